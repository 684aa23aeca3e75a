"""What a process that draws the built-in head holds, beyond what its imports take.

    python benchmarks/memory.py [--frames 2000] [--samples 4] [--size 1024]
    python benchmarks/memory.py --dropped 500 [--samples 4] [--size 256]
    python benchmarks/memory.py --slopes 500 [--samples 4] [--size 256]

Frames: the camera moves, every frame is read back. Dropped: each frame has a renderer of its own,
which nobody releases. Slopes: each frame has a program of its own. Prints resident MiB, which is
flat when nothing leaks.
"""

from __future__ import annotations

import argparse
import resource
import warnings
from collections.abc import Iterator
from pathlib import Path

import moderngl  # noqa: F401
import numpy  # noqa: F401
import PIL.Image  # noqa: F401
import trimesh  # noqa: F401

import facerender as fr


def resident() -> int:
    """Of the process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def frames(count: int, size: int, samples: int) -> Iterator[None]:
    mesh = fr.load_mesh()
    with fr.Renderer((size, size), samples=samples) as renderer:
        for frame in range(count):
            renderer.render(fr.Scene(mesh, fr.Camera(azimuth=2.0 * (frame % 180))))
            yield


def dropped(count: int, size: int, samples: int) -> Iterator[None]:
    scene = fr.Scene(fr.load_mesh())
    warnings.simplefilter("ignore", ResourceWarning)
    for _ in range(count):
        fr.Renderer((size, size), samples=samples).render(scene)
        yield


def slopes(count: int, size: int, samples: int) -> Iterator[None]:
    scene = fr.Scene(fr.load_mesh())
    with fr.Renderer((size, size), samples=samples) as renderer:
        for step in range(count):
            renderer.render(scene, fr.Shading(m=0.1 + 1e-4 * step))
            yield


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--dropped", type=int, default=0)
    parser.add_argument("--slopes", type=int, default=0)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--size", type=int, default=1024)
    options = parser.parse_args()
    imports = resident()
    count, what = options.frames, frames
    if options.dropped or options.slopes:
        count = options.dropped or options.slopes
        what = dropped if options.dropped else slopes
    for done, _ in enumerate(what(count, options.size, options.samples), start=1):
        if done in {1, 10, count} or done % max(count // 10, 1) == 0:
            held = (resident() - imports) / 2**20
            print(f"{done:6} {what.__name__}: {held:.0f} MiB above imports", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - imports
    print(f"at most: {peak / 2**20:.0f} MiB above imports")


if __name__ == "__main__":
    main()
