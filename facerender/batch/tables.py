"""Tables of jobs: reads the rows of a file (.jsonl, .csv, .parquet, .toml or .py) one at a time, as
nested plain data, and generates rows from grids and random values. ``jobs.py`` makes jobs from the
rows. This module also reads records as JSON lines, and writes them as Parquet."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import re
import runpy
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal, DecimalException
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from facerender.errors import FacerenderError, InputError, clipped, quoted, reason
from facerender.loading import MESH_PATHS
from facerender.scene.camera import STANDARD_ANGLES, Camera
from facerender.scene.environment import EnvironmentFile
from facerender.scene.light import RIGS, Light
from facerender.scene.scene import default_lights
from facerender.system.files import read_file, suffix_of, tables_of
from facerender.system.process import optional
from facerender.values.fields import Table, build, has_numbers, merged, plain, ungrouped

# The number of the line where a row ends (None for .parquet, .toml and .py), and a function that
# returns the row as `nested` does. It raises InputError for this row only: further rows follow.
Unparsed = tuple[int | None, Callable[[], Table]]

# In bytes. A large file without line ends is thus refused before it fills the memory.
_LONGEST_LINE = 2**20
_NUMBER = re.compile(r"[+-]?([0-9]+|[0-9]+\.[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_WORDS = {"true": True, "false": False, "null": None}
_TEXT = {  # Columns of a .csv file with text in each cell, even if the cell looks like a number.
    *("id", "outputs", "scene", "mesh", "mesh.parts", "mesh.hide", "environment"),
    *("environment.file", *(f"mesh.{name}" for name in MESH_PATHS)),
}


def read_rows(path: str | os.PathLike[str]) -> Iterator[Unparsed]:
    """Yield the rows of a table; the suffix determines the format. Raise InputError if the file or
    a part of it cannot be read."""
    file = Path(path)
    read = _FORMATS[suffix_of(file, (*_FORMATS,), "table", "a job table", sys.maxsize)]
    try:
        yield from read(file)
    except OSError as error:
        raise InputError(f"cannot read {file}: {reason(error)}; give a job table") from None


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file in UTF-8, of at most _LONGEST_LINE bytes each."""
    with path.open("rb") as file:
        lines = iter(lambda: file.readline(_LONGEST_LINE + 1), b"")
        for number, line in enumerate(lines, 1):
            if len(line) > _LONGEST_LINE:
                problem = f"line {number} has more than {_LONGEST_LINE} bytes"
                raise InputError(f"{path.name}, {problem}: give one row per line")
            try:
                yield line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                problem = f"line {number} is not UTF-8 ({error.reason})"
                raise InputError(f"{path.name}, {problem}: save the file as UTF-8") from None


def _jsonl(path: Path) -> Iterator[Unparsed]:
    for number, line in enumerate(_lines(path), 1):
        if line.strip():
            yield number, partial(_json_row, line.strip())


def _json_row(text: str) -> Table:
    try:
        row = _JSON.decode(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {_why(error)}; give one object per line") from None
    return nested(row)


def _why(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"{error.msg} at column {error.colno}"
    return "nested too deep" if isinstance(error, RecursionError) else str(error)


def _object(pairs: list[tuple[str, Any]]) -> Table:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError(f"key {quoted(repeated([key for key, _ in pairs]))} is given twice")
    return table


_JSON = json.JSONDecoder(object_pairs_hook=_object)


def _csv(path: Path) -> Iterator[Unparsed]:
    reader = csv.reader(_lines(path), strict=True)
    rows = ([cell.strip() for cell in cells] for cells in reader)
    try:
        names = next(filter(any, rows), [])
        _check_columns(path, names)
        for cells in filter(any, rows):
            yield reader.line_num, partial(_csv_row, names, cells)
    except csv.Error as error:
        raise InputError(f"{path.name}, line {reader.line_num} is not CSV: {error}") from None


def _csv_row(names: list[str], cells: list[str]) -> Table:
    if len(cells) != len(names):
        remedy = "give one cell per column, and quote cells with commas"
        raise InputError(f"{len(cells)} cells in a table of {len(names)} columns: {remedy}")
    columns = zip(names, cells, strict=True)
    try:
        row = {name: _cell(name, cell) for name, cell in columns if cell}
    except (ValueError, RecursionError) as error:
        raise InputError(f"a cell cannot be read: {_why(error)}") from None
    return nested(row)


def _check_columns(path: Path, names: list[str]) -> None:
    if "" in names:
        raise InputError(f"{path.name}: a column has no name; name it in the first line")
    if (name := repeated(names)) is not None:
        raise InputError(f"{path.name} has two columns {quoted(name)}: leave one out")


def _cell(name: str, text: str) -> Any:
    if name in _TEXT or name.startswith("meta."):
        return text
    if match := _NUMBER.fullmatch(text):
        return int(text) if match[1].isdecimal() and not match[2] else float(text)
    # Cells have lists, tables and quoted text as JSON; any other text needs no quotes.
    if text[:1] in ("[", "{", '"'):
        return _JSON.decode(text)
    return _WORDS.get(text.lower(), text)


def _parquet(path: Path) -> Iterator[Unparsed]:
    need = f"{path.name} needs the package pyarrow"
    parquet = optional("pyarrow.parquet", f"{need}; pip install 'facerender[batch]'")
    with path.open("rb") as file:
        try:
            table = parquet.ParquetFile(file)
            _check_columns(path, table.schema_arrow.names)
            for batch in table.iter_batches(4096):
                for row in batch.to_pylist():
                    yield None, partial(nested, row)
        except InputError:
            raise
        except (ValueError, ArithmeticError, NotImplementedError, OSError) as error:
            why = clipped(str(error))
            raise InputError(f"{path.name} is not a readable Parquet file: {why}") from None


def read_toml(path: Path) -> Table:
    """Read the tables of a TOML file; raise InputError if it cannot be read, or is not TOML."""
    return tables_of(read_file(path, "tables as TOML", 2**26), path.name)


def _toml(path: Path) -> Iterator[Unparsed]:
    tables = read_toml(path)
    try:
        for row in grid_rows(tables) if tables else ():
            yield None, partial(dict, row)
    except (InputError, RecursionError) as error:
        raise InputError(f"{path.name}: {_why(error)}") from None


def _py(path: Path) -> Iterator[Unparsed]:
    path.open("rb").close()  # Raises OSError here if the file cannot be read.
    try:
        jobs = runpy.run_path(str(path), run_name="facerender_jobs").get("jobs")
        for row in jobs() if callable(jobs) else ():
            yield None, partial(nested, row)
    # The file is a program, which may raise any exception or call sys.exit.
    except (Exception, SystemExit) as error:
        raise InputError(_where(path, error)) from None
    if not callable(jobs):
        raise InputError(f"{path.name} has no function jobs(): write one that yields rows")


def _where(path: Path, error: BaseException) -> str:
    """Describe an error in a .py table in one line of text, with the line number in that file."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines.append(error.lineno)
    line = f", line {lines[-1]}" if lines else ""
    error_type = "" if isinstance(error, FacerenderError) else f"{type(error).__name__}: "
    return f"{path.name}{line}: {error_type}{clipped(str(error))}"


_FORMATS: dict[str, Callable[[Path], Iterator[Unparsed]]] = {
    ".jsonl": _jsonl,
    ".csv": _csv,
    ".parquet": _parquet,
    ".toml": _toml,
    ".py": _py,
}


def json_lines(path: Path) -> Iterator[Any]:
    """Yield the values of a file with one JSON value per line."""
    with path.open() as file:
        yield from map(json.loads, file)


_ROWS = 4096  # rows in memory at a time
_NUMBERS = {"int", "float"}


def check_parquet() -> None:
    """Raise InputError if pyarrow is missing."""
    remedy = "pip install 'facerender[batch]', or use --table jsonl"
    optional("pyarrow", f"jobs.parquet needs pyarrow: {remedy}")


def write_parquet(lines: Path, target: Path) -> None:
    """Convert records, one JSON object per line, to Parquet. A column with lists of tables, or with
    values of different types, contains JSON text; a column with integers and floats, floats."""
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    number, text = pa.float64(), pa.string()
    types = {"bool": pa.bool_(), "int": pa.int64(), "float": number, "text": text, "json": text}
    types |= {"vector": pa.list_(number), "matrix": pa.list_(pa.list_(number))}
    columns = _columns(lines)
    schema = pa.schema([(name, types[column_type]) for name, column_type in columns.items()])
    rows = (dict(_flat(record, "")) for record in json_lines(lines))
    with ParquetWriter(target, schema) as writer:
        while block := [*islice(rows, _ROWS)]:
            for row in block:
                row |= {name: json.dumps(row[name]) for name in row if columns[name] == "json"}
            values = [[row.get(name) for row in block] for name in columns]
            writer.write_table(pa.table(values, schema))


def _flat(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif value is not None:
            yield f"{prefix}{key}", value


def _columns(lines: Path) -> dict[str, str]:
    """Return the type of the values in each column, keyed by the column's name."""
    columns: dict[str, str] = {}
    for record in json_lines(lines):
        for name, value in _flat(record, ""):
            value_type = _type_of(value)
            column_type = columns.setdefault(name, value_type)
            if column_type != value_type:
                columns[name] = "float" if {column_type, value_type} == _NUMBERS else "json"
    return columns


def _type_of(value: Any) -> str:
    if isinstance(value, list):
        inner = {_type_of(element) for element in value}
        if inner <= _NUMBERS:
            return "vector"
        return "matrix" if inner == {"vector"} else "json"
    return {bool: "bool", int: "int", float: "float", str: "text"}.get(type(value), "json")


_DEEPEST = 10  # levels of nested tables and lists
# Tables whose keys are names in a mesh file, which may contain dots, or only digits.
NAMED = ("parts", "pose.weights", "pose.joints", "before.weights", "before.joints")
# Records that a text stands for, keyed as in a job. The table of the text has only the fields that
# the text names, so that a row may change single fields of the common tables.
_PARSED: dict[str, Any] = {"camera": Camera, "environment": EnvironmentFile}
_MAX_BITS = 64  # largest size of a whole number, in bits


def nested(row: Any) -> Table:
    """Return a row as nested tables of plain data; raise InputError if it has other data.

    Dotted keys become nested tables, and None values are removed. A mesh, an environment, a camera
    or a light that is given as text becomes a table. Numbered items (``lights.0.azimuth``) stay
    tables with numbers as keys until :func:`listed` converts them.
    """
    if type(row) is not dict and not isinstance(row, Mapping):
        raise InputError(f"row = {quoted(row)}: give a table")
    values: Table = {}
    for key, value in row.items():
        if key == "mesh" and isinstance(value, str | os.PathLike):
            key = "mesh.path"
        elif key in _PARSED and isinstance(value, str):
            parts = _PARSED[key].parse(value)
            values |= {f"{key}.{name}": part for name, part in parts.items()}
            continue
        if key in values:
            raise InputError(f"{key} is given twice: leave one out")
        values[key] = value
    tables: Table = _plain(values, "", 0)
    lights = tables.get("lights")
    if type(lights) is dict:
        tables["lights"] = {key: _light(light) for key, light in lights.items()}
    elif isinstance(lights, str | list):
        several = [lights] if isinstance(lights, str) else lights
        tables["lights"] = [_light(light) for light in ungrouped(several, RIGS)]
    return tables


def repeated(names: Sequence[str]) -> str | None:
    """Return the first name that occurs more than once, if any."""
    counts = Counter(names)
    return next((name for name in names if counts[name] > 1), None)


def inside(keys: Sequence[str], value: Any) -> Any:
    """Return a value inside nested tables with the given keys, the outermost key first."""
    for key in reversed(keys):
        value = {key: value}
    return value


def with_default_lights(tables: Table) -> Table:
    """Return the tables of a row, with the default lights if the row changes single lights by
    numbered keys, such as ``lights.0.azimuth``. A light with a position replaces the default."""
    changes = tables.get("lights")
    if not changes or type(changes) is not dict or not has_numbers(changes):
        return tables
    lights = {
        str(index): _light(light)
        for index, light in enumerate(default_lights("environment" in tables))
        if not isinstance(change := changes.get(str(index)), dict) or "position" not in change
    }
    return {**tables, "lights": merged(lights, changes)}


def _plain(value: Any, name: str, depth: int) -> Any:
    value_type = type(value)
    if value_type is float and not math.isfinite(value):
        raise InputError(f"{name} = {value!r}: give a finite number")
    if value_type is int and value.bit_length() > _MAX_BITS:
        raise InputError(f"{name} = {quoted(value)}: a whole number has at most {_MAX_BITS} bits")
    if value_type in (str, bool, float, int):
        return value
    if depth > _DEEPEST:
        remedy = f"use at most {_DEEPEST} levels"
        raise InputError(f"{name.split('.')[0]} has tables or lists {depth} deep: {remedy}")
    if value_type is dict or isinstance(value, Mapping):
        return _plain_table(value, name, depth)
    if value_type is list or isinstance(value, list | tuple):
        return [_plain(item, f"{name}.{index}", depth + 1) for index, item in enumerate(value)]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist(), name, depth + 1)
    if isinstance(value, os.PathLike):
        return _plain(os.fspath(value), name, depth + 1)
    remedy = "give a number, true or false, text, a list or a table"
    raise InputError(f"{name} = {quoted(value)}: {remedy}")


def _plain_table(value: Mapping[Any, Any], name: str, depth: int) -> Table:
    table: Table = {}
    for key, entry in value.items():
        if not isinstance(key, str):
            raise InputError(f"key {quoted(key)}{f' of {name}' if name else ''}: give text")
        if entry is None:
            continue
        full = f"{name}.{key}" if name else key
        entry = _plain(entry, full, depth + 1)
        if entry == {} and value[key]:  # the value contained only None
            continue
        if "." in key and name not in NAMED:
            key, *parts = key.split(".")
            if depth + len(parts) > _DEEPEST:
                raise InputError(f"key {quoted(full)} has too many dots: use at most {_DEEPEST}")
            entry = inside(parts, entry)
        table[key] = _joined(table[key], entry, full) if key in table else entry
    return table


def _joined(base: Any, addition: Any, name: str) -> Any:
    """Add the values of table `addition` to table `base`, and return `base`."""
    if type(base) is not dict or type(addition) is not dict:
        raise InputError(f"{clipped(name)} is given twice, or as a whole and in parts: remove one")
    for key, value in addition.items():
        base[key] = _joined(base[key], value, name) if key in base else value
    return base


def _light(light: Any) -> Any:
    """Return the table of a light that is a record or a text; other values stay."""
    return _light_of(light) if isinstance(light, str | Light) else light


@lru_cache(1024)
def _light_of(light: Light | str) -> Table:
    return _plain_table(plain(build(Light, light, "lights")), "", 0)


MAX_ROWS = 10**9
_MAX_AXES = 100
_BLOCK = 1024  # rows whose random numbers are generated together


def grid_rows(tables: Table) -> Iterator[Table]:
    """Yield the rows that a file's tables define; rows with the same mesh are neighbours.

    The loops are, from the outermost: meshes of the grid, ``jobs``, other axes of the grid (the
    last axis changes fastest), ``random.count`` repetitions. If several tables define a key, random
    wins over grid, grid over jobs, and jobs over the common tables.
    """
    tables = dict(tables)
    grid, chance = (tables.pop(key, {}) for key in ("grid", "random"))
    jobs = tables.pop("jobs", [{}])
    for name, table in (("grid", grid), ("random", chance)):
        if not isinstance(table, Mapping):
            raise InputError(f"{name} = {quoted(table)}: give a table, [{name}]")
    if not isinstance(jobs, list) or not jobs:
        raise InputError(f"jobs = {quoted(jobs)}: give tables, [[jobs]]")
    chance = dict(chance)
    count = _whole("random.count", chance.pop("count", 1), 1)
    seed = _whole("random.seed", chance.pop("seed", 0), 0)
    random = [*_leaves(chance, {*_DISTRIBUTIONS, "choice"})]
    if grid.get("camera") == "standard":
        grid = {**grid, "camera": [*STANDARD_ANGLES]}
    axes = [(key, *_axis(key, value)) for key, value in _leaves(grid, {"from", "to", "step"})]
    draws = [_random(key, how, seed) for key, how in random]
    if len(axes) > _MAX_AXES or len(random) > _MAX_AXES:
        raise InputError(f"more than {_MAX_AXES} axes in grid or random: give fewer")
    keys = [*(key for key, _, _ in axes), *(key for key, _ in random)]
    keys = ["mesh.path" if key == "mesh" else key for key in keys]
    if (twice := repeated(keys)) is not None:
        raise InputError(f"{twice} is given twice in grid and random: remove one")
    rows = len(jobs) * count * math.prod(length for _, length, _ in axes)
    if rows > MAX_ROWS:
        remedy = f"give {MAX_ROWS} at most"
        raise InputError(f"grid, jobs and random give {rows} rows together: {remedy}")
    common = nested(tables)
    bases = [merged(common, nested(job)) for job in jobs]
    meshes = [axis for key, *axis in axes if key.split(".")[0] == "mesh"]
    other_axes = [axis for key, *axis in axes if key.split(".")[0] != "mesh"]
    number = 0
    for mesh in _spread({}, meshes):
        for base in bases:
            for row in _spread(merged(base, mesh), other_axes):
                for _ in range(count):
                    for draw in draws:
                        row = merged(row, draw(number))
                    yield row
                    number += 1


def _spread(base: Table, axes: Sequence[Any]) -> Iterator[Table]:
    """Yield a row for each combination of the values of axes, which :func:`_axis` returns."""
    if not axes:
        yield base
        return
    length, row_at = axes[0]
    for index in range(length):
        yield from _spread(merged(base, row_at(index)), axes[1:])


def _leaves(table: Mapping[str, Any], leaf_keys: set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables with their dotted keys. A table with one of `leaf_keys`
    counts as a value."""
    for key, value in table.items():
        if isinstance(value, Mapping) and value and leaf_keys.isdisjoint(value):
            yield from ((f"{key}.{subkey}", leaf) for subkey, leaf in _leaves(value, leaf_keys))
        else:
            yield key, value


def _axis(key: str, value: Any) -> tuple[int, Callable[[int], Table]]:
    """Return the number of values of an axis, and a function that returns the value at an index as
    a row with only `key`."""
    name = f"grid.{key}"
    if isinstance(value, list) and value:
        rows = [nested({key: element}) for element in value]
        return len(rows), rows.__getitem__
    if not isinstance(value, Mapping):
        remedy = "give a list of values, or { from, to, step }, or { from, to, count }"
        raise InputError(f"{name} = {quoted(value)}: {remedy}")
    if len(value) != 3 or set(value) - {"from", "to", "step", "count"}:
        raise InputError(f"{name} = {quoted(value)}: give from, to, and step or count")
    low, high = (_number(f"{name}.{end}", value.get(end)) for end in ("from", "to"))
    integral = all(type(parameter) is int for parameter in value.values())
    try:
        start, end = Decimal(str(low)), Decimal(str(high))
        if "step" in value:
            step = Decimal(str(_number(f"{name}.step", value["step"])))
            if not step or (end - start) / step < 0:
                problem = f"{value['step']!r} does not lead from {low} to {high}"
                raise InputError(f"{name}.step = {problem}: give another")
            count = int((end - start) // step) + 1
        else:
            count = _whole(f"{name}.count", value["count"], 1)
            step = (end - start) / max(count - 1, 1)
            integral = integral and step == int(step)
    except DecimalException:
        raise InputError(f"{name} = {quoted(value)}: give numbers nearer to each other") from None
    number = int if integral else float
    keys = key.split(".")
    return count, lambda index: inside(keys, number(start + index * step))


def _random(key: str, how: Any, seed: int) -> Callable[[int], Table]:
    """Return a function that maps a row number to a random value, as a row with only `key`.

    The values come from Philox, a counter-based generator whose blocks of four words depend only on
    its key and a counter. The counter is the row number. The generator's key is the seed and a
    digest of the dotted key, so that other keys of the table do not change these values.

    References: Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3".
    """
    name, keys = f"random.{key}", key.split(".")
    if not isinstance(how, Mapping) or len(how) != 1 or not {*how} <= {*_DISTRIBUTIONS, "choice"}:
        raise InputError(f"{name} = {quoted(how)}: give one of {_REMEDY}")
    ((distribution, values),) = how.items()
    if not isinstance(values, list) or not values:
        raise InputError(f"{name}.{distribution} = {quoted(values)}: give one of {_REMEDY}")
    digest = hashlib.blake2b(key.encode(), digest_size=8).digest()
    stream = np.array([seed, int.from_bytes(digest, "little")], dtype=np.uint64)

    @lru_cache(1)
    def words(block: int) -> Any:
        generator = np.random.Philox(key=stream, counter=[block * _BLOCK, 0, 0, 0])
        return generator.random_raw(4 * _BLOCK).reshape(_BLOCK, 4)[:, :2].tolist()

    if distribution == "choice":
        rows = [nested({key: value}) for value in values]
        return lambda number: rows[words(number // _BLOCK)[number % _BLOCK][0] * len(rows) >> 64]
    if len(values) != 2:
        raise InputError(f"{name}.{distribution} = {quoted(values)}: give two numbers")
    low, high = parameters = [float(_number(f"{name}.{distribution}", n)) for n in values]
    if distribution == "normal":
        if high < 0.0:
            raise InputError(f"{name}.normal: sigma = {high:g} is negative; give at least 0")
        low, high = -math.inf, math.inf
    elif low > high:
        raise InputError(f"{name}.{distribution} = [{low:g}, {high:g}]: give the lower end first")
    elif distribution == "log_uniform" and low <= 0.0:
        raise InputError(f"{name}.log_uniform = [{low:g}, {high:g}]: give ends above 0")

    def draw(number: int) -> Any:
        u_bits, v_bits = words(number // _BLOCK)[number % _BLOCK]
        u, v = (u_bits >> 11) * 2.0**-53, (v_bits >> 11) * 2.0**-53
        value = _DISTRIBUTIONS[distribution](parameters[0], parameters[1], u, v)
        # Rounded, because exp and log agree between machines only to 12 digits.
        return inside(keys, min(max(float(f"{value:.12g}"), low), high))

    return draw


# A distribution has four arguments: the ends of its range (for "normal", mean and standard
# deviation), then two uniform random numbers in [0, 1).
_DISTRIBUTIONS: dict[str, Callable[[float, float, float, float], float]] = {
    "uniform": lambda low, high, u, _: (1.0 - u) * low + u * high,
    "log_uniform": lambda low, high, u, _: math.exp((1.0 - u) * math.log(low) + u * math.log(high)),
    "normal": lambda mean, sigma, u, v: (  # Box and Muller (1958)
        mean + sigma * math.sqrt(-2.0 * math.log(1.0 - u)) * math.cos(2.0 * math.pi * v)
    ),
}
_REMEDY = (
    "{ uniform = [LOW, HIGH] }, { log_uniform = [LOW, HIGH] }, { normal = [MEAN, SIGMA] }, "
    "{ choice = [...] }"
)


def _number(name: str, value: Any) -> int | float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e300:
        return value
    raise InputError(f"{name} = {quoted(value)}: give a finite number")


def _whole(name: str, value: Any, minimum: int) -> int:
    if type(value) is int and minimum <= value < 2**63:
        return value
    raise InputError(f"{name} = {quoted(value)}: give a whole number from {minimum} to 2^63 - 1")
