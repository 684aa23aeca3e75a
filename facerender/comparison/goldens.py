"""Goldens: images kept beside tests, which later ones must equal. What becomes of one image is
here; the pytest plugin is facerender/pytest_plugin.py."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from facerender import __version__
from facerender.comparison.compare import Comparable, as_picture, compare
from facerender.comparison.pairs import Pair
from facerender.comparison.shift_range import MOVES, range_of
from facerender.errors import InputError, reason
from facerender.images.exr import save_exr
from facerender.images.image import ImageData

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
class Verdict:
    """What became of an image.

    Attributes
    ----------
    image : with the metadata that a golden carries
    pair : it and its golden, as they were before one was written
    golden : that it was compared with, or its place
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
    image: Comparable,
    golden: Path,
    updates: Updates = Updates(),
    written: Container[Path] = (),
    *,
    metadata: Mapping[str, str] | None = None,
    draw: Draw | None = None,
    **options: Any,
) -> Verdict:
    """Compare an image with its golden, and write the golden where that is allowed.

    Parameters
    ----------
    name : of the pair, for the report
    golden : FOLDER/NAME.exr; FOLDER/NAME@RENDERER.exr is taken in its place where it exists for the
        renderer that the image's metadata names
    written : goldens that another image has become meanwhile: they are not written again
    metadata : to add to the image's own
    draw : gives the image moved by so many pixels to the right and down, of which a golden that is
        written keeps the range; without, none
    options : limits and mask, see :func:`facerender.compare`

    Raises
    ------
    InputError : the image is not linear float, cannot be read, or the golden cannot be written
    """
    picture = as_picture(image, "the image")
    if picture.encoding != "linear":
        raise InputError(
            f"{picture.name} is 8-bit, which hides what a golden is to show: give a Frame, floats "
            "or an EXR file"
        )
    if picture.pixels.shape[2] < 3:
        raise InputError(f"{picture.name} is grey: give RGB")
    merged = {"facerender": __version__, **picture.metadata, **(metadata or {})}
    picture = replace(picture, metadata=merged)
    renderer = merged.get("GL_RENDERER", "")
    own = golden.with_name(f"{golden.stem}@{renderer_name(renderer)}.exr")
    if os.path.isfile(own):
        golden = own
    pair = Pair.of(name, golden, picture, **options)
    if pair.status == 0:
        return Verdict(picture, pair, golden)

    missing = not os.path.isfile(golden)
    if missing and not (updates.missing or updates.differing):
        failure = f"{golden.stem} has no golden: --facerender-update-missing writes it"
        return Verdict(picture, pair, golden, failure=failure)
    if not missing and not updates.differing:
        failure = pair.error or f"{golden.stem} differs from its golden: {pair.comparison}"
        return Verdict(picture, pair, golden, failure=failure)
    try:
        compare(picture, picture, **options)  # what is wrong with the image itself or its limits
    except InputError as error:
        return Verdict(picture, pair, golden, failure=str(error))
    place = golden
    if not missing:
        recorded = pair.reference.metadata.get("GL_RENDERER", "") if pair.reference else None
        if recorded != renderer and updates.alternative and renderer:
            place = own
        if recorded != renderer and place == golden and not updates.force:
            failure = (
                f"{golden.name} was recorded on {recorded or UNKNOWN}, this is "
                f"{renderer or UNKNOWN}: --facerender-force overwrites it, "
                "--facerender-alternative writes one for this renderer beside it"
            )
            return Verdict(picture, pair, golden, failure=failure)
    if place in written:
        failure = f"{place.name} was written for another image just now: give each a name"
        return Verdict(picture, pair, golden, failure=failure)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {place.parent}: {reason(error)}") from None
    moved = None if draw is None else range_of([picture, *_moved(picture, draw)])
    save_exr(place, picture.pixels, picture.metadata, moved)
    return Verdict(picture, pair, golden, written=place)


def _moved(picture: ImageData, draw: Draw) -> list[ImageData]:
    """Draw an image moved by a hair.

    Raises
    ------
    InputError : what is drawn cannot be compared with the image, or is moved by more
    """
    drawn = [as_picture(draw(x, y), f"what draw({x:g}, {y:g}) gives") for x, y in MOVES]
    shifts = np.array([compare(picture, each).shift for each in drawn])
    times = float(np.vdot(shifts, MOVES) / np.vdot(MOVES, MOVES))
    if times > _FURTHER:
        raise InputError(
            f"draw moves the image by {times:.2g} times what it is given: take that as pixels to "
            "the right and down"
        )
    return drawn
