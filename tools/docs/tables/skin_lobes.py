"""Variance of sampled directions, and the effect of the energy-conserving diffuse term."""

from __future__ import annotations

from tools.docs.tables import load


def blocks() -> dict[str, str]:
    data = load("skin_lobes")
    times = [
        f"{ratio['60']:.0f} times smaller at m = {m}" for m, ratio in data["variances"].items()
    ]
    return {
        "variances": ", ".join(times),
        "coupled": "{mean:.1f}/255 on average over the head, and at most {p99:.0f}/255 at 99 % of"
        " the pixels".format(**data["coupled"]),
    }
