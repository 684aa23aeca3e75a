"""facerender in other people's programs: after a fork, in threads, dropped without release, and with
values of the wrong type."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import facerender as fr
from facerender.drawing import context as contexts
from facerender.drawing.context import Backend, create_context
from facerender.drawing.evaluate import Evaluator
from facerender.drawing.resources import MOST_PROGRAMS
from tests.awkward_files import MINI_HEAD

ROOT = Path(__file__).parents[1]


# --- Fork ----------------------------------------------------------------------------------------


def digest(linear: np.ndarray) -> str:
    return blake2b(linear.tobytes()).hexdigest()


def in_child(function: Callable[[], str]) -> str:
    """Return what a function returns, or the error that it raises, in a child made by fork, which
    is killed after a minute."""
    fork = multiprocessing.get_context("fork")
    ours, its = fork.Pipe(duplex=False)

    def run() -> None:
        signal.alarm(60)  # kills it
        try:
            its.send(function())
        except fr.FacerenderError as error:
            its.send(f"{type(error).__name__}: {error}")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads beside a fork
        child = fork.Process(target=run)
        child.start()
    its.close()
    try:
        told: str = ours.recv()
    except EOFError:
        told = "no answer"
    child.join()
    assert child.exitcode == 0, f"{told}; the child ended with {child.exitcode}"
    return told


@pytest.fixture(scope="module")
def drawn(egl: Backend) -> Iterator[tuple[fr.Renderer, str]]:
    """A renderer that has drawn the built-in head, and what."""
    with fr.Renderer((64, 64), samples=4, backend=egl) as renderer:
        yield renderer, digest(renderer.render(fr.Scene(fr.load_mesh())).linear)


def test_a_child_draws_the_same(drawn):
    assert in_child(lambda: digest(fr.render(size=(64, 64)).linear)) == drawn[1]


def test_a_child_draws_a_mesh_whose_maps_are_being_decoded(drawn):
    mesh = fr.load_mesh()
    maps = [mesh.materials[0].albedo_map.levels(kind) for kind in ("color", "linear-color")]
    assert in_child(lambda: digest(fr.render(mesh, size=(64, 64)).linear)) == drawn[1]
    assert all(levels.done() for levels in maps)


def test_a_childs_child_is_told_what_to_do(drawn):
    def draw() -> str:
        return in_child(lambda: digest(fr.render(size=(64, 64), backend="egl").linear))

    def draw_and_fork() -> str:
        own = digest(fr.render(size=(64, 64), backend="egl").linear)
        return " ".join([own, draw()])

    own, told = in_child(draw_and_fork).split(maxsplit=1)
    assert own == drawn[1]
    assert told.startswith("ContextError: no OpenGL context (egl: it was in use before this")
    assert told.endswith("start processes by spawn or forkserver (multiprocessing.get_context), "
                         "not by fork")  # fmt: skip
    assert in_child(draw) == drawn[1], "a child that has not drawn does not stand in the way"


def test_a_renderer_of_before_the_fork_is_refused(drawn):
    renderer, expected = drawn
    scene = fr.Scene(fr.load_mesh())

    def use() -> str:
        with renderer:
            return digest(renderer.render(scene).linear)

    said = "ContextError: this renderer was made in the process that this one was forked from"
    assert in_child(use).startswith(said)
    assert in_child(lambda: str(renderer.release())) == "None"
    assert digest(renderer.render(scene).linear) == expected


def test_osmesa_is_refused_after_a_fork(drawn):
    from tests.conftest import require_backend

    require_backend("osmesa")
    told = in_child(lambda: digest(fr.render(size=(64, 64), backend="osmesa").linear))
    assert told.startswith("ContextError: no OpenGL context (osmesa: it was in use before this")


def test_a_hosts_context_is_refused_after_a_fork(egl):
    host = create_context(egl)
    with host.gl as gl:
        target = gl.framebuffer([gl.renderbuffer((64, 64), 4)])
        target.clear(0.25, 0.5, 0.75, 1.0)  # is not finished yet
        told = in_child(lambda: digest(fr.render(size=(64, 64), backend="current").linear))
        own = in_child(lambda: digest(fr.render(size=(64, 64), backend="egl").linear))
        assert target.read(components=4)[:4] == bytes([64, 128, 191, 255])
    host.release()
    assert told.startswith("ContextError: no OpenGL context (current: no EGL, GLX or OSMesa")
    assert own == digest(fr.render(size=(64, 64), backend="egl").linear)


def test_a_gpu_is_refused_after_a_fork(drawn, monkeypatch):
    monkeypatch.setitem(contexts._opened, "egl", False)
    told = in_child(lambda: digest(fr.render(size=(16, 16), backend="egl").linear))
    assert told.startswith("ContextError: no OpenGL context (egl: it was in use before this")


def test_maps_are_decoded_in_a_child(drawn):
    def decode() -> str:
        levels = fr.load_mesh().materials[0].albedo_map.levels("color").result()
        return digest(levels[0])

    assert in_child(decode) == decode()


def test_an_evaluator_of_before_the_fork_is_refused(egl):
    numbers = {"x": np.ones(4, np.float32)}
    evaluate = Evaluator(create_context(egl).gl)
    assert (evaluate("", "2.0 * x", numbers) == 2.0).all()
    told = in_child(lambda: str(evaluate("", "2.0 * x", numbers)))
    evaluate.release()
    assert told.startswith("ContextError: this renderer was made in the process")


def test_levels_and_occlusion_in_a_child():
    mesh = fr.load_mesh(MINI_HEAD)

    def work() -> str:
        baked = fr.with_occlusion(fr.load_mesh(MINI_HEAD))
        return digest(fr.simplified(baked, 300).parts[0].positions)

    fr.with_occlusion(fr.simplified(mesh, 300))
    assert in_child(work) == work()
