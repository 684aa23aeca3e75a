"""Tests lens distortion: the model against OpenCV, labels against rays that the test casts,
radiance against a supersampled image, and the values that cameras accept."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import trimesh

import facerender as fr
from facerender.batch.outputs import camera_record, transforms_frame
from facerender.images.image import linear_to_srgb
from facerender.scene.camera import distort, jacobian, undistort
from facerender.scene.scene import DATA
from facerender.scene.view import view_of
from tests.awkward_files import MINI_HEAD
from tests.verification.rays import Surface

SIZE = (160, 120)
K = ((150.0, 0.0, 86.0), (0.0, 140.0, 57.0), (0.0, 0.0, 1.0))
TYPICAL = (-0.28, 0.07, 2e-4, -1e-4)
STRONG = (-0.4, 0.2, 2e-4, -1e-4, 0.0, 0.0, 0.0, 0.05)
PINCUSHION = (0.3, 0.1, -2e-3, 1e-3, 0.05)
LENSES = [TYPICAL, STRONG, PINCUSHION, (-0.1, 0.02, 0.01, -0.02, 0.0, 0.2, 0.1, 0.0)]
lenses = pytest.mark.parametrize("lens", LENSES, ids=["typical", "strong", "pincushion", "tilted"])


def pose_of(mesh, distance):
    """Return [R|t] of a camera in front of a mesh; the distance is in radii of the mesh."""
    turn = np.diag([1.0, -1.0, -1.0])
    return np.column_stack([turn, [0.0, 0.0, distance * mesh.radius] - turn @ mesh.center])


def camera_of(mesh, lens, distance=2.6, **changes):
    own = {"extrinsics": pose_of(mesh, distance), "intrinsics": K, "size": SIZE} | changes
    return fr.Camera(**own, distortion=lens)


def bent(points, lens):
    """The model as in OpenCV's documentation, for points (N, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens, *[0.0] * 4)[:8]
    x, y = points.T
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def straight(points, lens):
    """Invert ``bent`` by fixed-point iteration."""
    found = points
    for _ in range(2000):
        off = points - bent(found, lens)
        if np.abs(off).max() < 1e-12:
            return found
        found = found + 0.7 * off
    raise AssertionError("the iteration does not converge")


def centres(size, per_pixel=1):
    axes = (np.arange(side * per_pixel) / per_pixel + 0.5 / per_pixel for side in size)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def normalised(pixels, k=K):
    k = np.array(k)
    return (pixels - k[:2, 2]) / k[[0, 1], [0, 1]]


@pytest.fixture(scope="module")
def drawing(egl):
    with fr.Renderer(SIZE, samples=1, backend=egl) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def mini():
    return fr.load_mesh(MINI_HEAD)


@pytest.fixture(scope="module")
def balls():
    """A sphere of 1280 triangles behind a smaller sphere, as two parts."""
    small = trimesh.creation.icosphere(2, 0.4)
    small.apply_translation([0.5, 0.3, 1.0])
    return fr.load_mesh(trimesh.Scene([trimesh.creation.icosphere(3), small]))


# --- model ---------------------------------------------------------------------------------------


@lenses
@pytest.mark.parametrize("scale", [1, 3])
def test_projection_agrees_with_opencv(mini, lens, scale):
    """OpenCV's first pixel has its centre at (0, 0), here at (0.5, 0.5)."""
    camera, size = camera_of(mini, lens), (scale * SIZE[0], scale * SIZE[1])
    view = view_of(fr.Scene(mini, camera), SIZE[0] / SIZE[1])
    points = np.concatenate([part.positions for part in mini.parts])
    pixels, depth = view.project(mini, points, size)
    assert not np.isnan(pixels).any()
    k, pose = np.array(K), np.array(camera.extrinsics)
    k[:2] *= scale
    k[:2, 2] -= 0.5
    wanted, _ = cv2.projectPoints(
        points.astype(float), cv2.Rodrigues(pose[:, :3])[0], pose[:, 3], k, np.array(lens)
    )
    np.testing.assert_allclose(pixels, wanted[:, 0] + 0.5, rtol=0, atol=1e-6)
    np.testing.assert_allclose(depth, points @ pose[2, :3] + pose[2, 3], rtol=1e-9)


@lenses
def test_undistort_inverts_distort(lens):
    points = np.random.default_rng(1).uniform(-0.6, 0.6, (5000, 2))
    found = distort(points, lens)
    np.testing.assert_allclose(found, bent(points, lens), rtol=0, atol=1e-14)
    inverse = undistort(found, lens)
    np.testing.assert_allclose(inverse, points, rtol=0, atol=1e-9)
    np.testing.assert_allclose(distort(inverse, lens), found, rtol=0, atol=1e-12)
    steps = [(np.array([1e-6, 0]), 0), (np.array([0, 1e-6]), 1)]
    for step, axis in steps:
        slope = (bent(points + step, lens) - bent(points - step, lens)) / 2e-6
        np.testing.assert_allclose(jacobian(points, lens)[:, :, axis], slope, rtol=0, atol=1e-8)


def test_points_that_no_pixel_shows(mini):
    lens = (-0.25, 0.0, 0.0, 0.0)
    view = view_of(fr.Scene(mini, camera_of(mini, lens)), SIZE[0] / SIZE[1])
    eye = mini.to_mesh_space(view.position)
    ahead, aside = mini.radius * view.forward, mini.radius * np.array([1.0, 0.0, 0.0])
    points = eye + np.array([ahead, ahead + 1.2 * aside, -ahead])
    pixels, depth = view.project(mini, points, SIZE)
    assert np.isnan(pixels).all(axis=-1).tolist() == [False, True, True]
    np.testing.assert_allclose(depth / mini.radius, [1.0, 1.0, -1.0])
    np.testing.assert_allclose(pixels[0], [K[0][2], K[1][2]], atol=1e-9)
    with pytest.raises(fr.InputError, match=r"points has the shape \(3,\): give \(N, 3\)"):
        view.project(mini, eye, SIZE)


# --- cameras -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": (1.0, 2.0)}, "camera distortion = (1.0, 2.0): give 4, 5 or 8 numbers"),
        ({"distortion": "k1"}, "camera distortion = 'k1': give 4, 5 or 8 numbers"),
        ({"distortion": (0.0,) * 11 + (1.0,)}, "without thin prism and tilt"),
        ({"distortion": (0.1, "a", 0, 0)}, "give numbers in [-1e+06, 1e+06]"),
        ({"distortion": (0.1, np.nan, 0, 0)}, "give numbers in [-1e+06, 1e+06]"),
        ({"distortion": (0.1, 2e6, 0, 0)}, "give numbers in [-1e+06, 1e+06]"),
        ({"intrinsics": None, "size": None}, "camera distortion needs intrinsics: give K"),
        (
            {"distortion": (-1.2, 0.0, 0.0, 0.0)},
            # The fold is at a distorted radius of 2/3 sqrt(1/3.6), and fy is 140 pixels.
            "is not invertible 50 pixels from the principal point, inside the image of 160 x 120",
        ),
        ({"distortion": (0.0, 0.0, 3.0, 0.0)}, "is not invertible"),
    ],
)
def test_invalid_distortions_are_refused(mini, changes, message):
    own = {"extrinsics": pose_of(mini, 3), "intrinsics": K, "size": SIZE, "distortion": TYPICAL}
    with pytest.raises(fr.InputError, match=re.escape(message)) as caught:
        fr.Camera(**own | changes)
    assert "\n" not in str(caught.value)


def test_distortions_that_are_equal(mini):
    assert camera_of(mini, (0, 0, 0, 0.0)) == camera_of(mini, None)
    wanted = camera_of(mini, TYPICAL)
    assert wanted.distortion == TYPICAL
    assert camera_of(mini, np.array([TYPICAL])) == wanted
    # OpenCV's calibration returns 14 numbers for a rational model.
    assert camera_of(mini, np.array([(*STRONG, *[0.0] * 6)])).distortion == STRONG
    assert {each.distortion for each in fr.turntable(wanted, 3)} == {None}


def test_files_hold_distortions(mini, tmp_path):
    wanted = camera_of(mini, STRONG)
    table = {"K": K, "Rt": pose_of(mini, 2.6).tolist(), "width": 160, "height": 120}
    path = tmp_path / "rig.json"
    for key in ("dist", "distortion", "distCoeffs", "D"):
        for value in (STRONG, [STRONG], [[each] for each in STRONG]):
            path.write_text(json.dumps(table | {key: value}))
            assert [*fr.load_cameras(path).values()] == [wanted]
    path = tmp_path / "rig.npz"
    two = {**table, "Rt": [table["Rt"]] * 2}
    column = np.array(STRONG)[:, None]
    for value in (STRONG, column, column.T, [STRONG, STRONG], [column, column]):
        np.savez(path, D=value, **two)
        assert [*fr.load_cameras(path).values()] == [wanted, wanted]
    other = replace(wanted, distortion=TYPICAL)
    np.savez(path, dist=[[*TYPICAL, *[0.0] * 4], STRONG], **two)
    first, second = fr.load_cameras(path).values()
    assert first.distortion == (*other.distortion, *[0.0] * 4)
    assert second == wanted
    job = fr.Job(camera=wanted)
    assert fr.Job.from_dict(json.loads(json.dumps(job.as_dict()))) == job
    (tmp_path / "job.toml").write_text(
        "[camera]\n" + job.toml().split("[camera]\n")[1].split("\n\n")[0]
    )
    scene = fr.load_scene(tmp_path / "job.toml")
    assert scene["camera"] == wanted


def test_records_and_transforms_hold_distortions(mini, tmp_path):
    view = view_of(fr.Scene(mini, camera_of(mini, PINCUSHION)), SIZE[0] / SIZE[1])
    facts = camera_record(view, mini, SIZE)
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(facts))
    (again,) = fr.load_cameras(path).values()
    assert again.distortion == PINCUSHION
    frame = transforms_frame(facts, "a.png")
    # nerfstudio's OPENCV model: its k4 multiplies r^8.
    assert tuple(frame[key] for key in ("k1", "k2", "p1", "p2", "k3")) == PINCUSHION
    assert "k4" not in frame
    view = replace(view, distortion=STRONG)
    with pytest.raises(fr.InputError, match=r"^a.png: .* k4 to k6, which transforms.json cannot"):
        transforms_frame(camera_record(view, mini, SIZE), "a.png")
    plain = camera_record(replace(view, distortion=None), mini, SIZE)
    assert "distortion" not in plain
    assert "k1" not in transforms_frame(plain, "a.png")


# --- images --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens",
    [STRONG, *(pytest.param(own, marks=pytest.mark.slow) for own in LENSES if own != STRONG)],
)
def test_labels_are_those_of_distorted_rays(drawing, balls, lens):
    camera = camera_of(balls, lens, 2.2)
    scene = fr.Scene(balls, camera)
    seen = drawing.gbuffer(scene)
    pose = np.array(camera.extrinsics)
    flat = straight(normalised(centres(SIZE)), lens)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ pose[:, :3]  # of depth 1
    origin = -pose[:, :3].T @ pose[:, 3]
    surface = Surface.of(balls)
    depth, face, _ = surface.hit(flat, (np.eye(3), pose))
    part = np.where(depth < np.inf, surface.part[face], -1).reshape(SIZE[::-1])
    a, b, c = surface.corners[face].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(rays, axis=-1)
    cosine = np.abs((normals * rays).sum(axis=-1)) / lengths

    # Labels differ at silhouettes only, in the adjacent pixels.
    padded = np.pad(part, 1, mode="edge")
    height, width = part.shape
    around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    inside = np.all([each == part for each in around], axis=0)
    assert set(part[inside].tolist()) == {-1, 0, 1}
    assert inside.mean() > 0.85
    assert (seen.part == part)[inside].all()
    assert (seen.part == part).mean() > 0.985
    parts = drawing.render(scene, only="parts").linear[..., 0]
    assert np.array_equal(parts, seen.part + 1)
    assert np.array_equal(drawing.render(scene, only="mask").linear[..., 0], parts > 0)

    # The position is at most half a pixel's footprint, on each axis, from the ray's hit.
    own = inside & (part >= 0)
    places = seen.position[own]
    z = depth[own.ravel()]
    footprint = z / np.array(K)[[0, 1], [0, 1]].min() / cosine[own.ravel()]
    off = np.linalg.norm(places - (origin + z[:, None] * rays[own.ravel()]), axis=-1)
    clear = cosine[own.ravel()] > 0.3
    stretch = np.linalg.norm(np.linalg.inv(jacobian(flat, lens)), 2, axis=(1, 2)).max()
    assert (off / footprint)[clear].max() < 0.75 * max(stretch, 1.0)
    pixels, _ = seen.view.project(balls, places, SIZE)
    assert np.abs(pixels - centres(SIZE)[own.ravel()]).max() < 0.51
    drawn = drawing.render(scene, only="depth").linear[own][:, 0]
    _, depths = seen.view.project(balls, places, SIZE)
    np.testing.assert_allclose(drawn, depths, rtol=1e-6)
    assert np.array_equal(drawing.render(scene, only="normal").linear[own][:, :3], seen.normal[own])


def supersampled(mesh, lens, backend, camera, count=4):
    """Return the mean of count^2 rays per pixel, (H, W, 4), read from a finer undistorted image."""
    pixels = centres(SIZE, count)
    flat = normalised(pixels)
    places = (straight(flat, lens) if lens else flat) * np.array(K)[[0, 1], [0, 1]] * count
    low = np.floor(places.min(axis=0)) - 2
    size = tuple((np.ceil(places.max(axis=0)) - low + 2).astype(int).tolist())
    k = ((count * K[0][0], 0.0, -low[0]), (0.0, count * K[1][1], -low[1]), (0.0, 0.0, 1.0))
    fine = replace(camera, intrinsics=k, size=size, distortion=None)
    with fr.Renderer(size, samples=1, backend=backend) as renderer:
        image = renderer.render(fr.Scene(mesh, fine)).linear
    x, y = (places - low).astype(int).T
    width, height = SIZE
    return image[y, x].reshape(height, count, width, count, 4).mean(axis=(1, 3))


def levels(image, wanted):
    """Return the error of each covered pixel in 8-bit levels."""
    first, second = (linear_to_srgb(np.clip(each[..., :3], 0, 1)) for each in (image, wanted))
    return 255.0 * np.abs(first - second).max(axis=-1)[wanted[..., 3] > 0.0]


@pytest.mark.slow
@pytest.mark.parametrize("lens", [TYPICAL, STRONG, PINCUSHION], ids=["typical", "strong", "pin"])
def test_radiance_is_that_of_a_supersampled_image(mini, egl, drawing, lens):
    """A distorted image is as near to its reference as an image without distortion to its own."""
    errors = []
    for own in (None, lens):
        camera = camera_of(mini, own)
        image = drawing.render(fr.Scene(mini, camera), samples=4).linear
        errors.append(levels(image, supersampled(mini, own, egl, camera)))
    plain, bent_ = errors
    assert bent_.mean() < 1.25 * plain.mean() + 0.1
    assert np.quantile(bent_, 0.99) < 1.3 * np.quantile(plain, 0.99)


def dark(mesh, **changes):
    lights = (fr.Light(40.0, 30.0, radius=3.0, shadow=True),)
    return fr.Scene(mesh, lights=lights, **changes)


SCENES = {
    "plain": lambda mesh: fr.Scene(mesh),
    "transparent": lambda mesh: fr.Scene(mesh, background=None),
    "shadows": dark,
    "scattering": lambda mesh: fr.Scene(mesh.with_material(("head",), scattering="skin")),
}


@pytest.fixture(scope="module")
def whole():
    """The built-in head, with blended parts."""
    return fr.load_mesh()


@pytest.mark.first_case
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("samples", [1, 4, 16])
def test_slight_distortion_changes_no_pixel(drawing, whole, name, samples):
    """The undistorted image then has the same pixels, and a margin."""
    scene = SCENES[name](whole)
    images = [
        drawing.render(replace(scene, camera=camera_of(whole, lens)), samples=samples)
        for lens in (None, (1e-7, 0.0, 0.0, 0.0))
    ]
    one, other = (dict(image.metadata) for image in images)
    assert one.pop("camera") != other.pop("camera")
    assert one == other
    assert images[0].transparent == images[1].transparent
    assert images[1].linear.dtype == np.float32
    off = np.abs(images[0].linear - images[1].linear).max(axis=-1)
    # Rounding may move samples of edges, and the 2 x 2 pixels that share a mip level differ: 0.4 %
    # of the pixels on llvmpipe, 0.6 % on an NVIDIA GPU.
    assert (off > 0.01).mean() < 7e-3
    assert off.mean() < 5e-4
    assert np.abs(images[0].linear[..., 3] - images[1].linear[..., 3]).mean() < 1e-4


def test_slight_distortion_changes_no_label(drawing, whole):
    scene = dark(whole)
    first, second = (
        drawing.gbuffer(replace(scene, camera=camera_of(whole, lens)))
        for lens in (None, (1e-7, 0.0, 0.0, 0.0))
    )
    assert len(first.transparent_layers) == len(second.transparent_layers) > 0
    pairs = zip(
        (first, *first.transparent_layers), (second, *second.transparent_layers), strict=True
    )
    for one, other in pairs:
        for each in fields(one):
            a, b = getattr(one, each.name), getattr(other, each.name)
            if isinstance(a, np.ndarray):
                same = np.isclose(a, b, atol=5e-3).reshape(*SIZE[::-1], -1).all(axis=-1)
                assert same.mean() > 0.985, each.name
    assert second.view.distortion
    assert (second.visibility[second.part >= 0] < 0.5).any()


def test_terms_of_a_distorted_scene(drawing, whole):
    """Coverage and terms agree with the G-buffer; the sum of the terms is the image."""
    scene = dark(whole, camera=camera_of(whole, STRONG), background=None)
    scene = replace(scene, before=scene)
    seen = drawing.gbuffer(scene, blended=False)
    assert (drawing.render(scene, only="motion").linear[..., :2] == 0.0).all()
    images = {only: drawing.render(scene, only=only).linear for only in DATA}
    for image in images.values():
        assert np.array_equal(image[..., 3], images["mask"][..., 0])
    same = images["parts"][..., 0] == seen.part + 1  # no lashes
    assert same.mean() > 0.99
    assert np.array_equal(images["albedo"][same, :3], seen.albedo[same])
    image = drawing.render(scene, samples=4).linear
    assert (image >= 0.0).all()
    assert image[..., 3].max() == 1.0
    assert (image[image[..., 3] == 0.0] == 0.0).all()  # premultiplied
    ratio = image[..., :3].max(axis=-1) / np.maximum(image[..., 3], 1e-6)
    assert ratio.max() < 2.0


@pytest.mark.parametrize("lit", [{"lights": ()}, {"environment": "studio"}], ids=["dark", "studio"])
def test_terms_of_a_distorted_scene_without_lights(drawing, mini, lit):
    scene = fr.Scene(mini, camera_of(mini, STRONG), background=None, **lit)
    scene = replace(scene, before=scene)
    covered = drawing.gbuffer(scene).part >= 0
    for only in DATA:
        assert np.array_equal(drawing.render(scene, only=only).linear[..., 3], covered)


def test_threads_draw_through_different_lenses(egl, mini):
    """A renderer frees the layers of another lens only after they are read."""
    mesh = mini.with_material(alpha="blend", opacity=0.5)
    scenes = [fr.Scene(mesh, camera_of(mini, lens)) for lens in (STRONG, PINCUSHION)] * 4
    with fr.Renderer(SIZE, samples=1, backend=egl) as renderer, ThreadPoolExecutor(2) as pool:
        expected = [renderer.gbuffer(scene).transparent_layers for scene in scenes[:2]]
        found = pool.map(lambda scene: renderer.gbuffer(scene).transparent_layers, scenes)
        for layers, wanted in zip(found, expected * 4, strict=True):
            assert len(layers) == len(wanted) > 1
            for one, other in zip(layers, wanted, strict=True):
                np.testing.assert_array_equal(one.part, other.part)


def test_shifted_scenes_keep_their_distortion(drawing, mini):
    scene = fr.Scene(mini, camera_of(mini, STRONG))
    moved = fr.shifted(scene, 3.0, -2.0, SIZE)
    assert moved.camera.distortion == STRONG
    points = mini.parts[0].positions[::50].astype(float)
    first, second = (
        view_of(each, SIZE[0] / SIZE[1]).project(mini, points, SIZE)[0] for each in (scene, moved)
    )
    np.testing.assert_allclose(second - first, [[3.0, -2.0]] * len(points), atol=1e-9)
    images = [drawing.render(each, samples=4).linear for each in (scene, moved)]
    off = np.abs(images[0][2:, :-3] - images[1][:-2, 3:]).max(axis=-1)
    assert (off > 0.01).mean() < 5e-3
    assert off.mean() < 5e-4


def test_images_that_show_nothing(drawing, mini):
    camera = camera_of(mini, STRONG)
    pose = np.array(camera.extrinsics)
    pose[0, 3] += 5.0 * mini.radius
    beside = replace(camera, extrinsics=pose)
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows .*: it lies right of the frame"):
        drawing.render(fr.Scene(mini, beside))


def test_images_of_another_shape_are_refused(renderer, mini):
    scene = fr.Scene(mini, camera_of(mini, STRONG))
    for only in (None, "depth"):
        with pytest.raises(fr.InputError, match="are for images of 160 x 120 pixels"):
            renderer.render(scene, only=only)


def test_undistorted_images_have_a_limit(egl, mini):
    size = (16384, 2)
    k = ((9000.0, 0.0, 8192.0), (0.0, 9000.0, 1.0), (0.0, 0.0, 1.0))
    camera = camera_of(mini, TYPICAL, intrinsics=k, size=size)
    with (
        fr.Renderer(size, samples=1, backend=egl) as renderer,
        pytest.raises(fr.InputError, match=r"undistorted image of \d+ x \d+ pixels, but the limit"),
    ):
        renderer.render(fr.Scene(mini, camera))
