"""Render a sphere with PyVista. A VTK shader replacement replaces Phong's specular term with
Cook-Torrance.

    python examples/pyvista_replacement.py [OUT.png]

The mesh keeps its VTK material: ``specular`` is the weight ks, ``specular_color`` its colour. The
code supports one directional light. The variables of a second light in VTK are lightColor1 and
lightDirectionVC1.
"""

from __future__ import annotations

import sys

import pyvista as pv

import facerender as fr

M = 0.2
F0 = 0.04
LIGHT = (-1.0, 1.0, 1.5)

# GLSL that follows VTK's lighting code and uses its variables. In VTK, a light of colour 1 gives a
# white diffuse surface the radiance 1, so its irradiance is pi.
SHADING = f"""//VTK::Light::Impl
  vec3 eye = cameraParallel != 0 ? vec3(0.0, 0.0, 1.0) : normalize(-vertexVC.xyz);
  vec3 received = FR_PI * df * lightColor0;
  float brdf = fr_cook_torrance(normalVCVSOutput, -lightDirectionVC0, eye, {M}, {F0});
  vec3 x = ambientColor + diffuse + specularColor * brdf * received;
  fragOutput0.rgb = mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
"""


def plot(mesh: pv.PolyData) -> pv.Plotter:
    """Return an off-screen plot of a mesh with a Cook-Torrance highlight, sRGB-encoded."""
    plotter = pv.Plotter(off_screen=True, window_size=(512, 512), lighting="none")
    plotter.background_color = "black"
    plotter.add_light(pv.Light(position=LIGHT, light_type="scene light"))
    actor = plotter.add_mesh(mesh, color=(0.46, 0.25, 0.17), ambient=0.05, smooth_shading=True)
    actor.prop.specular, actor.prop.specular_color = 1.0, "white"
    shader = actor.GetShaderProperty()
    functions = "//VTK::Light::Dec\n" + fr.shader_source("cook_torrance")
    shader.AddFragmentShaderReplacement("//VTK::Light::Dec", True, functions, False)
    shader.AddFragmentShaderReplacement("//VTK::Light::Impl", True, SHADING, False)
    plotter.view_xy()
    plotter.camera.zoom(1.6)
    return plotter


def main() -> None:
    path = sys.argv[1] if len(sys.argv) > 1 else "pyvista.png"
    sphere = pv.Sphere(radius=1.0, theta_resolution=128, phi_resolution=128)
    plot(sphere).screenshot(path)


if __name__ == "__main__":
    main()
