"""Draws random samples of every public function of the shader library, while there is time:
finite, >= 0, BRDFs exactly 0 below the surface, and terms within the bounds of their headers.

python -m benchmarks.samples COUNT [TARGET ...]      such as 1e9 "WGSL, Vulkan"; default: all

Targets share what float64 makes of the samples. COUNT is of samples of each kind, at the least;
what has been seen is printed each minute, and the exit code is 1 after a draw with a fault.
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

from facerender.shading import Term
from tests.verification.cases import Case, Each, brdf_case, singles
from tests.verification.climb import VARIANTS, slopes_of
from tests.verification.evaluate import Inputs
from tests.verification.many import GROUPS, MANY, Random, cases_of, faults
from tests.verification.targets import LAVAPIPE, TARGETS, Remote, groups_of

SLOPES = 256  # of a draw, where they are compared with float64


class Count:
    """What a target has shown, to several threads.

    Attributes
    ----------
    finite, bounded : samples that were looked at, for the one and for the other
    worst : largest share of a bound, and the term that has it
    told : what is wrong
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.finite, self.bounded = 0, 0
        self.worst = 0.0, ""
        self.told: list[str] = []

    def __str__(self) -> str:
        share, term = self.worst
        return (
            f"{self.finite:.3e} samples, {len(self.told)} faults; {self.bounded:.3e} samples, "
            f"{share:.3f} of the bound at most, of {term}"
        )

    def look(self, target: Each, group: str, inputs: Inputs) -> None:
        """Look for what is not finite, negative, or not 0 below the surface."""
        tried = cases_of(group)
        told = faults(target, tried, inputs)
        with self._lock:
            self.told += told
            self.finite += len(tried) * len(inputs["n"])

    def compare(self, target: Each, case: Case, name: str) -> None:
        """Compare with float64."""
        result = target.each(case.prelude, [case.expression], case.inputs)[0]
        fault, share = case.fault(result), float(case.share(result).max())
        with self._lock:
            self.told += [f"{name}: {fault}"] * bool(fault)
            self.worst = max(self.worst, (share, name))
            self.bounded += len(result)


def bounded(term: Term, f0: float, inputs: Inputs, seed: int) -> Case:
    """Return a term at directions of the inputs, at a few slopes: each has a peak to be found."""
    random = np.random.default_rng(seed)
    low, high = map(math.log, slopes_of(term))
    few = singles(np.exp(random.uniform(low, high, SLOPES)))
    slopes = random.choice(few, len(inputs["n"]))
    return brdf_case(term, {**{axis: inputs[axis] for axis in "nlv"}, "m": slopes}, f0=f0)


def draw(counts: Mapping[Remote, Count], seed: int, wanted: float) -> Iterator[None]:
    """Look at MANY samples of each expression, of the kinds of which there have not been enough, on
    all cores; yield now and then."""
    inputs = Random(seed, MANY).inputs()

    def compare(variant: tuple[Term, float]) -> None:
        case = bounded(*variant, inputs, seed)
        for target, count in counts.items():
            count.compare(target, case, "{}, f0 = {}".format(*variant))

    def look(group: str) -> None:
        for target, count in counts.items():
            if group in groups_of(target.name, GROUPS):
                count.look(target, group, inputs)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        if min(count.bounded for count in counts.values()) < wanted:
            yield from pool.map(compare, VARIANTS)
        if min(count.finite for count in counts.values()) < wanted:
            yield from pool.map(look, GROUPS)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.samples", description=__doc__)
    parser.add_argument("count", type=float, metavar="COUNT", help="such as 1e9")
    known = [*TARGETS, *LAVAPIPE]
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(known)}")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="draw to begin with (0)")
    given = parser.parse_args()
    if unknown := set(given.targets).difference(known):
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(known)}")
    with ExitStack() as stack:
        counts = {stack.enter_context(Remote(name)): Count() for name in given.targets or known}
        last = time.monotonic()
        for seed in itertools.count(given.first):
            for _ in draw(counts, seed, given.count):
                if time.monotonic() > last + 60.0:
                    last = tell(counts, seed)
            tell(counts, seed)
            if any(count.told for count in counts.values()):
                return 1
            if all(min(count.finite, count.bounded) >= given.count for count in counts.values()):
                break
    return 0


def tell(counts: Mapping[Remote, Count], seed: int) -> float:
    """Print what has been seen, and return the time."""
    for target, count in counts.items():
        print(f"{target.name}, draw {seed}: {count}", *count.told, sep="\n", flush=True)
    return time.monotonic()


if __name__ == "__main__":
    sys.exit(main())
