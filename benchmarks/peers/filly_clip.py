"""Render a clip of the head with Filament, by the package filly: morph targets on the GPU.

filly_clip.py CLIP.glb FRAMES.npy SAMPLES    a frame of the clip per line of standard input
"""

from filly_head import Head
from frames import play


class Clip(Head):
    def __init__(self, path, frames, samples):
        super().__init__(path, samples)

    def show(self, turn):
        self.model.apply_animation(0, turn / 25 % 2)
        return self.frame(0.0)


if __name__ == "__main__":
    play(Clip)
