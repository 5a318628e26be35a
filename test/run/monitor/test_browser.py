# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page in headless Chromium, before the real daemon and the simulated rig; axe-core finds no violation in it."""

import contextlib
import http.server
import importlib.util
import random
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('selenium', reason='the browser tests need selenium: pip install .[test]')

from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from psd_deflection.cli.main import main
from psd_deflection.records import AppliedLoad, BlockStatus, Mark
from tools.accessible import views, violations
from tools.program import PSD_DEFLECTION, ROOT, Program

from .browsing import Page
from .serving import BLOCK_NS, START_NS, Serving

pytestmark = pytest.mark.browser
Start = Callable[..., Program]
BAGS = Path(__file__).parents[3] / 'bags'


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[Program] = []

    def begin(*arguments: str) -> Program:
        program = Program(
            [*PSD_DEFLECTION, *arguments], tmp_path, env={'PYTHONPATH': str(ROOT), 'XDG_STATE_HOME': str(tmp_path)}
        )
        started.append(program)
        return program

    yield begin
    for program in started:
        program.end()


def address_of(program: Program) -> str:
    """Of the page that it serves."""
    return program.until(r'monitor: (http://\S+)')[1]


def parameter_file(folder: Path, **values: object) -> str:
    path = folder / 'rig.yaml'
    lines = [f'    {name}: {str(value).lower()}\n' for name, value in values.items()]
    path.write_text('/**:\n  ros__parameters:\n' + ''.join(lines))
    return str(path)


def free_port() -> int:
    """One that stays free while nobody serves on it: none of those that the system gives to whoever connects."""
    for port in random.sample(range(10_000, 32_000), 100):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(('127.0.0.1', port))
            return port
    pytest.fail('no port is free')


def picture(page: Page, selector: str) -> str:
    return str(page.js('document.querySelector(arguments[0]).toDataURL()', selector))


COLORED = """(() => {
  const canvas = document.querySelector('#plot_shift canvas');
  const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let n = 0;
  for (let i = 0; i < data.length; i += 4) n += data[i + 3] > 200 && data[i] - data[i + 2] > 60;
  return n;
})()"""
"""Pixels in the colour of dY."""
HEIGHTS = """(() => {
  const canvas = document.querySelector('#plot_shift canvas');
  const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const [sums, counts] = [[0, 0], [0, 0]];
  for (let i = 0; i < data.length; i += 4) {
    const red = data[i] - data[i + 2];
    if (data[i + 3] < 200 || Math.abs(red) < 60) continue;
    sums[red > 0 ? 1 : 0] += i / (4 * canvas.width);
    counts[red > 0 ? 1 : 0] += 1;
  }
  return [sums[0] / counts[0], sums[1] / counts[1]];
})()"""
"""Mean rows of the pixels in the colours of dX and of dY; downwards."""
STICKING_OUT = """(() => {
  for (const name of ['dx', 'dy', 'theta']) document.getElementById(name).textContent = '\u221212345.67';
  return [...document.querySelectorAll('main > section, .number, .number > *, figure, header > *')];
})().filter((e) => {
  const [own, parent] = [e.getBoundingClientRect(), e.parentElement.getBoundingClientRect()];
  const spills = e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0;
  return spills || own.right > parent.right + 1 || own.left < parent.left - 1;
}).map((e) => [e.tagName, e.id, e.className, e.textContent.slice(0, 30)])"""
"""What is wider than what it lies in, or than itself, where the numbers are long."""


@pytest.mark.parametrize('how', [pytest.param('node', marks=pytest.mark.slow), 'alone'])
def test_daemon_on_simulated_rig_shows_moving_dots(page: Page, start: Start, tmp_path: Path, how: str) -> None:
    if how == 'node' and importlib.util.find_spec('rclpy') is None:
        pytest.skip('the node needs rclpy: pip install .[ros]')
    arguments = ['--params-file', parameter_file(tmp_path, monitor=True, monitor_port=0, monitor_control='off')]
    # As `make run` starts it, but for the port, which others may have.
    program = start('estimator', '--demo', *arguments, *([] if how == 'node' else ['--no-ros']))
    page.open(address_of(program))
    page.live()
    first = [picture(page, f'#detector_{n} canvas') for n in (1, 2)]
    # The rig's loads come and go every few seconds; noise alone moves the dot by less than a pixel.
    for n in (1, 2):
        y = f'Number(document.querySelector("#detector_{n} canvas").dataset.y)'
        page.until(f'Number.isFinite({y})')
        page.until(f'Math.abs({y} - {page.js(y)}) > 1e-4')
    assert [picture(page, f'#detector_{n} canvas') for n in (1, 2)] != first
    page.until(f'{COLORED} > 200', 'a trace of dY')
    page.until('document.querySelectorAll("#tiles dd").length > 5')
    page.until('[...document.querySelectorAll("#entries b")].some((b) => b.textContent.startsWith("clock"))')
    # Not allowed: neither by the page nor past it.
    for button in ('zero', 'record', 'load'):
        page.until(f'document.getElementById("{button}").getAttribute("aria-disabled") === "true"')
        page.driver.find_element(By.ID, button).click()
        page.until('document.getElementById("notice").textContent.includes("buttons are switched off")')
    answer = page.later(
        'fetch("/api/zero", {method: "POST", headers: {"Content-Type": "application/json"}, body: "{}"})'
        '.then((r) => r.json().then((j) => [r.status, j.message]))'
    )
    assert answer[0] == 403
    assert 'monitor_control' in answer[1]
    assert page.complaints() == [] or all('403' in c for c in page.complaints())


def test_another_site_cannot_press_the_button_nor_look_on(page: Page, serve: Callable[..., Serving]) -> None:
    serving = serve(monitor_control=True)
    # A browser opens a connection more than it uses: served one after the other, the idle one holds up the other.
    server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), http.server.BaseHTTPRequestHandler)
    server.block_on_close = False
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        # An error page is a page of that other origin as well.
        page.open(f'http://localhost:{server.server_port}/')
        target = f'http://127.0.0.1:{serving.port}'
        for options in ('mode: "no-cors"', 'headers: {"Content-Type": "application/json"}'):
            page.later(f'fetch("{target}/api/zero", {{method: "POST", body: "{{}}", {options}}}).then((r) => r.type)')
        socket_of = f'new WebSocket("ws://127.0.0.1:{serving.port}/ws")'
        events = 's.onopen = () => ok("open"); s.onclose = () => ok("closed");'
        opened = page.later(f'new Promise((ok) => {{ const s = {socket_of}; {events} }})')
        assert opened == 'closed'
        assert serving.shown.zeros == 0
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_the_token_of_the_printed_address_opens_the_buttons(page: Page, serve: Callable[..., Serving]) -> None:
    serving = serve(monitor_control=True, monitor_address='0.0.0.0')
    address = f'http://127.0.0.1:{serving.port}/'
    serving.give(0, 10)
    page.open(f'{address}#token=wrong')
    page.until('document.getElementById("zero").getAttribute("aria-disabled") === "false"')
    page.driver.find_element(By.ID, 'zero').click()
    page.until('document.getElementById("notice").textContent.includes("token is missing or wrong")')
    assert serving.shown.zeros == 0
    page.driver.find_element(By.ID, 'zero').click()
    page.until('document.getElementById("ask").open')
    page.driver.find_element(By.ID, 'cancel').click()
    page.until('!document.getElementById("ask").open')
    page.driver.find_element(By.ID, 'mark').click()
    page.until('document.getElementById("ask").open')
    page.until(f'performance.now() > {page.js("performance.now()")} + 500')
    page.driver.find_element(By.ID, 'token').send_keys(serving.server.token + Keys.ENTER)
    page.until('document.getElementById("notice").textContent === "mark: mark 1"')
    # A mark is of the click, not of the token.
    assert serving.shown.lates[0] > 0.5
    page.driver.find_element(By.ID, 'zero').click()
    page.until('document.getElementById("notice").textContent === "unloaded dots taken"')
    assert serving.shown.zeros == 1
    assert serving.server.token not in str(page.js('location.href'))


@pytest.mark.slow
def test_the_page_outlives_an_unplugged_device(page: Page, start: Start, tmp_path: Path) -> None:
    link = str(tmp_path / 'port')
    device = start('simulate', '--serve', '--link', link)
    device.until('port: ')
    program = start('monitor', '--port', link, '--http-port', '0', '--control')
    page.open(address_of(program))
    page.live()
    faded = 'getComputedStyle(document.querySelector(".numbers")).outlineStyle === "dashed"'
    page.until(f'document.body.dataset.state === "live" && !({faded})')
    device.end()
    # What was measured last does not look like what is measured now, nor can it become a zero.
    page.until(f'document.body.dataset.state === "stale" && {faded}')
    page.until('document.title.startsWith("no samples ·")')
    page.until('document.querySelector("#messages").textContent.includes("waiting for it to come back")')
    page.driver.find_element(By.ID, 'zero').click()
    page.until('document.getElementById("notice").textContent === "not zeroed: no data flows"')
    before = page.rows()
    again = start('simulate', '--serve', '--link', link)
    again.until('port: ')
    page.live()
    page.until(f'document.body.dataset.rows > {before + 50}')
    page.until('document.querySelector("#messages").textContent.includes("the device is back")')
    # A rejected zero is a 409.
    assert [c for c in page.complaints() if '409' not in c] == []


@pytest.mark.slow
def test_the_page_reconnects_to_a_restarted_daemon(page: Page, start: Start) -> None:
    port = str(free_port())
    first = start('monitor', str(BAGS / 'clean'), '--loop', '--http-port', port, '--control')
    page.open(address_of(first))
    page.until('document.body.dataset.rows > 20')
    instance = page.js('document.body.dataset.instance')
    assert first.end() == 0
    page.until('document.body.dataset.state === "offline"')
    page.until('document.getElementById("zero").getAttribute("aria-disabled") === "true"')
    page.driver.find_element(By.ID, 'zero').click()
    page.until('document.getElementById("notice").textContent === "there is no connection to the daemon"')
    before = page.rows()
    address_of(start('monitor', str(BAGS / 'clean'), '--loop', '--http-port', port))
    page.live()
    page.until(f'document.body.dataset.rows > {before + 20}')
    assert page.js('document.body.dataset.instance') != instance
    assert [c for c in page.complaints() if 'ERR_CONNECTION_REFUSED' not in c] == []


@pytest.mark.slow
def test_a_lost_laser_is_observed(page: Page, start: Start) -> None:
    page.open(address_of(start('monitor', str(BAGS / 'laser_off'), '--loop', '--http-port', '0')))
    page.until('document.getElementById("state").textContent === "laser lost"')
    page.until('document.getElementById("detector_2").classList.contains("low")')
    page.until('document.getElementById("dx").textContent === "–"')
    page.live()
    page.until('!document.getElementById("detector_2").classList.contains("low")')


MOST_BYTES = 150_000
FETCHED = """[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]
.reduce((sum, entry) => sum + entry.transferSize, 0)"""


def test_the_first_load_is_small_and_dx_is_above_dy(page: Page, serve: Callable[..., Serving]) -> None:
    serving = serve()
    # dX rises from 0 to 1 mm, dY from -1 to 0 mm.
    serving.give(0, 20)
    page.driver.execute_cdp_cmd('Network.clearBrowserCache', {})
    page.open(serving.url)
    page.until('document.body.dataset.rows >= 20')
    page.until(f'{HEIGHTS}.every(Number.isFinite)', 'traces of dX and dY')
    dx, dy = page.js(HEIGHTS)
    assert dx < dy - 20
    assert page.js('["sd_dx", "sd_dy", "sd_theta"].every((id) => document.getElementById(id).title)')
    # A label of an enlarged axis is of its tick's time: half a second is not rounded away.
    assert page.later('import("/page/charts.js").then((m) => [2.5, 1, 0.25].map(m.decimals))') == [1, 0, 2]
    assert 20_000 < page.js(FETCHED) < MOST_BYTES


def test_page_of_a_recording_draws_dx_above_dy(page: Page, tmp_path: Path) -> None:
    # Its load pulls down.
    out = tmp_path / 'page.html'
    assert main(['plot', str(BAGS / 'clean'), '--out', str(out)]) == 0
    page.open(out.as_uri())
    page.until(f'{HEIGHTS}.every(Number.isFinite)', 'traces of dX and dY')
    dx, dy = page.js(HEIGHTS)
    assert dx < dy - 20


@pytest.mark.slow
@pytest.mark.parametrize('width', [390, 844, 1024, 1440])
def test_no_element_is_cut_off_or_overlaps(page: Page, serve: Callable[..., Serving], width: int) -> None:
    serving = serve(monitor_control=True)
    serving.shown.recordings.append('recordings/test')
    serving.give(0, 20)
    metrics = {'width': width, 'height': 800, 'deviceScaleFactor': 1, 'mobile': width < 800}
    page.driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', metrics)
    try:
        page.open(serving.url)
        page.until('document.body.dataset.rows >= 20 && document.getElementById("dx").textContent !== "–"')
        page.until('document.getElementById("record").textContent === "● Recording"')
        assert page.js('document.documentElement.scrollWidth') <= width
        assert page.js(STICKING_OUT) == []
        ends = (
            'arguments[0].map((b) => b.parentElement.getBoundingClientRect().right - b.getBoundingClientRect().right)'
        )
        assert max(page.js(ends, page.driver.find_elements(By.CLASS_NAME, 'enlarge'))) < 20
        header = page.js('document.querySelector("header").getBoundingClientRect().height')
        assert header < 100
    finally:
        page.driver.execute_cdp_cmd('Emulation.clearDeviceMetricsOverride', {})


@pytest.mark.slow
def test_a_moment_is_marked_from_the_page(page: Page, serve: Callable[..., Serving]) -> None:
    serving = serve()
    serving.give(0, 200)
    page.open(serving.url)
    page.until('document.body.dataset.rows >= 200')
    page.driver.find_element(By.ID, 'mark_text').send_keys('bumped it\n')
    page.until('document.getElementById("notice").textContent === "mark: bumped it"')
    # Without words it has a number, which the marks that are there do not have.
    serving.feed.put(Mark(START_NS + 100 * BLOCK_NS, 'mark 1'))
    serving.give(200, 20)
    page.until('document.body.dataset.rows >= 220')
    page.driver.find_element(By.ID, 'mark').click()
    page.until('document.getElementById("notice").textContent === "mark: mark 2"')
    assert serving.shown.marks == ['bumped it', 'mark 2']
    assert page.complaints() == []


@pytest.mark.slow
def test_a_load_is_noted_since_the_last_step_and_takes_a_decimal_comma(
    page: Page, serve: Callable[..., Serving]
) -> None:
    serving = serve()
    serving.give(0, 20)
    page.open(serving.url)
    page.until('document.body.dataset.rows >= 20')
    page.driver.find_element(By.ID, 'load').click()
    page.until('document.getElementById("since_step").textContent.startsWith("since the last step (")')
    page.driver.find_element(By.ID, 'since_step').click()
    page.until('Number(document.getElementById("ago").value) >= 3.4')
    page.driver.find_element(By.CSS_SELECTOR, '#weigh button[value=set]').click()
    page.until('document.getElementById("notice").textContent === "load noted"')
    (ago,) = serving.shown.agos
    assert ago is not None
    assert ago > 3.4
    # Without a step that is known there is no such button.
    serving.shown.stepped = ''
    page.driver.find_element(By.ID, 'load').click()
    page.until('document.getElementById("weigh").open && document.getElementById("since_step").hidden')
    assert page.js('document.getElementById("ago").value') == '0'
    page.driver.find_element(By.ID, 'weigh_cancel').click()
    page.driver.find_element(By.ID, 'load').click()
    page.until('document.getElementById("weigh").open')
    fields = [page.driver.find_element(By.ID, name) for name in ('fx', 'fy')]
    # Three digits may be thousands; the browser keeps the dialog open and names the field.
    for typed in ('1,500', '1.000,5', '1e-', ''):
        fields[1].clear()
        fields[1].send_keys(typed + Keys.ENTER)
        page.until('document.querySelector("#fy:invalid") && document.getElementById("weigh").open')
    for field, typed in zip(fields, (' +.5', '-1,5'), strict=True):
        field.clear()
        field.send_keys(typed)
    page.driver.execute_script('document.getElementById("notice").textContent = ""')
    page.driver.find_element(By.CSS_SELECTOR, '#weigh button[value=set]').click()
    page.until('document.getElementById("notice").textContent === "load noted"')
    assert serving.shown.loads[1:] == [(0.5, -1.5, 0.0, False)]
    assert page.complaints() == []


WARM_BLOCKS = 75_600
"""Until then the engine compiles and recompiles what runs often: 150 kB more than after 36 000 blocks, 20 kB less than
after 144 000."""
HALF_HOUR_BLOCKS = 91_800
"""50 blocks a second for half an hour. The arrays of twice 3000 rows are filled to row 3600 before and to row 5400
after it, so that a heap that follows them is seen."""


@pytest.mark.slow
def test_half_an_hour_leaves_the_heap_as_it_was(page: Page, serve: Callable[..., Serving]) -> None:
    serving = serve()
    look_on, connections = serving.server.look_on, 0

    def counting(*given: Any, **named: Any) -> Any:
        nonlocal connections
        connections += 1
        return look_on(*given, **named)

    serving.server.look_on = counting  # type: ignore[method-assign]
    page.open(serving.url)
    given = 0

    def give_until(count: int) -> None:
        nonlocal given
        while given < count:
            # Some are short, so that losses are drawn too.
            serving.give(given, 1790)
            serving.give(given + 1790, 10, lost=1)
            serving.server.notify(f'{given} blocks')
            given += 1800
            page.quietly_until_rows(given)

    for number in range(100):
        serving.server.notify(f'message {number}')
    give_until(WARM_BLOCKS)
    nodes = page.nodes()
    heap = page.heap_bytes()
    give_until(WARM_BLOCKS + HALF_HOUR_BLOCKS)
    grown = page.heap_bytes() - heap
    print(f'heap {heap / 1e6:.2f} MB after {WARM_BLOCKS} blocks, {grown / 1e3:+.0f} kB after {HALF_HOUR_BLOCKS} more')
    # A row that stayed would be 170 bytes, these blocks' 15 MB; a number alone would be 1 MB.
    assert grown < 200_000
    # A browser that is starved for ten seconds connects again, and gets the last minute once more.
    assert page.rows() == WARM_BLOCKS + HALF_HOUR_BLOCKS or connections > 1
    assert page.nodes() == nodes
    assert serving.feed.dropped == 0
    assert page.complaints() == []


def audit(page: Page, ready: str) -> None:
    problems = []
    for view in views(page.driver):
        page.driver.refresh()
        page.until(ready)
        problems += [f'{view}: {line}' for line in violations(page.driver)]
    assert problems == []


@pytest.fixture
def shown_page(serve: Callable[..., Serving]) -> Serving:
    serving = serve(monitor_control='off')
    serving.shown.recordings.append('recordings/test')
    serving.feed.put(AppliedLoad(START_NS + 10 * BLOCK_NS, 0.0, -10.0, 0.0))
    serving.give(0, 100)
    serving.give(100, 5, lost=3)
    for number in range(50):
        serving.server.notify(f'message {number}')
    return serving


@pytest.mark.slow
def test_the_live_page(page: Page, shown_page: Serving) -> None:
    page.open(shown_page.url)
    audit(page, 'document.body.dataset.rows >= 105 && document.querySelectorAll("#entries details").length > 0')


@pytest.mark.slow
def test_the_live_page_with_all_that_opens(page: Page, shown_page: Serving) -> None:
    shown_page.give(105, 1, status=BlockStatus.LASER_LOST)
    page.open(shown_page.url)
    for what in ('weigh', 'ask'):
        page.until('document.querySelectorAll("#entries details").length > 0')
        page.js('[...document.querySelectorAll("details")].forEach((d) => { d.open = true; })')
        page.js('document.getElementById("hold").click()')
        page.js('document.querySelector("[data-series=\'4\']").click()')
        page.js(f'document.getElementById("{what}").showModal()')
        assert violations(page.driver) == []
        page.driver.refresh()
