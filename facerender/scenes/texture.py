"""Maps as the GPU samples them: images decoded, converted and reduced to mip levels in the
background. No OpenGL here."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakMethod, WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_path, check_type, reason
from facerender.image import linear_to_srgb, srgb_to_linear
from facerender.terms.slope_variance import MAP_DEVIATION

if TYPE_CHECKING:
    from PIL.Image import Image

Kind = Literal["color", "linear-color", "normal", "data"]
Levels = list[NDArray[Any]]

MAX_SIZE = 16384
_STRIP = 32  # rows


class Texture:
    """An image that is decoded, once, when it is first needed.

    Parameters
    ----------
    decode : returns the Pillow image, in any mode; runs in a thread
    name : what messages call it: the file, or the map and the mesh file that holds it
    """

    def __init__(self, decode: Callable[[], Image], name: str) -> None:
        check_type("name of a texture", name, str, "text")
        check_type("decode", decode, Callable, "a function that returns a Pillow image")
        self.name = name
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
        from PIL import Image, UnidentifiedImageError

        check_path("image file", path)
        try:
            image = Image.open(BytesIO(Path(path).read_bytes()))
        except UnidentifiedImageError:
            raise InputError(f"{path} is not an image; give a PNG, JPEG, TIFF or WebP") from None
        except Image.DecompressionBombError as error:
            raise InputError(f"{path} is too large an image: {error}") from None
        except OSError as error:
            raise InputError(f"cannot read {path}: {reason(error)}") from None
        return cls(lambda: image, Path(path).name)

    @classmethod
    def known(cls, texels: NDArray[np.uint8], name: str, levels: Mapping[Kind, Levels]) -> Texture:
        """Return a texture of texels, (H, W) or (H, W, 3), row 0 at the bottom, whose mip chains
        are there already."""

        def decode() -> Image:
            from PIL import Image

            return _flipped(Image.fromarray(texels))

        texture = cls(decode, name)
        for kind, chain in levels.items():
            texture._levels[kind] = Future()
            texture._levels[kind].set_result(chain)
        return texture

    def rgb(self) -> Image:
        """The image in mode RGB, row 0 at the bottom as OpenGL has it; alpha is dropped.

        Raises
        ------
        InputError : the image is damaged, or has a side over 16384 texels
        """
        with self._lock:
            if self._rgb is not None:
                return self._rgb
            if self._decode is None:
                return self._finest()
            self._rgb = _upright_rgb(self._decode(), self.name)
            self._decode = None
            return self._rgb

    def channel(self, index: int, name: str) -> Texture:
        """One channel of this texture as a grey texture of its own."""
        return Texture(lambda: _flipped(self.rgb().getchannel(index)), name)

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
                    future = _executor().submit(lambda: _CHAINS[kind](self.rgb()))
                self._levels[kind] = future
                if kind != "linear-color":
                    drop = WeakMethod(self._drop_image)  # a future keeps what it has called
                    future.add_done_callback(lambda chain: (own := drop()) and own(chain))
            return self._levels[kind]

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
        sizes = [band.size for band in bands if band]
        size = max(width for width, _ in sizes), max(height for _, height in sizes)
        filled = [band.resize(size) if band else Image.new("L", size, 255) for band in bands]
        return _flipped(Image.merge("RGB", filled))

    names = [texture.name for texture in (red, green, blue) if texture]
    packed = known or Texture(decode, " + ".join(dict.fromkeys(names)))
    _packed[red, green, blue] = packed
    return packed


def _flipped(image: Image) -> Image:
    from PIL.Image import Transpose

    return image.transpose(Transpose.FLIP_TOP_BOTTOM)


def _upright_rgb(image: Image, name: str) -> Image:
    from PIL import Image as images

    if max(image.size) > MAX_SIZE:
        raise InputError(f"{name} is {image.width} x {image.height} texels: at most {MAX_SIZE}")
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{name} is damaged ({error}); replace the file") from None
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow's convert would clip at 255
        image = images.fromarray((np.asarray(image) // 257).astype(np.uint8))
    return _flipped(image.convert("RGB"))


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

    levels = [image]
    while max(image.size) > 1:
        half = max(image.width // 2, 1), max(image.height // 2, 1)
        image = image.resize(half, Resampling.BOX)
        levels.append(image)
    return [np.asarray(level) for level in levels]


def _even(texels: NDArray[Any]) -> NDArray[Any]:
    """Make both sides even: a side of 1 is doubled, the last texel of another odd one dropped."""
    for axis in (0, 1):
        if texels.shape[axis] == 1:
            texels = np.repeat(texels, 2, axis)
    return texels[: texels.shape[0] // 2 * 2, : texels.shape[1] // 2 * 2]


def _chain(texels: NDArray[Any], halve: Callable[[NDArray[Any]], NDArray[Any]]) -> Levels:
    levels = [texels]
    while max(texels.shape[:2]) > 1:
        texels = halve(np.ascontiguousarray(_even(texels)))
        levels.append(texels)
    return levels


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
    for top in range(0, height, _STRIP):  # in strips that stay in the cache
        # Four channels of 16 bits side by side are added as one number, without a carry.
        light = decode[texels[top : top + _STRIP]].view(np.uint64)[..., 0]
        rows = light[0::2] + light[1::2]
        blocks = rows[:, 0::2] + rows[:, 1::2]
        halved[top // 2 : top // 2 + len(blocks)] = encode[blocks.view(np.uint16)].reshape(
            *blocks.shape, channels
        )
    return halved


def _color_levels(image: Image) -> Levels:
    return _chain(np.asarray(image.convert("RGBA")), _halve_srgb)


def _halve_linear(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = texels.shape
    blocks = texels.reshape(height // 2, 2, width // 2, 2, channels)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _linear_color_levels(image: Image) -> Levels:
    decoded = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    chain = _chain(decoded[np.asarray(image.convert("RGBA"))], _halve_linear)
    return [level.astype(np.float16) for level in chain]


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
    texels = np.asarray(image)
    levels = [np.insert(texels, 3, 0, axis=-1)]
    if max(image.size) == 1:
        return levels
    even = _even(texels)
    strips = range(0, len(even), _STRIP)  # that stay in the cache
    halved = [_halve_planes(_unit_planes(even[top : top + _STRIP])) for top in strips]
    means = np.concatenate(halved, axis=1)
    while True:
        levels.append(_with_deviation(means))
        if max(means.shape[1:]) == 1:
            return levels
        means = _halve_planes(np.moveaxis(_even(np.moveaxis(means, 0, -1)), -1, 0))


_CHAINS: dict[Kind, Callable[[Image], Levels]] = {
    "color": _color_levels,
    "linear-color": _linear_color_levels,
    "normal": _normal_levels,
    "data": _data_levels,
}
