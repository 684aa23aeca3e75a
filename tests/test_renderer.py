"""Tests the renderer: against the float64 reference, across backends, its use of memory, and as a
guest in another program's OpenGL context."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import shutil
import subprocess
import sys
import tracemalloc
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.comparison.compare import compare
from facerender.drawing import reference
from facerender.drawing.context import CAPABILITIES, STATE, Backend, create_context
from facerender.drawing.prepare import LightGroup
from facerender.drawing.program import Program
from facerender.images.files import read_image
from facerender.images.image import ImageData
from facerender.lobes import GPower
from facerender.material import MAPS
from facerender.measure.measurement import block_error
from facerender.scene.environment import studio
from facerender.terms.model import MODELS, Model
from tests.awkward_files import MINI_HEAD
from tests.conftest import missing, require_backend
from tests.meshes import with_geometry
from tests.test_reference import SIDE, around, compared, lit, mixed, programs_of, shadows, skin
from tests.verification.eye import CLEAR, eye
from tests.verification.lights import PLAIN_THREE
from tests.verification.parts_head import parts_head


@pytest.fixture(scope="module")
def transparent(backend: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer((256, 192), samples=1, backend=backend) as renderer:
        yield renderer


def test_shifted_scene_moves_right_and_down(transparent, coarse_head):
    scene, size = fr.Scene(coarse_head), transparent.size
    still, moved = (transparent.render(fr.shifted(scene, *by, size)) for by in ((0, 0), (3, 2)))
    assert compare(transparent.render(scene), still)
    assert compare(still.linear[:-2, :-3], moved.linear[2:, 3:])


def test_data_views_show_the_simplified_scene(renderer, head):
    scene = fr.Scene(head)
    smooth = fr.Shading(normal_map=False)
    normal = renderer.render(scene, smooth, "normal").linear[..., :3]
    np.testing.assert_array_equal(normal, renderer.gbuffer(scene, smooth).normal)
    assert np.abs(normal - renderer.gbuffer(scene).normal).max() > 0.01


@pytest.mark.parametrize("name", ["specular_lights", "shadow_lights"])
@pytest.mark.parametrize("lights", [(-1,), (0, 9)])
def test_missing_lights_are_refused(renderer, head, name, lights):
    scene = lit(head)
    shading = fr.Shading(**{name: lights})
    message = rf"{name} names light {lights[-1]}: the scene has 4, counted from 0"
    for use in (
        lambda: renderer.render(scene, shading),
        lambda: renderer.gbuffer(scene, shading),
        lambda: reference.shade(renderer.gbuffer(scene), scene, shading),
    ):
        with pytest.raises(fr.InputError, match=message):
            use()


def test_slopes_of_a_shading_must_be_in_the_domain(renderer, head):
    for shading, message in (
        (fr.Shading(lobe="d8", m=0.8), "m = 0.8 is outside the domain of lobe d8"),
        (fr.Shading(lobe=GPower(8, 0.25, 1.0), m=0.6), r"lobe g-power 8 .* in \[0.0001, 0.5\]"),
    ):
        with pytest.raises(fr.InputError, match=message):
            renderer.render(fr.Scene(head), shading)
    outside = fr.Shading(lobe=GPower(8, 0.25, 1.0), m=0.6, outside="exact")
    frame = renderer.render(fr.Scene(head), outside)
    assert frame.metadata["lobe of each part"] == "exact"
    assert frame.metadata["lobe"] == "g-power 8 (0.25/m^2 - 1)"


PASSES = {  # a scene, and whether it uses deferred shading
    "forward": (lambda mesh: fr.Scene(mesh, SIDE, background=None), False),
    "deferred": (lambda mesh: fr.Scene(mesh, SIDE), True),
    "shadow maps": (shadows, False),
    "environment": (around, True),
    "scattering": (lambda mesh: skin(with_geometry(mesh, millimetres=1000.0)), False),
    "layers": (lambda _: fr.Scene(parts_head("mask"), SIDE), False),
}


@pytest.fixture(scope="module")
def drivers() -> Iterator[list[fr.Renderer]]:
    made = [fr.Renderer((64, 64), backend=require_backend(name)) for name in ("egl", "osmesa")]
    yield made
    for renderer in made:
        renderer.release()


@pytest.mark.first_case
@pytest.mark.osmesa
@pytest.mark.smoke
@pytest.mark.filterwarnings("ignore:data images and landmarks omit parts")  # the shells
@pytest.mark.parametrize("name", PASSES)
def test_osmesa_and_egl_draw_each_pass_equally(drivers, name, monkeypatch):
    scene_of, deferred = PASSES[name]
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred)
    scene = scene_of(fr.load_mesh(MINI_HEAD))
    for only in (None, "depth"):
        frames = [each.render(scene, only=only) for each in drivers]
        np.testing.assert_array_equal(frames[0].linear, frames[1].linear)
        assert np.ptp(frames[0].linear[..., :3]) > 0.1
    surfaces = [each.gbuffer(scene) for each in drivers]
    for field in ("part", "position", "normal", "albedo", "m", "occlusion", "visibility"):
        np.testing.assert_array_equal(*(getattr(each, field) for each in surfaces))


def test_d16_shows_no_false_highlight_at_grazing_angles(renderer, head):
    """Beyond 49 degrees, the base of D16 is negative at m = 0.2, and the power must be 0."""
    mesh = head.with_material(m=0.2, normal_map=None)
    scene = fr.Scene(mesh, lights=(fr.Light(110.0, 5.0),), ambient=0.0, background=None)
    exact = renderer.render(scene, fr.Shading(), only="specular").linear[..., :3]
    d16 = renderer.render(scene, fr.Shading(lobe="d16"), "specular").linear[..., :3]
    assert (d16 - exact).max() < 0.02 * exact.max()


def test_only_what_the_scene_needs_is_compiled(head):
    scene = fr.Scene(head, lights=PLAIN_THREE)
    (full,) = programs_of(scene, fr.Shading())
    assert {"ALBEDO_MAP", "NORMAL_MAP", "AMBIENT", "DIFFUSE"} <= set(full.features)
    assert full.lights == (LightGroup("directional", True, 3),)
    (default,) = programs_of(fr.Scene(head), fr.Shading())
    assert default.lights == (LightGroup("disc", True, 3, shadows=0),)
    brighter = tuple(replace(light, irradiance=9.0, azimuth=5.0) for light in scene.lights)
    assert programs_of(replace(scene, lights=brighter), fr.Shading()) == [full]
    plain = head.with_material(normal_map=None, roughness_map=None, occlusion_map=None, ks=0.0)
    dark = replace(scene, mesh=plain, ambient=0.0, lights=())
    assert programs_of(dark, fr.Shading()) == [
        Program("shade.frag", features=("ALBEDO_MAP", "UV", "DIFFUSE"), lights=())
    ]


def test_data_views(renderer, head):
    scene = fr.Scene(head, lights=(fr.Light(20.0, 30.0),))
    normal, depth, cosines, albedo = (
        renderer.render(scene, only=only).linear
        for only in ("normal", "depth", "cosines", "albedo")
    )
    covered = normal[..., 3] > 0
    np.testing.assert_allclose(np.linalg.norm(normal[covered][:, :3], axis=1), 1.0, atol=1e-5)
    expected = normal[covered][:, :3] @ scene.lights[0].direction
    np.testing.assert_allclose(cosines[covered][:, 0], expected, atol=1e-5)
    # The range of depths is at most the depth of the head along the view axis.
    extent = head.bounds[1, 2] - head.bounds[0, 2]
    assert 0.3 * extent < np.ptp(depth[covered][:, 0]) < extent
    gbuffer = renderer.gbuffer(scene, blended=False)
    of_gbuffer = gbuffer.part >= 0
    assert of_gbuffer.mean() > 0.2
    np.testing.assert_array_equal(gbuffer.depth[~of_gbuffer], 0.0)
    apart = np.abs(gbuffer.depth - depth[..., 0])[of_gbuffer]
    assert np.quantile(apart, 0.95) < 1e-5 * depth.max()  # lashes may be nearer
    assert (albedo[covered][:, :3] >= 0).all()
    assert (albedo[covered][:, :3] <= 1).all()


def square(folder: Path, height: float = 1.0, u: tuple[int, ...] = (0, 1, 1, 0)) -> Path:
    """Write a square in the plane z = 0, with u to the right and v up."""
    corners = [f"v {x} {y * height} 0" for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    uv = [f"vt {x} {y}" for x, y in zip(u, (0, 0, 1, 1), strict=True)]
    path = folder / "square.obj"
    path.write_text("\n".join([*corners, *uv, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]))
    return path


def test_normal_map_tilts_towards_its_green_and_red(renderer, tmp_path):
    """Red tilts the normal to +x and green to +y. This must hold from behind, too, and with a
    mirrored texture."""
    Image.new("RGB", (4, 4), (191, 191, 218)).save(tmp_path / "tilted.png")
    for sign, u in ((1, (0, 1, 1, 0)), (-1, (1, 0, 0, 1))):
        mesh = fr.load_mesh(square(tmp_path, u=u), normal_map=tmp_path / "tilted.png")
        for azimuth, facing in ((0, 1), (180, -1)):
            gbuffer = renderer.gbuffer(fr.Scene(mesh, fr.Camera(azimuth=azimuth)))
            normal = gbuffer.normal[gbuffer.part >= 0].mean(axis=0)
            np.testing.assert_allclose(normal, [0.5 * sign, 0.5, 0.7 * facing], atol=0.03)


def test_normal_map_on_a_stretched_chart(renderer, tmp_path):
    """Different texel densities along u and v change the tilt only by a common scale."""
    Image.new("RGB", (4, 4), (191, 128, 238)).save(tmp_path / "tilted.png")
    for height in (1.0, 4.0):
        mesh = fr.load_mesh(square(tmp_path, height), normal_map=tmp_path / "tilted.png")
        gbuffer = renderer.gbuffer(fr.Scene(mesh))
        tilt = gbuffer.normal[gbuffer.part >= 0].mean(axis=0)
        np.testing.assert_allclose(tilt, [0.5, 0.0, 0.866], atol=0.01)


def test_black_texels_of_a_roughness_map_stay_in_the_domain(renderer, tmp_path):
    Image.new("L", (4, 4), 0).save(tmp_path / "smooth.png")
    mesh = fr.load_mesh(MINI_HEAD, roughness_map=tmp_path / "smooth.png")
    gbuffer = renderer.gbuffer(fr.Scene(mesh), fr.Shading(slope_filter=False))
    assert (gbuffer.m[gbuffer.part >= 0] == np.float32(1e-4)).all()
    assert np.isfinite(renderer.render(fr.Scene(mesh)).linear).all()


def test_8_bit_images_of_a_frame():
    linear = np.zeros((1, 3, 4), np.float32)
    linear[0, :2] = [[0.107, 0.107, 0.107, 0.5], [0.214, 0.214, 0.214, 1.0]]
    clear = fr.Frame(linear, None, True, {}).srgb8()
    assert clear[0].tolist() == [[127, 127, 127, 128], [127, 127, 127, 255], [0, 0, 0, 0]]
    assert fr.Frame(linear, None, False, {}).srgb8()[0, 1].tolist() == [127, 127, 127]
    depth = fr.Frame(linear, "depth", False, {}).srgb8()[0, :, 0]
    assert depth.tolist() == [128, 26, 0]  # nearer is brighter; the first pixel is half covered
    normal = fr.Frame(linear * 0 + [[[0, 0, 1, 1]]], "normal", False, {}).srgb8()
    assert normal[0, 0].tolist() == [128, 128, 255]


def test_point_light_gives_its_irradiance_at_the_centre(renderer, tmp_path):
    mesh = fr.load_mesh(square(tmp_path)).with_material(albedo=1.0, ks=0.0)
    light = fr.Light(irradiance=np.pi, position=(0.0, 0.0, 5.0))
    frame = renderer.render(fr.Scene(mesh, lights=(light,), ambient=0.0))
    # Without ambient and specular terms, albedo / pi * irradiance is 1 at the centre.
    assert frame.linear[128, 128, :3] == pytest.approx(1.0, abs=1e-3)
    assert frame.linear[20, 20, 0] < 0.95


def test_background_alpha_and_multisampling(egl, head):
    with fr.Renderer((128, 128), samples=4, backend=egl) as renderer:
        opaque = renderer.render(fr.Scene(head, background=(0.1, 0.2, 0.3)))
        clear = renderer.render(fr.Scene(head, background=None))
    np.testing.assert_allclose(opaque.linear[0, 0], [0.1, 0.2, 0.3, 0.0])
    np.testing.assert_array_equal(opaque.linear[..., 3], clear.linear[..., 3])
    coverage = clear.linear[..., 3]
    assert set(np.unique(coverage)) == {0.0, 0.25, 0.5, 0.75, 1.0}
    assert opaque.srgb8().shape == (128, 128, 3)
    assert clear.srgb8().shape == (128, 128, 4)


def test_orbits_frame_the_whole_mesh(renderer, head, scan_mesh):
    for mesh in (head, scan_mesh):
        for camera in (SIDE, fr.Camera(90.0), fr.Camera(180.0, -30.0), fr.Camera(20.0, 90.0)):
            scene = fr.Scene(mesh, replace(camera, frame="all"))
            covered = renderer.gbuffer(scene).part >= 0
            assert covered.any()
            assert not covered[[0, -1], :].any()
            assert not covered[:, [0, -1]].any()


@pytest.mark.slow
@pytest.mark.osmesa
@pytest.mark.smoke
def test_renderers_side_by_side(egl, head):
    osmesa = require_backend("osmesa")
    scene = fr.Scene(head)
    renderers = [fr.Renderer((96, 96), backend=name) for name in (egl, osmesa, egl)]
    frames = [renderer.render(scene).linear for renderer in renderers]
    renderers[0].release()
    for renderer, frame in zip(renderers[1:], frames[1:], strict=True):
        np.testing.assert_array_equal(renderer.render(scene).linear, frame)
        renderer.release()


def _resident() -> int:
    """Return the resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() >> 20


@pytest.mark.memory
def test_frames_leave_no_objects_in_moderngl(backend):
    """Scopes of moderngl would leave 100 bytes each."""
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    own = [tracemalloc.Filter(True, moderngl.__file__)]

    def held() -> int:
        gc.collect()
        found = tracemalloc.take_snapshot().filter_traces(own).statistics("filename")
        return sum(each.size for each in found)

    with fr.Renderer((32, 32), backend=backend) as renderer:
        renderer.render(scene)
        tracemalloc.start()
        try:
            before = held()
            for _ in range(300):
                renderer.render(scene)
            assert (held() - before) / 300 < 100.0
        finally:
            tracemalloc.stop()


def test_renderer_returns_free_memory(backend, coarse_head):
    """Decoding and compiling leave no free memory that malloc_trim could return. The mesh has few
    triangles, because llvmpipe frees about 200 bytes per triangle in every frame."""
    trim = ctypes.CDLL(None).malloc_trim
    scene = fr.Scene(coarse_head)
    with fr.Renderer((256, 256), backend=backend) as renderer:
        for _ in range(3):
            renderer.render(scene)
        before = _resident()
        trim(0)
        assert before - _resident() < 10  # without settle(), 26


class Host:
    """A host program whose OpenGL context has every state set that could affect an image."""

    SETTINGS = (
        *(("glEnable", number) for number, needed in CAPABILITIES.values() if not needed),
        ("glDisable", CAPABILITIES["MULTISAMPLE"][0]),
        ("glScissor", 1, 2, 3, 4),
        ("glViewport", 5, 6, 7, 8),
        ("glDepthFunc", 0x0204),  # greater
        ("glDepthMask", 0),
        ("glColorMask", 0, 1, 0, 1),
        ("glFrontFace", 0x0900),  # clockwise
        ("glCullFace", 0x0404),  # front
        ("glPolygonMode", 0x0408, 0x1B01),  # lines
        ("glClipControl", 0x8CA2, 0x935F),  # upper left, 0 to 1
        ("glBlendFuncSeparate", 1, 0, 0, 1),
        ("glBlendEquationSeparate", 0x8007, 0x800B),  # minimum, reverse subtract
        *(("glPixelStorei", name, 200) for name in (0x0D02, 0x0CF2)),  # row lengths
        ("glPixelStorei", 0x0CF5, 8),
        ("glActiveTexture", 0x84C1),
    )
    UNITS = range(20)

    def __init__(self, backend: Backend) -> None:
        self.context = create_context(backend)
        self.gl = self.context.gl
        self.gl.__enter__()
        self.target = self.gl.framebuffer([self.gl.renderbuffer((64, 64), 4)])
        self.target.clear(*(value / 255 for value in (64, 128, 191, 255)))
        self.uniforms = self.gl.buffer(bytes(16))

    def function(self, name: str, *arguments: Any) -> Any:
        """Return an OpenGL function without a result."""
        address = self.context.loader.load(name)
        return ctypes.CFUNCTYPE(None, *arguments)(address)

    def set_everything(self) -> None:
        self.target.use()
        for unit in self.UNITS:
            self.gl.texture((1, 1), 4, bytes(4)).use(unit)
            self.gl.texture((1, 1), 4, samples=4).use(unit)
            self.gl.sampler(filter=(moderngl.NEAREST, moderngl.NEAREST)).use(unit)
        self.uniforms.bind_to_uniform_block(0)
        for name, *values in self.SETTINGS:
            self.function(name, *[ctypes.c_int] * len(values))(*values)
        self.function("glDepthRange", *[ctypes.c_double] * 2)(1.0, 0.0)

    def state(self) -> dict[tuple[str, int, int], tuple[float, ...]]:
        get = self.function("glGetDoublev", ctypes.c_int, ctypes.c_void_p)
        activate = self.function("glActiveTexture", ctypes.c_int)
        queries = [query for _, _, several, _ in STATE for query in several]
        queries += [(number, 1) for number, _ in CAPABILITIES.values()]
        queries += [(0x84E0, 1)]  # active texture
        state = {}
        for name, count in queries:
            values = (ctypes.c_double * count)()
            get(name, values)
            state["", 0, name] = tuple(values)
        for unit in self.UNITS:
            activate(0x84C0 + unit)
            for name in (0x8069, 0x9104, 0x8919):  # texture, multisample texture, sampler
                values = (ctypes.c_double * 1)()
                get(name, values)
                state["unit", unit, name] = tuple(values)
        activate(int(state["", 0, 0x84E0][0]))
        indexed = self.function("glGetIntegeri_v", *[ctypes.c_int] * 2, ctypes.c_void_p)
        buffer = ctypes.c_int()
        indexed(0x8A28, 0, ctypes.addressof(buffer))  # the uniform buffer of the first block
        state["", 0, 0x8A28] = (buffer.value,)
        return state

    def release(self) -> None:
        self.gl.__exit__(None, None, None)
        self.context.release()


@pytest.fixture
def host(backend: Backend) -> Iterator[Host]:
    host = Host(backend)
    yield host
    host.release()


def every_map() -> fr.Scene:
    """Return a scene with a part that reads every texture that one part can read."""
    mesh = eye(ks=1.0, transmission=0.5)
    maps = {name: fr.Texture.from_image(Image.new("RGB", (4, 4), "red")) for name in MAPS}
    maps["specular_map"] = maps["specular_map"].sampled(("clamp", "clamp"))
    part = replace(mesh.parts[CLEAR], uv=mesh.parts[CLEAR].positions[:, :2])
    material = replace(
        mesh.materials[CLEAR],
        **{**maps, "opacity_map": None, "emissive": (0.1, 0.1, 0.1)},
        **{"second_slope": 2.0, "lobe_weight": 0.5},
    )
    assert not material.packs
    mesh = with_geometry(
        mesh, parts=(*mesh.parts[:CLEAR], part), materials=(*mesh.materials[:CLEAR], material)
    )
    lights = (fr.Light(30.0, 20.0, shadow=True, radius=3.0),)
    return fr.Scene(mesh, lights=lights, environment=fr.Environment(studio()))


@pytest.mark.slow
@pytest.mark.parametrize("scene_of", [lambda: fr.Scene(fr.load_mesh(MINI_HEAD)), every_map])
def test_guest_draws_the_same_and_restores_the_hosts_state(host, scene_of):
    scene = scene_of()
    with fr.Renderer((96, 96), samples=4, backend=host.context.backend) as own:
        expected = own.render(scene).linear
    host.set_everything()
    before = host.state()
    with fr.Renderer((96, 96), samples=4, backend="current") as guest:
        assert host.state() == before
        for _ in range(2):
            np.testing.assert_array_equal(guest.render(scene).linear, expected)
            assert host.state() == before
        guest.gbuffer(scene)
        assert host.state() == before
        at_center = fr.Light(position=tuple(scene.mesh.center))
        with pytest.raises(fr.InputError, match="the mesh's centre"):
            guest.render(replace(scene, lights=(at_center,)))
        assert host.state() == before
    assert host.state() == before
    host.function("glPixelStorei", ctypes.c_int, ctypes.c_int)(0x0D02, 0)
    assert host.target.read(components=4)[:4] == bytes([64, 128, 191, 255])


def drawn_elsewhere(folder: Path, backend: str, **environment: str) -> ImageData:
    """Return the small head, drawn by ``facerender render`` with more environment variables."""
    command = [sys.executable, "-m", "facerender", "render", MINI_HEAD, "-o", folder / "head.exr"]
    subprocess.run(
        [*command, "--size", "96", "--backend", backend],
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
    )
    return read_image(folder / "head.exr")


@pytest.mark.slow
def test_window_system_context_draws_the_same_image(egl, display, tmp_path):
    image = drawn_elsewhere(tmp_path, "native", DISPLAY=display)
    assert compare(fr.render(MINI_HEAD, size=(96, 96), backend=egl), image, block=1e-3)


def test_missing_window_system_is_reported(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    message = r"no OpenGL context \(native: DISPLAY is not set: start an X server, .*xvfb$"
    with pytest.raises(fr.ContextError, match=message):
        fr.Renderer(backend="native")


@pytest.mark.parametrize("index", ["0", "99", "second"])
def test_a_gpu_is_chosen_by_its_index(egl, monkeypatch, index):
    """An index without a GPU is an error: another backend would draw on another device."""
    scene = fr.Scene(fr.load_mesh(MINI_HEAD))
    with fr.Renderer(32, backend=egl) as renderer:
        expected = renderer.render(scene).linear
    monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", index)
    if index == "0":
        with fr.Renderer(32) as renderer:
            assert renderer.context.backend == "egl"
            np.testing.assert_array_equal(renderer.render(scene).linear, expected)
        return
    message = (
        rf"no OpenGL context \(egl: [^;]*{index}[^;]*\); GLCONTEXT_DEVICE_INDEX = {index}: give"
    )
    with pytest.raises(fr.ContextError, match=message):
        fr.Renderer(32)


@pytest.mark.parametrize(
    ("platform", "order"), [("linux", ("egl", "osmesa")), ("win32", ("native",))]
)
def test_auto_uses_the_window_system_without_egl(platform, order):
    code = (
        "import importlib, sys, facerender.drawing.context as c; "
        f"sys.platform = {platform!r}; importlib.reload(c); print(c.AUTO, c.current_context())"
    )
    run = [sys.executable, "-c", code]
    output = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    assert output.strip() == f"{order} None"


@pytest.mark.vulkan
def test_vulkan_software_driver_draws_the_same_image(egl, tmp_path):
    """The driver is Mesa's zink on lavapipe."""
    zink = {"GALLIUM_DRIVER": "zink", "LIBGL_ALWAYS_SOFTWARE": "1"}
    image = drawn_elsewhere(tmp_path, egl, **zink)
    if "zink" not in image.metadata["GL_RENDERER"]:
        missing("no zink or lavapipe: apt-get install mesa-vulkan-drivers")
    assert compare(fr.render(MINI_HEAD, size=(96, 96), backend=egl), image)


@pytest.mark.parametrize("guest", ["egl", pytest.param("osmesa", marks=pytest.mark.osmesa)])
def test_own_context_keeps_that_of_the_host_current(host, head, guest):
    before = host.state()
    fr.render(head, size=(32, 32), samples=1, backend=require_backend(guest))
    assert host.state() == before
    host.target.clear(*[128 / 255] * 4)
    assert host.target.read(components=4)[:4] == bytes([128] * 4)


def test_guest_refuses_another_context(backend, head):
    first, second = create_context(backend), create_context(backend)
    with first.gl:
        guest = fr.Renderer((32, 32), backend="current")
    for use in (guest.render, guest.gbuffer):
        with second.gl, pytest.raises(fr.ContextError, match="is not current in this thread"):
            use(fr.Scene(head))
        with pytest.raises(fr.ContextError, match="is not current in this thread"):
            use(fr.Scene(head))
    with first.gl:
        guest.release()
    first.release()
    second.release()


def test_released_renderer(egl, head):
    with fr.Renderer((32, 32), backend=egl) as renderer:
        renderer.release()
    with pytest.raises(fr.ContextError, match="was released: create a new one"):
        renderer.render(fr.Scene(head))


def test_missing_current_context_is_refused():
    with pytest.raises(fr.ContextError, match="current: no EGL, GLX or OSMesa context is current"):
        create_context("current")


def test_renderer_does_not_keep_meshes_alive(renderer):
    others = len(renderer._resources.parts)
    mesh = fr.load_mesh(MINI_HEAD)
    renderer.render(fr.Scene(mesh))
    variant = mesh.with_material(m=0.2)
    renderer.render(fr.Scene(variant))
    simple = fr.Scene(mesh), fr.Shading(m=0.25, ks=0.5, normal_map=False)
    renderer.render(*simple)
    textures = [*map(id, renderer._resources.textures.values())]
    renderer.render(*simple)
    assert [*map(id, renderer._resources.textures.values())] == textures, "maps are not packed anew"
    assert len(renderer._resources.parts) == others + 1, "variants share their geometry"
    dead = weakref.ref(mesh), weakref.ref(variant), weakref.ref(mesh.parts[0])
    del mesh, variant, simple
    gc.collect()
    assert [reference() for reference in dead] == [None] * 3


def test_maps_of_earlier_frames_are_freed(renderer):
    mesh = fr.load_mesh(MINI_HEAD)
    for level in range(6):
        albedo = fr.Texture.from_array(np.full((8, 8, 3), 40 * level, np.uint8))
        renderer.render(fr.Scene(mesh.with_material(albedo_map=albedo)))
    with renderer.context.drawing() as gl:
        assert gl.gc() < 4, "only objects of the last frame wait to be freed"


@pytest.mark.slow
def test_float_albedo_is_close_to_8_bits(egl, head):
    scene = fr.Scene(head, background=None)
    with fr.Renderer((256, 256), samples=1, backend=egl) as bytes_, \
         fr.Renderer((256, 256), samples=1, backend=egl, float_albedo=True) as floats:  # fmt: skip
        a, b = bytes_.render(scene), floats.render(scene)
    assert b.metadata["float_albedo"] == "True"
    assert block_error(a.linear[..., :3], b.linear[..., :3], b.linear[..., 3]) < 0.015
    assert (a.linear != b.linear).any()


def test_anisotropy_sharpens_maps_at_grazing_angles(egl, tmp_path):
    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, ::8] = 255
    Image.fromarray(stripes).save(tmp_path / "stripes.png")
    mesh = fr.load_mesh(square(tmp_path), albedo=tmp_path / "stripes.png")
    scene = fr.Scene(mesh, fr.Camera(0.0, 85.0))
    contrast = []
    for anisotropy in (1.0, 16.0):
        with fr.Renderer((128, 128), samples=1, backend=egl, anisotropy=anisotropy) as renderer:
            gbuffer = renderer.gbuffer(scene)
        contrast.append(gbuffer.albedo[gbuffer.part >= 0].std())
    assert contrast[1] > 1.5 * contrast[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": (0, 10)}, "size 0 x 10: give 1 to 16384"),
        ({"samples": 65}, "samples = 65: give 1 to 64"),
        ({"anisotropy": 0.5}, "anisotropy = 0.5"),
        ({"backend": "wgl"}, "unknown backend 'wgl'; known: auto, egl"),
    ],
)
def test_invalid_arguments_are_refused(arguments, message):
    with pytest.raises(fr.InputError, match=message):
        fr.Renderer(**arguments)


@pytest.mark.slow
def test_more_samples_than_the_driver_has(egl):
    """The reference is a larger image with one sample per pixel, averaged over blocks."""
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh.with_material(m=0.3, albedo_map=None, normal_map=None))
    images = {}
    for size, samples in ((32, 1), (32, 4), (32, 16), (32, 64), (256, 1)):
        with fr.Renderer((size, size), samples=samples, backend=egl) as renderer:
            images[size, samples] = renderer.render(scene).linear
    fine = images[256, 1].reshape(32, 8, 32, 8, 4).mean(axis=(1, 3))
    error = {key: np.abs(image - fine).mean() for key, image in images.items() if key[0] == 32}
    assert error[32, 64] < 0.7 * error[32, 4] < 0.7 * error[32, 1]
    assert error[32, 64] < error[32, 16] < 0.8 * error[32, 4]


def test_moderngl_keeps_no_default_context(egl, head):
    with fr.Renderer((32, 32), backend=egl) as renderer:
        renderer.render(fr.Scene(head))
    assert moderngl._store.default_context is None


@pytest.fixture(scope="module")
def pair(head):
    """A mesh of two heads: one with m = 0.75, one with a map of m from 0.0001 to 0.36."""
    ramp = Image.fromarray(np.tile(np.linspace(0, 153, 256, dtype=np.uint8), (4, 1)))
    part = head.parts[0]
    other = replace(part, positions=part.positions + [0.2, 0.0, 0.0])
    rough = replace(head.materials[0], roughness_map=None, normal_map=None, m=0.75)
    mapped = replace(rough, roughness_map=fr.Texture(lambda: ramp, "ramp"), m=0.3)
    bounds = head.bounds + [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]
    return with_geometry(head, parts=(part, other), materials=(rough, mapped), bounds=bounds)


def test_lobe_of_each_part_depends_on_its_slopes(transparent, pair):
    low, high = pair.materials[1].slopes
    assert low == pytest.approx(1e-4)
    assert high == pytest.approx(0.36)
    chosen = fr.Shading(lobe="fitted", outside="exact")
    scene = lit(pair, background=None)
    metadata = transparent.render(scene, chosen).metadata
    assert (metadata["lobe"], metadata["lobe of each part"]) == ("fitted", "exact, fitted")
    gbuffer, _, error = compared(transparent, scene, chosen)
    covered = gbuffer.part >= 0
    assert set(gbuffer.part[covered]) == {0, 1}
    # Smaller slopes have larger errors, due to float32 maps and normals; see the shader headers.
    assert error[gbuffer.m[covered] > 0.1].max() < 1e-4


@pytest.mark.memory
def test_released_renderers_free_their_memory(backend, head):
    scene = fr.Scene(head)

    def resident() -> int:
        with fr.Renderer((256, 256), backend=backend) as renderer:
            renderer.render(scene)
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # free memory that malloc retains varies
        return _resident()

    first, last = ([resident() for _ in range(8)] for _ in range(2))
    assert min(last) - min(first) < 24


def test_images_are_reproducible(egl, head):
    scene = fr.Scene(head, SIDE)
    with fr.Renderer((128, 128), backend=egl) as renderer:
        first = renderer.render(scene).linear
        renderer.render(fr.Scene(head))
        np.testing.assert_array_equal(renderer.render(scene).linear, first)
    with fr.Renderer((128, 128), backend=egl) as renderer:
        np.testing.assert_array_equal(renderer.render(scene).linear, first)


def test_a_model_may_call_a_term_twice(egl, head, monkeypatch, tmp_path):
    """The model has two lobes like skin, with slopes m and m/2."""
    shaders = tmp_path / "shaders"
    shutil.copytree(fr.shader_dir(), shaders)
    (shaders / "facerender/two_lobes.glsl").write_text(
        '#include "facerender/cook_torrance.glsl"\n'
        "float two_lobes(vec3 n, vec3 l, vec3 v, float m, float f0, int lobe, int f, int g) {\n"
        "    return 0.7 * fr_cook_torrance_terms(n, l, v, m, f0, lobe, f, g)\n"
        "        + 0.3 * fr_cook_torrance_terms(n, l, v, 0.5 * m, f0, lobe, f, g);\n"
        "}\n"
    )

    def two_lobes(n, l, v, m, f0, /, **terms):
        one, other = (fr.brdf.cook_torrance(n, l, v, x, f0, **terms) for x in (m, 0.5 * m))
        return 0.7 * one + 0.3 * other

    entry = Model(
        name="two-lobes",
        title="Two lobes",
        file="two_lobes",
        call="two_lobes(n, l, v, {m}, f0, {lobe}, {fresnel}, {masking})",
        k=4,
        evaluate=two_lobes,
        factors=True,
        family="physical",
    )
    monkeypatch.setitem(MODELS, "two-lobes", entry)
    monkeypatch.setattr("facerender.glsl.library.shader_dir", lambda: shaders)
    with fr.Renderer((256, 256), samples=1, backend=egl) as renderer:
        for terms in ({}, {"lobe": "d16", "fresnel": "constant", "masking": "none"}):
            shading = fr.Shading("two-lobes", small_slope=True, **terms)
            assert compared(renderer, mixed(head), shading)[2].max() < 1e-4
