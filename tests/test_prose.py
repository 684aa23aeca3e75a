"""The texts of the project avoid the most frequent faults of language; see CONTRIBUTING.md."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.markdown import prose
from tools.docs.blocks import by_hand

ROOT = Path(__file__).parents[1]
MARKDOWN = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")})
PYTHON = sorted(ROOT.glob("facerender/**/*.py"))
SHADERS = sorted(each for each in ROOT.glob("shaders/**/*") if each.is_file())
GUIDE = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]

FAULTS = {
    "a clause in place of a noun": r"^(What|That which|Those|Whatever|Whichever|Whoever)\b[^?]*$",
    "'what' in place of a noun": r"\b(of|by|from|with|than|to|as|for|has|takes?|gives?) what\b",
    "a program does not speak": r"\b(tells?|told|says|hears?|heard|speaks?)\b",
    "'those' in place of a noun": r"\b(those (of|that|which|who|in|with)|that which)\b",
    "name the place": r"\bbesides?\b",
    "'repaired'": r"\bmend(s|ed|ing)?\b",
    "'camera'": r"\beyes? (sees?|looks?)\b|\bthe eye's side\b",
    "'environment map', 'ambient light'": r"\blight from (everywhere|all around)\b",
    "'tested against'": r"\bheld against\b",
    "'cache'": r"\bwhat is kept\b",
    "'N'": r"\bso many\b",
}
SENTENCE = re.compile(r"(?<=[.;:?!])\s+(?=[A-Z`[])|\n\s*\n|\n\s*[-*|]\s")
# Variables have the name of the thing.
VAGUE = {"each", "found", "given", "wanted", "whole"}
MESSAGES = {"InputError", "ContextError", "CannotDraw", "warn"}
MESSAGES |= {"Help", "add_argument", "add_field", "add_flag", "add_number", "add_option"}
MESSAGES |= {"add_switch"}


def sentences(text: str) -> Iterator[str]:
    for each in SENTENCE.split(text):
        words = " ".join(re.sub(r"`[^`]*`|\[([^\]]*)\]\([^)]*\)", r"\1 ", each).split())
        if words:
            yield words


def markdown_text(path: Path) -> str:
    return by_hand(prose(path.read_text(encoding="utf-8")))


def python_text(source: str) -> str:
    """Return docstrings, comments and messages, each as a paragraph."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            found.append(ast.get_docstring(node) or "")
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            texts = (each for each in ast.walk(node) if isinstance(each, ast.Constant))
            found += [e.value for e in texts if name in MESSAGES and isinstance(e.value, str)]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = [each.string.lstrip("# ") for each in tokens if each.type == tokenize.COMMENT]
    return "\n\n".join([*found, " ".join(comments)])


def shader_text(source: str) -> str:
    return " ".join(line.split("//", 1)[1].strip() for line in source.splitlines() if "//" in line)


def faults(text: str) -> list[str]:
    return [
        f"{reason}: {sentence}"
        for sentence in sentences(text)
        for reason, pattern in FAULTS.items()
        if re.search(pattern, sentence)
    ]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MARKDOWN, ids=name)
def test_documents(path):
    assert faults(markdown_text(path)) == []


def test_python():
    texts = {name(path): faults(python_text(path.read_text("utf-8"))) for path in PYTHON}
    assert {path: found for path, found in texts.items() if found} == {}


@pytest.mark.parametrize("path", PYTHON, ids=name)
def test_variables_have_nouns_as_names(path):
    nodes = ast.walk(ast.parse(path.read_text("utf-8")))
    names = {
        each.id for each in nodes if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
    }
    assert names & VAGUE == set()


def test_shaders():
    texts = {name(path): faults(shader_text(path.read_text("utf-8"))) for path in SHADERS}
    assert {path: found for path, found in texts.items() if found} == {}


@pytest.mark.parametrize("path", GUIDE, ids=name)
def test_no_sentence_of_the_guide_is_long(path):
    text = re.sub(r"^\|.*$|^#.*$", "\n\n", markdown_text(path), flags=re.MULTILINE)
    assert [each for each in sentences(text) if len(each.split()) > 30] == []


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("What a material gets whose m leaves the domain.", 1),
        ("The program tells how long it took.", 1),
        ("Return the half vector.\n\nWhat it holds.", 1),
        ("What does it cost? The command measures it.", 0),
        ("Return the cosine of the angle between `what is kept` and the normal.", 0),
    ],
)
def test_faults_are_found(text, count):
    assert len(faults(text)) == count
