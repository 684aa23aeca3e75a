"""The Lee Perry-Smith head scan (triplegangers.com, CC BY 3.0) among the data that the repository
does not hold."""

from __future__ import annotations

import os
from pathlib import Path

import facerender as fr

TEST_DATA = Path(
    os.environ.get("FACERENDER_TEST_DATA", Path(__file__).parents[2] / "shared" / "data")
)


def scan_folder() -> Path | None:
    """Return the folder of the scan, where there is one."""
    folder = TEST_DATA / "faces" / "LeePerrySmith"
    return folder if folder.is_dir() else None


def load_scan(folder: Path) -> fr.Mesh:
    """Return the scan of a folder with its maps."""
    return fr.load_mesh(
        folder / "LeePerrySmith.glb",
        albedo=folder / "Map-COL.jpg",
        normal_map=folder / "Infinite-Level_02_Tangent_SmoothUV.jpg",
        specular_map=folder / "Map-SPEC.jpg",
        flip_v=True,
    )
