"""The renderer against the float64 reference, across backends, and as a host of other hosts."""

from __future__ import annotations

import ctypes
import gc
import resource
from collections.abc import Iterator
from dataclasses import replace

import moderngl
import numpy as np
import pytest

import facerender as fr
from facerender import context, reference
from facerender.context import Backend, create_context
from tests import gates
from tests.conftest import require_backend

SIDE = fr.Camera(azimuth=35.0, elevation=8.0)
SHADINGS = [
    fr.Shading(model, lobe)
    for model in ("cook-torrance", "ward", "ward-printed")
    for lobe in fr.lobes.NAMES
] + [fr.Shading(fresnel="dielectric")]


def lit(mesh: fr.Mesh, **changes) -> fr.Scene:
    """A scene with every kind of light."""
    scene = fr.Scene(mesh, SIDE)
    point = tuple(mesh.center + mesh.radius * np.array([-1.0, 0.8, 1.5]))
    lights = (*scene.lights, fr.Light(irradiance=(1.0, 0.5, 0.2), position=point))
    return replace(scene, lights=lights, **changes)


def worst_error(renderer: fr.Renderer, scene: fr.Scene, shading: fr.Shading) -> float:
    """Largest relative error of the GPU image over every covered pixel; the denominator is
    max(reference, 0.01), where 1 is a white diffuse surface under an irradiance of pi."""
    gbuffer = renderer.gbuffer(scene)
    frame = renderer.render(scene, shading)
    covered = gbuffer.part >= 0
    np.testing.assert_array_equal(covered, frame.linear[..., 3] > 0)
    assert covered.mean() > 0.15
    expected = reference.shade(gbuffer, scene, shading)[covered]
    difference = np.abs(frame.linear[covered][:, :3] - expected)
    assert np.isfinite(frame.linear).all()
    return float((difference / np.maximum(expected, 0.01)).max())


@pytest.fixture(scope="module")
def transparent(backend: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer((512, 512), samples=1, backend=backend) as renderer:
        yield renderer


@pytest.mark.parametrize("shading", SHADINGS, ids=lambda s: f"{s.model}-{s.lobe}-{s.fresnel}")
def test_every_pixel_of_the_head_agrees_with_float64(transparent, head, shading):
    scene = lit(head, background=None)
    assert worst_error(transparent, scene, shading) < 1e-4


@pytest.mark.parametrize("shading", SHADINGS, ids=lambda s: f"{s.model}-{s.lobe}-{s.fresnel}")
def test_every_pixel_of_the_scan_agrees_with_float64(transparent, scan_mesh, shading):
    scene = lit(scan_mesh, background=None)
    assert worst_error(transparent, scene, shading) < 1e-4


def test_the_comparison_sees_a_change_of_a_thousandth(transparent, head):
    scene = lit(head, background=None)
    gbuffer = transparent.gbuffer(scene)
    frame = transparent.render(scene)
    covered = gbuffer.part >= 0
    changed = replace(gbuffer, m=gbuffer.m * np.float32(1.001))
    expected = reference.shade(changed, scene, fr.Shading())[covered]
    difference = np.abs(frame.linear[covered][:, :3] - expected) / np.maximum(expected, 0.01)
    assert difference.max() > 1e-4


@pytest.mark.parametrize("samples", [1, 4])
def test_egl_and_osmesa_draw_the_same_image(egl, scan_mesh, samples):
    osmesa = require_backend("osmesa")
    scene = fr.Scene(scan_mesh, SIDE, background=None)
    frames = []
    for name in (egl, osmesa):
        with fr.Renderer((1024, 1024), samples=samples, backend=name) as renderer:
            frames.append(renderer.render(scene).linear)
    a, b = frames
    assert gates.point(a[..., :3], b[..., :3]) <= 0.05
    assert gates.block(a[..., :3], b[..., :3], b[..., 3]) <= 1e-3


def false_highlights(linear: np.ndarray, expected: np.ndarray) -> float:
    return float((linear - expected).max() / expected.max())


def test_d16_shows_no_false_highlight_at_grazing_angles(renderer, head, monkeypatch):
    """Beyond 49 degrees the base of D16 is negative at m = 0.2, and its power must stay 0."""
    mesh = head.with_material(m=0.2, normal_map=None)
    scene = fr.Scene(mesh, lights=(fr.Light(110.0, 5.0),), ambient=0.0, background=None)
    exact = renderer.render(scene, fr.Shading(), only="specular").linear[..., :3]
    d16 = fr.Shading(lobe="d16")
    assert false_highlights(renderer.render(scene, d16, "specular").linear[..., :3], exact) < 0.02

    # the same without the clamp: the test must be able to see what it forbids
    from facerender import glsl

    text = glsl._read("facerender/lobe/g_power.glsl")
    unclamped = text.replace("max(1.0 - n / float(g) * (1.0 - min(c, 1.0)), 0.0)",
                             "1.0 - n / float(g) * (1.0 - min(c, 1.0))")  # fmt: skip
    assert unclamped != text
    read = glsl._read
    monkeypatch.setattr(
        glsl, "_read", lambda path: unclamped if path.endswith("g_power.glsl") else read(path)
    )
    with fr.Renderer((256, 256), samples=1) as broken:
        linear = broken.render(scene, d16, "specular").linear[..., :3]
    assert false_highlights(linear, exact) > 1.0


def test_only_what_the_scene_needs_is_compiled(head):
    from facerender import renderer

    scene = fr.Scene(head)
    full = renderer._shade_defines(head.parts[0], head.materials[0], scene, fr.Shading(), None)
    assert {"#define ALBEDO_MAP", "#define NORMAL_MAP", "#define AMBIENT"} <= set(full.splitlines())
    plain = head.with_material(normal_map=None, roughness_map=None, occlusion_map=None, ks=0.0)
    bare = renderer._shade_defines(
        plain.parts[0],
        plain.materials[0],
        replace(scene, mesh=plain, ambient=0.0, lights=()),
        fr.Shading(),
        None,
    )
    assert bare.split("\n") == [
        "#define ALBEDO_MAP", "#define UV", "#define DIRECTIONAL_LIGHTS 0",
        "#define POINT_LIGHTS 0", "#define DIFFUSE", "",
    ]  # fmt: skip


def test_specular_and_diffuse_add_up_to_the_image(renderer, head):
    scene = fr.Scene(head, background=None)
    parts = [renderer.render(scene, only=only).linear[..., :3] for only in ("specular", "diffuse")]
    np.testing.assert_allclose(
        sum(parts), renderer.render(scene).linear[..., :3], rtol=1e-5, atol=1e-6
    )


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
    # along the axis, the nearest point of the face and the nape are a head's depth apart
    extent = head.bounds[1, 2] - head.bounds[0, 2]
    assert 0.3 * extent < np.ptp(depth[covered][:, 0]) < extent
    assert (albedo[covered][:, :3] >= 0).all()
    assert (albedo[covered][:, :3] <= 1).all()


def test_gbuffer_of_the_scan_shows_its_own_albedo(renderer, scan_mesh, scan):
    """A texel looked up with the G-buffer's uv is what the GPU sampled, up to filtering."""
    from PIL import Image

    from facerender.image import srgb_to_linear

    gbuffer = renderer.gbuffer(fr.Scene(scan_mesh))
    covered = gbuffer.part >= 0
    texels = np.asarray(Image.open(scan / "Map-COL.jpg").convert("RGB").resize((256, 256))) / 255.0
    u, v = np.moveaxis(gbuffer.uv[covered], -1, 0)
    looked_up = srgb_to_linear(texels)[((1 - v) * 255.99).astype(int), (u * 255.99).astype(int)]
    assert np.abs(looked_up - gbuffer.albedo[covered]).mean() < 0.02


def test_normal_map_tilts_towards_its_green_and_red(renderer, tmp_path):
    """On a square in the plane z = 0 with u to the right and v up, red tilts to +x, green to +y;
    so it must also when the square is seen from behind, or its texture is mirrored."""
    from PIL import Image

    Image.new("RGB", (4, 4), (191, 191, 218)).save(tmp_path / "tilted.png")
    for name, u, faces in (
        ("plain", (0, 1, 1, 0), "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"),
        ("mirrored", (1, 0, 0, 1), "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"),
    ):
        corners = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
        uv = "".join(f"vt {x} {y}\n" for x, y in zip(u, (0, 0, 1, 1), strict=True))
        (tmp_path / f"{name}.obj").write_text(corners + uv + faces)
        mesh = fr.load_mesh(tmp_path / f"{name}.obj", normal_map=tmp_path / "tilted.png")
        for azimuth, facing in ((0, 1), (180, -1)):
            gbuffer = renderer.gbuffer(fr.Scene(mesh, fr.Camera(azimuth=azimuth)))
            normal = gbuffer.normal[gbuffer.part >= 0].mean(axis=0)
            expected = np.array([0.5 if name == "plain" else -0.5, 0.5, 0.7 * facing])
            np.testing.assert_allclose(normal, expected, atol=0.03)


def test_point_light_gives_its_irradiance_at_the_centre(renderer, tmp_path):
    (tmp_path / "square.obj").write_text(
        "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n"
    )
    mesh = fr.load_mesh(tmp_path / "square.obj").with_material(albedo=1.0, ks=0.0)
    light = fr.Light(irradiance=np.pi, position=(0.0, 0.0, 5.0))
    frame = renderer.render(fr.Scene(mesh, lights=(light,), ambient=0.0))
    # ambient and specular are off: albedo / pi * irradiance = 1 at the centre, less at the corner
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


def test_every_orbit_frames_the_whole_mesh(renderer, head, scan_mesh):
    for mesh in (head, scan_mesh):
        for camera in (SIDE, fr.Camera(90.0), fr.Camera(180.0, -30.0), fr.Camera(20.0, 90.0)):
            covered = renderer.gbuffer(fr.Scene(mesh, camera)).part >= 0
            assert covered.any()
            assert not covered[[0, -1], :].any()
            assert not covered[:, [0, -1]].any()


def test_images_are_the_same_again(egl, head):
    scene = fr.Scene(head, SIDE)
    with fr.Renderer((128, 128), backend=egl) as renderer:
        first = renderer.render(scene).linear
        renderer.render(fr.Scene(head))
        np.testing.assert_array_equal(renderer.render(scene).linear, first)
    with fr.Renderer((128, 128), backend=egl) as renderer:
        np.testing.assert_array_equal(renderer.render(scene).linear, first)


def test_renderers_side_by_side(egl, head):
    osmesa = require_backend("osmesa")
    scene = fr.Scene(head)
    renderers = [fr.Renderer((96, 96), backend=name) for name in (egl, osmesa, egl)]
    frames = [renderer.render(scene).linear for renderer in renderers]
    renderers[0].release()
    for renderer, frame in zip(renderers[1:], frames[1:], strict=True):
        np.testing.assert_array_equal(renderer.render(scene).linear, frame)
        renderer.release()


def test_renderers_leave_nothing_behind(backend, head):
    scene = fr.Scene(head)

    def use(count: int) -> int:
        for _ in range(count):
            with fr.Renderer((256, 256), backend=backend) as renderer:
                renderer.render(scene)
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kilobytes

    warm = use(5)
    assert use(15) - warm < 30_000


def host_state(host) -> dict[str, object]:
    """What a host may have set: capabilities, bindings, masks, viewport."""
    names = {
        "viewport": (0x0BA2, 4), "scissor": (0x0C10, 4), "framebuffer": (0x8CA6, 1),
        "program": (0x8B8D, 1), "vertex array": (0x85B5, 1), "active texture": (0x84E0, 1),
        "texture": (0x8069, 1), "depth function": (0x0B74, 1), "depth mask": (0x0B72, 1),
        "color mask": (0x0C23, 4), "polygon mode": (0x0B40, 1), "front face": (0x0B46, 1),
        "unpack alignment": (0x0CF5, 1), "pack alignment": (0x0D05, 1),
    }  # fmt: skip
    get = host.function("glGetIntegerv", ctypes.c_int, ctypes.c_void_p)
    enabled = host.function("glIsEnabled", ctypes.c_int, result=ctypes.c_ubyte)
    state: dict[str, object] = {}
    for name, (number, count) in names.items():
        values = (ctypes.c_int * count)()
        get(number, values)
        state[name] = tuple(values)
    for name, number in context._CAPABILITIES.items():
        state[name] = enabled(number)
    return state


def test_host_context_is_used_and_left_as_it_was(backend, head):
    """A host with everything set that could spoil the image gets the same image, and all back."""
    host = create_context(backend)
    try:
        mine = host.gl.framebuffer([host.gl.renderbuffer((64, 64), 4)])
        mine.use()
        mine.clear(0.25, 0.5, 0.75, 1.0)
        host.gl.texture((1, 1), 4, bytes(4)).use(1)
        call = {
            "glEnable": [(number,) for number in context._CAPABILITIES.values()],
            "glScissor": [(1, 2, 3, 4)], "glViewport": [(5, 6, 7, 8)], "glDepthFunc": [(0x0204,)],
            "glDepthMask": [(0,)], "glColorMask": [(0, 1, 0, 1)], "glFrontFace": [(0x0900,)],
            "glPolygonMode": [(0x0408, 0x1B01)], "glPixelStorei": [(0x0CF5, 8), (0x0D05, 2)],
            "glActiveTexture": [(0x84C1,)],
        }  # fmt: skip
        for name, calls in call.items():
            for arguments in calls:
                host.function(name, *[ctypes.c_int] * len(arguments))(*arguments)
        before = host_state(host)
        with fr.Renderer((96, 96), backend="current") as guest:
            assert guest.context.backend == "current"
            inside = guest.render(fr.Scene(head)).linear
            assert host_state(host) == before
        assert host_state(host) == before
        assert mine.read(components=4)[:4] == bytes([64, 128, 191, 255])
    finally:
        host.release()
    with fr.Renderer((96, 96), backend=backend) as own:
        np.testing.assert_array_equal(own.render(fr.Scene(head)).linear, inside)


def test_no_context_is_current():
    with pytest.raises(fr.ContextError, match="current: no EGL, GLX or OSMesa context is current"):
        create_context("current")


def test_float_albedo_is_close_to_the_bytes(egl, head):
    scene = fr.Scene(head, background=None)
    with fr.Renderer((256, 256), samples=1, backend=egl) as bytes_, \
         fr.Renderer((256, 256), samples=1, backend=egl, float_albedo=True) as floats:  # fmt: skip
        a, b = bytes_.render(scene), floats.render(scene)
    assert b.metadata["albedo"] == "RGBA16F"
    assert gates.block(a.linear[..., :3], b.linear[..., :3], b.linear[..., 3]) < 0.01
    assert (a.linear != b.linear).any()


def test_anisotropy_sharpens_what_is_seen_at_a_grazing_angle(egl, tmp_path):
    from PIL import Image

    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, ::8] = 255
    Image.fromarray(stripes).save(tmp_path / "stripes.png")
    (tmp_path / "square.obj").write_text(
        "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    mesh = fr.load_mesh(tmp_path / "square.obj", albedo=tmp_path / "stripes.png")
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
        ({"size": (10, 100000)}, "size 10 x 100000"),
        ({"samples": 0}, "samples = 0"),
        ({"anisotropy": 0.5}, "anisotropy = 0.5"),
        ({"backend": "wgl"}, "unknown backend 'wgl'; known: auto, egl"),
    ],
)
def test_refused_arguments(arguments, message):
    with pytest.raises(fr.InputError, match=message):
        fr.Renderer(**arguments)


def test_more_samples_than_the_driver_has(egl):
    with pytest.raises(fr.ContextError, match=r"samples = 64: .* offers at most"):
        fr.Renderer((64, 64), samples=64, backend=egl)


def test_slope_beyond_the_lobe_is_refused_in_maps_too(renderer, head):
    wide = head.with_material(m=2.0)
    with pytest.raises(fr.InputError, match=r"outside the domain of lobe d16 .* use"):
        renderer.render(fr.Scene(wide), fr.Shading(lobe="d16"))
    assert np.isfinite(renderer.render(fr.Scene(wide), fr.Shading()).linear).all()


def test_render_takes_a_mesh_or_nothing(egl, head):
    frame = fr.render(head, m=0.25, size=(64, 48), samples=1, backend=egl)
    assert frame.linear.shape == (48, 64, 4)
    assert frame.linear.dtype == np.float32
    assert frame.linear.flags.c_contiguous
    assert "llvmpipe" in frame.metadata["GL_RENDERER"] or frame.metadata["GL_RENDERER"]
    default = fr.render(size=(64, 48), samples=1, m=0.25, backend=egl)
    np.testing.assert_array_equal(default.linear, frame.linear)


def test_moderngl_is_not_left_with_our_context_as_its_default(egl, head):
    with fr.Renderer((32, 32), backend=egl) as renderer:
        renderer.render(fr.Scene(head))
    assert moderngl._store.default_context is None
