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
from facerender.images.exr import save_exr
from facerender.images.image import ImageData

_ROUNDED = 0.2  # largest rounding error of a golden, as a part of the point limit
UNKNOWN = "an unknown renderer"


@dataclass(frozen=True)
class Updates:
    """Selection of the goldens that may be written.

    Attributes
    ----------
    missing : goldens that do not exist
    differing : also goldens that differ from the image, if this renderer recorded them
    force : also goldens that differ from the image and that another renderer recorded
    """

    missing: bool = False
    differing: bool = False
    force: bool = False


@dataclass(frozen=True, eq=False)
class GoldenResult:
    """The result of checking an image against its golden.

    Attributes
    ----------
    image : the checked image, with the metadata that its golden would store
    pair : the image and its golden as it was before a new golden was written
    written : whether the golden was written
    failure : reason why the image fails, with the remedy; "" if it passes
    """

    image: ImageData
    pair: Pair
    written: bool = False
    failure: str = ""


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
    if not exists and pair.reference is None:
        pair = replace(pair, error="no golden yet")
    if pair.status == 0:
        return GoldenResult(image, pair)
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
    if not failure and exists and pair.reference is None:
        failure = "" if updates.force else pair.error
    elif not failure and pair.reference is not None:
        recorded, this = (
            picture.metadata.get("GL_RENDERER") or UNKNOWN for picture in (pair.reference, image)
        )
        if recorded != this and not updates.force:
            failure = (
                f"{golden.name} was recorded on {recorded}, this is {this}: --facerender-force "
                "overwrites it"
            )
    if not failure and golden in written:
        failure = f"{golden.name} was just written for another image: give each image a new name"
    if failure:
        return GoldenResult(image, pair, failure=failure)
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
