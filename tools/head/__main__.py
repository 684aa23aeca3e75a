"""Command line: ``python -m tools.head -o OUT.glb``.  Nothing is computed here."""

import argparse
import sys
import time
from pathlib import Path

from .glb import write_glb
from .surface import build_mesh
from .texture import paint
from .unwrap import unwrap


def main() -> None:
    """Generate the head and write it."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.head", description="Generate the built-in head."
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.glb")
    parser.add_argument(
        "--texture-size", type=int, default=2048, help="texels across albedo and normal map"
    )
    parser.add_argument("--seed", type=int, default=7, help="of pores, hairs and blotches")
    arguments = parser.parse_args()
    if arguments.texture_size < 64:
        parser.error(f"--texture-size {arguments.texture_size}: at least 64 is needed")

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
