"""Meshes as other programs write them: read in full, or refused or warned of by name. Each test has
variants of one kind of file that an earlier version read wrong without a word."""

from __future__ import annotations

import base64
import json
import shutil
import struct
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.images.image import srgb_to_linear
from tests import awkward_files as files
from tests.awkward_files import MINI_HEAD, mini_head
from tests.test_icc import CURVE, GREY, P3, SRGB, as_p3, profile

HEAD = mini_head()
RNG = np.random.default_rng(55)
COLORS = RNG.integers(0, 256, (len(HEAD.positions), 4), dtype=np.uint8)
OF_FACES = RNG.integers(0, 256, (len(HEAD.faces), 3), dtype=np.uint8)


def load(path: Path, **options: Any) -> tuple[fr.Mesh, list[str]]:
    """Return a mesh and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", fr.FacerenderWarning)
        mesh = fr.load_mesh(path, **options)
    return mesh, [str(warning.message) for warning in caught]


def linear(colors: NDArray[np.uint8]) -> NDArray[np.float64]:
    return srgb_to_linear(colors[:, :3] / 255.0)


def assert_same_mesh(mesh: fr.Mesh, other: fr.Mesh) -> None:
    """Compare geometry, names and materials."""
    for part, expected in zip(mesh.parts, other.parts, strict=True):
        files.assert_equal(part, expected, part.name)
    for material, expected in zip(mesh.materials, other.materials, strict=True):
        files.assert_equal(material, expected, "material")


# --- Draco ---------------------------------------------------------------------------------------

COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123}


def gltf_arrays(
    attributes: Mapping[str, NDArray[Any]], draco: bool, mesh: Mapping[str, Any] = {}
) -> bytes:
    """Return a GLB file with attributes (N, K) and the faces of the head. Integers are normalised,
    except joints.

    draco : whether the arrays are compressed
    mesh : further properties of the glTF mesh
    """
    arrays = {"POSITION": HEAD.positions.astype("f4"), **attributes}
    blocks = [values.tobytes() for values in arrays.values()]
    blocks.append(HEAD.faces.astype("u4").tobytes())
    if draco:
        DracoPy = pytest.importorskip("DracoPy")
        generic = dict(enumerate(attributes.values(), 1))
        points = arrays["POSITION"].astype("f8")
        options = {"generic_attributes": generic, "preserve_order": True, "quantization_bits": 30}
        blocks = [DracoPy.encode(points, HEAD.faces.astype("u4"), **options)]
    accessors = [
        {
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "normalized": values.dtype.kind == "u" and not name.startswith("JOINTS"),
            "count": len(values),
            "type": f"VEC{values.shape[1]}",
        }
        for name, values in arrays.items()
    ]
    faces = {"componentType": 5125, "count": HEAD.faces.size, "type": "SCALAR"}
    accessors.append({**faces, "normalized": False})
    views, binary = [], b""
    for number, block in enumerate(blocks):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(block)})
        binary += block + b"\0" * (-len(block) % 4)
        if not draco:
            accessors[number]["bufferView"] = number
    names = {name: number for number, name in enumerate(arrays)}
    primitive: dict[str, Any] = {"attributes": names, "indices": len(arrays)}
    required = []
    if draco:
        # DracoPy numbers positions after the generic attributes' own numbers.
        decoded = DracoPy.decode(blocks[0]).attributes
        (position,) = (a["unique_id"] for a in decoded if a["attribute_type"] == 0)
        identities = {**names, "POSITION": position}
        required = ["KHR_draco_mesh_compression"]
        primitive["extensions"] = {required[0]: {"bufferView": 0, "attributes": identities}}
    document = {
        "asset": {"version": "2.0"},
        "extensionsRequired": required,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], **mesh}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return files.join_glb(document, binary)


@pytest.mark.parametrize(
    "attributes",
    [
        {"COLOR_0": COLORS[:, :3].copy()},
        {"COLOR_0": COLORS.astype("u2") * 257},
        {"COLOR_0": (COLORS[:, :3] / np.float32(255.0)).astype("f4")},
        {"TEXCOORD_0": np.round(HEAD.uv * 65535).astype("u2")},
        {"TEXCOORD_0": np.round(HEAD.uv * 255).astype("u1"), "COLOR_0": COLORS},
    ],
    ids=["8-bit RGB", "16-bit RGBA", "float RGB", "16-bit uv", "8-bit uv and RGBA"],
)
def test_draco_scales_as_the_accessor_says(attributes, tmp_path):
    pytest.importorskip("DracoPy")
    meshes = []
    for draco in (False, True):
        path = tmp_path / f"{draco}.glb"
        path.write_bytes(gltf_arrays(attributes, draco))
        meshes.append(load(path)[0].parts[0])
    plain, packed = meshes
    # Draco changes the order of triangles and vertices: positions identify them.
    order, packed_order = (np.lexsort(part.positions.T) for part in meshes)
    np.testing.assert_allclose(
        packed.positions[packed_order], plain.positions[order], rtol=0, atol=1e-6
    )
    for name in ("colors", "uv"):
        if (expected := getattr(plain, name)) is not None:
            rows, packed_rows = (
                np.unique(np.round(np.hstack([p.positions, getattr(p, name)]), 5), axis=0)
                for p in meshes
            )
            np.testing.assert_allclose(packed_rows, rows, rtol=0, atol=2e-5)
            assert expected.max() > 0.9


# A tetrahedron as draco3d 1.5 (npm) encodes it: positions int16, uv int8, colours uint16.
SIGNED = base64.b64decode(
    "RFJBQ08CAgEAAAAEBAEAAgEAAQMAAwIBAgMBAwADAwAAAwECAAECBAMAAgEBAQABAQARAwEQNwEwAwBQgvD/BwAA"
    "AOj/9/8HAAAA6P/v/wcBgP///38AAAABAQAJAwEQFwEwAwBQgvgD9Pv39wGB////fwAAAAABAQARAwEQKwEQBwEg"
    "AwAwkBEA+P8HAAAA+P8PAIA+oE/uAgAAAAD//wAA"
)


def test_draco_of_signed_components(tmp_path):
    pytest.importorskip("DracoPy")
    common = {"normalized": True, "count": 4}
    faces = {"componentType": 5125, "count": 12, "type": "SCALAR"}
    names = {"POSITION": 0, "TEXCOORD_0": 1, "COLOR_0": 2}
    extension = {"bufferView": 0, "attributes": names}
    primitive = {"attributes": names, "indices": 3}
    primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"componentType": 5122, "type": "VEC3", **common},
            {"componentType": 5120, "type": "VEC2", **common},
            {"componentType": 5123, "type": "VEC3", **common},
            faces,
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(SIGNED)}],
        "buffers": [{"byteLength": len(SIGNED)}],
    }
    (tmp_path / "a.glb").write_bytes(files.join_glb(document, SIGNED + bytes(-len(SIGNED) % 4)))
    (part,) = load(tmp_path / "a.glb")[0].parts
    order = [int(np.argmin(np.abs(part.positions - p).sum(axis=1))) for p in np.eye(3) * (1, 1, -1)]
    np.testing.assert_allclose(part.positions[order], np.eye(3) * (1, 1, -1))
    np.testing.assert_allclose(part.uv[order], [[1, 1], [0, 0], [-1, 1 - 64 / 127]], atol=1e-6)
    np.testing.assert_allclose(part.colors[order[1]], [0, 0, 1], atol=1e-6)


# --- PLY -----------------------------------------------------------------------------------------


def write_ply(
    path: Path,
    vertex: Mapping[str, tuple[str, NDArray[Any]]] = {},
    face: Mapping[str, tuple[str, NDArray[Any]]] = {},
    *,
    corners: NDArray[Any] = HEAD.faces,
    comments: tuple[str, ...] = (),
    binary: bool = False,
) -> Path:
    """Write a PLY file.

    vertex, face : further properties of vertices and faces, by name: type in the file and values
    corners : vertices of each face, (F, K)
    """
    columns = {axis: ("float", HEAD.positions[:, i]) for i, axis in enumerate("xyz")} | {**vertex}
    kind = "binary_little_endian" if binary else "ascii"
    lines = ["ply", f"format {kind} 1.0", *(f"comment {text}" for text in comments)]
    lines.append(f"element vertex {len(HEAD.positions)}")
    lines += [f"property {type_} {name}" for name, (type_, _) in columns.items()]
    lines += [f"element face {len(corners)}", "property list uchar int vertex_indices"]
    lists = {name: values.ndim > 1 for name, (_, values) in face.items()}
    lines += [
        f"property {'list uchar ' * lists[name]}{type_} {name}" for name, (type_, _) in face.items()
    ]
    text = "\n".join([*lines, "end_header", ""])
    types = {"uchar": "u1", "ushort": "<u2", "int": "<i4", "float": "<f4"}
    body = b""
    for number in range(len(HEAD.positions)):
        row = [(types[type_], values[number]) for type_, values in columns.values()]
        body += _bytes(row, binary)
    for number, indices in enumerate(corners):
        row = [("u1", len(indices)), *(("<i4", index) for index in indices)]
        for type_, values in face.values():
            entries = np.atleast_1d(values[number])
            row += [("u1", len(entries))] if values.ndim > 1 else []
            row += [(types[type_], entry) for entry in entries]
        body += _bytes(row, binary)
    path.write_bytes(text.encode() + body)
    return path


def _bytes(row: list[tuple[str, Any]], binary: bool) -> bytes:
    if binary:
        return b"".join(np.array(value, dtype=type_).tobytes() for type_, value in row)
    return (" ".join(f"{value:.9g}" for _, value in row) + "\n").encode()


def rgb(type_: str, colors: NDArray[Any], names: str = "red green blue") -> dict[str, Any]:
    return {name: (type_, colors[:, i]) for i, name in enumerate(names.split())}


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize(
    ("properties", "expected"),
    [
        (rgb("uchar", OF_FACES), OF_FACES),
        (rgb("float", OF_FACES / 255.0), OF_FACES),
        (rgb("ushort", OF_FACES.astype("u2") * 257, "r g b"), OF_FACES),
        (rgb("uchar", OF_FACES, "diffuse_red diffuse_green diffuse_blue"), OF_FACES),
    ],
    ids=["uchar", "float", "ushort", "diffuse"],
)
def test_ply_faces_keep_their_colours_without_scipy(
    properties, expected, binary, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "scipy", None)
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    mesh, messages = load(write_ply(tmp_path / "a.ply", face=properties, binary=binary))
    (part,) = mesh.parts
    assert messages == []
    colors = part.colors[part.faces]
    assert (colors == colors[:, :1]).all()  # no vertex belongs to faces of two colours
    np.testing.assert_allclose(
        sorted(map(tuple, colors[:, 0])), sorted(map(tuple, linear(expected))), atol=1e-9
    )
    plain = load(write_ply(tmp_path / "b.ply", binary=binary))[0].parts[0]
    np.testing.assert_allclose(
        sorted(map(tuple, np.round(part.normals[part.faces].reshape(-1, 3), 6))),
        sorted(map(tuple, np.round(plain.normals[plain.faces].reshape(-1, 3), 6))),
    )  # the borders of colours are no creases


@pytest.mark.parametrize(
    ("faces", "colors"),
    [
        (["4 0 1 4 3 255 0 0", "4 1 2 5 4 0 255 0"], {(1, 0, 0): 2, (0, 1, 0): 2}),
        (
            ["3 0 1 4 255 0 0", "4 1 2 5 4 0 255 0", "3 0 4 3 0 0 255"],
            {(1, 0, 0): 1, (0, 1, 0): 2, (0, 0, 1): 1},
        ),
        (["5 0 1 5 6 3 0 0 255", "3 1 2 5 255 0 0"], {(0, 0, 1): 3, (1, 0, 0): 1}),
    ],
    ids=["quads", "mixed", "pentagon"],
)
def test_ply_polygons_keep_their_colours(faces, colors, tmp_path):
    path = tmp_path / "a.ply"
    corners = ["0 0 0", "1 0 0", "2 0 0", "0 1 0", "1 1 0", "2 1 0", "1 3 0"]
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 7\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        + "\n".join([*corners, *faces, ""])
    )
    part = load(path)[0].parts[0]
    of_triangles = part.colors[part.faces]
    assert (of_triangles == of_triangles[:, :1]).all()
    found, counts = np.unique(of_triangles[:, 0], axis=0, return_counts=True)
    assert {tuple(color): count for color, count in zip(found, counts, strict=True)} == colors


@pytest.mark.parametrize(
    ("type_", "scale"), [("float", 1.0), ("ushort", 257.0), ("int", 1.0), ("float", 1.0 / 255.0)]
)
@pytest.mark.parametrize("names", ["red green blue", "r g b"])
def test_ply_colours_of_any_type_and_name(type_, scale, names, tmp_path):
    values = COLORS[:, :3] * scale
    path = write_ply(tmp_path / "a.ply", rgb(type_, values, names), binary=type_ != "int")
    mesh, messages = load(path)
    assert messages == []
    np.testing.assert_allclose(
        sorted(map(tuple, mesh.parts[0].colors)), sorted(map(tuple, linear(COLORS))), atol=1e-9
    )


def textured_ply(folder: Path, numbers: NDArray[Any] | None, binary: bool, *names: str) -> Path:
    """Write a PLY file with images of one colour: red, green, blue."""
    for name, color in zip(names, np.eye(3, dtype=np.uint8) * 255, strict=False):
        Image.fromarray(np.full((4, 4, 3), color)).save(folder / name)
    uv = HEAD.uv[HEAD.faces].reshape(len(HEAD.faces), 6)
    face: dict[str, Any] = {"texcoord": ("float", uv)}
    face |= {} if numbers is None else {"texnumber": ("int", numbers)}
    comments = tuple(f"TextureFile {name}" for name in names)
    return write_ply(folder / "a.ply", face=face, comments=comments, binary=binary)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_ply_has_a_part_for_each_texture(binary, tmp_path):
    numbers = (HEAD.positions[HEAD.faces][:, 0, 1] > 0).astype(int) * 2
    numbers[:5] = 1
    mesh, messages = load(textured_ply(tmp_path, numbers, binary, "a.png", "b.png", "c.png"))
    assert messages == []
    assert [part.name for part in mesh.parts] == ["a", "b", "c"]
    assert [len(part.faces) for part in mesh.parts] == np.bincount(numbers).tolist()
    for channel, material in enumerate(mesh.materials):
        texels = np.asarray(material.albedo_map.rgb())
        assert texels[..., channel].min() > 250
        assert texels.sum(axis=-1).max() <= 255


def test_ply_with_textures_that_no_face_names(tmp_path):
    mesh, messages = load(textured_ply(tmp_path, None, False, "a.png", "b.png"))
    assert len(mesh.parts) == 1
    assert messages == ["a.ply names 2 textures, but its faces have no texnumber: all get a.png"]
    path = textured_ply(tmp_path, np.zeros(len(HEAD.faces), int), True, "a.png", "b.png")
    (tmp_path / "b.png").unlink()
    (material,) = load(path)[0].materials
    assert np.asarray(material.albedo_map.rgb())[..., 0].min() > 250


def test_ply_texture_without_coordinates_warns(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.png")
    path = write_ply(tmp_path / "a.ply", comments=("TextureFile a.png",))
    assert load(path)[1] == ["a.ply has no texture coordinates: its texture is ignored"]


def test_ply_colours_of_vertices_beside_coordinates(tmp_path):
    """Without a texture, the colours are drawn. Vertex numbers count the file's vertices."""
    uv = HEAD.uv[HEAD.faces].reshape(len(HEAD.faces), 6)
    for binary in (False, True):
        face = {"texcoord": ("float", uv)}
        path = write_ply(tmp_path / "a.ply", rgb("uchar", COLORS), face, binary=binary)
        mesh, messages = load(path)
        (part,) = mesh.parts
        assert messages == []
        assert part.source_count == len(HEAD.positions)
        np.testing.assert_allclose(part.positions, HEAD.positions[part.sources], atol=1e-6)
        np.testing.assert_allclose(part.colors, linear(COLORS)[part.sources], atol=1e-9)
        assert mesh.materials[0].albedo == (1.0, 1.0, 1.0)


def test_ply_colours_of_faces_beside_coordinates(tmp_path):
    uv = HEAD.uv[HEAD.faces].reshape(len(HEAD.faces), 6)
    face = {"texcoord": ("float", uv), **rgb("uchar", OF_FACES)}
    (part,) = load(write_ply(tmp_path / "a.ply", face=face))[0].parts
    np.testing.assert_allclose(
        sorted(map(tuple, part.colors[part.faces][:, 0])), sorted(map(tuple, linear(OF_FACES)))
    )


def test_ply_says_which_colours_are_drawn(tmp_path):
    path = write_ply(tmp_path / "a.ply", rgb("uchar", COLORS), rgb("uchar", OF_FACES))
    mesh, messages = load(path)
    assert messages == ["a.ply has colours of vertices and of faces: the vertex colours are drawn"]
    np.testing.assert_allclose(mesh.parts[0].colors, linear(COLORS), atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 300.0])
def test_ply_with_a_bad_colour(bad, tmp_path):
    values = COLORS[:, :3] / 255.0
    values[5, 1] = bad
    path = write_ply(tmp_path / "a.ply", rgb("float", values), binary=True)
    colors = load(path)[0].parts[0].colors
    np.testing.assert_allclose(np.delete(colors, 5, 0), np.delete(linear(COLORS), 5, 0), atol=1e-9)


def test_ply_texture_numbers_without_a_texture(tmp_path):
    numbers = np.zeros(len(HEAD.faces), int)
    numbers[:7], numbers[7:9] = -1, 5
    mesh, messages = load(textured_ply(tmp_path, numbers, False, "a.png", "b.png"))
    assert messages == [
        "a.ply has 7 faces whose texnumber -1 names no texture",
        "a.ply has 2 faces whose texnumber 5 names no texture",
    ]
    assert [material.albedo_map is None for material in mesh.materials] == [True, False, True]


def test_binary_ply_of_triangles_and_quads_is_no_damage(tmp_path):
    path = write_ply(tmp_path / "a.ply", binary=True)
    content = path.read_bytes().replace(
        f"element face {len(HEAD.faces)}".encode(), f"element face {len(HEAD.faces) + 1}".encode()
    )
    path.write_bytes(content + struct.pack("<B4i", 4, 0, 1, 2, 3))
    with pytest.raises(fr.InputError, match="has faces with different numbers of corners"):
        fr.load_mesh(path)


def test_ply_faces_that_do_not_exist(tmp_path):
    path = write_ply(tmp_path / "a.ply", face=rgb("uchar", OF_FACES), binary=True)
    content = bytearray(path.read_bytes())
    faces = content.index(b"end_header\n") + 11 + 12 * len(HEAD.positions)
    size = (len(content) - faces) // len(HEAD.faces)
    struct.pack_into("<i", content, faces + 3 * size + 1, 10**6)
    path.write_bytes(content)
    mesh, messages = load(path)
    assert "invalid vertex indices: dropped" in messages[0]
    part = mesh.parts[0]
    expected = np.delete(linear(OF_FACES), 3, axis=0)
    np.testing.assert_allclose(
        sorted(map(tuple, part.colors[part.faces][:, 0])), sorted(map(tuple, expected))
    )


def test_strips_are_refused(tmp_path):
    for body in ("3 0 1 2", "5 0 1 2 -1 3"):
        path = tmp_path / "a.ply"
        path.write_text(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
            "property float z\nelement tristrips 1\nproperty list int int vertex_indices\n"
            f"end_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n{body}\n"
        )
        with pytest.raises(fr.InputError, match="has triangle strips, which are not supported"):
            fr.load_mesh(path)


# --- STL -----------------------------------------------------------------------------------------


def test_colours_of_stl_warn(tmp_path):
    content = bytearray(files.stl(HEAD))
    (tmp_path / "plain.stl").write_bytes(content)
    assert load(tmp_path / "plain.stl")[1] == []
    coloured = bytearray(content)
    struct.pack_into("<H", coloured, 84 + 48, 0x8000 | 31 << 10)
    magics = bytearray(content)
    magics[:6] = b"COLOR="
    for number, data in enumerate((coloured, magics)):
        path = tmp_path / f"{number}.stl"
        path.write_bytes(data)
        assert load(path)[1] == [
            f"{number}.stl has colours of triangles, which are not read: export it as .ply or .glb"
        ]


# --- OBJ -----------------------------------------------------------------------------------------


def textured_obj(folder: Path) -> str:
    """Write skin.jpg and head.mtl, and return the text of an OBJ file that uses them."""
    path = files.write_textured_obj(folder / "head.obj", HEAD)
    text = path.read_text()
    path.unlink()
    return text


OBJ_TEXTS = {
    "tabs": lambda text: text.replace("v ", "v\t").replace("f ", "f\t\t").replace("mtl ", "mtl\t"),
    "indented": lambda text: "".join(f" \t{line}\n" for line in text.splitlines()),
    "CR": lambda text: text.replace("\n", "\r"),
    "CR LF": lambda text: text.replace("\n", "\r\n"),
    "two spaces": lambda text: text.replace(" ", "  "),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("style", OBJ_TEXTS)
def test_obj_of_any_layout(style, encoding, tmp_path):
    text = textured_obj(tmp_path)
    (tmp_path / "plain.obj").write_text(text)
    mark = b"\xfe\xff" if encoding == "utf-16-be" else b""
    (tmp_path / "other.obj").write_bytes(mark + OBJ_TEXTS[style](text).encode(encoding))
    library = tmp_path / "head.mtl"
    mesh, _ = load(tmp_path / "plain.obj")
    library.write_bytes(mark + OBJ_TEXTS[style](library.read_text()).encode(encoding))
    other, messages = load(tmp_path / "other.obj")
    assert messages == []
    assert_same_mesh(other, mesh)


def test_utf_16_without_a_mark_is_refused_by_name(tmp_path):
    for encoding in ("utf-16-le", "utf-16-be"):
        path = tmp_path / "a.obj"
        path.write_bytes(textured_obj(tmp_path).encode(encoding))
        with pytest.raises(fr.InputError, match=r"a\.obj is UTF-16 without a byte order mark"):
            fr.load_mesh(path)


@pytest.mark.parametrize(
    ("scale", "excess"), [(1.0, 0.0), (255.0, 0.0), (100.0, 0.0), (1.0, 2.0), (255.0, 100.0)]
)
@pytest.mark.parametrize(
    ("uv", "mtl"), [(False, None), (True, None), (False, "a.mtl"), (True, "a.mtl")]
)
def test_obj_colours_up_to_255(scale, excess, uv, mtl, tmp_path):
    """A few brighter vertices do not change the scale. Materials without a map keep the colours."""
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 0.8 0.8 0.8\n")
    levels = np.round(COLORS[:, :3] / 255.0 * scale * 1000) / 1000
    levels[:3] += excess
    path = files.write_obj(tmp_path / "a.obj", HEAD, colors=levels, uv=uv, mtl=mtl)
    mesh, _ = load(path)
    unit = 255.0 if scale > 1.0 else 1.0
    expected = srgb_to_linear(np.round((levels / unit).clip(0, 1) * 255.0) / 255.0)
    (part,) = mesh.parts
    rows = np.arange(len(expected)) if part.sources is None else part.sources
    np.testing.assert_allclose(part.colors, expected[rows], atol=0.005)
    assert mesh.materials[0].albedo == (1.0, 1.0, 1.0)


def test_obj_textures_win_over_colours(tmp_path):
    path = files.write_textured_obj(tmp_path / "a.obj", HEAD, colors=COLORS[:, :3] / 255.0)
    mesh, messages = load(path)
    assert messages == []
    assert mesh.parts[0].colors is None
    assert mesh.materials[0].albedo_map is not None


def test_obj_colours_of_some_vertices(tmp_path):
    lines = ["v 0 0 0 1 0 0", "v 1 0 0 0 1 0", "v 0 1 0", "v 0 0 1 1 0 0 1", "f 1 3 2", "f 1 2 4"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh, messages = load(tmp_path / "a.obj")
    assert messages == ["a.obj has vertices without colour (1): drawn white"]
    colors = {
        tuple(p): tuple(c)
        for p, c in zip(mesh.parts[0].positions, mesh.parts[0].colors, strict=True)
    }
    assert colors == {
        (0, 0, 0): (1, 0, 0),
        (1, 0, 0): (0, 1, 0),
        (0, 1, 0): (1, 1, 1),
        (0, 0, 1): (0, 0, 1),
    }


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0 # a\nv 1 0 0#b\nv 0 1 0\nf 1 2 3 # c\n",
        "v 0 \\\n0 0\nv 1 0 0\nv 0 1 0\nf 1 \\\n2 3\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0\nvt 0.5\nf 1/1 2/2 3/1\n",
    ],
    ids=["comments", "continuations", "one coordinate"],
)
def test_legal_obj_lines(text, tmp_path):
    (tmp_path / "a.obj").write_text(text)
    mesh, messages = load(tmp_path / "a.obj")
    assert messages == []
    assert len(mesh.parts[0].faces) == 1


def test_colours_of_zbrush_warn(tmp_path):
    path = files.write_obj(tmp_path / "a.obj", HEAD, uv=False)
    path.write_text("#MRGB ffff0000ff00ff00\n" + path.read_text())
    assert load(path)[1] == [
        "a.obj has colours of ZBrush (#MRGB), which are not read: export it as .ply or .glb"
    ]


def materials(folder: Path, mtl: str, *uses: str) -> tuple[fr.Mesh, list[str]]:
    """Load an OBJ file with an MTL file, and a usemtl for each of several parts; "" for none."""
    (folder / "a.mtl").write_text(mtl)
    lines = ["mtllib a.mtl", *(f"v {x} {y} {z}" for x, y, z in HEAD.positions)]
    for use, faces in zip(uses, np.array_split(HEAD.faces + 1, len(uses)), strict=True):
        lines += [f"usemtl {use}"] if use else []
        lines += [f"f {a} {b} {c}" for a, b, c in faces]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    return load(folder / "a.obj", as_is=True)


RED, TWO = "newmtl red\nKd 1 0 0\n", "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n"
RED_ALBEDO = (1.0, 0.0, 0.0)


def test_the_only_material_is_used(tmp_path):
    mesh, messages = materials(tmp_path, RED, "")
    assert (mesh.materials[0].albedo, messages) == (RED_ALBEDO, [])
    for use in ("Red", "red.001"):
        mesh, messages = materials(tmp_path, RED, use)
        assert mesh.materials[0].albedo == RED_ALBEDO
        assert messages == [
            f"a.obj uses the material {use}, but its MTL has only red: this is used"
        ]


@pytest.mark.parametrize(
    ("mtl", "uses", "message"),
    [
        (TWO, ("green",), "a.obj uses the material green, and its MTL has the materials red, blue"),
        (TWO, ("",), "a.obj has faces without usemtl, and its MTL has the materials red, blue"),
        (RED, ("red", "eye"), "a.obj uses the material eye, and its MTL has the materials red"),
        (
            TWO,
            ("", "blue"),
            "a.obj has faces without usemtl, and its MTL has the materials red, blue",
        ),
    ],
)
def test_a_material_that_the_library_lacks_warns(mtl, uses, message, tmp_path):
    mesh, messages = materials(tmp_path, mtl, *uses)
    assert [text.partition(":")[0] for text in messages] == [message]
    lacking = [i for i, use in enumerate(uses) if use not in ("red", "blue")]
    for i in lacking:
        assert mesh.materials[i].albedo == fr.Material().albedo


def test_no_library_causes_no_warning(tmp_path):
    (tmp_path / "a.obj").write_text(textured_obj(tmp_path).partition("\n")[2])
    assert load(tmp_path / "a.obj")[1] == []


@pytest.mark.parametrize(
    ("library", "texture", "used"),
    [
        ("HEAD.MTL", "skin.jpg", "head.mtl"),
        ("head.mtl", "Skin.JPG", "skin.jpg"),
        ("head.mtl", r"C:\Scans\SKIN.jpg", "skin.jpg"),
        ("head.mtl", "Textures/Skin.jpg", "textures/skin.jpg"),
        ("head.mtl", "TEXTURES/skin.jpg", "textures/skin.jpg"),
    ],
)
def test_names_in_another_case(library, texture, used, tmp_path):
    text = textured_obj(tmp_path)
    (tmp_path / "plain.obj").write_text(text)
    mesh, _ = load(tmp_path / "plain.obj")
    (tmp_path / "head.mtl").write_text(files.SKIN_MTL.format(texture=texture))
    (tmp_path / "other.obj").write_text(text.replace("head.mtl", library))
    if "/" in texture:
        (tmp_path / "textures").mkdir()
        (tmp_path / "skin.jpg").rename(tmp_path / used)
    other, messages = load(tmp_path / "other.obj")
    (message,) = messages
    assert message.endswith(f"{used} is used, whose name differs in upper and lower case")
    pixels = [np.asarray(m.materials[0].albedo_map.rgb()) for m in (other, mesh)]
    np.testing.assert_array_equal(*pixels)


def test_a_batch_draws_again_after_a_change_of_a_texture_in_another_case(cli):
    (cli.folder / "a.obj").write_text(textured_obj(cli.folder))
    (cli.folder / "head.mtl").write_text(files.SKIN_MTL.format(texture="SKIN.JPG"))
    (cli.folder / "jobs.jsonl").write_text(
        '{"mesh": "%s", "image.size": 16}\n' % (cli.folder / "a.obj")
    )
    command = ("batch", cli.folder / "jobs.jsonl", "-o", cli.folder / "out", "--workers", "1")
    keys = []
    for color in (0, 200):
        Image.fromarray(np.full((8, 8, 3), color, np.uint8)).save(cli.folder / "skin.jpg")
        assert cli.run(*command)[0] == 0
        keys.append(json.loads((cli.folder / "out" / "jobs.jsonl").read_text())["key"])
    assert keys[0] != keys[1]


def test_ks_0_is_named_only_where_it_has_an_effect(cli):
    textured_obj(cli.folder)
    path = files.write_obj(cli.folder / "a.obj", HEAD, mtl="a.mtl", uv=False)
    (cli.folder / "a.mtl").write_text("newmtl skin\nKd 0.5 0.4 0.3\nKs 0 0 0\n")
    for options, warned in (
        ((), True),
        (("--ks", "0"), False),
        (("--ks", "0.5"), False),
        (("--only", "mask"), False),
        (("--part", "skin,ks=0.2"), False),
    ):
        command = ("render", path, "--size", "16", "-o", cli.png, "--no-cache", *options)
        status, _, err = cli.run(*command)
        assert status == 0
        assert ("has Ks 0 in its MTL" in err) is warned, options
    assert "has Ks 0 in its MTL" in cli.run("info", path)[1]


# --- glTF ----------------------------------------------------------------------------------------


def shapes_of(folder: Path, mesh: Mapping[str, Any], primitive: Mapping[str, Any], *names: str):
    """Return the shapes of a file with two targets, and the names of the targets' accessors."""
    document, binary = files.gltf(HEAD)
    for name in names or (None, None):
        document["accessors"].append(
            {**document["accessors"][0], **({"name": name} if name else {})}
        )
    count = len(document["accessors"])
    targets = [{"POSITION": count - 2}, {"POSITION": count - 1}]
    document["meshes"][0]["primitives"][0] |= {"targets": targets, **primitive}
    document["meshes"][0] |= mesh
    (folder / "a.glb").write_bytes(files.join_glb(document, binary))
    return load(folder / "a.glb")[0].shapes


def extras(*names: str) -> dict[str, Any]:
    return {"extras": {"targetNames": [*names]}}


@pytest.mark.parametrize(
    ("mesh", "primitive", "accessors", "expected"),
    [
        ({}, extras("smile", "frown"), (), ("smile", "frown")),
        (extras("a", "b"), extras("smile", "frown"), (), ("a", "b")),
        ({"extras": {"age": 3}}, extras("smile"), (), ("smile", "shape2")),
        ({}, {}, ("smile", "frown"), ("smile", "frown")),
        ({}, extras("a", "b"), ("smile", "frown"), ("a", "b")),
        ({}, {}, ("accessor", "accessor"), ("shape1", "shape2")),
        ({}, {"extras": [1]}, (), ("shape1", "shape2")),
    ],
)
def test_names_of_shapes(mesh, primitive, accessors, expected, tmp_path):
    assert shapes_of(tmp_path, mesh, primitive, *accessors) == expected


@pytest.mark.parametrize("name", ["a.vrm", "a.bin", "a", "a.obj", "a.GLB.download"])
def test_glb_of_any_name(name, tmp_path, cli):
    shutil.copy(MINI_HEAD, tmp_path / name)
    mesh, messages = load(tmp_path / name)
    assert messages == []
    assert mesh.millimetres == 1000.0
    for part, expected in zip(mesh.parts, fr.load_mesh(MINI_HEAD).parts, strict=True):
        files.assert_equal(part, expected, name)
    assert cli.run("info", tmp_path / name)[1].startswith(f"{tmp_path / name}: glb, ")
    assert (cli.render(mesh=tmp_path / name) == cli.render()).all()


@pytest.mark.parametrize(
    ("write", "suffix"),
    [(files.write_ply, "ply"), (files.write_stl, "stl"), (files.write_gltf, "gltf")],
)
def test_other_formats_of_any_name(write, suffix, tmp_path):
    path = write(tmp_path / f"a.{suffix}", HEAD)
    expected = fr.load_mesh(path)
    path.rename(tmp_path / "a.data")
    mesh, _ = load(tmp_path / "a.data")
    for part, expected_part in zip(mesh.parts, expected.parts, strict=True):
        files.assert_equal(part, expected_part, suffix)


def test_unknown_formats_are_named(tmp_path):
    for content, message in (
        (b"Kaydara FBX Binary  \0", r"a\.xyz is an FBX file; export it as \.glb"),
        (b"PK\x03\x04", r"a\.xyz is a ZIP archive"),
        (b"hello", r"a\.xyz: unknown mesh format '\.xyz'; give \.glb, \.gltf"),
        (b"", r"a\.xyz: unknown mesh format"),
    ):
        (tmp_path / "a.xyz").write_bytes(content)
        with pytest.raises(fr.InputError, match=message):
            fr.load_mesh(tmp_path / "a.xyz")


# --- messages ------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [files.write_ply, files.write_stl])
def test_a_missing_package_is_no_fault_of_the_file(write, tmp_path, monkeypatch):
    path = write(tmp_path / "a.data", HEAD)
    for name in ("trimesh", "trimesh.exchange.ply", "trimesh.exchange.stl"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError) as caught:
        fr.load_mesh(path, kind=write.__name__[-3:])
    assert caught.value.__notes__ == ["while reading a.data"]


def test_obj_needs_no_trimesh(tmp_path, monkeypatch):
    path = files.write_textured_obj(tmp_path / "a.obj", HEAD)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert fr.load_mesh(path).materials[0].albedo_map is not None


def test_an_internal_error_names_the_file(cli, monkeypatch):
    path = files.write_ply(cli.folder / "a.ply", HEAD, COLORS)

    def fail(*_):
        raise AttributeError("no such attribute")

    monkeypatch.setattr("facerender.loading.from_trimesh.srgb_to_linear", fail)
    status, _, err = cli.run("render", path, "-o", cli.png, "--no-cache")
    assert status == 70
    assert "internal error (AttributeError: no such attribute while reading a.ply)" in err
    assert "damaged" not in err
    assert not cli.png.exists()


# --- colour profiles of textures -----------------------------------------------------------------


def flat(path: Path, level: tuple[int, ...], content: bytes | None) -> Path:
    texels = np.full((8, 8, len(level)), level, np.uint8).squeeze()
    Image.fromarray(texels).save(path, icc_profile=content, quality=100)
    return path


LEVEL = (150, 120, 90)


def test_profiles_reach_every_source_of_a_map(tmp_path):
    png = flat(tmp_path / "a.png", LEVEL, P3)
    expected = np.round(255 * as_p3(np.array([LEVEL]) / 255.0))[0]
    document, binary = files.gltf(HEAD, image={"uri": "a.png"})
    (tmp_path / "a.glb").write_bytes(files.join_glb(document, binary))
    (tmp_path / "a.mtl").write_text(files.SKIN_MTL.format(texture="a.png"))
    files.write_obj(tmp_path / "a.obj", HEAD, mtl="a.mtl")
    trimesh = pytest.importorskip("trimesh")
    visual = trimesh.visual.TextureVisuals(uv=HEAD.uv, image=Image.open(png))
    sources = [
        fr.load_mesh(trimesh.Trimesh(HEAD.positions, HEAD.faces, visual=visual, process=False)),
        load(tmp_path / "a.glb")[0],
        load(tmp_path / "a.obj")[0],
        load(MINI_HEAD, albedo=png)[0],
        load(MINI_HEAD, albedo=Image.open(png))[0],
    ]
    for mesh in sources:
        found = np.asarray(mesh.materials[0].albedo_map.rgb())[4, 4]
        assert np.abs(found - expected).max() <= 1


def test_profiles_of_data_maps_and_srgb_change_nothing(tmp_path):
    png = flat(tmp_path / "a.png", LEVEL, P3)
    mesh = fr.load_mesh(MINI_HEAD, roughness_map=png, normal_map=png)
    for name in ("roughness_map", "normal_map"):
        texels = np.asarray(getattr(mesh.materials[0], name).rgb())
        assert (texels == LEVEL).all()
    srgb = profile("Monitor", "RGB ", CURVE, *SRGB)
    texture = fr.Texture.open(flat(tmp_path / "b.png", LEVEL, srgb))
    assert (np.asarray(fr.Material(albedo_map=texture).albedo_map.rgb()) == LEVEL).all()
    grey = fr.Texture.open(flat(tmp_path / "c.png", (100,), GREY))
    found = np.asarray(fr.Material(albedo_map=grey).albedo_map.rgb())[0, 0]
    assert (found > 105).all()  # a gamma of 1.8 is brighter than sRGB


@pytest.mark.parametrize(
    ("level", "content"),
    [(LEVEL, b"nonsense" * 30), ((100,), P3), (LEVEL, GREY), ((*LEVEL, 200), GREY)],
    ids=["nonsense", "grey image", "grey profile", "grey profile, alpha"],
)
def test_a_profile_of_other_channels_is_ignored_with_a_warning(level, content, tmp_path):
    texture = fr.Texture.open(flat(tmp_path / "a.png", level, content))
    with pytest.warns(fr.FacerenderWarning, match=r"a\.png has an ICC profile that does not fit"):
        material = fr.Material(albedo_map=texture)
    found = np.asarray(material.albedo_map.rgb())[0, 0]
    assert (found == (level * 3 if len(level) == 1 else level[:3])).all()
    fr.Material(roughness_map=fr.Texture.open(tmp_path / "a.png"))  # no warning for data
