"""Plans a group of jobs at some of its cameras and checks the plan at all of its sample: what a
worker does, with OpenGL."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.batch.groups import Group
from facerender.drawing.renderer import Renderer
from facerender.job import Job
from facerender.planning.budget import Budget, highest_but
from facerender.planning.drawn import Place, draw
from facerender.planning.plan import Plan, plan
from facerender.scenes.camera import Camera
from facerender.scenes.file import scene_value
from facerender.scenes.mesh import Mesh
from facerender.scenes.planned import LevelOfDetail
from facerender.scenes.scene import Scene

_FIRST = 6  # cameras that are planned at
_JOINING = 4  # that break a plan, and are planned at as well then
_ROUNDS = 4
# Of the budget, what plans are made and checked with: cameras of no sample err more. Of 200 such, 6
# were over a budget of 1/255 at 99 % of the pixels, by up to a third, where 64 were just within it.
_LIMIT, _SPARED = 0.75, 0.5


def planned(group: Group, mesh: Mesh, renderer: Renderer) -> Iterator[dict[str, Any]]:
    """Plan a group, and yield what is known so far, at last the plan.

    A plan is made at cameras far from each other, and then drawn beside the full frame at the
    others; those where it is over the budget are planned at as well. All that with a budget that
    is tighter than what was asked for.

    Yields
    ------
    "seconds" that it took; and at last "exact", why all is drawn exactly, or "shading" and
    "planned", tables of a job, with "limit" and "error", the largest one that counts, both of what
    was asked for, "cameras", how many it was measured at, "text", the plan in words, "full" and
    "drawn", seconds of a frame without and with it

    Raises
    ------
    InputError : as of :func:`facerender.planning.plan.plan`
    """
    began = time.perf_counter()
    job = Job.from_dict(group.tables)
    scene = job.scene(mesh)
    cameras = [_camera(table) for table in group.cameras]
    asked = Budget.parse(group.budget, group.exposure, group.within)
    tight = replace(asked, limit=_LIMIT * asked.limit, within=1.0 - _SPARED * (1.0 - asked.within))
    inside = _far_apart(cameras, _FIRST)
    for _ in range(_ROUNDS):
        found = plan(
            scene,
            _given(tight),
            full=job.shading,
            cameras=[cameras[index] for index in inside],
            within=tight.within,
            exposure=group.exposure,
            renderer=renderer,
        )
        yield _told(began)
        if found.planned is None:
            yield _told(began, exact=f"nothing cheaper is within it at {len(inside)} cameras")
            return
        errors, times, broken = [], [], []
        # Those that it was not planned at come first: they are the likelier ones to break it.
        for index in sorted(range(len(cameras)), key=lambda index: index in inside):
            seen, covered, seconds = _compared(found, scene, cameras[index], renderer)
            errors.append(highest_but(seen, asked.spared(covered)))
            times.append(seconds)
            if highest_but(seen, tight.spared(covered)) > tight.limit:
                broken.append(index)
                if len(broken) == _JOINING:
                    break
            yield _told(began)
        if not broken:
            full, drawn = np.mean(times, axis=0).tolist()
            yield _told(
                began,
                shading=found.shading.as_dict(),
                planned={
                    name: value
                    for name, value in asdict(found.planned).items()
                    if value is not None
                },
                text=found.explain(),
                limit=asked.text(asked.limit),
                error=asked.text(max(errors)),
                cameras=len(cameras),
                full=full,
                drawn=drawn,
            )
            return
        inside = sorted({*inside, *broken})
    yield _told(began, exact=f"{_ROUNDS} plans were over it at cameras that they were not made at")


def _told(began: float, **facts: Any) -> dict[str, Any]:
    return {**facts, "seconds": time.perf_counter() - began}


def _given(budget: Budget) -> str | float:
    """A budget as a plan reads it."""
    if budget.unit == "display":
        return budget.limit
    return f"{100.0 * budget.limit}%" if budget.unit == "relative" else f"{budget.limit} flip"


def _camera(table: Any) -> Camera:
    camera: Camera = scene_value("camera", table)
    return camera


def _compared(
    found: Plan, scene: Scene, camera: Camera, renderer: Renderer
) -> tuple[NDArray[np.float64], int, tuple[float, float]]:
    """Draw a camera without and with a plan, and return the error of each pixel, how many are
    covered, and the seconds."""
    assert found.planned is not None
    place = Place(replace(scene, camera=camera), renderer)
    starts = [time.perf_counter()]
    images: list[NDArray[np.float64]] = []
    finest = LevelOfDetail(renderer.samples, None)
    for shading, detail in (found.full, finest), (found.shading, found.planned.detail):
        images.append(draw(place, shading, detail).astype(np.float64))
        starts.append(time.perf_counter())
    full, drawn = images
    errors = found.budget.errors(drawn[..., :3], full[..., :3])
    seconds = starts[1] - starts[0], starts[2] - starts[1]
    return errors, int(np.count_nonzero(full[..., 3])), seconds


def _far_apart(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return indices of cameras, each the farthest from those before it, where the range of each of
    their numbers counts as much as another's."""
    numbers = np.array([_numbers(camera) for camera in cameras])
    extent = np.ptp(numbers, axis=0)
    places = numbers / np.where(extent > 0.0, extent, 1.0)
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    nearest = np.full(len(places), np.inf)
    while len(chosen) < min(count, len(places)):
        distances = np.linalg.norm(places - places[chosen[-1]], axis=1)
        nearest = np.minimum(nearest, distances)
        chosen.append(int(np.argmax(nearest)))
    return chosen


def _numbers(camera: Camera) -> list[float]:
    """Where it looks from, as a direction, and its other numbers."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    eye = [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth)]
    points = [*(camera.target or (0.0,) * 3), *(camera.position or (0.0,) * 3)]
    pose = np.ravel(np.zeros((3, 4)) if camera.extrinsics is None else camera.extrinsics).tolist()
    return [*map(float, eye), camera.fov, float(np.log(camera.zoom)), *points, *pose]
