"""Error and cost of subsurface scattering."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

ERRORS = (
    ("subsurface samples", "{samples}"),
    ("mean error", "{mean:.2f%}"),
    ("99th percentile of the displayed error, levels", "{p99:.1f}"),
)
COSTS = (
    ("subsurface samples", "{samples}"),
    ("1 sample per pixel", "{time[0]:.1f}"),
    ("4 samples per pixel", "{time[1]:.1f}"),
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
