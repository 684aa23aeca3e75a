"""Tests the package: the wheel works outside the checkout, and modules respect the import rules."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
from collections.abc import Iterable
from email import message_from_bytes
from email.message import Message
from importlib.metadata import distribution, files, requires
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement

from tests.conftest import require_backend, require_module

ROOT = Path(__file__).parents[1]


def import_graph(folder: Path) -> subprocess.CompletedProcess[str]:
    tool = ROOT / "tools/import-graph"
    return subprocess.run([sys.executable, tool, folder], capture_output=True, text=True)


def test_import_graph_has_no_cycle_and_no_wrong_arrow():
    done = import_graph(ROOT / "facerender")
    assert (done.returncode, done.stderr) == (0, "")
    arrows = {room: set(below) for room, *below in map(str.split, done.stdout.splitlines())}
    assert not any("commands" in below for room, below in arrows.items() if room != "__main__")
    assert arrows["terms"] == {"values", "errors"}


def homes(folder: Path) -> subprocess.CompletedProcess[str]:
    tool = ROOT / "tools/homes"
    return subprocess.run([sys.executable, tool, folder], capture_output=True, text=True)


def test_each_setting_has_one_home():
    done = homes(ROOT / "facerender")
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    "function",
    [
        "def camera_of(text: str) -> Camera:\n    return Camera(float(text))",
        "def light(table: dict[str, float]):\n    return Light(**table)",
        "def check(size: int) -> None:\n    range_of(ImageSettings, 'size').check('size', size)",
        "def far(zoom: float) -> bool:\n    return zoom > limits_of(Camera)['zoom'].high",
    ],
)
def test_a_second_home_is_reported(tmp_path, function):
    shutil.copytree(ROOT / "facerender/scene", tmp_path / "facerender/scene")
    (tmp_path / "facerender/scene/second.py").write_text(f"{function}\n")
    done = homes(tmp_path / "facerender")
    assert done.returncode == 1
    assert "scene/second.py" in done.stdout


@pytest.mark.slow
def test_wrong_imports_are_reported(tmp_path):
    folder = tmp_path / "facerender"
    shutil.copytree(ROOT / "facerender", folder, ignore=shutil.ignore_patterns("*.json", "*.pyc"))
    for module, line in {
        "terms/entry": "from facerender import lobes",
        "drawing/prepare": "import moderngl",
        **{f"loading/{a}": f"from facerender.loading import {b}" for a, b in ("xy", "yx")},
    }.items():
        with (folder / f"{module}.py").open("a") as file:
            file.write(f"\n{line}\n")
    done = import_graph(folder)
    assert done.returncode == 1
    for fault in (
        "terms.entry imports lobes, which is above",
        "drawing.prepare imports OpenGL",
        "import cycle: ",
    ):
        assert fault in done.stderr


def test_all_copyright_lines_name_the_authors_of_the_metadata():
    with (ROOT / "pyproject.toml").open("rb") as file:
        (author,) = tomllib.load(file)["project"]["authors"]
    for path in ("LICENSE", "docs/conf.py", "facerender/glsl/library.py"):
        assert f"the {author['name']}" in (ROOT / path).read_text(encoding="utf-8"), path


# Runs a process as on another system, without OpenGL: removes what this system's Python and
# libraries lack there, then imports every module and runs the commands that need no OpenGL.
ELSEWHERE = """
import asyncio, ctypes, multiprocessing.connection, multiprocessing.util, os, pkgutil, runpy
import signal, socket, subprocess, sys, tempfile
from importlib import import_module

import PIL.Image, glcontext, moderngl, numpy as np, tqdm, trimesh

sys.platform = sys.argv[1]
sys.modules.update(dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios")))
absent = {os: {"sched_getaffinity", "posix_fadvise", "memfd_create", "pidfd_open"}}
if sys.platform == "win32":
    names = "fork register_at_fork getuid geteuid setsid killpg sysconf uname mkfifo statvfs pread"
    absent[os] |= {*names.split(), "pwrite", "fchmod", "chown", "wait4", "WNOHANG", "O_NOFOLLOW"}
    names = {"SIGINT", "SIGTERM", "SIGABRT", "SIGFPE", "SIGILL", "SIGSEGV"}
    absent[signal] = {name for name in dir(signal) if name.startswith("SIG")} - names
    absent[signal] |= {"setitimer", "alarm", "pthread_sigmask", "pthread_kill", "sigwait"}
for module, names in absent.items():
    for name in names & {*dir(module)} - {"SIG_DFL", "SIG_IGN"}:
        delattr(module, name)

def refuse(event, args):
    if event == "open" and str(args[0]).startswith(("/proc", "/sys")):
        raise FileNotFoundError(args[0])
    if event == "ctypes.dlopen" and any(name in str(args[0]) for name in ("GL", "OSMesa")):
        raise OSError(args[0])

sys.addaudithook(refuse)
glcontext.get_backend_by_name = glcontext.default_backend = None

import facerender as fr
from facerender.commands import main

modules = [each.name for each in pkgutil.walk_packages(fr.__path__, "facerender.")]
assert len(modules) > 100
for module in modules:
    if not module.endswith("__main__"):
        import_module(module)
n = np.array([0.0, 0.0, 1.0])
np.testing.assert_allclose(fr.brdf.cook_torrance(n, n, n, 0.3, 0.04), 0.04 / (4 * np.pi * 0.3**2))
value = np.exp(-((np.tan(0.2) / 0.3) ** 2)) / np.cos(0.2) ** 4
assert np.isclose(fr.lobes.exact(np.cos(0.2), 0.3, 4), value)
image = np.full((32, 32, 3), 0.5, np.float32)
np.save("a.npy", image)
np.save("b.npy", image + (np.arange(32) > 16)[:, None, None] * np.float32(0.2))
assert main(["compare", "a.npy", "a.npy"]) == 0
assert main(["compare", "a.npy", "b.npy", "--report", "report.html"]) == 1
for target in ("330", "es300", "vulkan"):
    assert main(["shaders", "flatten", "cook_torrance", "--target", target]) == 0
assert main(["info"]) == 0
assert main(["explore", "-o", "explorer.html"]) == 0
assert main(["render", "-o", "head.png"]) == 2  # OpenGL is absent
"""


@pytest.mark.slow
@pytest.mark.parametrize("system", ["win32", pytest.param("darwin", marks=pytest.mark.slow)])
def test_parts_without_opengl_work_elsewhere(system, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, system],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "no OpenGL context" in done.stderr
    assert all(
        (tmp_path / name).stat().st_size > 10_000 for name in ("report.html", "explorer.html")
    )


PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
EXTRAS = {"exr", "hdr", "draco", "lod", "rays", "mp4", "batch", "measure"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [*PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, ROOT], check=True
    )
    (path,) = folder.glob("facerender-*.whl")
    return path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The sdist, and a wheel built from the sdist."""
    folder = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "build", "--no-isolation", "-o", folder, ROOT]
    subprocess.run(command, check=True, capture_output=True)
    return [*folder.glob("*.tar.gz"), *folder.glob("*.whl")]


def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        return message_from_bytes(archive.read(name))


def contents(wheel: Path) -> dict[str, bytes]:
    with ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.wheel
def test_wheel_has_the_committed_files_of_the_package(wheel, built):
    listed = subprocess.run(
        ["git", "ls-files", "facerender", "shaders", "assets/head.glb", "assets/relief.npy"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()
    expected = {re.sub("^(?=shaders/|assets/)", "facerender/", name) for name in listed}
    found = contents(wheel)
    assert {name for name in found if ".dist-info/" not in name} == expected
    _, of_sdist = built
    assert contents(of_sdist) == found


@pytest.mark.wheel
def test_shaders_install_from_the_sdist(built, tmp_path):
    committed = ["git", "ls-files", ":!.ci"]
    listed = subprocess.run(committed, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    with tarfile.open(built[0]) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    found = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    assert found == {*listed.splitlines(), "PKG-INFO"}
    make = ["make", "install-shaders", f"PREFIX={tmp_path / 'prefix'}"]
    subprocess.run(make, cwd=source, check=True, capture_output=True)
    share = tmp_path / "prefix/share"
    for name in (
        "facerender/shaders/facerender/ward.glsl",
        "pkgconfig/facerender-shaders.pc",
        "cmake/facerender_shaders/facerender_shadersConfig.cmake",
    ):
        assert (share / name).is_file()


@pytest.mark.wheel
def test_checkers_accept_the_packages(built):
    for tool, *arguments in (
        ("twine", "check", "--strict", *built),
        ("check_wheel_contents", built[1]),
    ):
        command = [sys.executable, "-m", tool, *arguments]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.wheel
def test_description_shows_on_an_index(wheel):
    text = metadata(wheel).get_payload()
    assert isinstance(text, str)
    links = re.findall(r"\]\(([^)]*)\)", text)
    page = require_module("readme_renderer.markdown").render(text)
    links += re.findall(r'(?:href|src)="([^"]*)"', page)
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    for shown in ("pip install facerender", "<table>", "10.1117/12.2569770"):
        assert shown in page
    assert "<!--" not in text
    assert "&lt;" not in page


@pytest.mark.wheel
def test_metadata_name_what_users_install(wheel):
    about = metadata(wheel)
    assert set(about.get_all("Provides-Extra", ())) == EXTRAS
    needed = [each for each in about.get_all("Requires-Dist", ()) if "extra ==" not in each]
    assert len(needed) <= 7, needed


def declared(requirements: Iterable[str]) -> set[str]:
    """Return the distributions that pip installs for requirements without extras."""
    found = set()
    for text in requirements:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            found |= {requirement.name} | declared(requires(requirement.name) or ())
    return found


@pytest.fixture
def clean(wheel: Path, tmp_path: Path) -> Path:
    """The folder of a virtual environment with the wheel, its declared dependencies, and pytest.

    Links to this Python's packages replace the downloads of pip."""
    folder = tmp_path / "clean"
    venv.create(folder, symlinks=True)
    python = folder / "bin/python"
    install = [*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel]
    subprocess.run(install, check=True)
    (site,) = folder.glob("lib/python*/site-packages")
    size = sum(path.stat().st_size for path in site.rglob("*"))
    names = declared(metadata(wheel).get_all("Requires-Dist", ()))
    for name in sorted(names | declared(["pytest"])):
        for top in {each.parts[0] for each in files(name) or ()} - {"..", "__pycache__"}:
            (site / top).symlink_to(distribution(name).locate_file(top))
        if name in names:
            size += sum(each.locate().stat().st_size for each in files(name) or ())
    assert size < 130e6  # compiled modules add 10 %
    return folder


def run_away(code, site, folder):
    environment = {**os.environ, "PYTHONPATH": str(site)}
    start = (
        "import facerender, sys\n"
        f"assert facerender.__file__.startswith({str(site)!r})\n"
        f"assert str(facerender.shader_dir()).startswith({str(site)!r})\n"
    )
    subprocess.run([sys.executable, "-c", start + code], check=True, cwd=folder, env=environment)


@pytest.mark.slow
@pytest.mark.smoke
@pytest.mark.wheel
def test_wheel_imports_and_has_its_data(wheel, tmp_path):
    with ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "facerender.load_mesh(); facerender.resolve_includes('#include \"facerender/ward.glsl\"')"
    )
    run_away(code, tmp_path / "site", tmp_path)


@pytest.mark.wheel
def test_wheel_runs_in_a_clean_environment(clean, tmp_path):
    require_backend("egl")
    away = tmp_path / "away"
    away.mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*command: str, status: int = 0) -> str:
        done = subprocess.run(
            [clean / "bin" / command[0], *command[1:]],
            cwd=away,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout

    (away / "box.obj").write_bytes(
        b"# J\xf6rg\n" + b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 4 3 1\nf 1 2 4\n"
    )
    (away / "one.jsonl").write_text('{"image.size": 32, "id": "one"}')
    run("facerender", "render", "box.obj", "-o", "box.png", "--size", "64")
    run("facerender", "render", "-o", "head.png", "--size", "64")
    run("facerender", "explore", "-o", "explorer.html")
    run("facerender", "batch", "one.jsonl", "-o", "out", "--workers", "1")
    run("facerender", "compare", "head.png", "head.png", "--report", "report.html")
    assert "lobe_exact" in run("facerender", "shaders", "flatten", "ward", "--target", "330")
    packages = json.loads(run("facerender", "doctor", "--json"))["packages"]
    assert all(packages[""].values())
    assert (away / "head.png").stat().st_size > 1000
    report = (away / "report.html").read_text(encoding="utf-8")
    for name in ("page.css", "viewer.js"):
        assert (ROOT / "facerender" / "page" / name).read_text(encoding="utf-8") in report
    explorer = (away / "explorer.html").read_text(encoding="utf-8")
    source = (ROOT / "facerender/explorer/browser/explorer.js").read_text(encoding="utf-8")
    assert source.splitlines()[-1] in explorer
    assert (away / "out/data/one/image.png").is_file()
    unused = "--facerender-unused=fail"  # option of the plugin
    run("python", "-m", "pytest", unused, status=pytest.ExitCode.NO_TESTS_COLLECTED)
