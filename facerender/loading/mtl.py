"""MTL files: the materials that an OBJ file uses, and their maps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.images.srgb import srgb_to_linear
from facerender.loading.materials import Look, WarnOnce, image_of, second_of, unreadable
from facerender.loading.references import UDIM, References
from facerender.scenes.material import MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Material
from facerender.scenes.repair import Piece
from facerender.scenes.texture import Texture, with_green_turned
from facerender.scenes.vectors import HIGHEST, Vector
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE

if TYPE_CHECKING:
    from PIL.Image import Image


# The height of white over black, by the width of the map: 2.5 mm where that goes once around a head
# of 500 mm. MTL gives no unit.
DEPTH = 0.005
_LOOKED_AT = 64  # texels of a side
_GREY = 8.0  # mean difference of the channels of a grey image, as JPEG has it
_STRIP = 256  # rows


class Bump(Texture):
    """A normal map of a bump map, which is told by its colours, when it is decoded: heights are
    grey; normals have a length of 1 and point outwards, which is blue."""

    _image: Image | None = None  # a copy of a pickle has texels alone

    def __init__(self, image: Image, name: str, green_down: bool = False) -> None:
        def decode() -> Image:
            try:
                if not _is_normal_map(image):
                    return _normals(image)
                return with_green_turned(image) if green_down else image
            except Exception as error:  # each decoder of Pillow fails in its own way
                raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None

        super().__init__(decode, name, image.size)
        self._image = image

    def turned_green(self) -> Texture:
        """This texture, with green upwards if it is a map of normals; heights have none."""
        if self._image is None:
            return super().turned_green()
        return Bump(self._image, self.name, green_down=True)


def _is_normal_map(image: Image) -> bool:
    if image.mode not in ("RGB", "RGBA", "P"):
        return False
    texels = image.convert("RGB").resize((_LOOKED_AT, _LOOKED_AT))
    values = np.asarray(texels, dtype=np.float64)
    if float(np.ptp(values, axis=-1).mean()) < _GREY:
        return False
    normals = values / 127.5 - 1.0
    length = np.linalg.norm(normals, axis=-1)
    return bool((np.abs(length - 1.0) < 0.25).mean() > 0.9 and normals[..., 2].mean() > 0.5)


def _normals(image: Image) -> Image:
    """Return heights in any mode as a normal map, green up."""
    from PIL import Image as images

    deep = image.mode.startswith(("I", "F"))
    heights = np.asarray(image if deep else image.convert("L"))
    scale = 1.0 if image.mode == "F" else 65535.0 if deep else 255.0
    height, width = heights.shape
    normals = np.empty((height, width, 3), dtype=np.uint8)
    for top in range(0, height, _STRIP):
        start, end = max(top - 1, 0), min(top + _STRIP + 1, height)
        own = slice(top - start, min(top + _STRIP, height) - start)
        rows = heights[start:end].astype(np.float32) * np.float32(DEPTH / scale)
        # Rows go down, and green up: both signs of the second are turned.
        slopes = np.stack([-_slope(rows, 1) * width, _slope(rows, 0) * height], axis=-1)[own]
        length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
        unit = np.concatenate([slopes, np.ones_like(length)], axis=-1) / length
        normals[top : top + _STRIP] = np.round(unit * 127.5 + 127.5)
    return images.fromarray(normals)


def _slope(rows: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the difference per texel; none where there is one texel."""
    if rows.shape[axis] < 2:
        return np.zeros_like(rows)
    return np.asarray(np.gradient(rows, axis=axis))


_LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+(.*\S)", re.MULTILINE)
_MOST_TILES = 100
# By the statement, the field of the material that its map is, and what messages call it. Of several
# for a field the first counts.
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
# How many words follow an option of a map, at most where they are numbers.
_OPTIONS = {
    **dict.fromkeys(("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type"), 1),
    **dict.fromkeys(("-bm", "-boost", "-texres"), 1),
    "-mm": 2,
    **dict.fromkeys(("-o", "-s", "-t"), 3),
}
# Options that are not read, and what they say where nothing is lost by that.
_UNREAD = {"-cc": "off", "-boost": "0", "-blendu": "on", "-blendv": "on"}
_CHANNELS = {"r": 0, "g": 1, "b": 2}
# Without effect here, or on anything but ambient light, which has no colour of its own.
_PASSED_OVER = {"ka", "map_ka", "illum", "ni", "sharpness", "map_aat"}
_READ = {"kd", "ks", "ns", "ke", "d", "tr", "tf", "pr", *_MAPS}
_LAYERS = {"pm", "ps", "pc", "pcr", "aniso", "anisor"}  # which 0 leaves without effect


class UvSpread(NamedTuple):
    """What the options -s and -o of a map do to texture coordinates, v upwards."""

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    def applied(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return texture coordinates (N, 2) as they are then."""
        return uv if self == _PLAIN else uv * self.scale + self.offset


_PLAIN = UvSpread()


@dataclass
class _Map:
    """A statement of a map: its file, and what its options say.

    uv : of its texture coordinates
    """

    name: str
    uv: UvSpread = _PLAIN
    clamp: bool = False
    strength: float = 1.0
    channel: str = ""


class Library:
    """The materials of an OBJ file.

    Attributes
    ----------
    text : an MTL file of their names alone
    """

    def __init__(self, data: bytes, referred: References, name: str, without_albedo: bool) -> None:
        """Read the MTL files that an OBJ file names.

        Raises
        ------
        InputError : one of them is no file
        """
        self.referred = referred
        self.name = name
        self.without_albedo = without_albedo
        self.materials: dict[str, dict[str, str]] = {}
        self.looks: dict[tuple[str, bool, int], Look[UvSpread]] = {}
        self.textures: dict[tuple[Any, ...], Texture | None] = {}
        self.warn = WarnOnce()
        for line in dict.fromkeys(_LIBRARIES.findall(data)):
            for content in self._contents(_decoded(line)):
                self._parse(content)
        self.text = "".join(f"newmtl {each}\n" for each in self.materials).encode()

    def _contents(self, line: str) -> Iterator[str]:
        """The MTL file of a name, or those of its words."""
        try:
            yield _decoded(self.referred.read(line, "an MTL file"))
            return
        except FileNotFoundError:
            pass
        found = False
        for word in line.split() if " " in line else ():
            try:
                content = self.referred.read(word, "an MTL file")
            except FileNotFoundError:
                continue
            found = True
            yield _decoded(content)
        if found:
            del self.referred.files[line]

    def _parse(self, text: str) -> None:
        statements: dict[str, str] = {}
        for line in text.splitlines():
            key, _, rest = line.strip().partition("#")[0].replace("\t", " ").partition(" ")
            if key.lower() == "newmtl":
                statements = self.materials.setdefault(" ".join(rest.split()), {})
            elif rest.strip():
                statements[key.lower()] = rest.strip()

    def look(self, name: str, has_colors: bool, tile: int = 0) -> Look[UvSpread]:
        """Return the look of a material; that of a part without one where there is none.

        tile : for maps of UDIM, which are left out where it is 0
        """
        statements = self.materials.get(name)
        if statements is None:
            return Look(Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO), _PLAIN)
        key = name, has_colors, tile
        if key not in self.looks:
            self.looks[key] = self._look(statements, has_colors, tile)
        return self.looks[key]

    def tiles(self, name: str, piece: Piece) -> Mapping[int, NDArray[np.bool_]]:
        """Return by the tile of UDIM which faces of a piece lie there; nothing where its maps are
        not of that kind."""
        statements = self.materials.get(name, {})
        named = [statements[key] for key in _MAPS if key in statements]
        if piece.uv is None or not len(piece.faces):
            if any(UDIM in each for each in named):
                self.warn(f"{self.name} has no texture coordinates: its texture is ignored")
            return {}
        middle = piece.uv[piece.faces].mean(axis=1)
        cells = np.floor(np.where(np.abs(middle) < 1e6, middle, 0.0)).astype(np.int64)
        tiles = 1001 + np.clip(cells[:, 0], 0, 9) + 10 * np.clip(cells[:, 1], 0, 899)
        found = np.unique(tiles)
        if not any(UDIM in each for each in named):
            if len(found) > 1 and any(re.search(r"(?<!\d)1001(?!\d)", each) for each in named):
                self.warn(
                    f"a map of {self.name} is tile 1001 of UDIM: drawn in all of {len(found)} "
                    f"tiles; write {UDIM} in place of 1001 for one each"
                )
            return {}
        if len(found) > _MOST_TILES:
            raise InputError(
                f"{self.name} lies on {len(found)} tiles of UDIM, of {_MOST_TILES} at most"
            )
        return {int(tile): np.asarray(tiles == tile) for tile in found}

    def split(
        self, piece: Piece, name: str, tiles: Mapping[int, NDArray[np.bool_]]
    ) -> Iterator[Piece]:
        """Yield what of a piece lies on each tile of UDIM, its texture coordinates brought into the
        unit square."""
        assert piece.uv is not None
        for tile, chosen in tiles.items():
            vertices, inverse = np.unique(piece.faces[chosen], return_inverse=True)
            corner = (tile - 1001) % 10, (tile - 1001) // 10
            yield replace(
                piece,
                positions=piece.positions[vertices],
                faces=inverse.reshape(-1, 3),
                normals=None if piece.normals is None else piece.normals[vertices],
                uv=piece.uv[vertices] - corner,
                uv2=None if piece.uv2 is None else piece.uv2[vertices] - corner,
                colors=None if piece.colors is None else piece.colors[vertices],
                material=self.look(name, piece.colors is not None, tile).material,
                out_of_range=0,
            )

    # --- factors ---------------------------------------------------------------------------------

    def _look(self, statements: Mapping[str, str], has_colors: bool, tile: int) -> Look[UvSpread]:
        for key in statements.keys() - _READ - _PASSED_OVER:
            if key not in _LAYERS or any(self._numbers(statements, key)):
                self.warn(f"{self.name} has {clipped(key, 40)} in its MTL: not drawn")
        uses = self._uses(statements)
        places = {key: each.uv for key, each in uses.items()}
        first = places.get("albedo_map", next(iter(places.values()), _PLAIN))
        second = second_of(places.values(), first)
        maps: dict[str, Any] = {}
        for key, use in uses.items():
            if places[key] in (first, second):
                maps[key] = self._map(key, use, tile)
            else:
                self.warn(f"{clipped(use.name, 80)} lies as no two other maps do: left out")
        changes: dict[str, Any] = dict(maps)
        white = (1.0, 1.0, 1.0)
        has_map = "map_kd" in statements
        albedo = self._color(statements, "kd") or white
        if has_map and maps.get("albedo_map") is None and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # white was meant to multiply the image
        # With a map or colours it does not count: exporters write any grey.
        changes["albedo"] = white if maps.get("albedo_map") or has_colors else albedo
        emissive = self._color(statements, "ke") or (0.0, 0.0, 0.0)
        changes["emissive"] = emissive if any(emissive) or "map_ke" not in statements else white
        changes |= self._opacity(statements, "map_d" in statements)
        changes |= self._highlight(statements)
        if "normal_map" in uses:
            changes["normal_strength"] = uses["normal_map"].strength
        changes["second_uv"] = tuple(
            key for key, each in maps.items() if each and places[key] != first
        )
        return Look(Material(**changes), first, second)

    def _numbers(self, statements: Mapping[str, str], key: str) -> list[float]:
        """The numbers of a statement, none where it has others."""
        try:
            found = [float(each) for each in statements.get(key, "").split()]
        except ValueError:
            found = []
        if key in statements and not (found and all(map(math.isfinite, found))):
            self.warn(f"{self.name} has {key} {clipped(statements[key], 40)} in its MTL: left out")
            return []
        return found

    def _within(self, key: str, value: float, low: float, high: float) -> float:
        if not low <= value <= high:
            self.warn(
                f"{key} {value:.6g} in the MTL of {self.name} is outside [{low:g}, {high:g}]: "
                "brought there"
            )
        return min(max(value, low), high)

    def _color(self, statements: Mapping[str, str], key: str) -> Vector | None:
        """A colour as linear RGB; the file's is sRGB."""
        found = self._numbers(statements, key)
        if not found:
            return None
        three = found[:3] if len(found) >= 3 else found[:1] * 3
        most = HIGHEST if key == "ke" else 1.0
        red, green, blue = (self._within(key, each, 0.0, most) for each in three)
        linear = np.minimum(srgb_to_linear(np.array([red, green, blue])), HIGHEST)
        return float(linear[0]), float(linear[1]), float(linear[2])

    def _opacity(self, statements: Mapping[str, str], has_map: bool) -> dict[str, Any]:
        """The fields of opacity: a map cuts out, a factor alone blends."""
        found = self._numbers({"d": statements.get("d", "1").replace("-halo", "")}, "d")
        opacity = self._within("d", (found or [1.0])[0], 0.0, 1.0)
        if "d" not in statements and (tr := self._numbers(statements, "tr")):
            opacity = 1.0 - self._within("Tr", tr[0], 0.0, 1.0)
            if not opacity:  # who writes 1 for all means d
                self.warn(f"{self.name} has Tr 1 in its MTL, nothing to be seen: drawn as d 1")
                opacity = 1.0
        tf = self._numbers(statements, "tf")
        if len({*tf, 1.0}) > 1 and any(tf):
            self.warn(f"{self.name} has Tf, light that passes through, in its MTL: not drawn")
        kind = "blend" if opacity < 1.0 else "mask" if has_map else "opaque"
        return {"alpha": kind, "opacity": opacity}

    def _highlight(self, statements: Mapping[str, str]) -> dict[str, Any]:
        """The fields ks and m. Ns is an exponent of Blinn and Phong: m = sqrt(2 / (Ns + 2)).

        References: Walter et al. (2007), Microfacet models for refraction, section 5.2.
        """
        fields: dict[str, Any] = {}
        ks, ns, pr = (self._numbers(statements, key) for key in ("ks", "ns", "pr"))
        if ks and not any(ks) and "map_ks" not in statements:
            self.warn(
                f"{self.name} has no highlights in its MTL (Ks 0), as many write it: drawn with "
                "those of skin; --ks 0 for none"
            )
            ns = []
        elif any(ks):
            mean = sum(ks[:3]) / len(ks[:3])
            fields["ks"] = self._within("Ks", mean, 0.0, 1.0)
        if pr and (pr[0] or "map_pr" not in statements):
            fields["m"] = max(self._within("Pr", pr[0], 0.0, 1.0) ** 2, MIN_SLOPE)
        elif ns and ns[0] > 0.0:
            fields["m"] = min(max(math.sqrt(2.0 / (ns[0] + 2.0)), MIN_SLOPE), MAX_SLOPE)
        return fields

    # --- maps ------------------------------------------------------------------------------------

    def _uses(self, statements: Mapping[str, str]) -> dict[str, _Map]:
        """The maps by the fields of the material."""
        found: dict[str, _Map] = {}
        for key, (name, _) in _MAPS.items():
            if key not in statements or name in found:
                continue
            use = self._options(statements[key], _MAPS[key][1])
            if use.name and not (name == "albedo_map" and self.without_albedo):
                found[name] = use
                use.channel = use.channel or ("normal" if key == "norm" else "")
        return found

    def _options(self, text: str, kind: str) -> _Map:
        """Take the options off a statement of a map."""
        use = _Map("")
        scale, offset = [1.0, 1.0], [0.0, 0.0]
        while (word := text.partition(" ")[0].lower()) in _OPTIONS:
            text = text[len(word) :].lstrip()
            values: list[str] = []
            while len(values) < _OPTIONS[word] and text:
                value = text.partition(" ")[0]
                if _OPTIONS[word] > 1 and not _is_number(value):
                    break
                values.append(value)
                text = text[len(value) :].lstrip()
            numbers = [float(each) for each in values if _is_number(each)]
            if word == "-s":
                scale[: len(numbers[:2])] = numbers[:2]
            elif word == "-o":
                offset[: len(numbers[:2])] = numbers[:2]
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
                self.warn(f"the {kind} map of {self.name} has the option {word}: left out")
        use.name = text.strip().strip('"')
        use.uv = UvSpread((scale[0], scale[1]), (offset[0], offset[1]))
        return use

    def _map(self, key: str, use: _Map, tile: int) -> Texture | None:
        if UDIM in use.name and not tile:
            return None
        name = use.name.replace(UDIM, str(tile))
        identity = key, name, use.channel, use.clamp
        if identity not in self.textures:
            self.textures[identity] = self._texture(key, use, name)
        return self.textures[identity]

    def _texture(self, key: str, use: _Map, name: str) -> Texture | None:
        kind = key.removesuffix("_map")
        shown = f"{clipped(name, 80)} (named by {self.name})"
        try:
            content = self.referred.read(name, "an image file")
        except FileNotFoundError:
            return None
        try:
            image = image_of(content)
        except ValueError:
            unreadable(shown, kind, fatal=not self.without_albedo)
            return None
        texture = self._decoding(key, use, content, image, clipped(name, 80))
        return texture.sampled(("clamp", "clamp")) if use.clamp else texture

    def _decoding(self, key: str, use: _Map, content: bytes, image: Image, name: str) -> Texture:
        if key == "normal_map" and use.channel != "normal":
            return Bump(image, name)
        if key == "opacity_map" and use.channel in ("", "m"):
            alpha = Texture.alpha_of(content, name)
            if alpha is not None:
                return alpha
        same = "image", name
        texture = self.textures.get(same)
        if texture is None:
            texture = self.textures[same] = Texture.of(content, name)
        if key in ("opacity_map", "roughness_map", "specular_map"):
            return texture.channel(_CHANNELS.get(use.channel, 0), name)
        return texture


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _decoded(content: bytes) -> str:
    from trimesh.util import decode_text

    return str(decode_text(content))
