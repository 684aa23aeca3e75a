"""Tests jobs, scenes and shadings as JSON, TOML and pickles."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import facerender as fr
from facerender.lobes import GPower
from facerender.scene.detail import Planned
from facerender.scene.job import scene_toml
from facerender.scene.light import LIGHTS
from tests import awkward_files as files

POINT = fr.Light(irradiance=(1.0, 0.5, 0.2), position=(0.2, 0.3, 0.5))
JOBS = {
    "defaults": fr.Job(),
    "everything": fr.Job(
        fr.MeshFile(str(files.MINI_HEAD), flip_v=True, triangles=1000),
        {"m": 0.25, "ks": 0.5, "albedo": (0.5, 0.4, 0.3)},
        fr.Camera(20.0, 5.0, zoom=1.5, target=(0.0, 0.01, 0.0)),
        (LIGHTS["key"], POINT),
        ambient=(0.1, 0.2, 0.3),
        background=None,
        shading=fr.Shading(
            lobe=GPower(6, 0.3, 0.1),
            ks=0.4,
            normal_map=False,
            fresnel="dielectric",
            specular_lights=(0,),
        ),
        planned=Planned(((48, 32),), 4, triangles=900),
        image=fr.ImageSettings((48, 32), 1, float_albedo=True),
        outputs=(fr.Output("a.png", exposure=1.0), fr.Output("b.exr", "specular")),
    ),
    "terms": fr.Job(
        fr.MeshFile(lobe_map="mask.png", millimetres=3.0),
        {
            "second_slope": 0.4,
            "lobe_weight": 0.3,
            "scattering": ((0.5, 0.3, 0.2, 0.1), (2.0, 0.5, 0.0, 0.0)),
        },
        environment=fr.EnvironmentFile("studio", 20.0, 0.5),
        shading=fr.Shading(
            two_lobes=False,
            diffuse="coupled",
            environment=False,
            environment_samples=8,
            scatter_samples=32,
        ),
    ),
    "dark": fr.Job(
        material={"scattering": "skin"}, lights=(), shading=fr.Shading(specular_lights=())
    ),
}
WAYS = {
    "JSON": lambda job: fr.Job.from_dict(json.loads(json.dumps(job.as_dict()))),
    "TOML": lambda job: fr.Job.from_dict(tomllib.loads(job.toml())),
    "pickle": lambda job: pickle.loads(pickle.dumps(job)),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", JOBS)
def test_jobs_survive_json_toml_and_pickle(name, way, head):
    sent, mesh = WAYS[way](JOBS[name]), None if name == "everything" else head
    scene, expected = (each.scene(mesh) for each in (sent, JOBS[name]))
    assert scene.lights == JOBS[name].lights
    assert scene.mesh.materials == expected.mesh.materials or name == "everything"
    fields = ("mesh", "camera", "lights", "environment", "shading", "planned", "image", "outputs")
    for field in fields:
        assert getattr(sent, field) == getattr(JOBS[name], field)
    assert json.dumps(sent.as_dict()) == json.dumps(JOBS[name].as_dict())


def test_scene_files_hold_all_terms(head, tmp_path):
    job = JOBS["terms"]
    scene = fr.Job(job.mesh, job.material, environment=job.environment).scene(head)
    assert (scene.environment.rotation, scene.environment.scale) == (20.0, 0.5)
    (tmp_path / "scene.toml").write_text(scene_toml(scene, job.shading))
    loaded = fr.load_scene(tmp_path / "scene.toml")
    assert head.with_material(**loaded["material"]).materials == scene.mesh.materials
    assert fr.Shading.from_dict(loaded["shading"]) == job.shading
    assert loaded["environment"] == job.environment


@pytest.mark.slow
def test_pickled_scene_draws_the_same_bits(renderer, tmp_path):
    """A second process without the caches of this one draws the same bits, too."""
    mesh = fr.load_mesh(files.MINI_HEAD)
    mesh = mesh.with_material(specular_map=mesh.materials[0].albedo_map.channel(1, "green"))
    scene = fr.Scene(mesh, lights=(LIGHTS["key"], POINT))
    path = tmp_path / "scene.pickle"
    path.write_bytes(pickle.dumps(scene))
    expected = renderer.render(scene).linear
    np.testing.assert_array_equal(renderer.render(pickle.loads(path.read_bytes())).linear, expected)
    code = (
        "import pickle, sys, numpy as np, facerender as fr\n"
        "scene = pickle.load(open(sys.argv[1], 'rb'))\n"
        "with fr.Renderer((256, 256), samples=1, backend='egl') as renderer:\n"
        "    np.save(sys.argv[2], renderer.render(scene).linear)\n"
    )
    image = tmp_path / "image.npy"
    subprocess.run([sys.executable, "-c", code, path, image], check=True)
    np.testing.assert_array_equal(np.load(image), expected)


def test_a_pickle_holds_each_texture_once(head):
    scenes = [fr.Scene(head, fr.Camera(azimuth)) for azimuth in (0.0, 90.0)]
    one, two = (len(pickle.dumps(scenes[:count])) for count in (1, 2))
    assert two < 1.01 * one
    a, b = pickle.loads(pickle.dumps(scenes))
    assert a.mesh is b.mesh


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"colour": 1}, "unknown key 'colour'; known: mesh, .*, image, outputs"),
        ({"mesh": {"file": "a.glb"}}, "unknown key 'file' in mesh; known: path, albedo"),
        ({"mesh": 3}, "mesh = 3: give a facerender.MeshFile, a path, or a table"),
        ({"mesh": {"path": 3}}, "mesh path = 3: give a path as text"),
        ({"mesh": {"flip_v": 1}}, "mesh flip_v = 1: give true or false"),
        ({"image": {"width": 3}}, "unknown key 'width' in image; known: size, samples"),
        ({"image": 3}, "image = 3: give a facerender.ImageSettings, or a table of size, samples"),
        ({"image": {"size": [3]}}, r"image size = \[3\]: give width and height"),
        ({"image": {"size": "3x"}}, "image size '3x': give N or WxH"),
        ({"image": {"size": 5000 * "1"}}, "image size '1.*: give N or WxH"),
        ({"camera": {"target": 1}}, "camera target = 1: give three numbers"),
        ({"planned": {"sizes": [64, 48], "samples": 4}}, r"planned sizes = \[64, 48\]: give sizes"),
        ({"outputs": {"path": "a.png"}}, "outputs = .*: give a list, each a facerender.Output"),
        ({"outputs": [{"only": "specular"}]}, "outputs .* lacks path"),
        ({"outputs": [{"path": "a.gif"}]}, "a.gif: unknown image format '.gif'"),
        ({"outputs": [{"path": "a.png", "only": "shine"}]}, "unknown term 'shine'; known: spec"),
        ({"outputs": [{"path": 5}]}, "output path = 5: give a path"),
        ([1], r"job = \[1\]: give a facerender.Job, or a table"),
    ],
)
def test_invalid_tables_are_refused(tables, message):
    with pytest.raises(fr.InputError, match=message):
        fr.Job.from_dict(tables)


def test_paths_may_be_path_objects():
    assert fr.MeshFile(Path("a.glb")) == fr.MeshFile("a.glb")
    assert fr.Output(Path("a.png")) == fr.Output("a.png")


def test_converted_jobs_are_equal():
    job = fr.Job(lights=[fr.Light()], ambient=0.5, material={"albedo": [1, 1, 1]})
    assert WAYS["JSON"](job) == job
    assert fr.Job.from_dict(job.as_dict()) == job


def test_a_job_without_factors_or_with_odd_text_survives_its_file(tmp_path):
    pose = fr.Pose(clip="delete\x7f")
    parts = {"skin": {"scattering": None, "double_sided": None, "ks": 0.0}}
    job = fr.Job(material={"scattering": None}, parts=parts, pose=pose)
    (tmp_path / "job.toml").write_text(job.toml())
    loaded = fr.Job.load(tmp_path / "job.toml")
    assert loaded == job
    assert loaded.material == {"scattering": "none"}
    assert loaded.parts == {"skin": {"scattering": "none", "ks": 0.0}}


def test_a_map_in_memory_has_no_text():
    job = fr.Job(mesh=fr.MeshFile(albedo=np.zeros((4, 4, 3), np.uint8)))
    with pytest.raises(fr.InputError, match="mesh albedo = .*: give a path"):
        job.toml()


# --- shadings ------------------------------------------------------------------------------------


def test_fields_of_a_shading_can_be_reset():
    pinned = fr.Shading(m=0.3, specular_lights=[0], small_slope=True)
    assert pinned.replace(m=None, small_slope=None).term == fr.Term()
    assert pinned.replace(specular_lights=None).specular_lights is None
    assert pinned.replace(model="ward").term == fr.Term("ward", m=0.3, small_slope=True)
    assert fr.Shading.from_dict(pinned.as_dict()) == pinned
    with pytest.raises(fr.InputError, match="names light"):
        pinned.replace(specular_lights=[9]).check_lights(3)
