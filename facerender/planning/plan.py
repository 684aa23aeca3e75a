"""The plan of a scene, and its disk cache, which is keyed by a digest of scene, budget, full
shading, renderer and prices."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.prepare import resolve
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError, number_of
from facerender.glsl.library import Language, Target, call, term_source
from facerender.images.files import png_bytes
from facerender.mesh.mesh import drawn_alpha
from facerender.planning import search
from facerender.planning.budget import ROUNDING, Budget, highest_but
from facerender.planning.candidates import Constants, DrawnViews, Viewpoint
from facerender.planning.search import Choice, Cost, Decision, ReferencePixels, decisions
from facerender.pricing.table import FRAME, TABLE
from facerender.scene.background import clear_color
from facerender.scene.camera import Camera, orbiting
from facerender.scene.detail import LevelOfDetail, Planned
from facerender.scene.job import scene_toml
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from facerender.system import cache as disk_cache
from facerender.system.files import digest_of, write_bytes
from facerender.system.process import Progress, no_progress
from facerender.texture.texture import Texture
from facerender.values.fields import Several, parameters
from facerender.values.vectors import MAX_RADIANCE

# Colour ramp of an error map: errors as fractions of the budget, the colours of these errors, and
# the colour of errors beyond the budget.
_STOPS = (0.0, 0.25, 0.5, 0.75, 1.0)
_COLORS = np.array([(0, 0, 0), (40, 20, 140), (200, 40, 80), (250, 190, 40), (255, 255, 255)])
_OVER = (0, 255, 120)


@dataclass(frozen=True)
class Error:
    """The error of a shading compared with the full shading."""

    maximum: float  # of a pixel, computed in float64
    # Error that the budget's fraction of the pixels does not exceed, in the worst image; equal to
    # ``maximum`` if the fraction is 1.
    within: float
    percentile: float  # error that one covered pixel in 1000 exceeds
    camera: int  # index of the camera with the largest error
    size: tuple[int, int]  # width and height of the image with the largest error
    pixel: tuple[int, int]  # x and y of the pixel with the largest error
    # ``maximum`` and ``within`` of the rendered images, with the plan's samples and triangles, and
    # with blended and refracting parts, which the other errors leave out. None if only fragments
    # are priced, a pixel has one sample and the mesh has no such parts.
    drawn: float | None = None
    drawn_within: float | None = None


@dataclass(frozen=True)
class Elsewhere:
    """The error at a camera for which a plan does not hold, as an example."""

    camera: Camera  # the plan's first camera, turned by up to 45 degrees around the frame's centre
    maximum: float  # as in :class:`Error`, of the drawn image
    within: float


@dataclass(frozen=True, eq=False)
class Plan:
    """The cheapest frame that was found within a budget.

    Attributes
    ----------
    shading : the chosen shading, for :meth:`facerender.Renderer.render`
    full : the full shading, which the chosen shading replaces
    decisions : changes of the plan, and changes that would exceed the budget
    cameras : the cameras at which errors were measured
    sizes : width and height in pixels of the measured images, for every camera
    samples : samples per pixel of the measured images
    detail : level of detail of the chosen frame; None if only fragments are priced
    elsewhere : error at another camera, see :class:`Elsewhere`; None for the full frame
    constants : constants that could replace maps, and orders in which lights could lose terms or
        shadows
    candidates : number of shadings that cost less than the full shading
    tried : number of shadings that were evaluated at every pixel
    error_map : (H, W), error of each pixel in the image with the largest error; measured in the
        rendered image if the level of detail was reduced
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
    samples: int
    detail: LevelOfDetail | None
    elsewhere: Elsewhere | None
    constants: Constants
    candidates: int
    tried: int
    error_map: NDArray[np.float64] = field(repr=False)

    def __repr__(self) -> str:
        return f"<Plan within {self.budget.text(self.budget.limit)}, {self.shading!r}>"

    def explain(self) -> str:
        """Return the plan as text: lines for budget, basis, each decision, error and cost."""
        lines = self.lines
        width = max(map(len, lines)) + 2
        return "\n".join(f"{name:{width}}{text}" for name, text in lines.items())

    @property
    def lines(self) -> dict[str, str]:
        """The lines of :meth:`explain`, keyed by name."""
        limit, rounding = self.budget.limit, ROUNDING[self.budget.unit]
        part = "of which rounding may use" if limit > rounding else "but rounding may cause"
        fraction = f" for {self.budget.fraction} of the pixels" if self.budget.within < 1.0 else ""
        reserve = f"{part} {self.budget.text(rounding)}"
        given_up = self.cost.measured is not None and not self.cost.saves
        exact = self.shading == self.full and not given_up
        fits = "fits" if self.cost.measured is None else "fits and shortens the frame"
        sizes = ", ".join(f"{width} x {height}" for width, height in self.sizes)
        stops = self.budget.exposure
        exposure = f", exposure {stops:+g} stops" if stops else ""
        basis = f"{number_of(len(self.cameras), 'camera')}, {sizes} pixels{exposure}"
        return {
            "budget": f"{self.budget.text(limit)}{fraction}, {reserve}",
            "basis": f"{basis}; no guarantee for other cameras, sizes and poses",
            **({"elsewhere": self._elsewhere(self.elsewhere)} if self.elsewhere else {}),
            **({d.name: d.text for d in self.decisions} if limit > rounding else {}),
            **({"shading": f"exact: nothing cheaper {fits}"} if exact else {}),
            "error": self._error(),
            "cost": str(self.cost),
        }

    def shader(self, target: Target | Language | None = None) -> str:
        """Return a GLSL file as text: it contains only the chosen terms, with folded constants.
        Comments in the file contain the plan and the function call for each light. ``target`` is as
        in :func:`facerender.shader_source`."""
        resolved = resolve(self.scene, self.shading)
        smallest = min(low for low, _ in resolved.appearance.slopes)
        two_lobes = any(material.two_lobes for material in resolved.scene.mesh.materials)
        source = term_source(self.shading.term, smallest, target, two_lobes)
        version, _, body = source.partition("\n") if source.startswith("#") else ("", "", source)
        text = call(replace(self.shading.term, m=None), 1.0 if two_lobes else None)
        count = len(self.scene.lights)
        calls = [text if self.shading.shines(light) else "none" for light in range(count)]
        lines = [f"BRDF of light {light}: {brdf}" for light, brdf in enumerate(calls)]
        notes = [f"// {line}" for line in [*self.explain().splitlines(), *lines]]
        return "\n".join(filter(None, [version, *notes, body]))

    def scene_toml(self) -> str:
        """Return a scene file for ``facerender render --scene``, with the chosen shading and level
        of detail, and with the image sizes of the plan."""
        lines = ["Give mesh and maps again: this file has none.", *self.explain().splitlines()]
        notes = "".join(f"# {line}\n" for line in lines)
        return f"{notes}\n{scene_toml(self.scene, self.shading, self.planned)}"

    @property
    def planned(self) -> Planned | None:
        """Image sizes, samples and level of detail of the plan; None for the full frame."""
        if self._is_full:
            return None
        detail = self.detail or LevelOfDetail(self.samples, None)
        fewer = detail.samples if detail.samples < self.samples else None
        fine = (fewer, detail.triangles, detail.cull_back_faces, detail.shading_rate)
        return Planned(self.sizes, self.samples, *fine)

    def as_dict(self) -> dict[str, Any]:
        """Return all values of the plan, for JSON."""
        values: dict[str, Any] = {
            "text": self.explain(),
            "shading": self.shading.as_dict(),
            "budget": asdict(self.budget),
            "full": self.full.as_dict(),
            "error": asdict(self.error),
            "cost": asdict(self.cost)
            | {name: getattr(self.cost, name) for name in ("relative", "interval", "saves")},
            "decisions": [asdict(decision) for decision in self.decisions],
            "cameras": [asdict(camera) for camera in self.cameras],
            "sizes": self.sizes,
            "samples": self.samples,
            "detail": self.detail and asdict(self.detail),
            "elsewhere": self.elsewhere and asdict(self.elsewhere),
            "candidates": self.candidates,
            "tried": self.tried,
        }
        return {key: _finite(value) for key, value in values.items()}

    def save_error_map(self, path: str | os.PathLike[str]) -> None:
        """Write a PNG with the error of each pixel of the image with the largest error. Colours
        range from black (no error) over blue, red and yellow to white (error equal to the budget).
        Larger errors are green."""
        if os.path.splitext(path)[1].lower() != ".png":
            raise InputError(f"{path}: an error map is a PNG file: give a name that ends in .png")
        fractions = self.error_map / max(self.budget.limit, 1e-12)
        heat = np.stack([np.interp(fractions, _STOPS, ramp) for ramp in _COLORS.T], axis=-1)
        heat[fractions > 1.0] = _OVER
        comment = f"{self._error()}; white is {self.budget.text(self.budget.limit)}"
        write_bytes(path, png_bytes(np.round(heat).astype(np.uint8), {"Comment": comment}))

    @property
    def _is_full(self) -> bool:
        finest = self.detail is None or self.detail == LevelOfDetail(self.samples, None)
        return self.shading == self.full and finest

    def _elsewhere(self, elsewhere: Elsewhere) -> str:
        text, fraction = self.budget.text, self.budget.fraction
        azimuth, within = elsewhere.camera.azimuth, ""
        if self.budget.within < 1.0:
            within = f"{fraction} within {text(elsewhere.within)}, up to "
        remedy = "plan with all cameras and sizes, and each pose on its own"
        return f"{within}{text(elsewhere.maximum)} as rendered at azimuth {azimuth:g}: {remedy}"

    def _error(self) -> str:
        error, text, fraction = self.error, self.budget.text, self.budget.fraction
        if self._is_full:
            return "budget met: the full frame has no error"
        every = self.budget.within == 1.0
        largest = max(error.within, error.drawn_within or 0.0)
        verdict = "met" if largest <= self.budget.limit else "not met"
        pixels = "all pixels" if every else f"{fraction} of the pixels"
        parts = [f"budget {verdict}: {pixels} within {text(largest)}"]
        if self.shading != self.full:
            pixel = "at pixel ({}, {})".format(*error.pixel)
            pixel += f" of camera {error.camera}" if len(self.cameras) > 1 else ""
            pixel += " of {} x {}".format(*error.size) if len(self.sizes) > 1 else ""
            share, quantile = ("99.9 %", error.percentile) if every else (fraction, error.within)
            exact = f"up to {text(error.maximum)}, {pixel}; {share} within {text(quantile)}"
            parts.append(f"at pixel centres {exact if error.maximum else '0, except for rounding'}")
        if error.drawn is not None:
            parts.append(f"as rendered up to {text(error.drawn)}")
        return "; ".join(parts)


def _finite(value: Any) -> Any:
    """Replace non-finite numbers by None, since JSON cannot represent them."""
    if isinstance(value, dict):
        return {key: _finite(member) for key, member in value.items()}
    if isinstance(value, list):
        return [_finite(element) for element in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def plan(
    scene: Scene,
    budget: str | float,
    *,
    full: Shading = Shading(),
    cameras: Sequence[Camera | str] | None = None,
    sizes: Sequence[tuple[int, int]] | None = None,
    within: str | float = 1.0,
    cost: str = FRAME,
    exposure: float = 0.0,
    renderer: Renderer | None = None,
    progress: Progress = no_progress,
) -> Plan:
    """Find a cheaper frame of a scene, with an error within a budget.

    The choices are made in this order: culled back faces, the fewest samples, per-pixel shading,
    the fewest triangles, the cheapest shading. Earlier choices are in effect for later choices.

    Parameters
    ----------
    budget : the largest error of a pixel: "1/255" of the displayed image, "0.5%" of the linear
        radiance, "0.02 flip"; see :class:`facerender.planning.budget.Budget`
    full : the shading that counts as exact; it must have the exact lobe
    cameras : cameras at which errors are measured, each as in :class:`facerender.Scene`, such as
        :func:`facerender.turntable`; default: the scene's camera
    sizes : width and height of the measured images, for every camera; default: the renderer's size
    within : fraction of each image's covered pixels that must meet the budget: 0.999 or "99.9%"
    cost : "frame": time of whole frames on this driver, drawn in turns with the full frame. A plan
        without a measured gain is the full frame. Other values price a fragment and leave samples
        and triangles unchanged: "auto", "llvmpipe", "navi21" (RDNA2), "vega10" (GCN5) or "here",
        see :func:`facerender.pricing.table.load_prices`
    exposure : exposure of the displayed image, in stops; default 0
    renderer : renderer with the size and samples of the planned frame; default: a new
        :class:`facerender.Renderer`
    progress : called with the current step and its completed fraction

    Raises
    ------
    InputError : an invalid value, a scene without lights, cameras that see nothing, an inexact
        lobe, or a missing package for FLIP
    ContextError : no OpenGL context
    """
    allowed = Budget.parse(budget, exposure, within)
    checked = Several(Camera).check("cameras", [scene.camera] if cameras is None else cameras)
    if full.term.lobe != "exact":
        raise InputError(f"a plan chooses the lobe: omit {full.term.lobe}")
    if not scene.lights and scene.environment is None:
        raise InputError("the scene has no lights, so there is no shading to plan: add a light")
    full = replace(full, small_slope=None)
    with ExitStack() as stack:  # closes the new renderers, one per size with the same options
        base = renderer or stack.enter_context(Renderer())
        names = ("samples", "anisotropy", "full_maps", "memory")
        options: dict[str, Any] = {name: getattr(base, name) for name in names}
        options["backend"] = base.context.backend
        options["float_albedo"] = base.albedo_kind == "linear-color"
        renderers = [
            base if size == base.size else stack.enter_context(Renderer(size, **options))
            for size in (sizes or [base.size])
        ]
        return _planned(scene, allowed, full, checked, cost, renderers, progress)


def _planned(
    scene: Scene,
    budget: Budget,
    full: Shading,
    cameras: tuple[Camera, ...],
    cost: str,
    renderers: Sequence[Renderer],
    progress: Progress,
) -> Plan:
    sizes = [renderer.size for renderer in renderers]
    # The budget scales whole images by the exposure, but exposure leaves backgrounds as they are.
    # Black replaces images: errors at the mesh's edge are largest there.
    color = np.multiply(clear_color(scene.background), 2.0**-budget.exposure).clip(max=MAX_RADIANCE)
    background = None if scene.background is None else color
    viewpoints = [
        Viewpoint(replace(scene, camera=camera, background=background), renderer)
        for renderer in renderers
        for camera in cameras
    ]
    views = []
    for number, viewpoint in enumerate(viewpoints):
        progress("views", number / len(viewpoints))
        views.append(ReferencePixels.of_viewpoint(viewpoint, full, budget))
    if not any(view.counted.any() for view in views):
        raise InputError(f"the cameras see nothing of {scene.mesh.name}: give other cameras")
    constants = search.constants_of(scene, full, views)
    progress("prices", 0.0)
    choice = Choice(scene, full, budget, constants, cost, renderers[0].context.software, views)
    samples, rendered = renderers[0].samples, None
    pairs = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    layered = any(pair[1].refracts or drawn_alpha(*pair) == "blend" for pair in pairs)
    if samples > 1 or layered or cost == FRAME:
        rendered = DrawnViews(viewpoints, full, budget)
    framed = rendered if cost == FRAME else None  # set if the level of detail is chosen too
    if framed and choice.limit >= 0.0:
        progress("samples and triangles", 0.0)
        framed.coarsen()
    witnesses = search.Witnesses(views, choice, rendered)
    shading = choice.first(witnesses.accepts, progress)
    measured = None
    if framed:
        progress("frames", 0.0)
        choice.frames = search.measured_frames(choice, framed)
        shading = choice.without_idle_changes(shading, witnesses.accepts)
        if (shading, framed.detail) != (full, framed.finest):
            measured = search.relative_time(full, shading, framed)
            if not search.saves(measured):
                shading, framed.detail = full, framed.finest
                choice.frames = replace(choice.frames, planned=choice.frames.full)
    maps = [view.errors(shading) for view in views]
    error = _error(maps, views, cameras, sizes, [*rendered.errors(shading)] if rendered else [])
    progress("decisions", 0.0)

    def largest_error(shading: Shading, detail: LevelOfDetail | None = None) -> float:
        """Return the larger of two errors: in float64, and of the images at a level of detail."""
        errors = [view.error(shading) for view in views]
        return max([*errors, rendered.error(shading, detail)] if rendered else errors)

    finest_error = partial(largest_error, detail=rendered.finest if rendered else None)
    cost_of_plan = choice.cost(shading)
    if framed:
        relative = measured.value if measured is not None and search.saves(measured) else 1.0
        total = relative * cost_of_plan.full_total
        cost_of_plan = replace(cost_of_plan, total=total, measured=measured)
    plan_decisions = [*decisions(choice, shading, finest_error, largest_error, witnesses.error)]
    if framed:
        plan_decisions = [*search.details(choice, framed), *plan_decisions]
        maps = [*framed.maps(shading)] if framed.detail != framed.finest else maps
    # Changes that fit, but save nothing, would look like changes that the search has missed.
    stated = [one for one in plan_decisions if one.changed or one.error > budget.limit]
    return Plan(
        scene=scene,
        shading=shading,
        full=full,
        error=error,
        cost=cost_of_plan,
        decisions=tuple(stated),
        budget=budget,
        cameras=cameras,
        sizes=tuple(dict.fromkeys(sizes)),
        samples=samples,
        detail=framed.detail if framed else None,
        elsewhere=_elsewhere(viewpoints[0], cameras, full, budget, shading, framed),
        constants=constants,
        candidates=choice.count,
        tried=witnesses.tried,
        error_map=max(maps, key=np.max),
    )


def _elsewhere(
    viewpoint: Viewpoint,
    cameras: tuple[Camera, ...],
    full: Shading,
    budget: Budget,
    shading: Shading,
    framed: DrawnViews | None,
) -> Elsewhere | None:
    """Return the error at a camera that looks at the mesh, even if the first one does not."""
    if shading == full and (framed is None or framed.detail == framed.finest):
        return None
    camera, angle = cameras[0], 45.0
    while camera in cameras:
        azimuth = (cameras[0].azimuth + angle + 180.0) % 360.0 - 180.0
        camera, angle = orbiting(cameras[0], azimuth=azimuth, target=None), angle / 2.0
    other_viewpoint = replace(viewpoint, scene=replace(viewpoint.scene, camera=camera))
    rendered = DrawnViews([other_viewpoint], full, budget)
    ((maximum, within),) = rendered.errors(shading, framed.detail if framed else None)
    return Elsewhere(camera, maximum, within)


def _error(
    maps: Sequence[NDArray[np.float64]],
    views: Sequence[ReferencePixels],
    cameras: Sequence[Camera],
    sizes: Sequence[tuple[int, int]],
    rendered: Sequence[tuple[float, float]],
) -> Error:
    """Return the error over all views, which are ordered by size, then by camera."""
    worst = int(np.argmax([errors.max() for errors in maps]))
    y, x = np.unravel_index(np.argmax(maps[worst]), maps[worst].shape)
    pairs = [*zip(maps, views, strict=True)]
    covered = np.concatenate([errors[view.counted] for errors, view in pairs])
    maximum, within = np.max(rendered, axis=0).tolist() if rendered else (None, None)
    size, camera = divmod(worst, len(cameras))
    return Error(
        maximum=float(covered.max()),
        within=max(highest_but(errors, view.spared) for errors, view in pairs),
        percentile=float(np.quantile(covered, 0.999)),
        camera=camera,
        size=sizes[size],
        pixel=(int(x), int(y)),
        drawn=maximum,
        drawn_within=within,
    )


def cached_plan(
    scene: Scene,
    budget: str | float,
    full: Shading,
    exposure: float,
    within: str | float,
    renderer: Renderer,
    cache: bool = True,
) -> dict[str, Any]:
    """Return a plan in the form of :meth:`facerender.Plan.as_dict`, from the cache if possible; the
    parameters are as in :func:`facerender.plan`."""
    allowed = Budget.parse(budget, exposure, within)
    name = _digest(scene, allowed, full, renderer) if cache else ""
    # The cache checks its entries, and the name depends on the version and thus on the format.
    if cache and (content := disk_cache.read("plans", name)) is not None:
        return dict(json.loads(bytes(content)))
    new_plan = plan(scene, budget, full=full, exposure=exposure, within=within, renderer=renderer)
    values = new_plan.as_dict()
    if cache:
        disk_cache.write("plans", name, [json.dumps(values).encode()])
    return values


def _digest(*parts: Any) -> str:
    # The version and the price table count too: another one may give another plan.
    pieces = (piece for part in (__version__, *parts) for piece in _pieces(part))
    return digest_of(TABLE.read_bytes(), *pieces)


def _pieces(value: Any) -> Iterator[bytes]:
    """Yield the content of a value as bytes; different values yield different bytes."""
    yield type(value).__name__.encode()
    if isinstance(value, Texture):
        value = value.sampling, np.asarray(value.rgb())
    elif isinstance(value, Renderer):
        names = ("size", "samples", "anisotropy", "albedo_kind", "full_maps")
        value = (*(getattr(value, name) for name in names), value.context.renderer)
    elif hasattr(value, "__dataclass_fields__"):
        value = tuple(parameters(value).values())
    if isinstance(value, np.ndarray):
        yield repr((value.shape, value.dtype.str)).encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, tuple):
        for element in value:
            yield from _pieces(element)
        yield b")"
    else:
        yield repr(value).encode() + b";"
