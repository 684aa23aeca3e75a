"""Tests the outputs of a job (``facerender.batch.outputs``): they equal a renderer's frames, other
programs can read them, and their cameras project the mesh to its pixels."""

from __future__ import annotations

import io
import json
import re
import sys
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import facerender as fr
from facerender.batch.outputs import OUTPUTS as ALL
from facerender.batch.outputs import camera_record, draw, transforms_frame
from facerender.images.files import read_image
from facerender.scene.detail import Planned
from facerender.scene.view import view_of
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module
from tests.meshes import with_geometry

SIZE = (96, 64)
OUTPUTS = tuple(name for name in ALL if name != "motion")  # motion needs the frame before
KEY = fr.Light(-50.0, 42.0, irradiance=3.0, shadow=True)


@pytest.fixture(scope="module")
def drawing(egl):
    with fr.Renderer(SIZE, samples=4, backend=egl) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def small():
    return fr.load_mesh(MINI_HEAD)


@pytest.fixture(scope="module")
def halves(head):
    """The built-in head with its upper and lower triangles as two parts."""
    (part,) = head.parts
    upper = part.positions[part.faces][..., 1].mean(axis=1) > head.center[1]
    parts = tuple(replace(part, faces=part.faces[each]) for each in (upper, ~upper))
    return with_geometry(head, parts=parts, materials=head.materials * 2)


def job_of(**changes) -> fr.Job:
    image = fr.ImageSettings(size=SIZE)
    return replace(fr.Job(camera=fr.Camera(-35.0, 10.0), lights=(KEY,), image=image), **changes)


def unchanged(content):
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


def layers_of(content):
    with OpenEXR.File(io.BytesIO(content), separate_channels=True) as file:
        return {name: channel.pixels.copy() for name, channel in file.channels().items()}


@pytest.mark.parametrize("background", [None, (0.2, 0.1, 0.0)])
def test_images_equal_those_that_frames_save(small, drawing, background, tmp_path):
    job = job_of(background=background)
    files = draw(job, small, drawing, OUTPUTS, -0.5, "linear").files
    assert [*files] == [f"{name}.png" for name in OUTPUTS[:-1]] + ["layers.exr"]
    numbers = ("depth", "mask", "parts")  # a frame saves these as images, a job as data
    for only in (None, *OUTPUTS[1:-1]):
        name = f"{only or 'image'}.png"
        drawing.render(job.scene(small), job.shading, only).save(tmp_path / name, -0.5)
        assert (files[name] == (tmp_path / name).read_bytes()) == (only not in numbers), name


@pytest.mark.first_case
@pytest.mark.parametrize(
    "how",
    [
        {"drawn_samples": 1},
        {"triangles": 300},
        {"cull_back_faces": True},
        {"shading_rate": "pixel"},
    ],
    ids=str,
)
def test_a_planned_job_is_drawn_as_planned(small, drawing, how, tmp_path, four_samples):
    camera = fr.Camera(-35.0, -70.0)  # looks into the open neck
    planned = Planned((SIZE,), 4, **how)
    material = {"m": 0.25, "albedo": (0.5, 0.3, 0.2), "double_sided": True}
    job = job_of(camera=camera, material=material)
    outputs = "image", "specular", "normal"
    drawn = draw(replace(job, planned=planned), small, drawing, outputs, 0.0, "linear")
    assert drawn.details["planned"] is True
    detail = planned.detail
    for only in (None, "specular", "normal"):
        name = f"{only or 'image'}.png"
        drawing.render(detail.of(job.scene(small)), job.shading, only, **detail.values).save(
            tmp_path / name
        )
        assert drawn.files[name] == (tmp_path / name).read_bytes()
    whole = draw(job, small, drawing, ("image",), 0.0, "linear")
    assert "planned" not in whole.details
    assert drawn.files["image.png"] != whole.files["image.png"]


@pytest.mark.parametrize("camera", [fr.Camera(), fr.Camera(zoom=8.0), fr.Camera(fov=120.0)])
def test_depth_error_is_at_most_half_a_step(head, drawing, camera):
    mesh = moved(head).with_material(double_sided=True)  # one camera is inside the head
    drawn = draw(job_of(camera=camera), mesh, drawing, ("depth",), 0.0, "linear")
    (content,), scale = drawn.files.values(), drawn.details["depth_scale"]
    steps = unchanged(content)
    assert steps.dtype == np.uint16
    with Image.open(io.BytesIO(content)) as image:
        np.testing.assert_array_equal(np.asarray(image), steps)
    exact = drawing.render(fr.Scene(mesh, camera), only="depth").linear
    np.testing.assert_array_equal(steps > 0, exact[..., 3] > 0)
    assert steps.any()
    assert np.abs(steps * scale - exact[..., 0]).max() <= (0.5 + 1e-6) * scale
    farthest = max(np.linalg.norm(mesh.center - eye_of(drawn.details["camera"])), 0) + mesh.radius
    assert scale <= farthest / 65535 * (1 + 1e-9)


def test_depths_behind_the_bounding_sphere_are_not_0(drawing):
    """A pose may move the surface away, for example by a whole 65536 steps."""
    mesh = fr.Mesh.from_arrays([(-1, -1, 0), (1, -1, 0), (0, 2, 0)], [(0, 1, 2)])
    camera = fr.Camera(position=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0))
    scale = draw(job_of(camera=camera), mesh, drawing, ("depth",), 0.0, "linear").details[
        "depth_scale"
    ]
    for steps in (65534, 65536, 80000):
        away = mesh.with_positions(mesh.parts[0].positions - (0.0, 0.0, steps * scale - 4.0))
        (content,) = draw(
            job_of(camera=camera), away, drawing, ("depth",), 0.0, "linear"
        ).files.values()
        assert [*np.unique(unchanged(content))] == [0, min(steps, 65535)]


def test_cameras_of_one_distance_share_their_scale(head, drawing):
    jobs = [job_of(camera=camera) for camera in fr.turntable(count=5)]
    scales = [
        draw(job, head, drawing, ("depth",), 0.0, "linear").details["depth_scale"] for job in jobs
    ]
    assert scales == pytest.approx([scales[0]] * 5, rel=1e-12)


def test_a_camera_that_sees_nothing(head, drawing):
    away = fr.Camera(position=tuple(head.center + [0, 0, 3]), target=tuple(head.center + [0, 0, 9]))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows head.glb: .* behind the camera"):
        drawn = draw(job_of(camera=away), head, drawing, OUTPUTS, 0.0, "linear")
    for name in ("depth", "mask", "parts", "normal"):
        assert not unchanged(drawn.files[f"{name}.png"]).any()
    assert drawn.details["depth_scale"] > 0.0
    json.dumps(drawn.details, allow_nan=False)


def test_mask_and_parts_show_the_pixel_centre(halves, drawing):
    drawn = draw(job_of(), halves, drawing, ("mask", "parts", "depth"), 0.0, "linear")
    part = drawing.gbuffer(job_of().scene(halves)).part
    mask, parts, depth = (unchanged(drawn.files[f"{n}.png"]) for n in ("mask", "parts", "depth"))
    assert (mask.dtype, parts.dtype) == (np.uint8, np.uint16)
    np.testing.assert_array_equal(parts, part + 1)
    assert set(np.unique(parts)) == {0, 1, 2}
    np.testing.assert_array_equal(mask, 255 * (part >= 0))
    np.testing.assert_array_equal(depth > 0, mask > 0)
    assert drawn.details["mesh"] == "built-in"
    assert drawn.details["parts"] == [part.name for part in halves.parts]


def test_layers_hold_every_pass(halves, drawing, tmp_path):
    job = job_of(background=None)
    content = draw(job, halves, drawing, ("layers",), 3.0, "linear").files["layers.exr"]
    layers = layers_of(content)
    assert {values.dtype for values in layers.values()} == {np.dtype(np.float32)}
    scene = job.scene(halves)
    rgb, part = "RGB", drawing.gbuffer(scene).part
    for only, names in {
        None: "RGBA",
        "depth": "Z",
        "normal": [f"normal.{axis}" for axis in "XYZ"],
        "visibility": ["visibility.Y"],
        **{
            only: [f"{only}.{each}" for each in rgb]
            for only in ("specular", "diffuse", "albedo", "cosines")
        },
    }.items():
        linear = drawing.render(scene, job.shading, only).linear
        for index, name in enumerate(names):
            np.testing.assert_array_equal(layers.pop(name), linear[..., index], name)
    np.testing.assert_array_equal(layers.pop("part.Y"), part + 1)
    np.testing.assert_array_equal(layers.pop("mask.A"), part >= 0)
    assert not layers
    (tmp_path / "layers.exr").write_bytes(content)
    picture = read_image(tmp_path / "layers.exr")  # this reader ignores layers
    np.testing.assert_array_equal(picture.pixels, drawing.render(scene).linear)
    assert picture.metadata["GL_RENDERER"] == drawing.metadata["GL_RENDERER"]


def test_outputs_that_cannot_be_drawn_are_refused(head, drawing, monkeypatch):
    many = with_geometry(head, parts=head.parts * 65536, materials=head.materials * 65536)
    with pytest.raises(fr.InputError, match=r"65536 parts, but parts.png holds at most 65535: use"):
        draw(job_of(), many, drawing, ("parts",), 0.0, "linear")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(
        fr.InputError, match=r"^layers.exr: EXR files need the package OpenEXR; pip"
    ):
        draw(job_of(), head, drawing, ("image", "layers"), 0.0, "linear")
    assert draw(job_of(), head, drawing, ("image",), 0.0, "linear").files


# --- the camera ----------------------------------------------------------------------------------


def moved(mesh: fr.Mesh) -> fr.Mesh:
    """Return the mesh in millimetres, far from the origin."""
    offset = np.array([4e5, -2e4, 7e5])
    parts = [replace(part, positions=part.positions * 1e3 + offset) for part in mesh.parts]
    bounds, radius = mesh.bounds * 1e3 + offset, mesh.radius * 1e3
    return with_geometry(mesh, parts=tuple(parts), bounds=bounds, radius=radius)


def eye_of(camera):
    return np.array(camera["transform_matrix"])[:3, 3]


# Drivers round the positions of vertices to 1/256 pixel.
PIXEL = 0.5 / 256 + 5e-5

CAMERAS = {
    "front": fr.Camera(),
    "orbit": fr.Camera(azimuth=215.0, elevation=-30.0, fov=60.0),
    "near": fr.Camera(azimuth=40.0, zoom=6.0),
    "above": fr.Camera(azimuth=30.0, elevation=90.0),
    "below": fr.Camera(azimuth=-70.0, elevation=-90.0),
    "placed": fr.Camera(position=(1.5, 0.8, 2.0), target=(0.1, 0.2, -0.1), fov=35.0),
    "level": fr.Camera(position=(-3.0, 0.0, 0.0), fov=40.0),
    "straight down": fr.Camera(position=(0.0, 4.0, 0.0), target=(0.0, 0.0, 0.0), azimuth=20.0),
}


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("name", "place"), [("orbit", lambda mesh: mesh), *((name, moved) for name in CAMERAS)]
)
def test_camera_projects_points_to_their_pixels(head, drawing, name, place):
    mesh, camera = place(head), CAMERAS[name]
    for end in ("position", "target"):  # given in radii from the mesh's centre
        if (point := getattr(camera, end)) is not None:
            camera = replace(camera, **{end: tuple(mesh.to_mesh_space(point))})
    seen = drawing.gbuffer(fr.Scene(mesh, camera))
    facts = camera_record(seen.view, mesh, SIZE)
    covered = seen.part >= 0
    assert covered.sum() > 100
    pose, to_world = np.array(facts["Rt"]), np.array(facts["transform_matrix"])

    points = seen.position[covered]
    in_camera = points @ pose[:, :3].T + pose[:, 3]
    depth = drawing.render(fr.Scene(mesh, camera), only="depth").linear[covered][:, 0]
    np.testing.assert_allclose(in_camera[:, 2], depth, rtol=1e-6)
    pixels = in_camera @ np.array(facts["K"]).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    centres = np.argwhere(covered)[:, ::-1] + 0.5
    assert np.abs(pixels - centres).max() < PIXEL
    by_opencv, _ = cv2.projectPoints(
        points, cv2.Rodrigues(pose[:, :3])[0], pose[:, 3], np.array(facts["K"]), None
    )
    np.testing.assert_allclose(by_opencv[:, 0], pixels, atol=1e-3)

    assert np.linalg.det(pose[:, :3]) == pytest.approx(1.0)  # right-handed
    np.testing.assert_allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-12)
    flipped = np.diag([1.0, -1.0, -1.0]) @ np.linalg.inv(to_world)[:3]
    np.testing.assert_allclose(flipped, pose, atol=1e-9 * np.abs(pose).max())
    np.testing.assert_allclose(eye_of(facts), mesh.to_mesh_space(seen.view.position), rtol=1e-12)
    assert (facts["K"][0][2], facts["K"][1][2]) == (SIZE[0] / 2, SIZE[1] / 2)
    assert facts["K"][0][0] == facts["K"][1][1]  # square pixels


def test_a_frame_of_transforms_json(head, drawing):
    camera = draw(job_of(), head, drawing, ("mask",), 0.0, "linear").details["camera"]
    frame = transforms_frame(camera, "data/0/image.png")
    assert frame == json.loads(json.dumps(frame))
    keys = ["file_path", "w", "h", "fl_x", "fl_y", "cx", "cy", "transform_matrix"]
    assert [*frame] == keys
    assert [frame[key] for key in ("file_path", "w", "h", "cx", "cy")] == [
        *("data/0/image.png", 96, 64, 48.0, 32.0)
    ]
    # instant-ngp computes the vertical field of view as 2 atan(h / (2 fl_y)).
    assert np.degrees(2 * np.arctan(64 / (2 * frame["fl_y"]))) == pytest.approx(25.0)
    assert frame["fl_x"] == pytest.approx(frame["fl_y"])
    up, back = np.array(frame["transform_matrix"])[:3, 1:3].T
    assert up[1] > 0.9  # y is up
    assert back @ (eye_of(camera) - head.center) > 0  # z points away from the mesh


def test_the_frame_before_changes_only_motion(head, drawing):
    job = job_of(before=fr.Pose({"jawOpen": 0.4}))
    files = draw(job, head, drawing, ("image", "motion", "mask", "normal"), 0.0, "linear").files
    assert b"before" in files.pop("motion.png")[:2000]
    for name, content in files.items():
        assert content == draw(job, head, drawing, (Path(name).stem,), 0.0, "linear").files[name], (
            name
        )
    layers = draw(job, head, drawing, ("layers", "image"), 0.0, "linear").files
    assert b"before" in layers["layers.exr"][:4000]
    assert layers["image.png"] == files["image.png"]


LENS = (-0.1, 0.05, 0.002, -0.001)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of webdataset
@pytest.mark.parametrize("lens", [None, LENS], ids=["straight", "distorted"])
def test_code_of_the_page_reads_the_outputs(head, egl, tmp_path, monkeypatch, lens):
    text = (Path(__file__).parents[1] / "docs" / "batch.md").read_text(encoding="utf-8")
    camera = fr.Camera(position=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0))
    if lens:
        view = view_of(fr.Scene(head, camera), 512 / 384)
        k, pose = view.intrinsics((512, 384)), view.extrinsics(head)
        camera = fr.Camera(extrinsics=pose, intrinsics=k, size=(512, 384), distortion=lens)
    image = fr.ImageSettings(size=(512, 384))
    job = fr.Job(camera=camera, image=image, before=fr.Pose({"jawOpen": 0.4}))
    with fr.Renderer.of(job, egl) as renderer:
        drawn = draw(job, head, renderer, ALL, 0.0, "linear")
        seen = renderer.gbuffer(job.scene(head))
        motion = renderer.render(job.scene(head, True), only="motion").linear
    folder = tmp_path / "views" / "data" / "front"
    folder.mkdir(parents=True)
    for name, content in drawn.files.items():
        (folder / name).write_bytes(content)
    record = json.dumps({"id": "front", **drawn.details})
    (tmp_path / "views" / "jobs.jsonl").write_text(f"{record}\n")
    shards = tmp_path / "heads" / "shards"
    shards.mkdir(parents=True)
    (folder / "json").write_text(record)
    with tarfile.open(shards / "000000-0.tar", "w") as tar:
        for member in ("depth.png", "json"):
            tar.add(folder / member, f"front.{member}")
    monkeypatch.chdir(tmp_path)
    require_module("webdataset")
    page: dict[str, Any] = {}
    blocks = re.findall(r"^(?<!-->\n)```python$(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    for block in blocks:
        exec(block, page)
    covered = seen.part >= 0
    np.testing.assert_array_equal(page["surface"], covered)
    np.testing.assert_array_equal(page["distance"], page["depth"])
    moved, valid = page["motion"](folder / "motion.png")
    np.testing.assert_array_equal(valid, covered)
    np.testing.assert_allclose(moved[valid], motion[valid][:, :2], rtol=0, atol=0.5 / 64)
    assert np.abs(moved[valid]).max() > 2.0
    parts = unchanged((folder / "parts.png").read_bytes())
    np.testing.assert_array_equal(parts.astype(int) - 1, seen.part)
    normals = np.stack([page["layers"][f"normal.{axis}"] for axis in "XYZ"], axis=-1)[covered]
    np.testing.assert_allclose(page["normal"][covered], normals, atol=0.5 / 127.5 + 1e-6)
    exact = seen.position[covered]
    # With a lens, labels are up to half a pixel of a finer image away.
    near, apart = (0.51, 0.01) if lens else (PIXEL, drawn.details["depth_scale"])
    facing = normals @ page["Rt"][2, :3] < -0.5
    assert np.abs(page["points"] - exact)[facing].max() < apart
    np.testing.assert_allclose(page["project"](exact), page["pixels"], rtol=0, atol=near)
    np.testing.assert_allclose(page["project"](page["points"]), page["pixels"], atol=1e-3)
    turned = page["normal"][covered] @ page["Rt"][:, :3].T
    assert (turned[:, 2] < 0.0).mean() > 0.9  # normals look back at the camera
    to_camera = head.to_mesh_space(seen.view.position) - exact
    cosine = (normals * to_camera).sum(axis=1) / np.linalg.norm(to_camera, axis=1)
    shown = unchanged((folder / "cosines.png").read_bytes())[..., 1][covered]  # N.V
    np.testing.assert_allclose(shown / 255, np.maximum(cosine, 0.0), atol=0.5 / 255 + 1e-5)
