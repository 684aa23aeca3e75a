"""The scene options of ``render`` and ``plan``, and the job that these options describe."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from facerender.commands.common import Options, mesh_files, number_parser, part_materials
from facerender.drawing.prepare import resolved_parts, start_maps
from facerender.errors import InputError, clipped, shown, warn
from facerender.loading.source import GLTF, NORMAL_MAP_Y, source_of
from facerender.material import Material
from facerender.mesh.hints import no_shadows
from facerender.mesh.mesh import Mesh
from facerender.scene.camera import (
    CAMERA_FILES,
    FRAMES,
    MOST_CAMERAS,
    ORBITS,
    TURNS,
    Camera,
    named,
    orbit_of,
    orbiting,
    turntable,
)
from facerender.scene.environment import STUDIO, EnvironmentFile, parse_environment
from facerender.scene.file import ImageSettings, Pose, load_scene, parse_entry, parse_vertices
from facerender.scene.job import Job, MeshFile
from facerender.scene.light import LIGHTS, Light, parse_light
from facerender.scene.scene import Scene, background_of, default_light
from facerender.scene.shading import DIFFUSE, SCATTER_SAMPLES, Shading, Term
from facerender.terms import FRESNEL, MASKING, MODELS
from facerender.texture.mips import Kind
from facerender.values.ranges import range_of
from facerender.values.vectors import ROTATIONS, SHAPE_WEIGHTS, axes_of

_FACTORS = ["m", "f0", "ks", "kd", "second_slope", "lobe_weight", "scattering", "normal_strength"]
_OR_FILE = "{:g} or the mesh file's"  # default in the help, for factors that a mesh file may set
WHERE = (
    f"{ORBITS}, where AZIMUTH may be a name; turntable[:N], for N views around the mesh (8); "
    "gltf[:NAME], for cameras of the mesh file; or a camera file: .toml with [[cameras]], .json or "
    ".npz with K and [R|t]"
)


def add_scene(
    command: argparse.ArgumentParser, shading: str = "shading"
) -> tuple[Options, Options]:
    """Add MESH and the options of a scene; return the groups "reflectance" and "scene".

    shading : name of the shading that a scene file sets
    """
    Options(command).add_mesh()
    terms = Options(command, "reflectance")
    maps = Options(command, "maps, which replace the maps of the skin")
    scene = Options(command, "scene")
    _add_reflectance(terms)
    _add_maps(maps)
    scene.add_parts()
    unit, default = "length of a unit of the mesh", "1000 in glTF, else unknown"
    scene.add_field(MeshFile, "millimetres MM", unit, default, "Required for subsurface scattering")
    orbit = (f"{name} {range_of(Camera, name)}" for name in ("azimuth", "elevation", "zoom"))
    text, note = "camera; repeat for several views", f"Give {WHERE}. Ranges: {', '.join(orbit)}"
    scene.add_option("--camera CAMERA", text, "front", note, action="append")
    note = (
        "auto is the head if a face is found on a clearly larger mesh, otherwise all. Without a "
        "face on the surface, names of parts and joints, or else the outline, define the head"
    )
    text = "region of the mesh that an orbiting camera frames"
    scene.add_option("--frame", text, Camera.frame, note, choices=FRAMES)
    scene.add_field(Camera, "fov DEGREES", "vertical angle of view")
    _add_pose(scene)
    _add_lighting(scene)
    text = "linear background colour R,G,B, or none for transparent"
    default, note = _numbers(Scene.background), ".jpg, .gif and .mp4 cannot be transparent"
    scene.add_option("--background R,G,B", text, default, note, range_of(Scene, "background"))
    text = f"scene file with camera, lights, material and {shading}"
    scene.add_option("--scene FILE.toml", text, "none")
    return terms, scene


def _add_pose(scene: Options) -> None:
    text, default = "weight of a shape; repeat for others", "the mesh file's"
    note, values = "facerender info lists the names", SHAPE_WEIGHTS
    scene.add_option("--weight NAME=WEIGHT", text, default, note, values, action="append")
    text = "angles of a joint about x, y and z; repeat for others"
    scene.add_option("--joint NAME=X,Y,Z", text, default, note, ROTATIONS, action="append")
    scene.add_option("--clip NAME", "animation of the mesh file", "none; the first with --time")
    scene.add_field(Pose, "time SECONDS", "time in the clip", "the whole clip")
    text = "vertex positions, all frames or one"
    note = (
        "The file is .npy of shape (frames, vertices, 3), or .npz with such an array for each part"
    )
    scene.add_option("--vertices FILE[,FRAME]", text, "the mesh file's", note)
    note = "By default, cameras frame the stored pose and stay"
    scene.add_flag("track", "orbiting cameras follow the head of a moving mesh", note)


def _numbers(vector: Any) -> str:
    return ",".join(f"{component:g}" for component in vector)


def _add_reflectance(terms: Options) -> None:
    printed = "ward-printed is Ward as published by Romanyuk et al. (2020)"
    text = "specular model"
    terms.add_option("--model", text, Term.model, printed, choices=tuple(MODELS))
    for name, registry, text in (("fresnel", FRESNEL, "Fresnel"), ("masking", MASKING, "masking")):
        text += " term of Cook-Torrance"
        terms.add_option(f"--{name}", text, getattr(Term, name), choices=tuple(registry))
    slope = "RMS slope of the microfacets"
    note = (
        "Replaces the roughness map. Like other factors and maps, it applies only to skin: to no "
        "part that transmits light or has a name of eyes, lashes, teeth or hair. If no part is "
        "skin, it applies to all. facerender info lists the skin; --part changes any part"
    )
    terms.add_field(Material, "m M", slope, _OR_FILE, note)
    terms.add_field(Material, "f0", "Fresnel reflectance at normal incidence", _OR_FILE)
    terms.add_field(Material, "ks", "specular weight", _OR_FILE)
    note = "coupled reduces the diffuse light by the light that the specular term reflects"
    terms.add_option("--diffuse", "diffuse term", Shading.diffuse, note, choices=DIFFUSE)
    terms.add_field(Material, "kd", "diffuse weight")
    text = "specular antialiasing: widen the lobe by normal-map slopes smaller than a pixel"
    terms.add_switch("slope-filter", text, "on")
    second = "m of a second lobe, as a factor of m"
    terms.add_field(Material, "second_slope F", second, "{:g}: one lobe")
    terms.add_field(Material, "lobe_weight W", "fraction of the first lobe", "{:g}: one lobe")
    text, note = "subsurface scattering", "Requires the length of a mesh unit: see --millimetres"
    terms.add_option("--scattering", text, "none", note, choices=("skin", "none"))
    text, note = "subsurface samples per pixel", "0 disables subsurface scattering"
    *counts, last = map(str, SCATTER_SAMPLES)
    default, values = f"{Shading.scatter_samples}", f"{', '.join(counts)} or {last}"
    parser = number_parser(True, values)
    terms.add_option("--scatter-samples N", text, default, note, values, type=parser)


def _add_maps(maps: Options) -> None:
    for name, text in (
        ("albedo", "albedo map, sRGB"),
        ("normal-map", "normal map in tangent space, linear, green up"),
        ("specular-map", "grey map, linear, which multiplies ks"),
        ("roughness-map", "grey map, linear; a texel r gives m = r^2"),
    ):
        maps.add_option(f"--{name} FILE", text, "the mesh file's")
    text = "grey map, linear, which multiplies the fraction of the second lobe; white is wet skin"
    maps.add_option("--lobe-map FILE", text, "none")
    maps.add_flag("flip-v", "flip the v texture coordinate, if colours are in the wrong places")
    text = "direction of green in normal maps, including maps of the mesh file"
    default, note = MeshFile.normal_map_y, "down is the convention of DirectX"
    maps.add_option("--normal-map-y", text, default, note, choices=NORMAL_MAP_Y)
    maps.add_field(Material, "normal_strength X", "factor on the slopes of normal maps", _OR_FILE)
    maps.add_allow_outside()
    maps.add_field(ImageSettings, "anisotropy N", "maximum anisotropy of texture filtering")
    text = "store albedo maps as linear float16, so that drivers differ only in the last digits"
    maps.add_flag("float-albedo", text)
    text = "decode all mip levels of maps of more than 4096 x 4096 texels, as --float-albedo does"
    maps.add_flag("full-maps", text)


def _add_lighting(scene: Options) -> None:
    radius = range_of(Light, "radius")
    text, default = "light; repeat for several lights", "key, rim, fill; none with --environment"
    note = (
        f"Give {', '.join(LIGHTS)}, AZIMUTH,ELEVATION[,IRRADIANCE] in degrees, or "
        "point:X,Y,Z[,IRRADIANCE] in mesh units. IRRADIANCE is E or R,G,B, "
        f"{range_of(Light, 'irradiance')}. Append ,radius=DEGREES, {radius}, for the angular "
        "radius of an area light, and ,no-shadow for a light without shadows"
    )
    scene.add_option("--light LIGHT", text, default, note, action="append")
    scene.add_switch("shadows", "shadows of all lights", "as each light specifies")
    rotation, scale = (range_of(EnvironmentFile, name) for name in ("rotation", "scale"))
    text = f"environment map: .hdr, .exr, .npy, .npz or {STUDIO}"
    note = (
        f"ROTATION is {rotation}; SCALE, a factor on the radiance, is {scale}. An environment "
        "map replaces the default lights and the default ambient light. Requires pip install "
        "'facerender[hdr]' for .hdr, 'facerender[exr]' for .exr"
    )
    scene.add_option("--environment FILE[,ROTATION[,SCALE]]", text, "none", note)
    directions = "directions of the environment map that each lobe reflects, an even number"
    note = "0 disables the specular reflection of the environment"
    scene.add_field(Shading, "environment_samples N", directions, note=note)
    default = f"{_numbers(Scene.ambient)}; 0 with --environment"
    text, values = "ambient irradiance, E or R,G,B", range_of(Scene, "ambient")
    scene.add_option("--ambient E", text, default, values=values)
    text = "ray-trace ambient occlusion at the vertices of parts without an occlusion map"
    dims = "Occlusion dims ambient light and the diffuse light of the environment map"
    scene.add_flag("occlusion", text, f"{dims}. Requires pip install 'facerender[rays]'")


def job_of(
    options: argparse.Namespace, size: tuple[int, int] | None
) -> tuple[Job, dict[str, Camera]]:
    """Return the job that options and scene file describe, and the cameras, keyed by name.

    The cameras come from the options, otherwise from the scene file. If neither has a camera, one
    default camera is used.

    size : image size; None for the size of the first camera, or else the default size
    """
    if options.m is not None and options.roughness_map is not None:
        raise InputError("--m and --roughness-map exclude each other: leave one of them out")
    settings = load_scene(options.scene) if options.scene else {}
    names = (field.name for field in fields(ImageSettings) if field.name != "size")
    image = settings.pop("image", {}) | values_of(options, *names)
    size = size or image.get("size")
    material = settings.pop("material", {})
    shading = _shading(options, settings.pop("shading", {}), material, "planned" in settings)
    camera, cameras = _cameras(options, settings, size)
    parts = part_materials(options, settings.pop("parts", {}))
    if options.roughness_map is not None:
        material.pop("m", None)
    settings |= _scene_settings(options)
    settings["pose"] = _pose(options, settings.get("pose", Pose()))
    if options.shadows is not None:
        has_environment = settings.get("environment") is not None
        lights, _ = default_light(settings.get("lights"), None, has_environment)
        settings["lights"] = tuple(replace(light, shadow=options.shadows) for light in lights)
        if options.shadows and not (lights or options.occlusion):
            warn(no_shadows(has_environment))
    if options.environment_samples and settings.get("environment") is None:
        raise InputError(
            f"--environment-samples {options.environment_samples} has no environment map: add "
            "--environment FILE"
        )
    tables = [{"scattering": options.scattering}, material, *parts.values()]
    scatters = any(table.get("scattering") not in (None, "none") for table in tables)
    if options.scatter_samples and not scatters:
        raise InputError(
            f"--scatter-samples {options.scatter_samples} has no subsurface scattering: add "
            "--scattering skin"
        )
    names = (field.name for field in fields(MeshFile))
    job = Job(
        mesh=MeshFile(options.mesh, **values_of(options, *names)),
        material=material | values_of(options, *_FACTORS),
        parts=parts,
        camera=camera,
        shading=shading,
        image=ImageSettings(**image | {"size": size or camera.size or ImageSettings.size}),
        **settings,
    )
    return job, cameras


def _pose(options: argparse.Namespace, pose: Pose) -> Pose:
    """Return the pose of the scene file, changed by the options."""
    changes = values_of(options, "clip", "time")
    for option in ("weight", "joint"):
        if texts := getattr(options, option):
            entries = dict(parse_entry(option, text) for text in texts)
            changes[f"{option}s"] = getattr(pose, f"{option}s") | entries
    if options.vertices is not None:
        file, frame = parse_vertices(options.vertices)
        changes |= {"vertices": file, "frame": frame or 0}
    return replace(pose, **changes, track=options.track or pose.track)


def plays(options: argparse.Namespace, pose: Pose) -> bool:
    """Return whether the options name a sequence: a clip without a time, or a file of vertices
    without a frame."""
    if options.vertices is not None:
        return parse_vertices(options.vertices)[1] is None
    return pose.clip is not None and pose.time is None


def sequence(pose: Pose, mesh: Mesh, fps: float) -> list[Pose]:
    """Return the poses of a clip at a frame rate, or of all frames in a file of vertices.

    Raises
    ------
    InputError : the mesh has no such clip, the file cannot be used, or there are too many frames
    """
    if pose.vertices is not None:
        from facerender.scene.vertices import frame_count

        return [replace(pose, frame=number) for number in range(frame_count(pose.vertices))]
    mesh.with_pose(clip=pose.clip)  # only checks the clip
    seconds = mesh.clips[str(pose.clip)]
    count = math.floor(seconds * fps + 1e-6) + 1
    if count > MOST_CAMERAS:
        raise InputError(
            f"the clip {pose.clip} has {count} frames at --fps {fps:g}: give a rate with at most "
            f"{MOST_CAMERAS} frames"
        )
    return [replace(pose, time=min(number / fps, seconds)) for number in range(count)]


def values_of(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of those named options that the command line sets."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}


def files_read(options: argparse.Namespace, job: Job) -> Iterator[str | Path | None]:
    """Yield the input files that the options and the job name."""
    yield from mesh_files(job.mesh)
    environment = job.environment and job.environment.file
    yield from filter(None, [options.scene, environment, job.pose.vertices, job.before.vertices])
    yield from (place for place in options.camera or () if place.lower().endswith(CAMERA_FILES))


def load(job: Job, cache: bool = False, ahead: bool = True) -> Scene:
    """Load the scene of a job.

    Parameters
    ----------
    cache : whether the disk cache is used for the mesh and its decoded maps
    ahead : whether threads start to decode the maps before the renderer is created
    """
    scene = job.scene(job.mesh.load("read" if cache and not ahead else cache))
    albedo: Kind = "linear-color" if job.image.float_albedo else "color"
    if ahead:
        start_maps(resolved_parts(scene.mesh, albedo, job.shading.slope_filter))
    return scene


def _shading(
    options: argparse.Namespace,
    pinned: Mapping[str, Any],
    material: Mapping[str, Any],
    planned: bool,
) -> Shading:
    """Return the shading that the options and the scene file define. Raise InputError for options
    without effect, because the file pins the same value, and for changes of a plan's material."""
    for name, value in values_of(options, *_FACTORS).items():
        if planned and value != material.get(name, value):
            option = f"--{name.replace('_', '-')}"
            raise InputError(
                f"{options.scene} was planned for {name} = {material[name]}: leave {option} out, "
                f"or plan again with {option} {value}"
            )
    remedy = "plan again with it" if planned else "remove that line from the file"
    for key, names in (
        ("m", ("m", "roughness_map")),
        ("ks", ("ks", "specular_map")),
        ("normal_map", ("normal_map",)),
        ("two_lobes", ("second_slope", "lobe_weight", "lobe_map")),
        ("ambient", ("ambient",)),
        ("environment", ("environment",)),
        ("environment_samples", ("environment_samples",)),
        ("specular_lights", ("light",)),
    ):
        if key in pinned:
            for name, value in values_of(options, *names).items():
                if value != material.get(name):
                    raise InputError(
                        f"{options.scene} pins {key} = {pinned[key]} of the shading: leave "
                        f"--{name.replace('_', '-')} out, or {remedy}"
                    )
    terms = ("model", "lobe", "fresnel", "masking", "diffuse", "outside")
    features = ("slope_filter", "scatter_samples", "environment_samples")
    return Shading.from_dict({**pinned, **values_of(options, *terms, *features)})


def _cameras(
    options: argparse.Namespace, settings: dict[str, Any], size: tuple[int, int] | None
) -> tuple[Camera, dict[str, Camera]]:
    """Remove the cameras from the settings of a scene file; return the job's camera, and all
    cameras, keyed by name. If an option sets an orbiting camera, fields that the option does not
    set come from the file's camera."""
    path = settings.pop("cameras", ())
    camera = settings.pop("camera", path[0] if path else Camera())
    changes = values_of(options, "fov", "frame")
    if (target := getattr(options, "looked_at", None)) is not None:
        changes["target"] = tuple(_numbers_of("target", target, (3,)))
    if not options.camera:
        camera, *path = (replace(file_camera, **changes) for file_camera in (camera, *path))
        return camera, named(path or [camera], "camera")
    camera = replace(orbiting(camera), **changes)
    cameras: dict[str, Camera] = {}
    for place in options.camera:
        for name, placed_camera in _placed(place, camera, changes, options, size).items():
            cameras[name if name not in cameras else f"{name}_{len(cameras):03d}"] = placed_camera
    return next(iter(cameras.values())), cameras


def _placed(
    place: str,
    camera: Camera,
    changes: Mapping[str, Any],
    options: argparse.Namespace,
    size: tuple[int, int] | None,
) -> dict[str, Camera]:
    """Return the cameras of one --camera option, keyed by name.

    camera, changes : camera whose fields an orbiting camera inherits; values of :class:`Camera`
        fields, which replace the values in camera files
    """
    word, _, argument = place.partition(":")
    if word == "turntable":
        count = argument or "8"
        if not count.isdecimal() or int(count[:9]) not in TURNS:
            raise InputError(f"--camera {place}: give turntable:N, with {TURNS} views")
        return {f"turntable_{i:03d}": c for i, c in enumerate(turntable(camera, int(count)))}
    if word == "gltf" or place.lower().endswith(CAMERA_FILES):
        cameras = _file_cameras(place, options, size)
        return {name: replace(file_camera, **changes) for name, file_camera in cameras.items()}
    return {place.replace(",", "_"): orbiting(camera, **orbit_of(place, WHERE))}


def _file_cameras(
    place: str, options: argparse.Namespace, size: tuple[int, int] | None
) -> dict[str, Camera]:
    from facerender.scene.cameras import gltf_cameras, load_cameras

    word, colon, name = place.partition(":")
    if word != "gltf":
        return load_cameras(place, size)
    source = source_of(options.mesh)
    if options.mesh is None or source.suffix not in GLTF:
        raise InputError(f"--camera {place}: the mesh is not a .glb or .gltf; give another camera")
    if options.up == "auto":
        raise InputError(f"--camera {place} needs the axis of the file: give --up z, not auto")
    axes = axes_of(options.up or "y", options.rotate or (0.0, 0.0, 0.0))
    cameras = gltf_cameras(source.content, source.name, axes)
    if not colon:
        return cameras
    if name not in cameras:
        names = ", ".join(map(clipped, cameras))
        raise InputError(f"--camera {place}: {options.mesh} has no such camera; it has {names}")
    return {name: cameras[name]}


def _scene_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of Scene that the options set, except the camera."""
    settings: dict[str, Any] = {}
    if options.light:
        settings["lights"] = tuple(map(parse_light, options.light))
    if options.environment is not None:
        settings["environment"] = parse_environment(options.environment)
    if options.ambient is not None:
        numbers = _numbers_of("ambient", options.ambient, (1, 3))
        settings["ambient"] = tuple(numbers) if len(numbers) == 3 else numbers[0]
    if options.background is not None:
        settings["background"] = background_of(options.background)
    return settings


def _numbers_of(option: str, text: str, counts: Sequence[int]) -> list[float]:
    """Parse numbers separated by commas. Raise InputError if their count is not in `counts`."""
    with suppress(ValueError):
        if len(numbers := [*map(float, text.split(","))]) in counts:
            return numbers
    choices = " or ".join(map(str, counts))
    raise InputError(f"--{option} {shown(text)}: give {choices} numbers separated by commas")
