"""Short reprs of dataclasses."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any


def short_repr(value: Any) -> str:
    """Return the repr of a dataclass with only the fields that differ from their defaults."""
    words = []
    for field in fields(value):
        field_value = getattr(value, field.name)
        factory = field.default_factory
        if field.repr and field_value != (field.default if factory is MISSING else factory()):
            words.append(f"{field.name}={field_value!r}")
    return f"{type(value).__name__}({', '.join(words)})"
