"""The paper's claims and the measurements that check them."""

from __future__ import annotations

from tools.docs.tables import load, published, table

CLAIMS = (
    ("claim", "{claim}"),
    ("the paper", "{paper}"),
    ("measured", "{measured}"),
    ("verdict", "{verdict}"),
    ("conditions", "{conditions}"),
)


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
    facts = [f"- {name}: {value}" for name, value in data["environment"].items()]
    return {"claims": table(CLAIMS, claims), "environment": "\n".join(facts)}
