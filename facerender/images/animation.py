"""Several pictures as one that moves: GIF and WebP by Pillow, MP4 by an installed ffmpeg."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterable, Iterator
from itertools import chain
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import (
    InputError,
    check_path,
    check_range,
    check_type,
    clipped,
    reason,
    shown,
)
from facerender.images.write import QUALITY, check_opaque
from facerender.system.atomic import write_whole

MOVING = (".gif", ".webp", ".mp4")
MOST_FPS = 100.0  # a GIF counts in hundredths of a second
_HIGHEST = 16383  # pixels a side, of a WebP
_CRF = "16"  # quality of the MP4


def save_animation(
    path: str | os.PathLike[str], pictures: Iterable[NDArray[np.uint8]], fps: float = 12.0
) -> None:
    """Write pictures as .gif, .webp or .mp4 (H.264), whole or not at all; they repeat without end.

    Parameters
    ----------
    pictures : 8-bit sRGB, (H, W, 3) each, as of :meth:`facerender.Frame.srgb8`; they may be made
        one by one. Of a .webp also (H, W, 4). A side of an .mp4 is made even by black pixels
    fps : pictures a second, in [0.1, 100]; a GIF takes the nearest hundredth of a second for each

    Raises
    ------
    InputError : another suffix, no picture, transparent ones in a .gif or .mp4, a place that cannot
        be written; no ffmpeg is found for an .mp4, or it fails
    """
    suffix = check_animation(path, fps)
    check_type("pictures", pictures, Iterable, "several arrays (H, W, 3) of uint8")
    every = map(_checked, pictures)
    first = next(every, None)
    if first is None:
        raise InputError(f"{path} would have no picture: give at least one")
    if suffix != ".webp":
        check_opaque(suffix, first.shape[-1] == 4)
    elif max(first.shape[:2]) > _HIGHEST:
        raise InputError(f"a WebP has at most {_HIGHEST} pixels a side: give a smaller size")

    def alike(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if picture.shape != first.shape:
            raise InputError(
                f"pictures of {first.shape} and {picture.shape} for {path}: give them one size"
            )
        return picture

    images = chain([first], map(alike, every))
    if suffix == ".mp4":
        write_whole(path, lambda name: _mp4(name, images, first.shape[:2], fps))
    else:
        write_whole(path, lambda name: _pillow(name, suffix[1:], images, fps))


def check_animation(path: str | os.PathLike[str], fps: float) -> str:
    """Return the suffix of an animation; raise InputError where it can be known to fail."""
    check_path("image file", path)
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in MOVING:
        raise InputError(f"{shown(os.fspath(path))}: give {', '.join(MOVING)}")
    check_range("fps", fps, 0.1, MOST_FPS)
    if suffix == ".mp4":
        _ffmpeg()
    return suffix


def _checked(picture: Any) -> NDArray[np.uint8]:
    good = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.size > 0
    if not (good and picture.ndim == 3 and picture.shape[2] in (3, 4)):
        raise InputError(f"picture = {shown(picture)}: give an array (H, W, 3) of uint8")
    return np.asarray(picture)


def _pillow(name: str, kind: str, pictures: Iterator[NDArray[np.uint8]], fps: float) -> None:
    from PIL import Image

    images = map(Image.fromarray, pictures)
    step = max(10, round(100.0 / fps) * 10) if kind == "gif" else round(1000.0 / fps)
    more = {"disposal": 1} if kind == "gif" else {"quality": QUALITY, "method": 3}
    next(images).save(
        name, kind, save_all=True, append_images=images, duration=step, loop=0, **more
    )


def _mp4(
    name: str, pictures: Iterator[NDArray[np.uint8]], size: tuple[int, ...], fps: float
) -> None:
    """Have ffmpeg read the pictures from a socket: a pipe would end this process by SIGPIPE where
    ffmpeg ends early."""
    colors = ("-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-colorspace", "bt709")
    command = [
        *(_ffmpeg(), "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-video_size", f"{size[1]}x{size[0]}", "-framerate", f"{fps:g}", "-i", "pipe:0"),
        *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv"),
        *("-c:v", "libx264", "-crf", _CRF, "-pix_fmt", "yuv420p", *colors),
        *("-f", "mp4", name),
    ]
    here, there = socket.socketpair()
    with here, TemporaryFile() as told:  # a pipe that nobody reads meanwhile may be full
        with there:
            try:
                encoder = subprocess.Popen(
                    command, stdin=there.fileno(), stdout=subprocess.DEVNULL, stderr=told
                )
            except OSError as error:
                raise InputError(
                    f"cannot start {clipped(command[0])}: {reason(error)}; give .gif or .webp"
                ) from None
        with encoder:
            try:
                for picture in pictures:
                    here.sendall(np.ascontiguousarray(picture).data.cast("B"), _SILENT)
            except (BrokenPipeError, ConnectionResetError):
                pass  # it says why
            except BaseException:
                encoder.kill()
                raise
            here.close()
        told.seek(0)
        said = told.read().decode(errors="replace").strip().splitlines()
    if encoder.returncode:
        why = clipped(said[-1] if said else f"status {encoder.returncode}")
        raise InputError(f"ffmpeg made no .mp4 ({why}): give .gif or .webp")


_SILENT = getattr(socket, "MSG_NOSIGNAL", 0)


def _ffmpeg() -> str:
    """Return the path of ffmpeg.

    Raises
    ------
    InputError : there is none
    """
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise InputError(
            f"no ffmpeg for an .mp4 ({reason(error)}): apt-get install ffmpeg, or pip install "
            "imageio-ffmpeg, or give .gif or .webp"
        ) from None
