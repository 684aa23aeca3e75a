"""Machine instructions of GLSL expressions on Intel and NVIDIA GPUs, from their compilers of
OpenCL C and CUDA C++.

Needs the Debian package intel-opencl-icd and the dependency group compilers. Needs neither a
GPU nor a driver: programs are compiled, not run.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from facerender.errors import InputError, NotMeasured
from facerender.pricing import cost
from facerender.pricing.cost import INPUTS
from tests.verification.hosts import flat

# The compilers' names of the GPUs, and their architectures.
INTEL = {"skl": "Intel Gen9", "acm-g10": "Intel Xe-HPG"}
NVIDIA = {"sm_75": "NVIDIA Turing", "sm_120": "NVIDIA Blackwell"}
GPUS = INTEL | NVIDIA

# The library is translated to Metal's language. These definitions make the part that terms use
# valid OpenCL C and CUDA C++.
_OPENCL = """
#define FUNCTION static __attribute__((overloadable))
#define KERNEL __kernel __attribute__((intel_reqd_sub_group_size(16))) void
#define BUFFER __global
#define INDEX get_global_id(0)
#define constant __constant
#define float(x) ((float)(x))
#define float2(...) ((float2)(__VA_ARGS__))
#define float3(...) ((float3)(__VA_ARGS__))
#define float4(...) ((float4)(__VA_ARGS__))
#define abs fabs
#define normalize(a) ((a) * rsqrt(dot(a, a)))
"""
_CUDA = """
#define FUNCTION __device__
#define KERNEL extern "C" __global__ void
#define BUFFER
#define INDEX (blockIdx.x * blockDim.x + threadIdx.x)
#define constant __device__ const
#define thread
FUNCTION float2 make_float2(float a) { return {a, a}; }
FUNCTION float3 make_float3(float a) { return {a, a, a}; }
FUNCTION float4 make_float4(float a) { return {a, a, a, a}; }
#define WITH_NUMBERS(n, op) \\
    FUNCTION float##n operator op(float##n a, float b) { return a op make_float##n(b); } \\
    FUNCTION float##n operator op(float a, float##n b) { return make_float##n(a) op b; }
#define OPERATOR(op) \\
    FUNCTION float2 operator op(float2 a, float2 b) { return {a.x op b.x, a.y op b.y}; } \\
    FUNCTION float3 operator op(float3 a, float3 b) { \\
        return {a.x op b.x, a.y op b.y, a.z op b.z}; \\
    } \\
    FUNCTION float4 operator op(float4 a, float4 b) { \\
        return {a.x op b.x, a.y op b.y, a.z op b.z, a.w op b.w}; \\
    } \\
    WITH_NUMBERS(2, op) WITH_NUMBERS(3, op) WITH_NUMBERS(4, op)
OPERATOR(+) OPERATOR(-) OPERATOR(*) OPERATOR(/)
#define float2(...) make_float2(__VA_ARGS__)
#define float3(...) make_float3(__VA_ARGS__)
#define float4(...) make_float4(__VA_ARGS__)
FUNCTION float dot(float2 a, float2 b) { return a.x * b.x + a.y * b.y; }
FUNCTION float dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
FUNCTION float dot(float4 a, float4 b) { return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w; }
FUNCTION float3 normalize(float3 a) { return a * rsqrtf(dot(a, a)); }
FUNCTION float rsqrt(float a) { return rsqrtf(a); }
FUNCTION float clamp(float a, float low, float high) { return min(max(a, low), high); }
FUNCTION float saturate(float a) { return __saturatef(a); }
FUNCTION float mix(float a, float b, float share) { return a + (b - a) * share; }
"""
_TERM = "%s\nfloat fr_priced(vec3 n, vec3 l, vec3 v, float m, float f0) {\n    return %s;\n}\n"
_KERNEL = """
KERNEL kernel_%(prefix)s(const BUFFER float4 *points, BUFFER float *results) {
    int i = INDEX;
    float4 a = points[3 * i], b = points[3 * i + 1], c = points[3 * i + 2];
    float3 n = float3(a.x, a.y, a.z), l = float3(b.x, b.y, b.z), v = float3(c.x, c.y, c.z);
    results[i] = %(prefix)sfr_priced(n, l, v, a.w, b.w);
}
"""
# GLSL permits this arithmetic to drivers: fused operations, denormals as 0, approximate built-ins.
_OCLOC_OPTIONS = "-cl-fast-relaxed-math -cl-denorms-are-zero"
_NVRTC_OPTIONS = ("--use_fast_math", "--std=c++17", "--disable-warnings")

# An instruction in a listing, except waits and padding.
_INTEL_INSTRUCTION = re.compile(r"^ *(?:\([^)]*\) *)?([a-z]\w*)[.\w]* +\(\d+\|M\d+\)", re.MULTILINE)
_NVIDIA_INSTRUCTION = re.compile(r"^ */\*\w{4,}\*/ +(?:@!?\w+ +)?(?!NOP)(\w+)", re.MULTILINE)
_SPECIAL = ("math", "MUFU")


@dataclass(frozen=True)
class Instructions:
    """The instruction counts of a term, minus a kernel that only sums its inputs.

    An instruction processes 16 invocations on Intel GPUs, and 32 on NVIDIA GPUs.

    Attributes
    ----------
    all : machine instructions, except waits and padding
    special : the instructions among them of the unit for roots, reciprocals and transcendentals,
        which is several times as slow as the other units and works in parallel
    """

    all: int
    special: int


def statistics(terms: Mapping[str, tuple[str, str]], gpu: str) -> dict[str, Instructions]:
    """Return the instruction counts of each term on a GPU.

    The kernels read N, L, V, m and F0 from a buffer.

    Parameters
    ----------
    terms : prelude and expression by name; the prelude may include files of the library, the
        expression is a float that depends on vec3 n, l, v and float m, f0
    gpu : one of GPUS

    Raises
    ------
    InputError : the GPU is unknown, or a term cannot be translated or compiled
    NotMeasured : a tool is missing; the message names it and the command that installs it
    """
    if gpu not in GPUS:
        raise InputError(f"unknown GPU {gpu!r}; known: {', '.join(GPUS)}")
    programs = [_program(f"t{i}_", *term) for i, term in enumerate((("", INPUTS), *terms.values()))]
    listings = (_intel if gpu in INTEL else _nvidia)("".join(programs), gpu)
    empty, *gross = (listings[f"kernel_t{i}_"] for i in range(len(programs)))
    return {
        name: Instructions(
            len(found) - len(empty),
            sum(each in _SPECIAL for each in found) - sum(each in _SPECIAL for each in empty),
        )
        for name, found in zip(terms, gross, strict=True)
    }


def compilers() -> list[str]:
    """Return the compilers' names and versions; raises as :func:`statistics`."""
    with TemporaryDirectory() as folder:
        query = "OCL_DRIVER_VERSION"
        subprocess.run([_ocloc(), "query", query], cwd=folder, capture_output=True, check=True)
        intel = Path(folder, query).read_text(encoding="utf-8").strip("\0\n ")
    _wheel("nvidia-cuda-nvrtc", "libnvrtc.so")
    return [f"ocloc {intel}", f"NVRTC {importlib.metadata.version('nvidia-cuda-nvrtc')}"]


def table() -> dict[str, Any]:
    """Return the compilers, and the instruction counts by GPU, model and term; raises as
    :func:`statistics`."""

    def rows(gpu: str, model: str) -> dict[str, dict[str, int]]:
        return {name: asdict(row) for name, row in statistics(cost.terms(model), gpu).items()}

    return {
        "compilers": compilers(),
        "instructions": {gpu: {model: rows(gpu, model) for model in cost.PRINTED} for gpu in GPUS},
    }


def _program(prefix: str, prelude: str, expression: str) -> str:
    """Return the source of a term and its kernel for both compilers; the prefix makes the names of
    several terms unique in one file."""
    text = flat(_TERM % (prelude, expression), "metal").partition("using namespace metal;\n")[2]
    text = re.sub(r"\bfr_", f"{prefix}fr_", text.replace("fast::", ""))
    text = text.replace("static inline __attribute__((always_inline))\n", "FUNCTION ")
    numbers = r"(?<![\w.])(\d+\.\d*(e[-+]?\d+)?|\d+e[-+]?\d+)(?![\w.])"
    return re.sub(numbers, r"\1f", text) + _KERNEL % {"prefix": prefix}


def _intel(program: str, gpu: str) -> dict[str, list[str]]:
    """Compile with Intel's compiler; return the operations of each kernel by its name."""
    environment = {name: value for name, value in os.environ.items() if "IGC_" not in name}
    with TemporaryDirectory() as folder:
        Path(folder, "terms.cl").write_text(_OPENCL + program, encoding="utf-8")
        command = [_ocloc(), "compile", "-file", "terms.cl", "-device", gpu]
        run = subprocess.run(
            [*command, "-options", _OCLOC_OPTIONS],
            cwd=folder,
            env=environment | {"IGC_ShaderDumpEnable": "1", "IGC_DumpToCustomDir": folder},
            capture_output=True,
            text=True,
        )
        if run.returncode:
            raise _not_compiled("ocloc", gpu, run.stdout + run.stderr)
        found = {}
        for path in Path(folder).glob("*.asm"):
            text = path.read_text(encoding="utf-8")
            name = re.search(r"^//\.kernel (\w+)$", text, re.MULTILINE)
            if name:
                found[name[1]] = _INTEL_INSTRUCTION.findall(text)
    return found


def _nvidia(program: str, gpu: str) -> dict[str, list[str]]:
    """Compile with NVIDIA's compiler; return the operations of each kernel by its name."""
    disassembler = _wheel("nvidia-cuda-nvdisasm", "nvdisasm")
    nvrtc = ctypes.CDLL(str(_wheel("nvidia-cuda-nvrtc", "libnvrtc.so")))

    def output(name: str) -> bytes:
        size = ctypes.c_size_t()
        getattr(nvrtc, f"nvrtcGet{name}Size")(handle, ctypes.byref(size))
        text = ctypes.create_string_buffer(size.value)
        getattr(nvrtc, f"nvrtcGet{name}")(handle, text)
        return text.raw

    handle = ctypes.c_void_p()
    source = (_CUDA + program).encode()
    nvrtc.nvrtcCreateProgram(ctypes.byref(handle), source, b"terms.cu", 0, None, None)
    options = [each.encode() for each in (f"--gpu-architecture={gpu}", *_NVRTC_OPTIONS)]
    try:
        if nvrtc.nvrtcCompileProgram(
            handle, len(options), (ctypes.c_char_p * len(options))(*options)
        ):
            raise _not_compiled("NVRTC", gpu, output("ProgramLog").rstrip(b"\0").decode())
        binary = output("CUBIN")
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(handle))
    with TemporaryDirectory() as folder:
        path = Path(folder, "terms.cubin")
        path.write_bytes(binary)
        listing = subprocess.run(
            [disassembler, "-c", path], capture_output=True, text=True, check=True
        ).stdout
    sections = re.split(r"^\.text\.(\w+):$", listing, flags=re.MULTILINE)[1:]
    return {
        name: _NVIDIA_INSTRUCTION.findall(text)
        for name, text in zip(sections[::2], sections[1::2], strict=True)
    }


def _not_compiled(compiler: str, gpu: str, log: str) -> InputError:
    error = next((line for line in log.splitlines() if "error" in line), log)
    return InputError(f"{compiler} does not compile the terms for {gpu}: {error.strip()}")


def _ocloc() -> str:
    """Return the path of Intel's compiler."""
    path = shutil.which("ocloc")
    if path is None:
        raise NotMeasured("ocloc is not installed; on Debian 12: apt-get install intel-opencl-icd")
    return path


def _wheel(package: str, file: str) -> Path:
    """Return the path of the first file of a package whose name begins with ``file``."""
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError:
        raise NotMeasured(
            f"the Python package {package} is not installed: pip install --group compilers"
        ) from None
    return Path(next(each for each in files if each.name.startswith(file)).locate())
