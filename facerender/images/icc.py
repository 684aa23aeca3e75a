"""Colours of images with an ICC profile, converted to sRGB by Pillow's LittleCMS."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped


def to_srgb(pixels: NDArray[np.uint8], content: bytes) -> tuple[NDArray[np.uint8], str]:
    """Return 8-bit pixels (H, W, 1 to 4) with their colours in sRGB, clipped to its gamut, and the
    name of their profile; alpha stays. Where the conversion changes no pixel, the name is "".

    content : of the ICC profile, for grey or RGB as the pixels are

    Raises
    ------
    OSError, ImageCms.PyCMSError : the profile is damaged, or for other colours
    """
    from PIL import Image, ImageCms

    grey = pixels.shape[2] < 3
    colors = pixels[..., 0] if grey else np.ascontiguousarray(pixels[..., :3])
    profile = ImageCms.ImageCmsProfile(BytesIO(content))
    transform = ImageCms.buildTransform(
        profile,
        ImageCms.createProfile("sRGB"),
        "L" if grey else "RGB",
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    converted = np.asarray(ImageCms.applyTransform(Image.fromarray(colors), transform))
    result = pixels.copy()
    result[..., : 1 if grey else 3] = converted[..., 1:2] if grey else converted
    changed = not np.array_equal(result, pixels)
    return result, clipped(profile.profile.profile_description or "no name") if changed else ""
