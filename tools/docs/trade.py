"""Writes docs/trade.md, and the README's table of costs, from a measurement.

facerender measure -o out/measure && cp out/measure/measure.json docs/measurements/llvmpipe.json
python -m tools.docs.trade
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

from benchmarks.prices.amd import Statistics
from benchmarks.prices.offline import GPUS
from facerender.measure.measurement import MODELS, MeasuredVariant, Measurement
from facerender.measure.pareto import CostKind
from facerender.measure.tables import cost_tables, error_tables, markdown_table, tables_of
from facerender.pricing.interval import Interval
from facerender.pricing.table import FAMILY_NAMES, shipped, term_name
from facerender.pricing.variants import SLOPE, Variant
from facerender.shading import Term

HERE = Path(__file__).parents[2] / "docs"
MEASUREMENT = HERE / "measurements" / "llvmpipe.json"
TRADE = HERE / "trade.md"
AMD = json.loads((HERE / "measurements" / "amd.json").read_text(encoding="utf-8"))
COMPILED = [HERE / "measurements" / name for name in ("offline.json", "mobile.json")]
README = HERE.parent / "README.md"
MARKED = re.compile(r"(?<=<!-- python -m tools.docs.trade -->\n)(.*?)(?=<!-- end -->)", re.DOTALL)

IN_PROGRAM = """### {title}: what a light's term costs in the whole program

Of a fragment: the first light's term / each further light's, which shares with it what depends on
the fragment alone; in cycles of a wave, and nanoseconds on llvmpipe. Prices of
`python -m benchmarks.prices table`, with Schlick's Fresnel term and V-cavities, all lobes equally
lean; m as each fragment has it, or constant, {m}. Bold: no lobe is cheaper there, for one light or
for many, and as exact at m = {m}.

{table}

"""

HEAD = """# The trade: what each approximation costs and loses

Written by `python -m tools.docs.trade` from [measurements/llvmpipe.json](measurements/llvmpipe.json),
which `facerender measure` wrote. Measure your own machine and mesh: `facerender measure MESH`.

Measured on {date}: {GL_RENDERER}, OpenGL {GL_VERSION}, on {cores} cores of {processor}; for AMD's
GPUs, which nothing ran on, the estimates of {amd_driver}'s compiler. {gpu}

"""

COMPILERS = """

## Other compilers

Machine instructions that a term adds to a kernel which only sums up its inputs, and in brackets how
many of them are for the slow unit of roots, reciprocals and transcendentals. Compiled, not run, by
{compilers}: those of Intel (for 16 invocations) and NVIDIA (for 32) are their makers' own, from the
terms in OpenCL C and CUDA C++ with relaxed arithmetic, which Intel's also reassociates;
`python -m benchmarks.prices offline docs/measurements/offline.json` writes their figures.
Those of Adreno and Mali are Mesa's, from the terms as Vulkan's SPIR-V, over the null drivers of
Debian 13 for arm64, without what only waits on Adreno: `python -m benchmarks.prices.mobile FOLDER`. There is no
`--cost` of them: Intel's and NVIDIA's take no fragment program with textures, and Mesa's count
instructions where a plan needs cycles.

Tried without success: the makers' own compilers for Mali and Adreno are not among the packages of
Debian, PyPI and npm; Debian has no null driver for Intel's GPUs, and 13 no intel-opencl-icd. Mesa's
compiler for NVIDIA works over Debian 13's null driver too, and counts instructions alone.
"""


def headline(measurement: Measurement) -> str:
    """Return the README's table: costs of both models side by side, relative to the printed form,
    and the error of the lobe."""
    head = [""]
    rows: dict[str, list[str]] = {}
    for model, title in MODELS.items():
        head += [f"{title}, ns", "RDNA2, cycles", "error, %"]
        variants = measurement.of_model(model)
        base = variants[0].cost
        for row in variants:
            variant, cost = row.variant, row.cost
            exact = variant.lobe == "exact" and not variant.printed
            cells = rows.setdefault(f"**{variant.name}**" if exact else variant.name, [])
            cells.append(f"{cost.term_ns.value:.2f}, {cost.term_ns.value / base.term_ns.value:.2f}")
            cycles, of = (amd("navi21", each).inverse_throughput for each in (row, variants[0]))
            cells.append(f"{cycles}, {cycles / of:.2f}")
            error = row.error.lobe[measurement.settings.slope]
            cells.append("-" if error is None else f"{error:.2f}")
    return markdown_table(head, [[name, *cells] for name, cells in rows.items()]) + "\n"


def amd(family: str, measured: MeasuredVariant) -> Statistics:
    """Return the estimate for a variant of the compiler for a family of AMD's GPUs."""
    variant = measured.variant
    return Statistics(**AMD["statistics"][family][variant.model][variant.name])


def amd_cost(family: str, title: str) -> CostKind:
    """Return the cost on a family of AMD's GPUs, as a kind of cost beside the measured ones."""
    return CostKind(
        f"specular term on AMD {title}",
        "cycles a wave",
        lambda measured: Interval(*3 * (amd(family, measured).inverse_throughput,)),
        {
            "instructions": lambda measured: amd(family, measured).instructions,
            "latency, cycles": lambda measured: amd(family, measured).latency,
        },
    )


def trade(measurement: Measurement) -> str:
    """Return docs/trade.md."""
    facts = measurement.as_dict()["environment"]
    gpu = "No GPU has been measured." if measurement.environment.software else ""
    programs = "".join(in_program(measurement, model) for model in MODELS)
    head = HEAD.format(**facts, amd_driver=AMD["driver"], gpu=gpu)
    kinds = [amd_cost("navi21", "Navi 21"), amd_cost("vega10", "Vega 10")]
    compiled = [table for kind in kinds for table in tables_of(measurement, kind)]
    tables = [*cost_tables(measurement), *compiled, *error_tables(measurement)]
    return head + programs + "\n\n".join(table.markdown() for table in tables) + others()


def in_program(measurement: Measurement, model: str) -> str:
    """Return what a term of a model costs in the host's program, by lobe and target, with m per
    fragment and with a constant m."""
    error = {
        row.variant: row.error.lobe[measurement.settings.slope] or 0.0
        for row in measurement.of_model(model)
        if not row.variant.printed
    }
    columns: dict[str, dict[Variant, tuple[float, float]]] = {}
    for kind, prices in shipped().items():
        for words, m in (("per fragment", None), ("constant", SLOPE)):
            names = {
                each: term_name(Term(model, each.lobe, m=m, small_slope=not each.plain), SLOPE)
                for each in error
            }
            title = f"{FAMILY_NAMES.get(kind, kind)}, m {words}"
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
    table = markdown_table(["lobe", "error, %", *columns], rows)
    return IN_PROGRAM.format(title=MODELS[model], m=f"{SLOPE:g}", table=table)


def others() -> str:
    """Return the instructions that other compilers make of the terms, a table for each model."""
    data = [json.loads(path.read_text(encoding="utf-8")) for path in COMPILED]
    found = data[0]["instructions"] | data[1]["instructions"]
    names = [GPUS.get(gpu, gpu.replace("-", " ").title()) for gpu in found]
    texts = [COMPILERS.format(compilers=", ".join(data[0]["compilers"] + data[1]["compilers"]))]
    for model, title in MODELS.items():
        variants = next(iter(found.values()))[model]
        rows = [
            [name, *("{all} ({special})".format(**rows[model][name]) for rows in found.values())]
            for name in variants
        ]
        texts.append(f"### {title}: instructions\n\n{markdown_table(['variant', *names], rows)}\n")
    return "\n".join(texts)


def committed() -> Measurement:
    """Return what docs/measurements holds."""
    return Measurement.from_dict(json.loads(MEASUREMENT.read_text(encoding="utf-8")))


def stale() -> Iterator[str]:
    """Tell whether the document, or the README's table, is another."""
    data = committed()
    if TRADE.read_text(encoding="utf-8") != trade(data):
        yield "not what its measurement says"
    if MARKED.findall(README.read_text(encoding="utf-8")) != [headline(data)]:
        yield "README.md has not what its measurement says"


def main() -> None:
    measured = committed()
    TRADE.write_text(trade(measured), encoding="utf-8")
    readme = README.read_text(encoding="utf-8")
    README.write_text(MARKED.sub(lambda match: headline(measured), readme), encoding="utf-8")


if __name__ == "__main__":
    main()
