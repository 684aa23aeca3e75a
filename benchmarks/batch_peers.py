"""Compare programs that render a data set of the built-in head, each written in the usual way.

    python benchmarks/batch_peers.py [--size 256] [--count 64] [--turns 3]
        [--python-pyrender PYTHON] [--only NAME ...] [--keep FOLDER]

The programs are a loop over one `facerender.Renderer`, a pool of processes, `facerender batch`,
PyVista and pyrender. pyrender pins PyOpenGL 3.1.0 and therefore needs a separate interpreter. Whole
processes run in turns (A B C A B C), from start to PNG files. Cameras, maps, the three directional
lights and the 4 samples are the same; the shading differs.

Prints medians, ranges, and medians of the ratios to the loop within a turn of: images per second of
whole runs; images per second after the first quarter; CPU time per image of all processes with
start-up, which other load disturbs least. Also prints the mean difference of the first image from
the loop's, in 8-bit levels.
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
from facerender.images.files import read_image
from facerender.images.image import linear_to_srgb
from facerender.system.files import data_dir

SCRIPTS = Path(__file__).parent / "peers" / "batch"
LOOP = "loop over one Renderer"


def jobs_of(size: int, samples: int, count: int) -> dict[str, Any]:
    """Return the jobs of all programs as JSON data.

    Cameras around the face are position, target and clipping range in the mesh's units, and again
    azimuth and elevation. Lights are direction and irradiance.
    """
    path = data_dir("assets") / "head.glb"
    mesh = fr.load_mesh(path)
    turns = [(index * 37.0 % 140.0 - 70.0, index * 23.0 % 40.0 - 20.0) for index in range(count)]
    scene = fr.Scene(mesh)
    cameras = []
    for turn in turns:
        eye = mesh.radius * fr.view_of(fr.Scene(mesh, fr.Camera(*turn)), 1.0).position
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
    """Return the same jobs as JSON lines for ``facerender batch``."""
    names = ("azimuth", "elevation", "irradiance")
    common = {
        "lights": [
            {**dict(zip(names, light, strict=True)), "shadow": False}
            for light in jobs["facerender_lights"]
        ],
        "mesh": jobs["mesh"],
        "ambient": 0.0,
        "background": jobs["facerender_background"],
    }
    cameras = [dict(zip(names, turn, strict=False)) for turn in jobs["turns"]]
    return "".join(json.dumps({**common, "camera": camera}) + "\n" for camera in cameras)


def script(python: str, name: str, jobs: Path) -> Callable[[str], list[str]]:
    return lambda out: [python, str(SCRIPTS / name), str(jobs), out]


def rates(command: list[str], out: Path, count: int) -> tuple[float, float, float]:
    """Run a command that writes ``count`` PNG files.

    Returns images per second of the whole run and of the last three quarters of the files, and CPU
    milliseconds per image of the whole run. The second rate is computed from modification times.
    """
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
        sys.exit(f"{command[0]} wrote {len(written)} of {count} images to {out}")
    first = count // 4
    later = 1e-9 * (written[-1] - written[first])
    return count / seconds, (count - 1 - first) / later, 1e3 * cpu / count


def spread(values: list[float]) -> str:
    return f"{statistics.median(values):7.2f}  ({min(values):.2f} to {max(values):.2f})"


def first_image(out: Path) -> np.ndarray:
    return read_image(min(out.rglob("*.png"))).color.astype(float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--python-pyrender", help="Python interpreter with pyrender")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="programs beyond the loop")
    parser.add_argument("--keep", type=Path, help="folder for the images of the last turn")
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
        drawn: dict[str, Callable[[str], list[str]]] = {
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
        figures: dict[str, list[tuple[float, float, float]]] = {name: [] for name in drawn}
        for turn in range(options.turns):
            for name, command in drawn.items():
                out = folder / f"{turn}-{name}"
                figures[name].append(rates(command(str(out)), out, options.count))
        print(
            f"{options.count} images, {options.size} px, {options.samples} samples, "
            f"{os.cpu_count()} cores; images per second, medians of {options.turns} turns"
        )
        base = first_image(folder / f"0-{LOOP}")
        for name, values in figures.items():
            pairs = list(zip(values, figures[LOOP], strict=True))
            ratios = [statistics.median(a[i] / b[i] for a, b in pairs) for i in range(3)]
            whole, steady, cpu = (spread(list(each)) for each in zip(*values, strict=True))
            away = np.abs(first_image(folder / f"0-{name}") - base).mean()
            print(
                f"  {name:24} whole {whole} {ratios[0]:.2f}   steady {steady} {ratios[1]:.2f}   "
                f"CPU ms {cpu} {ratios[2]:.2f}   {away:.1f}/255"
            )
        if options.keep:
            options.keep.mkdir(parents=True, exist_ok=True)
            for name in drawn:
                (folder / f"{options.turns - 1}-{name}").rename(options.keep / name)


if __name__ == "__main__":
    main()
