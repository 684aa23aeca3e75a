"""The data sets of docs/measurements, which `python -m tools.docs` turns into tables, and the ratio
of two times."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import facerender as fr
from facerender.pricing.cost import Draw, Interval, bootstrap, seconds
from tests.verification.scan import load_scan, scan_folder
from tests.verification.subjects import Subject, subjects

MEASUREMENTS = Path(__file__).parents[1] / "docs" / "measurements"


def save(name: str, **data: Any) -> None:
    """Write docs/measurements/NAME.json: the OpenGL driver of this machine, and the data."""
    with fr.Renderer((16, 16)) as renderer:
        facts = {key: renderer.metadata[key] for key in ("GL_RENDERER", "GL_VERSION")}
    content = json.dumps({"environment": facts, **data}, indent=1, ensure_ascii=False)
    (MEASUREMENTS / f"{name}.json").write_text(f"{content}\n", encoding="utf-8")


def meshes() -> Iterator[tuple[str, fr.Mesh]]:
    """Yield the built-in head, and the head scan of the tests if it is installed."""
    yield "head", fr.load_mesh()
    if folder := scan_folder():
        yield "scan", load_scan(folder)


def scenes() -> Iterator[Subject]:
    """Yield the scenes for plans: ten, or eight without the head scan."""
    found = dict(meshes())
    yield from subjects(found["head"], found.get("scan"))


def ratio(draw: Draw, full: Draw, repeats: int) -> Interval:
    """Divide the time of ``draw`` by the time of ``full`` per round; return the median ratio."""
    times, baseline = seconds([draw, full], repeats).T
    return bootstrap(lambda turns: np.median((times / baseline)[turns], keepdims=True), repeats)[0]
