"""The table of supported glTF extensions."""

from __future__ import annotations

from facerender.loading.gltf_document import EXTENSIONS


def blocks() -> dict[str, str]:
    rows = [f"| {each.name} | {each.fate} | {each.how} |" for each in EXTENSIONS.values()]
    return {"gltf": "\n".join(["| extension | support | details |", "|---|---|---|", *rows])}
