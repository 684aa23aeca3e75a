"""What ``render`` and ``plan`` share: the options that a scene is made of, and their job."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from facerender.commands.common import import_trimesh, mesh_files, numbers_of
from facerender.drawing.prepare import start_maps
from facerender.errors import InputError
from facerender.job import ImageSettings, Job, MeshFile, Output
from facerender.scenes.camera import Camera, turntable
from facerender.scenes.file import STUDIO, load_scene, parse_environment
from facerender.scenes.light import LIGHTS, parse_light
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Kind
from facerender.shading import DIFFUSE, Shading
from facerender.terms import FRESNEL, MASKING, MODELS

CAMERAS = {"front": 0.0, "three-quarter": -35.0, "profile": 90.0}
WHERE = f"{', '.join(CAMERAS)}, or AZIMUTH[,ELEVATION[,ZOOM]] in degrees"


def add_scene(
    command: argparse.ArgumentParser,
) -> tuple[argparse._ArgumentGroup, argparse._ArgumentGroup]:
    """Add what a scene is made of, and return the groups on reflectance and on the scene."""
    command.add_argument(
        "mesh", nargs="?", help=".glb .gltf .obj .ply .stl; without it the built-in head"
    )
    terms = command.add_argument_group("reflectance")
    terms.add_argument("--model", choices=tuple(MODELS), help="(cook-torrance)")
    terms.add_argument("--fresnel", choices=tuple(FRESNEL), help="(schlick)")
    terms.add_argument("--masking", choices=tuple(MASKING), help="(v-cavity)")
    terms.add_argument(
        "--m", type=float, help="rms slope of the microfacets, in place of the file's map (0.3)"
    )
    terms.add_argument("--f0", type=float, help="reflectance at normal incidence (0.028)")
    terms.add_argument("--ks", type=float, help="specular weight (1)")
    terms.add_argument(
        "--diffuse", choices=DIFFUSE, help="coupled: what the specular term leaves (lambert)"
    )
    terms.add_argument("--kd", type=float, help="diffuse weight (1)")
    terms.add_argument(
        "--slope-filter",
        action=argparse.BooleanOptionalAction,
        help="widen the lobe by what a pixel does not resolve of the normal map (on)",
    )
    terms.add_argument(
        "--curvature",
        action=argparse.BooleanOptionalAction,
        help="widen it by the mesh's curvature over a pixel too, for small images (off)",
    )
    terms.add_argument(
        "--second-slope", type=float, metavar="F", help="second lobe: m of it over m (1: none)"
    )
    terms.add_argument(
        "--lobe-weight", type=float, metavar="W", help="share of the first lobe (1: the only one)"
    )
    terms.add_argument(
        "--scattering", choices=("skin", "none"), help="light that enters and leaves beside (none)"
    )
    terms.add_argument(
        "--scatter-samples",
        type=int,
        metavar="N",
        help="pixels at which it is looked for: 8, 16, 32 or 64; 0 leaves it out (16)",
    )

    maps = command.add_argument_group("maps, in place of those of the mesh file")
    for name in ("albedo", "normal-map", "specular-map", "roughness-map", "lobe-map"):
        maps.add_argument(f"--{name}", metavar="FILE")
    maps.add_argument("--flip-v", action="store_true", help="turn texture coordinates upside down")
    maps.add_argument(
        "--allow-outside",
        action="store_true",
        help="open what the mesh file refers to wherever it lies (below its folder alone)",
    )
    maps.add_argument("--anisotropy", type=float, default=1.0, help="of texture filtering (1)")
    maps.add_argument("--float-albedo", action="store_true", help="albedo as linear float16")

    scene = command.add_argument_group("scene")
    scene.add_argument(
        "--millimetres",
        type=float,
        metavar="MM",
        help="that a unit of the mesh is, for scattering (1000 in glTF)",
    )
    scene.add_argument("--fov", type=float, help="vertical angle of view in degrees (25)")
    scene.add_argument(
        "--light",
        action="append",
        metavar="LIGHT",
        help=f"{', '.join(LIGHTS)}, AZIMUTH,ELEVATION[,IRRADIANCE] or "
        "point:X,Y,Z[,IRRADIANCE], and behind it ,radius=DEGREES where it has a size and ,shadow "
        "where it casts one; repeat for several (key, rim, fill)",
    )
    scene.add_argument(
        "--shadows",
        action=argparse.BooleanOptionalAction,
        help="have every light cast shadows, or none (as each light says)",
    )
    scene.add_argument(
        "--environment",
        metavar="FILE[,ROTATION[,SCALE]]",
        help=f".hdr, .exr or {STUDIO}: light from all around, in place of lights and ambient light "
        "where none are given; rotation in degrees",
    )
    scene.add_argument(
        "--environment-samples",
        type=int,
        metavar="N",
        help="directions of it that a lobe reflects, even; 0 for its diffuse part alone (32)",
    )
    scene.add_argument("--ambient", metavar="E", help="irradiance from everywhere, E or R,G,B")
    scene.add_argument(
        "--occlusion",
        action="store_true",
        help="dim ambient and environment light by what the mesh hides of it, found by rays to its "
        "vertices, where the file has no occlusion map (off)",
    )
    scene.add_argument("--background", metavar="RGB", help="linear R,G,B, or none: transparent")
    return terms, scene


def job_of(
    options: argparse.Namespace,
    places: Sequence[str],
    size: tuple[int, int],
    outputs: tuple[Output, ...] = (),
) -> tuple[Job, tuple[Camera, ...]]:
    """Return what options and scene file say: the job, and the cameras of the places, or else of
    the file, or else the job's own."""
    if options.m is not None and options.roughness_map is not None:
        raise InputError("--m and --roughness-map exclude each other: leave one of them out")
    settings = load_scene(options.scene) if options.scene else {}
    names = (
        *("model", "lobe", "fresnel", "masking", "diffuse", "outside"),
        *("slope_filter", "curvature", "scatter_samples", "environment_samples"),
    )
    terms = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    pinned = settings.pop("shading", {})
    _check_unpinned(options, pinned)
    shading = Shading.from_dict(pinned | terms)
    material = settings.pop("material", {})
    if options.roughness_map is not None:
        material.pop("m", None)
    path = settings.pop("cameras", ())
    camera = settings.get("camera", path[0] if path else Camera())
    if options.fov is not None:
        camera = dataclasses.replace(camera, fov=options.fov)
    cameras = tuple(each for place in places for each in _cameras(place, camera)) or path
    settings["camera"] = cameras[0] if places else camera
    settings.update(_scene_settings(options))
    if "environment" in settings:
        settings.setdefault("lights", ())
        settings.setdefault("ambient", 0.0)
    if options.shadows is not None:
        lights = settings.get("lights", Job.lights)
        settings["lights"] = tuple(
            dataclasses.replace(light, shadow=options.shadows) for light in lights
        )
    material.update(
        (name, value)
        for name in ("m", "f0", "ks", "kd", "second_slope", "lobe_weight", "scattering")
        if (value := getattr(options, name)) is not None
    )
    mesh = MeshFile(
        options.mesh,
        options.albedo,
        options.normal_map,
        options.specular_map,
        options.roughness_map,
        options.flip_v,
        getattr(options, "triangles", None),
        options.lobe_map,
        options.millimetres,
        options.occlusion,
        options.allow_outside,
    )
    job = Job(
        mesh,
        material,
        shading=shading,
        image=ImageSettings(size, options.samples, options.anisotropy, options.float_albedo),
        outputs=outputs,
        **settings,
    )
    return job, cameras or (job.camera,)


def files_read(options: argparse.Namespace, job: Job) -> Iterator[str | Path]:
    """Yield what options and job say is read."""
    yield from mesh_files(job.mesh)
    yield from filter(None, [options.scene, job.environment and job.environment.file])
    places = [options.camera] if isinstance(options.camera, str) else options.camera or []
    yield from (place for place in places if place.lower().endswith(".toml"))


def load(job: Job, cache: bool = False) -> Scene:
    """Return the scene of a job, whose maps are being decoded."""
    mesh = job.mesh.kept() if cache else None
    if mesh is None:
        import_trimesh(job.mesh.path)
        mesh = job.mesh.load(cache)
    scene = job.scene(mesh)
    albedo: Kind = "linear-color" if job.image.float_albedo else "color"
    start_maps(scene.mesh, albedo, job.shading.slope_filter)
    return scene


def _check_unpinned(options: argparse.Namespace, pinned: Mapping[str, Any]) -> None:
    """An option of which the scene's shading would take no account is refused."""
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
        for name in names:
            if key in pinned and getattr(options, name, None) is not None:
                raise InputError(
                    f"{options.scene} pins {key} = {pinned[key]} of the shading: leave "
                    f"--{name.replace('_', '-')} out, or that line"
                )


def _cameras(place: str, camera: Camera) -> tuple[Camera, ...]:
    """Return the cameras that a word means, others of their kind as the given one."""
    if place == "turntable":
        return turntable(camera)
    if place.lower().endswith(".toml"):
        if not (path := load_scene(place).get("cameras")):
            raise InputError(f"{place} has no [[cameras]]")
        return tuple(path)
    orbit: dict[str, Any] = {}
    if place in CAMERAS:
        orbit = {"azimuth": CAMERAS[place], "elevation": 0.0}
    else:
        try:
            numbers = numbers_of("camera", place, (1, 2, 3))
        except InputError as error:
            raise InputError(f"{error}, or {', '.join(CAMERAS)}") from None
        orbit = dict(zip(("azimuth", "elevation", "zoom"), numbers, strict=False))
    return (dataclasses.replace(camera, position=None, **orbit),)


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
