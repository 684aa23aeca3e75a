"""The shadings that a plan may choose in place of the full, exact shading of a scene, and the views
in which OpenGL draws them to choose the level of detail and to measure errors of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame_passes import deferred_is_cheaper
from facerender.drawing.prepare import resolve, simplify
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.planning.budget import Budget, highest_but
from facerender.scene.detail import LevelOfDetail
from facerender.scene.scene import Scene
from facerender.scene.shading import SCATTER_SAMPLES, SMALL_SLOPE, Shading, Term
from facerender.terms.lobe import G_POWERS, LOBES, AnyLobe, fit_g_power
from facerender.terms.model import FRESNEL, MASKING, MODELS
from facerender.values.fields import parameters

# From this slope m on, float32 needs no FR_SMALL_SLOPE: the error without it, 3e-7/m² of the lobe's
# peak, is invisible.
SMALLEST_PLAIN_SLOPE = 0.1

# Attribute of a shading, keyed by the decision's name. If the model changes, all decisions of TERM
# count as one decision.
DECISIONS = {
    "two lobes": "two_lobes",
    "lights": "specular_lights",
    "shadows": "shadow_lights",
    "scattering": "scatter_samples",
    "normal map": "normal_map",
    "slope": "term.m",
    "specular weight": "ks",
    "ambient": "ambient",
    "environment": "environment_samples",
    "diffuse": "diffuse",
    "model": "term.model",
    "lobe": "term.lobe",
    "Fresnel": "term.fresnel",
    "masking": "term.masking",
    "small slopes": "term.small_slope",
}
_GET = {name: attrgetter(path) for name, path in DECISIONS.items()}
SINGLE = ("two lobes", "slope")  # one decision: a single lobe needs another slope than two lobes
_SLOPES = {"slope", "normal map"}  # decisions that change slopes
ENVIRONMENT_SAMPLES = (0, 8, 16, 32)
TERM = ("model", "lobe", "Fresnel", "masking", "small slopes")
Fits = Callable[[Shading], bool]  # returns whether a shading is within the budget


@dataclass(frozen=True)
class Constants:
    """Constants that may replace maps, and orders in which lights may lose terms or shadows."""

    m: float  # mean slope of the visible pixels
    ks: float  # mean specular weight of the visible pixels
    # Indices of the lights, in the order in which they lose their specular terms: the light with
    # the faintest highlight first.
    faintest: tuple[int, ...]
    # Indices of the lights with shadows, sorted by how much the shadow darkens the image, weakest
    # first.
    shadows: tuple[int, ...] = ()
    single: tuple[float, ...] = ()  # values of m with which a single lobe may replace two lobes


def candidates(
    scene: Scene, full: Shading, constants: Constants, fits: Fits = lambda _: True
) -> Iterator[Shading]:
    """Yield every shading that may replace the full shading, and the full shading itself.

    full : the shading that counts as exact; it has the exact lobe
    fits : function that returns whether a shading with one change is within the budget. It is
        called for each change, except changes of highlights, lobes, Fresnel and masking terms.
        Only changes that fit are combined with other changes, which limits their number
    """
    lit = [light for light in constants.faintest if full.shines(light)]
    choices = [full.specular_lights, *(tuple(sorted(lit[n:])) for n in range(1, len(lit) + 1))]
    for surface in _surfaces(scene, full, constants, fits):
        for shading, lights in product(_terms(scene, surface), choices):
            if lights == () and shading != surface:
                continue
            yield replace(shading, specular_lights=lights)


def _surfaces(scene: Scene, full: Shading, constants: Constants, fits: Fits) -> Iterator[Shading]:
    """Yield variants of the full shading; the specular terms keep all properties except m."""
    materials = scene.mesh.materials
    normal_maps = any(material.normal_map is not None for material in materials)
    specular_maps = any(material.specular_map is not None for material in materials)
    means = [constants.m] if full.term.m is None else []
    single = constants.single if full.two_lobes else ()
    changes = [*((full.two_lobes, m) for m in means), *((False, m) for m in single)]
    slopes = [(full.two_lobes, full.term.m)]
    slopes += [(two, m) for two, m in changes if fits(full.replace(two_lobes=two, m=m))]
    cast = [tuple(sorted(constants.shadows[n:])) for n in range(1, len(constants.shadows) + 1)]
    scatters = any(material.scattering and material.diffuse_weight > 0.0 for material in materials)
    fewer = [count for count in SCATTER_SAMPLES if scatters and count < full.scatter_samples]
    reflects = scene.environment is not None and full.environment
    most = full.environment_samples if reflects else 0

    replacements: dict[str, Iterable[Any]] = {
        "ks": [constants.ks] if full.ks is None and specular_maps else [],
        "shadow_lights": cast,
        "scatter_samples": fewer,
        "normal_map": [False] if full.normal_map and normal_maps else [],
        "ambient": [False] if full.ambient and np.any(scene.ambient) else [],
        "diffuse": {"lambert"} - {full.diffuse},
        "environment_samples": [count for count in ENVIRONMENT_SAMPLES if count < most],
    }
    choices = {
        name: [getattr(full, name), *(v for v in values if fits(replace(full, **{name: v})))]
        for name, values in replacements.items()
    }
    for (two_lobes, m), *combination in product(slopes, *choices.values()):
        attributes = dict(zip(choices, combination, strict=True))
        yield replace(full, m=m, two_lobes=two_lobes, **attributes)


def shadowed(scene: Scene, shading: Shading) -> list[int]:
    """Return the indices of the lights whose shadows the shading draws."""
    return [index for index, light in enumerate(simplify(scene, shading).lights) if light.shadow]


def _terms(scene: Scene, full: Shading) -> Iterator[Shading]:
    ranges = resolve(scene, full).appearance.slopes
    slopes = min(low for low, _ in ranges), max(high for _, high in ranges)
    exactness = FRESNEL[full.term.fresnel].exactness
    allowed = [name for name, fresnel in FRESNEL.items() if fresnel.exactness <= exactness]
    for model in MODELS.values():
        if model.family != full.term.entry.family:
            continue
        names = [name for name, lobe in LOBES.items() if lobe.belongs(slopes, model.k).all()]
        fits = [fit_g_power(model.k, g, *slopes) for g in G_POWERS]
        # Of lobes with equal costs, the first is taken: the exact lobe, or a fitted g-power.
        lobes: list[AnyLobe] = [names[0], *filter(None, fits), *names[1:]]
        for lobe in lobes:
            factors = product(allowed, MASKING) if model.factors else [(Term.fresnel, Term.masking)]
            for fresnel, masking in factors:
                term = Term(model.name, lobe, fresnel, masking, full.m)
                yield (shading := replace(full, **parameters(term)))
                if lobe == "exact" and SMALLEST_PLAIN_SLOPE <= slopes[0] < SMALL_SLOPE:
                    yield replace(shading, small_slope=False)


def changed(shading: Shading, full: Shading) -> list[str]:
    """Return the names of the decisions in which two shadings differ."""
    return [name for name, get in _GET.items() if get(shading) != get(full)]


def groups(shading: Shading, full: Shading) -> dict[str, tuple[str, ...]]:
    """Return groups of decisions in which two shadings differ, keyed by each group's main decision:
    "model" has all decisions of TERM, and "two lobes" includes the slope."""
    differs = changed(shading, full)
    together = {"two lobes": SINGLE, "model": TERM}
    joint_groups = {name: together[name] for name in differs if name in together}
    grouped = {decision for names in joint_groups.values() for decision in names}
    return {name: (name,) for name in differs if name not in grouped} | joint_groups


def values(shading: Shading, names: Sequence[str]) -> dict[str, Any]:
    """Return the values of the named decisions, keyed by the shading's attribute."""
    return {DECISIONS[name]: _GET[name](shading) for name in names}


def with_decisions(shading: Shading, other: Shading, names: Sequence[str]) -> Shading:
    """Return a shading whose named decisions are replaced by the decisions of ``other``."""
    decided = values(other, names)
    return replace(shading, **{path.removeprefix("term."): v for path, v in decided.items()})


def separable(shading: Shading, names: Sequence[str]) -> bool:
    """Return whether the named decisions may change and the lobe remain: lobes other than the exact
    one are fitted to the slopes."""
    return shading.term.lobe == "exact" or not _SLOPES.intersection(names)


def alone(shading: Shading, full: Shading, names: Sequence[str]) -> Shading:
    """Return the full shading with only the named decisions taken from ``shading``."""
    # A g-power lobe is fitted to the chosen slope and is invalid for other slopes.
    base = with_decisions(full, shading, SINGLE) if "lobe" in names else full
    return with_decisions(base, shading, names)


Float = NDArray[np.float64]

_FEWEST = 500  # smallest number of triangles of a level of detail
_MAX_SCATTERED = 8  # largest number of scattering images that a viewpoint caches


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A place where errors are measured: a scene with its camera, and a renderer."""

    scene: Scene
    renderer: Renderer


def draw(viewpoint: Viewpoint, shading: Shading, detail: LevelOfDetail) -> NDArray[np.float32]:
    """Return the linear image (H, W, 4) of a viewpoint."""
    scene, options = detail.of(viewpoint.scene), detail.values
    return viewpoint.renderer.render(scene, shading, **options).linear


def scattered_light(viewpoint: Viewpoint) -> Callable[[Shading], Float]:
    """Return a function that draws the change of each pixel's radiance that scattering causes, (H,
    W, 3). Scattered light depends on other pixels; float64 would take seconds to compute it."""

    @lru_cache(_MAX_SCATTERED)
    def change(light: Shading) -> Float:
        render, scene = viewpoint.renderer.render, viewpoint.scene
        variants = light, light.replace(scatter_samples=0)
        images = [render(scene, variant, "diffuse", samples=1).linear for variant in variants]
        return np.subtract(*images, dtype=np.float64)[..., :3]

    def of_shading(shading: Shading) -> Float:
        names, m = ["scatter_samples", "shadow_lights", "normal_map", "ambient", "diffuse"], None
        if shading.diffuse == "coupled":  # this term also depends on m and the added names
            names, m = [*names, "ks", "two_lobes", "slope_filter"], shading.term.m
        return change(Shading(**{name: getattr(shading, name) for name in names}, m=m))

    return of_shading


class DrawnViews:
    """Views that OpenGL draws. With several samples per pixel, OpenGL also shades silhouettes that
    cover no pixel's centre. If a single change exceeds the budget in these images, shadings with
    this change are not tried."""

    def __init__(self, viewpoints: Sequence[Viewpoint], full: Shading, budget: Budget) -> None:
        self.viewpoints, self.full, self.budget = viewpoints, full, budget
        self.triangles = sum(len(part.faces) for part in viewpoints[0].scene.mesh.parts)
        # Level of detail of the full frame, and of the frames that are tried.
        self.finest = self.detail = LevelOfDetail(viewpoints[0].renderer.samples, None)
        self.exact = [draw(view, full, self.finest).astype(np.float64) for view in viewpoints]
        self.tried: list[tuple[LevelOfDetail, float]] = []  # with the error of each
        self.failed: list[tuple[Sequence[str], dict[str, Any]]] = []

    def coarsen(self) -> None:
        """Choose the coarsest level of detail at which the full shading stays within the budget.
        Try in this order: cull the back faces of double-sided parts, take fewer samples, shade per
        pixel, and halve the triangles repeatedly."""
        if any(material.double_sided for material in self.viewpoints[0].scene.mesh.materials):
            self._first([replace(self.detail, cull_back_faces=True)])
        samples = [count for count in (4, 1) if count < self.finest.samples]
        self._first(replace(self.detail, samples=count) for count in reversed(samples))
        views = [(view.scene, view.renderer, self.detail.samples) for view in self.viewpoints]
        if all(
            deferred_is_cheaper(scene.mesh.parts, drawer.size, count, drawer.context.renderer)
            and drawer.can_shade_per_pixel(scene, count)
            for scene, drawer, count in views
        ):
            self._first([replace(self.detail, shading_rate="pixel")])
        count = self.triangles // 2
        with suppress(InputError):  # the package for levels of detail may be missing
            while count >= _FEWEST and self._first([replace(self.detail, triangles=count)]):
                count //= 2

    def _first(self, details: Iterable[LevelOfDetail]) -> bool:
        for detail in details:
            error = self.error(self.full, detail)
            self.tried.append((detail, error))
            if error <= self.budget.limit:
                self.detail = detail
                return True
        return False

    def accepts(self, shading: Shading) -> bool:
        """Return whether a shading is within the budget; if not, note which single changes fail."""
        if self._within(shading):
            return True
        for names in groups(shading, self.full).values():
            if not self._within(alone(shading, self.full, names)):
                self.failed.append((names, values(shading, names)))
        return False

    def rejects(self, shading: Shading) -> bool:
        """Return whether a shading has a change that failed on its own."""
        return any(values(shading, names) == failed for names, failed in self.failed)

    def _within(self, shading: Shading) -> bool:
        return all(error <= self.budget.limit for _, error in self.errors(shading))

    def error(self, shading: Shading, detail: LevelOfDetail | None = None) -> float:
        """Return the largest error of all images without the spared pixels."""
        return max(within for _, within in self.errors(shading, detail))

    def errors(
        self, shading: Shading, detail: LevelOfDetail | None = None
    ) -> Iterator[tuple[float, float]]:
        """Yield two errors per image: the largest error with and without the spared pixels. Pixels
        that the full frame does not cover count too, since FLIP compares neighbourhoods. The
        default of ``detail`` is ``self.detail``."""
        for errors, exact in zip(self.maps(shading, detail), self.exact, strict=True):
            spared = self.budget.spared(int(np.count_nonzero(exact[..., 3])))
            yield float(errors.max()), highest_but(errors, spared)

    def maps(self, shading: Shading, detail: LevelOfDetail | None = None) -> Iterator[Float]:
        """Yield the error of every pixel (H, W) of each image; ``detail`` as in :meth:`errors`."""
        for viewpoint, exact in zip(self.viewpoints, self.exact, strict=True):
            image = draw(viewpoint, shading, detail or self.detail)[..., :3].astype(np.float64)
            yield self.budget.errors(image, exact[..., :3])
