"""``facerender info``."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import warnings
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from facerender.commands.options import add_options
from facerender.commands.output import print_result
from facerender.commands.scene import fields_set
from facerender.errors import FacerenderWarning, number_of
from facerender.loading import load_mesh
from facerender.material import MAPS, PRESETS, Material
from facerender.mesh import hints
from facerender.mesh.geometry import clips_of
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.scene.job import Job

_ALWAYS = ("albedo", "m", "roughness_factor", "f0", "ks")  # listed even if they are defaults
_NAMES_PER_LINE, _MAX_NAMES = 8, 64  # names of shapes, joints and clips in the text output
_MAX_ROWS = 20  # rows of the table of parts in the text output
_WIDTH = 120  # width of this table for more parts than rows, if the output is no terminal


def add(info: argparse.ArgumentParser) -> None:
    info.set_defaults(command=run)
    info.description = (
        "List the contents of a mesh file as facerender draws them: bounds, size, length\n"
        "of a unit, and for each part triangles, preset, maps and factors; shapes, joints\n"
        "and clips of its rig, repairs, omissions, and hints on probable mistakes. Equal\n"
        f"parts of a mesh with more than {_MAX_ROWS} parts share a row. Factors and maps of\n"
        "other commands apply to the parts that are skin. The command draws nothing."
    )
    add_options(
        info,
        """mesh allow_outside as_is up rotate
--json | print all contents as JSON, also vertices, names of maps and every factor""",
        mesh={"nargs": "?"},
    )


def run(options: argparse.Namespace) -> int:
    file = Job(**fields_set(options, "mesh")).mesh
    source = file.source
    with warnings.catch_warnings(record=True) as caught:  # warnings are part of the result
        warnings.simplefilter("always", FacerenderWarning)
        mesh = load_mesh(file)
    description = {
        "file": str(source.path),
        "format": source.suffix[1:],
        "bytes": len(source.content),
        **description_of(mesh),
        "warnings": list(dict.fromkeys(str(warning.message) for warning in caught)),
    }
    lines = [json.dumps(description, indent=2)] if options.json else _lines(description)
    print_result(*lines)
    return 0


def description_of(mesh: Mesh) -> dict[str, Any]:
    """Return a mesh's description as plain data. Lengths are in mesh units, size_mm is in mm.
    Lengths of clips are in seconds, or None for a damaged clip."""
    size = mesh.bounds[1] - mesh.bounds[0]
    millimetres, skin, face = mesh.millimetres, mesh.skin, mesh.geometry.framing.face
    parts = [
        {**_part(number + 1, *pair), "skin": number in skin}
        for number, pair in enumerate(zip(mesh.parts, mesh.materials, strict=True))
    ]
    return {
        "vertices": sum(part["vertices"] for part in parts),
        "triangles": sum(part["triangles"] for part in parts),
        "bounds": mesh.bounds.tolist(),
        "size": size.tolist(),
        "radius": mesh.radius,
        "millimetres": millimetres,
        "size_mm": None if millimetres is None else (size * millimetres).tolist(),
        "unit": hints.unit_of(mesh) if millimetres is None else None,
        "face": face
        and {
            "score": round(face.score, 3),
            "eyes": face.eyes.tolist(),
            "eye_distance": face.eye_distance,
            "up": face.up.tolist(),
            "front": face.front.tolist(),
        },
        "parts": parts,
        "shapes": list(mesh.shapes),
        "joints": list(mesh.joints),
        "clips": {c.name: None if c.fault else c.duration for c in clips_of(mesh.parts)},
        "hints": hints.of_mesh(mesh),
    }


def _part(number: int, part: Part, material: Material) -> dict[str, Any]:
    values = {field.name: getattr(material, field.name) for field in fields(Material)}
    maps = {name: texture for name in MAPS if (texture := values.pop(name)) is not None}
    return {
        "number": number,
        "name": part.name,
        "vertices": len(part.positions),
        "triangles": len(part.faces),
        "has": [name for name in ("uv", "uv2", "colors") if getattr(part, name) is not None],
        "material": values,
        "preset": part.preset or None,
        "maps": {
            name: {
                "name": texture.name,
                "size": texture.size,
                "encoding": "srgb" if name in ("albedo_map", "emissive_map") else "linear",
                "wrap": texture.wrap,
            }
            for name, texture in maps.items()
        },
    }


def _lines(description: dict[str, Any]) -> list[str]:
    parts = description["parts"]
    low, high = (" ".join(f"{x:.5g}" for x in corner) for corner in description["bounds"])
    lines = [
        f"{description['file']}: {description['format']}, {description['bytes']} bytes",
        f"{number_of(len(parts), 'part')}, {description['vertices']} vertices, "
        f"{description['triangles']} triangles",
        f"from ({low}) to ({high})",
        _size(description),
        _face(description),
    ]
    lines += _table(parts)
    lines += _list("shape", description["shapes"])
    lines += _list("joint", description["joints"])
    clips = description["clips"].items()
    lines += _list("clip", [f"{n} {'damaged' if t is None else f'{t:.4g} s'}" for n, t in clips])
    lines += [f"warning: {warning}" for warning in description["warnings"]]
    return lines + [f"hint: {hint}" for hint in description["hints"]]


def _list(noun: str, names: Sequence[str]) -> list[str]:
    """Return indented lines of names below their number."""
    if not names:
        return []
    starts = range(0, min(len(names), _MAX_NAMES), _NAMES_PER_LINE)
    rows = ["  " + ", ".join(names[i : i + _NAMES_PER_LINE]) for i in starts]
    excess = len(names) - _MAX_NAMES
    remainder = [f"  and {excess} more: --json lists all"] * (excess > 0)
    return [f"{number_of(len(names), noun)}:", *rows, *remainder]


def _table(parts: Sequence[dict[str, Any]]) -> list[str]:
    """Return a table of parts. Of many parts, parts with equal materials share a row. The rows with
    the most triangles are listed, then the names of the parts that share a row."""
    many = len(parts) > _MAX_ROWS
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for part in parts:
        groups.setdefault(_cells(part) if many else (part["number"],), []).append(part)
    sizes = {key: sum(part["triangles"] for part in group) for key, group in groups.items()}
    largest = sorted(groups, key=lambda key: -sizes[key])[:_MAX_ROWS]
    rows: list[tuple[str, ...]] = [("part", "triangles", "skin", "preset", "maps", "material")]
    shared, remainder = [], 0
    for key, group in groups.items():
        if key not in largest:
            remainder += len(group)
            continue
        title, *others = (part["name"] or "(no name)" for part in group)
        if others:
            title = f"{title} (+{len(others)})"
            shared.append(f"{title}: {', '.join(others)}")
        rows.append((title, str(sizes[key]), *_cells(group[0])))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    form = "  ".join(f"{{:{'>' if n == 1 else '<'}{width}}}" for n, width in enumerate(widths))
    lines = [form.format(*row).rstrip() for row in rows]
    if not many:
        return lines
    if remainder:
        triangles = sum(sizes.values()) - sum(sizes[key] for key in largest)
        lines.append(f"and {remainder} more parts with {triangles} triangles")
    lines += shared
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else _WIDTH
    lines = [line if len(line) <= width else f"{line[: width - 4]} ..." for line in lines]
    return [*lines, "--json lists all parts with their materials"]


def _cells(part: dict[str, Any]) -> tuple[str, ...]:
    """Return a part's cells of the table: skin, preset, maps, factors."""
    maps = []
    for name, texture in part["maps"].items():
        width, height = texture["size"]
        size = f"{width}" if width == height else f"{width}x{height}"
        maps.append(f"{name.removesuffix('_map')} {size}")
    maps += ["vertex colours"] * ("colors" in part["has"]) + ["no uv"] * ("uv" not in part["has"])
    skin = "yes" if part["skin"] else "-"
    return skin, part["preset"] or "-", ", ".join(maps) or "-", _factors(part) or "-"


def _size(description: dict[str, Any]) -> str:
    size = " x ".join(f"{extent:.4g}" for extent in description["size"])
    if description["millimetres"] is not None:
        size_mm = " x ".join(f"{extent:.4g}" for extent in description["size_mm"])
        return f"{size} units of {description['millimetres']:g} mm: {size_mm} mm"
    text = f"{size} units of unknown length"
    return f"{text}: {description['unit']}" if description["unit"] else text


def _face(description: dict[str, Any]) -> str:
    """Return the face in words."""
    if (face := description["face"]) is None:
        return "no face found"
    left, right = (" ".join(f"{x:.4g}" for x in eye) for eye in face["eyes"])
    return (
        f"face with score {face['score']:.2f}: eyes at ({left}) and ({right}), "
        f"{face['eye_distance']:.4g} units apart"
    )


def _factors(part: dict[str, Any]) -> str:
    """Return the factors of a part that its preset or, without one, the defaults do not set."""
    defaults = {f.name: f.default for f in fields(Material) if f.name not in _ALWAYS}
    defaults |= {"double_sided": False, **PRESETS.get(part["preset"], {})}
    factors = dict(part["material"])
    factors.pop("m" if "roughness_map" in part["maps"] else "roughness_factor")
    return ", ".join(
        f"{name} {_text(value)}"
        for name, value in factors.items()
        if name not in defaults or value != defaults[name]
    )


def _text(value: Any) -> str:
    if isinstance(value, tuple | list):
        return " ".join(map(_text, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)
