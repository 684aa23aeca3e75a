"""Tests the hints: each appears for its mistake, and none for a mesh without the mistake."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import facerender as fr
from facerender.commands import main
from facerender.errors import noting
from facerender.mesh import hints
from tests.awkward_files import MINI_HEAD, mini_head, write_glb, write_obj, write_stl
from tests.people import ball, body
from tests.test_batch import draw, reused, rows, table  # noqa: F401  # fixtures
from tests.verification.cache import wait_for_cache
from tests.verification.scan import load_scan

RNG = np.random.default_rng(33)


PLACES = [(u, v) for u in (0.15, 0.4, 0.65, 0.85) for v in (0.1, 0.3)]


def bumps(uv_of, places=PLACES, width=0.05):
    """Return a square mesh of 64 x 64 vertices with steep bumps at `places`.

    uv_of : function from the positions in [0, 1]^2 to the texture coordinates
    """
    x, y = np.meshgrid(*[np.linspace(0.0, 1.0, 64)] * 2)
    flat = np.stack([x.ravel(), y.ravel()], axis=-1)
    far = np.linalg.norm(flat[:, None] - np.array(places), axis=-1)
    height = 0.05 * np.exp(-((far / width) ** 2)).sum(axis=1)
    corner = (np.arange(63)[:, None] * 64 + np.arange(63)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + 65], axis=-1),
            np.stack([corner, corner + 65, corner + 64], axis=-1),
        ]
    )
    return fr.Mesh.from_arrays(np.column_stack([flat, height]), faces, uv=uv_of(flat))


def spotted(places, background=None, width=0.05):
    """Return a map (256, 256, 3) with noise at `places`, v upwards, on a smooth gradient.

    background : the rows with v above this value are black, apart from the spots
    """
    v, u = np.meshgrid(*[(np.arange(256) + 0.5) / 256.0] * 2, indexing="ij")
    texels = np.full((256, 256, 3), 90.0) + 30.0 * u[..., None]
    if background is not None:
        texels[v > background] = 0.0
    for place in places:
        near = np.hypot(u - place[0], v - place[1]) < 1.5 * width
        texels[near] += RNG.normal(0.0, 60.0, (near.sum(), 3))
    return fr.Texture.from_array(texels[::-1].clip(0, 255).astype(np.uint8))


def same(flat):
    return flat


def reversed_v(flat):
    return flat * (1.0, -1.0) + (0.0, 1.0)


def test_detail_of_the_map_shows_its_direction():
    texture = spotted(PLACES)
    right = bumps(same).with_material(albedo_map=texture)
    wrong = bumps(reversed_v).with_material(albedo_map=texture)
    assert hints.upside_down(right, True) is None
    assert "probably upside down (agreement" in (hints.upside_down(wrong, True) or "")
    only_normals = wrong.with_material(albedo_map=None, normal_map=texture)
    assert "give --flip-v" in (hints.upside_down(only_normals, True) or "")
    assert hints.upside_down(wrong.with_material(alpha="blend"), True) is None
    assert hints.upside_down(wrong) is None  # the map is not decoded


def test_background_refutes_the_detail():
    def lower(flat):
        return flat * (1.0, 0.6)  # v in [0, 0.6]

    places = [(u, 1.0 - 0.6 * v) for u, v in PLACES]  # where reversed v finds the bumps
    mesh = bumps(lower).with_material(albedo_map=spotted(places))
    assert hints.upside_down(mesh, True) is not None
    refuted = mesh.with_material(albedo_map=spotted(places, background=0.6))
    assert hints.upside_down(refuted, True) is None


def test_seams_show_the_direction():
    """The built-in head has a smooth map and seams with equal colours on both sides."""
    for flip_v in (False, True):
        mesh = fr.load_mesh(flip_v=flip_v)
        texture = mesh.materials[0].albedo_map
        assert texture is not None
        grey = fr.Texture.from_image(texture.rgb().transpose(1).convert("L").convert("RGB"))
        plain = mesh.with_material(albedo_map=grey)
        assert (hints.upside_down(plain, True) is not None) is flip_v


@pytest.mark.first_case
@pytest.mark.parametrize("color", [0, 128, 255])
def test_maps_without_evidence(color):
    flat = fr.Texture.from_array(np.full((64, 64, 3), color, np.uint8))
    noise = fr.Texture.from_array(RNG.integers(0, 256, (256, 256, 3), dtype=np.uint8))
    for texture in (flat, noise):
        for uv_of in (same, reversed_v):
            mesh = bumps(uv_of).with_material(albedo_map=texture, normal_map=texture)
            assert hints.of_mesh(mesh) == []


def normal_map(height, green=1.0):
    """Return the normal map of a height field, row 0 at the bottom."""
    dy, dx = np.gradient(height)
    normals = np.stack([-dx, -green * dy, np.ones_like(dx)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return fr.Texture.from_array(np.round(normals[::-1] * 127.5 + 127.5).astype(np.uint8))


def relief(size=256):
    """Return a random height field without fine detail."""
    waves = np.fft.fftfreq(size)
    spectrum = np.exp(-((np.hypot(*np.meshgrid(waves, waves)) / 0.05) ** 2))
    smooth = np.fft.ifft2(np.fft.fft2(RNG.normal(size=(size, size))) * spectrum).real
    return 2.0 * smooth / smooth.std()


def test_green_down():
    mesh, height = bumps(same), relief()
    up = mesh.with_material(normal_map=normal_map(height))
    down = mesh.with_material(normal_map=normal_map(height, -1.0))
    assert hints.green_down(up, True) is None
    assert "give --normal-map-y down" in (hints.green_down(down, True) or "")
    x = np.linspace(-1.0, 1.0, 256)
    patch = height * (np.hypot(x, x[:, None]) < 0.1)
    for weak in (0.02 * height, patch):  # differences of one 8-bit level; a small patch
        texture = normal_map(weak, -1.0)
        assert hints.green_down(mesh.with_material(normal_map=texture), True) is None
    assert hints.green_down(down) is None  # the map is not decoded


@pytest.mark.slow
def test_built_in_head_and_scan_give_no_hint(scan):
    head = fr.load_mesh()
    assert hints.of_mesh(head) == []
    turned = fr.load_mesh(normal_map_y="down")
    assert "green of the normal map of head.glb" in (hints.green_down(turned, True) or "")
    right = load_scan(scan)
    assert [hints.upside_down(right, True), hints.green_down(right, True)] == [None, None]
    assert hints.faint(right, True) is None
    wrong = fr.load_mesh(scan / "LeePerrySmith.glb", albedo=scan / "Map-COL.jpg")
    assert "give --flip-v" in (hints.upside_down(wrong, True) or "")


def dull(folder):
    """Write the head with a material without a visible highlight."""
    (folder / "a.mtl").write_text("newmtl skin\nKs 0.03 0.03 0.03\n")
    return write_obj(folder / "a.obj", mini_head(), mtl="a.mtl")


def test_faint_highlights(tmp_path):
    mesh = fr.load_mesh(dull(tmp_path))
    assert hints.faint(mesh) == (
        "a.obj has no visible highlight with ks 0.03 and m 0.3: give --ks 1 for skin"
    )
    rough = fr.Texture.from_array(np.full((64, 64), 255, np.uint8))
    for changes, remedy in (
        ({"ks": 1.0}, None),
        ({"ks": 0.0}, None),
        ({"ks": 0.18}, None),  # powdered skin
        ({"ks": 0.03, "m": 0.05}, None),
        ({"ks": 0.03, "m": 1.0}, "--ks 1 --m 0.3"),
        ({"ks": 1.0, "m": 0.9}, None),
        ({"ks": 1.0, "m": 1.2}, "--m 0.3"),
        ({"ks": 1.0, "m": 1.2, "second_slope": 0.3, "lobe_weight": 0.5}, None),
        ({"ks": 1.0, "f0": 0.001}, "--f0 0.028"),
    ):
        found = hints.faint(mesh.with_material(**changes))
        assert found is None if remedy is None else f"give {remedy} for" in (found or ""), changes
    mapped = mesh.with_material(ks=1.0, roughness_map=rough)
    assert "give --m 0.3" in (hints.faint(mapped, True) or "")
    assert hints.faint(mapped) is None  # the map is not decoded
    half = mesh.with_material(ks=1.0, roughness_map=rough, roughness_factor=0.5)
    assert hints.faint(half, True) is None


def scan(folder, *images):
    """Write the head without maps, and images beside it; return the messages of its load."""
    folder.mkdir()
    path = write_obj(folder / "scan.obj", mini_head())
    for image in images:
        (folder / image).parent.mkdir(exist_ok=True)
        (folder / image).write_bytes(b"an image")
    with noting() as messages:
        fr.load_mesh(path)
    return messages


@pytest.mark.parametrize(
    ("images", "count", "named"),
    [
        (["textures/normal.png", "textures/head_Color.JPG", "textures/rough.png"], 3, 1),
        (["Scan_Textures/u1_v1.png"], 1, 0),
        (["maps/a.png", "maps/b.png", "maps/read.txt"], 2, "maps/FILE"),
        (["Map-COL.jpg", "Map-SPEC.jpg"], 2, 0),
        (["basecolor.png", "Textures/b.png"], 1, 0),
    ],
)
@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
def test_maps_beside_a_mesh_without_maps(tmp_path, images, count, named):
    folder = tmp_path / "a"
    (message,) = scan(folder, *images)
    image = images[named] if isinstance(named, int) else named
    where = f"{image.partition('/')[0]}/" if "/" in image else "its folder"
    noun = f"{count} image{'s' * (count > 1)}"
    holds = f"scan.obj has no albedo map, but {where} holds {noun}"
    assert message == f"{holds}: give --albedo {folder / image}"


@pytest.mark.filterwarnings("error")
def test_no_maps_beside_a_mesh(tmp_path):
    """Folders without images, renderings, deeper folders, and meshes that cannot have maps."""
    others = ["textures/read.txt", "renderings/color.png", "out.png", "mapped.png"]
    assert scan(tmp_path / "a", *others) == []
    (tmp_path / "b/textures/4k").mkdir(parents=True)
    (tmp_path / "b/textures/4k/color.png").write_bytes(b"")
    write_obj(tmp_path / "b/scan.obj", mini_head())
    fr.load_mesh(tmp_path / "b/scan.obj")
    stl = write_stl(tmp_path / "b/scan.stl", mini_head())
    (tmp_path / "b/textures/color.png").write_bytes(b"")
    fr.load_mesh(stl)
    (tmp_path / "a/textures/color.png").write_bytes(b"")
    fr.load_mesh(tmp_path / "a/scan.obj", albedo=fr.Texture.from_array(np.zeros((4, 4, 3))))


def test_small_dull_parts_give_no_hint():
    head = fr.load_mesh(MINI_HEAD)
    small = replace(head.parts[0], faces=head.parts[0].faces[:200])
    dull = replace(head.materials[0], ks=0.03)
    mesh = fr.Mesh.of("two", [*head.parts, small], [*head.materials, dull])
    assert hints.faint(mesh) is None
    assert hints.faint(fr.Mesh.of("two", [*head.parts, small], [dull, *head.materials]))


def proposal(length, unit):
    return f"give --millimetres {length} ({unit}) for an eye distance of about 63 mm"


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("scale", "remedy"),
    [
        (1.0, None),
        (10.0, r"--millimetres (9\d|10\d|1e\+02) is a guess: measure the mesh"),
        (39.4, re.escape(proposal(25.4, "inches"))),
        (100.0, re.escape(proposal(10, "cm"))),
        *[(scale, re.escape(proposal(1, "mm"))) for scale in (1000.0, 1400.0)],
    ],
)
def test_unit_of_a_glb(scale, remedy, tmp_path, capsys):
    head = mini_head()
    path = write_glb(tmp_path / "a.glb", replace(head, positions=scale * head.positions))
    found = hints.wrong_unit(fr.load_mesh(path))
    expected = f"mm apart if its unit is 1000 mm: {remedy}$"
    assert found is None if remedy is None else re.search(expected, found or "")
    assert main(["info", str(path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("hint: ") is (remedy is not None)
    millimetres = float(found.split("--millimetres ")[1].split()[0]) if found else 1000.0
    assert hints.wrong_unit(fr.load_mesh(path, millimetres=millimetres)) is None


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("unit", "text"),
    [
        (1000.0, proposal(1000, "m")),
        (10.0, proposal(10, "cm")),
        (1.0, proposal(1, "mm")),
        (25.4, proposal(25.4, "inches")),
        (370.0, "--millimetres [34][0-9]0 is a guess: measure the mesh"),
    ],
)
def test_info_names_the_unit_of_a_face(unit, text, tmp_path, capsys):
    head = mini_head()
    path = write_obj(tmp_path / "a.obj", replace(head, positions=head.positions * 1000.0 / unit))
    assert main(["info", str(path)]) == 0
    out = capsys.readouterr().out
    text = text if "guess" in text else re.escape(text)
    assert re.search(f" units of unknown length: {text}\n", out)
    (line,) = [line for line in out.splitlines() if line.startswith("face with score ")]
    distance = float(re.fullmatch(r".*eyes at \(.*\) and \(.*\), (.*) units apart", line)[1])
    assert distance * unit == pytest.approx(62.7, rel=0.06)
    assert main(["info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert re.fullmatch(text, found["unit"])
    assert found["face"]["eye_distance"] == pytest.approx(distance, rel=1e-3)
    assert found["face"].keys() == {"score", "eyes", "eye_distance", "up", "front"}
    assert main(["info", str(path), "--json", "--up", "z"]) == 0
    lying = json.loads(capsys.readouterr().out)["face"]
    assert lying["eye_distance"] == pytest.approx(distance, rel=0.1)


def doll(path):
    """Write a head without a face on a body."""
    shapes = [*body((0.2, -0.5, 0.0)), ball((0.0, 0.0, 0.0), (0.08, 0.11, 0.1))]
    path.write_bytes(trimesh.util.concatenate(shapes).export(file_type="stl"))
    return path


def test_unit_of_a_doll_is_a_guess(tmp_path, capsys):
    assert main(["info", str(doll(tmp_path / "doll.stl"))]) == 0
    out = capsys.readouterr().out
    assert re.search(r": --millimetres 1000 \(m\) is a guess: measure the mesh\n", out)
    assert "\nno face found\n" in out
    assert "hint" not in out
    assert main(["info", str(tmp_path / "doll.stl"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["face"] is None


def test_a_unit_beyond_the_limits_is_not_proposed(tmp_path, capsys, renderer):
    head = mini_head()
    path = write_glb(tmp_path / "a.glb", replace(head, positions=1e-6 * head.positions))
    assert (hints.wrong_unit(fr.load_mesh(path)) or "").endswith(": scale the mesh to mm")
    path = write_obj(tmp_path / "a.obj", replace(head, positions=1e-6 * head.positions))
    assert main(["info", str(path)]) == 0
    assert " units of unknown length\n" in capsys.readouterr().out
    with pytest.raises(fr.InputError, match="unit: scale the mesh to mm, and give --millimetres 1"):
        renderer.render(fr.Scene(fr.load_mesh(path).with_skin(scattering="skin")))


def test_a_face_that_was_not_found_is_a_guess(tmp_path, renderer):
    """Each mesh warns once, and each image that records its warnings has the line."""
    mesh = fr.load_mesh(doll(tmp_path / "doll.stl"))
    line = (
        "no face was found on doll.stl, and its head is a guess from its outline: look at the "
        "image, or give --target"
    )
    renderer.render(fr.Scene(mesh))  # the default frames the whole mesh
    with pytest.warns(fr.FacerenderWarning) as caught:
        renderer.render(fr.Scene(mesh, fr.Camera(frame="face")))
    assert [str(warning.message) for warning in caught] == [line]
    for frame in ("head", "face", "eyes"):
        with noting() as noted:
            renderer.render(fr.Scene(mesh, fr.Camera(frame=frame)))
        assert noted == [line]
    with noting() as noted:
        renderer.render(fr.Scene(mesh, fr.Camera(frame="all")))
    assert noted == []
    part = replace(mesh.parts[0], name="Head")
    named = fr.Mesh.of("named", [part], mesh.materials)
    with pytest.warns(fr.FacerenderWarning, match="a guess from"):
        renderer.render(fr.Scene(named, fr.Camera(frame="eyes")))


@pytest.mark.slow
def test_records_of_a_batch_have_the_guess(table, draw, tmp_path):  # noqa: F811
    path = str(doll(tmp_path / "doll.stl"))
    jobs = [*rows(2, mesh=path, **{"camera.frame": "head"}), {**rows(1, mesh=path)[0], "id": "all"}]
    result = draw(table(jobs), "out")
    assert (result["status"], result["err"]) == (0, "")
    lines = (tmp_path / "out/jobs.jsonl").read_text().splitlines()
    records = {each["id"]: each.get("warnings", []) for each in map(json.loads, lines)}
    assert records.pop("all") == []
    assert len(records) == 2
    for warnings in records.values():
        (line,) = warnings
        assert line.startswith("no face was found on doll.stl, and its head is a guess from")


@pytest.mark.slow
def test_renderer_warns_once_for_each_mesh(renderer):
    mesh = fr.load_mesh(flip_v=True)
    with pytest.warns(fr.FacerenderWarning, match="probably upside down"):
        renderer.render(fr.Scene(mesh))
    for m in (0.2, 0.4):
        with noting() as noted:  # a batch records the warnings of each image
            renderer.render(fr.Scene(mesh.with_material(m=m)))
        assert len(noted) == 1


@pytest.mark.slow
def test_highlights_that_a_user_sets_give_no_warning(renderer, tmp_path):
    renderer.render(fr.Scene(fr.load_mesh(MINI_HEAD).with_material(ks=0.01, m=1.5)))
    mesh = fr.load_mesh(dull(tmp_path))
    renderer.render(fr.Scene(mesh.with_material(ks=1.0)))
    with pytest.warns(fr.FacerenderWarning, match="no visible highlight"):
        renderer.render(fr.Scene(mesh))


@pytest.mark.slow
def test_render_and_info_print_hints(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("FACERENDER_CACHE_MIB", "100")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for _ in range(2):  # the second run reads the cache
        assert main(["render", "--flip-v", "--size", "64", "-o", str(tmp_path / "a.png")]) == 0
        wait_for_cache()
        assert capsys.readouterr().err.count("probably upside down") == 1
    path = dull(tmp_path)
    assert main(["info", str(path), "--json"]) == 0
    assert "--ks 1" in json.loads(capsys.readouterr().out)["hints"][0]


@pytest.mark.slow
def test_every_record_of_a_batch_has_the_hints_of_its_mesh(table, draw, tmp_path):  # noqa: F811
    path = dull(tmp_path)
    result = draw(table(rows(3, mesh=str(path))), "out")
    assert (result["status"], result["err"]) == (0, "")
    records = [json.loads(line) for line in (tmp_path / "out/jobs.jsonl").read_text().splitlines()]
    hints = [[text for text in each["warnings"] if "white" not in text] for each in records]
    assert [len(each) for each in hints] == [1, 1, 1]
