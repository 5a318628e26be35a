# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of the live page in docs/figures: ``make docs STEP=shots``; needs Chromium and its driver."""

import argparse
import contextlib
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import emulate, open_browser, picture
from tools.program import PSD_DEFLECTION, WAIT_S, Program

FIGURES = Path(__file__).resolve().parents[1] / 'docs' / 'figures'
THETA = 'return document.getElementById("theta").textContent'
LOADED = r'\u22129[34]\d\.\d+'
"""The twist in mdeg when 50 N hang on the sidebar, which they do every ``LOAD_PERIOD_S``."""
LOAD_PERIOD_S, BLOCKS_PER_S = 36.0, 50.0
DESK, PHONE = (1440, 900), (390, 844, 2.0, 'light', True)


def anything(driver: Any) -> bool:
    return True


@contextlib.contextmanager
def page_of(*words: str) -> Iterator[str]:
    """The address of the live page of ``psd-deflection monitor``, until the end."""
    program = Program([*PSD_DEFLECTION, 'monitor', '--monitor-port', '0', *words])
    try:
        yield program.until(r'monitor: (http\S+)')[1]
    finally:
        program.end()


def take(url: str, name: str, screen: Sequence[Any], seconds: float, ready: Callable[[Any], bool] = anything) -> None:
    """One picture, on a screen of :func:`emulate`, once ``seconds`` of data were drawn and the page is ``ready``."""
    driver = open_browser(Path(tempfile.mkdtemp()))
    try:
        emulate(driver, *screen)
        driver.get(url)
        wait = WebDriverWait(driver, seconds + LOAD_PERIOD_S + WAIT_S, poll_frequency=0.2)
        wait.until(drawn(seconds))
        wait.until(ready)
        picture(driver, FIGURES / f'{name}.png')
    finally:
        driver.quit()


def loaded(driver: Any) -> bool:
    return re.fullmatch(LOADED, driver.execute_script(THETA)) is not None


def shows(*texts: str) -> Callable[[Any], bool]:
    return lambda driver: any(text in driver.execute_script('return document.body.innerText') for text in texts)


def away_without(device: Program) -> Callable[[Any], bool]:
    """Pull the cable at the first question; then whether the page says so."""
    away = shows('no samples')

    def ready(driver: Any) -> bool:
        device.end()
        return away(driver)

    return ready


def drawn(seconds: float) -> Callable[[Any], bool]:
    return lambda driver: int(driver.execute_script('return document.body.dataset.rows ?? 0')) >= BLOCKS_PER_S * seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=40.0, help='before the first picture')
    seconds = parser.parse_args().seconds
    with page_of('--demo') as url:
        take(url, 'monitor', DESK, seconds, loaded if seconds > 10.0 else anything)
        take(url, 'monitor_phone', PHONE, 4.0)
    with page_of('bags/laser_off', '--loop') as url:
        take(url, 'monitor_laser_off', DESK, 1.0, shows('laser 1 lost', 'laser 2 lost'))
    with tempfile.TemporaryDirectory() as folder:
        port = f'{folder}/rig_port'
        device = Program([*PSD_DEFLECTION, 'simulate', '--serve', '--link', port])
        device.until('port: ')
        try:
            with page_of('--port', port) as url:
                take(url, 'monitor_away', DESK, 3.0, away_without(device))
        finally:
            device.end()


if __name__ == '__main__':
    main()
