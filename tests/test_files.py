"""Tests ``facerender.system.files``: which paths are read, and the messages for all others."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

import facerender as fr
from facerender.commands import main
from facerender.errors import clipped, reason
from facerender.system.files import read_file, tables_of


def bind(path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(path))


def loop(path):
    path.symlink_to(path)


def sparse(path):
    with path.open("wb") as file:
        file.truncate(1 << 40)


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "cannot read .*x: no such file or directory"),
    "folder": (Path.mkdir, "x is a directory; give an image file"),
    "pipe": (os.mkfifo, "x is a pipe; give an image file"),
    "socket": (bind, "x is a socket; give an image file"),
    "endless": (lambda path: path.symlink_to("/dev/zero"), "x is a device; give an image file"),
    "loop": (loop, "cannot read .*x: too many levels of symbolic links"),
    "sparse": (sparse, "x has 1099511627776 bytes, but the limit is 1073741824; give .*"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_only_regular_files_are_read(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # paths of sockets must be short
    make, message = REFUSED[case]
    make(tmp_path / "x")
    with pytest.raises(fr.InputError, match=f"^{message}|/{message}$"):
        read_file(tmp_path / "x", "an image file")


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "n" * 300, "d/" * 3000])
def test_impossible_names_are_refused(name):
    with pytest.raises(fr.InputError, match="cannot read ") as caught:
        read_file(name, "an image file")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


LONG = "x" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", LONG, "-o", "a.png"),
        ("render", f"{LONG}.obj", "-o", "a.png"),
        ("render", "--scene", LONG, "-o", "a.png"),
        ("render", "--camera", f"{LONG}.npz", "-o", "a.png"),
        ("render", "--environment", f"{LONG}.hdr", "-o", "a.png"),
        ("info", f"{LONG}.glb"),
        ("plan", f"{LONG}.glb", "--budget", "1/255"),
        ("plan", "--budget", "1/255", "--save-scene", LONG),
        ("measure", LONG),
        ("compare", LONG, LONG),
        ("compare", "--calibrate", LONG),
        ("batch", f"{LONG}.jsonl", "--check"),
        ("batch", "--status", LONG),
        ("explore", f"{LONG}.glb", "-o", "a.html"),
        ("shaders", "flatten", LONG),
    ],
    ids=lambda each: " ".join(each)[:40],
)
def test_commands_refuse_long_names_in_one_line(arguments, capsys, tmp_path):
    with contextlib.chdir(tmp_path):
        assert main([*arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("facerender: error: ")


def test_whole_file(tmp_path):
    (tmp_path / "x").write_bytes(b"12345")
    (tmp_path / "link").symlink_to("x")
    assert read_file(tmp_path / "link", "x", most=5) == b"12345"
    with pytest.raises(fr.InputError, match="link has 5 bytes, but the limit is 4"):
        read_file(tmp_path / "link", "x", most=4)


def test_messages_of_libraries_become_one_line():
    assert reason(KeyError()) == "KeyError"
    assert reason(ValueError("a\nb\x1b[31m\ud800")) == "a b?[31m?"
    assert len(reason(ValueError("x" * 10_000))) < 200
    assert clipped("ab" * 100, 10) == "ababa ... babab"
    assert reason(FileNotFoundError(2, "No such file", "x")) == "no such file"


NO_TOML: dict[str, tuple[str, str]] = {
    "unfinished": ("[a", "Expected ']'"),
    "another encoding": ("\ufffe", "Invalid statement"),
    "long number": (f"a = 1{'0' * 5000}", "Exceeds the limit"),
    "nested lists": (f"a = {'[' * 5000}", "nested too deep"),
    "key of many names": (f"{'a.' * 40_000}b = 1", "nested too deep"),
    "table of many names": (f"[{'a . ' * 100_000}b]", "nested too deep"),
    "quoted names": (f"""{'"a b"."".' * 30_000}b = 1""", "nested too deep"),
    "many words": ("a b " * 100_000, "Expected '='"),
}


@pytest.mark.parametrize("case", NO_TOML)
def test_invalid_toml_is_refused(case):
    text, why = NO_TOML[case]
    with pytest.raises(fr.InputError, match=f"^x.toml is not valid TOML: {why}.*; correct it$"):
        tables_of(text.encode(), "x.toml")


def test_toml_with_a_byte_order_mark_and_dots():
    text = f"a.'b c'.\"d\" = [{'0.5, ' * 100}]\n'{'x.' * 100}' = 1\n"
    tables = tables_of(text.encode("utf-8-sig"), "x.toml")
    assert tables == {"a": {"b c": {"d": [0.5] * 100}}, "x." * 100: 1}
