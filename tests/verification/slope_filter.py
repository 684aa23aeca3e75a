"""Errors of the slope filter and of disc lights. The reference of a highlight on fine relief is an
image with many samples of the unfiltered normal map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.comparison import pictures
from facerender.images.image import linear_to_srgb

Float = NDArray[np.float64]

LIGHT = fr.Light(azimuth=-50.0, elevation=42.0, shadow=False)
CAMERA = fr.Camera(azimuth=-20.0)
STEEPEST = 3.0  # largest slope of a relief's texel
_SPREAD = 2  # the reference has this many pixels per pixel and axis, with _SAMPLES samples each
_SAMPLES = 64


def slopes_of(texture: fr.Texture) -> Float:
    """Return the slopes (H, W, 2) of a normal map's texels, row 0 on top."""
    normals = np.asarray(texture.rgb(), dtype=np.float64)[::-1] / 127.5 - 1.0
    return -normals[..., :2] / np.maximum(normals[..., 2:], 0.25)


def relief(slopes: Float, strength: float) -> fr.Texture:
    """Return the normal map of slopes times ``strength``, clamped to STEEPEST."""
    steep = np.clip(slopes * strength, -STEEPEST, STEEPEST)
    normals = np.concatenate([-steep, np.ones_like(steep[..., :1])], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    texels = np.round(normals * 127.5 + 127.5).astype(np.uint8)
    return fr.Texture(lambda: Image.fromarray(texels), "relief")


def unfiltered(texture: fr.Texture) -> fr.Texture:
    """Return a copy of a normal map that has only the finest mip level."""
    finest = texture.levels("normal").result()[:1]
    texels = np.ascontiguousarray(finest[0][..., :3])
    return fr.Texture.known(texels, "unfiltered", {"data": [texels], "normal": finest})


@dataclass(frozen=True)
class Lost:
    """Errors of an image's highlight against the reference.

    Attributes
    ----------
    energy : relative error of the highlight's total radiance
    l1 : mean absolute difference in the highlight, relative to its mean
    flip : mean FLIP error of the fully covered pixels
    """

    energy: float
    l1: float
    flip: float


@dataclass(frozen=True, eq=False)
class Bench:
    """A mesh with a relief, lit by LIGHT and drawn at one size.

    Attributes
    ----------
    mesh : its material has the relief as normal map
    size : width and height of the images, in pixels
    """

    mesh: fr.Mesh
    size: int
    camera: fr.Camera = CAMERA

    @classmethod
    def of(cls, mesh: fr.Mesh, texture: fr.Texture, m: float, size: int) -> Bench:
        """Return a bench for a mesh with a relief and roughness m, without other specular maps."""
        maps: dict[str, Any] = dict.fromkeys(("specular_map", "occlusion_map"))
        maps["normal_map"] = texture
        return cls(mesh.with_material(m=m, ks=1.0, **maps), size)

    def image(
        self, renderer: fr.Renderer, shading: fr.Shading, samples: int = 1
    ) -> NDArray[np.float32]:
        """Draw the specular light, (H, W, 4)."""
        scene = fr.Scene(self.mesh, self.camera, (LIGHT,), ambient=0.0, background=None)
        return renderer.render(scene, shading, "specular", samples).linear

    def reference(self, renderer: fr.Renderer) -> Float:
        """Draw the specular light with 256 samples per pixel and only the finest level of the map.

        renderer : twice as wide and high as the result
        """
        texture = self.mesh.materials[0].normal_map
        assert texture is not None
        bench = replace(self, mesh=self.mesh.with_material(normal_map=unfiltered(texture)))
        image = bench.image(renderer, fr.Shading(slope_filter=False), _SAMPLES)
        blocks = image.reshape(self.size, _SPREAD, self.size, _SPREAD, 4)
        return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def lost(image: NDArray[np.floating], reference: NDArray[np.floating]) -> Lost:
    """Compare an image with the reference, at the pixels that the reference covers fully."""
    whole = reference[..., 3] > 0.9999
    value, expected = (each[..., 0].astype(np.float64) for each in (image, reference))
    bright = whole & (expected > 0.25 * np.quantile(expected[whole], 0.995))
    total = expected[bright].sum()
    seen = [linear_to_srgb(np.where(whole, 1.1 * each + 0.15, 0.0)) for each in (expected, value)]
    shown = [np.repeat(each[..., None], 3, axis=-1) for each in seen]
    return Lost(
        float(value[bright].sum() / total - 1.0),
        float(np.abs(value - expected)[bright].sum() / total),
        float(pictures.flip_errors(*shown)[whole].mean()),
    )


FILTERS = {"none": fr.Shading(slope_filter=False), "filter": fr.Shading()}


def filtered(
    mesh: fr.Mesh, texture: fr.Texture, m: float, size: int, anisotropy: float = 1.0
) -> dict[str, Lost]:
    """Return the errors of the highlight on a mesh with a relief, for each of FILTERS."""
    bench = Bench.of(mesh, texture, m, size)
    with fr.Renderer((_SPREAD * size,) * 2) as renderer:
        expected = bench.reference(renderer)
    with fr.Renderer((size, size), anisotropy=anisotropy) as renderer:
        return {
            name: lost(bench.image(renderer, shading), expected)
            for name, shading in FILTERS.items()
        }


def flicker(
    mesh: fr.Mesh, texture: fr.Texture, m: float, size: int, azimuths: Sequence[float]
) -> dict[str, float]:
    """Return the excess flicker of the highlight over camera azimuths, for each of FILTERS.

    Flicker is the standard deviation of the highlight's pixels. The excess over the flicker of the
    reference is relative to the mean of the reference.
    """
    bench = Bench.of(mesh, texture, m, size)
    turned = [replace(bench, camera=replace(CAMERA, azimuth=each)) for each in azimuths]
    with fr.Renderer((_SPREAD * size,) * 2) as renderer:
        expected = np.stack([each.reference(renderer) for each in turned])
    whole = (expected[..., 3] > 0.9999).all(axis=0)
    value = expected[..., 0]
    bright = whole & (value.min(axis=0) > 0.1 * value[:, whole].max())
    found = {}
    with fr.Renderer((size, size)) as renderer:
        for name, shading in FILTERS.items():
            images = np.stack([each.image(renderer, shading)[..., 0] for each in turned])
            beyond = images.std(axis=0)[bright].mean() - value.std(axis=0)[bright].mean()
            found[name] = float(beyond / value.mean(axis=0)[bright].mean())
    return found


def disc(
    angle: float, radius: float, m: float, points: int = 600, side: int = 72
) -> tuple[float, float]:
    """Return two relative mean errors of a disc light's specular term on a sphere, in float64.

    The first treats the light as a point; the second adds its disc as slope variance.

    Parameters
    ----------
    angle : between the directions to the camera and to the light, in degrees
    radius : of the disc, in degrees
    points : number of points on the disc; their mean is the reference
    side : width and height of the sphere's image, in pixels
    """
    axis = (np.arange(side) + 0.5) / side * 2.0 - 1.0
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    inside = x * x + y * y < 0.98
    n = np.stack([x, y, np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))], axis=-1)[inside]
    v = np.array([0.0, 0.0, 1.0])
    l = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
    across, up = np.array([l[2], 0.0, -l[0]]), np.array([0.0, 1.0, 0.0])
    index = np.arange(points) + 0.5
    cosine = 1.0 - (1.0 - np.cos(np.radians(radius))) * index / points
    sine, turn = np.sqrt(1.0 - cosine**2), index * np.pi * (3.0 - np.sqrt(5.0))
    spread = np.stack([cosine, sine * np.cos(turn), sine * np.sin(turn)], axis=-1)

    def specular(light: Float, slope: float) -> Float:
        value = fr.brdf.cook_torrance(n, light, v, slope, 0.028)
        return value * np.maximum(n @ light, 0.0)

    exact = np.mean([specular(each, m) for each in spread @ np.stack([l, across, up])], axis=0)
    s, k = np.sin(np.radians(radius)), 0.5 + 0.5 * np.cos(np.radians(radius))
    v_dot_h = 0.5 * float(np.linalg.norm(l + v))
    widened = fr.brdf.slope_filtered(m, fr.brdf.slope_variance_disc(s, k, v_dot_h))
    errors = (np.abs(specular(l, each) - exact).sum() / exact.sum() for each in (m, float(widened)))
    none, with_disc = (float(each) for each in errors)
    return none, with_disc
