"""The command line of a peer: MESH.glb OUT.png for one image, or MESH.glb SAMPLES for frames."""

import sys


def run(Head) -> None:
    """Save one image, or render a frame of a moving camera per line of standard input.

    Head : class of a renderer with the methods frame(degrees) and save(path)
    """
    mesh, last = sys.argv[1:]
    if last.isdecimal():
        head = Head(mesh, int(last))
        for _ in sys.stdin:
            print(head.frame(2.0).shape, flush=True)
    else:
        Head(mesh).save(last)


def play(Clip) -> None:
    """Render a frame of a clip, at 25 frames per second, per line of standard input.

    Clip : class of a renderer with the method show(turn), made of CLIP.glb, FRAMES.npy and SAMPLES
    """
    clip = Clip(*sys.argv[1:3], int(sys.argv[3]))
    for turn, _ in enumerate(sys.stdin):
        print(clip.show(turn).shape, flush=True)
