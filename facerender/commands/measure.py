"""``facerender measure``."""

from __future__ import annotations

import argparse
import json

from facerender.commands import options as common
from facerender.commands.output import print_message, print_result
from facerender.commands.scene import fields_set, part_materials
from facerender.drawing.context import BACKENDS
from facerender.material import Material
from facerender.scene.job import Job
from facerender.system.files import make_folder


def add(measure: argparse.ArgumentParser) -> None:
    measure.set_defaults(command=run)
    measure.description = (
        "Measure the cost and the error of each specular approximation on this machine.\n"
        "Print recommended variants and tables; write measure.json, images and an HTML page.\n"
        "FLIP requires pip install 'facerender[measure]'."
    )
    slope = "RMS slope of the skin's microfacets; other parts keep their own"
    slopes = {"text": slope, "unset": f"{Material.m:g}", "note": "", "default": Material.m}
    changes = common.SCENE_CHANGES | {"m": slopes, "output": {"default": _FOLDER}}
    common.add_options(measure, _OPTIONS, **changes, backend=common.BACKEND | {"choices": BACKENDS})


_FOLDER = "out/measure"
_OPTIONS = f"""mesh
-o --output DIR | directory for measure.json, images and index.html | {_FOLDER}
allow_outside {common.PARTS} m
--quick | use smaller images and fewer repeats
backend
--json | print measure.json instead of the table
quiet verbose
"""


def run(options: argparse.Namespace) -> int:
    from facerender.measure import report
    from facerender.measure.measurement import measure

    material = {"m": options.m}
    job = Job(**fields_set(options, "mesh"), material=material, parts=part_materials(options))
    folder = make_folder(options.output)
    files = [folder / name for name in (report.JSON, report.PAGE)]
    common.check_outputs(files, common.mesh_files(job.mesh))
    with common.progress_bar(options) as progress:
        mesh = job.scene().mesh
        measurement, triptychs = measure(
            mesh, options.m, options.quick, options.backend, progress=progress
        )
        progress("report", 0.0)
        paths = report.write(measurement, triptychs, folder)
    text = report.table(measurement)
    print_result(json.dumps(report.content(measurement), indent=2) if options.json else text)
    for line in measurement["not_measured"]:
        print_message(f"facerender: not measured: {line}")
    if not options.quiet:
        print_message(*paths)
    return 0
