"""Measure the shader library's largest error relative to its bound, on each target.

    python -m benchmarks.targets

Writes docs/measurements/targets.json. For an unavailable target, ``renderer`` gives the reason.
"""

from __future__ import annotations

import re
from typing import Any

from benchmarks.data import save
from tests.verification.cases import GROUPS, cases_of, evaluated
from tests.verification.targets import LAVAPIPE, TARGETS, Remote

FIELDS = ("target", "renderer", "version", "functions", "samples", "percent", "case")


def measured(target: str) -> dict[str, Any]:
    """Evaluate all cases on a target; return its largest error in percent of the bound."""
    functions, samples, shares = set(), 0, {}
    with Remote(target) as remote:
        for group in GROUPS:
            cases = cases_of(group)
            for name, result in evaluated(cases, remote).items():
                functions.update(re.findall(r"fr_\w+", cases[name].expression))
                samples += len(result)
                shares[name] = cases[name].share(result).max()
        worst = max(shares, key=shares.__getitem__)
        return {
            "target": target,
            "renderer": remote.renderer,
            "version": remote.version,
            "functions": len(functions),
            "samples": samples,
            "percent": 100.0 * shares[worst],
            "case": worst,
        }


def main() -> None:
    rows = []
    for target in (*TARGETS, *LAVAPIPE):
        try:
            rows.append(measured(target))
        except Exception as error:  # glcontext raises bare Exception
            missing = {"target": target, "renderer": f"none: {error}"}
            rows.append({**dict.fromkeys(FIELDS), **missing})
    save("targets", targets=rows)


if __name__ == "__main__":
    main()
