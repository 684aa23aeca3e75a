"""Render as loop.py, with a pool of one process per core: ``pool.py JOBS.json OUT``."""

import json
import multiprocessing
import sys

from loop import scene_of

import facerender as fr


def start(given):
    global jobs, mesh, renderer
    jobs = given
    mesh = fr.load_mesh(jobs["mesh"])
    renderer = fr.Renderer((jobs["size"], jobs["size"]), samples=jobs["samples"])


def draw(numbered):
    number, turn = numbered
    renderer.render(scene_of(mesh, jobs, turn)).save(f"{sys.argv[2]}/{number:06d}.png")


if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        given = json.load(file)
    with multiprocessing.get_context("spawn").Pool(None, start, (given,)) as pool:
        pool.map(draw, enumerate(given["turns"]))
