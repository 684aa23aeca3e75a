"""Writer of the head as a binary glTF 2.0 file: one mesh, one material, three embedded JPEG maps.

Converts centimetres to metres, and v from up to down, as in glTF.
"""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .texture import Maps
from .unwrap import Unwrapped

GENERATOR = "facerender tools/head"
METRES_PER_CM = 0.01

# JPEG quality, and whether chroma keeps the full resolution. Maps of numbers need full resolution,
# because errors in their channels are more visible than errors of colour.
ALBEDO_JPEG, NORMAL_JPEG, OCCLUSION_ROUGHNESS_JPEG = (86, False), (83, True), (90, True)

# Constants of glTF, with the names in its specification.
FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
REPEAT, CLAMP_TO_EDGE = 10497, 33071
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


def _jpeg(image: Image.Image, quality: int, full_colour: bool) -> bytes:
    stream = io.BytesIO()
    subsampling = "4:4:4" if full_colour else "4:2:0"
    image.save(stream, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
    return stream.getvalue()


def _padded(content: bytes, filler: bytes) -> bytes:
    """Return content padded to a multiple of 4 bytes."""
    return content + filler * (-len(content) % 4)


class _Buffer:
    """The binary part of the file, with its buffer views."""

    def __init__(self) -> None:
        self.content = b""
        self.views: list[dict[str, int]] = []

    def add(self, content: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        self.content += _padded(content, b"\0")
        return len(self.views) - 1


def _describe(unwrapped: Unwrapped, maps: Maps) -> tuple[dict[str, Any], bytes]:
    buffer = _Buffer()
    accessors: list[dict[str, Any]] = []

    def attribute(values: NDArray[Any], kind: str) -> int:
        values = np.ascontiguousarray(values, "<f4")
        accessors.append(
            {
                "bufferView": buffer.add(values.tobytes(), ARRAY_BUFFER),
                "componentType": FLOAT,
                "count": len(values),
                "type": kind,
                "min": values.min(0).tolist(),
                "max": values.max(0).tolist(),
            }
        )
        return len(accessors) - 1

    mesh = unwrapped.mesh
    coordinates = unwrapped.coordinates * (1, -1) + (0, 1)
    attributes = {
        "POSITION": attribute(mesh.positions * METRES_PER_CM, "VEC3"),
        "NORMAL": attribute(mesh.normals, "VEC3"),
        "TEXCOORD_0": attribute(coordinates, "VEC2"),
    }
    # Index 65,535 is excluded: it is the primitive restart index.
    short = len(mesh.positions) < 65_535
    indices = mesh.faces.astype("<u2" if short else "<u4").tobytes()
    accessors.append(
        {
            "bufferView": buffer.add(indices, ELEMENT_ARRAY_BUFFER),
            "componentType": UNSIGNED_SHORT if short else UNSIGNED_INT,
            "count": mesh.faces.size,
            "type": "SCALAR",
        }
    )
    images = [
        {"bufferView": buffer.add(_jpeg(image, *encoding)), "mimeType": "image/jpeg", "name": name}
        for name, image, encoding in (
            ("albedo", maps.albedo, ALBEDO_JPEG),
            ("normal", maps.normal, NORMAL_JPEG),
            (
                "occlusion-roughness",
                maps.occlusion_roughness,
                OCCLUSION_ROUGHNESS_JPEG,
            ),
        )
    ]
    description = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [
            {
                "name": "head",
                "primitives": [
                    {"attributes": attributes, "indices": len(accessors) - 1, "material": 0}
                ],
            }
        ],
        "materials": [
            {
                "name": "skin",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicRoughnessTexture": {"index": 2},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "normalTexture": {"index": 1},
                "occlusionTexture": {"index": 2},
            }
        ],
        "textures": [{"source": index, "sampler": 0} for index in range(len(images))],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": REPEAT,
                "wrapT": CLAMP_TO_EDGE,
            }
        ],
        "images": images,
        "accessors": accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.content)}],
    }
    return description, buffer.content


def write_glb(path: Path, unwrapped: Unwrapped, maps: Maps) -> None:
    """Write the head to ``path``."""
    description, binary = _describe(unwrapped, maps)
    text = _padded(json.dumps(description, separators=(",", ":")).encode(), b" ")
    size = 12 + 8 + len(text) + 8 + len(binary)
    path.write_bytes(
        struct.pack("<III", GLB_MAGIC, 2, size)
        + struct.pack("<II", len(text), JSON_CHUNK)
        + text
        + struct.pack("<II", len(binary), BINARY_CHUNK)
        + binary
    )
