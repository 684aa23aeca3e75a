"""What several commands share: values from text, folders, progress, interrupts."""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from facerender.errors import InputError, reason


def parse_size(text: str) -> tuple[int, int]:
    try:
        numbers = [int(word) for word in text.lower().split("x")]
        width, height = numbers * 2 if len(numbers) == 1 else numbers
    except ValueError:
        raise InputError(f"size {text!r}: give N or WxH, such as 1024 or 640x480") from None
    return width, height


def parse_sizes(text: str) -> list[tuple[int, int]]:
    """Read a size, or of a range such as 512..1024 both ends, and evenly between them so many that
    none is more than sqrt(2) times the one before."""
    first, *rest = map(parse_size, text.split("..", 1))
    if not rest:
        return [first]
    ranges = [*zip(first, *rest, strict=True)]
    if not all(0 < low <= high for low, high in ranges):
        raise InputError(f"sizes {text!r}: give a smaller and a larger one, such as 512..1024")
    steps = math.ceil(2.0 * max(math.log2(high / low) for low, high in ranges) - 1e-9)
    widths, heights = (np.geomspace(low, high, steps + 1).round() for low, high in ranges)
    return [(int(width), int(height)) for width, height in zip(widths, heights, strict=True)]


def numbers_of(option: str, text: str, counts: Sequence[int]) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts:
        wanted = " or ".join(map(str, counts))
        raise InputError(f"--{option} {text!r}: give {wanted} numbers with commas between")
    return numbers


def clean_up_on_interrupt() -> None:
    """From here on files are written, which Ctrl-C must not leave half-written."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def make_folder(text: str) -> Path:
    """Make the folder of the results, so that nothing is measured for one that cannot be."""
    try:
        Path(text).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {text}: {reason(error)}; give a writable folder") from None
    return Path(text)


class Progress:
    """A line on standard error that says what is done, and vanishes; on a terminal only."""

    def __enter__(self) -> Progress:
        return self

    def __call__(self, what: str, done: float) -> None:
        if sys.stderr.isatty():
            bar = "#" * round(24 * done)
            print(f"\r\033[K{bar:24}  {what}", end="", file=sys.stderr, flush=True)

    def __exit__(self, *exception: object) -> None:
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)


def import_trimesh() -> None:
    """Import trimesh without scipy and networkx, which it imports where it finds them, for things
    that reading a file does not need, and which take two thirds of a cold start. The process is
    this command's own, so nobody else misses them in trimesh."""
    absent = [name for name in ("scipy", "networkx") if name not in sys.modules]
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    try:
        import trimesh  # noqa: F401
    finally:
        for name in absent:
            del sys.modules[name]
