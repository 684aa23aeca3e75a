"""Tests the float64 BRDFs (``facerender.brdf``): identities, reciprocity, limits and domains."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facerender import InputError, brdf, lobes

N = np.array([0.0, 0.0, 1.0])


def direction(theta, phi):
    """Return the unit vector at polar angle theta from N; both angles are in degrees."""
    t, p = np.radians(theta), np.radians(phi)
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t) + 0.0 * p], axis=-1)


MODELS = {
    "cook_torrance": lambda n, l, v, m, **kw: brdf.cook_torrance(n, l, v, m, 0.028, **kw),
    "ward": brdf.ward,
    "ward_printed": brdf.ward_printed,
}

angles = st.floats(0.0, 89.0)
turns = st.floats(0.0, 360.0)


@given(angles, turns, angles, st.floats(0.05, 0.7), st.sampled_from(["cook_torrance", "ward"]))
def test_reciprocity(theta_l, phi, theta_v, m, model):
    l, v = direction(theta_l, phi), direction(theta_v, 0.0)
    there, back = MODELS[model](N, l, v, m), MODELS[model](N, v, l, m)
    assert there == pytest.approx(back, rel=1e-9, abs=1e-300)


def test_ward_as_published_is_not_reciprocal():
    l, v = direction(70.0, 180.0), direction(20.0, 0.0)
    assert brdf.ward_printed(N, l, v, 0.5) != pytest.approx(brdf.ward_printed(N, v, l, 0.5))


@pytest.mark.parametrize("m", [0.1, 0.3, 0.6])
def test_values_at_normal_incidence(m):
    # Walter et al. (2007): F G D'/(4 N.L N.V) with D' = 1/(pi m^2) at N = H
    assert brdf.cook_torrance(N, N, N, m, 0.028) == pytest.approx(0.028 / (4 * np.pi * m**2))
    assert brdf.ward(N, N, N, m) == pytest.approx(1.0 / (4 * np.pi * m**2))
    assert brdf.ward_printed(N, N, N, m) == pytest.approx(brdf.ward(N, N, N, m) / np.sqrt(2.0))


def test_cook_torrance_in_the_textbook_form():
    l, v, m = direction(50.0, 130.0), direction(35.0, 10.0), 0.35
    h = (l + v) / np.linalg.norm(l + v)
    gamma = np.arccos(h @ N)
    d = np.exp(-(np.tan(gamma) ** 2) / m**2) / (np.pi * m**2 * np.cos(gamma) ** 4)
    g = min(1.0, 2 * h[2] * v[2] / (v @ h), 2 * h[2] * l[2] / (l @ h))
    f = 0.04 + 0.96 * (1.0 - v @ h) ** 5
    assert brdf.cook_torrance(N, l, v, m, 0.04) == pytest.approx(
        f * g * d / (4.0 * l[2] * v[2]), rel=1e-12
    )


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", lobes.NAMES)
def test_zero_below_the_surface_and_finite_at_the_horizon(model, name):
    l = direction(np.array([91.0, 10.0, 180.0, 90.0, 89.9999999]), 180.0)
    v = direction(np.array([10.0, 91.0, 0.0, 90.0, 89.9999999]), 0.0)
    values = MODELS[model](N, l, v, 0.3, lobe=name)
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    assert (values[:3] == 0.0).all()


def test_exact_fresnel_at_its_ends_and_at_brewsters_angle():
    assert brdf.fresnel_dielectric(0.028, 1.0) == pytest.approx(0.028)
    assert brdf.fresnel_dielectric(0.028, 0.0) == pytest.approx(1.0)
    assert (brdf.fresnel_dielectric(0.0, [0.0, 1e-9, 0.5, 1.0]) == 0.0).all()
    assert brdf.fresnel_dielectric([1e-8, 0.5], 1.0) == pytest.approx([1e-8, 0.5], rel=1e-12)
    eta = 1.5
    f0 = ((eta - 1) / (eta + 1)) ** 2
    at = np.arctan(eta)  # Brewster's angle: only perpendicular polarisation is reflected
    r = (np.cos(at) - eta * np.cos(np.pi / 2 - at)) / (np.cos(at) + eta * np.cos(np.pi / 2 - at))
    assert brdf.fresnel_dielectric(f0, np.cos(at)) == pytest.approx(0.5 * r**2)


def test_stated_error_of_schlick():
    c = np.linspace(0.0, 1.0, 20001)
    error = np.abs(brdf.fresnel_schlick(0.028, c) - brdf.fresnel_dielectric(0.028, c))
    assert error.max() == pytest.approx(0.046, abs=5e-4)
    assert np.degrees(np.arccos(c[error.argmax()])) == pytest.approx(84.0, abs=0.5)


def test_masking():
    assert brdf.masking_v_cavity(1.0, 1.0, 1.0, 1.0) == 1.0
    assert brdf.masking_v_cavity(0.9, 0.6, 0.1, 0.8) == pytest.approx(2 * 0.9 * 0.1 / 0.6)
    # The length of h must cancel.
    assert brdf.masking_v_cavity(1.8, 1.2, 0.1, 0.8) == pytest.approx(2 * 0.9 * 0.1 / 0.6)


@given(angles, turns, angles)
def test_masking_of_kelemen_is_half_to_all_of_that_of_v_cavities(theta_l, phi, theta_v):
    l, v = direction(theta_l, phi), direction(theta_v, 0.0)
    h = (l + v) / np.linalg.norm(l + v)
    ratio = brdf.masking_kelemen(v @ h, l[2], v[2]) / brdf.masking_v_cavity(h[2], v @ h, l[2], v[2])
    assert 0.5 - 1e-9 < ratio < 1.0 + 1e-9


@given(angles, turns, angles)
def test_masking_terms_within_the_brdf(theta_l, phi, theta_v):
    l, v = direction(theta_l, phi), direction(theta_v, 0.0)
    none, kelemen, v_cavity = (
        brdf.cook_torrance(N, l, v, 0.5, 0.028, masking_term=term)
        for term in ("none", "kelemen", "v-cavity")
    )
    v_dot_h = np.linalg.norm(l + v) / 2.0
    unmasked = none * l[2] * v[2]
    assert kelemen == pytest.approx(unmasked / v_dot_h**2, rel=1e-9, abs=1e-300)
    masked = brdf.masking_v_cavity((l + v)[2] / (2.0 * v_dot_h), v_dot_h, l[2], v[2])
    assert v_cavity == pytest.approx(none * masked, rel=1e-9, abs=1e-300)


def test_kelemens_masking_in_the_mirror_direction():
    for theta in (0.0, 40.0, 85.0):
        cosine = np.cos(np.radians(theta))
        assert brdf.masking_kelemen(cosine, cosine, cosine) == pytest.approx(1.0)


def test_constant_fresnel_is_its_reflectance():
    np.testing.assert_array_equal(brdf.fresnel(0.04, [0.0, 0.5, 1.0], "constant"), [0.04] * 3)
    l, v = direction(50.0, 180.0), direction(50.0, 0.0)
    constant, schlick = (
        brdf.cook_torrance(N, l, v, 0.3, 0.04, fresnel_term=term)
        for term in ("constant", "schlick")
    )
    cosine = np.cos(np.radians(50.0))
    assert schlick / constant == pytest.approx(brdf.fresnel_schlick(0.04, cosine) / 0.04)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: brdf.ward(N * 1.1, N, N, 0.3), "n holds a vector of length 1.1"),
        (lambda: brdf.ward(N, np.zeros(3), N, 0.3), "l holds a vector of length 0"),
        (lambda: brdf.ward(N, N, [1.0, 0.0], 0.3), r"v has shape \(2,\)"),
        (lambda: brdf.ward(N, N, N, 3.0), r"m = 3 is outside .* \[0.0001, 2\]"),
        (lambda: brdf.cook_torrance(N, N, N, 0.3, 1.0), r"f0 = 1 is outside \[0, 1\)"),
        (lambda: brdf.cook_torrance(N, N, N, 0.8, 0.04, lobe="d8"), "use the lobe exact"),
        (lambda: brdf.fresnel(0.04, 0.5, "metal"), "unknown Fresnel term 'metal'; known: schlick"),
        (lambda: brdf.fresnel(1.0, 0.5, "constant"), r"f0 = 1 is outside \[0, 1\)"),
        (
            lambda: brdf.cook_torrance(N, N, N, 0.3, 0.04, masking_term="smith"),
            "unknown masking term 'smith'; known: v-cavity, kelemen, none",
        ),
    ],
)
def test_values_outside_the_domain_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
