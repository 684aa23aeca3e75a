"""Prices of shading from compilers and from measurements. Run in the root of the repository:

    python -m benchmarks.prices table   write facerender/pricing/prices.json, in a few minutes
    python -m benchmarks.prices parts   print the cost of each part of the fragment program
    python -m benchmarks.prices amd docs/measurements/amd.json           write AMD's estimates
    python -m benchmarks.prices offline docs/measurements/offline.json   write instruction counts

amd.py and offline.py list the packages that they need.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.prices import amd, offline, table
from facerender.errors import FacerenderError
from facerender.pricing import table as fragment


def print_parts() -> None:
    """Print the cost of each part of the fragment program, or the name of a missing tool."""
    measures: dict[str, Callable[[], Mapping[str, float]]] = {
        **{f"{family}, cycles": partial(table.parts, family) for family in amd.FAMILIES},
        "here, ns": lambda: {name: each.value for name, each in fragment.by_slope().items()},
    }
    for title, measure in measures.items():
        print(title)
        try:
            for name, value in measure().items():
                print(f"  {name:<24}{value:8.2f}")
        except FacerenderError as error:
            print(f"  not measured: {error}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0, or 2 if a requirement is missing."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.prices",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("table", "parts"):
        commands.add_parser(name)
    for name in ("amd", "offline"):
        commands.add_parser(name).add_argument("output", type=Path, metavar="OUT.json")
    options = parser.parse_args(arguments)
    try:
        if options.command == "table":
            table.write()
        elif options.command == "parts":
            print_parts()
        else:
            tables = {"amd": amd.table, "offline": offline.table}
            text = json.dumps(tables[options.command](), indent=2)
            options.output.write_text(text + "\n", encoding="utf-8")
    except FacerenderError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
