"""The table of supported glTF features."""

from __future__ import annotations

from facerender.loading.gltf_document import FEATURES


def blocks() -> dict[str, str]:
    rows = [f"| {each.name} | {each.fate} | {each.how} |" for each in FEATURES]
    return {"gltf": "\n".join(["| glTF | support | details |", "|---|---|---|", *rows])}
