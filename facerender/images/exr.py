"""OpenEXR files, read and written by the package OpenEXR (the extra ``exr``)."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.images.decode import check_pixels
from facerender.images.image import HALVED, ImageData, PixelRange
from facerender.system.atomic import write_bytes
from facerender.system.standard_error import redirected_stderr

REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # default primaries and white of EXR
_MAGIC = b"v/1\x01"
_MULTIPART = 0x10  # of the third byte of the flags
_HALF = 1  # as EXR numbers the kinds of a channel's values
_PXR24, _B44, _B44A, _DWAA, _DWAB = range(5, 10)  # as it numbers compressions, the lossy ones
_B44_LOSS, _DWA_LOSS = 0.012, 0.015  # at most, of the built-in head at 256 to 1024 pixels
_MOVED = ("moved_least", "moved_most")  # layers of a golden
_DWA_LEVEL = 45.0  # where the file names none
_HIGHEST_DWA_LEVEL = 1000.0  # a higher level would explain any difference as its loss


def save_exr(
    path: str | os.PathLike[str],
    linear: NDArray[np.floating],
    metadata: Mapping[str, str],
    shift_range: PixelRange | None = None,
) -> None:
    """Write linear pixels (H, W, 3 or 4) as OpenEXR, float32; needs the extra ``exr``.

    shift_range : of an :class:`ImageData`, in layers of half floats
    """
    channels: dict[str, NDArray[np.floating]] = {
        "RGBA"[: linear.shape[-1]]: linear.astype(np.float32, copy=False)
    }
    if shift_range is not None:
        channels |= dict(zip(_MOVED, shift_range, strict=True))
    write_bytes(path, exr_bytes(os.fspath(path), channels, metadata))


def exr_bytes(
    name: str, channels: Mapping[str, NDArray[np.floating]], metadata: Mapping[str, str]
) -> bytes:
    """Return an OpenEXR file of channels (H, W), or of several in one (H, W, C), by their names:
    half floats as such, all else as float32; needs the extra ``exr``.

    name : of the file, for messages

    The same channels and metadata give the same bytes. A file that OpenEXR writes itself can end
    too early without a word: it does not look whether its last buffer still had room.
    """
    OpenEXR = openexr(name)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {
        key: np.ascontiguousarray(values, np.float16 if values.dtype == np.float16 else np.float32)
        for key, values in channels.items()
    }
    content = BytesIO()
    OpenEXR.File({**header, **metadata}, pixels).write(content)
    return content.getvalue()


def read_exr(path: Path, start: bytes, size: int) -> ImageData:
    """Read an EXR file of so many bytes, whose header is in its start."""
    OpenEXR = openexr(path)
    try:
        raw = _checked_exr(path, _exr_headers(start), size)
        kinds = _exr_channels(raw)
        names = [name for name in "RGBA" if name in kinds and "R" in kinds]
        names = names or sorted(kinds, reverse=True)
        if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"], ["Y", "A"]):
            channels = clipped(", ".join(kinds))
            raise InputError(f"{path} has channels {channels}: give R, G, B, and A if any")
        whole = len(names) > 2 and len({kinds[name] for name in names}) == 1
        # OpenEXR prints what it thinks of a damaged file.
        with open(os.devnull, "w") as nothing, redirected_stderr(nothing), redirect_stdout(nothing):
            file = OpenEXR.File(str(path), separate_channels=not whole)
            header, found = file.header(), file.channels()
        if whole:
            pixels = found["".join(names)].pixels
        else:
            pixels = np.stack([found[name].pixels for name in names], axis=-1)
        if pixels.dtype != np.float16:
            pixels = pixels.astype(np.float32, copy=False)
        pixels = _in_window(pixels, header)
        shift_range = None
        if all(name in found and found[name].pixels.shape == pixels.shape for name in _MOVED):
            shift_range = PixelRange(*(found[name].pixels.astype(np.float16) for name in _MOVED))
        metadata = {key: value for key, value in header.items() if isinstance(value, str)}
        primaries = header.get("chromaticities", REC_709)
        space = "" if np.allclose(primaries, REC_709, atol=1e-4) else f"of primaries {primaries}"
        noise = _exr_noise(raw, any(kinds[name] == _HALF for name in names))
    except InputError:
        raise
    except Exception as error:  # of its own, and of what a damaged file makes of a header
        raise InputError(
            f"{path} is no image that OpenEXR reads ({reason(error)}); write it anew"
        ) from None
    return ImageData(
        pixels, "linear", str(path), metadata, space, noise=noise, shift_range=shift_range
    )


def _exr_noise(header: Mapping[bytes, bytes], half: bool) -> float:
    """Return the noise of an :class:`ImageData`.

    half : whether channels hold half floats

    Raises
    ------
    ValueError, struct.error : a DWA level that no image has

    References: OpenEXR, "Technical Introduction"; its DWA compressor, for the level.
    """
    compression = header[b"compression"][0]
    if compression in (_DWAA, _DWAB):
        value = header.get(b"dwaCompressionLevel")
        level = struct.unpack("<f", value)[0] if value else _DWA_LEVEL
        if not 0.0 <= level <= _HIGHEST_DWA_LEVEL:
            raise ValueError(f"DWA level {level:g} is outside [0, {_HIGHEST_DWA_LEVEL:g}]")
        return float(_DWA_LOSS * level / _DWA_LEVEL)
    if half:
        return _B44_LOSS if compression in (_B44, _B44A) else HALVED
    return 2.0**-16 / 3.0**0.5 if compression == _PXR24 else 0.0


def _exr_headers(content: bytes) -> list[dict[bytes, bytes]]:
    """Return the attributes of each part of an EXR file. OpenEXR itself reads some damaged headers
    with defaults in place of what is missing, as an image of 64 x 64 pixels.

    Raises
    ------
    ValueError, IndexError, struct.error : it is none

    References: OpenEXR, "OpenEXR File Layout".
    """
    if not content.startswith(_MAGIC):
        raise ValueError("it does not start as EXR files do")
    headers, at = [], 8
    while True:
        header: dict[bytes, bytes] = {}
        while content[at]:
            end = content.index(0, at)
            start = content.index(0, end + 1) + 5
            (size,) = struct.unpack_from("<I", content, start - 4)
            header[content[at:end]] = content[start : start + size]
            at = start + size
        headers.append(header)
        at += 1
        if not content[5] & _MULTIPART or not content[at]:
            return headers


def _exr_channels(header: Mapping[bytes, bytes]) -> dict[str, int]:
    """Return the number of the kind of each channel's values, by its name."""
    channels, at, kinds = header[b"channels"], 0, {}
    while channels[at]:
        end = channels.index(0, at)
        kinds[channels[at:end].decode()] = int.from_bytes(channels[end + 1 : end + 5], "little")
        at = end + 17
    return kinds


def _checked_exr(
    path: Path, headers: Sequence[Mapping[bytes, bytes]], of: int
) -> Mapping[bytes, bytes]:
    """Return the header of a flat image of one part; refuse others, and what is too large, before
    OpenEXR reads it."""
    if len(headers) > 1:
        raise InputError(f"{path} has {len(headers)} parts: write the one that counts as a file")
    (header,) = headers
    if header.get(b"type", b"").startswith(b"deep"):
        raise InputError(f"{path} is a deep image: flatten it")
    count = len(_exr_channels(header))
    for name, most in ((b"dataWindow", max(count, 4)), (b"displayWindow", 4)):
        left, top, right, bottom = struct.unpack("<4i", header[name])
        check_pixels(str(path), right - left + 1, bottom - top + 1, 4 * most, of)
    return header


def _in_window(pixels: NDArray[Any], header: Mapping[str, Any]) -> NDArray[Any]:
    """Place the pixels of an EXR's data window in its display window; 0 around them."""
    (left, top), (right, bottom) = np.asarray(header["displayWindow"]).tolist()
    size = (bottom - top + 1, right - left + 1)
    corner = np.asarray(header["dataWindow"]).tolist()[0]
    x, y = corner[0] - left, corner[1] - top
    height, width, channels = pixels.shape
    if (x, y, height, width) == (0, 0, *size):
        return pixels
    placed = np.zeros((*size, channels), dtype=pixels.dtype)
    rows = slice(max(y, 0), max(min(y + height, size[0]), 0))
    columns = slice(max(x, 0), max(min(x + width, size[1]), 0))
    window = placed[rows, columns]
    window[:] = pixels[max(-y, 0) :, max(-x, 0) :][: window.shape[0], : window.shape[1]]
    return placed


def openexr(path: str | os.PathLike[str]) -> Any:
    """Return the package OpenEXR.

    path : of a file that needs it, for the message

    Raises
    ------
    InputError : it is not installed
    """
    try:
        import OpenEXR
    except ImportError:
        raise InputError(
            f"{path}: EXR needs the package OpenEXR; pip install 'facerender[exr]'"
        ) from None
    return OpenEXR
