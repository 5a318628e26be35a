# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the page "Try it in the browser" of the site as a visitor does (``make docs STEP=try-page``); needs Chromium."""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from tools.accessible import views, violations
from tools.browser import emulate, open_browser, picture, served

LIMIT_S = 1200.0
"""Longest wait for an answer: a busy machine, both cores taken, computes many times as long as an idle one."""
NO_OTHER_HOST = '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1'
HIDDEN = (0, 'drawn', '')  # What is chosen, one after the other: the first of the list, one drawn by chance, nothing.
NOTHING = 'Nothing is missing: '
SIZE = (940, 1250)  # Of the picture.


def state(driver: Any) -> str:
    """What the page says of itself: ready, absent, running, done or failed."""
    return str(driver.execute_script('return document.getElementById("try-form").dataset.state') or '')


def text(driver: Any, name: str) -> str:
    return str(driver.find_element(By.ID, f'try-{name}').text)


def answered(driver: Any, choice: int | str) -> str:
    """Choose, press *Run*, wait; returns what was hidden. SystemExit if the page fails."""
    select = Select(driver.find_element(By.ID, 'try-effect'))
    if isinstance(choice, int):
        select.select_by_index(choice)
    else:
        select.select_by_value(choice)
    # By keyboard: a mouse would stay over something, which then has another colour.
    driver.find_element(By.CSS_SELECTOR, '#try-form button').send_keys(Keys.ENTER)
    WebDriverWait(driver, LIMIT_S, poll_frequency=0.2).until(lambda d: state(d) != 'running')
    if state(driver) != 'done':
        raise SystemExit(f'the page: {text(driver, "state")}\n{text(driver, "steps")}')
    return text(driver, 'hidden')


def wrong(hidden: str, answer: str) -> bool:
    """Whether ``answer`` names anything but what was hidden."""
    return not answer.startswith(f'{hidden.partition(",")[0]} ' if hidden != 'nothing' else NOTHING)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument('site', type=Path)
    parser.add_argument('--picture', type=Path, metavar='FILE', help='the page after the first answer, as a .png')
    args = parser.parse_args()
    failures = 0
    with tempfile.TemporaryDirectory() as profile, served(args.site) as address:
        driver = open_browser(Path(profile), NO_OTHER_HOST)
        try:
            driver.get(f'{address}/try.html')
            WebDriverWait(driver, LIMIT_S).until(state)
            if state(driver) != 'ready':
                raise SystemExit(f'the page: {text(driver, "state")}')
            for choice in HIDDEN:
                hidden = answered(driver, choice)
                message = text(driver, 'answer')
                failures += wrong(hidden, message)
                print(f'{hidden}: {message.splitlines()[0]}', text(driver, 'steps'), text(driver, 'state'), sep='\n')
                if choice != HIDDEN[0]:
                    continue
                if args.picture is not None:
                    emulate(driver, *SIZE)
                    driver.execute_script('window.scrollTo(0, 0)')
                    picture(driver, args.picture)
                for view in views(driver):
                    for line in violations(driver):
                        failures += 1
                        print(f'try.html ({view}): {line}', flush=True)
        finally:
            driver.quit()
    print(f'{len(HIDDEN)} answers, {failures} failures')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
