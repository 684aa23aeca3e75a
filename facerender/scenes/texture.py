"""Maps as the GPU samples them: images decoded, converted and reduced to mip levels in the
background. No OpenGL here."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakMethod, WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_path, check_type, clipped, reason
from facerender.files import read_file
from facerender.image import check_pixels, linear_to_srgb, open_image, srgb_to_linear, texels
from facerender.terms.slope_variance import MAP_DEVIATION

if TYPE_CHECKING:
    from PIL.Image import Image

Kind = Literal["color", "linear-color", "normal", "data"]
Levels = list[NDArray[Any]]

FORMATS = (
    *("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA", "GIF", "PPM", "JPEG2000", "DDS"),
    "AVIF",
)
MOST_TEXELS = 6 * 8192**2  # of the maps of a mesh together: 4 GiB with mip levels, twice
_STRIP = 32  # rows


class Texture:
    """An image that is decoded, once, when it is first needed.

    Parameters
    ----------
    decode : returns the Pillow image, in any mode; runs in a thread
    name : what messages call it: the file, or the map and the mesh file that holds it
    size : width and height of what ``decode`` makes of other textures, which is not kept then
    """

    def __init__(
        self, decode: Callable[[], Image], name: str, size: tuple[int, int] | None = None
    ) -> None:
        check_type("name of a texture", name, str, "text")
        check_type("decode", decode, Callable, "a function that returns a Pillow image")
        self.name = name
        self._size, self._derived = size, size is not None
        self._decode: Callable[[], Image] | None = decode  # until it has been asked
        self._lock = threading.Lock()
        self._levels_lock = threading.Lock()
        self._rgb: Image | None = None
        self._levels: dict[Kind, Future[Levels]] = {}

    def __getstate__(self) -> tuple[str, Image]:
        """Pickles the decoded image, whatever it is decoded from."""
        return self.name, self.rgb()

    def __setstate__(self, state: tuple[str, Image]) -> None:
        name, image = state
        self.__init__(lambda: image, name)  # type: ignore[misc]
        self._rgb = image

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Texture:
        """Read an image file; it is decoded later.

        Raises
        ------
        InputError : the file is missing or not an image
        """
        check_path("image file", path)
        return cls.of(read_file(path, "an image file"), clipped(Path(path).name))

    @classmethod
    def of(cls, content: bytes, name: str) -> Texture:
        """Take the content of an image file; it is decoded later.

        Raises
        ------
        InputError : it is not an image, or too large
        """
        image = open_image(content, name, FORMATS, "PNG, JPEG, TIFF or WebP")
        return cls(lambda: image, name)

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture of texels, (H, W) or (H, W, 3), row 0 at the bottom, whose mip chains
        are there already."""

        def decode() -> Image:
            from PIL import Image

            return _flipped(Image.fromarray(texels))

        texture = cls(decode, name, texels.shape[1::-1])
        for kind, chain in levels.items():
            texture._levels[kind] = Future()
            texture._levels[kind].set_result(chain)
        return texture

    def rgb(self) -> Image:
        """The image in mode RGB, row 0 at the bottom as OpenGL has it; alpha is dropped.

        Raises
        ------
        InputError : the image is damaged or too large: see :func:`facerender.image.check_pixels`
        """
        with self._lock:
            if self._rgb is not None:
                return self._rgb
            if self._decode is None:
                return self._finest()
            image = _upright_rgb(self._decode(), self.name)
            if not self._derived:
                self._rgb, self._decode = image, None
            return image

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, which a file tells before it is decoded."""
        if self._size is None:
            image, decode = self._rgb, self._decode  # one of both, until a chain alone is left
            self._size = (image or (decode() if decode else self.rgb())).size
        return self._size

    def channel(self, index: int, name: str) -> Texture:
        """One channel of this texture as a grey texture of its own."""
        return Texture(lambda: _flipped(self.rgb().getchannel(index)), name, self.size)

    def levels(self, kind: Kind) -> Future[Levels]:
        """Start computing the mip chain in a thread, once, and return its future.

        "color" gives sRGB-encoded uint8 (H, W, 4), averaged in linear light; "linear-color" the
        same decoded, in float16, for comparisons to the last digit; "normal" uint8 (H, W, 4), of a
        normal map, averaged as unit vectors, with the slope deviation of what a texel stands for as
        alpha (``fr_slope_variance_map``), 0 in the finest; "data" uint8 (H, W, 3).
        """
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
            return _CHAINS[kind](self.rgb())
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
    red: Texture | None,
    green: Texture | None,
    blue: Texture | None,
    known: Texture | None = None,
) -> Texture:
    """Merge three grey textures into one, at the largest of their sizes; absent ones are white.

    The same three give the same texture while somebody holds it, so that materials which differ in
    a factor alone share one. ``known`` is what they gave when it was kept.
    """
    if (found := _packed.get((red, green, blue))) is not None:
        return found

    def decode() -> Image:
        from PIL import Image

        bands = [texture and texture.rgb().getchannel(0) for texture in (red, green, blue)]
        filled = [band.resize(size) if band else Image.new("L", size, 255) for band in bands]
        return _flipped(Image.merge("RGB", filled))

    present = [texture for texture in (red, green, blue) if texture]
    names = " + ".join(dict.fromkeys(texture.name for texture in present))
    widths, heights = zip(*(texture.size for texture in present), strict=True)
    size = max(widths), max(heights)
    packed = known or Texture(decode, names, size)
    _packed[red, green, blue] = packed
    return packed


def _flipped(image: Image) -> Image:
    from PIL.Image import Transpose

    return image.transpose(Transpose.FLIP_TOP_BOTTOM)


def _upright_rgb(image: Image, name: str) -> Image:
    from PIL import Image as images

    check_pixels(name, *image.size, 4, math.inf)
    try:
        image.load()
        if image.mode.startswith("I"):  # 16-bit grey, which Pillow's convert would clip at 255
            image = images.fromarray((np.clip(np.asarray(image), 0, 65535) // 257).astype(np.uint8))
        return _flipped(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise InputError(f"{name} is damaged ({reason(error)}); replace the file") from None


@lru_cache(maxsize=1)
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=3, thread_name_prefix="facerender-textures")


_starting = threading.Lock()


def _finish() -> None:
    """Finish what has been started, before a fork: its threads would not be in the child."""
    with _starting:
        if _executor.cache_info().currsize:
            _executor().shutdown()
            _executor.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_finish)


def _data_levels(image: Image) -> Levels:
    from PIL.Image import Resampling

    levels = [texels(image, "RGB")]
    while max(image.size) > 1:
        half = max(image.width // 2, 1), max(image.height // 2, 1)
        image = image.resize(half, Resampling.BOX)
        levels.append(texels(image, "RGB"))
    return levels


def _even(texels: NDArray[Any]) -> NDArray[Any]:
    """Make both sides even: a side of 1 is doubled, the last texel of another odd one dropped."""
    for axis in (0, 1):
        if texels.shape[axis] == 1:
            texels = np.repeat(texels, 2, axis)
    return texels[: texels.shape[0] // 2 * 2, : texels.shape[1] // 2 * 2]


@lru_cache(maxsize=1)
def _light_tables() -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """sRGB byte to a quarter of linear light, and the sum of four quarters to sRGB byte."""
    quarter = 16383
    decode = np.round(srgb_to_linear(np.arange(256) / 255.0) * quarter).astype(np.uint16)
    encode = np.round(linear_to_srgb(np.arange(65536) / (4 * quarter)) * 255.0).astype(np.uint8)
    return decode, encode


def _halve_srgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    decode, encode = _light_tables()
    height, width, channels = texels.shape
    halved = np.empty((height // 2, width // 2, channels), dtype=np.uint8)
    for top, strip in _strips(texels):
        # Four channels of 16 bits side by side are added as one number, without a carry.
        light = decode[strip].view(np.uint64)[..., 0]
        rows = light[0::2] + light[1::2]
        blocks = rows[:, 0::2] + rows[:, 1::2]
        halved[top // 2 : top // 2 + len(blocks)] = encode[blocks.view(np.uint16)].reshape(
            *blocks.shape, channels
        )
    return halved


def _color_levels(image: Image) -> Levels:
    levels = [texels(image, "RGBA")]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halve_srgb(_even(levels[-1])))
    return levels


def _halve_linear(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = texels.shape
    blocks = texels.reshape(height // 2, 2, width // 2, 2, channels)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _linear_color_levels(image: Image) -> Levels:
    decoded = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    finest = texels(image, "RGBA")
    levels = [decoded.astype(np.float16)[finest]]
    if max(image.size) == 1:
        return levels
    halved = [_halve_linear(decoded[strip]) for _, strip in _strips(_even(finest))]
    means = np.concatenate(halved)
    while True:
        levels.append(means.astype(np.float16))
        if max(means.shape[:2]) == 1:
            return levels
        means = _halve_linear(_even(means))


def _strips(rows: NDArray[Any]) -> list[tuple[int, NDArray[Any]]]:
    """Return some rows at a time, which stay in the cache, and the number of the first."""
    return [(top, rows[top : top + _STRIP]) for top in range(0, len(rows), _STRIP)]


def _halve_planes(planes: NDArray[Any]) -> NDArray[np.float32]:
    """Return means of blocks of 2 x 2, of (C, H, W) with even sides."""
    rows = planes[:, 0::2] + planes[:, 1::2]
    blocks = rows[..., 0::2] + rows[..., 1::2]
    blocks *= np.float32(0.25)
    return np.asarray(blocks)


def _unit_planes(texels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return normals (3, H, W) of unit length."""
    planes = np.moveaxis(texels, -1, 0).astype(np.float32, order="C")
    planes -= np.float32(127.5)  # no byte stands for 0, nor three for a zero vector
    planes *= 1.0 / np.sqrt(planes[0] ** 2 + planes[1] ** 2 + planes[2] ** 2)
    return planes


def _with_deviation(means: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the texels of a level: directions of mean vectors (3, H, W), and their deviation."""
    length = np.sqrt(means[0] ** 2 + means[1] ** 2 + means[2] ** 2).clip(1e-6, 1.0)
    texels = np.empty((*length.shape, 4), dtype=np.uint8)
    scale = np.float32(127.5) / length
    for channel, plane in enumerate(means):
        texels[..., channel] = plane * scale + np.float32(128.0)  # is cut off
    deviation = np.sqrt((1.0 - length) / length)
    texels[..., 3] = np.minimum(deviation * np.float32(255.0 / MAP_DEVIATION), 255.0) + 0.5
    return texels


def _normal_levels(image: Image) -> Levels:
    levels = [texels(image, "RGBA")]
    levels[0][..., 3] = 0
    if max(image.size) == 1:
        return levels
    even = _even(levels[0][..., :3])
    means = np.empty((3, even.shape[0] // 2, even.shape[1] // 2), dtype=np.float32)
    for top, strip in _strips(even):
        means[:, top // 2 : (top + len(strip)) // 2] = _halve_planes(_unit_planes(strip))
    while True:
        strips = _strips(np.moveaxis(means, 0, -1))
        levels.append(
            np.concatenate([_with_deviation(np.moveaxis(each, -1, 0)) for _, each in strips])
        )
        if max(means.shape[1:]) == 1:
            return levels
        means = _halve_planes(np.moveaxis(_even(np.moveaxis(means, 0, -1)), -1, 0))


_CHAINS: dict[Kind, Callable[[Image], Levels]] = {
    "color": _color_levels,
    "linear-color": _linear_color_levels,
    "normal": _normal_levels,
    "data": _data_levels,
}
