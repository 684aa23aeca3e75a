"""Tests the float64 lobes (``facerender.lobes``): 50-digit references, the errors stated in shader
headers, domains and fits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facerender import InputError, lobes
from facerender.lobes import GPower
from facerender.terms.lobe import fit_g_power
from tools.fits.lobes import _Programs, fit

REFERENCE = np.genfromtxt(Path(__file__).parent / "data/beckmann_reference.csv", delimiter=",")
C, M, D, W, LOG_D = REFERENCE.T


@pytest.mark.parametrize(
    ("k", "scale", "expected"),
    [(4, np.pi * M**2, D), (0, 4.0 * np.pi * M**2, W)],
    ids=["cook-torrance", "ward"],
)
def test_exact_agrees_with_50_digits(k, scale, expected):
    normal = expected > 1e-300
    assert normal.sum() > 100
    result = np.array([lobes.exact(c, m, k) for c, m in zip(C, M, strict=True)]) / scale
    np.testing.assert_allclose(result[normal], expected[normal], rtol=1e-13, atol=0)
    assert (result[~normal] <= 1e-299).all()


def test_exact_from_tangent_agrees_with_exact_from_cosine():
    c = np.linspace(0.05, 1.0, 1001)
    tan2 = (1.0 - c) * (1.0 + c) / c**2
    for k in (0, 4):
        np.testing.assert_allclose(
            lobes.exact_tan2(tan2, 0.3, k), lobes.exact(c, 0.3, k), rtol=1e-12, atol=1e-300
        )


# Approximations whose errors the registry states for six slopes.
STATED = [
    (k, name)
    for name, lobe in lobes.LOBES.items()
    for k, errors in (lobe.errors or {}).items()
    if len(errors) == 6
]


@pytest.mark.parametrize(("k", "name"), STATED)
def test_stated_errors_of_the_approximations(k, name):
    """Errors are in percent of the peak over 0 to 90 degrees for m = 0.1 to 0.6, as in the headers
    of the shader files."""
    assert len(STATED) == 8
    c = np.cos(np.linspace(0.0, np.pi / 2, 20001)).clip(0.0, 1.0)
    stated = lobes.LOBES[name].errors[k]
    for m, most in zip((0.1, 0.2, 0.3, 0.4, 0.5, 0.6), stated, strict=True):
        error = 100.0 * np.abs(lobes.lobe(name, c, m, k) - lobes.exact(c, m, k)).max()
        assert error == pytest.approx(most, rel=0.005, abs=0.005), m


@settings(max_examples=50)
@given(
    name=st.sampled_from([*lobes.NAMES, GPower(7, 0.3, 0.5)]),
    k=st.sampled_from([0, 4]),
    m=st.floats(1e-4, 0.7),
    c=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=20),
)
def test_every_lobe_rises_with_the_cosine_from_zero_to_one(name, k, m, c):
    values = lobes.lobe(name, np.sort([*c, 1.0]), m, k)
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    assert (np.diff(values) >= -1e-12).all()
    assert values[-1] == 1.0


@pytest.mark.parametrize(("name", "k"), lobes.FITTED)
def test_fitted_lobes_keep_their_bound_between_the_points_of_the_fit(name, k):
    (stated,) = lobes.LOBES[name].errors[k]
    # 20 times as many slopes and angles as in the fit; errors in % of the peak.
    slopes = np.array([1e-4, 1e-3, *np.linspace(0.01, lobes.max_slope(name, k), 720)])
    for m in np.array_split(slopes[:, None], 60):
        angle = np.where(m > 0.2, np.pi / 2, 8.0 * m) * np.linspace(0.0, 1.0, 1200)
        value = lobes.FITTED[name, k](2.0 * np.sin(angle / 2.0) ** 2, m)
        exact = lobes.exact_tan2(np.tan(angle.clip(0, 1.5707963)) ** 2, m, k)
        assert 100.0 * np.abs(value - exact).max() < stated, m
        assert np.diff(value).max() <= 0.0, m
        assert (value[:, 0] == 1.0).all()


def test_fit_finds_the_optimum_of_one_slope():
    # Global optima for g = 4 and 8, from an independent bisection with finer grids.
    for k, power, degree, m, optimum in (
        (4, 4, 3, 0.3, 0.1571), (4, 4, 3, 0.5, 0.1342), (0, 4, 3, 0.4, 0.1634),
        (4, 8, 3, 0.6, 0.102), (0, 8, 4, 0.4, 0.008),
    ):  # fmt: skip
        found, error = fit(k, power, degree, m)
        assert 100.0 * error == pytest.approx(optimum, rel=0.02, abs=0.0006)
        c = np.cos(np.linspace(0.0, np.pi / 2, 5001)).clip(0.0)
        dense = np.abs(found(1.0 - c, m) - lobes.exact(c, m, k)).max()
        assert dense == pytest.approx(error, rel=0.03)


@pytest.mark.parametrize(("name", "k"), lobes.FITTED)
def test_constants_are_as_good_as_a_new_fit(name, k):
    lobe = lobes.FITTED[name, k]
    slopes = np.linspace(0.01, lobe.max_slope, 12)
    c = np.cos(np.linspace(0.0, np.pi / 2, 2001)).clip(0.0)
    ours = np.abs(lobe(1.0 - c, slopes[:, None]) - lobes.exact(c, slopes[:, None], k)).max()
    programs = _Programs.of(k, lobe.power, len(lobe.table[0]), slopes, len(lobe.table) - 1)
    assert programs.constants_within(ours / 1.15) is None
    assert programs.constants_within(ours / 0.97) is not None


def test_impossible_fit_is_refused():
    with pytest.raises(InputError, match="no monotone fit of power 5 for m up to 1.5, k = 4"):
        fit(4, 5, 3, [0.5, 1.5])


def test_clamp_prevents_the_power_from_rising_again():
    c = np.cos(np.radians([49.4, 60.0, 90.0])).clip(0.0)
    assert (lobes.g_power(c, 0.2, 4, 16) == 0.0).all()


@pytest.mark.parametrize("k", [0, 4])
@pytest.mark.parametrize("g", [4, 8, 16])
def test_free_g_power_includes_those_of_the_paper(k, g):
    c = np.linspace(0.0, 1.0, 1001)
    own = GPower(g, 2.0 / g, k / g)
    for m in (1e-4, 0.1, 0.3, 0.7):
        np.testing.assert_allclose(
            lobes.lobe(own, c, m, k), lobes.g_power(c, m, k, g), rtol=1e-9, atol=1e-300
        )
    assert lobes.max_slope(own, k) == pytest.approx(lobes.max_slope(f"d{g}", k))


def test_free_g_power_by_hand():
    assert lobes.clamped_power(0.75, 2.0, 3) == 0.125
    assert lobes.clamped_power(0.25, 2.0, 3) == 0.0
    assert lobes.lobe(GPower(3, 1.0, 2.0), 0.75, 0.5, 4) == 0.125


@pytest.mark.parametrize(
    ("own", "end"),
    [(GPower(5, 0.5, 2.0), 0.5), (GPower(5, 0.5), 2.0), (GPower(5, 0.5, 0.01), 2.0)],
)
def test_domain_of_a_free_g_power_ends_where_its_steepness_is_0(own, end):
    assert lobes.max_slope(own, 4) == lobes.max_slope(own, 0) == end
    assert lobes.in_domain([1e-4, end, end * 1.0000002], own, 4).all()
    assert not lobes.in_domain([0.0, 1.001 * end], own, 4).any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lobes.exact(0.5, 0.0, 4), r"m = 0 is outside .* \[0.0001, 2\]"),
        (lambda: lobes.exact(0.5, math.nan, 4), "m = nan"),
        (lambda: lobes.exact(1.5, 0.3, 4), r"cosine 1.5 is outside \[0, 1\]"),
        (lambda: lobes.exact(math.nan, 0.3, 4), "cosine nan"),
        (lambda: lobes.exact_tan2(-1.0, 0.3, 4), "tan2 = -1"),
        (lambda: lobes.exact(0.5, 0.3, 2), "k = 2 is neither 4"),
        (lambda: lobes.cosine(0.5, 0.8, 4), r"m = 0.8 .* lobe cosine .* 0.7071\), or use the lobe"),
        (lambda: lobes.g_power(0.5, [0.3, 0.75], 4, 16), "m = 0.75 .* lobe d16"),
        (lambda: lobes.g_power(0.5, 0.3, 4, 5), "g = 5 is none of 4, 8, 16"),
        (lambda: lobes.fitted(0.5, 0.71, 4), r"m = 0.71 .* fitted .* 0.7\], or use the lobe exact"),
        (lambda: lobes.fitted_fine(1.1, 0.5, 0), "cosine 1.1"),
        (lambda: lobes.fitted_coefficients(1.01, 0), r"m = 1.01 .* Ward: give m in \[0.0001, 1\]"),
        (lambda: lobes.fitted_fine_coefficients(0.8, 4), "lobe fitted-fine"),
        (lambda: lobes.fitted(0.5, 0.3, 3), "k = 3 is neither"),
        (lambda: lobes.fitted_coefficients(0.3, 3), "k = 3 is neither"),
        (lambda: lobes.in_domain(0.3, "d32", 4), "unknown lobe 'd32'"),
        (lambda: lobes.lobe("d32", 0.5, 0.3, 4), "unknown lobe 'd32'; known: exact, cosine"),
        (lambda: GPower(0, 0.5), "g-power g = 0: give 1 to 31"),
        (
            lambda: lobes.lobe(GPower(4, 0.5, 2.0), 0.5, 0.6, 4),
            r"g-power 4 .* m in \[0.0001, 0.5\]",
        ),
        (lambda: lobes.clamped_power(1.5, 1.0, 4), "cosine 1.5"),
    ],
)
def test_values_outside_the_domain_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_ends_of_domains():
    for k in (0, 4):
        for name in lobes.NAMES:
            end = lobes.max_slope(name, k)
            assert lobes.in_domain([1e-4, np.float32(1e-4), 0.999 * end], name, k).all()
            if name.startswith("fitted"):  # float32 may round a map's squared roughness up
                assert lobes.in_domain(end * 1.0000002, name, k)
            assert not lobes.in_domain([0.0, 0.99e-4, 1.001 * end, np.nan], name, k).any()
            closed = name == "exact" or k == 0 or name.startswith("fitted")
            assert lobes.in_domain(end, name, k) == closed


def farthest(lobe, m, k):
    angles = np.concatenate([np.linspace(0.0, 4.0 * m, 2001), np.linspace(0.0, np.pi / 2, 2001)])
    c = np.cos(angles[angles <= np.pi / 2]).clip(0.0, 1.0)
    return np.abs(lobes.lobe(lobe, c, m, k) - lobes.exact(c, m, k)).max()


def test_fitted_g_power_is_accurate():
    assert farthest(fit_g_power(4, 6, 0.3, 0.3), 0.3, 4) < 0.002


@pytest.mark.parametrize("k", [0, 4])
@pytest.mark.parametrize("g", [4, 8, 16])
def test_fitted_g_power_is_at_least_as_good_as_the_papers(g, k):
    for m in (1e-4, 1e-3, 0.02, 0.1, 0.2, 0.3, 0.45, 0.6, 0.7):
        found = fit_g_power(k, g, m, m)
        assert found.g == g
        assert found.offset == 0.0
        assert farthest(found, m, k) <= farthest(f"d{g}", m, k) * (1 + 1e-6)


@pytest.mark.parametrize("k", [0, 4])
def test_no_other_steepness_is_better(k):
    for g, m in ((1, 0.4), (3, 0.2), (6, 0.3), (24, 0.5)):
        found = fit_g_power(k, g, m, m)
        best = farthest(found, m, k)
        for factor in (0.9, 0.97, 0.99, 1.01, 1.03, 1.1):
            other = farthest(replace(found, factor=found.factor * factor), m, k)
            assert other > best * (0.995 if abs(factor - 1.0) < 0.02 else 1.0)


@pytest.mark.parametrize("k", [0, 4])
def test_a_g_power_for_a_range_of_slopes(k):
    found = fit_g_power(k, 8, 0.2, 0.45)
    for m in np.linspace(0.2, 0.45, 6):
        single = fit_g_power(k, 8, float(m), float(m))
        assert farthest(found, m, k) <= farthest(single, m, k) + 0.02
