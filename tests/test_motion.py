"""Tests motion vectors against rays and projections in float64, for quads with known motions, for
static surfaces, and in the files of a batch."""

from __future__ import annotations

import io
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest

import facerender as fr
from facerender.batch.outputs import draw
from facerender.scenes.lod import LevelOfDetail
from facerender.scenes.texture import Texture
from tests.verification.rays import Surface, by_opencv, camera_of

SIZE = (256, 192)
CAMERAS = fr.Camera(22.0, 6.0, zoom=1.1), fr.Camera(18.0, 5.0, zoom=1.08)  # this frame, before


@pytest.fixture(scope="module")
def drawing(backend):
    with fr.Renderer(SIZE, samples=1, backend=backend) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def skull():
    return fr.load_mesh()


def bent(mesh: fr.Mesh, amount: float) -> fr.Mesh:
    """Return the mesh bent and twisted smoothly."""
    places = mesh.normalised(np.concatenate([part.positions for part in mesh.parts]))
    x, y, z = places.T
    moved = places + amount * np.stack([np.sin(3.0 * y), np.cos(2.0 * x) * z, x * y], axis=1)
    return mesh.with_positions(mesh.to_mesh_space(moved))


def moved_away(mesh: fr.Mesh) -> fr.Mesh:
    """Return the mesh in millimetres, far from the origin."""
    offset = np.array([4e5, -2e4, 7e5])
    parts = [replace(part, positions=part.positions * 1e3 + offset) for part in mesh.parts]
    return fr.Mesh.of(mesh.name, parts, mesh.materials)


@pytest.mark.slow
def test_motion_agrees_with_rays_in_float64(skull, drawing):
    now, before = (bent(skull, amount) for amount in (0.05, -0.02))
    scene = fr.Scene(now, CAMERAS[0], before=fr.Scene(before, CAMERAS[1]))
    image = drawing.render(scene, only="motion").linear
    np.testing.assert_array_equal(
        image[..., 3] > 0.0, drawing.render(scene, only="mask").linear[..., 0] > 0.0
    )
    assert not image[..., 2].any()
    rows, columns = np.nonzero(image[..., 3])
    chosen = np.random.default_rng(0).choice(len(rows), 2000, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    centres = np.stack([columns, rows], axis=1) + 0.5
    motion = image[rows, columns, :2].astype(np.float64)

    camera, old_camera = camera_of(scene, SIZE), camera_of(scene.before, SIZE)
    surface, old_surface = Surface.of(now), Surface.of(before)
    _, index, weights = surface.hit(centres, camera)
    then = by_opencv(np.einsum("nij,ni->nj", old_surface.corners[index], weights), old_camera)
    error = np.abs(motion - (centres - then)).max(axis=1)
    assert np.hypot(*motion.T).max() > 5.0
    # At edges between two triangles the driver may see the other triangle, which is nearly the same
    # point; only at silhouettes the points are different.
    assert (error < 1e-4).mean() > 0.99
    assert np.quantile(error, 0.995) < 0.01

    # The frame before shows the same surface points at the pixels moved back, unless it hides them.
    _, old_index, old_weights = old_surface.hit(centres - motion, old_camera)
    rest = Surface.of(skull).corners
    points, old_points = (
        np.einsum("nij,ni->nj", rest[i], w) for i, w in ((index, weights), (old_index, old_weights))
    )
    pixel = 2.0 * skull.radius / SIZE[1]
    apart = np.linalg.norm(points - old_points, axis=1) / pixel
    hidden = apart > 5.0
    assert np.median(apart[~hidden]) < 0.01
    assert (apart[~hidden] < 0.1).mean() > 0.99
    assert hidden.sum() >= 5
    assert error[hidden].max() < 0.01  # hidden points have their own motion too


@pytest.mark.slow
def test_motion_warps_one_frame_into_the_next(skull, drawing):
    """Random surface points, visible in this frame, move as the image of the motion says."""
    now, before = (bent(skull, amount) for amount in (0.05, -0.02))
    scene = fr.Scene(now, CAMERAS[0], before=fr.Scene(before, CAMERAS[1]))
    image = drawing.render(scene, only="motion").linear
    surface = Surface.of(now)
    points, index = surface.points(2000, seed=3)
    pixels = by_opencv(points, camera_of(scene, SIZE))
    _, seen, _ = surface.hit(pixels, camera_of(scene, SIZE))
    a, b, c = surface.corners[index].transpose(1, 0, 2)
    weights = np.linalg.solve(np.stack([a, b, c], axis=2), points[:, :, None])[..., 0]
    old = np.einsum("nij,ni->nj", Surface.of(before).corners[index], weights)
    exact = pixels - by_opencv(old, camera_of(scene.before, SIZE))
    columns, rows = np.floor(pixels).astype(int).T
    error = np.hypot(*(image[rows, columns, :2] - exact).T)[seen == index]
    assert len(error) > 500
    assert np.median(error) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("place", [lambda mesh: mesh, moved_away], ids=["near", "far"])
def test_static_surfaces_have_no_motion(skull, drawing, place):
    mesh = place(skull)
    camera = fr.Camera(20.0, 10.0)
    for before in (mesh, mesh.with_skin(m=0.3)):
        scene = fr.Scene(mesh, camera, before=fr.Scene(before, camera))
        image = drawing.render(scene, only="motion").linear
        assert image[..., 3].sum() > 5000
        assert not image[..., :3].any()
        assert not np.signbit(image).any()
    # The moved vertices enlarge the renderer's space, in which the two poses then differ.
    positions = [part.positions.copy() for part in mesh.parts]
    eyes = next(i for i, part in enumerate(mesh.parts) if part.name == "eyeballs")
    positions[eyes][:, 2] += mesh.radius
    posed = mesh.with_positions(positions)
    assert posed.radius != mesh.radius
    scene = fr.Scene(posed, camera, before=fr.Scene(mesh, camera))
    image = drawing.render(scene, only="motion").linear
    part = drawing.render(scene, only="parts").linear[..., 0]
    assert (part == eyes + 1).any()
    assert (np.hypot(*np.moveaxis(image[part == eyes + 1, :2], -1, 0)) > 1.0).all()
    others = (part > 0) & (part != eyes + 1)
    assert others.sum() > 5000
    assert not image[others, :2].any()


def card(material: fr.Material = fr.Material(), z: float = 0.0) -> fr.Mesh:
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float64) + (0, 0, z)
    uv = corners[:, :2] * 0.5 + 0.5
    return fr.Mesh.from_arrays(corners, [(0, 1, 2), (0, 2, 3)], uv=uv, material=material)


def looking(z: float = 4.0, x: float = 0.0) -> fr.Camera:
    return fr.Camera(position=(x, 0.0, z), target=(x, 0.0, 0.0), fov=40.0)


def test_motion_of_a_quad_is_exact(drawing):
    quad = card()
    (part,) = quad.parts
    step = np.array([0.125, -0.0625, 0.0])
    moved = quad.with_positions(part.positions + step)
    focal = camera_of(fr.Scene(quad, looking()), SIZE)[0][0, 0]
    for now, then, cameras in (
        (moved, quad, (looking(), looking())),
        (quad, quad, (looking(), looking(x=0.125))),
    ):
        scene = fr.Scene(now, cameras[0], before=fr.Scene(then, cameras[1]))
        image = drawing.render(scene, only="motion").linear
        shown = image[..., 3] > 0.0
        assert shown.sum() > 3000
        expected = step[0] * focal / 4.0, (now is moved) * -step[1] * focal / 4.0
        np.testing.assert_allclose(image[shown, :2], [expected] * shown.sum(), atol=1e-5)
    turned = quad.with_positions(part.positions[:, [1, 0, 2]] * (-1, 1, 1))  # 90 degrees
    image = drawing.render(
        fr.Scene(turned, looking(), before=fr.Scene(quad, looking())), only="motion"
    ).linear
    y, x = np.nonzero(image[..., 3])
    x, y = x + 0.5 - SIZE[0] / 2, y + 0.5 - SIZE[1] / 2
    expected = np.stack([x + y, y - x], axis=1)  # before: (-y, x)
    np.testing.assert_allclose(image[image[..., 3] > 0, :2], expected, atol=1e-4)


@pytest.mark.parametrize("second", [False, True])
def test_masks_and_second_coordinates(drawing, second):
    half = np.zeros((8, 8, 3), np.uint8)
    half[:, 4:] = 255
    mask = fr.Material(
        alpha="mask",
        opacity_map=Texture.from_array(half).sampled(("clamp", "clamp"), nearest=True),
        second_uv=("opacity_map",) if second else (),
    )
    back, front = card(z=-0.5), card(mask, z=0.5)
    if second:
        (part,) = front.parts
        front = replace(front, parts=(replace(part, uv=1.0 - part.uv, uv2=part.uv),))
    mesh = fr.Mesh.of("cards", [*back.parts, *front.parts], [*back.materials, *front.materials])
    moved = mesh.with_positions([None, mesh.parts[1].positions + (0.1, 0.0, 0.0)])
    scene = fr.Scene(moved, looking(), before=fr.Scene(mesh, looking()))
    image = drawing.render(scene, only="motion").linear
    part = drawing.gbuffer(scene).part
    np.testing.assert_array_equal(image[..., 0] > 0.0, part == 1)
    assert {*np.unique(part)} == {-1, 0, 1}
    focal = camera_of(scene, SIZE)[0][0, 0]
    np.testing.assert_allclose(image[part == 1, 0], 0.1 * focal / 3.5, atol=1e-5)
    assert not image[part == 0, :2].any()


def test_points_behind_the_earlier_camera_have_no_motion(drawing):
    quad = card()
    away = fr.Camera(position=(0.0, 0.0, 0.5), target=(0.0, 0.0, 2.0))
    scene = fr.Scene(quad, looking(), before=fr.Scene(quad, away))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows"):
        assert not drawing.render(scene, only="motion").linear.any()


def test_the_frame_before_is_checked(skull, drawing):
    with pytest.raises(fr.InputError, match="^motion of head.glb needs the frame before: give "):
        drawing.render(fr.Scene(skull), only="motion")
    for other in (skull.select(hide="cornea"), card()):
        with pytest.raises(fr.InputError, match="have different triangles: give two poses of one"):
            drawing.render(fr.Scene(skull, before=fr.Scene(other)), only="motion")
    with pytest.raises(fr.InputError, match=r"^before = 3: give the facerender.Scene of the frame"):
        fr.Scene(skull, before=3)


def test_levels_of_detail_simplify_both_frames(skull, drawing):
    pytest.importorskip("meshoptimizer")
    scene = fr.Scene(bent(skull, 0.05), before=fr.Scene(bent(skull, 0.0)))
    coarse = LevelOfDetail(1, 5000).of(scene)
    assert sum(len(part.faces) for part in coarse.before.mesh.parts) <= 5000
    images = [drawing.render(each, only="motion").linear for each in (scene, coarse)]
    both = (images[0][..., 3] > 0.0) & (images[1][..., 3] > 0.0)
    assert np.median(np.abs(images[0] - images[1])[both]) < 0.05


def test_colours_show_direction_and_length():
    linear = np.zeros((1, 4, 4), np.float32)
    linear[0, :, :2] = [(2.0, 0.0), (-1.0, 0.0), (0.0, 0.0), (0.0, 1.0)]
    linear[..., 3] = 1.0
    pixels = fr.Frame(linear, "motion", False, {}).srgb8()
    expected = [[255, 0, 0], [0, 127.5, 127.5], [0, 0, 0], [63.75, 127.5, 0]]
    np.testing.assert_allclose(pixels[0], expected, atol=0.51)


@pytest.mark.slow
def test_files_of_a_batch(skull, drawing, monkeypatch):
    now, before = (bent(skull, amount) for amount in (0.05, -0.02))
    scene = fr.Scene(now, CAMERAS[0], before=fr.Scene(before, CAMERAS[1]))
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: scene)
    job = fr.Job(image=fr.ImageSettings(size=SIZE, samples=1))
    drawn = draw(job, now, drawing, ("motion", "mask", "layers"), 0.0)
    exact = drawing.render(scene, only="motion").linear
    content = np.frombuffer(drawn.files["motion.png"], np.uint8)
    valid, y, x = np.moveaxis(cv2.imdecode(content, cv2.IMREAD_UNCHANGED), -1, 0)  # BGR
    assert valid.dtype == np.uint16
    np.testing.assert_array_equal(valid, exact[..., 3])
    for steps, axis in ((x, 0), (y, 1)):
        decoded = (steps.astype(np.float64) - 2**15) / 64.0
        assert np.abs(decoded - exact[..., axis])[valid > 0].max() <= 0.5 / 64.0 + 1e-6
        assert not steps[valid == 0].any()
    with OpenEXR.File(io.BytesIO(drawn.files["layers.exr"]), separate_channels=True) as file:
        for name, axis in (("motion.X", 0), ("motion.Y", 1)):
            np.testing.assert_array_equal(file.channels()[name].pixels, exact[..., axis])
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: replace(scene, before=None))
    with pytest.raises(fr.InputError, match="motion of head.glb needs the frame before"):
        draw(job, now, drawing, ("motion",), 0.0)


def test_motion_beyond_the_range_of_a_png_is_not_valid(drawing, monkeypatch):
    quad = card()
    (part,) = quad.parts
    near = replace(looking(), fov=1.0)  # 1 unit is 2750 pixels
    moved = quad.with_positions(part.positions + (0.25, 0.01, 0.0))
    scene = fr.Scene(moved, near, before=fr.Scene(quad, near))
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: scene)
    job = fr.Job(image=fr.ImageSettings(size=SIZE, samples=1))
    content = draw(job, moved, drawing, ("motion",), 0.0).files["motion.png"]
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    valid, y, x = np.moveaxis(pixels, -1, 0)
    assert (x == 65535).all()
    assert ((y > 0) & (y < 2**15)).all()
    assert not valid.any()
