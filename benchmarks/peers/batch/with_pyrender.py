"""Render a data set of the head with pyrender: one process, one renderer, a loop.

    with_pyrender.py JOBS.json OUT

benchmarks/batch_peers.py writes JOBS.json. pyrender 0.1.45 always uses 4 samples per pixel. Set
PYOPENGL_PLATFORM=osmesa to render without EGL.
"""

import json
import os
import sys

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import numpy as np
import pyrender
import trimesh
from PIL import Image

np.infty = np.inf  # noqa: NPY201 - pyrender 0.1.45 is older than NumPy 2


def looking(eye, target):
    """Return the pose of a camera at ``eye`` whose -z axis points at ``target``, with y up."""
    z = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    x = np.cross((0.0, 1.0, 0.0), z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return pose


with open(sys.argv[1]) as file:
    jobs = json.load(file)
mesh = trimesh.load_scene(jobs["mesh"], process=False).to_geometry()
scene = pyrender.Scene(ambient_light=(0.0, 0.0, 0.0), bg_color=jobs["background"])
scene.add(pyrender.Mesh.from_trimesh(mesh))
for towards, irradiance in jobs["lights"]:
    strength = max(irradiance)
    light = pyrender.DirectionalLight([value / strength for value in irradiance], strength)
    scene.add(light, pose=looking(towards, (0.0, 0.0, 0.0)))
near, far = jobs["cameras"][0][2]
camera = scene.add(pyrender.PerspectiveCamera(np.radians(jobs["fov"]), znear=near, zfar=far))
renderer = pyrender.OffscreenRenderer(jobs["size"], jobs["size"])
for number, (eye, target, _) in enumerate(jobs["cameras"]):
    scene.set_pose(camera, looking(eye, target))
    color, _ = renderer.render(scene)
    Image.fromarray(color).save(f"{sys.argv[2]}/{number:06d}.png", compress_level=1)
