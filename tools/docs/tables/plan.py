"""Plans of ten scenes: choices, cost, errors and checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tools.docs.tables import load, machine, table

NAMES = {"llvmpipe": "llvmpipe", "navi21": "RDNA2", "vega10": "GCN5"}
COSTS = tuple(
    (name, f"{{{kind}[cost]:.2f}} ({{{kind}[specular]:.2f}}): {{{kind}[chosen]}}")
    for kind, name in NAMES.items()
)
_OVER = "{{{0}[over]}} of {{{0}[of]}} ({{{0}[rate]:.1f%}}), {{{0}[largest]:.2f}}"
RATES = (
    ("planned for", "{planned}"),
    ("budget", "{budget}"),
    ("planned cameras", _OVER.format("own")),
    ("other cameras", _OVER.format("others")),
)
CHECKS = (
    ("GPU", "{name}"),
    ("largest difference", "{largest:.3f}"),
    ("median difference", "{median:.3f}"),
)


def _with_rate(cameras: Mapping[str, Any]) -> dict[str, Any]:
    return {**cameras, "rate": cameras["over"] / cameras["of"]}


def blocks() -> dict[str, str]:
    data = load("plan")
    costs = {
        f"{mode}-{budget}": table([(f"budget {budget}/255", "{scene}"), *COSTS], rows)
        for mode, budgets in data["costs"].items()
        for budget, rows in budgets.items()
    }
    rates = [
        {**each, "own": _with_rate(each["own"]), "others": _with_rate(each["others"])}
        for each in data["rates"]
    ]
    checks = [{**each, "name": NAMES[each["family"]]} for each in data["checks"]]
    seconds = {
        f"seconds-{mode}": "{:.1f} s (at most {:.1f} s)".format(*seconds)
        for mode, seconds in data["seconds"].items()
    }
    return {
        "machine": machine(data),
        **costs,
        "rates": table(RATES, rates),
        "checks": table(CHECKS, checks),
        "shadings": "{} to {}".format(*data["search"]["shadings"]),
        "plans": "{plans} plans ({scenes} scenes, three budgets, three costs)".format(
            **data["search"]
        ),
        "dearer": str(data["search"]["dearer"]),
        **seconds,
    }
