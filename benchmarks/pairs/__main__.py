"""Render the missing pairs of the suite of image pairs into a folder.

python -m benchmarks.pairs OUT [--scenes NAME ...] [--changes NAME ...] [--drawn FOLDER]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from benchmarks.pairs.suite import SUITE, draw_suite
from tests.verification.pairs.scenes import SETTINGS


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pairs", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=SETTINGS, default=[*SETTINGS])
    parser.add_argument("--changes", nargs="+", choices=SUITE, default=[*SUITE])
    parser.add_argument("--drawn", type=Path, help="images of benchmarks.pairs.unchanged")
    given = parser.parse_args()
    os.environ.setdefault("LP_NUM_THREADS", "1")
    for scene in draw_suite(given.out, given.scenes, given.changes, given.drawn):
        print(scene, flush=True)


if __name__ == "__main__":
    main()
