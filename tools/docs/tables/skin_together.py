"""What each part of skin costs of a frame, and what plans leave out."""

from __future__ import annotations

from tools.docs.tables import load, machine, table, with_median
from tools.docs.tables.frame import PLANS

COSTS = (
    ("a frame of 1024 x 1024, 1 sample", "{part}"),
    ("over the plain one", "{time:.2f}"),
    ("fastest over fastest", "{fastest:.2f}"),
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
