"""The frame that a scene's error budget allows, samples, triangles and shading, and what that is
based on. Which shadings there are, how they err and how they are searched is told beside this file;
what they cost in ``pricing/table.py``, what frames cost in ``frames.py``."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.renderer import Renderer
from facerender.drawing.resolve import resolve
from facerender.errors import InputError, check_switch, check_type, each_of, warn
from facerender.glsl.code import call
from facerender.glsl.library import Language, Target, term_source
from facerender.images.write import save_png
from facerender.planning.bound import Unbounded, bound
from facerender.planning.budget import ROUNDING, Budget, highest_but
from facerender.planning.candidates import Constants
from facerender.planning.decisions import Decision, decisions, details
from facerender.planning.drawn import Drawn, Place
from facerender.planning.frames import measured_frames, verified
from facerender.planning.search import Choice, Cost, Region, Witnesses, constants_seen
from facerender.pricing.interval import Interval
from facerender.pricing.table import FRAME
from facerender.scenes.camera import Camera
from facerender.scenes.file import scene_toml
from facerender.scenes.mesh import drawn_alpha
from facerender.scenes.planned import LevelOfDetail, Planned
from facerender.scenes.scene import Scene
from facerender.shading import Shading
from facerender.system.progress import Progress, no_progress

# Of an error map: where on the way to the budget, and which colour there; and beyond it.
_STOPS = (0.0, 0.25, 0.5, 0.75, 1.0)
_COLORS = np.array([(0, 0, 0), (40, 20, 140), (200, 40, 80), (250, 190, 40), (255, 255, 255)])
_OVER = (0, 255, 120)


@dataclass(frozen=True)
class Error:
    """How far a shading is from the full one.

    Attributes
    ----------
    maximum : the largest error of a pixel; with a guarantee, the bound
    within : the largest error of the budget's share of the pixels, of the worst image; the maximum
        where that is all of them
    percentile : exceeded by one covered pixel in 1000, or None with a guarantee
    camera, size, pixel : where the largest is: index of the camera, width and height of the image,
        x and y; None with a guarantee
    drawn, drawn_within : maximum and within of the images as the renderer draws them, with the
        samples and triangles of the plan; None where only fragments are priced and a pixel has one
        sample, or with a guarantee
    """

    maximum: float
    within: float
    percentile: float | None = None
    camera: int | None = None
    size: tuple[int, int] | None = None
    pixel: tuple[int, int] | None = None
    drawn: float | None = None
    drawn_within: float | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """A frame within a budget.

    Attributes
    ----------
    scene : what was planned for
    shading : for :meth:`facerender.Renderer.render`
    full : the shading that it stands for
    error, cost, decisions : see there
    budget : as parsed
    cameras : whose pixels were measured; with a guarantee none, since it holds for all
    sizes : width and height in pixels of the images that were measured, of every camera
    samples : of each pixel of them; None with a guarantee
    detail : how finely the frame is drawn that stands for the full one; None where the cost is
        that of a fragment
    measured : the frame's time over that of the full one, where it was asked for
    constants : what could stand for maps, and the order in which lights could go
    candidates, tried : how many shadings cost less than the full one, and how many were evaluated
        at every pixel
    error_map : (H, W), of the image with the largest error, as drawn where samples or triangles
        were taken away; None with a guarantee
    """

    scene: Scene
    shading: Shading
    full: Shading
    error: Error
    cost: Cost
    decisions: tuple[Decision, ...]
    budget: Budget
    cameras: tuple[Camera, ...]
    sizes: tuple[tuple[int, int], ...]
    samples: int | None
    detail: LevelOfDetail | None
    measured: Interval | None
    constants: Constants
    candidates: int
    tried: int
    error_map: NDArray[np.float64] | None = field(default=None, repr=False)

    def explain(self) -> str:
        """Return the plan in words: what was measured, a line for each decision, error and cost."""
        lines = self.lines
        width = max(map(len, lines)) + 2
        return "\n".join(f"{name:{width}}{text}" for name, text in lines.items())

    @property
    def lines(self) -> dict[str, str]:
        """What :meth:`explain` says, by the names of its lines."""
        limit, rounding = self.budget.limit, ROUNDING[self.budget.unit]
        part = "of it kept for" if limit > rounding else "may come from"
        share = f" at {self.budget.share} of the pixels" if self.budget.within < 1.0 else ""
        kept = f"{self.budget.text(rounding)} {part} rounding"
        lines = {
            "budget": f"{self.budget.text(limit)}{share}, {kept}",
            "basis": self._basis(),
            **({d.name: d.text for d in self.decisions} if limit > rounding else {}),
            **({} if self.shading != self.full else {"shading": "nothing cheaper fits: exact"}),
            "error": self._error(),
            "cost": str(self.cost),
        }
        if self.measured:
            ends = f"{self.measured.low:.2f} to {self.measured.high:.2f}"
            lines["measured"] = f"{self.measured.value:.2f} of the full frame ({ends}), in turns"
        return lines

    def shader(self, target: Target | Language | None = None) -> str:
        """Return the library's file with the chosen terms alone, its constants folded; target as in
        :func:`facerender.shader_source`. Comments tell what a host must leave out besides, and what
        to call for each light.

        Raises
        ------
        InputError : an unknown target
        """
        resolved = resolve(self.scene, self.shading)
        smallest = min(low for low, _ in resolved.slopes)
        two = any(each.two_lobes for each in resolved.scene.mesh.materials)
        flat = term_source(self.shading.term, smallest, target, two)
        version, _, rest = flat.partition("\n") if flat.startswith("#") else ("", "", flat)
        terms = [self.shading.of(light) for light in range(len(self.scene.lights))]
        second = 1.0 if two else None
        calls = [call(replace(term, m=None), second) if term else "none" for term in terms]
        lines = [f"BRDF of light {light}: {text}" for light, text in enumerate(calls)]
        notes = [f"// {line}" for line in [*self.explain().splitlines(), *lines]]
        return "\n".join(filter(None, [version, *notes, rest]))

    def scene_toml(self) -> str:
        """Return the scene with its shading pinned, and for which images it was planned, for
        ``facerender render --scene``."""
        lines = ["Mesh and maps are not in here: name them again.", *self.explain().splitlines()]
        notes = [f"# {line}\n" for line in lines]
        return "".join(notes) + "\n" + scene_toml(self.scene, self.shading, self.planned)

    @property
    def planned(self) -> Planned | None:
        """For which images it holds, and how finely they are drawn; None with a guarantee, and
        where nothing was taken away."""
        if self.samples is None or self._is_full:
            return None
        detail = self.detail or LevelOfDetail(self.samples, None)
        fewer = detail.samples if detail.samples < self.samples else None
        fine = (fewer, detail.triangles, detail.cull_back_faces, detail.shading_rate)
        return Planned(self.sizes, self.samples, *fine)

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
            "sizes": self.sizes,
            "samples": self.samples,
            "detail": self.detail and asdict(self.detail),
            "measured": self.measured and asdict(self.measured),
            "candidates": self.candidates,
            "tried": self.tried,
        }
        return {key: _finite(value) for key, value in facts.items()}

    def save_error_map(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG of the errors of the image with the largest one: black none, then blue, red
        and yellow to white at the budget; green beyond it.

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
        heat[at > 1.0] = _OVER
        comment = f"error {self._error()}; white is {self.budget.text(self.budget.limit)}"
        save_png(path, np.round(heat).astype(np.uint8), {"Comment": comment})

    @property
    def _is_full(self) -> bool:
        finest = self.detail is None or self.detail == LevelOfDetail(self.samples or 1, None)
        return self.shading == self.full and finest

    def _basis(self) -> str:
        if not self.cameras:
            return "a bound, which holds for every camera"
        sizes = ", ".join(f"{width} x {height}" for width, height in self.sizes)
        count = f"{len(self.cameras)} cameras" if len(self.cameras) > 1 else "1 camera"
        shown = f", {self.budget.exposure:+g} stops" if self.budget.exposure else ""
        return f"{count} of {sizes} pixels{shown}; no guarantee for others"

    def _error(self) -> str:
        error, text, share = self.error, self.budget.text, self.budget.share
        if self._is_full:
            return f"{text(0.0)}: the full shading"
        every = self.budget.within == 1.0
        drawn = ""
        if error.drawn is not None and error.drawn_within is not None:
            drawn = f"; {text(error.drawn)} as drawn"
            drawn += "" if every else f", {share} within {text(error.drawn_within)}"
        if self.shading == self.full:
            return drawn.removeprefix("; ")
        if error.maximum == 0.0:
            return f"{text(0.0)}: nothing changes but rounding{drawn}"
        if error.pixel is None or error.size is None or error.percentile is None:
            return f"at most {text(error.maximum)}"
        at = "at pixel ({}, {})".format(*error.pixel)
        at += f" of camera {error.camera}" if len(self.cameras) > 1 else ""
        at += " of {} x {}".format(*error.size) if len(self.sizes) > 1 else ""
        most = ("99.9 %", error.percentile) if every else (share, error.within)
        return f"{text(error.maximum)}, {at}; {most[0]} of the pixels within {text(most[1])}{drawn}"


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
    sizes: Sequence[tuple[int, int]] | None = None,
    within: str | float = 1.0,
    guarantee: bool = False,
    cost: str = FRAME,
    verify_cost: bool = False,
    exposure: float = 0.0,
    renderer: Renderer | None = None,
    progress: Progress = no_progress,
) -> Plan:
    """Find a cheaper frame of a scene whose error stays within a budget: the fewest samples,
    pixels shaded once and the fewest triangles with these, and the cheapest shading with all that.

    Parameters
    ----------
    budget : the largest error of a pixel: "1/255" of the displayed image, "0.5%" of the linear
        radiance, "0.02 flip"; see :class:`facerender.planning.budget.Budget`
    full : what counts as exact; its lobe is the exact one
    cameras : where the error is measured; None for the scene's own. See
        :func:`facerender.turntable`
    sizes : width and height of the images that are measured, of every camera; None for the
        renderer's size
    within : share of the pixels which the budget must hold at, of those that each image covers:
        0.999 or "99.9%"; the error of the worst pixel is told as well
    guarantee : bound the error over all views in place of measuring it
    cost : "frame", of whole frames on this driver, by a few that are measured; or of a fragment,
        which leaves samples and triangles as they are: "auto", "llvmpipe", "navi21" (RDNA2) or
        "vega10" (GCN5) from the table, or "here"; see
        :func:`facerender.pricing.table.load_prices`. With a guarantee a fragment's, of "auto" RDNA2
    verify_cost : measure the chosen frame beside the full one, in turns
    exposure : of the displayed image, in stops
    renderer : draws; what it shades with several samples a pixel counts as well; None makes one of
        1024 x 1024 pixels with 4 samples
    progress : called with what is done now and the share of it that is done

    Raises
    ------
    InputError : an unknown unit, a negative budget, a scene without lights, cameras that see
        nothing, another lobe than the exact one, FLIP with a guarantee or without its package, no
        share of the pixels, or one with a guarantee
    ContextError : no OpenGL context

    Warns
    -----
    FacerenderWarning : a part is blended: what shading changes of it is not counted
    """
    check_type("scene", scene, Scene, "a facerender.Scene")
    check_type("budget", budget, str | float | int, 'an error with its unit, such as "1/255"')
    check_type("full", full, Shading, "a facerender.Shading")
    check_type("cost", cost, str, f'where prices come from, such as "{FRAME}"')
    check_type("renderer", renderer, Renderer | None, "a facerender.Renderer")
    for name, value in (("guarantee", guarantee), ("verify_cost", verify_cost)):
        check_switch(name, value)
    if cameras is not None:
        cameras = each_of("cameras", cameras, Camera, "several facerender.Camera")
    if sizes is not None:
        remedy = "widths and heights, such as [(512, 512)]"
        sizes = each_of("sizes", sizes, tuple | list, remedy)
    allowed = Budget.parse(budget, exposure, within)
    if full.term.lobe != "exact":
        raise InputError(f"a plan chooses the lobe: leave {full.term.lobe} out")
    if full != full.replace(lights={}, frontal_lights=full.frontal_lights):
        raise InputError("a plan chooses the lights' terms: leave lights out of the shading")
    if not scene.lights and scene.environment is None:
        raise InputError("the scene has no lights: there is no shading to plan")
    if "blend" in map(drawn_alpha, scene.mesh.parts, scene.mesh.materials):
        warn(f"parts of {scene.mesh.name} are blended: the plan counts what lies behind them")
    full = replace(full, term=replace(full.term, small_slope=None))  # as the slopes need it
    if guarantee:
        if cameras is not None or sizes is not None:
            raise InputError("a guarantee holds for every camera: leave cameras and sizes out")
        if allowed.within < 1.0:
            raise InputError(f"a guarantee holds at every pixel: leave within {within} out")
        if verify_cost:
            raise InputError("a guarantee is of no frame: leave verify_cost out")
        return _guaranteed(scene, full, allowed, cost, progress)
    at = (scene.camera,) if cameras is None else tuple(cameras)
    with ExitStack() as stack:
        drawing = renderer or stack.enter_context(Renderer())
        renderers = [
            drawing if size == drawing.size else stack.enter_context(_resized(drawing, size))
            for size in (sizes or [drawing.size])
        ]
        places = [Place(replace(scene, camera=camera), each) for each in renderers for camera in at]
        views = []
        for number, place in enumerate(places):
            progress("views", number / len(places))
            views.append(Region.seen(place, full, allowed))
        if not any(view.counted.any() for view in views):
            raise InputError(f"the cameras see nothing of {scene.mesh.name}")
        constants = constants_seen(scene, full, views)
        software = drawing.context.software
        progress("prices", 0.0)
        choice = Choice(scene, full, allowed, constants, cost, software, views)
        return _measured(choice, at, places, views, cost == FRAME, verify_cost, progress)


def _resized(renderer: Renderer, size: tuple[int, int]) -> Renderer:
    """Return a renderer that differs in its size alone."""
    return Renderer(
        size,
        samples=renderer.samples,
        backend=renderer.context.backend,  # type: ignore[arg-type]
        anisotropy=renderer.anisotropy,
        float_albedo=renderer.albedo_kind == "linear-color",
        full_maps=renderer.full_maps,
        memory=renderer.memory,
    )


def _measured(
    choice: Choice,
    cameras: tuple[Camera, ...],
    places: Sequence[Place],
    views: Sequence[Region],
    framed: bool,
    verify: bool,
    progress: Progress,
) -> Plan:
    samples = places[0].renderer.samples
    drawn = None
    if samples > 1 or framed or verify:
        drawn = Drawn(places, choice.full, choice.budget)
    if drawn and framed and choice.limit >= 0.0:
        progress("samples and triangles", 0.0)
        drawn.coarsen()
    witnesses = Witnesses(views, choice, drawn)
    shading = choice.first(witnesses.let_pass, progress)
    if drawn and framed:
        progress("frames", 0.0)
        choice.frames = measured_frames(choice, drawn)
    maps = [view.errors(shading) for view in views]
    worst = int(np.argmax([errors.max() for errors in maps]))
    y, x = np.unravel_index(np.argmax(maps[worst]), maps[worst].shape)
    seen = np.concatenate([each[view.counted] for each, view in zip(maps, views, strict=True)])
    as_drawn = np.max([*drawn.errors(shading)], axis=0).tolist() if drawn else (None, None)
    error = Error(
        float(seen.max()),
        max(highest_but(each, view.spared) for each, view in zip(maps, views, strict=True)),
        float(np.quantile(seen, 0.999)),
        worst % len(cameras),
        places[worst].renderer.size,
        (int(x), int(y)),
        *as_drawn,
    )
    progress("decisions", 0.0)
    told = decisions(
        choice,
        shading,
        error=lambda other: max(view.error(other) for view in views),
        otherwise=witnesses.error,
        might="would err by at least",
    )
    sizes = tuple(dict.fromkeys(place.renderer.size for place in places))
    if drawn and drawn.detail != drawn.finest:
        maps = [*drawn.maps(shading)]
        worst = int(np.argmax([errors.max() for errors in maps]))
    return _plan(
        choice,
        shading,
        error,
        (*(details(choice, drawn) if drawn and framed else ()), *told),
        cameras,
        sizes,
        samples,
        drawn.detail if drawn and framed else None,
        verified(choice.full, shading, drawn) if drawn and verify else None,
        witnesses.tried,
        maps[worst],
    )


def _guaranteed(scene: Scene, full: Shading, budget: Budget, cost: str, progress: Progress) -> Plan:
    bound(scene, full, full, budget)  # refuses at once what it cannot bound
    ends = [end for slopes in resolve(scene, full).slopes for end in slopes]
    brightest = [float(np.max(light.irradiance)) for light in scene.lights]
    faintest = tuple(int(light) for light in np.argsort(brightest, kind="stable"))
    constants = Constants(max(ends), max(each.ks for each in scene.mesh.materials), faintest)
    choice = Choice(scene, full, budget, constants, cost, software=False)

    def at_most(shading: Shading) -> float:
        try:
            return bound(scene, shading, full, budget)
        except Unbounded:
            return math.inf

    shading = choice.first(lambda each: at_most(each) <= choice.limit, progress)
    told = decisions(choice, shading, at_most, at_most, might="might err by up to")
    return _plan(choice, shading, Error(at_most(shading), at_most(shading)), told)


def _plan(
    choice: Choice,
    shading: Shading,
    error: Error,
    told: Iterable[Decision],
    cameras: tuple[Camera, ...] = (),
    sizes: tuple[tuple[int, int], ...] = (),
    samples: int | None = None,
    detail: LevelOfDetail | None = None,
    measured: Interval | None = None,
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
        sizes,
        samples,
        detail,
        measured,
        choice.constants,
        choice.count,
        tried,
        error_map,
    )
