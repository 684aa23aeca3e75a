"""What drawn directions save, and what coupled diffuse light changes."""

from __future__ import annotations

from tools.docs.tables import load


def blocks() -> dict[str, str]:
    data = load("skin_lobes")
    times = [f"{ratio['60']:.0f} times less at m {m}" for m, ratio in data["variances"].items()]
    return {
        "variances": ", ".join(times),
        "coupled": "{mean:.1f}/255 in the mean of the head, at most {p99:.0f}/255 for 99 % of the"
        " pixels".format(**data["coupled"]),
    }
