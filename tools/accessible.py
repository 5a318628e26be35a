# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Audits pages with axe-core in headless Chromium: ``make docs STEP=axe`` for the site, the tests for the rest."""

import argparse
import functools
import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from selenium.webdriver.support.ui import WebDriverWait

from tools.browser import emulate, open_browser, served
from tools.program import WAIT_S

VIEWS = (('light', 1440, 900, False), ('dark', 1440, 900, False), ('light', 390, 844, True), ('dark', 390, 844, True))
"""Colour scheme, width, height, whether it is a phone."""
RUN = Path(__file__).with_suffix('.js').read_text(encoding='utf-8')


READY = 'return document.readyState === "complete"'


@functools.cache
def axe_source() -> str:
    """The text of axe.min.js. SystemExit, with the fix, if it is not installed."""
    spec = importlib.util.find_spec('axe_core_python')
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit('axe-core is needed: pip install axe-core-python')
    return (Path(next(iter(spec.submodule_search_locations))) / 'axe.min.js').read_text(encoding='utf-8')


def violations(driver: Any) -> list[str]:
    """What axe has against the page that ``driver`` shows: rule, and the elements concerned."""
    driver.set_script_timeout(WAIT_S)
    driver.execute_script(axe_source())
    rows = driver.execute_async_script(RUN)
    return [f'{rule} ({text}): {where}: {" ".join(why.split())}' for rule, text, nodes in rows for where, why in nodes]


def views(driver: Any) -> Iterator[str]:
    """Show the page in each of ``VIEWS``; yields its name. Afterwards the window is as it was."""
    try:
        for scheme, width, height, mobile in VIEWS:
            emulate(driver, width, height, scheme=scheme, phone=mobile)
            yield f'{scheme}, {width} px'
    finally:
        driver.execute_cdp_cmd('Emulation.clearDeviceMetricsOverride', {})
        driver.execute_cdp_cmd('Emulation.setEmulatedMedia', {'features': []})


def main() -> int:
    """Audit every page of the site in the folder that is given; the exit status is 1 if one has a violation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument('site', type=Path)
    parser.add_argument('--in-turn', action='store_true', help='each page in one view only, a quarter of the time')
    args = parser.parse_args()
    pages = sorted(str(p.relative_to(args.site)) for p in args.site.rglob('*.html'))
    if not pages:
        raise SystemExit(f'{args.site}: no pages are there')
    failures = 0
    with tempfile.TemporaryDirectory() as profile, served(args.site) as address:
        driver = open_browser(Path(profile))
        try:
            for number, view in enumerate(views(driver)):
                driver.get(f'{address}/{pages[0]}')
                # The site keeps the colours that it was seen in first.
                driver.execute_script('localStorage.clear()')
                for page in pages[number :: len(VIEWS)] if args.in_turn else pages:
                    driver.get(f'{address}/{page}')
                    WebDriverWait(driver, WAIT_S).until(lambda d: d.execute_script(READY))
                    for line in violations(driver):
                        failures += 1
                        print(f'{page} ({view}): {line}', flush=True)
        finally:
            driver.quit()
    print(f'{len(pages)} pages, {1 if args.in_turn else len(VIEWS)} of {len(VIEWS)} views each: {failures} violations')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
