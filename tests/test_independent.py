"""Tests the float64 BRDFs against independent results: Mitsuba, and a table of albedos."""

from __future__ import annotations

import numpy as np
import pytest

from facerender import brdf, lobes
from tests.conftest import missing

N = np.array([0.0, 0.0, 1.0])
SINGLE = 2.0**-23  # Mitsuba's wheels have no variant in double precision


@pytest.fixture(scope="module")
def mi():
    try:
        import mitsuba
    except (ImportError, NameError):  # NameError if a system library is missing
        missing("no mitsuba, or not libatomic.so.1 (Debian: libatomic1), which it needs")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def eye(theta):
    """Return the unit vector at theta degrees from N."""
    t = np.radians(theta)
    return np.stack([np.sin(t), 0.0 * t, np.cos(t)], axis=-1)


def facet(p, q):
    """Return the unit normal of a microfacet with the slopes p and q."""
    h = np.stack(np.broadcast_arrays(p, q, 1.0), axis=-1)
    return h / np.linalg.norm(h, axis=-1, keepdims=True)


def mirrored(v, h):
    """Return the light direction that a facet h mirrors into v, and V.H."""
    v_dot_h = (v * h).sum(axis=-1)
    return 2.0 * v_dot_h[..., None] * h - v, v_dot_h


def without_fresnel(n, l, v, m):
    """Return Cook-Torrance with F = 1."""
    v_dot_h = 0.5 * np.linalg.norm(l + v, axis=-1)
    return brdf.cook_torrance(n, l, v, m, 0.5) / brdf.fresnel_schlick(0.5, v_dot_h)


@pytest.mark.parametrize("m", [0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0])
def test_exact_lobe_equals_that_of_mitsuba(mi, m):
    root = np.linspace(0.0, 6.0, 121)  # square root of the exponent tan² γ / m²; at 6, E = 2e-16
    beckmann = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, m)
    h = facet(0.6 * m * root, 0.8 * m * root).astype(np.float32).astype(np.float64)
    theirs = np.array([beckmann.eval(mi.Vector3f(*x)) for x in h.tolist()])
    ours = lobes.exact(h[:, 2] / np.linalg.norm(h, axis=-1), m, 4) / (np.pi * m**2)
    # Single precision: a few rounding errors of the exponent and of the other factors.
    assert (np.abs(theirs / ours - 1.0) < 4.0 * SINGLE * (1.0 + root**2)).all()


@pytest.mark.parametrize("m", [0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0])
def test_cook_torrance_equals_mitsubas_rough_conductor(mi, m):
    beckmann = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, m)
    conductor = mi.load_dict(
        {"type": "roughconductor", "distribution": "beckmann", "material": "none", "alpha": m}
    )
    context, at = mi.BSDFContext(), mi.SurfaceInteraction3f()

    def rough_conductor(l, v, h):  # D/(4 N.L N.V), without Smith's masking
        at.wi, light = mi.Vector3f(*v), mi.Vector3f(*l)
        masking = beckmann.G(at.wi, light, mi.Vector3f(*h))
        return conductor.eval(context, at, light)[0] / (masking * l[2])

    slopes = m * np.linspace(-2.0, 2.0, 9)
    v, h = np.broadcast_arrays(
        eye(np.array([0.0, 25.0, 50.0, 75.0]))[:, None, None], facet(slopes[:, None], slopes)
    )
    l, v_dot_h = mirrored(v, h)
    above = (l[..., 2] > 0.05) & (v_dot_h > 0.0)
    assert above.sum() > 80
    l, v, h, v_dot_h = l[above], v[above], h[above], v_dot_h[above]
    theirs = np.array([rough_conductor(*x) for x in np.stack([l, v, h], axis=1).tolist()])
    scale = 4.0 * l[:, 2] * v[:, 2]

    masking = brdf.masking_v_cavity(h[:, 2], v_dot_h, l[:, 2], v[:, 2])
    ours = without_fresnel(N, l, v, m) / masking
    # The rounding error of h is about SINGLE, so the error of tan γ / m is SINGLE / m.
    tolerance = 16.0 * SINGLE * (1.0 + 1.0 / m)
    np.testing.assert_allclose(theirs, ours, rtol=tolerance)
    np.testing.assert_allclose(
        theirs * scale, lobes.exact(h[:, 2], m, 4) / (np.pi * m**2), rtol=tolerance
    )


ANGLES = np.array([0.0, 30.0, 60.0, 75.0, 80.0, 85.0, 88.0, 89.0, 89.9])  # of the camera, degrees
SLOPES = np.array([0.1, 0.2, 0.3, 0.5])
# Rows are for SLOPES, columns for ANGLES; computed without this package.
ALBEDOS = {
    "cook_torrance": [
        [1.0000, 1.0000, 0.9991, 0.9699, 0.9417, 0.9375, 0.9683, 0.9836, 0.9984],
        [1.0000, 0.9989, 0.9656, 0.9275, 0.9339, 0.9598, 0.9830, 0.9914, 0.9990],
        [0.9956, 0.9812, 0.9248, 0.9273, 0.9449, 0.9702, 0.9878, 0.9939, 0.9993],
        [0.8924, 0.8750, 0.8869, 0.9344, 0.9551, 0.9772, 0.9908, 0.9954, 0.9996],
    ],
    "ward": [
        [0.9711, 0.8416, 0.4890, 0.2595, 0.1836, 0.1196, 0.1002, 0.1099, 0.2702],
        [0.8949, 0.7773, 0.4589, 0.2692, 0.2162, 0.1816, 0.1969, 0.2421, 0.6702],
        [0.7939, 0.6911, 0.4223, 0.2799, 0.2451, 0.2335, 0.2808, 0.3597, 1.0369],
        [0.5855, 0.5144, 0.3507, 0.2772, 0.2665, 0.2862, 0.3763, 0.4985, 1.4836],
    ],
    "ward_printed": [
        [0.6808, 0.5499, 0.2455, 0.0983, 0.0606, 0.0323, 0.0207, 0.0177, 0.0156],
        [0.6134, 0.4986, 0.2342, 0.1115, 0.0803, 0.0555, 0.0441, 0.0410, 0.0386],
        [0.5275, 0.4330, 0.2200, 0.1223, 0.0964, 0.0747, 0.0643, 0.0613, 0.0591],
        [0.3642, 0.3090, 0.1861, 0.1260, 0.1087, 0.0935, 0.0859, 0.0837, 0.0820],
    ],
}
MODELS = {
    "cook_torrance": without_fresnel,
    "ward": brdf.ward,
    "ward_printed": brdf.ward_printed,
}


def gauss(count):
    """Return Gauss-Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1.0), 0.5 * w


def albedo(model, theta, m):
    """Return the integral of f N.L over all light directions, for a camera at theta degrees.

    The facets that mirror light from above the surface to the camera have slopes (p, q) in the disk
    of radius 1/cos θ about (tan θ, 0). The integral over the disk, limited to 5 m, uses Gauss-
    Legendre quadrature with 32 nodes for half of q and 192 for p. The nodes of p are denser at the
    edge where N.L = 0, since the integrand has narrow kinks there near grazing angles.
    """
    (x, x_weight), (y, y_weight) = gauss(192), gauss(32)
    x, x_weight = x**2, 2.0 * x * x_weight
    v, m = eye(theta)[..., None, None, :], np.asarray(m)[..., None, None]
    sin, cos = v[..., 0], v[..., 2]
    end = np.minimum(5.0 * m, 1.0 / cos)
    q = end * y[:, None]
    root = np.sqrt(1.0 - (cos * q) ** 2)
    low = np.maximum(cos * (q**2 - 1.0) / (sin + root), -5.0 * m)  # (sin - root)/cos
    high = np.minimum((sin + root) / cos, 5.0 * m)
    h = facet(low + (high - low) * x, q)
    l, v_dot_h = mirrored(v, h)
    # dω of the light is 4 V.H times dω of h, which is cos³ dp dq.
    values = model(N, l, v, m) * l[..., 2].clip(0.0) * 4.0 * v_dot_h * h[..., 2] ** 3
    return (values * 2.0 * end * y_weight[:, None] * (high - low) * x_weight).sum(axis=(-1, -2))


@pytest.mark.parametrize("name", MODELS)
def test_directional_albedo(name):
    # The table is rounded to 5e-5, and the quadrature error is 4e-5. The table's Cook-Torrance at
    # 89.9 degrees has a further error of 1e-4.
    expected = np.array(ALBEDOS[name])
    result = albedo(MODELS[name], ANGLES, SLOPES[:, None])
    np.testing.assert_allclose(result[:, :-1], expected[:, :-1], rtol=0, atol=1e-4)
    np.testing.assert_allclose(result[:, -1], expected[:, -1], rtol=0, atol=2e-4)


@pytest.mark.slow
def test_cook_torrance_reflects_no_more_than_it_receives():
    theta = 90.0 - np.geomspace(0.1, 90.0, 25)
    for m in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0):
        assert albedo(without_fresnel, theta, m).max() < 1.0 + 1e-4, m
