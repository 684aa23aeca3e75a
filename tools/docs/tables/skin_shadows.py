"""How far shadows and baked occlusion are from rays, and what they cost."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

ERRORS = (
    ("mesh", "{mesh}"),
    ("light", "{light}"),
    ("radius", "{radius:g}"),
    ("in shadow", "{shadowed:.2f%}"),
    ("without shadows", "{without:.2f%}"),
    ("mean error", "{mean:.2f%}"),
    ("wrong by half", "{wrong:.2f%}"),
)
COSTS = (
    ("a frame of 1024 x 1024", "{light}"),
    ("1 sample", "{time[0]:.2f}"),
    ("4 samples", "{time[1]:.2f}"),
)
OCCLUSION = (
    ("mesh", "{mesh}"),
    ("vertices", "{vertices:,}"),
    ("baked in", "{seconds:.1f} s"),
    ("mean error without", "{without:.3f}"),
    ("mean error", "{baked:.3f}"),
    ("a frame, 1 sample", "{time[0]:.2f}"),
    ("4 samples", "{time[1]:.2f}"),
)


def blocks() -> dict[str, str]:
    data = load("skin_shadows")
    return {
        "machine": machine(data),
        "errors": table(ERRORS, data["errors"]),
        "costs": table(COSTS, data["costs"]),
        "occlusion": table(OCCLUSION, data["occlusion"]),
    }
