"""What a generated document says whatever was measured: the words of its template, and the heads of
its tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from facerender.measure.tables import markdown_table


def missing(path: Path, template: str, heads: Sequence[Sequence[str]] = ()) -> Iterator[str]:
    """Yield the lines of a template that hold no field, and the heads, that a document lacks."""
    lines = set(path.read_text(encoding="utf-8").splitlines())
    words = [line for line in template.splitlines() if "{" not in line]
    tables = [markdown_table(head, []).splitlines()[0] for head in heads]
    yield from (f"no line {line!r}" for line in [*words, *tables] if line not in lines)
