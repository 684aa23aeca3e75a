"""Render a sphere with PyOpenGL and EGL. OpenGL has no includes, so facerender resolves them.

python examples/pyopengl_include.py [OUT.png]
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.image import encode_srgb8

os.environ["PYOPENGL_PLATFORM"] = "egl"  # before PyOpenGL is imported
from OpenGL import EGL, GL
from OpenGL.GL.shaders import compileProgram, compileShader

SHADER = Path(__file__).with_name("sphere")
SIZE = 512
EGL_PLATFORM_SURFACELESS_MESA = 0x31DD  # missing in PyOpenGL


def make_context_current() -> None:
    """Create an OpenGL 3.3 core context without a window, and make it current."""
    display = EGL.eglGetPlatformDisplay(EGL_PLATFORM_SURFACELESS_MESA, None, None)
    EGL.eglInitialize(display, None, None)
    EGL.eglBindAPI(EGL.EGL_OPENGL_API)
    attributes = [
        *(EGL.EGL_CONTEXT_MAJOR_VERSION, 3, EGL.EGL_CONTEXT_MINOR_VERSION, 3),
        *(EGL.EGL_CONTEXT_OPENGL_PROFILE_MASK, EGL.EGL_CONTEXT_OPENGL_CORE_PROFILE_BIT),
        EGL.EGL_NONE,
    ]
    context = EGL.eglCreateContext(display, None, None, attributes)
    EGL.eglMakeCurrent(display, None, None, context)


def compiled(path: Path, kind: int) -> int:
    """Return the compiled shader of a file, with resolved includes."""
    return compileShader(fr.resolve_includes(path.read_text(encoding="utf-8")), kind)


def draw() -> NDArray[np.float32]:
    """Return linear RGB of the sphere, with the specular radiance as alpha; row 0 at the top."""
    make_context_current()
    colour = GL.glGenRenderbuffers(1)
    GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, colour)
    GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, GL.GL_RGBA32F, SIZE, SIZE)
    GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, GL.glGenFramebuffers(1))
    GL.glFramebufferRenderbuffer(
        GL.GL_FRAMEBUFFER, GL.GL_COLOR_ATTACHMENT0, GL.GL_RENDERBUFFER, colour
    )
    GL.glViewport(0, 0, SIZE, SIZE)
    GL.glBindVertexArray(GL.glGenVertexArrays(1))
    program = compileProgram(
        compiled(SHADER.with_suffix(".vert"), GL.GL_VERTEX_SHADER),
        compiled(SHADER.with_suffix(".frag"), GL.GL_FRAGMENT_SHADER),
    )
    GL.glUseProgram(program)
    GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
    return GL.glReadPixels(0, 0, SIZE, SIZE, GL.GL_RGBA, GL.GL_FLOAT, outputType=None)[::-1]


def main() -> None:
    path = sys.argv[1] if len(sys.argv) > 1 else "pyopengl.png"
    Image.fromarray(encode_srgb8(draw()[..., :3])).save(path)


if __name__ == "__main__":
    main()
