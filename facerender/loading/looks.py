"""What the materials of glTF and of MTL files have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from facerender.errors import warn
from facerender.scenes.material import Material

Transform = TypeVar("Transform")


@dataclass(frozen=True)
class Look(Generic[Transform]):
    """A material, and what transforms the texture coordinates of its maps: of those that it names
    as ``second_uv`` the second, of the others the first."""

    material: Material
    first: Transform
    second: Transform | None = None


def second_of(transforms: Iterable[Transform], first: Transform) -> Transform | None:
    """Return the first of these that is another than ``first``."""
    return next((each for each in transforms if each != first), None)


class WarnOnce:
    """Warns of each thing once."""

    def __init__(self) -> None:
        self.warned: set[str] = set()

    def __call__(self, message: str) -> None:
        if message not in self.warned:
            self.warned.add(message)
            warn(message)
