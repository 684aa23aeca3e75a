"""Data images, their metadata and the records of batches: blended parts, causes of empty images,
backgrounds, names of terms, and values that pass through."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import facerender as fr
from facerender.images.files import read_image
from facerender.scene.scene import ONLY
from tests import awkward_files as files
from tests.awkward_files import MINI_HEAD, mini_head
from tests.test_alpha import quad
from tests.test_cli import Capture, Cli

DATA = ("mask", "depth", "normal", "parts", "albedo", "cosines")
FACING = fr.Camera("front")


@pytest.fixture
def cli(tmp_path: Path, capsys: Capture) -> Cli:
    return Cli(tmp_path, capsys)


@pytest.fixture(scope="module")
def renderer(egl):
    with fr.Renderer(64, samples=1, backend=egl) as renderer:
        yield renderer


def two_sheets(**front: Any) -> fr.Mesh:
    """Return a small sheet before a large one; ``front``: values of the small one's material."""
    material = fr.Material(double_sided=False)
    return fr.Mesh.of(
        "two.glb",
        [quad(0.0, 2.0, name="back"), quad(1.0, 1.0, name="veil")],
        [material, replace(material, **front)],
    )


def half() -> fr.Texture:
    """Return an opacity map that is 0.8 on the left and 0.2 on the right."""
    return fr.Texture.from_array(np.repeat([[0.8, 0.2]], 2, axis=0).repeat(8, 0).repeat(8, 1))


def drawn(renderer: fr.Renderer, mesh: fr.Mesh, only: str) -> tuple[np.ndarray, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", fr.FacerenderWarning)
        image = renderer.render(fr.Scene(mesh, FACING), only=only).linear
    return image, [str(warning.message) for warning in caught]


# --- outputs of one drawing ----------------------------------------------------------------------


SCENES = {
    "opaque": lambda head: fr.Scene(two_sheets(), FACING),
    "blended": lambda head: fr.Scene(two_sheets(alpha="blend", opacity=0.6), FACING),
    "cut": lambda head: fr.Scene(two_sheets(alpha="blend", opacity_map=half()), FACING),
    "masked": lambda head: fr.Scene(two_sheets(alpha="mask", opacity_map=half()), FACING),
    "only blended": lambda head: fr.Scene(
        fr.Mesh.of("veil", [quad(0.0, 2.0)], [fr.Material(alpha="blend", opacity=0.6)]), FACING
    ),
    # Of the lashes, triangles that are nearly edge-on cover a pixel if they are drawn in the order
    # of blended parts.
    "lashes": lambda head: fr.Scene(fr.load_mesh(), fr.Camera(-33.397), background=(0.1, 0.2, 0.3)),
    "scattering": lambda head: fr.Scene(head.with_skin(scattering="skin"), fr.Camera(20.0)),
    "lens": lambda head: fr.Scene(
        head,
        fr.Camera(
            extrinsics=np.c_[np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.7]],
            intrinsics=((300.0, 0.0, 64.0), (0.0, 300.0, 64.0), (0.0, 0.0, 1.0)),
            size=(128, 128),
            distortion=(0.2, 0.05, 0.0, 0.0),
        ),
    ),
}


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("name", [*SCENES])
def test_outputs_together_equal_single_images(egl, head, name, samples):
    scene = SCENES[name](head)
    outputs = "image", *(only for only in ONLY if only != "motion")
    with fr.Renderer(256 if name == "lashes" else 128, samples=samples, backend=egl) as renderer:
        single = {only: renderer.render(scene, only=only) for only in outputs[1:]}
        single["image"] = renderer.render(scene)
        for names in (outputs, outputs[::-1], ("depth", "image"), ("mask", "normal")):
            frames = renderer.render_outputs(scene, names)
            assert [*frames] == [*names]
            for output, frame in frames.items():
                np.testing.assert_array_equal(frame.linear, single[output].linear, output)
                assert frame.only == single[output].only
                assert dict(frame.metadata) == dict(single[output].metadata)
    depth, mask, parts = (single[only].linear for only in ("depth", "mask", "parts"))
    np.testing.assert_array_equal(depth[..., 3], mask[..., 0])
    np.testing.assert_array_equal(depth[..., 0] > 0.0, parts[..., 0] > 0.0)


def test_outputs_are_named(renderer):
    scene = fr.Scene(two_sheets(), FACING)
    assert renderer.render_outputs(scene, ()) == {}
    assert [*renderer.render_outputs(scene, "depth")] == ["depth"]
    for outputs in ("colour", ("image", "colour"), (None,)):
        with pytest.raises(fr.InputError, match="give|known"):
            renderer.render_outputs(scene, outputs)


def test_frames_stay_as_they_are(renderer):
    scenes = [fr.Scene(two_sheets(), fr.Camera(azimuth)) for azimuth in range(0, 50, 10)]
    frames = [renderer.render_outputs(scene, ("image", "depth")) for scene in scenes]
    for scene, pair in zip(scenes, frames, strict=True):
        np.testing.assert_array_equal(pair["image"].linear, renderer.render(scene).linear)
        depth = renderer.render(scene, only="depth").linear
        np.testing.assert_array_equal(pair["depth"].linear, depth)


def test_an_empty_image_is_reported_once(renderer):
    away = fr.Scene(two_sheets(), fr.Camera(target=(50.0, 0.0, 0.0)))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows") as caught:
        renderer.render_outputs(away, ("image", "mask", "depth"))
    assert len(caught) == 1


# --- blended parts -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("front", "cut"),
    [
        ({"alpha": "blend", "opacity": 0.6}, {}),
        ({"alpha": "blend", "opacity": 0.5}, {}),
        ({"alpha": "blend", "opacity_map": half()}, {"alpha": "mask", "opacity_map": half()}),
        (
            {"alpha": "blend", "opacity_map": half(), "opacity": 0.7},
            {"alpha": "mask", "opacity_map": half(), "opacity": 0.7},
        ),
    ],
    ids=["factor", "at the threshold", "map", "map and factor"],
)
def test_blended_parts_count_where_they_are_opaque(renderer, front, cut):
    for only in DATA:
        blended, messages = drawn(renderer, two_sheets(**front), only)
        expected, _ = drawn(renderer, two_sheets(**cut), only)
        np.testing.assert_array_equal(blended, expected)
        assert messages == []


def test_a_blended_part_below_the_threshold_is_named(renderer):
    mesh = two_sheets(alpha="blend", opacity=0.3)
    mask, messages = drawn(renderer, mesh, "parts")
    assert set(np.unique(mask[..., 0])) == {0.0, 1.0}
    assert messages == [
        "data images and landmarks omit parts of two.glb whose opacity is below 0.5 everywhere: "
        "veil; give a lower --alpha-threshold to include them"
    ]
    assert drawn(renderer, mesh, "mask")[1] == []  # once for each mesh


def test_the_threshold_is_a_setting(egl):
    mesh = two_sheets(alpha="blend", opacity_map=half())
    counts = []
    for threshold in (0.0, 0.1, 0.5, 0.9):
        with fr.Renderer(64, samples=1, backend=egl, alpha_threshold=threshold) as renderer:
            parts, messages = drawn(renderer, mesh, "parts")
            counts.append(int((parts[..., 0] == 2.0).sum()))
            assert bool(messages) is (threshold == 0.9)
    assert counts[0] == counts[1] > 1.9 * counts[2] > 0 == counts[3]
    for value in (-0.1, 1.5, "x"):
        with pytest.raises(fr.InputError, match="alpha_threshold"):
            fr.Renderer(64, alpha_threshold=value)


def test_parts_that_transmit_light_stay_out(renderer):
    clear = two_sheets(alpha="blend", opacity=0.9, transmission=1.0)
    parts, messages = drawn(renderer, clear, "parts")
    assert set(np.unique(parts[..., 0])) == {0.0, 1.0}
    assert messages == []


def test_blended_parts_hide_landmarks(renderer):
    mesh = two_sheets(alpha="blend", opacity_map=half())
    # Points of the large sheet behind the opaque and the clear half of the small one.
    weights = np.array([[0.6, 0.4, 0.0], [0.4, 0.6, 0.0]])
    corners = np.array([[0, 2, 0], [0, 2, 0]])
    points = fr.Landmarks(("left", "right"), corners, weights, ("back", "back"))
    scene = fr.Scene(mesh, FACING)
    _, _, visible = renderer.landmarks(scene, points)
    assert visible.tolist() == [False, True]


def test_motion_counts_blended_parts(renderer):
    mesh = two_sheets(alpha="blend", opacity=0.8)
    before = fr.Scene(mesh, fr.Camera("front", target=(0.1, 0.0, 0.0)))
    scene = fr.Scene(mesh, fr.Camera("front", target=(0.0, 0.0, 0.0)), before=before)
    motion = renderer.render(scene, only="motion").linear
    opaque = two_sheets()
    expected = renderer.render(
        replace(scene, mesh=opaque, before=replace(before, mesh=opaque)), only="motion"
    ).linear
    np.testing.assert_array_equal(motion, expected)
    assert len(np.unique(np.round(motion[motion[..., 3] > 0.0][:, 0], 3))) > 1


def test_blended_parts_cast_no_shadow_in_data(renderer):
    mesh = two_sheets(alpha="blend", opacity=0.8)
    lights = (fr.Light(40.0, 30.0, shadow=True),)
    image = renderer.render(fr.Scene(mesh, FACING, lights=lights), only="visibility").linear
    assert (image[image[..., 3] > 0.0][:, 0] == 1.0).all()


def test_the_image_itself_still_blends(renderer):
    clear, opaque = (
        renderer.render(fr.Scene(two_sheets(**front), FACING)).linear
        for front in (
            {"alpha": "blend", "opacity": 0.6, "albedo": (1, 0, 0)},
            {"albedo": (1, 0, 0)},
        )
    )
    assert np.abs(clear - opaque).max() > 0.05


def glb(folder: Path, **material: Any) -> Path:
    path = folder / "a.glb"
    return files.write_glb(path, mini_head(), material={"alphaMode": "BLEND", **material})


def test_a_batch_names_parts_below_the_threshold(cli):
    pale = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.3]}}
    path = glb(cli.folder, name="Veil", **pale)
    rows = [
        {"mesh": str(path), "image.size": 24, "outputs": ["mask", "depth"]},
        {"mesh": str(path), "image.size": 24, "outputs": ["mask"], "image.alpha_threshold": 0.2},
    ]
    (cli.folder / "jobs.jsonl").write_text("\n".join(map(json.dumps, rows)))
    command = ("batch", cli.folder / "jobs.jsonl", "-o", cli.folder / "out", "--workers", "1")
    assert cli.run(*command)[0] == 0
    lines = (cli.folder / "out" / "jobs.jsonl").read_text().splitlines()
    first, second = map(json.loads, lines)
    assert any("whose opacity is below 0.5 everywhere" in text for text in first["warnings"])
    assert "warnings" not in second
    masks = [
        np.asarray(Image.open(cli.folder / "out" / record["files"]["mask.png"]["path"]))
        for record in (first, second)
    ]
    assert [bool(mask.any()) for mask in masks] == [False, True]


# --- images that show nothing --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("front", "camera", "only", "message"),
    [
        ({"alpha": "blend", "opacity": 0.3}, FACING, "mask", "0.3; give a lower --alpha-"),
        ({"alpha": "mask", "opacity": 0.4}, FACING, None, "is at most 0.4; give --part '*,alpha="),
        ({"alpha": "blend", "opacity": 0.0}, FACING, None, "is at most 0; give --part"),
        ({}, fr.Camera(180.0), "depth", "shows only back faces; give --double"),
        ({}, fr.Camera(180.0), None, "shows only back faces"),
        ({"transmission": 1.0}, FACING, "mask", "transmits light, and data images omit such parts"),
        ({}, fr.Camera(zoom=0.01), "mask", "pixels large; move the camera nearer"),
    ],
)
def test_the_cause_of_an_empty_image_is_named(renderer, front, camera, only, message):
    material = fr.Material(**{"double_sided": False, **front})
    mesh = fr.Mesh.of("one.glb", [quad()], [material])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", fr.FacerenderWarning)
        renderer.render(fr.Scene(mesh, camera), only=only)
    texts = [str(warning.message) for warning in caught]
    (text,) = [text for text in texts if text.startswith("no pixel shows one.glb: ")]
    assert message in text


# --- presets -------------------------------------------------------------------------------------


# --- backgrounds and metadata --------------------------------------------------------------------


def test_albedo_has_the_background_that_is_asked_for(cli):
    plain = cli.render("--only", "albedo")
    assert (plain[0, 0] == 0).all()
    white = cli.render("--only", "albedo", "--background", "1,1,1")
    assert (white[0, 0] == 255).all()
    covered = cli.render("--only", "mask")[..., 0] > 0
    np.testing.assert_array_equal(white[covered], plain[covered])
    clear = cli.render("--only", "albedo", "--background", "none")
    assert clear[0, 0].tolist() == [0, 0, 0, 0]
    assert (cli.render("--only", "depth", "--background", "1,1,1")[0, 0] == 0).all()


@pytest.mark.parametrize("only", ["specular", "normal", "mask", "parts", "cosines"])
def test_metadata_name_the_term_and_its_range(only, cli):
    cli.render("--only", only)
    metadata = read_image(cli.png).metadata
    assert metadata["only"] == only
    assert metadata["range"]
    cli.render()
    assert "only" not in read_image(cli.png).metadata


def test_an_8_bit_depth_image_states_its_scale(cli):
    pixels = cli.render("--only", "depth", "--background", "none").astype(float)
    text = read_image(cli.png).metadata["range"]
    near, far = (float(word.rstrip(",")) for word in text.split() if "." in word)
    depth = fr.render(MINI_HEAD, size=48, only="depth").linear
    covered = depth[..., 3] > 0.0
    found = near + (255.0 - pixels[..., 0][covered]) / (255.0 - 26.0) * (far - near)
    np.testing.assert_allclose(found, depth[..., 0][covered], atol=0.005 * (far - near))
    assert text == f"255 at {near:.6g}, 26 at {far:.6g} mesh units"


def test_no_key_of_a_png_is_a_setting_of_imagemagick(cli):
    cli.render()
    with Image.open(cli.png) as image:
        info = dict(image.info)
    assert {"background", "alpha"}.isdisjoint(info)
    assert info["facerender:background"]
    assert read_image(cli.png).metadata["background"] == info["facerender:background"]
    assert cli.run("compare", cli.png, cli.png)[0] == 0


# --- batches -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "toml"])
def test_meta_columns_pass_through(suffix, cli):
    table = {
        "csv": f"mesh,image.size,meta.age,meta.subject,m\n{MINI_HEAD},16,041,a b,0.3\n"
        f"{MINI_HEAD},16,,x,9\n",
        "jsonl": json.dumps(
            {"mesh": str(MINI_HEAD), "image.size": 16, "meta": {"age": 41, "tags": ["a", 1]}}
        ),
        "toml": f'mesh = "{MINI_HEAD}"\nimage.size = 16\n[meta]\nage = 41\n[grid]\n'
        '"meta.side" = ["left", "right"]\n',
    }[suffix].replace(",m\n", ",material.m\n")
    path = cli.folder / f"jobs.{suffix}"
    path.write_text(table)
    if suffix == "csv":
        path.write_text(table.rpartition(f"{MINI_HEAD}")[0])
    status, _, err = cli.run("batch", path, "-o", cli.folder / "out", "--workers", "1")
    assert status == 0, err
    lines = (cli.folder / "out" / "jobs.jsonl").read_text().splitlines()
    expected = {
        "csv": [{"age": "041", "subject": "a b"}],
        "jsonl": [{"age": 41, "tags": ["a", 1]}],
        "toml": [{"age": 41, "side": side} for side in ("left", "right")],
    }[suffix]
    assert [json.loads(line)["meta"] for line in lines] == expected


def test_meta_stays_with_jobs_that_fail_and_changes_with_the_table(cli):
    path = cli.folder / "jobs.jsonl"
    row = {"mesh": str(cli.folder / "none.glb"), "image.size": 16, "meta.age": 3}
    path.write_text(json.dumps(row))
    command = ("batch", path, "-o", cli.folder / "out", "--workers", "1")
    assert cli.run(*command)[0] == 3
    failed = json.loads((cli.folder / "out" / "failed.jsonl").read_text().splitlines()[0])
    assert failed["meta"] == {"age": 3}
    for age in (4, 5):
        path.write_text(json.dumps({**row, "mesh": str(MINI_HEAD), "meta.age": age}))
        assert cli.run(*command)[0] == 0
        record = json.loads((cli.folder / "out" / "jobs.jsonl").read_text())
        assert record["meta"] == {"age": age}
    path.write_text(json.dumps({**row, "meta": 5} | {}).replace('"meta.age": 3, ', ""))
    assert "meta" in cli.run("batch", path, "--check", "-o", cli.folder / "out")[2]


def test_layers_have_no_background(cli):
    row = {"mesh": str(MINI_HEAD), "image.size": 16, "background": [0, 1, 0], "outputs": "layers"}
    (cli.folder / "jobs.jsonl").write_text(json.dumps(row))
    assert cli.run("batch", cli.folder / "jobs.jsonl", "-o", cli.folder / "out")[0] == 0
    record = json.loads((cli.folder / "out" / "jobs.jsonl").read_text())
    path = cli.folder / "out" / record["files"]["layers.exr"]["path"]
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    outside = channels["mask.A"] == 0.0
    assert outside.any()
    assert (channels["albedo.G"][outside] == 0.0).all()
    assert (channels["G"][outside] > 0.0).any()


# --- cameras -------------------------------------------------------------------------------------


def test_transforms_with_shared_intrinsics(tmp_path):
    pose = [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.9], [0, 0, 0, 1]]
    nerf = {"camera_angle_x": 0.6, "w": 80, "h": 60, "frames": [{"transform_matrix": pose}] * 2}
    (tmp_path / "a.json").write_text(json.dumps(nerf))
    first, second = fr.load_cameras(tmp_path / "a.json").values()
    assert first == second
    assert first.size == (80, 60)
    assert first.intrinsics[0][0] == pytest.approx(40 / np.tan(0.3))
    np.testing.assert_allclose(
        first.extrinsics, [[1, 0, 0, -0.1], [0, -1, 0, 0.2], [0, 0, -1, 0.9]]
    )
    lens = {**nerf, "fl_x": 90.0, "fl_y": 95.0, "cx": 41.0, "k1": -0.02, "camera_model": "OPENCV"}
    (tmp_path / "b.json").write_text(json.dumps(lens))
    camera = next(iter(fr.load_cameras(tmp_path / "b.json").values()))
    assert camera.intrinsics == ((90.0, 0.0, 41.0), (0.0, 95.0, 30.0), (0.0, 0.0, 1.0))
    assert camera.distortion[0] == -0.02
    blender = {"camera_angle_x": 0.6, "camera_angle_y": 0.4, "frames": nerf["frames"]}
    (tmp_path / "d.json").write_text(json.dumps(blender))
    camera = next(iter(fr.load_cameras(tmp_path / "d.json", (80, 60)).values()))
    assert camera.intrinsics[0][0] == pytest.approx(40 / np.tan(0.3))
    assert camera.intrinsics[1][1] == pytest.approx(30 / np.tan(0.2))
    for broken in (
        blender,
        {"frames": [{}]},
        {**nerf, "frames": [5]},
        {**nerf, "camera_model": "OPENCV_FISHEYE"},
        {**nerf, "frames": [{"transform_matrix": [[1]]}]},
        {**nerf, "camera_angle_x": 0},
        {**nerf, "frames": []},
    ):
        (tmp_path / "c.json").write_text(json.dumps(broken))
        with pytest.raises(fr.InputError, match=r"c\.json"):
            fr.load_cameras(tmp_path / "c.json")


def test_names_of_cameras_in_toml(cli):
    path = cli.folder / "rig.toml"
    path.write_text('[[cameras]]\nname = "left"\nazimuth = -30\n[[cameras]]\nazimuth = 30\n')
    assert [*fr.load_cameras(path)] == ["left", "rig_001"]
    options = ("--size", "16", "-o", cli.folder / "v-{name}.png")
    for option in ("--camera", "--scene"):
        assert cli.run("render", MINI_HEAD, option, path, *options)[0] == 0
    assert {"v-left.png", "v-rig_001.png", "v-camera_001.png"} <= {*cli.written}
    names = ("x_002", "x", "x", "x")
    path.write_text("".join(f'[[cameras]]\nname = "{name}"\n' for name in names))
    assert [*fr.load_cameras(path)] == ["x_002", "x", "x_002_002", "x_003"]
    path.write_text('[camera]\nname = "one"\n')
    assert [*fr.load_cameras(path)] == ["one"]
    path.write_text("[[cameras]]\nname = 5\n")
    cli.fail("camera name = 5: give text", "render", MINI_HEAD, "--camera", path, "-o", cli.png)
