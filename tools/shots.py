# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of the live page in docs/figures: ``make docs STEP=shots``; needs Chromium and its driver."""

import argparse
import base64
import io
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import open_browser
from tools.program import PSD_DEFLECTION, WAIT_S, Program

FIGURES = Path(__file__).resolve().parents[1] / 'docs' / 'figures'
MONITOR = ('monitor', 1440, 900, 1.0, 'light', False)
LASER_OFF = ('monitor_laser_off', 1440, 900, 1.0, 'light', False)
AWAY = ('monitor_away', 1440, 900, 1.0, 'light', False)
THETA = 'return document.getElementById("theta").textContent'
LOADED = r'\u22129[34]\d\.\d+'
"""The twist in mdeg when 50 N hang on the sidebar, which they do every ``LOAD_PERIOD_S``."""
LOAD_PERIOD_S = 36.0
BLOCKS_PER_S = 50.0
PHONE = ('monitor_phone', 390, 844, 2.0, 'light', True)


def take(
    url: str,
    name: str,
    width: int,
    height: int,
    ratio: float,
    scheme: str,
    mobile: bool,
    seconds: float,
    ready: Callable[[Any], bool] = lambda driver: True,
) -> None:
    """One picture, once ``seconds`` of data were drawn and the page is ``ready``."""
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
        wait.until(drawn(seconds))
        wait.until(ready)
        shot = driver.execute_cdp_cmd('Page.captureScreenshot', {})
        (FIGURES / f'{name}.png').write_bytes(base64.b64decode(shot['data']))
    finally:
        driver.quit()


def loaded(driver: Any) -> bool:
    """Whether 50 N hang on the sidebar."""
    return re.fullmatch(LOADED, driver.execute_script(THETA)) is not None


def shows(*texts: str) -> Callable[[Any], bool]:
    """Whether the page shows one of ``texts``."""
    return lambda driver: any(text in driver.execute_script('return document.body.innerText') for text in texts)


def away_without(device: Program) -> Callable[[Any], bool]:
    """Pull the cable at the first question; then whether the page says so."""
    away = shows('no samples')

    def ready(driver: Any) -> bool:
        device.end()
        return away(driver)

    return ready


WIDTHS = {390: 844, 768: 1024, 1024: 768, 1440: 900, 1920: 1080}
"""Of a phone, a tablet, a small and a usual laptop, a desk: width and height, px."""
SCHEMES = ('light', 'dark')
SHEET_HEIGHT = 300  # Pixels of each picture on the sheet of all.
EVERYWHERE = Path(__file__).resolve().parents[1] / 'build' / 'shots'


def everywhere(url: str, name: str, ready: Callable[[Any], bool]) -> Image.Image:
    """The page at every width, light and dark: each as ``build/shots/NAME_WIDTH_SCHEME.png``; all on one sheet."""
    driver = open_browser(Path(tempfile.mkdtemp()))
    rows = []
    try:
        driver.get(url)
        WebDriverWait(driver, LOAD_PERIOD_S + WAIT_S, poll_frequency=0.2).until(ready)
        for scheme in SCHEMES:
            one = {'name': 'prefers-color-scheme', 'value': scheme}
            driver.execute_cdp_cmd('Emulation.setEmulatedMedia', {'features': [one]})
            shots = []
            for width, height in WIDTHS.items():
                size = {'width': width, 'height': height, 'deviceScaleFactor': 1.0, 'mobile': width < 500}
                driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', size)
                wide = driver.execute_script('return document.documentElement.scrollWidth')
                if wide > width:
                    raise SystemExit(f'{name}: {wide} px wide on a screen of {width} px')
                # Two frames: canvases are drawn anew for this width and scheme.
                driver.execute_async_script(TWO_FRAMES)
                shot = base64.b64decode(driver.execute_cdp_cmd('Page.captureScreenshot', {})['data'])
                (EVERYWHERE / f'{name}_{width}_{scheme}.png').write_bytes(shot)
                image = Image.open(io.BytesIO(shot)).convert('RGB')
                shots.append(image.resize((round(width * SHEET_HEIGHT / height), SHEET_HEIGHT)))
            rows.append(_beside(shots))
    finally:
        driver.quit()
    sheet = Image.new('RGB', (rows[0].width, sum(row.height + 8 for row in rows)), 'white')
    for number, row in enumerate(rows):
        sheet.paste(row, (0, number * (SHEET_HEIGHT + 8)))
    return sheet


TWO_FRAMES = (
    'const done = arguments[0]; requestAnimationFrame(() => setTimeout(() => requestAnimationFrame(done), 300))'
)


def _beside(images: list[Image.Image]) -> Image.Image:
    row = Image.new('RGB', (sum(i.width + 8 for i in images) - 8, SHEET_HEIGHT), 'white')
    at = 0
    for image in images:
        row.paste(image, (at, 0))
        at += image.width + 8
    return row


def reports(folder: Path) -> dict[str, Path]:
    """The page of each study, of a small recording."""
    loads = 'steps:0,0,0;20,0,0;0,-20,0;0,0,2;0,0,0:0.6'
    recording = folder / 'rig.csv'
    rotated = ['--true-pose', '--loads', loads, '--effect', 'sensor_rotation,psd=2,angle=0.01']
    studies = ('discover', 'identify', 'validate', 'calibrate')
    commands = [['simulate', '--out', str(recording), *rotated]]
    commands += [[study, str(recording), '--out', str(folder / study)] for study in studies]
    commands += [['plot', str(recording), '--out', str(folder / 'plot.html')]]
    for words in commands:
        subprocess.run([*PSD_DEFLECTION, *words], check=True, capture_output=True)
    return {**{study: folder / study / 'report.html' for study in studies}, 'plot': folder / 'plot.html'}


def at_every_width() -> None:
    """Live page and reports at every width, and one sheet of each, in build/shots."""
    EVERYWHERE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        program = Program([*PSD_DEFLECTION, 'monitor', '--monitor-port', '0', '--demo'])
        try:
            url = program.until(r'monitor: (http\S+)')[1]
            sheets = {'page': everywhere(url, 'page', drawn(2.0))}
        finally:
            program.end()
        for name, path in reports(Path(folder)).items():
            sheets[name] = everywhere(path.as_uri(), name, charted)
    for name, sheet in sheets.items():
        sheet.save(EVERYWHERE / f'{name}.png')


def drawn(seconds: float) -> Callable[[Any], bool]:
    """Whether so many seconds of data were drawn."""
    return lambda driver: int(driver.execute_script('return document.body.dataset.rows ?? 0')) >= BLOCKS_PER_S * seconds


def charted(driver: Any) -> bool:
    """Whether the charts that a report shows are drawn; those in closed details are not."""
    plots = '[...document.querySelectorAll(".plot")].filter((p) => p.clientWidth > 0)'
    return bool(driver.execute_script(f'return {plots}.every((p) => p.querySelector(".uplot"))'))


def main() -> int:
    """Start the rig, take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=40.0, help='before the first picture')
    parser.add_argument('--widths', action='store_true', help='only page and reports at every width, light and dark')
    args = parser.parse_args()
    seconds = args.seconds
    if args.widths:
        at_every_width()
        return 0
    monitor = [*PSD_DEFLECTION, 'monitor', '--monitor-port', '0']
    with tempfile.TemporaryDirectory() as folder:
        program = Program([*monitor, '--demo'])
        try:
            url = program.until(r'monitor: (http\S+)')[1]
            take(url, *MONITOR, seconds, loaded if seconds > 10.0 else lambda driver: True)
            take(url, *PHONE, 4.0)
        finally:
            program.end()
        program = Program([*monitor, 'bags/laser_off', '--loop'], FIGURES.parents[1])
        try:
            take(program.until(r'monitor: (http\S+)')[1], *LASER_OFF, 1.0, shows('laser 1 lost', 'laser 2 lost'))
        finally:
            program.end()
        port = f'{folder}/rig_port'
        device = Program([*PSD_DEFLECTION, 'simulate', '--serve', '--link', port])
        device.until('port: ')
        program = Program([*monitor, '--port', port])
        try:
            url = program.until(r'monitor: (http\S+)')[1]
            take(url, *AWAY, 3.0, away_without(device))
        finally:
            program.end()
            device.end()
    return 0


if __name__ == '__main__':
    sys.exit(main())
