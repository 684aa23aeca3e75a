"""Tests cameras, lights, materials and scene files."""

from __future__ import annotations

import math
import tomllib
from contextlib import suppress

import numpy as np
import pytest

import facerender as fr
from facerender.scene.detail import Planned
from facerender.scene.job import load_scene
from facerender.scene.light import LIGHTS
from facerender.scene.view import view_of
from tests.settings import parse_light


def project(scene: fr.Scene, point, aspect=1.0):
    """Return the image coordinates of a point in [-1, 1], x to the right and y upwards."""
    view = view_of(scene, aspect)
    clip = np.array([*scene.mesh.normalised(point), 1.0]) @ view.matrix
    return np.array([clip[0], -clip[1]]) / clip[3]


def test_camera_turns_as_documented(head):
    center, offset = head.center, 0.05
    right = center + [offset, 0, 0]  # the subject's left
    nose = center + [0, 0, offset]
    assert project(fr.Scene(head), right)[0] > 0.01
    assert project(fr.Scene(head, fr.Camera(90.0)), nose)[0] < -0.01
    assert project(fr.Scene(head, fr.Camera(elevation=60.0)), nose)[1] < -0.01
    above = fr.Scene(head, fr.Camera(elevation=90.0))
    assert project(above, nose)[1] < -0.01  # the face looks down the image
    assert project(above, right)[0] > 0.01


def test_zoom_and_target(head):
    point = head.center + [0.02, 0.0, 0.0]
    at_one = project(fr.Scene(head), point)[0]
    assert project(fr.Scene(head, fr.Camera(zoom=2.0)), point)[0] > 1.9 * at_one
    target = tuple(head.center + [0.0, 0.05, 0.0])
    assert project(fr.Scene(head, fr.Camera(target=target)), target) == pytest.approx([0, 0])


def test_camera_position_is_in_units_of_the_mesh(head):
    eye = tuple(head.center + [0.0, 0.0, 1.0])
    view = view_of(fr.Scene(head, fr.Camera(position=eye)), 1.0)
    assert view.position * head.radius == pytest.approx([0.0, 0.0, 1.0])
    # A point 10 cm to the side at a distance of 1 m, with a field of view of 25 degrees.
    side = project(fr.Scene(head, fr.Camera(position=eye)), head.center + [0.1, 0, 0])
    assert side[0] == pytest.approx(0.1 / math.tan(math.radians(12.5)))


def test_frustum_of_a_camera_fills_the_clip_space(head):
    rng = np.random.default_rng(2)
    for _ in range(20):
        camera = fr.Camera(
            position=tuple(head.to_mesh_space(rng.normal(0.0, 3.0, 3))),
            target=tuple(head.to_mesh_space(rng.normal(0.0, 0.3, 3))),
            fov=float(rng.uniform(5.0, 120.0)),
        )
        aspect = float(rng.uniform(0.4, 2.5))
        view = view_of(fr.Scene(head, camera), aspect)
        right = np.cross(view.forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, view.forward)
        half = math.tan(math.radians(camera.fov) / 2.0)
        for x, y in ((0, 0), (1, 1), (-1, 0.5), (0.3, -1)):
            ray = view.forward + half * (x * aspect * right + y * up)
            far = max(1.0 - view.position @ view.forward, 0.02)  # far side of the unit sphere
            near = max(far - 2.0, 1e-3 * far)
            for depth, z in ((near, -1.0), (far, 1.0)):
                clip = np.array([*(view.position + depth * ray), 1.0]) @ view.matrix
                assert clip == pytest.approx(depth * np.array([x, -y, z, 1.0]), abs=1e-9)


def test_camera_at_its_target_is_refused(head):
    scene = fr.Scene(head, fr.Camera(position=tuple(head.center)))
    with pytest.raises(fr.InputError, match="is at its target"):
        view_of(scene, 1.0)


@pytest.mark.parametrize(
    ("text", "light"),
    [
        ("key", LIGHTS["key"]),
        ("30,45", fr.Light(30.0, 45.0)),
        ("-30,45,2.5", fr.Light(-30.0, 45.0, 2.5)),
        ("point:1,2,3,0.5", fr.Light(irradiance=0.5, position=(1.0, 2.0, 3.0))),
        ("30,45,3,2,1", fr.Light(30.0, 45.0, (3.0, 2.0, 1.0))),
    ],
)
def test_lights_from_text(text, light):
    assert parse_light(text) == light


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fr.Shading("ward", fresnel="dielectric"), "ward has no Fresnel term"),
        (lambda: fr.Shading("ward", masking="none"), "ward has no masking term: leave 'none' out"),
        (
            lambda: fr.Shading(masking="smith"),
            "unknown masking term 'smith'; known: v-cavity, kelemen, none",
        ),
    ],
)
def test_values_outside_their_domain(make, message):
    with pytest.raises(fr.InputError, match=message):
        make()


def test_scene_file(tmp_path):
    (tmp_path / "scene.toml").write_text(
        'ambient = 0.2\nbackground = "none"\n'
        'lights = ["key", {azimuth = 10, irradiance = [1, 2, 3]}]\n'
        "[camera]\nazimuth = 40\nzoom = 1.5\n[material]\nm = 0.25\n"
        "[planned]\nsizes = [[512, 512], [1024, 1024]]\nsamples = 4\n"
        'drawn_samples = 1\ntriangles = 900\nshading_rate = "pixel"\n'
    )
    assert load_scene(tmp_path / "scene.toml") == {
        "ambient": (0.2, 0.2, 0.2),
        "background": None,
        "lights": (LIGHTS["key"], fr.Light(azimuth=10, irradiance=(1.0, 2.0, 3.0))),
        "camera": fr.Camera(azimuth=40, zoom=1.5),
        "material": {"m": 0.25},
        "planned": Planned(((512, 512), (1024, 1024)), 4, 1, 900, shading_rate="pixel"),
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[camera]\nroll = 3", "unknown key 'roll' in camera; known: azimuth, elevation"),
        ("[camera]\nfov = 'wide'", "camera fov = 'wide'"),
        ("camera = { position = [0, 0] }", r"camera position = \[0, 0\]"),
        ("[[lights]]\nwatt = 3", "unknown key 'watt' in lights"),
        ("lights = 'blue'", "unknown light 'blue'"),
        ("material = { m = 'rough' }", "m = 'rough' is not a number: give a number in"),
        ("material = { albedo = 'red' }", "albedo = 'red': give a number in"),
        ("lights = ['blue']", "unknown light 'blue'"),
        ("[material]\nm = 9", "m = 9 is outside"),
        ("[material]\nalbedo_map = 'a.png'", "unknown key 'albedo_map' in material"),
        ("background = 'red'", "background = 'red'"),
        ("colour = 1", "unknown key 'colour'; known: mesh, "),
        ("lights = [3]", "lights = 3: give a facerender.Light, a text such as key"),
        ("ambient = -1.0", "ambient = -1.0: give a number in"),
        ("shading = 'exact'", "shading = 'exact': give a facerender.Shading, or a table"),
        ("[shading]\nlobe = 'd5'", "unknown lobe 'd5'"),
        ("[shading]\nlobe = { g = 4 }", "lobe .* lacks factor: add it"),
        ("[shading]\nlobe = { g = 4, factor = -1 }", "g-power factor = -1"),
        ("[shading]\ngloss = 1", "unknown key 'gloss' in shading; known: model"),
        ("[shading]\nspecular_lights = ['key']", r"specular_lights = \['key'\]: "),
        ("[shading]\nspecular_lights = [0, 0]", r"specular_lights = \[0, 0\]: .* each once"),
        ("[shading]\nspecular_lights = [true]", r"specular_lights = \[True\]: give a list"),
        ("[shading]\nsmall_slope = 'no'", "small_slope = 'no': give true or false"),
        ("[planned]\nsizes = [[8, 8]]", "planned .* lacks samples"),
        ("[planned]\nsizes = []\nsamples = 1", r"planned sizes = \[\]: give sizes, such"),
        ("[planned]\nsizes = [[8, 0]]\nsamples = 1", "planned sizes 8 x 0: give 1 to 16384"),
        ("[planned]\nsizes = [[8]]\nsamples = 1", r"planned sizes = \[8\]: give width and height"),
        ("[planned]\nsizes = [[8, 8]]\nsamples = 0.5", "samples = 0.5: give"),
        (
            "planned = { sizes = [[8, 8]], samples = 4, shading_rate = 1 }",
            "rate 1; known: sample, p",
        ),
        ("[camera", " is not valid TOML"),
    ],
)
def test_invalid_scene_files_are_refused(tmp_path, text, message):
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(fr.InputError, match=f"^scene.toml.*{message}"):
        load_scene(tmp_path / "scene.toml")
    with suppress(tomllib.TOMLDecodeError):
        tables = tomllib.loads(text)
        with pytest.raises(fr.InputError, match=message):
            fr.Job.from_dict(tables)
