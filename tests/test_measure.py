"""Tests ``facerender measure``: the order of costs, known errors, JSON files and the command."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import facerender as fr
from facerender.commands import main
from facerender.drawing.context import Context
from facerender.errors import InputError
from facerender.measure import measurement as measuring
from facerender.measure.measurement import MODELS, SCHEMA, rows_of
from facerender.measure.report import content
from facerender.pricing import cost
from facerender.pricing.cost import Interval, Variant, bootstrap, lobe_terms, of_model, terms
from tests.awkward_files import MINI_HEAD
from tests.conftest import missing
from tests.meshes import with_geometry
from tools.docs.tables.trade import measurement_of

MEASUREMENT = Path(__file__).parents[1] / "docs" / "measurements" / "llvmpipe.json"
NANOSECOND = Interval(1.0, 0.9, 1.1)


def powers(count):
    return "", " + ".join(f"exp2(-c * {i}.0)" for i in range(1, count + 1))


@pytest.mark.slow
def test_costs_grow_with_the_number_of_operations(egl):
    measured = cost.by_slope(
        {"none": ("", cost.OF_COSINE), "four": powers(4), "sixteen": powers(16)},
        cost.OF_COSINE,
        repeats=7,
        backend=egl,
    )
    none, four, sixteen = measured.values()
    assert abs(none.value) < 0.1 * four.value
    assert 2.0 < sixteen.value / four.value < 8.0
    assert all(x.low <= x.value <= x.high for x in measured.values())


def test_interval_covers_the_spread_of_the_repeats():
    times = np.array([5.0, 1.0, 1.1, 0.9, 1.05, 0.95, 9.0, 1.0])
    (interval,) = bootstrap(lambda turns: np.quantile(times[turns], [0.25], axis=0), 8)
    assert interval.value == pytest.approx(0.9875)
    assert 0.9 <= interval.low <= interval.value <= interval.high < 5.0


@pytest.mark.parametrize(
    ("renderer", "software"),
    [("llvmpipe (LLVM 15.0.6, 256 bits)", True), ("softpipe", True), ("NVIDIA H200/PCIe", False)],
)
def test_software_drivers_are_known(renderer, software):
    assert Context("egl", None, None, renderer, "").software == software


def test_lobe_error_is_signed_and_relative_to_the_peak():
    degrees = np.linspace(0.0, 90.0, 9001)
    d16 = measuring.lobe_error("d16", 0.4, 4)
    assert 100.0 * np.abs(d16).max() == pytest.approx(9.50, abs=0.01)
    assert d16[0] == 0.0
    np.testing.assert_array_equal(d16[::100], measuring.lobe_error("d16", 0.4, 4, degrees[::100]))


def test_brdf_error():
    assert measuring.brdf_error(fr.Shading(), 0.3) == 0.0
    fine, fitted, d16 = (
        measuring.brdf_error(fr.Shading("ward", lobe), 0.3)
        for lobe in ("fitted-fine", "fitted", "d16")
    )
    assert 0.0 < fine < fitted < d16 < 0.1


def test_image_error_separates_pixels_from_weights():
    reference = np.full((64, 64, 3), 0.5)
    covered = np.ones((64, 64), bool)
    same = measuring.image_error(reference.astype(np.float32), reference, covered)
    names = ("point", "block", "largest", "steps", "flip")
    assert [same[name] for name in names] == [0, 0, 0, 0, 0]
    spot = reference.copy()
    spot[20, 20] += 0.2
    pixel = measuring.image_error(spot.astype(np.float32), reference, covered)
    assert pixel["point"] == pytest.approx(0.2)
    assert pixel["block"] < 0.002
    assert pixel["largest"] == pytest.approx(0.4)
    assert pixel["percentile"] == 0.0
    weight = measuring.image_error((reference * 1.04).astype(np.float32), reference, covered)
    assert weight["block"] == pytest.approx(0.04, rel=1e-4)
    assert weight["steps"] == weight["steps_percentile"] == 3


@pytest.mark.slow
def test_image_errors_are_in_the_order_of_the_lobes(egl, head):
    scene = fr.Scene(head.with_material(m=0.4))
    shadings = [fr.Shading(lobe=lobe) for lobe in ("exact", "fitted", "d16")]
    exact, fitted, d16 = measuring.image_errors(scene, shadings, (128, 128), egl)[2]
    assert exact["largest"] < 1e-4
    assert exact["largest"] < fitted["largest"] < d16["largest"]
    assert exact["steps"] <= 1 < d16["steps"]


@pytest.mark.parametrize(("model", "m"), [("cook-torrance", 0.15), ("ward", 0.12)])
def test_image_of_the_published_d16_has_no_clamp(egl, coarse_head, model, m):
    scene = fr.Scene(coarse_head.with_material(m=m))
    clamped, published = (Variant(model, "d16", printed).shading for printed in (False, True))
    _, images, errors = measuring.image_errors(scene, [clamped], (64, 64), egl, [published])
    assert len(images) == 1
    d16, unclamped = errors
    assert 0.0 < 100.0 * d16["largest"] < unclamped["largest"]
    assert measuring.brdf_error(published, m) > 1.0 > measuring.brdf_error(clamped, m)
    assert measuring.brdf_error(published, 0.4) == pytest.approx(measuring.brdf_error(clamped, 0.4))


@pytest.mark.parametrize("model", MODELS)
def test_every_lobe_is_measured(model):
    variants = of_model(model)
    names = [variant.name for variant in variants]
    assert len(set(names)) == len(names)
    assert list(terms(model)) == names
    assert set(fr.lobes.NAMES) < set(names)
    assert set(fr.lobes.NAMES) < set(lobe_terms(model))


def test_json_of_a_measurement_is_read_and_written_unchanged():
    text = MEASUREMENT.read_text(encoding="utf-8")
    measurement = measurement_of(json.loads(text))
    assert json.dumps(content(measurement), indent=1) + "\n" == text
    assert measurement_of(measurement) == measurement


def test_json_of_another_version_is_refused():
    with pytest.raises(
        InputError, match=r"schema is 'facerender.measure/9', not .*; measure again"
    ):
        measurement_of({"schema": "facerender.measure/9"})
    content = json.loads(MEASUREMENT.read_text(encoding="utf-8"))
    content["variants"][0]["name"] = "blinn"
    with pytest.raises(InputError, match=r"unknown variant 'blinn' of 'cook-torrance' in the meas"):
        measurement_of(content)


@pytest.fixture
def quicker(monkeypatch):
    """Three timed repeats and frames of 32 x 32 pixels; more would only narrow the intervals."""
    by_slope, frames = cost.by_slope, cost.frames
    monkeypatch.setattr(
        cost, "by_slope", lambda terms, of, repeats, *rest: by_slope(terms, of, 3, *rest)
    )
    monkeypatch.setattr(
        cost,
        "frames",
        lambda scene, shadings, size, repeats, *rest: frames(scene, shadings, (32, 32), 3, *rest),
    )


@pytest.fixture
def quickest(quicker, monkeypatch):
    """An invented cost of 1 ns per term."""

    def by_slope(terms, of, repeats, *rest):
        assert (of, repeats) == (cost.OF_VECTORS, 7)
        return dict.fromkeys(terms, NANOSECOND)

    monkeypatch.setattr(cost, "by_slope", by_slope)


@pytest.mark.slow
def test_missing_packages_are_named(egl, coarse_head, quickest, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    stages = []
    measurement, triptychs = measuring.measure(
        coarse_head, 0.65, quick=True, backend=egl, progress=lambda what, done: stages.append(what)
    )
    assert measurement["not_measured"] == [
        "FLIP needs flip-evaluator: pip install 'facerender[measure]'"
    ]
    assert "ward: frames" in stages
    rows = {(row["model"], row["name"]): row for row in measurement["variants"]}
    assert len(rows) == len(measurement["variants"]) == 2 * len(terms("ward"))
    for row in rows.values():
        assert row["cost"]["term_ns"] == asdict(NANOSECOND)
    printed = rows["cook-torrance", "printed, d16"]
    assert printed["error"]["lobe"]["0.2"] == pytest.approx(2.33e6, rel=0.01)
    assert rows["ward", "exact, m >= 0.2"]["error"]["lobe"]["0.1"] is None
    assert triptychs["ward", "d16"].shape == (256, 768, 3)
    largest = [triptychs["cook-torrance", lobe][:, 512:].max() for lobe in ("fitted", "d16")]
    assert largest == sorted({*largest})


@pytest.mark.slow
def test_m_changes_the_skin_only(egl, coarse_head, quickest, monkeypatch):
    eyes = fr.load_mesh().select("eyeballs").with_material(m=0.9)  # outside the domain of d16
    head = with_geometry(
        coarse_head,
        parts=(*coarse_head.parts, *eyes.parts),
        materials=(*coarse_head.materials, *eyes.materials),
    )
    drawn = []
    frames = cost.frames

    def record(scene, *rest):
        drawn.append(scene.mesh)
        return frames(scene, *rest)

    monkeypatch.setattr(cost, "frames", record)
    measurement, _ = measuring.measure(head, 0.25, quick=True, backend=egl)
    assert [[each.m for each in mesh.materials] for mesh in drawn] == 2 * [[0.25, 0.9]]
    assert drawn[0].materials[0].roughness_map is None
    images = {row["name"]: row["error"]["image"] for row in rows_of(measurement, "ward")}
    assert images["exact"]["largest"] < 1e-4 < images["d16"]["largest"]


@pytest.mark.slow
@pytest.mark.parametrize("speed", ["quickest", pytest.param("quicker", marks=pytest.mark.slow)])
def test_command_writes_everything(speed, egl, tmp_path, capsys, monkeypatch, request):
    request.getfixturevalue(speed)
    if speed == "quickest":
        errors = measuring.image_errors
        monkeypatch.setattr(measuring, "SLOPES", (0.3,))
        monkeypatch.setattr(
            measuring,
            "image_errors",
            lambda scene, own, size, *rest: errors(scene, own, (64, 64), *rest),
        )
    folder = tmp_path / "new" / "measure"
    command = ["measure", str(MINI_HEAD), "--quick", "--m", "0.25", "-o", str(folder)]
    assert main([*command, "--backend", egl]) == 0
    printed = capsys.readouterr()
    assert "Cook-Torrance, m = 0.25: specular term" in printed.out
    assert "dominated" in printed.out
    assert printed.err.splitlines()[-1] == str(folder / "index.html")
    data = json.loads((folder / "measure.json").read_text(encoding="utf-8"))
    assert data["schema"] == SCHEMA
    assert data["settings"]["mesh"] == MINI_HEAD.name
    assert all(x["cost"]["term_ns"]["value"] > 0.0 for x in data["variants"])
    if data["not_measured"]:
        missing("; ".join(data["not_measured"]))


def test_folder_that_cannot_be_written_is_refused(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main(["measure", "-o", str(tmp_path / "file" / "folder")]) == 2
    assert "folder: not a directory; give a writable folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
