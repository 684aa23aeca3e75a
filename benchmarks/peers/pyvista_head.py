"""Render the head with PyVista's physically based shading.

pyvista_head.py MESH.glb OUT.png    one image
pyvista_head.py MESH.glb SAMPLES    a frame of a moving camera per line of standard input
"""

import numpy as np
import pyvista
from frames import run


class Head:
    def __init__(self, path, samples=1, size=1024):
        self.plotter = pyvista.Plotter(off_screen=True, window_size=(size, size), lighting="none")
        if samples > 1:
            self.plotter.enable_anti_aliasing("msaa", multi_samples=samples)
        else:
            self.plotter.disable_anti_aliasing()
        self.plotter.import_gltf(path)
        for azimuth in (-50, 125, 50):
            light = pyvista.Light(light_type="scene light")
            light.set_direction_angle(40, azimuth)
            self.plotter.add_light(light)
        self.plotter.camera_position = "xy"

    def frame(self, turned) -> np.ndarray:
        """Turn the camera by ``turned`` degrees and return the image."""
        self.plotter.camera.Azimuth(turned)
        self.plotter.render()
        return self.plotter.screenshot(return_img=True)

    def save(self, path) -> None:
        self.plotter.screenshot(path)


if __name__ == "__main__":
    run(Head)
