"""Renders the pictures of docs/skin-lobes.md, and prints what its table says of directions that are
drawn: python -m tools.docs.skin_lobes"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

import facerender as fr
from facerender.scenes.texture import Texture

HERE = Path(__file__).parents[2] / "docs"
SKIN = {"second_slope": 1.7, "lobe_weight": 0.85}
SWEAT = {"second_slope": 0.35, "lobe_weight": 0.5}
SIZE = 420


def sweat() -> Texture:
    """A film with gaps: smoothed noise."""
    noise = np.random.default_rng(4).integers(0, 256, (512, 512), dtype=np.uint8)
    smooth = np.asarray(Image.fromarray(noise).filter(ImageFilter.GaussianBlur(4)), dtype=float)
    film = np.clip(2.0 * ((smooth - smooth.mean()) / smooth.std() - 0.6), 0.0, 1.0)
    return Texture(lambda: Image.fromarray(np.round(255.0 * film).astype(np.uint8)), "sweat")


def save(name: str, images: list[np.ndarray]) -> None:
    Image.fromarray(np.hstack(images)).save(HERE / name, quality=84)


def main() -> None:
    head, camera = fr.load_mesh(), fr.Camera(azimuth=-35.0, zoom=1.35)
    with fr.Renderer((SIZE, SIZE)) as renderer:

        def shown(shading: fr.Shading = fr.Shading(), **material: object) -> np.ndarray:
            scene = fr.Scene(head.with_material(**material), camera)
            return renderer.render(scene, shading).srgb8()

        save("two-lobes.jpg", [shown(), shown(**SKIN), shown(**SWEAT, lobe_map=sweat())])
        plain, coupled = shown(), shown(fr.Shading(diffuse="coupled"))
        taken = np.clip(8 * (plain.astype(int) - coupled), 0, 255).astype(np.uint8)
        save("coupled.jpg", [plain, coupled, taken])
        steps = np.abs(plain.astype(int) - coupled).max(axis=-1)[plain.max(axis=-1) > 40]
        most = np.quantile(steps, 0.99)
        print(f"coupled: {steps.mean():.1f}/255 in the mean, 99 % within {most:.0f}/255")

    n = np.array([0.0, 0.0, 1.0])
    random = np.random.default_rng(1)
    for m in (0.1, 0.3, 0.5):
        for degrees in (30, 60):
            v = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
            u = random.random((200_000, 3))
            own = fr.brdf.cook_torrance_sample(n, v, m, u)
            weights = _weights(n, own, v, m, fr.brdf.cook_torrance_pdf(n, own, v, m))
            z, turn = np.sqrt(u[:, 0]), 2.0 * np.pi * u[:, 1]
            s = np.sqrt(1.0 - z**2)
            even = np.stack([s * np.cos(turn), s * np.sin(turn), z], axis=-1)
            others = _weights(n, even, v, m, z / np.pi)
            ratio = others.var() / weights.var()
            print(f"m {m}, {degrees} degrees: {ratio:.0f} times less variance")


def _weights(
    n: np.ndarray, l: np.ndarray, v: np.ndarray, m: float, density: np.ndarray
) -> np.ndarray:
    value = fr.brdf.cook_torrance(n, l, v, m, 0.028) * np.maximum(l @ n, 0.0)
    return np.divide(value, density, out=np.zeros_like(value), where=value > 0.0)


if __name__ == "__main__":
    main()
