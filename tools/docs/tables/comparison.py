"""Changes that each check of the image comparison detects, and changes that it misses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, product
from typing import Any

from benchmarks.pairs.verdicts import FACERENDER, FORMATS, OWN, UNNAMED, Summary, read_summary
from facerender.comparison.result import FOREIGN, HOLES, LIMITS
from facerender.comparison.sources import CHECKS
from tests.verification.pairs.changes import Format, Must
from tests.verification.pairs.scenes import Group
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
FINDS = {
    "point": "fireflies, missing pixels, false highlights",
    "block": "another lobe, weight, exposure or light",
    "trend": "small changes of many blocks in one direction, such as 0.3 % more light",
    "grain": "noise, values with fewer bits",
    "texture": "blur, other maps",
    "coverage": "another mesh or camera",
    "shift": "another camera",
}
FORMAT_NAMES: Mapping[Format, str] = {"png": "PNG", "exr": "EXR", "jpeg": "JPEG"}
REPORT: tuple[Format, ...] = ("png", "exr")  # formats of the group "report"


def blocks() -> dict[str, str]:
    data = load("comparison")
    own, peers, judge, judge_peers = (
        read_summary(MEASUREMENTS / f"{name}.json")
        for name in ("pairs", "pairs_peers", "pairs_judge", "pairs_judge_peers")
    )
    return {
        **limits(),
        **{
            name.replace(", ", "-"): _results("change", rows)
            for name, rows in data["changes"].items()
        },
        "drivers": _results("image", data["drivers"]),
        "thresholds": table(THRESHOLDS, map(_threshold, data["thresholds"])),
        "versions": ", ".join(peers.versions.values()),
        "judges": judges_table("report", REPORT, own, peers),
        "broken": changes_table("report", REPORT, own, "fail"),
        "harmless": changes_table("report", REPORT, own, "pass"),
        "judge": judges_table("judge", FORMATS, judge, judge_peers),
        "judge-broken": changes_table("judge", FORMATS, judge, "fail", UNNAMED),
        "judge-harmless": changes_table("judge", FORMATS, judge, "pass", UNNAMED),
        "judge-versions": ", ".join(judge_peers.versions.values()),
        "machine": machine(data),
    }


def limits() -> dict[str, str]:
    """Return tables of the limits of all checks, and the factor on them for another driver."""
    rows = [
        [f"**{name}**", *(f"{getattr(LIMITS[kind], name):g}" for kind in ("linear", "srgb8"))]
        for name in FINDS
    ]
    checks = []
    for name, finds in FINDS.items():
        check = CHECKS[name]
        amounts = [check.amount(getattr(LIMITS[kind], name), kind) for kind in LIMITS]
        checks.append([f"`{name}`", *amounts, check.quantity, finds])
    for place, name, limit, finds in (
        (1, "slivers", "50 pixels and 1 in 10,000", "as point, at edges"),
        (2, "holes", CHECKS["holes"].amount(HOLES, "linear"), "missing pixels and triangles"),
    ):
        checks.insert(place, [f"`{name}`", limit, limit, CHECKS[name].quantity, finds])
    head = ["check", "limit, linear", "limit, 8-bit", "limited quantity", "finds"]
    return {
        "checks": markdown_table(head, checks),
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


def judges_table(group: Group, formats: Sequence[Format], own: Summary, peers: Summary) -> str:
    """Return a table: the scores of all tools on a group of scenes."""
    scores = {
        (each.judge, each.format): each
        for each in (*own.scores, *peers.scores)
        if each.group == group
    }
    rows = []
    for judge in dict.fromkeys(name for name, _ in scores):
        row = [judge]
        for kind in formats:
            if (found := scores.get((judge, kind))) is None:
                row += [""] * 4
                continue
            row += [
                "" if judge in OWN else f"{found.threshold:.3g}",
                f"{found.caught} of {found.must_fail}",
                f"{found.alarms} of {found.must_pass}",
                f"{found.balanced:.3f}",
            ]
        rows.append(row)
    head = (
        [f"{FORMAT_NAMES[kind]}: threshold", "detected", "false alarms", "balanced accuracy"]
        for kind in formats
    )
    return markdown_table(["tool", *chain.from_iterable(head)], rows)


def changes_table(
    group: Group, formats: Sequence[Format], own: Summary, must: Must, *unnamed: str
) -> str:
    """Return a table: the scenes of a group in which facerender found a change.

    must : "fail" for changes that a comparison must detect, "pass" for harmless ones
    unnamed : UNNAMED for more columns with the verdicts on files without metadata
    """
    judges = (FACERENDER, *unnamed)
    counts = {
        (each.change, each.judge, each.format): f"{each.different} of {each.pairs}"
        for each in own.tallies
        if (each.group, each.must) == (group, must)
    }
    columns = [*product(judges, formats)]
    rows = [
        [change, *(counts.get((change, *column), "") for column in columns)]
        for change in dict.fromkeys(name for name, *_ in counts)
    ]
    without = {FACERENDER: "", UNNAMED: ", no metadata"}
    return markdown_table(
        ["change", *(FORMAT_NAMES[kind] + without[judge] for judge, kind in columns)], rows
    )
