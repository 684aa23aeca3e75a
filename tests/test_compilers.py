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
from facerender.pricing.variants import INPUTS, PRINTED
from tests.conftest import missing

MEASUREMENTS = Path(__file__).parents[1] / "docs" / "measurements"
# By command: the module, the keys of the compiler versions and of the values, and the GPUs.
TABLES = {
    "amd": (amd, "driver", "statistics", amd.FAMILIES),
    "offline": (offline, "compilers", "instructions", offline.GPUS),
}
COMPILER = pytest.mark.compiler
SMOKE_FAMILY = pytest.param("navi21", marks=pytest.mark.smoke)


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


@pytest.fixture(params=[SMOKE_FAMILY, *(each for each in amd.FAMILIES if each != "navi21")])
def family(request):
    require("amd")
    return request.param


@pytest.fixture(params=offline.GPUS)
def gpu(request):
    require("offline")
    return request.param


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


@pytest.mark.slow
@COMPILER
def test_cost_is_in_cycles_of_the_vector_alu(family):
    product, exponential = {"navi21": (2, 2), "vega10": (4, 16)}[family]
    terms = {
        "none": ("", INPUTS),
        "eight products": ("", f"({INPUTS})" + 8 * " * l.x"),
        "exponential": ("", f"exp2({INPUTS})"),
    }
    found = amd.statistics(terms, family)
    assert found["none"] == amd.Statistics(0, 0, 0)
    assert found["eight products"].instructions == 8
    assert found["eight products"].inverse_throughput == 8 * product
    assert found["exponential"].inverse_throughput == exponential


@COMPILER
def test_instructions_are_net_and_special_ones_are_counted(gpu):
    terms = {
        "none": ("", INPUTS),
        "products": ("", f"({INPUTS}) * n.x * n.y * n.z * l.x * l.y * l.z * v.x * v.y"),
        "exponential": ("", f"exp2({INPUTS})"),
        "root and logarithm": ("", f"log2(sqrt({INPUTS}))"),
    }
    found = offline.statistics(terms, gpu)
    assert found["none"] == offline.Instructions(0, 0)
    assert found["products"].all == pytest.approx(8, abs=1)  # one product may be fused
    assert found["products"].special == 0
    assert found["exponential"].special == 1
    assert found["root and logarithm"].special == 2
    assert 1 <= found["exponential"].all <= 4  # it may include scaling for denormal numbers


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
                ("fr_nonsense(m)", r"fr_nonsense\(\), which is neither declared"),
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
