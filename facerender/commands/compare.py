"""``facerender compare``."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from facerender.commands.options import add_options, check_outputs, progress_bar
from facerender.commands.output import print_message, print_result
from facerender.comparison import pictures
from facerender.comparison.result import LIMITS, NAMES
from facerender.comparison.sources import CHECKS, HIGHEST
from facerender.errors import InputError, clipped, warn, withheld
from facerender.images.files import SUFFIXES, WRITTEN, read_image
from facerender.system.files import write_text
from facerender.values.fields import Range

# Suffixes of each output file, keyed by the option's name in Python.
OUTPUTS = {
    "heatmap": (".png",),
    "sheet": (*WRITTEN,),
    "report": (".html", ".htm"),
    "output": (".ini", ".cfg", ".toml"),
}


def add(compare: argparse.ArgumentParser) -> None:
    compare.set_defaults(command=run)
    compare.description = (
        "Compare two images, or the images of the same names in two folders. Differences\n"
        "between OpenGL drivers (rounding, noise, moved edges) are below the limits.\n"
        "Exit status: 0 the images are the same, 1 they differ, 2 no comparison is possible."
    )
    changes: dict[str, Any] = {"a": {"nargs": "?"}, "b": {"nargs": "?"}}
    lines = []
    for name in NAMES:
        text, unit, _ = CHECKS[name]
        unit, _, remark = unit.partition(" ")
        if unit == "%":
            text, unit = f"{text}, as a fraction {remark}", ""
        changes[name] = {"limits": Range(0.0, HIGHEST, unit)}
        linear, encoded = (getattr(LIMITS[encoding], name) for encoding in ("linear", "srgb8"))
        of_encoded = f"; 8-bit images: {encoded:g}/255" if encoded != linear else ""
        lines.append(f"--{name} LIMIT | {text} | {linear:g}{of_encoded}")
    add_options(compare, _OPTIONS.replace("LIMITS", "\n".join(lines)), **changes)


_OPTIONS = f"""
A | reference: {", ".join(SUFFIXES)}, or a folder of them | required, except with --calibrate
B | image to compare, or a folder of images with the same names | required, except with --calibrate
[limits, above which the images differ]
LIMITS
--limits FILE | pytest's ini file, or pyproject.toml: limits that no option sets | none
--same-driver | compare as images of one OpenGL driver; by default, only images whose metadata name
    one driver, or that differ without noise, are of one driver
--mask FILE | image that is not 0 at the pixels to compare | all pixels
[limits for another renderer]
--calibrate DIR | find limits, instead of comparing | off | DIR has a folder for each run or driver.
    All images of the same name must pass. The limits are printed as a section of pytest's ini file,
    each with the smallest change that the limit still detects
-o --output FILE | new .ini, .cfg or .toml file for the limits of --calibrate | none
[results]
--heatmap OUT.png | image of the FLIP metric at each pixel, for two images | none
    | Requires pip install 'facerender[measure]'
--sheet OUT.png | picture of A, B and their difference, for two images | none
--report OUT.html | HTML page with all images and metrics | none
--json | print every metric as JSON
anonymous id quiet verbose
"""


def run(options: argparse.Namespace) -> int:
    from facerender.comparison.calibration import read_limits
    from facerender.comparison.compare import Pair, pairs_of
    from facerender.comparison.pictures import side_by_side
    from facerender.comparison.report import entry, write_report

    mask = read_image(options.mask).color.max(axis=-1) if options.mask else None
    if options.calibrate:
        return calibrate(options, mask)
    if options.output:
        raise InputError("-o writes the limits of --calibrate: leave -o out, or add --calibrate")
    if options.b is None:
        fault = "no images" if options.a is None else "only one image"
        raise InputError(f"{fault}: give A and B, or --calibrate with a folder")
    names = pairs_of(options.a, options.b)
    limits: dict[str, Any] = {name: getattr(options, name) for name in NAMES}
    limits["limits"] = read_limits(options.limits) if options.limits else {}
    limits["driver"] = "same" if options.same_driver else "auto"
    check_results(options, [path for _, *paths in names for path in paths], len(names))
    results, entries, status = [], [], 0
    all_pairs = f"{len(names)} pairs" if len(names) > 1 else "a pair"
    with progress_bar(options) as progress:
        for number, (name, a, b) in enumerate(names):
            progress(all_pairs, number / len(names))
            if hidden := options.anonymous is not None:
                name = f"{options.anonymous} {number + 1}" if len(names) > 1 else options.anonymous
            pair = Pair.of(name, a, b, mask=mask, anonymous=hidden, **limits)
            present = [os.path.lexists(path) for path in (a, b)]
            if os.path.isdir(options.a) and not all(present):
                folder = options.a if present[0] else options.b
                pair = replace(pair, error=f"{pair.name} is only in {folder}")
            if hidden and pair.error:
                pair = replace(pair, error=withheld(1, "message"))
            status = max(status, pair.status)
            results.append(pair.as_dict())
            if options.report:
                entries.append(entry(pair))
            if pair.error:
                print_message(f"facerender: error: {pair.error}")
            elif not options.json:
                print_result(f"{pair.name}: {pair.comparison}")
            if not (options.heatmap or options.sheet):
                del pair  # frees the images of this pair before the next is read
        if options.report:
            progress("report", 0.0)
            write_report(options.report, entries)
        if options.heatmap:
            pair.save_heat_map(options.heatmap)
        if options.sheet:
            if pair.reference is None or pair.image is None:
                raise InputError(f"no sheet: {pair.error}")
            side_by_side(pair.reference, pair.image).save(options.sheet)
    if options.json:
        print_result(json.dumps({"same": status == 0, "pairs": results}, indent=2))
    return status


def check_results(options: argparse.Namespace, images: Iterable[Path] = (), pairs: int = 1) -> None:
    """Check all output files before the images are compared. No output may replace one of
    ``images``."""
    for name, suffixes in OUTPUTS.items():
        path = getattr(options, name)
        if path and name in ("heatmap", "sheet") and pairs > 1:
            problem = f"needs two images, not folders with {pairs} pairs"
            raise InputError(f"--{name} {problem}: leave it out")
        if path and (suffix := os.path.splitext(path)[1].lower()) not in suffixes:
            problem = f"unknown format {suffix!r}; give {', '.join(suffixes)}"
            raise InputError(f"--{name} {clipped(path)}: {problem}")
    if options.heatmap:
        pictures.check_flip_installed()
    written = [getattr(options, name) for name in OUTPUTS]
    check_outputs(written, [*images, options.mask, options.limits])


def calibrate(options: argparse.Namespace, mask: NDArray[Any] | None) -> int:
    """Find limits that all pairs of images pass, and print or write these limits."""
    from facerender.comparison.calibration import ENOUGH, calibration_of, runs_of, text_of

    for name in ("a", *NAMES, "limits", "same_driver", "heatmap", "sheet", "report", "anonymous"):
        if getattr(options, name) not in (None, False):
            option = name.upper() if name == "a" else f"--{name.replace('_', '-')}"
            raise InputError(f"--calibrate finds limits instead of comparing: leave out {option}")
    pairs = runs_of(options.calibrate)
    check_results(options)
    if options.output and os.path.exists(options.output):
        remedy = "write to a new file, then copy the sections of the new file"
        raise InputError(f"{options.output} exists: {remedy} into {options.output}")
    with progress_bar(options) as progress:
        calibrations = calibration_of(pairs, mask, progress)
    for calibration in calibrations:
        if calibration.pairs < ENOUGH:
            count = f"pairs of {calibration.encoding} images: {calibration.pairs}"
            problem = "too few to cover the variation of your renders"
            warn(f"{count}, {problem}; give at least {ENOUGH}")
        for text in calibration.blind:
            warn(text)
    limits = {calibration.encoding: calibration.noted for calibration in calibrations}
    text = text_of(options.output or "pytest.ini", limits)
    if options.output:
        write_text(options.output, f"{text}\n")
    if options.json or not options.output:
        result = json.dumps([calibration.as_dict() for calibration in calibrations], indent=2)
        print_result(result if options.json else text)
    return 0
