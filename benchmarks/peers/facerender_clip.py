"""Render a clip of the head with facerender: with_pose and a frame, as the other renderers do.

facerender_clip.py CLIP.glb FRAMES.npy SAMPLES    a frame of the clip per line of standard input
"""

from frames import play

import facerender as fr
from tests.verification.lights import PLAIN_THREE


class Clip:
    def __init__(self, path, frames, samples):
        self.mesh, self.renderer = fr.load_mesh(path), fr.Renderer(samples=samples)

    def show(self, turn):
        pose = self.mesh.with_pose(clip="talk", time=turn / 25 % 2)
        return self.renderer.render(fr.Scene(pose, lights=PLAIN_THREE)).linear


if __name__ == "__main__":
    play(Clip)
