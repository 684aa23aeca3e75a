"""Tests mesh files as they occur in practice. Each file is generated from a small head, loaded and
rendered, and compared with the valid file or with known values. MTL files define materials."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import facerender as fr
from facerender.drawing.prepare import resolved_parts, start_maps
from facerender.loading.obj import DEPTH
from facerender.material import SKIN_ALBEDO
from facerender.mesh.repair import joined
from tests import awkward_files as files
from tests.awkward_files import Head, flat, mini_head, texels
from tests.test_hostile_mesh import loaded
from tests.verification.fuzz.seeds import octahedron

Draw = Callable[..., NDArray[np.float32]]
Make = Callable[[Path], Path]

WHITE = (1.0, 1.0, 1.0)
# A colour in 8-bit sRGB, and its linear value by IEC 61966-2-1.
SRGB = (188, 128, 64)
LINEAR = (0.50289, 0.21586, 0.05127)


@pytest.fixture(scope="module")
def draw(renderer):
    """A function that draws a mesh from an oblique direction, so that left and right differ."""

    def draw(mesh, only=None, azimuth=20.0, **scene):
        return renderer.render(fr.Scene(mesh, fr.Camera(azimuth), **scene), only=only).linear

    return draw


@pytest.fixture(scope="module")
def control(tmp_path_factory):
    """The valid OBJ file, with a texture and without normals."""
    folder = tmp_path_factory.mktemp("control")
    return fr.load_mesh(files.write_textured_obj(folder / "mini.obj", mini_head()))


@pytest.fixture(scope="module")
def plain():
    """The valid GLB file, with normals and a repeating texture."""
    return files.repeated(fr.load_mesh(files.MINI_HEAD))


def assert_same_image(a, b, share=0.0):
    """Check that pixels agree to 1e-3, except for a fraction ``share`` at silhouettes."""
    differ = (np.abs(a - b) > 1e-3).any(axis=-1).mean()
    assert differ <= share, f"{differ:.3%} of the pixels differ, by up to {np.abs(a - b).max():g}"


def mean_albedo(view):
    return view[view[..., 3] > 0.0][:, :3].mean(axis=0, dtype=np.float64)


def angles(a, b):
    """Return the angles in degrees between rows of unit vectors."""
    chord = np.linalg.norm(a - b, axis=-1)
    return np.degrees(2.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0)))


def warned(path, message):
    """Load a mesh, and check that it causes a matching warning."""
    with pytest.warns(fr.FacerenderWarning, match=message):
        return fr.load_mesh(path)


def refused(path, message):
    with pytest.raises(fr.InputError, match=message):
        fr.load_mesh(path)


def assert_sound(mesh):
    assert np.isfinite(mesh.bounds).all()
    for part in mesh.parts:
        used = part.normals[np.unique(part.faces)]
        np.testing.assert_allclose(np.linalg.norm(used, axis=1), 1.0, atol=1e-6)


# --- formats -------------------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("write", "suffix"),
    [
        (files.write_textured_obj, ".obj"),
        (files.write_glb, ".glb"),
        (files.write_gltf, ".gltf"),
        (files.write_ply, ".ply"),
        (files.write_stl, ".stl"),
    ],
)
def test_every_format_gives_the_same_shape(write, suffix, tmp_path, plain, draw):
    mesh = fr.load_mesh(write(tmp_path / f"mini{suffix}", mini_head()))
    np.testing.assert_allclose(mesh.bounds, plain.bounds, atol=1e-7)
    assert sum(len(part.faces) for part in mesh.parts) == len(mini_head().faces)
    assert_sound(mesh)
    difference = np.abs(draw(mesh, "normal") - draw(plain, "normal"))
    assert difference[..., :3].mean() < 0.01
    assert difference[..., 3].mean() < 1e-3


def test_gltf_with_separate_files_equals_the_glb(tmp_path, plain, draw):
    mesh = fr.load_mesh(files.write_gltf(tmp_path / "mini.gltf", mini_head()))
    np.testing.assert_array_equal(draw(mesh), draw(plain))


def test_stl_from_windows(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    text = trimesh.creation.box().export(file_type="stl_ascii").replace("solid", "solid Jörg", 1)
    (tmp_path / "a.stl").write_bytes(text.encode("cp1252"))
    assert len(fr.load_mesh(tmp_path / "a.stl").parts[0].faces) == 12


def test_obj_texture_in_a_folder_with_a_space(tmp_path, control, draw):
    path = files.write_textured_obj(tmp_path / "mini.obj", mini_head())
    (tmp_path / "my maps").mkdir()
    (tmp_path / "skin.jpg").rename(tmp_path / "my maps" / "skin.jpg")
    (tmp_path / "mini.mtl").write_text(files.SKIN_MTL.format(texture="my maps/skin.jpg"))
    np.testing.assert_array_equal(draw(fr.load_mesh(path)), draw(control))


# --- missing textures and MTL files --------------------------------------------------------------


def test_missing_texture(tmp_path, draw):
    path = files.write_obj(tmp_path / "mini.obj", mini_head(), mtl="mini.mtl")
    (tmp_path / "mini.mtl").write_text(files.SKIN_MTL.format(texture="not_here.jpg"))
    mesh = warned(path, r"not_here\.jpg \(named by mini\.obj\) not found in .*--albedo FILE")
    np.testing.assert_allclose(mean_albedo(draw(mesh, "albedo")), SKIN_ALBEDO, rtol=1e-5)


def test_missing_texture_of_a_glb(tmp_path, draw):
    path = files.write_glb(tmp_path / "mini.glb", mini_head(), image={"uri": "missing.png"})
    mesh = warned(path, r"missing\.png \(named by mini\.glb\) not found")
    assert mesh.materials[0].albedo_map is None
    assert np.isfinite(draw(mesh)).all()


@pytest.mark.slow
def test_missing_mtl_suggests_the_image_in_its_folder(tmp_path, control, draw):
    path = files.write_textured_obj(tmp_path / "mini.obj", mini_head())
    (tmp_path / "mini.mtl").unlink()
    mesh = warned(path, r"mini\.mtl .* not found in .*: .*; pass --albedo skin\.jpg")
    # trimesh would put a grey image of 2 x 2 texels here.
    assert mesh.materials[0].albedo_map is None
    np.testing.assert_allclose(mean_albedo(draw(mesh, "albedo")), SKIN_ALBEDO, rtol=1e-5)

    remedied = fr.load_mesh(path, albedo=tmp_path / "skin.jpg")  # must not warn
    np.testing.assert_array_equal(draw(remedied), draw(control))


def test_no_texture_coordinates(tmp_path, draw):
    path = files.write_obj(tmp_path / "mini.obj", mini_head(), uv=False)
    mesh = fr.load_mesh(path)
    np.testing.assert_allclose(mean_albedo(draw(mesh, "albedo")), SKIN_ALBEDO, rtol=1e-5)
    skin = tmp_path / "skin.png"
    mini_head().image.save(skin)
    with pytest.raises(
        fr.InputError, match=r"mini\.obj has no texture coordinates, which skin\.png needs; unwrap"
    ):
        fr.load_mesh(path, albedo=skin)


def test_texture_without_texture_coordinates(tmp_path):
    path = files.write_textured_obj(tmp_path / "mini.obj", mini_head(), uv=False)
    warned(path, r"mini\.obj has no texture coordinates: its texture is ignored")


def test_flip_v(tmp_path, control, draw):
    upside_down = replace(mini_head(), uv=mini_head().uv * (1, -1) + (0, 1))
    path = files.write_textured_obj(tmp_path / "mini.obj", upside_down)
    assert np.abs(draw(fr.load_mesh(path), "albedo") - draw(control, "albedo")).mean() > 0.01
    assert_same_image(draw(fr.load_mesh(path, flip_v=True)), draw(control))


# --- geometry that needs repair ------------------------------------------------------------------


def with_bad_vertices(head):
    positions = head.positions.copy()
    positions[10], positions[50, 1] = np.nan, np.inf
    return head.with_positions(positions)


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("write", "suffix"), [(files.write_textured_obj, ".obj"), (files.write_glb, ".glb")]
)
def test_non_finite_vertices(write, suffix, tmp_path, draw):
    path = write(tmp_path / f"mini{suffix}", with_bad_vertices(mini_head()))
    lost = int(np.isin(mini_head().faces, (10, 50)).any(axis=1).sum())
    mesh = warned(path, rf"mini{suffix} has 2 non-finite vertices: {lost} faces dropped")
    assert_sound(mesh)
    sound = fr.load_mesh(write(tmp_path / f"sound{suffix}", mini_head()))
    assert sum(len(part.faces) for part in mesh.parts) == len(mini_head().faces) - lost
    assert_same_image(draw(mesh), draw(sound), share=0.01)


@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
@pytest.mark.parametrize("factor", [np.nan, 0.0])
def test_no_face_that_can_be_drawn(factor, tmp_path):
    head = mini_head().with_positions(mini_head().positions * factor)
    path = files.write_obj(tmp_path / "mini.obj", head)
    refused(path, r"no face of mini\.obj has a finite, non-zero area")


def test_degenerate_and_duplicated_faces(tmp_path, control, draw):
    head = mini_head()
    degenerate = [(5, 5, 9), (7, 9, 7), (3, 3, 3)]
    faces = np.concatenate([head.faces, head.faces[100:150], degenerate])
    path = files.write_textured_obj(tmp_path / "mini.obj", head.with_faces(faces))
    mesh = warned(path, r"mini\.obj has 3 degenerate faces: dropped")
    assert_sound(mesh)
    # Duplicated faces slightly change the normals at their borders.
    assert np.abs(draw(mesh) - draw(control)).mean() < 1e-3


@pytest.mark.parametrize("end", ["-8e25 1.4 0", "0 1e-170 0"], ids=["far out", "thin"])
def test_face_whose_area_rounds_to_zero(end, tmp_path):
    """The result must not depend on the order of the face's corners."""
    path = tmp_path / "a.obj"
    places = [end, "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    path.write_text("".join(f"v {place}\n" for place in places) + "f 1 2 3\nf 3 2 1\nf 2 3 4\n")
    with pytest.warns(fr.FacerenderWarning) as warned_of:
        mesh = fr.load_mesh(path)
    assert "a.obj has 2 degenerate faces: dropped" in [str(each.message) for each in warned_of]
    assert len(mesh.parts[0].faces) == 1


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("scale", "offset"), [(1e3, 1e6), (1e-6, 0.0), (1e12, 0.0)], ids=["mm", "micrometre", "huge"]
)
def test_scale_and_position_do_not_change_the_image(scale, offset, tmp_path, control, draw):
    head = mini_head().with_positions(mini_head().positions * scale + offset)
    mesh = fr.load_mesh(files.write_textured_obj(tmp_path / "mini.obj", head))
    assert_same_image(draw(mesh), draw(control), share=1e-4)
    depth, expected = draw(mesh, "depth"), draw(control, "depth")
    np.testing.assert_allclose(depth[..., 0] / scale, expected[..., 0], rtol=1e-4)


def flipped(head, every):
    faces = head.faces.copy()
    faces[::every] = faces[::every, ::-1]
    return head.with_faces(faces)


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("every", "warning"),
    [
        (1, r"faces of mini\.obj are inside out: turned"),
        (2, r"mini\.obj has faces wound both ways: 3361 of 6722 turned"),
    ],
    ids=["inverted", "mixed"],
)
def test_winding_without_normals(every, warning, tmp_path, control, draw):
    path = files.write_textured_obj(tmp_path / "mini.obj", flipped(mini_head(), every))
    mesh = warned(path, warning)
    assert_same_image(draw(mesh), draw(control))


@pytest.mark.parametrize("every", [1, 2], ids=["inverted", "mixed"])
def test_winding_against_good_normals(every, tmp_path, plain, draw):
    mesh = fr.load_mesh(files.write_glb(tmp_path / "mini.glb", flipped(mini_head(), every)))
    assert_same_image(draw(mesh), draw(plain))


def test_faces_and_normals_both_inside_out(tmp_path, plain, draw):
    head = replace(flipped(mini_head(), 1), normals=-mini_head().normals)
    path = files.write_glb(tmp_path / "mini.glb", head)
    mesh = warned(path, r"faces of mini\.glb are inside out: turned")
    assert_same_image(draw(mesh), draw(plain))


def test_normals_of_zero_length(tmp_path, control, draw):
    zero = np.zeros_like(mini_head().normals)
    path = files.write_textured_obj(tmp_path / "mini.obj", mini_head(), normals=zero)
    mesh = warned(path, r"mini\.obj has 3444 normals of zero length: all recomputed")
    assert_same_image(draw(mesh), draw(control))


# --- normals -------------------------------------------------------------------------------------


def test_normals_of_an_obj_are_read(tmp_path, plain, draw):
    path = files.write_textured_obj(tmp_path / "mini.obj", mini_head(), normals=mini_head().normals)
    assert_same_image(draw(fr.load_mesh(path)), draw(plain.with_material(double_sided=True)))


def test_computed_normals_have_no_seam(control):
    (part,) = control.parts
    _, first, same = np.unique(part.positions, axis=0, return_index=True, return_inverse=True)
    assert len(first) < len(part.positions)  # the texture's seam splits vertices
    np.testing.assert_array_equal(part.normals, part.normals[first][same.reshape(-1)])


def sphere(rings=24):
    """Return a unit sphere, split at a seam and at the poles, where rounding changes x slightly."""
    theta, phi = np.meshgrid(
        np.linspace(0.0, np.pi, rings + 1), np.linspace(0.0, 2.0 * np.pi, 2 * rings + 1)
    )
    points = np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1
    ).reshape(-1, 3)
    corner = (np.arange(2 * rings)[:, None] * (rings + 1) + np.arange(rings)).reshape(-1)
    right, below = corner + rings + 1, corner + 1
    upper = np.stack([corner, below, right], axis=1)
    lower = np.stack([right, below, below + rings + 1], axis=1)
    upper, lower = upper[corner % (rings + 1) > 0], lower[below % (rings + 1) < rings]
    uv = np.stack([phi, theta], axis=-1).reshape(-1, 2)
    return Head(points, points, uv, np.concatenate([upper, lower]), b"")


def test_computed_normals_do_not_depend_on_the_triangulation(tmp_path):
    """At the corners of a box, its sides have equal weight, whatever their size and triangles."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    squares = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    faces = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    head = Head(corners * (1.0, 2.0, 3.0), corners, corners[:, :2], faces, b"")
    (part,) = fr.load_mesh(files.write_obj(tmp_path / "box.obj", head, uv=False)).parts
    np.testing.assert_allclose(part.normals, np.sign(part.positions) / 3.0**0.5, atol=1e-12)


def test_computed_normals_of_a_sphere_point_outwards(tmp_path):
    mesh = fr.load_mesh(files.write_obj(tmp_path / "sphere.obj", sphere()))
    (part,) = mesh.parts
    used = np.unique(part.faces)
    assert angles(part.normals[used], part.positions[used]).max() < 0.5


# --- the scene graph -----------------------------------------------------------------------------


@pytest.mark.parametrize("normals", [True, False])
def test_mirrored_node_mirrors_the_image(normals, tmp_path, plain, draw):
    """The mirror turns the faces, which must not cause a warning about inverted faces."""
    nodes = [{"scale": [-1, 1, 1]}]
    path = files.write_glb(tmp_path / "mirrored.glb", mini_head(), nodes, normals=normals)
    if not normals:
        plain = fr.load_mesh(files.write_glb(tmp_path / "plain.glb", mini_head(), normals=False))
    lights = (fr.Light(-40.0, 30.0, 3.0),)
    mirrored_lights = (fr.Light(40.0, 30.0, 3.0),)
    picture = draw(fr.load_mesh(path), azimuth=25.0, lights=mirrored_lights)
    assert_same_image(picture[:, ::-1], draw(plain, azimuth=-25.0, lights=lights), share=2e-3)


def test_node_of_scale_0_is_hidden(tmp_path, plain, draw):
    path = files.write_glb(tmp_path / "mini.glb", mini_head(), [{"scale": [0, 0, 0]}, {}])
    mesh = warned(path, r"mini\.glb has 6722 degenerate faces: dropped")
    assert_same_image(draw(mesh), draw(plain))


def test_two_materials(tmp_path, control, draw):
    head = mini_head()
    groups = {"skin": ~head.upper, "scalp": head.upper}
    path = files.write_textured_obj(tmp_path / "two.obj", head, groups=groups)
    with path.with_suffix(".mtl").open("a") as mtl:
        mtl.write("newmtl scalp\nKd {} {} {}\n".format(*(value / 255 for value in SRGB)))
    mesh = fr.load_mesh(path)
    assert len(mesh.parts) == 2

    albedo, expected = draw(mesh, "albedo"), draw(control, "albedo")
    scalp = np.isclose(albedo[..., :3], LINEAR, atol=1e-4).all(axis=-1)
    covered = albedo[..., 3] > 0.0
    assert 0.2 < scalp.sum() / covered.sum() < 0.8
    assert_same_image(albedo[~scalp], expected[~scalp], share=0.01)

    # Normals are smooth across the border, as in one part.
    assert_same_image(draw(mesh, "normal"), draw(control, "normal"), share=1e-4)
    one, other = ({tuple(p): n for p, n in border(part)} for part in mesh.parts)
    common = one.keys() & other.keys()
    assert len(common) > 50
    for position in common:
        np.testing.assert_allclose(one[position], other[position], atol=1e-12)


def border(part):
    used = np.unique(part.faces)
    return zip(part.positions[used], part.normals[used], strict=True)


# --- textures ------------------------------------------------------------------------------------


def textured(folder, texture):
    path = files.write_obj(folder / "mini.obj", mini_head(), mtl="mini.mtl")
    (folder / "mini.mtl").write_text(files.SKIN_MTL.format(texture=texture))
    return fr.load_mesh(path)


def half_transparent():
    """Return the skin with an alpha channel that is 0 in one half."""
    image = mini_head().image.convert("RGBA")
    alpha = np.full((image.height, image.width), 255, np.uint8)
    alpha[: image.height // 2] = 0
    image.putalpha(Image.fromarray(alpha))
    return image


def palette():
    image = mini_head().image.quantize(256)
    image.info["transparency"] = 3
    return image


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("name", "image", "tolerance"),
    [
        ("skin.png", lambda: mini_head().image, 1e-6),
        ("rgba.png", half_transparent, 1e-6),
        ("palette.png", palette, 0.02),
        ("cmyk.jpg", lambda: mini_head().image.convert("CMYK"), 0.02),
        ("skin.tif", lambda: mini_head().image, 1e-6),
    ],
)
def test_image_modes(name, image, tolerance, tmp_path, control, draw):
    """The tolerance is the mean error of linear albedo due to 256 colours or JPEG."""
    image().save(tmp_path / name)
    albedo, expected = draw(textured(tmp_path, name), "albedo"), draw(control, "albedo")
    assert np.abs(albedo - expected).mean() < tolerance


def test_grey_image(tmp_path, draw):
    grey = mini_head().image.convert("L")
    grey.save(tmp_path / "grey.png")
    grey.convert("RGB").save(tmp_path / "rgb.png")
    albedo = draw(textured(tmp_path, "grey.png"), "albedo")
    np.testing.assert_array_equal(albedo, draw(textured(tmp_path, "rgb.png"), "albedo"))
    assert np.ptp(albedo[..., 0][albedo[..., 3] > 0]) > 0.1


@pytest.mark.first_case
@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_image_of_16_bits(mode, tmp_path, draw):
    image = mini_head().image.convert(mode)
    image.save(tmp_path / "eight.png")
    texels = np.asarray(image).astype(np.uint16) * 257
    if mode == "RGB":
        files.write_png16(tmp_path / "sixteen.png", texels)
    else:
        Image.fromarray(texels).save(tmp_path / "sixteen.png")
    np.testing.assert_array_equal(
        draw(textured(tmp_path, "sixteen.png"), "albedo"),
        draw(textured(tmp_path, "eight.png"), "albedo"),
    )


def test_albedo_map_is_srgb(tmp_path, draw):
    Image.new("RGB", (4, 4), SRGB).save(tmp_path / "flat.png")
    albedo = draw(textured(tmp_path, "flat.png"), "albedo")
    # Drivers may decode sRGB with an error of half an 8-bit level.
    np.testing.assert_allclose(mean_albedo(albedo), LINEAR, atol=0.5 / 255)


def test_texture_that_is_not_an_image(tmp_path):
    (tmp_path / "page.jpg").write_text("<html>404 not found</html>")
    with pytest.raises(fr.InputError, match=r"page\.jpg \(named by mini\.obj\) .*--albedo FILE"):
        textured(tmp_path, "page.jpg")


def test_embedded_texture_that_is_not_an_image(tmp_path):
    path = files.write_glb(tmp_path / "mini.glb", replace(mini_head(), skin=b"<html></html>"))
    refused(path, r"mini\.glb.* not an image")


# --- colours and factors -------------------------------------------------------------------------


def test_ply_vertex_colors_are_srgb(tmp_path, draw):
    colors = np.tile(np.uint8([*SRGB, 255]), (3444, 1))
    mesh = fr.load_mesh(files.write_ply(tmp_path / "mini.ply", mini_head(), colors))
    np.testing.assert_allclose(mean_albedo(draw(mesh, "albedo")), LINEAR, atol=1e-4)


def test_vertex_colors_stay_with_their_vertices(tmp_path):
    heights = mini_head().positions[:, 1]
    top = heights > np.median(heights)
    colors = np.where(top[:, None], np.uint8([255, 0, 0, 255]), np.uint8([0, 0, 255, 255]))
    mesh = fr.load_mesh(files.write_ply(tmp_path / "mini.ply", mini_head(), colors))
    (part,) = mesh.parts
    assert part.colors is not None
    red = part.positions[:, 1] > np.median(heights)
    np.testing.assert_array_equal(part.colors, np.where(red[:, None], (1, 0, 0), (0, 0, 1)))


# --- files without a mesh ------------------------------------------------------------------------


def content(data):
    def make(path):
        path.write_bytes(data)
        return path

    return make


def changed_glb(**tables):
    def make(path):
        document, binary = files.gltf(mini_head())
        document |= tables
        path.write_bytes(files.join_glb(document, binary))
        return path

    return make


def cut_ply(path):
    data = files.write_ply(path, mini_head()).read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def missing_buffer(path):
    files.write_gltf(path, mini_head()).with_suffix(".bin").unlink()
    return path


BROKEN = [
    ("points.obj", content(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "only points and no faces; give a tri"),
    ("garbage.obj", content(np.random.default_rng(1).bytes(2000)), "has no geometry"),
    ("flat.obj", content(b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"), "is damaged"),
    ("nothing.glb", changed_glb(meshes=[]), "has no mesh"),
    ("unused.glb", changed_glb(nodes=[], scenes=[{}]), "has no geometry"),
    ("hidden.glb", changed_glb(nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "no face of"),
    ("mini.gltf", missing_buffer, r"mini\.bin"),
    ("short.ply", cut_ply, "or lacks bytes: export it"),
    ("text.ply", content(b"hello"), "is damaged"),
]


@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
@pytest.mark.parametrize(("name", "make", "message"), BROKEN)
def test_broken_file(name, make, message, tmp_path):
    path = make(tmp_path / name)
    with pytest.raises(fr.InputError, match=message) as caught:
        fr.load_mesh(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


# --- several parts -------------------------------------------------------------------------------


def boxes(texture):
    """Return four boxes side by side, as bytes of a GLB file."""
    scene = trimesh.Scene()
    for number in range(4):
        box = trimesh.creation.box()
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=texture)
        box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] + 0.5, material=material)
        box.apply_translation([2.0 * number, 0, 0])
        scene.add_geometry(box)
    return scene.export(file_type="glb")


def test_parts_that_share_an_image(tmp_path):
    pixels = np.random.default_rng(5).integers(0, 256, (512, 512, 3), dtype=np.uint8)
    (tmp_path / "boxes.glb").write_bytes(boxes(Image.fromarray(pixels)))
    for _ in range(5):
        mesh = fr.load_mesh(tmp_path / "boxes.glb")
        start_maps(resolved_parts(mesh))
        for material in mesh.materials:
            assert material.albedo_map is not None
            texels = material.albedo_map.levels("color").result()[0]
            np.testing.assert_array_equal(texels[::-1, :, :3], pixels)
        assert len({id(material.albedo_map) for material in mesh.materials}) == 1


# --- Draco ---------------------------------------------------------------------------------------


def test_draco_without_its_package(tmp_path, monkeypatch):
    path = files.write_draco(tmp_path / "mini.glb", mini_head())
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    refused(path, r"mini\.glb is compressed with Draco: pip install DracoPy")


# --- MTL files ------------------------------------------------------------------------------------


def load(folder, mtl, head=octahedron(), **images):
    """Load a mesh with an MTL file for the material skin; ``images`` are saved as PNG files."""
    for name, image in images.items():
        image.save(folder / f"{name}.png")
    (folder / "a.mtl").write_text(f"newmtl skin\n{mtl}\n")
    return loaded(files.write_obj(folder / "a.obj", head, mtl="a.mtl"))


def material(folder, mtl, **images):
    """Load an MTL file without warnings, and return the material."""
    mesh, messages = load(folder, mtl, **images)
    assert messages == []
    return mesh.materials[0]


@pytest.mark.parametrize(("encoding", "name"), [("utf-8-sig", "größe"), ("cp1252", "größe…")])
def test_names_beyond_ascii(encoding, name, tmp_path):
    """Neither OBJ nor MTL files state their encoding."""
    Image.new("RGB", (2, 2), "red").save(tmp_path / f"{name}.png")
    path = files.write_obj(tmp_path / "a.obj", octahedron(), mtl=f"{name}.mtl")
    text = f"newmtl skin\nmap_Kd {name}.png\n"
    (tmp_path / f"{name}.mtl").write_bytes(text.encode(encoding))
    path.write_bytes(path.read_text("utf-8").encode(encoding))
    mesh, messages = loaded(path)
    assert messages == []
    assert (texels(mesh.materials[0].albedo_map) == (255, 0, 0)).all()


def test_factors(tmp_path):
    found = material(tmp_path, "Kd 0.5 0.5 0.5\nKs 0.4 0.2 0.3\nNs 30\nKe 1 0 0\nd 0.25\nillum 2")
    assert found.albedo == pytest.approx((0.2140411,) * 3)
    assert found.ks == pytest.approx(0.3)
    assert found.m == pytest.approx(0.25)  # sqrt(2 / 32)
    assert found.emissive == (1.0, 0.0, 0.0)
    assert (found.alpha, found.opacity) == ("blend", 0.25)
    assert material(tmp_path, "Pr 0.5\nNs 30").m == 0.25
    assert material(tmp_path, "Tr 0.75").opacity == 0.25
    assert material(tmp_path, "d 0.5\nTr 0.9").opacity == 0.5
    assert material(tmp_path, "d -halo 0.5").opacity == 0.5
    assert material(tmp_path, "Ks 1 1 1\nNs 0").m == fr.Material().m


def test_unsupported_statements_warn(tmp_path):
    for mtl, message in (
        ("Tr 1", "Tr 1 in its MTL"),
        ("Tf 0.5 0.5 0.5", "Tf"),
        ("refl sphere.png", "has refl in its MTL: ignored"),
        ("disp deep.png", "has disp in its MTL: ignored"),
        ("Pm 1", "has pm in its MTL: ignored"),
        ("map_Ns x.png", "has map_ns in its MTL: ignored"),
        ("Kd spectral file.rfl", "has kd spectral file.rfl in its MTL: ignored"),
        ("d nan", "has d nan in its MTL: ignored"),
        ("Kd 2 0 0", "kd 2 in the MTL of a.obj is outside [0, 1]: clamped"),
        ("map_Kd -cc on skin.png", "the albedo map of a.obj has the option -cc: ignored"),
        ("map_Kd -t 1 1 1 skin.png", "the albedo map of a.obj has the option -t: ignored"),
    ):
        messages = load(tmp_path, mtl, skin=flat(1, 2, 3))[1]
        assert len(messages) == 1, mtl
        assert message in messages[0]
    for mtl in ("Pm 0\nNi 1.5\nTf 1 1 1\nKa 0 0 0", "map_Kd -mm 0 1 -cc off skin.png"):
        material(tmp_path, mtl)


def test_maps_and_the_options_before_their_names(tmp_path):
    mtl = """map_Kd -s 2 3 1 -o 0.5 -clamp on my skin.png
map_d cut.png
map_Ks -imfchan g shine.png
map_Ke -s 2 3 -o 0.5 0 glow.png
map_Pr rough.png
norm -bm 0.5 normal.png"""
    images = {"my skin": flat(1, 2, 3), "cut": flat(9, 9, 9, 60), "shine": flat(1, 77, 3)}
    images |= {"glow": flat(4, 5, 6), "rough": flat(128), "normal": flat(128, 128, 255)}
    mesh, messages = load(tmp_path, mtl, **images)
    assert len(messages) == 4
    assert messages[0].startswith(
        "cut.png (named by a.obj) has other options -s and -o than my skin"
    )
    found, part = mesh.materials[0], mesh.parts[0]
    assert found.albedo_map.sampling == (("clamp", "clamp"), False)
    for name, value in (
        ("albedo", [1, 2, 3]),
        ("opacity", 60),
        ("specular", 77),
        ("emissive", [4, 5, 6]),
        ("roughness", 128),
        ("normal", [128, 128, 255]),
    ):
        assert (texels(getattr(found, f"{name}_map")) == value).all(), name
    assert (found.alpha, found.alpha_cutoff, found.normal_strength) == ("mask", 0.5, 0.5)
    assert found.emissive == (1.0, 1.0, 1.0)
    assert (found.second_uv, part.uv2) == ((), None)
    plain = load(tmp_path, "map_Kd cut.png")[0].parts[0].uv
    np.testing.assert_allclose(part.uv, plain * (2, 3) + (0.5, 0))


def test_opacity_map_without_alpha_uses_its_grey(tmp_path):
    assert (texels(material(tmp_path, "map_d cut.png", cut=flat(60)).opacity_map) == 60).all()


def waves(mode):
    """Return a height map: a sine with eight periods along u, from 0 to the maximum."""
    u = (np.arange(256) + 0.5) / 256
    heights = np.tile(0.5 + 0.5 * np.sin(2 * np.pi * 8 * u), (64, 1))
    if mode == "16 bits":
        return Image.fromarray(np.round(heights * 65535).astype(np.uint16))
    return Image.fromarray(np.round(heights * 255).astype(np.uint8)).convert(mode)


@pytest.mark.parametrize("mode", ["L", "RGB", "16 bits"])
@pytest.mark.parametrize("key", ["map_Bump", "bump"])
def test_heights_become_normals(key, mode, tmp_path):
    """The slope is the derivative of the sine; the multiplier becomes the material's strength."""
    found = material(tmp_path, f"{key} -bm 3 wave.png", wave=waves(mode))
    assert found.normal_strength == 3.0
    normals = texels(found.normal_map) / 127.5 - 1.0
    u = (np.arange(256) + 0.5) / 256
    expected = -np.pi * 8 * np.cos(2 * np.pi * 8 * u) * DEPTH
    slopes = -(normals[..., 0] / normals[..., 2])[32, 1:-1]
    np.testing.assert_allclose(slopes, -expected[1:-1], atol=0.02)
    np.testing.assert_allclose(normals[..., 1], 0.0, atol=0.01)


def test_green_is_up(tmp_path):
    """If the height grows upwards, the normal tilts down."""
    ramp = Image.new("L", (8, 64))
    ramp.paste(255, (0, 0, 8, 32))
    normals = texels(material(tmp_path, "bump ramp.png", ramp=ramp).normal_map)
    assert normals[..., 1].max() <= 128
    assert (normals[31:33, :, 1] < 120).all()


def test_a_bump_map_may_be_a_normal_map(tmp_path):
    """MakeHuman writes normal maps as map_Bump; they are detected by their colours."""
    slopes = np.random.default_rng(0).normal(0.0, 0.2, (32, 32, 2))
    unit = np.concatenate([slopes, np.ones((32, 32, 1))], axis=-1)
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    image = Image.fromarray(np.round(unit * 127.5 + 127.5).astype(np.uint8))
    found = material(tmp_path, "map_Bump normal.png", normal=image)
    np.testing.assert_array_equal(texels(found.normal_map), np.asarray(image)[::-1])


def test_a_udim_tile_on_several_tiles_causes_a_warning(tmp_path):
    head = mini_head()
    Image.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "skin.1001.png")
    (tmp_path / "a.mtl").write_text("newmtl skin\nmap_Kd skin.1001.png\n")
    for width, tiles in ((0.999, 1), (1.999, 2)):
        wide = replace(head, uv=np.clip(head.uv, 0.0, 1.0) * (width, 0.999))
        messages = loaded(files.write_obj(tmp_path / "a.obj", wide, mtl="a.mtl"))[1]
        assert ["drawn on all 2 tiles" in each for each in messages] == [True] * (tiles - 1)


def test_libraries_of_several_names(tmp_path):
    head = mini_head()
    (tmp_path / "a.mtl").write_text("newmtl skin\nd 0.5\n")
    (tmp_path / "b.mtl").write_text("newmtl scalp\nd 0.25\n")
    groups = {"skin": head.upper, "scalp": ~head.upper}
    path = files.write_obj(tmp_path / "a.obj", head, mtl="a.mtl b.mtl", groups=groups)
    mesh, messages = loaded(path)
    assert messages == []
    assert sorted(each.opacity for each in mesh.materials) == [0.25, 0.5]


def test_damaged_bump_map_is_refused(tmp_path):
    buffer = BytesIO()
    waves("RGB").save(buffer, "PNG")
    (tmp_path / "wave.png").write_bytes(buffer.getvalue()[:-60])
    (tmp_path / "a.mtl").write_text("newmtl skin\nbump wave.png\n")
    mesh, _ = loaded(files.write_obj(tmp_path / "a.obj", octahedron(), mtl="a.mtl"))
    with pytest.raises(fr.InputError, match=r"wave\.png is damaged"):
        mesh.materials[0].normal_map.rgb()


def test_hostile_statements(tmp_path):
    """Invalid statements cause no exception."""
    for mtl in ("map_Kd", "map_Kd -s", "bump -bm", "Ns inf", "Ke 1e308 0 0", "d 1e400", "Ks -1"):
        mesh, _ = load(tmp_path, mtl)
        assert math.isfinite(mesh.materials[0].m)


@pytest.mark.parametrize("edges", [0, 500, 1000, 3000])
def test_connected_components_are_those_of_scipy(edges):
    pairs = np.random.default_rng(edges).integers(0, 2000, (edges, 2))
    graph = coo_array((np.ones(edges), pairs.T), shape=(2000, 2000))
    _, label = connected_components(graph, directed=False)
    _, first, index = np.unique(label, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(joined(pairs, 2000), first[index])
