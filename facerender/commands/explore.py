"""``facerender explore``."""

from __future__ import annotations

import argparse
from pathlib import Path

from facerender.commands.common import clean_up_on_interrupt, import_trimesh
from facerender.errors import InputError
from facerender.explorer import explorer
from facerender.image import write_bytes
from facerender.job import Job, MeshFile


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
    for name in ("albedo", "normal-map", "specular-map", "roughness-map"):
        maps.add_argument(f"--{name}", metavar="FILE")
    maps.add_argument("--flip-v", action="store_true", help="turn texture coordinates upside down")


def run(options: argparse.Namespace) -> int:
    if Path(options.output).suffix.lower() not in (".html", ".htm"):
        raise InputError(
            f"{options.output}: the explorer is a page; give a name that ends in .html"
        )
    file = MeshFile(
        options.mesh,
        options.albedo,
        options.normal_map,
        options.specular_map,
        options.roughness_map,
        options.flip_v,
    )
    import_trimesh()
    page = explorer(Job(file), file.load())
    clean_up_on_interrupt()
    write_bytes(options.output, page.encode())
    print(options.output)
    return 0
