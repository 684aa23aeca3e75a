"""Cost and error of whole frames: samples per pixel, deferred shading, plans."""

from __future__ import annotations

from tools.docs.tables import load, machine, table, with_median

SAMPLES = (
    ("samples", "{samples}"),
    ("frame time (1 sample = 1)", "{frame:digits}"),
    ("silhouette: mean, 1/255", "{silhouette:digits}"),
    ("99th percentile, 1/255", "{silhouette_99:digits}"),
    ("inside: mean, 1/255", "{inside:digits}"),
    ("99th percentile, 1/255", "{inside_99:digits}"),
    ("pixels over 1/255, %", "{over_percent:digits}"),
)
_TIME = "{{{0}[value]:.2f}} ({{{0}[low]:.2f}} to {{{0}[high]:.2f}})"
DEFERRED = (
    ("scene", "{scene}"),
    ("triangles", "{triangles}"),
    ("time, 1 sample", _TIME.format("one")),
    ("pixels over 1/255", "{one[over]:.3f%}"),
    ("time, 4 samples", _TIME.format("four")),
    ("pixels over 1/255", "{four[over]:.3f%}"),
)
PLANS = (
    ("scene", "{scene}"),
    ("chosen", "{chosen}"),
    ("measured time", "{measured:.2f}"),
    ("relative to forward shading", "{of_drawn:.2f}"),
    ("error", "{error}"),
    ("worst pixel", "{worst}"),
)


def blocks() -> dict[str, str]:
    data = load("frame")
    sizes = [(f"{size} x {size}", _TIME.format(f"s{size}")) for size in data["sizes"]]
    return {
        "machine": machine(data),
        "most-samples": str(data["most_samples"]),
        **{f"samples-{size}": table(SAMPLES, rows) for size, rows in data["samples"].items()},
        "deferred": table(DEFERRED, data["deferred"]),
        "sizes": table(sizes, [{f"s{size}": time for size, time in data["sizes"].items()}]),
        **{
            f"plans-{name}": table(PLANS, with_median(plans["plans"], plans["median"]))
            for name, plans in data["plans"].items()
        },
    }
