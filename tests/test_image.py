"""Tests sRGB encoding, PNG and EXR files, and writing files atomically."""

from __future__ import annotations

import io
import warnings

import cv2
import numpy as np
import pytest
from PIL import Image

from facerender import InputError
from facerender.images.files import exr_bytes, png_bytes, read_image, save_exr
from facerender.images.image import encode_srgb8, linear_to_srgb, srgb_to_linear
from facerender.system.files import write_whole as write


def test_srgb_and_back():
    x = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(x)), x, atol=1e-7)
    assert linear_to_srgb(np.array([0.0, 0.214041, 1.0])) == pytest.approx(
        [0.0, 0.5, 1.0], abs=1e-5
    )


def test_encoding_gives_the_nearest_level():
    first, last = (int(np.float32(x).view(np.uint32)) for x in (1e-4, 1.0))
    x = np.arange(first, last + 1, 127, dtype=np.uint32).view(np.float32)
    boundaries = srgb_to_linear((np.arange(1, 256) - 0.5) / 255.0).astype(np.float32)
    for sign in (0.0, np.float32(2.0)):  # the float32 values around each boundary
        x = np.append(x, np.nextafter(boundaries, sign))
    exact = 255.0 * linear_to_srgb(x.astype(np.float64))
    np.testing.assert_array_equal(encode_srgb8(x), np.round(exact))


@pytest.mark.parametrize(
    ("linear", "expected"),
    [
        (srgb_to_linear(np.arange(256) / 255.0), range(256)),
        ([-1.0, -0.0, 1e-30, 1e30, np.inf, np.nan], [0, 0, 0, 255, 255, 0]),
    ],
    ids=["every byte", "extremes"],
)
def test_encoding(linear, expected):
    np.testing.assert_array_equal(encode_srgb8(np.float32(linear)), expected)


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (5, 7, 4), (1, 1, 3), (300, 200, 3)])
def test_png(shape, tmp_path):
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    metadata = {"GL_RENDERER": "llvmpipe", "author": "Zo\u00eb \u4e2d"}
    (tmp_path / "a.png").write_bytes(png_bytes(pixels, metadata))
    with Image.open(tmp_path / "a.png") as image:
        image.verify()  # the checksums
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == {1: "L", 3: "RGB", 4: "RGBA"}[pixels[0, 0].size]
        np.testing.assert_array_equal(np.asarray(image), pixels)
        assert image.info == metadata


@pytest.mark.parametrize("shape", [(5, 7), (1, 1), (300, 200), (5, 7, 3), (5, 7, 4)])
def test_png_of_16_bits(shape):
    pixels = np.random.default_rng(1).integers(0, 65536, shape, dtype=np.uint16)
    content = png_bytes(pixels, {"samples": "1"})
    read = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    order = [2, 1, 0, 3][: shape[2]] if len(shape) > 2 else slice(None)  # OpenCV uses BGR
    np.testing.assert_array_equal(read, pixels[..., order] if len(shape) > 2 else pixels)
    if len(shape) == 2:  # Pillow drops the lower byte of images with more channels
        with Image.open(io.BytesIO(content)) as image:
            np.testing.assert_array_equal(np.asarray(image), pixels)
            assert image.info == {"samples": "1"}


def test_png_of_array_views():
    pixels = np.random.default_rng(1).integers(0, 65536, (12, 10), dtype=np.uint16)
    for turned in (pixels.T, pixels[::2, ::3], pixels[::-1]):
        for kind in (np.uint8, np.uint16):
            view = turned.astype(kind)
            assert png_bytes(turned.astype(kind, order="K"), {}) == png_bytes(view.copy("C"), {})


def test_signalling_nan_is_read_without_a_warning(tmp_path):
    linear = np.full((8, 16, 4), 0.5, np.float32)
    linear[1, 1, 3] = np.uint32(0x7FA00000).view(np.float32)
    save_exr(tmp_path / "a.exr", linear, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (read_image(tmp_path / "a.exr").color == 0.5).all()


def test_exr(tmp_path):
    import OpenEXR

    values = np.random.default_rng(1).normal(size=(3, 5, 7)).astype(np.float32) * 1e3
    channels = dict(zip(["R", "normal.X", "Z"], values, strict=True))
    content = exr_bytes("a.exr", channels, {"samples": "4"})
    assert content == exr_bytes("b.exr", channels, {"samples": "4"})
    (tmp_path / "a.exr").write_bytes(content)
    linear = np.random.default_rng(1).normal(size=(5, 7, 4)).astype(np.float32) * 1e3
    save_exr(tmp_path / "b.exr", linear, {"samples": "4"})
    own = dict(zip("RGBA", np.moveaxis(linear, 2, 0), strict=True))
    for name, expected in (("a.exr", channels), ("b.exr", own)):
        with OpenEXR.File(str(tmp_path / name), separate_channels=True) as file:
            assert file.header()["samples"] == "4"
            for key, pixels in expected.items():
                np.testing.assert_array_equal(file.channels()[key].pixels, pixels)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", [[], ["a.png"]])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error, before):
    def fail_half_way(name):
        with open(name, "wb") as file:
            file.write(b"half")
        raise error

    for name in before:
        (tmp_path / name).write_bytes(b"old")
    expected, message = type(error), None
    if isinstance(error, OSError):
        expected, message = InputError, r"cannot write .*a.png: no space left"
    with pytest.raises(expected, match=message):
        write(tmp_path / "a.png", fail_half_way)
    assert [path.name for path in tmp_path.iterdir()] == before
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"] * len(before)


def test_written_file_has_ordinary_permissions(tmp_path):
    write(tmp_path / "a.txt", lambda name: open(name, "w").close())
    (tmp_path / "b.txt").touch()
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode


@pytest.mark.parametrize(
    ("name", "message"),
    [("missing/a.png", "no such file or directory"), (".", "it is a directory; give a file name")],
)
def test_places_that_cannot_be_written(tmp_path, name, message):
    with pytest.raises(InputError, match=message):
        write(tmp_path / name, lambda name: None)
