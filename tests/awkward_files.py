"""Writes valid and broken mesh files of the small head in data/mini_head.glb. It does not use
trimesh, so that files are not written by the code that reads them."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.material import MAPS

MINI_HEAD = Path(__file__).parent / "data" / "mini_head.glb"
SKIN_MTL = "newmtl skin\nKd 1 1 1\nmap_Kd {texture}\n"
Z_UP = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # quaternion x, y, z, w of -90 degrees around x

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Head:
    """A mesh whose vertices are split at the texture's seam, with normals and coordinates."""

    positions: Floats
    normals: Floats
    uv: Floats  # v upwards
    faces: Ints
    skin: bytes  # JPEG

    @property
    def image(self) -> Image.Image:
        return Image.open(BytesIO(self.skin)).convert("RGB")

    @property
    def upper(self) -> NDArray[np.bool_]:
        """A mask of the faces in the upper half."""
        heights = self.positions[self.faces].mean(axis=1)[:, 1]
        return np.asarray(heights > np.median(heights))

    def with_faces(self, faces: Ints) -> Head:
        return replace(self, faces=faces)

    def with_positions(self, positions: Floats) -> Head:
        return replace(self, positions=positions)


@lru_cache(maxsize=1)
def repeated(mesh: fr.Mesh) -> fr.Mesh:
    """Return a mesh of one material with repeating maps, the default of mesh files."""
    (material,) = mesh.materials
    maps = {name: map for name in MAPS if (map := getattr(material, name)) is not None}
    return mesh.with_material(
        **{name: map.sampled(("repeat", "repeat")) for name, map in maps.items()}
    )


def mini_head() -> Head:
    document, binary = split_glb(MINI_HEAD.read_bytes())

    def view(index: int) -> bytes:
        entry = document["bufferViews"][index]
        return binary[entry["byteOffset"] :][: entry["byteLength"]]

    uv = np.frombuffer(view(1), np.float32).reshape(-1, 2).astype(np.float64)
    return Head(
        positions=np.frombuffer(view(0), np.float32).reshape(-1, 3).astype(np.float64),
        normals=np.frombuffer(view(2), np.float32).reshape(-1, 3).astype(np.float64),
        uv=uv * (1.0, -1.0) + (0.0, 1.0),
        faces=np.frombuffer(view(3), np.uint16).reshape(-1, 3).astype(np.int64),
        skin=view(4),
    )


def assert_equal(a: Any, b: Any, where: str) -> None:
    """Check that objects of the package are bitwise equal; compare textures by their texels."""
    assert type(a) is type(b), where
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, where)
    elif isinstance(a, fr.Texture):
        assert (a.name, a.sampling) == (b.name, b.sampling), where
        np.testing.assert_array_equal(np.asarray(a.rgb()), np.asarray(b.rgb()), where)
    elif isinstance(a, Exception):
        assert str(a) == str(b)
    elif isinstance(a, list | tuple):
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_equal(*pair, f"{where}[{i}]")
    elif hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            assert_equal(getattr(a, name), getattr(b, name), f"{where}.{name}")
    elif not callable(a):
        assert a == b or "object at" in repr(a), where


# --- OBJ -----------------------------------------------------------------------------------------


def write_obj(
    path: Path,
    head: Head,
    *,
    mtl: str | None = None,
    uv: bool = True,
    normals: Floats | None = None,
    colors: Floats | None = None,
    groups: Mapping[str, NDArray[np.bool_]] | None = None,
) -> Path:
    """Write an OBJ file.

    Parameters
    ----------
    mtl : name of the MTL file that the OBJ file refers to
    colors : vertex colours, (N, 3) in [0, 1], written after the coordinates
    groups : faces of each material; by default all have the material skin
    """
    columns = head.positions if colors is None else np.hstack([head.positions, colors])
    lines = [f"mtllib {mtl}"] if mtl else []
    lines += _records("v", columns)
    lines += _records("vt", head.uv) if uv else []
    lines += _records("vn", normals) if normals is not None else []
    corner = {
        (False, False): "{0}",
        (True, False): "{0}/{0}",
        (False, True): "{0}//{0}",
        (True, True): "{0}/{0}/{0}",
    }[uv, normals is not None]
    for name, chosen in (groups or {"skin": np.ones(len(head.faces), bool)}).items():
        lines += [f"usemtl {name}"] if mtl else []
        for face in (head.faces[chosen] + 1).tolist():
            lines.append("f " + " ".join(corner.format(index) for index in face))
    path.write_text("\n".join(lines) + "\n")
    return path


def _records(keyword: str, values: Floats) -> list[str]:
    return [f"{keyword} " + " ".join(map(repr, row)) for row in values.tolist()]


def write_textured_obj(path: Path, head: Head, **options: Any) -> Path:
    """Write an OBJ file with skin.jpg and an MTL file of the same name."""
    path.with_name("skin.jpg").write_bytes(head.skin)
    path.with_suffix(".mtl").write_text(SKIN_MTL.format(texture="skin.jpg"))
    return write_obj(path, head, mtl=path.with_suffix(".mtl").name, **options)


# --- PLY, STL ------------------------------------------------------------------------------------


def write_ply(path: Path, head: Head, colors: NDArray[np.uint8] | None = None) -> Path:
    """Write a binary PLY file; ``colors`` are RGBA, (N, 4)."""
    fields: list[tuple[str, str] | tuple[str, str, int]] = [("position", "<f4", 3)]
    properties = [f"property float {axis}" for axis in "xyz"]
    if colors is not None:
        fields.append(("color", "u1", 4))
        properties += [f"property uchar {name}" for name in ("red", "green", "blue", "alpha")]
    vertices = np.zeros(len(head.positions), dtype=fields)
    vertices["position"] = head.positions
    if colors is not None:
        vertices["color"] = colors
    faces = np.zeros(len(head.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, head.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    path.write_bytes(text.encode() + vertices.tobytes() + faces.tobytes())
    return path


def stl(head: Head) -> bytes:
    """Return the content of a binary STL file, whose triangles share no vertices."""
    layout = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    triangles = np.zeros(len(head.faces), dtype=layout)
    triangles["corners"] = head.positions[head.faces]
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + triangles.tobytes()


def write_stl(path: Path, head: Head) -> Path:
    path.write_bytes(stl(head))
    return path


# --- glTF ----------------------------------------------------------------------------------------

KINDS = {"|i1": 5120, "<i1": 5120, "|u1": 5121, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125}
KINDS["<f4"] = 5126
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def gltf(
    head: Head,
    nodes: Sequence[Mapping[str, Any]] = ({},),
    *,
    normals: bool = True,
    image: Mapping[str, Any] | None = None,
    material: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any], bytes]:
    """Return a glTF document and its buffer.

    Parameters
    ----------
    nodes : glTF nodes; each is an instance of the head with its transform
    image : glTF image; default: the head's skin, stored in the buffer
    material : glTF material; default: the skin as base colour
    """
    uv = head.uv * (1.0, -1.0) + (0.0, 1.0)
    arrays: dict[str, NDArray[Any]] = {"POSITION": head.positions.astype("<f4")}
    if normals:
        arrays["NORMAL"] = head.normals.astype("<f4")
    arrays["TEXCOORD_0"] = uv.astype("<f4")
    accessors = [
        {
            "bufferView": index,
            "componentType": 5126,
            "count": len(values),
            "type": f"VEC{values.shape[1]}",
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
        }
        for index, values in enumerate(arrays.values())
    ]
    attributes = {name: index for index, name in enumerate(arrays)}
    accessors.append(
        {
            "bufferView": len(arrays),
            "componentType": 5125,
            "count": head.faces.size,
            "type": "SCALAR",
        }
    )
    blocks = [values.tobytes() for values in (*arrays.values(), head.faces.astype("<u4"))]
    if image is None:
        image = {"bufferView": len(blocks), "mimeType": "image/jpeg"}
        blocks.append(head.skin)
    views, binary = [], b""
    for block in blocks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(block)})
        binary += block + b"\0" * (-len(block) % 4)
    primitive = {"attributes": attributes, "indices": len(arrays), "material": 0}
    skin = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": [{"mesh": 0, **node} for node in nodes],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material or skin],
        "textures": [{"source": 0}],
        "images": [image],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return document, binary


def join_glb(document: Mapping[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


class Glb:
    """A glTF document and its buffer, to which accessors, clips and meshes can be added."""

    def __init__(self, *nodes: dict[str, Any]) -> None:
        self.binary = b""
        lists: dict[str, Any] = {"meshes": [], "accessors": [], "bufferViews": []}
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": list(nodes),
            "buffers": [{"byteLength": 0}],
            **lists,
        }

    def view(self, values: Any, **more: Any) -> int:
        """Add a buffer view of bytes or of an array."""
        content = values if isinstance(values, bytes) else np.ascontiguousarray(values).tobytes()
        self.binary += bytes(-len(self.binary) % 4)
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content), **more}
        )
        self.binary += content
        self.document["buffers"][0]["byteLength"] = len(self.binary)
        return len(self.document["bufferViews"]) - 1

    def add(self, values: Any, kind: str = "<f4", sparse: bool = False, **more: Any) -> int:
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
        elif "bufferView" not in more:
            entry["bufferView"] = self.view(values)
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives: dict[str, Any], **more: Any) -> int:
        self.document["meshes"].append({"primitives": list(primitives), **more})
        return len(self.document["meshes"]) - 1

    def primitive(
        self, positions: Any, faces: Any, normals: Any = None, **attributes: int
    ) -> dict[str, Any]:
        own = {"POSITION": self.add(positions)}
        if normals is not None:
            own["NORMAL"] = self.add(normals)
        return {"attributes": {**own, **attributes}, "indices": self.add(np.ravel(faces), "<u2")}

    def skin(self, joints: Sequence[int], inverse: Any = None) -> None:
        """Add a skin; ``inverse`` (N, 4, 4) are its inverse bind matrices, by columns."""
        more = {} if inverse is None else {"inverseBindMatrices": self.add(inverse)}
        self.document.setdefault("skins", []).append({"joints": [*joints], **more})

    def clip(self, *channels: Any, **more: Any) -> dict[str, Any]:
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

    def content(self) -> bytes:
        return join_glb(self.document, self.binary + bytes(-len(self.binary) % 4))

    def load(self) -> fr.Mesh:
        return fr.load_mesh(self.content(), kind="glb")


def write_glb(path: Path, head: Head, *args: Any, **options: Any) -> Path:
    """Write a GLB file; see :func:`gltf` for the parameters."""
    path.write_bytes(join_glb(*gltf(head, *args, **options)))
    return path


def write_gltf(path: Path, head: Head) -> Path:
    """Write a glTF file, and its buffer and image as separate files."""
    document, binary = gltf(head, image={"uri": "skin.jpg"})
    document["buffers"][0]["uri"] = path.with_suffix(".bin").name
    path.with_suffix(".bin").write_bytes(binary)
    path.with_name("skin.jpg").write_bytes(head.skin)
    path.write_text(json.dumps(document))
    return path


def write_draco(path: Path, head: Head) -> Path:
    """Write a GLB file compressed with Draco, with positions in 14 bits; needs DracoPy."""
    import DracoPy

    packed = DracoPy.encode(head.positions.astype(np.float32), head.faces, quantization_bits=14)
    document, _ = gltf(head, normals=False, image={"uri": "skin.jpg"})
    extension = {"bufferView": 0, "attributes": {"POSITION": 0}}
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    accessors = [document["accessors"][0], document["accessors"][-1]]
    for accessor in accessors:
        del accessor["bufferView"]
    for unused in ("materials", "textures", "images"):
        del document[unused]
    document |= {
        "extensionsUsed": ["KHR_draco_mesh_compression"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(packed)}],
        "buffers": [{"byteLength": len(packed)}],
    }
    path.write_bytes(join_glb(document, packed + b"\0" * (-len(packed) % 4)))
    return path


# --- images --------------------------------------------------------------------------------------


def flat(*color: int) -> Image.Image:
    """Return an image of 4 x 4 pixels of one colour."""
    mode = {1: "L", 3: "RGB", 4: "RGBA"}[len(color)]
    return Image.new(mode, (4, 4), color if len(color) > 1 else color[0])


def texels(texture: fr.Texture | None) -> Ints:
    assert texture is not None
    return np.asarray(texture.rgb()).astype(int)


def write_png16(path: Path, texels: NDArray[np.uint16]) -> Path:
    """Write a 16-bit RGB PNG file, which Pillow cannot write."""
    height, width, _ = texels.shape
    rows = texels.astype(">u2").reshape(height, -1).view(np.uint8)
    filtered = np.hstack([np.zeros((height, 1), np.uint8), rows])
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 1)), (b"IEND", b""))
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in chunks:
        checksum = zlib.crc32(kind + content)
        data += struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)
    path.write_bytes(data)
    return path
