"""What Intel's and NVIDIA's compilers make of the specular terms is what
docs/measurements/offline.json says."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
from pathlib import Path

import pytest

from facerender.errors import InputError, NotMeasured
from facerender.pricing import offline, variants
from tests.conftest import missing

COMMITTED = Path(__file__).parents[1] / "docs" / "measurements" / "offline.json"
REWRITE = "python -m facerender.pricing.offline -o docs/measurements/offline.json writes it anew"


@pytest.fixture(scope="module")
def table():
    try:
        return offline.table()
    except NotMeasured as error:
        missing(str(error), "intel-opencl-icd" if "ocloc" in str(error) else "")


@pytest.mark.parametrize("gpu", offline.GPUS)
@pytest.mark.parametrize("model", variants.PRINTED)
def test_terms_have_the_instructions_that_the_table_says(table, gpu, model):
    committed = json.loads(COMMITTED.read_text(encoding="utf-8"))
    found, said = (t["instructions"][gpu][model] for t in (table, committed))
    if table["compilers"] == committed["compilers"]:
        assert found == said, REWRITE
        return
    assert found.keys() == said.keys(), REWRITE
    for name in said:
        assert found[name]["all"] == pytest.approx(said[name]["all"], rel=0.15), name


@pytest.mark.parametrize("gpu", offline.GPUS)
def test_instructions_are_net_and_special_ones_are_told(table, gpu):
    inputs = "dot(l, v) + n.x + m * f0"
    terms = {
        "none": ("", inputs),
        "products": ("", f"({inputs}) * n.x * n.y * n.z * l.x * l.y * l.z * v.x * v.y"),
        "exponential": ("", f"exp2({inputs})"),
        "root and logarithm": ("", f"log2(sqrt({inputs}))"),
    }
    found = offline.statistics(terms, gpu)
    assert found["none"] == offline.Instructions(0, 0)
    assert found["products"].all == pytest.approx(8, abs=1)  # one may be fused
    assert found["products"].special == 0
    assert found["exponential"].special == 1
    assert found["root and logarithm"].special == 2
    assert 1 <= found["exponential"].all <= 4  # a scale may go with it, for denormal numbers


@pytest.mark.parametrize("gpu", offline.GPUS)
def test_what_a_term_may_use_is_compiled(table, gpu):
    vectors = """#define FR_MASKING FR_MASKING_KELEMEN
#include "facerender/cook_torrance.glsl"
vec3 turned(vec3 a, float s) { return -s * a / 2.0 + vec3(s) - vec3(a.x, s, 1e-3); }
float several(vec2 a) { return mix(a.x, abs(a.y), 0.25) + pow(a.x, 5.0) + float(3); }
float more(vec3 a) { return several(vec2(a.y, clamp(a.z, 0.0, 1.0))) + inversesqrt(a.x); }
"""
    value = "fr_cook_torrance(normalize(n), l, v, m, f0) * more(turned(n, m))"
    found = offline.statistics({"vectors": (vectors, value)}, gpu)["vectors"]
    assert 30 < found.all < 120


@pytest.mark.parametrize(
    ("find", "nothing", "gpu", "remedy"),
    [
        ((shutil, "which"), lambda name: None, "skl", "apt-get install intel-opencl-icd"),
        (
            (importlib.metadata, "files"),
            lambda name: importlib.metadata.distribution("no such package"),
            "sm_75",
            r"pip install 'facerender\[compilers\]'",
        ),
    ],
)
def test_missing_tools_are_named(monkeypatch, find, nothing, gpu, remedy):
    monkeypatch.setattr(*find, nothing)
    with pytest.raises(NotMeasured, match=f"^.*{remedy}$"):
        offline.statistics({}, gpu)


@pytest.mark.parametrize("gpu", ["skl", "sm_75"])
def test_bad_input_is_named(table, gpu):
    with pytest.raises(InputError, match=r"unknown GPU 'voodoo'; known: skl, acm-g10, sm_75, sm"):
        offline.statistics({}, "voodoo")
    with pytest.raises(InputError, match="the function fr_nonsense, which is not known"):
        offline.statistics({"nonsense": ("", "fr_nonsense(m)")}, gpu)
    with pytest.raises(InputError, match=rf"does not compile the terms for {gpu}: .*error: .*dfdx"):
        offline.statistics({"slope": ("", "dFdx(m)")}, gpu)


def test_command_writes_the_table_or_one_line(monkeypatch, tmp_path, capsys, table):
    path = tmp_path / "offline.json"
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "which", lambda name: None)
        assert offline.main(["-o", str(path)]) == 2
    assert capsys.readouterr().err.startswith("facerender: error: ocloc is not installed; on")
    assert not path.exists()
    monkeypatch.setattr(offline, "table", lambda: table)
    assert offline.main(["-o", str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == table
