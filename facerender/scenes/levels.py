"""Levels of detail: a mesh with fewer triangles, for pictures that cannot show them all. The
arithmetic is meshoptimizer's, as WebAssembly in the folder beside; wasmtime runs it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, warn
from facerender.scenes.mesh import Mesh, Part

if TYPE_CHECKING:
    import wasmtime

Float = NDArray[np.float64]

# What errors count beside a distance of the mesh's extent: of normals; of places on a map, measured
# on the surface in radii; of linear colours. Chosen by images such as those of docs/levels.md.
_NORMAL, _PLACE, _COLOR = 1.0, 20.0, 1.0
_ANY_ERROR = 1e9  # the number of triangles alone ends it
# Of what goes in, of the 4 GiB that WebAssembly has: 8 million triangles that share their vertices,
# which take 3 GiB.
_MOST_BYTES = 2**28

_levels: WeakKeyDictionary[Mesh, dict[int, Mesh]] = WeakKeyDictionary()


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most so many triangles, where that can be.

    Edges collapse in the order of their quadric error (Garland and Heckbert 1997), which counts
    normals, texture coordinates and colours beside distances (Hoppe 1999); what is left of them
    moves to where the error is least. Open borders, seams of texture coordinates and normals, and
    borders between parts collapse along themselves, both sides at once: no crack opens. Materials,
    the number of parts, bounds, radius and profile stay, so that a camera sees both meshes alike.

    The result is the same on every machine, and the same object for the same arguments. Kapoulkine
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
    check_triangles(triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    known = _levels.setdefault(mesh, {})
    if triangles not in known:
        known[triangles] = _simplify(mesh, triangles)
    if (left := sum(len(part.faces) for part in known[triangles].parts)) > triangles:
        warn(f"{mesh.name} cannot be simplified to {triangles} triangles: it keeps {left}")
    return known[triangles]


def check_triangles(value: Any) -> None:
    """Raise InputError where a value is no number of triangles."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InputError(f"triangles = {value!r}: give a whole number of at least 1")


def _simplify(mesh: Mesh, triangles: int) -> Mesh:
    """All parts at once, so that their common borders stay common and the worst goes last."""
    scales = [_scale(part) / mesh.radius for part in mesh.parts]
    ends = np.cumsum([len(part.positions) for part in mesh.parts])
    starts = [0, *ends[:-1]]
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=True)]
    positions = mesh.normalised(np.concatenate([part.positions for part in mesh.parts]))
    attributes = np.concatenate(
        [_attributes(*each) for each in zip(mesh.parts, scales, strict=True)]
    )
    if 4 * (3 * sum(map(len, faces)) + positions.size + attributes.size) > _MOST_BYTES:
        raise InputError(f"{mesh.name} is too large to simplify: leave the triangles out")
    left, moved, changed = _run(np.concatenate(faces), positions, attributes, triangles)
    moved /= np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1.0)  # the radius stays
    normals = _normals(positions, attributes[:, :3], changed[:, :3], np.unique(left))
    parts = []
    for part, start, end, scale in zip(mesh.parts, starts, ends, scales, strict=True):
        own = left[(left[:, 0] >= start) & (left[:, 0] < end)] - start
        if not len(own):
            own = part.faces[[np.argmax(_double_areas(part.positions[part.faces]))]]
        kept, numbers = np.unique(own, return_inverse=True)
        places = changed[start:end, 3:5][kept] / scale
        colors = changed[start:end, 5:][kept]
        parts.append(
            Part(
                mesh.denormalised(moved[start:end][kept]),
                normals[start:end][kept],
                numbers.reshape(own.shape).astype(np.uint32),
                None if part.uv is None else _within(places, part.uv),
                None if part.colors is None else _within(colors, part.colors),
            )
        )
    return replace(mesh, parts=tuple(parts))


def _scale(part: Part) -> float:
    """Return the length on the surface of a step of 1 on the part's maps."""
    if part.uv is None:
        return 1.0
    flat = np.concatenate([part.uv, np.zeros((len(part.uv), 1))], axis=1)
    on_map = float(_double_areas(flat[part.faces]).sum())
    on_surface = float(_double_areas(part.positions[part.faces]).sum())
    return math.sqrt(on_surface / on_map) if on_map > 0.0 else 1.0


def _double_areas(corners: Float) -> Float:
    """Return twice the areas of triangles, (F, 3, 3) to (F,)."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))


def _attributes(part: Part, scale: float) -> Float:
    """Return normals, scaled texture coordinates and colours, (N, 8)."""
    count = len(part.positions)
    uv = np.zeros((count, 2)) if part.uv is None else part.uv * scale
    colors = np.ones((count, 3)) if part.colors is None else part.colors
    return np.concatenate([part.normals, uv, colors], axis=1)


def _normals(positions: Float, before: Float, after: Float, kept: NDArray[np.uint32]) -> Float:
    """Return unit normals: one for vertices that had one place and one normal in common.

    A seam of texture coordinates has two vertices at one place, each changed by its own side.
    """
    whole = np.concatenate([positions, before], axis=1)[kept]
    _, common = np.unique(whole, axis=0, return_inverse=True)
    sums = np.zeros((len(kept), 3))
    np.add.at(sums, common.reshape(-1), after[kept])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    units = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 1e-6)
    normals = before.copy()
    normals[kept] = np.where(lengths > 1e-6, units, 0.0)[common.reshape(-1)]
    return normals


def _within(values: Float, old: Float) -> Float:
    return np.clip(values, old.min(axis=0), old.max(axis=0))


def _run(
    faces: NDArray[np.uint32], positions: Float, attributes: Float, triangles: int
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
        np.array([_NORMAL] * 3 + [_PLACE] * 2 + [_COLOR] * 3, dtype=np.float32),
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
    code = (Path(__file__).parent / "meshoptimizer" / "simplifier.wasm").read_bytes()
    engine = wasmtime.Engine()
    return engine, wasmtime.Module(engine, code)
