"""Measure which checks of the image comparison detect which changes, and the smallest change that
each check detects.

    python -m benchmarks.comparison

Writes docs/measurements/comparison.json. Needs an OpenGL context; half of the data also needs the
head scan of the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.data import meshes, save
from facerender.comparison.compare import compare
from facerender.comparison.result import Comparison
from facerender.images.image import encode_srgb8
from tests.verification.mutations import (
    BROKEN,
    CAMERAS,
    DRIVERS,
    HARMLESS,
    Images,
    images,
    rougher,
    setting_of,
)
from tests.verification.pairs.changes import exposed, factor
from tests.verification.pairs.room import Room, draw_elsewhere

Change = Callable[[float], Images]
Sees = Callable[[Images], bool]


# Whether a check alone detects a change. The result gives no reason for the trend if blocks exceed
# their limit.
ALONE: dict[str, Callable[[Comparison], bool]] = {
    "point": lambda result: "point" in result.failed,
    "block": lambda result: result.blocks > 0,
    "trend": lambda result: result.changed_alike,
}


def row(result: Comparison) -> dict[str, Any]:
    """Return the metrics of a comparison; block is relative for linear images, else in levels."""
    guesses = dict.fromkeys(
        reason.split("perhaps ")[-1].split(" (")[0] for reason in result.reasons
    )
    return {
        "linear": result.encoding != "srgb8",
        **{"point": result.point, "points": result.points, "block": result.block},
        **{"blocks": result.blocks, "judged": result.blocks_judged, "trend": result.trend},
        **{"texture": result.texture, "checks": list(result.failed), "looks_like": list(guesses)},
    }


def drivers() -> Iterator[dict[str, Any]]:
    """Yield the metrics of each scene rendered by two drivers."""
    for size, name, camera in product((512, 1024), dict(meshes()), CAMERAS):
        setting = setting_of(name, camera, size=size)
        drawn = (draw_elsewhere(setting, variables=each) for each in DRIVERS.values())
        yield {"image": f"{name}, {camera}, {size}"} | row(compare(*drawn))


def smallest(change: Change, found: Sees, most: float) -> float | None:
    """Return the smallest detected change, by bisection to 5 %; None if it is above ``most``."""
    low, high = 0.0, most
    if not found(change(high)):
        return None
    while high - low > 0.05 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if found(change(middle)) else (middle, high)
    return high


def sees(check: str) -> Sees:
    return lambda images: ALONE[check](compare(*images))


def differ(images: Images) -> bool:
    return not compare(*images).same


def png(images: Images) -> bool:
    return not compare(
        *(encode_srgb8(np.asarray(image, np.float32)[..., :3]) for image in images)
    ).same


def one_pixel(linear: np.ndarray, place: tuple[int, int], sign: float) -> Change:
    def change(by: float) -> Images:
        image = linear.copy()
        image[(*place, slice(0, 3))] += sign * by
        return linear, image

    return change


def places(linear: np.ndarray) -> dict[str, tuple[int, int]]:
    """Return the flattest interior pixel of median radiance, and a pixel at the silhouette."""
    full = linear[..., 3] >= 1.0
    inside = ndimage.binary_erosion(full, iterations=8)
    level = linear[..., :3].mean(axis=-1)
    contrast = ndimage.maximum_filter(level, 5) - ndimage.minimum_filter(level, 5)
    middle = inside & (np.abs(level - np.median(level[inside])) < 0.05)
    smooth = np.unravel_index(np.where(middle, contrast, np.inf).argmin(), level.shape)
    rim = np.argwhere(full & ~ndimage.binary_erosion(full))
    return {"smooth skin": smooth, "the silhouette": tuple(rim[len(rim) // 2])}


def thresholds(name: str, room: Room) -> Iterator[dict[str, Any]]:
    """Yield the smallest changes of one camera's image that are detected: by each check, and by
    the whole comparison of EXR and of PNG."""
    changes: dict[str, tuple[Change, float]] = {
        "ks, %": (lambda by: images(factor("ks", 1.0 - 0.01 * by))(room), 50.0),
        "m from 0.3, %": (lambda by: images(rougher(0.3 + 0.003 * by))(room), 50.0),
        "exposure, %": (lambda by: images(exposed(1.0 + 0.01 * by))(room), 50.0),
    }
    linear = room.golden
    for label, place in places(linear).items():
        changes[f"pixel brighter, {label}"] = (one_pixel(linear, place, 1.0), 8.0)
        changes[f"pixel darker, {label}"] = (one_pixel(linear, place, -1.0), 1.0)
    for label, (change, most) in changes.items():
        finds = {**{check: sees(check) for check in ALONE}, "EXR": differ, "PNG": png}
        seen = {check: smallest(change, find, most) for check, find in finds.items()}
        yield {"image": name, "change": label, "most": most, "seen": seen}


def main() -> None:
    changes: dict[str, object] = {}
    least: list[dict[str, Any]] = []
    for name, camera in product(dict(meshes()), CAMERAS):
        room = Room(setting_of(name, camera))
        changes[f"{name}-{camera}"] = [
            {"change": change} | row(compare(*make(room)))
            for change, make in (BROKEN | HARMLESS).items()
        ]
        least += thresholds(f"{name}, {camera}", room)
        room.renderer.release()
    save("comparison", changes=changes, drivers=[*drivers()], thresholds=least)


if __name__ == "__main__":
    main()
