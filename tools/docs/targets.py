"""Writes docs/targets.md: what the shader library is held to, and how near it comes to its bounds.

python -m tools.docs.targets        from the repository's root; what is missing here is said in its row
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from facerender.measure.tables import markdown_table
from tests.verification.cases import cases_of, evaluated
from tests.verification.targets import LAVAPIPE, TARGETS, Remote, groups_of
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/targets.md"
TEXT = """# Targets

Written by `python -m tools.docs.targets`. Every function of the library runs on every target, on the same
grids of inputs, into float pixels, which are held against float64 with the same bounds
(`tests/verification/cases.py`): those of the headers, and of the precision that Vulkan asks of drivers.
The last two columns tell how much of its bound the worst sample of the worst case uses.

{table}

The last three are drawn by Mesa's Vulkan driver: GLSL 450 and HLSL go through glslang to SPIR-V,
and with WGSL through naga; HLSL and WGSL are what `facerender shaders flatten` writes. They read
buffers: functions with samplers or arrays (environment, shadow, scatter) are not among theirs, and
those are not translated. Metal's language is translated as well; without Apple's compiler, g++
compiles every file of it as C++14 with glm's vectors and no warning, and what it draws is within
1e-6 of what OpenGL draws. `fr_cook_torrance_half` is held to its bound in float32 here, since no
renderer of the table has halves; the suite holds it to the same bound in NumPy's.

The suite compiles every flattened file for Vulkan with `glslangValidator -V`, and holds the result
against `spirv-val`; no warning on any target. Random samples of every function, as many as wanted,
on any target: `python -m tests.verification.many 1e9 "WGSL, Vulkan"`.
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
    with Remote(target) as remote:
        for group in groups_of(target):
            cases = cases_of(group)
            for name, result in evaluated(cases, remote).items():
                functions.update(re.findall(r"fr_\w+", cases[name].expression))
                samples += len(result)
                shares[name] = cases[name].share(result).max()
        worst = max(shares, key=shares.__getitem__)
        return [
            target,
            remote.renderer,
            remote.version,
            str(len(functions)),
            f"{samples:,}",
            f"{100.0 * shares[worst]:.0f}",
            worst,
        ]


def stale() -> Iterator[str]:
    """Tell what the document lacks of what is not measured."""
    return missing(OUTPUT, TEXT, (HEAD,))


def main() -> None:
    rows = []
    for target in (*TARGETS, *LAVAPIPE):
        try:
            rows.append(row(target))
        except Exception as error:  # glcontext raises bare Exception
            rows.append([target, f"none: {error}", *[""] * (len(HEAD) - 2)])
    OUTPUT.write_text(TEXT.format(table=markdown_table(HEAD, rows)), encoding="utf-8")


if __name__ == "__main__":
    main()
