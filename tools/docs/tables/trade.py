"""Cost and error of the specular terms; the README contains the first table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from benchmarks.prices.amd import FAMILIES, Statistics
from benchmarks.prices.offline import GPUS
from facerender.errors import InputError
from facerender.measure.measurement import (
    MODELS,
    SCHEMA,
    MeasuredVariant,
    Measurement,
    rows_of,
    slope_of,
)
from facerender.measure.report import CostKind, Table, cost_tables, error_tables
from facerender.pricing.cost import SLOPE, Interval, Variant, of_model
from facerender.pricing.table import shipped, term_name
from facerender.scene.shading import Term
from tools.docs.tables import load, markdown_table, published

_WORDS = ("variant", "lobe", "remark", "shading")  # columns that are aligned to the left


def blocks() -> dict[str, str]:
    measurement, h200 = (measurement_of(load(name)) for name in ("llvmpipe", "h200"))
    compiled = [load("offline"), load("mobile")]
    instructions = compiled[0]["instructions"] | compiled[1]["instructions"]
    return {
        "readme": headline(measurement),
        "targets": by_target(measurement, h200, instructions),
        "machine": _machine(measurement),
        "machine-h200": _machine(h200),
        "amd": load("amd")["driver"],
        **{f"program-{model}": in_program(measurement, model) for model in MODELS},
        "costs": _tables([*cost_tables(measurement), *amd_tables(measurement)]),
        "costs-h200": _tables(cost_tables(h200)),
        "errors": _tables(error_tables(measurement)),
        "compilers": ", ".join(compiled[0]["compilers"] + compiled[1]["compilers"]),
        **{f"instructions-{model}": instruction_table(instructions, model) for model in MODELS},
    }


def measurement_of(content: Mapping[str, Any]) -> Measurement:
    """Return the measurement in the content of measure.json, without the recommended variants.

    Raises
    ------
    InputError : another schema, or a variant that this version does not have
    """
    if content["schema"] != SCHEMA:
        raise InputError(
            f"the measurement's schema is {content['schema']!r}, not {SCHEMA!r}; measure again"
        )
    for model, name in ((row["model"], row["name"]) for row in content["variants"]):
        if name not in (variant.name for variant in of_model(model)):
            raise InputError(
                f"unknown variant {name!r} of {model!r} in the measurement; measure again"
            )
    return {key: value for key, value in content.items() if key != "recommended"}


def _machine(measurement: Measurement) -> str:
    """Return date, driver and processor of a measurement."""
    return ("{date}: {GL_RENDERER}, OpenGL {GL_VERSION}, on {cores} cores of {processor}").format(
        **measurement["environment"]
    )


def amd(family: str, measured: MeasuredVariant) -> Statistics:
    """Return the compiler's estimate of a variant's cost on a family of AMD's GPUs."""
    statistics = load("amd")["statistics"][family]
    return Statistics(**statistics[measured["model"]][measured["name"]])


def amd_tables(measurement: Measurement) -> list[Table]:
    """Return the tables of the estimated costs on AMD's GPUs."""

    def kind(family: str, title: str) -> CostKind:
        return CostKind(
            f"specular term on AMD {title}",
            "cycles per wave",
            lambda measured: Interval(*3 * (amd(family, measured).inverse_throughput,)),
            {
                "instructions": lambda measured: amd(family, measured).instructions,
                "latency, cycles": lambda measured: amd(family, measured).latency,
            },
        )

    kinds = kind("navi21", "Navi 21"), kind("vega10", "Vega 10")
    return cost_tables(measurement, kinds)


def headline(measurement: Measurement) -> str:
    """Return the README's table: cost of Cook-Torrance, absolute and relative to the published
    form, and error of the lobe."""
    variants = rows_of(measurement, "cook-torrance")
    base = variants[0]
    rows = []
    for row in variants:
        name = published(row["name"])
        ns, of = (each["cost"]["term_ns"]["value"] for each in (row, base))
        cycles, all_cycles = (amd("navi21", each).inverse_throughput for each in (row, base))
        error = row["error"]["lobe"][slope_of(measurement)]
        rows.append(
            [
                f"**{name}**" if name.startswith("exact") else name,
                f"{ns:.2f} ({ns / of:.2f})",
                f"{cycles} ({cycles / all_cycles:.2f})",
                "-" if error is None else f"{error:.2f}",
            ]
        )
    return markdown_table(["Cook-Torrance", "ns (relative)", "cycles (relative)", "error, %"], rows)


def by_target(cpu: Measurement, gpu: Measurement, instructions: dict[str, dict[str, Any]]) -> str:
    """Return a table: cost of some Cook-Torrance terms on phones, desktop GPUs and a CPU."""
    names = ("exact", "exact, m >= 0.2", "d8", "fitted")
    counts = "instructions (of the slow unit)"
    rows = []
    for phone in ("adreno-740", "mali-g610"):
        of = instructions[phone]["cook-torrance"]
        title = f"phone: {phone.replace('-', ' ').title()}"
        rows.append([title, counts, *("{all} ({special})".format(**of[name]) for name in names)])
    cycles = load("amd")["statistics"]["navi21"]["cook-torrance"]
    rows.append(
        ["desktop GPU: AMD RDNA2 (estimate)", "cycles per wave"]
        + [str(cycles[name]["inverse_throughput"]) for name in names]
    )
    for title, measurement in (("desktop GPU: NVIDIA H200", gpu), ("CPU: llvmpipe", cpu)):
        costs = {
            row["name"]: row["cost"]["term_ns"]["value"]
            for row in rows_of(measurement, "cook-torrance")
        }
        rows.append([title, "ns per evaluation", *(f"{costs[name]:#.3g}" for name in names)])
    return markdown_table(["target", "unit", *names], rows)


def in_program(measurement: Measurement, model: str) -> str:
    """Return a table: cost of a model's term in the renderer's program, by lobe and target, with m
    per fragment and with a constant m. Costs are bold unless another lobe dominates them: at most
    the same error and the same costs."""
    errors = {
        row["name"]: row["error"]["lobe"][slope_of(measurement)]
        for row in rows_of(measurement, model)
    }
    error = {
        variant: errors[variant.name] or 0.0
        for variant in of_model(model)
        if not variant.printed and variant.name in errors
    }
    columns: dict[str, dict[Variant, tuple[float, float]]] = {}
    for kind, prices in shipped().items():
        for words, m in (("per fragment", None), ("constant", SLOPE)):
            names = {
                each: term_name(Term(model, each.lobe, m=m, small_slope=not each.plain), SLOPE)
                for each in error
            }
            title = f"{FAMILIES.get(kind, kind)}, m {words}"
            columns[title] = {each: prices.terms[name] for each, name in names.items()}

    def cell(each: Variant, costs: dict[Variant, tuple[float, float]]) -> str:
        text = " / ".join(f"{cost:.3g}" for cost in costs[each])
        beaten = any(
            error[other] <= error[each]
            and all(a <= b for a, b in zip(costs[other], costs[each], strict=True))
            and (error[other], costs[other]) != (error[each], costs[each])
            for other in error
        )
        return text if beaten else f"**{text}**"

    rows = [
        [each.name, f"{error[each]:.2f}", *(cell(each, costs) for costs in columns.values())]
        for each in error
    ]
    return markdown_table(["lobe", "error, %", *columns], rows)


def instruction_table(instructions: dict[str, Any], model: str) -> str:
    """Return a table: the instructions of a model's terms from other compilers."""
    names = [GPUS.get(gpu, gpu.replace("-", " ").title()) for gpu in instructions]
    rows = [
        [
            published(name),
            *("{all} ({special})".format(**of[model][name]) for of in instructions.values()),
        ]
        for name in next(iter(instructions.values()))[model]
    ]
    return markdown_table(["variant", *names], rows)


def _tables(tables: Iterable[Table]) -> str:
    """Return tables of the package under headings of the third level, numbers aligned right."""
    parts = []
    for each in tables:
        marks = ["---" if name in _WORDS else "---:" for name in each.head]
        rows = [[published(name), *cells] for name, *cells in each.rows]
        text = f"{each.note}\n\n{markdown_table(each.head, rows, marks)}"
        parts.append(f"### {each.title}\n\n{text if each.rows else 'Not measured.'}")
    return "\n\n".join(parts)
