"""Add eyes behind transparent shells to a head, from arrays, and save views in several formats.

Run: python head_of_parts.py [FOLDER]
"""

from __future__ import annotations

import copy
import pickle
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import facerender as fr

EYES = ((0.0318, 0.0001, 0.0697), (-0.0326, 0.0009, 0.0697))  # eye centres of the built-in head, m
RADIUS = 0.01175


def ball(
    centre: tuple[float, float, float], radius: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return positions (N, 3) and faces (F, 3) of a sphere."""
    rows, columns = 24, 48
    polar, around = np.meshgrid(
        np.linspace(0.01, np.pi - 0.01, rows), np.linspace(0.0, 2.0 * np.pi, columns), indexing="ij"
    )
    across = np.sin(polar)
    points = np.stack([across * np.cos(around), np.cos(polar), across * np.sin(around)], axis=-1)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    return np.asarray(centre) + radius * points.reshape(-1, 3), faces


def eyes() -> list[fr.Mesh]:
    """Return eyeballs and the transparent shells over them."""
    white = fr.Material(albedo=(0.8, 0.8, 0.8), m=0.3)
    clear = fr.Material(albedo=(1.0, 1.0, 1.0), alpha="blend", opacity=0.1, m=0.05)
    return [
        fr.Mesh.from_arrays(*ball(centre, size * RADIUS), material=material, name=name)
        for centre in EYES
        for name, size, material in (("eye", 1.0, white), ("shell", 1.02, clear))
    ]


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    head = fr.load_mesh().select("head")  # the skin, without its own eyes
    whole = [head, *eyes()]
    mesh = fr.Mesh.of(
        "a head with eyes",
        [part for each in whole for part in each.parts],
        [material for each in whole for material in each.materials],
        head.millimetres,
    )
    print(mesh, [part.name for part in mesh.parts])
    mesh = pickle.loads(pickle.dumps(copy.deepcopy(mesh)))

    with fr.Renderer((512, 512)) as renderer:
        face = renderer.render(fr.Scene(mesh, fr.Camera(azimuth=15, frame="face")))
        face.save(folder / "face.jpg")
        print(face, face.image.size)
        numbers = renderer.render(fr.Scene(mesh), only="parts").linear[..., 0]
        print("visible parts:", sorted(map(int, np.unique(numbers))))
        bare = renderer.render(fr.Scene(mesh.select(hide="shell*"), fr.Camera(frame="face")))
        content = BytesIO()
        bare.save(content, format="png")
        print("without shells:", len(content.getvalue()), "bytes")
        views = fr.turntable(fr.Camera(frame="head"), count=8)
        frames = [renderer.render(fr.Scene(mesh, view)).srgb8() for view in views]
    fr.save_animation(folder / "head.gif", frames, fps=4)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/head_of_parts"))
