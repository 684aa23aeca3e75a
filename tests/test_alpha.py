"""Tests transparent, cut-out, emissive and refracting parts: their materials, textures and
rendering. The eye is compared with exact rays."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.drawing import reference
from facerender.drawing.compiled import CompiledFrame
from facerender.drawing.frame_passes import can_defer
from facerender.drawing.maps import regions_of
from facerender.drawing.prepare import resolve
from facerender.errors import InputError
from facerender.explorer.page import drawable, lost_features
from facerender.material import MAPS, Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.scene.job import Job, load_scene, scene_toml
from facerender.texture.texture import Texture
from tests.meshes import with_geometry
from tests.settings import parse_light
from tests.test_lod import grid
from tests.test_lod import mesh_of as shaped
from tests.verification.eye import CLEAR, camera, cap, disc, eye, iris_errors
from tests.verification.lights import PLAIN
from tests.verification.parts_head import NAMES, joined, parts_head

FACTORS = {
    "alpha": "mask",
    "opacity": 0.75,
    "alpha_cutoff": 0.25,
    "emissive": (0.5, 0.25, 2.0),
    "normal_strength": 0.5,
    "occlusion_strength": 0.25,
    "second_uv": ("occlusion_map", "opacity_map"),
    "transmission": 0.25,
    "refraction": 1.25,
}


def mesh_of(parts, materials):
    """Return a mesh of parts with their materials."""
    return replace(shaped(*parts), materials=tuple(materials))


def grey(values, name="grey"):
    """Return a texture of grey values in [0, 1], (H, W), row 0 on top."""
    texels = np.round(255.0 * np.asarray(values, dtype=np.float64)).astype(np.uint8)
    return Texture(lambda: Image.fromarray(texels), name)


def test_material_fields_are_checked():
    """test_ranges.py checks the numbers."""
    material = Material(**FACTORS, opacity_map=grey([[0.0, 1.0]]))
    assert material.second_uv == ("occlusion_map", "opacity_map")
    assert Material(emissive=2.0).emissive == (2.0, 2.0, 2.0)
    for name, value, message in (
        ("alpha", "glass", "unknown alpha 'glass'; known: opaque, mask, blend"),
        ("alpha", 1, "unknown alpha 1; known: opaque, mask, blend"),
        ("second_uv", ("bump_map",), "second_uv = "),
        ("opacity_map", "lashes.png", "opacity_map = "),
    ):
        with pytest.raises(InputError, match=message.replace("(", r"\(")):
            Material(**{name: value})


def test_material_is_solid_if_opacity_has_no_effect():
    holes, none = grey([[0.2, 1.0]]), grey([[1.0, 1.0]])
    assert Material(opacity=0.1).solid
    assert Material(alpha="mask", opacity_map=none).solid
    assert Material(alpha="blend", opacity_map=none).solid
    assert Material(alpha="mask", opacity_map=holes, alpha_cutoff=0.2).solid
    assert not Material(alpha="mask", opacity_map=holes).solid
    assert not Material(alpha="blend", opacity=0.99).solid


@pytest.mark.slow
def test_transmission_scales_the_diffuse_term_and_the_coverage(single):
    """The highlight, the emission and the opacity do not depend on the transmission."""
    lights = {"lights": (parse_light("0,10"),), "ambient": 1.0}
    front = replace(WHITE, ks=1.0, m=0.3, opacity=0.5, emissive=0.1)
    for alpha, cover in (("opaque", 1.0), ("blend", 0.5), ("mask", 1.0)):
        own = replace(front, alpha=alpha, alpha_cutoff=0.4, transmission=0.75)
        scene = scene_of([quad(0.0), quad(0.5, 0.5)], [WHITE, own], **lights)
        gbuffer = agrees(single, scene)[1]
        (layer,) = gbuffer.transparent_layers
        assert layer.transmission == 0.75
        assert layer.opacity[48, 48] == cover
        alone = scene_of([quad(0.5, 0.5)], [own], **lights)
        assert agrees(single, alone)[0][48, 48, 3] == pytest.approx(0.25 * cover)
        bare = replace(alone, mesh=mesh_of(alone.mesh.parts, [replace(own, kd=0.0)]))
        thick = replace(bare, mesh=mesh_of(bare.mesh.parts, [replace(front, kd=0.0)]))
        shine = [single.render(each).linear[48, 48, :3] for each in (bare, thick)]
        np.testing.assert_allclose(shine[0], cover * shine[1], rtol=1e-6)
    cut = replace(own, alpha_cutoff=0.6)
    hidden = scene_of([quad(0.0), quad(0.5, 0.5)], [WHITE, cut], **lights)
    wall = single.render(scene_of([quad(0.0)], [WHITE], **lights)).linear
    np.testing.assert_allclose(agrees(single, hidden)[0][48, 48], wall[48, 48], rtol=0.05)


def test_parts_with_transmission_cast_no_shadow(single):
    lights = (parse_light("0,30,3"),)
    thin, cornea = Material(transmission=0.5), Material(transmission=0.5, refraction=1.3)
    for front, least in ((thin, 1.0), (Material(), 0.0), (cornea, 1.0), (Material(), 0.0)):
        scene = scene_of([quad(0.0), quad(0.5, 0.5)], [Material(), front], lights=lights)
        gbuffer = single.gbuffer(scene)
        seen = gbuffer.visibility[gbuffer.part == 0]
        assert seen.min() == least


def test_texture_sampling_is_stored_and_checked():
    plain = grey([[0.0, 1.0], [0.5, 0.25]])
    other = plain.sampled(("clamp", "mirror"), nearest=True)
    assert plain.sampling == (("repeat", "repeat"), False)
    assert other.sampling == (("clamp", "mirror"), True)
    assert other.size == plain.size
    assert other.levels("data") is plain.levels("data")  # decoded once
    assert other.channel(0, "red").sampling == other.sampling
    assert other.sampled(("repeat", "repeat")).rgb() == plain.rgb()
    for wrap in ("repeat", ("repeat",), ("repeat", "border"), ("repeat", None)):
        with pytest.raises(InputError, match="wrap"):
            plain.sampled(wrap)


def quad(z=0.0, size=1.0, **columns):
    """Return a square that faces +z."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=np.float64)
    return Part(
        np.hstack([size * corners, np.full((4, 1), z)]),
        np.tile((0.0, 0.0, 1.0), (4, 1)),
        np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32),
        0.5 + 0.5 * corners,
        **columns,
    )


@pytest.mark.filterwarnings("ignore:.* has no effect without")  # the mesh has no maps
def test_factors_survive_scene_files_and_jobs(tmp_path):
    mesh = mesh_of([quad()], [Material(**FACTORS)])
    path = tmp_path / "scene.toml"
    path.write_text(scene_toml(fr.Scene(mesh), fr.Shading()))
    loaded = load_scene(path)["material"]
    assert mesh_of([quad()], [Material()]).with_material(**loaded).materials == mesh.materials
    job = Job(material=FACTORS)
    assert Job.from_dict(json.loads(json.dumps(job.as_dict()))) == job
    path.write_text(job.toml())
    assert load_scene_material(path) == job.material


def load_scene_material(path):
    import tomllib

    return Job.from_dict(tomllib.loads(path.read_text())).material


def test_a_simplified_mesh_keeps_second_coordinates():
    pytest.importorskip("meshoptimizer")
    steps = np.linspace(-1.0, 1.0, 21)
    x, y = (each.ravel() for each in np.meshgrid(steps, steps))
    faces = grid(20, 20)[:, ::-1].copy()
    positions = np.stack([x, y, 0.2 * np.sin(3.0 * x)], axis=1)
    uv = np.stack([0.5 + 0.5 * x, 0.5 + 0.5 * y], axis=1)
    normals = np.tile((0.0, 0.0, 1.0), (len(x), 1))
    part = Part(positions, normals, faces, uv, uv2=3.0 * uv[:, ::-1])
    less = fr.simplified(mesh_of([part], [Material()]), 200).parts[0]
    assert len(less.faces) <= 200
    assert np.abs(less.uv2 - 3.0 * less.uv[:, ::-1]).max() < 0.05


# --- rendering -----------------------------------------------------------------------------------

LIGHTS = tuple(map(parse_light, ("key,radius=0", "rim,no-shadow", "fill,no-shadow")))
FRONT = fr.Camera(fov=20.0)
WHITE = Material((1.0, 1.0, 1.0), ks=0.0)


@pytest.fixture(scope="module")
def single(backend):
    with fr.Renderer((96, 96), samples=1, backend=backend, float_albedo=True) as renderer:
        yield renderer


def scene_of(parts, materials, **settings):
    """Return a scene of parts with a camera in front of them."""
    return fr.Scene(mesh_of(parts, materials), FRONT, **{"background": None, **settings})


def agrees(renderer, scene, shading=fr.Shading(), bound=1e-4):
    """Check the frame of a scene against float64; return the frame and the G-buffer."""
    frame, gbuffer = renderer.render(scene, shading).linear, renderer.gbuffer(scene, shading)
    behind = (1.0 - gbuffer.coverage[..., None]) * (scene.background or 0.0)
    expected = reference.shade(gbuffer, scene, shading) + behind
    assert np.abs(frame[..., :3] - expected).max() < bound
    assert np.abs(frame[..., 3] - gbuffer.coverage).max() < 1e-6
    return frame, gbuffer


@pytest.mark.slow
@pytest.mark.parametrize("hair", ["mask", pytest.param("blend", marks=pytest.mark.slow)])
def test_head_of_parts_agrees_with_float64(single, hair):
    scene = fr.Scene(parts_head(hair), fr.Camera(30.0), LIGHTS, background=None)
    frame, gbuffer = agrees(single, scene)
    shells = [
        each for each in gbuffer.transparent_layers if (each.part == NAMES.index("shells")).any()
    ]
    assert len(shells) == 2  # front and, where the eye does not hide it, back
    assert (gbuffer.part == NAMES.index("eyes")).sum() > 20
    assert (gbuffer.part == NAMES.index("hair")).any() == (hair == "mask")
    assert frame[..., 3].max() == pytest.approx(1.0)


def test_edges_of_masks_are_smooth(backend, four_samples):
    y, x = np.mgrid[-1.0:1.0:64j, -1.0:1.0:64j]
    disc = grey((10.0 * (0.8 - np.hypot(x, y)) + 0.5).clip(0.0, 1.0))
    scene = scene_of([quad()], [replace(WHITE, alpha="mask", opacity_map=disc)])
    with fr.Renderer((128, 128), samples=4, backend=backend) as renderer:
        one, four, many = (renderer.render(scene, samples=n).linear[..., 3] for n in (1, 4, 64))
    assert {*np.unique(one)} == {0.0, 1.0}
    assert {*np.unique(four)} == {0.0, 0.25, 0.5, 0.75, 1.0}
    edge = (many > 0.0) & (many < 1.0)
    assert np.abs(four - many)[edge].mean() < 0.6 * np.abs(one - many)[edge].mean()
    assert abs(four.mean() - many.mean()) < 2e-3


@pytest.mark.slow
def test_masks_cut_holes(single):
    half = grey(np.repeat([[0.0, 1.0]], 2, axis=0)).sampled(("clamp", "clamp"), nearest=True)
    front = Material((1.0, 0.0, 0.0), ks=0.0, alpha="mask", opacity_map=half)
    scene = scene_of([quad(0.0), quad(0.5, 0.5)], [WHITE, front])
    part = agrees(single, scene)[1].part
    assert part[48, 54] == 1
    assert part[48, 42] == 0
    for material, seen in (
        (replace(front, alpha_cutoff=2.0), 0),
        (replace(front, alpha_cutoff=0.0), 1),
        (replace(front, alpha="opaque"), 1),
        (replace(front, opacity=0.4), 0),
    ):
        gbuffer = single.gbuffer(scene_of([quad(0.0), quad(0.5, 0.5)], [WHITE, material]))
        assert gbuffer.part[48, 54] == seen


def test_blended_parts_are_drawn_back_to_front(single):
    dark = {"lights": (), "ambient": 1.0}
    quads = [quad(z, size) for z, size in ((0.6, 0.3), (0.0, 1.0), (0.3, 0.6))]
    colors = ((1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 1.0))
    glass = [Material(c, ks=0.0, kd=np.pi, alpha="blend", opacity=0.25) for c in colors]
    materials = [glass[0], replace(WHITE, kd=np.pi), glass[2]]
    frame, gbuffer = agrees(single, scene_of(quads, materials, **dark))
    np.testing.assert_allclose(frame[48, 48], (0.8125, 0.5625, 0.75, 1.0), atol=1e-6)
    assert [each.part.max() for each in gbuffer.transparent_layers] == [2, 0]
    both_glasses = joined([quads[0], quads[2]])  # nearest first: triangles must be sorted
    both = [replace(WHITE, kd=np.pi), replace(glass[0], albedo=(1.0, 1.0, 1.0))]
    frame, gbuffer = agrees(single, scene_of([quads[1], both_glasses], both, **dark))
    assert len(gbuffer.transparent_layers) == 2
    assert (
        gbuffer.transparent_layers[0].position[48, 48, 2]
        < gbuffer.transparent_layers[1].position[48, 48, 2]
    )
    alone, _ = agrees(single, scene_of([quads[0]], [glass[0]], **dark))
    np.testing.assert_allclose(alone[48, 48], (0.25, 0.0, 0.0, 0.25), atol=1e-6)


def test_shells_cast_no_shadow_and_lashes_cast_shadows_of_hairs(single):
    mesh = parts_head()
    at, lashes = NAMES.index("shells"), NAMES.index("lashes")

    def opaque(index):
        own = [*mesh.materials]
        own[index] = replace(own[index], alpha="opaque")
        return replace(mesh, materials=tuple(own))

    bare = [*mesh.parts]
    bare[at] = replace(bare[at], faces=bare[at].faces[:1], positions=0.0 * bare[at].positions)
    camera = fr.Camera(10.0, zoom=6.0, target=(0.032, 0.0, 0.08))
    seen, part = [], []
    for drawn in (mesh, with_geometry(mesh, parts=tuple(bare)), opaque(at), opaque(lashes)):
        scene = fr.Scene(drawn, camera, (parse_light("0,75,3"),))
        gbuffer = single.gbuffer(scene, blended=False)
        seen.append(gbuffer.visibility[..., 0])
        part.append(gbuffer.part)
    eye = (part[0] == NAMES.index("eyes")) & (part[3] == part[0])
    assert eye.sum() > 200
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (part[2] == at).sum() > 200
    assert seen[0][eye].mean() > seen[3][eye].mean() + 0.02


@pytest.mark.slow
def test_emission_is_added_and_scaled(single):
    shines = replace(WHITE, emissive=(0.5, 1.0, 4.0), emissive_map=grey(np.full((2, 2), 1.0)))
    plain_one = scene_of([quad()], [WHITE])
    lit = replace(plain_one, mesh=mesh_of([quad()], [shines]))
    frame, gbuffer = agrees(single, lit)
    dark, _ = agrees(single, plain_one)
    inside = gbuffer.part == 0
    np.testing.assert_allclose((frame - dark)[inside] - (0.5, 1.0, 4.0, 0.0), 0.0, atol=1e-5)
    for only in ("diffuse", "specular"):
        same_ = [single.render(scene, only=only).linear for scene in (lit, plain_one)]
        np.testing.assert_array_equal(*same_)
    half = replace(shines, emissive_map=grey(np.full((2, 2), 188 / 255)))
    frame, _ = agrees(single, replace(lit, mesh=mesh_of([quad()], [half])))
    np.testing.assert_allclose((frame - dark)[inside][:, 1], 0.5, atol=5e-3)  # sRGB


NOISE = np.random.default_rng(4).uniform(0.0, 1.0, (8, 8))


def relief():
    rng = np.random.default_rng(3)
    slopes = rng.uniform(-0.4, 0.4, (16, 16, 2))
    normals = np.dstack([slopes, np.ones((16, 16))])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    texels = np.round(127.5 + 127.5 * normals).astype(np.uint8)
    return Texture(lambda: Image.fromarray(texels), "relief")


@pytest.mark.slow
def test_normal_maps_have_a_strength(single):
    normals, slopes = [], []
    for strength in (0.0, 0.5, 1.0, 2.0):
        material = replace(WHITE, ks=1.0, normal_map=relief(), normal_strength=strength)
        _, gbuffer = agrees(single, scene_of([quad()], [material]))
        inside = gbuffer.part == 0
        normal = gbuffer.normal[inside].astype(np.float64)
        normals.append(normal[:, :2] / normal[:, 2:])
        slopes.append(gbuffer.m[inside])
    np.testing.assert_allclose(normals[0], 0.0, atol=6e-3)  # no 8-bit value encodes 0
    np.testing.assert_allclose(normals[1], 0.5 * normals[2], atol=1e-5)
    np.testing.assert_allclose(normals[3], 2.0 * normals[2], atol=1e-5)
    far = fr.Camera(fov=20.0, zoom=0.05)  # far enough for the slope filter to act
    added = []
    for strength in (0.5, 1.0):
        own = replace(material, normal_strength=strength)
        gbuffer = single.gbuffer(fr.Scene(mesh_of([quad()], [own]), far))
        added.append(gbuffer.m[gbuffer.part == 0].astype(np.float64) ** 2 - material.m**2)
    assert added[0].min() > 0.001
    np.testing.assert_allclose(added[1], 4.0 * added[0], rtol=1e-3)
    np.testing.assert_allclose(slopes[0], material.m, atol=1e-6)


def test_occlusion_has_a_strength(single):
    for strength in (0.0, 0.25, 1.0):
        dims = grey(np.full((4, 4), 0.2))
        material = replace(WHITE, occlusion_map=dims, occlusion_strength=strength)
        _, gbuffer = agrees(single, scene_of([quad()], [material]))
        expected = 1.0 + strength * (51 / 255 - 1.0)
        np.testing.assert_allclose(gbuffer.occlusion[gbuffer.part == 0], expected, atol=1e-5)


def texels_of(name, gbuffer):
    """Return the G-buffer channel that a map changes."""
    return {
        "albedo_map": gbuffer.albedo,
        "normal_map": gbuffer.normal,
        "roughness_map": gbuffer.m,
        "specular_map": gbuffer.specular_weight,
        "occlusion_map": gbuffer.occlusion,
        "lobe_map": gbuffer.lobe_weight,
        "opacity_map": gbuffer.part,
        "emissive_map": gbuffer.emission,
    }[name]


@pytest.mark.first_case
@pytest.mark.parametrize("name", MAPS)
def test_maps_use_second_texture_coordinates(single, name):
    """A map with uv2 equals the same map on a part whose uv has those coordinates."""
    part = quad()
    turned = 0.9 * part.uv[:, ::-1] + 0.05
    image = relief() if name == "normal_map" else grey(NOISE)
    others = {"roughness_map": grey([[0.7]]), "occlusion_map": grey([[0.6]])}
    two = {"second_slope": 2.0, "lobe_weight": 0.5, "alpha": "mask", "emissive": 1.0}
    material = Material(**two, **{**others, name: image})
    scenes = [
        scene_of([replace(part, uv2=turned)], [replace(material, second_uv=(name,))]),
        scene_of([replace(part, uv=turned)], [material]),
        scene_of([part], [material]),
    ]
    second, first, other = (agrees(single, scene)[1] for scene in scenes)
    np.testing.assert_allclose(texels_of(name, second), texels_of(name, first), atol=2e-5)
    assert np.abs(texels_of(name, other) - texels_of(name, first)).max() > 0.05
    lost = single.gbuffer(scene_of([part], [replace(material, second_uv=(name,))]))
    kept = single.gbuffer(scene_of([part], [replace(material, **{name: None})]))
    np.testing.assert_array_equal(texels_of(name, lost) * 1.0, texels_of(name, kept) * 1.0)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_maps_are_wrapped_and_filtered(single, wrap, nearest):
    values = np.round(255.0 * np.random.default_rng(5).uniform(0, 1, (4, 4))) / 255.0
    other = {"repeat": "mirror", "clamp": "repeat", "mirror": "clamp"}[wrap]
    specular = grey(values).sampled((wrap, other), nearest)
    occlusion = grey([[0.7]]).sampled(("repeat", "clamp"), nearest)  # so they are not packed
    material = replace(WHITE, ks=1.0, specular_map=specular, occlusion_map=occlusion)
    part = quad()
    part = replace(part, uv=3.0 * part.uv - 1.0)
    gbuffer = single.gbuffer(scene_of([part], [material]))
    inside = gbuffer.part == 0
    expected = looked_up(
        values[::-1], gbuffer.uv[inside].astype(np.float64), (wrap, other), nearest
    )
    error = np.abs(gbuffer.specular_weight[inside] - expected)
    assert np.quantile(error, 0.98) < (1e-5 if nearest else 5e-3)  # except at edges of texels


def looked_up(texels, uv, wraps, nearest):
    def at(index, wrap):
        if wrap == "clamp":
            return index.clip(0, 3)
        return index % 4 if wrap == "repeat" else np.where(index % 8 < 4, index % 8, 7 - index % 8)

    place = 4.0 * uv - (0.0 if nearest else 0.5)
    low = np.floor(place).astype(int)
    share = np.zeros_like(place) if nearest else place - low
    result = np.zeros(len(uv))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
            x, y = (at(low[:, i] + d, wraps[i]) for i, d in ((0, dx), (1, dy)))
            result += weight * texels[y, x]
    return result


@pytest.mark.slow
def test_blended_parts_are_composited_after_scattering(single):
    """The image with shells is the image without them, with the shells composited over it."""
    mesh = with_geometry(parts_head(scattering="skin"), millimetres=1000.0)
    camera = fr.Camera(20.0, zoom=2.0)
    clear = [*mesh.materials]
    clear[NAMES.index("shells")] = replace(clear[NAMES.index("shells")], opacity=0.0)
    scene = fr.Scene(mesh, camera, LIGHTS, background=(0.1, 0.2, 0.3))
    behind = replace(scene, mesh=replace(mesh, materials=tuple(clear)))
    gbuffer = single.gbuffer(scene)
    over = behind_image = single.render(behind).linear[..., :3].astype(np.float64)
    for layer in gbuffer.transparent_layers:
        alpha = layer.opacity[..., None]
        over = (
            alpha * reference.layers(layer, scene, fr.Shading()).sum(fr.Shading())
            + (1 - alpha) * over
        )
    assert np.abs(over - behind_image).max() > 0.01
    np.testing.assert_allclose(single.render(scene).linear[..., :3], over, atol=1e-4)
    whole = single.render(scene, samples=4).linear
    assert np.abs(whole - single.render(scene, samples=16).linear).mean() < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("scattering", [None, "skin"])
def test_blended_parts_are_drawn_over_deferred_shading(
    backend, coarse_head, monkeypatch, scattering, four_samples
):
    """They change only their own pixels, and look as in forward shading."""
    whole = with_geometry(parts_head(scattering=scattering), millimetres=1000.0)
    parts = (coarse_head.parts[0], *whole.parts[1:3])
    shells = with_geometry(whole, parts=parts, materials=whole.materials[:3])
    bare = with_geometry(whole, parts=parts[:2], materials=whole.materials[:2])
    settings = {"camera": fr.Camera(20.0, zoom=2.0), "lights": LIGHTS, "background": (0.1,) * 3}
    scene, without = fr.Scene(shells, **settings), fr.Scene(bare, **settings)
    assert can_defer(resolve(scene, fr.Shading()).appearance.unblended, (0.0, 0.0, 0.0), 16384)
    images = []
    for deferred in (True, False):
        name = "facerender.drawing.frame_passes.deferred_is_cheaper"
        monkeypatch.setattr(name, lambda *_, on=deferred: on)
        with fr.Renderer((160, 160), samples=4, backend=backend) as renderer:
            images.append([renderer.render(scene, samples=n).linear for n in (1, 4, 16)])
            fronts = replace(scene, mesh=scene.mesh.with_material(double_sided=False))
            backs = renderer.render(fronts).linear
            assert np.abs(backs - images[-1][1]).max() > 0.01
            shine = [renderer.render(each, only="specular").linear for each in (scene, without)]
            assert (shine[0] - shine[1]).max() > 0.05
            if deferred:
                behind = [renderer.render(without, samples=n).linear for n in (1, 4, 16)]
                layers = renderer.gbuffer(scene).transparent_layers
                rate = renderer.render(scene, shading_rate="pixel")
                assert rate.metadata["shading_rate"] == "pixel"
                assert np.abs(rate.linear - images[0][2]).mean() < 5e-3
    covered = np.any([each.part >= 0 for each in layers], axis=0)
    near = sum(np.roll(covered, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)) > 0
    assert 100 < covered.sum() < 5000
    for one, other, plain in zip(*images, behind, strict=True):
        np.testing.assert_array_equal(one[~near], plain[~near])
        assert np.abs(one - plain)[covered].max() > 0.05
        assert np.abs(one - other)[near].mean() < 1e-3
        assert np.quantile(np.abs(one - other)[near], 0.98) < 0.01


def test_the_explorer_omits_blended_parts():
    mesh = parts_head("blend")
    assert lost_features(mesh) == ["blended parts", "masks"]
    shown = drawable(mesh)
    assert len(shown.parts) == 3
    assert {material.alpha for material in shown.materials} == {"opaque"}


@pytest.mark.slow
@pytest.mark.parametrize("front", [{"alpha": "blend", "opacity": 0.5}, {"transmission": 1.0}])
def test_a_plan_counts_errors_of_blended_parts(front):
    """Only the front part has a highlight, which the cheapest shading of the wall omits."""
    wall, glass = replace(WHITE, ks=0.0), replace(WHITE, ks=1.0, f0=0.2, **front)
    scene = scene_of([quad(), quad(0.5)], [wall, glass], lights=(PLAIN["key"],), ambient=0.0)
    with fr.Renderer((32, 32), samples=1) as renderer:
        plan = fr.plan(scene, "1/255", renderer=renderer, cost="navi21")
        full, planned = (renderer.render(scene, each).linear for each in (plan.full, plan.shading))
    assert plan.shading != plan.full
    assert plan.error.drawn is not None
    drawn = plan.budget.errors(planned[..., :3], full[..., :3]).max()
    assert plan.error.drawn == pytest.approx(drawn, rel=1e-4, abs=1e-7)  # float32
    assert 0.0 < plan.error.drawn <= plan.budget.limit


def test_transparent_parts_bake_no_occlusion():
    pytest.importorskip("embreex")
    wall, glass = quad(0.0), quad(0.3)
    bare, clear = Material(), Material(alpha="blend", opacity=0.5)
    open_ = fr.with_occlusion(mesh_of([wall, glass], [bare, clear]))
    assert open_.parts[0].occlusion.min() > 0.99
    assert open_.parts[1].occlusion is None
    assert fr.with_occlusion(mesh_of([wall, glass], [bare, bare])).parts[0].occlusion.max() < 0.9


# --- refraction -----------------------------------------------------------------------------------


EYE_LIGHTS = tuple(map(parse_light, ("-30,35,3,radius=3", "rim,no-shadow", "fill,no-shadow")))


@pytest.fixture(scope="module")
def wide(backend):
    with fr.Renderer((256, 256), samples=1, backend=backend, float_albedo=True) as renderer:
        yield renderer


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("azimuth", "straight"), [(0.0, 0.05), (30.0, 0.08), (50.0, 0.16), (-45.0, 0.14)]
)
def test_iris_is_where_exact_rays_hit_it(wide, azimuth, straight):
    """On a cornea of 512 triangles. Without refraction the error is much larger."""
    drawn, without = iris_errors(wide, azimuth, rings=8, sectors=32)
    assert len(drawn) > 15_000
    assert drawn.mean() < 0.001
    assert np.quantile(drawn, 0.99) < 0.01
    assert without.mean() == pytest.approx(straight, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"alpha": "blend", "opacity": 0.5},
        {"alpha": "mask", "opacity": 0.4},
        {"transmission": 0.6, "emissive": 0.1},
        {"second_slope": 2.0, "lobe_weight": 0.5},
    ],
)
def test_highlight_agrees_with_float64(wide, change):
    mesh = eye(ks=1.0, **change)
    scene = fr.Scene(mesh, camera(30.0), EYE_LIGHTS, ambient=0.3, background=(0.1, 0.2, 0.3))
    bare = replace(scene, mesh=eye(ks=0.0, **change))
    frame, gbuffer = agrees(wide, scene)
    if change.get("alpha") == "mask":  # the whole cornea is below the cutoff
        np.testing.assert_array_equal(frame, wide.render(bare).linear)
        return
    layer = gbuffer.transparent_layers[0] if "alpha" in change else gbuffer
    own = layer.part == CLEAR
    assert own.sum() > 10_000
    shine = frame[..., :3] - wide.render(bare).linear[..., :3]
    assert shine[own].max() > 0.5
    assert shine[own].min() > -0.2  # light that the surface reflects does not enter
    assert np.abs(shine[~own]).max() < 1e-6
    light = [
        each if "alpha" not in change else each.transparent_layers[0]
        for each in (gbuffer, wide.gbuffer(bare))
    ]
    ratio = light[0].emission[own] / light[1].emission[own]
    towards = gbuffer.view.position - layer.normalised_position[own]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = (towards * layer.normal[own]).sum(axis=1)
    if "emissive" not in change:
        schlick = 0.0207 + 0.9793 * (1.0 - cosine.clip(0.0, 1.0)) ** 5
        np.testing.assert_allclose(ratio, np.tile(1.0 - schlick[:, None], 3), atol=1e-4)


def test_surfaces_in_front_of_the_cornea_are_not_behind_it(wide):
    """A plate in front of the cornea changes only the pixels that it hides."""
    mesh = eye()
    plate = disc(2, 16)
    positions = plate.positions * (0.1, 0.1, 0.0) + (-4.8, 0.0, -0.6)
    plate = replace(plate, positions=positions, colors=None)
    more = (*mesh.parts, plate), (*mesh.materials, Material((0.0, 0.0, 0.0), ks=0.0))
    hidden = with_geometry(mesh, parts=more[0], materials=more[1])
    light = {"lights": (), "ambient": 3.0}
    one, two = (wide.gbuffer(fr.Scene(each, camera(50.0), **light)) for each in (mesh, hidden))
    own = (one.part == CLEAR) & (two.part == CLEAR)
    assert own.sum() > 10_000
    np.testing.assert_allclose(one.emission[own], two.emission[own], atol=1e-6)


@pytest.mark.slow
def test_every_effect_agrees_with_float64(wide):
    studio = fr.load_environment(fr.EnvironmentFile("studio"))
    mesh = eye(ks=1.0)
    for settings, shading in (
        ({"lights": (), "ambient": 0.0, "environment": studio}, fr.Shading()),
        ({"lights": EYE_LIGHTS}, fr.Shading(diffuse="coupled")),
    ):
        agrees(wide, fr.Scene(mesh, camera(20.0), **settings), shading)
    scatters = [replace(each, scattering="skin") for each in mesh.materials[:CLEAR]]
    skin = with_geometry(mesh, materials=(*scatters, mesh.materials[CLEAR]), millimetres=8.0)
    frame, _ = agrees(wide, fr.Scene(skin, camera(20.0), EYE_LIGHTS), bound=1e-3)
    plain = wide.render(fr.Scene(mesh, camera(20.0), EYE_LIGHTS)).linear
    assert 0.0 < np.abs(frame - plain).mean() < 0.05
    four = wide.render(fr.Scene(skin, camera(20.0), EYE_LIGHTS), samples=4).linear
    assert np.abs(four - frame).mean() < 0.01


@pytest.mark.slow
def test_forward_deferred_and_per_pixel_shading_agree(backend, monkeypatch):
    scene = fr.Scene(eye(ks=1.0), camera(35.0), EYE_LIGHTS)
    assert can_defer(resolve(scene, fr.Shading()).appearance.unblended, (0.0, 0.0, 0.0), 16384)
    images = []
    for deferred in (False, True):
        name = "facerender.drawing.frame_passes.deferred_is_cheaper"
        monkeypatch.setattr(name, lambda *_, on=deferred: on)
        with fr.Renderer((128, 128), samples=4, backend=backend) as renderer:
            images += [renderer.render(scene, samples=n).linear for n in (1, 4, 16)]
            pixel = renderer.render(scene, shading_rate="pixel").linear
    for one, other in zip(images[:3], images[3:], strict=True):
        assert np.quantile(np.abs(one - other), 0.995) < 2e-3
    assert np.abs(pixel - images[2]).mean() < 5e-3


def test_terms_and_data_views_show_the_cornea_itself(wide):
    scene = fr.Scene(eye(ks=1.0), camera(0.0), EYE_LIGHTS)
    middle = (128, 128)
    assert wide.render(scene, only="parts").linear[middle][0] == CLEAR + 1
    assert wide.render(scene, only="depth").linear[middle][0] > 0.0
    for only in ("diffuse", "specular"):
        image = wide.render(scene, only=only).linear
        assert np.isfinite(image).all()
        assert image[middle][0] < 0.05  # refracted light belongs to neither term


@pytest.mark.slow
def test_maps_are_reused_until_the_scene_changes(wide, monkeypatch):
    drawn = []
    replay = CompiledFrame._replay

    def count(self, step, *others):
        drawn.extend([step.source.name] * len(step.source.draws))
        replay(self, step, *others)

    monkeypatch.setattr(CompiledFrame, "_replay", count)
    mesh = eye()
    scene = fr.Scene(mesh, camera(0.0), EYE_LIGHTS)
    dark = replace(mesh, materials=(*mesh.materials[:1], Material(), *mesh.materials[CLEAR:]))
    studio = fr.load_environment(fr.EnvironmentFile("studio"))
    for changes, count in (
        ({}, 2),
        ({"camera": camera(10.0)}, 0),
        ({"ambient": 0.5}, 2),
        ({"lights": EYE_LIGHTS[:2]}, 2),
        ({"environment": studio}, 2),
        ({"environment": replace(studio, rotation=90.0)}, 2),
        ({"mesh": dark}, 2),
        ({}, 0),
    ):
        scene = replace(scene, **changes)
        drawn.clear()
        wide.render(scene)
        assert drawn.count("refraction_map") == count, changes


@pytest.mark.slow
def test_nothing_behind_shows_the_background(wide):
    mesh = eye()
    alone = Mesh.of("lens", mesh.parts[CLEAR:], mesh.materials[CLEAR:])
    for azimuth in (0.0, 90.0, 180.0, -120.0):
        scene = fr.Scene(alone, fr.Camera(azimuth), EYE_LIGHTS, background=(0.1, 0.2, 0.3))
        image, gbuffer = agrees(wide, scene)
        lost = image[gbuffer.part == 0][:, :3] / (0.1, 0.2, 0.3)
        assert (lost > 0.0).all()
        assert (lost <= 1.0 + 1e-6).all()
    inside = fr.Camera(position=(0.0, 0.0, -1.0), target=(0.0, 0.0, -3.6), fov=60.0)
    for place in (inside, replace(inside, target=(0.0, 0.0, 1.0))):
        assert np.isfinite(wide.render(fr.Scene(mesh, place, EYE_LIGHTS)).linear).all()


def test_each_region_has_a_map(wide):
    """Two eyes in one mesh look like one eye; so does an eye with a clear shell around it."""
    one = eye()
    apart = [[replace(p, positions=p.positions + (x, 0, 0)) for x in (-16, 16)] for p in one.parts]
    colors = [None, np.concatenate([one.parts[1].colors] * 2), None]
    parts = [
        replace(joined([replace(p, uv=p.positions[:, :2], colors=None) for p in own]), colors=color)
        for own, color in zip(apart, colors, strict=True)
    ]
    two = Mesh.of("eyes", parts, one.materials)
    assert len(regions_of(two.setups[CLEAR], two.setups)) == 2
    light = {"lights": (), "ambient": 3.0}
    middle = np.s_[100:156, 100:156, :3]
    alone = wide.render(fr.Scene(one, fov(0.0), **light)).linear[middle]
    for x in (-16.0, 16.0):
        beside = wide.render(fr.Scene(two, fov(x), **light)).linear[middle]
        assert np.abs(alone - beside).max() < 0.01
    shell = cap(-12.6, 12.6, 0.0, np.pi, 24, 64)
    closed = Mesh.of("shell", [*one.parts[:CLEAR], shell], one.materials)
    (region,) = regions_of(closed.setups[CLEAR], closed.setups)
    np.testing.assert_allclose(region.matrix[:2, 2], 0.0, atol=1e-6)
    image = wide.render(fr.Scene(closed, fov(0.0), **light)).linear[middle]
    assert np.abs(image - alone).mean() < 0.1


def fov(x):
    """Return a camera 300 mm in front of an eye at x, whatever the bounds of the mesh are."""
    return fr.Camera(position=(x, 0.0, 300.0), target=(x, 0.0, 0.0), fov=4.0)


def test_many_regions_share_one_map(wide):
    lens = eye().parts[CLEAR]
    row = [
        replace(lens, positions=lens.positions + (14.0 * i, 0.0, 0.0), uv=lens.positions[:, :2])
        for i in range(9)
    ]
    for count, maps in ((1, 1), (8, 8), (9, 1)):
        mesh = Mesh.of("lenses", [joined(row[:count])], eye().materials[CLEAR:])
        regions = regions_of(mesh.setups[0], mesh.setups)
        assert len(regions) == maps
        assert sum(len(each.faces) for each in regions) == len(mesh.parts[0].faces)
    agrees(wide, fr.Scene(mesh, fr.Camera(), EYE_LIGHTS))


@pytest.mark.slow
def test_maps_follow_the_order_of_the_lights():
    """Lights without a specular term come last, and so do their shadow maps."""
    camera = fr.Camera(-35, target=(0.03, 0.02, 0.1), zoom=5.0)
    shading = fr.Shading(specular_lights=(1, 2))
    images = []
    for shadings in ((shading,), (fr.Shading(), shading)):
        scene = fr.Scene(fr.load_mesh().with_material(), camera)
        for each in shadings:
            with fr.Renderer((128, 128), samples=1) as renderer:
                image = renderer.render(scene, each).linear
        images.append(image)
    np.testing.assert_array_equal(*images)
