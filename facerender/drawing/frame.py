"""Results of a renderer: Frame is an image, GBuffer has values per pixel, and metadata state the
scene and the shading as text. No OpenGL."""

from __future__ import annotations

import dataclasses
import math
import os
import zlib
from collections import UserDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import PurePath, PureWindowsPath
from typing import IO, TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import ResolvedScene, resolve
from facerender.errors import InputError, clipped, note, quoted, warn
from facerender.images.animation import arranged, draw_scale_bar
from facerender.images.files import Format, exr_bytes, format_of, pillow_bytes, png_bytes
from facerender.images.image import ImageData, Tone, encode_srgb8, encode_srgb16, neutral
from facerender.material import Material
from facerender.mesh.mesh import Mesh
from facerender.scene.background import clear_color
from facerender.scene.job import Output
from facerender.scene.scene import DATA, Only, Scene
from facerender.scene.shading import Shading
from facerender.scene.view import View, hidden, scale_of
from facerender.system.files import write_bytes
from facerender.texture.texture import Kind, Texture
from facerender.values.vectors import Vector, unit

if TYPE_CHECKING:
    from PIL.Image import Image


_LONGEST = 400  # characters of a value: Exif metadata of a JPEG has at most 64 KiB
_ALWAYS = ("albedo", "m", "f0", "ks", "kd")  # factors that are listed also if they are defaults


class LazyMetadata(UserDict[str, str]):
    """Metadata that are made on first use: most frames of a loop are never saved."""

    def __init__(self, make: Callable[[], dict[str, str]]) -> None:
        self._make = make

    @cached_property
    def data(self) -> dict[str, str]:  # type: ignore[override]
        return self._make()

    def __or__(self, other: Mapping[str, str]) -> dict[str, str]:  # type: ignore[override]
        return {**self.data, **other}

    def __ror__(self, other: Mapping[str, str]) -> dict[str, str]:  # type: ignore[override]
        return {**other, **self.data}

    def __reduce__(self) -> tuple[Any, ...]:
        return LazyMetadata, (partial(dict, self.data),)


def frame_metadata(
    scene: Scene,
    shading: Shading,
    only: Only | None,
    albedo: Kind,
    shaded: ResolvedScene | None,
    settings: dict[str, str],
    size: tuple[int, int],
) -> dict[str, str]:
    """Return a scene and its shading as text, without paths of files. The result keeps no renderer
    alive.

    It has the keys "mesh"; the factors and maps of materials by the names of :class:`Material`,
    such as "m", unless all parts have the default; "camera", "scale", "light 0" and so on,
    "ambient", "background", "environment", "before"; and "textures": "float", or "8-bit" if an
    8-bit map is used. Shaded images also have the fields of :class:`Shading` that differ from the
    defaults, the fields of the specular term, and the lobe of each part if lobes differ from the
    shading's.

    shaded : resolved scene of shaded images
    settings : metadata of the renderer
    """
    look, scene = resolve(scene, shading, albedo).appearance, scene.labelled
    mesh = scene.mesh
    texts = {"mesh": _mesh(mesh)}
    for field in fields(Material):
        values = [getattr(material, field.name) for material in mesh.materials]
        for index, material in enumerate(mesh.materials):  # a roughness map replaces m
            if field.name == "m" and material.roughness_map is not None:
                values[index] = "of the roughness map"
            if field.name == "roughness_factor" and material.roughness_map is None:
                values[index] = field.default
        if field.name in _ALWAYS or any(value != field.default for value in values):
            texts[field.name] = _by_part(mesh, values)
    names = "camera", *(f"light {index}" for index in range(len(scene.lights)))
    texts |= zip(names, map(repr, (scene.camera, *scene.lights)), strict=True)
    texts["scale"] = scale_of(scene, size)
    back = scene.background
    back = PurePath(back.name).name if isinstance(back, ImageData) else back
    texts |= {"ambient": str(scene.ambient), "background": str(back)}
    if scene.environment is not None:
        name = PurePath(scene.environment.panorama.name).name
        rotation, scale = scene.environment.rotation, scene.environment.scale
        texts["environment"] = f"{name}, rotation {rotation}, scale {scale}"
    if scene.before is not None:
        texts["before"] = f"{_mesh(scene.before.mesh)}, {scene.before.camera!r}"
    is_float = all(mip_kind == "linear-color" for part in look.parts for *_, mip_kind in part.maps)
    texts["textures"] = "float" if is_float else "8-bit"
    if shaded and only not in DATA:
        look = shaded.appearance
        texts |= {key: str(value) for key, value in look.shading.as_dict().items()}
        term = look.shading.term
        texts |= {k: str(getattr(term, k)) for k in ("model", "lobe", "fresnel", "masking")}
        terms = look.terms if only != "diffuse" and look.lighting.shining else []
        if any(other != term for other in terms):
            texts["lobe of each part"] = ", ".join(str(other.lobe) for other in terms)
    metadata = {name: _limited(text) for name, text in texts.items()} | settings
    if only == "parts":
        metadata["parts"] = ", ".join(part.name for part in mesh.parts)
    return metadata


def _limited(text: str) -> str:
    """Return a text of one line, which is cut and gets a checksum if it is long."""
    if len(text) <= _LONGEST and text.isprintable():
        return text
    return f"{clipped(text, _LONGEST)} (CRC-32 {zlib.crc32(text.encode(errors='replace')):08x})"


def _mesh(mesh: Mesh) -> str:
    geometry, parts = mesh.geometry, mesh.parts
    vertices = sum(len(part.positions) for part in parts)
    triangles = sum(len(part.faces) for part in parts)
    checksum = zlib.crc32(str([part.checksum for part in parts]).encode())
    size = f"{vertices} vertices, {triangles} triangles, radius {geometry.radius:.6g}"
    unit = "" if geometry.millimetres is None else f", 1 unit = {geometry.millimetres} mm"
    return f"{geometry.name}, {size}{unit}, CRC-32 {checksum:08x}"


def _by_part(mesh: Mesh, values: Iterable[Any]) -> str:
    """Return a value for each part as text, each value once: "0.3" or "0.3 (head); 0.1 (eyes)"."""
    names: dict[str, list[str]] = {}
    for index, (part, value) in enumerate(zip(mesh.geometry.parts, values, strict=True), 1):
        if isinstance(value, Texture):
            # An MTL file of Windows has directories with backslashes.
            text = "{}, {} x {}".format(PureWindowsPath(value.name).name, *value.decoded_size)
        else:
            text = str(float(f"{value:.9g}")) if isinstance(value, float) else str(value)
        names.setdefault(text, []).append(part.name or f"part{index}")
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{text} ({', '.join(part_names)})" for text, part_names in names.items())


IMAGE_FORMATS: tuple[Format, ...] = get_args(Format)
NO_SCALE = (
    "a scale bar needs the size of a pixel: give an orthographic camera (--orthographic, "
    "--mm-per-pixel) and a known unit (--millimetres)"
)
_COVERED, _CLIPPED = 0.99, 0.01  # coverage of pixels that may clip; fraction without a warning


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """A rendered image.

    Attributes
    ----------
    linear : (H, W, 4) float32, row 0 on top: linear RGB, unclamped, and the mesh's coverage. If the
        scene has a background, RGB includes it; otherwise RGB is premultiplied by coverage.
        If ``only`` is set, the background is 0, and the content of RGB depends on the term. Only
        for albedo, it is the scene's background, if that is not the default:

        - specular, diffuse: the radiance of this term
        - albedo: linear colour
        - normal: unit vector in the mesh's space
        - depth: distance from the camera along the viewing direction, in mesh units, in all three
          channels
        - cosines: N.L in red, N.V in green and N.H in blue, for the first light
        - visibility: visible fraction of the first light that casts shadows, in all three channels
        - mask: 1 where the mesh is visible, in all three channels
        - parts: index of the part plus 1, in all three channels
        - motion: displacement, in pixels, of the surface point at the pixel's centre from the frame
          before to this frame: x (right) in red, y (down) in green, 0 in blue. The point may be
          hidden in the frame before. Points behind the camera of the frame before have no motion;
          there coverage is 0
    only : the term that the image shows; None for the whole image
    transparent : whether PNG, TIFF and WebP files get an alpha channel; true if the scene has no
        background
    metadata : all parameters of the image as text: facerender's version, GL_RENDERER, GL_VERSION,
        settings of the renderer, and the values of ``frame_metadata`` in
        ``facerender/drawing/frame.py``
    background : colour or image (H, W, 3) behind the mesh, linear RGB, which exposure and tone
        leave unchanged; None for none, or for radiance, such as the environment
    warned : exposures at which images of this mesh were clipped, with a warning
    mm_per_pixel : width of a pixel in mm; None for perspective images and unknown units
    """

    linear: NDArray[np.float32]
    only: Only | None
    transparent: bool
    metadata: Mapping[str, str]
    background: NDArray[np.float32] | Vector | None = None
    warned: set[float] = dataclasses.field(default_factory=set)
    mm_per_pixel: float | None = None

    def __post_init__(self) -> None:
        if self.linear.ndim != 3:
            raise InputError(f"linear = {quoted(self.linear)}: give an array (H, W, 4)")

    def srgb8(
        self, exposure: float = 0.0, tone: Tone = "linear", scale_bar: bool = False
    ) -> NDArray[np.uint8]:
        """Return an 8-bit image for display: (H, W, 3), or (H, W, 4) with straight alpha if
        ``transparent`` is true.

        Radiance and albedo are encoded as sRGB, normals as 0.5 n + 0.5. Cosines, visibility and
        mask are clamped to [0, 1]. Depth is white at the nearest point and dark at the farthest.
        The colour of a part depends on the part's index. For motion, the hue is the direction, red
        to the right, and the brightness is the length relative to the longest in the image.

        exposure : exposure of radiance and albedo, in stops; default 0
        tone : tone mapping of radiance: "linear" (default) clips it at 1, "neutral" compresses it,
            see :func:`facerender.images.image.neutral`
        scale_bar : whether a scale bar is drawn, as in :meth:`save`
        """
        return self._display(Output("a.png", None, exposure, tone, scale_bar=scale_bar))[0]

    def _display(self, output: Output) -> tuple[NDArray[Any], dict[str, str]]:
        """Return the result of :meth:`srgb8` with 8 or 16 bits, and further metadata: the linear
        values that the pixels stand for, and an exposure and a tone that change them."""
        tone = "linear" if self.only in DATA else output.tone
        exposure, bits = output.exposure, output.bits
        color, coverage = self.linear[..., :3], self.linear[..., 3:]
        metadata = {}
        if self.only in _CONVERSIONS:
            values, text = _CONVERSIONS[self.only](color, coverage)
            metadata["range"] = text.format(white=2**bits - 1, dark=round(0.1 * (2**bits - 1)))
            pixels = _levels(values, bits)
        else:
            if self.transparent:
                color = np.divide(color, np.maximum(coverage, 1e-6), dtype=np.float32)
            if exposure or tone != "linear":
                color = self._exposed(color, coverage, 2.0**exposure, tone)
                metadata["tone"] = tone if tone != "linear" else ""
            pixels = encode_srgb8(color) if bits == 8 else encode_srgb16(color)
            metadata["exposure"] = str(float(exposure)) if exposure else ""
            metadata["range"] = "sRGB of 0 to 1" if self.only else ""
        if self.transparent:
            pixels = np.concatenate([pixels, _levels(coverage, bits)], axis=-1)
        if output.scale_bar:
            if self.mm_per_pixel is None:
                raise InputError(NO_SCALE)
            draw_scale_bar(pixels, self.mm_per_pixel)
        return pixels, {name: text for name, text in metadata.items() if text}

    def _exposed(
        self, color: NDArray[np.float32], coverage: NDArray[np.float32], scale: float, tone: Tone
    ) -> NDArray[np.float32]:
        """Return linear colours for display: exposure and tone do not change the background."""
        weight, behind = np.ones(1, dtype=np.float32), np.zeros(1, dtype=np.float32)
        if self.background is not None:
            behind = (1.0 - coverage) * np.asarray(self.background, dtype=np.float32)
        with np.errstate(over="ignore"):
            front = np.clip((color - behind) * np.float32(scale), 0.0, np.float32(1e30))
        if tone == "neutral":
            if self.background is not None:
                # Straight colours; highlights on clear glass are brighter than its coverage.
                least = np.maximum(coverage, np.float32(1e-6))
                weight = np.clip(front.max(axis=-1, keepdims=True), least, 1.0)
            front = neutral(front / weight) * weight
        return np.asarray(front + behind)

    def warn_of_clipping(self, exposure: float, tone: Tone) -> None:
        """Emit the warning of :meth:`save`; repeated warnings are only noted."""
        if self.only in DATA or tone != "linear":
            return
        # A sample of about 65,000 pixels first: to count all pixels takes as long as the encoding.
        for step in (math.isqrt(self.linear[..., 0].size) // 256 or 1, 1):
            pixels = self.linear[::step, ::step]
            values = pixels[(pixels[..., 3:] > _COVERED).all(axis=-1), :3].max(axis=-1)
            spared, count = int(_CLIPPED * len(values)), np.count_nonzero(values > 2.0**-exposure)
            if count <= spared:
                return
        largest = float(np.partition(values, -1 - spared)[-1 - spared])
        stops = math.floor(-10.0 * math.log2(largest)) / 10.0
        (note if exposure in self.warned else warn)(
            f"{100.0 * count / len(values):.1f} % of the covered pixels are brighter than white: "
            f"give --exposure {stops:g}, or --tone neutral"
        )
        self.warned.add(exposure)

    def save(
        self,
        path: str | os.PathLike[str] | IO[bytes] | Output,
        exposure: float = 0.0,
        format: Format | None = None,
        tone: Tone = "linear",
        bits: int = 8,
        dpi: float | None = None,
        scale_bar: bool = False,
    ) -> None:
        """Write the image as .png, .tif, .jpg or .webp (sRGB), or as .exr (linear float32).

        The file is written atomically: a failure leaves no incomplete file.

        Parameters
        ----------
        path : path of the file, an object with a ``write`` method, such as ``io.BytesIO``, or an
            :class:`Output`, which has the path and all other parameters
        exposure : exposure of the sRGB formats, in stops; default 0
        format : "png", "exr", "jpeg", "webp" or "tiff"; default: the format of the path's suffix,
            or PNG for an object
        tone : tone mapping of the sRGB formats, as in :meth:`srgb8`
        bits : bits per channel: 8 (default), or 16 for PNG
        dpi : pixels per inch that the sRGB formats store, in [1, 10000]; default: the true scale if
            ``mm_per_pixel`` is set, otherwise none
        scale_bar : whether a scale bar is drawn in a lower corner; requires ``mm_per_pixel``

        Raises
        ------
        InputError : the suffix is unknown, the path cannot be written, the Python package for EXR
            is missing, a JPEG would be transparent, or a parameter does not fit the format

        Warns (FacerenderWarning), once for a mesh and an exposure, if more than 1 % of the covered
        pixels are brighter than white in an 8-bit format.
        """
        if format is not None and format not in IMAGE_FORMATS:
            raise InputError(f"format = {quoted(format)}: give {', '.join(IMAGE_FORMATS)}")
        if isinstance(path, Output):
            output, path = path, path.path
        else:
            named = format is None and isinstance(path, str | os.PathLike)
            name: Any = path if named else f"image.{format or 'png'}"
            output = Output(name, None, exposure, tone, bits, dpi, scale_bar)
        content = self.encoded(output)
        if isinstance(path, str | os.PathLike):
            write_bytes(path, content)
        else:
            path.write(content)

    def encoded(
        self,
        format: Format | Output = "png",
        exposure: float = 0.0,
        tone: Tone = "linear",
        bits: int = 8,
        dpi: float | None = None,
        scale_bar: bool = False,
    ) -> bytes:
        """Return the content of an image file. For parameters and errors see :meth:`save`."""
        output = format
        if not isinstance(output, Output):
            output = Output(f"image.{format}", None, exposure, tone, bits, dpi, scale_bar)
        if (written := format_of(output.path)) == "exr":
            channels = {"RGBA"[: self.linear.shape[2]]: self.linear}
            return exr_bytes(output.path, channels, self.metadata)
        pixels, further = self._display(output)
        self.warn_of_clipping(output.exposure, output.tone)
        metadata, dpi = {**self.metadata, **further}, output.dpi
        if dpi is None and self.mm_per_pixel:
            dpi = 25.4 / self.mm_per_pixel
            dpi = dpi if 1.0 <= dpi <= 65535.0 else None  # the range of JPEG
        if written == "png":
            return png_bytes(pixels, metadata, dpi, srgb=self.only not in _CONVERSIONS)
        return pillow_bytes(written, pixels, metadata, dpi)

    @property
    def image(self) -> Image:
        """The result of :meth:`srgb8` as a Pillow image."""
        from PIL import Image

        return Image.fromarray(self.srgb8())

    def _repr_png_(self) -> bytes:
        """Return the image as PNG, which notebooks display."""
        return self.encoded()

    def __repr__(self) -> str:
        height, width = self.linear.shape[:2]
        term = f" of {self.only}" if self.only else ""
        return f"<Frame {width} x {height}{term}{', transparent' * self.transparent}>"


def _levels(values: NDArray[np.float32], bits: int = 8) -> NDArray[Any]:
    """Return values in [0, 1], clamped, as integers of 8 or 16 bits."""
    return np.round(np.clip(values, 0.0, 1.0) * (2.0**bits - 1.0)).astype(f"uint{bits}")


def _part_colors(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a colour (..., 3) for each number (part index plus 1); 0 is black. The hue advances by
    the golden ratio, so that consecutive numbers have very different hues."""
    hue, number = _hue(numbers * np.float32(0.618034)), numbers[..., None]
    return np.asarray((1.0 - 0.2 * (number % 3.0)) * (0.25 + 0.75 * hue) * (number > 0.0))


def _hue(turns: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the pure colour (..., 3) of each hue: red at 0, green at 1/3, blue at 2/3."""
    thirds = np.array([0.0, 2.0 / 3.0, 1.0 / 3.0], dtype=np.float32)
    return np.asarray(np.clip(np.abs(6.0 * ((turns[..., None] + thirds) % 1.0) - 3.0) - 1.0, 0, 1))


def _motion(motion: NDArray[np.float32], coverage: NDArray[np.float32]) -> _Converted:
    x, y = motion[..., 0], motion[..., 1]
    length = np.hypot(x, y)
    longest = length.max()
    level = length / max(float(longest), 1e-30)
    turns = np.asarray(np.arctan2(y, x) / (2.0 * np.pi), dtype=np.float32)
    text = f"brightness {{white}} at {longest:.6g} pixels" if coverage.any() else ""
    return np.asarray(level[..., None] * _hue(turns), dtype=np.float32), text


def _depth(depth: NDArray[np.float32], coverage: NDArray[np.float32]) -> _Converted:
    inside = depth[coverage[..., 0] > 0.0]
    if not inside.size:
        return depth, ""
    near, far = inside.min(), inside.max()
    brightness = 1.0 - 0.9 * (depth - near) / max(float(far - near), 1e-30)
    return brightness * coverage, f"{{white}} at {near:.6g}, {{dark}} at {far:.6g} mesh units"


# Colours in [0, 1] of display images by term, and the linear values that their levels stand for: a
# text with fields for the levels of 1 and 0.1. The arguments are the linear colours (H, W, 3) and
# the coverage (H, W, 1).
_Converted = tuple[NDArray[np.float32], str]
_CONVERSIONS: dict[str | None, Callable[..., _Converted]] = {
    **dict.fromkeys(
        ("cosines", "visibility", "mask"), lambda color, _: (color, "0 at 0, {white} at 1")
    ),
    "normal": lambda color, coverage: ((color * 0.5 + 0.5) * coverage, "0 at -1, {white} at 1"),
    "parts": lambda color, _: (_part_colors(color[..., 0]), "a colour for each part"),
    "motion": _motion,
    "depth": _depth,
}


@dataclass(frozen=True, eq=False, repr=False)
class GBuffer:
    """Geometry and material values at the centre of each pixel; row 0 is on top.

    Attributes
    ----------
    part : (H, W) int, index into ``mesh.parts``, or -1 for the background
    normalised_position : (H, W, 3) float32 in the renderer's space (see ``Mesh.normalised``), 0 on
        the background; :attr:`position` is in the mesh's units
    normal : (H, W, 3) float32, the shading normal with the normal map applied
    albedo : (H, W, 3) float32, linear
    m, specular_weight, occlusion : (H, W) float32
    uv : (H, W, 2) float32
    visibility : (H, W, lights) float32, visible fraction of each light, and then of each light of
        the environment
    view : the camera, in the renderer's space
    space : centre (x, y, z) and radius of the mesh, in its units
    second_m : (H, W) float32, m of the second lobe; None if no material has two lobes
    lobe_weight : (H, W) float32, weight of the first lobe; None if no material has two lobes
    facing : (H, W) float32, cosine between the direction to the camera and the mesh's normal,
        without the normal map; None if no material scatters
    emission : (H, W, 3) float32, emitted radiance; None if no material emits light
    opacity : (H, W) float32, opacity of a blended part, 0 elsewhere; None in the G-buffer of parts
        that are not blended
    transmission : of a blended part, see ``Material.transmission``
    transparent_layers : one G-buffer for each layer of the blended parts; layers behind parts
        that are not blended are left out. The layers at each pixel are in drawing order
    """

    part: NDArray[np.int64]
    normalised_position: NDArray[np.float32]
    normal: NDArray[np.float32]
    albedo: NDArray[np.float32]
    m: NDArray[np.float32]
    specular_weight: NDArray[np.float32]
    occlusion: NDArray[np.float32]
    uv: NDArray[np.float32]
    visibility: NDArray[np.float32]
    view: View
    space: tuple[float, ...]
    second_m: NDArray[np.float32] | None = None
    lobe_weight: NDArray[np.float32] | None = None
    facing: NDArray[np.float32] | None = None
    emission: NDArray[np.float32] | None = None
    opacity: NDArray[np.float32] | None = None
    transmission: float = 0.0
    transparent_layers: tuple[GBuffer, ...] = ()

    @property
    def position(self) -> NDArray[np.float64]:
        """(H, W, 3) float64: positions in the mesh's units, as ``Part.positions``; 0 on the
        background. Each access computes a new array."""
        positions = self.normalised_position * np.float64(self.space[3]) + self.space[:3]
        return np.where(self.part[..., None] >= 0, positions, 0.0)

    @property
    def depth(self) -> NDArray[np.float64]:
        """(H, W): depth along the viewing direction, in mesh units; 0 on the background."""
        depth = (self.normalised_position - self.view.position) @ self.view.forward * self.space[3]
        return np.where(self.part >= 0, depth, 0.0)

    @property
    def coverage(self) -> NDArray[np.float64]:
        """(H, W): 1 on parts that are not blended, elsewhere the combined opacity of blended
        parts, reduced by their transmission; 0 on the background."""
        clear = (self.part < 0).astype(np.float64)
        for layer in self.transparent_layers:
            if layer.opacity is not None:
                clear = clear * (1.0 - (1.0 - layer.transmission) * layer.opacity)
        return np.asarray(1.0 - clear)

    def _repr_png_(self) -> bytes:
        """Return a sheet of parts, normal, albedo, m, occlusion and the visibility of the first
        light as PNG, which notebooks display. Transparent layers are left out."""
        covered, first = self.part[..., None] >= 0, self.visibility[..., :1]
        layers = {
            "part": _levels(_part_colors(self.part + np.float32(1.0))),
            "normal": _levels((self.normal * 0.5 + 0.5) * covered),
            "albedo": encode_srgb8(self.albedo),
        }
        for name, image in {"m": self.m, "occlusion": self.occlusion, "visibility": first}.items():
            if image.size:
                layers[name] = _levels(image.reshape(covered.shape) * covered).repeat(3, axis=-1)
        return png_bytes(arranged([*layers.values()], [*layers], columns=3), {})

    def __repr__(self) -> str:
        height, width = self.part.shape
        covered = 100.0 * float(self.coverage.mean())
        return f"<GBuffer {width} x {height}, {covered:.3g} % covered>"


def in_order(layers: Sequence[GBuffer], numbers: NDArray[np.float32]) -> list[GBuffer]:
    """Return the layers with each pixel's values sorted across layers.

    numbers : (layers, H, W) sort keys, ascending in the result. At each pixel, the layers that do
        not cover this pixel come last
    """
    covered = np.array([layer.part >= 0 for layer in layers])
    order = np.argsort(np.where(covered, numbers, np.inf), axis=0, kind="stable")
    sorted_images = {}
    for name, value in vars(layers[0]).items() if layers else ():
        if isinstance(value, np.ndarray):
            stack = np.array([getattr(layer, name) for layer in layers])
            indices = order.reshape(order.shape + (1,) * (stack.ndim - order.ndim))
            sorted_images[name] = np.take_along_axis(stack, indices, axis=0)
    images = ({name: stack[i] for name, stack in sorted_images.items()} for i in range(len(layers)))
    return [replace(layer, **values) for layer, values in zip(layers, images, strict=True)]


# The planes of each data image; see ``drawing/frame_passes.py``.
PLANES_OF: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("depth", "mask", "parts", "visibility"), ("depth",)),
    "normal": ("normal",),
    "albedo": ("albedo",),
    "cosines": ("position", "normal"),
}


def data_image(
    only: Only, planes: Mapping[str, NDArray[np.float32]], view: View, scene: Scene
) -> NDArray[np.float32]:
    """Return a data image (H, W, 4) float32; see ``Frame.linear``.

    planes : the planes of PLANES_OF; for "visibility" also "fraction", the visible fraction (H, W)
        of the first light that casts shadows, unless it is 1 everywhere
    """
    if only in ("normal", "albedo"):
        image = planes[only]
        # The default background would tint the zeros that programs expect around the mesh.
        if only == "albedo" and scene.background != Scene.background:
            image[image[..., 3] == 0.0, :3] = clear_color(scene.background)
        return image
    if only == "cosines":
        covered = planes["position"][..., 3] > 0.0
        position, normal = (
            planes[name][covered, :3].astype(np.float64) for name in ("position", "normal")
        )
        l = v = view.towards(position)
        for light in scene.lights[:1]:
            l, _ = light.kind.lighting(light, scene.mesh.space, position)
        image = np.zeros((*covered.shape, 4), dtype=np.float32)
        for channel, direction in enumerate((l, v, unit(l + v))):
            image[covered, channel] = (normal * direction).sum(axis=-1)
        image[..., 3] = covered
        return image
    relative, part = planes["depth"][..., 0], planes["depth"][..., 1]
    covered = (part > 0.0).astype(np.float32)
    if only == "mask":
        return np.asarray(covered.repeat(4).reshape(*covered.shape, 4))
    values = part
    if only == "depth":
        # The sum of three float32 has almost the rounding error of one: the largest comes last.
        centre = -float(view.position @ view.forward) * scene.mesh.radius
        values = relative * np.float32(scene.mesh.radius)
        values += np.float32(centre - float(np.float32(centre)))
        values += np.float32(centre)
        values *= covered
    elif only == "visibility":
        values = planes.get("fraction", np.float32(1.0)) * covered
    image = values.repeat(4).reshape(*covered.shape, 4)
    image[..., 3] = covered
    return image


def check_images(images: Mapping[str, NDArray[np.float32]], scene: Scene, threshold: float) -> None:
    """Raise InputError if a pixel is not finite, and warn if no pixel shows the mesh.

    images : images by output, which are linear RGB with coverage
    threshold : smallest opacity of blended parts in data images
    """
    for name, linear in images.items():
        if name in ("mask", "parts"):
            continue
        # The sum of squares is several times as fast as isfinite on every value. It can overflow.
        total = float(np.vdot(linear, linear))
        if not math.isfinite(total) and not (finite := np.isfinite(linear).all(axis=-1)).all():
            row, column = np.unravel_index(int(finite.argmin()), finite.shape)
            raise InputError(
                f"{(~finite).sum()} pixels of {scene.mesh.name} are not finite, the first at "
                f"({column}, {row}): a light stands on the surface, a triangle has no width, or "
                "lights and weights are too strong for float32; move the light, repair the mesh, "
                "or lower the lights or weights"
            )
    for name, linear in images.items():
        coverage = linear[..., 3]
        if not coverage[len(coverage) // 2].any() and not coverage.any():
            cut = threshold if name in DATA else None
            warn(f"no pixel shows {scene.mesh.name}: {hidden(scene, linear.shape[1::-1], cut)}")
            return
