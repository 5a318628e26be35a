"""What someone waits for who types ``make run``: until the page is served, shows the dots, and they move.

    python bench/first_look.py [--times 3]

The clock starts with ``make run``, in an environment that is set up, with a browser that is open already;
the dots have moved once the simulated rig's first weight shows (0.1 mm on PSD 1). Needs Chromium and its driver.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

ROOT = Path(__file__).resolve().parent.parent
LIMIT_S = 60.0
MOVED = 1e-4
FLAGS = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--disable-background-networking')
DOT = 'const y = document.querySelector("#detector_1 canvas")?.dataset.y; return y ? Number(y) : null'


def open_browser(profile: str) -> webdriver.Chrome:
    """A headless one with an empty page."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which('chromium') or shutil.which('google-chrome') or ''
    for flag in (*FLAGS, f'--user-data-dir={profile}'):
        options.add_argument(flag)
    return webdriver.Chrome(options=options, service=Service(shutil.which('chromedriver') or ''))


def wait_for(question: Callable[[], Any], what: str) -> Any:
    """What ``question`` answers first that is true."""
    until = time.monotonic() + LIMIT_S
    while time.monotonic() < until:
        if answer := question():
            return answer
        time.sleep(0.01)
    raise SystemExit(f'{what}: not within {LIMIT_S:.0f} s')


def look(browser: webdriver.Chrome, folder: str) -> tuple[float, float, float]:
    """One ``make run``: seconds until the address was printed, the first dot, the dots moved."""
    browser.get('about:blank')
    began = time.monotonic()
    program = subprocess.Popen(
        ['make', '--silent', 'run', f'ARGS=--record {folder} --ros-args -p monitor_port:=0'],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert program.stderr is not None
        url = next((line.split()[1] for line in program.stderr if line.startswith('monitor: ')), None)
        if url is None:
            raise SystemExit('make run ended without the address of a page')
        served = time.monotonic() - began
        browser.get(url)

        def dot() -> Any:
            return browser.execute_script(DOT)

        first = wait_for(lambda: (y := dot()) is not None and [y], 'a dot')[0]
        shown = time.monotonic() - began
        wait_for(lambda: (y := dot()) is not None and abs(y - first) > MOVED, 'a dot that moves')
        return served, shown, time.monotonic() - began
    finally:
        os.killpg(program.pid, signal.SIGINT)
        program.communicate()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=1)
    args = parser.parse_args()
    if not shutil.which('chromedriver'):
        raise SystemExit('Chromium and its driver are needed: apt install chromium chromium-driver')
    # What make sets up is not part of it.
    subprocess.run(['make', '--silent', 'setup'], cwd=ROOT, check=True)
    # A browser that was closed may still tidy up in its profile.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        browser = open_browser(f'{folder}/profile')
        try:
            for _ in range(args.times):
                served, shown, moved = look(browser, folder)
                print(f'page served {served:.1f} s, first dot {shown:.1f} s, dots moved {moved:.1f} s after make run')
        finally:
            browser.quit()
    return 0


if __name__ == '__main__':
    sys.exit(main())
