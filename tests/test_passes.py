"""Tests rendering passes: each draws to its own target, which later passes read as a texture."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.drawing.compiled import CompiledFrame
from facerender.drawing.frame_passes import Structure, image_passes
from facerender.drawing.maps import Maps
from facerender.drawing.prepare import resolve
from facerender.drawing.program import Draw, Pass, Program, Target
from facerender.scene.view import view_of
from tests.verification.lights import PLAIN_THREE

SHADERS = {
    "depth.frag": "out vec4 depth;\nvoid main() { depth = vec4(gl_FragCoord.z); }\n",
    "join.frag": (
        "uniform sampler2D shade;\nuniform sampler2D light_depth;\nout vec4 result;\n"
        "void main() {\n"
        "    ivec2 at = ivec2(gl_FragCoord.xy);\n"
        "    vec3 twice = 2.0 * texelFetch(shade, at, 0).rgb;\n"
        "    result = vec4(twice, texelFetch(light_depth, at / 2, 0).r);\n"
        "}\n"
    ),
}
SIZE = (64, 64)


@pytest.fixture
def renderer(egl, four_samples, monkeypatch, tmp_path):
    folder = tmp_path / "shaders"
    shutil.copytree(fr.shader_dir(), folder)
    for name, text in SHADERS.items():
        (folder / "host" / name).write_text(text)
    monkeypatch.setattr("facerender.glsl.library.shader_dir", lambda: folder)
    with fr.Renderer(SIZE, samples=4, backend=egl) as renderer:
        yield renderer


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("samples", "deferred"),
    [
        (1, False),
        (4, True),
        pytest.param(1, True, marks=pytest.mark.slow),
        pytest.param(4, False, marks=pytest.mark.slow),
    ],
)
def test_pass_reads_the_targets_of_earlier_passes(renderer, head, samples, deferred, monkeypatch):
    monkeypatch.setattr("facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_: deferred)
    scene = fr.Scene(head.with_material(m=0.3), lights=PLAIN_THREE, background=None)
    view = view_of(scene, 1.0)
    above = view_of(replace(scene, camera=fr.Camera(elevation=60.0)), 1.0)
    resolved = resolve(scene, fr.Shading())
    depth = Pass(
        "light_depth",
        Target(size=(32, 32), sampled=True),
        (Draw(Program("depth.frag"), {}, resolved.appearance.parts[0]),),
        clear=(1.0, 1.0, 1.0, 1.0),
        uniforms={"view_projection": above.matrix},
    )
    black = (0.0, 0.0, 0.0)
    counts = (1, samples) if deferred else ()
    maps = Maps(resolved.appearance, scene.mesh, view, SIZE)
    of = Structure(resolved.appearance, scene.mesh, maps, black, samples, counts)
    *before, shaded = image_passes(of, None)
    shaded = replace(shaded, target=replace(shaded.target, sampled=True))
    join = Pass("join", Target(), (Draw(Program("join.frag", "screen.vert"), {}),), results=(0,))

    frame = CompiledFrame(renderer._resources, [depth, *before, shaded, join], SIZE)
    with renderer.context.drawing():
        _, joined = frame.draw(view, scene.mesh)
    with fr.Renderer(SIZE, samples=samples, backend="egl") as plain:
        expected = plain.render(scene).linear
    np.testing.assert_array_equal(joined[..., :3], 2.0 * expected[..., :3])
    with fr.Renderer((32, 32), samples=1, backend="egl") as small:
        seen = small.gbuffer(replace(scene, camera=fr.Camera(elevation=60.0)))
    covered = seen.part >= 0
    clip = (
        np.insert(seen.normalised_position[covered].astype(float), 3, 1.0, axis=-1) @ above.matrix
    )
    np.testing.assert_allclose(
        joined[::2, ::2, 3][covered], 0.5 + 0.5 * clip[:, 2] / clip[:, 3], atol=1e-4
    )
    assert (joined[::2, ::2, 3][~covered] == 1.0).all()


def test_only_needed_passes_are_drawn(egl, head, monkeypatch):
    drawn = []
    replay = CompiledFrame._replay
    monkeypatch.setattr(
        CompiledFrame,
        "_replay",
        lambda own, step, *rest: drawn.append(step.source.name) or replay(own, step, *rest),
    )
    for deferred in (False, True):
        monkeypatch.setattr(
            "facerender.drawing.frame_passes.deferred_is_cheaper", lambda *_, on=deferred: on
        )
        with fr.Renderer(SIZE, samples=4) as fresh:
            fresh.render(fr.Scene(head, lights=PLAIN_THREE))
            fresh.render(fr.Scene(head), only="normal")  # with shadows, which are not drawn
    assert drawn == ["shade", "data", "visible", "shade", "visible", "data"]
