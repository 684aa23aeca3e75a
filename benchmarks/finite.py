"""Check with 10^8 samples each that all functions of the shader library are finite and >= 0.

    python -m benchmarks.finite

Prints a line for every 2^20 samples, then the total. Takes minutes.
"""

from __future__ import annotations

import sys

from facerender.drawing.context import create_context
from tests.verification.evaluate import Evaluator
from tests.verification.many import GROUPS, MANY, cases_of, faults_of_draw

DRAWS = -(-(10**8) // MANY)


def main() -> int:
    evaluator = Evaluator(create_context("egl").gl)
    for seed in range(DRAWS):
        found = faults_of_draw(evaluator, seed)
        print(f"seed {seed}:", *(found or ["no error"]), sep="\n" if found else " ", flush=True)
        if found:
            return 1
    count = sum(len(cases_of(group)) for group in GROUPS)
    print(f"{DRAWS * MANY:,} samples of each of {count} expressions: no error")
    return 0


if __name__ == "__main__":
    sys.exit(main())
