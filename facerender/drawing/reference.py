"""The reference implementation for whole images, which shades a G-buffer in float64. No OpenGL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.prepare import resolve, simplify
from facerender.material import Material
from facerender.scene.light import Light, half_sum
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading, Term
from facerender.terms.environment import (
    cook_torrance_albedo,
    cook_torrance_albedo_mean,
    diffuse_coupled,
)
from facerender.terms.model import cosine_disc, dot, slope_filtered, slope_variance_disc
from facerender.values.vectors import unit

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Layers:
    """Radiance of a G-buffer's pixels, one array per term; the sum of the terms is the image.

    ambient, diffuse : (H, W, 3) float64, radiance of each of these terms
    specular : (lights, H, W, 3) float64, specular radiance from each light
    environment : (H, W, 3) float64, diffuse and specular radiance from the environment map
    emission : (H, W, 3) float32, emitted radiance; None if no material emits light
    light : (H, W, 3) float64, summed irradiance of diffuse and ambient terms; None if no material
        scatters
    albedo : (H, W, 3) float64, diffuse BRDF: diffuse radiance divided by ``light``; None if no
        material scatters
    """

    ambient: Float
    diffuse: Float
    specular: Float
    environment: Float
    light: Float | None = None
    albedo: Float | None = None
    emission: NDArray[np.float32] | None = None

    def sum(self, shading: Shading) -> NDArray[np.float64]:
        """Return the image (H, W, 3). The ambient term and the specular term of each light are
        included only if the shading has them."""
        image = self.diffuse + self.environment
        if shading.ambient:
            image += self.ambient
        if self.emission is not None:
            image += self.emission
        for light, specular in enumerate(self.specular):
            if shading.shines(light):
                image += specular
        return image


def shade(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Shade a G-buffer as ``shaders/host/shade.frag`` does, add subsurface scattering as in
    ``scatter.frag``, and composite the blended parts over the image.

    Parameters
    ----------
    gbuffer : the result of ``Renderer.gbuffer`` for this scene and shading

    Returns
    -------
    (H, W, 3) float64: linear radiance times coverage, 0 on the background

    Raises
    ------
    InputError : m lies outside the lobe's domain, and ``shading.outside`` is "error"
    """
    terms = layers(gbuffer, scene, shading)
    image = terms.sum(shading) + scattered(gbuffer, scene, shading, terms)
    for layer in gbuffer.transparent_layers:
        assert layer.opacity is not None
        opacity = layer.opacity[..., None].astype(np.float64)
        behind = 1.0 - (1.0 - layer.transmission) * opacity
        image = opacity * layers(layer, scene, shading).sum(shading) + behind * image
    return image


def scattered(gbuffer: GBuffer, scene: Scene, shading: Shading, terms: Layers) -> Float:
    """Return the radiance (H, W, 3) float64 that subsurface scattering adds or removes.

    gbuffer : G-buffer of the whole image, not of a section
    terms : the result of :func:`layers` for this G-buffer
    """
    change = np.zeros(gbuffer.normalised_position.shape)
    if terms.light is None or terms.albedo is None or gbuffer.facing is None:
        return change
    from facerender.scene.scattering import scattering_of
    from facerender.terms.transport import scatter, scatter_area

    size = gbuffer.part.shape[1], gbuffer.part.shape[0]
    if (scattering := scattering_of(simplify(scene, shading), size)) is None:
        return change
    number = np.array([*scattering.numbers, 0])[gbuffer.part]
    place, area = gbuffer.normalised_position.astype(np.float64), scatter_area(gbuffer.facing)
    for index, gaussians in enumerate(scattering.profiles, 1):
        pixels = number == index
        depth = (place[pixels] - gbuffer.view.position) @ gbuffer.view.forward
        scale = scattering.pixels / (depth * scattering.millimetres)
        light = scatter(
            terms.light, place, number, area, pixels,
            scale=scale, unit=scattering.millimetres, gaussians=gaussians,
            samples=shading.scatter_samples,
        )  # fmt: skip
        change[pixels] = terms.albedo[pixels] * (light - terms.light[pixels])
    return change


@dataclass(frozen=True, eq=False)
class _Pixels:
    """The N pixels of a G-buffer that a part covers.

    position : (N, 3) in the renderer's space
    n : (N, 3) unit normal
    v : (N, 3) unit vector to the camera
    lobes : m (N,) of each lobe, and its fraction of the specular weight: 1 or (N,)
    weight : (N,) specular weight
    occlusion : (N,) ambient occlusion
    albedo : (N, 3) diffuse BRDF, the ratio of diffuse radiance to irradiance
    """

    position: Float
    n: Float
    v: Float
    lobes: list[tuple[Float, Float | float]]
    weight: Float
    occlusion: Float
    albedo: Float

    @classmethod
    def of(
        cls, gbuffer: GBuffer, covered: NDArray[np.bool_], material: Material, term: Term
    ) -> _Pixels:
        """Return the pixels of a part.

        covered : (H, W), true at the pixels of the part
        term : term of the shading; a constant m of this term replaces the m of the G-buffer
        """

        def values(image: NDArray[np.float32]) -> Float:
            return image[covered].astype(np.float64)

        position, m = values(gbuffer.normalised_position), values(gbuffer.m)
        m = np.broadcast_to(term.slope(m), m.shape)
        lobes: list[tuple[Float, Float | float]] = [(m, 1.0)]
        if material.two_lobes:
            assert gbuffer.second_m is not None
            assert gbuffer.lobe_weight is not None
            second = term.second(material.second_slope).slope(values(gbuffer.second_m))
            fraction = values(gbuffer.lobe_weight)
            lobes = [(m, fraction), (np.broadcast_to(second, m.shape), 1.0 - fraction)]
        return cls(
            position,
            values(gbuffer.normal),
            unit(gbuffer.view.position - position),
            lobes,
            values(gbuffer.specular_weight),
            values(gbuffer.occlusion),
            material.diffuse_weight / np.pi * values(gbuffer.albedo),
        )

    def coupling(
        self, material: Material, shading: Shading
    ) -> Callable[[Float | None], Float | float]:
        """Return the function that computes the factor (N, 1) of the diffuse term for a light, or
        1, from the cosine (N,) between light and normal, or from None for light from all sides."""
        if shading.diffuse != "coupled" or material.ks <= 0.0:
            return lambda cosine: 1.0
        lobes = [(m, fraction * self.weight) for m, fraction in self.lobes]

        def albedo(cosine: Float) -> Float:
            albedos = [w * cook_torrance_albedo(cosine, m, material.f0) for m, w in lobes]
            return np.asarray(np.sum(albedos, axis=0))

        camera = albedo(dot(self.n, self.v))
        mean = np.sum([w * cook_torrance_albedo_mean(m, material.f0) for m, w in lobes], axis=0)
        return lambda cosine: diffuse_coupled(
            mean if cosine is None else albedo(cosine), camera, mean
        )[:, None]


def layers(
    gbuffer: GBuffer, scene: Scene, shading: Shading, environment: Float | None = None
) -> Layers:
    """Return the terms of the image, with a specular term for every light. See also :func:`shade`.

    environment : the result of :func:`environment_layer`; None: it is computed here
    """
    if environment is None:
        environment = environment_layer(gbuffer, scene, shading)
    resolved = resolve(scene, shading)
    scene = resolved.scene
    ambient, diffuse = np.zeros((2, *gbuffer.normalised_position.shape))
    specular = np.zeros((len(scene.lights), *gbuffer.normalised_position.shape))
    scatters = any(material.scattering for material in scene.mesh.materials)
    light_of, albedo_of = np.zeros((2, *ambient.shape)) if scatters else (None, None)
    for index, material in enumerate(scene.mesh.materials):
        covered = gbuffer.part == index
        if not covered.any():
            continue
        pixels = _Pixels.of(gbuffer, covered, material, shading.term)
        coupling = pixels.coupling(material, shading)
        entered = pixels.occlusion[:, None] * np.asarray(scene.ambient) * coupling(None)
        ambient[covered] = pixels.albedo * entered
        for light, source in enumerate(scene.lights):
            visible = gbuffer.visibility[covered][:, light, None] if source.shadow else None
            l, spread, specular[light][covered] = _lit(
                pixels, material, resolved.appearance.terms[index], source, scene, visible
            )
            factor = coupling(dot(pixels.n, l))
            diffuse[covered] += pixels.albedo * spread * factor
            entered = entered + spread * factor
        if light_of is not None and albedo_of is not None:
            light_of[covered], albedo_of[covered] = entered, pixels.albedo
    return Layers(ambient, diffuse, specular, environment, light_of, albedo_of, gbuffer.emission)


def _lit(
    pixels: _Pixels,
    material: Material,
    term: Term,
    source: Light,
    scene: Scene,
    visible: NDArray[np.float32] | None,
) -> tuple[Float, Float, Float]:
    """Return three arrays (N, 3): the direction to a light, the irradiance of the diffuse term, and
    the specular radiance.

    visible : (N, 1) visible fraction of the light; None for lights without shadows
    """
    n, v = pixels.n, pixels.v
    l, irradiance = source.kind.lighting(source, scene.mesh.space, pixels.position)
    if visible is not None:
        irradiance = irradiance * visible
    cosine = dot(n, l)
    received = irradiance * np.maximum(cosine, 0.0)[:, None]
    spread, variance = received, np.zeros(len(n))
    if source.kind.sine is not None:
        s = source.kind.sine(source, scene.mesh.space, pixels.position)[..., 0]
        k = half_sum(s)
        spread = irradiance * cosine_disc(cosine, s, k)[:, None]
        variance = slope_variance_disc(s, k, 0.5 * np.linalg.norm(l + v, axis=-1))
    brdf = np.zeros(len(n))
    lobe_terms = [term, *(term.second(material.second_slope) for _ in pixels.lobes[1:])]
    for (m, fraction), lobe in zip(pixels.lobes, lobe_terms, strict=True):
        brdf += fraction * lobe.brdf(n, l, v, slope_filtered(m, variance), material.f0)
    return l, spread, received * (pixels.weight * brdf)[:, None]


def environment_layer(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Return the radiance from the environment, (H, W, 3) float64; see also :func:`shade`.

    The lights, the lobe and ``small_slope`` have no effect: the environment's reflections use the
    exact lobe.
    """
    scene = simplify(scene, shading)
    image = np.zeros(gbuffer.normalised_position.shape)
    if scene.environment is None:
        return image
    from facerender.terms.environment import environment_irradiance, reflected

    panorama, turn = scene.environment.panorama, scene.environment.turn
    samples = shading.environment_samples
    for index, material in enumerate(scene.mesh.materials):
        covered = gbuffer.part == index
        if not covered.any():
            continue
        pixels = _Pixels.of(gbuffer, covered, material, shading.term)
        n, v = pixels.n @ turn.T, pixels.v @ turn.T
        irradiance = environment_irradiance(panorama.coefficients, n)
        total = pixels.albedo * pixels.occlusion[:, None] * irradiance
        total *= pixels.coupling(material, shading)(None)
        term = replace(shading.term, lobe="exact", m=None)
        brdf = partial(term.brdf, f0=material.f0)
        for m, fraction in pixels.lobes * bool(samples and material.ks > 0.0):
            reflection = reflected(panorama.map, len(panorama.map) - 2, n, v, m, brdf, samples)
            total += (fraction * pixels.weight)[:, None] * reflection
        image[covered] = scene.environment.scale * total
    return image
