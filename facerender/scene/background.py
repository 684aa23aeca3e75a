"""Backgrounds that images show behind the mesh: a colour, an image, or the environment map."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import PurePath
from typing import Any, TypeAlias

import numpy as np

from facerender.errors import InputError
from facerender.images.files import SUFFIXES
from facerender.images.image import ImageData, image_from_array, srgb_to_linear
from facerender.values.fields import PATH, VectorRange
from facerender.values.vectors import MAX_RADIANCE, Array, Float32, Vector

BackgroundSource: TypeAlias = "Vector | ImageData | Array | str | os.PathLike[str] | None"
ENVIRONMENT = "environment"  # the background that shows the environment map


class _Backgrounds(VectorRange):
    """Colours, "none", ENVIRONMENT, and images: paths, arrays or :class:`ImageData`."""

    def check(self, name: str, value: Any) -> Any:
        if isinstance(value, os.PathLike) or is_image(value):
            return PATH.check(name, value)
        if isinstance(value, np.ndarray) and value.ndim > 1:
            return image_from_array(value, name)
        named = isinstance(value, ImageData) or (isinstance(value, str) and value == ENVIRONMENT)
        return value if named else super().check(name, value)


_OTHER = f', "none" (None in Python) for a transparent background, "{ENVIRONMENT}" or an image file'
BACKGROUNDS = _Backgrounds(0.0, MAX_RADIANCE, other=_OTHER, none="none")


def is_image(background: Any) -> bool:
    """Return whether a background is the path of an image, as text."""
    return isinstance(background, str) and PurePath(background).suffix.lower() in SUFFIXES


def check_environment(scene: Any) -> None:
    """Raise InputError if the background of a scene or job is an environment map that it lacks."""
    if scene.background == ENVIRONMENT and scene.environment is None:
        remedy = "add --environment FILE (environment=)"
        raise InputError(f"background = '{ENVIRONMENT}' needs an environment map: {remedy}")


def clear_color(background: Any) -> Vector:
    """Return a background colour, or black for other backgrounds."""
    return background if isinstance(background, tuple) else (0.0, 0.0, 0.0)


@lru_cache(1)
def covering(image: ImageData, size: tuple[int, int]) -> Float32:
    """Return an image as linear RGB (H, W, 3), scaled to cover the size and cropped centrally. Its
    transparent pixels lie on black."""
    from PIL import Image, ImageOps

    color = image.color.astype(np.float64)
    color = srgb_to_linear(color / 255.0) if image.encoding == "srgb8" else color
    channels = np.moveaxis(np.clip(color, 0.0, MAX_RADIANCE), -1, 0).astype(np.float32)
    images = (Image.fromarray(channel) for channel in channels)
    scaled = [np.asarray(ImageOps.fit(i, size, Image.Resampling.BILINEAR)) for i in images]
    return np.stack(scaled * (3 // len(scaled)), axis=-1)
