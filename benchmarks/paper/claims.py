"""The claims of Romanyuk et al. (2020) and their measurements: the error of D16, and the speed of
D16 in scalar code, in GLSL and according to AMD's compiler. ``pricing/cost.py`` measures costs."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.prices import amd
from facerender import lobes
from facerender.brdf import K_COOK_TORRANCE, K_WARD
from facerender.drawing.context import Backend
from facerender.errors import NotMeasured
from facerender.lobes import AnyLobe
from facerender.measure.measurement import MODELS, lobe_error
from facerender.pricing.cost import (
    OF_COSINE,
    OF_VECTORS,
    PRINTED_D16,
    QUANTILE,
    Interval,
    Variant,
    bootstrap,
    by_slope,
)

Verdict = Literal["holds", "fails", "undecided", "not measured", "for comparison"]

SLOPES = (0.2, 0.3, 0.4, 0.5, 0.6)  # values of m in the paper
ERROR_SLOPES = (0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6)
PEAK = "in % of the peak, 0 to 90 degrees; clamped; float64"
D16_ERROR = 1.3  # percent; claimed: "does not exceed"
SCALAR_SPEED = 4.34  # claimed speed-up of D16 alone on a CPU
WHOLE_SPEED = 2.0  # claimed speed-up of the whole model: "more than"
_WHOLE_PAPER = f"more than {WHOLE_SPEED:g} times as fast"
FLAGS = ("-O2", "-fno-tree-vectorize")  # scalar code: gcc vectorises some loops at -O2
DEGREES = np.linspace(0.0, 90.0, 9001)
COSINES = np.cos(np.radians(DEGREES)).clip(0.0, 1.0)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and its measurement.

    Attributes
    ----------
    claim, paper, measured, conditions : texts for the report; paper is the paper's number
    verdict : a claim of speed holds if the whole 95 % interval is at or above the paper's number,
        and is undecided if the interval contains it
    where : the range of m in which the claim holds, or the reason for a missing measurement
    values : the numbers in "measured"
    """

    claim: str
    paper: str
    measured: str
    conditions: str
    verdict: Verdict
    where: str = ""
    values: Mapping[str, float] = field(default_factory=dict)


# --- errors --------------------------------------------------------------------------------------


def exact_lobe(m: float, k: int = K_COOK_TORRANCE) -> NDArray[np.float64]:
    """Return the exact lobe at DEGREES, relative to its peak."""
    return lobes.exact(COSINES, m, k)


def relative_error(name: str, m: float, down_to: float, k: int = K_COOK_TORRANCE) -> float:
    """Return the largest |lobe - exact|/exact in percent, over the angles at which the exact lobe
    is at least the fraction ``down_to`` of its peak.

    Raises
    ------
    InputError : m is outside the domain of the lobe
    """
    end = np.interp(-down_to, -exact_lobe(m, k), DEGREES)
    degrees = np.linspace(0.0, end, 1001)
    exact = lobes.exact(np.cos(np.radians(degrees)), m, k)
    return 100.0 * float((np.abs(lobe_error(name, m, k, degrees)) / exact).max())


def peak_error(name: AnyLobe, m: float, k: int) -> float:
    """Return the largest |lobe - exact| in percent of the peak, over 0 to 90 degrees."""
    return 100.0 * float(np.abs(lobe_error(name, m, k)).max())


def error_claims(slopes: Sequence[float] = ERROR_SLOPES) -> list[Claim]:
    """Test the claim "the relative error does not exceed 1.3 %".

    The paper makes it in its section on Ward, about exp(-tan^2(gamma)/m^2) approximated with
    g = 16. The same errors of Cook-Torrance's D are listed for comparison.
    """
    errors: dict[str, Callable[[float, int], float]] = {
        PEAK: partial(peak_error, "d16"),
        "relative to the lobe, down to a tenth of its peak; clamped; float64": (
            lambda m, k: relative_error("d16", m, 0.1, k)
        ),
        "in % of the peak, 0 to 90 degrees; as printed, without a clamp; float64": (
            partial(peak_error, PRINTED_D16)
        ),
    }
    claims = []
    for k, title in ((K_WARD, "Ward"), (K_COOK_TORRANCE, "Cook-Torrance")):
        for conditions, error in errors.items():
            values = {f"{m:g}": error(m, k) for m in slopes}
            inside = [m for m in np.linspace(0.1, 0.7, 601) if error(m, k) <= D16_ERROR]
            where = f"from {inside[0]:.3f} to {inside[-1]:.3f}" if inside else "nowhere"
            verdict: Verdict = "holds" if max(values.values()) <= D16_ERROR else "fails"
            claims.append(
                Claim(
                    f"{title}, lobe alone: error of D16",
                    f"at most {D16_ERROR:g} %" if k == K_WARD else "",
                    f"{', '.join(f'{value:.3g}' for value in values.values())} % "
                    f"at m = {', '.join(values)}",
                    conditions,
                    verdict if k == K_WARD else "for comparison",
                    f"of m = 0.1 to 0.7, at most {D16_ERROR:g} % {where}",
                    values,
                )
            )
    return claims


# --- cost ----------------------------------------------------------------------------------------


def scalar_cost(repeats: int) -> tuple[dict[str, Interval], str]:
    """Compile ``scalar.c`` with the C compiler of the system, and measure it.

    Returns
    -------
    nanoseconds per evaluation by function name, and the compiler with its flags

    Raises
    ------
    NotMeasured : the compiler is missing or fails
    """
    source = str(Path(__file__).with_name("scalar.c"))
    with TemporaryDirectory() as folder:
        program = os.path.join(folder, "scalar")
        try:
            _output("cc", *FLAGS, source, "-o", program, "-lm")
            compiler = _output("cc", "--version").splitlines()[0]
            names, _, *rows = _output(program, str(repeats)).splitlines()
        except (OSError, subprocess.SubprocessError) as error:
            raise NotMeasured(f"needs the apt packages gcc and libc6-dev ({error})") from None
    times = np.array([row.split() for row in rows], dtype=np.float64)
    intervals = bootstrap(lambda turns: np.quantile(times[turns], QUANTILE, axis=0), repeats)
    return dict(zip(names.split(), intervals, strict=True)), f"{compiler}, {' '.join(FLAGS)}"


def _output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def scalar_claims(cost: Mapping[str, Interval], where: str) -> list[Claim]:
    """Test the claim "4.34 times faster" for scalar code; not measured if ``cost`` is empty."""
    title, paper = "D16 against D, scalar on a CPU", f"{SCALAR_SPEED:g} times as fast"
    if not cost:
        return [Claim(title, paper, "", "", "not measured", where)]
    claims = [
        speed_claim(title, cost[exact], cost[d16], f"{how}; {where}", paper, SCALAR_SPEED)
        for exact, d16, how in (
            ("printed_each", "d16_each", "as printed, an m for each cosine"),
            ("printed_one", "d16_one", "as printed, one m for all"),
            ("printed_one", "d16_beforehand", "one m, in D16 no division left"),
        )
    ]
    ours = "D with one division against D as printed, scalar"
    conditions = f"an m for each cosine; {where}"
    return [*claims, speed_claim(ours, cost["printed_each"], cost["exact_each"], conditions)]


@dataclass(frozen=True)
class Contest:
    """A comparison of three forms of a whole model or of its lobe alone: exact as published, D16 as
    published, and exact as in the library."""

    model: str
    whole: bool

    @property
    def title(self) -> str:
        """Name of the timed expression."""
        return f"{MODELS[self.model]}, {'whole term' if self.whole else 'lobe alone'}"

    @property
    def forms(self) -> dict[str, tuple[str, str]]:
        """GLSL prelude and expression of each form, by name."""
        variants = (
            Variant(self.model, "exact", printed=True),
            Variant(self.model, "d16", printed=True),
            Variant(self.model, "exact"),
        )
        return {form.name: form.term if self.whole else form.lobe_term for form in variants}

    def claims(
        self, costs: Mapping[str, Interval], conditions: str, unit: str = "ns"
    ) -> list[Claim]:
        """Test the claim "more than twice as fast" for the whole model.

        The lobe alone and the exact form of the library are listed for comparison. ``costs`` gives
        the cost of each form by name.
        """
        printed, d16, ours = (costs[name] for name in self.forms)
        paper, needed = (_WHOLE_PAPER, WHOLE_SPEED) if self.whole else ("", None)
        against = f"{self.title}: our exact against exact as printed"
        return [
            speed_claim(self._d16, printed, d16, conditions, paper, needed, unit),
            speed_claim(against, printed, ours, conditions, unit=unit),
        ]

    def not_measured(self, conditions: str, reason: str) -> Claim:
        """Return the claim of the whole model as not measured."""
        return Claim(self._d16, _WHOLE_PAPER, "", conditions, "not measured", reason)

    @property
    def _d16(self) -> str:
        return f"{self.title}: D16 against exact, as printed"


def glsl_cost(
    repeats: int, backend: Backend, progress: Callable[[float], object] = lambda done: None
) -> dict[Contest, dict[str, Interval]]:
    """Measure the whole models and the lobes alone; ``progress`` as in :func:`by_slope`."""
    contests = [Contest(model, whole) for whole in (True, False) for model in MODELS]
    empty = {True: OF_VECTORS, False: OF_COSINE}
    costs = {}
    for number, contest in enumerate(contests):

        def step(done: float, before: int = number) -> None:
            progress((before + done) / len(contests))

        costs[contest] = by_slope(contest.forms, empty[contest.whole], repeats, backend, step)
    return costs


def amd_claims() -> list[Claim]:
    """Test the claim "more than twice as fast" with the estimates of AMD's compiler."""
    claims = []
    for contest in (Contest(model, whole=True) for model in MODELS):
        for family in amd.FAMILIES:
            try:
                rows = amd.statistics(contest.forms, family)
            except NotMeasured as error:
                claims.append(contest.not_measured(family, str(error)))
                continue
            cycles = {form: Interval(*3 * (row.inverse_throughput,)) for form, row in rows.items()}
            where = f"{family}, estimated by the compiler of {amd.driver()}"
            claims += contest.claims(cycles, where, "cycles")
    return claims


def speed_claim(
    title: str,
    slow: Interval,
    fast: Interval,
    conditions: str,
    paper: str = "",
    needed: float | None = None,
    unit: str = "ns",
) -> Claim:
    """Compare the ratio of two costs with ``needed``, the paper's ratio, if given.

    The bounds of the ratio combine the opposite bounds of both costs.
    """
    least = 1e-9  # because of noise, a net cost may be zero or negative
    ratio = slow.value / max(fast.value, least)
    low, high = slow.low / max(fast.high, least), slow.high / max(fast.low, least)
    verdict: Verdict = "for comparison"
    if needed is not None:
        verdict = "holds" if low >= needed else "fails" if high < needed else "undecided"
    return Claim(
        title,
        paper,
        f"{ratio:.2f} times ({low:.2f} to {high:.2f}): "
        f"{slow.value:.3g} and {fast.value:.3g} {unit}",
        conditions,
        verdict,
        values={"ratio": ratio, "low": low, "high": high},
    )
