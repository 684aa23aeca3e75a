"""Writes docs/targets.md: what the shader library is held to, and how near it comes to its bounds.

python -m docs.targets        from the repository's root; what is missing here is said in its row
"""

from __future__ import annotations

import re
from pathlib import Path

from facerender.measure.tables import markdown_table
from tests.targets import TARGETS, Remote
from tests.test_shaders import CASES

OUTPUT = Path(__file__).with_suffix(".md")
TEXT = """# Targets

Written by `python -m docs.targets`. Every function of the library runs on every target, on the same
grids of inputs, into float pixels, which are held against float64 with the same bounds
(`tests/test_shaders.py`): those of the headers, and of the precision that Vulkan asks of drivers.
The last two columns tell how much of its bound the worst sample of the worst case uses.

{table}

Vulkan has no row: the suite compiles every flattened file with `glslangValidator -V` and holds the
result against `spirv-val`; no warning on any target.
"""
HEAD = (
    "target",
    "renderer",
    "version",
    "functions",
    "samples",
    "largest error, % of its bound",
    "of",
)


def row(target: str) -> list[str]:
    """Walk all cases on a target."""
    functions, samples, shares = set(), 0, {}
    with Remote(target) as evaluate:
        for name, make in CASES.items():
            case = make()
            result = evaluate(case.include, case.expression, case.inputs)
            functions.update(re.findall(r"fr_\w+", case.expression))
            samples += len(result)
            shares[name] = case.share(result).max()
        worst = max(shares, key=shares.__getitem__)
        return [
            target,
            evaluate.renderer,
            evaluate.version,
            str(len(functions)),
            f"{samples:,}",
            f"{100.0 * shares[worst]:.0f}",
            worst,
        ]


def main() -> None:
    rows = []
    for target in TARGETS:
        try:
            rows.append(row(target))
        except Exception as error:  # glcontext raises bare Exception
            rows.append([target, f"none: {error}", *[""] * (len(HEAD) - 2)])
    OUTPUT.write_text(TEXT.format(table=markdown_table(HEAD, rows)), encoding="utf-8")


if __name__ == "__main__":
    main()
