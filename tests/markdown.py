"""Splits Markdown into prose and fenced code, for the tests of documents."""

from __future__ import annotations

import re

_FENCE = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def prose(page: str) -> str:
    """Return a page without its fenced code."""
    return _FENCE.sub("", page)


def blocks(page: str) -> list[tuple[str, str, str]]:
    """Return each block of fenced code: the last line before the block, language and code."""
    found = []
    for match in _FENCE.finditer(page):
        before = page[: match.start()].rstrip().rpartition("\n")[2]
        found.append((before, match[1], match[2]))
    return found


def code(page: str, language: str) -> list[str]:
    """Return the fenced code of a page in one language; "" is code without a language."""
    return [text for each, text in _FENCE.findall(page) if each == language]
