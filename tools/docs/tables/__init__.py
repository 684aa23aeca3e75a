"""Tables of the documents, a module for each data set: ``blocks()`` returns Markdown by name.

Measured data come from docs/measurements; commands in benchmarks and tests/verification write them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Formatter
from typing import Any

MEASUREMENTS = Path(__file__).parents[3] / "docs" / "measurements"

Columns = Sequence[tuple[str, str]]
"""Heads of a table, and the formats of a record's values below them."""


class _Formatter(Formatter):
    """``str.format`` with further formats: a "%" at the end writes a percentage and a spaced sign,
    "digits" three significant digits, or all before the point; None is an empty cell."""

    def format_field(self, value: Any, spec: str) -> str:
        if value is None:
            return ""
        if spec == "digits":
            return f"{value:.0f}" if value == 0.0 or abs(value) >= 100.0 else f"{value:#.3g}"
        if spec.endswith("%"):
            return f"{100.0 * value:{spec[:-1]}} %"
        return str(super().format_field(value, spec))


_FORMATTER = _Formatter()


def load(name: str) -> dict[str, Any]:
    """Return what docs/measurements/NAME.json holds."""
    data: dict[str, Any] = json.loads((MEASUREMENTS / f"{name}.json").read_text(encoding="utf-8"))
    return data


def markdown_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()
) -> str:
    """Return a table in Markdown; marks align its columns, to the left by default."""
    lines = (head, marks or ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def row(formats: Iterable[str], record: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row: formats with the values of a record."""
    return [_FORMATTER.format(form, **record) for form in formats]


def table(columns: Columns, records: Iterable[Mapping[str, Any]]) -> str:
    """Return a table in Markdown, a row for each record."""
    heads, formats = zip(*columns, strict=True)
    return markdown_table(heads, [row(formats, record) for record in records])


def with_median(
    records: Sequence[Mapping[str, Any]], median: Mapping[str, float]
) -> Iterator[Mapping[str, Any]]:
    """Yield records, and a last one of medians under the name "median"."""
    yield from records
    name, *others = records[0]
    yield {name: "median", **dict.fromkeys(others), **median}


def machine(data: Mapping[str, Any]) -> str:
    """Return the OpenGL driver that a data set was measured with."""
    return "{GL_RENDERER}, OpenGL {GL_VERSION}".format(**data["environment"])
