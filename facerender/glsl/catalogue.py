"""What the functions of the shader library are, read from the comments of its files: a header for
each file, and a comment over a function that is not the file's only one. The grammar is small: a
first sentence, then lines ``//   key   text`` that go on where they are indented further."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from facerender.glsl.library import library, shader_dir

_FUNCTION = re.compile(r"((?:^//.*\n)*)^(\w+) (fr_\w+)\(([^)]*)\) \{", re.MULTILINE)
_KEYED = re.compile(r"^   (\w+(?:, \w+)*) +(\S.*(?:\n {5,}\S.*)*)", re.MULTILINE)


@dataclass(frozen=True)
class Function:
    """A public function of the library.

    Attributes
    ----------
    name, signature, file : file as an include line names it
    summary : one line
    parameters : name to meaning, unit and domain
    formula, unit, result, error, source : as the comments say; result is "" where they say nothing
    """

    name: str
    signature: str
    file: str
    summary: str
    parameters: dict[str, str]
    formula: str
    unit: str
    result: str
    error: str
    source: str


@cache
def functions() -> tuple[Function, ...]:
    """Return every public function of the library, by file, in the files' order."""
    return tuple(function for name in library() for function in _functions(name))


def _functions(name: str) -> list[Function]:
    file = f"facerender/{name}.glsl"
    text = (shader_dir() / file).read_text(encoding="utf-8")
    header = _comment(text[: text.index("#ifndef")])
    result = []
    for comment, kind, function, parameters in _FUNCTION.findall(text):
        own = _comment(comment)
        known = _keyed(header) | _keyed(own)
        parameters = " ".join(parameters.split())
        names = [parameter.split()[1] for parameter in parameters.split(", ")]
        result.append(
            Function(
                function,
                f"{kind} {function}({parameters})",
                file,
                _sentence(own or header),
                {name: known[name] for name in names},
                known["formula"],
                known["unit"],
                known.get("result", ""),
                known["error"],
                known["source"],
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


def _sentence(comment: str) -> str:
    """Return the first sentence."""
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(comment.split("\n\n")[0].split()))[0]
