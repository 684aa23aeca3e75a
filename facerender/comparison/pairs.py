"""Pairs of images, from files, folders and arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from facerender.comparison.compare import Comparable, as_image, compare
from facerender.comparison.result import Comparison
from facerender.errors import InputError
from facerender.images.image import Encoding, ImageData
from facerender.images.read import SUFFIXES


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and what comparing them gave: metrics, or the error that made it impossible.

    Attributes
    ----------
    name : of the pair
    reference, image : None where it could not be read
    comparison, error : one of the two
    """

    name: str
    reference: ImageData | None
    image: ImageData | None
    comparison: Comparison | None
    error: str = ""

    @classmethod
    def of(
        cls,
        name: str,
        reference: Comparable,
        image: Comparable,
        limits: Mapping[Encoding, Mapping[str, float]] = MappingProxyType({}),
        **options: Any,
    ) -> Pair:
        """Compare two images; the options are those of :func:`compare`, and the limits take the
        place of those that are None, by the images' encoding."""
        images: list[ImageData | None] = []
        errors = []
        for source, letter in ((reference, "A"), (image, "B")):
            try:
                images.append(as_image(source, letter))
            except InputError as error:
                images.append(None)
                errors.append(str(error))
        a, b = images
        if a is None or b is None:
            return cls(name, a, b, None, errors[0])
        try:
            own = {key: value for key, value in options.items() if value is not None}
            allowed: dict[str, Any] = {**limits.get(a.encoding, {}), **own}
            return cls(name, a, b, compare(a, b, **allowed))
        except InputError as error:
            return cls(name, a, b, None, str(error))

    @property
    def status(self) -> int:
        """0 the same, 1 they differ, 2 they cannot be compared."""
        return 2 if self.comparison is None else int(not self.comparison.same)

    def as_dict(self) -> dict[str, Any]:
        """Return name, error and every figure, for JSON."""
        metrics = {} if self.comparison is None else self.comparison.as_dict()
        return {"name": self.name, "error": self.error, **metrics}


def pairs_of(a: str | os.PathLike[str], b: str | os.PathLike[str]) -> list[tuple[str, Path, Path]]:
    """Return name, reference and image of two files, or of every image in two folders.

    Raises
    ------
    InputError : a file and a folder, or folders without an image
    """
    a, b = Path(a), Path(b)
    if os.path.isdir(a) != os.path.isdir(b):
        raise InputError(f"one of {a} and {b} is a folder: give two folders, or two images")
    if not os.path.isdir(a):
        return [(b.name, a, b)]
    names = {
        path.relative_to(folder).as_posix()
        for folder in (a, b)
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES
    }
    if not names:
        raise InputError(f"no image in {a} and {b}: give folders of {', '.join(SUFFIXES)} files")
    return [(name, a / name, b / name) for name in sorted(names)]
