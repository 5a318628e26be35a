# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Times from ``make run`` until the page is served, shows the dots, and the dots move."""

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import open_browser
from tools.program import ROOT, Program

LIMIT_S, MOVED = 60.0, 1e-4
LOADED = """const all = [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')];
const [drawn] = performance.getEntriesByName('drawn');
return [all.reduce((sum, e) => sum + e.transferSize, 0), Math.max(...all.map((e) => e.responseEnd)), drawn.startTime]"""
"""Bytes over the wire, and ms from the start of the navigation to the last of them and to the first trace."""
DRAWN = 'return performance.getEntriesByName("drawn").length'
DOT = 'const y = document.querySelector("#detector_1 canvas")?.dataset.y'


def busy_s(browser: webdriver.Chrome) -> float:
    """CPU time of the page's thread so far, s."""
    reported = browser.execute_cdp_cmd('Performance.getMetrics', {})['metrics']
    return float(next(m['value'] for m in reported if m['name'] == 'TaskDuration'))


def look(browser: webdriver.Chrome, folder: str) -> tuple[float, float, float, str]:
    """One ``make run``: seconds until the address, the first dot, the dots moved; the first load in words."""
    browser.get('about:blank')
    began = time.monotonic()
    program = Program(['make', '--silent', 'run', f'ARGS=--record {folder} --ros-args -p monitor_port:=0'])
    try:
        url = program.until(r'monitor: (http\S+)')[1]
        served = time.monotonic() - began
        before = busy_s(browser)
        browser.get(url)
        wait = WebDriverWait(browser, LIMIT_S, poll_frequency=0.01)
        wait.until(lambda b: b.execute_script(DRAWN), 'no trace')
        busy = busy_s(browser) - before
        first = wait.until(lambda b: b.execute_script(f'{DOT}; return y ? [Number(y)] : null'), 'no dot')[0]
        shown = time.monotonic() - began
        moved = f'{DOT}; return y && Math.abs(Number(y) - arguments[0]) > {MOVED}'
        wait.until(lambda b: b.execute_script(moved, first), 'no dot moves')
        ended = time.monotonic() - began
        size, fetched, drawn = browser.execute_script(LOADED)
        load = f'first load {size / 1e3:.0f} kB in {fetched / 1e3:.2f} s, first trace after {drawn / 1e3:.2f} s'
        return served, shown, ended, f'{load}, {busy:.2f} s of CPU of the page'
    finally:
        program.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=1)
    args = parser.parse_args()
    # The set-up by make is not part of the time.
    subprocess.run(['make', '--silent', 'setup'], cwd=ROOT, check=True)
    # A browser that was closed may still tidy up in its profile.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        browser = open_browser(Path(folder) / 'profile')
        browser.execute_cdp_cmd('Performance.enable', {'timeDomain': 'threadTicks'})
        try:
            for _ in range(args.times):
                served, shown, moved, load = look(browser, folder)
                print(f'page served {served:.1f} s, first dot {shown:.1f} s, dots moved {moved:.1f} s after make run')
                print(load)
        finally:
            browser.quit()


if __name__ == '__main__':
    main()
