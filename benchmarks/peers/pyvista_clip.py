"""Render a clip of the head with PyVista: vertices of each frame are assigned to the mesh.

pyvista_clip.py CLIP.glb FRAMES.npy SAMPLES    a frame of the clip per line of standard input
"""

import numpy as np
import pyvista
from frames import play
from pyvista_head import Head


class Clip(Head):
    def __init__(self, path, frames, samples):
        super().__init__(path, samples)
        self.frames = np.load(frames)
        actors = self.plotter.actors.values()
        self.meshes = [pyvista.wrap(each.GetMapper().GetInput()) for each in actors]

    def show(self, turn):
        rows, start = self.frames[turn % len(self.frames)], 0
        for mesh in self.meshes:
            mesh.points = rows[start : start + mesh.n_points]
            start += mesh.n_points
        return self.frame(0.0)


if __name__ == "__main__":
    play(Clip)
