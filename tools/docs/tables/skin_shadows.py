"""Errors of shadows and baked occlusion against rays, and their cost."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

ERRORS = (
    ("mesh", "{mesh}"),
    ("light", "{light}"),
    ("radius, degrees", "{radius:g}"),
    ("light in shadow", "{shadowed:.2f%}"),
    ("error without shadows", "{without:.2f%}"),
    ("error with shadows", "{mean:.2f%}"),
    ("pixels with an error over half", "{wrong:.2f%}"),
)
COSTS = (
    ("light", "{light}"),
    ("frame time, 1 sample", "{time[0]:.2f}"),
    ("frame time, 4 samples", "{time[1]:.2f}"),
)
OCCLUSION = (
    ("mesh", "{mesh}"),
    ("vertices", "{vertices:,}"),
    ("time to bake", "{seconds:.1f} s"),
    ("mean error, not baked", "{without:.3f}"),
    ("mean error, baked", "{baked:.3f}"),
    ("frame time, 1 sample", "{time[0]:.2f}"),
    ("frame time, 4 samples", "{time[1]:.2f}"),
)


def blocks() -> dict[str, str]:
    data = load("skin_shadows")
    return {
        "machine": machine(data),
        "errors": table(ERRORS, data["errors"]),
        "costs": table(COSTS, data["costs"]),
        "occlusion": table(OCCLUSION, data["occlusion"]),
    }
