"""Writes Parquet tables of records: one column per value; nested values get dotted names."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from facerender.errors import InputError

_ROWS = 4096  # rows in memory at a time
_NUMBERS = {"int", "float"}


def check_parquet() -> None:
    """Raise InputError if pyarrow is missing."""
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise InputError(
            "jobs.parquet needs pyarrow: pip install 'facerender[batch]', or use --table jsonl"
        ) from None


def write_parquet(lines: Path, target: Path) -> None:
    """Convert a file of records, one JSON object per line, to a Parquet file.

    A column with lists of tables, or with values of different kinds, contains JSON text; a column
    with integers and floats contains floats.
    """
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    number, text = pa.float64(), pa.string()
    types = {
        "bool": pa.bool_(),
        "int": pa.int64(),
        "float": number,
        "text": text,
        "json": text,
        "vector": pa.list_(number),
        "matrix": pa.list_(pa.list_(number)),
    }
    kinds = _kinds(lines)
    schema = pa.schema([(name, types[kind]) for name, kind in kinds.items()])
    rows = _rows(lines)
    with ParquetWriter(target, schema) as writer:
        while block := [*islice(rows, _ROWS)]:
            for row in block:
                row |= {name: json.dumps(row[name]) for name in row if kinds[name] == "json"}
            columns = [[row.get(name) for row in block] for name in kinds]
            writer.write_table(pa.table(columns, schema))


def _rows(lines: Path) -> Iterator[dict[str, Any]]:
    with lines.open() as file:
        for line in file:
            yield dict(_flat(json.loads(line), ""))


def _flat(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif value is not None:
            yield f"{prefix}{key}", value


def _kinds(lines: Path) -> dict[str, str]:
    """Return the kind of the values in each column, keyed by the column's name."""
    kinds: dict[str, str] = {}
    for row in _rows(lines):
        for name, value in row.items():
            kind = _kind(value)
            column_kind = kinds.setdefault(name, kind)
            if column_kind != kind:
                kinds[name] = "float" if {column_kind, kind} == _NUMBERS else "json"
    return kinds


def _kind(value: Any) -> str:
    if isinstance(value, list):
        inner = {_kind(element) for element in value}
        if inner <= _NUMBERS:
            return "vector"
        return "matrix" if inner == {"vector"} else "json"
    return {bool: "bool", int: "int", float: "float", str: "text"}.get(type(value), "json")
