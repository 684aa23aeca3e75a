"""ICC profiles: what they make of 8-bit colours, found by trying, and those colours in sRGB."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

_STEP = 17  # of 255, between the levels that are tried
_STRIP = 256  # rows
_NAMES = {"L": "grey", "RGB": "RGB"}
_SPACES = {"L": "GRAY", "RGB": "RGB"}


@dataclass(frozen=True, eq=False)
class Profile:
    """What an ICC profile makes of 8-bit colours.

    Attributes
    ----------
    name : as the profile says it
    srgb : whether it is sRGB: no colour moves by more than a step of 255
    gain : RMS factor on small differences of its colours, in the worst channel of sRGB
    """

    name: str
    srgb: bool
    gain: float
    _transform: Any

    def convert(self, pixels: NDArray[np.uint8]) -> None:
        """Replace the colours of pixels (H, W, 1 to 4) by those in sRGB, clipped to what it has;
        alpha stays."""
        count = pixels.shape[2] - 1 + pixels.shape[2] % 2
        for top in range(0, len(pixels), _STRIP):
            strip = pixels[top : top + _STRIP, :, :count]
            strip[:] = _applied(self._transform, np.ascontiguousarray(strip))


@lru_cache(maxsize=8)
def profile_of(content: bytes, mode: Literal["L", "RGB"]) -> Profile:
    """Read the ICC profile of a grey or RGB image; the last ones are kept.

    Raises
    ------
    ValueError : it is for other colours, with their name
    Exception : it is damaged; Pillow's and LittleCMS's own
    """
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(BytesIO(content))
    space = profile.profile.xcolor_space.strip()
    if space != _SPACES[mode]:
        raise ValueError(f"it is for {space}, the image is {_NAMES[mode]}")
    transform = ImageCms.ImageCmsTransform(
        profile,
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")),
        mode,
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    axes = len(mode)
    levels = np.arange(0, 256, _STEP, dtype=np.uint8)
    grid = np.stack(np.meshgrid(*[levels] * axes, indexing="ij"), axis=-1)
    greys = np.repeat(np.arange(256, dtype=np.uint8)[:, None], axes, axis=1)
    tried = np.concatenate([grid.reshape(-1, axes), greys])
    seen = _applied(transform, tried[None])[0].astype(np.float64)
    moved = seen[: -len(greys)].reshape(*grid.shape[:-1], -1)
    squares = [np.square(np.diff(moved, axis=axis) / _STEP) for axis in range(axes)]
    gain = sum(each.reshape(-1, each.shape[-1]).mean(axis=0) for each in squares)
    return Profile(
        name=profile.profile.profile_description or "no name",
        srgb=bool(np.abs(seen - tried).max() <= 1.0),
        gain=float(np.sqrt(np.max(gain))),
        _transform=transform,
    )


def _applied(transform: Any, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return colours (H, W, 1 or 3) in sRGB; a grey one stays one."""
    from PIL import Image

    grey = colors.shape[2] == 1
    seen = np.asarray(transform.apply(Image.fromarray(colors[..., 0] if grey else colors)))
    return seen[..., 1:2] if grey else seen
