"""What every entry of the registry has: a name, and where and how GLSL evaluates it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from facerender.errors import InputError

ULP = 2.0**-23  # of float32


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """A term of the registry.

    Attributes
    ----------
    name : as users write it, such as "v-cavity"
    file : of the library, that defines it, such as "masking/v_cavity"
    call : GLSL that evaluates it; of which variables, the kind says
    """

    name: str
    file: str
    call: str

    @property
    def word(self) -> str:
        """The name as GLSL writes it in capitals."""
        return self.name.upper().replace("-", "_")


E = TypeVar("E", bound=Entry)


def registry(*entries: E) -> dict[str, E]:
    """Return entries by name, in their order."""
    return {entry.name: entry for entry in entries}


def named(kind: str, entries: Mapping[str, E], name: object) -> E:
    """Return the entry of a name.

    Raises
    ------
    InputError : an unknown name
    """
    if not isinstance(name, str) or name not in entries:
        raise InputError(f"unknown {kind} {name!r}; known: {', '.join(entries)}")
    return entries[name]
