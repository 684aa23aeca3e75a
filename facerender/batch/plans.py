"""Plans of a batch: made by workers, written to its folder, found there again, and what they save.
Which jobs share one is told in ``groups.py``, how it is made in ``planner.py``. No OpenGL here."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from facerender.batch.chunk import Settings
from facerender.batch.driver import carried
from facerender.batch.engine import Engine
from facerender.batch.groups import Group, Groups
from facerender.batch.place import Place
from facerender.batch.supervisor import plan_group
from facerender.batch.tables import Table

PLANS = "plans"
_TOLD = 10  # groups that have a line each

Facts = dict[str, Any]
Say = Callable[[str], object]


@dataclass(frozen=True)
class Plans:
    """What was planned for a batch.

    Attributes
    ----------
    of : by number of the group, tables of each of its jobs
    about : how many groups and jobs are planned, and an estimate of what that saves
    """

    of: dict[int, Table]
    about: Facts


def planned(
    groups: Groups,
    place: Place,
    settings: Settings,
    engine: Callable[[], Engine],
    again: bool,
    say: Say,
) -> Plans:
    """Plan the groups that have no plan in the batch's folder, and write it there.

    A group whose planner dies, as often as a job may, or that cannot be planned is drawn exactly;
    that is written as well, so that a second run draws the same.

    Parameters
    ----------
    engine : called where there is something to plan
    again : whether what could not be planned is tried again
    say : is told of the first groups, those first that could not be planned, and of the others
        together

    Raises
    ------
    CannotDraw : nothing can be drawn or written
    FacerenderError : as of :func:`facerender.batch.driver.run`
    """
    found = {number: _read(place, group, again) for number, group in groups.of.items()}
    left = [group for number, group in groups.of.items() if found[number] is None]
    spent = 0.0
    if left:
        say(f"plans: {len(left)} to make")
        for group, facts in carried(engine(), plan_group, settings, iter(left)):
            place.put(_path(group), json.dumps(facts, indent=1).encode() + b"\n")
            found[group.number] = facts
            spent += facts.get("seconds", 0.0)
    known = {number: facts for number, facts in found.items() if facts is not None}
    told = sorted(groups.of.values(), key=lambda group: "error" not in known[group.number])
    for group in told[:_TOLD]:
        say(_line(group, known[group.number]))
    if rest := [known[group.number] for group in told[_TOLD:]]:
        exact = sum("planned" not in facts for facts in rest)
        say(f"plans: {len(rest)} groups more, {exact} of them drawn exactly")
    if groups.few:
        say(
            f"plans: {groups.few} jobs are drawn exactly: a plan pays from {groups.fewest} jobs "
            f"that differ in their cameras alone, which these, of {groups.groups_of_few} kinds, "
            "are not"
        )
    if groups.unserved:
        say(f"plans: {groups.unserved} jobs are drawn exactly: a plan is of image, without layers")
    of = {
        number: {key: facts[key] for key in ("shading", "planned")}
        for number, facts in known.items()
        if "planned" in facts
    }
    return Plans(of, _about(groups, known, spent))


def text(about: Facts) -> str:
    """Return in words what plans have saved, for the end of a line."""
    share, seconds = about["share_saved"], about["seconds_saved"]
    return (
        f"plans serve {about['jobs']} of {about['jobs_of_batch']} jobs and save an estimated "
        f"{100.0 * share:.0f} % of the drawing, {seconds:.0f} s of a worker, for "
        f"{about['seconds_planning']:.0f} s of planning"
    )


def _path(group: Group) -> str:
    return f"{PLANS}/{group.name}.json"


def _read(place: Place, group: Group, again: bool) -> Facts | None:
    try:
        facts: Facts = json.loads(place.get(_path(group)))
    except FileNotFoundError:
        return None
    return None if again and "error" in facts else facts


def _line(group: Group, facts: Facts) -> str:
    if "planned" not in facts:
        why = facts.get("error") or facts["exact"]
        return f"{group}: drawn exactly: {why}"
    return (
        f"{group}: errs by {facts['error']} of {facts['limit']} at {facts['cameras']} cameras, "
        f"saves {100.0 * _saved(facts):.0f} % of a frame"
    )


def _saved(facts: Facts) -> float:
    """The share of a frame that a plan saves."""
    return 1.0 - facts["drawn"] / facts["full"] if "planned" in facts else 0.0


def _about(groups: Groups, known: dict[int, Facts], spent: float) -> Facts:
    """What the plans of a batch come to."""
    served = [(groups.of[number], facts) for number, facts in known.items() if "planned" in facts]
    jobs = sum(group.jobs for group in groups.of.values()) + groups.few + groups.unserved
    return {
        "jobs": sum(group.jobs for group, _ in served),
        "jobs_of_batch": jobs,
        "groups": len(served),
        "share_saved": sum(group.jobs * _saved(facts) for group, facts in served) / jobs,
        "seconds_saved": sum(
            group.jobs * (facts["full"] - facts["drawn"]) for group, facts in served
        ),
        "seconds_planning": sum(facts.get("seconds", 0.0) for facts in known.values()),
        "seconds_planning_now": spent,
        "how": "frames of a sample of each group's cameras drawn in turns with its plan and "
        "without; a full frame of any job counts as much as another's",
    }
