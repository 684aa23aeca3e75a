"""What the encoding of an image costs: as its file says, beside what it does cost a drawn face."""

from __future__ import annotations

import io
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import facerender as fr
from facerender.comparison.compare import compare
from facerender.images.image import image_from_array
from facerender.images.read import read_image
from facerender.jpeg import Jpeg

SAMPLINGS = [(1, 1), (2, 1), (2, 2)]  # as Pillow numbers them
QUALITIES = (75, 85, 92, 95, 98, 100)


@pytest.fixture(scope="module", params=[256, 512])
def frame(request: pytest.FixtureRequest, egl) -> fr.Frame:
    """A drawn head."""
    return fr.render(size=(request.param, request.param), backend=egl)


@pytest.fixture(scope="module")
def face(frame) -> tuple[np.ndarray, np.ndarray]:
    """Its 8-bit colours (H, W, 3), and where it is."""
    return frame.srgb8()[..., :3], frame.linear[..., 3] > 0.99


def saved(path: Path, pixels: np.ndarray, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("number", range(3))
def test_noise_holds(face, number, quality, tmp_path):
    pixels, inside = face
    path = saved(tmp_path / "a.jpg", pixels, quality=quality, subsampling=number)
    picture = read_image(path)
    error = picture.pixels.astype(float) - pixels
    rms = np.sqrt(np.square(error[inside]).mean(axis=0)).max()
    assert 0.2 * picture.noise < rms < picture.noise
    assert picture.jpeg.sampling == SAMPLINGS[number]


@pytest.mark.parametrize("quality", QUALITIES)
def test_grey(face, quality, tmp_path):
    pixels, inside = face
    picture = read_image(saved(tmp_path / "a.jpg", pixels[..., 1], quality=quality))
    error = picture.pixels[..., 0].astype(float) - pixels[..., 1]
    assert 0.2 * picture.noise < np.sqrt(np.square(error[inside]).mean()) < picture.noise
    assert len(picture.jpeg.tables) == 1


def test_finer_tables_cost_less(face, tmp_path):
    pictures = [
        read_image(saved(tmp_path / "a.jpg", face[0], quality=quality)) for quality in QUALITIES
    ]
    for coarse, fine in pairwise(pictures):
        assert coarse.noise > fine.noise


def test_what_is_no_jpeg_costs_its_rounding(tmp_path):
    exact = np.random.default_rng(1).uniform(0.0, 255.0, (64, 64, 3))
    rounded = np.round(exact).astype(np.uint8)
    rms = np.sqrt(np.square(rounded - exact).mean())
    for picture in (
        read_image(saved(tmp_path / "a.png", rounded)),
        image_from_array(rounded, "array"),
    ):
        assert picture.noise == pytest.approx(rms, rel=0.02)
        assert picture.jpeg is None
    assert image_from_array(np.float32(rounded), "linear").noise == 0.0


COMPRESSIONS = [  # EXR, how wide its floats are, attributes
    *((name, bits, {}) for name in ("ZIP", "PXR24", "B44", "B44A", "DWAB") for bits in (16, 32)),
    *(("DWAA", 32, {"dwaCompressionLevel": level}) for level in (20.0, 45.0, 90.0)),
]


@pytest.mark.parametrize("level", [1e30, float("inf"), float("nan"), -5.0])
def test_a_dwa_level_that_no_image_has(level, tmp_path):
    """Taken at its word it would explain any difference."""
    path = tmp_path / "a.exr"
    header = {"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"RGB": np.zeros((32, 32, 3), np.float32)}
    OpenEXR.File({**header, "dwaCompressionLevel": level}, channels).write(str(path))
    with pytest.raises(
        fr.InputError, match=r"DWA level .* is outside \[0, 1000\]\); write it anew"
    ):
        read_image(path)


@pytest.mark.parametrize(("name", "bits", "header"), COMPRESSIONS)
def test_noise_of_exr(frame, name, bits, header, tmp_path):
    path, kind = tmp_path / "a.exr", np.dtype(f"f{bits // 8}")
    compression = getattr(OpenEXR, f"{name}_COMPRESSION")
    channels = {"RGBA": frame.linear.astype(kind)}
    header = {"compression": compression, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(header, channels).write(str(path))
    picture = read_image(path)
    assert picture.pixels.dtype == kind

    exact, inside = frame.linear[..., :3].astype(float), frame.linear[..., 3] > 0.99
    error = picture.color - exact
    relative = error / np.maximum(exact, 0.01)
    rms = np.sqrt(np.square(relative[inside]).mean(axis=0)).max()
    assert 0.2 * picture.noise <= rms <= picture.noise


def test_half_floats_cost_the_same_however_they_are_given(tmp_path):
    exact = np.full((64, 64, 3), 0.3, dtype=np.float32)
    half = exact.astype(np.float16)
    np.save(tmp_path / "a.npy", half)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": half}).write(str(tmp_path / "a.exr"))
    for given in (half, tmp_path / "a.npy", tmp_path / "a.exr"):
        assert str(compare(exact, given)) == "same"


def test_halves_compare_as_what_they_are(frame, tmp_path):
    """A value beyond half floats' range would overflow if the limits were taken as halves."""
    paths = [tmp_path / f"{name}.exr" for name in ("half", "float")]
    for path, kind in zip(paths, (np.float16, np.float32), strict=True):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGBA": frame.linear.astype(kind)}).write(str(path))
    assert compare(*paths).same
    broken = frame.linear.astype(np.float16)
    broken[100, 50, 1] = np.inf
    OpenEXR.File(header, {"RGBA": broken}).write(str(paths[0]))
    with pytest.raises(fr.InputError, match=r"1 infinite values, the first at pixel \(50, 100\)"):
        compare(*paths)


PEAK = """
import sys
from facerender.images.read import read_image
def peak():
    (line,) = (each for each in open("/proc/self/status") if each.startswith("VmHWM"))
    return int(line.split()[1]) >> 10
import OpenEXR, PIL.Image, PIL.PngImagePlugin
before = peak()
held = read_image(sys.argv[1]).pixels.nbytes >> 20
print(peak() - before - held)
"""


@pytest.mark.parametrize(("name", "more"), [("f4.exr", 24), ("f2.exr", 24), ("rgba.png", 88)])
def test_reading_takes_little_beside_the_pixels(name, more, tmp_path):
    """MiB, of 2048 x 2048 pixels of noise: 64, 32 and 16 in themselves. Pillow holds a PNG as
    another 16, beside its file, which noise fills."""
    path, rng = tmp_path / name, np.random.default_rng(1)
    if path.suffix == ".png":
        pixels = rng.integers(0, 256, (2048, 2048, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(path, compress_level=1)
    else:
        pixels = rng.random((2048, 2048, 4), dtype=np.float32).astype(path.stem)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGBA": pixels}).write(str(path))
    command = [sys.executable, "-c", PEAK, path]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(done.stdout) < more


OPTIONS = [
    *({"quality": 90, "subsampling": number} for number in range(3)),
    {"quality": 75, "progressive": True},
    {"quality": 90, "keep_rgb": True},
    {"qtables": [[7] * 64, [9] * 64, [30] * 64]},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_encoded_as_another_file_it_is_the_same(face, options, tmp_path):
    """Quality 75 moves pixels by 40 and more; of the same pixels nothing is left of that."""
    original = image_from_array(face[0], "original")
    other = read_image(saved(tmp_path / "a.jpg", face[0], **options))
    np.testing.assert_array_equal(original.encoded_as(other).pixels, other.pixels)
    assert not np.array_equal(original.pixels, other.pixels)
    assert compare(original, other).largest == compare(other, original).largest == 0.0
    assert other.encoded_as(other) is other
    assert other.encoded_as(original) is other


def test_grey_encoded_as_another_file(face, tmp_path):
    original = image_from_array(face[0][..., 1], "original")
    other = read_image(saved(tmp_path / "a.jpg", face[0][..., 1], quality=60))
    np.testing.assert_array_equal(original.encoded_as(other).pixels, other.pixels)


def test_encoder_of_another_library(face):
    """OpenCV writes the tables and the sampling that Pillow reads."""
    _, content = cv2.imencode(".jpg", face[0][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    with Image.open(io.BytesIO(content.tobytes())) as image:
        applied = Jpeg.of(image).applied(face[0])
        np.testing.assert_array_equal(applied, np.asarray(image))
