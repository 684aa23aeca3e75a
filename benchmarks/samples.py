"""Test every public function of the shader library with random samples, on one or more targets.

    python -m benchmarks.samples COUNT [TARGET ...]      for example: 1e9 "WGSL, Vulkan"

Checks that all values are finite and >= 0, that BRDFs are exactly 0 below the surface, and that
terms are within the error bounds of their headers. Default: all targets. All targets use the same
samples and share the float64 reference values. COUNT is the minimum number of samples for each of
the two kinds of checks: finite values, and error bounds. Prints the progress every minute. Stops
with exit status 1 after a round with errors.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from threading import Lock

import numpy as np

from facerender.scene.shading import Term
from tests.verification.cases import Case, Each, brdf_case, singles
from tests.verification.climb import VARIANTS, slopes_of
from tests.verification.evaluate import Inputs
from tests.verification.many import GROUPS, MANY, Random, cases_of, faults
from tests.verification.targets import LAVAPIPE, TARGETS, Remote

SLOPES = 256  # values of m per round in comparisons with float64


class Count:
    """The results of a target, collected from several threads.

    Attributes
    ----------
    finite, bounded : number of samples checked for finite values, and for error bounds
    worst : largest error as a fraction of its bound, and its term
    errors : messages
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.finite, self.bounded = 0, 0
        self.worst = 0.0, ""
        self.errors: list[str] = []

    def __str__(self) -> str:
        share, term = self.worst
        return (
            f"{self.finite:.3e} samples, {len(self.errors)} errors; {self.bounded:.3e} samples, "
            f"largest error {share:.3f} of the bound: {term}"
        )

    def check_values(self, target: Each, group: str, inputs: Inputs) -> None:
        """Check that values are finite, not negative, and 0 below the surface."""
        tried = cases_of(group)
        found = faults(target, tried, inputs)
        with self._lock:
            self.errors += found
            self.finite += len(tried) * len(inputs["n"])

    def compare(self, target: Each, case: Case, name: str) -> None:
        """Compare a case with float64, and check its error bound."""
        result = target.each(case.prelude, [case.expression], case.inputs)[0]
        fault, share = case.fault(result), float(case.share(result).max())
        with self._lock:
            self.errors += [f"{name}: {fault}"] * bool(fault)
            self.worst = max(self.worst, (share, name))
            self.bounded += len(result)


def bounded(term: Term, f0: float, inputs: Inputs, seed: int) -> Case:
    """Return the case of a term at the inputs' directions, with SLOPES values of m.

    Few values of m put many samples near each value's peak.
    """
    random = np.random.default_rng(seed)
    low, high = map(math.log, slopes_of(term))
    few = singles(np.exp(random.uniform(low, high, SLOPES)))
    slopes = random.choice(few, len(inputs["n"]))
    return brdf_case(term, {**{axis: inputs[axis] for axis in "nlv"}, "m": slopes}, f0=f0)


def draw(counts: Mapping[Remote, Count], seed: int, wanted: float) -> Iterator[None]:
    """Check MANY samples of each expression on all cores, and yield after each expression or group.

    Skips a kind of check that has reached the wanted number of samples.
    """
    inputs = Random(seed, MANY).inputs()

    def compare(variant: tuple[Term, float]) -> None:
        case = bounded(*variant, inputs, seed)
        for target, count in counts.items():
            count.compare(target, case, "{}, f0 = {}".format(*variant))

    def check_values(group: str) -> None:
        for target, count in counts.items():
            count.check_values(target, group, inputs)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        if min(count.bounded for count in counts.values()) < wanted:
            yield from pool.map(compare, VARIANTS)
        if min(count.finite for count in counts.values()) < wanted:
            yield from pool.map(check_values, GROUPS)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.samples", description=__doc__)
    parser.add_argument("count", type=float, metavar="COUNT", help="for example 1e9")
    known = [*TARGETS, *LAVAPIPE]
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"one of {', '.join(known)}")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="first seed (0)")
    given = parser.parse_args()
    if unknown := set(given.targets).difference(known):
        parser.error(f"unknown target {', '.join(unknown)}: choose from {', '.join(known)}")
    with ExitStack() as stack:
        counts = {stack.enter_context(Remote(name)): Count() for name in given.targets or known}
        last = time.monotonic()
        for seed in itertools.count(given.first):
            for _ in draw(counts, seed, given.count):
                if time.monotonic() > last + 60.0:
                    last = print_counts(counts, seed)
            print_counts(counts, seed)
            if any(count.errors for count in counts.values()):
                return 1
            if all(min(count.finite, count.bounded) >= given.count for count in counts.values()):
                break
    return 0


def print_counts(counts: Mapping[Remote, Count], seed: int) -> float:
    """Print the results of all targets so far; return the time."""
    for target, count in counts.items():
        print(f"{target.name}, seed {seed}: {count}", *count.errors, sep="\n", flush=True)
    return time.monotonic()


if __name__ == "__main__":
    sys.exit(main())
