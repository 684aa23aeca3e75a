"""Goldens (reference images of tests): compare an image with its golden, and write the golden.

The pytest plugin is facerender/pytest_plugin.py.
"""

from __future__ import annotations

import os
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facerender import __version__
from facerender.comparison.compare import Pair, compare
from facerender.comparison.sources import Comparable, as_image
from facerender.errors import InputError, reason
from facerender.images.files import save_exr
from facerender.images.image import ImageData

_ROUNDED = 0.2  # largest rounding error of a golden, as a part of the point limit
UNKNOWN = "an unknown renderer"


@dataclass(frozen=True)
class Updates:
    """Selection of the goldens that may be written."""

    missing: bool = False  # goldens that do not exist
    differing: bool = False  # also goldens that differ from the image, recorded by this renderer
    force: bool = False  # also goldens that differ from the image, recorded by another renderer


@dataclass(frozen=True, eq=False)
class GoldenResult:
    """The result of checking an image against its golden."""

    image: ImageData  # the checked image, with the metadata that its golden would store
    pair: Pair  # the image and its golden as it was before a new golden was written
    written: bool = False
    failure: str = ""  # reason why the image fails, with the remedy; "" if it passes


def check(
    name: str,
    source: Comparable,
    golden: Path,
    updates: Updates = Updates(),
    written: Container[Path] = (),
    *,
    metadata: Mapping[str, str] | None = None,
    **options: Any,
) -> GoldenResult:
    """Compare an image with its golden, and write the golden if allowed.

    Parameters
    ----------
    name : name of the pair in the report
    golden : path of the golden; the file may be missing
    written : goldens that were already written in this session; they are not written again
    metadata : entries that are added to the image's metadata
    options : limits and mask, see :func:`facerender.compare`

    Raises
    ------
    InputError : the image is not linear float or cannot be read, or the golden cannot be written
    """
    image = _linear_rgb(source, metadata or {})
    exists = os.path.isfile(golden)  # checked before reading: another process may write the file
    pair = Pair.of(name, golden, image, **options)
    exists = exists or pair.reference is not None
    if not exists:
        pair = replace(pair, error="no golden yet")

    def result(failure: str = "") -> GoldenResult:
        return GoldenResult(image, pair, failure=failure)

    if pair.status == 0:
        return result()
    if exists and not updates.differing:
        return result(pair.error or f"{golden.stem} differs from its golden: {pair.comparison}")
    if not (updates.missing or updates.differing):
        return result(f"{golden.stem} has no golden: --facerender-update-missing writes it")
    try:
        compare(image, image, **options)  # the image itself or its limits may be invalid
    except InputError as error:
        return result(str(error))
    if exists and not updates.force:
        if pair.reference is None:
            return result(pair.error)
        recorded, this = (
            data.metadata.get("GL_RENDERER") or UNKNOWN for data in (pair.reference, image)
        )
        if recorded != this:
            return result(
                f"{golden.name} was recorded on {recorded}, this is {this}: --facerender-force "
                "overwrites it"
            )
    if golden in written:
        return result(
            f"{golden.name} was just written for another image: give each image a new name"
        )
    _write(golden, image, options)
    return GoldenResult(image, pair, written=True)


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


def _write(path: Path, image: ImageData, options: Mapping[str, Any]) -> None:
    """Write a golden as 24-bit floats, or as float32 if rounding errors are large compared with the
    limits."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {path.parent}: {reason(error)}") from None
    pixels = image.pixels.astype(np.float32, copy=False)
    for rounded in (True, False):
        save_exr(path, pixels, image.metadata, rounded)
        comparison = Pair.of(path.name, path, image, **options).comparison
        if comparison and comparison.largest <= _ROUNDED * comparison.limits.point:
            return
