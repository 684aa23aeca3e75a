"""Tests framing: head and face are found in many kinds of meshes by their geometry alone, and a
camera frames them."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest

import facerender as fr
from facerender.scenes.framing import find_regions
from facerender.scenes.view import view_of
from tests.people import PEOPLE, ball, person

# Heights on the built-in head in metres, judged by eye.
CHIN, CROWN, BROW = -0.105, 0.116, 0.01

known = cache(person)


def ends(mesh, region):
    """Return the lowest and the highest y of a region, in the mesh's units."""
    middle = mesh.to_mesh_space(region.center)[1]
    return middle - region.height * mesh.radius, middle + region.height * mesh.radius


@pytest.mark.parametrize("name", PEOPLE)
def test_face_of_a_person_is_found(name):
    mesh = known(name)
    low, high = ends(mesh, region := find_regions(mesh)["face"])
    assert CHIN - 0.025 < low < CHIN + 0.01
    assert BROW + 0.03 < high < CROWN + 0.015
    assert abs(mesh.to_mesh_space(region.center)[0]) < 0.006
    assert 0.045 < region.radius * mesh.radius < 0.09


@pytest.mark.parametrize("name", sorted(PEOPLE.keys() - {"mask"}))
def test_head_of_a_person_is_found(name):
    mesh = known(name)
    low, high = ends(mesh, region := find_regions(mesh)["head"])
    assert CHIN - 0.06 < low < CHIN + 0.005
    top = 0.19 if name == "bun" else 0.14 if "hair" in name else CROWN
    assert high == pytest.approx(top, abs=0.004)
    assert 0.09 < region.radius * mesh.radius < 0.17


@pytest.mark.parametrize(("scale", "move"), [(1000.0, (0, 0, 0)), (0.01, (5, -9, 2)), (39.37, 0)])
def test_units_and_position_do_not_matter(scale, move):
    shift = np.broadcast_to(np.asarray(move, float) * scale, 3)
    own = person("arms down")
    other = person("arms down", scale, shift)
    for name in ("head", "face"):
        a, b = find_regions(own)[name], find_regions(other)[name]
        center = (other.to_mesh_space(b.center) - shift) / scale
        np.testing.assert_allclose(center, own.to_mesh_space(a.center), atol=2e-3)
        assert b.radius == pytest.approx(a.radius, rel=0.02)


def test_face_of_a_scan_is_found(scan_mesh):
    """The eyes of the scan are at y = 1.9, its chin at -0.45 and its crown at 4."""
    low, high = ends(scan_mesh, find_regions(scan_mesh)["face"])
    assert -1.3 < low < -0.3
    assert 2.6 < high < 4.3
    assert ends(scan_mesh, find_regions(scan_mesh)["head"])[1] == pytest.approx(3.97, abs=0.05)


def test_shape_without_a_face_has_finite_regions(tmp_path):
    import trimesh

    path = tmp_path / "shape.ply"
    for shape in (ball((3, 3, 3), (1, 1, 1)), trimesh.creation.box((2, 1e-9, 3))):
        shape.export(path)
        mesh = fr.load_mesh(path)
        for name in ("head", "face"):
            region = find_regions(mesh)[name]
            assert np.isfinite(region.center).all()
            assert 0.1 < region.radius < 2.5


def test_a_triangle_has_regions(tmp_path):
    path = tmp_path / "one.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh = fr.load_mesh(path)
    view = view_of(fr.Scene(mesh, fr.Camera(frame="face")), 1.0)
    assert np.isfinite(view.matrix).all()


@pytest.mark.parametrize("frame", ["head", "face"])
@pytest.mark.parametrize("azimuth", [0.0, 70.0, 200.0])
def test_camera_frames_its_region(head, frame, azimuth):
    region = find_regions(head)[frame]
    camera = fr.Camera(azimuth, 10.0, frame=frame)  # type: ignore[arg-type]
    view = view_of(fr.Scene(head, camera), 0.8)
    turn = np.linspace(0.0, 2.0 * np.pi, 16)
    sides = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], axis=1) * region.radius
    rims = [region.center + sides + (0.0, y, 0.0) for y in (-region.height, region.height)]
    clip = np.column_stack([np.concatenate(rims), np.ones(32)]) @ view.matrix
    across = np.abs(clip[:, :2] / clip[:, 3:])
    assert across.max() <= 1.0
    assert across.max() > 0.8
    center = [*region.center, 1.0] @ view.matrix
    np.testing.assert_allclose(center[:2] / center[3], 0.0, atol=1e-12)


def test_target_and_zoom_override_the_found_region(head):
    own = view_of(fr.Scene(head, fr.Camera(frame="face")), 1.0)
    near = view_of(fr.Scene(head, fr.Camera(frame="face", zoom=2.0)), 1.0)
    middle = find_regions(head)["face"].center
    assert np.linalg.norm(near.position - middle) == pytest.approx(
        np.linalg.norm(own.position - middle) / 2
    )
    place = (0.01, 0.02, 0.03)
    moved = view_of(fr.Scene(head, fr.Camera(frame="face", target=place)), 1.0)
    np.testing.assert_allclose(
        moved.position - own.position, head.normalised(place) - middle, atol=1e-12
    )


def test_simplified_mesh_keeps_its_regions(head):
    fewer = fr.simplified(head, 3000).with_material(m=0.2)
    for name in ("head", "face"):
        assert find_regions(fewer)[name] is find_regions(head)[name]
    again = pickle.loads(pickle.dumps(fewer))
    assert find_regions(again)["face"].radius == find_regions(head)["face"].radius


def test_a_frame_is_one_of_three():
    with pytest.raises(fr.InputError, match="camera frame = 'nose': give all, head, face"):
        fr.Camera(frame="nose")  # type: ignore[arg-type]
