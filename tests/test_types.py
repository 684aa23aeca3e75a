"""Tests values of the wrong type for every parameter of every public class and function. Fields of
records raise InputError, other parameters also Python's own errors; each message is one line. The
parameter's annotation decides which values are wrong."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.loading import MESH_PATHS
from facerender.values.fields import limits_of
from tests.awkward_files import MINI_HEAD

MATRIX, NAME, HUGE = np.zeros((2, 3)), np.array(["a"]), 10**400
VALUES = [
    *(None, "nonsense", b"x", -7, 1.5, True, [], ["x"], (1, 2, 3, 4, 5), {}, {"x": 1}),
    *(float("nan"), HUGE, 1j, object(), len, fr.Term, MATRIX, NAME),
]
# Patterns of annotations, and the VALUES that may be valid for them.
ALLOWED = {
    r"\| None$": [None],
    r"^float|^Vector|^str \| float": [-7, 1.5],
    r"^bool": [True],
    r"^tuple\[.*\.\.\.|^Sequence|Iterable|^Mapping\[int|^ArrayLike": [[]],
    r"^Mapping|^tuple\[[LO]|^Sequence|Iterable\[str": [{}],
    r"^Mapping\[str, str": [{"x": 1}],
    r"^Sequence\[int": [b"x", (1, 2, 3, 4, 5)],  # may be indices
    r"^tuple\[str": [["x"], {"x": 1}, {}, NAME, "nonsense"],
    r"^Callable\[\[\], Image": [len, fr.Term],  # called later
    r"^Map \|": [MATRIX],
    r"^bytes": [b"x"],
}
# Further valid values of single parameters.
RIGHT: dict[str, list[Any]] = {
    "Job mesh": ["nonsense", {}],  # a path, and a table without fields
    **{f"{name} camera": [{}] for name in ("Scene", "turntable", "render")},
    **{f"Scene {name}": [None] for name in ("lights", "ambient", "mesh")},
    "load_mesh rotate": [None],
    **{f"Shading {name}_lights": [b"x", (1, 2, 3, 4, 5), {}] for name in ("specular", "shadow")},
    **{f"load_mesh {name}": [None, [], {}, ["x"]] for name in ("parts", "hide")},
    **{f"MeshFile {name}": [None, MATRIX] for name in MESH_PATHS},
    **{f"{name} only": [None, [], {}] for name in ("render", "Renderer.render")},
    **{f"{name} background": [None, 1.5, MATRIX] for name in ("Scene", "Job", "render")},
    "MeshFile triangles": [HUGE],  # keeps all triangles
    "simplified triangles": [HUGE],
    "Pose weights": [{"x": 1}],
    **{f"{name} paths": [["x"]] for name in ("resolve_includes", "shader_source")},
    **{f"Mesh.with_positions {name}": [None, {}] for name in ("positions", "normals")},
    **{f"Mesh{name}": [MATRIX] for name in (" bounds", " rotation", ".from_arrays faces")},
    "Texture.from_array texels": [MATRIX],
}
# Python reports wrong types of typed parameters, with these errors.
PYTHON_ERRORS = (TypeError, AttributeError, ValueError, IndexError, KeyError, OverflowError)
# Parameters for internal use, and typed parameters of which Python accepts any object.
UNCHECKED = (
    *("Texture size", "Texture name", "Texture profile", "Texture decode", "plan progress"),
    *("Texture.from_image name", "Texture.from_array name", "Mesh.from_arrays name", "Mesh pose"),
    *("Frame only", "Frame transparent", "Frame metadata", "Renderer.gbuffer blended"),
    *("Frame background", "Frame warned", "Frame mm_per_pixel"),
    *("Scene before", "load_mesh cache", "with_occlusion cache", "plan renderer", "plan sizes"),
)
METHODS = [
    *("Shading.from_dict", "Job.from_dict", "Renderer.of", "Renderer.render", "Renderer.gbuffer"),
    *("Renderer.can_shade_per_pixel", "Frame.srgb8", "Frame.save", "Mesh.from_arrays"),
    *("Mesh.select", "Mesh.with_positions", "Texture.open", "Texture.from_array"),
    *("Texture.from_image", "View.intrinsics", "View.extrinsics"),
    *("Camera.from_opencv", "Camera.from_view_matrix", "Camera.from_camera_to_world"),
]
GIVEN = ("renderer", "backend", "size", "samples", "mesh", "source")  # replace expensive defaults
RESULTS = ("Face", "GBuffer", "Plan", "Registration", "View")  # created only by functions


def public_callables() -> list[str]:
    """Return the names of all public classes, functions and methods with parameters."""
    errors = [name for name in fr.__all__ if name.endswith(("Error", "Warning"))]
    names = [name for name in fr.__all__ if callable(getattr(fr, name))]
    return [*sorted({*names} - {*errors, *RESULTS}), *METHODS]


@pytest.fixture(scope="module")
def objects(egl: Any) -> Iterator[dict[str, Any]]:
    """Valid arguments, by "PARAMETER" or "CALLABLE PARAMETER"."""
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh)
    with fr.Renderer((8, 8), samples=1, backend=egl) as renderer:
        frame = renderer.render(scene)
        yield {
            **{f"Mesh {name}": value for name, value in vars(mesh).items()},
            **{f"Frame {name}": value for name, value in vars(frame).items()},
            **{"Renderer": renderer, "Frame": frame, "View": fr.view_of(scene, 1.0), "Mesh": mesh},
            **{"mesh": mesh, "scene": scene, "job": fr.Job(), "source": MINI_HEAD, "name": "a"},
            **{"panorama": fr.Panorama("even", np.ones((2, 4, 3))), "radiance": np.ones((2, 4, 3))},
            **{"load_environment file": fr.EnvironmentFile("studio"), "file": "studio"},
            **{"path": "a.png", "reference": frame, "image": frame, "budget": "1/255"},
            **{"context": renderer.context.gl, "renderer": renderer, "text": "void main() {}"},
            **{"images": [], "x": 0.1, "y": 0.0, "size": (8, 8), "triangles": 300, "aspect": 1.0},
            **{"samples": 1, "table": {}, "tables": {}, "positions": np.eye(3), "backend": egl},
            **{"faces": [[0, 1, 2]], "texels": np.eye(3), "shader_source name": "ward"},
            **{"Texture.from_image image": Image.new("RGB", (2, 2)), "only": None},
            **{"decode": lambda: Image.new("RGB", (2, 2)), "Frame.save path": "a.gif"},
        }


def right(call: str, name: str, annotation: str) -> list[Any]:
    """Return those VALUES that may be valid for a parameter."""
    annotation = re.sub(r"^InitVar\[(.*)\]$", r"\1", annotation)
    values = [
        value for words, some in ALLOWED.items() if re.search(words, annotation) for value in some
    ]
    any_text = name in ("name", "file", "text", "clip", "vertices", "anonymous") or (
        call == "MeshFile" and name in MESH_PATHS
    )
    return [*values, *["nonsense"] * any_text, *RIGHT.get(f"{call} {name}", [])]


@pytest.mark.parametrize("call", public_callables())
def test_values_of_the_wrong_type_raise_an_error_of_one_line(objects, call):
    owner, _, method = call.partition(".")
    function = getattr(fr, owner)
    if method:
        static = isinstance(inspect.getattr_static(function, method), classmethod | staticmethod)
        function = getattr(function if static else objects[owner], method)
    parameters = dict(inspect.signature(function).parameters)
    parameters.pop("unknown", None)  # keywords that are always refused
    good = {
        name: objects.get(f"{call} {name}", objects.get(name))
        for name, each in parameters.items()
        if each.default is each.empty or name in GIVEN
    }
    for name, each in parameters.items():
        allowed = right(call, name, str(each.annotation))
        for wrong in VALUES:
            if f"{call} {name}" in UNCHECKED or any(_equal(wrong, value) for value in allowed):
                continue
            is_field = name in limits_of(function) if is_dataclass(function) else False
            expected = fr.InputError if is_field else (fr.InputError, *PYTHON_ERRORS)
            with pytest.raises(expected) as caught:
                function(**{**good, name: wrong})
            message = str(caught.value)
            assert "\n" not in message
            assert isinstance(caught.value, PYTHON_ERRORS) or 20 < len(message) <= 510


def _equal(a: Any, b: Any) -> bool:
    plain = isinstance(a, int | float | str | bytes | list | tuple | dict)
    return a is b or (plain and type(a) is type(b) and repr(a) == repr(b))
