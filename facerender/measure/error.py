"""Errors of approximated lobes, and of their BRDFs and images, against exact float64 values."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facerender import lobes
from facerender.comparison import flip
from facerender.comparison.blocks import BLOCK, FLOOR, block_sums, cell_sums
from facerender.comparison.neighbourhoods import FULL, filtered, shrunk
from facerender.drawing.context import Backend
from facerender.drawing.reference import shade
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.srgb import encode_srgb8
from facerender.lobes import AnyLobe
from facerender.measure.measurement import ImageError
from facerender.scenes.scene import Scene
from facerender.shading import Shading

Array = NDArray[np.float64]


def lobe_error(name: AnyLobe, m: float, k: int, degrees: Array | None = None) -> Array:
    """Return a lobe minus the exact lobe (peak 1), at angles γ between normal and half vector.

    Parameters
    ----------
    m : roughness, in the domain of the lobe
    k : power of the cosine in the lobe's formula: 4 for Cook-Torrance, 0 for Ward
    degrees : angles in degrees, (N,); None: 0 to 90 in steps of 0.01

    Raises
    ------
    InputError : m is outside the domain of the lobe
    """
    angles = np.linspace(0.0, 90.0, 9001) if degrees is None else degrees
    c = np.cos(np.radians(angles)).clip(0.0, 1.0)
    return lobes.lobe(name, c, m, k) - lobes.exact(c, m, k)


def brdf_error(shading: Shading, m: float, f0: float = 0.028, count: int = 24) -> float:
    """Return the largest error of the BRDF times N.L, relative to the largest exact product.

    Both maxima are over all directions. Light and camera each take `count` polar angles from 0 to
    89 degrees; the light also takes 2 `count` azimuths from 0 to 180 degrees.

    Raises
    ------
    InputError : m is outside the domain of the lobe
    """
    theta = np.radians(np.linspace(0.0, 89.0, count))
    phi = np.linspace(0.0, np.pi, 2 * count)
    l = _from_angles(theta[:, None, None], phi)
    v = _from_angles(theta[:, None], np.pi)
    n = np.array([0.0, 0.0, 1.0])
    exact = shading.replace(lobe="exact")
    values, expected = (s.term.brdf(n, l, v, m, f0) * l[..., 2] for s in (shading, exact))
    return float(np.abs(values - expected).max() / expected.max())


def _from_angles(theta: Array, phi: Array | float) -> Array:
    sine = np.sin(theta)
    x, y, z = np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), np.cos(theta))
    return np.stack([x, y, z], axis=-1)


def image_errors(
    scene: Scene,
    shadings: Sequence[Shading],
    size: tuple[int, int],
    backend: Backend = "auto",
    undrawn: Sequence[Shading] = (),
) -> tuple[Array, list[NDArray[np.float32]], list[ImageError]]:
    """Draw a scene with each shading, one sample per pixel, and compare the images with float64.

    Return the float64 reference, the OpenGL images and the errors. The reference uses
    `shadings[0]`, but with the exact lobe. The errors of `undrawn`, which OpenGL cannot draw, come
    last; their images are float64, too.

    Raises
    ------
    ContextError : no OpenGL context
    InputError : the scene cannot be drawn with one of the shadings
    """
    scene = replace(scene, background=None)
    exact = shadings[0].replace(lobe="exact")
    with Renderer(size, samples=1, backend=backend) as renderer:
        gbuffer = renderer.gbuffer(scene, exact)
        reference = shade(gbuffer, scene, exact)
        images = [renderer.render(scene, shading).linear[..., :3] for shading in shadings]
    covered = gbuffer.coverage > 0.0
    compared: list[NDArray[np.floating]] = [*images]
    compared += [shade(gbuffer, scene, shading) for shading in undrawn]
    errors = [image_error(image, reference, covered) for image in compared]
    return reference, images, errors


def image_error(
    image: NDArray[np.floating], reference: Array, covered: NDArray[np.bool_]
) -> ImageError:
    """Compare a linear image (H, W, 3) with its reference over the covered pixels (H, W)."""
    relative = np.abs(image - reference)[covered] / np.maximum(reference[covered], 0.01)
    displayed, expected = encode_srgb8(image), encode_srgb8(reference.astype(np.float32))
    steps = np.abs(displayed.astype(int) - expected)[covered].max(axis=-1)
    flip_error = None
    with suppress(InputError):  # the package for FLIP may be missing
        flip_error = float(flip.errors(expected / 255.0, displayed / 255.0).mean())
    return ImageError(
        point=point_error(image, reference),
        block=block_error(image, reference, covered.astype(np.float64)),
        largest=float(relative.max()),
        percentile=float(np.quantile(relative.max(axis=-1), 0.999)),
        steps=int(steps.max()),
        steps_percentile=float(np.quantile(steps, 0.999)),
        flip=flip_error,
    )


def point_error(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return the largest distance from a pixel to the range of 3 x 3 pixels in the other image.

    Image a is compared with b, and b with a; both are (H, W, 3).
    """
    worst = 0.0
    for neighbours, pixels in ((a, b), (b, a)):
        for channel in range(3):
            x, y = neighbours[..., channel], pixels[..., channel]
            beyond = np.maximum(y - filtered(x, np.maximum), filtered(x, np.minimum) - y)
            worst = max(worst, float(beyond.max()))
    return worst


def block_error(
    a: NDArray[np.floating], reference: NDArray[np.floating], coverage: NDArray[np.floating]
) -> float:
    """Return the largest error of a block's mean, relative to max(mean of the reference, 0.01).

    A block has 16 x 16 pixels.

    Parameters
    ----------
    a, reference : linear images, (H, W, 3)
    coverage : (H, W) in [0, 1]. Pixels count if all pixels within a distance of 3 are fully
        covered; blocks count if they contain at least 64 such pixels
    """
    inside = shrunk(coverage >= FULL, 3)
    count = block_sums(cell_sums(inside))
    worst = 0.0
    for channel in range(3):
        x, y = reference[..., channel], a[..., channel]
        divisor = np.maximum(
            block_sums(cell_sums(np.abs(x) * inside)), FLOOR * np.maximum(count, 1.0)
        )
        change = np.abs(block_sums(cell_sums((y - x) * inside))) / divisor
        worst = max(worst, float(change[count >= BLOCK**2 // 4].max(initial=0.0)))
    return worst
