"""Tests outputs: inputs are never overwritten, full disks and closed streams cause no traceback,
signals leave no partial files, and long work reports its progress."""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.commands.options import check_outputs
from facerender.drawing.renderer import Renderer
from facerender.system import files as atomic
from facerender.system.process import Bar
from tests.awkward_files import MINI_HEAD, write_textured_obj
from tests.awkward_files import mini_head as read_mini_head
from tests.test_cli import assert_error

ROOT = Path(__file__).parents[1]
SMALL = ("--size", "32", "--samples", "1")


def process(*arguments, **options):
    command = [sys.executable, "-m", "facerender", *map(str, arguments)]
    options = {"capture_output": True, "text": True, "timeout": 120} | options
    return subprocess.run(command, check=False, **options)


# --- outputs that are also inputs ----------------------------------------------------------------


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """A folder with one input file of each kind."""
    folder = tmp_path_factory.mktemp("files")
    for name in ("skin.png", "other.png", "mask.png"):
        Image.new("RGB", (32, 32), (200, 150, 120)).save(folder / name)
    write_textured_obj(folder / "head.obj", read_mini_head())
    (folder / "scene.toml").write_text("ambient = 0.1\n")
    np.save(folder / "around.npy", np.ones((8, 16, 3), np.float32))
    (folder / "lit.toml").write_text('[environment]\nfile = "around.npy"\n')
    (folder / "path.toml").write_text("[[cameras]]\nazimuth = 10\n")
    (folder / "explorer.json").write_text("{}")
    (folder / "out").mkdir()
    (folder / "out" / "jobs.jsonl").write_text('{"image.size": 32}\n')
    return folder


@pytest.fixture
def inputs(files, tmp_path, monkeypatch):
    """A copy of ``files``, which is the working directory of the command."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(capsys):
    """A function that runs a command and checks that it fails with one line."""

    def check(message, *arguments):
        status = main([*map(str, arguments)])
        printed = capsys.readouterr()
        assert_error(status, printed.out, printed.err, message)

    return check


def linked(how, name, suffix):
    """Create a symbolic or hard link to a file, and return its name."""
    other = f"other{suffix}"
    Path(other).unlink(missing_ok=True)
    (os.symlink if how == "symlink" else os.link)(os.path.abspath(name), other)
    return other


RENDER = ("render", "head.obj", *SMALL)
PLAN = ("plan", "head.obj", "--budget", "1/255")


READ = [
    ("skin.png", (*RENDER, "--albedo", "skin.png", "-o"), ".png"),
    ("skin.png", (*RENDER, "--lobe-map", "skin.png", "-o"), ".png"),
    ("head.obj", (*RENDER, "-o"), ".png"),
    ("scene.toml", (*RENDER, "--scene", "scene.toml", "-o"), ".png"),
    ("around.npy", (*RENDER, "--environment", "around.npy,90,0.5", "-o"), ".exr"),
    ("around.npy", (*RENDER, "--scene", "lit.toml", "-o"), ".exr"),
    ("path.toml", (*RENDER, "--camera", "path.toml", "-o"), ".png"),
    ("skin.png", (*PLAN, "--albedo", "skin.png", "--error-map"), ".png"),
    ("head.obj", (*PLAN, "--emit"), ".glsl"),
    ("scene.toml", (*PLAN, "--scene", "scene.toml", "--save-scene"), ".toml"),
    ("path.toml", (*PLAN, "--camera", "path.toml", "--emit"), ".glsl"),
    ("skin.png", ("compare", "skin.png", "mask.png", "--heatmap"), ".png"),
    ("mask.png", ("compare", "skin.png", "mask.png", "--report"), ".html"),
    ("mask.png", ("compare", "skin.png", "skin.png", "--mask", "mask.png", "--report"), ".html"),
    ("skin.png", ("explore", "head.obj", "--albedo", "skin.png", "-o"), ".html"),
]


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("read", "arguments", "suffix", "how"),
    [
        (*case, how)
        for case in READ
        for how in ("same", "symlink", "hard link")
        if how != "same" or case[0].endswith(case[2])  # the command accepts this suffix
    ],
)
def test_inputs_are_not_overwritten(read, arguments, suffix, how, inputs, refused, monkeypatch):
    monkeypatch.setattr(Renderer, "of", None)  # drawing would fail
    output = read if how == "same" else linked(how, read, suffix)
    before = {path.name: path.read_bytes() for path in inputs.iterdir() if path.is_file()}
    refused("is both input and output: give another", *arguments, output)
    assert before == {path.name: path.read_bytes() for path in inputs.iterdir() if path.is_file()}


def test_files_of_a_mesh_are_not_overwritten(inputs, refused):
    output = linked("hard link", "skin.jpg", ".png")
    refused("is both input and output", *RENDER, "-o", output)


def test_outputs_that_are_one_file(inputs, refused):
    words = (*PLAN, "--emit", "a.png", "--error-map", "out/../a.png")
    refused("a.png is written twice: give another name", *words)


def test_job_table_in_the_output_folder_is_refused(inputs, refused):
    before = (inputs / "out/jobs.jsonl").read_bytes()
    words = ("batch", "out/jobs.jsonl", "-o", "out", "--workers", "1")
    refused("jobs.jsonl is both input and output", *words)
    assert (inputs / "out/jobs.jsonl").read_bytes() == before
    assert os.listdir(inputs / "out") == ["jobs.jsonl"]


# --- paths and disks -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gone/a.png", "no such file or directory; give a file in a writable folder"),
        ("folder.exr", "it is a directory; give a file name"),
        ("pipe.png", "it is not a regular file; give a file name"),
        ("full.png", "it is not a regular file; give a file name"),
        ("loop.png", "too many levels of symbolic links"),
        ("file/a.png", "not a directory; give a file in a writable folder"),
        ("/proc/a.png", "give a"),
        (f"{'x' * 300}.png", "file name too long; give a file in a writable folder"),
    ],
)
def test_invalid_output_paths_are_refused(name, message, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Renderer, "of", None)
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").touch()
    os.mkfifo("pipe.png")
    os.symlink("/dev/full", "full.png")
    os.symlink("loop.png", "loop.png")
    if name.startswith("/proc"):
        monkeypatch.undo()
    refused(f"cannot write .*{message}", "render", MINI_HEAD, *SMALL, "-o", name)


def test_the_longest_name(tmp_path, egl):
    path = tmp_path / f"{'x' * 251}.png"
    assert main(["render", str(MINI_HEAD), *SMALL, "-o", str(path)]) == 0
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("a.png", 32), ("a.exr", 4)])
def test_full_disk_keeps_the_old_file(name, size, tmp_path, egl):
    (tmp_path / name).write_bytes(b"old")

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (512, 512))

    small = ("--size", size, "--samples", "1", "--no-cache")
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}  # truncated bytecode would remain
    options = {"preexec_fn": limit, "env": environment}
    done = process("render", MINI_HEAD, *small, "-o", tmp_path / name, **options)
    assert_error(
        done.returncode,
        done.stdout,
        done.stderr,
        rf"cannot write .*{name}: file too large; raise the limit",
    )
    assert len(done.stderr.splitlines()) == 1
    assert os.listdir(tmp_path) == [name]
    assert (tmp_path / name).read_bytes() == b"old"


def test_two_writers_of_one_file(tmp_path):
    contents = [bytes([number]) * 100_000 for number in range(4)]

    def write(content):
        for _ in range(50):
            atomic.write_bytes(tmp_path / "a.png", content)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        if (tmp_path / "a.png").exists():
            assert (tmp_path / "a.png").read_bytes() in contents
    assert os.listdir(tmp_path) == ["a.png"]


def test_old_temporary_files_are_removed(tmp_path, egl):
    old, new = tmp_path / ".facerender-0", tmp_path / ".facerender-1"
    for path in (old, new, tmp_path / ".other"):
        path.touch()
    for path in (old, tmp_path / ".other"):
        os.utime(path, (0, 0))
    assert main(["render", str(MINI_HEAD), *SMALL, "-o", str(tmp_path / "a.png")]) == 0
    assert {*os.listdir(tmp_path)} == {"a.png", new.name, ".other"}


# --- streams -------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [("--help",), ("shaders", "list")])
def test_full_standard_output(arguments):
    with open("/dev/full", "w") as full:
        done = process(*arguments, stdout=full, stderr=subprocess.PIPE, capture_output=False)
    assert_error(done.returncode, "", done.stderr, "cannot write standard output: no space left")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_both_streams_full(tmp_path, egl):
    with open("/dev/full", "w") as full:
        arguments = ("render", MINI_HEAD, *SMALL, "-o", tmp_path / "a.png")
        done = process(*arguments, stdout=full, stderr=full, capture_output=False)
    assert done.returncode == 2
    with Image.open(tmp_path / "a.png") as written:
        written.load()


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_closed_streams(closed, tmp_path, egl):
    """An opened file must not get the descriptor of a closed stream."""
    path = tmp_path / "a.png"
    mesh = write_textured_obj(tmp_path / "head.obj", read_mini_head())
    (tmp_path / "skin.jpg").unlink()  # causes a warning
    words = f"render {mesh} {' '.join(SMALL)} -o {path}"
    command = f"{sys.executable} -m facerender {words} {closed}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    with Image.open(path) as written:
        written.load()


def test_closed_pipe_ends_with_sigpipe():
    reading, writing = os.pipe()
    os.close(reading)
    done = process("shaders", "list", stdout=writing, stderr=subprocess.PIPE, capture_output=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.slow
@pytest.mark.parametrize("encoding", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C"}])
def test_unencodable_characters_in_paths(encoding, tmp_path, egl):
    path = tmp_path / "Gesicht ä\udcff.png"
    environment = os.environ | encoding | {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "facerender", "render", str(MINI_HEAD), *SMALL, "-o"]
    done = subprocess.run([*command, os.fsencode(path)], env=environment, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert os.listdir(os.fsencode(tmp_path)) == [os.fsencode(path.name)]
    gone = subprocess.run([*command[:-4], b"\xff\xc3.glb", "-o", "a.png"], env=environment,
                          capture_output=True, cwd=tmp_path)  # fmt: skip
    assert gone.returncode == 2
    assert b"Traceback" not in gone.stderr


# --- signals -------------------------------------------------------------------------------------


def catches_sigterm(process):
    """Return whether a process catches SIGTERM."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    (caught,) = [line.split()[1] for line in lines if line.startswith("SigCgt")]
    return int(caught, 16) >> signal.SIGTERM - 1 & 1


@pytest.mark.parametrize(
    ("sent", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")]
)
def test_signal_during_imports(sent, word, tmp_path):
    command = [sys.executable, "-m", "facerender", "render", "-o", str(tmp_path / "a.png")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        while running.poll() is None and not catches_sigterm(running):
            time.sleep(0.001)
        running.send_signal(sent)
        _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors) == (128 + sent, f"facerender: {word}\n")
    assert os.listdir(tmp_path) == []


ENDED = """
import os, shutil, signal, subprocess, sys, tempfile, threading
from pathlib import Path
from facerender.system.signals import heed_signals, if_ended
from facerender.system.files import write_whole
from facerender.system.process import Bar

heed_signals()

def write(name):
    Path(name).write_text("half")
    child = subprocess.Popen([sys.executable, "-c", "import time; print(1, flush=True);"
        "time.sleep(600)"], stdout=subprocess.PIPE)
    child.stdout.readline()
    print(child.pid, folder, flush=True)
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:  # as trimesh does
        pass

folder = tempfile.mkdtemp()
with if_ended(lambda: shutil.rmtree(folder), always=True), Bar() as progress:
    progress("reading", 0.5)
    progress("writing", 0.25)
    write_whole(sys.argv[1], write)
print("went on")
"""


def test_signal_removes_partial_results(tmp_path):
    (tmp_path / "a.png").write_bytes(b"old")
    command = [sys.executable, "-c", ENDED, tmp_path / "a.png"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stderr == "facerender: interrupted: done: reading, 25 % of writing\n"
    assert done.returncode == 130
    child, folder = done.stdout.split()
    assert not os.path.exists(folder)
    assert not os.path.exists(f"/proc/{child}")
    assert os.listdir(tmp_path) == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == b"old"


DRIVEN = """
import os, signal, sys, time
from pathlib import Path
from facerender.system.signals import heed_the_coordinator
from facerender.system.files import write_whole

heed_the_coordinator()

def write(name):
    Path(name).write_text("half")
    os.kill(os.getpid(), signal.SIGINT)
    print("goes on", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)

write_whole(sys.argv[1], write)
"""


def test_terminated_worker_removes_partial_results(tmp_path):
    command = [sys.executable, "-c", DRIVEN, tmp_path / "a.png"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    reported = done.returncode, done.stdout, done.stderr
    assert reported == (-signal.SIGTERM, "goes on\n", "")
    assert os.listdir(tmp_path) == []


@pytest.mark.slow
def test_workers_of_a_batch_obey_their_coordinator():
    ours, theirs = socket.socketpair()
    command = [sys.executable, "-m", "facerender.batch.worker", str(theirs.fileno())]
    with ours, theirs, subprocess.Popen(command, pass_fds=[theirs.fileno()]) as running:
        while not catches_sigterm(running) and running.poll() is None:
            time.sleep(0.01)
        running.terminate()
    assert running.returncode == -signal.SIGTERM


@pytest.mark.slow
def test_killed_at_random():
    command = [sys.executable, ROOT / "benchmarks/kills.py", "--kills", "10"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


# --- progress ------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_progress_bar_appears_only_on_terminals(stream, quiet, monkeypatch):
    error = stream()
    monkeypatch.setattr(sys, "stderr", error)
    with Bar(quiet) as progress:
        for what in ("views", "shadings"):
            for done in (0.0, 0.5, 1.0):
                progress(what, done)
    reported = error.getvalue()
    if stream is Terminal and not quiet:
        assert "views   0%" in reported
        assert "shadings   0%" in reported
        assert reported.rpartition("\r")[0].rpartition("\r")[2].strip() == ""  # the bar was erased
    else:
        assert reported == ""


@pytest.mark.slow
def test_quiet_keeps_warnings_and_errors(inputs, capsys, egl):
    for path in inputs.glob("*.mtl"):
        path.unlink()
    assert main(["explore", "head.obj", "-o", "a.html", "--quiet"]) == 0
    assert "facerender: warning: " in capsys.readouterr().err
    assert main(["explore", "gone.obj", "-o", "a.html", "--quiet"]) == 2
    assert "facerender: error: " in capsys.readouterr().err


@pytest.mark.slow
def test_batch_prints_its_progress_unless_quiet(tmp_path, capsys, egl):
    jobs = tmp_path / "jobs.jsonl"
    jobs.write_text(json.dumps({"mesh": str(MINI_HEAD), "image.size": 32}) + "\n")
    assert main(["batch", str(jobs), "-o", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().err.startswith("facerender: ")
    assert main(["batch", str(jobs), "-o", str(tmp_path / "b"), "--quiet"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_many_outputs_are_checked_in_linear_time(tmp_path):
    names = [tmp_path / f"{number}.png" for number in range(2000)]
    names[0].touch()

    def seconds(count):
        began = time.process_time()
        check_outputs(names[:count], [tmp_path / "mesh.glb"])
        return time.process_time() - began

    few, many = (min(seconds(count) for _ in range(3)) for count in (250, 2000))
    assert many < 24.0 * few  # 8 times as many outputs; quadratic time would be 64 times
    with pytest.raises(fr.InputError, match=r"/0.png is written twice"):
        check_outputs([*names, tmp_path / "." / "0.png"])
    with pytest.raises(fr.InputError, match=r"/0.png is both input and output"):
        check_outputs(names, [tmp_path / "9.png", names[0]])
