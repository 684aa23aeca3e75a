"""Measure whether a batch worker leaks: its resident memory while it renders thousands of jobs.

    python benchmarks/batch_memory.py [--jobs 2000] [--size 256] [--sweep NAME ...]

Each sweep starts a new worker and varies one setting from job to job: the camera, the mesh, m, the
environment map, lights with shadows, or the image size. The meshes are 40 files of the built-in
head with different materials. The environment maps are a generated one, one file, and four files.

Prints resident MiB after every tenth of the jobs. The growth of a sweep is its increase after the
second tenth.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from facerender.batch.jobs import JobTable, Settings, chunks, code_version
from facerender.batch.supervisor import Supervisor
from facerender.system.files import data_dir

_MESHES = 40
_FILES = 4  # environment maps
_SIZES = (64, 96, 128, 200, 256)
_SIDE_BY_SIDE = 25  # consecutive jobs with one mesh, and jobs per chunk
Change = Callable[[int, Path], dict[str, Any]]


def _another_head(number: int, folder: Path) -> str:
    """Write a copy of the built-in head with another roughness factor; return its path."""
    path = folder / f"head{number:02d}.glb"
    if not path.exists():
        content = (data_dir("assets") / "head.glb").read_bytes()
        length = int.from_bytes(content[12:16], "little")
        document = json.loads(content[20 : 20 + length])
        document["materials"][0].setdefault("pbrMetallicRoughness", {})
        document["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] = 0.3 + 0.01 * number
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        rest = content[20 + length :]
        whole = 20 + len(text) + len(rest)
        head = content[:8] + whole.to_bytes(4, "little") + len(text).to_bytes(4, "little")
        path.write_bytes(head + content[16:20] + text + rest)
    return str(path)


def _environment(number: int, folder: Path) -> str:
    path = folder / f"room{number}.npy"
    if not path.exists():
        random = np.random.default_rng(number)
        np.save(path, random.uniform(0.0, 1.0, (256, 512, 3)).astype(np.float32))
    return str(path)


def _lights(number: int) -> list[dict[str, Any]]:
    place = {"azimuth": float(number % 120 - 60), "elevation": 30.0, "irradiance": 2.0}
    return [{**place, "radius": 2.0 * (number % 2), "shadow": True}]


SWEEPS: dict[str, Change] = {
    "one mesh": lambda number, _: {"camera.azimuth": 0.1 * number},
    f"{_MESHES} meshes": lambda number, folder: {
        "mesh": _another_head(number // _SIDE_BY_SIDE % _MESHES, folder)
    },
    "m": lambda number, _: {"material.m": 0.1 + 0.0004 * (number % 2000)},
    "studio": lambda number, _: {
        "environment.file": "studio", "environment.rotation": number % 360
    },
    "environment": lambda number, folder: {
        "environment.file": _environment(0, folder), "environment.rotation": number % 360
    },
    f"{_FILES} environments": lambda number, folder: {
        "environment.file": _environment(number % _FILES, folder)
    },
    "lights": lambda number, _: {"lights": _lights(number)},
    "sizes": lambda number, _: {"image.size": _SIZES[number // _SIDE_BY_SIDE % len(_SIZES)]},
}  # fmt: skip


def measure(sweep: str, jobs: int, size: int, folder: Path) -> list[float]:
    """Return the worker's resident MiB after each tenth of the jobs, and print them."""
    change = SWEEPS[sweep]
    table = folder / "jobs.jsonl"
    with table.open("w") as file:
        for number in range(jobs):
            row = {"id": f"j{number}", "image.size": size, "image.samples": 1}
            file.write(json.dumps(row | change(number, folder)) + "\n")
    settings = Settings(str(folder / "out"), code_version=code_version())
    supervisor, seen, drawn = Supervisor(), [], 0

    def on_event(worker: str, event: str, job: str) -> None:
        nonlocal drawn
        if event == "failed":
            raise SystemExit(f"{sweep}: {job} failed")
        if event != "done":
            return
        drawn += 1
        if drawn % (jobs // 10) == 0:
            process = psutil.Process(int(worker.partition(":")[2]))
            seen.append(process.memory_info().rss / 2**20)
            print(f" {seen[-1]:6.0f}", end="", flush=True)

    print(f"{sweep:>16}", end="", flush=True)
    for chunk in chunks(JobTable(table), _SIDE_BY_SIDE):
        supervisor.run(settings, chunk, on_event)
    supervisor.stop()
    print(f"   {seen[-1] - seen[1]:+.0f} MiB after warm-up")
    return seen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2000)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--sweep", nargs="*", choices=[*SWEEPS], default=[*SWEEPS])
    options = parser.parse_args()
    print(f"resident MiB of a worker, {options.size} pixels a side, 1 sample, after N jobs:")
    print(" " * 16 + "".join(f" {options.jobs * (i + 1) // 10:6}" for i in range(10)))
    with tempfile.TemporaryDirectory() as folder:
        for sweep in options.sweep:
            measure(sweep, options.jobs, options.size, Path(folder))


if __name__ == "__main__":
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path[1:]))
    main()
