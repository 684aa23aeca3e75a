"""Tests normal maps whose green points down, and the strength of normal maps."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from tests.awkward_files import MINI_HEAD, join_glb, split_glb


@pytest.fixture
def maps(tmp_path: Path) -> tuple[Path, Path]:
    """Paths of a normal map of waves with green up, and of the same map with green down."""
    y, x = np.mgrid[0:64, 0:64] * (2.0 * np.pi / 16.0)
    texels = np.stack([128 + 60 * np.sin(x), 128 + 60 * np.sin(y), 220 + 0 * x], axis=-1)
    up = texels.astype(np.uint8)
    down = up * (1, 0, 1) + (255 - up) * (0, 1, 0)
    for name, each in (("up.png", up), ("down.png", down)):
        Image.fromarray(each.astype(np.uint8)).save(tmp_path / name)
    return tmp_path / "up.png", tmp_path / "down.png"


def normals(mesh: fr.Mesh) -> Any:
    with fr.Renderer((48, 48), samples=1) as renderer:
        return renderer.gbuffer(fr.Scene(mesh)).normal


@pytest.mark.slow
def test_green_that_points_down(maps: tuple[Path, Path]):
    up, down = maps
    wanted = normals(fr.load_mesh(MINI_HEAD, normal_map=up))
    turned = fr.load_mesh(MINI_HEAD, normal_map=down, normal_map_y="down")
    assert np.array_equal(normals(turned), wanted)
    assert not np.allclose(normals(fr.load_mesh(MINI_HEAD, normal_map=down)), wanted, atol=0.05)
    assert np.array_equal(normals(copy.deepcopy(turned)), wanted)


def test_green_down_applies_to_maps_of_the_mesh_file(maps: tuple[Path, Path], tmp_path: Path):
    document, binary = split_glb(MINI_HEAD.read_bytes())
    document["images"].append({"uri": "down.png"})
    document["textures"].append({"source": len(document["images"]) - 1, "sampler": 0})
    for material in document["materials"]:
        material["normalTexture"] = {"index": len(document["textures"]) - 1}
    path = tmp_path / "head.glb"
    path.write_bytes(join_glb(document, binary))
    wanted = normals(fr.load_mesh(MINI_HEAD, normal_map=maps[0]))
    assert np.array_equal(normals(fr.load_mesh(path, normal_map_y="down")), wanted)


def test_cache_distinguishes_the_green_direction(
    maps: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("FACERENDER_CACHE_MIB", "100")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found = [
        normals(fr.load_mesh(MINI_HEAD, normal_map=maps[1], normal_map_y=y, cache=True))
        for y in ("down", "up", "down")
    ]
    assert np.array_equal(found[0], found[2])
    assert not np.allclose(found[0], found[1], atol=0.05)


@pytest.mark.slow
def test_options_of_render(maps: tuple[Path, Path], tmp_path: Path):
    start = ["render", str(MINI_HEAD), "--size", "32", "--samples", "1", "-o"]
    up, down, flat, plain = (str(tmp_path / f"{name}.png") for name in "abcd")
    assert main([*start, up, "--normal-map", str(maps[0])]) == 0
    assert main([*start, down, "--normal-map", str(maps[1]), "--normal-map-y", "down"]) == 0
    assert main([*start, flat, "--normal-map", str(maps[0]), "--normal-strength", "0"]) == 0
    assert main([*start, plain]) == 0
    a, b, c, d = (np.asarray(Image.open(each)).astype(int) for each in (up, down, flat, plain))
    assert np.array_equal(a, b)
    assert np.abs(a - d).max() > 20
    assert np.abs(c - d).max() <= 1


def test_invalid_green_direction_is_refused():
    for make in (lambda: fr.load_mesh(normal_map_y="left"), lambda: fr.MeshFile(normal_map_y="x")):
        with pytest.raises(fr.InputError, match="unknown mesh normal_map_y '.*'; known: up, down"):
            make()
