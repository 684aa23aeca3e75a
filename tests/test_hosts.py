"""Tests the shader library in hosts with other preprocessors and compilers: each draws the same
images as OpenGL."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import missing, require_module
from tests.verification.hosts import CHOICES, HOSTS, SCENE, desktop, draw

MODULES = {"naga": "wgpu", "glslc": "wgpu", "vispy": "vispy"}
HERE = "vispy"  # needs no other compiler, since Mesa compiles its GLSL
SCENES = [f"{macros}{SCENE}" for macros in CHOICES.values()]


@pytest.fixture(scope="module")
def expected(egl) -> list[np.ndarray]:
    return desktop(SCENES)[1]


def check(images: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """Check that errors are at most 1e-6 of the largest value of each channel."""
    for name, image, other in zip(CHOICES, images, expected, strict=True):
        assert other.max((0, 1)).min() > 0.01, "something is drawn"
        error = np.abs(image - other) / other.max((0, 1))
        assert error.max() < 1e-6, name


def test_choices_give_different_images(expected):
    defaults, choices, small, every = expected
    assert np.abs(choices - defaults).max((0, 1)).min() > 1e-3
    assert 0.0 < np.abs(small - defaults).max() < 1e-5
    np.testing.assert_array_equal(every, defaults)


@pytest.mark.slow
@pytest.mark.parametrize(
    "host",
    [each if each == HERE else pytest.param(each, marks=pytest.mark.compiler) for each in HOSTS],
)
def test_hosts_draw_the_same_as_opengl(host, expected):
    require_module(MODULES[host])
    try:
        _, images = draw(HOSTS[host], SCENES)
    except FileNotFoundError as error:
        missing(f"no {error.filename}: tools/system-libraries --tests")
    check(images, expected)
