"""``facerender reproduce``."""

from __future__ import annotations

import argparse

from facerender.commands.common import add_verbose, make_folder, steps
from facerender.commands.streams import tell


def add(reproduce: argparse.ArgumentParser) -> None:
    reproduce.set_defaults(command=run)
    reproduce.add_argument(
        "-o", "--output", default="out/reproduction", metavar="DIR", help="(out/reproduction)"
    )
    add_verbose(reproduce)


def run(options: argparse.Namespace) -> int:
    from facerender.measure import plots
    from facerender.measure.reproduce import reproduce

    plots.check()
    folder = make_folder(options.output)
    with steps(options) as progress:
        result = reproduce(progress=progress)
        progress("report", 0.0)
        paths = result.write(folder)
    tell(*paths)
    return 0
