"""Render a data set of the head with one facerender.Renderer: ``loop.py JOBS.json OUT``."""

import json
import sys

import facerender as fr


def scene_of(mesh, jobs, turn):
    azimuth, elevation = turn
    lights = [fr.Light(*light, shadow=False) for light in jobs["facerender_lights"]]
    camera = fr.Camera(azimuth, elevation)
    return fr.Scene(mesh, camera, lights, ambient=0.0, background=jobs["facerender_background"])


if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        jobs = json.load(file)
    mesh = fr.load_mesh(jobs["mesh"])
    size = (jobs["size"], jobs["size"])
    with fr.Renderer(size, samples=jobs["samples"]) as renderer:
        for number, turn in enumerate(jobs["turns"]):
            renderer.render(scene_of(mesh, jobs, turn)).save(f"{sys.argv[2]}/{number:06d}.png")
