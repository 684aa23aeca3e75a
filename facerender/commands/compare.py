"""``facerender compare``."""

from __future__ import annotations

import argparse
import json

from facerender.commands.common import add_verbose, check_outputs, steps
from facerender.commands.streams import say, tell
from facerender.errors import InputError
from facerender.image import read_image


def add(compare: argparse.ArgumentParser) -> None:
    compare.set_defaults(command=run)
    compare.description = "Exit status: 0 the same, 1 they differ, 2 they cannot be compared."
    kinds = ".exr, .npz, .npy, .png or .jpg, or a folder of them"
    compare.add_argument("a", metavar="A", help=f"reference: {kinds}")
    compare.add_argument("b", metavar="B", help="image, or folder with files of the same names")
    compare.add_argument(
        "--point", type=float, help="limit: excess of a pixel (0.05; 8-bit: 8 steps)"
    )
    compare.add_argument(
        "--block", type=float, help="limit: mean difference of a block (0.005; 8-bit: 1 step)"
    )
    compare.add_argument("--coverage", type=float, help="limit: share of changed pixels (0.005)")
    compare.add_argument("--mask", metavar="FILE", help="image, not 0 where pixels count")
    compare.add_argument("--heatmap", metavar="OUT.png", help="map of FLIP, for two images")
    compare.add_argument("--report", metavar="OUT.html", help="a page to look at the images")
    compare.add_argument("--json", action="store_true", help="every figure")
    add_verbose(compare)


def run(options: argparse.Namespace) -> int:
    from facerender.comparison.pairs import Pair, pairs_of
    from facerender.comparison.pictures import save_heat_map
    from facerender.comparison.report import entry, write_report

    limits = {name: getattr(options, name) for name in ("point", "block", "coverage")}
    mask = read_image(options.mask).color.max(axis=-1) if options.mask else None
    names = pairs_of(options.a, options.b)
    if options.heatmap and len(names) > 1:
        raise InputError(f"--heatmap takes two images, not the {len(names)} of two folders")
    read = [path for _, *paths in names for path in paths]
    check_outputs([options.heatmap, options.report], [*read, options.mask])
    results, entries, status = [], [], 0
    all_pairs = f"{len(names)} pairs" if len(names) > 1 else "a pair"
    with steps(options) as progress:
        for number, name in enumerate(names):
            progress(all_pairs, number / len(names))
            pair = Pair.of(*name, mask=mask, **limits)
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
