"""Measure the resident memory of a process that renders, above the memory of its imports.

    python benchmarks/memory.py [--frames 2000] [--samples 4] [--size 1024]
    python benchmarks/memory.py --dropped 500 [--samples 4] [--size 256]
    python benchmarks/memory.py --changes 100000 [--samples 4] [--size 64]
    python benchmarks/memory.py --maps 8192 [--samples 4] [--size 1024]

--frames     the camera moves, and every frame is read back
--dropped    each frame creates a renderer and does not release it
--changes    each frame has another camera and random terms, every 20th a shadow and a mesh with a
             map from new files, every 5000th another m; every 1000th time, an unchanged scene must
             give the same bytes
--maps       albedo, normal and roughness maps of N x N texels, reduced to the size that the image
             needs, and full (--full-maps): peak memory of both, and the difference of the images

Prints resident MiB, which stays constant if nothing leaks.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import moderngl  # noqa: F401
import numpy as np
import trimesh  # noqa: F401
from batch_kills import small
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.files import read_image
from facerender.images.image import linear_to_srgb
from facerender.scene.light import LIGHTS
from facerender.terms.model import FRESNEL, MASKING


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def frames(count: int, size: int, samples: int) -> Iterator[None]:
    mesh = fr.load_mesh()
    with fr.Renderer((size, size), samples=samples) as renderer:
        for frame in range(count):
            renderer.render(fr.Scene(mesh, fr.Camera(azimuth=2.0 * (frame % 180))))
            yield


def dropped(count: int, size: int, samples: int) -> Iterator[None]:
    scene = fr.Scene(fr.load_mesh())
    warnings.simplefilter("ignore", ResourceWarning)
    for _ in range(count):
        fr.Renderer((size, size), samples=samples).render(scene)
        yield


# Runs the command and prints the peak memory from /proc: ru_maxrss of a child includes the peak of
# its parent.
COMMAND = """
import sys
from pathlib import Path
from facerender.commands import main
main(sys.argv[1:])
(line,) = (each for each in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in each)
print(line)
"""


def changes(count: int, size: int, samples: int) -> Iterator[None]:
    random = np.random.default_rng(1)
    lobes = ("exact", "d8", "d16", "fitted")
    terms: list[dict[str, Any]] = [{"model": "ward", "lobe": lobe} for lobe in lobes]
    names = ("lobe", "fresnel", "masking")
    terms += [dict(zip(names, each, strict=True)) for each in product(lobes, FRESNEL, MASKING)]
    with TemporaryDirectory() as folder, fr.Renderer((size, size), samples=samples) as renderer:
        unchanged = Path(folder, "unchanged")
        unchanged.mkdir()
        scene = fr.Scene(fr.load_mesh(small(unchanged)))
        expected = renderer.render(scene).linear.tobytes()
        for number in range(count):
            if number % 20 == 0:
                path = small(Path(folder))
                path.write_text(path.read_text().replace("v 1 0 0", f"v {1.0 + 1e-5 * number} 0 0"))
                texels = random.integers(0, 256, (256, 256, 3), dtype=np.uint8)
                Image.fromarray(texels).save(Path(folder, "skin.png"), compress_level=1)
                mesh = fr.load_mesh(path)
            m = 0.1 + 5e-6 * (number - number % 5000)
            shading = fr.Shading(**terms[random.integers(len(terms))], m=m)
            camera = fr.Camera(azimuth=float(number % 360))
            light = replace(LIGHTS["key"], shadow=number % 20 == 0)
            renderer.render(fr.Scene(mesh, camera, (light,)), shading)
            if number % 1000 == 0 and renderer.render(scene).linear.tobytes() != expected:
                raise SystemExit(f"frame {number}: an unchanged scene renders to another image")
            yield


def noise(side: int, seed: int) -> NDArray[np.float32]:
    """Return noise of four octaves, (side, side)."""
    random, total = np.random.default_rng(seed), np.zeros((side, side), np.float32)
    for octave in (1, 2, 16, 128):
        grid = random.standard_normal((side // octave, side // octave)).astype(np.float32)
        total += np.asarray(Image.fromarray(grid).resize((side, side), Image.Resampling.BICUBIC))
    return total


def maps(side: int, size: int, samples: int) -> None:
    height = 0.05 * noise(side, 1)
    slopes = [np.roll(height, 1, axis) - height for axis in (1, 0)]
    normals = np.stack([*slopes, np.ones_like(height)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    values = {
        "albedo": np.array((190.0, 150.0, 130.0)) + 14.0 * noise(side, 2)[..., None],
        "normal-map": 127.5 + 127.5 * normals,
        "roughness-map": 130.0 + 12.0 * noise(side, 3),
    }
    with TemporaryDirectory() as folder:
        files = []
        for name, texels in values.items():
            path = f"{folder}/{name}.png"
            Image.fromarray(texels.clip(0, 255).astype(np.uint8)).save(path, compress_level=1)
            files += [f"--{name}", path]
        pictures: list[NDArray[np.float64]] = []
        for kind in ([], ["--full-maps"]):
            image = f"{folder}/image{len(pictures)}.exr"
            command = [sys.executable, "-c", COMMAND, "render", *files, *kind, "-o", image]
            command += ["--no-cache", "--size", str(size), "--samples", str(samples)]
            output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            most = int(output.split()[-2]) * 1024 / 1e6
            print(f"{' '.join(kind) or 'reduced'}: peak {most:.0f} MB", flush=True)
            linear = read_image(image).pixels[..., :3]
            pictures.append(linear_to_srgb(np.clip(linear, 0.0, 1.0)) * 255.0)
    off = np.abs(pictures[0] - pictures[1]).max(axis=-1)
    print(f"{(off > 1.0).mean():.4%} of pixels differ by over 1/255; at most {off.max():.2f}/255")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--dropped", type=int, default=0)
    parser.add_argument("--changes", type=int, default=0)
    parser.add_argument("--maps", type=int, default=0)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--size", type=int, default=1024)
    options = parser.parse_args()
    if options.maps:
        return maps(options.maps, options.size, options.samples)
    imports = resident()
    count, kind = options.frames, frames
    for other in (dropped, changes):
        if number := getattr(options, other.__name__):
            count, kind = number, other
    for done, _ in enumerate(kind(count, options.size, options.samples), start=1):
        if done in {1, 10, count} or done % max(count // 10, 1) == 0:
            held = (resident() - imports) / 2**20
            print(f"{done:6} {kind.__name__}: {held:.0f} MiB above imports", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - imports
    print(f"peak: {peak / 2**20:.0f} MiB above imports")


if __name__ == "__main__":
    main()
