# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium with its driver, for the page's tests, pictures and timing."""

import base64
import contextlib
import functools
import http.server
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

FLAGS = (
    *('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run'),
    *('--disable-background-networking', '--disable-component-update', '--disable-sync'),
    *('--disable-background-timer-throttling', '--disable-renderer-backgrounding', '--js-flags=--expose-gc'),
    '--enable-precise-memory-info',
)
WHAT_IS_NEEDED = 'Chromium and its driver are needed: apt install chromium chromium-driver'


def find_browser() -> tuple[str, str] | None:
    """The paths of Chromium and its driver; None if one of them is missing."""
    chromium = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
    driver = shutil.which('chromedriver') or shutil.which('chromium.chromedriver')
    return (chromium, driver) if chromium and driver else None


def open_browser(profile: Path, *flags: str) -> webdriver.Chrome:
    """A browser with an empty page, whose console is logged; its profile is a new folder. SystemExit without one."""
    paths = find_browser()
    if paths is None:
        raise SystemExit(WHAT_IS_NEEDED)
    chromium, driver = paths
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f'--user-data-dir={profile}', *flags):
        options.add_argument(flag)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    return webdriver.Chrome(options=options, service=Service(driver))


def emulate(
    driver: Any, width: int, height: int, ratio: float = 1.0, scheme: str = 'light', phone: bool = False
) -> None:
    """Show the page on a screen of that size, in that colour scheme."""
    screen = {'width': width, 'height': height, 'deviceScaleFactor': ratio, 'mobile': phone}
    driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', screen)
    colours = {'features': [{'name': 'prefers-color-scheme', 'value': scheme}]}
    driver.execute_cdp_cmd('Emulation.setEmulatedMedia', colours)


def picture(driver: Any, file: Path) -> None:
    """What the page shows, without scroll bars, into ``file``."""
    driver.execute_script("document.documentElement.style.scrollbarWidth = 'none'")
    shot = driver.execute_cdp_cmd('Page.captureScreenshot', {})
    file.write_bytes(base64.b64decode(shot['data']))


def heap_bytes(driver: webdriver.Chrome) -> int:
    """JavaScript heap in use, bytes, after its garbage is gone. No frame is drawn between the two."""
    return int(driver.execute_script('gc(); return performance.memory.usedJSHeapSize'))


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextlib.contextmanager
def served(site: Path) -> Iterator[str]:
    """The address at which the files of ``site`` are served meanwhile, as any host of static files does it."""
    server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), functools.partial(_Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f'http://127.0.0.1:{server.server_port}'
    finally:
        server.shutdown()
        server.server_close()
