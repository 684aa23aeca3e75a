"""Goldens: reference images beside tests. This module compares one image with its golden and writes
the golden; the pytest plugin is facerender/pytest_plugin.py.

A golden may keep the range of each pixel's value over 24 shifts of the image by at most 0.1 pixel.
It explains detail finer than a pixel, which no neighbourhood does. It holds colours of covered
pixels only: a black pixel is no uncovered background.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facerender import __version__
from facerender.comparison.compare import Comparable, Pair, as_image, compare
from facerender.comparison.neighbourhoods import COVERED
from facerender.errors import InputError, reason
from facerender.images.exr import save_exr
from facerender.images.image import ImageData, PixelRange

FARTHEST = 0.1  # pixels
# Pixels to the right and down: circles of several radii, since fine detail comes and goes.
SHIFTS = tuple(
    (round(by * math.cos(0.25 * i * math.pi), 6), round(by * math.sin(0.25 * i * math.pi), 6))
    for by in (FARTHEST, FARTHEST * 2.0 / 3.0, FARTHEST / 3.0)
    for i in range(8)
)
_HIGHEST = 65504.0  # of half floats
_FURTHER = 3.0  # times as far: detail finer than a pixel seems to move by more
Draw = Callable[[float, float], Comparable]
UNKNOWN = "an unknown renderer"


@dataclass(frozen=True)
class Updates:
    """Which goldens may be written.

    Attributes
    ----------
    missing : those that do not exist
    differing : those as well that the image differs from, if this renderer recorded them
    force : of the differing, also those of another renderer
    alternative : beside one of another renderer, NAME@RENDERER.exr for this one
    """

    missing: bool = False
    differing: bool = False
    force: bool = False
    alternative: bool = False


@dataclass(frozen=True, eq=False)
class GoldenResult:
    """The result of checking an image against its golden.

    Attributes
    ----------
    image : with the metadata that a golden carries
    pair : it and its golden, as they were before one was written
    golden : path of the golden, which need not exist
    written : the golden that was written, or None
    failure : why the image does not pass, with the remedy; "" where it does
    """

    image: ImageData
    pair: Pair
    golden: Path
    written: Path | None = None
    failure: str = ""


def renderer_name(gl_renderer: str) -> str:
    """Return GL_RENDERER up to its first bracket or slash, fit for a file's name:
    "llvmpipe (LLVM 15.0.6, 256 bits)" is llvmpipe, "NVIDIA H200/PCIe/SSE2" NVIDIA-H200."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", re.split(r" \(|/", gl_renderer)[0]).strip("-")


def check(
    name: str,
    source: Comparable,
    golden: Path,
    updates: Updates = Updates(),
    written: Container[Path] = (),
    *,
    metadata: Mapping[str, str] | None = None,
    draw: Draw | None = None,
    **options: Any,
) -> GoldenResult:
    """Compare an image with its golden, and write the golden where that is allowed.

    Parameters
    ----------
    name : of the pair, for the report
    golden : FOLDER/NAME.exr; FOLDER/NAME@RENDERER.exr is taken in its place where it exists for the
        renderer that the image's metadata names
    written : goldens that another image has become meanwhile: they are not written again
    metadata : to add to the image's own
    draw : returns the image shifted by N pixels to the right and M down; a golden that is written
        keeps the range of each pixel over such shifts. None: no range
    options : limits and mask, see :func:`facerender.compare`

    Raises
    ------
    InputError : the image is not linear float, cannot be read, or the golden cannot be written
    """
    image = _linear_rgb(source, metadata or {})
    renderer = image.metadata.get("GL_RENDERER", "")
    own = golden.with_name(f"{golden.stem}@{renderer_name(renderer)}.exr")
    golden = own if os.path.isfile(own) else golden
    exists = os.path.isfile(golden)  # before it is read: another process may write it meanwhile
    pair = Pair.of(name, golden, image, **options)
    if pair.status == 0:
        return GoldenResult(image, pair, golden)
    exists = exists or pair.reference is not None
    failure = ""
    if exists and not updates.differing:
        failure = pair.error or f"{golden.stem} differs from its golden: {pair.comparison}"
    elif not (updates.missing or updates.differing):
        failure = f"{golden.stem} has no golden: --facerender-update-missing writes it"
    if not failure:
        try:
            compare(image, image, **options)  # the image itself or its limits may be invalid
        except InputError as error:
            failure = str(error)
    place = golden
    if not failure and exists:
        recorded = pair.reference.metadata.get("GL_RENDERER", "") if pair.reference else None
        if recorded != renderer and updates.alternative and renderer:
            place = own
        if recorded != renderer and place == golden and not updates.force:
            failure = _of_another(golden.name, recorded, renderer)
    if not failure and place in written:
        failure = f"{place.name} was written for another image just now: give each a name"
    if failure:
        return GoldenResult(image, pair, golden, failure=failure)
    _write(place, image, draw)
    return GoldenResult(image, pair, golden, written=place)


def _of_another(name: str, recorded: str | None, renderer: str) -> str:
    return (
        f"{name} was recorded on {recorded or UNKNOWN}, this is {renderer or UNKNOWN}: "
        "--facerender-force overwrites it, --facerender-alternative writes one for this renderer "
        "beside it"
    )


def _linear_rgb(source: Comparable, metadata: Mapping[str, str]) -> ImageData:
    image = as_image(source, "the image")
    if image.encoding != "linear":
        raise InputError(
            f"{image.name} is 8-bit, which hides what a golden is to show: give a Frame, floats or "
            "an EXR file"
        )
    if image.pixels.shape[2] < 3:
        raise InputError(f"{image.name} is grey: give RGB")
    return replace(image, metadata={"facerender": __version__, **image.metadata, **metadata})


def _write(path: Path, image: ImageData, draw: Draw | None) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {reason(error)}") from None
    shift_range = None if draw is None else range_of([image, *_shifted(image, draw)])
    save_exr(path, image.pixels, image.metadata, shift_range)


def range_of(images: Sequence[ImageData]) -> PixelRange:
    """Return the range of linear images of one size: of colours where they are covered."""
    each = []
    for image in images:
        color, alpha = image.rows(slice(None))
        values = np.where(alpha[..., None] >= COVERED, color, np.float32(np.nan))
        if image.pixels.shape[2] > color.shape[2]:
            values = np.concatenate([values, alpha[..., None]], axis=2)
        each.append(values)
    ends = []
    for choose, beyond in ((np.fmin, -np.inf), (np.fmax, np.inf)):
        values = choose.reduce(each).clip(-_HIGHEST, _HIGHEST).astype(np.float16)
        with np.errstate(over="ignore"):
            ends.append(np.nextafter(values, np.float16(beyond)))
    return PixelRange(*ends)


def _shifted(image: ImageData, draw: Draw) -> list[ImageData]:
    """Draw an image at every one of :data:`SHIFTS`.

    Raises
    ------
    InputError : what is drawn cannot be compared with the image, or is shifted by more
    """
    drawn = [as_image(draw(x, y), f"what draw({x:g}, {y:g}) gives") for x, y in SHIFTS]
    shifts = np.array([compare(image, each).shift for each in drawn])
    times = float(np.vdot(shifts, SHIFTS) / np.vdot(SHIFTS, SHIFTS))
    if times > _FURTHER:
        raise InputError(
            f"draw moves the image by {times:.2g} times its arguments: take them as pixels to the "
            "right and down"
        )
    return drawn
