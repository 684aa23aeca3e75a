"""Render the head with pyrender (metallic-roughness shading, 4 samples per pixel).

pyrender_head.py MESH.glb OUT.png
"""

import os
import sys

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import numpy as np
import pyrender
import trimesh
from PIL import Image

np.infty = np.inf  # noqa: NPY201 - pyrender 0.1.45 is older than NumPy 2
mesh = trimesh.load_scene(sys.argv[1], process=False).to_geometry()
scene = pyrender.Scene(ambient_light=(0.1, 0.1, 0.1))
scene.add(pyrender.Mesh.from_trimesh(mesh))
pose = trimesh.transformations.rotation_matrix
for azimuth in (-50, 125, 50):
    turn = pose(np.radians(azimuth), (0, 1, 0)) @ pose(np.radians(-40), (1, 0, 0))
    scene.add(pyrender.DirectionalLight(intensity=3.0), pose=turn)
eye = np.eye(4)
eye[:3, 3] = mesh.bounds.mean(axis=0) + (0, 0, 0.8)
scene.add(pyrender.PerspectiveCamera(yfov=np.radians(25)), pose=eye)
color, _ = pyrender.OffscreenRenderer(1024, 1024).render(scene)
Image.fromarray(color).save(sys.argv[2], compress_level=1)
