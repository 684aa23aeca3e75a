"""Read MTL files: the materials of an OBJ file and their maps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.conventions import preset_for
from facerender.loading.source import References, text_of
from facerender.material import MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Material
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE
from facerender.texture.texture import Texture
from facerender.values.vectors import MAX_RADIANCE, Vector

if TYPE_CHECKING:
    from PIL.Image import Image


# Height of white above black in a bump map, as a fraction of the map's width. The height is 2.5 mm
# for a map that wraps once around a head of 500 mm circumference. MTL defines no unit of height.
DEPTH = 0.005
_STRIP = 256  # rows of a bump map converted at a time


def _is_normal_map(image: Image) -> bool:
    """Return whether a bump map has normals, not heights: it is bluish, with unit vectors."""
    if image.mode not in ("RGB", "RGBA", "P"):
        return False
    levels = np.asarray(image.convert("RGB").resize((64, 64)), dtype=np.float64)
    if np.ptp(levels, axis=-1).mean() < 8.0:  # a grey image, with compression errors
        return False
    normals = levels / 127.5 - 1.0
    length = np.linalg.norm(normals, axis=-1)
    return bool((np.abs(length - 1.0) < 0.25).mean() > 0.9 and normals[..., 2].mean() > 0.5)


def _normals(image: Image) -> Image:
    """Convert heights in any image mode to a normal map with green up."""
    from PIL import Image as images

    deep = image.mode.startswith(("I", "F"))
    heights = np.asarray(image if deep else image.convert("L"))
    scale = 1.0 if image.mode == "F" else 65535.0 if deep else 255.0
    height, width = heights.shape
    normals = np.empty((height, width, 3), dtype=np.uint8)
    for top in range(0, height, _STRIP):
        start, end = max(top - 1, 0), min(top + _STRIP, height)
        rows = heights[start : end + 1].astype(np.float32) * np.float32(DEPTH / scale)
        rows = np.pad(rows, [(0, size < 2) for size in rows.shape], "edge")  # a slope of 0
        down, right = (slope[top - start : end - start, :width] for slope in np.gradient(rows))
        # A normal's x is minus the slope; y is plus the slope, because rows run down and y up.
        slopes = np.stack([-right * width, down * height], axis=-1)
        length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
        unit = np.concatenate([slopes, np.ones_like(length)], axis=-1) / length
        normals[top:end] = np.round(unit * 127.5 + 127.5)
    result = images.fromarray(normals)
    result.info["heights"] = True  # its green points up, whatever the direction in normal maps
    return result


# Keyed by statement: field of the material, name in messages. If a material has several statements
# for a field, the first of them in this table is used.
_MAPS = {
    "map_kd": ("albedo_map", "albedo"),
    "map_d": ("opacity_map", "opacity"),
    "norm": ("normal_map", "normal"),
    "map_bump": ("normal_map", "bump"),
    "bump": ("normal_map", "bump"),
    "map_ks": ("specular_map", "specular"),
    "map_ke": ("emissive_map", "emission"),
    "map_pr": ("roughness_map", "roughness"),
}
# Keyed by option of a map: number of words after the option; the last of 2 or 3 may be missing.
_FLAGS = ("-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type")
_OPTIONS = {**dict.fromkeys(_FLAGS, 1), "-mm": 2, "-o": 3, "-s": 3, "-t": 3}
# Ignored options, each with the value that has no effect; other values cause a warning.
_UNREAD = {"-cc": "off", "-boost": "0", "-blendu": "on", "-blendv": "on"}
# Statements that are read, and statements without an effect except on ambient light.
_KNOWN = {"kd", "ks", "ns", "ke", "d", "tr", "tf", "pr", *_MAPS}
_KNOWN |= {"ka", "map_ka", "illum", "ni", "sharpness", "map_aat"}
_LAYERS = {"pm", "ps", "pc", "pcr", "aniso", "anisor"}  # not supported; no effect if 0


@dataclass
class MapStatement:
    """The statement of a map: file name and options."""

    name: str = ""
    scale: tuple[float, ...] = (1.0, 1.0)  # of texture coordinates; v points up
    offset: tuple[float, ...] = (0.0, 0.0)
    clamp: bool = False
    strength: float = 1.0
    channel: str = ""


class Library:
    """The materials of an OBJ file."""

    def __init__(self, names: Iterable[str], referred: References, albedo_given: bool) -> None:
        """Read the MTL files with the names after mtllib; errors as of :meth:`References.read`."""
        self.referred = referred
        self.name = referred.name
        self.albedo_given = albedo_given
        self.materials: dict[str, dict[str, str]] = {}
        self.textures: dict[tuple[Any, ...], Texture | None] = {}
        self.images: dict[str, Texture] = {}
        self.warn = cache(warn)  # emits each warning once
        for line in dict.fromkeys(names):
            if not self._parse(line) and True in [self._parse(word) for word in line.split()]:
                del referred.files[line]  # not one name, but several

    def _parse(self, name: str) -> bool:
        """Read the statements of an MTL file. Return whether the file was found."""
        try:
            text = text_of(self.referred.read(name, "an MTL file"))
        except FileNotFoundError:
            return False
        statements: dict[str, str] = {}
        for line in text.splitlines():
            key, _, arguments = line.strip().partition("#")[0].replace("\t", " ").partition(" ")
            key, arguments = key.lower(), arguments.strip()
            if key == "newmtl":
                statements = self.materials.setdefault(" ".join(arguments.split()), {})
            elif arguments:
                statements[key] = arguments.replace("-halo", "") if key == "d" else arguments
        return True

    def matched(self, names: Sequence[str]) -> list[str]:
        """Return a material for the name that each part of the OBJ file has, which is "" without
        usemtl. If all parts have one name, they get the only material of an MTL file. Warn of names
        that the MTL file lacks."""
        valid_names, missing = [*self.materials], sorted({*names} - self.materials.keys())
        if not valid_names or not missing:
            return [*names]
        listing = clipped(", ".join(valid_names), 120)
        if len(valid_names) == len({*names}) == 1:
            if names[0]:
                self.warn(
                    f"{self.name} uses the material {clipped(names[0], 60)}, but its MTL has only "
                    f"{listing}: this is used"
                )
            return valid_names * len(names)
        for name in missing:
            used = f"uses the material {clipped(name, 60)}" if name else "has faces without usemtl"
            self.warn(
                f"{self.name} {used}, and its MTL has the materials {listing}: drawn without a "
                "material; correct usemtl in the OBJ file"
            )
        return [*names]

    def material_uv(self, name: str, has_colors: bool) -> tuple[Material, MapStatement]:
        """Return a material and its first map, which transforms its texture coordinates, or the
        default material if the name is not defined."""
        white = (1.0, 1.0, 1.0)
        if (statements := self.materials.get(name)) is None:
            return Material(albedo=white if has_colors else SKIN_ALBEDO), MapStatement()
        for key in statements.keys() - _KNOWN:
            if key not in _LAYERS or any(self._numbers(statements, key)):
                self.warn(f"{self.name} has {clipped(key, 40)} in its MTL: ignored")
        maps: dict[str, MapStatement] = {}
        for key, (field, _) in _MAPS.items():
            if key in statements and field not in maps:
                statement = self._options(key, statements[key])
                if statement.name:
                    maps[field] = statement
        fields: dict[str, Any] = {field: self._texture(field, s) for field, s in maps.items()}
        first = next(iter(maps.values()), MapStatement())  # that of the albedo, if there is one
        for statement in maps.values():
            if (statement.scale, statement.offset) != (first.scale, first.offset):
                self.warn(
                    f"{clipped(statement.name, 80)} (named by {self.name}) has other options -s "
                    f"and -o than {clipped(first.name, 80)}: ignored, because all maps of a "
                    "material have one scale and offset"
                )
        if "normal_map" in maps:
            fields["normal_strength"] = maps["normal_map"].strength
        has_albedo_map = fields.get("albedo_map") is not None
        albedo = self._color(statements, "kd", white)
        if "map_kd" in statements and not has_albedo_map and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # the file's white multiplies only the missing map
        # With an albedo map or vertex colours, Kd is ignored: exporters write an arbitrary grey.
        fields["albedo"] = white if has_albedo_map or has_colors else albedo
        emissive = self._color(statements, "ke", (0.0, 0.0, 0.0))
        fields["emissive"] = emissive if any(emissive) or "map_ke" not in statements else white
        fields |= self._opacity(name, statements) | self._highlight(name, statements)
        return Material(**fields), first

    def _numbers(self, statements: Mapping[str, str], key: str) -> list[float]:
        """Return the numbers of a statement; an empty list if a word is not a finite number."""
        words = statements.get(key, "").split()
        if key in statements and not (words and all(map(_is_number, words))):
            self.warn(f"{self.name} has {key} {clipped(statements[key], 40)} in its MTL: ignored")
            return []
        return [float(word) for word in words]

    def _clamped(self, key: str, value: float, high: float = 1.0) -> float:
        if not 0.0 <= value <= high:
            problem = f"is outside [0, {high:g}]: clamped"
            self.warn(f"{key} {value:.6g} in the MTL of {self.name} {problem}")
        return min(max(value, 0.0), high)

    def _color(self, statements: Mapping[str, str], key: str, default: Vector) -> Vector:
        """Return a colour as linear RGB; the file stores sRGB."""
        if not (numbers := self._numbers(statements, key)):
            return default
        rgb = numbers[:3] if len(numbers) >= 3 else numbers[:1] * 3
        high = MAX_RADIANCE if key == "ke" else 1.0
        srgb = np.array([self._clamped(key, channel, high) for channel in rgb])
        red, green, blue = np.minimum(srgb_to_linear(srgb), MAX_RADIANCE).tolist()
        return red, green, blue

    def _opacity(self, name: str, statements: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields alpha and opacity. Alpha is "blend" for an opacity below 1 or a map of
        fine hairs, else "mask" with an opacity map, else "opaque"."""
        opacity = self._clamped("d", (self._numbers(statements, "d") or [1.0])[0])
        if "d" not in statements and (tr := self._numbers(statements, "tr")):
            opacity = 1.0 - self._clamped("Tr", tr[0])
            if not opacity:  # exporters that write Tr 1 for all materials mean d 1
                self.warn(f"{self.name} has Tr 1 in its MTL, fully transparent: drawn opaque")
                opacity = 1.0
        tf = self._numbers(statements, "tf")
        if any(tf) and {*tf} != {1.0}:
            self.warn(f"{self.name} has Tf (transmission) in its MTL: ignored")
        alpha = "mask" if "map_d" in statements else "opaque"
        is_hair = preset_for(name) in ("lashes", "hair-card")  # a mask makes it black or jagged
        if opacity < 1.0 or (alpha == "mask" and is_hair):
            alpha = "blend"
        return {"alpha": alpha, "opacity": opacity}

    def _highlight(self, name: str, statements: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields ks and m. m is Pr^2 or, without Pr, sqrt(2 / (Ns + 2)) with the
        Blinn-Phong exponent Ns: Walter et al. (2007), Microfacet models for refraction, 5.2."""
        fields: dict[str, Any] = {}
        ks, ns, pr = (self._numbers(statements, key) for key in ("ks", "ns", "pr"))
        if self.ignores_ks(name):
            ns = []
        elif any(ks):
            fields["ks"] = self._clamped("Ks", sum(ks[:3]) / len(ks[:3]))
        if pr and (pr[0] or "map_pr" not in statements):
            fields["m"] = max(self._clamped("Pr", pr[0]) ** 2, MIN_SLOPE)
        elif ns and ns[0] > 0.0:
            fields["m"] = min(max(math.sqrt(2.0 / (ns[0] + 2.0)), MIN_SLOPE), MAX_SLOPE)
        return fields

    def ignores_ks(self, name: str) -> bool:
        """Return whether Ks of a material is 0 without a map. Many exporters write this by default,
        so that skin gets its highlights nevertheless; see :func:`facerender.mesh.hints.no_ks`."""
        statements = self.materials.get(name, {})
        ks = self._numbers(statements, "ks")
        return bool(ks) and not any(ks) and "map_ks" not in statements

    def warn_of_tiles(self, name: str, uv: NDArray[np.float64]) -> None:
        """Warn if a map is a UDIM tile, and the faces' uv, (F, 3, 2), are on several tiles."""
        maps = [text for key, text in self.materials.get(name, {}).items() if key in _MAPS]
        if not any(re.search(r"(?<!\d)1001(?!\d)", text) for text in maps):
            return
        if (tiles := len(np.unique(np.floor(uv.mean(axis=1)), axis=0))) > 1:
            self.warn(
                f"a map of {self.name} is UDIM tile 1001: drawn on all {tiles} tiles; "
                "export one map per part"
            )

    def _options(self, key: str, text: str) -> MapStatement:
        """Parse the statement of a map."""
        statement = MapStatement(channel="normal" if key == "norm" else "")
        words = re.findall("[^ ]+ *", text)  # keeps the spaces of file names
        while words and (option := words[0].strip().lower()) in _OPTIONS:
            values = [word.strip() for word in words[1 : 1 + _OPTIONS[option]]]
            if _OPTIONS[option] > 1:
                values = [*takewhile(_is_number, values)]
            del words[: 1 + len(values)]
            numbers = [float(value) for value in values if _is_number(value)]
            if option == "-s":
                statement.scale = (*numbers[:2], *statement.scale[len(numbers) :])
            elif option == "-o":
                statement.offset = (*numbers[:2], *statement.offset[len(numbers) :])
            elif option == "-bm" and numbers:
                statement.strength = self._clamped("-bm", numbers[0], MAX_NORMAL_STRENGTH)
            elif option == "-clamp":
                statement.clamp = values == ["on"]
            elif option == "-imfchan" and values:
                statement.channel = values[0]
            elif (
                (option == "-t" and any(numbers))
                or (option == "-mm" and numbers != [0.0, 1.0])
                or (option in _UNREAD and values != [_UNREAD[option]])
            ):
                map_name = _MAPS[key][1]
                self.warn(f"the {map_name} map of {self.name} has the option {option}: ignored")
        statement.name = "".join(words).strip().strip('"')
        return statement

    def _texture(self, field: str, statement: MapStatement) -> Texture | None:
        """Return the texture of a map, or None if its image is missing or unreadable."""
        key = field, statement.name, statement.channel, statement.clamp
        if key in self.textures:
            return self.textures[key]
        self.textures[key] = None
        map_name, silent = field.removesuffix("_map"), field == "albedo_map"
        content = self.referred.image(statement.name, map_name, not self.albedo_given, silent)
        if content is None:
            return None
        name = clipped(statement.name, 80)
        uses_alpha = field == "opacity_map" and statement.channel in ("", "m")
        if field == "normal_map" and statement.channel != "normal":
            texture = Texture.of(content, name).changed(
                lambda image: image if _is_normal_map(image) else _normals(image)
            )
        elif uses_alpha and (alpha := Texture.alpha_of(content, name)) is not None:
            texture = alpha
        else:
            texture = self.images.get(name) or Texture.of(content, name)
            self.images[name] = texture
            if field in ("opacity_map", "roughness_map", "specular_map"):
                texture = texture.channel({"g": 1, "b": 2}.get(statement.channel, 0), name)
        texture = texture.sampled(("clamp", "clamp")) if statement.clamp else texture
        self.textures[key] = texture
        return texture


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
