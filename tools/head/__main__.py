"""Command line of the generator: ``python -m tools.head -o OUT.glb``."""

import argparse
import sys
import time
from pathlib import Path

from .eye_texture import paint_eyes
from .eyes import both_eyes, corneas, eyeballs
from .glb import CORNEA, EYEBALLS, LASHES, TEAR_LINE, Part, write_glb
from .lashes import lashes, tear_lines
from .lids import open_lids, with_open_eyes
from .mouth import with_mouth
from .shapes import lash_moves, skin_moves
from .surface import Mesh, build_mesh
from .texture import paint
from .unwrap import unwrap

EYE_TEXTURE_SHARE = 4  # the chart of an eye is so many times narrower than the skin's maps


def write_head(path: Path, closed: Mesh, *, open_eyes: bool, texture_size: int, seed: int) -> None:
    """Paint the ``closed`` head, open its eyes if wanted, and write the GLB file."""
    eyes = both_eyes() if open_eyes else ()
    openings = [open_lids(eye) for eye in eyes]
    cut, tucked, rings = with_open_eyes(closed, openings) if eyes else (closed, None, [])
    shaped, mouth = with_mouth(cut)
    head = unwrap(shaped, mouth, tucked)
    maps = paint(head, texture_size, seed, closed, eyes)
    moves = skin_moves(shaped, mouth, openings, rings)
    parts = []
    if eyes:
        strands = lashes(openings, seed)
        eye_maps = paint_eyes(eyes, texture_size // EYE_TEXTURE_SHARE, seed)
        parts = [
            Part("eyeballs", eyeballs(eyes), EYEBALLS, eye_maps),
            Part("lash-strands", strands, LASHES, moves=lash_moves(strands, openings)),
            Part("tear-line", tear_lines(openings), TEAR_LINE),
            Part("cornea", corneas(eyes), CORNEA),
        ]
    write_glb(path, head, maps, moves, parts)


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
    parser.add_argument("--eyes", choices=("open", "closed"), default="open", help="default: open")
    arguments = parser.parse_args()
    if arguments.texture_size < 64:
        parser.error(f"--texture-size {arguments.texture_size} is too small: give at least 64")

    start = time.perf_counter()
    write_head(
        arguments.output,
        build_mesh(),
        open_eyes=arguments.eyes == "open",
        texture_size=arguments.texture_size,
        seed=arguments.seed,
    )
    size, seconds = arguments.output.stat().st_size, time.perf_counter() - start
    print(f"{arguments.output}: {size} bytes, {seconds:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
