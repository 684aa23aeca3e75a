"""Builds the explorer's page: scripts, and their data (GLSL, registry, ranges, and the mesh with
its maps, quantised and compressed)."""

from __future__ import annotations

import json
import shlex
import zlib
from base64 import b64encode
from dataclasses import asdict, replace
from io import BytesIO
from itertools import product
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.prepare import resolved_parts
from facerender.drawing.program import fixed_attributes, part_uniforms, surface_features
from facerender.errors import InputError, warn
from facerender.glsl.library import call, shader_dir, shader_source, term_source
from facerender.loading import MESH_PATHS, MeshFile
from facerender.material import MAPS, Material, part_text
from facerender.mesh.mesh import Mesh, drawn_alpha, slope_range
from facerender.page import document
from facerender.scene.background import clear_color
from facerender.scene.camera import AZIMUTHS_BY_NAME, Camera
from facerender.scene.job import Job
from facerender.scene.light import LIGHT_KINDS, Light
from facerender.scene.pose import Pose
from facerender.scene.scene import AMBIENT, Scene, default_lights
from facerender.scene.shading import SMALL_SLOPE, Shading, Term
from facerender.scene.view import FRAMING_MARGIN, following, region_of, target_of, view_of
from facerender.terms.lobe import LOBES, MIN_SLOPE, AnyLobe, GPower, lobe_entry
from facerender.terms.model import FRESNEL, MASKING, MODELS
from facerender.texture.texture import Kind, Texture
from facerender.values.fields import EXPOSURES, limits_of, plain, range_of, toml_text

STEPS = 2**16 - 1  # Positions: 2.6 micrometres each on a head.
# Texels per side, which every WebGL 2 implementation supports.
LARGEST_MAP = 2048
MAX_NAMES = 4  # parts that a note names
# Factors of materials that the page does not draw.
UNDRAWN = (
    *("second_slope", "lobe_weight", "scattering", "normal_strength", "occlusion_strength"),
    *("emissive", "unlit", "alpha", "alpha_cutoff", "opacity", "transmission", "refraction"),
)
LEAST_LOSS = 1.0  # Limit of a JPEG map's mean error, in 8-bit levels; above it, the map is a PNG.


def drawable(mesh: Mesh) -> Mesh:
    """Return a mesh without the features that the page does not draw. All parts of the result are
    opaque. Blended and refracting parts are removed, unless all parts are. Materials have no
    emission. Maps have strength 1 and use the first texture coordinates."""
    names = (*UNDRAWN, "opacity_map", "emissive_map", "lobe_map", "second_uv")
    unused: dict[str, Any] = {name: getattr(Material, name) for name in names}
    alphas = _alphas(mesh)
    indices = [i for i, alpha in enumerate(alphas) if alpha != "blend"] or range(len(alphas))
    stored, posed = ([parts[i] for i in indices] for parts in (mesh.geometry.parts, mesh.parts))
    geometry = replace(mesh.geometry, parts=tuple(stored), known_framing=mesh.geometry.framing)
    materials = (mesh.materials[i] for i in indices)
    return Mesh(
        geometry,
        tuple(replace(material, **(_by_second(material) | unused)) for material in materials),
        mesh.pose and replace(mesh.pose, geometry=geometry, parts=tuple(posed)),
    )


def lost_features(mesh: Mesh) -> list[str]:
    """Return the names of the features of a mesh that the page does not draw."""
    alphas, materials = _alphas(mesh), mesh.materials
    strengths = {(material.normal_strength, material.occlusion_strength) for material in materials}
    pairs = zip(mesh.parts, alphas, strict=True)
    blended = [part.name for part, alpha in pairs if alpha == "blend"]
    listed = blended[:MAX_NAMES]
    if blended[MAX_NAMES:]:
        listed.append(f"{len(blended) - MAX_NAMES} more")
    names = f" ({', '.join(listed)})" if all(blended) else ""
    features = {
        f"blended parts{names}": bool(blended),
        "masks": "mask" in alphas,
        "emission": any(any(material.emission) for material in materials),
        "maps with second texture coordinates": any(map(_by_second, materials)),
        "map strengths": strengths != {(1.0, 1.0)},
    }
    return [name for name, lost in features.items() if lost]


def _alphas(mesh: Mesh) -> list[str]:
    """Return how each part is drawn: opaque, mask or blend. Refracting parts count as blended."""
    pairs = zip(mesh.parts, mesh.materials, strict=True)
    return ["blend" if pair[1].refracts else drawn_alpha(*pair) for pair in pairs]


def _by_second(material: Material) -> dict[str, Any]:
    """Return None for each map that uses the second texture coordinates."""
    return dict.fromkeys(name for name in MAPS if material.by_second(name))


def packed(mesh: Mesh) -> tuple[dict[str, Any], bytes, list[tuple[Texture, Kind]]]:
    """Return the description of a mesh, its compressed arrays, and its maps with the kinds of their
    mip chains. The description refers to arrays and maps by index."""
    columns: list[NDArray[np.int64]] = []
    parts, skin, reach = resolved_parts(mesh), mesh.skin, mesh.space.reach
    textures = [*dict.fromkeys(map_[1:] for part in parts for map_ in part.maps)]
    descriptions = []
    for resolved in parts:
        part, material, arrays = mesh.parts[resolved.index], resolved.material, {}
        attributes = {"in_position": mesh.normalised(part.positions), "in_normal": part.normals}
        for name, values in (attributes | fixed_attributes(part, uv2=False)).items():
            low, extent = values.min(axis=0), np.ptp(values, axis=0).clip(1e-9)
            if name == "in_position":
                # One grid for all parts: their common borders stay closed.
                low, extent = np.full(3, -reach), np.full(3, 2.0 * reach)
            scale = (extent / STEPS).tolist()
            arrays[name] = {"column": len(columns), "scale": scale, "offset": low.tolist()}
            columns.append(np.round((values - low) / extent * STEPS).astype(np.int64))
        columns.append(part.faces.astype(np.int64))
        uniforms = part_uniforms(resolved).items()
        descriptions.append(
            {
                "features": surface_features(resolved, Shading()),
                "uniforms": {name: np.asarray(value).tolist() for name, value in uniforms},
                "arrays": arrays,
                "faces": len(columns) - 1,
                "maps": {map_[0]: textures.index(map_[1:]) for map_ in resolved.maps},
                "doubleSided": material.double_sided is not False,
                "slopes": slope_range(part, material),
                "skin": resolved.index in skin,
            }
        )
    description = {
        "parts": descriptions,
        "columns": [list(column.shape) for column in columns],
        "maps": [{"kind": k, "wrap": map_.wrap, "nearest": map_.nearest} for map_, k in textures],
    }
    return description, zlib.compress(b"".join(map(_planes, columns)), 9), textures


def _planes(column: NDArray[np.int64]) -> bytes:
    """Encode integers (N, K) as differences of successive rows, with the sign in the lowest bit and
    each of their four bytes in a plane of its own."""
    # Neighbouring vertices have close values, so the planes of the upper bytes are runs of zeros,
    # which deflate compresses well.
    steps = np.diff(column, axis=0, prepend=0)
    folded = ((steps << 1) ^ (steps >> 63)).astype("<u4")
    return folded.view(np.uint8).reshape(-1, 4).T.tobytes()


def encoded(texture: Texture, mip_kind: Kind) -> bytes:
    """Return a map as an image file with row 0 at the bottom: a JPEG if the mean error is below one
    8-bit level, otherwise a PNG."""
    from PIL import Image

    image = texture.rgb()
    if max(image.size) > LARGEST_MAP:
        scale = LARGEST_MAP / max(image.size)
        width, height = (max(round(side * scale), 1) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    texels = np.asarray(image).astype(np.int16)
    # Without chroma subsampling, since the three channels of a normal map are independent.
    for quality in (95, 98) if mip_kind == "normal" else (93, 97):
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, subsampling=0, optimize=True)
        if np.abs(np.asarray(Image.open(file)) - texels).mean() < LEAST_LOSS:
            return file.getvalue()
    file = BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()


_BROWSER = Path(__file__).parent / "browser"
_FILES = ("explorer.css", "state.js", "drawing.js", "panel.js", "explorer.js")
_SHADERS = ("level.frag", "error.glsl", "error.frag", "show.frag", "lobe.frag")
_HOST = ("shade.frag", "gbuffer.frag", "surface.vert", "screen.vert")
_CAMERA = ("azimuth", "elevation", "zoom", "fov")
_LIGHT = ("azimuth", "elevation", "irradiance", "radius")
# First numbers of the g-power lobe. The page replaces them in the text of the GLSL.
_G_POWER = GPower(8, 0.25, 0.5)
TERM_FACTORS = ("m", "f0", "ks")  # factors of the skin that the page changes, in A and in B
MAX_LIGHTS = 8
# Parameters of the shading that the page draws, or whose omission has a name in _omitted.
_NAMED = {
    *("model", "lobe", "fresnel", "masking", "m", "small_slope", "outside", "diffuse"),
    *("scatter_samples", "environment", "environment_samples", "environment_lights"),
    *("two_lobes", "shadow_lights"),
}


def explorer_page(
    job: Job, mesh: Mesh, a: Term = Term(), b: Term = Term(lobe="d16"), plays: bool = False
) -> str:
    """Return the page as HTML.

    Features that the page cannot draw are left out; a warning and a note on the page list them.
    Maps with more than 2048 texels per side are reduced. Raise InputError if a map is damaged, the
    job has more than 8 lights, or a camera that does not orbit.

    job : job whose mesh file, lights, ambient light, background, camera, and m, f0 and ks of the
        skin the page shows first
    mesh : mesh of the job, with all factors except m, f0 and ks
    a, b : the two shadings of the skin that the page shows first
    plays : whether the job's pose stands for a sequence, of which the page shows one frame
    """
    start = job.camera
    if start.position is not None or start.extrinsics is not None or start.orthographic:
        remedy = "give --camera front, three-quarter, profile or AZIMUTH,ELEVATION,ZOOM"
        raise InputError(f"the explorer needs a perspective camera that orbits the mesh: {remedy}")
    if len(job.lights) > MAX_LIGHTS:
        counts = f"at most {MAX_LIGHTS} lights, and there are {len(job.lights)}"
        raise InputError(f"the explorer has {counts}: leave some out")
    of_scene, note = ", ".join(_omitted(job, mesh, plays)), ""
    if omitted := ", ".join(filter(None, [*lost_features(mesh), of_scene])):
        warn(f"the explorer shows {mesh.name} without {omitted}")
        note = f"This page omits {omitted}." + f" Its command omits {of_scene}." * bool(of_scene)
    mesh = drawable(mesh)
    lights, ambient = job.lights, job.ambient
    if job.environment is not None and not lights:
        # The page does not draw environment maps, and would be black.
        lights, ambient = default_lights(False), AMBIENT
    scene = Scene(mesh, start, lights)
    lights = following(scene, view_of(scene, 1.0)).lights
    mesh_description, arrays, textures = packed(mesh)
    framed = region_of(mesh, job.camera.frame) or mesh
    factors = {name: job.material.get(name) for name in TERM_FACTORS}
    camera = plain(job.camera, changed=True)
    page_data = {
        "version": __version__,
        "name": mesh.name,
        "mesh": _words(job),
        "center": mesh.center.tolist(),
        "radius": mesh.radius,
        "target": target_of(mesh, job.camera).tolist(),
        "profile": framed.profile.round(5).tolist(),
        "framing_margin": FRAMING_MARGIN,
        **mesh_description,
        "first": {
            "a": _term(a) | factors,
            "b": _term(b) | factors,
            "camera": {name: getattr(job.camera, name) for name in _CAMERA},
            "lights": [_light(light, mesh) for light in lights],
            "ambient": np.broadcast_to(ambient, 3).tolist(),
        },
        "aim": {name: camera[name] for name in ("frame", "target") if name in camera},
        "cameras": AZIMUTHS_BY_NAME,
        "most_lights": MAX_LIGHTS,
        "note": note,
        "background": clear_color(job.background),
        "registry": _registry(),
        "ranges": _ranges(),
    }
    contents = {
        "geometry": arrays,
        "sources": zlib.compress(json.dumps(_sources()).encode(), 9),
        **{f"map-{i}": encoded(*pair) for i, pair in enumerate(textures)},
    }
    # A browser ends a script at the first "</script", also within a JSON string.
    json_text = json.dumps(page_data, separators=(",", ":")).replace("</", "<\\/")
    body = _text("explorer.html") + _script("application/json", "facts", json_text)
    for name, content in contents.items():
        body += _script("text/plain", name, b64encode(content).decode())
    title = f"facerender explorer: {mesh.name}"
    return document(title, body, *(_BROWSER / name for name in _FILES))


def _term(term: Term) -> dict[str, Any]:
    """Return the values of a shading's controls; ``constant`` is the constant m of a plan."""
    power = term.lobe if isinstance(term.lobe, GPower) else _G_POWER
    lobe = "g-power" if power is term.lobe else term.lobe
    return {**plain(term), "lobe": lobe, "constant": term.m, **plain(power)}


def _omitted(job: Job, mesh: Mesh, plays: bool) -> list[str]:
    """Return the names of the features of a job that neither the page nor its command draws."""
    shading, materials = job.shading, mesh.materials
    lit = enumerate(job.lights)
    only = shading.shadow_lights
    cast = [light for i, light in lit if light.shadow and (only is None or i in only)]
    replaced = "" if job.lights else " (the default lights and ambient light replace the map)"
    parameters = [name for name in shading.as_dict() if name not in _NAMED]
    image = [name for name in plain(job.image, changed=True) if name != "size"]
    features = {
        "the motion of lights with the camera": any(light.follow for light in job.lights),
        "soft shadows": any(light.radius for light in cast),
        "shadows": any(not light.radius for light in cast),
        f"the environment map{replaced}": job.environment is not None,
        "the background image": not isinstance(job.background, tuple | None),
        "second lobes": shading.two_lobes and any(material.two_lobes for material in materials),
        "subsurface scattering": shading.scatter_samples > 0
        and any(material.scattering for material in materials),
        "the coupled diffuse term": shading.diffuse != Shading.diffuse,
        f"{', '.join(parameters)} of the shading": bool(parameters),
        f"{', '.join(image)} of the image": bool(image),
        "the planned level of detail": job.planned is not None,
        "all frames but one": plays,
    }
    return [name for name, omitted in features.items() if omitted]


def _registry() -> dict[str, Any]:
    """Return every model, lobe, Fresnel and masking term, as data for the page's controls."""
    return {
        "models": {
            model.name: {"title": model.title, "k": model.k, "factors": model.factors}
            for model in MODELS.values()
        },
        "lobes": {
            name: {
                "ends": lobe.ends,
                "open": lobe.open_ends,
                "errors": lobe.errors,
                "by_angle": lobe.of_tan2 is not None,
            }
            for name, lobe in (LOBES | {"g-power": lobe_entry(_G_POWER)}).items()
        },
        "fresnel": [*FRESNEL],
        "masking": [*MASKING],
        "defaults": asdict(Term()),
        "small_slope": SMALL_SLOPE,
    }


def _ranges() -> dict[str, Any]:
    """Return the ranges of the numbers that the page changes, as [low, high]."""
    factors = {name: range_of(Material, name) for name in TERM_FACTORS}
    ranges = {
        "term": {**factors, "constant": range_of(Term, "m"), **limits_of(GPower)},
        "camera": {name: range_of(Camera, name) for name in _CAMERA},
        "light": {name: range_of(Light, name) for name in _LIGHT},
        "image": {"exposure": EXPOSURES},
    }
    return {
        table: {name: [limits.low, limits.high] for name, limits in members.items()}
        for table, members in ranges.items()
    }


def _sources() -> dict[str, Any]:
    """Return the GLSL sources of the page's programs, keyed by role."""
    host = shader_dir() / "host"
    lines: dict[str, int] = {}
    return {
        "terms": _terms(lines),
        "lines": [*lines],
        "variance": shader_source("slope_variance"),
        "host": {name: shader_source(str(host / name)) for name in _HOST},
        "lights": {
            name: {"text": shader_source(str(host / f"light/{name}.glsl")), "arrays": light.arrays}
            for name, light in LIGHT_KINDS.items()
        },
        "page": {name: _text(name) for name in _SHADERS},
    }


def _terms(lines: dict[str, int]) -> dict[str, Any]:
    """Return every term, keyed by its names, such as "ward exact", as its function call and the
    indices of its lines in ``lines``. Adds its lines, without the #version line, to ``lines``."""
    lobes: dict[str, AnyLobe] = {**{name: name for name in LOBES}, "g-power": _G_POWER}
    terms = {}
    # Most lines occur in many of the terms: the page is smaller if it has each line once.
    for model, (name, lobe) in product(MODELS.values(), lobes.items()):
        # A lobe of tan^2 has a cheaper text, "plain", which is accurate from SMALL_SLOPE on.
        slopes = {"": MIN_SLOPE}
        if lobe_entry(lobe).of_tan2:
            slopes["plain"] = SMALL_SLOPE
        factors = product(FRESNEL, MASKING) if model.factors else [("", "")]
        for (fresnel, masking), (suffix, smallest) in product(factors, slopes.items()):
            words = filter(None, [model.name, name, fresnel, masking, suffix])
            term = Term(model.name, lobe, fresnel or Term.fresnel, masking or Term.masking)
            text = term_source(term, smallest, "330").rstrip("\n").split("\n")[1:]
            numbers = [lines.setdefault(line, len(lines)) for line in text]
            terms[" ".join(words)] = {"lines": numbers, "call": call(term)}
    return terms


def _light(light: Light, mesh: Mesh) -> dict[str, Any]:
    """Return a light as data, with its direction from the mesh's centre and, for a point light, its
    distance from the centre in the renderer's space."""
    values = {name: getattr(light, name) for name in _LIGHT}
    if light.position is None:
        return values | {"distance": None}
    x, y, z = mesh.normalised(light.position)
    distance = float(np.linalg.norm((x, y, z)))
    azimuth, elevation = np.degrees((np.arctan2(x, z), np.arcsin(y / max(distance, 1e-30))))
    return values | {"azimuth": azimuth, "elevation": elevation, "distance": distance}


# Fields of MeshFile that contain no names.
_NAMELESS = "flip_v allow_outside as_is double_sided occlusion normal_map_y up rotate"


def _words(job: Job) -> dict[str, Any]:
    """Return the mesh's files as command-line arguments, without their directories, and material
    and pose as TOML. If the job is anonymous, options with names are left out."""
    if job.anonymous is not None:
        orientation = {name: getattr(job.mesh, name) for name in _NAMELESS.split()}
        job = replace(job, mesh=MeshFile(job.anonymous, **orientation), parts={}, pose=Pose())
    options = {}
    for name, value in plain(job.mesh, changed=True).items():
        value = PurePath(value).name if name in MESH_PATHS else value
        text = ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
        argument = "" if value is True else f" {shlex.quote(text)}"
        options[name] = f"--{name.replace('_', '-')}{argument}"
    words = [shlex.quote(PurePath(job.mesh.path).name)] if job.mesh.path else []
    words += [options[name] for name in f"{_NAMELESS} parts hide".split() if name in options]
    words += [f"--part {shlex.quote(part_text(*entry))}" for entry in job.parts.items()]
    maps = ("albedo", "normal_map", "specular_map", "roughness_map")
    factors = {n: value for n, value in job.material.items() if n not in (*TERM_FACTORS, *UNDRAWN)}
    pose = plain(job.pose, changed=True)
    if job.pose.vertices is not None:
        pose["vertices"] = PurePath(job.pose.vertices).name
    return {
        "shell": " ".join(words),
        "maps": {name: options[name] for name in maps if name in options},
        "material": toml_text(factors).strip().splitlines(),
        "pose": toml_text({"pose": pose}) if pose else "",
    }


def _text(name: str) -> str:
    return (_BROWSER / name).read_text(encoding="utf-8")


def _script(media_type: str, name: str, content: str) -> str:
    return f'<script type="{media_type}" id="{name}">{content}</script>\n'
