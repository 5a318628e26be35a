"""Makes the pictures of the live page in docs/figures: ``make shots``; needs Chromium and its driver.

The page shows the simulated rig; the pictures are taken after all load cases, with 50 N on the sidebar.
"""

from __future__ import annotations

import argparse
import base64
import re
import sys
import tempfile
from pathlib import Path

from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import open_browser
from tools.program import PSD_DEFLECTION, WAIT_S, Program

FIGURES = Path(__file__).resolve().parents[1] / 'docs' / 'figures'
SHOTS = (('monitor', 1440, 900, 1.0, 'light', False),)
THETA = 'return document.getElementById("theta").textContent'
LOADED = r'\u22129[34]\d\.\d+'
"""The twist in mdeg when 50 N hang on the sidebar, which they do every ``LOAD_PERIOD_S``."""
LOAD_PERIOD_S = 36.0
BLOCKS_PER_S = 50.0
PHONE = ('monitor_phone', 390, 844, 2.0, 'light', True)


def take(
    url: str, name: str, width: int, height: int, ratio: float, scheme: str, mobile: bool, seconds: float, loaded: bool
) -> None:
    """One picture."""
    driver = open_browser(Path(tempfile.mkdtemp()))
    try:
        driver.execute_cdp_cmd(
            'Emulation.setDeviceMetricsOverride',
            {'width': width, 'height': height, 'deviceScaleFactor': ratio, 'mobile': mobile},
        )
        driver.execute_cdp_cmd(
            'Emulation.setEmulatedMedia', {'features': [{'name': 'prefers-color-scheme', 'value': scheme}]}
        )
        driver.get(url)
        driver.execute_script("document.documentElement.style.scrollbarWidth = 'none'")
        wait = WebDriverWait(driver, seconds + LOAD_PERIOD_S + WAIT_S, poll_frequency=0.2)
        wait.until(lambda d: int(d.execute_script('return document.body.dataset.rows ?? 0')) >= BLOCKS_PER_S * seconds)
        if loaded:
            wait.until(lambda d: re.fullmatch(LOADED, d.execute_script(THETA)), 'no 50 N on the sidebar')
        shot = driver.execute_cdp_cmd('Page.captureScreenshot', {})
        (FIGURES / f'{name}.png').write_bytes(base64.b64decode(shot['data']))
    finally:
        driver.quit()


def main() -> int:
    """Start the rig, take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=40.0, help='before the first picture')
    seconds = parser.parse_args().seconds
    program = Program([*PSD_DEFLECTION, 'monitor', '--http-port', '0'])
    try:
        url = program.until(r'monitor: (http\S+)')[1]
        for i, shot in enumerate((*SHOTS, PHONE)):
            take(url, *shot, seconds if i == 0 else 4.0, i == 0 and seconds > 10.0)
    finally:
        program.end()
    return 0


if __name__ == '__main__':
    sys.exit(main())
