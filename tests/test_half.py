"""Tests cook_torrance_half.glsl in half precision: NumPy evaluates its lines with float16 for
mediump."""

from __future__ import annotations

import re

import numpy as np
import pytest

import facerender as fr
from tests.verification.cases import cases_of, directions

LINE = re.compile(r"^    (mediump )?(?:float|vec3) (\w+) = (.*?);(?:  //.*)?$", re.MULTILINE)
LARGEST = 2.0**14  # range that GLSL ES requires of mediump


def evaluated(inputs: dict[str, np.ndarray], f0: float) -> np.ndarray:
    """Evaluate each line of the function in order, and return its result."""
    text = (fr.shader_dir() / "facerender/cook_torrance_half.glsl").read_text(encoding="utf-8")
    body = text[text.index(") {") :]
    names = {
        **{axis: inputs[axis].T for axis in "nlv"},
        **{"m": inputs["m"], "f0": f0, "FR_SLOPE": lambda m: m},
        **{"FR_LOG2_E": np.log2(np.e).item(), "FR_PI": np.pi},
        **{"dot": lambda a, b: (a * b).sum(axis=0), "clamp": np.clip, "exp2": np.exp2},
        **{"min": np.minimum, "max": np.maximum, "sqrt": np.sqrt},
    }
    lines = LINE.findall(body)
    assert len(lines) == body.count(" = ")
    for half, name, expression in lines:  # float and half operands give float, as in GLSL
        value = eval(expression, {"__builtins__": {}}, names)
        names[name] = value.astype(np.float16) if half else value
        assert not half or np.abs(value).max() < LARGEST, name
    above = np.minimum(names["n_dot_l"], names["n_dot_v"]) > 1e-6
    return np.where(above, names["value"], 0.0)


def test_half_precision_is_within_the_bound_of_the_header():
    (case,) = cases_of("fr_cook_torrance_half").values()
    assert not case.fault(evaluated(case.inputs, 0.028))
    assert case.share(evaluated(case.inputs, 0.028)).max() > 0.3, "halves, not floats"


@pytest.mark.parametrize("f0", [0.0, 0.028, 0.99])
def test_half_precision_is_finite_everywhere(f0):
    slopes = np.resize(np.float32([0.0, 1e-4, 0.1, 0.3, 1.0, 2.0]), 50_000)
    result = evaluated(directions(slopes, 1e-5), f0)
    assert np.isfinite(result).all()
    assert result.min() >= 0.0
