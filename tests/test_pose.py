"""Tests moving meshes (with_positions, tracked, sequences of vertices), and motion vectors against
rays and projections in float64, for quads, for static surfaces, and in the files of a batch."""

from __future__ import annotations

import gc
import io
import json
import weakref
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh

import facerender as fr
from facerender.batch.outputs import draw
from facerender.commands import main
from facerender.images.files import read_image
from facerender.scene.detail import LevelOfDetail
from facerender.scene.light import light_space
from facerender.scene.view import view_of
from facerender.texture.texture import Texture
from tests.awkward_files import MINI_HEAD
from tests.meshes import with_geometry
from tests.test_alpha import quad
from tests.verification.rays import Surface, by_opencv, camera_of


@pytest.fixture(scope="module")
def head() -> fr.Mesh:
    return fr.load_mesh(MINI_HEAD)


def waved(mesh: fr.Mesh, phase: float = 0.0, size: float = 0.01) -> list[np.ndarray]:
    """Return smoothly displaced positions of each part."""
    step = size * mesh.radius
    return [
        part.positions + step * np.sin(5.0 * part.positions / mesh.radius + phase)
        for part in mesh.parts
    ]


def area_weighted(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return vertex normals, written as loops."""
    sums = np.zeros_like(positions)
    for a, b, c in faces:
        normal = np.cross(positions[b] - positions[a], positions[c] - positions[a])
        for corner in (a, b, c):
            sums[corner] += normal
    return sums / np.linalg.norm(sums, axis=1)[:, None]


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return positions and faces of a sphere that has each vertex once."""
    ball = trimesh.creation.icosphere(2)
    return np.array(ball.vertices), np.array(ball.faces)


class TestWithPositions:
    def test_changes_only_positions_and_normals(self, head):
        moved = head.with_positions(waved(head))
        for part, own, wanted in zip(moved.parts, head.parts, waved(head), strict=True):
            np.testing.assert_array_equal(part.positions, wanted)
            assert part.faces is own.faces
        assert moved.materials == head.materials
        assert moved.geometry is head.geometry
        np.testing.assert_array_equal(moved.bounds, head.bounds)

    def test_computes_area_weighted_normals(self):
        positions, faces = sphere()
        mesh = fr.Mesh.from_arrays(positions, faces)
        moved = positions * (1.0, 1.3, 0.8) + 0.1 * positions**2
        part = mesh.with_positions(moved).parts[0]
        np.testing.assert_allclose(part.normals, area_weighted(moved, part.faces), atol=1e-12)

    def test_normals_agree_across_seams_and_parts(self):
        positions, faces = sphere()
        uv, uv_faces = np.random.default_rng(1).random((3 * len(faces), 2)), None
        uv_faces = np.arange(3 * len(faces)).reshape(-1, 3)
        mesh = fr.Mesh.from_arrays(positions, faces, uv=uv, uv_faces=uv_faces)
        assert len(mesh.parts[0].positions) == 3 * len(faces)
        moved = positions * (1.0, 1.5, 1.0)
        part = mesh.with_positions(moved).parts[0]
        np.testing.assert_array_equal(part.positions, moved[part.sources])
        np.testing.assert_allclose(
            part.normals, area_weighted(moved, faces)[part.sources], atol=1e-12
        )

    def test_creases_remain(self):
        """Two walls share positions, but not normals, so that moving keeps the edge sharp."""
        wall = np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], dtype=float)
        roof = np.array([(0, 1, 1), (1, 1, 1), (1, 1, 0), (0, 1, 0)], dtype=float)
        positions = np.concatenate([wall, roof])
        normals = np.repeat([(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)], 4, axis=0)
        faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
        mesh = fr.Mesh.from_arrays(positions, faces, normals=normals)
        part = mesh.with_positions(positions * 2.0).parts[0]
        np.testing.assert_allclose(part.normals, normals, atol=1e-12)

    def test_given_normals_are_normalised(self, head):
        normals = [3.0 * part.normals for part in head.parts]
        moved = head.with_positions(waved(head), normals)
        for part, own in zip(moved.parts, head.parts, strict=True):
            np.testing.assert_allclose(part.normals, own.normals, atol=1e-12)

    def test_accepts_one_array_for_all_parts_and_a_mapping(self):
        parts = fr.load_mesh(None)
        whole = np.concatenate(waved(parts))
        by_list, by_array = parts.with_positions(waved(parts)), parts.with_positions(whole)
        for a, b in zip(by_list.parts, by_array.parts, strict=True):
            np.testing.assert_array_equal(a.positions, b.positions)
        name = parts.parts[1].name
        only = parts.with_positions({name: parts.parts[1].positions + 0.001})
        assert only.parts[0] is parts.parts[0]
        assert only.geometry is parts.geometry

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda p: p[:-1], "rows: give"),
            (lambda p: p[:, :2], "give rows of 3"),
            (lambda p: np.where(p > 0, np.nan, p), "not finite"),
            (lambda p: p * 1e9, "mesh radii"),
            (lambda p: [p, p], "arrays: give 1"),
            (lambda p: {"nose": p}, "no part"),
            (lambda p: "abc", "give rows"),
        ],
    )
    def test_refuses_other_shapes_and_values(self, head, change, words):
        positions = head.parts[0].positions
        with pytest.raises(fr.InputError, match=words) as error:
            head.with_positions(change(positions))
        assert "\n" not in str(error.value)

    def test_baked_occlusion_causes_a_warning(self, head):
        baked = with_geometry(
            head, parts=tuple(replace(p, occlusion=np.ones(len(p.positions))) for p in head.parts)
        )
        with pytest.warns(fr.FacerenderWarning, match="baked occlusion"):
            baked.with_positions(waved(head))

    @pytest.mark.slow
    def test_poses_do_not_keep_each_other_alive(self, head, egl):
        with fr.Renderer((64, 64), samples=1, backend=egl) as renderer:
            scenes = [fr.Scene(head.with_positions(waved(head, i))) for i in range(3)]
            for scene in scenes:
                renderer.render(scene)
            alive = [weakref.ref(scene.mesh.parts[0]) for scene in scenes]
            del scenes, scene
            gc.collect()
            assert sum(each() is not None for each in alive) == 0


class TestDrawing:
    @pytest.mark.first_case
    @pytest.mark.parametrize("deferred", [True, False])
    def test_a_pose_is_drawn_like_a_mesh_with_these_positions(
        self, head, egl, deferred, monkeypatch
    ):
        """Also after other poses, which share the vertex buffers."""
        monkeypatch.setattr(
            "facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred
        )
        moved = head.with_positions(waved(head))
        geometry = replace(head.geometry, parts=moved.parts, known_framing=head.geometry.framing)
        alone = fr.Mesh(geometry, head.materials)
        with fr.Renderer((128, 128), samples=1, backend=egl) as renderer:
            first = renderer.render(fr.Scene(head)).linear
            renderer.render(fr.Scene(head.with_positions(waved(head, 1.0))))
            got = renderer.render(fr.Scene(moved)).linear
            again = renderer.render(fr.Scene(head)).linear
            wanted = renderer.render(fr.Scene(alone)).linear
        np.testing.assert_array_equal(got, wanted)
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - got).max() > 0.01

    def test_the_camera_stays_and_can_follow(self, head):
        step = np.array([0.3, 0.1, 0.0]) * head.radius
        moved = head.with_positions([part.positions + step for part in head.parts])
        still, kept, followed = (
            view_of(fr.Scene(mesh, fr.Camera(frame="face")), 1.0).extrinsics(mesh)
            for mesh in (head, moved, fr.tracked(moved))
        )
        np.testing.assert_allclose(kept, still, atol=1e-9)
        np.testing.assert_allclose(followed[:, :3], still[:, :3], atol=1e-12)
        np.testing.assert_allclose(followed[:, 3], still[:, 3] - still[:, :3] @ step, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("frame", ["all", "face"])
    def test_crown_and_ears_stay_while_the_jaw_opens(self, egl, frame):
        """The mask above the mouth is the same in every pixel."""
        mesh = fr.load_mesh()
        with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
            masks = [
                renderer.render(fr.Scene(own, fr.Camera(20.0, frame=frame)), only="mask").linear
                for own in (mesh, mesh.with_pose({"jawOpen": 1.0}))
            ]
        still, opened = (mask[..., 0] for mask in masks)
        np.testing.assert_array_equal(still[:256], opened[:256])
        assert (still[256:] != opened[256:]).sum() > 100

    def test_far_vertices_are_neither_clipped_nor_change_the_framing(self, head):
        """The range of depths and the shadow maps cover all vertices."""
        moved = head.with_positions([part.positions * (1.0, 1.0, 3.0) for part in head.parts])
        assert moved.radius == head.radius
        scene = fr.Scene(moved, fr.Camera(90.0))
        spaces = [light_space(light, moved.space).matrix for light in scene.lights]
        for part in moved.parts:
            points = np.column_stack(
                [moved.normalised(part.positions), np.ones(len(part.positions))]
            )
            clip = points @ view_of(scene, 1.0).matrix
            assert (np.abs(clip[:, 2]) <= clip[:, 3] * (1.0 + 1e-9)).all()
            assert all(np.abs(points @ space).max() <= 1.0 + 1e-9 for space in spaces)
        for frame in ("all", "head", "face"):
            a, b = (
                view_of(fr.Scene(mesh, fr.Camera(frame=frame)), 1.0).extrinsics(mesh)
                for mesh in (head, moved)
            )
            np.testing.assert_allclose(a, b, atol=1e-9 * head.radius)

    def test_a_level_of_detail_keeps_its_triangles(self, head):
        pytest.importorskip("meshoptimizer")
        coarse = fr.simplified(head, 500)
        moved = fr.simplified(head.with_positions(waved(head)), 500)
        for part, own in zip(moved.parts, coarse.parts, strict=True):
            assert part.faces is own.faces
            distance = np.linalg.norm(part.positions - own.positions, axis=1)
            assert 0.0 < distance.max() < 0.02 * head.radius * np.sqrt(3.0)


class TestSources:
    def test_an_obj_file_takes_the_vertices_of_the_file(self, tmp_path):
        positions, faces = sphere()
        uv = np.random.default_rng(2).random((3 * len(faces), 2))
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in positions.tolist()]
        lines += [f"vt {u!r} {v!r}" for u, v in uv.tolist()]
        lines += [
            "f " + " ".join(f"{corner + 1}/{3 * row + k + 1}" for k, corner in enumerate(face))
            for row, face in enumerate(faces.tolist())
        ]
        file = tmp_path / "sphere.obj"
        file.write_text("\n".join(lines))
        mesh = fr.load_mesh(file)
        (part,) = mesh.parts
        assert part.source_count == len(positions) < len(part.positions)
        np.testing.assert_array_equal(positions[part.sources], part.positions)
        moved = mesh.with_positions(2.0 * positions)
        np.testing.assert_array_equal(moved.parts[0].positions, 2.0 * part.positions)

    def test_coincident_vertices_are_told_apart_by_the_faces(self, tmp_path):
        """Closed lips: the two sides of a slit have equal positions until the mouth opens."""
        text = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 0", "v 1 0 0", "v 0 -1 0"]
        text += ["v 0 2 0", "vt 0 0", "vt 1 0", "vt 0 1"]
        text += ["f 1/1 2/2 3/3", "f 5/2 4/1 6/3", "f 3/1 2/1 7/2"]
        file = tmp_path / "lips.obj"
        file.write_text("\n".join(text))
        (part,) = fr.load_mesh(file).parts
        assert part.sources is not None
        faces = [set(part.sources[face].tolist()) for face in part.faces]
        assert {3, 4, 5} in faces
        assert {0, 1, 2} in faces

    @pytest.mark.parametrize(
        ("values", "words"),
        [
            ({"uv_faces": [[0, 1, 2]]}, "without uv"),
            ({"uv": [[0, 0]] * 3, "uv_faces": [[0, 1, 3]]}, "uv_faces use row 3 of 3"),
            ({"uv": [[0, 0]] * 3, "uv_faces": [[0, 1, 2]] * 2}, "has 2 rows: give 1"),
        ],
    )
    def test_invalid_uv_faces(self, values, words):
        with pytest.raises(fr.InputError, match=words):
            fr.Mesh.from_arrays(np.eye(3), [[0, 1, 2]], **values)


@pytest.fixture(scope="module")
def frames(head, tmp_path_factory) -> str:
    """A file with four frames of vertices."""
    file = tmp_path_factory.mktemp("frames") / "frames.npy"
    np.save(file, np.stack([np.concatenate(waved(head, i)) for i in range(4)]))
    return str(file)


class TestSequences:
    def test_a_job_draws_a_frame_of_vertices(self, head, frames):
        job = fr.Job(fr.MeshFile(str(MINI_HEAD)), pose=fr.Pose(vertices=frames, frame=2))
        again = fr.Job.from_dict(json.loads(json.dumps(job.as_dict())))
        assert again == job
        (part,) = again.scene().mesh.parts
        np.testing.assert_array_equal(part.positions, waved(head, 2)[0])

    @pytest.mark.slow
    def test_the_command_draws_one_frame_or_all(self, frames, tmp_path):
        base = ["render", str(MINI_HEAD), "--size", "64", "--samples", "1", "--quiet"]
        assert main([*base, "--vertices", frames, "-o", f"{tmp_path}/f-{{index}}.png"]) == 0
        assert len([*tmp_path.glob("f-*.png")]) == 4
        assert main([*base, "--vertices", f"{frames},2", "-o", f"{tmp_path}/one.png"]) == 0
        one, other, same = (read_image(tmp_path / f"{n}.png") for n in ("one", "f-001", "f-002"))
        np.testing.assert_array_equal(one.pixels, same.pixels)
        assert (one.pixels != other.pixels).any()

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (["-o", "one.png"], "holds one image"),
            (["-o", "a.gif", "--camera", "front", "--camera", "profile"], "one view"),
            (["-o", "a.gif", "--budget", "1/255"], "plans one view"),
        ],
    )
    def test_sequences_need_a_fitting_output(
        self, frames, options, words, tmp_path, monkeypatch, capsys
    ):
        monkeypatch.chdir(tmp_path)
        assert main(["render", str(MINI_HEAD), "--vertices", frames, *options]) == 2
        assert words in capsys.readouterr().err
        assert not [*tmp_path.iterdir()]

    @pytest.mark.parametrize(
        ("name", "content", "words"),
        [
            ("f.npy", b"no", "damaged"),
            ("f.txt", b"1 2 3", "unknown vertices format"),
            ("f.npy", np.zeros((2, 3)), "shape"),
            ("f.npy", np.zeros((0, 4, 3)), "0"),
            ("f.npy", np.zeros((1, 4, 3)), "rows: give"),
            ("f.npy", "all", "not finite"),
        ],
    )
    def test_damaged_files_of_vertices(self, tmp_path, head, name, content, words):
        file = tmp_path / name
        if isinstance(content, bytes):
            file.write_bytes(content)
        else:
            every = np.full((1, len(head.parts[0].positions), 3), np.nan)
            np.save(file, every if isinstance(content, str) else content)
        job = fr.Job(fr.MeshFile(str(MINI_HEAD)), pose=fr.Pose(vertices=str(file)))
        with pytest.raises(fr.InputError, match=words) as error:
            job.scene()
        assert "\n" not in str(error.value)


# --- motion ---------------------------------------------------------------------------------------


SIZE = (256, 192)
CAMERAS = fr.Camera(22.0, 6.0, zoom=1.1), fr.Camera(18.0, 5.0, zoom=1.08)  # this frame, before


@pytest.fixture(scope="module")
def drawing(backend):
    with fr.Renderer(SIZE, samples=1, backend=backend) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def skull():
    return fr.load_mesh()


def bent(mesh: fr.Mesh, amount: float) -> fr.Mesh:
    """Return the mesh bent and twisted smoothly."""
    places = mesh.normalised(np.concatenate([part.positions for part in mesh.parts]))
    x, y, z = places.T
    moved = places + amount * np.stack([np.sin(3.0 * y), np.cos(2.0 * x) * z, x * y], axis=1)
    return mesh.with_positions(mesh.to_mesh_space(moved))


def moved_away(mesh: fr.Mesh) -> fr.Mesh:
    """Return the mesh in millimetres, far from the origin."""
    offset = np.array([4e5, -2e4, 7e5])
    parts = [replace(part, positions=part.positions * 1e3 + offset) for part in mesh.parts]
    return fr.Mesh.of(mesh.name, parts, mesh.materials)


@pytest.mark.slow
def test_motion_agrees_with_rays_in_float64(skull, drawing):
    now, before = (bent(skull, amount) for amount in (0.05, -0.02))
    scene = fr.Scene(now, CAMERAS[0], before=fr.Scene(before, CAMERAS[1]))
    image = drawing.render(scene, only="motion").linear
    np.testing.assert_array_equal(
        image[..., 3] > 0.0, drawing.render(scene, only="mask").linear[..., 0] > 0.0
    )
    assert not image[..., 2].any()
    rows, columns = np.nonzero(image[..., 3])
    chosen = np.random.default_rng(0).choice(len(rows), 2000, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    centres = np.stack([columns, rows], axis=1) + 0.5
    motion = image[rows, columns, :2].astype(np.float64)

    camera, old_camera = camera_of(scene, SIZE), camera_of(scene.before, SIZE)
    surface, old_surface = Surface.of(now), Surface.of(before)
    _, index, weights = surface.hit(centres, camera)
    then = by_opencv(np.einsum("nij,ni->nj", old_surface.corners[index], weights), old_camera)
    error = np.abs(motion - (centres - then)).max(axis=1)
    assert np.hypot(*motion.T).max() > 5.0
    # At edges between two triangles the driver may see the other triangle, which is nearly the same
    # point; only at silhouettes the points are different.
    assert (error < 1e-4).mean() > 0.99
    assert np.quantile(error, 0.995) < 0.01

    # The frame before shows the same surface points at the pixels moved back, unless it hides them.
    _, old_index, old_weights = old_surface.hit(centres - motion, old_camera)
    rest = Surface.of(skull).corners
    points, old_points = (
        np.einsum("nij,ni->nj", rest[i], w) for i, w in ((index, weights), (old_index, old_weights))
    )
    pixel = 2.0 * skull.radius / SIZE[1]
    apart = np.linalg.norm(points - old_points, axis=1) / pixel
    hidden = apart > 5.0
    assert np.median(apart[~hidden]) < 0.01
    assert (apart[~hidden] < 0.1).mean() > 0.99
    assert hidden.sum() >= 5
    assert error[hidden].max() < 0.01  # hidden points have their own motion too


@pytest.mark.slow
@pytest.mark.parametrize("place", [lambda mesh: mesh, moved_away], ids=["near", "far"])
def test_static_surfaces_have_no_motion(skull, drawing, place):
    mesh = place(skull)
    camera = fr.Camera(20.0, 10.0)
    for before in (mesh, mesh.with_skin(m=0.3)):
        scene = fr.Scene(mesh, camera, before=fr.Scene(before, camera))
        image = drawing.render(scene, only="motion").linear
        assert image[..., 3].sum() > 5000
        assert not image[..., :3].any()
        assert not np.signbit(image).any()
    # The moved vertices enlarge the sphere around the mesh, which the range of depths covers.
    positions = [part.positions.copy() for part in mesh.parts]
    eyes = next(i for i, part in enumerate(mesh.parts) if part.name == "eyeballs")
    positions[eyes][:, 2] += mesh.radius
    posed = mesh.with_positions(positions)
    assert posed.space.reach > 1.0
    scene = fr.Scene(posed, camera, before=fr.Scene(mesh, camera))
    image = drawing.render(scene, only="motion").linear
    part = drawing.render(scene, only="parts").linear[..., 0]
    assert (part == eyes + 1).any()
    assert (np.hypot(*np.moveaxis(image[part == eyes + 1, :2], -1, 0)) > 1.0).all()
    others = (part > 0) & (part != eyes + 1)
    assert others.sum() > 5000
    assert not image[others, :2].any()


def card(material: fr.Material = fr.Material(), z: float = 0.0) -> fr.Mesh:
    return fr.Mesh.of("card", [quad(z)], [material])


def looking(z: float = 4.0, x: float = 0.0) -> fr.Camera:
    return fr.Camera(position=(x, 0.0, z), target=(x, 0.0, 0.0), fov=40.0)


def test_motion_of_a_quad_is_exact(drawing):
    plane = card()
    (part,) = plane.parts
    step = np.array([0.125, -0.0625, 0.0])
    moved = plane.with_positions(part.positions + step)
    focal = camera_of(fr.Scene(plane, looking()), SIZE)[0][0, 0]
    for now, then, cameras in (
        (moved, plane, (looking(), looking())),
        (plane, plane, (looking(), looking(x=0.125))),
    ):
        scene = fr.Scene(now, cameras[0], before=fr.Scene(then, cameras[1]))
        image = drawing.render(scene, only="motion").linear
        shown = image[..., 3] > 0.0
        assert shown.sum() > 3000
        expected = step[0] * focal / 4.0, (now is moved) * -step[1] * focal / 4.0
        np.testing.assert_allclose(image[shown, :2], [expected] * shown.sum(), atol=1e-5)
    turned = plane.with_positions(part.positions[:, [1, 0, 2]] * (-1, 1, 1))  # 90 degrees
    image = drawing.render(
        fr.Scene(turned, looking(), before=fr.Scene(plane, looking())), only="motion"
    ).linear
    y, x = np.nonzero(image[..., 3])
    x, y = x + 0.5 - SIZE[0] / 2, y + 0.5 - SIZE[1] / 2
    expected = np.stack([x + y, y - x], axis=1)  # before: (-y, x)
    np.testing.assert_allclose(image[image[..., 3] > 0, :2], expected, atol=1e-4)


@pytest.mark.parametrize("second", [False, True])
def test_masks_and_second_coordinates(drawing, second):
    half = np.zeros((8, 8, 3), np.uint8)
    half[:, 4:] = 255
    mask = fr.Material(
        alpha="mask",
        opacity_map=Texture.from_array(half).sampled(("clamp", "clamp"), nearest=True),
        second_uv=("opacity_map",) if second else (),
    )
    back, front = card(z=-0.5), card(mask, z=0.5)
    if second:
        (part,) = front.parts
        front = with_geometry(front, parts=(replace(part, uv=1.0 - part.uv, uv2=part.uv),))
    mesh = fr.Mesh.of("cards", [*back.parts, *front.parts], [*back.materials, *front.materials])
    moved = mesh.with_positions([None, mesh.parts[1].positions + (0.1, 0.0, 0.0)])
    scene = fr.Scene(moved, looking(), before=fr.Scene(mesh, looking()))
    image = drawing.render(scene, only="motion").linear
    part = drawing.gbuffer(scene).part
    np.testing.assert_array_equal(image[..., 0] > 0.0, part == 1)
    assert {*np.unique(part)} == {-1, 0, 1}
    focal = camera_of(scene, SIZE)[0][0, 0]
    np.testing.assert_allclose(image[part == 1, 0], 0.1 * focal / 3.5, atol=1e-5)
    assert not image[part == 0, :2].any()


def test_points_behind_the_earlier_camera_have_no_motion(drawing):
    plane = card()
    away = fr.Camera(position=(0.0, 0.0, 0.5), target=(0.0, 0.0, 2.0))
    scene = fr.Scene(plane, looking(), before=fr.Scene(plane, away))
    with pytest.warns(fr.FacerenderWarning, match="no pixel shows"):
        assert not drawing.render(scene, only="motion").linear.any()


def test_the_frame_before_is_checked(skull, drawing):
    with pytest.raises(fr.InputError, match="^motion of head.glb needs the frame before: give "):
        drawing.render(fr.Scene(skull), only="motion")
    for other in (skull.select(hide="cornea"), card()):
        with pytest.raises(fr.InputError, match="have different triangles: give two poses of one"):
            drawing.render(fr.Scene(skull, before=fr.Scene(other)), only="motion")


def test_levels_of_detail_simplify_both_frames(skull, drawing):
    pytest.importorskip("meshoptimizer")
    scene = fr.Scene(bent(skull, 0.05), before=fr.Scene(bent(skull, 0.0)))
    coarse = LevelOfDetail(1, 5000).of(scene)
    assert sum(len(part.faces) for part in coarse.before.mesh.parts) <= 5000
    images = [drawing.render(each, only="motion").linear for each in (scene, coarse)]
    both = (images[0][..., 3] > 0.0) & (images[1][..., 3] > 0.0)
    assert np.median(np.abs(images[0] - images[1])[both]) < 0.05


def test_colours_show_direction_and_length():
    linear = np.zeros((1, 4, 4), np.float32)
    linear[0, :, :2] = [(2.0, 0.0), (-1.0, 0.0), (0.0, 0.0), (0.0, 1.0)]
    linear[..., 3] = 1.0
    pixels = fr.Frame(linear, "motion", False, {}).srgb8()
    expected = [[255, 0, 0], [0, 127.5, 127.5], [0, 0, 0], [63.75, 127.5, 0]]
    np.testing.assert_allclose(pixels[0], expected, atol=0.51)


@pytest.mark.slow
def test_files_of_a_batch(skull, drawing, monkeypatch):
    now, before = (bent(skull, amount) for amount in (0.05, -0.02))
    scene = fr.Scene(now, CAMERAS[0], before=fr.Scene(before, CAMERAS[1]))
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: scene)
    job = fr.Job(image=fr.ImageSettings(size=SIZE, samples=1))
    drawn = draw(job, now, drawing, ("motion", "mask", "layers"), 0.0, "linear")
    exact = drawing.render(scene, only="motion").linear
    content = np.frombuffer(drawn.files["motion.png"], np.uint8)
    valid, y, x = np.moveaxis(cv2.imdecode(content, cv2.IMREAD_UNCHANGED), -1, 0)  # BGR
    assert valid.dtype == np.uint16
    np.testing.assert_array_equal(valid, exact[..., 3])
    for steps, axis in ((x, 0), (y, 1)):
        decoded = (steps.astype(np.float64) - 2**15) / 64.0
        assert np.abs(decoded - exact[..., axis])[valid > 0].max() <= 0.5 / 64.0 + 1e-6
        assert not steps[valid == 0].any()
    with OpenEXR.File(io.BytesIO(drawn.files["layers.exr"]), separate_channels=True) as file:
        for name, axis in (("motion.X", 0), ("motion.Y", 1)):
            np.testing.assert_array_equal(file.channels()[name].pixels, exact[..., axis])
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: replace(scene, before=None))
    with pytest.raises(fr.InputError, match="motion of head.glb needs the frame before"):
        draw(job, now, drawing, ("motion",), 0.0, "linear")


def test_motion_beyond_the_range_of_a_png_is_not_valid(drawing, monkeypatch):
    plane = card()
    (part,) = plane.parts
    near = replace(looking(), fov=1.0)  # 1 unit is 2750 pixels
    moved = plane.with_positions(part.positions + (0.25, 0.01, 0.0))
    scene = fr.Scene(moved, near, before=fr.Scene(plane, near))
    monkeypatch.setattr(fr.Job, "scene", lambda self, *_: scene)
    job = fr.Job(image=fr.ImageSettings(size=SIZE, samples=1))
    content = draw(job, moved, drawing, ("motion",), 0.0, "linear").files["motion.png"]
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    valid, y, x = np.moveaxis(pixels, -1, 0)
    assert (x == 65535).all()
    assert ((y > 0) & (y < 2**15)).all()
    assert not valid.any()
