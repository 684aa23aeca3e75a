"""Starts headless Chromium with WebGL 2 on SwiftShader."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Playwright

_FLAGS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-angle=swiftshader "
    "--enable-unsafe-swiftshader"
)


def launch(playwright: Playwright) -> Browser:
    """Start the system's Chromium or, if there is none, playwright's Chromium."""
    return playwright.chromium.launch(executable_path=shutil.which("chromium"), args=_FLAGS.split())
