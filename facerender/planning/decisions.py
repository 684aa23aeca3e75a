"""A plan in words: what each decision adds and saves, or why it could not be made."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from facerender.planning.candidates import (
    DECISIONS,
    SINGLE,
    alone,
    changed,
    groups,
    shadowed,
    values,
    with_decisions,
)
from facerender.planning.search import Choice
from facerender.planning.views import DrawnViews
from facerender.scenes.light import LIGHTS
from facerender.scenes.scene import Scene
from facerender.shading import Shading

# What they save is no fraction of the specular terms.
_OF_THE_WHOLE = ("normal map", "ambient", "diffuse", "shadows", "scattering")


@dataclass(frozen=True)
class Decision:
    """What was decided about one thing.

    Attributes
    ----------
    name : such as "Fresnel"
    changed : whether it differs from the full shading
    chosen : in words
    other : what the full shading has; where nothing was changed, the cheaper one that errs least
    error : what the change adds, alone; where nothing was changed, the error with the other
    saving : fraction of the full program's cost that the change saves, or the other would save
    text : a line that says it
    values : what the cheaper of the two has, by where a shading has it, such as "term.lobe"; empty
        for what is no part of a shading
    """

    name: str
    changed: bool
    chosen: str
    other: str
    error: float
    saving: float
    text: str
    values: dict[str, Any] = field(default_factory=dict)


def decisions(
    choice: Choice,
    shading: Shading,
    error: Callable[[Shading], float],
    otherwise: Callable[[Shading], float],
) -> Iterator[Decision]:
    """Tell of each decision of a shading.

    Parameters
    ----------
    error, otherwise : give the error of a shading, the second one at least
    """
    made = groups(shading, choice.full)
    for name in DECISIONS:
        if name in made:
            yield _changed(choice, shading, name, made[name], error)
        elif any(name in names for names in made.values()):
            continue  # part of another decision
        elif (unchanged := _unchanged(choice, shading, name, otherwise)) is not None:
            yield unchanged


def details(choice: Choice, drawn: DrawnViews) -> Iterator[Decision]:
    """Yield the decisions on back faces, samples, shading rate and triangles."""
    if choice.frames is None:
        return
    taken, before = choice.frames.taken, "full"
    for name in ("cull_back_faces", "samples", "shading_rate", "triangles"):
        saved = (taken[before] - taken[name]) / taken["full"]
        before = name
        own, full = (getattr(detail, name) for detail in (drawn.detail, drawn.finest))
        if own != full:
            alone_ = replace(drawn.finest, **{name: own})
            if name == "shading_rate":  # which needs the driver's samples
                alone_ = replace(alone_, samples=drawn.detail.samples)
            added = max(within for _, within in drawn.errors(choice.full, alone_))
            chosen, other = (_detail(name, each, drawn) for each in (own, full))
            text = f"{chosen} instead of {other}: alone adds {choice.budget.text(added)}, "
            text += (
                f"{'saves' if saved >= 0.0 else 'costs'} {100.0 * abs(saved):.1f} % of the frame"
            )
            yield Decision(name, True, chosen, other, added, saved, text)
            continue
        refused = (each for each in drawn.coarser if getattr(each[0], name) != own)
        for detail, error in islice(refused, 1):
            chosen, other = (_detail(name, each, drawn) for each in (own, getattr(detail, name)))
            text = f"{chosen}: {other} would err by {choice.budget.text(error)}"
            yield Decision(name, False, chosen, other, error, 0.0, text)


def _detail(name: str, value: int | str | None, drawn: DrawnViews) -> str:
    if name == "cull_back_faces":
        return "culled" if value else "drawn"
    return str(value or drawn.triangles)


def _changed(
    choice: Choice,
    shading: Shading,
    name: str,
    names: Sequence[str],
    error: Callable[[Shading], float],
) -> Decision:
    chosen, other = (_words(choice.scene, each, names) for each in (shading, choice.full))
    added = error(alone(shading, choice.full, names))
    reverted = with_decisions(shading, choice.full, names)
    saved = choice.saved(shading, reverted)
    instead = f" instead of {other}" if other != "none" else ""
    text = f"{chosen}{instead}: alone adds {choice.budget.text(added)}, "
    text += f"{'saves' if saved >= 0.0 else 'costs'} {_fraction(choice, name, abs(saved))}"
    return Decision(name, True, chosen, other, added, saved, text, values(shading, names))


def _unchanged(
    choice: Choice,
    shading: Shading,
    name: str,
    otherwise: Callable[[Shading], float],
) -> Decision | None:
    own = choice.total(shading)
    names = SINGLE if name == "two lobes" else (name,)
    refused = [
        with_decisions(shading, each, names)
        for each in choice.refused
        if name in changed(each, choice.full)
        and (names != SINGLE or shading.term.lobe == "exact")  # others are fitted to a slope
    ]
    others = [
        each
        for each in (*choice.ordered, *filter(choice.is_priced, refused))
        if name in (differs := changed(each, shading))
        and set(differs) <= set(names)
        and choice.total(each) < own
    ]
    if not others:
        return None
    errors = [otherwise(each) for each in others]
    nearest = others[errors.index(min(errors))]
    chosen, other = (_words(choice.scene, each, names) for each in (shading, nearest))
    saved = choice.saved(nearest, shading)
    text = f"{chosen}: {other} would err by at least {choice.budget.text(min(errors))}, and save "
    text += _fraction(choice, name, saved)
    return Decision(name, False, chosen, other, min(errors), saved, text, values(nearest, names))


def _fraction(choice: Choice, name: str, saved: float) -> str:
    if choice.frames is not None:
        return f"{100.0 * saved:.1f} % of the frame"
    cost = choice.cost(choice.full)
    if name in _OF_THE_WHOLE:
        return f"{100.0 * saved:.0f} % of the cost"
    part = cost.specular / cost.full_total
    return f"{100.0 * saved / part if part else 0.0:.0f} % of the specular cost"


def _words(scene: Scene, shading: Shading, names: Sequence[str]) -> str:
    term = shading.term
    names_of_lights = {light: name for name, light in LIGHTS.items()}
    plain = [replace(light, radius=0.0, shadow=False) for light in scene.lights]
    lights = [names_of_lights.get(each, f"light {i}") for i, each in enumerate(plain)]
    lit = [name for i, name in enumerate(lights) if shading.of(i)]
    dark = [lights[i] for i in shadowed(scene, shading)]
    near = [lights[i] for i in shading.frontal_lights]
    words = {
        "two lobes": "two" if shading.two_lobes else "one",
        "lights": f"specular of {', '.join(lit) or 'none'}",
        "shadows": f"of {', '.join(dark) or 'none'}",
        "frontal": f"{', '.join(near)} with Fresnel f0, not masked" if near else "none",
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
    shown = names if term.entry.factors or "model" not in names else names[:2]
    if len(names) == 1:
        return words[names[0]].removeprefix(names[0]).strip()
    return ", ".join(words[name] for name in shown if name not in ("small slopes", "frontal"))
