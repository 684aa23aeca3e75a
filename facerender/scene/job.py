"""Jobs: a scene and its outputs as plain data, which is also what a scene file contains.

A :class:`Job` is built from a TOML file, from the tables of a batch, or from the options of the
command line: all of them are tables, merged by :func:`facerender.values.fields.merged` and built
once by the job's constructor. The renderer draws :meth:`Job.scene`. This module does not use
OpenGL."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from facerender.errors import InputError, clipped, number_of, quoted, warn
from facerender.images.files import MAX_SIDE, format_of
from facerender.images.image import TONES, ImageData, Tone
from facerender.loading import MESH_PATHS, MeshFile, load_mesh
from facerender.material import MAPS, Factors, Material, PartFactors
from facerender.mesh.mesh import Mesh, warn_of_one_lobe
from facerender.scene.background import check_environment
from facerender.scene.camera import STANDARD_VIEWS, Camera
from facerender.scene.detail import LevelOfDetail, Planned
from facerender.scene.environment import EnvironmentFile
from facerender.scene.light import Light
from facerender.scene.pose import Pose, posed
from facerender.scene.scene import ONLY, Only, Scene, set_default_light
from facerender.scene.shading import Shading
from facerender.system.files import read_file, tables_of
from facerender.values.fields import (
    EXPOSURES,
    FRACTION,
    PATH,
    SWITCH,
    Built,
    Choice,
    IntegerRange,
    Range,
    Several,
    SizeRange,
    build,
    field,
    field_of,
    plain,
    record,
    toml_text,
)
from facerender.values.vectors import Vector

MAX_SAMPLES = 64
MAX_TEXT_BYTES = 1 << 24  # largest size of a scene file, in bytes


@record("image ")
class ImageSettings:
    """Settings of the renderer, which checks whether the driver supports them."""

    size: tuple[int, int] = field(
        SizeRange(1, MAX_SIDE, "pixels"), (1024, 1024), "width and height, or N for both"
    )
    samples: int = field(
        IntegerRange(1, MAX_SAMPLES),
        4,
        "samples per pixel",
        "Above the driver's maximum, shifted images with as many samples each are averaged",
    )
    anisotropy: float = field(Range(1.0, 16.0), 1.0, "maximum anisotropy of texture filtering")
    float_albedo: bool = field(
        SWITCH,
        False,
        "store albedo maps as linear float16, so that drivers differ only in the last digits",
    )
    full_maps: bool = field(
        SWITCH,
        False,
        "decode all mip levels of maps of more than 4096 x 4096 texels, as float albedo does",
    )
    alpha_threshold: float = field(
        FRACTION, 0.5, "smallest opacity at which a blended part counts as a surface in data"
    )


@record("output ")
class Output:
    """An image file to write."""

    path: str = field(PATH, text="path with the suffix .png, .tif, .exr, .jpg or .webp")
    only: Only | None = field(
        Choice(ONLY, "term"),
        None,
        "term or data to render",
        "parts gives each part a colour, or in an .exr file the number of the part",
        "the whole image",
    )
    exposure: float = field(EXPOSURES, 0.0, "exposure of all formats except .exr")
    tone: Tone = field(
        Choice(TONES, "tone"),
        "linear",
        "tone mapping of all formats except .exr",
        "linear clips radiance at 1; neutral, the Khronos PBR Neutral tone mapper, compresses it",
    )
    bits: int = field(Choice((8, 16)), 8, "bits per channel", "16 is for .png only")
    dpi: float | None = field(
        Range(1.0, 10_000.0, "pixels per inch"),
        None,
        "print resolution that all formats except .exr and animations store",
        unset="the true scale of an orthographic image with a known unit, otherwise none",
    )
    scale_bar: bool = field(
        SWITCH,
        False,
        "draw a scale bar in mm in all formats except .exr",
        "Requires an orthographic camera and a known unit",
    )

    def __post_init__(self) -> None:
        written = format_of(self.path)
        if self.bits == 16 and written != "png":
            raise InputError(f"bits = 16 is for .png only, and the image is {written}: give .png")
        if written == "exr" and (self.dpi is not None or self.scale_bar):
            name = "scale_bar" if self.scale_bar else f"dpi = {self.dpi:g}"
            raise InputError(f"{name} is not for .exr: give .png, .tif, .jpg or .webp")


@record()
class Job:
    """A render job: scene, shading, settings of the renderer, and the images to write. Each record
    may be a table of its fields or, if it has a text form, a text."""

    mesh: MeshFile = field(Built(MeshFile), MeshFile(), "files of the mesh")
    material: Mapping[str, Any] = field(
        Factors(),
        text="factors of :class:`facerender.Material` that replace the factors of the skin, see "
        ":attr:`facerender.Mesh.skin`",
        default_factory=dict,
    )
    camera: Camera = field_of(Scene, "camera")
    lights: tuple[Light, ...] = field_of(Scene, "lights")
    ambient: float | Vector = field_of(Scene, "ambient")
    background: Vector | ImageData | str | None = field_of(Scene, "background")
    shading: Shading = field(
        Built(Shading), Shading(), "specular term of the lights, and the features that are left out"
    )
    planned: Planned | None = field(
        Built(Planned),
        None,
        "images for which the shading was planned, with their level of detail",
    )
    image: ImageSettings = field(Built(ImageSettings), ImageSettings(), "settings of the renderer")
    outputs: tuple[Output, ...] = field(Several(Output), (), "image files")
    environment: EnvironmentFile | None = field(
        Built(EnvironmentFile),
        None,
        "file of the environment map, as in :func:`facerender.load_environment`",
    )
    parts: Mapping[str, Mapping[str, Any]] = field(
        PartFactors(),
        text="factors of some parts, applied after ``material`` in the order of the table: for "
        "each name of parts, with wildcards, a table of factors and ``preset``; see "
        ":meth:`facerender.Mesh.with_material`",
        default_factory=dict,
    )
    pose: Pose = field(Built(Pose), Pose(), "pose of the mesh")
    before: Pose = field(
        Built(Pose),
        Pose(),
        "pose of the mesh in the frame before, from which motion vectors start",
    )
    landmarks: str | None = field(
        PATH, None, "path of a landmark file; see :func:`facerender.load_landmarks`"
    )
    cameras: tuple[Camera, ...] = field(
        Several(Camera, {"standard": tuple(STANDARD_VIEWS.values())}),
        (),
        "camera path of ``facerender plan``, or the views of a scene file",
    )
    anonymous: str | None = field_of(Scene, "anonymous")

    def __post_init__(self) -> None:
        set_default_light(self)
        check_environment(self)

    @property
    def stem(self) -> str:
        """The name of an output that has no other name, without suffix."""
        return self.anonymous or Path(self.mesh.path or "head").stem

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Job:
        """Read a job from a scene file in TOML, as :meth:`toml` writes it.

        Raises
        ------
        InputError : the file cannot be read, or has an unknown key or a value outside its range
        """
        return cls(**load_scene(path))

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any]) -> Job:
        """Return the job that data from :meth:`as_dict` describe; missing keys get their defaults.
        Raises InputError if a key is unknown, or a value is outside its domain."""
        return build(cls, tables, "")

    def as_dict(self) -> dict[str, Any]:
        """Return the job as plain data for JSON or TOML; see :meth:`from_dict`. Raises InputError
        if a map of the mesh is in memory."""
        files = {f"mesh {name}": getattr(self.mesh, name) for name in MESH_PATHS}
        for name, value in {**files, "background": self.background}.items():
            if not isinstance(value, str | tuple | None):
                remedy = "give a path: files cannot contain an image in memory"
                raise InputError(f"{name} = {quoted(value)}: {remedy}")
        table = plain(self) | {"background": self.background or "none"}
        # Defaults of a shading stay away: a plan pins only the values that it decided.
        table["shading"] = self.shading.as_dict()
        unset = [name for name in ("pose", "before") if getattr(self, name) == Pose()]
        return {key: value for key, value in table.items() if key not in unset}

    def toml(self) -> str:
        """Return the job as the text of a scene file in TOML."""
        return toml_text(self.as_dict())

    def scene(self, mesh: Mesh | None = None, moves: bool = False) -> Scene:
        """Return the scene.

        Parameters
        ----------
        mesh : result of ``load_mesh(job.mesh)``, which several jobs may share; None to load it
        moves : whether the scene has the frame before (:attr:`Scene.before`), for motion vectors

        Raises
        ------
        InputError : a file cannot be used; warnings as in :func:`facerender.load_mesh`
        """
        loaded = load_mesh(self.mesh) if mesh is None else mesh
        previous_scene = Scene(posed(loaded, self.before), self.camera) if moves else None
        loaded = posed(loaded, self.pose)
        # The skin first: tables of parts may then change single parts of it.
        if self.material:
            loaded = loaded.with_skin(**self.material)
        for name, table in self.parts.items():
            loaded = loaded.with_material((name,), **table)
        if self.mesh.lobe_map and not any(material.two_lobes for material in loaded.materials):
            warn_of_one_lobe(loaded.name, "lobe_map")
        light = self.lights, self.ambient, self.background, self.environment
        return Scene(loaded, self.camera, *light, previous_scene, self.anonymous)

    def detail(self, samples: int, name: str = "the scene") -> LevelOfDetail:
        """Return the level of detail of an image with the renderer's samples per pixel. The planned
        level is used only for the planned size and samples. Otherwise, a FacerenderWarning, which
        contains the name of the scene, is emitted, and all triangles are drawn."""
        if self.planned and self.planned.covers(self.image.size, samples):
            return self.planned.detail
        if self.planned:
            width, height = self.image.size
            warn(
                f"{name} was planned for {self.planned}: at {width} x {height} with "
                f"{number_of(self.image.samples, 'sample')} its error is unknown; plan for this "
                "size and samples"
            )
        return LevelOfDetail(self.image.samples, None)


def load_scene(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the values of a scene file in TOML.

    Returns
    -------
    dict with the keys that the file contains: arguments of :class:`facerender.Job`, converted to
    their types, but shading and image as tables, so that options can change single values

    Raises
    ------
    InputError : the file cannot be read, or has an unknown key or a value outside its range
    """
    name = clipped(Path(PATH.check("scene file", path)).name)
    tables = tables_of(read_file(path, "a scene file", MAX_TEXT_BYTES), name)
    try:
        if tables.get("cameras") == []:
            raise InputError("cameras = []: give a list of names or tables")
        job = Job.from_dict(tables)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    # The caller may change single values of these before the records are built.
    as_tables = ("shading", "image")
    return {key: tables[key] if key in as_tables else getattr(job, key) for key in tables}


def scene_toml(scene: Scene, shading: Shading, planned: Planned | None = None) -> str:
    """Return a scene, without its mesh and maps, as TOML text that :func:`load_scene` parses.

    The table ``material`` contains the factors that are equal for all parts of the skin, the table
    ``parts`` the other factors of each part. The table ``planned`` contains the fields of
    :class:`Planned`.
    """
    source = scene.environment
    materials = [scene.mesh.materials[i] for i in scene.mesh.skin]
    values = ((name, {getattr(m, name) for m in materials}) for name in _factor_names(*materials))
    shared = {name: several.pop() for name, several in values if len(several) == 1}
    tables = {
        "ambient": scene.ambient,
        "background": getattr(scene.background, "name", scene.background) or "none",
        "camera": plain(scene.camera, changed=True),
        "lights": [plain(light, changed=True) for light in scene.lights],
        "environment": source
        and {"file": source.panorama.name, "rotation": source.rotation, "scale": source.scale},
        "material": shared,
        "parts": _differing_factors(scene.mesh, shared) or None,
        "shading": shading.as_dict(),
        "planned": planned and plain(planned),
    }
    return toml_text(tables)


def _factor_names(*materials: Material) -> list[str]:
    """Return the names of the factors that have an effect on some of the materials."""
    mapped = any(material.roughness_map is not None for material in materials)
    unused = (*MAPS, "m" if mapped else "roughness_factor")
    return [member.name for member in fields(Material) if member.name not in unused]


def _differing_factors(mesh: Mesh, shared: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each named part, its factors, without the ``shared`` factors of the skin."""
    tables: dict[str, dict[str, Any]] = {}
    for number, (part, material) in enumerate(zip(mesh.parts, mesh.materials, strict=True)):
        omitted = shared if number in mesh.skin else ()
        names = [name for name in _factor_names(material) if name not in omitted]
        if names and part.name:
            values = {name: getattr(material, name) for name in names}
            tables[part.name] = {n: "none" if v is None else v for n, v in values.items()}
    return tables
