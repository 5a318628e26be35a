# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""No page of ours has a violation that axe-core finds: colours, names, labels, landmarks, order of headings."""

from collections.abc import Callable

import pytest

pytest.importorskip('selenium', reason='the browser tests need selenium: pip install .[test]')

from psd_deflection.records import AppliedLoad, BlockStatus
from tools.accessible import views, violations

from .browsing import Page
from .serving import BLOCK_NS, START_NS, Serving

pytestmark = pytest.mark.browser


def audit(page: Page, ready: str) -> None:
    found = []
    for view in views(page.driver):
        page.driver.refresh()
        page.until(ready)
        found += [f'{view}: {line}' for line in violations(page.driver)]
    assert found == []


@pytest.fixture
def shown(serve: Callable[..., Serving]) -> Serving:
    serving = serve(monitor_control='off')
    serving.shown.recordings.append('recordings/test')
    serving.feed.put(AppliedLoad(START_NS + 10 * BLOCK_NS, 0.0, -10.0, 0.0))
    serving.give(0, 100)
    serving.give(100, 5, lost=3)
    for number in range(50):
        serving.server.notify(f'message {number}')
    return serving


@pytest.mark.slow
def test_the_live_page(page: Page, shown: Serving) -> None:
    page.open(shown.url)
    audit(page, 'document.body.dataset.rows >= 105 && document.querySelectorAll("#entries details").length > 0')


@pytest.mark.slow
def test_the_live_page_with_all_that_opens(page: Page, shown: Serving) -> None:
    shown.give(105, 1, status=BlockStatus.LASER_LOST)
    page.open(shown.url)
    for what in ('weigh', 'ask'):
        page.until('document.querySelectorAll("#entries details").length > 0')
        page.js('[...document.querySelectorAll("details")].forEach((d) => { d.open = true; })')
        page.js('document.getElementById("hold").click()')
        page.js('document.querySelector("[data-series=\'4\']").click()')
        page.js(f'document.getElementById("{what}").showModal()')
        assert violations(page.driver) == []
        page.driver.refresh()
