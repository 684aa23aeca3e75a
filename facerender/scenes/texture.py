"""Textures: images that background threads decode and reduce to mip levels. OpenGL is not used.

A :class:`Texture` is a function that decodes an image, a sampling, and mip chains. Its texels are
arrays; channels, packed maps and reduced maps are functions of these arrays."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, get_args
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import (
    InputError,
    check_known,
    check_path,
    check_switch,
    check_type,
    clipped,
    reason,
    shown,
    warn,
)
from facerender.images.files import check_pixels, in_srgb, open_image, png_bytes
from facerender.images.image import linear_to_srgb
from facerender.scenes.mips import (
    CHAIN,
    Kind,
    Levels,
    Rows,
    coarse_base,
    coarse_chain,
    coarse_data,
    in_three,
)
from facerender.system.files import open_file
from facerender.system.process import give_back

if TYPE_CHECKING:
    from PIL.Image import Image

Wrap = Literal["repeat", "clamp", "mirror"]
Decode = Callable[[], "Image | NDArray[np.uint8]"]

DECODERS = (*("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "DDS"), "AVIF")
MOST_TEXELS = 6 * 8192**2  # texels of all maps of a mesh; two copies with mip levels take 4 GiB
_DISPLAYED = 512  # largest side of a texture that a notebook displays, in pixels
_MOST_KEPT = 1 << 20  # bytes; larger files are not kept in memory but read again for decoding
_STRIP = 256  # number of rows that are converted at once
_FLOAT: Kind = "linear-color"  # its mip chain does not contain the 8-bit texels
LARGE = 4096**2  # texels; larger maps omit mip levels that are too fine for the rendered image


class _Decoded:
    """What textures of one image with different sampling share: decoder, texels, mip chains."""

    def __init__(self, decode: Decode) -> None:
        self.decode = decode  # after a mip chain is computed, a function that returns its texels
        self.lock = threading.Lock()
        self.texels: NDArray[np.uint8] | None = None
        self.chains: dict[Kind, Future[Levels]] = {}
        self.ends: NDArray[np.uint8] | None = None
        self.variants: WeakValueDictionary[Any, Texture] = WeakValueDictionary()


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
    """

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    coarse: bool = False
    _full: tuple[Texture, int] | None = None  # full texture, and number of omitted finest levels
    _channel: tuple[Texture, int] | None = None  # texture whose channel this is, and its index

    def __init__(
        self,
        decode: Decode,
        name: str,
        size: tuple[int, int] | None = None,
        profile: bytes | None = None,
    ) -> None:
        check_type("name of a texture", name, str, "text")
        check_type("decode", decode, Callable, "a function that returns a Pillow image")
        check_type("profile", profile, bytes | None, "the bytes of an ICC profile")
        self.name, self.profile, self._size = name, profile, size
        self._decoded = _Decoded(decode)

    def __getstate__(self) -> tuple[Any, ...]:
        """Pickle the decoded image instead of its source."""
        return self.name, self.texels(), self.wrap, self.nearest, self.profile

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.name, texels, self.wrap, self.nearest, self.profile = state
        self._size = texels.shape[1::-1]
        self._decoded = _Decoded(lambda: texels)

    def _with(self, decoded: _Decoded, **attributes: Any) -> Texture:
        """Return a texture with the same name and sampling."""
        texture = Texture.__new__(Texture)
        vars(texture).update(vars(self), _decoded=decoded, **attributes)
        return texture

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Texture:
        """Return the texture of an image file. The file is decoded later.

        Raises
        ------
        InputError : the file is missing or not an image
        """
        check_path("image file", path)
        name = clipped(Path(path).name)

        def decode() -> Image:
            with open_file(path, "an image file") as file:
                return _loaded(_opened(file, name), name)

        with open_file(path, "an image file") as file:
            if file.seek(0, os.SEEK_END) <= _MOST_KEPT:
                file.seek(0)
                return cls.of(file.read(), name)
            opened = _opened(file, name)
            return cls(decode, name, opened.size, profile_of(opened))

    @classmethod
    def of(cls, content: bytes, name: str) -> Texture:
        """Return a texture from the bytes of an image file. The bytes are decoded later.

        Raises
        ------
        InputError : the content is not an image, or too large
        """
        opened = _opened(content, name)
        return cls(lambda: _opened(content, name), name, opened.size, profile_of(opened))

    @classmethod
    def alpha_of(cls, content: bytes, name: str) -> Texture | None:
        """Return an image file's alpha channel as a grey texture, or None if it has no alpha.
        Raises the errors of :meth:`of`."""
        opened = _opened(content, name)
        if not opened.has_transparency_data:
            return None

        def decode() -> Image:
            return _loaded(_opened(content, name), name).convert("RGBA").getchannel("A")

        return cls(decode, name, opened.size)

    @classmethod
    def from_array(cls, texels: ArrayLike, name: str = "an array") -> Texture:
        """Return a texture from an array of texels, which are copied and converted to 8 bits.

        The values are encoded as in an image file: sRGB for an albedo or emissive map, linear for
        all other maps.

        Parameters
        ----------
        texels : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), row 0 on top: uint8, uint16, or floats
            in [0, 1]. Alpha is dropped; use ``from_array(texels[..., 3])`` as an opacity map.
        name : name in messages

        Raises
        ------
        InputError : invalid shape or type, values outside [0, 1], or too many texels
        """
        pixels = _bytes_of(texels, name)
        check_pixels(name, pixels.shape[1], pixels.shape[0], 4, math.inf)
        return cls(lambda: _image_of(pixels), name, pixels.shape[1::-1])

    @classmethod
    def from_image(cls, image: Image, name: str = "an image") -> Texture:
        """Return a texture from a copy of a Pillow image of any mode.

        Raises
        ------
        InputError : not a Pillow image, or one that cannot be decoded
        """
        from PIL import Image as images

        check_type("image", image, images.Image, "a Pillow image")
        check_pixels(name, *image.size, 4, math.inf)
        try:
            copy = image.copy()
        except Exception as error:  # Pillow's decoders raise many types
            raise InputError(f"{name} is damaged ({reason(error)}); replace it") from None
        return cls(lambda: copy, name, copy.size, profile_of(copy))

    def __repr__(self) -> str:
        size = "" if self._size is None else f", {self._size[0]} x {self._size[1]}"
        return f"<Texture {self.name!r}{size}>"

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture with precomputed mip chains.

        texels : (H, W) or (H, W, 3), row 0 at the bottom
        """
        texture = cls(lambda: texels, name, texels.shape[1::-1])
        for kind, chain in levels.items():
            texture._decoded.chains[kind] = Future()
            texture._decoded.chains[kind].set_result(chain)
        return texture

    def sampled(self, wrap: tuple[Wrap, Wrap], nearest: bool = False) -> Texture:
        """Return a texture with other sampling, which shares this texture's decoded image.

        wrap, nearest : see the attributes of :class:`Texture`

        Raises
        ------
        InputError : unknown wrap mode
        """
        modes = get_args(Wrap)
        if not (isinstance(wrap, tuple | list) and len(wrap) == 2):
            raise InputError(f"wrap = {shown(wrap)}: give two of {', '.join(modes)}, for u and v")
        for mode in wrap:
            check_known("wrap", mode, modes)
        check_switch("nearest", nearest)
        return self._with(self._decoded, wrap=(wrap[0], wrap[1]), nearest=nearest)

    @property
    def sampling(self) -> tuple[tuple[Wrap, Wrap], bool]:
        """Wrap modes and filtering. Only maps with equal sampling can be packed in one texture."""
        return self.wrap, self.nearest

    @property
    def size(self) -> tuple[int, int]:
        """Width and height. The size of an image file is available before decoding."""
        if self._size is None:
            height, width = self.texels().shape[:2]
            self._size = width, height
        return self._size

    @property
    def decoded_size(self) -> tuple[int, int]:
        """Width and height of the decoded image; for a coarse texture, of the full image."""
        return self._full[0].size if self._full else self.size

    # --- texels ----------------------------------------------------------------------------------

    def texels(self) -> NDArray[np.uint8]:
        """Return the image without alpha, (H, W, 3), or (H, W) for a channel. Row 0 is at the
        bottom, as in OpenGL.

        Raises
        ------
        InputError : the image is damaged, or too large for
            :func:`facerender.images.files.check_pixels`
        """
        decoded = self._decoded
        if self._full:  # not cached, to save memory
            return _upright(decoded.decode(), self.name)
        with decoded.lock:
            if decoded.texels is None:
                decoded.texels = _upright(decoded.decode(), self.name)
            return decoded.texels

    def rgb(self) -> Image:
        """Return the image in mode RGB; see :meth:`texels`."""
        return _image_of(np.ascontiguousarray(in_three(self.texels())))

    def _original(self) -> Image:
        """Return the image in its own mode, with row 0 on top."""
        image = self._decoded.decode()
        return _image_of(image[::-1]) if isinstance(image, np.ndarray) else image

    @contextmanager
    def _rows(self) -> Iterator[Rows]:
        """Yield a function that returns rows of the image. The image is not cached."""
        if self._channel:
            texture, index = self._channel
            with texture._rows() as rows:
                yield lambda low, high: _band(rows(low, high), index)
            return
        with _decoding:
            decoded = self._decoded
            with decoded.lock:
                texels, decode = decoded.texels, decoded.decode
            images = [decode() if texels is None else texels]
            if not isinstance(images[0], np.ndarray):
                images[0] = _loaded(images[0], self.name)
            yield lambda low, high: _strip(images[0], low, high, self.name)
            images.clear()
            give_back()

    def _repr_png_(self) -> bytes:
        """Return the image as PNG of at most 512 pixels a side, which notebooks display."""
        image = _image_of(in_three(self.texels())[::-1])
        image.thumbnail((_DISPLAYED, _DISPLAYED))
        return png_bytes(np.asarray(image), {})

    # --- textures made of this one ---------------------------------------------------------------

    def channel(self, index: int, name: str) -> Texture:
        """Return one channel of this texture as a grey texture with the same sampling."""
        if self._full:  # only this channel is reduced, to save memory
            return self._full[0].channel(index, name).coarser(self._full[1])
        decoded = _Decoded(lambda: _band(self.texels(), index))
        return self._with(decoded, name=name, profile=None, _channel=(self, index))

    def coarser(self, levels: int) -> Texture:
        """Return a texture of the same image without the finest mip levels.

        levels : number of levels to omit

        To save memory, the image is not cached, and large images are decoded one at a time.
        """
        if not levels:
            return self
        if self._full:
            return self._full[0].coarser(self._full[1] + levels)
        size = tuple(max(side >> levels, 1) for side in self.size)

        def decode() -> NDArray[np.uint8]:
            with self._rows() as rows:
                return coarse_data(rows, self.size, levels)

        return self._variant(levels, decode, _full=(self, levels), coarse=True, _size=size)

    def _variant(self, name: Any, decode: Decode, **attributes: Any) -> Texture:
        """Return the variant with a name and this sampling, or make it. A renderer uploads each
        texture once, so equal calls must return one object while it is in use."""
        variants, key = self._decoded.variants, (name, self.sampling)
        if (texture := variants.get(key)) is None:
            texture = variants[key] = self._with(_Decoded(decode), **attributes)
        return texture

    def turned_green(self) -> Texture:
        """Return this normal map, whose green points down, converted to green pointing up."""
        return self._with(_Decoded(lambda: with_green_turned(self._original())))

    def in_srgb(self) -> Texture:
        """Return this texture converted from its ICC profile to sRGB, or itself without a profile.
        Data maps do not use it: their values are no colours."""
        if (profile := self.profile) is None:
            return self
        if not profile:
            warn(f"{self.name} has an ICC profile that does not fit its channels: ignored")
            self.profile = None
            return self

        def decode() -> Image:
            return _srgb_of(_loaded(self._original(), self.name), profile, self.name)

        return self._variant("sRGB", decode, profile=None)

    # --- mip levels ------------------------------------------------------------------------------

    def levels(self, kind: Kind) -> Future[Levels]:
        """Return the future of a mip chain. A thread computes each chain once.

        - "color": sRGB-encoded uint8 (H, W, 4), averaged in linear light
        - "linear-color": linear float16 (H, W, 4), averaged in linear light, for exact comparisons
        - "normal": uint8 (H, W, 4), averaged as unit vectors. Alpha is the slope deviation within
          a texel (``fr_slope_variance_map``), and 0 in the finest level.
        - "data": uint8 (H, W, 3), averaged as stored, without sRGB decoding
        """
        chains = self._decoded.chains
        with _starting:
            if kind not in chains:
                chains[kind] = _executor().submit(self._chain, kind)
            return chains[kind]

    def _chain(self, kind: Kind) -> Levels:
        try:
            if self._full and kind != "linear-color":
                full, omitted = self._full
                with full._rows() as rows:
                    base = coarse_base(kind, rows, full.size, omitted)
                return coarse_chain(base)
            levels = CHAIN[kind](in_three(self.texels()))
        except MemoryError:
            lacking = "not enough memory for {} of {} x {} texels".format(self.name, *self.size)
            raise InputError(f"{lacking}: make it smaller") from None
        if kind != _FLOAT:  # the chain also contains the texels of the image
            with self._decoded.lock:
                self._decoded.texels = None
                if not self.coarse:  # forget() drops the chains of coarse textures
                    self._decoded.decode = lambda: levels[0][..., :3]
        return levels

    def forget(self) -> None:
        """Drop the mip chains of a coarse texture. The chains are computed again on demand."""
        if self.coarse:
            if "data" in self._decoded.chains:
                self.ends()
            with _starting:
                self._decoded.chains.clear()

    def ends(self) -> NDArray[np.uint8]:
        """Return the minimum and maximum of each channel over the image, (2, 3). Waits until
        the mip chain "data" is computed."""
        if self._decoded.ends is None:
            finest = self.levels("data").result()[0]
            rows = finest.reshape(len(finest), -1)  # NumPy reduces long rows 30 times as fast
            limits = np.stack([rows.min(axis=0), rows.max(axis=0)]).reshape(2, *finest.shape[1:])
            self._decoded.ends = np.stack([limits[0].min(axis=0), limits[1].max(axis=0)])
        return self._decoded.ends

    def preview(self, side: int, decode: bool = False) -> NDArray[np.uint8] | None:
        """Return a small image (H, W, 3) in 8 bits, with row 0 at the bottom: the finest mip level
        with at most ``side`` texels a side.

        decode : whether to decode the image if no mip chain is computed yet; if not, and by
            default, the result is then None

        Raises
        ------
        InputError : the image is damaged or too large
        """
        with _starting:
            computed = [chain for chain in self._decoded.chains.values() if chain.done()]
        if computed:
            levels = computed[0].result()
            small = (mip for mip in levels if max(mip.shape[:2]) <= side)
            level = next(small, levels[-1])
            if level.dtype != np.uint8:
                level = np.round(linear_to_srgb(level.astype(np.float64)) * 255.0).astype(np.uint8)
            return np.asarray(level[..., :3])
        if not decode:
            return None
        spare = max(math.ceil(math.log2(max(self.size) / side)), 0)
        return in_three(self.coarser(spare).texels())


_packed: WeakValueDictionary[tuple[Texture | None, ...], Texture] = WeakValueDictionary()


def pack(
    red: Texture | None, green: Texture | None, blue: Texture | None, known: Texture | None = None
) -> Texture:
    """Merge three grey textures into the channels of one texture. Its width and height are the
    largest width and the largest height of the three.

    Missing textures become white. The textures must have equal sampling, see
    :attr:`Material.property_map`; the result also has this sampling. Repeated calls with equal
    arguments return the same texture as long as it is in use, so that materials which differ only
    in factors share the texture.

    known : packed texture from the cache, which is returned instead of a new texture
    """
    if (cached := _packed.get((red, green, blue))) is not None:
        return cached

    def decode() -> NDArray[np.uint8]:
        bands = [None if t is None else t.channel(0, names).texels() for t in (red, green, blue)]
        merged = np.full((*size[::-1], 3), 255, dtype=np.uint8)
        for index, band in enumerate(bands):
            if band is not None and band.shape == merged.shape[:2]:
                merged[..., index] = band
            elif band is not None:
                merged[..., index] = _image_of(np.ascontiguousarray(band)).resize(size)
        return merged

    present = [texture for texture in (red, green, blue) if texture]
    names = " + ".join(dict.fromkeys(texture.name for texture in present))
    widths, heights = zip(*(texture.size for texture in present), strict=True)
    size = max(widths), max(heights)
    packed = known or Texture(decode, names, size)
    packed.wrap, packed.nearest = present[0].sampling
    packed.coarse = any(texture.coarse for texture in present)
    _packed[red, green, blue] = packed
    return packed


def _image_of(texels: NDArray[np.uint8]) -> Image:
    from PIL import Image

    return Image.fromarray(texels)


def _opened(content: bytes | BinaryIO, name: str) -> Image:
    return open_image(content, name, DECODERS, "PNG, JPEG, TIFF or WebP")


def _bytes_of(texels: ArrayLike, name: str) -> NDArray[np.uint8]:
    """Return a copy of texels as uint8, (H, W), (H, W, 3) or (H, W, 4)."""
    try:
        array = np.asarray(texels)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} cannot be used ({reason(error)}): give (H, W, 3)") from None
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,), (4,)) or not array.size:
        remedy = "give (H, W), (H, W, 3) or (H, W, 4) texels"
        raise InputError(f"{name} has the shape {array.shape}: {remedy}")
    if array.dtype.kind == "f":
        array = array.astype(np.float64)
        if not ((array >= 0.0) & (array <= 1.0)).all():
            ends = f"{array.min():.4g} to {array.max():.4g}"
            raise InputError(f"{name} has floats from {ends}: scale them to [0, 1], or give uint8")
        return np.round(array * 255.0).astype(np.uint8)
    if array.dtype == np.uint16:
        return (array // 257).astype(np.uint8)
    if array.dtype == np.bool_:
        return array * np.uint8(255)
    if array.dtype != np.uint8:
        remedy = "give uint8, uint16, or floats in [0, 1]"
        raise InputError(f"{name} has values of type {array.dtype}: {remedy}")
    return array.copy()


def with_green_turned(image: Image) -> Image:
    """Return an image in mode RGB with inverted green: 255 - green. An image with the entry
    "heights" in its info is a bump map, converted to normals with green up, and does not change."""
    if "heights" in image.info:
        return image
    identity = range(256)
    return image.convert("RGB").point([*identity, *reversed(identity), *identity])


def _loaded(image: Image, name: str) -> Image:
    check_pixels(name, *image.size, 4, math.inf)
    try:
        image.load()
    except Exception as error:  # Pillow's decoders raise many types
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None
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
    colors = image.convert(bands)
    ramp = np.arange(0, 256, 15, dtype=np.uint8)
    axes = np.meshgrid(*[ramp] * len(bands))
    samples = np.stack(axes, axis=-1).reshape(len(ramp), -1, len(bands))
    grid = images.fromarray(samples[..., 0] if bands == "L" else samples, bands)
    try:
        changes = np.asarray(in_srgb(grid, profile)[0], np.int16) - np.asarray(grid.convert("RGB"))
        return image if np.abs(changes).max() <= 1 else in_srgb(colors, profile)[0]
    except Exception as error:  # LittleCMS raises several types
        warn(f"{name} has an ICC profile that cannot be used ({reason(error)}): ignored")
        return image


def _band(texels: NDArray[np.uint8], index: int) -> NDArray[np.uint8]:
    return texels if texels.ndim == 2 else texels[..., index]


def _upright(image: Image | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Return the texels of a decoded image, converted in strips to avoid a second full copy."""
    if isinstance(image, np.ndarray):
        return image
    image = _loaded(image, name)
    texels = np.empty((image.height, image.width, 3), dtype=np.uint8)
    for low in range(0, image.height, _STRIP):
        texels[low : low + _STRIP] = _strip(image, low, min(low + _STRIP, image.height), name)
    return texels


def _strip(image: Image | NDArray[np.uint8], low: int, high: int, name: str) -> NDArray[np.uint8]:
    """Return rows [low, high) of a decoded image; row 0 is at the bottom."""
    if isinstance(image, np.ndarray):
        return image[low:high]
    try:
        strip = image.crop((0, image.height - high, image.width, image.height - low))
        if strip.mode.startswith("I"):  # 16-bit grey, which Pillow's convert() clips at 255
            strip = _image_of((np.clip(np.asarray(strip), 0, 65535) // 257).astype(np.uint8))
        return np.asarray(strip if strip.mode == "RGB" else strip.convert("RGB"))[::-1]
    except Exception as error:
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None


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
