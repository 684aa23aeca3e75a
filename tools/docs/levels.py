"""Writes docs/levels.md: what levels of detail change in the image, and what they save.

python -m tools.docs.levels      from the repository's root; five minutes on an idle machine; needs an
                           OpenGL context, the extra lod, and the head scan of the tests
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

import facerender as fr
from facerender.measure.tables import markdown_table
from tests.verification.scan import load_scan, scan_folder
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/levels.md"
SIZES = (1024, 512)
SAMPLES = (1, 4)
CAMERAS = tuple(fr.Camera(azimuth=azimuth) for azimuth in (0.0, -35.0, 90.0))
LEVELS = {"head": (50_000, 32_000, 16_000, 8_000), "scan": (14_000, 12_000, 8_000, 4_000)}
ROUNDS = 15
HEAD = (
    *("triangles", "> 1/255", "> 2/255", "> 4/255", "mean", "silhouette"),
    *(f"frame, {samples} sample{'s' * (samples > 1)}" for samples in SAMPLES),
)

PAGE = """# Levels of detail: what they change, what they save

Written by `python -m tools.docs.levels`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. `facerender render --triangles N` and `fr.simplified(mesh, N)` simplify a mesh to N
triangles; without them every triangle is drawn.

Each image is compared with that of the whole mesh: the share of the pixels that either covers whose
worst channel of the displayed image (8 bits, sRGB) differs by more than 1, 2 and 4 steps, the mean
difference in steps, with 4 samples a pixel, the mean of three cameras (front, three-quarter,
profile); and the farthest that the silhouette moves, in pixels, of the worst. A frame's time is the
median over {rounds} rounds of the time of the level over that of the whole mesh, drawn in turns,
with readback. The head is the built-in one with all its maps, the scan Lee Perry-Smith's
(Infinite-Realities, CC BY 3.0).

{tables}

Simplifying takes {seconds:.1f} s for the slowest of these, once: the same mesh gives the same level
again, in every process.

- Normals, places on the maps and vertex colours count as errors beside distances, and what is left
  of them moves to where the error is least, so that colours do not slide over the surface.
- Open borders, seams of the maps and borders between parts collapse with both their sides: no crack
  opens. A mesh keeps at least what its seams and parts need; a warning tells where that is more
  than N.
- The camera sees both meshes alike: bounds and radius stay those of the whole mesh.
- Relief that is lost is not put into the normal map.
"""


def difference(a: fr.Frame, b: fr.Frame) -> list[float]:
    """Shares over 1, 2 and 4 steps in %, mean in steps, the silhouette's way in pixels."""
    covered = (a.linear[..., 3] > 0.0) | (b.linear[..., 3] > 0.0)
    steps = np.abs(a.srgb8().astype(int) - b.srgb8())[covered].max(axis=-1)
    inside, other = (frame.linear[..., 3] >= 0.5 for frame in (a, b))
    way = np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside))
    moved = way[inside != other]
    shares = [100.0 * float((steps > step).mean()) for step in (1, 2, 4)]
    return [*shares, float(steps.mean()), float(moved.max(initial=0.0))]


def frame_times(meshes: Sequence[fr.Mesh], size: int, samples: int) -> list[float]:
    """Time of each mesh's frame over the first one's."""
    with fr.Renderer((size, size), samples=samples) as renderer:
        scenes = [fr.Scene(mesh, CAMERAS[1]) for mesh in meshes]
        times: list[list[float]] = []
        for _ in range(ROUNDS + 1):
            times.append([])
            for scene in scenes:
                start = time.perf_counter()
                renderer.render(scene)
                times[-1].append(time.perf_counter() - start)
    ratios = np.array(times[1:]) / np.array(times[1:])[:, :1]  # the first round uploads
    return [float(value) for value in np.median(ratios, axis=0)]


def table(meshes: Sequence[fr.Mesh], size: int) -> str:
    """The first mesh is whole."""
    with fr.Renderer((size, size), samples=4) as renderer:
        frames = [[renderer.render(fr.Scene(mesh, at)) for at in CAMERAS] for mesh in meshes]
    ratios = [frame_times(meshes, size, samples) for samples in SAMPLES]
    rows = []
    for index, mesh in enumerate(meshes):
        values: NDArray[np.float64] = np.array(
            [difference(*pair) for pair in zip(frames[0], frames[index], strict=True)]
        )
        *shares, mean, _ = values.mean(axis=0)
        rows.append(
            [
                f"{sum(len(part.faces) for part in mesh.parts):,}",
                *(f"{share:.2g} %" for share in shares),
                f"{mean:.2f}",
                f"{values[:, -1].max():.1f}",
                *(f"{each[index]:.2f}" for each in ratios),
            ]
        )
    return markdown_table(HEAD, rows)


def main() -> None:
    if (folder := scan_folder()) is None:
        raise SystemExit("no head scan: set FACERENDER_TEST_DATA")
    tables, seconds = [], []
    for name, whole in (("head", fr.load_mesh()), ("scan", load_scan(folder))):
        meshes = [whole]
        for triangles in LEVELS[name]:
            start = time.perf_counter()
            meshes.append(fr.simplified(whole, triangles))
            seconds.append(time.perf_counter() - start)
        for size in SIZES:
            tables.append(f"## The {name} at {size} x {size}\n\n{table(meshes, size)}")
    with fr.Renderer((16, 16)) as renderer:
        facts = renderer.metadata
    text = PAGE.format(tables="\n\n".join(tables), rounds=ROUNDS, seconds=max(seconds), **facts)
    OUTPUT.write_text(text, encoding="utf-8")


def stale() -> Iterator[str]:
    yield from missing(OUTPUT, PAGE, [HEAD])


if __name__ == "__main__":
    main()
