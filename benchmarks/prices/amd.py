"""Cost of GLSL expressions on AMD GPUs, as RADV, their compiler in Mesa, estimates it.

Needs the Debian packages glslang-tools, mesa-vulkan-drivers and libvulkan1, and the
dependency group compilers. Needs no GPU: programs are compiled, not run.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from facerender.errors import InputError, NotMeasured
from facerender.glsl.library import resolve_includes
from facerender.pricing import cost
from facerender.pricing.cost import INPUTS

FAMILIES = {"navi21": "RDNA2 (navi21)", "vega10": "GCN5 (vega10)"}
ICD_FOLDERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
_DRIVER_PACKAGES = "mesa-vulkan-drivers libvulkan1"

_KERNEL = """#version 450
%s
layout(local_size_x = 64) in;
struct Point { vec4 n_m, l_f0, v; };
layout(std430, binding = 0) readonly restrict buffer Points { Point points[]; };
layout(std430, binding = 1) writeonly restrict buffer Results { float results[]; };
void main() {
    uint i = gl_GlobalInvocationID.x;
    vec3 n = points[i].n_m.xyz, l = points[i].l_f0.xyz, v = points[i].v.xyz;
    float m = points[i].n_m.w, f0 = points[i].l_f0.w;
    float result = %s;
    %s
    results[i] = result;
}
"""
# RADV's inverse throughput of a wave is the maximum of two values: the cycles of its busiest unit,
# and its latency divided by the number of waves that hide it. In a kernel as short as a term, the
# second value, mostly memory latency, would be the larger. The ballast, a chain of dependent
# operations, makes the vector ALU the busiest unit, as in a whole shader. The subtraction of the
# empty kernel removes the ballast from the result.
_BALLAST = 256 * "result = fma(result, result, 0.25);"


@dataclass(frozen=True)
class Statistics:
    """The estimated cost of a wave of 64 invocations, minus a kernel that only sums its inputs.

    Attributes
    ----------
    instructions : machine instructions
    latency : cycles of a wave that runs alone: issue and stalls
    inverse_throughput : cycles for which the wave occupies the vector ALU of its SIMD. On RDNA2 a
        transcendental counts like any instruction: its unit, four times as slow, works in parallel.
    """

    instructions: int
    latency: int
    inverse_throughput: int


def statistics(terms: Mapping[str, tuple[str, str]], family: str) -> dict[str, Statistics]:
    """Return the cost of each term on a GPU family, minus a kernel that only sums its inputs.

    The kernels read N, L, V, m and F0 from a buffer.

    Parameters
    ----------
    terms : prelude and expression by name; the prelude may include files of the library, the
        expression is a float that depends on vec3 n, l, v and float m, f0
    family : "navi21" (RDNA2) or "vega10" (GCN5)

    Raises
    ------
    InputError : the family is unknown, or a term is not valid GLSL
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    kernels = [kernel(*term) for term in (("", INPUTS), *terms.values())]
    (empty, *gross) = compile_programs(kernels, family)[1]
    return {
        name: Statistics(
            *(row[key] - empty[key] for key in ("Instructions", "Latency", "Inverse Throughput"))
        )
        for name, row in zip(terms, gross, strict=True)
    }


def driver() -> str:
    """Return the compiler's name and version, such as "radv Mesa 22.3.6".

    Raises
    ------
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    return compile_programs([], next(iter(FAMILIES)))[0]


def table() -> dict[str, Any]:
    """Return the driver, and the statistics by family, model and term; raises as
    :func:`statistics`."""

    def rows(model: str, family: str) -> dict[str, dict[str, int]]:
        found = statistics(cost.terms(model), family)
        return {name: asdict(row) for name, row in found.items()}

    return {
        "driver": driver(),
        "statistics": {
            family: {model: rows(model, family) for model in cost.PRINTED} for family in FAMILIES
        },
    }


def kernel(prelude: str, expression: str, ballast: str = _BALLAST) -> tuple[bytes, ...]:
    """Return the SPIR-V of a kernel that evaluates a term; raise InputError if it is not GLSL."""
    source = resolve_includes(_KERNEL % (prelude, expression, ballast))
    try:
        return spirv(comp=source)
    except InputError as error:
        raise InputError(f"{expression} is not GLSL: {error}") from None


@cache
def spirv(**sources: str) -> tuple[bytes, ...]:
    """Return the SPIR-V of a program's stages, for :func:`compile_programs`.

    Uniforms outside a block form the uniform buffer at binding 0; textures have the bindings from
    1. Attributes and varyings have locations in the order of their declarations.

    Parameters
    ----------
    sources : GLSL with resolved includes, by stage: comp, or vert and frag

    Raises
    ------
    InputError : a source is not valid GLSL
    NotMeasured : glslangValidator is missing; the message names the command that installs it
    """
    compiler = shutil.which("glslangValidator")
    if compiler is None:
        raise _not_measured("glslangValidator is not installed", "glslang-tools")
    options = "-V -R --target-env vulkan1.1 --auto-map-locations --auto-map-bindings"
    with TemporaryDirectory() as folder:
        for stage, source in sources.items():
            Path(folder, f"program.{stage}").write_text(source, encoding="utf-8")
        files = [f"program.{stage}" for stage in sources]
        run = subprocess.run(
            [compiler, *options.split(), "--shift-texture-binding", "1", *files],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        if run.returncode:
            error = next((line for line in run.stdout.splitlines() if "ERROR" in line), run.stderr)
            raise InputError(error.strip())
        return tuple(Path(folder, f"{stage}.spv").read_bytes() for stage in sources)


def compile_programs(
    programs: Sequence[Sequence[bytes]], family: str, attributes: Sequence[int] = ()
) -> tuple[str, list[dict[str, int]]]:
    """Compile programs with RADV for a GPU family.

    Runs a separate process, because the driver reads the family when it is loaded.

    Parameters
    ----------
    programs : each is the SPIR-V of a compute program, or of a vertex and a fragment program
    family : "navi21" (RDNA2) or "vega10" (GCN5)
    attributes : number of components of each vertex attribute, in the order of declaration

    Returns
    -------
    the driver's name and version, and for each program the statistics of its last stage by name

    Raises
    ------
    InputError : the family is unknown
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    if family not in FAMILIES:
        raise InputError(f"unknown family {family!r}; known: {', '.join(FAMILIES)}")
    manifests = [path for folder in ICD_FOLDERS for path in folder.glob("radeon_icd*.json")]
    if not manifests:
        folders = " or ".join(map(str, ICD_FOLDERS))
        raise _not_measured(f"no RADV: no radeon_icd*.json in {folders}", _DRIVER_PACKAGES)
    if importlib.util.find_spec("vulkan") is None:
        raise NotMeasured(
            "the Python package vulkan is not installed: pip install --group compilers"
        )
    # The user's settings of Mesa and Vulkan would change the measurement.
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("ACO_", "MESA_", "RADV_", "VK_"))
    } | {
        "RADV_FORCE_FAMILY": family,
        "VK_ICD_FILENAMES": os.pathsep.join(map(str, manifests)),
        "MESA_SHADER_CACHE_DISABLE": "true",
    }
    run = subprocess.run(
        [sys.executable, Path(__file__).with_name("radv.py")],
        input=json.dumps(
            {
                "attributes": attributes,
                "programs": [[module.hex() for module in modules] for modules in programs],
            }
        ),
        env=environment,
        capture_output=True,
        text=True,
    )
    if run.returncode:
        lines = run.stderr.strip().splitlines() or [f"exit status {run.returncode}"]
        raise _not_measured(f"RADV did not compile for {family} ({lines[-1]})", _DRIVER_PACKAGES)
    name, rows = json.loads(run.stdout)
    return name, rows


def _not_measured(reason: str, packages: str) -> NotMeasured:
    return NotMeasured(f"{reason}; on Debian or Ubuntu: apt-get install {packages}")
