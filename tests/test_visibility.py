"""Tests deferred shading against forward shading, per-pixel shading, which back faces are drawn,
and in which order triangles are stored."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.drawing import frame_passes
from facerender.drawing.prepare import resolve
from facerender.drawing.program import IN_ROW
from facerender.images.image import linear_to_srgb
from facerender.material import Material
from facerender.mesh import part as mesh_part
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part, TriangleSetup
from tests.awkward_files import MINI_HEAD, join_glb, split_glb
from tests.meshes import with_geometry
from tests.test_alpha import quad
from tests.verification.lights import PLAIN_THREE

Both = Callable[..., tuple[NDArray[np.float32], NDArray[np.float32]]]
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def cube(sides: tuple[tuple[int, ...], ...] = SIDES, smooth: bool = False) -> Part:
    """Return a cube with normals per side or, with ``smooth``, per corner."""
    positions = CORNERS[np.array(sides).ravel()]
    if smooth:
        normals = positions / np.sqrt(3.0)
    else:
        across = CORNERS[[side[:3] for side in sides]]
        flat = np.cross(across[:, 1] - across[:, 0], across[:, 2] - across[:, 0])
        normals = np.repeat(flat / np.linalg.norm(flat, axis=1)[:, None], 4, axis=0)
    start = 4 * np.arange(len(sides))[:, None]
    faces = np.concatenate([start + (0, 1, 2), start + (0, 2, 3)]).astype(np.uint32)
    return Part(positions, normals, faces, colors=np.abs(positions) * (0.2, 0.5, 0.9))


def mesh_of(*parts: Part) -> fr.Mesh:
    bounds = np.array([CORNERS.min(axis=0), CORNERS.max(axis=0)])
    materials = tuple(Material(m=0.3 + 0.1 * i) for i in range(len(parts)))
    return fr.Mesh(Geometry("cube", parts, bounds, np.sqrt(3.0), np.array([(0.8, 0.6)])), materials)


@pytest.fixture(scope="module")
def renderer_of(egl):
    """A function that returns a renderer by size and samples, and caches it."""
    with ExitStack() as stack:

        @cache
        def of(size, samples, deferred=True):  # a renderer keeps its compiled frames
            made = fr.Renderer(size, samples=samples, backend=egl, float_albedo=True)
            return stack.enter_context(made)

        yield of


@pytest.fixture
def both(renderer_of, four_samples, monkeypatch) -> Both:
    """A function that draws a scene twice, with deferred and with forward shading."""

    def draw(scene: fr.Scene, size=(256, 192), samples=1, only=None):
        images = []
        for deferred in (True, False):
            monkeypatch.setattr(
                "facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_, on=deferred: on
            )
            renderer = renderer_of(size, samples, deferred)
            images.append(renderer.render(scene, only=only).linear)
        return tuple(images)

    return draw


def assert_same(deferred, drawn, share=0.999, steps=1.0):
    """Check that coverage is equal, and that displayed colours differ by at most ``steps`` levels.

    share : fraction of the covered pixels for which this must hold
    """
    np.testing.assert_array_equal(deferred[..., 3], drawn[..., 3])
    shown = [linear_to_srgb(each[..., :3]) for each in (deferred, drawn)]
    error = 255.0 * np.abs(shown[0] - shown[1]).max(axis=-1)
    covered = drawn[..., 3] > 0.0
    assert covered.any()
    assert np.quantile(error[covered], share) <= steps
    assert error[~covered].max(initial=0.0) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize(
    ("mesh", "azimuth"),
    [
        ("head", -50.0),
        pytest.param("head", 0.0, marks=pytest.mark.slow),
        pytest.param("head", 160.0, marks=pytest.mark.slow),
        pytest.param("scan_mesh", 30.0, marks=pytest.mark.slow),
    ],
)
def test_heads_agree(both, request, samples, mesh, azimuth):
    scene = fr.Scene(request.getfixturevalue(mesh), fr.Camera(azimuth))
    assert_same(*both(scene, (512, 384), samples))


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("camera", "size"),
    [
        (fr.Camera(elevation=-70.0), (256, 256)),  # looks into the open neck
        (fr.Camera(zoom=4.0, azimuth=20.0), (333, 100)),
        (fr.Camera(position=(0.1, 0.0, 0.1), target=(0.0, 0.05, 0.0)), (128, 128)),  # within
        (fr.Camera(position=(0.0, 0.0, 1.0), target=(1.0, 0.0, 1.0)), (64, 64)),  # sees nothing
    ],
)
@pytest.mark.filterwarnings("ignore:no pixel shows")
def test_unusual_cameras_agree(both, camera, size):
    mesh = fr.load_mesh(MINI_HEAD)
    deferred, drawn = both(fr.Scene(mesh, camera, background=None), size, 4)
    if (drawn == 0.0).all():
        np.testing.assert_array_equal(deferred, drawn)
    else:
        assert_same(deferred, drawn, 0.99)


@pytest.mark.first_case
@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("smooth", [False, True])
def test_creases_and_parts_are_antialiased(both, samples, smooth):
    """If a pixel contains several sides or parts, each contributes to its colour."""
    left, right = cube(SIDES[:3], smooth), cube(SIDES[3:], smooth)
    for mesh in (mesh_of(cube(smooth=smooth)), mesh_of(left, right)):
        scene = fr.Scene(mesh, fr.Camera(30.0, 25.0))
        assert_same(*both(scene, samples=samples), steps=0.1 if samples == 1 else 1.0)


@pytest.mark.parametrize("only", ["specular", "diffuse", "albedo", "normal", "depth"])
def test_terms_agree(both, head, only):
    deferred, drawn = both(fr.Scene(head, fr.Camera(-30.0)), only=only)
    np.testing.assert_array_equal(deferred[..., 3], drawn[..., 3])
    error = np.abs(deferred - drawn)[drawn[..., 3] > 0.0]
    assert np.quantile(error, 0.99) < 1e-3


def test_zero_width_triangles(both, renderer_of, monkeypatch):
    """Such triangles fill T-junctions; after rounding, their plane is undefined. With forward
    shading, llvmpipe interpolates no valid colours on them."""
    generator = np.random.default_rng(1)
    ends = generator.normal(size=(2, 500, 3))
    positions = np.concatenate([*ends, ends.mean(axis=0)])
    normals = positions / np.linalg.norm(positions, axis=1)[:, None]
    faces = np.stack(np.arange(1500, dtype=np.uint32).reshape(3, 500), axis=1)
    part = Part(positions, normals, faces, colors=0.5 + 0.25 * np.sign(positions))
    mesh = mesh_of(part).with_material(albedo=(1.0, 1.0, 1.0))
    scene = fr.Scene(mesh, fr.Camera(30.0, frame="all"))
    if renderer_of((512, 512), 1).context.software:
        with pytest.raises(fr.InputError, match="pixels of cube are not finite.* has no width"):
            both(scene, (512, 512), only="albedo")
    monkeypatch.setattr("facerender.drawing.renderer.check_images", lambda *_: None)
    deferred, drawn = both(scene, (512, 512), only="albedo")
    np.testing.assert_array_equal(deferred[..., 3], drawn[..., 3])
    seen = deferred[deferred[..., 3] > 0.0][:, :3]
    assert len(seen) > 5
    assert seen.min() > 0.0
    assert seen.max() < 1.0


def test_back_faces_above_a_rim(both):
    """A head's neck ends in a collar that is turned up, whose back faces are visible in front."""
    y = np.linspace(1.0, -0.9, 9)
    profile = [*zip(np.sqrt(1.0 - y**2), y, strict=True), (0.5, -1.2), (1.3, -1.0), (1.4, 0.1)]
    around = 2.0 * np.pi * np.arange(24) / 24
    ring = np.stack([np.sin(around), np.ones(24), np.cos(around)], axis=-1)
    positions = np.concatenate([ring * (r, y, r) for r, y in profile])
    quads = np.arange(24 * (len(profile) - 1)).reshape(-1, 24)
    one, two = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    faces = np.stack([one, one + 24, two, two, one + 24, two + 24], axis=1).reshape(-1, 3)
    part = Part(positions, np.tile(ring, (len(profile), 1)), faces.astype(np.uint32))
    assert_same(*both(fr.Scene(mesh_of(part), fr.Camera(elevation=10.0))))


@pytest.mark.parametrize("brightness", [1e3, 1e6])
def test_bright_backgrounds_agree(both, brightness):
    scene = fr.Scene(mesh_of(cube()), background=(brightness,) * 3)
    assert_same(*both(scene))


def test_part_shared_by_two_meshes(both):
    part = cube()
    both(fr.Scene(mesh_of(part)))
    assert_same(*both(fr.Scene(with_geometry(mesh_of(part), radius=3.0), fr.Camera(20.0))))


def tetrahedron() -> Part:
    """Return a tetrahedron with a red, a green, a blue and a white side."""
    positions = CORNERS[[(0, 6, 5), (0, 3, 6), (0, 5, 3), (3, 5, 6)]].reshape(-1, 3)
    faces = np.arange(12, dtype=np.uint32).reshape(4, 3)
    colors = np.repeat(np.vstack([np.eye(3), np.ones(3)]), 3, axis=0)
    return Part(positions, positions, faces, colors=colors)


@pytest.fixture
def rates(renderer_of, four_samples, monkeypatch) -> Both:
    """A function that draws a scene with per-pixel and with per-sample shading, both deferred.

    Its default number of samples is the driver's maximum.
    """
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: True)

    def draw(scene: fr.Scene, size=(256, 192), samples=None):
        renderer = renderer_of(size, 4)
        samples = samples or renderer.context.most_samples
        frames = [
            renderer.render(scene, samples=samples, shading_rate=each)
            for each in ("pixel", "sample")
        ]
        does = renderer.can_shade_per_pixel(scene, samples)
        assert ["shading_rate" in frame.metadata for frame in frames] == [does, False]
        return tuple(frame.linear for frame in frames)

    return draw


@pytest.mark.first_case
@pytest.mark.parametrize("azimuth", [10.0, 100.0, 190.0])
@pytest.mark.parametrize("elevation", [-10.0, 25.0])
def test_per_pixel_shading_uses_the_side_with_most_samples(rates, azimuth, elevation):
    """Without lights, the image is colour times coverage. A pixel's colour shows how many of its
    samples see each side."""
    mesh = mesh_of(tetrahedron()).with_material(albedo=(1.0, 1.0, 1.0))
    scene = fr.Scene(mesh, fr.Camera(azimuth, elevation), (), np.pi, background=None)
    one, full = rates(scene)
    np.testing.assert_array_equal(one[..., 3], full[..., 3])
    covered = full[..., 3] > 0.0
    colors, mixed = (each[covered][:, :3] / each[covered][:, 3:] for each in (one, full))
    white = mixed.min(axis=-1, keepdims=True)
    weights = np.hstack([mixed - white, white])
    sides = np.vstack([np.eye(3), np.ones(3)])
    chosen = np.abs(colors[:, None] - sides).max(axis=-1).argmin(axis=-1)
    np.testing.assert_allclose(colors, sides[chosen], atol=1e-5)
    seen = np.take_along_axis(weights, chosen[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(seen, weights.max(axis=-1), atol=1e-5)
    assert (seen < 0.99).sum() > 50


def test_per_pixel_shading_shades_every_part(rates):
    """If every side is a separate part, per-pixel shading equals per-sample shading."""
    whole = tetrahedron()
    parts = [replace(whole, faces=face[None]) for face in whole.faces]
    scene = fr.Scene(mesh_of(*parts), fr.Camera(10.0, 25.0))
    np.testing.assert_allclose(*rates(scene), rtol=1e-5, atol=1e-6)
    one, full = rates(replace(scene, mesh=mesh_of(whole)))
    assert (np.abs(one - full) > 1e-2).any()


@pytest.mark.slow
def test_per_pixel_shading_of_a_head(rates, head):
    one, full = rates(fr.Scene(head, fr.Camera(-35.0), PLAIN_THREE, background=None), (1024, 1024))
    assert (one != full).any()
    assert_same(one, full, 0.985)
    assert_same(one, full, 0.999, 16.0)


@pytest.mark.first_case
@pytest.mark.parametrize(("samples", "brightness"), [(1, 0.0), (2, 0.0), (8, 0.0), (4, 1e6)])
def test_per_pixel_shading_falls_back_to_per_sample(rates, head, samples, brightness):
    one, full = rates(fr.Scene(head, background=(brightness,) * 3), (64, 64), samples)
    np.testing.assert_array_equal(one, full)


@pytest.mark.slow
def test_per_pixel_shading_does_not_depend_on_deferring(rates, renderer_of, head, monkeypatch):
    scene = fr.Scene(head)
    one, _ = rates(scene)
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: False)
    renderer_of((256, 192), 4)._resources.frames.clear()  # a compiled frame keeps its choice
    np.testing.assert_array_equal(rates(scene)[0], one)


@pytest.mark.slow
def test_choice_of_deferred_shading(head):
    scene = fr.Scene(head)
    llvmpipe = "llvmpipe (LLVM 15.0.6, 256 bits)"
    assert frame_passes.deferred_is_cheaper(scene.mesh.parts, (1024, 1024), 1, llvmpipe)
    assert not frame_passes.deferred_is_cheaper(scene.mesh.parts, (1024, 1024), 4, "softpipe")
    low = fr.Scene(mesh_of(cube()))
    assert not frame_passes.deferred_is_cheaper(low.mesh.parts, (1024, 1024), 1, llvmpipe)
    assert frame_passes.deferred_is_cheaper(low.mesh.parts, (1024, 1024), 4, llvmpipe)


def test_meshes_too_large_for_deferring_are_drawn_forward(head):
    look = resolve(fr.Scene(head), fr.Shading()).appearance
    assert frame_passes.can_defer(look.unblended, (0.0, 0.0, 0.0), 16384)
    too_few = (len(head.parts[0].faces) - 1) // IN_ROW
    assert not frame_passes.can_defer(look.unblended, (0.0, 0.0, 0.0), too_few)


# --- sides and order of triangles -----------------------------------------------------------------


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
    """Without the property or without a material, only front faces are drawn."""
    document, binary = split_glb(MINI_HEAD.read_bytes())
    if value is None:
        del document["meshes"][0]["primitives"][0]["material"]
    else:
        document["materials"][0]["doubleSided"] = value
    content = join_glb(document, binary)
    assert two_sides(fr.load_mesh(content)) == [bool(value)]
    assert two_sides(fr.load_mesh(content, double_sided=True)) == [True]
    assert two_sides(fr.load_mesh(MINI_HEAD)) == [False]


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
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: True)
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh, camera, PLAIN_THREE)
    assert two_sides(mesh) == [False]
    images, counts, facing = [], [], TriangleSetup.facing

    def counted(*arguments):
        chosen = facing(*arguments)
        counts.append(len(chosen))
        return chosen

    monkeypatch.setattr(TriangleSetup, "facing", counted)
    for edge_on in (mesh_part._EDGE_ON, 1.0):
        monkeypatch.setattr(mesh_part, "_EDGE_ON", edge_on)
        with fr.Renderer((96, 96), samples=samples, backend=egl) as renderer:
            images.append(renderer.render(scene).linear)
    np.testing.assert_array_equal(*images)
    assert counts[0] < 0.75 * counts[1]
    assert counts[1] == len(mesh.parts[0].faces)


@pytest.mark.first_case
@pytest.mark.parametrize("deferred", [True, False])
def test_back_faces_are_drawn_only_with_two_sides(egl, deferred, monkeypatch):
    name = "facerender.drawing.frame_passes.deferred_is_cheaper"
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


UP = np.tile((0.0, 1.0, 0.0), (4, 1))


def test_both_sides_cast_shadows(egl):
    """A sheet above a floor casts the same shadow, whichever side it turns to the light."""
    light = fr.Light(0.0, 89.0, shadow=True)
    images = []
    for side in (1.0, -1.0):
        floor, sheet = (
            replace(part, positions=part.positions[:, [0, 2, 1]] * (1, 1, -1), normals=normals)
            for part, normals in ((quad(0, 2), UP), (quad(1.0, 0.5), side * UP))
        )
        parts = [floor, replace(sheet, faces=sheet.faces[:, :: int(side)].copy())]
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
    part = scenes[1].mesh.parts[0]
    steps = [
        np.median(np.linalg.norm(np.diff(part.positions[first], axis=0), axis=1))
        for first in (part.faces[:, 0], np.random.default_rng(3).permutation(part.faces[:, 0]))
    ]
    assert steps[0] < 0.1 * steps[1], "neighbours are stored together"
    with fr.Renderer((96, 96), samples=1, backend=egl) as renderer:
        images = [renderer.render(each).linear for each in scenes]
    assert (np.abs(images[0] - images[1]).max(axis=-1) > 1e-3).mean() < 1e-3


def test_double_sided_is_checked():
    with pytest.raises(fr.InputError, match="double_sided"):
        fr.Material(double_sided="yes")
    with pytest.raises(fr.InputError, match="double_sided"):
        fr.load_mesh(MINI_HEAD, double_sided=1)
