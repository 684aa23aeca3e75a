"""Decoding of images with Pillow. Size limits are checked before memory is allocated."""

from __future__ import annotations

import os
import re
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.system.files import check_downloaded

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_SIDE = 16384  # largest width or height in pixels
MAX_PIXELS = 178_956_970  # above this number, Pillow raises DecompressionBombError
MAX_BYTES = 1 << 31  # largest size of a decoded image, in bytes
_UNSUSPECTED = 64 << 20  # decoded bytes; up to this size the compression ratio is not checked
_MOST_PACKED = 2000  # largest compression ratio; deflate reaches 1032
_STRIP = 256  # number of rows that are converted at once


class TooLarge(InputError):
    """An image has too many pixels."""


def check_pixels(name: str, width: int, height: int, bytes_each: int, of: float) -> None:
    """Check the size of an image before memory for its pixels is allocated.

    Parameters
    ----------
    bytes_each : number of bytes of a decoded pixel
    of : size of the file in bytes; infinite for an image that is not from a file

    Raises
    ------
    TooLarge : more than MAX_SIDE pixels on a side; more than MAX_PIXELS pixels; or more than
        MAX_BYTES when decoded
    InputError : no pixels, or more pixels than a file of this size can contain
    """
    size, content = f"{name} is {width} x {height} pixels", width * height * bytes_each
    if width < 1 or height < 1:
        raise InputError(f"{size}: save it again")
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS or content > MAX_BYTES:
        raise TooLarge(
            f"{size} of {bytes_each} bytes: at most {MAX_SIDE} a side, {MAX_PIXELS:.3g} pixels and "
            f"{MAX_BYTES >> 20} MiB; make it smaller"
        )
    if content > _UNSUSPECTED and content > _MOST_PACKED * of:
        raise InputError(f"{size}, which {of} bytes cannot hold: it is damaged; save it again")


def open_image(content: bytes | BinaryIO, name: str, formats: tuple[str, ...], known: str) -> Image:
    """Open an image with Pillow and check its size. The pixels are decoded later.

    Parameters
    ----------
    content : bytes of the file, or the file, which must stay open until the pixels are decoded
    formats : accepted formats, as Pillow names them
    known : text for the error message that lists the recommended formats

    Raises
    ------
    InputError : a format that is not accepted, a damaged file, or TooLarge
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
    except Image.DecompressionBombError as error:
        count = re.search("[0-9]+", str(error))
        raise TooLarge(
            f"{name} has {count[0] if count else 'too many'} pixels: at most {MAX_SIDE} a side and "
            f"{MAX_PIXELS:.3g} pixels; make it smaller"
        ) from None
    except Exception as error:  # Pillow's decoders raise many types
        raise InputError(f"{name} is damaged ({reason(error)}); save it again") from None
    check_pixels(name, *image.size, 4, length)
    return image


def in_srgb(image: Image, profile: bytes) -> tuple[Image, str]:
    """Convert an image in mode L, RGB or CMYK from an ICC profile to sRGB, with relative
    colorimetric intent, clipped to the sRGB gamut. Return the image in mode RGB, and the name of
    the profile.

    Raises
    ------
    OSError, ImageCms.PyCMSError : the profile is damaged, or does not match the channels
    """
    from PIL import ImageCms

    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    srgb, intent = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
    transform = ImageCms.buildTransform(source, srgb, image.mode, "RGB", intent)
    converted = ImageCms.applyTransform(image, transform)
    assert converted is not None  # only a conversion in place returns None
    return converted, clipped(source.profile.profile_description or "no name")


def texels(image: Image, mode: str) -> NDArray[np.uint8]:
    """Return the pixels of a Pillow image, converted to a mode, as an array (H, W, channels).
    The image is converted in strips to avoid a second full copy. Pillow's errors are not caught.
    """
    image.load()
    pixels = np.empty((image.height, image.width, len(mode)), dtype=np.uint8)
    for top in range(0, image.height, _STRIP):
        strip = image.crop((0, top, image.width, min(top + _STRIP, image.height)))
        rows = pixels[top : top + _STRIP]
        strip = strip if strip.mode == mode else strip.convert(mode)
        rows[:] = np.asarray(strip).reshape(rows.shape)
    return pixels
