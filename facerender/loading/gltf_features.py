"""What of glTF 2.0 and its extensions is drawn, and what is not: the table that the reader goes by,
and that docs/formats.md shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Feature:
    """A property or an extension of glTF.

    Attributes
    ----------
    name : as files have it
    fate : "drawn"; "warned" of, and drawn without; "refused" where the file requires it, and warned
        of where it does not; "passed over" for what changes nothing of the picture
    how : what is done, for people
    factor : of a material's extension, the property that is 0 where it changes nothing
    """

    name: str
    fate: Literal["drawn", "warned", "refused", "passed over"]
    how: str
    factor: str = ""

    @property
    def is_extension(self) -> bool:
        return self.name.partition("_")[0] in ("KHR", "EXT", "MSFT")


FEATURES = (
    Feature("node transforms", "drawn", "every instance where the scene places it"),
    Feature(
        "primitive.mode", "drawn", "triangles, strips and fans; points and lines with a warning"
    ),
    Feature("interleaved accessors", "drawn", "any byteStride and byteOffset"),
    Feature("sparse accessors", "drawn", "of vertices, indices and morph targets"),
    Feature(
        "morph targets",
        "drawn",
        "positions and normals, by the weights of the node or else of the mesh",
    ),
    Feature("skins", "drawn", "joints as the nodes stand, up to eight for a vertex"),
    Feature("animations", "warned", "drawn as the nodes and weights are stored"),
    Feature("cameras", "passed over", "unless `--camera gltf` asks for them; perspective alone"),
    Feature(
        "COLOR_0", "drawn", "multiplies the base colour; its alpha with a warning, where it counts"
    ),
    Feature("TEXCOORD_n", "drawn", "two of the sets, or of their transforms, for a material"),
    Feature("TANGENT", "passed over", "tangents follow from the texture coordinates"),
    Feature("baseColor", "drawn", "albedo: factor and texture"),
    Feature("alphaMode", "drawn", "mask and blend, by the base colour's alpha and alphaCutoff"),
    Feature(
        "metallic",
        "warned",
        "the models draw dielectrics, which skin is: metal is drawn as its base colour. A factor "
        "that the file leaves out counts with a map alone",
    ),
    Feature(
        "roughness", "drawn", "m = (factor x green)^2; the factor counts with its texture alone"
    ),
    Feature("normalTexture.scale", "drawn", "in [0, 100]"),
    Feature("occlusionTexture.strength", "drawn", "red; dims light from everywhere"),
    Feature("emissive", "drawn", "factor and texture"),
    Feature("doubleSided", "passed over", "back faces are drawn by default"),
    Feature(
        "sampler",
        "drawn",
        "wrapS, wrapT, and magFilter where it is NEAREST; maps are always reduced by mip levels",
    ),
    Feature("KHR_texture_transform", "drawn", "brought into the texture coordinates"),
    Feature("KHR_mesh_quantization", "drawn", "all component types"),
    Feature("KHR_draco_mesh_compression", "drawn", "by `facerender[draco]`"),
    Feature("EXT_meshopt_compression", "drawn", "by `facerender[lod]`"),
    Feature("KHR_meshopt_compression", "drawn", "by `facerender[lod]`"),
    Feature("EXT_mesh_gpu_instancing", "drawn", "a part for every instance"),
    Feature("KHR_node_visibility", "drawn", "as stored"),
    Feature("EXT_texture_webp", "drawn", "in place of the texture's source"),
    Feature("EXT_texture_avif", "drawn", "where the texture has no source"),
    Feature("MSFT_texture_dds", "drawn", "where the texture has no source"),
    Feature("KHR_texture_basisu", "refused", "the texture's source, or no map where it has none"),
    Feature("KHR_materials_emissive_strength", "drawn", "multiplies the emission"),
    Feature("KHR_materials_ior", "drawn", "f0 = ((n - 1) / (n + 1))^2, in place of 0.028"),
    Feature(
        "KHR_materials_specular",
        "drawn",
        "factor: ks; alpha of its texture: specular map; grey of its colour: a factor on f0, tint "
        "and colour texture with a warning",
    ),
    Feature(
        "KHR_materials_pbrSpecularGlossiness", "warned", "diffuse colour drawn, specular part not"
    ),
    Feature("KHR_materials_unlit", "warned", "lit like others"),
    Feature("KHR_materials_clearcoat", "warned", "without the coat", "clearcoatFactor"),
    Feature("KHR_materials_sheen", "warned", "without sheen", "sheenColorFactor"),
    Feature("KHR_materials_transmission", "warned", "as if opaque", "transmissionFactor"),
    Feature("KHR_materials_volume", "passed over", "counts with transmission alone"),
    Feature("KHR_materials_dispersion", "passed over", "counts with transmission alone"),
    Feature(
        "KHR_materials_diffuse_transmission", "warned", "as if opaque", "diffuseTransmissionFactor"
    ),
    Feature("KHR_materials_anisotropy", "warned", "isotropic", "anisotropyStrength"),
    Feature("KHR_materials_iridescence", "warned", "without the film", "iridescenceFactor"),
    Feature("KHR_materials_variants", "passed over", "the materials of the primitives themselves"),
    Feature("KHR_lights_punctual", "warned", "the scene's lights are the options'"),
    Feature("KHR_animation_pointer", "passed over", "see animations"),
    Feature("KHR_xmp_json_ld", "passed over", "facts about the file"),
    Feature("MSFT_lod", "passed over", "the finest level, which is the node itself"),
    Feature(
        "any other extension",
        "refused",
        "drawn without, with a warning; one that the file requires is an error",
    ),
)
EXTENSIONS = {each.name: each for each in FEATURES if each.is_extension}


def not_understood(required: Sequence[str]) -> list[str]:
    """Return the extensions without which a file that requires them cannot be drawn."""
    return sorted(
        each
        for each in set(required)
        if each not in EXTENSIONS or EXTENSIONS[each].fate == "refused"
    )
