"""Writes docs/shaders.md, the reference of the GLSL library, from the headers of its files.

python -m tools.docs.shaders
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from facerender.glsl.catalogue import Function, functions
from facerender.measure.tables import markdown_table
from facerender.terms import FRESNEL, LOBES, MASKING

OUTPUT = Path(__file__).parents[2] / "docs/shaders.md"

HOSTS = """# The shader library

The first part is how to use it in a program of yours, the second every function. Written by
`python -m tools.docs.shaders` from the headers of [shaders/facerender](../shaders/facerender), which
`facerender shaders list --json` gives to programs.

## In your program

Your code includes `"facerender/cook_torrance.glsl"`, below one include root; the files include each
other beside the includer. They need nothing but the language: GLSL 330, GLSL ES 300 (WebGL 2), or
GLSL 450 for Vulkan, no uniforms, no host code. Where your host has no include, or another language,
flatten:

```
facerender shaders flatten cook_torrance                         text to include, for all of GLSL
facerender shaders flatten cook_torrance --target es300          begins with #version 300 es
facerender shaders flatten ward --lobe d16 --m 0.3               one lobe, one slope: constants
facerender shaders flatten mine.frag --target vulkan             your own file, includes resolved
facerender shaders flatten cook_torrance --target hlsl           HLSL; or msl (Metal), wgsl (WebGPU)
```

HLSL, Metal's language and WGSL are translated from the same files, with their headers and
comments: functions and constants of numbers, vectors and matrices, of the library and of a file of
your own that includes it. What has samplers or arrays (environment, shadow, scatter) is refused,
and so is an assignment within an expression, which WGSL does not know. They know no choices: all
are made, by macros of your file, `--lobe` and `--m`, or the defaults, and macros that are numbers
become constants.

Choices are macros, said before the include (or given to `flatten`):

| macro | values | default |
| --- | --- | --- |
| FR_LOBE | {lobes}, _G_POWER; _EVERY | FR_LOBE_EXACT |
| FR_LOBE_FUNCTION | a lobe of your own: float name(float c, float m, int k) | |
| FR_FRESNEL | {fresnel} | FR_FRESNEL_SCHLICK |
| FR_MASKING | {masking} | FR_MASKING_V_CAVITY |
| FR_SMALL_SLOPE | 1: accurate for every m; 0: cheaper, for m from 0.2 | 1 |
| FR_SLOPE(m) | (m), or one slope for all fragments, such as 0.3 | (m) |
| FR_G | power of FR_LOBE_G_POWER, in 1 to 31 | 8 |
| FR_STEEPNESS(m, k) | steepness of FR_LOBE_G_POWER, such as (0.25 / ((m) * (m)) - 0.5) | \
(2/m^2 - k)/FR_G |
| FR_FITTED_COEFFICIENTS(m, k) | a vec3 | computed from m |
| FR_FITTED_FINE_COEFFICIENTS(m, k) | a vec4 | computed from m |

Preprocessors that compare macros as text, Babylon.js's and PlayCanvas's, need the number of a
lobe: `#define FR_LOBE 16`; a name fails to compile, with a message that has the numbers.

For several kinds of lobes in one program, or lights with terms of their own,
`#define FR_LOBE FR_LOBE_EVERY` and name the terms call by call, as constants, which the compiler
folds, and a slope that is one too:
`fr_cook_torrance_terms(n, l, v, m, f0, FR_LOBE_D16, FR_FRESNEL_SCHLICK, FR_MASKING_NONE)`.

Radiance is `fr_cook_torrance(n, l, v, m, f0) * irradiance * max(dot(n, l), 0.0)` for a light of
that irradiance; a material with a specular weight multiplies by it. Which lobe loses what, and
where, is in [accuracy.md](accuracy.md); what it costs in [trade.md](trade.md).

In GLSL ES the library declares `precision highp float`, which counts for what follows it: mediump
holds neither 1/m^2 nor the digits of a small angle. A host that wants mediump elsewhere declares it
after the include. `fr_cook_torrance_half` is the exact term with mediump where 10 bits are enough,
within 1 % for cosines from 0.05 and m from 0.1.

| host | how | example |
| --- | --- | --- |
| moderngl | `facerender.moderngl_includes(ctx)`, then `#include` | \
[moderngl_minimal.py](../examples/moderngl_minimal.py) |
| PyOpenGL, or any host in Python | `facerender.resolve_includes(text)` | \
[pyopengl_include.py](../examples/pyopengl_include.py) |
| PyVista, VTK | `facerender.shader_source(...)` in a shader replacement | \
[pyvista_replacement.py](../examples/pyvista_replacement.py) |
| C, C++ | flatten in the build; or install, see below | [c_egl](../examples/c_egl) |
| three.js, WebGL 2 | `make npm`: a package of ES modules, one string for each file | \
[threejs](../examples/threejs) |
| Babylon.js | `make npm`; the strings go into a shader as they are | \
[babylonjs](../examples/babylonjs) |
| PlayCanvas | `make npm`; the strings go into a shader's `fragmentGLSL` as they are | |
| Panda3D | `facerender.resolve_includes(text)`: its own includes end at the first file | \
[panda3d_sphere.py](../examples/panda3d_sphere.py) |
| vispy, pyglet | `facerender.resolve_includes(text)`, or flatten | |
| wgpu, pygfx | `--target wgsl`; or GLSL by `--target vulkan` | |
| Qt | qsb includes the folder `facerender` from beside your shader, with `#extension \
GL_GOOGLE_include_directive : require`; or `--target vulkan` | |
| Vulkan | an include path for the compiler, see below, or `--target vulkan` | |
| Direct3D, Unity, Unreal | `--target hlsl` | |
| Metal | `--target msl` | |

`tests/test_hosts.py` and `test_web.py` draw with naga, glslc, Qt's qsb, vispy, Panda3D, Babylon.js and PlayCanvas
what OpenGL draws, within 1e-6 of the largest value.

A roughness r of glTF, Unreal, three.js, Babylon.js or PlayCanvas is m = r^2: their alpha is r^2
(Burley 2012, "Physically-based shading at Disney"; glTF 2.0, appendix B), and the width alpha of
GGX and that of Beckmann's distribution, which is m, stand for the same peak 1/(pi alpha^2) (Walter
et al. 2007). GGX has longer tails: the same r looks tighter here.

In three.js, `BRDF_GGX` is in 1/sr without N.L, as `fr_cook_torrance` is, so that one may stand for
the other, and roughness, its map, specular colour and all of MeshPhysicalMaterial around it stay.
What multiplies it to make up for light that GGX loses goes:

```js
import { MeshStandardMaterial, ShaderChunk } from "three";
import { cookTorrance } from "facerender-shaders";

const skin = `${cookTorrance}
vec3 BRDF_GGX(const in vec3 lightDir, const in vec3 viewDir, const in vec3 normal,
              const in PhysicalMaterial material) {
  float m = material.roughness * material.roughness;
  vec3 f0 = material.specularColorBlended;
  return vec3(fr_cook_torrance(normal, lightDir, viewDir, m, f0.r),
              fr_cook_torrance(normal, lightDir, viewDir, m, f0.g),
              fr_cook_torrance(normal, lightDir, viewDir, m, f0.b));
}
vec3 BRDF_GGX_of_three(`;
const material = new MeshStandardMaterial();
material.onBeforeCompile = (shader) => {
  const chunk = "lights_physical_pars_fragment";
  const physical = ShaderChunk[chunk]
    .replace("vec3 BRDF_GGX(", () => skin)
    .replace("* material.multiScatteringCompensation", "");
  shader.fragmentShader = shader.fragmentShader.replace(`#include <${chunk}>`, () => physical);
};
```

`make install-shaders PREFIX=/usr/local` installs the files for C and C++: `pkg-config
--variable=shaderdir facerender-shaders` prints the include root, and in CMake

```cmake
find_package(facerender_shaders 0.1 REQUIRED)
add_custom_command(OUTPUT skin.spv DEPENDS skin.frag
    COMMAND glslc -I ${FACERENDER_SHADERS_DIR} ${CMAKE_CURRENT_SOURCE_DIR}/skin.frag -o skin.spv)
```

glslangValidator asks for `#extension GL_GOOGLE_include_directive : require` behind `#version 450`,
and for an include root with no space in it:

```
glslangValidator -V -I$(facerender shaders path) skin.frag -o skin.spv
```

A file comes once into a flattened text, however often it is included: files that are meant to be
included twice, with other macros each time, are not for `flatten`.

Compiler messages: in `resolve_includes`, source string 0 is your text, with your line numbers;
files of the library have the numbers that their `#line` gives.
"""

LEGEND = """## Every function

gamma is the angle between the normal and the half vector, c its cosine. N, L, V and H are unit
vectors: the normal, towards the light, towards the eye, and half between these two. F, G and D are
Fresnel reflectance, masking and the distribution of slopes. The test suite holds every error stated
here, on every target ([targets.md](targets.md)).
"""


def section(function: Function) -> str:
    """Return the entry of one function."""
    parameters = groupby(function.parameters.items(), lambda item: item[1])
    rows = [
        ["formula", f"`{function.formula}`"],
        *([", ".join(f"`{name}`" for name, _ in names), text] for text, names in parameters),
        ["unit", function.unit],
        *([["result", function.result]] if function.result else []),
        ["error", function.error],
        ["source", function.source],
        ["file", f"[{function.file}](../shaders/{function.file})"],
    ]
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    signature = f"```glsl\n{function.signature}\n```"
    table = markdown_table(["", ""], escaped)
    return f"### {function.name}\n\n{signature}\n\n{function.summary}\n\n{table}\n"


def reference() -> str:
    """Return docs/shaders.md."""
    kinds = {"lobes": LOBES, "fresnel": FRESNEL, "masking": MASKING}
    hosts = HOSTS
    for name, kind in kinds.items():
        first, *others = (entry.macro for entry in kind.values())
        prefix = "_".join(first.split("_")[:2])
        macros = [first, *(macro.removeprefix(prefix) for macro in others)]
        hosts = hosts.replace(f"{{{name}}}", ", ".join(macros))
    return "\n".join([hosts, LEGEND, *(section(function) for function in functions())])


def stale() -> Iterator[str]:
    """Tell whether the document is another."""
    if OUTPUT.read_text(encoding="utf-8") != reference():
        yield "not what the headers say"


def main() -> None:
    OUTPUT.write_text(reference(), encoding="utf-8")


if __name__ == "__main__":
    main()
