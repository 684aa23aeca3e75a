"""Tests the HTML report and the heat map of a comparison: their content, that the page loads no
other file, and its controls in a browser."""

from __future__ import annotations

import sys
from base64 import b64decode
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerender import InputError
from facerender.commands import main
from facerender.comparison import pictures, report
from facerender.comparison.compare import Pair
from facerender.comparison.report import entry, write_report
from facerender.comparison.sources import CHECKS
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
        assert all(a["loading"] == "lazy" for a in found)
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
    ids = [a["id"] for tag, a, _ in parsed.tags if "id" in a and tag == "div"]
    assert ids == [at(name) for name in ORDER]
    summary = parsed.text[""]
    places = [summary.index(name) for name in ORDER]
    assert places == sorted(places)
    rows = [a["class"] for tag, a, at in parsed.tags if tag == "tr" and a.get("class") and not at]
    assert rows == ["differs"] * 4 + ["error"] * 3 + ["same"] * 2
    assert "Comparison: 4 differ, 3 not comparable, 2 the same" in summary
    for pair in pairs:
        reasons = (pair.error,) if pair.comparison is None else pair.comparison.reasons or ("same",)
        assert f"{pair.name}{report.VERDICTS[pair.status]}{reasons[0]}" in summary
        for reason in reasons:
            assert reason in parsed.text[at(pair.name)]


def test_values_and_limits_have_units_and_a_meaning(parsed: Page) -> None:
    text = parsed.text[at("coverage.exr")]
    assert "coverage16.7 % > 0.5 %The number of pixels whose coverage changed" in text
    for row in ("point0 radiance ≤ 0.005 radiance", "trend0 ≤ 0.9", "grain0 % ≤ 0.54 %"):
        assert row in text
    text = parsed.text[at("eight.png")]
    assert "levels > 3 levelsdarker at (30, 12); 1 pixel over" in text
    assert "block0 levels ≤ 1 level" in text
    for text in (parsed.text[at(name)] for name in ("coverage.exr", "eight.png", "equal.exr")):
        assert text.count("may be at most") == len(CHECKS)


def test_equal_pairs_have_a_line_with_the_largest_difference(tmp_path: Path, parsed: Page) -> None:
    assert "All pixels are equal." in parsed.text[at("equal.exr")]
    other = image()
    other[AT[1], AT[0], 0] += 1e-3
    text = page_of(tmp_path, image(), other).text["pair-0"]
    assert f"Largest difference of a pixel: 0.001 radiance at {AT}." in text


def test_a_limit_that_the_verdict_does_not_apply_is_no_failure(tmp_path: Path) -> None:
    """A lone pixel in texture may exceed the limit of point; its row is not marked."""
    noise = np.random.default_rng(1).random((64, 64, 1))
    a = (0.39 + 0.02 * noise).astype(np.float32).repeat(3, axis=2)
    b = a.copy()
    b[20, 20] = a[18:23, 18:23].max() + 0.08
    page = page_of(tmp_path, a, b)
    assert "Comparison: 1 the same" in page.text[""]
    assert " > " in page.text["pair-0"]
    assert not [1 for _, a, _ in page.tags if a.get("class") in ("over", "changed")]


def test_page_fetches_nothing_and_names_are_text(page: Path, parsed: Page) -> None:
    text = page.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert text.count("url(") == text.count("url(#")
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


def test_changed_metadata_comes_first(parsed: Page) -> None:
    """Rows that differ are marked and above the folded table of equal rows; the name is on top."""
    assert parsed.text[at(NAME)].count("extra") == 1
    text = parsed.text[at(NAME)]
    assert "ABimagea.exrb.exrsamples41extra–new2 equal propertiesABpixels" in text
    assert "GL_RENDERER<llvm> & pipe<llvm> & pipe" in text.partition("equal properties")[2]
    marked = [a for tag, a, id in parsed.tags if (tag, id) == ("tr", at(NAME)) and a.get("class")]
    failed = text.count(" > ")
    assert len(marked) == 2 + failed


def test_pictures_of_a_pair_that_differs(parsed: Page) -> None:
    shown = parsed.images(at(NAME))
    assert list(shown) == ["difference", "FLIP", "A", "B"]
    x, y = AT
    wrong = np.zeros(SIZE, dtype=bool)
    wrong[y, x] = True
    np.testing.assert_array_equal((shown["A"] != shown["B"]).any(axis=-1), wrong)
    assert tuple(shown["B"][y, x]) == (255, 255, 255)
    np.testing.assert_array_equal((shown["difference"] != 0).any(axis=-1), wrong)
    assert shown["FLIP"][y, x].sum() > 2 * shown["FLIP"][0, 0].sum()
    brighter = parsed.images(at(NAME))["difference"][y, x]
    darker = parsed.images(at("grey.npy"))["difference"][y, x]
    assert brighter[0] > brighter[2]
    assert darker[2] > darker[0]
    uncovered = parsed.images(at("coverage.exr"))["difference"]
    assert uncovered[:, :8].any(axis=-1).all()
    assert not uncovered[:, 8:].any()


def test_pictures_of_other_pairs(parsed: Page) -> None:
    shown = parsed.images(at("not finite.exr"))
    assert list(shown) == ["A", "B"]
    magenta = (shown["B"] == (255, 0, 255)).all(axis=-1)
    assert [tuple(place) for place in np.argwhere(magenta)] == [AT[::-1]]
    sizes = {kind: shown.shape[:2] for kind, shown in parsed.images(at("sizes.exr")).items()}
    assert sizes == {"A": SIZE, "B": (SIZE[0], 20)}
    assert list(parsed.images(at("missing.exr"))) == ["B"]
    assert [x.shape[:2] for x in parsed.images(at("equal.exr")).values()] == [SIZE]
    assert [x.shape[:2] for x in parsed.images(at("equal, large.exr")).values()] == [(160, 120)]


def test_transparent_pixels_are_shown_on_black(tmp_path: Path) -> None:
    straight = to_8_bit(image())
    straight[..., 3] = 51
    shown = page_of(tmp_path, straight, to_8_bit(image())).images("pair-0")["A"]
    np.testing.assert_array_equal(shown, np.round(straight[..., :3] * 0.2))


def test_page_without_the_package_for_heat_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    page = page_of(tmp_path, image(), with_pixel(3.0))
    assert list(page.images("pair-0")) == ["difference", "A", "B"]
    assert "FLIP" not in page.text["pair-0"]


def crops(page: Page, id: str = "pair-0") -> list[np.ndarray]:
    """Return the enlarged places of a pair: A, B and their difference for each place."""
    return [
        decode(a["src"]) for tag, a, at in page.tags if (tag, at, a.get("alt")) == ("img", id, "")
    ]


def test_the_worst_places_are_enlarged(tmp_path: Path) -> None:
    """A, B and their difference around the worst block and pixel, also at a corner."""
    a = np.full((64, 80, 3), 0.4, dtype=np.float32)
    b = a.copy()
    b[48:, 64:] *= np.float32(1.02)
    b[0, 1] = 3.0
    page = page_of(tmp_path, a, b)
    block, pixel = crops(page)[:3], crops(page)[3:]
    assert {each.shape for each in block} == {(32, 32, 3)}
    assert {each.shape for each in pixel} == {(17, 17, 3)}
    assert len(pixel) == 3
    shown = page.images("pair-0")
    for name, crop, small in zip(("A", "B", "difference"), block, pixel, strict=True):
        np.testing.assert_array_equal(crop, shown[name][-32:, -32:])
        np.testing.assert_array_equal(small, shown[name][:17, :17])
    buttons = {a["value"] for tag, a, _ in page.tags if tag == "button" and "value" in a}
    assert buttons == {"72,56", "1,0"}


@pytest.mark.slow
def test_a_large_difference_is_reduced_and_loses_no_pixel(tmp_path: Path) -> None:
    a = np.full((1100, 900, 3), 0.4, dtype=np.float32)
    b = a.copy()
    b[1001, 707] = 3.0
    page = page_of(tmp_path, a, b)
    difference = page.images("pair-0")["difference"]
    assert difference[..., 0].size <= report.MAP
    assert [tuple(each) for each in np.argwhere(difference.any(axis=-1))] == [(500, 353)]
    assert tuple(difference[500, 353]) == pictures.BRIGHTER
    assert (tmp_path / "report.html").stat().st_size < 60_000


@pytest.mark.slow
def test_only_the_first_pairs_are_unfolded(tmp_path: Path) -> None:
    entries = [entry(Pair.of(str(i), image(), with_pixel(3.0))) for i in range(12)]
    write_report(tmp_path / "report.html", entries)
    folds = [
        a
        for tag, a, _ in Page(tmp_path / "report.html").tags
        if a.get("class") == "differs" and tag == "details"
    ]
    assert [("open" in each) for each in folds] == [True] * 10 + [False] * 2


@pytest.mark.first_case
@pytest.mark.parametrize("shape", [(400, 500), (363, 363), (30, 50)])
def test_small_heat_map_loses_no_firefly(shape: tuple[int, int]) -> None:
    a = np.full((*shape, 3), 100, dtype=np.uint8)
    b = a.copy()
    at = (shape[0] - 2, 7)
    b[at] = 255
    small, whole = pictures.small_heat_map(a, b), pictures.heat_map(a / 255.0, b / 255.0)
    assert small[..., 0].size <= pictures.HEAT
    step = round(shape[0] / len(small))
    brightest = np.unravel_index(small.sum(axis=-1, dtype=int).argmax(), small.shape[:2])
    assert tuple(brightest) == (at[0] // step, at[1] // step)
    assert small.max(axis=(0, 1)).sum() >= whole.max(axis=(0, 1)).sum()
    if step == 1:
        np.testing.assert_array_equal(small, whole)


def test_image_too_large_for_webp() -> None:
    pixels = np.zeros((2, 16384, 3), dtype=np.uint8)
    pixels[0, ::7] = 200
    content, kind = pictures.lossless(pixels)
    assert kind == "png"
    np.testing.assert_array_equal(np.asarray(Image.open(BytesIO(content))), pixels)


def test_heat_map(tmp_path: Path) -> None:
    for name, a, b in (
        ("linear.png", image(), with_pixel(0.0)),
        ("bytes.png", to_8_bit(image(3)), to_8_bit(with_pixel(0.0, 3))),
        ("grey.png", image(1), with_pixel(0.0, 1)),
    ):
        Pair.of("x", a, b).save_heat_map(tmp_path / name)
        heat = np.asarray(Image.open(tmp_path / name)).astype(int).sum(axis=-1)
        assert heat.shape == SIZE
        assert np.unravel_index(heat.argmax(), SIZE) == AT[::-1]
        assert heat.max() > 100 + heat[0, 0]


def test_heat_map_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "heat.png"
    with pytest.raises(InputError, match="no heat map: cannot read no.exr: no such file"):
        Pair.of("x", "no.exr", image()).save_heat_map(path)
    with pytest.raises(InputError, match="48 x 40, B is 20 x 40 pixels"):
        Pair.of("x", image(), image()[:, :20]).save_heat_map(path)
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match=r"pip install 'facerender\[measure\]'"):
        Pair.of("x", image(), with_pixel(0.0)).save_heat_map(path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--report", "r.png"), "--report r.png: unknown format '.png'; give .html, .htm"),
        (("--heatmap", "x.txt"), "--heatmap x.txt: unknown format '.txt'; give .png"),
        (("--sheet", "s.html"), "--sheet s.html: unknown format '.html'; give .png, .exr"),
        (("--report", "report"), "--report report: unknown format ''; give .html, .htm"),
    ],
)
def test_outputs_are_checked_before_the_comparison(
    arguments, message, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", image())
    monkeypatch.setattr(Pair, "of", None)  # comparing would fail
    assert main(["compare", "a.npy", "a.npy", *arguments]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert (printed.out, len(printed.err.splitlines())) == ("", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


def test_the_package_for_heat_maps_is_checked_first(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", image())
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    monkeypatch.setattr(Pair, "of", None)
    assert main(["compare", "a.npy", "a.npy", "--heatmap", "x.png"]) == 2
    assert "pip install 'facerender[measure]'" in capsys.readouterr().err


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


def top(section) -> str:
    """Return the image, A or B, that is visible at the left border of the figure of both."""
    script = """figure => {
        const box = figure.querySelector(".view").getBoundingClientRect();
        const at = document.elementFromPoint(box.x + 5, box.y + box.height / 2);
        return at.closest(".sheet").className;
    }"""
    return section.locator(".both").evaluate(script).split()[-1]


def test_the_page_opens_with_the_difference(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    section.scroll_into_view_if_needed()
    boxes = [section.locator(f"figure.{kind}").bounding_box() for kind in ("difference", "both")]
    assert boxes[0]["x"] < boxes[1]["x"]
    assert boxes[0]["width"] > 300
    assert not section.locator(".FLIP").is_visible()
    section.get_by_label("FLIP").check()
    assert section.locator(".FLIP").is_visible()


def test_a_and_b_swap_by_key_and_by_slider(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    section.locator(".both").scroll_into_view_if_needed()
    assert section.locator("kbd").inner_text() == "X"
    assert top(section) == "A"  # the border is in the middle
    for expected in "ABA":
        tab.keyboard.press("x")
        assert top(section) == expected
    tab.keyboard.press("Control+x")
    assert top(section) == "A"
    section.get_by_role("button", name="swap").click()
    assert top(section) == "B"
    slider = section.get_by_label("border between A and B")
    slider.fill("25")
    assert top(section) == "A"
    clip = section.locator(".both .B").evaluate("sheet => getComputedStyle(sheet).clipPath")
    assert clip == "inset(0px 0px 0px 25%)"
    slider.press("ArrowRight")
    assert slider.input_value() == "26"


def test_a_lone_pixel_is_visible_in_the_difference(browser, tmp_path: Path) -> None:
    """A pixel of a large image is smaller than a pixel of a narrow screen."""
    a = np.full((512, 512, 3), 0.4, dtype=np.float32)
    b = a.copy()
    b[301, 203] = 3.0
    page_of(tmp_path, a, b)
    tab = browser.new_page(viewport={"width": 360, "height": 740})
    tab.goto((tmp_path / "report.html").as_uri())
    tab.add_style_tag(content=".mark { display: none }")
    content = tab.locator("figure.difference .view").screenshot()
    tab.close()
    shown = np.asarray(Image.open(BytesIO(content)).convert("RGB"))
    assert (shown[..., 0] > 80).sum() >= 9


def enlarged(section) -> tuple[float, float, float]:
    """Return the size of a pixel of A on the screen, and x and y of the pixel in the centre."""
    x, y, size = section.locator("figure.both").evaluate(
        """figure => {
            const image = figure.querySelector("img").getBoundingClientRect();
            const view = figure.querySelector(".view").getBoundingClientRect();
            const size = image.width / +figure.style.getPropertyValue("--w");
            return [(view.x + view.width / 2 - image.x) / size,
                    (view.y + view.height / 2 - image.y) / size, size];
        }"""
    )
    return size, x, y


def test_zoom_by_button_click_and_keys(tab) -> None:
    section = tab.locator(f"#{at(NAME)}")
    fit = enlarged(section)[0]
    button = section.get_by_role("button", name="worst pixel")
    button.press("Enter")
    assert enlarged(section) == pytest.approx((2 * fit, AT[0] + 0.5, AT[1] + 0.5), rel=0.01)
    assert button.get_attribute("aria-pressed") == "true"
    rendering = section.locator("figure.both img").first.evaluate(
        "image => getComputedStyle(image).imageRendering"
    )
    assert rendering == "pixelated"
    button.press("ArrowLeft")
    assert enlarged(section)[1] == pytest.approx(AT[0] - 4 + 0.5, rel=0.01)
    tab.keyboard.press("Escape")
    assert enlarged(section)[0] == pytest.approx(fit)
    assert button.get_attribute("aria-pressed") == "false"
    view = section.locator("figure.both .view")
    view.click(position={"x": fit * 20.5, "y": fit * 25.5})
    assert enlarged(section) == pytest.approx((2 * fit, 20.5, 25.5), rel=0.01)
    view.click()
    assert enlarged(section)[0] == pytest.approx(fit)


def test_the_worst_pixel_is_marked(tab) -> None:
    section = tab.locator(f"#{at(NAME)} figure.difference")
    image, ring = (section.locator(each).first.bounding_box() for each in ("img", ".ring"))
    pixel = image["width"] / SIZE[1]
    x, y = (ring[axis] + ring[side] / 2 for axis, side in (("x", "width"), ("y", "height")))
    assert (x - image["x"]) / pixel == pytest.approx(AT[0] + 0.5, abs=0.1)
    assert (y - image["y"]) / pixel == pytest.approx(AT[1] + 0.5, abs=0.1)


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


@pytest.mark.parametrize("width", [360, 1400])
def test_page_is_as_wide_as_the_window(tab, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 900})
    assert tab.evaluate("document.documentElement.scrollWidth") == width
