"""Self-contained HTML pages, which all reports share: the document, images, figures and tables.

The functions return HTML as text. Titles and captions that are plain text are escaped here; cells,
heads and bodies are HTML, which their makers escape. A page refers to no other file, so that it can
be sent by mail and read years later: images are data URLs, and the style sheet (for light and dark
mode) and the script of this folder are copied into it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from html import escape
from pathlib import Path

_FOLDER = Path(__file__).parent


def document(title: str, body: str, *files: str | Path) -> str:
    """Return an HTML page.

    title : plain text for the window title and the heading
    body : HTML below the heading, with classes from page.css
    files : scripts, which share one scope, and style sheets in addition to page.css. A name such
        as "viewer.js" is a file in this folder; paths are allowed too
    """
    paths = [_FOLDER / file for file in ("page.css", *files)]
    # All files become one style sheet and one script, since every page must work as a single file.
    # A module script runs after the page was parsed, in a scope of its own.
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


def image_source(content: bytes, file_format: str = "png") -> str:
    """Return an image file as a data URL; ``file_format`` is such as "webp"."""
    return f"data:image/{file_format};base64," + b64encode(content).decode()


def figure(png: bytes, caption: str) -> str:
    """Return a figure as HTML: an image with a caption of plain text."""
    text = escape(caption)
    image = f'<img src="{image_source(png)}" alt="{text}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def table(css_class: str, head: Iterable[str], rows: Iterable[str], caption: str = "") -> str:
    """Return a table as HTML; a table that is wider than the page scrolls.

    css_class : class names from page.css
    head, caption : HTML; omitted if empty
    rows : results of :func:`row`
    """
    cells = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    top = f"<thead><tr>{cells}</tr></thead>" if cells else ""
    title = f"<caption>{caption}</caption>" if caption else ""
    body = f"<tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table class="{css_class}">{title}{top}{body}</table></div>'


def row(name: str, cells: Iterable[str], css_class: str = "") -> str:
    """Return a row of a table from HTML cells."""
    marked = f' class="{css_class}"' if css_class else ""
    data_cells = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr{marked}><th scope="row">{name}</th>{data_cells}</tr>'
