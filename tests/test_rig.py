"""Tests poses of glTF files against an evaluation that follows the text of the glTF 2.0
specification with loops and with SciPy's rotations. The files resemble Khronos's sample assets."""

from __future__ import annotations

import json
import math
import time
import warnings
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import facerender as fr
from facerender.commands import main
from facerender.errors import InputError
from facerender.images.files import read_image
from tests import awkward_files as files
from tests.awkward_files import KINDS, WIDTHS, Glb, assert_equal
from tests.meshes import with_geometry
from tests.verification.cache import wait_for_cache

HALF = math.sqrt(0.5)


# --- files ---------------------------------------------------------------------------------------


def cube(size=1.0):
    """Return positions, faces and normals of a cube with four vertices on each side."""
    places, faces, normals = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            first = len(places)
            for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                own = [0.0] * 3
                own[axis], own[(axis + 1) % 3], own[(axis + 2) % 3] = side, u, v
                places.append([0.5 * size * each for each in own])
                normals.append([side * (each == axis) for each in range(3)])
            order = (0, 1, 2, 3) if side > 0 else (3, 2, 1, 0)
            a, b, c, d = (first + each for each in order)
            faces += [(a, b, c), (a, c, d)]
    return places, faces, normals


def tube(rings=9, sectors=12):
    """Return positions, faces and normals of an open tube from y = 0 to 2."""
    angles = np.arange(sectors) * (2.0 * np.pi / sectors)
    circle = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    places = [0.4 * circle + (0.0, y, 0.0) for y in np.linspace(0.0, 2.0, rings)]
    faces = []
    for ring in range(rings - 1):
        for i in range(sectors):
            a, b = ring * sectors + i, ring * sectors + (i + 1) % sectors
            faces += [(a, b, b + sectors), (a, b + sectors, a + sectors)]
    return np.concatenate(places), faces, np.tile(circle, (rings, 1))


def around(axis, *degrees):
    """Return quaternions of rotations around named axes."""
    angles = np.reshape(degrees, (-1, len(axis)))
    return Rotation.from_euler(axis, angles, degrees=True).as_quat()


def animated_cube():
    file = Glb({"mesh": 0, "rotation": [0, 0, 0, 1]})
    file.mesh(file.primitive(*cube()))
    keys = around("y", 0, 180, 360)
    keys[2] *= -1.0  # the same rotation, and the longer arc without the change of sign
    keys *= [[0.7], [1.5], [3.0]]
    file.clip((0, "rotation", [0, 1, 2], keys), name="animation_AnimatedCube")
    return file


def box_animated():
    quarter = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]
    file = Glb(
        {"children": [1, 3], "matrix": quarter},
        {"children": [2], "rotation": [0, HALF, 0, HALF], "translation": [0.5, 0, 0]},
        {"mesh": 0, "scale": [1, 2, 1]},
        {"mesh": 1, "translation": [0, 0, 3]},
    )
    file.mesh(file.primitive(*cube()))
    file.mesh(file.primitive(*cube(0.5)))
    file.clip(
        (2, "rotation", [1.25, 2.5], around("x", 0, 170)),
        (1, "translation", [0, 1.25, 2.5, 3.7], [(0, 0, 0), (0, 2.5, 0), (0, 2.5, 1), (0, 0, 0)]),
    )
    return file


def interpolation_test():
    rng = np.random.default_rng(7)
    file = Glb({"children": [*range(1, 10)]})
    cubes = file.mesh(file.primitive(*cube(0.8)))
    channels = []
    times = [0.2, 0.9, 1.4, 2.1]
    for path in ("translation", "rotation", "scale"):
        for kind in ("STEP", "LINEAR", "CUBICSPLINE"):
            number = len(file.document["nodes"])
            place = [float(number), 0.0, 0.0]
            file.document["nodes"].append({"mesh": cubes, "translation": place})
            width = 4 if path == "rotation" else 3
            values = rng.normal(size=(len(times), width))
            values = np.abs(values) + 0.2 if path == "scale" else values
            if path == "rotation":
                values /= np.linalg.norm(values, axis=1)[:, None]
            if kind == "CUBICSPLINE":
                tangents = 0.3 * rng.normal(size=(2, len(times), width))
                values = np.stack([tangents[0], values, tangents[1]], axis=1).reshape(-1, width)
            channels.append((number, path, times, values, kind))
    file.clip(*channels)
    return file


def targets_of(file, count, vertices, seed, normals=True, sparse=False):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        rows = rng.random((vertices, 1)) < 0.5
        own = {"POSITION": file.add(0.2 * rng.normal(size=(vertices, 3)) * rows, sparse=sparse)}
        if normals:
            own["NORMAL"] = file.add(0.2 * rng.normal(size=(vertices, 3)) * rows, sparse=sparse)
        found.append(own)
    return found


def morph_stress():
    """Eight named targets on two primitives, three clips, and stored weights."""
    names = [f"Key {i}" for i in range(1, 9)]
    file = Glb({"mesh": 0, "weights": [0.3, 0, 0, 0, -0.2, 0, 0, 0]})
    primitives = []
    for seed in (3, 4):
        places, faces, normals = tube()
        primitives.append(file.primitive(places + (seed, 0, 0), faces, normals))
        primitives[-1]["targets"] = targets_of(file, 8, len(places), seed)
    file.mesh(*primitives, extras={"targetNames": names}, weights=[1.0] * 8)
    rng = np.random.default_rng(5)
    for name in ("Individuals", "TheWave"):
        file.clip((0, "weights", [0, 0.5, 2], rng.random((3, 8))), name=name)
    file.clip((0, "weights", [0, 0.5, 2], rng.random((3, 3, 8)), "CUBICSPLINE"), name="Pulse")
    return file


def skinned_tube(file, joints, weights, kind="<f4", **more):
    """Add a tube with joints (N, K) and weights (N, K), in sets of four."""
    places, faces, normals = tube()
    attributes = {}
    for i in range(joints.shape[1] // 4):
        columns = slice(4 * i, 4 * i + 4)
        attributes[f"JOINTS_{i}"] = file.add(joints[:, columns], "<u1")
        attributes[f"WEIGHTS_{i}"] = file.add(weights[:, columns], kind, **more)
    return file.mesh(file.primitive(places, faces, normals, **attributes))


def along(places, count):
    """Return joints (N, 4) and smooth weights (N, 4) of a chain of joints along y."""
    height = np.clip(places[:, 1] / 2.0 * (count - 1), 0, count - 1 - 1e-6)
    first = height.astype(int)
    joints, weights = np.zeros((2, len(places), 4))
    joints[:, 0], joints[:, 1] = first, first + 1
    weights[:, 0], weights[:, 1] = 1.0 - (height - first), height - first
    return joints, weights


def rigged_simple():
    """A tube in a Z-up armature, with normalised bytes as weights; a clip moves, turns and scales
    its joints."""
    file = Glb(
        {"children": [1, 2], "rotation": [-HALF, 0, 0, HALF]},
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"children": [3], "translation": [0, 0.1, 0], "rotation": around("x", 10)[0].tolist()},
        {"translation": [0, 1, 0], "scale": [1, 0.8, 1.3]},
    )
    joints, weights = along(tube()[0], 2)
    high = np.round(255 * weights[:, :1])
    weights = np.hstack([high, 255 - high, 0 * weights[:, 2:]])
    skinned_tube(file, joints, weights, "<u1", normalized=True)
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 3, 1] = -1.0
    file.skin([2, 3], inverse)
    file.clip(
        (3, "rotation", [0.1, 1, 2], around("x", 0, 70, -20)),
        (3, "scale", [0, 2], [(1, 0.8, 1.3), (0.5, 1, 0.7)]),
        (2, "translation", [0, 0.5, 1.5], [(0, 0, 0), (0, 1, 0), (1, 0, 0)], "STEP"),
    )
    return file


def recursive_skeletons():
    """Two skinned meshes below the joints of the same nested skeleton with scaled nodes."""
    file = Glb(
        {"children": [1], "scale": [0.5, 0.5, 0.5]},
        {"children": [2, 4], "translation": [0, 0.3, 0]},
        {"children": [3], "translation": [0, 1, 0], "scale": [1.2, 1.2, 1.2]},
        {"children": [5], "translation": [0, 0.5, 0], "rotation": around("z", 20)[0].tolist()},
        {"mesh": 0, "skin": 0},
        {"mesh": 0, "skin": 1, "scale": [3, 3, 3]},
    )
    skinned_tube(file, *along(tube()[0], 3))
    inverse = np.tile(np.eye(4), (3, 1, 1))
    inverse[:, 3, 1] = [0, -0.8, -1.6]
    file.skin([1, 2, 3], inverse)
    file.skin([3, 2, 1], 2.0 * inverse[::-1])
    file.clip(
        (1, "rotation", [0, 1], around("z", 0, 50)), (2, "scale", [0, 1], [(1,) * 3, (2,) * 3])
    )
    return file


def sparse_quantized():
    """Normalised 16-bit positions and sparse targets, scaled by the node."""
    file = Glb({"mesh": 0, "scale": [2.5, 2.5, 2.5], "translation": [0, -1, 0]})
    file.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    places, faces, normals = tube()
    primitive = file.primitive(places, faces)
    count, rng = len(places), np.random.default_rng(8)
    short = {"kind": "<i2", "normalized": True}
    primitive["attributes"] = {
        "POSITION": file.add(np.round(16383 * places), **short),
        "NORMAL": file.add(np.round(127 * normals), "<i1", normalized=True),
    }
    primitive["targets"] = [
        {
            "POSITION": file.add(
                np.round(5000 * rng.normal(size=(count, 3))) * (rng.random((count, 1)) < 0.3),
                sparse=True,
                **short,
            ),
            "NORMAL": file.add(np.round(30 * rng.normal(size=(count, 3))), **short),
        }
        for _ in range(2)
    ]
    file.mesh(primitive)
    file.clip(
        (0, "weights", [0, 1], [(0, 0), (1, 0.5)]), (0, "scale", [0, 1], [(1,) * 3, (2,) * 3])
    )
    return file


def eight_joints():
    count = len(tube()[0])
    rng = np.random.default_rng(9)
    nodes = [{"translation": rng.normal(size=3).tolist(), "children": [i + 3]} for i in range(7)]
    file = Glb({"children": [1, 2]}, {"mesh": 0, "skin": 0}, *nodes, {"scale": [1, 1, 1]})
    joints = np.stack([rng.permutation(8) for _ in range(count)])
    skinned_tube(file, joints, rng.random((count, 8)))
    inverse = np.tile(np.eye(4), (8, 1, 1)) + 0.1 * rng.normal(size=(8, 4, 4)) * (1, 1, 1, 0)
    file.skin(range(2, 10), inverse)
    angles = rng.normal(scale=20, size=(8, 2, 3))
    rotations = [(i + 2, "rotation", [0, 1], around("xyz", *own)) for i, own in enumerate(angles)]
    file.clip(*rotations)
    return file


def mirrored():
    """A node mirrors its mesh; a skin mirrors another one. Their parents turn."""
    file = Glb(
        {"children": [1, 2, 3]},
        {"mesh": 0, "scale": [-1, 1, 1], "translation": [-3, 0, 0]},
        {"mesh": 1, "skin": 0},
        {"scale": [1, 1, -0.5]},
    )
    file.mesh(file.primitive(*tube()))
    joints, weights = along(tube()[0], 2)
    skinned_tube(file, 0 * joints, weights)
    file.skin([3])
    file.clip((0, "rotation", [0, 1], around("y", 0, 100)))
    return file


def instanced():
    file = Glb({"children": [1]}, {"mesh": 0, "translation": [0, 0, 1]})
    primitive = file.primitive(*tube())
    primitive["targets"] = targets_of(file, 1, len(tube()[0]), 11)
    file.mesh(primitive)
    attributes = {
        "TRANSLATION": file.add([(0, 0, 0), (3, 0, 0), (0, 4, 0)]),
        "SCALE": file.add([(1, 1, 1), (1, 2, 1), (0.5, 0.5, 0.5)]),
        "ROTATION": file.add(around("x", 0, 40, 90)),
    }
    file.document["nodes"][1]["extensions"] = {
        "EXT_mesh_gpu_instancing": {"attributes": attributes}
    }
    file.clip((0, "rotation", [0, 1], around("y", 0, 100)), (1, "weights", [0, 1], [0, 0.6]))
    return file


def rigid_eyes():
    """A skinned head without clips, and two instances of a rigid eye with a target below its joint,
    in an armature with z up that has another unit."""
    file = Glb(
        {"children": [1, 2], "rotation": [-HALF, 0, 0, HALF], "scale": [0.1, 0.1, 0.1]},
        {"mesh": 0, "skin": 0},
        {"children": [3], "rotation": around("xyz", 90, 20, -30)[0].tolist()},
        {"children": [4], "translation": [3, 10, 1], "rotation": around("z", 65)[0].tolist()},
        {"children": [5], "scale": [1, 1.5, -1], "translation": [0, 0, 2]},
        {"mesh": 1, "translation": [1, 2, 3]},
    )
    skinned_tube(file, *along(tube()[0], 2))
    inverse = np.tile(np.diag([5.0, 10.0, 10.0, 1.0]), (2, 1, 1))
    inverse[1, 3, 1] = -10.0
    file.skin([2, 3], inverse)
    eye = file.primitive(*cube())
    eye["targets"] = targets_of(file, 1, 24, 13)
    file.mesh(eye)
    offsets = {"TRANSLATION": file.add([(0, 0, 0), (3, 0, 0)])}
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": offsets}}
    file.document["nodes"][5]["extensions"] = instancing
    return file


SKINNED = [rigged_simple, recursive_skeletons, eight_joints, mirrored, rigid_eyes]
SAMPLES = [
    rigid_eyes,
    animated_cube,
    box_animated,
    interpolation_test,
    morph_stress,
    rigged_simple,
    recursive_skeletons,
    sparse_quantized,
    eight_joints,
    mirrored,
    instanced,
]


# --- evaluation by the specification -------------------------------------------------------------


class Reference:
    """Evaluates a document by the text of the specification."""

    def __init__(self, file):
        self.document, self.binary = file.document, file.binary

    def view(self, index, offset, kind, shape):
        start = self.document["bufferViews"][index]["byteOffset"] + offset
        return np.frombuffer(self.binary, kind, math.prod(shape), start).reshape(shape)

    def accessor(self, index):
        own = self.document["accessors"][index]
        kind = next(name for name, number in KINDS.items() if number == own["componentType"])
        shape = own["count"], WIDTHS[own["type"]]
        values = np.zeros(shape)
        if "bufferView" in own:
            values = self.view(own["bufferView"], 0, kind, shape).astype(float)
        if "sparse" in own:
            count = own["sparse"]["count"]
            rows = self.view(own["sparse"]["indices"]["bufferView"], 0, "<u2", (count,))
            view = own["sparse"]["values"]["bufferView"]
            values[rows] = self.view(view, 0, kind, (count, shape[1]))
        if own.get("normalized"):
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def sampled(self, sampler, path, width, at):
        """Appendix C of the specification."""
        times = self.accessor(sampler["input"])[:, 0]
        values = self.accessor(sampler["output"]).reshape(len(times), -1, width)
        kind = sampler.get("interpolation", "LINEAR")
        middle = values[:, 1] if kind == "CUBICSPLINE" else values[:, 0]
        at = min(max(at, times[0]), times[-1])
        k = max(i for i in range(len(times)) if times[i] <= at)
        if k == len(times) - 1 or kind == "STEP":
            found = middle[k]
        else:
            td = times[k + 1] - times[k]
            t = (at - times[k]) / td
            if kind == "CUBICSPLINE":
                found = (
                    (2 * t**3 - 3 * t**2 + 1) * middle[k]
                    + td * (t**3 - 2 * t**2 + t) * values[k, 2]
                    + (-2 * t**3 + 3 * t**2) * middle[k + 1]
                    + td * (t**3 - t**2) * values[k + 1, 0]
                )
            elif path == "rotation":
                ends = Rotation.from_quat(middle[k : k + 2])
                return Slerp([0.0, 1.0], ends)(t).as_quat()
            else:
                found = (1 - t) * middle[k] + t * middle[k + 1]
        return found / np.linalg.norm(found) if path == "rotation" else found

    def parts(self, given, clip, at, angles):
        """Return positions and normals of the primitives in the order of the scene.

        angles : three angles of some joints, keyed by the node's name
        """
        self.angles = angles
        nodes = [dict(node) for node in self.document["nodes"]]
        for node in nodes:
            if "mesh" in node:
                mesh = self.document["meshes"][node["mesh"]]
                count = len(mesh["primitives"][0].get("targets", ()))
                weights = node.get("weights", mesh.get("weights", [0.0] * count))
                node["weights"] = [float(each) for each in weights]
        if clip is not None:
            animation = self.document["animations"][clip]
            for channel in animation["channels"]:
                node, path = channel["target"]["node"], channel["target"]["path"]
                width = {"translation": 3, "rotation": 4, "scale": 3}.get(path)
                width = width or len(nodes[node]["weights"])
                sampler = animation["samplers"][channel["sampler"]]
                nodes[node][path] = self.sampled(sampler, path, width, at)
        self.nodes = nodes
        self.worlds: dict[int, Any] = {}
        self.order: list[int] = []
        for root in self.document["scenes"][0]["nodes"]:
            self.visit(root, np.eye(4), Rotation.identity())
        found = []
        for number in self.order:
            if "mesh" in nodes[number]:
                found += self.mesh(nodes[number], self.worlds[number], given)
        return found

    def visit(self, number, parent, axes):
        """Set the world matrices of a node and of all nodes below it.

        axes : rotation of the mesh's axes by the angles of the joints above the node
        """
        node = self.nodes[number]
        self.order.append(number)
        self.worlds[number] = world = parent @ local(node)
        angles = self.angles.get(node.get("name"), (0.0, 0.0, 0.0))
        for axis, angle in zip(axes.as_matrix().T, angles, strict=True):
            turn = Rotation.from_rotvec(math.radians(angle) * axis)
            world[:3, :3] = turn.as_matrix() @ world[:3, :3]
            axes = turn * axes
        for child in node.get("children", ()):
            self.visit(child, world, axes)

    def mesh(self, node, world, given):
        mesh = self.document["meshes"][node["mesh"]]
        names = mesh.get("extras", {}).get("targetNames")
        places = [world]
        if own := node.get("extensions", {}).get("EXT_mesh_gpu_instancing"):
            columns = {k.lower(): self.accessor(i) for k, i in own["attributes"].items()}
            rows = range(len(columns["translation"]))
            places = [world @ local({k: v[i] for k, v in columns.items()}) for i in rows]
        found = []
        for place in places:
            for primitive in mesh["primitives"]:
                weights = list(node["weights"])
                for i in range(len(weights)):
                    weights[i] = given.get(names[i] if names else f"shape{i + 1}", weights[i])
                found.append(self.primitive(primitive, weights, node, place))
        return found

    def primitive(self, primitive, weights, node, world):
        attributes = primitive["attributes"]
        places = self.accessor(attributes["POSITION"]).copy()
        normals = np.tile((0.0, 0.0, 1.0), (len(places), 1))  # samples without normals are flat
        if "NORMAL" in attributes:
            normals = self.accessor(attributes["NORMAL"]).copy()
        for target, weight in zip(primitive.get("targets", ()), weights, strict=True):
            places += weight * self.accessor(target["POSITION"])
            if "NORMAL" in target:
                normals += weight * self.accessor(target["NORMAL"])
        matrices = [world] * len(places)
        if "skin" in node:
            skin = self.document["skins"][node["skin"]]
            bound = [np.eye(4)] * len(skin["joints"])
            if "inverseBindMatrices" in skin:
                stored = self.accessor(skin["inverseBindMatrices"])
                bound = [row.reshape(4, 4).T for row in stored]
            of_joints = [self.worlds[j] @ b for j, b in zip(skin["joints"], bound, strict=True)]
            sets = [i for i in (0, 1) if f"JOINTS_{i}" in attributes]
            joints = np.hstack([self.accessor(attributes[f"JOINTS_{i}"]) for i in sets])
            shares = np.hstack([self.accessor(attributes[f"WEIGHTS_{i}"]) for i in sets])
            shares = shares / shares.sum(axis=1, keepdims=True)
            matrices = [
                sum(share * of_joints[int(j)] for j, share in zip(js, ws, strict=True))
                for js, ws in zip(joints, shares, strict=True)
            ]
        for i, matrix in enumerate(matrices):
            places[i] = (matrix @ [*places[i], 1.0])[:3]
            turned = np.linalg.inv(matrix[:3, :3]).T @ normals[i]
            normals[i] = turned / np.linalg.norm(turned)
        return places, normals


def local(node):
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] = turn @ np.diag(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def assert_pose(mesh, file, weights, clip, at, angles=MappingProxyType({})):
    found = Reference(file).parts(weights, clip, at, angles)
    assert len(mesh.parts) == len(found)
    for part, (places, normals) in zip(mesh.parts, found, strict=True):
        scale = max(1.0, np.abs(places).max())
        np.testing.assert_allclose(part.positions, places, atol=1e-6 * scale)
        np.testing.assert_allclose(part.normals, normals, atol=1e-6)


@pytest.mark.first_case
@pytest.mark.parametrize("sample", SAMPLES)
def test_poses_follow_the_specification(sample):
    file = sample()
    mesh = file.load()
    assert_pose(mesh, file, {}, None, 0.0)
    shapes = mesh.shapes[1:3]
    for number, (clip, duration) in enumerate(mesh.clips.items()):
        for at in (0.0, 0.13 * duration, 0.5 * duration, 0.77 * duration, duration):
            pose = mesh.with_pose(clip=clip, time=at)
            assert_pose(pose, file, {}, number, at)
            given = dict(zip(shapes, (0.7, -1.2), strict=False))
            assert_pose(pose.with_pose(given, clip=clip, time=at), file, given, number, at)
    given = dict(zip(mesh.shapes, (1.5, -0.5, 0.25), strict=False))
    assert_pose(mesh.with_pose(given), file, given, None, 0.0)


@pytest.mark.parametrize("sample", SKINNED)
def test_joints_rotate_about_the_axes_of_the_mesh(sample):
    """Their children follow, and carry the axes of their rotations along."""
    file = sample()
    for skin in file.document["skins"]:
        for number in skin["joints"]:
            file.document["nodes"][number]["name"] = f"node {number}"
    mesh = file.load()
    rng = np.random.default_rng(3)
    angles = {name: rng.uniform(-90, 90, 3).tolist() for name in mesh.joints}
    weights = dict.fromkeys(mesh.shapes, 0.5)
    for joints in (dict([*angles.items()][-1:]), angles):
        assert_pose(mesh.with_pose(joints=joints), file, {}, None, 0.0, joints)
        for clip in mesh.clips:
            pose = mesh.with_pose(weights, joints=joints, clip=clip, time=0.7)
            assert_pose(pose, file, weights, 0, 0.7, joints)
    pose = mesh.with_pose(weights, joints=angles)
    assert_pose(pose, file, weights, None, 0.0, angles)
    for same in (pose.with_pose(), mesh.with_pose(joints=dict.fromkeys(angles, (0, 0.0, 0)))):
        for part, own in zip(same.parts, mesh.parts, strict=True):
            assert_equal(part.positions, own.positions, "no angles")
            assert_equal(part.normals, own.normals, "no angles")


# --- normals -------------------------------------------------------------------------------------


def bulging(has_normals):
    """Two tubes of one mesh that share a border. The targets of both have no normals; the first
    target moves the border, too."""
    places, faces, normals = tube(sectors=6)
    file = Glb({"mesh": 0, "rotation": around("z", 30)[0].tolist(), "scale": [2, 2, 2]})
    primitives = []
    for shift in (0.0, 2.0):
        own = np.asarray(places) + (0.0, shift, 0.0)
        primitives.append(file.primitive(own, faces, normals if has_normals else None))
        bulge = np.exp(-((own[:, 1:2] - 2.0) ** 2)) * normals
        lifted = 0.3 * np.maximum(own[:, 1:2] - 3.0, 0.0) * (0.0, 0.0, 1.0)
        primitives[-1]["targets"] = [{"POSITION": file.add(bulge)}, {"POSITION": file.add(lifted)}]
    file.mesh(*primitives, extras={"targetNames": ["bulge", "lift"]}, weights=[0.0, 0.4])
    file.clip((0, "rotation", [0, 1], around("x", 0, 90)))
    return file


def welded_normals(parts, places):
    """Return unit normals weighted by area at each vertex of the parts. Vertices at one place of
    ``places`` share a normal."""
    sums: dict[tuple[float, ...], Any] = {}
    keys = [[tuple(np.round(each, 5)) for each in own] for own in places]
    for part, own in zip(parts, keys, strict=True):
        for face in part.faces:
            a, b, c = part.positions[face]
            for i in face:
                sums[own[i]] = sums.get(own[i], 0.0) + np.cross(b - a, c - a)
    return [[sums[key] / np.linalg.norm(sums[key]) for key in own] for own in keys]


@pytest.mark.parametrize("has_normals", [True, False])
def test_normals_follow_targets_without_normals(has_normals):
    mesh = bulging(has_normals).load()
    stored = [part.positions for part in mesh.parts]
    before = welded_normals(mesh.parts, stored)
    pose = mesh.with_pose({"bulge": 0.5, "lift": 1.0})
    after = welded_normals(pose.parts, stored)
    for part, own, a, b in zip(pose.parts, mesh.parts, after, before, strict=True):
        expected = own.normals + a - b
        expected /= np.linalg.norm(expected, axis=1)[:, None]
        np.testing.assert_allclose(part.normals, expected, atol=1e-6)
    lower, upper = (part.normals for part in pose.parts)
    np.testing.assert_allclose(lower[-6:], upper[:6], atol=1e-6)


@pytest.mark.parametrize("has_normals", [True, False])
def test_normals_of_a_moved_part_turn_with_it(has_normals):
    """The node turns by another rotation in the clip than in the file; shapes do not change."""
    mesh = bulging(has_normals).load()
    pose = mesh.with_pose(clip="clip1", time=1.0)
    turn = Rotation.from_euler("x", 90, degrees=True) * Rotation.from_euler("z", -30, degrees=True)
    for part, own in zip(pose.parts, mesh.parts, strict=True):
        np.testing.assert_allclose(part.normals, turn.apply(own.normals), atol=1e-6)


def test_normals_of_a_mesh_that_is_inside_out():
    """The loader turns the faces and the normals, and a pose keeps them turned."""
    places, faces, normals = cube()
    file = Glb({"mesh": 0})
    file.mesh(file.primitive(places, np.flip(faces, 1), -np.asarray(normals)))
    file.clip((0, "rotation", [0, 1], around("y", 0, 90)))
    mesh, messages = loaded_glb(file)
    assert messages == ["the faces of bytes are inside out: turned"]
    part = mesh.with_pose(clip="clip1", time=1.0).parts[0]
    turned = Rotation.from_euler("y", 90, degrees=True).apply(normals)
    np.testing.assert_allclose(part.normals, turned, atol=1e-6)


def test_normals_that_are_not_finite_keep_their_stored_direction():
    file = Glb({"mesh": 0, "rotation": around("xyz", 20, 30, 40)[0].tolist()})
    primitive = file.primitive(*cube())
    turns = np.zeros((24, 3))
    turns[5], turns[6, 0] = math.nan, math.inf
    primitive["targets"] = [{"NORMAL": file.add(turns)}]
    file.mesh(primitive)
    mesh = file.load()
    pose = mesh.with_pose({"shape1": 1.0})
    np.testing.assert_allclose(pose.parts[0].normals, mesh.parts[0].normals, atol=1e-12)


def test_normals_of_a_part_without_extent_are_unit_vectors():
    file = Glb({"mesh": 0})
    file.mesh(file.primitive(*cube()))
    file.clip((0, "scale", [0, 1, 2], [(1, 1, 1), (0, 0, 0), (1, 0, 1)]))
    mesh = file.load()
    for at in (1.0, 2.0):
        part = mesh.with_pose(time=at).parts[0]
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0)
        assert np.ptp(part.positions[:, 1]) == 0.0


# --- names and values ----------------------------------------------------------------------------


def loaded_glb(file):
    """Return the mesh of a file and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = file.load()
    return mesh, [str(each.message) for each in caught]


def two_meshes():
    """Two meshes with targets: the first has names, one of them repeated in the other mesh."""
    file = Glb({"children": [1, 2]}, {"mesh": 0}, {"mesh": 1, "translation": [3, 0, 0]})
    for names in (["smile", "smile", 5, "jaw"], ["frown", "smile", "", " two\nlines "]):
        primitive = file.primitive(*cube())
        primitive["targets"] = targets_of(file, 4, 24, 1)
        file.mesh(primitive, extras={"targetNames": names})
    return file


def test_names_of_shapes_and_clips():
    file = two_meshes()
    file.document["meshes"][1]["primitives"][0]["targets"] *= 2
    for name in ("walk", None, "walk", 7, "clip2"):
        file.clip(
            (0, "scale", [0, 2.5], [(1, 1, 1), (2, 2, 2)]), **({"name": name} if name else {})
        )
    mesh = file.load()
    own = ("smile", "smile.2", "shape3", "jaw")
    assert mesh.shapes == (*own, "frown", "two lines", "shape5", "shape6", "shape7", "shape8")
    assert mesh.clips == dict.fromkeys(("walk", "clip2", "walk.2", "clip4", "clip2.2"), 2.5)
    assert fr.load_mesh(files.MINI_HEAD).shapes == ()
    assert fr.load_mesh(files.MINI_HEAD).clips == {}


def boned(*names):
    """Return a file whose nodes 2, 3 and 4 have these names; 2 and 3 are joints."""
    file = rigid_eyes()
    for node, name in zip(file.document["nodes"][2:], names, strict=False):
        node["name"] = name
    return file


@pytest.mark.parametrize(
    ("names", "joints"),
    [
        (("Bone", "Bone", "other"), ("Bone", "Bone.2")),
        (("", 5), ("joint1", "joint2")),
        ((" two\nlines ", "joint1"), ("two lines", "joint1")),
    ],
)
def test_names_of_joints(names, joints, tmp_path, capsys):
    path = tmp_path / "a.glb"
    path.write_bytes(boned(*names).content())
    assert fr.load_mesh(path).joints == joints
    assert main(["info", str(path)]) == 0
    assert f"\n2 joints:\n  {', '.join(joints)}\n" in capsys.readouterr().out


def test_files_and_options_rotate_joints(tmp_path, egl):
    (tmp_path / "a.glb").write_bytes(boned("Bone", "Bone.001").content())
    scene = '[pose]\njoints = { Bone = [0, 0, 40], "Bone.001" = [10, 0, 0] }\n'
    (tmp_path / "scene.toml").write_text(scene)
    base = ["render", f"{tmp_path}/a.glb", "--size=64", "--samples=1", "-o", f"{tmp_path}/a.png"]
    assert main([*base, "--scene", f"{tmp_path}/scene.toml", "--joint", "Bone.001=0,0,-70"]) == 0
    mesh = fr.load_mesh(tmp_path / "a.glb")
    angles = {"Bone": (0, 0, 40), "Bone.001": (0, 0, -70)}
    with fr.Renderer((64, 64), samples=1, backend=egl) as renderer:
        image, still = (
            renderer.render(fr.Scene(mesh.with_pose(joints=joints))).srgb8()
            for joints in (angles, {})
        )
    found = read_image(tmp_path / "a.png").pixels
    np.testing.assert_array_equal(found, image)
    assert (image != still).any(axis=-1).mean() > 0.1


def test_a_shape_moves_all_parts_that_have_it():
    mesh = two_meshes().load()
    pose = mesh.with_pose({"smile": 1.0})
    for part, own in zip(pose.parts, mesh.parts, strict=True):
        assert np.abs(part.positions - own.positions).max() > 0.1
    pose = mesh.with_pose({"frown": 1.0})
    assert_equal(pose.parts[0].positions, mesh.parts[0].positions, "part without the shape")
    assert np.abs(pose.parts[1].positions - mesh.parts[1].positions).max() > 0.1


def test_given_weights_override_the_clip_and_a_pose_starts_from_the_file():
    file = morph_stress()
    mesh = file.load()
    pose = mesh.with_pose({"Key 1": 3.0}, clip="Pulse", time=1.7)
    again = pose.with_pose({"Key 2": 0.5})
    assert_pose(again, file, {"Key 2": 0.5}, None, 0.0)
    for same in (mesh.with_pose(), pose.with_pose(), mesh.with_pose({"Key 5": -0.2})):
        for part, own in zip(same.parts, mesh.parts, strict=True):
            np.testing.assert_allclose(part.positions, own.positions, atol=1e-12)
            np.testing.assert_allclose(part.normals, own.normals, atol=1e-12)
    first = mesh.with_pose(time=0.5), mesh.with_pose(clip="Individuals", time=0.5)
    assert_equal(*(each.parts[0].positions for each in first), "first clip")
    begin = mesh.with_pose(clip="Pulse"), mesh.with_pose(clip="Pulse", time=0)
    assert_equal(*(each.parts[0].positions for each in begin), "no time")


def test_a_pose_keeps_the_rest_of_the_mesh():
    mesh = morph_stress().load()
    pose = mesh.with_pose({"Key 1": 1.0})
    for name in ("name", "bounds", "millimetres"):
        assert getattr(pose, name) is getattr(mesh, name)
    assert pose.geometry is mesh.geometry
    moved = fr.tracked(pose.with_positions([part.positions + 0.1 for part in mesh.parts]))
    again = moved.with_material(m=0.2).with_pose({"Key 1": 1.0})
    assert_equal(again.parts[0].positions, pose.parts[0].positions, "after other positions")
    assert_equal(again.bounds, mesh.bounds, "bounds")
    assert again.materials[0].m == 0.2
    chosen = mesh.select("part2").with_material(m=0.2)
    assert_equal(
        chosen.with_pose({"Key 1": 1.0}).parts[0].positions, pose.parts[1].positions, "selected"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weights": {"smil": 1.0}}, "bytes has no shape 'smil': its shapes are Key 1, Key 2, "),
        ({"weights": {3: 1.0}}, "bytes has no shape 3: its shapes are Key 1"),
        ({"weights": {"Key 1": math.nan}}, "weight of 'Key 1' = nan is outside [-100, 100]"),
        ({"weights": {"Key 1": True}}, "weight of 'Key 1' = True is not a number"),
        ({"clip": "run"}, "clip = 'run', which bytes lacks: its clips are Individuals, TheWave"),
        ({"time": 2.01}, "time of clip 'Individuals' = 2.01 is outside [0, 2]"),
        ({"clip": "Pulse", "time": -0.1}, "time of clip 'Pulse' = -0.1 is outside [0, 2]"),
        ({"time": "1"}, "time of clip 'Individuals' = '1' is not a number"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    assert message in error_of(morph_stress().load(), **arguments)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"hed": (0, 9, 0)}, "bytes has no joint 'hed': its joints are joint1, joint2"),
        ({"joint1": 9.0}, "joint 'joint1' = 9.0: give three numbers in [-3600, 3600] degrees"),
        ({"joint1": (0, math.nan, 0)}, "joint 'joint1' = (0, nan, 0): give three numbers in"),
    ],
)
def test_invalid_joints_raise(joints, message):
    assert message in error_of(rigid_eyes().load(), joints=joints)


def error_of(mesh, *arguments, **more):
    with pytest.raises(InputError) as caught:
        mesh.with_pose(*arguments, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_meshes_without_rig_or_clips_raise():
    still = fr.load_mesh(files.MINI_HEAD)
    assert "has no shapes, clips or joints: give a glTF file" in error_of(still, {"smile": 1.0})
    file = morph_stress()
    del file.document["animations"]
    mesh = file.load()
    assert "time = 1 needs a clip, which bytes lacks: it has no clips" in error_of(mesh, time=1)
    file = box_animated()
    assert "has no shape 'smile': it has no shapes" in error_of(file.load(), {"smile": 1.0})
    assert "no joint 'a': it has no joints" in error_of(file.load(), joints={"a": (0, 9, 0)})
    with pytest.raises(InputError, match="vertices = 'a.npy' exclude weights, joints, clip and"):
        fr.Pose(joints={"a": (0, 9, 0)}, vertices="a.npy")


def test_a_pose_that_leaves_the_camera_behind_raises():
    file = Glb({"mesh": 0})
    file.mesh(file.primitive(*cube()))
    file.clip((0, "translation", [0, 1], [(0, 0, 0), (1e30, 0, 0)]))
    mesh = file.load()
    assert "the pose moves vertices of bytes to" in error_of(mesh, time=1.0)
    mesh.with_pose(time=0.0)


# --- files that are damaged or hostile -----------------------------------------------------------


def posable():
    """Return a file with a clip "walk" of one translation, and its one animation."""
    file = Glb({"mesh": 0}, {})
    file.mesh(file.primitive(*cube()))
    return file, file.clip((0, "translation", [0, 1], [(0, 0, 0), (1, 0, 0)]), name="walk")


def with_keys(times=(0, 1), values=((0, 0, 0), (1, 0, 0)), node=0, path="translation", **more):
    """Return a change of the sampler's keys and the channel's target."""

    def change(file, animation):
        animation["samplers"][0] |= {"input": file.add(times), "output": file.add(values), **more}
        animation["channels"][0]["target"] = {"node": node, "path": path}

    return change


def with_accessor(**changes):
    """Return a change of the accessor of the sampler's values."""

    def change(file, animation):
        file.document["accessors"][animation["samplers"][0]["output"]] |= changes

    return change


def without_view(file, animation):
    del file.document["accessors"][animation["samplers"][0]["output"]]["bufferView"]


def of_a_matrix(file, _):
    file.document["nodes"][0]["matrix"] = np.eye(4).ravel().tolist()


DAMAGED = {
    "backwards": (with_keys([1, 0]), "the times run backwards"),
    "nan time": (with_keys([0, math.nan]), "has a value that is not finite"),
    "negative time": (with_keys([-1, 0]), "the first time is below 0"),
    "nan value": (with_keys(values=[(0, 0, 0), (0, math.nan, 0)]), "a value that is not finite"),
    "few values": (with_keys([0, 1, 2]), "the values have the shape (2, 3) for 3 keys"),
    "cubic": (with_keys(interpolation="CUBICSPLINE"), "the values have the shape (2, 3) for 2"),
    "no times": (with_keys(np.zeros((2, 3))), "the times have the shape (2, 3)"),
    "kind": (with_keys(interpolation="SLOW"), "interpolation 'SLOW' is unknown"),
    "node": (with_keys(node=2), "node = 2 is not an index into the 2 nodes"),
    "path": (with_keys(path="visible"), "target.path = 'visible' is unknown"),
    "targets": (with_keys(path="weights"), "nodes[0], which has no morph targets"),
    "beyond": (with_accessor(count=1000), "needs 12000 bytes of bufferViews"),
    "far beyond": (with_accessor(count=10**9), "the file has too many animated values"),
    "no view": (without_view, "has no bufferView"),
    "matrix": (of_a_matrix, "moves nodes[0], which has a matrix"),
    "sampler": (lambda _, own: own["channels"][0].update(sampler=4), "sampler = 4 does not exist"),
    "twice": (lambda _, own: own["channels"].extend(own["channels"]), "has the same target as"),
    "no channels": (lambda _, own: own.pop("channels"), "animations[0].channels is missing"),
    "text": (lambda _, own: own.update(samplers="x"), "samplers = 'x' is not a list"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_clip_does_not_prevent_drawing(case):
    change, message = DAMAGED[case]
    file, animation = posable()
    plain = file.load()
    change(file, animation)
    file.clip((0, "scale", [0, 1], [(1, 1, 1), (2, 2, 2)]), name="grow")
    mesh, messages = loaded_glb(file)
    assert messages == []
    assert_equal(mesh.parts[0].positions, plain.parts[0].positions, case)
    for name in ("walk", None):
        text = error_of(mesh, clip=name, time=0.5)
        assert text.startswith("clip 'walk' of bytes is damaged (")
        assert message in text
    assert mesh.clips == ({"grow": 1.0} if case != "matrix" else {})


@pytest.mark.parametrize("animations", [7, {}, "x", [], [3], [None], [{}], [[]]])
def test_animations_of_another_type_are_no_clips(animations):
    file, _ = posable()
    file.document["animations"] = animations
    mesh, messages = loaded_glb(file)
    assert messages == []
    assert mesh.clips == {}


def test_a_damaged_shape_does_not_prevent_drawing():
    file = two_meshes()
    first, second = (mesh["primitives"][0]["targets"] for mesh in file.document["meshes"])
    file.document["accessors"][first[0]["POSITION"]]["count"] = 23
    second[0]["POSITION"] = file.add(np.full((24, 3), math.nan))
    mesh, messages = loaded_glb(file)
    assert messages == []
    mesh.with_pose({"smile": 0.0, "frown": 0.0, "jaw": 1.0})
    assert "targets[0]: POSITION has the wrong number of entries" in error_of(mesh, {"smile": 1.0})
    assert "the pose moves vertices of bytes to nan" in error_of(mesh, {"frown": 1.0})
    file.document["nodes"][1]["weights"] = [0.5]
    with pytest.raises(InputError, match="is damaged .*POSITION has the wrong number"):
        file.load()


def test_shapes_and_clips_that_share_much_data_are_refused(monkeypatch):
    """Thousands of accessors may refer to the same bytes."""
    file, _ = posable()
    file.document["meshes"][0]["primitives"][0]["targets"] = [
        {"POSITION": file.add(np.ones((24, 3)))} for _ in range(9)
    ]
    monkeypatch.setattr("facerender.loading.gltf_accessors._MAX_WORDS", 300)
    mesh, messages = loaded_glb(file)
    assert messages == []
    assert "the file has too many animated values" in error_of(mesh, {"shape9": 1.0})
    mesh.with_pose({"shape1": 1.0}, clip="walk")


def test_pointers_are_ignored_with_a_warning():
    file, animation = posable()
    target = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/x"}}}
    animation["channels"].append({"sampler": 0, "target": target})
    animation["channels"].append({"sampler": 0, "target": {"path": "scale"}})
    mesh, messages = loaded_glb(file)
    assert messages == []
    with pytest.warns(fr.FacerenderWarning) as caught:
        pose = mesh.with_pose(clip="walk", time=1.0)
    assert [str(each.message) for each in caught] == [
        "clip 'walk' of bytes has channels of KHR_animation_pointer: ignored"
    ]
    step = pose.parts[0].positions - mesh.parts[0].positions
    np.testing.assert_allclose(step, np.tile((1.0, 0.0, 0.0), (24, 1)), atol=1e-6)


def test_unused_vertices_do_not_move():
    """The loader moves them into the bounds; a pose must not move them out again."""
    places, faces, normals = cube()
    file = Glb({"mesh": 0})
    far = [(math.nan, 0, 0), (1e38, 0, 0)]
    file.mesh(file.primitive([*places, *far], faces, [*normals, (1, 0, 0), (1, 0, 0)]))
    file.clip((0, "scale", [0, 1], [(1, 1, 1), (2, 2, 2)]))
    mesh, messages = loaded_glb(file)
    assert messages == ["bytes has 1 non-finite vertices: 0 faces dropped"]
    pose = mesh.with_pose(time=1.0)
    np.testing.assert_allclose(pose.parts[0].positions[:24], 2.0 * np.array(places), atol=1e-6)
    assert np.abs(pose.parts[0].positions).max() < 1.1


def test_shapes_of_primitives_that_share_vertices():
    """The loader keeps only the vertices that a primitive uses."""
    places, faces, normals = tube(rings=41, sectors=24)
    file = Glb({"mesh": 0})
    whole = file.primitive(places, faces, normals)
    whole["targets"] = targets_of(file, 2, len(places), 12)
    few = {**whole, "indices": file.add(np.ravel(faces[100:220]), "<u2")}
    file.mesh(few, {**whole, "indices": file.add(np.ravel(faces[220:]), "<u2")})
    mesh = file.load()
    assert len(mesh.parts[0].positions) < 200
    pose = mesh.with_pose({"shape1": 1.0, "shape2": -0.3})
    moves = [Reference(file).accessor(each["POSITION"]) for each in whole["targets"]]
    moved = places + moves[0] - 0.3 * moves[1]
    for part, own in zip(pose.parts, (faces[100:220], faces[220:]), strict=True):
        np.testing.assert_allclose(part.positions[part.faces], moved[own], atol=1e-6)


def test_vertices_without_weights_follow_their_first_joint():
    file = Glb({"children": [1, 2, 3]}, {"mesh": 0, "skin": 0}, {}, {})
    joints, weights = np.zeros((2, len(tube()[0]), 4))
    joints[:, 0] = tube()[0][:, 1] > 1.0
    skinned_tube(file, joints, weights)
    file.skin([2, 3])
    file.clip((3, "translation", [0, 1], [(0, 0, 0), (2, 0, 0)]))
    mesh = file.load()
    step = mesh.with_pose(time=1.0).parts[0].positions - mesh.parts[0].positions
    np.testing.assert_allclose(step, joints[:, :1] * (2.0, 0.0, 0.0), atol=1e-12)


def test_a_skinned_node_does_not_place_a_mesh_without_joints():
    """The specification forbids such files; they are drawn in mesh space, also in a pose."""
    file = Glb({"children": [1, 2]}, {"mesh": 0, "skin": 0, "translation": [5, 0, 0]}, {})
    primitive = file.primitive(*cube())
    primitive["targets"] = [{"POSITION": file.add(np.ones((24, 3)))}]
    file.mesh(primitive)
    file.skin([2])
    mesh = file.load()
    np.testing.assert_allclose(mesh.parts[0].positions, cube()[0], atol=1e-6)
    pose = mesh.with_pose({"shape1": 1.0})
    np.testing.assert_allclose(pose.parts[0].positions, np.add(cube()[0], 1.0), atol=1e-6)


# --- storage -------------------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize("sample", SAMPLES)
def test_rigs_survive_the_cache(sample, tmp_path, cache_folder):
    path = tmp_path / "a.glb"
    path.write_bytes(sample().content())
    first = fr.load_mesh(path, cache=True)
    wait_for_cache()
    assert len([*cache_folder.glob("meshes/*")]) == 1
    cached = fr.load_mesh(path, cache=True)
    assert cached is not first
    assert_equal(with_geometry(first), with_geometry(cached), "mesh")
    skeletons = {part.rig.skeleton for part in cached.parts if part.rig is not None}
    assert len(skeletons) == 1
    assert cached.joints == first.joints
    for clip, duration in first.clips.items():
        poses = [each.with_pose(clip=clip, time=0.6 * duration) for each in (first, cached)]
        assert_equal(*(pose.parts[0].positions for pose in poses), "positions")
        assert_equal(*(pose.parts[0].normals for pose in poses), "normals")


def test_info_lists_shapes_and_clips(tmp_path, capsys):
    file, animation = posable()
    animation["samplers"][0]["interpolation"] = "SLOW"
    file.clip((0, "scale", [0, 1.25], [(1, 1, 1), (2, 2, 2)]), name="grow")
    targets = targets_of(file, 1, 24, 1) * 70
    file.document["meshes"][0]["primitives"][0]["targets"] = targets
    path = tmp_path / "a.glb"
    path.write_bytes(file.content())
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["shapes"] == [f"shape{i}" for i in range(1, 71)]
    assert facts["clips"] == {"walk": None, "grow": 1.25}
    assert main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = lines.index("70 shapes:")
    assert lines[first + 1] == "  " + ", ".join(f"shape{i}" for i in range(1, 9))
    assert lines[first + 8].endswith("shape63, shape64")
    assert lines[first + 9] == "  and 6 more: --json lists all"
    assert lines[first + 10 : first + 12] == ["2 clips:", "  walk damaged, grow 1.25 s"]
    assert main(["info", str(files.MINI_HEAD)]) == 0
    assert "shapes" not in capsys.readouterr().out


def test_a_million_keys():
    file = Glb({"mesh": 0})
    file.mesh(file.primitive(*cube()))
    times = np.linspace(0, 1000, 10**6).astype("<f4")
    file.clip((0, "translation", times, np.stack([times, 0 * times, 0 * times], axis=1)))
    mesh = file.load()
    start = time.perf_counter()
    for at in np.linspace(0, 1000, 100):
        centre = mesh.with_pose(time=at).parts[0].positions.mean(axis=0)
        np.testing.assert_allclose(centre, (at, 0, 0), atol=1e-3)
    assert time.perf_counter() - start < 2.0  # 20 ms each; reading all keys takes longer
