"""The catalogue of the shader library's functions, parsed from the comments in the GLSL files.

Each file has a header comment, and a function may have a comment above it. A comment begins with a
sentence; lines ``//   key: text`` follow. Deeper indented lines continue the text of a key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from facerender.glsl.library import library, shader_dir

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
    return tuple(function for name in library() for function in _functions(name))


def _functions(name: str) -> list[Function]:
    file = f"facerender/{name}.glsl"
    text = (shader_dir() / file).read_text(encoding="utf-8")
    header = _comment(text[: text.index("#ifndef")])
    result = []
    for comment, kind, function, parameters in _FUNCTION.findall(text):
        description = _comment(comment)
        texts = _keyed(header) | _keyed(description)
        paragraph = (description or header).split("\n\n")[0]
        parameters = " ".join(parameters.split())
        names = [parameter.split()[1] for parameter in parameters.split(", ")]
        result.append(
            Function(
                function,
                f"{kind} {function}({parameters})",
                file,
                re.split(r"(?<=\.) (?=[A-Z])", " ".join(paragraph.split()))[0],
                {name: texts[name] for name in names},
                texts["formula"],
                texts["unit"],
                texts.get("returns", ""),
                texts["error"],
                texts["source"],
            )
        )
    return result


def _comment(lines: str) -> str:
    return re.sub(r"^//", "", lines, flags=re.MULTILINE)


def _keyed(comment: str) -> dict[str, str]:
    return {
        key: " ".join(text.split())
        for keys, text in _KEYED.findall(comment)
        for key in keys.split(", ")
    }
