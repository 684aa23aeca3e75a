"""Images at the edges: sRGB bytes from linear float, PNG and EXR files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason


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


def write_whole(path: str | os.PathLike[str], write: Callable[[str], None]) -> None:
    """Call write with a temporary name beside path, and rename it to path when it succeeded.

    Raises
    ------
    InputError : the folder is missing or not writable, or path is a folder
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"cannot write {target}: it is a directory; give a file name")
    try:
        handle, temporary = tempfile.mkstemp(
            prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent
        )
    except OSError as error:
        why = reason(error)
        raise InputError(f"cannot write {target}: {why}; give a writable place") from None
    os.close(handle)
    try:
        write(temporary)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        Path(temporary).unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def save_png(
    path: str | os.PathLike[str], pixels: NDArray[np.uint8], metadata: Mapping[str, str]
) -> None:
    """Write 8-bit pixels, (H, W), (H, W, 3) or (H, W, 4) with straight alpha, as PNG."""
    from PIL import Image, PngImagePlugin

    text = PngImagePlugin.PngInfo()
    for key, value in metadata.items():
        text.add_text(key, value)
    image = Image.fromarray(pixels)
    # Level 1 takes a quarter of the default's time for 10 % more bytes.
    write_whole(path, lambda name: image.save(name, "PNG", compress_level=1, pnginfo=text))


def save_exr(
    path: str | os.PathLike[str], linear: NDArray[np.float32], metadata: Mapping[str, str]
) -> None:
    """Write linear float32 pixels (H, W, 3 or 4) as OpenEXR; needs the extra ``exr``."""
    try:
        import OpenEXR
    except ImportError:
        raise InputError(
            f"cannot write {path}: EXR needs the package OpenEXR; pip install 'facerender[exr]'"
        ) from None
    channels = {"RGBA"[: linear.shape[-1]]: np.ascontiguousarray(linear)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    file = OpenEXR.File({**header, **metadata}, channels)

    def write(name: str) -> None:
        try:
            file.write(name)
        except RuntimeError as error:  # whatever the cause is
            raise OSError(str(error)) from None

    write_whole(path, write)
