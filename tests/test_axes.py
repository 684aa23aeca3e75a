"""Tests meshes whose axes differ from facerender's: the arguments up and rotate of load_mesh, and
everything that follows them. Files that were rotated by hand must give the original again."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import facerender as fr
from facerender.batch.jobs import JobTable
from facerender.batch.outputs import file_faults
from facerender.commands import main
from facerender.mesh.simplify import simplified
from tests import awkward_files as files
from tests.awkward_files import Glb, assert_equal, join_glb, split_glb
from tests.meshes import with_geometry
from tests.test_rig import SAMPLES, cube, recursive_skeletons
from tests.verification.cache import wait_for_cache

# For each axis that points up in the file: x, y and z of the file as combinations of x (right),
# y (up) and z (front) of facerender.
IN_FILE = {
    "y": [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "z": [(1, 0, 0), (0, 0, -1), (0, 1, 0)],
    "-z": [(1, 0, 0), (0, 0, 1), (0, -1, 0)],
    "x": [(0, 1, 0), (-1, 0, 0), (0, 0, 1)],
    "-x": [(0, -1, 0), (1, 0, 0), (0, 0, 1)],
    "-y": [(-1, 0, 0), (0, -1, 0), (0, 0, 1)],
}
ANGLES = (10.0, 20.0, 30.0)
ROTATION = trimesh.transformations.euler_matrix(*np.radians(ANGLES), "sxyz")[:3, :3]
WRITERS = [files.write_obj, files.write_ply, files.write_stl, files.write_glb]


def in_file(points, up="z"):
    """Return points (N, 3) of mesh space in the axes of a file."""
    return points @ np.array(IN_FILE[up], dtype=float).T


def with_axes(head, up="z"):
    return replace(head, positions=in_file(head.positions, up), normals=in_file(head.normals, up))


def below_z_up(content):
    """Return a GLB file whose scene is below a node that makes it a z-up file."""
    document, binary = split_glb(content)
    matrix = np.eye(4)
    matrix[:3, :3] = IN_FILE["z"]
    scene = document["scenes"][0]
    document["nodes"].append({"children": scene["nodes"], "matrix": matrix.T.ravel().tolist()})
    scene["nodes"] = [len(document["nodes"]) - 1]
    return join_glb(document, binary)


def poses_of(mesh):
    """Return a mesh in its stored pose, in a pose of each clip, and with all shapes."""
    clips = (mesh.with_pose(clip=clip, time=0.6 * end) for clip, end in mesh.clips.items())
    shapes = [mesh.with_pose(dict.fromkeys(mesh.shapes, 0.7))] if mesh.shapes else []
    return [mesh, *clips, *shapes]


@pytest.mark.parametrize("up", IN_FILE)
def test_a_file_with_other_axes_gives_the_original(up, tmp_path):
    head = files.mini_head()
    for write in WRITERS:
        own, other = (
            write(tmp_path / name, each)
            for name, each in (
                (f"a.{write.__name__[6:]}", head),
                (f"b.{write.__name__[6:]}", with_axes(head, up)),
            )
        )
        a, b = fr.load_mesh(own), fr.load_mesh(other, up=up)
        assert_equal(a.parts, b.parts, write.__name__)
        assert_equal(a.profile, b.profile, write.__name__)
    instance = trimesh.Trimesh(with_axes(head, up).positions, head.faces, process=False)
    scene = trimesh.Scene(instance)
    mesh = fr.load_mesh(scene, up=up)
    np.testing.assert_array_equal(mesh.parts[0].positions, head.positions)


def test_rotations_about_x_then_y_then_z():
    plain = fr.load_mesh(files.MINI_HEAD)
    mesh = fr.load_mesh(files.MINI_HEAD, up="z", rotate=ANGLES)
    np.testing.assert_allclose(
        mesh.geometry.rotation, ROTATION @ np.transpose(IN_FILE["z"]), atol=1e-15
    )
    for a, b in zip(plain.parts, mesh.parts, strict=True):
        np.testing.assert_allclose(a.positions @ mesh.geometry.rotation.T, b.positions, atol=1e-15)
        np.testing.assert_allclose(a.normals @ mesh.geometry.rotation.T, b.normals, atol=1e-12)


@pytest.mark.parametrize(
    "axes", [{}, {"rotate": (0, 360, -720)}, {"up": "z", "rotate": (90, 0, 0)}]
)
def test_nothing_changes_without_a_rotation(axes):
    a, b = fr.load_mesh(files.MINI_HEAD), fr.load_mesh(files.MINI_HEAD, **axes)
    assert_equal(a.parts, b.parts, "parts")
    assert b.geometry.rotation is None
    assert not {"up", "rotate"} & fr.Job().as_dict()["mesh"].keys()


@pytest.mark.parametrize("sample", SAMPLES)
def test_shapes_skins_and_clips_follow(sample):
    content = sample().content()
    plain = fr.load_mesh(content)
    assert plain.shapes or plain.clips
    for a, b in zip(poses_of(plain), poses_of(fr.load_mesh(content, rotate=ANGLES)), strict=True):
        for own, other in zip(a.parts, b.parts, strict=True):
            np.testing.assert_allclose(own.positions @ ROTATION.T, other.positions, atol=1e-12)
            np.testing.assert_allclose(own.normals @ ROTATION.T, other.normals, atol=1e-9)
    z_up = fr.load_mesh(below_z_up(content), up="z")
    assert z_up.select(z_up.parts[0].name).geometry.rotation is z_up.geometry.rotation
    for a, b in zip(poses_of(plain), poses_of(z_up), strict=True):
        for own, other in zip(a.parts, b.parts, strict=True):
            np.testing.assert_allclose(own.positions, other.positions, rtol=0, atol=1e-14)


def test_a_skinned_mesh_without_joints_follows():
    """Neither its node nor a joint places this mesh."""
    file = Glb({"children": [1, 2]}, {"mesh": 0, "skin": 0, "translation": [5, 0, 0]}, {})
    primitive = file.primitive(*cube())
    primitive["targets"] = [{"POSITION": file.add(np.ones((24, 3)))}]
    file.mesh(primitive)
    file.skin([2])
    mesh = fr.load_mesh(file.content(), rotate=(0, 0, 90))
    expected = np.array(cube()[0]) @ [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]
    np.testing.assert_allclose(mesh.parts[0].positions, expected, atol=1e-6)
    pose = mesh.with_pose({"shape1": 1.0}).parts[0]
    np.testing.assert_allclose(pose.positions, expected + (-1.0, 1.0, 1.0), atol=1e-6)


def test_bounds_of_a_head_are_above_its_joint():
    file = recursive_skeletons()
    file.document["nodes"][2]["name"] = "Head"
    plain, z_up = fr.load_mesh(file.content()), fr.load_mesh(below_z_up(file.content()), up="z")
    for a, b in zip(plain.parts, z_up.parts, strict=True):
        assert a.head is not None
        np.testing.assert_allclose(a.head, b.head, rtol=0, atol=1e-14)


def test_the_command_line_draws_the_original(tmp_path):
    """The mesh has maps and shapes, and the camera is a camera of the file."""
    head, file = files.mini_head(), Glb()
    document, file.binary = files.gltf(head)
    file.document = document = deepcopy(document)
    target = {"POSITION": file.add(np.maximum(head.positions, 0.0) * (0.0, 0.0, 0.5))}
    document["meshes"][0]["primitives"][0]["targets"] = [target]
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.4, "znear": 0.1}}]
    document["nodes"].append({"camera": 0, "translation": [0.05, 0.0, 0.8]})
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)
    content = file.content()
    images = {}
    for name, data, *axes in (
        ("plain", content),
        ("z", below_z_up(content), "--up", "z"),
        ("-z", below_z_up(content), "--up", "-z", "--rotate", "-180,0,0"),
        ("wrong", below_z_up(content)),
    ):
        path, image = tmp_path / "head.glb", tmp_path / f"{name}.png"
        path.write_bytes(data)
        line = ["--weight", "shape1=1", "--camera", "gltf", "--size", "96", "--no-cache"]
        assert main(["render", str(path), *line, *axes, "-o", str(image)]) == 0
        images[name] = np.asarray(Image.open(image))
    assert_equal(images["plain"], images["z"], "z")
    assert_equal(images["plain"], images["-z"], "-z")
    assert np.abs(np.subtract(images["plain"], images["wrong"], dtype=float)).max() > 20
    cameras = fr.load_cameras(tmp_path / "head.glb", up="z")
    (tmp_path / "plain.glb").write_bytes(content)
    assert cameras == fr.load_cameras(tmp_path / "plain.glb")


def test_vertices_landmarks_and_motion_follow(tmp_path):
    """Files of vertices, positions and normals have the axes of the mesh file."""
    head = files.mini_head()
    step = 0.02 * np.sin(9.0 * head.positions[:, [1, 2, 0]])
    frames = np.stack([head.positions, head.positions + step])
    points = fr.Landmarks(("a", "b"), np.array([(9, 9, 9), (70, 71, 72)]), np.full((2, 3), 1 / 3))
    found = []
    for folder, up in (("a", "y"), ("b", "z")):
        (tmp_path / folder).mkdir()
        path, vertices = tmp_path / folder / "head.obj", tmp_path / folder / "frames.npy"
        files.write_obj(path, with_axes(head, up))
        np.save(vertices, in_file(frames, up))
        pose = fr.Pose(vertices=str(vertices), frame=1)
        job = fr.Job(fr.MeshFile(str(path), up=up), pose=pose, before=replace(pose, frame=0))
        mesh = job.mesh.load()
        normals = [in_file(head.normals, up)]
        mesh_with_normals = mesh.select().with_positions(in_file(frames[1], up), normals)
        scene = job.scene(mesh, moves=True)
        with fr.Renderer(64, samples=1) as renderer:
            images = [renderer.render(scene, only=only).linear for only in (None, "motion")]
            images += renderer.landmarks(scene, points)
        found.append((images, mesh_with_normals.parts, simplified(mesh, 200).parts))
        assert np.abs(images[1][..., :2]).max() > 0.5
    assert_equal(*found, "results")
    assert found[0][1][0].positions.tolist() == frames[1].tolist()


def test_the_cache_keeps_the_rotation_apart(tmp_path, cache_folder):
    path = files.write_obj(tmp_path / "head.obj", with_axes(files.mini_head()))
    first = fr.load_mesh(path, up="z", cache=True)
    wait_for_cache()
    cached = fr.load_mesh(path, up="z", cache=True)
    assert cached.parts[0] is not first.parts[0]
    assert_equal(with_geometry(first), with_geometry(cached), "mesh")
    assert fr.load_mesh(path, cache=True).geometry.rotation is None


def test_other_commands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head = files.mini_head()
    files.write_obj(Path("z.obj"), with_axes(head))
    np.save("frames.npy", in_file(head.positions)[None])
    axes = ["--up", "z", "--rotate", "-10,0,0.5"]
    assert main(["info", "z.obj", "--json", "--up", "z"]) == 0
    bounds = json.loads(capsys.readouterr().out)["bounds"]
    np.testing.assert_array_equal(bounds, fr.load_mesh("z.obj", up="z").bounds)
    assert main(["explore", "z.obj", *axes, "-o", "z.html"]) == 0
    assert "z.obj --up z --rotate -10.0,0.0,0.5" in Path("z.html").read_text()
    row = {"mesh": {"path": "z.obj", "up": "z", "rotate": [-10, 0, 0.5]}}
    Path("jobs.jsonl").write_text(json.dumps({**row, "pose": {"vertices": "frames.npy"}}))
    table = JobTable("jobs.jsonl")
    ((_, found, _),) = table.valid()
    assert fr.Job.from_dict(found.tables).mesh == fr.MeshFile(
        str(tmp_path / "z.obj"), up="z", rotate=(-10.0, 0.0, 0.5)
    )
    assert not table.faults
    assert not file_faults(table.valid())


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"up": "w"}, "unknown (mesh )?up 'w'; known: y, z, x, -y, -z, -x, auto"),
        ({"rotate": 90}, r"rotate = 90: give three numbers in \[-3600, 3600\]"),
        ({"rotate": (0, 4000, 0)}, r"rotate = \(0, 4000, 0\): give three numbers in"),
        ({"rotate": (0, float("nan"), 0)}, "give three numbers in"),
    ],
)
def test_invalid_values_are_refused(axes, message):
    for call in (fr.load_mesh, fr.MeshFile):
        with pytest.raises(fr.InputError, match=message):
            call(**axes)


def test_invalid_options_are_refused(tmp_path, capsys):
    for axes in (["--rotate", "0,180"], ["--rotate", "0,0,9999"], ["--up", "w"]):
        assert main(["info", str(files.MINI_HEAD), *axes]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert axes[0].strip("-") in line
        assert "give three numbers" in line or "choose from" in line
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(fr.InputError, match="leave up and rotate out"):
        fr.load_cameras(tmp_path / "a.json", up="z")


# For each pose of a head in a file: what the file has of x, y and z as in IN_FILE, the axes along
# which the face looks and the top of the head is, and the options that turn it upright.
POSES = {
    "lying": (IN_FILE["z"], "-y", "z", "--up z"),
    "on its face": (IN_FILE["-z"], "y", "-z", "--up -z"),
    "upside down": (IN_FILE["-y"], "z", "-y", "--up -y"),
    "on its head": ([(1, 0, 0), (0, -1, 0), (0, 0, -1)], "-z", "-y", "--up -y --rotate 0,180,0"),
    "away": ([(-1, 0, 0), (0, 1, 0), (0, 0, -1)], "-z", "y", "--rotate 0,180,0"),
    "to +x": ([(0, 0, 1), (0, 1, 0), (-1, 0, 0)], "x", "y", "--rotate 0,270,0"),
    "to -x": ([(0, 0, -1), (0, 1, 0), (1, 0, 0)], "-x", "y", "--rotate 0,90,0"),
    "lying to +x": ([(0, 0, 1), (1, 0, 0), (0, 1, 0)], "x", "z", "--up z --rotate 0,270,0"),
}


def posed_obj(path, axes):
    head = files.mini_head()
    return files.write_obj(path, head.with_positions(head.positions @ np.transpose(axes)))


def keywords(options):
    words = options.split()
    found = dict(zip(words[::2], words[1::2], strict=True))
    angles = [float(angle) for angle in found.get("--rotate", "0,0,0").split(",")]
    return {"up": found.get("--up", "y"), "rotate": angles}


@pytest.mark.first_case
@pytest.mark.parametrize("pose", POSES)
def test_a_warning_names_the_options_that_turn_a_face_upright(pose, tmp_path, renderer):
    axes, front, up, options = POSES[pose]
    path = posed_obj(tmp_path / "a.obj", axes)
    mesh = fr.load_mesh(path)
    with pytest.warns(fr.FacerenderWarning) as caught:
        wrong = [renderer.render(fr.Scene(mesh, fr.Camera(azimuth))) for azimuth in (0.0, 30.0)]
    (warning,) = caught
    assert str(warning.message) == (
        f"the face of a.obj looks along {front}, and the top of the head is along {up}: "
        f"give {options}, or --up auto (up='auto')"
    )
    upright = fr.load_mesh(posed_obj(tmp_path / "b.obj", np.eye(3)))
    expected = renderer.render(fr.Scene(upright)).srgb8()
    assert np.abs(np.subtract(wrong[0].srgb8(), expected, dtype=float)).max() > 20
    for found in (fr.load_mesh(path, **keywords(options)), fr.load_mesh(path, up="auto")):
        assert_equal(found.parts, upright.parts, "parts")
        np.testing.assert_array_equal(renderer.render(fr.Scene(found)).srgb8(), expected)


def test_the_command_line_turns_a_face_upright(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    posed_obj(Path("a.obj"), IN_FILE["z"])
    posed_obj(Path("b.obj"), np.eye(3))
    images = []
    for words in (["a.obj"], ["a.obj", "--up", "z"], ["a.obj", "--up", "auto"], ["b.obj"]):
        line = ["render", *words, "--frame", "eyes", "--size", "64", "-o", "a.png"]
        assert main(line) == 0
        assert ("give --up z, or --up auto" in capsys.readouterr().err) is (words == ["a.obj"])
        images.append(np.asarray(Image.open("a.png")))
    assert (images[0] != images[3]).any()
    assert_equal(images[1], images[3], "--up z")
    assert_equal(images[2], images[3], "--up auto")
    assert main(["info", "a.obj"]) == 0
    assert "hint: the face of a.obj looks along -y" in capsys.readouterr().out
    assert main(["info", "a.obj", "--up", "auto", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert not [hint for hint in found["hints"] if "looks along" in hint]
    np.testing.assert_allclose(found["face"]["front"], (0.0, 0.0, 1.0), atol=0.1)


def test_a_face_at_an_odd_angle_is_turned_upright():
    """The axes of the face replace those of the file, also for trimesh objects and shapes."""
    turn = trimesh.transformations.rotation_matrix(np.radians(37.0), (1.0, -2.0, 0.5))[:3, :3]
    turn = turn @ np.transpose(IN_FILE["x"])
    head = files.mini_head()
    positions = np.asarray(head.positions @ turn.T, dtype=np.float32)
    shift = np.asarray(np.maximum(head.positions, 0.0) * (0.0, 0.0, 0.5) @ turn.T, np.float32)
    file = Glb({"mesh": 0})
    primitive = file.primitive(positions, head.faces)
    primitive["targets"] = [{"POSITION": file.add(shift)}]
    file.mesh(primitive)
    instance = trimesh.Trimesh(positions, head.faces, process=False)
    for source in (file.content(), instance, trimesh.Scene(instance)):
        mesh = fr.load_mesh(source, up="auto")
        rotation = mesh.geometry.rotation
        error = rotation @ turn
        assert np.degrees(np.arccos((np.trace(error) - 1.0) / 2.0)) < 5.0
        np.testing.assert_allclose(mesh.parts[0].positions, positions @ rotation.T, atol=1e-6)
        face = fr.find_face(mesh)
        assert face is not None
        assert min(face.up[1], face.front[2]) > np.cos(np.radians(5.0))
        if mesh.shapes:
            moved = mesh.with_pose({"shape1": 1.0}).parts[0].positions
            expected = (positions + shift) @ rotation.T
            np.testing.assert_allclose(moved, expected, atol=1e-6)
    assert mesh.shapes or fr.load_mesh(file.content(), up="auto").shapes == ("shape1",)


def test_up_auto_follows_shapes_along_axes():
    head = files.mini_head()
    file = Glb()
    document, file.binary = files.gltf(head)
    file.document = document = deepcopy(document)
    target = {"POSITION": file.add(np.maximum(head.positions, 0.0) * (0.0, 0.0, 0.5))}
    document["meshes"][0]["primitives"][0]["targets"] = [target]
    plain = fr.load_mesh(file.content())
    turned = fr.load_mesh(below_z_up(file.content()), up="auto")
    assert turned.shapes == plain.shapes != ()
    for a, b in zip(poses_of(plain), poses_of(turned), strict=True):
        np.testing.assert_allclose(a.parts[0].positions, b.parts[0].positions, rtol=0, atol=1e-14)
    assert fr.load_mesh(file.content(), up="auto").geometry.rotation is None
    further = fr.load_mesh(below_z_up(file.content()), up="auto", rotate=ANGLES)
    expected = ROTATION @ turned.geometry.rotation
    np.testing.assert_allclose(further.geometry.rotation, expected, atol=1e-15)


def test_up_auto_without_a_face(tmp_path):
    shape = trimesh.creation.box((1.0, 2.0, 3.0))
    path = tmp_path / "box.stl"
    path.write_bytes(shape.export(file_type="stl"))
    plain = fr.load_mesh(path)
    with pytest.warns(fr.FacerenderWarning) as caught:
        mesh = fr.load_mesh(path, up="auto")
    (warning,) = caught
    assert str(warning.message) == (
        "no face was found on box.stl: it stays as it is; give its axis, as in --up z"
    )
    assert_equal(mesh.parts, plain.parts, "parts")
    assert mesh.geometry.rotation is None


def test_up_auto_is_stored_in_the_cache(tmp_path, cache_folder, monkeypatch):
    path = posed_obj(tmp_path / "a.obj", IN_FILE["z"])
    file = fr.MeshFile(str(path), up="auto")
    first = fr.load_mesh(path, up="auto", cache=True)
    wait_for_cache()
    monkeypatch.setattr("facerender.mesh.face.find_faces", None)
    monkeypatch.setattr("facerender.mesh.framing.find_faces", None)
    cached = fr.load_mesh(path, up="auto", cache=True)
    assert_equal(with_geometry(first), with_geometry(cached), "mesh")
    assert fr.find_face(cached) is not None
    assert fr.Job.from_dict(fr.Job(file).as_dict()).mesh == file


def test_cameras_of_a_file_need_its_axis(tmp_path, capsys):
    """The face is found on the mesh only, and the cameras would not follow."""
    document, binary = deepcopy(files.gltf(files.mini_head()))
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.4, "znear": 0.1}}]
    document["nodes"].append({"camera": 0, "translation": [0.05, 0.0, 0.8]})
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)
    path = tmp_path / "a.glb"
    path.write_bytes(join_glb(document, binary))
    line = ["render", str(path), "--camera", "gltf", "--size", "32", "-o", str(tmp_path / "a.png")]
    assert main(line) == 0
    capsys.readouterr()
    assert main([*line, "--up", "auto"]) == 2
    assert "give --up z, not auto" in capsys.readouterr().err
    with pytest.raises(fr.InputError, match="auto"):
        fr.load_cameras(path, up="auto")
