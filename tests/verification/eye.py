"""A modelled eye, and the point of its iris that each view ray hits, computed in float64.

Lengths are in millimetres. The cornea is a sphere with its apex at the origin; z points out of the
eye. Sources of the dimensions: Gullstrand's schematic eye (cornea, anterior chamber), and the guide
of Unreal Engine's digital humans (iris)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.material import Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.values.vectors import unit

CORNEA, SCLERA = 7.8, 12.0  # radii of the spheres
DEPTH, RIM = 3.6, 6.0  # iris plane below the apex; radius of the iris and of the cornea's rim
INDEX = 1.336  # of cornea and aqueous humour
CLEAR = 2  # index of the cornea in the mesh

Floats = NDArray[np.float64]


def cap(center: float, radius: float, low: float, high: float, rings: int, sectors: int) -> Part:
    """Return a part of a sphere about (0, 0, center) with its normals.

    low, high : polar angles in radians, from +z
    rings, sectors : number of quads in polar angle and in azimuth
    """
    polar = np.repeat(np.linspace(low, high, rings + 1), sectors)
    around = np.tile(2.0 * np.pi * np.arange(sectors) / sectors, rings + 1)
    sine = np.sin(polar)
    normals = np.stack([sine * np.cos(around), sine * np.sin(around), np.cos(polar)], axis=1)
    return Part(normals * radius + (0.0, 0.0, center), normals, _quads(rings, sectors))


def disc(rings: int, sectors: int) -> Part:
    """Return the iris plane out to 1.15 RIM. Its colours encode x and y, see :func:`places`."""
    size = np.repeat(np.linspace(0.0, 1.15 * RIM, rings + 1), sectors)
    around = np.tile(2.0 * np.pi * np.arange(sectors) / sectors, rings + 1)
    x, y = size * np.cos(around), size * np.sin(around)
    positions = np.stack([x, y, np.full_like(x, -DEPTH)], axis=1)
    colors = np.stack([0.5 + x / 16.0, 0.5 + y / 16.0, np.full_like(x, 0.5)], axis=1)
    return Part(
        positions, np.tile((0.0, 0.0, 1.0), (len(x), 1)), _quads(rings, sectors), colors=colors
    )


def places(color: Floats) -> Floats:
    """Return x and y (N, 2) of the points of the iris plane with the given colours (N, 3)."""
    return np.asarray(16.0 * (0.5 * color[:, :2] / color[:, 2:] - 0.5))


def _quads(rings: int, sectors: int) -> NDArray[np.uint32]:
    ring, sector = (each.ravel() for each in np.mgrid[:rings, :sectors])
    beside = (sector + 1) % sectors
    corners = [ring * sectors + sector, (ring + 1) * sectors + sector]
    corners += [(ring + 1) * sectors + beside, ring * sectors + beside]
    a, b, c, d = corners
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return faces.astype(np.uint32)


def eye(rings: int = 12, sectors: int = 32, **cornea: Any) -> Mesh:
    """Return the eye. A cornea has ``rings`` x ``sectors`` quads.

    cornea : changes of the cornea's material; by default it refracts, without a highlight
    """
    edge = np.arcsin(RIM / CORNEA)
    height = CORNEA * (np.cos(edge) - 1.0)
    opening = np.arcsin(RIM / SCLERA)
    parts = (
        cap(height - SCLERA * np.cos(opening), SCLERA, opening, np.pi, 24, 2 * sectors),
        disc(12, 2 * sectors),
        cap(-CORNEA, CORNEA, 0.0, edge, rings, sectors),
    )
    clear: dict[str, Any] = {"transmission": 1.0, "refraction": INDEX, "f0": 0.0207}
    materials = (
        Material((0.8, 0.75, 0.7), ks=0.0),
        Material((1.0, 1.0, 1.0), ks=0.0),
        Material((1.0, 1.0, 1.0), **{**clear, "ks": 0.0, "m": 0.05, **cornea}),
    )
    return Mesh.of("eye", parts, materials, millimetres=1.0)


def hits(camera: Floats, rays: Floats, index: float = INDEX) -> Floats:
    """Return x and y (N, 2) where view rays meet the iris plane; NaN for rays that miss the cornea.

    camera : (3,), the start of the rays
    rays : (N, 3) directions
    index : index of refraction; 1 for straight rays
    """
    d = unit(rays)
    start = camera + (0.0, 0.0, CORNEA)
    along = d @ start
    with np.errstate(invalid="ignore"):
        t = -along - np.sqrt(along**2 - start @ start + CORNEA**2)
        n = (start + t[:, None] * d) / CORNEA
        n[CORNEA * n[:, 2] < np.sqrt(CORNEA**2 - RIM**2)] = np.nan
        cosine = -(n * d).sum(axis=1, keepdims=True)
        inner = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
        inwards = d / index + (cosine / index - inner) * n
        point = CORNEA * n - (0.0, 0.0, CORNEA)
        at = point - inwards * ((point[:, 2:] + DEPTH) / inwards[:, 2:])
    return np.asarray(at[:, :2])


def camera(azimuth: float) -> fr.Camera:
    """Return a camera that frames the iris, in a direction of the given azimuth."""
    return fr.Camera(azimuth, fov=6.0, zoom=1.7, target=(0.0, 0.0, -DEPTH))


def iris_errors(renderer: fr.Renderer, azimuth: float, **settings: int) -> tuple[Floats, Floats]:
    """Return by how much an image displaces the points of the iris, (N,) as a fraction of RIM: the
    image of the renderer, and an exact image without refraction.

    The N pixels show the cornea, and their exact ray hits the iris within 0.97 RIM.

    Parameters
    ----------
    azimuth : of the camera, in degrees
    settings : see :func:`eye`
    """
    mesh = eye(**settings)
    scene = fr.Scene(mesh, camera(azimuth), lights=(), ambient=np.pi, background=None)
    gbuffer = renderer.gbuffer(scene)
    color = renderer.render(scene, samples=1).linear[..., :3].astype(np.float64)
    height, width = gbuffer.part.shape
    y, x = np.mgrid[:height, :width]
    clip = np.stack([2.0 * (x + 0.5) / width - 1.0, 2.0 * (y + 0.5) / height - 1.0], axis=-1)
    far = np.concatenate([clip, np.ones((height, width, 2))], axis=-1)
    far = far @ np.linalg.inv(gbuffer.view.matrix)
    rays = (far[..., :3] / far[..., 3:] - gbuffer.view.position)[gbuffer.part == CLEAR]
    start = mesh.to_mesh_space(gbuffer.view.position)
    exact, straight = hits(start, rays), hits(start, rays, 1.0)
    seen = np.linalg.norm(exact, axis=1) < 0.97 * RIM
    drawn = places(color[gbuffer.part == CLEAR])
    drawn_error, straight_error = (
        np.linalg.norm(each - exact, axis=1)[seen] / RIM for each in (drawn, straight)
    )
    return drawn_error, straight_error
