"""Programs that host the shader library, each with another preprocessor and compiler.

Each host draws in a separate process and may change its environment.
"""

from __future__ import annotations

import base64
import multiprocessing
import os
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.glsl.library import Language, Target

Image = NDArray[np.float32]  # (SIZE, SIZE, 4), row 0 where y is 0
Drawn = tuple[str, list[Image]]  # the host's version, and an image of each scene

SIZE = 64
# Light directions over the hemisphere above a plane and slightly below it. Products are exact and
# quotients are rounded once, so that all hosts use the same directions.
SCENE = """#include "facerender/cook_torrance.glsl"
#include "facerender/ward.glsl"

vec3 direction(vec2 place) {
    float s = dot(place, place);
    return vec3(2.0 * place, 1.0 - s) / (1.0 + s);
}

vec4 drawn(vec2 pixel) {
    vec3 n = vec3(0.0, 0.0, 1.0);
    vec3 l = direction((floor(pixel) - 31.5) / 32.0);
    vec3 v = direction(vec2(0.25, -0.125));
    float c = max(l.z, 0.0);
    return vec4(
        fr_cook_torrance(n, l, v, 0.6, 0.028), fr_ward(n, l, v, 0.6),
        fr_fresnel(0.028, c), fr_lobe(c, 0.6, FR_K_COOK_TORRANCE)
    );
}
"""
# Numbers instead of names of terms, since every preprocessor evaluates numbers.
CHOICES = {
    "defaults": "",
    "choices": "#define FR_LOBE 3\n#define FR_FRESNEL 1\n#define FR_MASKING 1\n",
    "small slope": "#define FR_SMALL_SLOPE 0\n",
    "every": "#define FR_LOBE 91\n",
}
_MAIN = "\nvoid main() { result = drawn(gl_FragCoord.xy); }\n"
_FRAGMENT = "\nlayout(location = 0) out vec4 result;\n" + _MAIN
_VERTEX = "#version 330\nin vec4 corner;\nvoid main() { gl_Position = corner; }\n"
_CORNERS = [[-1, -1, 0, 1], [3, -1, 0, 1], [-1, 3, 0, 1]]  # a triangle that covers the target
_BABYLON = Path(__file__).with_name("engines") / "babylonjs.js"


def flat(text: str, target: Target | Language | None = None) -> str:
    """Return the GLSL of a host without includes, for a target of ``fr.shader_source``."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "scene.glsl")
        path.write_text(text, encoding="utf-8")
        return fr.shader_source(str(path), target)


def desktop(scenes: Sequence[str]) -> Drawn:
    """Draw on OpenGL 3.3 by moderngl, the reference for the other hosts."""
    return _opengl(["#version 330\n" + flat(scene) + _FRAGMENT for scene in scenes])


def _opengl(fragments: Sequence[str]) -> Drawn:
    from facerender.drawing.context import create_context

    images = []
    with create_context("egl").gl as gl:
        target = gl.framebuffer([gl.renderbuffer((SIZE, SIZE), 4, dtype="f4")])
        target.use()
        corners = gl.buffer(np.array(_CORNERS, np.float32).tobytes())
        for fragment in fragments:
            program = gl.program(_VERTEX, fragment)
            gl.vertex_array(program, [(corners, "4f", "corner")]).render()
            images.append(_image(target.read(components=4, dtype="f4")))
        return str(gl.info["GL_VERSION"]), images


def _image(data: bytes) -> Image:
    return np.frombuffer(data, np.float32).reshape(SIZE, SIZE, 4)


def _naga(scenes: Sequence[str]) -> Drawn:
    """Compile GLSL with naga."""
    return _webgpu(["#version 450\n" + flat(scene) + _FRAGMENT for scene in scenes])


def _webgpu(fragments: Sequence[str | bytes]) -> Drawn:
    from tests.verification.webgpu import Device

    device = Device()
    images = [device.draw(fragment, (SIZE, SIZE)) for fragment in fragments]
    return device.version.split(", ")[1], images


def _glslc(scenes: Sequence[str]) -> Drawn:
    """Compile to SPIR-V with shaderc, which resolves the includes, and draw with wgpu."""
    with TemporaryDirectory() as folder:
        path, output = Path(folder, "scene.frag"), Path(folder, "scene.spv")
        codes = []
        for scene in scenes:
            path.write_text("#version 450\n" + scene + _FRAGMENT, encoding="utf-8")
            _run("glslc", "-Werror", "-I", fr.shader_dir(), path, "-o", output)
            codes.append(output.read_bytes())
    return f"glslc of {_run('glslc', '--version').split(chr(10))[0]}", _webgpu(codes)[1]


def _run(*command: str | Path) -> str:
    """Return the standard output of a tool.

    Raises
    ------
    FileNotFoundError : the tool is not installed
    RuntimeError : the tool fails; the message has its output
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{command[0]}: {done.stdout}{done.stderr}")
    return done.stdout


def _vispy(scenes: Sequence[str]) -> Drawn:
    os.environ |= {"PYOPENGL_PLATFORM": "egl", "EGL_PLATFORM": "surfaceless"}
    import vispy

    vispy.use(app="egl", gl="gl+")
    from vispy import app, gloo

    app.Canvas(size=(SIZE, SIZE), show=False).set_current()
    texture = gloo.Texture2D(shape=(SIZE, SIZE, 4), format="rgba", internalformat="rgba32f")
    images = []
    with gloo.FrameBuffer(texture):
        gloo.set_viewport(0, 0, SIZE, SIZE)
        for scene in scenes:
            program = gloo.Program(_VERTEX, "#version 330\n" + flat(scene) + _FRAGMENT)
            program["corner"] = np.array(_CORNERS, np.float32)
            program.draw("triangles")
            image = gloo.read_pixels((0, 0, SIZE, SIZE), alpha=True, out_type="float")
            images.append(image[::-1])
    return f"vispy {vispy.__version__}", images


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder by HTTP inside the context, and yield its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


def babylon(folder: Path, scenes: Sequence[str]) -> Drawn:
    """Draw in Chromium with Babylon.js, which npm installed in a folder."""
    from playwright.sync_api import sync_playwright

    from tests.verification import chromium

    script = _BABYLON.read_text(encoding="utf-8")
    main = _MAIN.replace("result", "gl_FragColor")
    with served(folder) as address, sync_playwright() as playwright:
        browser = chromium.launch(playwright)
        page = browser.new_page()
        page.goto(f"{address}package.json")
        call = {"fragments": [flat(scene) + main for scene in scenes], "size": SIZE}
        version, images = page.evaluate(script, call)
        browser.close()
    return version, [_image(base64.b64decode(data)) for data in images]


HOSTS: dict[str, Callable[[Sequence[str]], Drawn]] = {
    "naga": _naga,
    "glslc": _glslc,
    "vispy": _vispy,
}


def draw(host: Callable[[Sequence[str]], Drawn], scenes: Sequence[str]) -> Drawn:
    """Return the version and the images of a host."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(host, scenes).result()
