"""A head of several parts, built by code as in digital-human assets: the built-in face, eyeballs
under transparent shells, lashes on cut-out strips, and hair cards."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.material import Alpha, Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.texture.texture import Texture
from tests.meshes import with_geometry

Floats = NDArray[np.float64]

EYES = ((0.0322, 0.0008, 0.0735), (-0.0322, 0.0008, 0.0735))  # in front of the lids, metres
EYE = 0.0128  # radius of an eyeball, in metres
SHELL = 1.06  # ratio of the radii of shell and eyeball
NAMES = ("face", "eyes", "shells", "lashes", "hair")


def surface(points: Floats, outwards: Floats) -> Part:
    """Return a grid of points (rows, columns, 3) with normals on the side of ``outwards``."""
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    normals = outwards.reshape(-1, 3) / np.linalg.norm(outwards.reshape(-1, 3), axis=1)[:, None]
    return Part(points.reshape(-1, 3), normals, faces.astype(np.uint32), uv)


def ball(centre: tuple[float, float, float], radius: float, steps: int = 24) -> Part:
    """Return a sphere whose texture coordinate (0.5, 0.5) is in front."""
    around = np.linspace(-np.pi, np.pi, 2 * steps + 1)[None, :]
    up = np.linspace(-np.pi / 2, np.pi / 2, steps + 1)[:, None]
    x, y = np.sin(around) * np.cos(up), np.sin(up) * np.ones_like(around)
    outwards = np.stack([x, y, np.cos(around) * np.cos(up)], axis=-1)
    return surface(np.asarray(centre) + radius * outwards, outwards)


def lashes(centre: tuple[float, float, float]) -> Part:
    """Return a strip that stands out from the upper rim of an eye."""
    along = np.radians(np.linspace(-60.0, 60.0, 25))[None, :]
    out = np.linspace(1.04, 1.75, 5)[:, None]
    turn = np.radians(28.0 + 14.0 * (out - 1.0))
    direction = np.stack(
        [
            np.sin(along) * np.cos(turn),
            np.sin(turn) * np.ones_like(along),
            np.cos(along) * np.cos(turn),
        ],
        axis=-1,
    )
    above = np.broadcast_to(np.array([0.0, 1.0, 0.3]), direction.shape)
    return surface(np.asarray(centre) + EYE * out[..., None] * direction, above)


def cards(count: int = 72) -> list[Part]:
    """Return strips that hang from the crown, all around except in front of the face."""
    strips = []
    for number, place in enumerate(np.linspace(0.0, 1.0, count)):
        angle = np.radians(64.0 + 232.0 * place) + 0.26 * np.linspace(-0.5, 0.5, 3)[None, :]
        down = np.radians(np.linspace(12.0, 105.0, 8))[:, None]
        outwards = np.stack(
            [
                np.sin(angle) * np.sin(down),
                np.cos(down) * np.ones_like(angle),
                np.cos(angle) * np.sin(down),
            ],
            axis=-1,
        )
        size = (1.0 + 0.03 * (number % 3)) * np.array([0.084, 0.1, 0.103])
        strips.append(surface(np.array([0.0, 0.02, -0.004]) + size * outwards, outwards))
    return strips


def joined(parts: list[Part]) -> Part:
    """Return one part that joins several."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts[:-1])])
    return Part(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate(
            [part.faces + np.uint32(at) for part, at in zip(parts, starts, strict=True)]
        ),
        np.concatenate([part.uv for part in parts if part.uv is not None]),
    )


def texture(values: Floats, name: str) -> Texture:
    """Return a texture of values in [0, 1], (H, W) or (H, W, 3), row 0 on top."""
    texels = np.round(255.0 * values.clip(0.0, 1.0)).astype(np.uint8)
    return Texture(lambda: Image.fromarray(texels), name)


@cache
def iris() -> Texture:
    v, u = np.mgrid[-1:1:256j, -1:1:512j]
    distance = np.hypot(2.0 * u, v)
    white, blue, black = (
        np.array(each) for each in ((0.85, 0.82, 0.8), (0.2, 0.4, 0.6), (0.02,) * 3)
    )
    color = np.where((distance < 0.28)[..., None], blue, white)
    return texture(np.where((distance < 0.12)[..., None], black, color), "iris")


@cache
def hairs(count: int, width: float, seed: int) -> Texture:
    """Return an alpha map of hairs that start at the lower edge and taper off."""
    rng = np.random.default_rng(seed)
    height = np.linspace(1.0, 0.0, 256)[:, None]
    across = np.linspace(0.0, 1.0, 512)[None, :]
    alpha = np.zeros((256, 512))
    for root in rng.uniform(0.02, 0.98, count):
        lean, top = rng.uniform(-0.06, 0.06), rng.uniform(0.75, 1.0)
        thick = width * (1.0 - 1.5 * height / top)
        alpha = np.maximum(alpha, (thick - np.abs(across - root - lean * height**2)) / width + 0.5)
    return texture(alpha, "hairs")


head = cache(fr.load_mesh)


@cache
def parts_head(hair: Alpha = "mask", scattering: str | None = None) -> Mesh:
    """Return the head; its parts are in the order of NAMES."""
    plain = head()
    two = {"eyes": [ball(each, EYE) for each in EYES], "lashes": [lashes(each) for each in EYES]}
    parts = [
        plain.parts[0],
        joined(two["eyes"]),
        joined([ball(each, SHELL * EYE) for each in EYES]),
        joined(two["lashes"]),
        joined(cards()),
    ]
    brown = (0.05, 0.03, 0.02)
    materials = [
        replace(plain.materials[0], scattering=scattering),
        Material((1.0, 1.0, 1.0), m=0.35, albedo_map=iris()),
        Material((1.0, 1.0, 1.0), m=0.08, alpha="blend", opacity=0.12),
        Material((0.01, 0.01, 0.01), m=0.4, alpha="mask", opacity_map=hairs(60, 0.012, 1)),
        Material(
            brown,
            m=0.3,
            ks=0.3,
            alpha=hair,
            opacity_map=hairs(40, 0.02, 2).sampled(("clamp", "clamp")),
        ),
    ]
    points = np.concatenate([part.positions for part in parts])
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    radius = float(np.linalg.norm(points - bounds.mean(axis=0), axis=1).max())
    values = {"name": "parts", "parts": tuple(parts), "bounds": bounds, "radius": radius}
    return with_geometry(plain, materials, **values)
