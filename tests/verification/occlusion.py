"""Error of occlusion baked at vertices against rays at pixels, and the time that baking takes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.renderer import Renderer
from facerender.mesh.mesh import Mesh
from facerender.mesh.occlusion import with_occlusion
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from tests.verification.shadows import blocking, tracer_of

Float = NDArray[np.float64]

_OFFSET = 2e-4  # from the surface to the start of a ray, in radii of the bounding sphere


@dataclass(frozen=True)
class OcclusionError:
    """Mean absolute errors of the fraction of uniform ambient light that pixels receive.

    Attributes
    ----------
    without, baked : without occlusion, and with baked occlusion
    seconds : time for baking
    """

    without: float
    baked: float
    seconds: float


def occlusion_error(
    renderer: Renderer, scene: Scene, pixels: int = 4000, rays: int = 512
) -> OcclusionError:
    """Compare baked occlusion with cosine-weighted random rays at randomly chosen pixels of the
    parts that block light."""
    begin = time.perf_counter()
    baked = replace(scene, mesh=with_occlusion(scene.mesh))
    seconds = time.perf_counter() - begin
    gbuffer = renderer.gbuffer(baked, Shading(normal_map=False))
    rng = np.random.default_rng(3)
    where = rng.permutation(np.flatnonzero(np.isin(gbuffer.part, blocking(scene.mesh))))[:pixels]
    position, normal = (
        each.reshape(-1, 3)[where].astype(np.float64)
        for each in (gbuffer.normalised_position, gbuffer.normal)
    )
    truth = open_fraction(scene.mesh, position, normal, rays, rng)
    found = gbuffer.occlusion.ravel()[where]
    return OcclusionError(float((1.0 - truth).mean()), float(np.abs(found - truth).mean()), seconds)


def open_fraction(
    mesh: Mesh, position: Float, normal: Float, rays: int, rng: np.random.Generator
) -> Float:
    """Return the fraction of cosine-weighted rays about normals that miss the mesh, (N,)."""
    tracer, seen = tracer_of(mesh), np.zeros(len(position))
    for _ in range(rays):
        towards = rng.normal(size=position.shape)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        seen += ~tracer.intersects_any(position + _OFFSET * normal, normal + towards)
    return seen / rays
