"""The one-dimensional lobe E/c^k and its approximations, in float64: the reference for
``shaders/facerender/lobe``. BRDFs are in ``brdf.py``; nothing here knows vectors or OpenGL.

Both models need the same function, the slope factor E = exp(-tan² γ / m²) over a power of
c = cos γ: k = 4 in Cook-Torrance, k = 0 in Ward. Every function here has its peak, 1, at c = 1;
the model multiplies by its scale. ``lobes.f`` is ``fr_lobe_f`` in GLSL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError

Lobe = Literal["exact", "cosine", "d4", "d8", "d16", "fitted", "fitted-fine"]

NAMES: tuple[Lobe, ...] = ("exact", "cosine", "d4", "d8", "d16", "fitted", "fitted-fine")
MIN_SLOPE = 1e-4
MAX_SLOPE = 2.0
_POWERS = {"d4": 4, "d8": 8, "d16": 16}
_MODELS = {4: "Cook-Torrance", 0: "Ward"}


@dataclass(frozen=True)
class PowerPolynomial:
    """The lobe max(P(u), 0)^power with P = 1 + a₁ u + a₂ u² + ..., u = 1 - cos γ.

    Attributes
    ----------
    power : of the clamped polynomial
    max_slope : upper end of the domain of m
    table : row j holds the factors of m^(2j) in a₁ m², a₂ m⁴, a₃ m⁶, ...
    """

    power: int
    max_slope: float
    table: tuple[tuple[float, ...], ...]

    def coefficients(self, m: ArrayLike) -> NDArray[np.float64]:
        """Return a₁, a₂, ... at slopes m of shape (...), as (..., degree)."""
        w = np.asarray(m, dtype=np.float64)[..., None] ** 2
        table = np.array(self.table)
        scaled = sum(row * w**j for j, row in enumerate(table))
        return np.asarray(scaled / w ** np.arange(1, table.shape[1] + 1))

    def __call__(self, u: ArrayLike, m: ArrayLike) -> NDArray[np.float64]:
        """Evaluate at u and m, which broadcast; no check of their domains."""
        x = np.asarray(u, dtype=np.float64)
        p = np.zeros(np.broadcast(x, m).shape)
        for a in np.moveaxis(self.coefficients(m), -1, 0)[::-1]:
            p = (p + a) * x
        return np.maximum(1.0 + p, 0.0) ** self.power


@dataclass(frozen=True)
class GPower:
    """The g-power with g and steepness free: max(1 - s (1 - cos γ), 0)^g, s = factor/m² - offset.

    Parameters
    ----------
    g : in 1 to 31; the paper's lobes have 4, 8, 16, the factor 2/g and the offset k/g
    factor : > 0
    offset : the lobe's domain ends where s = 0

    Raises
    ------
    InputError : a value outside its domain

    References: Romanyuk et al. (2020); Lyon (1993) for the clamp.
    """

    g: int
    factor: float
    offset: float = 0.0

    def __post_init__(self) -> None:
        whole = isinstance(self.g, (int, np.integer)) and not isinstance(self.g, bool)
        if not whole or not 1 <= self.g <= 31:
            raise InputError(f"g = {self.g} is no whole number in 1 to 31")
        if not 0.0 < self.factor < math.inf:
            raise InputError(f"factor = {self.factor:g} of the g-power is not in (0, inf)")
        if not math.isfinite(self.offset):
            raise InputError(f"offset = {self.offset:g} of the g-power is not finite")

    def __str__(self) -> str:
        sign = "-" if self.offset > 0.0 else "+"
        offset = f" {sign} {abs(self.offset):.5g}" if self.offset else ""
        return f"g-power {self.g} ({self.factor:.5g}/m^2{offset})"


AnyLobe = Lobe | GPower

# The same constants stand in shaders/facerender/lobe/fitted.glsl.
FITTED: dict[tuple[str, int], PowerPolynomial] = {
    ("fitted", 4): PowerPolynomial(
        5,
        0.7,
        (
            (-0.39700398, 0.07498738, -0.0060935954),
            (0.6738297, -0.58629695, 0.0026217349),
            (0.71936623, -1.6754473, 1.1615276),
            (-1.0351326, 4.1195317, -5.0082767),
        ),
    ),
    ("fitted", 0): PowerPolynomial(
        5,
        1.0,
        (
            (-0.40198098, 0.083526049, -0.010091574),
            (-0.020725706, -0.49894731, 0.08771378),
            (0.077372606, -0.42975123, 0.18764888),
            (-0.067503089, 0.51304211, -1.5410764),
        ),
    ),
    ("fitted-fine", 4): PowerPolynomial(
        8,
        0.7,
        (
            (-0.24963107, 0.030319915, -0.0020734921, 0.0),
            (0.50360702, -0.52566283, 0.15216287, -0.017956779),
            (-0.013824908, 0.50565452, -0.92452698, 0.030042244),
            (-0.081719136, 0.47515006, -1.4199605, 1.6944034),
            (0.19363848, -1.434821, 4.5145226, -5.6548034),
        ),
    ),
    ("fitted-fine", 0): PowerPolynomial(
        8,
        1.0,
        (
            (-0.24950537, 0.029811221, -0.0017648837, 0.0),
            (0.0018034024, -0.38853178, 0.14142554, -0.024093986),
            (-0.0076809275, 0.078399249, -0.74785186, 0.058197197),
            (-0.0071770924, 0.063575568, -0.40797551, 1.0990611),
            (0.015975844, -0.20239128, 1.087785, -2.6305629),
        ),
    ),
}


def max_slope(name: str | GPower, k: int) -> float:
    """Return the upper end of a lobe's domain of m.

    It belongs to the domain but for the cosine power and the g-powers in Cook-Torrance, whose
    exponent n = 2/m² - k must be positive.
    """
    if not isinstance(name, GPower) and name not in NAMES:
        raise InputError(f"unknown lobe {name!r}; known: {', '.join(NAMES)}")
    if k not in _MODELS:
        raise InputError(f"k = {k} is neither 4 (Cook-Torrance) nor 0 (Ward)")
    if isinstance(name, GPower):
        return math.sqrt(name.factor / max(name.offset, name.factor / MAX_SLOPE**2))
    if (name, k) in FITTED:
        return FITTED[name, k].max_slope
    return MAX_SLOPE if name == "exact" or k == 0 else math.sqrt(2.0 / k)


def in_domain(m: ArrayLike, name: str | GPower, k: int) -> NDArray[np.bool_]:
    """Tell which slopes lie in the lobe's domain, to a millionth at ends that belong to it: a
    G-buffer holds m as float32.

    Raises
    ------
    InputError : an unknown lobe, or k neither 4 nor 0
    """
    slope = np.asarray(m, dtype=np.float64)
    end = max_slope(name, k)
    below_end = slope <= end * (1.0 + 1e-6) if _end_belongs(name, k) else slope < end
    return np.asarray((slope >= MIN_SLOPE * (1.0 - 1e-6)) & below_end)


def check_slope(m: ArrayLike, name: str | GPower, k: int) -> NDArray[np.float64]:
    """Return m as float64, or raise InputError when a value lies outside the lobe's domain."""
    slope = np.asarray(m, dtype=np.float64)
    inside = in_domain(slope, name, k)
    if not inside.all():
        bracket = "]" if _end_belongs(name, k) else ")"
        remedy = (
            ""
            if max_slope(name, k) == MAX_SLOPE
            else ", or use the lobe exact (facerender render: --outside exact)"
        )
        raise InputError(
            f"m = {slope[~inside].flat[0]:g} is outside the domain of lobe {name} for "
            f"{_MODELS[k]}: give m in [{MIN_SLOPE:g}, {max_slope(name, k):.4g}{bracket}{remedy}"
        )
    return slope


def _end_belongs(name: str | GPower, k: int) -> bool:
    return isinstance(name, GPower) or name == "exact" or k == 0 or (name, k) in FITTED


def _check_cosine(c: ArrayLike) -> NDArray[np.float64]:
    cosine = np.asarray(c, dtype=np.float64)
    inside = (cosine >= 0.0) & (cosine <= 1.0)
    if not inside.all():
        raise InputError(f"cosine {cosine[~inside].flat[0]:g} is outside [0, 1]")
    return cosine


def _exact(tan2: NDArray[np.floating], m: NDArray[np.float64], k: int) -> NDArray[np.float64]:
    # A relative error e of the exponent x becomes e x in the result, and x reaches 690 before
    # the result leaves float64: extended precision, where the platform has it, keeps 1e-13.
    exponent = tan2 / np.asarray(m, dtype=np.longdouble) ** 2
    exponent = np.minimum(exponent, 1e4)  # exp(-1e4) is 0, and infinity - infinity is not
    head = exponent.astype(np.float64)
    tail = (exponent - head).astype(np.float64)
    slope_factor = np.exp(-head) * np.exp(-tail)
    sec2 = 1.0 + np.minimum(tan2, 1e100).astype(np.float64)  # E is 0 long before
    return np.asarray(slope_factor * sec2 ** (k // 2), dtype=np.float64)


def exact_tan2(tan2: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate E/c^k from the squared tangent of the angle between normal and half vector.

    Parameters
    ----------
    tan2 : tan² γ, >= 0, infinity allowed; any shape
    m : rms slope of the microfacets, in [1e-4, 2]; broadcasts with tan2
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : tan2 or m outside its domain

    References: Beckmann and Spizzichino (1963); Cook and Torrance (1982); Ward (1992), eq. 4.
    """
    slope = check_slope(m, "exact", k)
    t = np.asarray(tan2, dtype=np.float64)
    if not (t >= 0.0).all():
        raise InputError(f"tan2 = {t[~(t >= 0.0)].flat[0]:g} is negative or not a number")
    return _exact(t.astype(np.longdouble), slope, k)


def exact(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate E/c^k from the cosine of the angle between normal and half vector.

    Relative error at most 1e-13 where the result is above 1e-300 and ``numpy.longdouble`` has 64
    bits of mantissa or more; 5e-13 elsewhere.

    Parameters
    ----------
    c : cos γ, in [0, 1]; any shape
    m : rms slope of the microfacets, in [1e-4, 2]; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : c or m outside its domain
    """
    slope = check_slope(m, "exact", k)
    x = _check_cosine(c).astype(np.longdouble)
    with np.errstate(divide="ignore"):
        tan2 = (1.0 - x) * (1.0 + x) / (x * x)
    return _exact(tan2, slope, k)


def cosine(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Approximate E/c^k by c^n, n = 2/m² - k.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    m : rms slope, in [1e-4, sqrt(2/k)), at most 2; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : c or m outside its domain

    References: Romanyuk et al. (2020), section 3.
    """
    slope = check_slope(m, "cosine", k)
    return np.asarray(_check_cosine(c) ** (2.0 / slope**2 - k), dtype=np.float64)


def g_power(c: ArrayLike, m: ArrayLike, k: int, g: int) -> NDArray[np.float64]:
    """Approximate E/c^k by one clamped linear factor to the power g, max((n/g)(c - 1) + 1, 0)^g.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    m : rms slope, in [1e-4, sqrt(2/k)), at most 2; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward
    g : 4, 8 or 16

    Raises
    ------
    InputError : c, m or g outside its domain

    References: Romanyuk et al. (2020), D4, D8, D16; Lyon (1993) for the clamp.
    """
    if g not in _POWERS.values():
        raise InputError(f"g = {g} is none of {', '.join(map(str, _POWERS.values()))}")
    n = 2.0 / check_slope(m, f"d{g}", k) ** 2 - k
    return clamped_power(c, n / g, g)


def clamped_power(c: ArrayLike, steepness: ArrayLike, g: int) -> NDArray[np.float64]:
    """Evaluate max(1 - s (1 - c), 0)^g, which g-powers are made of.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    steepness : s, >= 0; broadcasts with c
    g : in 1 to 31

    Raises
    ------
    InputError : c outside its domain

    References: Lyon (1993).
    """
    base = 1.0 - np.asarray(steepness, dtype=np.float64) * (1.0 - _check_cosine(c))
    return np.asarray(np.maximum(base, 0.0) ** g)


def fitted(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Approximate E/c^k by a cubic to the power 5: at most 0.19 % of the peak off for
    Cook-Torrance, 0.13 % for Ward, at every angle and slope.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    m : rms slope, in [1e-4, 0.7] for Cook-Torrance, to 1 for Ward; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : c or m outside its domain

    References: Lyon (1993) for the clamped power; the constants are ``fitting.py``'s.
    """
    return _power_polynomial("fitted", c, m, k)


def fitted_fine(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Approximate E/c^k by a quartic to the power 8: at most 0.04 % of the peak off.

    Parameters, errors and references as in :func:`fitted`.
    """
    return _power_polynomial("fitted-fine", c, m, k)


def fitted_coefficients(m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Return the factors (..., 3) of u, u², u³, with u = 1 - c, in the cubic of :func:`fitted`.

    Raises
    ------
    InputError : m outside the domain of :func:`fitted`
    """
    slope = check_slope(m, "fitted", k)
    return FITTED["fitted", k].coefficients(slope)


def fitted_fine_coefficients(m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Return the factors (..., 4) of u to u⁴ in the quartic of :func:`fitted_fine`.

    Raises
    ------
    InputError : m outside the domain of :func:`fitted_fine`
    """
    slope = check_slope(m, "fitted-fine", k)
    return FITTED["fitted-fine", k].coefficients(slope)


def _power_polynomial(
    name: Literal["fitted", "fitted-fine"], c: ArrayLike, m: ArrayLike, k: int
) -> NDArray[np.float64]:
    slope = check_slope(m, name, k)
    return FITTED[name, k](1.0 - _check_cosine(c), slope)


def lobe(name: AnyLobe, c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate the named lobe; parameters as in :func:`exact` and the function of that name."""
    slope = check_slope(m, name, k)
    if isinstance(name, GPower):
        return clamped_power(c, name.factor / slope**2 - name.offset, name.g)
    if name == "exact":
        return exact(c, m, k)
    if name == "cosine":
        return cosine(c, m, k)
    if name == "fitted" or name == "fitted-fine":
        return _power_polynomial(name, c, m, k)
    return g_power(c, m, k, _POWERS[name])
