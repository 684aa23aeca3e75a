"""Writes docs/reproduction.md and its figures: the paper's claims beside what is measured here.

python -m tools.docs.reproduction        from the repository's root; needs an OpenGL context
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.paper.__main__ import reproduce
from benchmarks.paper.report import PAPER
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/reproduction.md"

TEXT = """# The paper's figures and claims, measured

Written by `python -m tools.docs.reproduction`; `python -m benchmarks.paper` makes the same on your machine.
The paper is {paper}.

D is the lobe of Cook-Torrance with its scale, D16 its approximation. "As printed" are the literal
formulas (`shaders/printed`), "our exact" is what `shaders/facerender` does. A ratio stands with its
95 % interval and the two costs of an evaluation; a claim of speed holds where the whole interval
reaches the paper's number.

{measured}"""


def stale() -> Iterator[str]:
    """Tell what the document lacks of what is not measured."""
    return missing(OUTPUT, TEXT)


def main() -> None:
    result = reproduce(size=(270, 315))  # with the charts under 400 KB
    folder = OUTPUT.with_suffix("")
    folder.mkdir(exist_ok=True)
    for name, data in result.figures.items():
        (folder / name).write_bytes(data)
    text = TEXT.format(paper=PAPER, measured=result.markdown(folder.name))
    OUTPUT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
