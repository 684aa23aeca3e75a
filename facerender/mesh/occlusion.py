"""Ambient occlusion at vertices, for meshes without occlusion maps. Embree traces the rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facerender import __version__
from facerender.errors import warn
from facerender.mesh.mesh import Mesh, coordinates, drawn_alpha
from facerender.mesh.part import Part
from facerender.system import cache as disk_cache
from facerender.system.files import digest_of
from facerender.system.process import optional
from facerender.values.vectors import Array, Float, Float32

DIRECTIONS = 512  # ray directions on the whole sphere; half of them are on a vertex's outer side
# Distance of ray origins from the surface, in mesh radii; float32 resolves 1e-7 mesh radii.
_OFFSET = 1e-4
_BLOCK = 1 << 16  # rays that are traced at once, to limit the memory


def with_occlusion(mesh: Mesh, *, cache: bool = False) -> Mesh:
    """Return the mesh with ambient occlusion baked at vertices of parts without an occlusion map.

    The occlusion is the fraction of uniform ambient light that reaches a vertex. It dims ambient
    light and environment maps.

    All vertices use the same 512 ray directions over the whole sphere. Only rays on the outer side
    of the surface count, weighted by the cosine between ray and normal. The result is as accurate
    as with 256 cosine-distributed rays, but deterministic and without noise between neighbouring
    vertices. Vertices with equal position and normal, for example at seams of texture coordinates,
    share one value. Opaque parts block rays from both sides. Parts that are not opaque, or have
    transmission, do not block rays and get no occlusion. A mesh that has only such parts, or parts
    with occlusion maps, is returned unchanged with a FacerenderWarning.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`; :func:`facerender.simplified` keeps baked occlusion
    cache : whether to read and write baked occlusion in ``~/.cache/facerender``
    """
    pairs = [*zip(mesh.parts, mesh.materials, strict=True)]
    solid = [drawn_alpha(*pair) == "opaque" and not pair[1].transmission for pair in pairs]
    bare = [
        is_solid and not (m.occlusion_map and coordinates(part, m, "occlusion_map") is not None)
        for is_solid, (part, m) in zip(solid, pairs, strict=True)
    ]
    if not any(bare):
        warn(f"{mesh.name} has occlusion maps for all opaque parts: no occlusion is baked")
        return mesh
    rows = [np.hstack([mesh.normalised(part.positions), part.normals]) for part in mesh.parts]
    starts = np.cumsum([0, *map(len, rows)])
    all_faces = zip(mesh.parts, starts[:-1], solid, strict=True)
    faces = [part.faces + start for part, start, is_solid in all_faces if is_solid]
    occlusions = np.split(_values(np.concatenate(rows), np.concatenate(faces), cache), starts[1:-1])
    baked = [values if lacks else None for values, lacks in zip(occlusions, bare, strict=True)]

    def with_baked(parts: tuple[Part, ...]) -> tuple[Part, ...]:
        return tuple(replace(p, occlusion=values) for p, values in zip(parts, baked, strict=True))

    geometry = replace(mesh.geometry, parts=with_baked(mesh.geometry.parts))
    pose = mesh.pose and replace(mesh.pose, geometry=geometry, parts=with_baked(mesh.parts))
    return Mesh(geometry, mesh.materials, pose)


def _values(vertices: Float, faces: Array, cache: bool) -> Float:
    """Return the occlusion of vertices, given as rows (N, 6) of position and normal, with the disk
    cache if ``cache`` is true. Vertices that no face uses get 1."""
    version = repr((__version__, DIRECTIONS, _OFFSET, vertices.shape, faces.shape))
    name = digest_of(version, vertices.data, faces.data) if cache else ""
    if cache and (content := disk_cache.read("occlusion", name)) is not None:
        return np.frombuffer(content)
    used, corners = np.unique(faces, return_inverse=True)
    rows = vertices[used].astype(np.float32)
    different, numbers = np.unique(rows, axis=0, return_inverse=True)
    corners, numbers = corners.reshape(-1, 3), numbers.reshape(-1)
    occlusion = np.ones(len(vertices))
    occlusion[used] = _open_fraction(rows[:, :3], corners, different, numbers[corners])[numbers]
    if cache:
        disk_cache.write("occlusion", name, [occlusion.data])
    return occlusion


def _open_fraction(positions: Float32, faces: Array, vertices: Float32, corners: Array) -> Float:
    """Return the fraction of ambient light that reaches each vertex, in [0, 1]. ``vertices`` has
    rows (N, 6) of position and normal, to which ``corners``, (F, 3), refer for each face."""
    missing = "baking occlusion needs the package embreex; pip install 'facerender[rays]'"
    scene = optional("embreex.rtcore_scene", missing).EmbreeScene()
    construction = optional("embreex.mesh_construction", missing)
    construction.TriangleMesh(scene, np.ascontiguousarray(positions), faces.astype(np.int32))
    offsets = _off_surface(positions, faces, vertices, corners)
    starts = vertices[:, :3] + np.float32(_OFFSET) * offsets
    # Unit vectors, evenly distributed on a golden-ratio spiral
    indices = np.arange(DIRECTIONS) + 0.5
    heights = 1.0 - 2.0 * indices / DIRECTIONS
    angles, radii = indices * (np.pi * (3.0 - np.sqrt(5.0))), np.sqrt(1.0 - heights**2)
    spiral = np.stack([radii * np.cos(angles), heights, radii * np.sin(angles)], axis=1)
    fractions = []
    for first in range(0, len(vertices), _BLOCK):
        rows = slice(first, first + _BLOCK)
        origins, normals = starts[rows], vertices[rows, 3:]
        through, total = np.zeros((2, len(origins)))
        for direction in spiral.astype(np.float32):
            cosines = normals @ direction
            above = cosines > 0.0
            towards = np.tile(direction, (int(above.sum()), 1))
            missed = scene.run(origins[above], towards, query="OCCLUDED") < 0
            through[above] += cosines[above] * missed
            total[above] += cosines[above]
        fractions.append(through / total)
    return np.concatenate(fractions)


def _off_surface(positions: Float32, faces: Array, vertices: Float32, corners: Array) -> Float32:
    """Return the directions in which ray origins are offset from vertices: the normal plus a
    component towards the middle of the vertex's faces. Without this component, a ray at a sharp
    edge could start in the plane of the face behind the edge."""
    sums, lengths = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    middles = positions[faces].mean(axis=1)
    for vertex, face in zip(corners.T, faces.T, strict=True):
        inwards = middles - positions[face]
        np.add.at(sums, vertex, inwards)
        np.add.at(lengths, vertex, np.linalg.norm(inwards, axis=1))
    normals = vertices[:, 3:]
    sums -= normals * np.einsum("ij,ij->i", normals, sums)[:, None]
    return (normals + sums / np.maximum(lengths, 1e-30)[:, None]).astype(np.float32)
