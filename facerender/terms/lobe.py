"""The lobe E/c^k and its approximations: registry entries, float64 references and fits.

All models use the slope factor E = exp(-tan² γ / m²) divided by c^k with c = cos γ: k = 4 in
Cook-Torrance, k = 0 in Ward. Every lobe has the value 1 at c = 1 (γ = 0); the models (``model.py``)
multiply the lobe by their scale. ``lobes.NAME`` is ``fr_lobe_NAME`` in GLSL.
``tools/fits/lobes.py`` computes the constants of the lobes "fitted" and "fitted-fine" with the fits
at the end of the file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_known
from facerender.values import fields as values
from facerender.values.fields import IntegerRange, Range

ULP = 2.0**-23  # Unit in the last place of a float32 in [1, 2).


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """A term of the registry."""

    name: str  # in options and scene files, for example "v-cavity"
    file: str  # library file that defines the term, for example "masking/v_cavity"
    call: str  # GLSL expression of the term; each subclass documents its variables
    number: int = 0  # value of the macro that selects the term, unique; 0 without a macro
    prefix: ClassVar[str] = ""  # start of the names of these macros, for example "FR_MASKING_"

    @property
    def macro(self) -> str:
        """The GLSL macro that selects the term, for example "FR_MASKING_V_CAVITY"."""
        return self.prefix + self.name.upper().replace("-", "_")


E = TypeVar("E", bound=Entry)


def registry(*entries: E) -> dict[str, E]:
    """Return the entries keyed by their names, in the given order."""
    return {entry.name: entry for entry in entries}


def named(noun: str, entries: Mapping[str, E], name: object) -> E:
    """Return the entry with this name."""
    check_known(noun, name, entries)
    return entries[str(name)]


Float = NDArray[np.float64]
Float64Lobe = Callable[[ArrayLike, ArrayLike, int], Float]

MIN_SLOPE = 1e-4
MAX_SLOPE = 2.0
SLOPES = Range(MIN_SLOPE, MAX_SLOPE)
TINY = 1.2e-38  # Smallest normal float32; drivers may flush smaller values to zero.
TITLES = {4: "Cook-Torrance", 0: "Ward"}  # Names of the models, keyed by k.


@dataclass(frozen=True, eq=False, kw_only=True)
class Lobe(Entry):
    """A lobe. The GLSL call uses float c, m and int k."""

    evaluate: Float64Lobe  # float64 reference; checks the domain
    ends: Mapping[int, float]  # upper end of the domain of m, keyed by k; the lower is MIN_SLOPE
    open_ends: tuple[int, ...] = ()  # values of k whose upper end itself is outside the domain
    # Largest difference from the exact lobe in percent of the peak, keyed by k: six numbers for
    # m = 0.1, 0.2, ... 0.6, or one number for all slopes; None if no error is stated.
    errors: Mapping[int, tuple[float, ...]] | None = None
    # float32 error bounds, relative and absolute, as a function of c, m and k.
    rounding: Callable[[Float, Float, int], tuple[Float | float, Float | float]]
    # Error of the lobe, in units of its peak, as a function of the relative error of (1 - c)/m².
    amplified: Callable[[Float], Float] = lambda error: error
    macro: str = ""  # macro that selects the lobe
    macros: Mapping[str, str] = field(default_factory=dict)  # values of further macros, by name
    price: str = ""  # key in tables of prices; lobes of the same cost share one key
    # Macro that sets the coefficients if m is constant, and their float64 function of m and k.
    constants: tuple[str, Callable[[float, int], Float]] | None = None
    # Only for the exact lobe: float64 reference as a function of tan² γ instead of c, which keeps
    # the digits of small angles.
    of_tan2: Float64Lobe | None = None
    prefix = "FR_LOBE_"

    def __post_init__(self) -> None:
        object.__setattr__(self, "macro", self.macro or super().macro)
        object.__setattr__(self, "price", self.price or self.name)

    def belongs(self, m: ArrayLike, k: int) -> NDArray[np.bool_]:
        """Return whether each slope is in the domain of the lobe. At ends that belong to the
        domain, the relative tolerance is 1e-6, because a G-buffer stores m as float32."""
        slope = np.asarray(m, dtype=np.float64)
        end = self.end(k)
        below_end = slope < end if k in self.open_ends else slope <= end * (1.0 + 1e-6)
        return np.asarray((slope >= MIN_SLOPE * (1.0 - 1e-6)) & below_end)

    def end(self, k: int) -> float:
        """Return the upper end of the domain of m."""
        if k not in self.ends:
            raise InputError(f"k = {k} is neither 4 (Cook-Torrance) nor 0 (Ward)")
        return self.ends[k]

    def check(self, m: ArrayLike, k: int) -> Float:
        """Return m as float64, or raise InputError if a value is outside the domain."""
        slope = np.asarray(m, dtype=np.float64)
        inside = self.belongs(slope, k)
        if not inside.all():
            end, bracket = self.end(k), ")" if k in self.open_ends else "]"
            remedy = ", or use the lobe exact (facerender render: --outside exact)"
            problem = f"m = {slope[~inside].flat[0]:g} is outside the domain of lobe {self.name}"
            domain = f"[{MIN_SLOPE:g}, {end:.4g}{bracket}{'' if end == MAX_SLOPE else remedy}"
            raise InputError(f"{problem} for {TITLES[k]}: give m in {domain}")
        return slope


@dataclass(frozen=True)
class PowerPolynomial:
    """A lobe max(P(u), 0)^power with P = 1 + a₁ u + a₂ u² + ..., u = 1 - cos γ.

    Attributes
    ----------
    power : exponent of the clamped polynomial
    max_slope : upper end of the domain of m
    table : row j contains the factors of m^(2j) in a₁ m², a₂ m⁴, a₃ m⁶, ...
    """

    power: int
    max_slope: float
    table: tuple[tuple[float, ...], ...]

    def coefficients(self, m: ArrayLike) -> Float:
        """Return the coefficients a₁, a₂, ... (..., degree) for slopes m (...)."""
        w = np.asarray(m, dtype=np.float64)[..., None] ** 2
        table = np.array(self.table)
        scaled = sum(row * w**j for j, row in enumerate(table))
        return np.asarray(scaled / w ** np.arange(1, table.shape[1] + 1))

    def magnitudes(self, m: ArrayLike) -> Float:
        """Return the sums of absolute terms in a₁ m², a₂ m⁴, ...; the sums scale rounding."""
        w = np.asarray(m, dtype=np.float64)[..., None] ** 2
        return np.asarray(sum(np.abs(row) * w**j for j, row in enumerate(self.table)))

    def __call__(self, u: ArrayLike, m: ArrayLike) -> Float:
        """Return the lobe at u and m, which broadcast. Domains are not checked."""
        x = np.asarray(u, dtype=np.float64)
        p = np.zeros(np.broadcast(x, m).shape)
        for a in np.moveaxis(self.coefficients(m), -1, 0)[::-1]:
            p = (p + a) * x
        return np.maximum(1.0 + p, 0.0) ** self.power


@values.record("g-power ")
class GPower:
    """A g-power lobe with free steepness s: max(1 - s (1 - cos γ), 0)^g, s = factor/m² - offset.

    References: Romanyuk et al. (2020); Lyon (1993) for the clamp."""

    g: int = values.field(
        IntegerRange(1, 31), text="power; D4, D8 and D16 have the factor 2/g and the offset k/g"
    )
    factor: float = values.field(Range(1e-9, 1e6), text="factor of 1/m² in s")
    offset: float = values.field(
        Range(-1e6, 1e6), 0.0, "number subtracted from factor/m²; the domain of m ends where s = 0"
    )

    def __str__(self) -> str:
        sign = "-" if self.offset > 0.0 else "+"
        offset = f" {sign} {abs(self.offset):.5g}" if self.offset else ""
        return f"g-power {self.g} ({self.factor:.5g}/m^2{offset})"


# Keyed by lobe and k. shaders/facerender/lobe/fitted.glsl contains the same constants.
_TABLES: dict[tuple[str, int], tuple[tuple[float, ...], ...]] = {
    ("fitted", 4): (
        (-0.39700398, 0.07498738, -0.0060935954),
        (0.6738297, -0.58629695, 0.0026217349),
        (0.71936623, -1.6754473, 1.1615276),
        (-1.0351326, 4.1195317, -5.0082767),
    ),
    ("fitted", 0): (
        (-0.40198098, 0.083526049, -0.010091574),
        (-0.020725706, -0.49894731, 0.08771378),
        (0.077372606, -0.42975123, 0.18764888),
        (-0.067503089, 0.51304211, -1.5410764),
    ),
    ("fitted-fine", 4): (
        (-0.24963107, 0.030319915, -0.0020734921, 0.0),
        (0.50360702, -0.52566283, 0.15216287, -0.017956779),
        (-0.013824908, 0.50565452, -0.92452698, 0.030042244),
        (-0.081719136, 0.47515006, -1.4199605, 1.6944034),
        (0.19363848, -1.434821, 4.5145226, -5.6548034),
    ),
    ("fitted-fine", 0): (
        (-0.24950537, 0.029811221, -0.0017648837, 0.0),
        (0.0018034024, -0.38853178, 0.14142554, -0.024093986),
        (-0.0076809275, 0.078399249, -0.74785186, 0.058197197),
        (-0.0071770924, 0.063575568, -0.40797551, 1.0990611),
        (0.015975844, -0.20239128, 1.087785, -2.6305629),
    ),
}
_POWERS, _ENDS = {"fitted": 5, "fitted-fine": 8}, {4: 0.7, 0: 1.0}
FITTED = {
    (name, k): PowerPolynomial(_POWERS[name], _ENDS[k], table)
    for (name, k), table in _TABLES.items()
}


def _check_cosine(c: ArrayLike) -> Float:
    cosine = np.asarray(c, dtype=np.float64)
    inside = (cosine >= 0.0) & (cosine <= 1.0)
    if not inside.all():
        raise InputError(f"cosine {cosine[~inside].flat[0]:g} is outside [0, 1]")
    return cosine


def _exact(tan2: NDArray[np.floating], m: Float, k: int) -> Float:
    # A relative error e of the exponent x becomes a relative error e x of the result, and x reaches
    # 690 in the range of float64. Extended precision, if available, keeps the error at 1e-13.
    exponent = tan2 / np.asarray(m, dtype=np.longdouble) ** 2
    exponent = np.minimum(exponent, 1e4)  # exp(-1e4) is 0; infinity - infinity would be NaN.
    head = exponent.astype(np.float64)
    tail = (exponent - head).astype(np.float64)
    slope_factor = np.exp(-head) * np.exp(-tail)
    sec2 = 1.0 + np.minimum(tan2, 1e100).astype(np.float64)  # E is 0 for larger tan2.
    return np.asarray(slope_factor * sec2 ** (k // 2), dtype=np.float64)


def exact_tan2(tan2: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Return E/c^k from the squared tangent of the angle between normal and half vector.

    tan2 is tan² γ, >= 0, infinity allowed, of any shape. For m and k see :func:`exact`.

    References: Beckmann and Spizzichino (1963); Cook and Torrance (1982); Ward (1992), eq. 4.
    """
    slope = LOBES["exact"].check(m, k)
    t = np.asarray(tan2, dtype=np.float64)
    if not (t >= 0.0).all():
        raise InputError(f"tan2 = {t[~(t >= 0.0)].flat[0]:g} is negative or not a number")
    return _exact(t.astype(np.longdouble), slope, k)


def exact(c: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Return E/c^k from the cosine of the angle between normal and half vector.

    The relative error is at most 1e-13 for results above 1e-300 if ``numpy.longdouble`` has 64
    bits of mantissa or more; 5e-13 otherwise.

    Parameters
    ----------
    c : cos γ, in [0, 1]; any shape
    m : RMS slope of the microfacets, in [1e-4, 2]; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward
    """
    slope = LOBES["exact"].check(m, k)
    x = _check_cosine(c).astype(np.longdouble)
    with np.errstate(divide="ignore"):
        tan2 = (1.0 - x) * (1.0 + x) / (x * x)
    return _exact(tan2, slope, k)


def cosine(c: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Approximate E/c^k by c^n, n = 2/m² - k.

    m is in [1e-4, sqrt(2/k)), at most 2. For the other parameters and the exceptions see
    :func:`exact`.

    References: Romanyuk et al. (2020), section 3.
    """
    slope = LOBES["cosine"].check(m, k)
    return np.asarray(_check_cosine(c) ** (2.0 / slope**2 - k), dtype=np.float64)


def g_power(c: ArrayLike, m: ArrayLike, k: int, g: int) -> Float:
    """Approximate E/c^k by a factor linear in c, clamped and raised to the power g.

    The formula is max((n/g)(c - 1) + 1, 0)^g with n = 2/m² - k.

    m is in [1e-4, sqrt(2/k)), at most 2; g is 4, 8 or 16. For the other parameters and the
    exceptions see :func:`exact`.

    References: Romanyuk et al. (2020), D4, D8, D16; Lyon (1993) for the clamp.
    """
    if g not in (4, 8, 16):
        raise InputError(f"g = {g} is none of 4, 8, 16")
    n = 2.0 / LOBES[f"d{g}"].check(m, k) ** 2 - k
    return clamped_power(c, n / g, g)


def clamped_power(c: ArrayLike, steepness: ArrayLike, g: int) -> Float:
    """Return max(1 - s (1 - c), 0)^g, a g-power lobe with steepness s.

    c is cos γ, in [0, 1], of any shape; the steepness is at least 0 and broadcasts with c; g is in
    1 to 31.

    References: Lyon (1993).
    """
    base = 1.0 - np.asarray(steepness, dtype=np.float64) * (1.0 - _check_cosine(c))
    return np.asarray(np.maximum(base, 0.0) ** g)


def fitted(c: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Approximate E/c^k by the fifth power of a clamped cubic in 1 - c.

    The error is at most 0.19 % of the peak for Cook-Torrance and 0.13 % for Ward, at all angles and
    slopes of the domain.

    m is in [1e-4, 0.7] for Cook-Torrance, in [1e-4, 1] for Ward. For the other parameters and the
    exceptions see :func:`exact`.

    References: Lyon (1993) for the clamped power. ``tools/fits/lobes.py`` computes the constants.
    """
    slope = LOBES["fitted"].check(m, k)
    return FITTED["fitted", k](1.0 - _check_cosine(c), slope)


def fitted_fine(c: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Approximate E/c^k by the eighth power of a clamped quartic in 1 - c.

    The error is at most 0.04 % of the peak. For the parameters, exceptions and references see
    :func:`fitted`.
    """
    slope = LOBES["fitted-fine"].check(m, k)
    return FITTED["fitted-fine", k](1.0 - _check_cosine(c), slope)


def fitted_coefficients(m: ArrayLike, k: int) -> Float:
    """Return the coefficients (..., 3) of u, u², u³ in :func:`fitted`, with u = 1 - c."""
    slope = LOBES["fitted"].check(m, k)
    return FITTED["fitted", k].coefficients(slope)


def fitted_fine_coefficients(m: ArrayLike, k: int) -> Float:
    """Return the coefficients (..., 4) of u, u², u³, u⁴ in :func:`fitted_fine`."""
    slope = LOBES["fitted-fine"].check(m, k)
    return FITTED["fitted-fine", k].coefficients(slope)


def _exact_rounding(c: Float, m: Float, k: int) -> tuple[Float, Float]:
    x = c.clip(1e-3)
    exponent = np.minimum((1.0 / x**2 - 1.0) / m**2, 100.0)
    # 3 ulp of the exponent for m² and the division, 3 + 2 x ulp for exp2, 2 ulp for 1/c⁴, five
    # operations for tan². Each term includes a margin of 2 ulp: without this margin, dense samples
    # reach 98 % of the bound.
    return ULP * (12.0 + 11.0 * exponent), TINY / np.maximum(x, 0.03) ** 4


def _cosine_rounding(c: Float, m: Float, k: int) -> tuple[Float, float]:
    n = 2.0 / m**2 - k
    x = c.clip(1e-30)
    power = np.minimum(n * -np.log2(x), 130.0)
    n_error = ULP * (3.0 * 2.0 / m**2 + k) / n  # Error of n: 4 ulp, more where 2/m² - k cancels.
    log_error = np.where(x >= 0.5, 2.0**-21, 3.0 * ULP * -np.log2(x))
    exponent_error = np.log(2.0) * (power * n_error + n * log_error)
    return np.expm1(np.minimum(exponent_error, 80.0)) + ULP * (3.0 + 3.0 * power), TINY


def power_error(base: Float, base_error: Float, power: int) -> Float:
    """Return the error of max(base, 0)^power that an error of the base causes."""
    return np.asarray(power * np.maximum(base + base_error, 0.0) ** (power - 1) * base_error)


def _g_power_rounding(
    c: Float, m: Float, k: int, g: int, factor: float, offset: float
) -> tuple[float, Float]:
    steepness = factor / m**2 - offset
    # Error of the base 1 - s u: 4 ulp of the terms of s, 3.5 of the product, 0.5 of the sum.
    error = 4.0 * ULP * (factor / m**2 + np.abs(steepness)) * (1.0 - c) + ULP
    return ULP * g, power_error(1.0 - steepness * (1.0 - c), error, g) + TINY


def _fitted_rounding(c: Float, m: Float, k: int, name: str) -> tuple[float, Float]:
    lobe = FITTED[name, k]
    powers = np.arange(1, len(lobe.table[0]) + 1)
    # Each coefficient has 4 products and sums of constants, 1/m² and its powers, and a power of u.
    sums = lobe.magnitudes(m) * ((1.0 - c) / m**2)[:, None] ** powers
    error = 20.0 * ULP * sums.sum(axis=-1) + ULP
    base = 1.0 + (lobe.coefficients(m) * (1.0 - c)[:, None] ** powers).sum(axis=-1)
    return ULP * lobe.power, power_error(base, error, lobe.power) + TINY


def _g_power(g: int, cook_torrance: tuple[float, ...], ward: tuple[float, ...]) -> Lobe:
    return Lobe(
        name=f"d{g}",
        number=g,
        file="lobe/g_power",
        call=f"fr_lobe_g_power(c, m, k, {g})",
        evaluate=lambda c, m, k: g_power(c, m, k, g),
        ends={4: math.sqrt(0.5), 0: MAX_SLOPE},
        open_ends=(4,),
        errors={4: cook_torrance, 0: ward},
        rounding=lambda c, m, k: _g_power_rounding(c, m, k, g, 2.0 / g, k / g),
    )


LOBES: dict[str, Lobe] = registry(
    Lobe(
        name="exact",
        number=1,
        file="lobe/exact",
        call="fr_lobe_exact(c, m, k)",
        evaluate=exact,
        ends={4: MAX_SLOPE, 0: MAX_SLOPE},
        errors={4: (0.0,), 0: (0.0,)},
        rounding=_exact_rounding,
        of_tan2=exact_tan2,
    ),
    Lobe(
        name="cosine",
        number=2,
        file="lobe/cosine",
        call="fr_lobe_cosine(c, m, k)",
        evaluate=cosine,
        ends={4: math.sqrt(0.5), 0: MAX_SLOPE},
        open_ends=(4,),
        errors={4: (0.28, 1.26, 3.42, 8.00, 17.8, 39.7), 0: (0.27, 1.07, 2.37, 4.11, 6.25, 8.70)},
        rounding=_cosine_rounding,
        amplified=lambda error: error + 7e-7,  # The second summand is the error of log2.
    ),
    _g_power(4, (6.96, 5.54, 2.46, 4.18, 17.8, 45.4), (6.98, 5.78, 3.79, 1.12, 2.55, 6.64)),
    _g_power(8, (3.11, 1.68, 1.43, 7.79, 20.9, 46.9), (3.13, 1.92, 0.12, 2.83, 6.25, 10.25)),
    _g_power(16, (1.31, 0.13, 3.21, 9.50, 22.3, 47.6), (1.32, 0.12, 1.88, 4.60, 7.99, 11.9)),
    Lobe(
        name="fitted",
        number=3,
        file="lobe/fitted",
        call="fr_lobe_fitted(c, m, k)",
        evaluate=fitted,
        ends=_ENDS,
        errors={4: (0.19,), 0: (0.13,)},
        rounding=partial(_fitted_rounding, name="fitted"),
        constants=("FR_FITTED_COEFFICIENTS", fitted_coefficients),
    ),
    Lobe(
        name="fitted-fine",
        number=5,
        file="lobe/fitted",
        call="fr_lobe_fitted_fine(c, m, k)",
        evaluate=fitted_fine,
        ends=_ENDS,
        errors={4: (0.04,), 0: (0.04,)},
        rounding=partial(_fitted_rounding, name="fitted-fine"),
        constants=("FR_FITTED_FINE_COEFFICIENTS", fitted_fine_coefficients),
    ),
)

AnyLobe = str | GPower | Lobe


def lobe_entry(lobe: AnyLobe) -> Lobe:
    """Return the entry of a lobe that is given by its name, as a GPower, or as an entry."""
    if isinstance(lobe, Lobe):
        return lobe
    return _of_g_power(lobe) if isinstance(lobe, GPower) else named("lobe", LOBES, lobe)


@lru_cache(maxsize=4096)
def _of_g_power(lobe: GPower) -> Lobe:
    g, factor, offset = lobe.g, float(lobe.factor), float(lobe.offset)
    end = math.sqrt(factor / max(offset, factor / MAX_SLOPE**2))
    offset_term = f" - {offset}" if offset else ""
    entry = Lobe(
        name=str(lobe),
        number=6,
        file="lobe/g_power",
        call="fr_lobe_clamped_power(c, FR_STEEPNESS(FR_SLOPE(m), k), FR_G)",
        evaluate=lambda c, m, k: clamped_power(c, factor / entry.check(m, k) ** 2 - offset, g),
        ends=dict.fromkeys(TITLES, end),
        rounding=lambda c, m, k: _g_power_rounding(c, m, k, g, factor, offset),
        amplified=lambda error: error * factor * g / 2.0,
        macro="FR_LOBE_G_POWER",
        macros={"FR_G": str(g), "FR_STEEPNESS(m, k)": f"({factor} / ((m) * (m)){offset_term})"},
        price=f"g{g}",
    )
    return entry


def lobe(name: AnyLobe, c: ArrayLike, m: ArrayLike, k: int) -> Float:
    """Return the value of the lobe `name`; for the other parameters see :func:`exact`."""
    return lobe_entry(name).evaluate(c, m, k)


def max_slope(name: AnyLobe, k: int) -> float:
    """Return the upper end of a lobe's domain of m.

    The end belongs to the domain, except in Cook-Torrance for the cosine power, D4, D8 and D16:
    their exponent n = 2/m² - k must be positive.
    """
    return lobe_entry(name).end(k)


def in_domain(m: ArrayLike, name: AnyLobe, k: int) -> NDArray[np.bool_]:
    """Return whether each slope is in the domain of a lobe; see :meth:`Lobe.belongs`."""
    return lobe_entry(name).belongs(m, k)


def check_slope(m: ArrayLike, name: AnyLobe, k: int) -> Float:
    """Return m as float64, or raise InputError if a value is outside the domain of the lobe."""
    return lobe_entry(name).check(m, k)


G_POWERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24)  # Each power needs few products.


@lru_cache(maxsize=1024)
def fit_g_power(k: int, g: int, smallest: float, largest: float) -> GPower | None:
    """Return the g-power lobe that fits a range of m best; None if the range leaves the lobe's
    domain.

    For one m the lobe is the best uniform approximation of the exact lobe. For a range, least
    squares fit the steepness to the best steepness at each of five values of m.

    k : 4 for Cook-Torrance, 0 for Ward
    g : power, in 1 to 31
    smallest, largest : ends of the range of m, in the domain of the exact lobe
    """
    slopes = np.unique(np.geomspace(smallest, largest, 5)) if smallest < largest else [smallest]
    best = np.array([_steepness(k, g, m) for m in slopes])
    # Least squares minimise the relative error of steepness = factor/m² - offset.
    terms = np.stack([np.asarray(slopes) ** -2.0, -np.ones(len(slopes))], axis=-1)
    relative = terms[:, : len(slopes)] / best[:, None]  # one m determines no offset
    factor, offset = (*np.linalg.lstsq(relative, np.ones(len(slopes)), rcond=None)[0], 0.0)[:2]
    lobe = GPower(g, float(factor), float(offset))
    return lobe if in_domain([smallest, largest], lobe, k).all() else None


def _steepness(k: int, g: int, m: float) -> float:
    """Return the steepness of the g-power lobe whose largest errors above and below the exact lobe
    are equal. Bisection finds this steepness, because a steeper lobe is lower at every angle."""
    c = np.cos(np.linspace(0.0, np.arctan(5.0 * m), 800))  # The lobe is tiny at larger angles.
    target = exact(c, m, k)
    low, high = 0.0, 40.0 / (g * m * m)
    for _ in range(50):
        middle = 0.5 * (low + high)
        difference = clamped_power(c, middle, g) - target
        too_wide = difference.max() > -difference.min()
        low, high = (middle, high) if too_wide else (low, middle)
    return middle
