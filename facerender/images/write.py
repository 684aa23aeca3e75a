"""Encoding of PNG, JPEG and WebP files. Equal pixels and metadata give equal bytes."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason
from facerender.system.atomic import write_bytes
from facerender.system.files import check_suffix

Format = Literal["png", "exr", "jpeg", "webp"]
WRITTEN: dict[str, Format] = {
    **{".png": "png", ".exr": "exr"},
    **{".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"},
}
QUALITY = 95  # quality setting of JPEG and WebP, at most 100
FRAME_RATES = (0.1, 100.0)  # images per second; a GIF stores delays in hundredths of a second
PREFIX = "facerender:"
_INTERPRETED = ("alpha", "background")  # ImageMagick reads these keys of a PNG as settings


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the output format for a path. Raise InputError if its suffix is unknown."""
    return WRITTEN[check_suffix(path, (*WRITTEN,), "image")]


def check_opaque(name: str, transparent: bool) -> None:
    """Raise InputError if a transparent image is to be written to a format without alpha."""
    if transparent:
        raise InputError(f"{name} cannot store transparency: give a background, or .png or .webp")


def save_png(
    path: str | os.PathLike[str], pixels: NDArray[np.uint8], metadata: Mapping[str, str]
) -> None:
    """Write pixels as PNG; see :func:`png_bytes` for the parameters."""
    write_bytes(path, png_bytes(pixels, metadata))


def png_bytes(pixels: NDArray[np.uint8] | NDArray[np.uint16], metadata: Mapping[str, str]) -> bytes:
    """Return a PNG of 8-bit or 16-bit pixels: (H, W), (H, W, 3) or (H, W, 4) with straight alpha.

    Equal pixels and metadata give equal bytes. All rows use the PNG filter "Up". Compression level
    1 takes a quarter of the time of the default level. This encoder takes half as long as Pillow's,
    gives fewer bytes and avoids the import of Pillow.
    """
    height, width = pixels.shape[:2]
    kind = {1: 0, 3: 2, 4: 6}[pixels[0, 0].size]  # grey, RGB, RGBA
    big_endian = pixels.astype(pixels.dtype.newbyteorder(">"), order="C", copy=False)
    rows = big_endian.reshape(height, -1).view(np.uint8)
    filtered = np.full((height, 1 + rows.shape[1]), 2, dtype=np.uint8)  # 2: the filter "Up"
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    depth = 8 * pixels.itemsize
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))]
    for name, value in metadata.items():
        key = f"{PREFIX}{name}" if name in _INTERPRETED else name
        try:
            chunks.append((b"tEXt", f"{key}\0{value}".encode("latin-1")))
        except UnicodeEncodeError:
            chunks.append((b"iTXt", f"{key}\0\0\0\0\0{value}".encode()))
    chunks += [(b"IDAT", zlib.compress(filtered.data, 1)), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(data)) + chunk + data + struct.pack(">I", zlib.crc32(chunk + data))
        for chunk, data in chunks
    ]
    return b"".join([b"\x89PNG\r\n\x1a\n", *packed])


def lossy_bytes(
    kind: Literal["jpeg", "webp"], pixels: NDArray[np.uint8], metadata: Mapping[str, str]
) -> bytes:
    """Return a JPEG or WebP of 8-bit pixels (H, W, 3); WebP also accepts (H, W, 4), straight alpha.

    The Exif field ImageDescription contains the metadata as JSON. JPEG chroma is not subsampled.

    Raises
    ------
    InputError : alpha in a JPEG; more pixels on a side than the format allows
    """
    from PIL import Image

    if kind == "jpeg":
        check_opaque("JPEG", pixels.shape[-1] == 4)
    exif = Image.Exif()
    exif[0x010E] = json.dumps(dict(metadata))  # ImageDescription
    file = BytesIO()
    try:
        Image.fromarray(pixels).save(file, kind, quality=QUALITY, subsampling=0, exif=exif)
    except (OSError, ValueError) as error:
        height, width = pixels.shape[:2]
        raise InputError(
            f"{kind} cannot store {width} x {height} pixels ({reason(error)}): give a smaller "
            "size, or .png"
        ) from None
    return file.getvalue()
