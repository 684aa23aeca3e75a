"""Fill the marked blocks of the README and of the pages in docs from their data.

python -m tools.docs [--check] [NAME ...]      from the repository's root; seconds

NAME is a module of tools/docs/tables, or one block of it: levels, levels.head-1024. Without names,
all blocks. What measures the data stands in each page.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tools.docs.blocks import BlockError, fill, pages, stale

ROOT = Path(__file__).parents[2]


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Fill or check the blocks, and return the exit status: 1 if one is stale or has a fault."""
    summary, *_ = (__doc__ or "").split("\n")
    parser = argparse.ArgumentParser(prog="python -m tools.docs", description=summary)
    parser.add_argument("names", nargs="*", metavar="NAME", help="a module or a block (all)")
    parser.add_argument("--check", action="store_true", help="write nothing; name stale blocks")
    options = parser.parse_args(arguments)
    faults = []
    for path in pages(root):
        page, name = path.read_text(encoding="utf-8"), path.relative_to(root)
        try:
            if options.check:
                faults += [
                    f"{name}: {block} is stale: run python -m tools.docs {block}"
                    for block in stale(page, options.names)
                ]
            elif (filled := fill(page, options.names)) != page:
                path.write_text(filled, encoding="utf-8")
        except BlockError as error:
            faults.append(f"{name}: {error}")
    print("".join(f"{fault}\n" for fault in faults), end="", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
