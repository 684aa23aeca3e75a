"""Tests ``facerender views``: the standard views of one or several scans in one frame and scale,
and the sheet of changes."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.comparison.pictures import INWARDS, OUTWARDS, changes
from tests.awkward_files import MINI_HEAD
from tests.test_cli import assert_error

VIEWS = [*fr.STANDARD_VIEWS]
SIZE = ("--size", "96")


@pytest.fixture(scope="module")
def mini():
    return fr.load_mesh(MINI_HEAD)


def write_obj(path, mesh, change=lambda points: points, scale=1.0):
    """Write the positions of a mesh, changed, as an OBJ file."""
    (part,) = mesh.parts
    points = scale * change(part.positions)
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in points]
    lines += [f"f {a} {b} {c}" for a, b, c in part.faces + 1]
    path.write_text("\n".join(lines))
    return path


def chin(mesh):
    """Return the foremost point of the chin, found from the eyes."""
    face, points = fr.find_face(mesh), mesh.parts[0].positions
    below = face.eyes.mean(axis=0) - 1.6 * face.eye_distance * face.up
    near = np.abs((points - below)[:, :2]).max(axis=1) < 0.25 * face.eye_distance
    return points[near][points[near][:, 2].argmax()]


def advanced(mesh, depth=0.005, width=0.018):
    """Return a function that moves the chin forwards, as an operation does."""
    centre = chin(mesh)

    def change(points):
        weight = np.exp(-((points - centre) ** 2).sum(axis=1) / (2.0 * width**2))
        return points + depth * weight[:, None] * [0.0, 0.0, 1.0]

    return change


def image_of(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def covered(path):
    """Return which pixels of an image differ from the grey background in its corner."""
    pixels = image_of(path)
    return np.abs(pixels - pixels[0, 0]).max(axis=-1) > 8


def test_the_views_of_a_scan(cli):
    status, out, _ = cli.run("views", MINI_HEAD, *SIZE, "-o", cli.folder, "--json")
    assert status == 0
    data = json.loads(out)
    names = [f"mini_head-{view}.png" for view in VIEWS] + ["sheet.png"]
    assert data["output"] == [str(cli.folder / name) for name in names]
    assert cli.written == sorted(names)
    texts = [Image.open(cli.folder / name).text for name in names[:-1]]
    assert {text["scale"] for text in texts} == {data["scale"]}
    assert all("follow=True" in text["light 0"] for text in texts)
    grey = image_of(cli.folder / names[0])[0, 0]
    assert grey.tolist() == [118, 118, 118]
    sheet = image_of(cli.folder / "sheet.png")
    assert sheet.shape[0] > 2 * 96
    assert sheet.shape[1] > 4 * 96
    right, left = (
        covered(cli.folder / f"mini_head-{side}-lateral.png") for side in ("right", "left")
    )
    assert (right == left[:, ::-1]).mean() > 0.98  # a symmetric head


def test_other_cameras_become_orthographic(cli):
    line = ["views", MINI_HEAD, *SIZE, "--camera", "frontal", "--camera=-30,10", "-o", cli.folder]
    assert cli.run(*line)[0] == 0
    assert cli.written == ["mini_head--30_10.png", "mini_head-frontal.png", "sheet.png"]
    scales = {Image.open(cli.folder / name).text["scale"] for name in cli.written[:2]}
    assert len(scales) == 1


def test_two_scans_have_one_frame(cli, mini, tmp_path):
    before = write_obj(tmp_path / "before.obj", mini)
    after = write_obj(tmp_path / "after.obj", mini, advanced(mini))
    line = ["views", before, after, "--mm-per-pixel", "1.5", "--size", "200", "-o", cli.folder]
    status, out, _ = cli.run(*line)
    assert status == 0
    low, high = map(float, re.match(r"changes from (\S+) \(inwards\) to (\S+) mm", out).groups())
    assert low == pytest.approx(0.0, abs=0.6)  # a pixel is 1.5 mm wide
    assert high == pytest.approx(5.0, abs=0.3)
    names = [f"{stem}-{view}.png" for stem in ("before", "after") for view in VIEWS]
    assert cli.written == sorted([*names, "sheet.png", "changes.png"])
    # The chin moves by 5 mm, the rest of the profile stays.
    ends = [covered(cli.folder / f"{stem}-right-lateral.png") for stem in ("before", "after")]
    outermost = [np.where(rows.any(axis=1), 199 - rows[:, ::-1].argmax(axis=1), 0) for rows in ends]
    moved = 1.5 * (outermost[1] - outermost[0])
    assert moved.max() == pytest.approx(5.0, abs=1.6)
    assert (np.abs(moved) <= 1.5).mean() > 0.8
    # The sheet of changes is red at the chin, and grey elsewhere.
    sheet = image_of(cli.folder / "changes.png")
    red = sheet[..., 0] - sheet[..., 2]
    frontal = red[: sheet.shape[0] // 2, : sheet.shape[1] // 4]
    rows, columns = np.nonzero(frontal > 60)
    assert len(rows) > 50
    assert columns.mean() == pytest.approx(frontal.shape[1] / 2, abs=8)
    assert rows.mean() > 0.55 * len(frontal)
    assert frontal.min() > -30


def test_scans_in_other_units_and_places(cli, mini, tmp_path):
    metres = write_obj(tmp_path / "a.obj", mini)
    millimetres = write_obj(tmp_path / "b.obj", mini, scale=1000.0)
    elsewhere = write_obj(tmp_path / "c.obj", mini, lambda points: points + [0.0, 1.3, 0.2])
    line = ["views", metres, millimetres, elsewhere, "--camera", "frontal", *SIZE, "-o", cli.folder]
    _, _, err = cli.run(*line)
    assert "the face of c.obj is not where that of a.obj is" in err
    assert "changes are not drawn; give --register" in err
    assert "changes.png" not in cli.written
    a, b, c = (image_of(cli.folder / f"{name}-frontal.png") for name in "abc")
    assert np.abs(a - b).max() <= 2
    assert np.abs(a - c).mean() < 0.5


def test_labels_name_the_scans(cli):
    line = ["views", MINI_HEAD, MINI_HEAD, "--camera", "frontal", *SIZE, "-o", cli.folder]
    assert cli.run(*line, "--labels", "before,after")[0] == 0
    assert cli.written == ["after-frontal.png", "before-frontal.png", "changes.png", "sheet.png"]
    cli.fail("--labels a with 2 scans: give a different name for each", *line, "--labels", "a")
    cli.fail("--labels a,a with 2 scans: give", *line, "--labels", "a,a")


def test_equal_names_are_numbered(cli, mini, tmp_path):
    paths = []
    for folder in ("before", "after"):
        (tmp_path / folder).mkdir()
        paths.append(write_obj(tmp_path / folder / "scan.obj", mini))
    cli.run("views", *paths, "--camera", "frontal", *SIZE, "-o", cli.folder)
    assert cli.written == ["changes.png", "scan-1-frontal.png", "scan-2-frontal.png", "sheet.png"]


def test_a_scan_that_cannot_be_read_leaves_no_image(cli, tmp_path):
    (tmp_path / "b.obj").write_text("v 0 0 0")
    status, out, err = cli.run("views", MINI_HEAD, tmp_path / "b.obj", "-o", cli.folder)
    assert_error(status, out, err, r"b\.obj")
    assert cli.written == []


def test_a_scene_file_replaces_the_light(cli, tmp_path):
    (tmp_path / "a.toml").write_text("lights = ['front']\nbackground = [0, 0, 0]\n")
    line = ["views", MINI_HEAD, "--camera", "frontal", "--scene", tmp_path / "a.toml"]
    cli.run(*line, *SIZE, "-o", cli.folder)
    text = Image.open(cli.folder / "mini_head-frontal.png").text
    assert "follow" not in text["light 0"]
    assert "light 1" not in text
    assert image_of(cli.folder / "mini_head-frontal.png")[0, 0].tolist() == [0, 0, 0]


def test_changes_are_distances_of_the_surface():
    """A plane with a slope of 45 degrees that moves along its normal by 2 mm."""
    rows = np.arange(40.0)[:, None].repeat(30, axis=1)
    before, after = rows, rows + 2.0 * np.sqrt(2.0)
    white = np.full((40, 30, 3), 255, dtype=np.uint8)
    sheet, distances = changes([(before, after), (after, before)], [white] * 2, "ab", 1.0, "mm")
    np.testing.assert_allclose(distances, (-2.0, 2.0), rtol=1e-3)
    cells = [sheet[-42:-2, x : x + 30] for x in (2, 34)]  # below titles, with gaps of 2 pixels
    outwards, inwards = (cell[20].mean(axis=0) for cell in cells)
    np.testing.assert_allclose(outwards, OUTWARDS, atol=2)
    np.testing.assert_allclose(inwards, INWARDS, atol=2)


def test_changes_at_outlines_are_distances_of_the_nearest_points():
    """A plane that ends three rows earlier, and a step that hides the plane behind it."""
    flat = np.zeros((96, 40))
    short, step, longer = flat.copy(), flat.copy(), flat.copy()
    short[90:] = np.nan
    longer[93:] = np.nan
    step[:40], moved = 30.0, flat.copy()
    moved[:42] = 30.0
    white = np.full((96, 40, 3), 255, dtype=np.uint8)
    _, distances = changes([(short, longer), (step, moved)], [white] * 2, "ab", 1.0, "mm")
    # The outermost row has no slope, and does not count.
    np.testing.assert_allclose(distances, (0.0, 2.0), atol=0.3)
