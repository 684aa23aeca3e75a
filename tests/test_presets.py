"""Tests presets, the materials of parts, and which parts are skin, to which factors and maps of the
whole mesh apply. Command line, scene files, jobs and Python agree."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.commands.scene import part_materials
from facerender.drawing.renderer import Renderer
from facerender.images.files import read_image
from facerender.loading.conventions import _eye_map, _lash_map, apply_names, preset_for
from facerender.material import PRESETS, SKIN_ALBEDO, Material, changed, parse_part, part_text
from facerender.mesh import hints
from facerender.mesh.repair import Piece
from facerender.scene.job import scene_toml
from tests.awkward_files import gltf, join_glb, mini_head, write_glb
from tests.conftest import require_module
from tests.meshes import with_geometry
from tests.test_parts import FACES, VERTICES, names, row, run
from tests.verification.cache import wait_for_cache

KNOWN = {
    "skin": "M_Face M_BackHead Wolf3D_Head Wolf3D_Skin Std_Skin_Head Std_Skin_Leg head_lod0_mesh",
    "cornea": "cornea Cornea_L Std_Cornea_R CC_Base_Cornea eye-cornea.001 Eyes.Cornea.Right",
    "sclera": "M_ScleraLeft EyeLeft eyeRight_lod0_mesh Std_Eye_L CC_Base_Eye Wolf3D_Eye l_eyeball",
    "iris": "M_IrisLeft Iris.R IRIS",
    "tear": "M_LacrimalFluid M_EyeBlend Std_Tearline_L CC_Base_TearLine eyeEdge_lod0_mesh saliva",
    "eye-occlusion": "M_EyeOcclusion Std_Eye_Occlusion_R CC_Base_EyeOcclusion EyeAO eyeshell_lod0",
    "lashes": "M_EyeLashes Std_Eyelash eyelashes01 Eyelashes.002 lashes_upper_L lash",
    "teeth": "M_Teeth Std_Upper_Teeth Wolf3D_Teeth teeth_base TEETH_MESH teeth_lod0_mesh",
    "lips": "M_GumsTongue tongue01 Std_Tongue Lips",
    "hair-card": "eyebrow001 Eyebrows Wolf3D_Hair hair_cards",
}
UNKNOWN = (
    "head face skin eye eyes body hair Headscarf M_Headscarf Eyebrowser eyelid Eyelashes_Curler "
    "toothbrush Irish corneal scleroderma teardrop lipstick slash Splash tearoff Eyeglasses part3 "
    "M_Eye Std_Nails Std_Eyewear Wolf3D_Headwear Wolf3D_Glasses default Material.001 high-poly"
)


def preset_of(material: fr.Material) -> str | None:
    """Return the name of the preset whose fields a material has."""
    names = (name for name in PRESETS if changed(material, {"preset": name}) == material)
    return next(names, None)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *((name, preset) for preset, known in KNOWN.items() for name in known.split()),
        *((name, None) for name in [*UNKNOWN.split(), "", "123", "Haut"]),
    ],
)
def test_known_names(name, expected):
    assert preset_for(name) == expected


def test_presets_are_valid_and_told_apart():
    for name in PRESETS:
        material = row("a").with_material(preset=name).materials[0]
        assert preset_of(material) == name
        assert preset_of(replace(material, m=0.77)) is None
    assert preset_of(Material()) is None
    skin = Material(**PRESETS["skin"])
    broad = np.sqrt(skin.m) / 1.3 * 0.75  # perceptual roughness of Unreal's narrow lobe
    assert skin.second_slope == pytest.approx(broad**2 / skin.m, abs=1e-3)
    for name, index in (("cornea", 1.336), ("tear", 1.337)):
        assert PRESETS[name]["f0"] == pytest.approx(((index - 1.0) / (index + 1.0)) ** 2)
    one = {each for each, own in PRESETS.items() if own["transmission"] == 1.0}
    assert one == {"cornea", "tear"}


def test_every_preset_replaces_the_fields_of_every_other():
    for first in PRESETS:
        for second in PRESETS:
            mesh = row("a").with_material(preset=first).with_material(preset=second)
            own = row("a").with_material(preset=second).materials[0]
            albedo = {} if "albedo" in PRESETS[second] else {"albedo": own.albedo}
            cutoff = {"alpha_cutoff": own.alpha_cutoff}
            assert replace(mesh.materials[0], **albedo, **cutoff) == replace(own, **cutoff)


def test_a_preset_keeps_maps_except_the_roughness_map():
    texture = fr.Texture.from_array(np.full((2, 2), 0.5))
    maps = dict.fromkeys(("albedo_map", "opacity_map", "roughness_map"), texture)
    white = row("a").with_material(**maps, albedo=(1.0, 1.0, 1.0), alpha="mask", opacity=0.9)
    for name in ("lashes", "sclera"):
        found = white.with_material(preset=name).materials[0]
        maps = {each: getattr(found, each) for each in maps}
        assert maps == {"albedo_map": texture, "opacity_map": texture, "roughness_map": None}
        assert (found.albedo, found.alpha, found.opacity) == ((1.0, 1.0, 1.0), "mask", 0.9)
        assert preset_of(found) == name


def test_with_material_changes_the_named_parts():
    mesh = row("eye", "hair", "eye.2")
    changed = mesh.with_material("eye*", preset="cornea", m=0.05)
    assert [each.transmission for each in changed.materials] == [1.0, 0.0, 1.0]
    assert [each.m for each in changed.materials] == [0.05, 0.3, 0.05]
    assert changed.parts == mesh.parts
    assert changed.with_material(["hair", "eye"], ks=0.5).materials[2].ks == 1.0
    with pytest.raises(fr.InputError, match=r"no part of row is called 'lash\*': its parts are"):
        mesh.with_material("lash*", m=0.3)
    with pytest.raises(fr.InputError, match=r"unknown preset 'glass'; known: skin, lips, cornea"):
        mesh.with_material(preset="glass")


PARTS = [
    ("eye*=cornea", ("eye*", {"preset": "cornea"})),
    ("a,m=0.2", ("a", {"m": 0.2})),
    (
        "a b.2=skin,albedo=0.5,0.25,0.125",
        ("a b.2", {"preset": "skin", "albedo": (0.5, 0.25, 0.125)}),
    ),
    ("[ab]?,alpha=blend,opacity=0.8", ("[ab]?", {"alpha": "blend", "opacity": 0.8})),
]


@pytest.mark.parametrize(("text", "expected"), PARTS)
def test_part_options_are_parsed_and_written(text, expected):
    assert parse_part(text) == expected
    assert part_text(*expected) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("eye", "give NAME=PRESET or NAME,FIELD=VALUE"),
        ("eye,0.5", "give NAME=PRESET or NAME,FIELD=VALUE"),
        ("=skin", "give NAME=PRESET or NAME,FIELD=VALUE"),
        ("eye=glass", "unknown preset 'glass'"),
        ("eye,m=3", r"m = 3.0 is outside \[0.0001, 2\]"),
        ("eye,m=soft", r"m = 'soft' is not a number: give a number in \[0.0001, 2\]"),
        ("eye,gloss=1", "unknown key 'gloss' in --part.eye"),
        ("eye,albedo_map=a.png", "unknown key 'albedo_map'"),
    ],
)
def test_bad_part_options_are_refused(text, message):
    with pytest.raises(fr.InputError, match=message):
        parse_part(text)


def test_jobs_carry_the_materials_of_parts():
    tables = {"eye*": {"preset": "cornea"}, "*": {"m": 0.2, "albedo": [0.5, 0.4, 0.3]}}
    job = fr.Job(parts=tables)
    again = fr.Job.from_dict(json.loads(json.dumps(job.as_dict())))
    assert again == job
    assert '"eye*" = { preset = "cornea" }' in job.toml()
    assert "parts" not in fr.Job().as_dict()
    scene = job.scene(row("eye", "hair"))
    assert [each.m for each in scene.mesh.materials] == [0.2, 0.2]
    assert scene.mesh.materials[0].refraction == PRESETS["cornea"]["refraction"]
    for bad, message in (
        ({"eye": {"preset": 3}}, "unknown preset 3"),
        ({"eye": 3}, r"parts.eye = 3: give a table"),
        ({" ": {}}, "parts has the key ' '"),
        ({"eye": {"m": 9.0}}, "m = 9.0 is outside"),
        ([], "parts = \\[\\]: give a table of parts"),
    ):
        with pytest.raises(fr.InputError, match=message):
            fr.Job.from_dict({"parts": bad})


def test_a_scene_file_stores_the_factors_that_differ(tmp_path):
    scene = fr.Scene(row("eye", "hair [a]").with_material("eye", preset="cornea"))
    text = scene_toml(scene, fr.Shading())
    (tmp_path / "a.toml").write_text(text)
    found = fr.load_scene(tmp_path / "a.toml")
    bare = row("eye", "hair [a]").with_material(m=0.9)
    job = fr.Job(material=found["material"], parts=found["parts"])
    assert job.scene(bare).mesh.materials == scene.mesh.materials
    alone = fr.Scene(row("eye"))
    assert "[parts]" not in scene_toml(alone, fr.Shading())


def obj(path, *materials):
    """Write an OBJ file with a tetrahedron for each material; no MTL file."""
    faces = "".join(f"usemtl {each}\n{FACES}" for each in materials)
    path.write_text(VERTICES + faces)
    return path


def test_a_bare_part_with_a_known_name_gets_a_preset(tmp_path):
    path = obj(tmp_path / "a.obj", "Std_Skin_Head", "Std_Cornea_L", "Std_Cornea_R", "shirt")
    expected = (
        "a.obj: presets by name: skin for Std_Skin_Head; cornea for Std_Cornea_L, Std_Cornea_R; "
        "--as-is keeps the file's own"
    )
    with pytest.warns(fr.FacerenderWarning) as caught:
        mesh = fr.load_mesh(path)
    assert [str(each.message) for each in caught] == [expected]
    assert [*map(preset_of, mesh.materials)] == ["skin", "cornea", "cornea", None]
    plain = fr.load_mesh(path, as_is=True)
    assert [*map(preset_of, plain.materials)] == [None] * 4
    assert fr.MeshFile(str(path), as_is=True).load().materials == plain.materials


@pytest.mark.parametrize("made", ["map", "blend", "colours", "transmission"])
def test_a_better_material_of_the_file_stays(made, tmp_path):
    head = mini_head()
    metallic = {"baseColorFactor": [0.5, 0.5, 0.5, 0.5]}
    own = {
        "map": {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        "blend": {"pbrMetallicRoughness": metallic, "alphaMode": "BLEND"},
        "colours": {},
        "transmission": {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.5}}},
    }[made]
    if made == "colours":
        mesh = _vertex_colours(tmp_path)
    else:
        path = write_glb(
            tmp_path / "a.glb", head, [{"name": "x"}], material={"name": "Std_Eyelash", **own}
        )
        mesh = fr.load_mesh(path)
    assert preset_of(mesh.materials[0]) is None


def _vertex_colours(folder):
    lines = VERTICES.replace("\n", " 0.5 0.5 0.5\n")
    (folder / "a.obj").write_text(f"{lines}usemtl Std_Eyelash\n{FACES}")
    return fr.load_mesh(folder / "a.obj")


def test_the_name_of_the_material_counts(tmp_path):
    head = mini_head()
    material = {"name": "Std_Eyelash"}
    path = write_glb(tmp_path / "a.glb", head, [{"name": "Mesh12"}], material=material)
    with pytest.warns(fr.FacerenderWarning, match="lashes for Mesh12"):
        mesh = fr.load_mesh(path)
    assert preset_of(mesh.materials[0]) == "lashes"


def test_the_cache_repeats_presets_and_their_warning(tmp_path, cache_folder):
    path = obj(tmp_path / "a.obj", "shirt", "Std_Eyelash")
    for as_is, expected in ((False, "lashes"), (True, None), (False, "lashes")):
        file = fr.MeshFile(str(path), as_is=as_is)
        for _ in range(2):
            if expected:
                with pytest.warns(fr.FacerenderWarning, match="lashes for Std_Eyelash"):
                    mesh = file.load(cache=True)
            else:
                mesh = file.load(cache=True)
            wait_for_cache()
            assert preset_of(mesh.materials[1]) == expected


def test_factors_of_the_caller_win(tmp_path):
    path = obj(tmp_path / "a.obj", "Std_Skin_Head", "Std_Eyelash")
    with pytest.warns(fr.FacerenderWarning, match="presets by name"):
        scene = fr.Job(fr.MeshFile(str(path)), {"ks": 0.25}, parts={"*lash": {"m": 0.4}}).scene()
    assert [each.ks for each in scene.mesh.materials] == [0.25, PRESETS["lashes"]["ks"]]
    assert [each.m for each in scene.mesh.materials] == [0.3, 0.4]


def test_a_grey_face_gets_the_albedo_of_skin(tmp_path):
    path = obj(tmp_path / "a.obj", "M_Face", "M_BackHead")
    path.write_text("mtllib a.mtl\n" + path.read_text())
    (tmp_path / "a.mtl").write_text("newmtl M_Face\nKd 0.6 0.6 0.6\nnewmtl M_BackHead\nKd 1 0 0\n")
    with pytest.warns(fr.FacerenderWarning, match="skin for M_Face, M_BackHead"):
        mesh = fr.load_mesh(path)
    assert [each.albedo for each in mesh.materials] == [SKIN_ALBEDO, (1.0, 0.0, 0.0)]


@pytest.mark.parametrize(
    ("name", "alpha"), [("eyelashes01", "blend"), ("eyebrow001", "blend"), ("short01", "mask")]
)
def test_lashes_and_eyebrows_of_obj_files_are_blended(name, alpha, tmp_path):
    Image.new("L", (4, 4), 128).save(tmp_path / "a.png")
    uv = "vt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "f 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{VERTICES}{uv}usemtl {name}\n{faces}")
    (tmp_path / "a.mtl").write_text(f"newmtl {name}\nmap_Kd a.png\nmap_d a.png\n")
    (material,) = fr.load_mesh(tmp_path / "a.obj").materials
    assert (material.alpha, preset_of(material)) == (alpha, None)


def test_the_built_in_head_has_no_presets(head):
    assert preset_of(head.materials[0]) is None


# --- ICT-FaceKit ---------------------------------------------------------------------------------


def test_painted_maps():
    eye = np.asarray(_eye_map().rgb())
    side = len(eye)
    middle, rim, corner = (eye[side // 2, each] for each in (side // 2, int(0.8 * side), 2))
    assert middle.max() == 0
    assert rim[0] > rim[1] > rim[2] > 0
    assert corner.min() > 180
    lashes = np.asarray(_lash_map().rgb())[::-1, :, 0].reshape(6, 64, -1)
    assert (lashes[:, :8].mean(axis=(1, 2)) > 40).all()  # roots
    assert (lashes[:, -2:].max(axis=(1, 2)) < 60).all()  # tips
    assert lashes.max() == 255


# --- commands ------------------------------------------------------------------------------------


def test_render_takes_materials_of_parts(tmp_path, capsys):
    path = obj(tmp_path / "a.obj", "eye", "shirt")
    (tmp_path / "a.toml").write_text('[parts."eye"]\nm = 0.5\nks = 0.0\n[parts."*"]\nkd = 0.0\n')
    small = ("--size", "16", "--samples", "1", "--no-cache")

    status, _, err = run(
        capsys, "render", path, *small, "-o", tmp_path / "x.png", "--part", "e=skin"
    )
    assert status == 2
    assert err == ("facerender: error: no part of a.obj is called 'e': its parts are eye, shirt\n")
    scene = ("--scene", tmp_path / "a.toml")
    for words, level in ((scene, 0), ((*scene, "--part", "*,kd=1"), 1)):
        out = tmp_path / "x.exr"
        status, _, err = run(capsys, "render", path, *small, "--only", "diffuse", "-o", out, *words)
        assert (status, err) == (0, "")
        assert (read_image(out).pixels[..., :3].max() > 0.05) == bool(level)


def test_later_options_add_to_earlier_ones_and_come_last():
    options = Namespace(part=["eye,m=0.2", "*=skin", "eye,ks=0.5"])
    found = part_materials(options, {"eye": {"kd": 0.0}, "lash": {"m": 0.1}})
    assert [*found.items()] == [
        ("lash", {"m": 0.1}),
        ("*", {"preset": "skin"}),
        ("eye", {"kd": 0.0, "m": 0.2, "ks": 0.5}),
    ]


@pytest.mark.first_case
@pytest.mark.parametrize("command", ["plan", "measure", "explore", "batch"])
def test_other_commands_take_materials_of_parts(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = obj(tmp_path / "a.obj", "eye", "shirt")
    (tmp_path / "jobs.jsonl").write_text('{"mesh": "a.obj"}\n')
    words = {
        "plan": ("plan", path, "--budget", "1/255", "--size", "16"),
        "measure": ("measure", path, "--quick", "-o", "out"),
        "explore": ("explore", path, "-o", "a.html"),
        "batch": ("batch", "jobs.jsonl", "--check"),
    }[command]
    status, _, err = run(capsys, *words, "--part", "eye=glass")
    assert (status, "unknown preset 'glass'" in err) == (2, True)
    if command == "explore":
        status, _, err = run(capsys, *words, "--as-is", "--part", "eye,m=0.125")
        assert status == 0
        text = (tmp_path / "a.html").read_text()
        assert "--as-is --part eye,m=0.125" in text
    elif command != "batch":
        status, _, err = run(capsys, *words, "--part", "lash*=lashes")
        assert (status, "its parts are eye, shirt" in err) == (2, True)


def test_info_prints_a_screenful_for_many_parts(tmp_path, capsys):
    few = obj(tmp_path / "few.obj", *(f"part_{number}" for number in range(19)), "Std_Eyelash")
    lines = run(capsys, "info", few)[1].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("part  "))
    rows = lines[start + 1 : start + 21]
    assert [each.split()[0] for each in rows] == [*(f"part_{n}" for n in range(19)), "Std_Eyelash"]
    assert rows[19].split() == ["Std_Eyelash", "4", "-", "lashes", "no", "uv", "-"]
    assert lines[start + 21].startswith("warning: few.obj: presets by name")
    assert rows[0].endswith("no uv  albedo 0.48 0.28 0.21, m 0.3, f0 0.028, ks 1")

    path = obj(tmp_path / "a.obj", *(f"part_{number}" for number in range(139)), "Std_Eyelash")
    status, out, err = run(capsys, "info", path)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("part  "))
    assert lines[start + 1].split()[:4] == ["part_0", "(+138)", str(139 * 4), "yes"]
    assert lines[start + 2].split() == rows[19].split()
    assert lines[start + 3].startswith("part_0 (+138): part_1, part_2, part_3, ")
    assert lines[start + 4] == "--json lists all parts with their materials"
    assert max(map(len, lines[: start + 5])) <= 120
    facts = json.loads(run(capsys, "info", path, "--json", "--as-is")[1])
    assert [each["name"] for each in facts["parts"][:139]] == [f"part_{n}" for n in range(139)]
    assert (facts["parts"][139]["preset"], facts["warnings"]) == (None, [])


def test_info_lists_the_largest_of_many_different_parts(tmp_path, capsys):
    names = [f"part_{number}" for number in range(50)]
    path = obj(tmp_path / "a.obj", *names)
    path.write_text(f"mtllib a.mtl\n{path.read_text()}")
    colors = (f"newmtl {name}\nKd 0.5 0.5 {i / 100}\n" for i, name in enumerate(names))
    (tmp_path / "a.mtl").write_text("".join(colors))
    lines = run(capsys, "info", path)[1].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("part  "))
    assert [line.split()[0] for line in lines[start + 1 : start + 21]] == names[:20]
    assert lines[start + 21] == "and 30 more parts with 120 triangles"
    assert len(lines) < 40


# --- skin -----------------------------------------------------------------------------------------


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
    apply_names(pieces, "a.glb", as_is=True)
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
    eyes = with_geometry(mesh, parts=tuple(replace(each, skin=False) for each in mesh.parts))
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
    np.testing.assert_array_equal(read_image(png).pixels, python.srgb8())


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


@pytest.mark.filterwarnings("ignore:.*presets by name")
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


@pytest.mark.filterwarnings("ignore:.*presets by name")
@pytest.mark.parametrize("chosen", [{}, {"parts": ("Std_Eyelash",)}, {"hide": ("shirt",)}])
def test_the_cache_keeps_the_skin(chosen, tmp_path, cache_folder):
    faces = "".join(f"usemtl {each}\n{FACES}" for each in ("shirt", "Std_Eyelash", "M_Eye"))
    (tmp_path / "a.obj").write_text(VERTICES + faces)
    file = fr.MeshFile(str(tmp_path / "a.obj"), **chosen)
    plain, stored = file.load(), file.load(cache=True)
    wait_for_cache()
    cached = file.load(cache=True)
    for mesh in (stored, cached):
        assert names(mesh) == names(plain)
        assert mesh.skin == plain.skin
        assert [part.skin for part in mesh.parts] == [part.skin for part in plain.parts]
        assert mesh.materials == plain.materials


# --- info, hints ----------------------------------------------------------------------------------


def test_dull_hair_gives_no_hint_on_the_skin():
    mesh = row("head", "hair", "hair.2").with_material("hair*", ks=0.03)
    hair = tuple(replace(part, skin=part.name == "head") for part in mesh.parts)
    assert hints.faint(mesh) is not None
    assert hints.faint(with_geometry(mesh, parts=hair)) is None
