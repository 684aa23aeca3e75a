"""How a JPEG holds its pixels: read from its tables, what that costs, and pixels as it would hold
them."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SIDE = 8  # pixels of a block
_ORDER = np.add.outer(np.arange(_SIDE), np.arange(_SIDE)).ravel()  # u + v of each coefficient
# RMS of a render's coefficients by their order, over its covered blocks: at most that of the
# built-in head at 256 x 256 pixels, and less where it is larger; the mean may be anything.
_LUMA = np.where(_ORDER > 0, 110.0 / np.maximum(_ORDER, 1) ** 1.5, np.inf)
_CHROMA = _LUMA / 5.0 + 0.5
_TO_RGB = np.array([[1.0, 0.0, 1.402], [1.0, -0.344136, -0.714136], [1.0, 1.772, 0.0]])  # JFIF
_ROUNDED = 1.0 / 12.0  # variance of what rounding to whole steps adds
_ADOBE_RGB = (82, 71, 66)  # components that are called R, G and B
_SAMPLINGS = {(1, 1): 0, (2, 1): 1, (2, 2): 2}  # as Pillow numbers them: 4:4:4, 4:2:2, 4:2:0


@dataclass(frozen=True)
class Jpeg:
    """How a JPEG holds its pixels.

    Attributes
    ----------
    tables : of each component, the 64 steps of its coefficients, row by row
    sampling : how many columns and rows share a chroma
    direct : whether the components are R, G and B, and not Y, Cb and Cr
    """

    tables: tuple[tuple[int, ...], ...]
    sampling: tuple[int, int]
    direct: bool

    @classmethod
    def of(cls, image: Any) -> Jpeg:
        """Return how a JPEG that Pillow has opened holds its pixels."""
        names, across, down, numbers = zip(*image.layer, strict=True)
        tables = tuple(tuple(image.quantization[number]) for number in numbers)
        sampling = (across[0] // min(across), down[0] // min(down))
        direct = names == _ADOBE_RGB or image.info.get("adobe_transform") == 0
        return cls(tables, sampling, direct)

    @property
    def noise(self) -> float:
        """RMS error of a pixel in its worst channel, in steps of 255, of a render at least as
        smooth as the built-in head at 256 x 256 pixels: where blocks are flat it is less."""
        parts = []
        for number, table in enumerate(self.tables):
            chroma = number > 0 and not self.direct
            energy = np.square(_CHROMA if chroma else _LUMA)
            error = np.minimum(np.square(table) / 12.0, energy)
            if chroma:
                across, down = (np.arange(_SIDE) >= _SIDE // each for each in self.sampling)
                lost = (down[:, None] | across).ravel()
                error = np.where(lost, np.maximum(error, energy), error)
            parts.append(error.sum() / _SIDE**2 + 2.0 * _ROUNDED)
        count = len(parts)
        to_rgb = np.eye(count) if self.direct or count == 1 else _TO_RGB
        return float(np.sqrt((np.square(to_rgb) @ parts).max() + _ROUNDED))

    def applied(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return pixels (H, W, 1 or 3), as many channels as there are tables, as such a JPEG holds
        them. A sampling that Pillow does not write is taken as 4:2:0."""
        from PIL import Image

        file = BytesIO()
        shared = {} if len(self.tables) == 1 else {"subsampling": _SAMPLINGS.get(self.sampling, 2)}
        grey = pixels.shape[2] == 1
        Image.fromarray(pixels[..., 0] if grey else pixels).save(
            file, "JPEG", qtables=self.tables, keep_rgb=self.direct, **shared
        )
        with Image.open(file, formats=("JPEG",)) as image:
            return np.asarray(image).reshape(pixels.shape)
