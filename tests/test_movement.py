"""Tests goldens that store the range of each pixel over small camera shifts: which images pass,
which fail, and the content of the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import facerender as fr
from facerender.comparison.compare import compare
from facerender.comparison.goldens import FARTHEST, SHIFTS, Updates, check, range_of
from facerender.comparison.neighbourhoods import explained
from facerender.comparison.sources import HIGHEST
from facerender.errors import InputError
from facerender.images.image import ImageData
from facerender.images.read import read_image
from tests.verification.lights import PLAIN_THREE

SIZE = (160, 160)
STRANDS = 40
# The range does not apply to these checks.
OTHERS = dict.fromkeys(("block", "trend", "grain", "texture"), HIGHEST)
MISSING = Updates(missing=True)


def strands() -> fr.Mesh:
    """Return dark strands, half a pixel wide, in front of a bright, slightly irregular quad."""
    rng = np.random.default_rng(0)
    top = rng.uniform(-0.8, 0.8, STRANDS)
    bottom, width = top + rng.uniform(-0.3, 0.3, STRANDS), 0.5 * 2.0 / SIZE[0]
    positions = [(-1.0, -1.0, 0), (1.1, -0.9, 0), (1.0, 1.1, 0), (-1.1, 1.0, 0)]
    faces = [(0, 1, 2), (0, 2, 3)]
    for low, high in zip(bottom, top, strict=True):
        first = len(positions)
        positions += [(low, -0.9, 0.1), (low + width, -0.9, 0.1)]
        positions += [(high + width, 0.9, 0.1), (high, 0.9, 0.1)]
        faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    colors = np.full((len(positions), 3), 0.05)
    colors[:4] = 0.6, 0.4, 0.3
    return fr.Mesh.from_arrays(positions, faces, colors=colors)


class Studio:
    def __init__(self, renderer: fr.Renderer, mesh: fr.Mesh) -> None:
        self.renderer, self.scene = renderer, fr.Scene(mesh, lights=PLAIN_THREE)
        self.calls = 0

    def draw(self, x: float = 0.0, y: float = 0.0) -> fr.Frame:
        self.calls += 1
        return self.renderer.render(fr.shifted(self.scene, x, y, SIZE))


@pytest.fixture(scope="module", params=[1, 4])
def studio(request, egl) -> Iterator[Studio]:
    with fr.Renderer(SIZE, samples=request.param, backend=egl) as renderer:
        yield Studio(renderer, strands())


@pytest.fixture(scope="module")
def goldens(studio, tmp_path_factory) -> tuple[Path, Path]:
    """Paths of a golden without the range, and of one with it."""
    folder = tmp_path_factory.mktemp("goldens")
    plain, ranged = folder / "plain.exr", folder / "kept.exr"
    check("plain", studio.draw(), plain, MISSING)
    check("kept", studio.draw(), ranged, MISSING, draw=studio.draw)
    return plain, ranged


@pytest.mark.slow
def test_shifts_surround_the_centre(goldens):
    places = np.array(SHIFTS)
    assert np.hypot(*places.T).max() == pytest.approx(FARTHEST, rel=1e-4)
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=1e-6)


@pytest.mark.parametrize("move", [(0.02, 0.0), (0.05, 0.0), (0.03, -0.04), (-0.08, 0.0)])
def test_movement_passes_with_a_range_in_the_golden(studio, goldens, move):
    plain, ranged = goldens
    image = studio.draw(*move)
    assert compare(ranged, image, **OTHERS), str(compare(ranged, image, **OTHERS))
    if studio.renderer.samples == 1 and move[0] != 0.02:
        assert not compare(plain, image, **OTHERS)


def test_coverage_of_a_drawn_shift_is_explained(studio, goldens):
    image = studio.draw(*SHIFTS[1])
    assert compare(goldens[0], image).coverage > 0.0
    assert compare(goldens[1], image).coverage == 0.0


@pytest.mark.first_case
@pytest.mark.parametrize("value", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("seed", range(2))
def test_wrong_pixels_fail(goldens, value, seed):
    plain, ranged = (read_image(path) for path in goldens)
    rows, columns = np.random.default_rng(seed).choice(np.argwhere(plain.coverage >= 1.0), 3).T
    pixels = plain.pixels.copy()
    pixels[rows, columns, :3] = value
    broken = replace(plain, pixels=pixels)
    assert compare(ranged, broken).same == compare(plain, broken).same
    assert not compare(ranged, broken) or value == 0.0  # a black pixel may look like a strand


def test_black_pixel_does_not_count_as_background(goldens):
    """If a shift uncovers the background, the range explains only pixels that are not covered."""
    ranged = read_image(goldens[1])
    uncovers = (ranged.shift_range.high[..., 3] - ranged.shift_range.low[..., 3] > 0.2) & (
        ranged.coverage >= 1.0
    )
    assert uncovers.any()
    black = np.full_like(ranged.color, 0.012)  # similar to the background
    assert not explained(ranged.shift_range, black, ranged.coverage, 0.005)[0][uncovers].any()
    gone = ranged.shift_range.low[..., 3].astype(np.float32)
    bare = uncovers & (gone < 0.5)
    assert explained(ranged.shift_range, black, gone, 0.005)[0][bare].all()


def test_range_is_stored_in_standard_exr_layers(goldens, studio):
    plain, ranged = goldens
    with OpenEXR.File(str(ranged), separate_channels=True) as file:
        names = set(file.channels())
        assert {each.pixels.dtype for each in file.channels().values()} == {np.dtype(np.float16)}
    assert names == {
        f"{layer}{name}" for layer in ("", "moved_down.", "moved_up.") for name in "RGBA"
    }
    a, b = read_image(plain), read_image(ranged)
    np.testing.assert_allclose(a.pixels, b.pixels, rtol=2.0**-10)
    assert a.shift_range is None
    assert ranged.stat().st_size < 1.75 * plain.stat().st_size
    for x, y in ((0.0, 0.0), SHIFTS[3]):
        linear = studio.draw(x, y).linear
        covered = linear[..., 3] >= 0.5
        assert (b.shift_range.low <= linear)[covered].all()
        assert (b.shift_range.high >= linear)[covered].all()


def test_range_is_rounded_outwards_within_half_floats():
    values = np.array([[[0.1, 1e6, -0.1]]], np.float32)
    least, most = range_of(
        [ImageData(values, "linear", "a"), ImageData(2.0 * values, "linear", "b")]
    )
    assert (least[0, 0, [0, 2]] < [0.1, -0.2]).all()
    assert (most[0, 0, [0, 2]] > [0.2, -0.1]).all()
    assert not np.isnan([least, most]).any()


@pytest.mark.first_case
@pytest.mark.parametrize("ranged", [False, True])
@pytest.mark.parametrize(
    ("scale", "limits", "bits"),
    [(1.0, {}, 16), (50.0, {}, 24), (1e6, {}, 32), (1.0, {"point": 0.0}, 32)],
)
def test_golden_is_rounded_by_a_part_of_the_limits(tmp_path, ranged, scale, limits, bits):
    values = np.random.default_rng(1).random((48, 64, 3), np.float32) * np.float32(scale)
    draw = (lambda x, y: values) if ranged else None
    check("a", values, tmp_path / "a.exr", MISSING, draw=draw, **limits)
    stored = read_image(tmp_path / "a.exr")
    bits = bits if ranged else max(bits, 24)
    error = (np.abs(stored.pixels - values) / values).max()
    assert error <= {16: 2.0**-11, 24: 2.0**-16, 32: 0.0}[bits] < 1000.0 * error + (bits == 32)
    assert (stored.shift_range is not None) == ranged
    assert check("a", values, tmp_path / "a.exr", **limits).failure == ""


@pytest.mark.slow
@pytest.mark.parametrize("studio", [1], indirect=True)
def test_draw_is_called_only_when_a_golden_is_written(studio, goldens, tmp_path):
    before = studio.calls
    image = studio.draw()
    check("a", image, goldens[0], draw=studio.draw)
    check("a", image, tmp_path / "none.exr", draw=studio.draw)
    assert studio.calls == before + 1
    check("a", image, tmp_path / "none.exr", MISSING, draw=studio.draw)
    assert studio.calls == before + 1 + len(SHIFTS)


@pytest.mark.slow
@pytest.mark.parametrize("studio", [1], indirect=True)
@pytest.mark.parametrize(
    ("factor", "size", "message"),
    [
        (10.0, SIZE, "draw shifts the image by .* times its arguments: interpret these as pixels"),
        (1.0, (80, 80), r"the result of draw\(0.1, 0\) is 80 x 80 pixels: render both at one size"),
    ],
)
def test_wrong_draw_functions_are_refused(studio, tmp_path, factor, size, message):
    def draw(x: float, y: float) -> np.ndarray:
        pixels = studio.draw(factor * x, factor * y).linear
        return pixels[: size[1], : size[0]]

    with pytest.raises(InputError, match=message):
        check("a", studio.draw(), tmp_path / "a.exr", MISSING, draw=draw)
    assert not list(tmp_path.iterdir())


def test_shifted_scene_moves_right_and_down(studio):
    linear, moved = studio.draw().linear, studio.draw(3.0, 2.0).linear
    np.testing.assert_allclose(moved[2:, 3:], linear[:-2, :-3], atol=0.02)
    np.testing.assert_allclose(studio.renderer.render(studio.scene).linear, linear, atol=1e-3)
