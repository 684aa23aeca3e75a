"""``facerender explore``."""

from __future__ import annotations

import argparse
from pathlib import Path

from facerender.commands.common import (
    MAPS_TITLE,
    add_allow_outside,
    add_flip_v,
    add_maps,
    add_mesh,
    add_parts,
    add_verbose,
    check_outputs,
    import_trimesh,
    mesh_files,
    part_materials,
    progress_bar,
)
from facerender.commands.help import Help
from facerender.commands.streams import print_result
from facerender.errors import InputError
from facerender.explorer.page import explorer_page
from facerender.job import Job, MeshFile
from facerender.system.atomic import write_text


def add(explore: argparse.ArgumentParser) -> None:
    explore.set_defaults(command=run)
    explore.description = (
        "Write one HTML file that draws a mesh in a browser with two shadings, and shows\n"
        "their difference and cost. The file opens from disk, needs no network, and uses\n"
        "the GPU of the reader's machine."
    )
    add_mesh(explore)
    output = Help("output file, which ends in .html or .htm", "required")
    explore.add_argument("-o", "--output", required=True, metavar="OUT.html", help=output)
    maps = explore.add_argument_group(MAPS_TITLE)
    add_maps(maps, "albedo", "normal-map", "specular-map", "roughness-map")
    add_flip_v(maps)
    add_allow_outside(maps)
    add_parts(explore)
    add_verbose(explore)


def run(options: argparse.Namespace) -> int:
    if Path(options.output).suffix.lower() not in (".html", ".htm"):
        raise InputError(
            f"{options.output}: the explorer is an HTML page; give a name that ends in .html"
        )
    file = MeshFile(
        options.mesh,
        albedo=options.albedo,
        normal_map=options.normal_map,
        specular_map=options.specular_map,
        roughness_map=options.roughness_map,
        flip_v=options.flip_v,
        allow_outside=options.allow_outside,
        parts=options.parts,
        hide=options.hide,
        as_is=options.as_is,
        double_sided=options.double_sided,
    )
    job = Job(file, parts=part_materials(options))
    check_outputs([options.output], mesh_files(file))
    import_trimesh(options.mesh)
    with progress_bar(options) as progress:
        progress("mesh", 0.0)
        mesh = job.scene().mesh
        progress("page", 0.0)
        page = explorer_page(job, mesh)
    write_text(options.output, page)
    print_result(options.output)
    return 0
