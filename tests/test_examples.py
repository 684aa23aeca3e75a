"""Tests the examples: each runs with one command and agrees with the float64 reference, the
notebook displays its images, and CMake and pkg-config find the installed shaders."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from base64 import b64decode
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender import __version__, brdf
from facerender.drawing.context import Backend
from facerender.images.files import read_image
from facerender.images.image import linear_to_srgb, srgb_to_linear
from tests.conftest import missing, require_module

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SIZE = 512
LIGHT = np.array([-1.0, 1.0, 1.5]) / np.linalg.norm([-1.0, 1.0, 1.5])
EYE = np.array([0.0, 0.0, 1.0])
PROBES = ((189, 189), (150, 190), (230, 230), (190, 60), (60, 300), (256, 256), (350, 350), (2, 2))


def require_command(*names: str) -> None:
    for name in names:
        if shutil.which(name) is None:
            missing(f"no {name}: install it (tools/system-libraries --tests)")


def require_package(name: str) -> None:
    if find_spec(name) is None:
        missing(f"no Python package {name}")


def run(*command: str | Path, **options) -> subprocess.CompletedProcess[str]:
    result = subprocess.run(command, capture_output=True, text=True, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result


def specular(n: NDArray[np.float64], eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the specular radiance of sphere.frag and of the PyVista example."""
    received = np.pi * np.maximum(n @ LIGHT, 0.0)
    return received * brdf.cook_torrance(n, LIGHT, eye, 0.2, 0.04)


def sphere() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal of every pixel of sphere.frag, and its distance to the centre, in radii."""
    at = ((np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0) / 0.9
    x, y = np.meshgrid(at, -at)
    r = np.hypot(x, y)
    z = np.sqrt(np.maximum(1.0 - r**2, 0.0))
    return np.stack([x, y, z], axis=-1) / np.maximum(r, 1.0)[..., None], r


def check_picture(path: Path) -> NDArray[np.uint8]:
    """Check that an image has a sphere on black, brightest where the normal is the half vector."""
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape == (SIZE, SIZE, 3)
    assert not pixels[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert 0.5 < (pixels.max(axis=-1) > 20).mean() < 0.75
    brightness = pixels.sum(axis=-1, dtype=int)
    y, x = np.argwhere(brightness >= brightness.max() - 2).mean(axis=0)
    assert np.hypot(x - 190, y - 190) < 8
    assert pixels[190, 190].min() > 160
    assert pixels[400, 430].max() < 60
    return pixels


def check_sphere(path: Path) -> None:
    """Check every pixel of an image of sphere.frag."""
    n, r = sphere()
    inside = r < 0.99
    diffuse = np.array([0.46, 0.25, 0.17]) * (np.maximum(n[inside] @ LIGHT, 0.0) + 0.05)[:, None]
    expected = linear_to_srgb(diffuse + specular(n[inside], EYE)[:, None])
    drawn = check_picture(path)[inside]
    np.testing.assert_allclose(drawn / 255.0, expected, atol=0.7 / 255.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "package"),
    [
        ("moderngl_minimal", "moderngl"),
        pytest.param("pyopengl_include", "OpenGL", marks=pytest.mark.slow),
    ],
)
def test_script_agrees_with_float64(egl: Backend, tmp_path: Path, script: str, package: str):
    require_package(package)
    run(sys.executable, EXAMPLES / f"{script}.py", tmp_path / "sphere.png")
    check_sphere(tmp_path / "sphere.png")
    code = (
        f"import sys, numpy, examples.{script} as example; numpy.save(sys.argv[1], example.draw())"
    )
    run(sys.executable, "-c", code, tmp_path / "radiance.npy", cwd=ROOT)
    n, r = sphere()
    drawn = np.load(tmp_path / "radiance.npy")[..., 3]
    inside = r < 0.99
    np.testing.assert_allclose(drawn[inside], specular(n[inside], EYE), rtol=1e-4, atol=1e-6)
    assert not drawn[r > 1.01].any()


@pytest.fixture(scope="module")
def c_egl(egl: Backend, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the C example, compiled without warnings."""
    require_command("cc", "pkg-config")
    if subprocess.run(["pkg-config", "--exists", "egl", "opengl"]).returncode:
        missing("no headers of EGL and OpenGL: install libegl-dev libopengl-dev")
    copy = tmp_path_factory.mktemp("examples") / "examples"
    shutil.copytree(EXAMPLES, copy, ignore=shutil.ignore_patterns("*.inc", "sphere", "*.ppm"))
    make_c(copy / "c_egl")
    return copy / "c_egl"


def make_c(folder: Path) -> None:
    tool = f"FACERENDER={sys.executable} -m facerender"
    flags = "CFLAGS=-O1 -Wall -Wextra -Wpedantic -Werror"
    run("make", "-C", folder, "sphere", tool, flags, cwd=ROOT)


@pytest.mark.compiler
def test_c_program_agrees_with_float64(c_egl: Path, tmp_path: Path):
    picture = tmp_path / "sphere.ppm"
    printed = run(c_egl / "sphere", picture, *(f"{x},{y}" for x, y in PROBES)).stdout
    check_sphere(picture)
    n, _ = sphere()
    values = np.array([line.split() for line in printed.splitlines()], dtype=float)
    columns, rows = np.array(PROBES).T
    np.testing.assert_array_equal(values[:, :2], PROBES)
    reference = np.where(n[rows, columns, 2] > 0.0, specular(n[rows, columns], EYE), 0.0)
    assert reference.max() > 0.2
    np.testing.assert_allclose(values[:, 2], reference, rtol=1e-4, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "usage"),
        (["no/folder.ppm"], "no/folder.ppm: No such file"),
        (["sphere.ppm", "1,512"], "1,512 is not a pixel"),
        (["sphere.ppm", "1;2"], "1;2 is not a pixel"),
    ],
)
def test_c_program_prints_errors(c_egl: Path, tmp_path: Path, arguments: list[str], message: str):
    program = c_egl / "sphere"
    result = subprocess.run([program, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("parallel", [False, True])
def test_pyvista_agrees_with_float64(egl: Backend, tmp_path: Path, parallel: bool):
    require_package("pyvista")
    code = f"""
import sys
import pyvista
from examples.pyvista_replacement import plot

plotter = plot(pyvista.Sphere(radius=1.0, theta_resolution=128, phi_resolution=128))
(actor,) = plotter.actors.values()
actor.prop.ambient = actor.prop.diffuse = 0.0
plotter.camera.parallel_projection = {parallel}
plotter.screenshot(sys.argv[1])
camera = plotter.camera
print(camera.position[2], camera.view_angle, camera.parallel_scale)
"""
    run(sys.executable, EXAMPLES / "pyvista_replacement.py", tmp_path / "picture.png")
    check_picture(tmp_path / "picture.png")
    printed = run(sys.executable, "-c", code, tmp_path / "sphere.png", cwd=ROOT).stdout
    distance, angle, scale = map(float, printed.split())
    at = (np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0
    x, y = np.meshgrid(at, -at)
    plane = np.stack([x, y, np.zeros_like(x)], axis=-1)
    origin, ray = (
        (plane * scale + EYE * distance, -EYE + 0.0 * plane)
        if parallel
        else (EYE * distance + 0.0 * plane, plane * np.tan(np.radians(angle / 2.0)) - EYE)
    )
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    nearest = -(origin * ray).sum(axis=-1)
    depth2 = 1.0 - (origin**2).sum(axis=-1) + nearest**2
    inside = depth2 > 0.02
    n = origin + ray * (nearest - np.sqrt(np.maximum(depth2, 0.0)))[..., None]
    with Image.open(tmp_path / "sphere.png") as image:
        drawn = srgb_to_linear(np.asarray(image.convert("L")) / 255.0)
    reference = specular(n[inside], -ray[inside])
    assert reference.max() > 0.2
    np.testing.assert_allclose(drawn[inside], reference, atol=4e-3)  # 8 bits, sRGB


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prefix of the shaders, installed with DESTDIR and then moved."""
    folder = tmp_path_factory.mktemp("install")
    run("make", "-s", "install-shaders", f"DESTDIR={folder}", "PREFIX=/opt/staged", cwd=ROOT)
    return (folder / "opt/staged").rename(folder / "moved")


def test_install_has_every_file_of_the_library(prefix: Path):
    installed, own = prefix / "share/facerender/shaders", ROOT / "shaders"
    assert {path.relative_to(installed) for path in installed.rglob("*.*")} == {
        path.relative_to(own) for path in (own / "facerender").rglob("*.glsl")
    }


def test_pkg_config_finds_the_shaders(prefix: Path):
    require_command("pkg-config")
    environment = {**os.environ, "PKG_CONFIG_PATH": str(prefix / "share/pkgconfig")}

    def ask(option: str) -> str:
        return run("pkg-config", option, "facerender-shaders", env=environment).stdout.strip()

    shaders = Path(ask("--variable=shaderdir"))
    assert (shaders / "facerender/cook_torrance.glsl").samefile(
        prefix / "share/facerender/shaders/facerender/cook_torrance.glsl"
    )
    assert ask("--cflags") == f"-I{shaders}"
    assert ask("--modversion") == __version__


@pytest.mark.compiler
def test_cmake_finds_the_shaders(prefix: Path, tmp_path: Path):
    require_command("cmake")
    (tmp_path / "CMakeLists.txt").write_text(
        f"""
cmake_minimum_required(VERSION 3.11)
project(host LANGUAGES NONE)
find_package(facerender_shaders {__version__} EXACT REQUIRED)
find_package(facerender_shaders {__version__.rpartition(".")[0]} REQUIRED)
get_target_property(root facerender::shaders INTERFACE_INCLUDE_DIRECTORIES)
message("${{FACERENDER_SHADERS_DIR}}|${{root}}")
foreach(other 99.0 {__version__}.1)
    find_package(facerender_shaders ${{other}} QUIET)
    message("${{other}} ${{facerender_shaders_FOUND}}")
endforeach()
"""
    )
    build = ("cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    printed = run(*build).stderr
    root = prefix / "share/facerender/shaders"
    assert printed.split() == [f"{root}|{root}", "99.0", "0", f"{__version__}.1", "0"]


@pytest.mark.slow
@pytest.mark.parametrize(("weight", "failed"), [("1", 0), ("0.97", 3), ("0.9", 3)])
def test_images_of_the_ci_example(egl: Backend, tmp_path: Path, weight: str, failed: int):
    """Three images are compared with goldens. A highlight that is 3 % weaker is detected on the
    driver that drew the goldens, and one that is 10 % weaker on every driver."""
    goldens = EXAMPLES / "ci_image_diff/goldens/test_skin"
    drawn = read_image(goldens / "test_highlight-0.3.exr").metadata["GL_VERSION"]
    if weight == "0.97" and drawn != fr.render(size=(8, 8), backend=egl).metadata["GL_VERSION"]:
        failed = 0
    shutil.copytree(EXAMPLES / "ci_image_diff", tmp_path / "copy")
    command = [sys.executable, "-m", "pytest", "-p", "facerender.pytest_plugin"]
    result = subprocess.run(
        [*command, "--facerender-report", "report"],
        cwd=tmp_path / "copy",
        env={**os.environ, "PYTHONPATH": str(ROOT), "SKIN_WEIGHT": weight},
        capture_output=True,
        text=True,
    )
    assert result.returncode == bool(failed), result.stdout
    assert len(re.findall("^E .*perhaps another slope", result.stdout, re.MULTILINE)) == failed
    assert (tmp_path / "copy/report/index.html").is_file()


@pytest.mark.slow
def test_a_head_of_parts(tmp_path):
    output = run(sys.executable, EXAMPLES / "head_of_parts.py", tmp_path, cwd=ROOT).stdout
    assert "visible parts: [0, 1, 2, 4]" in output  # includes the parts behind the shells
    face = np.asarray(Image.open(tmp_path / "face.jpg"), dtype=float)
    grey = np.ptp(face, axis=-1) < 30.0
    bright = face.mean(axis=-1) > 150.0
    assert (grey & bright).sum() > 300  # the eyeballs, seen through the shells
    with Image.open(tmp_path / "head.gif") as moving:
        assert moving.n_frames == 8


@pytest.mark.slow
def test_notebook_displays_frames(egl: Backend, monkeypatch: pytest.MonkeyPatch):
    nbclient, nbformat = require_module("nbclient"), require_module("nbformat")
    require_module("ipykernel")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # for the kernel
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    results = {
        cell.id: [each.data for each in cell.outputs if each.output_type == "execute_result"]
        for cell in notebook.cells
        if cell.cell_type == "code"
    }
    (shown,), (listed,) = results["frame"], results["turntable"]
    assert Image.open(BytesIO(b64decode(shown["image/png"]))).size == (320, 320)
    assert shown["text/plain"] == "<Frame 320 x 320>"
    assert listed["text/plain"].count("<Frame 320 x 320>") == 4
    (compared,), (sheet,), (layers,) = (results[name] for name in ("compare", "sheet", "gbuffer"))
    assert "<b>differs</b>: block at" in compared["text/html"]
    inside = re.search(r'src="data:image/png;base64,([^"]+)"', compared["text/html"])[1]
    sizes = [
        Image.open(BytesIO(b64decode(each))).size
        for each in (inside, sheet["image/png"], layers["image/png"])
    ]
    assert sizes[0] == sizes[1]
    assert min(sizes[0]) > 320
    assert sizes[0][0] == sizes[2][0] > 3 * 320
