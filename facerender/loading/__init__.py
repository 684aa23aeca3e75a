"""Load meshes with their materials and maps. The package exists so that untrusted files become
checked and repaired meshes. Paths, bytes and trimesh objects flow in, meshes flow out. Rules: files
that the mesh file names are opened only through ``References``, and OpenGL is not used."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, noting, quoted, reason, warn
from facerender.loading import mesh_cache
from facerender.loading import source as sources
from facerender.loading.gltf_document import damaged
from facerender.loading.source import GLTF, References, Source, source_of
from facerender.mesh.hints import gloss_of
from facerender.mesh.mesh import TRIANGLES, Mesh, names_of
from facerender.mesh.part import Face
from facerender.mesh.repair import Piece, clean, in_space_order, placed
from facerender.system.files import read_file
from facerender.texture.texture import LARGE, Texture, with_green_turned
from facerender.values import vectors
from facerender.values.fields import PATH, SWITCH, Choice, Limits, field, record

Path_ = str | os.PathLike[str]
if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

    MeshSource: TypeAlias = Path_ | bytes | IO[bytes] | trimesh.Trimesh | trimesh.Scene
    Map = Path_ | Texture | NDArray[Any] | Image
else:
    MeshSource = Map = Any
# The result of the search, so that the first image of the built-in head need not wait for it.
_BUILT_IN_EYES = np.array([(-0.0308, 0.0007, 0.084), (0.0308, 0.0007, 0.084)])
_BUILT_IN_FACE = Face(_BUILT_IN_EYES, np.eye(3)[1], np.eye(3)[2], 0.0616, 1.06)
# The fields of MeshFile that are paths.
MESH_PATHS = ("path", "albedo", "normal_map", "specular_map", "roughness_map", "lobe_map")
# The fields of MeshFile on which a stored mesh depends. The rest applies to the loaded mesh.
_STORED = ("flip_v", "normal_map_y", "allow_outside", "as_is", "parts", "hide", "up", "rotate")
_MAPS = ("albedo_map", "normal_map", "specular_map", "roughness_map", "lobe_map")
_FILES = "the mesh file's"


class _Map(Limits):
    """An image file, or in Python also a texture, an array or a Pillow image."""

    def check(self, name: str, value: Any) -> Any:
        if isinstance(value, Texture):
            return value
        if isinstance(value, np.ndarray):
            return Texture.from_array(value, f"the array of {name}")
        if hasattr(value, "getbands"):  # a Pillow image: isinstance would import Pillow
            return Texture.from_image(value, f"the image of {name}")
        if not isinstance(value, str | os.PathLike):
            forms = "give a path, or in Python a texture, an array or a Pillow image"
            raise InputError(f"{name} = {quoted(value)}: {forms}")
        return PATH.check(name, value)


class _Names(Limits):
    """Names of parts, in a list or in one text with commas."""

    def check(self, name: str, value: Any) -> Any:
        return names_of(name, value) or None


@record("mesh ")
class MeshFile:
    """The file of a mesh, the maps that replace its maps, its selected parts, its orientation, and
    its number of triangles."""

    path: str | None = field(PATH, None, "mesh file; None for the built-in head")
    albedo: Any = field(_Map(), None, "albedo map, sRGB", unset=_FILES)
    normal_map: Any = field(
        _Map(), None, "normal map in tangent space, linear, green up", unset=_FILES
    )
    specular_map: Any = field(_Map(), None, "grey map, linear, which multiplies ks", unset=_FILES)
    roughness_map: Any = field(
        _Map(), None, "grey map, linear; a texel r gives m = r^2", unset=_FILES
    )
    flip_v: bool = field(
        SWITCH, False, "flip the v texture coordinate, if colours are in the wrong places"
    )
    triangles: int | None = field(
        TRIANGLES,
        None,
        "simplify the mesh to N triangles",
        "Requires pip install 'facerender[lod]'",
        "all",
    )
    lobe_map: Any = field(
        _Map(),
        None,
        "grey map, linear, which multiplies the fraction of the second lobe; white is wet skin",
        unset="none",
    )
    millimetres: float | None = field(
        vectors.MILLIMETRES,
        None,
        "length of a unit of the mesh",
        "Required for subsurface scattering",
        "1000 in glTF, else unknown",
    )
    occlusion: bool = field(
        SWITCH,
        False,
        "ray-trace ambient occlusion at the vertices of parts without an occlusion map",
        "Occlusion dims ambient light and the diffuse light of the environment map. Requires pip "
        "install 'facerender[rays]'",
    )
    allow_outside: bool = field(
        SWITCH,
        False,
        "open files that the mesh file refers to even if they are outside its directory",
    )
    parts: tuple[str, ...] | None = field(
        _Names(),
        None,
        "render only these parts of the mesh",
        "Names may contain the wildcards '*', '?' and [...]; facerender info lists the names",
        "all",
    )
    hide: tuple[str, ...] | None = field(
        _Names(), None, "do not render these parts, which are named as in parts", unset="none"
    )
    normal_map_y: str = field(
        Choice(("up", "down")),
        "up",
        "direction of green in normal maps, including maps of the mesh file",
        "down is the convention of DirectX",
    )
    as_is: bool = field(
        SWITCH,
        False,
        "draw every part with the material of the mesh file",
        "By default, a part with a known name and without maps or opacity gets a preset. Names "
        "define the skin in both cases",
    )
    double_sided: bool = field(
        SWITCH,
        False,
        "draw the back faces of all parts",
        "By default, glTF materials decide; in other formats, only open surfaces have two sides",
    )
    up: str | None = field(
        Choice(vectors.UP_NAMES),
        None,
        "axis of the mesh file that points up",
        "auto turns a face upright that is found on the surface",
        "y",
    )
    rotate: vectors.Vector | None = field(
        vectors.ROTATIONS,
        None,
        "rotate the upright mesh about x, then y, then z",
        "Poses, files of vertices and cameras of the mesh file follow",
        "0,0,0",
    )

    TEXTS = "a path"

    @classmethod
    def parse(cls, text: str) -> dict[str, Any]:
        """Return the fields for the text of a path."""
        return {"path": text}

    @cached_property
    def source(self) -> Source:
        """The mesh file, which is read once: ``load_mesh`` takes it over."""
        return source_of(self.path)

    def load(self, cache: bool | Literal["read"] = False) -> Mesh:
        """Return ``load_mesh(self, cache=cache)``."""
        return load_mesh(self, cache=cache)

    @property
    def files(self) -> list[str]:
        """The paths of mesh file and maps."""
        return [path for name in MESH_PATHS if isinstance(path := getattr(self, name), str)]


def load_mesh(
    source: MeshSource | MeshFile | None = None,
    *,
    albedo: Map | None = None,
    normal_map: Map | None = None,
    specular_map: Map | None = None,
    roughness_map: Map | None = None,
    lobe_map: Map | None = None,
    flip_v: bool = False,
    millimetres: float | None = None,
    cache: bool | Literal["read"] = False,
    allow_outside: bool = False,
    kind: str | None = None,
    normal_map_y: str = "up",
    as_is: bool = False,
    parts: Any = None,
    hide: Any = None,
    double_sided: bool = False,
    up: str | None = None,
    rotate: Any = None,
) -> Mesh:
    """Load a mesh from a file or a trimesh object, or load the built-in head.

    Missing textures, dropped faces, repaired normals and presets that parts get by their names are
    reported as FacerenderWarning. Parameters without a description are the fields of
    :class:`facerender.MeshFile`.

    Parameters
    ----------
    source : path of a .glb, .gltf, .obj (with .mtl), .ply or .stl file; its content as bytes, or
        an open binary file; a ``trimesh.Trimesh`` or ``trimesh.Scene``, which is copied; None for
        the built-in head; or a :class:`facerender.MeshFile`, without further parameters except
        ``cache``. For arrays, use :meth:`facerender.Mesh.from_arrays`
    cache : load the mesh with its decoded maps from ``~/.cache/facerender`` if no file has changed
        since the mesh was stored. Otherwise decode all maps, and store the mesh in the background;
        "read" does not store it. Trimesh objects, and meshes with maps that are not files, are not
        cached
    kind : "glb", "gltf", "obj", "ply" or "stl"; required if neither the file name nor the bytes
        identify the format

    Raises
    ------
    InputError : the file or a map is missing, empty, damaged or of an unknown format; the mesh has
        no faces; no part has a name of ``parts`` or ``hide``; a value is outside its range
    """
    options = MeshFile(
        albedo=albedo,
        normal_map=normal_map,
        specular_map=specular_map,
        roughness_map=roughness_map,
        lobe_map=lobe_map,
        flip_v=flip_v,
        millimetres=millimetres,
        allow_outside=allow_outside,
        normal_map_y=normal_map_y,
        as_is=as_is,
        parts=parts,
        hide=hide,
        double_sided=double_sided,
        up=up,
        rotate=rotate,
    )
    if isinstance(source, MeshFile):
        if options != MeshFile() or kind is not None:
            raise InputError("a MeshFile has its own options: change its fields instead")
        options = source
    trimesh = sys.modules.get("trimesh")
    if trimesh is not None and isinstance(source, trimesh.Trimesh | trimesh.Scene):
        from facerender.loading import from_trimesh

        name, unit = from_trimesh.name_of(source), from_trimesh.millimetres_of(source)
        read = lambda axes, _: from_trimesh.pieces_of(source, name, axes)  # noqa: E731
        mesh = _assembled(read, name, unit, _opened(_maps(options)), options)
    else:
        mesh_source = options.source if source is options else source_of(source, kind)
        options.__dict__.pop("source", None)  # the content of the file takes memory
        mesh = _loaded(mesh_source, options, cache)
        skin = [(mesh.parts[i], mesh.materials[i].albedo_map) for i in mesh.skin]
        colored = any(texture or part.colors is not None for part, texture in skin)
        if mesh_source.folder and not colored and any(part.uv is not None for part, _ in skin):
            sources.unused_maps(mesh_source.name, mesh_source.folder)
    if options.double_sided:
        mesh = mesh.with_material(double_sided=True)
    gloss, unit = tuple(map(gloss_of, mesh.materials)), options.millimetres or mesh.millimetres
    mesh = replace(mesh, geometry=replace(mesh.geometry, gloss=gloss, millimetres=unit))
    if options.occlusion:
        from facerender.mesh.occlusion import with_occlusion

        mesh = with_occlusion(mesh, cache=bool(cache))
    if options.triangles is None:
        return mesh
    from facerender.mesh.simplify import simplified

    return simplified(mesh, options.triangles)


def _maps(options: MeshFile) -> dict[str, Path | Texture]:
    """Return the image files and textures that replace maps, keyed by the field of Material."""
    maps = {name: getattr(options, name.replace("albedo_map", "albedo")) for name in _MAPS}
    return {
        name: source if isinstance(source, Texture) else Path(source)
        for name, source in maps.items()
        if source is not None
    }


def _loaded(source: Source, options: MeshFile, cache: bool | Literal["read"]) -> Mesh:
    """Return the mesh of a mesh file, from the cache if possible."""
    maps = _maps(options)
    if not cache or any(isinstance(file, Texture) for file in maps.values()):
        return _read(source, _opened(maps), options)[0]
    contents = {n: read_file(path, "an image file") for n, path in maps.items()}  # type: ignore[arg-type]
    values = [getattr(options, name) for name in _STORED]
    entry = mesh_cache.entry_name(source, {n: (maps[n].name, contents[n]) for n in maps}, values)
    if (stored_mesh := mesh_cache.find(entry, source, options.allow_outside)) is not None:
        return stored_mesh
    with noting() as warnings:
        mesh, references = _read(source, _opened(maps, contents), options)
    if cache != "read":
        mesh = replace(mesh, geometry=replace(mesh.geometry, known_framing=mesh.geometry.framing))
        mesh_cache.store(entry, mesh, references.files, "albedo_map" in maps, warnings)
    return mesh


def _opened(
    maps: Mapping[str, Path | Texture], contents: Mapping[str, bytes] | None = None
) -> dict[str, Texture]:
    """Return the textures of maps. Their files are not read again if their ``contents`` are given,
    except large images, whose contents would take memory."""
    textures = {}
    for name, source in maps.items():
        if not isinstance(source, Texture):
            path, content = source, contents and contents[name]
            source = Texture.of(content, clipped(path.name)) if content else Texture.open(path)
            if content and math.prod(source.size) > LARGE:
                source = Texture.open(path)
        textures[name] = source
    return textures


def _read(
    source: Source, textures: Mapping[str, Texture], options: MeshFile
) -> tuple[Mesh, References]:
    """Return the mesh of a mesh file, and the files to which the mesh file refers."""
    if not source.content:
        raise InputError(f"{source.name} is an empty file; give a mesh file")
    sources.check_format(source.content, source.suffix, source.name)
    references = References(source.name, source.folder, options.allow_outside)
    read = partial(_pieces, source, references, "albedo_map" in textures)
    millimetres = 1000.0 if source.suffix in GLTF else None
    mesh = _assembled(read, source.name, millimetres, textures, options)
    geometry = mesh.geometry
    is_whole = not (options.parts or options.hide)
    if source.path == sources.BUILT_IN and geometry.rotation is None and is_whole:
        from facerender.mesh.framing import framing_of

        framing = framing_of(geometry.parts, geometry.space, geometry.profile, _BUILT_IN_FACE)
        mesh = replace(mesh, geometry=replace(geometry, known_framing=framing))
    return mesh, references


def _upright(pieces: Sequence[Piece], name: str) -> NDArray[np.float64]:
    """Return the rotation (3, 3) that turns the face on pieces upright; without a face, warn."""
    from facerender.mesh.face import Surface, find_faces

    # Pieces are not cleaned yet: they may have invalid indices and positions.
    corners = np.concatenate([np.take(p.positions, p.faces, axis=0, mode="clip") for p in pieces])
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    if len(corners) and (faces := find_faces(Surface(corners - corners.mean(axis=(0, 1))))):
        return vectors.upright_of(faces[0].axes)[2]
    warn(f"no face was found on {name}: it stays as it is; give its axis, as in --up z")
    return np.eye(3)


def _pieces(
    source: Source,
    references: References,
    albedo_given: bool,
    axes: NDArray[np.float64] | None,
    stored: Sequence[Piece] | None,
) -> Sequence[Piece]:
    """Return a piece for every geometry with faces. The readers are imported here: a mesh from the
    cache does not need them. If ``albedo_given``, the caller replaces albedo maps, which may then
    be missing or unreadable. ``stored`` is the result without axes, if it is known."""
    read: Callable[[bytes, References, bool], Sequence[Piece]]
    suffix = source.suffix
    if stored and (axes is None or suffix not in GLTF):
        return stored if axes is None else [placed(piece, axes) for piece in stored]
    if suffix in GLTF:
        from facerender.loading.gltf import read_gltf

        read = partial(read_gltf, axes=axes)  # its joints define the height of a head
    elif suffix == ".obj":
        from facerender.loading.obj import read_obj as read
    elif suffix == ".ply":
        from facerender.loading.from_trimesh import read_ply as read
    else:
        from facerender.loading.from_trimesh import read_stl as read
    try:
        pieces = read(source.content, references, albedo_given)
        for file, content in references.files.items():
            if content is None and not albedo_given and suffix not in GLTF:
                sources.missing_image(references, file)
    except InputError:
        raise
    except (ValueError, LookupError, ArithmeticError) as error:
        raise damaged(references.name, reason(error)) from None
    except Exception as error:  # not a fault of the file, such as a missing package
        error.add_note(f"while reading {references.name}")
        raise
    if not pieces:
        raise sources.no_faces(references.name, points=False)
    if axes is None or suffix in GLTF:
        return pieces
    return [placed(piece, axes) for piece in pieces]


@np.errstate(all="ignore")  # clean() drops faces whose vertices overflow
def _assembled(
    read: Callable[[NDArray[np.float64] | None, Sequence[Piece] | None], Sequence[Piece]],
    name: str,
    millimetres: float | None,
    textures: Mapping[str, Texture],
    options: MeshFile,
) -> Mesh:
    """Return the mesh of the pieces that ``read`` returns for their axes; see :func:`axes_of`. With
    ``up="auto"``, it is called twice, because poses of a glTF file follow the axes."""
    from facerender.loading.conventions import apply_names

    stored = read(None, None) if options.up == "auto" else None
    upright = None if stored is None else _upright(stored, name)
    axes = vectors.axes_of(options.up or "y", options.rotate or (0.0, 0.0, 0.0), upright)
    pieces = clean(read(axes, stored), name)
    apply_names(pieces, name, options.as_is)
    for piece in pieces:
        piece.faces = in_space_order(piece.faces, piece.positions)
        for key in ("uv", "uv2"):
            if options.flip_v and (uv := getattr(piece, key)) is not None:
                setattr(piece, key, uv * (1.0, -1.0) + (0.0, 1.0))
    mesh = Mesh.assembled(pieces, name, millimetres)
    mesh = mesh.select(options.parts or (), options.hide or ())
    if axes is not None:
        mesh = replace(mesh, geometry=replace(mesh.geometry, rotation=axes[:3, :3]))
    return _mapped(mesh, textures, options.normal_map_y)


def _mapped(mesh: Mesh, maps: Mapping[str, Texture], normal_map_y: str) -> Mesh:
    """Return a mesh with new maps on the parts of the skin that have texture coordinates, and with
    green up in all normal maps. A new map takes the wrapping and filtering of the replaced map or,
    if there was no such map, of the albedo map."""
    parts, materials = [*mesh.parts], [*mesh.materials]
    if maps and all(parts[i].uv is None for i in mesh.skin):
        first, remedy = next(iter(maps.values())), "unwrap the mesh, or render it without maps"
        problem = f"{mesh.name} has no texture coordinates, which {first.name} needs"
        raise InputError(f"{problem}; {remedy}")
    for i in mesh.skin if maps else ():
        if parts[i].uv is None:
            warn(f"a part of {mesh.name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = {}
        for name, texture in maps.items():
            template = getattr(materials[i], name) or materials[i].albedo_map or texture
            matches = template.sampling == texture.sampling
            changes[name] = texture if matches else texture.sampled(*template.sampling)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            parts[i] = replace(parts[i], colors=None)
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        materials[i] = replace(materials[i], **changes)
    if normal_map_y == "down":
        turned: dict[Texture | None, Texture | None] = {None: None}
        turned |= {old: old.changed(with_green_turned) for m in materials if (old := m.normal_map)}
        materials = [replace(m, normal_map=turned[m.normal_map]) for m in materials]
    return Mesh(replace(mesh.geometry, parts=tuple(parts)), tuple(materials))
