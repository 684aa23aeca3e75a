"""Tests parts of meshes: their names in each file format, selecting and hiding them, and
``facerender info``."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

import facerender as fr
from facerender.commands import main
from facerender.images.files import read_image
from facerender.material import Material
from facerender.mesh.part import Part
from tests.awkward_files import (
    gltf,
    join_glb,
    mini_head,
    write_glb,
    write_obj,
    write_ply,
    write_stl,
)
from tests.conftest import require_module
from tests.verification.cache import wait_for_cache

VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def names(mesh):
    return [part.name for part in mesh.parts]


def obj(path, *heads):
    """Load an OBJ file with a tetrahedron after each of the given lines."""
    path.write_text(VERTICES + "".join(f"{head}\n{FACES}" for head in heads))
    return fr.load_mesh(path)


def row(*parts):
    """Return squares in a row with different colours; they are 1 wide and start 2 apart."""
    places = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)
    up, faces = np.tile((0.0, 0.0, 1.0), (4, 1)), np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    made = [
        Part(places + (2.0 * i, 0.0, 0.0), up, faces, name=name) for i, name in enumerate(parts)
    ]
    materials = [Material(albedo=(1.0, i / len(parts), 0.0)) for i in range(len(parts))]
    return fr.Mesh.of("row", made, materials, 10.0)


@pytest.mark.parametrize(
    ("heads", "expected"),
    [
        (("",), [""]),
        (("g skin",), ["skin"]),
        (("o Head", "o Hair"), ["Head", "Hair"]),
        (("o Head\ng face", "g fringe", "o Eye\ng eye"), ["face", "fringe", "eye"]),
        (("usemtl a", "usemtl b", "usemtl a"), ["a", "b"]),
        (("", "g hair"), ["part1", "hair"]),
        (("g body\nusemtl a", "usemtl b", "g hair"), ["body.a", "body.b", "hair"]),
        (("o l\ng eye", "o r"), ["l.eye", "r.eye"]),
        (("o A\ng x y  ", "\to\tB", "  g z"), ["A.x y", "B.x y", "z"]),
    ],
)
def test_names_of_parts_in_obj(heads, expected, tmp_path):
    mesh = obj(tmp_path / "a.obj", *heads)
    assert names(mesh) == expected
    assert sum(len(part.faces) for part in mesh.parts) == 4 * len(heads)


def test_too_many_groups_are_joined_by_their_materials(tmp_path):
    heads = [f"g n{i}\nusemtl {'ab'[i % 2]}" for i in range(257)]
    with pytest.warns(fr.FacerenderWarning, match="257 groups .* limit is 256 .*joined"):
        assert names(obj(tmp_path / "a.obj", *heads)) == ["a", "b"]
    assert len(obj(tmp_path / "b.obj", *heads[:-1]).parts) == 256
    materials = [f"usemtl m{i}" for i in range(257)]
    assert len(obj(tmp_path / "c.obj", *materials).parts) == 257


@pytest.mark.parametrize("write", [write_ply, write_stl])
def test_ply_and_stl_have_no_names(write, tmp_path):
    path = tmp_path / f"a.{write.__name__[-3:]}"
    assert names(fr.load_mesh(write(path, mini_head()))) == [""]


def test_solids_of_stl_are_numbered(tmp_path):
    facet = "facet normal 0 0 1\nouter loop\n{}endloop\nendfacet\n"
    corners = "vertex 0 0 0\nvertex 1 0 {0}\nvertex 0 1 {0}\n"
    solids = [f"solid s{i}\n{facet.format(corners.format(i))}endsolid s{i}\n" for i in range(3)]
    path = tmp_path / "a.stl"
    path.write_text("".join(solids))
    assert names(fr.load_mesh(path)) == ["part1", "part2", "part3"]


@pytest.mark.parametrize(
    ("nodes", "mesh", "materials", "expected"),
    [
        ([{}], {}, [None], [""]),
        ([{"name": "Head"}], {"name": "mesh"}, ["skin"], ["Head"]),
        ([{}], {"name": "mesh"}, ["skin"], ["mesh"]),
        ([{"name": "Head"}], {}, ["skin", "eye"], ["Head.skin", "Head.eye"]),
        ([{"name": "Head"}], {}, ["skin", "skin", None], ["Head.skin", "Head.skin.2", "Head"]),
        ([{"name": "eye"}, {"name": "eye"}, {}], {}, [None], ["eye", "eye.2", "part3"]),
        ([{"name": " a\nb\t\x07"}], {}, [None], ["a b ?"]),
        ([{"name": "x" * 500}], {}, [None], ["x" * 40 + " ... " + "x" * 40]),
    ],
)
def test_names_of_parts_in_gltf(nodes, mesh, materials, expected, tmp_path):
    document, binary = gltf(mini_head(), nodes)
    primitive = document["meshes"][0]["primitives"][0]
    document["materials"] = [{} if each is None else {"name": each} for each in materials]
    document["meshes"][0] |= {
        "primitives": [{**primitive, "material": i} for i in range(len(materials))],
        **mesh,
    }
    path = tmp_path / "a.glb"
    path.write_bytes(join_glb(document, binary))
    assert names(fr.load_mesh(path)) == expected


@pytest.mark.parametrize("place", ["nodes", "meshes", "materials"])
def test_names_that_are_not_text_are_ignored(place):
    document, binary = gltf(mini_head())
    document[place][0]["name"] = 5
    assert names(fr.load_mesh(join_glb(document, binary))) == [""]


@pytest.mark.parametrize(
    ("chosen", "left"),
    [
        ({}, ["eye.l", "eye.r", "hair", "[x]"]),
        ({"parts": "hair"}, ["hair"]),
        ({"parts": "hair, eye.*"}, ["eye.l", "eye.r", "hair"]),
        ({"parts": ["hair", "eye.?"], "hide": "*.r"}, ["eye.l", "hair"]),
        ({"hide": "[hx]*,[[]x]"}, ["eye.l", "eye.r"]),
        ({"hide": "[x]"}, ["eye.l", "eye.r", "hair"]),
        ({"parts": np.array(["hair"])}, ["hair"]),
        ({"hide": ()}, ["eye.l", "eye.r", "hair", "[x]"]),
    ],
)
def test_parts_are_chosen_by_names_and_wildcards(chosen, left):
    mesh = row("eye.l", "eye.r", "hair", "[x]")
    got = mesh.select(**chosen)
    assert names(got) == left
    own = [i for i, part in enumerate(mesh.parts) if part.name in left]
    assert got.materials == tuple(mesh.materials[i] for i in own)
    low, high = 2.0 * min(own), 2.0 * max(own) + 1.0
    np.testing.assert_array_equal(got.bounds, [(low, 0.0, 0.0), (high, 1.0, 0.0)])
    assert got.millimetres == 10.0
    assert got is mesh or len(left) < 4


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"parts": "Hair"}, "no part of row is called 'Hair': its parts are eye, hair"),
        ({"hide": "*lash*"}, "no part of row is called '*lash*': its parts are eye, hair"),
        ({"hide": "*"}, "every part of row is hidden: its parts are eye, hair; hide fewer"),
        ({"parts": "eye", "hide": "eye"}, "every part of row is hidden"),
        ({"parts": 5}, "parts = 5: give names of parts"),
        ({"hide": ["eye", None]}, "hide = ['eye', None]: give names of parts"),
    ],
)
def test_unknown_names_are_refused(chosen, message):
    with pytest.raises(fr.InputError, match=re.escape(message)):
        row("eye", "hair").select(**chosen)
    with pytest.raises(fr.InputError, match="its 1 parts have no names"):
        row("").select("x")


def test_names_survive_simplification_occlusion_and_the_cache(tmp_path, cache_folder):
    path = write_glb(tmp_path / "a.glb", mini_head(), [{"name": "Head"}])
    assert names(fr.load_mesh(path, cache=True)) == ["Head"]
    wait_for_cache()
    found = fr.MeshFile(str(path)).load(cache=True)
    assert names(found) == ["Head"]
    require_module("meshoptimizer")
    assert names(fr.simplified(found, 300)) == ["Head"]
    require_module("embreex")
    assert names(fr.with_occlusion(found)) == ["Head"]


def test_mesh_file_selects_and_hides_parts(tmp_path):
    obj(tmp_path / "a.obj", "g eye", "g hair", "g cap")
    path = str(tmp_path / "a.obj")
    file = fr.MeshFile(path, parts="eye, hair", hide=["hair"])
    assert (file.parts, file.hide) == (("eye", "hair"), ("hair",))
    assert names(file.load()) == ["eye"]
    job = fr.Job(file)
    assert fr.Job.from_dict(job.as_dict()).mesh == file
    assert 'parts = ["eye", "hair"]' in job.toml()
    assert "parts" not in fr.Job(fr.MeshFile(path)).as_dict()["mesh"]
    with pytest.raises(fr.InputError, match="mesh hide = 5"):
        fr.MeshFile(path, hide=5)  # type: ignore[arg-type]


@pytest.mark.parametrize("samples", [1, 4])
def test_masks_and_part_numbers(samples):
    mesh = row("a", "b", "c")
    with fr.Renderer((120, 40), samples=samples) as renderer:
        scene = fr.Scene(mesh)
        mask, parts = renderer.render(scene, only="mask"), renderer.render(scene, only="parts")
        gbuffer = renderer.gbuffer(scene)
        alone = renderer.render(fr.Scene(mesh.select("b")), only="mask")
    np.testing.assert_array_equal(parts.linear[..., 0], gbuffer.part + 1)
    np.testing.assert_array_equal(mask.linear[..., 0], gbuffer.part >= 0)
    assert set(np.unique(parts.linear[..., 2])) == {0.0, 1.0, 2.0, 3.0}
    assert parts.metadata["parts"] == "a, b, c"
    assert set(np.unique(mask.srgb8())) == {0, 255}
    colors = {tuple(each) for each in parts.srgb8().reshape(-1, 3)}
    assert len(colors) == 4
    assert (0, 0, 0) in colors
    # The part is framed on its own, although the renderer drew it with others before.
    assert alone.linear[..., 0].sum() > 2.0 * (gbuffer.part == 1).sum()


def test_colours_of_parts_differ():
    numbers = np.repeat(np.arange(1, 65, dtype=np.float32)[:, None, None], 4, axis=2)
    frame = fr.Frame(numbers, "parts", False, {})
    steps = frame.srgb8().reshape(-1, 3).astype(int)
    apart = np.abs(steps[:, None] - steps[None]).max(axis=2) + 255 * np.eye(64, dtype=int)
    assert apart.min() > 4
    assert np.abs(np.diff(steps, axis=0)).max(axis=1).min() > 60  # consecutive parts
    assert steps.max(axis=1).min() > 80  # no colour is nearly black


def run(capsys, *words):
    status = main([*map(str, words)])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def test_render_selects_parts(tmp_path, capsys):
    obj(tmp_path / "a.obj", "g eye", "g hair")
    path, out = tmp_path / "a.obj", tmp_path / "o.png"
    small = ("--size", 32, "-o", out)
    assert run(capsys, "render", path, "--only", "parts", *small)[0] == 0
    before = read_image(out).pixels.copy()
    assert run(capsys, "render", path, "--hide", "ha*", "--only", "parts", *small)[0] == 0
    assert not np.array_equal(before, read_image(out).pixels) or len(np.unique(before)) > 1
    out.unlink()
    status, _, err = run(capsys, "render", path, "--parts", "lashes", *small)
    assert status == 2
    assert err == (
        "facerender: error: no part of a.obj is called 'lashes': its parts are eye, hair\n"
    )
    assert not out.exists()


def test_info_prints_the_content_of_a_file(tmp_path, capsys):
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.25, 1, 1]}
    path = write_glb(
        tmp_path / "a.glb",
        mini_head(),
        [{"name": "Head"}],
        material={"name": "skin", "alphaMode": "MASK", "pbrMetallicRoughness": base},
    )
    status, out, err = run(capsys, "info", path, "--json")
    facts: dict[str, Any] = json.loads(out)
    mesh = fr.load_mesh(path)
    assert (status, err) == (0, "")
    assert (facts["format"], facts["bytes"]) == ("glb", path.stat().st_size)
    assert facts["triangles"] == len(mesh.parts[0].faces)
    assert facts["millimetres"] == 1000.0
    np.testing.assert_allclose(facts["size_mm"], np.ptp(mesh.bounds, axis=0) * 1000.0)
    (part,) = facts["parts"]
    assert (part["number"], part["name"], part["has"]) == (1, "Head", ["uv"])
    assert part["material"]["albedo"] == [0.5, 0.25, 1.0]
    size = part["maps"]["albedo_map"]["size"]
    assert tuple(size) == mesh.materials[0].albedo_map.size  # type: ignore[union-attr]
    assert part["maps"]["albedo_map"]["encoding"] == "srgb"
    header, line = run(capsys, "info", path)[1].splitlines()[5:7]
    assert re.split("  +", header) == ["part", "triangles", "skin", "preset", "maps", "material"]
    assert re.split("  +", line) == [
        *("Head", str(facts["triangles"]), "yes", "-", f"albedo {size[0]}"),
        "albedo 0.5 0.25 1, m 0.3, f0 0.028, ks 1, alpha mask",
    ]


def test_info_prints_repairs_and_a_size_for_heads(tmp_path, capsys):
    head = mini_head()
    faces = np.concatenate([head.faces, head.faces[:3, [0, 0, 1]]])
    path = write_obj(tmp_path / "a.obj", head.with_faces(faces))
    status, out, err = run(capsys, "info", path)
    assert (status, err) == (0, "")
    assert "warning: a.obj has 3 degenerate faces: dropped\n" in out
    assert ": give --millimetres 1000 (m) for an eye distance of about 63 mm\n" in out
    assert json.loads(run(capsys, "info", path, "--json")[1])["millimetres"] is None
    status, out, err = run(capsys, "info", tmp_path / "b.obj")
    assert (status, out) == (2, "")
    assert err.startswith("facerender: error: cannot read")
