"""``facerender shaders list``, ``path`` and ``flatten``; the catalogue of shader functions."""

from __future__ import annotations

import argparse
import json
import re
import textwrap
from dataclasses import asdict, dataclass
from functools import cache

from facerender.commands.options import add_options
from facerender.commands.output import print_result
from facerender.glsl.library import LANGUAGES, TARGETS, library, shader_dir, shader_source
from facerender.terms.lobe import LOBES, SLOPES

# The catalogue of functions is parsed from the comments that a reader of the GLSL files has. Each
# file has a header comment, and a function may have a comment above it. A comment begins with a
# sentence; lines "//   key: text" follow. Deeper indented lines continue the text of a key.
_FUNCTION = re.compile(r"((?:^//.*\n)*)^(\w+) (fr_\w+)\(([^)]*)\) \{", re.MULTILINE)
_KEYED = re.compile(r"^   (\w+(?:, \w+)*): +(\S.*(?:\n {5,}\S.*)*)", re.MULTILINE)


@dataclass(frozen=True)
class Function:
    """A public function of the library, with the texts of its comments."""

    name: str  # such as "fr_ward"
    signature: str  # GLSL declaration
    file: str  # path in an include line
    summary: str  # first sentence of the comment
    parameters: dict[str, str]  # meaning, unit and domain, keyed by the parameter name
    formula: str
    unit: str
    result: str  # text of the key "returns"; "" if the comment lacks this key
    error: str
    source: str


@cache
def functions() -> tuple[Function, ...]:
    """Return all public functions of the library, in alphabetical order of the files."""
    result = []
    for file in (f"facerender/{name}.glsl" for name in library()):
        text = (shader_dir() / file).read_text(encoding="utf-8")
        header = _texts(text[: text.index("#ifndef")])
        for comment, return_type, name, parameters in _FUNCTION.findall(text):
            texts = header | _texts(comment)
            parameters = " ".join(parameters.split())
            function = Function(
                name,
                signature=f"{return_type} {name}({parameters})",
                file=file,
                parameters={key: texts[key] for key in re.findall(r"(\w+)(?:,|$)", parameters)},
                result=texts.get("returns", ""),
                **{key: texts[key] for key in ("summary", "formula", "unit", "error", "source")},
            )
            result.append(function)
    return tuple(result)


def _texts(comment: str) -> dict[str, str]:
    """Return the texts of a comment by key; "summary" is the key of the first sentence."""
    comment = re.sub(r"^//", "", comment, flags=re.MULTILINE)
    sentence = re.findall(r"\A\s.+?\.(?=\s+[A-Z]|\n\n|\s*\Z)", comment, re.DOTALL)
    texts = [("summary", text) for text in sentence]
    return {
        key: " ".join(text.split())
        for keys, text in [*texts, *_KEYED.findall(comment)]
        for key in keys.split(", ")
    }


def add(shaders: argparse.ArgumentParser) -> None:
    shaders.description = (
        "Use the GLSL library in another program: list its functions, print its include\n"
        "directory, or flatten a shader into one file."
    )
    actions = shaders.add_subparsers(title="actions", required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="list every function with its unit and error")
    listing.description = (
        "List every public function of the GLSL library: signature, file, summary, unit\nand error."
    )
    add_options(listing, "--json | print all values of the shader headers as JSON")
    listing.set_defaults(command=run_list)
    path = actions.add_parser("path", help="print the include directory")
    path.description = (
        "Print the include directory of the GLSL library, in which a program finds\n"
        "facerender/cook_torrance.glsl and the other files."
    )
    path.set_defaults(command=run_path)
    flatten = actions.add_parser("flatten", help="print a shader without includes")
    flatten.description = (
        "Print a shader as one file, which contains each included file once. With --lobe,\n"
        "the code of all other lobes is removed. Other functions that you do not call\n"
        "remain. With --m, all coefficients of the lobe are constants. To combine several\n"
        "library files or to set macros such as FR_MASKING, flatten a file of your own."
    )
    add_options(
        flatten,
        _FLATTEN,
        target={"choices": (*TARGETS, *LANGUAGES)},
        lobe={"choices": tuple(LOBES)},
        m={"limits": SLOPES},
        I={"dest": "paths", "action": "append", "default": []},
    )
    flatten.set_defaults(command=run_flatten)


_FLATTEN = """
NAME | library file, such as cook_torrance or lobe/exact; library function; or your GLSL file; -
    reads standard input | required
--target | #version line or language of the result | GLSL to include, without #version
    | 330 is OpenGL 3.3, es300 OpenGL ES 3.0 and WebGL 2, vulkan GLSL 450
--lobe | the only lobe in the result | the lobe that FR_LOBE selects
--m M | RMS slope of the microfacets, as a constant | a parameter
-I DIR | folder of files that your file includes; repeatable | none
"""


def run_list(options: argparse.Namespace) -> int:
    if options.json:
        listed = [asdict(function) for function in functions()]
        print_result(json.dumps(listed, indent=2))
        return 0
    for function in functions():
        print_result(f"{function.signature}    {function.file}", f"    {function.summary}")
        for name, text in (("unit", function.unit), ("error", function.error)):
            lines = textwrap.wrap(text, 86, break_on_hyphens=False)
            print_result(f"    {name:6}" + f"\n{'':10}".join(lines))
    return 0


def run_path(options: argparse.Namespace) -> int:
    print_result(shader_dir())
    return 0


def run_flatten(options: argparse.Namespace) -> int:
    choices = {"lobe": options.lobe, "m": options.m, "paths": options.paths}
    print_result(shader_source(options.name, options.target, **choices), end="")
    return 0
