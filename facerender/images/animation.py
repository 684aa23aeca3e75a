"""Several images in one file: sheets and animations (GIF, WebP, MP4)."""

from __future__ import annotations

import logging
import math
import os
import signal
import struct
import textwrap
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
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
    number_of,
    reason,
    shown,
)
from facerender.images.files import FRAME_RATES, QUALITY, check_opaque, check_pixels
from facerender.system.files import check_suffix, write_whole
from facerender.system.process import redirected_stderr

MOST_COLUMNS = 4  # default largest number of images in a row
_BYTES = 24  # per pixel: 8-bit RGB, and float32 RGBA of a Frame
_TEXT = 11, 32  # smallest and largest size of the font, in pixels
_PAPER, _INK = (255, 255, 255), (20, 20, 20)


def arranged(
    images: Sequence[NDArray[np.uint8]],
    titles: Sequence[str] = (),
    columns: int | None = None,
) -> NDArray[np.uint8]:
    """Return one image (H, W, 3) with ``images`` in rows, on white.

    Parameters
    ----------
    images : (h, w, 3) each, of one size
    titles : one text above each image; default: no titles
    columns : number of images in a row; default: all, at most :data:`MOST_COLUMNS`

    Raises
    ------
    InputError : the sheet is too large
    """
    columns = columns or min(len(images), MOST_COLUMNS)
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    gap = max(width // 64, 2)
    bands = [_text(title, width) for title in titles] if any(titles) else []
    band = max(map(len, bands), default=0)
    across, down = width + gap, band + height + gap
    sheet_size = columns * across + gap, rows * down + gap
    check_pixels(f"a sheet of {number_of(len(images), 'image')}", *sheet_size, _BYTES, math.inf)
    pixels = np.full((*sheet_size[::-1], 3), _PAPER, dtype=np.uint8)
    for number, image in enumerate(images):
        top, left = gap + number // columns * down, gap + number % columns * across
        if bands:
            bottom = top + band
            pixels[bottom - len(bands[number]) : bottom, left : left + width] = bands[number]
        pixels[top + band : top + band + height, left : left + width] = image
    return pixels


def _text(title: str, width: int) -> NDArray[np.uint8]:
    """Return a title (H, W, 3); a long one has a smaller font and, if needed, several lines."""
    from PIL import Image, ImageDraw, ImageFont

    size, line = min(max(width // 20, _TEXT[0]), _TEXT[1]), clipped(title)
    long = max(ImageFont.load_default(size).getlength(line), 1.0)
    font = ImageFont.load_default(max(min(size * width / long, size), _TEXT[0]))
    excess = font.getlength(line) / width
    lines = textwrap.wrap(line, max(int(0.9 * len(line) / excess), 1)) if excess > 1.0 else [line]
    step = round(1.5 * size)
    image = Image.new("RGB", (width, step * len(lines)), _PAPER)
    draw = ImageDraw.Draw(image)
    for number, text in enumerate(lines):
        draw.text((0, number * step + step // 2), text, _INK, font, "lm")
    return np.asarray(image)


MOVING = (".gif", ".webp", ".mp4")
_HIGHEST = 16383  # largest side of a WebP, in pixels


def save_animation(
    path: str | os.PathLike[str], images: Iterable[NDArray[np.uint8]], fps: float = 12.0
) -> None:
    """Write an animation as .gif, .webp or .mp4 (H.264). A .gif or .webp repeats forever.

    If writing fails, no partial file is left.

    Parameters
    ----------
    images : 8-bit sRGB arrays of one size, (H, W, 3), as :meth:`facerender.Frame.srgb8` returns
        them; a generator is read one image at a time. A .webp also accepts (H, W, 4). An .mp4 with
        an odd height or width gets one more row or column, which is black
    fps : images per second, in [0.1, 100]; a GIF rounds delays to hundredths of a second

    Raises
    ------
    InputError : unknown suffix, no images, transparent images for a .gif or .mp4, a path that
        cannot be written; for an .mp4 a missing imageio-ffmpeg or a failing encoder
    """
    suffix = check_animation(path, fps)
    check_type("images", images, Iterable, "several arrays (H, W, 3) of uint8")
    checked = _checked(images, os.fspath(path))
    if (first := next(checked, None)) is None:
        raise InputError(f"no images for {path}: give at least one")
    if suffix != ".webp":
        check_opaque(suffix, first.shape[-1] == 4)
    elif max(first.shape[:2]) > _HIGHEST:
        raise InputError(f"a WebP has at most {_HIGHEST} pixels per side: give a smaller size")
    frames = chain([first], checked)
    if suffix == ".mp4":
        write_whole(path, lambda name: _mp4(name, frames, first.shape[:2], fps))
    else:
        write_whole(path, lambda name: _pillow(name, suffix[1:], frames, fps))


def check_animation(path: str | os.PathLike[str], fps: float) -> str:
    """Return the path's suffix. Raise InputError if suffix or fps is invalid, or if an .mp4 cannot
    be written because ffmpeg is missing."""
    check_path("image file", path)
    suffix = check_suffix(path, MOVING, "animation")
    check_range("fps", fps, *FRAME_RATES)
    if suffix == ".mp4":
        _imageio_ffmpeg()
    return suffix


def _checked(images: Iterable[Any], path: str) -> Iterator[NDArray[np.uint8]]:
    shape = None
    for image in images:
        good = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.size > 0
        if not (good and image.ndim == 3 and image.shape[2] in (3, 4)):
            raise InputError(f"image = {shown(image)}: give an array (H, W, 3) of uint8")
        if shape not in (None, image.shape):
            raise InputError(
                f"shapes {shape} and {image.shape} in {path} differ: give images of one size"
            )
        shape = image.shape
        yield image


def _pillow(name: str, kind: str, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    from PIL import Image

    images = map(Image.fromarray, frames)
    step = max(10, round(100.0 / fps) * 10) if kind == "gif" else round(1000.0 / fps)
    options = {"disposal": 1} if kind == "gif" else {"quality": QUALITY, "method": 3}
    next(images).save(
        name, kind, save_all=True, append_images=images, duration=step, loop=0, **options
    )


def _mp4(name: str, frames: Iterator[NDArray[np.uint8]], size: tuple[int, ...], fps: float) -> None:
    ffmpeg = _imageio_ffmpeg()
    logging.getLogger(ffmpeg.__name__).addHandler(logging.NullHandler())
    output = [
        *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv"),
        *("-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-colorspace", "bt709"),
        *("-crf", "16", "-f", "mp4"),  # the rate factor sets the quality
    ]
    options = {"codec": "libx264", "quality": None, "macro_block_size": 1}
    logs = {"ffmpeg_log_level": "error", "output_params": output}
    encoder = ffmpeg.write_frames(name, size[::-1], fps=fps, **options, **logs)
    with TemporaryFile() as log, _sigpipe_ignored():
        try:
            with redirected_stderr(log):
                encoder.send(None)  # starts ffmpeg
        except OSError as error:
            raise InputError(f"cannot start ffmpeg: {reason(error)}; give .gif or .webp") from None
        failed = ""
        with closing(encoder):
            for frame in frames:
                try:
                    encoder.send(np.ascontiguousarray(frame))
                except OSError:  # ffmpeg has ended
                    failed = "it ended early"
                    break
        log.seek(0)
        failed = [failed, *log.read().decode(errors="replace").strip().splitlines()][-1]
    if failed or not _has_index(name):
        failed = failed or "the file is incomplete"
        raise InputError(f"ffmpeg wrote no .mp4 ({clipped(failed)}): give .gif or .webp")


def _has_index(name: str) -> bool:
    """Return whether a file is a complete MP4, with the box "moov", which ffmpeg writes last.
    imageio_ffmpeg.write_frames ignores ffmpeg's exit status, so this check is needed."""
    with suppress(OSError), open(name, "rb") as file:
        while len(head := file.read(16)) >= 8:
            size, kind = struct.unpack_from(">I4s", head)
            if kind == b"moov":
                return True
            size = struct.unpack_from(">8xQ", head)[0] if size == 1 else size  # 64-bit size
            if size < 8:
                return False
            file.seek(size - len(head), os.SEEK_CUR)
    return False


@contextmanager
def _sigpipe_ignored() -> Iterator[None]:
    """Ignore SIGPIPE, so that a write to ffmpeg raises BrokenPipeError if ffmpeg has ended early.
    Otherwise SIGPIPE would end the process: the command line enables it for standard output."""
    if not hasattr(signal, "SIGPIPE") or threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGPIPE, handler)


def _imageio_ffmpeg() -> Any:
    """Return the package imageio_ffmpeg; raise InputError if it or its ffmpeg is missing."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise InputError(
            f"an .mp4 needs ffmpeg ({reason(error)}): pip install 'facerender[mp4]', or give .gif "
            "or .webp"
        ) from None
    return imageio_ffmpeg
