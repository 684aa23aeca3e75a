"""Settings from texts and tables, as files and options have them."""

from __future__ import annotations

from typing import Any

import facerender as fr
from facerender.values.fields import build


def parse_light(text: str) -> fr.Light:
    return build(fr.Light, text, "lights")


def parse_environment(text: str) -> fr.EnvironmentFile:
    return build(fr.EnvironmentFile, text, "environment")


def scene_value(key: str, value: Any) -> Any:
    """Return the value of a key of a scene file, as a job has it."""
    return getattr(fr.Job.from_dict({key: value}), key)
