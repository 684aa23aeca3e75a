"""What a mesh is drawn with: its maps, started ahead. No OpenGL here."""

from __future__ import annotations

from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.texture import Kind, Texture


def part_maps(part: Part, material: Material, albedo: Kind) -> list[tuple[str, Texture, Kind]]:
    """Return the maps that a part is drawn with: name, texture, kind of mip chain.

    albedo is the kind for the albedo map: "color" or "linear-color".
    """
    if part.uv is None:
        return []
    candidates: list[tuple[str, Texture | None, Kind]] = [
        ("albedo_map", material.albedo_map, albedo),
        ("normal_map", material.normal_map, "data"),
        ("property_map", material.property_map, "data"),
    ]
    return [(name, texture, kind) for name, texture, kind in candidates if texture is not None]


def start_maps(mesh: Mesh, albedo: Kind = "color") -> None:
    """Start decoding the maps of a mesh in threads, ahead of the renderer that waits for them."""
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        for _, texture, kind in part_maps(part, material, albedo):
            texture.levels(kind)
