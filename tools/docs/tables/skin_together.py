"""Frame time of each part of skin, and plans of scenes with all parts."""

from __future__ import annotations

from tools.docs.tables import load, machine, table, with_median
from tools.docs.tables.frame import PLANS

COSTS = (
    ("frame", "{part}"),
    ("median time / plain", "{time:.2f}"),
    ("fastest / fastest plain", "{fastest:.2f}"),
)


def blocks() -> dict[str, str]:
    data = load("skin_together")
    over = sum(each["over_budget"] for each in data["plans"])
    return {
        "machine": machine(data),
        "costs": table(COSTS, data["costs"]),
        "plans": table(PLANS, with_median(data["plans"], data["median"])),
        "violations": f"{over} of {len(data['plans'])}",
    }
