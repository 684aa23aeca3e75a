"""Reading of image files: EXR, NumPy arrays, and 8-bit images with Pillow."""

from __future__ import annotations

import math
import os
from contextlib import nullcontext
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from facerender.errors import InputError, check_path, clipped, reason
from facerender.images.decode import MAX_BYTES, check_pixels, in_srgb, open_image, texels
from facerender.images.exr import read_exr
from facerender.images.image import ImageData, image_from_array
from facerender.images.write import PREFIX
from facerender.system.files import check_downloaded, open_file, suffix_of
from facerender.system.standard_error import redirected_stderr

if TYPE_CHECKING:
    from PIL.Image import Image

_8_BIT = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".gif", ".bmp", ".tga")
SUFFIXES = (".exr", ".npz", ".npy", *_8_BIT)
# Other images and videos. In folders, these files are errors: a silent skip would hide a change.
REFUSED = (
    *(".apng", ".avif", ".dds", ".dng", ".hdr", ".heic", ".heif", ".ico", ".jfif", ".jp2", ".jpe"),
    *(".jxl", ".ktx2", ".mov", ".mp4", ".pbm", ".pcx", ".pfm", ".pgm", ".pnm", ".ppm", ".psd"),
    *(".qoi", ".svg", ".webm"),
)
# Without AVIF, JPEG 2000 and PPM: Pillow silently reduces their larger values to 8 bits.
_DECODERS = ("PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP", "TGA")
_MODES = ("L", "LA", "RGB", "RGBA")  # Pillow's modes that are read as they are
_MODE_NAMES = {"P": "a palette image", "CMYK": "a CMYK image", "1": "a 1-bit image"}
SRGB_GAMMA = 0.45455  # value of the gAMA chunk of an sRGB PNG
_NPY = b"\x93NUMPY"
_LONGEST_HEADER = 1 << 16  # largest header of a NumPy array, in bytes
_LONGEST_EXR = 1 << 24  # largest header of an EXR file, in bytes


def read_image(path: str | os.PathLike[str]) -> ImageData:
    """Read an image file.

    path : .exr (needs the extra ``exr``), .npz or .npy (linear floats, or 8-bit sRGB), .png, .jpg,
        .webp, .tif, .gif, .bmp or .tga (8-bit, one frame)

    Raises
    ------
    InputError : the file is missing, damaged, too large or of another format
    """
    check_path("image file", path)
    path = Path(path)
    suffix = suffix_of(path, SUFFIXES, "image", "an image file", MAX_BYTES)
    with open_file(path, "an image file", MAX_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(_LONGEST_EXR if suffix == ".exr" else size)
    if not content:
        raise InputError(f"{path} is empty: save it again")
    check_downloaded(content, f"{path} is")
    if suffix == ".exr":
        return read_exr(path, content, size)
    if suffix in (".npz", ".npy"):
        return _read_numpy(path, content)
    return _read_8_bit(path, content)


def _read_numpy(path: Path, content: bytes) -> ImageData:
    from zipfile import ZipFile

    try:
        if content.startswith(_NPY):
            return image_from_array(_array(BytesIO(content), str(path), len(content)), str(path))
        with ZipFile(BytesIO(content)) as file:
            names = file.namelist()
            stems = [name.removesuffix(".npy") for name in names]
            if len(names) != 1 and "linear" not in stems:
                listing = clipped(", ".join(stems)) or "no array"
                raise InputError(f"{path} contains {listing}: name one array 'linear'")
            with file.open(names[stems.index("linear") if len(names) > 1 else 0]) as member:
                return image_from_array(_array(member, str(path), len(content)), str(path))
    except InputError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib raise many types
        raise InputError(f"{path} is not a NumPy file ({reason(error)}); save it again") from None


def _array(file: IO[bytes], name: str, size: int) -> NDArray[Any]:
    """Read a NumPy array after a check of its header.

    size : size of the file in bytes

    Raises
    ------
    InputError : the array contains Python objects, does not have an image's shape, or is too large
    """
    head = BytesIO(file.read(_LONGEST_HEADER))
    read = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0}
    shape, _, kind = read[npy.read_magic(head)[0]](head)
    if kind.hasobject:
        raise InputError(f"{name} contains Python objects, which are not read: give floats")
    if len(shape) in (2, 3):
        check_pixels(name, shape[1], shape[0], kind.itemsize * math.prod(shape[2:]), size)
        file.seek(0)
        return np.asarray(npy.read_array(file, allow_pickle=False))
    raise InputError(f"{name} has shape {clipped(str(shape))}: give (H, W, 3) or (H, W, 4)")


def _read_8_bit(path: Path, content: bytes) -> ImageData:
    # Pillow would silently drop the lower byte of 16-bit values.
    if content.startswith(b"\x89PNG") and content[24:25] == b"\x10":
        raise InputError(f"{path} is a 16-bit PNG: save as 8-bit PNG, or as EXR")
    libtiff = content[:2] in (b"II", b"MM")  # it prints to standard error
    with open(os.devnull, "w") as nothing, redirected_stderr(nothing) if libtiff else nullcontext():
        image = open_image(content, str(path), _DECODERS, "PNG or JPEG")
        if (bits := max(getattr(image, "tag_v2", {}).get(258, (8,)))) > 8:  # tag BitsPerSample
            raise InputError(f"{path} is a {bits}-bit TIFF: save it as EXR")
        return image_from_pillow(image, str(path), in_file=True)


def image_from_pillow(image: Image, name: str, in_file: bool = False) -> ImageData:
    """Return an image from a Pillow image, turned as its EXIF data state and converted to sRGB.

    in_file : whether the remedies of errors are for a file, not for a Pillow image
    """
    from PIL import ExifTags, ImageOps

    mode = image.mode
    if image.format == "GIF" or mode not in _MODES or "transparency" in image.info:
        mode = "LA" if mode == "La" else "RGBA" if image.has_transparency_data else "RGB"
    if image.mode != mode and image.format != "GIF":
        description = _MODE_NAMES.get(image.mode, image.mode)
        problem = f"is {description}" if in_file else f"has Pillow's mode {image.mode}"
        remedy = f"save it as {mode}" if in_file else f"give image.convert({mode!r})"
        if image.mode in _MODES:
            problem = "marks one colour as transparent"
        elif image.mode[0] in "FI":
            remedy = "give numpy.asarray(image) / WHITE, where WHITE is the value of white"
        raise InputError(f"{name} {problem}: {remedy}")
    try:
        frames = getattr(image, "n_frames", 1)
        turned = image.getexif().get(ExifTags.Base.Orientation) in range(2, 9)
        pixels = texels(ImageOps.exif_transpose(image) if turned else image, mode)
    except Exception as error:  # Pillow's decoders raise many types
        raise InputError(f"{name} is damaged ({reason(error)}); save it again") from None
    if frames > 1:
        remedy = "save each as a file" if in_file else f"give one as image.convert({mode!r})"
        raise InputError(f"{name} has {frames} frames: {remedy}")
    texts = {
        str(key).removeprefix(PREFIX): value
        for key, value in image.info.items()
        if isinstance(value, str) and key != "compression"  # of TIFF and TGA; changes no pixel
    }
    result = replace(image_from_array(pixels, name), metadata=texts, jpeg=image.format == "JPEG")
    if "icc_profile" in image.info:
        try:
            pixels, profile = _to_srgb(pixels, image.info["icc_profile"] or b"")
        except Exception as error:  # LittleCMS raises several types
            raise InputError(
                f"{name} has an ICC profile that cannot be used ({reason(error)}): save it as sRGB"
            ) from None
        noise = 0.5 if profile else 0.0  # of a conversion from 8 bits to 8 bits, in 8-bit levels
        return replace(result, pixels=pixels, profile=profile, noise=noise)
    gamma = image.info.get("gamma", SRGB_GAMMA)
    is_srgb = abs(gamma - SRGB_GAMMA) <= 1e-4
    return result if is_srgb else replace(result, color_space=f"gamma {gamma:.4g}")


def _to_srgb(pixels: NDArray[np.uint8], content: bytes) -> tuple[NDArray[np.uint8], str]:
    """Convert 8-bit pixels (H, W, 1 to 4) from an ICC profile to sRGB, with errors as of
    :func:`in_srgb`. Return the pixels, with their alpha unchanged, and the name of the profile. The
    name is "" if the conversion changes no pixel."""
    from PIL import Image

    grey = pixels.shape[2] < 3
    colors = pixels[..., 0] if grey else np.ascontiguousarray(pixels[..., :3])
    image, name = in_srgb(Image.fromarray(colors), content)
    converted, result = np.asarray(image), pixels.copy()
    result[..., : 1 if grey else 3] = converted[..., 1:2] if grey else converted
    return result, "" if np.array_equal(result, pixels) else name
