"""Tests several views in one command, contact sheets and animations, and frames as files, images
and bytes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.commands.render import sheet
from facerender.images.animation import MOVING
from facerender.images.files import read_image
from tests.awkward_files import MINI_HEAD
from tests.conftest import require_module
from tests.test_cameras import glb

Run = Callable[..., tuple[int, list[str], str]]
SMALL = ("render", str(MINI_HEAD), "--size", "24", "--samples", "1")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.chdir(tmp_path)

    def call(*options: str) -> tuple[int, list[str], str]:
        status = main([*SMALL, *options])
        printed = capsys.readouterr()
        return status, printed.out.splitlines(), printed.err

    return call


@pytest.fixture(scope="module")
def frame() -> fr.Frame:
    return fr.render(MINI_HEAD, size=(24, 20), samples=1)


@pytest.fixture(scope="module")
def drawn() -> Iterator[Callable[[fr.Camera], Any]]:
    mesh = fr.load_mesh(MINI_HEAD)
    with fr.Renderer((24, 24), samples=1) as renderer:
        yield lambda camera: renderer.render(fr.Scene(mesh, camera)).srgb8()


def pixels(name: str) -> Any:
    return np.asarray(Image.open(name))


# --- several cameras -----------------------------------------------------------------------------


PATHS = {"40.toml": "azimuth = 40\nfov = 60", "two.toml": "azimuth = 40\n[[cameras]]\nzoom = 2"}
FACES = fr.turntable(fr.Camera(frame="face"), 3)
CAMERAS: dict[str, tuple[str, dict[str, fr.Camera]]] = {  # options; the camera of each file
    "a file each": (
        "--camera profile --camera 20,10,1.5 -o a.png",
        {"a_000.png": fr.Camera(-90.0), "a_001.png": fr.Camera(20.0, 10.0, zoom=1.5)},
    ),
    "turntable": (
        "--camera turntable:3 --frame face -o t.png",
        {f"t_00{number}.png": camera for number, camera in enumerate(FACES)},
    ),
    "scene file": (
        "--scene two.toml -o {index:d}.png",
        {"0.png": fr.Camera(40.0), "1.png": fr.Camera(zoom=2.0)},
    ),
    "option before a scene file": (
        "--scene two.toml --camera profile -o p.png",
        {"p.png": fr.Camera(-90.0)},
    ),
    "options before a camera file": (
        "--camera 40.toml --fov 30 --frame head -o p.png",
        {"p.png": fr.Camera(40.0, fov=30.0, frame="head")},
    ),
    "target": (
        "--target 0.01,0.02,0 --camera 5,0,3 -o t.png",
        {"t.png": fr.Camera(5.0, zoom=3.0, target=(0.01, 0.02, 0.0))},
    ),
}


@pytest.mark.first_case
@pytest.mark.parametrize("case", CAMERAS)
def test_cameras(run: Run, drawn, case: str):
    options, cameras = CAMERAS[case]
    for name, text in PATHS.items():
        Path(name).write_text(f"[[cameras]]\n{text}\n")
    assert run(*options.split()) == (0, [*cameras], "")
    for name, camera in cameras.items():
        assert np.array_equal(pixels(name), drawn(camera))


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("{name}.png", ["front.png", "30_5.png"]),
        ("{index:01d}-{name}.jpg", ["0-front.jpg", "1-30_5.jpg"]),
        ("x{index}.webp", ["x000.webp", "x001.webp"]),
        ("{}.png", ["{}_000.png", "{}_001.png"]),
    ],
)
def test_names_of_files(run: Run, pattern: str, names: list[str]):
    status, out, err = run("--camera", "front", "--camera", "30,5", "-o", pattern)
    assert (status, out, err) == (0, names, "")
    assert sorted(os.listdir()) == sorted(names)


def test_camera_files_set_the_size(run: Run, capsys: pytest.CaptureFixture[str]):
    k = [[60, 0, 20], [0, 50, 10], [0, 0, 1]]
    pose = np.column_stack([np.diag([1.0, -1, -1]), [0.0, 0.0, 1.0]]).tolist()
    table = {"K": k, "Rt": pose, "width": 40, "height": 20}
    Path("rig.json").write_text(json.dumps([table, table]))
    assert main([*SMALL[:2], "--camera", "rig.json", "-o", "c.png"]) == 0
    assert capsys.readouterr().out == "c_000.png\nc_001.png\n"
    assert pixels("c_000.png").shape == (20, 40, 3)
    status, out, err = run("--camera", "rig.json", "-o", "d.png")
    assert (status, out) == (2, [])
    assert "intrinsics are for images of 40 x 20 pixels: give a size with this aspect" in err
    assert sorted(os.listdir()) == ["c_000.png", "c_001.png", "rig.json"]
    status, _, err = run("--camera", "rig.json", "--target", "0,0,0", "-o", "d.png")
    assert "camera target = (0.0, 0.0, 0.0) and extrinsics exclude each other" in err


def test_cameras_of_the_mesh_file(run: Run, drawn, tmp_path: Path):
    mesh = fr.load_mesh(MINI_HEAD)
    place = (mesh.center + [0.0, 0.0, 5.0 * mesh.radius]).tolist()
    lens = {"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}
    nodes = [{"name": each, "camera": 0, "translation": place} for each in ("one", "two")]
    path = str(glb(tmp_path, nodes, [lens]))
    wanted = drawn(fr.Camera(position=tuple(place), fov=np.degrees(0.5)))
    for where in ("gltf", "gltf:two"):
        assert main(["render", path, *SMALL[2:], "--camera", where, "-o", "{name}.png"]) == 0
        assert np.abs(pixels("two.png").astype(int) - wanted).max() <= 1
    assert sorted(os.listdir()) == ["head.glb", "one.png", "two.png"]


def test_sheet(run: Run):
    options = ("--camera", "turntable:3", "--sheet", "--background", "0,0,1", "-o", "s.png")
    assert run(*options)[:2] == (0, ["s.png"])
    found = pixels("s.png")
    assert found.shape == (48, 48, 3)
    fr_mesh = fr.load_mesh(MINI_HEAD)
    with fr.Renderer((24, 24), samples=1) as renderer:
        for camera, place in zip(fr.turntable(count=3), ((0, 0), (0, 24), (24, 0)), strict=True):
            scene = fr.Scene(fr_mesh, camera, background=(0.0, 0.0, 1.0))
            tile = found[place[0] :, place[1] :][:24, :24]
            assert np.array_equal(tile, renderer.render(scene).srgb8())
    assert (found[24:, 24:] == (0, 0, 255)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("turntable:200", "--size", "1024"), "of 200 images is 15360 x 14336 pixels of 32 bytes"),
        (("turntable:3", "--size", "8193x1"), "16386 x 2 pixels of 32 bytes: at most 16384 a side"),
        (("turntable:9", "--memory", "1", "--size", "99"), "and 1 MiB; give a smaller size or few"),
    ],
)
def test_sheets_that_are_too_large_are_refused(run: Run, monkeypatch, options, message):
    monkeypatch.setattr(fr.Renderer, "of", None)  # drawing would fail
    status, out, err = run("--sheet", "-o", "s.png", "--camera", *options)
    assert (status, out) == (2, [])
    assert message in err
    assert os.listdir() == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--camera", "turntable:0"), "turntable:0: give turntable:N, with 1 to 3600 views"),
        (("--camera", "turntable:99999"), "turntable:99999: give turntable:N, with 1 to 3600"),
        (("--camera", "gltf:eye"), "mini_head.glb has no camera"),
        (("--target", "1,2"), "camera target = '1,2': give three numbers in"),
        (("--budget", "1/255", "--camera", "turntable"), "plans one view, and there are 8"),
        (("--camera", "0", "--camera", "1", "-o", "{name:d}.png"), "-o {name:d}.png: in braces"),
        (("--camera", "0", "--camera", "0", "-o", "a{index:.0s}.png"), "in braces give"),
        (("-o", "a.gif", "--background", "none"), ".gif cannot store transparency"),
        (("-o", "a.png", "--format", "exr"), "--format exr is for -o - only: the file name sets"),
        (("-o", "a.png", "--fps", "3"), "--fps 3 is for a .gif, .webp or .mp4 of several views"),
        (("-o", "-", "--camera", "turntable"), "-o - takes one image, and there are 8"),
    ],
)
def test_invalid_options_are_refused(run: Run, options: tuple[str, ...], message: str):
    given = options if "-o" in options else (*options, "-o", "a.png")
    status, out, err = run(*given)
    assert (status, out) == (2, [])
    assert message in err
    assert err.count("\n") == 1
    assert os.listdir() == []


# --- animations ----------------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animated_turntable(run: Run, drawn, suffix: str):
    options = ("--camera", "turntable:4", "--fps", "10", "-o", f"t{suffix}")
    assert run(*options) == (0, [f"t{suffix}"], "")
    with Image.open(f"t{suffix}") as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (4, (24, 24), 0)  # type: ignore[attr-defined]
        for number, camera in enumerate(fr.turntable(count=4)):
            image.seek(number)
            image.load()
            assert image.info["duration"] == 100
            off = np.asarray(image.convert("RGB")).astype(int) - drawn(camera)
            assert np.abs(off).mean() < 6.0


def test_a_movie(tmp_path: Path):
    exe = require_module("imageio_ffmpeg").get_ffmpeg_exe()
    steps = [np.full((21, 33, 3), (200 - 30 * i, 60, 30 * i), dtype=np.uint8) for i in range(6)]
    path = tmp_path / "m.mp4"
    fr.save_animation(path, iter(steps), fps=4)
    output = subprocess.run([exe, "-i", path], capture_output=True, text=True).stderr
    assert "Duration: 00:00:01.50" in output
    assert "34x22" in output
    subprocess.run([exe, "-loglevel", "error", "-i", path, tmp_path / "%d.png"], check=True)
    for number, step in enumerate(steps):
        found = pixels(str(tmp_path / f"{number + 1}.png"))[:20, :32].astype(int)
        assert np.abs(found - step[:20, :32]).max() <= 6
    fr.save_animation(path, steps[:2])
    assert {each.name for each in tmp_path.iterdir()} == {
        "m.mp4",
        *(f"{i}.png" for i in range(1, 7)),
    }


def encoder(folder: Path, script: str) -> str:
    path = folder / "ffmpeg"
    path.write_text(f"#!{script}\n")
    path.chmod(0o700)
    return str(path)


@pytest.mark.parametrize(
    ("script", "message"),
    [  # ends before it has read its input, writes more than a pipe holds, or writes nothing
        (
            "/bin/sh\necho first >&2\necho 'Unknown encoder' >&2\nexit 1",
            r".mp4 \(Unknown encoder\):",
        ),
        ("/bin/sh\nyes odd | head -c 300000 >&2\ncat >/dev/null\nexit 1", r"no .mp4 \(odd\):"),
        ("/bin/sh\nexit 1", r"wrote no .mp4 \(it ended early\):"),
        ("/bin/sh\nhead -c 9 >/dev/null\nexit 0", r"wrote no .mp4 \(it ended early\):"),
        (
            "/bin/sh\nfor name; do :; done\ncat >$name\nexit 1",
            r"wrote no .mp4 \(the file is incomplete\):",
        ),
        ("/bin/sh\ncat >/dev/null", r"wrote no .mp4 \(the file is incomplete\):"),
        ("/no/such/shell", "cannot start ffmpeg: no such file .*;"),
    ],
)
def test_failures_of_ffmpeg_are_reported(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    script: str,
    message: str,
):
    require_module("imageio_ffmpeg")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", encoder(tmp_path, script))
    many = (np.zeros((512, 512, 3), dtype=np.uint8) for _ in range(8))
    with pytest.raises(fr.InputError, match=f"{message} give .gif or .webp"):
        fr.save_animation(tmp_path / "a.mp4", many)
    assert [each.name for each in tmp_path.iterdir()] == ["ffmpeg"]
    assert capfd.readouterr() == ("", "")


def test_ffmpeg_that_is_not_executable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    require_module("imageio_ffmpeg")
    path = encoder(tmp_path, "/bin/sh")
    os.chmod(path, 0o600)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", path)
    with pytest.raises(fr.InputError, match="cannot start ffmpeg: permission denied; give .gif"):
        fr.save_animation(tmp_path / "a.mp4", [np.zeros((4, 4, 3), dtype=np.uint8)])


@pytest.mark.parametrize("error", [fr.InputError, BrokenPipeError, KeyboardInterrupt])
def test_ffmpeg_is_ended_if_the_images_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
):
    require_module("imageio_ffmpeg")
    process = tmp_path / "process"
    script = f"/bin/sh\necho $$ >{process}.new\nmv {process}.new {process}\nexec cat >/dev/null"
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", encoder(tmp_path, script))

    def images() -> Iterator[np.ndarray]:
        yield np.zeros((4, 4, 3), dtype=np.uint8)
        while not process.exists():
            time.sleep(0.01)
        raise error("no more")

    with pytest.raises((error, fr.InputError), match="no more|broken pipe"):
        fr.save_animation(tmp_path / "a.mp4", images())
    with pytest.raises(ProcessLookupError):  # a zombie would be found
        os.kill(int(process.read_text()), 0)
    assert {path.name for path in tmp_path.iterdir()} == {"ffmpeg", "process"}


@pytest.mark.slow
def test_a_broken_pipe_to_ffmpeg_does_not_end_the_command(run: Run, tmp_path: Path):
    """The command normally lets SIGPIPE end the process."""
    command = [sys.executable, "-m", "facerender", "render", str(MINI_HEAD), "--size", "256"]
    command += ["--camera", "turntable:3", "-o", "a.mp4"]
    environment = {**os.environ, "IMAGEIO_FFMPEG_EXE": encoder(tmp_path, "/bin/sh\nexit 1")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 2
    assert "ffmpeg wrote no .mp4 (it ended early): give .gif or .webp" in done.stderr


def test_without_imageio_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(
        fr.InputError, match=r"an .mp4 needs ffmpeg .*: pip install 'facerender\[mp"
    ):
        fr.save_animation(tmp_path / "a.mp4", [np.zeros((4, 4, 3), dtype=np.uint8)])


def stops() -> Iterator[Any]:
    yield np.zeros((4, 4, 3), dtype=np.uint8)
    raise fr.InputError("no more")


@pytest.mark.parametrize("suffix", MOVING)
@pytest.mark.parametrize(
    ("images", "message"),
    [
        (stops, "no more"),
        (list, "no images for"),
        (lambda: [np.zeros((side, 4, 3), np.uint8) for side in (4, 6)], "one size"),
        (lambda: [np.zeros((4, 4, 3))], "image = array.*: give an array"),
    ],
)
def test_failed_animation_leaves_no_file(tmp_path: Path, suffix: str, images, message: str):
    with pytest.raises(fr.InputError, match=message):
        fr.save_animation(tmp_path / f"a{suffix}", images())
    assert list(tmp_path.iterdir()) == []


# --- standard output -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["png", "exr", "jpeg", "webp", "tiff"])
def test_standard_output_contains_only_the_image(
    kind: Any, capfdbinary: pytest.CaptureFixture[bytes]
):
    command = [*SMALL, "-o", "-"]
    if kind == "png":
        python = [sys.executable, "-m", "facerender", *command]
        done = subprocess.run(python, capture_output=True, check=True)
        found = done.stdout, done.stderr
    else:
        assert main([*command, "--format", kind]) == 0
        found = capfdbinary.readouterr()
    assert found == (fr.render(MINI_HEAD, size=(24, 24), samples=1).encoded(kind), b"")


# --- frames --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["png", "exr", "jpeg", "webp", "tiff"])
def test_frame_in_memory_equals_its_file(frame: fr.Frame, kind: Any, tmp_path: Path):
    file = BytesIO()
    frame.save(file, format=kind)
    path = tmp_path / f"a.{kind}"
    frame.save(path)
    assert file.getvalue() == path.read_bytes() == frame.encoded(kind)
    frame.save(tmp_path / "other", format=kind)
    assert (tmp_path / "other").read_bytes() == file.getvalue()
    frame.save(file := BytesIO(), -1.0)  # PNG is the default format
    assert np.array_equal(np.asarray(Image.open(file)), frame.srgb8(-1.0))


@pytest.mark.parametrize("name", ["a.jpg", "a.JPEG", "a.webp"])
def test_lossy_files_are_close_and_keep_metadata(frame: fr.Frame, name: str, tmp_path: Path):
    frame.save(tmp_path / name)
    with Image.open(tmp_path / name) as image:
        assert json.loads(image.getexif()[0x010E]) == frame.metadata
        off = np.asarray(image.convert("RGB")).astype(int) - frame.srgb8()
    assert np.abs(off).mean() < 3.0
    if name != "a.webp":
        assert read_image(tmp_path / name).pixels.shape == (20, 24, 3)


def test_webp_keeps_alpha_and_jpeg_refuses_it(tmp_path: Path):
    mesh = fr.load_mesh(MINI_HEAD)
    with fr.Renderer((24, 24), samples=1) as renderer:
        frame = renderer.render(fr.Scene(mesh, background=None))
    frame.save(tmp_path / "a.webp")
    alpha = np.asarray(Image.open(tmp_path / "a.webp"))[..., 3]
    assert np.array_equal(alpha, frame.srgb8()[..., 3])
    with pytest.raises(fr.InputError, match="JPEG cannot store transparency: give a background"):
        frame.save(tmp_path / "a.jpg")
    assert [each.name for each in tmp_path.iterdir()] == ["a.webp"]
    assert frame.image.mode == "RGBA"
    assert repr(frame) == "<Frame 24 x 24, transparent>"


def test_webp_that_is_too_large_is_refused(tmp_path: Path):
    wide = fr.Frame(np.zeros((1, 16384, 4), dtype=np.float32), None, False, {})
    with pytest.raises(fr.InputError, match="webp cannot store 16384 x 1 pixels"):
        wide.save(tmp_path / "a.webp")
    assert list(tmp_path.iterdir()) == []


def test_display_of_frames(frame: fr.Frame):
    assert frame._repr_png_() == frame.encoded("png")
    assert np.array_equal(np.asarray(frame.image), frame.srgb8())
    assert repr(frame) == "<Frame 24 x 20>"
    depth = fr.Frame(frame.linear, "depth", False, {})
    assert repr(depth) == "<Frame 24 x 20 of depth>"
    with fr.Renderer((24, 20), samples=1) as renderer:
        output = repr(renderer.gbuffer(fr.Scene(fr.load_mesh(MINI_HEAD))))
    assert output.startswith("<GBuffer 24 x 20, ")
    assert len(output) < 50


def test_sheet_does_not_keep_its_images(frame: fr.Frame):
    alive: weakref.WeakSet[fr.Frame] = weakref.WeakSet()

    def frames() -> Iterator[fr.Frame]:
        for _ in range(7):
            image = replace(frame)
            alive.add(image)
            yield image
            assert len(alive) <= 2

    assert sheet(frames(), 7).linear.shape == (60, 72, 4)
