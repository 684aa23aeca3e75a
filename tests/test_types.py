"""Values of the wrong type, at every door: InputError, on one line, with the remedy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.scenes.mesh import Part
from tests.awkward_files import MINI_HEAD

WRONG = [
    *(None, "nonsense", b"x", -7, 1.5, True, [], ["x"], (1, 2, 3, 4, 5), {}, {"x": 1}),
    *(float("nan"), 10**400, 1j, object(), len, fr.Term, np.zeros((2, 3)), np.array(["a"])),
]

# Doors by name: what is called, and arguments that it takes; and what in WRONG is right for these.
Door = tuple[Callable[..., Any], dict[str, Any]]
NUMBER = (-7, 1.5, True)
RIGHT: dict[str, tuple[Any, ...]] = {
    "Camera": (None, *NUMBER),
    "Light": (None, *NUMBER),
    "Material": (None, *NUMBER),
    "Material second_uv": ([],),
    "Mesh name": ("nonsense",),
    "Mesh radius": (1.5,),
    "Mesh bounds": (WRONG[-2],),
    "Mesh millimetres": (None, 1.5),
    "Mesh regions": (None,),
    "Part uv": (None,),
    "Part uv2": (None,),
    "Part name": ("nonsense",),
    "Part colors": (None, WRONG[-2]),
    "Part occlusion": (None,),
    "Part": (WRONG[-2],),
    "Scene lights": ([], {}),
    "Scene": (None, *NUMBER),
    "Panorama name": ("nonsense",),
    "Environment": (-7, 1.5),
    "EnvironmentFile file": ("nonsense",),
    "EnvironmentFile": (-7, 1.5),
    "Term": (None, 1.5, True),
    "Shading normal_map": (True,),
    "Shading": (None, 1.5, True, b"x", [], (1, 2, 3, 4, 5), {}),
    "Shading.from_dict": ({},),
    **dict.fromkeys(
        ("MeshFile parts", "MeshFile hide"), (None, "nonsense", [], ["x"], {}, {"x": 1}, WRONG[-1])
    ),
    "MeshFile triangles": (None, 10**400),
    "MeshFile": (None, "nonsense", 1.5, True),
    "ImageSettings": (-7, 1.5, True, float("nan"), 10**400),  # the renderer tells
    "Output": (None, -7, 1.5),
    "Job mesh": (),
    "Job": (None, [], {}, *NUMBER),
    "Job.from_dict": ({},),
    "Renderer anisotropy": (1.5,),
    "Renderer float_albedo": (True,),
    "Renderer.of": (),
    "render m": (None, 1.5),
    "render lights": (None, [], {}),
    "render": (None,),
    "Renderer.render cull_back_faces": (True,),
    "Renderer.render": (None,),
    "Renderer.gbuffer blended": (True,),
    "Frame transparent": (True,),
    "Frame only": (None,),
    "Frame metadata": ({}, {"x": 1}),
    "Frame.save format": (None,),
    "Frame.save": (-7, 1.5),
    "Frame.srgb8": (-7, 1.5),
    "load_cameras size": (None,),
    "save_animation fps": (1.5,),
    "compare": (None, 1.5, True),
    "load_mesh flip_v": (True,),
    "load_mesh cache": (True,),
    "load_mesh allow_outside": (True,),
    **{
        f"load_mesh {name}": (None, WRONG[-2])
        for name in ("albedo", "normal_map", "specular_map", "roughness_map", "lobe_map")
    },
    "load_mesh": (None, 1.5),
    "Mesh.from_arrays name": ("nonsense",),
    "Mesh.from_arrays millimetres": (None, 1.5),
    "Mesh.from_arrays positions": (),
    "Mesh.from_arrays faces": (WRONG[-2],),
    "Mesh.from_arrays": (None,),
    "Mesh.select": ([], {}),
    "Texture.from_array texels": (WRONG[-2], True),
    "Texture.from_array name": ("nonsense",),
    "Texture.from_image name": ("nonsense",),
    "simplified triangles": (10**400,),
    "with_occlusion cache": (True,),
    "view_of aspect": (1.5,),
    "shifted x": (-7, 1.5),
    "shifted y": (-7, 1.5),
    "Texture decode": (len, fr.Term),
    "Texture name": ("nonsense",),
    "shader_source": (None, 1.5),
    "resolve_includes": ("nonsense",),
    "plan cameras": (None, [], {}),
    "plan sizes": (None, [], {}),
    "plan budget": (1.5,),
    "plan within": (True,),
    "plan exposure": (-7, 1.5),
    "plan verify_cost": (True,),
    "plan renderer": (None,),
}


@pytest.fixture(scope="module")
def doors(egl: Any) -> Iterator[dict[str, Door]]:
    mesh = fr.load_mesh(MINI_HEAD)
    part = mesh.parts[0]
    scene, shading, job = fr.Scene(mesh), fr.Shading(), fr.Job()
    defaults = {
        kind: {name: getattr(kind(), name) for name in kind.__dataclass_fields__}
        for kind in (fr.Camera, fr.Light, fr.Material, fr.MeshFile, fr.ImageSettings, fr.Job)
    }
    term = {name: getattr(fr.Term(), name) for name in fr.Term.__dataclass_fields__}
    own = {name: getattr(shading, name) for name in fr.Shading.__dataclass_fields__}
    size = {"size": (8, 8), "samples": 1, "backend": egl}
    with fr.Renderer((8, 8), samples=1, backend=egl) as renderer:
        frame = renderer.render(scene)
        view = fr.view_of(scene, 1.0)
        yield {
            **{kind.__name__: (kind, given) for kind, given in defaults.items()},
            "Term": (fr.Term, term),
            "Shading": (fr.Shading, {**term, **own, "frontal_lights": None}),
            "Shading.from_dict": (fr.Shading.from_dict, {"table": {}}),
            "Mesh": (fr.Mesh, {name: getattr(mesh, name) for name in mesh.__dataclass_fields__}),
            "Part": (Part, {name: getattr(part, name) for name in part.__dataclass_fields__}),
            "Scene": (
                fr.Scene,
                {name: getattr(scene, name) for name in scene.__dataclass_fields__},
            ),
            "Panorama": (fr.Panorama, {"name": "even", "radiance": np.ones((2, 4, 3))}),
            "Environment": (
                fr.Environment,
                {
                    "panorama": fr.Panorama("even", np.ones((2, 4, 3))),
                    "rotation": 0.0,
                    "scale": 1.0,
                },
            ),
            "EnvironmentFile": (
                fr.EnvironmentFile,
                {"file": "studio", "rotation": 0.0, "scale": 1.0},
            ),
            "load_environment": (fr.load_environment, {"file": fr.EnvironmentFile("studio")}),
            "Output": (fr.Output, {"path": "a.png", "only": None, "exposure": 0.0}),
            "Job.from_dict": (fr.Job.from_dict, {"tables": {}}),
            "Renderer": (fr.Renderer, {**size, "anisotropy": 1.0, "float_albedo": False}),
            "Renderer.of": (fr.Renderer.of, {"job": job, "backend": egl}),
            "Renderer.render": (
                renderer.render,
                {
                    **{"scene": scene, "shading": shading, "only": None, "samples": 1},
                    **{"cull_back_faces": False, "shading_rate": "sample"},
                },
            ),
            "Renderer.gbuffer": (
                renderer.gbuffer,
                {"scene": scene, "shading": shading, "blended": False},
            ),
            "Renderer.can_shade_per_pixel": (
                renderer.can_shade_per_pixel,
                {"scene": scene, "samples": 1},
            ),
            "render": (
                fr.render,
                {
                    **size,
                    **{name: term[name] for name in ("model", "lobe", "fresnel", "masking")},
                    **{"mesh": mesh, "outside": "error", "m": None},
                    **{"camera": fr.Camera(), "lights": None, "only": None},
                },
            ),
            "Frame": (
                fr.Frame,
                {"linear": frame.linear, "transparent": False, "metadata": {}, "only": None},
            ),
            "Frame.srgb8": (frame.srgb8, {"exposure": 0.0}),
            "Frame.save": (frame.save, {"path": "a.tiff", "exposure": 0.0, "format": None}),
            "compare": (
                fr.compare,
                {
                    **{"reference": frame, "image": frame, "mask": np.ones((8, 8))},
                    **{"point": 0.1, "block": 0.1, "coverage": 0.1},
                },
            ),
            "load_mesh": (
                fr.load_mesh,
                {
                    **{"source": MINI_HEAD, "albedo": None, "normal_map": None, "flip_v": False},
                    **{"specular_map": None, "roughness_map": None, "lobe_map": None},
                    **{"millimetres": None, "cache": False, "allow_outside": False, "kind": None},
                },
            ),
            "Mesh.from_arrays": (
                fr.Mesh.from_arrays,
                {
                    **{"positions": np.eye(3), "faces": [[0, 1, 2]], "uv": None, "normals": None},
                    **{"colors": None, "material": None, "name": "a", "millimetres": None},
                },
            ),
            "Mesh.select": (mesh.select, {"parts": (), "hide": ()}),
            "Texture.from_array": (fr.Texture.from_array, {"texels": np.eye(3), "name": "a"}),
            "Texture.from_image": (
                fr.Texture.from_image,
                {"image": Image.new("RGB", (2, 2)), "name": "a"},
            ),
            "load_cameras": (fr.load_cameras, {"path": "cameras.json", "size": None}),
            "save_animation": (fr.save_animation, {"path": "a.gif", "pictures": [], "fps": 12.0}),
            "load_scene": (fr.load_scene, {"path": "scene.toml"}),
            "simplified": (fr.simplified, {"mesh": mesh, "triangles": 300}),
            "with_occlusion": (fr.with_occlusion, {"mesh": mesh, "cache": False}),
            "turntable": (fr.turntable, {"camera": fr.Camera(), "count": 4}),
            "view_of": (fr.view_of, {"scene": scene, "aspect": 1.0}),
            "shifted": (fr.shifted, {"scene": scene, "x": 0.1, "y": 0.0, "size": (8, 8)}),
            "View.intrinsics": (view.intrinsics, {"size": (8, 8)}),
            "View.extrinsics": (view.extrinsics, {"mesh": mesh}),
            "Texture": (fr.Texture, {"decode": lambda: Image.new("RGB", (2, 2)), "name": "grey"}),
            "Texture.open": (fr.Texture.open, {"path": "map.png"}),
            "shader_source": (
                fr.shader_source,
                {"name": "ward", "target": None, "lobe": None, "m": None},
            ),
            "resolve_includes": (fr.resolve_includes, {"text": "void main() {}"}),
            "moderngl_includes": (fr.moderngl_includes, {"context": renderer.context.gl}),
            "plan": (
                fr.plan,
                {
                    **{"scene": scene, "budget": "1/255", "full": shading, "cameras": None},
                    **{"sizes": None, "within": 1.0, "verify_cost": False},
                    **{"cost": "auto", "exposure": 0.0, "renderer": renderer},
                },
            ),
        }


DOORS = [
    *("Camera", "Light", "Material", "Mesh", "Part", "Scene", "Panorama", "Environment"),
    *("EnvironmentFile", "load_environment", "Term", "Shading", "Shading.from_dict", "MeshFile"),
    *("ImageSettings", "Output", "Job", "Job.from_dict", "Renderer", "Renderer.of", "render"),
    *(
        "Renderer.render",
        "Renderer.gbuffer",
        "Renderer.can_shade_per_pixel",
        "Frame",
        "Frame.srgb8",
    ),
    *("Frame.save", "compare", "load_mesh", "load_scene", "simplified", "with_occlusion"),
    *("turntable", "view_of", "shifted", "View.intrinsics", "View.extrinsics"),
    *("Texture", "Texture.open", "Texture.from_array", "Texture.from_image"),
    *("Mesh.from_arrays", "Mesh.select"),
    *("load_cameras", "save_animation", "shader_source", "resolve_includes"),
    *("moderngl_includes", "plan"),
]


@pytest.mark.parametrize("door", DOORS)
def test_a_value_of_the_wrong_type_is_an_input_error(doors, door):
    function, good = doors[door]
    for name in good:
        right = RIGHT.get(f"{door} {name}", RIGHT.get(door, ()))
        for wrong in WRONG:
            if any(wrong is each or _equal(wrong, each) for each in right):
                continue
            with pytest.raises(fr.InputError) as told:
                function(**{**good, name: wrong})
            message = str(told.value)
            assert "\n" not in message
            assert 20 < len(message) <= 510


def _equal(a: Any, b: Any) -> bool:
    plain = isinstance(a, int | float | str | bytes | list | tuple | dict)
    return plain and type(a) is type(b) and repr(a) == repr(b)
