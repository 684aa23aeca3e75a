"""Render a sphere with moderngl; its programs include files of the shader library by name.

python examples/moderngl_minimal.py [OUT.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.image import encode_srgb8

SHADER = Path(__file__).with_name("sphere")
SIZE = 512


def draw() -> NDArray[np.float32]:
    """Return linear RGB of the sphere, with the specular radiance as alpha; row 0 at the top."""
    gl = moderngl.create_context(
        standalone=True, backend="egl", libegl="libEGL.so.1", libgl="libGL.so.1"
    )
    fr.moderngl_includes(gl)  # enables #include "facerender/cook_torrance.glsl"
    program = gl.program(
        vertex_shader=SHADER.with_suffix(".vert").read_text(encoding="utf-8"),
        fragment_shader=SHADER.with_suffix(".frag").read_text(encoding="utf-8"),
    )
    target = gl.framebuffer([gl.renderbuffer((SIZE, SIZE), 4, dtype="f4")])
    target.use()
    gl.vertex_array(program, []).render(vertices=3)
    data = target.read(components=4, dtype="f4")
    gl.release()
    return np.frombuffer(data, np.float32).reshape(SIZE, SIZE, 4)[::-1]


def main() -> None:
    path = sys.argv[1] if len(sys.argv) > 1 else "moderngl.png"
    Image.fromarray(encode_srgb8(draw()[..., :3])).save(path)


if __name__ == "__main__":
    main()
