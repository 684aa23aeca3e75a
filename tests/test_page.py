"""Tests ``facerender.page``: text is escaped, images are embedded, and every colour has enough
contrast in light and dark mode."""

from __future__ import annotations

from base64 import b64decode

import pytest

from facerender.page import document, figure, image_source, row, table

PNG = b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJggg=="
)
VERDICTS = ("differs", "error", "same", "holds", "fails", "undecided")

# For each element that has text: the contrast with its background, as defined by WCAG 2.
CONTRASTS = """() => {
    const context = new OffscreenCanvas(1, 1).getContext("2d", {willReadFrequently: true});
    const bytes = (...colours) => {
        context.clearRect(0, 0, 1, 1);
        for (const colour of colours) { context.fillStyle = colour; context.fillRect(0, 0, 1, 1); }
        return [...context.getImageData(0, 0, 1, 1).data];
    };
    const luminance = colours => bytes(...colours).slice(0, 3).reduce((sum, byte, i) => {
        const x = byte / 255;
        const linear = x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
        return sum + [0.2126, 0.7152, 0.0722][i] * linear;
    }, 0);
    document.documentElement.style.background = "Canvas";
    return [...document.body.querySelectorAll("*")].filter(element =>
        [...element.childNodes].some(node => node.nodeType === 3 && node.data.trim())
    ).map(element => {
        const behind = [];
        for (let at = element; at; at = at.parentElement)
            behind.unshift(getComputedStyle(at).backgroundColor);
        const [low, high] = [behind, [...behind, getComputedStyle(element).color]]
            .map(luminance).sort((a, b) => a - b);
        return [element.textContent, (high + 0.05) / (low + 0.05)];
    });
}"""


def test_page_elements() -> None:
    page = document("a < b & c", figure(PNG, 'x < "y"'))
    assert "<title>a &lt; b &amp; c</title>" in page
    assert "<h1>a &lt; b &amp; c</h1>" in page
    assert page.count("x &lt; &quot;y&quot;") == 2
    assert "<script" not in page
    kind, _, data = image_source(PNG).partition(",")
    assert (kind, b64decode(data)) == ("data:image/png;base64", PNG)
    assert f'<img src="{image_source(PNG)}"' in figure(PNG, "")
    assert table("x", (), [row("a", ["1", "2"]), row("b", [], "y")]) == (
        '<div class="wide"><table class="x"><tbody>'
        '<tr><th scope="row">a</th><td>1</td><td>2</td></tr>'
        '<tr class="y"><th scope="row">b</th></tr></tbody></table></div>'
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_colour_has_enough_contrast(browser, tmp_path, scheme) -> None:
    rows = [row(kind, ['<b class="verdict">word</b>'], kind) for kind in VERDICTS]
    rows += [row("name", ['<span class="over">1</span>', "figure"], "changed"), row("n", "1")]
    body = (
        table("facts", ("", "verdict"), rows, "title <small>note</small>")
        + table("numbers costs", ("", "remark"), [row("name", ["0.5"], "dominated")])
        + '<p>text <a href="#">link</a></p><p class="note">note</p>'
        + "<details open><summary><h2>pair</h2></summary></details><dl><dt>a</dt><dd>b</dd></dl>"
        + '<div class="stage"><figure><figcaption>a <b>b</b><label>FLIP</label>'
        + '<button class="swap">swap <kbd>X</kbd></button></figcaption></figure></div>'
        + '<button class="place"><b>c</b> at<span><span class="crop">A</span></span></button>'
        + figure(PNG, "caption")
    )
    path = tmp_path / "page.html"
    path.write_text(document("Title", body), encoding="utf-8")
    tab = browser.new_page(color_scheme=scheme)
    tab.goto(path.as_uri())
    contrasts = tab.evaluate(CONTRASTS)
    background = tab.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    tab.close()
    assert (background == "rgb(255, 255, 255)") == (scheme == "light")
    assert len(contrasts) > 30
    assert [(text, ratio) for text, ratio in contrasts if ratio < 4.5] == []
