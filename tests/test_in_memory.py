"""Tests meshes and maps in memory (arrays, bytes, open files, objects of trimesh), and that public
objects can be pickled and copied."""

from __future__ import annotations

import copy
import io
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.images.image import srgb_to_linear
from tests.awkward_files import (
    MINI_HEAD,
    assert_equal,
    mini_head,
    write_gltf,
    write_ply,
    write_stl,
    write_textured_obj,
)
from tests.verification.cache import wait_for_cache
from tests.verification.lights import PLAIN

HEAD = mini_head()


def assert_same(a, b):
    """Check that meshes have the same parts except for names, and the same factors and texels."""
    assert len(a.parts) == len(b.parts)
    for part, other in zip(a.parts, b.parts, strict=True):
        for name in ("positions", "normals", "faces", "uv", "colors"):
            one, two = getattr(part, name), getattr(other, name)
            assert (one is None) == (two is None), name
            if one is not None:
                np.testing.assert_allclose(one, two, atol=1e-12, err_msg=name)
    for material, like in zip(a.materials, b.materials, strict=True):
        for name, one in vars(material).items():
            two = getattr(like, name)
            if isinstance(one, fr.Texture):
                np.testing.assert_array_equal(np.asarray(one.rgb()), np.asarray(two.rgb()), name)
            else:
                assert one == pytest.approx(two, abs=1e-6) if isinstance(one, float) else True


def scene_of(path):
    import trimesh

    return trimesh.load_scene(path, process=False)


# --- files in memory -----------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize("write", [None, write_ply, write_stl, write_textured_obj])
def test_bytes_and_open_files_equal_their_file(write, tmp_path):
    path = MINI_HEAD
    if write:
        path = write(tmp_path / f"a.{write.__name__[-3:]}", HEAD)
    known = fr.load_mesh(path)
    content = path.read_bytes()
    with path.open("rb") as file:
        assert_same(fr.load_mesh(file), known)
    if write is write_textured_obj:
        return
    for source in (content, bytearray(content), memoryview(content), io.BytesIO(content)):
        mesh = fr.load_mesh(source)
        assert_same(mesh, known)
        assert mesh.millimetres == known.millimetres
    assert_same(fr.load_mesh(content, kind=path.suffix[1:]), known)
    assert_same(fr.load_mesh(content, kind=path.suffix.upper()), known)


def test_open_files_find_their_other_files_and_bytes_do_not(tmp_path):
    path = write_gltf(tmp_path / "a.gltf", HEAD)
    with path.open("rb") as file:
        assert_same(fr.load_mesh(file), fr.load_mesh(path))
    with pytest.raises(fr.InputError, match=r"a\.bin .* has no folder: give a path"):
        fr.load_mesh(path.read_bytes())
    textured = write_textured_obj(tmp_path / "a.obj", HEAD)
    with pytest.warns(fr.FacerenderWarning, match=r"a\.mtl \(named by bytes\) .*no folder"):
        mesh = fr.load_mesh(textured.read_bytes(), allow_outside=True)
    assert mesh.materials[0].albedo_map is None


def test_bytes_are_cached(cache_folder, monkeypatch):
    content = MINI_HEAD.read_bytes()
    first = fr.load_mesh(content, cache=True)
    wait_for_cache()
    monkeypatch.setattr("facerender.loading._pieces", lambda *_: pytest.fail("it was read anew"))
    assert_same(fr.load_mesh(content, cache=True), first)


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (b"hello", {}, "bytes: unknown mesh format; specify it, such as kind='obj'"),
        (b"hello", {"kind": "obj"}, "bytes has no geometry"),
        (b"PK\x03\x04 usdz", {}, "bytes is a ZIP archive"),
        (b"glTF", {}, "bytes is truncated"),
        (b"", {"kind": "glb"}, "bytes is an empty file"),
        (b"v 0 0 0", {"kind": "fbx"}, "unknown mesh kind 'fbx'; known: glb, gltf, obj"),
        (b"v 0 0 0", {"kind": 5}, "unknown mesh kind 5"),
        (io.BytesIO(), {}, "file has no more bytes to read: rewind it with seek(0)"),
        (io.StringIO("v 0 0 0"), {}, "file is open as text: open it as bytes, with mode 'rb'"),
        ([[0, 0, 0]], {}, "mesh file = [[0, 0, 0]]: give a path, bytes, an open file"),
    ],
)
def test_invalid_meshes_are_refused(source, options, message):
    with pytest.raises(fr.InputError, match=re.escape(message)) as error:
        fr.load_mesh(source, **options)
    assert "\n" not in str(error.value)


def test_closed_files_are_refused(tmp_path):
    file = MINI_HEAD.open("rb")
    file.close()
    with pytest.raises(fr.InputError, match="cannot read mini_head.glb: .*closed"):
        fr.load_mesh(file)
    with (tmp_path / "a").open("wb") as writing, pytest.raises(fr.InputError, match="cannot read"):
        fr.load_mesh(writing)


def test_kind_overrides_the_suffix(tmp_path):
    path = tmp_path / "head.bin"
    path.write_bytes(MINI_HEAD.read_bytes())
    with pytest.raises(fr.InputError, match=r"is not OBJ but glTF; name it \.glb"):
        fr.load_mesh(path, kind="obj")
    assert_same(fr.load_mesh(path, kind="glb"), fr.load_mesh(MINI_HEAD))
    with path.open("rb") as file:
        assert_same(fr.load_mesh(file), fr.load_mesh(MINI_HEAD))


# --- trimesh -------------------------------------------------------------------------------------


def test_trimesh_scene_equals_its_file():
    scene, known = scene_of(MINI_HEAD), fr.load_mesh(MINI_HEAD)
    mesh = fr.load_mesh(scene)
    assert_same(mesh, known)
    assert mesh.millimetres == 1000.0
    (geometry,) = scene.geometry.values()
    assert_same(fr.load_mesh(geometry), known)


def test_trimesh_instances_are_placed_by_the_scene_graph():
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.tile(np.uint8([255, 128, 0, 255]), (len(ball.vertices), 1))
    scene = trimesh.Scene()
    mirror = np.diag([-2.0, 1.0, 1.0, 1.0])
    mirror[:3, 3] = 10.0, 0.0, 0.0
    scene.add_geometry(ball, node_name="one")
    scene.add_geometry(ball, node_name="two", transform=mirror)
    scene.add_geometry(trimesh.PointCloud(np.eye(3)))
    scene.units = "centimeters"
    mesh = fr.load_mesh(scene)
    assert sorted(part.name for part in mesh.parts) == ["one", "two"]
    two = mesh.select("two")
    np.testing.assert_allclose(two.bounds, [(8, -1, -1), (12, 1, 1)], atol=1e-6)
    assert (
        np.einsum("ij,ij->i", two.parts[0].normals, two.parts[0].positions - (10, 0, 0)) > 0
    ).all()
    np.testing.assert_allclose(
        two.parts[0].colors[0], srgb_to_linear(np.array([255, 128, 0]) / 255)
    )  # type: ignore[index]
    assert mesh.millimetres == 10.0
    assert fr.load_mesh(scene, millimetres=2.0).millimetres == 2.0


def test_objects_of_trimesh_are_copied():
    import trimesh

    box = trimesh.creation.box()
    mesh = fr.load_mesh(box)
    before = mesh.parts[0].positions.copy()
    box.vertices *= 7.0
    np.testing.assert_array_equal(mesh.parts[0].positions, before)


def test_materials_of_trimesh_cut_and_blend():
    import trimesh

    image = Image.new("RGBA", (4, 4), (200, 100, 50, 64))
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[255, 128, 0, 128],
        baseColorTexture=image,
        roughnessFactor=0.25,
        alphaMode="MASK",
        alphaCutoff=0.3,
        emissiveFactor=[0.5, 0.0, 0.0],
    )
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(box.vertices), 2)), material=material
    )
    (own,) = fr.load_mesh(box).materials
    assert own.albedo == pytest.approx((1.0, 128 / 255, 0.0))
    assert (own.alpha, own.alpha_cutoff, own.roughness_factor) == ("mask", 0.3, 0.25)
    assert own.opacity == pytest.approx(128 / 255)
    assert own.emissive == (0.5, 0.0, 0.0)
    assert np.asarray(own.opacity_map.rgb())[0, 0, 0] == 64  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("Trimesh", (), "a trimesh.Trimesh has no faces"),
        ("Scene", (), "a trimesh.Scene has no faces"),
        ("Trimesh", (np.eye(3), [[0, 1, 7]]), "no face"),
        ("Trimesh", (np.full((3, 3), np.nan), [[0, 1, 2]]), "no face"),
    ],
)
@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning", "ignore::RuntimeWarning")
def test_trimesh_without_faces_is_refused(name, arguments, message):
    import trimesh

    options = {"process": False} if arguments else {}
    with pytest.raises(fr.InputError, match=message):
        fr.load_mesh(getattr(trimesh, name)(*arguments, **options))


def test_maps_may_be_arrays_images_and_textures():
    texels = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    given: list[Any] = [texels, Image.fromarray(texels), fr.Texture.from_array(texels)]
    for each in given:
        (material,) = fr.load_mesh(MINI_HEAD, albedo=each, cache=True).materials
        np.testing.assert_array_equal(np.asarray(material.albedo_map.rgb())[::-1], texels)  # type: ignore[union-attr]
    with pytest.raises(
        fr.InputError, match="albedo = 5: give a path, or in Python a texture, an array"
    ):
        fr.load_mesh(MINI_HEAD, albedo=5)  # type: ignore[arg-type]


def test_scene_takes_a_file_as_the_first_call():
    code = (
        "import sys, facerender as fr\n"
        "assert 'numpy' not in sys.modules\n"
        "print(fr.Scene(sys.argv[1]).mesh.name)\n"
        "assert 'trimesh' not in sys.modules\n"
    )
    command = [sys.executable, "-c", code, str(MINI_HEAD)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == (
        "mini_head.glb\n"
    )
    for bad in (None, 5, "nowhere.glb"):
        with pytest.raises(fr.InputError):
            fr.Scene(bad)  # type: ignore[arg-type]


# --- arrays --------------------------------------------------------------------------------------

POSITIONS, FACES = HEAD.positions, HEAD.faces


def test_arrays_equal_their_file():
    known = fr.load_mesh(MINI_HEAD)
    mesh = fr.Mesh.from_arrays(
        POSITIONS,
        FACES,
        uv=HEAD.uv,
        normals=3.0 * HEAD.normals,
        material=known.materials[0],
        name="head",
        millimetres=1000.0,
    )
    assert_same(mesh, known)
    assert (mesh.name, mesh.parts[0].name, mesh.millimetres) == ("head", "head", 1000.0)
    np.testing.assert_array_equal(mesh.profile, known.profile)


@pytest.mark.parametrize(
    ("places", "corners"),
    [
        (np.ndarray.tolist, np.ndarray.tolist),
        (lambda a: a.astype(np.float32), lambda a: a.astype(np.uint16)),
        (
            lambda a: a.astype(np.float32)[:, ::-1][:, ::-1],
            lambda a: a.astype(np.int8 if len(a) < 99 else np.int64),
        ),
        (np.asfortranarray, lambda a: a.astype(np.float64)),
        (lambda a: (a * 1e6).astype(np.int64), lambda a: a.astype(np.uint64)),
        (lambda a: a.astype(">f8"), lambda a: a.astype(">i4")),
    ],
)
def test_arrays_of_any_kind(places, corners):
    mesh = fr.Mesh.from_arrays(places(POSITIONS), corners(FACES))
    again = fr.Mesh.from_arrays(POSITIONS, FACES)
    assert len(mesh.parts[0].faces) == len(again.parts[0].faces)
    a, b = (each.normalised(each.parts[0].positions) for each in (mesh, again))
    np.testing.assert_allclose(a, b, atol=1e-5)


def test_arrays_are_copied():
    own, faces = POSITIONS.copy(), FACES.astype(np.uint32)
    mesh = fr.Mesh.from_arrays(own, faces, uv=HEAD.uv, normals=HEAD.normals)
    part = mesh.parts[0]
    for array in (own, faces, HEAD.uv, HEAD.normals):
        for held in (part.positions, part.faces, part.uv, part.normals):
            assert held is not None
            assert not np.shares_memory(array, held)


def test_colours_of_arrays():
    linear = np.abs(HEAD.normals)
    bytes_ = np.full((len(POSITIONS), 4), 128, np.uint8)
    for given, expected in (
        (linear, linear),
        (bytes_, np.full(linear.shape, srgb_to_linear(np.array(128 / 255)))),
        (
            bytes_.astype(np.uint16) * 257,
            np.full(linear.shape, srgb_to_linear(np.array(128 / 255))),
        ),
    ):
        mesh = fr.Mesh.from_arrays(POSITIONS, FACES, colors=given)
        np.testing.assert_allclose(mesh.parts[0].colors, expected)
        assert mesh.materials[0].albedo == (1.0, 1.0, 1.0)


def test_arrays_are_repaired_like_files():
    faces = np.concatenate([FACES, FACES[:3, [0, 0, 1]]])
    with pytest.warns(fr.FacerenderWarning, match="3 degenerate faces"):
        mesh = fr.Mesh.from_arrays(POSITIONS, faces)
    assert len(mesh.parts[0].faces) == len(FACES)
    np.testing.assert_allclose(np.linalg.norm(mesh.parts[0].normals, axis=1), 1.0)


def changed(values, value):
    copied = values.astype(float)
    copied[5, 1] = value
    return copied


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"positions": POSITIONS[:, :2]}, "positions has the shape"),
        ({"positions": "abc"}, "positions has the shape () and type <U3: give rows of 3 numbers"),
        ({"positions": [[0, 1, 2], [3]]}, "positions cannot be an array"),
        ({"positions": np.empty((0, 3))}, "positions has 0 rows: give at least one"),
        ({"positions": changed(POSITIONS, np.inf)}, "1 rows are not finite; leave them out"),
        ({"faces": FACES[:, [0, 1, 2, 0]]}, "cut polygons into triangles"),
        ({"faces": []}, "faces has the shape (0,)"),
        ({"faces": FACES + 0.5}, "faces are not whole numbers: give vertex indices"),
        ({"faces": FACES - 1}, "a face uses vertex -1 of"),
        ({"faces": FACES + 1}, f"of {len(POSITIONS)}: give indices from 0"),
        ({"uv": HEAD.uv[:9]}, f"uv has 9 rows: give {len(POSITIONS)}, one for each vertex"),
        ({"uv": POSITIONS}, "give rows of 2 numbers"),
        ({"normals": changed(HEAD.normals, np.nan)}, "normals[5] = ["),
        ({"colors": POSITIONS - 9.0}, "give linear values in [0, 1] or"),
        ({"colors": np.full(POSITIONS.shape, 200)}, "colors range from 200 to 200"),
        (
            {"material": fr.Material(normal_map=fr.Texture.from_array(np.zeros((2, 2))))},
            "the material has normal_map, but the mesh has no uv: give uv",
        ),
        ({"millimetres": -1.0}, "millimetres = -1.0 is outside"),
    ],
)
def test_invalid_arrays_are_refused(given, message):
    arrays: dict[str, Any] = {"positions": POSITIONS, "faces": FACES} | given
    with pytest.raises(fr.InputError, match=re.escape(message)) as error:
        fr.Mesh.from_arrays(**arrays)
    assert "\n" not in str(error.value)


# --- textures ------------------------------------------------------------------------------------

GREY = np.linspace(0, 255, 20).astype(np.uint8).reshape(4, 5)
COLOR = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], axis=-1)
ALPHA = np.concatenate([COLOR, GREY[..., None]], axis=-1)


@pytest.mark.parametrize(
    ("texels", "expected"),
    [
        (GREY, np.repeat(GREY[..., None], 3, axis=2)),
        (GREY[..., None], np.repeat(GREY[..., None], 3, axis=2)),
        (COLOR[::-1][::-1], COLOR),
        (ALPHA, COLOR),
        (COLOR.astype(np.uint16) * 257, COLOR),
        (COLOR / 255.0, COLOR),
        ((COLOR / 255.0).astype(np.float32), COLOR),
        (GREY > 100, np.repeat(np.uint8(255) * (GREY > 100)[..., None], 3, axis=2)),
        ((COLOR / 255.0).tolist(), COLOR),
    ],
)
def test_textures_of_arrays(texels, expected):
    own = np.array(texels)
    texture = fr.Texture.from_array(own)
    own[:] = 0
    assert texture.size == (5, 4)
    np.testing.assert_array_equal(np.asarray(texture.rgb())[::-1], expected)
    np.testing.assert_array_equal(texture.levels("data").result()[0][::-1], expected)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "1", "CMYK", "I;16", "F", "LA"])
def test_textures_of_images_equal_those_of_their_files(mode, tmp_path):
    image = Image.fromarray(COLOR).convert("L" if mode == "I;16" else mode)
    if mode == "I;16":
        image = Image.fromarray(GREY.astype(np.uint16) * 257)
    texture = fr.Texture.from_image(image)
    path = tmp_path / "a.tif"
    image.save(path)
    known = np.asarray(fr.Texture.open(path).rgb())
    image.putpixel((0, 0), 0 if len(image.getbands()) == 1 else (0,) * len(image.getbands()))
    np.testing.assert_array_equal(np.asarray(texture.rgb()), known)


@pytest.mark.parametrize(
    ("texels", "message"),
    [
        (np.zeros((4, 4, 2)), "an array has the shape (4, 4, 2): give (H, W), (H, W, 3)"),
        (np.zeros((0, 4)), "has the shape (0, 4)"),
        (None, "has the shape ()"),
        (np.full((4, 4), 3.0), "has floats from 3 to 3: scale them to [0, 1], or give uint8"),
        (np.full((4, 4), np.nan), "has floats from nan to nan"),
        (np.zeros((4, 4), int), "values of type int64: give uint8, uint16, or floats"),
        ([[1, 2], [3]], "an array cannot be used"),
        (np.zeros((1, 20000), np.uint8), "at most 16384 a side"),
    ],
)
def test_invalid_texels_are_refused(texels, message):
    with pytest.raises(fr.InputError, match=re.escape(message)) as error:
        fr.Texture.from_array(texels)
    assert "\n" not in str(error.value)


def test_invalid_texture_images_are_refused(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)).save(
        tmp_path / "a.png"
    )
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:2000])
    with pytest.raises(fr.InputError, match="an image is damaged"):
        fr.Texture.from_image(Image.open(io.BytesIO((tmp_path / "b.png").read_bytes())))


# --- pickles and copies --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def everything():
    """An object of every public class, by the name of the class."""
    mesh = fr.load_mesh(MINI_HEAD)
    scene = fr.Scene(mesh, environment=fr.Environment(fr.Panorama("even", np.ones((2, 4, 3)))))
    with fr.Renderer((16, 16), samples=1) as renderer:
        frame, gbuffer = renderer.render(scene), renderer.gbuffer(scene)
        lit = fr.Scene(mesh, lights=(PLAIN["key"],))
        plan = fr.plan(lit, "16/255", renderer=renderer, cost="llvmpipe")
    return {
        "Camera": fr.Camera(azimuth=3),
        "ContextError": fr.ContextError("no OpenGL"),
        "Environment": scene.environment,
        "EnvironmentFile": fr.EnvironmentFile("studio", 30.0),
        "FacerenderError": fr.FacerenderError("wrong"),
        "FacerenderWarning": fr.FacerenderWarning("mended"),
        "Face": fr.find_face(mesh),
        "Frame": frame,
        "GBuffer": gbuffer,
        "ImageSettings": fr.ImageSettings((3, 4)),
        "InputError": fr.InputError("wrong"),
        "Job": fr.Job(fr.MeshFile("a.glb", hide="hair"), {"m": 0.2}),
        "Landmarks": fr.Landmarks(("nose",), np.array([[0, 1, 2]]), np.array([[0.2, 0.3, 0.5]])),
        "Light": fr.Light(3.0, 4.0),
        "Material": mesh.materials[0],
        "Mesh": mesh,
        "MeshFile": fr.MeshFile("a.glb", parts="head"),
        "Output": fr.Output("a.png"),
        "Panorama": scene.environment.panorama,  # type: ignore[union-attr]
        "Plan": plan,
        "Pose": fr.Pose({"jawOpen": 0.5}, track=True),
        "Registration": fr.Registration(mesh, 0.04, "mm", np.eye(4)),
        "Scene": scene,
        "Shading": fr.Shading(lobe="d16", specular_lights=[0]),
        "Term": fr.Term("ward"),
        "Texture": mesh.materials[0].albedo_map,
        "View": fr.view_of(scene, 1.0),
        "compare": fr.compare(frame.linear, frame.linear),
        "Part": mesh.parts[0],
    }


def test_every_public_class_is_tested(everything):
    classes = {name for name in fr.__all__ if isinstance(getattr(fr, name), type)}
    assert classes - {"Renderer"} <= everything.keys()


@pytest.mark.parametrize("way", ["pickle", "copy", "deepcopy"])
def test_objects_can_be_pickled_and_copied(way, everything):
    ways: dict[str, Callable[[Any], Any]] = {
        "pickle": lambda value: pickle.loads(pickle.dumps(value)),
        "copy": copy.copy,
        "deepcopy": copy.deepcopy,
    }
    for name, value in everything.items():
        assert_equal(value, ways[way](value), name)


def test_reprs_are_one_short_line(everything, renderer):
    for name, value in {**everything, "Renderer": renderer}.items():
        text = repr(value)
        assert "\n" not in text, name
        assert "array(" not in text, name
        assert len(text) < (100 if name in ("Mesh", "Part", "Texture") else 500), name


def test_a_copy_of_a_texture_stays_upright():
    texels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    texture = pickle.loads(pickle.dumps(fr.Texture.from_array(texels)))
    for kind in ("color", "data", "normal"):  # every kind of mip chain
        finest = texture.levels(kind).result()[0]
        np.testing.assert_array_equal(finest[..., :3], texels[::-1])
