"""Tests the cache of meshes and plans: results are bitwise equal to those without it, never stale,
and robust against damage, concurrent writers and folders that are full or not writable."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import loading
from facerender.commands import main
from facerender.system import cache
from facerender.system.files import data_dir
from tests import awkward_files as files
from tests.awkward_files import MINI_HEAD, assert_equal, mini_head
from tests.meshes import with_geometry
from tests.test_cli import assert_error
from tests.test_gltf_features import File
from tests.verification.cache import wait_for_cache

SMALL = ("--size", "48", "--samples", "1", "--light", "key,radius=0,no-shadow")


@pytest.fixture(autouse=True)
def place(cache_folder):
    return cache_folder


@pytest.fixture
def reads(monkeypatch):
    """The list of mesh files that were read instead of taken from the cache."""
    seen = []

    def spy(data, *options):
        seen.append(data)
        return read(data, *options)

    read = loading._pieces
    monkeypatch.setattr(loading, "_pieces", spy)
    return seen


def load(*args, **options):
    mesh = fr.load_mesh(*args, cache=True, **options)
    wait_for_cache()
    return mesh


def entries(place):
    return sorted(place.glob("meshes/*"))


def textured(folder):
    folder.mkdir(exist_ok=True)
    return files.write_textured_obj(folder / "head.obj", mini_head())


def assert_same(mesh, other):
    """Check that meshes are bitwise equal, including face, regions and the mip levels of their
    maps."""
    assert_equal(with_geometry(mesh), with_geometry(other), "mesh")
    assert_equal(fr.find_face(mesh), fr.find_face(other), "face")
    for name, region in mesh.regions.items():
        assert_equal(region, other.regions[name], name)
    for materials in zip(mesh.materials, other.materials, strict=True):
        for name in ("albedo_map", "normal_map", "property_map"):
            maps = [getattr(material, name) for material in materials]
            for kind in ("color", "normal", "data"):
                assert_equal(*([each and each.levels(kind).result() for each in maps]), name)


def textures_of_files(folder):
    """Write maps of different sizes; return their paths by option name."""
    rng = np.random.default_rng(5)
    made = {}
    for name, shape in (
        ("albedo", (9, 7, 3)),
        ("specular_map", (5, 8)),
        ("roughness_map", (4, 4, 3)),
        ("normal_map", (6, 6, 3)),
    ):
        made[name] = folder / f"{name}.png"
        Image.fromarray(rng.integers(0, 256, shape, dtype=np.uint8)).save(made[name])
    return made


def colored(folder):
    colors = np.random.default_rng(1).integers(0, 256, (len(mini_head().positions), 4))
    return files.write_ply(folder / "head.ply", mini_head(), colors.astype(np.uint8))


def second_uv(folder):
    """Write a .glb file with second texture coordinates, and factors in most fields."""
    file = File()
    file.attributes["TEXCOORD_1"] = file.accessor((0.5 * mini_head().uv).astype("<f4"))
    occlusion = {**file.texture(files.flat(128)), "texCoord": 1, "strength": 0.25}
    file.material |= {"alphaMode": "BLEND", "occlusionTexture": occlusion, "doubleSided": True}
    file.material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.5]
    return file.write(folder)


CASES = {
    "head": lambda folder: (None, {}),
    "obj": lambda folder: (textured(folder / "in"), {}),
    "gltf": lambda folder: (files.write_gltf(folder / "head.gltf", mini_head()), {}),
    "second uv": lambda folder: (second_uv(folder), {}),
    "ply": lambda folder: (colored(folder), {}),
    "stl": lambda folder: (files.write_stl(folder / "head.stl", mini_head()), {}),
    "maps": lambda folder: (MINI_HEAD, textures_of_files(folder)),
    "flipped": lambda folder: (MINI_HEAD, {"flip_v": True}),
}


@pytest.mark.first_case
@pytest.mark.parametrize("case", CASES)
def test_cached_mesh_equals_the_loaded_one(case, tmp_path, reads, place):
    path, options = CASES[case](tmp_path)
    plain = fr.load_mesh(path, **options)
    first = load(path, **options)
    assert len(entries(place)) == 1
    cached = load(path, **options)
    assert len(reads) == 2
    assert_same(plain, first)
    assert_same(plain, cached)
    for part in cached.parts:
        assert part.positions.flags.writeable


def test_a_face_is_found_once(tmp_path, monkeypatch):
    path = files.write_gltf(tmp_path / "head.gltf", mini_head())
    face = fr.find_face(load(path))
    monkeypatch.setattr("facerender.mesh.framing.framing_of", None)
    mesh = load(path).with_material(m=0.2)
    assert mesh.regions["eyes"] is not None
    assert face is not None
    assert_equal(fr.find_face(mesh), face, "face")
    with pytest.raises(TypeError):  # the search is not called elsewhere
        fr.find_face(fr.load_mesh(path))


@pytest.mark.slow
def test_the_command_draws_the_same_bits_and_imports_neither_trimesh_nor_pillow(tmp_path, place):
    """Three processes run: without the cache, filling it, and reading from it."""
    code = (
        "import sys; from facerender.commands import main\n"
        "status = main(sys.argv[1:])\n"
        "print(*{'trimesh', 'PIL', 'scipy'} & set(sys.modules))\n"
        "sys.exit(status)"
    )
    images, imported = [], []
    for options in (["--no-cache"], [], []):
        png = tmp_path / f"{len(images)}.png"
        command = [sys.executable, "-c", code, "render", MINI_HEAD, "-o", png, *SMALL, *options]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        images.append(png.read_bytes())
        imported.append(done.stdout.splitlines()[1])
        assert bool(entries(place)) == (not options)
    assert images[0] == images[1] == images[2]
    assert imported[1] == "PIL"  # reading glTF does not need trimesh
    assert imported[2] == ""


def test_property_maps_of_cached_meshes_are_not_packed_again(place):
    head = data_dir("assets") / "head.glb"
    load(head)
    maps = [material.property_map for material in load(head).materials]
    assert any(maps)
    assert all(packed.levels("data").done() for packed in maps if packed)


def test_cached_meshes_repeat_warnings(tmp_path, reads):
    head = mini_head()
    path = files.write_obj(tmp_path / "inside-out.obj", head.with_faces(head.faces[:, ::-1]))
    for _ in range(2):
        with pytest.warns(fr.FacerenderWarning, match="inside-out.obj are inside out: turned"):
            load(path)
    assert len(reads) == 1


@pytest.mark.first_case
@pytest.mark.parametrize("change", ["mesh", "mtl", "texture", "other texture", "removed", "name"])
def test_a_changed_file_is_read_anew(change, tmp_path, reads):
    path = textured(tmp_path / "in")
    mtl, texture = (next(path.parent.glob(f"*.{suffix}")) for suffix in ("mtl", "jpg"))
    load(path)
    if change == "mesh":
        path.write_text(re.sub(r"^v \S+", "v 0.01", path.read_text(), count=1, flags=re.M))
    elif change == "mtl":
        other = path.parent / "other.png"
        Image.new("RGB", (4, 4), (200, 10, 10)).save(other)
        mtl.write_text(mtl.read_text().replace(texture.name, other.name))
    elif change == "texture":
        times = texture.stat()
        data = bytearray(texture.read_bytes())
        data[-3] ^= 1
        texture.write_bytes(data)
        os.utime(texture, ns=(times.st_atime_ns, times.st_mtime_ns))  # some tools keep the time
    elif change == "other texture":
        Image.new("RGB", (4, 4), (10, 10, 200)).save(texture, "PNG")
    elif change == "removed":
        texture.unlink()
    else:
        path = path.rename(path.with_name("renamed.obj"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fr.FacerenderWarning)
        again, plain = load(path), fr.load_mesh(path)
    assert len(reads) == 3
    assert_same(again, plain)


def test_loading_options_are_part_of_the_key(reads):
    for _ in range(2):
        for flip_v in (False, True):
            assert_same(load(MINI_HEAD, flip_v=flip_v), fr.load_mesh(MINI_HEAD, flip_v=flip_v))
    assert len(reads) == 6


def test_a_changed_map_is_read_anew(tmp_path, reads):
    for level in (40, 90):
        Image.new("L", (4, 4), level).save(tmp_path / "rough.png")
        mesh = load(MINI_HEAD, roughness_map=tmp_path / "rough.png")
        assert mesh.materials[0].slopes[1] == pytest.approx((level / 255) ** 2)
    assert len(reads) == 2


def test_file_that_changes_while_it_is_read(tmp_path, monkeypatch, place):
    """The entry holds what was read, under the name of what was read."""
    path = textured(tmp_path / "in")
    content = path.read_bytes()
    read = loading._pieces

    def read_and_change(*args, **options):
        pieces = read(*args, **options)
        path.write_text(re.sub(r"^v \S+", "v 0.01", path.read_text(), count=1, flags=re.M))
        return pieces

    monkeypatch.setattr(loading, "_pieces", read_and_change)
    first = load(path)
    monkeypatch.setattr(loading, "_pieces", read)
    assert_same(load(path), fr.load_mesh(path))
    path.write_bytes(content)
    monkeypatch.setattr(loading, "_pieces", lambda *_: pytest.fail("it was read anew"))
    assert_same(load(path), first)


def test_other_versions_of_the_readers_invalidate_entries(reads, monkeypatch):
    load(MINI_HEAD)
    readers = loading.mesh_cache._code()
    assert any("trimesh" in path for path, *_ in readers)
    assert any("PIL" in path for path, *_ in readers)
    monkeypatch.setattr(loading.mesh_cache, "_code", lambda: readers[1:])
    load(MINI_HEAD)
    assert len(reads) == 2


def test_mesh_with_a_missing_file_is_not_cached(tmp_path, place):
    path = textured(tmp_path / "in")
    next(path.parent.glob("*.jpg")).unlink()
    for _ in range(2):
        with pytest.warns(fr.FacerenderWarning, match="not found in"):
            load(path)
    assert entries(place) == []


def test_mesh_with_a_damaged_map_is_not_cached(tmp_path, place, capsys):
    texture = tmp_path / "skin.jpg"
    texture.write_bytes(mini_head().skin[:-200])
    for _ in range(2):
        mesh = load(MINI_HEAD, albedo=texture)
        with pytest.raises(fr.InputError, match="skin.jpg is damaged"):
            mesh.materials[0].albedo_map.levels("color").result()
    assert entries(place) == []
    assert capsys.readouterr() == ("", "")


DAMAGE = {
    "empty": lambda content: b"",
    "head only": lambda content: content[:20],
    "cut off": lambda content: content[: len(content) // 2],
    "last byte gone": lambda content: content[:-1],
    "longer": lambda content: content + b"\0",
    "a bit": lambda content: content[:5000] + bytes([content[5000] ^ 4]) + content[5001:],
    "zeros": lambda content: content[:-4096] + bytes(4096),
    "other magic": lambda content: b"facerender 0" + content[12:],
}


@pytest.mark.first_case
@pytest.mark.parametrize("how", DAMAGE)
def test_damaged_entries_are_replaced(how, reads, place):
    plain = fr.load_mesh(MINI_HEAD)
    load(MINI_HEAD)
    (entry,) = entries(place)
    good = entry.read_bytes()
    entry.write_bytes(DAMAGE[how](good))
    assert_same(load(MINI_HEAD), plain)
    assert len(reads) == 3
    assert entry.read_bytes() == good


def test_pipe_in_place_of_an_entry_is_ignored(reads, place):
    load(MINI_HEAD)
    (entry,) = entries(place)
    entry.unlink()
    os.mkfifo(entry)
    reader = threading.Thread(target=load, args=(MINI_HEAD,), daemon=True)
    reader.start()
    reader.join(30.0)
    assert not reader.is_alive()


WRITE = """
import sys, numpy as np
from facerender.system import cache
size, seed = 1 << 18, int(sys.argv[1])
for turn in range(40):
    kind = np.full(size, seed, dtype=np.uint8)
    cache.write("meshes", "same", [b"head", kind.data])
    read = cache.read("meshes", "same")
    assert read is not None and bytes(read[:4]) == b"head"
    assert len(set(bytes(read[4:]))) == 1 and len(read) == size + 4
"""


@pytest.mark.slow
def test_writers_at_the_same_time_leave_whole_entries(place):
    writers = [subprocess.Popen([sys.executable, "-c", WRITE, str(seed)]) for seed in range(3)]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert [path.name for path in entries(place)] == ["same"]


def test_other_users_cannot_read_the_folder(place):
    place.mkdir(mode=0o755, parents=True)
    cache.write("meshes", "a", [b"1"])
    assert place.stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
def test_entries_that_are_cut_anywhere(reads, place, monkeypatch):
    """One search for a face suffices for hundreds of meshes."""
    plain = fr.load_mesh(MINI_HEAD)
    framing = plain.geometry.framing
    monkeypatch.setattr("facerender.mesh.framing.framing_of", lambda *_: framing)
    load(MINI_HEAD)
    (entry,) = entries(place)
    good = entry.read_bytes()
    for size in range(0, len(good), 1024):
        entry.write_bytes(good[:size])
        assert_equal(with_geometry(load(MINI_HEAD)), with_geometry(plain), "mesh")
        assert entry.read_bytes() == good


def test_entry_that_is_replaced_while_it_is_mapped(place):
    plain, _ = load(MINI_HEAD), load(MINI_HEAD)
    mapped = load(MINI_HEAD)
    (entry,) = entries(place)
    content = cache.read("meshes", entry.name)
    cache.write("meshes", entry.name, [bytes(len(content or b""))])
    assert_same(mapped, plain)


def test_old_partial_files_are_removed(place):
    cache.write("meshes", "a", [b"1"])
    old, new = (place / "meshes" / f".b-{name}" for name in ("old", "new"))
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (1e9, 1e9))
    assert cache.read("meshes", "b") is None
    cache.write("plans", "c", [b"2"])
    assert not old.exists()
    assert new.exists()


def test_least_recently_used_entries_are_removed(place, monkeypatch):
    monkeypatch.setenv("FACERENDER_CACHE_MIB", "4")
    mib = bytes(2**20 - 4096)
    for age, name in enumerate("dcba"):
        cache.write("meshes", name, [mib])
        os.utime(place / "meshes" / name, (1e9 - age, 1e9 - age))
    assert cache.size() <= 4 << 20
    assert cache.read("meshes", "a") is not None  # now the most recently used
    cache.write("plans", "e", [mib])
    assert {path.name for path in place.glob("*/*")} == {"a", "e", "c", "d"}
    cache.write("meshes", "f", [mib, mib, mib])
    assert {path.name for path in place.glob("*/*")} == {"e", "f"}
    cache.write("meshes", "g", [mib] * 5)  # larger than the limit
    assert {path.name for path in place.glob("*/*")} == {"e", "f"}


@pytest.mark.parametrize("mib", ["-1", "1.5", "much"])
def test_invalid_size_limit_is_refused(mib, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FACERENDER_CACHE_MIB", mib)
    status = main(["render", str(MINI_HEAD), "-o", str(tmp_path / "o.png"), *SMALL])
    printed = capsys.readouterr()
    assert_error(status, printed.out, printed.err, re.escape(f"FACERENDER_CACHE_MIB = {mib!r}"))


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--no-cache", "limit 0", "a file", "/dev/null", "closed"])
def test_render_without_a_usable_cache(option, tmp_path, egl, monkeypatch, place, capsys):
    options = [option] if option == "--no-cache" else []
    if option == "limit 0":
        monkeypatch.setenv("FACERENDER_CACHE_MIB", "0")
    elif option == "a file":
        place.parent.write_text("")
    elif option == "/dev/null":
        monkeypatch.setenv("XDG_CACHE_HOME", option)
    elif option == "closed":
        place.parent.mkdir()
        # Root may write to any folder; a file with the folder's name stops root as well.
        (place.parent / "facerender").touch(mode=0)
    png = tmp_path / "o.png"
    budget = ["--budget", "2/255", "--light", "key"] if option in ("--no-cache", "a file") else []
    assert main(["render", str(MINI_HEAD), "-o", str(png), *SMALL, *budget, *options]) == 0
    wait_for_cache()
    printed = capsys.readouterr()
    assert printed.out == f"{png}\n"
    assert "warning" not in re.sub(".* brighter than white: .*", "", printed.err)
    assert not place.is_dir()


def test_mesh_is_cached_before_the_process_ends(place):
    code = "import sys, facerender; facerender.load_mesh(sys.argv[1], cache=True)"
    subprocess.run([sys.executable, "-c", code, MINI_HEAD], check=True)
    assert len(entries(place)) == 1


def test_doctor_prints_folder_and_size(place, capsys):
    cache.write("plans", "a", [bytes(3 << 20)])
    main(["doctor"])
    assert f"cache   {place}, 3 of at most 1024 MiB" in capsys.readouterr().out
