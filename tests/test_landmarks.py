"""Tests landmarks: their file, their positions on posed and split meshes, and their pixels and
visibility against rays in float64."""

from __future__ import annotations

import json
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.batch.outputs import draw
from facerender.scene.landmarks import MAX_LANDMARKS, located
from tests.meshes import with_geometry
from tests.test_parts import row
from tests.verification.rays import Surface, by_opencv, camera_of


@pytest.fixture(scope="module")
def skull():
    return fr.load_mesh()


def written(tmp_path, content):
    path = tmp_path / "landmarks.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def tetrahedron():
    return fr.Mesh.from_arrays(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (5, 5, 5)],
        [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)],
    )


def covered_at(image, pixels):
    """Return whether the pixels of points in an image have a depth."""
    column, row = pixels.astype(int).T
    return image[row, column, 3] > 0.0


# --- files ---------------------------------------------------------------------------------------


def test_a_file_lists_or_names_landmarks(tmp_path):
    corner, middle = 3, {"vertices": [0, 1, 2], "weights": [0.25, 0.25, 0.5]}
    edge = {"vertices": [1, 3], "weights": [0.5, 0.5]}
    expected = [(0.0, 0.0, 1.0), (0.25, 0.5, 0.0), (0.5, 0.0, 0.5)]
    listed = written(tmp_path, [corner, {"name": "middle", **middle}, edge])
    found = fr.load_landmarks(listed)
    assert found.names == ("0", "middle", "2")
    np.testing.assert_allclose(found.positions(tetrahedron()), expected, atol=1e-15)
    named = written(tmp_path, {"a": {"vertices": corner}, "b": middle, "c": edge})
    found = fr.load_landmarks(named)
    assert found.names == ("a", "b", "c")
    assert repr(found) == "<Landmarks, 3 from 'a' on>"
    np.testing.assert_allclose(found.positions(tetrahedron()), expected, atol=1e-15)


def test_rounded_weights_are_scaled(tmp_path):
    third = {"vertices": [0, 1, 2], "weights": [0.33, 0.33, 0.33]}
    found = fr.load_landmarks(written(tmp_path, [third]))
    np.testing.assert_allclose(found.weights, [[1 / 3] * 3])


def test_landmarks_follow_poses(skull):
    """Numbers count the vertices of all parts, or of one part."""
    counts = [len(part.positions) for part in skull.parts]
    eyes, head = skull.parts[1], skull.parts[0]
    of_head, of_eyes = (int(part.faces[100, 0]) for part in (head, eyes))
    numbers = [[of_head] * 3, [counts[0] + of_eyes] * 3, [of_eyes] * 3]
    own = fr.Landmarks(
        ("head", "eyes", "part"), np.array(numbers), np.eye(3)[[0] * 3], ("", "", eyes.name)
    )
    step = np.array([0.01, 0.02, 0.03])
    posed = skull.with_positions([None, eyes.positions + step, None, None, None])
    for mesh, moved in ((skull, 0.0), (posed, step)):
        expected = head.positions[of_head], *[eyes.positions[of_eyes] + moved] * 2
        np.testing.assert_array_equal(own.positions(mesh), expected)


def test_numbers_count_the_vertices_of_the_file():
    """Parts that share the vertices of a file, as an OBJ file with texture seams and materials."""
    places = np.random.default_rng(1).normal(size=(6, 3))
    cells = np.array([5, 0, 1, 0]), np.array([2, 3, 4])  # vertex of the file, for each vertex
    faces = np.array([[0, 1, 2], [0, 3, 2]]), np.array([[0, 1, 2]])
    pairs = [
        replace(fr.Mesh.from_arrays(places[own], corners).parts[0], name=name)
        for own, corners, name in zip(cells, faces, "ab", strict=True)
    ]
    parts = [
        replace(part, sources=own, source_count=6) for part, own in zip(pairs, cells, strict=True)
    ]
    mesh = fr.Mesh.of("split", parts, [fr.Material()] * 2)
    every = fr.Landmarks(tuple("uvwxyz"), np.arange(6)[:, None] + [0] * 3, np.eye(3)[[0] * 6])
    np.testing.assert_array_equal(every.positions(mesh), places)
    one = replace(every, parts=("a", "a", "b", "b", "b", "a"))
    np.testing.assert_array_equal(one.positions(mesh), places)
    with pytest.raises(
        fr.InputError, match="landmark 'u': vertex 0, but no triangle of part 'b' of split uses it"
    ):
        replace(every, parts=("b",) * 6).positions(mesh)


def test_vertices_that_a_mesh_lacks():
    def at(number, part=""):
        return fr.Landmarks(("tip",), np.full((1, 3), number), np.eye(3)[:1], (part,))

    mesh = tetrahedron()
    two = with_geometry(mesh, parts=mesh.parts * 2, materials=mesh.materials * 2)
    for landmarks, own, message in (
        (at(5), mesh, "landmark 'tip': vertex 5, but arrays has 5 vertices: give the number of a"),
        (at(4), mesh, "landmark 'tip': vertex 4, but no triangle of arrays uses it: give the num"),
        (at(0, "nose"), mesh, "no part of arrays is called 'nose'"),
        (at(0, "arr*"), two, r"landmark part 'arr\*' matches 2 parts: give one part"),
    ):
        with pytest.raises(fr.InputError, match=f"^{message}") as caught:
            landmarks.positions(own)
        assert "\n" not in str(caught.value)


HOSTILE = {
    "empty": ("", "its JSON cannot be read"),
    "text": ('"nose"', "content = 'nose': give a list of landmarks, or a table by name"),
    "number": ("3", "content = 3: give a list"),
    "none": ("[]", "0 landmarks: give 1 to 100000"),
    "many": (f"[{'1,' * 1_000_000}1]", "1000001 landmarks: give 1 to 100000"),
    "deep": ("[" * 100_000, "its JSON cannot be read"),
    "nested": (f"[{'[' * 500}{']' * 500}]", "landmark '0': vertices = .*: give one to three"),
    "null": ("[null]", "landmark '0': vertices = None: give one to three vertex numbers"),
    "negative": ("[-1]", "landmark '0': vertices = -1"),
    "digits": (f"[{'9' * 5000}]", "its JSON cannot be read"),
    "four": ('[{"vertices": [1, 2, 3, 4], "weights": [1, 0, 0, 0]}]', "landmark '0': vertices"),
    "weights": ('[{"vertices": [1, 2]}]', r"weights = None: give 2 numbers in \[0, 1\]"),
    "nan": ('[{"vertices": [1, 2], "weights": [NaN, 1]}]', r"weights = \[nan, 1\]: give 2 num"),
    "sum": ('[{"vertices": [1, 2], "weights": [0.5, 0.6]}]', "have the sum 1.1: give weights in"),
    "sign": ('[{"vertices": [1, 2], "weights": [1.5, -0.5]}]', "have the sum 1: give weights in"),
    "key": ('{"a": {"vertex": 1}}', "landmark 'a': unknown key 'vertex'; known: vertices, weig"),
    "name": ('[{"name": 1, "vertices": 1}]', "landmark '0': name = 1: give text"),
    "part": ('[{"part": ["a"], "vertices": 1}]', r"landmark '0': part = \['a'\]: give text"),
    "same": ('[1, {"name": "0", "vertices": 1}]', "two landmarks are called '0': give different"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(tmp_path, name):
    content, message = HOSTILE[name]
    path = tmp_path / "face.json"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(fr.InputError, match=f"^face.json: .*{message}") as caught:
        fr.load_landmarks(path)
    assert len(str(caught.value).splitlines()) == 1


def test_other_files_are_refused(tmp_path):
    large = tmp_path / "large.json"
    large.write_bytes(b" " * (1 << 24) + b"[1]")
    with pytest.raises(fr.InputError, match="bytes, but the limit is"):
        fr.load_landmarks(large)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ()}, f"^0 landmarks: give 1 to {MAX_LANDMARKS}"),
        ({"names": ("a", "a")}, "two landmarks are called 'a'"),
        ({"vertices": np.zeros((3, 3))}, "landmark vertices has 3 rows: give 2"),
        ({"vertices": np.full((2, 3), 0.5)}, "landmark 'a': vertex 0.5: give a vertex number"),
        ({"vertices": np.full((2, 3), -1)}, "landmark 'a': vertex -1: give a vertex number"),
        ({"vertices": np.full((2, 3), 1e12)}, "landmark 'a': vertex 1e[+]12: give"),
        ({"weights": np.full((2, 3), np.nan)}, "landmark weights.0. = .nan"),
        ({"weights": np.ones((2, 3))}, "landmark 'a': weights .* have the sum 3: give"),
        ({"parts": ("a",)}, "1 landmark parts: give 2, one for each landmark"),
    ],
)
def test_fields_are_checked(changes, message):
    good = {
        "names": ("a", "b"),
        "vertices": np.zeros((2, 3), np.int64),
        "weights": np.full((2, 3), 1 / 3),
    }
    fr.Landmarks(**good)
    with pytest.raises(fr.InputError, match=message):
        fr.Landmarks(**{**good, **changes})


# --- images --------------------------------------------------------------------------------------


def nearest(mesh, *targets):
    """Return landmarks at the vertices of the skin that are nearest to points in the renderer's
    space."""
    part = mesh.parts[0]
    places = mesh.normalised(part.positions)
    drawn = np.unique(part.faces)
    found = [drawn[np.linalg.norm(places[drawn] - each, axis=1).argmin()] for each in targets]
    names = tuple(map(str, range(len(found))))
    return fr.Landmarks(names, np.array(found)[:, None] + [0] * 3, np.eye(3)[[0] * len(found)])


def nose_of(mesh):
    """Return the place of the nose tip in the renderer's space: the frontmost vertex of the skin
    in the middle of the face."""
    places = mesh.normalised(mesh.parts[0].positions[np.unique(mesh.parts[0].faces)])
    middle = places[np.abs(places[:, 0]) < 0.02]
    return middle[middle[:, 2].argmax()]


@pytest.mark.slow
def test_nose_neck_and_cheeks(skull, renderer):
    nose = nose_of(skull)
    back = nose * (1, 1, -1)
    left, right = nose + (0.25, 0.0, -0.2), nose + (-0.25, 0.0, -0.2)  # cheeks
    landmarks = nearest(skull, nose, back, left, right)
    for azimuth, expected in (
        (0.0, [True, False, True, True]),
        (60.0, [True, False, True, False]),
        (-60.0, [True, False, False, True]),
        (180.0, [False, True, False, False]),
    ):
        scene = fr.Scene(skull, fr.Camera(azimuth))
        pixels, depth, visible = renderer.landmarks(scene, landmarks)
        assert visible.tolist() == expected, azimuth
        points, camera = landmarks.positions(skull), camera_of(scene, renderer.size)
        np.testing.assert_allclose(pixels, by_opencv(points, camera), atol=1e-6)
        in_camera = points @ camera[1][:, :3].T + camera[1][:, 3]
        np.testing.assert_allclose(depth, in_camera[:, 2], rtol=1e-12)


@pytest.mark.slow
def test_landmarks_on_silhouettes_do_not_flicker(skull, renderer):
    """Points that are nearly edge-on stay visible in every grid of pixels, except on pixels whose
    centre shows the background."""
    scene, surface = fr.Scene(skull, fr.Camera(80.0, 5.0)), Surface.of(skull)
    points, own = surface.points(20000, seed=4)
    view = fr.view_of(scene, 1.0)
    a, b, c = surface.corners[own].transpose(1, 0, 2)
    normals, rays = np.cross(b - a, c - a), skull.to_mesh_space(view.position) - points
    facing = (normals * rays).sum(axis=1)
    facing /= np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    slanted = (facing > 0.0) & (facing < 0.1)
    matrices = camera_of(scene, renderer.size)
    _, index, _ = surface.hit(by_opencv(points[slanted], matrices), matrices)
    rim = points[slanted][index == own[slanted]]
    assert len(rim) > 200
    for shift in np.random.default_rng(0).uniform(-1.0, 1.0, (8, 2)):
        moved = fr.shifted(scene, *shift, renderer.size)
        image = renderer.render(moved, only="depth").linear
        pixels, _, visible = located(fr.view_of(moved, 1.0), skull, rim, image)
        covered = covered_at(image, pixels)
        assert covered.mean() > 0.5
        assert visible[covered].mean() > 0.995
        assert not visible[~covered].any()


def test_landmarks_outside_the_image(skull, renderer):
    landmarks = nearest(skull, nose_of(skull))
    (tip,) = landmarks.positions(skull)
    beside = tip + (0, 0, skull.radius), tip + (0.1 * skull.radius, 0, 0)
    away = fr.Scene(skull, fr.Camera(position=tuple(beside[0]), target=(*tip[:2], 9.0)))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows"):
        pixels, depth, visible = renderer.landmarks(away, landmarks)
    assert np.isnan(pixels).all()
    assert depth[0] == pytest.approx(-skull.radius)
    assert not visible.any()
    aside = fr.shifted(fr.Scene(skull), 150.0, 0.0, renderer.size)
    pixels, _, visible = renderer.landmarks(aside, landmarks)
    assert pixels[0, 0] > renderer.size[0]
    assert not visible.any()


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(fr.Camera(), marks=pytest.mark.slow),
        pytest.param(fr.Camera(90.0), marks=pytest.mark.slow),
        pytest.param(fr.Camera(-35.0, 15.0), marks=pytest.mark.slow),
    ],
    ids=("front", "side", "oblique"),
)
def test_visibility_agrees_with_rays(skull, renderer, camera):
    """Of 500 random points, all that rays find visible are visible, except on pixels whose centre
    shows the background; 99 % of the others are hidden, unless a silhouette is within 1.5 pixels.
    """
    scene, surface = fr.Scene(skull, camera), Surface.of(skull)
    points, own = surface.points(500, seed=0)
    matrices = camera_of(scene, renderer.size)
    pixels = by_opencv(points, matrices)
    depth = (points @ matrices[1][:, :3].T + matrices[1][:, 3])[:, 2]
    first, index, _ = surface.hit(pixels, matrices)
    exact = (index == own) | (first >= depth * (1.0 - 1e-9))
    image = renderer.render(scene, only="depth").linear
    view = fr.view_of(scene, 1.0)
    visible = located(view, skull, points, image)[2]
    assert 150 < exact.sum() < 350
    assert visible[exact & covered_at(image, pixels)].all()
    assert not visible[~covered_at(image, pixels)].any()
    turns = np.arange(8) * np.pi / 4.0
    offsets = 1.5 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    around = np.array([first, *(surface.hit(pixels + each, matrices)[0] for each in offsets)])
    pixel = depth / matrices[0][0, 0]
    with np.errstate(invalid="ignore"):
        inner = around.max(axis=0) - around.min(axis=0) < 10.0 * pixel
    assert inner.sum() > 300
    assert (visible == exact)[inner].mean() >= 0.99


def test_hollows_and_slopes(renderer):
    """Points between pixel centres on a steep plane and at the bottom of a valley are visible,
    also at the border of the image; a surface two pixels behind another is hidden."""
    x = np.linspace(-1.0, 1.0, 9)
    size = renderer.size[0]
    cells = np.arange(8)[:, None] * 2
    faces = np.concatenate([cells + (0, 3, 1), cells + (0, 2, 3)])
    flat = fr.Mesh.from_arrays([(a, y, 0.0) for a in x for y in (-1.0, 1.0)], faces)
    for slope, bend in ((0.0, 0.0), (4.0, 0.0), (-4.0, 0.0), (0.0, 1.0)):
        rows = [(a, y, slope * a + bend * abs(a)) for a in x for y in (-1.0, 1.0)]
        mesh = flat.with_positions(rows).with_material(double_sided=True)
        eye = fr.Camera(position=(0.0, 0.0, 30.0), target=(0.0, 0.0, 0.0), fov=3.0)
        scene = fr.Scene(mesh, eye)
        points = np.random.default_rng(2).uniform(-1.0, 1.0, (3000, 3))
        points[:500, 0] *= 0.01  # at the bottom of the valley
        points[:, 2] = slope * points[:, 0] + bend * np.abs(points[:, 0])
        image = renderer.render(scene, only="depth").linear
        view = fr.view_of(scene, 1.0)
        pixels, _, visible = located(view, mesh, points, image)
        inside = ((pixels >= 0) & (pixels < size)).all(axis=1)
        assert 500 < inside.sum() < 3000
        np.testing.assert_array_equal(visible, inside)
        behind = points - (0.0, 0.0, 2.5 * 30.0 / camera_of(scene, (size, size))[0][0, 0])
        if slope == bend == 0.0:
            assert not located(view, mesh, behind, image)[2].any()


@pytest.mark.filterwarnings("ignore:data images and landmarks omit")
def test_pixels_of_visible_landmarks_have_a_depth(renderer, tmp_path):
    """depth.png is 0 where blended parts are clearer than the threshold, and beside silhouettes. No
    landmark on such a pixel is visible, and all others in front are."""
    rng, counts = np.random.default_rng(1), []
    weights = [*rng.dirichlet(np.ones(3), 100).tolist(), [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    points = [
        {"vertices": [0, 1, 2], "weights": weight, "part": part, "name": f"{part}{number}"}
        for part in ("left", "right")
        for number, weight in enumerate(weights)
    ]
    path = written(tmp_path, points)
    for azimuth in np.linspace(0.0, 30.0, 5):
        for alpha in ({}, {"opacity": 0.4}, {"opacity": 0.6}):
            mesh = row("left", "right").with_material("right", **({"alpha": "blend"} | alpha))
            image = fr.ImageSettings(size=renderer.size, samples=1)
            job = fr.Job(camera=fr.Camera(azimuth), image=image, landmarks=str(path))
            drawn = draw(job, mesh, renderer, ("depth",), 0.0, "linear")
            depth = np.asarray(Image.open(BytesIO(drawn.files["depth.png"])))
            found = drawn.details["landmarks"]
            nearest_depth = [depth[int(mark["y"]), int(mark["x"])] for mark in found]
            assert [mark["visible"] for mark in found] == [value > 0 for value in nearest_depth]
            counts.append(sum(mark["visible"] for mark in found))
    assert max(counts[1::3]) <= 102 < min(counts[0::3] + counts[2::3])
    assert min(counts) < 102  # corners lie beside the silhouette


# --- batch ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_records_of_a_batch(skull, renderer, tmp_path):
    (number,) = nearest(skull, nose_of(skull)).vertices[:, 0].tolist()
    (other,) = nearest(skull, nose_of(skull) * (1, 1, -1)).vertices[:, 0].tolist()
    path = written(tmp_path, {"nose": number, "neck": {"vertices": other, "part": "head"}})
    image = fr.ImageSettings(size=renderer.size, samples=1)
    job = fr.Job(camera=fr.Camera(20.0), image=image, landmarks=str(path))
    assert fr.Job.from_dict(job.as_dict()) == job
    assert fr.Job.from_dict(json.loads(json.dumps(job.as_dict()))) == job
    drawn = draw(job, skull, renderer, ("image",), 0.0, "linear")
    assert [*drawn.files] == ["image.png"]
    found = drawn.details["landmarks"]
    pixels, depth, visible = renderer.landmarks(job.scene(skull), fr.load_landmarks(path))
    assert found == [
        {"name": name, "x": x, "y": y, "depth": d, "visible": v}
        for name, (x, y), d, v in zip(
            ("nose", "neck"), pixels.tolist(), depth.tolist(), (True, False), strict=True
        )
    ]
    assert visible.tolist() == [True, False]
    json.dumps(drawn.details, allow_nan=False)
    assert (
        "landmarks"
        not in draw(fr.Job(image=image), skull, renderer, ("image",), 0.0, "linear").details
    )
    tip = skull.parts[0].positions[number]
    away = fr.Camera(position=(*tip[:2], tip[2] + 1.0), target=(*tip[:2], tip[2] + 2.0))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows"):
        drawn = draw(replace(job, camera=away), skull, renderer, ("image", "mask"), 0.0, "linear")
    nose = drawn.details["landmarks"][0]
    assert (nose["x"], nose["y"], nose["visible"]) == (None, None, False)
    json.dumps(drawn.details, allow_nan=False)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*cannot be simplified")
def test_landmarks_of_a_planned_job_count_all_vertices(skull, renderer, tmp_path):
    pytest.importorskip("meshoptimizer")
    from facerender.scene.detail import Planned

    landmarks = nearest(skull, nose_of(skull), nose_of(skull) + (0.25, 0.0, -0.2))
    path = written(tmp_path, landmarks.vertices[:, 0].tolist())
    image = fr.ImageSettings(size=renderer.size, samples=1)
    job = fr.Job(image=image, landmarks=str(path))
    planned = replace(job, planned=Planned((renderer.size,), 1, triangles=6000))
    facts = [
        draw(each, skull, renderer, ("mask",), 0.0, "linear").details for each in (job, planned)
    ]
    assert facts[0]["landmarks"] == facts[1]["landmarks"]
