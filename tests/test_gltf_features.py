"""Tests every feature of glTF in the reader's table with generated files: it is rendered, or causes
a warning."""

from __future__ import annotations

import math
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.loading.gltf_document import EXTENSIONS
from tests import awkward_files as files
from tests.awkward_files import flat, mini_head, texels
from tests.test_hostile_mesh import loaded, refused

Case = Callable[[Path], None]
CASES: dict[str, Case] = {}


def case(*names):
    def register(test):
        CASES.update(dict.fromkeys(names, test))
        return test

    return register


class File(files.Glb):
    """The small head as an editable glTF document, to which accessors and images can be added."""

    def __init__(self, **options):
        self.document, self.binary = files.gltf(mini_head(), **options)
        self.primitives: list[dict[str, Any]] = self.document["meshes"][0]["primitives"]
        self.attributes: dict[str, int] = self.primitives[0]["attributes"]
        self.material: dict[str, Any] = self.document["materials"][0]
        self.node: dict[str, Any] = self.document["nodes"][0]

    def accessor(self, values, **more):
        """Add an accessor of the type of the values."""
        return self.add(values, values.dtype.str, **more)

    def texture(self, image, **more):
        """Add a texture; return a textureInfo object that refers to it."""
        buffer = BytesIO()
        image.save(buffer, "PNG")
        self.document["images"].append({"bufferView": self.view(buffer.getvalue())})
        source = len(self.document["images"]) - 1
        self.document["textures"].append({"source": source, **more})
        return {"index": len(self.document["textures"]) - 1}

    def write(self, folder):
        path = folder / "a.glb"
        path.write_bytes(self.content())
        return path

    def read(self, folder, **options):
        return loaded(self.write(folder), **options)

    def quiet(self, folder, **options):
        """Load without a warning."""
        mesh, messages = self.read(folder, **options)
        assert messages == []
        return mesh


def plain():
    return fr.load_mesh(files.MINI_HEAD)


def same_shape(mesh, other, tolerance=1e-06):
    np.testing.assert_allclose(mesh.parts[0].positions, other.parts[0].positions, atol=tolerance)


def test_every_extension_has_a_case():
    assert EXTENSIONS.keys() <= CASES.keys()


# --- shape ---------------------------------------------------------------------------------------


@case("node transforms")
def _(folder):
    file = File(nodes=({}, {"translation": [9, 0, 0]}))
    mesh = file.quiet(folder)
    first, second = (part.positions for part in mesh.parts)
    np.testing.assert_allclose(second - first, [[9, 0, 0]] * len(first), atol=1e-6)


@case("primitive.mode")
def _(folder):
    file = File()
    file.primitives.append({**file.primitives[0], "mode": 1})
    mesh, messages = file.read(folder)
    assert len(mesh.parts) == 1
    assert messages == ["a.glb has points, lines or vertices without positions: not drawn"]


@case("interleaved accessors")
def _(folder):
    head, file = mini_head(), File()
    rows = np.hstack([head.normals, head.positions]).astype("<f4")
    view = file.view(rows.tobytes(), byteStride=24)
    for key, start in (("NORMAL", 0), ("POSITION", 12)):
        file.attributes[key] = file.accessor(
            rows[:, :3], bufferView=view, byteOffset=start, type="VEC3"
        )
    same_shape(file.quiet(folder), plain())


@case("sparse accessors")
def _(folder):
    """The indices and the values may lie in one buffer view."""
    row = np.array([0.0, 0.2, 0.0], "<f4")
    for one_view in (False, True):
        file = File()
        view = file.view(np.array([5], "<u4").tobytes() + row.tobytes())
        values = {"bufferView": view, "byteOffset": 4}
        if not one_view:
            values = {"bufferView": file.view(row)}
        indices = {"bufferView": view, "componentType": 5125}
        sparse = {"count": 1, "indices": indices, "values": values}
        file.document["accessors"][file.attributes["POSITION"]]["sparse"] = sparse
        np.testing.assert_array_equal(file.quiet(folder).parts[0].positions[5], row)


@case("morph targets")
def _(folder):
    """test_rig.py compares targets and skins with the text of the specification."""
    file = File()
    step = np.array([[0.0, 0.0, 2.0]], "<f4").repeat(len(mini_head().positions), axis=0)
    file.primitives[0]["targets"] = [{"POSITION": file.accessor(step)}]
    file.document["meshes"][0]["weights"] = [0.25]
    expected = mini_head().positions + [0, 0, 0.5]
    np.testing.assert_allclose(file.quiet(folder).parts[0].positions, expected, atol=1e-5)
    file.node["weights"] = [0.0]  # overrides the weights of the mesh
    same_shape(file.quiet(folder), plain())


@case("skins")
def _(folder):
    """The mesh node's transform is ignored."""
    count = len(mini_head().positions)
    file = File(nodes=({"translation": [50, 0, 0], "skin": 0},))
    file.attributes["JOINTS_0"] = file.accessor(np.zeros((count, 4), "<u1"))
    file.attributes["WEIGHTS_0"] = file.add(np.eye(4)[[0] * count])
    file.document["nodes"].append({"translation": [1, 0, 0]})
    file.document["scenes"][0]["nodes"] = [0, 1]
    file.skin([1])
    expected = mini_head().positions + [1, 0, 0]
    np.testing.assert_allclose(file.quiet(folder).parts[0].positions, expected, atol=1e-5)
    file.document["scenes"][0]["nodes"] = [0]
    assert file.read(folder)[1][:1] == [
        "a.glb has a skin whose joints are not in its scene: skin ignored"
    ]


@case("animations", "KHR_animation_pointer")
def _(folder):
    file = File()
    file.document["animations"] = [{"channels": [], "samplers": []}]
    file.document["extensionsUsed"] = ["KHR_animation_pointer"]
    same_shape(file.quiet(folder), plain())


@case("cameras", "KHR_xmp_json_ld", "MSFT_lod", "KHR_materials_variants")
def _(folder):
    """Features without an effect on the image are ignored silently."""
    file = File()
    file.document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]
    file.document["nodes"].append({"camera": 0})
    file.document["extensionsUsed"] = ["KHR_xmp_json_ld", "MSFT_lod", "KHR_materials_variants"]
    file.document["extensionsRequired"] = file.document["extensionsUsed"]
    same_shape(file.quiet(folder), plain())


# --- vertex attributes ---------------------------------------------------------------------------


@case("COLOR_0")
def _(folder):
    file = File()
    color = np.tile(np.array([[51, 102, 255, 128]], "<u1"), (len(mini_head().positions), 1))
    file.attributes["COLOR_0"] = file.accessor(color, normalized=True)
    part = file.quiet(folder).parts[0]
    assert part.colors is not None
    np.testing.assert_allclose(part.colors[0], [0.2, 0.4, 1.0], atol=1e-6)
    file.material["alphaMode"] = "BLEND"
    assert file.read(folder)[1] == ["a.glb has alpha in its vertex colours: ignored"]


@case("TEXCOORD_n")
def _(folder):
    head, file = mini_head(), File()
    other = (0.5 * head.uv).astype("<f4")
    file.attributes["TEXCOORD_1"] = file.accessor(other)
    file.material["occlusionTexture"] = {**file.texture(flat(128)), "texCoord": 1}
    mesh = file.quiet(folder)
    part, material = mesh.parts[0], mesh.materials[0]
    assert material.second_uv == ("occlusion_map",)
    assert part.uv is not None
    assert part.uv2 is not None
    np.testing.assert_allclose(part.uv, head.uv, atol=1e-6)
    np.testing.assert_allclose(part.uv2, other * (1, -1) + (0, 1), atol=1e-6)
    file.material["normalTexture"] = {**file.texture(flat(128, 128, 255)), "texCoord": 2}
    mesh, messages = file.read(folder)
    assert messages == [
        "the occlusion map of a.glb needs a third set or transform of texture coordinates: "
        "ignored, because a material can have only two",
        "a.glb has no second texture coordinates: maps that use them are ignored",
    ]
    material = mesh.materials[0]
    assert material.albedo_map is not None
    assert (material.normal_map, material.occlusion_map, material.second_uv) == (None, None, ())


@case("KHR_texture_transform")
def _(folder):
    """The transform shows the lower left quarter of the image, as in the extension's README."""
    head, file = mini_head(), File()
    own = {"offset": [0, 1], "rotation": math.pi / 2, "scale": [0.5, 0.5]}
    use = file.material["pbrMetallicRoughness"]["baseColorTexture"]
    use["extensions"] = {"KHR_texture_transform": own}
    file.material["occlusionTexture"] = file.texture(flat(128))
    file.document["extensionsRequired"] = ["KHR_texture_transform"]
    mesh = file.quiet(folder)
    u, v = head.uv[:, 0], 1.0 - head.uv[:, 1]
    np.testing.assert_allclose(mesh.parts[0].uv, np.stack([0.5 * v, 0.5 * u], axis=1), atol=1e-6)
    np.testing.assert_allclose(mesh.parts[0].uv2, head.uv, atol=1e-6)
    use["extensions"]["KHR_texture_transform"] = {"texCoord": 0, "scale": [2, 3]}
    u, v = 2.0 * u, 3.0 * v
    np.testing.assert_allclose(
        file.quiet(folder).parts[0].uv, np.stack([u, 1.0 - v], axis=1), atol=1e-6
    )


@case("TANGENT")
def _(folder):
    file = File()
    tangents = np.ones((len(mini_head().positions), 4), "<f4")
    file.attributes["TANGENT"] = file.accessor(tangents)
    same_shape(file.quiet(folder), plain())


# --- materials -----------------------------------------------------------------------------------


@case("baseColor")
def _(folder):
    file = File()
    file.material["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 0.75, 0.5]
    material = file.quiet(folder).materials[0]
    assert material.albedo == (0.5, 0.25, 0.75)
    assert (material.alpha, material.opacity, material.opacity_map) == ("opaque", 1.0, None)
    assert texels(material.albedo_map).shape[2] == 3
    file.material["pbrMetallicRoughness"]["baseColorFactor"] = [3, 0.5, -1, 1]
    mesh, messages = file.read(folder)
    assert mesh.materials[0].albedo == (1.0, 0.5, 0.0)
    assert messages == [
        f"the albedo factor {value} of a.glb is outside [0, 1]: clamped" for value in (3, -1)
    ]


@case("alphaMode")
def _(folder):
    file = File()
    base = file.material["pbrMetallicRoughness"]
    base["baseColorTexture"] = file.texture(flat(10, 20, 30, 90))
    base["baseColorFactor"] = [1, 1, 1, 0.5]
    file.material |= {"alphaMode": "MASK", "alphaCutoff": 0.25}
    material = file.quiet(folder).materials[0]
    assert (material.alpha, material.opacity, material.alpha_cutoff) == ("mask", 0.5, 0.25)
    assert (texels(material.opacity_map) == 90).all()
    assert (texels(material.albedo_map) == [10, 20, 30]).all()
    del file.material["alphaCutoff"]
    file.material["alphaMode"] = "BLEND"
    replaced = Image.new("RGB", (2, 2))
    replaced.save(folder / "own.png")
    material = file.quiet(folder, albedo=folder / "own.png").materials[0]
    assert (material.alpha, material.alpha_cutoff) == ("blend", 0.5)
    assert (texels(material.opacity_map) == 90).all()  # of the file's own map


@case("metallic")
def _(folder):
    expected_warning = ["a.glb has metallic materials: drawn as dielectrics, like skin"]
    file = File()
    base = file.material["pbrMetallicRoughness"]
    assert file.read(folder)[1] == []  # no warning by default
    base["metallicFactor"] = 1.0
    assert file.read(folder)[1] == expected_warning
    base["metallicRoughnessTexture"] = file.texture(flat(0, 128, 5))
    assert file.read(folder)[1] == []  # nearly 0, as JPEG errors leave it
    base["metallicRoughnessTexture"] = file.texture(flat(0, 128, 255))
    del base["metallicFactor"]
    assert file.read(folder)[1] == expected_warning
    base["metallicFactor"] = 0.0
    assert file.read(folder)[1] == []


@case("roughness")
def _(folder):
    file = File()
    base = file.material["pbrMetallicRoughness"]
    base["roughnessFactor"] = 0.5
    assert file.quiet(folder).materials[0].m == fr.Material().m
    base["metallicRoughnessTexture"] = file.texture(flat(0, 102, 0))
    assert file.quiet(folder).materials[0].slopes == pytest.approx(((0.5 * 0.4) ** 2,) * 2)


@case("normalTexture.scale")
def _(folder):
    file = File()
    file.material["normalTexture"] = {**file.texture(flat(128, 128, 255)), "scale": 2.5}
    assert file.quiet(folder).materials[0].normal_strength == 2.5
    file.material["normalTexture"]["scale"] = -1
    assert file.read(folder)[1] == [
        "the normalTexture.scale factor -1 of a.glb is outside [0, 100]: clamped"
    ]


@case("occlusionTexture.strength")
def _(folder):
    file = File()
    file.material["occlusionTexture"] = {**file.texture(flat(50, 90, 0)), "strength": 0.25}
    material = file.quiet(folder).materials[0]
    assert material.occlusion_strength == 0.25
    assert (texels(material.occlusion_map) == 50).all()


@case("emissive", "KHR_materials_emissive_strength")
def _(folder):
    file = File()
    file.material["emissiveTexture"] = file.texture(flat(9, 8, 7))
    assert file.quiet(folder).materials[0].emissive_map is None  # its factor is 0
    file.material["emissiveFactor"] = [1, 0.5, 0]
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}
    file.material["extensions"] = strength
    material = file.quiet(folder).materials[0]
    assert material.emissive == (4.0, 2.0, 0.0)
    assert (texels(material.emissive_map) == [9, 8, 7]).all()


@case("doubleSided")
def _(folder):
    file = File()
    file.material["doubleSided"] = True
    same_shape(file.quiet(folder), plain())


@case("sampler")
def _(folder):
    file = File()
    file.document["samplers"] = [
        {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728, "minFilter": 9985},
        {"wrapS": 10497, "magFilter": 9729, "minFilter": 9728},
    ]
    file.document["textures"][0]["sampler"] = 0
    file.material["normalTexture"] = file.texture(flat(128, 128, 255), sampler=1)
    material = file.quiet(folder).materials[0]
    assert material.albedo_map is not None
    assert material.normal_map is not None
    assert material.albedo_map.sampling == (("clamp", "mirror"), True)
    assert material.normal_map.sampling == (("repeat", "repeat"), False)


# --- extensions ----------------------------------------------------------------------------------


@case("KHR_mesh_quantization")
def _(folder):
    head, file = mini_head(), File()
    low, extent = head.positions.min(axis=0), np.ptp(head.positions, axis=0)
    numbers = np.round((head.positions - low) / extent * 65535).astype("<u2")
    padded = np.hstack([numbers, np.zeros((len(numbers), 1), "<u2")])
    view = file.view(padded.tobytes(), byteStride=8)
    file.attributes["POSITION"] = file.accessor(
        numbers, bufferView=view, type="VEC3", normalized=True
    )
    file.node |= {"translation": low.tolist(), "scale": extent.tolist()}
    file.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    same_shape(file.quiet(folder), plain(), 2.0 * float(extent.max()) / 65535)


@case("KHR_draco_mesh_compression")
def _(folder):
    pytest.importorskip("DracoPy")
    mesh, messages = loaded(files.write_draco(folder / "a.glb", mini_head()))
    assert messages == []
    np.testing.assert_allclose(mesh.bounds, plain().bounds, atol=1e-3)


# Eight elements of 12 bytes, and two triangles, encoded by meshoptimizer 1.3.
PACKED_VERTICES = (
    "a1767676008000ff002000dbdca2827400160082020200c000ffff000077f7c2ae687c001600"
    "04020200e000ffff8000908fe4a49870780128820000000000000000000000000000000000803f00008040000000"
)
PACKED_FACES = "e1f010007687566778a9866589689801690000"


@case("EXT_meshopt_compression", "KHR_meshopt_compression")
def _(folder):
    pytest.importorskip("meshoptimizer")
    vertices = np.arange(24, dtype="<f4").reshape(8, 3) ** 2
    for key in ("EXT_meshopt_compression", "KHR_meshopt_compression"):
        file = files.Glb({"mesh": 0})
        file.mesh(file.primitive(vertices, [0, 1, 2, 2, 1, 3]))
        whole, file.binary = len(file.binary), b""
        file.document["extensionsRequired"] = [key]
        packed = (PACKED_VERTICES, "ATTRIBUTES", 12), (PACKED_FACES, "TRIANGLES", 2)
        for view, (digits, mode, size) in zip(file.document["bufferViews"], packed, strict=True):
            content = bytes.fromhex(digits)
            own = {"buffer": 0, "byteOffset": len(file.binary), "byteLength": len(content)}
            own |= {"byteStride": size, "count": view["byteLength"] // size, "mode": mode}
            view |= {"buffer": 1, "extensions": {key: own}}
            file.binary += content
        file.document["buffers"] = [{"byteLength": len(file.binary)}, {"byteLength": whole}]
        path = folder / "a.glb"
        path.write_bytes(file.content())
        part = loaded(path)[0].parts[0]
        np.testing.assert_array_equal(part.positions, vertices[:4])  # only vertices of faces stay
        assert sorted(map(sorted, part.faces.tolist())) == [[0, 1, 2], [1, 2, 3]]
        own["byteStride"] = 3
        path.write_bytes(file.content())
        assert "has an invalid mode, filter (NONE)" in refused(path)
        own["byteStride"] = 2
        file.document["bufferViews"][0]["extensions"][key]["count"] = 1 << 40
        path.write_bytes(file.content())
        assert "damaged" in refused(path)


@case("EXT_mesh_gpu_instancing")
def _(folder):
    file = File()
    moves = np.array([[0, 0, 0], [0, 9, 0], [0, 18, 0]], "<f4")
    scales = np.array([[1, 1, 1], [1, 1, 1], [2, 2, 2]], "<f4")
    attributes = {"TRANSLATION": file.accessor(moves), "SCALE": file.accessor(scales)}
    file.node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    file.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    first, second, third = (part.positions for part in file.quiet(folder).parts)
    np.testing.assert_allclose(second, first + [0, 9, 0], atol=1e-5)
    np.testing.assert_allclose(third, 2.0 * first + [0, 18, 0], atol=1e-5)


@case("KHR_node_visibility")
def _(folder):
    file = File(nodes=({}, {"translation": [9, 0, 0]}))
    hidden = {"KHR_node_visibility": {"visible": False}}
    file.document["nodes"] = [{"children": [1], "extensions": hidden}, {"mesh": 0}, {"mesh": 0}]
    file.document["scenes"][0]["nodes"] = [0, 2]
    assert len(file.quiet(folder).parts) == 1


@case("EXT_texture_webp", "EXT_texture_avif", "MSFT_texture_dds")
def _(folder):
    for key in ("EXT_texture_webp", "EXT_texture_avif", "MSFT_texture_dds"):
        file = File()  # with a JPEG, since the test needs only a readable image
        file.document["textures"][0] = {"extensions": {key: {"source": 0}}}
        file.document["extensionsRequired"] = [key]
        assert file.quiet(folder).materials[0].albedo_map is not None


@case("KHR_texture_basisu")
def _(folder):
    file = File()
    other = {"KHR_texture_basisu": {"source": 0}}
    file.document["textures"][0]["extensions"] = other
    file.document["extensionsUsed"] = ["KHR_texture_basisu"]
    assert file.quiet(folder).materials[0].albedo_map is not None
    file.document["textures"][0] = {"extensions": other}
    messages = file.read(folder)[1]
    assert messages == [
        "the albedo map of a.glb has no image in a supported format (KHR_texture_basisu): ignored"
    ]
    file.document["extensionsRequired"] = ["KHR_texture_basisu"]
    assert "requires the extension KHR_texture_basisu" in refused(file.write(folder))


@case("KHR_materials_ior")
def _(folder):
    file = File()
    assert file.quiet(folder).materials[0].f0 == fr.Material().f0
    for ior, f0 in ((1.5, 0.04), (1.33, (0.33 / 2.33) ** 2), (1.0, 0.0), (0.0, 0.999)):
        file.material["extensions"] = {"KHR_materials_ior": {"ior": ior}}
        assert file.quiet(folder).materials[0].f0 == pytest.approx(f0)


@case("KHR_materials_specular")
def _(folder):
    file = File()
    own = {"specularFactor": 0.3, "specularTexture": file.texture(flat(1, 2, 3, 77))}
    file.material["extensions"] = {
        "KHR_materials_specular": own | {"specularColorFactor": [0.5, 0.5, 0.5]}
    }
    material = file.quiet(folder).materials[0]
    assert (material.ks, material.f0) == (0.3, pytest.approx(0.014))
    assert (texels(material.specular_map) == 77).all()
    own["specularColorFactor"] = [1, 0, 0]
    file.material["extensions"] = {"KHR_materials_specular": own}
    assert file.read(folder)[1] == [
        "a.glb has a specular colour (KHR_materials_specular): drawn grey"
    ]


@case("KHR_materials_pbrSpecularGlossiness")
def _(folder):
    file = File()
    own = {"diffuseFactor": [0.5, 0.5, 0.5, 1], "specularFactor": [1, 1, 1]}
    file.material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": own}
    mesh, messages = file.read(folder)
    assert mesh.materials[0].albedo == (0.5, 0.5, 0.5)
    assert len(messages) == 1
    assert "pbrSpecularGlossiness" in messages[0]


@case("KHR_materials_unlit")
def _(folder):
    """Emission, transmission and metal of the file are for programs without the extension."""
    file = File()
    own = {"KHR_materials_unlit": {}, "KHR_materials_transmission": {"transmissionFactor": 0.5}}
    file.material |= {"extensions": own, "emissiveFactor": [0, 1, 0]}
    metallic = {"baseColorFactor": [0.5, 0.25, 1, 1], "metallicFactor": 1}
    file.material["pbrMetallicRoughness"] |= metallic
    scene = fr.Scene(file.quiet(folder), lights=("key",), environment="studio", background=None)
    with fr.Renderer((64, 48), samples=1) as renderer:
        linear = renderer.render(scene).linear
        np.testing.assert_allclose(linear, renderer.render(scene, only="albedo").linear, atol=1e-6)
    assert linear[..., 3].mean() > 0.1
    assert np.median(linear[linear[..., 3] > 0.0], axis=0)[2] > 0.1


LAYERS = {
    "KHR_materials_clearcoat": {"clearcoatFactor": 0.5},
    "KHR_materials_sheen": {"sheenColorFactor": [0, 0.1, 0]},
    "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.5},
    "KHR_materials_anisotropy": {"anisotropyStrength": 0.5},
    "KHR_materials_iridescence": {"iridescenceFactor": 0.5},
}


@case("KHR_materials_transmission", "KHR_materials_volume")
def _(folder):
    file = File()
    own: dict[str, Any] = {"KHR_materials_volume": {"thicknessFactor": 1}}
    file.material["extensions"] = own
    material = file.quiet(folder).materials[0]
    assert (material.transmission, material.refraction) == (0.0, 1.0)
    own["KHR_materials_transmission"] = {"transmissionFactor": 0.75}
    material = file.quiet(folder).materials[0]
    assert (material.transmission, material.refraction) == (0.75, 1.5)
    own["KHR_materials_ior"] = {"ior": 1.336}
    assert file.quiet(folder).materials[0].refraction == 1.336
    own["KHR_materials_volume"] = {}
    assert file.quiet(folder).materials[0].refraction == 1.0
    own["KHR_materials_transmission"]["transmissionTexture"] = file.texture(flat(9))
    material, messages = file.read(folder)[0].materials[0], file.read(folder)[1]
    assert messages == ["a.glb has a transmission map: ignored, only the factor is used"]
    assert material.transmission == 0.75


@case(*LAYERS, "KHR_materials_dispersion")
def _(folder):
    for key, own in LAYERS.items():
        file = File(nodes=({}, {"translation": [9, 0, 0]}))
        file.document["materials"].append({"extensions": {key: own}})  # two materials, one warning
        file.material["extensions"] = {key: own}
        file.document["meshes"].append({"primitives": [{**file.primitives[0], "material": 1}]})
        file.document["nodes"][1]["mesh"] = 1
        file.document["extensionsRequired"] = [key]
        assert file.read(folder)[1] == [
            f"a.glb has {key}, which is not supported: {EXTENSIONS[key].partition(': ')[2]}"
        ]
        if own:
            for extensions in (file.material["extensions"], file.document["materials"][1]):
                extensions.clear()
            file.material["extensions"] = {key: {}}
            file.quiet(folder)
    file = File()
    file.material["extensions"] = {"KHR_materials_dispersion": {}}
    file.quiet(folder)


@case("KHR_lights_punctual")
def _(folder):
    file = File()
    file.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    file.document["extensionsUsed"] = ["KHR_lights_punctual"]
    file.quiet(folder)  # no node uses the light
    file.node["extensions"] = {"KHR_lights_punctual": {"light": 0}}
    assert file.read(folder)[1] == ["a.glb has lights (KHR_lights_punctual): ignored; use --light"]


@case("any extension that is not listed below")
def _(folder):
    file = File()
    file.document["extensionsUsed"] = ["ACME_glow"]
    assert file.read(folder)[1] == ["a.glb uses ACME_glow, which is not supported: ignored"]
    file.document["extensionsRequired"] = ["ACME_glow"]
    assert "requires the extension ACME_glow" in refused(file.write(folder))


ONCE = {test: name for name, test in reversed(CASES.items())}  # a test may cover several features


@pytest.mark.first_case
@pytest.mark.parametrize("test", ONCE, ids=ONCE.values())
def test_feature(test, tmp_path):
    test(tmp_path)
