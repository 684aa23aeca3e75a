"""Generated documents are what their generators write."""

from __future__ import annotations

from docs import accuracy


def test_tables_of_the_lobes_are_current():
    assert accuracy.lobe_tables() in accuracy.OUTPUT.read_text(encoding="utf-8")
