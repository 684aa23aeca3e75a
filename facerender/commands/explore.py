"""``facerender explore``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from facerender.commands.common import Options, check_outputs, progress_bar
from facerender.commands.output import print_result
from facerender.commands.scene import add_scene, files_read, job_of, plays
from facerender.errors import InputError
from facerender.explorer.page import TERM_FACTORS, explorer_page
from facerender.system.files import write_text
from facerender.terms import LOBES

_LOBE = "d16"


def add(explore: argparse.ArgumentParser) -> None:
    explore.set_defaults(command=run)
    explore.description = (
        "Write one HTML file that draws a mesh in a browser with two shadings, and shows\n"
        "their difference and cost. The file opens from disk, needs no network, and uses\n"
        "the GPU of the reader's machine. A note on the page lists features that it omits."
    )
    text = "output file, which ends in .html or .htm"
    Options(explore).add_output("OUT.html", text, ".html")
    terms, _ = add_scene(explore, shading="the shading B")
    default, lobes = f"the scene file's, otherwise {_LOBE}", tuple(LOBES)
    terms.add_option("--lobe", "lobe of shading B", default, choices=lobes)
    text = "lobe of shading A, against which the page measures B"
    terms.add_option("--against", text, "exact", choices=lobes, default="exact")
    Options(explore).add_verbose()


def run(options: argparse.Namespace) -> int:
    output = options.output or f"{Path(options.mesh or 'head').stem}.html"
    if Path(output).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{output}: the explorer is an HTML page; give a name that ends in .html")
    job, cameras = job_of(options, None)
    if len(cameras) > 1:
        raise InputError(f"the explorer opens with one camera, and there are {len(cameras)}")
    check_outputs([output], files_read(options, job), None if options.output else output)
    b = job.shading.term
    if options.lobe is None and options.scene is None:
        b = replace(b, lobe=_LOBE)
    a = replace(b, lobe=options.against, m=None, small_slope=None)
    with progress_bar(options) as progress:
        progress("mesh", 0.0)
        # The page applies these factors itself, so that its controls can remove them.
        factors = job.material.items()
        material = {name: factor for name, factor in factors if name not in TERM_FACTORS}
        mesh = replace(job, material=material).scene().mesh
        progress("page", 0.0)
        page = explorer_page(job, mesh, a, b, plays(options, job.pose))
    write_text(output, page)
    print_result(output)
    return 0
