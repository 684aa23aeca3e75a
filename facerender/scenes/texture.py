"""Maps: images that are decoded, converted and reduced to mip levels in the background. No OpenGL
here."""

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
    check_path,
    check_switch,
    check_type,
    clipped,
    reason,
    shown,
)
from facerender.images.decode import check_pixels, open_image
from facerender.scenes.mips import Kind, Levels, Rows, chain, coarse_base, coarse_chain, coarse_data
from facerender.system.files import open_file
from facerender.system.memory import give_back

if TYPE_CHECKING:
    from PIL.Image import Image

Wrap = Literal["repeat", "clamp", "mirror"]

FORMATS = (*("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "DDS"), "AVIF")
MOST_TEXELS = 6 * 8192**2  # of the maps of a mesh together: 4 GiB with mip levels, twice
_MOST_KEPT = 1 << 20  # bytes of a file; a larger one is read again when it is decoded
LARGE = 4096**2  # texels; a map of more is drawn as coarse as a picture can show it


class Texture:
    """An image that is decoded, once, when it is first needed.

    Parameters
    ----------
    decode : returns the Pillow image, in any mode; runs in a thread
    name : what messages call it: the file, or the map and the mesh file that holds it
    size : width and height, where they are known
    coarser : of a texture that is made of others, what :meth:`coarser` returns; ``decode`` returns
        an image in mode RGB then, with row 0 at the bottom, which is not kept

    Attributes
    ----------
    wrap : what lies beyond the image's edges, in u and in v: "repeat", "clamp" or "mirror"
    nearest : whether the nearest texel counts alone, of the nearest mip level, and none between
    coarse : whether it lacks the finest mip levels of its image
    """

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    coarse: bool = False
    _source: Texture | None = None  # whose image this one samples otherwise
    _fine: tuple[Texture, int] | None = None  # which lacks so many of its finest levels here

    def __init__(
        self,
        decode: Callable[[], Image],
        name: str,
        size: tuple[int, int] | None = None,
        coarser: Callable[[int], Texture] | None = None,
    ) -> None:
        check_type("name of a texture", name, str, "text")
        check_type("decode", decode, Callable, "a function that returns a Pillow image")
        self.name = name
        self._size, self._derived = size, coarser is not None
        self._decode: Callable[[], Image] | None = decode  # until it has been asked
        self._lock = threading.Lock()
        self._levels_lock = threading.Lock()
        self._rgb: Image | None = None
        self._levels: dict[Kind, Future[Levels]] = {}
        self._ends: NDArray[np.uint8] | None = None
        self._make_coarser = coarser
        self._coarser: WeakValueDictionary[int, Texture] = WeakValueDictionary()

    def __getstate__(self) -> tuple[str, Image, tuple[Wrap, Wrap], bool]:
        """Pickles the decoded image, whatever it is decoded from."""
        return self.name, self.rgb(), self.wrap, self.nearest

    def __setstate__(self, state: tuple[str, Image, tuple[Wrap, Wrap], bool]) -> None:
        name, image, wrap, nearest = state
        Texture.__init__(self, lambda: _flipped(image), name, image.size)
        self._rgb, self.wrap, self.nearest = image, wrap, nearest

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Texture:
        """Read an image file; it is decoded later.

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
            return cls(decode, name, _opened(file, name).size)

    @classmethod
    def of(cls, content: bytes, name: str) -> Texture:
        """Take the content of an image file; it is decoded later.

        Raises
        ------
        InputError : it is not an image, or too large
        """
        return cls(lambda: _opened(content, name), name, _opened(content, name).size)

    @classmethod
    def alpha_of(cls, content: bytes, name: str) -> Texture | None:
        """Return the alpha of an image file as a grey texture; None where it has none; errors as of
        :meth:`of`."""
        opened = _opened(content, name)
        if not opened.has_transparency_data:
            return None

        def decode() -> Image:
            return _loaded(_opened(content, name), name).convert("RGBA").getchannel("A")

        return cls(decode, name, opened.size)

    @classmethod
    def from_array(cls, texels: ArrayLike, name: str = "an array") -> Texture:
        """Return a texture of the numbers that an image file would hold: those of an albedo are
        sRGB-encoded, all others linear. They are copied, and brought to 8 bits, as of a file.

        Parameters
        ----------
        texels : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), row 0 on top: uint8, uint16, or floats
            in [0, 1]; alpha is dropped, ``from_array(texels[..., 3])`` is an opacity map of it
        name : what messages call it

        Raises
        ------
        InputError : another shape or kind of numbers, values outside [0, 1], or too many texels
        """
        values = _bytes_of(texels, name)
        check_pixels(name, values.shape[1], values.shape[0], 4, math.inf)

        def decode() -> Image:
            from PIL import Image

            return Image.fromarray(values)

        return cls(decode, name)

    @classmethod
    def from_image(cls, image: Image, name: str = "an image") -> Texture:
        """Return a texture of a copy of a Pillow image of any mode.

        Raises
        ------
        InputError : it is none, or cannot be decoded
        """
        from PIL import Image as images

        check_type("image", image, images.Image, "an image of Pillow")
        check_pixels(name, *image.size, 4, math.inf)
        try:
            copy = image.copy()
        except Exception as error:  # each decoder of Pillow fails in its own way
            raise InputError(f"{name} is damaged ({reason(error)}); replace it") from None
        return cls(lambda: copy, name)

    def __repr__(self) -> str:
        size = "" if self._size is None else f", {self._size[0]} x {self._size[1]}"
        return f"<Texture {self.name!r}{size}>"

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture of texels, (H, W) or (H, W, 3), row 0 at the bottom, whose mip chains
        are there already."""

        def decode() -> Image:
            from PIL import Image

            return Image.fromarray(texels).convert("RGB")

        texture = cls(decode, name, texels.shape[1::-1])
        texture._derived = True
        for kind, own in levels.items():
            texture._levels[kind] = Future()
            texture._levels[kind].set_result(own)
        return texture

    def sampled(self, wrap: tuple[Wrap, Wrap], nearest: bool = False) -> Texture:
        """Return a texture of the same image, decoded once for both, that is sampled otherwise;
        parameters as the attributes.

        Raises
        ------
        InputError : no such words
        """
        known = get_args(Wrap)
        if not (isinstance(wrap, tuple | list) and len(wrap) == 2):
            raise InputError(f"wrap = {shown(wrap)}: give two of {', '.join(known)}, for u and v")
        for each in wrap:
            if not (isinstance(each, str) and each in known):
                raise InputError(f"unknown wrap {shown(each)}; known: {', '.join(known)}")
        check_switch("nearest", nearest)
        source = self._source or self
        texture = Texture(source.rgb, self.name)
        texture._source, texture.wrap, texture.nearest = source, (wrap[0], wrap[1]), nearest
        texture.coarse = source.coarse
        return texture

    @property
    def sampling(self) -> tuple[tuple[Wrap, Wrap], bool]:
        """How it is sampled: what two maps must have in common to be one."""
        return self.wrap, self.nearest

    def rgb(self) -> Image:
        """The image in mode RGB, row 0 at the bottom as OpenGL has it; alpha is dropped.

        Raises
        ------
        InputError : the image is damaged or too large: see
            :func:`facerender.images.decode.check_pixels`
        """
        if self._source:
            return self._source.rgb()
        with self._lock:
            if self._rgb is not None:
                return self._rgb
            if self._decode is None:
                return self._finest()
            image = self._decode()
            if not self._derived:
                self._rgb = image = _upright_rgb(_loaded(image, self.name), self.name)
                self._decode = None
            return image

    def band(self, index: int) -> Image:
        """One channel of :meth:`rgb`, in mode L."""
        if self._source:
            return self._source.band(index)
        if self._fine:
            from PIL import Image

            fine, levels = self._fine
            with fine._rows() as rows:
                band = coarse_data(lambda *ends: rows(*ends).getchannel(index), fine.size, levels)
            return Image.fromarray(band)
        return self.rgb().getchannel(index)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, which a file tells before it is decoded."""
        if self._source:
            return self._source.size
        if self._size is None:
            image, decode = self._rgb, self._decode  # one of both, until a chain alone is left
            self._size = (image or (decode() if decode else self.rgb())).size
        return self._size

    @property
    def decoded_size(self) -> tuple[int, int]:
        """Width and height of the image that is decoded: of a coarse texture, of all of it."""
        known = self._source or (self._fine and self._fine[0])
        return known.decoded_size if known else self.size

    def channel(self, index: int, name: str) -> Texture:
        """One channel of this texture as a grey texture of its own, sampled as this one."""

        def decode() -> Image:
            return self.band(index).convert("RGB")

        def coarser(levels: int) -> Texture:
            return self.coarser(levels).channel(index, name)

        grey = Texture(decode, name, self.size, coarser)
        return grey.sampled(*self.sampling) if self.sampling != grey.sampling else grey

    def coarser(self, levels: int) -> Texture:
        """Return a texture of the same image without so many of its finest mip levels. What it
        decodes is not kept beside them, and large images are decoded one after another."""
        if not levels:
            return self
        if self._fine:
            fine, own = self._fine
            return fine.coarser(own + levels)
        found = self._coarser.get(levels)
        if found is None:
            if self._source:
                found = self._source.coarser(levels).sampled(*self.sampling)
            elif self._make_coarser:
                found = self._make_coarser(levels)
            else:
                width, height = (max(side >> levels, 1) for side in self.size)
                found = Texture(lambda: self._coarse_image(levels), self.name, (width, height))
                found._fine, found._derived = (self, levels), True
            found.coarse = True
            self._coarser[levels] = found
        return found

    def _coarse_image(self, levels: int) -> Image:
        from PIL import Image

        with self._rows() as rows:
            return Image.fromarray(coarse_data(rows, self.size, levels))

    @contextmanager
    def _rows(self) -> Iterator[Rows]:
        """Yield the rows of the image, row 0 at the bottom, of which no copy is kept."""
        with _decoding:
            with self._lock:
                known, decode = self._rgb, self._decode
            if known or decode is None or self._derived:
                upright = known or self.rgb()
                yield lambda low, high: upright.crop((0, low, upright.width, high))
                return
            images = [_loaded(decode(), self.name)]

            def rows(low: int, high: int) -> Image:
                (image,) = images
                ends = image.height - high, image.width, image.height - low
                return _upright_rgb(image.crop((0, *ends)), self.name)

            yield rows
            images.clear()
            give_back()

    def forget(self) -> None:
        """Drop the mip chains of a coarse texture: they can be had again."""
        if self._source:
            self._source.forget()
        elif self.coarse:
            if "data" in self._levels:
                self.ends()
            with self._levels_lock:
                self._levels.clear()

    def ends(self) -> NDArray[np.uint8]:
        """Return the smallest and the largest texel of "data", (2, 3); waits for it."""
        if self._source:
            return self._source.ends()
        if self._ends is None:
            finest = self.levels("data").result()[0]
            self._ends = np.stack([finest.min(axis=(0, 1)), finest.max(axis=(0, 1))])
        return self._ends

    def turned_green(self) -> Texture:
        """This texture, a normal map whose green points down, with green upwards."""
        if self._source:
            return self._source.turned_green().sampled(*self.sampling)

        def decode() -> Image:
            raw = None if self._derived else self._decode
            return with_green_turned(raw() if raw else _flipped(self.rgb()))

        return Texture(decode, self.name, self.size)

    def levels(self, kind: Kind) -> Future[Levels]:
        """Start computing the mip chain in a thread, once, and return its future.

        "color" gives sRGB-encoded uint8 (H, W, 4), averaged in linear light; "linear-color" the
        same decoded, in float16, for comparisons to the last digit; "normal" uint8 (H, W, 4), of a
        normal map, averaged as unit vectors, with the slope deviation of what a texel stands for as
        alpha (``fr_slope_variance_map``), 0 in the finest; "data" uint8 (H, W, 3).
        """
        if self._source:
            return self._source.levels(kind)
        with self._levels_lock:
            if kind not in self._levels:
                with _starting:
                    future = _executor().submit(lambda: self._chain(kind))
                self._levels[kind] = future
                if kind != "linear-color":
                    drop = WeakMethod(self._drop_image)  # a future keeps what it has called
                    future.add_done_callback(lambda chain: (own := drop()) and own(chain))
            return self._levels[kind]

    def _chain(self, kind: Kind) -> Levels:
        try:
            if self._fine and kind != "linear-color":
                fine, levels = self._fine
                with fine._rows() as rows:
                    base = coarse_base(kind, rows, fine.size, levels)
                return coarse_chain(base)
            return chain(kind, self.rgb())
        except MemoryError:
            width, height = self.size
            raise InputError(
                f"no memory for {self.name} of {width} x {height} texels: make it smaller"
            ) from None

    def _drop_image(self, chain: Future[Levels]) -> None:
        """Keep the image once: an 8-bit chain holds it as well."""
        if chain.exception() is None:
            with self._lock:
                self._rgb = None

    def _finest(self) -> Image:
        """The image, of a chain that holds it."""
        from PIL import Image

        chains = (
            self._levels[kind] for kind in ("normal", "data", "color") if kind in self._levels
        )
        texels = next(chain.result()[0] for chain in chains if chain.done())
        return Image.fromarray(np.ascontiguousarray(texels[..., :3]))


_packed: WeakValueDictionary[tuple[Texture | None, ...], Texture] = WeakValueDictionary()


def pack(
    red: Texture | None, green: Texture | None, blue: Texture | None, known: Texture | None = None
) -> Texture:
    """Merge three grey textures into one, at the largest of their sizes; absent ones are white.

    The same three give the same texture while somebody holds it, so that materials which differ in
    a factor alone share one. ``known`` is what they gave when it was kept. They are sampled alike,
    and so is what they give; maps that are not stay apart (:attr:`Material.property_map`).
    """
    if (found := _packed.get((red, green, blue))) is not None:
        return found

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


def _opened(content: bytes | BinaryIO, name: str) -> Image:
    return open_image(content, name, FORMATS, "PNG, JPEG, TIFF or WebP")


def _bytes_of(texels: ArrayLike, name: str) -> NDArray[np.uint8]:
    """Return a copy of texels in 8 bits, (H, W), (H, W, 3) or (H, W, 4)."""
    try:
        values = np.asarray(texels)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} is no array ({reason(error)}): give (H, W, 3)") from None
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,), (4,)) or not values.size:
        raise InputError(
            f"{name} has the shape {values.shape}: give (H, W), (H, W, 3) or (H, W, 4) texels"
        )
    if values.dtype.kind == "f":
        values = values.astype(np.float64)
        if not ((values >= 0.0) & (values <= 1.0)).all():
            low, high = values.min(), values.max()
            raise InputError(
                f"{name} has floats from {low:.4g} to {high:.4g}: bring them to [0, 1], or give "
                "uint8"
            )
        return np.round(values * 255.0).astype(np.uint8)
    if values.dtype == np.uint16:
        return (values // 257).astype(np.uint8)
    if values.dtype == np.bool_:
        return values * np.uint8(255)
    if values.dtype != np.uint8:
        raise InputError(
            f"{name} has numbers of type {values.dtype}: give uint8, uint16, or floats in [0, 1]"
        )
    return values.copy()


def with_green_turned(image: Image) -> Image:
    """Return an image in mode RGB whose green is 255 less what it was."""
    same = range(256)
    return image.convert("RGB").point([*same, *reversed(same), *same])


def _flipped(image: Image) -> Image:
    from PIL.Image import Transpose

    return image.transpose(Transpose.FLIP_TOP_BOTTOM)


def _loaded(image: Image, name: str) -> Image:
    check_pixels(name, *image.size, 4, math.inf)
    try:
        image.load()
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None
    return image


def _upright_rgb(image: Image, name: str) -> Image:
    from PIL import Image as images

    try:
        if image.mode.startswith("I"):  # 16-bit grey, which Pillow's convert would clip at 255
            image = images.fromarray((np.clip(np.asarray(image), 0, 65535) // 257).astype(np.uint8))
        return _flipped(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None


@lru_cache(maxsize=1)
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=3, thread_name_prefix="facerender-textures")


_starting = threading.Lock()
_decoding = threading.Lock()  # of what is too large to have several of


def _finish() -> None:
    """Finish what has been started, before a fork: its threads would not be in the child."""
    with _starting:
        if _executor.cache_info().currsize:
            _executor().shutdown()
            _executor.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_finish)
