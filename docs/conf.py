"""Sphinx configuration of the documentation: `make site` writes it to out/site."""

import re
from typing import Any

from pygments.lexers.special import TextLexer
from sphinx.highlighting import lexers

import facerender

project = "facerender"
author = "the facerender contributors"
version = release = facerender.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"facerender {release}"
html_show_copyright = False
html_show_sourcelink = False
exclude_patterns = ["measurements/reproduction/*"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # signatures have them
napoleon_google_docstring = False
napoleon_use_rtype = False

lexers["csv"] = TextLexer()  # Pygments has no lexer for CSV

_FIELD = re.compile(r"^(\s*)([\w*][\w*, ]*) : (.+)$")


def _describe(
    app: object, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Move the text behind ``name : `` to a line of its own, which napoleon reads as a
    description and not as a type."""
    lines[:] = "\n".join(_FIELD.sub(r"\1\2\n\1    \3", line) for line in lines).split("\n")


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", _describe, priority=100)
