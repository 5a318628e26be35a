"""Makes the pictures of the live page in docs/figures: ``make shots``; needs Chromium and its driver.

The page shows the simulated rig until every load case has gone by, and 50 N hang on the sidebar.
"""

from __future__ import annotations

import argparse
import base64
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

FIGURES = Path(__file__).resolve().parents[1] / 'docs' / 'figures'
SHOTS = (('monitor', 1440, 900, 1.0, 'light', False),)
PHONE = ('monitor_phone', 390, 844, 2.0, 'light', True)


def wait_for_load(driver: webdriver.Chrome) -> None:
    """Until 50 N hang still on the sidebar, which they do every 36 s."""
    still = 0
    until = time.monotonic() + 45.0
    while still < 5 and time.monotonic() < until:
        theta = driver.execute_script('return document.getElementById("theta").textContent').replace('\u2212', '-')
        still = still + 1 if re.fullmatch(r'-9[34]\d\.\d+', theta) else 0
        time.sleep(0.2)


def take(
    url: str, name: str, width: int, height: int, ratio: float, scheme: str, mobile: bool, seconds: float, loaded: bool
) -> None:
    """One picture."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which('chromium') or shutil.which('google-chrome') or ''
    for flag in ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--disable-background-networking'):
        options.add_argument(flag)
    options.add_argument(f'--user-data-dir={tempfile.mkdtemp()}')
    driver = webdriver.Chrome(options=options, service=Service(shutil.which('chromedriver') or ''))
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
        time.sleep(seconds)
        if loaded:
            wait_for_load(driver)
        shot = driver.execute_cdp_cmd('Page.captureScreenshot', {})
        (FIGURES / f'{name}.png').write_bytes(base64.b64decode(shot['data']))
    finally:
        driver.quit()


def main() -> int:
    """Start the rig, take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=40.0, help='before the first picture')
    seconds = parser.parse_args().seconds
    program = subprocess.Popen(
        [sys.executable, '-m', 'psd_deflection', 'monitor', '--http-port', '0', '--control'],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert program.stderr is not None
        url = next(line.split()[1] for line in program.stderr if line.startswith('monitor: '))
        for i, shot in enumerate((*SHOTS, PHONE)):
            take(url, *shot, seconds if i == 0 else 4.0, i == 0 and seconds > 10.0)
    finally:
        program.send_signal(signal.SIGINT)
        program.wait()
    return 0


if __name__ == '__main__':
    sys.exit(main())
