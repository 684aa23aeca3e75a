"""Encodes a mesh and its maps as quantised and compressed data of the explorer's page."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import part_maps
from facerender.drawing.program import part_uniforms, surface_features
from facerender.scenes.material import MAPS, Material
from facerender.scenes.mesh import Mesh, Part, drawn_alpha, slope_range
from facerender.scenes.mips import Kind
from facerender.scenes.texture import Texture
from facerender.shading import Shading

POSITION_STEPS = 2**16 - 1  # Steps across the bounding sphere: 2.6 micrometres each on a head.
NORMAL_STEPS = 2**15 - 1  # Steps per unit of an octahedral coordinate: 0.003 degrees each.
UV_STEPS = 2**16 - 1
VERTEX_STEPS = 10_000  # Steps per unit of the colours and the occlusion at vertices.
LARGEST_MAP = 2048  # Texels per side; every WebGL 2 implementation supports it.
QUALITIES: dict[Kind, tuple[int, ...]] = {
    "color": (93, 97),
    "normal": (95, 98),
    "data": (93, 97),
}
MOST_NAMES = 4  # parts that a note names
LEAST_LOSS = 1.0  # Limit of a JPEG map's mean error, in 8-bit levels; above it, the map is a PNG.


def drawable(mesh: Mesh) -> Mesh:
    """Return a mesh without the features that the page does not draw.

    All parts of the result are opaque. Blended and refracting parts are removed, unless all parts
    are. Materials have no emission. Maps have strength 1 and use the first texture coordinates.
    """
    materials = []
    for material in mesh.materials:
        removed: dict[str, Any] = dict.fromkeys(
            (*_by_second(material), "opacity_map", "emissive_map")
        )
        plain = {"alpha": "opaque", "emissive": 0.0, "second_uv": (), "transmission": 0.0}
        strengths = {"normal_strength": 1.0, "occlusion_strength": 1.0}
        reflectance = {
            "second_slope": 1.0,
            "lobe_weight": 1.0,
            "lobe_map": None,
            "scattering": None,
        }
        materials.append(replace(material, **{**removed, **plain, **strengths, **reflectance}))
    alphas = _alphas(mesh)
    opaque = [number for number, alpha in enumerate(alphas) if alpha != "blend"]
    numbers = opaque or range(len(alphas))
    parts = tuple(mesh.parts[number] for number in numbers)
    return replace(mesh, parts=parts, materials=tuple(materials[number] for number in numbers))


def lost_features(mesh: Mesh) -> list[str]:
    """Return the names of the features of a mesh that the page does not draw."""
    alphas, materials = _alphas(mesh), mesh.materials
    strengths = {(material.normal_strength, material.occlusion_strength) for material in materials}
    blended = [
        part.name for part, alpha in zip(mesh.parts, alphas, strict=True) if alpha == "blend"
    ]
    remainder = [f"{len(blended) - MOST_NAMES} more"] if len(blended) > MOST_NAMES else []
    names = f" ({', '.join([*blended[:MOST_NAMES], *remainder])})" if all(blended) else ""
    features = {
        f"blended parts{names}": bool(blended),
        "masks": "mask" in alphas,
        "emission": any(any(material.emissive) for material in materials),
        "maps with second texture coordinates": any(map(_by_second, materials)),
        "map strengths": strengths != {(1.0, 1.0)},
    }
    return [name for name, lost in features.items() if lost]


def _alphas(mesh: Mesh) -> list[str]:
    """Return how each part is drawn: opaque, mask or blend. Refracting parts count as blended."""
    pairs = zip(mesh.parts, mesh.materials, strict=True)
    return ["blend" if pair[1].refracts else drawn_alpha(*pair) for pair in pairs]


def _by_second(material: Material) -> list[str]:
    return [name for name in MAPS if material.by_second(name)]


def packed(mesh: Mesh) -> tuple[dict[str, Any], bytes, list[tuple[Texture, Kind]]]:
    """Return the facts of a mesh, its compressed arrays, and its maps with their kinds.

    The facts refer to arrays and maps by index.
    """
    columns: list[NDArray[np.int64]] = []
    textures: list[tuple[Texture, Kind]] = []
    pairs, skin = zip(mesh.parts, mesh.materials, strict=True), mesh.skin
    parts = [
        {**_part(mesh, part, material, columns, textures), "skin": number in skin}
        for number, (part, material) in enumerate(pairs)
    ]
    steps = {"position": POSITION_STEPS, "normal": NORMAL_STEPS, "uv": UV_STEPS}
    facts = {
        "steps": steps | {"vertex": VERTEX_STEPS},
        "parts": parts,
        "columns": [list(column.shape) for column in columns],
        "maps": [
            {"kind": kind, "wrap": texture.wrap, "nearest": texture.nearest}
            for texture, kind in textures
        ],
    }
    return facts, zlib.compress(b"".join(map(_planes, columns)), 9), textures


def _part(
    mesh: Mesh,
    part: Part,
    material: Material,
    columns: list[NDArray[np.int64]],
    textures: list[tuple[Texture, Kind]],
) -> dict[str, Any]:
    """Return the facts of a part, and append its arrays and maps to the lists."""
    maps: dict[str, int] = {}
    for name, texture, kind in part_maps(part, material, "color", slope_filter=True):
        if (texture, kind) not in textures:
            textures.append((texture, kind))
        maps[name] = textures.index((texture, kind))
    corner, extent = np.zeros(2), np.ones(2)
    values: dict[str, NDArray[Any]] = {
        "position": (mesh.normalised(part.positions) + 1.0) * (0.5 * POSITION_STEPS),
        "normal": octahedral(part.normals) * NORMAL_STEPS,
        "faces": part.faces,
    }
    if part.uv is not None:
        corner, extent = part.uv.min(axis=0), np.ptp(part.uv, axis=0).clip(1e-9)
        values["uv"] = (part.uv - corner) / extent * UV_STEPS
    if part.colors is not None:
        values["color"] = part.colors * VERTEX_STEPS
    if part.occlusion is not None:
        values["occlusion"] = part.occlusion[:, None] * VERTEX_STEPS
    arrays = {name: len(columns) + i for i, name in enumerate(values)}
    columns += [np.round(column).astype(np.int64) for column in values.values()]
    uniforms: Mapping[str, Any] = part_uniforms(part, material)
    return {
        "features": surface_features(part, material, Shading()),
        "uniforms": {name: np.asarray(value).tolist() for name, value in uniforms.items()},
        "arrays": arrays,
        "uv": [corner.tolist(), extent.tolist()],
        "maps": maps,
        "doubleSided": material.double_sided is not False,
        "slopes": slope_range(part, material),
    }


def octahedral(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map unit vectors (N, 3) to a square, (N, 2) in [-1, 1].

    References: Cigolle et al. (2014), "A survey of efficient representations for independent unit
    vectors".
    """
    flat = normals / np.abs(normals).sum(axis=1, keepdims=True)
    low = flat[:, 2] < 0.0
    folded = (1.0 - np.abs(flat[:, 1::-1])) * np.where(flat[:, :2] < 0.0, -1.0, 1.0)
    return np.asarray(np.where(low[:, None], folded, flat[:, :2]))


def _planes(column: NDArray[np.int64]) -> bytes:
    """Encode integers (N, K) so that deflate compresses them well.

    The result contains the differences of successive rows, with the sign in the lowest bit. The
    four bytes of each difference are stored in four separate planes.
    """
    steps = np.diff(column, axis=0, prepend=0)
    folded = ((steps << 1) ^ (steps >> 63)).astype("<u4")
    return folded.view(np.uint8).reshape(-1, 4).T.tobytes()


def encoded(texture: Texture, kind: Kind) -> bytes:
    """Return a map as an image file with row 0 at the bottom.

    The file is a JPEG if the mean error is below one 8-bit level, otherwise a PNG.

    Raises
    ------
    InputError : the map is damaged
    """
    from PIL import Image

    image = texture.rgb()
    if max(image.size) > LARGEST_MAP:
        scale = LARGEST_MAP / max(image.size)
        width, height = (max(round(side * scale), 1) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    texels = np.asarray(image).astype(np.int16)
    for quality in QUALITIES[kind]:
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, subsampling=0, optimize=True)
        if np.abs(np.asarray(Image.open(file)) - texels).mean() < LEAST_LOSS:
            return file.getvalue()
    file = BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()
