"""Textures: images that background threads decode and reduce to mip levels. OpenGL is not used."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal, get_args
from weakref import WeakMethod, WeakValueDictionary

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
from facerender.scenes.mips import CHAIN, Kind, Levels, Rows, coarse_base, coarse_chain, coarse_data
from facerender.system.files import open_file
from facerender.system.process import give_back

if TYPE_CHECKING:
    from PIL.Image import Image

Wrap = Literal["repeat", "clamp", "mirror"]

DECODERS = (*("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "DDS"), "AVIF")
MOST_TEXELS = 6 * 8192**2  # texels of all maps of a mesh; two copies with mip levels take 4 GiB
_DISPLAYED = 512  # largest side of a texture that a notebook displays, in pixels
_MOST_KEPT = 1 << 20  # bytes; larger files are not kept in memory but read again for decoding
LARGE = 4096**2  # texels; larger maps omit mip levels that are too fine for the rendered image


class Texture:
    """An image that is decoded once, when it is first needed.

    Parameters
    ----------
    decode : function that returns the Pillow image, in any mode; runs in a thread
    name : name in messages: the file, or the map and its mesh file
    size : width and height, if known
    coarser : implementation of :meth:`coarser` for a texture that is made of other textures. In
        this case, ``decode`` must return an image in mode RGB with row 0 at the bottom, and the
        image is not cached.
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
    _in_srgb: Texture | None = None
    _source: Texture | None = None  # texture whose image this one shares, with another sampling
    _fine: tuple[Texture, int] | None = None  # full texture, and number of omitted finest levels

    def __init__(
        self,
        decode: Callable[[], Image],
        name: str,
        size: tuple[int, int] | None = None,
        coarser: Callable[[int], Texture] | None = None,
        profile: bytes | None = None,
    ) -> None:
        check_type("name of a texture", name, str, "text")
        check_type("decode", decode, Callable, "a function that returns a Pillow image")
        check_type("profile", profile, bytes | None, "the bytes of an ICC profile")
        self.name, self.profile = name, profile
        self._size, self._derived = size, coarser is not None
        self._decode: Callable[[], Image] | None = decode  # None once the image is decoded
        self._lock = threading.Lock()
        self._levels_lock = threading.Lock()
        self._rgb: Image | None = None
        self._levels: dict[Kind, Future[Levels]] = {}
        self._ends: NDArray[np.uint8] | None = None
        self._make_coarser = coarser
        self._coarser: WeakValueDictionary[int, Texture] = WeakValueDictionary()

    def __getstate__(self) -> tuple[str, Image, tuple[Wrap, Wrap], bool, bytes | None]:
        """Pickle the decoded image instead of its source."""
        return self.name, self.rgb(), self.wrap, self.nearest, self.profile

    def __setstate__(self, state: tuple[str, Image, tuple[Wrap, Wrap], bool, bytes | None]) -> None:
        name, image, wrap, nearest, profile = state
        Texture.__init__(self, lambda: _flipped(image), name, image.size)
        self._rgb, self.wrap, self.nearest, self.profile = image, wrap, nearest, profile

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
            return cls(decode, name, opened.size, profile=profile_of(opened))

    @classmethod
    def of(cls, content: bytes, name: str) -> Texture:
        """Return a texture from the bytes of an image file. The bytes are decoded later.

        Raises
        ------
        InputError : the content is not an image, or too large
        """
        opened = _opened(content, name)
        return cls(lambda: _opened(content, name), name, opened.size, profile=profile_of(opened))

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
        return cls(lambda: _image_of(pixels), name)

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
        return cls(lambda: copy, name, profile=profile_of(copy))

    def __repr__(self) -> str:
        size = "" if self._size is None else f", {self._size[0]} x {self._size[1]}"
        return f"<Texture {self.name!r}{size}>"

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture with precomputed mip chains.

        texels : (H, W) or (H, W, 3), row 0 at the bottom
        """
        texture = cls(lambda: _image_of(texels).convert("RGB"), name, texels.shape[1::-1])
        texture._derived = True
        for kind, kind_levels in levels.items():
            texture._levels[kind] = Future()
            texture._levels[kind].set_result(kind_levels)
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
        source = self._source or self
        texture = Texture(source.rgb, self.name, source._size, profile=source.profile)
        texture._source, texture._derived = source, True
        texture.wrap, texture.nearest, texture.coarse = (wrap[0], wrap[1]), nearest, source.coarse
        return texture

    @property
    def sampling(self) -> tuple[tuple[Wrap, Wrap], bool]:
        """Wrap modes and filtering. Only maps with equal sampling can be packed in one texture."""
        return self.wrap, self.nearest

    def rgb(self) -> Image:
        """Return the image in mode RGB, without alpha, with row 0 at the bottom as in OpenGL.

        Raises
        ------
        InputError : the image is damaged, or too large for
            :func:`facerender.images.files.check_pixels`
        """
        with self._lock:
            if self._rgb is not None:
                return self._rgb
            if self._decode is None:  # a mip chain is already computed
                chains = (self._levels.get(kind) for kind in ("normal", "data", "color"))
                texels = next(chain.result()[0] for chain in chains if chain and chain.done())
                return _image_of(np.ascontiguousarray(texels[..., :3]))
            image = self._decode()
            if not self._derived:
                self._rgb = image = _upright_rgb(_loaded(image, self.name), self.name)
                self._decode = None
            return image

    def band(self, index: int) -> Image:
        """Return one channel of the image from :meth:`rgb`, in mode L."""
        if self._source:
            return self._source.band(index)
        if self._fine:  # saves memory: only this channel is reduced
            fine, levels = self._fine
            with fine._rows() as rows:
                band = coarse_data(lambda *span: rows(*span).getchannel(index), fine.size, levels)
            return _image_of(band)
        return self.rgb().getchannel(index)

    def _repr_png_(self) -> bytes:
        """Return the image as PNG of at most 512 pixels a side, which notebooks display."""
        image = _flipped(self.rgb())
        image.thumbnail((_DISPLAYED, _DISPLAYED))
        return png_bytes(np.asarray(image), {})

    @property
    def size(self) -> tuple[int, int]:
        """Width and height. The size of an image file is available before decoding."""
        if self._source:
            return self._source.size
        if self._size is None:
            image, decode = self._rgb, self._decode  # both None if only a mip chain is left
            self._size = (image or (decode() if decode else self.rgb())).size
        return self._size

    @property
    def decoded_size(self) -> tuple[int, int]:
        """Width and height of the decoded image; for a coarse texture, of the full image."""
        full = self._source or (self._fine and self._fine[0])
        return full.decoded_size if full else self.size

    def channel(self, index: int, name: str) -> Texture:
        """Return one channel of this texture as a grey texture with the same sampling."""

        def decode() -> Image:
            return self.band(index).convert("RGB")

        def coarser(levels: int) -> Texture:
            return self.coarser(levels).channel(index, name)

        grey = Texture(decode, name, self.size, coarser)
        return grey.sampled(*self.sampling) if self.sampling != grey.sampling else grey

    def coarser(self, levels: int) -> Texture:
        """Return a texture of the same image without the finest mip levels.

        levels : number of levels to omit

        To save memory, the image is not cached, and large images are decoded one at a time.
        """
        if not levels:
            return self
        if self._fine:
            fine, omitted = self._fine
            return fine.coarser(omitted + levels)
        if (cached := self._coarser.get(levels)) is not None:
            return cached

        def decode() -> Image:
            with self._rows() as rows:
                return _image_of(coarse_data(rows, self.size, levels))

        if self._source:
            texture = self._source.coarser(levels).sampled(*self.sampling)
        elif self._make_coarser:
            texture = self._make_coarser(levels)
        else:
            width, height = (max(side >> levels, 1) for side in self.size)
            texture = Texture(decode, self.name, (width, height))
            texture._fine, texture._derived = (self, levels), True
        texture.coarse = True
        self._coarser[levels] = texture
        return texture

    @contextmanager
    def _rows(self) -> Iterator[Rows]:
        """Yield a function that returns rows of the image. The image is not cached."""
        with _decoding:
            with self._lock:
                decoded, decode = self._rgb, self._decode
            if decoded or decode is None or self._derived:
                upright = decoded or self.rgb()
                yield lambda low, high: upright.crop((0, low, upright.width, high))
                return
            images = [_loaded(decode(), self.name)]

            def rows(low: int, high: int) -> Image:
                (image,) = images
                edges = image.height - high, image.width, image.height - low
                return _upright_rgb(image.crop((0, *edges)), self.name)

            yield rows
            images.clear()
            give_back()

    def forget(self) -> None:
        """Drop the mip chains of a coarse texture. The chains are computed again on demand."""
        if self._source:
            self._source.forget()
        elif self.coarse:
            if "data" in self._levels:
                self.ends()
            with self._levels_lock:
                self._levels.clear()

    def ends(self) -> NDArray[np.uint8]:
        """Return the minimum and maximum of each channel over the image, (2, 3). Waits until
        the mip chain "data" is computed."""
        if self._source:
            return self._source.ends()
        if self._ends is None:
            finest = self.levels("data").result()[0]
            rows = finest.reshape(len(finest), -1)  # NumPy reduces long rows 30 times as fast
            limits = np.stack([rows.min(axis=0), rows.max(axis=0)]).reshape(2, *finest.shape[1:])
            self._ends = np.stack([limits[0].min(axis=0), limits[1].max(axis=0)])
        return self._ends

    def turned_green(self) -> Texture:
        """Return this normal map, whose green points down, converted to green pointing up."""
        if self._source:
            return self._source.turned_green().sampled(*self.sampling)
        return Texture(lambda: with_green_turned(self._unflipped()), self.name, self.size)

    def _unflipped(self) -> Image:
        """Return the image with row 0 at the top."""
        decode = None if self._derived else self._decode
        return decode() if decode else _flipped(self.rgb())

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
            return _srgb_of(_loaded(self._unflipped(), self.name), profile, self.name)

        if self._in_srgb is None:
            if self._source:
                self._in_srgb = self._source.in_srgb().sampled(*self.sampling)
            else:
                self._in_srgb = Texture(decode, self.name, self._size)
        return self._in_srgb

    def levels(self, kind: Kind) -> Future[Levels]:
        """Return the future of a mip chain. A thread computes each chain once.

        - "color": sRGB-encoded uint8 (H, W, 4), averaged in linear light
        - "linear-color": linear float16 (H, W, 4), averaged in linear light, for exact comparisons
        - "normal": uint8 (H, W, 4), averaged as unit vectors. Alpha is the slope deviation within
          a texel (``fr_slope_variance_map``), and 0 in the finest level.
        - "data": uint8 (H, W, 3), averaged as stored, without sRGB decoding
        """
        if self._source:
            return self._source.levels(kind)
        with self._levels_lock:
            if kind not in self._levels:
                with _starting:
                    future = _executor().submit(lambda: self._chain(kind))
                self._levels[kind] = future
                if kind != "linear-color":
                    drop = WeakMethod(self._drop_image)  # weak: futures keep callbacks alive
                    future.add_done_callback(lambda chain: (method := drop()) and method(chain))
            return self._levels[kind]

    def preview(self, side: int, decode: bool = False) -> NDArray[np.uint8] | None:
        """Return a small image (H, W, 3) in 8 bits, with row 0 at the bottom: the finest mip level
        with at most ``side`` texels a side.

        decode : whether to decode the image if no mip chain is computed yet; if not, and by
            default, the result is then None

        Raises
        ------
        InputError : the image is damaged or too large
        """
        if self._source:
            return self._source.preview(side, decode)
        with self._levels_lock:
            computed = [future for future in self._levels.values() if future.done()]
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
        return np.asarray(self.coarser(spare).rgb())

    def _chain(self, kind: Kind) -> Levels:
        try:
            if self._fine and kind != "linear-color":
                fine, levels = self._fine
                with fine._rows() as rows:
                    base = coarse_base(kind, rows, fine.size, levels)
                return coarse_chain(base)
            return CHAIN[kind](self.rgb())
        except MemoryError:
            lacking = "not enough memory for {} of {} x {} texels".format(self.name, *self.size)
            raise InputError(f"{lacking}: make it smaller") from None

    def _drop_image(self, chain: Future[Levels]) -> None:
        """Drop the decoded image, since an 8-bit mip chain also contains the image's texels."""
        if chain.exception() is None:
            with self._lock:
                self._rgb = None


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

    def decode() -> Image:
        from PIL import Image

        bands = [texture and texture.band(0) for texture in (red, green, blue)]
        filled = [band.resize(size) if band else Image.new("L", size, 255) for band in bands]
        return Image.merge("RGB", filled)

    present = [texture for texture in (red, green, blue) if texture]
    names = " + ".join(dict.fromkeys(texture.name for texture in present))
    widths, heights = zip(*(texture.size for texture in present), strict=True)
    size = max(widths), max(heights)

    def coarser(levels: int) -> Texture:
        return pack(*(texture and texture.coarser(levels) for texture in (red, green, blue)))

    packed = known or Texture(decode, names, size, coarser)
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
    """Return an image in mode RGB with inverted green: 255 - green."""
    identity = range(256)
    return image.convert("RGB").point([*identity, *reversed(identity), *identity])


def _flipped(image: Image) -> Image:
    from PIL.Image import Transpose

    return image.transpose(Transpose.FLIP_TOP_BOTTOM)


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


def _upright_rgb(image: Image, name: str) -> Image:
    try:
        if image.mode.startswith("I"):  # 16-bit grey, which Pillow's convert() clips at 255
            image = _image_of((np.clip(np.asarray(image), 0, 65535) // 257).astype(np.uint8))
        return _flipped(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None


@lru_cache(maxsize=1)
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=3, thread_name_prefix="facerender-textures")


_starting = threading.Lock()
_decoding = threading.Lock()  # ensures that one large image is decoded at a time, to limit memory


def _finish() -> None:
    """Finish running tasks before a fork, because threads do not exist in the child process."""
    with _starting:
        if _executor.cache_info().currsize:
            _executor().shutdown()
            _executor.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_finish)
