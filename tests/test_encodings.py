"""Tests the noise that image files state for their encoding against the error on a rendered face,
and the warning about JPEG."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import facerender as fr
from facerender.comparison.compare import compare
from facerender.images.files import read_image
from facerender.images.image import image_from_array


@pytest.fixture(scope="module", params=[256, pytest.param(512, marks=pytest.mark.slow)])
def frame(request: pytest.FixtureRequest, egl) -> fr.Frame:
    """A rendered head."""
    return fr.render(size=(request.param, request.param), backend=egl)


def write_exr(path: Path, pixels: np.ndarray, compression: str = "ZIP", **header: object) -> Path:
    header["compression"] = getattr(OpenEXR, f"{compression}_COMPRESSION")
    header["type"] = OpenEXR.scanlineimage
    OpenEXR.File(header, {"RGBA"[: pixels.shape[2]]: pixels}).write(str(path))
    return path


@pytest.mark.first_case
@pytest.mark.parametrize("name", ["ZIP", "PXR24"])
@pytest.mark.parametrize("bits", [16, 32])
def test_noise_of_exr(frame, name, bits, tmp_path):
    kind = np.dtype(f"f{bits // 8}")
    image = read_image(write_exr(tmp_path / "a.exr", frame.linear.astype(kind), name))
    assert image.pixels.dtype == kind
    exact, inside = frame.linear[..., :3].astype(float), frame.linear[..., 3] > 0.99
    relative = (image.color - exact) / np.maximum(exact, 0.01)
    rms = np.sqrt(np.square(relative[inside]).mean(axis=0)).max()
    assert 0.2 * image.noise <= rms <= image.noise


def test_half_floats_have_the_same_noise_in_arrays_and_files(tmp_path):
    exact = np.full((64, 64, 3), 0.3, dtype=np.float32)
    half = exact.astype(np.float16)
    np.save(tmp_path / "a.npy", half)
    write_exr(tmp_path / "a.exr", half)
    for given in (half, tmp_path / "a.npy", tmp_path / "a.exr"):
        assert str(compare(exact, given)) == "same"
    assert image_from_array(exact, "linear").noise == 0.0


def test_half_and_full_floats_can_be_compared(frame, tmp_path):
    """Computed in half floats, the limits would overflow."""
    half, full = (write_exr(tmp_path / f"{k}.exr", frame.linear.astype(k)) for k in ("f2", "f4"))
    assert compare(half, full).same
    broken = frame.linear.astype(np.float16)
    broken[100, 50, 1] = np.inf
    write_exr(half, broken)
    with pytest.raises(fr.InputError, match=r"1 infinite value, the first at pixel \(50, 100\)"):
        compare(half, full)


def test_compare_warns_of_a_jpeg_and_compares_its_pixels(frame, tmp_path):
    pixels = frame.srgb8()[..., :3]
    paths = [tmp_path / name for name in ("a.png", "b.jpg")]
    for path in paths:
        Image.fromarray(pixels).save(path, quality=75)
    with pytest.warns(fr.FacerenderWarning, match=r"b\.jpg: the losses of JPEG count .* as PNG"):
        result = compare(*paths)
    assert not result.same
    decoded = np.asarray(Image.open(paths[1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compare(paths[0], decoded).largest == result.largest > 30.0
        assert compare(paths[0], pixels).same


PEAK = """
import sys
from facerender.images.files import read_image
def peak():
    (line,) = (each for each in open("/proc/self/status") if each.startswith("VmHWM"))
    return int(line.split()[1]) >> 10
import OpenEXR, PIL.Image, PIL.PngImagePlugin
before = peak()
held = read_image(sys.argv[1]).pixels.nbytes >> 20
print(peak() - before - held)
"""


@pytest.mark.memory
@pytest.mark.parametrize(("name", "more"), [("f4.exr", 24), ("f2.exr", 24), ("rgba.png", 88)])
def test_reading_needs_little_extra_memory(name, more, tmp_path):
    """The 2048 x 2048 pixels need 64, 32 and 16 MiB; ``more`` is the limit beyond that. For PNG,
    Pillow holds another 16 MiB and the file, which noise makes large."""
    path, rng = tmp_path / name, np.random.default_rng(1)
    if path.suffix == ".png":
        pixels = rng.integers(0, 256, (2048, 2048, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(path, compress_level=1)
    else:
        write_exr(path, rng.random((2048, 2048, 4), dtype=np.float32).astype(path.stem))
    command = [sys.executable, "-c", PEAK, path]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(done.stdout) < more
