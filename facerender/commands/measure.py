"""``facerender measure``."""

from __future__ import annotations

import argparse
import json
import sys

from facerender.commands.common import Progress, clean_up_on_interrupt, import_trimesh, make_folder
from facerender.drawing.context import BACKENDS
from facerender.loading import load_mesh


def add(measure: argparse.ArgumentParser) -> None:
    measure.set_defaults(command=run)
    measure.add_argument("mesh", nargs="?", help="rendered; without it the built-in head")
    measure.add_argument(
        "-o",
        "--output",
        default="out/measure",
        metavar="DIR",
        help="for measure.json, plots and index.html (out/measure)",
    )
    measure.add_argument("--m", type=float, default=0.3, help="rms slope of the mesh (0.3)")
    measure.add_argument("--quick", action="store_true", help="smaller images, fewer repeats")
    measure.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    measure.add_argument("--json", action="store_true", help="print measure.json, no table")


def run(options: argparse.Namespace) -> int:
    from facerender.measure import plots, report
    from facerender.measure.run import measure

    plots.check()
    folder = make_folder(options.output)
    import_trimesh()
    mesh = load_mesh(options.mesh)
    with Progress() as progress:
        measurement, triptychs = measure(mesh, options.m, options.quick, options.backend, progress)
        progress("report", 0.0)
        clean_up_on_interrupt()
        paths = report.write(measurement, triptychs, folder)
    content = measurement.as_dict()
    print(json.dumps(content, indent=2) if options.json else report.table(measurement))
    for line in measurement.not_measured:
        print(f"facerender: not measured: {line}", file=sys.stderr)
    print(*paths, sep="\n", file=sys.stderr)
    return 0
