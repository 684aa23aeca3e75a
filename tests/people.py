"""Builds bodies and busts around the built-in head, in metres; its neck ends at y = -0.16."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

import facerender as fr
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part


def shape_of(vertices: Any, faces: Any) -> Any:
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False)


@cache
def head_shape() -> Any:
    import trimesh

    parts = fr.load_mesh().parts
    shapes = [shape_of(part.positions, part.faces) for part in parts]
    return trimesh.util.concatenate(shapes)


def ball(center: Any, radii: Any) -> Any:
    import trimesh

    shape = trimesh.creation.icosphere(4)
    shape.apply_scale(radii)
    return shape.apply_translation(center)


def limb(start: Any, end: Any, radius: float) -> Any:
    import trimesh

    way = np.subtract(end, start)
    length = float(np.linalg.norm(way))
    shape = trimesh.creation.capsule(length, radius, count=(16, 16))
    place = trimesh.geometry.align_vectors([0, 0, 1], way / length)
    # Depending on trimesh's version, a capsule's axis starts at 0 or is centred there.
    shape.apply_translation([0, 0, length / 2 - shape.bounds[:, 2].mean()])
    place[:3, 3] = start
    return shape.apply_transform(place)


def body(hands: tuple[float, float, float]) -> list[Any]:
    """Return the body below the head; ``hands`` is the left hand's offset from the shoulder."""
    arms = [
        limb((side * 0.17, -0.22, -0.03), (side * (0.17 + x), -0.22 + y, -0.03 + z), 0.045)
        for side in (-1, 1)
        for x, y, z in (hands,)
    ]
    legs = [limb((side * 0.09, -0.75, 0), (side * 0.1, -1.5, 0), 0.075) for side in (-1, 1)]
    neck = limb((0, -0.12, -0.03), (0, -0.2, -0.03), 0.06)
    trunk = [
        ball((0, -0.38, -0.03), (0.18, 0.24, 0.12)),
        ball((0, -0.65, -0.03), (0.16, 0.2, 0.11)),
    ]
    return [neck, *trunk, *arms, *legs]


def shoulders() -> list[Any]:
    return [
        ball((0, -0.33, -0.03), (0.24, 0.2, 0.13)),
        limb((0, -0.1, -0.03), (0, -0.25, -0.03), 0.065),
    ]


def hair(length: float) -> list[Any]:
    """Return a shell around the head, open at the face; ``length`` is the height of its back."""
    import trimesh

    cap = ball((0, 0.03, -0.01), (0.105, 0.11, 0.115))
    centers = cap.triangles_center
    shells = [shape_of(cap.vertices, cap.faces[(centers[:, 2] < 0.03) | (centers[:, 1] > 0.085)])]
    if length:
        curtain = trimesh.creation.cylinder(0.105, length, sections=64)
        curtain.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        curtain = curtain.subdivide().subdivide()
        curtain.apply_translation([0, 0.055 - length / 2, -0.01])
        shells.append(
            shape_of(curtain.vertices, curtain.faces[curtain.triangles_center[:, 2] < 0.03])
        )
    return shells


def mask() -> Any:
    """Return only the face, from the chin to the hairline."""
    shape = head_shape()
    x, y, z = shape.triangles_center.T
    face = (z > 0.0) & (y > -0.095) & (y < 0.08) & (np.abs(x) < 0.07)
    return shape_of(shape.vertices, shape.faces[face])


PEOPLE: dict[str, Callable[[], list[Any]]] = {
    "head": lambda: [head_shape()],
    "mask": lambda: [mask()],
    "bust": lambda: [head_shape(), *shoulders()],
    "hair": lambda: [head_shape(), *hair(0.0)],
    "bun": lambda: [head_shape(), *shoulders(), ball((0, 0.15, -0.06), (0.04, 0.04, 0.04))],
    "bust with long hair": lambda: [head_shape(), *shoulders(), *hair(0.45)],
    "arms down": lambda: [head_shape(), *body((0.2, -0.5, 0.0))],
    "arms apart": lambda: [head_shape(), *body((0.58, 0.0, 0.0))],
    "arms up": lambda: [head_shape(), *body((0.18, 0.62, 0.0))],
    "arms forward": lambda: [head_shape(), *body((0.0, 0.0, 0.6))],
    "body with long hair": lambda: [head_shape(), *body((0.2, -0.5, 0.0)), *hair(0.45)],
}


def person(name: str, scale: float = 1.0, move: Any = (0.0, 0.0, 0.0)) -> fr.Mesh:
    shapes = [(np.array(each.vertices) * scale + move, each.faces) for each in PEOPLE[name]()]
    return mesh_of(name, shapes)


def mesh_of(name: str, shapes: list[Any], names: list[str] | None = None) -> fr.Mesh:
    """Return a mesh of shapes (vertices, faces); ``names`` are the names of its parts."""
    normal = np.array([0.0, 0.0, 1.0])
    parts = tuple(
        Part(
            np.array(v),
            np.broadcast_to(normal, v.shape),
            np.asarray(f, np.uint32),
            name=names[i] if names else "",
        )
        for i, (v, f) in enumerate(shapes)
    )
    used = np.concatenate([part.positions[np.unique(part.faces)] for part in parts])
    bounds = np.array([used.min(axis=0), used.max(axis=0)])
    radius = float(np.linalg.norm(used - bounds.mean(axis=0), axis=1).max())
    materials = (fr.Material(),) * len(parts)
    return fr.Mesh(
        Geometry(name, parts, bounds, radius, np.array([(1.0, 1.0), (1.0, -1.0)])), materials
    )
