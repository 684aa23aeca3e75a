"""Tests the messages of the most common errors: each names the thing, the value and the remedy."""

from __future__ import annotations

import math
import re
import shlex
import shutil
from pathlib import Path

import pytest
from PIL import Image

from facerender.commands import main

ROOT = Path(__file__).parents[1]
# Command lines whose messages are compared word for word.
EXACT = {
    "render gone.glb -o x.png": "cannot read gone.glb: no such file or directory; give a mesh file",
    "render --m 0.75 --lobe d8 -o x.png": (
        "m = 0.75 is outside the domain of lobe d8 for Cook-Torrance: give m in [0.0001, 0.7071),"
        " or use the lobe exact (facerender render: --outside exact)"
    ),
    "render --camera west -o x.png": (
        "unknown camera 'west'; give front, three-quarter, profile, frontal, right-oblique, "
        "left-oblique, right-lateral, left-lateral, basal, superior, or "
        "AZIMUTH[,ELEVATION[,ZOOM]] in degrees, where AZIMUTH may be a name; standard, for all "
        "seven standard views, frontal to superior; turntable[:N[,FROM..TO]], for N views "
        "around the mesh (8), or on an arc; gltf[:NAME], for cameras of the mesh file; or a camera "
        "file: .toml with [[cameras]], .json or .npz with K and [R|t]"
    ),
    "render --light moon -o x.png": (
        "unknown light 'moon'; give key, rim, fill, front, top, or "
        "AZIMUTH,ELEVATION[,IRRADIANCE], or point:X,Y,Z[,IRRADIANCE], then optionally "
        ",radius=DEGREES for an area light, ,no-shadow, and ,follow to follow the camera"
    ),
    "render --scene unknown.toml -o x.png": (
        "unknown.toml: unknown key 'unknown'; known: mesh, material, camera, lights, ambient, "
        "background, shading, planned, image, outputs, environment, parts, pose, before, "
        "landmarks, cameras, anonymous"
    ),
    "render tri.obj --scattering skin -o x.png": (
        "scattering needs the size of tri.obj, which does not specify its unit: "
        "--millimetres 230 is a guess: measure the mesh (load_mesh(..., millimetres=...))"
    ),
    "render --budget 1 -o x.png": (
        "budget '1' has no unit: give a fraction of the display's range such as 1/255, 0.5%, or "
        "0.02 flip"
    ),
    "render --within 99% -o x.png": "--within 99% has no budget: add --budget ERROR",
    "render --lobe d32 -o x.png": (
        "argument --lobe: invalid choice: 'd32' (choose from exact, cosine, d4, d8, d16, fitted, "
        "fitted-fine); see facerender render --help"
    ),
    "render head.glb --samples 1": (
        "head.png exists: give -o head.png to replace it, or another name"
    ),
    "batch jobs.csv --check": (
        "jobs.csv, row 1 (line 2): unknown key 'm'; known: id, outputs, exposure, tone, scene, "
        "meta, mesh, material, camera, lights, ambient, background, shading, planned, image, "
        "environment, parts, pose, before, landmarks, anonymous"
    ),
    "plan --budget 1/255 --target es300": "--target es300 has no shader: add --emit OUT.glsl",
    "compare a.png b.png": "a.png is 8 x 8, b.png is 9 x 9 pixels: render both at one size",
    "explore -o x.png": "x.png: the explorer is an HTML page; give a name that ends in .html",
    "info nosuffix": (
        "nosuffix has no suffix, which sets the mesh format; give .glb, .gltf, .obj, .ply or .stl"
    ),
}
# Command lines, and the part of the message that names the thing and the value.
SHAPES = {
    "render --scene range.toml -o x.png": "range.toml: camera azimuth = 1000000000.0 is outside",
    "shaders flatten shadow --lobe d16": "shadow does not use FR_LOBE",
    "render bad.glb -o x.png": "bad.glb is not glTF",
    "render empty.obj -o x.png": "empty.obj has only points and no faces",
    "render note.txt -o x.png": "note.txt: unknown mesh format '.txt'",
    "render -o x.gif2": "x.gif2: unknown image format '.gif2'",
    "render -o out": "out has no suffix, which sets the image format",
    "render -o nowhere/x.png": "cannot write nowhere/x.png: no such file or directory",
    "render --m 3 -o x.png": "m = 3.0",
    "render --f0 1 -o x.png": "f0 = 1.0",
    "render --ks -1 -o x.png": "ks = -1.0",
    "render --size 0 -o x.png": "image size 0 x 0",
    "render --size 20x -o x.png": "size '20x'",
    "render --samples 65 -o x.png": "samples = 65",
    "render --camera 10,100 -o x.png": "camera elevation = 100.0",
    "render --camera rig.json -o x.png": "rig.json: no such file or directory; give a cam",
    "render --light key,radius=30 -o x.png": "light radius = 30.0",
    "render --light 1,2,-3 -o x.png": "light irradiance = -3.0",
    "render --background 1,2 -o x.png": "background = '1,2'",
    "render --background red -o x.png": "background = 'red'",
    "render --environment gone.hdr -o x.png": "gone.hdr: no such file or directory; give an en",
    "render --environment studo -o x.png": "studo: no such file or directory; give studio",
    "render --environment-samples 7 -o x.png": "environment_samples = 7",
    "render --parts '*brow*' -o x.png": "no part of head.glb is called '*brow*': its parts are ",
    "render --parts head --hide head -o x.png": "every part of head.glb is hidden",
    "render --albedo gone.png -o x.png": "gone.png: no such file or directory; give an i",
    "render --albedo bad.png -o x.png": "bad.png is not an image",
    "render --albedo '' -o x.png": "the value of --albedo is empty",
    "render --scene gone.toml -o x.png": "gone.toml: no such file or directory; give a scene file",
    "render --scene bad.toml -o x.png": "bad.toml is not valid TOML",
    "render --scene west.toml -o x.png": "west.toml: camera azimuth = 'west' is not a number",
    "render --scene= -o x.png": "the value of --scene is empty",
    "render --scene planned.toml --roughness-map a.png -o x.png": "pins m = 0.3043",
    "render --scatter-samples 7 -o x.png": "scatter_samples = 7",
    "render --triangles 0 -o x.png": "mesh triangles = 0",
    "render --vertices nofile -o x.png": "no such file or directory; give a file of vertices",
    "render --budget little -o x.png": "budget 'little' has an unknown unit",
    "render --within 101% --budget 1/255 -o x.png": "within 101%",
    "render --exposure 1000 -o x.png": "exposure = 1000.0",
    "render --fps 0 --camera turntable:2 -o x.gif": "fps = 0.0",
    "render --background none -o x.jpg": "JPEG cannot store transparency",
    "render --m rough -o x.png": "argument --m: 'rough' is not a number",
    "render --samples 1.5 -o x.png": "argument --samples: '1.5' is not a whole number",
    "render --quiet --verbose -o x.png": "--quiet and --verbose exclude each other",
    "render -o - --json": "-o - and --json both write to standard output",
    "render --camera front --camera profile -o -": "-o - takes one image, and there are 2",
    "info gone.glb": "cannot read gone.glb: no such file or directory; give a mesh file",
    "info head": "cannot read head: no such file or directory; give head.glb",
    "render --scene planned.toml --m 0.4 -o x.png": "planned.toml was planned for m = 0.3",
    "info ''": "an argument is empty",
    "info head.glb --jsn": "unrecognized arguments: --jsn",
    "batch gone.csv -o out": "cannot read gone.csv: no such file or directory; give a job table",
    "batch note.txt -o out": "note.txt: unknown table format '.txt'",
    "batch m.csv --check": "m.csv, row 1 (line 2): m = 3",
    "batch --status gone": "gone is not a batch",
    "plan --budget 1/255 --size 512..256": "sizes '512..256'",
    "plan --size 99999 --budget 1/255": "image size 99999 x 99999",
    "plan --parts head --budget 1/255 --size 16 --cost gpu": "unknown cost 'gpu'",
    "plan head.glb --budget 0.5%%": "budget '0.5%%' has an unknown unit",
    "compare a.png gone.png": "cannot read gone.png: no such file or directory; give an image file",
    "compare a b": "cannot read a: no such file or directory; give a.png",
    "compare . gone": "cannot read gone: no such file or directory; give an image file",
    "compare a.png note.txt": "note.txt: unknown image format '.txt'",
    "compare a.png a.png --point -1": "limit point = -1.0",
    "compare a.png": "only one image",
    "compare a.png a.png --limits gone.ini": "gone.ini: no such file or directory; give an ini",
    "compare --calibrate gone": "gone: no such file or directory; give a folder with a sub",
    "measure --m 5": "m = 5.0",
    "shaders flatten gone": "unknown shader 'gone'; known: albedo, constants, cook_torrance, ",
    "shaders flatten gone.frag": "cannot read gone.frag: no such file or directory; give a GLSL",
    "shaders flatten cook_torrance --target dx": "argument --target: invalid choice: 'dx'",
    "shaders flatten cook_torrance --lobe d8 --m 0.9": "m = 0.9 is outside the domain of lobe d8",
}
# Each message ends with a remedy, or with the valid names.
REMEDY = re.compile(
    r"[:;,(] ?(give|add|see|leave|export|correct|hide|known|choose from|its parts are|write)\b"
)
FILES = {
    "nosuffix": "x",
    "west.toml": "[camera]\nazimuth = 'west'\n",
    "planned.toml": "[material]\nm = 0.3\n[shading]\nm = 0.3043\n"
    "[planned]\nsizes = [[512, 512]]\nsamples = 4\n",
    "tri.obj": "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "empty.obj": "v 0 0 0\n",
    "bad.glb": "x",
    "bad.png": "x",
    "bad.toml": "a = [",
    "unknown.toml": "unknown = 1\n",
    "range.toml": "[camera]\nazimuth = 1e9\n",
    "jobs.csv": "mesh,m\na.glb,3\n",
    "m.csv": "id,material.m\na,3\n",
    "note.txt": "hello",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("messages")
    for name, content in FILES.items():
        (folder / name).write_text(content)
    shutil.copy(ROOT / "assets" / "head.glb", folder)
    Image.new("RGB", (8, 8)).save(folder / "a.png")
    Image.new("RGB", (8, 8)).save(folder / "head.png")
    Image.new("RGB", (9, 9)).save(folder / "b.png")
    return folder


def message_of(command, folder, monkeypatch, capsys):
    """Run a command that must fail, write no file and print one line; return its message."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("facerender.commands.plan._SILENT", math.inf)
    files = sorted(folder.iterdir())
    assert main(shlex.split(command)) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert sorted(folder.iterdir()) == files
    # Python 3.12 and earlier quote the choices.
    return re.sub(r"choose from [^)]*", lambda choices: choices[0].replace("'", ""), err)


@pytest.mark.parametrize("command", EXACT)
def test_the_message_of_a_bad_command(command, folder, monkeypatch, capsys):
    message = message_of(command, folder, monkeypatch, capsys)
    assert message == f"facerender: error: {EXACT[command]}\n"


@pytest.mark.parametrize("command", SHAPES)
def test_a_message_names_the_value_and_a_remedy(command, folder, monkeypatch, capsys):
    message = message_of(command, folder, monkeypatch, capsys)
    start, named, rest = message.partition(SHAPES[command])
    assert (start.startswith("facerender: error: "), named) == (True, SHAPES[command])
    assert REMEDY.search(f"{named}{rest}")
