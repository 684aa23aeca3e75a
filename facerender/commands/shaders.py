"""``facerender shaders list``, ``path`` and ``flatten``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import textwrap

from facerender.commands.options import add_options
from facerender.commands.output import print_result
from facerender.glsl.library import LANGUAGES, TARGETS, shader_dir, shader_source
from facerender.terms.lobe import LOBES, SLOPES


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
    | 330 is OpenGL 3.3, es300 OpenGL ES 3.0 and WebGL 2, vulkan GLSL 450, msl Metal
--lobe | the only lobe in the result | the lobe that FR_LOBE selects
--m M | RMS slope of the microfacets, as a constant | a parameter
-I DIR | folder of files that your file includes; repeatable | none
"""


def run_list(options: argparse.Namespace) -> int:
    from facerender.glsl.library import functions

    if options.json:
        listed = [dataclasses.asdict(function) for function in functions()]
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
