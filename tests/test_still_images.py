"""Tests images that Pillow reads: formats, frames, orientation and modes, as files and in memory.
An image that cannot be compared pixel by pixel is an error, so that no change passes unseen."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

import facerender as fr
from facerender.comparison.compare import compare
from facerender.images.files import read_image
from tests.test_cli import Capture, Cli, process

BEFORE = np.full((24, 32, 3), 60, dtype=np.uint8)
BEFORE[4:20, 6:26] = 180, 120, 90
AFTER = BEFORE.copy()
AFTER[7:11, 12:16] = 250
LOSSLESS = (".png", ".webp", ".tif", ".tiff", ".gif", ".bmp", ".tga", ".TIF")
OPTIONS: dict[str, dict[str, object]] = {".webp": {"lossless": True}, ".jpg": {"quality": 95}}


@pytest.fixture
def cli(tmp_path: Path, capsys: Capture) -> Cli:
    return Cli(tmp_path, capsys)


def opened(path: Path) -> Image.Image:
    """Return a Pillow image that leaves no file open."""
    return Image.open(io.BytesIO(path.read_bytes()))


def save(path: Path, image: Image.Image | np.ndarray, **options: object) -> Path:
    """Write an image in the format of the suffix."""
    image = Image.fromarray(image) if isinstance(image, np.ndarray) else image
    path.parent.mkdir(exist_ok=True)
    image.save(path, **{**OPTIONS.get(path.suffix.lower(), {}), **options})
    return path


# --- formats -------------------------------------------------------------------------------------


def test_folders_are_compared_in_every_still_format(cli: Cli, tmp_path):
    for number, suffix in enumerate((*LOSSLESS, ".jpg")):
        save(tmp_path / f"a/{number}-equal{suffix}", BEFORE)
        save(tmp_path / f"b/{number}-equal{suffix}", BEFORE)
        save(tmp_path / f"a/{number}-other{suffix}", BEFORE)
        save(tmp_path / f"b/{number}-other{suffix}", AFTER)
    status, out, _ = cli.run("compare", tmp_path / "a", tmp_path / "b")
    assert status == 1
    verdicts = dict(line.split(": ", 1) for line in out.splitlines())
    assert len(verdicts) == 2 * (len(LOSSLESS) + 1)
    for name, verdict in verdicts.items():
        assert (verdict == "same") == ("equal" in name), name


def test_folders_name_images_that_are_not_compared(cli: Cli, tmp_path):
    save(tmp_path / "a/same.png", BEFORE)
    save(tmp_path / "b/same.png", BEFORE)
    for folder in ("a", "b"):
        for name in ("plot.svg", "PHOTO.HEIC", "turn.mp4", "dump.ppm"):
            (tmp_path / folder / name).write_bytes(folder.encode())
        (tmp_path / folder / "notes.txt").write_text(folder)
    (tmp_path / "b/new.avif").write_bytes(b"b")
    status, out, err = cli.run("compare", tmp_path / "a", tmp_path / "b")
    assert (status, out) == (2, "same.png: same\n")
    lines = err.splitlines()
    for name in ("plot.svg", "PHOTO.HEIC", "turn.mp4", "dump.ppm"):
        suffix = Path(name).suffix.lower()
        assert any(f"{name}: unknown image format '{suffix}'; give .exr" in line for line in lines)
    assert lines[-3].endswith(f"new.avif is only in {tmp_path / 'b'}")
    assert len(lines) == 5


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("suffix", LOSSLESS)
def test_lossless_formats_have_the_pixels_of_the_png(suffix, mode, tmp_path):
    image = Image.fromarray(AFTER).convert(mode)
    if mode == "RGBA":
        image.paste((0, 0, 0, 0), (0, 0, 5, 24))  # a GIF has one transparent colour
    image = image.convert("RGB") if suffix == ".bmp" else image  # BMP files have no alpha
    path = save(tmp_path / f"a{suffix}", image)
    color, coverage = read_image(path).rows(slice(None))
    expected = read_image(save(tmp_path / "b.png", image)).rows(slice(None))
    np.testing.assert_array_equal(coverage, expected[1])
    np.testing.assert_array_equal(*np.broadcast_arrays(color, expected[0]))


def test_the_compression_of_a_file_is_no_metadata(tmp_path):
    packed, plain = (
        save(tmp_path / f"{name}.tif", AFTER, compression=name) for name in ("tiff_lzw", "raw")
    )
    assert str(compare(packed, plain)) == "same"
    assert str(compare(save(tmp_path / "a.tga", AFTER, rle=True), plain)) == "same"


def deep_tiff(samples: int, value: int) -> bytes:
    """Return a TIFF of 4 x 4 pixels with 16 bits a sample, which Pillow writes only for grey."""
    bits = 8 + 2 + 10 * 12 + 4  # position after the directory
    tags = {256: 4, 257: 4, 258: 16, 259: 1, 262: 2 if samples == 3 else 1, 273: bits + 8}
    tags |= {277: samples, 278: 4, 279: 32 * samples, 284: 1}
    entries = b""
    for tag, number in tags.items():
        count, number = (3, bits) if (tag, samples) == (258, 3) else (1, number)
        entries += struct.pack("<HHII", tag, 3, count, number)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    return head + struct.pack("<4H", 16, 16, 16, 0) + struct.pack("<H", value) * 16 * samples


@pytest.mark.parametrize("samples", [1, 3])
def test_tiff_files_with_more_than_8_bits_are_refused(samples, tmp_path, cli: Cli):
    for name, value in (("a.tif", 0x4000), ("b.tif", 0x40FF)):
        (tmp_path / name).write_bytes(deep_tiff(samples, value))
    message = r"a\.tif is a 16-bit TIFF: save it as EXR$"
    cli.fail(message, "compare", tmp_path / "a.tif", tmp_path / "b.tif")
    floats = Image.fromarray(np.linspace(0.0, 3.0, 64, dtype=np.float32).reshape(8, 8))
    floats.save(tmp_path / "c.tif")
    with pytest.raises(fr.InputError, match=r"c\.tif is a 32-bit TIFF: save it as EXR"):
        read_image(tmp_path / "c.tif")


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate"])
def test_a_damaged_tiff_is_one_line(compression, tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = save(tmp_path / "a.tif", noise, compression=compression)
    content = bytearray(path.read_bytes())
    content[700:900] = bytes(200)
    path.write_bytes(content)
    done = process("compare", path, path)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"facerender: error: \S*a\.tif is damaged .*; save it again\n", done.stderr)


def test_a_transparent_palette_is_saved_as_rgba(tmp_path):
    clear = Image.fromarray(BEFORE).quantize(8)
    path = save(tmp_path / "a.png", clear, transparency=0)
    with pytest.raises(fr.InputError, match=r"a\.png is a palette image: save it as RGBA"):
        read_image(path)


# --- frames --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".webp", ".gif", ".tif"])
def test_images_of_several_frames_are_refused(suffix, cli: Cli, tmp_path):
    first, second = (Image.fromarray(pixels) for pixels in (BEFORE, AFTER))
    pair = [
        save(tmp_path / f"{name}{suffix}", first, save_all=True, append_images=[second, last])
        for name, last in (("a", first), ("b", Image.new("RGB", first.size, "red")))
    ]
    cli.fail(rf"a{suffix} has 3 frames: save each as a file$", "compare", *pair)
    for path in pair:
        image = opened(path)
        with pytest.raises(fr.InputError, match=r"^A has 3 frames: give one as image\.convert\('"):
            compare(image, first)
    image.seek(2)
    assert not compare(image.convert("RGB"), first).same
    cli.fail("has 3 frames", "compare", pair[0], save(tmp_path / f"c{suffix}", first))


@pytest.mark.parametrize("suffix", [".png", ".webp", ".gif", ".tif"])
def test_an_animation_of_one_frame_is_an_image(suffix, tmp_path):
    path = save(tmp_path / f"a{suffix}", AFTER, save_all=True)
    assert compare(path, Image.fromarray(AFTER)).same


# --- orientation ---------------------------------------------------------------------------------

TURNED = {  # pixels as stored, for each value of the EXIF tag
    1: AFTER,
    2: AFTER[:, ::-1],
    3: AFTER[::-1, ::-1],
    4: AFTER[::-1],
    5: AFTER.swapaxes(0, 1),
    6: np.rot90(AFTER),
    7: AFTER[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90(AFTER, -1),
}


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tif", ".jpg"])
@pytest.mark.parametrize("orientation", TURNED)
def test_the_orientation_turns_the_image(orientation, suffix, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.ascontiguousarray(TURNED[orientation])
    path = save(tmp_path / f"a{suffix}", stored, exif=exif)
    image = read_image(path)
    assert np.abs(image.color - AFTER).max() <= (60 if suffix == ".jpg" else 0)
    assert image.jpeg == (suffix == ".jpg")
    np.testing.assert_array_equal(fr.sheet([opened(path)]).srgb8(), fr.sheet([path]).srgb8())


# --- Pillow's images -----------------------------------------------------------------------------


def converted(mode: str, level: int) -> Image.Image:
    """Return an image whose values or opacity ``convert('RGB')`` would lose in many modes."""
    if mode[0] in "FI":
        scale = {"F": np.float32(1e-3 * level), "I": np.int32(1000 * level)}
        value = scale.get(mode, np.array(300 + 50 * level, ">u2" if mode == "I;16B" else "<u2"))
        values = np.full((32, 32), value)
        if mode == "I;16B":
            return Image.frombytes(mode, (32, 32), values.astype(">u2").tobytes())
        return Image.fromarray(values)
    color = (10 * level, 128, 200, 128)
    if mode in ("P", "PA"):
        return Image.new("RGBA", (32, 32), (90, 128, 200, 20 * level)).convert("P").convert(mode)
    if mode == "La":
        return Image.new("LA", (32, 32), (20 * level, 128)).convert("La")
    if mode == "1":
        return Image.new("1", (32, 32), level > 5)
    source = "RGBA" if mode == "RGBa" else "RGB"
    return Image.new(source, (32, 32), color[: len(source)]).convert(mode)


@pytest.mark.parametrize(
    "mode", ["F", "I", "I;16", "I;16B", "P", "PA", "La", "RGBa", "1", "CMYK", "HSV", "YCbCr"]
)
def test_the_remedy_of_a_mode_keeps_the_difference(mode):
    images = [converted(mode, level) for level in (2, 9)]
    with pytest.raises(fr.InputError, match=rf"^A has Pillow's mode {mode}: give ") as caught:
        compare(*images)
    remedy = re.search("give ([^,]*)", str(caught.value))[1]
    values = {"numpy": np, "WHITE": 65535 if mode.startswith("I;16") else 1}
    remedied = [eval(remedy, {**values, "image": image}) for image in images]
    assert compare(remedied[0], remedied[0]).same
    assert not compare(*remedied).same


def test_a_transparent_colour_is_not_ignored(tmp_path):
    path = save(tmp_path / "a.png", BEFORE, transparency=(60, 60, 60))
    image = opened(path)
    remedy = r"A marks one colour as transparent: give image\.convert\('RGBA'\)"
    with pytest.raises(fr.InputError, match=remedy):
        compare(image, Image.fromarray(BEFORE))
    assert not compare(image.convert("RGBA"), Image.fromarray(BEFORE).convert("RGBA")).same


def test_an_opened_image_is_its_file(tmp_path):
    info = PngImagePlugin.PngInfo()
    info.add_text("GL_RENDERER", "llvmpipe")
    info.add(b"gAMA", struct.pack(">I", 100_000))
    path = save(tmp_path / "a.png", AFTER, pnginfo=info)
    with pytest.raises(fr.InputError, match="A is in colour space gamma 1, B is in colour space"):
        compare(opened(path), Image.fromarray(AFTER))
    assert compare(opened(path), path).same
    with pytest.raises(fr.InputError, match=r"^A has shape \(0, 0, 3\)"):
        compare(Image.new("RGB", (0, 0)), path)
    noise = np.random.default_rng(1).integers(0, 256, AFTER.shape, dtype=np.uint8)
    content = save(tmp_path / "noise.png", noise).read_bytes()
    half = Image.open(io.BytesIO(content[: len(content) // 2]))
    with pytest.raises(fr.InputError, match=r"^A is damaged \(.*\); save it again"):
        compare(half, path)
