"""What several commands share: options, values from text, where results go."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facerender.commands.streams import print_message
from facerender.errors import InputError
from facerender.job import MESH_PATHS, MeshFile, parse_size
from facerender.loading.references import named_files
from facerender.loading.source import GLTF
from facerender.system.atomic import check_writable, remove_abandoned
from facerender.system.progress import Bar
from facerender.terms.ranges import IntegerRange, range_of


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


_MAPS = {
    "albedo": "image of the colour without light, sRGB-encoded",
    "normal-map": "of normals in the space of the surface, green up",
    "specular-map": "grey, linear: multiplies ks",
    "roughness-map": "grey, linear: r gives m = r^2",
    "lobe-map": "grey, linear: white where the second lobe is",
}


def add_maps(command: argparse._ArgumentGroup, *names: str) -> None:
    for name in names:
        command.add_argument(f"--{name}", metavar="FILE", help=_MAPS[name])


def add_field(
    group: argparse._ArgumentGroup,
    kind: type,
    name: str,
    text: str,
    without: str = "",
    **keywords: Any,
) -> None:
    """Add the option that sets a field of a dataclass, whose range and unit its help states.

    Parameters
    ----------
    text : what the option does
    without : what holds without the option, in words; "" for the field's default
    """
    limits = range_of(kind, name)
    without = without or f"{getattr(kind, name):g}"
    group.add_argument(
        f"--{name.replace('_', '-')}",
        type=int if isinstance(limits, IntegerRange) else float,
        help=f"{text}, {limits} ({without})",
        **keywords,
    )


def add_flag(group: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value."""
    group.add_argument(f"--{name}", action="store_true", help=text)


def add_switch(group: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option and its contrary, --no-NAME."""
    group.add_argument(f"--{name}", action=argparse.BooleanOptionalAction, help=text)


def add_quiet(command: argparse._ActionsContainer) -> None:
    add_flag(command, "quiet", "only warnings and errors on standard error")


def add_verbose(command: argparse._ActionsContainer) -> None:
    """Add --quiet and its contrary."""
    add_quiet(command)
    add_flag(command, "verbose", "every step and when it began, on standard error")


def step_log(options: argparse.Namespace) -> Callable[[str], None]:
    """Return a function that logs a step if --verbose is given; see :func:`add_verbose`."""
    if options.quiet and options.verbose:
        raise InputError("--quiet and --verbose exclude each other: leave one of them out")
    began = time.monotonic()

    def log(step: str) -> None:
        if options.verbose:
            print_message(f"facerender: {time.monotonic() - began:.2f} s: {step}")

    return log


def progress_bar(options: argparse.Namespace) -> Bar:
    """Return a progress bar, which logs its steps if --verbose is given."""
    log = step_log(options)
    return Bar(options.quiet, log if options.verbose else None)


def add_allow_outside(command: argparse._ActionsContainer) -> None:
    text = "open what the mesh file refers to wherever it lies (below its folder alone)"
    add_flag(command, "allow-outside", text)


def add_parts(command: argparse._ActionsContainer) -> None:
    parts = (
        "draw these parts of the mesh alone; *, ? and [...] are wildcards, and facerender info "
        "lists the names (all)"
    )
    command.add_argument("--parts", metavar="NAME,...", help=parts)
    others = "draw all parts but these, named in the same way (none)"
    command.add_argument("--hide", metavar="NAME,...", help=others)


def check_outputs(
    written: Iterable[str | Path | None], read: Iterable[str | Path | None] = ()
) -> None:
    """Refuse, before any work, what cannot be written, is written twice, or is read as well, by
    whatever name; and remove what killed runs have left beside it.

    read : is looked at only where a file is there already that will be written
    """
    names: dict[object, str | Path] = {}
    for name in (each for each in written if each):
        check_writable(name)
        if (place := _identity(name)) in names:
            raise InputError(f"{name} is written twice: give another name")
        names[place] = name
    for folder in {Path(name).parent for name in names.values()}:
        remove_abandoned(folder)
    if not (there := {key: name for key, name in names.items() if os.path.exists(name)}):
        return
    for other in read:
        if other and (replaced := there.get(_identity(other))):
            raise InputError(f"{replaced} is read, and would be replaced: give another name")


def _identity(name: str | Path) -> object:
    """Return what two names of one file have in common."""
    try:
        facts = os.stat(name)
    except (OSError, ValueError):  # it is not there
        return os.path.realpath(name)
    return facts.st_dev, facts.st_ino


def mesh_files(mesh: MeshFile) -> Iterator[str | Path | None]:
    """Yield what is read of a mesh: the files that are given, and those that its file names, where
    they would be looked for."""
    yield from (getattr(mesh, name) for name in MESH_PATHS)
    if mesh.path is not None:
        for path in named_files(Path(mesh.path)):
            yield from (path, Path(mesh.path).with_name(path.name))


def import_trimesh(mesh: str | None) -> None:
    """Import trimesh, for a mesh that it reads, without scipy and networkx."""
    # trimesh imports both if it finds them, and has no switch. Reading a file needs neither, and
    # they make an import of 0.23 s one of 1.0 s. The process is the command's own: no other code
    # in it misses them.
    if mesh is None or Path(mesh).suffix.lower() in GLTF:
        return
    absent = [name for name in ("scipy", "networkx") if name not in sys.modules]
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    try:
        import trimesh  # noqa: F401
    finally:
        for name in absent:
            del sys.modules[name]
