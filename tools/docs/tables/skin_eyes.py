"""Errors of refracting eyes against exact rays, and the cost of eyes."""

from __future__ import annotations

from tools.docs.tables import load, machine, table


def blocks() -> dict[str, str]:
    data = load("skin_eyes")
    columns = [
        ("azimuth, degrees", "{azimuth:g}"),
        *(
            (f"{count} triangles", f"{{drawn[{i}][mean]:.2%}}, {{drawn[{i}][most]:.2%}}")
            for i, count in enumerate(data["triangles"])
        ),
        ("without refraction", "{straight:.3%}"),
    ]
    shells = (
        ("shells", "{shells}"),
        ("frame time, 1 sample", "{time[0]:.2f}"),
        ("frame time, 4 samples", "{time[1]:.2f}"),
    )
    return {
        "machine": machine(data),
        "errors": table(columns, data["errors"]),
        "costs": table(shells, data["costs"]),
    }
