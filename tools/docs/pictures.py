"""Draw the images of the README and of the documents.

python -m tools.docs.pictures [NAME ...]      from the repository's root; a minute

All images need an OpenGL context. slope-filter, occlusion and heads also need the heads of the
tests, explorer needs Chromium. explorer also writes docs/explorer.html, the page of the built-in
head. Its 3.6 MB are not in the repository.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

import facerender as fr
from benchmarks.skin import subjects
from benchmarks.skin_environment import sky
from facerender.commands import main as main_command
from facerender.images.image import encode_srgb8
from facerender.loading.source import BUILT_IN
from facerender.scene.environment import studio
from facerender.texture.texture import Texture
from tests.verification.scan import load_scan, scan_folder
from tests.verification.slope_filter import Bench, relief

DOCS = Path(__file__).parents[2] / "docs"
IMAGES = DOCS / "images"
Pixels = NDArray[np.uint8]


def save(name: str, rows: Iterable[Iterable[Pixels]], quality: int, scale: int = 1) -> None:
    """Write rows of images as one JPEG; each pixel becomes a square with sides of ``scale``."""
    image = np.vstack([np.hstack([each[..., :3] for each in row]) for row in rows])
    image = image.repeat(scale, axis=0).repeat(scale, axis=1)
    Image.fromarray(image).save(IMAGES / f"{name}.jpg", quality=quality)


def halved(image: Pixels) -> Pixels:
    """Return an image at half its size; each pixel is the mean of four."""
    return np.asarray(Image.fromarray(image).reduce(2))


def exact_d16() -> None:
    """Draw the exact lobe, D16, and eight times their difference, with one m for all pixels."""
    scene = fr.Scene(fr.load_mesh().with_material(m=0.4), fr.Camera(-35.0, 4.0))
    with fr.Renderer((960, 960)) as renderer:
        exact, d16 = (renderer.render(scene, fr.Shading(lobe=lobe)) for lobe in ("exact", "d16"))
    difference = np.abs(d16.linear[..., :3] - exact.linear[..., :3])
    amplified = np.multiply(difference, 8.0, dtype=np.float32)
    shown = (exact.srgb8(), d16.srgb8(), encode_srgb8(amplified))
    save("exact-d16", [map(halved, shown)], 90)


def explorer() -> None:
    """Draw the explorer in a browser: D8 at a slope at which it errs by several 8-bit levels."""
    from playwright.sync_api import sync_playwright

    from facerender.explorer.page import explorer_page
    from facerender.scene.job import Job
    from tests.verification import chromium

    page = DOCS / "explorer.html"
    page.write_text(explorer_page(Job(), fr.load_mesh()), encoding="utf-8")
    link = "#a=m:0.35&b=lobe:d8;m:0.35&camera=azimuth:-28;elevation:4&cut=0.46&budget=4"
    with sync_playwright() as playwright:
        browser = chromium.launch(playwright)
        tab = browser.new_page(viewport={"width": 1280, "height": 760}, color_scheme="dark")
        tab.goto(page.as_uri() + link)
        tab.evaluate("explorer.errors()")
        image = Image.open(io.BytesIO(tab.screenshot()))
        browser.close()
    image.convert("RGB").save(IMAGES / "explorer.jpg", quality=85, optimize=True)


def slope_filter(size: int = 192) -> None:
    """Draw head and scan without and with the slope filter, and as a supersampled reference."""
    rows = []
    for mesh, slopes in subjects().values():
        bench = Bench.of(mesh, relief(slopes, 3.0), 0.15, size)
        bench = replace(bench, camera=fr.Camera(-20.0, zoom=1.5))
        with fr.Renderer((2 * size,) * 2) as renderer:
            expected = bench.reference(renderer)
        with fr.Renderer((size, size)) as renderer:
            shadings = fr.Shading(slope_filter=False), fr.Shading()
            images = [bench.image(renderer, shading) for shading in shadings]
        shown = [np.asarray(each, np.float32)[..., :3] for each in (*images, expected)]
        rows.append(map(encode_srgb8, shown))
    save("slope-filter", rows, 88, scale=2)


def environment(size: int = 420) -> None:
    """Draw the head and its specular term under the default lights, in the studio and under the
    sky."""
    mesh, camera = fr.load_mesh(), fr.Camera(azimuth=-35.0, zoom=1.3)
    scenes = [fr.Scene(mesh, camera)]
    for panorama, scale in ((studio(), 1.0), (sky(), 0.9)):
        around = fr.Environment(panorama, 0.0, scale)
        scenes.append(fr.Scene(mesh, camera, (), 0.0, environment=around))
    with fr.Renderer((size, size)) as renderer:
        whole = [renderer.render(scene).srgb8() for scene in scenes]
        specular = [renderer.render(scene, only="specular").srgb8(2.0) for scene in scenes]
    save("environment", [whole, specular], 86)


def lobes(size: int = 420) -> None:
    """Draw one lobe, two lobes and sweat; draw the Lambert and the coupled diffuse term, and eight
    times their difference."""
    skin: dict[str, Any] = {"second_slope": 0.333, "lobe_weight": 0.85}
    sweat: dict[str, Any] = {"second_slope": 0.35, "lobe_weight": 0.5, "lobe_map": _film()}
    mesh, camera = fr.load_mesh(), fr.Camera(azimuth=-35.0, zoom=1.35)
    with fr.Renderer((size, size)) as renderer:

        def drawn(shading: fr.Shading = fr.Shading(), **material: Any) -> Pixels:
            return renderer.render(fr.Scene(mesh.with_skin(**material), camera), shading).srgb8()

        plain, coupled = drawn(), drawn(fr.Shading(diffuse="coupled"))
        save("two-lobes", [[plain, drawn(**skin), drawn(**sweat)]], 84)
    taken = np.clip(8 * (plain.astype(int) - coupled), 0, 255).astype(np.uint8)
    save("coupled", [[plain, coupled, taken]], 84)


def _film() -> Texture:
    """Return a map of sweat: smoothed noise, as a film with gaps."""
    noise = np.random.default_rng(4).integers(0, 256, (512, 512), dtype=np.uint8)
    smooth = np.asarray(Image.fromarray(noise).filter(ImageFilter.GaussianBlur(4)), dtype=float)
    film = np.clip(2.0 * ((smooth - smooth.mean()) / smooth.std() - 0.6), 0.0, 1.0)
    return Texture(lambda: Image.fromarray(np.round(255.0 * film).astype(np.uint8)), "sweat")


def scattering() -> None:
    """Draw the head without and with subsurface scattering, and eight times the difference."""
    mesh = fr.load_mesh().with_skin(scattering="skin")
    lights = (fr.Light(-50.0, 42.0, 3.0, shadow=True), fr.Light(80.0, 20.0, 0.5))
    scene = fr.Scene(mesh, fr.Camera(-35.0, zoom=1.6), lights)
    with fr.Renderer((480, 480)) as renderer:
        shadings = (fr.Shading(scatter_samples=count) for count in (0, 32))
        off, on = (renderer.render(scene, each).srgb8() for each in shadings)
    change = np.clip(128 + 8 * (on.astype(int) - off), 0, 255).astype(np.uint8)
    save("scattering", [[off, on, change]], 86)


def shadows(size: int = 440) -> None:
    """Draw the head without shadows, with hard shadows and with soft shadows."""
    mesh = fr.load_mesh()
    images = []
    with fr.Renderer((size, size)) as renderer:
        for shadow, radius in ((False, 0.0), (True, 0.0), (True, 5.0)):
            lights = (replace(e, shadow=shadow, radius=radius) for e in fr.Scene(mesh).lights)
            scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.35), tuple(lights))
            images.append(renderer.render(scene).srgb8())
    save("shadows", [images], 88)


def photographs(size: int = 440) -> None:
    """Draw the head with a map of photographs under hard light: under the default lights, under
    soft light with a weak highlight, and unlit."""
    mesh = fr.load_mesh().with_skin(normal_map=None)
    mesh = mesh.with_skin(albedo_map=_photographed(mesh))
    camera, light = fr.Camera(-20.0, zoom=1.5), fr.Light(0.0, 20.0, 1.2, radius=20.0)
    scenes = (
        fr.Scene(mesh, camera),
        fr.Scene(mesh.with_skin(ks=0.3), camera, (light,), ambient=1.6),
        fr.Scene(mesh.with_material(unlit=True), camera),
    )
    with fr.Renderer((size, size)) as renderer:
        save("photographs", [[renderer.render(scene).srgb8() for scene in scenes]], 88)


def _photographed(mesh: fr.Mesh, side: int = 1024) -> Texture:
    """Return the skin's albedo map as photographs from the front and from the sides show it, with
    their light and highlights."""
    sharp = mesh.with_skin(m=0.2, ks=2.0)
    lights = (fr.Light(45.0, 25.0, 5.0, radius=3.0), fr.Light(-70.0, 20.0, 1.0))
    albedo = mesh.materials[mesh.skin[0]].albedo_map
    assert albedo is not None
    plain = np.asarray(albedo.rgb().resize((side, side)), np.float64)
    sums, weights = 0.05 * plain, np.full((side, side, 1), 0.05)
    with fr.Renderer((2 * side, 2 * side), samples=1) as renderer:
        for azimuth in (0.0, -50.0, 50.0):
            scene = fr.Scene(sharp, fr.Camera(azimuth, frame="head"), lights, ambient=0.5)
            photograph, gbuffer = renderer.render(scene), renderer.gbuffer(scene)
            of_skin = np.isin(gbuffer.part, mesh.skin)
            rays = gbuffer.view.position - gbuffer.normalised_position[of_skin]
            facing = (rays * gbuffer.normal[of_skin]).sum(axis=1) / np.linalg.norm(rays, axis=1)
            column, row = (gbuffer.uv[of_skin] * side).astype(int).clip(0, side - 1).T
            weight = facing.clip(0.0)[:, None] ** 8
            texel = side - 1 - row, column
            np.add.at(sums, texel, weight * photograph.srgb8()[of_skin][:, :3])
            np.add.at(weights, texel, weight)
    return Texture.from_array(np.round(sums / weights).astype(np.uint8))


def occlusion(size: int = 440) -> None:
    """Draw the scan without and with baked occlusion, in ambient light and under the default
    lights."""
    if (folder := scan_folder()) is None:
        raise SystemExit("no head scan: set FACERENDER_TEST_DATA")
    bare = load_scan(folder).with_material(occlusion_map=None)
    baked, images = fr.with_occlusion(bare), []
    with fr.Renderer((size, size)) as renderer:
        for ambient in (True, False):
            for mesh in (bare, baked):
                scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6))
                scene = replace(scene, lights=(), ambient=3.0) if ambient else scene
                images.append(renderer.render(scene).srgb8())
    save("occlusion", [images], 88)


def heads(size: int = 480) -> None:
    """Draw the scan and ICT-FaceKit's head with default settings."""
    if (folder := scan_folder()) is None:
        raise SystemExit("no head scan: set FACERENDER_TEST_DATA")
    face_kit = fr.load_mesh(folder.parent / "ICT-FaceKit" / "generic_neutral_mesh.obj")
    with fr.Renderer((size, size)) as renderer:
        images = [
            renderer.render(fr.Scene(mesh, camera)).srgb8()
            for mesh in (load_scan(folder), face_kit)
            for camera in (fr.Camera(), fr.Camera(-35.0, 3.0))
        ]
    save("gallery/heads", [images], 88)


def gallery() -> None:
    """Run the commands and the Python code of docs/gallery.md; write their images as JPEG, and
    animations as they are, for that page."""
    page = (DOCS / "gallery.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.chdir(folder):
            for block in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE):
                exec(block, {})
        for path in Path(folder).iterdir():
            image = Image.open(path).convert("RGB")
            image.save(IMAGES / "gallery" / f"{path.stem}.jpg", quality=88)
        for command in re.findall(r"^facerender (.+)$", page, re.MULTILINE):
            *options, name = shlex.split(command)
            path = Path(folder, name)
            if main_command([*options, str(path)]):
                raise SystemExit(f"no picture from: facerender {command}")
            if path.suffix == ".webp":
                shutil.copy(path, IMAGES / "gallery")
                continue
            image = Image.open(path).convert("RGB")
            image.save(IMAGES / "gallery" / f"{path.stem}.jpg", quality=88)


def readme() -> None:
    """Join four pictures of the gallery for the README."""
    names = ("portrait", "scattering", "specular", "normals")
    save("readme", [[np.asarray(Image.open(IMAGES / "gallery" / f"{e}.jpg")) for e in names]], 86)


def views() -> None:
    """Draw the sheet of standard views of the built-in head, and the changes of a nose and a chin,
    for docs/views.md."""
    (skin,) = fr.load_mesh().select("head").parts
    changed, face = skin.positions.copy(), fr.find_face(fr.load_mesh())
    assert face is not None
    eyes, front = face.eyes.mean(axis=0), skin.positions[:, 2]
    for below, width, depth in ((0.045, 0.012, -0.003), (0.115, 0.018, 0.005)):
        near = np.abs(skin.positions - eyes)[:, 0] < 0.012
        near &= np.abs(skin.positions[:, 1] - eyes[1] + below) < 0.012
        tip = skin.positions[near][front[near].argmax()]
        distances = ((skin.positions - tip) ** 2).sum(axis=1)
        changed[:, 2] += depth * np.exp(-distances / (2.0 * width**2))
    with tempfile.TemporaryDirectory() as folder:
        for name, positions in (("before", skin.positions), ("after", changed)):
            lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in positions]
            lines += [f"f {a} {b} {c}" for a, b, c in skin.faces + 1]
            Path(folder, f"{name}.obj").write_text("\n".join(lines))
        scans = [f"{folder}/{name}.obj" for name in ("before", "after")]
        for name, meshes in (("sheet", [str(BUILT_IN)]), ("changes", scans)):
            main_command(["views", *meshes, "--size", "320", "-o", folder])
            picture = "views" if name == "sheet" else name
            image = Image.open(Path(folder, f"{name}.png")).convert("RGB")
            image.save(IMAGES / f"{picture}.jpg", quality=88)


PICTURES: dict[str, Callable[[], None]] = {
    **{"gallery": gallery, "readme": readme},
    **{"exact-d16": exact_d16, "explorer": explorer, "slope-filter": slope_filter},
    **{"environment": environment, "lobes": lobes, "scattering": scattering, "shadows": shadows},
    **{"photographs": photographs, "views": views},
    **{"occlusion": occlusion, "heads": heads},
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.docs.pictures")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(PICTURES)} (all)")
    options = parser.parse_args()
    if unknown := set(options.names).difference(PICTURES):
        parser.error(f"unknown image {', '.join(unknown)}; known: {', '.join(PICTURES)}")
    for name in options.names or PICTURES:
        PICTURES[name]()


if __name__ == "__main__":
    main()
