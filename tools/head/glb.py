"""Writer of the head as a binary glTF 2.0 file with embedded JPEG maps: the skin, and open eyes.

Converts centimetres to metres, and v from up to down, as in glTF.
"""

import io
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .eye_texture import EyeMaps
from .eyes import IRIS_DEPTH, Textured
from .fields import Floats
from .shapes import Moves
from .surface import Mesh
from .texture import Maps
from .unwrap import Unwrapped

GENERATOR = "facerender tools/head"
METRES_PER_CM = 0.01

Doc = dict[str, Any]

# JPEG quality, and whether chroma keeps the full resolution. Maps of numbers need full resolution,
# because errors in their channels are more visible than errors of colour.
ALBEDO_JPEG, NORMAL_JPEG, OCCLUSION_ROUGHNESS_JPEG = (86, False), (83, True), (95, True)

# Constants of glTF, with the names in its specification.
FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
REPEAT, CLAMP_TO_EDGE = 10497, 33071
MAX_SHORT = 65_535  # vertices with short indices; index 65,535 is the primitive restart index
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


def _clear(name: str, roughness: float, index: float, thickness: float = 0.0) -> Doc:
    """Return a clear material; a thickness in metres makes it the surface of a volume."""
    extensions = {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_ior": {"ior": index},
    }
    if thickness:
        extensions["KHR_materials_volume"] = {"thicknessFactor": thickness}
    return {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": roughness},
        "extensions": extensions,
    }


# Roughness is the square root of m. The indices are those of the aqueous humour and of tears.
CORNEA = _clear("cornea", 0.173, 1.336, IRIS_DEPTH * METRES_PER_CM)
TEAR_LINE = _clear("tear-line", 0.3, 1.337)
EYEBALLS: Doc = {"name": "eyeballs"}  # with maps
LASHES: Doc = {
    # Blended parts cast no shadow: a shadow map would show the thin strands as dots.
    "name": "lash-strands",
    "alphaMode": "BLEND",
    "pbrMetallicRoughness": {
        "baseColorFactor": [0.012, 0.008, 0.006, 0.9],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.7,
    },
}


def _jpeg(image: Image.Image, quality: int, full_colour: bool) -> bytes:
    stream = io.BytesIO()
    subsampling = "4:4:4" if full_colour else "4:2:0"
    image.save(stream, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
    return stream.getvalue()


def _padded(content: bytes, filler: bytes) -> bytes:
    """Return content padded to a multiple of 4 bytes."""
    return content + filler * (-len(content) % 4)


@dataclass(frozen=True)
class Part:
    """A part besides the skin: its mesh and blend shapes in cm, its glTF material, its maps."""

    name: str
    shape: Textured
    material: Doc
    maps: EyeMaps | None = None
    moves: Moves = field(default_factory=dict)


class _Writer:
    """The binary part of the file, and what describes it."""

    def __init__(self) -> None:
        self.content = b""
        self.views: list[dict[str, int]] = []
        self.accessors: list[Doc] = []
        self.images: list[Doc] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        self.content += _padded(content, b"\0")
        return len(self.views) - 1

    def attribute(self, values: NDArray[Any], kind: str) -> int:
        values = np.ascontiguousarray(values, "<f4")
        self.accessors.append(
            {
                "bufferView": self.view(values.tobytes(), ARRAY_BUFFER),
                "componentType": FLOAT,
                "count": len(values),
                "type": kind,
                "min": values.min(0).tolist(),
                "max": values.max(0).tolist(),
            }
        )
        return len(self.accessors) - 1

    def scalars(self, values: NDArray[Any]) -> int:
        content = np.asarray(values, "<f4").ravel()
        self.accessors.append(
            {
                "bufferView": self.view(content.tobytes()),
                "componentType": FLOAT,
                "count": len(content),
                "type": "SCALAR",
                "min": [float(content.min())],
                "max": [float(content.max())],
            }
        )
        return len(self.accessors) - 1

    def sparse(self, moves: Floats) -> int:
        """Add displacements in cm, of which only those that are not 0 are stored."""
        values = np.asarray(moves * METRES_PER_CM, "<f4")
        rows = np.flatnonzero(values.any(1))
        short = len(moves) <= MAX_SHORT
        kind = UNSIGNED_SHORT if short else UNSIGNED_INT
        indices = self.view(rows.astype("<u2" if short else "<u4").tobytes())
        replaced = self.view(values[rows].tobytes())
        self.accessors.append(
            {
                "componentType": FLOAT,
                "count": len(values),
                "type": "VEC3",
                "min": values.min(0).tolist(),
                "max": values.max(0).tolist(),
                "sparse": {
                    "count": len(rows),
                    # VTK requires byteOffset, although its default is 0.
                    "indices": {"bufferView": indices, "byteOffset": 0, "componentType": kind},
                    "values": {"bufferView": replaced, "byteOffset": 0},
                },
            }
        )
        return len(self.accessors) - 1

    def mesh(
        self,
        name: str,
        mesh: Mesh,
        coordinates: Floats | None,
        material: int,
        shapes: Moves,
    ) -> Doc:
        attributes = {
            "POSITION": self.attribute(mesh.positions * METRES_PER_CM, "VEC3"),
            "NORMAL": self.attribute(mesh.normals, "VEC3"),
        }
        if coordinates is not None:
            attributes["TEXCOORD_0"] = self.attribute(coordinates * (1, -1) + (0, 1), "VEC2")
        short = len(mesh.positions) <= MAX_SHORT
        indices = mesh.faces.astype("<u2" if short else "<u4").tobytes()
        self.accessors.append(
            {
                "bufferView": self.view(indices, ELEMENT_ARRAY_BUFFER),
                "componentType": UNSIGNED_SHORT if short else UNSIGNED_INT,
                "count": mesh.faces.size,
                "type": "SCALAR",
            }
        )
        indices_at = len(self.accessors) - 1
        primitive = {"attributes": attributes, "indices": indices_at, "material": material}
        if not shapes:
            return {"name": name, "primitives": [primitive]}
        primitive["targets"] = [{"POSITION": self.sparse(moves)} for moves in shapes.values()]
        return {"name": name, "primitives": [primitive], "extras": {"targetNames": list(shapes)}}

    def image(self, name: str, image: Image.Image, encoding: tuple[int, bool]) -> int:
        view = self.view(_jpeg(image, *encoding))
        self.images.append({"bufferView": view, "mimeType": "image/jpeg", "name": name})
        return len(self.images) - 1


def _material(name: str, albedo: int, numbers: int, normal: int | None = None) -> Doc:
    """Return a material with maps, given as indices of textures."""
    found: Doc = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": albedo},
            "metallicRoughnessTexture": {"index": numbers},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
    }
    if normal is not None:
        found["normalTexture"] = {"index": normal}
    return found | {"occlusionTexture": {"index": numbers}}


# The clip "talk": weights of shapes at equal steps of time, in seconds.
TALK_STEP = 0.125
TALK: dict[str, tuple[float, ...]] = {
    "jawOpen": (0, 0.1, 0.35, 0.6, 0.3, 0.1, 0.45, 0.7, 0.4, 0.15, 0.3, 0.5, 0.25, 0.1, 0.05, 0, 0),
    "browInnerUp": (0, 0, 0.2, 0.5, 0.7, 0.7, 0.5, 0.3, 0.1, 0, 0, 0, 0, 0, 0, 0, 0),
    **dict.fromkeys(
        ("mouthSmileLeft", "mouthSmileRight"),
        (0, 0, 0, 0, 0.1, 0.2, 0.2, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.6, 0.4, 0.2, 0),
    ),
    **dict.fromkeys(
        ("eyeBlinkLeft", "eyeBlinkRight"),
        (0, 0, 0, 0, 0, 0, 0, 0.6, 1, 0.4, 0, 0, 0, 0, 0, 0, 0),
    ),
}


def _talk(writer: _Writer, meshes: Sequence[Doc]) -> Doc:
    """Return the clip "talk" of all meshes with shapes."""
    times = writer.scalars(TALK_STEP * np.arange(len(TALK["jawOpen"])))
    channels: list[Doc] = []
    samplers: list[Doc] = []
    for node, mesh in enumerate(meshes):
        if names := mesh.get("extras", {}).get("targetNames", ()):
            still = np.zeros(len(TALK["jawOpen"]))
            weights = np.stack([TALK.get(name, still) for name in names], axis=1)
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": "weights"}})
            samplers.append({"input": times, "output": writer.scalars(weights)})
    return {"name": "talk", "channels": channels, "samplers": samplers}


def _describe(
    unwrapped: Unwrapped, maps: Maps, moves: Moves, parts: Sequence[Part]
) -> tuple[dict[str, Any], bytes]:
    writer = _Writer()
    own = {name: values[unwrapped.source] for name, values in moves.items()}
    meshes = [writer.mesh("head", unwrapped.mesh, unwrapped.coordinates, 0, own)]
    albedo = writer.image("albedo", maps.albedo, ALBEDO_JPEG)
    normal = writer.image("normal", maps.normal, NORMAL_JPEG)
    numbers = writer.image(
        "occlusion-roughness", maps.occlusion_roughness, OCCLUSION_ROUGHNESS_JPEG
    )
    materials = [_material("skin", albedo, numbers, normal)]
    for part in parts:
        shape = part.shape
        meshes.append(
            writer.mesh(part.name, shape.mesh, shape.coordinates, len(materials), part.moves)
        )
        material = part.material
        if part.maps is not None:
            albedo = writer.image(f"{part.name}-albedo", part.maps.albedo, ALBEDO_JPEG)
            numbers = writer.image(
                f"{part.name}-occlusion-roughness",
                part.maps.occlusion_roughness,
                OCCLUSION_ROUGHNESS_JPEG,
            )
            material = _material(material["name"], albedo, numbers)
        materials.append(material)
    talk = _talk(writer, meshes)
    used = sorted({key for material in materials for key in material.get("extensions", {})})
    description = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        **({"extensionsUsed": used} if used else {}),
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": index, "name": mesh["name"]} for index, mesh in enumerate(meshes)],
        "meshes": meshes,
        "animations": [talk],
        "materials": materials,
        "textures": [{"source": index, "sampler": 0} for index in range(len(writer.images))],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": REPEAT,
                "wrapT": CLAMP_TO_EDGE,
            }
        ],
        "images": writer.images,
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{"byteLength": len(writer.content)}],
    }
    return description, writer.content


def write_glb(
    path: Path, unwrapped: Unwrapped, maps: Maps, moves: Moves, parts: Sequence[Part] = ()
) -> None:
    """Write the head to ``path``.

    ``moves`` are the shapes of the skin, for the vertices before unwrapping; ``parts`` are the
    eyes if they are open.
    """
    description, binary = _describe(unwrapped, maps, moves, parts)
    text = _padded(json.dumps(description, separators=(",", ":")).encode(), b" ")
    size = 12 + 8 + len(text) + 8 + len(binary)
    path.write_bytes(
        struct.pack("<III", GLB_MAGIC, 2, size)
        + struct.pack("<II", len(text), JSON_CHUNK)
        + text
        + struct.pack("<II", len(binary), BINARY_CHUNK)
        + binary
    )
