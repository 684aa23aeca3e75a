"""Tests of backgrounds, of exposure and of tone mapping, in images and files."""

from __future__ import annotations

import json
import math
import pickle
import re
import warnings
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.batch.jobs import JobTable, forget_files, key_of
from facerender.commands import main
from facerender.images.image import neutral, srgb_to_linear
from tests.awkward_files import MINI_HEAD

SIZE = (64, 48)
WALLS = {  # colours of the six directions: right, left, up, down, front, back
    (1, 0, 0): (1.0, 0.0, 0.0),
    (-1, 0, 0): (0.0, 1.0, 0.0),
    (0, 1, 0): (0.0, 0.0, 1.0),
    (0, -1, 0): (1.0, 1.0, 0.0),
    (0, 0, 1): (0.0, 1.0, 1.0),
    (0, 0, -1): (1.0, 0.0, 1.0),
}


@pytest.fixture(scope="module")
def mesh() -> fr.Mesh:
    return fr.load_mesh(MINI_HEAD)


@pytest.fixture(scope="module")
def renderer() -> Any:
    with fr.Renderer(SIZE) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def room() -> fr.Environment:
    """An environment in which each direction has the colour of the wall it points at."""
    rows = 64
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * rows) + 0.5) / rows)
    x, z = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
    directions = np.stack([x, np.sin(elevation) + 0.0 * azimuth, z], axis=-1)
    nearest = (directions @ np.array([*WALLS]).T).argmax(axis=-1)
    return fr.Environment(fr.Panorama("room", np.float32([*WALLS.values()])[nearest]))


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A picture of 40 x 20 pixels, left half red, right half green, top row blue."""
    pixels = np.zeros((20, 40, 3), np.uint8)
    pixels[:, :20, 0] = pixels[:, 20:, 1] = 188
    pixels[0] = (0, 0, 188)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


def run(*options: Any) -> int:
    return main(["render", str(MINI_HEAD), "--size", "64x48", *map(str, options)])


# --- the environment -----------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [0.0, 90.0])
@pytest.mark.parametrize("wall", WALLS, ids=str)
def test_a_camera_sees_the_wall_that_it_looks_at(wall, rotation, mesh, renderer, room):
    # The camera looks along the wall's direction, and the mesh covers the image's middle at most.
    away = -np.array(wall, float)
    azimuth, elevation = math.degrees(math.atan2(away[0], away[2])), 90.0 * away[1]
    camera = fr.Camera(azimuth, elevation, zoom=0.5)
    environment = replace(room, rotation=rotation, scale=0.5)
    frame = renderer.render(fr.Scene(mesh, camera, (), 0.1, "environment", environment))
    cos, sin = (round(f(math.radians(rotation))) for f in (math.cos, math.sin))
    x, y, z = wall
    expected = WALLS[x * cos - z * sin, y, x * sin + z * cos]
    corner = frame.linear[2, 2]
    assert corner[3] == 0.0
    np.testing.assert_allclose(corner[:3], np.multiply(expected, 0.5), atol=1e-5)


def gradient(rows: int = 128) -> fr.Environment:
    """An environment with smooth colours: the mean of each direction's components with 1."""
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * rows) + 0.5) / rows)
    x, z = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
    y = np.sin(elevation) + 0.0 * azimuth
    return fr.Environment(fr.Panorama("smooth", np.float32(np.stack([x, y, z], -1) + 1.0)))


def test_each_pixel_shows_the_direction_of_its_ray(mesh, renderer):
    scene = fr.Scene(mesh, "three-quarter", (), 0.0, "environment", gradient())
    for distortion in (None, (-0.3, 0.1, 0.01, -0.01, 0.0)):
        k = ((70.0, 0.0, 30.0), (0.0, 70.0, 25.0), (0.0, 0.0, 1.0))
        pose = fr.view_of(scene, SIZE[0] / SIZE[1]).extrinsics(mesh)
        camera = fr.Camera(extrinsics=pose, intrinsics=k, size=SIZE, distortion=distortion)
        frame = renderer.render(replace(scene, camera=camera))
        seen = frame.linear[..., :3][frame.linear[..., 3] == 0.0] - 1.0
        assert len(seen) > 500
        # Points far away along the seen directions project to the pixels that show them.
        centre = -pose[:, :3].T @ pose[:, 3]
        pixels, _ = fr.view_of(replace(scene, camera=camera), SIZE[0] / SIZE[1]).project(
            mesh, centre + 1e4 * mesh.radius * seen, SIZE
        )
        rows, columns = np.nonzero(frame.linear[..., 3] == 0.0)
        off = np.abs(pixels - np.stack([columns, rows], axis=-1) - 0.5)
        assert off.max() < 0.25


def test_a_background_needs_its_environment(mesh, renderer, capsys, tmp_path):
    message = "background = 'environment' needs an environment map: add --environment FILE"
    with pytest.raises(fr.InputError, match=message):
        renderer.render(fr.Scene(mesh, background="environment"))
    assert run("--background", "environment", "-o", tmp_path / "a.png") == 2
    assert message in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_exposure_and_tone_change_the_environment(mesh, renderer, room):
    frame = renderer.render(
        fr.Scene(mesh, "front", (), 0.1, "environment", replace(room, scale=0.2))
    )
    background = frame.linear[..., 3] == 0.0
    exposed = replace(frame, linear=frame.linear * np.float32([2, 2, 2, 1]))
    assert (frame.srgb8(1.0)[background] == exposed.srgb8()[background]).all()
    bright = replace(frame, linear=frame.linear * np.float32([10, 10, 10, 1]))
    assert bright.srgb8()[background].max() == 255 > bright.srgb8(0.0, "neutral")[background].max()


# --- images --------------------------------------------------------------------------------------


def test_an_image_covers_the_background_and_keeps_its_aspect(photo, mesh, renderer):
    sources = photo, str(photo), np.asarray(Image.open(photo)), None
    linear = srgb_to_linear(np.asarray(Image.open(photo)) / 255.0).astype(np.float32)
    frames = [
        renderer.render(fr.Scene(mesh, background=linear if source is None else source))
        for source in sources
    ]
    for frame in frames:
        image, clear = frame.srgb8(), frame.linear[..., 3] == 0.0
        assert not frame.transparent
        assert image.shape == (48, 64, 3)
        # 64 x 48 shows 26.7 x 20 of the 40 x 20 pixels.
        assert np.abs(image[20, 2].astype(int) - (188, 0, 0)).max() <= 1
        assert np.abs(image[20, 61].astype(int) - (0, 188, 0)).max() <= 1
        assert np.abs(image[0, 30].astype(int) - (0, 0, 188)).max() <= 1
        np.testing.assert_allclose(frame.linear[clear], frames[0].linear[clear], atol=1e-6)
        for other in (frame.srgb8(1.0), frame.srgb8(-2.0, "neutral")):
            assert (other[clear] == image[clear]).all()
            assert (other[~clear] != image[~clear]).any()
    assert frames[0].metadata["background"] == "photo.png"


def test_the_edge_of_the_mesh_mixes_radiance_and_image(photo, mesh, renderer):
    clear = renderer.render(fr.Scene(mesh, background=None))
    frame = renderer.render(fr.Scene(mesh, background=photo))
    coverage = clear.linear[..., 3:]
    assert ((coverage > 0.0) & (coverage < 1.0)).any()
    behind = frame.background
    for stops in (0.0, -1.5):
        expected = clear.linear[..., :3] * 2.0**stops + (1.0 - coverage) * behind
        shown = srgb_to_linear(frame.srgb8(stops) / 255.0)
        np.testing.assert_allclose(shown, np.clip(expected, 0, 1), atol=5e-3)
    # Neutral maps the straight colour, which the transparent image has.
    straight = srgb_to_linear(clear.srgb8(-1.0, "neutral")[..., :3] / 255.0)
    shown = srgb_to_linear(frame.srgb8(-1.0, "neutral") / 255.0)
    np.testing.assert_allclose(shown, coverage * straight + (1 - coverage) * behind, atol=1e-2)


def test_transparent_pixels_of_an_image_lie_on_black(mesh, renderer):
    pixels = np.full((4, 4, 4), 200, np.uint8)
    pixels[..., 3] = 0
    frame = renderer.render(fr.Scene(mesh, background=pixels))
    assert not frame.transparent
    assert frame.srgb8()[0, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("only", ["specular", "albedo", "depth", "mask"])
def test_data_images_and_terms_have_no_image_behind_them(only, photo, mesh, renderer):
    images = [
        renderer.render(fr.Scene(mesh, background=background), only=only).linear
        for background in (photo, (0.0, 0.0, 0.0))
    ]
    np.testing.assert_array_equal(*images)


def test_albedo_keeps_a_background_colour_at_any_exposure(mesh, renderer):
    frame = renderer.render(fr.Scene(mesh, background=(0.5, 0.0, 0.25)), only="albedo")
    assert frame.srgb8()[0, 0].tolist() == frame.srgb8(-3.0)[0, 0].tolist() == [188, 0, 137]


def test_exposure_zero_changes_no_byte_and_frames_can_be_pickled(mesh, renderer, photo):
    frame = renderer.render(fr.Scene(mesh, background=photo))
    copy = pickle.loads(pickle.dumps(frame))
    assert copy.encoded("png", -1.0) == frame.encoded("png", -1.0)
    bare = fr.Frame(frame.linear, None, False, frame.metadata)  # its background is unknown
    assert bare.encoded() == frame.encoded()


# --- command line, files and batches -------------------------------------------------------------


def test_scene_file_option_and_sheet_show_an_image(photo, tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(f"background = {json.dumps(str(photo))}\n")
    assert run("--scene", tmp_path / "scene.toml", "-o", tmp_path / "a.png") == 0
    assert run("--background", photo, "-o", tmp_path / "b.png") == 0
    a, b = (np.asarray(Image.open(tmp_path / name)) for name in ("a.png", "b.png"))
    assert (a == b).all()
    assert np.abs(a[20, 2].astype(int) - (188, 0, 0)).max() <= 1
    sheet = "--camera", "turntable:3", "--sheet", "--exposure=-1", "-o", tmp_path / "c.png"
    assert run("--background", photo, *sheet) == 0
    cells = np.asarray(Image.open(tmp_path / "c.png"))
    for top, left in ((0, 0), (0, 64), (48, 0), (48, 64)):  # the last cell is empty
        assert np.abs(cells[top + 20, left + 2].astype(int) - (188, 0, 0)).max() <= 1
    text = "".join(Image.open(tmp_path / "c.png").text.values())
    assert "photo.png" in text
    assert str(tmp_path) not in text
    assert f'background = "{photo}"' in fr.Job(background=photo).toml()
    assert fr.Job.from_dict(fr.Job(background=photo).as_dict()) == fr.Job(background=photo)
    with pytest.raises(fr.InputError, match="background = .*: give a path: files cannot contain"):
        fr.Job(background=np.zeros((2, 2, 3))).as_dict()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("red", "background = 'red': give a number in .*environment.* or an image file"),
        ("missing.png", "cannot read missing.png: no such file or directory; give an image file"),
        (__file__ + ".png", "no such file or directory; give an image file"),
    ],
)
def test_messages_of_backgrounds(value, message, tmp_path, capsys):
    assert run("--background", value, "-o", tmp_path / "a.png") == 2
    assert re.search(message, capsys.readouterr().err)
    assert [*tmp_path.iterdir()] == []


def test_an_image_that_is_read_is_not_overwritten(photo, capsys):
    before = photo.read_bytes()
    assert run("--background", photo, "-o", photo) == 2
    assert "is both input and output" in capsys.readouterr().err
    assert photo.read_bytes() == before


def test_the_key_of_a_job_depends_on_the_content_of_its_background(photo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def key(**row: Any) -> str:
        Path("rows.jsonl").write_text(json.dumps(row))
        forget_files()
        (result,) = JobTable("rows.jsonl")
        return key_of(result)

    first = key(background="photo.png")
    Path("copy.png").write_bytes(photo.read_bytes())
    assert key(background="copy.png") == key(background=str(photo)) == first
    Image.new("RGB", (8, 8)).save("photo.png")
    assert len({first, key(background="photo.png"), key(tone="neutral"), key()}) == 4
    assert key(background="none") != key(background=[0.1, 0.2, 0.3])
    Path("rows.jsonl").write_text('{"tone": "warm"}')
    assert [*(table := JobTable("rows.jsonl"))] == []
    assert table.faults == [
        "rows.jsonl, row 1 (line 1): unknown tone 'warm'; known: linear, neutral"
    ]


# --- tone and clipping ---------------------------------------------------------------------------

# Results of pbrNeutral.glsl of KhronosGroup/ToneMapping in float64.
NEUTRAL = {
    (0.0, 0.0, 0.0): (0.0, 0.0, 0.0),
    (0.04, 0.04, 0.04): (0.01, 0.01, 0.01),
    (0.5, 0.25, 0.1): (0.46, 0.21, 0.06),
    (0.8, 0.5, 0.08): (0.76, 0.46, 0.04),
}


def specified(color: np.ndarray) -> np.ndarray:
    """Return the result of the formulas in Khronos' specification, in float64, for one colour."""
    f90, ks, kd = 0.04, 0.8 - 0.04, 0.15
    x = min(color)
    f = x - x * x / (4.0 * f90) if x <= 2.0 * f90 else f90
    p = max(color) - f
    if p <= ks:
        return color - f
    pn = 1.0 - (1.0 - ks) ** 2 / (p + 1.0 - 2.0 * ks)
    g = 1.0 / (kd * (p - pn) + 1.0)
    return (color - f) * pn / p * g + pn * (1.0 - g)


def test_neutral_is_the_tone_mapper_of_khronos():
    for color, expected in NEUTRAL.items():
        np.testing.assert_allclose(neutral(np.float32([color]))[0], expected, atol=1e-7)
        np.testing.assert_allclose(specified(np.array(color)), expected, atol=1e-12)
    # Grey 1: peak 0.96, compressed to 1 - 0.0576 / 0.44; red 10: 1 - 0.0576 / 9.48, desaturated.
    np.testing.assert_allclose(neutral(np.ones((1, 3), np.float32))[0], 0.8690909, atol=1e-6)
    np.testing.assert_allclose(
        neutral(np.float32([[10.0, 0.0, 0.0]]))[0], (0.993924, 0.5711416, 0.5711416), atol=1e-6
    )
    colors = np.random.default_rng(0).exponential(1.0, (2000, 3)) ** 2
    expected = np.array([specified(color) for color in colors])
    np.testing.assert_allclose(neutral(colors.astype(np.float32)), expected, atol=2e-6)
    assert neutral(np.float32([[1e30, 1.0, 0.0]])).max() <= 1.0


def test_neutral_maps_radiance_only(mesh, renderer, tmp_path):
    scene = fr.Scene(mesh, lights="0,0,12", background=None)
    image, albedo = (renderer.render(scene, only=only) for only in (None, "albedo"))
    color = image.linear[..., :3] / np.maximum(image.linear[..., 3:], 1e-6)
    expected = np.array([specified(each) for each in color.reshape(-1, 3).astype(float)])
    shown = srgb_to_linear(image.srgb8(0.0, "neutral")[..., :3].reshape(-1, 3) / 255.0)
    np.testing.assert_allclose(shown, expected, atol=5e-3)
    assert (albedo.srgb8(0.0, "neutral") == albedo.srgb8()).all()
    image.save(tmp_path / "a.png", tone="neutral")
    assert Image.open(tmp_path / "a.png").text["tone"] == "neutral"
    assert "tone" not in Image.open(BytesIO(albedo.encoded(tone="neutral"))).text
    assert image.encoded("exr") == image.encoded("exr", tone="neutral")
    with pytest.raises(fr.InputError, match="unknown tone 'warm'; known: linear, neutral"):
        image.srgb8(0.0, "warm")


def clipped(frame: fr.Frame, stops: float) -> float:
    """Return the fraction of the covered pixels that are brighter than white."""
    covered = frame.linear[..., 3] > 0.99
    return float((frame.linear[covered, :3].max(axis=-1) * 2.0**stops > 1.0).mean())


@pytest.mark.parametrize("background", ["none", (0.9, 0.9, 0.9)])
def test_the_exposure_of_the_warning_prevents_clipping(background):
    mesh = fr.load_mesh(MINI_HEAD)
    with fr.Renderer((700, 600), samples=1) as renderer:
        frame = renderer.render(fr.Scene(mesh, lights="-40,30,5", background=background))
    for stops in (0.0, 1.0):
        with pytest.warns(fr.FacerenderWarning) as found:
            frame.encoded(exposure=stops)
        assert len(found) == 1
        form = (
            r"([\d.]+) % of the covered pixels are brighter than white: give --exposure (-[\d.]+)"
        )
        match = re.fullmatch(form + ", or --tone neutral", str(found[0].message))
        assert float(match[1]) == pytest.approx(100.0 * clipped(frame, stops), abs=0.051)
        assert clipped(frame, float(match[2])) <= 0.01 < clipped(frame, float(match[2]) + 0.1)
        frame.encoded(exposure=stops)  # an equal warning is emitted once
    frame.encoded(exposure=float(match[2]))
    frame.encoded(tone="neutral")
    frame.encoded("exr", 5.0)


def test_a_loop_of_frames_warns_once(renderer):
    scene = fr.Scene(MINI_HEAD, lights="-40,30,8")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for camera in fr.turntable("front", 5):
            renderer.render(replace(scene, camera=camera)).encoded()
    assert len(found) == 1


@pytest.mark.parametrize("name", ["a.png", "a.gif"])
def test_a_turntable_prints_one_warning(name, tmp_path, capsys):
    options = "--camera", "turntable:3", "--light=-40,30,8", "-o", tmp_path / name
    assert run(*options) == 0
    assert capsys.readouterr().err.count("brighter than white: give --exposure") == 1
    assert run(*options, "--tone", "neutral") == 0
    assert capsys.readouterr().err == ""
    assert run("--budget", "1/255", "--tone", "neutral", "-o", tmp_path / "b.png") == 2
    assert "leave --tone neutral out" in capsys.readouterr().err
