"""Write normal maps with slope deviation as KTX 2 files, for other programs. Reference: Khronos
Group, "KTX File Format Specification", version 2."""

from __future__ import annotations

import os
import struct

import numpy as np

from facerender import __version__
from facerender.scenes.texture import Texture
from facerender.system.atomic import write_bytes
from facerender.system.files import check_suffix

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
_R8G8B8A8_UNORM = 37  # value of Vulkan's VkFormat
_CHANNELS = (0, 1, 2, 15)  # red, green, blue, alpha


def prepare_normal_map(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Write a normal map's mip chain, with slope deviation, which ``fr_slope_variance_map`` needs.

    Parameters
    ----------
    source : path of an image that :meth:`Texture.open` reads
    path : output path, .ktx2; the file contains 8-bit linear RGBA with rows from the top down

    Raises
    ------
    InputError : the image is missing, damaged or too large; the output path has a suffix other than
        .ktx2 or cannot be written
    """
    check_suffix(path, (".ktx2",), "texture")
    levels = Texture.open(source).levels("normal").result()
    texels = [np.ascontiguousarray(level[::-1]).tobytes() for level in levels]
    height, width = levels[0].shape[:2]
    described, metadata = _description(), _metadata()
    start = 80 + 24 * len(levels)
    offset = start + len(described) + len(metadata)
    places = []
    for level in reversed(texels):  # KTX 2 stores the smallest level first
        places.append(struct.pack("<3Q", offset, len(level), len(level)))
        offset += len(level)
    head = struct.pack("<9I", _R8G8B8A8_UNORM, 1, width, height, 0, 0, 1, len(levels), 0)
    index = struct.pack("<4I2Q", start, len(described), start + len(described), len(metadata), 0, 0)
    content = [_IDENTIFIER, head, index, *reversed(places), described, metadata, *reversed(texels)]
    write_bytes(path, b"".join(content))


def _description() -> bytes:
    """Return the texel format as the basic block of a Khronos data format descriptor."""
    samples = [
        struct.pack("<HBB4BII", 8 * i, 7, channel, 0, 0, 0, 0, 0, 255)
        for i, channel in enumerate(_CHANNELS)
    ]
    rgb, bt709, linear = 1, 1, 1
    block = struct.pack("<IHH4B4B8B", 0, 2, 88, rgb, bt709, linear, 0, *(0,) * 4, 4, *(0,) * 7)
    return struct.pack("<I", 92) + block + b"".join(samples)


def _metadata() -> bytes:
    pieces = []
    for key, value in (("KTXorientation", "rd"), ("KTXwriter", f"facerender {__version__}")):
        pair = f"{key}\0{value}\0".encode()
        pieces.append(struct.pack("<I", len(pair)) + pair + bytes(-len(pair) % 4))
    return b"".join(pieces)
