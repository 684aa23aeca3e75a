"""The table of supported glTF extensions."""

from __future__ import annotations

from facerender.loading.gltf_document import EXTENSIONS


def blocks() -> dict[str, str]:
    rows = [f"| {name} | {row.replace(': ', ' | ', 1)} |" for name, row in EXTENSIONS.items()]
    return {"gltf": "\n".join(["| extension | support | details |", "|---|---|---|", *rows])}
