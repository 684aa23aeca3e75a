"""What a renderer returns: the frame, which can be shown and saved, and the G-buffer. No OpenGL."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_path, check_range, check_switch, check_type, shown
from facerender.image import encode_srgb8, save_exr, save_png
from facerender.scenes.scene import ONLY, Only
from facerender.scenes.view import View


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered image.

    Attributes
    ----------
    linear : (H, W, 4) float32, row 0 on top; linear RGB, unclamped, and the mesh's coverage. Colour
        holds the background where the scene has one, and is premultiplied by coverage otherwise.
        With ``only`` the background is 0, and colour is the specular or diffuse radiance, the
        albedo, the normal (unit vector in the mesh's space), the depth along the viewing direction
        in the mesh's units (three times), the cosines N.L of the first light, N.V and N.H, or how
        much of the first light that casts shadows is seen, in [0, 1] (three times).
    only : which term this is, or None for the whole image
    transparent : whether a PNG gets an alpha channel; the scene has no background
    metadata : facerender's version, GL_RENDERER, GL_VERSION, samples, texture format; of shaded
        images also model, lobe and Fresnel term
    """

    linear: NDArray[np.float32]
    only: Only | None
    transparent: bool
    metadata: Mapping[str, str]

    def __post_init__(self) -> None:
        if not isinstance(self.linear, np.ndarray) or self.linear.ndim != 3:
            raise InputError(f"linear = {shown(self.linear)}: give an array (H, W, 4)")
        if self.only is not None and str(self.only) not in ONLY:
            raise InputError(f"unknown term {shown(self.only)}; known: {', '.join(ONLY)}")
        check_switch("transparent", self.transparent)
        check_type("metadata", self.metadata, Mapping, "texts by name")

    def srgb8(self, exposure: float = 0.0) -> NDArray[np.uint8]:
        """8-bit image for looking at: (H, W, 3), or (H, W, 4) with straight alpha if transparent.

        Radiance and albedo are sRGB, normals 0.5 n + 0.5, cosines and visibility as they are, depth
        from the nearest (white) to the farthest; exposure, in stops, applies to radiance.
        """
        check_range("exposure", exposure, -100.0, 100.0)
        color, coverage = self.linear[..., :3], self.linear[..., 3:]
        if self.only == "normal":
            pixels = _bytes((color * 0.5 + 0.5) * coverage)
        elif self.only in ("cosines", "visibility"):
            pixels = _bytes(color)
        elif self.only == "depth":
            pixels = _bytes(_depth_as_brightness(color, coverage))
        elif self.transparent:
            straight = np.divide(color, np.maximum(coverage, 1e-6), dtype=np.float32)
            pixels = encode_srgb8(straight, exposure)
        else:
            pixels = encode_srgb8(color, exposure)
        return np.concatenate([pixels, _bytes(coverage)], axis=-1) if self.transparent else pixels

    def save(self, path: str | os.PathLike[str], exposure: float = 0.0) -> None:
        """Write .png (8-bit sRGB) or .exr (linear float32), whole or not at all.

        Raises
        ------
        InputError : another suffix, a place that cannot be written, EXR without its package
        """
        check_path("image file", path)
        check_range("exposure", exposure, -100.0, 100.0)
        suffix = os.path.splitext(path)[1].lower()
        if suffix == ".png":
            save_png(path, self.srgb8(exposure), self.metadata)
        elif suffix == ".exr":
            save_exr(path, self.linear, self.metadata)
        else:
            raise InputError(f"{path}: unknown image format {suffix!r}; give .png or .exr")


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def _depth_as_brightness(
    depth: NDArray[np.float32], coverage: NDArray[np.float32]
) -> NDArray[np.float32]:
    inside = depth[coverage[..., 0] > 0.0]
    if not inside.size:
        return depth
    near, far = inside.min(), inside.max()
    span = max(float(far - near), 1e-30)
    return np.asarray((1.0 - 0.9 * (depth - near) / span) * coverage)


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What the fragment program shades, one sample at each pixel's centre, row 0 on top.

    Attributes
    ----------
    part : (H, W) int, index into ``mesh.parts``, or -1 for the background
    position : (H, W, 3) float32 in the renderer's space (see ``Mesh.normalised``)
    normal : (H, W, 3) float32, the shading normal with the normal map applied
    albedo : (H, W, 3) float32, linear
    m, specular_weight, occlusion : (H, W) float32
    uv : (H, W, 2) float32
    visibility : (H, W, lights) float32, how much of each light of the scene is not in shadow
    view : the camera that saw it
    second_m, lobe_weight : (H, W) float32, slope of the second lobe and share of the first; None
        where no material has two lobes
    facing : (H, W) float32, cosine between the mesh's normal, without its map, and the eye; None
        where nothing scatters
    """

    part: NDArray[np.int64]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    albedo: NDArray[np.float32]
    m: NDArray[np.float32]
    specular_weight: NDArray[np.float32]
    occlusion: NDArray[np.float32]
    uv: NDArray[np.float32]
    visibility: NDArray[np.float32]
    view: View
    second_m: NDArray[np.float32] | None = None
    lobe_weight: NDArray[np.float32] | None = None
    facing: NDArray[np.float32] | None = None
