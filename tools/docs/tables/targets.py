"""On which targets the shader library is tested, and how near its bounds it is."""

from __future__ import annotations

from tools.docs.tables import load, table

COLUMNS = (
    ("target", "{target}"),
    ("renderer", "{renderer}"),
    ("version", "{version}"),
    ("functions", "{functions}"),
    ("samples", "{samples:,}"),
    ("largest error, % of its bound", "{percent:.0f}"),
    ("of", "{case}"),
)


def blocks() -> dict[str, str]:
    return {"targets": table(COLUMNS, load("targets")["targets"])}
