"""Tests unlit parts: their radiance is their albedo under any light, and the other parts are drawn
as without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main
from facerender.drawing import reference
from tests.awkward_files import MINI_HEAD, gltf, join_glb, mini_head
from tests.meshes import with_geometry
from tests.test_parts import row
from tests.verification.cache import wait_for_cache

LIGHTS = (fr.Light(-50.0, 42.0, 3.0, shadow=True), fr.Light(60.0, 10.0, 1.0, radius=10.0))
COLORS = np.array([(0.1, 0.2, 0.3), (0.9, 0.1, 0.2), (0.4, 0.8, 0.6), (0.2, 0.3, 0.7)])


def pair(**right: object) -> fr.Scene:
    """Return two squares with vertex colours under every kind of light. The left one scatters
    light, the right one has the given material."""
    mesh = row("left", "right")
    mesh = with_geometry(mesh, parts=[replace(part, colors=COLORS) for part in mesh.parts])
    mesh = mesh.with_material("left", scattering="skin").with_material("right", **right)
    return fr.Scene(mesh, fr.Camera(-20.0), LIGHTS, 0.2, None, environment="studio")


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize(
    "alpha", [{}, {"alpha": "mask", "opacity": 0.8}, {"alpha": "blend", "opacity": 0.75}]
)
@pytest.mark.parametrize("shading", [fr.Shading(), fr.Shading(diffuse="coupled", m=0.1, ks=2.0)])
def test_radiance_of_an_unlit_part_is_its_albedo(egl, samples, alpha, shading):
    unlit = pair(unlit=True, scattering="skin", emissive=(1.0, 1.0, 1.0), **alpha)
    with fr.Renderer((96, 64), samples=samples, backend=egl) as renderer:
        linear = renderer.render(unlit, shading).linear
        gbuffer = renderer.gbuffer(unlit, shading)
        covered = renderer.render(unlit, only="parts").linear[..., 0]
        albedo = renderer.render(unlit, only="albedo").linear[..., :3]
        terms = [renderer.render(unlit, shading, only=only) for only in ("diffuse", "specular")]
        lit = renderer.render(pair(**alpha), shading).linear
    # Multisampling mixes the pixels at edges.
    right, left = (np.logical_and.reduce([np.roll(covered == part, offset, axis)
                                          for axis in (0, 1) for offset in (-1, 1)])
                   for part in (2, 1))  # fmt: skip
    assert right.sum() > 200
    expected = albedo[right] * alpha.get("opacity", 1.0) ** (alpha.get("alpha") == "blend")
    # Multisampling evaluates colours at slightly different points where two triangles meet.
    tolerance = 1e-5 if samples == 1 else 5e-3
    np.testing.assert_allclose(linear[right][:, :3], expected, atol=tolerance)
    assert not any(term.linear[right][:, :3].any() for term in terms)
    np.testing.assert_array_equal(linear[left], lit[left])
    assert np.abs(linear[right] - lit[right]).mean() > 0.02
    if samples == 1:
        shaded = reference.shade(gbuffer, unlit, shading)
        np.testing.assert_allclose(linear[..., :3], shaded, atol=1e-4)


def test_part_option_draws_a_file_unlit_or_lit(tmp_path):
    """The background, the exposure and the records are as in other images."""
    words = ["render", str(MINI_HEAD), "--size", "64", "--samples", "1", "--background", "0,0,0"]
    pixels = {}
    for name, options in {
        "lit": [], "unlit": ["--part", "*,unlit=true"], "albedo": ["--only", "albedo"]
    }.items():  # fmt: skip
        path = tmp_path / f"{name}.png"
        assert main([*words, *options, "--exposure", "1", "-o", str(path)]) == 0
        with Image.open(path) as image:
            assert ("unlit" in image.info) == (name == "unlit")
            pixels[name] = np.asarray(image.convert("RGB"), dtype=int)
    assert np.abs(pixels["unlit"] - pixels["albedo"]).max() <= 1
    assert np.abs(pixels["unlit"] - pixels["lit"]).mean() > 5.0


def written(path, **extensions):
    document, binary = gltf(mini_head())
    document["materials"][0]["extensions"] = extensions
    path.write_bytes(join_glb(document, binary))
    return path


def test_an_unlit_file_can_be_lit_and_is_cached(tmp_path, cache_folder):
    path = written(tmp_path / "unlit.glb", KHR_materials_unlit={})
    meshes = [fr.load_mesh(path, cache=True)]
    wait_for_cache()
    meshes.append(fr.load_mesh(path, cache=True))
    with fr.Renderer((64, 64), samples=1) as renderer:
        stored, again = (renderer.render(fr.Scene(mesh)).linear for mesh in meshes)
        np.testing.assert_array_equal(stored, again)
        lit = renderer.render(fr.Scene(meshes[1].with_material(unlit=False))).linear
        other = fr.load_mesh(written(tmp_path / "lit.glb"))
        np.testing.assert_array_equal(lit, renderer.render(fr.Scene(other)).linear)
    assert np.abs(lit - stored).mean() > 0.01


def test_a_factor_without_effect_is_named(tmp_path):
    mesh = fr.load_mesh(written(tmp_path / "unlit.glb", KHR_materials_unlit={}))
    message = "m = 0.2 has no effect without unlit=false: give both for a part of unlit.glb"
    with pytest.warns(fr.FacerenderWarning, match=message):
        mesh.with_material(m=0.2)
    mesh.with_material(m=0.2, unlit=False)


def test_a_plan_of_unlit_parts_costs_no_specular_term(egl):
    with fr.Renderer((32, 32), samples=1, backend=egl) as renderer:
        lit, unlit = (
            fr.plan(pair(unlit=value, scattering=None), "2/255", renderer=renderer, cost="navi21")
            for value in (False, True)
        )
    assert unlit.cost.full_total < lit.cost.full_total
