"""Light between points of a surface, in float64: subsurface scattering, the reference for
``shaders/facerender/scatter.glsl``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, quoted

Float = NDArray[np.float64]

_TURN = 2.39996323  # Golden angle between consecutive samples of a spiral, in radians.

Gaussians = tuple[tuple[float, float, float, float], ...]  # Variance in mm^2; RGB weights.

# Named profiles of materials. "skin" models three layers: d'Eon and Luebke (2007), GPU Gems 3,
# chapter 14.
PROFILES: dict[str, Gaussians] = {
    "skin": (
        (0.0064, 0.233, 0.455, 0.649),
        (0.0484, 0.100, 0.336, 0.344),
        (0.187, 0.118, 0.198, 0.0),
        (0.567, 0.113, 0.007, 0.007),
        (1.99, 0.358, 0.004, 0.0),
        (7.41, 0.078, 0.0, 0.0),
    )
}
MAX_GAUSSIANS = 16  # Largest number of Gaussians in a profile.
MAX_VARIANCE = 1e4  # Largest variance of a Gaussian, in mm^2.
NARROW = 0.5  # Standard deviation in pixels; narrower Gaussians are left out.
_CENTER = 1e-3  # Weight of the pixel itself, so that the sum of the weights is never 0.
_WORD = 1 << 32  # Number of values of GLSL's uint.
_LAST = 0.98  # Largest sampled quantile of the radii; samples farther away would add noise.


def profile_of(profile: Any) -> str | Gaussians:
    """Return a material's scattering profile as a name in PROFILES or as Gaussians."""
    if isinstance(profile, str):
        if profile not in PROFILES:
            names = ", ".join((*PROFILES, "none"))
            raise InputError(f"unknown scattering {quoted(profile)}; known: {names}")
        return profile
    try:
        rows = tuple((float(v), float(r), float(g), float(b)) for v, r, g, b in profile)
    except (TypeError, ValueError, OverflowError):
        rows = ()
    variances, weights = _columns(rows)
    in_range = (variances > 0.0) & (variances <= MAX_VARIANCE)
    if not 0 < len(variances) <= MAX_GAUSSIANS or not in_range.all():
        numbers = f"a variance in (0, {MAX_VARIANCE:g}] mm^2 and weights of red, green and blue"
        remedy = f"give a name, or 1 to {MAX_GAUSSIANS} Gaussians, each as {numbers}"
        raise InputError(f"scattering = {quoted(profile)}: {remedy}")
    if not ((weights >= 0.0).all() and (weights.sum(axis=0) <= 1.0 + 1e-6).all()):
        remedy = "give weights of at least 0 whose sum in each channel is at most 1"
        raise InputError(f"scattering = {quoted(profile)}: {remedy}")
    return rows


def wide_gaussians(profile: str | Gaussians, pixel: float) -> Gaussians:
    """Return a profile's Gaussians that are wider than half a pixel of a size in millimetres."""
    gaussians = PROFILES[profile] if isinstance(profile, str) else profile
    narrow = (NARROW * pixel) ** 2
    return tuple(gaussian for gaussian in gaussians if gaussian[0] >= narrow and any(gaussian[1:]))


def scatter_profile(r2: ArrayLike, gaussians: Gaussians) -> Float:
    """Return the fraction of light, per mm^2, that leaves at a distance from its entry, (..., 3),
    from the squared distance r2 in mm^2, >= 0, of any shape."""
    variance, weight = _columns(gaussians)
    falloff = np.exp(-np.asarray(r2, dtype=np.float64)[..., None] / (2.0 * variance))
    return np.asarray((falloff / (2.0 * math.pi * variance)) @ weight, dtype=np.float64)


def rest(gaussians: Gaussians) -> Float:
    """Return the fraction of light in each channel that the Gaussians do not scatter, (3,)."""
    return np.asarray(np.maximum(1.0 - _columns(gaussians)[1].sum(axis=0), 0.0))


@lru_cache(maxsize=64)
def spiral(gaussians: Gaussians, samples: int) -> Float:
    """Return, for each sample around a pixel, its offset in mm and its 1/density in mm^2. The shape
    is (samples, 3). The radii are distributed like the profile of the channel that scatters
    farthest."""
    variance, weight = _columns(gaussians)
    share = weight[:, int(np.argmax(variance @ weight / np.maximum(weight.sum(axis=0), 1e-30)))]
    share = share / share.sum()
    radius = np.sqrt(variance.max()) * np.linspace(0.0, 1.0, 8193) ** 2 * 8.0
    below = 1.0 - np.exp(-(radius[:, None] ** 2) / (2.0 * variance)) @ share
    index = np.arange(samples)
    r = np.interp(_LAST * (index + 0.5) / samples, below, radius)
    density = (np.exp(-(r[:, None] ** 2) / (2.0 * variance)) / (2.0 * math.pi * variance)) @ share
    angle = _TURN * index
    return np.stack([r * np.cos(angle), r * np.sin(angle), 1.0 / density], axis=-1)


def scatter_uniforms(gaussians: Gaussians, samples: int, unit: float = 1.0) -> dict[str, Float]:
    """Return the arguments "gaussians", "rest" and "spiral" of ``fr_scatter``.

    gaussians : result of :func:`wide_gaussians`; their number is FR_SCATTER_GAUSSIANS
    samples : FR_SCATTER_SAMPLES
    unit : millimetres per unit of length in the shader
    """
    variance, weight = _columns(gaussians)
    doubled = 2.0 * variance[:, None] / unit**2
    return {
        "gaussians": np.hstack([weight / (math.pi * doubled), -math.log2(math.e) / doubled]),
        "rest": rest(gaussians),
        "spiral": spiral(gaussians, samples) / (unit, unit, unit**2),
    }


def scatter_area(c: ArrayLike) -> Float:
    """Return the surface area that a pixel shows for N.V = c, in [-1, 1], relative to the area if
    the surface faced the camera."""
    return np.asarray(1.0 / np.maximum(np.abs(np.asarray(c, dtype=np.float64)), 0.2))


def scatter_turn(x: ArrayLike, y: ArrayLike) -> Float:
    """Return the rotation angle of a pixel's samples, in [-pi, pi], for column x and row y."""
    column, row = (np.asarray(coordinate, dtype=np.int64) for coordinate in (x, y))
    inner = (column * 288237660 + row * 25070368) % _WORD
    outer = (inner * 53 - inner // 59) % _WORD
    return np.asarray((outer // 256 - 8388608) * (math.pi / 8388608.0))


def scatter(
    light: Float, positions: Float, profiles: NDArray[Any], area: Float, pixels: NDArray[np.bool_],
    *, scale: Float, unit: float, gaussians: Gaussians, samples: int,
) -> Float:  # fmt: skip
    """Return the irradiance of N pixels after scattering, (N, 3).

    light : irradiance (H, W, 3)
    positions : (H, W, 3)
    profiles : profile indices (H, W), equal for surfaces that scatter into each other
    area : result of :func:`scatter_area`, (H, W)
    pixels : mask of the N pixels, (H, W)
    scale : pixels per millimetre, (N,)
    unit : millimetres per unit of the positions
    gaussians : Gaussians of the profile
    samples : number of samples per pixel
    """
    height, width = profiles.shape
    y, x = np.nonzero(pixels)
    entered, position, profile = light[pixels], positions[pixels], profiles[pixels]
    turn = scatter_turn(x, y)
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    norm = np.full_like(entered, _CENTER)
    sum_ = norm * entered
    for across, up, weight in spiral(gaussians, samples):
        column = np.floor(x + 0.5 + cosine * across - sine * up).astype(np.int64)
        row = np.floor(y + 0.5 + sine * across + cosine * up).astype(np.int64)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        neighbour = row.clip(0, height - 1), column.clip(0, width - 1)
        offset = positions[neighbour] - position
        same = inside & (profiles[neighbour] == profile)
        r2 = unit**2 * np.einsum("ij,ij->i", offset, offset)
        share = (weight * area[neighbour] * same)[:, None] * scatter_profile(r2, gaussians)
        sum_ += share * light[neighbour]
        norm += share
    stays = rest(gaussians)
    return np.asarray(stays * entered + (1.0 - stays) * sum_ / norm)


def _columns(gaussians: Sequence[Sequence[float]]) -> tuple[Float, Float]:
    values = np.array(gaussians, dtype=np.float64).reshape(-1, 4)
    return values[:, 0], values[:, 1:]
