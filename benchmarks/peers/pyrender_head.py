"""Render the head with pyrender (metallic-roughness shading, always 4 samples per pixel).

pyrender_head.py MESH.glb OUT.png    one image
pyrender_head.py MESH.glb 4          a frame of a moving camera per line of standard input

The package pyrender-maintained is a fork of pyrender that runs with NumPy 2 and current PyOpenGL.
"""

import os

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import numpy as np
import pyrender
import trimesh
from frames import run
from PIL import Image
from trimesh.transformations import rotation_matrix

np.infty = np.inf  # noqa: NPY201 - pyrender 0.1.45 is older than NumPy 2


class Head:
    def __init__(self, path, samples=4, size=1024):
        assert samples == 4, "pyrender always draws 4 samples per pixel"
        mesh = trimesh.load_scene(path, process=False).to_geometry()
        self.scene = pyrender.Scene(ambient_light=(0.1, 0.1, 0.1))
        self.scene.add(pyrender.Mesh.from_trimesh(mesh))
        for azimuth in np.radians((-50, 125, 50)):
            turn = rotation_matrix(azimuth, (0, 1, 0)) @ rotation_matrix(np.radians(-40), (1, 0, 0))
            self.scene.add(pyrender.DirectionalLight(intensity=3.0), pose=turn)
        self.center, self.azimuth = mesh.bounds.mean(axis=0), 0.0
        self.camera = self.scene.add(pyrender.PerspectiveCamera(yfov=np.radians(25)))
        self.renderer = pyrender.OffscreenRenderer(size, size)

    def frame(self, turned) -> np.ndarray:
        """Turn the camera by ``turned`` degrees and return the image."""
        self.azimuth += np.radians(turned)
        eye = np.eye(4)
        eye[:3, 3] = self.center + (0, 0, 0.8)
        turn = rotation_matrix(self.azimuth, (0, 1, 0), self.center)
        self.scene.set_pose(self.camera, turn @ eye)
        return self.renderer.render(self.scene)[0]

    def save(self, path) -> None:
        Image.fromarray(self.frame(0.0)).save(path, compress_level=1)


if __name__ == "__main__":
    run(Head)
