"""Writes docs/comparison.md: which check of the image comparison sees what, and what escapes it.

python -m tools.docs.comparison      from the repository's root; needs an OpenGL context, and the head
                               scan of the tests for half of the tables

The tables of the suite of pairs come from docs/measurements/pairs.json and pairs_peers.json:

python -m tests.verification.pairs SUITE
python -m tests.verification.pairs.verdicts SUITE -o docs/measurements/pairs.json
python -m tests.verification.pairs.verdicts SUITE --peers -o docs/measurements/pairs_peers.json

The last needs, beside the extras measure, head and hdr, what nothing else of the project does: pip
install pybind11-pixelmatch; npm install odiff-bin; apt-get install imagemagick. It leaves out what
is not there.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy import ndimage

import facerender as fr
from facerender.comparison.compare import compare
from facerender.comparison.result import FOREIGN, LIMITS, Comparison
from facerender.images.srgb import encode_srgb8
from facerender.measure.tables import markdown_table
from tests.verification.drivers import DRIVERS, draw_with
from tests.verification.mutations import (
    BROKEN,
    CAMERAS,
    HARMLESS,
    SIZE,
    Images,
    Studio,
    brighter,
    rougher,
    weaker,
)
from tests.verification.pairs.scenes import SETTINGS
from tests.verification.pairs.verdicts import FACERENDER, Summary, read_summary
from tests.verification.scan import load_scan, scan_folder
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/comparison.md"
MEASUREMENTS = Path(__file__).parents[2] / "docs/measurements"
CHECKS = {  # and how their reasons begin
    **{"point": r"\d+ pixel", "block": "block", "trend": "neighbouring blocks", "grain": "grain"},
    **{"texture": "texture", "shift": "shift", "coverage": "coverage"},
}
HEAD = ("change", "point, pixels", "block, blocks", "trend", "texture", "checks", "looks like")
DRIVERS_HEAD = ("image", *HEAD[1:])
JUDGES_HEAD = (
    *("judge", "PNG: threshold", "caught", "false alarms", "balanced accuracy"),
    *("EXR: threshold", "caught", "false alarms", "balanced accuracy"),
)
CHANGES_HEAD = ("change", "PNG", "EXR")

Change = Callable[[float], Images]
Sees = Callable[[Images], bool]


def meshes() -> Iterator[tuple[str, fr.Mesh]]:
    yield "head", fr.load_mesh()
    if (scan := scan_folder()) is not None:
        yield "scan", load_scan(scan)


def failed_checks(result: Comparison) -> list[str]:
    """Name the checks that failed, by their reasons."""
    return [
        name
        for name, start in CHECKS.items()
        if any(re.match(start, reason) for reason in result.reasons)
    ]


# By each check alone: of the trend no reason is told where blocks are over their limit.
ALONE: dict[str, Callable[[Comparison], bool]] = {
    "point": lambda result: "point" in failed_checks(result),
    "block": lambda result: result.blocks > 0,
    "trend": lambda result: result.changed_alike,
}
THRESHOLDS_HEAD = ("image", "change", *ALONE, "EXR", "PNG")


def row(result: Comparison) -> list[str]:
    unit = 1.0 if result.encoding == "srgb8" else 100.0
    block = f"{unit * result.block:+.2g}" + ("" if unit == 1.0 else " %")
    guesses = dict.fromkeys(
        reason.split("looks like ")[-1].split(" (")[0] for reason in result.reasons
    )
    return [
        f"{result.point:+.2g}, {result.points}",
        f"{block}, {result.blocks} of {result.blocks_judged}",
        f"{result.trend:.2g}",
        f"{100.0 * result.texture:+.1f} %",
        ", ".join(failed_checks(result)) or "none",
        "; ".join(guesses) or "same",
    ]


def mutation_table(studio: Studio) -> str:
    entries = BROKEN | HARMLESS
    rows = [[name, *row(compare(*make(studio)))] for name, make in entries.items()]
    return markdown_table(HEAD, rows)


def driver_table() -> str:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for size in (512, 1024):
            for name, scan in {"head": None, "scan": scan_folder()}.items():
                if name == "scan" and scan is None:
                    continue
                a, b = (draw_with(each, Path(folder) / each, scan, size) for each in DRIVERS)
                for camera in CAMERAS:
                    result = compare(a[camera], b[camera])
                    rows.append([f"{name}, {camera}, {size}", *row(result)])
    return markdown_table(DRIVERS_HEAD, rows)


def smallest(change: Change, found: Sees, most: float) -> str:
    """Find by bisection the smallest change that is seen, to 5 %."""
    low, high = 0.0, most
    if not found(change(high)):
        return f"> {most:g}"
    while high - low > 0.05 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if found(change(middle)) else (middle, high)
    return f"{high:.2g}"


def sees(check: str) -> Sees:
    return lambda images: ALONE[check](compare(*images))


def differ(images: Images) -> bool:
    return not compare(*images).same


def png(images: Images) -> bool:
    return not compare(*(encode_srgb8(image[..., :3]) for image in images)).same


def one_pixel(linear: np.ndarray, place: tuple[int, int], sign: float) -> Change:
    def change(by: float) -> Images:
        image = linear.copy()
        image[(*place, slice(0, 3))] += sign * by
        return linear, image

    return change


def places(linear: np.ndarray) -> dict[str, tuple[int, int]]:
    """A pixel of median radiance in the interior, the flattest such, and one at the silhouette."""
    full = linear[..., 3] >= 1.0
    inside = ndimage.binary_erosion(full, iterations=8)
    level = linear[..., :3].mean(axis=-1)
    contrast = ndimage.maximum_filter(level, 5) - ndimage.minimum_filter(level, 5)
    middle = inside & (np.abs(level - np.median(level[inside])) < 0.05)
    smooth = np.unravel_index(np.where(middle, contrast, np.inf).argmin(), level.shape)
    rim = np.argwhere(full & ~ndimage.binary_erosion(full))
    return {"smooth skin": smooth, "the silhouette": tuple(rim[len(rim) // 2])}


def threshold_rows(name: str, studio: Studio) -> Iterator[list[str]]:
    changes: dict[str, tuple[Change, float]] = {
        "ks, %": (lambda by: weaker(studio, 0.01 * by), 50.0),
        "m from 0.3, %": (lambda by: rougher(studio, 0.3 * (1.0 + 0.01 * by)), 50.0),
        "exposure, %": (lambda by: brighter(studio, 0.01 * by), 50.0),
    }
    linear = studio.draw()
    for where, place in places(linear).items():
        changes[f"pixel brighter, {where}"] = (one_pixel(linear, place, 1.0), 8.0)
        changes[f"pixel darker, {where}"] = (one_pixel(linear, place, -1.0), 1.0)
    for what, (change, most) in changes.items():
        finds = (*map(sees, ALONE), differ, png)
        yield [name, what, *(smallest(change, each, most) for each in finds)]


def judges_table(own: Summary, peers: Summary) -> str:
    """The judges on the half that is reported, facerender first."""
    scores = {
        (each.judge, each.format): each
        for each in (*own.scores, *peers.scores)
        if each.half == "report"
    }
    rows = []
    for judge in dict.fromkeys(name for name, _ in scores):
        row = [judge]
        for kind in ("png", "exr"):
            if (found := scores.get((judge, kind))) is None:
                row += [""] * 4
                continue
            row += [
                "" if judge == FACERENDER else f"{found.threshold:.3g}",
                f"{found.caught} of {found.must_fail}",
                f"{found.alarms} of {found.must_pass}",
                f"{found.balanced:.3f}",
            ]
        rows.append(row)
    return markdown_table(JUDGES_HEAD, rows)


def changes_table(own: Summary, must: str) -> str:
    """How many scenes of the half that is reported facerender found different, by change."""
    counts = {
        (each.change, each.format): f"{each.different} of {each.pairs}"
        for each in own.tallies
        if (each.half, each.must) == ("report", must)
    }
    rows = [
        [change, *(counts.get((change, kind), "") for kind in ("png", "exr"))]
        for change in dict.fromkeys(name for name, _ in counts)
    ]
    return markdown_table(CHANGES_HEAD, rows)


TEXT = """# The image comparison

Written by `python -m tools.docs.comparison`; `tests/test_compare.py` holds the comparison to every line
of the first tables, on both meshes, from the front and from three-quarter, with 1 and 4 samples.

`facerender compare A B` and `facerender.compare(a, b)` have seven checks; linear images first, of
8-bit ones in brackets:

- **point**, {point:g} radiance ({point8:g} of 255): how far a pixel leaves the 3 x 3
  neighbourhood in the other image, less half the range of 5 x 5 pixels and a hundredth of the
  level; at edges a few slivers may be over.
- **block**, {block:g} of it ({block8:g} of 255): the change of the mean of 16 x 16 pixels, smooth
  ones counting most, beyond three standard errors, less what a shift of the image explains.
- **trend**, {trend:g}: the mean product of neighbouring blocks' changes, each over its standard
  error: about 0 where they scatter, large where a lobe, a weight or a light changed them alike.
- **grain**, {grain:g} of the level ({grain8:g} of 255): RMS that was added from one pixel to the
  next where the images are flat; half as much again may be lost.
- **texture**, {texture:g}: the fraction of the variance from one pixel to the next that was added.
- **shift**, {shift:g}: pixels by which the whole image is displaced.
- **coverage**, {coverage:g}: the fraction of the pixels whose coverage passed one half, or left that
  of its neighbourhood by 0.2.

What drivers, cameras and codecs do differently scatters from pixel to pixel and lies at edges: the
standard errors hold it, measured on the pair itself. Where the files say that another driver drew
the image, or one of them does not say who did, its filter of 8-bit textures may differ by 0.3 steps
of 255, and trend, grain and texture have limits {foreign:g} times as wide. The losses of a
JPEG count as differences, with a warning: save images as PNG.

All images: Cook-Torrance, exact lobe, default lights, float albedo, 1 sample, {size} x {size}
where nothing else is said.

## What is seen, and what passes

Point in radiance and block in percent, of the 8-bit line in steps of 255; behind them the pixels
and blocks over their limits.

{mutations}

### llvmpipe against softpipe

{drivers}

## The smallest change that each check sees

Found by bisection, to 5 %: by one check, by any of them on linear images, and by any on the images
as 8-bit sRGB without alpha. Of a single pixel the number is what was added to its radiance, or
taken off; "> x": not seen up to x.

{thresholds}

## A suite of pairs, and other tools

Twelve scenes, of {sizes} pixels a side and with 1 and 4 samples, each drawn as it is and once per
change, as EXR and as PNG, in two halves that share no head, camera or light: `python -m
tests.verification.pairs SUITE`. The limits are set by looking at the one half; all figures here are of the
other, which was printed, too, while those of texture and holes were settled. Pairs of identical
pixels are left out, and so are changes that must fail and move no pixel by more than the
encoding's noise: 0.5 % of its radiance or of 0.01, whichever is more, in EXR; 1 of 255, before
rounding, in PNG.

facerender compares at its defaults. Every number of another tool has the threshold that suits this
very half best: the highest balanced accuracy, the mean of the share that is caught of what must
fail and the share that passes of what must pass. Of what must pass, the other tools' PNG columns also
count 12 JPEGs at quality 95 and 98. `python -m tests.verification.pairs.verdicts SUITE` writes
them, with {versions}.

{judges}

### What must fail: scenes in which facerender finds it

{broken}

### What must pass: scenes in which facerender fails it

{harmless}

## What escapes

- Changes under the figures above, and those of the pairs' tables that are not found in all scenes:
  of normals to 8 bits and half floats, in 8-bit images most of all.
- A single pixel at an edge, by less than 0.5 (90 of 255): so do slivers come and go.
- Black pixels beside a black background, in images without alpha.
- Changes of a lobe of less than 1 % where another driver drew the image: its 8-bit textures
  differ.

## What fails although nothing is broken

- A map, a mesh or a camera that really changed by little: a shift of 0.3 pixels, 5 % less relief.
- Hair cards and lashes in images of few pixels, by single strands of a driver or a sample more.
- Another number of samples: a golden fixes it.
- A JPEG beside the PNG that it was made of: all of 24 pairs, at quality 95 and 98.

{renderer}, OpenGL {version}.
"""


def stale() -> Iterator[str]:
    """Tell what the document lacks of what is not measured."""
    return missing(OUTPUT, TEXT, (HEAD, DRIVERS_HEAD, THRESHOLDS_HEAD, JUDGES_HEAD, CHANGES_HEAD))


def main() -> None:
    mutations, thresholds = [], []
    for name, mesh in meshes():
        with fr.Renderer((SIZE, SIZE), samples=1, float_albedo=True) as renderer:
            for camera, where in CAMERAS.items():
                studio = Studio(renderer, mesh, where)
                mutations.append(f"### {name}, {camera}\n\n{mutation_table(studio)}")
                thresholds += threshold_rows(f"{name}, {camera}", studio)
            context = renderer.context
    own, peers = (read_summary(MEASUREMENTS / f"{name}.json") for name in ("pairs", "pairs_peers"))
    sizes = sorted({each.size for each in SETTINGS.values()})
    linear, steps = LIMITS["linear"], LIMITS["srgb8"]
    text = TEXT.format(
        mutations="\n\n".join(mutations),
        drivers=driver_table(),
        thresholds=markdown_table(THRESHOLDS_HEAD, thresholds),
        sizes=f"{sizes[0]} to {sizes[-1]}",
        versions=", ".join(peers.versions.values()),
        judges=judges_table(own, peers),
        broken=changes_table(own, "fail"),
        harmless=changes_table(own, "pass"),
        size=SIZE,
        point=linear.point,
        trend=linear.trend,
        grain=linear.grain,
        grain8=steps.grain,
        texture=linear.texture,
        shift=linear.shift,
        foreign=FOREIGN,
        block=linear.block,
        coverage=linear.coverage,
        point8=steps.point,
        block8=steps.block,
        renderer=context.renderer,
        version=context.version,
    )
    OUTPUT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
