"""Measure frames of a moving face, and compare them with other installed renderers.

    python benchmarks/moving.py [--frames 40] [--python NAME=PATH ...]

The first tables compare a frame of moving vertices with a static frame, in turns in one renderer:
1024 x 1024 pixels, the skin of the built-in head. "shadows" has the three default lights, whose
shadow maps a static scene draws only once. The memory table renders 1,000 frames.

The last tables render a clip of the built-in head, 25 frames per second: facerender by with_pose,
filly (Filament) by apply_animation, PyVista by assigning vertices computed before to a head without
morph targets. Each renderer has a process of its own and renders a frame per line of its standard
input, in turns.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import struct
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from run import HEAD, HERE, frames_of, in_turns, report, resident, started

import facerender as fr
from facerender.scene.scene import default_lights

FPS = 25
SECONDS = 2.0


def without_targets(path: Path) -> None:
    """Write the built-in head without morph targets and clip, with which VTK takes seconds per
    frame."""
    content = HEAD.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    del document["animations"]
    for mesh in document["meshes"]:
        mesh["primitives"][0].pop("targets", None)
    text = json.dumps(document, separators=(",", ":")).encode().ljust(length)
    path.write_bytes(content[:20] + text + content[20 + length :])


def waves(mesh: fr.Mesh, count: int) -> list[list[np.ndarray]]:
    """Return smoothly displaced vertices for each part and frame."""
    step = 0.01 * mesh.radius
    return [
        [p.positions + step * np.sin(5.0 * p.positions / mesh.radius + 0.3 * i) for p in mesh.parts]
        for i in range(count)
    ]


def against_static(frames: int, samples: int, shadows: bool) -> None:
    mesh = fr.load_mesh(HEAD).select("head")
    lights = tuple(replace(each, shadow=shadows) for each in default_lights(False))
    moved, normals = waves(mesh, 6), [part.normals for part in mesh.parts]
    with fr.Renderer(samples=samples) as renderer:

        def draw(own: fr.Mesh) -> object:
            return renderer.render(fr.Scene(own, lights=lights)).linear

        actions = {
            "static": lambda turn: draw(mesh),
            "normals given": lambda turn: draw(mesh.with_positions(moved[turn % 6], normals)),
            "normals computed": lambda turn: draw(mesh.with_positions(moved[turn % 6])),
        }
        times = in_turns(frames, actions)
        title = f"{samples} sample(s), {'shadows' if shadows else 'no shadows'}"
        report(f"A frame of moving vertices, {title}", "ms", times)


def memory() -> None:
    mesh = fr.load_mesh(HEAD)
    moved = waves(mesh, 6)
    print("\nResident memory of 1,000 frames, 256 x 256, all parts, MiB")
    with fr.Renderer((256, 256)) as renderer:
        for turn in range(1001):
            renderer.render(fr.Scene(mesh.with_positions(moved[turn % 6])))
            if turn in (10, 100, 250, 500, 750, 1000):
                print(f"  after {turn:4} frames {resident(os.getpid()):7.0f}")


def peers(frames: int, samples: int, pythons: dict[str, str], folder: Path) -> None:
    with ExitStack() as stack:
        actions = {}
        for name, python in pythons.items():
            script = str(HERE / "peers" / f"{name}_clip.py")
            head = folder / "plain.glb" if name == "pyvista" else HEAD
            files = str(head), str(folder / "frames.npy")
            command = [python, script, *files, str(samples)]
            actions[name] = frames_of(started(stack, command))
        times = in_turns(frames, actions)
        report(f"A clip of the whole head, {samples} sample(s), readback", "ms", times)
        for name, values in times.items():
            print(f"  {name:24} {1.0 / statistics.median(values):7.1f} frames per second")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH")
    options = parser.parse_args()
    for shadows in (False, True):
        for samples in (1, 4):
            against_static(options.frames, samples, shadows)
    memory()
    pythons = {"facerender": sys.executable, **dict(e.split("=", 1) for e in options.python)}
    with tempfile.TemporaryDirectory() as folder:
        mesh = fr.load_mesh(HEAD)
        times = np.arange(int(SECONDS * FPS) + 1) / FPS
        poses = [mesh.with_pose(clip="talk", time=float(time)) for time in times]
        every = [np.concatenate([part.positions for part in pose.parts]) for pose in poses]
        np.save(Path(folder, "frames.npy"), np.array(every, dtype=np.float32))
        without_targets(Path(folder, "plain.glb"))
        for samples in (1, 4):
            peers(options.frames, samples, pythons, Path(folder))


if __name__ == "__main__":
    main()
