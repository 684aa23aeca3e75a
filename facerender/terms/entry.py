"""Base class of the registry's entries: the name of a term, its GLSL file and its GLSL call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from facerender.errors import check_known

ULP = 2.0**-23  # Unit in the last place of a float32 in [1, 2).


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """A term of the registry.

    Attributes
    ----------
    name : name in options and scene files, for example "v-cavity"
    file : library file that defines the term, for example "masking/v_cavity"
    call : GLSL expression of the term; each subclass documents the variables of the expression
    """

    name: str
    file: str
    call: str

    @property
    def word(self) -> str:
        """Name of the term in GLSL macros, for example "V_CAVITY"."""
        return self.name.upper().replace("-", "_")


E = TypeVar("E", bound=Entry)


def registry(*entries: E) -> dict[str, E]:
    """Return the entries keyed by their names, in the given order."""
    return {entry.name: entry for entry in entries}


def named(kind: str, entries: Mapping[str, E], name: object) -> E:
    """Return the entry with this name.

    Raises
    ------
    InputError : an unknown name
    """
    check_known(kind, name, entries)
    return entries[str(name)]
