"""Tests orthographic cameras: lengths in images against the mesh, every output against float64, and
lights that follow the camera."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.batch.outputs import camera_record, transforms_frame
from facerender.drawing import reference
from facerender.loading.source import BUILT_IN
from facerender.scene.light import RIGS
from facerender.scene.view import shifted, view_of
from facerender.values.vectors import rotation_of
from tests.awkward_files import MINI_HEAD
from tests.test_cameras import glb

SIDE = fr.Camera(-60.0, 20.0, orthographic=True, frame="head")
LIGHTS = (fr.Light(30.0, 20.0, 2.0, shadow=False),)


@pytest.fixture(scope="module")
def skull():
    return fr.load_mesh()


def turned(mesh, degrees):
    """Return a mesh rotated about the y axis through the origin."""
    rotation = rotation_of((0.0, degrees, 0.0))
    return mesh.with_positions(
        {part.name: part.positions @ rotation.T for part in mesh.parts},
        {part.name: part.normals @ rotation.T for part in mesh.parts},
    )


def mirrored(mesh):
    """Return the mirror image of a mesh of one part."""
    (part,) = mesh.parts
    flip = np.array([-1.0, 1.0, 1.0])
    mirror = replace(
        part,
        positions=part.positions * flip,
        normals=part.normals * flip,
        faces=part.faces[:, ::-1].copy(),
    )
    return fr.Mesh.of(mesh.name, [mirror], mesh.materials, mesh.millimetres)


# --- lengths -------------------------------------------------------------------------------------


def test_distances_in_an_image_are_those_of_the_mesh(renderer, head):
    """Distances across the view, from the positions that the pixels show."""
    camera = replace(SIDE, view_height=0.3)
    gbuffer = renderer.gbuffer(fr.Scene(head, camera))
    view, rows = gbuffer.view, np.argwhere(gbuffer.part >= 0)
    rng = np.random.default_rng(1)
    pairs = rows[rng.integers(len(rows), size=(200, 2))]
    lengths = np.linalg.norm((pairs[:, 0] - pairs[:, 1]), axis=1) * 0.3 / 256
    a, b = (gbuffer.position[pairs[:, i, 0], pairs[:, i, 1]] for i in (0, 1))
    between = a - b
    across = between - (between @ view.forward)[:, None] * view.forward
    long = lengths > 0.03
    assert long.sum() > 20
    errors = np.linalg.norm(across, axis=1)[long] / lengths[long] - 1.0
    assert np.abs(errors).max() < 1e-3


def test_vertices_project_to_one_scale(head):
    camera = replace(SIDE, view_height=0.25)
    view, points = view_of(fr.Scene(head, camera), 1.0), head.parts[0].positions[::97]
    pixels, depth = view.project(head, points, 500)
    axes = view.extrinsics(head)
    seen = points @ axes[:, :3].T + axes[:, 3]
    np.testing.assert_allclose(pixels, 250.0 + seen[:, :2] * 500 / 0.25, atol=1e-9)
    np.testing.assert_allclose(depth, seen[:, 2], atol=1e-12)
    np.testing.assert_allclose(axes[:, :3] @ axes[:, :3].T, np.eye(3), atol=1e-12)


def test_all_views_of_a_mesh_have_one_scale(head):
    cameras = [replace(SIDE, azimuth=a, elevation=e) for a in (0.0, 70.0) for e in (-60.0, 0.0)]
    heights = [view_of(fr.Scene(head, camera), 0.8).height(head) for camera in cameras]
    np.testing.assert_allclose(heights, heights[0])
    for camera in cameras:  # the framed region is in the image
        pixels, _ = view_of(fr.Scene(head, replace(camera, frame="all")), 0.8).project(
            head, head.parts[0].positions, (80, 100)
        )
        assert (pixels > 0.0).all()
        assert (pixels < (80, 100)).all()
    zoomed = view_of(fr.Scene(head, replace(SIDE, zoom=2.0)), 0.8)
    assert zoomed.height(head) == pytest.approx(heights[0] / 2.0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"orthographic": True, "fov": 30.0}, "fov = 30.0 and orthographic exclude each other"),
        ({"view_height": 1.0, "zoom": 2.0}, "zoom = 2.0 and view_height exclude each other"),
        ({"orthographic": True, "position": (0, 0, 1)}, "need view_height"),
        ({"orthographic": True, "extrinsics": np.eye(3, 4)}, "need view_height"),
        ({"view_height": -1.0}, "view_height = -1.0"),
    ],
)
def test_fields_that_do_not_fit_are_refused(fields, message):
    with pytest.raises(fr.InputError, match=message):
        fr.Camera(**fields)


@pytest.mark.parametrize("height", [1e-7, 1e7])
def test_heights_beyond_the_precision_are_refused(head, height):
    with pytest.raises(fr.InputError, match=r"view_height = .*: give .* mesh units"):
        view_of(fr.Scene(head, fr.Camera(view_height=height)), 1.0)


def test_the_scale_is_in_the_metadata(renderer, skull):
    camera = replace(SIDE, view_height=0.256)
    assert renderer.render(fr.Scene(skull, camera)).metadata["scale"] == "1 mm per pixel"
    face, view = fr.find_face(skull), view_of(fr.Scene(skull, "front"), 1.0)
    pixels, _ = view.project(skull, face.eyes + [[0, 0, 0], [0.0, 0.001, 0.0]], 256)
    text = renderer.render(fr.Scene(skull, "front")).metadata["scale"]
    assert text.endswith(" mm per pixel at the eyes")
    across = np.linalg.norm(face.eyes[0] - face.eyes[1]) / np.abs(pixels[0, 0] - pixels[1, 0])
    assert float(text.split()[0]) == pytest.approx(1000.0 * across, rel=0.01)


# --- images --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [{}, {"scattering": "skin"}, {"second_slope": 0.4, "lobe_weight": 0.7}],
    ids=lambda changes: "-".join(changes) or "plain",
)
def test_images_against_the_reference(renderer, head, changes):
    lights = (*LIGHTS, fr.Light(-40.0, 30.0, 1.0, radius=5.0))
    scene = fr.Scene(head.with_skin(**changes), SIDE, lights, background=None)
    gbuffer = renderer.gbuffer(scene)
    expected = reference.shade(gbuffer, scene, fr.Shading())
    covered = gbuffer.part >= 0
    linear = renderer.render(scene).linear[..., :3]
    errors = np.abs(linear - expected)[covered] / expected[covered].clip(0.01)
    assert errors.max() < 2e-3
    assert np.percentile(errors, 99.0) < 1e-4


def test_images_with_blended_and_refracting_parts(renderer, skull):
    scene = fr.Scene(skull, SIDE, LIGHTS, background=None)
    gbuffer = renderer.gbuffer(scene)
    expected = reference.shade(gbuffer, scene, fr.Shading())
    linear = renderer.render(scene).linear[..., :3]
    errors = np.abs(linear - expected)[gbuffer.part >= 0]
    assert np.percentile(errors, 99.0) < 1e-4
    assert errors.max() < 0.02


def test_visible_triangles_and_all_triangles_give_one_image(renderer, egl, head):
    """Both ways to shade: only visible triangles, and all triangles (with an alpha mask)."""
    scene = fr.Scene(head, SIDE, LIGHTS)
    masked = replace(scene, mesh=head.with_skin(alpha="mask", alpha_cutoff=0.0))
    a, b = (renderer.render(each).linear for each in (scene, masked))
    assert np.percentile(np.abs(a - b), 99.5) < 1e-3


def test_data_images_against_the_gbuffer(renderer, skull):
    scene = fr.Scene(skull.select("head"), SIDE, LIGHTS)
    gbuffer = renderer.gbuffer(scene)
    frames = renderer.render_outputs(scene, ("depth", "cosines", "normal", "mask"))
    covered = gbuffer.part >= 0
    depth = frames["depth"].linear[..., 0]
    np.testing.assert_allclose(depth[covered], gbuffer.depth[covered], rtol=1e-5)
    cosine = gbuffer.normal.astype(np.float64) @ -gbuffer.view.forward
    np.testing.assert_allclose(
        frames["cosines"].linear[..., 1][covered], cosine[covered], atol=1e-5
    )


def test_the_background_of_parallel_rays_is_one_direction(renderer, head):
    panorama = np.zeros((8, 16, 3), dtype=np.float32)
    panorama[:, :8] = 1.0
    environment = fr.Environment(fr.Panorama("half", panorama))
    scene = fr.Scene(head, SIDE, environment=environment, background="environment")
    linear = renderer.render(scene).linear
    empty = renderer.render(scene, only="mask").linear[..., 3] == 0.0
    assert np.ptp(linear[empty][:, :3], axis=0).max() == 0.0


def test_landmarks_are_where_the_image_shows_them(renderer, skull):
    scene = fr.Scene(skull, fr.Camera("front", orthographic=True))
    gbuffer, part = renderer.gbuffer(scene, blended=False), skull.parts[0]
    vertices = np.arange(0, len(part.positions), 53)
    zeros = np.zeros(len(vertices), dtype=int)
    corners, weights = np.stack([vertices, zeros, zeros], axis=1), np.zeros((len(vertices), 3))
    weights[:, 0] = 1.0
    names = tuple(map(str, vertices))
    landmarks = fr.Landmarks(names, corners, weights, (part.name,) * len(vertices))
    pixels, depth, visible = renderer.landmarks(scene, landmarks)
    assert 0.2 < visible.mean() < 0.8
    column, row = pixels[visible].astype(int).T
    shown = gbuffer.position[row, column]
    away = np.linalg.norm(shown - part.positions[vertices][visible], axis=1)
    assert np.median(away) < 0.002  # a pixel is 1.4 mm wide
    assert np.isfinite(depth).all()


def test_motion_of_a_moved_camera_is_the_same_everywhere(renderer, head):
    before = fr.Scene(head, replace(SIDE, azimuth=0.0, elevation=0.0, view_height=0.4))
    camera = replace(before.camera, target=(0.01, 0.005, 0.0))
    still = fr.Scene(head, replace(before.camera, target=(0.0, 0.0, 0.0)))
    motion = renderer.render(replace(still, camera=camera, before=still), only="motion").linear
    moved = motion[motion[..., 3] > 0.0][:, :2]
    np.testing.assert_allclose(
        moved, np.array([[-0.01, 0.005]] * len(moved)) * 256 / 0.4, atol=1e-4
    )


def test_a_shifted_image_is_moved_by_pixels(renderer, head):
    scene = fr.Scene(head, SIDE, LIGHTS)
    a = renderer.render(scene).linear
    b = renderer.render(shifted(scene, 5.0, -3.0, 256)).linear
    np.testing.assert_allclose(b[:-3, 5:], a[3:, :-5], atol=2e-3)


# --- files ---------------------------------------------------------------------------------------


def test_records_of_batches_are_cameras(renderer, head, tmp_path):
    scene = fr.Scene(head, SIDE)
    view = view_of(scene, 4.0 / 3.0)
    record = camera_record(view, head, (160, 120))
    (tmp_path / "rig.json").write_text(json.dumps(record))
    (camera,) = fr.load_cameras(tmp_path / "rig.json").values()
    again = view_of(fr.Scene(head, camera), 4.0 / 3.0)
    np.testing.assert_allclose(again.matrix[:, :2], view.matrix[:, :2], atol=1e-9)
    np.testing.assert_allclose(again.position, view.position, atol=1e-9)
    with pytest.raises(fr.InputError, match=r"a\.png: its camera is orthographic.*--transforms"):
        transforms_frame(record, "a.png")


def test_orthographic_cameras_of_gltf_files(tmp_path):
    cameras = [{"type": "orthographic", "orthographic": {"xmag": 0.2, "ymag": 0.15}}]
    path = glb(tmp_path, [{"camera": 0, "name": "top", "translation": [0, 0, 2]}], cameras)
    mesh, camera = fr.load_mesh(path), fr.load_cameras(path)["top"]
    assert camera.view_height == pytest.approx(0.3)
    pixels, depth = view_of(fr.Scene(mesh, camera), 1.0).project(mesh, np.array([[0, 0.15, 0]]), 60)
    np.testing.assert_allclose(pixels, [[30.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(depth, [2.0])


def test_the_side_of_a_pixel_in_millimetres(cli):
    data = cli.describe("--mm-per-pixel", "2", "--size", "200x160", mesh=BUILT_IN)
    assert data["scale"] == "2 mm per pixel"
    assert "view_height=0.32" in data["camera"]


def test_a_guessed_unit_gives_no_scale(cli, tmp_path):
    corners = np.random.default_rng(1).normal(size=(50, 3)) * 0.07
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [
        f"f {i} {i + 1} {i + 2}" for i in range(1, 48)
    ]
    (tmp_path / "blob.obj").write_text("\n".join(lines))
    line = ["render", tmp_path / "blob.obj", "--mm-per-pixel", "1", "-o", cli.png]
    cli.fail("1 mm per pixel needs the unit of blob.obj: .*--millimetres", *line)
    assert cli.run(*line, "--millimetres", "1000", "--size", "32")[0] == 0


# --- standard views and lights that follow -------------------------------------------------------


def test_standard_views_by_name(head):
    assert [*fr.STANDARD_VIEWS] == [
        *("frontal", "right-oblique", "left-oblique", "right-lateral", "left-lateral"),
        *("basal", "superior"),
    ]
    heights = set()
    for name, camera in fr.STANDARD_VIEWS.items():
        scene = fr.Scene(head, name)
        view, same = view_of(scene, 1.0), view_of(replace(scene, camera=camera), 1.0)
        np.testing.assert_array_equal(view.matrix, same.matrix)
        heights.add(round(view.height(head), 9))
    assert len(heights) == 1
    # The right side of a subject that looks along +z is at -x.
    assert view_of(fr.Scene(head, "right-lateral"), 1.0).forward[0] == pytest.approx(1.0)
    assert view_of(fr.Scene(head, "basal"), 1.0).forward[1] > 0.5


def test_the_standard_views_of_a_command_and_a_scene_file(cli, tmp_path):
    cli.run("render", "--camera", "standard", "--size", "32", "-o", cli.folder / "a-{name}.png")
    assert cli.written == sorted(f"a-{name}.png" for name in fr.STANDARD_VIEWS)
    (tmp_path / "scene.toml").write_text("cameras = 'standard'\n")
    job = fr.Job.load(tmp_path / "scene.toml")
    assert job.cameras == (*fr.STANDARD_VIEWS.values(),)


def test_the_standard_views_of_a_batch(cli, tmp_path):
    table = "image.size = 32\nlights = 'softbox'\n[grid]\ncamera = 'standard'\n"
    (tmp_path / "jobs.toml").write_text(table)
    line = ["batch", tmp_path / "jobs.toml", "--mesh", MINI_HEAD, "--workers", "1", "--quiet"]
    assert cli.run(*line, "-o", cli.folder)[0] == 0
    records = [json.loads(row) for row in (cli.folder / "jobs.jsonl").read_text().splitlines()]
    assert len(records) == len(fr.STANDARD_VIEWS)
    heights = [record["camera"]["view_height"] for record in records]
    assert heights == pytest.approx([heights[0]] * len(heights))
    assert [record["job"]["lights"][0]["follow"] for record in records] == [True] * len(records)


def test_following_lights_turn_with_the_camera(renderer, head):
    """The image of a mesh that turns with the camera stays the same, except for rounding."""
    lights = (
        fr.Light(30.0, 20.0, 2.0, follow=True),
        fr.Light(-45.0, 10.0, 1.0, radius=4.0, follow=True),
    )
    camera = fr.Camera("front", target=(0.0, 0.0, 0.0))
    straight = renderer.render(fr.Scene(head, camera, lights)).linear
    around = replace(camera, azimuth=40.0)
    moved = renderer.render(fr.Scene(turned(head, 40.0), around, lights)).linear
    fixed = tuple(replace(light, follow=False) for light in lights)
    others = renderer.render(fr.Scene(turned(head, 40.0), around, fixed)).linear
    assert np.percentile(np.abs(moved - straight), 99.0) < 0.02
    assert np.percentile(np.abs(others - straight), 99.0) > 0.2


@pytest.mark.parametrize("view", ["basal", "superior", "left-oblique"])
def test_following_lights_against_the_reference(renderer, head, view):
    scene = fr.Scene(head, view, "softbox", background=None)
    gbuffer = renderer.gbuffer(scene)
    expected = reference.shade(gbuffer, scene, fr.Shading())
    covered = gbuffer.part >= 0
    errors = np.abs(renderer.render(scene).linear[..., :3] - expected)[covered]
    assert np.percentile(errors, 99.0) < 1e-4
    assert errors.max() < 1e-3
    # The light comes from the camera's side.
    assert expected[covered].mean() > 0.12


def test_profiles_of_a_mirrored_mesh_are_mirrored_images(head):
    with fr.Renderer(192, samples=4) as renderer:
        left, right = (
            renderer.render(fr.Scene(mesh, camera, "softbox"))
            for mesh, camera in ((head, "left-lateral"), (mirrored(head), "right-lateral"))
        )
        fixed = renderer.render(fr.Scene(mirrored(head), "right-lateral", "portrait"))
    mirror = right.srgb8()[:, ::-1].astype(float)
    assert np.abs(left.srgb8() - mirror).mean() < 1.0
    assert np.abs(left.srgb8() - fixed.srgb8()[:, ::-1].astype(float)).mean() > 5.0


def test_rigs_by_name(head, cli):
    assert fr.Scene(head, lights="softbox").lights == RIGS["softbox"]
    assert fr.Scene(head).lights == RIGS["portrait"] == fr.Scene(head, lights="portrait").lights
    assert (
        fr.Scene(head, lights=["softbox", "rim"]).lights[3]
        == fr.Scene(head, lights="rim").lights[0]
    )
    light = cli.describe("--lights", "softbox")["light 0"]
    assert cli.describe("--light", "-45,20,1.3,radius=20,follow")["light 0"] == light
    assert "follow=True" in light


def test_a_point_light_does_not_follow():
    with pytest.raises(fr.InputError, match="follow = True and position exclude each other"):
        fr.Light(position=(1.0, 2.0, 3.0), follow=True)


def test_the_explorer_names_what_it_cannot_draw(cli):
    page = cli.folder / "a.html"
    cli.fail("needs a perspective camera", "explore", "--camera", "frontal", "-o", page)
    _, _, err = cli.run("explore", "--lights", "softbox", "-o", page)
    assert "the motion of lights with the camera" in err
