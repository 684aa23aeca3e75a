"""Targets that the shader library was tested on, and the largest error on each."""

from __future__ import annotations

from tools.docs.tables import load, table

COLUMNS = (
    ("target", "{target}"),
    ("renderer", "{renderer}"),
    ("version", "{version}"),
    ("functions", "{functions}"),
    ("samples", "{samples:,}"),
    ("largest error, % of its bound", "{percent:.0f}"),
    ("case", "{case}"),
)


def blocks() -> dict[str, str]:
    return {"targets": table(COLUMNS, load("targets")["targets"])}
