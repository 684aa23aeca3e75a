"""Plans that were made before, kept by everything that they depend on: mesh, maps, lights, camera,
budget, prices. In $XDG_CACHE_HOME/facerender or ~/.cache/facerender; a place that cannot be
written is passed over."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from facerender._version import __version__
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.image import write_bytes
from facerender.planning.budget import Budget
from facerender.planning.plan import plan
from facerender.pricing.table import TABLE
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Texture
from facerender.shading import Shading


def planned(
    scene: Scene,
    budget: str | float,
    full: Shading,
    exposure: float,
    within: str | float,
    renderer: Renderer,
) -> dict[str, Any]:
    """Return a plan as :meth:`facerender.Plan.as_dict` has it: the one that was kept, or one
    that is made now and kept. Parameters and errors as in :func:`facerender.plan`."""
    allowed = Budget.parse(budget, exposure, within)
    path = _folder() / f"{_digest(scene, allowed, full, renderer)}.json"
    try:
        kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        Shading.from_dict(kept["shading"]).check_lights(len(scene.lights))
        if isinstance(kept["text"], str):
            return kept
    except (OSError, ValueError, KeyError, TypeError):  # none, or damaged
        pass
    made = plan(scene, budget, full=full, exposure=exposure, within=within, renderer=renderer)
    facts = made.as_dict()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, json.dumps(facts).encode())
    except (OSError, InputError):
        pass
    return facts


def _folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    home = os.path.expanduser("~/.cache")
    return Path(base if os.path.isabs(base) else home, "facerender", "plans")


def _digest(*parts: Any) -> str:
    digest = hashlib.blake2b(digest_size=16)
    digest.update(TABLE.read_bytes())
    for part in (__version__, *parts):
        for piece in _pieces(part):
            digest.update(piece)
    return digest.hexdigest()


def _pieces(value: Any) -> Iterator[bytes]:
    """What a value is made of, in an order that tells it from every other."""
    yield type(value).__name__.encode()
    if isinstance(value, np.ndarray):
        yield repr((value.shape, value.dtype.str)).encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Texture):
        yield repr(value.rgb().size).encode()
        yield value.rgb().tobytes()
    elif isinstance(value, Renderer):
        names = ("size", "samples", "anisotropy", "albedo_kind")
        facts = [getattr(value, name) for name in names] + [value.context.renderer]
        yield repr(facts).encode()
    elif isinstance(value, tuple):
        for item in value:
            yield from _pieces(item)
        yield b")"
    elif hasattr(value, "__dataclass_fields__"):
        for each in fields(value):
            yield from _pieces(getattr(value, each.name))
    else:
        yield repr(value).encode() + b";"
