"""Code shared by the readers of glTF and MTL materials: reports of missing or unreadable images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, warn
from facerender.images.decode import TooLarge, open_image
from facerender.loading.references import References
from facerender.scenes.texture import DECODERS

if TYPE_CHECKING:
    from PIL.Image import Image


class WarnOnce:
    """A callable that emits each warning once."""

    def __init__(self) -> None:
        self.warned: set[str] = set()

    def __call__(self, message: str) -> None:
        if message not in self.warned:
            self.warned.add(message)
            warn(message)


def color_bytes(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours of a mesh file as 8 bits. Programs write floats up to 1 or 255, and integers
    of any type up to 255 or, in 16 bits, up to 65535."""
    finite = np.where(np.isfinite(colors), colors, 0)
    if colors.dtype.kind == "f":
        lit = finite[finite > 0.0]
        white = 255.0 if len(lit) and np.median(lit) > 1.0 else 1.0
    else:
        white = 65535.0 if colors.dtype.itemsize == 2 and finite.max(initial=0) > 255 else 255.0
    return np.asarray(np.clip(finite * (255.0 / white), 0.0, 255.0).round(), dtype=np.uint8)


SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".tga")


def image_of(content: bytes) -> Image:
    """Open an image; its texels are decoded later.

    Raises
    ------
    TooLarge : the image has too many pixels; the message starts with "it"
    ValueError : the format is not supported, or the image is damaged
    """
    try:
        return open_image(content, "it", DECODERS, "PNG, JPEG, TIFF or WebP")
    except TooLarge:
        raise
    except InputError as error:
        raise ValueError(str(error)) from None


def unreadable(shown: str, kind: str, error: ValueError, fatal: bool) -> None:
    """Report an error of :func:`image_of`: raise InputError if ``fatal``, else warn."""
    message, advice = f"{shown} is not an image that can be read", "replace it"
    if isinstance(error, TooLarge):
        message, _, advice = f"{shown} {str(error).removeprefix('it ')}".partition("; ")
    if not fatal:
        warn(f"{message}: ignored")
        return
    option = {"albedo": "--albedo", "normal": "--normal-map", "roughness": "--roughness-map"}
    remedy = f", or pass {option[kind]} FILE" if kind in option else ""
    raise InputError(f"{message}; {advice}{remedy}")


def missing_image(referred: References, name: str) -> None:
    """Warn of a missing image. If the mesh file's folder contains exactly one image, suggest it."""
    near = referred.folder.iterdir() if referred.folder else ()
    beside = [path.name for path in near if path.suffix.lower() in SUFFIXES]
    hint = f"pass --albedo {clipped(beside[0], 80) if len(beside) == 1 else 'FILE'}"
    warn(
        f"{clipped(name, 80)} (named by {referred.name}) "
        f"{referred.why_not(name)}: rendering without it; {hint}"
    )
