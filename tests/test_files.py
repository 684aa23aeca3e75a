"""What is opened as a file, and what is said of everything else."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

import facerender as fr
from facerender.errors import clipped, reason
from facerender.files import read_file


def bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(path))


def loop(path: Path) -> None:
    path.symlink_to(path)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "cannot read .*x: no such file or directory"),
    "folder": (Path.mkdir, "x is a directory; give an image file"),
    "pipe": (os.mkfifo, "x is a pipe; give an image file"),
    "socket": (bind, "x is a socket; give an image file"),
    "endless": (lambda path: path.symlink_to("/dev/zero"), "x is a device; give an image file"),
    "loop": (loop, "cannot read .*x: too many levels of symbolic links"),
    "sparse": (sparse, "x has 1099511627776 bytes, of 1073741824 at most; give an image file"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_file(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket is short
    make, message = REFUSED[case]
    make(tmp_path / "x")
    with pytest.raises(fr.InputError, match=f"^{message}|/{message}$"):
        read_file(tmp_path / "x", "an image file")


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "n" * 300, "d/" * 3000])
def test_names_that_no_file_has(name: str) -> None:
    with pytest.raises(fr.InputError, match="cannot read ") as caught:
        read_file(name, "an image file")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_whole_file(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"12345")
    (tmp_path / "link").symlink_to("x")
    assert read_file(tmp_path / "link", "x", most=5) == b"12345"
    with pytest.raises(fr.InputError, match="link has 5 bytes, of 4 at most"):
        read_file(tmp_path / "link", "x", most=4)


def test_what_libraries_say_is_one_line() -> None:
    assert reason(KeyError()) == "KeyError"
    assert reason(ValueError("a\nb\x1b[31m\ud800")) == "a b?[31m?"
    assert len(reason(ValueError("x" * 10_000))) < 200
    assert clipped("ab" * 100, 10) == "ababa ... babab"
    assert reason(FileNotFoundError(2, "No such file", "x")) == "no such file"
