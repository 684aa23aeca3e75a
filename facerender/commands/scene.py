"""What ``render`` and ``plan`` share: the options that a scene is made of, and their job."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from facerender.commands.common import (
    add_allow_outside,
    add_field,
    add_flag,
    add_maps,
    add_parts,
    add_switch,
    import_trimesh,
    mesh_files,
    numbers_of,
)
from facerender.drawing.prepare import start_maps
from facerender.errors import InputError, clipped
from facerender.job import ImageSettings, Job, MeshFile
from facerender.loading.source import GLTF, NORMAL_MAP_Y
from facerender.scenes.camera import (
    AZIMUTHS_BY_NAME,
    CAMERA_FILES,
    FRAMES,
    Camera,
    orbiting,
    turntable,
)
from facerender.scenes.file import STUDIO, load_scene, parse_environment
from facerender.scenes.light import LIGHTS, parse_light
from facerender.scenes.material import Material
from facerender.scenes.mips import Kind
from facerender.scenes.scene import Scene
from facerender.shading import DIFFUSE, SCATTER_SAMPLES, Shading, Term
from facerender.terms import FRESNEL, MASKING, MODELS

_FACTORS = (
    *("m", "f0", "ks", "kd", "second_slope", "lobe_weight", "scattering", "normal_strength"),
)
WHERE = (
    f"{', '.join(AZIMUTHS_BY_NAME)}, or AZIMUTH[,ELEVATION[,ZOOM]] in degrees; turntable[:N], for "
    "8 or N around; gltf[:NAME], of the mesh file; a .toml with [[cameras]], a .json or .npz with "
    "K and [R|t]; repeat for several"
)


def add_scene(
    command: argparse.ArgumentParser,
) -> tuple[argparse._ArgumentGroup, argparse._ArgumentGroup]:
    """Add what a scene is made of, and return the groups on reflectance and on the scene."""
    command.add_argument(
        "mesh", nargs="?", help=".glb .gltf .obj .ply .stl; without it the built-in head"
    )
    terms = command.add_argument_group("reflectance")
    maps = command.add_argument_group("maps, in place of those of the mesh file")
    scene = command.add_argument_group("scene")
    _add_reflectance(terms)
    _add_maps(maps)
    add_parts(scene)
    unit = "length of a unit of the mesh, for scattering"
    add_field(scene, MeshFile, "millimetres", unit, "1000 in glTF", metavar="MM")
    scene.add_argument("--camera", action="append", metavar="WHERE", help=f"{WHERE} (front)")
    framed = f"what the image holds of the mesh, where a camera orbits ({Camera.frame})"
    scene.add_argument("--frame", choices=FRAMES, help=framed)
    add_field(scene, Camera, "fov", "vertical angle of view")
    _add_lighting(scene)
    scene.add_argument("--background", metavar="RGB", help="linear R,G,B, or none: transparent")
    return terms, scene


def _add_reflectance(terms: argparse._ArgumentGroup) -> None:
    for name, registry in (("model", MODELS), ("fresnel", FRESNEL), ("masking", MASKING)):
        terms.add_argument(f"--{name}", choices=tuple(registry), help=f"({getattr(Term, name)})")
    add_field(terms, Material, "m", "rms slope of the microfacets, in place of the file's map")
    add_field(terms, Material, "f0", "reflectance at normal incidence")
    add_field(terms, Material, "ks", "specular weight")
    coupled = f"coupled: what the specular term leaves ({Shading.diffuse})"
    terms.add_argument("--diffuse", choices=DIFFUSE, help=coupled)
    add_field(terms, Material, "kd", "diffuse weight")
    unresolved = "widen the lobe by what a pixel does not resolve of the normal map (on)"
    add_switch(terms, "slope-filter", unresolved)
    curved = "widen it by the mesh's curvature over a pixel too, for small images (off)"
    add_switch(terms, "curvature", curved)
    second = "m of a second lobe, as a factor on m"
    add_field(terms, Material, "second_slope", second, "1: none", metavar="F")
    add_field(terms, Material, "lobe_weight", "fraction of the first lobe", metavar="W")
    scattering = "subsurface scattering (none)"
    terms.add_argument("--scattering", choices=("skin", "none"), help=scattering)
    terms.add_argument(
        "--scatter-samples",
        type=int,
        metavar="N",
        help=f"subsurface samples per pixel: {', '.join(map(str, SCATTER_SAMPLES))}; 0 leaves "
        f"scattering out ({Shading.scatter_samples})",
    )


def _add_maps(maps: argparse._ArgumentGroup) -> None:
    add_maps(maps, "albedo", "normal-map", "specular-map", "roughness-map", "lobe-map")
    add_flag(maps, "flip-v", "turn texture coordinates upside down")
    green = f"down: green of normal maps points down, as DirectX has it ({MeshFile.normal_map_y})"
    maps.add_argument("--normal-map-y", choices=NORMAL_MAP_Y, help=green)
    add_field(maps, Material, "normal_strength", "factor on slopes of normal maps", metavar="X")
    add_allow_outside(maps)
    add_field(maps, ImageSettings, "anisotropy", "of texture filtering")
    add_flag(maps, "float-albedo", "albedo as linear float16")
    add_flag(maps, "full-maps", "keep all mip levels of maps of more than 4096 x 4096")


def _add_lighting(scene: argparse._ArgumentGroup) -> None:
    scene.add_argument(
        "--light",
        action="append",
        metavar="LIGHT",
        help=f"{', '.join(LIGHTS)}, AZIMUTH,ELEVATION[,IRRADIANCE] or "
        "point:X,Y,Z[,IRRADIANCE], and behind it ,radius=DEGREES where it has a size and ,shadow "
        "where it casts one; repeat for several (key, rim, fill)",
    )
    add_switch(scene, "shadows", "have every light cast shadows, or none (as each light says)")
    scene.add_argument(
        "--environment",
        metavar="FILE[,ROTATION[,SCALE]]",
        help=f".hdr, .exr or {STUDIO}: environment light, in place of lights and ambient light "
        "where none are given; rotation in degrees",
    )
    directions = "directions of it that a lobe reflects, even, or 0 for its diffuse part alone"
    add_field(scene, Shading, "environment_samples", directions, metavar="N")
    scene.add_argument("--ambient", metavar="E", help="ambient irradiance, E or R,G,B")
    add_flag(
        *(scene, "occlusion"),
        "dim ambient and environment light by what the mesh hides of it, found by rays to its "
        "vertices, where the file has no occlusion map (off)",
    )


def job_of(
    options: argparse.Namespace, size: tuple[int, int] | None
) -> tuple[Job, dict[str, Camera]]:
    """Return what options and scene file say: the job, and by their names the cameras of the
    options, or else of the file, or else the job's own.

    size : of the images; None for that of the first camera, or else of ImageSettings
    """
    if options.m is not None and options.roughness_map is not None:
        raise InputError("--m and --roughness-map exclude each other: leave one of them out")
    settings = load_scene(options.scene) if options.scene else {}
    shading = _shading(options, settings.pop("shading", {}))
    camera, cameras = _cameras(options, settings, size)
    material = settings.pop("material", {})
    if options.roughness_map is not None:
        material.pop("m", None)
    settings |= _scene_settings(options)
    if "environment" in settings:
        settings.setdefault("lights", ())
        settings.setdefault("ambient", 0.0)
    if options.shadows is not None:
        lights = settings.get("lights", Job.lights)
        settings["lights"] = tuple(replace(light, shadow=options.shadows) for light in lights)
    names = [each.name for each in fields(MeshFile) if each.name != "path"]
    images = ("samples", "anisotropy", "float_albedo", "full_maps")
    job = Job(
        mesh=MeshFile(options.mesh, **values_of(options, *names)),
        material=material | values_of(options, *_FACTORS),
        camera=camera,
        shading=shading,
        image=ImageSettings(
            size or camera.size or ImageSettings.size, **values_of(options, *images)
        ),
        **settings,
    )
    return job, cameras


def values_of(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return those of the options that were given."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}


def files_read(options: argparse.Namespace, job: Job) -> Iterator[str | Path | None]:
    """Yield what options and job say is read."""
    yield from mesh_files(job.mesh)
    yield from filter(None, [options.scene, job.environment and job.environment.file])
    yield from (place for place in options.camera or () if _is_file(place))


def load(job: Job, cache: bool = False, ahead: bool = True) -> Scene:
    """Return the scene of a job; ahead of its renderer its maps are being decoded, and kept."""
    mesh = job.mesh.cached() if cache else None
    if mesh is None:
        import_trimesh(job.mesh.path)
        mesh = job.mesh.load(cache and ahead)
    scene = job.scene(mesh)
    albedo: Kind = "linear-color" if job.image.float_albedo else "color"
    if ahead:
        start_maps(scene.mesh, albedo, job.shading.slope_filter)
    return scene


def _shading(options: argparse.Namespace, pinned: Mapping[str, Any]) -> Shading:
    """Return the shading of the options and of the scene file.

    Raises
    ------
    InputError : an option of which the file's shading would take no account
    """
    for key, names in (
        ("m", ("m", "roughness_map")),
        ("ks", ("ks", "specular_map")),
        ("normal_map", ("normal_map",)),
        ("two_lobes", ("second_slope", "lobe_weight", "lobe_map")),
        ("ambient", ("ambient",)),
        ("environment", ("environment",)),
        ("environment_samples", ("environment_samples",)),
        ("specular_lights", ("light",)),
        ("frontal_lights", ("light",)),
        ("lights", ("light", "m", "lobe", "model", "fresnel", "masking")),
    ):
        if key in pinned:
            for name in values_of(options, *names):
                raise InputError(
                    f"{options.scene} pins {key} = {pinned[key]} of the shading: leave "
                    f"--{name.replace('_', '-')} out, or that line"
                )
    terms = ("model", "lobe", "fresnel", "masking", "diffuse", "outside")
    others = ("slope_filter", "curvature", "scatter_samples", "environment_samples")
    return Shading.from_dict({**pinned, **values_of(options, *terms, *others)})


def _cameras(
    options: argparse.Namespace, settings: dict[str, Any], size: tuple[int, int] | None
) -> tuple[Camera, dict[str, Camera]]:
    """Take the cameras out of the settings of a scene file, and return the job's camera and all
    cameras by their names. Cameras of options orbit as that of the file does."""
    path = settings.pop("cameras", ())
    camera = settings.pop("camera", path[0] if path else Camera())
    changes = values_of(options, "fov", "frame")
    if (target := getattr(options, "looked_at", None)) is not None:
        changes["target"] = tuple(numbers_of("target", target, (3,)))
    if not options.camera:
        camera = replace(camera, **changes)
        own = [replace(each, **changes) for each in path] or [camera]
        return camera, {f"camera_{number:03d}": each for number, each in enumerate(own)}
    camera = replace(orbiting(camera), **changes)
    found: dict[str, Camera] = {}
    for place in options.camera:
        for name, each in _placed(place, camera, changes, options.mesh, size).items():
            found[name if name not in found else f"{name}_{len(found):03d}"] = each
    return next(iter(found.values())), found


def _placed(
    place: str,
    camera: Camera,
    changes: Mapping[str, Any],
    mesh: str | None,
    size: tuple[int, int] | None,
) -> dict[str, Camera]:
    """Return by their names the cameras that an option --camera names: of the kind of the given
    one, or of files, with the changes."""
    word, _, rest = place.partition(":")
    if word == "turntable":
        if rest and not rest.isdecimal():
            raise InputError(f"--camera {place}: give turntable:N, with N views")
        turned = turntable(camera, int(rest[:9]) if rest else 8)
        return {f"turntable_{number:03d}": each for number, each in enumerate(turned)}
    if word == "gltf" or _is_file(place):
        file = mesh if word == "gltf" else place
        found = _file_cameras(place, file, rest, size)
        return {name: replace(each, **changes) for name, each in found.items()}
    return {place.replace(",", "_"): _orbit(place, camera)}


def _is_file(place: str) -> bool:
    return place.lower().endswith(CAMERA_FILES)


def _file_cameras(
    place: str, file: str | None, name: str, size: tuple[int, int] | None
) -> dict[str, Camera]:
    if place.startswith("gltf") and not (file or "").lower().endswith(GLTF):
        raise InputError(f"--camera {place}: the mesh is no .glb or .gltf; give another camera")
    from facerender.loading.cameras import load_cameras

    found = load_cameras(str(file), size)
    if not place.startswith("gltf:"):
        return found
    if name not in found:
        known = ", ".join(map(clipped, found))
        raise InputError(f"--camera {place}: {file} has no such camera; known: {known}")
    return {name: found[name]}


def _orbit(place: str, camera: Camera) -> Camera:
    if place in AZIMUTHS_BY_NAME:
        return orbiting(camera, azimuth=AZIMUTHS_BY_NAME[place], elevation=0.0)
    try:
        numbers = numbers_of("camera", place, (1, 2, 3))
    except InputError as error:
        raise InputError(f"{error}, or {WHERE.replace(';', ',')}") from None
    return orbiting(camera, **dict(zip(("azimuth", "elevation", "zoom"), numbers, strict=False)))


def _scene_settings(options: argparse.Namespace) -> dict[str, Any]:
    """The fields of Scene that options set, over those of the scene file; but for the camera."""
    settings: dict[str, Any] = {}
    if options.light:
        settings["lights"] = tuple(parse_light(text) for text in options.light)
    if options.environment is not None:
        settings["environment"] = parse_environment(options.environment)
    if options.ambient is not None:
        numbers = numbers_of("ambient", options.ambient, (1, 3))
        settings["ambient"] = tuple(numbers) if len(numbers) == 3 else numbers[0]
    if options.background is not None:
        transparent = options.background == "none"
        settings["background"] = (
            None if transparent else tuple(numbers_of("background", options.background, (3,)))
        )
    return settings
