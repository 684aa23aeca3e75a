"""``facerender compare``."""

from __future__ import annotations

import argparse
import json
import os
from typing import Any

from numpy.typing import NDArray

from facerender.commands.common import add_verbose, check_outputs, progress_bar
from facerender.commands.streams import print_message, print_result
from facerender.comparison.result import LIMITS
from facerender.errors import InputError, warn
from facerender.images.read import read_image
from facerender.system.atomic import write_text

LIMITED = {
    "point": "excess of a pixel over what its neighbours explain",
    "block": "change of the mean of a block, as a fraction",
    "trend": "how far neighbouring blocks change alike",
    "grain": "noise that the image has more, as a fraction",
    "texture": "fine detail that the image has more, or less, as a fraction",
    "coverage": "fraction of the pixels whose coverage changed",
    "shift": "pixels by which the image is moved",
}


def add(compare: argparse.ArgumentParser) -> None:
    compare.set_defaults(command=run)
    compare.description = "Exit status: 0 the same, 1 they differ, 2 they cannot be compared."
    kinds = ".exr, .npz, .npy, .png or .jpg, or a folder of them"
    compare.add_argument("a", metavar="A", nargs="?", help=f"reference: {kinds}")
    compare.add_argument(
        "b", metavar="B", nargs="?", help="image, or folder with files of the same names"
    )
    for name, text in LIMITED.items():
        help = f"limit: {text} ({default_of(name)})"
        compare.add_argument(f"--{name}", type=float, help=help)
    compare.add_argument(
        "--limits",
        metavar="FILE",
        help="file with limits that no option sets: pytest's ini file, or pyproject.toml",
    )
    compare.add_argument(
        "--calibrate",
        metavar="DIR",
        help="find limits that pairs of images pass, those of one name in two folders of DIR, one "
        "for each run or driver, and print them as a section of pytest's ini file",
    )
    compare.add_argument(
        "-o", "--output", metavar="FILE", help="with --calibrate: a new .ini, .cfg or .toml file"
    )
    compare.add_argument("--mask", metavar="FILE", help="image, not 0 where pixels count")
    compare.add_argument("--heatmap", metavar="OUT.png", help="map of FLIP, for two images")
    compare.add_argument("--report", metavar="OUT.html", help="a page to look at the images")
    compare.add_argument("--json", action="store_true", help="every metric")
    add_verbose(compare)


def default_of(name: str) -> str:
    """Return a limit's default, for the help text."""
    linear, encoded = (getattr(LIMITS[encoding], name) for encoding in ("linear", "srgb8"))
    return f"{linear:g}" + (f"; 8-bit: {encoded:g} of 255" if encoded != linear else "")


def run(options: argparse.Namespace) -> int:
    from facerender.comparison.calibration import read_limits
    from facerender.comparison.compare import Pair, pairs_of
    from facerender.comparison.report import entry, write_report
    from facerender.comparison.visualization import save_heat_map

    mask = read_image(options.mask).color.max(axis=-1) if options.mask else None
    if options.calibrate:
        return calibrate(options, mask)
    if options.output:
        raise InputError("-o writes the limits of --calibrate: leave it out")
    if options.b is None:
        raise InputError("one image alone: give A and B, or --calibrate and a folder")
    names = pairs_of(options.a, options.b)
    limits: dict[str, Any] = {name: getattr(options, name) for name in LIMITED}
    limits["limits"] = read_limits(options.limits) if options.limits else {}
    if options.heatmap and len(names) > 1:
        raise InputError(f"--heatmap takes two images, not the {len(names)} of two folders")
    read = [path for _, *paths in names for path in paths]
    check_outputs([options.heatmap, options.report], [*read, options.mask, options.limits])
    results, entries, status = [], [], 0
    all_pairs = f"{len(names)} pairs" if len(names) > 1 else "a pair"
    with progress_bar(options) as progress:
        for number, name in enumerate(names):
            progress(all_pairs, number / len(names))
            pair = Pair.of(*name, mask=mask, **limits)
            status = max(status, pair.status)
            results.append(pair.as_dict())
            if options.report:
                entries.append(entry(pair))
            if pair.error:
                print_message(f"facerender: error: {pair.error}")
            elif not options.json:
                print_result(f"{pair.name}: {pair.comparison}")
            if not options.heatmap:
                del pair  # before the next one is read
        if options.report:
            progress("report", 0.0)
            write_report(options.report, entries)
        if options.heatmap:
            save_heat_map(options.heatmap, pair)
    if options.json:
        print_result(json.dumps({"same": status == 0, "pairs": results}, indent=2))
    return status


def calibrate(options: argparse.Namespace, mask: NDArray[Any] | None) -> int:
    """Find limits in place of comparing."""
    from facerender.comparison.calibration import calibration_of, runs_of, text_of

    for name in ("a", *LIMITED, "limits", "heatmap", "report"):
        if getattr(options, name) is not None:
            option = name.upper() if name == "a" else f"--{name}"
            raise InputError(f"--calibrate finds limits and compares nothing: leave out {option}")
    pairs = runs_of(options.calibrate)
    check_outputs([options.output], [options.mask])
    if options.output and os.path.exists(options.output):
        raise InputError(f"{options.output} exists: give a new file, and paste its sections there")
    with progress_bar(options) as progress:
        found = calibration_of(pairs, mask, progress)
    for each in found:
        for text in each.blind:
            warn(text)
    text = text_of(options.output or "pytest.ini", {each.encoding: each.noted for each in found})
    print_result(json.dumps([each.as_dict() for each in found], indent=2) if options.json else text)
    if options.output:
        write_text(options.output, f"{text}\n")
    return 0
