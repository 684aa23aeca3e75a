"""Pictures of a comparison: a heat map, and a page to look at.

Every picture is 8-bit sRGB, linear radiance 1 being white, over black where the coverage ends;
values that are not finite are magenta.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.gates import BLOCK, Comparison, Pair
from facerender.errors import InputError
from facerender.image import Encoding, Picture, encode_srgb8, save_png, write_bytes
from facerender.page.document import document, image_source, row, table

VERDICTS = {1: "differs", 2: "error", 0: "same"}  # by status, in the page's order
INDEX = "\N{SYMBOL FOR UNIT SEPARATOR}"  # in no name
THUMBNAIL = 160  # pixels a side
LEVELS = 32  # of the difference, either way
DARKER, BRIGHTER, UNCOVERED = (74, 163, 255), (255, 148, 41), (190, 70, 255)
NOT_FINITE = (255, 0, 255)
FLOORS: dict[Encoding, float] = {"linear": 1e-3, "srgb8": 1.0}  # of the difference's scale
MODES = ("side by side", "blink", "slider", "difference")

Bytes = NDArray[np.uint8]


def save_heat_map(path: str | os.PathLike[str], pair: Pair) -> None:
    """Write the heat map of FLIP (Andersson et al. 2020) as PNG.

    Raises
    ------
    InputError : flip-evaluator is missing, an image could not be read, the sizes differ, or the
        file is no .png or cannot be written
    """
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"the heat map {path}: give a .png")
    a, b = pair.reference, pair.image
    if a is None or b is None or a.pixels.shape[:2] != b.pixels.shape[:2]:
        raise InputError(f"no heat map: {pair.error}")
    save_png(path, _heat_map(_shown(a), _shown(b)), {})


@dataclass(frozen=True)
class Entry:
    """A pair as text, which takes less memory than its images and may go from process to process.

    Attributes
    ----------
    name, status : of the pair
    row, section : of the page; INDEX in them stands for the entry's number
    """

    name: str
    status: int
    row: str
    section: str


def entry(pair: Pair) -> Entry:
    """Return what the page says of a pair."""
    return Entry(pair.name, pair.status, _row(pair), _section(pair))


def write_report(path: str | os.PathLike[str], entries: Sequence[Entry]) -> None:
    """Write a page with every pair, self-contained, those that differ first.

    Raises
    ------
    InputError : the file cannot be written
    """
    # names may be no UTF-8
    write_bytes(path, _page(entries).encode(errors="backslashreplace"))


def _heat_map(a: Bytes, b: Bytes) -> Bytes:
    try:
        import flip_evaluator
    except ImportError:
        raise InputError(
            "a heat map needs the package flip-evaluator; pip install 'facerender[measure]'"
        ) from None
    images = (image.astype(np.float32) / 255.0 for image in (a, b))
    heat, _, _ = flip_evaluator.evaluate(*images, "LDR", computeMeanError=False)
    return np.asarray(np.round(255.0 * heat.clip(0.0, 1.0)), dtype=np.uint8)


def _shown(picture: Picture) -> Bytes:
    """Return (H, W, 3) to look at."""
    linear, color = picture.encoding == "linear", picture.color
    shown = encode_srgb8(color) if linear else np.round(color).astype(np.uint8)
    if shown.shape[2] == 1:
        shown = np.repeat(shown, 3, axis=-1)
    shown[~np.isfinite(picture.pixels).all(axis=-1)] = NOT_FINITE
    return shown


def _difference(a: Picture, b: Picture) -> tuple[Bytes, float]:
    """Return (H, W, 3), the signed difference in the worst channel, linear below the floor and
    logarithmic above; and the largest difference, which has the full colour."""
    floor = FLOORS[a.encoding]
    signed = np.subtract(b.color, a.color, dtype=np.float64)
    worst = np.abs(signed).argmax(axis=-1)[..., None]
    signed = np.take_along_axis(signed, worst, axis=-1)[..., 0]
    largest = max(float(np.abs(signed).max()), floor)
    level = np.log1p(np.abs(signed) / floor) / np.log1p(largest / floor)
    level = np.round(level * LEVELS).astype(int)
    ramp = np.linspace(0.0, 1.0, LEVELS + 1)[:, None]
    colors = np.round([ramp * DARKER, ramp * BRIGHTER]).astype(np.uint8)
    shown = colors[(signed > 0.0).astype(int), level]
    shown[((a.coverage >= 0.5) != (b.coverage >= 0.5)) & (level == 0)] = UNCOVERED
    return shown, largest


def _png(pixels: Bytes) -> bytes:
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def _thumbnail(picture: Picture) -> str:
    from PIL import Image

    image = Image.fromarray(_shown(picture))
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    return f'<img class="thumbnail" src="{image_source(_png(np.asarray(image)))}" alt="the image">'


_NOTES = """
<section>
<h2>How to read this</h2>
<dl class="note">
<dt>point</dt>
<dd>How far the worst pixel leaves the 3 × 3 neighbourhood of the same place in the other image. It
sees fireflies and missing pixels, and lets edges pass that moved by less than a pixel. At the
silhouette the limit is four times as wide.</dd>
<dt>block</dt>
<dd>The largest change of the mean of 16 × 16 pixels inside the coverage, beyond what a shift of
0.05 pixels explains; of linear images relative to that mean of A, or to 0.01. It sees a lobe or a
weight that changed; noise averages out.</dd>
<dt>coverage</dt>
<dd>The share of the pixels whose coverage, the alpha channel, changed.</dd>
<dt>pictures</dt>
<dd>Linear radiance 1 is white; black lies behind transparency; magenta is not finite. A click on a
picture enlarges a place, the arrow keys move it, another click shows the whole.</dd>
</dl>
</section>"""

_MOTION = """<label class="cut">cut <input type="range" min="0" max="100" value="50"></label>
<label class="blinking"><input type="checkbox" class="run">run</label>
<button class="blinking swap" type="button">swap</button>"""


def _page(entries: Sequence[Entry]) -> str:
    order = list(VERDICTS)
    ranked = sorted(entries, key=lambda entry: order.index(entry.status))
    counts = Counter(entry.status for entry in entries)
    words = {1: "differs" if counts[1] == 1 else "differ", 2: "not comparable", 0: "the same"}
    title = ", ".join(f"{counts[key]} {word}" for key, word in words.items() if counts[key])
    rows = (entry.row.replace(INDEX, str(number)) for number, entry in enumerate(ranked))
    sections = (entry.section.replace(INDEX, str(number)) for number, entry in enumerate(ranked))
    summary = table("names", ("pair", "verdict", "point", "block", "coverage"), rows)
    body = f"{summary}{''.join(sections)}{_NOTES}"
    return document(f"Comparison: {title}", body, "viewer.js")


def _row(pair: Pair) -> str:
    gates = _gates(pair.comparison) if pair.comparison else ()
    figures = [gate.relation for gate in gates] or ["–"] * 3
    name = f'<a href="#pair-{INDEX}">{escape(pair.name)}</a>'
    return row(name, [_verdict(pair), *figures], VERDICTS[pair.status])


def _section(pair: Pair) -> str:
    title = f"{escape(pair.name)} {_verdict(pair)}"
    gates = _gate_table(pair.comparison) if pair.comparison else ""
    tables = f'<div class="tables">{gates}{_facts(pair)}</div>'
    if pair.status == 0 and pair.reference:
        return (
            f'<details class="same"><summary>{title}</summary>'
            f'<div id="pair-{INDEX}">{_thumbnail(pair.reference)}{tables}</div></details>'
        )
    reasons = pair.comparison.reasons if pair.comparison else (pair.error,)
    said = "".join(f"<li>{escape(reason)}</li>" for reason in reasons)
    return (
        f'<section id="pair-{INDEX}" class="{VERDICTS[pair.status]}"><h2>{title}</h2>'
        f'<ul class="reasons">{said}</ul>{_viewer(pair)}{tables}</section>'
    )


def _verdict(pair: Pair) -> str:
    return f'<span class="verdict">{VERDICTS[pair.status]}</span>'


@dataclass(frozen=True)
class _Gate:
    name: str
    figure: str
    limit: str
    over: bool
    where: str = ""

    @property
    def relation(self) -> str:
        if self.over:
            return f'<span class="over">{self.figure} &gt;&nbsp;{self.limit}</span>'
        return f"{self.figure} ≤&nbsp;{self.limit}"


def _gates(result: Comparison) -> tuple[_Gate, _Gate, _Gate]:
    limits = result.limits
    amount = _percent if result.encoding == "linear" else _number
    point_at, block_at = ("({}, {})".format(*at) for at in (result.point_at, result.block_at))
    return (
        _Gate(
            "point",
            _number(abs(result.point)),
            _number(limits.point),
            result.points > 0,
            f"{_side(result.point)} at {point_at}; {result.points} over" if result.point else "",
        ),
        _Gate(
            "block",
            amount(abs(result.block)),
            amount(limits.block),
            result.blocks > 0,
            f"{_side(result.block)} from {block_at}; {result.blocks} of {result.blocks_judged} over"
            if result.block
            else "",
        ),
        _Gate(
            "coverage",
            _percent(result.coverage),
            _percent(limits.coverage),
            result.coverage > limits.coverage,
        ),
    )


def _gate_table(result: Comparison) -> str:
    rows = [row(gate.name, [gate.relation, gate.where]) for gate in _gates(result)]
    for name, value in (("largest difference", result.largest), ("mean difference", result.mean)):
        rows.append(row(name, [_number(value), ""]))
    unit = "radiance" if result.encoding == "linear" else "steps of 255"
    return table("gates", ("gate", "figure and limit", "B is"), rows, f"Figures, in {unit}")


def _facts(pair: Pair) -> str:
    """Lay out what the images are and what drew them, rows that differ marked."""
    pictures = {"A": pair.reference, "B": pair.image}
    facts = {name: _fact(picture) for name, picture in pictures.items() if picture}
    rows = []
    for key in dict.fromkeys(key for fact in facts.values() for key in fact):
        values = [fact.get(key, "") for fact in facts.values()]
        changed = "changed" if len(set(values)) > 1 and key != "image" else ""
        rows.append(row(escape(key), map(escape, values), changed))
    return table("facts", ("", *facts), rows, "Images, and what drew them") if facts else ""


def _fact(picture: Picture) -> dict[str, str]:
    height, width, channels = picture.pixels.shape
    kind = "linear" if picture.encoding == "linear" else "8-bit sRGB"
    space = {"colour space": picture.color_space} if picture.color_space else {}
    pixels = f"{width} × {height}, {channels} channel{'s' * (channels > 1)}, {kind}"
    return {"image": picture.name, "pixels": pixels, **space, **picture.metadata}


def _viewer(pair: Pair) -> str:
    """Show the images there are, and how they differ if they could be compared."""
    places = _places(pair)
    pictures = {"a": pair.reference, "b": pair.image}
    shown = {kind: _shown(picture) for kind, picture in pictures.items() if picture}
    captions = {"a": "<b>A</b> reference", "b": "<b>B</b> image"}
    figures = [_figure(kind, captions[kind], shown[kind], places) for kind in shown]
    if not figures:
        return ""
    controls = ""
    if pair.reference and pair.image and pair.comparison:
        controls = _choices("view", {mode: mode for mode in MODES})
        try:
            caption = "<b>heat map</b> FLIP: what the eye sees when the images alternate"
            figures.append(_figure("heat", caption, _heat_map(**shown), places))
        except InputError as error:
            figures.append(f'<p class="heat note">{escape(str(error))}</p>')
        difference, largest = _difference(pair.reference, pair.image)
        caption = _legend(largest, pair.comparison.encoding)
        figures.append(_figure("difference", caption, difference, places))
    centres = {name: f"{x + side // 2},{y + side // 2}" for name, (x, y, side) in places.items()}
    if places:
        controls += _choices("zoom", {"whole": "", **centres})
        controls += '<label><input type="checkbox" class="marks" checked>marks</label>'
    if pair.comparison:
        controls += _MOTION
    if controls:
        controls = f'<div class="controls">{controls}</div>'
    return (
        f'<div class="viewer">{controls}'
        '<div class="stage" tabindex="0" role="group" aria-label="images; arrow keys move what is'
        f' enlarged">{"".join(figures)}</div></div>'
    )


def _places(pair: Pair) -> dict[str, tuple[int, int, int]]:
    """Return x, y and side of what is worth a look."""
    places = {}
    if result := pair.comparison:
        if result.point:
            places["worst pixel"] = (*result.point_at, 1)
        if result.block:
            places["worst block"] = (*result.block_at, BLOCK)
        return places
    for letter, picture in (("A", pair.reference), ("B", pair.image)):
        if picture is not None and not np.isfinite(picture.pixels).all():
            row, column, _ = np.argwhere(~np.isfinite(picture.pixels))[0].tolist()
            places[f"not finite in {letter}"] = (column, row, 1)
    return places


def _figure(
    kind: str, caption: str, pixels: Bytes, places: Mapping[str, tuple[int, int, int]]
) -> str:
    height, width = pixels.shape[:2]
    source, marks = image_source(_png(pixels)), ""
    for x, y, side in places.values():
        middle = 0.5 if side == 1 else 0.0
        at = f"left:{100 * (x + middle) / width:.3f}%;top:{100 * (y + middle) / height:.3f}%"
        if side > 1:
            at += f";width:{100 * side / width:.3f}%;height:{100 * side / height:.3f}%"
        marks += f'<i class="mark {"ring" if side == 1 else "square"}" style="{at}"></i>'
    return (
        f'<figure class="{kind}" style="--w:{width};--h:{height}">'
        f'<figcaption>{caption}</figcaption><div class="view"><div class="layer">'
        f'<img src="{source}" alt="{kind}" draggable="false">{marks}</div></div></figure>'
    )


def _legend(largest: float, encoding: Encoding) -> str:
    """Name the colours of the difference."""
    dark, bright = (f"rgb{color}" for color in (DARKER, BRIGHTER))
    end = f"{_number(largest)}{'' if encoding == 'linear' else ' of 255'}"
    return (
        "<b>difference</b> in the worst channel, B less A; the scale is linear below"
        f" {FLOORS[encoding]:g} and logarithmic above; violet where coverage alone changed"
        f'<span class="legend" style="background:linear-gradient(90deg,{dark},#000,{bright})">'
        f'</span><span class="ends"><span>-{end}</span><span>0</span><span>+{end}</span></span>'
    )


def _choices(name: str, values: Mapping[str, str]) -> str:
    """Offer values by name, the first chosen."""
    choices = "".join(
        f'<label><input type="radio" name="{name}-{INDEX}" value="{value}"'
        f"{'' if position else ' checked'}>{label}</label>"
        for position, (label, value) in enumerate(values.items())
    )
    return f"<fieldset><legend>{name}</legend>{choices}</fieldset>"


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def _percent(share: float) -> str:
    return f"{_number(100.0 * share)}&nbsp;%"


def _side(value: float) -> str:
    return "brighter" if value > 0.0 else "darker"
