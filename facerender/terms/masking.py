"""Masking and shadowing of microfacets: registry entries and float64 references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.terms.entry import Entry, registry

Float = NDArray[np.float64]

MIN_COSINE = 1e-6  # Value of FR_MIN_COSINE in shaders/facerender/constants.glsl.


@dataclass(frozen=True, eq=False, kw_only=True)
class Masking(Entry):
    """A masking term; its macro is FR_MASKING_NAME.

    The GLSL call uses float n_dot_h, h_dot_h, n_dot_l and n_dot_v for h = l + v, not normalised.
    The call returns a vec2 (x, y) with G/((N.L)(N.V)) = x/(y h_dot_h).

    Attributes
    ----------
    number : value of the macro, unique
    cut : the BRDF is exactly 0 if N.L or N.V is at most this cosine
    evaluate : G in float64 as a function of n_dot_h, v_dot_h, n_dot_l, n_dot_v, for a unit half
        vector
    """

    number: int
    cut: float = 0.0
    evaluate: Callable[[Float, Float, Float, Float], Float]

    @property
    def macro(self) -> str:
        return f"FR_MASKING_{self.word}"


def masking_v_cavity(
    n_dot_h: ArrayLike, v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike
) -> Float:
    """Return the masking term of V-shaped cavities, min(1, 2 N.H N.V/V.H, 2 N.H N.L/V.H), in
    [0, 1].

    Parameters
    ----------
    n_dot_h, v_dot_h : N.H and V.H > 0 for a half vector H of any length
    n_dot_l, n_dot_v : N.L and N.V for the directions L to the light and V to the camera, in (0, 1]

    References: Torrance and Sparrow (1967); Cook and Torrance (1982).
    """
    ratio = 2.0 * np.asarray(n_dot_h, dtype=np.float64) / np.asarray(v_dot_h, dtype=np.float64)
    return np.asarray(np.minimum(1.0, ratio * np.minimum(n_dot_l, n_dot_v)))


def masking_kelemen(v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike) -> Float:
    """Return Kelemen masking (N.L)(N.V)/(V.H)², which cancels (N.L)(N.V) in the BRDF's divisor.

    The value is between 0.5 and 1 times :func:`masking_v_cavity`.

    Parameters
    ----------
    v_dot_h : cosine of the angle between the direction to the camera and the unit half vector; at
        least (N.L + N.V)/2, a condition that all unit vectors meet
    n_dot_l, n_dot_v : N.L and N.V for the directions L to the light and V to the camera, in (0, 1]

    References: Kelemen and Szirmay-Kalos (2001); for skin: d'Eon and Luebke (2007), GPU Gems 3,
    chapter 14.
    """
    product = np.multiply(n_dot_l, n_dot_v, dtype=np.float64)
    return np.asarray(product / np.asarray(v_dot_h, dtype=np.float64) ** 2)


MASKING: dict[str, Masking] = registry(
    Masking(
        name="v-cavity",
        number=0,
        file="masking/v_cavity",
        call="fr_masking_v_cavity_ratio(n_dot_h, h_dot_h, n_dot_l, n_dot_v)",
        evaluate=masking_v_cavity,
    ),
    Masking(
        name="kelemen",
        number=1,
        file="masking/kelemen",
        call="fr_masking_kelemen_ratio(n_dot_l, n_dot_v)",
        cut=MIN_COSINE,
        evaluate=lambda n_dot_h, v_dot_h, n_dot_l, n_dot_v: masking_kelemen(
            v_dot_h, n_dot_l, n_dot_v
        ),
    ),
    Masking(
        name="none",
        number=2,
        file="constants",
        call="vec2("
        "min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? h_dot_h : 0.0, abs(n_dot_l * n_dot_v) + FR_FLOOR)",
        cut=MIN_COSINE,
        evaluate=lambda n_dot_h, v_dot_h, n_dot_l, n_dot_v: np.ones_like(n_dot_h),
    ),
)
