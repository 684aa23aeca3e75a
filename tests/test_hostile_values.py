"""Tests hostile images, scenes and numbers: the result is a valid value or a one-line error, in
bounded memory. Tracebacks, non-finite images and empty images without a warning must not occur."""

from __future__ import annotations

import io
import re
import struct
import warnings
import zipfile
import zlib
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import material as materials
from facerender.commands import INTERNAL_ERROR, main
from facerender.comparison import sources, windows
from facerender.drawing import compiled
from facerender.drawing.frame import check_images
from facerender.errors import InputError
from facerender.images.files import MAX_PIXELS, check_pixels, read_image
from facerender.scene.job import load_scene
from facerender.texture.texture import Texture
from tests.awkward_files import MINI_HEAD

LONGEST = 500
HEAD = fr.load_mesh(MINI_HEAD)


def content(save, *arguments: object, **options: object) -> bytes:
    memory = io.BytesIO()
    save(memory, *arguments, **options)
    return memory.getvalue()


def pixels(height: int = 12, width: int = 14, channels: int = 3) -> np.ndarray:
    values = np.random.default_rng(1).integers(0, 256, (height, width, channels), dtype=np.uint8)
    return np.squeeze(values)


def png(array: np.ndarray) -> bytes:
    return content(Image.fromarray(array).save, "PNG")


def chunk(name: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(name + data)
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)


def refused(read, path: Path) -> str:
    """Return the error message about a file, one printable line."""
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert path.name in message
    assert len(message) <= LONGEST
    assert message.isprintable()
    return message


def decode(path: Path) -> None:
    Texture.open(path).levels("color").result()


# --- images --------------------------------------------------------------------------------------


def _npy(header: str) -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + bytes(64)


def _npz(name: str, data: bytes, damage: bool = False) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, data)
    packed = bytearray(memory.getvalue())
    if damage:
        packed[60:90] = b"\xff" * 30
    return bytes(packed)


FLOATS = content(np.save, pixels().astype(np.float32))
IMAGES = {
    "zlib.npz": (_npz("linear.npy", FLOATS, damage=True), "is not a NumPy file"),
    "vast.npy": (
        _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (99999999, 99999999, 3)}"),
        "at most 16384 a side",
    ),
    "below.npy": (_npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 4, 3)}"), "pixels"),
    "bomb.npy": (
        _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (9000, 9000, 3)}"),
        "which 192 bytes cannot hold",
    ),
    "deep.npy": (_npy("{'descr': '<f4', 'shape': (" + "-" * 90), "is not a NumPy file"),
    "object.npy": (content(np.save, np.array([{}], object)), "contains Python objects"),
    "bomb.png": (
        (start := png(pixels()))[:8]
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 16000, 16000, 8, 2, 0, 0, 0))
        + start[33:],
        "256000000 pixels: at most 16384 a side and 1.79e[+]08 pixels; make it smaller",
    ),
    "wide.png": (
        start[:8] + chunk(b"IHDR", struct.pack(">IIBBBBB", 20000, 4, 8, 2, 0, 0, 0)) + start[33:],
        "20000 x 4 pixels .* at most 16384 a side",
    ),
    "empty.jpg": (b"", "is empty|not an image"),
    "tall.jpg": (content(Image.new("L", (4, 20000)).save, "jpeg"), "4 x 20000 pixels .* 16384 a"),
    "feeds.png": (start.replace(b"\r\n", b"\n"), "is a PNG image that was converted as text; tr"),
    "pointer.png": (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
}


@pytest.mark.parametrize("name", IMAGES)
def test_invalid_images_are_refused(name, tmp_path, capsys):
    data, message = IMAGES[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_image(path)
    refused(read_image, path)
    if path.suffix != ".npy" and path.suffix != ".npz":
        refused(decode, path)
    assert main(["compare", str(path), str(path)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1


def test_zip_bomb_is_refused_before_decompression(tmp_path):
    head = content(
        np.lib.format.write_array_header_1_0,
        {"descr": "<f8", "fortran_order": False, "shape": (16000, 11000, 3)},
    )
    path = tmp_path / "bomb.npz"
    path.write_bytes(_npz("linear.npy", head + bytes(1 << 20)))
    assert "2048 MiB" in refused(read_image, path)


def _exr(window: tuple[int, ...], tmp_path: Path) -> Path:
    OpenEXR = pytest.importorskip("OpenEXR")
    path = tmp_path / "window.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ones((4, 4, 3), np.float32)}).write(str(path))
    content = path.read_bytes()
    for name in (b"dataWindow", b"displayWindow"):
        at = content.index(name + b"\0box2i\0") + len(name) + 11
        content = content[:at] + struct.pack("<4i", *window) + content[at + 16 :]
    path.write_bytes(content)
    return path


EXTREME = (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1)


@pytest.mark.parametrize(
    ("window", "message"),
    [
        ((0, 0, 19999, 19999), "20000 x 20000 pixels .* at most 16384 a side"),
        ((0, 0, 9999, 9999), "10000 x 10000 pixels, which .* bytes cannot hold"),
        (EXTREME, "at most 16384 a side"),
        ((5, 5, 2, 2), "-2 x -2 pixels"),
    ],
)
def test_large_windows_of_exr_are_refused(window, message, tmp_path):
    path = _exr(window, tmp_path)
    with pytest.raises(InputError, match=message):
        read_image(path)
    refused(read_image, path)


def test_limits_of_image_sizes():
    check_pixels("a", 16384, MAX_PIXELS // 16384, 4, 1 << 30)
    for size in ((16385, 1), (1, 16385), (16384, MAX_PIXELS // 16384 + 1), (0, 4), (4, 0)):
        with pytest.raises(InputError):
            check_pixels("a", *size, 4, 1 << 30)
    with pytest.raises(InputError, match="at most .* 2048 MiB"):
        check_pixels("a", 16384, 10000, 16, 1 << 30)


def test_size_of_maps_is_known_before_decoding_and_limited(monkeypatch, tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "a.png")
    map = fr.Texture.open(tmp_path / "a.png")
    assert map.size == map.channel(1, "green").size == (14, 12)
    map.levels("color").result()
    assert map.size == (14, 12)
    monkeypatch.setattr(materials, "MAX_TEXELS", 12 * 14 - 1)
    with pytest.raises(InputError, match="maps of mini_head.glb have .* million texels, more than"):
        HEAD.with_material(albedo_map=map, normal_map=None, roughness_map=None, occlusion_map=None)


# --- compare -------------------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize("rows", [1, 16, 300, 700])
def test_comparison_in_strips_equals_the_whole(rows, monkeypatch):
    """The upper half is not covered, so that some strips have alpha 0 everywhere."""
    chance = np.random.default_rng(rows)
    a = chance.random((rows, 90, 4), dtype=np.float32)
    a[:, 40:, :3] = 0.3 + 0.002 * a[:, 40:, :3]
    a[18::16, 50, :3] = 0.0  # black also in A, three rows below and in the next strip
    a[..., 3] = np.arange(rows)[:, None] >= rows // 2
    b = a * (1.0 + 0.002 * chance.standard_normal((rows, 90, 1), dtype=np.float32))
    b[15::16, 50, :3] = 0.0
    b[chance.random((rows, 90)) < 0.01] *= np.float32(1.5)
    b[..., 3] = a[..., 3]
    strips = fr.compare(a, b).as_dict()
    monkeypatch.setattr(windows, "_STRIP", 1)
    whole = fr.compare(a, b).as_dict()
    for name in ("mean", "shift", "trend", "z_score", "gain", "block", "grain", "texture"):
        assert strips.pop(name) == pytest.approx(whole.pop(name), rel=1e-4, abs=1e-6)
    assert strips == whole


def test_values_whose_differences_overflow_are_refused():
    a = np.zeros((32, 32, 3), np.float32)
    b = a.copy()
    b[3, 4] = 2e38
    with pytest.raises(InputError, match=r"B holds values beyond 1e\+30, .* pixel \(4, 3\)"):
        fr.compare(a, b)


@pytest.mark.parametrize(
    ("fault", "status", "reason"),
    [
        (ValueError("no\nsuch thing"), INTERNAL_ERROR, r"\(ValueError: no such thing\)"),
        (AssertionError(), INTERNAL_ERROR, r"\(AssertionError\)"),
        (MemoryError(), 2, "out of memory"),
        (RecursionError("deep"), INTERNAL_ERROR, "RecursionError"),
    ],
)
def test_internal_errors_of_compare_have_another_exit_status(
    fault, status, reason, monkeypatch, tmp_path, capsys
):
    def fail(*_: object) -> None:
        raise fault

    monkeypatch.setattr(sources, "read_image", fail)
    command = ["compare", str(tmp_path / "a.png"), str(tmp_path / "a.png")]
    assert main(command) == status
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    assert re.search(reason, err)
    assert INTERNAL_ERROR not in (0, 1, 2, 3, 130)
    monkeypatch.setenv("FACERENDER_DEBUG", "1")
    main(command)
    assert ("Traceback" in capsys.readouterr().err) == (status == INTERNAL_ERROR)


# --- numbers -------------------------------------------------------------------------------------

DIGITS = "1" + "0" * 400
SCENES = {  # test_ranges.py has single numbers outside their ranges
    "digits": f"ambient = {DIGITS}",
    "four": "ambient = [1, 1, 1, 1]",
    "place": "[camera]\nposition = [1e300, 0, 0]",
    "light": "lights = [{ position = [1e31, 0, 0] }]",
    "scattering": f"[material]\nscattering = [[{DIGITS}, 0, 0, 0]]",
    "sizes": f"[planned]\nsizes = [[{DIGITS}, 1]]\nsamples = 4",
    "term": "[shading]\nfresnel = [[]]",
    "lobe": "[shading]\nlobe = { a = {} }",
    "long": f"'{'x' * 10_000}' = 1",
    "escape": "'\\u001b[31m' = 1",
}


@pytest.mark.parametrize("name", SCENES)
def test_numbers_of_scenes(name, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENES[name])
    refused(load_scene, path)


def test_messages_shorten_long_values():
    with pytest.raises(InputError) as caught:
        fr.Camera(azimuth=10**5000)
    assert len(str(caught.value)) < 200
    with pytest.raises(InputError) as caught:
        fr.Light(position=["x" * 10**6, 0, 0])
    assert len(str(caught.value)) < 300


# --- rendered images -----------------------------------------------------------------------------


def beside(*radii: float, mesh: fr.Mesh = HEAD) -> tuple[float, ...]:
    return tuple((mesh.center + mesh.radius * np.array(radii)).tolist())


HIDDEN = {
    "behind": ({"position": beside(0, 0, 3), "target": beside(0, 0, 6)}, "behind the camera"),
    "outside": ({"target": beside(6, 0, 0)}, "left of the frame; set camera target"),
    "below": ({"target": beside(0, 9, 0)}, "below the frame"),
    "small": ({"position": beside(1.3, 0, 1e5)}, r"it is .* pixels large; move the camera nearer"),
}


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1, 4])
def test_image_without_the_mesh_warns_with_the_reason(samples, recwarn):
    with fr.Renderer((64, 48), samples=samples) as renderer:
        renderer.render(fr.Scene(HEAD, fr.Camera(zoom=0.2, target=beside(2.6, 0, 0))))
        assert not recwarn.list
        for (camera, reason), only in product(HIDDEN.values(), (None, "normal")):
            with pytest.warns(
                fr.FacerenderWarning, match=f"no pixel shows mini_head.glb: .*{reason}"
            ):
                renderer.render(fr.Scene(HEAD, fr.Camera(**camera)), only=only)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_pixels_raise(value, monkeypatch):
    def read(*arguments: Any) -> np.ndarray:
        image = true_read(*arguments)
        image[5, 7, 1] = value
        return image

    true_read = compiled.read
    monkeypatch.setattr(compiled, "read", read)
    with (
        fr.Renderer((64, 48)) as renderer,
        pytest.raises(InputError, match=r"1 pixels of mini_head.glb are not finite, .* \(7, 5\)"),
    ):
        renderer.render(fr.Scene(HEAD))


def test_large_pixels_are_accepted(monkeypatch):
    """The sum of an image may overflow although every pixel is finite."""
    image = np.full((8, 8, 4), 3e38, np.float32)
    check_images({"image": image}, fr.Scene(HEAD), 0.5)


@pytest.mark.parametrize(
    "rows", [[[1.0, 0.1]] * 2, [[1.0, 0.1, 0.2, 0.3, 5.0, 0.1, 0.1, 0.1]], [[1.0, 0.1, 0.2, "a"]]]
)
def test_rows_of_a_scattering_profile_have_four_numbers(rows):
    with pytest.raises(InputError, match="scattering = .*: give a name, or 1 to 16 Gaussians"):
        fr.Material(scattering=rows)


STRONG = {"irradiance": 1e9}


def ends(head: fr.Mesh) -> dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]]:
    """Return cameras, lights and materials at the ends of their ranges."""
    near = partial(beside, mesh=head)
    return {
        "orbit": ({"azimuth": 3600, "elevation": 90, "fov": 150, "zoom": 1000}, {}, {}),
        "from below": ({"azimuth": -3600, "elevation": -90, "fov": 1, "zoom": 0.01}, {}, {}),
        "far": ({"position": near(9.9e5, 0, 0)}, {}, {}),
        "near": ({"position": near(0, 0, 2e-6)}, {}, {}),
        "strong light": ({}, STRONG, {"ks": 1e6, "kd": 1e6, "albedo": 1e9, "m": 1e-4}),
        "smooth": ({}, {}, {"m": 1e-4, "f0": 0.999}),
        "rough": ({}, {}, {"m": 2, "f0": 0, "ks": 0, "kd": 0, "albedo": 0}),
        "two lobes": ({}, STRONG, {"m": 0.01, "second_slope": 100, "lobe_weight": 0.5}),
        "far light": ({}, STRONG | {"position": near(9.9e5, 0, 0), "shadow": True}, {}),
        "light within": ({}, STRONG | {"position": near(0, 0, 1e-5), "shadow": False}, {}),
        "on a vertex": (
            {},
            STRONG | {"position": tuple(head.parts[0].positions[100].tolist()), "shadow": False},
            {},
        ),
        "wide light": ({}, STRONG | {"radius": 20, "shadow": True}, {}),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "samples"),
    [(MINI_HEAD, 4), *(pytest.param(None, n, marks=pytest.mark.slow) for n in (1, 4))],
    ids=str,
)
@pytest.mark.filterwarnings("ignore::facerender.FacerenderWarning")
def test_images_at_the_ends_of_all_ranges_are_finite(path, samples):
    head = fr.load_mesh(path)
    with fr.Renderer((40, 40), samples=samples) as renderer:
        for name, (camera, light, changes) in ends(head).items():
            mesh = head.with_material(**changes) if changes else head
            scene = fr.Scene(mesh, fr.Camera(**camera), (fr.Light(**light),), ambient=1e9)
            for shading in (fr.Shading(), fr.Shading(model="ward"), fr.Shading(diffuse="coupled")):
                frame = renderer.render(scene, shading)
                assert np.isfinite(frame.linear).all(), name
                for exposure in (-100.0, 100.0):
                    frame.srgb8(exposure)


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("camera position", {"camera": fr.Camera(position=(1e30, 0.0, 0.0))}),
        ("camera target", {"camera": fr.Camera(target=(1e30, 0.0, 0.0))}),
        *(
            ("point light", {"lights": (fr.Light(position=(1e30, 0.0, 0.0), **extra),)})
            for extra in ({}, {"shadow": True})
        ),
    ],
)
def test_positions_beyond_float32_precision_are_refused(what, changes):
    with (
        fr.Renderer((16, 16)) as renderer,
        pytest.raises(InputError, match=rf"{what} .* mesh radii .* give at most 1e\+06"),
    ):
        renderer.render(fr.Scene(HEAD, **changes))


@pytest.mark.parametrize("seed", range(40))
def test_metrics_of_any_two_images_are_finite(seed):
    chance = np.random.default_rng(seed)
    shape = (*chance.integers(1, 80, 2), int(chance.choice([1, 3, 4])))
    a = (chance.normal(size=shape) * 10.0 ** chance.choice([-40, -5, 0, 10, 27])).astype(np.float32)
    b = (a * (1.0 + chance.normal(size=shape) * chance.choice([0.0, 0.1, 3.0]))).astype(np.float32)
    b[chance.random(shape[:2]) < 0.1] = 10.0 ** chance.integers(-38, 30)
    with warnings.catch_warnings(action="error"):
        result = fr.compare(a, b)
    figures = (value for value in result.as_dict().values() if isinstance(value, float))
    assert np.isfinite([*figures, *result.shift]).all()
