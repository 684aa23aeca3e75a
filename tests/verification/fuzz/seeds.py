"""Seeds of the fuzzer: small files of every format that facerender reads."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo

from facerender.images.files import save_exr
from facerender.mesh.mesh import Mesh
from facerender.scene.job import scene_toml
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from tests import awkward_files as files


def octahedron() -> files.Head:
    """Return a mesh with six vertices, eight faces and a map of 8 x 8 texels."""
    positions = np.array(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float
    )
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    texels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    return files.Head(
        positions,
        positions.copy(),
        0.5 + 0.4 * positions[:, :2],
        np.array(faces),
        _image(texels, "JPEG"),
    )


def _image(texels: np.ndarray[Any, Any], format: str, **options: Any) -> bytes:
    buffer = BytesIO()
    Image.fromarray(texels).save(buffer, format, **options)
    return buffer.getvalue()


def _written(write: Callable[[Path], Any], name: str) -> dict[str, bytes]:
    """Return all files that a function writes, by name, when it is called with a path."""
    with TemporaryDirectory() as folder:
        write(Path(folder, name))
        return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def meshes() -> Iterator[tuple[str, Mapping[str, bytes]]]:
    """Yield the name of a mesh file, and the content of all its files by name."""
    head = octahedron()
    colors = np.random.default_rng(1).random((6, 3))
    ascii_ply = "\n".join(
        [
            "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 6",
            *(f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz", "s", "t")),
            "element face 8\nproperty list uchar int vertex_indices\nend_header",
            *(" ".join(map(str, row)) for row in np.hstack([*[head.positions] * 2, head.uv])),
            *(f"3 {a} {b} {c}" for a, b, c in head.faces),
        ]
    )
    facet = "facet normal 0 0 1\nouter loop\n{}\nendloop\nendfacet"
    facets = (
        facet.format("\n".join("vertex {} {} {}".format(*corner) for corner in triangle))
        for triangle in head.positions[head.faces]
    )
    ascii_stl = "\n".join(["solid head", *facets, "endsolid head"])
    turned: list[dict[str, Any]] = [
        {"children": [1]},
        {"translation": [0.1, 0, 0], "rotation": files.Z_UP},
    ]

    def tree(path: Path) -> None:
        document, binary = files.gltf(head, turned)
        del document["nodes"][0]["mesh"]
        document["scenes"][0]["nodes"] = [0]
        path.write_bytes(files.join_glb(document, binary))

    def by(write: Callable[..., Any], name: str, **options: Any) -> tuple[str, dict[str, bytes]]:
        return name, _written(lambda path: write(path, head, **options), name)

    yield by(files.write_glb, "a.glb")
    yield "a.glb", _written(tree, "a.glb")
    yield by(files.write_glb, "a.glb", normals=False)
    yield by(files.write_draco, "a.glb")
    yield "a.glb", {"a.glb": featured(head)}
    yield by(files.write_gltf, "a.gltf")
    yield by(files.write_textured_obj, "a.obj")
    yield by(files.write_obj, "a.obj", uv=False, colors=colors)
    yield "a.obj", by(files.write_textured_obj, "a.obj")[1] | {"a.mtl": MTL}
    yield by(files.write_ply, "a.ply")
    yield "a.ply", {"a.ply": ascii_ply.encode()}
    yield by(files.write_stl, "a.stl")
    yield "a.stl", {"a.stl": ascii_stl.encode()}
    yield "a.glb", {"a.glb": animated(head)}


MTL = b"""newmtl skin
Kd 0.5 0.4 0.3
Ks 0.2 0.2 0.2
Ns 30
Ke 0.1 0 0
d 0.9
Tf 1 1 1
map_Kd -s 2 3 1 -o 0.5 -clamp on skin.jpg
map_Bump -bm 0.5 skin.jpg
map_d -imfchan g skin.jpg
map_Pr skin.jpg
"""


def featured(head: files.Head) -> bytes:
    """Return a GLB file with most supported features of materials, shapes and nodes."""
    document, binary = files.gltf(head, [{"skin": 0, "weights": [0.5]}, {"scale": [1, 2, 1]}])
    count = len(head.positions)
    joints, shares = np.zeros((count, 4), "<u1"), np.full((count, 4), 0.25, "<f4")
    blocks = {"JOINTS_0": joints, "WEIGHTS_0": shares, "TEXCOORD_1": head.uv.astype("<f4")}
    primitive = document["meshes"][0]["primitives"][0]
    for key, values in blocks.items():
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
        document["bufferViews"].append(view)
        primitive["attributes"][key] = len(document["accessors"])
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "count": count}
        kind = {"componentType": 5121 if key == "JOINTS_0" else 5126}
        document["accessors"].append(accessor | kind | {"type": f"VEC{values.shape[1]}"})
        binary += values.tobytes()
    document["buffers"][0]["byteLength"] = len(binary)
    primitive["targets"] = [{"POSITION": 0, "NORMAL": 1}]
    document["skins"] = [{"joints": [1]}]
    document["nodes"][1]["extensions"] = {
        "EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0, "SCALE": 1}}
    }
    document["samplers"] = [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]
    document["textures"][0]["sampler"] = 0
    transform = {"offset": [0.5, 0], "rotation": 1.5, "scale": [2, 3], "texCoord": 1}
    use = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    material = document["materials"][0]
    material |= {"alphaMode": "MASK", "alphaCutoff": 0.25, "emissiveFactor": [0.5, 0, 0]}
    material |= {"normalTexture": {"index": 0, "scale": 2}, "emissiveTexture": use}
    material["occlusionTexture"] = {"index": 0, "strength": 0.5, "texCoord": 1}
    material["pbrMetallicRoughness"]["metallicFactor"] = 0.5
    material["extensions"] = {
        "KHR_materials_ior": {"ior": 1.4},
        "KHR_materials_specular": {"specularFactor": 0.5, "specularTexture": {"index": 0}},
        "KHR_materials_emissive_strength": {"emissiveStrength": 3},
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.5},
    }
    return files.join_glb(document, binary)


def animated(head: files.Head) -> bytes:
    """Return a GLB file with a skin, sparse morph targets and a clip of all interpolations."""
    document, binary = files.gltf(head, [{"skin": 0}, {}, {"translation": [0, 0.1, 0]}])
    count, times = len(head.positions), np.array([0.0, 0.5, 1.0], "<f4")
    turns = np.array([(0, 0, 0, 1), (0, 0.6, 0, 0.8), (0.6, 0, 0, 0.8)], "<f4")
    blocks: list[tuple[np.ndarray[Any, Any], str]] = [
        (np.eye(4, dtype="<u1")[np.arange(count) % 2], "VEC4"),
        (np.tile(np.array([0.75, 0.25, 0, 0], "<f4"), (count, 1)), "VEC4"),
        (times, "SCALAR"),
        (np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], "<f4"), "VEC3"),
        (np.repeat(turns, 3, axis=0), "VEC4"),
        (np.array([(1, 1, 1), (1, 2, 1), (2, 1, 1)], "<f4"), "VEC3"),
        (np.array([0.0, 0.25, 0.5, 1.0, 0.75, 0.0], "<f4"), "SCALAR"),
        (np.tile(np.eye(4, dtype="<f4").ravel(), (2, 1)), "MAT4"),
    ]
    kinds = {"|u1": 5121, "<f4": 5126}
    first = len(document["accessors"])
    for values, name in blocks:
        binary += bytes(-len(binary) % 4)
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
        document["bufferViews"].append(view)
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "count": len(values)}
        kind = {"componentType": kinds[values.dtype.str], "type": name}
        document["accessors"].append(accessor | kind)
        binary += values.tobytes()
    binary += bytes(-len(binary) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    joints, weights, start, moves, rotations, scales, shapes, inverse = range(first, first + 8)
    primitive = document["meshes"][0]["primitives"][0]
    primitive["attributes"] |= {"JOINTS_0": joints, "WEIGHTS_0": weights}
    primitive["targets"] = [{"POSITION": 0, "NORMAL": 1}, {"POSITION": 1}]
    document["meshes"][0] |= {"weights": [0, 0.1], "extras": {"targetNames": ["open", "smile"]}}
    document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": inverse}]
    document["animations"] = [
        {
            "name": "talk",
            "samplers": [
                {"input": start, "output": moves, "interpolation": "STEP"},
                {"input": start, "output": rotations, "interpolation": "CUBICSPLINE"},
                {"input": start, "output": scales},
                {"input": start, "output": shapes},
            ],
            "channels": [
                {"sampler": 0, "target": {"node": 1, "path": "translation"}},
                {"sampler": 1, "target": {"node": 2, "path": "rotation"}},
                {"sampler": 2, "target": {"node": 2, "path": "scale"}},
                {"sampler": 3, "target": {"node": 0, "path": "weights"}},
            ],
        }
    ]
    return files.join_glb(document, binary)


def vertices(count: int) -> Iterator[tuple[str, bytes]]:
    """Yield files with two frames of vertices of a mesh with one part."""
    frames = np.random.default_rng(3).normal(size=(2, count, 3)).astype(np.float32)
    yield from _written(lambda path: np.save(path, frames), "a.npy").items()
    yield from _written(lambda path: np.savez_compressed(path, head=frames), "a.npz").items()


def images() -> Iterator[tuple[str, bytes]]:
    """Yield the name and the content of image files."""
    texels = np.random.default_rng(0).integers(0, 256, (8, 8, 4), dtype=np.uint8)
    linear = np.abs(np.random.default_rng(1).normal(size=(8, 16, 4))).astype(np.float32)
    described = PngInfo()
    described.add_text("comment", "made by code", zip=True)
    described.add(b"gAMA", (45455).to_bytes(4, "big"))
    described.add(b"pHYs", bytes(9))
    yield "a.png", _image(texels, "PNG", pnginfo=described)
    yield "a.png", _image(texels[..., :3], "PNG")
    yield "a.png", _image(texels[..., 0], "PNG", transparency=0)
    yield "a.jpg", _image(texels[..., :3], "JPEG")
    yield "a.webp", _image(texels, "WEBP", lossless=True)
    yield "a.tif", _image(texels, "TIFF")
    yield "a.tga", _image(texels, "TGA")
    yield "a.bmp", _image(texels[..., :3], "BMP")
    yield from _written(lambda path: save_exr(path, linear, {}), "a.exr").items()
    yield "a.hdr", _hdr()
    yield from _written(lambda path: np.save(path, linear), "a.npy").items()
    yield from _written(lambda path: np.save(path, texels), "a.npy").items()
    yield from _written(lambda path: np.savez_compressed(path, linear=linear), "a.npz").items()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    yield "a.jpg", _image(texels[..., :3], "JPEG", icc_profile=profile)
    yield "a.png", _image(texels, "PNG", icc_profile=profile)


def _hdr() -> bytes:
    texels = np.random.default_rng(2).integers(100, 140, (4, 8, 4), dtype=np.uint8)
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n" + texels.tobytes()


def scenes(scene: Scene) -> Iterator[bytes]:
    """Yield two scene files; facerender wrote the first."""
    yield scene_toml(scene, Shading()).encode()
    yield b"""ambient = [0.1, 0.1, 0.1]
background = "none"
lights = ["key", "point:1,2,3,1.5", { azimuth = 30, irradiance = 2.0, radius = 2.0, shadow = true }]

[[cameras]]
azimuth = 10
elevation = -5
fov = 30
zoom = 1.5

[[cameras]]
position = [0.0, 0.1, 4.0]
target = [0.0, 0.0, 0.0]

[environment]
file = "studio"
rotation = 30
scale = 0.5

[pose]
weights = { jawOpen = 0.5, "eye.blink" = 1 }
clip = "talk"
time = 0.5
track = true

[material]
m = 0.25
f0 = 0.04
second_slope = 2.0
lobe_weight = 0.7

[shading]
model = "ward"
lobe = "d8"
specular_lights = [0, 2]
"""


def cameras(mesh: Mesh) -> Iterator[tuple[str, bytes]]:
    """Yield camera files for a mesh: JSON and NumPy files with matrices, and glTF."""
    eye = mesh.center + [0.0, 0.0, 5.0 * mesh.radius]
    turn = np.diag([1.0, -1.0, -1.0])
    pose = np.column_stack([turn, -turn @ eye])
    k = [[60.0, 0.0, 12.0], [0.0, 55.0, 11.0], [0.0, 0.0, 1.0]]
    table = {"K": k, "Rt": pose.tolist(), "width": 24, "height": 24}
    apart = {"name": "b", "K": k, "R": turn.tolist(), "t": pose[:, 3].tolist(), "size": [24, 24]}
    yield "a.json", json.dumps([table, apart, {"azimuth": 10, "frame": "head"}]).encode()
    poses: dict[str, Any] = {"K": k, "Rt": np.stack([pose, pose]), "size": (24, 24)}
    yield from _written(lambda path: np.savez(path, **poses), "a.npz").items()
    glb = _written(lambda path: files.write_glb(path, octahedron()), "a.glb")["a.glb"]
    document, binary = files.split_glb(glb)
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}]
    document["nodes"].append({"name": "eye", "camera": 0, "translation": eye.tolist()})
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)
    yield "a.glb", files.join_glb(document, binary)


def options() -> Iterator[Sequence[str]]:
    """Yield command-line arguments of ``facerender render``."""
    yield (
        *("--light", "key", "--light", "point:1,2,3,1.5,radius=3", "--light", "30,20,1,2,3"),
        *("--camera", "-35,10,1.2", "--fov", "30", "--m", "0.25", "--ks", "0.18", "--kd", "0.8"),
        *("--model", "cook-torrance", "--lobe", "d16", "--f0", "0.04", "--samples", "1"),
        *("--background", "0.1,0.2,0.3", "--ambient", "0.1,0.1,0.1"),
    )
    yield (
        *("--environment", "studio,30,0.5", "--environment-samples", "8", "--background", "none"),
        *("--camera", "three-quarter", "--second-slope", "2", "--lobe-weight", "0.7"),
        *("--fresnel", "dielectric", "--exposure", "0.5"),
    )
    yield (
        *("--only", "specular", "--model", "ward", "--scattering", "skin", "--shadows"),
        *("--millimetres", "100", "--slope-filter", "--samples", "4", "--json"),
    )
    yield ("--track", "--only", "parts", "--camera", "20,5")


def tables() -> Iterator[tuple[str, bytes]]:
    """Yield job tables."""
    rows = [
        {"id": "a", "camera": {"azimuth": 10}, "material.m": 0.3, "outputs": ["image", "mask"]},
        {"id": "c", "pose": {"weights": {"jawOpen": 0.5}}, "before.clip": "talk"},
        {"id": "b", "lights": ["key"], "image": {"size": [64, 64]}, "exposure": 0.5},
    ]
    yield "a.jsonl", b"".join(json.dumps(row).encode() + b"\n" for row in rows)
    yield "a.csv", b"id,camera.azimuth,material.m,image.size\na,10,0.3,64x64\nb,-20,0.4,32x32\n"
    yield "a.toml", b'[[jobs]]\nid = "a"\n[jobs.camera]\nazimuth = 10\n[[jobs]]\nid = "b"\n'
