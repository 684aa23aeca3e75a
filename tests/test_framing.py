"""Tests framing: head and face are found in many kinds of meshes by names and geometry, and a
camera frames them."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest

import facerender as fr
from facerender.mesh.framing import names_head
from facerender.scene.view import view_of
from tests.awkward_files import Glb
from tests.people import PEOPLE, ball, body, hair, head_shape, limb, mesh_of, person
from tools.head.landmarks import HAIRLINE

# Heights on the built-in head in metres, judged by eye.
CHIN, CROWN, BROW = -0.105, 0.116, 0.01

# Points of the built-in head in metres: the hairline from its generator, and the lower end of the
# chin, where the profile has receded by 6 mm, as at landmark 8 of ICT-FaceKit.
TRICHION, MENTON = (0.0, 0.01 * HAIRLINE[0][1], 0.084), (0.0, -0.11, 0.0848)

EYES = (-0.0313, 0.0, 0.082), (0.0322, 0.0, 0.082)

known = cache(person)


def ends(mesh, region):
    """Return the lowest and the highest y of a region, in the mesh's units."""
    middle = mesh.to_mesh_space(region.center)[1]
    return middle - region.height * mesh.radius, middle + region.height * mesh.radius


@pytest.mark.first_case
@pytest.mark.parametrize("name", PEOPLE)
def test_face_of_a_person_is_found(name):
    mesh = known(name)
    low, high = ends(mesh, region := mesh.regions["face"])
    assert CHIN - 0.025 < low < CHIN + 0.01
    assert BROW + 0.03 < high < CROWN + 0.015
    assert abs(mesh.to_mesh_space(region.center)[0]) < 0.006
    assert 0.045 < region.radius * mesh.radius < 0.09
    assert (face := fr.find_face(mesh)) is not None
    assert np.linalg.norm(face.eyes - EYES, axis=1).max() < 0.02
    assert 0.045 < face.eye_distance < 0.09
    assert min(face.up[1], face.front[2]) > 0.97


@pytest.mark.parametrize("name", sorted(PEOPLE.keys() - {"mask"}))
def test_head_of_a_person_is_found(name):
    mesh = known(name)
    low, high = ends(mesh, region := mesh.regions["head"])
    assert CHIN - 0.06 < low < CHIN + 0.005
    top = 0.19 if name == "bun" else 0.14 if "hair" in name else CROWN
    assert high == pytest.approx(top, abs=0.004)
    assert 0.09 < region.radius * mesh.radius < 0.17


def height_in_image(mesh, camera, *points):
    """Return the distance of two points in the image, as a fraction of the image's height."""
    view = view_of(fr.Scene(mesh, camera), 1.0)
    clip = np.column_stack([mesh.normalised(points), np.ones(2)]) @ view.matrix
    assert np.abs(clip[:, :2]).max() < clip[:, 3].min()
    return abs(np.diff(clip[:, 1] / clip[:, 3])[0]) / 2.0


@pytest.mark.parametrize("name", sorted(PEOPLE.keys() - {"mask"}))
@pytest.mark.parametrize("fov", [10.0, 25.0, 50.0])
def test_face_fills_most_of_the_image(name, fov):
    camera = fr.Camera(fov=fov, frame="face")
    assert 0.85 < height_in_image(known(name), camera, TRICHION, MENTON) < 0.9


def test_face_of_a_mask_is_the_mask():
    """The mouth is a hole, and the mask ends at the chin and at the hairline."""
    shape = head_shape()
    x, y, z = shape.triangles_center.T
    mouth = (np.abs(x) < 0.03) & (np.abs(y + 0.068) < 0.006)
    inside = (z > 0.02) & (y > -0.112) & (y < 0.07) & (np.abs(x) < 0.07) & ~mouth
    mesh = mesh_of("mask", [(shape.vertices, shape.faces[inside])])
    low, high = ends(mesh, mesh.regions["face"])
    assert low == pytest.approx(-0.112 - 0.009, abs=0.006)
    assert high == pytest.approx(0.07 + 0.009, abs=0.006)


LARGER = PEOPLE.keys() - {"head", "mask", "hair"}


@pytest.mark.parametrize("name", PEOPLE)
def test_the_default_frames_the_head_of_a_larger_mesh(name):
    mesh = known(name)
    wanted = "head" if name in LARGER else "all"
    views = [view_of(fr.Scene(mesh, fr.Camera(frame=each)), 1.0) for each in ("auto", wanted)]
    np.testing.assert_array_equal(views[0].matrix, views[1].matrix)
    assert fr.Camera().frame == "auto"


def box(extents, center):
    import trimesh

    return trimesh.creation.box(extents).apply_translation(center)


def things():
    """Return shapes without a head; some have a part like a head, or like a nose."""
    legs = [box((0.05, 0.45, 0.05), (x, 0.22, z)) for x in (-0.22, 0.22) for z in (-0.22, 0.22)]
    seat = [box((0.5, 0.05, 0.5), (0.0, 0.45, 0.0)), box((0.5, 0.5, 0.05), (0.0, 0.75, -0.22))]
    rest = [box((0.3, 0.15, 0.06), (0.0, 1.1, -0.22)), box((0.06, 0.2, 0.05), (0.0, 1.0, -0.22))]
    post = limb((0.0, 0.0, 0.0), (0.0, 0.4, 0.0), 0.02)
    return {
        "sphere": [ball((0, 0, 0), (1, 1, 1))],
        "egg": [ball((0, 0, 0), (1, 1.3, 1))],
        "chair": [*legs, *seat],
        "chair with head rest": [*legs, *seat, *rest],
        "lamp": [post, ball((0.0, 0.5, 0.0), (0.12, 0.12, 0.12))],
        "tap": [post, limb((0.0, 0.35, 0.0), (0.0, 0.3, 0.2), 0.02)],
        "snowman": [ball((0, y, 0), (r, r, r)) for y, r in ((0.3, 0.3), (0.75, 0.22), (1.1, 0.15))],
    }


@pytest.mark.parametrize("name", things())
def test_the_default_frames_all_of_a_thing(name):
    mesh = mesh_of(name, [(each.vertices, each.faces) for each in things()[name]])
    assert mesh.regions["auto"] is None


@pytest.mark.parametrize(("apart", "scale"), [(0.3, 1.0), (0.9, 1.0), (0.9, 0.8)])
def test_the_default_frames_both_of_two_heads(apart, scale):
    shapes = [head_shape(), *body((0.2, -0.5, 0.0))] if apart > 0.5 else [head_shape()]
    pairs = [
        (each.vertices * size + (x, 0.0, 0.0), each.faces)
        for x, size in ((-apart / 2.0, 1.0), (apart / 2.0, scale))
        for each in shapes
    ]
    assert mesh_of("two", pairs).regions["auto"] is None


@pytest.mark.parametrize(
    ("name", "is_head"),
    [
        *((each, True) for each in ("Head", "Wolf3D_Head", "M_Face", "M_BackHead", "HEAD.001")),
        *((each, True) for each in ("mixamorig:Head", "J_Bip_C_Head", "face", "BaseHead_lod0")),
        *((each, False) for each in ("Headscarf", "headphones", "Overhead light", "HeadTop_End")),
        *((each, False) for each in ("Head_Light", "headHair", "surface", "forehead", "Body", "")),
    ],
)
def test_names_of_heads_are_words(name, is_head):
    assert names_head(name) == is_head


def hooded(name):
    """Return a body in T-pose whose part with the given name has the head, without a nose, and
    whose hair hides the neck and lies on the arms."""
    arms = ball((0.0, -0.23, -0.03), (0.75, 0.05, 0.06))
    curls = [ball((x, -0.08, 0.0), (0.07, 0.2, 0.1)) for x in (-0.12, 0.12)]
    skull = ball((0.0, 0.0, 0.0), (0.08, 0.11, 0.1))
    shapes = [*body((0.58, 0.0, 0.0)), arms, *curls, *hair(0.45), skull]
    names = [""] * (len(shapes) - 1) + [name]
    return mesh_of("hooded", [(each.vertices, each.faces) for each in shapes], names)


def test_named_parts_are_framed_first():
    region = hooded("CC_Base_Head").regions["head"]
    low, high = ends(hooded(""), region)
    assert -0.16 < low < -0.1
    assert 0.1 < high < 0.15
    assert ends(hooded(""), hooded("Headscarf").regions["head"])[0] < -0.165


@pytest.mark.parametrize(("other", "clear"), [("EyeLeft", True), ("Eyelet", False)])
def test_a_named_head_without_a_nose_needs_eyes(other, clear):
    shapes = [
        *body((0.58, 0.0, 0.0)),
        ball((0, 0, 0), (0.1, 0.12, 0.1)),
        ball((0.04, 0.02, 0.08), (0.01,) * 3),
    ]
    names = [""] * (len(shapes) - 2) + ["Head", other]
    mesh = mesh_of("doll", [(each.vertices, each.faces) for each in shapes], names)
    assert (mesh.regions["auto"] is not None) == clear


@pytest.mark.parametrize("named", ["Head", "face", ""])
def test_a_named_part_may_be_a_whole_body(named):
    shapes = [head_shape(), *body((0.58, 0.0, 0.0))]
    import trimesh

    whole = trimesh.util.concatenate(shapes)
    mesh = mesh_of("body", [(whole.vertices, whole.faces)], [named])
    low, high = ends(mesh, mesh.regions["head"])
    assert CHIN - 0.06 < low < CHIN + 0.005
    assert high == pytest.approx(CROWN, abs=0.004)


def test_long_hair_does_not_widen_the_head():
    """Ponytails on a body in T-pose reach the hips and touch the arms."""
    tails = [limb((x, 0.05, -0.08), (2.5 * x, -0.6, -0.1), 0.04) for x in (-0.09, 0.09)]
    shapes = [head_shape(), *body((0.58, 0.0, 0.0)), *tails]
    mesh = mesh_of("tails", [(each.vertices, each.faces) for each in shapes])
    region = mesh.regions["head"]
    assert region.radius * mesh.radius < 0.2
    assert 0.85 < height_in_image(mesh, fr.Camera(frame="face"), TRICHION, MENTON) < 0.9


@pytest.mark.parametrize("joint", ["mixamorig:Head", "Spine"])
def test_vertices_of_a_head_joint_are_framed_first(joint):
    """A doll without neck and nose is one part. A child of the joint moves half of its head."""
    import trimesh

    doll = trimesh.util.concatenate(
        [ball((0, 1.4, 0), (0.3, 0.5, 0.2)), ball((0, 1.9, 0), (0.3,) * 3)]
    )
    places = np.asarray(doll.vertices, "<f4")
    top = np.arange(len(places)) >= len(places) // 2
    joints, weights = np.zeros((2, len(places), 4))
    joints[top, 0] = np.where(places[top, 0] > 0.0, 1, 2)
    weights[:, 0] = 1.0
    file = Glb(
        {"name": "Body", "mesh": 0, "skin": 0},
        {"name": "Hips", "children": [2]},
        {"name": joint, "children": [3], "translation": [0.0, 1.7, 0.0]},
        {"name": "LeftEye"},
    )
    file.document["scenes"][0]["nodes"] = [0, 1]
    attributes = {"JOINTS_0": file.add(joints, "<u1"), "WEIGHTS_0": file.add(weights)}
    file.mesh(file.primitive(places, doll.faces, **attributes))
    file.skin([1, 2, 3])
    mesh = file.load()
    named = joint != "Spine"
    assert (mesh.parts[0].head is not None) == named
    assert (mesh.regions["auto"] is not None) == named
    if named:
        low, high = ends(mesh, mesh.regions["head"])
        assert low == pytest.approx(1.6 + 1.7, abs=0.02)
        assert high == pytest.approx(2.2 + 1.7, abs=0.02)
        kept = mesh.select("Body").parts[0].head
        np.testing.assert_array_equal(kept, mesh.parts[0].head)


@pytest.mark.parametrize(("scale", "move"), [(1000.0, (0, 0, 0)), (0.01, (5, -9, 2)), (39.37, 0)])
def test_units_and_position_do_not_matter(scale, move):
    shift = np.broadcast_to(np.asarray(move, float) * scale, 3)
    own = person("arms down")
    other = person("arms down", scale, shift)
    for name in ("head", "face"):
        a, b = own.regions[name], other.regions[name]
        center = (other.to_mesh_space(b.center) - shift) / scale
        np.testing.assert_allclose(center, own.to_mesh_space(a.center), atol=2e-3)
        assert b.radius == pytest.approx(a.radius, rel=0.02)


def test_face_of_a_scan_is_found(scan_mesh):
    """The eyes of the scan are at y = 1.9, its chin at -0.45 and its crown at 4. The hairline is
    where the forehead of the bald scan turns to the crown."""
    low, high = ends(scan_mesh, scan_mesh.regions["face"])
    assert -1.3 < low < -0.3
    assert 2.6 < high < 4.3
    assert ends(scan_mesh, scan_mesh.regions["head"])[1] == pytest.approx(3.97, abs=0.05)
    points = (-0.08, 3.1, 1.95), (-0.08, -0.48, 2.1)
    assert 0.8 < height_in_image(scan_mesh, fr.Camera(frame="face"), *points) < 0.92


@pytest.mark.parametrize("frame", ["head", "face"])
@pytest.mark.parametrize("azimuth", [0.0, 70.0, 200.0])
def test_camera_frames_its_region(head, frame, azimuth):
    region = head.regions[frame]
    camera = fr.Camera(azimuth, 10.0, frame=frame)  # type: ignore[arg-type]
    view = view_of(fr.Scene(head, camera), 0.8)
    turn = np.linspace(0.0, 2.0 * np.pi, 16)
    sides = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], axis=1) * region.radius
    rims = [region.center + sides + (0.0, y, 0.0) for y in (-region.height, region.height)]
    clip = np.column_stack([np.concatenate(rims), np.ones(32)]) @ view.matrix
    across = np.abs(clip[:, :2] / clip[:, 3:])
    assert across.max() <= 1.0
    assert across.max() > 0.8
    center = [*region.center, 1.0] @ view.matrix
    np.testing.assert_allclose(center[:2] / center[3], 0.0, atol=1e-12)


def test_target_and_zoom_override_the_found_region(head):
    own = view_of(fr.Scene(head, fr.Camera(frame="face")), 1.0)
    near = view_of(fr.Scene(head, fr.Camera(frame="face", zoom=2.0)), 1.0)
    middle = head.regions["face"].center
    assert np.linalg.norm(near.position - middle) == pytest.approx(
        np.linalg.norm(own.position - middle) / 2
    )
    place = (0.01, 0.02, 0.03)
    moved = view_of(fr.Scene(head, fr.Camera(frame="face", target=place)), 1.0)
    np.testing.assert_allclose(
        moved.position - own.position, head.normalised(place) - middle, atol=1e-12
    )


def test_simplified_mesh_keeps_its_regions(head):
    fewer = fr.simplified(head, 3000).with_material(m=0.2)
    for name in ("head", "face"):
        assert fewer.regions[name] is head.regions[name]
    again = pickle.loads(pickle.dumps(fewer))
    assert again.regions["face"].radius == head.regions["face"].radius


@pytest.mark.parametrize("width", [0.001, 0.01])
def test_head_below_a_thin_tip_is_found(width):
    """A strand of hair is not the head, although a wider shape follows below."""
    shape = head_shape()
    tip = np.array([(-width, 0.115, 0.0), (width, 0.115, 0.0), (0.0, 0.175, 0.0)])
    mesh = mesh_of("tip", [(shape.vertices, shape.faces), (tip, [(0, 1, 2)])])
    low, high = ends(mesh, region := mesh.regions["head"])
    assert CHIN - 0.06 < low < CHIN + 0.005
    assert CROWN - 0.004 < high < 0.176
    assert 0.09 < region.radius * mesh.radius < 0.17
    assert 0.8 < height_in_image(mesh, fr.Camera(frame="face"), TRICHION, MENTON) < 0.95


def flat_box(sizes):
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij")).reshape(3, -1).T * sizes
    faces = [(0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 3, 7), (2, 7, 6)]
    return mesh_of("box", [(corners, [*faces, (0, 2, 6), (1, 3, 7)])])


@pytest.mark.parametrize("sizes", [(0, 1, 1), (1, 1, 0), (1, 0, 1)])
def test_regions_of_a_flat_box_are_the_box(sizes):
    check_regions_are_the_mesh(flat_box(sizes))


def test_regions_of_a_thin_box_are_a_guess():
    """The front and the back of the thin box are apart, so a row has points of one x only."""
    mesh = flat_box((3e-4, 1, 1))
    assert mesh.regions["auto"] is None
    assert ends(mesh, region := mesh.regions["head"]) == pytest.approx((-0.5, 0.5), abs=1e-3)
    assert region.radius * mesh.radius == pytest.approx(0.5, abs=1e-3)
    with pytest.warns(fr.FacerenderWarning, match="on box, and its head is a guess from its out"):
        position_of(mesh, "head")
    for name in ("face", "eyes"):
        low, high = ends(mesh, mesh.regions[name])
        assert -0.55 < low < high < 0.55


def position_of(mesh, frame):
    return view_of(fr.Scene(mesh, fr.Camera(frame=frame)), 1.0).position


def check_regions_are_the_mesh(mesh):
    """One warning says that no face was found."""
    assert mesh.regions["auto"] is None
    with pytest.warns(fr.FacerenderWarning) as caught:
        first = position_of(mesh, "head")
    assert [str(warning.message) for warning in caught] == [
        f"no face was found on {mesh.name}: frame head shows the whole mesh"
    ]
    for position in (first, position_of(mesh, "face"), position_of(mesh, "eyes")):
        np.testing.assert_allclose(position, position_of(mesh, "auto"), rtol=1e-6)


def test_regions_of_a_mesh_with_a_far_vertex_are_the_mesh():
    """All triangles but one are at one point in float64."""
    shape = ball((0, 0, 0), (1, 1, 1))
    shape.vertices[0] = (0.0, 0.0, 1e30)
    check_regions_are_the_mesh(mesh_of("far", [(shape.vertices, shape.faces)]))
