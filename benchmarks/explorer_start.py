"""Measure the time to the first image of the explorer and of comparable three.js pages.

    python benchmarks/explorer_start.py [--turns 9] [--keep FOLDER]

Chromium on SwiftShader starts anew for each page, a single file opened from disk; the pages take
turns. The time runs from the start of the navigation until a pixel of the first image can be read.
The three.js pages (``peers/explorer``, bundled with Vite; npm installs both) show the same mesh,
maps and number of lights at the size of the explorer's image. The equal page shows two shadings in
a split view, on float targets with four samples; the plain page shows one shading on the canvas.

Prints the file sizes, medians and ranges, and the medians of the ratios within a turn.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Playwright, ViewportSize, sync_playwright

import facerender as fr
from facerender.explorer.page import explorer_page
from facerender.scene.job import Job
from facerender.system.files import data_dir
from tests.verification import chromium

ROOT = Path(__file__).parents[1]
SOURCE = Path(__file__).parent / "peers" / "explorer" / "main.js"
VIEWPORT: ViewportSize = {"width": 1280, "height": 800}
EXPLORER, EQUAL, PLAIN = "facerender explore", "three.js, equal", "three.js, plain"

# Records when the frame with the first draw of the mesh is complete. A draw with fewer than 1000
# indices is not the mesh.
CLOCK = """
const drawn = WebGL2RenderingContext.prototype.drawElements;
WebGL2RenderingContext.prototype.drawElements = function (mode, count, ...rest) {
  drawn.call(this, mode, count, ...rest);
  if (count < 1000 || window.begun) return;
  window.begun = true;
  setTimeout(() => {
    this.bindFramebuffer(this.READ_FRAMEBUFFER, null);
    this.readPixels(0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, new Uint8Array(4));
    window.firstPicture = performance.now();
  });
};
"""


def bundled(folder: Path) -> str:
    """Return the script of the three.js pages, with the library versions of examples/threejs."""
    example = ROOT / "examples" / "threejs"
    work = folder / "examples" / "threejs"
    work.mkdir(parents=True)
    for path in (example / "package.json", example / "package-lock.json", SOURCE):
        shutil.copy(path, work)
    package = folder / "out" / "npm"
    subprocess.run([sys.executable, ROOT / "tools" / "npm-package", "-o", package], check=True)
    config = "export default {build: {lib: {entry: 'main.js', formats: ['es'], fileName: 'page'}}}"
    (work / "vite.config.js").write_text(config)
    tools = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "NODE_USE_SYSTEM_CA": "1", "PATH": tools}
    for command in ("npm ci --no-audit --no-fund", "node node_modules/vite/bin/vite.js build"):
        subprocess.run(command.split(), cwd=work, env=environment, check=True, stdout=sys.stderr)
    return (work / "dist" / "page.js").read_text(encoding="utf-8")


def peer(script: str, size: list[int]) -> str:
    """Return the three.js page as HTML; ``size`` is the size of its image in pixels."""
    job = Job()
    head = data_dir("assets") / "head.glb"
    mesh = fr.load_mesh(head)
    scene = fr.Scene(mesh, job.camera)
    facts = {
        "size": size,
        "eye": (mesh.radius * fr.view_of(scene, size[0] / size[1]).position).tolist(),
        "fov": job.camera.fov,
        "lights": [
            {"direction": list(light.direction), "irradiance": _rgb(light.irradiance)}
            for light in job.lights
        ],
        "ambient": _rgb(job.ambient),
        "background": _rgb(job.background or 0.0),
    }
    embedded = base64.b64encode(head.read_bytes()).decode()
    script = script.replace("</script", "<\\/script")
    return (
        "<!doctype html><meta charset='utf-8'><title>three.js</title>"
        "<style>body { margin: 0 } canvas { display: block }</style><canvas></canvas>"
        f"<script type='application/json' id='facts'>{json.dumps(facts)}</script>"
        f"<script type='text/plain' id='head'>{embedded}</script>"
        f"<script type='module'>{script}</script>"
    )


def _rgb(value: Any) -> list[float]:
    return [value] * 3 if isinstance(value, int | float) else list(value)


def first_image(playwright: Playwright, address: str, keep: Path | None) -> float:
    browser = chromium.launch(playwright)
    page = browser.new_page(viewport=VIEWPORT)
    page.add_init_script(CLOCK)
    page.goto(address)
    page.wait_for_function("window.firstPicture")
    time = float(page.evaluate("firstPicture"))
    if keep is not None:
        page.screenshot(path=keep)
    browser.close()
    return time


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="folder for pages and images")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        ours, theirs = folder / "explorer.html", folder / "three.html"
        ours.write_text(explorer_page(Job(), fr.load_mesh()), encoding="utf-8")
        browser = chromium.launch(playwright)
        page = browser.new_page(viewport=VIEWPORT)
        page.goto(ours.as_uri())
        size = page.evaluate("explorer.errors().then(() => explorer.size)")
        version = browser.version
        browser.close()
        theirs.write_text(peer(bundled(Path(temporary)), size), encoding="utf-8")
        pages = {
            EXPLORER: ours.as_uri(),
            EQUAL: theirs.as_uri(),
            PLAIN: f"{theirs.as_uri()}#plain",
        }
        times: dict[str, list[float]] = {name: [] for name in pages}
        for turn in range(options.turns):
            for index, (name, address) in enumerate(pages.items()):
                keep = folder / f"{index}.png" if options.keep and not turn else None
                times[name].append(first_image(playwright, address, keep))
        print(f"Chromium {version} on SwiftShader, {size[0]} x {size[1]} pixels")
        sizes = [path.stat().st_size / 1e6 for path in (ours, theirs, theirs)]
        for megabytes, (name, each) in zip(sizes, times.items(), strict=True):
            ratio = statistics.median(a / b for a, b in zip(times[EXPLORER], each, strict=True))
            print(
                f"{name:20} {megabytes:4.1f} MB {statistics.median(each):6.0f} ms "
                f"({min(each):.0f} to {max(each):.0f}); explorer / page {ratio:.2f}"
            )


if __name__ == "__main__":
    main()
