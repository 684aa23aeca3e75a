"""Tests the built-in head: properties that loaders and shaders rely on, and that ``tools.head``
still generates it."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from tests.conftest import require_module

ROOT = Path(__file__).parents[1]
HEAD = ROOT / "assets" / "head.glb"


PARTS = ("head", "eyeballs", "lash-strands", "tear-line", "cornea")


@dataclass(frozen=True)
class Head:
    """A head read by trimesh, and the JSON of its file."""

    description: dict[str, Any]
    parts: dict[str, Any]

    @property
    def mesh(self) -> Any:
        return self.parts["head"]

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
    return Head(json.loads(content[20 : 20 + length]), dict(scene.geometry))


@pytest.fixture(scope="module")
def head() -> Head:
    return read_head(HEAD)


def test_file_is_small_and_suits_strict_readers(head: Head):
    assert HEAD.stat().st_size < 3_400_000
    description = head.description
    assert description["asset"] == {"version": "2.0", "generator": "facerender tools/head"}
    assert all(view["byteOffset"] % 4 == 0 for view in description["bufferViews"])
    assert tuple(mesh["name"] for mesh in description["meshes"]) == tuple(head.parts) == PARTS
    unsigned_short = 5123
    for mesh in description["meshes"]:
        (primitive,) = mesh["primitives"]
        attributes = primitive["attributes"]
        mapped = {"TEXCOORD_0"} if mesh["name"] in ("head", "eyeballs") else set()
        assert set(attributes) == {"POSITION", "NORMAL"} | mapped
        position = description["accessors"][attributes["POSITION"]]
        vertices = head.parts[mesh["name"]].vertices
        assert position["min"] == pytest.approx(vertices.min(0).tolist())
        assert position["max"] == pytest.approx(vertices.max(0).tolist())
        assert description["accessors"][primitive["indices"]]["componentType"] == unsigned_short
        assert len(vertices) < 65_535
    assert sum(len(mesh.faces) for mesh in head.parts.values()) < 80_000
    assert len(description["samplers"]) == 1
    assert all("sampler" in texture for texture in description["textures"])


def test_head_has_a_dielectric_material_with_maps(head: Head):
    material = head.description["materials"][0]
    factors = material["pbrMetallicRoughness"]
    assert (factors["metallicFactor"], factors["roughnessFactor"]) == (0, 1)
    assert material["occlusionTexture"] == factors["metallicRoughnessTexture"]
    maps = head.albedo, head.normal_map, head.occlusion_roughness
    assert [each.size[0] for each in maps] == [2048, 2048, 1024]
    assert all(each.size[0] == each.size[1] for each in maps)


def test_parts_of_the_eyes_have_materials(head: Head):
    materials = {each["name"]: each for each in head.description["materials"]}
    assert tuple(materials) == ("skin", *PARTS[1:])
    mesh = fr.load_mesh(HEAD)
    found = {part.name: material for part, material in zip(mesh.parts, mesh.materials, strict=True)}
    assert tuple(found) == PARTS
    cornea, tear = found["cornea"], found["tear-line"]
    assert (cornea.transmission, cornea.refraction) == (1.0, 1.336)
    assert cornea.m == pytest.approx(0.03, abs=0.001)
    assert (tear.transmission, tear.refraction) == (1.0, 1.0)
    assert tear.f0 == pytest.approx((0.337 / 2.337) ** 2)
    thickness = materials["cornea"]["extensions"]["KHR_materials_volume"]["thicknessFactor"]
    assert thickness == pytest.approx(0.0036), "m, from the apex to the iris"
    assert "KHR_materials_volume" not in materials["tear-line"]["extensions"]
    assert max(found["lash-strands"].albedo) < 0.02
    for name, alpha in (("head", "opaque"), ("eyeballs", "opaque"), ("lash-strands", "blend")):
        assert (found[name].transmission, found[name].alpha) == (0.0, alpha)
    roughness = np.asarray(head.parts["eyeballs"].visual.material.metallicRoughnessTexture)
    assert ((roughness[..., 1] / 255) ** 2).min() > 0.1, "the cornea has the highlight"


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


@dataclass(frozen=True)
class MeasuredEye:
    """An eye of the file, in mm, relative to the centre of its sclera; +x away from the nose."""

    side: int
    centre: np.ndarray
    head: Head

    def vertices(self, name: str) -> np.ndarray:
        """Vertices of a part on this side of the head."""
        found = 1000 * self.head.parts[name].vertices
        found = found[found[:, 0] * self.side > 0]
        return (found - self.centre) * (self.side, 1, 1)


def fitted_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere through points, by least squares."""
    system = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0]
    return solution[:3], float(np.sqrt(solution[3] + (solution[:3] ** 2).sum()))


@pytest.fixture(params=[1, -1], ids=["left", "right"])
def eye(request: pytest.FixtureRequest, head: Head) -> MeasuredEye:
    ball = 1000 * head.parts["eyeballs"].vertices
    ball = ball[ball[:, 0] * request.param > 0]
    behind_limbus = ball[:, 2] < np.sort(ball[:, 2])[-200]
    away = np.hypot(*(ball - ball.mean(0))[:, :2].T) > 7
    centre, radius = fitted_sphere(ball[behind_limbus & away])
    assert 11.5 < radius < 12.0, "mm, of the sclera"
    return MeasuredEye(request.param, centre, head)


def test_eyes_have_anatomical_dimensions(eye: MeasuredEye):
    """In mm; from the anatomy of an adult eye."""
    cornea, ball = eye.vertices("cornea"), eye.vertices("eyeballs")
    off_axis = np.hypot(*cornea[:, :2].T)
    centre, radius = fitted_sphere(cornea[off_axis < 5])
    assert radius == pytest.approx(7.8, abs=0.05)
    assert np.abs(centre[:2]).max() < 0.02, "the eye looks straight ahead"
    apex = cornea[:, 2].max()
    assert 12.6 < apex < 13.0

    off_axis_ball = np.hypot(*ball[:, :2].T)
    limbus = ball[:, 2] > ball[:, 2].max() - 0.01
    assert 2 * off_axis_ball[limbus] == pytest.approx(11.7, abs=0.1)
    iris = (np.abs(ball[:, 2] - (apex - 3.6)) < 0.05) & (off_axis_ball < 6.5)
    assert 2 * off_axis_ball[iris].max() == pytest.approx(12.0, abs=0.1)
    assert 2 * off_axis_ball[iris].min() == pytest.approx(3.5, abs=0.1)
    # Beyond the limbus, the cornea leaves the sclera nowhere by more than its smooth transition.
    height = np.linalg.norm(cornea, axis=1) - 11.75
    assert np.abs(height[off_axis > 6.1]).max() < 0.1


def test_lids_touch_the_eyeball_and_do_not_enter_it(eye: MeasuredEye):
    """Distances in mm to the union of sclera and cornea."""
    apex = eye.vertices("cornea")[:, 2].max()

    def distance(points: np.ndarray) -> np.ndarray:
        sclera = np.linalg.norm(points, axis=1) - 11.75
        return np.minimum(sclera, np.linalg.norm(points - (0, 0, apex - 7.8), axis=1) - 7.8)

    mesh = eye.head.mesh
    corners = 1000 * mesh.vertices[mesh.faces]
    corners = corners[(corners[:, :, 0] * eye.side > 0).all(1)]
    corners = (corners - eye.centre) * (eye.side, 1, 1)
    for place in (*np.eye(3), np.full(3, 1 / 3), (0.5, 0.5, 0), (0, 0.5, 0.5), (0.5, 0, 0.5)):
        assert distance(np.einsum("ijk,j->ik", corners, place)).min() > 0.0
    skin = eye.vertices("head")
    margin = skin[(distance(skin) < 0.12) & (skin[:, 2] > 2.5)]
    around = np.sort(np.degrees(np.arctan2(margin[:, 1], margin[:, 0])))
    assert np.diff(around, append=around[0] + 360).max() < 15, "degrees around the eye"


def test_lids_are_open_naturally(eye: MeasuredEye):
    """In mm. The edge of the lids is the foremost skin of each column of the opening."""
    skin = eye.vertices("head")
    shell = np.linalg.norm(skin, axis=1)
    middle = skin[(np.abs(skin[:, 0]) < 1.5) & (shell < 15) & (skin[:, 2] > 9)]
    upper = middle[middle[:, 1] > 0][:, 1].min()
    lower = middle[middle[:, 1] < 0][:, 1].max()
    assert 3.6 < upper < 4.4, "the upper lid covers the top of the iris, whose radius is 6 mm"
    assert -6.0 < lower < -5.0, "the inner edge of the lower margin"
    edge = lower - 0.55  # front edge
    assert 9.5 < upper - edge < 11.0


def visible(head: Head, names: tuple[str, ...], azimuth: float, elevation: float) -> list[Any]:
    """Draw parts in a parallel projection around the left eye: what each ray meets first.

    Returns the index of the part, or -1, and whether the ray meets the front of a face, (M,).
    """
    from tools.head.unwrap import _rasterise

    a, e = np.radians(azimuth), np.radians(elevation)
    ahead = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    up = np.cross(ahead, right)
    size, width = 1200, 0.60  # pixels, m: the whole head
    eye = head.parts["eyeballs"].vertices
    middle = eye[eye[:, 0] > 0].mean(0)
    part, front, depth = np.full(size**2, -1), np.zeros(size**2, bool), np.full(size**2, -np.inf)
    for index, name in enumerate(names):
        mesh = head.parts[name]
        flat = (mesh.vertices - middle) @ np.column_stack([right, up]) / width + 0.5
        faces = mesh.faces[((flat[mesh.faces] > 0) & (flat[mesh.faces] < 1)).all((1, 2))]
        away = (mesh.vertices - middle) @ ahead
        texel, face, shares = _rasterise(flat, faces, away, size)
        nearer = np.argsort((away[faces[face]] * shares).sum(1), kind="stable")
        texel, face, shares = texel[nearer], face[nearer], shares[nearer]
        height = np.full(size**2, -np.inf)
        height[texel] = (away[faces[face]] * shares).sum(1)
        a_, b_, c_ = np.moveaxis(mesh.vertices[faces], 1, 0)
        looks = np.zeros(size**2, bool)
        looks[texel] = (np.cross(b_ - a_, c_ - a_) @ ahead > 0)[face]
        over = height > depth
        part[over], front[over] = index, looks[over]
        depth = np.maximum(height, depth)
    column, row = np.arange(size**2) % size, np.arange(size**2) // size
    central = np.hypot(column - size / 2, row - size / 2) * width / size < 0.018
    return [part[central], front[central]]


@pytest.mark.parametrize("elevation", [-40, 0, 40])
@pytest.mark.parametrize("azimuth", [-45, 0, 45, 75])
def test_no_ray_enters_the_head_beside_an_eye(head: Head, azimuth: int, elevation: int):
    require_module("skimage")
    part, front = visible(head, ("head", "eyeballs"), azimuth, elevation)
    assert (part == 1).any(), "the eyeball is visible"
    inside = (part == 0) & ~front
    # At 45 degrees from below, a slit of less than 1 mm is open at the end of a lid's back.
    assert inside.sum() <= 3, "rays that meet the inside of the skin, 0.5 mm apart"
    behind = (part == 1) & ~front
    assert behind.sum() == 0, "rays that meet the inside of an eyeball"


def test_lashes_grow_out_of_the_lids(eye: MeasuredEye):
    """In mm. Only the first section of a lash, of 13 vertices, is in the skin."""
    from scipy.spatial import cKDTree

    lashes = eye.vertices("lash-strands").reshape(-1, 13, 3)
    assert len(lashes) > 80
    assert np.linalg.norm(lashes[:, 12] - lashes[:, 0], axis=1).max() < 10
    mesh = eye.head.mesh
    skin = (1000 * mesh.vertices - eye.centre) * (eye.side, 1, 1)
    normals = mesh.vertex_normals * (eye.side, 1, 1)
    distance, nearest = cKDTree(skin).query(lashes)
    assert distance[:, 0].max() < 0.6, "roots"
    outward = ((lashes - skin[nearest]) * normals[nearest]).sum(2)
    assert (outward[:, 3:] > 0).all()
    assert (np.linalg.norm(lashes[:, 3:], axis=2) > 12.5).all(), "not in the eyeball"


def one_sided_distance(points: np.ndarray, others: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    return float(cKDTree(others).query(points)[0].max())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Head]:
    """Heads that the generator makes now; with textures of 512 texels, which take seconds."""
    require_module("skimage")
    from tools.head.__main__ import write_head
    from tools.head.surface import build_mesh

    folder = tmp_path_factory.mktemp("heads")
    closed = build_mesh()
    for name in ("open", "again", "closed"):
        path = folder / f"{name}.glb"
        write_head(path, closed, open_eyes=name != "closed", texture_size=512, seed=7)
    assert (folder / "open.glb").read_bytes() == (folder / "again.glb").read_bytes()
    return {name: read_head(folder / f"{name}.glb") for name in ("open", "closed")}


@pytest.mark.slow
def test_generator_still_makes_the_committed_head(head: Head, made: dict[str, Head]):
    # Other library versions may place vertices elsewhere on the same surface, at most half an edge
    # (1 to 4 mm) away.
    opened = made["open"]
    assert tuple(opened.parts) == PARTS
    for name in PARTS:
        vertices, committed = opened.parts[name].vertices, head.parts[name].vertices
        assert one_sided_distance(vertices, committed) < 0.002, name
        assert one_sided_distance(committed, vertices) < 0.002, name
    for name in ("albedo", "normal_map", "occlusion_roughness"):
        mean = np.asarray(getattr(opened, name), np.float64).mean((0, 1))
        committed = np.asarray(getattr(head, name), np.float64).mean((0, 1))
        assert mean == pytest.approx(committed, abs=2.0), f"{name}, of 255"


@pytest.mark.slow
def test_eyes_change_nothing_else(made: dict[str, Head]):
    opened, closed = made["open"], made["closed"]
    assert tuple(closed.parts) == ("head",)

    def rows(head: Head) -> np.ndarray:
        """Vertices with their texture coordinates outside the eyes, sorted."""
        mesh = head.mesh
        eye = np.abs(np.abs(mesh.vertices[:, 0]) - 0.032) / 0.026, mesh.vertices[:, 1] / 0.018
        outside = (np.hypot(*eye) > 1) | (mesh.vertices[:, 2] < 0.03)
        found = np.column_stack([mesh.vertices, mesh.visual.uv])[outside]
        return found[np.lexsort(found.T)]

    np.testing.assert_array_equal(rows(opened), rows(closed))
    for name in ("albedo", "normal_map", "occlusion_roughness"):
        one, other = (np.asarray(getattr(each, name), int) for each in (opened, closed))
        changed = (np.abs(one - other) > 12).any(2)
        assert 0.002 < changed.mean() < 0.05, f"{name}: the eyes, and no other texels"
        lines, columns = np.nonzero(changed)
        size = len(changed)
        assert np.ptp(lines) < 0.15 * size, f"{name}: at the height of the eyes"
        assert np.ptp(columns) < 0.45 * size
