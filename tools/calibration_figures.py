# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes docs/figures/calibrate_1.png to _5.png for docs/calibration.md: ``python -m tools.calibration_figures``.

The five commands are taken from the page and run in a folder of their own; the pictures are those that the commands
draw, smaller, or the first chart of their reports, and for the last one the p of each group. It needs Chromium.
"""

from __future__ import annotations

import base64
import io
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import open_browser
from tools.program import PSD_DEFLECTION, WAIT_S
from tools.shots import TWO_FRAMES, charted

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / 'docs' / 'figures'


def commands() -> list[str]:
    """The five commands of the section *Calibrate*."""
    text = (ROOT / 'docs' / 'calibration.md').read_text()
    section = text[text.index('\n## Calibrate\n') :]
    lines = [line for line in section.splitlines() if line.startswith('psd-deflection ')][:5]
    if [line.split()[1] for line in lines] != ['simulate', 'calibrate', 'simulate', 'validate', 'calibrate']:
        raise SystemExit(f'docs/calibration.md: other commands than expected: {lines}')
    return lines


def run(line: str, folder: Path) -> str:
    """What a command prints; SystemExit if it fails."""
    words = [*PSD_DEFLECTION, *shlex.split(line)[1:]]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'{line}\n{done.stdout}{done.stderr}')
    return done.stdout


def first_chart(page: Path) -> bytes:
    """A picture of the first chart of a report, as a browser shows it."""
    with tempfile.TemporaryDirectory() as profile:
        driver = open_browser(Path(profile), '--window-size=1030,900')
        try:
            driver.get(page.as_uri())
            driver.execute_script("document.documentElement.style.scrollbarWidth = 'none'")
            WebDriverWait(driver, WAIT_S).until(charted)
            driver.execute_async_script(TWO_FRAMES)
            box = driver.execute_script(
                'const b = document.querySelector("figure.chart").getBoundingClientRect();'
                'return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height, scale: 1}'
            )
            shot = driver.execute_cdp_cmd('Page.captureScreenshot', {'clip': box, 'captureBeyondViewport': True})
            return base64.b64decode(shot['data'])
        finally:
            driver.quit()


def save(content: bytes, name: str) -> None:
    """Write a picture no wider than the page needs, in few colours."""
    image = Image.open(io.BytesIO(content)).convert('RGB')
    image.thumbnail((1000, 1000))
    image.quantize(48).save(FIGURES / name, optimize=True)


def groups(answer: str) -> bytes:
    """A bar for each group: how surely it did not move."""
    found = json.loads(answer)
    names = [g['name'] for g in found['groups']][::-1]
    figure = Figure(figsize=(8, 4.4), layout='constrained', dpi=90)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.barh(names, [g['p'] for g in found['groups']][::-1], color='#4c72b0')
    axis.axvline(found['level'] / len(names), color='#c44e52', ls='--', label='below: it moved')
    axis.set_xscale('log')
    axis.set_xlabel(f'p of each group; all together {found["p"]:.2g}: {found["verdict"]}')
    axis.legend(frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format='png')
    return stream.getvalue()


def main() -> int:
    """Run the five commands and draw."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        shutil.copytree(ROOT / 'config', folder / 'config')
        lines = commands()
        for line in lines[:4]:
            run(line, folder)
        checked = run(f'{lines[4]} --json', folder)
        for recording, name in (('sidebar', 'calibrate_1.png'), ('link', 'calibrate_3.png')):
            run(f'psd-deflection plot {recording}.csv --out {recording}.png', folder)
            save((folder / f'{recording}.png').read_bytes(), name)
        save(first_chart(folder / 'calibrated' / 'report.html'), 'calibrate_2.png')
        save(first_chart(folder / 'validated' / 'report.html'), 'calibrate_4.png')
        save(groups(checked), 'calibrate_5.png')
    return 0


if __name__ == '__main__':
    sys.exit(main())
