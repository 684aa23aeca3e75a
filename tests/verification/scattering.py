"""Error of screen-space scattering against the profile integrated over points of the mesh. Both use
the same ray-traced light, so that only scattering differs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.image import linear_to_srgb
from facerender.material import SKIN_ALBEDO
from facerender.mesh.mesh import Mesh
from facerender.scene.camera import Camera
from facerender.scene.light import Light
from facerender.scene.scattering import scattering_of
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from facerender.scene.view import view_of
from facerender.terms.transport import Gaussians, rest, scatter, scatter_area
from tests.meshes import with_geometry
from tests.verification.shadows import tracer_of

Float = NDArray[np.float64]

_OFFSET = 2e-3  # from the surface to the start of a ray, in radii of the bounding sphere
_POINTS = 300  # points per Gaussian, within three standard deviations
_AT_ONCE = 20_000  # pixels per step, to bound the memory
_LIT = 1.1  # radiance of a white diffuse surface that faces the light


def _subject(mesh: Mesh, millimetres: float, zoom: float) -> tuple[Scene, Light]:
    skin = with_geometry(mesh, millimetres=millimetres).with_material(scattering="skin")
    camera = Camera(-20.0, zoom=zoom, frame="all")
    return Scene(skin, camera), Light(-50.0, 42.0, shadow=False)


# Scenes by the name of the mesh's fixture: 512 x 512 pixels, 1.8 pixels per millimetre. A unit of
# the scan's file is 53 mm, which makes the head as large as in the OBJ file of the scan.
SUBJECTS = {
    "head": lambda mesh: _subject(mesh, 1000.0, 1.09),
    "scan_mesh": lambda mesh: _subject(mesh, 53.0, 1.68),
}


@dataclass(frozen=True)
class ScatterError:
    """Errors over the pixels of lit skin.

    Attributes
    ----------
    samples : subsurface samples per pixel; 0: an image without scattering
    mean : mean absolute error of the irradiance, relative to its mean
    p99 : 99th percentile of the worst channel's error in the displayed image, in 8-bit levels
    """

    samples: int
    mean: float
    p99: float


def scatter_errors(
    renderer: Renderer,
    scene: Scene,
    light: Light,
    samples: Sequence[int] = (0, 8, 16, 32, 64),
    count: int = 20_000,
) -> tuple[float, list[ScatterError]]:
    """Measure scattering under one directional light at pixel centres.

    Parameters
    ----------
    scene : its first material must scatter
    samples : subsurface samples per pixel; 0 for no scattering
    count : number of randomly chosen pixels; all if there are fewer

    Returns
    -------
    mean number of pixels per millimetre; an error for each number of samples

    Raises
    ------
    NotMeasured : embreex is missing
    InputError : no material scatters, or the light is not directional
    """
    size = renderer.size
    found = scattering_of(scene, view_of(scene, size[0] / size[1]), size)
    if found is None or light.position is not None:
        raise InputError(f"{scene.mesh.name}: give a material that scatters and a distant light")
    gbuffer = renderer.gbuffer(scene, Shading(normal_map=False))
    covered = gbuffer.part >= 0
    place, normal = (
        each.astype(np.float64) for each in (gbuffer.normalised_position, gbuffer.normal)
    )
    entered = np.zeros(place.shape)
    lit = _Lit(scene.mesh, light)
    entered[covered] = lit(place[covered], normal[covered])[:, None]
    chosen = np.flatnonzero(covered)
    chosen = np.sort(np.random.default_rng(3).permutation(chosen)[:count])
    pixels = np.zeros(covered.shape, dtype=bool)
    pixels.flat[chosen] = True
    gaussians, unit = found.profiles[0], found.millimetres
    truth = by_points(scene.mesh, gaussians, unit, lit, place[pixels], entered[pixels])
    scale = found.pixels / (((place[pixels] - gbuffer.view.position) @ gbuffer.view.forward) * unit)
    assert gbuffer.facing is not None
    number, area = covered.astype(int), scatter_area(gbuffer.facing)
    errors = []
    for each in samples:
        own = entered[pixels]
        if each:
            images = entered, place, number, area, pixels
            own = scatter(*images, scale=scale, unit=unit, gaussians=gaussians, samples=each)
        shown, expected = (linear_to_srgb(_LIT * np.array(SKIN_ALBEDO) * v) for v in (own, truth))
        p99 = 255.0 * float(np.quantile(np.abs(shown - expected).max(axis=-1), 0.99))
        mean = float(np.abs(own - truth).sum() / truth.sum())
        errors.append(ScatterError(each, mean, p99))
    return float(scale.mean()), errors


class _Lit:
    """The irradiance of points of a mesh under a directional light, computed with rays."""

    def __init__(self, mesh: Mesh, light: Light) -> None:
        self.rays, self.direction = tracer_of(mesh), light.direction

    def __call__(self, points: Float, normals: Float) -> Float:
        cosine = normals @ self.direction
        facing = cosine > 0.0
        received = np.zeros(len(points))
        origin = points[facing] + _OFFSET * normals[facing]
        towards = np.broadcast_to(self.direction, origin.shape)
        received[facing] = cosine[facing] * ~self.rays.intersects_any(origin, towards)
        return received


def by_points(
    mesh: Mesh, gaussians: Gaussians, millimetres: float, lit: _Lit, places: Float, entered: Float
) -> Float:
    """Return the irradiance of places after scattering, (N, 3).

    It is the weighted sum, over the Gaussians, of mean irradiances of points around each place.

    Parameters
    ----------
    millimetres : length of a unit of the renderer's space
    places : (N, 3), in the renderer's space
    entered : irradiance of the places before scattering, (N, 3); the fraction that no Gaussian
        scatters stays
    """
    from scipy.spatial import cKDTree

    random = np.random.default_rng(5)
    near = cKDTree(places)
    result = rest(gaussians) * entered
    for variance, *weights in gaussians:
        deviation = math.sqrt(variance) / millimetres
        density = _POINTS / (math.pi * 9.0 * deviation**2)
        points, normals = _points(mesh, density, near, 3.6 * deviation, random)
        light, tree = lit(points, normals), cKDTree(points)
        for start in range(0, len(places), _AT_ONCE):
            few = slice(start, start + _AT_ONCE)
            distance, index = tree.query(places[few], _POINTS + 40, workers=-1)
            share = np.exp(-((distance / deviation) ** 2) / 2.0)
            mean = (share * light[index]).sum(axis=1) / share.sum(axis=1)
            result[few] += mean[:, None] * np.array(weights)
    return result


def _points(
    mesh: Mesh, density: float, near: object, reach: float, random: np.random.Generator
) -> tuple[Float, Float]:
    """Return random points on the faces within reach of the places, and their normals."""
    points, normals = [], []
    for part in mesh.parts:
        corners = mesh.normalised(part.positions)[part.faces]
        sides = corners[:, 1:] - corners[:, :1]
        area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        middle = corners.mean(axis=1)
        size = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1)
        away = near.query(middle)[0]  # type: ignore[attr-defined]
        wanted = density * area * (away < reach + size)
        face = np.repeat(
            np.arange(len(area)), np.floor(wanted + random.random(len(area))).astype(int)
        )
        u = random.random((len(face), 2))
        u = np.where(u.sum(axis=1, keepdims=True) > 1.0, 1.0 - u, u)
        share = np.stack([1.0 - u.sum(axis=1), u[:, 0], u[:, 1]], axis=-1)
        points.append(np.einsum("ij,ijk->ik", share, corners[face]))
        normal = np.einsum("ij,ijk->ik", share, part.normals[part.faces[face]])
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    return np.concatenate(points), np.concatenate(normals)
