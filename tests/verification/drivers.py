"""The cameras of the comparison as each of Mesa's software drivers draws them. A driver is chosen
when Mesa is loaded: each draws in a process of its own, which this module is as well.

python -m tests.verification.drivers FOLDER SIZE [SCAN]
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import facerender as fr
from tests.verification.mutations import CAMERAS
from tests.verification.scan import load_scan

DRIVERS = ("llvmpipe", "softpipe")


def draw_with(driver: str, folder: Path, scan: Path | None, size: int) -> dict[str, Path]:
    """Write an EXR for each of CAMERAS, of the head or, where its folder is given, of the scan."""
    arguments = [str(folder), str(size), *([] if scan is None else [str(scan)])]
    subprocess.run(
        [sys.executable, "-m", "tests.verification.drivers", *arguments],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "GALLIUM_DRIVER": driver, "LIBGL_ALWAYS_SOFTWARE": "1"},
        check=True,
        capture_output=True,
    )
    return {camera: folder / f"{camera}.exr" for camera in CAMERAS}


def main(folder: str, size: str, scan: str | None = None) -> None:
    mesh = fr.load_mesh() if scan is None else load_scan(Path(scan))
    Path(folder).mkdir(exist_ok=True)
    pixels = (int(size), int(size))
    with fr.Renderer(pixels, samples=1, backend="egl", float_albedo=True) as renderer:
        for name, camera in CAMERAS.items():
            renderer.render(fr.Scene(mesh, camera)).save(Path(folder, f"{name}.exr"))


if __name__ == "__main__":
    main(*sys.argv[1:])
