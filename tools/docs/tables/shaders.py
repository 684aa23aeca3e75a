"""The reference of the GLSL library, from the headers of its files."""

from __future__ import annotations

from itertools import groupby

from facerender.commands.shaders import Function, functions
from facerender.terms.lobe import LOBES
from facerender.terms.model import FRESNEL, MASKING
from tools.docs.tables import markdown_table


def blocks() -> dict[str, str]:
    return {
        "lobes": _macros([entry.macro for entry in LOBES.values()]),
        "fresnel": _macros([entry.macro for entry in FRESNEL.values()]),
        "masking": _macros([entry.macro for entry in MASKING.values()]),
        "functions": "\n".join(map(section, functions())).rstrip("\n"),
    }


def _macros(macros: list[str]) -> str:
    """Return the first macro as it is, of the others what follows the common prefix."""
    prefix = "_".join(macros[0].split("_")[:2])
    return ", ".join([macros[0], *(macro.removeprefix(prefix) for macro in macros[1:])])


def section(function: Function) -> str:
    """Return the entry of one function."""
    parameters = groupby(function.parameters.items(), lambda item: item[1])
    rows = [
        ["formula", f"`{function.formula}`"],
        *([", ".join(f"`{name}`" for name, _ in names), text] for text, names in parameters),
        ["unit", function.unit],
        *([["returns", function.result]] if function.result else []),
        ["error", function.error],
        ["source", function.source],
        ["file", f"[{function.file}](../shaders/{function.file})"],
    ]
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    signature = f"```glsl\n{function.signature}\n```"
    table = markdown_table(["", ""], escaped)
    return f"## {function.name}\n\n{signature}\n\n{function.summary}\n\n{table}\n"
