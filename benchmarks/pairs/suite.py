"""Rendering of the suite: each scene as golden and once per change, with an index of the pairs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.pairs.unchanged import file_of
from benchmarks.pairs.webgl import draw_webgl
from facerender.images.files import read_image
from facerender.system.files import write_text
from tests.verification import chromium
from tests.verification.pairs.changes import CHANGES, Against, Change, with_one_sample
from tests.verification.pairs.draw import Pair, draw
from tests.verification.pairs.room import Linear, Room
from tests.verification.pairs.scenes import SETTINGS, Setting

INDEX = "index.json"
WORKERS = 2
_PAIRS = "pairs.json"


def swiftshader(room: Room) -> Against | None:
    """Render with WebGL 2 on SwiftShader, with one sample, if :func:`draw_webgl` can."""
    from playwright.sync_api import sync_playwright

    if any(each.scattering or each.refracts for each in room.scene.mesh.materials):
        return None
    scene = room.scene, room.setting.shading, room.size, room.setting.float_albedo
    with sync_playwright() as playwright, chromium.launch(playwright) as browser:
        return with_one_sample(room, draw_webgl(browser, *scene), "SwiftShader")


def machines(drawn: Path) -> dict[str, Change]:
    """Return the changes that replace the image by one of ``benchmarks.pairs.unchanged``."""

    def image(room: Room, samples: int) -> tuple[Linear, str] | None:
        file = file_of(drawn, room.setting, samples)
        if not file.exists():
            return None
        found = read_image(file)
        return found.pixels.astype(np.float32), found.metadata["GL_RENDERER"]

    def as_golden(room: Room) -> Against | None:
        samples = room.setting.samples
        found = image(room, samples)
        return Against("golden", room.golden, found[0], samples, found[1]) if found else None

    def single(room: Room) -> Against | None:
        found = image(room, 1) if room.setting.samples > 1 else None
        return with_one_sample(room, *found) if found else None

    makers = {"another machine": as_golden, "another machine, 1 sample": single}
    return {name: Change(name, "pass", make) for name, make in makers.items()}


SUITE = CHANGES | {"SwiftShader": Change("SwiftShader", "pass", swiftshader)}


def draw_missing(
    setting: Setting, out: Path, names: Sequence[str], drawn: Path | None = None
) -> None:
    """Render the pairs of a scene's changes that are missing in a folder.

    drawn : folder of ``benchmarks.pairs.unchanged``; None for no pairs of another machine
    """
    folder = out / setting.name
    folder.mkdir(parents=True, exist_ok=True)
    none_of = folder / "none.json"  # changes without effect on this scene, which give no pair
    absent = set(json.loads(none_of.read_text())) if none_of.exists() else set()
    known = {(pair.change, pair.format): pair for pair in read_pairs(folder / _PAIRS)}
    there = {key for key, pair in known.items() if (out / pair.image).exists()}
    room = Room(setting)
    others = machines(drawn) if drawn else {}
    for name, change in {**{name: SUITE[name] for name in names}, **others}.items():
        formats = change.formats if isinstance(change, Change) else ("png",)
        if name in absent or all((name, each) in there for each in formats):
            continue
        pairs = [*draw(room, change, out)]
        known |= {(pair.change, pair.format): pair for pair in pairs}
        if not pairs and name in SUITE:
            absent.add(name)
            write_text(none_of, json.dumps(sorted(absent)))
        write_pairs(folder / _PAIRS, [*known.values()])
    room.renderer.release()


def draw_scene(name: str, out: Path, changes: Sequence[str], drawn: Path | None) -> str:
    draw_missing(SETTINGS[name], out, changes, drawn)
    return name


def draw_suite(
    out: Path,
    scenes: Sequence[str] = (*SETTINGS,),
    changes: Sequence[str] = (*SUITE,),
    drawn: Path | None = None,
) -> Iterator[str]:
    """Render the pairs that are missing in a folder, and update its index.

    drawn : see :func:`draw_missing`

    Yields the name of each finished scene.
    """
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        work = [pool.submit(draw_scene, name, out, changes, drawn) for name in scenes]
        for done in as_completed(work):
            yield done.result()
            write_index(out)


def read_pairs(path: Path) -> list[Pair]:
    """Return the pairs of an index; an empty list if the file does not exist."""
    return [Pair(**each) for each in json.loads(path.read_text())] if path.exists() else []


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    rows = ",\n".join(json.dumps(asdict(pair)) for pair in pairs)
    write_text(path, f"[\n{rows}\n]\n")


def write_index(out: Path) -> list[Pair]:
    """Write the index of the pairs of all scenes, and return the pairs."""
    pairs = [pair for name in SETTINGS for pair in read_pairs(out / name / _PAIRS)]
    write_pairs(out / INDEX, pairs)
    return pairs
