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
MESSAGES = [
    (
        "render gone.glb -o x.png",
        "cannot read gone.glb: no such file or directory; give a mesh file",
    ),
    (
        "render bad.glb -o x.png",
        (
            "bad.glb is not glTF: its JSON cannot be read (Expecting value: line 1 column 1 (char"
            " 0)); export it again"
        ),
    ),
    (
        "render empty.obj -o x.png",
        "empty.obj has only points and no faces; give a triangle mesh",
    ),
    (
        "render note.txt -o x.png",
        "note.txt: unknown mesh format '.txt'; give .glb, .gltf, .obj, .ply or .stl",
    ),
    (
        "render -o x.gif2",
        "x.gif2: unknown image format '.gif2'; give .png, .exr, .jpg, .jpeg or .webp",
    ),
    (
        "render -o out",
        "out has no suffix, which sets the image format; give .png, .exr, .jpg, .jpeg or .webp",
    ),
    (
        "render -o nowhere/x.png",
        "cannot write nowhere/x.png: no such file or directory; give a file in a writable folder",
    ),
    (
        "render --m 3 -o x.png",
        "m = 3.0 is outside [0.0001, 2]: give a value in this range",
    ),
    (
        "render --m 0.75 --lobe d8 -o x.png",
        (
            "m = 0.75 is outside the domain of lobe d8 for Cook-Torrance: give m in [0.0001, "
            "0.7071), or use the lobe exact (facerender render: --outside exact)"
        ),
    ),
    (
        "render --f0 1 -o x.png",
        "f0 = 1.0 is outside [0, 0.999]: give a value in this range",
    ),
    (
        "render --ks -1 -o x.png",
        "ks = -1.0 is outside [0, 1e+06]: give a value in this range",
    ),
    (
        "render --size 0 -o x.png",
        "image size 0 x 0: give 1 to 16384 pixels a side",
    ),
    (
        "render --size 20x -o x.png",
        "size '20x': give N or WxH, such as 1024 or 640x480",
    ),
    (
        "render --samples 65 -o x.png",
        "image samples = 65: give 1 to 64",
    ),
    (
        "render --camera west -o x.png",
        (
            "unknown camera 'west'; give front, three-quarter, profile, or "
            "AZIMUTH[,ELEVATION[,ZOOM]] in degrees, where AZIMUTH may be a name; turntable[:N], for"
            " N views around the mesh (8); gltf[:NAME], for cameras of the mesh file; or a camera"
            " file: .toml with [[cameras]], .json or .npz with K and [R|t]"
        ),
    ),
    (
        "render --camera 10,100 -o x.png",
        "camera elevation = 100.0 is outside [-90, 90]: give a value in this range",
    ),
    (
        "render --camera rig.json -o x.png",
        "cannot read rig.json: no such file or directory; give a camera file",
    ),
    (
        "render --light moon -o x.png",
        (
            "unknown light 'moon'; give key, rim, fill, front, top, or "
            "AZIMUTH,ELEVATION[,IRRADIANCE], or point:X,Y,Z[,IRRADIANCE], then optionally "
            ",radius=DEGREES for an area light and ,no-shadow"
        ),
    ),
    (
        "render --light key,radius=30 -o x.png",
        "light radius = 30.0 is outside [0, 20]: give a value in this range",
    ),
    (
        "render --light 1,2,-3 -o x.png",
        "light irradiance = -3.0: give a number in [0, 1e+09], or three",
    ),
    (
        "render --background 1,2 -o x.png",
        "background = '1,2': give 3 numbers in linear RGB, or none for a transparent background",
    ),
    (
        "render --environment gone.hdr -o x.png",
        "cannot read gone.hdr: no such file or directory; give an environment map "
        "(.hdr, .exr, .npy, .npz), or studio",
    ),
    (
        "render --environment studo -o x.png",
        "cannot read studo: no such file or directory; give studio, or an environment map "
        "(.hdr, .exr, .npy, .npz)",
    ),
    (
        "render --environment-samples 7 -o x.png",
        "environment_samples = 7: give an even number up to 4096",
    ),
    (
        "render --parts '*brow*' -o x.png",
        "no part of head.glb is called '*brow*': its parts are head, eyeballs, lash-strands, "
        "tear-line, cornea",
    ),
    (
        "render --albedo gone.png -o x.png",
        "cannot read gone.png: no such file or directory; give an image file",
    ),
    (
        "render --albedo bad.png -o x.png",
        "bad.png is not an image; give a PNG, JPEG, TIFF or WebP",
    ),
    (
        "render --scene gone.toml -o x.png",
        "cannot read gone.toml: no such file or directory; give a scene file",
    ),
    (
        "render --scene bad.toml -o x.png",
        "bad.toml is not valid TOML: Invalid value (at end of document); correct it",
    ),
    (
        "render --scene unknown.toml -o x.png",
        (
            "unknown.toml: unknown key 'unknown'; known: camera, cameras, lights, environment, "
            "material, parts, shading, planned, ambient, background, pose, before, image"
        ),
    ),
    (
        "render --scene range.toml -o x.png",
        (
            "range.toml: camera azimuth = 1000000000.0 is outside [-3600, 3600]: give a value in "
            "this range"
        ),
    ),
    (
        "render tri.obj --scattering skin -o x.png",
        (
            "scattering needs the size of tri.obj, which does not specify its unit: give "
            "--millimetres 230 for a head of 230 mm (load_mesh(..., millimetres=230))"
        ),
    ),
    (
        "render --scatter-samples 7 -o x.png",
        "scatter_samples = 7: give one of 0, 8, 16, 32, 64",
    ),
    (
        "render --triangles 0 -o x.png",
        "mesh triangles = 0: give a whole number of at least 1",
    ),
    (
        "render --budget 1 -o x.png",
        (
            "budget '1' has no unit: give a fraction of the display's range such as 1/255, 0.5%, "
            "or 0.02 flip"
        ),
    ),
    (
        "render --budget little -o x.png",
        (
            "budget 'little' has an unknown unit: give a fraction of the display's range such as "
            "1/255, 0.5%, or 0.02 flip"
        ),
    ),
    (
        "render --within 101% --budget 1/255 -o x.png",
        "within 101%: give a fraction of the pixels such as 99.9% or 0.999",
    ),
    (
        "render --within 99% -o x.png",
        "--within 99% has no budget: add --budget ERROR",
    ),
    (
        "render --exposure 1000 -o x.png",
        "exposure = 1000.0 is outside [-100, 100]: give a value in this range",
    ),
    (
        "render --fps 0 --camera turntable:2 -o x.gif",
        "fps = 0.0 is outside [0.1, 100]: give a value in this range",
    ),
    (
        "render --background none -o x.jpg",
        "JPEG cannot store transparency: give a background, or .png or .webp",
    ),
    (
        "render --lobe d32 -o x.png",
        (
            "argument --lobe: invalid choice: 'd32' (choose from exact, cosine, d4, d8, "
            "d16, fitted, fitted-fine); see facerender render --help"
        ),
    ),
    (
        "render --quiet --verbose -o x.png",
        "--quiet and --verbose exclude each other: leave one of them out",
    ),
    (
        "render -o - --json",
        "-o - and --json both write to standard output: leave one of them out",
    ),
    (
        "render head.glb -o head.glb",
        "head.glb: unknown image format '.glb'; give .png, .exr, .jpg, .jpeg or .webp",
    ),
    (
        "render --lobes d8 -o x.png",
        "unrecognized arguments: --lobes; see facerender render --help",
    ),
    (
        "render head.glb --samples 1",
        "head.png exists: give -o head.png to replace it, or another name",
    ),
    (
        "info gone.glb",
        "cannot read gone.glb: no such file or directory; give a mesh file",
    ),
    (
        "info bad.glb",
        (
            "bad.glb is not glTF: its JSON cannot be read (Expecting value: line 1 column 1 (char"
            " 0)); export it again"
        ),
    ),
    (
        "batch gone.csv -o out",
        "cannot read gone.csv: no such file or directory; give a job table",
    ),
    (
        "batch note.txt -o out",
        "note.txt: unknown table format '.txt'; give .jsonl, .csv, .parquet, .toml or .py",
    ),
    (
        "batch jobs.csv --check",
        (
            "jobs.csv, row 1 (line 2): unknown key 'm'; known: id, outputs, exposure, scene, "
            "meta, mesh, camera, lights, environment, material, parts, shading, planned, ambient, "
            "background, pose, before, image, landmarks"
        ),
    ),
    (
        "batch m.csv --check",
        "m.csv, row 1 (line 2): m = 3 is outside [0.0001, 2]: give a value in this range",
    ),
    (
        "batch --status gone",
        (
            "gone is not a batch: its batch.json cannot be read (no such file or directory); give"
            " the output folder of facerender batch"
        ),
    ),
    (
        "plan --budget 1/255 --size 512..256",
        "sizes '512..256': give the smaller size first, such as 512..1024",
    ),
    (
        "plan --parts head --budget 1/255 --size 16 --cost gpu",
        "unknown cost 'gpu'; known: frame, auto, navi21, vega10, llvmpipe, here",
    ),
    (
        "plan --budget 1/255 --target es300",
        "--target es300 has no shader: add --emit OUT.glsl",
    ),
    (
        "plan --budget nan",
        (
            "budget nan is not a finite number: give a fraction of the display's range such as "
            "1/255, 0.5%, or 0.02 flip"
        ),
    ),
    (
        "render --scene planned.toml --m 0.4 -o x.png",
        "planned.toml was planned for m = 0.3: leave --m out, or plan again with --m 0.4",
    ),
    (
        "render --scene planned.toml --roughness-map a.png -o x.png",
        "planned.toml pins m = 0.3043 of the shading: leave --roughness-map out, or plan again "
        "with it",
    ),
    (
        "compare a.png gone.png",
        "cannot read gone.png: no such file or directory; give an image file",
    ),
    (
        "compare a.png b.png",
        "a.png is 8 x 8, b.png is 9 x 9 pixels: render both at one size",
    ),
    (
        "compare a.png note.txt",
        "note.txt: unknown image format '.txt'; give .exr, .npz, .npy, .png, .jpg, .jpeg, .webp, "
        ".tif, .tiff, .gif, .bmp or .tga",
    ),
    (
        "compare a.png a.png --point -1",
        "limit point = -1.0 is outside [0, 1e+30]: give a value in this range",
    ),
    (
        "compare a.png",
        "only one image: give A and B, or --calibrate with a folder",
    ),
    (
        "compare a.png a.png --limits gone.ini",
        "cannot read gone.ini: no such file or directory; give an ini file",
    ),
    (
        "measure --m 5",
        "m = 5.0 is outside [0.0001, 2]: give a value in this range",
    ),
    (
        "explore -o x.png",
        "x.png: the explorer is an HTML page; give a name that ends in .html",
    ),
    (
        "shaders flatten gone",
        (
            "unknown shader 'gone'; known: albedo, constants, cook_torrance, cook_torrance_half, "
            "cook_torrance_sample, cook_torrance_two, environment, fresnel, fresnel/dielectric, "
            "fresnel/schlick, half_vector, lobe, lobe/cosine, lobe/exact, lobe/fitted, "
            "lobe/g_power, masking, masking/kelemen, masking/v_cavity, scatter, shadow, "
            "slope_sample, slope_variance, ward, ward_printed, ward_sample, their functions (see "
            "facerender shaders list), and paths of GLSL files"
        ),
    ),
    (
        "shaders flatten cook_torrance --target dx",
        (
            "argument --target: invalid choice: 'dx' (choose from 330, es300, vulkan, "
            "hlsl, msl, wgsl); see facerender shaders flatten --help"
        ),
    ),
    (
        "shaders flatten cook_torrance --lobe d8 --m 0.9",
        (
            "m = 0.9 is outside the domain of lobe d8 for Cook-Torrance: give m in [0.0001, "
            "0.7071), or use the lobe exact (facerender render: --outside exact)"
        ),
    ),
    (
        "batch bad.toml -o out",
        "bad.toml is not valid TOML: Invalid value (at end of document); correct it",
    ),
    (
        "render --parts head --hide head -o x.png",
        "every part of head.glb is hidden: its parts are head, eyeballs, lash-strands, "
        "tear-line, cornea; hide fewer",
    ),
    (
        "render --camera front --camera profile -o -",
        "-o - takes one image, and there are 2: give --sheet or a file",
    ),
    (
        "plan head.glb --budget 0.5%%",
        (
            "budget '0.5%%' has an unknown unit: give a fraction of the display's range such as "
            "1/255, 0.5%, or 0.02 flip"
        ),
    ),
    (
        "compare --calibrate gone",
        "cannot read gone: no such file or directory; give a folder with a subfolder for each run",
    ),
    (
        "info head.glb --jsn",
        "unrecognized arguments: --jsn; see facerender info --help",
    ),
    (
        "info nofile",
        "cannot read nofile: no such file or directory; give a mesh file",
    ),
    (
        "info head",
        "cannot read head: no such file or directory; give head.glb",
    ),
    (
        "info nosuffix",
        "nosuffix has no suffix, which sets the mesh format; give .glb, .gltf, .obj, .ply or .stl",
    ),
    (
        "compare a b",
        "cannot read a: no such file or directory; give a.png",
    ),
    (
        "compare . gone",
        "cannot read gone: no such file or directory; give an image file",
    ),
    (
        "render --environment nofile -o x.png",
        "cannot read nofile: no such file or directory; give an environment map "
        "(.hdr, .exr, .npy, .npz), or studio",
    ),
    (
        "render --vertices nofile -o x.png",
        "cannot read nofile: no such file or directory; give a file of vertices",
    ),
    (
        "batch nofile -o out",
        "cannot read nofile: no such file or directory; give a job table",
    ),
    (
        "render --background red -o x.png",
        "background = 'red': give 3 numbers in linear RGB, or none for a transparent background",
    ),
    (
        "render --scene red.toml -o x.png",
        "red.toml: background = 'red': give 3 numbers in linear RGB, or none for a "
        "transparent background",
    ),
    (
        "render --scene west.toml -o x.png",
        "west.toml: camera azimuth = 'west' is not a number: give a number in [-3600, 3600], "
        "or front, three-quarter, profile",
    ),
    (
        "render --camera rig.json --size 0 -o x.png",
        "image size 0 x 0: give 1 to 16384 pixels a side",
    ),
    (
        "plan --size 99999 --budget 1/255",
        "image size 99999 x 99999: give 1 to 16384 pixels a side",
    ),
    (
        "render --m rough -o x.png",
        "argument --m: 'rough' is not a number: give 0.0001 to 2; see facerender render --help",
    ),
    (
        "render --samples 1.5 -o x.png",
        "argument --samples: '1.5' is not a whole number: give 1 to 64; see facerender render "
        "--help",
    ),
    (
        "render --albedo '' -o x.png",
        "the value of --albedo is empty: give a value, or leave it out",
    ),
    (
        "render --scene= -o x.png",
        "the value of --scene is empty: give a value, or leave it out",
    ),
    (
        "info ''",
        "an argument is empty: give a value, or leave it out",
    ),
    (
        "shaders flatten gone.frag",
        "cannot read gone.frag: no such file or directory; give a GLSL file",
    ),
    (
        "shaders flatten shadow --target hlsl",
        "facerender/shadow.glsl in HLSL: not translated: function fr_shadow_depth: 'sampler2D'; "
        "only functions and constants of numbers, vectors and matrices are supported; write this "
        "code in HLSL, or convert the SPIR-V of target vulkan with spirv-cross",
    ),
]
FILES = {
    "nosuffix": "x",
    "red.toml": "background = 'red'\n",
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


@pytest.mark.parametrize(("command", "message"), MESSAGES, ids=[each[0] for each in MESSAGES])
def test_the_message_of_a_bad_command(command, message, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("facerender.commands.plan._SILENT", math.inf)
    files = sorted(folder.iterdir())
    assert main(shlex.split(command)) == 2
    out, err = capsys.readouterr()
    # Python 3.12 and earlier quote the choices.
    err = re.sub(r"choose from [^)]*", lambda choices: choices[0].replace("'", ""), err)
    assert (out, err) == ("", f"facerender: error: {message}\n")
    assert sorted(folder.iterdir()) == files
