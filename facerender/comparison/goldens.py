"""Goldens (reference images of tests): compare an image with its golden, and write the golden.

The pytest plugin is facerender/pytest_plugin.py.

A golden may store the range of each pixel's value over 24 shifts of the image by at most 0.1 pixel.
The range explains differences in detail finer than a pixel, which neighbouring pixels do not
explain. The range contains colours of covered pixels only, so that a black pixel cannot pass as
uncovered background.
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
from facerender.comparison.compare import Pair, compare
from facerender.comparison.neighbourhoods import COVERED
from facerender.comparison.sources import HIGHEST_HALF, Comparable, as_image
from facerender.errors import InputError, reason
from facerender.images.exr import half_above, save_exr
from facerender.images.image import ImageData, PixelRange

FARTHEST = 0.1  # largest shift, in pixels
# Shifts in pixels to the right and down, on circles of several radii: fine detail may appear at
# some radii only.
SHIFTS = tuple(
    (
        round(radius * math.cos(0.25 * i * math.pi), 6),
        round(radius * math.sin(0.25 * i * math.pi), 6),
    )
    for radius in (FARTHEST, FARTHEST * 2.0 / 3.0, FARTHEST / 3.0)
    for i in range(8)
)
_ROUNDED = 0.2  # largest rounding error of a golden, as a part of the point limit
_FURTHER = 3.0  # largest ratio of a measured to a requested shift: fine detail exaggerates shifts
Draw = Callable[[float, float], Comparable]
UNKNOWN = "an unknown renderer"


@dataclass(frozen=True)
class Updates:
    """Selection of the goldens that may be written.

    Attributes
    ----------
    missing : goldens that do not exist
    differing : also goldens that differ from the image, if this renderer recorded them
    force : also goldens that differ from the image and that another renderer recorded
    alternative : a second golden, NAME@RENDERER.exr, if another renderer recorded the golden
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
    image : the checked image, with the metadata that its golden would store
    pair : the image and its golden as it was before a new golden was written
    golden : path of the golden; the file may be missing
    written : path of the written golden, or None
    failure : reason why the image fails, with the remedy; "" if it passes
    """

    image: ImageData
    pair: Pair
    golden: Path
    written: Path | None = None
    failure: str = ""


def renderer_name(gl_renderer: str) -> str:
    """Return GL_RENDERER up to its first bracket or slash, as a valid part of a file name.

    "llvmpipe (LLVM 15.0.6, 256 bits)" gives llvmpipe, "NVIDIA H200/PCIe/SSE2" gives NVIDIA-H200.
    """
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
    """Compare an image with its golden, and write the golden if allowed.

    Parameters
    ----------
    name : name of the pair in the report
    golden : FOLDER/NAME.exr. If FOLDER/NAME@RENDERER.exr exists for the renderer in the image's
        metadata, it is used instead
    written : goldens that were already written in this session; they are not written again
    metadata : entries that are added to the image's metadata
    draw : function that returns the image shifted by x pixels to the right and y pixels down. A
        written golden stores the range of each pixel over these shifts. None: no range
    options : limits and mask, see :func:`facerender.compare`

    Raises
    ------
    InputError : the image is not linear float or cannot be read, or the golden cannot be written
    """
    image = _linear_rgb(source, metadata or {})
    renderer = image.metadata.get("GL_RENDERER", "")
    of_renderer = golden.with_name(f"{golden.stem}@{renderer_name(renderer)}.exr")
    golden = of_renderer if os.path.isfile(of_renderer) else golden
    exists = os.path.isfile(golden)  # checked before reading: another process may write the file
    pair = Pair.of(name, golden, image, **options)
    if not exists and pair.reference is None:
        pair = replace(pair, error="no golden yet")
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
    if not failure and exists and pair.reference is None:
        failure = "" if updates.force else pair.error
    elif not failure and pair.reference is not None:
        recorded = pair.reference.metadata.get("GL_RENDERER", "")
        if recorded != renderer and updates.alternative and renderer:
            place = of_renderer
        if recorded != renderer and place == golden and not updates.force:
            failure = _of_another(golden.name, recorded, renderer)
    if not failure and place in written:
        failure = f"{place.name} was just written for another image: give each image a new name"
    if failure:
        return GoldenResult(image, pair, golden, failure=failure)
    _write(place, image, draw, options)
    return GoldenResult(image, pair, golden, written=place)


def _of_another(name: str, recorded: str, renderer: str) -> str:
    return (
        f"{name} was recorded on {recorded or UNKNOWN}, this is {renderer or UNKNOWN}: "
        "--facerender-force overwrites it, --facerender-alternative writes another golden for this "
        "renderer"
    )


def _linear_rgb(source: Comparable, metadata: Mapping[str, str]) -> ImageData:
    image = as_image(source, "the image")
    if image.encoding != "linear":
        raise InputError(
            f"{image.name} is 8-bit, which is too coarse for a golden: give a Frame, floats or an "
            "EXR file, or compare folders of PNG files with facerender compare"
        )
    if image.pixels.shape[2] < 3:
        raise InputError(f"{image.name} is grey: give RGB")
    return replace(image, metadata={"facerender": __version__, **image.metadata, **metadata})


def _write(path: Path, image: ImageData, draw: Draw | None, options: Mapping[str, Any]) -> None:
    """Write a golden with the fewest bits whose rounding errors are small compared with the limits:
    half floats next to a range, else 24-bit floats, else float32."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {reason(error)}") from None
    shift_range = None
    kinds: list[tuple[type[np.floating], bool]] = [(np.float32, True), (np.float32, False)]
    if draw is not None:
        shift_range = range_of([image, *_shifted(image, draw)])
        kinds.insert(0, (np.float16, True))
    for kind, rounded in kinds:
        with np.errstate(over="ignore"):
            pixels = image.pixels.astype(kind, copy=False)
        save_exr(path, pixels, image.metadata, shift_range, rounded)
        comparison = Pair.of(path.name, path, image, **options).comparison
        if comparison and comparison.largest <= _ROUNDED * comparison.limits.point:
            return


def range_of(images: Sequence[ImageData]) -> PixelRange:
    """Return each pixel's range over linear images of one size; ignore uncovered pixels."""
    layers = []
    for image in images:
        color, alpha = image.rows(slice(None))
        values = np.where(alpha[..., None] >= COVERED, color, np.float32(np.nan))
        if image.pixels.shape[2] > color.shape[2]:
            values = np.concatenate([values, alpha[..., None]], axis=2)
        layers.append(values)
    low, high = (
        choose.reduce(layers).clip(-HIGHEST_HALF, HIGHEST_HALF) for choose in (np.fmin, np.fmax)
    )
    return PixelRange(-half_above(-low), half_above(high))


def _shifted(image: ImageData, draw: Draw) -> list[ImageData]:
    """Draw an image at each of :data:`SHIFTS`.

    Raises
    ------
    InputError : a drawn image cannot be compared with ``image``, or its shift is too large
    """
    drawn = [as_image(draw(x, y), f"the result of draw({x:g}, {y:g})") for x, y in SHIFTS]
    shifts = np.array([compare(image, shifted).shift for shifted in drawn])
    times = float(np.vdot(shifts, SHIFTS) / np.vdot(SHIFTS, SHIFTS))
    if times > _FURTHER:
        raise InputError(
            f"draw shifts the image by {times:.2g} times its arguments: interpret these as pixels "
            "to the right and down"
        )
    return drawn
