"""Read the chunks of a glTF file, and check its JSON against a table of supported properties. The
table follows the schema of glTF 2.0 (Khronos, 2021, section 5); other properties are ignored.
docs/formats.md lists the features and extensions, and their support."""

from __future__ import annotations

import json
import reprlib
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import PurePath
from typing import Any

from facerender.errors import InputError, reason

_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # chunk types
_MAX_VALUES = 2_000_000  # values per document; a value takes up to 100 bytes of memory
_MAX_ENTRIES = 1 << 17  # maximum length of a list of the document, such as "nodes"
Doc = dict[str, Any]

# The properties of each JSON object and their types; ! marks required properties. Type "#nodes" is
# an index into the list "nodes"; "[x]" is a list of values of type x; "3 x" is a list of three
# values of type x. Type "{x}" is an object with any keys and values of type x. All other types are
# objects of this table or keys of _VALUES.
_SCHEMA = {
    "document": "extensionsRequired: [text], extensionsUsed: [text], buffers: [buffers], "
    "bufferViews: [bufferViews], accessors: [accessors], images: [images], textures: [textures], "
    "samplers: [samplers], materials: [materials], meshes: [meshes], skins: [skins], "
    "cameras: [cameras], nodes: [nodes], scenes: [scenes], animations: any, scene: #scenes",
    "buffers": "byteLength!: size, uri: text",
    "bufferViews": "buffer!: #buffers, byteOffset: size, byteLength!: size, byteStride: size, "
    "extensions: view extensions",
    "view extensions": "EXT_meshopt_compression: packed, KHR_meshopt_compression: packed",
    "packed": "buffer!: #buffers, byteOffset: size, byteLength!: size, byteStride!: size, "
    "count!: size, mode!: text, filter: text",
    "accessors": "name: name, bufferView: #bufferViews, byteOffset: size, "
    "componentType!: component, normalized: switch, count!: size, type!: type, sparse: sparse",
    "sparse": "count!: size, indices!: sparse part, values!: sparse part",
    "sparse part": "bufferView!: #bufferViews, byteOffset: size, componentType: component",
    "images": "uri: text, bufferView: #bufferViews",
    "samplers": "magFilter: size, wrapS: size, wrapT: size",
    "textures": "source: #images, sampler: #samplers, extensions: texture extensions",
    "texture extensions": "EXT_texture_webp: image, EXT_texture_avif: image, "
    "MSFT_texture_dds: image, KHR_texture_basisu: image",
    "image": "source: #images",
    "materials": "name: name, pbrMetallicRoughness: metallic, normalTexture: map, "
    "occlusionTexture: map, emissiveTexture: map, emissiveFactor: 3 number, alphaMode: text, "
    "alphaCutoff: number, doubleSided: switch, extensions: material extensions",
    "metallic": "baseColorFactor: 4 number, baseColorTexture: map, metallicFactor: number, "
    "metallicRoughnessTexture: map, roughnessFactor: number",
    "material extensions": "KHR_materials_pbrSpecularGlossiness: glossy, "
    "KHR_materials_emissive_strength: emissive, KHR_materials_ior: ior, "
    "KHR_materials_specular: specular, KHR_materials_unlit: empty, "
    "KHR_materials_clearcoat: clearcoat, KHR_materials_sheen: sheen, "
    "KHR_materials_transmission: transmission, KHR_materials_volume: volume, "
    "KHR_materials_diffuse_transmission: diffuse transmission, "
    "KHR_materials_anisotropy: anisotropy, KHR_materials_iridescence: iridescence, "
    "KHR_materials_subsurface: empty",
    "glossy": "diffuseFactor: 4 number, diffuseTexture: map",
    "emissive": "emissiveStrength: number",
    "ior": "ior: number",
    "specular": "specularFactor: number, specularTexture: map, specularColorFactor: 3 number, "
    "specularColorTexture: map",
    "clearcoat": "clearcoatFactor: number",
    "sheen": "sheenColorFactor: 3 number",
    "transmission": "transmissionFactor: number, transmissionTexture: map",
    "volume": "thicknessFactor: number",
    "diffuse transmission": "diffuseTransmissionFactor: number",
    "anisotropy": "anisotropyStrength: number",
    "iridescence": "iridescenceFactor: number",
    "empty": "",
    "map": "index!: #textures, texCoord: size, scale: number, strength: number, "
    "extensions: map extensions",
    "map extensions": "KHR_texture_transform: transform",
    "transform": "offset: 2 number, rotation: number, scale: 2 number, texCoord: size",
    "meshes": "primitives!: [primitive], name: name, weights: [number], extras: any",
    "primitive": "attributes!: {#accessors}, indices: #accessors, material: #materials, "
    "mode: mode, targets: [{#accessors}], extras: any, extensions: primitive extensions",
    "primitive extensions": "KHR_draco_mesh_compression: draco",
    "draco": "bufferView!: #bufferViews, attributes!: {size}",
    "cameras": "name: text, perspective: perspective, orthographic: orthographic",
    "perspective": "yfov!: number",
    "orthographic": "ymag!: number",
    "nodes": "name: name, mesh: #meshes, skin: #skins, weights: [number], camera: #cameras, "
    "children: [#nodes], matrix: 16 number, translation: 3 number, scale: 3 number, "
    "rotation: 4 number, extensions: node extensions",
    "node extensions": "EXT_mesh_gpu_instancing: instancing, KHR_node_visibility: visibility, "
    "KHR_lights_punctual: empty",
    "instancing": "attributes!: {#accessors}",
    "visibility": "visible: switch",
    "skins": "joints!: [#nodes], inverseBindMatrices: #accessors",
    "scenes": "nodes: [#nodes]",
    "animation": "channels!: [channel], samplers!: [keys]",
    "channel": "sampler!: size, target!: target",
    "target": "node: #nodes, path!: text",
    "keys": "input!: #accessors, output!: #accessors, interpolation: text",
}
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and -1e300 < value < 1e300


def _is_size(value: Any) -> bool:
    return _is_number(value) and 0 <= value < 1 << 53 and value == int(value)


# Keyed by type: check of a value, conversion, description for messages. A size such as 3 may be
# written as 3.0. A name is only for display: values of other types become "".
_VALUES: dict[str, tuple[Callable[[Any], bool], Callable[[Any], Any], str]] = {
    "any": (lambda value: True, lambda value: value, ""),
    "text": (lambda value: isinstance(value, str), str, "text"),
    "name": (lambda value: True, lambda value: value if isinstance(value, str) else "", ""),
    "switch": (lambda value: isinstance(value, bool), bool, "true or false"),
    "number": (_is_number, float, "a number"),
    "size": (_is_size, int, "an integer >= 0"),
    "component": (lambda code: _is_size(code) and code in COMPONENTS, int, "a glTF component type"),
    "type": (lambda value: isinstance(value, str) and value in TYPES, str, "a glTF accessor type"),
    "mode": (lambda value: _is_size(value) and value in range(7), int, "a glTF primitive mode"),
}


@cache
def _properties(name: str) -> dict[str, str]:
    """Return the type of each property of an object of _SCHEMA."""
    return dict(entry.split(": ") for entry in _SCHEMA[name].split(", ") if entry)


def chunks(data: bytes, name: str) -> tuple[bytes, memoryview | None]:
    """Return the JSON of a glTF file, and its binary chunk or None. A .gltf file is all JSON."""
    if data[:4] != b"glTF":
        if data.startswith((b"\xef\xbb\xbfglTF", b"\xff\xfeg\0l\0T\0F\0")):
            raise _converted(name, "to Unicode")
        return data, None
    version, declared = struct.unpack_from("<II", data, 4) if len(data) >= 20 else (2, 20)
    check_conversion(name, data, declared)
    if declared > len(data):
        expected = declared if len(data) >= 20 else "at least 20"
        sizes = f"it should have {expected} bytes, but has {len(data)}"
        raise InputError(f"{name} is truncated: {sizes}; copy it again as binary data")
    if version != 2:
        raise InputError(f"{name} is glTF version {version}: export it as version 2")
    contents: dict[int, memoryview] = {}
    start = 12
    while start + 8 <= declared:
        length, chunk_type = struct.unpack_from("<II", data, start)
        if start + 8 + length > declared:
            raise damaged(name, f"a chunk has {length} bytes, the file {declared}")
        contents.setdefault(chunk_type, memoryview(data)[start + 8 : start + 8 + length])
        start += 8 + length
    if _JSON not in contents:
        raise damaged(name, "it has no JSON chunk")
    return bytes(contents[_JSON]), contents.get(_BINARY)


def check_conversion(name: str, data: bytes | memoryview, size: int) -> None:
    """Raise InputError if a conversion of text changed binary data of originally ``size`` bytes."""
    if len(data) == size:
        return
    data = bytes(data)
    feeds, pairs = data.count(b"\n"), data.count(b"\r\n")
    if len(data) > size and pairs == feeds >= len(data) - size:
        raise _converted(name, "from LF to CRLF")
    with suppress(UnicodeDecodeError):
        text = data.decode()  # binary data with bytes above 127 are no UTF-8
        if not text.isascii():
            replaced = " with replacement characters" * ("\ufffd" in text)
            raise _converted(name, f"to UTF-8{replaced}")
    # Each conversion of CRLF removes a byte, and few do so by chance in floats and images. If data
    # of this length would hold 4 CRLFs by chance but hold none, they were converted.
    missing, expected = size - len(data), data.count(b"\r") * feeds / max(len(data), 1)
    if 0 < missing <= min(feeds, max(8 * expected, 4)) and not pairs and expected > 4.0:
        raise _converted(name, "from CRLF to LF")


def _converted(name: str, how: str) -> InputError:
    suffix = PurePath(name).suffix or ".glb"
    remedy = f"transfer it again as binary data; in Git, add '*{suffix} binary' to .gitattributes"
    return InputError(f"{name} is damaged, because it was converted as text ({how}): {remedy}")


def document_of(text: bytes, name: str) -> Doc:
    """Parse and check the JSON of a glTF file. Return only the properties of _SCHEMA. Missing lists
    of the document become empty."""
    if text.count(b",") + text.count(b"[") + text.count(b"{") > _MAX_VALUES:
        raise InputError(f"{name} has more than {_MAX_VALUES} values in its JSON: simplify it")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        why = f"its JSON cannot be read ({reason(error).partition(';')[0]})"
        raise InputError(f"{name} is not glTF: {why}; export it again") from None
    properties = _properties("document")
    if not isinstance(document, dict) or document.keys().isdisjoint({"asset", *properties}):
        raise InputError(f"{name} is not glTF but other JSON ({reprlib.repr(document)})")
    if document.get("meshes", []) == []:
        raise InputError(f"{name} has no mesh; give a file with a triangle mesh")
    for key in properties:
        if (count := _count(document, key)) > _MAX_ENTRIES:
            remedy = "simplify it"
            raise InputError(f"{name} has {count} {key}, but the limit is {_MAX_ENTRIES}: {remedy}")
    try:
        valid = checked(document, "document", "", document)
    except ValueError as error:
        raise damaged(name, str(error)) from None
    return {**{key: [] for key, shape in properties.items() if shape[0] == "["}, **valid}


def _count(document: Doc, key: str) -> int:
    return len(entries) if isinstance(entries := document.get(key), list) else 0


def damaged(name: str, what: str) -> InputError:
    return InputError(f"{name} is damaged ({what}); export it again")


def checked(value: Any, shape: str, where: str, document: Doc) -> Any:
    """Convert a value of a document to a type of _SCHEMA, or raise ValueError."""
    if shape in _SCHEMA or shape[0] == "{":
        _expect(isinstance(value, dict), value, where, "an object")
        if shape[0] == "{":
            return {
                key: checked(entry, shape[1:-1], f"{where}[{reprlib.repr(key)}]", document)
                for key, entry in value.items()
            }
        result = {}
        for key, inner in _properties(shape).items():
            name = key.rstrip("!")
            path = f"{where}.{name}" if where else name
            if name in value:
                result[name] = checked(value[name], inner, path, document)
            elif key != name:
                raise ValueError(f"{path} is missing")
        return result
    if shape[0] == "[" or shape[0].isdigit():
        length, inner = ("", shape[1:-1]) if shape[0] == "[" else shape.split(" ", 1)
        good = isinstance(value, list) and length in ("", str(len(value)))
        _expect(good, value, where, f"{length} numbers" if length else "a list")
        return [checked(entry, inner, f"{where}[{i}]", document) for i, entry in enumerate(value)]
    if shape[0] == "#":
        count = _count(document, shape[1:])
        good = _is_size(value) and value < count
        _expect(good, value, where, f"an index into the {count} {shape[1:]}")
        return int(value)
    check, convert, description = _VALUES[shape]
    _expect(check(value), value, where, description)
    return convert(value)


def _expect(good: bool, value: Any, where: str, description: str) -> None:
    if not good:
        raise ValueError(f"{where} = {reprlib.repr(value)} is not {description}")


# Keyed by extension: fate: details for users. "drawn": supported; "warned": ignored with a
# warning; "refused": an error if the file requires the extension, otherwise ignored with a warning;
# "ignored": ignored silently.
EXTENSIONS = {
    "KHR_texture_transform": "drawn: applied to the texture coordinates",
    "KHR_mesh_quantization": "drawn: all component types",
    "KHR_draco_mesh_compression": "drawn: requires `facerender[draco]`",
    "EXT_meshopt_compression": "drawn: requires `facerender[lod]`",
    "KHR_meshopt_compression": "drawn: requires `facerender[lod]`",
    "EXT_mesh_gpu_instancing": "drawn: one part per instance",
    "KHR_node_visibility": "drawn: a node is drawn if it is stored as visible",
    "EXT_texture_webp": "drawn: used instead of the texture's source",
    "EXT_texture_avif": "drawn: used if the texture has no source",
    "MSFT_texture_dds": "drawn: used if the texture has no source",
    "KHR_texture_basisu": "refused: the texture's source is used if the texture has one",
    "KHR_materials_emissive_strength": "drawn: multiplies the emission",
    "KHR_materials_ior": "drawn: f0 = ((n - 1) / (n + 1))^2 instead of 0.028",
    "KHR_materials_specular": "drawn: the factor is ks, the texture's alpha the specular map; the "
    "mean of the colour multiplies f0. A tint or a colour texture is ignored with a warning",
    "KHR_materials_pbrSpecularGlossiness": "warned: only the diffuse colour is drawn",
    "KHR_materials_unlit": "drawn: the colour is the radiance; `--part '*,unlit=false'` lights it",
    "KHR_materials_clearcoat": "warned: drawn without the coat",
    "KHR_materials_sheen": "warned: drawn without sheen",
    "KHR_materials_transmission": "drawn: the factor is the transmission; a texture is ignored "
    "with a warning",
    "KHR_materials_volume": "drawn: with transmission and a thickness above 0 the surface refracts "
    "with the ior of KHR_materials_ior; the thickness itself and the attenuation are ignored",
    "KHR_materials_dispersion": "ignored: has an effect only with transmission",
    "KHR_materials_diffuse_transmission": "warned: drawn as opaque",
    "KHR_materials_anisotropy": "warned: drawn as isotropic",
    "KHR_materials_iridescence": "warned: drawn without the film",
    "KHR_materials_variants": "ignored: each primitive keeps its own material",
    "KHR_lights_punctual": "warned: use `--light` instead",
    "KHR_animation_pointer": "warned: its channels are ignored in a pose",
    "KHR_xmp_json_ld": "ignored: metadata",
    "MSFT_lod": "ignored: the node itself, the finest level, is drawn",
}
