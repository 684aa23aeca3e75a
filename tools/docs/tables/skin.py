"""Errors of the slope filter and of area lights against many samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tools.docs.tables import load, machine, table

FILTERED = (
    ("relief", "{relief}"),
    ("image, pixels", "{size}"),
    ("m", "{m:g}"),
    ("energy, unfiltered", "{none[energy]:+.1f%}"),
    ("energy, filtered", "{filter[energy]:+.1f%}"),
    ("L1", "{filter[l1]:.1f%}"),
    ("L1 / unfiltered", "{l1:.2f}"),
    ("FLIP", "{filter[flip]:.4f}"),
    ("FLIP / unfiltered", "{flip:.2f}"),
)
FLICKER = (
    ("relief", "{relief}"),
    ("unfiltered", "{beyond[none]:.4f}"),
    ("slope filter", "{beyond[filter]:.4f}"),
)
DISCS = (
    ("angle between light and camera, degrees", "{angle:g}"),
    ("radius, degrees", "{radius:g}"),
    ("m", "{m:g}"),
    ("error, radius ignored", "{without:.1f%}"),
    ("error, area light", "{with:.1f%}"),
)


def blocks() -> dict[str, str]:
    data = load("skin")
    filtered = [_ratios(each) for each in data["filtered"]]
    energies = [each["filter"]["energy"] for each in filtered]
    return {
        "machine": machine(data),
        "energy": f"{100.0 * min(energies):+.1f} % to {100.0 * max(energies):+.1f} %",
        "l1": f"{max(each['l1'] for each in filtered):.2f}",
        "flip": f"{max(each['flip'] for each in filtered):.2f}",
        "filtered": table(FILTERED, filtered),
        "flicker": table(FLICKER, data["flicker"]),
        "discs": table(DISCS, data["discs"]),
    }


def _ratios(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with the ratios of L1 and FLIP, filtered to unfiltered, added."""
    lost = record["lost"]
    ratios = {name: lost["filter"][name] / lost["none"][name] for name in ("l1", "flip")}
    return {**record, **lost, **ratios}
