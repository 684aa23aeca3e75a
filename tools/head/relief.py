"""Make assets/relief.npy, with which facerender finds faces: ``python -m tools.head.relief``.

The first relief is a height map of the built-in head. The second is the mean of this map and of the
same map with lower eyes and a flatter nose, as many faces have them."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import facerender as fr

EYES = np.array([[-0.0321, 0.0005, 0.0815], [0.0321, 0.0005, 0.0815]])  # of the built-in head
HALF, CELLS, FLOOR = 1.4, 56, -1.0  # as in facerender.mesh.face
LOWER, FLATTER = 1.15, 0.75
POINTS = 1_500_000

Floats = NDArray[np.float64]


def samples() -> Floats:
    """Return points (N, 3) on the surface of the built-in head, in distances between the eyes."""
    parts = [part for part in fr.load_mesh().parts if part.name in ("head", "eyeballs")]
    corners = np.concatenate([part.positions[part.faces] for part in parts])
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    random = np.random.default_rng(1)
    chosen = corners[random.choice(len(areas), POINTS, p=areas / areas.sum())]
    weights = random.dirichlet((1.0, 1.0, 1.0), POINTS)
    points = np.einsum("nk,nki->ni", weights, chosen) - EYES.mean(axis=0)
    return np.asarray(points / np.linalg.norm(EYES[1] - EYES[0]))


def relief(points: Floats) -> Floats:
    """Return the height map (CELLS, CELLS) of the front, symmetric, with the tip of the nose at the
    middle and at height 0."""
    x, y, z = points.T
    nose = points[(np.abs(x) < 0.2) & (y < -0.3) & (y > -0.95)]
    x, y, z = (points - nose[nose[:, 2].argmax()] * (0.0, 1.0, 1.0)).T
    inside = (np.abs(x) < HALF) & (np.abs(y) < HALF) & (z > -1.7)
    column, row = (((c[inside] + HALF) * (CELLS / 2.0 / HALF)).astype(int) for c in (x, y))
    cells, z = row * CELLS + column, z[inside]
    top = np.full(CELLS * CELLS, -np.inf)
    np.maximum.at(top, cells, z)
    front = z > top[cells] - 0.15
    with np.errstate(invalid="ignore"):
        heights = np.bincount(cells[front], z[front], CELLS * CELLS)
        heights /= np.bincount(cells[front], minlength=CELLS * CELLS)
    heights = heights.reshape(CELLS, CELLS)
    return np.asarray((heights + heights[:, ::-1]) / 2.0)


def at(heights: Floats, x: Floats, y: Floats) -> Floats:
    """Return bilinear samples of a height map; NaN outside."""
    row, column = ((c + HALF) * (CELLS / 2.0 / HALF) - 0.5 for c in (y, x))
    outside = (row < -0.5) | (row > CELLS - 0.5) | (column < -0.5) | (column > CELLS - 0.5)
    row, column = row.clip(0, CELLS - 1.001), column.clip(0, CELLS - 1.001)
    (i, j), (u, v) = np.int64([row, column]), np.modf([row, column])[0]
    low, high = (heights[k, j] * (1.0 - v) + heights[k, j + 1] * v for k in (i, i + 1))
    return np.where(outside, np.nan, low * (1.0 - u) + high * u)


def changed(heights: Floats) -> Floats:
    """Return a height map with lower eyes and a flatter nose."""
    side = (np.arange(CELLS) + 0.5) / CELLS * 2.0 * HALF - HALF
    x, y = np.meshgrid(side, side)
    result = at(heights, x, LOWER * y)
    beside = at(heights, np.full_like(x, 0.6), LOWER * y)
    nose = np.exp(-((x / 0.3) ** 2) / 2.0) * np.exp(-(((y - 0.05) / 0.45) ** 2) / 2.0)
    result -= (1.0 - FLATTER) * np.clip(result - beside, 0.0, None) * nose
    return np.asarray(result - np.nanmax(result[(np.abs(x) < 0.2) & (np.abs(y) < 0.35)]))


def main() -> None:
    """Write both reliefs as float16."""
    parser = argparse.ArgumentParser(prog="python -m tools.head.relief", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.npy")
    first = relief(samples())
    second = np.nanmean([first, changed(first)], axis=0)
    filled = np.nan_to_num([first, second], nan=FLOOR)
    np.save(parser.parse_args().output, np.maximum(filled, FLOOR).astype(np.float16))


if __name__ == "__main__":
    main()
