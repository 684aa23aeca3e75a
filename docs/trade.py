"""Writes docs/trade.md, and the README's table of costs, from a measurement.

facerender measure -o out/measure && cp out/measure/measure.json docs/measurements/llvmpipe.json
python -m docs.trade
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from facerender.measure import report
from facerender.measure.tables import markdown_table

HERE = Path(__file__).parent
MEASUREMENT = HERE / "measurements" / "llvmpipe.json"
TRADE = HERE / "trade.md"
README = HERE.parent / "README.md"
MARKED = re.compile(r"(?<=<!-- python -m docs.trade -->\n)(.*?)(?=<!-- end -->)", re.DOTALL)

HEAD = """# The trade: what each approximation costs and loses

Written by `python -m docs.trade` from [measurements/llvmpipe.json](measurements/llvmpipe.json),
which `facerender measure` wrote. Measure your own machine and mesh: `facerender measure MESH`.

Measured on {date}: {GL_RENDERER}, OpenGL {GL_VERSION}, on {cores} cores of {processor}; for AMD's
GPUs, which nothing ran on, the estimates of {amd_driver}'s compiler. {gpu}

"""


def headline(data: dict[str, Any]) -> str:
    """Return the README's table: costs of both models side by side, relative to the printed form,
    and the error of the lobe."""
    m = f"{data['settings']['m']:g}"
    rows: dict[str, list[str]] = {}
    for model in ("cook-torrance", "ward"):
        variants = [v for v in data["variants"] if v["model"] == model]
        base = variants[0]["cost"]
        for variant in variants:
            cost, error = variant["cost"], variant["error"]["lobe"][m]
            name = variant["name"]
            nanoseconds, cycles = cost["term_ns"]["value"], cost["navi21"]
            cells = rows.setdefault(f"**{name}**" if name.startswith("exact") else name, [])
            cells += [
                f"{nanoseconds:.2f}, {nanoseconds / base['term_ns']['value']:.2f}",
                "-"
                if cycles is None
                else f"{cycles['inverse_throughput']}, "
                f"{cycles['inverse_throughput'] / base['navi21']['inverse_throughput']:.2f}",
                "-" if error is None else f"{error:.2f}",
            ]
    head = [
        "",
        "Cook-Torrance, ns",
        "RDNA2, cycles",
        "error, %",
        "Ward, ns",
        "RDNA2, cycles",
        "error, %",
    ]
    return markdown_table(head, [[name, *cells] for name, cells in rows.items()]) + "\n"


def trade(data: dict[str, Any]) -> str:
    """Return docs/trade.md."""
    environment = data["environment"]
    gpu = "No GPU has been measured." if environment["software"] else ""
    return HEAD.format_map(environment | {"gpu": gpu}) + report.markdown(data)


def stale() -> Iterator[str]:
    """Tell whether the document, or the README's table, is another."""
    data = json.loads(MEASUREMENT.read_text(encoding="utf-8"))
    if TRADE.read_text(encoding="utf-8") != trade(data):
        yield "not what its measurement says"
    if MARKED.findall(README.read_text(encoding="utf-8")) != [headline(data)]:
        yield "README.md has not what its measurement says"


def main() -> None:
    data = json.loads(MEASUREMENT.read_text(encoding="utf-8"))
    TRADE.write_text(trade(data), encoding="utf-8")
    readme = README.read_text(encoding="utf-8")
    README.write_text(MARKED.sub(lambda match: headline(data), readme), encoding="utf-8")


if __name__ == "__main__":
    main()
