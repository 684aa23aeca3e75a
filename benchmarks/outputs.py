"""Compare the time of several outputs of one drawing with the time of the image alone.

    python -m benchmarks.outputs [--rounds 30] [--cpu]

Each image has another camera, m and light. Prints medians in milliseconds, and ratios to the image;
"kept" are lights whose shadow maps stay from image to image. ``--cpu`` measures the time of all
cores. Other load on the machine changes the ratios: compare ``--cpu``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from itertools import count, product

import facerender as fr

OUTPUTS = (
    ("image",),
    ("image", "depth", "mask"),
    ("image", "depth", "mask", "normal", "parts", "albedo"),
)
LIGHTS = ("no shadows", "shadows, kept", "shadows")


def scene_of(mesh: fr.Mesh, number: int, lights: str) -> fr.Scene:
    """Return a scene that no other number has."""
    turn = number % 61
    key = fr.Light(20.0 + (turn if lights == "shadows" else 0.0), 25.0, radius=2.0)
    rig: tuple[fr.Light, ...] = key, fr.Light(-60.0, 15.0, 1.2)
    if lights == "no shadows":
        rig = tuple(
            fr.Light(light.azimuth, light.elevation + 0.1 * turn, shadow=False) for light in rig
        )
    return fr.Scene(mesh.with_skin(m=0.25 + 1e-3 * turn), fr.Camera(0.5 * turn - 15.0), rig)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--cpu", action="store_true")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    mesh, numbers = fr.load_mesh(), count()
    print("size samples lights: image ms, ratio of image + depth + mask, ratio of six outputs")
    for size, samples, lights in product((256, 512), (1, 4), LIGHTS):
        times: list[list[float]] = []
        with fr.Renderer(size, samples=samples) as renderer:
            for _ in range(options.rounds + 3):
                times.append([])
                for outputs in OUTPUTS:
                    scene, start = scene_of(mesh, next(numbers), lights), clock()
                    renderer.render_outputs(scene, outputs)
                    times[-1].append(clock() - start)
        rows = times[3:]  # the first images compile and upload
        three, six = (statistics.median(row[i] / row[0] for row in rows) for i in (1, 2))
        image = 1e3 * statistics.median(row[0] for row in rows)
        print(f"{size} {samples} {lights}: {image:.1f} ms, {three:.2f}, {six:.2f}", flush=True)


if __name__ == "__main__":
    main()
