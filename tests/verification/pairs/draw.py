"""Writes the pairs of a change as files. Golden and image are both EXR, or both 8-bit images as
facerender writes them, both PNG or both JPEG."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.files import pillow_bytes, png_bytes
from facerender.images.image import linear_to_srgb
from facerender.system.files import write_bytes
from tests.verification.pairs.changes import Against, Change, Encode, Encoded, Format, Must
from tests.verification.pairs.room import Linear, Room
from tests.verification.pairs.scenes import Group

FLOORS: dict[Format, float] = {"exr": 0.5, "png": 1.0, "jpeg": 1.0}
DARK = 0.01  # smallest radiance that a relative change is divided by
BLOCK = 8  # pixels; JPEG encodes blocks of this side


@dataclass(frozen=True)
class Pair:
    """Two images, and whether a comparison must fail them.

    Attributes
    ----------
    golden, image : paths relative to the folder of all scenes
    effect : largest change of a colour channel of any pixel. EXR: in percent of the golden's
        radiance or of 0.01. PNG: in levels, before rounding if the change is of linear values.
        JPEG: see :func:`above_codec`
    above_floor : whether the effect is above the noise of the encoding, FLOORS
    identical : whether the files hold the same pixels
    """

    scene: str
    group: Group
    change: str
    must: Must
    format: Format
    golden: str
    image: str
    samples: int
    size: int
    effect: float
    above_floor: bool
    identical: bool


def straight(frame: fr.Frame) -> NDArray[np.float64]:
    """Return a frame's linear colours, divided by coverage if the background is transparent."""
    color, coverage = frame.linear[..., :3].astype(np.float64), frame.linear[..., 3:]
    return color / np.maximum(coverage, 1e-6) if frame.transparent else color


def steps(frame: fr.Frame, encode: Encode | None = None) -> NDArray[np.float64]:
    """Return the channels of a frame's 8-bit image before rounding.

    encode : maps linear values to [0, 1]; default sRGB
    """
    color = 255.0 * (encode or linear_to_srgb)(straight(frame))
    coverage = 255.0 * np.clip(frame.linear[..., 3:], 0.0, 1.0)
    return np.concatenate([color, coverage], axis=-1) if frame.transparent else color


def relative(golden: Linear, image: Linear) -> float:
    """Return the largest relative change of a colour channel, in percent."""
    a, b = golden[..., :3].astype(np.float64), image[..., :3].astype(np.float64)
    return float((100.0 * np.abs(b - a) / np.maximum(a, DARK)).max())


def largest(a: NDArray[np.number], b: NDArray[np.number]) -> float:
    return float(np.abs(b.astype(np.float64) - a).max())


def above_codec(
    golden: NDArray[np.number], image: NDArray[np.number], decoded: NDArray[np.uint8]
) -> float:
    """Return the largest ratio, in a channel of any block, of the RMS change to the RMS error of
    the golden's JPEG encoding or 1 level, whichever is more.

    golden, image : levels before rounding, (H, W, 3)
    decoded : the golden's pixels after decoding
    """
    height, width = (BLOCK * (side // BLOCK) for side in golden.shape[:2])

    def blocks(difference: NDArray[np.number]) -> NDArray[np.float64]:
        cut = np.asarray(difference[:height, :width], dtype=np.float64)
        cut = cut.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, -1)
        return np.asarray(np.sqrt((cut**2).mean(axis=(1, 3))))

    return float((blocks(image - golden) / blocks(decoded - golden).clip(1.0)).max())


def slug(name: str) -> str:
    """Return the file name of a change."""
    return re.sub(r"[^a-z0-9.+-]+", "-", name.lower().replace(" %", "")).strip("-")


def draw(room: Room, change: Change | Encoded, out: Path) -> Iterator[Pair]:
    """Write the pairs of a change into the folder of the room's scene, and yield them.

    An existing golden stays. Nothing is yielded if the change does not apply to the scene.
    """
    name, setting = change.name, room.setting
    folder = out / setting.name
    folder.mkdir(parents=True, exist_ok=True)

    def pair(
        kind: Format, golden: Path, image: Path, samples: int, effect: float, same: bool
    ) -> Pair:
        a, b = (str(each.relative_to(out)) for each in (golden, image))
        about = setting.name, setting.group, name, change.must, kind
        above = effect > FLOORS[kind]
        return Pair(*about, a, b, samples, setting.size, effect, above, bool(same))

    if isinstance(change, Encoded):
        a, golden = room.frame(room.golden), folder / "golden.png"
        image = folder / f"{slug(name)}.png"
        if (content := change.make(a.srgb8())) is not None:
            if not golden.exists():
                a.save(golden)
            write_bytes(image, content)
            with Image.open(image) as file:
                effect = largest(a.srgb8(), np.asarray(file))
            yield pair("png", golden, image, setting.samples, effect, False)
        return
    if (made := change.make(room)) is None:
        return
    if not isinstance(made, Against):
        made = Against("golden", room.golden, made, setting.samples)
    a, b = room.frame(made.golden), room.frame(made.image, made.renderer)
    jpeg: tuple[Format, ...] = ("jpeg",) if setting.group == "judge" else ()
    for kind in (*change.formats, *(jpeg if "png" in change.formats else ())):
        golden, image = (folder / f"{each}.{kind}" for each in (made.name, slug(name)))
        if kind == "jpeg":  # without alpha
            a, b = (replace(each, transparent=False) for each in (a, b))
        if not golden.exists():
            a.save(golden)
        if kind == "exr":
            b.save(image)
            effect, same = relative(a.linear, b.linear), np.array_equal(a.linear, b.linear)
        else:
            after, pixels = steps(b, change.encode), b.srgb8()
            if change.encode:
                pixels[..., :3] = np.round(after[..., :3])
            same = np.array_equal(a.srgb8(), pixels)
            if kind == "png":
                write_bytes(image, png_bytes(pixels, b.metadata))
                effect = largest(steps(a), after)
            else:
                write_bytes(image, pillow_bytes("jpeg", pixels, b.metadata))
                with Image.open(golden) as file:
                    effect = above_codec(steps(a), after, np.asarray(file))
        yield pair(kind, golden, image, made.samples, effect, same)
