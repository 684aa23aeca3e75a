"""What a process that draws the built-in head holds, beyond what its imports take.

    python benchmarks/memory.py [--frames 2000] [--samples 4] [--size 1024]

The camera moves, every frame is read back. Prints resident MiB, which is flat when nothing leaks.
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

import moderngl  # noqa: F401
import numpy  # noqa: F401
import PIL.Image  # noqa: F401
import trimesh  # noqa: F401

import facerender as fr


def resident() -> int:
    """Of the process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--size", type=int, default=1024)
    options = parser.parse_args()
    imports = resident()
    mesh = fr.load_mesh()
    with fr.Renderer((options.size, options.size), samples=options.samples) as renderer:
        print(f"{renderer.metadata['GL_RENDERER']}; imports {imports / 2**20:.0f} MiB")
        for frame in range(options.frames):
            renderer.render(fr.Scene(mesh, fr.Camera(azimuth=2.0 * (frame % 180))))
            if frame + 1 in {10, options.frames} or (frame + 1) % 500 == 0:
                held = (resident() - imports) / 2**20
                print(f"{frame + 1:6} frames: {held:.0f} MiB above imports", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - imports
    print(f"at most: {peak / 2**20:.0f} MiB above imports")


if __name__ == "__main__":
    main()
