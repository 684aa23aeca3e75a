"""Where the images of several cameras go: a file each, one file that moves, a sheet, or standard
output."""

from __future__ import annotations

import math
import os
import string
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
_FIELDS = {"index", "name"}
_OF_PIXEL = 32  # bytes, of a sheet: linear, and as much at the most while it is written


@dataclass(frozen=True)
class Destination:
    """What is written.

    Attributes
    ----------
    files : names, or that of standard output
    kind : "each" file an image, or "moving" or a "sheet", where one file has all images
    count : of the images
    format : of an image on standard output
    fps : of a file that moves
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
    ) -> Destination:
        """Return where images go.

        Parameters
        ----------
        path : a file name, in which {index} and {name} stand for an image's; or standard output
        names : of the images
        as_sheet : whether they are put beside each other
        format, fps : None where nobody asked
        transparent : whether there is no background

        Raises
        ------
        InputError : what can be known to fail, before any work
        """
        kind: Literal["each", "moving", "sheet"] = "sheet" if as_sheet else "each"
        files: tuple[str, ...] = (path,)
        if path == STANDARD_OUTPUT:
            if len(names) > 1 and not as_sheet:
                raise InputError(
                    f"-o - takes one image, and there are {len(names)}: give --sheet, or a file"
                )
            format = format or "png"
        elif format is not None:
            raise InputError(f"--format {format} is of -o -: a file's name says its own")
        elif not as_sheet and _moves(path, len(names)):
            kind = "moving"
        else:
            files = file_names(path, ["sheet"] if as_sheet else names)
        if fps is not None and kind != "moving":
            raise InputError(f"--fps {fps:g} is of a .gif, .webp or .mp4 of several views")
        if kind == "moving":
            from facerender.images.animation import check_animation

            check_animation(path, 12.0 if fps is None else fps)
            if not path.lower().endswith(".webp"):
                check_opaque(path, transparent)
        elif (format or format_of(files[0])) == "jpeg":
            check_opaque("JPEG", transparent)
        return cls(files, kind, len(names), format, 12.0 if fps is None else fps)

    def write(self, frames: Iterator[Frame], exposure: float, background: Vector | None) -> Frame:
        """Write images as they are drawn, and return the last."""
        last: list[Frame] = []

        def drawn() -> Iterator[Frame]:
            for last[:] in ([frame] for frame in frames):
                yield last[0]

        if self.kind == "moving":
            from facerender.images.animation import save_animation

            save_animation(self.files[0], (frame.srgb8(exposure) for frame in drawn()), self.fps)
            return last[0]
        images = drawn()
        if self.kind == "sheet":
            images = iter([sheet(images, self.count, background)])
        for file, frame in zip(self.files, images, strict=True):
            if self.format is not None:
                print_bytes(frame.encoded(self.format, exposure))
            else:
                frame.save(file, exposure)
        return last[0]


def _moves(path: str, count: int) -> bool:
    """Tell whether a file holds several images one after the other: a .gif or .mp4 does, and a
    .webp of several whose name has no place for a number."""
    suffix = os.path.splitext(path)[1].lower()
    return suffix in (".gif", ".mp4") or (suffix == ".webp" and count > 1 and not _has_fields(path))


def file_names(pattern: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the file of each image: by {index}, three digits or more, and {name} in the pattern;
    without them out.png gives out_000.png and so on, and of one image itself.

    Raises
    ------
    InputError : something else in braces
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


def _has_fields(pattern: str) -> bool:
    """Tell whether a file name has a place for what each image is called; one whose braces are no
    such place is a name like others."""
    try:
        return any(part[1] in _FIELDS for part in string.Formatter().parse(pattern))
    except ValueError:
        return False


def _plain(name: str) -> str:
    """A name, which others may have written, as part of a file's."""
    plain = "".join(each if each.isalnum() or each in "._-+" else "_" for each in name)
    return plain.lstrip(".")[:80] or "_"


def check_sheet(count: int, size: tuple[int, int], memory: float | None) -> None:
    """Raise InputError where a sheet of images is too large.

    Parameters
    ----------
    count : of the images
    size : width and height of each
    memory : MiB that the process may have; None for what the system has left
    """
    columns, rows = _grid(count)
    width, height = columns * size[0], rows * size[1]
    most = min(limit(memory), MAX_BYTES / MIB)
    if max(width, height) > MAX_SIDE or _OF_PIXEL * width * height > most * MIB:
        raise InputError(
            f"a sheet of {count} images is {width} x {height} pixels of {_OF_PIXEL} bytes: at most "
            f"{MAX_SIDE} a side, and {most:.0f} MiB; give a smaller size, "
            "or fewer views"
        )


def sheet(frames: Iterable[Frame], count: int, background: Vector | None) -> Frame:
    """Return so many images beside each other, in as many columns as rows or one more; what is left
    of the last row has the background. No image is kept."""
    columns, rows = _grid(count)
    for index, frame in enumerate(frames):
        height, width = frame.linear.shape[:2]
        if index == 0:
            color = background if background is not None and frame.only is None else (0.0,) * 3
            size = rows * height, columns * width
            linear = np.full((*size, 4), (*color, 0.0), dtype=np.float32)
            whole = replace(frame, linear=linear)
        top, left = index // columns * height, index % columns * width
        linear[top : top + height, left : left + width] = frame.linear
    return whole


def _grid(count: int) -> tuple[int, int]:
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)
