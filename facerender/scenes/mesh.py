"""Meshes: triangles with their materials. The package ``loading`` reads mesh files."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import (
    InputError,
    check_range,
    check_switch,
    check_type,
    each_of,
    shown,
    warn,
)
from facerender.scenes.arrays import piece_of
from facerender.scenes.material import Alpha, Material, check_maps
from facerender.scenes.normals import Corners, unit_or
from facerender.scenes.presets import changed, without_effect
from facerender.scenes.presets import preset as check_preset
from facerender.scenes.repair import Piece, are_closed, clean, unique, used
from facerender.scenes.vectors import MOST_RADII, check_array, rows_of
from facerender.terms.ranges import IntegerRange, Range, check_fields, ranged

if TYPE_CHECKING:
    from facerender.scenes.rig import Clip, Rig

Floats = NDArray[np.float64]

# The radius of the renderer's space grows by this factor if vertices leave it. With a small factor,
# the space would change in many frames, and all parts would be uploaded again.
_GROWTH = 2.0**0.25
TRIANGLES = IntegerRange(1, math.inf)  # accepted triangle limits of a simplified mesh
_OF_ROOT = ("faces", "uv", "colors", "occlusion", "uv2")  # arrays that all poses of a part share


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in mesh space.

    Attributes
    ----------
    positions : (N, 3) float64
    normals : (N, 3) float64, unit vectors
    faces : (F, 3) uint32, counter-clockwise seen from outside
    uv : (N, 2) float64 with v upwards, or None
    colors : (N, 3) linear RGB, or None
    occlusion : (N,) in [0, 1], fraction of uniform ambient light that reaches a vertex, or None;
        see :func:`facerender.with_occlusion`
    uv2 : (N, 2) float64, second texture coordinates for the maps that
        :attr:`Material.second_uv` names, or None
    head : (2, 3) float64, bounds of the vertices that follow a head joint of the file's skin, or
        None; camera framing uses them
    name : name from the file, or ""; see docs/formats.md
    skin : False for eyes, lashes, teeth and hair, by the names of the part and its material
    sources : (N,) index of each vertex in the vertices of the mesh's file or arrays, which texture
        seams do not split; None if each vertex of the part has its own
    source_count : number of these vertices of the file or arrays
    rest : the part in the reference pose, if this part is in another pose, else None
    rig : data of the poses of a glTF file; None for a part that cannot be posed
    preset : name of the preset that the part got by its name when it was loaded, or ""
    ks_ignored : whether the part's MTL file has Ks 0, which was loaded as ks 1
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float64] | None = None
    colors: NDArray[np.float64] | None = None
    occlusion: NDArray[np.float64] | None = None
    uv2: NDArray[np.float64] | None = None
    head: NDArray[np.float64] | None = None
    name: str = ""
    skin: bool = True
    sources: NDArray[np.integer] | None = None
    source_count: int = 0
    rest: Part | None = None
    rig: Rig | None = None
    preset: str = ""
    ks_ignored: bool = False

    def __post_init__(self) -> None:
        check_type("name of a part", self.name, str, "text")
        check_switch("skin of a part", self.skin)
        if not isinstance(self.preset, str) or self.preset:
            check_preset(self.preset)
        check_switch("ks_ignored of a part", self.ks_ignored)
        check_type("rest of a part", self.rest, Part | None, "a Part or None")
        if self.rig is not None:
            from facerender.scenes.rig import Rig  # most meshes have none: this saves 5 ms

            check_type("rig of a part", self.rig, Rig, "a facerender.scenes.rig.Rig or None")
        IntegerRange(0, math.inf).check("source_count of a part", self.source_count)
        for name, columns in (("positions", 3), ("normals", 3), ("faces", 3)):
            check_array(name, getattr(self, name), columns)
        for name, columns in (
            *(("uv", 2), ("colors", 3), ("occlusion", 0), ("uv2", 2), ("head", 3)),
            ("sources", 0),
        ):
            if (array := getattr(self, name)) is not None:
                check_array(name, array, columns)
        if self.uv is None and self.uv2 is not None:
            raise InputError("uv2 without uv: give the first texture coordinates as uv")

    def __repr__(self) -> str:
        has = [
            name for name in ("uv", "uv2", "colors", "occlusion") if vars(self)[name] is not None
        ]
        counts = f"{len(self.positions)} vertices, {len(self.faces)} triangles"
        return f"<Part {', '.join([repr(self.name), counts, *has])}>"

    @property
    def root(self) -> Part:
        """The part in the reference pose. All poses of a part have one root, under which caches
        store what does not depend on the pose."""
        rest_part = self.rest
        shared = rest_part is not None and all(
            getattr(self, n) is getattr(rest_part, n) for n in _OF_ROOT
        )
        return rest_part if shared and rest_part is not None else self


@dataclass(frozen=True, eq=False)
class Region:
    """An upright cylinder around the head or face of a mesh, in the renderer's space.

    Attributes
    ----------
    center : (3,) float64
    radius, height : half the width and half the height of the cylinder
    """

    center: NDArray[np.float64]
    radius: float
    height: float

    @property
    def profile(self) -> NDArray[np.float64]:
        """Outline of the cylinder: distance from its axis, and height, like ``Mesh.profile``."""
        return np.array([(self.radius, self.height), (self.radius, -self.height)])


class ShapeKey:
    """Weakly referenced key of cached values that depend on the shape of a mesh."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Parts with their materials, as read from a mesh file.

    Attributes
    ----------
    name : file name, for messages
    parts : at least one part
    materials : one material for each part
    bounds : (2, 3) float64, lowest and highest coordinates of the vertices that faces use
    radius : largest distance of a face's vertex from the centre of the bounds
    profile : (K, 2) float64, outline of the solid that the mesh sweeps when it rotates about the
        vertical axis through the centre of the bounds: distance from the axis and height, in the
        renderer's space
    millimetres : millimetres per unit of mesh space, needed for scattering; None if unknown
    regions : regions that a camera may frame, if they are known, as of a simplified mesh or a mesh
        from the cache; None to find them, see :func:`facerender.scenes.framing.find_regions`
    rest : the mesh in the reference pose, if this mesh is in another pose, else None. Bounds,
        profile and regions describe the reference pose, so that cameras stay; the radius may be
        larger. See :meth:`with_positions` and :func:`facerender.tracked`
    """

    name: str
    parts: tuple[Part, ...]
    materials: tuple[Material, ...]
    bounds: NDArray[np.float64]
    radius: float
    profile: NDArray[np.float64]
    millimetres: float | None = ranged(Range(1e-6, 1e6, "mm"), None)
    regions: Mapping[str, Region | None] | None = None
    rest: Mesh | None = None

    def __post_init__(self) -> None:
        check_type("name of a mesh", self.name, str, "text")
        check_type("rest of a mesh", self.rest, Mesh | None, "a Mesh or None")
        parts = each_of("parts", self.parts, Part, "several facerender.scenes.mesh.Part")
        materials = each_of("materials", self.materials, Material, "several facerender.Material")
        if not 0 < len(parts) == len(materials):
            raise InputError(
                f"{self.name} has {len(parts)} parts and {len(materials)} materials: give at least "
                "one part, and one material for each"
            )
        object.__setattr__(self, "parts", parts)
        object.__setattr__(self, "materials", materials)
        check_array("bounds", self.bounds, 3)
        check_array("profile", self.profile, 2)
        check_range("radius", self.radius, 0.0, sys.float_info.max)
        check_fields(self)
        if self.regions is not None:
            check_type("regions", self.regions, Mapping, "auto, head and face, or None")
            if set(self.regions) != {"auto", "head", "face"}:
                raise InputError(
                    f"regions = {shown(self.regions)}: give auto, head and face, or None"
                )
            for name, region in self.regions.items():
                kinds = Region | None if name == "auto" else Region
                check_type(f"regions {name}", region, kinds, "a facerender.scenes.mesh.Region")
        check_maps(self.name, self.materials)

    def __repr__(self) -> str:
        count = len(self.parts)
        triangles = sum(len(part.faces) for part in self.parts)
        parts = f"{count} part{'s' * (count > 1)}, {triangles} triangles"
        return f"<Mesh {self.name!r}, {parts}, radius {self.radius:.4g}>"

    @classmethod
    def of(
        cls,
        name: str,
        parts: Sequence[Part],
        materials: Sequence[Material],
        millimetres: float | None = None,
    ) -> Mesh:
        """Return a mesh of the given parts; compute its bounds, radius and profile, and set
        ``double_sided`` of the materials. The face indices must be valid."""
        drawn = np.concatenate([part.positions[used(part.positions, part.faces)] for part in parts])
        bounds = np.array([drawn.min(axis=0), drawn.max(axis=0)])
        offsets = drawn - bounds.mean(axis=0)
        radius = float(np.linalg.norm(offsets, axis=1).max())
        within = tuple(_within(part, bounds) for part in parts)
        profile = _profile(offsets / radius)
        sided = tuple(_sided(parts, materials))
        return cls(name, within, sided, bounds, radius, profile, millimetres)

    @classmethod
    def assembled(cls, pieces: Sequence[Piece], name: str, millimetres: float | None) -> Mesh:
        """Return a mesh of pieces that :func:`facerender.scenes.repair.clean` has repaired. A
        piece without a name is numbered, unless it is the only one: the third is ``part3``."""
        several = len(pieces) > 1
        names = (piece.name or f"part{i}" * several for i, piece in enumerate(pieces, 1))
        parts = [
            Part(
                piece.positions,
                np.asarray(piece.normals),
                np.ascontiguousarray(piece.faces, dtype=np.uint32),
                piece.uv,
                piece.colors,
                name=part_name,
                uv2=piece.uv2,
                head=piece.head,
                skin=piece.skin,
                sources=piece.sources,
                source_count=piece.source_count,
                rig=piece.rig,
                preset=piece.preset,
                ks_ignored=piece.ks_ignored,
            )
            for piece, part_name in zip(pieces, unique(names), strict=True)
        ]
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

        Raises
        ------
        InputError : invalid shape, values that are not finite numbers, a face index out of range,
            maps without texture coordinates
        """
        check_type("name of a mesh", name, str, "text")
        piece = piece_of(positions, faces, uv, uv_faces, normals, colors, material)
        piece.name = name
        with np.errstate(all="ignore"):  # clean() drops faces that cause overflow
            return cls.assembled(clean([piece], name), name, millimetres)

    def select(self, parts: str | Iterable[str] = (), hide: str | Iterable[str] = ()) -> Mesh:
        """Return a mesh of the named parts (default: all) without the hidden parts.

        Bounds and camera framing refer to the remaining parts.

        Parameters
        ----------
        parts, hide : part names, as several texts or one text with commas; ``*``, ``?`` and
            ``[...]`` are wildcards as in file names

        Raises
        ------
        InputError : no part matches a name, or no part remains
        """
        names, hidden = names_of("parts", parts), names_of("hide", hide)
        chosen = {i for name in names for i in self.called(name)} or {*range(len(self.parts))}
        remaining = sorted(chosen - {i for name in hidden for i in self.called(name)})
        if not remaining:
            raise InputError(f"every part of {self.name} is hidden: {self._known()}; hide fewer")
        if len(remaining) == len(self.parts):
            return self
        return Mesh.of(
            self.name,
            [replace(self.parts[i]) for i in remaining],  # copies: renderers cache parts per mesh
            [self.materials[i] for i in remaining],
            self.millimetres,
        )

    def called(self, name: str) -> list[int]:
        """Return the indices of the parts that match a name."""
        pairs = enumerate(part.name for part in self.parts)
        if not (
            matches := [
                i for i, part_name in pairs if part_name == name or fnmatchcase(part_name, name)
            ]
        ):
            raise InputError(f"no part of {self.name} is called {shown(name)}: {self._known()}")
        return matches

    def _known(self) -> str:
        if not any(part.name for part in self.parts):
            return f"its {len(self.parts)} parts have no names"
        return f"its parts are {', '.join(part.name for part in self.parts)}"

    @cached_property
    def shape_key(self) -> ShapeKey:
        """Key of the cached regions. Copies with other materials share it."""
        return ShapeKey()

    @property
    def skin(self) -> tuple[int, ...]:
        """Indices of the parts that are skin: their ``Part.skin`` is true, and their materials have
        no transmission. If no part is skin, the indices of all parts."""
        pairs = enumerate(zip(self.parts, self.materials, strict=True))
        indices = [i for i, (part, material) in pairs if part.skin and material.transmission == 0.0]
        return tuple(indices or range(len(self.parts)))

    @property
    def center(self) -> NDArray[np.float64]:
        """Centre of the bounds, (3,) float64."""
        return np.asarray(0.5 * (self.bounds[0] + self.bounds[1]))

    def normalised(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points (..., 3) from mesh space to the renderer's space: centre at 0, radius 1.
        Computes in float64: in float32, large offsets and small units would lose precision."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) / self.radius)

    def to_mesh_space(self, points: ArrayLike) -> NDArray[np.float64]:
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

        Raises
        ------
        InputError : no part matches a name, the preset is unknown, or a value is outside its range
        """
        names = names_of("parts", parts)
        chosen = {i for name in names for i in self.called(name)} or {*range(len(self.parts))}
        table = changes if preset is None else {"preset": preset, **changes}
        return self._changed(chosen, table)

    def with_skin(self, **changes: Any) -> Mesh:
        """Return a copy of the mesh in which ``changes`` replace fields of the skin's materials;
        see :attr:`skin` and :meth:`with_material`."""
        return self._changed(self.skin, changes)

    def with_positions(self, positions: Any, normals: Any = None) -> Mesh:
        """Return the mesh in another pose: moved vertices, with the same triangles, texture
        coordinates and materials.

        A renderer only updates its vertex buffers. Cameras frame the reference pose, which is the
        mesh of the first call, so that the image stays while the face moves. See
        :func:`facerender.tracked`.

        Parameters
        ----------
        positions : (N, 3), a row for each vertex of the file or arrays from which the mesh was
            made, or for each vertex of all parts in order. Or an array for each part, as a list, or
            as a mapping by part name; parts without an array (None) stay as they are
        normals : like positions, vectors of any length. None to compute them: area-weighted means
            of face normals, also across texture seams and parts. Creases of the reference pose
            remain creases

        Raises
        ------
        InputError : a shape is wrong, values are not finite numbers, no part has a name, or a
            vertex is more than 1e6 mesh radii from the centre

        Warns
        -----
        FacerenderWarning : the mesh has baked occlusion, which remains that of the reference pose
        """
        places = _rows_of_parts(self, "positions", positions)
        part_normals = _rows_of_parts(self, "normals", normals)
        with np.errstate(all="ignore"):  # in_space() refuses positions that cause overflow
            return moved(self, places, part_normals)

    def _changed(self, chosen: Iterable[int], changes: Mapping[str, Any]) -> Mesh:
        updates = {i: changed(self.materials[i], changes) for i in chosen}
        _warn_of_lobes(self.name, changes, updates.values())
        for fault in without_effect(
            changes, [self.materials[i] for i in updates], [*updates.values()]
        ):
            warn(f"{fault}: give both for a part of {self.name}")
        materials = tuple(updates.get(i, material) for i, material in enumerate(self.materials))
        copy = replace(self, materials=materials)
        vars(copy)["shape_key"] = self.shape_key  # sets the cached property
        return copy

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the morph targets of a glTF file: ``shape1``, ``shape2``... if it has none."""
        rigs = (part.rig for part in self.parts)
        return tuple(dict.fromkeys(shape.name for rig in rigs if rig for shape in rig.shapes))

    @property
    def clips(self) -> dict[str, float]:
        """Lengths in seconds of the animations of a glTF file, keyed by name: ``clip1``,
        ``clip2``... if they have none. Damaged animations are left out."""
        return {clip.name: clip.duration for clip in clips_of(self.parts) if not clip.fault}

    def with_pose(
        self,
        weights: Mapping[str, float] | None = None,
        *,
        clip: str | None = None,
        time: float | None = None,
    ) -> Mesh:
        """Return a copy of the mesh in another pose. Triangles, materials and camera framing do
        not change. Every pose starts from the pose in the file, also if this mesh has another one.

        Parameters
        ----------
        weights : weights in [-100, 100] of morph targets, keyed by a name of :attr:`shapes`. They
            override the weights of the clip and of the file, in all parts with this shape
        clip : name of an animation, see :attr:`clips`; None: the first one if ``time`` is given,
            otherwise the pose in the file
        time : time in seconds, from 0 to the length of the clip; None: 0

        Raises
        ------
        InputError : the mesh has no shapes and no clips, a name is unknown, a value is outside its
            range, a clip or shape is damaged, or a vertex moves too far

        Warns
        -----
        FacerenderWarning : the clip has channels of KHR_animation_pointer, which are ignored; or
            the mesh has baked occlusion, see :meth:`with_positions`
        """
        from facerender.scenes.rig_pose import posed  # only for poses, as above

        rest_mesh = reference_of(self)
        places, normals = posed(rest_mesh, lambda: _corners_of(rest_mesh), weights, clip, time)
        stored = (
            self
            if rest_mesh is self
            else replace(self, parts=rest_mesh.parts, bounds=rest_mesh.bounds)
        )
        return moved(stored, places, normals)


def clips_of(parts: Iterable[Part]) -> tuple[Clip, ...]:
    """Return the clips of a mesh's file, also the damaged ones."""
    return next((part.rig.skeleton.clips for part in parts if part.rig), ())


def coordinates(part: Part, material: Material, name: str) -> NDArray[np.float64] | None:
    """Return a part's texture coordinates for the named map. None means that the part has none;
    the map is then ignored."""
    return part.uv2 if material.by_second(name) else part.uv


def drawn_alpha(part: Part, material: Material) -> Alpha:
    """Return the alpha mode with which a part is drawn: "blend" if it is thin and
    clear, otherwise "opaque" if its opacity has no effect. Decodes the opacity map if necessary."""
    if material.thin:
        return "blend"
    if material.opacity_map is not None and coordinates(part, material, "opacity_map") is None:
        material = replace(material, opacity_map=None)
    return "opaque" if material.solid else material.alpha


def blends_only(material: Material) -> bool:
    """Return whether a material is blended and transmits no light."""
    return material.alpha == "blend" and not material.transmission


def largest_opacity(part: Part, material: Material) -> float:
    """Return the largest opacity of a part. Decodes the opacity map if necessary."""
    texture = material.opacity_map
    if texture is None or coordinates(part, material, "opacity_map") is None:
        return material.opacity
    return material.opacity * float(texture.ends()[1, 0]) / 255.0


def base_slope(part: Part, material: Material) -> float:
    """Return m of a part's first lobe, or the factor that maps squared roughness texels to m."""
    mapped = material.roughness_map and coordinates(part, material, "roughness_map") is not None
    return material.roughness_factor**2 if mapped else material.m


def slope_range(part: Part, material: Material) -> tuple[float, float]:
    """Return the smallest and largest m of a part over all lobes. A roughness map without texture
    coordinates is ignored."""
    if coordinates(part, material, "roughness_map") is None:
        return material.with_second(material.m, material.m)
    return material.slopes


def _warn_of_lobes(name: str, changes: Mapping[str, Any], materials: Iterable[Material]) -> None:
    """Warn if changes ask for a second lobe, but none of the changed materials has one."""
    unused = {"second_slope": 1.0, "lobe_weight": 1.0, "lobe_map": None}
    asked = [key for key, value in unused.items() if changes.get(key, value) != value]
    if asked and not any(material.two_lobes for material in materials):
        warn_of_one_lobe(name, asked[0])


def warn_of_one_lobe(name: str, field: str) -> None:
    """Warn that a field of the second lobe has no effect on the mesh of this name."""
    warn(
        f"{field} has no effect on {name}, because a second lobe needs a second_slope other than 1 "
        "and a lobe_weight below 1: give both, such as 0.333 and 0.85"
    )


def names_of(option: str, names: Any) -> tuple[str, ...]:
    """Return part names from one text with commas or from several texts.

    Raises
    ------
    InputError : a value that is not text
    """
    names = names.split(",") if isinstance(names, str) else names
    texts = each_of(option, names, str, "names of parts")
    return tuple(name for text in texts if (name := text.strip()))


def _sided(parts: Sequence[Part], materials: Sequence[Material]) -> Iterator[Material]:
    """Yield the materials with ``double_sided`` true or false. Parts that share a material share
    the result, unless only one of them is closed."""
    if all(material.double_sided is not None for material in materials):
        yield from materials
        return
    closed = are_closed([part.positions for part in parts], [part.faces for part in parts])
    variants: dict[tuple[int, bool], Material] = {}
    for material, is_closed in zip(materials, closed, strict=True):
        if material.double_sided is None:
            key = id(material), is_closed
            material = variants.setdefault(key, replace(material, double_sided=not is_closed))
        yield material


def _within(part: Part, bounds: NDArray[np.float64]) -> Part:
    """Return a part whose vertices outside the bounds are moved to the bounds' centre. No face uses
    these vertices, but they could overflow in float32."""
    inside = ((part.positions >= bounds[0]) & (part.positions <= bounds[1])).all(axis=1)
    if inside.all():
        return part
    positions = np.where(inside[:, None], part.positions, bounds.mean(axis=0))
    return replace(part, positions=positions)


def _profile(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a mesh's profile: distance from the axis and height of the outermost vertex in
    each of at most 511 horizontal slices."""
    widths, heights = np.hypot(positions[:, 0], positions[:, 2]), positions[:, 1]
    slices = np.round(heights * 255.0).astype(np.int64)
    order = np.lexsort((widths, slices))
    widest = order[np.diff(slices[order], append=slices.max() + 1) > 0]
    return np.stack([widths[widest], heights[widest]], axis=1)


def _rows_of_parts(mesh: Mesh, name: str, values: Any) -> list[Floats | None]:
    """Return the rows (N, 3) of each part; None for a part without rows. For the accepted values
    and the errors see :meth:`Mesh.with_positions`."""
    parts = mesh.parts
    if isinstance(values, Mapping):
        chosen: dict[int, Any] = {}
        for key, array in values.items():
            chosen |= dict.fromkeys(mesh.called(str(key)), array)
        values = [chosen.get(number) for number in range(len(parts))]
    if values is None:
        values = [None] * len(parts)
    each_part = isinstance(values, list | tuple) and all(
        array is None or np.ndim(array) == 2 for array in values
    )
    if each_part:
        if len(values) != len(parts):
            raise InputError(
                f"{name} has {len(values)} arrays: give {len(parts)}, one for each part of "
                f"{mesh.name}"
            )
        return [
            None if array is None else _of_part(f"{name} of {part.name or mesh.name}", array, part)
            for array, part in zip(values, parts, strict=True)
        ]
    rows: Floats = rows_of(name, values, (3,))
    counts = [len(part.positions) for part in parts]
    sources = {part.source_count for part in parts if part.sources is not None}
    if len(rows) in sources and len(sources) == 1:
        return [
            rows[:count] if part.sources is None else rows[part.sources]
            for part, count in zip(parts, counts, strict=True)
        ]
    if len(rows) != sum(counts):
        expected = " or ".join(map(str, dict.fromkeys((*sources, sum(counts)))))
        raise InputError(
            f"{name} has {len(rows)} rows: give {expected}, one for each vertex of {mesh.name}"
        )
    return list(np.split(rows, np.cumsum(counts)[:-1]))


def _of_part(name: str, array: Any, part: Part) -> NDArray[np.float64]:
    rows: Floats = rows_of(name, array, (3,))
    if part.sources is not None and len(rows) == part.source_count:
        return np.asarray(rows[part.sources])
    if len(rows) != len(part.positions):
        raise InputError(
            f"{name} has {len(rows)} rows: give {len(part.positions)}, one for each vertex"
        )
    return rows


def moved(
    mesh: Mesh,
    places: Sequence[NDArray[np.float64] | None],
    normals: Sequence[NDArray[np.float64] | None],
) -> Mesh:
    """Return a mesh with moved vertices; see :meth:`Mesh.with_positions`.

    Parameters
    ----------
    places : finite positions (N, 3) of each part; None for a part that stays as it is
    normals : finite normals (N, 3) of each part; None to compute them. A vector of length 0 is
        replaced by the normal of the reference pose
    """
    rest_mesh = reference_of(mesh)
    if any(part.occlusion is not None for part in rest_mesh.parts):
        warn(
            f"the baked occlusion of {rest_mesh.name} remains that of the reference pose: bake it "
            "for each pose with facerender.with_occlusion, or leave it out"
        )
    if any(place is not None and n is None for place, n in zip(places, normals, strict=True)):
        pairs = zip(mesh.parts, places, strict=True)
        sums = _corners_of(rest_mesh).normal_sums(
            [p.positions if place is None else place for p, place in pairs]
        )
    parts = []
    for number, (part, place, normal) in enumerate(zip(mesh.parts, places, normals, strict=True)):
        if place is not None or normal is not None:
            root = part.root
            positions = part.positions if place is None else place
            positions = (
                positions
                if (drawn := _drawn_of(root)) is None
                else np.where(drawn, positions, mesh.center)
            )
            turned = unit_or(sums[number] if normal is None else normal, root.normals)
            part = replace(root, positions=positions, normals=turned, rest=root)
        parts.append(part)
    return in_space(replace(mesh, parts=tuple(parts), regions=None, rest=rest_mesh))


def reference_of(mesh: Mesh) -> Mesh:
    """Return the mesh in the reference pose: the mesh itself unless it is a pose of another mesh
    with the same arrays."""
    rest_mesh = mesh.rest
    if rest_mesh is None or any(
        a.root is not b for a, b in zip(mesh.parts, rest_mesh.parts, strict=True)
    ):
        return mesh
    return rest_mesh


def in_space(mesh: Mesh) -> Mesh:
    """Return a posed mesh whose radius is at least the distance of all vertices from its centre.
    The profile, which is relative to the radius, shrinks accordingly."""
    rest_mesh = mesh.rest
    assert rest_mesh is not None
    away = (part.positions - mesh.center for part in mesh.parts)
    reach = (
        math.sqrt(max(np.einsum("ij,ij->i", offsets, offsets).max() for offsets in away))
        / rest_mesh.radius
    )
    if reach > MOST_RADII:
        raise InputError(
            f"a vertex of {mesh.name} is {reach:.3g} mesh radii from the mesh's centre: give "
            f"positions within {MOST_RADII:g}"
        )
    steps = max(math.ceil(math.log(reach * (1.0 - 1e-9), _GROWTH)), 0) if reach > 0.0 else 0
    growth = _GROWTH**steps
    return replace(mesh, radius=rest_mesh.radius * growth, profile=rest_mesh.profile / growth)


_drawn: WeakKeyDictionary[Part, NDArray[np.bool_] | None] = WeakKeyDictionary()


def _drawn_of(root: Part) -> NDArray[np.bool_] | None:
    """Return a mask (N, 1) of the vertices that faces use; None if faces use all vertices."""
    if root not in _drawn:
        mask = used(root.positions, root.faces)[:, None]
        _drawn[root] = None if mask.all() else mask
    return _drawn[root]


_corners: WeakKeyDictionary[Mesh, Corners] = WeakKeyDictionary()


def _corners_of(rest_mesh: Mesh) -> Corners:
    if rest_mesh not in _corners:
        columns = zip(
            *((part.positions, part.normals, part.faces) for part in rest_mesh.parts), strict=True
        )
        _corners[rest_mesh] = Corners.of(*columns)
    return _corners[rest_mesh]
