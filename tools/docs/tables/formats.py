"""The table of supported glTF extensions."""

from __future__ import annotations

from facerender.loading.gltf_document import EXTENSIONS


def blocks() -> dict[str, str]:
    rows = [f"| {name} | {fate} | {how} |" for name, (fate, how) in EXTENSIONS.items()]
    return {"gltf": "\n".join(["| extension | support | details |", "|---|---|---|", *rows])}
