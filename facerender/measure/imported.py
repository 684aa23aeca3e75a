"""What the explorer measured on a reader's GPU: the JSON that its page saves, checked, as a
record. See docs/explorer.md for how it is measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from reprlib import repr as short
from typing import Any, NoReturn
from unicodedata import category

import numpy as np

from facerender.errors import InputError, check_range
from facerender.system.files import read_file

KIND = "facerender explorer cost"
UNIT = "ms a picture"
METHODS = ("GPU timer", "fence")
MOST_BYTES = 1 << 20
_LONGEST = 4000  # of a text; a link of eight lights has some hundred letters
_MOST_ROUNDS = 1000
_MOST_TIME = 1e9  # milliseconds
_MOST_SIDE = 1 << 15
_ROUNDING = 1e-9
_SPREADS = ("base", "a", "b", "difference")


@dataclass(frozen=True)
class Spread:
    """Median of rounds, and the ends of their middle half, in milliseconds."""

    median: float
    low: float
    high: float
    rounds: Sequence[float]


@dataclass(frozen=True)
class Imported:
    """What two shadings cost on another GPU.

    Attributes
    ----------
    version : of facerender, that wrote the page
    gpu, browser : as they name themselves
    method : one of METHODS
    mesh : its name
    size, samples : of the picture, in pixels, and a pixel
    passes : of a round
    link : what the page showed: its address behind #
    shadings : A and B in words
    base, a, b, difference : of the picture without highlights, of A, of B, and B less A
    """

    version: str
    gpu: str
    browser: str
    method: str
    mesh: str
    size: tuple[int, int]
    samples: int
    passes: int
    link: str
    shadings: Mapping[str, str]
    base: Spread
    a: Spread
    b: Spread
    difference: Spread

    @property
    def place(self) -> tuple[str, str, str]:
        """What another import replaces this one by: the same GPU, mesh and link."""
        return self.gpu, self.mesh, self.link

    @classmethod
    def from_dict(cls, content: Any) -> Imported:
        """Return the record of plain data; keys that are none of its own are left out.

        Raises
        ------
        InputError : a value that is missing or cannot be, by its name
        """
        own = _mapping(content, "the whole")
        for field in fields(cls):
            if field.name not in own:
                raise InputError(f"{field.name} is missing")
        shadings = _mapping(own["shadings"], "shadings")
        method = own["method"]
        if method not in METHODS:
            _refuse("method", method, " or ".join(METHODS))
        size = own["size"]
        if not isinstance(size, list) or len(size) != 2:
            _refuse("size", size, "width and height")
        spreads = {name: _spread(own[name], name) for name in _SPREADS}
        if len({len(each.rounds) for each in spreads.values()}) > 1:
            raise InputError(f"{', '.join(_SPREADS)} have unlike numbers of rounds")
        a, b, apart = (np.array(spreads[name].rounds) for name in _SPREADS[1:])
        if (np.abs(b - a - apart) > _ROUNDING * np.maximum(abs(a), abs(b))).any():
            raise InputError("the rounds of difference are not those of b less those of a")
        return cls(
            version=_text(own["version"], "version"),
            gpu=_text(own["gpu"], "gpu"),
            browser=_text(own["browser"], "browser"),
            method=method,
            mesh=_text(own["mesh"], "mesh"),
            size=(_count(size[0], "size", _MOST_SIDE), _count(size[1], "size", _MOST_SIDE)),
            samples=_count(own["samples"], "samples", 64),
            passes=_count(own["passes"], "passes", 1 << 20),
            link=_text(own["link"], "link", empty=True),
            shadings={which: _text(shadings.get(which), f"shadings.{which}") for which in "ab"},
            base=spreads["base"],
            a=spreads["a"],
            b=spreads["b"],
            difference=spreads["difference"],
        )


def read_imported(path: str) -> Imported:
    """Read the JSON that the explorer saved.

    Raises
    ------
    InputError : a file that cannot be read, is none that the explorer saves, or is damaged
    """
    data = read_file(path, "what the explorer saved", MOST_BYTES)
    try:
        content = _mapping(_parsed(data), "the whole")
        for name, value in (("kind", KIND), ("unit", UNIT)):
            if content.get(name) != value:
                _refuse(name, content.get(name), repr(value))
        return Imported.from_dict(content)
    except InputError as error:
        raise InputError(f"{path}: {error}; give a file that the explorer saved") from None


def _parsed(data: bytes) -> Any:
    try:
        return json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        raise InputError("it is no JSON") from None


def _refuse(name: str, value: Any, wanted: str) -> NoReturn:
    raise InputError(f"{name} is {short(value)}, not {wanted}")


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        _refuse(name, value, "an object of JSON")
    return value


def _text(value: Any, name: str, empty: bool = False) -> str:
    """Text of one line, without what a terminal obeys."""
    good = isinstance(value, str) and len(value) <= _LONGEST and (empty or value.strip())
    if not good or any(category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in value):
        _refuse(name, value, f"a line of at most {_LONGEST} letters")
    return str(value)


def _count(value: Any, name: str, most: int) -> int:
    if type(value) is not int or not 1 <= value <= most:
        _refuse(name, value, f"a whole number from 1 to {most}")
    return int(value)


def _spread(value: Any, name: str) -> Spread:
    own = _mapping(value, name)
    rounds = own.get("rounds")
    if not isinstance(rounds, list) or not 1 <= len(rounds) <= _MOST_ROUNDS:
        _refuse(f"{name}.rounds", rounds, f"1 to {_MOST_ROUNDS} numbers")
    times = [_time(each, f"{name}.rounds") for each in rounds]
    median, low, high = np.quantile(times, (0.5, 0.25, 0.75)).tolist()
    for key, expected in {"median": median, "low": low, "high": high}.items():
        told = _time(own.get(key), f"{name}.{key}")
        if abs(told - expected) > _ROUNDING * max(map(abs, times)):
            _refuse(f"{name}.{key}", told, f"{expected:g}, which its rounds have")
    return Spread(median, low, high, times)


def _time(value: Any, name: str) -> float:
    try:
        check_range(name, value, -_MOST_TIME, _MOST_TIME)
    except InputError:
        _refuse(name, value, f"a number of milliseconds within {_MOST_TIME:g}")
    return float(value)
