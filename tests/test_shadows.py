"""Tests shadow maps: against ray tracing and geometry, and that they are redrawn only after a
change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import facerender as fr
from facerender.drawing.compiled import CompiledFrame
from facerender.drawing.context import create_context
from facerender.drawing.maps import MAX_SHADOWS
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part
from facerender.scene.light import LIGHTS
from tests.awkward_files import MINI_HEAD
from tests.markdown import code
from tests.settings import parse_light
from tests.test_alpha import quad
from tests.test_reference import key, shadows
from tests.verification.evaluate import CORNERS, vertex_shader
from tests.verification.shadows import edge_error, shadow_error

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def renderer(egl):
    with fr.Renderer((256, 256), samples=1, backend=egl, float_albedo=True) as renderer:
        yield renderer


# Bounds of the mean error, relative to the light that arrives.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("radius", "bound", "distance"),
    [
        (0.0, 0.005, None),
        (2.0, 0.005, None),
        (6.0, 0.01, 2.5),
        (10.0, 0.015, None),
        pytest.param(0.25, 0.005, 2.5, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name", ["head", pytest.param("scan_mesh", marks=pytest.mark.slow)])
def test_shadows_agree_with_ray_tracing(renderer, name, radius, bound, distance, request):
    mesh = request.getfixturevalue(name)
    scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6, frame="all"))
    found = shadow_error(renderer, scene, key(mesh, radius, distance), stride=5)
    assert found.mean <= bound
    assert found.wrong <= 0.003
    assert found.without > 4.0 * found.mean


@pytest.mark.slow
@pytest.mark.parametrize(("frame", "bound"), [("all", 0.06), ("face", 0.08)])
def test_hard_shadow_of_the_chin_has_a_smooth_edge(egl, head, frame, bound):
    """The bound is half of the error of bilinear filtering with an offset of 2.5 texels."""
    light = fr.Light(-20.0, 50.0, 3.0)
    scene = fr.Scene(head, fr.Camera(-20.0, frame=frame))
    with fr.Renderer((700, 700), samples=1, backend=egl) as renderer:
        assert edge_error(renderer, scene, light, -0.8, -0.38) <= bound


@pytest.mark.parametrize("radius", [0.0, 4.0])
def test_terminator_does_not_show_the_triangles(egl, radius):
    """A sphere of 80 triangles hides no part of a light above its horizon."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    part = Part(ball.vertices, ball.vertices.copy(), ball.faces.astype(np.uint32))
    bounds = np.array([(-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)])
    mesh = fr.Mesh(Geometry("ball", (part,), bounds, 1.0, np.array([(1.0, 1.0)])), (fr.Material(),))
    light = fr.Light(-80.0, 10.0, radius=radius)
    with fr.Renderer((256, 256), samples=1, backend=egl) as renderer:
        gbuffer = renderer.gbuffer(fr.Scene(mesh, lights=(light,)), fr.Shading())
    risen = gbuffer.normal @ light.direction > np.sin(np.radians(radius)) + 0.02
    seen = gbuffer.visibility[(gbuffer.part >= 0) & risen]
    assert len(seen) > 4000
    assert seen.min() > 0.9


@pytest.mark.first_case
@pytest.mark.parametrize("radius", [4.0, 10.0])
@pytest.mark.parametrize("azimuth", [-90.0, 0.0, 90.0])
@pytest.mark.parametrize("name", ["head", pytest.param("scan_mesh", marks=pytest.mark.slow)])
def test_folds_have_no_dots(egl, name, azimuth, radius, request):
    """Few pixels, also in the folds of the ears, differ from most of their neighbours."""
    scene = fr.Scene(request.getfixturevalue(name), fr.Camera(azimuth))
    lights = tuple(replace(light, radius=radius) for light in scene.lights)
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        gbuffer = renderer.gbuffer(replace(scene, lights=lights), fr.Shading(normal_map=False))
    for number, light in enumerate(lights):
        lit = (gbuffer.part >= 0) & (gbuffer.normal @ light.direction > 0.1)
        seen = gbuffer.visibility[..., number]
        around = [np.roll(seen, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        inside = [np.roll(lit, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        dots = (np.abs(seen - np.median(around, axis=0)) > 0.5) & np.all(inside, axis=0)
        assert dots.sum() <= 2e-4 * lit.sum() + 5


def dots(renderer, mesh, light, azimuth, samples):
    """Return the RMS difference of a shadow from its 3 x 3 median within the penumbra, in levels of
    255. Real edges, such as eyelids, count too."""
    from scipy.ndimage import median_filter

    lit, free = (
        renderer.render(
            fr.Scene(mesh, fr.Camera(azimuth), (replace(light, shadow=shadow),), 0.0),
            samples=samples,
        ).linear
        for shadow in (True, False)
    )
    seen = lit[..., :3].mean(axis=-1) / np.maximum(free[..., :3].mean(axis=-1), 1e-6)
    covered = (free[..., 3] > 0.999) & (free[..., :3].mean(axis=-1) > 0.02)
    smooth = median_filter(np.where(covered, seen, 0.0), 3)
    penumbra = median_filter(covered, 3) & covered & (smooth > 0.05) & (smooth < 0.95)
    return 255.0 * float(np.sqrt(np.mean((seen - smooth)[penumbra] ** 2)))


@pytest.mark.parametrize(
    ("light", "azimuth", "bound"),
    [
        (fr.Light(1.27, 63.75, 3.0, radius=7.7), 0.0, 13.4),
        (fr.Light(-135.0, 25.0, 3.0, radius=12.0), -90.0, 16.1),
    ],
    ids=["neck", "ear"],
)
def test_samples_average_the_noise_of_soft_shadows(renderer, head, light, azimuth, bound):
    few, many = (dots(renderer, head, light, azimuth, samples) for samples in (4, 16))
    assert few < bound  # 0.6 of the noise of 8 samples in the search and 12 in the mean
    assert many < 0.65 * few


def test_maps_are_drawn_again_when_something_moves(renderer, monkeypatch):
    head, drawn = fr.load_mesh(MINI_HEAD), []
    replay = CompiledFrame._replay

    def count(self, step, *others):
        drawn.extend(draw.program.fragment for draw in step.source.draws)
        replay(self, step, *others)

    monkeypatch.setattr(CompiledFrame, "_replay", count)

    def maps(scene: fr.Scene, shading: fr.Shading = fr.Shading()) -> int:
        drawn.clear()
        renderer.render(scene, shading)
        return drawn.count("shadow_map.frag")

    scene = shadows(head)
    assert maps(scene) == 4
    assert maps(replace(scene, camera=fr.Camera(60.0))) == 0
    assert maps(replace(scene, lights=(key(head, 0.0, None), *scene.lights[1:]))) == 4
    assert maps(scene, fr.Shading(shadow_lights=[2])) == 1
    assert maps(scene, fr.Shading(shadow_lights=[])) == 0
    assert maps(replace(scene, mesh=head.with_material(m=0.2)), fr.Shading(shadow_lights=[2])) == 0
    other = fr.load_mesh(MINI_HEAD)  # has other part objects
    assert maps(replace(scene, mesh=other), fr.Shading(shadow_lights=[2])) == 1


@pytest.mark.parametrize("distance", [None, 3.0])
def test_width_of_the_penumbra_agrees_with_geometry(egl, distance):
    """A square of side 0.4 at z = 0.4 casts a shadow of an area light on a wall at z = -0.4. At the
    middle of the shadow's edge, half of the light is visible."""
    bounds = np.array([(-0.8, -0.8, -0.4), (0.8, 0.8, 0.4)])
    parts = (quad(-0.4, 0.8), quad(0.4, 0.2))
    mesh = fr.Mesh(
        Geometry("wall", parts, bounds, 1.2, np.array([(0.8, 0.4)])), (fr.Material(),) * 2
    )
    radius = 8.0
    light = fr.Light(0.0, 0.0, radius=radius, shadow=True)
    edge, width = 0.2, 2.0 * 0.8 * np.tan(np.radians(radius))
    if distance is not None:
        z = 1.2 * distance
        light = replace(light, azimuth=0.0, elevation=0.0, position=(0.0, 0.0, z))
        edge = 0.2 * (z + 0.4) / (z - 0.4)
        width = 2.0 * z * np.tan(np.radians(radius)) * 0.8 / (z - 0.4)
    camera = fr.Camera(position=(1.5, 0.0, 0.5), target=(0.3, 0.0, -0.4))
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        gbuffer = renderer.gbuffer(fr.Scene(mesh, camera, (light,)))
    position = gbuffer.position
    near = (gbuffer.part == 0) & (np.abs(position[..., 1]) < 0.02)
    x, seen = position[near][:, 0], gbuffer.visibility[near][:, 0]
    middle = seen[np.abs(x - edge) < 0.01]
    assert abs(middle.mean() - 0.5) < 0.06
    half = 0.5 * width
    assert (seen[x > edge + 1.15 * half] == 1.0).all()
    assert (seen[(x > 0.05) & (x < edge - 1.15 * half)] == 0.0).all()
    across = np.clip((x - edge) / half, -1.0, 1.0)
    visible = 1.0 - (np.arccos(across) - across * np.sqrt(1.0 - across**2)) / np.pi
    inside = np.abs(across) < 1.0
    assert np.abs(seen - visible)[inside].mean() < 0.05


def test_invalid_shadows_are_refused(renderer, head):
    with pytest.raises(fr.InputError, match="too near to cast a shadow"):
        renderer.render(fr.Scene(head, lights=(key(head, 0.0, 0.9),)))
    with pytest.raises(fr.InputError, match=f"17 lights cast shadows: at most {MAX_SHADOWS}"):
        renderer.render(fr.Scene(head, lights=(fr.Light(shadow=True),) * 17))
    with pytest.raises(fr.InputError, match="light shadow = 1: give true or false"):
        fr.Light(shadow=1)


def test_shadow_option_of_lights():
    assert parse_light("key,no-shadow") == replace(LIGHTS["key"], shadow=False)
    assert parse_light("key,radius=2") == replace(LIGHTS["key"], radius=2.0)
    light = parse_light("10,20,2,radius=3,no-shadow")
    assert (light.azimuth, light.radius, light.shadow) == (10.0, 3.0, False)
    assert not parse_light("point:1,2,3,no-shadow,radius=1").shadow
    assert parse_light("10,20") == fr.Light(10.0, 20.0, radius=0.0, shadow=True)
    for text in ("key,no-shadow,no-shadow", "key,shadows", "key,radius=1,radius=2", "no-shadow"):
        with pytest.raises(fr.InputError, match="unknown light"):
            parse_light(text)


def test_visibility_view(renderer, head):
    scene = shadows(head)
    frame = renderer.render(scene, only="visibility")
    gbuffer = renderer.gbuffer(scene)
    covered = gbuffer.part >= 0
    np.testing.assert_array_equal(frame.linear[covered][:, 1], gbuffer.visibility[covered][:, 0])
    assert not frame.linear[~covered].any()


RECIPE = """#version 330 core
{include}
uniform vec3 centre, n, across, along;
uniform mat3 axes;
uniform float radius, size;
uniform sampler2D map;
out float seen;
void main() {{
    vec2 at = 0.7 * (gl_FragCoord.xy / 64.0 - 1.0);  // inside the sphere
    vec3 position = centre + size * (at.x * across + at.y * along);
    {body}
    seen = visible;
}}
"""


def test_recipe_of_the_guide_agrees_with_rays(egl):
    """The recipe of docs/shaders.md for a square over a plane that is tilted to the light."""
    page = (ROOT / "docs/shaders.md").read_text(encoding="utf-8")
    (recipe,) = (block for block in code(page, "glsl") if "fr_shadow_disc" in block)
    include, body = recipe.split("\n\n", 1)
    source = fr.resolve_includes(RECIPE.format(include=include, body=body))
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turned = trimesh.transformations.rotation_matrix(0.6, (0.8, -0.6, 0.0))[:3, :3]
    across, along, n = (axes @ turned).T
    centre, size, radius, height, side = np.array([5.0, -2.0, 1.0]), 3.0, 0.1, 0.5, 0.4
    unit = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)]) @ [across, along]
    squares = (side * unit + height * n, unit)
    context = create_context(egl)
    with context.drawing() as gl:
        depth = gl.program(
            "#version 330 core\nin vec3 q; out float z;"
            "void main() { z = q.z; gl_Position = vec4(q.xy, -q.z, 1.0); }",
            "#version 330 core\nin float z; out float color; void main() { color = z; }",
        )
        map_ = gl.texture((1024, 1024), 1, dtype="f4")
        gl.framebuffer(map_, gl.depth_renderbuffer((1024, 1024))).use()
        gl.enable(gl.DEPTH_TEST)
        gl.clear(-1e30)
        for square in squares:
            q = gl.buffer((square @ axes).astype("f4"))
            gl.vertex_array(depth, [(q, "3f", "q")]).render(gl.TRIANGLE_STRIP)
        gl.disable(gl.DEPTH_TEST)
        image = gl.texture((128, 128), 1, dtype="f4")
        gl.framebuffer(image).use()
        program = gl.program(vertex_shader("330 core"), source)
        values = {"centre": centre, "n": n, "across": across, "along": along, "axes": axes.T}
        for name, value in (values | {"size": size, "radius": radius}).items():
            program[name] = value if np.ndim(value) == 0 else tuple(np.ravel(value))
        map_.use(0)
        gl.vertex_array(program, [(gl.buffer(CORNERS), "2f", "corner")]).render()
        seen = np.frombuffer(image.read(), "f4").reshape(128, 128)
    context.release()
    spread = np.sqrt((np.arange(300) + 0.5) / 300) * np.tan(radius)
    turn = 2.4 * np.arange(300)
    rays = axes @ [spread * np.cos(turn), spread * np.sin(turn), np.ones(300)]
    rays = rays * height / (n @ rays)
    at = 0.7 * ((np.arange(128)[:, None] + 0.5) / 64.0 - 1.0)
    x, y = np.abs(at + across @ rays) < side, np.abs(at + along @ rays) < side
    hit = y[:, None] & x
    apart = (seen - 1.0 + hit.mean(axis=-1)).reshape(16, 8, 16, 8).mean(axis=(1, 3))
    assert hit.mean() > 0.1
    assert np.abs(apart).max() < 0.03
