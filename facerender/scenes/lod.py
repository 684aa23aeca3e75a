"""Levels of detail: a mesh with fewer triangles, for pictures that cannot show them all. The
arithmetic is meshoptimizer's, as WebAssembly in the folder beside; wasmtime runs it."""

from __future__ import annotations

import atexit
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_type, warn
from facerender.scenes.framing import find_regions
from facerender.scenes.mesh import TRIANGLES, Mesh, Part

if TYPE_CHECKING:
    import wasmtime

Float = NDArray[np.float64]

# What errors count beside a distance of the mesh's extent: of normals; of places on a map, measured
# on the surface in radii; of linear colours, of occlusion, and of places by second coordinates.
# Chosen by images such as those of docs/measurements/levels.md.
_NORMAL, _PLACE, _COLOR = 1.0, 20.0, 1.0
_WEIGHTS = [_NORMAL] * 3 + [_PLACE] * 2 + [_COLOR] * 4 + [_PLACE] * 2
_ANY_ERROR = 1e9  # the number of triangles alone ends it
# Of what goes in, of the 4 GiB that WebAssembly has: 8 million triangles that share their vertices,
# which take 3 GiB.
_MOST_BYTES = 2**28

_levels: WeakKeyDictionary[Mesh, dict[int, Mesh]] = WeakKeyDictionary()


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most so many triangles, where that can be.

    Edges collapse in the order of their quadric error (Garland and Heckbert 1997), which counts
    normals, texture coordinates, colours and occlusion beside distances (Hoppe 1999); what is left
    of them moves to where the error is least. Open borders, seams of texture coordinates and
    normals, and borders between parts collapse along themselves, both sides at once: no crack
    opens. Materials, the number of parts, bounds, radius, profile, head and face stay, so that a
    camera sees both meshes alike.

    The result is the same in every process, and the same object for the same arguments. Kapoulkine
    (2016-2026), meshoptimizer 1.3: meshopt_simplifyWithUpdate.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    triangles : of all parts together, at least 1; the mesh itself where it has no more

    Raises
    ------
    InputError : triangles below 1; wasmtime is not installed; some 8 million triangles and more

    Warns
    -----
    FacerenderWarning : seams and parts need more triangles
    """
    check_type("mesh", mesh, Mesh, "a facerender.Mesh")
    TRIANGLES.check("triangles", triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    known = _levels.setdefault(mesh, {})
    if triangles not in known:
        known[triangles] = _simplify(mesh, triangles)
    if (left := sum(len(part.faces) for part in known[triangles].parts)) > triangles:
        warn(f"{mesh.name} cannot be simplified to {triangles} triangles: it keeps {left}")
    return known[triangles]


def _simplify(mesh: Mesh, triangles: int) -> Mesh:
    """All parts at once, so that their common borders stay common and the worst goes last."""
    scales = [(_scale(part, part.uv), _scale(part, part.uv2)) for part in mesh.parts]
    rows = np.concatenate([_vertices(mesh, *each) for each in enumerate(scales)])
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    rows, numbers = np.unique(rows, axis=0, return_inverse=True)  # some files share no vertex
    own, positions, attributes = rows[:, 0], rows[:, 1:4], rows[:, 4:]
    corners = numbers.reshape(-1)[np.concatenate(faces)]
    if 4 * (corners.size + positions.size + attributes.size) > _MOST_BYTES:
        raise InputError(f"{mesh.name} is too large to simplify: leave the triangles out")
    left, moved, changed = _run(corners, positions, attributes, triangles)
    moved /= np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1.0)  # the radius stays
    normals = _normals(positions, attributes[:, :3], changed[:, :3], np.unique(left))
    parts = []
    for index, (part, scale) in enumerate(zip(mesh.parts, scales, strict=True)):
        chosen = left[own[left[:, 0]] == index]
        if not len(chosen):
            all_faces = corners[own[corners[:, 0]] == index]
            chosen = all_faces[[np.argmax(_double_areas(positions[all_faces]))]]
        kept, numbers = np.unique(chosen, return_inverse=True)
        parts.append(
            Part(
                mesh.to_mesh_space(moved[kept]),
                normals[kept],
                numbers.reshape(chosen.shape).astype(np.uint32),
                _places(part.uv, changed[kept, 3:5], scale[0] / mesh.radius),
                None if part.colors is None else _within(changed[kept, 5:8], part.colors),
                None if part.occlusion is None else _within(changed[kept, 8], part.occlusion),
                _places(part.uv2, changed[kept, 9:11], scale[1] / mesh.radius),
                part.name,
            )
        )
    return replace(mesh, parts=tuple(parts), regions=find_regions(mesh))


def _vertices(mesh: Mesh, index: int, scales: tuple[float, float]) -> Float:
    """Return number of the part, position, normal, scaled place on the maps, colour: (N, 12),
    occlusion where a part of the mesh has it or what follows: (N, 13), and where a part has it the
    scaled second place on the maps: (N, 15)."""
    part = mesh.parts[index]
    count = len(part.positions)
    columns = [
        np.full((count, 1), index),
        mesh.normalised(part.positions),
        part.normals,
        np.zeros((count, 2)) if part.uv is None else part.uv * (scales[0] / mesh.radius),
        np.ones((count, 3)) if part.colors is None else part.colors,
    ]
    second = any(each.uv2 is not None for each in mesh.parts)
    if second or any(each.occlusion is not None for each in mesh.parts):
        columns.append((np.ones(count) if part.occlusion is None else part.occlusion)[:, None])
    if second:
        own = np.zeros((count, 2)) if part.uv2 is None else part.uv2 * (scales[1] / mesh.radius)
        columns.append(own)
    return np.concatenate(columns, axis=1)


def _scale(part: Part, uv: Float | None) -> float:
    """Return the length on the surface of a step of 1 on a part's maps."""
    if uv is None:
        return 1.0
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    on_map = float(_double_areas(flat[part.faces]).sum())
    on_surface = float(_double_areas(part.positions[part.faces]).sum())
    return math.sqrt(on_surface / on_map) if on_map > 0.0 else 1.0


def _double_areas(corners: Float) -> Float:
    """Return twice the areas of triangles, (F, 3, 3) to (F,)."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))


def _normals(positions: Float, before: Float, after: Float, kept: NDArray[np.uint32]) -> Float:
    """Return unit normals: one for vertices that had one place and one normal in common.

    A seam of texture coordinates has two vertices at one place, each changed by its own side.
    """
    whole = np.concatenate([positions, before], axis=1)[kept]
    _, common = np.unique(whole, axis=0, return_inverse=True)
    sums = np.zeros((len(kept), 3))
    np.add.at(sums, common.reshape(-1), after[kept])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    useful = (lengths > 1e-6)[common.reshape(-1)]
    normals = before.copy()
    normals[kept] = np.where(
        useful, (sums / np.maximum(lengths, 1e-6))[common.reshape(-1)], before[kept]
    )
    return normals


def _places(uv: Float | None, moved: Float, scale: float) -> Float | None:
    return None if uv is None else _within(moved / scale, uv)


def _within(values: Float, old: Float) -> Float:
    return np.clip(values, old.min(axis=0), old.max(axis=0))


def _run(
    faces: NDArray[np.int64], positions: Float, attributes: Float, triangles: int
) -> tuple[NDArray[np.uint32], Float, Float]:
    """Call meshopt_simplifyWithUpdate; return faces, positions and attributes as they are then."""
    engine, module = _compiled()
    import wasmtime

    store = wasmtime.Store(engine)
    library = wasmtime.Instance(store, module, []).exports(store)
    memory = library["memory"]
    arrays = [
        faces.astype(np.uint32),
        positions.astype(np.float32),
        attributes.astype(np.float32),
        np.array(_WEIGHTS[: attributes.shape[1]], dtype=np.float32),
        np.zeros(1, dtype=np.float32),  # the error
    ]
    places = [library["sbrk"](store, -(-array.nbytes // 16) * 16) for array in arrays]
    for array, place in zip(arrays, places, strict=True):
        memory.write(store, array.tobytes(), place)
    at_faces, at_positions, at_attributes, at_weights, at_error = places
    left = library["meshopt_simplifyWithUpdate"](
        store,
        *(at_faces, faces.size, at_positions, len(positions), 12),
        *(at_attributes, 4 * attributes.shape[1], at_weights, attributes.shape[1]),
        *(0, 3 * triangles, _ANY_ERROR, 0, at_error),  # no vertex locked, no option
    )

    def read(place: int, array: NDArray[Any]) -> NDArray[Any]:
        content = memory.read(store, place, place + array.nbytes)
        return np.frombuffer(content, array.dtype).reshape(array.shape)

    return (
        read(at_faces, arrays[0])[: left // 3],
        read(at_positions, arrays[1]).astype(np.float64),
        read(at_attributes, arrays[2]).astype(np.float64),
    )


@cache
def _compiled() -> tuple[wasmtime.Engine, wasmtime.Module]:
    try:
        import wasmtime
    except ImportError:
        raise InputError(
            "levels of detail need the package wasmtime; pip install 'facerender[lod]'"
        ) from None
    atexit.register(_compiled.cache_clear)  # wasmtime's own objects go before it does
    code = (Path(__file__).parent / "meshoptimizer" / "simplifier.wasm").read_bytes()
    engine = wasmtime.Engine()
    return engine, wasmtime.Module(engine, code)
