"""Compare the speed of facerender with a minimal script and with other installed renderers.

    python benchmarks/run.py [--repeats 11] [--frames 40] [--peers] [--python NAME=PATH ...]

Cold start: whole processes from file to PNG at 1024 x 1024 without multisampling, in turns.
"Cached" uses the decoded mesh that an earlier process cached. Steady state: one process renders
frames of a moving camera and reads each back; the renderers take turns. Other renderers, and
facerender a second time, render in processes of their own.

Prints medians, ranges, the medians of the ratios within a turn, and the resident memory of each
process after the last frame. Other load on the machine widens the ranges.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.images.image import linear_to_srgb
from facerender.system.files import data_dir
from tests.verification.lights import PLAIN_THREE

HERE = Path(__file__).parent
HEAD = data_dir("assets") / "head.glb"
# The numbers of samples with which a script of peers/ renders frames of a moving camera.
STEADY = {"facerender": (1, 4), "filly": (1, 4), "pyrender": (4,), "pyvista": (1, 4)}


def report(title: str, unit: str, times: dict[str, list[float]]) -> None:
    """Print medians, ranges and ratios of times in seconds.

    unit : unit of the printed times, "s" or "ms"
    """
    base, scale = next(iter(times)), {"s": 1.0, "ms": 1e3}[unit]
    print(f"\n{title}")
    for name, values in times.items():
        ratio = statistics.median(a / b for a, b in zip(values, times[base], strict=True))
        print(
            f"  {name:24} {scale * statistics.median(values):7.3f} {unit}"
            f"  ({scale * min(values):.3f} to {scale * max(values):.3f})   {ratio:.2f} of {base}"
        )


def in_turns(repeats: int, actions: dict[str, Callable[[int], object]]) -> dict[str, list[float]]:
    times: dict[str, list[float]] = {name: [] for name in actions}
    for action in actions.values():
        action(0)  # fills the caches of disk and driver
    for turn in range(repeats):
        for name, action in actions.items():
            start = time.perf_counter()
            action(turn)
            times[name].append(time.perf_counter() - start)
    return times


def process(folder: str, *arguments: str, python: str = sys.executable) -> Callable[[int], object]:
    """Return a function that runs a Python process with its caches in ``folder``.

    The process may write bytecode, because installed packages have it.
    """
    command = [python, *arguments]
    environment = {**os.environ, "XDG_CACHE_HOME": folder, "PYTHONDONTWRITEBYTECODE": ""}
    return lambda turn: subprocess.run(
        command, check=True, stdout=subprocess.DEVNULL, env=environment
    )


def cold(repeats: int, peers: Mapping[str, str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        render = ("-m", "facerender", "render", str(HEAD), "--samples", "1", "--no-shadows", "-o")
        actions = {
            "minimal script": process(
                folder, str(HERE / "minimal_moderngl.py"), str(HEAD), f"{folder}/script.png"
            ),
            "facerender --no-cache": process(folder, *render, f"{folder}/head.png", "--no-cache"),
            "facerender, cached": process(folder, *render, f"{folder}/head.png"),
        }
        for peer, python in peers.items():
            arguments = (str(HERE / "peers" / f"{peer}_head.py"), str(HEAD), f"{folder}/{peer}.png")
            actions[peer] = process(folder, *arguments, python=python)
        report("Cold start, file to PNG, whole process", "s", in_turns(repeats, actions))


def resident(pid: int) -> float:
    """Return the resident memory of a process in MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def started(stack: ExitStack, command: list[str]) -> subprocess.Popen[str]:
    """Start the process of a peer, which renders a frame per line of its standard input.

    VTK and a context of facerender cannot share a process.
    """
    own = stack.enter_context(
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    )
    stack.callback(own.kill)
    return own


def frames_of(own: subprocess.Popen[str]) -> Callable[[int], object]:
    """Return a function that makes a peer's process render the next frame."""

    def frame(turn: int) -> None:
        assert own.stdout is not None
        print(turn, file=own.stdin, flush=True)
        if not own.stdout.readline():
            sys.exit(f"{own.args!r} ended")

    return frame


def steady(frames: int, samples: int, peers: Mapping[str, str]) -> None:
    from minimal_moderngl import Script

    script = Script(str(HEAD), samples=samples if samples > 1 else 0)
    mesh = fr.load_mesh(HEAD)
    with fr.Renderer(samples=samples) as renderer, ExitStack() as stack:
        scenes = [
            fr.Scene(mesh, fr.Camera(azimuth=2.0 * turn), PLAIN_THREE) for turn in range(frames)
        ]

        def by_script(turn: int) -> NDArray[np.float32]:
            with script.ctx:
                return np.asarray(script.frame(2.0 * turn))

        def by_facerender(turn: int) -> NDArray[np.float32]:
            return renderer.render(scenes[turn]).linear

        actions: dict[str, Callable[[int], object]]
        actions = {"minimal script": by_script, "facerender": by_facerender}
        processes = {
            f"{peer}, own process": started(
                stack, [python, str(HERE / "peers" / f"{peer}_head.py"), str(HEAD), str(samples)]
            )
            for peer, python in {"facerender": sys.executable, **peers}.items()
            if samples in STEADY.get(peer, ())
        }
        actions |= {name: frames_of(own) for name, own in processes.items()}
        times = in_turns(frames, actions)
        report(f"Steady state, {samples} sample(s), moving camera, readback", "ms", times)
        print("  resident MiB after the last frame:")
        pids = {name: own.pid for name, own in processes.items()}
        for name, pid in {"script and facerender": os.getpid(), **pids}.items():
            print(f"  {name:24} {resident(pid):7.0f}")
        middle = frames // 2
        one = linear_to_srgb(by_script(middle)[..., :3].astype(float))
        print(
            f"  at azimuth {2 * middle}, pixels that differ from the script's by more than 1/255:"
        )
        for name, slope_filter in {"with": True, "without": False}.items():
            shading = fr.Shading(slope_filter=slope_filter)
            other = renderer.render(scenes[middle], shading).linear
            steps = 255.0 * np.abs(one - linear_to_srgb(other[..., :3].astype(float))).max(axis=-1)
            over = 100.0 * (steps[other[..., 3] > 0.0] > 1.0).mean()
            print(f"  {over:.1f} % of the covered pixels {name} the slope filter")
        print(f"  {renderer.metadata['GL_RENDERER']}, {renderer.metadata['GL_VERSION']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--peers", action="store_true", help="also run other installed renderers")
    parser.add_argument(
        "--python",
        action="append",
        default=[],
        metavar="NAME=PATH",
        help="also run this renderer, with another interpreter that has it",
    )
    options = parser.parse_args()
    pythons = dict(each.split("=", 1) for each in options.python)
    scripts = (HERE / "peers").glob("*_head.py")
    names = sorted({path.stem.removesuffix("_head") for path in scripts} - {"facerender"})
    if pythons.keys() - set(names):
        parser.error(f"argument --python: NAME must be one of {', '.join(names)}")
    peers = {
        name: pythons.get(name, sys.executable)
        for name in names
        if name in pythons or (options.peers and importlib.util.find_spec(name))
    }
    cold(options.repeats, peers)
    for samples in (1, 4):
        steady(options.frames, samples, peers)


if __name__ == "__main__":
    main()
