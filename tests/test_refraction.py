"""Tests refracting parts: the eye against exact rays, and refraction with every other feature."""

from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing import reference
from facerender.drawing.passes.refraction import regions_of
from facerender.drawing.passes.visibility import can_defer
from facerender.drawing.triangle_setup import triangle_setup_of
from facerender.explorer.mesh import drawable, lost_features
from facerender.scenes.light import parse_light
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh
from tests.verification.eye import CLEAR, camera, cap, disc, eye, iris_errors
from tests.verification.parts_head import joined

LIGHTS = tuple(map(parse_light, ("-30,35,3,radius=3", "rim,no-shadow", "fill,no-shadow")))


@pytest.fixture(scope="module")
def single(backend):
    with fr.Renderer((256, 256), samples=1, backend=backend, float_albedo=True) as renderer:
        yield renderer


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("azimuth", "straight"), [(0.0, 0.05), (30.0, 0.08), (50.0, 0.16), (-45.0, 0.14)]
)
def test_iris_is_where_exact_rays_hit_it(single, azimuth, straight):
    """On a cornea of 512 triangles. Without refraction the error is much larger."""
    drawn, without = iris_errors(single, azimuth, rings=8, sectors=32)
    assert len(drawn) > 15_000
    assert drawn.mean() < 0.001
    assert np.quantile(drawn, 0.99) < 0.01
    assert without.mean() == pytest.approx(straight, abs=0.01)


def test_error_falls_with_the_triangles_of_the_cornea(single):
    coarse, fine = (iris_errors(single, 40.0, rings=n, sectors=4 * n)[0].mean() for n in (4, 24))
    assert fine < 0.1 * coarse
    assert fine < 1.5e-4


def agrees(renderer, scene, shading=fr.Shading(), bound=1e-4):
    """Check an image against float64; return the image and the G-buffer."""
    frame, gbuffer = renderer.render(scene, shading).linear, renderer.gbuffer(scene, shading)
    expected = reference.shade(gbuffer, scene, shading) + (1.0 - gbuffer.coverage[..., None]) * (
        scene.background or 0.0
    )
    assert np.abs(frame[..., :3] - expected).max() < bound
    assert np.abs(frame[..., 3] - gbuffer.coverage).max() < 1e-6
    return frame, gbuffer


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"alpha": "blend", "opacity": 0.5},
        {"alpha": "mask", "opacity": 0.4},
        {"transmission": 0.6, "emissive": 0.1},
        {"second_slope": 2.0, "lobe_weight": 0.5},
    ],
)
def test_highlight_agrees_with_float64(single, change):
    mesh = eye(ks=1.0, **change)
    scene = fr.Scene(mesh, camera(30.0), LIGHTS, ambient=0.3, background=(0.1, 0.2, 0.3))
    bare = replace(scene, mesh=eye(ks=0.0, **change))
    frame, gbuffer = agrees(single, scene)
    if change.get("alpha") == "mask":  # the whole cornea is below the cutoff
        np.testing.assert_array_equal(frame, single.render(bare).linear)
        return
    layer = gbuffer.transparent_layers[0] if "alpha" in change else gbuffer
    own = layer.part == CLEAR
    assert own.sum() > 10_000
    shine = frame[..., :3] - single.render(bare).linear[..., :3]
    assert shine[own].max() > 0.5
    assert shine[own].min() > -0.2  # light that the surface reflects does not enter
    assert np.abs(shine[~own]).max() < 1e-6
    light = [
        each if "alpha" not in change else each.transparent_layers[0]
        for each in (gbuffer, single.gbuffer(bare))
    ]
    ratio = light[0].emission[own] / light[1].emission[own]
    towards = gbuffer.view.position - layer.normalised_position[own]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = (towards * layer.normal[own]).sum(axis=1)
    if "emissive" not in change:
        schlick = 0.0207 + 0.9793 * (1.0 - cosine.clip(0.0, 1.0)) ** 5
        np.testing.assert_allclose(ratio, np.tile(1.0 - schlick[:, None], 3), atol=1e-4)


def test_surfaces_in_front_of_the_cornea_are_not_behind_it(single):
    """A plate in front of the cornea changes only the pixels that it hides."""
    mesh = eye()
    plate = disc(2, 16)
    positions = plate.positions * (0.1, 0.1, 0.0) + (-4.8, 0.0, -0.6)
    plate = replace(plate, positions=positions, colors=None)
    more = (*mesh.parts, plate), (*mesh.materials, Material((0.0, 0.0, 0.0), ks=0.0))
    hidden = replace(mesh, parts=more[0], materials=more[1])
    light = {"lights": (), "ambient": 3.0}
    one, two = (single.gbuffer(fr.Scene(each, camera(50.0), **light)) for each in (mesh, hidden))
    own = (one.part == CLEAR) & (two.part == CLEAR)
    assert own.sum() > 10_000
    np.testing.assert_allclose(one.emission[own], two.emission[own], atol=1e-6)


@pytest.mark.slow
def test_every_effect_agrees_with_float64(single):
    studio = fr.load_environment(fr.EnvironmentFile("studio"))
    mesh = eye(ks=1.0)
    for settings, shading in (
        ({"lights": (), "ambient": 0.0, "environment": studio}, fr.Shading()),
        ({"lights": LIGHTS}, fr.Shading(diffuse="coupled")),
    ):
        agrees(single, fr.Scene(mesh, camera(20.0), **settings), shading)
    scatters = [replace(each, scattering="skin") for each in mesh.materials[:CLEAR]]
    skin = replace(mesh, materials=(*scatters, mesh.materials[CLEAR]), millimetres=8.0)
    frame, _ = agrees(single, fr.Scene(skin, camera(20.0), LIGHTS), bound=1e-3)
    plain = single.render(fr.Scene(mesh, camera(20.0), LIGHTS)).linear
    assert 0.0 < np.abs(frame - plain).mean() < 0.05
    four = single.render(fr.Scene(skin, camera(20.0), LIGHTS), samples=4).linear
    assert np.abs(four - frame).mean() < 0.01


@pytest.mark.slow
def test_forward_deferred_and_per_pixel_shading_agree(backend, monkeypatch):
    scene = fr.Scene(eye(ks=1.0), camera(35.0), LIGHTS)
    assert can_defer(scene, 16384)
    images = []
    for deferred in (False, True):
        name = "facerender.drawing.renderer.deferred_is_cheaper"
        monkeypatch.setattr(name, lambda *_, on=deferred: on)
        with fr.Renderer((128, 128), samples=4, backend=backend) as renderer:
            images += [renderer.render(scene, samples=n).linear for n in (1, 4, 16)]
            pixel = renderer.render(scene, shading_rate="pixel").linear
    for one, other in zip(images[:3], images[3:], strict=True):
        assert np.quantile(np.abs(one - other), 0.995) < 2e-3
    assert np.abs(pixel - images[2]).mean() < 5e-3


def test_terms_and_data_views_show_the_cornea_itself(single):
    scene = fr.Scene(eye(ks=1.0), camera(0.0), LIGHTS)
    middle = (128, 128)
    assert single.render(scene, only="parts").linear[middle][0] == CLEAR + 1
    assert single.render(scene, only="depth").linear[middle][0] > 0.0
    for only in ("diffuse", "specular"):
        image = single.render(scene, only=only).linear
        assert np.isfinite(image).all()
        assert image[middle][0] < 0.05  # refracted light belongs to neither term


@pytest.mark.slow
def test_maps_are_reused_until_the_scene_changes(single, monkeypatch):
    drawn = []
    draw = type(single._resources)._draw
    monkeypatch.setattr(
        type(single._resources),
        "_draw",
        lambda own, each, step, *rest: (drawn.append(step.name), draw(own, each, step, *rest)),
    )
    mesh = eye()
    scene = fr.Scene(mesh, camera(0.0), LIGHTS)
    dark = replace(mesh, materials=(*mesh.materials[:1], Material(), *mesh.materials[CLEAR:]))
    studio = fr.load_environment(fr.EnvironmentFile("studio"))
    for changes, count in (
        ({}, 2),
        ({"camera": camera(10.0)}, 0),
        ({"ambient": 0.5}, 2),
        ({"lights": LIGHTS[:2]}, 2),
        ({"environment": studio}, 2),
        ({"environment": replace(studio, rotation=90.0)}, 2),
        ({"mesh": dark}, 2),
        ({}, 0),
    ):
        scene = replace(scene, **changes)
        drawn.clear()
        single.render(scene)
        assert drawn.count("refraction_map") == count, changes


@pytest.mark.slow
def test_nothing_behind_shows_the_background(single):
    mesh = eye()
    alone = Mesh.of("lens", mesh.parts[CLEAR:], mesh.materials[CLEAR:])
    for azimuth in (0.0, 90.0, 180.0, -120.0):
        scene = fr.Scene(alone, fr.Camera(azimuth), LIGHTS, background=(0.1, 0.2, 0.3))
        image, gbuffer = agrees(single, scene)
        lost = image[gbuffer.part == 0][:, :3] / (0.1, 0.2, 0.3)
        assert (lost > 0.0).all()
        assert (lost <= 1.0 + 1e-6).all()
    inside = fr.Camera(position=(0.0, 0.0, -1.0), target=(0.0, 0.0, -3.6), fov=60.0)
    for place in (inside, replace(inside, target=(0.0, 0.0, 1.0))):
        assert np.isfinite(single.render(fr.Scene(mesh, place, LIGHTS)).linear).all()


def test_each_region_has_a_map(single):
    """Two eyes in one mesh look like one eye; so does an eye with a clear shell around it."""
    one = eye()
    apart = [[replace(p, positions=p.positions + (x, 0, 0)) for x in (-16, 16)] for p in one.parts]
    colors = [None, np.concatenate([one.parts[1].colors] * 2), None]
    parts = [
        replace(joined([replace(p, uv=p.positions[:, :2], colors=None) for p in own]), colors=color)
        for own, color in zip(apart, colors, strict=True)
    ]
    two = Mesh.of("eyes", parts, one.materials)
    assert len(regions_of(triangle_setup_of(two.parts[CLEAR], two))) == 2
    light = {"lights": (), "ambient": 3.0}
    middle = np.s_[100:156, 100:156, :3]
    alone = single.render(fr.Scene(one, fov(0.0), **light)).linear[middle]
    for x in (-16.0, 16.0):
        beside = single.render(fr.Scene(two, fov(x), **light)).linear[middle]
        assert np.abs(alone - beside).max() < 0.01
    shell = cap(-12.6, 12.6, 0.0, np.pi, 24, 64)
    closed = Mesh.of("shell", [*one.parts[:CLEAR], shell], one.materials)
    (region,) = regions_of(triangle_setup_of(closed.parts[CLEAR], closed))
    np.testing.assert_allclose(region.matrix[:2, 2], 0.0, atol=1e-6)
    image = single.render(fr.Scene(closed, fov(0.0), **light)).linear[middle]
    assert np.abs(image - alone).mean() < 0.1


def fov(x):
    """Return a camera 300 mm in front of an eye at x, whatever the bounds of the mesh are."""
    return fr.Camera(position=(x, 0.0, 300.0), target=(x, 0.0, 0.0), fov=4.0)


def test_many_regions_share_one_map(single):
    lens = eye().parts[CLEAR]
    row = [
        replace(lens, positions=lens.positions + (14.0 * i, 0.0, 0.0), uv=lens.positions[:, :2])
        for i in range(9)
    ]
    for count, maps in ((1, 1), (8, 8), (9, 1)):
        mesh = Mesh.of("lenses", [joined(row[:count])], eye().materials[CLEAR:])
        regions = regions_of(triangle_setup_of(mesh.parts[0], mesh))
        assert len(regions) == maps
        assert sum(len(each.faces) for each in regions) == len(mesh.parts[0].faces)
    agrees(single, fr.Scene(mesh, fr.Camera(), LIGHTS))


def test_the_explorer_omits_refracting_parts():
    assert lost_features(eye())[0].startswith("blended parts")
    assert len(drawable(eye()).parts) == 2


@pytest.mark.slow
def test_maps_follow_the_order_of_the_lights():
    """Lights without a specular term come last, and so do their shadow maps."""
    camera = fr.Camera(-35, target=(0.03, 0.02, 0.1), zoom=5.0)
    shading = fr.Shading(specular_lights=(1, 2))
    images = []
    for shadings in ((shading,), (fr.Shading(), shading)):
        scene = fr.Scene(fr.load_mesh().with_material(), camera)
        for each in shadings:
            with fr.Renderer((128, 128), samples=1) as renderer:
                image = renderer.render(scene, each).linear
        images.append(image)
    np.testing.assert_array_equal(*images)
