"""Decisions of a plan as text: error and saving of each change, or of a rejected change."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from facerender.planning import candidates
from facerender.planning.candidates import DECISIONS, SINGLE, DrawnViews, values, with_decisions
from facerender.planning.search import Choice
from facerender.scene.light import LIGHTS, Light
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading

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
    changes = candidates.groups(shading, choice.full)
    for name in DECISIONS:
        if name in changes:
            yield _changed(choice, shading, name, changes[name], error)
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


def _changed(
    choice: Choice, shading: Shading, name: str, names: Sequence[str], error: ErrorOf
) -> Decision:
    chosen, other = (_words(choice.scene, variant, names) for variant in (shading, choice.full))
    added = error(candidates.alone(shading, choice.full, names))
    saved = choice.saved(shading, with_decisions(shading, choice.full, names))
    instead = f" instead of {other}" if other != "none" else ""
    text = f"{chosen}{instead}: error {choice.budget.text(added)} on its own, "
    text += f"{'saves' if saved >= 0.0 else 'costs'} {_fraction(choice, name, abs(saved))}"
    return Decision(name, True, chosen, other, added, saved, text, values(shading, names))


def _unchanged(
    choice: Choice, shading: Shading, name: str, otherwise: ErrorOf, bound: ErrorOf
) -> Decision | None:
    cost = choice.total(shading)
    names = SINGLE if name == "two lobes" else (name,)
    refused = (
        with_decisions(shading, variant, names)
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
    nearest, error = alternatives[0], math.inf
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
