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
from facerender.drawing.program import fixed_attributes, part_uniforms, surface_features
from facerender.scenes.material import MAPS, Material
from facerender.scenes.mesh import Mesh, Part, drawn_alpha, slope_range
from facerender.scenes.mips import Kind
from facerender.scenes.texture import Texture
from facerender.shading import Shading

STEPS = 2**16 - 1  # Positions: 2.6 micrometres each on a head.
LARGEST_MAP = 2048  # Texels per side; every WebGL 2 implementation supports it.
MOST_NAMES = 4  # parts that a note names
# Factors of materials that the page does not draw.
UNDRAWN = (
    *("second_slope", "lobe_weight", "scattering", "normal_strength", "occlusion_strength"),
    *("emissive", "alpha", "alpha_cutoff", "opacity", "transmission", "refraction"),
)
LEAST_LOSS = 1.0  # Limit of a JPEG map's mean error, in 8-bit levels; above it, the map is a PNG.


def drawable(mesh: Mesh) -> Mesh:
    """Return a mesh without the features that the page does not draw.

    All parts of the result are opaque. Blended and refracting parts are removed, unless all parts
    are. Materials have no emission. Maps have strength 1 and use the first texture coordinates.
    """
    names = (*UNDRAWN, "opacity_map", "emissive_map", "lobe_map", "second_uv")
    plain: dict[str, Any] = {name: getattr(Material, name) for name in names}
    alphas = _alphas(mesh)
    opaque = [number for number, alpha in enumerate(alphas) if alpha != "blend"]
    numbers = opaque or range(len(alphas))
    materials = [mesh.materials[number] for number in numbers]
    return replace(
        mesh,
        parts=tuple(mesh.parts[number] for number in numbers),
        materials=tuple(
            replace(material, **(_by_second(material) | plain)) for material in materials
        ),
    )


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


def _by_second(material: Material) -> dict[str, Any]:
    """Return None for each map that uses the second texture coordinates."""
    return dict.fromkeys(name for name in MAPS if material.by_second(name))


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
    facts = {
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
    positions = mesh.normalised(part.positions)
    attributes = {"in_position": positions, "in_normal": part.normals, **fixed_attributes(part)}
    attributes.pop("in_uv2", None)
    arrays = {}
    for name, values in attributes.items():
        low, extent = values.min(axis=0), np.ptp(values, axis=0).clip(1e-9)
        if name == "in_position":  # One grid for all parts: their common borders stay closed.
            low, extent = np.full(3, -1.0), np.full(3, 2.0)
        scale = (extent / STEPS).tolist()
        arrays[name] = {"column": len(columns), "scale": scale, "offset": low.tolist()}
        columns.append(np.round((values - low) / extent * STEPS).astype(np.int64))
    columns.append(part.faces.astype(np.int64))
    uniforms: Mapping[str, Any] = part_uniforms(part, material)
    return {
        "features": surface_features(part, material, Shading()),
        "uniforms": {name: np.asarray(value).tolist() for name, value in uniforms.items()},
        "arrays": arrays,
        "faces": len(columns) - 1,
        "maps": maps,
        "doubleSided": material.double_sided is not False,
        "slopes": slope_range(part, material),
    }


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
    for quality in (95, 98) if kind == "normal" else (93, 97):
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, subsampling=0, optimize=True)
        if np.abs(np.asarray(Image.open(file)) - texels).mean() < LEAST_LOSS:
            return file.getvalue()
    file = BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()
