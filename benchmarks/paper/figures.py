"""Figures 1 to 5 of Romanyuk et al. (2020), reproduced as PNG in memory. Needs matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from benchmarks.paper.claims import COSINES, D16_ERROR, DEGREES, SLOPES, exact_lobe
from facerender import lobes
from facerender.brdf import K_COOK_TORRANCE
from facerender.drawing.context import Backend
from facerender.drawing.renderer import Renderer
from facerender.images.image import encode_srgb8
from facerender.loading import load_mesh
from facerender.measure.measurement import MODELS, lobe_error
from facerender.pricing.cost import printed_lobe
from facerender.scene.camera import Camera
from facerender.scene.light import Light
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading

FACE_SLOPE = 0.4
CAPTIONS = {
    "fig1.png": "Figure 1. D of Cook-Torrance and its cosine form c^n, n = 2/m^2 - 4 (dashed), in "
    "units of the peak 1/(4 m^2).",
    "fig2.png": "Figure 2. Relative error of the cosine form; dots where D is a tenth of its peak.",
    "fig3.png": "Figure 3. D and its approximations D4, D8 and D16, clamped (dashed) and as the "
    "paper prints them (dotted), in units of the peak.",
    "fig4.png": "Figure 4. Relative error of D16, clamped; dots where D is a tenth of its peak.",
    "fig5.png": "Figure 5. The built-in head at m = {m:g} under a high oblique light, with both "
    "models: exact, D16, and eight times their difference.",
}

_DPI = 110
_FACES: tuple[str, str] = ("exact", "d16")


def charts(slopes: Sequence[float] = SLOPES) -> dict[str, bytes]:
    """Draw figures 1 to 4 for these values of m; return PNG content by file name."""
    return {
        "fig1.png": _lobes((), slopes),
        "fig2.png": _errors("cosine", slopes),
        "fig3.png": _lobes((4, 8, 16), slopes),
        "fig4.png": _errors("d16", slopes),
    }


def faces(size: tuple[int, int], backend: Backend, m: float = FACE_SLOPE) -> bytes:
    """Draw figure 5, the head with both models; return PNG content."""
    lights = tuple(Light(*each, shadow=False) for each in ((120.0, 48.0, 6.5), (-60.0, 5.0, 0.9)))
    head = load_mesh().with_material(m=m)
    scene = Scene(head, Camera(-15.0, zoom=1.2), lights)
    rows = []
    with Renderer(size, backend=backend) as renderer:
        for model in MODELS:
            exact, d16 = (renderer.render(scene, Shading(model, lobe)) for lobe in _FACES)
            difference = np.abs(d16.linear[..., :3] - exact.linear[..., :3])
            rows.append(
                np.hstack([exact.srgb8(), d16.srgb8(), encode_srgb8(np.float32(8.0) * difference)])
            )
    margin = 30  # pixels, at the top and on the left
    width, height = 3 * size[0] + margin, 2 * size[1] + margin
    figure = _sheet(width / _DPI, height / _DPI, layout=None)
    figure.figimage(np.vstack(rows), xo=margin)
    centred = {"ha": "center", "va": "center"}
    for column, text in enumerate(("exact", "D16", "8 times the difference")):
        x = margin + (column + 0.5) * size[0]
        figure.text(x / width, 1.0 - 0.5 * margin / height, text, **centred)
    for row, text in enumerate(MODELS.values()):
        y = (1.5 - row) * size[1]
        figure.text(0.5 * margin / width, y / height, text, rotation=90, **centred)
    return _png(figure)


def _lobes(powers: Sequence[int], slopes: Sequence[float]) -> bytes:
    """Draw D with its g-power approximations, or with its cosine form if ``powers`` is empty.

    Each value of m has its own panel.
    """
    figure = _sheet(2.0 * max(len(slopes), 2), 2.9)
    (panels,) = figure.subplots(1, len(slopes), sharey=True, squeeze=False)
    for panel, m in zip(panels, slopes, strict=True):
        panel.plot(DEGREES, exact_lobe(m), color="black", label="D")
        if not powers:
            cosine = lobes.cosine(COSINES, m, K_COOK_TORRANCE)
            panel.plot(DEGREES, cosine, "--", label="$c^n$")
        for index, g in enumerate(powers):
            clamped = lobes.g_power(COSINES, m, K_COOK_TORRANCE, g)
            panel.plot(DEGREES, clamped, "--", color=f"C{index}", label=f"D{g}")
            panel.plot(
                DEGREES, printed_lobe(COSINES, m, K_COOK_TORRANCE, g), ":", color=f"C{index}"
            )
        panel.set_title(f"m = {m:g}, peak {0.25 / m**2:.2f}", fontsize="medium")
        panel.set(xlim=(0.0, 90.0), xticks=(0, 30, 60, 90), ylim=(-0.05, 1.1))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("D / peak")
    panels[len(slopes) // 2].set_xlabel("γ in degrees")
    panels[-1].legend(loc="upper right")
    return _png(figure, colors=64)


def _errors(name: str, slopes: Sequence[float]) -> bytes:
    """Draw the relative error of a lobe over the angle, with a curve for each m."""
    figure = _sheet(8.0, 4.4)
    axes = figure.subplots()
    axes.set(yscale="log", xlim=(0.0, 90.0), ylim=(1e-2, 1e4))
    axes.set(xlabel="γ in degrees", ylabel="relative error in %")
    for index, m in enumerate(slopes):
        exact = exact_lobe(m)
        positive = exact > 1e-300
        error = (
            100.0
            * np.abs(lobe_error(name, m, K_COOK_TORRANCE, DEGREES)[positive])
            / exact[positive]
        )
        axes.plot(DEGREES[positive], error, color=f"C{index}", label=f"m = {m:g}")
        tenth = np.flatnonzero(exact >= 0.1)[-1]
        axes.plot(DEGREES[tenth], error[tenth], "o", color=f"C{index}")
    axes.axhline(D16_ERROR, color="black", linewidth=0.8, linestyle="--")
    axes.text(89.5, D16_ERROR, f"{D16_ERROR:g} %", ha="right", va="bottom")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return _png(figure, colors=64)


def _sheet(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Any:
    from matplotlib.figure import Figure

    return Figure((width, height), dpi=_DPI, layout=layout)


def _png(figure: Any, colors: int | None = None) -> bytes:
    """Render a figure to PNG; a palette of ``colors`` reduces a chart to a third of the bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    buffer = io.BytesIO()
    (image.quantize(colors) if colors else image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
