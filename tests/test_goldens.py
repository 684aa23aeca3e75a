"""Tests small images of every shading, camera, term and kind of mesh against goldens.

``pytest tests/test_goldens.py --facerender-update-missing`` writes missing goldens; check them by
eye. The goldens were recorded on llvmpipe, with float albedo maps. Without maps, other drivers
agree within the strict limits. With maps they need wider limits, since drivers filter maps
differently.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing.context import Backend
from facerender.scene.light import LIGHTS
from facerender.scene.scene import ONLY, Only
from tests import awkward_files as files
from tests.conftest import missing, require_backend
from tests.test_reference import SHADINGS, shading_name

SIZE = (128, 128)
CLOSE = fr.Camera(azimuth=-30.0, elevation=5.0, zoom=1.25)
CAMERAS = {
    "front": fr.Camera(),
    "profile": fr.Camera(azimuth=90.0),
    "above": fr.Camera(azimuth=35.0, elevation=60.0),
    "below": fr.Camera(azimuth=-30.0, elevation=-20.0, fov=60.0, zoom=1.8),
}
STRICT = {"block": 1e-3}  # limit for float textures and one driver
MAPPED = {"point": 0.15, "block": 0.01}
SLOPES = {"exact": 1.2, "fitted": 0.6, "d8": 0.15, "cosine": 0.15}

Compare = Callable[..., None]


@pytest.fixture(scope="module")
def meshes(head: fr.Mesh, tmp_path_factory: pytest.TempPathFactory) -> dict[str, fr.Mesh]:
    folder = tmp_path_factory.mktemp("meshes")
    mini = files.mini_head()
    colors = np.uint8(127.5 + 127.5 * np.insert(mini.normals, 3, 1.0, axis=1))
    return {
        "head": head,
        "bare": head.with_material(m=0.3, albedo_map=None, normal_map=None, occlusion_map=None),
        "mini": fr.load_mesh(files.MINI_HEAD),
        "vertex-colors": fr.load_mesh(files.write_ply(folder / "mini.ply", mini, colors)),
        "no-colors": fr.load_mesh(files.write_stl(folder / "mini.stl", mini)),
    }


@pytest.fixture(scope="module")
def small(egl: Backend) -> Iterator[fr.Renderer]:
    with fr.Renderer(SIZE, samples=1, backend=egl, float_albedo=True) as renderer:
        yield renderer


@pytest.fixture
def agrees(facerender_snapshot) -> Compare:
    """A function that compares a frame with its golden."""

    def check(frame: fr.Frame, maps: bool = False) -> None:
        wide = maps and not frame.metadata["GL_RENDERER"].startswith("llvmpipe")
        limits = MAPPED if wide else STRICT
        facerender_snapshot.check(frame, **limits)

    return check


@pytest.mark.slow
def test_eyes(small, agrees):
    """Default settings: soft shadows, refracting corneas, blended lashes and tear lines."""
    scene = fr.Scene(fr.load_mesh(), fr.Camera(frame="face", zoom=2.0))
    agrees(small.render(scene), maps=True)


@pytest.mark.first_case
@pytest.mark.parametrize("shading", SHADINGS, ids=shading_name)
def test_shadings(small, meshes, agrees, shading):
    frame = small.render(fr.Scene(meshes["bare"], CLOSE), shading, "specular")
    agrees(frame)


@pytest.mark.first_case
@pytest.mark.parametrize("model", ["cook-torrance", "ward"])
@pytest.mark.parametrize("lobe", SLOPES)
def test_other_slopes(small, meshes, agrees, model, lobe):
    mesh = meshes["mini"].with_material(m=SLOPES[lobe])
    frame = small.render(fr.Scene(mesh, CLOSE), fr.Shading(model, lobe), "specular")
    agrees(frame)


@pytest.mark.first_case
@pytest.mark.parametrize("mesh", ["head", "mini"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_cameras(small, meshes, agrees, mesh, camera):
    agrees(small.render(fr.Scene(meshes[mesh], CAMERAS[camera])), maps=True)


@pytest.mark.first_case
@pytest.mark.parametrize("mesh", ["head", "mini", "vertex-colors", "no-colors"])
def test_meshes_in_ward(small, meshes, agrees, mesh):
    frame = small.render(fr.Scene(meshes[mesh], CLOSE), fr.Shading("ward", "fitted"))
    agrees(frame, maps=mesh in ("head", "mini"))


@pytest.mark.first_case
@pytest.mark.parametrize("only", ONLY)
def test_terms(small, meshes, agrees, only: Only):
    mesh = "head" if only == "albedo" else "bare"
    scene = fr.Scene(meshes[mesh], CLOSE)
    if only == "visibility":
        scene = replace(scene, lights=(replace(LIGHTS["key"], radius=4.0, shadow=True),))
    if only == "motion":
        posed = scene.mesh.with_pose({"jawOpen": 0.5, "mouthSmileLeft": 0.5})
        scene = replace(scene, mesh=posed, before=scene)
    frame = small.render(scene, only=only)
    agrees(frame, maps=only == "albedo")


def test_shadows(small, meshes, agrees):
    mesh = meshes["bare"]
    lights = [replace(light, radius=0.0) for light in fr.Scene(mesh).lights]
    place = tuple(mesh.center + mesh.radius * np.array([0.4, 2.0, 1.5]))
    near = fr.Light(irradiance=1.0, position=place, radius=6.0, shadow=True)
    agrees(small.render(fr.Scene(mesh, CLOSE, (*lights, near))))


def test_point_light_before_nothing(small, meshes, agrees):
    mesh = meshes["head"]
    place = tuple(mesh.center + mesh.radius * np.array([-1.0, 0.8, 1.5]))
    light = fr.Light(irradiance=(3.0, 1.5, 0.6), position=place, shadow=False)
    scene = fr.Scene(mesh, CLOSE, (light, LIGHTS["rim"]), ambient=0.0, background=None)
    agrees(small.render(scene), maps=True)


def test_samples(egl, small, meshes, agrees):
    if small.context.gl.max_samples < 4:
        missing(f"{small.context.renderer} has no 4 samples")
    with fr.Renderer(SIZE, samples=4, backend=egl, float_albedo=True) as renderer:
        scene = replace(fr.Scene(meshes["head"], CLOSE), background=None)
        agrees(renderer.render(scene), maps=True)


@pytest.mark.slow
def test_goldens_hold_on_another_driver():
    require_backend("egl")
    tests = "not (cameras or terms or printed or another_driver)"
    command = [sys.executable, "-m", "pytest", "-p", "facerender.pytest_plugin", __file__]
    environment = {**os.environ, "GALLIUM_DRIVER": "softpipe"}
    environment.pop("FACERENDER_REQUIRE_ALL", None)  # softpipe lacks multisampling
    result = subprocess.run(
        [*command, "-k", tests], env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout
    assert "softpipe has no 4 samples" in result.stdout
