"""``facerender explore``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from facerender.commands import options as common
from facerender.commands.output import print_result
from facerender.commands.scene import files_read, job_of, plays
from facerender.errors import InputError
from facerender.explorer.page import TERM_FACTORS, explorer_page
from facerender.system.files import write_text
from facerender.terms.lobe import LOBES

_LOBE = "d16"


def add(explore: argparse.ArgumentParser) -> None:
    explore.set_defaults(command=run)
    explore.description = (
        "Write one HTML file that draws a mesh in a browser with two shadings, and shows\n"
        "their difference and cost. The file opens from disk, needs no network, and uses\n"
        "the GPU of the reader's machine. A note on the page lists features that it omits."
    )
    changes: dict[str, Any] = {"lobe": {"choices": tuple(LOBES)}, "scene": {"text": _SCENE_FILE}}
    against = {"choices": tuple(LOBES), "default": "exact"}
    common.add_options(explore, _OPTIONS, **common.SCENE_CHANGES, **changes, against=against)


_SCENE_FILE = "scene file with camera, lights, material and the shading B"
_OPTIONS = f"""
-o --output OUT.html | output file, which ends in .html or .htm
    | the mesh's name with .html {common.NEW_FILE}
mesh
{common.SCENE}
[reflectance]
--lobe | lobe of shading B | the scene file's, otherwise {_LOBE}
--against | lobe of shading A, against which the page measures B | exact
[options]
anonymous id quiet verbose
"""


def run(options: argparse.Namespace) -> int:
    if options.output and Path(options.output).suffix.lower() not in (".html", ".htm"):
        output = options.output
        raise InputError(f"{output}: the explorer is an HTML page; give a name that ends in .html")
    job, cameras = job_of(options, None)
    output = options.output or f"{job.stem}.html"
    if len(cameras) > 1:
        raise InputError(f"the explorer opens with one camera, and there are {len(cameras)}")
    common.check_outputs([output], files_read(options, job), None if options.output else output)
    b = job.shading.term
    if options.lobe is None and options.scene is None:
        b = replace(b, lobe=_LOBE)
    # A constant m belongs to a plan of B; the exact lobe of A has no limits of m.
    a = replace(b, lobe=options.against, m=None, small_slope=None)
    with common.progress_bar(options) as progress:
        progress("mesh", 0.0)
        # The page applies these factors itself, so that its controls can remove them.
        factors = job.material.items()
        material = {name: factor for name, factor in factors if name not in TERM_FACTORS}
        mesh = replace(job, material=material).scene().labelled.mesh
        progress("page", 0.0)
        page = explorer_page(job, mesh, a, b, plays(options, job.pose))
    write_text(output, page)
    print_result(output)
    return 0
