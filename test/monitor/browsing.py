"""Headless Chromium, driven by its own driver; and the programs whose pages it looks at."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait

from test.heard import WAIT_S, Heard

ROOT = Path(__file__).parent.parent.parent
FLAGS = (
    '--headless',
    '--no-sandbox',
    '--disable-gpu',
    '--disable-quic',
    '--no-first-run',
    '--disable-background-networking',
    '--disable-component-update',
    '--disable-sync',
    # A page that nobody looks at is drawn all the same.
    '--disable-background-timer-throttling',
    '--disable-renderer-backgrounding',
    '--js-flags=--expose-gc',
)


def find_browser() -> tuple[str, str]:
    """Chromium and its driver; skips where they are not there, fails where NEED_BROWSER says they must be."""
    chromium = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
    driver = shutil.which('chromedriver') or shutil.which('chromium.chromedriver')
    if chromium is None or driver is None:
        missing = 'chromium and its driver are needed: apt install chromium chromium-driver'
        if os.environ.get('NEED_BROWSER'):
            pytest.fail(missing)
        pytest.skip(missing)
    return chromium, driver


class Page:
    """One browser window. What a test waits for is a JavaScript expression that becomes true."""

    def __init__(self, profile: Path) -> None:
        chromium, driver = find_browser()
        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        for flag in (*FLAGS, f'--user-data-dir={profile}', '--window-size=1440,900'):
            options.add_argument(flag)
        options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
        self.driver = webdriver.Chrome(options=options, service=Service(driver))

    def open(self, url: str) -> None:
        self.driver.get_log('browser')  # type: ignore[no-untyped-call]
        self.driver.get(url)

    def js(self, expression: str, *arguments: Any) -> Any:
        return self.driver.execute_script(f'return {expression}', *arguments)

    def later(self, expression: str) -> Any:
        """What a promise brings."""
        script = f'const done = arguments[0]; ({expression}).then(done, (e) => done(`failed: ${{e}}`))'
        self.driver.set_script_timeout(WAIT_S)
        return self.driver.execute_async_script(script)

    def until(self, expression: str, what: str = '') -> Any:
        wait = WebDriverWait(self.driver, WAIT_S, poll_frequency=0.05)
        return wait.until(lambda _: self.js(expression), f'{what or expression}; {self.state()}')

    def state(self) -> str:
        return str(self.js('JSON.stringify([document.body.dataset, document.getElementById("state")?.textContent])'))

    def live(self) -> None:
        self.until('document.body.dataset.state === "live"')

    def rows(self) -> int:
        return int(self.js('document.body.dataset.rows ?? 0'))

    def complaints(self) -> list[str]:
        """What the page told the console, but for the connections that the test cut itself."""
        log = self.driver.get_log('browser')  # type: ignore[no-untyped-call]
        return [e['message'] for e in log if 'WebSocket connection' not in e['message']]

    def heap_bytes(self) -> int:
        """JavaScript heap in use after the garbage is gone."""
        for _ in range(2):
            self.driver.execute_cdp_cmd('HeapProfiler.collectGarbage', {})
        return int(self.driver.execute_cdp_cmd('Runtime.getHeapUsage', {})['usedSize'])

    def nodes(self) -> int:
        return int(self.js('document.querySelectorAll("*").length'))

    def close(self) -> None:
        self.driver.quit()


class Program:
    """``psd-deflection ...`` as a process; what it says, line by line."""

    def __init__(self, arguments: Sequence[str], cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'psd_deflection', *arguments],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env={**os.environ, 'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1', 'XDG_STATE_HOME': str(cwd)},
        )
        assert self.process.stdout is not None
        self._heard = Heard(self.process.stdout)

    def said(self, pattern: str) -> str:
        """Group 1 of the first line that matches."""
        return str(self._heard.until(pattern)[1])

    def url(self) -> str:
        return self.said(r'monitor: (http://\S+)')

    def end(self) -> int:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
        status = self.process.wait(WAIT_S)
        self._heard.close()
        return status


Start = Callable[..., Program]
