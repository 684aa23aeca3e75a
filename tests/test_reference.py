"""Tests every pixel of images against float64 shading of their G-buffers, for each term, and that
each term changes the image."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.drawing import reference
from facerender.drawing.context import Backend
from facerender.drawing.prepare import resolve
from facerender.drawing.program import Program
from facerender.lobes import GPower
from facerender.scene.environment import studio
from facerender.scene.light import LIGHTS
from facerender.scene.view import view_of
from tests.verification.forward import forward_passes
from tests.verification.lights import PLAIN_THREE


def shading_name(shading: fr.Shading) -> str:
    term = shading.term
    return f"{term.model}-{term.lobe}-{term.fresnel}"


SIDE = fr.Camera(azimuth=35.0, elevation=8.0)
SHADINGS = [
    fr.Shading(model, lobe)
    for model in ("cook-torrance", "ward", "ward-printed")
    for lobe in fr.lobes.NAMES
] + [fr.Shading(fresnel="dielectric")]
REDUCED = [  # choices that omit something of a scene with five lights
    fr.Shading(lobe=GPower(11, 0.2, 0.4), masking="none"),
    fr.Shading(fresnel="constant", masking="kelemen", m=0.25, small_slope=False),
    fr.Shading(fresnel="constant", masking="none", m=0.1, small_slope=True, ks=0.6),
    fr.Shading(lobe=GPower(8, 0.25, 0.5), m=0.3, ks=0.6, normal_map=False),
    fr.Shading(lobe="fitted", masking="kelemen", ambient=False, specular_lights=(0, 2)),
    fr.Shading(normal_map=False, ambient=False, specular_lights=[4, 1]),
    fr.Shading("ward", GPower(4, 0.6), m=0.4, specular_lights=(3,)),
    fr.Shading("ward", ks=0.5, specular_lights=()),
    fr.Shading("ward-printed", "d8", normal_map=False, ambient=False, specular_lights=(0,)),
    fr.Shading(fresnel="dielectric", lobe="d4"),
    fr.Shading(masking="kelemen", m=0.3, specular_lights=(4, 0, 2)),
]


def lit(mesh: fr.Mesh, **changes) -> fr.Scene:
    """Return a scene with directional lights and a point light, without shadows."""
    place = tuple(mesh.center + mesh.radius * np.array([-1.0, 0.8, 1.5]))
    point = fr.Light(irradiance=(1.0, 0.5, 0.2), position=place, shadow=False)
    return replace(fr.Scene(mesh, SIDE, (*PLAIN_THREE, point), background=None), **changes)


def mixed(mesh: fr.Mesh) -> fr.Scene:
    """Return a scene with five lights; numbers 0 and 3 are point lights."""
    key, rim, fill, point = lit(mesh).lights
    other = replace(point, position=tuple(mesh.center + mesh.radius * np.array([1.5, 0.5, 1.0])))
    return fr.Scene(mesh, SIDE, (point, key, rim, other, fill), background=None)


def compared(
    renderer: fr.Renderer, scene: fr.Scene, shading: fr.Shading = fr.Shading()
) -> tuple[fr.GBuffer, np.ndarray, np.ndarray]:
    """Return the G-buffer, the float64 radiance of the covered pixels, and the error of the GPU.

    Radiance and errors are (N, 3). Errors are relative to max(reference, 0.01); a white diffuse
    surface has radiance 1 under an irradiance of pi.
    """
    gbuffer = renderer.gbuffer(scene, shading)
    linear = renderer.render(scene, shading).linear
    covered = gbuffer.part >= 0
    np.testing.assert_array_equal(covered, linear[..., 3] > 0)
    assert covered.mean() > 0.12
    assert np.isfinite(linear).all()
    shadowed = gbuffer.visibility.min(axis=(0, 1))
    lights = resolve(scene, shading).appearance.lighting.environment
    shadows = [light.shadow for light in (*scene.lights, *lights)]
    np.testing.assert_array_equal(shadowed < 1.0, shadows)
    expected = reference.shade(gbuffer, scene, shading)[covered]
    return gbuffer, expected, np.abs(linear[covered][:, :3] - expected) / expected.clip(0.01)


def programs_of(scene: fr.Scene, shading: fr.Shading) -> list[Program]:
    """Return the programs that the renderer compiles for a scene."""
    *_, last = forward_passes(resolve(scene, shading), view_of(scene, 1.0), (64, 64))
    return [draw.program for draw in last.draws]


@pytest.fixture(scope="module")
def transparent(backend: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer((128, 96), samples=1, backend=backend) as renderer:
        yield renderer


@pytest.mark.first_case
@pytest.mark.parametrize("mesh", ["head", pytest.param("scan_mesh", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("scene_of", "shading"),
    [*((lit, each) for each in SHADINGS), *((mixed, each) for each in REDUCED)],
    ids=lambda each: shading_name(each) if isinstance(each, fr.Shading) else each.__name__,
)
def test_every_term_of_a_light(transparent, mesh, scene_of, shading, request):
    scene = scene_of(request.getfixturevalue(mesh))
    assert compared(transparent, scene, shading)[2].max() < 1e-4


@pytest.mark.parametrize("shading", [fr.Shading(), fr.Shading("ward", "d16")], ids=shading_name)
def test_poses_of_a_mesh(transparent, head, shading):
    """One renderer draws poses of one mesh, whose vertex buffers and triangle table it reuses."""
    shapes = {"jawOpen": 1.0, "mouthSmileLeft": 0.7, "eyeBlinkRight": 1.0}
    for weight in (1.0, 0.3):
        posed = head.with_pose({name: weight * own for name, own in shapes.items()})
        assert compared(transparent, lit(posed), shading)[2].max() < 1e-4


@pytest.mark.parametrize("m", [1e-3, 0.05, 0.15, 0.25, 1.5])
def test_the_exact_lobe_at_every_slope(transparent, head, m):
    # The slopes use both forms of the half vector. For small m, rounding of the normal shows.
    scene = lit(head.with_material(m=m, roughness_map=None))
    assert compared(transparent, scene)[2].max() < (1e-4 if m > 0.01 else 1e-2)


def test_change_of_a_thousandth_is_detected(transparent, scan_mesh):
    scene = lit(scan_mesh)
    gbuffer, expected, error = compared(transparent, scene)
    assert error.max() < 1e-4
    changed = replace(gbuffer, m=gbuffer.m * np.float32(1.001))
    other = reference.shade(changed, scene, fr.Shading())[gbuffer.part >= 0]
    assert (np.abs(other - expected) / expected.clip(0.01)).max() > 1e-4


# --- terms of a whole image ----------------------------------------------------------------------

SWEAT = {"second_slope": 0.4, "lobe_weight": 0.3}
TWO = {"second_slope": 0.5, "lobe_weight": 0.6}
ENVIRONMENT = fr.Environment(studio(), 70.0, 0.8)


def ramp() -> fr.Texture:
    rows = np.add.outer(np.arange(64), np.arange(64)) * 2
    return fr.Texture(lambda: Image.fromarray(rows.astype(np.uint8)), "ramp")


def around(mesh: fr.Mesh, **material) -> fr.Scene:
    """Return a scene with an environment map and one light."""
    lights, camera = (LIGHTS["key"],), fr.Camera(azimuth=-35.0)
    mesh = mesh.with_material(**material)
    return fr.Scene(mesh, camera, lights, 0.0, None, ENVIRONMENT)


def plain(mesh: fr.Mesh, **material) -> fr.Scene:
    lights = (LIGHTS["key"], replace(LIGHTS["fill"], azimuth=100.0, irradiance=2.5))
    return fr.Scene(mesh.with_material(**material), fr.Camera(35.0), lights, background=None)


def areas(mesh: fr.Mesh) -> fr.Scene:
    """Return a scene with every kind of light, with and without a radius."""
    place = tuple(mesh.center + mesh.radius * np.array([-1.0, 1.2, 2.5]))
    key, rim, fill = PLAIN_THREE
    lights = (
        *(replace(key, radius=8.0), rim, replace(fill, radius=20.0)),
        fr.Light(irradiance=1.0, position=place, radius=10.0, shadow=False),
        fr.Light(irradiance=0.3, position=place, shadow=False),
    )
    return fr.Scene(mesh.with_material(m=0.2), SIDE, lights, background=None)


def key(mesh: fr.Mesh, radius: float, distance: float | None) -> fr.Light:
    """Return a light from the upper left; ``distance`` is in mesh radii, None means directional."""
    light = fr.Light(-50.0, 42.0, 3.0, radius=radius, shadow=True)
    if distance is None:
        return light
    return replace(
        light,
        azimuth=0.0,
        elevation=0.0,
        position=tuple(mesh.center + distance * mesh.radius * light.direction),
    )


def shadows(mesh: fr.Mesh) -> fr.Scene:
    """Return a scene with all kinds of lights, with and without shadows, in mixed order."""
    lights = (
        key(mesh, 0.0, 2.0),
        fr.Light(80.0, 20.0, 0.5, shadow=False),
        key(mesh, 5.0, None),
        fr.Light(40.0, -10.0, (0.2, 0.4, 0.3), shadow=True),
        key(mesh, 3.0, 4.0),
    )
    return fr.Scene(mesh, fr.Camera(-20.0), lights, ambient=0.1, background=None)


def skin(mesh: fr.Mesh) -> fr.Scene:
    """Return a scene of the head's nose, near enough for four Gaussians at 96 pixels."""
    side = fr.Light(80.0, 20.0, (0.2, 0.4, 0.3), shadow=False)
    lights = (fr.Light(-50.0, 42.0, 3.0), side)
    mesh = mesh.with_material(scattering="skin")
    camera = fr.Camera(-35.0, zoom=5.0, target=(0.0, -0.03, 0.1))
    return fr.Scene(mesh, camera, lights, background=None)


@dataclass(frozen=True)
class Case:
    """A scene of the head, a shading, and the effect of its term.

    without : changes of the shading that disable the term
    least : lower bound of the mean absolute change of the float64 radiance without the term
    largest : lower bound of the largest absolute change
    darkest : lower bound of the signed change
    rounded : fraction of pixels with an error of up to 0.5, because rounding changes their samples
    """

    scene: Callable[[fr.Mesh], fr.Scene]
    shading: fr.Shading
    without: dict[str, object]
    least: float
    darkest: float = -np.inf
    largest: float = 0.05
    rounded: float = 0.0


def cases() -> Iterator[tuple[Case, bool]]:
    """Yield every case, and whether it uses deferred shading."""
    off, forward, deferred = {"environment": False}, (False,), (True,)
    lobes = {"second_slope": 1.7, "lobe_weight": 0.8}
    both = {"lobe": "d8", "outside": "exact", "fresnel": "dielectric", "masking": "kelemen"}
    for shading in (
        fr.Shading(),
        fr.Shading(**both, diffuse="coupled"),
        fr.Shading("ward", environment_samples=8, ambient=False),
    ):
        yield Case(around, shading, off, 0.1), True
        yield Case(partial(around, **lobes), shading, off, 0.1), False
    sweat = partial(plain, **SWEAT, lobe_map=ramp())
    for shading, paths in (
        (fr.Shading(), deferred),
        (fr.Shading(lobe="fitted", fresnel="dielectric", masking="kelemen"), deferred),
        (fr.Shading("ward", "d16"), deferred),
        (fr.Shading("ward-printed", m=0.1), deferred),
        (fr.Shading(lobe="d8"), deferred + forward),
    ):
        yield from ((Case(sweat, shading, {"two_lobes": False}, 0.003), path) for path in paths)
    for material, changes, path in (
        ({}, {}, True),
        ({**TWO, "ks": 0.7}, {}, False),
        ({**TWO, "ks": 0.7}, {"lobe": "d8", "m": 0.25}, True),
        (TWO, {"model": "ward", "ambient": False, "ks": 0.5}, True),
    ):
        shading = fr.Shading(diffuse="coupled", **changes)
        yield Case(partial(plain, **material), shading, {"diffuse": "lambert"}, 0.002, -0.02), path
    for path in (False, True):
        shading = fr.Shading(lobe="fitted", outside="exact")
        yield Case(areas, shading, {"normal_map": False}, 0.001), path
        yield Case(shadows, fr.Shading(), {"shadow_lights": []}, 0.01), path
    wide = fr.Shading(scatter_samples=8, diffuse="coupled")
    for shading, path in ((fr.Shading(), False), (wide, True)):
        yield Case(skin, shading, {"scatter_samples": 0}, 0.002, -np.inf, 0.1, 1e-3), path


@pytest.fixture(scope="module")
def floats(egl: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer((96, 96), samples=1, backend=egl, float_albedo=True) as renderer:
        yield renderer


CASES = [*cases()]
NAMES = [getattr(case.scene, "func", case.scene).__name__ for case, _ in CASES]


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("case", "deferred"), CASES, ids=[f"{name}-{i}" for i, name in enumerate(NAMES)]
)
def test_every_term_of_an_image(floats, head, case, deferred, monkeypatch):
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred)
    floats._resources.frames.clear()  # a compiled frame keeps its choice
    scene = case.scene(head)
    gbuffer, expected, error = compared(floats, scene, case.shading)
    assert np.quantile(error, 1.0 - case.rounded) < 1e-4
    assert error.max() < 0.5
    covered = gbuffer.part >= 0
    ((low, high),) = resolve(scene, case.shading).appearance.slopes
    if scene.mesh.materials[0].second_slope == 1.0:
        assert low * (1.0 - 1e-6) <= gbuffer.m[covered].min() <= gbuffer.m[covered].max() <= high
    if scene.mesh.materials[0].lobe_map:
        assert np.ptp(gbuffer.lobe_weight[covered]) > 0.3
    shading = case.shading.replace(**case.without)
    bare = floats.gbuffer(scene, shading)
    other = reference.shade(bare, scene, shading)[covered]
    assert np.abs(other - expected).mean() > case.least
    assert np.abs(other - expected).max() > case.largest
    assert (other - expected).min() > case.darkest


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("material", "changes", "off", "least"),
    [
        ({}, {"environment": ENVIRONMENT}, {"environment": False}, 0.1),
        (
            {},
            {"lights": [replace(each, shadow=True) for each in PLAIN_THREE]},
            {"shadow_lights": []},
            5e-3,
        ),
        ({"second_slope": 1.7, "lobe_weight": 0.85}, {}, {"two_lobes": False}, 1e-3),
        ({"scattering": "skin"}, {}, {"scatter_samples": 0}, 1e-3),
    ],
)
def test_disabled_feature_equals_a_scene_without_it(floats, head, material, changes, off, least):
    plain = fr.Scene(head, fr.Camera(zoom=2.5), PLAIN_THREE)
    scene = replace(plain, mesh=head.with_material(**material), **changes)
    full, without, none = fr.Shading(), fr.Shading(**off), floats.render(plain).linear
    assert programs_of(scene, without) == programs_of(plain, full)
    assert programs_of(scene, full) != programs_of(plain, full) or "scattering" in material
    np.testing.assert_array_equal(floats.render(scene, without).linear, none)
    assert np.abs(floats.render(scene, full).linear - none).mean() > least


# --- plans that may leave out a term -------------------------------------------------------------


def lone(mesh: fr.Mesh) -> fr.Scene:
    """Return a scene with two lobes under one light from the side."""
    mesh = mesh.with_material(normal_map=None, m=0.3, second_slope=1.7, lobe_weight=0.85)
    return fr.Scene(mesh, fr.Camera(-35.0), PLAIN_THREE[1:2], ambient=0.0)


def dim(mesh: fr.Mesh) -> fr.Scene:
    mesh = mesh.with_material(normal_map=None, m=0.3, albedo_map=None, kd=0.1)
    return fr.Scene(mesh, lights=PLAIN_THREE[:1], ambient=0.0)


def surrounded(mesh: fr.Mesh) -> fr.Scene:
    scene = around(mesh, m=0.3, normal_map=None)
    return replace(scene, lights=(), environment=fr.Environment(studio()), background=(0.0,) * 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene_of", "full", "budgets", "values", "texts"),
    [
        (lone, {}, ("1/255", "6/255"), {"two_lobes": (True, False)},
         ("two, constant 0.3: one, constant", "one, constant 0.3")),
        (dim, {"diffuse": "coupled"}, ("0.5/255", "20/255"),
         {"diffuse": ("coupled", "lambert")}, ("", "lambert instead of coupled")),
        (surrounded, {}, ("0.5/255", "16/255"), {"environment": (True, True)},
         ("samples", "samples")),
    ],
)  # fmt: skip
def test_plans_may_leave_out_terms(head, scene_of, full, budgets, values, texts):
    scene, exact = scene_of(head), fr.Shading(**full)
    with fr.Renderer((32, 32), samples=1) as renderer:
        plans = [
            fr.plan(scene, budget, full=exact, renderer=renderer, cost="navi21")
            for budget in budgets
        ]
        whole = renderer.render(scene, exact).linear[..., :3].astype(float)
        for plan in plans:
            drawn = renderer.render(scene, plan.shading).linear[..., :3].astype(float)
            assert plan.budget.errors(drawn, whole).max() <= plan.budget.limit
            assert plan.cost.total < plan.cost.full_total or scene_of is not lone
    for name, wanted in values.items():
        assert tuple(getattr(plan.shading, name) for plan in plans) == wanted
    assert all(words in plan.explain() for words, plan in zip(texts, plans, strict=True))
    near, far = plans
    assert fr.Shading.from_dict(json.loads(json.dumps(far.shading.as_dict()))) == far.shading
    if scene_of is lone:
        assert 0.3 < far.shading.term.m < 0.51
        assert "fr_cook_torrance_two_terms(" in near.shader() or near.shading.term.model == "ward"
    if scene_of is surrounded:
        assert near.shading.environment_samples == 32 > far.shading.environment_samples
