"""Frame time of each part of skin, and plans of scenes with all parts."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

COSTS = (
    ("frame", "{part}"),
    ("median time / plain", "{time:.2f}"),
    ("fastest / fastest plain", "{fastest:.2f}"),
)


def blocks() -> dict[str, str]:
    data = load("skin_together")
    plans = data["plans"]
    full = sum(each["chosen"] == "the full frame" for each in plans)
    over = sum(each["over_budget"] for each in plans)
    return {
        "machine": machine(data),
        "costs": table(COSTS, data["costs"]),
        "full": f"{full} of {len(plans)}",
        "violations": f"{over} of {len(plans)}",
        "forward": f"{data['median']['of_drawn']:.2f}",
    }
