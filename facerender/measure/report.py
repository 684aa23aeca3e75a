"""Writes a measurement to files: ``measure.json``, images as PNG, and the page ``index.html``.

``tables.py`` makes sentences and tables, ``chart.py`` draws.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from facerender.measure import chart
from facerender.measure.measurement import MAGNIFIED, MODELS, Measurement, Triptych
from facerender.measure.pareto import EXACT, FRAME, TERM, CostKind, measure_of, pareto, recommended
from facerender.measure.tables import (
    ERRORS,
    NOT_MEASURED,
    Table,
    advice,
    cost_tables,
    error_tables,
    frame_advice,
    recommendation_table,
    tables_of,
)
from facerender.page.document import document, figure, row
from facerender.page.document import table as page_table
from facerender.system.atomic import make_folder, write_bytes

METHODS = {
    "specular term": "The time of one evaluation of the whole term from the normal N, the"
    " direction L to the light and the direction V to the camera, on all cores or GPU units"
    " together: the slope of the time over the number of evaluations, minus the slope of an empty"
    " loop. If the CPU draws, processor time divided by the number of cores is measured. The"
    " terms are timed in turns. The value is the lower quartile of the repeats, with a 95 %"
    " bootstrap interval. The lobe alone is measured in the same way.",
    "whole frame": "The time to draw the mesh with one sample per pixel and to read the image"
    " back. The variants are timed in turns. The value is the lower quartile of the repeats, with"
    " a 95 % interval.",
    "error of the lobe": "The largest difference from the exact lobe in percent of the lobe's"
    " peak, for angles γ of 0 to 90 degrees between N and the half vector, which is halfway"
    " between L and V. Both lobes are computed in float64.",
    "error of the BRDF": "The BRDF f is the fraction of light that is reflected from L to V, per"
    " solid angle. The error is the largest difference from the exact f N.L over all L and V, in"
    " percent of the largest exact f N.L. Both are computed in float64.",
    "error of the image": "The OpenGL image is compared with float64 shading of the same G-buffer"
    " with the exact lobe, at covered pixels. Errors of linear radiance are in percent of"
    " max(exact radiance, 0.01). Levels are 1/255 of the range of the displayed 8-bit image."
    " Blocks are means over 16 x 16 pixels. The error beyond 3 x 3 neighbours is the distance of"
    " a pixel from the range of these pixels in the other image, in radiance (white is 1). FLIP"
    " is a perceptual difference between 0 and 1 (Andersson et al. 2020).",
}
INTRODUCTION = (
    "The specular term computes the highlight of a light at a point of the surface. The model is"
    " the whole formula, Cook-Torrance or Ward. Its lobe gives the highlight its shape: the exact"
    " lobe is an exponential function, the other lobes approximate it. A variant is a form of a"
    " model's term; its cost is the time of one evaluation, for one light at one point. The"
    " roughness m is the root mean square (RMS) slope of the skin's microfacets. Other parts,"
    " such as eyes, keep their own m; the error of the image includes them."
)
DOMINATED = (
    "In the charts, lower left is better: filled points are the best variants, hollow points are"
    " dominated, horizontal bars are 95 % intervals of the cost. "
    "Dominated: another variant of the model is at least as cheap and as exact, and better in cost"
    " or error. Costs with overlapping intervals count as equal. Errors up to"
    f" {EXACT:g} % count as zero, because float32 causes errors of this size. Forms as published"
    " return NaN in some directions, and dominate no other variant; D16 as published has no clamp."
)

JSON, PAGE = "measure.json", "index.html"


def write(measurement: Measurement, triptychs: Sequence[Triptych], directory: Path) -> list[Path]:
    """Write measure.json, images and index.html atomically, and return their paths.

    All images are encoded before the first file is written. A missing directory is created.

    Raises
    ------
    InputError : the directory is not writable
    ValueError : the measurement contains NaN or infinity, which JSON cannot represent
    """
    text = json.dumps(content(measurement), indent=1, allow_nan=False) + "\n"
    images, captions = {}, []
    for triptych in triptychs:
        model, lobe = triptych.model, triptych.lobe
        images[f"images-{model}-{lobe}.png"] = _png(triptych)
        captions.append(
            f"{MODELS[model]}, m = {measurement.settings.slope}: exact (left), {lobe} (middle), and"
            f" {MAGNIFIED} times their difference (right)."
        )
    page = _page(measurement, map(figure, images.values(), captions))
    return write_files(directory, {JSON: text.encode(), **images, PAGE: page.encode()})


def content(measurement: Measurement) -> dict[str, Any]:
    """Return the content of measure.json: the measurement and the recommended variants."""
    best = [
        {
            **{name: getattr(row.variant, name) for name in ("model", "name", "lobe")},
            "limits": list(limits),
            "error": row.error,
        }
        for model in measurement.models
        for limits, row in recommended(measurement, model)
    ]
    return {"recommended": best, **measurement.as_dict()}


def write_files(directory: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write files, keyed by file name, atomically to a directory, and return their paths.

    A missing directory is created.

    Raises
    ------
    InputError : the directory cannot be created, or is not writable
    """
    make_folder(directory)
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def table(measurement: Measurement) -> str:
    """Return tables of cost and error as text for a terminal.

    The recommended variants come first. There is one table for each combination of model and kind
    of cost.
    """
    models = measurement.models
    sentences = [say(measurement, model) for say in (advice, frame_advice) for model in models]
    tables = [*(recommendation_table(measurement, model) for model in models)]
    tables += cost_tables(measurement)
    return "\n\n".join(["\n".join(filter(None, sentences)), *(table.text() for table in tables)])


def _png(triptych: Triptych) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    pixels = np.hstack([triptych.exact, triptych.image, triptych.difference])
    Image.fromarray(pixels).save(file, "PNG", optimize=True)
    return file.getvalue()


def _page(measurement: Measurement, figures: Iterable[str]) -> str:
    """Return the page: one self-contained HTML file."""
    models, slope = measurement.models, measurement.settings.slope
    frames = " ".join(frame_advice(measurement, model) for model in models)
    missing = "".join(f"<li>{escape(text)}</li>" for text in measurement.not_measured)
    machine = f"{measurement.settings.mesh} on {measurement.environment['GL_RENDERER']}"
    body = [
        f'<p class="note">{escape(machine)}</p>',
        _trades(measurement, TERM),
        f"<p>{escape(frames)}</p>" * bool(frames),
        f"<p>{escape(INTRODUCTION)}</p>",
        f'<p class="note">{escape(DOMINATED)}</p>',
        *(_html(recommendation_table(measurement, model), "numbers costs") for model in models),
        *(_html(table, "numbers costs") for table in tables_of(measurement, TERM)),
        _folded(
            "Cost of a whole frame",
            _trades(measurement, FRAME),
            *(_html(table, "numbers costs") for table in tables_of(measurement, FRAME)),
        ),
        _folded(
            f"Errors of the image at m = {slope}, and of lobe and BRDF at other m",
            *(_html(table, "numbers") for table in error_tables(measurement)),
        ),
        _folded(f"Images at m = {slope}", *figures),
        _folded(
            "How the values are measured",
            "<dl>",
            *(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in METHODS.items()),
            "</dl>",
        ),
        f"<h2>Not measured</h2><ul>{missing}</ul>" * bool(missing),
        "<h2>Machine and settings</h2>",
        page_table("facts", (), _facts(measurement)),
    ]
    return document(f"Cost and error at m = {slope}", "\n".join(body), chart.STYLE)


def _trades(measurement: Measurement, kind: CostKind) -> str:
    """Return the charts of cost and error side by side, for each model with its recommendation."""
    cost = f"cost of the {kind.title}, {kind.unit}"
    figures = []
    for model in measurement.models:
        error = ERRORS[measure_of(measurement, model)]
        svg = chart.trade(pareto(measurement, model, kind), cost, error)
        say = advice if kind is TERM else frame_advice
        if svg:
            sentence = escape(say(measurement, model), quote=False)
            text = re.sub('"(.*?)"', r"<b>\1</b>", sentence)  # the names of variants
            figures.append(f'<figure><figcaption class="lead">{text}</figcaption>{svg}</figure>')
    return f'<div class="pair trades">{"".join(figures)}</div>'


def _folded(summary: str, *content: str) -> str:
    return "\n".join([f"<details><summary>{escape(summary)}</summary>", *content, "</details>"])


def _facts(measurement: Measurement) -> list[str]:
    """Return rows of a table with the machine and the settings."""
    environment, settings = measurement.environment, measurement.settings
    facts = {
        "mesh": settings.mesh,
        "m of the skin (RMS slope of the microfacets)": settings.slope,
        "size of the images, pixels": "{} x {}".format(*settings.size),
        "repeats of each timing": settings.repeats,
        "reduced measurement (--quick)": "yes" if settings.quick else "no",
        "OpenGL driver (GL_RENDERER)": environment["GL_RENDERER"],
        "version of OpenGL (GL_VERSION)": environment["GL_VERSION"],
        "drawn by": "CPU" if environment["software"] else "GPU",
        "processor": environment["processor"],
        "processor cores that the process may use": environment["cores"],
        "version of facerender": environment["facerender"],
        "version of Python": environment["python"],
        "version of NumPy": environment["numpy"],
        "date of the measurement": environment["date"],
    }
    return [row(name, [escape(str(value))]) for name, value in facts.items()]


def _html(table: Table, kind: str) -> str:
    """Return a table as HTML, with dominated rows in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    rows = [
        row(escape(name), map(escape, cells), "dominated" if name in table.dominated else "")
        for name, *cells in table.rows
    ]
    caption = f"<span>{escape(table.title)}</span><small>{escape(table.note)}</small>"
    return page_table(kind, map(escape, table.head), rows, caption)
