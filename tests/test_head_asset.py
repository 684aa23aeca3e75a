"""Tests the built-in head: properties that loaders and shaders rely on, and that ``tools.head``
still generates it."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.conftest import require_module

ROOT = Path(__file__).parents[1]
HEAD = ROOT / "assets" / "head.glb"


@dataclass(frozen=True)
class Head:
    """A head read by trimesh, and the JSON of its file."""

    description: dict[str, Any]
    mesh: Any

    @property
    def albedo(self) -> Image.Image:
        return self.mesh.visual.material.baseColorTexture

    @property
    def normal_map(self) -> Image.Image:
        return self.mesh.visual.material.normalTexture

    @property
    def occlusion_roughness(self) -> Image.Image:
        return self.mesh.visual.material.metallicRoughnessTexture

    @property
    def face_normals(self) -> np.ndarray:
        """Normals by the order of the corners, not normalised."""
        a, b, c = np.moveaxis(self.mesh.vertices[self.mesh.faces], 1, 0)
        return np.cross(b - a, c - a)


def read_head(path: Path) -> Head:
    import trimesh

    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    scene = trimesh.load_scene(path, process=False)
    (mesh,) = scene.geometry.values()
    return Head(json.loads(content[20 : 20 + length]), mesh)


@pytest.fixture(scope="module")
def head() -> Head:
    return read_head(HEAD)


def test_file_is_small_and_suits_strict_readers(head: Head):
    assert HEAD.stat().st_size < 3_000_000
    description = head.description
    assert description["asset"] == {"version": "2.0", "generator": "facerender tools/head"}
    assert all(view["byteOffset"] % 4 == 0 for view in description["bufferViews"])
    (mesh,) = description["meshes"]
    (primitive,) = mesh["primitives"]
    attributes = primitive["attributes"]
    assert set(attributes) == {"POSITION", "NORMAL", "TEXCOORD_0"}
    position = description["accessors"][attributes["POSITION"]]
    assert position["min"] == pytest.approx(head.mesh.vertices.min(0).tolist())
    assert position["max"] == pytest.approx(head.mesh.vertices.max(0).tolist())
    unsigned_short = 5123
    assert description["accessors"][primitive["indices"]]["componentType"] == unsigned_short
    assert len(head.mesh.vertices) < 65_535
    assert len(description["samplers"]) == 1
    assert all("sampler" in texture for texture in description["textures"])


def test_head_has_one_dielectric_material_with_maps(head: Head):
    (material,) = head.description["materials"]
    factors = material["pbrMetallicRoughness"]
    assert (factors["metallicFactor"], factors["roughnessFactor"]) == (0, 1)
    assert material["occlusionTexture"] == factors["metallicRoughnessTexture"]
    maps = head.albedo, head.normal_map, head.occlusion_roughness
    assert [each.size[0] for each in maps] == [2048, 2048, 1024]
    assert all(each.size[0] == each.size[1] for each in maps)


def test_vertices_are_finite_and_faces_look_outwards(head: Head):
    mesh = head.mesh
    for values in (mesh.vertices, mesh.vertex_normals, mesh.visual.uv):
        assert np.isfinite(values).all()
    assert np.abs(np.linalg.norm(mesh.vertex_normals, axis=1) - 1).max() < 1e-5
    assert ((head.face_normals * mesh.vertex_normals[mesh.faces].mean(1)).sum(1) > 0).all()
    a, b, c = mesh.faces.T
    assert ((a != b) & (b != c) & (c != a)).all()
    assert np.linalg.norm(head.face_normals, axis=1).min() > 1e-10, "m^2: no face is degenerate"
    # Volume by the divergence theorem; the plane of the neck's open cut closes the surface.
    centres = mesh.vertices[mesh.faces].mean(1) - (0, mesh.vertices[:, 1].min(), 0)
    volume = (centres * head.face_normals).sum() / 6
    assert 0.004 < volume < 0.009, "m^3; a head and neck hold 5 to 8 litres"


def test_rims_of_the_ears_are_round(head: Head):
    """Normals must not turn much along an edge, or the silhouette shows notches."""
    edges = head.mesh.edges_unique
    outer = np.abs(head.mesh.vertices[edges].mean(1)[:, 0]) > 0.078
    start, end = np.moveaxis(head.mesh.vertex_normals[edges[outer]], 1, 0)
    turn = np.degrees(np.arccos(np.clip((start * end).sum(1), -1, 1)))
    assert (turn > 45).mean() < 0.01


def test_head_is_in_metres_and_faces_z(head: Head):
    lowest, highest = (0.14, 0.25, 0.18), (0.24, 0.32, 0.24)  # width, height, depth
    size = np.ptp(head.mesh.vertices, axis=0)
    assert (size > lowest).all()
    assert (size < highest).all()
    x, y, _ = head.mesh.vertices[head.mesh.vertices[:, 2].argmax()]
    assert abs(x) < 0.01, "the tip of the nose is the foremost point"
    assert -0.05 < y < -0.02


def test_maps_are_not_mirrored_and_hold_skin(head: Head):
    # In a mirrored texture, the bitangent cross(N, T) has the wrong sign: bumps become dents.
    a, b, c = np.moveaxis(head.mesh.visual.uv[head.mesh.faces], 1, 0)  # v up, as trimesh has it
    area = np.linalg.norm(head.face_normals, axis=1)
    turned = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] <= 0
    assert area[turned].sum() < 0.01 * area.sum()
    vectors = np.asarray(head.normal_map, np.float32) / 127.5 - 1
    assert vectors[..., 2].min() > 0
    lengths = np.linalg.norm(vectors, axis=2)
    assert np.percentile(np.abs(lengths - 1), 99) < 0.1, "JPEG may bend a few texels"
    assert np.abs(vectors[..., :2].mean((0, 1))).max() < 0.03
    slope = (np.asarray(head.occlusion_roughness, np.float64)[..., 1] / 255) ** 2
    assert 0.17 < slope.min() < slope.max() < 0.56
    assert np.ptp(slope) > 0.1, "the slope differs between lips, nose and scalp"


def one_sided_distance(points: np.ndarray, others: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    return float(cKDTree(others).query(points)[0].max())


@pytest.mark.slow
def test_generator_still_makes_the_committed_head(head: Head, tmp_path: Path):
    """Textures of 512 texels take only seconds; the mesh does not depend on their size."""
    require_module("skimage")
    path = tmp_path / "head.glb"
    command = [sys.executable, "-m", "tools.head", "--texture-size", "512", "-o", path]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=300)
    made = read_head(path)

    # Other library versions may place vertices elsewhere on the same surface, at most half an edge
    # (1 to 4 mm) away.
    assert one_sided_distance(made.mesh.vertices, head.mesh.vertices) < 0.002
    assert one_sided_distance(head.mesh.vertices, made.mesh.vertices) < 0.002
    for name in ("albedo", "normal_map", "occlusion_roughness"):
        mean = np.asarray(getattr(made, name), np.float64).mean((0, 1))
        committed = np.asarray(getattr(head, name), np.float64).mean((0, 1))
        assert mean == pytest.approx(committed, abs=2.0), f"{name}, of 255"
