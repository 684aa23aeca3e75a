"""What the image comparison is held against: renders that are broken on purpose, and renders that
differ as drivers, formats and cameras make them. The table of docs/measurements/comparison.md and
the tests walk the same entries."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy import ndimage

import facerender as fr
from facerender.drawing.passes.shade import shade_pass
from facerender.drawing.program import Program
from facerender.drawing.resolve import resolve
from facerender.images.srgb import srgb_to_linear
from facerender.scenes.texture import Texture
from facerender.scenes.view import view_of

Pixels = NDArray[np.float32] | NDArray[np.uint8]
Images = tuple[Pixels, Pixels]

SIZE = 512
CAMERAS = {"front": fr.Camera(), "three-quarter": fr.Camera(-35.0)}


@dataclass(frozen=True)
class Patched(Program):
    """A program with one passage of its GLSL replaced."""

    old: str = ""
    new: str = ""

    def sources(self, version: str) -> dict[str, str]:
        stages = super().sources(version)
        assert stages["frag"].count(self.old) == 1, self.old
        return stages | {"frag": stages["frag"].replace(self.old, self.new)}


@dataclass(frozen=True)
class Studio:
    """A mesh before a camera, and what draws it."""

    renderer: fr.Renderer
    mesh: fr.Mesh
    camera: fr.Camera = fr.Camera()

    def draw(self, shading: fr.Shading = fr.Shading(), **material: object) -> NDArray[np.float32]:
        """Linear RGB and coverage, (H, W, 4), of the mesh with fields of its material replaced."""
        return self.frame(shading, **material).linear

    def patched(
        self, old: str, new: str, shading: fr.Shading = fr.Shading(), **material: object
    ) -> NDArray[np.float32]:
        """The same with one passage of the GLSL replaced."""
        scene = fr.Scene(self.mesh.with_material(**material), self.camera)
        step = shade_pass(resolve(scene, shading), view_of(scene, 1.0), self.renderer.samples)
        draws = tuple(
            replace(draw, program=Patched(**vars(draw.program), old=old, new=new))
            for draw in step.draws
        )
        (linear,) = self.renderer._draw([replace(step, draws=draws)], scene)
        return linear

    def frame(self, shading: fr.Shading = fr.Shading(), **material: object) -> fr.Frame:
        scene = fr.Scene(self.mesh.with_material(**material), self.camera)
        return self.renderer.render(scene, shading)

    def remapped(self, name: str, change: Callable[[Image.Image], Image.Image]) -> Texture:
        """A map of the mesh, every pixel changed."""
        texture = getattr(self.mesh.materials[0], name)
        return Texture(lambda: ImageOps.flip(change(texture.rgb())), texture.name)

    def moved(self, pixels: float) -> Studio:
        """The same, drawn where the image lies so far to the right and down."""
        view = view_of(fr.Scene(self.mesh, self.camera), 1.0)
        distance = np.linalg.norm(view.eye)
        pixel = 2.0 * distance * math.tan(math.radians(self.camera.fov) / 2) / SIZE
        right = np.cross(view.forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        shift = pixels * pixel * (np.cross(right, view.forward) - right)
        target = tuple(self.mesh.to_mesh_space(shift).tolist())
        return replace(self, camera=replace(self.camera, target=target))


def bright(linear: NDArray[np.float32], count: int, seed: int = 1) -> tuple[NDArray[np.int64], ...]:
    """Rows and columns of pixels well inside the coverage, brighter than the median."""
    inside = ndimage.binary_erosion(linear[..., 3] >= 1.0, iterations=5)
    level = linear[..., :3].min(axis=-1)
    return _some(inside & (level > np.median(level[inside])), count, seed)


def edge(linear: NDArray[np.float32], count: int, seed: int = 1) -> tuple[NDArray[np.int64], ...]:
    """Rows and columns of the last fully covered pixels before the silhouette."""
    full = linear[..., 3] >= 1.0
    return _some(full & ~ndimage.binary_erosion(full), count, seed)


def _some(mask: NDArray[np.bool_], count: int, seed: int) -> tuple[NDArray[np.int64], ...]:
    chosen = np.random.default_rng(seed).choice(np.argwhere(mask), count, replace=False)
    return tuple(chosen.T)


def set_pixels(
    linear: NDArray[np.float32], where: tuple[NDArray[np.int64], ...], radiance: float
) -> NDArray[np.float32]:
    image = linear.copy()
    image[..., :3][where] = radiance
    return image


def weaker(studio: Studio, by: float = 0.03) -> Images:
    return studio.draw(), studio.draw(ks=1.0 - by)


def rougher(studio: Studio, m: float = 0.306) -> Images:
    return studio.draw(m=0.3), studio.draw(m=m)


def no_masking(studio: Studio) -> Images:
    old = "min(h_dot_h, 4.0 * abs(n_dot_h) * lower)"
    return studio.draw(), studio.patched(old, "h_dot_h")


def no_power(studio: Studio) -> Images:
    old = "* sec2 * (masked.x * inverse)"
    return studio.draw(), studio.patched(old, "/ sec2 * (masked.x * inverse)")


def unclamped(studio: Studio) -> Images:
    old = "clamp(1.0 - steepness * (1.0 - c), 0.0, 1.0)"
    new = "1.0 - steepness * (1.0 - c)"
    d16 = fr.Shading(lobe="d16")
    return studio.draw(d16, m=0.2), studio.patched(old, new, d16, m=0.2)


def black_pixels(studio: Studio) -> Images:
    linear = studio.draw()
    return linear, set_pixels(linear, bright(linear, 2), 0.0)


def fireflies(studio: Studio) -> Images:
    linear = studio.draw()
    return linear, set_pixels(linear, bright(linear, 3), 4.0)


def false_highlights(studio: Studio) -> Images:
    linear = studio.draw()
    return linear, set_pixels(linear, edge(linear, 12), 1.0)


def green_down(studio: Studio) -> Images:
    def change(image: Image.Image) -> Image.Image:
        red, green, blue = image.split()
        return Image.merge("RGB", (red, ImageOps.invert(green), blue))

    return studio.draw(), studio.draw(normal_map=studio.remapped("normal_map", change))


def decoded_twice(studio: Studio) -> Images:
    table = np.round(255.0 * srgb_to_linear(np.arange(256) / 255.0)).astype(int).tolist()
    albedo = studio.remapped("albedo_map", lambda image: image.point(table * 3))
    return studio.draw(), studio.draw(albedo_map=albedo)


def brighter(studio: Studio, by: float = 0.02) -> Images:
    linear = studio.draw()
    image = linear.copy()
    image[..., :3] *= 1.0 + by
    return linear, image


def rounding(studio: Studio) -> Images:
    a = studio.frame().srgb8()
    steps = np.random.default_rng(1).integers(-1, 2, a.shape)
    return a, np.clip(a + steps, 0, 255).astype(np.uint8)


def noise(studio: Studio) -> Images:
    linear = studio.draw()
    image = linear.copy()
    image[..., :3] *= 1.0 + 5e-4 * np.random.default_rng(1).normal(size=image[..., :3].shape)
    return linear, image


def shifted(studio: Studio, pixels: float = 0.05) -> Images:
    linear = studio.draw()
    moved = ndimage.shift(linear.astype(np.float64), (pixels, pixels, 0), order=3, mode="nearest")
    moved[..., 3] = np.round(moved[..., 3], 3).clip(0.0, 1.0)  # the spline rings
    return linear, moved.astype(np.float32)


BROKEN: dict[str, Callable[[Studio], Images]] = {
    "ks -3 %": weaker,
    "m 0.300 to 0.306": rougher,
    "no masking": no_masking,
    "no 1/c^4 in the lobe": no_power,
    "D16 not clamped, m = 0.2": unclamped,
    "2 black pixels": black_pixels,
    "3 fireflies": fireflies,
    "12 false highlights at the silhouette": false_highlights,
    "green of the normal map inverted": green_down,
    "albedo decoded twice": decoded_twice,
    "exposure +2 %": brighter,
}
HARMLESS: dict[str, Callable[[Studio], Images]] = {
    "8 bits, 1 step of rounding": rounding,
    "noise of 5e-4": noise,
    "image moved by 0.05 pixels": shifted,
}
