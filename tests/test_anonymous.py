"""Tests ``--anonymous``: no byte of the written files, of standard output and of standard error
contains a name of the scan or a path. Without it, metadata and records contain names of files, and
no directories."""

from __future__ import annotations

import base64
import binascii
import html
import json
import os
import re
import subprocess
import sys
import unicodedata
import zlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from tests.awkward_files import Glb, mini_head

pytestmark = [pytest.mark.usefixtures("egl"), pytest.mark.first_case]

# Pieces of the names of the folder, the files and what the files contain.
SECRETS = ("Mustermann", "Käthe", "1900-01-01", "links", "Abteilung7")
NAME = "Mustermann Käthe_1900-01-01"
JOBS = "outputs = ['image', 'depth', 'parts', 'layers']\n"


def spellings(word: str) -> Iterator[bytes]:
    """Yield a word in lower case, as the encodings of files and pages write it."""
    for form in ("NFC", "NFD"):
        text = unicodedata.normalize(form, word).lower()
        escaped = html.escape(text.encode("ascii", "xmlcharrefreplace").decode())
        replaced = (re.sub(r"[^\x00-\x7f]", other, text) for other in "_?")
        ascii_forms = quote(text), json.dumps(text)[1:-1], ascii(text)[1:-1], escaped, *replaced
        for spelling in (text, *ascii_forms):
            for encoding in ("utf-8", "utf-16-le", "utf-16-be", "latin-1"):
                yield spelling.encode(encoding, "ignore").lower()


def unpacked(content: bytes, depth: int = 3) -> Iterator[bytes]:
    """Yield bytes, and the content of the zlib, gzip and base64 streams in them."""
    yield content
    if not depth:
        return
    for match in re.finditer(rb"\x78[\x01\x5e\x9c\xda]|\x1f\x8b\x08", content):
        try:
            inner = zlib.decompressobj(47).decompress(content[match.start() :], 1 << 25)
        except zlib.error:
            continue
        yield from unpacked(inner, depth - 1)
    for match in re.finditer(rb"[A-Za-z0-9+/]{16,}={0,2}", content):
        try:
            inner = base64.b64decode(match[0][: len(match[0]) // 4 * 4])
        except binascii.Error:
            continue
        yield from unpacked(inner, depth - 1)


def leaks(content: bytes, words: tuple[str, ...] = SECRETS) -> set[str]:
    """Return the words that some bytes contain in any spelling."""
    found = set[str]()
    for layer in unpacked(content):
        text = layer.lower()
        found |= {word for word in words if any(form in text for form in spellings(word))}
    return found


@pytest.mark.parametrize("word", ["Mustermann", "Käthe"])
def test_the_search_finds_a_name_in_every_encoding(word):
    for form in ("NFC", "NFD"):
        text = unicodedata.normalize(form, f"the scan {word} {form}")
        for content in (text.encode(), text.encode("utf-16"), quote(text).encode()):
            assert leaks(content) == {word}
            assert leaks(b"before" + zlib.compress(content)) == {word}
            assert leaks(b'data:"' + base64.b64encode(zlib.compress(content)) + b'"') == {word}
        assert leaks(json.dumps(text).encode()) == {word}
    assert not leaks(b"must ermann, Kaethe, link")


# --- the scans -----------------------------------------------------------------------------------


def write_jpeg(path: Path) -> None:
    """Write a texture whose EXIF, XMP and comment contain names."""
    exif = Image.Exif()
    exif[0x010E], exif[0x013B] = "Mustermann links", "Käthe"  # ImageDescription, Artist
    xmp = f"<x:xmpmeta xmlns:x='adobe:ns:meta/'>{NAME}</x:xmpmeta>".encode()
    noise = np.random.default_rng(7).integers(90, 190, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, exif=exif, comment=NAME.encode(), xmp=xmp)


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scans whose names, and names in them, contain SECRETS."""
    folder = tmp_path_factory.mktemp("Abteilung7") / NAME
    folder.mkdir()
    for side in ("links", "rechts"):
        write_jpeg(folder / f"{NAME} {side}.jpg")
    head = mini_head()
    half, count = len(head.faces) // 2, len(head.positions)
    lines = [f"# Patient: {NAME}", f"mtllib {NAME}.mtl", f"o {NAME}"]
    lines += ["v {:.6f} {:.6f} {:.6f}".format(*row) for row in head.positions]
    lines += ["vt {:.6f} {:.6f}".format(*row) for row in head.uv]
    for side, faces in (("links", head.faces[:half]), ("rechts", head.faces[half:])):
        lines += [f"g Mustermann_{side}", f"usemtl Käthe {side}"]
        lines += ["f " + " ".join(f"{i}/{i}" for i in row) for row in (faces + 1).tolist()]
    text = "\n".join(lines)
    (folder / f"{NAME}.obj").write_text(text)
    materials = [f"newmtl Käthe {s}\nmap_Kd {NAME} {s}.jpg\n" for s in ("links", "rechts")]
    (folder / f"{NAME}.mtl").write_text("\n".join(materials))
    # Broken scans, whose warnings and errors contain names.
    (folder / "Mustermann cut.obj").write_text(text[: 2 * len(text) // 3] + "\nf 1/1 2/2 links")
    (folder / "Mustermann bare.obj").write_text(text.replace(f"{NAME}.mtl", "Käthe none.mtl"))
    (folder / "Käthe lost.mtl").write_text("\n".join(materials).replace("echts.j", "x.j"))
    (folder / "Mustermann lost.obj").write_text(text.replace(f"{NAME}.mtl", "Käthe lost.mtl"))
    (folder / "Mustermann empty.obj").write_text("")
    # A rigged head.
    file = Glb(
        {"mesh": 0, "skin": 0, "name": NAME},
        {"name": "Käthe_links", "children": [2]},
        {"name": "Mustermann_Hals"},
        {"camera": 0, "name": "Käthe links", "translation": [0.0, 0.0, 0.6]},
    )
    joints = np.tile(np.array([0, 1, 0, 0]), (count, 1))
    weights = np.tile(np.array([0.5, 0.5, 0.0, 0.0]), (count, 1))
    primitive = file.primitive(
        head.positions,
        head.faces,
        head.normals,
        TEXCOORD_0=file.add(head.uv),
        JOINTS_0=file.add(joints, "|u1"),
        WEIGHTS_0=file.add(weights),
    )
    primitive["targets"] = [{"POSITION": file.add(0.02 * head.positions)}]
    primitive["material"] = 0
    file.mesh(primitive, name=f"{NAME} Kopf", extras={"targetNames": ["Käthe lacht"]})
    image = file.view((folder / f"{NAME} links.jpg").read_bytes())
    file.skin([1, 2])
    file.clip((0, "weights", [0.0, 0.1], [0.0, 1.0]), name="Mustermann spricht")
    file.document |= {
        "scenes": [{"nodes": [0, 1, 3]}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.01}}],
        "images": [{"bufferView": image, "mimeType": "image/jpeg", "name": NAME}],
        "textures": [{"source": 0, "name": NAME}],
        "materials": [
            {"name": NAME, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        ],
    }
    content = file.content()
    (folder / f"{NAME}.glb").write_bytes(content)
    (folder / "Mustermann cut.glb").write_bytes(content[: len(content) // 2])
    np.save(folder / "Käthe panorama.npy", np.ones((8, 16, 3), dtype=np.float32))
    (folder / "Käthe cameras.toml").write_text(
        '[[cameras]]\nname = "Mustermann links"\n[[cameras]]\nname = "Käthe"\nazimuth = 40\n'
    )
    rows = [
        {"id": "{mesh.stem}-{number}", "mesh": f"{folder}/{NAME}.obj", "camera.name": NAME},
        {"id": "view-{number}", "mesh": f"{folder}/{NAME}.glb", "pose.weights.Käthe lacht": 0.5},
        {"mesh": f"{folder}/{NAME}.glb", "pose.joints": {"Käthe_links": [0.0, 9.0, 0.0]}},
        {"mesh": f"{folder}/Mustermann lost.obj", "background": f"{folder}/{NAME} links.jpg"},
        {"mesh": f"{folder}/Mustermann empty.obj"},
        {"mesh": f"{folder}/Mustermann gone.obj", "environment": f"{folder}/Käthe panorama.npy"},
    ]
    extra = {"meta.patient": NAME, "outputs": "image,depth,parts,motion,layers"}
    (folder / "Käthe landmarks.json").write_text('{"Käthe links": 5}')
    rows[0]["landmarks"] = f"{folder}/Käthe landmarks.json"
    table = "\n".join(json.dumps(row | extra) for row in rows)
    (folder / f"{NAME}.jsonl").write_text(table)
    return folder


def run(
    scans: Path, out: Path, *words: str, status: int | None = 0, hidden: bool = True
) -> subprocess.CompletedProcess[bytes]:
    """Run a command in an empty folder with an empty cache. In the words, @ stands for the folder
    of scans, and NAME for the name of the scan. Check that nothing contains a name."""
    cache = out / "cache" if hidden else out.parent
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": os.getcwd()}
    environment.pop("FACERENDER_CACHE_MIB", None)
    arguments = [word.replace("@", f"{scans}/").replace("NAME", NAME) for word in words]
    command = [sys.executable, "-m", "facerender", *arguments, *["--anonymous"] * hidden]
    result = subprocess.run(command, cwd=out, env=environment, capture_output=True)
    assert status is None or result.returncode == status, result.stderr
    if hidden:
        assert not leaks(result.stdout), result.stdout
        assert not leaks(result.stderr), result.stderr
        for path in out.rglob("*"):
            assert not leaks(str(path.relative_to(out)).encode()), path
            found = leaks(path.read_bytes()) if path.is_file() else None
            assert not found, (path, found)
    return result


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An empty folder, whose path contains no secret."""
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


SMALL = ("--size", "32", "--samples", "1")
BOTH = ("--camera", "front", "--camera", "@Käthe cameras.toml")
POSED = ("--weight", "Käthe lacht=0.5", "--joint", "Käthe_links=0,10,0")
OBJ_RENDERS = [
    ("-o", "{name}.png", *BOTH, "--json", "--verbose", "--part", "*links,m=0.2"),
    ("-o", "a.jpg", "--background", "@NAME links.jpg", "--hide", "*rechts"),
    ("-o", "a.webp", "--albedo", "@NAME links.jpg", "--environment", "@Käthe panorama.npy"),
    ("-o", "a.exr", "--only", "parts", "--id", "P017"),
    ("-o", "a.gif", *BOTH),
    ("-o", "a.png", *BOTH, "--sheet", "--only", "parts"),
    ("-o", "-", "--format", "webp"),
    ("-o", "a.png", "--budget", "1/255", "--json"),
]
GLB_RENDERS = [
    ("-o", "{name}.png", "--camera", "gltf", *POSED, "--json"),
    ("-o", "a.webp", "--clip", "Mustermann spricht"),
    ("-o", "a.exr", *POSED, "--camera", "gltf:Käthe links"),
]


@pytest.mark.parametrize("options", OBJ_RENDERS, ids=" ".join)
def test_images_of_an_obj_file_contain_no_name(options, scans, out):
    run(scans, out, "render", "@NAME.obj", *SMALL, *options)


@pytest.mark.parametrize("options", GLB_RENDERS, ids=" ".join)
def test_images_of_a_rigged_head_contain_no_name(options, scans, out):
    run(scans, out, "render", "@NAME.glb", *SMALL, *options)


@pytest.mark.parametrize("words", [(), ("--id", "P017")], ids=str)
def test_the_id_names_image_and_mesh(words, scans, out):
    name = words[-1] if words else "anonymous"
    result = run(scans, out, "render", "@NAME.obj", *SMALL, *words)
    assert result.stdout.decode() == f"{name}.png\n"
    with Image.open(out / f"{name}.png") as image:
        assert image.info["mesh"].startswith(f"{name}, ")
        assert image.info["albedo_map"] == "albedo map, 64 x 64"
    run(scans, out, "explore", "@NAME.obj", *words)
    assert f"<title>facerender explorer: {name}</title>" in (out / f"{name}.html").read_text()


@pytest.mark.parametrize("form", ["png", "tiff"])
def test_standard_views_contain_no_name(form, scans, out):
    scan = "@NAME.obj", "--camera", "frontal", "--format", form, "--id", "P017"
    words = "views", "@NAME.obj", *scan, "--register", "--size", "64", "-o", "views"
    run(scans, out, *words, "--json")
    names = "P017-1-frontal", "P017-2-frontal", "changes", "sheet"
    assert sorted(path.name for path in (out / "views").iterdir()) == [
        f"{name}.{form}" for name in names
    ]


@pytest.mark.parametrize("options", [
    ("--part", "*links,m=0.2", "--parts", "*links", "--normal-map", "@NAME rechts.jpg"),
    ("--background", "@NAME links.jpg", "--environment", "@Käthe panorama.npy"),
], ids=" ".join)  # fmt: skip
def test_explorer_pages_contain_no_name(options, scans, out):
    run(scans, out, "explore", "@NAME.obj", "-o", "a.html", *options)


@pytest.mark.parametrize("options", [POSED, ("--clip", "Mustermann spricht")], ids=" ".join)
def test_explorer_pages_of_a_rigged_head_contain_no_name(options, scans, out):
    run(scans, out, "explore", "@NAME.glb", "-o", "a.html", *options)


BROKEN = ("Mustermann lost.obj", "Mustermann bare.obj", "Mustermann cut.obj", "Mustermann cut.glb",
          "Mustermann empty.obj", "Mustermann gone.obj")  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_messages_about_broken_scans_contain_no_name(name, scans, out, monkeypatch):
    monkeypatch.setenv("FACERENDER_DEBUG", "1")
    result = run(scans, out, "render", f"@{name}", *SMALL, "-o", "a.png", status=None)
    named = run(scans, out, "render", f"@{name}", *SMALL, "-o", "b.png", status=None, hidden=False)
    assert result.returncode == named.returncode
    assert leaks(named.stderr)
    assert result.stderr.count(b"may contain names: run without --anonymous to read") == (
        (b"warning:" in named.stderr) + (b"error:" in named.stderr)
    )


@pytest.mark.parametrize("words", [
    ("render", "@NAME.obj", "--part", "Käthe"),
    ("render", "@NAME.obj", "--parts", "Käthe*"),
    ("render", "@NAME.obj", "--Mustermann"),
    ("render", "@NAME.obj", "--m", "Mustermann"),
    ("render", "@NAME.glb", "--clip", "Käthe"),
    ("render", "@NAME.obj", "@NAME.obj"),
    ("explore", "@NAME.obj", "-o", "@Mustermann.txt"),
    ("batch", "@Mustermann none.csv", "-o", "batch"),
    ("compare", "@Mustermann.png", "@Käthe.png"),
    ("Mustermann",),
], ids=" ".join)  # fmt: skip
def test_errors_in_options_contain_no_name(words, scans, out):
    result = run(scans, out, *words, status=2)
    assert result.stderr.count(b"\n") == 1
    assert (
        b"error: 1 message may contain names: run without --anonymous to read it" in result.stderr
    )


@pytest.mark.parametrize("layout", ["files", "shards"])
def test_batches_contain_no_name(layout, scans, out):
    words = "batch", "@NAME.jsonl", "-o", "batch", "--size", "32", "--layout", layout
    result = run(scans, out, *words, "--transforms", "--json", "--id", "P017", status=3)
    records = [json.loads(line) for line in (out / "batch/jobs.jsonl").read_text().splitlines()]
    # An id with the name of the mesh becomes the number of the row.
    assert [record["id"] for record in records] == ["00000000", "view-1", "00000002", "00000003"]
    assert {record["mesh"] for record in records} == {"P017"}
    assert records[0]["parts"] == ["part1", "part2"]
    assert records[0]["landmarks"][0]["name"] == "landmark1"
    assert records[3]["warnings"] == [
        "1 warning may contain names: run without --anonymous to read it"
    ]
    assert json.loads(result.stdout.splitlines()[-1])["failed"] == 2
    again = run(scans, out, *words, "--transforms", "--json", "--id", "P017", status=3)
    assert json.loads(again.stdout.splitlines()[-1])["drawn"] == 0
    run(scans, out, "batch", "@NAME.jsonl", "--check", status=2)


def test_reports_of_comparisons_contain_no_name(scans, out):
    """Images that were drawn with names lose them in the report."""
    pictures = scans / "Mustermann pictures"
    pictures.mkdir()
    for name, m in (("Mustermann a.png", "0.3"), ("Käthe b.png", "0.2")):
        words = "render", "@NAME.obj", *SMALL, "--m", m, "-o", str(pictures / name)
        run(scans, out, *words, hidden=False)
        assert leaks((pictures / name).read_bytes())
    files = "@Mustermann pictures/Mustermann a.png", "@Mustermann pictures/Käthe b.png"
    outputs = "--report", "r.html", "--sheet", "s.png"
    for extra in ((), ("--json",)):
        result = run(scans, out, "compare", *files, *outputs, *extra, "--id", "P017", status=1)
        assert b"P017" in result.stdout
    page = (out / "r.html").read_text()
    assert "image 1" in page
    assert "llvmpipe" in page or "GL_RENDERER" in page
    folders = "@Mustermann pictures", "@"
    run(scans, out, "compare", *folders, "--report", "r.html", "--json", status=2)


def test_an_id_needs_anonymous(cli, scans):
    cli.fail("--id P017 is for --anonymous: add it, or leave --id out", "render", "--id", "P017")


# --- without --anonymous -------------------------------------------------------------------------


def test_metadata_contain_names_and_no_directories(scans, out):
    """The directory of the scan contains Abteilung7."""
    options = *SMALL, "--background", "@NAME links.jpg", "--environment", "@Käthe panorama.npy"
    for file in ("a.png", "a.exr", "a.jpg", "a.webp"):
        run(scans, out, "render", "@NAME.obj", *options, "-o", file, hidden=False)
    run(scans, out, "explore", "@NAME.glb", *POSED, "-o", "a.html", hidden=False)
    run(scans, out, "compare", "a.png", "a.png", "--report", "r.html", hidden=False)
    run(scans, out, "compare", str(out / "a.exr"), "a.exr", "--report", "s.html", hidden=False)
    words = "batch", "@NAME.jsonl", "-o", "batch", "--size", "32"
    run(scans, out, *words, status=3, hidden=False)
    records = [json.loads(line) for line in (out / "batch/jobs.jsonl").read_text().splitlines()]
    assert records[0]["mesh"] == records[0]["job"]["mesh"]["path"] == f"{NAME}.obj"
    for path in out.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            # Messages may contain the path of a missing file.
            content = re.sub(rb'"error": "[^"]*"|"warnings": \[[^\]]*\]', b"", content)
            assert not leaks(content, ("Abteilung7", str(out))), path


def test_python_replaces_names(scans):
    mesh = fr.load_mesh(scans / f"{NAME}.glb")
    frame = fr.render(mesh, size=16, samples=1, anonymous="P017")
    assert not leaks(json.dumps(dict(frame.metadata)).encode())
    assert frame.metadata["mesh"].startswith("P017, ")
    scene = fr.Job(fr.MeshFile(str(scans / f"{NAME}.obj")), anonymous="P017").scene()
    with fr.Renderer(16, samples=1) as renderer:
        drawn, named = (renderer.render(s) for s in (scene, fr.Scene(scene.mesh)))
    assert not leaks(json.dumps(dict(drawn.metadata)).encode())
    assert leaks(json.dumps(dict(named.metadata)).encode())
    np.testing.assert_array_equal(drawn.linear, named.linear)
