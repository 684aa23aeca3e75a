"""Tests the report of a measurement: dominated and recommended rows, tables, the page, and files
that are written completely or not at all."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from facerender import InputError
from facerender.measure import report
from facerender.measure.report import FRAME, LIMITS, TERM, measure_of, pareto, recommended
from tests.test_compare_report import Page
from tests.test_page import CONTRASTS
from tools.docs.tables.trade import measurement_of

MEASUREMENT = Path(__file__).parents[1] / "docs" / "measurements" / "llvmpipe.json"

COSTS = {  # cost in ns, and largest relative error of the image
    "printed, exact": (0.4, None),
    "exact": (0.8, 2e-5),
    "exact, m >= 0.2": (0.7, None),
    "d4": (0.7, 0.2),
    "d8": (0.6, 0.1),
    "d16": (0.6, 0.1),
    "cosine": (0.6, 0.3),
    "fitted": (0.9, 1e-5),
}


def variant(name, cost, largest):
    image = {"point": 0.1, "block": 0.1, "largest": largest, "percentile": 0.1, "steps": 3}
    interval = {"value": cost, "low": 0.99 * cost, "high": 1.01 * cost}
    return {
        "model": "cook-torrance",
        "name": name,
        "lobe": name.removeprefix("printed, ").split(",")[0],
        "cost": {
            "term_ns": interval,
            "lobe_ns": None,
            "frame_ms": interval if name == "exact" else None,
        },
        "error": {
            "lobe": {"0.3": 0.0 if "exact" in name else 2.5, "0.8": None},
            "brdf": {"0.3": 1.5, "0.8": None},
            "image": image | {"steps_percentile": 1.0, "flip": None} if largest else None,
        },
    }


@pytest.fixture
def data():
    return {
        "schema": "facerender.measure/2",
        "environment": {
            "date": "2026-01-31",
            "facerender": "0.1.0",
            "GL_RENDERER": "<llvm> & pipe",
            "GL_VERSION": "4.5",
            "software": True,
            "processor": "x86",
            "cores": 1,
            "python": "3.11",
            "numpy": "2.0",
        },
        "settings": {"mesh": "head", "m": 0.3, "size": [8, 8], "repeats": 3, "quick": True},
        "variants": [variant(name, *values) for name, values in COSTS.items()],
        "not_measured": ["FLIP needs a package"],
    }


@pytest.fixture
def triptychs():
    return {("cook-torrance", "d16"): np.zeros((8, 24, 3), np.uint8)}


def rows(data, kind=TERM):
    return pareto(measurement_of(data), "cook-torrance", kind)


def states(data):
    return {row.variant.name: row.dominated for row in rows(data)}


def compared(data):
    return measure_of(measurement_of(data), "cook-torrance")


def test_dominated_rows(data):
    assert states(data) == {
        "printed, exact": False,  # the cheapest, but published forms dominate nothing
        "cosine": True,  # same cost as d8, larger error
        "d8": False,
        "d16": False,  # same cost and error as d8
        "exact, m >= 0.2": False,
        "d4": True,
        "exact": True,  # same error, higher cost
        "fitted": True,  # errors below float32 rounding count as equal
    }


def test_costs_whose_intervals_overlap_count_as_equal(data):
    costs = {variant["name"]: variant["cost"]["term_ns"] for variant in data["variants"]}
    costs["d4"] |= {"value": 0.69, "low": 0.68, "high": 0.72}
    assert states(data)["d4"]  # its interval overlaps "exact, m >= 0.2" at 0.7
    costs["d8"]["low"] = costs["d16"]["low"] = costs["cosine"]["low"] = 0.5
    costs["d4"] |= {"value": 0.4, "low": 0.39, "high": 0.41}
    assert not states(data)["d4"]


def test_rows_are_ordered_by_cost(data):
    costs = [row.cost.value for row in rows(data)]
    assert costs == sorted(costs)
    frames = rows(data, FRAME)
    assert [row.variant.name for row in frames].index("exact") == 0
    assert not any(row.dominated for row in frames)


def test_errors_of_lobes_replace_missing_images(data):
    assert compared(data) == "image"
    data["variants"][3]["error"]["image"] = None
    assert compared(data) == "lobe"
    assert states(data)["d4"]
    assert {row.error for row in rows(data)} == {0.0, 2.5}


def test_rows_outside_the_domain_are_not_compared(data):
    data["settings"]["m"] = 0.8
    assert compared(data) == "image"
    for variant in data["variants"]:
        variant["error"]["image"] = None
    assert not any(states(data).values())
    assert "outside the domain" in report.table(measurement_of(data))


def test_tables_mark_dominated_rows_and_missing_values(data):
    text = report.table(measurement_of(data))
    lines = text.splitlines()
    d4 = next(line for line in lines if "d4" in line and "0.700" in line)
    assert "dominated" in d4
    assert "20.0" in d4  # percent
    assert "lobe alone" not in text  # no cost of a lobe was measured
    data["variants"][3]["cost"]["lobe_ns"] = {"value": 0.1, "low": 0.1, "high": 0.1}
    text = report.table(measurement_of(data))
    assert "lobe alone, ns" in text
    assert "not measured" in next(line for line in text.splitlines() if "d8" in line)
    frames = text.split("whole frame")[1]
    assert "exact" in frames
    assert "d4" not in frames  # no frame was drawn
    for row in data["variants"]:
        row["cost"]["frame_ms"] = None
    text = report.table(measurement_of(data))
    assert "not measured" in text.split("Whole frame")[1].lower()


def limits(data):
    best = recommended(measurement_of(data), "cook-torrance")
    return {row.variant.name: limits for limits, row in best}


def test_recommended_variants_are_the_cheapest_within_each_limit(data):
    assert limits(data) == {"exact, m >= 0.2": LIMITS}  # d8 has an error of 10 %
    lost = {variant["name"]: variant["error"]["image"] for variant in data["variants"]}
    lost["d8"]["largest"] = 0.02
    assert limits(data) == {"exact, m >= 0.2": (LIMITS[0], 1.0), "d8": (3.0,)}
    costs = {variant["name"]: variant["cost"]["term_ns"] for variant in data["variants"]}
    costs["exact, m >= 0.2"]["low"] = 0.6  # now the order of the two costs is unknown
    assert limits(data) == {"exact, m >= 0.2": LIMITS}
    for row in data["variants"]:
        row["error"]["image"] = row["error"]["image"] and row["error"]["image"] | {"largest": 0.5}
    assert limits(data) == {}
    assert "no variant has an error of at most 3 %" in report.table(measurement_of(data))


def test_recommendation_opens_text_and_json(data):
    data["variants"][4]["error"]["image"]["largest"] = 0.02  # d8
    measurement = measurement_of(data)
    first, second, *_ = report.table(measurement).splitlines()
    assert first.startswith('Cook-Torrance at m = 0.3: use "exact, m >= 0.2" (0.700 ns per ')
    assert 'or "d8" if an error of 3 % is acceptable (0.600 ns' in first
    assert "0.800 ms (95 % interval 0.792 to 0.808)" in second
    frame = data["variants"][4]["cost"]["term_ns"]
    data["variants"][4]["cost"]["frame_ms"] = frame
    text = report.table(measurement_of(data))
    assert "Faster lobes with an error of at most 3 %: d8 (0.600 ms)." in text
    assert "FR_LOBE FR_LOBE_EXACT, FR_SMALL_SLOPE 0" in text
    data["variants"][7]["cost"]["frame_ms"] = frame  # fitted; its term is dearer than the exact one
    assert "at most 3 %: d8 (0.600 ms)." in report.table(measurement_of(data))
    name, best = next(iter(report.content(measurement).items()))
    assert name == "recommended"
    assert [(each["name"], each["limits"]) for each in best] == [
        ("exact, m >= 0.2", [LIMITS[0], 1.0]),
        ("d8", [3.0]),
    ]


@pytest.mark.parametrize("spread", [1.0, 0.1, 0.01])
def test_names_are_nearest_to_their_own_points(data, spread):
    for i, each in enumerate(data["variants"]):
        cost = 0.6 + 0.4 * spread * i
        each["cost"]["term_ns"] = {"value": cost, "low": 0.99 * cost, "high": 1.01 * cost}
        if each["error"]["image"]:
            each["error"]["image"]["largest"] = 0.3 * (1.0 - 0.99 * spread) ** i
    svg = ElementTree.fromstring(report.trade(rows(data), "cost", "error"))
    circles = [(each.findtext("title"), each.find("circle").attrib) for each in svg.iter("g")]
    points = {name: (float(at["cx"]), float(at["cy"])) for name, at in circles}
    lines = {each.get("d").split("L")[0] for each in svg.iterfind("path")}
    names = [each for each in svg.iter("text") if "name" in each.get("class")]
    assert len(names) >= 3
    for each in names:
        x, y = points[each.text]
        if f"M{x:.1f} {y:.1f}" in lines:
            continue  # a line joins the name to its point
        left = (
            float(each.get("x"))
            - 8.0
            * len(each.text)
            * ({"start": 0.0, "middle": 0.5, "end": 1.0}[each.get("text-anchor")])
        )
        box = np.array([(left, float(each.get("y")) - 9.0), (0.0, float(each.get("y")))])
        box[1, 0] = left + 8.0 * len(each.text)
        away = {
            name: np.hypot(*np.maximum(0.0, np.maximum(box[0] - point, point - box[1])))
            for name, point in points.items()
        }
        assert away[each.text] <= min(away.values()) + 1.0


# Positions of the texts of a chart, and of the chart: [text, left, top, right, bottom].
TEXTS = """chart => [...chart.querySelectorAll("text"), chart].map(each => {
    const {left, top, right, bottom} = each.getBoundingClientRect();
    return [each.tagName === "svg" ? "" : each.textContent, left, top, right, bottom];
})"""


@pytest.mark.parametrize("source", ["own", "crowded", "llvmpipe"])
@pytest.mark.parametrize(("size", "scheme"), [((1280, 800), "light"), ((360, 640), "dark")])
def test_first_screen_recommends_and_shows_the_chart(data, browser, tmp_path, source, size, scheme):
    if source == "llvmpipe":
        data = json.loads(MEASUREMENT.read_text(encoding="utf-8"))
    elif source == "crowded":  # all costs and errors are almost equal
        for i, each in enumerate(data["variants"]):
            cost = 0.6 + 0.001 * i
            each["cost"]["term_ns"] = {"value": cost, "low": cost, "high": cost}
            if each["error"]["image"]:
                each["error"]["image"]["largest"] = 0.02 - 0.0001 * i
    path = report.write(measurement_of(data), {}, tmp_path)[-1]
    tab = browser.new_page(
        viewport=dict(zip(("width", "height"), size, strict=True)), color_scheme=scheme
    )
    tab.goto(path.as_uri())
    assert tab.evaluate("document.documentElement.scrollWidth") == size[0]
    assert tab.locator(".lead").first.text_content().startswith("Cook-Torrance at m = 0.3: use ")
    charts = tab.locator(".chart")
    bottom = charts.first.evaluate("chart => chart.getBoundingClientRect().bottom")
    assert bottom <= size[1]
    texts = [each.evaluate(TEXTS) for each in charts.all() if each.is_visible()]
    contrasts = tab.evaluate(CONTRASTS)
    height = tab.evaluate("document.documentElement.scrollHeight")
    tab.close()
    assert len(texts) == (2 if source == "llvmpipe" else 1)
    for *names, (_, left, top, right, bottom) in texts:
        assert all(each[1] >= left - 1 and each[3] <= right + 1 for each in names)
        assert all(each[2] >= top - 1 and each[4] <= bottom + 1 for each in names)
        overlaps = [
            (a[0], b[0])
            for a, b in combinations(names, 2)
            if a[1] < b[3] and b[1] < a[3] and a[2] + 2 < b[4] and b[2] + 2 < a[4]
        ]
        assert overlaps == []
        shown = {each[0] for each in names}
        assert "cost of the specular term, ns per evaluation" in shown
        assert any("% of" in each for each in shown)
    shown = {name for name, *_ in texts[0]}
    own = rows(data)
    assert {row.variant.name for row in own if not (row.dominated or row.variant.printed)} <= shown
    assert not {row.variant.name for row in own if row.variant.printed} & shown
    assert [(text, ratio) for text, ratio in contrasts if ratio < 4.5] == []
    assert height < 5000


def test_files(data, triptychs, tmp_path):
    paths = report.write(measurement_of(data), triptychs, tmp_path / "new" / "report")
    assert {path.name for path in paths} == {
        "measure.json",
        "images-cook-torrance-d16.png",
        "index.html",
    }
    assert sorted(paths) == sorted((tmp_path / "new" / "report").iterdir())
    content = json.loads(paths[0].read_text())
    assert content.pop("recommended")
    assert content == data

    page = Page(paths[-1])
    tags = [tag for tag, _, _ in page.tags]
    attributes = [each for _, each, _ in page.tags]
    assert not {*tags} & {"script", "link", "iframe", "object"}
    assert not any({"href", "srcset", "style"} & each.keys() for each in attributes)
    images = [each for tag, each, _ in page.tags if tag == "img"]
    assert all(each["src"].startswith("data:image/png;base64,") and each["alt"] for each in images)
    assert len(images) == len(paths) - 2
    source = paths[-1].read_text(encoding="utf-8")
    assert "url(" not in source.replace("url(#", "")  # only filters of the page itself
    assert "@import" not in source
    text = "".join(page.text.values())
    assert ("html", {"lang": "en"}, "") in page.tags
    for shown in ("<llvm> & pipe", "8 x 8", "FLIP needs a package"):
        assert shown in text
    order = ["svg", "table", "details"]
    assert sorted(order, key=tags.index) == order
    assert text.index("Machine and settings") > text.index("FLIP needs a package")
    assert {"class": "dominated"} in attributes


@pytest.mark.parametrize(
    ("fault", "kind", "message"),
    [
        ("image", MemoryError, None),
        ("number", ValueError, "not JSON compliant"),
        ("folder", InputError, "cannot create .*file/report: not a directory"),
    ],
)
def test_failed_report_writes_no_file(data, triptychs, tmp_path, monkeypatch, fault, kind, message):
    folder = tmp_path / "report"
    if fault == "image":
        monkeypatch.setattr("PIL.Image.fromarray", lambda *_: (_ for _ in ()).throw(MemoryError))
    elif fault == "number":
        data["variants"][1]["cost"]["term_ns"]["high"] = float("nan")
    else:
        (tmp_path / "file").touch()
        folder = tmp_path / "file" / "report"
    with pytest.raises(kind, match=message):
        report.write(measurement_of(data), triptychs, folder)
    assert [path.name for path in tmp_path.iterdir()] == ["file"] * (fault == "folder")
