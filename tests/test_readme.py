"""The README stays short, every link of the pages leads somewhere, and the page on the command line
has the options that there are."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

from facerender.commands import main

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "examples/*.md", "examples/*/README.md")
    for page in ROOT.glob(pattern)
)
CODE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
OPTION = re.compile(r"--[a-z][a-z0-9-]*")


def prose(page: Path) -> str:
    return CODE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Return what GitHub lets a link name: headings in lower case, spaces as hyphens, no signs."""
    seen: Counter[str] = Counter()
    found = set()
    for heading in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


def broken_links(page: Path) -> list[str]:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if link.startswith(("http://", "https://")):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 160


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    assert broken_links(page) == []


def test_a_broken_link_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A `b`, c\n\n# Twice\n\n# Twice\n\n```\n# none\n[x](code)\n```\n\n"
        "[a](#a-b-c) [b](page.md#twice-1) [c](gone.md) [d](#none) [e](https://example.org)\n"
    )
    assert broken_links(page) == ["gone.md", "#none"]


def test_the_page_on_the_command_line_has_every_option(capsys):
    def options(*words: str) -> set[str]:
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        text = capsys.readouterr().out
        inner = re.findall(r"^    ([a-z]\S*)", text, re.MULTILINE)  # commands of this one
        return set(OPTION.findall(text)).union(*(options(*words, command) for command in inner))

    told = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert set(OPTION.findall(told)) == options()
