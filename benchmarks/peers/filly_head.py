"""Render the head with Filament, by the package filly, with the view of pyvista_head.py.

filly_head.py MESH.glb OUT.png    one image
filly_head.py MESH.glb SAMPLES    a frame of a moving camera per line of standard input

Filament draws only one directional light of a scene. Two of the three are therefore point lights
so far away that the image stays the same within 2/255.
"""

import os

os.environ.setdefault("FILLY_OFFSCREEN_GL", "egl")

import filly
import numpy as np
from frames import run
from PIL import Image

IRRADIANCE = 2.1  # about as bright as PyVista's image


class Head:
    def __init__(self, path, samples=1, size=1024):
        filly.set_log_level("error")
        self.renderer = filly.Renderer()
        self.scene = self.renderer.create_scene()
        self.scene.msaa = samples
        self.scene.background = (1, 1, 1, 1)
        self.model = self.scene.load(path)
        low, high = np.array(self.model.bounds)
        self.center, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
        self.distance, self.azimuth = radius / np.sin(np.radians(15)), 0.0
        near, far = self.distance - radius, self.distance + radius
        self.camera = self.scene.camera = self.renderer.create_camera()
        self.camera.exposure = 1.0
        self.camera.set_perspective(fov_y_deg=30, near=near, far=far)
        up, away = np.radians(40), 500 * radius
        towards = [
            np.array((np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)))
            for turn in np.radians((-50, 125, 50))
        ]
        self.scene.add_directional_light(direction=-towards[0], intensity=IRRADIANCE)
        for each in towards[1:]:
            self.scene.add_point_light(
                position=self.center + away * each,
                intensity=IRRADIANCE * away**2,
                range=100 * away,
            )
        self.target = self.renderer.create_render_target(width=size, height=size)

    def frame(self, turned) -> np.ndarray:
        """Turn the camera by ``turned`` degrees and return the image."""
        self.azimuth += np.radians(turned)
        forward = np.array((np.sin(self.azimuth), 0.0, np.cos(self.azimuth)))
        self.camera.position = self.center + self.distance * forward
        self.camera.look_at(self.center)
        self.renderer.render(self.scene, self.target)
        return self.target.read()

    def save(self, path) -> None:
        Image.fromarray(self.frame(0.0)).save(path, compress_level=1)


if __name__ == "__main__":
    run(Head)
