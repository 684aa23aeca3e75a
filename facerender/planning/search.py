"""The choice of the cheapest shading within the budget, frame times on this driver, estimated from
a few measured frames, and the plan's decisions as text: error and saving of each change, or of a
rejected change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import accumulate, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.prepare import resolve, simplify
from facerender.drawing.reference import Layers, environment_layer, layers
from facerender.planning import candidates
from facerender.planning.budget import ROUNDING, Budget, highest_but
from facerender.planning.candidates import Constants, DrawnViews, Viewpoint, values
from facerender.pricing.cost import Frames, Interval, Line, relative, seconds
from facerender.pricing.table import NoPrice, load_prices
from facerender.scene.background import clear_color
from facerender.scene.detail import LevelOfDetail
from facerender.scene.light import LIGHTS, Light
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from facerender.system.process import Progress

_VIEWPOINTS, _REPEATS = 3, 5
_ROUNDS, _SECONDS = 25, 5.0  # most rounds of the chosen and the full frame, and their time


def measured_frames(choice: Choice, views: DrawnViews) -> Frames:
    """Measure a few frames, and return frame time as a linear function of the fragment price. With
    the full shading, a frame for each change of the level of detail is measured. The full and the
    final level of detail are also measured with the cheapest shading: a line through the times of
    the two shadings gives the time of every other shading."""
    full, cheap = choice.full, choice.ordered[0]
    detail = views.finest
    steps = {"full": detail}
    for name in ("cull_back_faces", "samples", "shading_rate", "triangles"):
        detail = steps[name] = replace(detail, **{name: getattr(views.detail, name)})
    asked = {(detail, full) for detail in steps.values()}
    asked |= {(detail, cheap) for detail in (views.finest, views.detail)}
    frames = sorted(asked, key=lambda frame: frame[1] is not full)
    durations = seconds([_frame(views, *frame) for frame in frames], _REPEATS)
    medians = 1e3 * np.median(durations[:, 0]) * np.median(durations / durations[:, :1], axis=0)
    times = dict(zip(frames, medians.tolist(), strict=True))
    prices = choice.total(full), choice.total(cheap)

    def line(detail: LevelOfDetail) -> Line:
        detail_times = times[detail, full], times[detail, cheap]
        return Line.through((prices[0], detail_times[0]), (prices[1], detail_times[1]))

    source = f"drawn in turns on {views.viewpoints[0].renderer.context.renderer}"
    step_times = {name: times[detail, full] for name, detail in steps.items()}
    return Frames(line(views.finest), line(views.detail), step_times, source)


def relative_time(full: Shading, shading: Shading, views: DrawnViews) -> Interval:
    """Draw a shading's frame and the full frame alternately; see
    :func:`facerender.pricing.cost.relative`."""
    planned_frame = _frame(views, views.detail, shading)
    return relative(planned_frame, _frame(views, views.finest, full), _ROUNDS, _SECONDS)


def _frame(views: DrawnViews, detail: LevelOfDetail, shading: Shading) -> Callable[[], object]:
    """Return a function that draws up to _VIEWPOINTS of the viewpoints, one after the other."""
    step = max(len(views.viewpoints) // _VIEWPOINTS, 1)
    viewpoints = views.viewpoints[::step][:_VIEWPOINTS]
    return lambda: [candidates.draw(viewpoint, shading, detail) for viewpoint in viewpoints]


Float = NDArray[np.float64]

# A small region has up to _SPREAD random pixels, and the worst pixels of an image. The number of
# worst pixels is _WORST plus the number of pixels that may exceed the budget.
_SPREAD, _WORST = 256, 64
# Below this fraction of a fragment's price, a saving does not shorten the frame measurably.
_IDLE = 0.02
_REGIONS = 8  # largest number of small regions, each of which caches up to about 100 MB
_KEPT = 2**18  # largest product of a region's number of pixels and number of cached terms
# Largest number of cached environment layers per cached term: most terms share one such layer.
_ENVIRONMENTS = 8


@dataclass(frozen=True)
class Cost:
    """Cost of a fragment, computed from the prices of the plan, or of a frame."""

    total: float  # of the whole fragment program or frame
    specular: float  # of its specular terms
    full_total: float  # with full shading and full level of detail
    full_specular: float
    unit: str  # of the prices
    source: str  # origin of the prices
    # Time of the cheaper frame divided by the time of the full frame, both drawn in turns: median,
    # and the interval of 80 % of the rounds. If this interval includes 1, the plan is the full
    # frame. None for fragments, or if there is no cheaper frame.
    measured: Interval | None = None

    @property
    def relative(self) -> float:
        """The cost divided by the cost of the full shading or frame, at most 1."""
        return self.total / self.full_total

    @property
    def saves(self) -> bool:
        """Whether a frame was measured to be cheaper, or prices make a fragment cheaper."""
        return self.total < self.full_total if self.measured is None else saves(self.measured)

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of ``relative``, a single value for fragments and the full frame."""
        if self.measured is not None and self.saves:
            return self.measured.low, self.measured.high
        return self.relative, self.relative

    def __str__(self) -> str:
        costs = f"{self.total:.4g} of {self.full_total:.4g} {self.unit}"
        if self.measured is None and self.saves:
            return f"{costs}, ratio {self.relative:.2f}; {self.source}"
        if self.measured is None:
            return "saves nothing: nothing cheaper is within the budget"
        interval = f"{self.measured.low:.2f} to {self.measured.high:.2f}"
        if not self.saves:
            cause = f"the cheaper frame took {interval} of its time"
            remedy = "Repeat on an idle machine, or plan for fewer pixels: within 90%"
            return f"saves nothing, so the plan is the full frame: {cause}. {remedy}"
        ratio = f"{interval} of the full frame in 80 % of rounds, median {self.relative:.2f}"
        return f"{ratio}: {costs}, {self.source}"


def saves(measured: Interval) -> bool:
    """Return whether a time relative to the full frame is below 1, also when rounded to 0.01."""
    return round(measured.high, 2) < 1.0


class Choice:
    """The shadings that may be chosen for a scene, in the order of their costs."""

    # Frame times as functions of fragment prices; None if only fragments are priced.
    frames: Frames | None = None

    def __init__(
        self,
        scene: Scene,
        full: Shading,
        budget: Budget,
        constants: Constants,
        cost: str,
        software: bool,
        views: Sequence[ReferencePixels] = (),
    ) -> None:
        """Collect and price the shadings. A change whose error on its own exceeds the limit in one
        of ``views`` is left out of the search."""
        self.scene, self.full, self.budget = scene, full, budget
        self.limit = budget.limit - ROUNDING[budget.unit]  # of the error in float64
        # Variants of the full shading with one change and an error above the limit.
        self.refused: list[Shading] = []

        def fits(shading: Shading) -> bool:
            if all(view.error(shading) <= self.limit for view in views):
                return True
            self.refused.append(shading)
            return False

        listed = list(candidates.candidates(scene, full, constants, fits))
        self.prices = load_prices(cost, scene, [*listed, full], software)
        self.costs: dict[Shading, float] = {}
        full_cost = self.prices.cost(scene, full)[0]
        cheaper = [shading for shading in listed if self.total(shading) < full_cost]
        # The cheapest shading comes first; of equal costs, the one with the fewest changes.
        changes = candidates.changed
        cheaper.sort(key=lambda shading: (self.total(shading), len(changes(shading, full))))
        self.ordered = [*cheaper, full]
        self.count = len(cheaper)

    def total(self, shading: Shading) -> float:
        """Return the cost of a fragment with a shading; infinity if a term has no price."""
        if shading not in self.costs:
            self.costs[shading] = np.inf
            with suppress(NoPrice):
                self.costs[shading] = self.prices.cost(self.scene, shading)[0]
        return self.costs[shading]

    def cost(self, shading: Shading) -> Cost:
        """Return the cost of a fragment or a frame, with a shading and with the full shading."""
        cost = self.prices.cost(self.scene, shading)
        full_cost = self.prices.cost(self.scene, self.full)
        if self.frames is None:
            return Cost(*cost, *full_cost, f"{self.prices.unit} a fragment", self.prices.source)
        frame_costs = self.frames.planned.cost(*cost), self.frames.full.cost(*full_cost)
        return Cost(*frame_costs[0], *frame_costs[1], "ms a frame", self.frames.source)

    def saved(self, shading: Shading, other: Shading) -> float:
        """Return how much less ``shading`` costs than ``other``, as a fraction of the full cost."""
        saving = self.prices.cost(self.scene, other)[0] - self.total(shading)
        if self.frames is not None:
            saving *= self.frames.planned.slope
        return saving / self.cost(self.full).full_total

    def first(self, fits: Callable[[Shading], bool], progress: Progress) -> Shading:
        """Return the cheapest shading that fits."""
        # If the budget is smaller than the error of rounding, only the full shading fits.
        for index, shading in enumerate(self.ordered if self.limit >= 0.0 else ()):
            progress("shadings", index / len(self.ordered))
            if shading is self.full or fits(shading):
                return shading
        return self.full

    def without_idle_changes(self, shading: Shading, fits: Callable[[Shading], bool]) -> Shading:
        """Return a shading without the changes that together save less than _IDLE of the price."""
        result = shading
        changes = candidates.groups(shading, self.full)
        for names in reversed(changes.values()):  # the lobe before the slopes that it is fitted to
            if not candidates.separable(result, names):
                continue
            reverted = candidates.with_decisions(result, self.full, names)
            extra_cost = self.total(reverted) - self.total(shading)
            if extra_cost < _IDLE * self.total(self.full) and fits(reverted):
                result = reverted
        return result


class Witnesses:
    """Test of shadings, first at the pixels at which earlier shadings exceeded the limit."""

    def __init__(
        self, views: Sequence[ReferencePixels], choice: Choice, rendered: DrawnViews | None
    ) -> None:
        self.views, self.limit, self.rendered = views, choice.limit, rendered
        self.tried = 0  # number of shadings that were evaluated at every pixel
        # Up to _REGIONS regions; the one that last rejected a shading is first. Empty with FLIP.
        self.regions = [view.spread() for view in views if view.counted.any()]
        if choice.budget.unit == "flip":
            errors = [self.error(shading) for shading in choice.ordered]
            smallest = accumulate(errors, min, initial=np.inf)  # of the earlier shadings
            triples = zip(choice.ordered, errors, smallest, strict=False)
            choice.ordered = [shading for shading, error, least in triples if error < least]
            self.regions = []

    def accepts(self, shading: Shading) -> bool:
        """Return whether a shading is within the limit in every image."""
        if self.rendered is not None and self.rendered.rejects(shading):
            return False
        for index, region in enumerate(self.regions):
            if not region.error(shading) <= self.limit:
                self.regions.insert(0, self.regions.pop(index))
                return False
        self.tried += 1
        for view in self.views:
            errors = view.errors(shading)
            if not highest_but(errors, view.spared) <= self.limit:
                if self.regions:
                    self.regions = [view.around(errors), *self.regions[: _REGIONS - 1]]
                return False
        return self.rendered is None or self.rendered.accepts(shading)

    def error(self, shading: Shading) -> float:
        """Return a lower bound of a shading's error in the views; with FLIP this error itself."""
        return max(region.error(shading) for region in self.regions or self.views)


@dataclass(eq=False)
class ReferencePixels:
    """All pixels of one camera, or a few that reject most shadings in a fraction of the time, with
    G-buffers, float64 terms, and radiance of the full shading."""

    scene: Scene
    mapped: GBuffer  # with the normal map
    plain: GBuffer  # without the normal map
    counted: NDArray[np.bool_]  # (H, W), mask of the pixels whose errors count
    full: Shading
    budget: Budget
    spared: int  # number of pixels of the whole image that may exceed the budget
    # Returns the change of radiance that scattering causes; None if no material scatters.
    scattered: Callable[[Shading], Float] | None
    # Largest number of shadings with cached terms; the first is the full shading.
    most_known: int = 1

    def __post_init__(self) -> None:
        self.known: dict[Shading, Layers] = {}
        self.environments: dict[Shading, Float] = {}
        self.terms = self.layers(self.full)
        self.exact = self.image(self.full)

    @classmethod
    def of_viewpoint(cls, viewpoint: Viewpoint, full: Shading, budget: Budget) -> ReferencePixels:
        """Return a region of all pixels of a viewpoint."""
        renderer, scene = viewpoint.renderer, viewpoint.scene
        mapped = renderer.gbuffer(scene, full, blended=False)
        plain = mapped
        materials = simplify(scene, full).mesh.materials
        if any(material.normal_map is not None for material in materials):
            plain = renderer.gbuffer(scene, replace(full, normal_map=False), blended=False)
        counted = mapped.part >= 0
        spared = budget.spared(int(np.count_nonzero(counted)))
        scattered = None if mapped.facing is None else candidates.scattered_light(viewpoint)
        return cls(scene, mapped, plain, counted, full, budget, spared, scattered)

    def layers(self, shading: Shading) -> Layers:
        """Return the terms of a shading for all lights and ambient light."""
        lit_shading = replace(shading, ambient=True, scatter_samples=0, specular_lights=None)
        if lit_shading in self.known:
            return self.known[lit_shading]
        gbuffer = self.mapped if lit_shading.normal_map else self.plain
        if lit_shading.ks is not None:
            weight = np.full_like(gbuffer.specular_weight, lit_shading.ks)
            gbuffer = replace(gbuffer, specular_weight=weight)
        exact = {"lobe": "exact", "small_slope": None, "shadow_lights": ()}
        environment_shading = lit_shading.replace(**exact)
        environment = self.environments.get(environment_shading)
        if environment is None:
            environment = environment_layer(gbuffer, self.scene, environment_shading)
            if len(self.environments) < _ENVIRONMENTS * self.most_known:
                self.environments[environment_shading] = environment
        terms = layers(gbuffer, self.scene, lit_shading, environment)
        if len(self.known) < self.most_known:
            self.known[lit_shading] = terms
        return terms

    def image(self, shading: Shading) -> Float:
        """Return the radiance (H, W, 3) of a shading, including the background."""
        image = self.layers(shading).sum(shading)
        if self.scattered is not None:
            image += self.scattered(shading)
        if self.scene.background is not None:
            image[~self.counted] = clear_color(self.scene.background)
        return image

    def errors(self, shading: Shading) -> Float:
        """Return the error of each pixel, (H, W); 0 for pixels outside ``counted``."""
        return np.where(self.counted, self.budget.errors(self.image(shading), self.exact), 0.0)

    def error(self, shading: Shading) -> float:
        """Return the largest error of a pixel after leaving out the ``spared`` worst pixels."""
        return highest_but(self.errors(shading), self.spared)

    def spread(self) -> ReferencePixels:
        """Return a region of a few random pixels and the pixels with the brightest highlights."""
        shine = np.where(self.counted, self.terms.specular.sum(axis=(0, -1)), -1.0)
        chance = np.random.default_rng(0).permutation(np.flatnonzero(self.counted))[:_SPREAD]
        return self._pixels(np.union1d(chance, self._highest(shine)))

    def around(self, errors: Float) -> ReferencePixels:
        """Return a region of the pixels with the largest errors."""
        return self._pixels(self._highest(errors))

    def _highest(self, values: Float) -> NDArray[np.int64]:
        count = min(self.spared + _WORST, values.size)
        return np.argpartition(values, -count, axis=None)[-count:]

    def _pixels(self, flat: NDArray[np.int64]) -> ReferencePixels:
        index = np.unravel_index(flat[None], self.counted.shape)
        budget, scattered = self.budget, self.scattered
        return replace(
            self,
            mapped=_part_of(self.mapped, index),
            plain=_part_of(self.plain, index),
            counted=self.counted[index],
            budget=Budget(1.0, "display", budget.exposure) if budget.unit == "flip" else budget,
            scattered=scattered and (lambda shading: scattered(shading)[index]),
            most_known=1 + _KEPT // flat.size,
        )


def _part_of(gbuffer: GBuffer, index: Any) -> GBuffer:
    arrays = {k: v[index] for k, v in vars(gbuffer).items() if isinstance(v, np.ndarray)}
    return replace(gbuffer, **arrays)


def constants_of(scene: Scene, full: Shading, views: Sequence[ReferencePixels]) -> Constants:
    """Return the constants: means over pixels, which the pixels' specular radiance weights."""
    single = resolve(scene, replace(full, two_lobes=False))
    bounds = {end for slopes in single.appearance.slopes for end in slopes}
    peaks, darkened = np.zeros((2, len(scene.lights)))
    cast = candidates.shadowed(scene, full)
    m, ks, light = [], [], []
    for view in views:
        specular = view.terms.specular.max(axis=-1)
        peaks = np.maximum(peaks, specular.max(axis=(1, 2)))
        for index in cast:
            bare = replace(full, shadow_lights=tuple(set(cast) - {index}))
            darkened[index] += np.abs(view.image(bare) - view.exact).mean()
        m.append(view.mapped.m[view.counted])
        ks.append(view.mapped.specular_weight[view.counted])
        light.append(specular.sum(axis=0)[view.counted] + 1e-9)
    weights = np.concatenate(light)
    averages = (np.average(np.concatenate(arrays), weights=weights) for arrays in (m, ks))
    means = [_rounded(float(average)) for average in averages]
    faintest = tuple(int(light) for light in np.argsort(peaks, kind="stable"))
    shadows = tuple(sorted(cast, key=lambda light: darkened[light]))
    slope = bounds.pop() if len(bounds) == 1 else means[0]
    return Constants(slope, means[1], faintest, shadows, _single(views, weights))


def _single(views: Sequence[ReferencePixels], weights: Float) -> tuple[float, ...]:
    """Return values of m with which a single lobe may replace two lobes. The smallest m gives the
    same peak, the largest m the same slope variance; ``weights`` weight the means over pixels."""
    if any(view.mapped.second_m is None for view in views):
        return ()
    fraction, m, second_m = (
        np.concatenate([getattr(view.mapped, name)[view.counted] for view in views]).astype(float)
        for name in ("lobe_weight", "m", "second_m")
    )
    peak, variance = (
        float(np.average(fraction * m**power + (1 - fraction) * second_m**power, weights=weights))
        ** (1 / power)
        for power in (-2, 2)
    )
    return tuple(map(_rounded, np.geomspace(peak, variance, 4)))


def _rounded(value: float) -> float:
    """Return a value with four digits. The plan uses and measures this value, so its text states
    the value in full."""
    return float(f"{value:.4g}")


ErrorOf = Callable[[Shading], float]

# Decisions whose saving is stated as a fraction of the whole cost, not of the specular cost.
_OF_THE_WHOLE = ("normal map", "ambient", "diffuse", "shadows", "scattering")


@dataclass(frozen=True)
class Decision:
    """A decision of a plan about one attribute."""

    name: str  # such as "Fresnel"
    changed: bool  # whether the plan differs from the full shading in this attribute
    chosen: str  # the chosen value, as text
    other: str  # the full value; without a change, the cheaper value with the smallest error
    # Error of this change alone; without a change, error of the plan's frame with ``other``. The
    # larger of two errors: of the drawn frame, and of the terms in float64 at pixel centres.
    error: float
    saving: float  # fraction of the full cost that the change saves, or that ``other`` would save
    text: str  # line of :meth:`Plan.explain`
    # The cheaper of chosen and other value, keyed by attribute of the shading, such as "term.lobe";
    # empty if the decision is not about the shading.
    values: dict[str, Any] = field(default_factory=dict)


def decisions(
    choice: Choice, shading: Shading, error: ErrorOf, otherwise: ErrorOf, bound: ErrorOf
) -> Iterator[Decision]:
    """Yield each decision of a shading.

    error, otherwise : functions that return the error of a shading, at the level of detail of the
        full frame and of the plan
    bound : function that returns a lower bound of a shading's error
    """
    full = choice.full
    changes = candidates.groups(shading, full)
    for name in candidates.DECISIONS:
        if names := changes.get(name):
            chosen, other = (_words(choice.scene, variant, names) for variant in (shading, full))
            added = error(candidates.alone(shading, full, names))
            saved = choice.saved(shading, candidates.with_decisions(shading, full, names))
            instead = f" instead of {other}" if other != "none" else ""
            text = f"{chosen}{instead}: error {choice.budget.text(added)} on its own, "
            text += f"{'saves' if saved >= 0.0 else 'costs'} {_fraction(choice, name, abs(saved))}"
            yield Decision(name, True, chosen, other, added, saved, text, values(shading, names))
        elif any(name in names for names in changes.values()):
            continue  # part of another decision
        elif (unchanged := _unchanged(choice, shading, name, otherwise, bound)) is not None:
            yield unchanged


def details(choice: Choice, views: DrawnViews) -> Iterator[Decision]:
    """Yield the decisions on back faces, samples, shading rate and triangles."""
    if choice.frames is None:
        return
    step_times, previous = choice.frames.taken, "full"
    for name in ("cull_back_faces", "samples", "shading_rate", "triangles"):
        saved = (step_times[previous] - step_times[name]) / step_times["full"]
        previous = name
        planned, full_value = (getattr(detail, name) for detail in (views.detail, views.finest))
        if planned != full_value:
            alone_ = replace(views.finest, **{name: planned})
            if name == "shading_rate":  # the error of "pixel" depends on the samples
                alone_ = replace(alone_, samples=views.detail.samples)
            added = views.error(choice.full, alone_)
            chosen, other = (_detail(name, value, views) for value in (planned, full_value))
            text = f"{chosen} instead of {other}: error {choice.budget.text(added)} on its own, "
            text += f"{'saves' if saved >= 0.0 else 'costs'} {_fraction(choice, name, abs(saved))}"
            yield Decision(name, True, chosen, other, added, saved, text)
            continue
        tried = ((getattr(detail, name), error) for detail, error in views.tried)
        for value, error in islice((pair for pair in tried if pair[0] != planned), 1):
            chosen, other = (_detail(name, detail, views) for detail in (planned, value))
            text = f"{chosen}: {other} would cause an error of {choice.budget.text(error)}"
            yield Decision(name, False, chosen, other, error, 0.0, text)


def _detail(name: str, value: int | str | None, views: DrawnViews) -> str:
    if name == "cull_back_faces":
        return "culled" if value else "drawn"
    return str(value or views.triangles)


def _unchanged(
    choice: Choice, shading: Shading, name: str, otherwise: ErrorOf, bound: ErrorOf
) -> Decision | None:
    cost = choice.total(shading)
    names = candidates.SINGLE if name == "two lobes" else (name,)
    refused = (
        candidates.with_decisions(shading, variant, names)
        for variant in choice.refused
        if name in candidates.changed(variant, choice.full) and candidates.separable(shading, names)
    )
    alternatives = [
        alternative
        for alternative in (*choice.ordered, *refused)
        if name in (differs := candidates.changed(alternative, shading))
        and set(differs) <= set(names)
        and choice.total(alternative) < cost
    ]
    if not alternatives:
        return None
    nearest, error = alternatives[0], np.inf
    bounds = {alternative: bound(alternative) for alternative in alternatives}
    for alternative in sorted(alternatives, key=bounds.__getitem__):
        if bounds[alternative] >= error:
            break
        if (added := otherwise(alternative)) < error:
            nearest, error = alternative, added
    chosen, other = (_words(choice.scene, variant, names) for variant in (shading, nearest))
    saved = choice.saved(nearest, shading)
    text = f"{chosen}: {other} would cause an error of {choice.budget.text(error)} and save "
    text += _fraction(choice, name, saved)
    return Decision(name, False, chosen, other, error, saved, text, values(nearest, names))


def _fraction(choice: Choice, name: str, saved: float) -> str:
    if choice.frames is not None:
        return f"{100.0 * saved:.1f} % of the frame time"
    cost = choice.cost(choice.full)
    if name in _OF_THE_WHOLE:
        return f"{100.0 * saved:.0f} % of the cost"
    part = cost.specular / cost.full_total
    return f"{100.0 * saved / part if part else 0.0:.0f} % of the specular cost"


def _plain(light: Light) -> Light:
    return replace(light, radius=0.0, shadow=False)


def _words(scene: Scene, shading: Shading, names: Sequence[str]) -> str:
    term = shading.term
    light_names = {_plain(light): name for name, light in LIGHTS.items()}
    lights = [light_names.get(_plain(light), f"light {i}") for i, light in enumerate(scene.lights)]
    lit = [name for i, name in enumerate(lights) if shading.shines(i)]
    dark = [lights[i] for i in candidates.shadowed(scene, shading)]
    words = {
        "two lobes": "two" if shading.two_lobes else "one",
        "lights": f"specular of {', '.join(lit) or 'none'}",
        "shadows": f"of {', '.join(dark) or 'none'}",
        "normal map": "on" if shading.normal_map else "off",
        "slope": "the material's" if term.m is None else f"constant {term.m:.4g}",
        "specular weight": "the material's" if shading.ks is None else f"constant {shading.ks:.4g}",
        "ambient": "on" if shading.ambient else "off",
        "environment": f"{shading.environment_samples} samples",
        "diffuse": shading.diffuse,
        "scattering": f"{shading.scatter_samples or 'no'} samples",
        "model": term.model,
        "lobe": f"lobe {term.lobe}",
        "Fresnel": f"Fresnel {term.fresnel}",
        "masking": f"masking {term.masking}",
        "small slopes": "small slopes " + ("plain" if term.small_slope is False else "exact"),
    }
    if len(names) == 1:
        return words[names[0]].removeprefix(names[0]).strip()
    stated = names if term.entry.factors or "model" not in names else names[:2]
    return ", ".join(words[name] for name in stated if name != "small slopes")
