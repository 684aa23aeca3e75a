"""Load environment maps from .hdr, .exr and NumPy files, or generate the map "studio"."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, near
from facerender.images.files import MAX_BYTES, check_pixels, read_image
from facerender.scenes.environment import Environment, Panorama, studio
from facerender.scenes.file import STUDIO, EnvironmentFile, environment_file
from facerender.system.files import read_file, suffix_of

_SUFFIXES = (".hdr", ".exr", ".npy", ".npz")


def wanted(file: str) -> str:
    """Return the description of the expected file for messages, first a name like ``file``."""
    maps = f"an environment map ({', '.join(_SUFFIXES)})"
    return f"{STUDIO}, or {maps}" if near(file, [STUDIO]) else f"{maps}, or {STUDIO}"


def load_environment(file: EnvironmentFile | str | os.PathLike[str]) -> Environment:
    """Load an environment map. The panoramas of the two files used last are cached, with all data
    derived from these panoramas. All environments loaded from one file share its panorama.

    file : a path, "studio", a text such as "room.hdr,ROTATION,SCALE", or an
        :class:`EnvironmentFile`

    Raises
    ------
    InputError : the file is missing, damaged, or of an unknown format or shape; a radiance is not a
        number in [0, 1e9]; OpenImageIO (.hdr) or OpenEXR (.exr) is not installed
    """
    file = environment_file(file)
    panorama = studio() if file.file == STUDIO else _panorama(file.file, *_state(file.file))
    return Environment(panorama, file.rotation, file.scale)


def _state(path: str) -> tuple[int, int]:
    """Return a file's modification time in ns and its size in bytes, to detect a change."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        return 0, 0  # reading the file reports the error
    return status.st_mtime_ns, status.st_size


@lru_cache(2)
def _panorama(file: str, written: int, size: int) -> Panorama:
    path, description = Path(file), wanted(file)
    if suffix_of(path, _SUFFIXES, "environment", description, MAX_BYTES) == ".hdr":
        return Panorama(file, _read_hdr(read_file(path, description, MAX_BYTES), path))
    picture = read_image(path)
    if picture.encoding != "linear":
        raise InputError(f"environment {path} holds 8-bit values: give linear radiance")
    return Panorama(file, picture.color)


def _read_hdr(content: bytes, path: Path) -> NDArray[np.float32]:
    try:
        import OpenImageIO as oiio
    except ImportError:
        raise InputError(
            f"{path}: .hdr needs the package OpenImageIO; pip install 'facerender[hdr]'"
        ) from None
    file, why = None, "it does not start like a Radiance file"
    if content.startswith(b"#?"):  # otherwise OpenImageIO would try other formats
        file, why = oiio.ImageInput.open(str(path)), oiio.geterror()
    if file:
        spec = file.spec()
        check_pixels(str(path), spec.width, spec.height, 4 * spec.nchannels, len(content))
        if (pixels := file.read_image(oiio.FLOAT)) is not None:
            return np.asarray(pixels, dtype=np.float32)
        why = file.geterror()
    why = clipped(why) or "damaged"
    raise InputError(f"OpenImageIO cannot read {path} ({why}); write the file again")
