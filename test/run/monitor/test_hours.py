# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page's windows of hours in headless Chromium: what the daemon remembers, drawn."""

from collections.abc import Callable

import pytest

pytest.importorskip('selenium', reason='the browser tests need selenium: pip install .[test]')


from psd_deflection.measure.watch import Alarm
from psd_deflection.records import BlockStatus, Mark

from .browsing import Page
from .serving import BLOCK_NS, START_NS, Serving

pytestmark = pytest.mark.browser
SLOWLY = 50
"""Blocks come once a second, so that an hour has few."""
SECOND_NS = SLOWLY * BLOCK_NS
WARM_ANSWERS, MORE_ANSWERS = 400, 400
"""Until then the engine compiles what runs often."""
CELL = 'document.getElementById("cell").textContent'
OPEN = 'document.body.dataset.cells'
PRESSED = '[...document.querySelectorAll(".windows [aria-pressed=true]")].map((b) => b.textContent).join()'
OBSERVED = """((plot, from, to, is) => {
  const canvas = document.querySelector(plot + ' canvas');
  const over = document.querySelector(plot + ' .u-over').getBoundingClientRect();
  const whole = canvas.getBoundingClientRect();
  const ratio = canvas.width / whole.width;
  const left = (over.left - whole.left + from * over.width) * ratio;
  const top = (over.top - whole.top) * ratio;
  const wide = Math.max(1, (to - from) * over.width * ratio);
  const {data} = canvas.getContext('2d').getImageData(left, top, wide, over.height * ratio);
  let n = 0;
  for (let i = 0; i < data.length; i += 4) n += data[i + 3] > 100 && is(data[i], data[i + 1], data[i + 2]);
  return n;
})"""
"""Pixels of one colour on a part of a plot, from 0 at its left edge to 1 at its right one."""
DY = '(r, g, b) => r - b > 60 && g > 60'
MARK = '(r, g, b) => b > 130 && r - g > 60'
RED = '(r, g, b) => r > 150 && g < 80 && b < 80'
COLORED = '(r, g, b) => Math.max(r, g, b) - Math.min(r, g, b) > 60'
AMBER = '(r, g, b) => r > 155 && r < 167 && g > 86 && g < 98 && b < 6'


@pytest.fixture
def hour(serve: Callable[..., Serving]) -> Serving:
    """An hour with a gap of six minutes in its middle, a mark, an alarm, losses, and a minute without light."""
    serving = serve()
    for first, count in ((0, 900), (900, 780), (2040, 960), (3000, 540)):
        serving.give(first, count, every=SLOWLY)
        # Numbers go on after the gap: nothing is lost in it, the daemon was away.
        serving.feed.skip()
        serving.settle()
    serving.give(3540, 5, every=SLOWLY, lost=3)
    serving.give(3545, 55, every=SLOWLY, status=BlockStatus.LASER_LOST)
    serving.feed.put(Mark(START_NS + 900 * SECOND_NS, 'bumped it'))
    serving.shown.alarmed = Alarm(START_NS + 2200 * SECOND_NS, START_NS + 2204 * SECOND_NS, 'x1', 3e-6, 1e-7)
    return serving


def see(start: float, end: float, color: str, plot: str = '#plot_shift') -> str:
    """How many pixels of a colour are on a part of a plot."""
    return f'{OBSERVED}("{plot}", {start}, {end}, {color})'


def choose(page: Page, name: str) -> None:
    page.js(f'[...document.querySelectorAll("[data-span]")].find((b) => b.textContent === "{name}").click()')


def test_a_mark_a_gap_and_an_alarm_are_observed_in_the_hour(page: Page, hour: Serving) -> None:
    page.open(hour.url)
    page.until('document.body.dataset.rows > 0')
    choose(page, '1 h')
    page.until(f'{OPEN} > 300')
    page.until(f'{CELL}.startsWith("a point is the mean of ")')
    page.until(f'{see(0.605, 0.617, RED)} > 50', 'the alarm')
    for part in (0.1, 0.3, 0.6, 0.9):
        assert page.js(see(part, part + 0.02, DY)) > 10
    # From 28 min to 34 min: neither line nor band, in no plot.
    for plot in ('#plot_shift', '#plot_theta', '#plot_sums'):
        assert page.js(see(0.475, 0.56, COLORED, plot)) == 0
    assert page.js(see(0.245, 0.255, MARK)) > 50
    assert page.js(see(0.5, 0.55, MARK)) == 0
    # Lost samples are ticks at the top, blocks without an estimate at the bottom.
    assert page.js(see(0.98, 1.0, RED)) > 5
    assert page.js(see(0.98, 1.0, AMBER)) > 5
    assert page.js(see(0.1, 0.7, AMBER)) == 0
    # A second browser, and this one after it was reloaded, have the same; the window is remembered.
    page.driver.refresh()
    page.until(f'{OPEN} > 300 && {PRESSED} === "1 h"')
    assert page.js(see(0.245, 0.255, MARK)) > 50
    choose(page, '30 s')
    page.until(f'{OPEN} === undefined && {CELL} === ""')
    assert [c for c in page.complaints() if 'willReadFrequently' not in c] == []
