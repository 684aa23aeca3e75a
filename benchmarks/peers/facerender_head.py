"""Render frames of the head with facerender in a process of its own, to compare its memory.

facerender_head.py MESH.glb SAMPLES    a frame of a moving camera per line of standard input
"""

import sys

import facerender as fr
from tests.verification.lights import PLAIN_THREE

mesh = fr.load_mesh(sys.argv[1])
with fr.Renderer(samples=int(sys.argv[2])) as renderer:
    for turn, _ in enumerate(sys.stdin):
        scene = fr.Scene(mesh, fr.Camera(azimuth=2.0 * turn), PLAIN_THREE)
        print(renderer.render(scene).linear.shape, flush=True)
