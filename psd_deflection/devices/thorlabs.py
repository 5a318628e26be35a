# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A pair of Thorlabs KPA101/TQD001, one per PSD, asked at once in slots of ``converter.sample_rate_hz`` up to the rate
that is measured at the start. A sample's time is half-way between question and answer; a slot without one is a lost
sample."""

from __future__ import annotations

import contextlib
import math
import select
import threading
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices.device import OUTPUT_LIMIT, Answer, Device, PowerUp, Probe
from psd_deflection.devices.port import OpenPort
from psd_deflection.devices.port_source import reject_datagrams
from psd_deflection.devices.ports import open_port
from psd_deflection.devices.protocol.apt import (
    DEVICE_ADDRESS,
    FULL_SCALE,
    HOST_ADDRESS,
    INFO_REQUEST,
    READINGS_REQUEST,
    SUM_VOLTS,
    AptDecoder,
    AptMessage,
    HardwareInfo,
    QuadrantReadings,
    encode_info,
    encode_readings,
)
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, BadFrame, HelloFrame
from psd_deflection.devices.source import Clock, Event, Received, Sample, Source
from psd_deflection.records import CHANNELS
from psd_deflection.rig.config import Rig

if TYPE_CHECKING:
    from psd_deflection.devices.rig_feed import RigFeed

BAUD = 115_200
ANSWER_S = 0.1
"""An answer that takes longer is given up; the devices take about 2 ms."""

POLL_S = 0.5e-3
"""How often a port without a descriptor is asked whether its answer has come."""

TRIAL = 50
HEADROOM = 0.8
"""Share of the rate measured at the start that may be asked for."""

SECOND_NS = 1_000_000_000
ANSWER_NS = 2_100_000
"""How long a simulated aligner takes to answer, as real ones do."""

IDLE_NS = 20_000_000


class ThorlabsPair(Source):
    """``source: thorlabs``; ``port`` names two ports separated by a comma, PSD 1 first."""

    clock = Clock.HOST
    volts = True

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        self._names = [n.strip() for n in self.name.split(',')]
        if len(self._names) != 2 or not all(self._names) or self._names[0] == self._names[1]:
            raise ConfigError(
                f'source = thorlabs: port = {self.name!r}: two ports are needed, PSD 1 first, with a comma between: '
                '/dev/ttyUSB0,/dev/ttyUSB1'
            )
        reject_datagrams('thorlabs', *self._names)
        self._rate = rig.converter.sample_rate_hz
        self._period_ns = round(SECOND_NS / self._rate)
        # Two independent drivers found that x has the opposite sign; here a parameter sets it.
        self._x_sign = rig.acquisition.thorlabs_x_sign
        if abs(self._x_sign) != 1.0:
            raise ConfigError(f'thorlabs.x_sign = {self._x_sign:g}: must be 1 or -1')
        self._ports: list[OpenPort] = []  # Bound: two ports.
        self._given_up = threading.Event()
        self._decoders = [AptDecoder(), AptDecoder()]
        self._origin_ns: int | None = None
        self._slot = -1
        self._reach = 0.0
        self._taken = 0
        self._first_ns = self._last_ns = 0
        self._models = ('?', '?')

    def open(self, timeout: float) -> HelloFrame:
        """Open both, read their hardware info, and measure how many readings per second they give."""
        try:
            for name in self._names:
                self._ports.append(open_port(name, BAUD, rtscts=True, given_up=self._given_up))
            infos = [self._identify(number, timeout) for number in range(2)]
            self._models = (infos[0].model, infos[1].model)
            self._reach = self._measure()
        except BaseException:
            self.close()
            raise
        if self._rate > HEADROOM * self._reach:
            self.close()
            raise DeviceError(
                f'{self.name}: the pair gives {self._reach:.0f} readings/s, converter.sample_rate_hz = {self._rate:g} '
                f'is out of reach; set it to at most {_floor(HEADROOM * self._reach)}, and block_size with it'
            )
        return HelloFrame(
            PROTOCOL_VERSION,
            {
                'serial': f'{infos[0].serial},{infos[1].serial}',
                'firmware': f'Thorlabs {infos[0].model} {infos[0].firmware}, {infos[1].model} {infos[1].firmware}',
                'sample_rate_hz': self._rate,
                'channels': list(CHANNELS),
                'volts_per_count': None,
                'sample_times': 'of the host',
            },
        )

    def _identify(self, number: int, timeout: float) -> HardwareInfo:
        port, decoder = self._ports[number], self._decoders[number]
        deadline = time.monotonic() + timeout
        received = 0
        port.write(INFO_REQUEST)
        while (remaining := deadline - time.monotonic()) > 0:
            piece = port.read(remaining)
            received += len(piece)
            for message in decoder.feed(piece):
                if isinstance(message, HardwareInfo):
                    return message
        raise DeviceError(
            f'{self._names[number]}: {"nothing" if not received else f"{received} bytes but no hardware info"} '
            f'in {timeout:g} s; is it a KPA101 or TQD001, powered, and not open in Kinesis?'
        )

    def _measure(self) -> float:
        good = 0
        started = time.monotonic_ns()
        for _ in range(TRIAL):
            first, second, _, _ = self._ask([])
            good += first is not None and second is not None
        if good < TRIAL // 2:
            raise DeviceError(f'{self.name}: {good} of {TRIAL} readings were answered; are the cables good?')
        return good / ((time.monotonic_ns() - started) * 1e-9)

    def _ask(self, events: list[Event]) -> tuple[QuadrantReadings | None, QuadrantReadings | None, int, int]:
        """Return both readings, the time half-way and the number of bytes; malformed data go to ``events``."""
        asked = time.monotonic_ns()
        for port, decoder in zip(self._ports, self._decoders, strict=True):
            port.discard_input()
            decoder.reset()
            port.write(READINGS_REQUEST)
        readings: list[QuadrantReadings | None] = [None, None]
        size = 0
        deadline = asked + round(ANSWER_S * 1e9)
        while None in readings and (remaining := deadline - time.monotonic_ns()) > 0:
            waiting = [p for p, f in zip(self._ports, readings, strict=True) if f is None]
            _await(waiting, remaining * 1e-9)
            for number, port in enumerate(self._ports):
                if readings[number] is None:
                    piece = port.read(0.0)
                    size += len(piece)
                    readings[number] = _reading(self._decoders[number].feed(piece), events)
        now = time.monotonic_ns()
        for decoder, reading in zip(self._decoders, readings, strict=True):
            left_over = decoder.reset()
            if reading is None:
                events.append(BadFrame('no answer in time', left_over))
        return readings[0], readings[1], (asked + now) // 2, size

    def start(self) -> None:
        """Begin the first slot now. After a reconnection the slots continue, so that the gap is detected."""
        if self._origin_ns is None:
            self._origin_ns = time.monotonic_ns()

    def read(self, timeout: float) -> Received:
        """Wait for the next slot, ask both devices, and return the sample of that slot."""
        origin = self._origin_ns or 0
        now = time.monotonic_ns()
        slot = max(self._slot + 1, (now - origin) // self._period_ns)
        wait = origin + slot * self._period_ns - now
        if wait > timeout * 1e9:
            time.sleep(timeout)
            return Received([], time.monotonic_ns(), 0)
        if wait > 0:
            time.sleep(wait * 1e-9)
        self._slot = slot
        events: list[Event] = []
        first, second, t_ns, size = self._ask(events)
        if first is None or second is None:
            pass
        elif (t_ns - origin) // self._period_ns != slot:
            # The next slot began between question and answer: the sample belongs to neither.
            events.append(BadFrame('answered too late for its slot', size))
        else:
            sign = self._x_sign
            values = (sign * first.x, first.y, first.total, sign * second.x, second.y, second.total)
            events.append(Sample(0, slot % 2**32, t_ns, values))
            self._first_ns = self._first_ns or t_ns
            self._last_ns = t_ns
            self._taken += 1
        return Received(events, time.monotonic_ns(), max(size, 1))

    def give_up(self) -> None:
        """Stop waiting for the devices."""
        self._given_up.set()

    def close(self) -> None:
        """Give both ports back."""
        for port in self._ports:
            port.close()
        self._ports = []
        for decoder in self._decoders:
            decoder.reset()

    def describe(self) -> Mapping[str, str]:
        """Models, requested and reached rate, and the kind of the times."""
        passed = (self._last_ns - self._first_ns) * 1e-9
        done = f'{(self._taken - 1) / passed:.1f}' if passed > 0 else 'not yet known'
        return {
            'source': f'Thorlabs {self._models[0]} and {self._models[1]} on {self.name}, polled',
            'rate asked for (1/s)': f'{self._rate:g}',
            'rate within reach at start (1/s)': f'{self._reach:.0f}',
            'rate done (1/s)': done,
            'sample numbers': 'slots of the host; a slot without an answer is a lost sample',
            'sample times': 'of the host, half-way between question and answer',
        }


def _await(ports: Sequence[OpenPort], seconds: float) -> None:
    """Wait for bytes on one of ``ports``; if one has no descriptor, only until it is to be asked again."""
    descriptors = [fd for port in ports if (fd := port.fileno()) is not None]
    if len(descriptors) == len(ports):
        select.select(descriptors, (), (), seconds)
    else:
        time.sleep(min(seconds, POLL_S))


def _reading(messages: list[AptMessage], events: list[Event]) -> QuadrantReadings | None:
    latest = None
    for message in messages:
        if isinstance(message, QuadrantReadings):
            latest = message
        elif isinstance(message, BadFrame):
            events.append(message)
    return latest


def _floor(rate: float) -> str:
    """The rate rounded down to two digits, which are easy to type."""
    digits = 10.0 ** (math.floor(math.log10(max(rate, 1.0))) - 1)
    with contextlib.suppress(OverflowError):
        return f'{math.floor(rate / digits) * digits:g}'
    return f'{rate:g}'


class SharedRig:
    """One rig that two devices measure, each from its own thread; it advances with their time."""

    def __init__(self, feed: RigFeed) -> None:
        self._feed = feed
        self._rate = feed.rig.converter.sample_rate_hz
        self._volts = feed.rig.converter.volts_per_count
        self._lock = threading.Lock()

    def volts(self, since_power_up_ns: int, psd: int) -> tuple[float, float, float]:
        """x, y and sum of one PSD as the rig's amplifier would give them, V."""
        with self._lock:
            row = self._feed.at(int(since_power_up_ns * 1e-9 * self._rate))
        x, y, total = row[3 * psd - 3 : 3 * psd]
        return x * self._volts, y * self._volts, total * self._volts


class SimulatedAligner:
    """One KPA101. ``psd``: 1 or 2."""

    def __init__(self, shared: SharedRig, psd: int, *, answer_ns: int = ANSWER_NS) -> None:
        self._shared = shared
        self._psd = psd
        self._serial = 69_000_000 + psd
        self._answer_ns = answer_ns
        self._input = b''
        self._queue: list[tuple[int, bytes]] = []  # Bound: the simulated device: two answers a poll.

    def greeting(self) -> bytes:
        """Nothing: the device only answers questions."""
        return b''

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next answer goes out."""
        return self._queue[0][0] - since_power_up_ns if self._queue else IDLE_NS

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Accept questions; the answers come later, through :meth:`take`."""
        self._input = (self._input + received)[-256:]
        while len(self._input) >= 6:
            if self._input[4] != DEVICE_ADDRESS or self._input[5] != HOST_ADDRESS:
                self._input = self._input[1:]
                continue
            question, self._input = self._input[:6], self._input[6:]
            at = since_power_up_ns + self._answer_ns
            if question == READINGS_REQUEST:
                x, y, total = self._shared.volts(since_power_up_ns, self._psd)
                # The device gives differences, not quotients.
                scale = total / FULL_SCALE * 32767.0 / 10.0
                sum_count = min(max(round(total / SUM_VOLTS), 0), 65535)
                self._queue.append((at, encode_readings(_int16(x * scale), _int16(y * scale), sum_count)))
            elif question == INFO_REQUEST:
                self._queue.append((at, encode_info(self._serial, 'KPA101')))
        return b''

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """The answers that are due."""
        out = b''
        while self._queue and self._queue[0][0] <= since_power_up_ns:
            out += self._queue.pop(0)[1]
        return out[:room]


def _int16(value: float) -> int:
    return min(max(round(value), -32768), 32767)


class AlignerProbe:
    """Recognises the hardware info of one aligner."""

    promising = False

    def __init__(self, baud: int) -> None:
        self._decoder = AptDecoder()

    def feed(self, piece: bytes) -> Answer | None:
        """Which aligner answers."""
        for message in self._decoder.feed(piece):
            if isinstance(message, HardwareInfo):
                return Answer(f'Thorlabs {message.model} {message.serial}, firmware {message.firmware}')
        return None


def _simulate(feed: RigFeed, power_up: PowerUp) -> Sequence[SimulatedAligner]:
    del power_up
    shared = SharedRig(feed)
    return [SimulatedAligner(shared, psd) for psd in (1, 2)]


DEVICE = Device(
    'thorlabs',
    'a pair of Thorlabs KPA101 or TQD001, two ports',
    ThorlabsPair,
    _simulate,
    Probe(
        AlignerProbe,
        INFO_REQUEST,
        # It cannot detect a question in another protocol.
        first=True,
        ports=2,
        together={'converter.sample_rate_hz': 200.0, 'block_size': 10, 'min_samples': 5},
    ),
)
