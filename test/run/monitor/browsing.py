# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium, driven by its own driver."""

import os
from pathlib import Path
from typing import Any

import pytest
from selenium.webdriver.support.ui import WebDriverWait

from test.heard import WAIT_S
from tools.browser import WHAT_IS_NEEDED, find_browser, heap_bytes, open_browser


def require_browser() -> None:
    """Skip the tests without Chromium and its driver; fail them if NEED_BROWSER says that they must be there."""
    if find_browser() is None:
        if os.environ.get('NEED_BROWSER'):
            pytest.fail(WHAT_IS_NEEDED)
        pytest.skip(WHAT_IS_NEEDED)


class Page:
    """One browser window. What a test waits for is a JavaScript expression that becomes true."""

    def __init__(self, profile: Path) -> None:
        require_browser()
        self.driver = open_browser(profile, '--window-size=1440,900')

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

    def quietly_until_rows(self, count: int) -> None:
        """Wait for that many rows without running a script in the page.

        What the driver compiles and answers counts in the page's heap, 20 kB a question in some versions of Chromium.
        """
        document = self.driver.execute_cdp_cmd('DOM.getDocument', {'depth': 2})['root']
        html = next(node for node in document['children'] if node['nodeName'] == 'HTML')
        body = next(node for node in html['children'] if node['nodeName'] == 'BODY')['nodeId']

        def observed(_: object) -> bool:
            words = self.driver.execute_cdp_cmd('DOM.getAttributes', {'nodeId': body})['attributes']
            return int(dict(zip(words[::2], words[1::2], strict=True)).get('data-rows', 0)) >= count

        WebDriverWait(self.driver, WAIT_S, poll_frequency=0.02).until(observed, f'{count} rows on the page')

    def complaints(self) -> list[str]:
        """What the page told the console, but for the connections that the test cut itself."""
        log = self.driver.get_log('browser')  # type: ignore[no-untyped-call]
        return [e['message'] for e in log if 'WebSocket connection' not in e['message']]

    def heap_bytes(self) -> int:
        """JavaScript heap in use after the garbage is gone."""
        return heap_bytes(self.driver)

    def nodes(self) -> int:
        return int(self.js('document.querySelectorAll("*").length'))

    def close(self) -> None:
        self.driver.quit()
