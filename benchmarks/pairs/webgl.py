"""Rendering of a scene with WebGL 2 in headless Chromium, on SwiftShader: the same passes and GLSL
as the renderer's, on another driver."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import facerender as fr
from facerender.drawing.prepare import reduced, resolve
from facerender.drawing.program import ENVIRONMENT_MAP, Draw, Pass, fixed_attributes
from facerender.scene.scene import Scene
from facerender.scene.view import view_of
from facerender.texture.texture import Kind
from tests.verification.forward import forward_passes

if TYPE_CHECKING:
    from playwright.sync_api import Browser


class _Blob:
    """A buffer of concatenated arrays."""

    def __init__(self) -> None:
        self.content = bytearray()

    def place(self, values: ArrayLike, kind: Any) -> tuple[int, int]:
        """Append an array; return its offset and length in bytes."""
        data = np.ascontiguousarray(values, dtype=kind).tobytes()
        start = len(self.content)
        self.content += data + b"\0" * (-len(data) % 4)
        return start, len(data)


def draw_webgl(
    browser: Browser, scene: Scene, shading: fr.Shading, size: tuple[int, int], float_albedo: bool
) -> NDArray[np.float32]:
    """Render a scene without subsurface scattering, with one sample per pixel.

    Returns linear RGB and coverage, (H, W, 4).
    """
    view = view_of(scene, size[0] / size[1])
    albedo: Kind = "linear-color" if float_albedo else "color"
    resolved = resolve(scene, shading, albedo)
    if not float_albedo:
        resolved = resolve(reduced(resolved, view, size, 1.0), shading, albedo)
    scene = resolved.scene
    steps = forward_passes(resolved, view, size)
    camera = {"view_projection": view.matrix, "camera_position": view.eye}
    camera["forward"] = view.forward
    blob = _Blob()
    passes = [
        {
            "name": step.name,
            "size": step.target.size or size,
            "number": step.target.channels == (1,),
            "clear": step.clear,
            "draws": [_described(blob, draw, step, scene, size, camera) for draw in step.draws],
        }
        for step in steps
    ]
    script = Path(__file__).with_name("webgl.js").read_text(encoding="utf-8")
    page = browser.new_page()
    with TemporaryDirectory() as folder:
        file = Path(folder, "buffers")
        file.write_bytes(blob.content)
        page.evaluate(script)
        page.set_input_files("input", file)
        data = base64.b64decode(page.evaluate("passes => window.draw(passes)", passes))
    page.close()
    return np.frombuffer(data, np.float32).reshape(*size[::-1], 4)


def _map(
    blob: _Blob,
    levels: Any,
    kind: str,
    numbers: Any,
    wrap: tuple[str, str] = ("clamp", "clamp"),
    step: bool = False,
    filtered: bool = True,
) -> dict[str, Any]:
    return {
        "levels": [
            {"width": each.shape[1], "height": each.shape[0], "place": blob.place(each, numbers)}
            for each in levels
        ],
        "kind": kind,
        "wrap": wrap,
        "step": step,
        "filtered": filtered,
    }


def _described(
    blob: _Blob,
    draw: Draw,
    step: Pass,
    scene: Scene,
    size: tuple[int, int],
    camera: Mapping[str, NDArray[np.float64]],
) -> dict[str, Any]:
    """Return a draw as JSON data for webgl.js."""
    maps: dict[str, Any] = {}
    if scene.environment is not None:
        texels = scene.environment.panorama.map
        maps[ENVIRONMENT_MAP] = _map(blob, [texels], "float", np.float32, filtered=False)
    columns: dict[str, NDArray[Any]] = {}
    faces = np.arange(3, dtype=np.uint32)
    if draw.part is not None:
        part = draw.part.part
        positions, normals = np.hsplit(scene.mesh.setups[draw.part.index].vertices, 2)
        columns = {"in_position": positions, "in_normal": normals, **fixed_attributes(part)}
        faces = part.faces
        if draw.order is not None:  # back to front
            depth = (positions @ camera["forward"])[faces].sum(axis=1)
            faces = faces[np.argsort(-depth, kind="stable")]
        maps |= {
            name: _map(
                *(blob, texture.levels(kind).result(), kind),
                np.float16 if kind == "linear-color" else np.uint8,
                *(texture.wrap, name == "property_map", not texture.nearest),
            )
            for name, texture, kind in draw.part.maps
        }
    uniforms: dict[str, Any] = {**camera, **step.uniforms, **draw.uniforms}
    sources = draw.program.sources("300 es")
    first, rest = sources["frag"].split("\n", 1)
    return {
        "sources": sources | {"frag": f"{first}\nprecision highp float;\n{rest}"},
        "uniforms": {
            name: np.asarray(value, dtype=float).ravel().tolist()
            for name, value in uniforms.items()
        },
        "maps": maps,
        "columns": {
            name: {"width": values.shape[1], "place": blob.place(values, np.float32)}
            for name, values in columns.items()
        },
        "faces": blob.place(faces, np.uint32),
        "area": draw.area or (0, 0, *(step.target.size or size)),
        "blend": draw.depth == "blend",
    }
