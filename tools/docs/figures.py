"""Renders the pictures of the README and docs/lobes.md: ``python docs/figures.py``."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import facerender as fr
from facerender.images.srgb import encode_srgb8

HERE = Path(__file__).parents[2] / "docs"


def save(name: str, images: list[np.ndarray]) -> None:
    halves = [np.asarray(Image.fromarray(image).reduce(2)) for image in images]
    Image.fromarray(np.hstack(halves)).save(HERE / name, quality=90)


def main() -> None:
    head = fr.load_mesh()
    oblique = fr.Camera(-35.0, 4.0)
    with fr.Renderer((960, 960)) as renderer:
        soft = tuple(replace(each, radius=5.0, shadow=True) for each in fr.Scene(head).lights)
        scenes = [fr.Scene(head, camera, soft) for camera in (fr.Camera(), oblique)]
        front, side = map(renderer.render, scenes)
        specular = renderer.render(scenes[1], only="specular")
        save("head.jpg", [front.srgb8(), side.srgb8(), encode_srgb8(specular.linear[..., :3], 1.0)])

        # One m for the whole face, so that the caption can name it.
        scene = fr.Scene(head.with_material(m=0.4), oblique)
        exact, d16 = (renderer.render(scene, fr.Shading(lobe=lobe)) for lobe in ("exact", "d16"))
        difference = np.abs(d16.linear[..., :3] - exact.linear[..., :3])
        save("exact-d16.jpg", [exact.srgb8(), d16.srgb8(), encode_srgb8(8.0 * difference)])
        print(f"D16 at m = 0.4 is off by up to {difference.max():.2f} in linear radiance")


if __name__ == "__main__":
    main()
