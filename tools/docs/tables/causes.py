"""Causes that the comparison's first reason names, for pairs of images with known causes."""

from __future__ import annotations

from collections import Counter

from tools.docs.tables import load, markdown_table


def blocks() -> dict[str, str]:
    pairs = load("causes")["pairs"]
    return {
        half: _confusion([(each["cause"], each["named"]) for each in pairs if each["half"] == half])
        for half in ("tune", "report")
    }


def _confusion(pairs: list[tuple[str, str]]) -> str:
    """Return a table: a row per cause, a column per named cause, and the fraction named right."""
    counts = Counter(pairs)
    causes = [*dict.fromkeys(cause for cause, _ in pairs)]
    rows = []
    for cause in causes:
        total = sum(counts[cause, other] for other in causes)
        cells = [str(counts[cause, other] or "") for other in causes]
        rows.append([cause, *cells, f"{counts[cause, cause]} of {total}"])
    right = sum(counts[cause, cause] for cause in causes)
    rows.append(["all", *[""] * len(causes), f"{right} of {len(pairs)}"])
    return markdown_table(["cause", *causes, "named first"], rows)
