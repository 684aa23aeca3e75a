"""Help texts: descriptions, options and examples; unknown options; --verbose."""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from facerender.commands import COMMANDS, main, parser_of
from facerender.commands.output import EXAMPLES, Help, commands_of, groups_of
from tests.awkward_files import MINI_HEAD

SIZE = ("--size", "16", "--samples", "1")


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    status = main([*map(str, words)])
    told = capsys.readouterr()
    return status, told.out, told.err


@pytest.mark.parametrize("example", [each for lines in EXAMPLES.values() for each in lines])
def test_examples_are_understood(example):
    words = shlex.split(re.sub(r'^eval "\$\((.*)\)"$', r"\1", example.partition(" > ")[0]))
    assert words[0] == "facerender"
    assert parser_of(words[1:]).parse_args(words[1:]).command


def walk(name: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, Any]]:
    yield name, parser
    for action, each in commands_of(parser).items():
        yield from walk(f"{name} {action}".strip(), each)


PARSERS = dict(walk("", parser_of([*COMMANDS])))


@pytest.mark.parametrize("name", PARSERS)
def test_every_command_has_a_description_and_an_example_and_every_option_a_text(name):
    parser = PARSERS[name]
    assert parser.description.endswith(".")
    assert max(map(len, parser.description.splitlines())) <= 84
    if name:
        assert EXAMPLES[name]
        assert all(name in example for example in EXAMPLES[name])
        assert parser.epilog.startswith("examples:\n")
    for _, actions in groups_of(parser):
        for action in actions:
            if action.dest not in ("help", "version") and not commands_of(parser):
                assert isinstance(action.help, Help), action
                assert action.help.text
                assert action.help.default


@pytest.mark.parametrize(
    ("words", "told", "command"),
    [
        (("render", "--colour", "-o", "x.png"), "unrecognized arguments: --colour", "render"),
        (("plan",), "the following arguments are required: --budget", "plan"),
        (("shaders", "list", "--all"), "unrecognized arguments: --all", "shaders list"),
        (("plan", "--budget"), "argument --budget: expected one argument", "plan"),
        (("--nope", "doctor"), "unrecognized arguments: --nope", ""),
    ],
)
def test_the_command_that_does_not_understand_is_named(words, told, command, capsys):
    see = " ".join(filter(None, ["facerender", command, "--help"]))
    assert run(capsys, *words) == (2, "", f"facerender: error: {told}; see {see}\n")


@pytest.mark.slow
def test_verbose_tells_the_steps_and_quiet_none(tmp_path, capsys):
    out, render = tmp_path / "o.png", ("render", MINI_HEAD, *SIZE)
    assert run(capsys, *render, "-o", out) == (0, f"{out}\n", "")
    assert run(capsys, *render, "--quiet", "-o", out) == (0, f"{out}\n", "")
    status, written, err = run(capsys, *render, "--verbose", "-o", out)
    assert (status, written) == (0, f"{out}\n")
    lines = err.splitlines()
    assert all(re.match(r"facerender: \d+\.\d\d s: ", line) for line in lines)
    assert [line.split(": ")[2].split()[0] for line in lines] == ["mesh", "OpenGL", "image"]
    assert "s: a pair\n" in run(capsys, "compare", "--verbose", out, out)[2]
    assert run(capsys, "compare", out, out)[2] == ""
    status, told, err = run(capsys, *render, "--quiet", "--verbose", "-o", out)
    assert (status, told) == (2, "")
    assert "--quiet and --verbose exclude each other" in err


def test_version_and_signal_handlers_do_not_wait_for_numpy():
    code = (
        "import sys, facerender.__main__\n"
        "assert 'numpy' not in sys.modules, 'handlers are installed after this import'\n"
        "from facerender.commands import main\n"
        "assert main(['--version']) == 0 and 'numpy' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)


@pytest.mark.slow
def test_a_cold_start_pays_for_none_of_it(tmp_path: Path):
    code = (
        "import sys, facerender\n"
        "assert not {'numpy', 'argparse', 'moderngl', 'trimesh', 'scipy', 'PIL'} & {*sys.modules}\n"
        "from facerender.commands import main\n"
        "main(sys.argv[1:])\n"
        "late = {'tqdm', 'trimesh', 'pyrr'}\n"
        "assert not late & {*sys.modules}\n"
    )
    words = ["render", *SIZE, "--no-cache", "--only", "mask", "--m", "0.3"]
    words += ["-o", str(tmp_path / "o.png")]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
