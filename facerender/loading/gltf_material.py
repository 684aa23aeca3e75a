"""Materials of glTF files: factors, maps and transforms of texture coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

import numpy as np

from facerender.errors import InputError, clipped, warn
from facerender.loading.gltf_accessors import Buffers
from facerender.loading.gltf_document import EXTENSIONS, Doc
from facerender.loading.source import inline, is_image, missing_image
from facerender.material import MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Alpha, Material
from facerender.texture.texture import Texture, Wrap
from facerender.values.ranges import range_of
from facerender.values.vectors import MOST_RADIANCE

_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror"}
_Channel = int | Literal["alpha"] | None  # None: the colours
_ALPHAS: dict[str, Alpha] = {"MASK": "mask", "BLEND": "blend"}
# Objects of a texture whose image is used, in order; "": the texture itself
_SOURCES = ("EXT_texture_webp", "", "EXT_texture_avif", "MSFT_texture_dds")

# A material and the transforms of its texture coordinates: the second for the maps named in
# ``material.second_uv``, the first for the other maps
Look = tuple[Material, Doc, Doc | None]


def _transform_of(use: Doc) -> Doc:
    """Return KHR_texture_transform of a material's reference to a texture, with all properties."""
    defaults = {"offset": [0.0, 0.0], "rotation": 0.0, "scale": [1.0, 1.0]}
    stored = use.get("extensions", {}).get("KHR_texture_transform", {})
    return {"texCoord": use.get("texCoord", 0), **defaults, **stored}


class Materials:
    """The materials of a checked glTF file. Methods raise ValueError if the data are damaged."""

    def __init__(self, buffers: Buffers, albedo_given: bool) -> None:
        self.buffers, self.name, self.document = buffers, buffers.name, buffers.document
        self.albedo_given = albedo_given
        # Keyed by the image's index: texture, texture of alpha; None: missing, unreadable
        self.images: dict[int | None, tuple[Texture, Texture | None] | None] = {}
        self.looks: dict[int, Look] = {}
        self.warn = cache(warn)

    def look(self, index: int | None, has_colors: bool) -> Look:
        """Return the look of a material; ``has_colors``: its primitive has vertex colours."""
        if index is None:
            albedo = (1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO
            return Material(albedo=albedo, double_sided=False), _transform_of({}), None
        if index not in self.looks:
            self.looks[index] = self._look(self.document["materials"][index])
        return self.looks[index]

    def _look(self, source: Doc) -> Look:
        extensions = source.get("extensions", {})
        metallic = source.get("pbrMetallicRoughness", {})
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness", {})
        specular = extensions.get("KHR_materials_specular", {})
        self._warn_of(extensions)
        base = glossy.get("diffuseTexture", metallic.get("baseColorTexture"))
        alpha = _ALPHAS.get(source.get("alphaMode", "OPAQUE"), "opaque")
        emissive = self._emissive(source, extensions)
        # Keyed by map: reference to its texture, and the image channel that the map uses
        uses: dict[str, tuple[Any, _Channel]] = {
            "albedo_map": (base, None),
            "opacity_map": (base if alpha != "opaque" else None, "alpha"),
            "normal_map": (source.get("normalTexture"), None),
            "roughness_map": (metallic.get("metallicRoughnessTexture"), 1),
            "occlusion_map": (source.get("occlusionTexture"), 0),
            "emissive_map": (source.get("emissiveTexture") if any(emissive) else None, None),
            "specular_map": (specular.get("specularTexture"), "alpha"),
        }
        transforms = {key: _transform_of(use) for key, (use, _) in uses.items() if use}
        first = next(iter(transforms.values()), _transform_of({}))
        second = next((other for other in transforms.values() if other != first), None)
        maps: dict[str, Any] = {}
        for key, transform in transforms.items():
            map_name = "emission" if key == "emissive_map" else key.removesuffix("_map")
            if transform in (first, second):
                use, channel = uses[key]
                maps[key] = self._map(use, map_name, channel)
            else:
                self.warn(
                    f"the {map_name} map of {self.name} needs a third set or transform of "
                    "texture coordinates: ignored, because a material can have only two"
                )
        if not glossy:
            self._look_for_metal(metallic)
        factor = glossy.get("diffuseFactor", metallic.get("baseColorFactor", [1.0] * 4))
        red, green, blue, opacity = (self._factor("albedo", channel) for channel in factor)
        albedo = (red, green, blue)
        lost_images = None in self.images.values()
        if lost_images and maps.get("albedo_map") is None and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # the file's white multiplies only the missing map
        material = Material(
            albedo=albedo,
            # Has no effect without a roughness map, because exporters write 1 or 0.5 by default.
            roughness_factor=self._factor("roughness", metallic.get("roughnessFactor", 1.0)),
            f0=self._f0(extensions),
            ks=self._factor("specular", specular.get("specularFactor", 1.0)),
            alpha=alpha,
            opacity=opacity if alpha != "opaque" else 1.0,
            alpha_cutoff=self._factor("alphaCutoff", source.get("alphaCutoff", 0.5), MOST_RADIANCE),
            emissive=emissive,
            double_sided=source.get("doubleSided", False),
            normal_strength=self._strength(source, "normalTexture", "scale", MAX_NORMAL_STRENGTH),
            occlusion_strength=self._strength(source, "occlusionTexture", "strength", 1.0),
            second_uv=tuple(key for key in maps if maps[key] and transforms[key] != first),
            **self._transmission(extensions, metallic),
            **maps,
        )
        return material, first, second

    def _warn_of(self, extensions: Mapping[str, Doc]) -> None:
        """Warn of the material's unsupported extensions that have an effect."""
        for key, extension in extensions.items():
            fate, how = EXTENSIONS.get(key, ("", ""))
            always = key in ("KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit")
            effect = always or any(map(np.any, extension.values()))  # a factor of 0 has no effect
            if fate == "warned" and effect:
                self.warn(f"{self.name} has {key}, which is not supported: {how}")

    def _factor(self, name: str, value: float, high: float = 1.0) -> float:
        if not 0.0 <= value <= high:
            warn(f"the {name} factor {value:.6g} of {self.name} is outside [0, {high:g}]: clamped")
        return float(min(max(value, 0.0), high))

    def _strength(self, source: Doc, use: str, key: str, high: float) -> float:
        return self._factor(f"{use}.{key}", source.get(use, {}).get(key, 1.0), high)

    def _emissive(self, source: Doc, extensions: Doc) -> tuple[float, float, float]:
        stored = extensions.get("KHR_materials_emissive_strength", {})
        strength = stored.get("emissiveStrength", 1.0)
        strength = self._factor("emissiveStrength", strength, MOST_RADIANCE)
        factor = source.get("emissiveFactor", (0.0, 0.0, 0.0))
        red, green, blue = (strength * self._factor("emissive", channel) for channel in factor)
        return red, green, blue

    def _f0(self, extensions: Doc) -> float:
        f0 = 0.028
        if "KHR_materials_ior" in extensions:
            n = extensions["KHR_materials_ior"].get("ior", 1.5)
            if n and n < 1.0:
                warn(f"the ior {n:.6g} of {self.name} is below 1: clamped to 1")
                n = 1.0
            f0 = ((n - 1.0) / (n + 1.0)) ** 2
        specular = extensions.get("KHR_materials_specular", {})
        tint = specular.get("specularColorFactor", (1.0, 1.0, 1.0))
        if "specularColorTexture" in specular or max(tint) - min(tint) > 0.01 * max(tint):
            self.warn(f"{self.name} has a specular colour (KHR_materials_specular): drawn grey")
        return min(f0 * self._factor("specularColor", sum(tint) / 3.0, MOST_RADIANCE), 0.999)

    def _transmission(self, extensions: Doc, metallic: Doc) -> dict[str, Any]:
        """Return transmission, refraction and m. A surface without thickness does not refract."""
        transmission = extensions.get("KHR_materials_transmission", {})
        factor = self._factor("transmission", transmission.get("transmissionFactor", 0.0))
        if not factor:
            return {}
        if "transmissionTexture" in transmission:
            self.warn(f"{self.name} has a transmission map: ignored, only the factor is used")
        thickness = extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0.0)
        ior = extensions.get("KHR_materials_ior", {}).get("ior", 1.5) if thickness > 0.0 else 1.0
        max_ior = range_of(Material, "refraction").high
        roughness = self._factor("roughness", metallic.get("roughnessFactor", 1.0))
        m = max(roughness * roughness, range_of(Material, "m").low)
        return {"transmission": factor, "refraction": min(max(ior, 1.0), max_ior), "m": m}

    def _look_for_metal(self, metallic: Doc) -> None:
        """Warn of a metallic material. This check decodes a metallic map of up to 2^22 texels."""
        use = metallic.get("metallicRoughnessTexture")
        factor = metallic.get("metallicFactor", 0.0 if use is None else 1.0)
        if factor <= 0.0:
            return
        source = None if use is None else self._source(self.document["textures"][use["index"]])
        if (record := self.images.get(source)) is not None:
            texture, _ = record
            if math.prod(texture.size) > 1 << 22:
                self.warn(f"{self.name} has a metallic map: ignored, drawn as a dielectric")
                return
            try:
                factor *= float(texture.channel(2, texture.name).texels().max()) / 255.0
            except InputError:  # drawing the map reports the error
                return
        if factor > 0.1:  # lower values may be JPEG noise in a map without metal
            self.warn(f"{self.name} has metallic materials: drawn as dielectrics, like skin")

    @staticmethod
    def _source(texture: Doc) -> Any:
        """Return the index of the image that is read for a texture; None without such an image."""
        tables = {"": texture, **texture.get("extensions", {})}
        stored = (tables[key] for key in _SOURCES if key in tables)
        return next((table["source"] for table in stored if "source" in table), None)

    def _map(self, use: Doc, map_name: str, channel: _Channel) -> Texture | None:
        """Return a material's map, or None if its image is missing."""
        texture = self.document["textures"][use["index"]]
        source = self._source(texture)
        replaced = map_name == "albedo" and self.albedo_given
        if source is None:
            basis = "KHR_texture_basisu" in texture.get("extensions", {})
            if not replaced:
                self.warn(
                    f"the {map_name} map of {self.name} has no image in a supported format"
                    f"{' (KHR_texture_basisu)' * basis}: ignored"
                )
            self.images[None] = None
        elif source not in self.images:
            self.images[source] = self._image(source, map_name, replaced)
        if (record := self.images[source]) is None:
            return None
        sampler = self.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        u, v = (_WRAPS.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
        nearest = sampler.get("magFilter") == 9728  # GL_NEAREST
        colors, alpha = record
        image_texture = alpha if channel == "alpha" else colors
        if isinstance(channel, int):
            image_texture = colors.channel(channel, colors.name)
        return image_texture and image_texture.sampled((u, v), nearest)

    def _image(
        self, index: int, map_name: str, replaced: bool
    ) -> tuple[Texture, Texture | None] | None:
        """Return an entry of ``images``. An unreadable image raises InputError, or causes a warning
        if the caller replaces the albedo map; ``replaced``: without a warning."""
        entry = self.document["images"][index]
        name = label = f"the {map_name} map of {self.name}"
        content: bytes | None
        try:
            if "bufferView" in entry:
                content = bytes(self.buffers.view(entry["bufferView"]))
            elif "uri" not in entry:
                raise ValueError(f"images[{index}] has neither uri nor bufferView")
            elif (content := inline(entry["uri"])) is None:
                label = f"{clipped(entry['uri'], 80)} (named by {self.name})"
                content = self.buffers.referred.read(entry["uri"], "an image file")
        except FileNotFoundError:
            if not replaced:
                missing_image(self.buffers.referred, entry["uri"])
            return None
        if not is_image(content, label, map_name, not self.albedo_given, replaced):
            return None
        alpha = Texture.alpha_of(content, f"the opacity map of {self.name}")
        return Texture.of(content, name), alpha
