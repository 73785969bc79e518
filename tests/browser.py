"""A real browser without a display, which reaches no host, for the tests of pages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

INSTALL = "apt-get install --no-install-recommends chromium"
NEEDED = "SPRINGBENCH_NEEDS_BROWSER"
"""Where this is set, a browser that is missing is a failure: CI sets it where it may install one."""

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)


@contextmanager
def chromium() -> Iterator[Any]:
    """Playwright's handle of an installed Chromium; without one the test is skipped, and says how to get it."""
    binary = next(filter(None, map(shutil.which, _NAMES)), None)
    if binary is None:
        (pytest.fail if os.environ.get(NEEDED) else pytest.skip)(f"there is no Chromium: {INSTALL}")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=binary, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()
