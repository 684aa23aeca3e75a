"""Tests subsurface scattering: against the integral of the profile over the mesh, closed forms and
float64, with several samples and parts, and absent if no material scatters."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.images.srgb import linear_to_srgb
from facerender.planning.candidates import Constants, candidates
from facerender.pricing.table import load_prices
from facerender.scenes.mesh import Part
from facerender.scenes.scattering import scattering_of
from facerender.terms.scattering import PROFILES, scatter_profile, spiral, wide_gaussians
from tests.awkward_files import MINI_HEAD
from tests.test_reference import skin
from tests.verification.scattering import SUBJECTS, scatter_errors

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


@pytest.mark.parametrize("variance", [0.0064, 0.567, 7.41])
def test_narrow_gaussians_are_not_scattered(variance):
    deviation = math.sqrt(variance)
    for factor, wide in ((1.99, True), (2.01, False)):
        found = wide_gaussians("skin", factor * deviation)
        assert (variance in {each[0] for each in found}) == wide


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
    monkeypatch.setattr("facerender.drawing.renderer.deferred_is_cheaper", lambda *_: deferred)
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
    return fr.Mesh("wall", parts, materials, bounds, 174.0, np.array([(0.5, 0.5)]), 1.0)


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
    mesh = replace(wall((0.0, 0.0, 0.0, skin)), parts=(both,))
    scene = of_wall(mesh, lights=(light,), ambient=0.0)
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        found = scattering_of(scene, renderer.size)
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
        return replace(
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
    assert scattering_of(scene, renderer.size) is None
    np.testing.assert_array_equal(renderer.render(scene).linear, renderer.render(scene, OFF).linear)


@pytest.mark.slow
def test_module_is_not_imported_without_scattering():
    code = (
        "import sys, facerender as fr\n"
        "with fr.Renderer((32, 32), samples=4, backend='egl') as renderer:\n"
        "    renderer.render(fr.Scene(fr.load_mesh(sys.argv[1])))\n"
        "print([name for name in sys.modules if 'scatter' in name])\n"
    )
    command = [sys.executable, "-c", code, str(MINI_HEAD)]
    assert subprocess.check_output(command, text=True) == "[]\n"


def test_scattering_needs_the_size_of_the_mesh(head, renderer, tmp_path, mini_obj):
    assert head.millimetres == 1000.0
    mesh = fr.load_mesh(mini_obj)
    assert mesh.millimetres is None
    with pytest.raises(fr.InputError, match=r"needs the size of head.obj, .* give --millimetres"):
        renderer.render(fr.Scene(mesh.with_material(scattering="skin")))
    assert fr.load_mesh(mini_obj, millimetres=2.0).millimetres == 2.0
    assert fr.MeshFile(str(mini_obj), millimetres=2.0).load().millimetres == 2.0
    for size in (0.0, -1.0, math.nan, "1"):
        with pytest.raises(fr.InputError, match="millimetres = .*: give a"):
            fr.load_mesh(mini_obj, millimetres=size)
    large = replace(head, millimetres=1e5).with_material(scattering="skin")
    with pytest.warns(fr.FacerenderWarning, match=r"give --millimetres 1000 \(m\)$"):
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
    for samples in (5, True, 16.5, "16"):
        with pytest.raises(
            fr.InputError, match="scatter_samples = .*: give one of 0, 8, 16, 32, 64"
        ):
            fr.Shading(scatter_samples=samples)
    radius = np.linspace(0.0, 30.0, 60001)
    whole = np.trapezoid(
        scatter_profile(radius**2, PROFILES["skin"]).T * 2 * np.pi * radius, radius
    )
    np.testing.assert_allclose(whole, 1.0, atol=2e-3)
    places = spiral(PROFILES["skin"], 64)
    assert np.isfinite(places).all()
    assert (np.diff(np.hypot(*places.T[:2])) > 0.0).all()


def test_plans_may_use_fewer_samples(head, face):
    def counts(scene: fr.Scene, full: fr.Shading) -> set[int]:
        few = candidates(scene, full, Constants(0.3, 1.0, ()))
        return {shading.scatter_samples for shading in few}

    assert counts(face, fr.Shading()) == {0, 8, 16}
    assert counts(face, fr.Shading(scatter_samples=8)) == {0, 8}
    assert counts(replace(face, mesh=head), fr.Shading()) == {16}
    unshadowed = replace(face, lights=(fr.Light(),))
    prices = load_prices("navi21", unshadowed, [OFF])
    costs = [prices.cost(unshadowed, fr.Shading(scatter_samples=n))[0] for n in (0, 8, 16, 64)]
    assert costs == sorted(costs)
    assert costs[1] < costs[2] < costs[3]
