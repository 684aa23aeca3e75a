"""Tests ``facerender.values.fields``: constructors check the ranges of fields, help texts state
them."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

import facerender as fr
from facerender.commands import main
from facerender.lobes import GPower
from facerender.scene.detail import Planned
from facerender.scene.environment import studio
from facerender.values.fields import (
    IntegerRange,
    Range,
    SizeRange,
    VectorRange,
    limits_of,
    range_of,
)
from tests.settings import scene_value

BASES = {
    fr.Camera: {},
    fr.Light: {},
    fr.Material: {},
    fr.EnvironmentFile: {"file": "studio"},
    fr.Environment: {"panorama": studio()},
    fr.Term: {},
    fr.Shading: {},
    fr.MeshFile: {},
    fr.ImageSettings: {},
    fr.Output: {"path": "a.png"},
    fr.Job: {},
    GPower: {"g": 4, "factor": 1.0},
    Planned: {"sizes": ((8, 8),), "samples": 4},
}
FIELDS = [
    (kind, name)
    for kind in BASES
    for name, limits in limits_of(kind).items()
    if isinstance(limits, Range) and type(limits).__module__ == "facerender.values.fields"
]


def of(kind, name, value):
    together = {} if (kind, name) != (fr.Camera, "size") else {
        "extrinsics": ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)),
        "intrinsics": ((1e4, 0, 0), (0, 1e4, 0), (0, 0, 1)),
    }  # fmt: skip
    return getattr(kind(**{**BASES[kind], **together, name: value}), name)


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=lambda each: getattr(each, "__name__", each))
def test_constructors_accept_exactly_the_range(kind, name):
    limits = range_of(kind, name)
    whole = isinstance(limits, IntegerRange)
    form = {SizeRange: lambda end: (end, end), VectorRange: lambda end: (end,) * 3}.get(
        type(limits), lambda end: end
    )
    for end, beyond in ((limits.low, -math.inf), (limits.high, math.inf)):
        if end == math.inf:
            continue
        end = int(end) if whole else end
        if not (kind is fr.Camera and name == "size"):  # must match its intrinsics
            assert of(kind, name, form(end)) == form(end)
        further = end + (1 if beyond > 0 else -1) if whole else np.nextafter(end, beyond)
        shown = limits.high if limits.high < math.inf else limits.low
        limit = f"{shown:.0f}" if whole else re.escape(f"{shown:g}")
        with pytest.raises(fr.InputError, match=rf"{name}.* {limit}\b"):
            of(kind, name, form(further))
    huge = [10**5000] if limits.high < math.inf else []
    for wrong in (math.nan, "a", True, [], b"1", {}, *huge, *([1.5] if whole else [])):
        with pytest.raises(fr.InputError, match=f"{name} "):
            of(kind, name, wrong)


@pytest.mark.slow
def test_one_number_is_width_and_height():
    assert fr.ImageSettings(256).size == fr.ImageSettings(np.int64(256)).size == (256, 256)
    assert scene_value("image", {"size": 256}).size == (256, 256)
    assert fr.Job(image={"size": 256}).image.size == (256, 256)
    assert fr.render(size=16, samples=1).linear.shape == (16, 16, 4)
    scene = fr.Scene(fr.load_mesh())
    view = fr.view_of(scene, 1.0)
    np.testing.assert_array_equal(view.intrinsics(64), view.intrinsics((64, 64)))
    move = [fr.shifted(scene, 1.0, 0.0, size).camera for size in (64, (64, 64))]
    assert move[0] == move[1]
    with pytest.raises(fr.InputError, match=r"^image size 0 x 0: give 1 to 16384 pixels a side$"):
        fr.Renderer(0)


def test_numpy_numbers_are_converted():
    assert type(of(fr.ImageSettings, "samples", np.int64(4))) is int
    assert of(fr.ImageSettings, "size", np.array([3, 4])) == (3, 4)
    assert of(fr.Light, "irradiance", np.array([1.0, 2.0, 3.0])) == (1.0, 2.0, 3.0)
    assert of(fr.Light, "irradiance", 2) == (2.0, 2.0, 2.0)


def test_help_states_ranges_units_and_defaults(capsys):
    texts = []
    for command in ("render", "plan"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        texts.append(" ".join(capsys.readouterr().out.split()))
    for kind, names in (
        (fr.Material, ("m", "f0", "ks", "kd", "lobe_weight", "normal_strength")),
        (fr.Camera, ("fov",)),
        (fr.ImageSettings, ("samples", "anisotropy")),
        (fr.Output, ("exposure",)),
        (fr.Shading, ("environment_samples",)),
    ):
        for name in names:
            option = rf"--{name.replace('_', '-')} [A-Z0-9_]+ [^-]*"
            limit = f", {range_of(kind, name)} ({getattr(kind, name):g}"
            assert all(re.search(option + re.escape(limit), text) for text in texts), name
