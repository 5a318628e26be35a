# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page's own thread: an aiohttp server with the page, a websocket and its buttons; buffers of fixed size. A browser
that is too slow misses rows, and nothing waits for it."""

import asyncio
import json
import math
import os
import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any

from aiohttp import web

from psd_deflection import __version__
from psd_deflection.base import charts
from psd_deflection.base.log import INFO, LogCallback
from psd_deflection.base.plugins import optional
from psd_deflection.measure.watch import Alarm
from psd_deflection.records import (
    AppliedLoad,
    BlockStatus,
    DiagnosticReport,
    FloatArray,
    Mark,
    ParameterChange,
    ReferencePose,
    SampleBlock,
)
from psd_deflection.rig.running import MonitorConfig
from psd_deflection.run.monitor import gated, metrics
from psd_deflection.run.monitor.feed import BlockResult, Feed, mark_json, reference_json, row_columns, row_json
from psd_deflection.run.monitor.gated import HEARTBEAT_S, GatedServer
from psd_deflection.run.monitor.served import (
    MAX_AGO_S,
    SINCE_STEP,
    TOKEN_HEADER,
    TOKEN_VARIABLE,
    Served,
    announce,
    withdraw,
)
from psd_deflection.run.monitor.shown import PageCalibration, RejectedError, Shown
from psd_deflection.run.monitor.spectrum import Spectrum, density_json, line_entry
from psd_deflection.run.recorder import new_folder

HISTORY = optional('psd_deflection.run.monitor.kept_history')
"""The room that keeps the last week, or None."""
PAGE = Path(__file__).parent / 'page'

PUMP_S = 0.03
SPECTRUM_EVERY_S = 0.5
HEALTH_S = 0.9
HISTORY_S = 60.0
FRESH_S = 2.0
"""A block that came longer ago, s, is in no metrics: the device is away, and a scrape may come once a minute."""
MESSAGES = 50
MARKS = 200
"""Loads, zeros and marks that are kept."""

MAX_SEEK_S = 1e8
MAX_FORCE = 1e6
"""Largest load that is taken down, N and N m: a slip of the hand is rejected."""

HEADERS = {
    'Content-Security-Policy': "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff',
    'X-Frame-Options': 'DENY',
    'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Cache-Control': 'no-cache',
}


class MonitorServer(GatedServer):
    """Serves ``shown``, fed by ``feed``, from :meth:`start` to :meth:`close`. ``log`` gets the address as a line."""

    def __init__(self, shown: Shown, feed: Feed, config: MonitorConfig, log: LogCallback) -> None:
        super().__init__('monitor', config.address, config.port, log)
        self.token = ''
        self.url = ''
        self._shown = shown
        self._feed = feed
        self._config = config
        self._instance = secrets.token_hex(8)
        rate = shown.rig.converter.sample_rate_hz / shown.rig.estimator.block_size
        self._rows: deque[str] = deque(maxlen=max(100, round(HISTORY_S * rate)))
        self._row_count = 0
        # References may come faster than blocks: one for each block is shown.
        self._last_block: BlockResult | None = None
        self._block_came = 0.0
        self._references: deque[str] = deque(maxlen=self._rows.maxlen)
        self._reference_count = 0
        self._reference_ns: int | None = None
        self._block_ns = 1e9 / rate
        self._marks: deque[str] = deque(maxlen=MARKS)
        self._mark_count = 0
        self._alarm: Alarm | None = None
        kept_in = shown.history_file() if config.history else None
        of = shown.rig.estimator.block_size
        self._history = HISTORY and HISTORY.PageHistory(len(shown.rig.psds), of, kept_in, log)
        self._calibration = PageCalibration()
        self._messages: deque[tuple[int, float, str]] = deque(maxlen=MESSAGES)
        self._message_count = 0
        self._health: tuple[int, str] = (0, 'null')
        self._report: DiagnosticReport | None = None
        self._report_at = 0.0
        self._spectrum = Spectrum(shown.rig)
        self._density: tuple[int, str] = (0, 'null')
        self._last_density: FloatArray | None = None
        alone = gated.is_loopback(config.address)
        self._control = config.control == 'on' or (config.control == 'local' and alone)
        self._announced: Path | None = None
        if self._control and not alone:
            self.token = os.environ.get(TOKEN_VARIABLE) or secrets.token_urlsafe(16)

    def start(self) -> str:
        """Start the thread; return the page's address. Raises ConfigError if it cannot be served."""
        if self._history:
            self._history.start()
        self.url = f'http:{self.start_thread()}/'
        self._announced = announce(Served(self.url, self.token, str(self._shown.describe()['name']), os.getpid()))
        self.log(f'monitor: {self.url}' + (f'#token={self.token}' if self.token else ''))
        return self.url

    def close(self) -> None:
        """Close the connections to the browsers and end the thread; a second call does nothing."""
        withdraw(self._announced)
        super().close()
        if self._history:
            self._history.end()

    def notify(self, text: str, level: int = INFO, /) -> None:
        """Show a message on the page; from any thread."""
        self._message_count += 1
        self._messages.append((self._message_count, time.time(), text))

    def add_routes(self, application: web.Application) -> None:
        """The page, its websocket, its buttons."""
        application.router.add_get('/', self._index)
        application.router.add_get(self.websocket_path, self._websocket)
        application.router.add_get('/metrics', self._metrics)
        if self._history:
            application.router.add_get('/api/history', self._get_history)
        application.router.add_post('/api/zero', self._zero)
        application.router.add_post('/api/record', self._record)
        application.router.add_post('/api/load', self._load)
        application.router.add_post('/api/step', self._step)
        application.router.add_post('/api/mark', self._mark)
        application.router.add_post('/api/play', self._play)
        application.router.add_post('/api/calibrate', self._calibrate)
        application.on_shutdown.append(lambda _: self._calibration.close())
        application.router.add_get('/page/charts.js', self._charts)
        application.router.add_static('/page/vendor', charts.FOLDER / 'vendor')
        application.router.add_static('/page', PAGE)
        application.on_response_prepare.append(_add_headers)

    def jobs(self) -> list[Coroutine[Any, Any, None]]:
        """What comes from the run, and its health."""
        keeping = self._history.jobs() if self._history else ()
        return [self._pump(), self._once_a_second(), *keeping]

    # Data from the threads of the run.

    async def _pump(self) -> None:
        next_time = 0.0
        while True:
            new = False
            for item in self._feed.take():
                if isinstance(item, BlockResult):
                    self._rows.append(row_json(item))
                    if self._history:
                        self._history.add(item)
                    self._last_block, self._block_came = item, time.monotonic()
                    self._row_count += 1
                    new = True
                elif isinstance(item, SampleBlock):
                    self._spectrum.add(item)
                elif isinstance(item, ReferencePose):
                    new = self._take_reference(item) or new
                else:
                    self._take_mark(item)
                    new = True
            now = time.monotonic()
            if self.viewers and now >= next_time:
                next_time = now + SPECTRUM_EVERY_S
                self._last_density = self._spectrum.density()
                self._density = (self._density[0] + 1, density_json(self._last_density))
                new = True
            if new:
                self.wake()
            await asyncio.sleep(PUMP_S)

    def _take_mark(self, item: AppliedLoad | Mark | ParameterChange | Alarm) -> None:
        text = mark_json(item)
        self._marks.append(text)
        self._mark_count += 1
        if self._history:
            self._history.mark(item.since_ns if isinstance(item, Alarm) else item.t_ns, text)

    def _take_reference(self, reference: ReferencePose) -> bool:
        last = self._reference_ns
        if last is not None and 0 <= reference.t_ns - last < self._block_ns:
            return False
        self._reference_ns = reference.t_ns
        self._references.append(reference_json(reference))
        self._reference_count += 1
        return True

    async def _once_a_second(self) -> None:
        while True:
            last, self._alarm = self._alarm, self._shown.alarm()
            if self._alarm is not None and (last is None or last.observed_ns != self._alarm.observed_ns):
                self._take_mark(self._alarm)
            if self.viewers:
                self._take_health()
            await asyncio.sleep(1.0)

    def _take_health(self) -> None:
        now = time.monotonic()
        if self._report is None or now - self._report_at >= HEALTH_S:
            # A report covers the time since the last one: over a very short time it would show no samples.
            self._report, self._report_at = self._shown.health(time.time_ns()), now
        self._health = (self._health[0] + 1, self._health_json(self._report))
        self.wake()

    def _health_json(self, report: DiagnosticReport) -> str:
        entries = [
            {
                'name': e.name.removeprefix('psd_deflection: '),
                'level': e.level,
                'message': e.message,
                'values': e.values,
            }
            for e in (*report.entries, line_entry(self._shown.rig, self._spectrum.frequencies, self._last_density))
        ]
        return json.dumps(
            {
                't': report.t_ns / 1e9,
                'entries': entries,
                'dropped': self._feed.dropped,
                'browsers': len(self.viewers),
                'sum_min': self._shown.rig.estimator.sum_min,
                'calibration': self._calibration.state,
                **self._shown.describe(),
            }
        )

    # Requests of browsers.

    async def _index(self, request: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / 'index.html')

    async def _charts(self, request: web.Request) -> web.StreamResponse:
        return web.FileResponse(charts.CHARTS)

    async def _metrics(self, request: web.Request) -> web.StreamResponse:
        families = self._shown.metrics()
        families.append(metrics.counter('page_dropped', 'Items for which the page was too slow', self._feed.dropped))
        if self._history:
            families.append(metrics.memory('page_history_bytes', 'Memory of the history', self._history.bytes))
        if self._last_block is not None and time.monotonic() - self._block_came < FRESH_S:
            families += metrics.of_block(self._last_block)
        return web.Response(text=metrics.text_of(families), headers={'Content-Type': metrics.CONTENT_TYPE})

    async def _get_history(self, request: web.Request) -> web.StreamResponse:
        try:
            return web.Response(text=self._history.answer(request.query), content_type='application/json')
        except ValueError as error:
            return _answer(400, f'rejected: {error}')

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        # A browser that does not read for this long is gone.
        # Not compressed: aiohttp compresses long messages in a separate task, which outlives a browser that has left.
        browser = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=1024, compress=False)
        history = request.query.get('history') != '0'

        async def send(browser: web.WebSocketResponse, event: asyncio.Event) -> None:
            self._take_health()
            await self._send(browser, event, history)

        return await self.look_on(request, browser, send)

    async def _send(self, browser: web.WebSocketResponse, event: asyncio.Event, history: bool) -> None:
        rows = self._row_count - (len(self._rows) if history else 0)
        marks = references = messages = health = density = 0
        await browser.send_str(json.dumps({'hello': self._hello()}))
        while True:
            parts = []
            if (new := min(self._row_count - rows, len(self._rows))) > 0:
                rows = self._row_count
                parts.append('"rows":[' + ','.join([self._rows[i] for i in range(-new, 0)]) + ']')
            if (new := min(self._mark_count - marks, len(self._marks))) > 0:
                marks = self._mark_count
                parts.append('"marks":[' + ','.join([self._marks[i] for i in range(-new, 0)]) + ']')
            if (new := min(self._reference_count - references, len(self._references))) > 0:
                references = self._reference_count
                parts.append('"references":[' + ','.join([self._references[i] for i in range(-new, 0)]) + ']')
            if self._message_count > messages:
                reported = [m for m in tuple(self._messages) if m[0] > messages]
                messages = self._message_count
                parts.append('"messages":' + json.dumps([m[1:] for m in reported]))
            if self._health[0] > health:
                health, text = self._health
                parts.append('"health":' + text)
            if self._density[0] > density:
                density, text = self._density
                parts.append('"spectrum":' + text)
            if parts:
                await browser.send_str('{' + ','.join(parts) + '}')
            await event.wait()
            event.clear()

    def _hello(self) -> dict[str, Any]:
        rig = self._shown.rig
        frequencies = self._spectrum.frequencies
        return {
            'instance': self._instance,
            'version': __version__,
            'columns': row_columns(len(rig.psds)),
            'statuses': [s.name.lower().replace('_', ' ') for s in BlockStatus],
            'history_s': HISTORY_S,
            'rows': self._rows.maxlen,
            'block_s': rig.estimator.block_size / rig.converter.sample_rate_hz,
            'block_size': rig.estimator.block_size,
            'sample_rate_hz': rig.converter.sample_rate_hz,
            'active_areas': [psd.active_area for psd in rig.psds],
            'sum_nominal': rig.amplifier.sum_nominal,
            'sum_min': rig.estimator.sum_min,
            'modes': [['bending', rig.dynamics.bending_frequency], ['torsion', rig.dynamics.torsion_frequency]],
            'frequency': [frequencies[0], len(frequencies)],
            'spectrum_s': self._spectrum.seconds,
            'solver': rig.estimator.solver,
            'control': self._control,
            'why_no_control': '' if self._control else self._why_no_control(),
            'needs_token': bool(self.token),
            **self._shown.describe(),
        }

    def _why_no_control(self) -> str:
        if self._config.control == 'off':
            return 'the buttons are switched off (parameter monitor_control)'
        return (
            'the buttons are off because the network can reach this page; the parameter monitor_control:=on, or '
            '`psd-deflection monitor --control`, allows them to whoever has the token'
        )

    async def _zero(self, request: web.Request) -> web.StreamResponse:
        def zero(body: dict[str, Any]) -> Awaitable[str]:
            _need(body.keys() <= {'late'}, '{"late": s}')
            return asyncio.to_thread(self._shown.zero, _late(body))

        return await self._act(request, 'zero', zero)

    async def _record(self, request: web.Request) -> web.StreamResponse:
        def record(body: dict[str, Any]) -> Awaitable[str]:
            # Nothing is recorded unless it was asked for in so many words.
            wanted = body.get('record')
            _need(isinstance(wanted, bool), '{"record": true} or {"record": false}')
            return self._shown.record(bool(wanted))

        return await self._act(request, 'record', record)

    async def _calibrate(self, request: web.Request) -> web.StreamResponse:
        async def calibrate(body: dict[str, Any]) -> str:
            wanted = body.get('calibrate')
            _need(isinstance(wanted, bool), '{"calibrate": true} or {"calibrate": false}')
            if not wanted:
                return self._calibration.stop()
            if self._shown.describe()['kind'] == 'replay':
                raise RejectedError('a recording is played; psd-deflection calibrate takes it')
            parent = Path(self._shown.rig.acquisition.bag_dir).expanduser().absolute()
            out = new_folder(parent, 'calibration')
            return await self._calibration.start(self.url, TOKEN_VARIABLE, self.token, out)

        return await self._act(request, 'calibrate', calibrate)

    async def _load(self, request: web.Request) -> web.StreamResponse:
        def load(body: dict[str, Any]) -> Awaitable[str]:
            values: list[Any] = [body.get(name) for name in ('fx', 'fy', 'tz')]
            add, ago, late = body.get('add', False), body.get('ago', 0.0), _late(body)
            _need(
                all(map(_is_number, values)) and isinstance(add, bool) and (ago == SINCE_STEP or _is_number(ago)),
                f'{{"fx": N, "fy": N, "tz": N m, "add": false, "ago": s or "{SINCE_STEP}", "late": s}}',
            )
            for name, value, unit in zip(('Fx', 'Fy', 'Tz'), values, ('N', 'N', 'N·m'), strict=True):
                if abs(value) > MAX_FORCE:
                    raise _BadBodyError(f'not noted: {name} of more than {MAX_FORCE:g} {unit}')
            if ago != SINCE_STEP and not 0.0 <= ago <= MAX_AGO_S:
                raise _BadBodyError(f'not noted: a load has hung for 0 to {MAX_AGO_S:g} s when it is noted')
            fx, fy, tz = map(float, values)
            ago_s = None if ago == SINCE_STEP else float(ago)
            return asyncio.to_thread(self._shown.load, fx, fy, tz, add, ago_s, late)

        return await self._act(request, 'load', load)

    async def _step(self, request: web.Request) -> web.StreamResponse:
        def step(body: dict[str, Any]) -> Awaitable[str]:
            _need(not body, '{}')
            return asyncio.to_thread(self._shown.step)

        return await self._act(request, '', step)

    async def _mark(self, request: web.Request) -> web.StreamResponse:
        def mark(body: dict[str, Any]) -> Awaitable[str]:
            text, late = body.get('text'), _late(body)
            _need(isinstance(text, str), '{"text": "what happened", "late": s}')
            return asyncio.to_thread(self._shown.mark, str(text), late)

        return await self._act(request, '', mark)

    async def _play(self, request: web.Request) -> web.StreamResponse:
        def play(body: dict[str, Any]) -> Awaitable[str]:
            paused, seek = body.get('paused'), body.get('seek')
            good = (paused is None or isinstance(paused, bool)) and (seek is None or _is_number(seek))
            good = good and (seek is None or 0.0 <= seek <= MAX_SEEK_S) and (paused, seek) != (None, None)
            _need(good, '{"paused": true} or {"seek": SECONDS}')
            return asyncio.to_thread(self._shown.play, paused, seek)

        return await self._act(request, '', play)

    async def _act(
        self, request: web.Request, name: str, action: Callable[[dict[str, Any]], Awaitable[str]]
    ) -> web.StreamResponse:
        """Carry out ``action`` with the body of ``request``, if it is allowed; ``name`` is said, unless it is ''."""
        if not self._control:
            return _answer(403, f'rejected: {self._why_no_control()}')
        if self.token and not gated.is_token(request.headers.get(TOKEN_HEADER), self.token):
            return _answer(401, 'rejected: the token is missing or wrong; the address printed at the start has it')
        # A type that a form of another site cannot send.
        if request.content_type != 'application/json':
            return _answer(415, 'rejected: Content-Type must be application/json')
        try:
            body = json.loads(await request.read() or b'{}')
        except (ValueError, RecursionError):
            return _answer(400, 'rejected: not JSON')
        try:
            _need(isinstance(body, dict), 'a JSON object')
            text = await action(body)
        except _BadBodyError as error:
            return _answer(400, str(error))
        except RejectedError as error:
            return _answer(409, str(error))
        if name:
            # What came of it is told by the run itself.
            self.log(f'monitor: {name} was asked for by {request.remote}')
        if self.viewers:
            self._take_health()
        return _answer(200, text)


class _BadBodyError(Exception):
    """The body of a request is not what it should be; the message says so."""


def _need(good: bool, expected: str) -> None:
    if not good:
        raise _BadBodyError(f'rejected: expected {expected}')


def _late(body: Mapping[str, Any]) -> float:
    """For how long the request was under way already, s: from the click or the start of the command."""
    late = body.get('late', 0.0)
    _need(_is_number(late) and 0.0 <= late <= MAX_AGO_S, f'"late": 0 to {MAX_AGO_S:g} s')
    return float(late)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    # An integer may be too large for a float.
    return abs(value) < math.inf


def _answer(status: int, text: str) -> web.Response:
    return web.json_response({'ok': status == 200, 'message': text}, status=status)


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
