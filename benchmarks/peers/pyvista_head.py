"""The head with PyVista's physically based shading: ``pyvista_head.py MESH.glb OUT.png``."""

import sys

import pyvista

plotter = pyvista.Plotter(off_screen=True, window_size=(1024, 1024), lighting="none")
plotter.import_gltf(sys.argv[1])
for azimuth in (-50, 125, 50):
    light = pyvista.Light(light_type="scene light")
    light.set_direction_angle(40, azimuth)
    plotter.add_light(light)
plotter.camera_position = "xy"
plotter.screenshot(sys.argv[2])
