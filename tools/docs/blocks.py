"""Marked blocks of Markdown pages: the generated parts of a page.

A block begins with a mark that contains the command to fill it, and ends with an end mark. Both
marks are on separate lines, or within a sentence:

    <!-- python -m tools.docs levels.head-1024 -->
    | triangles | > 1/255 | ...
    <!-- end -->

``levels.head-1024`` is the item "head-1024" of ``blocks()`` in ``tools/docs/tables/levels.py``.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

_MARK = r"<!-- python -m tools\.docs (?P<name>[\w-]+\.[\w.-]+) -->"
_BLOCK = re.compile(rf"(?P<mark>{_MARK}\n?)(?P<text>.*?)\n?<!-- end -->", re.DOTALL)


class BlockError(Exception):
    """A mark without an end mark, or with an unknown block name."""


def pages(root: Path) -> list[Path]:
    """Return the Markdown pages of a repository that may contain blocks."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


@cache
def blocks_of(module: str) -> Mapping[str, str]:
    """Return the blocks of ``tools/docs/tables/MODULE.py`` by name, without a final newline."""
    if find_spec(f"tools.docs.tables.{module}") is None:
        raise BlockError(f"no module {module} in tools/docs/tables")
    blocks: Mapping[str, str] = import_module(f"tools.docs.tables.{module}").blocks()
    return blocks


def found(page: str) -> Iterator[re.Match[str]]:
    """Yield a match for each block of a page, with the groups mark, name and text.

    Raises
    ------
    BlockError : a mark has no end mark
    """
    end = 0
    for match in _BLOCK.finditer(page):
        if re.search(_MARK, match["text"]):
            raise BlockError(f"{match['name']} has no <!-- end -->")
        yield match
        end = match.end()
    if rest := re.search(_MARK, page[end:]):
        raise BlockError(f"{rest['name']} has no <!-- end -->")


def by_hand(page: str) -> str:
    """Return a page without its blocks."""
    return _BLOCK.sub("", page)


def fill(page: str, names: Collection[str] = ()) -> str:
    """Return a page with its blocks filled.

    Parameters
    ----------
    names : modules and blocks to fill; empty for all

    Raises
    ------
    BlockError : a mark has no end mark, or an unknown block name
    """
    parts, at = [], 0
    for match in found(page):
        module, _, block = match["name"].partition(".")
        if names and not {module, match["name"]}.intersection(names):
            continue
        text = blocks_of(module).get(block)
        if text is None:
            raise BlockError(f"no block {match['name']}; there are {', '.join(blocks_of(module))}")
        line = "\n" if match["mark"].endswith("\n") else ""
        parts += [page[at : match.start()], match["mark"], text, line, "<!-- end -->"]
        at = match.end()
    return "".join([*parts, page[at:]])


def stale(page: str, names: Collection[str] = ()) -> list[str]:
    """Return the names of the blocks whose text differs from their data; parameters and errors as
    of :func:`fill`."""
    pairs = zip(found(page), found(fill(page, names)), strict=True)
    return [old["name"] for old, new in pairs if old.group() != new.group()]
