"""Presets of parts with known names, and names of parts that are not skin.

A part gets a preset if the name of its material, or else its own name, is known, and if the file
has no better material for it: neither maps nor vertex colours, opacity or transmission. The rule
applies before the caller's maps and factors, which therefore win. The known names come
from ICT-FaceKit, Character Creator, MetaHuman, Ready Player Me, MakeHuman and FLAME, or are words
of anatomy. ICT-FaceKit's eyes and lashes have texture coordinates but no textures: they also get
painted maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped, warn
from facerender.images.image import linear_to_srgb
from facerender.material import MAPS, PRESETS, SKIN_ALBEDO, changed
from facerender.mesh.framing import words_of
from facerender.mesh.repair import Piece
from facerender.texture.texture import Texture

_SIDES = {"l", "r", "left", "right", "upper", "lower"}
_AFFIXES = {
    *("m", "mi", "std", "cc", "base", "game", "wolf", "d", "lod", "mesh", "geo", "shape", "sg"),
    *("mat", "mtl", "material", "shader", "primitive"),
}
# Words of anatomy that are known names, also with affixes and sides, or after "eye".
WORDS = {
    "cornea": "Cornea",
    "tear": "LacrimalFluid TearLine TearFilm Tear Tears EyeBlend EyeEdge Cartilage Saliva",
    "sclera": "Sclera Eyeball Eyeballs",
    "iris": "Iris Irises",
    "eye-occlusion": "EyeOcclusion EyeAO EyeShell",
    "lashes": "Lash Lashes Eyelash Eyelashes",
    "teeth": "Teeth Tooth",
    "lips": "Lip Lips Tongue Gum Gums GumsTongue",
    "hair-card": "HairCard HairCards Eyebrow Eyebrows",
}
# Names that are known as a whole. "head", "face" and "eye" are not known names, because a file of
# any kind may use these words.
WHOLE_NAMES = {
    "skin": "M_Face M_BackHead Wolf3D_Head Wolf3D_Skin Wolf3D_Body Std_Skin_Head Std_Skin_Body "
    "Std_Skin_Arm Std_Skin_Leg CC_Base_Head head_lod0_mesh",
    "sclera": "EyeLeft EyeRight LeftEye RightEye Wolf3D_Eye Std_Eye_L Std_Eye_R CC_Base_Eye",
    "hair-card": "Wolf3D_Hair Wolf3D_Beard",
}
# Words of names of parts that are not skin. A word of the second set shows that the part is skin.
_NOT_SKIN = {
    *("eye", "eyes", "eyeball", "eyeballs", "cornea", "sclera", "lash", "lashes", "eyelash"),
    *("eyelashes", "eyebrow", "eyebrows", "brows", "hair", "beard", "teeth"),
}
_SKIN = {"skin", "lid", "lids", "socket", "sockets"}
# Names of MakeHuman's eyes, which are known in a file with lashes or teeth.
_EYES = ("highpoly", "lowpoly", "highpolyeyes", "lowpolyeyes")
# The presets of words and of whole names, keyed by their letters in lower case.
_OF_WORDS, _OF_NAMES = (
    {"".join(words_of(name)): preset for preset, text in names.items() for name in text.split()}
    for names in (WORDS, WHOLE_NAMES)
)


def preset_for(name: str) -> str | None:
    """Return the preset of a part's or material's name, or None if the name is not known."""
    words = words_of(name)
    bare = [word for word in words if word not in _AFFIXES]
    stem = [word for word in bare if word not in _SIDES]
    of_eye = stem[1:] if stem[:1] in (["eye"], ["eyes"]) else stem
    matches = [_OF_NAMES.get("".join(candidate)) for candidate in (words, bare)]
    matches += [_OF_WORDS.get("".join(candidate)) for candidate in (stem, of_eye)]
    return next(filter(None, matches), None)


def apply_names(pieces: Sequence[Piece], file: str, as_is: bool) -> None:
    """Set ``skin`` of each piece: false if its name or its material's name is a name of eyes,
    lashes, teeth or hair. Unless ``as_is``, give presets to pieces with known names, with a
    warning that names the ``file``."""
    presets = [preset_for(piece.material_name) or preset_for(piece.name) for piece in pieces]
    if {"lashes", "teeth"} & {*presets}:
        pairs = zip(pieces, presets, strict=True)
        presets = ["sclera" if _stem(piece) in _EYES else preset for piece, preset in pairs]
    for piece, preset in zip(pieces, presets, strict=True):
        names = {*words_of(piece.name)}, {*words_of(piece.material_name)}
        excluded = any(words & _NOT_SKIN and not words & _SKIN for words in names)
        piece.skin = preset in (None, "skin", "lips") and not excluded
    if as_is:
        return
    part_names: dict[str, list[str]] = {}
    # Names of ICT-FaceKit without sides: miris, msclera, meyelashes
    eyes = [_stem(piece) == "miris" and _has_ict_iris(piece) for piece in pieces]
    eye_map = _eye_map() if any(eyes) else None
    for piece, preset, eye in zip(pieces, presets, eyes, strict=True):
        if eye_map and _stem(piece) == "msclera":
            preset = "cornea"  # the clear shell around the eyeball of the iris
        if preset is None or not _is_bare(piece):
            continue
        piece.material, piece.preset = changed(piece.material, {"preset": preset}), preset
        if preset == "skin" and np.ptp(piece.material.albedo) < 0.02:  # grey
            piece.material = replace(piece.material, albedo=SKIN_ALBEDO)
        if eye:
            _close_pupil(piece)
            piece.material = replace(piece.material, albedo=(1.0, 1.0, 1.0), albedo_map=eye_map)
        elif _stem(piece) == "meyelashes" and piece.uv is not None:
            piece.material = replace(piece.material, opacity=1.0, opacity_map=_lash_map())
        part_names.setdefault(preset, []).append(piece.name or piece.material_name)
    if part_names:
        all_ = "; ".join(f"{preset} for {', '.join(names)}" for preset, names in part_names.items())
        warn(f"{file}: presets by name: {clipped(all_, 400)}; --as-is keeps the file's own")


def _is_bare(piece: Piece) -> bool:
    material = piece.material
    plain = not material.transmission and not material.unlit and piece.colors is None
    return plain and material.alpha == "opaque" and not any(getattr(material, key) for key in MAPS)


def _stem(piece: Piece) -> str:
    """Return the letters of a material's or part's name without sides, in lower case."""
    words = words_of(piece.material_name or piece.name)
    return "".join(word for word in words if word not in _SIDES)


# --- ICT-FaceKit ---------------------------------------------------------------------------------
# The iris mesh is a whole eyeball. Its texture coordinates show the front as a disc of radius 0.5
# around the centre; the pupil is a hole of radius 0.09. The lashes are six cards a side, one in
# each sixth of v, with the roots on top; the lower three belong to the lower lid.
_SIDE = 256  # texels of a side of the eye's map; the map of the lashes is four times as wide
_PUPIL, _LIMBUS = (0.1, 0.112), (0.385, 0.46)
_STRANDS = 40


def _has_ict_iris(piece: Piece) -> bool:
    if piece.uv is None or not _is_bare(piece):
        return False
    radii = np.hypot(*(piece.uv - 0.5).T)
    return bool(radii.min() > 0.08 and ((radii > 0.15) & (radii < 0.35)).any())


def _close_pupil(piece: Piece) -> None:
    """Close the pupil, through which a refracting cornea would show the back of the iris."""
    assert piece.uv is not None
    assert piece.normals is not None
    offset = piece.uv - 0.5
    radii = np.hypot(*offset.T)
    rim = np.flatnonzero(radii < radii.min() + 1e-3)
    rim = rim[np.unique(np.round(np.arctan2(*offset[rim].T), 3), return_index=True)[1]]
    middle = np.full_like(rim, len(piece.positions))
    fan = np.stack([middle, rim, np.roll(rim, -1)], axis=1)
    front = piece.normals[(radii > 0.15) & (radii < 0.35)].mean(axis=0)
    positions = np.vstack([piece.positions, piece.positions[rim].mean(axis=0)])
    a, b, c = positions[fan.T]
    across = np.cross(b - a, c - a).sum(axis=0)
    piece.faces = np.vstack([piece.faces, fan if across @ front > 0.0 else fan[:, ::-1]])
    piece.positions, piece.uv = positions, np.vstack([piece.uv, (0.5, 0.5)])
    piece.normals = np.vstack([piece.normals, front / np.linalg.norm(front)])
    piece.uv2 = None


def _eye_map() -> Texture:
    """Return the colours of an eyeball: a black pupil, an iris with fibres, and a white sclera."""
    x, y = np.meshgrid(*[(np.arange(_SIDE) + 0.5) / _SIDE - 0.5] * 2)
    radius, angle = np.hypot(x, y)[..., None], np.arctan2(y, x)[..., None]
    counts = np.arange(23, 89, 5)
    fibres = np.cos(counts * angle + counts**2 + 3.0 * np.sin(20.0 * radius + counts)).mean(axis=-1)
    depth = 1.0 + 0.8 * fibres[..., None] + 0.3 * np.cos(11.0 * radius)
    ring = 1.0 - 0.7 * np.exp(-(((radius - _LIMBUS[0]) / 0.035) ** 2))
    white = _ramp(radius, *_LIMBUS)
    iris, sclera = (np.array(PRESETS[name]["albedo"]) for name in ("iris", "sclera"))
    color = ((1.0 - white) * iris * depth + white * sclera) * ring * _ramp(radius, *_PUPIL)
    return Texture.from_array(linear_to_srgb(np.clip(color, 0.0, 1.0)), "a painted eye")


def _lash_map() -> Texture:
    """Return the opacity of cards of lashes: strands that become thinner towards their tips."""
    u, down = np.meshgrid((np.arange(4 * _SIDE) + 0.5) / (2 * _SIDE), (np.arange(64) + 0.5) / 64.0)
    card = np.arange(6)[:, None, None]
    position = (u % 1.0) * _STRANDS + 0.5 * card + 0.4 * down**2
    strand = np.floor(position).astype(int) % _STRANDS
    bend = 0.6 * np.sin(strand * 2.4 + card)
    distance = np.abs(position % 1.0 - 0.5 - 0.3 * bend * down)
    length = np.where(card > 2, 0.5, 0.75) + 0.2 * np.cos(strand * 1.7 + card)
    width = 0.16 * np.clip(1.0 - down / length, 0.0, 1.0)
    opacity = np.clip((width - distance) * 12.0 + 0.5, 0.0, 1.0) * (width > 0.0)
    return Texture.from_array(opacity.reshape(-1, 4 * _SIDE), "painted lashes")


def _ramp(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return a smooth step from 0 at low to 1 at high."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
