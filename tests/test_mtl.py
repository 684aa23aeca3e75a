"""Tests MTL files: the materials and maps that their statements define, and warnings."""

from __future__ import annotations

import math
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.loading.mtl import DEPTH
from tests import awkward_files as files
from tests.awkward_files import flat, mini_head, texels
from tests.test_hostile_mesh import loaded
from tests.verification.fuzz.seeds import octahedron


def load(folder, mtl, head=octahedron(), **images):
    """Load a mesh with an MTL file for the material skin; ``images`` are saved as PNG files."""
    for name, image in images.items():
        image.save(folder / f"{name}.png")
    (folder / "a.mtl").write_text(f"newmtl skin\n{mtl}\n")
    return loaded(files.write_obj(folder / "a.obj", head, mtl="a.mtl"))


def material(folder, mtl, **images):
    """Load an MTL file without warnings, and return the material."""
    mesh, messages = load(folder, mtl, **images)
    assert messages == []
    return mesh.materials[0]


@pytest.mark.parametrize(("encoding", "name"), [("utf-8-sig", "größe"), ("cp1252", "größe…")])
def test_names_beyond_ascii(encoding, name, tmp_path):
    """Neither OBJ nor MTL files state their encoding."""
    Image.new("RGB", (2, 2), "red").save(tmp_path / f"{name}.png")
    path = files.write_obj(tmp_path / "a.obj", octahedron(), mtl=f"{name}.mtl")
    text = f"newmtl skin\nmap_Kd {name}.png\n"
    (tmp_path / f"{name}.mtl").write_bytes(text.encode(encoding))
    path.write_bytes(path.read_text("utf-8").encode(encoding))
    mesh, messages = loaded(path)
    assert messages == []
    assert (texels(mesh.materials[0].albedo_map) == (255, 0, 0)).all()


def test_factors(tmp_path):
    found = material(tmp_path, "Kd 0.5 0.5 0.5\nKs 0.4 0.2 0.3\nNs 30\nKe 1 0 0\nd 0.25\nillum 2")
    assert found.albedo == pytest.approx((0.2140411,) * 3)
    assert found.ks == pytest.approx(0.3)
    assert found.m == pytest.approx(0.25)  # sqrt(2 / 32)
    assert found.emissive == (1.0, 0.0, 0.0)
    assert (found.alpha, found.opacity) == ("blend", 0.25)
    assert material(tmp_path, "Pr 0.5\nNs 30").m == 0.25
    assert material(tmp_path, "Tr 0.75").opacity == 0.25
    assert material(tmp_path, "d 0.5\nTr 0.9").opacity == 0.5
    assert material(tmp_path, "d -halo 0.5").opacity == 0.5
    assert material(tmp_path, "Ks 1 1 1\nNs 0").m == fr.Material().m


def test_unsupported_statements_warn(tmp_path):
    for mtl, message in (
        ("Tr 1", "Tr 1 in its MTL"),
        ("Tf 0.5 0.5 0.5", "Tf"),
        ("refl sphere.png", "has refl in its MTL: ignored"),
        ("disp deep.png", "has disp in its MTL: ignored"),
        ("Pm 1", "has pm in its MTL: ignored"),
        ("map_Ns x.png", "has map_ns in its MTL: ignored"),
        ("Kd spectral file.rfl", "has kd spectral file.rfl in its MTL: ignored"),
        ("d nan", "has d nan in its MTL: ignored"),
        ("Kd 2 0 0", "kd 2 in the MTL of a.obj is outside [0, 1]: clamped"),
        ("map_Kd -cc on skin.png", "the albedo map of a.obj has the option -cc: ignored"),
        ("map_Kd -t 1 1 1 skin.png", "the albedo map of a.obj has the option -t: ignored"),
    ):
        messages = load(tmp_path, mtl, skin=flat(1, 2, 3))[1]
        assert len(messages) == 1, mtl
        assert message in messages[0]
    for mtl in ("Pm 0\nNi 1.5\nTf 1 1 1\nKa 0 0 0", "map_Kd -mm 0 1 -cc off skin.png"):
        material(tmp_path, mtl)


def test_maps_and_the_options_before_their_names(tmp_path):
    mtl = """map_Kd -s 2 3 1 -o 0.5 -clamp on my skin.png
map_d cut.png
map_Ks -imfchan g shine.png
map_Ke -s 2 3 -o 0.5 0 glow.png
map_Pr rough.png
norm -bm 0.5 normal.png"""
    images = {"my skin": flat(1, 2, 3), "cut": flat(9, 9, 9, 60), "shine": flat(1, 77, 3)}
    images |= {"glow": flat(4, 5, 6), "rough": flat(128), "normal": flat(128, 128, 255)}
    mesh, messages = load(tmp_path, mtl, **images)
    assert len(messages) == 4
    assert messages[0].startswith(
        "cut.png (named by a.obj) has other options -s and -o than my skin"
    )
    found, part = mesh.materials[0], mesh.parts[0]
    assert found.albedo_map.sampling == (("clamp", "clamp"), False)
    for name, value in (
        ("albedo", [1, 2, 3]),
        ("opacity", 60),
        ("specular", 77),
        ("emissive", [4, 5, 6]),
        ("roughness", 128),
        ("normal", [128, 128, 255]),
    ):
        assert (texels(getattr(found, f"{name}_map")) == value).all(), name
    assert (found.alpha, found.alpha_cutoff, found.normal_strength) == ("mask", 0.5, 0.5)
    assert found.emissive == (1.0, 1.0, 1.0)
    assert (found.second_uv, part.uv2) == ((), None)
    plain = load(tmp_path, "map_Kd cut.png")[0].parts[0].uv
    np.testing.assert_allclose(part.uv, plain * (2, 3) + (0.5, 0))


def test_opacity_map_without_alpha_uses_its_grey(tmp_path):
    assert (texels(material(tmp_path, "map_d cut.png", cut=flat(60)).opacity_map) == 60).all()


def waves(mode):
    """Return a height map: a sine with eight periods along u, from 0 to the maximum."""
    u = (np.arange(256) + 0.5) / 256
    heights = np.tile(0.5 + 0.5 * np.sin(2 * np.pi * 8 * u), (64, 1))
    if mode == "16 bits":
        return Image.fromarray(np.round(heights * 65535).astype(np.uint16))
    return Image.fromarray(np.round(heights * 255).astype(np.uint8)).convert(mode)


@pytest.mark.parametrize("mode", ["L", "RGB", "16 bits"])
@pytest.mark.parametrize("key", ["map_Bump", "bump"])
def test_heights_become_normals(key, mode, tmp_path):
    """The slope is the derivative of the sine; the multiplier becomes the material's strength."""
    found = material(tmp_path, f"{key} -bm 3 wave.png", wave=waves(mode))
    assert found.normal_strength == 3.0
    normals = texels(found.normal_map) / 127.5 - 1.0
    u = (np.arange(256) + 0.5) / 256
    expected = -np.pi * 8 * np.cos(2 * np.pi * 8 * u) * DEPTH
    slopes = -(normals[..., 0] / normals[..., 2])[32, 1:-1]
    np.testing.assert_allclose(slopes, -expected[1:-1], atol=0.02)
    np.testing.assert_allclose(normals[..., 1], 0.0, atol=0.01)


def test_green_is_up(tmp_path):
    """If the height grows upwards, the normal tilts down."""
    ramp = Image.new("L", (8, 64))
    ramp.paste(255, (0, 0, 8, 32))
    normals = texels(material(tmp_path, "bump ramp.png", ramp=ramp).normal_map)
    assert normals[..., 1].max() <= 128
    assert (normals[31:33, :, 1] < 120).all()


def test_a_bump_map_may_be_a_normal_map(tmp_path):
    """MakeHuman writes normal maps as map_Bump; they are detected by their colours."""
    slopes = np.random.default_rng(0).normal(0.0, 0.2, (32, 32, 2))
    unit = np.concatenate([slopes, np.ones((32, 32, 1))], axis=-1)
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    image = Image.fromarray(np.round(unit * 127.5 + 127.5).astype(np.uint8))
    found = material(tmp_path, "map_Bump normal.png", normal=image)
    np.testing.assert_array_equal(texels(found.normal_map), np.asarray(image)[::-1])


def test_a_udim_tile_on_several_tiles_causes_a_warning(tmp_path):
    head = mini_head()
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "skin.1001.png")
    (tmp_path / "a.mtl").write_text("newmtl skin\nmap_Kd skin.1001.png\n")
    for width, tiles in ((0.999, 1), (1.999, 2)):
        wide = replace(head, uv=np.clip(head.uv, 0.0, 1.0) * (width, 0.999))
        messages = loaded(files.write_obj(tmp_path / "a.obj", wide, mtl="a.mtl"))[1]
        assert ["drawn on all 2 tiles" in each for each in messages] == [True] * (tiles - 1)


def test_libraries_of_several_names(tmp_path):
    head = mini_head()
    (tmp_path / "a.mtl").write_text("newmtl skin\nd 0.5\n")
    (tmp_path / "b.mtl").write_text("newmtl scalp\nd 0.25\n")
    groups = {"skin": head.upper, "scalp": ~head.upper}
    path = files.write_obj(tmp_path / "a.obj", head, mtl="a.mtl b.mtl", groups=groups)
    mesh, messages = loaded(path)
    assert messages == []
    assert sorted(each.opacity for each in mesh.materials) == [0.25, 0.5]


def test_damaged_bump_map_is_refused(tmp_path):
    buffer = BytesIO()
    waves("RGB").save(buffer, "PNG")
    (tmp_path / "wave.png").write_bytes(buffer.getvalue()[:-60])
    (tmp_path / "a.mtl").write_text("newmtl skin\nbump wave.png\n")
    mesh, _ = loaded(files.write_obj(tmp_path / "a.obj", octahedron(), mtl="a.mtl"))
    with pytest.raises(fr.InputError, match=r"wave\.png is damaged"):
        mesh.materials[0].normal_map.rgb()


def test_hostile_statements(tmp_path):
    """Invalid statements cause no exception."""
    for mtl in ("map_Kd", "map_Kd -s", "bump -bm", "Ns inf", "Ke 1e308 0 0", "d 1e400", "Ks -1"):
        mesh, _ = load(tmp_path, mtl)
        assert math.isfinite(mesh.materials[0].m)
