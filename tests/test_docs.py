"""Tests ``tools.docs``: generated blocks of the documents are up to date."""

from __future__ import annotations

from pathlib import Path
from pkgutil import iter_modules

import pytest

from tools.docs import tables
from tools.docs.__main__ import main
from tools.docs.blocks import BlockError, blocks_of, fill, found, pages, stale

ROOT = Path(__file__).parents[1]
PAGES = {
    str(path.relative_to(ROOT)): text
    for path in pages(ROOT)
    if (text := path.read_text(encoding="utf-8")) and any(found(text))
}


def test_blocks_of_all_pages_are_up_to_date(capsys):
    assert main(["--check"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("page", PAGES)
def test_a_block_that_was_edited_by_hand_is_stale(page):
    text = PAGES[page]
    for match in found(text):
        at = match.start("text") + len(match["text"]) // 2
        for edited in ("", "0 0"):
            assert stale(text[:at] + edited + text[at + 1 :]) == [match["name"]]


def test_every_block_is_used_in_a_page():
    modules = [module.name for module in iter_modules(tables.__path__)]
    blocks = [f"{module}.{block}" for module in modules for block in blocks_of(module)]
    assert sorted(blocks) == sorted(
        match["name"] for page in PAGES.values() for match in found(page)
    )


PAGE = """# Levels

Simplifying takes <!-- python -m tools.docs levels.seconds -->9 s<!-- end --> here.

<!-- python -m tools.docs levels.head-512 -->
<!-- end -->

<!-- python -m tools.docs accuracy.domains -->
| lobe |
<!-- end -->
"""


def test_blocks_are_filled_within_lines_and_as_lines():
    levels, accuracy = blocks_of("levels"), blocks_of("accuracy")
    first = PAGE.replace("9 s", levels["seconds"])
    assert fill(PAGE, ["levels.seconds"]) == first
    second = first.replace("512 -->\n", f"512 -->\n{levels['head-512']}\n")
    assert fill(PAGE, ["levels"]) == second
    assert fill(PAGE) == fill(fill(PAGE)) == second.replace("| lobe |", accuracy["domains"])
    assert stale(PAGE) == ["levels.seconds", "levels.head-512", "accuracy.domains"]
    assert stale(PAGE, ["accuracy"]) == ["accuracy.domains"]


def test_the_command_writes_stale_blocks_and_names_them(tmp_path, capsys):
    (tmp_path / "docs" / "measurements").mkdir(parents=True)
    (tmp_path / "README.md").write_text("no block")
    (tmp_path / "docs" / "measurements" / "levels.md").write_text(PAGE)
    assert main(["--check", "accuracy"], tmp_path) == 1
    message = "docs/measurements/levels.md: accuracy.domains is stale: run python -m tools.docs"
    assert capsys.readouterr().err == f"{message} accuracy.domains\n"
    assert main(["levels"], tmp_path) == 0
    assert main(["--check", "levels"], tmp_path) == 0
    assert main([], tmp_path) == 0
    assert (tmp_path / "docs" / "measurements" / "levels.md").read_text() == fill(PAGE)


@pytest.mark.parametrize(
    ("page", "fault"),
    [
        (
            PAGE.replace("levels.seconds", "levels.nothing"),
            "no block levels.nothing; there are mac",
        ),
        (
            PAGE.replace("levels.seconds", "nothing.seconds"),
            "no module nothing in tools/docs/tables",
        ),
        (PAGE.replace("s<!-- end -->", "s"), "levels.seconds has no <!-- end -->"),
        (PAGE.removesuffix("<!-- end -->\n"), "accuracy.domains has no <!-- end -->"),
    ],
)
def test_a_mark_without_a_block_or_an_end_is_refused(tmp_path, capsys, page, fault):
    with pytest.raises(BlockError, match=fault):
        fill(page)
    (tmp_path / "README.md").write_text(page)
    assert main(["--check"], tmp_path) == 1
    assert capsys.readouterr().err.startswith(f"README.md: {fault}")
