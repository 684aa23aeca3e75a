"""``facerender explore``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facerender.commands.common import (
    add_allow_outside,
    add_maps,
    add_parts,
    add_verbose,
    check_outputs,
    import_trimesh,
    mesh_files,
    steps,
)
from facerender.commands.streams import tell
from facerender.errors import InputError
from facerender.explorer import explorer
from facerender.job import Job, MeshFile
from facerender.system.atomic import write_text
from facerender.system.progress import Progress

if TYPE_CHECKING:
    from facerender.planning.plan import Plan
    from facerender.scenes.mesh import Mesh


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
    explore.add_argument(
        "--plan",
        metavar="BUDGET",
        help="1/255, 0.5%% or '0.02 flip': what facerender plan decides within it, as switches",
    )
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
    if options.plan is not None:
        from facerender.planning.budget import Budget

        Budget.parse(options.plan)
    file = MeshFile(
        options.mesh,
        options.albedo,
        options.normal_map,
        options.specular_map,
        options.roughness_map,
        options.flip_v,
        allow_outside=options.allow_outside,
        parts=options.parts,
        hide=options.hide,
    )
    check_outputs([options.output], mesh_files(file))
    import_trimesh(options.mesh)
    with steps(options) as progress:
        progress("mesh", 0.0)
        job, mesh = Job(file), file.load()
        planned = _planned(job, mesh, options.plan, progress) if options.plan else None
        progress("page", 0.0)
        page = explorer(job, mesh, planned)
    write_text(options.output, page)
    tell(options.output)
    return 0


def _planned(job: Job, mesh: Mesh, budget: str, progress: Progress) -> Plan:
    """Return the plan of what the page begins with. Its cost is that of a fragment: the page draws
    all samples and triangles."""
    from facerender.drawing.renderer import Renderer
    from facerender.planning.plan import plan

    with Renderer.of(job) as renderer:
        return plan(job.scene(mesh), budget, cost="auto", renderer=renderer, progress=progress)
