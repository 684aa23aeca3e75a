"""``facerender reproduce``."""

from __future__ import annotations

import argparse
import sys

from facerender.commands.common import clean_up_on_interrupt, make_folder


def add(reproduce: argparse.ArgumentParser) -> None:
    reproduce.set_defaults(command=run)
    reproduce.add_argument(
        "-o", "--output", default="out/reproduction", metavar="DIR", help="(out/reproduction)"
    )


def run(options: argparse.Namespace) -> int:
    from facerender.measure import plots
    from facerender.measure.reproduce import reproduce

    plots.check()
    folder = make_folder(options.output)
    result = reproduce(progress=lambda step: print(f"facerender: {step}", file=sys.stderr))
    clean_up_on_interrupt()
    for path in result.write(folder):
        print(path)
    return 0
