"""What scattering in the image loses and costs."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

ERRORS = (
    ("samples", "{samples}"),
    ("mean error", "{mean:.2f%}"),
    ("99 % of the pixels within", "{p99:.1f}"),
)
COSTS = (
    ("samples", "{samples}"),
    ("1 sample a pixel", "{time[0]:.1f}"),
    ("4 samples a pixel", "{time[1]:.1f}"),
)


def blocks() -> dict[str, str]:
    data = load("skin_scattering")
    errors = {
        name: [each | {"samples": each["samples"] or "none"} for each in rows]
        for name, rows in data["errors"].items()
    }
    return {
        "machine": machine(data),
        **{name: table(ERRORS, rows) for name, rows in errors.items()},
        "costs": table(COSTS, data["costs"]),
    }
