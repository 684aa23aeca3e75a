"""Images decoded by Pillow, and limits of the size of every image, checked before there is memory
for it."""

from __future__ import annotations

import os
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason
from facerender.system.files import check_downloaded

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_SIDE = 16384  # pixels
MAX_PIXELS = 178_956_970  # from which on Pillow as well suspects a decompression bomb
MAX_BYTES = 1 << 31  # decoded
_UNSUSPECTED = 64 << 20  # bytes that a file of any size may hold
_MOST_PACKED = 2000  # times its size; deflate packs 1032 at most
_STRIP = 256  # rows


def check_pixels(name: str, width: int, height: int, bytes_each: int, of: float) -> None:
    """Check the size of an image that a file claims to hold, before there is memory for it.

    Parameters
    ----------
    bytes_each : that a pixel takes, decoded
    of : bytes, of the file

    Raises
    ------
    InputError : no pixel, more than MAX_SIDE a side, MAX_PIXELS or MAX_BYTES, or far more than a
        file of so many bytes can hold
    """
    size, content = f"{name} is {width} x {height} pixels", width * height * bytes_each
    if width < 1 or height < 1:
        raise InputError(f"{size}: write it anew")
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS or content > MAX_BYTES:
        raise InputError(
            f"{size} of {bytes_each} bytes: at most {MAX_SIDE} a side, {MAX_PIXELS:.3g} pixels and "
            f"{MAX_BYTES >> 20} MiB; make it smaller"
        )
    if content > _UNSUSPECTED and content > _MOST_PACKED * of:
        raise InputError(f"{size}, which {of} bytes cannot hold: it is damaged; write it anew")


def open_image(content: bytes | BinaryIO, name: str, formats: tuple[str, ...], known: str) -> Image:
    """Return a Pillow image of a file, its size checked; its pixels are decoded later.

    Parameters
    ----------
    content : of the file, or the file, which stays open until then
    formats : that it may have, as Pillow names them
    known : those to give, in words

    Raises
    ------
    InputError : it has none of them, or is damaged or too large
    """
    from PIL import Image, UnidentifiedImageError

    file = BytesIO(content) if isinstance(content, bytes) else content
    length = file.seek(0, os.SEEK_END)
    file.seek(0)
    try:
        image = Image.open(file, formats=formats)
    except UnidentifiedImageError:
        file.seek(0)
        check_downloaded(file.read(64), f"{name} is")
        raise InputError(f"{name} is not an image; give a {known}") from None
    except Image.DecompressionBombError:
        raise InputError(
            f"{name} has too many pixels: at most {MAX_PIXELS:.3g}; make it smaller"
        ) from None
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise InputError(f"{name} is damaged ({reason(error)}); write it anew") from None
    check_pixels(name, *image.size, 4, length)
    return image


def texels(image: Image, mode: str) -> NDArray[np.uint8]:
    """Return the pixels of a Pillow image in a mode, (H, W, channels), strip by strip, so that no
    other copy of the whole is made; raises whatever Pillow does."""
    image.load()
    pixels = np.empty((image.height, image.width, len(mode)), dtype=np.uint8)
    for top in range(0, image.height, _STRIP):
        strip = image.crop((0, top, image.width, min(top + _STRIP, image.height)))
        rows = pixels[top : top + _STRIP]
        rows[:] = np.asarray(strip if strip.mode == mode else strip.convert(mode)).reshape(
            rows.shape
        )
    return pixels
