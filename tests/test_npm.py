"""The npm package holds the library as flat strings, and the files themselves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import facerender as fr
from tests.conftest import node_tool

ROOT = Path(__file__).parents[1]

FUNCTIONS = {
    "cookTorrance": "fr_cook_torrance",
    "cookTorranceHalf": "fr_cook_torrance_half",
    "cookTorranceTwo": "fr_cook_torrance_two",
    "cookTorranceSample": "fr_cook_torrance_sample",
    "wardSample": "fr_ward_sample",
    "slopeSample": "fr_slope_sample",
    "albedo": "fr_cook_torrance_albedo",
    "environment": "fr_environment_cook_torrance",
    "scatter": "fr_scatter",
    "shadow": "fr_shadow_disc",
    "slopeVariance": "fr_slope_filtered",
    "ward": "fr_ward",
    "wardPrinted": "fr_ward_printed",
    "lobe": "fr_lobe",
    "lobeExact": "fr_lobe_exact",
    "lobeCosine": "fr_lobe_cosine",
    "lobeGPower": "fr_lobe_g_power",
    "lobeFitted": "fr_lobe_fitted",
    "fresnel": "fr_fresnel",
    "fresnelSchlick": "fr_fresnel_schlick",
    "fresnelDielectric": "fr_fresnel_dielectric",
    "masking": "fr_masking_of",
    "maskingVCavity": "fr_masking_v_cavity",
    "maskingKelemen": "fr_masking_kelemen",
    "halfVector": "fr_half_vector",
}


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A folder in which the packed package is installed."""
    folder = tmp_path_factory.mktemp("npm")
    subprocess.run([sys.executable, ROOT / "tools/npm-package", "-o", folder / "npm"], check=True)
    (folder / "package.json").write_text("{}")
    npm = node_tool("npm")
    subprocess.run([npm, "pack", "./npm"], cwd=folder, check=True, capture_output=True)
    (archive,) = folder.glob("facerender-shaders-*.tgz")
    assert archive.name == f"facerender-shaders-{fr.__version__}.tgz"
    install = [npm, "install", "--offline", f"./{archive.name}"]
    subprocess.run(install, cwd=folder, check=True, capture_output=True)
    return folder


def test_exports_are_flat_sources_with_their_functions(project):
    code = 'import * as all from "facerender-shaders"; console.log(JSON.stringify(all))'
    command = [node_tool("node"), "--input-type=module", "--eval", code]
    output = subprocess.run(command, cwd=project, check=True, capture_output=True, text=True)
    exports = json.loads(output.stdout)
    assert exports.keys() == FUNCTIONS.keys()
    for name, source in exports.items():
        assert f" {FUNCTIONS[name]}(" in source
        lines = [line.lstrip() for line in source.splitlines()]
        assert not any(line.startswith(("#include", "#version")) for line in lines)


def test_every_export_has_its_type_and_its_header(project):
    types = (project / "node_modules/facerender-shaders/index.d.ts").read_text(encoding="utf-8")
    for name in FUNCTIONS:
        assert f"\n */\nexport const {name}: string;\n" in types
    assert types.count("/**\n") == types.count("\n */\n") == len(FUNCTIONS)


def test_files_are_the_librarys(project):
    package = project / "node_modules/facerender-shaders"
    for file in (fr.shader_dir() / "facerender").rglob("*.glsl"):
        packed = package / "glsl" / file.relative_to(fr.shader_dir())
        assert packed.read_bytes() == file.read_bytes()
    assert {"LICENSE", "README.md"} <= {path.name for path in package.iterdir()}
