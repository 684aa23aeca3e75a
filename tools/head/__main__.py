"""Command line of the generator: ``python -m tools.head -o OUT.glb``."""

import argparse
import sys
import time
from pathlib import Path

from .glb import write_glb
from .surface import build_mesh
from .texture import paint
from .unwrap import unwrap


def main() -> None:
    """Generate the head and write the GLB file."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.head", description="Generate the built-in head."
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.glb")
    parser.add_argument(
        "--texture-size", type=int, default=2048, help="width of albedo and normal map in texels"
    )
    parser.add_argument("--seed", type=int, default=7, help="seed of pores, hairs and blotches")
    arguments = parser.parse_args()
    if arguments.texture_size < 64:
        parser.error(f"--texture-size {arguments.texture_size} is too small: give at least 64")

    start = time.perf_counter()
    head = unwrap(build_mesh())
    maps = paint(head, arguments.texture_size, arguments.seed)
    write_glb(arguments.output, head, maps)
    print(
        f"{arguments.output}: {len(head.mesh.positions)} vertices, {len(head.mesh.faces)} faces, "
        f"{arguments.output.stat().st_size} bytes, {time.perf_counter() - start:.0f} s",
        file=sys.stderr,
    )


if __name__ == "__main__":
    main()
