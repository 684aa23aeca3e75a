"""``facerender compare``."""

from __future__ import annotations

import argparse
import json
from typing import Any

from numpy.typing import NDArray

from facerender.commands.common import add_verbose, check_outputs, steps
from facerender.commands.streams import say, tell
from facerender.comparison.compare import LIMITS
from facerender.errors import InputError, warn
from facerender.images.read import read_image

LIMITED = {
    "point": "excess of a pixel over what its neighbours explain",
    "block": "change of the mean of a block, as a share",
    "trend": "how far neighbouring blocks change alike",
    "grain": "noise that the image has more, as a share",
    "texture": "fine detail that the image has more, or less, as a share",
    "coverage": "share of the pixels whose coverage changed",
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
        help="take limits that are not given from an ini file, pytest's, or pyproject.toml",
    )
    compare.add_argument(
        "--calibrate",
        metavar="DIR",
        help="find limits that pairs of images pass, those of one name in two folders of DIR, one "
        "for each run or driver; tell what they still see; write them into the file of --limits",
    )
    compare.add_argument("--mask", metavar="FILE", help="image, not 0 where pixels count")
    compare.add_argument("--heatmap", metavar="OUT.png", help="map of FLIP, for two images")
    compare.add_argument("--report", metavar="OUT.html", help="a page to look at the images")
    compare.add_argument("--json", action="store_true", help="every figure")
    add_verbose(compare)


def default_of(name: str) -> str:
    """Return a limit's default, as help tells it."""
    linear, encoded = (getattr(LIMITS[encoding], name) for encoding in ("linear", "srgb8"))
    return f"{linear:g}" + (f"; 8-bit: {encoded:g} of 255" if encoded != linear else "")


def run(options: argparse.Namespace) -> int:
    from facerender.comparison.limits_file import read_limits
    from facerender.comparison.pairs import Pair, pairs_of
    from facerender.comparison.report import entry, write_report
    from facerender.comparison.visualization import save_heat_map

    mask = read_image(options.mask).color.max(axis=-1) if options.mask else None
    if options.calibrate:
        return calibrate(options, mask)
    if options.b is None:
        raise InputError("one image alone: give A and B, or --calibrate and a folder")
    limits = {name: getattr(options, name) for name in LIMITED}
    kept = read_limits(options.limits) if options.limits else {}
    names = pairs_of(options.a, options.b)
    if options.heatmap and len(names) > 1:
        raise InputError(f"--heatmap takes two images, not the {len(names)} of two folders")
    read = [path for _, *paths in names for path in paths]
    check_outputs([options.heatmap, options.report], [*read, options.mask, options.limits])
    results, entries, status = [], [], 0
    all_pairs = f"{len(names)} pairs" if len(names) > 1 else "a pair"
    with steps(options) as progress:
        for number, name in enumerate(names):
            progress(all_pairs, number / len(names))
            pair = Pair.of(*name, kept, mask=mask, **limits)
            status = max(status, pair.status)
            results.append(pair.as_dict())
            if options.report:
                entries.append(entry(pair))
            if pair.error:
                say(f"facerender: error: {pair.error}")
            elif not options.json:
                tell(f"{pair.name}: {pair.comparison}")
            if not options.heatmap:
                del pair  # before the next one is read
        if options.report:
            progress("report", 0.0)
            write_report(options.report, entries)
        if options.heatmap:
            save_heat_map(options.heatmap, pair)
    if options.json:
        tell(json.dumps({"same": status == 0, "pairs": results}, indent=2))
    return status


def calibrate(options: argparse.Namespace, mask: NDArray[Any] | None) -> int:
    """Find limits in place of comparing."""
    from facerender.comparison.calibration import calibration_of, runs_of
    from facerender.comparison.limits_file import text_of, write_limits

    given = ("a", *LIMITED, "heatmap", "report")
    for name in given:
        if getattr(options, name) is not None:
            shown = name.upper() if name == "a" else f"--{name}"
            raise InputError(f"--calibrate finds limits and compares nothing: leave out {shown}")
    pairs = runs_of(options.calibrate)
    check_outputs([options.limits], [options.mask])
    with steps(options) as progress:
        found = calibration_of(pairs, mask, progress)
    limits = {each.encoding: each.noted for each in found}
    for each in found:
        for told in each.blind:
            warn(told)
    if options.json:
        tell(json.dumps([each.as_dict() for each in found], indent=2))
    else:
        tell(text_of(options.limits or "pytest.ini", limits))
    if options.limits:
        write_limits(options.limits, limits)
    return 0
