"""The HTML report of a comparison: pairs, metrics with limits, and images."""

from __future__ import annotations

import os
from base64 import b64decode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import NamedTuple

import numpy as np

from facerender.comparison import visualization
from facerender.comparison.blocks import BLOCK
from facerender.comparison.compare import Pair
from facerender.comparison.result import BLUR, SURE, Comparison
from facerender.errors import InputError
from facerender.images.image import Encoding, ImageData
from facerender.page.document import document, image_source, row, table
from facerender.system.atomic import write_bytes

VERDICTS = {1: "differs", 2: "error", 0: "same"}  # text of each status, in the order of the page
# Placeholders in the HTML of an entry; names do not contain these characters.
INDEX = "\N{SYMBOL FOR UNIT SEPARATOR}"
IMAGE = "\N{SYMBOL FOR RECORD SEPARATOR}"
THUMBNAIL = 160  # largest width and height in pixels
EXACT = 25_000_000  # characters of a page; in longer pages, the largest images are compressed
EXACT_SIDE = 64  # pixels per side of the exact area around a place in a compressed image
CHECKS = ("point", "slivers", "block", "trend", "grain", "texture", "shift", "coverage")
MODES = ("side by side", "blink", "slider", "difference")


@dataclass(frozen=True)
class Entry:
    """A pair as text, which takes less memory than its images and can be sent between processes.

    Attributes
    ----------
    name, status : name and status of the pair
    row : HTML of the pair's table row; the placeholder INDEX stands for the entry's index
    section : HTML of the pair's section, also with INDEX. IMAGE and a letter stand for the image of
        that letter; IMAGE alone stands for "exact" or "compressed"
    images : images A and B as data URLs, keyed by "a" and "b"
    places : x and y of the places around which compressed images stay exact
    """

    name: str
    status: int
    row: str
    section: str
    images: Mapping[str, str] = field(default_factory=dict)
    places: Sequence[Sequence[int]] = ()


def entry(pair: Pair) -> Entry:
    """Return the entry of a pair."""
    sources = {"a": pair.reference, "b": pair.image} if pair.status else {}
    images = {key: image for key, image in sources.items() if image}
    most = max((image.pixels[..., 0].size for image in images.values()), default=0)
    large = most > visualization.MAX_PIXELS
    displayed = {} if large else {k: visualization.displayed(x) for k, x in images.items()}
    return Entry(
        name=pair.name,
        status=pair.status,
        row=_row(pair),
        section=_section(pair, displayed, large),
        images={key: _source(pixels) for key, pixels in displayed.items()},
        places=[_centre(place) for place in _places(pair).values()] if displayed else [],
    )


def write_report(path: str | os.PathLike[str], entries: Sequence[Entry]) -> None:
    """Write a self-contained page of all pairs; pairs that differ come first.

    Raises
    ------
    InputError : the file cannot be written
    """
    # The names of files may contain invalid UTF-8.
    write_bytes(path, _page(entries).encode(errors="backslashreplace"))


_NOTES = """
<section>
<h2>How to read this</h2>
<dl class="note">
<dt>point</dt>
<dd>The largest difference of a pixel from the range of its neighbourhood in the other image. The
check detects fireflies and missing pixels. It passes edges that moved by a fraction of a pixel.
</dd>
<dt>slivers</dt>
<dd>The number of pixels over the point limit, including pixels at edges, where thin slivers of
light and shade may appear or vanish.</dd>
<dt>block</dt>
<dd>The largest change of a block's mean (16 × 16 covered pixels), without the effect of a shift of
the whole image. In linear images, the change is divided by the mean. The check detects a changed
lobe or specular weight; noise averages out.</dd>
<dt>trend</dt>
<dd>How much neighbouring blocks changed in the same direction, even if each block is within the
block limit; 0 if chance may explain the changes.</dd>
<dt>grain</dt>
<dd>How much more or less noise between adjacent pixels B has than A.</dd>
<dt>texture</dt>
<dd>How much more or less fine detail B has than A.</dd>
<dt>shift</dt>
<dd>The displacement of B from A, in pixels to the right and down.</dd>
<dt>coverage</dt>
<dd>The fraction of the pixels whose coverage (alpha channel) changed.</dd>
<dt>heat map</dt>
<dd>FLIP: the difference that an observer sees when the images alternate, from black (none) to
pale yellow. For a large image, each pixel of the map shows the pixel that differs most in a cell of
the image.</dd>
<dt>images</dt>
<dd>Linear radiance 1 is white; the background is black; pixels that are not finite are magenta.
Click on an image to enlarge a place, move it with the arrow keys, and click again to show the whole
image. In a page of very many pairs, A and B may be compressed, as their captions state. Compressed
images are exact around the marks only. The image of the difference is always exact.</dd>
</dl>
</section>"""

_MOTION = """<label class="cut">split <input type="range" min="0" max="100" value="50"></label>
<label class="blinking"><input type="checkbox" class="run">run</label>
<button class="blinking swap" type="button">swap</button>"""


def _page(entries: Sequence[Entry]) -> str:
    order = list(VERDICTS)
    ranked = sorted(entries, key=lambda entry: order.index(entry.status))
    counts = Counter(entry.status for entry in entries)
    words = {1: "differs" if counts[1] == 1 else "differ", 2: "not comparable", 0: "the same"}
    title = ", ".join(f"{counts[key]} {word}" for key, word in words.items() if counts[key])
    rows = (entry.row.replace(INDEX, str(number)) for number, entry in enumerate(ranked))
    compressed = _to_compress(ranked)
    sections = (
        _with_images(entry, number in compressed).replace(INDEX, str(number))
        for number, entry in enumerate(ranked)
    )
    summary = table("names", ("pair", "verdict", *CHECKS), rows)
    body = f"{summary}{''.join(sections)}{_NOTES}"
    return document(f"Comparison: {title}", body, "viewer.js")


def _to_compress(entries: Sequence[Entry]) -> set[int]:
    """Return the indices of the entries whose images are compressed.

    The entries with the largest images are chosen, until the rest has at most EXACT characters.
    """
    sizes = [sum(map(len, entry.images.values())) for entry in entries]
    left = sum(sizes) + sum(len(entry.section) for entry in entries)
    chosen = set()
    for number in sorted(range(len(entries)), key=lambda number: -sizes[number]):
        if left <= EXACT:
            break
        chosen.add(number)
        left -= sizes[number]
    return chosen


def _with_images(entry: Entry, compressed: bool) -> str:
    """Return an entry's section, with the images A and B filled in."""
    section = entry.section
    for letter, source in entry.images.items():
        images = _compressed(source, letter, entry.places) if compressed else _image(source, letter)
        section = section.replace(IMAGE + letter, images)
    return section.replace(IMAGE, "compressed" if compressed else "exact")


def _compressed(source: str, letter: str, places: Iterable[Sequence[int]]) -> str:
    """Return HTML of a lossily compressed image, covered by exact crops around the places."""
    pixels = visualization.decoded(b64decode(source.partition(",")[2]))
    height, width = pixels.shape[:2]
    images = _image(image_source(visualization.lossy(pixels), "webp"), letter)
    for x, y in places:
        left, top = max(x - EXACT_SIDE // 2, 0), max(y - EXACT_SIDE // 2, 0)
        crop = pixels[top : top + EXACT_SIDE, left : left + EXACT_SIDE]
        down, across = crop.shape[:2]
        style = _box(left / width, top / height, across / width, down / height)
        images += f'<img class="near" style="{style}" src="{_source(crop)}" alt="">'
    return images


def _row(pair: Pair) -> str:
    checks = () if pair.comparison is None else _checks(pair.comparison)
    figures = [check.relation if check.failed else check.metric for check in checks]
    figures = figures or ["–"] * len(CHECKS)
    name = f'<a href="#pair-{INDEX}">{escape(pair.name)}</a>'
    return row(name, [_verdict(pair), *figures], VERDICTS[pair.status])


def _section(pair: Pair, displayed: Mapping[str, visualization.Bytes], large: bool) -> str:
    title = f"{escape(pair.name)} {_verdict(pair)}"
    checks = "" if pair.comparison is None else _check_table(pair.comparison)
    tables = f'<div class="tables">{checks}{_facts(pair)}</div>'
    if pair.status == 0 and pair.reference:
        source = _source(visualization.thumbnail(pair.reference, THUMBNAIL))
        return (
            f'<details class="same"><summary>{title}</summary><div id="pair-{INDEX}">'
            f'<img class="thumbnail" src="{source}" alt="the image">{tables}</div></details>'
        )
    reasons = (pair.error,) if pair.comparison is None else pair.comparison.reasons
    items = "".join(f"<li>{escape(reason)}</li>" for reason in reasons)
    return (
        f'<section id="pair-{INDEX}" class="{VERDICTS[pair.status]}"><h2>{title}</h2>'
        f'<ul class="reasons">{items}</ul>{_viewer(pair, displayed, large)}{tables}</section>'
    )


def _verdict(pair: Pair) -> str:
    return f'<span class="verdict">{VERDICTS[pair.status]}</span>'


class _Check(NamedTuple):
    name: str
    metric: str
    limit: str
    failed: bool
    where: str = ""

    @property
    def relation(self) -> str:
        if self.failed:
            return f'<span class="over">{self.metric} &gt;&nbsp;{self.limit}</span>'
        return f"{self.metric} ≤&nbsp;{self.limit}"


def _checks(result: Comparison) -> list[_Check]:
    limits, factor = result.limits, result.limit_factor
    amount = _percent if result.encoding == "linear" else _number
    point, block, slight = result.point, result.block, result.slight
    over = f"{result.points} over", f"{result.blocks} of {result.blocks_judged} over"
    at = "at ({}, {}); ".format(*result.point_at), "from ({}, {}); ".format(*result.block_at)
    where = [
        f"{'brighter' if each > 0.0 else 'darker'} {place}{count}" if each else ""
        for each, place, count in zip((point, block), at, over, strict=True)
    ]
    most = result.sliver_limit
    trend = max(result.trend, 0.0) if result.z_score > SURE else 0.0
    x, y = result.shift
    checks = [
        _Check("point", _number(abs(point)), _number(limits.point), result.points > 0, where[0]),
        _Check("slivers", str(slight), _number(most), slight > most),
        _Check("block", amount(abs(block)), amount(limits.block), result.blocks > 0, where[1]),
    ]
    for name, value, limit, text in (
        ("trend", trend, factor * limits.trend, _number),
        ("grain", result.grain, factor * limits.grain, amount),
        ("texture", result.texture, factor * limits.texture, _percent),
        ("shift", max(abs(x), abs(y)), limits.shift, _number),
        ("coverage", result.coverage, limits.coverage, _percent),
    ):
        less = f"at ({x:.2f}, {y:.2f})" if name == "shift" else ""
        if value < 0.0:
            limit, less = BLUR * limit, "less"
        checks.append(_Check(name, text(abs(value)), text(limit), abs(value) > limit, less))
    return checks


def _check_table(result: Comparison) -> str:
    rows = [row(check.name, [check.relation, check.where]) for check in _checks(result)]
    rows.append(row("largest difference", [_number(result.largest), ""]))
    rows.append(row("mean difference", [_number(result.mean), ""]))
    unit = "radiance" if result.encoding == "linear" else "8-bit levels"
    return table("checks", ("check", "metric and limit", "B is"), rows, f"Metrics, in {unit}")


def _facts(pair: Pair) -> str:
    """Return a table of the images' properties and metadata; rows that differ are marked."""
    images = {"A": pair.reference, "B": pair.image}
    facts = {name: _fact(image) for name, image in images.items() if image}
    rows = []
    for key in dict.fromkeys(key for fact in facts.values() for key in fact):
        values = [fact.get(key, "") for fact in facts.values()]
        changed = "changed" if len(set(values)) > 1 and key != "image" else ""
        rows.append(row(escape(key), map(escape, values), changed))
    return table("facts", ("", *facts), rows, "Images and their metadata") if facts else ""


def _fact(image: ImageData) -> dict[str, str]:
    height, width, channels = image.pixels.shape
    kind = "linear" if image.encoding == "linear" else "8-bit sRGB"
    space = {"colour space": image.color_space} if image.color_space else {}
    pixels = f"{width} × {height}, {channels} channel{'s' * (channels > 1)}, {kind}"
    converted = {"converted from": image.profile} if image.profile else {}
    return {"image": image.name, "pixels": pixels, **space, **converted, **image.metadata}


def _viewer(pair: Pair, displayed: Mapping[str, visualization.Bytes], large: bool) -> str:
    """Return HTML of the available images and, if both were compared, their differences."""
    if large:
        most = visualization.MAX_PIXELS
        return f'<p class="note">Images of more than {most} pixels are not shown.</p>'
    places = _places(pair)
    captions = {"a": "<b>A</b> reference", "b": "<b>B</b> image"}
    figures = [
        _figure(kind, captions[kind], pixels.shape, IMAGE + kind, places)
        for kind, pixels in displayed.items()
    ]
    if not figures:
        return ""
    controls = ""
    if pair.reference and pair.image and pair.comparison is not None:
        controls = _choices("view", {mode: mode for mode in MODES})
        shape = displayed["a"].shape
        try:
            heat = _image(
                _source(visualization.small_heat_map(displayed["a"], displayed["b"])), "heat"
            )
            figures.append(_figure("heat", "<b>heat map</b> of FLIP", shape, heat, places))
        except InputError as error:
            figures.append(f'<p class="heat note">{escape(str(error))}</p>')
        apart, largest = visualization.difference(pair.reference, pair.image)
        encoding = pair.comparison.encoding
        caption = _legend(max(largest, visualization.FLOORS[encoding]), encoding)
        difference = _image(_source(apart), "difference")
        figures.append(_figure("difference", caption, shape, difference, places))
    centres = {name: "{},{}".format(*_centre(place)) for name, place in places.items()}
    if places:
        controls += _choices("zoom", {"whole": "", **centres})
        controls += '<label><input type="checkbox" class="marks" checked>marks</label>'
    if pair.comparison is not None:
        controls += _MOTION
    if controls:
        controls = f'<div class="controls">{controls}</div>'
    return (
        f'<div class="viewer {IMAGE}">{controls}'
        '<div class="stage" tabindex="0" role="group" aria-label="images; arrow keys move the'
        f' enlarged area">{"".join(figures)}</div></div>'
    )


def _places(pair: Pair) -> dict[str, tuple[int, int, int]]:
    """Return x, y and side in pixels of the marked places, keyed by the place's name."""
    places = {}
    if (result := pair.comparison) is not None:
        if result.point:
            places["worst pixel"] = (*result.point_at, 1)
        if result.block:
            places["worst block"] = (*result.block_at, BLOCK)
        return places
    for letter, image in (("A", pair.reference), ("B", pair.image)):
        if image is not None and not np.isfinite(image.pixels).all():
            y, x, _ = np.argwhere(~np.isfinite(image.pixels))[0].tolist()
            places[f"not finite in {letter}"] = (x, y, 1)
    return places


def _centre(place: tuple[int, int, int]) -> tuple[int, int]:
    x, y, side = place
    return x + side // 2, y + side // 2


def _figure(
    kind: str,
    caption: str,
    shape: Sequence[int],
    images: str,
    places: Mapping[str, tuple[int, int, int]],
) -> str:
    height, width = shape[:2]
    marks = ""
    for x, y, side in places.values():
        if side == 1:
            box = _box((x + 0.5) / width, (y + 0.5) / height)
        else:
            box = _box(x / width, y / height, side / width, side / height)
        marks += f'<i class="mark {"ring" if side == 1 else "square"}" style="{box}"></i>'
    return (
        f'<figure class="{kind}" style="--w:{width};--h:{height}">'
        f'<figcaption>{caption}</figcaption><div class="view"><div class="layer">'
        f"{images}{marks}</div></div></figure>"
    )


def _box(*fractions: float) -> str:
    """Return CSS for left, top and optionally width and height, given as image fractions."""
    names = ("left", "top", "width", "height")
    return ";".join(
        f"{name}:{100 * each:.4f}%" for name, each in zip(names, fractions, strict=False)
    )


def _image(source: str, alt: str) -> str:
    return f'<img src="{source}" alt="{alt}" draggable="false">'


def _source(pixels: visualization.Bytes) -> str:
    return image_source(*visualization.lossless(pixels))


def _legend(largest: float, encoding: Encoding) -> str:
    """Return the caption of the difference, with a legend of its colours."""
    dark, bright = (f"rgb{color}" for color in (visualization.DARKER, visualization.BRIGHTER))
    end = f"{_number(largest)}{'' if encoding == 'linear' else ' of 255'}"
    return (
        "<b>difference</b> B − A in the worst channel; the scale is linear below"
        f" {visualization.FLOORS[encoding]:g} and logarithmic above; violet where only the coverage"
        " changed"
        f'<span class="legend" style="background:linear-gradient(90deg,{dark},#000,{bright})">'
        f'</span><span class="ends"><span>-{end}</span><span>0</span><span>+{end}</span></span>'
    )


def _choices(name: str, values: Mapping[str, str]) -> str:
    """Return radio buttons for values, keyed by their labels; the first button is checked."""
    choices = "".join(
        f'<label><input type="radio" name="{name}-{INDEX}" value="{value}"'
        f"{'' if position else ' checked'}>{label}</label>"
        for position, (label, value) in enumerate(values.items())
    )
    return f"<fieldset><legend>{name}</legend>{choices}</fieldset>"


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def _percent(fraction: float) -> str:
    return f"{_number(100.0 * fraction)}&nbsp;%"
