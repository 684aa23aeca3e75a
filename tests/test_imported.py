"""``facerender measure --import``: what an explorer saved stands in a folder's measurement, and
what is damaged leaves it as it was."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from facerender.commands import main
from facerender.errors import InputError
from facerender.measure import plots, run
from facerender.measure.imported import Imported, read_imported
from facerender.measure.measurement import Measurement, Triptych

MEASURED = Path(__file__).parents[1] / "docs" / "measurements" / "llvmpipe.json"
GPU = "ANGLE (NVIDIA, NVIDIA GeForce RTX 3080 Direct3D11 vs_5_0 ps_5_0, D3D11)"


def spread(rounds):
    median, low, high = np.quantile(rounds, (0.5, 0.25, 0.75)).tolist()
    return {"median": median, "low": low, "high": high, "rounds": list(rounds)}


def saved(a=(2.0, 2.2, 2.1), b=(1.5, 1.6, 1.4), **changes):
    """As the button of the page saves it."""
    return {
        "kind": "facerender explorer cost",
        "version": "0.1.0",
        "gpu": GPU,
        "browser": "Mozilla/5.0 <b>",
        "method": "GPU timer",
        "unit": "ms a picture",
        "mesh": "tête | head.glb",
        "size": [872, 559],
        "samples": 4,
        "passes": 64,
        "link": "b=lobe:d8",
        "shadings": {"a": "cook-torrance, exact", "b": "cook-torrance, d8, m 0.3"},
        "base": spread([1.0, 1.1, 0.9]),
        "a": spread(a),
        "b": spread(b),
        "difference": spread([each - other for other, each in zip(a, b, strict=True)]),
        **changes,
    }


def write(path, content):
    path.write_text(json.dumps(content), encoding="utf-8")
    return str(path)


@pytest.fixture
def folder(tmp_path):
    """A folder with a measurement of one model without curves, which takes few plots."""
    content = json.loads(MEASURED.read_text(encoding="utf-8"))
    content["variants"] = [row for row in content["variants"] if row["model"] == "ward"][:4]
    content["curves"] = {"degrees": []}
    (tmp_path / "measure").mkdir()
    write(tmp_path / "measure" / "measure.json", content)
    return tmp_path / "measure"


@pytest.fixture
def measured(monkeypatch, folder):
    """Counts what is measured, which is the folder's measurement again; plots are not drawn."""
    content = json.loads((folder / "measure.json").read_text())
    counted = []

    def measure(*arguments):
        counted.append(arguments)
        return Measurement.from_dict(content), []

    monkeypatch.setattr(run, "measure", measure)
    monkeypatch.setattr(plots, "trade", lambda *arguments: b"a plot")
    return counted


def imports_of(folder):
    return json.loads((folder / "measure.json").read_text(encoding="utf-8")).get("imports")


def test_a_file_is_read_and_written_unchanged(tmp_path):
    content = saved()
    imported = read_imported(write(tmp_path / "cost.json", content))
    assert imported.size == (872, 559)
    assert imported.difference.rounds == pytest.approx([-0.5, -0.6, -0.7])
    measurement = Measurement.from_dict(json.loads(MEASURED.read_text(encoding="utf-8")))
    assert "imports" not in measurement.as_dict()
    measurement = measurement.with_import(imported)
    (row,) = measurement.as_dict()["imports"]
    assert row == {key: value for key, value in content.items() if key not in ("kind", "unit")}
    assert Measurement.from_dict(json.loads(json.dumps(measurement.as_dict()))) == measurement


def test_imports_are_added_to_what_was_measured(folder, measured, tmp_path, capsys):
    slow = write(tmp_path / "slow.json", saved())
    even = saved(b=(2.0, 2.3, 2.05), gpu="Mali-G78")
    other = write(tmp_path / "other.json", even)
    before = json.loads((folder / "measure.json").read_text())
    strip = folder / "images-ward-exact.png"
    strip.write_bytes(b"PNG")
    assert main(["measure", "--import", slow, "--import", other, "-o", str(folder)]) == 0
    printed = capsys.readouterr()
    assert f"{slow}: {GPU}: added" in printed.err
    assert f"{other}: Mali-G78: added" in printed.err
    *_, first, second = printed.out.split("\n\n")
    assert first.startswith(f"{GPU}, in the explorer\n")
    assert "#b=lobe:d8" in first
    assert [line.split()[-4] for line in first.splitlines()[3:]] == [
        "1.00",
        "2.10",
        "1.50",
        "-0.600",
    ]
    assert second.startswith("Mali-G78")
    assert "not told apart" in second.splitlines()[-1]
    content = json.loads((folder / "measure.json").read_text())
    assert [each["gpu"] for each in content.pop("imports")] == [GPU, "Mali-G78"]
    assert content == before
    page = (folder / "index.html").read_text(encoding="utf-8")
    for shown in (GPU, "B: cook-torrance, d8, m 0.3", "tête | head.glb, 872 x 559", "#b=lobe:d8"):
        assert shown in page
    assert "UE5H" in page  # the strip that was there, as base64
    assert not measured

    faster = saved(b=(1.1, 1.2, 1.0))
    again = write(tmp_path / "again.json", faster)
    assert main(["measure", "--import", again, "-o", str(folder), "--json"]) == 0
    printed = capsys.readouterr()
    assert f"{again}: {GPU}: in place of an earlier one" in printed.err
    assert json.loads(printed.out)["imports"] == imports_of(folder)
    assert [each["b"] for each in imports_of(folder)] == [even["b"], faster["b"]]
    third = write(tmp_path / "third.json", saved(link=""))  # another picture on the same GPU
    assert main(["measure", "--import", third, "-o", str(folder)]) == 0
    assert len(imports_of(folder)) == 3
    assert not measured


def test_a_folder_without_a_measurement_is_measured(measured, tmp_path, capsys):
    file = write(tmp_path / "cost.json", saved())
    new = tmp_path / "new"
    assert main(["measure", "--import", file, "-o", str(new)]) == 0
    assert len(measured) == 1
    assert [each["gpu"] for each in imports_of(new)] == [GPU]
    capsys.readouterr()
    # What is asked for is measured, and what was imported stays.
    other = write(tmp_path / "other.json", saved(gpu="Mali-G78"))
    assert main(["measure", "--quick", "--import", other, "-o", str(new)]) == 0
    assert len(measured) == 2
    assert main(["measure", "-o", str(new)]) == 0
    assert len(measured) == 3
    assert [each["gpu"] for each in imports_of(new)] == [GPU, "Mali-G78"]
    assert "Mali-G78" in (new / "index.html").read_text(encoding="utf-8")


def test_an_import_is_kept_by_a_measurement_of_another_version(folder, measured, tmp_path):
    content = json.loads((folder / "measure.json").read_text())
    row = {key: value for key, value in saved().items() if key not in ("kind", "unit")}
    write(folder / "measure.json", content | {"schema": "facerender.measure/0", "imports": [row]})
    file = write(tmp_path / "cost.json", saved(gpu="Mali-G78"))
    assert main(["measure", "--import", file, "-o", str(folder)]) == 2  # there is nothing to add to
    assert main(["measure", "-o", str(folder)]) == 0
    assert [each["gpu"] for each in imports_of(folder)] == [GPU]


NESTED = "[" * 100_000
WRONG = {  # what is wrong with a file, and what is told
    "no JSON": (b"\x89PNG", "it is no JSON"),
    "cut": (json.dumps(saved())[:-20].encode(), "it is no JSON"),
    "deep": (NESTED.encode(), "it is no JSON"),
    "list": (b"[]", "the whole is [], not an object of JSON"),
    "large": (b" " * 2_000_000, "cost.json has 2000000 bytes, of 1048576 at most"),
    "digits": (b'{"kind": ' + b"9" * 5000 + b"}", "it is no JSON"),
    "foreign": ({"kind": "three.js"}, "kind is 'three.js', not 'facerender explorer cost'"),
    "measurement": ({"schema": "facerender.measure/1"}, "kind is None"),
    "unit": (saved(unit="s"), "unit is 's', not 'ms a picture'"),
    "gpu": (saved(gpu=3), "gpu is 3, not a line"),
    "no gpu": (saved(gpu=" "), "gpu is ' ', not a line"),
    "escape": (saved(gpu="a\x1b[2Jb"), r"gpu is 'a\x1b[2Jb', not a line"),
    "lines": (saved(mesh="a\nb"), r"mesh is 'a\nb', not a line"),
    "surrogate": (saved(mesh="\ud800"), r"mesh is '\ud800', not a line"),
    "long": (saved(link="a" * 5000), "link is 'aaaa"),
    "method": (saved(method=["GPU timer"]), "method is ['GPU timer'], not GPU timer or fence"),
    "size": (saved(size=[872]), "size is [872], not width and height"),
    "side": (saved(size=[872, -1]), "size is -1, not a whole number from 1 to 32768"),
    "samples": (saved(samples=True), "samples is True, not a whole number"),
    "passes": (saved(passes=1.5), "passes is 1.5, not a whole number"),
    "shadings": (saved(shadings={"a": "x"}), "shadings.b is None, not a line"),
    "spread": (saved(base=3.0), "base is 3.0, not an object of JSON"),
    "rounds": (saved(base=spread([1.0]) | {"rounds": []}), "base.rounds is [], not 1 to 1000"),
    "NaN": (saved(base=spread([1.0]) | {"rounds": [math.nan]}), "base.rounds is nan, not a number"),
    "infinite": (saved(base=spread([1.0]) | {"high": math.inf}), "base.high is inf, not a number"),
    "text": (saved(base=spread([1.0]) | {"rounds": ["1"]}), "base.rounds is '1', not a number"),
    "true": (saved(base=spread([1.0]) | {"rounds": [True]}), "base.rounds is True, not a number"),
    "huge": (saved(base=spread([1.0]) | {"rounds": [10**400]}), "not a number of milliseconds"),
    "median": (saved(a=(2.0, 2.2, 2.1)) | {"a": spread([2.0]) | {"median": 1}}, "a.median is 1.0"),
    "fewer": (saved(base=spread([1.0])), "base, a, b, difference have unlike numbers of rounds"),
    "apart": (saved(difference=spread([0.1, 0.1, 0.1])), "not those of b less those of a"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_refused(name, folder, measured, tmp_path, capsys):
    content, told = WRONG[name]
    path = tmp_path / "cost.json"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    good = write(tmp_path / "good.json", saved())
    before = (folder / "measure.json").read_bytes()
    for place in (folder, tmp_path / "new"):
        assert main(["measure", "--import", good, "--import", str(path), "-o", str(place)]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith(f"facerender: error: {path}")
        assert told in err
        assert re.search("; give (a file that|what) the explorer saved\n$", err)
        assert err.count("\n") == 1
        assert len(err) < 400
    assert [each.name for each in folder.iterdir()] == ["measure.json"]
    assert (folder / "measure.json").read_bytes() == before
    assert not (tmp_path / "new").exists()
    assert not measured


@pytest.mark.parametrize("name", sorted({*saved()} - {"kind", "unit"}))
def test_every_value_is_needed(name):
    content = saved()
    del content[name]
    with pytest.raises(InputError, match=f"^{name} is missing$"):
        Imported.from_dict(content)


def test_a_file_that_cannot_be_read_is_told(tmp_path, capsys):
    for path, why in ((tmp_path / "absent.json", ": no such file"), (tmp_path, " is a directory")):
        assert main(["measure", "--import", str(path), "-o", str(tmp_path / "new")]) == 2
        told = capsys.readouterr().err
        assert f"{path}{why}" in told
        assert told.endswith("; give what the explorer saved\n")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("content", "told", "plain"),
    [
        ("{", "is no JSON; move it away, or give another folder", 2),
        ("[]", "is no measurement; move it away, or give another folder", 0),
        ('{"schema": "facerender.measure/9"}', "measure anew", 0),
        ('{"schema": "facerender.measure/1"}', "is no measurement; move it away", 0),
        ('{"imports": [{"gpu": 3}]}', "version is missing; move it away", 2),
        ('{"imports": 3}', "imports is no list; move it away", 2),
    ],
)
def test_a_damaged_measurement_is_not_added_to(
    folder, measured, tmp_path, capsys, content, told, plain
):
    """And a new one takes its place, unless what it had imported would be lost."""
    (folder / "measure.json").write_text(content)
    file = write(tmp_path / "cost.json", saved())
    assert main(["measure", "--import", file, "-o", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"facerender: error: {folder / 'measure.json'}")
    assert told in error
    assert error.count("\n") == 1
    assert not measured
    assert (folder / "measure.json").read_text() == content
    assert main(["measure", "-o", str(folder)]) == plain
    assert len(measured) == (plain == 0)


def test_a_report_keeps_its_pictures(folder, measured, tmp_path, monkeypatch):
    def measure(*arguments):
        content = json.loads(MEASURED.read_text(encoding="utf-8"))
        content["variants"] = [row for row in content["variants"] if row["model"] == "ward"]
        content["curves"] = {"degrees": []}
        black = [np.zeros((8, 8, 3), np.uint8) for _ in range(3)]
        return Measurement.from_dict(content), [Triptych("ward", "d16", *black)]

    monkeypatch.setattr(run, "measure", measure)
    assert main(["measure", "-o", str(folder)]) == 0
    page = (folder / "index.html").read_text(encoding="utf-8")
    files = {each.name: each.read_bytes() for each in folder.glob("*.png")}
    file = write(tmp_path / "cost.json", saved())
    assert main(["measure", "--import", file, "-o", str(folder)]) == 0
    now = (folder / "index.html").read_text(encoding="utf-8")
    assert {each.name: each.read_bytes() for each in folder.glob("*.png")} == files
    start = now.index("<h2>Images</h2>")
    assert now[start:] == page[page.index("<h2>Images</h2>") :]
