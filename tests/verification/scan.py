"""Loads the Lee Perry-Smith head scan (triplegangers.com, CC BY 3.0), which is not in the
repository."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr

TEST_DATA = Path(
    os.environ.get("FACERENDER_TEST_DATA", Path(__file__).parents[3] / "shared" / "data")
)


def scan_folder() -> Path | None:
    """Return the folder of the scan, or None if it is not installed."""
    folder = TEST_DATA / "faces" / "LeePerrySmith"
    return folder if folder.is_dir() else None


def load_scan(folder: Path) -> fr.Mesh:
    """Return the scan with its maps."""
    return fr.load_mesh(
        folder / "LeePerrySmith.glb",
        albedo=folder / "Map-COL.jpg",
        normal_map=folder / "Infinite-Level_02_Tangent_SmoothUV.jpg",
        specular_map=folder / "Map-SPEC.jpg",
        flip_v=True,
    )


def pores(folder: Path, size: int = 2048) -> NDArray[np.float64]:
    """Return the slopes (size, size, 2) of the scan's pores, row 0 on top.

    Low frequencies come from the tangent-space map and high ones from the displacement map. The
    latter is scaled to match the tangent-space map where both have detail.
    """
    from scipy.ndimage import gaussian_filter, zoom

    with Image.open(folder / "Infinite-Level_02_Tangent_SmoothUV.jpg") as tangents:
        normals = np.asarray(tangents.convert("RGB"), dtype=np.float64) / 127.5 - 1.0
    slopes = -normals[..., :2] / np.maximum(normals[..., 2:], 0.25)
    slopes -= slopes.mean(axis=(0, 1))
    with Image.open(folder / "Infinite-Level_02_Disp_NoSmoothUV-4096.jpg") as displacement:
        height = np.asarray(displacement.convert("L"), dtype=np.float64) / 255.0
    fine = gaussian_filter(height, 0.7) - gaussian_filter(height, 4.0)
    down, right = np.gradient(fine)
    wide = len(height) // len(slopes)
    whole = zoom(slopes, (wide, wide, 1), order=1)
    whole += 38.0 * np.stack([right, -down], axis=-1)
    shrink = len(height) // size
    blocks = np.clip(whole, -1.5, 1.5).reshape(size, shrink, size, shrink, 2)
    return np.asarray(blocks.mean(axis=(1, 3)))
