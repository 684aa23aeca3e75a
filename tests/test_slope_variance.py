"""Tests the slope filter and area lights: stored mip levels, rendering, and errors against
supersampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import brdf
from facerender.commands import main
from facerender.drawing.prepare import resolve
from facerender.drawing.program import surface_features
from facerender.images.files import read_image
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module
from tests.settings import parse_light
from tests.test_reference import areas
from tests.verification.lights import PLAIN_THREE
from tests.verification.slope_filter import disc, filtered, flicker, relief, slopes_of


def levels_of(texels: np.ndarray) -> list[np.ndarray]:
    image = Image.fromarray(np.asarray(texels, dtype=np.uint8))
    return fr.Texture(lambda: image, "relief").levels("normal").result()


def tilted(angle: float) -> tuple[float, float, float]:
    """Return the texel of a normal tilted by an angle in degrees."""
    radians = np.radians(angle)
    return (127.5 + 127.5 * np.sin(radians), 127.5, 127.5 + 127.5 * np.cos(radians))


def test_levels_hold_the_mean_normal_and_the_deviation():
    texels = np.empty((4, 4, 3))
    texels[:, 0::2], texels[:, 1::2] = tilted(20.0), tilted(-20.0)
    finest, *coarser = levels_of(texels)
    np.testing.assert_array_equal(finest[..., :3], texels.astype(np.uint8))
    assert not finest[..., 3].any()
    length = np.cos(np.radians(20.0))
    for level in coarser:
        assert np.abs(level[..., :3].astype(int) - (127, 127, 255)).max() <= 1
        expected = 255.0 * np.sqrt((1.0 - length) / length) / 0.35
        np.testing.assert_allclose(level[..., 3], expected, atol=3.0)  # 8-bit levels
    assert [level.shape[:2] for level in coarser] == [(2, 2), (1, 1)]


def test_lengths_of_normals_are_ignored():
    """JPEG compression changes the lengths of normals."""
    random = np.random.default_rng(2)
    short = 127.5 + np.array([0.0, 0.0, 127.0]) * random.uniform(0.6, 1.0, (17, 9, 1))
    for level in levels_of(short):
        assert level[..., 3].max() <= 3
    assert [level.shape for level in levels_of(short[:1, :1])] == [(1, 1, 4)]


def test_steep_relief_is_clamped():
    texels = np.empty((2, 2, 3))
    texels[0], texels[1] = tilted(89.0), tilted(-89.0)
    assert levels_of(texels)[1][0, 0, 3] == 255


def test_relief_of_normally_distributed_slopes_needs_the_whole_variance(evaluator):
    slopes = np.random.default_rng(6).normal(0.0, 0.115, (256, 256, 2))
    c = 1.0 / np.sqrt(1.0 + (slopes**2).sum(axis=-1))
    deviation = relief(slopes, 1.0).levels("normal").result()[-1][0, 0, 3] / 255.0
    m = np.array([0.15, 0.25], np.float32)
    peaks = [fr.lobes.exact(c, each, 4).mean() / each**2 for each in m]
    include = '#include "facerender/slope_variance.glsl"'
    call = "fr_slope_filtered(m, fr_slope_variance_map(alpha))"
    inputs = {"m": m, "alpha": np.full_like(m, deviation)}
    for define, ratios in (("", (1.34, 1.13)), ("#define FR_MAP_SHARE 1.0\n", (1.0, 1.0))):
        wide = evaluator(fr.resolve_includes(define + include), call, inputs)
        np.testing.assert_allclose(wide**-2.0 / peaks, ratios, atol=0.04)


@pytest.mark.slow
def test_slope_filter_can_be_disabled(renderer, head):
    off = fr.Shading(slope_filter=False)
    for shading in (fr.Shading(), off):
        (part,) = resolve(fr.Scene(head), shading).appearance.parts
        assert ("SLOPE_FILTER" in surface_features(part, shading)) == shading.slope_filter
    mesh = head.with_material(m=0.3)
    covered = renderer.gbuffer(fr.Scene(mesh), off).part >= 0
    assert np.ptp(renderer.gbuffer(fr.Scene(mesh), off).m[covered]) == 0.0
    assert np.ptp(renderer.gbuffer(fr.Scene(mesh), fr.Shading()).m[covered]) > 0.01
    assert resolve(fr.Scene(mesh, lights=PLAIN_THREE), off).appearance.slopes == [(0.3, 0.3)]
    light = fr.Light(irradiance=2.0)
    assert light.kind.name == "directional"
    assert replace(light, radius=0.1).kind.name == "disc"


def test_constant_slope_of_a_shading_is_not_widened(renderer, head):
    pinned = fr.Shading(m=0.25)
    images = [
        renderer.render(areas(head), each, "specular").linear
        for each in (pinned, pinned.replace(slope_filter=False))
    ]
    assert np.abs(images[0] - images[1]).max() < 0.05 * images[0].max()


def test_area_light_that_is_too_near_is_refused(renderer, head):
    place = tuple(head.center + head.radius * np.array([0.0, 0.0, 1.5]))
    near = fr.Light(position=place, radius=10.0)
    for shading in (fr.Shading(), fr.Shading(specular_lights=())):
        with pytest.raises(fr.InputError, match="radius 10 is too near: .* reduce it, or"):
            renderer.render(fr.Scene(head, lights=(near,)), shading)
    renderer.render(fr.Scene(head, lights=(replace(near, radius=5.0),)))


def test_radius_option_of_lights():
    assert parse_light("key,radius=5").radius == 5.0
    assert parse_light("10,20,1,2,3,radius=0.27") == fr.Light(10.0, 20.0, (1, 2, 3), radius=0.27)
    assert parse_light("point:1,2,3,radius=2").position == (1.0, 2.0, 3.0)
    with pytest.raises(fr.InputError, match="radius = 30"):
        parse_light("key,radius=30")
    for text in ("key,radius", "radius=5", "key,radius=x"):
        with pytest.raises(fr.InputError, match="unknown light"):
            parse_light(text)


def test_options_of_render_equal_python(tmp_path, egl, capsys):
    options = ["--size", "48", "--samples", "1", "--light", "key,radius=12", "--no-cache"]
    path = tmp_path / "head.exr"
    require_module("OpenEXR")
    options += ["--no-slope-filter", "-o", str(path)]
    assert main(["render", str(MINI_HEAD), *options]) == 0
    shading = fr.Shading(slope_filter=False)
    scene = fr.Scene(fr.load_mesh(MINI_HEAD), lights=(parse_light("key,radius=12"),))
    with fr.Renderer((48, 48), samples=1, backend=egl) as renderer:
        expected = renderer.render(scene, shading).linear
    np.testing.assert_array_equal(read_image(path).pixels[..., :3], expected[..., :3])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("strength", "m"),
    [
        pytest.param(1.0, 0.15, marks=pytest.mark.slow),
        (3.0, 0.15),
        pytest.param(3.0, 0.3, marks=pytest.mark.slow),
    ],
)
def test_slope_filter_is_close_to_supersampling(egl, scan_mesh, strength, m):
    require_module("flip_evaluator")
    slopes = slopes_of(scan_mesh.materials[0].normal_map)
    found = filtered(scan_mesh, relief(slopes, 1.5 * strength), m, 64)
    none, own = found["none"], found["filter"]
    assert abs(own.energy) <= 0.1
    assert own.l1 <= 0.75 * none.l1
    assert own.flip < none.flip


@pytest.mark.slow
def test_slope_filter_reduces_flicker(egl, scan_mesh):
    texture = relief(slopes_of(scan_mesh.materials[0].normal_map), 4.0)
    beyond = flicker(scan_mesh, texture, 0.15, 96, (-20.0, -19.8, -19.6))
    assert beyond["none"] > 0.0
    assert beyond["filter"] < 0.5 * beyond["none"]


@pytest.mark.first_case
@pytest.mark.parametrize("m", [0.15, 0.3])
@pytest.mark.parametrize(
    ("angle", "radius", "most"), [(20.0, 20.0, 0.03), (60.0, 20.0, 0.07), (110.0, 10.0, 0.1)]
)
def test_area_lights_are_close_to_their_integral(angle, radius, most, m):
    none, own = disc(angle, radius, m, points=150, side=40)
    assert own <= most
    assert own < none


@pytest.mark.parametrize(("degrees", "bound"), [(2, 0.0063), (10, 0.0063), (20, 0.01), (30, 0.01)])
def test_cosine_of_a_disc_is_close_to_the_integral(degrees, bound):
    radius = np.radians(degrees)
    fractions = (np.arange(100) + 0.5) / 100.0
    cosines, turns = np.meshgrid(1.0 - fractions * (1.0 - np.cos(radius)), 2.0 * np.pi * fractions)
    sines = np.sqrt(1.0 - cosines**2)
    centres = np.linspace(-1.0, 1.0, 201)
    n_dot_l = [c * cosines + np.sqrt(1.0 - c * c) * sines * np.cos(turns) for c in centres]
    integrals = [np.maximum(cosine, 0.0).mean() for cosine in n_dot_l]
    approximated = brdf.cosine_disc(centres, np.sin(radius), (1.0 + np.cos(radius)) / 2.0)
    assert np.abs(approximated - integrals).max() <= bound
