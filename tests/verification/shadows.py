"""Error of shadow maps against ray tracing: the visible fraction of a light at pixel centres."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.renderer import Renderer
from facerender.scenes.light import Light, light_axes
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.shading import Shading

Float = NDArray[np.float64]

_OFFSET = 2e-3  # from the surface to the start of a ray, in radii of the bounding sphere
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


def shadow_error(renderer: Renderer, scene: Scene, light: Light, rays: int = 64) -> ShadowError:
    """Compare the shadow map of one light with rays at every pixel's centre."""
    lit = replace(scene, lights=(replace(light, shadow=True),))
    gbuffer = renderer.gbuffer(lit, _PLAIN)
    position = gbuffer.position.astype(np.float64)
    towards, _ = light.kind.lighting(light, scene.mesh, position)
    cosine = np.einsum("...i,...i", gbuffer.normal.astype(np.float64), towards)
    facing = (gbuffer.part >= 0) & (cosine > 0.0)
    seen = gbuffer.visibility[..., 0][facing]
    truth = by_rays(scene.mesh, gbuffer, light, facing, rays)
    weight = cosine[facing]
    arrives = float((truth * weight).sum())
    return ShadowError(
        1.0 - arrives / float(weight.sum()),
        float(((1.0 - truth) * weight).sum()) / arrives,
        float((np.abs(seen - truth) * weight).sum()) / arrives,
        float(((truth - seen) * weight).sum()) / arrives,
        float((np.abs(seen - truth) > 0.5).mean()),
    )


def by_rays(
    mesh: Mesh, gbuffer: GBuffer, light: Light, pixels: NDArray[np.bool_], rays: int
) -> Float:
    """Return the fraction of a light that each pixel sees.

    Parameters
    ----------
    gbuffer : drawn without normal maps
    rays : number of rays per pixel, each to a point of the light's disc
    """
    tracer = tracer_of(mesh)
    origin = gbuffer.position[pixels].astype(np.float64)
    origin += _OFFSET * gbuffer.normal[pixels]
    axes = light_axes(light, mesh)
    turn = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(origin))
    seen = np.zeros(len(origin))
    for i in range(rays):
        radius = math.tan(math.radians(light.radius)) * math.sqrt((i + 0.5) / rays)
        angle = 2.39996323 * i + turn
        across = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ axes.T[:2]
        if light.position is None:
            direction = axes[:, 2] + across
        else:
            place = mesh.normalised(light.position)
            direction = place + np.linalg.norm(place) * across - origin
        seen += ~tracer.intersects_any(origin, direction)
    return seen / rays


def tracer_of(mesh: Mesh) -> Any:
    """Return a ray tracer for a mesh in the renderer's space."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    positions = [mesh.normalised(part.positions) for part in mesh.parts]
    firsts = np.cumsum([0, *map(len, positions)])
    faces = [part.faces + first for part, first in zip(mesh.parts, firsts[:-1], strict=True)]
    whole = trimesh.Trimesh(np.concatenate(positions), np.concatenate(faces), process=False)
    return RayMeshIntersector(whole)
