"""Tests job tables (``facerender.batch.jobs``): file formats, grids, random values, ids, error
and messages."""

from __future__ import annotations

import csv
import itertools
import json
import re
import sys
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from facerender.batch.jobs import OUTPUTS, ROW_KEYS, TABLES, JobTable, Row
from facerender.errors import FacerenderWarning, InputError
from facerender.scene.job import Job
from facerender.scene.light import LIGHTS, Light
from facerender.scene.scene import default_lights
from tests.conftest import require_module
from tests.settings import parse_light

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def write(name, content):
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return name


def read_jobs(path, common=MappingProxyType({})):
    """Return the rows of a table; raise InputError for its first fault."""
    rows = [*(table := JobTable(path, common))]
    for fault in table.faults:
        raise InputError(fault)
    return rows


def check_jobs(path, common=MappingProxyType({}), most=10):
    for _ in (table := JobTable(path, common, most)):
        pass
    return table


def write_rows(*rows):
    return write("rows.jsonl", "".join(f"{json.dumps(row)}\n" for row in rows))


def rows_of(*rows, common=MappingProxyType({})):
    return read_jobs(write_rows(*rows), common)


def toml_rows(text):
    return read_jobs(write("rows.toml", text))


# --- forms ---------------------------------------------------------------------------------------

ROWS = [
    {"id": "a", "mesh.path": "a.glb", "camera.azimuth": 30, "lights.0.azimuth": -40.5},
    {"id": "b", "mesh.path": "a.glb", "mesh.flip_v": True, "material.m": 0.25},
    {"id": "1e5", "mesh.path": "b.glb", "shading.lobe": "d16", "outputs": "image, mask"},
]


def write_csv(rows):
    with open("rows.csv", "w", encoding="utf-8-sig", newline="") as file:
        writer = csv.DictWriter(file, columns(rows))
        writer.writeheader()
        writer.writerows(rows)
    return "rows.csv"


def write_parquet(rows):
    table = {name: [row.get(name) for row in rows] for name in columns(rows)}
    table = require_module("pyarrow").table(table)
    require_module("pyarrow.parquet").write_table(table, "rows.parquet", row_group_size=2)
    return "rows.parquet"


def columns(rows):
    return list(dict.fromkeys(name for row in rows for name in row))


def toml_job(row):
    return "[[jobs]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in row.items())


WRITERS = {
    "jsonl": lambda rows: write("rows.jsonl", "\n\n".join(map(json.dumps, rows))),
    "csv": write_csv,
    "parquet": write_parquet,
    "toml": lambda rows: write("rows.toml", "\n".join(map(toml_job, rows))),
    "py": lambda rows: write("rows.py", f"def jobs():\n    yield from {rows!r}\n"),
}


@pytest.mark.parametrize("form", WRITERS)
def test_every_form_gives_the_same_rows(form):
    (row,) = rows_of({"lights.0.azimuth": -40.5})
    found = read_jobs(WRITERS[form](ROWS), {"image": {"size": "64x32"}, "exposure": 1})
    a, b = ({"path": str(Path.cwd() / name)} for name in ("a.glb", "b.glb"))
    lit = {"mesh": a, "camera": {"azimuth": 30}, **row.tables}
    image = {"image": {"size": [64, 32]}}
    assert found == [
        Row(0, "a", lit | image, exposure=1.0),
        Row(1, "b", {"mesh": a | {"flip_v": True}, "material": {"m": 0.25}} | image, exposure=1.0),
        Row(2, "1e5", {"mesh": b, "shading": {"lobe": "d16"}} | image, ("image", "mask"), 1.0),
    ]
    for row in found:
        assert json.loads(json.dumps(row.tables)) == row.tables
        Job.from_dict(row.tables)


def test_rows_of_parquet_may_be_nested():
    pa, pq = require_module("pyarrow"), require_module("pyarrow.parquet")
    lights = [{"azimuth": 1.0, "position": None}, {"azimuth": None, "position": [0.0, 1.0, 2.0]}]
    rows = {"camera": [{"azimuth": 1, "zoom": None}, None], "lights": [lights, None]}
    pq.write_table(pa.table(rows | {"environment": [{"file": None}] * 2}), "rows.parquet")
    assert [row.tables for row in read_jobs("rows.parquet")] == [
        {"camera": {"azimuth": 1}, "lights": [{"azimuth": 1.0}, {"position": [0.0, 1.0, 2.0]}]},
        {},
    ]


def test_rows_of_a_python_table_may_have_arrays_and_paths():
    name = write(
        "rows.py",
        "import numpy as np\nfrom pathlib import Path\n"
        "def jobs():\n"
        "    yield {'mesh': Path('a.glb'), 'camera.target': np.arange(3) / 2,\n"
        "           'camera.azimuth': np.float32(1.5), 'image.size': (4, np.int64(5))}\n",
    )
    (row,) = read_jobs(name)
    assert row.tables == {
        "mesh": {"path": str(Path.cwd() / "a.glb")},
        "camera": {"target": [0.0, 0.5, 1.0], "azimuth": 1.5},
        "image": {"size": [4, 5]},
    }


def test_cells_of_csv():
    text = (
        "\ufeffid,camera.azimuth,mesh.flip_v,camera.zoom,lights,shading.lobe,ambient,outputs\r\n"
        '007,+1.5,TRUE,.5,"[""key""]",d4,"[1, 2, 3]",mask\r\n'
        "\r\n"
        ' 1e3 ,1e1, false ,2.,"\n",,0.5,\r\n'
    )
    first, second = read_jobs(write("rows.csv", text))
    assert (first.id, second.id) == ("007", "1e3")
    assert first.tables["camera"] == {"azimuth": 1.5, "zoom": 0.5}
    assert first.tables["mesh"] == {"flip_v": True}
    assert first.tables["ambient"] == [1, 2, 3]
    assert Job.from_dict(first.tables).lights == (parse_light("key"),)
    assert second.tables == {
        "camera": {"azimuth": 10.0, "zoom": 2.0},
        "mesh": {"flip_v": False},
        "ambient": 0.5,
    }


def test_row_overrides_common_values():
    common = {
        "mesh": "a.glb",
        "camera.fov": 30,
        "lights": ["key", "rim"],
        "environment": "studio,20",
        "outputs": ["depth"],
    }
    first, second, third = rows_of(
        {"mesh.flip_v": True, "camera": {"zoom": 2}, "lights.1.azimuth": 5, "lights.2": "fill"},
        {"lights": [], "environment.scale": 2, "outputs": "image"},
        {"mesh": None, "camera": None, "environment": {"file": "x.hdr"}, "lights": "front"},
        common=common,
    )
    assert first.tables["mesh"] == {"path": str(Path.cwd() / "a.glb"), "flip_v": True}
    assert first.tables["camera"] == {"fov": 30, "zoom": 2}
    lights = Job.from_dict(first.tables).lights
    assert lights[0] == parse_light("key")
    assert lights[1] == replace(parse_light("rim"), azimuth=5.0)
    assert lights[2] == parse_light("fill")
    assert first.outputs == ("depth",)
    assert second.tables["lights"] == []
    assert second.tables["environment"] == {"file": "studio", "rotation": 20.0, "scale": 2}
    assert second.outputs == ("image",)
    assert third.tables["mesh"] == {"path": str(Path.cwd() / "a.glb")}
    assert third.tables["environment"] == {"file": str(Path.cwd() / "x.hdr"), "rotation": 20.0}
    assert Job.from_dict(third.tables).lights == (parse_light("front"),)
    assert common["lights"] == ["key", "rim"]


def test_row_overrides_its_scene(tmp_path):
    """It also overrides options. The scene of a row replaces the scene of the command."""
    text = "[camera]\nfov = 20\nzoom = 2\n[planned]\nsizes = [[48, 48]]\nsamples = 4"
    write("a.toml", f"ambient = 0.5\n{text}")
    write("b.toml", "background = 'none'\n[material]\nm = 0.2")
    common = {"scene": "a.toml", "camera.fov": 30}
    first, second = rows_of({"camera.azimuth": 5}, {"scene": "b.toml", "ambient": 1}, common=common)
    planned = {"sizes": [[48, 48]], "samples": 4}
    camera = {"fov": 30, "zoom": 2, "azimuth": 5}
    assert first.tables == {"ambient": 0.5, "camera": camera, "planned": planned}
    assert second.tables == {
        "ambient": 1,
        "background": "none",
        "material": {"m": 0.2},
        "camera": {"fov": 30},
    }


def test_paths_are_absolute_or_addresses():
    mesh = {"path": "../m/a.glb", "albedo": "s3://b/a.png", "normal_map": "/n.png"}
    (row,) = rows_of({"mesh": mesh, "environment": "studio"})
    assert row.tables["mesh"] == {
        "path": str(Path.cwd().parent / "m/a.glb"),
        "albedo": "s3://b/a.png",
        "normal_map": "/n.png",
    }
    assert row.tables["environment"] == {"file": "studio"}


def test_environment_replaces_other_lights():
    first, second = rows_of(
        {"environment": "studio"}, {"environment": "studio", "ambient": 0.1, "lights": "key"}
    )
    assert Job.from_dict(first.tables).lights == ()
    assert first.tables["ambient"] == 0
    assert second.tables["ambient"] == 0.1
    assert Job.from_dict(second.tables).lights == (parse_light("key"),)
    with pytest.raises(InputError, match="specular_lights names light 0: the scene has 0, counted"):
        rows_of({"environment.file": "studio", "shading.specular_lights": [0]})


def test_a_numbered_key_changes_one_light_of_the_default_lights():
    several = rows_of(
        {"lights.1.azimuth": 5},
        {"lights.3": "front"},
        {"lights.0": {"position": [0, 0, 2]}},
        {"lights.0.azimuth": 5, "environment": "studio"},
        {"lights": ["rim"]},
    )
    key, rim, fill = default_lights(False)
    assert [Job.from_dict(row.tables).lights for row in several] == [
        (key, replace(rim, azimuth=5.0), fill),
        (key, rim, fill, LIGHTS["front"]),
        (Light(position=(0.0, 0.0, 2.0)), rim, fill),
        (Light(5.0),),
        (rim,),
    ]


def test_outputs_of_a_scene_file_are_left_out_with_a_warning():
    write("a.toml", "ambient = 1\n[[outputs]]\npath = 'a.png'")
    with pytest.warns(FacerenderWarning, match=r"the outputs of a\.toml are not used"):
        (row,) = rows_of({"scene": "a.toml"})
    assert (row.tables["ambient"], row.outputs) == (1, ("image",))


def test_a_scene_file_names_no_scene_file():
    write("a.toml", "scene = 'b.toml'")
    table = JobTable(write("rows.jsonl", '{"scene": "a.toml"}'))
    assert [*table] == []
    assert "unknown key 'scene'" in table.faults[0]


def test_each_table_reads_scene_files_again():
    write("rows.jsonl", '{"scene": "a.toml"}')
    for ambient in (0.5, 0.75):
        write("a.toml", f"ambient = {ambient}")
        (row,) = JobTable("rows.jsonl")
        assert row.tables["ambient"] == ambient


def test_every_row_of_a_sweep_has_the_scene_of_its_table():
    write("a.toml", "ambient = 0.5")
    rows = toml_rows("scene = 'a.toml'\nrandom.count = 3\nrandom.camera.azimuth.uniform = [0, 9]")
    assert [row.tables["ambient"] for row in rows] == [0.5] * 3


def test_lights_of_a_table_replace_the_lights_of_a_scene():
    write("a.toml", "lights = ['key', 'fill', 'front']")
    write("rows.toml", "scene = 'a.toml'\nlights = ['rim']\ngrid.lights.0.azimuth = [5]")
    (row,) = read_jobs("rows.toml")
    assert Job.from_dict(row.tables).lights == (replace(LIGHTS["rim"], azimuth=5.0),)


def test_names_of_shapes_and_joints_may_have_dots_or_only_digits():
    row = {"pose.joints": {"Bone.001": [0, 9, 0]}, "pose.joints.0": [1, 2, 3]}
    (row,) = rows_of({**row, "before": {"weights": {"a.b": 0.5, "0": 1.0}}})
    job = Job.from_dict(row.tables)
    assert job.pose.joints == {"Bone.001": (0.0, 9.0, 0.0), "0": (1.0, 2.0, 3.0)}
    assert job.before.weights == {"a.b": 0.5, "0": 1.0}
    assert Job.from_dict(job.as_dict()) == job


def test_keys_may_have_indices_of_lists():
    (row,) = rows_of(
        {
            "shading": {"lobe": "d16", "specular_lights.0": 1},
            "material.scattering.0": [1.0, 0.5, 0.5, 0.5],
            "image.size.1": 20,
            "image.size.0": 10,
            **{f"lights.{place}.azimuth": place for place in range(11)},
        }
    )
    assert row.tables["shading"] == {"lobe": "d16", "specular_lights": [1]}
    assert row.tables["material"] == {"scattering": [[1.0, 0.5, 0.5, 0.5]]}
    assert row.tables["image"] == {"size": [10, 20]}
    assert [light["azimuth"] for light in row.tables["lights"]] == [*range(11)]


# --- grids and random values ---------------------------------------------------------------------


def test_grid_has_every_combination_grouped_by_mesh():
    rows = toml_rows(
        """
        camera.fov = 30
        [[jobs]]
        material.m = 0.1
        [[jobs]]
        material.m = 0.2
        [grid]
        "camera.azimuth" = [0, 1]
        mesh = ["a.glb", "b.glb"]
        camera.elevation = [5]
        lights.0.azimuth = { from = 10, to = 20, step = 10 }
        """
    )
    keys = [
        (
            Path(row.tables["mesh"]["path"]).stem,
            row.tables["material"]["m"],
            row.tables["camera"]["azimuth"],
            row.tables["lights"][0]["azimuth"],
        )
        for row in rows
    ]
    assert keys == [*itertools.product("ab", (0.1, 0.2), (0, 1), (10, 20))]
    assert all(row.tables["camera"]["fov"] == 30 for row in rows)
    assert [row.number for row in rows] == [*range(16)]


def test_values_of_axes_may_be_tables_and_lists():
    rows = toml_rows(
        """
        [grid]
        mesh = ["a.glb", { path = "b.glb", flip_v = true }]
        lights = [["key"], [], ["rim", { azimuth = 3 }]]
        [random]
        environment = { choice = ["studio,20", { file = "studio", scale = 2 }] }
        """
    )
    names = [Path(row.tables["mesh"]["path"]).name for row in rows]
    assert names == ["a.glb"] * 3 + ["b.glb"] * 3
    assert [row.tables["mesh"].get("flip_v") for row in rows] == [None] * 3 + [True] * 3
    assert [len(row.tables["lights"]) for row in rows] == [1, 0, 2] * 2
    kinds = ({"file": "studio", "rotation": 20.0}, {"file": "studio", "scale": 2})
    assert all(row.tables["environment"] in kinds for row in rows)
    assert check_jobs("rows.toml").faults == []


@pytest.mark.parametrize(
    ("axis", "values"),
    [
        ("{ from = 0, to = 0.3, step = 0.1 }", [0.0, 0.1, 0.2, 0.3]),
        ("{ from = 0, to = 0.35, step = 0.1 }", [0.0, 0.1, 0.2, 0.3]),
        ("{ from = 3, to = 1, step = -1 }", [3, 2, 1]),
        ("{ from = 0, to = 1, count = 5 }", [0.0, 0.25, 0.5, 0.75, 1.0]),
        ("{ from = -10, to = 10, count = 3 }", [-10, 0, 10]),
        ("{ from = 0.1, to = 0.1, step = 1 }", [0.1]),
        ("{ from = 7, to = 9, count = 1 }", [7]),
        ("[1, 2.5]", [1, 2.5]),
    ],
)
def test_values_of_an_axis(axis, values):
    rows = toml_rows(f"[grid]\ncamera.azimuth = {axis}")
    found = [row.tables["camera"]["azimuth"] for row in rows]
    assert found == values
    assert [*map(type, found)] == [*map(type, values)]


RANDOM = """
[grid]
material.m = [0.1, 0.2]
[random]
count = {count}
seed = {seed}
camera.azimuth = {{ uniform = [-30, 60] }}
lights.0.irradiance = {{ log_uniform = [0.1, 10.0] }}
camera.elevation = {{ normal = [10, 5] }}
shading.lobe = {{ choice = ["exact", "d4", "fitted"] }}
"""


def random_values(rows):
    return [
        (
            row.tables["camera"]["azimuth"],
            row.tables["lights"][0]["irradiance"],
            row.tables["camera"]["elevation"],
            row.tables["shading"]["lobe"],
        )
        for row in rows
    ]


@pytest.mark.slow
def test_random_values_depend_on_seed_row_and_key_only():
    some = random_values(toml_rows(RANDOM.format(count=600, seed=3)))
    more = random_values(toml_rows(RANDOM.format(count=1100, seed=3)))
    assert more[:1200] == some
    assert some[:600] != some[600:]
    other = RANDOM.format(count=600, seed=3).replace(
        "[random]", "[random]\ncamera.fov.uniform = [1, 9]"
    )
    assert random_values(toml_rows(other)) == some
    quoted = RANDOM.format(count=600, seed=3).replace("camera.azimuth", '"camera.azimuth"')
    assert random_values(toml_rows(quoted)) == some
    assert random_values(toml_rows(RANDOM.format(count=600, seed=4)))[0] != some[0]


def test_random_values_have_their_distribution():
    rows = random_values(toml_rows(RANDOM.format(count=2000, seed=0)))
    azimuth, irradiance, elevation = (np.array(column) for column in [*zip(*rows, strict=True)][:3])
    deciles = np.arange(0.1, 1.0, 0.1)
    np.testing.assert_allclose(np.quantile(azimuth, deciles), -30 + 90 * deciles, atol=3)
    np.testing.assert_allclose(
        np.quantile(np.log10(irradiance), deciles), -1 + 2 * deciles, atol=0.1
    )
    assert azimuth.min() >= -30
    assert azimuth.max() <= 60
    assert irradiance.min() >= 0.1
    assert irradiance.max() <= 10
    assert abs(elevation.mean() - 10) < 0.3
    assert abs(elevation.std() - 5) < 0.3
    assert abs(np.corrcoef([azimuth, irradiance, elevation]) - np.eye(3)).max() < 0.06
    counts = [sum(row[3] == lobe for row in rows) for lobe in ("exact", "d4", "fitted")]
    assert min(counts) > 1200
    assert all(float(f"{value:.12g}") == value for row in rows for value in row[:3])


def test_rows_are_generated_lazily():
    text = "[grid]\ncamera.azimuth = { from = 0, to = 9, count = 100000000 }\nimage.size = [8, 9]"
    rows = itertools.islice(JobTable(write("rows.toml", text)), 3)
    assert [row.tables["image"]["size"][0] for row in rows] == [8, 9, 8]


@pytest.mark.slow
@pytest.mark.parametrize(
    "form",
    ["jsonl", *(pytest.param(form, marks=pytest.mark.memory) for form in ("csv", "toml", "py"))],
)
def test_memory_does_not_grow_with_the_table(form):
    count = 6_000
    texts = {
        "jsonl": '{"mesh": "a.glb", "camera.azimuth": 1.5}\n' * count,
        "csv": "mesh,camera.azimuth\n" + "a.glb,1.5\n" * count,
        "toml": f"[random]\ncount = {count}\ncamera.azimuth.uniform = [0, 1]",
        "py": f"def jobs():\n    for _ in range({count}):\n        yield {{}}",
    }
    name = write(f"rows.{form}", texts[form])
    check_jobs(name)  # Python keeps up to 2000 freed tuples of each length; fill these lists first.
    tracemalloc.start()
    assert check_jobs(name).rows == count
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**19  # a list of all lines would take more


# --- ids -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("template", "name"),
    [
        ("{number:06d}-{mesh.stem}-{camera.azimuth:+.0f}", "000000-my_head-30"),
        ("{camera.azimuth:+04.0f}_{lights.0}", None),
        ("x{lights.0.azimuth:.1f}", "x-5.5"),
        ("{number}{mesh.path:s}", "0_tmp_my_head.glb"),
        ("plain", "plain"),
        (12, "12"),
        ("{mesh.flip_v}", "true"),
    ],
)
def test_templates_of_ids(template, name):
    row = {"id": template, "mesh.path": "/tmp/my head.glb", "camera.azimuth": 30}
    row |= {"lights.0.azimuth": -5.5, "mesh.flip_v": True}
    if name is None:
        with pytest.raises(InputError, match="cannot be formatted as"):
            rows_of(row)
    else:
        assert rows_of(row)[0].id.startswith(name)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("a b", "id = 'a b': give 1 to 128 letters"),
        (".a", "id = '.a': give 1 to 128"),
        ("", "id = '': give 1 to 128"),
        ("a\n", r"id = 'a\\n': give"),
        ("a" * 129, "give 1 to 128"),
        (["a"], r"id = \['a'\]: give"),
        ("{", "is not a template: "),
        ("{number!r}", "is not a template: give {NAME} or {NAME:FORMAT}"),
        ("{}", "is not a template: give {NAME}"),
        ("{number:99999999d}", "is not a template: give {NAME}"),
        ("{number:{number}}", "is not a template: give {NAME}"),
        ("{camera.fov}", "uses camera.fov, which the row does not define"),
        ("{number.__class__}", "uses number.__class__, which the row does not define"),
        ("{mesh.stem:d}", "mesh.stem = 'head' cannot be formatted as 'd'"),
        ("../{number}", "id = '../0': give 1 to 128"),
    ],
)
def test_invalid_ids_are_refused(given, message):
    with pytest.raises(InputError, match=f"rows.jsonl, row 1 \\(line 1\\): .*{message}"):
        rows_of({"id": given})


# --- checks --------------------------------------------------------------------------------------


def test_check_counts_and_names_faults():
    lines = [
        {"mesh": "a.glb", "id": "same"},
        {"camera.elevation": 99, "mesh": "c.glb"},
        {},
        {"mesh": "b.glb", "image.samples": 4.0},
        {"mesh": "a.glb", "id": "same"},
        {"id": "00000002"},
        {"shading.specular_lights": [1], "lights": ["key"]},
        {"image.size": 20000},
        {"material": {"m": 1.5, "second_slope": 1.5, "lobe_weight": 0.5}},
    ]
    name = write("rows.jsonl", "\n".join(map(json.dumps, lines)))
    checked = check_jobs(name)
    assert (checked.rows, checked.meshes, checked.more) == (9, 2, 0)
    named = ["elevation = 99", "samples = 4.0", "light 1", "20000 x 20000", "second_slope = 2.25"]
    named += ["'same' is used by row 1", "'00000002' is used by row 3"]
    for row, text, fault in zip((2, 4, 7, 8, 9, 5, 6), named, checked.faults, strict=True):
        assert fault.startswith(f"rows.jsonl, row {row} (line {row}): ")
        assert text in fault
    few = check_jobs(name, most=2)
    assert few.faults == checked.faults[:2]
    assert few.more == 5
    assert check_jobs(name, most=6).more == 1


def test_rows_with_one_error_share_a_message():
    lines = [{"split": "train"}] * 40 + [{"image.samples": 0}, {}, {"image.samples": 0}, {"a": 1}]
    name = write("rows.jsonl", "\n".join(map(json.dumps, lines)))
    checked = check_jobs(name)
    starts = [fault.partition(";")[0] for fault in checked.faults]
    assert starts == [
        "rows.jsonl, rows 1 to 40: unknown key 'split'",
        "rows.jsonl, 2 rows from 41 to 43: image samples = 0: give 1 to 64",
        "rows.jsonl, row 44 (line 44): unknown key 'a'",
    ]
    assert checked.more == 0
    few = check_jobs(name, most=1)
    assert (few.faults, few.more) == (checked.faults[:1], 3)


def test_cached_checks_distinguish_values_and_types():
    """Equal tables are checked once. A number outside its range must not count as equal to a valid
    one, nor 1 as equal to True."""
    rows = [{"camera.azimuth": 1.0}, {"camera.azimuth": 4000.0}, {"mesh.flip_v": True}]
    rows += [{"mesh.flip_v": 1}, {"lights": ["key", {"radius": 1}]}, {"lights": [{"radius": 21}]}]
    rows += [{"image.samples": 4}, {"image.samples": 4.0}, {"image.samples": 65}]
    rows += [{"material": {"m": m, "second_slope": 1.5, "lobe_weight": 0.5}} for m in (0.5, 1.5)]
    checked = check_jobs(write("rows.jsonl", "\n".join(map(json.dumps, rows * 2))), most=20)
    assert [fault.split(":")[0] for fault in checked.faults] == [
        f"rows.jsonl, 2 rows from {row} to {row + 11}" for row in (2, 4, 6, 8, 9, 11)
    ]


def test_every_key_of_a_job_is_a_key_of_a_row():
    without = {"outputs", "cameras"}
    assert set(TABLES) == {each.name for each in fields(Job)} - without


DEEP = {"a": 1}
for _ in range(30):
    DEEP = {"a": DEEP}

BAD_FILES = [
    ("rows.txt", "", "unknown table format '.txt'; give .jsonl, .csv, .parquet, .toml or .py"),
    ("rows.jsonl", "", "rows.jsonl has no rows"),
    ("rows.jsonl", "[1]", r"rows.jsonl, row 1 \(line 1\): row = \[1\]: give a table"),
    ("rows.jsonl", "{}\n\n{", r"row 2 \(line 3\): not JSON: Expecting property name .* column 2"),
    ("rows.jsonl", '{"a": 1, "a": 2}', "not JSON: key 'a' is given twice"),
    ("rows.jsonl", '{"ambient": NaN}', "ambient = nan: give a finite number"),
    ("rows.jsonl", f'{{"ambient": {"9" * 400}}}', "= 9+ [.]{3} 9+: a whole number has at most 64"),
    ("rows.jsonl", f'{{"ambient": {"9" * 5000}}}', "not JSON: Exceeds the limit"),
    ("rows.jsonl", "[" * 100_000, "not JSON: nested too deep"),
    ("rows.jsonl", json.dumps(DEEP), "a has tables or lists 11 deep: use at most 10 levels"),
    ("rows.jsonl", json.dumps({"a" + ".a" * 1000: 1}), "has too many dots"),
    ("rows.jsonl", b"{}\n\xff\n", "rows.jsonl, line 2 is not UTF-8 .*save the file as UTF-8"),
    ("rows.jsonl", " " * 2**21, "line 1 has more than 1048576 bytes"),
    ("rows.jsonl", '{"colour": 1}', "unknown key 'colour'; known: id, outputs, exposure, tone"),
    ("rows.jsonl", '{"mesh": ""}', "mesh path = '' is not a path"),
    ("rows.jsonl", '{"mesh": "\\ud800"}', "mesh path = '.ud800' is not a path"),
    ("rows.jsonl", '{"mesh": "a", "mesh.path": "b"}', "mesh.path is given twice"),
    ("rows.jsonl", '{"camera": 1, "camera.fov": 2}', "camera.fov is given twice, or as a whole"),
    ("rows.jsonl", '{"lights.4.azimuth": 1}', "lights lacks item 3: count from 0"),
    (
        "rows.toml",
        'lights = ["key"]\ngrid.lights.2.azimuth = [1]',
        "rows.toml: lights lacks item 1: count from 0",
    ),
    ("rows.jsonl", '{"environment": "a,b"}', "environment 'a,b': give FILE"),
    ("rows.jsonl", '{"image.size": "64x"}', "image size '64x': give N or WxH"),
    ("rows.jsonl", '{"outputs": []}', r"outputs = \[\]: give a list of image, specular"),
    ("rows.jsonl", '{"outputs": "image,shine"}', "unknown output 'shine'; known: image"),
    ("rows.jsonl", '{"outputs": "mask,mask"}', "output mask is given twice"),
    ("rows.jsonl", '{"exposure": "1"}', "exposure = '1' is not a number"),
    ("rows.jsonl", '{"shading": {"fresnel": [[]]}}', r"rows.jsonl, row 1 \(line 1\): "),
    ("rows.jsonl", '{"scene": 3}', "scene = 3: give a path as text"),
    ("rows.jsonl", '{"scene": "no.toml"}', "row 1 .*cannot read no.toml: no such file"),
    ("rows.csv", "", "rows.csv has no rows"),
    ("rows.csv", "mesh,mesh\na,b\n", "rows.csv has two columns 'mesh': leave one out"),
    ("rows.csv", "mesh,\na,b\n", "rows.csv: a column has no name"),
    ("rows.csv", "mesh\na\na,b\n", r"row 2 \(line 3\): 2 cells in a table of 1 columns"),
    ("rows.csv", 'mesh\n"a\n', "rows.csv, line 2 is not CSV: unexpected end of data"),
    ("rows.csv", b"mesh\n\xe9\n", "rows.csv, line 2 is not UTF-8"),
    ("rows.csv", 'lights\n"[1,"\n', r"row 1 \(line 2\): a cell cannot be read: Expecting value"),
    ("rows.csv", "ambient\n" + "9" * 5000 + "\n", "a cell cannot be read: Exceeds the limit"),
    ("rows.csv", "ambient\n" + "9" * 200_000 + "\n", "line 2 is not CSV: field larger than"),
    ("rows.parquet", "PAR1", "rows.parquet is not a readable Parquet file"),
    ("rows.toml", "a = ", "rows.toml is not valid TOML: Invalid value"),
    ("rows.toml", "grid" + ".a" * 5000 + " = [1]", "rows.toml is not valid TOML: nested too deep"),
    ("rows.toml", "ambient = nan", "rows.toml: ambient = nan: give a finite number"),
    ("rows.toml", "grid = 3", r"rows.toml: grid = 3: give a table, \[grid\]"),
    ("rows.toml", "jobs = []", r"jobs = \[\]: give tables, \[\[jobs\]\]"),
    ("rows.toml", "[grid]\nambient = []", r"grid.ambient = \[\]: give a list of values"),
    ("rows.toml", "[grid]\ncolour = [3]", "row 1: unknown key 'colour'"),
    ("rows.toml", "[grid]\nambient = {from=0,to=1}", "give from, to, and step or count"),
    ("rows.toml", "[grid]\nambient = {from=0,to=1,step=0}", "step = 0 does not lead from 0 to 1"),
    ("rows.toml", "[grid]\nambient = {from='a',to=1,step=1}", "from = 'a': give a finite number"),
    ("rows.toml", "[grid]\nambient = {from=0,to=1,count=0}", "count = 0: give a whole number"),
    ("rows.toml", "[grid]\nambient = {from=0,to=1,step=1e-300}", "give numbers nearer to each"),
    ("rows.toml", "[grid]\nambient = {from=0,to=1,step=1e-10}", "10000000001 rows together: give"),
    ("rows.toml", "random.count = 0", "random.count = 0: give a whole number from 1"),
    ("rows.toml", "random.seed = -1", "random.seed = -1: give a whole number from 0"),
    ("rows.toml", "random.ambient.unifrom = [0, 1]", "random.ambient.unifrom = .*: give one of"),
    ("rows.toml", "random.ambient.uniform = [0]", r"uniform = \[0\]: give two numbers"),
    ("rows.toml", "random.ambient.uniform = [0, 'a']", "uniform = 'a': give a finite number"),
    ("rows.toml", "random.ambient.uniform = [1, 0]", r"\[1, 0\]: give the lower end first"),
    ("rows.toml", "random.ambient.log_uniform = [0, 1]", r"\[0, 1\]: give ends above 0"),
    ("rows.toml", "random.ambient.normal = [0, -1]", "sigma = -1 is negative"),
    ("rows.toml", "random.ambient.choice = []", r"choice = \[\]: give one of"),
    ("rows.toml", "grid.ambient = [1]\nrandom.ambient.choice = [1]", "ambient is given twice in"),
    ("rows.toml", "[grid]\nmesh = ['a']\n'mesh.path' = ['b']", "mesh.path is given twice in"),
    ("rows.py", "def jobs(:", "rows.py, line 1: SyntaxError"),
    ("rows.py", "x = 1\n\n1/0", "rows.py, line 3: ZeroDivisionError: division by zero"),
    ("rows.py", "import sys\nsys.exit('no')", "rows.py, line 2: SystemExit: no"),
    ("rows.py", "jobs = 3", r"rows.py has no function jobs\(\)"),
    ("rows.py", "def jobs(): return 3", "rows.py: TypeError: 'int' object is not iterable"),
    ("rows.py", "def jobs():\n  yield {}\n  raise ValueError('x\\ny')", "line 3: ValueError: x y"),
    ("rows.py", "def jobs(): yield {1: 2}", "rows.py, row 1: key 1: give text"),
    ("rows.py", "def jobs(): yield {'ambient': object()}", "ambient = <object .*: give a number"),
    ("rows.py", "def jobs():\n  a = {}\n  a['a'] = a\n  yield a", "a has tables or lists 11 deep"),
    ("rows.py", "def jobs(): yield {'ambient': 10**9999}", "ambient = a int that is too long"),
    ("rows.py", "import facerender as fr\nfr.Camera(fov=0)", "line 2: camera fov = 0 is outside"),
    ("rows.py", b"\0", "rows.py"),
]


@pytest.mark.parametrize(
    ("name", "content", "message"), BAD_FILES, ids=[f"{n}-{c[:40]!r}" for n, c, _ in BAD_FILES]
)
def test_bad_files_are_one_line(name, content, message):
    if name.endswith(".parquet"):
        require_module("pyarrow")
    with pytest.raises(InputError, match=message) as caught:
        read_jobs(write(name, content))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    assert name.split(".")[0] in str(caught.value)


def test_missing_files_are_named(tmp_path):
    for form in ("jsonl", "csv", "toml", "py", "parquet"):
        for name in (f"none.{form}", f"folder.{form}"):
            (tmp_path / f"folder.{form}").mkdir(exist_ok=True)
            with pytest.raises(InputError, match=f"{name}:? (no such|is a dir)"):
                read_jobs(tmp_path / name)


def test_parquet_without_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match=r"needs the package pyarrow; pip install 'facerender\[b"):
        read_jobs(write("rows.parquet", ""))


def test_invalid_parquet_columns_are_refused():
    pa, pq = require_module("pyarrow"), require_module("pyarrow.parquet")
    pq.write_table(pa.table([[1], [2]], names=["ambient", "ambient"]), "twice.parquet")
    with pytest.raises(InputError, match="two columns 'ambient'"):
        read_jobs("twice.parquet")
    pq.write_table(pa.table({"ambient": [b"x"]}), "bytes.parquet")
    with pytest.raises(InputError, match="bytes.parquet, row 1: ambient = b'x': give a number"):
        read_jobs("bytes.parquet")
    pq.write_table(pa.table({"ambient": pa.array([], pa.float32())}), "empty.parquet")
    with pytest.raises(InputError, match="empty.parquet has no rows"):
        read_jobs("empty.parquet")


def test_rows_have_materials_of_parts():
    scene = 'background = "none"\n[parts."M_Eye.Blend*"]\npreset = "tear"\nks = 0.5\n'
    write("scene.toml", scene)
    lines = [
        {"parts": {"M_Eye.Blend*": {"ks": 0.25}, "b": {"preset": "skin"}}},
        {"parts.b.albedo.0": 0.5, "parts.b.albedo.1": 0.25, "parts.b.albedo.2": 0},
        {},
    ]
    name = write("rows.jsonl", "\n".join(map(json.dumps, lines)))
    common = {"scene": "scene.toml", "parts": {"b": {"m": 0.2}}}
    rows = [Job.from_dict(row.tables).parts for row in JobTable(name, common)]
    eye = {"preset": "tear", "ks": 0.5}
    assert rows == [
        {"M_Eye.Blend*": {**eye, "ks": 0.25}, "b": {"m": 0.2, "preset": "skin"}},
        {"M_Eye.Blend*": eye, "b": {"m": 0.2, "albedo": (0.5, 0.25, 0)}},
        {"M_Eye.Blend*": eye, "b": {"m": 0.2}},
    ]


# --- rows ----------------------------------------------------------------------------------------

INVALID = [  # test_types.py has values of wrong types
    {"planned": {"sizes": [[1, 1]], "samples": 1, "cull_back_faces": 1}},
    {"environment": {}},
    {"material.scattering": "wax"},
    {"parts": {"a.b": {"preset": "glass"}}},
    {"parts": {"a": {"m": 0}}},
    {"parts": {"a": 1}},
    {"parts": ["a"]},
    {"parts.a.gloss": 1},
    {"parts.a.m": "x"},
    {"material.scattering": [[1, 2]]},
    {"exposure": 101},
]


@pytest.mark.parametrize("row", INVALID, ids=str)
def test_invalid_rows_are_refused(row):
    assert len(check_jobs(write("rows.jsonl", json.dumps(row))).faults) == 1


# --- documents -----------------------------------------------------------------------------------

PAGE = (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^`([a-z_]+\.\w+)`\n\n```\w+\n(.*?)^```$", PAGE, re.M | re.S))
FILES |= {
    name: (ROOT / "examples" / name).read_text(encoding="utf-8")
    for name in ("turntable.toml", "sweep.toml")
}
COUNTS = {"heads.toml": 1000, "views.jsonl": 2, "poses.csv": 2, "pairs.toml": 6, "spiral.py": 8}
COUNTS |= {"turntable.toml": 24, "sweep.toml": 300}


def test_every_file_of_the_page_has_rows():
    assert FILES.keys() == COUNTS.keys()


@pytest.mark.parametrize("name", FILES)
def test_examples_of_the_page(name):
    assert len(read_jobs(write(name, FILES[name]))) == COUNTS[name]
    assert check_jobs(name).faults == []


def test_random_values_are_the_same_in_every_release():
    sweep = {"outputs": "image,specular,normal,depth", "image.size": "320x240", "material.m": 0.2}
    lights = (
        (-54.1429113228, 32.7802616452, 2.1693731555),
        (-57.7344186782, 22.0399392771, 1.585699377),
    )
    names = ("azimuth", "elevation", "irradiance")
    expected = rows_of(
        *(
            sweep
            | {"shading.lobe": "exact", "material.f0": f0}
            | {"lights": [{"radius": 2} | dict(zip(names, light, strict=True))]}
            for light, f0 in zip(lights, (0.04, 0.028), strict=True)
        )
    )
    assert read_jobs(write("sweep.toml", FILES["sweep.toml"]))[:2] == expected


def test_the_page_names_every_key():
    for key in {*ROW_KEYS, *TABLES, *OUTPUTS}:  # docs/python.md has the fields of their tables
        assert f"`{key}`" in PAGE, key
