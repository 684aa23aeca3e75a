"""The features and extensions of glTF 2.0, and their support; docs/formats.md lists them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Feature:
    """A property or an extension of glTF.

    Attributes
    ----------
    name : name in glTF files
    fate : "drawn": supported; "warned": ignored with a warning; "refused": an error if the file
        requires the feature, otherwise ignored with a warning; "ignored": ignored silently
    how : details for users
    factor : property that disables a material's extension if the property is 0
    """

    name: str
    fate: Literal["drawn", "warned", "refused", "ignored"]
    how: str
    factor: str = ""

    @property
    def is_extension(self) -> bool:
        return self.name.partition("_")[0] in ("KHR", "EXT", "MSFT")


FEATURES = (
    Feature("node transforms", "drawn", "every instance is placed by the scene graph"),
    Feature(
        "primitive.mode",
        "drawn",
        "triangles, strips and fans; points and lines are ignored with a warning",
    ),
    Feature("interleaved accessors", "drawn", "any byteStride and byteOffset"),
    Feature("sparse accessors", "drawn", "vertices, indices and morph targets"),
    Feature(
        "morph targets",
        "drawn",
        "positions and normals, with the weights of the node or else of the mesh; a pose has other "
        "weights",
    ),
    Feature("skins", "drawn", "up to eight joints per vertex"),
    Feature("animations", "drawn", "in the stored pose, or in a pose of a clip"),
    Feature("cameras", "ignored", "used only with `--camera gltf`; must be perspective"),
    Feature(
        "COLOR_0",
        "drawn",
        "multiplies the base colour; its alpha is ignored, with a warning if alphaMode uses alpha",
    ),
    Feature("TEXCOORD_n", "drawn", "a material may use two sets, or one set with two transforms"),
    Feature("TANGENT", "ignored", "tangents are computed from the texture coordinates"),
    Feature("baseColor", "drawn", "albedo: factor and texture"),
    Feature("alphaMode", "drawn", "mask and blend, with the base colour's alpha and alphaCutoff"),
    Feature(
        "metallic",
        "warned",
        "drawn as a dielectric, like skin, with its base colour. A missing factor is 1 with a "
        "texture and 0 without a texture",
    ),
    Feature("roughness", "drawn", "m = (factor x green)^2; ignored without a texture"),
    Feature("normalTexture.scale", "drawn", "in [0, 100]"),
    Feature("occlusionTexture.strength", "drawn", "red channel; dims ambient light"),
    Feature("emissive", "drawn", "factor and texture"),
    Feature("doubleSided", "drawn", "back faces are drawn if it is true, or with `--double-sided`"),
    Feature(
        "sampler",
        "drawn",
        "wrapS, wrapT, and magFilter if it is NEAREST; minification always uses mip levels",
    ),
    Feature("KHR_texture_transform", "drawn", "applied to the texture coordinates"),
    Feature("KHR_mesh_quantization", "drawn", "all component types"),
    Feature("KHR_draco_mesh_compression", "drawn", "requires `facerender[draco]`"),
    Feature("EXT_meshopt_compression", "drawn", "requires `facerender[lod]`"),
    Feature("KHR_meshopt_compression", "drawn", "requires `facerender[lod]`"),
    Feature("EXT_mesh_gpu_instancing", "drawn", "one part per instance"),
    Feature("KHR_node_visibility", "drawn", "a node is drawn if it is stored as visible"),
    Feature("EXT_texture_webp", "drawn", "used instead of the texture's source"),
    Feature("EXT_texture_avif", "drawn", "used if the texture has no source"),
    Feature("MSFT_texture_dds", "drawn", "used if the texture has no source"),
    Feature("KHR_texture_basisu", "refused", "the texture's source is used if the texture has one"),
    Feature("KHR_materials_emissive_strength", "drawn", "multiplies the emission"),
    Feature("KHR_materials_ior", "drawn", "f0 = ((n - 1) / (n + 1))^2 instead of 0.028"),
    Feature(
        "KHR_materials_specular",
        "drawn",
        "the factor is ks, the texture's alpha the specular map; the mean of the colour multiplies "
        "f0. A tint or a colour texture is ignored with a warning",
    ),
    Feature("KHR_materials_pbrSpecularGlossiness", "warned", "only the diffuse colour is drawn"),
    Feature("KHR_materials_unlit", "warned", "drawn with lighting"),
    Feature("KHR_materials_clearcoat", "warned", "drawn without the coat", "clearcoatFactor"),
    Feature("KHR_materials_sheen", "warned", "drawn without sheen", "sheenColorFactor"),
    Feature(
        "KHR_materials_transmission",
        "drawn",
        "the factor is the transmission; a texture is ignored with a warning",
    ),
    Feature(
        "KHR_materials_volume",
        "drawn",
        "with transmission and a thickness above 0 the surface refracts with the ior of "
        "KHR_materials_ior; the thickness itself and the attenuation are ignored",
    ),
    Feature("KHR_materials_dispersion", "ignored", "has an effect only with transmission"),
    Feature(
        "KHR_materials_diffuse_transmission",
        "warned",
        "drawn as opaque",
        "diffuseTransmissionFactor",
    ),
    Feature("KHR_materials_anisotropy", "warned", "drawn as isotropic", "anisotropyStrength"),
    Feature("KHR_materials_iridescence", "warned", "drawn without the film", "iridescenceFactor"),
    Feature("KHR_materials_variants", "ignored", "each primitive keeps its own material"),
    Feature("KHR_lights_punctual", "warned", "use `--light` instead"),
    Feature("KHR_animation_pointer", "warned", "its channels are ignored in a pose"),
    Feature("KHR_xmp_json_ld", "ignored", "metadata"),
    Feature("MSFT_lod", "ignored", "the node itself, the finest level, is drawn"),
    Feature(
        "any other extension",
        "refused",
        "ignored with a warning; an error if the file requires it",
    ),
)
EXTENSIONS = {feature.name: feature for feature in FEATURES if feature.is_extension}
