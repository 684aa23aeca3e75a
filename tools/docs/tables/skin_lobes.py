"""Variance of sampled directions, and the effect of the energy-conserving diffuse term."""

from __future__ import annotations

from facerender.pricing.table import shipped
from tools.docs.tables import load


def blocks() -> dict[str, str]:
    data, parts = load("skin_lobes"), shipped()["navi21"].parts
    times = [
        f"{ratio['60']:.0f} times smaller at m = {m}" for m, ratio in data["variances"].items()
    ]
    return {
        "variances": ", ".join(times),
        "coupled": "{mean:.1f}/255 on average over the head, and at most {p99:.0f}/255 at 99 % of"
        " the pixels".format(**data["coupled"]),
        "coupled-cycles": f"{parts['coupled diffuse']:g} cycles per fragment and"
        f" {parts['light of coupled diffuse']:g} cycles per light",
    }
