"""Tests that each quantity has one limit: the help, the command line, Python, scene files and job
tables state the same ends and the same types."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from typing import Any

import pytest

import facerender as fr
from facerender.commands import COMMANDS, main, parser_of
from facerender.commands.common import number_parser
from facerender.commands.help import Help, groups_of
from facerender.comparison.result import HIGHEST
from facerender.images.write import FRAME_RATES
from facerender.scenes.vectors import SHAPE_WEIGHTS
from facerender.shading import SCATTER_SAMPLES
from facerender.terms.ranges import EXPOSURES, MEMORY, IntegerRange, Range, range_of

BASES = {
    "render": ("-o", "x.png", "--size", "16"),
    "plan": ("--budget", "1/255", "--size", "16"),
    "batch": ("jobs.csv", "-o", "out"),
    "measure": ("--quick", "-o", "out"),
    "compare": ("a.npy", "a.npy"),
}
# The range in Python of each numeric option, or None if Python has no such value.
RANGES: dict[str, Range | None] = {
    **{
        name: range_of(fr.Material, name)
        for name in ("m", "f0", "ks", "kd", "second_slope", "lobe_weight", "normal_strength")
    },
    **{name: range_of(fr.ImageSettings, name) for name in ("size", "samples", "anisotropy")},
    **{name: range_of(fr.MeshFile, name) for name in ("millimetres", "triangles")},
    **dict.fromkeys(("ambient", "background"), range_of(fr.Light, "irradiance")),
    **dict.fromkeys(
        ("point", "block", "trend", "grain", "texture", "coverage", "shift"), Range(0.0, HIGHEST)
    ),
    **dict.fromkeys(("workers", "timeout", "tries", "chunk"), None),
    "fov": range_of(fr.Camera, "fov"),
    "looked_at": range_of(fr.Camera, "target"),
    "time": range_of(fr.Pose, "time"),
    "weight": SHAPE_WEIGHTS,
    "environment_samples": range_of(fr.Shading, "environment_samples"),
    "exposure": EXPOSURES,
    "fps": Range(*FRAME_RATES),
    "memory": MEMORY,
}
OTHERS = ("budget", "within", "scatter_samples")  # not a range


def numeric() -> Iterator[tuple[str, argparse.Action]]:
    for command in COMMANDS:
        parser = parser_of([command])
        chosen = parser._subparsers._group_actions[0].choices[command]  # type: ignore[union-attr]
        for _, actions in groups_of(chosen):
            for action in actions:
                if isinstance(action.help, Help) and action.help.values:
                    yield command, action
