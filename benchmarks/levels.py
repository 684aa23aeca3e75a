"""Measure the image error and the time saving of levels of detail.

    python -m benchmarks.levels

Writes docs/measurements/levels.json in five minutes. Needs an OpenGL context, the extra lod and the
head scan.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

import facerender as fr
from benchmarks.data import meshes, save
from tests.verification.lights import PLAIN_THREE

SIZES = (1024, 512)
SAMPLES = (1, 4)
CAMERAS = tuple(fr.Camera(azimuth=azimuth, frame="all") for azimuth in (0.0, -35.0, 90.0))
LEVELS = {"head": (50_000, 32_000, 16_000, 8_000), "scan": (14_000, 12_000, 8_000, 4_000)}
ROUNDS = 15


def difference(a: fr.Frame, b: fr.Frame) -> list[float]:
    """Return the difference of two frames.

    The fractions of covered pixels that differ by more than 1, 2 and 4 levels; the mean difference
    in levels; and the largest movement of the silhouette in pixels.
    """
    covered = (a.linear[..., 3] > 0.0) | (b.linear[..., 3] > 0.0)
    steps = np.abs(a.srgb8().astype(int) - b.srgb8())[covered].max(axis=-1)
    inside, other = (frame.linear[..., 3] >= 0.5 for frame in (a, b))
    way = np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside))
    moved = way[inside != other]
    shares = [float((steps > step).mean()) for step in (1, 2, 4)]
    return [*shares, float(steps.mean()), float(moved.max(initial=0.0))]


def frame_times(meshes: Sequence[fr.Mesh], size: int, samples: int) -> list[float]:
    """Return each mesh's frame time relative to the first; CPU time, to exclude other load."""
    with fr.Renderer((size, size), samples=samples) as renderer:
        scenes = [fr.Scene(mesh, CAMERAS[1], PLAIN_THREE) for mesh in meshes]
        times: list[list[float]] = []
        for _ in range(ROUNDS + 1):
            times.append([])
            for scene in scenes:
                start = time.process_time()
                renderer.render(scene)
                times[-1].append(time.process_time() - start)
    ratios = np.array(times[1:]) / np.array(times[1:])[:, :1]  # skip the first: it uploads
    return [float(value) for value in np.median(ratios, axis=0)]


def changes(meshes: Sequence[fr.Mesh], size: int) -> list[dict[str, object]]:
    """Return the error and the relative time of each mesh against the first, the full mesh."""
    with fr.Renderer((size, size), samples=4) as renderer:
        frames = [
            [renderer.render(fr.Scene(mesh, at, PLAIN_THREE)) for at in CAMERAS] for mesh in meshes
        ]
    ratios = [frame_times(meshes, size, samples) for samples in SAMPLES]
    rows = []
    for index, mesh in enumerate(meshes):
        values: NDArray[np.float64] = np.array(
            [difference(*pair) for pair in zip(frames[0], frames[index], strict=True)]
        )
        *shares, mean, _ = map(float, values.mean(axis=0))
        rows.append(
            {
                "triangles": sum(len(part.faces) for part in mesh.parts),
                **dict(zip(("over_1", "over_2", "over_4"), shares, strict=True)),
                "mean": mean,
                "silhouette": float(values[:, -1].max()),
                "time": [each[index] for each in ratios],
            }
        )
    return rows


def main() -> None:
    levels: dict[str, object] = {}
    seconds = []
    for name, whole in meshes():
        each = [whole]
        for triangles in LEVELS[name]:
            start = time.process_time()
            each.append(fr.simplified(whole, triangles))
            seconds.append(time.process_time() - start)
        levels |= {f"{name}-{size}": changes(each, size) for size in SIZES}
    save("levels", seconds=max(seconds), levels=levels)


if __name__ == "__main__":
    main()
