"""Error of shadow maps against ray tracing: the visible fraction of a light at pixel centres."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.renderer import Renderer
from facerender.mesh.mesh import Mesh, drawn_alpha
from facerender.scene.light import Light, light_axes
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading

Float = NDArray[np.float64]

# From the surface to the start of a ray, in radii of the bounding sphere. The larger offset hides
# the triangles of a mesh and the noise of a scan.
_OFFSET, _SMALL_OFFSET = 2e-3, 1e-4
_MIXED = 37  # without a common factor with the number of rays
_PLAIN = Shading(normal_map=False)


@dataclass(frozen=True)
class ShadowError:
    """Errors over the pixels that face a light, weighted by N.L except for ``wrong``.

    Attributes
    ----------
    shadowed : fraction of the light that does not arrive
    without : mean absolute error of an image without shadows, relative to the light that arrives
    mean : mean absolute error of the image with the shadow map, relative to the same light
    lost : mean signed error; positive if the shadow map removes more light than it adds
    wrong : fraction of the pixels whose visibility differs by more than 0.5
    """

    shadowed: float
    without: float
    mean: float
    lost: float
    wrong: float


def shadow_error(renderer: Renderer, scene: Scene, light: Light, stride: int = 1) -> ShadowError:
    """Compare the shadow map of one light with 64 rays per pixel.

    stride : 1 to compare every pixel, N to compare one of N pixels
    """
    lit = replace(scene, lights=(replace(light, shadow=True),))
    gbuffer = renderer.gbuffer(lit, _PLAIN)
    position = gbuffer.normalised_position.astype(np.float64)
    towards, _ = light.kind.lighting(light, scene.mesh.space, position)
    cosine = np.einsum("...i,...i", gbuffer.normal.astype(np.float64), towards)
    facing = (gbuffer.part >= 0) & (cosine > 0.0)
    facing &= np.arange(facing.size).reshape(facing.shape) % stride == 0
    truth = by_rays(scene.mesh, gbuffer, light, facing, _OFFSET)
    inside = np.isfinite(truth)
    truth, weight = truth[inside], cosine[facing][inside]
    seen = gbuffer.visibility[..., 0][facing][inside]
    arrives = float((truth * weight).sum())
    return ShadowError(
        1.0 - arrives / float(weight.sum()),
        float(((1.0 - truth) * weight).sum()) / arrives,
        float((np.abs(seen - truth) * weight).sum()) / arrives,
        float(((truth - seen) * weight).sum()) / arrives,
        float((np.abs(seen - truth) > 0.5).mean()),
    )


def by_rays(
    mesh: Mesh,
    gbuffer: GBuffer,
    light: Light,
    pixels: NDArray[np.bool_],
    offset: float,
    side: int = 8,
) -> Float:
    """Return the fraction of a light that the surface in each pixel sees.

    Each ray goes through another place of the pixel and to another point of the light's disc. It
    starts on the curved surface of ``shaders/host/shadow.glsl``.

    Parameters
    ----------
    gbuffer : drawn without normal maps
    offset : distance along the normal from the surface to the start of a ray
    side : square root of the number of rays per pixel

    Returns
    -------
    NaN for pixels where a ray misses the mesh
    """
    tracer, view, rays = tracer_of(mesh), gbuffer.view, side**2
    back, axes = np.linalg.inv(view.matrix), light_axes(light, mesh.space)
    rows, columns = np.nonzero(pixels)
    turn = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(rows))
    seen = np.zeros(len(rows))
    for i in range(rays):
        at = np.ones((len(rows), 4))
        at[:, 0] = 2.0 * (columns + (i % side + 0.5) / side) / pixels.shape[1] - 1.0
        at[:, 1] = 2.0 * (rows + (i // side + 0.5) / side) / pixels.shape[0] - 1.0
        at = at @ back
        ray = at[:, :3] / at[:, 3:] - view.position
        face = tracer.intersects_first(np.broadcast_to(view.position, ray.shape), ray)
        normal = tracer.mesh.face_normals[face]
        across = np.einsum("ij,ij->i", normal, ray)
        plane = tracer.mesh.triangles[face, 0] - view.position
        hit = (np.einsum("ij,ij->i", normal, plane) / across)[:, None] * ray + view.position
        hit += _curve(tracer.mesh, face, hit, -ray)
        hit -= offset * np.sign(across)[:, None] * normal
        radius = math.tan(math.radians(light.radius)) * math.sqrt((_MIXED * i % rays + 0.5) / rays)
        angle = 2.39996323 * (_MIXED * i % rays) + turn
        away = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ axes.T[:2]
        if light.position is None:
            direction = axes[:, 2] + away
        else:
            place = mesh.normalised(light.position)
            direction = place + np.linalg.norm(place) * away - hit
        seen += np.where(face >= 0, ~tracer.intersects_any(hit, direction), np.nan)
    return seen / rays


def _curve(mesh: Any, faces: NDArray[np.int64], points: Float, towards: Float) -> Float:
    """Return the offsets (N, 3) from triangles to the curved surface of the vertex normals.

    Parameters
    ----------
    faces : index of each point's triangle
    points : points (N, 3) on the triangles
    towards : directions to the visible side of the surface
    """
    corners, normals = (each[mesh.faces[faces]] for each in (mesh.vertices, mesh.vertex_normals))
    edges, aside = corners[:, 1:] - corners[:, :1], points - corners[:, 0]
    # The normal equations have 2 x 2 matrices, so solving them is faster than np.linalg.pinv.
    products = np.einsum("ijk,ilk->ijl", edges, edges)
    rest = np.linalg.solve(products, np.einsum("ijk,ik->ij", edges, aside)[..., None])[..., 0]
    weights = np.concatenate([1.0 - rest.sum(axis=1, keepdims=True), rest], axis=1)
    normal = np.einsum("ij,ijk->ik", weights, normals)
    side = np.sign(np.einsum("ij,ij->i", normal, towards))
    planes = np.einsum("ij,ijk,ijk->i", weights, corners, normals)
    height = 0.5 * side * (planes - np.einsum("ij,ij->i", points, normal))
    unit = side[:, None] * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(np.maximum(height, 0.0)[:, None] * unit)


def blocking(mesh: Mesh) -> list[int]:
    """Return the indices of the parts that block light: opaque, without transmission."""
    pairs = enumerate(zip(mesh.parts, mesh.materials, strict=True))
    return [i for i, own in pairs if drawn_alpha(*own) == "opaque" and not own[1].transmission]


def tracer_of(mesh: Mesh) -> Any:
    """Return a ray tracer for the parts of a mesh that block light, in the renderer's space."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    parts = [mesh.parts[i] for i in blocking(mesh)]
    positions = [mesh.normalised(part.positions) for part in parts]
    firsts = np.cumsum([0, *map(len, positions)])
    faces = [part.faces + first for part, first in zip(parts, firsts[:-1], strict=True)]
    normals = np.concatenate([part.normals for part in parts])
    whole = trimesh.Trimesh(
        np.concatenate(positions), np.concatenate(faces), vertex_normals=normals, process=False
    )
    return RayMeshIntersector(whole)


def edge_error(
    renderer: Renderer, scene: Scene, light: Light, lowest: float, highest: float
) -> float:
    """Return the mean absolute error of a hard shadow in a band of 8 pixels around its edge.

    64 rays through each pixel give the true fraction of the pixel's surface that sees the light.

    lowest, highest : range of the surface's y, in the renderer's space, to consider
    """
    lit = replace(scene, lights=(replace(light, shadow=True),))
    gbuffer = renderer.gbuffer(lit, _PLAIN)
    y = gbuffer.normalised_position[..., 1]
    towards, _ = light.kind.lighting(
        light, scene.mesh.space, gbuffer.normalised_position.astype(np.float64)
    )
    facing = np.einsum("...i,...i", gbuffer.normal.astype(np.float64), towards) > 0.15
    part = (gbuffer.part >= 0) & (y > lowest) & (y < highest) & facing
    rough = np.zeros(part.shape)
    rough[part] = by_rays(scene.mesh, gbuffer, light, part, _SMALL_OFFSET, 1)
    edge = np.zeros_like(part)
    for axis in (0, 1):
        step = np.roll(rough, 1, axis) != rough
        edge |= step & part & np.roll(part, 1, axis)
    band = edge.copy()
    for _ in range(4):
        band |= np.logical_or.reduce(
            [np.roll(band, *each) for each in ((1, 0), (-1, 0), (1, 1), (-1, 1))]
        )
    band &= part
    truth = by_rays(scene.mesh, gbuffer, light, band, _SMALL_OFFSET)
    known = np.isfinite(truth)
    return float(np.abs(gbuffer.visibility[band][known, 0] - truth[known]).mean())


def light_in_cavities(
    renderer: Renderer, scene: Scene, centre: Float, radius: float
) -> tuple[float, float, float]:
    """Return the mean irradiance of cavities: with shadows, traced, and without shadows.

    A cavity consists of the pixels that see less than 0.35 of the hemisphere above them.

    Parameters
    ----------
    scene : scene whose lights cast shadows
    centre, radius : sphere around the cavities, in the renderer's space
    """
    gbuffer = renderer.gbuffer(scene, _PLAIN)
    near = np.linalg.norm(gbuffer.normalised_position - centre, axis=-1) < radius
    near &= gbuffer.part >= 0
    inside = near.copy()
    inside[near] = _openness(scene.mesh, gbuffer, near) < 0.35
    sums = np.zeros(3)
    for index, light in enumerate(scene.lights):
        position = gbuffer.normalised_position[inside].astype(np.float64)
        towards, irradiance = light.kind.lighting(light, scene.mesh.space, position)
        cosine = np.einsum("...i,...i", gbuffer.normal[inside].astype(np.float64), towards)
        arriving = np.clip(cosine, 0.0, 1.0) * np.mean(irradiance)
        traced = by_rays(scene.mesh, gbuffer, light, inside, _SMALL_OFFSET)
        drawn = gbuffer.visibility[inside][:, index]
        known = np.isfinite(traced)
        for i, seen in enumerate((drawn, traced, np.ones_like(drawn))):
            sums[i] += float((arriving * seen)[known].mean())
    return float(sums[0]), float(sums[1]), float(sums[2])


def _openness(mesh: Mesh, gbuffer: GBuffer, pixels: NDArray[np.bool_], rays: int = 64) -> Float:
    """Return the cosine-weighted fraction of the hemisphere that each pixel sees."""
    normal = gbuffer.normal[pixels].astype(np.float64)
    origin = gbuffer.normalised_position[pixels] + _OFFSET * normal
    tracer, random = tracer_of(mesh), np.random.default_rng(2)
    free = np.zeros(len(origin))
    for _ in range(rays):
        around = random.normal(size=normal.shape)
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        free += ~tracer.intersects_any(origin, normal + 0.999 * around)
    return free / rays
