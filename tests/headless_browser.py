"""A real browser without a display, which reaches no host, for the tests of pages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

INSTALL_COMMAND = "apt-get install --no-install-recommends chromium"
BROWSER_REQUIRED_VARIABLE = "SPRINGBENCH_NEEDS_BROWSER"
"""Where this is set, a browser that is missing is a failure: CI sets it where it may install one."""

_BROWSER_NAMES = ("chromium", "chromium-browser", "google-chrome")
_BROWSER_ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)


@contextmanager
def launch_chromium() -> Iterator[Any]:
    """Playwright's handle of an installed Chromium; without one the test is skipped, and says how to get it."""
    binary = next(filter(None, map(shutil.which, _BROWSER_NAMES)), None)
    if binary is None:
        (pytest.fail if os.environ.get(BROWSER_REQUIRED_VARIABLE) else pytest.skip)(
            f"there is no Chromium: {INSTALL_COMMAND}"
        )
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=binary, args=_BROWSER_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()
