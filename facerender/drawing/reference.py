"""The reference implementation for whole images, which shades a G-buffer in float64. No OpenGL."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.drawing.prepare import resolve, simplify
from facerender.material import Material
from facerender.mesh.part import Space
from facerender.scene.light import Light, half_sum
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading, Term
from facerender.scene.view import following
from facerender.terms.environment import (
    cook_torrance_albedo,
    cook_torrance_albedo_mean,
    diffuse_coupled,
    environment_irradiance,
    reflected,
)
from facerender.terms.model import cosine_disc, dot, slope_filtered, slope_variance_disc

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Layers:
    """Radiance of a G-buffer's pixels, one array per term; the sum of the terms is the image.

    ambient, diffuse : (H, W, 3) float64, radiance of each of these terms
    specular : (lights, H, W, 3) float64, specular radiance from each light
    environment : (H, W, 3) float64, diffuse and specular radiance from the environment map
    scattering : (2, H, W, 3) float64, summed irradiance of diffuse and ambient terms, and diffuse
        BRDF: diffuse radiance divided by this irradiance; None if no material scatters
    emission : (H, W, 3) float32, emitted radiance; None if no material emits light
    """

    ambient: Float
    diffuse: Float
    specular: Float
    environment: Float
    scattering: Float | None
    emission: NDArray[np.float32] | None

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
    if terms.scattering is None or gbuffer.facing is None:
        return change
    from facerender.scene.scattering import scattering_of
    from facerender.terms.transport import scatter, scatter_area

    (received, albedo), size = terms.scattering, gbuffer.part.shape[::-1]
    if (scattering := scattering_of(simplify(scene, shading), gbuffer.view, size)) is None:
        return change
    profile = np.array([*scattering.numbers, 0])[gbuffer.part]
    position, area = gbuffer.normalised_position.astype(np.float64), scatter_area(gbuffer.facing)
    for index, gaussians in enumerate(scattering.profiles, 1):
        pixels = profile == index
        scale = np.full(pixels.sum(), scattering.pixels / scattering.millimetres)
        if not gbuffer.view.orthographic:
            depth = (position[pixels] - gbuffer.view.position) @ gbuffer.view.forward
            scale = scattering.pixels / (depth * scattering.millimetres)
        light = scatter(
            received, position, profile, area, pixels,
            scale=scale, unit=scattering.millimetres, gaussians=gaussians,
            samples=shading.scatter_samples,
        )  # fmt: skip
        change[pixels] = albedo[pixels] * (light - received[pixels])
    return change


class _Pixels:
    """The N pixels of a G-buffer that a part covers, in float64.

    term : term of the shading; a constant m of this term replaces the m of the G-buffer
    position : (N, 3) in the renderer's space
    n, v : (N, 3) unit normal, and unit vector to the camera
    lobes : m (N,) of each lobe, and its fraction of the specular weight: 1 or (N,)
    weight, occlusion : (N,) specular weight, and (N, 1) ambient occlusion
    albedo : (N, 3) diffuse BRDF, the ratio of diffuse radiance to irradiance
    """

    def __init__(self, gbuffer: GBuffer, index: int, material: Material, term: Term) -> None:
        self.index, self.material, self.covered = index, material, gbuffer.part == index

        def values(image: NDArray[np.float32] | None) -> Float:
            assert image is not None
            return np.asarray(image[self.covered], dtype=np.float64)

        self.position, self.n = values(gbuffer.normalised_position), values(gbuffer.normal)
        self.v = gbuffer.view.towards(self.position)
        self.weight = values(gbuffer.specular_weight) * (not material.unlit)
        self.occlusion = values(gbuffer.occlusion)[:, None]
        self.albedo = material.diffuse_weight / np.pi * values(gbuffer.albedo)
        m = np.broadcast_to(term.slope(values(gbuffer.m)), self.weight.shape)
        self.lobes: list[tuple[Float, Float | float]] = [(m, 1.0)]
        if material.two_lobes:
            second = term.second(material.second_slope).slope(values(gbuffer.second_m))
            fraction = values(gbuffer.lobe_weight)
            self.lobes = [(m, fraction), (np.broadcast_to(second, m.shape), 1.0 - fraction)]

    def coupling(self, shading: Shading) -> Callable[[Float | None], Float | float]:
        """Return the function that computes the factor (N, 1) of the diffuse term for a light, or
        1, from the cosine (N,) between light and normal, or from None for light from all sides."""
        f0 = self.material.f0
        if shading.diffuse != "coupled" or self.material.ks <= 0.0:
            return lambda cosine: 1.0
        lobes = [(m, fraction * self.weight) for m, fraction in self.lobes]

        def albedo(cosine: Float) -> Float:
            return np.asarray(sum(w * cook_torrance_albedo(cosine, m, f0) for m, w in lobes))

        camera = albedo(dot(self.n, self.v))
        mean = sum(w * cook_torrance_albedo_mean(m, f0) for m, w in lobes)
        return lambda cosine: diffuse_coupled(
            mean if cosine is None else albedo(cosine), camera, mean
        )[:, None]

    def lit(
        self, light: Light, term: Term, space: Space, visible: Float | float
    ) -> tuple[Float, Float, Float]:
        """Return three arrays (N, 3): the direction to a light, the irradiance of the diffuse term,
        and the specular radiance.

        visible : (N, 1) visible fraction of the light, or 1
        """
        n, v, material = self.n, self.v, self.material
        l, irradiance = light.kind.lighting(light, space, self.position)
        irradiance = irradiance * visible
        cosine = dot(n, l)
        received = irradiance * np.maximum(cosine, 0.0)[:, None]
        spread, variance = received, np.zeros(len(n))
        if light.kind.sine is not None:
            s = light.kind.sine(light, space, self.position)[..., 0]
            k = half_sum(s)
            spread = irradiance * cosine_disc(cosine, s, k)[:, None]
            variance = slope_variance_disc(s, k, 0.5 * np.linalg.norm(l + v, axis=-1))
        brdf, terms = np.zeros(len(n)), (term, term.second(material.second_slope))
        for (m, fraction), lobe in zip(self.lobes, terms, strict=False):
            brdf += fraction * lobe.brdf(n, l, v, slope_filtered(m, variance), material.f0)
        return l, spread, received * (self.weight * brdf)[:, None]

    def fractions(
        self, lights: Sequence[Light], around: Float, visibility: NDArray[np.float32]
    ) -> tuple[Float, Float]:
        """Return the visible fractions (N, 3) of the irradiance of an environment's remainder, and
        of its specular light; see ``shaders/host/environment.glsl``.

        around : ``PanoramaLights.around``, scaled
        visibility : visible fraction of each of the lights, (H, W, lights)
        """
        mirrored = 2.0 * dot(self.n, self.v)[:, None] * self.n - self.v
        sums = np.zeros((4, *self.n.shape))
        for light, rest, seen in zip(lights, around, visibility[self.covered].T, strict=True):
            l, sine = light.direction, math.sin(math.radians(light.radius))
            width = 2.0 * self.lobes[0][0] ** 2 + 0.5 * sine**2 + 0.02
            lobe = np.exp((mirrored @ l - 1.0) / width) + 1e-4
            weights = (
                (np.maximum(self.n @ l, 0.0) + 0.01)[:, None] * rest,
                lobe[:, None] * (light.irradiance + rest),
            )
            for row, weight in enumerate(weights):
                sums[2 * row] += seen[:, None] * weight
                sums[2 * row + 1] += weight
        seen_sums, weight_sums = sums[::2], np.maximum(sums[1::2], 1e-30)
        irradiance, specular = seen_sums / weight_sums
        return irradiance, specular * irradiance**2 * (3.0 - 2.0 * irradiance)


def _parts(gbuffer: GBuffer, scene: Scene, term: Term) -> Iterator[_Pixels]:
    """Yield the pixels of each part that is visible."""
    for index, material in enumerate(scene.mesh.materials):
        if (gbuffer.part == index).any():
            yield _Pixels(gbuffer, index, material, term)


def layers(
    gbuffer: GBuffer, scene: Scene, shading: Shading, environment: Float | None = None
) -> Layers:
    """Return the terms of the image, with a specular term for every light. See also :func:`shade`.

    environment : the result of :func:`environment_layer`; None: it is computed here
    """
    if environment is None:
        environment = environment_layer(gbuffer, scene, shading)
    resolved = resolve(following(scene, gbuffer.view), shading)
    scene, terms = resolved.scene, resolved.appearance.terms
    shape = gbuffer.normalised_position.shape
    ambient, diffuse = np.zeros((2, *shape))
    specular = np.zeros((len(scene.lights), *shape))
    scatters = any(material.scattering for material in scene.mesh.materials)
    scattering = np.zeros((2, *shape)) if scatters else None
    for pixels in _parts(gbuffer, scene, shading.term):
        covered, coupling = pixels.covered, pixels.coupling(shading)
        entered = pixels.occlusion * np.asarray(scene.ambient) * coupling(None)
        ambient[covered] = pixels.albedo * entered
        for index, light in enumerate(scene.lights + resolved.appearance.lighting.environment):
            visible = gbuffer.visibility[covered][:, index, None] if light.shadow else 1.0
            lit = pixels.lit(light, terms[pixels.index], scene.mesh.space, visible)
            l, spread, shine = lit
            if index < len(specular):
                specular[index][covered] = shine
            factor = coupling(dot(pixels.n, l))
            diffuse[covered] += pixels.albedo * spread * factor
            entered = entered + spread * factor
        if scattering is not None:
            scattering[:, covered] = entered, pixels.albedo
    return Layers(ambient, diffuse, specular, environment, scattering, gbuffer.emission)


def environment_layer(gbuffer: GBuffer, scene: Scene, shading: Shading) -> NDArray[np.float64]:
    """Return the radiance from the environment, (H, W, 3) float64; see also :func:`shade`.

    The lights, the lobe and ``small_slope`` have no effect: the environment's reflections use the
    exact lobe. The diffuse light of the environment's own lights is left out.
    """
    resolved = resolve(scene, shading)
    lights, scene = resolved.appearance.lighting.environment, resolved.scene
    image = np.zeros(gbuffer.normalised_position.shape)
    if scene.environment is None:
        return image
    panorama, turn = scene.environment.panorama, scene.environment.turn
    samples, term = shading.environment_samples, replace(shading.term, lobe="exact", m=None)
    split, seen = panorama.lights(len(lights)), gbuffer.visibility[..., len(scene.lights) :]
    for pixels in _parts(gbuffer, scene, shading.term):
        n, v, material = pixels.n @ turn.T, pixels.v @ turn.T, pixels.material
        irradiance = environment_irradiance(split.coefficients, n)
        fractions: tuple[Float | float, Float | float] = pixels.occlusion, 1.0
        if lights:
            fractions = pixels.fractions(lights, scene.environment.scale * split.around, seen)
        total = pixels.albedo * fractions[0] * irradiance * pixels.coupling(shading)(None)
        brdf = partial(term.brdf, f0=material.f0)
        for m, fraction in pixels.lobes * bool(samples and material.ks > 0.0):
            reflection = reflected(panorama.map, len(panorama.map) - 2, n, v, m, brdf, samples)
            total += (fraction * pixels.weight)[:, None] * fractions[1] * reflection
        image[pixels.covered] = scene.environment.scale * total
    return image
