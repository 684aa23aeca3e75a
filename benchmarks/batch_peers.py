"""Pictures of the built-in head for a data set, drawn by scripts as people write them.

    python benchmarks/batch_peers.py [--size 256] [--count 64] [--turns 3]
        [--python-pyrender PYTHON] [--only NAME ...] [--keep FOLDER]

Whole processes, from nothing to PNG files, take turns (A B C A B C): a loop over one
`facerender.Renderer`, a pool of processes, `facerender batch`, PyVista, and pyrender, which pins
PyOpenGL 3.1.0 and therefore has an interpreter of its own. The same cameras, maps, three
directional lights and 4 samples; each shades in its own way. Prints medians, ranges, and medians of
the ratios to the loop within a turn: images a second of whole runs, and after the first quarter of
the pictures; CPU time an image, all processes, start-up included, which other work on the machine
disturbs least; and how far the first picture is from the loop's on average.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import facerender as fr
from facerender.images.read import read_image
from facerender.images.srgb import linear_to_srgb
from facerender.system.data import data_dir

SCRIPTS = Path(__file__).parent / "peers" / "batch"
LOOP = "loop over one Renderer"


def jobs_of(size: int, samples: int, count: int) -> dict[str, Any]:
    """What all draw, as JSON: cameras around the face as eye, target and clipping range, in the
    mesh's units, and as azimuth and elevation; lights as direction and irradiance."""
    path = data_dir("assets") / "head.glb"
    mesh = fr.load_mesh(path)
    turns = [(index * 37.0 % 140.0 - 70.0, index * 23.0 % 40.0 - 20.0) for index in range(count)]
    scene = fr.Scene(mesh)
    cameras = []
    for turn in turns:
        eye = mesh.radius * fr.view_of(fr.Scene(mesh, fr.Camera(*turn)), 1.0).eye
        distance = float(np.linalg.norm(eye))
        ends = (distance - mesh.radius, distance + mesh.radius)
        cameras.append(((mesh.center + eye).tolist(), mesh.center.tolist(), ends))
    background = np.asarray(scene.background)
    return {
        "mesh": str(path),
        "size": size,
        "samples": samples,
        "fov": scene.camera.fov,
        "cameras": cameras,
        "lights": [(light.direction.tolist(), light.irradiance) for light in scene.lights],
        "background": linear_to_srgb(background).tolist(),
        "turns": turns,
        "facerender_lights": [(a.azimuth, a.elevation, a.irradiance) for a in scene.lights],
        "facerender_background": background.tolist(),
    }


def table_of(jobs: dict[str, Any]) -> str:
    """The same as rows for ``facerender batch``."""
    names = ("azimuth", "elevation", "irradiance")
    common = {
        "lights": [dict(zip(names, light, strict=True)) for light in jobs["facerender_lights"]],
        "mesh": jobs["mesh"],
        "ambient": 0.0,
        "background": jobs["facerender_background"],
    }
    cameras = [dict(zip(names, turn, strict=False)) for turn in jobs["turns"]]
    return "".join(json.dumps({**common, "camera": camera}) + "\n" for camera in cameras)


def script(python: str, name: str, jobs: Path) -> Callable[[str], list[str]]:
    return lambda out: [python, str(SCRIPTS / name), str(jobs), out]


def rates(command: list[str], out: Path, count: int) -> tuple[float, float, float]:
    """Run a command that writes so many PNGs; images a second, of it all and of the last three
    quarters of the files by their times, and CPU milliseconds an image, of it all."""
    out.mkdir(parents=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if ended.returncode:
        sys.exit(f"{' '.join(command)} ended with {ended.returncode}:\n{ended.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    written = sorted(path.stat().st_mtime_ns for path in out.rglob("*.png"))
    if len(written) != count:
        sys.exit(f"{command[0]} wrote {len(written)} of {count} pictures to {out}")
    first = count // 4
    later = 1e-9 * (written[-1] - written[first])
    return count / seconds, (count - 1 - first) / later, 1e3 * cpu / count


def spread(values: list[float]) -> str:
    return f"{statistics.median(values):7.2f}  ({min(values):.2f} to {max(values):.2f})"


def first_picture(out: Path) -> np.ndarray:
    return read_image(min(out.rglob("*.png"))).color.astype(float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--python-pyrender", help="an interpreter that has pyrender")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="some of what is compared")
    parser.add_argument("--keep", type=Path, help="a folder for the pictures of the last turn")
    options = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        jobs = jobs_of(options.size, options.samples, options.count)
        path = folder / "jobs.json"
        path.write_text(json.dumps(jobs), encoding="utf-8")
        table = folder / "jobs.jsonl"
        table.write_text(table_of(jobs), encoding="utf-8")
        image = ("--size", str(options.size), "--samples", str(options.samples))
        batch = (sys.executable, "-m", "facerender", "batch", str(table), *image, "-o")
        drawn = {
            LOOP: script(sys.executable, "loop.py", path),
            "pool of processes": script(sys.executable, "pool.py", path),
            "facerender batch": lambda out: [*batch, out],
        }
        if importlib.util.find_spec("pyvista"):
            drawn["pyvista"] = script(sys.executable, "with_pyvista.py", path)
        if options.python_pyrender:
            drawn["pyrender"] = script(options.python_pyrender, "with_pyrender.py", path)
        if options.only:
            drawn = {name: drawn[name] for name in (LOOP, *options.only)}
        figures: dict[str, list[tuple[float, float]]] = {name: [] for name in drawn}
        for turn in range(options.turns):
            for name, command in drawn.items():
                out = folder / f"{turn}-{name}"
                figures[name].append(rates(command(str(out)), out, options.count))
        print(
            f"{options.count} pictures, {options.size} px, {options.samples} samples, "
            f"{os.cpu_count()} cores; images a second, medians of {options.turns} turns"
        )
        base = first_picture(folder / f"0-{LOOP}")
        for name, values in figures.items():
            pairs = list(zip(values, figures[LOOP], strict=True))
            ratios = [statistics.median(a[i] / b[i] for a, b in pairs) for i in range(3)]
            whole, steady, cpu = (spread(list(each)) for each in zip(*values, strict=True))
            away = np.abs(first_picture(folder / f"0-{name}") - base).mean()
            print(
                f"  {name:24} whole {whole} {ratios[0]:.2f}   steady {steady} {ratios[1]:.2f}   "
                f"CPU ms {cpu} {ratios[2]:.2f}   {away:.1f}/255"
            )
        if options.keep:
            for name in drawn:
                (folder / f"{options.turns - 1}-{name}").rename(options.keep / name)


if __name__ == "__main__":
    main()
