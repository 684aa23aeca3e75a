"""Disk cache of plans, keyed by a digest of scene, budget, full shading, renderer and prices."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from typing import Any

import numpy as np

from facerender import __version__
from facerender.drawing.renderer import Renderer
from facerender.planning.budget import Budget
from facerender.planning.plan import plan
from facerender.pricing.table import TABLE
from facerender.scenes.lod import LevelOfDetail
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Texture
from facerender.shading import Shading
from facerender.system import cache as disk_cache
from facerender.system.files import digest_of


def cached_plan(
    scene: Scene,
    budget: str | float,
    full: Shading,
    exposure: float,
    within: str | float,
    renderer: Renderer,
    cache: bool = True,
) -> dict[str, Any]:
    """Return a plan in the form of :meth:`facerender.Plan.as_dict`, from the cache if possible.

    ``cache`` enables the cache. The other parameters and the errors are the same as in
    :func:`facerender.plan`.
    """
    allowed = Budget.parse(budget, exposure, within)
    name = _digest(scene, allowed, full, renderer) if cache else ""
    with suppress(ValueError, KeyError, TypeError):  # the file is damaged or has another format
        if cache and (content := disk_cache.read("plans", name)) is not None:
            cached: dict[str, Any] = json.loads(bytes(content))
            Shading.from_dict(cached["shading"]).check_lights(len(scene.lights))
            LevelOfDetail(**cached["detail"])
            if isinstance(cached["text"], str):
                return cached
    new_plan = plan(scene, budget, full=full, exposure=exposure, within=within, renderer=renderer)
    facts = new_plan.as_dict()
    if cache:
        disk_cache.write("plans", name, [json.dumps(facts).encode()])
    return facts


def _digest(*parts: Any) -> str:
    pieces = (piece for part in (__version__, *parts) for piece in _pieces(part))
    return digest_of(TABLE.read_bytes(), *pieces)


def _pieces(value: Any) -> Iterator[bytes]:
    """Yield the content of a value as bytes; different values yield different bytes."""
    yield type(value).__name__.encode()
    if isinstance(value, np.ndarray):
        yield repr((value.shape, value.dtype.str)).encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Texture):
        yield repr((value.rgb().size, value.sampling)).encode()
        yield value.rgb().tobytes()
    elif isinstance(value, Renderer):
        names = ("size", "samples", "anisotropy", "albedo_kind", "full_maps")
        facts = [getattr(value, name) for name in names] + [value.context.renderer]
        yield repr(facts).encode()
    elif isinstance(value, tuple):
        for element in value:
            yield from _pieces(element)
        yield b")"
    elif hasattr(value, "__dataclass_fields__"):
        for field in fields(value):
            yield from _pieces(getattr(value, field.name))
    else:
        yield repr(value).encode() + b";"
