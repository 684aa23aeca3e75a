"""Several images in one file, as sheets and animations (GIF, WebP, MP4); scale bars."""

from __future__ import annotations

import math
import os
import signal
import textwrap
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from fractions import Fraction
from itertools import chain
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range, clipped, number_of, quoted, reason
from facerender.images.files import FRAME_RATES, QUALITY, check_opaque, check_pixels
from facerender.system.files import check_suffix, write_whole
from facerender.values.fields import PATH

MAX_COLUMNS = 4  # default largest number of images in a row
_BYTES = 24  # per pixel: 8-bit RGB, and float32 RGBA of a Frame
_TEXT = 11, 32  # smallest and largest size of the font, in pixels
_PAPER, _INK = (255, 255, 255), (20, 20, 20)


def arranged(
    images: Sequence[NDArray[np.uint8]], titles: Sequence[str] = (), columns: int | None = None
) -> NDArray[np.uint8]:
    """Return one image (H, W, 3) with ``images`` in rows, on white.

    images : (h, w, 3) each, of one size
    titles : one text above each image; default: no titles
    columns : number of images in a row; default: all, at most :data:`MAX_COLUMNS`
    """
    columns = columns or min(len(images), MAX_COLUMNS)
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    gap = max(width // 64, 2)
    bands = [text_band(title, width) for title in titles] if any(titles) else []
    across, down = width + gap, max(map(len, bands), default=0) + height + gap
    sheet_size = columns * across + gap, rows * down + gap
    check_pixels(f"a sheet of {number_of(len(images), 'image')}", *sheet_size, _BYTES, math.inf)
    pixels = np.full((*sheet_size[::-1], 3), _PAPER, dtype=np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        tile = np.concatenate([bands[index], image]) if bands else image
        bottom, left = (row + 1) * down, column * across + gap
        pixels[bottom - len(tile) : bottom, left : left + width] = tile
    return pixels


def text_band(title: str, width: int) -> NDArray[np.uint8]:
    """Return a title (H, W, 3); a long one has a smaller font and, if needed, several lines."""
    from PIL import Image, ImageDraw, ImageFont

    # Pillow's font has ASCII characters only.
    plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()
    size, line = min(max(width // 20, _TEXT[0]), _TEXT[1]), clipped(plain)
    long = max(ImageFont.load_default(size).getlength(line), 1.0)
    font = ImageFont.load_default(max(min(size * width / long, size), _TEXT[0]))
    excess = font.getlength(line) / width
    lines = textwrap.wrap(line, max(int(0.9 * len(line) / excess), 1)) if excess > 1.0 else [line]
    step = round(1.5 * size)
    image = Image.new("RGB", (width, step * len(lines)), _PAPER)
    draw = ImageDraw.Draw(image)
    for index, text in enumerate(lines):
        draw.text((0, index * step + step // 2), text, _INK, font, "lm")
    return np.asarray(image)


def draw_scale_bar(pixels: NDArray[Any], mm_per_pixel: float) -> None:
    """Draw a scale bar and its length in the lower right corner of an image, in place.

    The length is 1, 2 or 5 x 10^k mm, and at most a quarter of the image's width. Bar and text are
    black on bright or transparent pixels and white on dark pixels, with an outline of the other.

    pixels : (H, W, 3), or (H, W, 4) with straight alpha; uint8 or uint16
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = pixels.shape[:2]
    longest = 0.25 * width * mm_per_pixel * (1.0 + 1e-9)
    power = 10.0 ** math.floor(math.log10(longest))
    length = power * max(digit for digit in (1, 2, 5) if digit * power <= longest)
    across = max(round(length / mm_per_pixel), 1)
    size = max(min(width, height) // 32, _TEXT[0])
    outline, thickness = max(size // 12, 1), max(size // 6, 2)
    font, label = ImageFont.load_default(size), f"{length:g} mm"
    wider = math.ceil(max(across, font.getlength(label)))
    box_width, box_height = min(wider + 2 * size, width), min(3 * size, height)
    left = max(box_width - size - (wider + across) // 2, 0)
    bottom = max(box_height - size, min(box_height, thickness))
    masks = []
    for margin in (outline, 0):
        image = Image.new("L", (box_width, box_height))
        draw = ImageDraw.Draw(image)
        ends = left - margin, bottom - thickness - margin
        draw.rectangle((*ends, left + across + margin - 1, bottom + margin - 1), 255)
        above = left + across / 2.0, bottom - 2 * thickness
        draw.text(above, label, 255, font, "ms", stroke_width=margin)
        masks.append(np.asarray(image, dtype=np.float32)[..., None] / np.float32(255.0))
    box, white = pixels[-box_height:, -box_width:], np.iinfo(pixels.dtype).max
    behind = box[..., :3].mean(axis=-1) + (white - box[..., 3:]).sum(axis=-1)
    bright = np.average(behind, weights=masks[0][..., 0]) > 0.5 * white
    color = np.full(pixels.shape[-1], white, dtype=np.float32)  # alpha, if any, remains white
    for mask, is_white in zip(masks, (bright, not bright), strict=True):
        color[:3] = white * is_white
        box[:] = np.round(box + (color - box) * mask)


MOVING = (".gif", ".webp", ".mp4")
_HIGHEST = 16383  # largest side of a WebP, in pixels


def save_animation(
    path: str | os.PathLike[str], images: Iterable[NDArray[np.uint8]], fps: float = 12.0
) -> None:
    """Write an animation as .gif, .webp or .mp4 (H.264; needs the extra ``mp4``). A .gif or .webp
    repeats forever. If writing fails, no partial file is left.

    Parameters
    ----------
    images : 8-bit sRGB arrays of one size, (H, W, 3), as :meth:`facerender.Frame.srgb8` returns
        them; a generator is read one image at a time. A .webp also accepts (H, W, 4). An .mp4 with
        an odd height or width gets one more row or column, which is black
    fps : images per second, in [0.1, 100]; a GIF rounds delays to hundredths of a second
    """
    suffix = check_animation(path, fps)
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
    """Return the path's suffix after a check of suffix and fps and, for an .mp4, of ffmpeg."""
    suffix = check_suffix(PATH.check("image file", path), MOVING, "animation")
    check_range("fps", fps, *FRAME_RATES)
    if suffix == ".mp4":
        _ffmpeg()
    return suffix


def _checked(images: Iterable[Any], path: str) -> Iterator[NDArray[np.uint8]]:
    shape = None
    for image in images:
        valid = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.size > 0
        if not (valid and image.ndim == 3 and image.shape[2] in (3, 4)):
            raise InputError(f"image = {quoted(image)}: give an array (H, W, 3) of uint8")
        shape = shape or image.shape
        if image.shape != shape:
            problem = f"shapes {shape} and {image.shape} in {path} differ"
            raise InputError(f"{problem}: give images of one size")
        yield image


def _pillow(name: str, encoder: str, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    from PIL import Image

    images, gif = map(Image.fromarray, frames), encoder == "gif"
    duration = 10 * round(100.0 / fps) if gif else round(1000.0 / fps)  # in milliseconds
    options = {"disposal": 1} if gif else {"quality": QUALITY, "method": 3}
    next(images).save(
        name, encoder, save_all=True, append_images=images, duration=duration, loop=0, **options
    )


# The rate factor (crf) sets the quality. H.264 with 4:2:0 needs an even width and height.
_H264 = (
    "-vcodec libx264 -crf 16 -pix_fmt yuv420p -f mp4"
    " -vf pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv"
    " -color_primaries bt709 -color_trc iec61966-2-1 -colorspace bt709"
)


def _mp4(name: str, frames: Iterator[NDArray[np.uint8]], size: tuple[int, ...], fps: float) -> None:
    """Write the frames to the standard input of ffmpeg, which encodes them."""
    rate = Fraction(float(fps)).limit_denominator()
    pixels = f"-f rawvideo -pix_fmt rgb24 -s {size[1]}x{size[0]} -r {rate} -i -"
    command = [_ffmpeg(), "-v", "error", *pixels.split(), *_H264.split(), name]
    failure = ""
    with TemporaryFile() as log, ExitStack() as stack:
        # Let a write to an ended ffmpeg raise an error: the command line lets SIGPIPE end it.
        with suppress(AttributeError, ValueError):  # on Windows; not in the main thread
            handler = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
            stack.callback(signal.signal, signal.SIGPIPE, handler)
        try:  # in another process group: Ctrl-C interrupts only this process, which ends ffmpeg
            ffmpeg: Any = Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=log, process_group=0)
        except OSError as error:
            raise InputError(f"cannot start ffmpeg: {reason(error)}; give .gif or .webp") from None
        stack.callback(ffmpeg.communicate)  # closes the pipe and waits
        stack.callback(ffmpeg.kill)
        for frame in frames:
            try:
                ffmpeg.stdin.write(np.ascontiguousarray(frame))
            except OSError:
                failure = "it ended early"
                break
        ffmpeg.communicate()
        if not failure and (ffmpeg.returncode or not os.path.exists(name)):
            failure = "the file is incomplete"
        log.seek(0)
        failure = [failure, *log.read().decode(errors="replace").strip().splitlines()][-1]
    if failure:
        raise InputError(f"ffmpeg wrote no .mp4 ({clipped(failure)}): give .gif or .webp")


def _ffmpeg() -> str:
    """Return the path of ffmpeg; raise InputError if it or imageio_ffmpeg is missing."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        remedy = "pip install 'facerender[mp4]', or give .gif or .webp"
        raise InputError(f"an .mp4 needs ffmpeg ({reason(error)}): {remedy}") from None
