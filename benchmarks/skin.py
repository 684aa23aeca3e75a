"""Measure the errors of the slope filter and of disc lights, for docs/measurements/skin.md.

    python -m benchmarks.skin

Writes docs/measurements/skin.json in a quarter of an hour. Needs an OpenGL context and the head
scan.
"""

from __future__ import annotations

from dataclasses import asdict

import facerender as fr
from benchmarks.data import save
from tests.verification.scan import load_scan, pores, scan_folder
from tests.verification.slope_filter import Float, disc, filtered, flicker, relief, slopes_of

SIZES, SLOPES, STRENGTHS = (64, 128, 256, 512), (0.15, 0.25, 0.4), (1.0, 3.0)
TURNS = tuple(-20.0 + 0.15 * turn for turn in range(8))
DISCS = ((20.0, 5.0), (20.0, 20.0), (60.0, 5.0), (60.0, 20.0), (110.0, 5.0), (110.0, 10.0))

Subjects = dict[str, tuple[fr.Mesh, Float]]


def subjects() -> Subjects:
    """Return the built-in head and the head scan, each with the slopes of its relief."""
    if (folder := scan_folder()) is None:
        raise SystemExit("no head scan: set FACERENDER_TEST_DATA")
    head = fr.load_mesh()
    texture = head.materials[0].normal_map
    assert texture is not None
    return {"head": (head, slopes_of(texture)), "scan": (load_scan(folder), pores(folder))}


def main() -> None:
    seen, shaken = [], []
    for name, (mesh, slopes) in subjects().items():
        for strength in STRENGTHS:
            label, texture = f"{name} x{strength:g}", relief(slopes, strength)
            for size in SIZES:
                for m in SLOPES:
                    lost = filtered(mesh, texture, m, size)
                    losses = {each: asdict(value) for each, value in lost.items()}
                    seen.append({"relief": label, "size": size, "m": m, "lost": losses})
                    print(label, size, m, lost["none"], lost["filter"], flush=True)
            beyond = flicker(mesh, texture, 0.15, 128, TURNS)
            shaken.append({"relief": label, "beyond": beyond})
            print(label, beyond, flush=True)
    discs = []
    for angle, radius in DISCS:
        for m in (0.15, 0.3):
            errors = dict(zip(("without", "with"), disc(angle, radius, m), strict=True))
            discs.append({"angle": angle, "radius": radius, "m": m, **errors})
    save("skin", filtered=seen, flicker=shaken, discs=discs)


if __name__ == "__main__":
    main()
