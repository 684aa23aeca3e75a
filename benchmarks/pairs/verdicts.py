"""Score facerender's comparison at its defaults, and other tools, on the pairs of a suite.

python -m benchmarks.pairs.verdicts SUITE -o docs/measurements/pairs.json
python -m benchmarks.pairs.verdicts SUITE --peers -o docs/measurements/pairs_peers.json

The first command prints facerender's wrong verdicts. It judges each pair twice: as the files are,
and without their metadata, which name the driver. A pair that facerender cannot compare counts as
different. Two kinds of pairs are excluded: identical pixels, and changes that must fail but
whose effect is below the noise of the encoding. The other tools give numbers that grow with the
difference. Each tool gets the threshold that scores best on the pairs of a group and format, on
which it is also scored. The group "tune" is left out. ``benchmarks/pairs/peers.py`` lists the
packages that the tools need.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.pairs.peers import PEERS, present
from benchmarks.pairs.suite import INDEX, WORKERS, read_pairs
from facerender import __version__
from facerender.comparison.compare import compare
from facerender.errors import FacerenderWarning, InputError
from facerender.images.files import read_image
from facerender.images.image import ImageData
from facerender.system.files import write_text
from tests.verification.pairs.changes import Format, Must
from tests.verification.pairs.draw import Pair
from tests.verification.pairs.scenes import Group

FACERENDER = "facerender compare"
UNNAMED = "facerender compare, files without metadata"
OWN = (FACERENDER, UNNAMED)
GROUPS: tuple[Group, ...] = ("tune", "report", "judge")
FORMATS: tuple[Format, ...] = ("png", "exr", "jpeg")

Differences = Mapping[str, float]


@dataclass(frozen=True)
class Judged:
    """A pair and each judge's number; a judge is facerender or a metric of another tool."""

    pair: Pair
    differences: Differences


@dataclass(frozen=True)
class Score:
    """The score of a judge on the pairs of a group and a format.

    A pair counts as different if the judge's number is above the threshold.
    """

    judge: str
    group: Group
    format: Format
    threshold: float
    caught: int
    must_fail: int
    alarms: int
    must_pass: int

    @property
    def balanced(self) -> float:
        """Balanced accuracy: the mean of the fractions of both kinds that are judged right."""
        return 0.5 * (self.caught / self.must_fail + 1.0 - self.alarms / self.must_pass)


@dataclass(frozen=True)
class Tally:
    """The number of a change's pairs, and the number that one of OWN found different."""

    judge: str
    change: str
    must: Must
    group: Group
    format: Format
    different: int
    pairs: int


@dataclass(frozen=True)
class Summary:
    """The versions of the tools by name, with all scores and tallies."""

    versions: Mapping[str, str]
    scores: tuple[Score, ...]
    tallies: tuple[Tally, ...]


def counted(pairs: Iterable[Pair]) -> list[Pair]:
    """Return the pairs that count: not identical, and above the noise if they must fail."""
    return [
        pair for pair in pairs if not pair.identical and (pair.above_floor or pair.must == "pass")
    ]


def score(threshold: float, judged: Sequence[Judged], judge: str) -> Score:
    """Score a judge with a threshold on pairs of one group and format."""
    fails = np.array([each.pair.must == "fail" for each in judged])
    above = np.array([each.differences[judge] > threshold for each in judged])
    return Score(
        *(judge, judged[0].pair.group, judged[0].pair.format, threshold),
        caught=int((above & fails).sum()),
        must_fail=int(fails.sum()),
        alarms=int((above & ~fails).sum()),
        must_pass=int((~fails).sum()),
    )


def best(judged: Sequence[Judged], judge: str) -> Score:
    """Return the score at the threshold with the best balanced accuracy on these pairs."""
    values = np.unique([each.differences[judge] for each in judged])
    between = 0.5 * (values[1:] + values[:-1])
    scores = (score(float(each), judged, judge) for each in (*between, values[-1]))
    return max(scores, key=lambda found: found.balanced)


def own(out: Path, pair: Pair) -> Differences:
    """Compare a pair as ``facerender compare`` does, with and without the files' metadata."""
    images = [read_image(out / each) for each in (pair.golden, pair.image)]
    bare = [replace(each, metadata={}) for each in images]
    return {
        name: float(_different(*files)) for name, files in zip(OWN, (images, bare), strict=True)
    }


def _different(golden: ImageData, image: ImageData) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FacerenderWarning)  # of JPEG
        try:
            return not compare(golden, image)
        except InputError:
            return True


def of_peers(names: Sequence[str], out: Path, pair: Pair) -> Differences:
    """Measure a pair with the named tools that support its format."""
    found: dict[str, float] = {}
    for peer in PEERS:
        if peer.name in names and pair.format in peer.formats:
            found |= peer.measure(out / pair.golden, out / pair.image)
    return {judge: float(f"{value:.6g}") for judge, value in found.items()}


def judge(pairs: Sequence[Pair], ask: Callable[[Pair], Differences]) -> list[Judged]:
    """Measure all pairs in parallel."""
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        return [Judged(*each) for each in zip(pairs, pool.map(ask, pairs), strict=True)]


def tallies(judged: Sequence[Judged]) -> list[Tally]:
    """Count the pairs of each change that facerender found different."""
    found: dict[tuple[str, str, Must, Group, Format], list[bool]] = {}
    for each in judged:
        about = each.pair.change, each.pair.must, each.pair.group, each.pair.format
        for name in OWN:
            found.setdefault((name, *about), []).append(each.differences[name] > 0.5)
    return [Tally(*about, sum(each), len(each)) for about, each in found.items()]


def scores(judged: Sequence[Judged]) -> Iterator[Score]:
    """Score every judge on each group and format: facerender by its verdict, others at their best
    threshold."""
    for group, kind in product(GROUPS, FORMATS):
        found = [each for each in judged if (each.pair.group, each.pair.format) == (group, kind)]
        for judge in dict.fromkeys(name for each in found for name in each.differences):
            how = partial(score, 0.5) if judge in OWN else best
            yield how(found, judge)


def read_summary(path: Path) -> Summary:
    """Read a file of :func:`write_summary`."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return Summary(
        content["versions"],
        tuple(Score(**each) for each in content["scores"]),
        tuple(Tally(**each) for each in content["tallies"]),
    )


def write_summary(path: Path, summary: Summary) -> None:
    write_text(path, json.dumps(asdict(summary), indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pairs.verdicts", description=__doc__
    )
    parser.add_argument("suite", type=Path)
    parser.add_argument("--peers", action="store_true", help="score the other tools instead")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.json")
    given = parser.parse_args()
    pairs = counted(read_pairs(given.suite / INDEX))
    if given.peers:
        versions = {peer.name: found for peer, found in present()}
        pairs = [pair for pair in pairs if pair.group != "tune"]
        judged = judge(pairs, partial(of_peers, [*versions], given.suite))
        counts = []
    else:
        versions = {FACERENDER: f"facerender {__version__}"}
        judged = judge(pairs, partial(own, given.suite))
        counts = tallies(judged)
        for each, name in product(judged, OWN):
            if (each.differences[name] > 0.5) != (each.pair.must == "fail"):
                print(
                    "missed" if each.pair.must == "fail" else "alarm", each.pair.image, f"({name})"
                )
    write_summary(given.output, Summary(versions, tuple(scores(judged)), tuple(counts)))


if __name__ == "__main__":
    main()
