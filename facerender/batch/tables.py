"""Rows of a job table: generates them from common tables, a list of jobs, a grid and random values,
and converts them to nested plain data (expands keys and shorthands, merges tables).

``formats.py`` reads the files; ``jobs.py`` makes jobs from the rows."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from decimal import Decimal, DecimalException
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np

from facerender.errors import InputError, clipped, shown
from facerender.scene.camera import orbit_of
from facerender.scene.environment import parse_environment
from facerender.scene.light import Light, parse_light
from facerender.scene.scene import Scene

Table = dict[str, Any]

_DEEPEST = 10  # levels of nested tables and lists
_DIGITS = frozenset("0123456789")
# Tables whose keys are names in a mesh file, which may contain dots, or only digits.
_NAMED = ("parts", "pose.weights", "pose.joints", "before.weights", "before.joints")
_MOST_BITS = 64  # largest size of a whole number, in bits


def nested(row: Any) -> Table:
    """Return a row as nested tables of plain data.

    Dotted keys become nested tables, and None values are removed. A mesh, an environment, a camera
    or a light that is given as text becomes a table. Numbered items (``lights.0.azimuth``) stay
    tables with numbers as keys until :func:`listed` converts them.

    Raises
    ------
    InputError : the row is not a table, a key is given twice, a value is not plain data, or the
        text of a light, a camera or an environment is invalid
    """
    if type(row) is not dict and not isinstance(row, Mapping):
        raise InputError(f"row = {shown(row)}: give a table")
    values: Table = {}
    for key, value in row.items():
        if key == "mesh" and isinstance(value, str | os.PathLike):
            key = "mesh.path"
        elif key == "environment" and isinstance(value, str):
            parts = islice(asdict(parse_environment(value)).items(), value.count(",") + 1)
            values |= {f"environment.{name}": part for name, part in parts}
            continue
        elif key == "camera" and isinstance(value, str):
            values |= {f"camera.{name}": number for name, number in orbit_of(value).items()}
            continue
        if key in values:
            raise InputError(f"{key} is given twice: leave one out")
        values[key] = value
    tables: Table = _plain(values, "", 0)
    if "lights" in tables:
        tables["lights"] = _lights(tables["lights"])
    return tables


def placed(keys: Sequence[str], value: Any) -> Any:
    """Return a value inside nested tables with the given keys, the outermost key first."""
    for key in reversed(keys):
        value = {key: value}
    return value


def merged(base: Table, over: Table) -> Table:
    """Return table `base`, updated with table `over`.

    Nested tables are merged, numbered items replace items of a list, and other values are replaced.
    The arguments are not modified; the result may share parts with the arguments.
    Raise InputError if a numbered item is not in the list and does not extend it by one.
    """
    table = dict(base)
    for key, value in over.items():
        if type(value) is dict and key in table:
            base_value = table[key]
            if type(base_value) is list and _places(value):
                items = {str(place): item for place, item in enumerate(base_value)}
                value = listed(merged(items, value), key)
            elif type(base_value) is dict:
                value = merged(base_value, value)
        table[key] = value
    return table


def with_default_lights(tables: Table) -> Table:
    """Return the tables of a row, with the default lights if the row changes single lights by
    numbered keys, such as ``lights.0.azimuth``. A light with a position replaces the default."""
    changes = tables.get("lights")
    if not changes or type(changes) is not dict or not _places(changes):
        return tables
    default = () if "environment" in tables else Scene.lights
    lights = {
        str(place): _table_of(light)
        for place, light in enumerate(default)
        if not isinstance(change := changes.get(str(place)), dict) or "position" not in change
    }
    return {**tables, "lights": merged(lights, changes)}


def listed(value: Any, name: str) -> Any:
    """Convert tables with the keys 0, 1, 2, ... into lists, unless the keys are names; raise
    InputError if a number is missing among these keys."""
    if type(value) is dict:
        items = {
            key: listed(item, f"{name}.{key}") if type(item) in (dict, list) else item
            for key, item in value.items()
        }
        if not items or not _places(items) or name in _NAMED:
            return items
        for place in range(len(items)):
            if str(place) not in items:
                raise InputError(f"{name} lacks item {place}: count from 0 without gaps")
        return [items[str(place)] for place in range(len(items))]
    if type(value) is list and value and type(value[0]) is dict:
        return [listed(item, f"{name}.{place}") for place, item in enumerate(value)]
    return value


def _places(table: Table) -> bool:
    return all(map(_DIGITS.issuperset, table))


def _plain(value: Any, name: str, depth: int) -> Any:
    kind = type(value)
    if kind is float and not math.isfinite(value):
        raise InputError(f"{name} = {value!r}: give a finite number")
    if kind is int and value.bit_length() > _MOST_BITS:
        raise InputError(f"{name} = {shown(value)}: a whole number has at most {_MOST_BITS} bits")
    if kind in (str, bool, float, int):
        return value
    if depth > _DEEPEST:
        raise InputError(
            f"{name.split('.')[0]} has tables or lists {depth} deep: use at most {_DEEPEST} levels"
        )
    if kind is dict or isinstance(value, Mapping):
        return _plain_table(value, name, depth)
    if kind is list or isinstance(value, list | tuple):
        return [_plain(item, f"{name}.{place}", depth + 1) for place, item in enumerate(value)]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist(), name, depth + 1)
    if isinstance(value, os.PathLike):
        return _plain(os.fspath(value), name, depth + 1)
    raise InputError(
        f"{name} = {shown(value)}: give a number, true or false, text, a list or a table"
    )


def _plain_table(value: Mapping[Any, Any], name: str, depth: int) -> Table:
    table: Table = {}
    for key, entry in value.items():
        if not isinstance(key, str):
            raise InputError(f"key {shown(key)}{f' of {name}' if name else ''}: give text")
        if entry is None:
            continue
        full = f"{name}.{key}" if name else key
        entry = _plain(entry, full, depth + 1)
        if entry == {} and value[key]:  # the value contained only None
            continue
        if "." in key and name not in _NAMED:
            key, *parts = key.split(".")
            if depth + len(parts) > _DEEPEST:
                raise InputError(f"key {shown(full)} has too many dots: use at most {_DEEPEST}")
            entry = placed(parts, entry)
        table[key] = _joined(table[key], entry, full) if key in table else entry
    return table


def _joined(base: Any, addition: Any, name: str) -> Any:
    """Add the values of table `addition` to table `base`, and return `base`."""
    if type(base) is not dict or type(addition) is not dict:
        raise InputError(f"{clipped(name)} is given twice, or as a whole and in parts: remove one")
    for key, value in addition.items():
        base[key] = _joined(base[key], value, name) if key in base else value
    return base


def _lights(lights: Any) -> Any:
    def table_of(light: Any) -> Any:
        return _light(light) if isinstance(light, str) else light

    if type(lights) is dict:
        return {key: table_of(light) for key, light in lights.items()}
    lights = [lights] if isinstance(lights, str) else lights
    return [table_of(light) for light in lights] if type(lights) is list else lights


@lru_cache(1024)
def _light(text: str) -> Table:
    return _table_of(parse_light(text))


def _table_of(light: Light) -> Table:
    table: Table = _plain_table(asdict(light), "", 0)
    return table


MOST_ROWS = 10**9
_MOST_AXES = 100
_BLOCK = 1024  # rows whose random numbers are generated together


def grid_rows(tables: Table) -> Iterator[Table]:
    """Yield the rows that a file's tables define; rows with the same mesh are neighbours.

    The loops are, from the outermost: meshes of the grid, ``jobs``, other axes of the grid (the
    last axis changes fastest), ``random.count`` repetitions. If several tables define a key, random
    wins over grid, grid over jobs, and jobs over the common tables.

    Raises
    ------
    InputError : an axis, range or distribution is invalid, or there are more than MOST_ROWS rows
    """
    tables = dict(tables)
    grid, chance = (tables.pop(key, {}) for key in ("grid", "random"))
    jobs = tables.pop("jobs", [{}])
    for name, table in (("grid", grid), ("random", chance)):
        if not isinstance(table, Mapping):
            raise InputError(f"{name} = {shown(table)}: give a table, [{name}]")
    if not isinstance(jobs, list) or not jobs:
        raise InputError(f"jobs = {shown(jobs)}: give tables, [[jobs]]")
    chance = dict(chance)
    count = _whole("random.count", chance.pop("count", 1), 1)
    seed = _whole("random.seed", chance.pop("seed", 0), 0)
    random = [*_leaves(chance, "random", {*_DISTRIBUTIONS, "choice"})]
    axes = [_axis(key, value) for key, value in _leaves(grid, "grid", {"from", "to", "step"})]
    draws = {key: _random(key, how, seed) for key, how in random}
    if len(axes) > _MOST_AXES or len(random) > _MOST_AXES:
        raise InputError(f"more than {_MOST_AXES} axes in grid or random: give fewer")
    keys = [*(axis.key for axis in axes), *(key for key, _ in random)]
    keys = ["mesh.path" if key == "mesh" else key for key in keys]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"{twice[0]} is given twice in grid and random: remove one")
    rows = len(jobs) * count * math.prod(axis.count for axis in axes)
    if rows > MOST_ROWS:
        raise InputError(
            f"grid, jobs and random give {rows} rows together: give {MOST_ROWS} at most"
        )
    common = nested(tables)
    bases = [merged(common, nested(job)) for job in jobs]
    meshes = [axis for axis in axes if axis.key.split(".")[0] == "mesh"]
    other_axes = [axis for axis in axes if axis not in meshes]
    number = 0
    for mesh in _spread({}, meshes):
        for base in bases:
            for row in _spread(merged(base, mesh), other_axes):
                for _ in range(count):
                    for draw in draws.values():
                        row = merged(row, draw(number))
                    yield row
                    number += 1


@dataclass(frozen=True, eq=False)
class _Axis:
    """An axis of the grid: `row` returns its value at an index as a row with only `key`."""

    key: str
    count: int
    row: Callable[[int], Table]


def _spread(base: Table, axes: Sequence[_Axis]) -> Iterator[Table]:
    if not axes:
        yield base
        return
    for place in range(axes[0].count):
        yield from _spread(merged(base, axes[0].row(place)), axes[1:])


def _leaves(table: Mapping[str, Any], name: str, leaf_keys: set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables with their dotted keys; keys may contain dots themselves.

    A table with one of `leaf_keys` counts as a value.
    """
    for key, value in table.items():
        if isinstance(value, Mapping) and value and leaf_keys.isdisjoint(value):
            for subkey, leaf in _leaves(value, f"{name}.{key}", leaf_keys):
                yield f"{key}.{subkey}", leaf
        else:
            yield key, value


def _axis(key: str, value: Any) -> _Axis:
    name = f"grid.{key}"
    if isinstance(value, list) and value:
        rows = [nested({key: element}) for element in value]
        return _Axis(key, len(rows), rows.__getitem__)
    if not isinstance(value, Mapping):
        raise InputError(
            f"{name} = {shown(value)}: give a list of values, or {{ from, to, step }}, or "
            "{ from, to, count }"
        )
    if len(value) != 3 or set(value) - {"from", "to", "step", "count"}:
        raise InputError(f"{name} = {shown(value)}: give from, to, and step or count")
    low, high = (_number(f"{name}.{end}", value.get(end)) for end in ("from", "to"))
    integral = all(type(parameter) is int for parameter in value.values())
    try:
        start, end = Decimal(str(low)), Decimal(str(high))
        if "step" in value:
            step = Decimal(str(_number(f"{name}.step", value["step"])))
            if not step or (end - start) / step < 0:
                raise InputError(
                    f"{name}.step = {value['step']!r} does not lead from {low} to {high}: give "
                    "another"
                )
            count = int((end - start) // step) + 1
        else:
            count = _whole(f"{name}.count", value["count"], 1)
            step = (end - start) / max(count - 1, 1)
            integral = integral and step == int(step)
    except DecimalException:
        raise InputError(f"{name} = {shown(value)}: give numbers nearer to each other") from None
    number = int if integral else float
    keys = key.split(".")

    return _Axis(key, count, lambda index: placed(keys, number(start + index * step)))


def _random(key: str, how: Any, seed: int) -> Callable[[int], Table]:
    """Return a function that maps a row number to a random value, as a row with only `key`.

    The value depends only on the seed, the key and the row number. It comes from Philox, a
    counter-based generator: every block of four words depends only on a key and a counter. The
    counter is the row number. The generator's key consists of the seed and a digest of the dotted
    key, so that other keys of the table do not change these values.

    References: Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3".
    """
    name, keys = f"random.{key}", key.split(".")
    if not isinstance(how, Mapping) or len(how) != 1 or not {*how} <= {*_DISTRIBUTIONS, "choice"}:
        raise InputError(f"{name} = {shown(how)}: give one of {_REMEDY}")
    ((kind, values),) = how.items()
    if not isinstance(values, list) or not values:
        raise InputError(f"{name}.{kind} = {shown(values)}: give one of {_REMEDY}")
    digest = hashlib.blake2b(key.encode(), digest_size=8).digest()
    stream = np.array([seed, int.from_bytes(digest, "little")], dtype=np.uint64)

    @lru_cache(1)
    def words(block: int) -> Any:
        generator = np.random.Philox(key=stream, counter=[block * _BLOCK, 0, 0, 0])
        return generator.random_raw(4 * _BLOCK).reshape(_BLOCK, 4)[:, :2].tolist()

    if kind == "choice":
        rows = [nested({key: value}) for value in values]
        return lambda number: rows[words(number // _BLOCK)[number % _BLOCK][0] * len(rows) >> 64]
    if len(values) != 2:
        raise InputError(f"{name}.{kind} = {shown(values)}: give two numbers")
    parameters = [float(_number(f"{name}.{kind}", value)) for value in values]
    low, high = parameters
    if kind == "normal":
        if high < 0.0:
            raise InputError(f"{name}.normal: sigma = {high:g} is negative; give at least 0")
        low, high = -math.inf, math.inf
    elif low > high:
        raise InputError(f"{name}.{kind} = [{low:g}, {high:g}]: give the lower end first")
    elif kind == "log_uniform" and low <= 0.0:
        raise InputError(f"{name}.log_uniform = [{low:g}, {high:g}]: give ends above 0")

    def draw(number: int) -> Any:
        u_bits, v_bits = words(number // _BLOCK)[number % _BLOCK]
        u, v = (u_bits >> 11) * 2.0**-53, (v_bits >> 11) * 2.0**-53
        value = _DISTRIBUTIONS[kind](parameters[0], parameters[1], u, v)
        # Rounded, because exp and log agree between machines only to 12 digits.
        return placed(keys, min(max(float(f"{value:.12g}"), low), high))

    return draw


def _normal(mean: float, sigma: float, u: float, v: float) -> float:
    """Return a normally distributed number from uniform u and v (Box and Muller, 1958)."""
    return mean + sigma * math.sqrt(-2.0 * math.log(1.0 - u)) * math.cos(2.0 * math.pi * v)


# A distribution has four arguments: the ends of its range (for "normal", mean and standard
# deviation), then two uniform random numbers in [0, 1).
_DISTRIBUTIONS: dict[str, Callable[[float, float, float, float], float]] = {
    "uniform": lambda low, high, u, _: (1.0 - u) * low + u * high,
    "log_uniform": lambda low, high, u, _: math.exp((1.0 - u) * math.log(low) + u * math.log(high)),
    "normal": _normal,
}
_REMEDY = (
    "{ uniform = [LOW, HIGH] }, { log_uniform = [LOW, HIGH] }, { normal = [MEAN, SIGMA] }, "
    "{ choice = [...] }"
)


def _number(name: str, value: Any) -> int | float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e300:
        return value
    raise InputError(f"{name} = {shown(value)}: give a finite number")


def _whole(name: str, value: Any, minimum: int) -> int:
    if type(value) is int and minimum <= value < 2**63:
        return value
    raise InputError(f"{name} = {shown(value)}: give a whole number from {minimum} to 2^63 - 1")
