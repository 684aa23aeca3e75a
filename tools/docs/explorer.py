"""Writes docs/explorer.html, the built-in head's explorer, and the picture of it in the README:
``python -m tools.docs.explorer``. The page is not in the repository: it has 3.6 MB."""

import io
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

import facerender as fr
from facerender.explorer import explorer
from facerender.job import Job
from tests.verification import chromium

HERE = Path(__file__).parents[2] / "docs"
# What the picture shows: D8 at a slope where it is off by several steps.
LINK = "#a=m:0.35&b=lobe:d8;m:0.35&camera=azimuth:-28;elevation:4&cut=0.46&budget=4"


def main() -> None:
    page = HERE / "explorer.html"
    page.write_text(explorer(Job(), fr.load_mesh()), encoding="utf-8")
    with sync_playwright() as playwright:
        browser = chromium.launch(playwright)
        shown = browser.new_page(viewport={"width": 1280, "height": 760}, color_scheme="dark")
        shown.goto(page.as_uri() + LINK)
        shown.evaluate("explorer.errors()")
        picture = Image.open(io.BytesIO(shown.screenshot()))
        browser.close()
    picture.convert("RGB").save(HERE / "explorer.jpg", quality=85, optimize=True)


if __name__ == "__main__":
    main()
