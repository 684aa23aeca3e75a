"""Other image comparison tools, each as numbers that grow with the difference.

They need the extras ``measure``, ``head`` and ``hdr``, and packages that no other part of the
project needs: ``pip install pybind11-pixelmatch`` (pixelmatch in C++, with the counts of PyPI's
``pixelmatch`` at a hundred times its speed). On the path they need ``odiff`` (``npm install
odiff-bin``), ``compare`` (``apt-get install imagemagick``) and ``idiff`` (from the extra ``hdr``).

Tools without support for alpha get the images on middle grey.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from facerender.images.files import read_image
from tests.verification.pairs.changes import Format

Numbers = Mapping[str, float]
GREY = (128, 128, 128, 255)
SENSITIVITIES = (0.1, 0.03, 0.01, 0.005, 0.002)  # thresholds of pixelmatch and odiff; default 0.1
FUZZ = (1, 3, 10)  # percent; -fuzz of ImageMagick's AE metric


@dataclass(frozen=True)
class Peer:
    """A comparison tool.

    Attributes
    ----------
    formats : the image formats that the tool gets
    version : returns the tool's name and version; raises ImportError or OSError if it is missing
    measure : returns the tool's numbers by name for the two files of a pair
    """

    name: str
    formats: tuple[Format, ...]
    version: Callable[[], str]
    measure: Callable[[Path, Path], Numbers]


def _rgba(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGBA"))


def _rgb(path: Path) -> NDArray[np.uint8]:
    """Return an 8-bit image on middle grey."""
    with Image.open(path) as image:
        behind = Image.new("RGBA", image.size, GREY)
        return np.asarray(Image.alpha_composite(behind, image.convert("RGBA")).convert("RGB"))


def _linear(path: Path) -> NDArray[np.float32]:
    return np.ascontiguousarray(read_image(path).color)


def _run(*command: object) -> str:
    """Return a tool's output; ignore its exit status, which is not 0 if the images differ."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True)
    return done.stdout + done.stderr


def _number(text: str, pattern: str) -> float:
    found = re.search(pattern, text)
    assert found, text
    return float(found[1])


def _matplotlib(golden: Path, image: Path) -> Numbers:
    from matplotlib.testing.compare import calculate_rms

    a, b = (_rgb(path).astype(np.int16) for path in (golden, image))
    return {"matplotlib.testing.compare, rms": float(calculate_rms(a, b))}


def _pixelmatch(golden: Path, image: Path) -> Numbers:
    module = import_module("pybind11_pixelmatch")
    a, b = _rgba(golden), _rgba(image)
    found = {}
    for sensitivity in SENSITIVITIES:
        options = module.Options()
        options.threshold = sensitivity
        count = module.pixelmatch(a, b, output=np.zeros_like(a), options=options)
        found[f"pixelmatch at {sensitivity:g}, pixels"] = float(count)
    return found


def _odiff(golden: Path, image: Path) -> Numbers:
    found = {}
    for each in SENSITIVITIES:
        text = _run("odiff", golden, image, "--threshold", each, "--aa", "--parsable-stdout")
        count = float(text.split(";")[0]) if text.strip() else 0.0
        found[f"odiff at {each:g}, pixels"] = count
    return found


def _idiff(golden: Path, image: Path) -> Numbers:
    text = _run("idiff", "-v", "-a", "-fail", 0, "-warn", 0, golden, image)
    if "PASS" in text and "error" not in text:
        return {f"idiff, {name} error": 0.0 for name in ("mean", "RMS", "max")}
    return {
        f"idiff, {name} error": _number(text, rf"(?i){name} error\s*=\s*([-\d.e+]+)")
        for name in ("mean", "RMS", "max")
    }


def _imagemagick(golden: Path, image: Path) -> Numbers:
    found = {}
    for metric in ("RMSE", "PAE"):
        text = _run("compare", "-metric", metric, golden, image, "null:")
        found[f"ImageMagick compare, {metric}"] = _number(text, r"\(([-\d.e+]+)\)")
    for fuzz in FUZZ:
        text = _run("compare", "-metric", "AE", "-fuzz", f"{fuzz}%", golden, image, "null:")
        found[f"ImageMagick compare, AE at fuzz {fuzz} %"] = _number(text, r"([\d.e+]+)")
    return found


def _ssim(golden: Path, image: Path) -> Numbers:
    from skimage.metrics import structural_similarity

    floats = golden.suffix == ".exr"
    a, b = ((_linear if floats else _rgb)(path).astype(np.float64) for path in (golden, image))
    mean, windows = structural_similarity(
        a, b, channel_axis=-1, data_range=1.0 if floats else 255.0, full=True
    )
    return {
        "SSIM, 1 - mean": float(1.0 - mean),
        "SSIM, 1 - least window": float(1.0 - windows.min()),
    }


def _flip(golden: Path, image: Path) -> Numbers:
    from flip_evaluator import evaluate

    if golden.suffix == ".exr":
        a, b = _linear(golden), _linear(image)
        map_, mean, _ = evaluate(a, b, "HDR", applyMagma=False)
    else:
        a, b = (_rgb(path).astype(np.float32) / np.float32(255.0) for path in (golden, image))
        map_, mean, _ = evaluate(a, b, "LDR", applyMagma=False)
    return {"FLIP, mean": float(mean), "FLIP, max": float(map_.max())}


def _of(package: str) -> Callable[[], str]:
    return lambda: f"{package} {version(package)}"


def _printed(name: str, *command: str) -> Callable[[], str]:
    def ask() -> str:
        found = re.search(r"\d+\.[\d.-]*\d", _run(*command))
        assert found, command
        return f"{name} {found[0]}"

    return ask


EIGHT_BITS: tuple[Format, ...] = ("png", "jpeg")
ALL: tuple[Format, ...] = (*EIGHT_BITS, "exr")
PEERS = (
    Peer("matplotlib", EIGHT_BITS, _of("matplotlib"), _matplotlib),
    Peer("pixelmatch", EIGHT_BITS, _of("pybind11-pixelmatch"), _pixelmatch),
    Peer("odiff", EIGHT_BITS, _printed("odiff", "odiff", "--version"), _odiff),
    Peer("idiff", ALL, _printed("OpenImageIO", "idiff", "--version"), _idiff),
    Peer("ImageMagick", EIGHT_BITS, _printed("ImageMagick", "compare", "-version"), _imagemagick),
    Peer("SSIM", ALL, _of("scikit-image"), _ssim),
    Peer("FLIP", ALL, _of("flip-evaluator"), _flip),
)


def present() -> Iterator[tuple[Peer, str]]:
    """Yield the installed tools with their versions."""
    for peer in PEERS:
        try:
            yield peer, peer.version()
        except (ImportError, OSError):
            print(f"{peer.name} is not installed: skipped", file=sys.stderr)
