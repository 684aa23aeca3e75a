"""Tests that each quantity has one limit: for a value beyond it, the command line prints the
message that Python raises, and so do scene files and job tables. The same holds for values of other
types."""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest

import facerender as fr
from facerender.commands import main
from facerender.commands.output import Help, groups_of
from facerender.comparison.result import Limits
from facerender.comparison.sources import HIGHEST
from facerender.images.files import FRAME_RATES
from facerender.values.fields import EXPOSURES, MEMORY, Range, range_of
from facerender.values.vectors import MILLIMETRES, ROTATIONS, SHAPE_WEIGHTS
from tests.awkward_files import MINI_HEAD
from tests.test_help import PARSERS

BASES = {
    "render": ("head.obj", "-o", "x.png"),
    "plan": ("head.obj", "--budget", "1/255", "--size", "16"),
    "batch": ("jobs.csv", "-o", "out"),
    "explore": ("head.obj", "-o", "x.html"),
    "views": ("head.obj", "-o", "out"),
    "info": ("head.obj",),
    "measure": ("--quick", "-o", "out"),
    "compare": ("a.npy", "a.npy"),
    "shaders flatten": ("cook_torrance", "--lobe", "exact"),
}
Raises = Callable[[Any], Any]
OBJ = "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def fields_of(kind: Any, *names: str) -> dict[str, tuple[Range, Raises]]:
    """Return, for each field, its range and a function that creates an instance with a value."""

    def create(name: str, value: Any) -> Any:
        return kind(**{name: value})

    own = getattr(kind, "func", kind)
    return {name: (range_of(own, name), partial(create, name)) for name in names}


def compared(name: str, value: Any) -> Any:
    return fr.compare(IMAGE, IMAGE, **{name: value})


IMAGE = np.ones((8, 8, 3))
LIMITS = tuple(each.name for each in fields(Limits))
# For each option, its range in Python and a call that raises the error of Python.
PYTHON: dict[str, tuple[Range, Raises]] = {
    **fields_of(fr.Material, "m", "f0", "ks", "kd", "second_slope", "lobe_weight"),
    **fields_of(fr.Material, "normal_strength"),
    **fields_of(fr.ImageSettings, "size", "samples", "anisotropy", "alpha_threshold"),
    **fields_of(fr.MeshFile, "millimetres", "triangles", "rotate"),
    **fields_of(partial(fr.Scene, fr.load_mesh(MINI_HEAD)), "ambient", "background"),
    **fields_of(fr.Camera, "fov", "target"),
    **fields_of(fr.Pose, "time"),
    **fields_of(partial(fr.Output, "x.png"), "dpi"),
    **fields_of(fr.Shading, "environment_samples", "environment_lights"),
    **{name: (Range(0.0, HIGHEST), partial(compared, name)) for name in LIMITS},
    "exposure": (EXPOSURES, lambda value: fr.Output("x.png", exposure=value)),
    "weight": (SHAPE_WEIGHTS, lambda value: fr.Pose({"jawOpen": value})),
    "joint": (ROTATIONS, lambda value: fr.Pose(joints={"head": value})),
    "fps": (Range(*FRAME_RATES), lambda value: fr.save_animation("x.gif", [IMAGE], value)),
    "mm_per_pixel": (MILLIMETRES, partial(MILLIMETRES.check, "mm_per_pixel")),
    "memory": (MEMORY, lambda value: fr.Renderer((8, 8), memory=value)),
}
ONLY_CLI = ("budget", "within", "workers", "timeout", "tries", "chunk", "scatter_samples", "bits")


def numeric_options() -> list[tuple[str, argparse.Action]]:
    """Return each option with a range, and its command."""
    return [
        (command, action)
        for command, parser in PARSERS.items()
        for _, actions in groups_of(parser)
        for action in actions
        if isinstance(action.help, Help) and action.help.values and action.dest not in ONLY_CLI
    ]


OPTIONS = [(name, option) for name, option in numeric_options()]
IDS = [f"{name} {option.dest}" for name, option in OPTIONS]
FORMS: dict[str, Callable[[Any], tuple[str, Any]]] = {
    "size": lambda side: (f"{side}", (side, side)),
    "target": lambda x: (f"{x!r},0,0", (x, 0.0, 0.0)),
    "background": lambda x: (f"{x!r},0,0", (x, 0.0, 0.0)),
    "weight": lambda x: (f"jawOpen={x!r}", x),
    "joint": lambda x: (f"head=0,{x!r},0", [0.0, x, 0.0]),
    "rotate": lambda x: (f"{x!r},0,0", [x, 0.0, 0.0]),
}


def name_of(option: argparse.Action) -> str:
    return "target" if option.dest == "looked_at" else option.dest


@pytest.fixture
def folder(tmp_path, monkeypatch, egl):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "head.obj").write_text(OBJ)
    (tmp_path / "jobs.csv").write_text("id\na\n")
    np.save("a.npy", IMAGE.astype(np.float32))
    return tmp_path


def python_error(raises: Raises, value: Any) -> str:
    with pytest.raises(fr.InputError) as caught:
        raises(value)
    return str(caught.value)


@pytest.mark.first_case
@pytest.mark.parametrize(("command", "option"), OPTIONS, ids=IDS)
def test_one_limit(command, option, folder, capsys):
    name = name_of(option)
    limits, raises = PYTHON[name]
    assert option.help.values == str(limits).removesuffix(limits.unit).strip()
    for end, way in ((limits.low, -1), (limits.high, 1)):
        if math.isinf(end):
            continue
        whole = number_of(option) is int
        beyond = int(end) + way if whole else float(np.nextafter(end, way * math.inf))
        text, value = FORMS.get(name, lambda x: (repr(x), x))(beyond)
        words = [*command.split(), *BASES[command], f"{option.option_strings[0]}={text}"]
        if name == "fps":
            words += ["--camera", "turntable:2", "-o", "x.gif"]
        assert main(words) == 2
        out, err = capsys.readouterr()
        assert out == ""
        # The command line quotes the option's text, Python the value.
        remedy = re.search("(is outside|give) .*", python_error(raises, value))
        assert remedy
        assert remedy[0] in err
        assert repr(beyond) in err


def number_of(option: argparse.Action) -> type:
    """Return the type of an option's numbers."""
    whole = "size", "samples", "triangles", "environment_samples", "environment_lights"
    return int if name_of(option) in whole else float


@pytest.mark.parametrize(("command", "option"), OPTIONS, ids=IDS)
def test_text_in_place_of_a_number(command, option, folder, capsys):
    kind = "a whole number" if number_of(option) is int else "a number"
    words = [*command.split(), *BASES[command], f"{option.option_strings[0]}=much"]
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "much" in err
    own = {"size": "give N or WxH", "weight": "give NAME=WEIGHT", "target": "give three numbers in"}
    own |= {
        "joint": "give NAME=X,Y,Z",
        "rotate": "give three numbers",
        "ambient": "give a number in",
        "background": "give a number in",
    }
    assert own.get(name_of(option), f"'much' is not {kind}: give {option.help.values}") in err


SCENE = {
    "camera": ("fov", "target", "zoom", "azimuth"),
    "material": ("m", "f0", "ks", "kd", "second_slope", "lobe_weight", "normal_strength"),
    "pose": ("time",),
    "shading": ("environment_samples", "ks"),
}


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("table", "name"), [(table, name) for table, names in SCENE.items() for name in names]
)
def test_scene_files_and_tables_have_the_limits_and_types_of_python(table, name, folder, capsys):
    kind = {"camera": fr.Camera, "material": fr.Material, "pose": fr.Pose, "shading": fr.Shading}
    for value in (1e31, "much", True, [1]):
        error = python_error(lambda value: kind[table](**{name: value}), value)
        assert "number" in error or value == 1e31
        (folder / "scene.toml").write_text(f"[{table}]\n{name} = {json.dumps(value)}\n")
        assert main(["render", "head.obj", "-o", "x.png", "--scene", "scene.toml"]) == 2
        assert f"scene.toml: {error}" in capsys.readouterr().err
        (folder / "jobs.jsonl").write_text(json.dumps({table: {name: value}}) + "\n")
        assert main(["batch", "jobs.jsonl", "--check"]) == 2
        assert error in capsys.readouterr().err
