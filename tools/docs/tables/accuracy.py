"""Errors and ranges of all lobes, and errors of float32.

The tables of the lobes are computed here; the tables of float32 come from a measurement.
"""

from __future__ import annotations

import numpy as np

from facerender import lobes
from facerender.lobes import AnyLobe
from facerender.measure import measurement
from facerender.terms.lobe import G_POWERS, fit_g_power
from tools.docs.tables import load, machine, markdown_table, published, table

MODELS = {4: "Cook-Torrance", 0: "Ward"}
SLOPES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 1.0)
FLOAT32 = (
    ("m", "{m:g}"),
    ("Cook-Torrance", "{cook_torrance:.1e}"),
    ("Cook-Torrance, FR_SMALL_SLOPE 0", "{cook_torrance_plain:.1e}"),
    ("Cook-Torrance, unrounded directions", "{cook_torrance_true:.1e}"),
    ("Ward", "{ward:.1e}"),
    ("Ward, FR_SMALL_SLOPE 0", "{ward_plain:.1e}"),
    ("Ward, unrounded directions", "{ward_true:.1e}"),
)
EXTREMES = (("input", "{input}"), ("as published", "{printed}"), ("facerender", "{facerender}"))


def blocks() -> dict[str, str]:
    data = load("accuracy")
    extremes = [{**each, "input": published(each["input"])} for each in data["extremes"]]
    return {
        **{model: lobe_table(k) for k, model in MODELS.items()},
        "cook-torrance-short": short_table(4),
        "domains": domains(),
        "powers": ", ".join(map(str, G_POWERS)),
        "fitted": fitted_g_powers(),
        "float32": table(FLOAT32, data["float32"]),
        "extremes": table(EXTREMES, extremes),
        "machine": machine(data),
    }


def lobe_error(name: AnyLobe, m: float, k: int) -> float:
    """Return the largest difference from the exact lobe over 0 to 90 degrees, in % of its peak."""
    degrees = np.concatenate(
        [np.linspace(0.0, 90.0, 20001), np.degrees(np.linspace(0, 8 * m, 20001))]
    )
    return 100.0 * float(np.abs(measurement.lobe_error(name, m, k, degrees[degrees <= 90.0])).max())


def lobe_table(k: int) -> str:
    """Return a table: the errors of all lobes of a model, by m."""
    names = [name for name in lobes.NAMES if name != "exact"]
    rows = []
    for m in SLOPES:
        inside = {name: bool(lobes.in_domain(m, name, k)) for name in names}
        errors = [f"{lobe_error(name, m, k):.3g}" if inside[name] else "-" for name in names]
        if any(inside.values()):
            rows.append([f"{m:g}", *errors])
    return markdown_table(["m", *names], rows)


def g_power_errors(m: float, k: int) -> dict[int, float]:
    """Return the errors of the g-powers that are fitted to one m, by g."""
    fits = [fit_g_power(k, g, m, m) for g in G_POWERS]
    return {lobe.g: lobe_error(lobe, m, k) for lobe in fits if lobe is not None}


def short_table(k: int) -> str:
    """Return a table: the errors of the approximated lobes and of the best g-power, by m."""
    rows = []
    for m in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        power = min(g_power_errors(m, k).values())
        errors = [lobe_error(name, m, k) for name in ("d4", "d8", "d16", "fitted", "fitted-fine")]
        rows.append([f"{m:g}", *(f"{each:.2f}" for each in (*errors, power))])
    return markdown_table(["m", "d4", "d8", "d16", "fitted", "fitted-fine", "best g-power"], rows)


def domains() -> str:
    """Return a table: the range of m of each lobe, for both models."""
    rows = [
        [name, *(f"{lobes.MIN_SLOPE:g} to {lobes.max_slope(name, k):.4g}" for k in MODELS)]
        for name in lobes.NAMES
    ]
    return markdown_table(["lobe", *MODELS.values()], rows)


def fitted_g_powers() -> str:
    """Return a table: for each m the best g and its error, and the best error of d4, d8 and d16."""
    rows = []
    for m in SLOPES:
        row = [f"{m:g}"]
        for k in MODELS:
            errors = g_power_errors(m, k)
            g = min(errors, key=errors.__getitem__)
            paper = [
                lobe_error(name, m, k)
                for name in ("d4", "d8", "d16")
                if lobes.in_domain(m, name, k)
            ]
            row += [str(g), f"{errors[g]:.2g}", f"{min(paper):.2g}" if paper else "-"]
        rows.append(row)
    columns = ("best g", "its error, %", "best of d4 to d16, %")
    head = [f"{model}: {column}" for model in MODELS.values() for column in columns]
    return markdown_table(["m", *head], rows)
