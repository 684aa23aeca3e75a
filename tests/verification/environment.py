"""Error of environment light against rays: the float64 terms of the reference, with the visibility
of every direction at the centres of the pixels. Light is reflected once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.drawing.frame import GBuffer
from facerender.drawing.reference import _parts
from facerender.images.image import linear_to_srgb
from facerender.terms.environment import environment_radiance
from tests.verification.shadows import _curve, tracer_of

Float = NDArray[np.float64]

_OFFSET = 1e-3  # from the surface to the start of a ray, in radii of the bounding sphere
_OCCLUDED = 0.6  # ambient occlusion of creases: lids, lips, nostrils
_AROUND = 2  # pixels around a crease that count


@dataclass(frozen=True)
class EnvironmentError:
    """Errors of an image in 8-bit sRGB levels.

    Attributes
    ----------
    mean, high : mean and 99th percentile over the pixels of the first part, where no blended part
        lies over it
    crease_mean, crease_high : the same within two pixels of creases: lids, lips, nostrils
    """

    mean: float
    high: float
    crease_mean: float
    crease_high: float


def overcast(rows: int = 128) -> fr.Panorama:
    """Return the CIE standard overcast sky over dark ground."""
    up = np.sin(np.pi * (0.5 - (np.arange(rows) + 0.5) / rows))[:, None, None]
    radiance = np.where(up > 0.0, (1.0 + 2.0 * up) / 3.0, 0.15) * [0.9, 1.0, 1.15]
    return fr.Panorama("overcast", np.broadcast_to(radiance, (rows, 2 * rows, 3)))


class Traced:
    """The environment light of a view by rays, for several environments of one scene.

    covered : (H, W), pixels that are compared
    open : (H, W), fraction of uniform light that arrives
    """

    def __init__(self, renderer: fr.Renderer, scene: fr.Scene, count: int) -> None:
        self.renderer, self.scene, self.gbuffer = renderer, scene, renderer.gbuffer(scene)
        index = np.arange(count) + 0.5
        y, angle = 1.0 - 2.0 * index / count, index * np.pi * (3.0 - 5.0**0.5)
        across = np.sqrt(1.0 - y * y)
        self.directions = np.stack([across * np.cos(angle), y, across * np.sin(angle)], axis=-1)
        self.seen = self._seen(self.gbuffer)
        pixels, n = self.gbuffer.part >= 0, self.gbuffer.normal[self.gbuffer.part >= 0]
        cosine = np.maximum(n @ self.directions.T, 0.0)
        self.open = np.ones(pixels.shape)
        self.open[pixels] = (cosine * self.seen).sum(axis=1) / cosine.sum(axis=1)
        self.covered = self.gbuffer.part == 0
        for layer in self.gbuffer.transparent_layers:
            self.covered &= ~_grown(layer.part >= 0, 1)

    def _seen(self, gbuffer: GBuffer) -> NDArray[np.bool_]:
        """Return whether each covered pixel sees each direction, (pixels, directions)."""
        tracer, pixels = tracer_of(self.scene.mesh), gbuffer.part >= 0
        points = gbuffer.normalised_position[pixels].astype(np.float64)
        rays = points - gbuffer.view.position
        face = tracer.intersects_first(np.broadcast_to(gbuffer.view.position, rays.shape), rays)
        normal = tracer.mesh.face_normals[face]
        points += _curve(tracer.mesh, face, points, -rays)
        points -= _OFFSET * np.sign(np.einsum("ij,ij->i", normal, rays))[:, None] * normal
        seen = np.zeros((len(points), len(self.directions)), dtype=bool)
        above = (gbuffer.normal[pixels] @ self.directions.T > 0.0) & (face >= 0)[:, None]
        for index, direction in enumerate(self.directions):
            rows = above[:, index]
            towards = np.broadcast_to(direction, (rows.sum(), 3))
            seen[rows, index] = ~tracer.intersects_any(points[rows], towards)
        return seen

    def radiance(self, environment: fr.Environment, shading: fr.Shading) -> Float:
        """Return the radiance (H, W, 3) of the surfaces; 0 on the background."""
        gbuffer, panorama = self.gbuffer, environment.panorama
        steradians = 4.0 * np.pi / len(self.directions)
        sizes = np.full(len(self.directions), steradians)
        light = environment_radiance(
            panorama.map, len(panorama.map) - 2, self.directions @ environment.turn.T, sizes
        )
        light *= steradians * environment.scale
        image = np.zeros((*gbuffer.part.shape, 3))
        numbers = np.cumsum(gbuffer.part >= 0).reshape(gbuffer.part.shape) - 1
        term = replace(shading.term, lobe="exact", m=None)
        for pixels in _parts(gbuffer, self.scene, shading.term):
            seen, total = self.seen[numbers[pixels.covered]], np.zeros((len(pixels.n), 3))
            cosines, f0 = pixels.n @ self.directions.T, pixels.material.f0
            for index, direction in enumerate(self.directions):
                rows = np.flatnonzero(seen[:, index] & (cosines[:, index] > 0.0))
                n, v = pixels.n[rows], pixels.v[rows]
                l, brdf = np.broadcast_to(direction, n.shape), np.zeros(len(rows))
                for m, fraction in pixels.lobes:
                    fractions = np.broadcast_to(fraction, len(pixels.n))[rows]
                    brdf += fractions * term.brdf(n, l, v, m[rows], f0)
                brdfs = pixels.albedo[rows] + (pixels.weight[rows] * brdf)[:, None]
                total[rows] += brdfs * cosines[rows, index, None] * light[index]
            image[pixels.covered] = total
        return image

    def error(
        self, environment: fr.Environment, shading: fr.Shading, expected: Float
    ) -> EnvironmentError:
        """Return the error of the renderer's image against the result of :meth:`radiance`."""
        scene = replace(self.scene, environment=environment)
        image = self.renderer.render(scene, shading).linear[..., :3].astype(np.float64)
        error = 255.0 * np.abs(linear_to_srgb(image) - linear_to_srgb(expected)).mean(axis=-1)
        creases = self.covered & _grown(self.open < _OCCLUDED, _AROUND)
        pairs = [
            (error[each].mean(), np.percentile(error[each], 99)) for each in (self.covered, creases)
        ]
        return EnvironmentError(*(float(value) for pair in pairs for value in pair))


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Return a mask with the pixels around it."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(mask, 2 * pixels + 1))
