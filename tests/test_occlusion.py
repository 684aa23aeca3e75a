"""Tests occlusion baked at vertices: against geometry, rays and float64 shading, in the cache, and
absent when off."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing import reference
from facerender.drawing.program import Program, fixed_attributes, surface_features
from facerender.planning.cache import _digest
from facerender.scenes import occlusion
from facerender.scenes.mesh import Part
from tests.awkward_files import MINI_HEAD
from tests.test_cli import Cli
from tests.test_lod import grid, mesh_of, torus
from tests.verification.lights import PLAIN
from tests.verification.occlusion import occlusion_error


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
    monkeypatch.setattr("facerender.drawing.renderer.deferred_is_cheaper", lambda *_: deferred)
    (whole,) = baked.parts
    changes = dict(VARIANTS[name])
    if "colors" in changes:
        changes["colors"] = 0.5 + 0.5 * np.cos(9.0 * baked.normalised(whole.positions))
    part = replace(whole, **changes)
    environment = fr.load_environment(fr.EnvironmentFile("studio"))
    scene = fr.Scene(
        replace(baked, parts=(part,)), fr.Camera(-30.0), environment=environment, background=None
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
    light = replace(scene, lights=(), environment=None)
    dimmed = reference.shade(gbuffer, light, shading)[covered]
    undimmed = reference.shade(replace(gbuffer, occlusion=np.ones_like(gbuffer.m)), light, shading)
    shares = np.broadcast_to(gbuffer.occlusion[covered][:, None], dimmed.shape)
    np.testing.assert_allclose(dimmed, shares * undimmed[covered], rtol=1e-6)


def nearest(places, points):
    return np.array([np.linalg.norm(places - point, axis=1).argmin() for point in points])


def test_occlusion_is_compiled_only_if_present(bare, baked):
    for mesh, on in ((bare, False), (baked, True)):
        (part,), (material,) = mesh.parts, mesh.materials
        features = surface_features(part, material, fr.Shading())
        sources = Program("gbuffer.frag", features=features).sources("330 core")
        assert ("VERTEX_OCCLUSION" in features) == on
        assert ("#define VERTEX_OCCLUSION" in "".join(sources.values())) == on
        assert ("in_occlusion" in fixed_attributes(part)) == on


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
        replace(both, parts=(replace(both.parts[0], uv=None), both.parts[1]))
    )
    assert unused.parts[0].occlusion is not None


@pytest.mark.slow
@pytest.mark.usefixtures("measured_gain")
def test_simplified_meshes_and_plans_keep_occlusion(baked, bare, egl):
    level = fr.simplified(baked, 2000)
    (part,), (whole,) = level.parts, baked.parts
    assert part.occlusion.shape == part.positions.shape[:1]
    near = whole.occlusion[nearest(whole.positions, part.positions)]
    assert np.abs(part.occlusion - near).mean() < 0.02
    plain = fr.simplified(bare, 2000).parts[0]
    assert plain.occlusion is None
    scene = fr.Scene(baked, lights=(PLAIN["key"],), ambient=1.0)
    assert _digest(scene) != _digest(replace(scene, mesh=bare))
    with fr.Renderer((96, 96), backend=egl) as renderer:
        plan = fr.plan(scene, "8/255", within=0.8, renderer=renderer)
        detail = plan.detail
        fewer = detail.of(scene)
        frames = [
            renderer.render(scene),
            renderer.render(fewer, plan.shading, **detail.values),
        ]
    assert len(fewer.mesh.parts[0].occlusion) < len(whole.occlusion)
    images = [frame.srgb8().astype(int) for frame in frames]
    lost = np.abs(images[0] - images[1]).max(axis=-1)
    assert np.count_nonzero(lost > 9) <= 0.2 * np.count_nonzero(frames[0].linear[..., 3])


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
            fr.with_occlusion(replace(bare, parts=(other,)), cache=True)
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
    monkeypatch.setattr(occlusion, "_AT_ONCE", 1000)
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
        (own,) = fr.with_occlusion(replace(bare, parts=(more,))).parts
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
