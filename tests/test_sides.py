"""Tests which back faces are drawn, and in which order triangles are stored."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing import triangle_setup
from facerender.scenes.mesh import Part
from facerender.scenes.repair import in_space_order
from tests.awkward_files import MINI_HEAD, join_glb, split_glb
from tests.test_visibility import CORNERS, SIDES
from tests.verification.lights import PLAIN_THREE

FACES = [half for side in SIDES for half in (side[:3], (side[0], *side[2:]))]
BELOW = fr.Camera(-35.0, -70.0)  # looks into the open neck of a head


def obj(*groups, positions=CORNERS):
    """Return the content of an OBJ file: for each group of quadrilaterals, a part."""
    lines = ["v {} {} {}".format(*each) for each in positions]
    for number, sides in enumerate(groups):
        lines += [f"usemtl m{number}"]
        lines += ["f " + " ".join(str(corner + 1) for corner in side) for side in sides]
    return "\n".join(lines).encode()


def two_sides(mesh):
    return [each.double_sided for each in mesh.materials]


@pytest.mark.parametrize("value", [True, False, None])
def test_gltf_materials_decide(value):
    document, binary = split_glb(MINI_HEAD.read_bytes())
    if value is not None:
        document["materials"][0]["doubleSided"] = value
    content = join_glb(document, binary)
    assert two_sides(fr.load_mesh(content)) == [bool(value)]
    assert two_sides(fr.load_mesh(content, double_sided=True)) == [True]


def test_without_a_material_gltf_draws_front_faces():
    document, binary = split_glb(MINI_HEAD.read_bytes())
    del document["meshes"][0]["primitives"][0]["material"]
    assert two_sides(fr.load_mesh(join_glb(document, binary))) == [False]


def test_doubleSided_must_be_true_or_false():
    document, binary = split_glb(MINI_HEAD.read_bytes())
    document["materials"][0]["doubleSided"] = "no"
    with pytest.raises(fr.InputError, match="doubleSided|double_sided"):
        fr.load_mesh(join_glb(document, binary))


def test_closed_surfaces_of_other_formats_have_one_side():
    """Two parts can form one closed surface. A closed part beside an open one has one side."""
    other = obj(SIDES[:5], [tuple(corner + 8 for corner in side) for side in SIDES])
    both = np.concatenate([CORNERS, CORNERS + 5.0])
    cases = [
        (obj(SIDES), [False]),
        (obj(SIDES[:5]), [True]),
        (obj(SIDES[:2], SIDES[2:]), [False, False]),
        (obj(SIDES[:2], SIDES[2:5]), [True, True]),
        (other.replace(obj().strip(), obj(positions=both).strip()), [True, False]),
    ]
    for content, expected in cases:
        found = fr.load_mesh(content, kind="obj")
        assert two_sides(found) == expected
        assert two_sides(fr.load_mesh(content, kind="obj", double_sided=True)) == [True] * len(
            expected
        )


def test_arrays_follow_the_shape_or_the_material():
    assert two_sides(fr.Mesh.from_arrays(CORNERS, FACES)) == [False]
    assert two_sides(fr.Mesh.from_arrays(CORNERS, FACES[2:])) == [True]
    for value in (True, False):
        own = fr.Material(double_sided=value)
        assert two_sides(fr.Mesh.from_arrays(CORNERS, FACES, material=own)) == [value]


def test_a_cavity_that_faces_outwards_keeps_both_sides():
    """The normals point into the cube, so its faces are wound inwards."""
    shell = [tuple(reversed(face)) for face in FACES]
    flat = np.concatenate([CORNERS, 3.0 * CORNERS])
    parts = [
        Part(flat, np.tile(sign * CORNERS / np.sqrt(3.0), (2, 1)), np.array(own, dtype=np.uint32))
        for sign, own in ((-1.0, shell), (1.0, np.array(FACES) + 8))
    ]
    assert two_sides(fr.Mesh.of("nested", parts, [fr.Material()] * 2)) == [True, False]


@pytest.mark.first_case
@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("camera", [fr.Camera(), fr.Camera(100.0, 30.0), BELOW], ids=str)
def test_selected_triangles_change_no_pixel(egl, samples, camera, four_samples, monkeypatch):
    """OpenGL culls the triangles that the selection leaves out."""
    monkeypatch.setattr("facerender.drawing.renderer.deferred_is_cheaper", lambda *_: True)
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh, camera, PLAIN_THREE)
    assert two_sides(mesh) == [False]
    images, counts, draw = [], [], triangle_setup.TriangleSetup.facing
    for edge_on in (triangle_setup._EDGE_ON, 1.0):
        monkeypatch.setattr(triangle_setup, "_EDGE_ON", edge_on)

        def counted(setup, camera):
            counts.append(len(draw(setup, camera)))
            return draw(setup, camera)

        monkeypatch.setattr(triangle_setup.TriangleSetup, "facing", counted)
        with fr.Renderer((96, 96), samples=samples, backend=egl) as renderer:
            images.append(renderer.render(scene).linear)
    np.testing.assert_array_equal(*images)
    assert counts[0] < 0.75 * counts[1]
    assert counts[1] == len(mesh.parts[0].faces)


@pytest.mark.first_case
@pytest.mark.parametrize("deferred", [True, False])
def test_back_faces_are_drawn_only_with_two_sides(egl, deferred, monkeypatch):
    name = "facerender.drawing.renderer.deferred_is_cheaper"
    monkeypatch.setattr(name, lambda *_: deferred)
    mesh = fr.load_mesh(MINI_HEAD)
    both = mesh.with_material(double_sided=True)
    with fr.Renderer((96, 96), samples=4, backend=egl) as renderer:
        one, two = (
            renderer.render(fr.Scene(each, BELOW, PLAIN_THREE)).linear[..., 3]
            for each in (mesh, both)
        )
        layers = [renderer.gbuffer(fr.Scene(each, BELOW)) for each in (mesh, both)]
    assert one.mean() < 0.9 * two.mean()
    shown = [(each.part >= 0).mean() for each in layers]
    assert shown[0] < 0.9 * shown[1]
    normals = layers[0].normal[layers[0].part >= 0]
    towards = layers[0].view.position - layers[0].normalised_position[layers[0].part >= 0]
    assert ((normals * towards).sum(axis=1) > 0.0).mean() > 0.99


def test_both_sides_cast_shadows(egl):
    """A sheet above a floor casts the same shadow, whichever side it turns to the light."""
    square = np.array([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], dtype=float)
    up, down = [(0, 2, 1), (0, 3, 2)], [(0, 1, 2), (0, 2, 3)]
    light = fr.Light(0.0, 89.0, shadow=True)
    images = []
    for sheet in (up, down):
        parts = [
            Part(2.0 * square, np.tile((0.0, 1.0, 0.0), (4, 1)), np.array(up, dtype=np.uint32)),
            Part(
                0.5 * square + (0.0, 1.0, 0.0),
                np.tile((0.0, 1.0 if sheet is up else -1.0, 0.0), (4, 1)),
                np.array(sheet, dtype=np.uint32),
            ),
        ]
        mesh = fr.Mesh.of("sheet", parts, [fr.Material(double_sided=False)] * 2)
        with fr.Renderer((64, 64), samples=1, backend=egl) as renderer:
            scene = fr.Scene(mesh, fr.Camera(0.0, 15.0), (light,))
            buffer = renderer.gbuffer(scene)
            images.append((buffer.part == 0, buffer.visibility[..., 0]))
    floor = images[0][0] & images[1][0]
    assert (images[0][1][floor] < 0.5).sum() > 20
    assert np.abs(images[0][1] - images[1][1])[floor].max() < 0.01


def test_the_command_draws_both_sides(tmp_path):
    """The option, the field of a part and the scene file have the same effect."""
    from PIL import Image

    from facerender.commands import main

    options = ["--size", "64", "--camera=-35,-70", "--no-shadows", "--samples", "1"]
    (tmp_path / "both.toml").write_text('[parts."*"]\ndouble_sided = true\n')
    images = []
    for extra in (
        [],
        ["--double-sided"],
        ["--part", "*,double_sided=true"],
        ["--scene", str(tmp_path / "both.toml")],
    ):
        path = tmp_path / "a.png"
        assert main(["render", str(MINI_HEAD), *options, "-o", str(path), *extra]) == 0
        images.append(np.asarray(Image.open(path)).copy())
    assert (images[0] != images[1]).any()
    for each in images[2:]:
        np.testing.assert_array_equal(each, images[1])


def test_random_triangles_are_put_in_order():
    mesh = fr.load_mesh(MINI_HEAD)
    faces, positions = mesh.parts[0].faces.astype(np.int64), mesh.parts[0].positions
    assert in_space_order(faces, positions) is faces
    mixed = np.random.default_rng(3).permutation(faces)
    ordered = in_space_order(mixed, positions)
    assert {*map(tuple, ordered)} == {*map(tuple, faces)}
    steps = [
        np.linalg.norm(np.diff(positions[each[:, 0]], axis=0), axis=1) for each in (mixed, ordered)
    ]
    assert np.median(steps[1]) < 0.1 * np.median(steps[0])


def test_a_shuffled_file_gives_the_same_picture(egl):
    document, binary = split_glb(MINI_HEAD.read_bytes())
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["indices"]]
    view = document["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    kind = {5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
    faces = np.frombuffer(binary, kind, accessor["count"], start).reshape(-1, 3)
    mixed = np.random.default_rng(5).permutation(faces).tobytes()
    shuffled = join_glb(document, binary[:start] + mixed + binary[start + len(mixed) :])
    scenes = [fr.Scene(fr.load_mesh(each), lights=PLAIN_THREE) for each in (MINI_HEAD, shuffled)]
    with fr.Renderer((96, 96), samples=1, backend=egl) as renderer:
        images = [renderer.render(each).linear for each in scenes]
    assert (np.abs(images[0] - images[1]).max(axis=-1) > 1e-3).mean() < 1e-3


def test_double_sided_is_checked():
    with pytest.raises(fr.InputError, match="double_sided"):
        fr.Material(double_sided="yes")
    with pytest.raises(fr.InputError, match="double_sided"):
        fr.load_mesh(MINI_HEAD, double_sided=1)


def test_the_info_names_two_sides(capsys):
    from facerender.commands import main

    assert main(["info", str(MINI_HEAD), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["parts"][0]["material"]["double_sided"] is False


def test_copies_keep_their_sides():
    mesh = fr.load_mesh(MINI_HEAD, double_sided=True)
    assert two_sides(mesh.select(mesh.parts[0].name)) == [True]
    assert two_sides(replace(mesh, millimetres=1.0)) == [True]
