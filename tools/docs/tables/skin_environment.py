"""Errors of an environment map with few samples per lobe against many."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

COUNTS = (8, 16, 32, 64)
DIFFUSE = (
    ("environment", "{name}"),
    ("mean error", "{mean:.1f%}"),
    ("largest error", "{largest:.1f%}"),
)
SAMPLES = (
    ("mesh", "{mesh}"),
    ("environment", "{environment}"),
    ("m", "{m:g}"),
    *((f"{count} samples", f"{{n{count}[of_all]:.2f%}}") for count in COUNTS),
    ("32: error / specular term", "{n32[of_specular]:.1f%}"),
    ("32: energy", "{n32[energy]:+.1f%}"),
    ("32: 99th percentile", "{n32[displayed]:g}/255"),
)
RAYS = (
    ("mesh", "{mesh}"),
    ("environment", "{environment}"),
    ("lights", "{lights}"),
    ("mean", "{mean:.1f}"),
    ("99 %", "{high:.1f}"),
    ("creases: mean", "{crease_mean:.1f}"),
    ("creases: 99 %", "{crease_high:.1f}"),
)
SPARKLE = (("setting", "{name}"), ("pixels", "{n}"))


def blocks() -> dict[str, str]:
    data = load("skin_environment")
    rows = [
        {**each, **{f"n{count}": lost for count, lost in each["lost"].items()}}
        for each in data["samples"]
    ]
    of_specular = [each["n32"]["of_specular"] for each in rows]
    return {
        "machine": machine(data),
        "diffuse": table(DIFFUSE, [{"name": name, **e} for name, e in data["diffuse"].items()]),
        "samples": table(SAMPLES, rows),
        "worst": f"{100.0 * max(each['n32']['of_all'] for each in rows):.2f} %",
        "of-specular": f"{100.0 * min(of_specular):.1f} % to {100.0 * max(of_specular):.1f} %",
        "rays": table(RAYS, data["rays"]),
        "float64": f"{data['float64']:.1e}",
        "sparkle": table(SPARKLE, [{"name": name, "n": n} for name, n in data["sparkle"].items()]),
        "sample-cycles": str(data["cycles"]["sample"]),
        "base-cycles": str(data["cycles"]["base"]),
    }
