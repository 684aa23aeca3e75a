"""The cheapest shading that a scene's error budget allows, and what it is based on. Which shadings
there are, how they err and how they are searched is told beside this file; what they cost in
``pricing/table.py``."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import simplify
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.glsl.code import call
from facerender.glsl.library import Target, term_source
from facerender.image import save_png
from facerender.planning.bound import Unbounded, bound
from facerender.planning.budget import ROUNDING, Budget
from facerender.planning.candidates import Constants
from facerender.planning.decisions import Decision, decisions
from facerender.planning.search import Choice, Cost, Drawn, Region, Witnesses, constants_seen
from facerender.scenes.camera import Camera
from facerender.scenes.file import scene_toml
from facerender.scenes.scene import Scene, slope_ranges
from facerender.shading import Shading

# Of an error map: where on the way to the budget, and which colour there.
_STOPS = (0.0, 0.25, 0.5, 0.75, 1.0)
_COLORS = np.array([(0, 0, 0), (40, 20, 140), (200, 40, 80), (250, 190, 40), (255, 255, 255)])


@dataclass(frozen=True)
class Error:
    """How far a shading is from the full one.

    Attributes
    ----------
    maximum : the largest error of a pixel; with a guarantee, the bound
    percentile : exceeded by one covered pixel in 1000, or None with a guarantee
    camera, pixel : where the largest is: index of the camera, x and y; None with a guarantee
    drawn : the largest error of the images as the renderer draws them, with several samples a
        pixel; None where it has one, or with a guarantee
    """

    maximum: float
    percentile: float | None = None
    camera: int | None = None
    pixel: tuple[int, int] | None = None
    drawn: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """The cheapest shading within a budget.

    Attributes
    ----------
    scene : what was planned for
    shading : for :meth:`facerender.Renderer.render`
    full : the shading that it stands for
    error, cost, decisions : see there
    budget : as parsed
    cameras : whose pixels were measured; with a guarantee none, since it holds for all
    size : width and height in pixels
    constants : what could stand for maps, and the order in which lights could go
    candidates, tried : how many shadings cost less than the full one, and how many were evaluated
        at every pixel
    error_map : (H, W), of the camera with the largest error; None with a guarantee
    """

    scene: Scene
    shading: Shading
    full: Shading
    error: Error
    cost: Cost
    decisions: tuple[Decision, ...]
    budget: Budget
    cameras: tuple[Camera, ...]
    size: tuple[int, int] | None
    constants: Constants
    candidates: int
    tried: int
    error_map: NDArray[np.float64] | None = field(default=None, repr=False)

    def explain(self) -> str:
        """Return the plan in words: what was measured, a line for each decision, error and cost."""
        limit, rounding = self.budget.limit, ROUNDING[self.budget.unit]
        part = "of it kept for" if limit > rounding else "may come from"
        lines = {
            "budget": f"{self.budget.text(limit)}, {self.budget.text(rounding)} {part} rounding",
            "basis": self._basis(),
            **({d.name: d.text for d in self.decisions} if limit > rounding else {}),
            **({} if self.shading != self.full else {"shading": "nothing cheaper fits: exact"}),
            "error": self._error(),
            "cost": str(self.cost),
        }
        width = max(map(len, lines)) + 2
        return "\n".join(f"{name:{width}}{text}" for name, text in lines.items())

    def shader(self, target: Target | None = None) -> str:
        """Return the library's file with the chosen terms alone, its constants folded; target as in
        :func:`facerender.shader_source`. Comments tell what a host must leave out besides, and what
        to call for each light.

        Raises
        ------
        InputError : an unknown target
        """
        smallest = min(low for low, _ in slope_ranges(simplify(self.scene, self.shading)))
        flat = term_source(self.shading.term, smallest, target)
        version, _, rest = flat.partition("\n") if flat.startswith("#") else ("", "", flat)
        terms = [self.shading.of(light) for light in range(len(self.scene.lights))]
        calls = [call(replace(term, m=None)) if term else "none" for term in terms]
        lines = [f"BRDF of light {light}: {text}" for light, text in enumerate(calls)]
        notes = [f"// {line}" for line in [*self.explain().splitlines(), *lines]]
        return "\n".join(filter(None, [version, *notes, rest]))

    def scene_toml(self) -> str:
        """Return the scene with its shading pinned, for ``facerender render --scene``."""
        lines = ["Mesh and maps are not in here: name them again.", *self.explain().splitlines()]
        notes = [f"# {line}\n" for line in lines]
        return "".join(notes) + "\n" + scene_toml(self.scene, self.shading)

    def as_dict(self) -> dict[str, Any]:
        """Return every figure, for JSON."""
        facts: dict[str, Any] = {
            "text": self.explain(),
            "shading": self.shading.as_dict(),
            "budget": asdict(self.budget),
            "full": self.full.as_dict(),
            "guarantee": not self.cameras,
            "error": asdict(self.error),
            "cost": asdict(self.cost) | {"relative": self.cost.relative},
            "decisions": [asdict(decision) for decision in self.decisions],
            "cameras": [asdict(camera) for camera in self.cameras],
            "size": self.size,
            "candidates": self.candidates,
            "tried": self.tried,
        }
        return {key: _finite(value) for key, value in facts.items()}

    def save_error_map(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG of the errors at the camera with the largest one: black none, then blue, red
        and yellow to white at the budget.

        Raises
        ------
        InputError : a guarantee has no map; another suffix; a place that cannot be written
        """
        if os.path.splitext(path)[1].lower() != ".png":
            raise InputError(f"{path}: an error map is a .png")
        if self.error_map is None:
            raise InputError("a guarantee is not measured at any camera: it has no error map")
        at = self.error_map / max(self.budget.limit, 1e-12)
        heat = np.stack([np.interp(at, _STOPS, ramp) for ramp in _COLORS.T], axis=-1)
        comment = f"error {self._error()}; white is {self.budget.text(self.budget.limit)}"
        save_png(path, np.round(heat).astype(np.uint8), {"Comment": comment})

    def _basis(self) -> str:
        if not self.cameras:
            return "a bound, which holds for every camera"
        width, height = self.size or (0, 0)
        count = f"{len(self.cameras)} cameras" if len(self.cameras) > 1 else "1 camera"
        shown = f", {self.budget.exposure:+g} stops" if self.budget.exposure else ""
        return f"{count} of {width} x {height} pixels{shown}; no guarantee for others"

    def _error(self) -> str:
        error, text = self.error, self.budget.text
        if self.shading == self.full:
            return f"{text(0.0)}: the full shading"
        drawn = f"; {text(error.drawn)} as drawn" if error.drawn is not None else ""
        if error.maximum == 0.0:
            return f"{text(0.0)}: nothing changes but rounding{drawn}"
        if error.pixel is None or error.percentile is None:
            return f"at most {text(error.maximum)}"
        x, y = error.pixel
        at = f" of camera {error.camera}" if len(self.cameras) > 1 else ""
        return (
            f"{text(error.maximum)}, at pixel ({x}, {y}){at}; 99.9 % of the pixels within "
            f"{text(error.percentile)}{drawn}"
        )


def _finite(value: Any) -> Any:
    """The same with None for what is not finite: JSON has no other word for it."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def plan(
    scene: Scene,
    budget: str | float,
    *,
    full: Shading = Shading(),
    cameras: Sequence[Camera] | None = None,
    guarantee: bool = False,
    cost: str = "auto",
    exposure: float = 0.0,
    renderer: Renderer | None = None,
) -> Plan:
    """Find the cheapest shading of a scene whose error stays within a budget.

    Parameters
    ----------
    budget : the largest error of a pixel: "1/255" of the displayed image, "0.5%" of the linear
        radiance, "0.02 flip"; see :class:`facerender.planning.budget.Budget`
    full : what counts as exact; its lobe is the exact one
    cameras : where the error is measured; None for the scene's own. See
        :func:`facerender.turntable`
    guarantee : bound the error over all views in place of measuring it
    cost : whose: "auto", "llvmpipe", "navi21" (RDNA2) or "vega10" (GCN5) from the table, "here", or
        "radv:navi21"; see :func:`facerender.pricing.table.load_prices`. With a guarantee, "auto"
        is RDNA2's
    exposure : of the displayed image, in stops
    renderer : draws; of its size are the images that are measured, and what it shades with several
        samples a pixel counts as well; None makes one of 1024 x 1024 pixels with 4 samples

    Raises
    ------
    InputError : an unknown unit, a negative budget, a scene without lights, cameras that see
        nothing, another lobe than the exact one, FLIP with a guarantee or without its package
    ContextError : no OpenGL context
    """
    allowed = Budget.parse(budget, exposure)
    if full.term.lobe != "exact":
        raise InputError(f"a plan chooses the lobe: leave {full.term.lobe} out")
    if full != full.replace(lights={}, frontal_lights=full.frontal_lights):
        raise InputError("a plan chooses the lights' terms: leave lights out of the shading")
    if not scene.lights:
        raise InputError("the scene has no lights: there is no shading to plan")
    full = replace(full, term=replace(full.term, small_slope=None))  # as the slopes need it
    if guarantee:
        if cameras is not None:
            raise InputError("a guarantee holds for every camera: leave cameras out")
        return _guaranteed(scene, full, allowed, cost)
    at = (scene.camera,) if cameras is None else tuple(cameras)
    with nullcontext(renderer) if renderer else Renderer() as drawing:
        scenes = [replace(scene, camera=camera) for camera in at]
        views = [Region.seen(drawing, each, full, allowed) for each in scenes]
        if not any(view.counted.any() for view in views):
            raise InputError(f"the cameras see nothing of {scene.mesh.name}")
        software = drawing.context.software
        choice = Choice(scene, full, allowed, constants_seen(scene, full, views), cost, software)
        drawn = Drawn(drawing, scenes, full, allowed) if drawing.samples > 1 else None
        return _measured(choice, at, views, drawn)


def _measured(
    choice: Choice, cameras: tuple[Camera, ...], views: Sequence[Region], drawn: Drawn | None
) -> Plan:
    witnesses = Witnesses(views, choice, drawn)
    shading = choice.first(witnesses.let_pass)
    maps = [view.errors(shading) for view in views]
    camera = int(np.argmax([errors.max() for errors in maps]))
    y, x = np.unravel_index(np.argmax(maps[camera]), maps[camera].shape)
    seen = np.concatenate([each[view.counted] for each, view in zip(maps, views, strict=True)])
    error = Error(
        float(seen.max()),
        float(np.quantile(seen, 0.999)),
        camera,
        (int(x), int(y)),
        max(drawn.errors(shading)) if drawn else None,
    )
    told = decisions(
        choice,
        shading,
        error=lambda other: max(view.worst(other) for view in views),
        otherwise=witnesses.worst,
        might="would err by at least",
    )
    return _plan(choice, shading, error, told, cameras, witnesses.tried, maps[camera])


def _guaranteed(scene: Scene, full: Shading, budget: Budget, cost: str) -> Plan:
    bound(scene, full, full, budget)  # refuses at once what it cannot bound
    ends = [end for slopes in slope_ranges(simplify(scene, full)) for end in slopes]
    brightest = [float(np.max(light.irradiance)) for light in scene.lights]
    faintest = tuple(int(light) for light in np.argsort(brightest, kind="stable"))
    constants = Constants(max(ends), max(each.ks for each in scene.mesh.materials), faintest)
    choice = Choice(scene, full, budget, constants, cost, software=False)

    def at_most(shading: Shading) -> float:
        try:
            return bound(scene, shading, full, budget)
        except Unbounded:
            return math.inf

    shading = choice.first(lambda each: at_most(each) <= choice.limit)
    told = decisions(choice, shading, at_most, at_most, might="might err by up to")
    return _plan(choice, shading, Error(at_most(shading)), told)


def _plan(
    choice: Choice,
    shading: Shading,
    error: Error,
    told: Iterator[Decision],
    cameras: tuple[Camera, ...] = (),
    tried: int = 0,
    error_map: NDArray[np.float64] | None = None,
) -> Plan:
    return Plan(
        choice.scene,
        shading,
        choice.full,
        error,
        choice.cost(shading),
        tuple(told),
        choice.budget,
        cameras,
        None if error_map is None else (error_map.shape[1], error_map.shape[0]),
        choice.constants,
        choice.count,
        tried,
        error_map,
    )
