"""The HTML report of a comparison: pairs, metrics with limits, and images."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from facerender.comparison import pictures
from facerender.comparison.compare import Pair
from facerender.comparison.result import BLUR, HOLES, SURE, Comparison
from facerender.comparison.sources import CHECKS
from facerender.comparison.windows import BLOCK
from facerender.errors import InputError, number_of
from facerender.images.image import Encoding, ImageData
from facerender.page import document, image_source, row, table
from facerender.system.files import write_bytes

VERDICTS = {1: "differs", 2: "error", 0: "same"}  # text of each status, in the order of the page
# Placeholder in the HTML of an entry; names do not contain this character.
INDEX = "\N{SYMBOL FOR UNIT SEPARATOR}"
OPEN = 10  # largest number of unfolded pairs, so that a page of hundreds opens quickly
MAP = 1 << 18  # largest number of pixels of a difference
Square = tuple[int, int, int]  # x, y and side in pixels
Squares = Mapping[str, Square]  # keyed by name
# Width of the enlarged area around a square, keyed by the width of the square, in pixels.
AROUND = {1: 17, BLOCK: 2 * BLOCK}


def entry(pair: Pair) -> dict[str, Any]:
    """Return name and status of a pair, and the HTML of its table row and of its section, in which
    INDEX stands for the entry's index. This data takes less memory than the pair's images."""
    verdict = VERDICTS[pair.status]
    mark = f'<span class="verdict">{verdict}</span>'
    result = pair.comparison
    reasons = (pair.error,) if result is None else result.reasons or (str(result),)
    name = escape(pair.name)
    link = f'<a href="#pair-{INDEX}">{name}</a>'
    summary = row(link, (mark, escape(reasons[0])), verdict)
    items = "".join(f"<li>{escape(reason)}</li>" for reason in reasons)
    checks = "" if result is None else _check_table(result)
    section = (
        f'<details class="{verdict}"><summary><h2>{name} {mark}</h2></summary>'
        f'<div id="pair-{INDEX}"><ul class="reasons">{items}</ul>{_images(pair)}'
        f'<div class="tables">{_properties(pair)}{checks}</div></div></details>'
    )
    return {"name": pair.name, "status": pair.status, "row": summary, "section": section}


def write_report(path: str | os.PathLike[str], entries: Sequence[Mapping[str, Any]]) -> None:
    """Write a self-contained page of all pairs; pairs that differ come first."""
    # The names of files may contain invalid UTF-8.
    write_bytes(path, _page(entries).encode(errors="backslashreplace"))


_NOTES = """
<svg width="0" height="0" aria-hidden="true"><filter id="thicken">
<feMorphology operator="dilate" radius="1"/></filter></svg>
<details><summary><h2>How to read this</h2></summary>
<dl class="note">
<dt>difference</dt>
<dd>B − A in the channel that differs most: orange where B is brighter, blue where B is darker,
violet where only the coverage changed. The largest difference has the full colour. In an image of
more than 512 × 512 pixels, each pixel of the difference shows the pixel that differs most in a cell
of the image; the enlarged places are exact.</dd>
<dt>A and B</dt>
<dd>Linear radiance 1 is white; the background is black; pixels that are not finite are magenta.
</dd>
<dt>FLIP</dt>
<dd>The difference that an observer sees when the images alternate, from black (none) to pale
yellow. The page contains it if <code>pip install 'facerender[measure]'</code> installed FLIP.</dd>
<dt>controls</dt>
<dd>X swaps A and B. Click on an image or on an enlarged place to enlarge all images there, move
with the arrow keys, and press Escape or click again to show the whole images.</dd>
</dl>
</details>"""


def _page(entries: Sequence[Mapping[str, Any]]) -> str:
    order = list(VERDICTS)
    ranked = sorted(entries, key=lambda entry: order.index(entry["status"]))
    counts = Counter(entry["status"] for entry in entries)
    words = {1: "differs" if counts[1] == 1 else "differ", 2: "not comparable", 0: "the same"}
    title = ", ".join(f"{counts[key]} {word}" for key, word in words.items() if counts[key])
    rows, sections = [], []
    for index, pair in enumerate(ranked):
        rows.append(pair["row"].replace(INDEX, str(index)))
        unfolded = int(index < OPEN and pair["status"] > 0)
        section = pair["section"].replace(INDEX, str(index))
        sections.append(section.replace("<details", "<details open", unfolded))
    summary = table("names", ("pair", "verdict", "reason"), rows) if len(ranked) > 1 else ""
    return document(f"Comparison: {title}", f"{summary}{''.join(sections)}{_NOTES}", "viewer.js")


def _check_table(result: Comparison) -> str:
    """Return a table of all checks: value and limit in one unit, and the meaning of the limit."""
    limits, factor = result.limits, result.limit_factor
    x, y = result.shift
    points = CHECKS["slivers"].amount(result.points, result.encoding)
    blocks = f"{result.blocks} of {number_of(result.blocks_judged, 'block')}"
    where = {
        name: f"{'brighter' if change > 0.0 else 'darker'} at {position}; {count} over"
        for name, change, position, count in (
            ("point", result.point, result.point_at, points),
            ("block", result.block, result.block_at, blocks),
        )
        if change
    }
    if max(abs(x), abs(y)) > 0.005:
        where["shift"] = f"{x:+.2f} to the right, {y:+.2f} down"
    rows = []
    for name, value, limit in (
        ("point", abs(result.point), limits.point),
        ("slivers", result.slight, int(result.sliver_limit)),
        ("holes", result.holes, HOLES),
        ("block", abs(result.block), limits.block),
        ("trend", max(result.trend, 0.0) * (result.z_score > SURE), factor * limits.trend),
        ("grain", result.grain, factor * limits.grain),
        ("texture", result.texture, factor * limits.texture),
        ("shift", max(abs(x), abs(y)), limits.shift),
        ("coverage", result.coverage, limits.coverage),
    ):
        if value < 0.0:
            value, limit, where[name] = -value, BLUR * limit, "less in B"
        check = CHECKS[name]
        figures = [check.amount(number, result.encoding) for number in (value, limit)]
        relation = (" &gt; " if value > limit else " ≤ ").join(figures)
        failed = value > limit and not result.same
        cells = [f'<span class="over">{relation}</span>' if failed else relation]
        amount = check.amount(limit, result.encoding, remark=True)
        cells += [where.get(name, ""), escape(f"The {check.quantity} may be at most {amount}.")]
        rows.append(row(name, cells, "changed" if failed else ""))
    return table("checks", ("check", "value and limit", "B is", "meaning of the limit"), rows)


def _available(pair: Pair) -> dict[str, ImageData]:
    return {key: image for key, image in (("A", pair.reference), ("B", pair.image)) if image}


def _properties(pair: Pair) -> str:
    """Return a table of the images' names and differing properties, and a folded one of others."""
    properties: dict[str, dict[str, str]] = {}
    for letter, image in _available(pair).items():
        height, width, channels = image.pixels.shape
        encoding = "linear" if image.encoding == "linear" else "8-bit sRGB"
        pixels = f"{width} × {height}, {number_of(channels, 'channel')}, {encoding}"
        properties[letter] = {"image": PurePath(image.name).name, "pixels": pixels}
        if image.color_space:
            properties[letter]["colour space"] = image.color_space
        if image.profile:
            properties[letter]["converted from"] = image.profile
        properties[letter] |= image.metadata
    if not properties:
        return ""
    unfolded: list[str] = []
    folded: list[str] = []
    for key in dict.fromkeys(key for values in properties.values() for key in values):
        values = [of_image.get(key, "–") for of_image in properties.values()]
        changed = len(set(values)) > 1
        mark = "changed" if changed and key != "image" else ""
        rows = unfolded if changed or key == "image" else folded
        rows.append(row(escape(key), map(escape, values), mark))
    head = "", *properties
    equal = "equal " * (len(properties) > 1)
    title = f"{len(folded)} {equal}propert{'y' if len(folded) == 1 else 'ies'}"
    details = f"<details><summary>{title}</summary>{table('facts', head, folded)}</details>"
    return f"<div>{table('facts', head, unfolded)}{details}</div>"


def _images(pair: Pair) -> str:
    """Return HTML of the available images and, if both were compared, their differences; of equal
    images, a small one."""
    images, result = _available(pair), pair.comparison
    if result and pair.reference:  # the images are the same
        source = _source(pictures.thumbnail(pair.reference, 160))
        text = "All pixels are equal."
        if result.largest:
            amount = CHECKS["point"].amount(result.largest, result.encoding)
            text = f"Largest difference of a pixel: {amount} at {result.largest_at}."
        return f"<p>{_image(source, 'the image')}</p><p>{text}</p>"
    if not images:
        return ""
    if max(image.pixels[..., 0].size for image in images.values()) > pictures.MAX_PIXELS:
        limit = pictures.MAX_PIXELS
        return f'<p class="note">Images of more than {limit} pixels are not shown.</p>'
    displayed = {key: pictures.displayed(image) for key, image in images.items()}
    squares, sources = _squares(pair), {key: _source(pixels) for key, pixels in displayed.items()}
    areas = ""
    if pair.reference and pair.image and result is not None:
        colors, largest = pictures.difference_colours(pair.reference, pair.image)
        shape = colors.shape
        maps = {"difference": _source(pictures.brightest(colors, MAP))}
        flip = ""
        with suppress(InputError):  # FLIP needs an optional package
            maps["FLIP"] = _source(pictures.small_heat_map(*displayed.values()))
            flip = '<label><input type="checkbox" class="flip">FLIP</label>'
        caption = _legend(largest, result.encoding, flip)
        figures = _figure("difference", caption, shape, maps, squares)
        figures += _figure("both", _SWAP, shape, sources, {})
        for name, square in squares.items():
            areas += _enlarged(name, square, {**displayed, "difference": colors})
        areas = f'<div class="places">{areas}</div>'
    else:
        figures = "".join(
            _figure("one", f"<b>{letter}</b>", pixels.shape, {letter: sources[letter]}, squares)
            for letter, pixels in displayed.items()
        )
    return (
        '<div class="viewer"><div class="stage" tabindex="0" role="group"'
        f' aria-label="images; arrow keys move the enlarged area">{figures}</div>{areas}</div>'
    )


_SWAP = (
    "<span><b>A</b> reference, <b>B</b> image</span>"
    '<button type="button" class="swap">swap: key <kbd>X</kbd></button>'
    '<input type="range" min="0" max="100" value="50" class="cut"'
    ' aria-label="border between A and B">'
)


def _squares(pair: Pair) -> Squares:
    """Return the marked squares."""
    squares = {}
    if (result := pair.comparison) is not None:
        if result.block:
            squares["worst block"] = (*result.block_at, BLOCK)
        if result.point:
            squares["worst pixel"] = (*result.point_at, 1)
        return squares
    for letter, image in _available(pair).items():
        if not np.isfinite(image.pixels).all():
            y, x, _ = np.argwhere(~np.isfinite(image.pixels))[0].tolist()
            squares[f"not finite in {letter}"] = (x, y, 1)
    return squares


def _enlarged(name: str, square: Square, images: Mapping[str, pictures.Bytes]) -> str:
    """Return a button that shows a square, cut out of each image, and enlarges the images there."""
    x, y, side = square
    crops = ""
    for label, pixels in images.items():
        size = [min(AROUND[side], extent) for extent in pixels.shape[:2]]
        centre = y + side // 2, x + side // 2
        top, left = (
            min(max(middle - length // 2, 0), extent - length)
            for middle, length, extent in zip(centre, size, pixels.shape, strict=False)
        )
        crop = np.ascontiguousarray(pixels[top : top + size[0], left : left + size[1]])
        mark = _mark((x - left, y - top, side), crop.shape, "square")
        crops += f'<span class="crop">{label}<span>{_image(_source(crop), "")}{mark}</span></span>'
    return (
        f'<button type="button" class="place" value="{x + side // 2},{y + side // 2}">'
        f"<b>{name}</b> at ({x},\N{NO-BREAK SPACE}{y})<span>{crops}</span></button>"
    )


def _figure(
    css_class: str, caption: str, shape: Sequence[int], images: Mapping[str, str], squares: Squares
) -> str:
    """Return a figure of images that lie on each other, keyed by their alternative text."""
    marks = "".join(
        _mark(square, shape, "ring" if square[2] == 1 else "square") for square in squares.values()
    )
    layers = "".join(
        f'<div class="sheet {name}"><div class="layer">{_image(source, name)}{marks}</div></div>'
        for name, source in images.items()
    )
    height, width = shape[:2]
    return (
        f'<figure class="{css_class}" style="--w:{width};--h:{height}">'
        f'<figcaption>{caption}</figcaption><div class="view">{layers}</div></figure>'
    )


def _mark(square: Square, shape: Sequence[int], css_class: str) -> str:
    """Return HTML that marks a square in an image of a shape."""
    x, y, side = square
    sides = x / shape[1], y / shape[0], side / shape[1], side / shape[0]
    style = "left:{:.4%};top:{:.4%};width:{:.4%};height:{:.4%}".format(*sides)
    return f'<i class="mark {css_class}" style="{style}"></i>'


def _image(source: str, alt: str) -> str:
    return f'<img src="{source}" alt="{alt}" loading="lazy" draggable="false">'


def _source(pixels: pictures.Bytes) -> str:
    return image_source(*pictures.lossless(pixels))


def _legend(largest: float, encoding: Encoding, flip: str) -> str:
    """Return the caption of the difference, with a legend of its colours and the HTML ``flip``."""
    floor = pictures.FLOORS[encoding]
    dark, bright = (f"rgb{color}" for color in (pictures.DARKER, pictures.BRIGHTER))
    end = CHECKS["point"].amount(max(largest, floor), encoding)
    return (
        f"<span><b>B − A</b> to ±{end}, logarithmic above {floor:g}</span>{flip}"
        f'<span class="legend" style="background:linear-gradient(90deg,{dark},#000,{bright})">'
        '</span><span class="ends"><span>darker</span><span>equal</span><span>brighter</span>'
        "</span>"
    )
