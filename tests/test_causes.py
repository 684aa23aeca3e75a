"""Tests the likely causes of differences on a coloured texture with a highlight, drawn by NumPy.
docs/measurements/comparison.md has the causes named for renders."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from facerender.comparison.causes import CODEC, EXPOSURE, GEOMETRY, LIGHT, LOBE, TEXTURE
from facerender.comparison.compare import compare
from facerender.images.image import encode_srgb8, image_from_array

SIDE = 192
DOWN, ACROSS = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
RANDOM = np.random.default_rng(1)
PORES = gaussian_filter(RANDOM.standard_normal((SIDE, SIDE)), 3.0)
SKIN = np.float32([0.6, 0.4, 0.3]) * (1.0 + 1.5 * PORES[..., None])
SHADE = (0.5 - 0.7 * ACROSS)[..., None]
TURNED = SHADE + 0.1 * DOWN[..., None]
SPOT = np.exp(-20.0 * ((ACROSS + 0.2) ** 2 + DOWN**2))[..., None]


def drawn(skin=SKIN, shade=SHADE, spot=SPOT, power=1.0) -> np.ndarray:
    """Return a linear image: diffuse light on a texture, and a white highlight."""
    return (skin * shade + 0.3 * spot**power).astype(np.float32)


def jpeg(quality: int) -> np.ndarray:
    Image.fromarray(encode_srgb8(drawn())).save(file := io.BytesIO(), "JPEG", quality=quality)
    return np.asarray(Image.open(file))


PLAIN = drawn()
BYTES = encode_srgb8(PLAIN)
LEVELS = BYTES / 255.0
CHANGED = {  # change: reference, image, cause
    "wider highlight": (PLAIN, drawn(power=0.9), LOBE),
    "weaker highlight": (PLAIN, drawn(spot=0.97 * SPOT), LOBE),
    "weaker highlight, 8 bits": (BYTES, encode_srgb8(drawn(spot=0.9 * SPOT)), LOBE),
    "turned light": (PLAIN, drawn(shade=TURNED), LIGHT),
    "turned light, 8 bits": (
        BYTES,
        encode_srgb8(drawn(shade=SHADE + 0.1 * DOWN[..., None])),
        LIGHT,
    ),
    "exposure": (PLAIN, np.float32(1.01) * PLAIN, EXPOSURE),
    "exposure, 8 bits": (BYTES, encode_srgb8(np.float32(0.95) * PLAIN), EXPOSURE),
    "redder texture": (PLAIN, drawn(SKIN * np.float32([1.02, 1.0, 1.0])), TEXTURE),
    "blurred texture": (PLAIN, drawn(gaussian_filter(SKIN, (2.0, 2.0, 0.0))), TEXTURE),
    "moved by 2 pixels": (PLAIN[:, 2:], PLAIN[:, :-2], GEOMETRY),
    "moved by 2 pixels, 8 bits": (BYTES[2:], BYTES[:-2], GEOMETRY),
    "gamma 2.2": (BYTES, np.uint8(np.round(255.0 * PLAIN.clip(0.0, 1.0) ** (1.0 / 2.2))), CODEC),
    "64 levels": (BYTES, np.uint8(np.round(LEVELS * 63.0) * (255.0 / 63.0)), CODEC),
    "JPEG": (BYTES, jpeg(75), CODEC),
}


@pytest.mark.first_case
@pytest.mark.parametrize("name", CHANGED)
def test_first_reason_names_the_cause(name):
    reference, image, cause = CHANGED[name]
    result = compare(reference, image, driver="same")
    assert result.reasons[0].split("perhaps ")[1].split(" (")[0] == cause, str(result)


def test_few_wrong_pixels_are_a_reason_after_a_change_of_the_whole_image():
    """Only black pixels that change most of the image's radiance are the first reason."""
    places = ((60, 90, 130), (40, 60, 30))
    image, alone = drawn(spot=0.95 * SPOT), PLAIN.copy()
    image[places] = alone[places] = 0.0
    first, second = compare(PLAIN, image).reasons
    assert f"perhaps {LOBE}" in first
    assert second.endswith("perhaps missing pixels")
    assert compare(PLAIN, alone).reasons[0].endswith("perhaps missing pixels")


def metadata_text(one: dict[str, str], other: dict[str, str], gain: float = 1.01) -> str:
    """Compare two images with these metadata."""
    a, b = image_from_array(PLAIN, "A"), image_from_array(np.float32(gain) * PLAIN, "B")
    return str(compare(replace(a, metadata=one), replace(b, metadata=other)))


def test_changed_metadata_stand_in_the_first_reason_instead_of_a_cause():
    """Long values are cut, and at most three entries are listed."""
    one = {"m": "0.3", "ks": "1", "f0": "0.028", "lobe": "exact", "size": "8", "only": "here"}
    other = {"m": "0.33", "ks": "2", "f0": "0.04", "lobe": "d" * 99, "size": "8"}
    text = metadata_text(one, {**one, "m": "0.33"})
    assert text.endswith(" blocks (gain 1.01) (metadata: m 0.3 -> 0.33)")
    assert "(metadata: m 0.3 -> 0.33, ks 1 -> 2, f0 0.028 -> 0.04, 1 more)" in metadata_text(
        one, other
    )
    assert "perhaps" in metadata_text({"facerender": "1"}, {"facerender": "2"})


LIGHT_0 = "Light(azimuth=-50, elevation=42, irradiance=(3.0, 3.0, 3.0))"


@pytest.mark.parametrize(
    ("key", "one", "other", "text"),
    [
        ("light 0", LIGHT_0, LIGHT_0.replace("3.0", "3.06"), "light 0 irradiance 3.0 -> 3.06"),
        (
            "light 0",
            LIGHT_0,
            LIGHT_0.replace("-50", "-50.0").replace("elevation=42", "elevation=43.0"),
            "(metadata: light 0 elevation 42 -> 43.0",
        ),
        ("light 0", LIGHT_0, LIGHT_0.replace("-50", "-51"), "light 0 azimuth -50 -> -51"),
        ("camera", "Camera(zoom=1)", "Camera(zoom=1, frame='face')", "frame default -> 'face'"),
        ("background", "(0.1, 0.2, 0.3)", "(0.1, 0.2, 0.4)", "(0.1, 0.2, 0.3) -> (0.1, 0.2, 0.4)"),
        (
            "mesh",
            "a.glb, 9279 vertices, 17684 triangles, radius 5.5, CRC-32 11803573",
            "a.glb, 9279 vertices, 8000 triangles, radius 5.5, CRC-32 0a",
            "mesh 17684 triangles, CRC-32 11803573 -> 8000 triangles, CRC-32 0a",
        ),
    ],
)
def test_only_fields_that_differ_are_listed(key, one, other, text):
    assert f"{text})" in metadata_text({key: one}, {key: other})


def test_changed_metadata_of_equal_images():
    one = {"samples": "4", "GL_RENDERER": "a"}
    assert metadata_text(one, {**one, "samples": "1"}, 1.0) == "same (metadata: samples 4 -> 1)"
    assert metadata_text(one, {**one, "GL_RENDERER": "b"}, 1.0) == "same"
