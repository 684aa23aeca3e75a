"""Bump maps: heights as normal maps. A file that is called a bump map may hold either."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason
from facerender.scenes.texture import Texture, with_green_turned

if TYPE_CHECKING:
    from PIL.Image import Image

# The height of white over black, by the width of the map: 2.5 mm where that goes once around a head
# of 500 mm. MTL gives no unit.
DEPTH = 0.005
_LOOKED_AT = 64  # texels of a side
_GREY = 8.0  # mean difference of the channels of a grey image, as JPEG has it
_STRIP = 256  # rows


class Bump(Texture):
    """A normal map of a bump map, which is told by its colours, when it is decoded: heights are
    grey; normals have a length of 1 and point outwards, which is blue."""

    _image: Image | None = None  # a copy of a pickle has texels alone

    def __init__(self, image: Image, name: str, green_down: bool = False) -> None:
        def decode() -> Image:
            try:
                if not _is_normal_map(image):
                    return _normals(image)
                return with_green_turned(image) if green_down else image
            except Exception as error:  # each decoder of Pillow fails in its own way
                raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None

        super().__init__(decode, name, image.size)
        self._image = image

    def turned_green(self) -> Texture:
        """This texture, with green upwards if it is a map of normals; heights have none."""
        if self._image is None:
            return super().turned_green()
        return Bump(self._image, self.name, green_down=True)


def _is_normal_map(image: Image) -> bool:
    if image.mode not in ("RGB", "RGBA", "P"):
        return False
    texels = image.convert("RGB").resize((_LOOKED_AT, _LOOKED_AT))
    values = np.asarray(texels, dtype=np.float64)
    if float(np.ptp(values, axis=-1).mean()) < _GREY:
        return False
    normals = values / 127.5 - 1.0
    length = np.linalg.norm(normals, axis=-1)
    return bool((np.abs(length - 1.0) < 0.25).mean() > 0.9 and normals[..., 2].mean() > 0.5)


def _normals(image: Image) -> Image:
    """Return heights in any mode as a normal map, green up."""
    from PIL import Image as images

    deep = image.mode.startswith(("I", "F"))
    heights = np.asarray(image if deep else image.convert("L"))
    scale = 1.0 if image.mode == "F" else 65535.0 if deep else 255.0
    height, width = heights.shape
    normals = np.empty((height, width, 3), dtype=np.uint8)
    for top in range(0, height, _STRIP):
        start, end = max(top - 1, 0), min(top + _STRIP + 1, height)
        own = slice(top - start, min(top + _STRIP, height) - start)
        rows = heights[start:end].astype(np.float32) * np.float32(DEPTH / scale)
        # Rows go down, and green up: both signs of the second are turned.
        slopes = np.stack([-_slope(rows, 1) * width, _slope(rows, 0) * height], axis=-1)[own]
        length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
        unit = np.concatenate([slopes, np.ones_like(length)], axis=-1) / length
        normals[top : top + _STRIP] = np.round(unit * 127.5 + 127.5)
    return images.fromarray(normals)


def _slope(rows: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the difference per texel; none where there is one texel."""
    if rows.shape[axis] < 2:
        return np.zeros_like(rows)
    return np.asarray(np.gradient(rows, axis=axis))
