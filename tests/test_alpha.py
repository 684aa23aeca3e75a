"""Tests transparent, cut-out and emissive parts: their materials, textures and rendering."""

import copy
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.drawing import reference
from facerender.drawing.passes.shade import shade_pass
from facerender.drawing.passes.visibility import can_defer
from facerender.drawing.resolve import resolve
from facerender.errors import InputError
from facerender.explorer.mesh import drawable, lost_features
from facerender.job import Job
from facerender.loading.mesh_cache import MeshFiles
from facerender.loading.source import source_of
from facerender.scenes.file import load_scene, scene_toml
from facerender.scenes.light import parse_light
from facerender.scenes.material import MAPS, Material
from facerender.scenes.mesh import Part
from facerender.scenes.texture import Texture
from facerender.scenes.view import view_of
from tests.awkward_files import assert_equal
from tests.test_lod import grid
from tests.test_lod import mesh_of as shaped
from tests.verification.cache import wait_for_cache
from tests.verification.lights import PLAIN
from tests.verification.parts_head import NAMES, hairs, parts_head

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
    material = Material(**FACTORS, opacity_map=grey([[0.0, 1.0]]))
    assert material.second_uv == ("occlusion_map", "opacity_map")
    assert Material(emissive=2.0).emissive == (2.0, 2.0, 2.0)
    for name, value, message in (
        ("alpha", "glass", "unknown alpha 'glass'; known: opaque, mask, blend"),
        ("alpha", 1, "unknown alpha 1; known: opaque, mask, blend"),
        ("opacity", 1.5, "opacity = 1.5"),
        ("opacity", float("nan"), "opacity = nan"),
        ("alpha_cutoff", -0.1, "alpha_cutoff = -0.1"),
        ("emissive", (1.0, -1.0, 0.0), "emissive = "),
        ("normal_strength", -1.0, "normal_strength = -1"),
        ("normal_strength", 1e3, "normal_strength = 1000"),
        ("occlusion_strength", 2.0, "occlusion_strength = 2"),
        ("second_uv", ("bump_map",), "second_uv = "),
        ("second_uv", "bump_map", "second_uv = "),
        ("opacity_map", "lashes.png", "opacity_map = "),
        ("transmission", 1.5, "transmission = 1.5"),
        ("refraction", 0.9, "refraction = 0.9"),
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
    for made in (pickle.loads(pickle.dumps(other)), copy.deepcopy(other)):
        assert made.sampling == other.sampling
        assert made.rgb().tobytes() == plain.rgb().tobytes()
    for wrap in ("repeat", ("repeat",), ("repeat", "border"), ("repeat", None), None):
        with pytest.raises(InputError, match="wrap"):
            plain.sampled(wrap)
    with pytest.raises(InputError, match="nearest"):
        plain.sampled(("clamp", "clamp"), nearest=1)


def test_maps_with_equal_sampling_share_a_property_map():
    one, two = grey([[0.5, 1.0]]), grey([[0.25, 0.5]])
    clamped = two.sampled(("clamp", "clamp"))
    alike = Material(occlusion_map=clamped, roughness_map=clamped)
    assert alike.property_map is not None
    assert alike.property_map.sampling == clamped.sampling
    for apart in (
        Material(occlusion_map=one, roughness_map=clamped),
        Material(occlusion_map=one, roughness_map=two, second_uv=("occlusion_map",)),
    ):
        assert apart.property_map is None
        assert apart.slopes == Material(roughness_map=two).slopes
    both = ("occlusion_map", "roughness_map")
    assert Material(occlusion_map=one, roughness_map=two, second_uv=both).property_map is not None


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


def full_material():
    image = np.random.default_rng(1).uniform(0.0, 1.0, (4, 8))
    maps = {name: grey(image, name) for name in MAPS}
    maps["opacity_map"] = maps["opacity_map"].sampled(("mirror", "clamp"), nearest=True)
    return Material(**FACTORS, **maps)


def test_meshes_survive_pickles_and_the_cache(tmp_path, cache_folder):
    part = quad()
    mesh = mesh_of([replace(part, uv2=part.uv[::-1].copy())], [full_material()])
    file = tmp_path / "head.obj"
    file.write_text("v 0 0 0\n")
    files = MeshFiles(source_of(file), {})
    files.store(files.digest(), mesh, {}, [])
    wait_for_cache()
    kept = files.find()
    for found in (kept, pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh)):
        assert_equal(found.parts, mesh.parts, "parts")
        assert_equal(found.materials, mesh.materials, "materials")
    assert kept.materials[0].property_map is None  # its occlusion map uses other coordinates


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


def agrees(renderer, scene, shading=fr.Shading()):
    """Check the frame of a scene against float64; return the frame and the G-buffer."""
    frame, gbuffer = renderer.render(scene, shading).linear, renderer.gbuffer(scene, shading)
    expected = reference.shade(gbuffer, scene, shading)
    assert np.abs(frame[..., :3] - expected).max() < 1e-4
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


@pytest.mark.slow
def test_a_head_of_parts_is_smooth_with_several_samples(backend, four_samples):
    scene = fr.Scene(parts_head(), fr.Camera(30.0), LIGHTS, background=(0.2, 0.3, 0.4))
    with fr.Renderer((160, 160), samples=4, backend=backend) as renderer:
        one, four, many = (renderer.render(scene, samples=n).linear for n in (1, 4, 16))
        cut = renderer.gbuffer(scene).part == NAMES.index("hair")
    assert set(np.unique(four[cut][:, 3])) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    errors = [np.abs(each - many)[cut].mean() for each in (one, four)]
    assert errors[1] < 0.75 * errors[0]
    assert np.abs(four - many).mean() < 2e-3


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
    joined = parts_joined([quads[0], quads[2]])  # nearest first: triangles must be sorted
    both = [replace(WHITE, kd=np.pi), replace(glass[0], albedo=(1.0, 1.0, 1.0))]
    frame, gbuffer = agrees(single, scene_of([quads[1], joined], both, **dark))
    assert len(gbuffer.transparent_layers) == 2
    assert (
        gbuffer.transparent_layers[0].position[48, 48, 2]
        < gbuffer.transparent_layers[1].position[48, 48, 2]
    )
    alone, _ = agrees(single, scene_of([quads[0]], [glass[0]], **dark))
    np.testing.assert_allclose(alone[48, 48], (0.25, 0.0, 0.0, 0.25), atol=1e-6)


def parts_joined(parts):
    from tests.verification.parts_head import joined

    return joined(parts)


def test_shells_cast_no_shadow_and_lashes_cast_shadows_of_hairs(single):
    mesh = parts_head()
    at = NAMES.index("shells")
    solid = [*mesh.materials]
    solid[at] = replace(solid[at], alpha="opaque")
    lashes = NAMES.index("lashes")
    slabs = [*mesh.materials]
    slabs[lashes] = replace(slabs[lashes], alpha="opaque")
    camera = fr.Camera(10.0, zoom=6.0, target=(0.032, 0.0, 0.08))
    above = (parse_light("0,75,3"),)
    seen, part = [], []
    bare = [*mesh.parts]
    bare[at] = replace(bare[at], faces=bare[at].faces[:1], positions=0.0 * bare[at].positions)
    for parts, materials in (
        (mesh.parts, mesh.materials),
        (tuple(bare), mesh.materials),
        (mesh.parts, solid),
        (mesh.parts, slabs),
    ):
        drawn = replace(mesh, parts=parts, materials=tuple(materials))
        scene = fr.Scene(drawn, camera, above)
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
    occlusion = grey(values).sampled((wrap, other), nearest)
    part = quad()
    part = replace(part, uv=3.0 * part.uv - 1.0)
    gbuffer = single.gbuffer(scene_of([part], [replace(WHITE, occlusion_map=occlusion)]))
    inside = gbuffer.part == 0
    expected = looked_up(
        values[::-1], gbuffer.uv[inside].astype(np.float64), (wrap, other), nearest
    )
    error = np.abs(gbuffer.occlusion[inside] - expected)
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


def test_features_without_effect_are_not_compiled(head):
    """Programs and deferred shading are the same as in a scene without the features."""
    solid = grey(np.ones((2, 2)))
    idle = [
        {"alpha": "mask", "opacity_map": solid},
        {"alpha": "blend", "opacity_map": solid},
        {"opacity": 0.5, "opacity_map": grey(np.zeros((2, 2)))},
        {"emissive_map": solid},
        {"second_uv": MAPS[:1]},
        {"alpha": "mask", "alpha_cutoff": 0.3, "opacity": 0.3},
    ]
    bare = replace(head.materials[0], albedo_map=None, occlusion_map=None)
    shading = fr.Shading()

    def programs(material):
        scene = fr.Scene(replace(head, materials=(material,)), lights=LIGHTS)
        assert can_defer(scene, 16384)
        drawn = shade_pass(resolve(scene, shading), view_of(scene, 1.0), 4)
        return [draw.program for draw in drawn.draws]

    without = programs(bare)
    for changes in idle:
        assert programs(replace(bare, **changes)) == without
    assert programs(replace(bare, normal_map=None)) == programs(
        replace(bare, normal_map=None, normal_strength=0.5, occlusion_strength=0.5)
    )
    holes = replace(bare, alpha="mask", opacity_map=hairs(9, 0.1, 1))
    assert not can_defer(fr.Scene(replace(head, materials=(holes,))), 16384)


@pytest.mark.slow
def test_blended_parts_are_composited_after_scattering(single):
    """The image with shells is the image without them, with the shells composited over it."""
    mesh = replace(parts_head(scattering="skin"), millimetres=1000.0)
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
    whole = replace(parts_head(scattering=scattering), millimetres=1000.0)
    parts = (coarse_head.parts[0], *whole.parts[1:3])
    shells = replace(whole, parts=parts, materials=whole.materials[:3])
    bare = replace(whole, parts=parts[:2], materials=whole.materials[:2])
    settings = {"camera": fr.Camera(20.0, zoom=2.0), "lights": LIGHTS, "background": (0.1,) * 3}
    scene, without = fr.Scene(shells, **settings), fr.Scene(bare, **settings)
    assert can_defer(scene, 16384)
    images = []
    for deferred in (True, False):
        name = "facerender.drawing.renderer.deferred_is_cheaper"
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
