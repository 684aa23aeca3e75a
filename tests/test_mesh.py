"""Tests mesh files as they occur in practice. Each file is generated from a small head, loaded and
rendered, and compared with the valid file or with known values."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import facerender as fr
from facerender.drawing.prepare import start_maps
from facerender.scenes.material import SKIN_ALBEDO
from facerender.scenes.repair import joined
from tests import awkward_files as files
from tests.awkward_files import Head, mini_head

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


def test_suffix_in_capitals(tmp_path):
    assert fr.load_mesh(files.write_ply(tmp_path / "MINI.PLY", mini_head())).name == "MINI.PLY"


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


def test_normalised_mesh_fits_the_unit_sphere(control):
    points = control.normalised(control.parts[0].positions)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(points.min(axis=0) + points.max(axis=0), 0.0, atol=1e-12)


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


@pytest.mark.parametrize("edges", [0, 500, 1000, 3000])
def test_connected_components_are_those_of_scipy(edges):
    pairs = np.random.default_rng(edges).integers(0, 2000, (edges, 2))
    graph = coo_array((np.ones(edges), pairs.T), shape=(2000, 2000))
    _, label = connected_components(graph, directed=False)
    _, first, index = np.unique(label, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(joined(pairs, 2000), first[index])


def test_a_long_path_in_any_order_is_one_component():
    path = np.random.default_rng(1).permutation(100_000)
    assert not joined(np.stack([path[:-1], path[1:]], axis=1), len(path)).any()


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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* wound both ways")
def test_computed_normals_of_the_scan_agree_with_its_own(scan, tmp_path):
    (given,) = fr.load_mesh(scan / "LeePerrySmith.glb").parts
    assert given.uv is not None
    faces = given.faces.astype(np.int64)
    stripped = Head(given.positions, given.normals, given.uv, faces, b"")
    mesh = fr.load_mesh(files.write_obj(tmp_path / "scan.obj", stripped))
    angle = angles(mesh.parts[0].normals, given.normals)
    print(f"{angle.mean():.4f} degrees on average, at most {angle.max():.3f}")
    assert angle.max() < 0.05


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


def test_roughness_and_occlusion_of_a_glb(tmp_path, renderer):
    """Roughness and occlusion are green and red of one image, and m is the roughness squared."""
    Image.new("RGB", (8, 8), (51, 128, 0)).save(tmp_path / "orm.png")
    material = {
        "pbrMetallicRoughness": {
            "metallicRoughnessTexture": {"index": 0},
            "roughnessFactor": 0.8,
        },
        "occlusionTexture": {"index": 0},
    }
    image = {"uri": "orm.png"}
    path = files.write_glb(tmp_path / "mini.glb", mini_head(), material=material, image=image)
    gbuffer = renderer.gbuffer(fr.Scene(fr.load_mesh(path)))
    covered = gbuffer.part >= 0
    np.testing.assert_allclose(gbuffer.m[covered], (0.8 * 128 / 255) ** 2, rtol=1e-3)
    np.testing.assert_allclose(gbuffer.occlusion[covered], 0.2, rtol=1e-3)


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
    ("short.ply", cut_ply, "is damaged"),
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
        start_maps(mesh)
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
