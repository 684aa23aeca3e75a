"""Tests the search for a face on the surface of a mesh: people are found in any orientation and
unit, and other things are not people."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, Literal

import numpy as np
import pytest
import trimesh
from trimesh.creation import box, capsule, cylinder, icosphere, torus

import facerender as fr
from facerender.mesh.face import Face, Surface, find_faces
from facerender.scene.view import shifted, view_of
from tests.awkward_files import MINI_HEAD
from tests.people import body, head_shape, mesh_of

# The centres of the eyes of the built-in head in metres, first the one on the viewer's left.
EYES = np.array([(-0.0313, 0.0, 0.082), (0.0322, 0.0, 0.082)])
DISTANCE = 0.0635
HEIGHT = 0.28  # of the built-in head with its neck
SMILE = {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0}
Shape = tuple[Any, Any]  # vertices, faces


def posed(weights: dict[str, float]) -> Shape:
    parts = fr.load_mesh().with_pose(weights=weights).parts
    whole = trimesh.util.concatenate(
        [trimesh.Trimesh(part.positions, part.faces, process=False) for part in parts]
    )
    return whole.vertices, whole.faces


def cut(keep: Callable[[Any], Any], *shapes: Any) -> Shape:
    """Return the triangles of the built-in head and of shapes whose middles are to keep."""
    shape = trimesh.util.concatenate([head_shape(), *shapes])
    return shape.vertices, shape.faces[keep(shape.triangles_center.T)]


def noisy() -> Shape:
    """Return the head with noise that keeps equal positions equal."""
    shape, rng = head_shape(), np.random.default_rng(5)
    places, index = np.unique(shape.vertices, axis=0, return_inverse=True)
    places = places + rng.uniform(-0.01 * HEIGHT, 0.01 * HEIGHT, places.shape)
    return places[index.reshape(-1)], shape.faces


def random_triangles(_: Any) -> Any:
    return np.random.default_rng(3).random(len(head_shape().faces)) < 0.7


HEADS: dict[str, Callable[[], Shape]] = {
    "plain": lambda: posed({}),
    "smile": lambda: posed(SMILE),
    "open jaw": lambda: posed({"jawOpen": 1.0}),
    "without neck": lambda: cut(lambda middle: middle[1] > -0.115),
    "holes": lambda: cut(random_triangles),
    "noise": noisy,
    "body": lambda: cut(lambda middle: middle[1] > -9.0, *body((0.18, 0.62, 0.0))),
}


def check(face: Face | None, rotation: Any = None, scale: float = 1.0, move: Any = 0.0) -> Face:
    """Check a face of the built-in head that was rotated, scaled and moved."""
    turn = np.eye(3) if rotation is None else rotation
    assert face is not None
    assert face.up @ turn[:, 1] > np.cos(np.radians(15.0))
    assert face.front @ turn[:, 2] > np.cos(np.radians(15.0))
    eyes = scale * EYES @ turn.T + move
    assert np.linalg.norm(face.eyes - eyes, axis=1).max() < 0.5 * DISTANCE * scale
    assert 0.7 < face.eye_distance / (DISTANCE * scale) < 1.43
    apart = np.linalg.norm(face.eyes[1] - face.eyes[0])
    assert apart == pytest.approx(face.eye_distance, rel=1e-4)
    np.testing.assert_allclose(face.axes @ face.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(face.axes) > 0.0
    assert 0.84 < face.score < 1.2
    return face


@cache
def head_of(name: str) -> fr.Mesh:
    shape = HEADS[name]()
    return fr.Mesh.from_arrays(*shape) if name == "plain" else mesh_of(name, [shape])


@pytest.mark.parametrize("name", HEADS)
def test_a_face_is_found(name: str) -> None:
    check(fr.find_face(head_of(name)))


def test_the_built_in_head_is_found_accurately() -> None:
    face = check(fr.find_face(head_of("plain")))
    assert np.linalg.norm(face.eyes - EYES, axis=1).max() < 0.1 * DISTANCE
    assert face.eye_distance == pytest.approx(DISTANCE, rel=0.05)
    assert face.score > 1.0
    assert min(face.up[1], face.front[2]) > np.cos(np.radians(3.0))
    known = check(fr.find_face(fr.load_mesh()))  # without a search
    np.testing.assert_allclose(known.eyes, face.eyes, atol=0.03 * DISTANCE)
    assert known.eye_distance == pytest.approx(face.eye_distance, rel=0.03)
    assert known.score == pytest.approx(face.score, abs=0.03)


@pytest.mark.parametrize(
    ("seed", "scale", "move"),
    [(1, 1.0, 0.0), (2, 1e-3, (1e-2, 0.0, -2e-2)), (3, 1e3, (4e3, -1e3, 2e3)), (4, 39.37, -5.0)],
)
def test_orientation_unit_and_position_do_not_matter(seed: int, scale: float, move: Any) -> None:
    """The rotations are random."""
    rotation = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    rotation = rotation[:3, :3]
    vertices, faces = HEADS["body" if seed == 1 else "smile"]()
    mesh = mesh_of("other", [(scale * np.asarray(vertices) @ rotation.T + move, faces)])
    check(fr.find_face(mesh), rotation, scale, move)


THINGS: dict[str, Callable[[], Any]] = {
    "box": lambda: box((1.0, 2.0, 1.5)),
    "icosphere": icosphere,
    "torus": lambda: torus(1.0, 0.3),
    "capsule": capsule,
    "cylinder": lambda: cylinder(1.0, 3.0),
    "body": lambda: trimesh.util.concatenate(body((0.2, -0.5, 0.0))),
    "triangle": lambda: trimesh.Trimesh(np.eye(3), [(0, 1, 2)], process=False),
}


@pytest.mark.parametrize("name", THINGS)
def test_a_thing_has_no_face(name: str) -> None:
    shape = THINGS[name]()
    assert fr.find_face(mesh_of(name, [(shape.vertices, shape.faces)])) is None


def test_the_back_of_a_head_has_no_face() -> None:
    assert fr.find_face(mesh_of("back", [cut(lambda middle: middle[2] < 0.0)])) is None


def test_a_mesh_without_depth_or_size_has_no_face() -> None:
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 40)] * 2)
    grid = np.stack([x, y, np.zeros_like(x)], axis=-1)
    corners = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:]]
    flat = np.stack([each.reshape(-1, 3) for each in corners], axis=1)
    for triangles in (flat, np.zeros((9, 3, 3)), np.full((9, 3, 3), 7.0)):
        assert find_faces(Surface(triangles)) == []


def test_one_of_two_heads_is_found() -> None:
    shape = head_shape()
    pairs = [(shape.vertices + (x, 0.0, 0.0), shape.faces) for x in (-0.2, 0.2)]
    mesh = mesh_of("two", pairs)
    face = fr.find_face(mesh)
    assert face is not None
    check(face, move=(np.copysign(0.2, face.eyes[0, 0]), 0.0, 0.0))
    auto, whole = (
        view_of(fr.Scene(mesh, fr.Camera(frame=frame)), 1.0) for frame in ("auto", "all")
    )
    np.testing.assert_array_equal(auto.matrix, whole.matrix)


def test_the_result_does_not_depend_on_the_processor() -> None:
    code = (
        "import facerender as fr; from facerender.mesh.face import Surface, find_faces\n"
        f"part = fr.load_mesh({str(MINI_HEAD)!r}).parts[0]\n"
        "for face in find_faces(Surface(part.positions[part.faces]), 0.0):\n"
        "    print([each.tolist() for each in vars(face).values() if hasattr(each, 'tolist')])\n"
        "    print(face.eye_distance, face.score)"
    )
    umath: Any = np._core._multiarray_umath  # type: ignore[attr-defined]
    features = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__.get(name)]
    settings = (
        {"OPENBLAS_NUM_THREADS": "1", "OPENBLAS_CORETYPE": "Prescott"},
        {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": " ".join(features)},
    )
    outputs = [
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **setting},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for setting in settings
    ]
    part = fr.load_mesh(MINI_HEAD).parts[0]
    faces = find_faces(Surface(part.positions[part.faces]), 0.0)
    assert all(repr(face.eyes.tolist()) in outputs[0] for face in faces)
    assert all(f"{face.eye_distance} {face.score}\n" in outputs[0] for face in faces)
    assert len(faces) == len(outputs[0].splitlines()) / 2 > 0
    assert outputs[0] == outputs[1]


def test_a_camera_without_a_region_does_not_search(renderer: fr.Renderer) -> None:
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh, fr.Camera(frame="all"))
    renderer.render(scene)
    renderer.render(shifted(scene, 3.0, 0.0, 256))
    renderer.render(fr.Scene(mesh, fr.Camera(position=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0))))
    assert "framing" not in vars(mesh.geometry)
    renderer.render(fr.Scene(mesh, fr.Camera(frame="eyes")))
    assert "framing" in vars(mesh.geometry)


@pytest.mark.parametrize("frame", ["eyes", "face", "head"])
def test_a_frame_shows_the_eyes(frame: Literal["eyes", "face", "head"]) -> None:
    for name, azimuth in (("plain", 0.0), ("plain", 60.0), ("body", 0.0), ("body", -60.0)):
        mesh, size = head_of(name), (300, 200)
        view = view_of(fr.Scene(mesh, fr.Camera(azimuth, frame=frame)), 1.5)
        pixels, depth = view.project(mesh, EYES, size)
        assert depth.min() > 0.0
        assert ((pixels > 0.0) & (pixels < size)).all()
        assert pixels[0, 0] < pixels[1, 0]
        if frame == "eyes" and azimuth == 0.0:
            np.testing.assert_allclose(pixels.mean(axis=0), (150.0, 100.0), atol=4.0)
            assert 0.4 < (pixels[1, 0] - pixels[0, 0]) / 200.0 < 1.0
