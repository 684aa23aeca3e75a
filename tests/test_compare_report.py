"""Tests the HTML report and the heat map of a comparison: their content, that the page loads no
other file, and its controls in a browser."""

from __future__ import annotations

import re
import sys
import time
from base64 import b64decode
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import InputError
from facerender.commands import main
from facerender.comparison import flip, report, visualization
from facerender.comparison.compare import Pair
from facerender.comparison.report import entry, write_report
from facerender.comparison.visualization import save_heat_map
from facerender.images.image import ImageData

SIZE = (40, 48)  # height, width
AT = (30, 12)  # x, y of the wrong pixel
NAME = '<b onclick="x">&\'.exr'
ORDER = [  # of pairs in the page: different, not comparable, equal
    *(NAME, "eight.png", "grey.npy", "coverage.exr"),
    *("not finite.exr", "missing.exr", "sizes.exr"),
    *("equal.exr", "equal, large.exr"),
]
VOID = {"meta", "link", "img", "input", "br"}


def image(channels: int = 4) -> np.ndarray:
    x = np.linspace(0.2, 0.6, SIZE[1], dtype=np.float32)
    pixels = np.ones((*SIZE, 4), dtype=np.float32)
    pixels[..., :3] = x[None, :, None] * (1.0, 0.8, 0.7)
    return pixels[..., :channels]


def with_pixel(value: float, channels: int = 4) -> np.ndarray:
    pixels = image(channels).copy()
    pixels[AT[1], AT[0], :3] = value
    return pixels


def to_8_bit(pixels: np.ndarray) -> np.ndarray:
    return np.round(255.0 * pixels).astype(np.uint8)


def uncovered() -> np.ndarray:
    pixels = image()
    pixels[:, :8, 3] = 0.0
    return pixels


def picture(pixels: np.ndarray, name: str, **metadata: str) -> ImageData:
    return ImageData(pixels, "linear", name, metadata)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    a = picture(image(), "a.exr", GL_RENDERER="<llvm> & pipe", samples="4")
    b = picture(with_pixel(3.0), "b.exr", GL_RENDERER="<llvm> & pipe", samples="1", extra="new")
    return [
        Pair.of("equal.exr", image(), image()),
        Pair.of("not finite.exr", image(), with_pixel(np.nan)),
        Pair.of("missing.exr", "no/such.exr", image()),
        Pair.of("sizes.exr", image(), image()[:, :20]),
        Pair.of(NAME, a, b),
        Pair.of("eight.png", to_8_bit(image(3)), to_8_bit(with_pixel(0.0, 3))),
        Pair.of("grey.npy", image(1), with_pixel(0.0, 1)),
        Pair.of("coverage.exr", image(), uncovered()),
        Pair.of("equal, large.exr", np.ones((400, 300, 3)), np.ones((400, 300, 3))),
    ]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, pairs: list[Pair]) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, [entry(pair) for pair in pairs])
    return path


class Page(HTMLParser):
    """A parsed page: its tags, and its text by the nearest id; checks that tags nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[tuple[str, str | None]] = []
        self.tags: list[tuple[str, dict[str, str | None], str]] = []
        self.text: dict[str, str] = {}
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    @property
    def id(self) -> str:
        return next((id for _, id in reversed(self.open) if id), "")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append((tag, dict(attrs).get("id")))
        self.tags.append((tag, dict(attrs), self.id))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        self.text[self.id] = self.text.get(self.id, "") + data

    def images(self, id: str) -> dict[str | None, np.ndarray]:
        """Return the images of a section by their alternative text."""
        found = [a for tag, a, at in self.tags if tag == "img" and at == id and a["alt"]]
        return {a["alt"]: decode(a["src"] or "") for a in found}


def decode(source: str) -> np.ndarray:
    kind, _, data = source.partition(",")
    assert kind in ("data:image/webp;base64", "data:image/png;base64")
    return np.asarray(Image.open(BytesIO(b64decode(data))))


@pytest.fixture(scope="module")
def parsed(page: Path) -> Page:
    return Page(page)


def page_of(folder: Path, a: object, b: object, name: str = "x") -> Page:
    """Write and parse the page of one pair."""
    write_report(folder / "report.html", [entry(Pair.of(name, a, b))])
    return Page(folder / "report.html")


def at(name: str) -> str:
    return f"pair-{ORDER.index(name)}"


def test_summary_has_each_pair_and_its_columns(parsed: Page, pairs: list[Pair]):
    links = [a["href"] for tag, a, _ in parsed.tags if tag == "a"]
    assert links == [f"#{at(name)}" for name in ORDER]
    ids = [a["id"] for _, a, _ in parsed.tags if "id" in a]
    assert ids == [at(name) for name in ORDER]
    summary = parsed.text[""]
    places = [summary.index(name) for name in ORDER]
    assert places == sorted(places)
    rows = [a["class"] for tag, a, at in parsed.tags if tag == "tr" and a.get("class") and not at]
    assert rows == ["differs"] * 4 + ["error"] * 3 + ["same"] * 2
    assert "Comparison: 4 differ, 3 not comparable, 2 the same" in summary
    head = sum(tag == "th" and a.get("scope") == "col" and not at for tag, a, at in parsed.tags)
    cells = sum(tag == "td" and not at for tag, _, at in parsed.tags)
    assert cells == len(pairs) * (head - 1)
    assert re.search("[0-9].*".join(report.CHECKS), parsed.text[at("eight.png")])


def test_metrics_and_reasons(parsed: Page, pairs: list[Pair]) -> None:
    summary = parsed.text[""].replace("\N{NO-BREAK SPACE}", " ")
    (figures,) = (pair.comparison for pair in pairs if pair.name == NAME)
    assert f"{NAME}differs{figures.point:.3g} > 0.005" in summary
    assert "coverage.exrdiffers000 %00 %0 %016.7 % > 0.5 %" in summary
    assert f"missing.exrerror{'–' * len(report.CHECKS)}" in summary
    text = parsed.text[at("coverage.exr")].replace("\N{NO-BREAK SPACE}", " ")
    assert "trend0 ≤ 0.15grain0 % ≤ 0.09 %texture0 % ≤ 1 %shift0 ≤ 0.25" in text
    text = parsed.text[at("eight.png")].replace("\N{NO-BREAK SPACE}", " ")
    assert "Metrics, in 8-bit levels" in text
    assert "darker at (30, 12); 1 over" in text
    for pair in pairs:
        messages = (pair.error,) if pair.comparison is None else pair.comparison.reasons
        for reason in messages:
            assert reason in parsed.text[at(pair.name)]


def test_page_fetches_nothing_and_names_are_text(page: Path, parsed: Page) -> None:
    text = page.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert "url(" not in text
    assert "@import" not in text
    for tag, attributes, _ in parsed.tags:
        assert (attributes.get("src") or "data:").startswith("data:")
        assert (attributes.get("href") or "#").startswith(("data:", "#"))
        assert tag not in {"iframe", "object", "embed"}
    assert NAME not in page.read_text(encoding="utf-8")
    assert all("onclick" not in attributes for _, attributes, _ in parsed.tags)
    assert "<llvm> & pipe" in parsed.text[at(NAME)]


def test_name_that_is_not_utf_8(tmp_path: Path) -> None:
    page_of(tmp_path, image(), image(), "\udcff.exr")
    assert r"\udcff.exr" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_environment_marks_differences(page: Path, parsed: Page) -> None:
    text = page.read_text(encoding="utf-8").partition(f'<section id="{at(NAME)}"')[2]
    text = text.partition("</section>")[0]
    for key in ("image", "pixels", "GL_RENDERER", "samples", "extra"):
        mark = ' class="changed"' * (key in ("samples", "extra"))
        assert f'<tr{mark}><th scope="row">{key}</th>' in text


def test_pictures_of_a_pair_that_differs(parsed: Page) -> None:
    shown = parsed.images(at(NAME))
    assert list(shown) == ["a", "b", "heat", "difference"]
    x, y = AT
    wrong = np.zeros(SIZE, dtype=bool)
    wrong[y, x] = True
    np.testing.assert_array_equal((shown["a"] != shown["b"]).any(axis=-1), wrong)
    assert tuple(shown["b"][y, x]) == (255, 255, 255)
    np.testing.assert_array_equal((shown["difference"] != 0).any(axis=-1), wrong)
    assert shown["heat"][y, x].sum() > 2 * shown["heat"][0, 0].sum()
    x, y = AT
    brighter = parsed.images(at(NAME))["difference"][y, x]
    darker = parsed.images(at("grey.npy"))["difference"][y, x]
    assert brighter[0] > brighter[2]
    assert darker[2] > darker[0]
    uncovered = parsed.images(at("coverage.exr"))["difference"]
    assert uncovered[:, :8].any(axis=-1).all()
    assert not uncovered[:, 8:].any()


def test_pictures_of_other_pairs(parsed: Page) -> None:
    shown = parsed.images(at("not finite.exr"))
    assert list(shown) == ["a", "b"]
    magenta = (shown["b"] == (255, 0, 255)).all(axis=-1)
    assert [tuple(place) for place in np.argwhere(magenta)] == [AT[::-1]]
    sizes = {kind: shown.shape[:2] for kind, shown in parsed.images(at("sizes.exr")).items()}
    assert sizes == {"a": SIZE, "b": (SIZE[0], 20)}
    assert list(parsed.images(at("missing.exr"))) == ["b"]
    assert sum(tag == "details" for tag, _, _ in parsed.tags) == 2
    assert [x.shape[:2] for x in parsed.images(at("equal.exr")).values()] == [SIZE]
    assert [x.shape[:2] for x in parsed.images(at("equal, large.exr")).values()] == [(160, 120)]


def test_transparent_pixels_are_shown_on_black(tmp_path: Path) -> None:
    straight = to_8_bit(image())
    straight[..., 3] = 51
    shown = page_of(tmp_path, straight, to_8_bit(image())).images("pair-0")["a"]
    np.testing.assert_array_equal(shown, np.round(straight[..., :3] * 0.2))


def test_page_without_the_package_for_heat_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    page = page_of(tmp_path, image(), with_pixel(3.0))
    assert list(page.images("pair-0")) == ["a", "b", "difference"]
    assert "pip install 'facerender[measure]'" in page.text["pair-0"]


def test_images_are_compressed_if_the_page_is_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The largest images are compressed until the page fits; areas with differences stay exact."""
    rng = np.random.default_rng(1)
    large, small = (rng.integers(0, 100, (side, side, 3), dtype=np.uint8) for side in (300, 100))
    entries = []
    for name, a in (("large", large), ("small", small)):
        b = a.copy()
        b[20, 40] = 255
        entries.append(entry(Pair.of(name, a, b)))
    monkeypatch.setattr(report, "EXACT", 600_000)
    write_report(tmp_path / "report.html", entries)
    page = Page(tmp_path / "report.html")
    np.testing.assert_array_equal(page.images("pair-1")["a"], small)
    assert page.images("pair-0")["a"].shape == large.shape
    assert np.abs(page.images("pair-0")["a"].astype(int) - large).max() > 10

    kinds = [a["class"] for tag, a, _ in page.tags if "viewer" in (a.get("class") or "")]
    assert kinds == ["viewer compressed", "viewer exact"]
    crops = [a for tag, a, _ in page.tags if a.get("class") == "near"]
    assert len(crops) == 2  # of A and B at the worst pixel; blocks of noise are not checked
    np.testing.assert_array_equal(decode(crops[0]["src"]), large[:64, 8:72])
    sides = dict(part.split(":") for part in crops[0]["style"].split(";"))
    places = {name: 3.0 * float(side.rstrip("%")) for name, side in sides.items()}
    assert places == pytest.approx({"left": 8, "top": 0, "width": 64, "height": 64}, abs=0.01)
    assert (tmp_path / "report.html").stat().st_size < 1_000_000


@pytest.mark.parametrize("shape", [(400, 500), (363, 363), (30, 50)])
def test_small_heat_map_loses_no_firefly(shape: tuple[int, int]) -> None:
    a = np.full((*shape, 3), 100, dtype=np.uint8)
    b = a.copy()
    at = (shape[0] - 2, 7)
    b[at] = 255
    small, whole = visualization.small_heat_map(a, b), flip.heat_map(a / 255.0, b / 255.0)
    assert small[..., 0].size <= visualization.HEAT
    step = round(shape[0] / len(small))
    brightest = np.unravel_index(small.sum(axis=-1, dtype=int).argmax(), small.shape[:2])
    assert tuple(brightest) == (at[0] // step, at[1] // step)
    assert small.max(axis=(0, 1)).sum() >= whole.max(axis=(0, 1)).sum()
    if step == 1:
        np.testing.assert_array_equal(small, whole)


def test_image_too_large_for_webp() -> None:
    pixels = np.zeros((2, 16384, 3), dtype=np.uint8)
    pixels[0, ::7] = 200
    content, kind = visualization.lossless(pixels)
    assert kind == "png"
    np.testing.assert_array_equal(visualization.decoded(content), pixels)


@pytest.mark.slow
def test_page_of_a_hundred_pairs(tmp_path: Path, egl) -> None:
    """The comparison with its page needs at most 60 s of processor time and 30 MB."""
    mesh = fr.load_mesh()
    folders = [tmp_path / name for name in "ab"]
    with fr.Renderer((512, 512), samples=1, backend=egl) as renderer:
        for number in range(100):
            camera = fr.Camera(-60.0 + 1.2 * number, frame="head")
            for folder, m in zip(folders, (0.3, 0.32), strict=True):
                folder.mkdir(exist_ok=True)
                scene = fr.Scene(mesh.with_material(m=m), camera)
                renderer.render(scene).save(folder / f"{number}.exr")
    began = time.process_time()
    report = str(tmp_path / "report.html")
    assert main(["compare", *map(str, folders), "--report", report, "--json"]) == 1
    assert time.process_time() - began < 60.0
    assert (tmp_path / "report.html").stat().st_size < 30_000_000


def test_heat_map(tmp_path: Path) -> None:
    for name, a, b in (
        ("linear.png", image(), with_pixel(0.0)),
        ("bytes.png", to_8_bit(image(3)), to_8_bit(with_pixel(0.0, 3))),
        ("grey.png", image(1), with_pixel(0.0, 1)),
    ):
        save_heat_map(tmp_path / name, Pair.of("x", a, b))
        heat = np.asarray(Image.open(tmp_path / name)).astype(int).sum(axis=-1)
        assert heat.shape == SIZE
        assert np.unravel_index(heat.argmax(), SIZE) == AT[::-1]
        assert heat.max() > 100 + heat[0, 0]


def test_heat_map_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "heat.png"
    with pytest.raises(InputError, match="no heat map: cannot read no.exr: no such file"):
        save_heat_map(path, Pair.of("x", "no.exr", image()))
    with pytest.raises(InputError, match="48 x 40, B is 20 x 40 pixels"):
        save_heat_map(path, Pair.of("x", image(), image()[:, :20]))
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match=r"pip install 'facerender\[measure\]'"):
        save_heat_map(path, Pair.of("x", image(), with_pixel(0.0)))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def tab(browser, page: Path):
    """The page in a browser; at the end, checks that it logged nothing and requested no file."""
    tab = browser.new_page(viewport={"width": 1400, "height": 1000})
    messages: list[str] = []
    tab.on("console", lambda message: messages.append(message.text))
    tab.on("pageerror", lambda error: messages.append(str(error)))
    tab.on("request", lambda request: messages.append(request.url))
    tab.goto(page.as_uri())
    yield tab
    tab.close()
    assert [line for line in messages if not line.startswith(("data:", page.as_uri()))] == []


def visible(section) -> list[str]:
    figures = section.locator("figure")
    return [
        figures.nth(i).get_attribute("class")
        for i in range(figures.count())
        if figures.nth(i).is_visible()
    ]


def test_views(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    assert visible(section) == ["a", "b", "heat"]
    section.get_by_label("difference").check()
    assert visible(section) == ["difference"]
    section.get_by_label("blink").check()
    section.get_by_label("run").uncheck()
    before = visible(section)
    section.get_by_role("button", name="swap").click()
    assert sorted(before + visible(section)) == ["a", "b"]
    section.get_by_label("slider").check()
    assert visible(section) == ["a", "b"]
    boxes = [section.locator(f".{kind} .view").bounding_box() for kind in "ab"]
    assert boxes[0] == boxes[1]
    section.get_by_label("split").fill("25")
    clip = section.locator(".b .view").evaluate("view => getComputedStyle(view).clipPath")
    assert clip == "inset(0px 0px 0px 25%)"


def test_blinking_repeats(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    section.get_by_label("blink").check()
    for kind in "bab":
        section.locator(f".{kind}").wait_for(state="visible", timeout=5000)


def test_views_by_keyboard(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    section.get_by_label("side by side").focus()
    for shown in (1, 2, 1):
        tab.keyboard.press("ArrowRight")
        for _ in range(200):  # waits for the browser
            if len(visible(section)) == shown:
                break
            tab.wait_for_timeout(100)
        assert len(visible(section)) == shown


def enlarged(section) -> tuple[float, float, float]:
    """Return the size of a pixel of A on the screen, and x and y of the pixel in the centre."""
    x, y, size = section.locator(".a").evaluate(
        """figure => {
            const image = figure.querySelector("img").getBoundingClientRect();
            const view = figure.querySelector(".view").getBoundingClientRect();
            const size = image.width / +figure.style.getPropertyValue("--w");
            return [(view.x + view.width / 2 - image.x) / size,
                    (view.y + view.height / 2 - image.y) / size, size];
        }"""
    )
    return size, x, y


def test_marks_and_zoom_to_the_worst_pixel(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    fit = enlarged(section)[0]
    section.get_by_label("worst pixel").check()
    assert enlarged(section) == pytest.approx((2 * fit, AT[0] + 0.5, AT[1] + 0.5), rel=0.01)
    rendering = section.locator(".a img").evaluate(
        "image => getComputedStyle(image).imageRendering"
    )
    assert rendering == "pixelated"
    section.locator(".stage").press("ArrowLeft")
    assert enlarged(section)[1] == pytest.approx(AT[0] - 4 + 0.5, rel=0.01)
    section.locator(".a .view").click()
    assert enlarged(section)[0] == pytest.approx(fit)
    assert section.get_by_label("whole").is_checked()
    section.locator(".a .view").click(position={"x": fit * 20.5, "y": fit * 25.5})
    assert enlarged(section) == pytest.approx((2 * fit, 20.5, 25.5), rel=0.01)
    section = tab.locator(f"#{at(NAME)}")
    image = section.locator(".b img").bounding_box()
    ring = section.locator(".b .ring").bounding_box()
    pixel = image["width"] / SIZE[1]
    x, y = (ring[axis] + ring[side] / 2 for axis, side in (("x", "width"), ("y", "height")))
    assert (x - image["x"]) / pixel == pytest.approx(AT[0] + 0.5, abs=0.1)
    assert (y - image["y"]) / pixel == pytest.approx(AT[1] + 0.5, abs=0.1)
    section.get_by_label("marks").uncheck()
    assert not section.locator(".b .ring").is_visible()


def test_a_block_that_changed_is_marked(tmp_path: Path) -> None:
    a = np.full((64, 64, 3), 0.4, dtype=np.float32)
    b = a.copy()
    b[16:32, 32:48] *= np.float32(1.02)
    (left, top, width, height), *_ = (
        [float(part.split(":")[1].rstrip("%")) for part in each["style"].split(";")]
        for _, each, _ in page_of(tmp_path, a, b).tags
        if each.get("class") == "mark square"
    )
    assert (left, top, width, height) == pytest.approx((50.0, 25.0, 25.0, 25.0))


def test_link_opens_a_folded_pair(tab) -> None:
    thumbnail = tab.locator(f"#{at('equal.exr')} img")
    assert not thumbnail.is_visible()
    tab.get_by_role("link", name="equal.exr", exact=True).click()
    thumbnail.wait_for(state="visible", timeout=5000)


@pytest.mark.parametrize("width", [420, 1400])
def test_page_is_as_wide_as_the_window(tab, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 900})
    assert tab.evaluate("document.documentElement.scrollWidth") == width
