"""Tests facerender inside other programs: after a fork, in threads, and with renderers and meshes
that are dropped without release."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import facerender as fr
from facerender.drawing.compiled import CompiledFrame
from facerender.drawing.context import Backend, create_context
from tests.awkward_files import MINI_HEAD, Head, write_glb, write_ply, write_stl, write_textured_obj
from tests.verification.fuzz.seeds import octahedron

ROOT = Path(__file__).parents[1]
REFUSED = (
    "ContextError: no OpenGL context (egl: this driver was in use before this process was forked); "
    'start the process by multiprocessing.get_context("spawn"), or a PyTorch loader with '
    'multiprocessing_context="spawn"'
)


# --- fork ----------------------------------------------------------------------------------------


def digest(linear: np.ndarray) -> str:
    return blake2b(linear.tobytes()).hexdigest()


def in_child(function: Callable[[], str]) -> str:
    """Call a function in a forked child; return its result or the message of its error.

    The child is killed after four minutes.
    """
    fork = multiprocessing.get_context("fork")
    ours, its = fork.Pipe(duplex=False)

    def run() -> None:
        signal.alarm(240)  # kills this process
        try:
            its.send(function())
        except fr.FacerenderError as error:
            its.send(f"{type(error).__name__}: {error}")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python warns of fork with threads
        child = fork.Process(target=run)
        child.start()
    its.close()
    try:
        answer: str = ours.recv()
    except EOFError:
        answer = "no answer"
    child.join()
    assert child.exitcode == 0, f"{answer}; the child ended with {child.exitcode}"
    return answer


def draw(backend: str = "egl") -> str:
    return digest(fr.render(fr.load_mesh(MINI_HEAD), size=(64, 64), backend=backend).linear)


@pytest.fixture(scope="module")
def drawn(egl: Backend) -> Iterator[tuple[fr.Renderer, str]]:
    """A renderer that has drawn the small head, and the digest of its image."""
    with fr.Renderer((64, 64), samples=4, backend=egl) as renderer:
        yield renderer, digest(renderer.render(fr.Scene(fr.load_mesh(MINI_HEAD))).linear)


def test_a_child_is_refused_after_its_parent_has_drawn(drawn):
    assert in_child(draw) == REFUSED
    assert in_child(lambda: in_child(draw)) == REFUSED


def test_renderer_created_before_a_fork_is_refused(drawn):
    renderer, expected = drawn
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))

    def use() -> str:
        with renderer:
            return digest(renderer.render(scene).linear)

    message = "ContextError: this renderer was created before a fork, in another process: create"
    assert in_child(use).startswith(message)
    assert in_child(lambda: str(renderer.release())) == "None"
    assert digest(renderer.render(scene).linear) == expected


def test_osmesa_is_refused_after_a_fork(drawn):
    from tests.conftest import require_backend

    require_backend("osmesa")
    answer = in_child(lambda: draw("osmesa"))
    assert answer.startswith("ContextError: no OpenGL context (osmesa: this driver was in use")


def test_context_of_a_host_is_refused_after_a_fork(egl, drawn):
    host = create_context(egl)
    with host.gl as gl:
        target = gl.framebuffer([gl.renderbuffer((64, 64), 4)])
        target.clear(*(value / 255 for value in (64, 128, 191, 255)))  # unfinished before the fork
        answer = in_child(lambda: draw("current"))
        own = in_child(draw)
        assert target.read(components=4)[:4] == bytes([64, 128, 191, 255])
    host.release()
    assert answer.startswith("ContextError: no OpenGL context (current: no EGL, GLX or OSMesa")
    assert own == REFUSED


@pytest.mark.slow
@pytest.mark.parametrize("parent", ["nothing", "facerender", "another context"])
def test_a_child_draws_if_its_parent_has_not(parent, drawn):
    """The parent is a process of its own. It draws nothing, an image, or with other code."""
    code = {
        "nothing": "fr.load_mesh(sys.argv[1])",
        "facerender": "fr.render(sys.argv[1], size=8)",
        "another context": "moderngl.create_context(standalone=True, backend='egl')",
    }[parent]
    code = f"""
import sys, moderngl, faulthandler, os
import facerender as fr
from hashlib import blake2b
kept = {code}
if os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
faulthandler.dump_traceback_later(200, exit=True)
mesh = fr.load_mesh(sys.argv[1])
try:
    image = fr.render(mesh, size=(64, 64), backend="egl").linear
    print(blake2b(image.tobytes()).hexdigest())
except fr.ContextError as error:
    print(f"ContextError: {{error}}")
"""
    run = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", code, str(MINI_HEAD)],
        **{"capture_output": True, "text": True, "timeout": 240, "cwd": ROOT},
    )
    expected = drawn[1] if parent == "nothing" else REFUSED
    assert (run.stdout.strip(), run.stderr, run.returncode) == (expected, "", 0)


@pytest.mark.slow
def test_maps_are_decoded_in_a_child(drawn):
    def decode() -> str:
        levels = fr.load_mesh().materials[0].albedo_map.levels("color").result()
        return digest(levels[0])

    assert in_child(decode) == decode()


def test_levels_and_occlusion_in_a_child():
    def work() -> str:
        baked = fr.with_occlusion(fr.simplified(fr.load_mesh(MINI_HEAD), 300))
        return digest(fr.simplified(baked, 250).parts[0].positions)

    work()  # loads the libraries in this process before the fork
    assert in_child(work) == work()


# --- threads and dropped renderers ---------------------------------------------------------------


def test_threads_share_a_renderer(backend):
    mesh = fr.load_mesh(MINI_HEAD)
    scenes = [fr.Scene(mesh, fr.Camera(azimuth=30.0 * turn)) for turn in range(8)]
    with fr.Renderer((96, 96), backend=backend) as renderer:
        expected = [renderer.render(scene).linear for scene in scenes]
        with ThreadPoolExecutor(4) as pool:
            drawn = [*pool.map(lambda scene: renderer.render(scene).linear, scenes * 4)]
    for frame, wanted in zip(drawn, expected * 4, strict=True):
        np.testing.assert_array_equal(frame, wanted)


@pytest.mark.slow
def test_threads_draw_with_renderers_of_their_own(backend):
    mesh = fr.load_mesh(MINI_HEAD)
    expected = fr.render(mesh, size=(96, 96), backend=backend).linear
    with ThreadPoolExecutor(4) as pool:
        drawn = pool.map(lambda _: fr.render(mesh, size=(96, 96), backend=backend), range(8))
        for frame in drawn:
            np.testing.assert_array_equal(frame.linear, expected)


def resident() -> int:
    """Return the resident memory of this process in MiB."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # free memory that malloc retains varies
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") >> 20


def drop(scene: fr.Scene, backend: Backend) -> None:
    """Draw, and drop the renderer without release."""
    fr.Renderer((64, 64), samples=1, backend=backend).render(scene)


@pytest.mark.slow
def test_dropped_renderers_free_their_memory(backend):
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    held = []
    with warnings.catch_warnings(record=True) as answer:
        warnings.simplefilter("always")
        for _ in range(3):
            for _ in range(4):
                drop(scene, backend)
            held.append(resident())
    assert [warning.category for warning in answer] == [ResourceWarning] * 12
    assert "dropped without release(): create it in a with statement" in str(answer[0].message)
    assert held[2] - held[1] < 16  # without freeing, each took 12 MiB


@pytest.mark.first_case
@pytest.mark.parametrize("write", [write_glb, write_textured_obj, write_ply, write_stl])
def test_loaded_data_is_freed_with_its_mesh(
    write: Callable[[Path, Head], Path], tmp_path: Path
) -> None:
    """This needs no garbage collection. Textures and arrays of trimesh are counted."""
    from trimesh.caching import TrackedArray

    def held() -> int:
        return sum(isinstance(each, fr.Texture | TrackedArray) for each in gc.get_objects())

    kind = write.__name__.rpartition("_")[2]
    path = write(tmp_path / f"a.{kind}", octahedron())
    gc.collect()
    gc.disable()
    gc.freeze()  # get_objects omits these objects, of which earlier tests leave many
    try:
        before = held()
        mesh = fr.load_mesh(path)
        texture = mesh.materials[0].albedo_map
        assert held() == before + (texture is not None)
        del mesh, texture
        assert held() == before
    finally:
        gc.unfreeze()
        gc.enable()


@pytest.mark.first_case
@pytest.mark.parametrize("shading", [fr.Shading(), fr.Shading(m=0.3)], ids=["own m", "one m"])
def test_dropped_meshes_are_freed(shading: fr.Shading, backend):
    """Their parts, maps and simplified meshes are freed, too, while the renderer exists."""
    with fr.Renderer((64, 64), backend=backend) as renderer:
        mesh = fr.load_mesh(MINI_HEAD)
        for each in (mesh, fr.simplified(mesh, 500)):
            renderer.render(fr.Scene(each, fr.Camera(frame="face")), shading)
        held = [mesh, each, *mesh.parts, *each.parts, mesh.materials[0].albedo_map]
        known = [weakref.ref(one) for one in held]
        del mesh, each, held
        gc.collect()
        assert [one() for one in known] == [None] * len(known)


@pytest.mark.slow
def test_renderer_may_be_dropped_while_another_draws(backend, monkeypatch):
    """The garbage collector may drop a renderer in any thread at any time."""
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    with fr.Renderer((64, 64), backend=backend) as renderer:
        expected = renderer.render(scene).linear
        replay = CompiledFrame._replay

        def draw_beside(frame: CompiledFrame, *arguments: Any) -> Any:
            if frame.resources.context is renderer.context:
                drop(scene, backend)
            return replay(frame, *arguments)

        monkeypatch.setattr(CompiledFrame, "_replay", draw_beside)
        with pytest.warns(ResourceWarning, match="dropped without release"):
            np.testing.assert_array_equal(renderer.render(scene).linear, expected)


def test_dropped_guest_frees_its_objects_in_the_host_context(backend):
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    host = create_context(backend)
    address = host.loader.load("glIsTexture")
    is_texture = ctypes.CFUNCTYPE(ctypes.c_ubyte, ctypes.c_uint)(address)
    with host.gl:
        guest = fr.Renderer((32, 32), samples=1, backend="current")
        guest.render(scene)
        named = [number for number in range(1, 200) if is_texture(number)]
        with pytest.warns(ResourceWarning, match="dropped without release"):
            del guest
        assert named
        assert not any(map(is_texture, named))
    with host.gl:
        guest = fr.Renderer((32, 32), samples=1, backend="current")
    with pytest.warns(ResourceWarning, match="dropped without release"):
        del guest
    host.release()


@pytest.mark.slow
@pytest.mark.parametrize("end", ["raise SystemExit(3)", "import os; os.fork() or exit()"])
def test_the_interpreter_ends_without_noise(egl, end):
    """At the end a renderer exists in a reference cycle, and maps are being decoded."""
    code = (
        "import facerender as fr\n"
        "renderer = fr.Renderer((32, 32))\n"
        f"mesh = fr.load_mesh({str(MINI_HEAD)!r})\n"
        "renderer.render(fr.Scene(mesh))\n"
        "renderer.itself = renderer\n"
        f"fr.load_mesh().materials[0].albedo_map.levels('color')\n{end}"
    )
    run = subprocess.run(
        [sys.executable, "-X", "dev", "-W", "ignore::DeprecationWarning", "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert (run.returncode, run.stdout, run.stderr) == (3 if "3" in end else 0, "", "")


def test_cached_programs_are_bounded(egl, monkeypatch):
    monkeypatch.setattr("facerender.drawing.resources.MAX_PROGRAMS", 4)
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    with fr.Renderer((32, 32), samples=1, backend=egl) as renderer:
        made = []
        compile_ = renderer.context.gl.program
        monkeypatch.setattr(
            renderer.context.gl, "program", lambda **own: made.append(1) or compile_(**own)
        )
        expected = renderer.render(scene).linear
        for step in range(8):
            renderer.render(scene, fr.Shading(m=0.2 + 0.001 * step))
            if step % 2:
                renderer.render(scene)
        count = len(made)
        np.testing.assert_array_equal(renderer.render(scene).linear, expected)
        assert len(made) == count, "what is in use was compiled anew"
        renderer.render(scene, fr.Shading(m=0.2))
        assert len(made) > count

        monkeypatch.setattr("facerender.drawing.resources.MAX_PROGRAMS", 0)
        for _ in range(2):
            count = len(made)
            renderer.render(scene)
        assert len(made) == count, "a frame with more programs than are kept is compiled once"
