"""Tests the costs of specular terms by offline GPU compilers against the committed tables,
docs/measurements/amd.json and offline.json."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import re
import shutil
from functools import cache
from pathlib import Path

import pytest

from benchmarks.prices import amd, offline
from benchmarks.prices.__main__ import main
from facerender.errors import InputError, NotMeasured
from facerender.pricing.cost import PRINTED
from tests.conftest import missing

MEASUREMENTS = Path(__file__).parents[1] / "docs" / "measurements"
# By command: the module, the keys of the compiler versions and of the values, and the GPUs.
TABLES = {
    "amd": (amd, "driver", "statistics", amd.FAMILIES),
    "offline": (offline, "compilers", "instructions", offline.GPUS),
}
COMPILER = pytest.mark.compiler


@cache
def table_of(name):
    require(name)
    return TABLES[name][0].table()


@pytest.fixture(scope="module", params=TABLES)
def name(request):
    table_of(request.param)
    return request.param


@cache
def require(name):
    """Compile one term with each compiler of a table; skip the test if one is missing."""
    module, *_, gpus = TABLES[name]
    try:
        for gpu in gpus:
            module.statistics({"one": ("", "m")}, gpu)
    except NotMeasured as error:
        missing(str(error), "intel-opencl-icd" if "ocloc" in str(error) else "")


def cost(rows, term):
    """Return instructions, or cycles relative to the formula as published."""
    if "all" in rows[term]:
        return rows[term]["all"]
    return rows[term]["inverse_throughput"] / rows["printed, exact"]["inverse_throughput"]


@COMPILER
@pytest.mark.parametrize("model", PRINTED)
def test_costs_of_terms_equal_the_committed_table(name, model):
    _, version, figures, gpus = TABLES[name]
    committed = json.loads((MEASUREMENTS / f"{name}.json").read_text(encoding="utf-8"))
    rewrite = f"python -m benchmarks.prices {name} docs/measurements/{name}.json writes it anew"
    for each in gpus:
        found, expected = (t[figures][each][model] for t in (table_of(name), committed))
        if table_of(name)[version] == committed[version]:
            assert found == expected, rewrite
            continue
        assert found.keys() == expected.keys(), rewrite
        for term in expected:
            assert cost(found, term) == pytest.approx(cost(expected, term), rel=0.15), term


WHICH = (shutil, "which", lambda name: None)
FILES = lambda name: importlib.metadata.distribution("no such package")  # noqa: E731


def of_amd(replaced, remedy):
    return pytest.param(replaced, amd, "navi21", remedy, marks=COMPILER)


@pytest.mark.parametrize(
    ("replaced", "module", "gpu", "remedy"),
    [
        of_amd(WHICH, "apt-get install glslang-tools"),
        of_amd((amd, "ICD_FOLDERS", ()), "apt-get install mesa-vulkan-drivers libvulkan1"),
        of_amd((importlib.util, "find_spec", lambda name: None), "pip install --group compilers"),
        of_amd(
            (amd.sys, "executable", "/bin/false"), "apt-get install mesa-vulkan-drivers libvulkan1"
        ),
        (WHICH, offline, "skl", "apt-get install intel-opencl-icd"),
        ((importlib.metadata, "files", FILES), offline, "sm_75", "pip install --group compilers"),
    ],
)
def test_missing_tools_are_named(monkeypatch, replaced, module, gpu, remedy):
    if module is amd:
        require("amd")  # only the replaced tool is missing
    monkeypatch.setattr(*replaced)
    terms = {"not compiled before": (f"// {remedy}", "m")} if module is amd else {}
    with pytest.raises(NotMeasured, match=f"^.*{re.escape(remedy)}$"):
        module.statistics(terms, gpu)


@pytest.mark.parametrize(
    ("name", "gpu", "term", "error"),
    [
        ("amd", "tesla", "m", "unknown family 'tesla'; known: navi21, vega10"),
        ("amd", "navi21", "fr_nonsense(m)", r"^fr_nonsense\(m\) is not GLSL: ERROR: .*fr_nonsense"),
        ("offline", "voodoo", "m", "unknown GPU 'voodoo'; known: skl, acm-g10, sm_75, sm"),
        *(
            ("offline", gpu, term, error.format(gpu))
            for gpu in ("skl", "sm_75")
            for term, error in (
                ("fr_nonsense(m)", r"'fr_nonsense' : no matching overloaded function"),
                ("dFdx(m)", "does not compile the terms for {}: .*error: .*dfdx"),
            )
        ),
    ],
)
@COMPILER
def test_bad_input_is_named(name, gpu, term, error):
    require(name)
    with pytest.raises(InputError, match=error):
        TABLES[name][0].statistics({"bad": ("", term)}, gpu)


@pytest.mark.parametrize(
    ("name", "replaced", "error"),
    [
        ("amd", (amd, "ICD_FOLDERS", ()), "error: no RADV: no radeon_icd*.json"),
        ("offline", WHICH, "error: ocloc is not installed; on"),
    ],
)
def test_command_writes_the_table_or_one_line(monkeypatch, tmp_path, capsys, name, replaced, error):
    path = tmp_path / "table.json"
    table = json.loads((MEASUREMENTS / f"{name}.json").read_text(encoding="utf-8"))
    with monkeypatch.context() as patched:
        patched.setattr(*replaced)
        assert main([name, str(path)]) == 2
    assert capsys.readouterr().err.startswith(error)
    assert not path.exists()
    monkeypatch.setattr(TABLES[name][0], "table", lambda: table)
    assert main([name, str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == table
