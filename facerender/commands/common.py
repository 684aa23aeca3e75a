"""Code shared by the commands: options and their help texts, parsing of values, checks of output
files, and printing of results and messages, even if a stream is closed, is full or cannot encode a
character."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from facerender.commands.output import Help, print_message
from facerender.errors import InputError, shown
from facerender.loading.source import FORMATS, named_files
from facerender.material import PRESETS
from facerender.scene.environment import STUDIO
from facerender.scene.file import ImageSettings, parse_part
from facerender.scene.job import MESH_PATHS, Job, MeshFile, parse_size
from facerender.system.files import check_file, check_writable, remove_abandoned
from facerender.system.process import Bar
from facerender.values.ranges import IntegerRange, Range, range_of
from facerender.values.vectors import ROTATIONS, UP_NAMES


def parse_sizes(text: str) -> list[tuple[int, int]]:
    """Parse a size such as 1024, or a range such as 512..1024.

    A range gives both ends and sizes between the ends. Each size is the previous one times a
    constant factor of at most sqrt(2).
    """
    first, *last = map(parse_size, text.split("..", 1))
    if not last:
        return [first]
    ranges = [*zip(first, *last, strict=True)]
    if not all(low <= high for low, high in ranges):
        raise InputError(f"sizes {text!r}: give the smaller size first, such as 512..1024")
    steps = math.ceil(2.0 * max(math.log2(high / low) for low, high in ranges) - 1e-9)
    widths, heights = (np.geomspace(low, high, steps + 1).round() for low, high in ranges)
    return [(int(width), int(height)) for width, height in zip(widths, heights, strict=True)]


def number_parser(whole: bool, values: str) -> Callable[[str], float]:
    """Return a function that parses the number of an option, for argparse. Its message on other
    text states the valid values."""

    def parse(text: str) -> float:
        with suppress(ValueError):
            return int(text) if whole else float(text)
        kind = "a whole number" if whole else "a number"
        raise argparse.ArgumentTypeError(f"{shown(text)} is not {kind}: give {values}")

    return parse


def parse_angles(text: str) -> list[float]:
    """Parse the value of --rotate, for argparse."""
    with suppress(ValueError):
        if len(angles := [*map(float, text.split(","))]) == 3:
            return angles
    raise argparse.ArgumentTypeError(f"{shown(text)} is not X,Y,Z: give three numbers")


SIDE = f"{ImageSettings.size[0]}"  # default of --size


class Options:
    """A group of a command's options. Every option has a :class:`Help`."""

    def __init__(self, command: argparse.ArgumentParser, title: str = "") -> None:
        """Add a group to a command; without a title, use the command's first group."""
        self.group = command.add_argument_group(title) if title else command

    def add_option(
        self,
        names: str,
        text: str,
        without: str,
        note: str = "",
        values: Range | str = "",
        unit: str = "",
        **keywords: Any,
    ) -> None:
        """Add an option with a value.

        Parameters
        ----------
        names : names of the option and, except with choices, of its value, such as "-o --output F"
        without : default, as the help states it
        text, note, values, unit : see :class:`Help`; a range has both values and a unit
        keywords : further arguments of ``add_argument``
        """
        if isinstance(values, Range):
            unit = values.unit
            values = str(values).removesuffix(unit).strip()
        words = names.split()
        flags = [word for word in words if word.startswith("-")]
        metavar = words[-1] if len(words) > len(flags) else None
        help_text = Help(text, without, values, unit, note)
        self.group.add_argument(*flags, metavar=metavar, help=help_text, **keywords)

    def add_number(
        self, name: str, text: str, limits: Range, without: str, note: str = "", **keywords: Any
    ) -> None:
        """Add an option for a number. The help states its range, unit and default.

        Parameters
        ----------
        name : name of the option in Python and, if any, of its value, such as "lobe_weight W"
        text, without, note, keywords : see :meth:`add_option`
        """
        parser = number_parser(isinstance(limits, IntegerRange), str(limits))
        names = f"--{name.replace('_', '-')}"
        self.add_option(names, text, without, note, limits, type=parser, **keywords)

    def add_field(
        self,
        kind: type,
        name: str,
        text: str,
        without: str = "{:g}",
        note: str = "",
        **keywords: Any,
    ) -> None:
        """Add the option that sets a field of a dataclass, with the range of the field.

        Parameters
        ----------
        name, text, note, keywords : see :meth:`add_number`
        without : default, as the help states it, or a format such as "{:g}" for the field's default
        """
        field = name.split()[0]
        default = without.format(getattr(kind, field)) if "{" in without else without
        self.add_number(name, text, range_of(kind, field), default, note, **keywords)

    def add_flag(self, name: str, text: str, note: str = "") -> None:
        """Add an option without a value."""
        help_text = Help(text, "off", note=note)
        self.group.add_argument(f"--{name}", action="store_true", help=help_text)

    def add_switch(self, name: str, text: str, default: str) -> None:
        """Add the options --NAME and --no-NAME."""
        self.add_option(f"--{name}", text, default, action=argparse.BooleanOptionalAction)

    def add_mesh(self) -> None:
        """Add the positional argument MESH."""
        *suffixes, last = FORMATS
        formats = Help(f"mesh file: {', '.join(suffixes)} or {last}", "the built-in head")
        self.group.add_argument("mesh", nargs="?", metavar="MESH", help=formats)

    def add_size(
        self, without: str, note: str = "", forms: str = "N|WxH", default: str | None = None
    ) -> None:
        """Add --size, whose value has one of the forms. See also :meth:`add_field`."""
        text, values = "width and height, or N for both", range_of(ImageSettings, "size")
        self.add_option(f"--size {forms}", text, without, note, values, default=default)

    def add_samples(self) -> None:
        note = "Above the driver's maximum, each sample is drawn as a separate, shifted image"
        self.add_field(ImageSettings, "samples N", "samples per pixel", note=note)

    def add_budget(self, text: str, required: bool = False, within: str | None = None) -> None:
        """Add --budget and --within; ``within`` is the default value of --within."""
        without = "required" if required else "none"
        note = "1/255 is one 8-bit level, 0.5% is relative radiance, '0.02 flip' is the FLIP metric"
        self.add_option("--budget ERROR", text, without, note, "at least 0", required=required)
        text = "fraction of each image's covered pixels that must meet the budget"
        values = "above 0, at most 1 or 100%"
        self.add_option("--within FRACTION", text, "100%", values=values, default=within)

    def add_output(self, value: str, text: str, suffix: str, note: str = "") -> None:
        """Add -o, whose default is the mesh's name with another suffix."""
        file = f"the mesh's name with {suffix} in the current directory"
        self.add_option(f"-o --output {value}", text, f"{file}, which must not exist yet", note)

    def add_backend(self, backends: Sequence[str]) -> None:
        """Add --backend, which accepts the names in `backends`."""
        note = "auto tries egl, then osmesa; on Windows and macOS, auto is native (WGL, CGL). "
        note += "On Linux, native is GLX, which requires an X server"
        if "current" in backends:
            note += ". current is the OpenGL context of the calling program"
        text, auto = "OpenGL backend", "auto"
        self.add_option("--backend", text, auto, note, choices=backends, default=auto)

    def add_quiet(self) -> None:
        self.add_flag("quiet", "print only warnings and errors on standard error")

    def add_verbose(self) -> None:
        """Add --verbose and --quiet."""
        self.add_quiet()
        self.add_flag("verbose", "log each step and its start time on standard error")

    def add_allow_outside(self) -> None:
        text = "open files that the mesh file refers to even if they are outside its directory"
        self.add_flag("allow-outside", text)

    def add_axes(self) -> None:
        """Add --up and --rotate."""
        text = "axis of the mesh file that points up"
        note = "auto turns a face upright that is found on the surface"
        self.add_option("--up", text, "y", note, choices=UP_NAMES)
        text = "rotate the mesh about x, then y, then z, after --up"
        note = "Poses, files of vertices and cameras of the mesh file follow"
        self.add_option("--rotate X,Y,Z", text, "0,0,0", note, ROTATIONS, type=parse_angles)

    def add_parts(self) -> None:
        """Add --parts, --hide, --part, --as-is, --double-sided, --up and --rotate."""
        names = "Names may contain the wildcards *, ? and [...]; facerender info lists the names"
        self.add_option("--parts NAME,...", "render only these parts of the mesh", "all", names)
        hidden = "do not render these parts, which are named as in --parts"
        self.add_option("--hide NAME,...", hidden, "none")
        note = (
            "Give NAME=PRESET, NAME,FACTOR=VALUE,... or both, such as 'eye*=sclera' or "
            "'lash*,alpha=blend,opacity=0.8'. Factors are the fields of Material; presets: "
            f"{', '.join(PRESETS)}"
        )
        text, default = "material of some parts; repeat for other parts", "the mesh file's"
        self.add_option("--part NAME=PRESET", text, default, note, action="append")
        self.add_as_is()
        note = "By default, glTF materials decide; in other formats, only open surfaces have two "
        note += "sides"
        self.add_flag("double-sided", "draw the back faces of all parts", note)
        self.add_axes()

    def add_as_is(self) -> None:
        note = "By default, a part with a known name and without maps or opacity gets a preset. "
        note += "Names define the skin in both cases"
        self.add_flag("as-is", "draw every part with the material of the mesh file", note)


def step_log(options: argparse.Namespace) -> Callable[[str], None]:
    """Return a function that logs a step, but only with --verbose; see :func:`add_verbose`."""
    if options.quiet and options.verbose:
        raise InputError("--quiet and --verbose exclude each other: leave one of them out")
    began = time.monotonic()

    def log(step: str) -> None:
        if options.verbose:
            print_message(f"facerender: {time.monotonic() - began:.2f} s: {step}")

    return log


def progress_bar(options: argparse.Namespace) -> Bar:
    """Return a progress bar, or a log of the steps if --verbose is given."""
    log = step_log(options)
    return Bar(options.quiet, log if options.verbose else None)


def part_materials(
    options: argparse.Namespace, known: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, dict[str, Any]]:
    """Return the materials of parts: the tables ``known`` of a scene file, as in
    :func:`facerender.scene.file.part_tables`, changed by --part. Later options win."""
    tables = {name: dict(table) for name, table in (known or {}).items()}
    for name, table in map(parse_part, options.part or ()):
        tables[name] = {**tables.pop(name, {}), **table}
    return tables


def check_inputs(job: Job) -> None:
    """Raise InputError if an input file of a job is missing, before other checks refer to it."""
    if job.mesh.path is not None:
        _ = job.mesh.source  # reads the file
    for name in MESH_PATHS:
        if name != "path" and (path := getattr(job.mesh, name)) is not None:
            check_file(path, "an image file")
    for pose in (job.pose, job.before):
        if pose.vertices is not None:
            check_file(pose.vertices, "a file of vertices", sys.maxsize)
    if job.environment is not None and job.environment.file != STUDIO:
        from facerender.scene.environment import wanted

        check_file(job.environment.file, wanted(job.environment.file))


def check_outputs(
    written: Iterable[str | Path | None],
    read: Iterable[str | Path | None] = (),
    default: str | None = None,
) -> None:
    """Check the output files of a command before it starts to work.

    The function also deletes unfinished files of killed commands in the directories of the output
    files.

    Parameters
    ----------
    written : output files; None is ignored
    read : input files; the iterable is used only if an output file already exists
    default : name of the output without -o, which replaces no file; None with -o

    Raises
    ------
    InputError : an output file cannot be written, appears twice, or is also an input file; the
        paths may differ, for example through a link
    """
    paths = [path for path in written if path]
    if default and (existing := [*filter(os.path.lexists, paths)]):
        raise InputError(f"{existing[0]} exists: give -o {default} to replace it, or another name")
    names: dict[object, str | Path] = {}
    for name in paths:
        check_writable(name)
        if (identity := _identity(name)) in names:
            raise InputError(f"{name} is written twice: give another name")
        names[identity] = name
    for folder in {Path(name).parent for name in names.values()}:
        remove_abandoned(folder)
    if not (replaceable := {key: name for key, name in names.items() if os.path.exists(name)}):
        return
    for path in read:
        if path and (replaced := replaceable.get(_identity(path))):
            raise InputError(f"{replaced} is both input and output: give another output file")


def _identity(name: str | Path) -> object:
    """Return a value that is equal for all paths of one file."""
    try:
        facts = os.stat(name)
        return facts.st_dev, facts.st_ino
    except (OSError, ValueError):  # no such file yet
        return os.path.realpath(name)


def mesh_files(mesh: MeshFile) -> Iterator[str | Path | None]:
    """Yield the input files of a mesh, and all possible paths of files that its file refers to."""
    yield from (getattr(mesh, name) for name in MESH_PATHS)
    if mesh.path is not None:
        for path in named_files(mesh.source):
            yield from (path, Path(mesh.path).with_name(path.name))
