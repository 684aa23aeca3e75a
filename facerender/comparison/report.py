"""Pictures of a comparison: a heat map, and a page to look at.

Every picture is 8-bit sRGB, linear radiance 1 being white, over black where the coverage ends;
values that are not finite are magenta.
"""

from __future__ import annotations

import os
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.gates import BLOCK, Comparison, Pair
from facerender.errors import InputError
from facerender.image import Encoding, Picture, encode_srgb8, save_png, write_bytes

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


def _source(pixels: Bytes) -> str:
    """Return the pixels as the URL of a PNG."""
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return "data:image/png;base64," + b64encode(buffer.getvalue()).decode()


def _thumbnail(picture: Picture) -> str:
    from PIL import Image

    image = Image.fromarray(_shown(picture))
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    return f'<img class="thumbnail" src="{_source(np.asarray(image))}" alt="the image">'


_STYLE = """
:root { color-scheme: light dark; font: 1rem/1.5 system-ui, sans-serif;
  --line: color-mix(in srgb, CanvasText 18%, Canvas);
  --quiet: color-mix(in srgb, CanvasText 65%, Canvas);
  --panel: color-mix(in srgb, CanvasText 5%, Canvas);
  --differs: #b3261e; --error: #8a5a00; --same: #1b6e35; --changed: #fff1c9; }
@media (prefers-color-scheme: dark) {
  :root { --differs: #ff8a80; --error: #f2bd5b; --same: #7fd495; --changed: #4a3d12; } }
body { max-width: 92rem; margin: 0 auto; padding: 0 1rem 4rem; }
h1 { margin: 1.5rem 0 1rem; font-size: 1.6rem; line-height: 1.2; }
h2 { margin: 0; font-size: 1.2rem; line-height: 1.3; overflow-wrap: anywhere; }
section { margin-top: 2.5rem; padding-top: 1rem; border-top: 2px solid var(--line); }
p, dd, .reasons { max-width: 60rem; }
.reasons { margin: 0.5rem 0 1rem; padding-left: 1.2rem; overflow-wrap: anywhere; }
.verdict, .over { font-weight: 600; }
.differs .verdict, .over { color: var(--differs); }
.error .verdict { color: var(--error); }
.same .verdict { color: var(--same); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 1.5rem 0.25rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }
thead th { color: var(--quiet); font-weight: 600; }
tbody th { font-weight: normal; }
td { white-space: nowrap; }
.tables { display: flex; flex-wrap: wrap; gap: 1rem 4rem; margin-top: 1.5rem; }
.tables > * { max-width: 100%; min-width: 0; }
caption { padding-bottom: 0.25rem; text-align: left; font-weight: 600; }
.names tbody th { min-width: 7rem; overflow-wrap: anywhere; }
.gates td:last-child, .facts td { white-space: normal; }
.facts td { overflow-wrap: anywhere; }
.facts .changed > * { background: var(--changed); }
.facts :is(th, td) { padding-left: 0.4rem; }
small, figcaption, .note { color: var(--quiet); font-size: 0.85rem; }
section + details { margin-top: 2.5rem; border-top: 2px solid var(--line); }
details { border-bottom: 1px solid var(--line); padding: 0.35rem 0; }
details > div { scroll-margin-top: 2.5rem; }
summary { cursor: pointer; overflow-wrap: anywhere; }
.thumbnail { display: block; margin: 0.75rem 0; }
dt { font-weight: 600; }
dd { margin: 0 0 0.75rem; }

.controls { display: flex; flex-wrap: wrap; gap: 0.5rem 1.5rem; align-items: center;
  margin: 0 0 0.75rem; padding: 0.5rem 0.75rem; background: var(--panel); font-size: 0.9rem; }
fieldset { display: flex; flex-wrap: wrap; gap: 0.1rem 0.9rem; margin: 0; padding: 0; border: 0; }
legend { float: left; margin-right: 0.9rem; padding: 0; color: var(--quiet); }
label { display: inline-flex; gap: 0.3rem; align-items: center; white-space: nowrap; }
input { margin: 0; accent-color: currentColor; }
.cut input { width: min(16rem, 45vw); }
.stage { display: grid; gap: 1rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 18rem), 1fr)); }
figure { min-width: 0; width: min(100%, 85vh * var(--w) / var(--h)); margin: 0; }
figcaption { min-height: 1.5em; }
figcaption b { color: CanvasText; }
.view { position: relative; overflow: hidden; aspect-ratio: var(--w) / var(--h); background: #000;
  cursor: zoom-in; touch-action: pan-y; user-select: none; }
.layer { position: absolute; width: calc(100% * var(--z, 1)); height: calc(100% * var(--z, 1));
  left: calc(50% - 100% * var(--z, 1) * var(--x, 0.5));
  top: calc(50% - 100% * var(--z, 1) * var(--y, 0.5)); }
.layer img { display: block; width: 100%; height: 100%; }
.enlarged .view { cursor: zoom-out; }
.enlarged img { image-rendering: pixelated; }
.mark { position: absolute; box-sizing: border-box; border: 2px solid #7dff5a;
  outline: 1px solid #000; box-shadow: inset 0 0 0 1px #000; pointer-events: none; }
.ring { width: 2rem; height: 2rem; margin: -1rem; border-radius: 50%; }
.legend { display: block; width: 100%; height: 0.6rem; margin: 0.4rem 0 0.1rem; }
.ends { display: flex; justify-content: space-between; }
.viewer:not(:has(.marks:checked)) .mark { display: none; }
.difference, .viewer:not(:has([value=blink]:checked)) .blinking,
.viewer:not(:has([value=slider]:checked)) .cut { display: none; }
.viewer:is(:has([value=blink]:checked), :has([value=slider]:checked)) {
  & .stage { grid-template-columns: 1fr; }
  & figure { grid-area: 1 / 1; justify-self: center; }
  & .heat { display: none; } }
.viewer:has([value=blink]:checked) {
  &.swapped .a, &:not(.swapped) .b { visibility: hidden; } }
.viewer:has([value=slider]:checked) {
  & .b figcaption { text-align: right; }
  & .b .view { clip-path: inset(0 0 0 calc(1% * var(--cut, 50))); }
  & .b .view::after { content: ""; position: absolute; inset: 0 auto 0 calc(1% * var(--cut, 50));
    width: 2px; background: #fff; border-right: 1px solid #000; } }
.viewer:has([value=difference]:checked) {
  & .stage { grid-template-columns: 1fr; }
  & figure { justify-self: center; }
  & :is(.a, .b, .heat) { display: none; }
  & .difference { display: block; } }
@media (max-width: 40rem) {
  h1 { font-size: 1.3rem; }
  th, td { padding-right: 0.7rem; font-size: 0.8rem; }
  td { white-space: normal; }
  .names tbody th { min-width: 5rem; }
  legend { float: none; width: 100%; } }
"""

_SCRIPT = """
const PIXEL = 8;  // least size of an enlarged pixel
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
for (const viewer of document.querySelectorAll(".viewer")) {
  const find = selector => viewer.querySelector(selector);
  const figures = [...viewer.querySelectorAll("figure")];
  const choices = viewer.querySelectorAll("[name^=zoom]");
  const number = (figure, name) => +figure.style.getPropertyValue(name);
  let centre = null;  // of what is enlarged, in pixels

  function draw() {
    viewer.classList.toggle("enlarged", centre !== null);
    for (const figure of figures) {
      const layer = figure.querySelector(".layer");
      const fit = layer.parentElement.clientWidth / number(figure, "--w");
      const zoom = centre && fit ? Math.max(PIXEL, 2 * fit) / fit : 1;
      ["--w", "--h"].forEach((side, axis) => {
        const at = centre ? (centre[axis] + 0.5) / number(figure, side) : 0.5;
        const inside = Math.min(Math.max(at, 0.5 / zoom), 1 - 0.5 / zoom);
        layer.style.setProperty(axis ? "--y" : "--x", inside);
      });
      layer.style.setProperty("--z", zoom);
    }
  }

  function look(at) {
    centre = at;
    for (const choice of choices) choice.checked = !at && !choice.value;
    draw();
  }

  function cut(percent) {
    find(".cut input").value = percent;
    find(".stage").style.setProperty("--cut", percent);
  }

  const swap = () => viewer.classList.toggle("swapped");
  const shows = mode => find(`[value=${mode}]:checked`);
  const across = (event, element) => {
    const box = element.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };

  viewer.addEventListener("change", ({target}) => {
    const {name, value} = target;
    if (name.startsWith("zoom")) centre = value ? value.split(",").map(Number) : null;
    draw();
  });
  addEventListener("resize", draw);

  let pressed = 0;
  for (const figure of figures) {
    const view = figure.querySelector(".view");
    view.addEventListener("pointerdown", event => { pressed = event.clientX; });
    view.addEventListener("pointermove", event => {
      if (shows("slider")) cut(100 * across(event, view)[0]);
    });
    view.addEventListener("click", event => {
      if (Math.abs(event.clientX - pressed) > 4) return;  // a drag
      if (centre) return look(null);
      const [x, y] = across(event, figure.querySelector(".layer"));
      look([Math.floor(x * number(figure, "--w")), Math.floor(y * number(figure, "--h"))]);
    });
  }
  const steps = {ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4]};
  find(".stage").addEventListener("keydown", event => {
    const step = steps[event.key];
    if (!step || !centre) return;
    event.preventDefault();
    const limits = ["--w", "--h"].map(side => number(figures[0], side) - 1);
    look(centre.map((at, axis) => Math.min(Math.max(at + step[axis], 0), limits[axis])));
  });

  if (find(".cut")) {
    find(".cut input").addEventListener("input", ({target}) => cut(target.value));
    find(".run").checked = !still;
    find(".swap").addEventListener("click", () => { find(".run").checked = false; swap(); });
    setInterval(() => { if (shows("blink") && find(".run").checked) swap(); }, 600);
  }
}
"""

_NOTES = """
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
"""

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
    summary = _table("names", ("pair", "verdict", "point", "block", "coverage"), rows)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>Comparison: {title}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>Comparison: {title}</h1>
<div class="wide">{summary}</div>
{"".join(sections)}
<section>
<h2>How to read this</h2>
{_NOTES}</section>
<script>{_SCRIPT}</script>
</body>
</html>
"""


def _row(pair: Pair) -> str:
    verdict = VERDICTS[pair.status]
    gates = _gates(pair.comparison) if pair.comparison else ()
    cells = [f"<td{gate.marked}>{gate.relation}</td>" for gate in gates] or ["<td>–</td>"] * 3
    name = f'<a href="#pair-{INDEX}">{escape(pair.name)}</a>'
    return (
        f'<tr class="{verdict}"><th scope="row">{name}</th><td class="verdict">{verdict}</td>'
        f"{''.join(cells)}</tr>"
    )


def _section(pair: Pair) -> str:
    verdict = VERDICTS[pair.status]
    title = f'{escape(pair.name)} <span class="verdict">{verdict}</span>'
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
        f'<section id="pair-{INDEX}" class="{verdict}"><h2>{title}</h2>'
        f'<ul class="reasons">{said}</ul>{_viewer(pair)}{tables}</section>'
    )


@dataclass(frozen=True)
class _Gate:
    name: str
    figure: str
    limit: str
    over: bool
    where: str = ""

    @property
    def marked(self) -> str:
        return ' class="over"' if self.over else ""

    @property
    def relation(self) -> str:
        return f"{self.figure} {'&gt;' if self.over else '≤'}&nbsp;{self.limit}"


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
    rows = [
        f'<tr><th scope="row">{gate.name}</th><td{gate.marked}>{gate.relation}</td>'
        f"<td>{gate.where}</td></tr>"
        for gate in _gates(result)
    ]
    for name, value in (("largest difference", result.largest), ("mean difference", result.mean)):
        rows.append(f'<tr><th scope="row">{name}</th><td>{_number(value)}</td><td></td></tr>')
    unit = "radiance" if result.encoding == "linear" else "steps of 255"
    table = _table("gates", ("gate", "figure and limit", "B is"), rows, f"Figures, in {unit}")
    return f'<div class="wide">{table}</div>'


def _facts(pair: Pair) -> str:
    """Lay out what the images are and what drew them, rows that differ marked."""
    pictures = {"A": pair.reference, "B": pair.image}
    facts = {name: _fact(picture) for name, picture in pictures.items() if picture}
    rows = []
    for key in dict.fromkeys(key for fact in facts.values() for key in fact):
        values = [fact.get(key, "") for fact in facts.values()]
        changed = ' class="changed"' if len(set(values)) > 1 and key != "image" else ""
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        rows.append(f'<tr{changed}><th scope="row">{escape(key)}</th>{cells}</tr>')
    return _table("facts", ("", *facts), rows, "Images, and what drew them") if facts else ""


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
    marks = ""
    for x, y, side in places.values():
        middle = 0.5 if side == 1 else 0.0
        at = f"left:{100 * (x + middle) / width:.3f}%;top:{100 * (y + middle) / height:.3f}%"
        if side > 1:
            at += f";width:{100 * side / width:.3f}%;height:{100 * side / height:.3f}%"
        marks += f'<i class="mark {"ring" if side == 1 else "square"}" style="{at}"></i>'
    return (
        f'<figure class="{kind}" style="--w:{width};--h:{height}">'
        f'<figcaption>{caption}</figcaption><div class="view"><div class="layer">'
        f'<img src="{_source(pixels)}" alt="{kind}" draggable="false">{marks}</div></div></figure>'
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


def _table(kind: str, head: Iterable[str], rows: Iterable[str], caption: str = "") -> str:
    cells = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    title = f"<caption>{caption}</caption>" if caption else ""
    return (
        f'<table class="{kind}">{title}<thead><tr>{cells}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def _percent(share: float) -> str:
    return f"{_number(100.0 * share)}&nbsp;%"


def _side(value: float) -> str:
    return "brighter" if value > 0.0 else "darker"
