"""Writes the generated documents, all or those named; with --check, tells which are not current.

python -m tools.docs [--check] [NAME ...]      from the repository's root

What is cheap to generate, and the same on every machine, is compared as a whole; of the rest, the
words that no measurement fills in and the heads of the tables.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

GENERATED = (
    *("accuracy", "comparison", "explorer", "figures", "frame", "levels", "plan", "reproduction"),
    *("scale", "shaders", "skin", "skin_environment", "skin_scattering", "skin_shadows"),
    *("skin_together", "targets", "trade"),
)
PICTURES = ("explorer", "figures")  # of which there is nothing to compare


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs", description=__doc__.split("\n")[0]
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(GENERATED)}")
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args()
    if unknown := set(given.names).difference(GENERATED):
        parser.error(f"no document {', '.join(unknown)}; there are {', '.join(GENERATED)}")
    found = 0
    for name in given.names or GENERATED:
        document = import_module(f"tools.docs.{name}")
        if not given.check:
            document.main()
            continue
        for fault in document.stale() if name not in PICTURES else ():
            found = 1
            print(
                f"docs/{name.replace('_', '-')}.md: {fault}: run python -m tools.docs.{name}",
                file=sys.stderr,
            )
    return found


if __name__ == "__main__":
    sys.exit(main())
