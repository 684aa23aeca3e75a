"""Decoded images: pixels, their encoding, the sRGB transfer function (IEC 61966-2-1), and the
metadata of the file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError


def srgb_to_linear(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Decode sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Encode linear values, clipped to [0, 1], as sRGB (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1.0 / 2.4) - 0.055))


_LEAST = np.float32(2.0**-13)  # smaller values are 0 in 8 bits
_BITS = 13  # last bits of a float32 that the index of a range in the table leaves out
_FIRST, _LAST = (int(np.float32(x).view(np.uint32)) >> _BITS for x in (_LEAST, 1.0))
_BLOCK = 1 << 16  # values per step, so that temporary arrays stay in the CPU's cache


@lru_cache(maxsize=1)
def _levels() -> NDArray[np.uint32]:
    """Return a number for each range of 2^13 consecutive float32 values, from 2^-13 to 1. The sum
    of this number and the last 13 bits of a value in the range is 2^13 times the value's 8-bit sRGB
    level, plus less than 2^13. At most one level begins in a range."""
    boundaries = srgb_to_linear(np.linspace(0.5, 255.5, 256) / 255.0)
    first = boundaries.astype(np.float32)  # the first value of each level
    first = np.where(first < boundaries, np.nextafter(first, np.float32(2.0)), first)
    begins = first.view(np.uint32).astype(np.int64)
    ranges = np.arange(_FIRST, _LAST + 1) << _BITS
    level = np.searchsorted(begins, ranges, side="right")
    until = np.minimum(begins[level] - ranges, 1 << _BITS)
    return ((level + 1 << _BITS) - until).astype(np.uint32)


def encode_srgb8(linear: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Encode linear radiance (N, ...) as 8-bit sRGB: the nearest of the 256 levels. Radiance 1 is
    white, and NaN is black. The table takes a fifth of the time of the power function."""
    encoded = np.empty(linear.shape, dtype=np.uint8)
    for rows in _blocks(linear):
        values = np.fmax(linear[rows], _LEAST, dtype=np.float32)
        bits = np.minimum(values, np.float32(1.0), out=values).view(np.uint32)
        total = _levels().take((bits >> _BITS) - np.uint32(_FIRST))
        total += bits & ((1 << _BITS) - 1)
        encoded[rows] = total >> _BITS
    return encoded


def encode_srgb16(linear: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Encode linear radiance as 16-bit sRGB: the nearest of the 65,536 levels; see
    :func:`encode_srgb8`."""
    encoded = np.empty(linear.shape, dtype=np.uint16)
    for rows in _blocks(linear):
        values = np.fmax(linear[rows], 0.0, dtype=np.float64)
        encoded[rows] = np.round(65535.0 * linear_to_srgb(values))
    return encoded


def _blocks(values: NDArray[np.float32]) -> Iterator[slice]:
    """Yield slices of rows that have about _BLOCK values each."""
    step = max(_BLOCK * len(values) // max(values.size, 1), 1)
    return (slice(start, start + step) for start in range(0, len(values), step))


Tone = Literal["linear", "neutral"]
TONES: tuple[Tone, ...] = get_args(Tone)


def neutral(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radiance (..., 3), at least 0, mapped to colours in [0, 1]: values up to 0.8 lose the
    0.04 that a dielectric reflects, and brighter values are compressed and desaturated.

    Source: Khronos Group (2024), "Khronos PBR Neutral Tone Mapper", PBR Neutral Specification.
    """
    least = color.min(axis=-1, keepdims=True)
    color = color - np.where(least < 0.08, least - 6.25 * least * least, np.float32(0.04))
    peak = color.max(axis=-1, keepdims=True)
    compressed = np.minimum(peak, 1.0 - 0.24**2 / np.maximum(peak - 0.52, 0.24))
    saturation = 1.0 / (0.15 * (peak - compressed) + 1.0)
    color *= compressed / np.maximum(peak, 1e-30)
    return np.asarray(compressed + saturation * (color - compressed))


Encoding = Literal["linear", "srgb8"]
# Metadata of the driver and of the package, which contain no names of files or of their parts.
DRIVER_KEYS = ("GL_RENDERER", "GL_VERSION", "facerender")
HALVED = 2.0**-11 / 3.0**0.5  # relative RMS error of rounding to half floats


@dataclass(frozen=True, eq=False)
class ImageData:
    """A decoded image."""

    # (H, W, 1 to 4), row 0 on top; linear float32 (float16 if read from a half-float EXR) or sRGB
    # uint8. If there are 2 or 4 channels, the last channel is alpha.
    pixels: NDArray[Any]
    encoding: Encoding
    name: str  # name for messages, such as the file name
    metadata: Mapping[str, str] = field(default_factory=dict)  # texts stored in the file
    color_space: str = ""  # that the file specifies; "" for sRGB or if the file specifies none
    profile: str = ""  # name of the ICC profile that was converted to sRGB, "" for none
    jpeg: bool = False  # whether the file is a JPEG, so that compression has changed the pixels
    # RMS error of the pixels. For a linear image, the error of rounding to half or 24-bit floats,
    # divided by max(radiance, 0.01). For an 8-bit image, the rounding error of the colour
    # conversion, in 8-bit levels.
    noise: float = 0.0

    def renamed(self, name: str) -> ImageData:
        """Return the image with another name, without metadata that may contain names."""
        kept = {key: text for key, text in self.metadata.items() if key in DRIVER_KEYS}
        if self.metadata.get("textures") == "float":  # such drivers' images differ less
            kept["textures"] = "float"
        return replace(self, name=name, metadata=kept, profile="")

    @property
    def color(self) -> NDArray[np.float32]:
        """Colour of all rows; see :meth:`rows`."""
        return self.rows(slice(None))[0]

    def rows(self, rows: slice) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return colour (H, W, 1 or 3), premultiplied by coverage, and coverage (H, W) of a range
        of rows. Coverage is alpha in [0, 1]. It is 1 if the image has no alpha, or if the image is
        linear and its alpha is 0 everywhere."""
        pixels = self.pixels[rows]
        channels = pixels.shape[2]
        color = pixels[..., : channels - 1 + channels % 2].astype(np.float32, copy=False)
        if self._opaque:
            return color, np.ones(pixels.shape[:2], dtype=np.float32)
        if self.encoding == "linear":
            return color, pixels[..., -1].astype(np.float32, copy=False)
        coverage = pixels[..., -1].astype(np.float32) / np.float32(255.0)
        return color * coverage[..., None], coverage

    @cached_property
    def _opaque(self) -> bool:
        # numpy.any() would warn about signalling NaN.
        used = self.encoding == "srgb8" or bool(np.count_nonzero(self.pixels[..., -1]))
        return self.pixels.shape[2] % 2 == 1 or not used


def image_from_array(values: NDArray[Any], name: str) -> ImageData:
    """Return an image from an array (H, W) or (H, W, 1 to 4) of floats (linear) or uint8 (sRGB)."""
    pixels = values[..., None] if values.ndim == 2 else values
    if pixels.ndim != 3 or not 1 <= pixels.shape[2] <= 4 or 0 in pixels.shape:
        raise InputError(f"{name} has shape {values.shape}: give (H, W, 3) or (H, W, 4)")
    if pixels.dtype == np.uint8:
        return ImageData(pixels, "srgb8", name)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise InputError(f"{name} has type {pixels.dtype}: give linear floats, or uint8")
    noise = HALVED if pixels.dtype == np.float16 else 0.0
    with np.errstate(over="ignore"):
        return ImageData(pixels.astype(np.float32, copy=False), "linear", name, noise=noise)
