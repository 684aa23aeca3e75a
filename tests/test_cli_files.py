"""Tests files that are missing, directories or without a suffix, for every file option of every
command and every function that reads a file. The message never blames the format of a missing
file."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.commands.output import groups_of
from facerender.images.files import read_image
from tests.awkward_files import MINI_HEAD
from tests.test_help import PARSERS

# Arguments with which a command is valid, without its file options.
BASES: dict[str, tuple[str, ...]] = {
    "render": ("-o", "x.png", "--size", "16"),
    "info": (),
    "batch": ("-o", "out"),
    "plan": ("--budget", "1/255", "--size", "16"),
    "measure": ("--quick",),
    "compare": (),
    "explore": ("-o", "x.html"),
    "views": (str(MINI_HEAD), "-o", "out", "--size", "16", "--camera", "frontal"),
}
FILES = {"jobs": "jobs.csv", "a": "a.png", "b": "a.png"}
SUFFIX = {
    "jobs": ".csv",
    "mesh": ".glb",
    "scene": ".toml",
    "limits": ".ini",
    "environment": ".hdr",
    "vertices": ".npy",
}
NAMES = ("gone", "gone.txt", "gone{}", "folder", "folder{}")


def reads_file(action: argparse.Action) -> bool:
    metavar = str(action.metavar or "")
    is_file = metavar.startswith("FILE") or metavar in ("MESH", "JOBS", "A", "B")
    return is_file and action.dest != "output"


# The mesh of a batch may be a name with fields, and a missing mesh is a failed job.
OPTIONS = [
    (name, action.dest)
    for name, parser in PARSERS.items()
    for _, actions in groups_of(parser)
    for action in actions
    if reads_file(action) and (name, action.dest) != ("batch", "mesh")
]


def words_of(command: str, dest: str, value: str) -> list[str]:
    """Return the words of a command whose argument ``dest`` has a value."""
    words, last = [*command.split()], []
    for _, actions in groups_of(PARSERS[command]):
        for action in actions:
            if action.dest == dest and action.option_strings:
                last = [action.option_strings[0], value]
            elif not action.option_strings and (action.dest == dest or action.dest in FILES):
                words.append(value if action.dest == dest else FILES[action.dest])
    return [*words, *BASES[command], *last]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, egl: str) -> Path:
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (8, 8)).save("a.png")
    (tmp_path / "jobs.csv").write_text("id\na\n")
    return tmp_path


def test_every_file_option_is_tested():
    assert {command for command, _ in OPTIONS} == {*BASES}
    assert len(OPTIONS) >= 25


@pytest.mark.first_case
@pytest.mark.parametrize(("command", "dest"), OPTIONS)
def test_a_missing_file_is_reported_as_missing(command, dest, folder, capsys):
    for pattern in NAMES:
        name = pattern.format(SUFFIX.get(dest, ".png"))
        if name.startswith("folder"):
            (folder / name).mkdir()
        status = main(words_of(command, dest, name))
        out, err = capsys.readouterr()
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert name in err
        missing = f"cannot read {name}: no such file or directory; give "
        wanted = missing if name.startswith("gone") else f"{name} is a directory; give "
        if (command, dest) == ("compare", "a") and name.startswith("folder"):
            wanted = f"one of {name} and a.png is a folder"
        if (command, dest) == ("compare", "b") and name.startswith("folder"):
            wanted = f"one of a.png and {name} is a folder"
        assert wanted in err.replace(f"{name}: is", f"{name} is")


@pytest.mark.parametrize(("command", "dest"), OPTIONS)
def test_an_empty_name_is_refused(command, dest, folder, capsys):
    assert main(words_of(command, dest, "")) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith(" is empty: give a value, or leave it out\n")


READERS: dict[str, Callable[[str], Any]] = {
    "mesh": fr.load_mesh,
    "albedo": lambda path: fr.load_mesh(albedo=path),
    "scene": fr.load_scene,
    "cameras": fr.load_cameras,
    "environment": lambda path: fr.load_environment(fr.EnvironmentFile(path)),
    "landmarks": fr.load_landmarks,
    "vertices": lambda path: fr.Job(pose=fr.Pose(vertices=path)).scene(),
    "image": read_image,
    "texture": fr.Texture.open,
    "compare": lambda path: fr.compare(path, path),
    "job": lambda path: fr.Job(fr.MeshFile(path)).scene(),
}


@pytest.mark.parametrize("reader", READERS)
def test_python_reports_missing_files(reader, folder):
    (folder / "folder").mkdir()
    (folder / "folder.glb").mkdir()
    for name in ("gone", "gone.txt", "gone.glb"):
        with pytest.raises(fr.InputError, match=rf"cannot read {name}: no such file or directory"):
            READERS[reader](name)
    for name in ("folder", "folder.glb", Path(".")):
        with pytest.raises(fr.InputError, match=rf"{name} is a directory; give "):
            READERS[reader](name)
    with pytest.raises(fr.InputError, match="empty|give a path"):
        READERS[reader]("")


@pytest.mark.parametrize("text", ["environment = 'gone'", "pose = { vertices = 'gone' }"])
def test_files_that_a_scene_file_names(text, folder, capsys):
    (folder / "scene.toml").write_text(text)
    assert main(["render", "--scene", "scene.toml", *BASES["render"]]) == 2
    assert "cannot read gone: no such file or directory; give " in capsys.readouterr().err


# --- without -o -----------------------------------------------------------------------------------


def test_render_without_a_name(folder, capsys):
    (folder / "in").mkdir()
    shutil.copy(MINI_HEAD, "in/my.scan.glb")
    words = ["render", "in/my.scan.glb", "--size", "16"]
    assert main(words) == 0
    assert capsys.readouterr() == ("my.scan.png\n", "")
    first = Path("my.scan.png").read_bytes()
    assert main([*words, "--camera", "profile"]) == 2
    message = "my.scan.png exists: give -o my.scan.png to replace it, or another name"
    assert capsys.readouterr().err == f"facerender: error: {message}\n"
    assert Path("my.scan.png").read_bytes() == first
    assert main([*words, "--camera", "profile", "-o", "my.scan.png"]) == 0
    assert Path("my.scan.png").read_bytes() != first


def test_explore_without_a_name(folder, capsys):
    (folder / "in").mkdir()
    shutil.copy(MINI_HEAD, "in/my.scan.glb")
    assert main(["explore", "in/my.scan.glb", "--light", "key,no-shadow", "--quiet"]) == 0
    assert capsys.readouterr() == ("my.scan.html\n", "")
    assert main(["explore", "in/my.scan.glb"]) == 2
    message = "my.scan.html exists: give -o my.scan.html to replace it, or another name"
    assert capsys.readouterr().err == f"facerender: error: {message}\n"


@pytest.mark.slow
def test_render_several_views_without_a_name(folder, capsys):
    words = ["render", "--size", "16", "--camera", "turntable:2"]
    assert main(words) == 0
    assert capsys.readouterr().out == "head_000.png\nhead_001.png\n"
    Path("head_000.png").unlink()
    assert main(words) == 2
    assert "head_001.png exists: give -o head.png to replace it" in capsys.readouterr().err
    assert not Path("head_000.png").exists()
