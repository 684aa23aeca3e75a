"""Float64 shading of a G-buffer: the reference for whole images, and the views that are data. No
OpenGL here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from facerender import brdf
from facerender.drawing.frame import GBuffer
from facerender.drawing.prepare import simplify
from facerender.scenes.light import half_sum
from facerender.scenes.material import Material
from facerender.scenes.scene import Only, Scene, slope_ranges
from facerender.shading import Shading, Term
from facerender.terms.slope_variance import cosine_disc, slope_filtered, slope_variance_disc

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Layers:
    """Radiance of a G-buffer's pixels, apart: its sum is the image.

    Attributes
    ----------
    ambient, diffuse : (H, W, 3) float64
    specular : (lights, H, W, 3) float64
    environment : (H, W, 3) float64, diffuse and specular
    emission : (H, W, 3) float32, what surfaces give off themselves; None where none does
    light, albedo : (H, W, 3) float64, irradiance of the diffuse term and of the ambient one
        together, and what makes radiance of it; None where nothing scatters
    """

    ambient: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    specular: NDArray[np.float64]
    environment: NDArray[np.float64]
    light: NDArray[np.float64] | None = None
    albedo: NDArray[np.float64] | None = None
    emission: NDArray[np.float32] | None = None

    def sum(self, shading: Shading) -> NDArray[np.float64]:
        """Return the image (H, W, 3) of the lights and the ambient term that a shading has."""
        image = self.diffuse + self.environment
        if shading.ambient:
            image += self.ambient
        if self.emission is not None:
            image += self.emission
        for light, specular in enumerate(self.specular):
            if shading.of(light) is not None:
                image += specular
        return image


def shade(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Shade every covered pixel of a G-buffer as ``shaders/host/shade.frag`` does, scatter its
    light as ``scatter.frag`` does, and lay its blended parts over that.

    Parameters
    ----------
    gbuffer : as ``Renderer.gbuffer`` draws it with this scene and shading

    Returns
    -------
    (H, W, 3) float64: linear radiance times coverage, 0 where nothing is covered

    Raises
    ------
    InputError : m lies outside the lobe's domain, and the shading asks for an error then
    """
    terms = layers(gbuffer, scene, shading)
    image = terms.sum(shading) + scattered(gbuffer, scene, shading, terms)
    for layer in gbuffer.transparent_layers:
        assert layer.opacity is not None
        over = layer.opacity[..., None].astype(np.float64)
        image = over * layers(layer, scene, shading).sum(shading) + (1.0 - over) * image
    return image


def scattered(
    gbuffer: GBuffer, scene: Scene, shading: Shading, terms: Layers
) -> NDArray[np.float64]:
    """Return how scattering changes the radiance of a whole G-buffer's pixels, (H, W, 3).

    Parameters
    ----------
    terms : of the G-buffer, as :func:`layers` has them
    """
    change = np.zeros(gbuffer.position.shape)
    height, width = gbuffer.part.shape
    if terms.light is None or terms.albedo is None or gbuffer.facing is None:
        return change
    from facerender.scenes.scattering import scattering_of
    from facerender.terms.scattering import scatter, scatter_area

    if (found := scattering_of(simplify(scene, shading), (width, height))) is None:
        return change
    number = np.array([*found.numbers, 0])[gbuffer.part]
    place, area = gbuffer.position.astype(np.float64), scatter_area(gbuffer.facing)
    for index, gaussians in enumerate(found.profiles, 1):
        own = number == index
        depth = (place[own] - gbuffer.view.position) @ gbuffer.view.forward
        scale = found.pixels / (depth * found.millimetres)
        size = scale, found.millimetres, gaussians, shading.scatter_samples
        light = scatter(terms.light, place, number, area, *size, own)
        change[own] = terms.albedo[own] * (light - terms.light[own])
    return change


def layers(
    gbuffer: GBuffer,
    scene: Scene,
    shading: Shading,
    environment: NDArray[np.float64] | None = None,
) -> Layers:
    """Return the terms that :func:`shade` sums up, the specular one of every light; parameters and
    errors as there.

    environment : what :func:`environment_layer` gave, where that is known
    """
    if environment is None:
        environment = environment_layer(gbuffer, scene, shading)
    scene = simplify(scene, shading)
    pinned = shading.constant_slope
    ambient, diffuse = np.zeros((2, *gbuffer.position.shape))
    specular = np.zeros((len(scene.lights), *gbuffer.position.shape))
    scatters = any(material.scattering for material in scene.mesh.materials)
    light_of, albedo_of = np.zeros((2, *gbuffer.position.shape)) if scatters else (None, None)
    terms = [shading.of(light) or shading.term for light in range(len(scene.lights))]
    for index, (material, slopes) in enumerate(
        zip(scene.mesh.materials, slope_ranges(scene, shading), strict=True)
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
        v = _normalised(gbuffer.view.position - position)

        occlusion = gbuffer.occlusion[covered].astype(np.float64)
        coupling = None
        if shading.diffuse == "coupled" and material.ks > 0.0:
            n_dot_v = np.einsum("...i,...i", n, v)
            coupling = _Coupling.at(gbuffer, covered, material, n_dot_v, pinned)
        left = coupling.left(coupling.mean) if coupling else 1.0
        entered = occlusion[:, None] * np.asarray(scene.ambient) * left
        ambient[covered] = albedo * entered
        for light, (source, term) in enumerate(zip(scene.lights, own, strict=True)):
            l, irradiance = source.kind.lighting(source, scene.mesh, position)
            if source.shadow:
                irradiance = irradiance * gbuffer.visibility[covered][:, light, None]
            cosine = np.einsum("...i,...i", n, l)
            received = irradiance * np.maximum(cosine, 0.0)[:, None]
            spread, variance = received, np.zeros(len(m))
            if source.kind.sine is not None:
                s = source.kind.sine(source, scene.mesh, position)[..., 0]
                k = half_sum(s)
                spread = irradiance * cosine_disc(cosine, s, k)[:, None]
                variance = slope_variance_disc(s, k, 0.5 * np.linalg.norm(l + v, axis=-1))
            left = coupling.left(coupling.towards(cosine)) if coupling else 1.0
            diffuse[covered] += albedo * spread * left
            entered = entered + spread * left
            value = term.brdf(n, l, v, slope_filtered(m, variance), material.f0)
            if material.two_lobes:
                assert gbuffer.second_m is not None
                assert gbuffer.lobe_weight is not None
                second = term.second(material.second_slope)
                second_m = slope_filtered(gbuffer.second_m[covered], variance)
                share = gbuffer.lobe_weight[covered].astype(np.float64)
                value = share * value + (1.0 - share) * second.brdf(n, l, v, second_m, material.f0)
            specular[light][covered] = received * (weight * value)[:, None]
        if light_of is not None and albedo_of is not None:
            light_of[covered], albedo_of[covered] = entered, albedo
    more = light_of, albedo_of, gbuffer.emission
    return Layers(ambient, diffuse, specular, environment, *more)


def environment_layer(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Return the radiance (H, W, 3) that the environment adds; parameters and errors as of
    :func:`shade`. No light, no lobe and no digits of small angles count."""
    scene = simplify(scene, shading)
    image = np.zeros(gbuffer.position.shape)
    if scene.environment is None:
        return image
    from facerender.terms.environment import environment_irradiance, reflected

    panorama, turn = scene.environment.panorama, scene.environment.turn
    map_ = panorama.map
    term, samples = replace(shading.term, lobe="exact"), shading.environment_samples
    for index, material in enumerate(scene.mesh.materials):
        covered = gbuffer.part == index
        if not covered.any():
            continue
        n = gbuffer.normal[covered].astype(np.float64)
        v = _normalised(gbuffer.view.position - gbuffer.position[covered].astype(np.float64))
        albedo = material.kd / np.pi * gbuffer.albedo[covered].astype(np.float64)
        occlusion = gbuffer.occlusion[covered].astype(np.float64)[:, None]
        total = albedo * occlusion * environment_irradiance(panorama.coefficients, n @ turn.T)
        if shading.diffuse == "coupled" and material.ks > 0.0:
            n_dot_v = np.einsum("...i,...i", n, v)
            coupling = _Coupling.at(gbuffer, covered, material, n_dot_v, shading.constant_slope)
            total *= coupling.left(coupling.mean)
        weight = gbuffer.specular_weight[covered].astype(np.float64)
        lobes = [(gbuffer.m, weight, term)]
        if material.two_lobes:
            assert gbuffer.second_m is not None
            assert gbuffer.lobe_weight is not None
            first = gbuffer.lobe_weight[covered] * weight
            second = gbuffer.second_m, weight - first, term.second(material.second_slope)
            lobes = [(gbuffer.m, first, term), second]
        for slopes, share, own in lobes * bool(samples and material.ks > 0.0):
            m = slopes[covered].astype(np.float64) if own.m is None else own.m
            brdf = partial(_brdf, replace(own, m=None), material.f0)
            seen = reflected(map_, len(map_) - 2, n @ turn.T, v @ turn.T, m, brdf, samples)
            total += share[:, None] * seen
        image[covered] = scene.environment.scale * total
    return image


def _brdf(term: Term, f0: float, n: Float, l: Float, v: Float, m: Float) -> Float:
    return term.brdf(n, l, v, m, f0)


@dataclass(frozen=True, eq=False)
class _Coupling:
    """What specular terms leave to diffuse ones.

    Attributes
    ----------
    lobes : slope and weight of each lobe, (N,)
    f0 : of the material
    eye, mean : albedo towards the eye, and over the hemisphere, (N,)
    """

    lobes: list[tuple[Float, Float]]
    f0: float
    eye: Float
    mean: Float

    @classmethod
    def at(
        cls,
        gbuffer: GBuffer,
        covered: NDArray[np.bool_],
        material: Material,
        n_dot_v: Float,
        m: float | None,
    ) -> _Coupling:
        """m : in place of the G-buffer's"""
        weight = gbuffer.specular_weight[covered].astype(np.float64)
        slope = gbuffer.m[covered].astype(np.float64) if m is None else np.full_like(weight, m)
        lobes = [(slope, weight)]
        if material.two_lobes:
            assert gbuffer.second_m is not None
            assert gbuffer.lobe_weight is not None
            second = gbuffer.second_m[covered].astype(np.float64)
            second = second if m is None else slope * material.second_slope
            share = gbuffer.lobe_weight[covered].astype(np.float64)
            lobes = [(slope, share * weight), (second, (1.0 - share) * weight)]
        means = (w * brdf.cook_torrance_albedo_mean(each, material.f0) for each, w in lobes)
        bare = cls(lobes, material.f0, weight, np.sum([*means], axis=0))
        return replace(bare, eye=bare.towards(n_dot_v))

    def towards(self, cosine: Float) -> Float:
        """Return the albedo towards directions."""
        each = (w * brdf.cook_torrance_albedo(cosine, m, self.f0) for m, w in self.lobes)
        return np.asarray(np.sum([*each], axis=0))

    def left(self, albedo: Float) -> Float:
        """Return the share that is left to light of this albedo, (N, 1)."""
        return brdf.diffuse_coupled(albedo, self.eye, self.mean)[:, None]


def data_view(gbuffer: GBuffer, scene: Scene, only: Only) -> NDArray[np.float32]:
    """Return a view of the G-buffer, (H, W, 4) float32 with coverage; see ``Frame.linear``."""
    covered = gbuffer.part >= 0
    view = np.zeros((*covered.shape, 4), dtype=np.float32)
    view[..., 3] = covered
    position = gbuffer.position[covered].astype(np.float64)
    normal = gbuffer.normal[covered].astype(np.float64)
    to_eye = gbuffer.view.position - position
    if only == "albedo":
        values = gbuffer.albedo[covered]
    elif only == "normal":
        values = gbuffer.normal[covered]
    elif only == "depth":
        depth = -(to_eye @ gbuffer.view.forward) * scene.mesh.radius
        values = np.repeat(depth[:, None], 3, axis=1)
    elif only == "visibility":
        dark = next((i for i, light in enumerate(scene.lights) if light.shadow), None)
        seen = np.ones(len(to_eye)) if dark is None else gbuffer.visibility[covered][:, dark]
        values = np.repeat(seen[:, None], 3, axis=1)
    elif only in ("mask", "parts"):
        number = gbuffer.part[covered] + 1
        values = np.repeat(np.minimum(number, 1 if only == "mask" else number)[:, None], 3, axis=1)
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
