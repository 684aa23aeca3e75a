"""Tests the registration of a scan to another scan of the same person."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh

import facerender as fr
from tests.people import head_shape, mesh_of

EYES = np.array((0.0, 0.0, 82.0))  # between the eyes of the built-in head, in mm
NOSE, CHIN, CHEEK = (0.0, -40.0, 110.0), (0.0, -105.0, 92.0), (45.0, -45.0, 70.0)


def motion(degrees: float, shift: Any, seed: int = 1) -> Any:
    matrix = trimesh.transformations.rotation_matrix(
        np.radians(degrees), np.random.default_rng(seed).normal(size=3)
    )
    matrix[:3, 3] = shift
    return matrix


def apply(matrix: Any, points: Any) -> Any:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def operated(points: Any, *changes: tuple[Any, float, Any]) -> Any:
    """Return points after changes: centre, standard deviation, and shift in mm."""
    for center, width, shift in changes:
        squares = ((points - center) ** 2).sum(axis=1) / (2.0 * width**2)
        points = points + np.exp(-squares)[:, None] * shift
    return points


def scan_of(points: Any, faces: Any, seed: int, noise: float, name: str = "scan") -> fr.Mesh:
    """Return a mesh with noise that keeps equal positions equal."""
    places, index = np.unique(points, axis=0, return_inverse=True)
    places = places + np.random.default_rng(seed).normal(0.0, noise, places.shape)
    return fr.Mesh.from_arrays(places, index.reshape(-1)[faces], name=name)


@cache
def before(noise: float = 0.05) -> fr.Mesh:
    shape = head_shape()
    return scan_of(1000.0 * shape.vertices, shape.faces, 1, noise, "before")


def check(mesh: fr.Mesh, reference: fr.Mesh, truth: Any, points: Any, most: float) -> float:
    """Register a mesh, check its motion at points in the space of the reference, and return the
    residual in mm."""
    result = fr.register(mesh, reference)
    error = result.matrix @ truth
    assert np.linalg.norm(apply(error, points) - points, axis=1).mean() < most
    assert np.degrees(np.arccos(min(1.0, (np.trace(error[:3, :3]) - 1.0) / 2.0))) < most
    assert result.unit == "mm"
    for old, new in zip(mesh.parts, result.mesh.parts, strict=True):
        np.testing.assert_allclose(new.positions, apply(result.matrix, old.positions), atol=1e-9)
        np.testing.assert_allclose(new.normals, old.normals @ result.matrix[:3, :3].T, atol=1e-9)
        np.testing.assert_array_equal(new.faces, old.faces)
    return result.residual


@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
@pytest.mark.parametrize(
    ("degrees", "noise", "change"),
    [
        (4.0, 0.05, (NOSE, 12.0, (0.0, 0.0, -3.0))),
        (30.0, 0.05, (CHEEK, 14.0, (3.0, 0.0, 3.0))),
        pytest.param(170.0, 0.2, (CHIN, 18.0, (0.0, -10.0, 5.0)), marks=pytest.mark.slow),
    ],
)
def test_an_operation_does_not_move_the_scan(degrees: float, noise: float, change: Any) -> None:
    truth, shape = motion(degrees, (40.0, -70.0, 30.0)), head_shape()
    points = 1000.0 * shape.vertices
    after = operated(points, (CHIN, 18.0, (0.0, 0.0, 5.0)), change)
    scan = scan_of(apply(truth, after), shape.faces, 2, noise)
    residual = check(scan, before(noise), truth, points[points[:, 2] > 0.0], 0.15)
    assert 0.3 * noise < residual < noise + 0.03


@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
def test_a_scan_of_a_person(scan_mesh: fr.Mesh) -> None:
    """With another noise and with holes, and both ways."""
    part = scan_mesh.parts[0]
    positions = 53.0 * part.positions  # in mm
    truth = trimesh.transformations.euler_matrix(*np.radians((2.0, -1.5, 1.0)))
    truth[:3, 3] = 4.0, -7.0, 3.0
    nose = positions[positions[:, 2].argmax()]
    after = operated(
        positions, (nose, 12.0, (0.0, 0.0, -3.0)), (nose - (0, 72, 5), 18.0, (0, 0, 5))
    )
    faces = part.faces[np.random.default_rng(3).random(len(part.faces)) < 0.9]
    first = scan_of(positions, part.faces, 4, 0.05)
    second = scan_of(apply(truth, after), faces, 5, 0.05)
    near = positions[positions[:, 2] > -60.0]
    assert check(second, first, truth, near, 0.1) < 0.15
    assert check(first, second, np.linalg.inv(truth), apply(truth, near), 0.1) < 0.15


def test_other_axes_shapes_materials_and_poses() -> None:
    """A registered mesh looks like its reference, in each pose."""
    reference, other = fr.load_mesh(), fr.load_mesh(rotate=(-80.0, 20.0, 100.0))
    changed = other.with_material(m=0.21)
    move, head = np.array((0.4, -0.1, 0.2)), reference.parts[0]
    result = fr.register(changed, fr.Mesh.from_arrays(head.positions + move, head.faces))
    assert result.residual < 0.1
    assert result.mesh.materials == changed.materials
    assert result.mesh.millimetres == 1000.0
    rows = [1.01 * part.positions for part in reference.parts]
    smile = {"mouthSmileLeft": 1.0, "jawOpen": 0.5}
    pairs = [
        (result.mesh, reference),
        (result.mesh.with_pose(smile), reference.with_pose(smile)),
        (result.mesh.with_pose(clip="talk", time=1.0), reference.with_pose(clip="talk", time=1.0)),
        (result.mesh.with_positions(rows), reference.with_positions(rows)),
        (result.mesh.select("head").with_positions(rows[:1]), reference.with_positions(rows)),
        (fr.register(other.with_pose(smile), result.mesh).mesh, reference.with_pose(smile)),
    ]
    for mesh, expected in pairs:
        for a, b in zip(mesh.parts, expected.parts, strict=False):
            np.testing.assert_allclose(a.positions, b.positions + move, atol=1e-4)
            np.testing.assert_allclose(a.normals, b.normals, atol=0.01)
    face, expected_face = fr.find_face(result.mesh), fr.find_face(reference)
    assert face is not None
    assert expected_face is not None
    np.testing.assert_allclose(face.eyes, expected_face.eyes + move, atol=0.004)
    with fr.Renderer((64, 64)) as renderer:
        images = [
            renderer.render(fr.Scene(mesh.with_material(m=0.21), fr.Camera(0, 0))).linear
            for mesh in (result.mesh, reference)
        ]
    assert np.abs(images[0] - images[1]).mean() < 0.01


def test_results_repeat_and_the_unit_may_be_unknown() -> None:
    shape = head_shape()
    meshes = [scan_of(9.0 * shape.vertices, shape.faces, seed, 5e-4) for seed in (1, 2)]
    first, second = (fr.register(*meshes) for _ in range(2))
    np.testing.assert_array_equal(first.matrix, second.matrix)
    assert first.unit == "units"
    assert first.residual < 2e-3
    known = fr.register(meshes[0], scan_of(9.0 * shape.vertices, shape.faces, 2, 5e-4))
    assert known.residual == first.residual


def test_meshes_that_cannot_be_registered() -> None:
    shape, head = head_shape(), fr.load_mesh()
    box = mesh_of("box", [(trimesh.creation.box().vertices, trimesh.creation.box().faces)])
    for pair in ((box, head), (head, box)):
        with pytest.raises(fr.InputError, match="no face was found on box: registration needs"):
            fr.register(*pair)
    with pytest.raises(
        fr.InputError, match="the eyes of before and head.glb are 6.* and 0.06.* convert the meshes"
    ):
        fr.register(before(), head)
    # The face is found, but most of its upper part is missing.
    middles = 1000.0 * shape.triangles_center
    lost = (middles[:, 1] > 12.0) | (np.abs(middles[:, 0]) > 48.0)
    low = fr.Mesh.from_arrays(shape.vertices, shape.faces[~lost], name="low")
    assert fr.find_face(low) is not None
    with pytest.raises(fr.InputError, match="the upper faces of low and head.glb do not overlap"):
        fr.register(low, head)
