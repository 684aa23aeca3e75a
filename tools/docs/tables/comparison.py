"""Changes that each check of the image comparison detects, and changes that it misses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.pairs.verdicts import FACERENDER, Summary, read_summary
from facerender.comparison.result import FOREIGN, LIMITS
from tools.docs.tables import MEASUREMENTS, Columns, load, machine, markdown_table, table

_RESULT = (
    ("point, pixels over the limit", "{point:+.2g}, {points}"),
    ("block, blocks over the limit", "{block}, {blocks} of {judged}"),
    ("trend", "{trend:.2g}"),
    ("texture", "{texture:+.1f%}"),
    ("failed checks", "{checks}"),
    ("reported cause", "{guess}"),
)
THRESHOLDS = (
    ("image", "{image}"),
    ("change", "{change}"),
    *((name, f"{{{name}}}") for name in ("point", "block", "trend", "EXR", "PNG")),
)
CHECKS = ("point", "block", "trend", "grain", "texture", "shift", "coverage")
JUDGES_HEAD = (
    *("tool", "PNG: threshold", "detected", "false alarms", "balanced accuracy"),
    *("EXR: threshold", "detected", "false alarms", "balanced accuracy"),
)


def blocks() -> dict[str, str]:
    data = load("comparison")
    own, peers = (read_summary(MEASUREMENTS / f"{name}.json") for name in ("pairs", "pairs_peers"))
    return {
        **limits(),
        **{
            name.replace(", ", "-"): _results("change", rows)
            for name, rows in data["changes"].items()
        },
        "drivers": _results("image", data["drivers"]),
        "thresholds": table(THRESHOLDS, map(_threshold, data["thresholds"])),
        "versions": ", ".join(peers.versions.values()),
        "judges": judges_table(own, peers),
        "broken": changes_table(own, "fail"),
        "harmless": changes_table(own, "pass"),
        "machine": machine(data),
    }


def limits() -> dict[str, str]:
    """Return a table of the limits of all checks, and the factor on them for another driver."""
    rows = [
        [f"**{name}**", *(f"{getattr(LIMITS[kind], name):g}" for kind in ("linear", "srgb8"))]
        for name in CHECKS
    ]
    return {
        "limits": markdown_table(["check", "linear images", "8-bit images"], rows),
        "foreign": f"{FOREIGN:g}",
    }


def _results(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    columns: Columns = [(name, f"{{{name}}}"), *_RESULT]
    records = [
        {
            **row,
            "block": f"{100.0 * row['block']:+.2g} %" if row["linear"] else f"{row['block']:+.2g}",
            "checks": ", ".join(row["checks"]) or "none",
            "guess": "; ".join(row["looks_like"]) or "same",
        }
        for row in rows
    ]
    return table(columns, records)


def _threshold(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the smallest change that each check detects, or "> x" if none up to x is detected."""
    seen = {
        name: f"> {row['most']:g}" if value is None else f"{value:.2g}"
        for name, value in row["seen"].items()
    }
    return {"image": row["image"], "change": row["change"], **seen}


def judges_table(own: Summary, peers: Summary) -> str:
    """Return a table: the scores of all tools on the reported half of the suite."""
    scores = {
        (each.judge, each.format): each
        for each in (*own.scores, *peers.scores)
        if each.group == "report"
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
    """Return a table: the scenes of the reported half in which facerender found a change.

    must : "fail" for changes that a comparison must detect, "pass" for harmless ones
    """
    counts = {
        (each.change, each.format): f"{each.different} of {each.pairs}"
        for each in own.tallies
        if (each.group, each.must) == ("report", must)
    }
    rows = [
        [change, *(counts.get((change, kind), "") for kind in ("png", "exr"))]
        for change in dict.fromkeys(name for name, _ in counts)
    ]
    return markdown_table(["change", "PNG", "EXR"], rows)
