"""Render a sphere with Panda3D. Panda3D does not resolve nested includes, so facerender does.

python examples/panda3d_sphere.py [OUT.png]
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.srgb import encode_srgb8

os.environ.setdefault("EGL_PLATFORM", "surfaceless")  # before Panda3D opens EGL
from panda3d import core

SHADER = Path(__file__).with_name("sphere")
SIZE = 512
SETTINGS = "load-display p3headlessgl\naudio-library-name null\ngl-version 3 3"


def shader() -> core.Shader:
    """Return the shader of the two files, with resolved includes."""
    texts = [
        fr.resolve_includes(SHADER.with_suffix(end).read_text(encoding="utf-8"))
        for end in (".vert", ".frag")
    ]
    return core.Shader.make(core.Shader.SL_GLSL, *texts)


def target(engine: core.GraphicsEngine) -> tuple[core.GraphicsOutput, core.Texture]:
    """Return an off-screen float render target and its texture."""
    pipe = core.GraphicsPipeSelection.get_global_ptr().make_default_pipe()
    flags = core.GraphicsPipe.BF_refuse_window
    properties = core.FrameBufferProperties.get_default()
    window = core.WindowProperties(size=(1, 1))
    host = engine.make_output(pipe, "context", 0, properties, window, flags)
    floats = core.FrameBufferProperties()
    floats.set_float_color(True)
    floats.set_rgba_bits(32, 32, 32, 32)
    window = core.WindowProperties(size=(SIZE, SIZE))
    output = engine.make_output(pipe, "sphere", 1, floats, window, flags, host.gsg, host)
    texture = core.Texture()
    texture.setup_2d_texture(SIZE, SIZE, core.Texture.T_float, core.Texture.F_rgba32)
    output.add_render_texture(texture, output.RTM_copy_ram, output.RTP_color)
    output.set_clear_color((0, 0, 0, 0))
    return output, texture


def draw() -> NDArray[np.float32]:
    """Return linear RGB of the sphere, with the specular radiance as alpha; row 0 at the top."""
    core.load_prc_file_data("", SETTINGS)
    engine = core.GraphicsEngine.get_global_ptr()
    output, texture = target(engine)
    card = core.CardMaker("picture")
    card.set_frame_fullscreen_quad()
    root = core.NodePath("scene")
    root.attach_new_node(card.generate()).set_shader(shader())
    lens = core.OrthographicLens()
    lens.set_film_size(2, 2)
    lens.set_near_far(-1, 1)
    output.make_display_region().set_camera(root.attach_new_node(core.Camera("eye", lens)))
    engine.render_frame()
    pixels = np.frombuffer(bytes(texture.get_ram_image_as("RGBA")), np.float32)
    return pixels.reshape(SIZE, SIZE, 4)[::-1]


def main() -> None:
    path = sys.argv[1] if len(sys.argv) > 1 else "panda3d.png"
    Image.fromarray(encode_srgb8(draw()[..., :3])).save(path)


if __name__ == "__main__":
    main()
