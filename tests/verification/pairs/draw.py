"""Draws every scene as golden and once per change, and keeps what is known of each pair.

A pair of a scene is a golden and a picture, both EXR or both as the product writes 8-bit images.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.srgb import linear_to_srgb
from facerender.images.write import save_png
from facerender.system.atomic import write_bytes, write_text
from tests.verification.pairs.changes import CHANGES, Against, Change, Encode, Encoded, Format, Must
from tests.verification.pairs.room import Linear, Room
from tests.verification.pairs.scenes import SETTINGS, Half, Setting

FLOORS: dict[Format, float] = {"exr": 0.5, "png": 1.0}
DARK = 0.01  # radiance of which a change is taken at the least, relative
INDEX = "index.json"
WORKERS = 2
_PAIRS = "pairs.json"


@dataclass(frozen=True)
class Pair:
    """Two pictures, and whether a comparison must tell them apart.

    Attributes
    ----------
    golden, image : paths relative to the index
    effect : largest change of a colour of any pixel; of EXR in percent of the golden's radiance or
        of 0.01, of 8-bit images in steps of 255, before they are rounded where there is such
    above_floor : whether it is above what the encoding has of noise, FLOORS
    identical : whether the files hold the same pixels
    """

    scene: str
    half: Half
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
    """Return a frame's colours as an 8-bit picture shows them, linear."""
    color, coverage = frame.linear[..., :3].astype(np.float64), frame.linear[..., 3:]
    return color / np.maximum(coverage, 1e-6) if frame.transparent else color


def steps(frame: fr.Frame, encode: Encode | None = None) -> NDArray[np.float64]:
    """Return the channels of a frame's 8-bit picture before they are rounded.

    encode : of linear values, those in [0, 1]; None for sRGB
    """
    color = 255.0 * (encode or linear_to_srgb)(straight(frame))
    coverage = 255.0 * np.clip(frame.linear[..., 3:], 0.0, 1.0)
    return np.concatenate([color, coverage], axis=-1) if frame.transparent else color


def relative(golden: Linear, image: Linear) -> float:
    """Return the largest change of a colour in percent."""
    a, b = golden[..., :3].astype(np.float64), image[..., :3].astype(np.float64)
    return float((100.0 * np.abs(b - a) / np.maximum(a, DARK)).max())


def largest(a: NDArray[np.number], b: NDArray[np.number]) -> float:
    return float(np.abs(b.astype(np.float64) - a).max())


def slug(name: str) -> str:
    """Return a change's name as that of a file."""
    return re.sub(r"[^a-z0-9.+-]+", "-", name.lower().replace(" %", "")).strip("-")


class Drawer:
    """Draws the pairs of a scene into a folder of its own."""

    def __init__(self, setting: Setting, out: Path) -> None:
        self.out, self.setting = out, setting
        self.folder = out / setting.name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.room = Room(self.setting)
        self.known = {(pair.change, pair.format): pair for pair in read_pairs(self.folder / _PAIRS)}

    def draw(self, names: Sequence[str]) -> None:
        """Draw what is missing of some changes."""
        none_of = self.folder / "none.json"  # what the scene has nothing of
        absent = set(json.loads(none_of.read_text())) if none_of.exists() else set()
        for name in names:
            change = CHANGES[name]
            formats = change.formats if isinstance(change, Change) else ("png",)
            if name in absent or all(self.is_there(name, each) for each in formats):
                continue
            pairs = [*(self.drawn(change) if isinstance(change, Change) else self.encoded(change))]
            self.known |= {(pair.change, pair.format): pair for pair in pairs}
            if not pairs:
                absent.add(name)
                write_text(none_of, json.dumps(sorted(absent)))
            write_pairs(self.folder / _PAIRS, [*self.known.values()])

    def is_there(self, change: str, kind: Format) -> bool:
        pair = self.known.get((change, kind))
        return pair is not None and (self.out / pair.image).exists()

    def drawn(self, change: Change) -> Iterator[Pair]:
        made = change.make(self.room)
        if made is None:
            return
        if not isinstance(made, Against):
            made = Against("golden", self.room.golden, made, self.setting.samples)
        a, b = self.room.frame(made.golden), self.room.frame(made.image, made.renderer)
        for kind in change.formats:
            golden, image = (
                self.folder / f"{each}.{kind}" for each in (made.name, slug(change.name))
            )
            if not golden.exists():
                a.save(golden)
            if kind == "exr":
                b.save(image)
                effect, same = relative(a.linear, b.linear), np.array_equal(a.linear, b.linear)
            else:
                after = steps(b, change.encode)
                pixels = b.srgb8()
                if change.encode:
                    pixels[..., :3] = np.round(after[..., :3])
                save_png(image, pixels, b.metadata)
                effect, same = largest(steps(a), after), np.array_equal(a.srgb8(), pixels)
            yield self.pair(change, kind, golden, image, made.samples, effect, same)

    def encoded(self, change: Encoded) -> Iterator[Pair]:
        a = self.room.frame(self.room.golden)
        golden = self.folder / "golden.png"
        image = self.folder / f"{slug(change.name)}.png"
        if not golden.exists():
            a.save(golden)
        content = change.make(a.srgb8())
        if content is not None:
            write_bytes(image, content)
            with Image.open(image) as file:
                pixels = np.asarray(file)
            effect = largest(a.srgb8(), pixels)
            yield self.pair(change, "png", golden, image, self.setting.samples, effect, False)

    def pair(
        self,
        change: Change | Encoded,
        kind: Format,
        golden: Path,
        image: Path,
        samples: int,
        effect: float,
        same: bool,
    ) -> Pair:
        return Pair(
            scene=self.setting.name,
            half=self.setting.half,
            change=change.name,
            must=change.must,
            format=kind,
            golden=str(golden.relative_to(self.out)),
            image=str(image.relative_to(self.out)),
            samples=samples,
            size=self.setting.size,
            effect=effect,
            above_floor=effect > FLOORS[kind],
            identical=bool(same),
        )


def read_pairs(path: Path) -> list[Pair]:
    """Return the pairs of an index; none where it is not there."""
    return [Pair(**each) for each in json.loads(path.read_text())] if path.exists() else []


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    rows = ",\n".join(json.dumps(asdict(pair)) for pair in pairs)
    write_text(path, f"[\n{rows}\n]\n")


def draw_scene(name: str, out: Path, changes: Sequence[str]) -> str:
    drawer = Drawer(SETTINGS[name], out)
    drawer.draw(changes)
    drawer.room.renderer.release()
    return name


def draw_suite(
    out: Path,
    scenes: Sequence[str] = (*SETTINGS,),
    changes: Sequence[str] = (*CHANGES,),
) -> Iterator[str]:
    """Draw the pairs that a folder lacks, and keep the index there; yields the scenes as they are
    done."""
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        work = [pool.submit(draw_scene, name, out, changes) for name in scenes]
        for done in as_completed(work):
            yield done.result()
            write_index(out)


def write_index(out: Path) -> list[Pair]:
    """Collect the pairs of all scenes."""
    pairs = [pair for name in SETTINGS for pair in read_pairs(out / name / _PAIRS)]
    write_pairs(out / INDEX, pairs)
    return pairs
