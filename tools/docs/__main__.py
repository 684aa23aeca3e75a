"""Fill the marked blocks of the README and of the pages in docs from their data.

python -m tools.docs [--check] [NAME ...]      from the repository's root; seconds

NAME is a module of tools/docs/tables, or one of its blocks: levels, levels.head-1024. The default
is all blocks. Each page names the command that measures its data.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tools.docs.blocks import BlockError, fill, pages, stale

ROOT = Path(__file__).parents[2]


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Fill or check the blocks; return the exit status, 1 if a block is stale or invalid."""
    summary, *_ = (__doc__ or "").split("\n")
    parser = argparse.ArgumentParser(prog="python -m tools.docs", description=summary)
    parser.add_argument("names", nargs="*", metavar="NAME", help="module or block (all)")
    parser.add_argument("--check", action="store_true", help="only list stale blocks (off)")
    options = parser.parse_args(arguments)
    errors = []
    for path in pages(root):
        page, name = path.read_text(encoding="utf-8"), path.relative_to(root)
        try:
            if options.check:
                errors += [
                    f"{name}: {block} is stale: run python -m tools.docs {block}"
                    for block in stale(page, options.names)
                ]
            elif (filled := fill(page, options.names)) != page:
                path.write_text(filled, encoding="utf-8")
        except BlockError as error:
            errors.append(f"{name}: {error}")
    print("".join(f"{error}\n" for error in errors), end="", file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
