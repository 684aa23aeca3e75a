"""The reproduction of the paper's figures and claims as JSON and as an HTML page."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from benchmarks.paper.claims import Claim
from benchmarks.paper.figures import CAPTIONS
from facerender.measure.report import write_files
from facerender.page import document, figure, row, table
from facerender.pricing.cost import Interval

SCHEMA = "facerender.reproduce/1"
PAPER = (
    "S. O. Romanyuk et al., Modification of existing methods of visualization of offset face skin "
    "structure, Proc. SPIE 11456, 114560E (2020), doi 10.1117/12.2569770"
)
_HEAD = ("claim", "the paper", "measured", "verdict", "conditions")


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The reproduced figures and the measured claims.

    Attributes
    ----------
    environment : renderer, processor, versions, date
    claims : the rows of the table
    cost : nanoseconds per evaluation, by name of the timed function
    figures : PNG content by file name
    m : roughness of the head in figure 5
    """

    environment: Mapping[str, Any]
    claims: Sequence[Claim]
    cost: Mapping[str, Interval]
    figures: Mapping[str, bytes]
    m: float

    def json(self) -> str:
        """Return the reproduction without its images as JSON.

        schema       "facerender.reproduce/1"
        paper        citation of the paper
        environment  as in docs/measurements/measure-schema.md, and C compiler, C library,
                     matplotlib, repeats
        claims       list of the fields of :class:`Claim`; values are percent by m, or the ratio of
                     two costs with the bounds low and high
        cost         nanoseconds per evaluation by name: value, and the 95 % interval, low to high
        figures      captions by file name
        """
        content = {
            "schema": SCHEMA,
            "paper": PAPER,
            "environment": self.environment,
            "claims": [asdict(claim) for claim in self.claims],
            "cost": {name: asdict(cost) for name, cost in self.cost.items()},
            "figures": {name: self._caption(name) for name in CAPTIONS},
        }
        return json.dumps(content, indent=2) + "\n"

    def html(self) -> str:
        """Return an HTML page with embedded figures."""
        facts = [row(escape(name), [escape(str(fact))]) for name, fact in self.environment.items()]
        body = [
            f"<p>{escape(PAPER)}</p>",
            "<h2>Claims</h2>",
            table("claims", _HEAD, map(_row, self.claims)),
            "<h2>Figures</h2>",
            *(figure(png, self._caption(name)) for name, png in self.figures.items()),
            "<h2>Environment of the measurement</h2>",
            table("facts", (), facts),
        ]
        return document("The paper's figures and claims, measured", "\n".join(body))

    def _caption(self, name: str) -> str:
        return CAPTIONS[name].replace("{m:g}", f"{self.m:g}")

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write the figures, reproduction.json and index.html, each atomically.

        Raises
        ------
        InputError : the folder cannot be created or written
        """
        texts = {"reproduction.json": self.json(), "index.html": self.html()}
        encoded = {name: text.encode() for name, text in texts.items()}
        return write_files(Path(folder), {**self.figures, **encoded})


def _row(claim: Claim) -> str:
    kind = "verdict" if claim.paper else "note"
    verdict = f'<span class="{kind}">{claim.verdict}</span>{escape(_where(claim))}'
    cells = [escape(claim.paper), escape(claim.measured), verdict, escape(claim.conditions)]
    return row(escape(claim.claim), cells, claim.verdict.replace(" ", "-"))


def _where(claim: Claim) -> str:
    return f": {claim.where}" if claim.where else ""
