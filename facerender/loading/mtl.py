"""Read MTL files: the materials of an OBJ file and their maps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.images.image import srgb_to_linear
from facerender.loading.conventions import preset_for
from facerender.loading.source import References, WarnOnce, image_of, text_of, unreadable
from facerender.scenes.material import MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Material
from facerender.scenes.texture import Texture
from facerender.scenes.vectors import MOST_RADIANCE, Vector
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE

if TYPE_CHECKING:
    from PIL.Image import Image


# Height of white above black in a bump map, as a fraction of the map's width. The height is 2.5 mm
# for a map that wraps once around a head of 500 mm circumference. MTL defines no unit of height.
DEPTH = 0.005
_STRIP = 256  # rows of a bump map converted at a time


def _bump(image: Image, name: str) -> Texture:
    """Return the normal map of a bump map. Decoding tests the colours of the image: a grey image
    contains heights; a bluish image of vectors of length 1 already contains normals."""

    def decode() -> Image:
        try:
            return image if _is_normal_map(image) else _normals(image)
        except Exception as error:  # Pillow's decoders raise many exceptions
            raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None

    return Texture(decode, name, image.size)


def _is_normal_map(image: Image) -> bool:
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
        start, end = max(top - 1, 0), min(top + _STRIP + 1, height)
        strip = slice(top - start, min(top + _STRIP, height) - start)
        rows = heights[start:end].astype(np.float32) * np.float32(DEPTH / scale)
        # A normal's x is minus the slope; y is plus the slope, because rows run down and y up.
        slopes = np.stack([-_slope(rows, 1) * width, _slope(rows, 0) * height], axis=-1)[strip]
        length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
        unit = np.concatenate([slopes, np.ones_like(length)], axis=-1) / length
        normals[top : top + _STRIP] = np.round(unit * 127.5 + 127.5)
    result = images.fromarray(normals)
    result.info["heights"] = True  # its green points up, whatever the direction in normal maps
    return result


def _slope(rows: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the height difference per texel along an axis; 0 if the axis has only one texel."""
    flat = rows.shape[axis] < 2
    return np.zeros_like(rows) if flat else np.asarray(np.gradient(rows, axis=axis))


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
_OPTIONS = {
    **dict.fromkeys(("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type"), 1),
    **dict.fromkeys(("-bm", "-boost", "-texres"), 1),
    "-mm": 2,
    **dict.fromkeys(("-o", "-s", "-t"), 3),
}
# Ignored options, each with the value that has no effect; other values cause a warning.
_UNREAD = {"-cc": "off", "-boost": "0", "-blendu": "on", "-blendv": "on"}
_CHANNELS = {"r": 0, "g": 1, "b": 2}
# Statements ignored without a warning: they have no effect, or an effect on ambient light only.
_IGNORED = {"ka", "map_ka", "illum", "ni", "sharpness", "map_aat"}
_READ = {"kd", "ks", "ns", "ke", "d", "tr", "tf", "pr", *_MAPS}
_FINE = ("lashes", "hair-card")  # presets of hairs that a mask would make black or jagged
_LAYERS = {"pm", "ps", "pc", "pcr", "aniso", "anisor"}  # not supported; no effect if 0


class UvSpread(NamedTuple):
    """Scale and offset of texture coordinates (options -s and -o of a map); v points up."""

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    def applied(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return transformed texture coordinates (N, 2)."""
        return uv if self == UvSpread() else uv * self.scale + self.offset


@dataclass
class _Map:
    """The statement of a map: file name and options."""

    name: str
    uv: UvSpread = UvSpread()
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
        self.looks: dict[tuple[str, bool], tuple[Material, UvSpread]] = {}
        self.textures: dict[tuple[Any, ...], Texture | None] = {}
        self.warn = WarnOnce()
        for line in dict.fromkeys(names):
            for content in self._contents(line):
                self._parse(content)

    def _contents(self, line: str) -> list[str]:
        """Return the content of the MTL file with the name ``line`` or, if this file is missing,
        the contents of the files with the words of ``line`` as names."""
        with suppress(FileNotFoundError):
            return [text_of(self.referred.read(line, "an MTL file"))]
        contents = []
        for word in line.split() if " " in line else ():
            with suppress(FileNotFoundError):
                contents.append(text_of(self.referred.read(word, "an MTL file")))
        if contents:
            del self.referred.files[line]
        return contents

    def _parse(self, text: str) -> None:
        statements: dict[str, str] = {}
        for line in text.splitlines():
            key, _, arguments = line.strip().partition("#")[0].replace("\t", " ").partition(" ")
            if key.lower() == "newmtl":
                statements = self.materials.setdefault(" ".join(arguments.split()), {})
            elif arguments.strip():
                statements[key.lower()] = arguments.strip()

    def matched(self, names: Sequence[str]) -> list[str]:
        """Return a material for the name that each part of the OBJ file has, which is "" without
        usemtl. If all parts have one name, they get the only material of an MTL file. Warn of names
        that the MTL file lacks."""
        known, missing = [*self.materials], sorted({*names} - self.materials.keys())
        if not known or not missing:
            return [*names]
        listing = clipped(", ".join(known), 120)
        if len(known) == len({*names}) == 1:
            if names[0]:
                self.warn(
                    f"{self.name} uses the material {clipped(names[0], 60)}, but its MTL has only "
                    f"{listing}: this is used"
                )
            return known * len(names)
        for name in missing:
            used = f"uses the material {clipped(name, 60)}" if name else "has faces without usemtl"
            self.warn(
                f"{self.name} {used}, and its MTL has the materials {listing}: drawn without a "
                "material; correct usemtl in the OBJ file"
            )
        return [*names]

    def look(self, name: str, has_colors: bool) -> tuple[Material, UvSpread]:
        """Return a material and the transform of its texture coordinates, or the default material
        if the name is not defined."""
        if (name, has_colors) not in self.looks:
            self.looks[name, has_colors] = self._look(name, has_colors)
        return self.looks[name, has_colors]

    # --- factors ---------------------------------------------------------------------------------

    def _look(self, name: str, has_colors: bool) -> tuple[Material, UvSpread]:
        white = (1.0, 1.0, 1.0)
        if (statements := self.materials.get(name)) is None:
            return Material(albedo=white if has_colors else SKIN_ALBEDO), UvSpread()
        for key in statements.keys() - _READ - _IGNORED:
            if key not in _LAYERS or any(self._numbers(statements, key)):
                self.warn(f"{self.name} has {clipped(key, 40)} in its MTL: ignored")
        uses = self._uses(statements)
        changes: dict[str, Any] = {key: self._map(key, use) for key, use in uses.items()}
        has_albedo_map = changes.get("albedo_map") is not None
        first = uses.get("albedo_map") or next(iter(uses.values()), _Map(""))
        for use in uses.values():
            if use.uv != first.uv:
                self.warn(
                    f"{clipped(use.name, 80)} (named by {self.name}) has other options -s and -o "
                    f"than {clipped(first.name, 80)}: ignored, because all maps of a material have "
                    "one scale and offset"
                )
        albedo = self._color(statements, "kd") or white
        if "map_kd" in statements and not has_albedo_map and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # the file's white multiplies only the missing map
        # With an albedo map or vertex colours, Kd is ignored: exporters write an arbitrary grey.
        changes["albedo"] = white if has_albedo_map or has_colors else albedo
        emissive = self._color(statements, "ke") or (0.0, 0.0, 0.0)
        changes["emissive"] = emissive if any(emissive) or "map_ke" not in statements else white
        changes |= self._opacity(statements, "map_d" in statements)
        if changes["alpha"] == "mask" and preset_for(name) in _FINE:
            changes["alpha"] = "blend"
        changes |= self._highlight(name, statements)
        if "normal_map" in uses:
            changes["normal_strength"] = uses["normal_map"].strength
        return Material(**changes), first.uv

    def _numbers(self, statements: Mapping[str, str], key: str) -> list[float]:
        """Return the numbers of a statement; an empty list if a word is not a finite number."""
        try:
            numbers = [float(word) for word in statements.get(key, "").split()]
        except ValueError:
            numbers = []
        if key in statements and not (numbers and all(map(math.isfinite, numbers))):
            self.warn(f"{self.name} has {key} {clipped(statements[key], 40)} in its MTL: ignored")
            return []
        return numbers

    def _within(self, key: str, value: float, low: float, high: float) -> float:
        if not low <= value <= high:
            self.warn(
                f"{key} {value:.6g} in the MTL of {self.name} is outside [{low:g}, {high:g}]: "
                "clamped"
            )
        return min(max(value, low), high)

    def _color(self, statements: Mapping[str, str], key: str) -> Vector | None:
        """Return a colour as linear RGB; the file stores sRGB."""
        numbers = self._numbers(statements, key)
        if not numbers:
            return None
        rgb = numbers[:3] if len(numbers) >= 3 else numbers[:1] * 3
        high = MOST_RADIANCE if key == "ke" else 1.0
        srgb = np.array([self._within(key, channel, 0.0, high) for channel in rgb])
        red, green, blue = np.minimum(srgb_to_linear(srgb), MOST_RADIANCE).tolist()
        return red, green, blue

    def _opacity(self, statements: Mapping[str, str], has_map: bool) -> dict[str, Any]:
        """Return the fields alpha and opacity. Alpha is "blend" for an opacity below 1, else "mask"
        with an opacity map, else "opaque"."""
        numbers = self._numbers({"d": statements.get("d", "1").replace("-halo", "")}, "d")
        opacity = self._within("d", (numbers or [1.0])[0], 0.0, 1.0)
        if "d" not in statements and (tr := self._numbers(statements, "tr")):
            opacity = 1.0 - self._within("Tr", tr[0], 0.0, 1.0)
            if not opacity:  # exporters that write Tr 1 for all materials mean d 1
                self.warn(f"{self.name} has Tr 1 in its MTL, fully transparent: drawn opaque")
                opacity = 1.0
        tf = self._numbers(statements, "tf")
        if len({*tf, 1.0}) > 1 and any(tf):
            self.warn(f"{self.name} has Tf (transmission) in its MTL: ignored")
        kind = "blend" if opacity < 1.0 else "mask" if has_map else "opaque"
        return {"alpha": kind, "opacity": opacity}

    def _highlight(self, name: str, statements: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields ks and m. m is Pr^2 or, without Pr, sqrt(2 / (Ns + 2)) with the
        Blinn-Phong exponent Ns.

        References: Walter et al. (2007), Microfacet models for refraction, section 5.2.
        """
        fields: dict[str, Any] = {}
        ks, ns, pr = (self._numbers(statements, key) for key in ("ks", "ns", "pr"))
        if self.ignores_ks(name):
            ns = []
        elif any(ks):
            mean = sum(ks[:3]) / len(ks[:3])
            fields["ks"] = self._within("Ks", mean, 0.0, 1.0)
        if pr and (pr[0] or "map_pr" not in statements):
            fields["m"] = max(self._within("Pr", pr[0], 0.0, 1.0) ** 2, MIN_SLOPE)
        elif ns and ns[0] > 0.0:
            fields["m"] = min(max(math.sqrt(2.0 / (ns[0] + 2.0)), MIN_SLOPE), MAX_SLOPE)
        return fields

    def ignores_ks(self, name: str) -> bool:
        """Return whether Ks of a material is 0 without a map. Many exporters write this by default,
        so that skin gets its highlights nevertheless; see :func:`facerender.scenes.hints.no_ks`."""
        statements = self.materials.get(name, {})
        ks = self._numbers(statements, "ks")
        return bool(ks) and not any(ks) and "map_ks" not in statements

    # --- maps ------------------------------------------------------------------------------------

    def warn_of_tiles(self, name: str, uv: NDArray[np.float64]) -> None:
        """Warn if a map of a material is a UDIM tile and its faces, with the texture coordinates
        (F, 3, 2), are on several tiles."""
        maps = [text for key, text in self.materials.get(name, {}).items() if key in _MAPS]
        if not any(re.search(r"(?<!\d)1001(?!\d)", text) for text in maps):
            return
        tiles = len(np.unique(np.floor(uv.mean(axis=1)), axis=0))
        if tiles > 1:
            self.warn(
                f"a map of {self.name} is UDIM tile 1001: drawn on all {tiles} tiles; "
                "export one map per part"
            )

    def _uses(self, statements: Mapping[str, str]) -> dict[str, _Map]:
        """Return the statements of maps, keyed by the field of the material."""
        uses: dict[str, _Map] = {}
        for key, (field, kind) in _MAPS.items():
            if key in statements and field not in uses:
                use = self._options(statements[key], kind)
                use.channel = use.channel or ("normal" if key == "norm" else "")
                if use.name:
                    uses[field] = use
        return uses

    def _options(self, text: str, kind: str) -> _Map:
        """Parse the statement of a map."""
        use = _Map("")
        spread = {"-s": [1.0, 1.0], "-o": [0.0, 0.0]}
        while (word := text.partition(" ")[0].lower()) in _OPTIONS:
            text = text[len(word) :].lstrip()
            values: list[str] = []
            while len(values) < _OPTIONS[word] and text:
                value = text.partition(" ")[0]
                if _OPTIONS[word] > 1 and not _is_number(value):
                    break
                values.append(value)
                text = text[len(value) :].lstrip()
            numbers = [float(argument) for argument in values if _is_number(argument)]
            if word in spread:
                spread[word][: len(numbers[:2])] = numbers[:2]
            elif word == "-bm" and numbers:
                use.strength = self._within("-bm", numbers[0], 0.0, MAX_NORMAL_STRENGTH)
            elif word == "-clamp":
                use.clamp = values[:1] == ["on"]
            elif word == "-imfchan":
                use.channel = "".join(values[:1])
            elif (
                (word == "-t" and any(numbers))
                or (word == "-mm" and numbers != [0.0, 1.0])
                or (word in _UNREAD and values[:1] != [_UNREAD[word]])
            ):
                self.warn(f"the {kind} map of {self.name} has the option {word}: ignored")
        use.name = text.strip().strip('"')
        (su, sv), (ou, ov) = spread.values()
        use.uv = UvSpread((su, sv), (ou, ov))
        return use

    def _map(self, key: str, use: _Map) -> Texture | None:
        identity = key, use.name, use.channel, use.clamp
        if identity not in self.textures:
            self.textures[identity] = self._texture(key, use)
        return self.textures[identity]

    def _texture(self, key: str, use: _Map) -> Texture | None:
        kind, name = key.removesuffix("_map"), clipped(use.name, 80)
        try:
            content = self.referred.read(use.name, "an image file")
        except FileNotFoundError:
            return None
        try:
            image = image_of(content)
        except ValueError as error:
            if kind != "albedo" or not self.albedo_given:
                shown = f"{name} (named by {self.name})"
                unreadable(shown, kind, error, fatal=not self.albedo_given)
            return None
        texture = self._decoding(key, use, content, image, name)
        return texture.sampled(("clamp", "clamp")) if use.clamp else texture

    def _decoding(self, key: str, use: _Map, content: bytes, image: Image, name: str) -> Texture:
        if key == "normal_map" and use.channel != "normal":
            return _bump(image, name)
        if key == "opacity_map" and use.channel in ("", "m"):
            alpha = Texture.alpha_of(content, name)
            if alpha is not None:
                return alpha
        texture = self.textures.get(("image", name)) or Texture.of(content, name)
        self.textures["image", name] = texture
        if key in ("opacity_map", "roughness_map", "specular_map"):
            return texture.channel(_CHANNELS.get(use.channel, 0), name)
        return texture


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
