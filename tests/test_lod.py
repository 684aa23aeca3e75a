"""Tests mesh simplification (``facerender.simplified``): preserved properties, warnings, and the
error of the image; and occlusion baked at vertices: against geometry, rays and float64 shading."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import facerender as fr
from facerender.drawing import reference
from facerender.mesh import occlusion
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part
from facerender.planning.plan import _digest
from tests.awkward_files import MINI_HEAD
from tests.meshes import with_geometry
from tests.test_cli import Cli
from tests.verification.lights import PLAIN, PLAIN_THREE
from tests.verification.occlusion import occlusion_error

Ints = NDArray[np.int64]


def mesh_of(*parts):
    points = np.concatenate([part.positions for part in parts])
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    radius = float(np.linalg.norm(points - bounds.mean(axis=0), axis=1).max())
    materials = tuple(fr.Material(m=0.2 + 0.1 * index) for index in range(len(parts)))
    return fr.Mesh(Geometry("made.glb", parts, bounds, radius, np.array([[1.0, 0.0]])), materials)


def grid(rows, columns):
    """Return the faces of a grid of (rows + 1) x (columns + 1) vertices."""
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    quads = [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
    return np.concatenate(quads).reshape(-1, 3).astype(np.uint32)


RING, TUBE = 96, 32


def on_torus(uv):
    """Return positions and normals at u around the ring and v around the tube."""
    around, over = 2.0 * np.pi * (uv % 1.0).T
    outwards = np.stack([np.cos(around), np.zeros_like(around), -np.sin(around)], axis=1)
    normals = np.cos(over)[:, None] * outwards + np.sin(over)[:, None] * np.array([0.0, 1.0, 0.0])
    return outwards + 0.4 * normals, normals


def torus():
    """Return a closed torus with seams of the texture coordinates in both directions."""
    u, v = np.meshgrid(np.linspace(0, 1, RING + 1), np.linspace(0, 1, TUBE + 1), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    return Part(*on_torus(uv), grid(RING, TUBE), uv)


def welded(mesh):
    """Return the distinct positions of all parts, and faces that index them."""
    points = np.concatenate([part.positions for part in mesh.parts])
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    places, numbers = np.unique(points, axis=0, return_inverse=True)
    return places, numbers.reshape(-1)[np.concatenate(faces)]


def open_edges(mesh):
    """Return the end points of edges that only one face has, (E, 2, 3)."""
    places, faces = welded(mesh)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(pairs, axis=0, return_counts=True)
    return places[edges[counts == 1]]


def count(mesh):
    return sum(len(part.faces) for part in mesh.parts)


def in_two(mesh, height):
    """Split a mesh at a height into two parts with separate vertices and materials."""
    (part,) = mesh.parts
    below = part.positions[part.faces][:, :, 1].mean(axis=1) < height
    parts = []
    for faces in (part.faces[below], part.faces[~below]):
        used, numbers = np.unique(faces, return_inverse=True)
        own = (part.positions[used], part.normals[used], numbers.reshape(-1, 3).astype(np.uint32))
        parts.append(Part(*own, part.uv[used]))
    materials = (mesh.materials[0], replace(mesh.materials[0], ks=0.5))
    return with_geometry(mesh, parts=tuple(parts), materials=materials)


def test_closed_mesh_stays_closed_with_its_maps_in_place():
    whole = mesh_of(torus())
    assert not len(open_edges(whole))
    level = fr.simplified(whole, 1200)
    (part,) = level.parts
    assert 1150 <= len(part.faces) <= 1200
    assert not len(open_edges(level))
    assert part.uv.min() >= 0.0
    assert part.uv.max() <= 1.0
    assert np.ptp(part.uv[part.faces], axis=1).max() < 0.25, "a face reaches over a seam"
    places, normals = on_torus(part.uv)
    assert np.linalg.norm(places - part.positions, axis=1).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, rtol=1e-12)
    assert (normals * part.normals).sum(axis=1).min() > 0.99
    _, seams = np.unique(part.positions, axis=0, return_inverse=True)
    assert (
        len(np.unique(np.column_stack([seams.reshape(-1), part.normals]), axis=0)) == max(seams) + 1
    )


def test_open_borders_stay_where_they_are(head):
    before, after = open_edges(head), open_edges(fr.simplified(head, 16_000))
    assert 0 < len(after) < len(before)
    gaps = np.linalg.norm(after.reshape(-1, 1, 3) - before.reshape(1, -1, 3), axis=-1).min(axis=1)
    assert gaps.max() < 0.01 * head.radius
    ends = [
        np.concatenate([edges.min(axis=(0, 1)), edges.max(axis=(0, 1))])
        for edges in (before, after)
    ]
    np.testing.assert_allclose(*ends, atol=0.005 * head.radius)


def test_parts_keep_their_borders_materials_and_number(head):
    whole = in_two(head, 0.0)
    level = fr.simplified(whole, 16_000)
    assert count(level) <= 16_000
    assert level.materials == whole.materials
    assert [part.uv is None for part in level.parts] == [False, False]
    assert min(len(part.faces) for part in level.parts) > 2000
    gaps = open_edges(level).reshape(-1, 1, 3) - open_edges(whole).reshape(1, -1, 3)
    assert np.linalg.norm(gaps, axis=-1).min(axis=1).max() < 0.01 * head.radius, "a crack"


def test_a_camera_sees_the_same_mesh(head):
    level = fr.simplified(head, 8000)
    assert (level.name, level.radius) == (head.name, head.radius)
    assert level.bounds is head.bounds
    assert level.profile is head.profile
    reach = np.linalg.norm(level.normalised(level.parts[0].positions), axis=1)
    assert reach.max() <= 1.0 + 1e-12, "a near plane cuts it"


def test_the_same_arguments_give_the_same_mesh(head):
    assert fr.simplified(head, 8000).geometry is fr.simplified(head, 8000).geometry
    assert fr.simplified(head, 8000).geometry is not fr.simplified(head, 9000).geometry
    again = fr.simplified(fr.load_mesh().select("head"), 8000)
    for name in ("positions", "normals", "faces", "uv"):
        np.testing.assert_array_equal(
            getattr(fr.simplified(head, 8000).parts[0], name), getattr(again.parts[0], name)
        )


@pytest.mark.parametrize("more", [0, 1, 10**9])
def test_mesh_with_few_triangles_is_returned_unchanged(more):
    whole = mesh_of(torus())
    assert fr.simplified(whole, count(whole) + more) is whole


@pytest.mark.filterwarnings("ignore:no pixel shows made.glb")  # the remaining faces may be flat
def test_too_few_triangles_warn_and_every_part_keeps_one(renderer):
    small = replace(torus(), positions=0.01 * torus().positions)
    whole = mesh_of(torus(), small)
    with pytest.warns(
        fr.FacerenderWarning, match=r"made.glb cannot be .* to 1 triangles: \d+ remain"
    ):
        level = fr.simplified(whole, 1)
    assert all(len(part.faces) for part in level.parts)
    assert count(level) < 300
    assert np.isfinite(renderer.render(fr.Scene(level)).linear).all()


def awkward_parts():
    whole = torus()
    colors = 0.5 + 0.5 * np.cos(7.0 * whole.positions)
    folded = np.concatenate([whole.faces, whole.faces[:50, [0, 0, 1]], whole.faces[:50]])
    alone = Part(np.eye(3), np.eye(3), np.array([[0, 1, 2]], dtype=np.uint32))
    return {
        "no texture coordinates": (replace(whole, uv=None),),
        "all on one texel": (replace(whole, uv=np.full_like(whole.uv, 0.25)),),
        "colours": (replace(whole, colors=colors),),
        "degenerate and doubled faces": (replace(whole, faces=folded.astype(np.uint32)),),
        "a part of one face": (whole, alone),
        "far and large": (replace(whole, positions=1e6 * whole.positions + 1e8),),
        "triangles alone": (
            Part(
                whole.positions[whole.faces].reshape(-1, 3),
                whole.normals[whole.faces].reshape(-1, 3),
                np.arange(whole.faces.size, dtype=np.uint32).reshape(-1, 3),
            ),
        ),
    }


@pytest.mark.parametrize("name", awkward_parts())
def test_awkward_meshes(name):
    whole = mesh_of(*awkward_parts()[name])
    level = fr.simplified(whole, 2000)
    assert 1900 < count(level) <= 2000
    for part, old in zip(level.parts, whole.parts, strict=True):
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, rtol=1e-12)
        assert part.faces.max() == len(part.positions) - 1
        off = np.linalg.norm(whole.normalised(part.positions[:, None]), axis=-1)
        assert off.max() <= 1.0 + 1e-9
        for values, before in ((part.uv, old.uv), (part.colors, old.colors)):
            assert (values is None) == (before is None)
            if before is not None:
                assert values.min() >= before.min()
                assert values.max() <= before.max()


@pytest.mark.parametrize("value", [0, -5, 1.5, True, "8", None])
def test_invalid_number_of_triangles_is_refused(value):
    with pytest.raises(fr.InputError, match=rf"triangles = {value!r}: give a whole number"):
        fr.simplified(mesh_of(torus()), value)


def test_missing_meshoptimizer_is_reported_with_a_remedy(no_meshoptimizer):
    with pytest.raises(fr.InputError, match=r"meshoptimizer; pip install 'facerender\[lod\]'"):
        fr.simplified(mesh_of(torus()), 100)


@pytest.mark.parametrize(("triangles", "share", "median"), [(50_000, 1.0, 0), (16_000, 15.5, 1)])
def test_image_changes_little(head, renderer, triangles, share, median):
    """``share`` limits the percentage of covered pixels that change by more than one level."""
    exact, level = (
        renderer.render(fr.Scene(mesh, fr.Camera(azimuth=-35), PLAIN_THREE))
        for mesh in (head, fr.simplified(head, triangles))
    )
    covered = (exact.linear[..., 3] > 0.0) | (level.linear[..., 3] > 0.0)
    steps = np.abs(exact.srgb8().astype(int) - level.srgb8())[covered].max(axis=-1)
    assert 100.0 * (steps > 1).mean() < share
    assert np.median(steps) <= median


def test_a_mesh_file_is_simplified_as_it_is_read():
    whole = fr.MeshFile(str(MINI_HEAD)).load()
    few = count(whole) // 2
    level = fr.MeshFile(str(MINI_HEAD), triangles=few).load()
    np.testing.assert_array_equal(level.parts[0].faces, fr.simplified(whole, few).parts[0].faces)
    assert count(level) <= few


# --- occlusion ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bare():
    """A small head without an occlusion map."""
    mesh = fr.load_mesh(MINI_HEAD)
    assert mesh.materials[0].occlusion_map is None
    return mesh


@pytest.fixture(scope="module")
def whole_head():
    """The built-in head with its eyes: the skin alone is open there."""
    return fr.load_mesh()


@pytest.fixture(scope="module")
def baked(bare):
    return fr.with_occlusion(bare)


def strip(across, up, normal):
    """Return a band along z through the points (x, y)."""
    places = [(x, y, z) for x, y in zip(across, up, strict=True) for z in np.linspace(-60, 60, 41)]
    normals = np.tile(np.array(normal, dtype=float), (len(places), 1))
    return Part(np.array(places, dtype=float), normals, grid(len(across) - 1, 40))


@pytest.mark.parametrize("turned", [False, True])
def test_occlusion_at_a_wall_agrees_with_geometry(turned):
    """At distance d from an infinitely long wall of height h, the hidden fraction is
    (1 - d / sqrt(d^2 + h^2)) / 2, also at d = 0, where floor and wall share vertices."""
    across, up = np.array([0.0, 0.2, 0.5, 1.0, 3.0]), np.array([0.0, 0.5, 1.0])
    mesh = mesh_of(strip(across, 0.0 * across, (0, 1, 0)), strip(0.0 * up, up, (1, 0, 0)))
    if turned:  # the result must not depend on the axes
        turn, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
        mesh = mesh_of(
            *(
                replace(p, positions=p.positions @ turn, normals=p.normals @ turn)
                for p in mesh.parts
            )
        )
    floor, wall = (part.occlusion.reshape(-1, 41)[:, 20] for part in fr.with_occlusion(mesh).parts)
    np.testing.assert_allclose(floor, 1.0 - 0.5 * (1.0 - across / np.hypot(across, 1.0)), atol=0.02)
    hidden = 0.5 * (1.0 - up / np.hypot(up, 3.0))
    np.testing.assert_allclose(wall, 1.0 - hidden, atol=0.02)


def test_occlusion_in_a_hemisphere_is_half():
    """Seen from any point on a sphere, a part of it hides its fraction of the sphere's area."""
    around, over = np.meshgrid(np.linspace(0, 2 * np.pi, 129), np.linspace(0, np.pi / 2, 49)[1:])
    outwards = np.stack(
        [np.sin(over) * np.cos(around), -np.cos(over), np.sin(over) * np.sin(around)], axis=-1
    ).reshape(-1, 3)
    faces = np.concatenate([grid(47, 128), [[0, 128, 64]]]).astype(np.uint32)
    part = fr.with_occlusion(mesh_of(Part(outwards, -outwards, faces))).parts[0]
    inside = outwards[:, 1] < -0.05
    assert np.abs(part.occlusion[inside] - 0.5).max() < 0.03
    assert abs(part.occlusion[inside].mean() - 0.5) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bound", "pixels"),
    [
        ("bare", 0.012, 1000),
        pytest.param("whole_head", 0.01, 4000, marks=pytest.mark.slow),
        pytest.param("scan_mesh", 0.015, 4000, marks=pytest.mark.slow),
    ],
)
def test_pixels_are_close_to_ray_tracing(renderer, name, bound, pixels, request):
    mesh = request.getfixturevalue(name).with_material(occlusion_map=None)
    found = occlusion_error(renderer, fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6)), pixels)
    assert found.baked < bound
    assert found.without > 4.0 * found.baked


@pytest.fixture(scope="module")
def ring():
    """A torus with baked occlusion."""
    return fr.with_occlusion(mesh_of(torus())).parts[0]


def test_vertices_at_the_same_position_have_the_same_value(ring):
    part = ring
    _, seams = np.unique(part.positions, axis=0, return_inverse=True)
    for number in np.unique(seams):
        assert len(set(part.occlusion[seams.ravel() == number])) == 1
    assert part.occlusion.min() < 0.7
    assert part.occlusion.max() == 1.0


VARIANTS = {
    "as it is": {},
    "without places on a map": {"uv": None},
    "with colours": {"colors": 1.0},
    "with colours alone": {"uv": None, "colors": 1.0},
}


@pytest.mark.first_case
@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("deferred", [False, True])
def test_every_pixel_agrees_with_float64(egl, baked, name, deferred, monkeypatch):
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred)
    (whole,) = baked.parts
    changes = dict(VARIANTS[name])
    if "colors" in changes:
        changes["colors"] = 0.5 + 0.5 * np.cos(9.0 * baked.normalised(whole.positions))
    part = replace(whole, **changes)
    environment = fr.load_environment(fr.EnvironmentFile("studio"))
    scene = fr.Scene(
        with_geometry(baked, parts=(part,)),
        fr.Camera(-30.0),
        environment=environment,
        background=None,
    )
    shading = fr.Shading(environment_samples=0)
    with fr.Renderer((96, 96), samples=1, backend=egl, float_albedo=True) as renderer:
        gbuffer = renderer.gbuffer(scene, shading)
        image = renderer.render(scene, shading).linear[..., :3]
    covered = gbuffer.part >= 0
    expected = reference.shade(gbuffer, scene, shading)
    # Mesa 25 interpolates vertex colours with an error of 5e-6.
    least = 0.1 if name == "with colours alone" else 0.01
    assert (np.abs(image - expected) / np.maximum(expected, least))[covered].max() < 1e-4
    near = part.occlusion[nearest(part.positions, gbuffer.position[covered][::10])]
    assert np.abs(gbuffer.occlusion[covered][::10] - near).mean() < 0.02


def nearest(places, points):
    return np.array([np.linalg.norm(places - point, axis=1).argmin() for point in points])


@pytest.mark.slow
def test_parts_with_occlusion_maps_are_not_baked(head, ring):
    with pytest.warns(fr.FacerenderWarning, match=r"head\.glb has occlusion maps for all"):
        assert fr.with_occlusion(head) is head
    mapped = head.materials[0].occlusion_map
    both = mesh_of(torus(), replace(torus(), positions=torus().positions + (0.0, 1.0, 0.0)))
    first = replace(both.materials[0], occlusion_map=mapped)
    one, other = fr.with_occlusion(replace(both, materials=(first, both.materials[1]))).parts
    assert one.occlusion is None
    assert other.occlusion.mean() < ring.occlusion.mean()
    unused = fr.with_occlusion(
        with_geometry(both, parts=(replace(both.parts[0], uv=None), both.parts[1]))
    )
    assert unused.parts[0].occlusion is not None


def test_simplified_meshes_keep_occlusion(baked, bare):
    (part,), (whole,) = fr.simplified(baked, 2000).parts, baked.parts
    assert part.occlusion.shape == part.positions.shape[:1]
    near = whole.occlusion[nearest(whole.positions, part.positions)]
    assert np.abs(part.occlusion - near).mean() < 0.02
    assert fr.simplified(bare, 2000).parts[0].occlusion is None
    scene = fr.Scene(baked, lights=(PLAIN["key"],))
    assert _digest(scene) != _digest(replace(scene, mesh=bare))


def test_cache_key_of_occlusion_is_the_geometry(bare, baked, cache_folder, monkeypatch):
    place = cache_folder / "occlusion"
    first = fr.with_occlusion(bare, cache=True)
    np.testing.assert_array_equal(first.parts[0].occlusion, baked.parts[0].occlusion)
    (entry,) = place.iterdir()
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    again = fr.with_occlusion(fr.load_mesh(MINI_HEAD).with_material(m=0.2), cache=True)
    np.testing.assert_array_equal(again.parts[0].occlusion, baked.parts[0].occlusion)
    part = bare.parts[0]
    for other in (replace(part, normals=-part.normals), replace(part, faces=part.faces[1:])):
        with pytest.raises(fr.InputError, match="embreex"):
            fr.with_occlusion(with_geometry(bare, parts=(other,)), cache=True)
    with pytest.raises(fr.InputError, match="embreex"):
        fr.with_occlusion(bare)
    entry.write_bytes(entry.read_bytes()[:-1])
    with pytest.raises(fr.InputError, match="embreex"):
        fr.with_occlusion(bare, cache=True)


def test_missing_embreex_is_reported_with_a_remedy(bare, monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(fr.InputError, match=r"embreex; pip install 'facerender\[rays\]'"):
        fr.with_occlusion(bare)


def test_large_meshes_are_baked_in_pieces(bare, baked, monkeypatch):
    monkeypatch.setattr(occlusion, "_BLOCK", 1000)
    np.testing.assert_array_equal(
        fr.with_occlusion(bare).parts[0].occlusion, baked.parts[0].occlusion
    )


def test_unused_vertices_are_ignored(bare, baked):
    (part,) = bare.parts
    odd = np.array([(np.nan, 0.0, 0.0), (1e300, 0.0, 0.0), (0.0, 0.0, 0.0)])
    more = Part(
        np.concatenate([part.positions, odd]), np.concatenate([part.normals, 0.0 * odd[[2] * 3]]),
        part.faces,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (own,) = fr.with_occlusion(with_geometry(bare, parts=(more,))).parts
    np.testing.assert_array_equal(own.occlusion[:-3], baked.parts[0].occlusion)
    np.testing.assert_array_equal(own.occlusion[-3:], 1.0)


@pytest.mark.slow
def test_render_with_occlusion(tmp_path, capsys, egl, baked, cache_folder, monkeypatch):
    place = cache_folder / "occlusion"
    (tmp_path / "out").mkdir()
    cli = Cli(tmp_path / "out", capsys)
    options = ("--ambient", "2", "--occlusion")
    images = [cli.render(*options, "--no-cache")]
    assert not place.exists()
    images += [cli.render(*options), cli.render(*options)]
    assert len([*place.iterdir()]) == 1
    with fr.Renderer((48, 48), backend=egl) as renderer:
        own = renderer.render(fr.Scene(baked, ambient=2.0)).srgb8()
    for image in images:
        np.testing.assert_array_equal(image, own)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    cli.fail_to_render(r"baking occlusion needs .* pip install .*", *options, "--no-cache")


def test_a_mesh_file_is_baked_before_it_is_simplified(baked):
    level = fr.MeshFile(str(MINI_HEAD), occlusion=True, triangles=2000).load()
    np.testing.assert_array_equal(
        level.parts[0].occlusion, fr.simplified(baked, 2000).parts[0].occlusion
    )
    with pytest.raises(fr.InputError, match=r"mesh occlusion = 'baked': give true or false"):
        fr.MeshFile(str(MINI_HEAD), occlusion="baked")
