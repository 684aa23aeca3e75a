"""The paper's claims beside what is measured."""

from __future__ import annotations

from tools.docs.tables import load, table

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
        {**claim, "verdict": ": ".join(filter(None, (claim["verdict"], claim["where"])))}
        for claim in data["claims"]
    ]
    facts = [f"- {name}: {value}" for name, value in data["environment"].items()]
    return {"claims": table(CLAIMS, claims), "environment": "\n".join(facts)}
