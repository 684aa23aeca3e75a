"""Plans of batches: which jobs share one, that images stay within the budget and all else exact,
and that a plan is made once, whatever becomes of its planner."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from facerender.batch import groups, plans
from facerender.batch.chunk import chunks
from facerender.batch.groups import grouped, with_plans
from facerender.batch.jobs import Row, read_jobs
from tests.awkward_files import MINI_HEAD
from tests.test_cli import Capture, Cli

Few = Callable[[int, int], None]

JOBS = 24
TABLE = f"""
passes = ["image", "mask"]
mesh = "{MINI_HEAD}"
[material]
m = 0.3
[image]
size = 48
samples = 4
[grid]
"camera.azimuth" = {{ from = -60, to = 60, count = {JOBS} }}
"""
PLANNED = ("--budget", "24/255", "--within", "90%", "--workers", "1")


@pytest.fixture
def cli(tmp_path: Path, capsys: Capture, egl: str) -> Cli:
    folder = tmp_path / "out"
    folder.mkdir()
    return Cli(folder, capsys)


def written(folder: Path, count: int = JOBS) -> Path:
    path = folder / "t.toml"
    path.write_text(TABLE.replace(f"count = {JOBS}", f"count = {count}"))
    return path


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> Few:
    """So few jobs pay for a plan, of so many cameras."""

    def few(fewest: int, cameras: int) -> None:
        monkeypatch.setattr(groups, "FEWEST", fewest)
        monkeypatch.setattr(groups, "CAMERAS", cameras)

    return few


def rows_of(count: int, **tables: Any) -> list[Row]:
    """Jobs with cameras side by side."""
    return [
        Row(number, f"{number}", {**tables, "camera": {"azimuth": 0.25 * number}})
        for number in range(count)
    ]


def found(rows: list[Row]) -> groups.Groups:
    return grouped(lambda: rows, "1/255", "100%")


def digests(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("data/*/*.png")
    }


def test_a_group_is_what_differs_in_its_cameras(few: Few) -> None:
    few(8, 4)
    both = rows_of(20) + rows_of(12, ambient=0.5) + rows_of(7, ambient=0.7)
    made = found(both)
    assert sorted(group.jobs for group in made.of.values()) == [12, 20]
    assert (made.few, made.groups_of_few, made.unserved) == (7, 1, 0)
    assert all(len(group.cameras) == 4 for group in made.of.values())
    assert all("camera" not in group.tables for group in made.of.values())


def test_the_sample_is_that_of_the_cameras(few: Few) -> None:
    few(8, 4)
    rows = rows_of(40)
    again = [*rows, *rows]
    random.Random(1).shuffle(again)
    (one,), (other,) = found(rows).of.values(), found(again).of.values()
    assert (one.cameras, one.name) == (other.cameras, other.name)
    assert (one.jobs, other.jobs) == (40, 80)
    assert one.cameras != tuple(row.tables["camera"] for row in rows[:4])
    (third,) = grouped(lambda: rows, "2/255", "100%").of.values()
    assert third.name != one.name


def test_a_random_slope_starts_no_plan() -> None:
    rows = [Row(i, f"{i}", {"material": {"m": 0.2 + 1e-6 * i}, "camera": {}}) for i in range(2000)]
    made = found(rows)
    assert not made.of
    assert (made.few, made.groups_of_few) == (2000, 2000)


def test_the_largest_groups_are_planned(few: Few, monkeypatch: pytest.MonkeyPatch) -> None:
    few(2, 4)
    monkeypatch.setattr(groups, "MOST", 1)
    made = found(rows_of(5, ambient=0.5) + rows_of(9))
    assert [group.jobs for group in made.of.values()] == [9]
    assert (made.few, made.groups_of_few) == (5, 1)


def test_layers_and_data_have_no_plan(few: Few) -> None:
    few(2, 4)
    rows = [
        Row(0, "a", {}, ("image", "layers")),
        Row(1, "b", {}, ("mask", "specular")),
        *[Row(number, f"{number}", {}, ("image", "depth")) for number in (2, 3)],
    ]
    made = found(rows)
    ((number, group),) = made.of.items()
    assert (group.jobs, made.unserved) == (2, 2)
    plan = {"shading": {"m": 0.3}, "planned": {}}
    assert [row.plan for row in with_plans(rows, {number: plan})] == [None, None, plan, plan]


def test_a_mesh_with_another_content_has_another_plan(few: Few, tmp_path: Path) -> None:
    few(2, 4)
    mesh = tmp_path / "a.glb"
    mesh.write_bytes(MINI_HEAD.read_bytes())
    (before,) = found(rows_of(3, mesh={"path": str(mesh)})).of.values()
    name = before.name
    moved = mesh.rename(tmp_path / "b.glb")
    (same,) = found(rows_of(3, mesh={"path": str(moved)})).of.values()
    other = tmp_path / "c.glb"
    other.write_bytes(MINI_HEAD.read_bytes() + b" ")
    (changed,) = found(rows_of(3, mesh={"path": str(other)})).of.values()
    assert same.name == name != changed.name


def test_images_are_within_and_all_else_is_exact(
    cli: Cli,
    tmp_path: Path,
    few: Few,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few(JOBS, 10)
    table = written(tmp_path)
    exact, cheap = cli.folder / "exact", cli.folder / "cheap"
    assert cli.run("batch", table, "-o", exact, "--workers", "1")[0] == 0
    status, out, err = cli.run("batch", table, "-o", cheap, "--json", *PLANNED)
    assert status == 0
    assert f"plan of {MINI_HEAD}, {JOBS} jobs: errs by " in err
    end = json.loads(out.splitlines()[-1])
    assert end["plans"]["jobs"] == end["plans"]["jobs_of_batch"] == JOBS
    assert json.loads((cheap / "batch.json").read_text())["plans"] == end["plans"]
    records = [json.loads(line) for line in (cheap / "jobs.jsonl").read_text().splitlines()]
    assert len(records) == JOBS
    assert all(record["planned"] and record["plan"] for record in records)

    full, drawn = digests(exact), digests(cheap)
    assert full.keys() == drawn.keys()
    differ = [name for name in full if full[name] != drawn[name]]
    assert differ
    assert {Path(name).name for name in differ} == {"image.png"}
    for name in differ:
        images = [
            np.asarray(Image.open(root / name))[..., :3].astype(int) for root in (exact, cheap)
        ]
        errors = np.abs(images[0] - images[1]).max(axis=-1)
        covered = np.asarray(Image.open(exact / Path(name).parent / "mask.png")) > 0
        assert np.count_nonzero(errors > 25) <= 0.1 * np.count_nonzero(covered) + 1

    def refuse(*_: Any) -> None:
        raise AssertionError("planned again")

    monkeypatch.setattr(plans, "plan_group", refuse)
    for each in (cheap / "records").iterdir():
        each.unlink()
    (cheap / "jobs.jsonl").unlink()
    status, out, _ = cli.run("batch", table, "-o", cheap, "--json", *PLANNED)
    assert status == 0
    assert digests(cheap) == drawn
    end = json.loads(out.splitlines()[-1])
    assert end["drawn"] == JOBS
    assert end["plans"]["seconds_planning_now"] == 0.0
    # Without a budget all is drawn exactly again, in the same folder.
    assert cli.run("batch", table, "-o", cheap, "--workers", "1")[0] == 0
    assert digests(cheap) == full


def test_a_planner_that_dies_costs_its_plan_alone(
    cli: Cli,
    tmp_path: Path,
    few: Few,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few(4, 4)
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(
        "import os\nfrom facerender.batch import planner\n"
        "planner.planned = lambda *_: os.kill(os.getpid(), 9)\n"
    )
    monkeypatch.syspath_prepend(site)
    table = written(tmp_path, 4)
    out = cli.folder / "out"
    status, _, err = cli.run("batch", table, "-o", out, "--tries", "2", *PLANNED)
    assert status == 0
    why = "drawn exactly: the worker was killed by SIGKILL, 2 times"
    assert f"plan of {MINI_HEAD}, 4 jobs: {why}" in err
    assert len(digests(out)) == 8
    assert not any('"plan"' in path.read_text() for path in (out / "records").iterdir())
    # It is not tried again unless that is asked for.
    monkeypatch.syspath_prepend(tmp_path)
    (site / "sitecustomize.py").unlink()
    assert why in cli.run("batch", table, "-o", out, *PLANNED)[2]
    assert why not in cli.run("batch", table, "-o", out, "--retry-failed", *PLANNED)[2]


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--within", "99%"], "--within 99% is of a budget: say --budget ERROR"),
        (["--budget", "3 apples"], "budget '3 apples' has no unit"),
        (["--budget", "1/255", "--within", "0"], "within 0: give a share"),
    ],
)
def test_a_bad_budget_is_refused(
    cli: Cli,
    tmp_path: Path,
    options: list[str],
    fault: str,
) -> None:
    out = cli.folder / "out"
    status, _, err = cli.run("batch", written(tmp_path), "-o", out, *options)
    assert status == 2
    assert fault in err
    assert not out.exists()


def test_rows_with_a_plan_have_other_keys(few: Few, tmp_path: Path) -> None:
    rows = list(read_jobs(written(tmp_path)))
    few(2, 4)
    (number,) = found(rows).of
    planned = with_plans(rows, {number: {"shading": {"m": 0.3}, "planned": {}}})
    ((exact,), (cheap,)) = (tuple(chunks(each, 128)) for each in (rows, planned))
    assert not set(exact.keys) & set(cheap.keys)
