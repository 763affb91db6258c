"""Chromium for tests, with WebGL in software."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")  # which GitHub's machines have
MISSING = "Chromium is not installed (apt-get install chromium)"
SWIFTSHADER = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@contextmanager
def started_chromium() -> Iterator[Any]:
    """Start Chromium, and close it in the end."""
    from playwright.sync_api import sync_playwright

    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=[*SWIFTSHADER, *root])
        yield browser
        browser.close()
