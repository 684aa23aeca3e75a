"""Tests sheets and differences of images, and the images that notebooks display."""

from __future__ import annotations

import io
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.comparison.pictures import BRIGHTER, DARKER
from facerender.images.files import png_bytes
from facerender.images.image import encode_srgb8, srgb_to_linear

WHITE = (255, 240, 222)  # of a pixel that is brighter in B


def opened(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """Two linear images: B is brighter on the left and slightly darker on the right."""
    a = np.full((24, 40, 3), 0.25, dtype=np.float32)
    b = a.copy()
    b[:, :8, 1] += 0.5
    b[:, -8:] -= 0.01
    return a, b


def test_the_largest_difference_is_white_and_the_title_names_it(pair):
    a, b = pair
    apart = fr.difference(a, b)
    pixels = apart.srgb8()
    assert {tuple(each) for each in pixels[:, :8].reshape(-1, 3)} == {WHITE}
    assert not pixels[:, 8:-8].any()
    blue = pixels[0, -1].astype(int)
    assert blue.argmax() == np.argmax(DARKER)
    assert apart.metadata["difference"] == "B - A: orange +, blue -, white = 0.5"
    titled, plain = (fr.sheet([apart], titles).srgb8() for titles in (None, [""]))
    assert len(titled) > len(plain)


def test_a_small_difference_is_as_visible_as_a_large_one(pair):
    a, b = pair
    small = fr.difference(a, a + (b - a) / 100.0)
    np.testing.assert_array_equal(small.srgb8(), fr.difference(a, b).srgb8())
    assert small.metadata["difference"].endswith("white = 0.005")
    same = fr.difference(a, a)
    assert not same.srgb8().any()


def test_neither_outliers_nor_rounding_errors_set_the_scale():
    rng = np.random.default_rng(1)
    a = np.full((100, 100, 3), 0.25, dtype=np.float32)
    b = a + rng.normal(0.0, 1e-7, a.shape).astype(np.float32)
    b[:10] -= 0.01
    b[0, :2] += 5.0
    apart = fr.difference(a, b)
    assert apart.metadata["difference"].endswith("white = 0.01")
    pixels = apart.srgb8()
    assert tuple(pixels[0, 0]) == WHITE
    assert pixels[1, 0].min() > 200
    assert not pixels[10:].any()


def panels(frame: fr.Frame, count: int, height: int) -> list[np.ndarray]:
    """Return the images of a sheet of one row, whose images are 40 pixels wide."""
    return [frame.srgb8()[-2 - height : -2, 2 + 42 * n : 42 + 42 * n] for n in range(count)]


@pytest.mark.parametrize("encoding", ["linear", "srgb8"])
def test_differences_of_one_sheet_have_one_scale(pair, encoding):
    """The largest difference sets the scale; equal images do not count."""
    a, b = pair
    changed = [a + factor * (b - a) for factor in (0.5, 1.0, 0.0)]
    if encoding == "srgb8":
        a, *changed = (np.round(100.0 * image).astype(np.uint8) for image in (a, *changed))
    small, large, same = (fr.difference(a, image) for image in changed)
    assert tuple(small.srgb8()[0, 0]) == tuple(large.srgb8()[0, 0]) == WHITE
    sheet = fr.sheet([small, large, same, a])
    halved, full, black, _ = panels(sheet, 4, 24)
    np.testing.assert_array_equal(full, large.srgb8())
    np.testing.assert_allclose(halved[0, 0], BRIGHTER, atol=2)
    assert not black.any()
    white = large.metadata["difference"]
    explicit = fr.sheet([small, large, same, a], [white, white, white, ""])
    np.testing.assert_array_equal(sheet.srgb8(), explicit.srgb8())


def test_titles_state_the_scale_of_the_sheet(pair):
    a, b = pair
    small, large = fr.difference(a, a + (b - a) / 100.0), fr.difference(a, b)
    scale = "white = 0.5"
    for titles, printed in (
        (["one", "two"], [f"one, {scale}", f"two, {scale}"]),
        (
            [f"one: {d.metadata['difference']}" for d in (small, large)],
            [f"one: B - A: orange +, blue -, {scale}"] * 2,
        ),
        ([f"{scale} here", ""], [f"{scale} here", ""]),
    ):
        sheet = fr.sheet([small, large], titles)
        expected = fr.sheet([large, large], printed)
        assert sheet.linear.shape == expected.linear.shape
        bands = [frame.srgb8()[:-26] for frame in (sheet, expected)]
        np.testing.assert_array_equal(*bands)


@pytest.mark.parametrize("gains", [(1.0, 4.0), (4.0, None)])
def test_given_gains_of_one_sheet_become_one(pair, gains):
    a, b = pair
    frames = [fr.difference(a, b, gain=gain) for gain in gains]
    one, other = panels(fr.sheet(frames), 2, 24)
    np.testing.assert_array_equal(one, other)
    least = fr.difference(a, b, gain=min(gain or 2.0 for gain in gains))
    np.testing.assert_array_equal(one, least.srgb8())


@pytest.mark.parametrize("width", [48, 90, 128])
def test_titles_of_narrow_images_are_complete(width):
    """A title that is wider than its image has several lines, and no ink of it is missing."""
    bands = []
    for size in (width, 239):
        frame = fr.sheet(
            [np.zeros((10, size, 3), np.uint8)], ["B - A: orange +, blue -, white = 0.0123"]
        )
        gap = max(size // 64, 2)
        bands.append(255.0 - frame.srgb8()[gap : -10 - gap])
    narrow, wide = bands
    assert len(narrow) >= 2 * len(wide)
    assert narrow.sum() == pytest.approx(wide.sum(), rel=0.05)


def test_gain_is_a_linear_scale(pair):
    a, b = pair
    half, quarter, clipped = (fr.difference(a, b, gain=g).srgb8() for g in (1.0, 0.5, 1000.0))
    np.testing.assert_allclose(half[0, 0], BRIGHTER, atol=1)
    dark = srgb_to_linear(np.array(BRIGHTER) / 255.0) / 2.0
    np.testing.assert_allclose(srgb_to_linear(quarter[0, 0] / 255.0), dark, atol=0.01)
    assert tuple(clipped[0, 0]) == WHITE
    assert clipped[0, -1].argmax() == np.argmax(DARKER)
    bytes_a, bytes_b = (np.full((4, 4, 3), level, np.uint8) for level in (100, 151))
    full = fr.difference(bytes_a, bytes_b, gain=5.0)
    assert tuple(full.srgb8()[0, 0]) == WHITE
    assert full.metadata["difference"] == "B - A: orange +, blue -, white = 51/255"


def test_a_sheet_holds_each_kind_of_image_at_its_place(tmp_path):
    rng = np.random.default_rng(1)
    cells = rng.integers(0, 256, (5, 30, 128, 3), dtype=np.uint8)
    (tmp_path / "b.png").write_bytes(png_bytes(cells[1], {}))
    sources = [
        *(cells[0], tmp_path / "b.png", str(tmp_path / "b.png"), Image.fromarray(cells[3])),
        fr.sheet([cells[4]]),
    ]
    sources[4] = replace(sources[4], linear=sources[4].linear[2:-2, 2:-2])  # without the margin
    cells[2] = cells[1]
    whole = fr.sheet(sources, titles=["A", "B", "", "D", "E"], columns=2).srgb8()
    band = (len(whole) - 3 * 30 - 4 * 2) // 3
    assert band > 10
    for number, cell in enumerate(cells):
        top = 2 + number // 2 * (band + 30 + 2) + band
        left = 2 + number % 2 * (128 + 2)
        np.testing.assert_array_equal(whole[top : top + 30, left : left + 128], cell)
        title = whole[top - band : top, left : left + 128]
        assert (title.min() < 80) == (number != 2)
        assert title.max() == 255
    assert (whole[2 + 2 * (band + 32) :, 2 + 128 :] == 255).all()  # the empty place


def test_a_sheet_without_titles_is_one_row_of_at_most_four():
    grey = np.full((10, 20, 3), 0.5, dtype=np.float32)
    assert fr.sheet([grey] * 4).linear.shape == (10 + 4, 4 * 22 + 2, 4)
    assert fr.sheet([grey] * 5).linear.shape == (2 * 12 + 2, 4 * 22 + 2, 4)


def test_long_titles_stay_above_their_image():
    black = np.zeros((10, 200, 3), np.uint8)
    pixels = fr.sheet([black, black], titles=["long title " * 40, ""]).srgb8()
    assert pixels[:-15, 3:200].min() < 100
    assert (pixels[:-15, 206:] == 255).all()


def test_a_frame_of_a_term_has_its_own_colours(head, renderer):
    scene = fr.Scene(head, background=None)
    frame = renderer.render(scene, only="normal")
    pixels = fr.sheet([frame]).srgb8()[4:-4, 4:-4]
    encoded = frame.srgb8()
    inside = encoded[..., 3] == 255
    np.testing.assert_array_equal(pixels[inside], encoded[inside][:, :3])
    assert not pixels[encoded[..., 3] == 0].any()


BLACK = np.zeros((4, 5, 3), np.float32)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fr.sheet([]), "a sheet of 0 images: give at least one"),
        (lambda: fr.sheet([BLACK, BLACK[1:]]), "image 2 is 5 x 3 pixels, image 1 is 5 x 4"),
        (lambda: fr.sheet(BLACK), "give a list of images"),
        (lambda: fr.sheet("a.png"), "images = 'a.png': give a list of images"),
        (lambda: fr.sheet(["nofile.png"]), "cannot read nofile.png"),
        (lambda: fr.sheet([None]), r"image 1 has shape \(\)"),
        (lambda: fr.sheet([BLACK], titles=["a", "b"]), "titles: 2, images: 1; give one for each"),
        (lambda: fr.sheet([BLACK], columns=2), r"columns = 2 is outside \[1, 1\]"),
        (lambda: fr.sheet([np.zeros((9, 9000, 3))] * 2), "a sheet of 2 images is .* make it small"),
        (lambda: fr.sheet([Image.new("P", (4, 4))]), "image 1 has Pillow's mode P: give image.con"),
        (lambda: fr.difference(BLACK, BLACK[1:]), "A is 5 x 4, B is 5 x 3 pixels"),
        (lambda: fr.difference(BLACK, BLACK.astype(np.uint8)), "A is linear float, B is 8-bit"),
        (lambda: fr.difference(BLACK, BLACK * np.nan), "B holds 60 NaN"),
        (lambda: fr.difference(BLACK, BLACK, gain=0), r"gain = 0 is outside \[0.001, 1e\+09\]"),
    ],
)
def test_errors_are_one_line(call, message):
    with pytest.raises(fr.InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_result_shows_its_verdict_and_images(pair):
    result = fr.compare(*pair)
    page = result._repr_html_()
    assert page.startswith("<p><b>differs</b>: point: 384 pixels differ")
    assert page.count("<img ") == 1
    assert fr.compare(pair[0], pair[0])._repr_html_().startswith("<p>same</p><img ")
    assert "images" not in result.as_dict()
    assert "images" not in repr(result)
    assert replace(result, images=()) == result
    assert replace(result, images=())._repr_html_() == page[: page.index("<img")]


def test_the_command_writes_the_sheet_of_the_result(pair, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, pixels in zip("ab", pair, strict=True):
        np.save(f"{name}.npy", pixels)
    assert main(["compare", "a.npy", "b.npy", "--sheet", "sheet.png"]) == 1
    shown = fr.compare("a.npy", "b.npy")._repr_html_()
    written = opened((tmp_path / "sheet.png").read_bytes())
    np.testing.assert_array_equal(
        written, opened(b64decode(shown.split("base64,")[1].split('"')[0]))
    )
    np.save("b.npy", pair[1][1:])
    capsys.readouterr()
    assert main(["compare", "a.npy", "b.npy", "--sheet", "other.png"]) == 2
    assert "no sheet: " not in capsys.readouterr().out
    assert not (tmp_path / "other.png").exists()


def test_notebooks_display_gbuffers_textures_and_environments(head, renderer):
    gbuffer = renderer.gbuffer(fr.Scene(head))
    cells = opened(gbuffer._repr_png_())
    band = (cells.shape[0] - 4) // 2 - 260  # 256 pixels and a margin of 4
    albedo = cells[4 + band : 260 + band, 4 + 2 * 260 : 3 * 260]
    np.testing.assert_array_equal(albedo, encode_srgb8(gbuffer.albedo))
    texels = np.zeros((600, 1200, 3), np.uint8)
    texels[:100] = 200  # the top
    shown = opened(fr.Texture.from_array(texels)._repr_png_())
    assert shown.shape == (256, 512, 3)
    assert shown[:30].min() > 150
    assert not shown[60:].any()
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:, 32] = 0.25  # azimuth 90
    panorama = fr.Panorama("bar", radiance)
    for rotation, column in ((0.0, 32), (-90.0, 64), (90.0, 0)):
        shown = opened(fr.Environment(panorama, rotation, 4.0)._repr_png_())
        assert np.flatnonzero(shown[0].any(axis=-1)).tolist() == [column]
        assert shown.max() == 255
    assert opened(panorama._repr_png_()).max() == encode_srgb8(np.float32([0.25]))[0]
