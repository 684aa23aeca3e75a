"""Pieces, which are parts before repair, and safe repairs: bad faces, missing normals, winding."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, clipped, warn
from facerender.images.image import srgb_to_linear
from facerender.material import Material
from facerender.mesh.part import Part, used
from facerender.values.vectors import Array, Float, Integers, Mask, rows_of, transformed

if TYPE_CHECKING:
    from facerender.mesh.rig import Rig

# Largest coordinate and smallest extent of a mesh. Within these limits, areas, squared areas and
# products of areas with positions neither overflow nor become 0 in float64.
_HUGE, _TINY = 1e60, 1e-60
_CURVE_BITS = 10  # for each axis of the curve that orders faces
_MAX_PIECES = 1024  # limit, because every part needs a draw call in each pass

VERTEX_ARRAYS = ("positions", "normals", "uv", "uv2", "colors")


@dataclass
class Piece:
    """A :class:`Part` before repair. Normals may be missing and faces may be bad."""

    positions: Float
    faces: Integers
    normals: Float | None = None
    uv: Float | None = None
    colors: Float | None = None
    material: Material = Material()
    out_of_range: int = 0  # number of faces that the loader dropped for invalid vertex indices
    name: str = ""  # name from the file; not necessarily unique
    uv2: Float | None = None
    material_name: str = ""  # name of the material in the file
    head: Float | None = None
    skin: bool = True
    sources: NDArray[np.integer] | None = None
    source_count: int = 0
    rig: Rig | None = None
    preset: str = ""
    ks_ignored: bool = False


def in_space_order(faces: Integers, positions: Float) -> Integers:
    """Return faces in an order in which most faces are near the previous face. Faces in random
    order take up to 20 % more time to draw, because drivers transform shared vertices again.

    Faces of which half share a vertex with the previous face are not reordered. Otherwise, the
    faces follow the Z-order curve of their first vertices (Morton 1966).
    """
    adjacent = np.count_nonzero((faces[1:, :, None] == faces[:-1, None]).any(axis=(1, 2)))
    if 2 * adjacent >= len(faces) - 1:
        return faces
    points = positions[faces[:, 0]]
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max()) or 1.0
    cells = ((points - low) * ((2**_CURVE_BITS - 1) / extent)).astype(np.int64)
    codes = np.zeros(len(faces), dtype=np.int64)
    for bit in range(_CURVE_BITS):
        codes |= ((cells >> bit & 1) @ (1, 2, 4)) << 3 * bit
    return faces[np.argsort(codes, kind="stable")]


def unique(names: Iterable[str]) -> Iterator[str]:
    """Yield each name, clipped to one line. A repeated name gets a number: the second part that is
    called ``eye`` becomes ``eye.2``. Empty names stay empty."""
    numbers: dict[str, int] = {}
    for full in names:
        plain = name = clipped(full, 80)
        while name and name in numbers:
            numbers[plain] += 1
            name = f"{plain}.{numbers[plain]}"
        numbers[name] = 1
        yield name


def check_count(count: int, name: str) -> None:
    """Raise InputError if a file has too many parts."""
    if count > _MAX_PIECES:
        raise InputError(f"{name} has more than {_MAX_PIECES} parts with materials: join some")


def placed(piece: Piece, transform: Float) -> Piece:
    """Return a piece transformed by a matrix (4, 4)."""
    positions, normals, mirrored = transformed(piece.positions, piece.normals, transform)
    faces = piece.faces[:, ::-1] if mirrored else piece.faces
    return replace(piece, positions=positions, faces=faces, normals=normals)


def with_faces(piece: Piece, faces: Array, vertices: Array) -> Piece:
    """Return a piece with other faces, (F, 3), which are indices into ``vertices``, (N,). These are
    indices of vertices of the piece, which are copied; an index may occur more than once."""
    columns = ((name, getattr(piece, name)) for name in VERTEX_ARRAYS)
    arrays = {name: values[vertices] for name, values in columns if values is not None}
    sources = vertices if piece.sources is None else piece.sources[vertices]
    count = piece.source_count or len(piece.positions)
    return replace(piece, **arrays, faces=faces, sources=sources, source_count=count)


def with_face_colors(piece: Piece, colors: Float) -> Piece:
    """Return a piece with colours (F, 3) of faces: only faces of one colour share vertices."""
    palette, numbers = np.unique(colors, axis=0, return_inverse=True)
    corners = piece.faces * len(palette) + numbers.reshape(-1, 1)
    keys, inverse = np.unique(corners, return_inverse=True)
    vertices, numbers = np.divmod(keys, len(palette))
    return replace(with_faces(piece, inverse.reshape(-1, 3), vertices), colors=palette[numbers])


def indices_of(
    name: str, indices: ArrayLike, count: int, noun: str, uses: str, hint: str = ""
) -> Integers:
    """Return indices (F, 3) in [0, count) from an array or nested lists. ``noun`` names the indices
    in messages, and ``uses`` begins the message about an invalid one."""
    rows = rows_of(name, indices, (3,), hint)
    if (rows != np.floor(rows)).any():
        raise InputError(f"{name} are not whole numbers: give {noun} indices")
    if ((rows < 0) | (rows >= count)).any():
        bad = int(rows.min()) if (rows < 0).any() else int(rows.max())
        raise InputError(f"{uses} {bad} of {count}: give indices from 0 on")
    return rows.astype(np.int64)


def split_at_seams(piece: Piece, uv: Float, indices: ArrayLike) -> Piece:
    """Return a piece with a vertex for each pair of a vertex and a row of uv that a corner uses;
    for ``indices`` see uv_faces of :meth:`facerender.Mesh.from_arrays`."""
    uv_faces = indices_of("uv_faces", indices, len(uv), "row", "uv_faces use row")
    if len(uv_faces) != len(piece.faces):
        remedy = f"give {len(piece.faces)}, one for each face"
        raise InputError(f"uv_faces has {len(uv_faces)} rows: {remedy}")
    pairs, corners = np.unique(piece.faces * len(uv) + uv_faces, return_inverse=True)
    vertices, rows = np.divmod(pairs, len(uv))
    return replace(with_faces(piece, corners.reshape(-1, 3), vertices), uv=uv[rows])


def linear_colors(colors: ArrayLike, count: int) -> Float:
    """Return linear RGB (N, 3); for the colours see :meth:`facerender.Mesh.from_arrays`."""
    rows = rows_of("colors", colors, (3, 4), count=count)[:, :3]
    dtype = np.asarray(colors).dtype
    if dtype in (np.uint8, np.uint16):
        return srgb_to_linear(rows / np.iinfo(dtype).max)
    if rows.min() < 0.0 or rows.max() > 1.0:
        remedy = "give linear values in [0, 1] or sRGB-encoded uint8"
        raise InputError(f"colors range from {rows.min():.4g} to {rows.max():.4g}: {remedy}")
    return rows


def clean(pieces: Sequence[Piece], name: str) -> Sequence[Piece]:
    """Drop faces that cannot be drawn, compute missing normals, and turn the faces outwards."""
    _drop_bad_faces(pieces, name)
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise InputError(f"no face of {name} has a finite, non-zero area; export the mesh again")
    _drop_bad_uv(pieces, name)
    _complete_normals(pieces, name)
    corners = np.concatenate([_corners(piece) for piece in pieces])
    normals = face_normals(corners)
    areas = np.linalg.norm(normals, axis=1)
    middles = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0
    outward = middles - np.average(middles, axis=0, weights=areas)
    # The area-weighted mean cosine between face normals and directions from the mesh's centre is
    # near 1 for a closed head or an open mask, near -1 if the mesh is inside out.
    if (normals * outward).sum() / (areas * np.linalg.norm(outward, axis=1)).sum() < -0.5:
        warn(f"the faces of {name} are inside out: turned")
        for piece in pieces:
            piece.faces = piece.faces[:, ::-1]
            piece.normals = -np.asarray(piece.normals)
            if piece.rig is not None:
                piece.rig = replace(piece.rig, sign=-1.0)
    return pieces


def _corners(piece: Piece) -> Float:
    """Return the positions of the faces' corners, (F, 3, 3)."""
    return np.take(piece.positions, piece.faces, axis=0)  # twice as fast as positions[faces]


def joined(groups: NDArray[np.integer], count: int) -> Integers:
    """Return a label for each index below `count`. Indices of one row of `groups`, (N, K), share a
    label: the lowest index of their connected component."""
    labels = np.arange(count)
    a, b = groups[:, :-1].ravel(), groups[:, 1:].ravel()
    while len(a):
        np.minimum.at(labels, np.maximum(a, b), np.minimum(a, b))
        while (labels != (lower := labels[labels])).any():
            labels = lower
        a, b = labels[a], labels[b]
        apart = a != b
        a, b = a[apart], b[apart]
    return labels


def face_normals(corners: Float) -> Float:
    """Return normals of triangles (F, 3, 3). Each normal's length is twice the triangle's area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def double_areas(corners: Float) -> Float:
    """Return the doubled areas (F,) of triangles (F, 3, 3)."""
    return np.asarray(np.linalg.norm(face_normals(corners), axis=1))


def _drop_bad_faces(pieces: Sequence[Piece], name: str) -> None:
    """Drop faces that have invalid vertex indices, non-finite or huge vertices, or no area."""
    out_of_range = sum(piece.out_of_range for piece in pieces)
    infinite = huge = bad_faces = huge_faces = flat_faces = 0
    for piece in pieces:
        within = (piece.faces >= 0) & (piece.faces < len(piece.positions))
        out_of_range += _keep_faces(piece, within)
        small = np.asarray((np.abs(piece.positions) < _HUGE).all(axis=1))
        if not small.all():
            finite = np.asarray(np.isfinite(piece.positions).all(axis=1))
            infinite += int((~finite).sum())
            huge += int((finite & ~small).sum())
            bad_faces += _keep_faces(piece, finite[piece.faces])
            huge_faces += _keep_faces(piece, small[piece.faces])
    if filled := [piece for piece in pieces if len(piece.faces)]:
        _check_extent(filled, name)
    for piece in pieces:
        # Rounding of large coordinates (1e25) can give a cross product of 0 at one corner and not
        # at another, so both windings are tested.
        corners = _corners(piece)
        areas = np.minimum(double_areas(corners), double_areas(corners[:, ::-1]))
        flat_faces += _keep_faces(piece, areas[:, None] > 0.0)
    for count, problem in (
        (out_of_range, "faces with invalid vertex indices: dropped"),
        (infinite, f"non-finite vertices: {bad_faces} faces dropped"),
        (huge, f"vertices beyond {_HUGE:g}: {huge_faces} faces dropped"),
        (flat_faces, "degenerate faces: dropped"),
    ):
        if count:
            warn(f"{name} has {count} {problem}")


def _keep_faces(piece: Piece, good: Mask) -> int:
    """Drop faces with a bad corner in a mask (F, 3), or (F, 1) for faces; return their number."""
    keep = good.all(axis=1)
    piece.faces = piece.faces[keep]
    return int((~keep).sum())


def _check_extent(pieces: Sequence[Piece], name: str) -> None:
    """Raise InputError if a mesh is too small to compute its areas; warn about outliers. If
    the camera frames outliers, the rest of the mesh is only a dot in the image."""
    points = np.concatenate([p.positions[used(p.positions, p.faces)] for p in pieces])
    extent = float(np.ptp(points, axis=0).max())
    if 0.0 < extent < _TINY:
        raise InputError(f"{name} is {extent:g} units wide, below {_TINY:g}: scale it up")
    middle = np.median(points, axis=0)
    distances = np.linalg.norm(points - middle, axis=1)
    near = float(np.quantile(distances, 0.9, method="lower"))
    far = distances > max(32.0 * near, _TINY)
    if far.any():
        x, y, z = points[np.argmax(distances)]
        outer = f"{int(far.sum())} vertices far out, one at ({x:.4g}, {y:.4g}, {z:.4g})"
        others = f"within {near:.4g} of ({', '.join(f'{v:.4g}' for v in middle)})"
        remedy = "remove the outer vertices"
        warn(f"{name} has {outer}; 90 % are {others} and will appear tiny: {remedy}")


def _drop_bad_uv(pieces: Sequence[Piece], name: str) -> None:
    """Set texture coordinates to 0 if they are not finite or too large for float32."""
    count = 0
    for piece in pieces:
        for key in ("uv", "uv2"):
            if (uv := getattr(piece, key)) is not None:
                bad = ~(np.abs(uv) <= 1e6).all(axis=1)  # float32 resolves no texels at far less
                if bad.any():
                    count += int((bad & used(piece.positions, piece.faces)).sum())
                    setattr(piece, key, np.where(bad[:, None], 0.0, uv))
    if count:
        warn(f"{name} has {count} texture coordinates outside [-1e6, 1e6]: set to 0")


def _complete_normals(pieces: Sequence[Piece], name: str) -> None:
    """Normalise each piece's normals. Compute all normals of a piece if any is missing or bad."""
    without = []
    for piece in pieces:
        if piece.normals is not None:
            length = np.linalg.norm(piece.normals, axis=1)
            good: Mask = np.isfinite(length) & (length > 0.0)
            if good[piece.faces].all():
                normals = piece.normals = piece.normals / np.where(good, length, 1.0)[:, None]
                # Reverse the winding of each face that faces away from its vertices' normals.
                a, b, c = (np.take(normals, corner, axis=0) for corner in piece.faces.T)
                away = (face_normals(_corners(piece)) * (a + b + c)).sum(axis=1) < 0.0
                piece.faces = np.where(away[:, None], piece.faces[:, ::-1], piece.faces)
                continue
            warn(f"{name} has {int((~good).sum())} normals of zero length: all recomputed")
        without.append(piece)
    if without:
        _compute_normals(without, name)


def _compute_normals(pieces: Sequence[Piece], name: str) -> None:
    """Compute smooth normals. Vertices at one position share a normal, also across seams and
    materials. Face normals are weighted by the angle at the vertex (Thuermer and Wuethrich, 1998),
    so that the result does not depend on the triangulation of flat polygons."""
    positions, faces, welded, starts = stacked(pieces)
    faces = _wind_consistently(faces, welded[faces], positions, name)
    corners = positions[faces]
    unit = face_normals(corners)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    normals = np.zeros((welded.max() + 1, 3))
    for corner in range(3):
        a, b = (corners[:, (corner + i) % 3] - corners[:, corner] for i in (1, 2))
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        vertices = welded[faces[:, corner]]
        for axis in range(3):
            normals[:, axis] += np.bincount(vertices, angle * unit[:, axis], len(normals))
    # If the normals of opposite faces cancel out, an arbitrary unit vector replaces the sum.
    normals = np.where(np.linalg.norm(normals, axis=1)[:, None] > 0.0, normals, (0.0, 0.0, 1.0))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    splits = np.cumsum([len(piece.faces) for piece in pieces])
    for piece, start, triangles in zip(pieces, starts, np.split(faces, splits[:-1]), strict=False):
        piece.faces = triangles - start
        piece.normals = normals[welded[start : start + len(piece.positions)]]
        if piece.rig is not None:
            piece.rig = piece.rig.with_normals(piece.normals)


def stacked(parts: Sequence[Part | Piece]) -> tuple[Float, Integers, Integers, Integers]:
    """Return the vertices and the faces of all parts, an index for each position that faces use,
    and the first vertex of each part. Positions that are equal after rounding to about 2^-21 of the
    mesh's extent share an index."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    all_positions = np.concatenate([part.positions for part in parts])
    joint = np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)])
    mask = used(all_positions, joint)
    positions = all_positions[mask]
    extent = float(np.ptp(positions, axis=0).max()) or 1.0
    # 2^21 - 2 is even, so that a plane of symmetry is rounded to the middle of a cell.
    cells = np.round((positions - positions.min(axis=0)) * ((2**21 - 2) / extent)).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    welded = np.zeros(len(all_positions), dtype=np.int64)
    welded[mask] = np.unique(keys, return_inverse=True)[1]
    return all_positions, joint, welded, starts


def _wind_consistently(faces: Integers, welded: Integers, positions: Float, name: str) -> Integers:
    """Return the faces, wound consistently and outwards in each connected surface.
    The windings of two neighbouring faces are consistent if the faces traverse their common edge in
    opposite directions. If no directed edge occurs twice, all windings are already consistent.
    Otherwise a graph gets two nodes for each face: its original and its reversed winding. A graph
    edge joins two nodes if their faces are neighbours and their windings are consistent. Each
    connected component of the graph is then one possible winding of a surface.
    """
    first, second = welded[:, [0, 1, 2]].ravel(), welded[:, [1, 2, 0]].ravel()
    count = int(welded.max()) + 1
    directed = first * count + second
    if len(np.unique(directed)) == len(directed):
        return faces
    edge = np.minimum(first, second) * count + np.maximum(first, second)
    order = np.argsort(edge, kind="stable")
    _, start, uses = np.unique(edge[order], return_index=True, return_counts=True)
    start = start[uses == 2]  # an edge with three faces defines no consistent winding
    a, b = order[start], order[start + 1]
    disagree = (first[a] == first[b]).astype(np.int64)
    face_a, face_b, n = a // 3, b // 3, len(faces)
    rows = np.concatenate([face_a, face_a + n])
    columns = np.concatenate([face_b + n * disagree, face_b + n * (1 - disagree)])
    label = joined(np.stack([rows, columns], axis=1), 2 * n)
    corners = positions[faces]
    middle = corners.mean(axis=1)
    outward = (face_normals(corners) * (middle - middle.mean(axis=0))).sum(axis=1)
    score = np.bincount(label, np.concatenate([outward, -outward]), 2 * n)
    turn = score[label[n:]] > score[label[:n]]
    if not turn.any():
        return faces
    warn(f"{name} has faces wound both ways: {int(turn.sum())} of {n} turned")
    return np.where(turn[:, None], faces[:, ::-1], faces)
