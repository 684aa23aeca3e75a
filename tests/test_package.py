"""Tests the package: the wheel works outside the checkout, and modules respect the import rules."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.conftest import require_backend

ROOT = Path(__file__).parents[1]

# Modules that must not import OpenGL; see the import rules in CONTRIBUTING.md.
WITHOUT_GL = [
    *("errors", "system.data", "images.read", "lobes", "brdf", "shading", "loading"),
    *("glsl.library", "glsl.catalogue", "glsl.includes"),
    *("scenes.scene", "scenes.file", "scenes.view", "scenes.texture"),
    *("drawing.frame", "drawing.reference", "drawing.prepare"),
    *("comparison.compare", "comparison.flip", "comparison.visualization"),
    *("comparison.goldens", "comparison.report", "page.document"),
    *("batch.jobs", "batch.outputs", "batch.supervisor", "batch.coordinator", "batch.folder"),
    *("pricing.interval", "pricing.variants"),
    *("measure.measurement", "measure.pareto", "measure.tables", "measure.plots", "measure.report"),
]


def import_graph(folder: Path) -> subprocess.CompletedProcess[str]:
    tool = ROOT / "tools/import-graph"
    return subprocess.run([sys.executable, tool, folder], capture_output=True, text=True)


def test_import_graph_has_no_cycle_and_no_wrong_arrow():
    done = import_graph(ROOT / "facerender")
    assert (done.returncode, done.stderr) == (0, "")
    arrows = {room: set(below) for room, *below in map(str.split, done.stdout.splitlines())}
    assert not any("commands" in below for room, below in arrows.items() if room != "__main__")
    assert arrows["terms"] == {"errors"}


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


IMPORT_EACH = """
import sys, types
from importlib import import_module

folder, *modules = sys.argv[1:]
sys.modules["moderngl"] = sys.modules["glcontext"] = None
for module in modules:
    for name in [name for name in sys.modules if name.partition(".")[0] == "facerender"]:
        del sys.modules[name]
    package = sys.modules["facerender"] = types.ModuleType("facerender")
    package.__path__, package.__version__ = [folder], "0"
    try:
        import_module(f"facerender.{module}")
        assert "facerender.commands" not in sys.modules, "imports the commands"
    except (ImportError, AssertionError) as error:
        print(f"{module}: {error}")
"""


def test_modules_without_opengl_do_not_import_it():
    command = [sys.executable, "-c", IMPORT_EACH, ROOT / "facerender"]
    done = subprocess.run(
        [*command, *WITHOUT_GL, "drawing.context"], check=True, capture_output=True, text=True
    )
    lines = done.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["drawing.context"], lines


def test_importing_the_package_imports_no_heavy_module():
    code = "import sys, facerender\nprint(*{'trimesh', 'scipy', 'PIL'} & set(sys.modules))"
    output = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    assert output.stdout.strip() == ""


PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [*PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, ROOT], check=True
    )
    (path,) = folder.glob("facerender-*.whl")
    return path


def run_away(code, site, folder):
    environment = {**os.environ, "PYTHONPATH": str(site)}
    start = (
        "import facerender, sys\n"
        f"assert facerender.__file__.startswith({str(site)!r})\n"
        f"assert str(facerender.shader_dir()).startswith({str(site)!r})\n"
    )
    subprocess.run([sys.executable, "-c", start + code], check=True, cwd=folder, env=environment)


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
def test_wheel_renders_away_from_the_checkout(wheel, tmp_path):
    require_backend("egl")
    site = tmp_path / "site"
    subprocess.run([*PIP, "install", "--no-deps", "--target", site, wheel], check=True)
    code = (
        "from facerender.commands import main\n"
        "assert main(['render', '-o', 'head.png', '--size', '64']) == 0\n"
        "assert main(['explore', '-o', 'explorer.html']) == 0\n"
        "open('one.jsonl', 'w').write('{\"image.size\": 32, \"id\": \"one\"}')\n"
        "assert main(['batch', 'one.jsonl', '-o', 'out', '--workers', '1']) == 0\n"
        "sys.exit(main(['compare', 'head.png', 'head.png', '--report', 'report.html']))"
    )
    run_away(code, site, tmp_path)
    assert (tmp_path / "head.png").stat().st_size > 1000
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in ("page.css", "viewer.js"):
        assert (ROOT / "facerender" / "page" / name).read_text(encoding="utf-8") in report
    explorer = (tmp_path / "explorer.html").read_text(encoding="utf-8")
    source = (ROOT / "facerender/explorer/browser/explorer.js").read_text(encoding="utf-8")
    assert source.splitlines()[-1] in explorer
    assert (tmp_path / "out/data/one/image.png").is_file()
    command = [sys.executable, "-m", "pytest", "--facerender-unused=fail"]  # option of the plugin
    environment = {**os.environ, "PYTHONPATH": str(site)}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
    assert result.returncode == pytest.ExitCode.NO_TESTS_COLLECTED
