"""What a JPEG costs, as its tables say, beside what it does cost a drawn face."""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.image import picture_of, read_image
from facerender.jpeg import Jpeg

SAMPLINGS = [(1, 1), (2, 1), (2, 2)]  # as Pillow numbers them
QUALITIES = (75, 85, 92, 95, 98)


@pytest.fixture(scope="module", params=[256, 512])
def face(request: pytest.FixtureRequest, egl) -> tuple[np.ndarray, np.ndarray]:
    """A drawn head (H, W, 3), and where it is."""
    size = (request.param, request.param)
    frame = fr.render(size=size, backend=egl)
    return frame.srgb8()[..., :3], frame.linear[..., 3] > 0.99


def saved(path: Path, pixels: np.ndarray, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("number", range(3))
def test_noise_and_mean_hold(face, number, quality, tmp_path):
    pixels, inside = face
    path = saved(tmp_path / "a.jpg", pixels, quality=quality, subsampling=number)
    picture = read_image(path)
    error = picture.pixels.astype(float) - pixels
    rms = np.sqrt(np.square(error[inside]).mean(axis=0)).max()
    assert 0.2 * picture.noise < rms < picture.noise
    side = len(pixels) // 16
    blocks = error.reshape(side, 16, side, 16, 3).mean(axis=(1, 3))
    assert 0.1 * picture.mean < np.abs(blocks).max() < picture.mean
    assert picture.jpeg.sampling == SAMPLINGS[number]


@pytest.mark.parametrize("quality", QUALITIES)
def test_grey(face, quality, tmp_path):
    pixels, inside = face
    picture = read_image(saved(tmp_path / "a.jpg", pixels[..., 1], quality=quality))
    error = picture.pixels[..., 0].astype(float) - pixels[..., 1]
    assert 0.2 * picture.noise < np.sqrt(np.square(error[inside]).mean()) < picture.noise
    assert np.abs(error).mean() < picture.mean
    assert len(picture.jpeg.tables) == 1


def test_finer_tables_cost_less(face, tmp_path):
    pictures = [
        read_image(saved(tmp_path / "a.jpg", face[0], quality=quality)) for quality in QUALITIES
    ]
    for coarse, fine in pairwise(pictures):
        assert coarse.noise > fine.noise
        assert coarse.mean >= fine.mean


def test_what_is_no_jpeg_costs_its_rounding(tmp_path):
    exact = np.random.default_rng(1).uniform(0.0, 255.0, (64, 64, 3))
    rounded = np.round(exact).astype(np.uint8)
    rms = np.sqrt(np.square(rounded - exact).mean())
    for picture in (read_image(saved(tmp_path / "a.png", rounded)), picture_of(rounded, "array")):
        assert picture.noise == pytest.approx(rms, rel=0.02)
        assert (picture.mean, picture.jpeg) == (0.0, None)
    assert picture_of(np.float32(rounded), "linear").noise == 0.0


OPTIONS = [
    *({"quality": 90, "subsampling": number} for number in range(3)),
    {"quality": 75, "progressive": True},
    {"quality": 90, "keep_rgb": True},
    {"qtables": [[7] * 64, [9] * 64, [30] * 64]},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_encoded_as_another_file_it_is_the_same(face, options, tmp_path):
    """Quality 75 moves pixels by 40 and more; of the same pixels nothing is left of that."""
    original = picture_of(face[0], "original")
    other = read_image(saved(tmp_path / "a.jpg", face[0], **options))
    np.testing.assert_array_equal(original.encoded_as(other).pixels, other.pixels)
    assert not np.array_equal(original.pixels, other.pixels)
    assert other.encoded_as(other) is other
    assert other.encoded_as(original) is other


def test_grey_encoded_as_another_file(face, tmp_path):
    original = picture_of(face[0][..., 1], "original")
    other = read_image(saved(tmp_path / "a.jpg", face[0][..., 1], quality=60))
    np.testing.assert_array_equal(original.encoded_as(other).pixels, other.pixels)


def test_encoder_of_another_library(face):
    """OpenCV writes the tables and the sampling that Pillow reads."""
    _, content = cv2.imencode(".jpg", face[0][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    with Image.open(io.BytesIO(content.tobytes())) as image:
        applied = Jpeg.of(image).applied(face[0])
        np.testing.assert_array_equal(applied, np.asarray(image))
