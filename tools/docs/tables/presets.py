"""The table of presets and known names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facerender.loading.conventions import WHOLE_NAMES, WORDS
from facerender.material import COMMON, PRESETS


def blocks() -> dict[str, str]:
    known = {name: f"{WHOLE_NAMES.get(name, '')} {WORDS.get(name, '')}".split() for name in PRESETS}
    rows = [
        f"| `{name}` | {_values(own)} | {', '.join(f'`{each}`' for each in known[name])} |"
        for name, own in PRESETS.items()
    ]
    head = ["| preset | values | known names |", "|---|---|---|"]
    return {"table": "\n".join([*head, *rows])}


def _values(preset: Mapping[str, Any]) -> str:
    own = {key: value for key, value in preset.items() if COMMON.get(key) != value}
    return "; ".join(f"{key} {_text(value)}" for key, value in own.items())


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
