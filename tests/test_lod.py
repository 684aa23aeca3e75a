"""Tests mesh simplification (``facerender.simplified``): preserved properties, warnings, and the
error of the image."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import facerender as fr
from facerender.scenes.mesh import Part
from facerender.system import meshoptimizer
from tests.awkward_files import MINI_HEAD
from tests.verification.lights import PLAIN_THREE

Ints = NDArray[np.int64]


def mesh_of(*parts):
    points = np.concatenate([part.positions for part in parts])
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    radius = float(np.linalg.norm(points - bounds.mean(axis=0), axis=1).max())
    materials = tuple(fr.Material(m=0.2 + 0.1 * index) for index in range(len(parts)))
    return fr.Mesh("made.glb", parts, materials, bounds, radius, np.array([[1.0, 0.0]]))


def grid(rows, columns):
    """Return the faces of a grid of (rows + 1) x (columns + 1) vertices."""
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    quads = [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
    return np.concatenate(quads).reshape(-1, 3).astype(np.uint32)


RING, TUBE = 96, 32


def on_torus(uv):
    """Return positions and normals at u around the ring and v around the tube."""
    around, over = 2.0 * np.pi * (uv % 1.0).T
    outwards = np.stack([np.cos(around), np.zeros_like(around), -np.sin(around)], axis=1)
    normals = np.cos(over)[:, None] * outwards + np.sin(over)[:, None] * np.array([0.0, 1.0, 0.0])
    return outwards + 0.4 * normals, normals


def torus():
    """Return a closed torus with seams of the texture coordinates in both directions."""
    u, v = np.meshgrid(np.linspace(0, 1, RING + 1), np.linspace(0, 1, TUBE + 1), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    return Part(*on_torus(uv), grid(RING, TUBE), uv)


def welded(mesh):
    """Return the distinct positions of all parts, and faces that index them."""
    points = np.concatenate([part.positions for part in mesh.parts])
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    places, numbers = np.unique(points, axis=0, return_inverse=True)
    return places, numbers.reshape(-1)[np.concatenate(faces)]


def open_edges(mesh):
    """Return the end points of edges that only one face has, (E, 2, 3)."""
    places, faces = welded(mesh)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(pairs, axis=0, return_counts=True)
    return places[edges[counts == 1]]


def count(mesh):
    return sum(len(part.faces) for part in mesh.parts)


def in_two(mesh, height):
    """Split a mesh at a height into two parts with separate vertices and materials."""
    (part,) = mesh.parts
    below = part.positions[part.faces][:, :, 1].mean(axis=1) < height
    parts = []
    for faces in (part.faces[below], part.faces[~below]):
        used, numbers = np.unique(faces, return_inverse=True)
        own = (part.positions[used], part.normals[used], numbers.reshape(-1, 3).astype(np.uint32))
        parts.append(Part(*own, part.uv[used]))
    materials = (mesh.materials[0], replace(mesh.materials[0], ks=0.5))
    return replace(mesh, parts=tuple(parts), materials=materials)


def test_closed_mesh_stays_closed_with_its_maps_in_place():
    whole = mesh_of(torus())
    assert not len(open_edges(whole))
    level = fr.simplified(whole, 1200)
    (part,) = level.parts
    assert 1150 <= len(part.faces) <= 1200
    assert not len(open_edges(level))
    assert part.uv.min() >= 0.0
    assert part.uv.max() <= 1.0
    assert np.ptp(part.uv[part.faces], axis=1).max() < 0.25, "a face reaches over a seam"
    places, normals = on_torus(part.uv)
    assert np.linalg.norm(places - part.positions, axis=1).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, rtol=1e-12)
    assert (normals * part.normals).sum(axis=1).min() > 0.99
    _, seams = np.unique(part.positions, axis=0, return_inverse=True)
    assert (
        len(np.unique(np.column_stack([seams.reshape(-1), part.normals]), axis=0)) == max(seams) + 1
    )


def test_open_borders_stay_where_they_are(head):
    before, after = open_edges(head), open_edges(fr.simplified(head, 16_000))
    assert 0 < len(after) < len(before)
    gaps = np.linalg.norm(after.reshape(-1, 1, 3) - before.reshape(1, -1, 3), axis=-1).min(axis=1)
    assert gaps.max() < 0.01 * head.radius
    ends = [
        np.concatenate([edges.min(axis=(0, 1)), edges.max(axis=(0, 1))])
        for edges in (before, after)
    ]
    np.testing.assert_allclose(*ends, atol=0.005 * head.radius)


def test_parts_keep_their_borders_materials_and_number(head):
    whole = in_two(head, 0.0)
    level = fr.simplified(whole, 16_000)
    assert count(level) <= 16_000
    assert level.materials == whole.materials
    assert [part.uv is None for part in level.parts] == [False, False]
    assert min(len(part.faces) for part in level.parts) > 2000
    gaps = open_edges(level).reshape(-1, 1, 3) - open_edges(whole).reshape(1, -1, 3)
    assert np.linalg.norm(gaps, axis=-1).min(axis=1).max() < 0.01 * head.radius, "a crack"


def test_a_camera_sees_the_same_mesh(head):
    level = fr.simplified(head, 8000)
    assert (level.name, level.radius) == (head.name, head.radius)
    assert level.bounds is head.bounds
    assert level.profile is head.profile
    reach = np.linalg.norm(level.normalised(level.parts[0].positions), axis=1)
    assert reach.max() <= 1.0 + 1e-12, "a near plane cuts it"


def test_the_same_arguments_give_the_same_mesh(head):
    assert fr.simplified(head, 8000) is fr.simplified(head, 8000)
    assert fr.simplified(head, 8000) is not fr.simplified(head, 9000)
    again = fr.simplified(fr.load_mesh().select("head"), 8000)
    for name in ("positions", "normals", "faces", "uv"):
        np.testing.assert_array_equal(
            getattr(fr.simplified(head, 8000).parts[0], name), getattr(again.parts[0], name)
        )


def test_levels_are_freed_with_their_mesh():
    whole = mesh_of(torus())
    level = weakref.ref(fr.simplified(whole, 500))
    del whole
    gc.collect()
    assert level() is None


@pytest.mark.parametrize("more", [0, 1, 10**9])
def test_mesh_with_few_triangles_is_returned_unchanged(more):
    whole = mesh_of(torus())
    assert fr.simplified(whole, count(whole) + more) is whole


@pytest.mark.filterwarnings("ignore:no pixel shows made.glb")  # the remaining faces may be flat
def test_too_few_triangles_warn_and_every_part_keeps_one(renderer):
    small = replace(torus(), positions=0.01 * torus().positions)
    whole = mesh_of(torus(), small)
    with pytest.warns(
        fr.FacerenderWarning, match=r"made.glb cannot be .* to 1 triangles: \d+ remain"
    ):
        level = fr.simplified(whole, 1)
    assert all(len(part.faces) for part in level.parts)
    assert count(level) < 300
    assert np.isfinite(renderer.render(fr.Scene(level)).linear).all()


def test_a_part_that_would_vanish_keeps_its_largest_face(monkeypatch):
    small = replace(torus(), positions=0.01 * torus().positions)
    monkeypatch.setattr(meshoptimizer, "collapsed", lambda faces, *rest: faces[:2])
    with pytest.warns(fr.FacerenderWarning, match="to 2 triangles: 3 remain"):
        level = fr.simplified(mesh_of(torus(), small), 2)
    assert [len(part.faces) for part in level.parts] == [2, 1]


def awkward_parts():
    whole = torus()
    colors = 0.5 + 0.5 * np.cos(7.0 * whole.positions)
    folded = np.concatenate([whole.faces, whole.faces[:50, [0, 0, 1]], whole.faces[:50]])
    alone = Part(np.eye(3), np.eye(3), np.array([[0, 1, 2]], dtype=np.uint32))
    return {
        "no texture coordinates": (replace(whole, uv=None),),
        "all on one texel": (replace(whole, uv=np.full_like(whole.uv, 0.25)),),
        "colours": (replace(whole, colors=colors),),
        "degenerate and doubled faces": (replace(whole, faces=folded.astype(np.uint32)),),
        "a part of one face": (whole, alone),
        "far and large": (replace(whole, positions=1e6 * whole.positions + 1e8),),
        "triangles alone": (
            Part(
                whole.positions[whole.faces].reshape(-1, 3),
                whole.normals[whole.faces].reshape(-1, 3),
                np.arange(whole.faces.size, dtype=np.uint32).reshape(-1, 3),
            ),
        ),
    }


@pytest.mark.parametrize("name", awkward_parts())
def test_awkward_meshes(name):
    whole = mesh_of(*awkward_parts()[name])
    level = fr.simplified(whole, 2000)
    assert 1900 < count(level) <= 2000
    for part, old in zip(level.parts, whole.parts, strict=True):
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, rtol=1e-12)
        assert part.faces.max() == len(part.positions) - 1
        off = np.linalg.norm(whole.normalised(part.positions[:, None]), axis=-1)
        assert off.max() <= 1.0 + 1e-9
        for values, before in ((part.uv, old.uv), (part.colors, old.colors)):
            assert (values is None) == (before is None)
            if before is not None:
                assert values.min() >= before.min()
                assert values.max() <= before.max()


@pytest.mark.parametrize("value", [0, -5, 1.5, True, "8", None])
def test_invalid_number_of_triangles_is_refused(value):
    with pytest.raises(fr.InputError, match=rf"triangles = {value!r}: give a whole number"):
        fr.simplified(mesh_of(torus()), value)


def test_missing_meshoptimizer_is_reported_with_a_remedy(no_meshoptimizer):
    with pytest.raises(fr.InputError, match=r"meshoptimizer; pip install 'facerender\[lod\]'"):
        fr.simplified(mesh_of(torus()), 100)


@pytest.mark.parametrize(("triangles", "share", "median"), [(50_000, 1.0, 0), (16_000, 15.5, 1)])
def test_image_changes_little(head, renderer, triangles, share, median):
    """``share`` limits the percentage of covered pixels that change by more than one level."""
    exact, level = (
        renderer.render(fr.Scene(mesh, fr.Camera(azimuth=-35), PLAIN_THREE))
        for mesh in (head, fr.simplified(head, triangles))
    )
    covered = (exact.linear[..., 3] > 0.0) | (level.linear[..., 3] > 0.0)
    steps = np.abs(exact.srgb8().astype(int) - level.srgb8())[covered].max(axis=-1)
    assert 100.0 * (steps > 1).mean() < share
    assert np.median(steps) <= median


def test_a_mesh_file_is_simplified_as_it_is_read():
    whole = fr.MeshFile(str(MINI_HEAD)).load()
    few = count(whole) // 2
    level = fr.MeshFile(str(MINI_HEAD), triangles=few).load()
    np.testing.assert_array_equal(level.parts[0].faces, fr.simplified(whole, few).parts[0].faces)
    assert count(level) <= few
