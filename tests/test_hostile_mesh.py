"""Tests broken and malicious mesh files: each loads as a valid mesh with warnings about the omitted
parts, or is refused in one line with the file and the cause."""

from __future__ import annotations

import base64
import copy
import itertools
import json
import logging
import os
import re
import struct
import warnings
from collections.abc import Callable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.system import cache
from facerender.system.files import data_dir
from tests import awkward_files as files
from tests.awkward_files import MINI_HEAD, mini_head
from tests.verification.cache import wait_for_cache

Change = Callable[[dict[str, Any]], Any]

HEAD = data_dir("assets") / "head.glb"
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face {count}\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
)

WITH_UV = re.sub(r"^([01] [01] [01])$", r"\1 0.5 0.5", PLY.format(count=2), flags=re.M).replace(
    "float z\n", "float z\nproperty float s\nproperty float t\n"
)


def write(path, content):
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def changed(path, change, **options):
    """Write the head as GLB after ``change`` has edited its document."""
    document, binary = files.gltf(mini_head(), **options)
    change(document)
    return write(path, files.join_glb(document, binary))


def refused(path, **options):
    """Return the error message about a file, one printable line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fr.FacerenderWarning)
        with pytest.raises(fr.InputError) as caught:
            fr.load_mesh(path, **options)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 400
    assert "()" not in message
    return message


def loaded(path, **options):
    """Load a mesh, check its values, and return it with its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("error")
        warnings.simplefilter("always", fr.FacerenderWarning)
        mesh = fr.load_mesh(path, **options)
    for part in mesh.parts:
        assert len(part.faces)
        assert part.faces.max() < len(part.positions)
        used = np.unique(part.faces)
        assert np.isfinite(part.positions[used]).all()
        np.testing.assert_allclose(np.linalg.norm(part.normals[used], axis=1), 1.0, atol=1e-5)
        assert part.uv is None or np.isfinite(part.uv.astype(np.float32)).all()
    assert np.isfinite(mesh.bounds).all()
    return mesh, [str(each.message) for each in caught]


# --- glTF against its schema ---------------------------------------------------------------------


GONE = object()


def changing(changes):
    """Return a function that sets values in a document; keys are paths with dots."""

    def change(document):
        for path, value in changes.items():
            *keys, last = (int(key) if key.isdecimal() else key for key in path.split("."))
            inner = reduce(getitem, keys, document)
            if value is GONE:
                del inner[last]
            else:
                inner[last] = copy.deepcopy(value)

    return change


PBR = "materials.0.pbrMetallicRoughness"
SPARSE = {
    "count": 1,
    "indices": {"bufferView": 3, "componentType": 5125},
    "values": {"bufferView": 0},
}
VAST = {"bufferView": GONE, "count": 300_000_000, "sparse": SPARSE}


def instances(count):
    return {"nodes": [{"mesh": 0}] * count, "scenes.0.nodes": list(range(count))}


DAMAGED = [
    ({"accessors.0.bufferView": 99}, r"accessors\[0\]\.bufferView = 99 is not an index"),
    ({"accessors.0.bufferView": GONE}, r"accessors\[0\] has no bufferView"),
    ({"bufferViews": [7]}, r"bufferViews\[0\] = 7 is not an object"),
    ({"bufferViews.0.byteOffset": "x"}, r"\[0\]\.byteOffset = 'x' is not an integer >= 0"),
    ({"bufferViews.0.byteOffset": -4}, "= -4 is not an integer >= 0"),
    ({f"{PBR}.metallicRoughnessTexture": 5}, "metallicRoughnessTexture = 5 is not an object"),
    ({"materials.0.normalTexture": {"index": 1}}, r"normalTexture\.index = 1 is not an index"),
    ({"textures.0.source": 9}, "source = 9 is not an index"),
    ({"buffers.0.byteLength": 10**9}, r"buffers\[0\] should have 1000000000 bytes, but has \d+"),
    ({"bufferViews.1.byteLength": 10**9}, r"bufferViews\[1\] ends at byte \d+ of buffers\[0\]"),
    ({"accessors.0.count": 300_000_000}, r"accessors\[0\] needs 3600000000 bytes"),
    (
        {f"accessors.0.{key}": value for key, value in VAST.items()},
        r"accessors\[0\]\.count = 300000000 is too large without a bufferView",
    ),
    ({"accessors.0.sparse": SPARSE, "accessors.0.sparse.count": 6722}, r"bufferViews\[0\]"),
    ({"bufferViews.0.byteStride": 4}, r"byteStride = 4 is less than 12"),
    ({"accessors.0.componentType": 1}, "componentType = 1 is not a glTF component type"),
    ({"meshes.0.primitives.0.indices": 0}, "indices have the wrong type"),
    ({"meshes.0.primitives.0.attributes.POSITION": 2}, "POSITION has the wrong type"),
    ({"accessors.1.count": 7}, "NORMAL has 7 entries, POSITION has 3444"),
    ({"nodes.0.children": [0]}, r"nodes\[0\] has two parents, or is its own ancestor"),
    ({"scene": 1}, "scene = 1 is not an index into the 1 scenes"),
    ({"nodes.0.scale": [1, 1]}, r"scale = \[1, 1\] is not 3 numbers"),
    ({"nodes.0.translation": [float("nan"), 0, 0]}, r"translation\[0\] = nan is not a number"),
    ({"nodes.0.translation": [10**400, 0, 0]}, r"= 1000\d*\.\.\.\d* is not a number"),
    ({"buffers": []}, r"buffer = 0 is not an index into the 0 buffers"),
    ({"buffers.0.uri": "data:;base64,A"}, "is damaged"),
    (instances(1025), "more than 1024 parts"),
    (instances(600), "draws its geometry more than 8 times"),
    ({"nodes": [{}] * 140_000}, "has 140000 nodes, but the limit is 131072"),
    ({"materials.0.alphaCutoff": "half"}, "alphaCutoff = 'half' is not a number"),
    ({"nodes.0.skin": 3}, r"skin = 3 is not an index into the 0 skins"),
    ({"meshes.0.weights": [None]}, r"weights\[0\] = None is not a number"),
    ({"meshes.0.primitives.0.targets": [{"POSITION": 99}]}, "targets.*= 99 is not an index into"),
    ({"samplers": [{"wrapS": -1}]}, r"samplers\[0\].wrapS = -1 is not an integer >= 0"),
    ({"materials.0.doubleSided": "no"}, "doubleSided|double_sided"),
]


@pytest.mark.parametrize(("changes", "message"), DAMAGED)
def test_damaged_gltf(changes, message, tmp_path):
    path = changed(tmp_path / "a.glb", changing(changes))
    with pytest.raises(fr.InputError, match=message):
        fr.load_mesh(path)
    assert refused(path).startswith("a.glb ")


JSON: dict[str, tuple[bytes, str]] = {
    "deep": (b'{"asset":{},"meshes":' + b"[" * 100_000, "is not glTF: its JSON cannot be read"),
    "4301 digits": (b'{"asset":{},"scene":' + b"9" * 4301 + b"}", "its JSON cannot be read"),
    "1e400": (b'{"asset":{},"scene":1e400,"meshes":[{"primitives":[]}]}', "scene = inf is not"),
    "many values": (b'{"asset":{},"meshes":[' + b"[]," * 10**6 + b"0]}", "more than 2000000 value"),
    "an error page": (b'{"error": "not found"}', r"is not glTF but other JSON \(\{'error'"),
    "bytes": (bytes(range(128, 256)), "its JSON cannot be read"),
    "null": (b"null", r"is not glTF but other JSON \(None"),
}


@pytest.mark.parametrize("case", JSON)
def test_json_that_is_not_gltf_is_refused(case, tmp_path):
    content, message = JSON[case]
    assert message.replace("\\", "") in refused(write(tmp_path / "a.gltf", content))


def test_glb_chunks(tmp_path):
    good = MINI_HEAD.read_bytes()
    for offset, value, message in (
        (4, 1, "glTF version 1: export it as version 2"),
        (12, 2**32 - 1, "a chunk has 4294967295 bytes, the file "),
        (16, 0, "it has no JSON chunk"),
        (8, len(good) + 1, "is truncated: it should have"),
    ):
        data = bytearray(good)
        struct.pack_into("<I", data, offset, value)
        assert message in refused(write(tmp_path / "a.glb", bytes(data)))


def test_unused_properties_may_have_any_value(tmp_path):
    """This concerns names, extras, animations and extensions, which do not affect the image."""

    def change(document):
        document |= {"extras": json.loads("[" * 500 + "]" * 500), "animations": 7}
        document["nodes"][0] |= {"name": 5, "extras": {"units": []}}
        document["meshes"][0] |= {"name": ["x"], "extras": {"process": True}}
        document["accessors"].append({"componentType": 5126, "count": 3 * 10**8, "type": "VEC3"})

    mesh, messages = loaded(changed(tmp_path / "a.glb", change))
    assert messages == []
    np.testing.assert_allclose(mesh.bounds, fr.load_mesh(MINI_HEAD).bounds, atol=1e-7)


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans(mode, tmp_path):
    """The corners of a square are in fan order or in strip order."""
    around = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    positions = around[[0, 1, 3, 2]] if mode == 5 else around
    file = files.Glb({"mesh": 0})
    file.mesh({"attributes": {"POSITION": file.add(positions)}, "mode": mode})
    mesh, _ = loaded(write(tmp_path / "a.glb", file.content()))
    (part,) = mesh.parts
    corners = part.positions[part.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_array_equal(np.abs(areas[:, 2]), [1, 1])
    assert areas[0, 2] == areas[1, 2]


@pytest.mark.parametrize("write_mesh", ["glb", "obj", "ply"])
def test_sizes_of_large_maps_are_named(write_mesh, tmp_path):
    path = tmp_path / f"a.{write_mesh}"
    if write_mesh == "glb":
        files.write_glb(path, mini_head(), image={"uri": "wide.png"})
    elif write_mesh == "obj":
        write(tmp_path / "a.mtl", "newmtl skin\nmap_Kd wide.png\n")
        write(path, b"mtllib a.mtl\nusemtl skin\n" + TRIANGLE.replace(b"v 0 1", b"vt 0 0\nv 0 1"))
        path.write_bytes(path.read_bytes() + b"f 1/1 2/1 3/1\n")
    else:
        comment = "comment TextureFile wide.png\nelement vertex"
        write(path, WITH_UV.replace("element vertex", comment) + "3 0 1 2\n3 0 1 3\n")
    Image.new("1", (20000, 4)).save(tmp_path / "wide.png")
    text = refused(path)
    assert f"wide.png (named by a.{write_mesh}) is 20000 x 4 pixels of 4 bytes: at most 16" in text
    assert "; make it smaller, or pass --albedo FILE" in text


CONVERTED = {
    "from CRLF to LF": lambda data: data.replace(b"\r\n", b"\n"),
    "from LF to CRLF": lambda data: data.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"),
    "to UTF-8 with replacement characters": lambda data: data.decode(errors="replace").encode(),
    "to UTF-8": lambda data: data.decode("latin-1").encode(),
    "to Unicode": lambda data: data.decode("latin-1").encode("utf-16"),
}


@pytest.mark.parametrize("how", CONVERTED)
def test_files_converted_as_text_are_named(how, tmp_path):
    """Random vertices: a compressed or random file holds CRLF once in 65536 bytes."""
    positions = np.random.default_rng(3).random((40_000, 3), dtype=np.float32)
    file = files.Glb({"mesh": 0})
    file.mesh({"attributes": {"POSITION": file.add(positions)}})
    convert = CONVERTED[how]
    why = f"is damaged, because it was converted as text ({how}): transfer it again as binary"
    for data in (file.content(), HEAD.read_bytes()):
        text = refused(write(tmp_path / "a.glb", convert(data)))
        assert text.startswith(f"a.glb {why}")
        assert text.endswith("in Git, add '*.glb binary' to .gitattributes")
    if how != "to Unicode":
        file.document["buffers"][0]["uri"] = "a.bin"
        write(tmp_path / "a.bin", convert(file.binary))
        text = refused(write(tmp_path / "a.gltf", json.dumps(file.document)))
        assert text.startswith(f"a.bin {why}")
        assert text.endswith("in Git, add '*.bin binary' to .gitattributes")


@pytest.mark.first_case
@pytest.mark.parametrize("length", [100, 65536, 300_000, -4000, -100, -8, -1])
def test_truncated_files_were_not_converted(length, tmp_path):
    data = HEAD.read_bytes()
    assert "a.glb is truncated: it should have 3618724 bytes" in refused(
        write(tmp_path / "a.glb", data[:length])
    )
    assert fr.load_mesh(write(tmp_path / "a.glb", data + bytes(length % 7) + b"\r\n")).parts


@pytest.mark.parametrize("kind", ["occlusion", "normal"])
def test_damaged_map_is_refused_or_warned_of(kind, tmp_path):
    material = {f"{kind}Texture": {"index": 0}}
    image = {"uri": "page.png"}
    path = files.write_glb(tmp_path / "a.glb", mini_head(), material=material, image=image)
    write(tmp_path / "page.png", "<html></html>")
    assert "page.png (named by a.glb) is not an image that can be read; replace it" in refused(path)
    write(tmp_path / "skin.jpg", mini_head().skin)
    mesh, messages = loaded(path, albedo=tmp_path / "skin.jpg")
    assert messages == ["page.png (named by a.glb) is not an image that can be read: ignored"]
    assert mesh.materials[0].albedo_map is not None


def test_damaged_draco(tmp_path):
    pytest.importorskip("DracoPy")
    data = files.write_draco(tmp_path / "a.glb", mini_head()).read_bytes()
    document, binary = files.split_glb(data)
    broken = files.join_glb(document, binary[:5] + bytes(len(binary) - 5))
    assert "DracoPy failed" in refused(write(tmp_path / "a.glb", broken))


# --- faces, coordinates --------------------------------------------------------------------------


@pytest.mark.parametrize("index", [-1, 4, 2**31 - 1, -(2**31)])
def test_invalid_face_indices_in_ply(index, tmp_path):
    good = "3 0 2 1\n3 0 1 3\n"
    path = write(tmp_path / "a.ply", PLY.format(count=3) + good + f"3 0 1 {index}\n")
    mesh, messages = loaded(path)
    assert "a.ply has 1 faces with invalid vertex indices: dropped" in messages
    assert sum(len(part.faces) for part in mesh.parts) == 2
    path = write(tmp_path / "a.ply", PLY.format(count=1) + f"3 0 1 {index}\n")
    assert "no face of a.ply" in refused(path)


def test_invalid_face_indices_in_gltf(tmp_path):
    head = mini_head()
    faces = head.faces.copy()
    faces[7, 1] = 2**32 - 1
    mesh, messages = loaded(files.write_glb(tmp_path / "a.glb", head.with_faces(faces)))
    assert messages == ["a.glb has 1 faces with invalid vertex indices: dropped"]
    assert len(mesh.parts[0].faces) == len(faces) - 1


@pytest.mark.parametrize("corner", ["999", "0", "-999", "1/9", "1//9"])
def test_invalid_face_indices_in_obj(corner, tmp_path):
    slash = "/1" if corner == "1/9" else "//1" if corner == "1//9" else ""
    lines = f"vt 0 0\nvn 0 0 1\nf 1{slash} 2{slash} 3{slash}\nf {corner} 2{slash} 3{slash}\n"
    mesh, messages = loaded(write(tmp_path / "a.obj", TRIANGLE + lines.encode()))
    assert messages == ["a.obj has 1 faces with invalid vertex indices: dropped"]
    assert len(mesh.parts[0].faces) == 1


def test_negative_indices_of_obj(tmp_path):
    lines = b"f -3 -2 -1\n" + TRIANGLE.replace(b"0 0 0", b"0 0 9") + b"f -3 -2 -1\n"
    mesh, messages = loaded(write(tmp_path / "a.obj", TRIANGLE + lines))
    (part,) = mesh.parts
    assert not any("dropped" in each for each in messages)
    np.testing.assert_array_equal(part.positions[part.faces].max(axis=1)[:, 2], [0, 9])
    text = b"vt 0.5 1\n" + TRIANGLE + b"f -3/-1 -2/1 3/-1/\nf 1 2 # 3\nvt 0 0\n"
    mesh, messages = loaded(write(tmp_path / "a.obj", text))
    np.testing.assert_array_equal(mesh.parts[0].uv, [[0.5, 1]] * 3)
    assert "a.obj has 1 faces with invalid vertex indices: dropped" in messages


def test_corners_of_obj_without_texture_coordinates(tmp_path):
    text = b"vt 0.5 1\nvn 0 0 1\n" + TRIANGLE + b"f 1/1/1 2/1/1 3/1/1\nf 1//1 3 2/1\n"
    mesh, messages = loaded(write(tmp_path / "a.obj", text))
    (part,) = mesh.parts
    uv = {(0, 0.5), (0, 0.0), (1, 0.5), (2, 0.5), (2, 0.0)}
    assert {*zip(part.sources.tolist(), part.uv[:, 0].tolist(), strict=True)} == uv
    assert "a.obj has 2 vertices without texture coordinates: set to 0" in messages
    assert not any("normals" in each for each in messages)  # missing normals are computed


def test_a_vertex_far_out_is_named(tmp_path):
    positions = mini_head().positions.copy()
    positions[17] = 1e30, 0.0, 0.0
    path = files.write_obj(tmp_path / "a.obj", mini_head().with_positions(positions), uv=False)
    _, messages = loaded(path)
    (line,) = [each for each in messages if "far out" in each]
    assert line.startswith("a.obj has 1 vertices far out, one at (1e+30, 0, 0); 90 % are within ")
    assert not any("far out" in each for each in loaded(MINI_HEAD)[1])


def test_coordinates_too_small_or_too_large(tmp_path):
    tiny = mini_head().with_positions(mini_head().positions * 1e-150)
    path = files.write_obj(tmp_path / "a.obj", tiny)
    assert "units wide, below 1e-60: scale it up" in refused(path)
    positions = mini_head().positions.copy()
    positions[3] = 1e70
    mesh, messages = loaded(
        files.write_obj(tmp_path / "a.obj", mini_head().with_positions(positions))
    )
    assert any(each.startswith("a.obj has 1 vertices beyond 1e+60: ") for each in messages)
    assert mesh.radius < 1.0


@pytest.mark.parametrize("value", ["1e50", "1e200", "nan"])
def test_unused_vertices_are_ignored(value, tmp_path):
    mesh, _ = loaded(write(tmp_path / "a.obj", TRIANGLE + f"v {value} 0 0\nf 1 2 3\n".encode()))
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [1, 1, 0]])
    positions, faces = mini_head().positions.copy(), mini_head().faces
    positions[7] = min(float(value), 1e38)
    head = mini_head().with_positions(positions).with_faces(faces[~(faces == 7).any(axis=1)])
    path = files.write_glb(tmp_path / "a.glb", head)
    mesh, _ = loaded(path)
    assert np.abs(mesh.parts[0].positions).max() < 1.0


@pytest.mark.parametrize("value", ["1e100", "nan", "-inf"])
def test_invalid_texture_coordinates(value, tmp_path):
    lines = f"vt {value} 1\nvt 0.5 0\nf 1/1 2/2 3/2\n"
    mesh, messages = loaded(write(tmp_path / "a.obj", TRIANGLE + lines.encode()))
    assert messages == ["a.obj has 1 texture coordinates outside [-1e6, 1e6]: set to 0"]
    assert mesh.parts[0].uv is not None


# --- PLY, STL, OBJ -------------------------------------------------------------------------------


def ply(properties, end="0 0 0\n1 0 0\n0 1 0\n"):
    return f"ply\nformat ascii 1.0\n{properties}end_header\n{end}"


def binary_ply(kind, faces):
    """Return a PLY file with four vertices and two faces; ``kind`` is the type of list lengths."""
    head = PLY.replace("ascii", "binary_little_endian").replace("uchar", kind).format(count=2)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    return head[: head.index("0 0 0\n")].encode() + vertices.tobytes() + faces


VERTEX = "element vertex 3\nproperty float x\n"
STL = files.stl(mini_head())
REFUSED = [
    ("a.ply", ply(VERTEX.replace("3", "99999999999")), "declares 99999999999 lines, but it has 3"),
    ("a.ply", ply(VERTEX.replace("3", "-3")), "has the invalid line 'element vertex -"),
    ("a.ply", ply(VERTEX.replace("float", "text")), "has the invalid line 'property text x'"),
    ("a.ply", ply(VERTEX + "x\n"), "has the invalid line 'x'"),
    ("a.ply", ply("property float x\n"), "Property defined before any element"),
    ("a.ply", binary_ply("char", struct.pack("<b3ib3i", -1, 0, 1, 2, 3, 0, 1, 2)), "is damaged ("),
    ("a.ply", binary_ply("uint", struct.pack("<I6i", 2**31, *range(6))), "is damaged ("),
    (
        "a.ply",
        binary_ply("uchar", struct.pack("<B4iB4i", 4, 0, 1, 2, 3, 3, 0, 1, 2, 3)),
        "its faces have different numbers of vertex_indices",
    ),
    ("a.ply", PLY.format(count=1) + "3 0 1 2\n" + "1\n" * 100, "its header declares 5 lines, but "),
    ("a.stl", STL[:-50], "triangles need 336184 bytes, but it has 336134"),
    ("a.stl", STL[:80] + b"\xff" * 4 + STL[84:], "4294967295 triangles need"),
    ("a.stl", b"solid facet\n" + b"endsolid\n" * 1025, "a.stl has more than 1024 parts"),
    (
        "a.obj",
        TRIANGLE + b"".join(b"usemtl m%d\nf 1 2 3\n" % i for i in range(1025)),
        "a.obj has more than 1024 parts",
    ),
    (
        "a.ply",
        '{"message": "no access"}',
        'a.ply is not PLY but JSON ({"message": "no access"}); give a mesh',
    ),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED, ids=itertools.count())
def test_invalid_content_is_refused(name, content, message, tmp_path):
    assert message in refused(write(tmp_path / name, content))


def test_invalid_face_indices_in_ply_with_texture_coordinates(tmp_path):
    mesh, messages = loaded(write(tmp_path / "a.ply", WITH_UV + "3 0 1 2\n3 0 1 -1\n"))
    assert messages == ["a.ply has 1 faces with invalid vertex indices: dropped"]
    assert len(mesh.parts[0].faces) == 1


def binary_ply(properties, rows):
    """Return a binary PLY file with a triangle of three vertices and one face."""
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
        f"property float y\nproperty float z\nelement face 1\n{properties}end_header\n"
    )
    return header.encode() + np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], "<f4").tobytes() + rows


def test_vertex_indices_of_a_ply_with_another_name(tmp_path):
    triangle = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    content = binary_ply("property list uchar int corners\n", triangle)
    mesh, messages = loaded(write(tmp_path / "a.ply", content))
    assert (len(mesh.parts[0].faces), messages) == (1, [])


@pytest.mark.parametrize(
    ("properties", "rows"),
    [
        ("property int vertex_indices\n", bytes(4)),
        ("property int material\n", bytes(4)),
        ("property list uchar int corners\nproperty int flags\n", b"\3" + bytes(16)),
    ],
)
def test_ply_faces_without_vertex_indices(properties, rows, tmp_path):
    path = write(tmp_path / "a.ply", binary_ply(properties, rows))
    assert "a.ply is damaged (" in refused(path)


def test_edges_of_a_ply_are_ignored(tmp_path):
    text = PLY.format(count=1).replace(
        "end_header", "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header"
    )
    mesh, messages = loaded(write(tmp_path / "a.ply", text + "3 0 1 2\n0 1\n"))
    assert (len(mesh.parts[0].faces), messages) == (1, [])


@pytest.mark.parametrize("content", ["<html></html>", None], ids=["damaged", "missing"])
def test_texture_of_a_ply(content, tmp_path, capfd):
    """The user sees a warning or an error, but not the log of trimesh."""
    text = PLY.format(count=1).replace("ascii 1.0\n", "ascii 1.0\ncomment TextureFile page.png\n")
    path = write(tmp_path / "a.ply", text + "3 0 1 2\n")
    logging.lastResort.setLevel(logging.WARNING) if logging.lastResort else None
    if content is None:
        assert "page.png (named by a.ply) not found in" in loaded(path)[1][0]
    else:
        write(tmp_path / "page.png", content)
        assert "page.png (named by a.ply) is not an image" in refused(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("header", [b"", b"solid head"])
def test_bytes_after_the_triangles_of_an_stl(tmp_path, header):
    """A binary STL may begin with "solid", as a text STL does."""
    data = header + STL[len(header) :]
    mesh, messages = loaded(write(tmp_path / "a.stl", data + b"xyz"))
    assert messages == ["a.stl has 3 bytes after its 6722 triangles: ignored"]
    assert len(mesh.parts[0].faces) == 6722


# --- other file types ----------------------------------------------------------------------------

KINDS: dict[str, tuple[bytes, str]] = {
    "git-lfs": (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    "page": (b"\xef\xbb\xbf\n<!DOCTYPE html><html></html>", "an HTML page; download"),
    "XML": (b"<?xml version='1.0'?><COLLADA/>", "an XML file"),
    "zip": (b"PK\x03\x04" + bytes(99), "a ZIP archive"),
    "gzip": (b"\x1f\x8b" + bytes(99), "a gzip archive; unpack it"),
    "tar": (b"a.obj".ljust(257, b"\0") + b"ustar" + bytes(250), "a tar archive; unpack it"),
    "FBX": (b"Kaydara FBX Binary  \0", "an FBX file; export it as .glb"),
    "PNG": (b"\x89PNG\r\n\x1a\n" + bytes(99), "a PNG image; give a mesh, and"),
    "USD": (b"PXR-USDC" + bytes(99), "a USD file; export it as .glb"),
}


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply", ".stl"])
@pytest.mark.parametrize("case", KINDS)
def test_other_file_types_are_named(case, suffix, tmp_path):
    content, message = KINDS[case]
    line = refused(write(tmp_path / f"a{suffix}", content))
    assert line.startswith(f"a{suffix} is not ")
    assert message in line


# --- files that a mesh refers to -----------------------------------------------------------------


@pytest.fixture
def inside(tmp_path):
    """A folder for the mesh; the parent folder has a file that must not be opened."""
    write(tmp_path / "secret.jpg", mini_head().skin)
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


@pytest.mark.first_case
@pytest.mark.parametrize("absolute", [False, True])
def test_images_outside_the_folder_are_not_opened(absolute, inside):
    name = str(inside.parent / "secret.jpg") if absolute else "../secret.jpg"
    path = files.write_obj(inside / "a.obj", mini_head(), mtl="a.mtl")
    write(inside / "a.mtl", files.SKIN_MTL.format(texture=name))
    mesh, messages = loaded(path)
    (line,) = messages
    assert mesh.materials[0].albedo_map is None
    assert "lies outside" in line
    assert "pass --allow-outside (allow_outside=True)" in line
    mesh, messages = loaded(path, allow_outside=True)
    assert mesh.materials[0].albedo_map is not None
    assert messages == []
    write(inside / "secret.jpg", mini_head().skin)  # only the name counts
    assert loaded(path)[1] == []


def test_buffers_and_mtl_outside_the_folder_are_not_opened(inside):
    path = files.write_gltf(inside / "a.gltf", mini_head())
    (inside / "a.bin").rename(inside.parent / "b.bin")
    for uri in ("../b.bin", "%2e%2e/b.bin", "../in/../b.bin", str(inside.parent / "b.bin")):
        document = json.loads(path.read_text())
        document["buffers"][0]["uri"] = uri
        write(path, json.dumps(document))
        assert "(named by a.gltf) " in refused(path)
        loaded(path, allow_outside=True)
    write(inside.parent / "a.mtl", files.SKIN_MTL.format(texture="secret.jpg"))
    path = files.write_obj(inside / "a.obj", mini_head(), mtl="../a.mtl")
    assert "../a.mtl (named by a.obj) lies outside" in loaded(path)[1][0]


@pytest.mark.parametrize("uri", ["file:///etc/passwd", "http://localhost:1/b.bin", "\0", "", "."])
def test_invalid_uris_are_refused(uri, inside):
    path = files.write_gltf(inside / "a.gltf", mini_head())
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = uri
    assert "a.gltf" in refused(write(path, json.dumps(document)))


def test_symbolic_links_inside_the_folder_are_followed(inside):
    path = files.write_textured_obj(inside / "a.obj", mini_head())
    (inside / "skin.jpg").unlink()
    (inside / "skin.jpg").symlink_to(inside.parent / "secret.jpg")
    assert loaded(path)[1] == []


def test_data_uris(tmp_path):
    document, binary = files.gltf(mini_head())
    text = base64.b64encode(binary).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{text}"
    mesh, messages = loaded(write(tmp_path / "a.gltf", json.dumps(document)))
    assert messages == []
    assert mesh.materials[0].albedo_map is not None
    document["buffers"][0]["uri"] = "data:application/octet-stream,abc"
    assert "but has 3" in refused(write(tmp_path / "a.gltf", json.dumps(document)))


def pipe(path):
    os.mkfifo(path)


def endless(path):
    path.symlink_to("/dev/zero")


SPECIAL = {"pipe": pipe, "device": endless, "directory": Path.mkdir}


@pytest.mark.first_case
@pytest.mark.parametrize("what", SPECIAL)
@pytest.mark.parametrize("place", ["mesh", "buffer", "image", "mtllib", "map"])
def test_special_files_are_not_read(what, place, tmp_path):
    if place == "mesh":
        path = special = tmp_path / "a.glb"
    elif place in ("buffer", "image"):
        path = files.write_gltf(tmp_path / "a.gltf", mini_head())
        special = tmp_path / ("a.bin" if place == "buffer" else "skin.jpg")
    else:
        path = files.write_textured_obj(tmp_path / "a.obj", mini_head())
        special = tmp_path / ("a.mtl" if place == "mtllib" else "skin.jpg")
    special.unlink(missing_ok=True)
    SPECIAL[what](special)
    assert f"{special.name} is a {what}; give " in refused(path)


# --- cache ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_invalid_cache_entry_is_ignored(cache_folder):
    """The entry has a valid checksum, but not the content that this version writes."""
    expected = fr.load_mesh(MINI_HEAD, cache=True).bounds
    wait_for_cache()
    (entry,) = (cache_folder / "meshes").iterdir()
    content = bytes(cache.read("meshes", entry.name) or b"")
    (length,) = struct.unpack_from("<Q", content)
    facts = json.loads(content[8 : 8 + length])
    broken = [b"", b"\xff" * 99, content[:8], content[: length + 50]]
    broken.append(struct.pack("<Q", 2) + b"[]")
    for key in facts:
        head = json.dumps({name: each for name, each in facts.items() if name != key}).encode()
        broken.append(struct.pack("<Q", len(head)) + head + content[8 + length :])
    for each in broken:
        cache.write("meshes", entry.name, [each])
        mesh = fr.load_mesh(MINI_HEAD, cache=True)
        np.testing.assert_array_equal(mesh.bounds, expected)
        wait_for_cache()
