"""``facerender explore``."""

from __future__ import annotations

import argparse
from pathlib import Path

from facerender.commands.common import (
    add_allow_outside,
    add_maps,
    add_parts,
    add_verbose,
    check_outputs,
    import_trimesh,
    mesh_files,
    progress_bar,
)
from facerender.commands.streams import print_result
from facerender.errors import InputError
from facerender.explorer.page import explorer_page
from facerender.job import Job, MeshFile
from facerender.system.atomic import write_text


def add(explore: argparse.ArgumentParser) -> None:
    explore.set_defaults(command=run)
    explore.description = (
        "Write a page that draws the mesh in a browser with any two shadings, and tells their "
        "difference; it needs no network."
    )
    explore.add_argument(
        "mesh", nargs="?", help=".glb .gltf .obj .ply .stl; without it the built-in head"
    )
    explore.add_argument("-o", "--output", required=True, metavar="OUT.html")
    maps = explore.add_argument_group("maps, in place of those of the mesh file")
    add_maps(maps, "albedo", "normal-map", "specular-map", "roughness-map")
    maps.add_argument("--flip-v", action="store_true", help="turn texture coordinates upside down")
    add_allow_outside(maps)
    add_parts(explore)
    add_verbose(explore)


def run(options: argparse.Namespace) -> int:
    if Path(options.output).suffix.lower() not in (".html", ".htm"):
        raise InputError(
            f"{options.output}: the explorer is a page; give a name that ends in .html"
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
    )
    check_outputs([options.output], mesh_files(file))
    import_trimesh(options.mesh)
    with progress_bar(options) as progress:
        progress("mesh", 0.0)
        mesh = file.load()
        progress("page", 0.0)
        page = explorer_page(Job(file), mesh)
    write_text(options.output, page)
    print_result(options.output)
    return 0
