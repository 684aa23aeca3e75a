"""Reading and writing of OpenEXR files with the package OpenEXR (the extra ``exr``)."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from contextlib import redirect_stdout
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.images.decode import check_pixels
from facerender.images.image import HALVED, ImageData
from facerender.system.atomic import write_bytes
from facerender.system.standard_error import redirected_stderr

# EXR's default chromaticities: x and y of red, green, blue and white.
REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
_MAGIC = b"v/1\x01"
_MULTIPART = 0x10  # bit in byte 5 of an EXR file, set if the file has several parts
_HALF = 1  # EXR's number for the pixel type HALF
_PXR24 = 5  # EXR's number for the compression PXR24


def save_exr(
    path: str | os.PathLike[str],
    linear: NDArray[np.floating],
    metadata: Mapping[str, str],
    rounded: bool = False,
) -> None:
    """Write linear pixels (H, W, 3 or 4) as OpenEXR. Needs the extra ``exr``.

    linear, rounded : see :func:`exr_bytes`
    """
    channels = {"RGBA"[: linear.shape[-1]]: linear}
    write_bytes(path, exr_bytes(os.fspath(path), channels, metadata, rounded))


def exr_bytes(
    name: str,
    channels: Mapping[str, NDArray[np.floating]],
    metadata: Mapping[str, str],
    rounded: bool = False,
) -> bytes:
    """Return the bytes of an OpenEXR file. Needs the extra ``exr``.

    name : file name for messages
    channels : arrays keyed by the channel name: (H, W), or (H, W, C) for several channels. float16
        is written as half floats, any other type as float32
    rounded : whether float32 is rounded to 24 bits (PXR24), with a relative error up to 2^-16;
        default false: all values are stored exactly

    Equal channels and metadata give equal bytes. The file is built in memory because
    OpenEXR ignores a failed write of its last buffer, for example on a full disk.
    """
    OpenEXR = openexr(name)
    compression = OpenEXR.PXR24_COMPRESSION if rounded else OpenEXR.ZIP_COMPRESSION
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    pixels = {
        key: np.ascontiguousarray(values, np.float16 if values.dtype == np.float16 else np.float32)
        for key, values in channels.items()
    }
    content = BytesIO()
    OpenEXR.File({**header, **metadata}, pixels).write(content)
    return content.getvalue()


def read_exr(path: Path, start: bytes, size: int) -> ImageData:
    """Read an EXR file.

    start : first bytes of the file, which contain the header
    size : size of the file in bytes
    """
    OpenEXR = openexr(path)
    try:
        raw = _checked_exr(path, start, size)
        kinds = _exr_channels(raw)
        names = [name for name in "RGBA" if name in kinds and "R" in kinds]
        names = names or sorted(kinds, reverse=True)
        if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"], ["Y", "A"]):
            channels = clipped(", ".join(kinds))
            raise InputError(f"{path} has channels {channels}: give R, G, B and optionally A")
        interleaved = len(names) > 2 and len({kinds[name] for name in names}) == 1
        # For a damaged file OpenEXR prints to standard output and standard error.
        with open(os.devnull, "w") as nothing, redirected_stderr(nothing), redirect_stdout(nothing):
            file = OpenEXR.File(str(path), separate_channels=not interleaved)
            header, file_channels = file.header(), file.channels()
        if interleaved:
            pixels = file_channels["".join(names)].pixels
        else:
            pixels = np.stack([file_channels[name].pixels for name in names], axis=-1)
        if pixels.dtype != np.float16:
            pixels = pixels.astype(np.float32, copy=False)
        metadata = {key: value for key, value in header.items() if isinstance(value, str)}
        primaries = header.get("chromaticities", REC_709)
        space = "" if np.allclose(primaries, REC_709, atol=1e-4) else f"of primaries {primaries}"
        noise = 2.0**-16 / 3.0**0.5 if raw[b"compression"][0] == _PXR24 else 0.0
        noise = HALVED if _HALF in map(kinds.get, names) else noise
    except InputError:
        raise
    except Exception as error:  # from OpenEXR, or from parsing a damaged header
        raise InputError(
            f"{path} cannot be read as OpenEXR ({reason(error)}); save it again"
        ) from None
    return ImageData(pixels, "linear", str(path), metadata, space, noise=noise)


def _exr_headers(content: bytes) -> list[dict[bytes, bytes]]:
    """Return the attributes of each part of an EXR file.

    Headers are parsed here because OpenEXR reads some damaged headers as an image of 64 x 64
    pixels: it replaces missing attributes with defaults.

    Raises
    ------
    ValueError, IndexError, struct.error : the bytes are no EXR header

    References: OpenEXR, "OpenEXR File Layout".
    """
    if not content.startswith(_MAGIC):
        raise ValueError("it does not start with the EXR signature")
    headers, offset = [], 8
    while True:
        header: dict[bytes, bytes] = {}
        while content[offset]:
            end = content.index(0, offset)
            start = content.index(0, end + 1) + 5
            (size,) = struct.unpack_from("<I", content, start - 4)
            header[content[offset:end]] = content[start : start + size]
            offset = start + size
        headers.append(header)
        offset += 1
        if not content[5] & _MULTIPART or not content[offset]:
            return headers


def _exr_channels(header: Mapping[bytes, bytes]) -> dict[str, int]:
    """Return EXR's pixel type number of each channel, keyed by the channel name."""
    channels, offset, kinds = header[b"channels"], 0, {}
    while channels[offset]:
        end = channels.index(0, offset)
        kinds[channels[offset:end].decode()] = int.from_bytes(channels[end + 1 : end + 5], "little")
        offset = end + 17
    return kinds


def _checked_exr(path: Path, start: bytes, size: int) -> Mapping[bytes, bytes]:
    """Return the header of a flat image with one part. Raise InputError for an image that is deep,
    has several parts or two windows, or is too large, before OpenEXR reads the pixels."""
    headers = _exr_headers(start)
    if len(headers) > 1:
        raise InputError(f"{path} has {len(headers)} parts: save one part as a file")
    (header,) = headers
    if header.get(b"type", b"").startswith(b"deep"):
        raise InputError(f"{path} is a deep image: flatten it")
    if header[b"dataWindow"] != header[b"displayWindow"]:
        raise InputError(
            f"{path} has a data window that is not its display window: save it with one window"
        )
    left, top, right, bottom = struct.unpack("<4i", header[b"dataWindow"])
    bytes_of_pixel = 4 * max(len(_exr_channels(header)), 4)
    check_pixels(str(path), right - left + 1, bottom - top + 1, bytes_of_pixel, size)
    return header


def openexr(path: str | os.PathLike[str]) -> Any:
    """Return the package OpenEXR. Raise InputError if it is not installed."""
    try:
        import OpenEXR
    except ImportError:
        raise InputError(
            f"{path}: EXR files need the package OpenEXR; pip install 'facerender[exr]'"
        ) from None
    return OpenEXR
