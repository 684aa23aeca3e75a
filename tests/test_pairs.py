"""Tests the suite of image pairs (``tests.verification.pairs``): its files and index, and the
comparison of some pairs."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

import facerender as fr
from benchmarks.pairs import unchanged, verdicts
from benchmarks.pairs.suite import INDEX, SUITE, draw_missing, read_pairs, write_index
from benchmarks.pairs.verdicts import GROUPS, Judged, best, counted, score
from benchmarks.pairs.webgl import draw_webgl
from facerender.comparison.compare import compare
from facerender.images.files import read_image
from facerender.images.image import encode_srgb8
from tests.verification.pairs.draw import FLOORS, Pair, above_codec, slug, steps
from tests.verification.pairs.room import Room
from tests.verification.pairs.scenes import SETTINGS

SCENES = {
    "head-three-quarter": replace(SETTINGS["head-three-quarter"], size=256),
    "head-front": replace(SETTINGS["head-front"], size=256),
}
BROKEN = [
    *("exponent +5 %", "m +3 %", "f0 0.028 to 0.04", "exposure +2 %", "albedo decoded twice"),
    *("20 triangles missing", "2 black pixels", "3 fireflies", "D16 not clamped", "gamma 2.2"),
    *("12 false highlights at the silhouette", "light turned by 2 degrees"),
]
HARMLESS = [
    *("camera moved by 0.02 pixels in x", "camera moved by 0.02 pixels in y", "samples mirrored"),
    *("mean of other samples", "sample moved by 0.1 pixels", "vertices snapped", "noise of 5e-4"),
    *("dither of 1 step", "sRGB profile"),
]
# Changes that do not apply to a scene, because of its number of samples per pixel.
NOT_IN = {
    "head-front": ("samples mirrored", "mean of other samples"),
    "head-three-quarter": ("sample moved by 0.1 pixels",),
}


@pytest.fixture(
    scope="module",
    params=["head-front", pytest.param("head-three-quarter", marks=pytest.mark.slow)],
)
def scene(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def suite(scene, tmp_path_factory, egl) -> tuple[Path, list[Pair]]:
    folder = tmp_path_factory.mktemp("pairs")
    draw_missing(SCENES[scene], folder, [*BROKEN, *HARMLESS])
    return folder, write_index(folder)


@pytest.fixture
def room(request, egl) -> Iterator[Room]:
    """The room of a setting in a small size."""
    name, size = request.param
    room = Room(replace(SETTINGS[name], size=size))
    yield room
    room.renderer.release()


@pytest.mark.first_case
@pytest.mark.parametrize("change", [*BROKEN, *HARMLESS])
def test_comparison_judges_the_pairs_correctly(suite, scene, change):
    folder, pairs = suite
    own = [pair for pair in counted(pairs) if pair.change == change]
    assert bool(own) == (change not in NOT_IN[scene])
    for pair in own:
        result = compare(folder / pair.golden, folder / pair.image)
        assert result.same == (pair.must == "pass"), (pair.image, str(result))


def test_index_lists_all_files_and_only_missing_files_are_drawn(suite, scene):
    folder, pairs = suite
    assert read_pairs(folder / INDEX) == pairs
    files = {folder / each for pair in pairs for each in (pair.golden, pair.image)}
    assert files == {*folder.glob("*/*.exr"), *folder.glob("*/*.png")}
    wanted = (scene, "exposure +2 %", "exr")
    (pair,) = (each for each in pairs if (each.scene, each.change, each.format) == wanted)
    assert pair.effect == pytest.approx(2.0, abs=1e-3)
    assert pair.above_floor == (pair.effect > FLOORS["exr"])
    before = {file: file.stat().st_mtime_ns for file in files}
    (folder / scene / "2-black-pixels.exr").unlink()
    draw_missing(SCENES[scene], folder, [*BROKEN, *HARMLESS])
    times = {file: file.stat().st_mtime_ns for file in files if file.exists()}
    assert times.keys() == before.keys()
    changed = {file.name for file, time in times.items() if time != before[file]}
    assert changed == {"2-black-pixels.exr", "2-black-pixels.png"}


def test_the_groups_share_no_head_camera_or_light():
    for a, b in combinations(SETTINGS.values(), 2):
        if a.group != b.group:
            assert a.head != b.head
            assert a.camera != b.camera
            assert not {*a.lights} & {*b.lights}
            assert a.point is None or a.point != b.point
    assert {each.group for each in SETTINGS.values()} == {*GROUPS}


@pytest.mark.slow
def test_the_judge_has_jpegs_and_images_of_another_machine(tmp_path, monkeypatch, egl):
    scene = replace(SETTINGS["coarse-below"], size=96)
    monkeypatch.setattr(unchanged, "SETTINGS", {scene.name: scene})
    drawn = tmp_path / "drawn"
    monkeypatch.setattr("sys.argv", ["unchanged", str(drawn)])
    unchanged.main()
    assert {each.name for each in drawn.iterdir()} == {f"coarse-below-{n}.exr" for n in (1, 4)}
    assert read_image(drawn / "coarse-below-1.exr").pixels.dtype == np.float16
    names = ["exposure +2 %", "2 black pixels", "normal map's strength 0.95"]
    draw_missing(scene, tmp_path, names, drawn)
    pairs = write_index(tmp_path)
    machines = ["another machine", "another machine, 1 sample"]
    wanted = product([*names[:2], *machines], ("exr", "png", "jpeg"))
    assert {(pair.change, pair.format) for pair in pairs} == {*wanted}
    for pair in pairs:
        golden, image = (read_image(tmp_path / each) for each in (pair.golden, pair.image))
        assert golden.jpeg == image.jpeg == (pair.format == "jpeg")
        if pair.change in machines:
            assert pair.effect < {"exr": 0.05, "png": 0.1, "jpeg": 0.1}[pair.format]
            assert pair.samples == (1 if "1 sample" in pair.change else 4)
    assert all(pair.above_floor for pair in pairs if pair.change == "2 black pixels")


def test_the_effect_in_a_jpeg_is_relative_to_the_error_of_its_encoding():
    golden = np.full((16, 19, 3), 100.0)
    decoded = golden.astype(np.uint8)
    decoded[:8, :8] = 108
    image = golden.copy()
    assert above_codec(golden, image, decoded) == 0.0
    image[:8, :8, 1] += 12.0
    assert above_codec(golden, image, decoded) == pytest.approx(1.5)
    image[8:, 8:16, 2] -= 3.0
    assert above_codec(golden, image, decoded) == pytest.approx(3.0)


def test_facerender_judges_with_and_without_metadata(tmp_path, monkeypatch):
    pixels = np.full((32, 32, 3), 0.2, np.float32)
    for name in ("a", "b"):
        fr.Frame(pixels, None, False, {"GL_RENDERER": name}).save(tmp_path / f"{name}.exr")
    found = []
    monkeypatch.setattr(verdicts, "compare", lambda *images: found.append(images) or True)
    pair = Pair("s", "judge", "c", "pass", "exr", "a.exr", "b.exr", 1, 32, 9.0, True, False)
    assert verdicts.own(tmp_path, pair) == dict.fromkeys(verdicts.OWN, 0.0)
    metadata = [[each.metadata.get("GL_RENDERER") for each in images] for images in found]
    assert metadata == [["a", "b"], [None, None]]
    (named, unnamed) = verdicts.tallies(
        [Judged(pair, {verdicts.FACERENDER: 1.0, verdicts.UNNAMED: 0.0})]
    )
    assert (named.judge, named.different, named.pairs) == (verdicts.FACERENDER, 1, 1)
    assert (unnamed.judge, unnamed.different, unnamed.pairs) == (verdicts.UNNAMED, 0, 1)


def test_file_names_of_changes_are_unique():
    for a, b in combinations(SUITE, 2):
        assert slug(a) != slug(b)


@pytest.mark.parametrize("room", [("head-front", 64)], indirect=True)
def test_moved_camera_shifts_the_image(room):
    by = room.moved((1.0, -2.0))
    places = np.column_stack([0.05 * np.random.default_rng(1).normal(size=(50, 3)), np.ones(50)])
    a, b = (places @ view.matrix for view in (room.view, by))
    moved = 32.0 * (b[:, :2] / b[:, 3:] - a[:, :2] / a[:, 3:])
    np.testing.assert_allclose(moved, np.broadcast_to([-1.0, 2.0], moved.shape), rtol=0.1)


def test_steps_are_the_8_bit_image_before_rounding():
    linear = np.random.default_rng(1).uniform(0.0, 1.2, (8, 8, 4)).astype(np.float32)
    linear[..., :3] *= linear[..., 3:]
    for transparent in (False, True):
        frame = fr.Frame(linear, None, transparent, {})
        assert np.abs(steps(frame) - frame.srgb8()).max() < 0.65
    assert steps(fr.Frame(linear, None, False, {})).shape == encode_srgb8(linear[..., :3]).shape


def test_the_best_threshold_is_found():
    def pair(must, number):
        own = Pair("s", "report", str(number), must, "png", "a", "b", 1, 8, 9.0, True, False)
        return Judged(own, {"judge": number})

    judged = [pair("pass", each) for each in (0.1, 0.2, 0.9)]
    judged += [pair("fail", each) for each in (0.3, 0.4, 0.05)]
    found = best(judged, "judge")
    assert 0.2 < found.threshold < 0.3
    assert (found.caught, found.must_fail, found.alarms, found.must_pass) == (2, 3, 1, 3)
    assert found.balanced == pytest.approx(2.0 / 3.0)
    assert score(1.0, judged, "judge").balanced == 0.5


@pytest.mark.parametrize("room", [("parts-above", 96)], indirect=True)
def test_swiftshader_draws_the_scene(room, browser):
    how = room.setting.shading, room.size, room.setting.float_albedo
    image = draw_webgl(browser, room.scene, *how)
    apart = np.abs(image - room.golden)
    assert apart.mean() < 2e-3
    assert (apart.max(axis=-1) > 0.02).mean() < 0.01
