"""Tests poses of glTF files against an evaluation that follows the text of the glTF 2.0
specification with loops and with SciPy's rotations. The files resemble Khronos's sample assets."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import facerender as fr
from tests.awkward_files import join_glb

KINDS = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
KINDS["|u1"], KINDS["|i1"] = 5121, 5120
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
HALF = math.sqrt(0.5)


# --- files ---------------------------------------------------------------------------------------


class Glb:
    """A glTF document and its buffer, to which accessors, clips and meshes can be added."""

    def __init__(self, *nodes):
        self.binary = b""
        lists: dict[str, Any] = {"meshes": [], "accessors": [], "bufferViews": []}
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": list(nodes),
            "buffers": [{"byteLength": 0}],
            **lists,
        }

    def view(self, values):
        content = np.ascontiguousarray(values).tobytes()
        self.binary += bytes(-len(self.binary) % 4)
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        )
        self.binary += content
        self.document["buffers"][0]["byteLength"] = len(self.binary)
        return len(self.document["bufferViews"]) - 1

    def add(self, values, kind="<f4", sparse=False, **more):
        """Add an accessor of the values, or only of the rows that are not 0."""
        values = np.asarray(values, kind)
        values = values.reshape(len(values), -1)
        names = {width: name for name, width in WIDTHS.items()}
        entry = {"componentType": KINDS[kind], "count": len(values), **more}
        entry["type"] = names[values.shape[1]]
        if sparse:
            rows = np.flatnonzero(values.any(axis=1))
            entry["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": self.view(rows.astype("<u2")), "componentType": 5123},
                "values": {"bufferView": self.view(values[rows])},
            }
        else:
            entry["bufferView"] = self.view(values)
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives, **more):
        self.document["meshes"].append({"primitives": list(primitives), **more})
        return len(self.document["meshes"]) - 1

    def primitive(self, positions, faces, normals=None, **attributes):
        own = {"POSITION": self.add(positions)}
        if normals is not None:
            own["NORMAL"] = self.add(normals)
        return {"attributes": {**own, **attributes}, "indices": self.add(np.ravel(faces), "<u2")}

    def clip(self, *channels, **more):
        """Add an animation; a channel is (node, path, times, values, interpolation)."""
        animation: dict[str, Any] = {"channels": [], "samplers": [], **more}
        for node, path, times, values, *interpolation in channels:
            rows = np.ravel(values) if path == "weights" else values
            sampler = {"input": self.add(times), "output": self.add(rows)}
            if interpolation:
                sampler["interpolation"] = interpolation[0]
            number = len(animation["samplers"])
            animation["samplers"].append(sampler)
            animation["channels"].append(
                {"sampler": number, "target": {"node": node, "path": path}}
            )
        self.document.setdefault("animations", []).append(animation)
        return animation

    def content(self):
        return join_glb(self.document, self.binary + bytes(-len(self.binary) % 4))

    def load(self):
        return fr.load_mesh(self.content(), kind="glb")


def triangle():
    return [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]


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


def animated_triangle():
    file = Glb({"mesh": 0})
    file.mesh(file.primitive(*triangle()))
    file.clip((0, "rotation", [0, 0.25, 0.5, 0.75, 1], around("z", 0, 90, 180, 270, 360)))
    return file


def animated_cube():
    file = Glb({"mesh": 0, "rotation": [0, 0, 0, 1]})
    file.mesh(file.primitive(*cube()))
    keys = around("y", 0, 180, 360)
    keys[2] *= -1.0  # the same rotation, and the longer arc without the change of sign
    file.clip((0, "rotation", [0, 1, 2], 1.5 * keys), name="animation_AnimatedCube")
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


def simple_morph():
    """The sample's triangle, whose two targets move its upper vertex in its plane."""
    file = Glb({"mesh": 0})
    primitive = file.primitive(*triangle())
    primitive["targets"] = [
        {"POSITION": file.add([(0, 0, 0), (0, 0, 0), (-1, 1, 0)])},
        {"POSITION": file.add([(0, 0, 0), (0, 0, 0), (1, 1, 0)])},
    ]
    file.mesh(primitive, weights=[0.5, 0.5])
    file.clip((0, "weights", [0, 1, 2, 3, 4], [(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)], "LINEAR"))
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


def animated_morph_cube():
    file = Glb({"mesh": 0, "rotation": [HALF, 0, 0, HALF], "scale": [100, 100, 100]})
    primitive = file.primitive(*cube(0.02))
    primitive["targets"] = targets_of(file, 2, 24, 1)
    for target in primitive["targets"]:
        file.document["accessors"][target["POSITION"]]["componentType"] = 5126
    file.mesh(primitive, extras={"targetNames": ["thin", "angle"]}, weights=[0, 0])
    rng = np.random.default_rng(2)
    values = 0.02 * rng.random((7, 3, 2))
    file.clip((0, "weights", np.arange(7) / 3.0, values, "CUBICSPLINE"), name="Square")
    return file


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
    for name in ("Individuals", "TheWave", "Pulse"):
        file.clip((0, "weights", [0, 0.5, 2], rng.random((3, 8))), name=name)
    return file


def simple_skin():
    """The sample's strip of five pairs of vertices and two joints, without normals."""
    places = [(x - 0.5, 0.5 * y, 0) for y in range(5) for x in range(2)]
    faces = [f for i in range(0, 8, 2) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    upper = np.repeat(np.linspace(0, 1, 5), 2)
    file = Glb({"children": [1, 2]}, {"skin": 0, "mesh": 0}, {"children": [3]}, {})
    file.document["nodes"][2]["translation"] = [0.0, 1.0, 0.0]
    joints = np.zeros((10, 4))
    joints[:, 1] = 1
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], axis=1)
    file.mesh(
        file.primitive(places, faces, JOINTS_0=file.add(joints, "<u2"), WEIGHTS_0=file.add(weights))
    )
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[:, 3, 1] = -1.0
    file.document["skins"] = [{"joints": [2, 3], "inverseBindMatrices": file.add(inverse)}]
    file.clip((3, "rotation", np.arange(5) * 0.5, around("z", 0, 45, 90, -45, 0)))
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
    """A tube in a Z-up armature; a clip moves, turns and scales its joints."""
    file = Glb(
        {"children": [1, 2], "rotation": [-HALF, 0, 0, HALF]},
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"children": [3], "translation": [0, 0.1, 0], "rotation": around("x", 10)[0].tolist()},
        {"translation": [0, 1, 0], "scale": [1, 0.8, 1.3]},
    )
    skinned_tube(file, *along(tube()[0], 2))
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 3, 1] = -1.0
    file.document["skins"] = [{"joints": [2, 3], "inverseBindMatrices": file.add(inverse)}]
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
    file.document["skins"] = [
        {"joints": [1, 2, 3], "inverseBindMatrices": file.add(inverse)},
        {"joints": [3, 2, 1], "inverseBindMatrices": file.add(2.0 * inverse[::-1])},
    ]
    file.clip(
        (1, "rotation", [0, 1], around("z", 0, 50)), (2, "scale", [0, 1], [(1,) * 3, (2,) * 3])
    )
    return file


def cesium_man():
    """Two legs walk; the weights are normalised bytes."""
    file = Glb(
        {"children": [1, 2]},
        {"mesh": 0, "skin": 0},
        {"children": [3], "name": "Skeleton_torso_joint_1"},
        {"translation": [0, 1, 0], "name": "leg_joint_R_1"},
    )
    joints, weights = along(tube()[0], 2)
    high = np.round(255 * weights[:, :1])
    skinned_tube(
        file, joints, np.hstack([high, 255 - high, 0 * weights[:, 2:]]), "<u1", normalized=True
    )
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 3, 1] = -1.0
    file.document["skins"] = [{"joints": [2, 3], "inverseBindMatrices": file.add(inverse)}]
    times = np.linspace(0.04, 2.0, 48)
    swing = 40 * np.sin(3 * times)
    file.clip(
        (2, "translation", times, np.stack([0 * times, 0.1 * np.sin(times), times], axis=1)),
        (2, "rotation", times, around("x", *swing)),
        (3, "rotation", times, around("x", *(-0.5 * swing))),
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
    file.document["skins"] = [{"joints": [*range(2, 10)], "inverseBindMatrices": file.add(inverse)}]
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
    file.document["skins"] = [{"joints": [3]}]
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


SAMPLES = [
    animated_triangle,
    animated_cube,
    box_animated,
    interpolation_test,
    simple_morph,
    animated_morph_cube,
    morph_stress,
    simple_skin,
    rigged_simple,
    recursive_skeletons,
    cesium_man,
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

    def parts(self, given, clip, at):
        """Return positions and normals of the primitives in the order of the scene."""
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
            self.visit(root, np.eye(4))
        found = []
        for number in self.order:
            if "mesh" in nodes[number]:
                found += self.mesh(nodes[number], self.worlds[number], given)
        return found

    def visit(self, number, parent):
        node = self.nodes[number]
        self.order.append(number)
        self.worlds[number] = parent @ local(node)
        for child in node.get("children", ()):
            self.visit(child, self.worlds[number])

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


def assert_pose(mesh, file, weights, clip, at):
    found = Reference(file).parts(weights, clip, at)
    assert len(mesh.parts) == len(found)
    for part, (places, normals) in zip(mesh.parts, found, strict=True):
        scale = max(1.0, np.abs(places).max())
        np.testing.assert_allclose(part.positions, places, atol=1e-6 * scale)
        np.testing.assert_allclose(part.normals, normals, atol=1e-6)


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
