"""GLSL sources: where they are, and their includes resolved into flat text. No OpenGL here."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from facerender.errors import InputError

_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]+["<]([^">]+)[">][^\n]*$', re.MULTILINE)


def data_dir(name: str) -> Path:
    """Return the folder ``name`` of the package's data: in the wheel, or in the checkout."""
    installed = Path(__file__).parent / name
    return installed if installed.is_dir() else Path(__file__).parents[1] / name


def shader_dir() -> Path:
    """Return the include root: a host adds it to its include path and writes
    ``#include "facerender/cook_torrance.glsl"``."""
    return data_dir("shaders")


def shader_source(name: str) -> str:
    """Return one file of the shader library with its includes resolved.

    Parameters
    ----------
    name : a path below :func:`shader_dir`, or the name of a file of the library without suffix,
        such as "cook_torrance" or "lobe/exact"

    Raises
    ------
    InputError : there is no such file
    """
    path = name if name.endswith((".glsl", ".vert", ".frag")) else f"facerender/{name}.glsl"
    return resolve_includes(f'#include "{path}"\n')


def resolve_includes(text: str) -> str:
    """Replace every ``#include`` in text by the file's content, as often as it stands there: the
    files' own guards keep the compiler from reading one twice, also within ``#if``."""
    return _INCLUDE.sub(lambda match: resolve_includes(_read(match[1])).rstrip("\n"), text)


@cache
def _read(path: str) -> str:
    try:
        return (shader_dir() / path).read_text(encoding="utf-8")
    except OSError:
        raise InputError(f"no shader file {path} in {shader_dir()}") from None
