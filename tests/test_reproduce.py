"""Tests the reproduction of the paper's figures and claims: known values, files, the document."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.paper import __main__ as paper
from benchmarks.paper import claims
from benchmarks.paper.report import Reproduction
from facerender import lobes
from facerender.errors import NotMeasured
from facerender.pricing.cost import Interval
from tests.conftest import missing

DOCS = Path(__file__).parents[1] / "docs" / "measurements"
FIGURES = [f"fig{number}.png" for number in range(1, 6)]


@pytest.fixture(scope="module")
def result(egl: str) -> Reproduction:
    return paper.reproduce(repeats=3, size=(48, 56))


@pytest.fixture(scope="module")
def errors() -> list[claims.Claim]:
    return claims.error_claims()


@pytest.mark.slow
def test_error_of_d16_is_judged_for_ward(errors):
    ward, ward_relative, ward_unclamped, *others = errors
    expected = {
        "0.1": 1.32,
        "0.2": 0.12,
        "0.25": 0.79,
        "0.3": 1.88,
        "0.4": 4.60,
        "0.5": 7.99,
        "0.6": 11.9,
    }
    assert ward.values == pytest.approx(expected, abs=0.05)
    assert ward.where == "of m = 0.1 to 0.7, at most 1.3 % from 0.103 to 0.274"
    assert ward_relative.values["0.2"] == pytest.approx(1.18, abs=0.005)
    assert ward_unclamped.values["0.2"] == pytest.approx(1.7e7, rel=0.02)
    assert {claim.verdict for claim in (ward, ward_relative, ward_unclamped)} == {"fails"}
    absolute, relative, unclamped = others
    assert relative.values["0.2"] == pytest.approx(1.13, abs=0.005)
    assert relative.where == "of m = 0.1 to 0.7, at most 1.3 % from 0.188 to 0.200"
    expected = {
        "0.1": 1.31,
        "0.2": 0.13,
        "0.25": 1.39,
        "0.3": 3.21,
        "0.4": 9.50,
        "0.5": 22.3,
        "0.6": 47.6,
    }
    assert absolute.values == pytest.approx(expected, abs=0.05)
    assert unclamped.values["0.2"] == pytest.approx(2.3e6, rel=0.02)
    assert {claim.verdict for claim in others} == {"for comparison"}


def test_figures_and_errors_of_another_slope(egl, monkeypatch, capsys, tmp_path):
    for m, error in ((0.25, 0.79), (0.35, 3.15)):
        ward, *_ = claims.error_claims([m])
        assert ward.values == pytest.approx({f"{m:g}": error}, abs=0.05)
        assert ward.verdict == ("holds" if m == 0.25 else "fails")
    monkeypatch.setattr(claims, "scalar_cost", lambda repeats: ({}, "none"))
    monkeypatch.setattr(claims, "glsl_cost", lambda *_: {})
    monkeypatch.setattr(claims, "amd_claims", list)
    assert paper.main(["-o", str(tmp_path), "--m", "0.25"]) == 0
    content = json.loads((tmp_path / "reproduction.json").read_text())
    assert "at m = 0.25 under" in content["figures"]["fig5.png"]
    assert [*content["claims"][0]["values"]] == ["0.25"]
    for figure in FIGURES:
        drawn, published = (np.asarray(Image.open(folder / figure).convert("RGB"), int)
                            for folder in (tmp_path, DOCS / "reproduction"))  # fmt: skip
        assert drawn.std() > 10.0
        assert drawn.shape != published.shape or np.abs(drawn - published).max() > 10
    assert paper.main(["-o", str(tmp_path), "--m", "0.8"]) == 2
    assert "error: m = 0.8 is outside the domain" in capsys.readouterr().err


@pytest.mark.compiler
def test_every_claim_has_a_verdict(result):
    verdicts = {"holds", "fails", "undecided", "not measured", "for comparison"}
    assert {claim.verdict for claim in result.claims} <= verdicts
    ours = [claim for claim in result.claims if "our exact" in claim.claim]
    unmeasured = [claim.where for claim in result.claims if claim.verdict == "not measured"]
    if unmeasured:
        missing("; ".join(unmeasured))
    assert len(ours) == 8
    for claim in result.claims:
        assert (claim.verdict == "for comparison") == (claim.paper == "")


@pytest.mark.compiler
def test_d16_gains_more_in_ward_than_in_cook_torrance(result):
    ratios = {claim.claim: claim.values["ratio"] for claim in result.claims[6:] if claim.values}
    cook_torrance = ratios["Cook-Torrance, whole term: D16 against exact, as printed"]
    assert cook_torrance < ratios["Ward, whole term: D16 against exact, as printed"]


@pytest.mark.compiler
def test_files(result, tmp_path):
    paths = result.write(tmp_path / "new" / "folder")
    assert [path.name for path in paths] == [*FIGURES, "reproduction.json", "index.html"]
    assert sorted(path.name for path in paths[0].parent.iterdir()) == sorted(p.name for p in paths)
    for path in paths[:5]:
        pixels = np.asarray(Image.open(path).convert("RGB"))
        assert pixels.std() > 10.0, path.name

    content = json.loads(paths[5].read_text())
    assert content["schema"] == "facerender.reproduce/1"
    assert set(content) == {"schema", "paper", "environment", "claims", "cost", "figures"}
    assert {"date", "GL_RENDERER", "GL_VERSION", "processor"} <= set(content["environment"])
    for claim in content["claims"]:
        fields = {"claim", "paper", "measured", "conditions", "verdict", "where", "values"}
        assert set(claim) == fields
    assert all(set(cost) == {"value", "low", "high"} for cost in content["cost"].values())
    assert list(content["figures"]) == FIGURES

    page = paths[6].read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "<script" not in page
    assert "http" not in page
    for claim in result.claims:
        assert claim.measured in page


@pytest.mark.compiler
def test_scalar_code_computes_the_lobes(tmp_path):
    if not shutil.which("cc"):
        missing("no C compiler")
    source = Path(claims.__file__).with_name("scalar.c")
    strict = ("-Wall", "-Wextra", "-Werror", "-std=c11")
    subprocess.run(
        ["cc", *claims.FLAGS, *strict, source, "-o", tmp_path / "scalar", "-lm"], check=True
    )
    output = subprocess.run(
        [tmp_path / "scalar", "1"], check=True, capture_output=True, text=True
    ).stdout.splitlines()
    means = dict(zip(output[0].split(), map(float, output[1].split()), strict=True))

    share = np.arange(4096) / 4096
    c, each = np.cos(share), 0.3 + 0.1 * share

    def mean(name: lobes.Lobe, m: float | np.ndarray) -> float:
        if name == "exact":
            return float((lobes.exact(c, m, 4) / (4.0 * m**2)).mean())
        n = 2.0 / m**2 - 4.0
        return float(((n / 16.0 * (c - 1.0) + 1.0) ** 16 / (4.0 * m**2)).mean())

    expected = {
        **{"printed_each": mean("exact", each), "printed_one": mean("exact", 0.3)},
        **{"exact_each": mean("exact", each), "d16_each": mean("d16", each)},
        **{"d16_one": mean("d16", 0.3), "d16_beforehand": mean("d16", 0.3)},
    }
    assert means == pytest.approx(expected, rel=1e-5)


def test_without_a_compiler_scalar_cost_is_not_measured(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(NotMeasured, match="needs the apt packages gcc and libc6-dev") as caught:
        claims.scalar_cost(2)
    (claim,) = claims.scalar_claims({}, str(caught.value))
    assert claim.verdict == "not measured"
    assert claim.where == str(caught.value)


@pytest.mark.parametrize(
    ("low", "high", "verdict"), [(2.1, 2.3, "holds"), (1.9, 2.1, "undecided"), (1.5, 1.9, "fails")]
)
def test_speed_claims_compare_the_whole_interval(low, high, verdict):
    one = Interval(1.0, 1.0, 1.0)
    slow = Interval((low + high) / 2.0, low, high)
    assert claims.speed_claim("", slow, one, "", "twice", 2.0).verdict == verdict


@pytest.mark.compiler
def test_command_writes_and_names_its_files(monkeypatch, capsys, tmp_path, result):
    monkeypatch.setattr(paper, "reproduce", lambda progress, m: progress("figures", 0.0) or result)
    assert paper.main(["-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == str(tmp_path / "out" / "fig1.png")
    assert len(printed.out.splitlines()) == 7
    assert printed.err == ""
    (tmp_path / "file").write_text("")
    assert paper.main(["-o", str(tmp_path / "file")]) == 2
    assert f"error: cannot create {tmp_path / 'file'}: " in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert paper.main(["-o", str(tmp_path / "none")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert printed.err.endswith("pip install matplotlib\n")
    assert not (tmp_path / "none").exists()


def test_document_has_the_errors_and_small_figures(errors):
    document = (DOCS / "reproduction.md").read_text(encoding="utf-8")
    for claim in errors:
        assert claim.measured in document
        assert claim.where in document
    sizes = [path.stat().st_size for path in (DOCS / "reproduction").glob("*.png")]
    assert len(sizes) == 5
    assert sum(sizes) < 400_000
