"""Images at the edges: sRGB bytes from linear float; image files, written whole or not at all; and
what they hold."""

from __future__ import annotations

import os
import stat
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from errno import EACCES
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.ending import if_ended, temporary_folder
from facerender.errors import InputError, reason

Encoding = Literal["linear", "srgb8"]

REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # what an EXR has that says nothing
SRGB_GAMMA = 0.45455  # what a PNG says of itself for programs that know no sRGB
_SILENT = threading.Lock()

ABANDONED = 3600.0  # seconds after which an unfinished file is nobody's any more
_UNFINISHED = ".facerender-"  # how its name begins

SUFFIXES = (".exr", ".npz", ".npy", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class Picture:
    """What an image file holds.

    Attributes
    ----------
    pixels : (H, W, 1 to 4) float32, row 0 on top; linear, or the 8-bit steps 0 to 255. An even
        number of channels ends with alpha
    encoding : "linear" or "srgb8"
    name : for messages
    metadata : that the file carries
    color_space : as the file says it, "" where it says nothing
    """

    pixels: NDArray[np.float32]
    encoding: Encoding
    name: str
    metadata: Mapping[str, str] = field(default_factory=dict)
    color_space: str = ""

    @property
    def coverage(self) -> NDArray[np.float32]:
        """Alpha (H, W), in [0, 1]; 1 in an image without, or a linear one whose alpha is unused: 0
        everywhere."""
        scale = 255.0 if self.encoding == "srgb8" else 1.0
        alpha = self.pixels[..., -1] / np.float32(scale)
        absent = self.pixels.shape[2] % 2 or (self.encoding == "linear" and not alpha.any())
        return np.ones_like(alpha) if absent else alpha

    @property
    def color(self) -> NDArray[np.float32]:
        """Colour (H, W, 1 or 3), premultiplied by coverage, as linear images are."""
        channels = self.pixels.shape[2]
        if channels % 2:
            return self.pixels
        color = self.pixels[..., :-1]
        return color if self.encoding == "linear" else color * self.coverage[..., None]


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
    scaled = linear if exposure == 0.0 else linear * np.float32(2.0**exposure)
    with np.errstate(over="ignore"):  # beyond 65504 is infinite, and white
        halves = scaled.astype(np.float16)
    return _srgb_bytes()[halves.view(np.uint16)]


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Return a path at which a file can be written, or replaced.

    Raises
    ------
    InputError : the folder is missing or not writable, the name is too long, or there is something
        else than a file
    """
    target, mode = Path(path), stat.S_IFREG
    try:
        with suppress(FileNotFoundError):
            mode = target.stat().st_mode
        target.parent.stat()
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
    except OSError as error:
        raise InputError(
            f"cannot write {target}: {reason(error)}; give a file in a writable folder"
        ) from None
    if not stat.S_ISREG(mode):
        kind = "a directory" if stat.S_ISDIR(mode) else "no regular file"
        raise InputError(f"cannot write {target}: it is {kind}; give a file name")
    return target


def write_whole(path: str | os.PathLike[str], write: Callable[[str], None]) -> None:
    """Call write with a temporary name beside path, and rename it to path when it succeeded.

    Raises
    ------
    InputError : as of :func:`check_writable`, or the disk is full
    """
    target = check_writable(path)
    temporary = target.with_name(f"{_UNFINISHED}{os.urandom(8).hex()}")

    def remove() -> None:
        with suppress(OSError):
            temporary.unlink()

    with if_ended(remove):
        try:
            write(str(temporary))
            os.replace(temporary, target)
        except OSError as error:
            why = reason(error)
            raise InputError(
                f"cannot write {target}: {why}; make room there, or give another place"
            ) from None
        finally:
            remove()


def remove_abandoned(folder: str | os.PathLike[str]) -> None:
    """Remove what :func:`write_whole` has left in a folder where its process was killed."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(_UNFINISHED):
                with suppress(OSError):
                    if entry.stat().st_mtime < time.time() - ABANDONED:
                        os.unlink(entry)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file, whole or not at all; errors as in :func:`write_whole`."""

    def write(name: str) -> None:
        Path(name).write_bytes(content)

    write_whole(path, write)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write UTF-8, what of a file's name is none escaped; as :func:`write_bytes`."""
    write_bytes(path, text.encode(errors="backslashreplace"))


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


def save_exr(
    path: str | os.PathLike[str], linear: NDArray[np.float32], metadata: Mapping[str, str]
) -> None:
    """Write linear float32 pixels (H, W, 3 or 4) as OpenEXR; needs the extra ``exr``."""
    _write_exr(path, {"RGBA"[: linear.shape[-1]]: linear}, metadata)


def exr_bytes(
    name: str, channels: Mapping[str, NDArray[np.float32]], metadata: Mapping[str, str]
) -> bytes:
    """Return an OpenEXR file of float32 channels (H, W), by their names; needs the extra ``exr``.

    name : of the file, for messages

    The same channels and metadata give the same bytes. OpenEXR before 3.5 writes files alone: they
    go through the folder of temporary files.
    """
    openexr(name)  # the temporary name says nothing to a user
    with temporary_folder() as folder:
        path = Path(folder, name)
        _write_exr(path, channels, metadata)
        return path.read_bytes()


def _write_exr(
    path: str | os.PathLike[str],
    channels: Mapping[str, NDArray[np.float32]],
    metadata: Mapping[str, str],
) -> None:
    OpenEXR = openexr(path)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {key: np.ascontiguousarray(values) for key, values in channels.items()}
    file = OpenEXR.File({**header, **metadata}, pixels)

    def write(name: str) -> None:
        try:
            file.write(name)
        except RuntimeError as error:  # whatever the cause is
            raise OSError(str(error)) from None

    write_whole(path, write)


def read_image(path: str | os.PathLike[str]) -> Picture:
    """Read .exr (the extra ``exr``), .npz or .npy (linear float, or 8-bit), .png or .jpg (8-bit).

    Raises
    ------
    InputError : a file that is missing, damaged, or of another kind; the message has the remedy
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    if not start:
        raise InputError(f"{path} is empty: write it anew")
    if start.startswith(b"version https://git-lfs"):
        raise InputError(f"{path} is a pointer of Git LFS: git lfs pull")
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return _read_exr(path)
    if suffix in (".npz", ".npy"):
        return _read_numpy(path)
    if suffix in (".png", ".jpg", ".jpeg"):
        return _read_8_bit(path, start)
    raise InputError(
        f"{path}: unknown image format {suffix!r}; give .exr, .npz, .npy, .png or .jpg"
    )


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
        return Picture(pixels.astype(np.float32), "srgb8", name)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise InputError(f"{name} holds {pixels.dtype}: give linear float, or uint8")
    with np.errstate(over="ignore"):
        return Picture(pixels.astype(np.float32), "linear", name)


def _read_exr(path: Path) -> Picture:
    OpenEXR = openexr(path)
    try:
        with _silence():
            file = OpenEXR.File(str(path), separate_channels=True)
            parts = len(file.parts)
            header = file.header()
            # Of a deep image this has lists of samples, which are no numbers.
            channels = {
                name: np.asarray(channel.pixels, dtype=np.float32)
                for name, channel in file.channels().items()
            }
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(
            f"{path} is no image that OpenEXR reads ({error}); write it anew"
        ) from None
    if parts > 1:
        raise InputError(f"{path} has {parts} parts: write the one that counts as a file")
    names = [name for name in "RGBA" if name in channels and "R" in channels]
    names = names or sorted(channels, reverse=True)
    if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"], ["Y", "A"]):
        raise InputError(f"{path} has channels {', '.join(channels)}: give R, G, B, and A if any")
    pixels = _in_window(np.stack([channels[name] for name in names], axis=-1), header)
    metadata = {key: value for key, value in header.items() if isinstance(value, str)}
    primaries = header.get("chromaticities", REC_709)
    space = "" if np.allclose(primaries, REC_709, atol=1e-4) else f"of primaries {primaries}"
    return Picture(pixels, "linear", str(path), metadata, space)


def _in_window(pixels: NDArray[np.float32], header: Mapping[str, Any]) -> NDArray[np.float32]:
    """Place the pixels of an EXR's data window in its display window; 0 around them."""
    (left, top), (right, bottom) = header["displayWindow"]
    shown = np.zeros((bottom - top + 1, right - left + 1, pixels.shape[2]), dtype=np.float32)
    x, y = np.subtract(header["dataWindow"][0], (left, top))
    height, width = pixels.shape[:2]
    rows = np.arange(max(y, 0), min(y + height, shown.shape[0]))
    columns = np.arange(max(x, 0), min(x + width, shown.shape[1]))
    shown[np.ix_(rows, columns)] = pixels[np.ix_(rows - y, columns - x)]
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


def _read_numpy(path: Path) -> Picture:
    import zipfile

    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no NumPy file ({error}); write it anew") from None
    if len(arrays) > 1 and "linear" in arrays:
        arrays = {"linear": arrays["linear"]}
    if len(arrays) != 1:
        raise InputError(f"{path} holds {', '.join(arrays) or 'no array'}: name one of them linear")
    (values,) = arrays.values()
    return picture_of(values, str(path))


def _read_8_bit(path: Path, start: bytes) -> Picture:
    from PIL import Image, UnidentifiedImageError

    if start.startswith(b"\x89PNG") and start[24:25] == b"\x10":  # Pillow would drop the lower byte
        raise InputError(f"{path} is a 16-bit PNG: save as 8-bit PNG, or as EXR")
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            image.load()
    except UnidentifiedImageError:
        raise InputError(f"{path} is neither PNG nor JPEG: write it anew") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is damaged ({error}); write it anew") from None
    if image.mode not in ("L", "LA", "RGB", "RGBA"):
        kind = {"P": "a palette image", "CMYK": "a CMYK image", "1": "an image of single bits"}
        raise InputError(f"{path} is {kind.get(image.mode, image.mode)}: save it as RGB")
    if "transparency" in image.info:
        raise InputError(f"{path} has one transparent colour: save it as RGBA")
    metadata = {str(key): value for key, value in image.info.items() if isinstance(value, str)}
    profile = image.info.get("icc_profile") or b""
    space = f"ICC profile {zlib.crc32(profile):08x}" if profile else ""
    gamma = image.info.get("gamma", SRGB_GAMMA)
    if abs(gamma - SRGB_GAMMA) > 1e-4:
        space = space or f"gamma {gamma:.4g}"
    return Picture(
        np.asarray(image, dtype=np.float32).reshape(image.height, image.width, -1),
        "srgb8",
        str(path),
        metadata,
        space,
    )
