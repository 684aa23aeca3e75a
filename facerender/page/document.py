"""The shell of every page, and what pages have in common: images, figures, tables. A page is one
file of HTML that fetches nothing; its style and its script are files beside this one."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from html import escape
from pathlib import Path

_FOLDER = Path(__file__).parent


def document(title: str, body: str, *files: str | Path) -> str:
    """Return a page.

    Parameters
    ----------
    title : text, of the window and of the page
    body : HTML that follows the title; classes are those of page.css
    files : scripts, which share one scope, and stylesheets besides page.css: of this folder, such
        as "viewer.js", or by their paths
    """
    paths = [_FOLDER / file for file in ("page.css", *files)]
    style = "".join(path.read_text(encoding="utf-8") for path in paths if path.suffix == ".css")
    script = "".join(path.read_text(encoding="utf-8") for path in paths if path.suffix == ".js")
    code = f'<script type="module">\n{script}</script>\n' if script else ""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{body}
{code}</body>
</html>
"""


def image_source(content: bytes, kind: str = "png") -> str:
    """Return an image file, of a kind such as "webp", as the URL of itself."""
    return f"data:image/{kind};base64," + b64encode(content).decode()


def figure(png: bytes, caption: str) -> str:
    """Return an image with its caption, as text."""
    text = escape(caption)
    return (
        f'<figure><img src="{image_source(png)}" alt="{text}"><figcaption>{text}</figcaption>'
        "</figure>"
    )


def table(kind: str, head: Iterable[str], rows: Iterable[str], caption: str = "") -> str:
    """Return a table that scrolls where it is wider than the page.

    Parameters
    ----------
    kind : its classes in page.css
    head, caption : HTML; none where empty
    rows : of :func:`row`
    """
    cells = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    top = f"<thead><tr>{cells}</tr></thead>" if cells else ""
    title = f"<caption>{caption}</caption>" if caption else ""
    body = f"<tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table class="{kind}">{title}{top}{body}</table></div>'


def row(name: str, cells: Iterable[str], kind: str = "") -> str:
    """Return a row of a table, all of it HTML; kind is its class."""
    marked = f' class="{kind}"' if kind else ""
    values = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr{marked}><th scope="row">{name}</th>{values}</tr>'
