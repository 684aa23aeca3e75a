"""Compiles and runs Metal shaders without Apple's compiler. Metal's language is C++14 with vectors:
g++ compiles it with the vectors of glm. Errors that only Metal's compiler finds remain unseen."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

_LIBRARY = """#pragma once
#define GLM_FORCE_SWIZZLE
#include <glm/glm.hpp>
#include <cmath>
#define constant const
#define thread
#define threadgroup
#define device
namespace glm {
#define COMPARISON(op, name) template <length_t N, typename T, qualifier Q> \
    vec<N, bool, Q> operator op(vec<N, T, Q> a, vec<N, T, Q> b) { return name(a, b); }
COMPARISON(<, lessThan) COMPARISON(>, greaterThan) COMPARISON(<=, lessThanEqual)
inline bool any(bool of_vectors) { return of_vectors; }
}
namespace metal {
using namespace glm;
using float2 = vec2; using float3 = vec3; using float4 = vec4;
using int2 = ivec2; using int3 = ivec3; using int4 = ivec4;
using float2x2 = mat2x2; using float2x3 = mat2x3; using float2x4 = mat2x4; using float3x3 = mat3x3;
inline float powr(float x, float y) { return std::pow(x, y); }
inline float rsqrt(float x) { return 1.0f / std::sqrt(x); }
using std::atan2; using std::isnan; using std::isinf;
namespace fast = glm;
using uint2 = uvec2; using bool2 = bvec2; using bool3 = bvec3; using bool4 = bvec4;
template <typename T, typename B> T select(T a, T b, B second) { return mix(a, b, second); }
template <typename T> struct texture2d {
    float4 read(uint2, uint) const { return float4(0.0f); }
    uint get_width(uint = 0) const { return 1; }
    uint get_height(uint = 0) const { return 1; }
};
}
"""
# In Metal, literals without a suffix are float.
_FLAGS = ["-std=c++14", "-fsingle-precision-constant", "-Wall", "-Werror"]
_FLAGS += ["-Wno-unused", "-Wno-unused-const-variable", "-Wno-unknown-pragmas"]


def drawn(texts: Sequence[str], scenes: Sequence[str], size: int) -> list[NDArray[np.float32]]:
    """Compile Metal texts and scenes, and return an image of each scene, (size, size, 4).

    scenes : each defines ``float4 drawn(float2 pixel)``

    Raises
    ------
    FileNotFoundError : g++ is not installed
    RuntimeError : the compiler's errors or warnings
    """
    names = [f"scene{i}" for i in range(len(scenes))]
    names += [f"text{i}" for i in range(len(texts))]
    parts = [
        f"namespace {name} {{\n{text}\n}}\n"
        for name, text in zip(names, [*scenes, *texts], strict=True)
    ]
    calls = "".join(f"draw({name}::drawn);" for name in names[: len(scenes)])
    main = f"""#include <cstdio>
void draw(glm::vec4 (*drawn)(glm::vec2)) {{
    for (int y = 0; y < {size}; ++y) for (int x = 0; x < {size}; ++x) {{
        glm::vec4 pixel = drawn(glm::vec2(x + 0.5f, y + 0.5f));
        std::fwrite(&pixel[0], 4, 4, stdout);
    }}
}}
int main() {{ {calls} }}
"""
    with TemporaryDirectory() as folder:
        Path(folder, "metal_stdlib").write_text(_LIBRARY, encoding="utf-8")
        Path(folder, "simd").mkdir()
        Path(folder, "simd/simd.h").touch()
        source, program = Path(folder, "all.cpp"), Path(folder, "all")
        swizzled = re.sub(r"\.([xyzw]{2,4})\b", r".\1()", "".join(parts))  # functions in glm
        text = f"#include <metal_stdlib>\n{swizzled}{main}"
        source.write_text(text, encoding="utf-8")
        command: list[str | Path] = ["g++", *_FLAGS, "-I", folder, source, "-o", program]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        data = subprocess.run([program], capture_output=True, check=True).stdout
    return list(np.frombuffer(data, np.float32).reshape(-1, size, size, 4))
