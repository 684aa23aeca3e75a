"""Tests images with ICC profiles: sRGB profiles of any name are ignored, other profiles are
converted, and invalid ones are refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from facerender.comparison.compare import Pair, compare
from facerender.comparison.report import entry
from facerender.images.files import read_image
from facerender.images.image import linear_to_srgb, srgb_to_linear

# XYZ of red, green and blue, adapted to D50 as in ICC profiles (Lindbloom).
SRGB = ((0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141))
DISPLAY_P3 = ((0.5151, 0.2412, -0.0011), (0.2919, 0.6922, 0.0419), (0.1572, 0.0666, 0.7841))
WHITE = (0.9642, 1.0, 0.8249)
OF_MONITOR = (0.9505, 1.0, 1.0891)  # white point in version 2 profiles such as HP's sRGB
CURVE = np.round(65535 * srgb_to_linear(np.linspace(0.0, 1.0, 1024)))
GAMMA_2_2, GAMMA_1_8 = (np.array([round(256 * gamma)]) for gamma in (2.2, 1.8))


def profile(name: str, space: str, curve: np.ndarray, *primaries: tuple[float, ...]) -> bytes:
    """Return a profile of version 2 (ICC.1:2001-04) with a matrix and curves, or a grey curve."""

    def xyz(values: tuple[float, ...]) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(65536 * value) for value in values))

    text = name.encode() + b"\0"
    curves = b"curv\0\0\0\0" + struct.pack(f">I{curve.size}H", curve.size, *curve.astype(int))
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78),
        b"wtpt": xyz(OF_MONITOR),
        **{key: xyz(of) for key, of in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries, strict=False)},
        **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC") if primaries else (b"kTRC",), curves),
    }
    table, data = struct.pack(">I", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for key, content in tags.items():
        table += key + struct.pack(">2I", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    head = struct.pack(
        ">I4sI4s4s4s12x4s28x3i48x",
        *(start + len(data), b"none", 0x02100000, b"mntr", space.encode(), b"XYZ ", b"acsp"),
        *(round(65536 * value) for value in WHITE),
    )
    return head + table + data


P3 = profile("Display P3", "RGB ", CURVE, *DISPLAY_P3)
GREY = profile("Dot gain", "GRAY", GAMMA_1_8)


def colors(*channels: int) -> np.ndarray:
    """Return random colours that are inside sRGB and wider colour spaces."""
    return np.random.default_rng(1).integers(60, 200, (300, 20, *channels), dtype=np.uint8)


def saved(path: Path, pixels: np.ndarray, content: bytes | None) -> Path:
    Image.fromarray(pixels).save(path, icc_profile=content, quality=95)
    return path


@pytest.mark.parametrize(
    "content",
    [
        profile("Monitor 7", "RGB ", CURVE, *SRGB),
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
    ],
    ids=["version 2", "version 4"],
)
def test_srgb_profiles_of_any_name_change_nothing(content, tmp_path):
    for kind in ("png", "jpg"):
        plain = saved(tmp_path / f"plain.{kind}", colors(3), None)
        image = read_image(saved(tmp_path / f"own.{kind}", colors(3), content))
        np.testing.assert_array_equal(image.pixels, read_image(plain).pixels)
        assert (image.profile, image.color_space) == ("", "")
    assert compare(tmp_path / "plain.png", tmp_path / "own.png").same


def as_p3(values: np.ndarray) -> np.ndarray:
    linear = srgb_to_linear(values) @ DISPLAY_P3 @ np.linalg.inv(SRGB)
    return linear_to_srgb(linear)


CONVERTED = {  # name of the profile, its content, channels, conversion of colours in [0, 1]
    "RGB": ("Display P3", P3, (3,), as_p3),
    "RGBA": ("Display P3", P3, (4,), as_p3),
    "L": ("Dot gain", GREY, (), lambda values: linear_to_srgb(values**1.8)),
    "LA": ("Dot gain", GREY, (2,), lambda values: linear_to_srgb(values**1.8)),
    "called sRGB": (
        "sRGB IEC61966-2.1",
        profile("sRGB IEC61966-2.1", "RGB ", GAMMA_2_2, *SRGB),
        (3,),
        lambda values: linear_to_srgb(values**2.2),
    ),
}


@pytest.mark.parametrize("case", CONVERTED)
def test_other_profiles_are_converted_to_srgb(case, tmp_path):
    name, content, channels, convert = CONVERTED[case]
    pixels = colors(*channels)
    if case == "called sRGB":
        pixels[:] = 20  # the curves differ in dark colours
    image = read_image(saved(tmp_path / "a.png", pixels, content))
    assert image.pixels.shape[2:] == (channels or (1,))
    assert image.profile == name
    pixels = pixels.reshape(image.pixels.shape)
    count = 3 if pixels.shape[2] > 2 else 1
    expected = 255.0 * convert(pixels[..., :count] / 255.0)
    assert np.abs(image.pixels[..., :count] - expected).max() < 1.5
    assert np.abs(expected - pixels[..., :count]).max() > 2.0
    np.testing.assert_array_equal(image.pixels[..., count:], pixels[..., count:])


def test_noise_of_a_conversion_covers_its_rounding(tmp_path):
    exact = np.random.default_rng(1).uniform(70.0, 180.0, (300, 300, 3))
    linear = srgb_to_linear(exact / 255.0) @ SRGB @ np.linalg.inv(DISPLAY_P3)
    wide = np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)
    path = saved(tmp_path / "wide.png", wide, P3)
    image = read_image(path)
    error = np.sqrt(np.square(image.pixels - exact).mean(axis=(0, 1))).max()
    assert 0.5 * image.noise < error < 1.1 * image.noise
    plain = saved(tmp_path / "plain.png", np.round(exact).astype(np.uint8), None)
    assert compare(plain, path).trend < 0.01


BUILD = r"\(cannot build transform\)"
REFUSED = {
    "no profile": (b"wide gamut", (3,), r"\(cannot open profile from string\)"),
    "cut off": (P3[:300], (3,), r"\(cannot .*\)"),
    "RGB in grey": (P3, (), BUILD),
    "grey in RGB": (GREY, (3,), BUILD),
    "CMYK in RGB": (profile("Press", "CMYK", GAMMA_2_2, *SRGB), (4,), BUILD),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_profile_is_refused(name, cli, tmp_path):
    content, channels, reason = REFUSED[name]
    path = saved(tmp_path / "a.png", colors(*channels), content)
    message = rf"a\.png has an ICC profile that cannot be used {reason}: save it as sRGB"
    cli.fail(f"^facerender: error: .*{message}", "compare", path, path)


def test_profile_that_cannot_be_decompressed_is_refused(cli, tmp_path):
    path = saved(tmp_path / "a.png", colors(3), None)
    data = b"iCCPwide\0\0" + b"no zlib"
    chunk = struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))
    content = path.read_bytes()
    path.write_bytes(content[:33] + chunk + content[33:])
    cli.fail(r"a\.png has an ICC profile that cannot be used", "compare", path, path)


def test_report_names_the_converted_profile(tmp_path):
    wide = saved(tmp_path / "wide.png", colors(3), P3)
    pair = Pair.of("wide", saved(tmp_path / "plain.png", colors(3), None), wide)
    assert "<td>–</td><td>Display P3</td>" in entry(pair)["section"]
