"""``facerender measure``."""

from __future__ import annotations

import argparse
import json

from facerender.commands.common import (
    Options,
    check_outputs,
    mesh_files,
    part_materials,
    progress_bar,
)
from facerender.commands.output import print_message, print_result
from facerender.drawing.context import BACKENDS
from facerender.material import Material
from facerender.scene.job import Job, MeshFile
from facerender.system.files import make_folder
from facerender.values.ranges import range_of


def add(measure: argparse.ArgumentParser) -> None:
    measure.set_defaults(command=run)
    measure.description = (
        "Measure the cost and the error of each specular approximation on this machine.\n"
        "Print recommended variants and tables; write measure.json, images and an HTML page.\n"
        "FLIP requires pip install 'facerender[measure]'."
    )
    options = Options(measure)
    options.add_mesh()
    folder = "out/measure"
    text = "directory for measure.json, images and index.html"
    options.add_option("-o --output DIR", text, folder, default=folder)
    options.add_allow_outside()
    options.add_parts()
    slope = "RMS slope of the skin's microfacets; other parts keep their own"
    options.add_field(Material, "m M", slope, default=Material.m)
    options.add_flag("quick", "use smaller images and fewer repeats")
    options.add_backend(BACKENDS)
    options.add_flag("json", "print measure.json instead of the table")
    options.add_verbose()


def run(options: argparse.Namespace) -> int:
    from facerender.measure import report
    from facerender.measure.measurement import measure

    range_of(Material, "m").check("m", options.m)
    folder = make_folder(options.output)
    files = [folder / name for name in (report.JSON, report.PAGE)]
    names = ("allow_outside", "parts", "hide", "as_is", "double_sided", "up", "rotate")
    file = MeshFile(options.mesh, **{name: getattr(options, name) for name in names})
    job = Job(file, parts=part_materials(options))
    check_outputs(files, mesh_files(file))
    with progress_bar(options) as progress:
        mesh = job.scene().mesh
        measurement, triptychs = measure(
            mesh, options.m, options.quick, options.backend, progress=progress
        )
        progress("report", 0.0)
        paths = report.write(measurement, triptychs, folder)
    text = report.table(measurement)
    print_result(json.dumps(report.content(measurement), indent=2) if options.json else text)
    for line in measurement.not_measured:
        print_message(f"facerender: not measured: {line}")
    if not options.quiet:
        print_message(*paths)
    return 0
