"""What the materials of glTF and of MTL files have in common: looks, and
images, which are opened or left out with a warning."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from facerender.errors import InputError, clipped, warn
from facerender.images.decode import open_image
from facerender.loading.references import References
from facerender.scenes.material import Material
from facerender.scenes.texture import FORMATS

if TYPE_CHECKING:
    from PIL.Image import Image


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


SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".tga")


def image_of(content: bytes) -> Image:
    """Return an image, which is decoded later.

    Raises
    ------
    ValueError : it is none that is read, is damaged or too large
    """
    try:
        return open_image(content, "it", FORMATS, "PNG, JPEG, TIFF or WebP")
    except InputError as error:
        raise ValueError(str(error)) from None


def unreadable(shown: str, kind: str, fatal: bool) -> None:
    """Tell of an image that cannot be opened: as InputError where it is needed."""
    message = f"{shown} is not an image that can be read"
    if not fatal:
        warn(f"{message}: left out")
        return
    option = {"albedo": "--albedo", "normal": "--normal-map", "roughness": "--roughness-map"}
    remedy = f", or pass {option[kind]} FILE" if kind in option else ""
    raise InputError(f"{message}; replace it{remedy}")


def missing_image(referred: References, name: str) -> None:
    """Warn of an image that is not there."""
    near = referred.folder.iterdir() if referred.folder else ()
    beside = [each.name for each in near if each.suffix.lower() in SUFFIXES]
    hint = f"pass --albedo {clipped(beside[0], 80) if len(beside) == 1 else 'FILE'}"
    warn(
        f"{clipped(name, 80)} (named by {referred.name}) "
        f"{referred.why_not(name)}: rendering without it; {hint}"
    )
