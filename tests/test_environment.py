"""Tests environment maps: rendering against float64 references, files, prices and plans."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import facerender as fr
from facerender import InputError, brdf
from facerender.commands import main
from facerender.images.exr import save_exr
from facerender.planning.candidates import Constants, candidates
from facerender.pricing.table import Prices
from facerender.scenes.environment import SIDE, studio
from facerender.scenes.file import parse_environment
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module

CAMERA = fr.Camera(azimuth=-35.0)


@pytest.fixture(scope="module")
def small(egl):
    with fr.Renderer((64, 64), samples=1, backend=egl) as renderer:
        yield renderer


def spot(azimuth: float, elevation: float, height: int = 64) -> fr.Panorama:
    """Return a black panorama with a spot of 3 x 3 values whose irradiance is pi."""
    radiance = np.zeros((height, 2 * height, 3))
    row = int((0.5 - elevation / 180.0) * height)
    column = int((0.5 - azimuth / 360.0) * 2 * height)
    heights = np.cos(np.pi * np.array([row - 1, row + 2]) / height)
    solid_angle = (heights[0] - heights[1]) * 3.0 * np.pi / height
    radiance[row - 1 : row + 2, column - 1 : column + 2] = np.pi / solid_angle
    return fr.Panorama("spot", radiance)


def around(mesh: fr.Mesh, environment: fr.Environment | None, **others) -> fr.Scene:
    return fr.Scene(
        mesh, CAMERA, **{"lights": (), "ambient": 0.0, **others}, environment=environment
    )


def test_module_is_not_imported_without_an_environment():
    code = "import sys, facerender; print(*(x for x in sys.modules if 'environment' in x))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not found.stdout.strip()


@pytest.mark.slow
def test_small_spot_equals_a_directional_light(small, head):
    """Position, brightness and rotation must agree."""
    wide = head.with_material(m=0.4, normal_map=None, occlusion_map=None)
    light = fr.Light(-50.0, 42.0, shadow=False)
    expected = small.render(around(wide, None, lights=(light,)), only="specular").linear[..., :3]
    for turned, rotation in ((-50.0, 0.0), (10.0, -60.0)):
        environment = fr.Environment(spot(turned, 42.0), rotation)
        shading = fr.Shading(environment_samples=1024)
        seen = small.render(around(wide, environment), shading, only="specular").linear[..., :3]
        assert np.abs(seen - expected).sum() < 0.1 * expected.sum()
        assert seen.sum() == pytest.approx(expected.sum(), rel=0.03)
    both = [small.render(each, only="diffuse").linear for each in (around(wide, environment),)]
    lit = small.render(around(wide, None, lights=(light,)), only="diffuse").linear
    assert np.corrcoef(both[0].ravel(), lit.ravel())[0, 1] > 0.97


@pytest.mark.slow
def test_uniform_environment_shows_the_albedo():
    even = fr.Panorama("even", np.full((8, 16, 3), 0.7))
    n = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(
        brdf.environment_irradiance(even.coefficients, n), 0.7 * np.pi, rtol=2e-3
    )
    np.testing.assert_allclose(even.map[even.map > 0.0], 0.7, rtol=1e-6)
    u = np.random.default_rng(4).random((20_000, 3))
    for m in (0.1, 0.3):
        for v in ((0.0, 0.6, 0.8), (0.0, 0.0, 1.0), (0.8, 0.0, 0.6)):
            seen = brdf.environment_cook_torrance(even.map, SIDE, n, v, m, 0.028, samples=256)
            l = brdf.cook_torrance_sample(n, v, m, u)
            value = brdf.cook_torrance(n, l, v, m, 0.028) * np.maximum(l @ n, 0.0)
            density = brdf.cook_torrance_pdf(n, l, v, m)
            albedo = np.mean(value[density > 0.0] / density[density > 0.0])
            np.testing.assert_allclose(seen, 0.7 * albedo, rtol=0.01)


def test_nine_coefficients_approximate_the_irradiance():
    panorama = studio()
    rows = len(panorama.radiance)
    up = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    turn = np.pi * (1.0 - (np.arange(2 * rows) + 0.5) / rows)
    places = np.cos(up) * np.sin(turn), np.sin(up) + 0.0 * turn, np.cos(up) * np.cos(turn)
    directions = np.stack(places, axis=-1)
    solid_angle = np.cos(up)[..., None] * (np.pi / rows) ** 2
    n = np.random.default_rng(1).normal(size=(100, 3))
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    received = panorama.radiance * solid_angle
    expected = np.array(
        [(received * np.maximum(directions @ x, 0.0)[..., None]).sum((0, 1)) for x in n]
    )
    error = np.abs(brdf.environment_irradiance(panorama.coefficients, n) - expected)
    assert error.mean() < 0.04 * expected.mean()
    assert error.max() < 0.13 * expected.mean()


@pytest.mark.slow
@pytest.mark.parametrize("height", [64, 600])
def test_map_keeps_the_energy_of_a_small_light(height):
    panorama = spot(-50.0, 42.0, height)
    received = np.linalg.norm(panorama.coefficients[1:4], axis=0) * 2.0 / np.pi
    np.testing.assert_allclose(received, 1.0, rtol=0.01)
    place = 2.0 * (np.arange(SIDE) + 0.5) / SIDE - 1.0
    below = np.minimum(1.0 - np.add.outer(np.abs(place), np.abs(place)), 0.0)
    x, z = (np.abs(each) + below for each in np.meshgrid(place, place))
    y = 1.0 - x - z
    distance = np.sqrt(x * x + y * y + z * z)
    sent = (panorama.map[1 : SIDE + 1, 1 : SIDE + 1, 0] * distance**-3).sum() * (2.0 / SIDE) ** 2
    assert sent == pytest.approx(np.pi, rel=0.03)


def test_32_samples_are_close_to_1024(small, head):
    scene = around(head, fr.Environment(studio(), 120.0))
    few, many = (
        small.render(scene, fr.Shading(environment_samples=count)).linear[..., :3]
        for count in (32, 1024)
    )
    inside = small.gbuffer(scene).part >= 0
    error = np.abs(few - many)[inside].sum() / many[inside].sum()
    assert 0.0 < error <= 0.01


# --- files and settings --------------------------------------------------------------------------


def test_files_are_read(tmp_path):
    oiio = require_module("OpenImageIO")
    radiance = np.random.default_rng(2).uniform(0.0, 3.0, (8, 16, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", radiance)
    save_exr(tmp_path / "a.exr", radiance, {})
    file = oiio.ImageOutput.create(str(tmp_path / "a.hdr"))
    file.open(str(tmp_path / "a.hdr"), oiio.ImageSpec(16, 8, 3, oiio.FLOAT))
    file.write_image(radiance)
    file.close()
    for name, error in (("a.npy", 0.0), ("a.exr", 0.0), ("a.hdr", 0.02)):
        asked = fr.EnvironmentFile(str(tmp_path / name), 30.0, 2.0)
        environment = fr.load_environment(asked)
        assert (environment.rotation, environment.scale) == (30.0, 2.0)
        np.testing.assert_allclose(environment.panorama.radiance, radiance, atol=error)


def test_a_file_is_read_once_until_it_changes(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.ones((4, 8, 3)))
    first = fr.load_environment(fr.EnvironmentFile(str(path)))
    turned = fr.load_environment(fr.EnvironmentFile(str(path), 30.0, 2.0))
    assert turned.panorama is first.panorama
    np.save(path, np.full((4, 8, 3), 2.0))
    os.utime(path, ns=(1, 1))
    assert fr.load_environment(fr.EnvironmentFile(str(path))).panorama.radiance.max() == 2.0


def faulty(folder, name):
    radiance = np.ones((4, 8, 3), dtype=np.float32)
    if name == "shape.npy":
        radiance = radiance[:, :7]
    elif name == "grey.npy":
        radiance = radiance[..., :1]
    elif name.startswith(("nan", "negative", "huge")):
        radiance[2, 5, 1] = {"nan.npy": np.nan, "negative.npy": -1.0, "huge.npy": 2e9}[name]
    elif name == "bytes.npy":
        radiance = radiance.astype(np.uint8)
    if name == "damaged.hdr":
        (folder / name).write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n\x02")
    elif name not in ("missing.hdr", "other.jpg"):
        np.save(folder / name, radiance)
    return str(folder / name)


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.hdr", "cannot read .*missing.hdr: no such file"),
        ("damaged.hdr", "OpenImageIO cannot read .*damaged.hdr .*write the file again"),
        ("other.jpg", "unknown environment format '.jpg'; give .hdr, .exr, .npy or .npz"),
        ("shape.npy", "has 7 x 4 x 3 values: give an RGB image, twice as wide as"),
        ("grey.npy", "has 8 x 4 x 1 values"),
        ("bytes.npy", "holds 8-bit values"),
        ("nan.npy", r"radiance \[1.0, nan, 1.0\] in column 5 of row 2: give numbers"),
        ("negative.npy", r"radiance \[1.0, -1.0, 1.0\] in column 5 of row 2"),
        ("huge.npy", r"radiance .* in column 5 of row 2: give numbers in \[0, 1e\+09\]"),
        ("studio,a", "'studio,a': give FILE.,ROTATION.,SCALE"),
        ("studio,1,2,3", "give FILE"),
        ("studio,0,-1", r"environment scale = -1.0 is outside \[0, 1e\+09\]"),
        ("studio,nan", r"environment rotation = nan is outside \[-3600, 3600\]"),
    ],
)
def test_invalid_environments_print_one_line(tmp_path, capsys, name, message):
    require_module("OpenImageIO")
    given = name if name.startswith("studio") else faulty(tmp_path, name)
    if name == "other.jpg":
        (tmp_path / name).touch()
    output = tmp_path / "out.png"
    code = main(["render", "--environment", given, "-o", str(output), "--size", "16"])
    printed = capsys.readouterr()
    assert code == 2
    assert not printed.out
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("facerender: error: ")
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(printed.err)
    assert not output.exists()


@pytest.mark.parametrize("count", [-2, 3, 4098, 32.0, True])
def test_invalid_sample_counts_are_refused(count):
    with pytest.raises(InputError, match="environment_samples = .*: give an even number up to"):
        fr.Shading(environment_samples=count)


def test_model_without_environment_term_is_refused(small, head):
    scene = around(head, fr.Environment(studio()))
    with pytest.raises(InputError, match="ward-printed has no specular term for environment maps"):
        small.render(scene, fr.Shading("ward-printed"))
    small.render(scene, fr.Shading("ward-printed", environment_samples=0))


def test_scene_file_and_command_line(tmp_path):
    asked = fr.EnvironmentFile("studio", 20.0, 0.5)
    file = tmp_path / "scene.toml"
    file.write_text('environment = "studio,20,0.5"\n')
    assert fr.load_scene(file)["environment"] == asked == parse_environment("studio,20,0.5")
    outputs = [str(tmp_path / name) for name in ("a.png", "b.png")]
    own = ["render", str(MINI_HEAD), "--size", "16", "--samples", "1"]
    assert main([*own, "--scene", str(file), "-o", outputs[0]]) == 0
    assert main([*own, "--environment", "studio,20,0.5", "-o", outputs[1]]) == 0
    first, second = (Path(each).read_bytes() for each in outputs)
    assert first == second


# --- plans ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_plan_may_take_fewer_samples(small, head):
    scene = around(head, fr.Environment(studio()))
    listed = [*candidates(scene, fr.Shading(), Constants(0.3, 1.0, ()))]
    assert {each.environment_samples for each in listed} == {0, 8, 16, 32}
    plain = [*candidates(around(head, None), fr.Shading(), Constants(0.3, 1.0, ()))]
    assert {each.environment_samples for each in plain} == {32}
    parts = {"base program": 1.0, "albedo map": 10.0, "normal map": 100.0, "property map": 1e3}
    parts |= {"environment": 1e4, "environment sample": 1e5, "ambient term": 1e6}
    table = Prices("by hand", "beans", parts, {})
    two = around(head.with_material(second_slope=2.0, lobe_weight=0.5), fr.Environment(studio()))
    for shading, own, total in (
        (fr.Shading(), scene, 11111.0 + 32e5),
        (fr.Shading(environment_samples=8), scene, 11111.0 + 8e5),
        (fr.Shading(environment_samples=0), scene, 11111.0),
        (fr.Shading(environment=False), scene, 111.0),
        (fr.Shading(), two, 11111.0 + 64e5),
        (fr.Shading(ks=0.0), scene, 11111.0),
    ):
        assert table.cost(own, shading)[0] == pytest.approx(total)
