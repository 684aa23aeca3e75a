"""Render the unchanged scenes of the group "judge" with this machine's driver, for other machines.

python -m benchmarks.pairs.unchanged OUT

Each scene gives SCENE-SAMPLES.exr, with one sample and with the samples of the scene, as half
floats. ``python -m benchmarks.pairs SUITE --drawn OUT`` adds these images to a suite. The module
needs the package with its extra ``exr``, and no other package.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np

from facerender.images.files import exr_bytes
from facerender.system.files import write_bytes
from tests.verification.pairs.room import Room
from tests.verification.pairs.scenes import SETTINGS, Setting


def file_of(folder: Path, setting: Setting, samples: int) -> Path:
    """Return the file of an unchanged scene."""
    return folder / f"{setting.name}-{samples}.exr"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pairs.unchanged",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    for setting in SETTINGS.values():
        if setting.group != "judge":
            continue
        room = Room(setting)
        for samples in {1, setting.samples}:
            file = file_of(out, setting, samples)
            pixels = room.draw(samples=samples).astype(np.float16)
            metadata = {**room.renderer.metadata, "samples": str(samples)}
            write_bytes(file, exr_bytes(file.name, {"RGBA": pixels}, metadata))
            print(file.name, metadata["GL_RENDERER"], flush=True)
        room.renderer.release()


if __name__ == "__main__":
    main()
