"""Tests the albedo of Cook-Torrance and the energy-conserving diffuse term."""

from __future__ import annotations

import numpy as np
import pytest

import facerender as fr
from facerender import InputError, brdf
from facerender.pricing.table import load_prices
from tools.fits.albedo import albedo_integral

COUPLED = fr.Shading(diffuse="coupled")


@pytest.mark.slow
def test_albedo_fit_is_slightly_above_the_integral():
    random = np.random.default_rng(1)
    cosines = random.random(80) ** 2 * 0.9996 + 4e-4
    slopes, reflectances = random.uniform(0.05, 1.0, 80), random.uniform(0.0, 0.1, 80)
    above = [
        float(brdf.cook_torrance_albedo(*at)) - albedo_integral(*at)
        for at in zip(cosines.tolist(), slopes.tolist(), reflectances.tolist(), strict=True)
    ]
    assert min(above) >= 0.0
    assert 0.008 < max(above) <= 0.0125


@pytest.mark.slow
def test_error_of_the_albedo_fit_for_a_large_f0():
    random = np.random.default_rng(5)
    cosines = random.random(60) ** 2 * 0.9996 + 4e-4
    slopes, reflectances = random.uniform(0.05, 1.0, 60), random.uniform(0.1, 1.0, 60)
    for at in zip(cosines.tolist(), slopes.tolist(), reflectances.tolist(), strict=True):
        above = float(brdf.cook_torrance_albedo(*at)) - albedo_integral(*at)
        assert -0.008 * at[2] <= above <= 0.0125 + 0.008 * at[2]


@pytest.mark.parametrize("m", [0.1, 0.3, 0.6])
def test_albedo_integral_agrees_with_sampling(m):
    """The albedo is also the mean weight of sampled directions."""
    n, v = np.array([0.0, 0.0, 1.0]), np.array([0.8, 0.0, 0.6])
    l = brdf.cook_torrance_sample(n, v, m, np.random.default_rng(0).random((100_000, 3)))
    value = brdf.cook_torrance(n, l, v, m, 0.028) * np.maximum(l[:, 2], 0.0)
    density = brdf.cook_torrance_pdf(n, l, v, m)
    weight = np.divide(value, density, out=np.zeros_like(value), where=value > 0.0)
    assert weight.mean() == pytest.approx(albedo_integral(0.6, m, 0.028), rel=0.01)


@pytest.mark.first_case
@pytest.mark.parametrize("second", [None, 0.12])
@pytest.mark.parametrize("m", [0.05, 0.15, 0.3, 0.6, 1.0])
def test_both_terms_conserve_energy(m, second):
    """The sum of both terms over all light directions is at most 1 for a white surface."""
    f0, share = 0.05, 1.0 if second is None else 0.7
    lobes = [(m, share), (second or m, 1.0 - share)]

    def albedo(cosine):
        return sum(w * brdf.cook_torrance_albedo(cosine, each, f0) for each, w in lobes)

    x, weight = np.polynomial.legendre.leggauss(64)
    cosines, weight = 0.5 * (x + 1.0), 0.5 * weight
    mean = sum(w * brdf.cook_torrance_albedo_mean(each, f0) for each, w in lobes)
    for n_dot_v in (0.02, 0.1, 0.3, 0.6, 0.9, 1.0):
        left = brdf.diffuse_coupled(albedo(cosines), albedo(n_dot_v), mean)
        diffuse = (2.0 * weight * cosines * left).sum()
        specular = sum(w * albedo_integral(n_dot_v, each, f0, 64) for each, w in lobes)
        assert 0.98 < diffuse + specular <= 1.0 + 1e-3
        assert 1.0 + specular > 1.0 + 1e-3  # the sum without coupling


def test_coupled_term_without_specular_weight_is_lambert(renderer, head):
    scene = fr.Scene(head.with_material(ks=0.0))
    images = [renderer.render(scene, each).linear for each in (fr.Shading(), COUPLED)]
    np.testing.assert_array_equal(*images)


def test_lambert_is_the_default_and_others_are_refused():
    assert "diffuse" not in fr.Shading().as_dict()
    with pytest.raises(InputError, match="unknown diffuse term 'oren'; known: lambert, coupled"):
        fr.Shading(diffuse="oren")


def test_coupled_term_has_a_price(head):
    scene = fr.Scene(head.with_material(ks=1e-3, normal_map=None), fr.Camera(35.0))
    for kind in ("navi21", "vega10", "llvmpipe"):
        prices = load_prices(kind, scene, [])
        dear, cheap = (prices.cost(scene, each)[0] for each in (COUPLED, fr.Shading()))
        assert dear > cheap
