"""What AMD's compiler estimates for the specular terms is what docs/measurements/amd.json says."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import pytest

from facerender.errors import InputError, NotMeasured
from facerender.pricing import amd
from tests.conftest import missing

COMMITTED = Path(__file__).parents[1] / "docs" / "measurements" / "amd.json"
REWRITE = "python -m facerender.pricing.amd -o docs/measurements/amd.json writes the table anew"


@pytest.fixture(scope="module")
def table():
    try:
        return amd.table()
    except NotMeasured as error:
        missing(str(error))


@pytest.mark.parametrize("family", amd.FAMILIES)
@pytest.mark.parametrize("model", ["cook-torrance", "ward"])
def test_terms_cost_what_the_table_says(table, family, model):
    committed = json.loads(COMMITTED.read_text(encoding="utf-8"))
    found, said = (t["statistics"][family][model] for t in (table, committed))
    if table["driver"] == committed["driver"]:
        assert found == said, REWRITE
        return
    assert found.keys() == said.keys(), REWRITE
    for name in said:
        ratio, said_ratio = (
            rows[name]["inverse_throughput"] / rows["printed, exact"]["inverse_throughput"]
            for rows in (found, said)
        )
        assert ratio == pytest.approx(said_ratio, rel=0.15), f"{name}, {table['driver']}"


@pytest.mark.parametrize(
    ("family", "product", "exponential"), [("navi21", 2, 2), ("vega10", 4, 16)]
)
def test_cost_is_in_cycles_of_the_vector_alu(table, family, product, exponential):
    inputs = "dot(l, v) + n.x + m * f0"
    terms = {
        "none": ("", inputs),
        "eight products": ("", f"({inputs})" + 8 * " * l.x"),
        "exponential": ("", f"exp2({inputs})"),
    }
    cost = amd.statistics(terms, family)
    assert cost["none"] == amd.Statistics(0, 0, 0)
    assert cost["eight products"].instructions == 8
    assert cost["eight products"].inverse_throughput == 8 * product
    assert cost["exponential"].inverse_throughput == exponential


@pytest.mark.parametrize(
    ("find", "nothing", "remedy"),
    [
        ((shutil, "which"), lambda name: None, "apt-get install glslang-tools"),
        ((amd, "ICD_FOLDERS"), (), "apt-get install mesa-vulkan-drivers libvulkan1"),
        ((importlib.util, "find_spec"), lambda name: None, r"pip install 'facerender\[measure\]'"),
        ((amd.sys, "executable"), "/bin/false", "apt-get install mesa-vulkan-drivers libvulkan1"),
    ],
)
def test_missing_tools_are_named(monkeypatch, table, find, nothing, remedy):
    monkeypatch.setattr(*find, nothing)
    with pytest.raises(NotMeasured, match=f"^.*{remedy}$"):
        amd.statistics({"not compiled before": (f"// {remedy}", "m")}, "navi21")


def test_bad_input_is_named(table):
    with pytest.raises(InputError, match="unknown family 'tesla'; known: navi21, vega10"):
        amd.statistics({}, "tesla")
    with pytest.raises(InputError, match=r"^fr_nonsense\(m\) is not GLSL: ERROR: .*fr_nonsense"):
        amd.statistics({"nonsense": ("", "fr_nonsense(m)")}, "navi21")


def test_command_writes_the_table_or_one_line(monkeypatch, tmp_path, capsys, table):
    path = tmp_path / "amd.json"
    monkeypatch.setattr(amd, "ICD_FOLDERS", ())
    assert amd.main(["-o", str(path)]) == 2
    assert capsys.readouterr().err.startswith("facerender: error: no RADV: no radeon_icd*.json")
    assert not path.exists()
    monkeypatch.setattr(amd, "table", lambda: table)
    assert amd.main(["-o", str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == table
