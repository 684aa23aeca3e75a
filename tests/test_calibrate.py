"""Tests ``facerender compare --calibrate``: limits from pairs of images that must pass, their
messages, and the ini file that stores them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from facerender.commands import main
from facerender.comparison.calibration import (
    MARGIN,
    NAMES,
    Calibration,
    calibration_of,
    read_limits,
    runs_of,
    text_of,
)
from facerender.comparison.compare import compare
from facerender.comparison.result import LIMITS
from facerender.comparison.sources import HIGHEST
from facerender.errors import InputError
from facerender.images.files import png_bytes, save_exr
from facerender.images.image import encode_srgb8

SIDE = 128
OPEN = dict.fromkeys(NAMES, HIGHEST)
NOTED = {name: (value, f"sees {name}") for name, value in asdict(LIMITS["linear"]).items()}
NOTED_8_BIT = {name: (value, f"sees {name}") for name, value in asdict(LIMITS["srgb8"]).items()}
LOOSE = dict.fromkeys(NAMES, (1e6, "sees nothing"))


def picture(gain: float = 1.0, noise: float = 0.0) -> np.ndarray:
    """Return an image of skin with a highlight and fine detail, on black."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE - 0.5
    shape = 0.3 + 0.6 * np.exp(-((x - 0.1) ** 2 + (y + 0.1) ** 2) / 0.02)
    shape *= 1.0 + 0.003 * rng.standard_normal((SIDE, SIDE))
    color = shape[..., None] * (1.0, 0.7, 0.5)
    color *= gain * (1.0 + noise * np.random.default_rng(8).standard_normal((SIDE, SIDE, 1)))
    inside = x**2 + y**2 < 0.2
    return np.dstack([color * inside[..., None], inside]).astype(np.float32)


class Runs:
    """Folders of images, one per run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, run: str, pixels: np.ndarray, name: str = "head.exr") -> Path:
        path = self.folder / run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            path.write_bytes(png_bytes(encode_srgb8(pixels[..., :3]), {}))
        else:
            save_exr(path, pixels, {})
        return path

    def calibration(self) -> Calibration:
        (found,) = calibration_of(runs_of(self.folder))
        return found

    def __str__(self) -> str:
        return str(self.folder)


@pytest.fixture
def runs(tmp_path) -> Runs:
    return Runs(tmp_path / "runs")


@pytest.fixture(scope="module")
def equal(tmp_path_factory) -> Calibration:
    """The calibration of two equal runs."""
    runs = Runs(tmp_path_factory.mktemp("equal"))
    for run in ("one", "two"):
        runs.add(run, picture())
    return runs.calibration()


@pytest.fixture
def wide(runs) -> Runs:
    """Two runs that differ by 0.8 % in exposure."""
    runs.add("one", picture())
    runs.add("two", picture(1.008))
    return runs


# --- limits --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_equal_pairs_need_the_default_limits(equal):
    assert (equal.pairs, equal.limits, equal.needed) == (1, LIMITS["linear"], {})
    assert equal.blind == []


@pytest.mark.slow
def test_limits_fit_the_worst_pair_with_a_margin(wide):
    wide.add("one", picture(), "mild.exr")
    wide.add("two", picture(1.002), "mild.exr")
    found = wide.calibration()
    assert found.least.block == pytest.approx(0.009, rel=0.2)
    assert found.limits.block == pytest.approx(MARGIN * found.least.block, rel=0.1)
    assert found.needed["block"] == "two/head.exr"
    assert found.limits.point == LIMITS["linear"].point
    assert "two/head.exr needs 0.0" in found.noted["block"][1]
    one, two = (wide.folder / run / "head.exr" for run in ("one", "two"))
    assert not compare(one, two).same
    assert compare(one, two, **asdict(found.limits)).same
    tight = asdict(found.limits) | {"block": 0.9 * found.least.block}
    assert not compare(one, two, **tight).same


@pytest.mark.slow
def test_no_limit_is_wider_than_by_default_for_the_margin_alone(runs):
    runs.add("one", picture())
    runs.add("two", picture(1.003))
    found = runs.calibration()
    assert found.limits.block == LIMITS["linear"].block
    assert "wider" not in found.noted["block"][1]
    assert compare(
        *(runs.folder / run / "head.exr" for run in ("one", "two")), **asdict(found.limits)
    )


@pytest.mark.parametrize("name", ["point", "block", "trend", "grain", "texture"])
def test_limits_detect_the_stated_change_and_not_half_of_it(equal, name):
    b, by = picture(), equal.sees[name]
    color = b[..., :3]
    lit = b[..., 3] > 0
    noise = np.random.default_rng(5).standard_normal((SIDE, SIDE, 1))
    fine = color - 0.5 * (np.roll(color, 1, axis=1) + np.roll(color, -1, axis=1))
    above = np.maximum(color - np.median(color[lit], axis=0), 0.0)
    spot = np.zeros((SIDE, SIDE, 1))
    spot[90, 40:42] = 1.0  # outside the highlight
    change = {
        "point": spot,
        "block": color,
        "trend": above,
        "grain": color * noise,
        "texture": fine,
    }[name]
    for factor, same in ((1.5, False), (0.5, True)):
        changed = b.copy()
        changed[..., :3] += (factor * by * change).astype(np.float32)
        given = OPEN | {"shift": equal.limits.shift, name: getattr(equal.limits, name)}
        if name == "trend":
            given["block"] = equal.limits.block
        result = compare(b, changed, **given)
        assert (not result.changed_alike if name == "trend" else result.same) is same


@pytest.mark.slow
def test_masked_pixels_are_ignored(wide):
    a = picture()
    a[:, : SIDE // 2, :3] = 0.5
    wide.add("one", a)
    a[:, : SIDE // 2, :3] *= 1.05
    wide.add("two", a)
    mask = np.zeros((SIDE, SIDE))
    mask[:, SIDE // 2 :] = 1.0
    (found,) = calibration_of(runs_of(wide.folder), mask)
    assert found.limits == LIMITS["linear"]
    assert 5e-4 < found.sees["block"] < 0.01
    assert found.sees["point"] < 0.1


@pytest.mark.slow
def test_images_of_8_bits_have_limits_of_their_own(wide):
    wide.add("one", picture(), "head.png")
    wide.add("two", picture(1.02), "head.png")
    linear, encoded = calibration_of(runs_of(wide.folder))
    assert (linear.encoding, encoded.encoding) == ("linear", "srgb8")
    assert encoded.limits.block > 1.0
    assert encoded.sees["point"] >= 1.0
    assert encoded.noted["point"][1].endswith("of 255 or more")
    one, two = (wide.folder / run / "head.png" for run in ("one", "two"))
    assert not compare(one, two).same
    assert compare(one, two, **asdict(encoded.limits)).same
    for factor, same in ((1.2, False), (0.8, True)):  # of the detectable exposure change
        gain = 1.02 * (1.0 - factor * encoded.sees["block"])
        other = wide.add("three", picture(gain), "head.png")
        limits = OPEN | {"shift": encoded.limits.shift, "block": encoded.limits.block}
        assert compare(one, other, **limits).same is same


@pytest.mark.slow
def test_limits_of_black_images(runs):
    for run in ("one", "two", "three"):
        runs.add(run, np.zeros((32, 32, 3), np.float32))
    found = runs.calibration()
    assert (found.pairs, found.limits) == (3, LIMITS["linear"])
    assert found.noted["block"][1] == "does not detect an exposure change of any amount"
    json.dumps(found.as_dict(), allow_nan=False)


def test_invalid_pairs_are_refused(runs):
    a = picture()
    a[60:70:3, 60:70:3, :3] = 0.0
    runs.add("one", picture())
    runs.add("two", a)
    with pytest.raises(InputError, match=r"two/head.exr differs with any limits: holes: 16 pixels"):
        runs.calibration()
    runs.add("one", picture())
    runs.add("two", picture()[:64])
    with pytest.raises(InputError, match=r"one.head.exr is 128 x 128, .*render both at one size"):
        runs.calibration()
    runs.add("two", picture())
    runs.add("two", picture(), "body.exr")
    with pytest.raises(InputError, match=r"cannot read .*one.body.exr"):
        runs.calibration()


def test_folder_without_runs(runs):
    runs.add("one", picture())
    runs.add(".hidden", picture())
    with pytest.raises(InputError, match="fewer than two subfolders: give one for each run"):
        runs_of(runs.folder)
    with pytest.raises(InputError, match="cannot read .*nowhere: no such file"):
        runs_of(runs.folder / "nowhere")


# --- the file ------------------------------------------------------------------------------------


def written(path: Path, **noted: dict[str, tuple[float, str]]) -> Path:
    path.write_text(text_of(path, noted))
    return path


@pytest.mark.parametrize("name", ["pytest.ini", "setup.cfg", "pyproject.toml"])
@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig"])
def test_file_of_limits_is_read_as_it_was_written(tmp_path, name, coding):
    path = written(tmp_path / name, linear=NOTED, srgb8=NOTED_8_BIT)
    path.write_text(path.read_text(), encoding=coding)
    assert read_limits(path) == {
        "linear": asdict(LIMITS["linear"]),
        "srgb8": asdict(LIMITS["srgb8"]),
    }


TOML = "[tool.pytest.ini_options]\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[pytest]\nfacerender_point = much\n", "facerender_point = 'much': give a number"),
        ("[pytest]\nfacerender_point = -1\n", r"facerender_point = -1.0 is outside \[0, 1e"),
        ("[pytest]\naddopts = -q\n", "has no limit: add one, such as facerender_point"),
        ("[pytest]\naddopts = -q\n[pytest]\nx = 1\n", "cannot be read: .*; repair it"),
        ("[pytest\n", "cannot be read"),
        ("[pytest]\nx = \xff\n", "is not UTF-8"),
        (None, "cannot read .*missing"),
        (f"{TOML}facerender_point = [1]", "facerender_point = .1.: give a number"),
        (f"{TOML}facerender_point = 1{'0' * 400}", "facerender_point = 10.*0: give a number"),
        (f"{TOML}facerender_point = 1{'0' * 5000}", "is not valid TOML: Exceeds the limit"),
        (f"{TOML}{'a.' * 5000}b = 1", "is not valid TOML: nested too deep; correct it"),
    ],
)
def test_file_without_limits(tmp_path, content, message):
    path = tmp_path / ("missing.ini" if content is None else "pytest.ini")
    if content is not None:
        path = path.with_name("pyproject.toml") if TOML in content else path
        path.write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match=message):
        read_limits(path)


# --- the command ---------------------------------------------------------------------------------


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    status = main(["compare", *map(str, arguments)])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.slow
def test_command_writes_limits_that_it_reads(wide, tmp_path, capsys):
    path = tmp_path / "limits.ini"
    status, out, err = run(capsys, "--calibrate", wide)
    assert "pairs of linear images: 1, too few" in err
    assert run(capsys, "--calibrate", wide, "-o", path)[:2] == (0, "")
    assert (status, path.read_text()) == (0, out)
    assert "an exposure change of 1 %; wider than the default 0.005, since two/head.exr" in err
    limits = read_limits(path)["linear"]
    assert out.startswith("[pytest]\n# facerender_point: detects 2 pixels brightened by ")
    assert f"facerender_block = {limits['block']:g}\n" in out
    one, two = (wide.folder / run for run in ("one", "two"))
    assert run(capsys, one, two)[0] == 1
    assert run(capsys, one, two, "--limits", path)[0] == 0
    assert run(capsys, one, two, "--limits", path, "--block", 0.001)[0] == 1
    status, _, err = run(capsys, "--calibrate", wide, "-o", path)
    assert status == 2
    assert f"{path} exists: write to a new file" in err
    assert path.read_text() == out


def test_limits_of_a_file_are_for_the_images_of_their_encoding(runs, tmp_path, capsys):
    one, two = (runs.add(name, picture(gain), "head.png") for name, gain in (("a", 1), ("b", 1.02)))
    for encoding, status in (("linear", 1), ("srgb8", 0)):
        path = written(tmp_path / "pytest.ini", **{encoding: LOOSE})
        assert run(capsys, one, two, "--limits", path)[0] == status


@pytest.mark.slow
def test_json_warns_that_wider_limits_detect_less(wide, equal, capsys, tmp_path):
    status, out, _ = run(capsys, "--calibrate", wide, "--json")
    assert status == 0
    assert [each.name for each in tmp_path.iterdir()] == ["runs"]
    (found,) = json.loads(out)
    limit = found["limits"]["block"]
    assert limit > found["least"]["block"] > 0.005
    assert set(found["sees"]) == set(NAMES)
    assert found["sees"]["block"] > 0.01 > 0.005 > equal.sees["block"]
    (warning,) = (each for each in found["blind"] if "block" in each)
    assert warning.startswith(f"limit block = {limit:g} does not detect an exposure ")


def test_every_limit_is_an_option(wide, capsys):
    one, two = (wide.folder / run / "head.exr" for run in ("one", "two"))
    given = [part for name in NAMES for part in (f"--{name}", "1e6")]
    assert run(capsys, one, two, *given)[0] == 0
    assert "block at (" in run(capsys, one, two, *given, "--block", "0.005")[1]
    little = wide.add("two", picture(1.003))
    assert "changed alike" in run(capsys, one, little)[1]
    assert run(capsys, one, little, "--trend", "1e6")[0] == 0
    moved = wide.add("three", np.roll(picture(), 1, axis=1))
    assert "another mesh or camera" in run(capsys, one, moved, *given, "--shift", "0.1")[1]
    noisy = wide.add("four", picture(noise=0.01))
    assert "noise" in run(capsys, one, noisy, *given, "--grain", "0.001")[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--calibrate", "runs", "a.exr", "b.exr"), "leave out A"),
        (("--calibrate", "runs", "--same-driver"), "leave out --same-driver"),
        *(
            (("--calibrate", "runs", option, value), f"leave out {option}")
            for option, value in (("--block", "1"), ("--report", "x.html"), ("--limits", "x.ini"))
        ),
        (("a.exr",), "only one image: give A and B"),
        ((), "give A and B"),
        (("a.exr", "b.exr", "-o", "x.ini"), "-o writes the limits of --calibrate"),
        (("--calibrate", "runs", "-o", "nowhere/pytest.ini"), "cannot write nowhere"),
    ],
)
def test_options_that_exclude_each_other(wide, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(wide.folder.parent)
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (2, "")
    assert message in err
