"""The reference of the command line, from the parsers of the commands."""

from __future__ import annotations

import re
from argparse import Action, ArgumentParser
from collections.abc import Iterator

from facerender.commands import COMMANDS, parser_of
from facerender.commands.output import EXAMPLES, Help, commands_of, groups_of, usage_of
from tools.docs.tables import markdown_table

HEAD = ("option", "value", "effect", "unit", "range", "default")
_UNTITLED = ("positional arguments", "options", "actions")


def blocks() -> dict[str, str]:
    parser = parser_of([*COMMANDS])
    return {name: section(name, each) for name, each in commands_of(parser).items()}


def section(name: str, parser: ArgumentParser) -> str:
    """Return description, usage, options and examples of a command, then its subcommands."""
    paragraphs = [
        _escaped(" ".join((parser.description or "").split())),
        _code(usage_of(parser)),
        *_tables(parser),
        "Examples:",
        _code(*EXAMPLES[name]),
    ]
    for action, each in commands_of(parser).items():
        paragraphs += [f"### facerender {name} {action}", section(f"{name} {action}", each)]
    return "\n\n".join(paragraphs)


def _tables(parser: ArgumentParser) -> Iterator[str]:
    """Yield a table for the options without a title, then title and table of each group."""
    first: list[list[str]] = []
    others: list[str] = []
    for title, actions in groups_of(parser):
        rows = [_row(each) for each in actions if isinstance(each.help, Help)]
        if title in _UNTITLED:
            first += rows
        else:
            others += [f"**{_escaped(title)}**", markdown_table(HEAD, rows)]
    if first:
        yield markdown_table(HEAD, first)
    yield from others


def _row(action: Action) -> list[str]:
    text = action.help
    assert isinstance(text, Help)
    metavar = str(action.metavar or "")
    choices = ", ".join(f"`{each}`" for each in action.choices or ())
    names = ", ".join(f"`{each}`" for each in action.option_strings)
    effect = f"{text.text}. {text.note}." if text.note else text.text
    value = "" if action.choices or action.nargs == 0 else metavar or action.dest.upper()
    cells = [
        names or f"`{metavar or action.dest}`",
        f"`{value}`" if names and value else "",
        *map(_escaped, (effect, text.unit)),
        choices or _escaped(text.values),
        _escaped(text.default),
    ]
    return [cell.replace("|", "\\|") for cell in cells]


def _escaped(text: str) -> str:
    """Return a text as Markdown: without emphasis, options as code."""
    return re.sub(r"--[a-z][a-z-]*", r"`\g<0>`", text.replace("*", "\\*"))


def _code(*lines: str) -> str:
    return "\n".join(["```", *lines, "```"])
