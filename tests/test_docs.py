"""Generated documents are what their generators write."""

from __future__ import annotations

import json

from docs import accuracy, shaders, trade


def test_tables_of_the_lobes_are_current():
    text = accuracy.OUTPUT.read_text(encoding="utf-8")
    assert accuracy.lobe_tables() in text
    assert accuracy.fitted_g_powers() in text


def test_trade_is_what_its_measurement_says():
    data = json.loads(trade.MEASUREMENT.read_text(encoding="utf-8"))
    assert trade.TRADE.read_text(encoding="utf-8") == trade.trade(data)
    assert trade.MARKED.findall(trade.README.read_text(encoding="utf-8")) == [trade.headline(data)]


def test_reference_of_the_shaders_is_what_their_headers_say():
    assert shaders.OUTPUT.read_text(encoding="utf-8") == shaders.reference()
