"""``facerender shaders list``, ``path``, ``flatten`` and ``prepare-normal-map``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import textwrap

from facerender.commands.common import check_outputs
from facerender.commands.streams import print_result
from facerender.glsl.library import LANGUAGES, TARGETS, shader_dir, shader_source
from facerender.terms import LOBES


def add(shaders: argparse.ArgumentParser) -> None:
    actions = shaders.add_subparsers(required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="every function: signature, unit, error")
    listing.add_argument("--json", action="store_true", help="all that the headers say, as JSON")
    listing.set_defaults(command=run_list)
    path = actions.add_parser("path", help="the include root")
    path.set_defaults(command=run_path)
    flatten = actions.add_parser("flatten", help="one file, with all that it includes")
    flatten.add_argument(
        "name",
        metavar="NAME",
        help="cook_torrance, lobe/exact, ...; a function; or a GLSL file of your own",
    )
    flatten.add_argument(
        "--target",
        choices=(*TARGETS, *LANGUAGES),
        help="begin with this #version, or another language; without it: GLSL to include",
    )
    flatten.add_argument("--lobe", choices=tuple(LOBES), help="leave the others out")
    flatten.add_argument("--m", type=float, help="rms slope, as a constant")
    flatten.set_defaults(command=run_flatten)
    prepare = actions.add_parser(
        "prepare-normal-map", help="a normal map with the mip levels that slope_variance.glsl reads"
    )
    prepare.add_argument("source", metavar="IN", help="an image: .png .jpg .tif .webp")
    prepare.add_argument("output", metavar="OUT", help=".ktx2")
    prepare.set_defaults(command=run_prepare_normal_map)


def run_list(options: argparse.Namespace) -> int:
    from facerender.glsl.catalogue import functions

    if options.json:
        print_result(
            json.dumps([dataclasses.asdict(function) for function in functions()], indent=2)
        )
        return 0
    for function in functions():
        print_result(f"{function.signature}    {function.file}")
        print_result(f"    {function.summary}")
        for name, text in (("unit", function.unit), ("error", function.error)):
            lines = textwrap.wrap(text, 86, break_on_hyphens=False)
            print_result(f"    {name:6}" + f"\n{'':10}".join(lines))
    return 0


def run_path(options: argparse.Namespace) -> int:
    print_result(shader_dir())
    return 0


def run_flatten(options: argparse.Namespace) -> int:
    print_result(
        shader_source(options.name, options.target, lobe=options.lobe, m=options.m), end=""
    )
    return 0


def run_prepare_normal_map(options: argparse.Namespace) -> int:
    from facerender.scenes.prepared import prepare_normal_map

    check_outputs([options.output], [options.source])
    prepare_normal_map(options.source, options.output)
    print_result(options.output)
    return 0
