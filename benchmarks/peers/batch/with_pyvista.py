"""Render a data set of the head with PyVista: one process, one plotter, a loop.

    with_pyvista.py JOBS.json OUT

benchmarks/batch_peers.py writes JOBS.json.
"""

import json
import sys

import pyvista
from PIL import Image

with open(sys.argv[1]) as file:
    jobs = json.load(file)
size = jobs["size"]
plotter = pyvista.Plotter(off_screen=True, window_size=(size, size), lighting="none")
plotter.enable_anti_aliasing("msaa", multi_samples=jobs["samples"])
plotter.import_gltf(jobs["mesh"])
plotter.set_background(jobs["background"])
for towards, irradiance in jobs["lights"]:
    light = pyvista.Light(light_type="scene light")
    light.positional = False
    light.position, light.focal_point = towards, (0.0, 0.0, 0.0)
    light.intensity = max(irradiance)
    light.diffuse_color = [value / light.intensity for value in irradiance]
    plotter.add_light(light)
camera = plotter.camera
camera.view_angle = jobs["fov"]
for number, (eye, target, ends) in enumerate(jobs["cameras"]):
    camera.position, camera.focal_point, camera.up = eye, target, (0.0, 1.0, 0.0)
    camera.clipping_range = ends
    plotter.render()
    pixels = plotter.screenshot(return_img=True)
    Image.fromarray(pixels).save(f"{sys.argv[2]}/{number:06d}.png", compress_level=1)
