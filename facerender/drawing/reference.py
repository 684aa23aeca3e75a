"""Float64 shading of a G-buffer: the reference for whole images, and the views that are data. No
OpenGL here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.prepare import simplify
from facerender.scenes.scene import Scene, slope_ranges
from facerender.shading import Shading


@dataclass(frozen=True, eq=False)
class Layers:
    """Radiance of a G-buffer's pixels, apart: its sum is the image.

    Attributes
    ----------
    ambient, diffuse : (H, W, 3) float64
    specular : (lights, H, W, 3) float64
    """

    ambient: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    specular: NDArray[np.float64]

    def sum(self, shading: Shading) -> NDArray[np.float64]:
        """Return the image (H, W, 3) of the lights and the ambient term that a shading has."""
        image = self.diffuse + self.ambient if shading.ambient else self.diffuse.copy()
        for light, specular in enumerate(self.specular):
            if shading.of(light) is not None:
                image += specular
        return image


def shade(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Shade every covered pixel of a G-buffer as ``shaders/host/shade.frag`` does.

    Parameters
    ----------
    gbuffer : as ``Renderer.gbuffer`` draws it with this scene and shading

    Returns
    -------
    (H, W, 3) float64: linear radiance, 0 where nothing is covered

    Raises
    ------
    InputError : m lies outside the lobe's domain, and the shading asks for an error then
    """
    return layers(gbuffer, scene, shading).sum(shading)


def layers(gbuffer: GBuffer, scene: Scene, shading: Shading) -> Layers:
    """Return the terms that :func:`shade` sums up, the specular one of every light; parameters and
    errors as there."""
    scene = simplify(scene, shading)
    ambient, diffuse = np.zeros((2, *gbuffer.position.shape))
    specular = np.zeros((len(scene.lights), *gbuffer.position.shape))
    terms = [shading.of(light) or shading.term for light in range(len(scene.lights))]
    for index, (material, slopes) in enumerate(
        zip(scene.mesh.materials, slope_ranges(scene), strict=True)
    ):
        own = [term.for_slopes(*slopes, shading.outside) for term in terms]
        covered = gbuffer.part == index
        if not covered.any():
            continue
        position = gbuffer.position[covered].astype(np.float64)
        n = gbuffer.normal[covered].astype(np.float64)
        m = gbuffer.m[covered].astype(np.float64)
        albedo = material.kd / np.pi * gbuffer.albedo[covered].astype(np.float64)
        weight = gbuffer.specular_weight[covered].astype(np.float64)
        v = _normalised(gbuffer.view.eye - position)

        occlusion = gbuffer.occlusion[covered].astype(np.float64)
        ambient[covered] = albedo * occlusion[:, None] * np.asarray(scene.ambient)
        for light, (source, term) in enumerate(zip(scene.lights, own, strict=True)):
            l, irradiance = source.kind.lighting(source, scene.mesh, position)
            received = irradiance * np.maximum(np.einsum("...i,...i", n, l), 0.0)[:, None]
            diffuse[covered] += albedo * received
            value = term.brdf(n, l, v, m, material.f0)
            if material.two_lobes:
                assert gbuffer.second_m is not None
                assert gbuffer.lobe_weight is not None
                second = term.second(material.second_slope)
                second_m = gbuffer.second_m[covered].astype(np.float64)
                share = gbuffer.lobe_weight[covered].astype(np.float64)
                value = share * value + (1.0 - share) * second.brdf(n, l, v, second_m, material.f0)
            specular[light][covered] = received * (weight * value)[:, None]
    return Layers(ambient, diffuse, specular)


def data_view(
    gbuffer: GBuffer, scene: Scene, only: Literal["albedo", "normal", "depth", "cosines"]
) -> NDArray[np.float32]:
    """Return a view of the G-buffer, (H, W, 4) float32 with coverage; see ``Frame.linear``."""
    covered = gbuffer.part >= 0
    view = np.zeros((*covered.shape, 4), dtype=np.float32)
    view[..., 3] = covered
    position = gbuffer.position[covered].astype(np.float64)
    normal = gbuffer.normal[covered].astype(np.float64)
    to_eye = gbuffer.view.eye - position
    if only == "albedo":
        values = gbuffer.albedo[covered]
    elif only == "normal":
        values = gbuffer.normal[covered]
    elif only == "depth":
        depth = -(to_eye @ gbuffer.view.forward) * scene.mesh.radius
        values = np.repeat(depth[:, None], 3, axis=1)
    else:
        v = _normalised(to_eye)
        l = v
        if scene.lights:
            key = scene.lights[0]
            l, _ = key.kind.lighting(key, scene.mesh, position)
        h = _normalised(l + v)
        values = np.stack([(normal * direction).sum(axis=-1) for direction in (l, v, h)], axis=-1)
    view[covered, :3] = values
    return view


def _normalised(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.sqrt(np.einsum("...i,...i", vectors, vectors))[..., None]
    return np.asarray(vectors / np.maximum(length, 1e-300))
