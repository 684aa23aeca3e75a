"""``facerender measure``."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

from facerender.commands.common import (
    add_allow_outside,
    add_parts,
    add_verbose,
    check_outputs,
    import_trimesh,
    make_folder,
    mesh_files,
    steps,
)
from facerender.commands.streams import say, tell
from facerender.drawing.context import BACKENDS
from facerender.job import MeshFile
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
    add_allow_outside(measure)
    add_parts(measure)
    measure.add_argument("--m", type=float, help="rms slope of the mesh (0.3)")
    measure.add_argument("--quick", action="store_true", help="smaller images, fewer repeats")
    measure.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    measure.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="FILE",
        help="add what the explorer measured on another GPU, and saved; without a mesh, --m, "
        "--quick or --backend to the measurement in DIR, where there is one. May be repeated",
    )
    measure.add_argument("--json", action="store_true", help="print measure.json, no table")
    add_verbose(measure)


def run(options: argparse.Namespace) -> int:
    from facerender.measure import plots, report
    from facerender.measure.imported import read_imported
    from facerender.measure.run import measure

    plots.check()
    imports = [read_imported(file) for file in options.imports]
    folder = make_folder(options.output)
    read = [*mesh_files(MeshFile(options.mesh)), *options.imports]
    check_outputs([folder / name for name in (report.JSON, report.PAGE)], read)
    kept = report.read_imports(folder)
    asked = options.mesh or options.quick or options.m is not None or options.backend != "auto"
    asked = asked or options.parts is not None or options.hide is not None
    earlier = report.read(folder) if imports and not asked else None
    told = []
    with steps(options) as progress:
        if earlier:
            measurement, triptychs = earlier, None
        else:
            import_trimesh(options.mesh)
            mesh = load_mesh(options.mesh, allow_outside=options.allow_outside)
            mesh = mesh.select(options.parts or (), options.hide or ())
            m = 0.3 if options.m is None else options.m
            measurement, triptychs = measure(mesh, m, options.quick, options.backend, progress)
            measurement = replace(measurement, imports=kept)
        for file, imported in zip(options.imports, imports, strict=True):
            count = len(measurement.imports)
            measurement = measurement.with_import(imported)
            place = "added" if len(measurement.imports) > count else "in place of an earlier one"
            told.append(f"facerender: {file}: {imported.gpu}: {place}")
        progress("report", 0.0)
        paths = report.write(measurement, triptychs, folder)
    content = measurement.as_dict()
    tell(json.dumps(content, indent=2) if options.json else report.table(measurement))
    for line in measurement.not_measured:
        say(f"facerender: not measured: {line}")
    if not options.quiet:
        say(*told, *paths)
    return 0
