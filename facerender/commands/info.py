"""``facerender info``."""

from __future__ import annotations

import argparse
import json
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

from facerender.commands.common import add_allow_outside, add_flag, add_mesh, import_trimesh
from facerender.commands.streams import print_result
from facerender.errors import FacerenderWarning
from facerender.loading import load_mesh
from facerender.scenes import hints
from facerender.scenes.material import MAPS, Material
from facerender.scenes.mesh import Mesh, Part
from facerender.system.data import data_dir

_SRGB = ("albedo_map", "emissive_map")
_ALWAYS = ("albedo", "f0", "ks", "alpha")  # listed even if the values are defaults


def add(info: argparse.ArgumentParser) -> None:
    info.set_defaults(command=run)
    info.description = (
        "List the contents of a mesh file as facerender draws them: parts, vertices,\n"
        "triangles, materials, maps, bounds, size, length of a unit, repairs,\n"
        "omissions, and hints on probable mistakes. The command draws nothing."
    )
    add_mesh(info)
    add_allow_outside(info)
    add_flag(info, "json", "print the contents, with every material factor, as JSON")


def run(options: argparse.Namespace) -> int:
    import_trimesh(options.mesh)
    with warnings.catch_warnings(record=True) as caught:  # warnings are part of the result
        warnings.simplefilter("always", FacerenderWarning)
        mesh = load_mesh(options.mesh, allow_outside=options.allow_outside)
    path = Path(options.mesh) if options.mesh else data_dir("assets") / "head.glb"
    facts = {
        "file": str(path),
        "format": path.suffix.lower()[1:],
        "bytes": path.stat().st_size,
        **facts_of(mesh),
        "warnings": list(dict.fromkeys(str(each.message) for each in caught)),
    }
    print_result(json.dumps(facts, indent=2) if options.json else "\n".join(_lines(facts)))
    return 0


def facts_of(mesh: Mesh) -> dict[str, Any]:
    """Return a mesh's description as plain data. Lengths are in mesh units, size_mm is in mm."""
    size = mesh.bounds[1] - mesh.bounds[0]
    known = mesh.millimetres
    parts = [
        _part(number, *pair)
        for number, pair in enumerate(zip(mesh.parts, mesh.materials, strict=True), 1)
    ]
    return {
        "vertices": sum(each["vertices"] for each in parts),
        "triangles": sum(each["triangles"] for each in parts),
        "bounds": mesh.bounds.tolist(),
        "size": size.tolist(),
        "radius": mesh.radius,
        "millimetres": known,
        "size_mm": None if known is None else (size * known).tolist(),
        "millimetres_of_a_head": hints.millimetres_of(mesh),
        "parts": parts,
        "hints": hints.of_mesh(mesh),
    }


def _part(number: int, part: Part, material: Material) -> dict[str, Any]:
    maps = {name: texture for name in MAPS if (texture := getattr(material, name)) is not None}
    factors = {
        each.name: getattr(material, each.name)
        for each in fields(Material)
        if each.name not in MAPS
    }
    return {
        "number": number,
        "name": part.name,
        "vertices": len(part.positions),
        "triangles": len(part.faces),
        "has": [name for name in ("uv", "uv2", "colors") if getattr(part, name) is not None],
        "material": factors,
        "maps": {
            name: {
                "name": texture.name,
                "size": texture.size,
                "encoding": "srgb" if name in _SRGB else "linear",
                "wrap": texture.wrap,
            }
            for name, texture in maps.items()
        },
    }


def _lines(facts: dict[str, Any]) -> list[str]:
    parts = facts["parts"]
    low, high = (" ".join(f"{each:.5g}" for each in corner) for corner in facts["bounds"])
    lines = [
        f"{facts['file']}: {facts['format']}, {facts['bytes']} bytes",
        f"{len(parts)} part{'s' * (len(parts) > 1)}, {facts['vertices']} vertices, "
        f"{facts['triangles']} triangles",
        f"from ({low}) to ({high})",
        _size(facts),
    ]
    for part in parts:
        has = "".join(f", {each}" for each in part["has"])
        name = part["name"] or "without a name"
        lines += [
            f"part {part['number']}: {name}",
            f"    {part['vertices']} vertices, {part['triangles']} triangles{has}",
            f"    {_factors(part)}",
        ]
        for kind, own in part["maps"].items():
            width, height = own["size"]
            lines.append(f"    {kind} {width} x {height}, {own['encoding']}: {own['name']}")
    lines += [f"warning: {each}" for each in facts["warnings"]]
    return lines + [f"hint: {each}" for each in facts["hints"]]


def _size(facts: dict[str, Any]) -> str:
    size = " x ".join(f"{each:.4g}" for each in facts["size"])
    if facts["millimetres"] is not None:
        size_mm = " x ".join(f"{each:.4g}" for each in facts["size_mm"])
        return f"{size} units of {facts['millimetres']:g} mm: {size_mm} mm"
    if (length := facts["millimetres_of_a_head"]) is None:
        return f"{size} units of unknown length"
    return (
        f"{size} units of unknown length: for a head of about {hints.HEAD:g} mm, give "
        f"{hints.option(length)}"
    )


def _factors(part: dict[str, Any]) -> str:
    defaults = {each.name: each.default for each in fields(Material)}
    own = dict(part["material"])
    own.pop("m" if "roughness_map" in part["maps"] else "roughness_factor")
    always = (*_ALWAYS, "m", "roughness_factor")
    return ", ".join(
        f"{name} {_text(value)}"
        for name, value in own.items()
        if name in always or value != defaults[name]
    )


def _text(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_text, value))})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
