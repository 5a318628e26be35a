# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The charts of a report in headless Chromium: cursor, zoom, switches, keys; nothing asked for, nothing complained."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('selenium', reason='the browser tests need selenium: pip install .[test]')

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from psd_deflection.base.charts import Chart, Panel, Rule, Series, drawn
from psd_deflection.base.pages import page as page_of
from test.run.monitor.browsing import Page
from tools.accessible import views, violations

pytestmark = pytest.mark.browser
X = np.arange(101.0)
KEYS = '[...document.querySelectorAll("button.key")]'


@pytest.fixture(scope='module')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    page = Page(tmp_path_factory.mktemp('profile'))
    yield page
    page.close()


@pytest.fixture
def page(browser: Page, tmp_path: Path) -> Iterator[Page]:
    """Two plots over one time with two curves each, then a cloud of two values of x, in closed details a spectrum."""
    gap = np.where((X > 40) & (X < 60), np.nan, -X)
    above = Panel((Series('before', X, 2 * X, 'red'), Series('after', X, gap, 'blue', 'points')), 't / s', 'x / µm')
    half_width = Series('after', X, X, 'blue', half_width=np.full(101, 5.0))
    below = Panel((Series('before', X, X**2, 'red'), half_width), 't / s', 'y / µm', rules=[Rule(25.0, 'here')])
    load = np.repeat([0.0, 10.0], 50)
    cloud = Panel((Series('missing', load, np.arange(100.0), 'text', 'points'),), 'load / N', 'x / µm')
    other = Series(
        'law', np.array([2.5, 7.5]), np.array([-5.0, 5.0]), 'green', 'rings', half_width=np.array([1.0, 1.0])
    )
    lone = Panel((other,), 'load / N', 'z')
    f = np.geomspace(0.5, 200.0, 50)
    spectrum = Panel((Series('density', f, 1.0 / f, 'violet', bold=True),), 'frequency / Hz', '1/√Hz', log='x, y')
    nothing = np.full(3, np.nan)
    empty = Panel((Series('none', nothing, nothing, 'red'),), 'what / Hz', '1/√Hz', log='x, y')
    body = [
        '<h1>A report</h1>',
        drawn(Chart('over time', (above, below))),
        drawn(Chart('over loads', (cloud, lone), beside=2)),
        f'<details><summary>More</summary>{drawn(Chart("a spectrum", (spectrum, empty)))}</details>',
    ]
    path = tmp_path / 'report.html'
    path.write_text(page_of('a report', body), encoding='utf-8')
    browser.open(path.as_uri())
    browser.until('document.querySelectorAll(".uplot").length === 4')
    yield browser
    assert browser.complaints() == []


def move(page: Page, plot: str, across: float, up: float = 0.5) -> None:
    """The mouse to a share of what lies between the axes."""
    over = page.driver.find_element(By.CSS_SELECTOR, f'#plot_{plot} .u-over')
    size = over.size
    to = round((across - 0.5) * size['width']), round((0.5 - up) * size['height'])
    page.js('arguments[0].scrollIntoView({block: "center"})', over)
    ActionChains(page.driver).move_to_element_with_offset(over, *to).perform()


def values(page: Page) -> dict[str, str]:
    pairs = page.js(
        f'{KEYS}.map((k) => [k.dataset.plot + " " + k.dataset.name, k.querySelector("output").textContent])'
    )
    return {name: value.replace('−', '-') for name, value in pairs}


@pytest.mark.slow
def test_every_plot_says_its_values_under_one_cursor(page: Page) -> None:
    move(page, 'c0p0', 0.252)
    page.until(f'{KEYS}[0].querySelector("output").textContent !== ""')
    message = values(page)
    at = float(page.js('document.querySelector("output.at[data-plot=c0p0]").textContent').removesuffix(' s'))
    assert 22 <= at <= 28
    assert (float(message['c0p0 before']), float(message['c0p0 after'])) == (2 * at, -at)
    assert (float(message['c0p1 before']), float(message['c0p1 after'])) == (at**2, at)
    assert message['c1p0 missing'] == ''


def test_in_a_gap_there_is_no_value(page: Page) -> None:
    move(page, 'c0p0', 0.5)
    page.until(f'{KEYS}[0].querySelector("output").textContent !== ""')
    assert values(page)['c0p0 after'] == ''


DRAWN = """((plot, tone) => {
  const canvas = document.querySelector(`#plot_${plot} canvas`);
  const scratch = Object.assign(document.createElement('canvas'), {width: canvas.width, height: canvas.height});
  const probe = scratch.getContext('2d', {willReadFrequently: true});
  probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(`--${tone}`).trim();
  probe.fillRect(0, 0, 1, 1);
  const wanted = probe.getImageData(0, 0, 1, 1).data;
  probe.clearRect(0, 0, 1, 1);
  probe.drawImage(canvas, 0, 0);
  const {data} = probe.getImageData(0, 0, canvas.width, canvas.height);
  let n = 0;
  for (let i = 0; i < data.length; i += 4) {
    n += data[i + 3] > 200 && [0, 1, 2].every((k) => Math.abs(data[i + k] - wanted[k]) < 10);
  }
  return n;
})"""
"""Pixels of a plot in a colour of the page."""


def test_a_key_switches_its_curve_in_every_plot(page: Page) -> None:
    for plot in ('c0p0', 'c0p1'):
        page.until(f'{DRAWN}("{plot}", "red") > 50')
    key = page.driver.find_element(By.CSS_SELECTOR, 'button.key[data-name=before]')
    key.send_keys(Keys.ENTER)
    for plot in ('c0p0', 'c0p1'):
        page.until(f'{DRAWN}("{plot}", "red") === 0')
        assert page.js(f'{DRAWN}("{plot}", "blue")') > 50
    assert page.js(f'{KEYS}.map((k) => k.getAttribute("aria-pressed"))')[:4] == ['false', 'true', 'false', 'true']
    key.send_keys(Keys.SPACE)
    page.until(f'{DRAWN}("c0p1", "red") > 50')


@pytest.mark.slow
def test_drag_zooms_plots_of_axis_and_button_resets(page: Page) -> None:
    full = 'document.querySelector("button.whole").checkVisibility()'
    assert not page.js(full)
    over = page.driver.find_element(By.CSS_SELECTOR, '#plot_c0p1 .u-over')
    move(page, 'c0p1', 0.2)
    ActionChains(page.driver).click_and_hold().move_by_offset(round(0.1 * over.size['width']), 0).release().perform()
    page.until(full)
    times = []
    for across in (0.01, 0.99):
        move(page, 'c0p0', across)
        page.until('document.querySelector("output.at[data-plot=c0p0]").textContent !== ""')
        times.append(float(page.js('document.querySelector("output.at[data-plot=c0p0]").textContent').split()[0]))
    assert times[0] >= 19
    assert times[1] <= 31
    page.driver.find_element(By.CSS_SELECTOR, 'button.whole').click()
    page.until(f'!{full}')
    move(page, 'c0p0', 0.98)
    page.until('parseFloat(document.querySelector("output.at[data-plot=c0p0]").textContent) > 90')


@pytest.mark.slow
def test_the_charts_are_accessible_and_no_wider_than_a_phone(page: Page) -> None:
    page.js('document.querySelector("details").setAttribute("open", "")')
    problems = []
    for view in views(page.driver):
        page.driver.refresh()
        page.until('document.querySelectorAll(".uplot").length === 4')
        problems += [f'{view}: {line}' for line in violations(page.driver)]
        assert page.js('document.documentElement.scrollWidth <= window.innerWidth')
        page.until(f'{DRAWN}("c0p0", "red") > 50', f'the colours of {view}')
    assert problems == []


@pytest.mark.slow
def test_a_report_asks_for_nothing(page: Page) -> None:
    assert page.js('performance.getEntriesByType("resource").map((e) => e.name)') == []
