"""Meshes: a geometry, its materials, and a pose. The package ``loading`` reads mesh files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from facerender.errors import InputError, number_of, quoted, warn
from facerender.material import MAPS, Alpha, Material, changed, check_maps, without_effect
from facerender.mesh.geometry import Geometry, MeshPose, are_closed, clips_of, posed, unit_or
from facerender.mesh.part import Face, Part, Region, Space, TriangleSetup, used
from facerender.mesh.repair import Piece, clean, indices_of, linear_colors, split_at_seams, unique
from facerender.values.fields import IntegerRange, parameters
from facerender.values.vectors import Float, rows_of

TRIANGLES = IntegerRange(1, math.inf)  # accepted triangle limits of a simplified mesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """A geometry with materials, in a pose. Meshes that :meth:`with_material`, :meth:`with_pose`
    and :meth:`with_positions` return share the geometry, and a renderer uploads it once.

    Attributes
    ----------
    geometry : the parts in the reference pose, with name, radius, profile, millimetres and regions
    materials : one material for each part
    pose : moved vertices, or None for the reference pose. Cameras frame the reference pose; see
        :func:`facerender.tracked`
    """

    geometry: Geometry
    materials: tuple[Material, ...]
    pose: MeshPose | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "materials", tuple(self.materials))
        if not 0 < len(self.geometry.parts) == len(self.materials):
            counts = f"{len(self.geometry.parts)} parts and {len(self.materials)} materials"
            remedy = "give at least one part, and one material for each"
            raise InputError(f"{self.name} has {counts}: {remedy}")
        check_maps(self.name, self.materials)

    __getstate__ = parameters

    def __repr__(self) -> str:
        triangles = sum(len(part.faces) for part in self.parts)
        counts = f"{number_of(len(self.parts), 'part')}, {triangles} triangles"
        return f"<Mesh {self.name!r}, {counts}, radius {self.radius:.4g}>"

    @classmethod
    def of(
        cls,
        name: str,
        parts: Sequence[Part],
        materials: Sequence[Material],
        millimetres: float | None = None,
    ) -> Mesh:
        """Return a mesh in the reference pose, in which ``double_sided`` of the materials is set.
        Parts that share a material share the result, unless only one of them is closed."""
        geometry = Geometry.of(name, parts, millimetres)
        if any(material.double_sided is None for material in materials):
            sided = cache(lambda material, closed: replace(material, double_sided=not closed))
            pairs = zip(materials, are_closed(geometry.parts), strict=True)
            materials = [sided(m, shut) if m.double_sided is None else m for m, shut in pairs]
        return cls(geometry, tuple(materials))

    @classmethod
    def assembled(cls, pieces: Sequence[Piece], name: str, millimetres: float | None) -> Mesh:
        """Return a mesh of pieces that :func:`facerender.mesh.repair.clean` has repaired. A
        piece without a name is numbered, unless it is the only one: the third is ``part3``."""
        names = (piece.name or f"part{i}" * (len(pieces) > 1) for i, piece in enumerate(pieces, 1))
        parts = []
        for piece, part_name in zip(pieces, unique(names), strict=True):
            values: dict[str, Any] = {f.name: getattr(piece, f.name, None) for f in fields(Part)}
            faces = np.ascontiguousarray(piece.faces, dtype=np.uint32)
            parts.append(Part(**values | {"faces": faces, "name": part_name}))
        return cls.of(name, parts, [piece.material for piece in pieces], millimetres)

    @classmethod
    def from_arrays(
        cls,
        positions: ArrayLike,
        faces: ArrayLike,
        *,
        uv: ArrayLike | None = None,
        uv_faces: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        material: Material | None = None,
        name: str = "arrays",
        millimetres: float | None = None,
    ) -> Mesh:
        """Return a mesh of one part from copies of arrays or nested lists.

        The mesh is repaired like a mesh from a file, with warnings: faces that cannot be drawn are
        dropped, and faces are turned outwards.

        Parameters
        ----------
        positions : (N, 3), y up
        faces : (F, 3) vertex indices from 0, counter-clockwise seen from outside
        uv : (N, 2), v upwards, one row for each vertex; or (M, 2) with uv_faces
        uv_faces : (F, 3) indices of rows of uv for the corners of the faces, as in OBJ files; None
            if uv has one row for each vertex
        normals : (N, 3), vectors of any length; None to compute smooth normals
        colors : (N, 3) or (N, 4): linear floats in [0, 1], or sRGB-encoded uint8 or uint16; alpha
            is dropped
        material : None for skin, or for a white material if colors are given
        name : name of the mesh and of its part
        millimetres : millimetres per unit; scattering needs it
        """
        rows = rows_of("positions", positions, (3,))
        count, hint = len(rows), "; cut polygons into triangles"
        corners = indices_of("faces", faces, count, "vertex", "a face uses vertex", hint)
        if material is None:
            material = Material() if colors is None else Material(albedo=(1.0, 1.0, 1.0))
        maps = [name for name in MAPS if getattr(material, name) is not None]
        if uv is None and maps:
            raise InputError(f"the material has {maps[0]}, but the mesh has no uv: give uv")
        if uv is None and uv_faces is not None:
            raise InputError("uv_faces without uv: give uv as well")
        piece = Piece(rows, corners, material=material, name=name)
        if normals is not None:
            piece.normals = rows_of("normals", normals, (3,), count=count)
        if colors is not None:
            piece.colors = linear_colors(colors, count)
        if uv is not None and uv_faces is not None:
            piece = split_at_seams(piece, rows_of("uv", uv, (2,)), uv_faces)
        elif uv is not None:
            piece.uv = rows_of("uv", uv, (2,), count=count)
        with np.errstate(all="ignore"):  # clean() drops faces that cause overflow
            return cls.assembled(clean([piece], name), name, millimetres)

    def select(self, parts: str | Iterable[str] = (), hide: str | Iterable[str] = ()) -> Mesh:
        """Return a mesh of the named parts (default: all) without the hidden parts.

        Bounds and camera framing refer to the remaining parts.

        Parameters
        ----------
        parts, hide : part names, as several texts or one text with commas; ``*``, ``?`` and
            ``[...]`` are wildcards as in file names. A name without a match raises InputError
        """
        selected = self._named("parts", parts) or {*range(len(self.parts))}
        remaining = sorted(selected - self._named("hide", hide))
        if not remaining:
            raise InputError(f"every part of {self.name} is hidden: {self._known()}; hide fewer")
        if len(remaining) == len(self.parts):
            return self
        stored = [self.geometry.parts[i] for i in remaining]
        mesh = Mesh.of(self.name, stored, [self.materials[i] for i in remaining], self.millimetres)
        old = self.geometry
        geometry = replace(mesh.geometry, rotation=old.rotation, shift=old.shift)
        moved_parts = tuple(self.parts[i] for i in remaining)
        pose = self.pose and MeshPose(geometry, moved_parts, geometry.bounds)
        return Mesh(geometry, mesh.materials, pose)

    def renamed(self, name: str) -> Mesh:
        """Return a copy of the mesh with another name, parts called ``part1``, ``part2``..., and
        maps called by the fields of :class:`Material`. Shapes, joints and clips keep their names,
        since poses need them."""

        def numbered(parts: Iterable[Part]) -> tuple[Part, ...]:
            return tuple(replace(part, name=f"part{i}") for i, part in enumerate(parts, 1))

        materials = [
            replace(m, **{k: t.renamed(k.replace("_", " ")) for k in MAPS if (t := getattr(m, k))})
            for m in self.materials
        ]
        old, framing = self.geometry, self.geometry.framing  # which depends on names
        geometry = replace(old, name=name, parts=numbered(old.parts), known_framing=framing)
        pose = self.pose and replace(self.pose, geometry=geometry, parts=numbered(self.pose.parts))
        return Mesh(geometry, tuple(materials), pose)

    def _named(self, option: str, names: str | Iterable[str]) -> set[int]:
        return {i for name in names_of(option, names) for i in self.called(name)}

    def called(self, name: str) -> list[int]:
        """Return the indices of the parts that match a name."""
        parts = enumerate(self.parts)
        matches = [i for i, p in parts if p.name == name or fnmatchcase(p.name, name)]
        if not matches:
            raise InputError(f"no part of {self.name} is called {quoted(name)}: {self._known()}")
        return matches

    def _known(self) -> str:
        if not any(part.name for part in self.parts):
            return f"its {len(self.parts)} parts have no names"
        return f"its parts are {', '.join(part.name for part in self.parts)}"

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.geometry.name

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The parts in the pose of the mesh."""
        return (self.pose or self.geometry).parts

    @property
    def bounds(self) -> Float:
        """Lowest and highest coordinates in the reference pose, (2, 3) float64."""
        return (self.pose or self.geometry).bounds

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the centre of the bounds in the reference pose."""
        return self.geometry.radius

    @property
    def profile(self) -> Float:
        """Outline of the mesh; see :class:`Geometry`."""
        return self.geometry.profile

    @property
    def millimetres(self) -> float | None:
        """Millimetres per unit of mesh space; None if unknown."""
        return self.geometry.millimetres

    @property
    def regions(self) -> Mapping[str, Region | None]:
        """Regions that a camera may frame; see :class:`facerender.mesh.part.Framing`."""
        return self.geometry.framing.regions

    @cached_property
    def space(self) -> Space:
        """The renderer's space."""
        return (self.pose or self.geometry).space

    @cached_property
    def token(self) -> object:
        """A value that no mesh with other vertices has; see :attr:`Geometry.token`."""
        return (self.pose or self.geometry).token

    @cached_property
    def setups(self) -> list[TriangleSetup]:
        """The triangles of each part as the GPU gets them."""
        return (self.pose or self.geometry).setups

    @cached_property
    def single_sided(self) -> Mesh:
        """The mesh without back faces."""
        return self.with_material(double_sided=False)

    @cached_property
    def skin(self) -> tuple[int, ...]:
        """Indices of the parts that are skin: their ``Part.skin`` is true, and their materials have
        no transmission. If no part is skin, the indices of all parts."""
        pairs = enumerate(zip(self.parts, self.materials, strict=True))
        indices = [i for i, (part, material) in pairs if part.skin and material.transmission == 0.0]
        return tuple(indices or range(len(self.parts)))

    @property
    def center(self) -> Float:
        """Centre of the bounds, (3,) float64."""
        return np.array(self.space.center)

    def normalised(self, points: ArrayLike) -> Float:
        """Map points (..., 3) from mesh space to the renderer's space: centre at 0, radius 1."""
        return self.space.normalised(points)

    def to_mesh_space(self, points: ArrayLike) -> Float:
        """Map points (..., 3), such as ``View.position``, from the renderer's space to mesh space.

        ``Part.positions`` and ``GBuffer.position`` are in mesh space already."""
        return np.asarray(np.asarray(points, dtype=np.float64) * self.radius + self.center)

    def with_material(
        self, parts: str | Iterable[str] = (), preset: str | None = None, **changes: Any
    ) -> Mesh:
        """Return a copy of the mesh in which ``changes`` replace fields of the materials. The copy
        shares geometry and maps with this mesh.

        A new ``m`` also removes the roughness maps. A new ``second_slope``, ``lobe_weight`` or
        ``lobe_map`` that leaves a material with one lobe causes a warning, as does any other field
        without effect, such as ``opacity`` without ``alpha``.

        Parameters
        ----------
        parts : names of the parts whose materials change, as in :meth:`select`; default: all parts,
            also eyes and hair; see :meth:`with_skin`
        preset : name of a preset, whose fields apply before ``changes``; see docs/skin.md
        """
        table = changes if preset is None else {"preset": preset, **changes}
        return self._changed(self._named("parts", parts) or range(len(self.parts)), table)

    def with_skin(self, **changes: Any) -> Mesh:
        """Return a copy of the mesh in which ``changes`` replace fields of the skin's materials;
        see :attr:`skin` and :meth:`with_material`."""
        return self._changed(self.skin, changes)

    def with_positions(self, positions: Any, normals: Any = None) -> Mesh:
        """Return the mesh in another pose: moved vertices with the same triangles and materials.

        A renderer only updates its vertex buffers. Cameras frame the reference pose, which is the
        mesh of the first call, so that the image stays while the face moves. See
        :func:`facerender.tracked`. Baked occlusion does not change, with a FacerenderWarning.

        Parameters
        ----------
        positions : (N, 3), a row for each vertex of the file or arrays from which the mesh was
            made, or for each vertex of all parts in order. Or an array for each part, as a list, or
            as a mapping by part name; parts without an array (None) stay as they are. In the space
            of the file: rotation and registration are applied. At most 1e6 mesh radii from the
            centre
        normals : like positions, vectors of any length. None to compute them: area-weighted means
            of face normals, also across texture seams and parts, but not across creases
        """
        arrays = {"positions": positions, "normals": normals}
        columns = [_rows_of_parts(self, *pair) for pair in arrays.items()]
        with np.errstate(all="ignore"):  # moved() refuses positions that cause overflow
            if (rotation := self.geometry.rotation) is not None:
                shifts = [np.array(self.geometry.shift), np.zeros(3)]
                columns = [
                    [r if r is None else r @ rotation.T + shift for r in rows]
                    for rows, shift in zip(columns, shifts, strict=True)
                ]
        return moved(self, *columns)

    def _changed(self, indices: Iterable[int], changes: Mapping[str, Any]) -> Mesh:
        old = {i: self.materials[i] for i in indices}
        updates = {i: changed(material, changes) for i, material in old.items()}
        unused = {"second_slope": 1.0, "lobe_weight": 1.0, "lobe_map": None}
        asked = [key for key, value in unused.items() if changes.get(key, value) != value]
        if asked and not any(material.two_lobes for material in updates.values()):
            warn_of_one_lobe(self.name, asked[0])
        for fault in without_effect(changes, old.values(), updates.values()):
            warn(f"{fault}: give both for a part of {self.name}")
        materials = tuple(updates.get(i, material) for i, material in enumerate(self.materials))
        return replace(self, materials=materials)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the morph targets of a glTF file: ``shape1``, ``shape2``... if it has none."""
        return self.geometry.shapes

    @property
    def clips(self) -> dict[str, float]:
        """Lengths in seconds of the animations of a glTF file, keyed by name: ``clip1``,
        ``clip2``... if they have none. Damaged animations are left out."""
        return {clip.name: clip.duration for clip in clips_of(self.parts) if not clip.fault}

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints of a glTF file's skins, parents first: ``joint1``, ``joint2``... if
        they have none."""
        return next((tuple(dict(p.rig.skeleton.joints)) for p in self.parts if p.rig), ())

    def with_pose(
        self,
        weights: Mapping[str, float] | None = None,
        *,
        joints: Mapping[str, Sequence[float]] | None = None,
        clip: str | None = None,
        time: float | None = None,
    ) -> Mesh:
        """Return a copy of the mesh in another pose. Triangles, materials and camera framing do
        not change. Every pose starts from the pose in the file, also if this mesh has another one.
        Channels of KHR_animation_pointer are ignored with a FacerenderWarning; for baked occlusion
        see :meth:`with_positions`.

        Parameters
        ----------
        weights : weights in [-100, 100] of morph targets, keyed by a name of :attr:`shapes`. They
            override the weights of the clip and of the file, in all parts with this shape
        joints : angles x, y, z in degrees, in [-3600, 3600], keyed by a name of :attr:`joints`. The
            joint, with all that is below it, rotates about its position in the clip or file: about
            the mesh's axis x, then y, then z, whatever the local axes of the joint. The rotation of
            a joint carries along the axes of the joints below it; a clip does not
        clip : name of an animation, see :attr:`clips`; None: the first one if ``time`` is given,
            otherwise the pose in the file
        time : time in seconds, from 0 to the length of the clip; None: 0
        """
        return moved(replace(self, pose=None), *posed(self.geometry, weights, joints, clip, time))


def coordinates(part: Part, material: Material, name: str) -> Float | None:
    """Return a part's texture coordinates for the named map; None: the map is ignored."""
    return part.uv2 if material.by_second(name) else part.uv


def drawn_alpha(part: Part, material: Material) -> Alpha:
    """Return the alpha mode with which a part is drawn: "blend" if it is thin and
    clear, otherwise "opaque" if its opacity has no effect. Decodes the opacity map if necessary."""
    if material.thin:
        return "blend"
    if material.opacity_map is not None and coordinates(part, material, "opacity_map") is None:
        material = replace(material, opacity_map=None)
    return "opaque" if material.solid else material.alpha


def largest_opacity(part: Part, material: Material) -> float:
    """Return the largest opacity of a part. Decodes the opacity map if necessary."""
    texture = material.opacity_map
    if texture is None or coordinates(part, material, "opacity_map") is None:
        return material.opacity
    return material.opacity * float(texture.ends()[1, 0]) / 255.0


def slope_range(part: Part, material: Material) -> tuple[float, float]:
    """Return the smallest and largest m of a part over all lobes; a map without uv is ignored."""
    if coordinates(part, material, "roughness_map") is None:
        return material.with_second(material.m, material.m)
    return material.slopes


def warn_of_one_lobe(name: str, field: str) -> None:
    """Warn that a field of the second lobe has no effect on the mesh of this name."""
    cause = "a second lobe needs a second_slope other than 1 and a lobe_weight below 1"
    warn(f"{field} has no effect on {name}, because {cause}: give both, such as 0.333 and 0.85")


def names_of(option: str, names: Any) -> tuple[str, ...]:
    """Return part names from a text with commas or several texts. Raises InputError otherwise."""
    several = names.split(",") if isinstance(names, str) else names
    texts = [*several] if isinstance(several, Iterable) else [several]
    if not all(isinstance(text, str) for text in texts):
        raise InputError(f"{option} = {quoted(names)}: give names of parts")
    return tuple(name for text in texts if (name := text.strip()))


def _rows_of_parts(mesh: Mesh, name: str, values: Any) -> list[Float | None]:
    """Return the rows (N, 3) of each part; None for a part without rows. For the accepted values
    and the errors see :meth:`Mesh.with_positions`."""
    parts = mesh.parts
    if values is None:
        return [None] * len(parts)
    if isinstance(values, Mapping):
        by_index = {i: array for key, array in values.items() for i in mesh.called(str(key))}
        values = [by_index.get(i) for i in range(len(parts))]
    several = isinstance(values, list | tuple)
    if not several or not all(array is None or np.ndim(array) == 2 for array in values):
        return [*_split(name, values, parts, mesh.name)]
    if len(values) != len(parts):
        remedy = f"give {len(parts)}, one for each part of {mesh.name}"
        raise InputError(f"{name} has {len(values)} arrays: {remedy}")
    named = [(part, part.name or mesh.name) for part in parts]
    return [
        None if array is None else _split(f"{name} of {label}", array, [part], label)[0]
        for array, (part, label) in zip(values, named, strict=True)
    ]


def _split(name: str, array: Any, parts: Sequence[Part], owner: str) -> list[Float]:
    """Return the rows of an array, one for each vertex of all parts or of their file, by part."""
    rows = rows_of(name, array, (3,))
    counts = [len(part.positions) for part in parts]
    sources = {part.source_count for part in parts if part.sources is not None}
    if sources == {len(rows)}:
        return [rows[: len(p.positions)] if p.sources is None else rows[p.sources] for p in parts]
    if len(rows) != sum(counts):
        expected = " or ".join(map(str, dict.fromkeys((*sources, sum(counts)))))
        remedy = f"give {expected}, one for each vertex of {owner}"
        raise InputError(f"{name} has {len(rows)} rows: {remedy}")
    return np.split(rows, np.cumsum(counts)[:-1])


@np.errstate(all="ignore")  # MeshPose refuses positions that cause overflow
def moved(mesh: Mesh, positions: Sequence[Float | None], normals: Sequence[Float | None]) -> Mesh:
    """Return a mesh with moved vertices; see :meth:`Mesh.with_positions`.

    positions : finite positions (N, 3) of each part; None for a part that stays as it is
    normals : finite normals (N, 3) of each part; None to compute them. A vector of length 0 is
        replaced by the normal of the reference pose
    """
    geometry = mesh.geometry
    if any(part.occlusion is not None for part in geometry.parts):
        remedy = "bake it for each pose with facerender.with_occlusion, or leave it out"
        warn(f"the baked occlusion of {mesh.name} remains that of the reference pose: {remedy}")
    pairs = zip(mesh.parts, positions, strict=True)
    filled = [part.positions if rows is None else rows for part, rows in pairs]
    if any(rows is not None and n is None for rows, n in zip(positions, normals, strict=True)):
        sums = geometry.corners.normal_sums(filled)
    parts = [*mesh.parts]
    for i, (stored, normal) in enumerate(zip(geometry.parts, normals, strict=True)):
        if positions[i] is not None or normal is not None:
            mask = stored.drawn
            rows = filled[i] if mask is None else np.where(mask, filled[i], mesh.center)
            unit_normals = unit_or(sums[i] if normal is None else normal, stored.normals)
            parts[i] = replace(stored, positions=rows, normals=unit_normals)
    return replace(mesh, pose=MeshPose(geometry, tuple(parts), mesh.bounds))


def find_face(mesh: Mesh) -> Face | None:
    """Return the face on the surface of a mesh in the reference pose; None if none is found.

    The search needs no texture, no names and no orientation. See :mod:`facerender.mesh.face` for
    the method. A mesh finds its face once.
    """
    return mesh.geometry.framing.face


def tracked(mesh: Mesh) -> Mesh:
    """Return a posed mesh with a camera framing that follows the head.

    Orbiting cameras move by the median displacement of the head's vertices from the reference pose.
    If no head is found, all vertices count. A mesh in the reference pose is returned unchanged.
    """
    if mesh.pose is None:
        return mesh
    geometry = mesh.geometry
    head = geometry.framing.regions["head"]
    assert head is not None  # only "auto" may be None
    masks = [used(part.positions, part.faces) for part in geometry.parts]
    before, after = (
        np.concatenate([part.positions[mask] for part, mask in zip(parts, masks, strict=True)])
        for parts in (geometry.parts, mesh.parts)
    )
    across, up, along = np.abs(geometry.space.normalised(before) - head.center).T
    inside = (np.hypot(across, along) <= head.radius) & (up <= head.height)
    step = np.median((after - before)[inside if inside.any() else ...], axis=0)
    return replace(mesh, pose=MeshPose(geometry, mesh.parts, geometry.bounds + step))
