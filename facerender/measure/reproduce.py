"""Redraws figures 1 to 5 of S. O. Romanyuk et al., Proc. SPIE 11456, 114560E (2020), and holds the
paper's claims against what is measured here. How cost is measured is in ``cost.py``."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import json
import os
import platform
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender import lobes
from facerender.brdf import K_COOK_TORRANCE
from facerender.drawing.context import Backend
from facerender.drawing.renderer import Renderer
from facerender.errors import NotMeasured
from facerender.image import encode_srgb8
from facerender.loading import load_mesh
from facerender.measure import plots
from facerender.measure.error import lobe_error, printed_error, printed_lobe
from facerender.measure.report import write_files
from facerender.measure.run import environment
from facerender.measure.tables import markdown_table
from facerender.pricing import amd
from facerender.pricing.cost import OF_COSINE, OF_VECTORS, QUANTILE, Interval, bootstrap, by_slope
from facerender.pricing.variants import lobe_terms, terms
from facerender.scenes.camera import Camera
from facerender.scenes.light import Light
from facerender.scenes.scene import Scene
from facerender.shading import Shading

Array = NDArray[np.float64]
Verdict = Literal["holds", "fails", "undecided", "not measured", "for comparison"]

SCHEMA = "facerender.reproduce/1"
PAPER = (
    "S. O. Romanyuk et al., Modification of existing methods of visualization of offset face skin "
    "structure, Proc. SPIE 11456, 114560E (2020), doi 10.1117/12.2569770"
)
SLOPES = (0.2, 0.3, 0.4, 0.5, 0.6)  # the paper's
D16_ERROR = 1.3  # percent, "does not exceed"
SCALAR_SPEED = 4.34  # times, of D16 alone on a CPU
WHOLE_SPEED = 2.0  # times, "more than"
FACE_SLOPE = 0.4
FLAGS = ("-O2", "-fno-tree-vectorize")  # gcc vectorises some loops at -O2: that is not scalar
CAPTIONS = {
    "fig1.png": "Figure 1. D of Cook-Torrance and its cosine form c^n, n = 2/m^2 - 4 (dashed), in "
    "units of the peak 1/(4 m^2).",
    "fig2.png": "Figure 2. Relative error of the cosine form; dots where D is a tenth of its peak.",
    "fig3.png": "Figure 3. D and its approximations D4, D8 and D16, clamped (dashed) and as the "
    "paper prints them (dotted), in units of the peak.",
    "fig4.png": "Figure 4. Relative error of D16, clamped; dots where D is a tenth of its peak.",
    "fig5.png": f"Figure 5. The built-in head at m = {FACE_SLOPE:g} under a high oblique light, "
    "with both models: exact, D16, and eight times their difference.",
}

_DPI = 110
_FACES: tuple[str, str] = ("exact", "d16")
_DEGREES = np.linspace(0.0, 90.0, 9001)
_COSINES = np.cos(np.radians(_DEGREES)).clip(0.0, 1.0)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper beside what was measured.

    Attributes
    ----------
    claim, paper, measured, conditions : for a reader; paper is the number that the paper gives
    verdict : a claim of speed holds where the whole 95 % interval reaches the paper's number, and
        is undecided where the interval contains it
    where : the part of the domain in which a claim holds that fails as a whole, or why there is no
        measurement
    values : the numbers behind "measured"
    """

    claim: str
    paper: str
    measured: str
    conditions: str
    verdict: Verdict
    where: str = ""
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)


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
            "claims": [dataclasses.asdict(claim) for claim in self.claims],
            "cost": {name: dataclasses.asdict(cost) for name, cost in self.cost.items()},
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


def reproduce(
    repeats: int = 25,
    size: tuple[int, int] = (360, 420),
    backend: Backend = "auto",
    progress: Callable[[str], object] = lambda step: None,
) -> Reproduction:
    """Draw the paper's figures and measure what it claims.

    Parameters
    ----------
    repeats : of every measurement of time
    size : of one face in figure 5, in pixels
    progress : called with the name of each step as it begins

    Raises
    ------
    InputError : matplotlib is not installed
    ContextError : no OpenGL context
    """
    plots.check()
    progress("figures 1 to 4")
    figures = {
        "fig1.png": _lobes_figure(()),
        "fig2.png": _errors_figure("cosine"),
        "fig3.png": _lobes_figure((4, 8, 16)),
        "fig4.png": _errors_figure("d16"),
    }
    progress("figure 5")
    figures["fig5.png"] = _faces_figure(size, backend)
    facts = environment(backend)
    progress("scalar code")
    try:
        scalar, compiler = scalar_cost(repeats)
        claims = _scalar_claims(scalar, f"{compiler}; {facts['processor']}")
    except NotMeasured as error:
        scalar, compiler = {}, "none"
        claims = _scalar_claims(scalar, str(error))
    renderer = facts["GL_RENDERER"]
    progress(f"GLSL on {renderer}")
    glsl = _glsl_cost(repeats, backend)
    where = f"{renderer} on {facts['processor']}" if facts["software"] else renderer
    claims += _glsl_claims(glsl, where)
    progress("AMD's compiler")
    claims += _amd_claims()
    facts |= {
        "C compiler": compiler,
        "C library": " ".join(platform.libc_ver()),
        "matplotlib": version("matplotlib"),
        "repeats": repeats,
    }
    return Reproduction(facts, [*error_claims(), *claims], {**scalar, **glsl}, figures)


# --- errors --------------------------------------------------------------------------------------


def relative_error(name: str, m: float, down_to: float) -> float:
    """Return the largest |lobe - exact|/exact in percent for Cook-Torrance, from the peak down to
    the share ``down_to`` of it.

    Raises
    ------
    InputError : m outside the domain of the lobe
    """
    end = np.interp(-down_to, -_exact(m), _DEGREES)
    degrees = np.linspace(0.0, end, 1001)
    exact = lobes.exact(np.cos(np.radians(degrees)), m, K_COOK_TORRANCE)
    return 100.0 * float((np.abs(lobe_error(name, m, K_COOK_TORRANCE, degrees)) / exact).max())


def error_claims() -> list[Claim]:
    """Hold "the relative error does not exceed 1.3 %" against D16."""

    def relative(m: float) -> float:
        return relative_error("d16", m, 0.1)

    def absolute(m: float) -> float:
        return 100.0 * float(np.abs(lobe_error("d16", m, K_COOK_TORRANCE, _DEGREES)).max())

    def unclamped(m: float) -> float:
        return 100.0 * float(np.abs(printed_error(m, K_COOK_TORRANCE, 16)).max())

    claims = []
    for error, conditions in (
        (relative, "relative to D, down to a tenth of its peak; clamped; float64"),
        (absolute, "in % of the peak, 0 to 90 degrees; clamped; float64"),
        (unclamped, "in % of the peak, 0 to 90 degrees; as printed, without a clamp; float64"),
    ):
        values = {f"{m:g}": error(m) for m in SLOPES}
        scanned = np.linspace(0.1, 0.7, 601)
        inside = [m for m in scanned if error(m) <= D16_ERROR]
        run = f"from {inside[0]:.3f} to {inside[-1]:.3f}" if inside else "nowhere"
        claims.append(
            Claim(
                "error of D16 against D",
                f"at most {D16_ERROR:g} %",
                f"{', '.join(f'{value:.3g}' for value in values.values())} % "
                f"at m = {', '.join(values)}",
                conditions,
                "holds" if max(values.values()) <= D16_ERROR else "fails",
                f"of m = 0.1 to 0.7 it holds {run}",
                values,
            )
        )
    return claims


def _exact(m: float) -> Array:
    return lobes.exact(_COSINES, m, K_COOK_TORRANCE)


# --- cost ----------------------------------------------------------------------------------------


def scalar_cost(repeats: int) -> tuple[dict[str, Interval], str]:
    """Measure ``scalar.c``, compiled with the system's C compiler.

    Returns
    -------
    nanoseconds an evaluation by the name of the function, and the compiler with its flags

    Raises
    ------
    NotMeasured : no compiler, or one that fails
    """
    source = str(Path(__file__).with_name("scalar.c"))
    with tempfile.TemporaryDirectory() as folder:
        program = os.path.join(folder, "scalar")
        try:
            _output("cc", *FLAGS, source, "-o", program, "-lm")
            compiler = _output("cc", "--version").splitlines()[0]
            names, _, *rows = _output(program, str(repeats)).splitlines()
        except (OSError, subprocess.SubprocessError) as error:
            raise NotMeasured(f"needs the apt packages gcc and libc6-dev ({error})") from None
    times = np.array([row.split() for row in rows], dtype=np.float64)
    intervals = bootstrap(lambda turns: np.quantile(times[turns], QUANTILE, axis=0), repeats)
    return dict(zip(names.split(), intervals, strict=True)), f"{compiler}, {' '.join(FLAGS)}"


def _output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def _scalar_claims(cost: Mapping[str, Interval], where: str) -> list[Claim]:
    """Hold "4.34 times faster" against scalar code, or say where it could not be measured."""
    title, paper = "D16 against D, scalar on a CPU", f"{SCALAR_SPEED:g} times as fast"
    if not cost:
        return [Claim(title, paper, "", "", "not measured", where)]
    claims = [
        _speed_claim(title, cost[exact], cost[d16], f"{how}; {where}", paper, SCALAR_SPEED)
        for exact, d16, how in (
            ("printed_each", "d16_each", "as printed, an m for each cosine"),
            ("printed_one", "d16_one", "as printed, one m for all"),
            ("printed_one", "d16_beforehand", "one m, in D16 no division left"),
        )
    ]
    ours = "D with one division against D as printed, scalar"
    each = f"an m for each cosine; {where}"
    return [*claims, _speed_claim(ours, cost["printed_each"], cost["exact_each"], each)]


def _glsl_cost(repeats: int, backend: Backend) -> dict[str, Interval]:
    """Measure whole terms, and the lobes alone."""
    result: dict[str, Interval] = {}
    for title, forms, empty in (
        ("Cook-Torrance, whole term", terms("cook-torrance"), OF_VECTORS),
        ("Ward, whole term", terms("ward"), OF_VECTORS),
        ("Cook-Torrance, lobe alone", lobe_terms("cook-torrance"), OF_COSINE),
        ("Ward, lobe alone", lobe_terms("ward"), OF_COSINE),
    ):
        timed = {name: forms[name] for name in ("printed, exact", "printed, d16", "exact")}
        costs = by_slope(timed, empty, repeats, backend)
        result |= {f"{title}: {name}": cost for name, cost in costs.items()}
    return result


def _glsl_claims(cost: Mapping[str, Interval], renderer: str) -> list[Claim]:
    """Hold "more than twice" against whole terms; the lobes alone and our terms stand beside."""
    claims = []
    for title in dict.fromkeys(name.split(":")[0] for name in cost):
        exact, d16, ours = (
            cost[f"{title}: {name}"] for name in ("printed, exact", "printed, d16", "exact")
        )
        against = f"{title}: D16 against exact, as printed"
        if "whole" in title:
            paper = f"more than {WHOLE_SPEED:g} times as fast"
            claims.append(_speed_claim(against, exact, d16, renderer, paper, WHOLE_SPEED))
        else:
            claims.append(_speed_claim(against, exact, d16, renderer))
        against = f"{title}: our exact against exact as printed"
        claims.append(_speed_claim(against, exact, ours, renderer))
    return claims


def _amd_claims() -> list[Claim]:
    """Hold "more than twice" against what AMD's compiler says of whole terms."""
    claims = []
    paper = f"more than {WHOLE_SPEED:g} times as fast"
    models: dict[str, str] = {"Cook-Torrance": "cook-torrance", "Ward": "ward"}
    for name, model in models.items():
        title = f"{name}, whole term: D16 against exact, as printed"
        for family in amd.FAMILIES:
            try:
                rows = amd.statistics(terms(model), family)
            except NotMeasured as error:
                claims.append(Claim(title, paper, "", family, "not measured", str(error)))
                continue
            cycles = {form: Interval(*3 * (row.inverse_throughput,)) for form, row in rows.items()}
            exact, d16, ours = (cycles[f] for f in ("printed, exact", "printed, d16", "exact"))
            where = f"{family}, estimated by the compiler of {amd.driver()}"
            claims.append(_speed_claim(title, exact, d16, where, paper, WHOLE_SPEED, "cycles"))
            against = f"{name}, whole term: our exact against exact as printed"
            claims.append(_speed_claim(against, exact, ours, where, unit="cycles"))
    return claims


def _speed_claim(
    title: str,
    slow: Interval,
    fast: Interval,
    conditions: str,
    paper: str = "",
    needed: float | None = None,
    unit: str = "ns",
) -> Claim:
    """Hold the ratio of two costs against the paper's, if it gives one. The bounds of the ratio let
    both costs go their worst way."""
    least = 1e-9  # noise may take a cost to zero or below
    ratio = slow.value / max(fast.value, least)
    low, high = slow.low / max(fast.high, least), slow.high / max(fast.low, least)
    verdict: Verdict = "for comparison"
    if needed is not None:
        verdict = "holds" if low >= needed else "fails" if high < needed else "undecided"
    return Claim(
        title,
        paper,
        f"{ratio:.2f} times ({low:.2f} to {high:.2f}): "
        f"{slow.value:.3g} and {fast.value:.3g} {unit}",
        conditions,
        verdict,
        values={"ratio": ratio, "low": low, "high": high},
    )


# --- figures -------------------------------------------------------------------------------------


def _figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Any:
    from matplotlib.figure import Figure

    return Figure((width, height), dpi=_DPI, layout=layout)


def _png(figure: Any, colors: int | None = None) -> bytes:
    """Draw, in a palette of so many colours if it is given: a third of the bytes for a chart."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    buffer = io.BytesIO()
    (image.quantize(colors) if colors else image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _lobes_figure(powers: Sequence[int]) -> bytes:
    """D and its g-powers, or its cosine form where there are none; a panel for each slope."""
    figure = _figure(10.0, 2.9)
    panels = figure.subplots(1, len(SLOPES), sharey=True)
    for panel, m in zip(panels, SLOPES, strict=True):
        panel.plot(_DEGREES, _exact(m), color="black", label="D")
        if not powers:
            cosine = lobes.cosine(_COSINES, m, K_COOK_TORRANCE)
            panel.plot(_DEGREES, cosine, "--", label="$c^n$")
        for index, g in enumerate(powers):
            clamped = lobes.g_power(_COSINES, m, K_COOK_TORRANCE, g)
            panel.plot(_DEGREES, clamped, "--", color=f"C{index}", label=f"D{g}")
            panel.plot(
                _DEGREES, printed_lobe(_COSINES, m, K_COOK_TORRANCE, g), ":", color=f"C{index}"
            )
        panel.set_title(f"m = {m:g}, peak {0.25 / m**2:.2f}", fontsize="medium")
        panel.set(xlim=(0.0, 90.0), xticks=(0, 30, 60, 90), ylim=(-0.05, 1.1))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("D / peak")
    panels[2].set_xlabel("γ in degrees")
    panels[-1].legend(loc="upper right")
    return _png(figure, colors=64)


def _errors_figure(name: str) -> bytes:
    """The relative error of a lobe over the angle, a curve for each slope."""
    figure = _figure(8.0, 4.4)
    axes = figure.subplots()
    axes.set(yscale="log", xlim=(0.0, 90.0), ylim=(1e-2, 1e4))
    axes.set(xlabel="γ in degrees", ylabel="relative error in %")
    for index, m in enumerate(SLOPES):
        exact = _exact(m)
        shown = exact > 1e-300
        error = 100.0 * np.abs(lobe_error(name, m, K_COOK_TORRANCE, _DEGREES)[shown]) / exact[shown]
        axes.plot(_DEGREES[shown], error, color=f"C{index}", label=f"m = {m:g}")
        tenth = np.flatnonzero(exact >= 0.1)[-1]
        axes.plot(_DEGREES[tenth], error[tenth], "o", color=f"C{index}")
    axes.axhline(D16_ERROR, color="black", linewidth=0.8, linestyle="--")
    axes.text(89.5, D16_ERROR, f"{D16_ERROR:g} %", ha="right", va="bottom")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return _png(figure, colors=64)


def _faces_figure(size: tuple[int, int], backend: Backend) -> bytes:
    """The head with both models."""
    models: dict[str, str] = {"Cook-Torrance": "cook-torrance", "Ward": "ward"}
    lights = (Light(120.0, 48.0, 6.5), Light(-60.0, 5.0, 0.9))
    head = load_mesh().with_material(m=FACE_SLOPE)
    scene = Scene(head, Camera(-15.0, zoom=1.2), lights)
    rows = []
    with Renderer(size, backend=backend) as renderer:
        for model in models.values():
            exact, d16 = (renderer.render(scene, Shading(model, lobe)) for lobe in _FACES)
            difference = np.abs(d16.linear[..., :3] - exact.linear[..., :3])
            rows.append(np.hstack([exact.srgb8(), d16.srgb8(), encode_srgb8(8.0 * difference)]))
    margin = 30  # pixels, on top and on the left
    width, height = 3 * size[0] + margin, 2 * size[1] + margin
    figure = _figure(width / _DPI, height / _DPI, layout=None)
    figure.figimage(np.vstack(rows), xo=margin)
    centred = {"ha": "center", "va": "center"}
    for column, text in enumerate(("exact", "D16", "8 times the difference")):
        x = margin + (column + 0.5) * size[0]
        figure.text(x / width, 1.0 - 0.5 * margin / height, text, **centred)
    for row, text in enumerate(models):
        y = (1.5 - row) * size[1]
        figure.text(0.5 * margin / width, y / height, text, rotation=90, **centred)
    return _png(figure)


# --- documents -----------------------------------------------------------------------------------


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
