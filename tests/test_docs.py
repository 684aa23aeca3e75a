"""Generated documents are what their generators write."""

from __future__ import annotations

from docs import accuracy, shaders, trade


def test_tables_of_the_lobes_are_current():
    text = accuracy.OUTPUT.read_text(encoding="utf-8")
    assert accuracy.lobe_tables() in text
    assert accuracy.fitted_g_powers() in text


def test_trade_is_what_its_measurement_says():
    measured = trade.committed()
    assert trade.TRADE.read_text(encoding="utf-8") == trade.trade(measured)
    readme = trade.README.read_text(encoding="utf-8")
    assert trade.MARKED.findall(readme) == [trade.headline(measured)]


def test_reference_of_the_shaders_is_what_their_headers_say():
    assert shaders.OUTPUT.read_text(encoding="utf-8") == shaders.reference()
