"""Tests ``facerender batch``: each job is drawn once, its bytes do not depend on workers or
interruptions, and failures are isolated."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext, suppress
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import psutil
import pytest

import facerender as fr
from facerender.batch import supervisor
from facerender.batch.jobs import (
    JobTable,
    Row,
    Settings,
    chunks,
    code_version,
    forget_files,
    key_of,
)
from facerender.batch.records import Storage, locked
from facerender.batch.supervisor import Supervisor, draw_chunk
from facerender.commands import main
from facerender.loading import MESH_PATHS
from facerender.loading.source import named_files, source_of
from facerender.system.process import available
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module
from tests.faults import failing

pytestmark = pytest.mark.usefixtures("egl")
COMMAND = [sys.executable, "-m", "facerender", "batch"]


def rows(count: int, **more: Any) -> list[dict[str, Any]]:
    own = {"image.size": 48, "mesh": str(MINI_HEAD)}
    return [
        {"id": f"job{i:03d}", "camera.azimuth": 7.0 * i - 40.0, **own, **more} for i in range(count)
    ]


@pytest.fixture
def table(tmp_path: Path) -> Callable[[Sequence[dict[str, Any]]], str]:
    def write(jobs: Sequence[dict[str, Any]]) -> str:
        path = tmp_path / "jobs.jsonl"
        path.write_text("".join(json.dumps(job) + "\n" for job in jobs))
        return str(path)

    return write


@pytest.fixture(scope="module")
def reused() -> Iterator[Callable[[int], supervisor.Engine]]:
    """A function that returns engines whose workers survive a batch, as Dask's workers do."""
    with ExitStack() as open_:

        @cache
        def of(count: int) -> supervisor.Engine:
            executor = open_.enter_context(ThreadPoolExecutor(count))
            return supervisor.Engine(executor, lambda: count, count)

        yield of


@pytest.fixture
def draw(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    reused: Callable[[int], supervisor.Engine],
) -> Callable[..., dict[str, Any]]:
    """A function that runs a batch and returns its last line of JSON with the exit status.

    It reuses the workers of earlier batches unless ``fresh`` is true.
    """
    started = supervisor.local

    def run(jobs: str, output: str, *options: str, fresh: bool = False) -> dict[str, Any]:
        monkeypatch.setattr(
            supervisor,
            "local",
            lambda count: started(count) if fresh else nullcontext(reused(count)),
        )
        words = ["batch", jobs, "-o", str(tmp_path / output), "--workers", "1", "--json", *options]
        status = main(words)
        out, err = capsys.readouterr()
        last = json.loads(out.splitlines()[-1]) if out else {}
        return {**last, "status": status, "err": err, "lines": out.splitlines()}

    return run


def process(jobs: str, output: Path, *options: str, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a batch in a separate process."""
    words = [*COMMAND, jobs, "-o", str(output), *options]
    return subprocess.run(words, capture_output=True, text=True, timeout=120, **how)


def tree(folder: Path) -> dict[str, bytes]:
    """Return the files of a batch's folder, except files that depend on its path."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = {str(path.relative_to(folder)): path.read_bytes() for path in files}
    return {name: data for name, data in names.items() if name not in ("batch.json", ".lock")}


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A small mesh file: a tetrahedron whose material has a map."""
    positions = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "f 1/1 3/3 2/2\nf 1/1 2/2 4/3\nf 1/1 4/3 3/2\nf 2/1 3/2 4/3\n"
    path = tmp_path / "small.obj"
    path.write_text(f"mtllib small.mtl\n{positions}usemtl skin\n{faces}")
    (tmp_path / "small.mtl").write_text("newmtl skin\nmap_Kd -clamp on skin.png\n")
    image = require_module("PIL.Image")
    image.fromarray(np.full((4, 4, 3), (200, 150, 120), np.uint8)).save(tmp_path / "skin.png")
    return path


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_bytes_are_the_same_with_any_workers(table, draw, small, tmp_path, layout):
    jobs = rows(6, outputs="image,mask,depth")
    for job in jobs[::2]:
        job["mesh"] = str(small)
    path = table(jobs)
    for workers in ("1", "2"):
        options = ("--workers", workers, "--layout", layout, "--chunk", "2", "--transforms")
        found = draw(path, workers, *options)
        assert (found["status"], found["done"], found["drawn"]) == (0, 6, 6)
    one, two = tree(tmp_path / "1"), tree(tmp_path / "2")
    assert one == two
    assert len(one) > 4
    again = draw(path, "1", *options)
    assert (again["status"], again["drawn"], again["done"]) == (0, 0, 6)


@pytest.mark.slow
@pytest.mark.usefixtures("measured_gain")
def test_planned_scene_equals_that_of_render(table, draw, tmp_path):
    """The scene file of `facerender plan` is given by an option or by a job."""
    planned, size = str(tmp_path / "planned.toml"), ("--size", "48")
    # Without shadows, the plan has fewer candidates.
    light = "key,radius=0,no-shadow"
    plan = f"plan {MINI_HEAD} --budget 24/255 --within 90% --m 0.3 --size 48 --camera 0 --camera"
    plan += f" -60,20 --light {light} --save-scene {planned} --backend egl --quiet"
    assert main(plan.split()) == 0
    detail = tomllib.loads(Path(planned).read_text())["planned"]
    assert detail.get("drawn_samples", 4) < 4 or "triangles" in detail or detail["cull_back_faces"]
    jobs = rows(2, outputs="image,specular")
    draw(table(jobs), "command", "--scene", planned)
    draw(table([{**job, "scene": planned} for job in jobs]), "job", *size)
    assert tree(tmp_path / "command/data") == tree(tmp_path / "job/data")
    draw(table([{**job, "lights": [light]} for job in jobs]), "exact")
    for job in jobs:
        for only in ("image", "specular"):
            words = ["render", str(MINI_HEAD), "--scene", planned, *size]
            words += ["--camera", f"{job['camera.azimuth']}", "-o", str(tmp_path / "a.png")]
            assert main(words + ["--only", only] * (only != "image")) == 0
            file = f"data/{job['id']}/{only}.png"
            assert (tmp_path / "command" / file).read_bytes() == (tmp_path / "a.png").read_bytes()
            assert (tmp_path / "exact" / file).read_bytes() != (tmp_path / "a.png").read_bytes()

    draw(table([jobs[0] | {"image.size": 64}, jobs[1]]), "other", "--scene", planned)
    records = list(map(json.loads, (tmp_path / "other/jobs.jsonl").read_text().splitlines()))
    assert [record["planned"] for record in records] == [False, True]
    assert "its error is unknown; plan for this size" in records[0]["warnings"][0]
    (tmp_path / "whole.toml").write_text(Path(planned).read_text().partition("[planned]")[0])
    draw(table([jobs[0] | {"image.size": 64}]), "whole", "--scene", str(tmp_path / "whole.toml"))
    file = "data/job000/image.png"
    assert (tmp_path / "other" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_only_changed_jobs_are_drawn_again(table, draw, small, tmp_path, layout):
    options = ("--layout", layout, "--chunk", "4")
    jobs = rows(10, mesh=str(small))
    draw(table(jobs), "out", *options)
    jobs[3]["material.m"] = 0.5
    del jobs[7]
    jobs += [{**jobs[0], "id": "new", "camera.elevation": 20.0}]
    if layout == "files":  # a file that another program overwrote is drawn again
        (tmp_path / "out/data/job000/image.png").write_bytes(b"another's")
    again = draw(table(jobs), "out", "--prune", *options)
    assert again["drawn"] == (3 if layout == "files" else 2)
    draw(table(jobs), "fresh", *options)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


@pytest.mark.parametrize("name", ["small.obj", "small.mtl", "skin.png"])
def test_a_changed_mesh_is_drawn_again(table, draw, small, name):
    path = table([*rows(2, mesh=str(small)), *rows(1, id="other")])
    draw(path, "out")
    changed = small.parent / name
    if name == "skin.png":
        image = require_module("PIL.Image")
        image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(changed)
    else:
        changed.write_text(changed.read_text() + "# changed\n")
    assert draw(path, "out")["drawn"] == 2


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_removed_jobs_are_removed_from_tables_and_data(table, draw, small, tmp_path, layout):
    """Here a whole chunk is removed, and nothing is left to draw."""
    options = ("--layout", layout, "--chunk", "2", "--transforms")
    jobs = rows(4, mesh=str(small))
    draw(table(jobs), "out", *options)
    assert draw(table(jobs[:2]), "out", "--prune", *options)["drawn"] == 0
    draw(table(jobs[:2]), "fresh", *options)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_jobs_of_another_table_are_kept(table, draw, small, tmp_path, layout):
    """The second table changes two jobs and lacks four, of which one failed."""
    options = ("--layout", layout, "--chunk", "2")
    jobs = rows(6, mesh=str(small))
    jobs[5]["mesh"] = str(tmp_path / "none.obj")
    draw(table(jobs), "out", *options)
    about = (tmp_path / "out/batch.json").read_bytes()
    before = tree(tmp_path / "out")
    path = table([{**job, "material.m": 0.5} for job in jobs[:2]])
    found = draw(path, "out", *options)
    assert (found["status"], found["lines"]) == (2, [])
    assert found["err"] == (
        f"facerender: error: {path} lacks 3 of the finished jobs in {tmp_path / 'out'}: give "
        "another folder, or --prune to delete their files\n"
    )
    assert tree(tmp_path / "out") == before
    assert (tmp_path / "out/batch.json").read_bytes() == about

    # A run that was stopped after it set records aside does not permit the next run to delete.
    (tmp_path / "out/stale").mkdir()
    for record in (tmp_path / "out/records").iterdir():
        record.rename(tmp_path / "out/stale" / record.name)
    assert "lacks 3 of the finished jobs" in draw(path, "out", *options)["err"]
    assert draw(path, "out", "--prune", *options)["drawn"] == 2
    draw(path, "fresh", *options)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


def test_files_that_a_mesh_names_are_found(tmp_path):
    buffers = '"buffers": [{"uri": "a%20b.bin"}]'
    images = '[{"uri": "data:,"}, {"uri": "c.png"}, 7]'
    for name, text, named in (
        ("a.gltf", f'{{{buffers}, "images": 5}}', []),
        ("a.gltf", f'{{{buffers}, "images": {images}}}', ["a b.bin", "c.png"]),
        ("a.ply", "ply\ncomment TextureFile skin.png\n", ["skin.png"]),
        ("b.ply", "ply\n comment texturefile  skin.png\n", ["skin.png"]),
    ):
        (tmp_path / name).write_text(text)
        assert [path.name for path in named_files(source_of(tmp_path / name))] == named


@pytest.mark.parametrize("name", MESH_PATHS)
def test_the_key_of_a_job_depends_on_the_content_of_each_file(tmp_path, name):
    path, keys = tmp_path / "file", set()
    for content in ("a", "b"):
        path.write_text(content)
        forget_files()
        keys.add(key_of(Row(0, "a", {"mesh": {name: str(path)}})))
    assert len(keys) == 2


# --- failures -----------------------------------------------------------------------------------


CRASH = """
import os, signal
import facerender.loading as loading
load = loading.load_mesh
def load_or_die(source, **more):
    name = str(getattr(source, "path", source))
    if "crash" in name:
        os.kill(os.getpid(), signal.SIGSEGV)
    if "large" in name:
        raise MemoryError
    if "hangs" in name:
        signal.pause()
    return load(source, **more)
loading.load_mesh = load_or_die
"""


@pytest.mark.slow
@pytest.mark.parametrize(("tries", "timeout"), [(1, 4), pytest.param(2, 8, marks=pytest.mark.slow)])
def test_fatal_jobs_are_isolated(table, draw, small, tmp_path, monkeypatch, tries, timeout):
    (tmp_path / "garbage.glb").write_bytes(Random(1).randbytes(3000))
    os.mkfifo(tmp_path / "pipe.obj")
    (tmp_path / "endless.glb").symlink_to("/dev/zero")
    (tmp_path / "loop.glb").symlink_to("loop.glb")
    (tmp_path / "empty.glb").touch()
    (tmp_path / "folder.glb").mkdir()
    for name in ("crash.obj", "hangs.obj", "large.obj"):
        shutil.copy(small, tmp_path / name)
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(CRASH)
    monkeypatch.syspath_prepend(tmp_path / "site")
    jobs = rows(4, mesh=str(small))
    named = {
        "garbage.glb": "garbage.glb is not glTF",
        "absent.glb": "absent.glb: no such file",
        "pipe.obj": "pipe.obj is a pipe; give a mesh file",
        "endless.glb": "endless.glb is a device; give a mesh file",
        "loop.glb": "loop.glb: ",
        "empty.glb": "empty.glb ",
        "folder.glb": "folder.glb is a directory; ",
        "hangs.obj": f"the worker sent no message for {timeout} s, {tries} times",
        "large.obj": f"the worker ran out of memory, {tries} times: give fewer --workers",
        "crash.obj": f"the worker was killed by SIGSEGV, {tries} times",
    }
    for name in named:
        jobs.insert(2, {**jobs[1], "id": name.partition(".")[0], "mesh": str(tmp_path / name)})
    jobs.insert(3, {**jobs[0], "id": "crash2", "mesh": str(tmp_path / "crash.obj")})
    path = table(jobs)
    options = ("--timeout", str(timeout), "--tries", str(tries), "--chunk", "20")
    found = draw(path, "out", *options, fresh=True)
    assert (found["status"], found["done"], found["failed"]) == (3, 4, 11)
    lines = (tmp_path / "out/failed.jsonl").read_text().splitlines()
    failed = {record["id"]: record for record in map(json.loads, lines)}
    for name, error in named.items():
        assert error in failed[name.partition(".")[0]]["error"]
    assert failed["crash2"]["error"] == failed["crash"]["error"]
    events = [each for each in map(json.loads, found["lines"]) if each["event"] == "failed"]
    assert {each["id"] for each in events} == set(failed)
    ended = [json.loads(line).get("deaths", 0) for line in found["lines"]]
    assert sum(ended) == 3 * tries, "a mesh that ends workers is loaded for one of its jobs"
    died = {e["id"]: e["how"] for e in map(json.loads, found["lines"]) if e["event"] == "died"}
    ends = {"crash": "was killed by SIGSEGV", "large": "ran out of memory"}
    assert died == ends | {"hangs": f"sent no message for {timeout} s"}
    again = draw(path, "out", *options)
    assert (again["status"], again["drawn"], again["failed"]) == (3, 0, 11)

    (tmp_path / "site/sitecustomize.py").unlink()
    repaired = draw(path, "out", "--retry-failed", *options)
    assert (repaired["drawn"], repaired["failed"]) == (4, 7)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_failed_jobs_and_ended_workers_are_named(table, small, tmp_path, monkeypatch, kills):
    """Four jobs of one mesh end their worker, and four meshes are missing."""
    site = tmp_path / "site"
    site.mkdir()
    crash = CRASH.replace("signal.SIGSEGV", "signal.SIGKILL")
    (site / "sitecustomize.py").write_text(
        f"{crash}\n"
        "from facerender.batch import supervisor\n"
        f"counts = iter(range(0, 1000, {kills} or 1000))\n"
        f"supervisor._kills_for_memory = lambda: {kills} and next(counts)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path])}
    shutil.copy(small, tmp_path / "crash.obj")
    jobs = rows(9, mesh=str(small))
    for job in jobs[1:5]:
        job["mesh"] = str(tmp_path / f"lost-{job['id']}.obj")
    for job in jobs[5:]:
        job["mesh"] = str(tmp_path / "crash.obj")
    path, output = table(jobs), tmp_path / "out"
    options = ("--workers", "1", "--tries", "2", "--chunk", "9")
    found = process(path, output, *options, env=environment)
    last = f"{output}: 1 of 9 jobs are done, 8 failed ({output}/failed.jsonl has the reasons)"
    assert found.returncode == 3
    assert found.stdout.startswith(last)
    lines = [line.removeprefix("facerender: ") for line in found.stderr.splitlines()]
    memory = " after the machine ran out of memory" * kills
    for line in lines[:2]:
        start, _, end = line.partition(" was killed by SIGKILL")
        assert start.startswith(f"worker {socket.gethostname()}:")
        assert end == f"{memory} while it loaded the mesh of job job005"
    for line, job in zip(lines[2:6], jobs[1:5], strict=True):
        assert line.startswith(f"job {job['id']} failed: ")
        assert "no such file" in line
    assert f"job job005 failed: the worker was killed by SIGKILL{memory}, 2 times" in lines[6]
    assert ("fewer --workers" in lines[6]) == bool(kills)
    assert len(lines) == 7

    again = process(path, output, *options, env=environment)
    assert again.stdout.startswith(last)
    assert again.stderr.splitlines() == found.stderr.splitlines()[2:]


@pytest.mark.slow
def test_worker_that_dies_at_its_start_is_replaced(table, draw, small, monkeypatch):
    started, killed = Supervisor._started, []

    def started_and_killed(self: Supervisor, timeout: float) -> Any:
        connection = started(self, timeout)
        if not killed:
            killed.append(self._process.kill() or self._process.wait())
        return connection

    monkeypatch.setattr(Supervisor, "_started", started_and_killed)
    found = draw(table(rows(1, mesh=str(small))), "out")
    died, chunk = map(json.loads, found["lines"][:2])
    assert (found["status"], died["how"], chunk["deaths"]) == (0, "was killed by SIGKILL", 1)


def test_a_table_is_read_once(draw, small, tmp_path):
    """A Python table may yield other rows when it is run again."""
    path = tmp_path / "jobs.py"
    path.write_text(
        "import random\nfrom pathlib import Path\n"
        "def jobs():\n"
        f"    with Path({str(tmp_path / 'calls')!r}).open('a') as file:\n"
        "        file.write('called ')\n"
        "    for i in range(4):\n"
        f"        yield {{'mesh': {str(small)!r}, 'camera.azimuth': random.random()}}\n"
    )
    found = draw(str(path), "out", "--chunk", "2")
    assert (found["status"], found["drawn"]) == (0, 4)
    assert (tmp_path / "calls").read_text() == "called "


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_data_of_interrupted_and_removed_jobs_is_deleted(
    table, draw, small, tmp_path, layout, monkeypatch
):
    options = ("--layout", layout, "--chunk", "2")
    jobs = rows(4, mesh=str(small))

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:  # interrupts after the data, before the record
        patched.setattr("facerender.batch.records.commit", die)
        draw(table(jobs), "out", *options)
    draw(table(jobs[1:]), "out", *options)
    draw(table(jobs[1:]), "fresh", *options)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")
    assert len([*(tmp_path / "out/data").glob("*")]) == (3 if layout == "files" else 0)


@pytest.mark.first_case
@pytest.mark.parametrize("step", ["move", "drop", "put"])
def test_coordinator_may_stop_at_any_write(table, draw, small, tmp_path, monkeypatch, step):
    """It is interrupted at the first, second, ... call of one storage operation."""
    options = ("--chunk", "2", "--transforms")
    jobs = rows(4, mesh=str(small))
    draw(table(jobs[1:]), "fresh", *options)
    real = getattr(Storage, step)
    for count in range(20):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        draw(table(jobs), "out", *options)
        left = iter(range(count))

        def or_die(*given: Any, left: Iterator[int] = left) -> Any:
            if threading.current_thread() is threading.main_thread() and next(left, None) is None:
                raise KeyboardInterrupt
            return real(*given)

        with monkeypatch.context() as patched:
            patched.setattr(Storage, step, or_die)
            ended = draw(table(jobs[1:]), "out", "--prune", *options)["status"]
        assert draw(table(jobs[1:]), "out", "--prune", *options)["status"] == 0
        assert tree(tmp_path / "out") == tree(tmp_path / "fresh")
        if ended == 0:
            return
    raise AssertionError("it never came to its end")


def test_superseded_run_writes_nothing(table, draw, small, tmp_path):
    jobs = rows(2, mesh=str(small))
    draw(table(jobs), "out", "--chunk", "2")
    before = tree(tmp_path / "out")
    (chunk,) = chunks(JobTable(table([{**job, "material.m": 0.5} for job in jobs])), 2)
    with pytest.raises(fr.InputError, match="another run of the batch has started"):
        draw_chunk(Settings(str(tmp_path / "out"), code_version=code_version()), chunk)
    assert tree(tmp_path / "out") == before


def test_file_that_changed_before_drawing_fails_the_jobs(table, draw, small, tmp_path):
    (chunk,) = chunks(JobTable(table(rows(2, mesh=str(small)))), 2)
    small.write_text(small.read_text() + "# changed\n")
    outcome = draw_chunk(Settings(str(tmp_path / "out"), code_version=code_version()), chunk)
    assert [record["id"] for record in outcome.failed] == ["job000", "job001"]
    assert "differ from the files that the coordinator read" in outcome.failed[0]["error"]


def test_status_and_check(table, draw, small, capsys, tmp_path):
    path = table(rows(3, mesh=str(small)))
    draw(path, "out")
    assert main(["batch", "--status", str(tmp_path / "out")]) == 0
    assert "3 of 3 jobs are done, 0 failed" in capsys.readouterr().out
    assert main(["batch", path, "--check"]) == 0
    assert capsys.readouterr().out == f"{path}: 3 jobs of 1 meshes\n"
    assert main(["batch", "--status", str(tmp_path / "none")]) == 2
    assert main(["batch", table([*rows(1), {"camera.azimuth": "left"}]), "-o", "x"]) == 2
    assert "row 2" in capsys.readouterr().err
    assert main(["batch", path, "--check", "--rotate", "0,90"]) == 2
    assert "error: mesh rotate = '0,90': give three numbers" in capsys.readouterr().err


def check_faults(path: str, capsys: pytest.CaptureFixture[str], faults: dict[int, str]) -> None:
    """Check that ``batch --check`` prints a line for each row with its message."""
    assert main(["batch", path, "--check"]) == 2
    out, err = capsys.readouterr()
    assert not out
    for line, (row, message) in zip(err.splitlines(), faults.items(), strict=True):
        assert line.startswith(f"facerender: error: jobs.jsonl, row {row} (line {row})")
        assert message in line


def test_check_names_every_file_that_cannot_be_used(table, small, tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.obj")
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "noise.glb").write_bytes(Random(1).randbytes(3000))
    (tmp_path / "noise.npy").write_bytes(Random(2).randbytes(3000))
    (tmp_path / "short.png").write_bytes((tmp_path / "skin.png").read_bytes()[:50])
    shutil.copy(small, tmp_path / "map.obj")
    (tmp_path / "map.obj").write_text(small.read_text().replace("small.mtl", "map.mtl"))
    (tmp_path / "map.mtl").write_text("newmtl skin\nmap_Kd short.png\n")
    faults: list[tuple[dict[str, Any], str]] = [
        ({"mesh": "none.glb"}, "cannot read {}/none.glb: no such file or directory; give a mesh"),
        ({"mesh": "pipe.obj"}, "{}/pipe.obj is a pipe; give a mesh file"),
        ({"mesh": "noise.glb"}, "noise.glb is not glTF"),
        ({"mesh": "map.obj"}, "short.png is damaged"),
        ({"mesh.albedo": "none.png"}, "cannot read {}/none.png: no such file"),
        ({"mesh.normal_map": "short.png"}, "short.png is damaged"),
        ({"environment": "none.npy"}, "cannot read {}/none.npy: no such file"),
        ({"environment": "noise.npy"}, "{}/noise.npy is not a NumPy file"),
        ({"landmarks": "pipe.json"}, "{}/pipe.json is a pipe; give a JSON file with landmarks"),
        ({"pose.vertices": "noise.npy"}, "noise.npy is damaged"),
        ({"before.vertices": "none.npy"}, "cannot read {}/none.npy: no such file"),
    ]
    good = {"mesh": str(small)}
    jobs: list[dict[str, Any]] = [good]
    for job, _ in faults:
        named = {key: str(tmp_path / value) for key, value in job.items()}
        jobs += [{**({} if "mesh" in job else good), **named}] * 2
    # This albedo map replaces the damaged map of the mesh file.
    jobs.append({"mesh": str(tmp_path / "map.obj"), "mesh.albedo": str(tmp_path / "skin.png")})
    lines = {2 * i + 2: f": {text.format(tmp_path)}" for i, (_, text) in enumerate(faults)}
    check_faults(table(jobs), capsys, lines)
    path = table([{"camera.azimuth": "left"}, *jobs[3:]])
    assert main(["batch", path, "--check"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert "row 1 (line 1): camera azimuth" in lines[0]
    assert len(lines) == len(faults)


def test_check_names_poses_and_landmarks_that_do_not_fit(table, small, tmp_path, capsys):
    np.save(tmp_path / "three.npy", np.zeros((1, 3, 3)))
    np.save(tmp_path / "four.npy", np.random.default_rng(1).random((2, 4, 3)))
    (tmp_path / "far.json").write_text('{"nose": 7}')
    (tmp_path / "near.json").write_text('{"nose": 3}')
    still = {"mesh": str(small)}
    no_rig = "small.obj has no shapes, clips or joints: give a glTF file with a rig, or leave out"
    faults: list[tuple[dict[str, Any], str]] = [
        ({**still, "pose.weights": {"jawOpen": 1.0, "jawLeft": 0.5}}, no_rig),
        ({"pose.weights": {"jawOpn": 1.0}}, "head.glb has no shape 'jawOpn': its shapes are"),
        ({"pose.joints": {"a.1": [0, 9, 0]}}, "head.glb has no joint 'a.1': it has no joints"),
        ({"pose.clip": "walk"}, "clip = 'walk', which head.glb lacks: its clips are talk"),
        ({"pose.clip": "talk", "pose.time": 9.0}, "time of clip 'talk' = 9.0"),
        ({"before.weights": {"a": 1.0}, "outputs": "motion"}, "head.glb has no shape 'a'"),
        ({**still, "landmarks": "far.json"}, "landmark 'nose': vertex 7, but small.obj has 4"),
        ({**still, "pose.vertices": "three.npy"}, "small.obj"),
        ({**still, "pose.vertices": "four.npy", "pose.frame": 2}, "four.npy has 2 frames: frame"),
        ({"mesh.parts": "hat"}, "no part of head.glb is called 'hat'"),
    ]
    good = [
        {"pose.weights": {"jawOpen": 0.4}},
        {"pose.time": 1.5},
        {"pose.clip": "talk", "pose.time": 0.5},
        {**still, "before.weights": {"jawOpen": 1.0}},  # no output needs the frame before
        {**still, "landmarks": "near.json"},
        {**still, "pose.vertices": "four.npy", "pose.frame": 1},
    ]
    jobs = []
    for job in (*(job for job, _ in faults), *good):
        paths = {n: str(tmp_path / job[n]) for n in ("pose.vertices", "landmarks") if n in job}
        jobs.append({**job, **paths})
    check_faults(table(jobs), capsys, {i: text for i, (_, text) in enumerate(faults, 1)})
    assert main(["batch", table(jobs[len(faults) :]), "--check"]) == 0


def test_check_reads_each_file_once(table, small, capsys, monkeypatch):
    read = []
    monkeypatch.setattr(
        "facerender.batch.outputs.load_mesh",
        lambda file: read.append(file.path) or fr.load_mesh(file),
    )
    path = table(rows(300, mesh=str(small)))
    assert main(["batch", path, "--check"]) == 0
    assert capsys.readouterr().out == f"{path}: 300 jobs of 1 meshes\n"
    assert read == [str(small)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", "0"], "--workers 0: give at least 1"),
        (["--timeout", "nan"], "--timeout nan: give at least 1"),
        (["--chunk", "0"], "--chunk 0: give at least 1"),
        (["--scene", "none.toml"], "cannot read none.toml: no such file"),
        (["-o", "nowhere://here"], "nowhere://here cannot be reached"),
        (["--layout", "shards"], "id 'a.1' contains a dot, at which readers of shards split"),
        (["-o", "/dev/null/out"], "cannot write /dev/null/out: not a directory; correct this"),
    ],
)
def test_batch_that_cannot_start_prints_one_line(table, draw, options, message):
    found = draw(table([{"id": "a.1"}]), "out", *options)
    assert found["status"] == 2
    assert found["err"].startswith("facerender: error: ")
    assert message in found["err"]
    assert found["err"].count("\n") == 1


def test_a_folder_has_one_coordinator(table, draw, small, tmp_path):
    path = table(rows(1, mesh=str(small)))
    with locked(str(tmp_path / "out")):
        found = draw(path, "out")
    assert (found["status"], "another batch is being written" in found["err"]) == (2, True)
    assert draw(path, "out")["status"] == 0


def test_a_full_disk_stops_the_batch(table, small, tmp_path):
    path = table(rows(4, mesh=str(small)))
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (900, 900))
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}  # truncated bytecode would remain
    options = {"preexec_fn": limit, "env": environment}
    found = process(path, tmp_path / "out", "--workers", "1", **options)
    assert found.returncode == 2
    assert "file too large; raise the limit of file sizes" in found.stderr.splitlines()[-1]
    assert not list((tmp_path / "out").glob("records/*.jsonl"))


DISK = {
    errno.ENOSPC: "no space left on device; free space there",
    errno.EDQUOT: "disk quota exceeded; free space there",
    errno.EROFS: "read-only file system; make it writable",
    errno.EACCES: "permission denied; correct its permissions",
    errno.EIO: "input/output error; check the disk",
}


def check_one_line(found: dict[str, Any], place: Path, number: int) -> None:
    """Check that a batch ended with the message for a disk that fails with an error number."""
    assert found["status"] == 2
    (line,) = found["err"].splitlines()
    assert line.startswith(f"facerender: error: cannot write {place}")
    assert line.endswith(f"{DISK[number]}, and run the same command again")


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("number", "step"),
    [*((number, 9) for number in DISK), pytest.param(errno.ENOSPC, 1, marks=pytest.mark.slow)],
)
def test_disk_may_fail_at_any_write(table, draw, small, tmp_path, monkeypatch, number, step):
    """The coordinator's first, second, ... change of a file fails, and so do all later changes.

    The folder has files of an earlier table, which the batch removes.
    """
    options = ("--chunk", "2", "--transforms", "--layout", "shards")
    jobs, output = rows(4, mesh=str(small)), tmp_path / "out"
    jobs[3]["mesh"] = str(tmp_path / "lost.obj")
    draw(table(jobs[1:]), "before", *options)
    path = table(jobs)
    draw(path, "fresh", *options)
    for turn in range(0, 100, step):
        shutil.rmtree(output, ignore_errors=True)
        shutil.copytree(tmp_path / "before", output)
        with monkeypatch.context() as patched:
            for (module, name), function in failing(str(output), turn, number).items():
                patched.setattr(module, name, function)
            found = draw(path, "out", *options)
        if found["status"] == 3:
            assert turn > 20
            return
        check_one_line(found, output, number)
        assert not [*output.glob(".unfinished/*")]
        for name in output.rglob("*.json*"):
            assert name.read_bytes().endswith(b"\n")
        assert draw(path, "out", *options)["status"] == 3
        assert tree(output) == tree(tmp_path / "fresh")
    raise AssertionError("it never came to its end")


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["files", pytest.param("shards", marks=pytest.mark.slow)])
def test_disk_may_fail_at_any_write_of_a_worker(table, draw, small, tmp_path, monkeypatch, layout):
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(
        "import os, sys\n"
        "from tests.faults import failing\n"
        "turn = os.environ.get('TURN')\n"
        "if turn and 'facerender.batch.worker' in sys.orig_argv:\n"
        f"    place, number = {str(tmp_path / 'out')!r}, {errno.ENOSPC}\n"
        "    for (module, name), function in failing(place, int(turn), number).items():\n"
        "        setattr(module, name, function)\n"
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    options = ("--chunk", "2", "--layout", layout)
    path = table(rows(4, mesh=str(small)))
    draw(path, "fresh", *options)
    for turn in (0, 1, 3):
        monkeypatch.setenv("TURN", str(turn))
        check_one_line(draw(path, "out", *options, fresh=True), tmp_path / "out", errno.ENOSPC)
        assert not [*(tmp_path / "out").glob(".unfinished/*")]
    assert draw(path, "out", *options)["status"] == 0
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


def test_disk_may_be_full_for_a_parquet_table(table, draw, small, tmp_path):
    require_module("pyarrow")
    path, output = table(rows(4, mesh=str(small))), tmp_path / "out"
    draw(path, "fresh", "--table", "parquet")
    draw(path, "out")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = (output / "jobs.jsonl").stat().st_size
    assert size < (tmp_path / "fresh/jobs.parquet").stat().st_size
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        found = draw(path, "out", "--table", "parquet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (found["status"], found["err"].count("\n")) == (2, 1)
    assert f"cannot write {output}: file too large; raise the limit" in found["err"]
    assert not (output / "jobs.parquet").exists()
    draw(path, "out", "--table", "parquet")
    fresh = (tmp_path / "fresh/jobs.parquet").read_bytes()
    assert (output / "jobs.parquet").read_bytes() == fresh


def test_disk_may_be_full_for_temporary_files(table, draw, monkeypatch):
    """Rows that do not fit into memory are written to a temporary file."""
    monkeypatch.setattr("facerender.batch.records._IN_MEMORY", 1)
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: open("/dev/full", "w+b"))  # noqa: SIM115
    found = draw(table(rows(1)), "out")
    assert (found["status"], found["err"].count("\n")) == (2, 1)
    assert "no space left on device; free space there, or set TMPDIR to another" in found["err"]


def test_available_memory_respects_the_control_group(monkeypatch):
    group = "/sys/fs/cgroup/memory"
    files = {"/proc/meminfo": "MemFree: 9 kB\nMemAvailable: 8388608 kB\n"}
    files |= {f"{group}.max": f"{3 << 30}\n", f"{group}.current": f"{1 << 30}\n"}
    monkeypatch.setattr(Path, "read_text", lambda path: files[str(path)])
    assert available() == 2048.0
    files[f"{group}.max"] = "max\n"
    assert available() == 8192.0


def test_no_opengl_stops_the_batch(table, draw, small, monkeypatch):
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/dev/null")
    found = draw(table(rows(4, mesh=str(small))), "out", "--backend", "egl", fresh=True)
    assert found["status"] == 2
    assert found["err"].splitlines()[-1].startswith("facerender: error: no OpenGL context")


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["files", "shards"])
def test_killed_again_and_again(table, draw, small, tmp_path, layout):
    path = table(rows(240, mesh=str(small)))
    options = ["--layout", layout, "--chunk", "3", "--workers", "2"]
    records, kills, random = tmp_path / "out/records", 0, Random(7)
    for _ in range(4):
        before = len([*records.glob("*")])
        command = [*COMMAND, path, "-o", str(tmp_path / "out"), *options]
        coordinator = psutil.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        end = time.monotonic() + 60.0
        while coordinator.poll() is None and len([*records.glob("*")]) == before:
            assert time.monotonic() < end
            time.sleep(0.02)
        with suppress(psutil.NoSuchProcess):  # it may just have ended
            random.choice([coordinator, *coordinator.children()]).kill()
            kills += 1
            time.sleep(random.uniform(0.0, 0.5))
            coordinator.kill()
        coordinator.wait()
    assert kills > 1
    found = draw(path, "out", *options)
    assert (found["status"], found["done"]) == (0, 240)
    draw(path, "fresh", *options)
    assert tree(tmp_path / "out") == tree(tmp_path / "fresh")


# --- storage and readers of the results ---------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # leaves files open
def test_webdataset_reads_shards(table, draw, small, tmp_path):
    webdataset = require_module("webdataset")
    draw(table(rows(5, mesh=str(small), outputs="image,depth")), "out", "--layout", "shards")
    shards = sorted(str(path) for path in (tmp_path / "out/shards").glob("*.tar"))
    found = list(webdataset.WebDataset(shards, shardshuffle=False).decode("rgb8"))
    assert [each["__key__"] for each in found] == [f"job{i:03d}" for i in range(5)]
    assert found[0]["image.png"].shape == (48, 48, 3)
    assert found[2]["json"]["camera"]["width"] == 48
    assert found[2]["json"]["depth_scale"] > 0.0


def test_tables(table, draw, small, tmp_path):
    parquet = require_module("pyarrow.parquet")
    path = table([*rows(3, mesh=str(small)), *rows(1, id="lit", lights=["10,20"])])
    draw(path, "out", "--transforms")
    records = [json.loads(line) for line in (tmp_path / "out/jobs.jsonl").read_text().splitlines()]
    assert sorted(record["number"] for record in records) == [0, 1, 2, 3]
    draw(path, "out", "--table", "parquet")
    found = parquet.read_table(tmp_path / "out/jobs.parquet").to_pylist()
    for name in ("id", "number"):  # one number is 0, which must not become null
        assert [row[name] for row in found] == [record[name] for record in records]
    lit = next(row for row in found if row["id"] == "lit")
    assert json.loads(lit["job.lights"])[0]["azimuth"] == 10.0
    assert lit["camera.K"] == next(r for r in records if r["id"] == "lit")["camera"]["K"]
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [
        f"data/{record['id']}/image.png" for record in records
    ]
    assert all((tmp_path / "out" / frame["file_path"]).is_file() for frame in frames)


def test_transforms_name_the_files_of_unpacked_shards(table, draw, small, tmp_path):
    path = table(rows(3, mesh=str(small), outputs="mask,depth"))
    draw(path, "out", "--transforms", "--layout", "shards", "--chunk", "2")
    for shard in (tmp_path / "out/shards").iterdir():
        with tarfile.open(shard) as tar:
            for member in tar:
                (tmp_path / "out" / member.name).write_bytes(tar.extractfile(member).read())
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    found = {frame["file_path"]: frame["w"] for frame in frames}
    assert found == {f"job{number:03d}.depth.png": 48 for number in range(3)}
    assert all((tmp_path / "out" / name).read_bytes()[1:4] == b"PNG" for name in found)


@pytest.fixture
def s3(monkeypatch) -> Iterator[str]:
    server = require_module("moto.server").ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
        ("AWS_ACCESS_KEY_ID", "any"),
        ("AWS_SECRET_ACCESS_KEY", "any"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    require_module("s3fs").S3FileSystem.clear_instance_cache()  # connections to an earlier server
    require_module("s3fs").S3FileSystem().makedirs("heads", exist_ok=True)
    yield "s3://heads"
    server.stop()


def check_place(table, draw, small, tmp_path: Path, place: str, layout: str, fresh: bool) -> None:
    """Check that a batch in ``place`` has the same files as in a folder, also after a change."""
    options = ("--layout", layout, "--chunk", "2")
    jobs = rows(5, mesh=str(small))
    path = table(jobs)
    draw(path, "local", *options)
    assert draw(path, "x", *options, "-o", place, fresh=fresh)["drawn"] == 5
    assert draw(path, "x", *options, "-o", place, fresh=fresh)["drawn"] == 0
    jobs[0]["material.m"] = 0.5
    path = table(jobs)
    assert draw(path, "x", *options, "-o", place, fresh=fresh)["drawn"] == 1
    draw(path, "local", *options)
    system, there = require_module("fsspec").url_to_fs(place, use_listings_cache=False)
    system.get(there, str(tmp_path / "copy"), recursive=True)
    assert tree(tmp_path / "copy") == tree(tmp_path / "local")


@pytest.mark.cluster
@pytest.mark.parametrize("layout", ["files", "shards"])
def test_an_object_store_gets_the_same_files(table, draw, small, tmp_path, s3, layout):
    check_place(table, draw, small, tmp_path, f"{s3}/{layout}", layout, fresh=True)


def test_a_url_leaves_the_temporary_folder_empty(table, draw, small, tmp_path, monkeypatch):
    """Another user of the machine could not write to a folder that stays."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setenv("TMPDIR", str(temporary))
    for folder in ("begun", "records", "shards", "stale"):
        (tmp_path / "there" / folder).mkdir(parents=True)
    place = f"file://{tmp_path}/there"
    jobs = table(rows(1, mesh=str(small)))
    assert draw(jobs, "x", "--layout", "shards", "-o", place, fresh=True)["drawn"] == 1
    assert [*temporary.glob(".*")] == []


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_a_url_gets_the_same_files(table, draw, small, tmp_path, layout):
    for folder in ("begun", "records", "shards", "stale", *(f"data/job{i:03d}" for i in range(5))):
        (tmp_path / "there" / folder).mkdir(parents=True)  # file:// needs folders
    check_place(table, draw, small, tmp_path, f"file://{tmp_path}/there", layout, fresh=False)


# --- Dask ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a scheduler with two workers, started as in docs/batch.md."""
    require_module("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "dask"]
    scheduler = [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    workers = [*dask, "worker", address, "--nthreads", "1", "--nworkers", "2", "--no-dashboard"]
    started = [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for command in (scheduler, workers)
    ]
    yield address
    for process in reversed(started):
        process.send_signal(signal.SIGTERM)
        process.wait()


@pytest.mark.cluster
def test_a_cluster_draws_the_same_bytes(table, draw, small, tmp_path, cluster):
    jobs = rows(8, outputs="image,mask")
    for job in jobs[::2]:
        job["mesh"] = str(small)
    jobs.append({**jobs[0], "id": "absent", "mesh": str(tmp_path / "absent.glb")})
    path = table(jobs)
    options = ("--layout", "shards", "--chunk", "3")
    there = draw(path, "there", *options, "--scheduler", cluster)
    here = draw(path, "here", *options)
    assert (there["status"], there["done"], there["failed"]) == (3, 8, 1)
    assert (here["status"], here["done"]) == (3, 8)
    assert tree(tmp_path / "there") == tree(tmp_path / "here")


@pytest.mark.slow
@pytest.mark.cluster
@pytest.mark.smoke
def test_a_cluster_of_this_process_draws_four_jobs(table, draw, small, tmp_path):
    distributed = require_module("distributed")
    path = table(rows(4, mesh=str(small)))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0"
    ) as cluster:
        there = draw(path, "there", "--chunk", "2", "--scheduler", cluster.scheduler_address)
    assert (there["status"], there["drawn"]) == (0, 4)
    draw(path, "here", "--chunk", "2")
    assert tree(tmp_path / "there") == tree(tmp_path / "here")


def test_without_a_scheduler(table, draw, monkeypatch):
    require_module("distributed")
    monkeypatch.setattr("facerender.batch.supervisor._SECONDS", 0.1)
    found = draw(table(rows(1)), "out", "--scheduler", "tcp://127.0.0.1:1")
    assert found["status"] == 2
    assert "no scheduler at tcp://127.0.0.1:1" in found["err"]


# --- chunks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("jobs", "files", "shards"), [(40, 1, 32), (1000, 8, 32), (4200, 64, 64)])
def test_shards_have_at_least_32_jobs(jobs, files, shards):
    given = [Row(i, f"{i}", {}) for i in range(jobs)]
    for layout, size in (("files", files), ("shards", shards)):
        sizes = [len(chunk.rows) for chunk in chunks(given, layout=layout)]
        assert set(sizes[:-1]) == {size}
        assert 0 < sizes[-1] <= size
