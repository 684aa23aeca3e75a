"""The paper's claims and the measurements that check them."""

from __future__ import annotations

from benchmarks.paper.claims import PEAK
from tools.docs.tables import load, published, table

CLAIMS = (
    ("claim", "{claim}"),
    ("the paper", "{paper}"),
    ("measured", "{measured}"),
    ("verdict", "{verdict}"),
    ("conditions", "{conditions}"),
)
ERRORS = (("m", "{m}"), ("Ward", "{ward:.2f}"), ("Cook-Torrance", "{cook_torrance:.2f}"))


def blocks() -> dict[str, str]:
    data = load("reproduction/reproduction")
    claims = [
        {
            **claim,
            "claim": published(claim["claim"]),
            "verdict": ": ".join(filter(None, (claim["verdict"], claim["where"]))),
            "conditions": published(claim["conditions"]),
        }
        for claim in data["claims"]
    ]
    ward, cook_torrance = (
        next(c for c in data["claims"] if c["conditions"] == PEAK and c["claim"].startswith(model))
        for model in ("Ward", "Cook-Torrance")
    )
    errors = [
        {"m": m, "ward": error, "cook_torrance": cook_torrance["values"][m]}
        for m, error in ward["values"].items()
    ]
    facts = [f"- {name}: {value}" for name, value in data["environment"].items()]
    return {
        "claims": table(CLAIMS, claims),
        "errors": table(ERRORS, errors),
        "range": ward["where"].split(" % ")[1],
        "environment": "\n".join(facts),
    }
