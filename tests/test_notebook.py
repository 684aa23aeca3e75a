"""The notebook of the examples, executed, shows its pictures."""

from __future__ import annotations

import os
import sys
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image

from tests.conftest import require_module

NOTEBOOK = Path(__file__).parents[1] / "examples" / "notebook.ipynb"


def test_a_frame_shows_itself_in_a_notebook(egl: str, monkeypatch: pytest.MonkeyPatch):
    nbclient, nbformat = require_module("nbclient"), require_module("nbformat")
    require_module("ipykernel")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # of the kernel
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    frame, short = (
        next(cell for cell in notebook.cells if cell.id == name).outputs
        for name in ("frame", "turntable")
    )
    (shown,) = (each for each in frame if each.output_type == "execute_result")
    picture = Image.open(BytesIO(b64decode(shown.data["image/png"])))
    assert picture.size == (320, 320)
    assert shown.data["text/plain"] == "<Frame 320 x 320>"
    (listed,) = (each for each in short if each.output_type == "execute_result")
    assert listed.data["text/plain"].count("<Frame 320 x 320>") == 4
