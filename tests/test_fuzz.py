"""Tests every reader on randomly mutated files: it returns a valid result or raises an error of one
line. ``make fuzz`` runs more inputs."""

from __future__ import annotations

import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest

import facerender as fr
from facerender.errors import FacerenderError, InputError, warn
from tests.conftest import require_module
from tests.verification.fuzz.mutate import mutate
from tests.verification.fuzz.subjects import FAULTS, REDUCED, Subject, examine, subjects

ROOT = Path(__file__).parents[1]
FOUND = sorted((Path(__file__).parent / "data" / "fuzz").iterdir())
LARGE = 64 << 20


@pytest.fixture(autouse=True)
def _reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, value in REDUCED:
        monkeypatch.setattr(module, name, value)


def named(name: str) -> Subject:
    (subject,) = (each for each in subjects() if each.name == name)
    return subject


@pytest.mark.first_case
@pytest.mark.parametrize("inputs", [4, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("subject", subjects(), ids=lambda subject: subject.name)
def test_changed_files_are_read_or_refused(subject: Subject, inputs: int, tmp_path: Path) -> None:
    seed = examine(subject, subject.seed, tmp_path / "a")
    assert seed.outcome in ("clean", "warned")  # some seeds cause warnings
    random, faults = Random(subject.name), set()
    for _ in range(inputs):
        content = subject.seed
        for _ in range(random.choice((1, 1, 2, 4))):
            content = mutate(content, subject.suffix, random)
        result = examine(subject, content, tmp_path / "a")
        if result.outcome in FAULTS:
            faults.add(result)
    assert not faults
    for length in range(64):  # truncated files can be mutated, too
        mutate(subject.seed[:length], subject.suffix, random)


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_inputs_that_failed_once_pass(path: Path, tmp_path: Path) -> None:
    subject = named(path.stem.rpartition("-")[0])
    assert examine(subject, path.read_bytes(), tmp_path / "a").outcome not in FAULTS


@pytest.mark.slow
def test_the_guided_fuzzer_runs(tmp_path: Path) -> None:
    require_module("atheris")
    command = [sys.executable, "-m", "tools.fuzz", "--inputs", "200", "--only", "jobs-"]
    run = subprocess.run([*command, "-o", tmp_path], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert int(run.stdout.split()[0]) >= 200


HOLDS = """
from tools.fuzz import following
with following():
    from pathlib import Path
import facerender as fr
from facerender.mesh.mesh import Mesh

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) >> 8  # MiB

(part,) = fr.load_mesh("tests/data/mini_head.glb").parts
for count in range(30):
    mesh = Mesh.from_arrays(part.positions, part.faces)
    mesh.regions
    if count == 9:
        start = resident()
print(resident() - start)
"""


@pytest.mark.memory
def test_tracing_keeps_no_memory() -> None:
    """Atheris traces comparisons; without a workaround it would keep 5 MiB for each mesh."""
    require_module("atheris")
    run = subprocess.run(
        [sys.executable, "-c", HOLDS], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert int(run.stdout) < 20


def failing(error: Exception) -> Callable[[Path], None]:
    def examine(folder: Path) -> None:
        raise error

    return examine


@pytest.mark.parametrize(
    ("examiner", "outcome"),
    [
        (failing(FacerenderError("x" * 1000)), "unsound"),
        (failing(IndexError()), "crash"),
        (failing(InputError("a.glb is damaged (); export it again")), "unsound"),
        (lambda folder: warnings.warn("something", stacklevel=1), "unsound"),
        (lambda folder: warn("a\nb"), "unsound"),
        (lambda folder: bytearray(LARGE + (32 << 20)), "large"),
    ],
)
def test_faults_are_detected(
    examiner: Callable[[Path], None],
    outcome: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tests.verification.fuzz.subjects.LARGE", LARGE)
    subject = Subject("made up", {"a": b""}, "a", examiner)
    assert examine(subject, b"", tmp_path / "a").outcome == outcome


def test_slow_inputs_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(folder: Path) -> None:
        start = time.process_time()
        while time.process_time() - start < 0.2:
            pass

    subject = Subject("made up", {"a": b""}, "a", busy)
    for most, outcome in ((0.1, "slow"), (10.0, "clean")):
        monkeypatch.setattr("tests.verification.fuzz.subjects.SLOW", most)
        assert examine(subject, b"", tmp_path / "a").outcome == outcome


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_empty_images_are_detected(
    value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = fr.Frame(np.full((8, 8, 4), value, np.float32), None, False, {})
    monkeypatch.setattr(fr.Renderer, "render", lambda *_: frame)
    assert examine(named("a.glb-0"), named("a.glb-0").seed, tmp_path / "a").outcome == "unsound"
