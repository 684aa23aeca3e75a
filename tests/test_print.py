"""Tests images for print: TIFF files, 16-bit PNG files, the sRGB chunk, the print resolution, scale
bars, and arcs of views. Files are parsed by Pillow, or here."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.commands.render import sheet
from facerender.images.files import read_image
from tests.awkward_files import MINI_HEAD
from tests.test_views import SMALL, Run, run

__all__ = ["run"]

SCALE = 0.75  # mm per pixel


@pytest.fixture(scope="module")
def drawn() -> Iterator[Callable[..., fr.Frame]]:
    mesh = fr.load_mesh(MINI_HEAD)
    with fr.Renderer((160, 120), samples=4) as renderer:
        yield lambda only=None, **scene: renderer.render(fr.Scene(mesh, **scene), only=only)


@pytest.fixture(scope="module")
def frame(drawn) -> fr.Frame:
    return drawn()


def chunks(content: bytes) -> dict[bytes, bytes]:
    """Return the chunks of a PNG file, in their order; see the PNG specification, section 5."""
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    found, offset = {}, 8
    while offset < len(content):
        (length,) = struct.unpack_from(">I", content, offset)
        name, data = content[offset + 4 : offset + 8], content[offset + 8 : offset + 8 + length]
        assert struct.unpack_from(">I", content, offset + 8 + length) == (zlib.crc32(name + data),)
        found[name] = data
        offset += 12 + length
    return found


def decoded16(content: bytes) -> np.ndarray:
    """Return the pixels of a 16-bit PNG file whose rows have the filter "Up", as uint16."""
    found = chunks(content)
    width, height, bits, color = struct.unpack(">IIBB", found[b"IHDR"][:10])
    assert bits == 16
    channels = {2: 3, 6: 4}[color]
    rows = np.frombuffer(zlib.decompress(found[b"IDAT"]), np.uint8).reshape(height, -1)
    assert (rows[:, 0] == 2).all()
    sums = rows[:, 1:].cumsum(axis=0, dtype=np.uint8)
    return sums.view(">u2").reshape(height, width, channels).astype(np.uint16)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return sRGB values in [0, 1] of linear values (IEC 61966-2-1), in float64."""
    x = np.clip(linear.astype(np.float64), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


# --- TIFF ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("background", [(0.1, 0.2, 0.3), None], ids=["opaque", "transparent"])
@pytest.mark.parametrize("name", ["a.tif", "a.TIFF"])
def test_tiff_files_have_the_pixels_and_the_metadata(drawn, background, name, tmp_path: Path):
    frame = drawn(background=background)
    frame.save(tmp_path / name, exposure=-1.0)
    with Image.open(tmp_path / name) as image:
        assert image.format == "TIFF"
        assert image.mode == ("RGBA" if background is None else "RGB")
        assert image.info["compression"] == "tiff_adobe_deflate"
        np.testing.assert_array_equal(np.asarray(image), frame.srgb8(-1.0))
        stored = json.loads(image.tag_v2[270])  # ImageDescription
    assert stored == {**frame.metadata, "exposure": "-1.0"}
    found = read_image(tmp_path / name)
    np.testing.assert_array_equal(found.pixels, frame.srgb8(-1.0))
    assert (found.metadata, found.profile, found.color_space) == (stored, "", "")
    frame.save(tmp_path / "b.png", exposure=-1.0)
    assert str(fr.compare(tmp_path / name, tmp_path / "b.png")) == "same"


@pytest.mark.parametrize("text", ["a face", "[1, 2]", "{", "[" * 100_000], ids=len)
def test_a_description_of_another_program_is_no_metadata(text, tmp_path: Path):
    pixels = np.full((4, 4, 3), 9, dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.tif", description=text)
    assert read_image(tmp_path / "a.tif").metadata == {}


# --- 16 bits -------------------------------------------------------------------------------------


@pytest.mark.parametrize("only", [None, "albedo"])
def test_16_bits_are_the_nearest_levels_of_srgb(drawn, only):
    frame = drawn(only)
    pixels = decoded16(frame.encoded(bits=16))
    assert np.abs(pixels - 65535.0 * srgb(frame.linear[..., :3])).max() <= 0.501
    assert len(np.unique(pixels)) > 2000  # not 8 bits, spread


def test_16_bits_of_a_transparent_image(drawn):
    frame = drawn(background=None)
    pixels, coverage = decoded16(frame.encoded(bits=16)), frame.linear[..., 3:]
    assert np.abs(pixels[..., 3:] - 65535.0 * coverage).max() <= 0.501
    straight = frame.linear[..., :3] / np.maximum(coverage, 1e-6)
    assert np.abs(pixels[..., :3] - 65535.0 * srgb(straight)).max() <= 0.51


@pytest.mark.parametrize(
    ("only", "settings"),
    [
        (None, {"exposure": -1.5}),
        (None, {"exposure": 2.0, "tone": "neutral"}),
        *((only, {}) for only in ("depth", "normal", "mask", "parts", "cosines")),
    ],
)
def test_16_bits_and_8_bits_show_the_same_image(drawn, only, settings):
    frame = drawn(only)
    fine, coarse = decoded16(frame.encoded(bits=16, **settings)), frame.srgb8(**settings)
    assert np.abs(fine / 65535.0 - coarse / 255.0).max() <= 0.5001 / 255.0


def test_the_range_of_a_16_bit_image_has_its_levels(drawn):
    frame = drawn("depth")
    with Image.open(BytesIO(frame.encoded(bits=16))) as image:
        white, _, near, dark, _, far, *_ = image.text["range"].replace(",", "").split()
    pixels, depth = decoded16(frame.encoded(bits=16))[..., 0], frame.linear[..., 0]
    covered = frame.linear[..., 3] == 1.0
    assert (int(white), int(dark)) == (pixels[covered].max(), pixels[covered].min())
    assert depth[pixels == int(white)] == pytest.approx(float(near))
    assert depth[covered & (pixels == int(dark))] == pytest.approx(float(far))


# --- sRGB ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("only", [None, "specular", "albedo", "normal", "depth", "mask"])
def test_colours_state_srgb_and_data_do_not(drawn, only, bits):
    found = chunks(drawn(only).encoded(bits=bits))
    if only in (None, "specular", "albedo"):
        assert found[b"sRGB"] == b"\0"
        assert found[b"gAMA"] == struct.pack(">I", 45455)
        assert [*found].index(b"gAMA") < [*found].index(b"IDAT")
    else:
        assert not {b"sRGB", b"gAMA"} & found.keys()


def test_a_file_with_the_chunk_is_compared_as_srgb(frame, tmp_path: Path):
    frame.save(tmp_path / "a.png")
    Image.fromarray(frame.srgb8()).save(tmp_path / "b.png")  # without the chunk
    assert read_image(tmp_path / "a.png").color_space == ""
    assert str(fr.compare(tmp_path / "a.png", tmp_path / "b.png")) == "same"


# --- print resolution ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dpi", "scale", "expected"),
    [(300, None, 300.0), (72.5, SCALE, 72.5), (None, SCALE, 25.4 / SCALE), (None, None, None)],
)
def test_files_store_the_print_resolution(frame, dpi, scale, expected):
    frame = replace(frame, mm_per_pixel=scale)
    for bits in (8, 16):
        size = chunks(frame.encoded(bits=bits, dpi=dpi)).get(b"pHYs")
        per_metre = expected and round(expected / 0.0254)
        assert size == (expected and struct.pack(">IIB", per_metre, per_metre, 1))
    for kind in ("tiff", "jpeg", "webp"):
        with Image.open(BytesIO(frame.encoded(kind, dpi=dpi))) as image:
            tags, info = image.getexif(), image.info
        assert (tags.get(296) == 2) == (expected is not None)  # ResolutionUnit: inch
        for tag in (282, 283):
            assert tags.get(tag) == (expected and pytest.approx(expected))
        if kind == "jpeg":
            density = info["jfif_unit"], *info["jfif_density"]
            assert density == ((1, *[round(expected)] * 2) if expected else (0, 1, 1))


def test_the_true_scale_is_exact_in_metres(frame):
    found = chunks(replace(frame, mm_per_pixel=0.16).encoded())
    assert struct.unpack(">IIB", found[b"pHYs"]) == (6250, 6250, 1)


@pytest.mark.parametrize("scale", [1e-7, 100.0])
def test_a_scale_that_no_format_stores_is_left_out(frame, scale):
    tiny = replace(frame, mm_per_pixel=scale)
    assert b"pHYs" not in chunks(tiny.encoded())
    with Image.open(BytesIO(tiny.encoded("jpeg"))) as image:
        assert image.info["jfif_unit"] == 0


# --- scale bars ----------------------------------------------------------------------------------


def flat(value: float, size: tuple[int, int], scale: float, clear: bool = False) -> fr.Frame:
    linear = np.full((*size[::-1], 4), value, dtype=np.float32)
    linear[..., 3] = not clear
    return fr.Frame(linear, None, clear, {}, mm_per_pixel=scale)


def longest_run(row: np.ndarray) -> int:
    """Return the largest number of consecutive true values."""
    return max(map(len, "".join("x" if value else " " for value in row).split()), default=0)


@pytest.mark.parametrize(
    ("scale", "length"), [(1.0, 100), (0.99, 50), (0.5, 50), (0.3, 20), (0.01, 1), (200.0, 20_000)]
)
@pytest.mark.parametrize("bits", [8, 16])
def test_the_bar_has_a_round_length_in_pixels(scale, length, bits):
    frame = flat(0.0, (400, 300), scale)
    content = frame.encoded(bits=bits, scale_bar=True)
    pixels = decoded16(content) if bits == 16 else np.asarray(Image.open(BytesIO(content)))
    white = (pixels == 2**bits - 1).all(axis=-1)
    assert max(map(longest_run, white)) == round(length / scale)
    rows, columns = np.nonzero(white)
    assert rows.min() > 240  # in the lower right corner
    assert columns.min() > 250
    assert max(rows.max() + 1 - 300, columns.max() + 1 - 400) < 0
    assert (frame.linear[..., :3] == 0.0).all()


@pytest.mark.parametrize(
    ("value", "clear", "ink"), [(0.0, False, 255), (1.0, False, 0), (0.0, True, 0)]
)
def test_the_bar_contrasts_with_the_image(value, clear, ink):
    frame = flat(value, (200, 200), 1.0, clear)
    before, after = frame.srgb8(), frame.srgb8(scale_bar=True)
    changed = (before != after).any(axis=-1)
    inked = (
        changed & (after[..., :3] == ink).all(axis=-1) & (after[..., -1] == (255 if clear else ink))
    )
    assert max(map(longest_run, inked)) == 50
    if clear:
        assert (after[changed, 3] > 0).all()
        assert (after[~changed, 3] == 0).all()


def test_the_bar_has_an_outline():
    grey = flat(0.3, (200, 200), 1.0)
    pixels = grey.srgb8(scale_bar=True)[..., 0]
    assert pixels.min() == 0
    assert pixels.max() == 255
    row = int(np.argmax([longest_run(line == 0) for line in pixels]))
    assert longest_run(pixels[row] == 0) >= 50


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (200, 3), (16, 16)])
def test_the_bar_fits_into_every_image(size):
    assert flat(0.0, size, 1.0).srgb8(scale_bar=True).max() == 255


def test_the_label_depends_on_the_length():
    bars = [flat(0.0, (400, 300), scale).srgb8(scale_bar=True) for scale in (0.5, 5.0, 0.5)]
    assert (bars[0] == bars[2]).all()
    assert (bars[0] != bars[1]).any()  # 50 mm and 500 mm, of equal length in pixels


def test_a_sheet_keeps_the_scale_of_its_images(frame):
    scaled = replace(frame, mm_per_pixel=SCALE)
    assert sheet([scaled] * 3, 3).mm_per_pixel == SCALE
    assert sheet([scaled, frame], 2).mm_per_pixel is None  # one bar would be wrong
    assert sheet([frame, scaled], 2).mm_per_pixel is None


# --- settings ------------------------------------------------------------------------------------


def test_an_output_has_all_settings_of_a_file(frame, tmp_path: Path):
    scaled = replace(frame, mm_per_pixel=SCALE)
    settings: dict[str, Any] = {"exposure": 1.0, "tone": "neutral", "bits": 16, "dpi": 150}
    output = fr.Output(tmp_path / "a.png", **settings, scale_bar=True)
    scaled.save(output)
    expected = scaled.encoded("png", **settings, scale_bar=True)
    assert (tmp_path / "a.png").read_bytes() == expected == scaled.encoded(output)
    assert expected != scaled.encoded("png", **settings)
    scaled.save(file := BytesIO(), **settings, scale_bar=True)
    assert file.getvalue() == expected


def test_scene_files_have_the_settings(tmp_path: Path):
    settings = "bits = 16\ndpi = 300\nscale_bar = true\n"
    (tmp_path / "scene.toml").write_text(f"[[outputs]]\npath = 'a.png'\n{settings}")
    job = fr.Job.load(tmp_path / "scene.toml")
    assert job.outputs == (fr.Output("a.png", bits=16, dpi=300.0, scale_bar=True),)
    (tmp_path / "again.toml").write_text(job.toml())
    assert fr.Job.load(tmp_path / "again.toml") == job


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        *((name, {"bits": 16}, "bits = 16 is for .png only") for name in ("a.tif", "a.exr")),
        ("a.png", {"bits": 12}, "bits = 12: give one of 8, 16"),
        ("a.exr", {"dpi": 300}, "dpi = 300 is not for .exr: give .png, .tif, .jpg or .webp"),
        ("a.exr", {"scale_bar": True}, "scale_bar is not for .exr: give .png"),
        ("a.png", {"dpi": 0.5}, r"dpi = 0.5 is outside \[1, 10000\]"),
        ("a.png", {"scale_bar": True}, "an orthographic camera .*and a known unit"),
    ],
)
def test_settings_that_do_not_fit_write_no_file(frame, name, settings, message, tmp_path: Path):
    with pytest.raises(fr.InputError, match=message):
        frame.save(tmp_path / name, **settings)
    assert not [*tmp_path.iterdir()]


def test_options_write_the_settings(run: Run):
    assert run("--bits", "16", "--dpi", "300", "-o", "a.png") == (0, ["a.png"], "")
    expected = fr.render(MINI_HEAD, size=(24, 24), samples=1).encoded(bits=16, dpi=300)
    assert Path("a.png").read_bytes() == expected
    assert run("--camera", "turntable:2", "--sheet", "--bits", "16", "-o", "s.png")[0] == 0
    assert decoded16(Path("s.png").read_bytes()).shape == (24, 48, 3)


def test_standard_output_has_the_settings(capfdbinary: pytest.CaptureFixture[bytes]):
    assert main([*SMALL, "--dpi", "300", "--format", "tiff", "-o", "-"]) == 0
    expected = fr.render(MINI_HEAD, size=(24, 24), samples=1).encoded("tiff", dpi=300)
    assert capfdbinary.readouterr().out == expected


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--bits 16 -o a.jpg", "bits = 16 is for .png only, and the image is jpeg: give .png"),
        ("--bits 16 -o - --format tiff", "bits = 16 is for .png only"),
        ("--dpi 300 -o a.exr", "dpi = 300 is not for .exr"),
        ("--scale-bar -o a.exr", "scale_bar is not for .exr"),
        ("--scale-bar -o a.png", "give an orthographic camera (--orthographic, --mm-per-pixel)"),
        ("--scale-bar --camera turntable:2 -o a.gif", "give an orthographic camera"),
        (
            "--bits 16 --camera turntable:2 -o a.gif",
            "--bits 16 and --dpi: a.gif is an animation; leave them out",
        ),
        ("--dpi 99 --camera turntable:2 -o a.webp", "--bits 16 and --dpi: a.webp is an animation"),
        ("--dpi 0 -o a.png", "dpi = 0.0 is outside [1, 10000]"),
        ("--camera turntable:3,9 -o a.gif", "give turntable:N,FROM..TO, in degrees"),
        ("--camera turntable:3,left..9 -o a.gif", "give turntable:N,FROM..TO, in degrees"),
        ("--camera turntable:3,0..9e9 -o a.gif", "arc = 9000000000.0 is outside [-3600, 3600]"),
        ("--camera turntable:,0..9 -o a.gif", "give turntable:N, with 1 to 3600 views"),
    ],
)
def test_options_that_do_not_fit_write_no_file(run: Run, options: str, message: str):
    status, out, err = run(*options.split())
    assert (status, out, err.count("\n")) == (2, [], 1)
    assert message in err
    assert not [*Path().iterdir()]


# --- arcs ----------------------------------------------------------------------------------------


def test_an_arc_includes_both_ends():
    camera = fr.Camera(90.0, 10.0, frame="face")  # only the elevation and the frame count
    arc = fr.turntable(camera, 5, arc=(-60, 60))
    assert arc == tuple(replace(camera, azimuth=a) for a in (-60.0, -30.0, 0.0, 30.0, 60.0))
    assert [each.azimuth for each in fr.turntable(count=3, arc=[60, -60])] == [60.0, 0.0, -60.0]
    assert [each.azimuth for each in fr.turntable(count=1, arc=(-60, 60))] == [-60.0]


@pytest.mark.parametrize("arc", [60, (60,), (1, 2, 3), "60"])
def test_an_arc_has_two_azimuths(arc):
    with pytest.raises(fr.InputError, match=r"arc = .*: give two azimuths, such as \(-60, 60\)"):
        fr.turntable(count=3, arc=arc)


def test_the_option_draws_an_arc(run: Run):
    assert run("--camera", "turntable:3,-60..60", "-o", "a.png")[0] == 0
    names = [f"a_{index:03d}.png" for index in range(3)]
    for name, azimuth in zip(names, ("-60", "0", "60"), strict=True):
        assert run(f"--camera={azimuth}", "-o", "b.png")[0] == 0
        np.testing.assert_array_equal(np.asarray(Image.open(name)), np.asarray(Image.open("b.png")))
