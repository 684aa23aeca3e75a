"""Tests environment maps and subsurface scattering: rendering against float64 references, closed
forms and the integral of the profile over the mesh, files, prices and plans."""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import facerender as fr
from benchmarks.skin_environment import panorama_directions
from facerender import InputError, brdf
from facerender.commands import main
from facerender.images.files import read_image, save_exr
from facerender.images.image import linear_to_srgb
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part
from facerender.planning.candidates import Constants, candidates
from facerender.pricing.table import Prices, load_prices
from facerender.scene.environment import SIDE, studio
from facerender.scene.scattering import scattering_of
from facerender.scene.view import view_of
from facerender.terms.transport import PROFILES, scatter_profile, spiral
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module
from tests.meshes import with_geometry
from tests.settings import parse_environment
from tests.test_reference import skin
from tests.verification.environment import Traced, overcast
from tests.verification.scattering import SUBJECTS, scatter_errors

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


@pytest.mark.slow
def test_small_spot_equals_a_directional_light(small, head):
    """Position, brightness and rotation must agree."""
    wide = head.with_material(m=0.4, normal_map=None, occlusion_map=None)
    light = fr.Light(-50.0, 42.0, shadow=False)
    expected = small.render(around(wide, None, lights=(light,)), only="specular").linear[..., :3]
    for turned, rotation in ((-50.0, 0.0), (10.0, -60.0)):
        environment = fr.Environment(spot(turned, 42.0), rotation)
        shading = fr.Shading(environment_samples=1024, environment_lights=0)
        seen = small.render(around(wide, environment), shading, only="specular").linear[..., :3]
        assert np.abs(seen - expected).sum() < 0.1 * expected.sum()
        assert seen.sum() == pytest.approx(expected.sum(), rel=0.03)
    scene = around(wide, environment)
    both = [small.render(scene, shading, only="diffuse").linear]
    lit = small.render(around(wide, None, lights=(light,)), only="diffuse").linear
    assert np.corrcoef(both[0].ravel(), lit.ravel())[0, 1] > 0.97


@pytest.mark.parametrize(
    ("column", "rotation", "side"),
    [(16, 0.0, "x"), (48, 0.0, "-x"), (32, 90.0, "x"), (32, 0.0, "z"), (0, 180.0, "z")],
)
def test_a_bright_column_lights_the_side_of_its_direction(egl, column, rotation, side):
    """The middle of 64 columns is +z. Columns to its left are +x: the left side of the face, on the
    right in an image from the front. A rotation moves the map to the left."""
    radiance = np.full((32, 64, 3), 0.05, np.float32)
    radiance[:, np.arange(column - 3, column + 3)] = 3.0
    environment = fr.Environment(fr.Panorama("column", radiance), rotation)
    ball = trimesh.creation.icosphere(subdivisions=3)
    mesh = fr.Mesh.from_arrays(ball.vertices, ball.faces).with_material(m=0.2, f0=0.5)
    with fr.Renderer((64, 64), samples=1, backend=egl) as renderer:
        scene = fr.Scene(mesh, lights=(), ambient=0.0, environment=environment, background=None)
        light = renderer.render(scene).linear[..., :3].sum(axis=(0, 2))
    left, middle, right = light[:21].sum(), light[21:43].sum(), light[43:].sum()
    brightest = {"x": right, "-x": left, "z": middle}[side]
    assert brightest > 1.2 * max({left, middle, right} - {brightest})


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
    assert re.search(message, printed.err)
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
def test_the_price_depends_on_the_samples(small, head):
    scene = around(head, fr.Environment(studio()))
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
        shading = shading.replace(environment_lights=0)
        assert table.cost(own, shading)[0] == pytest.approx(total)


# --- scattering -----------------------------------------------------------------------------------


OFF = fr.Shading(scatter_samples=0)


@pytest.fixture(scope="module")
def renderer(egl):
    with fr.Renderer((160, 160), samples=1, backend=egl, float_albedo=True) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def face(head) -> fr.Scene:
    return skin(head)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["head", "scan_mesh"])
def test_errors_against_the_integral_over_the_mesh(egl, name, request):
    """For more pixels, run ``python -m benchmarks.skin_scattering``."""
    mesh = request.getfixturevalue(name)
    few = (0, 16, 32)
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        scale, errors = scatter_errors(renderer, *SUBJECTS[name](mesh), few, 400)
    none, sixteen, more = (error.p99 for error in errors)
    assert scale == pytest.approx(1.8, abs=0.05)
    assert sixteen <= 13.0
    assert more <= 10.0
    assert none > 2.0 * sixteen


def test_diffuse_and_specular_views_add_up(renderer, face):
    whole, diffuse, shine = (
        renderer.render(face, only=each).linear for each in (None, "diffuse", "specular")
    )
    np.testing.assert_allclose((diffuse + shine)[..., :3], whole[..., :3], atol=1e-6)
    np.testing.assert_array_equal(renderer.render(face, OFF, "specular").linear, shine)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("deferred", "background"),
    [(True, (0.3, 0.2, 0.1)), pytest.param(False, None, marks=pytest.mark.slow)],
)
def test_several_samples_keep_the_coverage(egl, face, deferred, background, monkeypatch):
    """Inside a surface, scattering changes a pixel equally for each number of samples. A silhouette
    pixel whose centre is not covered uses a neighbour's change, with a mean error below 1 %."""
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred)
    mesh = fr.load_mesh(MINI_HEAD).with_material(scattering="skin")
    scene = replace(face, mesh=mesh, background=background, camera=fr.Camera(-35.0, zoom=1.3))
    with fr.Renderer((96, 96), samples=4, backend=egl, float_albedo=True) as renderer:
        image, plain = renderer.render(scene).linear, renderer.render(scene, OFF).linear
        one, one_plain = (
            renderer.render(scene, each, samples=1).linear for each in (fr.Shading(), OFF)
        )
        fine, fine_plain = (
            renderer.render(scene, each, samples=16).linear for each in (fr.Shading(), OFF)
        )
    np.testing.assert_array_equal(image[..., 3], plain[..., 3])
    assert (image[plain[..., 3] == 0.0] == plain[plain[..., 3] == 0.0]).all()
    change, single = (image - plain)[..., :3], (one - one_plain)[..., :3]
    seen = (plain[..., 3] == 1.0) & (one[..., 3] == 1.0)
    np.testing.assert_allclose(change[seen], single[seen], atol=2e-6)
    edge = (plain[..., 3] > 0.0) & (plain[..., 3] < 1.0)
    expected = (fine - fine_plain)[..., :3]
    assert edge.sum() > 100
    assert np.abs(change - expected)[edge].mean() < 0.01 * fine[edge][:, :3].mean()
    outside = edge & (one[..., 3] == 0.0)
    assert change[outside].any(axis=-1).mean() > 0.9
    shown = [
        linear_to_srgb(each[edge, :3].astype(float)) for each in (image, fine, plain, fine_plain)
    ]
    worst = [np.quantile(np.abs(a - b), 0.99) for a, b in (shown[:2], shown[2:])]
    assert worst[0] < 1.15 * worst[1]


def wall(*squares: tuple[float, float, float, fr.Material]) -> fr.Mesh:
    """Return squares of 60 mm at (x, y, z) in mm; each is a separate part."""
    corners = np.array(
        [(-30.0, -30.0, 0.0), (30.0, -30.0, 0.0), (30.0, 30.0, 0.0), (-30.0, 30.0, 0.0)]
    )
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    up = np.tile((0.0, 0.0, 1.0), (4, 1))
    parts = tuple(Part(corners + place, up, faces) for *place, _ in squares)
    materials = tuple(material for *_, material in squares)
    bounds = np.array([(-100.0, -100.0, -100.0), (100.0, 100.0, 100.0)])
    return fr.Mesh(Geometry("wall", parts, bounds, 174.0, np.array([(0.5, 0.5)]), 1.0), materials)


def of_wall(mesh: fr.Mesh, **changes: object) -> fr.Scene:
    camera = fr.Camera(position=(0.0, 0.0, 400.0), target=(0.0, 0.0, 0.0), fov=14.0)
    lights = (fr.Light(-40.0, 0.0, 2.0), fr.Light(30.0, 30.0, (0.5, 0.2, 0.1)))
    return replace(fr.Scene(mesh, camera, lights, ambient=0.2), **changes)


def test_uniform_light_stays_uniform(renderer):
    skin = fr.Material(scattering="skin", ks=0.0)
    scene = of_wall(wall((0.0, 0.0, 0.0, skin)))
    plain = renderer.render(scene, OFF).linear
    np.testing.assert_allclose(renderer.render(scene).linear, plain, rtol=2e-6)


def test_edge_of_light_agrees_with_the_profile(egl):
    """Normals tilt to the light for x < 0 and away from it for x > 0; N.V is equal everywhere."""
    lean = np.array([(-0.6, 0.0, 0.8), (0.6, 0.0, 0.8)])
    sides = wall((-30.0, 0.0, 0.0, fr.Material()), (30.0, 0.0, 0.0, fr.Material())).parts
    both = Part(
        np.concatenate([side.positions for side in sides]),
        np.repeat(lean, 4, axis=0),
        np.concatenate([sides[0].faces, sides[1].faces + 4]),
    )
    skin = fr.Material((1.0, 1.0, 1.0), scattering="skin", ks=0.0)
    light = fr.Light(-90.0, 0.0, np.pi / 0.6)
    mesh = with_geometry(wall((0.0, 0.0, 0.0, skin)), parts=(both,))
    scene = of_wall(mesh, lights=(light,), ambient=0.0)
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        found = scattering_of(scene, view_of(scene, 1.0), renderer.size)
        image = renderer.render(scene, fr.Shading(scatter_samples=64)).linear
        x = renderer.gbuffer(scene).position[256, :, 0]
    seen = np.abs(x) < 12.0
    columns = image[128:384, seen, :3].mean(axis=0)
    expected = np.zeros_like(columns)
    wide = found.profiles[0]
    for variance, *weights in PROFILES["skin"]:
        lit = [0.5 * math.erfc(each / math.sqrt(2.0 * variance)) for each in x[seen]]
        if (variance, *weights) not in wide:
            lit = x[seen] < 0.0
        expected += np.outer(lit, weights)
    assert np.abs(columns - expected).mean() < 0.004
    assert np.abs(columns - expected).max() < 0.04


def test_other_parts_and_distant_surfaces_do_not_bleed(renderer):
    skin, wax = fr.Material(scattering="skin"), fr.Material(scattering=((3.0, 0.8, 0.8, 0.8),))
    stone = fr.Material(albedo=(0.9, 0.9, 0.9))
    places = ((-30.0, 0.0, 0.0), (31.0, 0.0, 0.0), (10.0, 0.0, -80.0), (0.0, 40.0, 0.0))
    parts = [(*place, each) for place, each in zip(places, (skin, wax, skin, stone), strict=True)]
    tilted = np.tile((0.6, 0.0, 0.8), (4, 1))  # its irradiance differs from its neighbours'

    def mesh(*which: int) -> fr.Mesh:
        made = wall(*(parts[i] for i in which))
        lean = [i % 2 for i in which]
        turned = zip(made.parts, lean, strict=True)
        return with_geometry(
            made, parts=tuple(replace(p, normals=tilted) if on else p for p, on in turned)
        )

    together = renderer.render(of_wall(mesh(0, 1, 2, 3)))
    part = renderer.gbuffer(of_wall(mesh(0, 1, 2, 3))).part
    plain = renderer.render(of_wall(mesh(0, 1, 2, 3)), OFF)
    np.testing.assert_array_equal(together.linear[part == 3], plain.linear[part == 3])
    for index in (0, 1):
        alone = renderer.render(of_wall(mesh(index)))
        seen = (
            (part == index) & (np.roll(part, 40, axis=0) != 3) & (np.roll(part, -40, axis=0) != 3)
        )
        assert seen.sum() > 1000
        np.testing.assert_allclose(together.linear[seen], alone.linear[seen], rtol=1e-5)


def test_unresolved_scattering_is_skipped(renderer, head):
    scene = fr.Scene(head.with_material(scattering="skin"), fr.Camera(zoom=0.05))
    assert scattering_of(scene, view_of(scene, 1.0), renderer.size) is None
    np.testing.assert_array_equal(renderer.render(scene).linear, renderer.render(scene, OFF).linear)


def test_scattering_needs_the_size_of_the_mesh(head, renderer, tmp_path, mini_obj):
    assert head.millimetres == 1000.0
    mesh = fr.load_mesh(mini_obj)
    assert mesh.millimetres is None
    with pytest.raises(
        fr.InputError, match=r"needs the size of head.obj, .*: --millimetres .* is a guess"
    ):
        renderer.render(fr.Scene(mesh.with_material(scattering="skin")))
    assert fr.load_mesh(mini_obj, millimetres=2.0).millimetres == 2.0
    assert fr.MeshFile(str(mini_obj), millimetres=2.0).load().millimetres == 2.0
    for size in (0.0, -1.0, math.nan, "1"):
        with pytest.raises(fr.InputError, match="millimetres = .*: give a"):
            fr.load_mesh(mini_obj, millimetres=size)
    large = with_geometry(head, millimetres=1e5).with_material(scattering="skin")
    with pytest.warns(fr.FacerenderWarning, match=r"give --millimetres 1000 \(m\) for an eye dist"):
        renderer.render(fr.Scene(large))


@pytest.fixture
def mini_obj(tmp_path):
    path = tmp_path / "head.obj"
    path.write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nv 2 2 0\nf 1 2 3\nf 2 4 3\n")
    return path


def test_profiles(head):
    for given, message in (
        ("wax", "unknown scattering 'wax'; known: skin, none"),
        ([(0.0, 1.0, 1.0, 1.0)], "give a name, or 1 to 16 Gaussians"),
        ([(1.0, 0.5)], "give a name, or 1 to 16 Gaussians"),
        ([], "give a name, or 1 to 16 Gaussians"),
        (3, "give a name, or 1 to 16 Gaussians"),
        ([(1.0, 0.6, 0.1, 0.1), (2.0, 0.6, 0.1, 0.1)], "sum in each channel is at most 1"),
        ([(1.0, -0.1, 0.1, 0.1)], "weights of at least 0"),
        ([(math.nan, 0.1, 0.1, 0.1)], "give a name, or 1 to 16 Gaussians"),
    ):
        with pytest.raises(fr.InputError, match=message):
            fr.Material(scattering=given)
    assert fr.Material(scattering="none").scattering is None
    radius = np.linspace(0.0, 30.0, 60001)
    whole = np.trapezoid(
        scatter_profile(radius**2, PROFILES["skin"]).T * 2 * np.pi * radius, radius
    )
    np.testing.assert_allclose(whole, 1.0, atol=2e-3)
    places = spiral(PROFILES["skin"], 64)
    assert np.isfinite(places).all()
    assert (np.diff(np.hypot(*places.T[:2])) > 0.0).all()


def test_plans_may_use_fewer_samples(head, face):
    for scene, full, expected in (
        (face, fr.Shading(), {0, 8, 16}),
        (face, fr.Shading(scatter_samples=8), {0, 8}),
        (replace(face, mesh=head), fr.Shading(), {16}),
    ):
        found = candidates(scene, full, Constants(0.3, 1.0, ()))
        assert {shading.scatter_samples for shading in found} == expected
    unshadowed = replace(face, lights=(fr.Light(),))
    prices = load_prices("navi21", unshadowed, [OFF])
    costs = [prices.cost(unshadowed, fr.Shading(scatter_samples=n))[0] for n in (0, 8, 16, 64)]
    assert costs == sorted(costs)
    assert costs[1] < costs[2] < costs[3]


def covered_error(renderer, head, panorama, count=768):
    scene = fr.Scene(head, fr.Camera(frame="face"), (), 0.0, environment=fr.Environment(studio()))
    traced, environment = Traced(renderer, scene, count), fr.Environment(panorama, 20.0, 0.8)
    expected = traced.radiance(environment, fr.Shading())
    return [
        traced.error(environment, fr.Shading(environment_lights=count), expected)
        for count in (0, 8)
    ]


@pytest.mark.parametrize(
    "panorama", [studio(), pytest.param(overcast(), marks=pytest.mark.slow)], ids=repr
)
def test_lights_of_the_environment_halve_the_error_against_rays(egl, head, panorama):
    """Without lights, the environment shines into the mouth, the lids and the nostrils."""
    with fr.Renderer(128, samples=1, backend=egl, float_albedo=True) as renderer:
        without, with_lights = covered_error(renderer, head, panorama)
    assert without.crease_high > 50.0
    for name in ("mean", "high", "crease_mean", "crease_high"):
        assert getattr(with_lights, name) <= 0.5 * getattr(without, name), name


def test_surfaces_that_no_light_of_the_environment_faces_are_not_black(egl, head):
    """Below the jaw, all lights are behind the surface, which faces the dim floor of the studio."""
    with fr.Renderer(128, samples=1, backend=egl, float_albedo=True) as renderer:
        scene = fr.Scene(head, "three-quarter", (), 0.0, environment="studio,40")
        traced = Traced(renderer, scene, 768)
        assert scene.environment is not None
        expected = traced.radiance(scene.environment, fr.Shading())[traced.covered]
        image = renderer.render(scene).linear[traced.covered][:, :3]
    assert (image < 0.3 * expected - 0.002).any(axis=-1).sum() <= 3


def test_a_sun_becomes_a_light_of_its_size():
    """The sun of 2 degrees is one light, apart from its sky; the sum of all lights and of the
    remainder is the energy of the panorama."""
    light = fr.Light(azimuth=-40.0, elevation=50.0)
    from_sun = panorama_directions(256) @ light.direction
    radiance = np.where(from_sun[..., None] > math.cos(math.radians(2.0)), 500.0, 0.2)
    panorama = fr.Panorama("sun", np.broadcast_to(radiance, (256, 512, 3)))
    lights = fr.Environment(panorama, rotation=30.0, scale=2.0).lights(8)
    sun = max(lights, key=lambda each: each.irradiance[0])
    assert (sun.azimuth, sun.elevation) == pytest.approx((-10.0, 50.0), abs=0.2)
    assert sun.radius == pytest.approx(2.0, abs=0.4)  # the sky within 20 degrees is a tenth of it
    split = panorama.lights(8)
    total = (split.irradiance + split.around).sum(axis=0)
    assert total == pytest.approx(4.0 * panorama.coefficients[0], rel=1e-3)
    assert sun.irradiance == pytest.approx(tuple(2.0 * split.irradiance.max(axis=0)))


@pytest.mark.parametrize("height", [2, 3, 50])
@pytest.mark.parametrize("value", [0.0, 1.0, 1e9])
def test_every_panorama_has_lights(height, value):
    radiance = np.full((height, 2 * height, 3), value, dtype=np.float32)
    lights = fr.Environment(fr.Panorama("even", radiance)).lights(16)
    assert len(lights) == min(16, 2 * height**2)
    assert np.isfinite([(*light.irradiance, light.radius, light.azimuth) for light in lights]).all()


def test_too_many_shadows_name_the_lights_of_the_environment(small, head):
    lights = [fr.Light(azimuth=float(angle)) for angle in range(9)]
    with pytest.raises(InputError, match="17 lights cast shadows, including 8 of the environment"):
        small.render(around(head, fr.Environment(studio()), lights=lights))


def test_data_images_do_not_depend_on_the_environment(small, head):
    scene = around(head, fr.Environment(studio()), lights=(fr.Light(30.0, 20.0),))
    for name in ("visibility", "cosines", "depth"):
        bare = small.render(replace(scene, environment=None), only=name)
        assert np.array_equal(small.render(scene, only=name).linear, bare.linear), name


def test_no_shadows_of_the_command_line_include_the_environment(tmp_path):
    images = []
    for options in (["--no-shadows"], ["--environment-lights", "0"], ["--shadows"]):
        file = str(tmp_path / f"{len(images)}.exr")
        scene = ["--environment", "studio", "--size", "48", "--frame", "face"]
        assert main(["render", *scene, *options, "-o", file]) == 0
        images.append(read_image(file).pixels)
    assert np.array_equal(images[0], images[1])
    assert not np.allclose(images[0], images[2], atol=0.01)
