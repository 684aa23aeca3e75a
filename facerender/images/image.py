"""Images at the edges: sRGB bytes from linear float; image files, written whole or not at all; and
what they hold."""

from __future__ import annotations

import json
import math
import os
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.images.icc import profile_of
from facerender.jpeg import Jpeg
from facerender.system.atomic import write_bytes
from facerender.system.files import open_file

if TYPE_CHECKING:
    from PIL.Image import Image

Encoding = Literal["linear", "srgb8"]

REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # what an EXR has that says nothing
SRGB_GAMMA = 0.45455  # what a PNG says of itself for programs that know no sRGB
_DESCRIPTION = 0x010E  # of Exif
_SILENT = threading.Lock()

MAX_SIDE = 16384  # pixels
MAX_PIXELS = 178_956_970  # from which on Pillow as well suspects a decompression bomb
MAX_BYTES = 1 << 31  # decoded
_UNSUSPECTED = 64 << 20  # bytes that a file of any size may hold
_MOST_PACKED = 2000  # times its size; deflate packs 1032 at most
_LONGEST_HEADER = 1 << 16  # of a NumPy array
_LONGEST_EXR = 1 << 24  # bytes of the header of an EXR
_STRIP = 256  # rows
_EXR, _NPY, _LFS = b"v/1\x01", b"\x93NUMPY", b"version https://git-lfs"
_EXR_PARTS = 0x10  # of the third byte of the flags
_HALF = 1  # as EXR numbers the kinds of a channel's values
_PXR24, _B44, _B44A, _DWAA, _DWAB = range(5, 10)  # as it numbers compressions, the lossy ones
_B44_LOSS, _DWA_LOSS = 0.012, 0.015  # at most, of the built-in head at 256 to 1024 pixels
_MOVED = ("moved_least", "moved_most")  # layers of a golden
_DWA_LEVEL = 45.0  # where the file names none
_HIGHEST_DWA_LEVEL = 1000.0  # what says more would explain any difference as its loss
_OTHERS = {  # what a file may be in place of an image, by its start
    _LFS: "a pointer of Git LFS: git lfs pull",
    b"<!doctype html": "a page of HTML",
    b"<html": "a page of HTML",
}

Format = Literal["png", "exr", "jpeg", "webp"]
WRITTEN: dict[str, Format] = {
    **{".png": "png", ".exr": "exr"},
    **{".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"},
}
QUALITY = 95  # of JPEG and WebP
ROUNDED = 12.0**-0.5  # RMS of what rounding to whole steps adds
HALVED = 2.0**-11 / 3.0**0.5  # and rounding to half floats, relative
SUFFIXES = (".exr", ".npz", ".npy", ".png", ".jpg", ".jpeg")


class Range(NamedTuple):
    """What pixels lie between, (H, W, C) each: colours, and coverage if the image has it."""

    least: NDArray[np.float16]
    most: NDArray[np.float16]


@dataclass(frozen=True, eq=False)
class Picture:
    """What an image file holds.

    Attributes
    ----------
    pixels : (H, W, 1 to 4), row 0 on top; linear float32, or float16 where an EXR has that, or the
        8-bit steps 0 to 255, uint8. An even number of channels ends with alpha
    encoding : "linear" or "srgb8"
    name : for messages
    metadata : that the file carries
    color_space : as the file says it, "" where it says nothing or sRGB
    profile : the ICC profile that its colours were converted from to sRGB, "" where they were not
    noise : RMS error that the encoding leaves in a pixel: in steps of 255, or relative to radiance,
        or to 0.01
    jpeg : how a JPEG holds its pixels, None in another file
    moved : what a movement of the camera by a hair makes of each pixel, None where the file does
        not say it
    """

    pixels: NDArray[Any]
    encoding: Encoding
    name: str
    metadata: Mapping[str, str] = field(default_factory=dict)
    color_space: str = ""
    profile: str = ""
    noise: float = 0.0
    jpeg: Jpeg | None = None
    moved: Range | None = None

    @property
    def coverage(self) -> NDArray[np.float32]:
        """Alpha (H, W), in [0, 1]; 1 in an image without, or a linear one whose alpha is unused: 0
        everywhere."""
        return self.rows(slice(None))[1]

    @property
    def color(self) -> NDArray[np.float32]:
        """Colour (H, W, 1 or 3), premultiplied by coverage, as linear images are."""
        return self.rows(slice(None))[0]

    def rows(self, rows: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return colour and coverage of some rows."""
        pixels = self.pixels[rows]
        channels = pixels.shape[2]
        color = pixels[..., : channels - 1 + channels % 2].astype(np.float32, copy=False)
        if self._opaque:
            return color, np.ones(pixels.shape[:2], dtype=np.float32)
        if self.encoding == "linear":
            return color, pixels[..., -1].astype(np.float32, copy=False)
        coverage = pixels[..., -1].astype(np.float32) / np.float32(255.0)
        return color * coverage[..., None], coverage

    def encoded_as(self, other: Picture) -> Picture:
        """Return these pixels as the file of another image would hold them: where that is a JPEG,
        after its losses. Both are 8-bit, with the same channels."""
        if other.jpeg is None or other.jpeg == self.jpeg:
            return self
        return replace(self, pixels=other.jpeg.applied(self.pixels))

    @cached_property
    def _opaque(self) -> bool:
        # Not any(), which warns of signalling NaN.
        used = self.encoding == "srgb8" or bool(np.count_nonzero(self.pixels[..., -1]))
        return self.pixels.shape[2] % 2 == 1 or not used


def srgb_to_linear(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Decode sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Encode linear values, clipped to [0, 1], as sRGB (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1.0 / 2.4) - 0.055))


@lru_cache(maxsize=1)
def _srgb_bytes() -> NDArray[np.uint8]:
    """8-bit sRGB of every float16, by its bit pattern; NaN is black."""
    halves = np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float64)
    return np.round(255.0 * linear_to_srgb(np.nan_to_num(halves))).astype(np.uint8)


def encode_srgb8(linear: NDArray[np.float32], exposure: float = 0.0) -> NDArray[np.uint8]:
    """Encode linear radiance as 8-bit sRGB, radiance 1 being white.

    A table over float16 makes it four times as fast as evaluating the power; float16 has eight
    steps or more for each step of the result, so the rounding differs from the exact one by at
    most 0.6 steps in place of 0.5.

    Parameters
    ----------
    linear : any shape
    exposure : in stops, in [-100, 100]; the radiance is multiplied by 2**exposure

    Raises
    ------
    InputError : exposure outside its domain
    """
    if not -100.0 <= exposure <= 100.0:
        raise InputError(f"exposure = {exposure:g} is outside [-100, 100]")
    with np.errstate(over="ignore"):  # beyond 65504 is infinite, and white
        scaled = linear if exposure == 0.0 else linear * np.float32(2.0**exposure)
        halves = scaled.astype(np.float16)
    return _srgb_bytes()[halves.view(np.uint16)]


def save_png(
    path: str | os.PathLike[str], pixels: NDArray[np.uint8], metadata: Mapping[str, str]
) -> None:
    """Write pixels as PNG; parameters as of :func:`png_bytes`."""
    write_bytes(path, png_bytes(pixels, metadata))


def png_bytes(pixels: NDArray[np.uint8] | NDArray[np.uint16], metadata: Mapping[str, str]) -> bytes:
    """Return a PNG of 8-bit or 16-bit pixels: (H, W), (H, W, 3) or (H, W, 4) with straight alpha.

    The same pixels and metadata give the same bytes. Every row is the difference to the one above,
    and level 1 of the compression takes a quarter of the default's time: half of Pillow's time for
    fewer bytes, without the import.
    """
    height, width = pixels.shape[:2]
    kind = {1: 0, 3: 2, 4: 6}[pixels[0, 0].size]  # grey, RGB, RGBA
    big_endian = pixels.astype(pixels.dtype.newbyteorder(">"), order="C", copy=False)
    rows = big_endian.reshape(height, -1).view(np.uint8)
    filtered = np.full((height, 1 + rows.shape[1]), 2, dtype=np.uint8)  # 2: "Up"
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    depth = 8 * pixels.itemsize
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0))]
    for key, value in metadata.items():
        try:
            chunks.append((b"tEXt", f"{key}\0{value}".encode("latin-1")))
        except UnicodeEncodeError:
            chunks.append((b"iTXt", f"{key}\0\0\0\0\0{value}".encode()))
    chunks += [(b"IDAT", zlib.compress(filtered.data, 1)), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    ]
    return b"".join([b"\x89PNG\r\n\x1a\n", *packed])


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format of an image file that will be written.

    Raises
    ------
    InputError : its suffix says none
    """
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in WRITTEN:
        raise InputError(
            f"{clipped(os.fsdecode(path))}: unknown image format {suffix!r}; give .png, .exr, .jpg "
            "or .webp"
        )
    return WRITTEN[suffix]


def check_opaque(name: str, transparent: bool) -> None:
    """Raise InputError where an image without a background goes to a file that cannot say so."""
    if transparent:
        raise InputError(f"{name} holds no transparency: give a background, or .png or .webp")


def lossy_bytes(
    kind: Literal["jpeg", "webp"], pixels: NDArray[np.uint8], metadata: Mapping[str, str]
) -> bytes:
    """Return a JPEG or WebP of 8-bit pixels (H, W, 3), in WebP also (H, W, 4) with straight alpha.

    Metadata are JSON, in the Exif field ImageDescription. Colours are not subsampled in a JPEG.

    Raises
    ------
    InputError : a JPEG with alpha; more pixels a side than the format has
    """
    from PIL import Image

    if kind == "jpeg":
        check_opaque("JPEG", pixels.shape[-1] == 4)
    exif = Image.Exif()
    exif[_DESCRIPTION] = json.dumps(dict(metadata))
    file = BytesIO()
    try:
        Image.fromarray(pixels).save(file, kind, quality=QUALITY, subsampling=0, exif=exif)
    except (OSError, ValueError) as error:
        height, width = pixels.shape[:2]
        raise InputError(
            f"no {kind} of {width} x {height} pixels can be made ({reason(error)}): give a smaller "
            "size, or .png"
        ) from None
    return file.getvalue()


def save_exr(
    path: str | os.PathLike[str],
    linear: NDArray[np.floating],
    metadata: Mapping[str, str],
    moved: Range | None = None,
) -> None:
    """Write linear pixels (H, W, 3 or 4) as OpenEXR, float32; needs the extra ``exr``.

    moved : of a :class:`Picture`, in layers of half floats
    """
    channels: dict[str, NDArray[np.floating]] = {
        "RGBA"[: linear.shape[-1]]: linear.astype(np.float32, copy=False)
    }
    if moved is not None:
        channels |= dict(zip(_MOVED, moved, strict=True))
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
        start = file.read(64).lstrip().lower()
        kind = next((kind for head, kind in _OTHERS.items() if start.startswith(head)), "")
        raise InputError(f"{name} is {kind or 'not an image'}; give a {known}") from None
    except Image.DecompressionBombError:
        raise InputError(
            f"{name} has too many pixels: at most {MAX_PIXELS:.3g}; make it smaller"
        ) from None
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise InputError(f"{name} is damaged ({reason(error)}); write it anew") from None
    check_pixels(name, *image.size, 4, length)
    return image


def read_image(path: str | os.PathLike[str]) -> Picture:
    """Read .exr (the extra ``exr``), .npz or .npy (linear float, or 8-bit), .png or .jpg (8-bit).

    Raises
    ------
    InputError : a file that is missing, damaged, too large, or of another kind; the message has the
        remedy
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: unknown image format {suffix!r}; give .exr, .npz, .npy, .png or .jpg"
        )
    with open_file(path, "an image file", MAX_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(_LONGEST_EXR if suffix == ".exr" else size)
    if not content:
        raise InputError(f"{path} is empty: write it anew")
    if content.startswith(_LFS):
        raise InputError(f"{path} is {_OTHERS[_LFS]}")
    if suffix == ".exr":
        return _read_exr(path, content, size)
    if suffix in (".npz", ".npy"):
        return _read_numpy(path, content)
    return _read_8_bit(path, content)


def picture_of(values: NDArray[Any], name: str) -> Picture:
    """Take an array (H, W), or (H, W, 1 to 4), of floats (linear) or uint8 (sRGB), as an image.

    Raises
    ------
    InputError : another shape or type
    """
    pixels = values[..., None] if values.ndim == 2 else values
    if pixels.ndim != 3 or not 1 <= pixels.shape[2] <= 4 or 0 in pixels.shape:
        raise InputError(f"{name} has shape {values.shape}: give (H, W, 3) or (H, W, 4)")
    if pixels.dtype == np.uint8:
        return Picture(pixels, "srgb8", name, noise=ROUNDED)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise InputError(f"{name} holds {pixels.dtype}: give linear float, or uint8")
    noise = HALVED if pixels.dtype == np.float16 else 0.0
    with np.errstate(over="ignore"):
        return Picture(pixels.astype(np.float32, copy=False), "linear", name, noise=noise)


def _read_exr(path: Path, start: bytes, size: int) -> Picture:
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
        with _silence():
            file = OpenEXR.File(str(path), separate_channels=not whole)
            header, found = file.header(), file.channels()
        if whole:
            pixels = found["".join(names)].pixels
        else:
            pixels = np.stack([found[name].pixels for name in names], axis=-1)
        if pixels.dtype != np.float16:
            pixels = pixels.astype(np.float32, copy=False)
        pixels = _in_window(pixels, header)
        moved = None
        if all(name in found and found[name].pixels.shape == pixels.shape for name in _MOVED):
            moved = Range(*(found[name].pixels.astype(np.float16) for name in _MOVED))
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
    return Picture(pixels, "linear", str(path), metadata, space, noise=noise, moved=moved)


def _exr_noise(header: Mapping[bytes, bytes], half: bool) -> float:
    """Return the noise of a :class:`Picture`.

    half : whether channels hold half floats

    Raises
    ------
    ValueError, struct.error : a DWA level that no image has

    References: OpenEXR, "Technical Introduction"; its DWA compressor, for the level.
    """
    compression = header[b"compression"][0]
    if compression in (_DWAA, _DWAB):
        given = header.get(b"dwaCompressionLevel")
        level = struct.unpack("<f", given)[0] if given else _DWA_LEVEL
        if not 0.0 <= level <= _HIGHEST_DWA_LEVEL:
            raise ValueError(f"DWA level {level:g} is outside [0, {_HIGHEST_DWA_LEVEL:g}]")
        return float(_DWA_LOSS * level / _DWA_LEVEL)
    if half:
        return _B44_LOSS if compression in (_B44, _B44A) else HALVED
    return 2.0**-16 / 3.0**0.5 if compression == _PXR24 else 0.0


def _exr_headers(content: bytes) -> list[dict[bytes, bytes]]:
    """Return the attributes of each part of an EXR file.

    Raises
    ------
    ValueError, IndexError, struct.error : it is none

    References: OpenEXR, "OpenEXR File Layout".
    """
    if not content.startswith(_EXR):
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
        if not content[5] & _EXR_PARTS or not content[at]:
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
    shown = np.zeros((*size, channels), dtype=pixels.dtype)
    rows = slice(max(y, 0), max(min(y + height, shown.shape[0]), 0))
    columns = slice(max(x, 0), max(min(x + width, shown.shape[1]), 0))
    place = shown[rows, columns]
    seen = pixels[max(-y, 0) :, max(-x, 0) :]
    place[:] = seen[: place.shape[0], : place.shape[1]]
    return shown


@contextmanager
def _silence() -> Iterator[None]:
    """Keep off standard output and error what OpenEXR says there, from C as well, about a damaged
    file."""
    with _SILENT, open(os.devnull, "w") as nothing, redirect_stdout(nothing):
        try:
            kept = os.dup(2)
        except OSError:  # closed
            yield
            return
        try:
            os.dup2(nothing.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


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


def _read_numpy(path: Path, content: bytes) -> Picture:
    from zipfile import ZipFile

    try:
        if content.startswith(_NPY):
            return picture_of(_array(BytesIO(content), str(path), len(content)), str(path))
        with ZipFile(BytesIO(content)) as file:
            names = [name.removesuffix(".npy") for name in file.namelist()]
            if len(names) > 1 and "linear" in names:
                names = ["linear"]
            if len(names) != 1:
                held = clipped(", ".join(names)) or "no array"
                raise InputError(f"{path} holds {held}: name one of them linear")
            (entry,) = (
                each for each in file.infolist() if each.filename.removesuffix(".npy") == names[0]
            )
            with file.open(entry) as member:
                return picture_of(_array(member, str(path), len(content)), str(path))
    except InputError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib fail in many ways
        raise InputError(f"{path} is no NumPy file ({reason(error)}); write it anew") from None


def _array(file: IO[bytes], name: str, of: int) -> NDArray[Any]:
    """Read an array, of a file of so many bytes, whose header is checked before.

    Raises
    ------
    InputError : it holds no numbers, or is no image, or too large
    """
    start = file.read(_LONGEST_HEADER)
    head = BytesIO(start)
    read = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0}
    shape, _, kind = read[npy.read_magic(head)[0]](head)
    if kind.hasobject:
        raise InputError(f"{name} holds objects of Python, which are not read: give floats")
    if len(shape) in (2, 3):
        check_pixels(name, shape[1], shape[0], kind.itemsize * math.prod(shape[2:]), of)
        file.seek(0)
        return np.asarray(npy.read_array(file, allow_pickle=False))
    raise InputError(f"{name} has shape {clipped(str(shape))}: give (H, W, 3) or (H, W, 4)")


def _read_8_bit(path: Path, content: bytes) -> Picture:
    if content.startswith(b"\x89PNG") and content[24:25] == b"\x10":  # Pillow drops the lower byte
        raise InputError(f"{path} is a 16-bit PNG: save as 8-bit PNG, or as EXR")
    image = open_image(content, str(path), ("PNG", "JPEG"), "PNG or JPEG")
    if image.mode not in ("L", "LA", "RGB", "RGBA"):
        kind = {"P": "a palette image", "CMYK": "a CMYK image", "1": "an image of single bits"}
        raise InputError(f"{path} is {kind.get(image.mode, image.mode)}: save it as RGB")
    if "transparency" in image.info:
        raise InputError(f"{path} has one transparent colour: save it as RGBA")
    try:
        pixels = texels(image, image.mode)
        jpeg = None if image.format == "PNG" else Jpeg.of(image)
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise InputError(f"{path} is damaged ({reason(error)}); write it anew") from None
    metadata = {str(key): value for key, value in image.info.items() if isinstance(value, str)}
    noise = jpeg.noise if jpeg else ROUNDED
    picture = Picture(pixels, "srgb8", str(path), metadata, noise=noise, jpeg=jpeg)
    if "icc_profile" in image.info:
        return _in_srgb(picture, image.info["icc_profile"])
    gamma = image.info.get("gamma", SRGB_GAMMA)
    if abs(gamma - SRGB_GAMMA) > 1e-4:
        return replace(picture, color_space=f"gamma {gamma:.4g}")
    return picture


def _in_srgb(picture: Picture, content: bytes | None) -> Picture:
    """Return an 8-bit image, whose pixels are its own, with its colours in sRGB.

    content : of its ICC profile, None of one that Pillow could not unpack
    """
    try:
        profile = profile_of(content or b"", "L" if picture.pixels.shape[2] < 3 else "RGB")
    except Exception as error:  # LittleCMS fails in its own ways
        raise InputError(
            f"{picture.name} has an ICC profile that cannot be used ({reason(error)}): save it as "
            "sRGB"
        ) from None
    if profile.srgb:
        return picture
    profile.convert(picture.pixels)
    noise = math.hypot(profile.gain * picture.noise, ROUNDED)
    return replace(picture, profile=clipped(profile.name), noise=noise, jpeg=None)


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
