"""Tests that Python, scene files and the command line accept the same names and the same fields."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import facerender as fr
from facerender.commands import parser_of
from facerender.commands.output import commands_of, groups_of
from facerender.commands.scene import job_of
from facerender.material import MAPS
from facerender.scene.camera import AZIMUTHS_BY_NAME
from facerender.scene.detail import Planned
from facerender.scene.environment import STUDIO
from facerender.scene.light import LIGHTS
from facerender.values.fields import limits_of, toml_text
from tests.awkward_files import MINI_HEAD
from tests.settings import scene_value
from tools.docs.tables import vocabulary


@pytest.fixture(scope="module")
def mesh() -> fr.Mesh:
    return fr.load_mesh(MINI_HEAD)


def job_of_options(*options: str) -> fr.Job:
    """Return the job that ``facerender render`` makes of options."""
    line = ["render", "-o", "x.png", *options]
    return job_of(parser_of(line).parse_args(line), None)[0]


# --- names ---------------------------------------------------------------------------------------

CAMERAS = {
    **{name: fr.Camera(azimuth) for name, azimuth in AZIMUTHS_BY_NAME.items()},
    "30": fr.Camera(30.0),
    "30,-20": fr.Camera(30.0, -20.0),
    "front,5,1.5": fr.Camera(0.0, 5.0, zoom=1.5),
    "three-quarter,-5": fr.Camera(-35.0, -5.0),
}


@pytest.mark.parametrize("text", CAMERAS)
def test_cameras_have_the_same_texts_everywhere(text, mesh, tmp_path):
    (tmp_path / "scene.toml").write_text(f"camera = '{text}'\ncameras = ['{text}', {{}}]\n")
    found = fr.load_scene(tmp_path / "scene.toml")
    assert fr.Scene(mesh, text).camera == CAMERAS[text]
    assert fr.Job(camera=text).camera == CAMERAS[text]
    assert fr.turntable(text, 1) == (CAMERAS[text],)
    assert found == {"camera": CAMERAS[text], "cameras": (CAMERAS[text], fr.Camera())}
    assert job_of_options(f"--camera={text}").camera == CAMERAS[text]


LIGHT_TEXTS = [*LIGHTS, "key,no-shadow", "10,20,2,radius=3", "point:1,2,3,0.5"]


@pytest.mark.parametrize("text", LIGHT_TEXTS)
def test_lights_have_the_same_texts_everywhere(text, mesh):
    (light,) = job_of_options("--light", text).lights
    assert fr.Scene(mesh, lights=(text, light)).lights == (light, light)
    assert fr.Job(lights=(text,)).lights == (light,)
    assert scene_value("lights", [text]) == (light,)
    assert fr.Scene(mesh, lights=text).lights == (light,)  # one light need not be in a list
    assert fr.Scene(mesh, lights=light).lights == (light,)


@pytest.mark.parametrize("text", [STUDIO, "studio,20", "studio,-30,0.5"])
def test_environments_have_the_same_texts_everywhere(text, mesh):
    file = job_of_options("--environment", text).environment
    expected = fr.load_environment(file)
    job = fr.Job(environment=text)
    assert file == job.environment == scene_value("environment", text)
    for found in (
        fr.load_environment(text),
        fr.Scene(mesh, environment=text).environment,
        fr.Scene(mesh, environment=file).environment,
        job.scene(mesh).environment,
    ):
        assert found == expected


def test_paths_of_environments_may_have_commas(mesh, tmp_path):
    np.save(tmp_path / "a,5.npy", np.ones((2, 4, 3), np.float32))
    found = fr.Scene(mesh, environment=tmp_path / "a,5.npy").environment
    assert (found.rotation, found.panorama.radiance.shape) == (0.0, (2, 4, 3))
    assert fr.load_environment(tmp_path / "a,5.npy") == found


@pytest.mark.parametrize(
    ("text", "color"), [("none", None), ("0.1,0.2,0.3", (0.1, 0.2, 0.3))], ids=str
)
def test_backgrounds_have_the_same_texts_everywhere(text, color, mesh):
    assert fr.Scene(mesh, background=text).background == color
    assert fr.Job(background=text).background == color
    assert scene_value("background", text) == color
    assert job_of_options("--background", text).background == color


def test_an_environment_replaces_the_default_lights_everywhere(mesh, tmp_path):
    (tmp_path / "scene.toml").write_text("environment = 'studio'\n")
    file = fr.load_scene(tmp_path / "scene.toml")
    for job in (
        fr.Job(environment="studio"),
        fr.Job(**file),
        fr.Job.from_dict({"environment": "studio"}),
        job_of_options("--environment", "studio"),
        job_of_options("--scene", str(tmp_path / "scene.toml")),
        fr.Scene(mesh, environment="studio"),
    ):
        assert (job.lights, job.ambient) == ((), (0.0, 0.0, 0.0))
    for own in (fr.Scene(mesh), fr.Job(), job_of_options()):
        assert own.lights == (LIGHTS["key"], LIGHTS["rim"], LIGHTS["fill"])
        assert own.ambient == (0.26, 0.28, 0.31)
    given = fr.Scene(mesh, lights=("key",), ambient=0.1, environment="studio")
    assert (given.lights, given.ambient) == ((LIGHTS["key"],), (0.1, 0.1, 0.1))


def test_render_accepts_the_names_of_the_command_line(mesh, egl):
    words = {"camera": "three-quarter", "lights": ("key",), "background": "none"}
    frame = fr.render(mesh, **words, ambient=0.1, environment="studio", size=(32, 32), backend=egl)
    scene = fr.Scene(
        mesh, fr.Camera(-35.0), (LIGHTS["key"],), 0.1, None, fr.load_environment("studio")
    )
    with fr.Renderer((32, 32), backend=egl) as renderer:
        np.testing.assert_array_equal(frame.linear, renderer.render(scene).linear)


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        (lambda mesh: fr.Scene(mesh, "west"), AZIMUTHS_BY_NAME),
        (lambda mesh: fr.Camera("west"), AZIMUTHS_BY_NAME),
        (lambda mesh: fr.turntable("west"), AZIMUTHS_BY_NAME),
        (lambda mesh: fr.plan(fr.Scene(mesh), "1/255", cameras="west"), AZIMUTHS_BY_NAME),
        (lambda mesh: fr.Scene(mesh, lights=("moon",)), LIGHTS),
        (lambda mesh: fr.load_environment("studoi"), [STUDIO, ".hdr", ".exr", ".npy"]),
        (lambda mesh: fr.Scene(mesh, environment="studoi"), [STUDIO]),
        (lambda mesh: fr.Scene(mesh, background="red"), ["none"]),
        (lambda mesh: job_of_options("--background", "red"), ["none"]),
        (lambda mesh: fr.Camera(frame="nose"), ["auto", "all", "head", "face"]),
        (lambda mesh: mesh.with_material(preset="leather"), ["skin", "lips", "hair-card"]),
        (lambda mesh: fr.Shading("phong"), ["cook-torrance", "ward"]),
        (lambda mesh: fr.Shading(lobe="d5"), ["exact", "fitted"]),
    ],
)
def test_unknown_names_list_the_valid_names(wrong, names, mesh):
    with pytest.raises(fr.InputError) as caught:
        wrong(mesh)
    message = str(caught.value)
    assert "\n" not in message
    assert all(name in message for name in names)


# --- fields --------------------------------------------------------------------------------------

PLACED = {
    "extrinsics": [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.6]],
    "intrinsics": [[500.0, 0.0, 128.0], [0.0, 500.0, 128.0], [0.0, 0.0, 1.0]],
    "size": [256, 256],
    "distortion": [-0.02, 0.001, 0.0, 0.0],
}
AIMED = {"position": [0.0, 0.0, 1.0], "target": [0.0, 0.1, 0.0], "fov": 30.0, "name": "left"}
PARALLEL = {"orthographic": True, "view_height": 0.3}
ORBIT = {"azimuth": 20.0, "elevation": 10.0, "zoom": 1.5, "frame": "face"}
MATERIAL = {
    **{"albedo": [0.4, 0.3, 0.2], "m": 0.25, "roughness_factor": 0.5, "f0": 0.04, "ks": 0.9},
    **{"kd": 0.8, "second_slope": 0.5, "lobe_weight": 0.7, "scattering": "skin"},
    **{"alpha": "blend", "opacity": 0.5, "alpha_cutoff": 0.4, "emissive": [0.1, 0.2, 0.3]},
    **{"normal_strength": 0.5, "occlusion_strength": 0.5, "second_uv": ["normal_map"]},
    **{"transmission": 0.5, "refraction": 1.3, "double_sided": True, "unlit": True},
}
SHADING = {
    **{"outside": "exact", "ks": 0.5, "normal_map": False, "ambient": False, "two_lobes": False},
    **{"slope_filter": False, "environment": False, "diffuse": "coupled"},
    **{"scatter_samples": 32, "environment_samples": 16, "environment_lights": 4},
    **{"specular_lights": [0], "shadow_lights": [0]},
}
TERM = {"lobe": "d16", "fresnel": "dielectric", "masking": "kelemen", "m": 0.2, "small_slope": True}
# Values that differ from their defaults, by class and table of a scene file.
SAMPLES: dict[tuple[type, str], list[dict[str, Any]]] = {
    (fr.Camera, "camera"): [PLACED, AIMED, ORBIT, PARALLEL],
    (fr.Light, "lights"): [
        {"azimuth": 5.0, "elevation": 6.0, "irradiance": [1.0, 2.0, 3.0], "radius": 4.0},
        {"position": [1.0, 2.0, 3.0], "shadow": False},
        {"azimuth": 5.0, "follow": True},
    ],
    (fr.EnvironmentFile, "environment"): [{"file": "a.exr", "rotation": 20.0, "scale": 0.5}],
    (fr.Material, "material"): [MATERIAL],
    (fr.Shading, "shading"): [SHADING],
    (fr.Term, "shading"): [TERM, {"model": "ward"}],
    (fr.ImageSettings, "image"): [
        {"size": [640, 480], "samples": 8, "anisotropy": 2.0, "float_albedo": True}
        | {"full_maps": True, "alpha_threshold": 0.3}
    ],
    (fr.Pose, "pose"): [
        {"weights": {"jawOpen": 0.5}, "clip": "nod", "time": 0.5, "track": True}
        | {"joints": {"head": [0.0, 20.0, 0.0]}},
        {"vertices": "a.npy", "frame": 3},
    ],
    (fr.Pose, "before"): [
        {"weights": {"jawOpen": 0.5}, "clip": "nod", "time": 0.5, "track": True}
        | {"joints": {"head": [0.0, 20.0, 0.0]}},
        {"vertices": "a.npy", "frame": 3},
    ],
    (Planned, "planned"): [
        {"sizes": [[64, 64]], "samples": 4, "drawn_samples": 2, "triangles": 300}
        | {"cull_back_faces": True, "shading_rate": "pixel"}
    ],
}


def plain(value: Any) -> Any:
    """Return a value as JSON represents it, with dataclasses as their class and fields."""
    return json.loads(json.dumps(value, default=lambda own: [type(own).__name__, vars(own)]))


@pytest.mark.parametrize(
    ("kind", "table"), SAMPLES, ids=lambda each: getattr(each, "__name__", each)
)
def test_scene_files_have_every_field(kind, table, tmp_path):
    tables = SAMPLES[kind, table]
    given = {name for each in tables for name in each}
    own = {*limits_of(kind)}
    own -= {*limits_of(fr.Term)} if kind is fr.Shading else set()
    assert given == own
    for each in tables:
        text = toml_text({table: [each] if table == "lights" else each})
        (tmp_path / "scene.toml").write_text(text)
        found = fr.load_scene(tmp_path / "scene.toml")[table]
        found = found[0] if table == "lights" else found
        if isinstance(found, dict):  # checked by load_scene, and passed on to Job
            assert plain(found) == plain(each)
            job = fr.Job(**{table: found})
            found = fr.Material(**job.material) if table == "material" else getattr(job, table)
        found = found.term if kind is fr.Term else found
        expected = kind.from_dict(each) if kind is fr.Shading else kind(**each)
        assert plain(found) == plain(expected)
        default = kind(
            **{
                name: each[name]
                for name in ("file", "sizes", "samples")
                if name in each and kind in (Planned, fr.EnvironmentFile)
            }
        )
        for name in each:
            if name not in ("file", "sizes") and (kind, name) != (Planned, "samples"):
                assert plain(getattr(found, name)) != plain(getattr(default, name)), name


def test_scene_files_have_every_field_of_a_scene():
    assert {each.name for each in fields(fr.Scene)} - {"mesh"} <= {*limits_of(fr.Job)}


def test_scene_files_have_every_setting_of_a_renderer():
    machine = {"self", "backend", "memory"}  # settings of the machine, not of the image
    settings = {each.name for each in fields(fr.ImageSettings)}
    assert {*inspect.signature(fr.Renderer.__init__).parameters} - machine == settings


def test_jobs_accept_the_values_of_a_scene_file(mesh, tmp_path):
    text = (
        "camera = 'three-quarter'\nlights = ['key']\n[material]\nm = 0.2\n[shading]\nlobe = 'd16'\n"
        "[image]\nsize = [64, 48]\nsamples = 2\n"
    )
    (tmp_path / "scene.toml").write_text(text)
    job = fr.Job(fr.MeshFile(str(MINI_HEAD)), **fr.load_scene(tmp_path / "scene.toml"))
    assert (job.camera, job.lights) == (fr.Camera(-35.0), (LIGHTS["key"],))
    assert (job.shading, job.image) == (fr.Shading(lobe="d16"), fr.ImageSettings((64, 48), 2))
    assert job.scene().mesh.materials[0].m == 0.2
    line = job_of_options(str(MINI_HEAD), "--scene", str(tmp_path / "scene.toml"))
    assert line == replace(job, pose=line.pose)


def test_options_override_the_image_of_a_scene_file(tmp_path):
    (tmp_path / "scene.toml").write_text("[image]\nsize = [64, 48]\nsamples = 2\nanisotropy = 4\n")
    scene = ["--scene", str(tmp_path / "scene.toml")]
    assert job_of_options(*scene).image == fr.ImageSettings((64, 48), 2, 4.0)
    assert job_of_options(*scene, "--samples", "8").image == fr.ImageSettings((64, 48), 8, 4.0)
    line = ["render", "-o", "x.png", *scene]
    assert job_of(parser_of(line).parse_args(line), (9, 9))[0].image.size == (9, 9)


@pytest.mark.parametrize(
    "name", [each.name for each in fields(fr.Material) if each.name not in MAPS]
)
def test_the_option_part_has_every_field_of_a_material(name):
    values = MATERIAL[name] if isinstance(MATERIAL[name], list) else [MATERIAL[name]]
    words = ",".join(str(each).lower() for each in values)
    (table,) = job_of_options("--part", f"head,{name}={words}").parts.values()
    assert getattr(fr.Material(**table), name) == getattr(
        fr.Material(**{name: MATERIAL[name]}), name
    )


# --- arguments that exclude each other -----------------------------------------------------------

IN_FRONT = {"position": (0.0, 0.0, 1.0)}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda mesh: fr.Light(azimuth=3.0, **IN_FRONT), "light azimuth = 3 and position exclude"),
        (lambda mesh: fr.Light(elevation=3, **IN_FRONT), "light elevation = 3 and position excl"),
        (lambda mesh: fr.Camera(elevation=3, **IN_FRONT), "camera elevation = 3.0 and position"),
        (lambda mesh: fr.Camera(zoom=2, **IN_FRONT), "camera zoom = 2.0 and position exclude"),
        (
            lambda mesh: fr.Camera(frame="face", target=(0, 0, 0), **IN_FRONT),
            "camera frame = 'face' and position exclude",
        ),
        (
            lambda mesh: fr.view_of(fr.Scene(mesh, fr.Camera(3.0, **IN_FRONT)), 1.0),
            "camera azimuth = 3 and position exclude each other, unless",
        ),
        (lambda mesh: fr.Pose(frame=3), "pose frame = 3 needs vertices"),
        (
            lambda mesh: mesh.with_skin(m=0.2, roughness_map=mesh.materials[0].albedo_map),
            "m = 0.2 and roughness_map exclude each other",
        ),
        (
            lambda mesh: job_of_options("--environment-samples", "8"),
            "--environment-samples 8 has no environment map: add --environment FILE",
        ),
        (
            lambda mesh: job_of_options("--scatter-samples", "8"),
            "--scatter-samples 8 has no subsurface scattering: add --scattering skin",
        ),
    ],
)
def test_arguments_that_would_be_ignored_are_errors(make, message, mesh):
    with pytest.raises(fr.InputError, match=message) as caught:
        make(mesh)
    assert "\n" not in str(caught.value)


def test_arguments_with_an_effect_are_not_refused(mesh, tmp_path):
    above = fr.Camera(20.0, position=(0.0, 4.0, 0.0), target=(0.0, 0.0, 0.0))
    assert fr.view_of(fr.Scene(mesh, above), 1.0).forward[1] == -1.0
    assert fr.Camera(frame="face", **IN_FRONT).frame == "face"  # the face is then the target
    scene = tmp_path / "scene.toml"
    scene.write_text("[material]\nscattering = 'skin'\n[environment]\nfile = 'studio'\n")
    options = ("--scene", str(scene), "--scatter-samples", "8", "--environment-samples", "8")
    assert job_of_options(*options).shading.scatter_samples == 8
    assert job_of_options("--environment-samples", "0").shading.environment_samples == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"second_slope": 0.5}, "second_slope has no effect on"),
        ({"opacity": 0.5}, "opacity = 0.5 has no effect without alpha blend or mask"),
        ({"alpha_cutoff": 0.2}, "alpha_cutoff = 0.2 has no effect without alpha mask"),
        ({"refraction": 1.3}, "refraction = 1.3 has no effect without transmission"),
        ({"normal_strength": 0.3}, "normal_strength = 0.3 has no effect without a normal map"),
        ({"roughness_factor": 0.3}, "roughness_factor = 0.3 has no effect without a roughness"),
        ({"occlusion_strength": 0.3}, "occlusion_strength = 0.3 has no effect without an occl"),
    ],
)
def test_factors_without_effect_cause_a_warning(changes, message, mesh):
    with pytest.warns(fr.FacerenderWarning, match=message):
        mesh.with_skin(**changes)


@pytest.mark.filterwarnings("error")
def test_factors_with_an_effect_cause_no_warning(mesh):
    mesh.with_skin(opacity=0.5, alpha="blend").with_skin(alpha="mask", alpha_cutoff=0.2)
    mesh.with_skin(refraction=1.3, transmission=0.5)
    mesh.with_skin(opacity=1.0, alpha_cutoff=0.5, normal_strength=1.0)  # the present values


# --- listings ------------------------------------------------------------------------------------


def test_dir_lists_the_public_names():
    assert dir(fr) == sorted(fr.__all__)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (fr.Camera(), "Camera()"),
        (fr.Camera("three-quarter", frame="face"), "Camera(azimuth=-35.0, frame='face')"),
        (fr.Pose({"jawOpen": 0.5}), "Pose(weights={'jawOpen': 0.5})"),
        (fr.Shading(lobe="d16"), "Shading(lobe='d16')"),
        (fr.load_environment("studio,20").panorama, "<Panorama 'studio', 256 x 128>"),
        (
            fr.load_environment("studio,20"),
            "Environment(panorama=<Panorama 'studio', 256 x 128>, rotation=20.0)",
        ),
    ],
)
def test_reprs_have_only_the_fields_that_differ_from_their_defaults(value, text):
    assert repr(value) == text


# --- the table of the guide ----------------------------------------------------------------------


def test_the_table_has_every_option_of_render():
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
    options = {
        next(name for name in each.option_strings if name.startswith("--"))
        for _, actions in groups_of(commands_of(parser_of(["render"]))["render"])
        for each in actions
        if each.option_strings
    }
    missing = {
        each
        for each in options - vocabulary.OF_THE_COMMAND
        if not re.search(rf"`[^`]*{each}\b", page)
    }
    assert missing == set()


def test_the_table_has_every_field():
    text = "\n".join(vocabulary.blocks().values())
    for kind in vocabulary.KINDS:
        for each in fields(kind):
            assert f"`{vocabulary.python(kind, each.name)}`" in text or each.name == "term"
    names = inspect.signature(fr.render).parameters
    assert {*names} - {"mesh", "size", "samples", "backend", "only", "outside", "m", "unknown"} <= {
        each.name for kind in vocabulary.KINDS for each in fields(kind)
    }
