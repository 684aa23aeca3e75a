"""Tests shadow maps: against ray tracing and geometry, and that they are redrawn only after a
change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing.passes.shadow import MOST
from facerender.scenes.light import light_space, parse_light
from facerender.scenes.mesh import Part
from tests.awkward_files import MINI_HEAD
from tests.test_reference import key, shadows
from tests.verification.shadows import shadow_error


@pytest.fixture(scope="module")
def renderer(egl):
    with fr.Renderer((128, 128), samples=1, backend=egl, float_albedo=True) as renderer:
        yield renderer


# Bounds of the mean error, relative to the light that arrives.
@pytest.mark.parametrize(
    ("radius", "bound", "distance"),
    [
        (0.0, 0.005, None),
        (0.25, 0.005, 2.5),
        (2.0, 0.005, None),
        (6.0, 0.02, 2.5),
        pytest.param(0.0, 0.005, 2.5, marks=pytest.mark.slow),
        pytest.param(0.25, 0.005, None, marks=pytest.mark.slow),
        pytest.param(2.0, 0.005, 2.5, marks=pytest.mark.slow),
        pytest.param(6.0, 0.02, None, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name", ["head", pytest.param("scan_mesh", marks=pytest.mark.slow)])
def test_shadows_agree_with_ray_tracing(renderer, name, radius, bound, distance, request):
    mesh = request.getfixturevalue(name)
    scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6, frame="all"))
    found = shadow_error(renderer, scene, key(mesh, radius, distance), 64 if radius else 1)
    assert found.mean <= bound
    assert found.wrong <= 0.003
    assert found.without > 4.0 * found.mean


def test_maps_are_drawn_again_when_something_moves(renderer, monkeypatch):
    head, drawn = fr.load_mesh(MINI_HEAD), []
    draw = type(renderer._resources)._draw

    def count(self, one, *others):
        drawn.append(one.program.fragment)
        draw(self, one, *others)

    monkeypatch.setattr(type(renderer._resources), "_draw", count)

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


def square(z: float, half: float) -> Part:
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    normals = np.tile((0.0, 0.0, 1.0), (4, 1))
    return Part(np.array(corners), normals, faces)


@pytest.mark.parametrize("distance", [None, 3.0])
def test_width_of_the_penumbra_agrees_with_geometry(egl, distance):
    """A square of side 0.4 at z = 0.4 casts a shadow of an area light on a wall at z = -0.4. At the
    middle of the shadow's edge, half of the light is visible."""
    bounds = np.array([(-0.8, -0.8, -0.4), (0.8, 0.8, 0.4)])
    parts = (square(-0.4, 0.8), square(0.4, 0.2))
    mesh = fr.Mesh("wall", parts, (fr.Material(),) * 2, bounds, 1.2, np.array([(0.8, 0.4)]))
    radius = 8.0
    light = fr.Light(0.0, 0.0, radius=radius, shadow=True)
    edge, width = 0.2, 2.0 * 0.8 * np.tan(np.radians(radius))
    if distance is not None:
        z = 1.2 * distance
        light = replace(light, position=(0.0, 0.0, z))
        edge = 0.2 * (z + 0.4) / (z - 0.4)
        width = 2.0 * z * np.tan(np.radians(radius)) * 0.8 / (z - 0.4)
    camera = fr.Camera(position=(1.5, 0.0, 0.5), target=(0.3, 0.0, -0.4))
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        gbuffer = renderer.gbuffer(fr.Scene(mesh, camera, (light,)))
    position = gbuffer.position * 1.2
    near = (gbuffer.part == 0) & (np.abs(position[..., 1]) < 0.02)
    x, seen = position[near][:, 0], gbuffer.visibility[near][:, 0]
    middle = seen[np.abs(x - edge) < 0.01]
    assert abs(middle.mean() - 0.5) < 0.06
    half = 0.5 * width
    assert (seen[x > edge + 1.15 * half] == 1.0).all()
    assert (seen[(x > 0.05) & (x < edge - 1.15 * half)] == 0.0).all()
    inside = seen[np.abs(x - edge) < 0.8 * half]
    assert ((inside > 0.0) & (inside < 1.0)).mean() > 0.9


def test_light_space_keeps_the_sphere_on_the_map(head):
    """The unit sphere stays within [-1, 1], and z increases towards the light up to ``top``."""
    random = np.random.default_rng(5).normal(size=(4000, 3))
    sphere = random / np.linalg.norm(random, axis=1, keepdims=True)
    for distance in (None, 1.06, 1.5, 30.0):
        space = light_space(key(head, 0.0, distance), head)
        place = np.hstack([sphere, np.ones((len(sphere), 1))]) @ space.matrix
        place = place[:, :3] / place[:, 3:]
        assert np.abs(place[:, :2]).max() <= 1.0 + 1e-9
        assert np.abs(place[:, :2]).max() > 0.97
        assert place[:, 2].max() <= space.top * (1.0 + 1e-9)


def test_invalid_shadows_are_refused(renderer, head):
    with pytest.raises(fr.InputError, match="too near to cast a shadow"):
        renderer.render(fr.Scene(head, lights=(key(head, 0.0, 0.9),)))
    with pytest.raises(fr.InputError, match=f"17 lights cast shadows: at most {MOST}"):
        renderer.render(fr.Scene(head, lights=(fr.Light(shadow=True),) * 17))
    with pytest.raises(fr.InputError, match="light shadow = 1: give true or false"):
        fr.Light(shadow=1)
    with pytest.raises(fr.InputError, match="shadow_lights names light 3: the scene has 3"):
        renderer.render(fr.Scene(head), fr.Shading(shadow_lights=[3]))


def test_shadow_option_of_lights():
    assert parse_light("key,shadow") == replace(fr.scenes.light.LIGHTS["key"], shadow=True)
    light = parse_light("10,20,2,radius=3,shadow")
    assert (light.azimuth, light.radius, light.shadow) == (10.0, 3.0, True)
    assert parse_light("point:1,2,3,shadow,radius=1").shadow
    for text in ("key,shadow,shadow", "key,shadows", "key,radius=1,radius=2", "shadow"):
        with pytest.raises(fr.InputError, match="unknown light"):
            parse_light(text)


def test_visibility_view(renderer, head):
    scene = shadows(head)
    frame = renderer.render(scene, only="visibility")
    gbuffer = renderer.gbuffer(scene)
    covered = gbuffer.part >= 0
    np.testing.assert_array_equal(frame.linear[covered][:, 1], gbuffer.visibility[covered][:, 0])
    assert not frame.linear[~covered].any()
