"""Readers of tables of jobs (.jsonl, .csv, .parquet, .toml and .py), whose rows are read one at a
time, and a writer of records as Parquet."""

from __future__ import annotations

import csv
import importlib
import json
import os
import re
import runpy
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from typing import Any

from facerender.batch.tables import Table, grid_rows, nested
from facerender.errors import FacerenderError, InputError, clipped, reason, shown
from facerender.scene.job import MESH_PATHS
from facerender.system.files import check_suffix, read_file, tables_of

# The number of the line where a row ends (None for .parquet, .toml and .py), and the row or its
# error.
Found = tuple[int | None, Table | InputError]

_LONGEST_LINE = 2**20
_NUMBER = re.compile(r"[+-]?([0-9]+|[0-9]+\.[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_WORDS = {"true": True, "false": False, "null": None}
_TEXT = {  # Columns of a .csv file with text in each cell, even if the cell looks like a number.
    *("id", "outputs", "scene", "mesh", "mesh.parts", "mesh.hide", "environment"),
    *("environment.file", *(f"mesh.{name}" for name in MESH_PATHS)),
}


def found_rows(path: str | os.PathLike[str]) -> Iterator[Found]:
    """Yield the rows of a table as :func:`nested` returns them; the suffix determines the format.
    Raise InputError if the file or a part of it cannot be read."""
    file = Path(path)
    try:
        mode = file.stat().st_mode
        if S_ISDIR(mode) and file.suffix.lower() not in _FORMATS:
            raise InputError(f"{file} is a directory; give a job table")
        read = _FORMATS[check_suffix(file, (*_FORMATS,), "table")]
        if not (S_ISREG(mode) or S_ISDIR(mode)):
            raise InputError(f"{file} is not a regular file; give a table")
        yield from read(file)
    except OSError as error:
        raise InputError(f"cannot read {file}: {reason(error)}; give a job table") from None


def _nested(row: Any) -> Table | InputError:
    try:
        return nested(row)
    except InputError as error:
        return error


def _lines(path: Path) -> Generator[str, None, None]:
    """Yield the lines of a text file in UTF-8, of at most _LONGEST_LINE bytes each."""
    with path.open("rb") as file:
        lines = iter(lambda: file.readline(_LONGEST_LINE + 1), b"")
        for number, line in enumerate(lines, 1):
            if len(line) > _LONGEST_LINE:
                raise InputError(
                    f"{path.name}, line {number} has more than {_LONGEST_LINE} bytes: give one "
                    "row per line"
                )
            try:
                yield line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise InputError(
                    f"{path.name}, line {number} is not UTF-8 ({error.reason}): save the file as "
                    "UTF-8"
                ) from None


def _jsonl(path: Path) -> Iterator[Found]:
    for number, line in enumerate(_lines(path), 1):
        if line.strip():
            try:
                row = _JSON.decode(line.strip())
            except (ValueError, RecursionError) as error:
                yield number, InputError(f"not JSON: {_why(error)}; give one object per line")
            else:
                yield number, _nested(row)


def _why(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"{error.msg} at column {error.colno}"
    return "nested too deep" if isinstance(error, RecursionError) else str(error)


def _object(pairs: list[tuple[str, Any]]) -> Table:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError(f"key {shown(_twice([key for key, _ in pairs]))} is given twice")
    return table


def _twice(names: Sequence[str]) -> str:
    """Return the first name that occurs more than once."""
    counts = Counter(names)
    return next(name for name in names if counts[name] > 1)


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not a finite number")


_JSON = json.JSONDecoder(object_pairs_hook=_object, parse_constant=_no_constant)


def _csv(path: Path) -> Iterator[Found]:
    with closing(_lines(path)) as lines:
        reader = csv.reader(lines, strict=True)
        rows = ([cell.strip() for cell in cells] for cells in reader)
        try:
            names = next(filter(any, rows), [])
            _check_columns(path, names)
            readers = [
                str if name in _TEXT or name.startswith("meta.") else _cell for name in names
            ]
            for cells in filter(any, rows):
                yield reader.line_num, _csv_row(names, readers, cells)
        except csv.Error as error:
            raise InputError(f"{path.name}, line {reader.line_num} is not CSV: {error}") from None


def _csv_row(
    names: list[str], readers: Sequence[Callable[[str], Any]], cells: list[str]
) -> Table | InputError:
    if len(cells) != len(names):
        return InputError(
            f"{len(cells)} cells in a table of {len(names)} columns: give one cell per column, and "
            "quote cells with commas"
        )
    try:
        columns = zip(names, readers, cells, strict=True)
        return _nested({name: read(cell) for name, read, cell in columns if cell})
    except (ValueError, RecursionError) as error:
        return InputError(f"a cell cannot be read: {_why(error)}")


def _check_columns(path: Path, names: list[str]) -> None:
    if "" in names:
        raise InputError(f"{path.name}: a column has no name; name it in the first line")
    if len(set(names)) < len(names):
        raise InputError(f"{path.name} has two columns {shown(_twice(names))}: leave one out")


def _cell(text: str) -> Any:
    if match := _NUMBER.fullmatch(text):
        return int(text) if match[1].isdecimal() and not match[2] else float(text)
    if text[:1] in ("[", "{", '"'):
        return _JSON.decode(text)
    return _WORDS.get(text.lower(), text)


def _parquet(path: Path) -> Iterator[Found]:
    try:
        parquet = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError(
            f"{path.name} needs the package pyarrow; pip install 'facerender[batch]'"
        ) from None
    with path.open("rb") as file:
        try:
            table = parquet.ParquetFile(file)
            _check_columns(path, table.schema_arrow.names)
            for batch in table.iter_batches(4096):
                for row in batch.to_pylist():
                    yield None, _nested(row)
        except (ValueError, ArithmeticError, NotImplementedError, OSError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{path.name} is not a readable Parquet file: {clipped(str(error))}"
            ) from None


def read_toml(path: Path) -> Table:
    """Read the tables of a TOML file; raise InputError if it cannot be read, or is not TOML."""
    return tables_of(read_file(path, "tables as TOML", 2**26), path.name)


def _toml(path: Path) -> Iterator[Found]:
    if not (tables := read_toml(path)):
        return
    try:
        for row in grid_rows(tables):
            yield None, row
    except (InputError, RecursionError) as error:
        raise InputError(f"{path.name}: {_why(error)}") from None


def _py(path: Path) -> Iterator[Found]:
    path.open("rb").close()  # Raises OSError here if the file cannot be read.
    try:
        jobs = runpy.run_path(str(path), run_name="facerender_jobs").get("jobs")
        for row in jobs() if callable(jobs) else ():
            yield None, _nested(row)
    except (Exception, SystemExit) as error:
        raise InputError(_where(path, error)) from None
    if not callable(jobs):
        raise InputError(f"{path.name} has no function jobs(): write one that yields rows")


def _where(path: Path, error: BaseException) -> str:
    """Describe an error in a .py table in one line of text, with the line number in that file."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines.append(error.lineno)
    line = f", line {lines[-1]}" if lines else ""
    kind = "" if isinstance(error, FacerenderError) else f"{type(error).__name__}: "
    return f"{path.name}{line}: {kind}{clipped(str(error))}"


_FORMATS: dict[str, Callable[[Path], Iterator[Found]]] = {
    ".jsonl": _jsonl,
    ".csv": _csv,
    ".parquet": _parquet,
    ".toml": _toml,
    ".py": _py,
}


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
