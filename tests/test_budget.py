"""Tests ``facerender.planning.budget``: parsing, errors and texts of budgets."""

from __future__ import annotations

import math

import numpy as np
import pytest

from facerender import InputError
from facerender.planning.budget import Budget, highest_but
from tests.conftest import missing


@pytest.mark.parametrize(
    ("given", "limit", "unit"),
    [
        ("1/255", 1 / 255, "display"),
        (" 0.5 / 255 ", 0.5 / 255, "display"),
        (0.25, 0.25, "display"),
        (1, 1.0, "display"),
        (np.float32(0.5), 0.5, "display"),
        ("0.5%", 0.005, "relative"),
        ("+2 %", 0.02, "relative"),
        ("0.02 flip", 0.02, "flip"),
        ("0.02FLIP", 0.02, "flip"),
        (0, 0.0, "display"),
        ("0/255", 0.0, "display"),
        ("0 flip", 0.0, "flip"),
    ],
)
def test_budgets_are_parsed(given, limit, unit):
    budget = Budget.parse(given, exposure=1.5)
    assert budget.limit == pytest.approx(limit, rel=1e-12)
    assert (budget.unit, budget.exposure) == (unit, 1.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *((given, f"budget {given!r} has an unknown unit: give a fraction") for given in (
            "1 dB", "5 %%", "", " ", "%", "flip", "/255", "1/255 flip", "1/two", "--1/255", "e%",
            "1,5%", "1/255\n2/255",
        )),
        *((given, f"budget {given!r} has no unit: give a fraction") for given in ("1", "0.004")),
        *((given, f"budget {given} is negative: give a fraction") for given in (
            "-1/255", "-0.5%", "-0.02 flip", "-1", "-inf", -1, -0.5,
        )),
        *((given, f"budget {given} is not a finite number: give a fraction") for given in (
            "nan", "inf", "nan%", "inf%", "nan flip", "inf/255", "1e400/255", math.nan, math.inf,
        )),
        ("1/0", "budget '1/0' "),
        ("0/0", "budget '0/0' "),
        ("1/-255", "budget '1/-255' "),
        (None, "budget None has an unknown unit"),
        (True, "budget True has an unknown unit"),
    ],
)  # fmt: skip
def test_invalid_budgets_are_refused_with_a_remedy(given, message):
    with pytest.raises(InputError) as error:
        Budget.parse(given)
    text = str(error.value)
    assert text.startswith(message)
    assert "such as 1/255, 0.5%, or 0.02 flip" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("given", "within"),
    [("99.9%", 0.999), (0.999, 0.999), ("0.5", 0.5), (" 100 % ", 1.0), (1, 1.0), ("1e-1%", 0.001),
     (np.float32(0.999), 0.999), ("99.99%", 0.9999)],
)  # fmt: skip
def test_within_is_parsed(given, within):
    assert Budget.parse("1/255", within=given) == Budget(1 / 255, within=within)


@pytest.mark.parametrize("given", ["99.9", 0, "0%", -0.5, "101%", "nan", "inf", "most", "", True])
def test_invalid_within_is_refused(given):
    with pytest.raises(InputError, match=rf"^within {given}: give a fraction .* 99.9% or 0.999$"):
        Budget.parse("1/255", within=given)


@pytest.mark.parametrize(
    ("within", "covered", "spared"),
    [(1.0, 1000, 0), (0.999, 999, 0), (0.999, 1000, 1), (0.999, 1999, 1), (0.999, 10**6, 1000),
     (0.07, 100, 93), (0.29, 100, 71), (0.5, 3, 1), (1e-9, 7, 6), (0.999, 0, 0)],
)  # fmt: skip
def test_spared_pixels(within, covered, spared):
    """The product of fraction and pixels must not be rounded up to spare one pixel more."""
    assert Budget(0.1, within=within).spared(covered) == spared


def test_highest_error_after_spared_pixels():
    errors = np.array([[3.0, 1.0, 2.0], [5.0, 4.0, 0.0]])
    assert [highest_but(errors, spared) for spared in range(7)] == [5, 4, 3, 2, 1, 0, 0]
    errors[0, 1] = math.nan  # NaN is above every limit
    assert math.isnan(highest_but(errors, 0))
    assert highest_but(errors, 1) == 5


def displayed(linear, exposure):
    """Return the sRGB encoding of one value, in scalar arithmetic."""
    x = min(max(linear * 2.0**exposure, 0.0), 1.0)
    return 12.92 * x if x <= 0.0031308 else 1.055 * math.pow(x, 1 / 2.4) - 0.055


def images(seed=0):
    """Return two images with values from black to above white and with small and large errors."""
    random = np.random.default_rng(seed)
    reference = 10.0 ** random.uniform(-5, 0.5, (24, 32, 3)) * random.integers(0, 2, (24, 32, 1))
    factor = 1.0 + 10.0 ** random.uniform(-6, 0, (24, 32, 3)) * random.choice([-1, 1], (24, 32, 3))
    return reference * factor + random.uniform(0, 1e-3, reference.shape), reference


@pytest.mark.parametrize("exposure", [0.0, 2.0, -3.0])
def test_error_of_the_displayed_image(exposure):
    image, reference = images()
    errors = Budget(0.1, "display", exposure).errors(image, reference)
    assert errors.shape == (24, 32)
    for y, x in np.ndindex(errors.shape):
        channels = zip(image[y, x], reference[y, x], strict=True)
        expected = max(abs(displayed(a, exposure) - displayed(b, exposure)) for a, b in channels)
        assert errors[y, x] == pytest.approx(expected, abs=1e-12)


def test_relative_error_of_the_linear_radiance():
    image, reference = images()
    errors = Budget(0.1, "relative", exposure=3.0).errors(image, reference)
    for y, x in np.ndindex(errors.shape):
        channels = zip(image[y, x], reference[y, x], strict=True)
        expected = max(abs(a - b) / max(b, 0.01) for a, b in channels)
        assert errors[y, x] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("exposure", [0.0, 1.0])
def test_flip_of_the_displayed_images(exposure):
    try:
        from flip_evaluator import evaluate
    except ImportError:
        missing("no flip-evaluator: pip install 'facerender[measure]'")
    image, reference = (np.clip(each, 0.0, 1.0) for each in images())
    encoded = [
        np.vectorize(displayed)(each, exposure).astype(np.float32) for each in (reference, image)
    ]
    mean = evaluate(*encoded, "LDR")[1]
    errors = Budget(0.1, "flip", exposure).errors(image, reference)
    assert errors.shape == (24, 32)
    assert errors.mean() == pytest.approx(mean, rel=1e-4)
    assert not Budget(0.1, "flip").errors(image, image).any()


def test_flip_without_its_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "flip_evaluator", None)
    with pytest.raises(InputError, match=r"FLIP needs pip install 'facerender\[measure\]'"):
        Budget(0.1, "flip").errors(*images())


@pytest.mark.parametrize(
    ("unit", "error", "text"),
    [
        ("display", 1 / 255, "1/255"),
        ("display", 0.4564 / 255, "0.456/255"),
        ("display", 0.0, "0/255"),
        ("display", 0.0011 / 255, "0.0011/255"),
        ("display", 0.0009 / 255, "<0.001/255"),
        ("relative", 1.234, "123 %"),
        ("relative", 1e-9, "<0.001 %"),
        ("flip", 0.02134, "FLIP 0.0213"),
        ("flip", 5e-4, "FLIP <0.001"),
    ],
)
def test_text(unit, error, text):
    assert Budget(1.0, unit).text(error) == text
