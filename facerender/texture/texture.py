"""Textures: an image, of which all channels or one, and all mip levels or coarser ones are read,
and a sampling. Each kind of map has its averaging method for mip chains. Maps are reduced in strips
of rows, which gives the same result as reducing the whole map."""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, get_args
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, clipped, quoted, warn
from facerender.images.files import check_pixels, converted, in_srgb, open_image, png_bytes
from facerender.images.image import linear_to_srgb, srgb_to_linear
from facerender.system.files import open_file
from facerender.system.process import give_back
from facerender.terms.model import MAP_DEVIATION
from facerender.values.fields import PATH
from facerender.values.vectors import Array, Float32, Size

if TYPE_CHECKING:
    from PIL.Image import Image

Wrap = Literal["repeat", "clamp", "mirror"]
Kind = Literal["color", "linear-color", "normal", "data"]
Levels = list[Array]
Strips = Iterable[NDArray[np.uint8]]
Decode = Callable[[], "Image | NDArray[np.uint8]"]

DECODERS = (*("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "DDS"), "AVIF")
MAX_TEXELS = 6 * 8192**2  # texels of all maps of a mesh; two copies with mip levels take 4 GiB
_MAX_KEPT = 1 << 20  # bytes; larger files are not kept in memory but read again for decoding
STRIP = 32  # number of rows that are reduced at once: they fit in the CPU cache
LARGE = 4096**2  # texels; larger maps omit mip levels that are too fine for the rendered image


class _Chains(dict[Kind, Future[Levels]]):
    """Mip chains of textures that differ in sampling."""

    ends: NDArray[np.uint8] | None = None  # see Texture.ends()


class _Image:
    """The image of textures that differ in sampling, channel and number of omitted mip levels."""

    def __init__(self, decode: Decode, name: str, size: Size | None) -> None:
        self.decode, self.name, self.size = decode, name, size
        self.lock = threading.Lock()
        self.texels: NDArray[np.uint8] | None = None
        # Chains, textures, and textures packed of channels of this image
        self.shared: WeakValueDictionary[Any, Any] = WeakValueDictionary()

    def decoded(self) -> Image | NDArray[np.uint8]:
        if (texels := self.texels) is not None:
            return texels
        image = self.decode()
        return image if isinstance(image, np.ndarray) else _loaded(image, self.name)

    def all_texels(self) -> NDArray[np.uint8]:
        """Return the texels (H, W, 3), or (H, W) of a grey array, which are cached."""
        with self.lock:
            image = self.decoded()
            if not isinstance(image, np.ndarray):
                strips = _strips(image, self.name)
                del image  # the strips keep it until the last one
                image = np.concatenate([*strips])
            self.texels, self.size = image, image.shape[1::-1]
            return image


class Texture:
    """An image that is decoded once, when it is first needed.

    Parameters
    ----------
    decode : function that returns a Pillow image of any mode, or texels (H, W, 3) or (H, W) of
        uint8 with row 0 at the bottom; runs in a thread
    name : name in messages: the file, or the map and its mesh file
    size : width and height, if known
    profile : ICC profile of the image, from :func:`profile_of`; :meth:`in_srgb` applies it

    Attributes
    ----------
    wrap : wrap modes in u and v: "repeat", "clamp" or "mirror"
    nearest : whether to sample the nearest texel of the nearest mip level, without interpolation
    coarse : whether the finest mip levels of the image are omitted
    image : value that textures share if they differ only in sampling, channel and levels
    """

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    coarse: bool = False
    _omitted: int = 0  # number of omitted finest levels
    _channel: int | None = None  # the only channel of the image that this texture contains

    def __init__(
        self, decode: Decode, name: str, size: Size | None = None, profile: bytes | None = None
    ) -> None:
        self.name, self.profile = name, profile
        self.image = _Image(decode, name, size)
        self._packed: deque[Texture] = deque(maxlen=2)  # materials keep packed textures, too
        self._chains: _Chains = self.image.shared.setdefault((None, 0), _Chains())

    def __getstate__(self) -> tuple[Any, ...]:
        """Pickle the decoded image instead of its source."""
        return self.name, self.texels(), self.wrap, self.nearest, self.profile

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        name, texels, self.wrap, self.nearest, profile = state
        Texture.__init__(self, lambda: texels, name, texels.shape[1::-1], profile)

    def _with(self, **attributes: Any) -> Texture:
        """Return a texture with other attributes. Textures of equal texels share mip chains."""
        texture = Texture.__new__(Texture)
        vars(texture).update(vars(self) | attributes)
        key = texture._channel, texture._omitted
        texture._chains = texture.image.shared.setdefault(key, _Chains())
        return texture

    def _variant(self, **attributes: Any) -> Texture:
        """Return a texture with other attributes; equal calls return one object, uploaded once."""
        texture = self._with(**attributes)
        key = texture.name, texture._channel, texture._omitted, texture.sampling
        variant: Texture = texture.image.shared.setdefault(key, texture)
        return variant

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Texture:
        """Return the texture of an image file, which is decoded later."""
        name = clipped(Path(PATH.check("image file", path)).name)

        def decode() -> Image:
            with open_file(path, "an image file") as file:
                return _loaded(_opened(file, name), name)

        with open_file(path, "an image file") as file:
            if len(content := file.read(_MAX_KEPT + 1)) <= _MAX_KEPT:
                return cls.of(content, name)
            opened = _opened(file, name)
            return cls(decode, name, opened.size, profile_of(opened))

    @classmethod
    def of(cls, content: bytes, name: str) -> Texture:
        """Return a texture from the bytes of an image file, which are decoded later."""
        opened = _opened(content, name)
        return cls(lambda: _opened(content, name), name, opened.size, profile_of(opened))

    @classmethod
    def alpha_of(cls, content: bytes, name: str) -> Texture | None:
        """Return an image file's alpha channel as a grey texture, or None if it has no alpha."""
        if not _opened(content, name).has_transparency_data:
            return None
        return cls.of(content, name).changed(lambda image: image.convert("RGBA").getchannel("A"))

    @classmethod
    def from_array(cls, texels: ArrayLike, name: str = "an array") -> Texture:
        """Return a texture from an array of texels, which are copied and converted to 8 bits.

        Values are encoded as in files: sRGB in albedo and emissive maps, linear in other maps.

        Parameters
        ----------
        texels : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), row 0 on top: uint8, uint16, or floats
            in [0, 1]. Alpha is dropped; use ``from_array(texels[..., 3])`` as an opacity map.
        name : name in messages
        """
        pixels = _bytes_of(texels, name)
        check_pixels(name, pixels.shape[1], pixels.shape[0], 4, math.inf)
        return cls(lambda: _image_of(pixels), name, pixels.shape[1::-1])

    @classmethod
    def from_image(cls, image: Image, name: str = "an image") -> Texture:
        """Return a texture from a copy of a Pillow image of any mode."""
        copy = _loaded(image, name).copy()
        return cls(lambda: copy, name, copy.size, profile_of(copy))

    def __repr__(self) -> str:
        size = ", {} x {}".format(*self.size) if self.image.size else ""
        return f"<Texture {self.name!r}{size}>"

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture of texels (H, W) or (H, W, 3), row 0 at the bottom, with mip chains."""
        texture = cls(lambda: texels, name, texels.shape[1::-1])
        for mip_kind, chain in levels.items():
            texture._chains[mip_kind] = Future()
            texture._chains[mip_kind].set_result(chain)
        return texture

    def sampled(self, wrap: tuple[Wrap, Wrap], nearest: bool = False) -> Texture:
        """Return a texture with other sampling, see the attributes of :class:`Texture`. It shares
        this texture's decoded image."""
        modes = get_args(Wrap)
        if len(wrap) != 2 or any(mode not in modes for mode in wrap):
            raise InputError(f"wrap = {quoted(wrap)}: give two of {', '.join(modes)}, for u and v")
        return self._variant(wrap=(wrap[0], wrap[1]), nearest=nearest)

    @property
    def sampling(self) -> tuple[tuple[Wrap, Wrap], bool]:
        """Wrap modes and filtering. Only maps with equal sampling can be packed in one texture."""
        return self.wrap, self.nearest

    @property
    def size(self) -> Size:
        """Width and height. The size of an image file is available before decoding."""
        width, height = self.decoded_size
        return max(width >> self._omitted, 1), max(height >> self._omitted, 1)

    @property
    def decoded_size(self) -> Size:
        """Width and height of the decoded image; for a coarse texture, of the full image."""
        return self.image.size or self.image.all_texels().shape[1::-1]

    def texels(self) -> NDArray[np.uint8]:
        """Return the image without alpha, (H, W, 3), or (H, W) for a channel. Row 0 is at the
        bottom, as in OpenGL. The first call decodes the image."""
        if self.coarse:
            # Pillow may round a value to another 8-bit level than the level of data_chain().
            return np.concatenate([_halved(strip, self._omitted) for strip in self._strips()])
        return _band(self.image.all_texels(), self._channel)

    def rgb(self) -> Image:
        """Return the image in mode RGB; see :meth:`texels`."""
        return _image_of(np.ascontiguousarray(as_rgb(self.texels())))

    def _strips(self) -> Strips:
        """Yield strips of the full image of a coarse texture. The image is not cached."""
        with _decoding:
            strips = _strips(self.image.decoded(), self.image.name, self._omitted)
            yield from (_band(strip, self._channel) for strip in strips)
            give_back()

    def _repr_png_(self) -> bytes:
        """Return the image as PNG of at most 512 pixels a side, which notebooks display."""
        image = _image_of(as_rgb(self.texels())[::-1])
        image.thumbnail((512, 512))
        return png_bytes(np.asarray(image), {})

    def renamed(self, name: str) -> Texture:
        """Return this texture with another name."""
        return self._with(name=name)

    def channel(self, index: int, name: str) -> Texture:
        """Return one channel of this texture as a grey texture with the same sampling."""
        channel = index if self._channel is None else self._channel
        return self._variant(name=name, profile=None, _channel=channel)

    def coarser(self, levels: int) -> Texture:
        """Return a texture of the same image without a number of the finest mip levels. To save
        memory, the image is not cached, and large images are decoded one at a time."""
        if not levels:
            return self
        return self._variant(coarse=True, _omitted=self._omitted + levels)

    def changed(self, change: Callable[[Image], Image]) -> Texture:
        """Return a texture with the result of a function of the image in its mode, row 0 on top."""
        image = self.image

        def decode() -> Image:
            original = image.decode()
            with converted(f"{image.name} is damaged", "; replace the file"):
                if isinstance(original, np.ndarray):
                    return change(_image_of(original[::-1]))
                return change(_loaded(original, image.name))

        return self._with(image=_Image(decode, image.name, image.size), profile=None)

    def in_srgb(self) -> Texture:
        """Return this texture in sRGB, converted from its ICC profile if it has one."""
        if (profile := self.profile) is None:
            return self
        if not profile:
            warn(f"{self.name} has an ICC profile that does not fit its channels: ignored")
            self.profile = None
            return self
        image = self.image
        texture = self.changed(lambda original: _srgb_of(original, profile, image.name))
        return self._variant(image=image.shared.setdefault("sRGB", texture.image), profile=None)

    def levels(self, kind: Kind) -> Future[Levels]:
        """Return the future of a mip chain. A thread computes each chain once.

        - "color": sRGB-encoded uint8 (H, W, 4), averaged in linear light
        - "linear-color": linear float16 (H, W, 4), averaged in linear light, for exact comparisons
        - "normal": uint8 (H, W, 4), averaged as unit vectors. Alpha is the slope deviation within
          a texel (``fr_slope_variance_map``), and 0 in the finest level.
        - "data": uint8 (H, W, 3), averaged as stored, without sRGB decoding
        """
        with _starting:
            if kind not in self._chains:
                self._chains[kind] = _executor().submit(self._chain, kind)
            return self._chains[kind]

    def _chain(self, mip_kind: Kind) -> Levels:
        try:
            if mip_kind == "data":
                levels = data_chain(as_rgb(self.texels()))
            else:
                strips = self._strips() if self.coarse else _strips(self.texels(), self.name)
                levels = mip_chain(mip_kind, strips, self.size[1], self._omitted)
        except MemoryError:
            lacking = "not enough memory for {} of {} x {} texels".format(self.name, *self.size)
            raise InputError(f"{lacking}: make it smaller") from None
        if mip_kind != "linear-color" and self._channel is None and not self.coarse:
            finest = levels[0][..., :3]  # replaces the image
            with self.image.lock:
                self.image.decode, self.image.texels = (lambda: finest), None
        return levels

    def forget(self) -> None:
        """Drop the mip chains of a coarse texture. The chains are computed again on demand."""
        if self.coarse:
            if "data" in self._chains:
                self.ends()
            with _starting:
                self._chains.clear()

    def ends(self) -> NDArray[np.uint8]:
        """Return the image's minimum and maximum per channel, (2, 3). Wait for the chain "data"."""
        if self._chains.ends is None:
            finest = self.levels("data").result()[0]
            rows = finest.reshape(len(finest), -1)  # NumPy reduces long rows 30 times as fast
            low, high = (limit.reshape(-1, 3) for limit in (rows.min(axis=0), rows.max(axis=0)))
            self._chains.ends = np.stack([low.min(axis=0), high.max(axis=0)])
        return self._chains.ends

    def preview(self, side: int, decode: bool = False) -> NDArray[np.uint8] | None:
        """Return a small image (H, W, 3) in 8 bits, with row 0 at the bottom: the finest mip level
        with at most ``side`` texels a side. If no mip chain is computed yet, the image is decoded
        if ``decode``, else the result is None."""
        with _starting:
            computed = next((chain for chain in self._chains.values() if chain.done()), None)
        if computed:
            levels = computed.result()
            level = next((mip for mip in levels if max(mip.shape[:2]) <= side), levels[-1])
            if level.dtype != np.uint8:
                level = np.round(linear_to_srgb(level.astype(np.float64)) * 255.0).astype(np.uint8)
            return np.asarray(level[..., :3])
        if not decode:
            return None
        spare = max(math.ceil(math.log2(max(self.size) / side)), 0)
        return as_rgb(self.coarser(spare).texels())


def pack(
    red: Texture | None, green: Texture | None, blue: Texture | None, known: Texture | None = None
) -> Texture:
    """Merge three grey textures into the channels of one texture. Its width and height are the
    largest width and the largest height of the three.

    Missing textures become white. The textures must have equal sampling, see
    :attr:`Material.property_map`; the result also has this sampling. Repeated calls with equal
    arguments return the same texture as long as it is in use, and the last ones also as long as
    their first texture is in use: materials that differ in factors share the texture.

    known : packed texture from the cache, which is returned instead of a new texture
    """
    present = [texture for texture in (red, green, blue) if texture]
    first = present[0]
    # Without the lists of packed textures, which would be reference cycles.
    maps = [t and t._with(_packed=deque(), _channel=t._channel or 0) for t in (red, green, blue)]
    key = first.sampling, *(t and (t.name, t.image, t._channel, t._omitted) for t in maps)
    cached: Texture | None = first.image.shared.get(key)
    if cached is not None:
        return cached

    def decode() -> NDArray[np.uint8]:
        # The maps are decoded before memory for the result is allocated.
        bands = [(index, t.texels()) for index, t in enumerate(maps) if t]
        merged = np.full((*size[::-1], 3), 255, dtype=np.uint8)
        for index, band in bands:
            merged[..., index] = np.asarray(_image_of(np.ascontiguousarray(band)).resize(size))
        return merged

    names = " + ".join(dict.fromkeys(texture.name for texture in present))
    size = max(texture.size[0] for texture in present), max(texture.size[1] for texture in present)
    packed = known or Texture(decode, names, size)
    packed.wrap, packed.nearest = first.sampling
    packed.coarse = any(texture.coarse for texture in present)
    first._packed.append(packed)
    first.image.shared[key] = packed
    return packed


def _image_of(texels: NDArray[np.uint8]) -> Image:
    from PIL import Image

    return Image.fromarray(texels)


def _opened(content: bytes | BinaryIO, name: str) -> Image:
    return open_image(content, name, DECODERS, "PNG, JPEG, TIFF or WebP")


def _bytes_of(texels: ArrayLike, name: str) -> NDArray[np.uint8]:
    """Return a copy of texels as uint8, (H, W), (H, W, 3) or (H, W, 4)."""
    with converted(f"{name} cannot be used", ": give (H, W, 3)"):
        array = np.asarray(texels)
    if array.shape[2:] == (1,):
        array = array[..., 0]
    if array.ndim < 2 or array.shape[2:] not in ((), (3,), (4,)) or not array.size:
        remedy = "give (H, W), (H, W, 3) or (H, W, 4) texels"
        raise InputError(f"{name} has the shape {array.shape}: {remedy}")
    if array.dtype.kind == "f":
        array = array.astype(np.float64)
        if not ((array >= 0.0) & (array <= 1.0)).all():
            ends = f"{array.min():.4g} to {array.max():.4g}"
            raise InputError(f"{name} has floats from {ends}: scale them to [0, 1], or give uint8")
        return np.round(array * 255.0).astype(np.uint8)
    if array.dtype == np.bool_:
        return array * np.uint8(255)
    if array.dtype not in (np.uint8, np.uint16):
        remedy = "give uint8, uint16, or floats in [0, 1]"
        raise InputError(f"{name} has values of type {array.dtype}: {remedy}")
    return (array // (257 if array.dtype == np.uint16 else 1)).astype(np.uint8)


def with_green_turned(image: Image) -> Image:
    """Return a normal map, whose green points down, in mode RGB with green pointing up: 255 -
    green. An image with the entry "heights" in its info is a bump map, converted to normals with
    green up, and does not change."""
    if "heights" in image.info:
        return image
    identity = range(256)
    return image.convert("RGB").point([*identity, *reversed(identity), *identity])


def _loaded(image: Image, name: str) -> Image:
    check_pixels(name, *image.size, 4, math.inf)
    with converted(f"{name} is damaged", "; replace the file"):
        image.load()
    return image


_SPACES = {  # color spaces of ICC profiles, by the mode of a Pillow image
    **dict.fromkeys(("1", "L", "LA"), b"GRAY"),
    **dict.fromkeys(("RGB", "RGBA", "RGBX", "P", "PA"), b"RGB "),
    "CMYK": b"CMYK",
}


def profile_of(image: Image) -> bytes | None:
    """Return the ICC profile of an image; None without a profile, and b"" for a profile that is no
    profile of these channels (ICC.1:2022, section 7.2)."""
    if not (profile := image.info.get("icc_profile")):
        return None
    fits = profile[36:40] == b"acsp" and profile[16:20] == _SPACES.get(image.mode)
    return bytes(profile) if fits else b""


def _srgb_of(image: Image, profile: bytes, name: str) -> Image:
    """Convert an image from an ICC profile to sRGB, unless the profile is sRGB itself: the image
    then keeps its texels, which a conversion would change by a level."""
    from PIL import Image as images

    bands = {b"GRAY": "L", b"CMYK": "CMYK"}.get(profile[16:20], "RGB")
    steps = np.indices((18,) * len(bands), dtype=np.uint8) * np.uint8(15)  # from 0 to 255
    samples = np.moveaxis(steps, 0, -1).reshape(18, -1, len(bands))
    grid = images.fromarray(samples[..., 0] if bands == "L" else samples, bands)
    try:
        with converted(f"{name} has an ICC profile that cannot be used", ": ignored"):
            converted_grid = np.asarray(in_srgb(grid, profile)[0], np.int16)
            equal = np.abs(converted_grid - np.asarray(grid.convert("RGB"))).max() <= 1
            return image if equal else in_srgb(image.convert(bands), profile)[0]
    except InputError as error:
        warn(str(error))
        return image


def _band(texels: NDArray[np.uint8], index: int | None) -> NDArray[np.uint8]:
    return texels if index is None or texels.ndim == 2 else texels[..., index]


def _strips(image: Image | NDArray[np.uint8], name: str, drop: int = 0) -> Strips:
    """Yield strips of a decoded image for its mip level ``drop``, (H, W, 3), or (H, W) of a grey
    array. Row 0 is at the bottom. The conversion in strips avoids a second full copy."""
    height = len(image) if isinstance(image, np.ndarray) else image.height
    end, step = max(height >> drop, 1) << drop, max(STRIP, 2 << drop)
    for low in range(0, end, step):
        high = min(low + step, end, height)
        yield image[low:high] if isinstance(image, np.ndarray) else _rows(image, low, high, name)


def _rows(image: Image, low: int, high: int, name: str) -> NDArray[np.uint8]:
    with converted(f"{name} is damaged", "; replace the file"):
        strip = image.crop((0, image.height - high, image.width, image.height - low))
        if strip.mode.startswith("I"):  # 16-bit grey, which Pillow's convert() clips at 255
            strip = _image_of((np.clip(np.asarray(strip), 0, 65535) // 257).astype(np.uint8))
        return np.asarray(strip if strip.mode == "RGB" else strip.convert("RGB"))[::-1]


@lru_cache(maxsize=1)
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=3, thread_name_prefix="facerender-textures")


_starting = threading.Lock()
_decoding = threading.RLock()  # ensures that one large image is decoded at a time, to limit memory


def _finish() -> None:
    """Finish running tasks before a fork, because threads do not exist in the child process."""
    with _starting:
        if _executor.cache_info().currsize:
            _executor().shutdown()
            _executor.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_finish)


def mip_chain(mip_kind: Kind, strips: Strips, height: int, drop: int) -> Levels:
    """Return the mip levels of an image, down to one texel. See ``Texture.levels`` for the kinds;
    :func:`data_chain` returns the levels of kind "data".

    strips : rows of the image from the bottom; all strips but the last one contain an even number
        of rows of the mip level ``drop``
    height : number of rows of the finest level
    drop : number of finest levels to omit
    """
    decode, halve, encode = _METHODS[mip_kind]
    low = 0
    for texels in strips:
        means = decode(as_rgb(texels))
        for _ in range(drop):
            means = halve(means)
        # The full normal map keeps its bytes: encode() would change the length of the vectors.
        level = _with_alpha(texels, 0) if mip_kind == "normal" and not drop else encode(means)
        half = halve(means)
        if not low:  # arrays of this size leave no holes in the heap, as a list of strips would
            finest = np.empty((height, *level.shape[1:]), level.dtype)
            halves = np.empty((-(-height // 2), *half.shape[1:]), half.dtype)
        finest[low : low + len(level)] = level
        halves[low // 2 : low // 2 + len(half)] = half
        low += len(level)
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        halves = halves[: max(len(levels[-1]) // 2, 1)]  # without the half of a last odd row
        strips = [halves[top : top + STRIP] for top in range(0, len(halves), STRIP)]
        levels.append(np.concatenate([*map(encode, strips)]))
        halves = np.concatenate([*map(halve, strips)])
    return levels


def data_chain(finest: NDArray[np.uint8]) -> Levels:
    """Return the mip levels of kind "data" from the finest level, (H, W, 3)."""
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1], 1))
    return levels


def _halved(texels: NDArray[np.uint8], times: int) -> NDArray[np.uint8]:
    from PIL.Image import Resampling

    image = _image_of(texels)
    for _ in range(times):
        half = max(image.width // 2, 1), max(image.height // 2, 1)
        image = image.resize(half, Resampling.BOX)
    return np.asarray(image)


def as_rgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return texels (H, W, 3) of grey texels (H, W), and other texels as they are."""
    return np.repeat(texels[..., None], 3, axis=2) if texels.ndim == 2 else texels


def _with_alpha(texels: NDArray[np.uint8], alpha: int) -> NDArray[np.uint8]:
    """Return a copy (H, W, 4) of texels with a constant alpha."""
    copy = np.empty((*texels.shape[:2], 4), dtype=np.uint8)
    copy[..., :3], copy[..., 3] = as_rgb(texels), alpha
    return copy


def _even(texels: Array, columns: int = 1) -> Array:
    """Make the numbers of rows and of columns, which lie along an axis, even: double a side of 1;
    any other odd side loses its last texels."""
    for axis in (0, columns):
        if texels.shape[axis] == 1:
            texels = np.repeat(texels, 2, axis)
        elif texels.shape[axis] % 2:
            texels = texels.take(range(texels.shape[axis] - 1), axis)
    return texels


@lru_cache(maxsize=1)
def _light_tables() -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return two tables to average sRGB bytes in linear light. The first maps a byte to a quarter
    of its linear value. The second maps the sum of four quarters to a byte."""
    quarter = 16383
    decode = np.round(srgb_to_linear(np.arange(256) / 255.0) * quarter).astype(np.uint16)
    encode = np.round(linear_to_srgb(np.arange(65536) / (4 * quarter)) * 255.0).astype(np.uint8)
    return decode, encode


def _halve_srgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    decode, encode = _light_tables()
    # Adds four 16-bit channels as one uint64. Each sum fits in 16 bits, so there is no carry.
    light = decode[_even(texels)].view(np.uint64)[..., 0]
    rows = light[0::2] + light[1::2]
    blocks = rows[:, 0::2] + rows[:, 1::2]
    return np.asarray(encode[blocks.view(np.uint16)].reshape(*blocks.shape, 4))


def _linear(texels: NDArray[np.uint8]) -> Float32:
    decode = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return np.asarray(decode[_with_alpha(texels, 255)])


def _halve_linear(texels: Float32) -> Float32:
    even = _even(texels)
    blocks = even.reshape(len(even) // 2, 2, even.shape[1] // 2, 2, 4)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _unit_vectors(texels: NDArray[np.uint8]) -> Float32:
    """Return texels of a normal map as unit vectors (H, 3, W)."""
    vectors = np.moveaxis(texels, -1, 1).astype(np.float32, order="C")
    vectors -= np.float32(127.5)  # no byte becomes 0, so no vector has length 0
    vectors *= 1.0 / _length(vectors)[:, None]
    return vectors


def _length(vectors: Float32) -> Float32:
    return np.asarray(np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2))


def _halve_vectors(means: Float32) -> Float32:
    even = _even(means, columns=2)
    rows = even[0::2] + even[1::2]
    blocks = rows[..., 0::2] + rows[..., 1::2]
    blocks *= np.float32(0.25)
    return np.asarray(blocks)


def _with_deviation(means: Float32) -> NDArray[np.uint8]:
    """Return the texels (H, W, 4) of a normal map's mip level from its mean normals (H, 3, W). RGB
    is the direction of the mean, alpha is the slope deviation."""
    length = _length(means).clip(1e-6, 1.0)
    texels = np.empty((*length.shape, 4), dtype=np.uint8)
    scale = np.float32(127.5) / length
    for axis in range(3):
        texels[..., axis] = means[:, axis] * scale + np.float32(128.0)  # truncated to uint8
    deviation = np.sqrt((1.0 - length) / length)
    texels[..., 3] = np.minimum(deviation * np.float32(255.0 / MAP_DEVIATION), 255.0) + 0.5
    return texels


# Keyed by kind: functions that decode a strip of texels (H, W, 3), halve what was decoded, and
# encode it as texels of a mip level.
_METHODS: dict[Kind, tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]] = {
    "color": (lambda texels: _with_alpha(texels, 255), _halve_srgb, lambda texels: texels),
    "linear-color": (_linear, _halve_linear, lambda light: light.astype(np.float16)),
    "normal": (_unit_vectors, _halve_vectors, _with_deviation),
}
