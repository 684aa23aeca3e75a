"""Targets that the shader library is tested on: OpenGL, OpenGL ES, WebGL 2 and Vulkan.

Each target runs in its own process: it sets Mesa's environment before Mesa loads, binds another API
of EGL, or runs an event loop.
"""

from __future__ import annotations

import base64
import ctypes
import multiprocessing
import os
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.drawing.context import Backend, ForeignContext, create_context
from facerender.errors import ContextError
from facerender.glsl.library import Language
from tests.verification import chromium
from tests.verification.evaluate import (
    EACH,
    WIDTH,
    Evaluator,
    Inputs,
    fetches,
    fragment_shaders,
    texels,
    vertex_shader,
)
from tests.verification.hosts import flat
from tests.verification.webgpu import Device


class Evaluate(Protocol):
    """Interface of :class:`Evaluator`: evaluates float expressions of the inputs."""

    renderer: str
    version: str

    def each(
        self, prelude: str, expressions: Sequence[str], inputs: Inputs
    ) -> NDArray[np.float32]: ...

    def release(self) -> None: ...


def _desktop(backend: Backend) -> Evaluator:
    return Evaluator(create_context(backend).gl)


def _desktop_450() -> Evaluator:
    egl: Any = {"backend": "egl", "libegl": "libEGL.so.1", "libgl": "libGL.so.1"}
    return Evaluator(moderngl.create_context(require=450, standalone=True, **egl), "450 core")


def _softpipe() -> Evaluator:
    os.environ["GALLIUM_DRIVER"] = "softpipe"
    evaluator = _desktop("egl")
    if "softpipe" not in evaluator.renderer:
        raise ContextError(f"no softpipe, but {evaluator.renderer}")
    return evaluator


def _es300() -> Evaluator:
    """Open an OpenGL ES 3.0 context without a surface; it stays current."""
    egl = ctypes.CDLL("libEGL.so.1")
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    egl.eglGetPlatformDisplay.restype = egl.eglCreateContext.restype = pointer
    surfaceless = 0x31DD  # EGL_PLATFORM_SURFACELESS_MESA
    display = pointer(egl.eglGetPlatformDisplay(surfaceless, None, None))
    config, count = pointer(), integer()
    # EGL_RENDERABLE_TYPE: ES 3; EGL_SURFACE_TYPE: pbuffer
    wanted = (integer * 5)(0x3040, 0x40, 0x3033, 1, 0x3038)
    version = (integer * 5)(0x3098, 3, 0x30FB, 0, 0x3038)
    context = None
    if egl.eglInitialize(display, None, None) and egl.eglBindAPI(0x30A0):  # EGL_OPENGL_ES_API
        egl.eglChooseConfig(display, wanted, ctypes.byref(config), 1, ctypes.byref(count))
        context = pointer(egl.eglCreateContext(display, config, None, version))
    if not context or not egl.eglMakeCurrent(display, None, None, context):
        raise ContextError("libEGL refused an OpenGL ES 3.0 context")
    loader: Any = ForeignContext(egl.eglGetProcAddress)
    return Evaluator(moderngl.create_context(require=300, context=loader), "300 es")


class _WebGL:
    """WebGL 2 in a page of headless Chromium, on SwiftShader."""

    def __init__(self) -> None:
        from playwright.sync_api import sync_playwright

        self._playwright = sync_playwright().start()
        self._browser = chromium.launch(self._playwright)
        self._page = self._browser.new_page()
        self._folder = TemporaryDirectory()
        self._file = Path(self._folder.name, "inputs")
        script = Path(__file__).with_name("webgl.js").read_text(encoding="utf-8")
        self.renderer, self.version = self._page.evaluate(script)

    def release(self) -> None:
        self._browser.close()
        self._playwright.stop()
        self._folder.cleanup()

    def each(self, prelude: str, expressions: Sequence[str], inputs: Inputs) -> NDArray[np.float32]:
        images = {f"{name}_texels": texels(values) for name, values in inputs.items()}
        self._file.write_bytes(b"".join(image.tobytes() for image in images.values()))
        self._page.set_input_files("input", self._file)
        call = {
            "vertex": vertex_shader("300 es"),
            "fragments": list(fragment_shaders("300 es", prelude, expressions, inputs)),
            "inputs": {name: image.shape[-1] for name, image in images.items()},
            "width": WIDTH,
            "height": next(iter(images.values())).shape[0],
        }
        data = base64.b64decode(self._page.evaluate("call => window.evaluate(call)", call))
        count = len(next(iter(inputs.values())))
        pixels = np.frombuffer(data, np.float32).reshape(len(call["fragments"]), -1, EACH)
        return np.concatenate(pixels[:, :count].transpose(0, 2, 1))[: len(expressions)]


class _Lavapipe:
    """Vulkan by wgpu, for GLSL 450 and for HLSL and WGSL that facerender translated."""

    def __init__(self, language: Language | None) -> None:
        """language : None for GLSL"""
        self._language = language
        self._device = Device()
        self.renderer, self.version = self._device.renderer, self._device.version

    def release(self) -> None:
        pass

    def each(self, prelude: str, expressions: Sequence[str], inputs: Inputs) -> NDArray[np.float32]:
        images = [texels(values) for values in inputs.values()]
        size = WIDTH, images[0].shape[0]
        fetched = tuple(inputs), "\n".join(fetches(inputs))
        results = []
        for first in range(0, len(expressions), EACH):
            few = [*expressions[first : first + EACH], *["0.0"] * (EACH - 1)][:EACH]
            code = _fragment(self._language, prelude, ", ".join(few), *fetched)
            results.append(self._device.draw(code, size, images).reshape(-1, EACH).T)
        count = len(next(iter(inputs.values())))
        return np.concatenate(results)[: len(expressions), :count]


@cache
def _fragment(
    language: Language | None, prelude: str, values: str, names: Sequence[str], fetched: str
) -> str | bytes:
    """Return the code of a fragment shader, or its SPIR-V.

    names, fetched : the inputs, and their declarations
    """
    textures = [f"{name}_texels" for name in names]
    parameters = ", ".join(f"sampler2D {texture}" for texture in textures)
    body = f"{{ {fetched} return vec4({values}); }}"
    text = f"{prelude}\nvec4 evaluated({parameters}, ivec2 at) {body}\n"
    if language:
        text = flat(text, language)
    else:  # naga supports neither RelaxedPrecision nor textures with a sampler.
        text = _VULKAN + text.replace("mediump", "highp").replace("sampler2D", "texture2D")
    texture, main = _READING[language]
    bindings = [texture.format(i=i, name=name) for i, name in enumerate(textures)]
    code = "\n".join([text, *bindings, main.format(", ".join(textures))])
    return code if language == "wgsl" else compiled(code, hlsl=language == "hlsl")


_VULKAN = """#version 450
#extension GL_EXT_samplerless_texture_functions : enable
precision highp float;
precision highp int;
"""
# For each language: a texture, and the main function.
_READING = {
    None: (
        "layout(binding = {i}) uniform texture2D {name};",
        """layout(location = 0) out vec4 result;
void main() {{ result = evaluated({}, ivec2(gl_FragCoord.xy)); }}
""",
    ),
    "hlsl": (
        "[[vk::binding({i}, 0)]] Texture2D<float4> {name};",
        """float4 main(float4 pixel : SV_Position) : SV_Target {{
    return evaluated({}, int2(pixel.xy));
}}
""",
    ),
    "wgsl": (
        "@group(0) @binding({i}) var {name}: texture_2d<f32>;",
        """@fragment fn main(@builtin(position) pixel: vec4f) -> @location(0) vec4f {{
    return evaluated({}, vec2i(pixel.xy));
}}
""",
    ),
}


def compiled(text: str, hlsl: bool = False) -> bytes:
    """Return the SPIR-V that glslang compiles from a fragment shader in Vulkan GLSL or HLSL."""
    with TemporaryDirectory() as folder:
        path, output = Path(folder, "x.frag"), Path(folder, "x.spv")
        path.write_text(text, encoding="utf-8")
        options = ["-V", "-S", "frag", "-o", str(output), str(path)]
        options += ["-D", "-e", "main"] if hlsl else []
        done = subprocess.run(["glslangValidator", *options], capture_output=True, text=True)
        if done.returncode or "WARNING" in done.stdout:
            raise RuntimeError(done.stdout)
        return output.read_bytes()


TARGETS: dict[str, Callable[[], Evaluate]] = {
    "GLSL 330, EGL": partial(_desktop, "egl"),
    "GLSL 330, OSMesa": partial(_desktop, "osmesa"),
    "GLSL 450, EGL": _desktop_450,
    "GLSL 330, softpipe": _softpipe,
    "GLSL ES 300, EGL": _es300,
    "WebGL 2, Chromium": _WebGL,
}
TRANSLATED: dict[str, Callable[[], Evaluate]] = {
    "HLSL, Vulkan": partial(_Lavapipe, "hlsl"),
    "WGSL, Vulkan": partial(_Lavapipe, "wgsl"),
}
LAVAPIPE: dict[str, Callable[[], Evaluate]] = {
    "GLSL 450, Vulkan": partial(_Lavapipe, None),
    **TRANSLATED,
}


_here: Evaluate  # set in the process of a target only


def _open(target: str) -> tuple[str, str]:
    global _here
    _here = (TARGETS | LAVAPIPE)[target]()
    return _here.renderer, _here.version


def _each(prelude: str, expressions: Sequence[str], inputs: Inputs) -> NDArray[np.float32]:
    return _here.each(prelude, expressions, inputs)


def _release() -> None:
    _here.release()


class Remote:
    """The evaluator of a target, in a separate process."""

    def __init__(self, target: str) -> None:
        self.name = target
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        try:
            self.renderer, self.version = self._pool.submit(_open, target).result()
        except Exception:
            self._pool.shutdown()
            raise

    def each(self, prelude: str, expressions: Sequence[str], inputs: Inputs) -> NDArray[np.float32]:
        return self._pool.submit(_each, prelude, expressions, inputs).result()

    def __enter__(self) -> Remote:
        return self

    def __exit__(self, *exception: object) -> None:
        self._pool.submit(_release).result()
        self._pool.shutdown()
