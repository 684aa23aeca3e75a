"""Images of a distorting lens: the undistorted image that the renderer draws for them, and its
resampling. ``scene.camera`` has the model. No OpenGL here."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from facerender.drawing.frame import GBuffer
from facerender.errors import InputError
from facerender.scene.camera import Camera, Coefficients, jacobian, undistort
from facerender.scene.scene import Scene
from facerender.scene.view import View
from facerender.values.vectors import Array, Float, Float32, Size, Vector

_MARGIN = 3  # pixels around the undistorted image: the reach of a cubic filter, and a tap's offset
_BLOCK = 1 << 15  # pixels per step, so that temporary arrays stay in the CPU's cache
_MAX_TAPS = 8  # largest number of taps per side of a pixel
_MAX_SIDE = 16384  # largest width and height of an undistorted image

Intrinsics = tuple[Vector, Vector, Vector]


class Lens:
    """A distorting lens for images of one size.

    wide : width and height of the undistorted image, which contains every pixel of the distorted
        image and resolves it at least as finely
    intrinsics : matrix K of the undistorted image
    focal : (fx, fy) of the distorted image in its pixels
    positions : (H * W, 2) float32, position of each pixel's centre in the undistorted image
    taps : (H * W,) uint8, taps per side of each pixel
    """

    def __init__(
        self, intrinsics: Intrinsics, camera_size: Size, coefficients: Coefficients, size: Size
    ) -> None:
        scale, k = np.divide(size, camera_size), np.array(intrinsics)
        focal, middle = k[[0, 1], [0, 1]] * scale, k[:2, 2] * scale
        count, finest = math.prod(size), math.inf
        positions = np.empty((count, 2))
        footprint = np.empty(count)  # largest extent of a pixel, in pixels of the same focal
        for pixels in _in_steps(np.arange(count)):
            centres = np.stack(np.divmod(pixels, size[0])[::-1], axis=-1) + 0.5
            flat = undistort((centres - middle) / focal, coefficients)
            positions[pixels] = flat * focal
            smallest, largest = _singular(jacobian(flat, coefficients) * focal[:, None] / focal)
            footprint[pixels], finest = 1.0 / smallest, min(finest, 1.0 / float(largest.max()))
        if np.isnan(positions).any():
            raise InputError(f"camera distortion = {coefficients} is not invertible in the image")
        positions /= finest
        footprint /= finest
        low, high = np.floor(positions.min(axis=0)), np.ceil(positions.max(axis=0))
        reach = _MARGIN + math.ceil(min(footprint.max(), _MAX_SIDE))
        width, height = (high - low).astype(int).tolist()
        self.wide = width + 2 * reach, height + 2 * reach
        if max(self.wide) > _MAX_SIDE:
            image = f"an undistorted image of {self.wide[0]} x {self.wide[1]} pixels"
            remedy = f"but the limit is {_MAX_SIDE} a side: give a smaller size"
            raise InputError(f"camera distortion = {coefficients} needs {image}, {remedy}")
        (fx, fy), (cx, cy) = (focal / finest).tolist(), (reach - low).tolist()
        self.intrinsics: Intrinsics = (fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)
        self.size, self.coefficients, self.focal = size, coefficients, focal
        positions -= low - reach
        self.positions = positions.astype(np.float32)
        self.taps = np.clip(np.round(footprint), 1, _MAX_TAPS).astype(np.uint8)

    def undistorted(self, scene: Scene) -> Scene:
        """Return the scene with the camera of the undistorted image."""
        pose = scene.camera.extrinsics
        camera = Camera(extrinsics=pose, intrinsics=self.intrinsics, size=self.wide)
        return replace(scene, camera=camera)

    def filtered(self, image: Float32) -> Float32:
        """Return the distorted image (H, W, 4) of an undistorted image. A pixel is the mean of its
        taps, which are evenly distributed over the pixel."""
        width, height = self.size
        distorted = np.empty((width * height, 4), dtype=np.float32)
        for count in np.unique(self.taps):
            for pixels in _in_steps(np.flatnonzero(self.taps == count)):
                total = np.zeros((len(pixels), 4), dtype=np.float32)
                for taps in self._tap_positions(pixels, int(count)):
                    total += _interpolated(image, taps)
                distorted[pixels] = total / np.float32(count * count)
        return distorted.reshape(height, width, 4)

    def nearest(self, gbuffer: GBuffer, view: View) -> GBuffer:
        """Return the distorted G-buffer with its view, from the nearest undistorted pixels."""
        layers = tuple(self.nearest(layer, view) for layer in gbuffer.transparent_layers)
        arrays = {name: v for name, v in vars(gbuffer).items() if isinstance(v, np.ndarray)}
        nearest: Any = {name: self.nearest_values(values) for name, values in arrays.items()}
        return replace(gbuffer, **nearest, view=view, transparent_layers=layers)

    def nearest_values(self, image: Array) -> Array:
        """Return the value of the nearest pixel of an undistorted image for each pixel."""
        columns, rows = self.positions.astype(np.intp).T
        flat = image.reshape(math.prod(self.wide), *image.shape[2:])
        values = flat[rows * self.wide[0] + columns]
        return np.asarray(values.reshape(*self.size[::-1], *image.shape[2:]))

    def _tap_positions(self, pixels: NDArray[np.intp], count: int) -> Iterator[Float32]:
        """Yield positions (N, 2) in the undistorted image: count x count per pixel."""
        positions = self.positions[pixels]
        if count == 1:
            yield positions
            return
        k = np.array(self.intrinsics)
        focal = k[[0, 1], [0, 1]]
        slopes = jacobian((positions - k[:2, 2]) / focal, self.coefficients)
        steps = np.linalg.inv(slopes * self.focal[:, None] / focal)
        offsets = (np.arange(count) + 0.5) / count - 0.5
        for y in offsets:
            for x in offsets:
                yield positions + (steps @ np.array([x, y])).astype(np.float32)


def lens_of(camera: Camera, size: Size) -> Lens:
    """Return the lens of a camera with distortion for images of the given size, from a cache."""
    return _lens(camera.intrinsics, camera.size, camera.distortion, size)


_lens = lru_cache(maxsize=1)(Lens)


def _in_steps(pixels: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    return (pixels[start : start + _BLOCK] for start in range(0, len(pixels), _BLOCK))


def _singular(matrices: Float) -> tuple[Float, Float]:
    """Return the smallest and the largest singular value of each matrix (N, 2, 2)."""
    squares = np.einsum("nij,nij->n", matrices, matrices)
    product = 2.0 * np.abs(np.linalg.det(matrices))
    total, difference = np.sqrt(squares + product), np.sqrt(np.maximum(squares - product, 0.0))
    return (total - difference) / 2.0, (total + difference) / 2.0


def _interpolated(image: Float32, positions: Float32) -> Float32:
    """Return the values (N, 4) of an image (H, W, 4) at positions (N, 2), by Catmull-Rom filters.

    Each value is limited to the range of the nearest 2 x 2 pixels: edges get no halos. If one of
    these pixels has a coverage below 1/2, the value is their bilinear mean. Otherwise, radiance and
    coverage could get different limits, so that their ratio, the straight colour, would be wrong.

    Source: Keys (1981), "Cubic convolution interpolation for digital image processing".
    """
    origins = np.floor(positions - 0.5)
    fractions = positions - 0.5 - origins
    x, y = (_weights(fraction) for fraction in fractions.T)
    columns, rows = origins.astype(np.intp).T - 1
    # Each entry holds four neighbours of a row.
    runs = as_strided(image, (len(image), image.shape[1] - 3, 16), (*image.strides[:2], 4))
    lines = [runs[rows + number, columns].reshape(-1, 4, 4) for number in range(4)]
    total = np.zeros((len(positions), 4), dtype=np.float32)
    for weight, line in zip(y.T, lines, strict=True):
        total += weight[:, None] * np.einsum("nk,nkc->nc", x, line)
    near = [line[:, column] for line in lines[1:3] for column in (1, 2)]
    low, high = (reduce(limit, near) for limit in (np.minimum, np.maximum))
    np.clip(total, low, high, out=total)
    edge = np.flatnonzero((low[:, 3] < 0.5) & (high[:, 3] > 0.0))
    across, down = fractions[edge].T[..., None]
    a, b, c, d = (values[edge] for values in near)
    above, below = a + across * (b - a), c + across * (d - c)
    total[edge] = above + down * (below - above)
    return total


def _weights(t: Float32) -> Float32:
    """Return the weights (N, 4) of four neighbours at the fraction t between the middle two."""
    s = 1.0 - t
    second, third = (1.0 + d * d * (1.5 * d - 2.5) for d in (t, s))
    return np.stack([-0.5 * t * s * s, second, third, -0.5 * s * t * t], axis=-1)
