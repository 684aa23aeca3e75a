"""The paper's figures and claims as documents: JSON, a page, Markdown."""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from facerender.measure.report import write_files
from facerender.measure.reproduce.claims import Claim
from facerender.measure.reproduce.figures import CAPTIONS
from facerender.measure.tables import markdown_table
from facerender.pricing.interval import Interval

SCHEMA = "facerender.reproduce/1"
PAPER = (
    "S. O. Romanyuk et al., Modification of existing methods of visualization of offset face skin "
    "structure, Proc. SPIE 11456, 114560E (2020), doi 10.1117/12.2569770"
)


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The figures and the claims.

    Attributes
    ----------
    environment : renderer, processor, versions, date
    claims : the rows of the table
    cost : nanoseconds an evaluation, of everything that was timed
    figures : PNG files by name
    """

    environment: Mapping[str, Any]
    claims: Sequence[Claim]
    cost: Mapping[str, Interval]
    figures: Mapping[str, bytes]

    def json(self) -> str:
        """Return everything but the pixels as JSON.

        schema       "facerender.reproduce/1"
        paper        its citation
        environment  as in docs/measure.schema.md, and C compiler, C library, matplotlib, repeats
        claims       list of the fields of :class:`Claim`; values are percent by m, or the ratio of
                     two costs with the bounds low and high
        cost         by name, nanoseconds an evaluation: value, and its 95 % interval, low to high
        figures      captions by file
        """
        content = {
            "schema": SCHEMA,
            "paper": PAPER,
            "environment": self.environment,
            "claims": [asdict(claim) for claim in self.claims],
            "cost": {name: asdict(cost) for name, cost in self.cost.items()},
            "figures": CAPTIONS,
        }
        return json.dumps(content, indent=2) + "\n"

    def html(self) -> str:
        """Return one page with the figures inside it."""
        figures = [
            f'<figure><img alt="{html.escape(CAPTIONS[name])}" '
            f'src="data:image/png;base64,{base64.b64encode(data).decode()}">'
            f"<figcaption>{html.escape(CAPTIONS[name])}</figcaption></figure>"
            for name, data in self.figures.items()
        ]
        facts = [
            f"<dt>{name}</dt><dd>{html.escape(str(fact))}</dd>"
            for name, fact in self.environment.items()
        ]
        head, *rows = ([html.escape(cell) for cell in row] for row in _rows(self.claims))
        table = ["<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
        for row, claim in zip(rows, self.claims, strict=True):
            cells = "".join(f"<td>{cell}</td>" for cell in row)
            table.append(f'<tr class="{claim.verdict.replace(" ", "-")}">{cells}</tr>')
        return _PAGE % (
            html.escape(PAPER),
            "\n".join(table),
            "\n".join(figures),
            "\n".join(facts),
        )

    def markdown(self, folder: str) -> str:
        """Return the table and the figures, which lie in a folder beside the document."""
        head, *rows = _rows(self.claims)
        table = markdown_table(head, rows)
        figures = "\n\n".join(
            f"![{caption.split('.')[0]}]({folder}/{name})\n\n{caption}"
            for name, caption in CAPTIONS.items()
        )
        facts = "\n".join(f"- {name}: {value}" for name, value in self.environment.items())
        return f"{table}\n\n{figures}\n\n{facts}\n"

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write the figures, reproduction.json and index.html, each whole or not at all.

        Raises
        ------
        InputError : the folder cannot be made or written
        """
        texts = {"reproduction.json": self.json(), "index.html": self.html()}
        encoded = {name: text.encode() for name, text in texts.items()}
        return write_files(Path(folder), {**self.figures, **encoded})


def _rows(claims: Sequence[Claim]) -> list[list[str]]:
    """The table for a reader, its head first."""
    head = ["claim", "the paper", "measured", "verdict", "conditions"]
    return [head] + [
        [
            claim.claim,
            claim.paper,
            claim.measured,
            f"{claim.verdict}: {claim.where}" if claim.where else claim.verdict,
            claim.conditions,
        ]
        for claim in claims
    ]


_PAGE = """<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The paper's figures and claims, measured</title>
<style>
body { max-width: 72rem; margin: 2rem auto; padding: 0 1rem; font: 1rem/1.5 system-ui, sans-serif;
       color: #222; background: #fff; }
h1, h2 { line-height: 1.2; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.4rem 0.6rem; border-bottom: 1px solid #ddd; text-align: left;
         vertical-align: top; }
tr.holds td:nth-child(4) { background: #dff2df; }
tr.fails td:nth-child(4) { background: #f9dfdc; }
figure { margin: 2rem 0; }
img { max-width: 100%%; height: auto; }
figcaption, dl { font-size: 0.9rem; color: #555; }
dt { float: left; clear: left; width: 8rem; }
dd { margin-left: 8.5rem; }
</style>
<h1>The paper's figures and claims, measured</h1>
<p>%s</p>
<h2>Claims</h2>
<table>
%s
</table>
<h2>Figures</h2>
%s
<h2>Where this was measured</h2>
<dl>%s</dl>
</html>
"""
