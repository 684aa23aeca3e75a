"""Short reprs of dataclasses."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any


def short_repr(value: Any) -> str:
    """Return the repr of a dataclass with only the fields that differ from their defaults."""
    words = []
    for each in fields(value):
        own = getattr(value, each.name)
        factory = each.default_factory
        if own != (each.default if factory is MISSING else factory()):
            words.append(f"{each.name}={own!r}")
    return f"{type(value).__name__}({', '.join(words)})"
