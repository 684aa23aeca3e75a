"""Jobs that differ in their cameras alone: which of them a plan can serve, how many there are, and
a sample of their cameras. Plans themselves are told in ``plans.py``. No OpenGL here."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from facerender.batch.chunk import digest_of, hash_of, painter, sources, with_contents
from facerender.batch.jobs import Row
from facerender.batch.tables import Table

CAMERAS = 64  # of a group's sample
# A plan takes as long as some 500 frames: 300 of it for a few cameras (170 to 480 were measured), 3
# for each of the sample, which is drawn twice and compared. Plans have saved half of a frame at
# most, so that fewer jobs cannot pay for one.
FEWEST = round((300 + 3 * CAMERAS) / 0.5)
MOST = 1000  # plans of a batch, so that the cameras of all samples fit in memory

_encode = json.JSONEncoder(sort_keys=True).encode


@dataclass(frozen=True)
class Group:
    """Jobs that differ in their cameras alone.

    Attributes
    ----------
    number : see :func:`group_number`
    jobs : how many
    tables : of a job, without its camera
    exposure : of 8-bit images, in stops
    cameras : a sample of theirs, in an order that is that of no table
    budget, within : see :class:`facerender.planning.budget.Budget`
    """

    number: int
    jobs: int
    tables: Table
    exposure: float
    cameras: tuple[Table, ...]
    budget: str
    within: str

    def __str__(self) -> str:
        mesh = self.tables.get("mesh", {}).get("path") or "the built-in head"
        return f"plan of {mesh}, {self.jobs} jobs"

    @property
    def name(self) -> str:
        """A digest of all that its plan depends on but the driver."""
        facts = [with_contents(self.tables), self.exposure, self.cameras, self.budget, self.within]
        return digest_of(painter(), _planner(), _encode(facts))


@dataclass(frozen=True)
class Groups:
    """The groups of a batch that may pay for a plan.

    Attributes
    ----------
    of : by number
    fewest : jobs that pay
    few, groups_of_few : jobs of other groups, and how many these are
    unserved : jobs that no plan serves
    """

    of: dict[int, Group]
    fewest: int
    few: int
    groups_of_few: int
    unserved: int


def grouped(rows: Callable[[], Iterable[Row]], budget: str, within: str) -> Groups:
    """Find the groups that may pay for a plan; the rows are read twice, and 16 bytes of each kept.

    The sample depends on the cameras alone, not on the order of the jobs: those with the smallest
    digests.
    """
    numbers, cameras, unserved = array("Q"), array("Q"), 0
    for row in rows():
        if serves(row):
            numbers.append(group_number(row))
            cameras.append(hash_of(_camera(row)))
        else:
            unserved += 1
    wanted, counts = _sampled(np.asarray(numbers), np.asarray(cameras))
    known, counted = np.unique(np.asarray(numbers), return_counts=True)
    few = ~np.isin(known, np.fromiter(wanted, np.uint64, len(wanted)))
    found: dict[int, dict[int, Table]] = {number: {} for number in wanted}
    examples: dict[int, Row] = {}
    for row in rows() if wanted else ():
        if serves(row) and (number := group_number(row)) in wanted:
            examples.setdefault(number, row)
            if (camera := hash_of(_camera(row))) in wanted[number]:
                found[number].setdefault(camera, row.tables.get("camera", {}))
    of = {
        number: Group(
            number,
            counts[number],
            {key: value for key, value in row.tables.items() if key != "camera"},
            row.exposure,
            tuple(found[number][camera] for camera in sorted(found[number])),
            budget,
            within,
        )
        for number, row in examples.items()
    }
    return Groups(of, FEWEST, int(counted[few].sum()), int(few.sum()), unserved)


def serves(row: Row) -> bool:
    """Tell whether a plan may serve a job: it is proven of the image on a display alone, not of the
    numbers in layers.exr, which have an image of their own."""
    return "image" in row.passes and "layers" not in row.passes


def group_number(row: Row) -> int:
    """Return a digest of what jobs of a group share."""
    rest = {key: value for key, value in row.tables.items() if key != "camera"}
    return hash_of(_encode([rest, row.exposure]))


def with_plans(rows: Iterable[Row], plans: dict[int, Table]) -> Iterator[Row]:
    """Yield the rows, those of a group with its plan."""
    for row in rows:
        plan = plans.get(group_number(row)) if plans and serves(row) else None
        yield replace(row, plan=plan) if plan else row


def _sampled(
    numbers: np.ndarray, cameras: np.ndarray
) -> tuple[dict[int, set[int]], dict[int, int]]:
    """The digests of the cameras of each group's sample, and how many jobs it has: of the largest
    groups."""
    order = np.lexsort((cameras, numbers))
    numbers, cameras = numbers[order], cameras[order]
    known, starts, counts = np.unique(numbers, return_index=True, return_counts=True)
    largest = np.argsort(-counts, kind="stable")[:MOST]
    chosen = largest[counts[largest] >= FEWEST]
    samples = {
        int(known[at]): set(np.unique(cameras[starts[at] :][: counts[at]])[:CAMERAS].tolist())
        for at in chosen
    }
    return samples, {int(known[at]): int(counts[at]) for at in chosen}


@cache
def _planner() -> str:
    """A digest of what plans."""
    return digest_of(*sources(("planning", "pricing"), ("batch/planner.py",)))


def _camera(row: Row) -> str:
    return _encode(row.tables.get("camera", {}))
