"""Tests the rule that factors and maps of the whole mesh apply only to skin: which parts are skin,
and that command line, scene files, jobs and Python agree."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main, parser_of
from facerender.commands.scene import job_of
from facerender.drawing.renderer import Renderer
from facerender.images.read import read_image
from facerender.loading.conventions import mark_skin
from facerender.scenes import hints
from facerender.scenes.file import scene_toml
from facerender.scenes.repair import Piece
from tests.awkward_files import gltf, join_glb, mini_head
from tests.conftest import require_module
from tests.test_parts import FACES, VERTICES, names, row, run
from tests.test_presets import KNOWN
from tests.verification.cache import wait_for_cache

pytestmark = pytest.mark.filterwarnings("ignore:.*presets by name")

SKIN = "head Face M_Head body.001 eyelid EyeLid_L Eye_Socket skin_eyes part3 shirt Iris_Murdoch"
OTHERS = (
    "eyeballs lash-strands tear-line cornea Eye_L eyes M_Eye.002 Head.Eyes hair Hair_Long FaceHair "
    "Eyelashes_Curler brows beard Upper_Teeth"
)


@pytest.fixture(scope="module")
def whole():
    """The built-in head with its eyes."""
    return fr.load_mesh()


def skin_of(*pairs):
    """Return whether pieces are skin, given the names of each piece and its material."""
    pieces = [
        Piece(np.zeros((3, 3)), np.array([[0, 1, 2]]), None, None, None, fr.Material(), name=name)
        for name, _ in pairs
    ]
    for piece, (_, material) in zip(pieces, pairs, strict=True):
        piece.material_name = material
    mark_skin(pieces)
    return [piece.skin for piece in pieces]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *((name, True) for name in [*SKIN.split(), ""]),
        *((name, False) for name in OTHERS.split()),
        *(
            (name, preset in ("skin", "lips"))
            for preset, text in KNOWN.items()
            for name in text.split()
        ),
    ],
)
def test_names_define_the_skin(name, expected):
    assert skin_of((name, "")) == [expected]
    assert skin_of(("part1", name)) == [expected]
    assert skin_of((name, "Material.001")) == [expected]


def test_high_poly_is_an_eye_beside_teeth():
    assert skin_of(("high-poly", ""), ("body", "")) == [True, True]
    assert skin_of(("high-poly", ""), ("body", ""), ("teeth_base", "")) == [False, True, False]


def test_clear_parts_are_not_skin_and_a_mesh_has_some_skin():
    mesh = row("a", "b")
    clear = mesh.with_material("b", transmission=0.5)
    assert (mesh.skin, clear.skin) == ((0, 1), (0,))
    assert clear.select("b").skin == (0,)
    eyes = replace(mesh, parts=tuple(replace(each, skin=False) for each in mesh.parts))
    assert eyes.skin == (0, 1)
    assert [each.m for each in clear.with_skin(m=0.5).materials] == [0.5, 0.3]
    assert [each.m for each in clear.with_material(m=0.5).materials] == [0.5, 0.5]


def test_skin_of_the_built_in_head(whole):
    assert [whole.parts[i].name for i in whole.skin] == ["head"]
    assert fr.load_mesh(as_is=True).skin == whole.skin
    require_module("meshoptimizer")
    assert fr.simplified(whole, 20_000).skin == whole.skin


# --- factors --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_interface_changes_the_skin_only(whole, tmp_path, capsys):
    """The command line, a scene file, a job, a batch and Python draw the same image."""
    expected = fr.Scene(whole.with_skin(m=0.15), fr.Camera(frame="face"))
    changed = zip(expected.mesh.materials, whole.materials, strict=True)
    assert [each != own for each, own in changed] == [True, False, False, False, False]
    size = ("--size", "64", "--samples", "1", "--frame", "face")
    with Renderer((64, 64), samples=1) as renderer:
        image = renderer.render(expected).linear
        job = fr.Job(material={"m": 0.15}, camera=fr.Camera(frame="face"))
        np.testing.assert_array_equal(renderer.render(job.scene()).linear, image)
    python = fr.render(m=0.15, camera=fr.Camera(frame="face"), size=(64, 64), samples=1)
    np.testing.assert_array_equal(python.linear, image)
    (tmp_path / "a.toml").write_text("[material]\nm = 0.15\n")
    for words in (("--m", 0.15), ("--scene", tmp_path / "a.toml")):
        out = tmp_path / "a.exr"
        assert run(capsys, "render", *size, *words, "--no-cache", "-o", out) == (0, f"{out}\n", "")
        np.testing.assert_array_equal(read_image(out).pixels, image)
    jobs = tmp_path / "jobs.jsonl"
    jobs.write_text(json.dumps({"id": "a", "material.m": 0.15, "camera.frame": "face"}))
    words = ("batch", jobs, "-o", tmp_path / "out", "--size", "64", "--samples", "1")
    assert main([*map(str, words)]) == 0
    (png,) = (tmp_path / "out").rglob("*.png")
    np.testing.assert_array_equal(read_image(png).pixels, read_image_of(python, tmp_path))


def read_image_of(frame, folder):
    frame.save(folder / "b.png")
    return read_image(folder / "b.png").pixels


@pytest.mark.slow
def test_the_catchlight_stays(whole):
    """Of the specular term, the eyes keep every pixel, and the skin changes."""
    camera = fr.Camera(frame="face", zoom=2.0)
    with Renderer((192, 192), samples=1) as renderer:
        own, rough = (
            renderer.render(fr.Scene(mesh, camera), only="specular").linear
            for mesh in (whole, fr.Job(material={"m": 0.3, "ks": 0.5}).scene(whole).mesh)
        )
        part = renderer.gbuffer(fr.Scene(whole, camera), blended=False).part
    cornea, skin = (part == names(whole).index(name) for name in ("cornea", "head"))
    assert own[cornea][:, :3].max() > 0.3
    assert np.abs(own - rough)[cornea].max() == 0.0
    assert np.abs(own - rough)[skin].max() > 0.05


def test_a_named_part_takes_factors():
    words = ["render", "--m", "0.25", "--scattering", "skin", "--part", "cornea,m=0.1", "-o", "x"]
    scene = job_of(parser_of(words).parse_args(words), None)[0].scene()
    found = dict(zip(names(scene.mesh), scene.mesh.materials, strict=True))
    assert (found["head"].m, found["cornea"].m) == (0.25, 0.1)
    assert [name for name, each in found.items() if each.scattering] == ["head"]
    assert found["eyeballs"].roughness_map is not None
    assert found["head"].roughness_map is None


def test_a_scene_file_restores_every_part(whole, tmp_path):
    mesh = whole.with_skin(m=0.2, ks=0.7).with_material("eyeballs", ks=0.5)
    text = scene_toml(fr.Scene(mesh), fr.Shading())
    (tmp_path / "a.toml").write_text(text)
    found = fr.load_scene(tmp_path / "a.toml")
    assert (found["material"]["m"], found["material"]["ks"]) == (0.2, 0.7)
    assert "head" not in found["parts"]
    job = fr.Job(material=found["material"], parts=found["parts"])
    assert job.scene(whole).mesh.materials == mesh.materials


# --- maps -----------------------------------------------------------------------------------------


def image(path, color=(200, 150, 130)):
    Image.new("RGB", (4, 4), color).save(path)
    return path


def test_maps_replace_the_maps_of_the_skin(tmp_path, recwarn):
    path = image(tmp_path / "skin.png")
    plain, mesh = fr.load_mesh(), fr.load_mesh(albedo=path, roughness_map=path, normal_map=path)
    assert len(recwarn) == 0, [str(each.message) for each in recwarn]
    assert {each.name for each in (mesh.materials[0].albedo_map, mesh.materials[0].normal_map)} == {
        "skin.png"
    }
    for name in ("albedo_map", "roughness_map", "normal_map"):
        own, given = (getattr(each.materials[1], name) for each in (plain, mesh))
        assert (own and own.size, own and own.name) == (given and given.size, given and given.name)
    assert mesh.materials[2:] == plain.materials[2:]


def eyes_and_face(folder, kind):
    """Write a file with a face and eyes that have albedo maps; the map of the face is missing."""
    image(folder / "eye.png", (10, 20, 30))
    path = folder / f"a.{kind}"
    if kind == "obj":
        uv = "vt 0 0\nvt 1 0\nvt 0 1\n"
        faces = "f 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
        groups = "".join(f"usemtl {each}\n{faces}" for each in ("Face", "Eye_L"))
        path.write_text(f"mtllib a.mtl\n{VERTICES}{uv}{groups}")
        (folder / "a.mtl").write_text(
            "newmtl Face\nmap_Kd gone.png\nnewmtl Eye_L\nmap_Kd eye.png\n"
        )
        return path
    document, binary = gltf(mini_head(), [{"name": "Face"}, {"name": "Eye_L"}])
    mesh = document["meshes"][0]
    document["meshes"] = [
        {"primitives": [{**mesh["primitives"][0], "material": i}]} for i in range(2)
    ]
    for i, node in enumerate(document["nodes"][-2:]):
        node["mesh"] = i
    document["images"] = [{"uri": "gone.png"}, {"uri": "eye.png"}]
    document["textures"] = [{"source": 0}, {"source": 1}]
    document["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": i}}} for i in range(2)
    ]
    path.write_bytes(join_glb(document, binary))
    return path


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_eyes_keep_their_map_and_a_replaced_map_may_be_missing(kind, tmp_path, recwarn):
    path = eyes_and_face(tmp_path, kind)
    mesh = fr.load_mesh(path, albedo=image(tmp_path / "skin.png"))
    assert len(recwarn) == 0, [str(each.message) for each in recwarn]
    assert names(mesh) == ["Face", "Eye_L"]
    texels = [tuple(each.albedo_map.rgb().getpixel((0, 0))) for each in mesh.materials]
    assert texels == [(200, 150, 130), (10, 20, 30)]


def test_maps_of_selected_eyes(tmp_path):
    path, eyes = image(tmp_path / "eye.png"), {"parts": "eyeballs"}
    for mesh in (fr.load_mesh(albedo=path, **eyes), fr.MeshFile(albedo=str(path), **eyes).load()):
        assert names(mesh) == ["eyeballs"]
        assert mesh.materials[0].albedo_map.name == "eye.png"
    with pytest.raises(fr.InputError, match=r"no part of head.glb is called 'eye': its parts are"):
        fr.load_mesh(parts="eye")
    with pytest.raises(fr.InputError, match=r"head.glb has no texture coordinates, which eye.png"):
        fr.load_mesh(albedo=path, parts="tear-line,lash*")


@pytest.mark.parametrize("chosen", [{}, {"parts": ("Std_Eyelash",)}, {"hide": ("shirt",)}])
def test_the_cache_keeps_the_skin(chosen, tmp_path, cache_folder):
    faces = "".join(f"usemtl {each}\n{FACES}" for each in ("shirt", "Std_Eyelash", "M_Eye"))
    (tmp_path / "a.obj").write_text(VERTICES + faces)
    file = fr.MeshFile(str(tmp_path / "a.obj"), **chosen)
    plain, stored = file.load(), file.load(cache=True)
    wait_for_cache()
    cached = file.cached()
    assert cached is not None
    for mesh in (stored, cached):
        assert names(mesh) == names(plain)
        assert mesh.skin == plain.skin
        assert [part.skin for part in mesh.parts] == [part.skin for part in plain.parts]
        assert mesh.materials == plain.materials


# --- info, hints ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_info_lists_the_skin(capsys):
    lines = run(capsys, "info")[1].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("part  "))
    rows = [line.split()[:3:2] for line in lines[start : start + 6]]
    assert rows[:3] == [["part", "skin"], ["head", "yes"], ["eyeballs", "-"]]
    parts = json.loads(run(capsys, "info", "--json")[1])["parts"]
    assert [each["skin"] for each in parts] == [True, False, False, False, False]


def test_dull_hair_gives_no_hint_on_the_skin():
    mesh = row("head", "hair", "hair.2").with_material("hair*", ks=0.03)
    hair = tuple(replace(part, skin=part.name == "head") for part in mesh.parts)
    assert hints.faint(mesh) is not None
    assert hints.faint(replace(mesh, parts=hair)) is None
