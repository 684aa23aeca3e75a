"""Tests cameras given as matrices K [R|t], in Python and in files, and cameras of glTF files."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from pyrr import Matrix33, Matrix44, Quaternion, Vector3

import facerender as fr
from facerender.scene.view import view_of
from facerender.values.vectors import rotation_of
from tests.awkward_files import MINI_HEAD, join_glb, split_glb
from tests.meshes import with_geometry

SIZE = (120, 90)
K = [[310.0, 0.0, 71.25], [0.0, 255.0, 38.5], [0.0, 0.0, 1.0]]


def pose_of(mesh, azimuth, tilt, distance):
    """Return [R|t] of a camera around a mesh, rolled by ``tilt``; angles are in degrees."""
    a, b = np.radians([azimuth, tilt])
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    roll = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    r = roll @ np.diag([1.0, -1.0, -1.0]) @ turn
    return np.column_stack([r, [0.0, 0.0, distance * mesh.radius] - r @ mesh.center])


def seen(mesh, camera, size=SIZE):
    with fr.Renderer(size, samples=1) as renderer:
        return renderer.gbuffer(fr.Scene(mesh, camera))


def projected(k, pose, points):
    x, y, z = np.asarray(k) @ (np.asarray(pose) @ np.column_stack([points, np.ones(len(points))]).T)
    return np.stack([x / z, y / z], axis=-1)


def glb(tmp_path, nodes, cameras):
    """Write the small head with cameras and further nodes; nodes without a parent are roots."""
    document, binary = split_glb(MINI_HEAD.read_bytes())
    document["cameras"] = cameras
    first = len(document["nodes"])
    document["nodes"] += nodes
    below = {child for node in nodes for child in node.get("children", ())}
    document["scenes"][0]["nodes"] += {*range(first, first + len(nodes))} - below
    path = tmp_path / "head.glb"
    path.write_bytes(join_glb(document, binary))
    return path


@pytest.fixture(scope="module")
def mini():
    return fr.load_mesh(MINI_HEAD)


def test_named_cameras_see_one_side_of_the_face(mini):
    """In profile and at three quarters, the nose points to the right."""
    tip = mini.parts[0].positions[mini.parts[0].positions[:, 2].argmax()]
    for name in ("three-quarter", "profile"):
        scene = fr.Scene(mini, name)
        pixels, _ = view_of(scene, 1.0).project(mini, tip[None] * (0.0, 1.0, 1.0), (100, 100))
        assert pixels[0, 0] > 55.0, name


def test_rotations_about_fixed_axes():
    """Rotations about x, then y, then z; multiples of 90 degrees are exact."""
    x, y, z = np.eye(3)
    assert (rotation_of((90.0, 0.0, 0.0)) @ y).tolist() == [0.0, 0.0, 1.0]
    assert (rotation_of((0.0, -270.0, 0.0)) @ z).tolist() == [1.0, 0.0, 0.0]
    assert (rotation_of((0.0, 0.0, 3690.0)) @ x).tolist() == [0.0, 1.0, 0.0]
    apart = [rotation_of(angles) for angles in np.diag([10.0, 20.0, 30.0])]
    np.testing.assert_allclose(
        rotation_of((10.0, 20.0, 30.0)), apart[2] @ apart[1] @ apart[0], rtol=0, atol=1e-15
    )
    assert np.isclose(apart[0][2, 1], 0.17364817766693033)  # sin 10


@pytest.mark.parametrize(("azimuth", "tilt"), [(0.0, 0.0), (35.0, -20.0), (160.0, 90.0)])
def test_matrices_project_points_to_their_pixels(mini, azimuth, tilt):
    """In K, fx differs from fy, and the principal point is off the centre."""
    pose = pose_of(mini, azimuth, tilt, 5.0)
    camera = fr.Camera(extrinsics=pose, intrinsics=K, size=SIZE)
    buffer = seen(mini, camera)
    rows, columns = np.nonzero(buffer.part >= 0)
    assert len(rows) > 500
    found = projected(K, pose, buffer.position[rows, columns])
    np.testing.assert_allclose(found, np.column_stack([columns, rows]) + 0.5, atol=2e-3)
    np.testing.assert_allclose(buffer.view.intrinsics(SIZE), K, atol=1e-9)
    np.testing.assert_allclose(buffer.view.extrinsics(mini), pose, atol=1e-12 + 1e-9 * mini.radius)


def test_intrinsics_scale_with_the_image_size(mini):
    camera = fr.Camera(extrinsics=pose_of(mini, 0, 0, 5), intrinsics=K, size=SIZE)
    twice = view_of(fr.Scene(mini, camera), 4 / 3).intrinsics((240, 180))
    np.testing.assert_allclose(twice[:2], 2.0 * np.array(K)[:2], atol=1e-9)
    with pytest.raises(fr.InputError, match="are for images of 120 x 90 pixels: give a size with"):
        view_of(fr.Scene(mini, camera), 1.0)


# --- constructors of other conventions -----------------------------------------------------------


def test_conventions_agree(mini):
    """Matrices, vectors and quaternions of pyrr, in row and column form, state one camera."""
    eye, up = mini.center + np.array([1.5, 0.7, 4.0]) * mini.radius, (0.3, 1.0, 0.1)
    view = Matrix44.look_at(eye, mini.center, up)
    lens = Matrix44.perspective_projection(30.0, SIZE[0] / SIZE[1], 0.1, 100.0)
    to_world, rows = view.inverse, {"projection": lens, "size": SIZE}
    columns = {"projection": np.array(lens).T.tolist(), "size": SIZE}
    pose = np.array(view).T[:3] * [[1.0], [-1.0], [-1.0]]
    focal = SIZE[1] / 2.0 / math.tan(math.radians(15.0))
    k = [[focal, 0.0, SIZE[0] / 2.0], [0.0, focal, SIZE[1] / 2.0], [0.0, 0.0, 1.0]]
    rotation = Quaternion.from_matrix(Matrix33(pose[:, :3]))
    cameras = [
        fr.Camera.from_opencv(k, pose[:, :3], pose[:, 3:], SIZE),
        fr.Camera.from_opencv(Matrix33(k), rotation, Vector3(pose[:, 3]), SIZE),
        fr.Camera.from_view_matrix(view, **rows),
        fr.Camera.from_view_matrix(np.array(view).T, **columns),
        fr.Camera.from_view_matrix(view, **rows, row_vectors=True),
        fr.Camera.from_camera_to_world(to_world, **rows),
        fr.Camera.from_camera_to_world(np.array(to_world).T.tolist(), **columns, row_vectors=False),
        fr.Camera.from_camera_to_world(view.quaternion, Vector3(eye), **rows),
        fr.Camera.from_view_matrix(view, fov=30.0),
        fr.Camera.from_view_matrix(view.astype(np.float32), fov=30.0),
    ]
    length = np.linalg.norm(pose[:, 3])
    for camera, precision in zip(cameras, (*[1e-14] * 9, 1e-6), strict=True):
        np.testing.assert_allclose(camera.extrinsics, pose, rtol=0, atol=precision * length)
        if camera.intrinsics is not None:
            np.testing.assert_allclose(camera.intrinsics, k, rtol=1e-13)
    np.testing.assert_allclose(view_of(fr.Scene(mini, cameras[0]), 4 / 3).position, (1.5, 0.7, 4.0))
    with fr.Renderer(SIZE, samples=1) as renderer:
        first, *images = [renderer.render(fr.Scene(mini, camera)).linear for camera in cameras]
    assert (first[..., 3] > 0).mean() > 0.1
    for image in images:
        assert (np.abs(image - first).max(axis=-1) > 1e-3).mean() < 1e-3  # rounding may move edges


def test_a_projection_beside_the_axis(mini):
    """Clip coordinates of OpenGL are those of the G-buffer's points, also with an oblique axis."""
    eye = mini.center + np.array([0.5, 0.2, 3.0]) * mini.radius
    view = Matrix44.look_at(eye, mini.center, (0.0, 1.0, 0.0))
    lens = Matrix44.perspective_projection_bounds(-0.03, 0.05, -0.035, 0.02, 0.1, 10.0)
    buffer = seen(mini, fr.Camera.from_view_matrix(view, lens, SIZE))
    rows, columns = np.nonzero(buffer.part >= 0)
    points = np.column_stack([buffer.position[rows, columns], np.ones(len(rows))])
    clip = points @ np.array(view) @ np.array(lens)
    found = (1.0 + clip[:, :2] / clip[:, 3:] * (1.0, -1.0)) * np.divide(SIZE, 2.0)
    assert len(found) > 500
    np.testing.assert_allclose(found, np.column_stack([columns, rows]) + 0.5, atol=2e-3)


def test_matrices_of_unknown_convention_are_refused():
    rotation, half = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    rotation[:3, :3] = rotation_of((0.0, 30.0, 0.0))
    make, inverse = fr.Camera.from_view_matrix, fr.Camera.from_camera_to_world
    with pytest.raises(fr.InputError, match="matrix = .*: give row_vectors=True or False"):
        make(rotation)
    assert make(rotation, row_vectors=True) == make(rotation.T, row_vectors=False)
    assert make(rotation, row_vectors=True) != make(rotation, row_vectors=False)
    assert make(half).extrinsics == ((-1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 1, 0))  # symmetric
    rotation[:3, 3] = 1.0
    orthographic = Matrix44.orthogonal_projection(-1.0, 1.0, -1.0, 1.0, 0.1, 10.0)
    perspective = Matrix44.perspective_projection(30.0, 1.0, 0.1, 10.0)
    for message, call in {
        "a last row .or last column. .0.0, 0.0, 0.0, 1.0.": lambda: make(rotation * 2.0),
        "camera matrix = .*: give a last row": lambda: make(rotation, row_vectors=True),
        "camera matrix = .*: give 4 rows of 4 numbers": lambda: make(rotation[:3]),
        "projection = .*: give a last row": lambda: make(rotation, orthographic, SIZE),
        "camera size = None: give width and height": lambda: make(rotation, perspective),
        "camera fov = 30.0 and intrinsics": lambda: make(rotation, perspective, SIZE, fov=30.0),
        "camera projection = .*: give it without": lambda: make(
            rotation, np.array(perspective).T + np.eye(4, k=3), SIZE
        ),
        "give .R|t. with a rotation R": lambda: make(rotation @ np.diag([2.0, 2.0, 2.0, 1.0])),
        "camera matrix = .*: give a quaternion of length 1": lambda: inverse([0, 0, 0, 2], [0] * 3),
        "camera matrix = .*: give 4 numbers": lambda: inverse(rotation, [0, 0, 0]),
        "camera R = .*: give 3 rows of 3 numbers or 4 numbers": lambda: fr.Camera.from_opencv(
            K, [1, 2], [0, 0, 1], SIZE
        ),
        "camera position = .*: give 3 numbers": lambda: inverse([0, 0, 0, 1], [0, 0]),
    }.items():
        with pytest.raises(fr.InputError, match=message):
            call()


GOOD = {"extrinsics": np.eye(3, 4), "intrinsics": K, "size": SIZE}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extrinsics": np.eye(4)}, "camera extrinsics = .*: give 3 rows of 4 numbers"),
        ({"extrinsics": np.diag([1, 1, -1.0, 0])[:3]}, "give .R|t. with a rotation R"),
        ({"extrinsics": np.full((3, 4), np.nan)}, "give 3 rows of 4 numbers"),
        ({"extrinsics": None}, "camera intrinsics need extrinsics"),
        ({"azimuth": 5.0}, "camera azimuth = 5.0 and extrinsics exclude each other: leave one"),
        ({"target": (0, 0, 0)}, "camera target = .* and extrinsics exclude each other"),
        ({"fov": 30.0}, "camera fov = 30.0 and intrinsics exclude each other"),
        ({"size": None}, "camera intrinsics and camera size belong together"),
        ({"size": (0, 10)}, "camera size 0 x 10: give 1 to 1073741824 pixels"),
        ({"intrinsics": [[300, 2, 60], [0, 300, 45], [0, 0, 1]]}, "without skew"),
        ({"intrinsics": [[300, 0, 60], [0, -300, 45], [0, 0, 1]]}, "give fx and fy from 0.001"),
        ({"intrinsics": [[300, 0, 60], [0, 300, 1e9], [0, 0, 1]]}, "cx and cy up to 1000 times"),
        ({"intrinsics": [[300, 0, 60]]}, "give 3 rows of 3 numbers"),
    ],
)
def test_invalid_matrices_are_refused(changes, message):
    with pytest.raises(fr.InputError, match=message):
        fr.Camera(**{**GOOD, **changes})


def test_job_files_hold_matrices(mini, tmp_path):
    camera = fr.Camera(extrinsics=pose_of(mini, 20, 5, 5), intrinsics=K, size=SIZE)
    job = fr.Job(camera=camera)
    assert fr.Job.from_dict(json.loads(json.dumps(job.as_dict()))) == job
    path = tmp_path / "job.toml"
    path.write_text("[camera]\n" + job.toml().split("[camera]\n")[1].split("\n\n")[0])
    assert fr.load_scene(path)["camera"] == camera


def test_turntable_replaces_matrices_by_azimuths(mini):
    placed = fr.Camera(extrinsics=pose_of(mini, 20, 5, 5), intrinsics=K, size=SIZE)
    assert fr.turntable(placed, 2) == (fr.Camera(0.0), fr.Camera(180.0))


def test_camera_and_its_matrices_give_the_same_image(mini):
    """This includes subsurface scattering, whose radius in pixels depends on the camera."""
    mesh = with_geometry(mini, millimetres=1000.0 * 0.15 / mini.radius).with_material(
        scattering="skin"
    )
    camera = fr.Camera(25.0, 10.0, zoom=1.3)
    with fr.Renderer(SIZE, samples=1) as renderer:
        own = renderer.render(fr.Scene(mesh, camera)).linear
        view = view_of(fr.Scene(mesh, camera), SIZE[0] / SIZE[1])
        pose, k = view.extrinsics(mesh), view.intrinsics(SIZE)
        placed = fr.Camera(extrinsics=pose, intrinsics=k, size=SIZE)
        again = renderer.render(fr.Scene(mesh, placed)).linear
        sharp = renderer.render(fr.Scene(mesh.with_material(scattering=None), placed)).linear
    assert (np.abs(again - own).max(axis=-1) > 1e-3).mean() < 1e-3  # rounding may move edges
    assert np.abs(sharp - own).max() > 0.01


# --- files ---------------------------------------------------------------------------------------


def test_cameras_of_a_json_file(mini, tmp_path):
    pose = pose_of(mini, 20, 5, 5)
    camera = fr.Camera(extrinsics=pose, intrinsics=K, size=SIZE)
    whole = {"K": K, "Rt": pose.tolist(), "width": 120, "height": 90}
    apart = {"K": K, "R": pose[:, :3].tolist(), "t": pose[:, 3].tolist(), "size": SIZE}
    square = {"intrinsics": K, "Rt": [*pose.tolist(), [0, 0, 0, 1]], "name": "left"}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(whole | {"transform_matrix": []}))
    assert fr.load_cameras(path) == {"rig_000": camera}
    for content in ([whole, apart, square], {"cameras": [whole, apart, square]}):
        path.write_text(json.dumps(content))
        found = fr.load_cameras(path, SIZE)
        assert found == dict.fromkeys(("rig_000", "rig_001", "left"), camera)
    path.write_text('{"azimuth": 30, "frame": "face"}')
    assert [*fr.load_cameras(path).values()] == [fr.Camera(30.0, frame="face")]


def test_cameras_of_a_numpy_file(mini, tmp_path):
    poses = np.stack([pose_of(mini, azimuth, 5, 5) for azimuth in (0, 90)])
    path = tmp_path / "rig.npz"
    wanted = [fr.Camera(extrinsics=pose, intrinsics=K, size=SIZE) for pose in poses]
    np.savez(path, K=K, R=poses[..., :3], t=poses[..., 3:], width=120, height=90)
    assert [*fr.load_cameras(path).values()] == wanted
    np.savez(path, K=[K, K], Rt=poses, size=SIZE)
    assert [*fr.load_cameras(path).values()] == wanted
    np.savez(path, Rt=poses[0])
    assert [*fr.load_cameras(path).values()] == [fr.Camera(extrinsics=poses[0])]


BAD = {
    "a.json": [
        ("{", "a.json: its JSON cannot be read"),
        ("[]", r"a.json has no cameras"),
        ('{"K": 3, "Rt": 4}', "a.json: camera extrinsics = 4: give 3 rows"),
        ('{"R": [[1]], "t": 4}', "a.json: camera R and t: give 3 x 3"),
        ('{"zoom": "x"}', "a.json: camera zoom = 'x'"),
        ('{"focal": 3}', "a.json: unknown key 'focal' in camera; known: azimuth"),
        ("[" * 100000, "a.json: its JSON cannot be read"),
    ],
    "a.npz": [
        ("", "a.npz: it is not a NumPy file"),
        ("PK nonsense", "a.npz: it is not a NumPy file"),
    ],
    "a.toml": [("ambient = 1", r"a.toml has no cameras")],
    "a.txt": [("", "a.txt: unknown camera format '.txt'; give .toml, .json, .npz, .glb or")],
    "a.glb": [("{}", "a.glb is not glTF but other JSON")],
}


@pytest.mark.parametrize(
    ("name", "content", "message"), [(name, *each) for name, all_ in BAD.items() for each in all_]
)
def test_invalid_camera_files_are_refused(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(fr.InputError, match=message):
        fr.load_cameras(tmp_path / name)


def test_arrays_of_other_shapes(tmp_path):
    path = tmp_path / "rig.npz"
    for arrays, message in (
        ({"K": np.eye(3)}, r"it has no pose \(arrays: K\): give K, R and t"),
        (
            {"Rt": np.zeros((2, 3, 4)), "K": np.zeros((3, 3, 3))},
            "'K' has 3 axes: give one matrix, or",
        ),
        ({"Rt": np.array(["x"])}, "'Rt' has 1 axes"),
        ({"Rt": np.zeros((0, 3, 4))}, r"has no cameras"),
        ({"Rt": np.zeros((3, 4))}, "give .R|t. with a rotation R"),
    ):
        np.savez(path, **arrays)  # type: ignore[arg-type]
        with pytest.raises(fr.InputError, match=message):
            fr.load_cameras(path)
    np.savez(path, Rt=np.array([None], dtype=object))
    with pytest.raises(fr.InputError, match="it is not a NumPy file"):
        fr.load_cameras(path)


# --- glTF ----------------------------------------------------------------------------------------


def test_cameras_of_a_gltf_file(mini, tmp_path):
    """A node that rotates its camera by 90 degrees places it at +x, looking at -x. The node's scale
    does not change the view."""
    quarter = [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)]
    distance = 4.0 * mini.radius
    nodes = [
        {"name": "arm", "rotation": quarter, "scale": [2, 2, 2]},
        {"name": "side", "camera": 0, "translation": [0.0, 0.0, distance / 2.0]},
        {"camera": 1, "translation": [0.0, 0.0, 7.0]},
    ]
    first = len(split_glb(MINI_HEAD.read_bytes())[0]["nodes"])
    nodes[0] |= {"children": [first + 1], "translation": mini.center.tolist()}
    cameras = [
        {"type": "perspective", "perspective": {"yfov": math.radians(30.0), "znear": 0.1}},
        {"type": "perspective", "name": "front", "perspective": {"yfov": 0.5, "znear": 0.1}},
    ]
    path = glb(tmp_path, nodes, cameras)
    found = fr.load_cameras(path)
    assert sorted(found) == ["front", "side"]
    view = view_of(fr.Scene(mini, found["side"]), 1.0)
    np.testing.assert_allclose(view.forward, [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(view.position, [4.0, 0.0, 0.0], atol=1e-9)
    wanted = fr.Camera(
        position=tuple(mini.to_mesh_space([4.0, 0.0, 0.0])), target=tuple(mini.center), fov=30.0
    )
    np.testing.assert_allclose(view.matrix, view_of(fr.Scene(mini, wanted), 1.0).matrix, atol=1e-9)
    assert math.radians(found["front"].fov) == pytest.approx(0.5)
    fr.load_mesh(path)  # cameras do not disturb loading


@pytest.mark.parametrize(
    ("node", "camera", "message"),
    [
        ({"camera": 0}, {"type": "orthographic"}, "camera '' of head.glb has no projection"),
        ({"camera": 0}, {"perspective": {"yfov": 3.1}}, "head.glb: camera fov = 177"),
        ({"camera": 0}, {"perspective": {}}, r"cameras\[0\].perspective.yfov is missing"),
        ({"camera": 1}, {"perspective": {"yfov": 1}}, "= 1 is not an index into the 1 cameras"),
        ({"camera": 0, "scale": [0, 1, 1]}, {"perspective": {"yfov": 1}}, "give 3 rows of 4"),
        ({"camera": 0, "scale": [-1, 1, 1]}, {"perspective": {"yfov": 1}}, "a rotation R"),
        ({}, {"perspective": {"yfov": 1}}, "head.glb has no camera"),
    ],
)
def test_unsupported_gltf_cameras_are_refused(node, camera, message, tmp_path):
    with pytest.raises(fr.InputError, match=message):
        fr.load_cameras(glb(tmp_path, [node], [camera]))
