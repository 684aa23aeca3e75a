"""Tests ``facerender render``, ``doctor`` and ``shaders``: output, files and errors. An error is
one line on standard error with exit status 2, and no file is written."""

from __future__ import annotations

import io
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.commands import doctor, main
from facerender.drawing import context
from facerender.scene.light import LIGHTS
from tests import awkward_files as files
from tests.awkward_files import MINI_HEAD, mini_head

Capture = pytest.CaptureFixture[str]
pytestmark = pytest.mark.usefixtures("egl")


@dataclass(frozen=True)
class Cli:
    """Runs commands in this process; images go to ``folder``."""

    folder: Path
    capture: Capture

    @property
    def png(self) -> Path:
        return self.folder / "head.png"

    @property
    def written(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())

    def run(self, *arguments: str | Path) -> tuple[int, str, str]:
        """Return exit status, standard output and standard error."""
        status = main([str(argument) for argument in arguments])
        printed = self.capture.readouterr()
        return status, printed.out, printed.err

    def render(self, *options: str | Path, mesh: str | Path = MINI_HEAD) -> NDArray[np.uint8]:
        """Render without errors or warnings, except of clipping, and return the image."""
        status, out, err = self.run("render", mesh, "-o", self.png, "--size", "48", *options)
        assert (status, [line for line in err.splitlines() if " than white: " not in line]) == (
            0,
            [],
        )
        assert out == f"{self.png}\n"
        return np.asarray(Image.open(self.png))

    def describe(self, *options: str | Path, mesh: str | Path = MINI_HEAD) -> dict[str, Any]:
        """Render with --json, and return its output."""
        status, out, _ = self.run(
            "render", mesh, "-o", self.png, "--size", "48", "--json", *options
        )
        assert status == 0
        return dict(json.loads(out))

    def fail(self, message: str, *arguments: str | Path) -> None:
        """Check that a command fails with a matching error and writes no file."""
        before = self.written
        status, out, err = self.run(*arguments)
        assert_error(status, out, err, message)
        assert self.written == before

    def fail_to_render(
        self, message: str, *options: str | Path, mesh: str | Path = MINI_HEAD
    ) -> None:
        size = () if "--size" in options else ("--size", "48")
        output = () if "-o" in options else ("-o", self.png)
        self.fail(message, "render", mesh, *output, *size, *options)


def assert_error(status: int, out: str, err: str, message: str) -> None:
    assert status == 2, err
    assert out == ""
    assert "Traceback" not in err
    *warnings, error = err.splitlines()
    assert all(line.startswith("facerender: warning: ") for line in warnings)
    assert error.startswith("facerender: error: ")
    assert err.endswith("\n")
    assert re.search(message, error), error


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str | bytes], Path]:
    """A function that writes an input file."""

    def write(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def process(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "facerender", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


# --- in a separate process -----------------------------------------------------------------------


def test_process_renders_the_built_in_head(tmp_path: Path, egl: str) -> None:
    done = process("render", "-o", tmp_path / "head.png", "--size", "64x48")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{tmp_path / 'head.png'}\n"
    with Image.open(tmp_path / "head.png") as image:
        assert image.size == (64, 48)
    assert os.listdir(tmp_path) == ["head.png"]


@pytest.mark.slow
def test_process_fails_in_one_line(tmp_path: Path) -> None:
    done = process("render", tmp_path / "gone.obj", "-o", tmp_path / "head.png")
    assert_error(done.returncode, done.stdout, done.stderr, r"cannot read .*gone\.obj: no such")
    assert len(done.stderr.splitlines()) == 1
    assert not os.listdir(tmp_path)


def test_process_version() -> None:
    done = process("--version")
    assert (done.returncode, done.stdout) == (0, f"facerender {fr.__version__}\n")


# --- images --------------------------------------------------------------------------------------


def test_png(cli: Cli) -> None:
    image = cli.render()
    assert image.shape == (48, 48, 3)
    assert image[:, :, 0].max() > 100
    assert cli.written == ["head.png"]
    with Image.open(cli.png) as file:
        text = file.info
    assert text["facerender"] == fr.__version__
    assert text["GL_RENDERER"]
    assert text["GL_VERSION"]
    assert text["samples"] == "4"


def test_image_is_readable_like_any_new_file(cli: Cli, write: Callable[..., Path]) -> None:
    cli.render()
    assert cli.png.stat().st_mode == write("other", b"").stat().st_mode


def test_json(cli: Cli) -> None:
    facts = cli.describe("--model", "ward", "--lobe", "d8", "--only", "specular", "--samples", "1")
    assert facts.pop("GL_RENDERER")
    assert facts.pop("GL_VERSION")
    expected = {
        "output": str(cli.png),
        "size": [48, 48],
        "backend": "egl",
        "only": "specular",
        "model": "ward",
        "lobe": "d8",
        "fresnel": "schlick",
        "masking": "v-cavity",
        "facerender": fr.__version__,
        "samples": "1",
        "float_albedo": "False",
        "textures": "8-bit",
        "camera": "Camera()",
        "warnings": [],
    }
    assert facts.items() >= expected.items()


def test_exr_is_the_linear_frame(cli: Cli) -> None:
    path = cli.folder / "head.exr"
    options = ("--size", "48x32", "--samples", "1", "--background", "none", "--backend", "egl")
    status, out, err = cli.run("render", MINI_HEAD, "-o", path, *options)
    assert (status, out, err) == (0, f"{path}\n", "")
    with fr.Renderer((48, 32), samples=1, backend="egl") as renderer:
        frame = renderer.render(fr.Scene(fr.load_mesh(MINI_HEAD), background=None))
    with OpenEXR.File(str(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGBA"].pixels, frame.linear)
        assert file.header()["GL_RENDERER"] == frame.metadata["GL_RENDERER"]
    assert cli.written == ["head.exr"]


def test_specular_and_diffuse_add_up_to_the_whole(cli: Cli) -> None:

    def linear(*options: str) -> NDArray[np.float32]:
        path = cli.folder / "part.exr"
        size = ("--size", "48", "--background", "none")
        assert cli.run("render", MINI_HEAD, "-o", path, *size, *options)[0] == 0
        with OpenEXR.File(str(path)) as file:
            return np.array(file.channels()["RGBA"].pixels[..., :3])

    both = linear("--only", "specular") + linear("--only", "diffuse")
    np.testing.assert_allclose(both, linear(), atol=1e-5)


def test_background_is_linear(cli: Cli) -> None:
    np.testing.assert_array_equal(cli.render("--background", "0.5,0,1")[0, 0], [188, 0, 255])


def test_exposure_in_stops(cli: Cli) -> None:
    once = cli.render("--ambient", "0.25", "--light", "0,0,0", "--ks", "0")
    twice = cli.render("--ambient", "0.5", "--light", "0,0,0", "--ks", "0")
    exposed = cli.render("--ambient", "0.25", "--light", "0,0,0", "--ks", "0", "--exposure", "1")
    assert (exposed == twice).all()
    assert (once < twice).any()


def test_exposure_and_tone_leave_the_background_colour(cli: Cli) -> None:
    options = "--background", "0.25,0.5,1"
    for more in (("--exposure", "1"), ("--exposure=-2",), ("--tone", "neutral")):
        image = cli.render(*options, *more)
        assert image[0, 0].tolist() == cli.render(*options)[0, 0].tolist() == [137, 188, 255]
        assert (image != cli.render(*options)).any()


# --- camera, lights, material --------------------------------------------------------------------


OPTIONS: dict[tuple[str, ...], dict[str, Any]] = {
    ("--camera", "-30,-20,1.5"): {"camera": fr.Camera(-30.0, -20.0, zoom=1.5)},
    ("--fov", "60"): {"camera": fr.Camera(fov=60.0)},
    ("--light", "key", "--light", "rim"): {"lights": (LIGHTS["key"], LIGHTS["rim"])},
    ("--light", "point:-1,0,1,5"): {
        "lights": (fr.Light(irradiance=5.0, position=(-1.0, 0.0, 1.0)),)
    },
    ("--background", "none"): {"background": None},
    ("--lobe", "cosine", "--fresnel", "dielectric"): {"lobe": "cosine", "fresnel": "dielectric"},
    ("--m", "0.9", "--lobe", "fitted", "--outside", "exact"): {"m": 0.9},
    ("--masking", "kelemen", "--only", "specular"): {"masking": "kelemen", "only": "specular"},
}


@pytest.mark.first_case
@pytest.mark.parametrize("options", OPTIONS, ids=" ".join)
def test_options_equal_their_values_in_python(options: tuple[str, ...], cli: Cli) -> None:
    frame = fr.render(MINI_HEAD, size=(48, 48), **OPTIONS[options])
    np.testing.assert_array_equal(cli.render(*options), frame.srgb8())


@pytest.mark.slow
def test_triangles(cli: Cli) -> None:
    level = fr.simplified(fr.load_mesh(MINI_HEAD), 1000)
    few = cli.render("--triangles", "1000")
    assert (few == fr.render(level, size=(48, 48)).srgb8()).all()
    assert (few != cli.render()).any()
    status, _, err = cli.run(
        *("render", MINI_HEAD, "-o", cli.png, "--size", "48", "--triangles", "1")
    )
    assert status == 0
    assert re.fullmatch(r"facerender: warning: .* to 1 triangles: \d+ remain\n", err)


def test_material(cli: Cli) -> None:
    image = cli.render("--m", "0.2", "--f0", "0.05", "--ks", "0.5", "--kd", "0.8")
    mesh = fr.load_mesh(MINI_HEAD).with_material(m=0.2, f0=0.05, ks=0.5, kd=0.8)
    np.testing.assert_array_equal(image, fr.render(mesh, size=(48, 48)).srgb8())


def test_maps(cli: Cli, tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (0, 255, 0)).save(tmp_path / "green.png")
    Image.new("L", (4, 4), 0).save(tmp_path / "black.png")
    image = cli.render(
        *("--albedo", tmp_path / "green.png", "--specular-map", tmp_path / "black.png"),
        *("--background", "0,0,0"),
    )
    assert image[..., 1].max() > 100
    assert not image[..., [0, 2]].any()


SCENE = """
ambient = 0.1
background = "none"
lights = ["key", { azimuth = 30, elevation = 10, irradiance = [1, 2, 3] }]

[camera]
azimuth = 25
zoom = 1.2

[material]
m = 0.2
ks = 0.5
"""


def test_options_override_the_scene_file(cli: Cli, write: Callable[..., Path]) -> None:
    path = write("scene.toml", SCENE)
    options = ("--camera", "40", "--light", "front", "--m", "0.4", "--background", "0,0,0")
    overridden = cli.render("--scene", path, *options)
    rest = write("rest.toml", "ambient = 0.1\n[camera]\nzoom = 1.2\n[material]\nks = 0.5\n")
    np.testing.assert_array_equal(overridden, cli.render("--scene", rest, *options))


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--size", "axb", r"size 'axb': give N or WxH"),
        ("--size", "1x2x3", r"size '1x2x3': give N or WxH"),
        ("--exposure", "nan", r"exposure"),
        ("--light", "1", r"unknown light '1'; give key"),
        ("--light", "0,100", r"light elevation = 100\.0 is outside"),
        ("--light", "0,0,nan", r"light irradiance = nan"),
        ("--light", "point:0,0", r"unknown light 'point:0,0'.*point:X,Y,Z"),
        ("--camera", "1,2,3,4", r"unknown camera '1,2,3,4'; give"),
        ("--camera", "0,0,0", r"camera zoom = 0\.0 is outside"),
        ("--camera", "nan", r"camera azimuth = nan is outside"),
        ("--ambient", "1,2", r"ambient = '1,2': give a number in .*, or three"),
        ("--ambient", "-1", r"ambient"),
        ("--background", "nan,0,0", r"background = 'nan,0,0': give a number in"),
        ("--model", "phong", r"argument --model: invalid choice: 'phong'"),
        ("--only", "shadow", r"argument --only: invalid choice: 'shadow'"),
        ("--backend", "vulkan", r"argument --backend: invalid choice: 'vulkan'"),
        ("--backend", "current", r"no EGL, GLX or OSMesa context is current"),
    ],
)
def test_bad_option(option: str, value: str, message: str, cli: Cli) -> None:
    cli.fail_to_render(message, option, value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), r"arguments are required: COMMAND; see facerender --help"),
        (("paint",), r"invalid choice: 'paint'"),
        (("render", "a.obj", "b.obj", "-o", "c.png"), r"unrecognized arguments: b\.obj"),
    ],
)
def test_bad_command(arguments: tuple[str, ...], message: str, cli: Cli) -> None:
    cli.fail(message, *arguments)


@pytest.mark.slow
def test_roughness_map_outside_the_domain_of_the_lobe(cli: Cli, tmp_path: Path) -> None:
    Image.new("L", (4, 4), 230).save(tmp_path / "rough.png")
    options = ("--roughness-map", tmp_path / "rough.png")
    cli.render(*options)
    cli.render(*options, "--lobe", "d16", "--model", "ward")
    cli.fail_to_render(r"--m and --roughness-map exclude each other", *options, "--m", "0.5")
    message = r"m = 0\.813\d* is outside the domain of lobe d16 .*0\.7071\), or use the lobe exact"
    cli.fail_to_render(message, *options, "--lobe", "d16")


def test_non_finite_vertices(cli: Cli, tmp_path: Path) -> None:
    positions = mini_head().positions.copy()
    positions[10] = np.nan
    mesh = files.write_glb(tmp_path / "head.glb", mini_head().with_positions(positions))
    status, out, err = cli.run("render", mesh, "-o", cli.png, "--size", "48")
    assert (status, out) == (0, f"{cli.png}\n")
    assert re.fullmatch(
        r"facerender: warning: head\.glb has 1 non-finite vertices: \d+ faces dropped\n", err
    )
    assert np.asarray(Image.open(cli.png))[24, 24].max() > 50
    (warning,) = cli.describe(mesh=mesh)["warnings"]
    assert warning in err


# --- output files --------------------------------------------------------------------------------


def test_folder_that_must_not_be_written(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    cli.fail_to_render(r"cannot write .*: permission denied; give a file in a writable folder")


def test_bad_input_leaves_the_existing_image(cli: Cli) -> None:
    cli.png.write_bytes(b"precious")
    cli.fail_to_render(r"cannot read", mesh=cli.folder / "gone.obj")
    cli.fail_to_render(r"m = 3", "--m", "3")
    cli.fail_to_render(r"gone", mesh=cli.folder / "a\ngone.glb")  # in one line
    assert cli.png.read_bytes() == b"precious"


def test_exr_without_its_package(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    cli.fail_to_render(r"pip install 'facerender\[exr\]'", "-o", cli.folder / "head.exr")


# --- OpenGL --------------------------------------------------------------------------------------

OWN = ("egl", "osmesa", "native")


@pytest.fixture
def no_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> Callable[[], Any]:
        def opener() -> Any:
            raise Exception(f"lib{name} is not there")

        return opener

    monkeypatch.setattr(context, "_OPENERS", {name: refuse(name) for name in OWN})


@pytest.mark.usefixtures("no_opengl")
def test_no_opengl(cli: Cli) -> None:
    cli.fail_to_render(
        r"no OpenGL context \(egl: libegl is not there; osmesa: libosmesa is not there\); "
        r".*apt-get install libegl1 libgl1 libgl1-mesa-dri$"
    )


@pytest.mark.usefixtures("no_opengl")
def test_no_opengl_of_the_requested_backend(cli: Cli) -> None:
    cli.fail_to_render(
        r"no OpenGL context \(osmesa: libosmesa is not there\); "
        r".*apt-get install libosmesa6; Mesa 25.1 and later lack it: use egl$",
        "--backend",
        "osmesa",
    )


def test_doctor(cli: Cli) -> None:
    status, out, err = cli.run("doctor", "--json")
    assert (status, err) == (0, "")
    report = json.loads(out)
    findings = {finding["backend"]: finding for finding in report["backends"]}
    assert set(findings) == set(OWN)
    assert set(findings["egl"]) == {"backend", "renderer", "version", "samples", "size", "error"}
    assert report["auto"] in ("egl", "osmesa")
    assert report["packages"][""]["numpy"] == np.__version__
    status, out, err = cli.run("doctor")
    assert (status, err) == (0, "")
    assert findings["egl"]["renderer"] in out
    assert f"Python {platform.python_version()}" in out


def test_doctor_names_remedies(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.PACKAGES, "hdr", ("not-there-at-all",))
    _, out, _ = cli.run("doctor")
    assert "hdr     not-there-at-all is missing: pip install 'facerender[hdr]'\n" in out


@pytest.mark.usefixtures("no_opengl")
def test_doctor_without_opengl(cli: Cli) -> None:
    status, out, err = cli.run("doctor")
    assert (status, err) == (2, "")
    assert re.search(r"egl .*apt-get install libegl1", out)
    assert re.search(r"osmesa .*apt-get install libosmesa6", out)
    assert re.search(r"native .*apt-get install libgl1", out)
    assert "\nauto    no backend works\n" in out


def test_shaders_lists_every_function(cli):
    status, out, err = cli.run("shaders", "list")
    assert (status, err) == (0, "")
    _, text, _ = cli.run("shaders", "list", "--json")
    described = json.loads(text)
    defined = set()
    for path in (fr.shader_dir() / "facerender").rglob("*.glsl"):
        defined |= set(re.findall(r"^\w+ (fr_\w+)\([^)]*\) \{$", path.read_text(), re.MULTILINE))
    assert {function["name"] for function in described} == defined
    words = " ".join(out.split())
    for function in described:
        for key in ("signature", "file", "summary", "unit", "error"):
            assert " ".join(function[key].split()) in words
    fresnel = next(f for f in described if f["name"] == "fr_fresnel_schlick")
    assert fresnel["error"] == "At most 0.046 (absolute) for f0 = 0.028, reached at 84 degrees."
    assert fresnel["source"] == "Schlick (1994), eq. 15."
    assert fresnel["parameters"]["f0"].startswith("Fresnel reflectance at normal incidence, in [")


def test_shaders_path_is_an_include_directory(cli):
    _, out, _ = cli.run("shaders", "path")
    assert Path(out.strip(), "facerender/cook_torrance.glsl").is_file()


def test_shaders_flatten(cli):
    status, out, err = cli.run(
        *("shaders", "flatten", "ward", "--target", "es300", "--lobe", "d8", "--m", "0.3")
    )
    assert (status, err) == (0, "")
    assert out == fr.shader_source("ward", "es300", lobe="d8", m=0.3)
    assert out.startswith("#version 300 es\n")
    assert "#define FR_SLOPE(m) 0.3\n" in out


def test_shaders_flatten_reads_standard_input(cli, write, monkeypatch):
    folder = os.path.dirname(write("shared.glsl", "// shared\n"))
    text = b'\xef\xbb\xbf#include <shared.glsl>\r\n#include "facerender/ward.glsl"\r\n'
    for arguments in ((), ("--target", "330")):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text)))
        status, out, err = cli.run(
            "shaders", "flatten", "-", "-I", "absent", "-I", folder, *arguments
        )
        assert (status, err) == (0, "")
        assert "// standard input with what it includes" in out
        assert out.count("// shared\n") == out.count("float fr_ward(") == 1
    for wrong, message in ((b"\xe9", "cannot read standard input: it is not UTF-8 text"),
                           (text, "line 1: no file shared.glsl in /")):  # fmt: skip
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(wrong)))
        cli.fail(message, "shaders", "flatten", "-")


def test_shaders_errors(cli, write):
    own = write("own.frag", '#include "other.glsl"')
    for message, *arguments in ((r"own.frag:1: no file other.glsl in ", own),):
        cli.fail(message, "shaders", "flatten", *arguments)
    write("other.glsl", '#include "own.frag"')
    cli.fail(r"other.glsl:1: include cycle .*own.frag -> ", "shaders", "flatten", own)
    cli.fail("the following arguments are required: ACTION", "shaders")
