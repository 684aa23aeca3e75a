"""Calibration: find limits for another renderer from pairs of images that must pass.

Each limit is the default or, if a pair needs a wider limit, the smallest value with which every
pair passes, times MARGIN. Bisection also finds the smallest change that each limit detects: changes
are applied to image B of a few pairs, and the other limits are disabled.

Limits are stored in pytest's ini file or pyproject.toml, for the pytest plugin and ``facerender
compare --limits``. Limits for linear images are options of pytest such as ``facerender_point``.
Limits for 8-bit images are in another section, since goldens are never 8-bit images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from configparser import Error as IniError
from configparser import RawConfigParser
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.compare import compare, pairs_of
from facerender.comparison.result import LIMITS, NAMES, Limits
from facerender.comparison.sources import CHECKS, HIGHEST, decimal
from facerender.comparison.windows import FULL, filtered, shrunk
from facerender.errors import InputError, check_range, quoted, reason
from facerender.images.files import read_image
from facerender.images.image import Encoding, ImageData, encode_srgb8, srgb_to_linear
from facerender.system.files import AnyPath, read_file, tables_of
from facerender.system.process import Progress, no_progress

PREFIX = "facerender_"
_MAX = 1 << 20  # largest size of a file of limits, in bytes
MARGIN = 1.5
ENOUGH = 5  # fewer pairs hardly show how much images vary
# Text for the change that each limit must detect; the amount follows it. The two pixels of "point"
# are adjacent and lie in a smooth area.
CHANGES = {
    "point": "2 pixels brightened by",
    "block": "an exposure change of",
    "trend": "a highlight change of",
    "grain": "noise of",
    "texture": "a change of fine detail by",
    "coverage": "a coverage change of",
    "shift": "a shift of",
}
# Amount of change that each limit should detect, in the unit of Calibration.sees.
_FRACTIONS = {"block": 0.01, "trend": 0.03, "grain": 0.02, "texture": 0.03}
STATED: dict[Encoding, dict[str, float]] = {
    "linear": {"point": 0.1, **_FRACTIONS},
    "srgb8": {"point": 32.0, **_FRACTIONS},
}
ALTERED = 3  # largest number of pairs to which changes are applied
_AROUND = 3  # flat pixels on each side of the brightened pixels
_Mask = NDArray[Any] | None  # (H, W), as in :func:`compare`
_OPEN: dict[str, Any] = dict.fromkeys(NAMES, HIGHEST)


@dataclass(frozen=True)
class Calibration:
    """Limits for images of one encoding."""

    encoding: Encoding
    pairs: int  # number of compared pairs
    limits: Limits  # limits that all pairs pass
    least: Limits  # the same limits without the margin
    # The pair that needs each limit, keyed by the limit's name; default limits are absent.
    needed: Mapping[str, str]
    # Smallest amount of each of :data:`CHANGES` that its limit detects in all altered pairs, keyed
    # by the limit's name; infinite if it detects none. The unit is radiance or 8-bit levels for
    # point, otherwise a fraction. The amounts for coverage and shift are the limits.
    sees: Mapping[str, float]

    @property
    def noted(self) -> dict[str, tuple[float, str]]:
        """The limits keyed by name, each with a comment: the smallest change that it detects, and
        the pair that needs a limit wider than the default."""
        noted = {}
        for name, limit in asdict(self.limits).items():
            amount = self.sees[name]
            note = f"detects {CHANGES[name]} {self._amount(name, amount)} or more"
            if math.isinf(amount):
                note = f"does not detect {CHANGES[name]} any amount"
            noted[name] = limit, note + self._why(name)
        return noted

    @property
    def blind(self) -> list[str]:
        """Warnings about wider limits that do not detect the change in :data:`STATED`."""
        return [
            f"limit {name} = {getattr(self.limits, name):g} does not detect {CHANGES[name]} "
            f"{self._amount(name, amount)}{self._why(name)}"
            for name, amount in STATED[self.encoding].items()
            if name in self.needed and self.sees[name] > amount
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return all values for JSON; ``sees`` contains None for a limit that detects no change."""
        sees = {name: None if math.isinf(amount) else amount for name, amount in self.sees.items()}
        return {**asdict(self), "sees": sees, "blind": self.blind}

    def _why(self, name: str) -> str:
        default = getattr(LIMITS[self.encoding], name)
        if getattr(self.limits, name) <= default:
            return ""
        limit = decimal(getattr(self.least, name))
        return f"; wider than the default {default:g}, since {self.needed[name]} needs {limit}"

    def _amount(self, name: str, amount: float) -> str:
        if name == "point":
            return f"{decimal(amount)}{'' if self.encoding == 'linear' else ' of 255'}"
        if name == "shift":
            return CHECKS["shift"].amount(amount, self.encoding)
        return f"{decimal(100.0 * amount)} %"


def runs_of(folder: AnyPath) -> list[tuple[str, Path, Path]]:
    """Return name, reference and image of each pair of equally named images in any two subfolders,
    each of which contains the images of one run or driver."""
    folder = Path(folder)
    try:
        folders = (path for path in folder.iterdir() if not path.name.startswith("."))
        runs = sorted(path for path in folders if path.is_dir())
    except OSError as error:
        remedy = "give a folder with a subfolder for each run"
        raise InputError(f"cannot read {folder}: {reason(error)}; {remedy}") from None
    if len(runs) < 2:
        remedy = "give one for each run or driver, with images of the same names"
        raise InputError(f"{folder} holds fewer than two subfolders: {remedy}")
    pairs = [pair for a, b in combinations(runs, 2) for pair in pairs_of(a, b)]
    return [(image.relative_to(folder).as_posix(), a, image) for _, a, image in pairs]


def calibration_of(
    pairs: list[tuple[str, Path, Path]], mask: _Mask = None, progress: Progress = no_progress
) -> list[Calibration]:
    """Return limits that all pairs of images pass, separately for linear and for 8-bit images. A
    pair has a name, and the paths of reference and image."""
    paths: dict[Encoding, list[list[Path]]] = {}
    least = dict(LIMITS)  # the smallest limits that all pairs pass
    needed: dict[Encoding, dict[str, str]] = {}  # the pair that needs each limit
    for index, (name, *pair) in enumerate(pairs):
        progress("limits", index / len(pairs))
        a, b = map(read_image, pair)
        result = compare(a, b, mask=mask, **_OPEN)
        if not result.same:
            raise InputError(f"{name} differs with any limits: {result}; remove this pair")
        encoding = result.encoding
        paths.setdefault(encoding, []).append(pair)
        wider = _needed(a, b, least[encoding], mask)
        least[encoding] = replace(least[encoding], **wider)
        needed.setdefault(encoding, {}).update(dict.fromkeys(wider, name))
    calibrations = []
    for encoding, of_encoding in paths.items():
        limits = least[encoding]
        for name in needed[encoding]:
            limit = MARGIN * getattr(limits, name)
            step = 10.0 ** (math.floor(math.log10(limit)) - 1)  # two significant digits, rounded up
            wide = float(f"{math.ceil(limit / step - 1e-9) * step:.2g}")
            limits = replace(limits, **{name: wide})
        sees = {"coverage": limits.coverage, "shift": limits.shift}
        altered = of_encoding[:ALTERED]
        for index, pair in enumerate(altered):
            progress("smallest changes", index / len(altered))
            a, b = map(read_image, pair)
            for name, amount in _smallest_changes(a, b, limits, mask).items():
                sees[name] = max(amount, sees.get(name, 0.0))
        values = len(of_encoding), limits, least[encoding], needed[encoding], sees
        calibrations.append(Calibration(encoding, *values))
    return calibrations


def _needed(a: ImageData, b: ImageData, limits: Limits, mask: _Mask) -> dict[str, float]:
    """Return the smallest value that passes, for each limit of ``limits`` that a pair fails."""
    needed: dict[str, float] = {}
    if compare(a, b, mask=mask, **asdict(limits)).same:
        return needed
    other_limits = dict(_OPEN)

    def passes(name: str, limit: float) -> bool:
        return compare(a, b, mask=mask, **{**other_limits, name: limit}).same

    # The shift limit comes first and the block limit second: a wider shift limit reduces the block
    # changes, and a wider block limit reduces the trend.
    for name in ("shift", "block", *(name for name in NAMES if name not in ("shift", "block"))):
        limit = _least(partial(passes, name), getattr(limits, name))
        if limit > getattr(limits, name):
            needed[name] = limit
        if name in ("shift", "block"):
            other_limits[name] = limit
    return needed


def _least(holds: Callable[[float], bool], low: float, highest: float = HIGHEST) -> float:
    """Return the smallest value >= ``low`` at which a monotonic condition holds; infinity if it
    holds at no value up to ``highest``."""
    if holds(low):
        return low
    high = low
    while not holds(high):
        if high >= highest:
            return math.inf
        low, high = high, min(2.0 * high, highest)
    while high > 1.05 * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _smallest_changes(a: ImageData, b: ImageData, limits: Limits, mask: _Mask) -> dict[str, float]:
    """Return the smallest amount of each change of image B that the change's limit detects."""
    encoded = b.encoding == "srgb8"
    color = b.pixels[..., : 3 if b.pixels.shape[2] > 2 else 1]
    radiance: NDArray[np.floating] = srgb_to_linear(color / 255.0) if encoded else color
    lit, flattest = _flattest(a, mask)
    middle = np.median(radiance[lit], axis=0) if lit.any() else 0.0
    detail = radiance - 0.5 * (np.roll(radiance, 1, axis=1) + np.roll(radiance, -1, axis=1))
    noise = np.random.default_rng(1).standard_normal((*lit.shape, 1))

    def brighter(amount: float) -> NDArray[Any]:
        changed = color.astype(np.float32)
        pair = changed[flattest]
        changed[flattest] = np.minimum(pair + amount, 255.0 if encoded else HIGHEST)
        return changed

    changes: dict[str, Callable[[float], NDArray[Any]]] = {
        "point": brighter,
        "block": lambda amount: radiance * np.float32(1.0 + amount),
        "trend": lambda amount: radiance + np.float32(amount) * np.maximum(radiance - middle, 0.0),
        "grain": lambda amount: radiance * (1.0 + amount * noise),
        "texture": lambda amount: radiance + np.float32(amount) * detail,
    }

    def fails(name: str, amount: float) -> bool:
        changed = changes[name](amount)
        if encoded and name != "point":
            changed = encode_srgb8(changed.astype(np.float32))
        pixels = b.pixels.copy()
        pixels[..., : color.shape[2]] = changed
        names = ("shift", name, *(["block"] if name == "trend" else []))
        narrow = _OPEN | {key: getattr(limits, key) for key in names}
        result = compare(a, replace(b, pixels=pixels), mask=mask, **narrow)
        return result.changed_alike if name == "trend" else not result.same

    def sees(name: str, amount: float) -> bool:
        signs = (1.0, -1.0) if name in ("block", "trend", "texture") else (1.0,)
        return all(fails(name, sign * amount) for sign in signs)

    ranges = dict.fromkeys(changes, (1e-4, 1.0))
    if encoded:
        ranges["point"] = 1.0, 255.0
    return {name: _least(partial(sees, name), *ends) for name, ends in ranges.items()}


def _flattest(image: ImageData, mask: _Mask) -> tuple[NDArray[np.bool_], tuple[slice, slice]]:
    """Return a mask of the lit pixels, and two adjacent pixels in the flattest medium area."""
    color, coverage = image.rows(slice(None))
    level = color.mean(axis=-1)
    lit = (coverage >= FULL) & (level > 0.0)
    if mask is not None:
        lit &= mask != 0
    low, high = np.percentile(level[lit], (40.0, 80.0)) if lit.any() else (0.0, 0.0)
    inside, brightest, darkest = shrunk(lit, _AROUND), level, level
    for _ in range(_AROUND):
        brightest, darkest = filtered(brightest, np.maximum), filtered(darkest, np.minimum)
    contrast = (brightest - darkest) / np.maximum(brightest, 1e-6)
    contrast += np.where(inside & (level > low) & (level <= high), 0.0, 1.0 + contrast.max())
    row, column = (int(index) for index in np.unravel_index(contrast.argmin(), contrast.shape))
    return lit, (slice(row, row + 1), slice(max(column - 1, 0), column + 1))


def read_limits(path: AnyPath) -> dict[Encoding, dict[str, float]]:
    """Return the limits of a .ini, .cfg or .toml file, keyed by the images' encoding."""
    path = Path(path)
    data = _parsed(path)
    limits: dict[Encoding, dict[str, float]] = {}
    for encoding, section in _sections(path, data).items():
        table, numbers = _within(data, section), {}
        for name in NAMES:
            if (key := PREFIX + name) not in table:
                continue
            try:
                numbers[name] = float(table[key])
            except (TypeError, ValueError, OverflowError):
                raise InputError(f"{path}: {key} = {quoted(table[key])}: give a number") from None
            check_range(f"{path}: {key}", numbers[name], 0.0, HIGHEST)
        limits[encoding] = numbers
    if not any(limits.values()):
        raise InputError(f"{path} has no limit: add one, such as {PREFIX}{NAMES[0]}")
    return limits


def text_of(path: AnyPath, limits: Mapping[Encoding, Mapping[str, tuple[float, str]]]) -> str:
    """Return limits as sections of a file, in the syntax that the suffix of the path requires."""
    path = Path(path)
    quote = '"' if path.suffix == ".toml" else ""
    rows = []
    for encoding, noted in limits.items():
        rows += ["", f"[{'.'.join(_sections(path, {})[encoding])}]"]
        for name, (limit, note) in noted.items():
            rows.append(f"# {PREFIX}{name}: {note}")
            rows.append(f"{PREFIX}{name} = {quote}{limit:g}{quote}")
    return "\n".join(rows[1:])


def _parsed(path: Path) -> dict[str, Any]:
    """Return the sections of a file, keyed by name; sections of TOML are nested."""
    content = read_file(path, "an ini file", _MAX)
    if path.suffix == ".toml":
        return tables_of(content, str(path))
    parser = RawConfigParser(inline_comment_prefixes=("#", ";"), default_section="")
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    try:
        parser.read_string(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8: save it in this encoding") from None
    except IniError as error:
        raise InputError(f"{path} cannot be read: {reason(error)}; repair it") from None
    return {name: dict(parser[name]) for name in parser.sections()}


def _sections(path: Path, data: Mapping[str, Any]) -> dict[Encoding, tuple[str, ...]]:
    """Return the section path of each encoding's limits, in a file with content ``data``."""
    if path.suffix == ".toml":
        options = set(_within(data, ("tool", "pytest"))) - {"ini_options"}  # pytest 9 and later
        inner = () if options else ("ini_options",)
        return {"linear": ("tool", "pytest", *inner), "srgb8": ("tool", "facerender", "8-bit")}
    pytest = "tool:pytest" if path.suffix == ".cfg" else "pytest"
    return {"linear": (pytest,), "srgb8": ("facerender:8-bit",)}


def _within(data: Mapping[str, Any], section: tuple[str, ...]) -> Mapping[str, Any]:
    for name in section:
        inner = data.get(name, {})
        data = inner if isinstance(inner, dict) else {}
    return data
