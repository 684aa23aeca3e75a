"""``facerender measure``."""

from __future__ import annotations

import argparse
import json

from facerender.commands.common import (
    add_allow_outside,
    add_parts,
    add_verbose,
    check_outputs,
    import_trimesh,
    mesh_files,
    progress_bar,
)
from facerender.commands.streams import print_message, print_result
from facerender.drawing.context import BACKENDS
from facerender.job import MeshFile
from facerender.loading import load_mesh
from facerender.system.atomic import make_folder


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
    add_allow_outside(measure)
    add_parts(measure)
    measure.add_argument("--m", type=float, default=0.3, help="rms slope of the mesh (0.3)")
    measure.add_argument("--quick", action="store_true", help="smaller images, fewer repeats")
    measure.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    measure.add_argument("--json", action="store_true", help="print measure.json, no table")
    add_verbose(measure)


def run(options: argparse.Namespace) -> int:
    from facerender.measure import plots, report
    from facerender.measure.run import measure

    plots.check()
    folder = make_folder(options.output)
    files = [folder / name for name in (report.JSON, report.PAGE)]
    check_outputs(files, mesh_files(MeshFile(options.mesh)))
    with progress_bar(options) as progress:
        import_trimesh(options.mesh)
        mesh = load_mesh(options.mesh, allow_outside=options.allow_outside)
        mesh = mesh.select(options.parts or (), options.hide or ())
        measurement, triptychs = measure(
            mesh, options.m, options.quick, options.backend, progress=progress
        )
        progress("report", 0.0)
        paths = report.write(measurement, triptychs, folder)
    content = measurement.as_dict()
    print_result(json.dumps(content, indent=2) if options.json else report.table(measurement))
    for line in measurement.not_measured:
        print_message(f"facerender: not measured: {line}")
    if not options.quiet:
        print_message(*paths)
    return 0
