"""Tests sampling of the BRDFs: directions have the density of the pdf functions, and weights
conserve energy."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from facerender import InputError, brdf

SLOPES = (0.1, 0.2, 0.3, 0.5)
ANGLES = (0, 30, 60, 80)
MODELS = {
    "cook-torrance": (brdf.cook_torrance_sample, brdf.cook_torrance_pdf, 3),
    "ward": (brdf.ward_sample, brdf.ward_pdf, 2),
}
CASES = [*product(MODELS, SLOPES, ANGLES)]
COUNT = 100_000
CELLS = (20, 36)  # of the cosine and of the angle about the normal
LEVEL = 0.01 / len(CASES)  # significance level with Bonferroni correction
N = np.array([0.0, 0.0, 1.0])


def eye_at(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([np.sin(angle), 0.0, np.cos(angle)])


def drawn(model: str, m: float, v: np.ndarray, count: int = COUNT) -> np.ndarray:
    sample, _, numbers = MODELS[model]
    return sample(N, v, m, np.random.default_rng(1).random((count, numbers)))


def chi_square(light: np.ndarray, model: str, m: float, v: np.ndarray, fine: int = 12) -> float:
    """Return the p value of directions above the surface, by the integral of the pdf over cells."""
    from scipy.special import gammaincc

    up = light[light[:, 2] > 0.0]
    angle = np.arctan2(up[:, 1], up[:, 0])
    ends = [[0.0, 1.0], [-np.pi, np.pi]]
    found = np.histogram2d(up[:, 2], angle, CELLS, ends)[0].ravel()
    z, turn = (
        low + (np.arange(cells * fine) + 0.5) / (cells * fine) * (high - low)
        for cells, (low, high) in zip(CELLS, ends, strict=True)
    )
    z, turn = np.meshgrid(z, turn, indexing="ij")
    across = np.sqrt(1.0 - z**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)
    density = MODELS[model][1](N, directions, v, m).reshape(CELLS[0], fine, CELLS[1], fine)
    wanted = density.mean(axis=(1, 3)).ravel() * 2.0 * np.pi / np.prod(CELLS) * len(light)
    few = wanted < 10.0
    wanted, found = (np.append(each[~few], each[few].sum()) for each in (wanted, found))
    counted = wanted > 5.0
    statistic = ((found - wanted)[counted] ** 2 / wanted[counted]).sum()
    return float(gammaincc(0.5 * (counted.sum() - 1), 0.5 * statistic))  # chi-squared distribution


@pytest.mark.first_case
@pytest.mark.parametrize(("model", "m", "degrees"), CASES)
def test_sampled_directions_have_the_stated_density(model, m, degrees):
    v = eye_at(degrees)
    assert chi_square(drawn(model, m, v), model, m, v) > LEVEL


def test_wrong_densities_are_detected():
    """One sampler ignores the choice of a cavity's side; the other has a slope off by 2 %."""
    v = eye_at(60)
    u = np.random.default_rng(1).random((COUNT, 3)) * (1.0, 1.0, 0.0)
    one_side = brdf.cook_torrance_sample(N, v, 0.3, u)
    assert chi_square(one_side, "cook-torrance", 0.3, v) < LEVEL
    assert chi_square(drawn("ward", 0.306, v), "ward", 0.3, v) < LEVEL


@pytest.mark.parametrize(("model", "m", "degrees"), CASES)
def test_weights_are_at_most_the_fresnel_term(model, m, degrees):
    """For Ward, which has no Fresnel term, weights are at most 1."""
    v = eye_at(degrees)
    l = drawn(model, m, v, 20_000)
    l = l[l[:, 2] > 1e-5]
    if model == "ward":
        value, most = brdf.ward(N, l, v, m), 1.0
    else:
        value = brdf.cook_torrance(N, l, v, m, 0.028)
        most = brdf.fresnel_schlick(0.028, 0.5 * np.linalg.norm(l + v, axis=-1))
    weight = value * l[:, 2] / MODELS[model][1](N, l, v, m)
    assert (weight <= most * (1.0 + 1e-9)).all()
    assert weight.max() > 0.3 * np.max(most)


def test_no_density_below_the_surface():
    """The density is 0 for a camera below the surface, and for Ward also for a light below it."""
    down = np.array([[0.6, 0.0, -0.8], [0.96, 0.0, -0.28], [-0.6, 0.0, -0.8], [1.0, 0.0, 0.0]])
    for v in (eye_at(10), eye_at(60)):
        np.testing.assert_array_equal(brdf.ward_pdf(N, down, v, 0.3), 0.0)
        for _, density, _ in MODELS.values():
            np.testing.assert_array_equal(density(N, v, down, 0.3), 0.0)


def test_sampling_works_with_any_normal():
    """The distribution of N.L must not depend on the normal."""
    random = np.random.default_rng(2)
    n = random.normal(size=(4, 3))
    n[0] = (0.0, 0.0, -1.0)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    u = random.random((50_000, 3))
    mean = brdf.cook_torrance_sample(N, N, 0.3, u).mean(axis=0)
    for normal in n:
        l = brdf.cook_torrance_sample(normal, normal, 0.3, u)
        np.testing.assert_allclose(np.linalg.norm(l, axis=-1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(l.mean(axis=0), normal * mean[2], atol=0.01)


@pytest.mark.parametrize(
    ("u", "message"),
    [
        ((0.5, 0.5), r"u has shape \(2,\): its last axis must hold 3 numbers"),
        ((0.5, -0.5, 0.5), r"u holds -0.5: give numbers in \[0, 1\)"),
    ],
)
def test_invalid_random_numbers_are_refused(u, message):
    with pytest.raises(InputError, match=message):
        brdf.cook_torrance_sample(N, N, 0.3, u)
