"""Tests textures: sizes and averages of mip levels, packing of channels, and damaged images."""

from __future__ import annotations

import gc
import mmap
import threading
import time
import weakref

import numpy as np
import pytest
from PIL import Image

from facerender import InputError
from facerender.images.image import srgb_to_linear
from facerender.system.process import unload
from facerender.texture.texture import Texture, pack


def texture(pixels, name="map.png"):
    return Texture(lambda: Image.fromarray(pixels), name)


@pytest.mark.parametrize("kind", ["color", "linear-color", "data"])
@pytest.mark.parametrize("size", [(64, 64), (64, 16), (5, 7), (1, 9), (1, 1)])
def test_chain_halves_down_to_one_texel(kind, size):
    pixels = np.full((*size, 3), 200, np.uint8)
    levels = texture(pixels).levels(kind).result()
    height, width = size
    for level in levels:
        assert level.shape[:2] == (max(height, 1), max(width, 1))
        height, width = height // 2, width // 2
    assert levels[-1].shape[:2] == (1, 1)
    channels = levels[0].astype(np.float64)[..., :3]
    np.testing.assert_allclose(levels[-1][0, 0, :3], channels[0, 0], rtol=2e-3)


def test_row_zero_is_at_the_bottom():
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0] = 255
    for kind in ("color", "data"):
        assert texture(pixels).levels(kind).result()[0][1, 0, 0] == 255


def test_colour_is_averaged_in_linear_light():
    checkers = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    pixels = np.repeat(checkers[..., None], 3, axis=-1)
    color = texture(pixels).levels("color").result()
    assert set(np.unique(color[1][..., :3])) == {188}  # sRGB of linear 0.5, not 128
    linear = texture(pixels).levels("linear-color").result()
    assert linear[-1][0, 0, 0] == 0.5
    assert texture(pixels).levels("data").result()[1][0, 0, 0] in (127, 128)


def test_bytes_and_floats_agree_on_a_random_image():
    pixels = np.random.default_rng(2).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    color = texture(pixels).levels("color").result()
    linear = texture(pixels).levels("linear-color").result()
    for encoded, decoded in zip(color, linear, strict=True):
        back = srgb_to_linear(encoded[..., :3] / 255.0)
        assert np.abs(back - decoded[..., :3]).max() < 0.008  # one 8-bit level, and rounding


def test_packing_fills_missing_channels_and_uses_the_largest_size():
    red = texture(np.full((4, 8, 3), 10, np.uint8), "red.png")
    blue = texture(np.full((16, 2, 3), 30, np.uint8), "blue.png")
    both = pack(red, None, blue)
    level = both.levels("data").result()[0]
    assert level.shape == (16, 8, 3)
    assert level[0, 0].tolist() == [10, 255, 30]
    assert both.name == "red.png + blue.png"


def test_packing_the_same_again_gives_the_same_texture():
    red = texture(np.full((4, 4, 3), 10, np.uint8))
    first = pack(red, None, None)
    assert pack(red, None, None) is first
    assert pack(None, red, None) is not first


def test_packed_texture_lives_as_long_as_its_first_map():
    red = texture(np.full((4, 4, 3), 10, np.uint8))
    packed = weakref.ref(pack(red, None, None))
    gc.disable()  # a reference cycle would need the garbage collector
    try:
        assert pack(red, None, None) is packed() is not None
        del red
        assert packed() is None
    finally:
        gc.enable()


def test_channel_keeps_its_rows():
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0, :, 1] = 200
    level = pack(None, texture(pixels).channel(1, "roughness"), None).levels("data").result()[0]
    assert level[:, 0, 1].tolist() == [0, 200]


def test_16_bit_grey_is_scaled_and_not_clipped():
    grey = np.array([[0, 25700], [51400, 65535]], dtype=np.uint16)
    level = texture(grey).levels("data").result()[0]
    assert level[..., 0].tolist() == [[200, 255], [0, 100]]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("page.jpg", b"<html></html>", "page.jpg is an HTML page; download the file itself"),
        ("empty.png", b"", "empty.png is not an image"),
        ("absent.png", None, "cannot read .*absent.png: no such file"),
    ],
)
def test_invalid_images_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        Texture.open(tmp_path / name)


def test_truncated_image_is_refused_when_it_is_decoded(tmp_path):
    pixels = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "half.jpg")
    content = (tmp_path / "half.jpg").read_bytes()
    (tmp_path / "half.jpg").write_bytes(content[: len(content) // 2])
    levels = Texture.open(tmp_path / "half.jpg").levels("color")
    with pytest.raises(InputError, match="half.jpg is damaged"):
        levels.result()


def test_huge_image_is_refused_before_it_is_decoded():
    huge = Texture(lambda: Image.new("L", (16385, 1)), "huge.png")
    with pytest.raises(InputError, match="huge.png is 16385 x 1 pixels .*: at most 16384 a side"):
        huge.levels("data").result()


def test_texels_are_read_while_chains_are_computed():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    for _ in range(50):
        image = texture(pixels)
        green = image.channel(1, "green")
        chains = [image.levels(kind) for kind in ("data", "normal", "color")]
        readers = [
            threading.Thread(target=read, daemon=True)
            for read in (image.texels, green.texels, image.coarser(1).texels, image.rgb)
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(30.0)
            assert not reader.is_alive()
        assert all(chain.result(30.0) for chain in chains)
        np.testing.assert_array_equal(image.texels()[::-1], pixels)


def test_texture_is_freed_with_its_last_reference():
    texture = Texture.known(np.zeros((4, 4, 3), np.uint8), "zeros", {})
    gone = weakref.ref(texture)
    gc.disable()  # a reference cycle would need the garbage collector
    try:
        texture.levels("color").result()
        del texture
        end = time.monotonic() + 20.0  # the decoding thread drops its reference later
        while gone() is not None and time.monotonic() < end:
            time.sleep(0.01)
        assert gone() is None
    finally:
        gc.enable()


def test_unloaded_pages_are_read_from_the_file_again(tmp_path):
    values = np.random.default_rng(1).integers(0, 256, 3 * mmap.PAGESIZE + 100, dtype=np.uint8)
    path = tmp_path / "values"
    path.write_bytes(values.tobytes())
    with path.open("rb") as file:
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
    mapped = np.frombuffer(data, dtype=np.uint8, offset=64)
    mapped[[0, mmap.PAGESIZE]] = values[[64, mmap.PAGESIZE + 64]] + 1
    unload([mapped, values])
    assert mapped[0] == values[64] + np.uint8(1)  # another array may use the rest of the page
    np.testing.assert_array_equal(mapped[1:], values[65:])
