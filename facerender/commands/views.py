"""Output files of several views: one file per view, an animation, a sheet, or standard output."""

from __future__ import annotations

import math
import os
import re
import string
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from facerender.commands.streams import print_bytes
from facerender.drawing.frame import Frame
from facerender.errors import InputError
from facerender.images.decode import MAX_BYTES, MAX_SIDE
from facerender.images.write import Format, check_opaque, format_of
from facerender.scenes.vectors import Vector
from facerender.system.memory import MIB, limit

STANDARD_OUTPUT = "-"
FPS = 12.0  # default frame rate of animations of several views
CLIP_FPS = 25.0  # default frame rate of clips
_PIXEL_BYTES = 32  # memory per pixel of a sheet: 16 for linear RGBA, up to 16 to write the file


@dataclass(frozen=True)
class Destination:
    """The output files of a command.

    Attributes
    ----------
    files : file names, or STANDARD_OUTPUT alone
    kind : "each" for one file per image, "moving" for one animation, "sheet" for one image with
        all images in a grid
    count : number of images
    format : format of an image on standard output; None for files
    fps : images per second of an animation
    """

    files: tuple[str, ...]
    kind: Literal["each", "moving", "sheet"]
    count: int
    format: Format | None
    fps: float

    @classmethod
    def of(
        cls,
        path: str,
        names: Sequence[str],
        as_sheet: bool,
        format: Format | None,
        fps: float | None,
        transparent: bool,
        plays: bool = False,
    ) -> Destination:
        """Return the destination of images, before the first image is drawn.

        Parameters
        ----------
        path : file name, in which {index} and {name} are replaced, or STANDARD_OUTPUT
        format, fps : values of the options; None if they are not given
        plays : whether the images are the frames of a sequence, to which --fps applies

        Raises
        ------
        InputError : the path, the format or fps is invalid for these images
        """
        kind: Literal["each", "moving", "sheet"] = "sheet" if as_sheet else "each"
        rate = fps if fps is not None else CLIP_FPS if plays else FPS
        files: tuple[str, ...] = (path,)
        if path == STANDARD_OUTPUT:
            if len(names) > 1 and not as_sheet:
                raise InputError(
                    f"-o - takes one image, and there are {len(names)}: give --sheet or a file"
                )
            format = format or "png"
        elif format is not None:
            raise InputError(f"--format {format} is for -o - only: the file name sets the format")
        elif not as_sheet and _moves(path, len(names)):
            kind = "moving"
        else:
            files = file_names(path, ["sheet"] if as_sheet else names)
        if fps is not None and kind != "moving" and not plays:
            raise InputError(
                f"--fps {fps:g} is for a .gif, .webp or .mp4 of several views, or a clip, only"
            )
        if kind == "moving":
            from facerender.images.animation import check_animation

            check_animation(path, rate)
            if not path.lower().endswith(".webp"):
                check_opaque(path, transparent)
        elif (format or format_of(files[0])) == "jpeg":
            check_opaque("JPEG", transparent)
        return cls(files, kind, len(names), format, rate)

    def write(self, frames: Iterator[Frame], exposure: float, background: Vector | None) -> Frame:
        """Write each image as soon as it is drawn, and return the last image."""
        last = deque[Frame](maxlen=1)

        def remembered() -> Iterator[Frame]:
            for frame in frames:
                last.append(frame)
                yield frame

        images = remembered()
        if self.kind == "moving":
            from facerender.images.animation import save_animation

            save_animation(self.files[0], (frame.srgb8(exposure) for frame in images), self.fps)
            return last[0]
        if self.kind == "sheet":
            images = iter([sheet(images, self.count, background)])
        for file, frame in zip(self.files, images, strict=True):
            if self.format is not None:
                print_bytes(frame.encoded(self.format, exposure))
            else:
                frame.save(file, exposure)
        return last[0]


def _moves(path: str, count: int) -> bool:
    """Return whether a file is an animation: any .gif or .mp4, or a .webp with several images
    whose file name contains neither {index} nor {name}."""
    suffix = os.path.splitext(path)[1].lower()
    return suffix in (".gif", ".mp4") or (suffix == ".webp" and count > 1 and not _has_fields(path))


def file_names(pattern: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the file name of each image.

    {index} becomes the image's index (from 000) in at least three digits, and {name} the image's
    name. If out.png has neither of these fields, several images are named out_000.png and so on.

    Raises
    ------
    InputError : the pattern has an unknown field in braces
    """
    digits = max(3, len(str(len(names) - 1)))
    if not _has_fields(pattern):
        if len(names) == 1:
            return (pattern,)
        root, suffix = os.path.splitext(pattern)
        pattern = f"{root.replace('{', '{{').replace('}', '}}')}_{{index}}{suffix}"
    pattern = pattern.replace("{index}", f"{{index:0{digits}d}}")
    try:
        return tuple(
            pattern.format(index=index, name=_plain(name)) for index, name in enumerate(names)
        )
    except (ValueError, LookupError, AttributeError):
        raise InputError(
            f"-o {pattern}: in braces give {{index}}, {{index:03d}} or {{name}}"
        ) from None


def is_several(path: str) -> bool:
    """Return whether an output can hold a sequence: an animation, or a name with {index}."""
    return _moves(path, 2) or _has_fields(path)


def _has_fields(pattern: str) -> bool:
    """Return whether a file name contains {index} or {name}. Other braces have no meaning."""
    try:
        return any(part[1] in ("index", "name") for part in string.Formatter().parse(pattern))
    except ValueError:
        return False


def _plain(name: str) -> str:
    """Return a camera's name, possibly from an untrusted file, as a safe part of a file name."""
    plain = re.sub(r"[^\w.+-]", "_", name)
    return plain.lstrip(".")[:80] or "_"


def check_sheet(count: int, size: tuple[int, int], memory: float | None) -> None:
    """Raise InputError if a sheet of images is too large.

    memory : limit of the process's memory in MiB; None for the free memory of the system
    """
    columns, rows = _grid(count)
    width, height = columns * size[0], rows * size[1]
    memory_limit = min(limit(memory), MAX_BYTES / MIB)
    if max(width, height) > MAX_SIDE or _PIXEL_BYTES * width * height > memory_limit * MIB:
        raise InputError(
            f"a sheet of {count} images is {width} x {height} pixels of {_PIXEL_BYTES} bytes: at "
            f"most {MAX_SIDE} a side, and {memory_limit:.0f} MiB; give a smaller size or fewer "
            "views"
        )


def sheet(frames: Iterable[Frame], count: int, background: Vector | None) -> Frame:
    """Return one frame with ``count`` images in a grid; empty cells show the background.

    The grid has as many columns as rows, or one column more. Each image is released after copying.
    """
    columns, rows = _grid(count)
    for index, frame in enumerate(frames):
        height, width = frame.linear.shape[:2]
        if index == 0:
            color = background if background is not None and frame.only is None else (0.0,) * 3
            size = rows * height, columns * width
            linear = np.full((*size, 4), (*color, 0.0), dtype=np.float32)
            grid = replace(frame, linear=linear)
        top, left = index // columns * height, index % columns * width
        linear[top : top + height, left : left + width] = frame.linear
    return grid


def _grid(count: int) -> tuple[int, int]:
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)
