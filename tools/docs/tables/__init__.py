"""Tables of the documents, one module per data set: ``blocks()`` returns Markdown by name.

The commands in ``benchmarks`` write the data, the JSON files in docs/measurements.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Formatter
from typing import Any

MEASUREMENTS = Path(__file__).parents[3] / "docs" / "measurements"

Columns = Sequence[tuple[str, str]]
"""Column headings of a table, each with the format of a record's cell."""


class _Formatter(Formatter):
    """A ``str.format`` with additional formats.

    A final "%" writes a percentage with a space before the sign. "digits" writes three significant
    digits, or all digits before the point. None is an empty cell.
    """

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
    """Return the content of docs/measurements/NAME.json."""
    data: dict[str, Any] = json.loads((MEASUREMENTS / f"{name}.json").read_text(encoding="utf-8"))
    return data


def markdown_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()
) -> str:
    """Return a Markdown table.

    marks : alignment of each column, such as ``---:``; default: left
    """
    lines = (head, marks or ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def row(formats: Iterable[str], record: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row: each format, filled with the values of a record."""
    return [_FORMATTER.format(form, **record) for form in formats]


def table(columns: Columns, records: Iterable[Mapping[str, Any]]) -> str:
    """Return a Markdown table with one row per record."""
    heads, formats = zip(*columns, strict=True)
    return markdown_table(heads, [row(formats, record) for record in records])


def with_median(
    records: Sequence[Mapping[str, Any]], median: Mapping[str, float]
) -> Iterator[Mapping[str, Any]]:
    """Yield the records, then a record with the medians, named "median"."""
    yield from records
    name, *others = records[0]
    yield {name: "median", **dict.fromkeys(others), **median}


def published(text: str) -> str:
    """Return a text of a data set in the words of the pages: "published" for "printed"."""
    return text.replace("printed", "published")


def machine(data: Mapping[str, Any]) -> str:
    """Return name and version of the OpenGL driver that drew a data set."""
    return "{GL_RENDERER}, OpenGL {GL_VERSION}".format(**data["environment"])
