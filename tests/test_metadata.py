"""Tests the metadata of images: every parameter of a frame, as text."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing.context import Backend
from facerender.images.files import read_image, save_exr
from facerender.scene.environment import studio
from facerender.scene.light import LIGHTS
from tests.awkward_files import MINI_HEAD
from tests.meshes import with_geometry

TEXELS = np.full((4, 4, 3), 100, np.uint8)


@pytest.fixture(scope="module")
def renderer(egl: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer((16, 16), samples=1, backend=egl) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def mesh() -> fr.Mesh:
    """A mesh of two parts, the second with other factors."""
    parts = fr.load_mesh(MINI_HEAD).parts * 2
    skin = fr.Material(m=0.25, scattering="skin")
    parts = tuple(replace(part, name=name) for part, name in zip(parts, "ab", strict=False))
    return fr.Mesh.of("two.glb", parts, [skin, replace(skin, ks=0.5, m=0.1)], millimetres=1000.0)


def test_metadata_lists_every_parameter_once(renderer, mesh):
    lights = (fr.Light(10.0, irradiance=2.0, radius=2.0), "key,no-shadow")
    scene = fr.Scene(mesh, fr.Camera(zoom=1.5), lights, 0.5, None, fr.Environment(studio(), 30.0))
    found = dict(renderer.render(scene, fr.Shading(shadow_lights=[0])).metadata)
    size = "6888 vertices, 13444 triangles, radius 0.181261, 1 unit = 1000.0 mm"
    assert found.pop("mesh").startswith(f"two.glb, {size}, CRC-32 ")
    scale = found.pop("scale")
    assert scale.endswith(" mm per pixel at the eyes")
    drivers = found.pop("GL_RENDERER"), found.pop("GL_VERSION")
    assert drivers == (renderer.context.renderer, renderer.context.version)
    assert found == {
        "albedo": "(0.48, 0.28, 0.21)",
        "m": "0.25 (a); 0.1 (b)",
        "f0": "0.028",
        "ks": "1.0 (a); 0.5 (b)",
        "kd": "1.0",
        "scattering": "skin",
        "double_sided": found["double_sided"],
        "camera": "Camera(zoom=1.5)",
        "light 0": "Light(azimuth=10.0, irradiance=(2.0, 2.0, 2.0), radius=2.0)",
        "light 1": repr(replace(LIGHTS["key"], shadow=False)),
        "ambient": "(0.5, 0.5, 0.5)",
        "background": "None",
        "environment": "studio, rotation 30.0, scale 1.0",
        "textures": "float",
        "model": "cook-torrance",
        "lobe": "exact",
        "fresnel": "schlick",
        "masking": "v-cavity",
        "shadow_lights": "[0]",
        "facerender": fr.__version__,
        "samples": "1",
        "anisotropy": "1.0",
        "float_albedo": "False",
    }


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("m", {"mesh": {"m": 0.101}}),
        ("emissive", {"mesh": {"emissive": (0.1, 0.0, 0.0)}}),
        ("mesh", {"moved": 1e-4}),
        ("camera", {"camera": fr.Camera(azimuth=1.0)}),
        ("light 2", {"lights": ["key", "rim", "top"]}),
        ("background", {"background": (0.1, 0.2, 0.3)}),
        ("samples", {"samples": 2}),
        ("m", {"shading": fr.Shading(m=0.2)}),
        ("environment_samples", {"shading": fr.Shading(environment_samples=8)}),
    ],
)
def test_changed_parameter_changes_its_own_row(renderer, mesh, key, change):
    before = renderer.render(fr.Scene(mesh)).metadata
    changed = mesh.with_material(("b",), **change.get("mesh", {}))
    if "moved" in change:
        positions = [part.positions.copy() for part in mesh.parts]
        positions[1][0] += change["moved"]
        changed = mesh.with_positions(positions)
    others = {key: change[key] for key in ("camera", "lights", "background") if key in change}
    shading, samples = change.get("shading", fr.Shading()), change.get("samples")
    after = renderer.render(fr.Scene(changed, **others), shading, None, samples).metadata
    rows = before.keys() | after.keys()
    changed_rows = {name for name in rows if before.get(name) != after.get(name)}
    assert changed_rows - ({"scale"} if key == "camera" else set()) == {key}


def test_frame_of_data_has_the_scene(renderer, mesh):
    whole, depth = (renderer.render(fr.Scene(mesh), only=only).metadata for only in (None, "depth"))
    own = {"only": "depth", "alpha_threshold": "0.5"}
    assert depth.items() <= {**whole, **own}.items()
    assert {"mesh", "camera", "m", "light 0", "GL_RENDERER", "textures"} <= depth.keys()


def test_textures_are_8_bit_if_any_drawn_map_is(egl, renderer):
    plain = fr.load_mesh(MINI_HEAD).with_material(albedo_map=None, normal_map=None)
    texture = fr.Texture.from_array(TEXELS, "texels")
    colored = plain.with_material(albedo_map=texture)
    bumpy = colored.with_material(normal_map=texture)
    unseen = plain.with_material(opacity_map=texture, emissive_map=texture)
    flat = fr.Shading(normal_map=False)

    def drawn(renderer: fr.Renderer, mesh: fr.Mesh, shading: fr.Shading = fr.Shading()) -> str:
        return renderer.render(fr.Scene(mesh, environment="studio"), shading).metadata["textures"]

    assert [drawn(renderer, mesh) for mesh in (plain, unseen)] == ["float", "float"]
    assert [drawn(renderer, mesh) for mesh in (colored, bumpy)] == ["8-bit", "8-bit"]
    with fr.Renderer((16, 16), samples=1, backend=egl, float_albedo=True) as floats:
        assert [drawn(floats, mesh) for mesh in (colored, bumpy)] == ["float", "8-bit"]
        assert drawn(floats, bumpy, flat) == "float"
        assert floats.metadata["float_albedo"] == "True"


def test_metadata_has_no_paths(renderer, tmp_path):
    shutil.copy(MINI_HEAD, tmp_path)
    save_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32), {})
    scene = fr.Scene(tmp_path / MINI_HEAD.name, environment=tmp_path / "sky.exr")
    metadata = renderer.render(scene).metadata
    assert metadata["mesh"].startswith("mini_head.glb, ")
    assert metadata["environment"].startswith("sky.exr, ")
    assert not any(str(tmp_path) in text for text in metadata.values())


@pytest.mark.parametrize(("only", "listed"), [(None, "-0.5"), ("normal", None)])
def test_8_bit_image_has_its_exposure(renderer, mesh, tmp_path, only, listed):
    frame = renderer.render(fr.Scene(mesh), only=only)
    frame.save(tmp_path / "a.png", exposure=-0.5)
    assert read_image(tmp_path / "a.png").metadata.get("exposure") == listed
    frame.save(tmp_path / "a.png")
    assert "exposure" not in read_image(tmp_path / "a.png").metadata


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_files_keep_the_metadata(renderer, mesh, tmp_path, name):
    parts = [
        replace(mesh.parts[0], name="Gesicht für 顔\n"),
        replace(mesh.parts[1], name="b" * 999),
    ]
    frame = renderer.render(fr.Scene(with_geometry(mesh, parts=tuple(parts)), camera="profile"))
    frame.save(tmp_path / name)
    found = read_image(tmp_path / name).metadata
    assert {key: found.get(key) for key in frame.metadata} == frame.metadata
    assert "Gesicht für 顔" in found["m"]
    assert max(map(len, found.values())) < 450


def test_equal_scenes_have_equal_metadata(egl, mesh):
    """Frames drawn earlier have no effect, so that equal jobs of a batch give equal files."""
    found = []
    for earlier in (0, 2):
        with fr.Renderer((16, 16), samples=1, backend=egl) as renderer:
            scene = fr.Scene(fr.load_mesh(MINI_HEAD), environment="studio")
            for _ in range(earlier):
                renderer.render(fr.Scene(mesh))
                renderer.render(scene)
            found.append(renderer.render(scene).encoded("png"))
    assert found[0] == found[1]
