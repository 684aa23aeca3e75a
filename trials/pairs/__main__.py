"""Draws the suite of image pairs.

python -m trials.pairs OUT [--scenes NAME,...] [--changes NAME,...] [--workers N]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from trials.pairs.changes import CHANGES
from trials.pairs.draw import draw_suite
from trials.pairs.scenes import SETTINGS


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m trials.pairs", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", default=",".join(SETTINGS), help=", ".join(SETTINGS))
    parser.add_argument("--changes", default=",".join(CHANGES), help="names with commas between")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    os.environ.setdefault("LP_NUM_THREADS", "1")
    names = given.scenes.split(","), given.changes.split(",")
    for scene in draw_suite(given.out, *names, given.workers):
        print(scene, flush=True)


if __name__ == "__main__":
    main()
