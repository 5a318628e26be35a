"""The reader thread: what a source gives, to chunks with host times, in a bounded queue.

The reader owns the source, the sequence numbers and the clock. It hands over a
chunk as soon as a block's last sample came, so that an estimate waits for nothing. When the
consumer is too slow the newest chunk is dropped and counted; the reader never waits.

Every sample that is missing is counted once, under its cause (``lost_by``), as far as it can be
known: the device said so, frames around it were damaged, the port was away, or none of these.
"""

from __future__ import annotations

import queue
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psd_deflection.config import Rig
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.source import (
    Clock,
    Event,
    Sample,
    Source,
    SourceEndedError,
)
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import (
    BadFrame,
    BadReason,
    HelloFrame,
    PongFrame,
    SampleFrame,
    StatusFrame,
)
from psd_deflection.protocol.sequence import NEARBY, WRAP, SequenceExtender, Step
from psd_deflection.records import FLAG_DEVICE_DROPPED, IntArray, RawChunk
from psd_deflection.runner.arrivals import AWAY, BY_DEVICE, DAMAGED, UNSEEN, AcquisitionCounters, check_hello
from psd_deflection.runner.realtime import prefer_reader
from psd_deflection.timing import ClockMap, ClockState

SILENCE_S = 2.0
"""A device that sends no sample for this long is reported, and asked for samples once more."""

RETRY_S = 0.2
READ_TIMEOUT_S = 0.1
READY_S = 10.0
GIVE_UP_TIMES = 5
"""How often, a read's time apart, a reader is asked to give up waiting for its device."""

TORN_US = 50_000
"""Device time that disagrees with the sample numbers by more: the clock jumped, or the device paused."""

PING_S = (0.1, 0.4)
"""Bounds of the random time between two pings: their phase to the samples must not repeat."""

GATHER_S = 0.004
"""Longest that the reader lets samples gather: to wake costs more than a sample does."""

UNANSWERED = 20
"""A device that has left so many pings unanswered in a row does not know them: it is asked no more."""

Say = Callable[[str], None]


@dataclass(slots=True)
class Chunk:
    """A RawChunk on its way, with the monotonic time at which its last byte was read, ns."""

    raw: RawChunk
    read_ns: int


class Restarted:
    """On the queue: the device started anew; the unfinished block is all there will be of it."""


class Ended:
    """On the queue: nothing follows."""


Item = Chunk | Restarted | Ended


class Acquisition:
    """Reads one device until stopped. ``say``: told of every change of state, one line each.

    Raises ConfigError where there is no source of the name that the rig has.
    """

    def __init__(self, rig: Rig, say: Say) -> None:
        self.source: Source = make_source(rig)
        self.counters = AcquisitionCounters()
        self.hello: HelloFrame | None = None
        self.queue: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._rig = rig
        self._name = self.source.name
        self._say = say
        self._block_size = rig.estimator.block_size
        self._latency_ns = round(rig.acquisition.latency_offset * 1e9)
        self._clock = ClockMap()
        self._regressed = self.source.clock in (Clock.DEVICE, Clock.COUNTED)
        # Monotonic time is mapped to ROS time by one constant: a step of the wall clock while
        # running must not tear the stamps apart.
        self.to_ros_ns = time.time_ns() - time.monotonic_ns()
        self._sequence = SequenceExtender(self._block_size)
        self._last_t_ns = 0
        self._first_number = 0
        self._period_us = 1e6 / rig.converter.sample_rate_hz
        self._observed: tuple[int, int] | None = None
        self._previous = (-1, 0)
        self._bad_since_sample = 0
        self._was_away = False
        self._refusal = ''
        self._random = random.Random()
        self._next_ping = 0.0
        self._sent: dict[int, int] = {}
        self._unanswered = 0
        self._volts_per_count: float | None = rig.converter.volts_per_count
        self._connected = False
        self.failed: BaseException | None = None
        self.beat = time.monotonic()
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name='reader', daemon=True)
        self._seq: list[int] = []
        self._t: list[int] = []
        self._readings: list[tuple[float, ...]] = []
        self._flags: list[int] = []

    def open(self) -> None:
        """Open the source and hear the device out.

        Raises DeviceError where the port cannot be had, nothing of use comes in 2 s, or the device
        does not fit the rig.
        """
        hello = self.source.open(SILENCE_S)
        try:
            self._volts_per_count = check_hello(hello, self._rig, self._name)
        except BaseException:
            self.source.close()
            raise
        self.hello = hello
        self._name = self.source.name
        self._connected = True

    def start(self) -> None:
        """Start the reader thread; :meth:`open` came before. What comes from now on is read."""
        self._thread.start()
        self._ready.wait(READY_S)

    def stop(self) -> None:
        """Stop the reader and close the port; an Ended item is the last on the queue.

        A reader that waits for its device is told to give up; one that does not come back is left behind.
        """
        self._stop.set()
        if self._thread.ident is None:
            self.queue.put(Ended())
        else:
            self._thread.join(2.0 * READ_TIMEOUT_S)
            for _ in range(GIVE_UP_TIMES):
                if not self._thread.is_alive():
                    break
                self.source.give_up()
                self._thread.join(READ_TIMEOUT_S)
            else:
                self._say(f'{self._name}: the source hangs; it is not waited for')
                self.queue.put(Ended())
                return
        self.source.close()

    @property
    def away(self) -> bool:
        """Whether the device is waited for."""
        return not self._connected

    def clock_state(self) -> ClockState:
        """How the device's clock stands to the host's."""
        return self._clock.state()

    def system_clock_step_ns(self) -> int:
        """How far the system clock has moved against CLOCK_MONOTONIC since the start.

        Stamps do not follow it: they would tear apart. The next start takes it over.
        """
        return time.time_ns() - time.monotonic_ns() - self.to_ros_ns

    def _run(self) -> None:
        if self._rig.acquisition.realtime:
            self._say(prefer_reader())
        # Locking the memory takes its time: only what comes after it is as old as it looks.
        if self._connected:
            try:
                self.source.start()
            except DeviceError as error:
                # Pulled out since it was heard out.
                self._disconnected(error)
        self._ready.set()
        silent_since = time.monotonic()
        try:
            while not self._stop.is_set():
                self.beat = time.monotonic()
                if not self._connected:
                    if not self._stop.wait(RETRY_S):
                        self._reopen()
                    silent_since = time.monotonic()
                    continue
                try:
                    events, now, size = self.source.read(READ_TIMEOUT_S)
                    if size:
                        self.counters.bytes += size
                        if self.feed(events, now):
                            silent_since = now / 1e9
                            self._gather()
                    elif self._seq:
                        self._hand_over(now)
                    if now / 1e9 - silent_since > SILENCE_S:
                        silent_since = now / 1e9
                        self._silent(size)
                    if now / 1e9 >= self._next_ping:
                        self._ping(now)
                except DeviceError as error:
                    self._disconnected(error)
                except SourceEndedError as end:
                    self._say(f'{self._name}: {end}')
                    break
        except BaseException as error:
            self.failed = error
            raise
        finally:
            self._hand_over(time.monotonic_ns())
            self.queue.put(Ended())

    def _gather(self) -> None:
        """Let samples come before the next read; the last ones of a block are waited for one by one.

        The clock map lives on the samples that are read as they come, and the estimate waits for the last.
        """
        if not self._regressed:
            # The time of the read is the time of the sample.
            return
        to_come = -(self._previous[0] + 1) % self._block_size or self._block_size
        period_s = self._period_us / 1e6
        rest = min(GATHER_S, (to_come - 2) * period_s)
        if rest >= 2 * period_s:
            time.sleep(rest)

    def _silent(self, size: int) -> None:
        self.counters.silences += 1
        what = 'bytes but no sample (is the baud rate right?)' if size else 'no sample'
        self._say(f'{self._name}: {what} for {SILENCE_S:g} s; still listening')
        # It may have been stopped, by itself or by another program.
        self.source.wake()

    def _ping(self, now: int) -> None:
        self._next_ping = now / 1e9 + self._random.uniform(*PING_S)
        if self._unanswered >= UNANSWERED:
            return
        cookie = self._random.getrandbits(63)
        sent = time.monotonic_ns()
        if not self.source.ping(cookie):
            self._unanswered = UNANSWERED
            return
        self.counters.pings += 1
        self._unanswered += 1
        self._sent = {cookie: sent}

    def _disconnected(self, error: DeviceError) -> None:
        if self._stop.is_set():
            # Given up by us.
            return
        self.counters.disconnects += 1
        self._hand_over(time.monotonic_ns())
        self.source.close()
        self._connected = False
        self._was_away = True
        self._refusal = ''
        self._say(f'{error}; waiting for it to come back')

    def _reopen(self) -> None:
        try:
            hello = self.source.reopen()
            if hello is not None:
                # Another device on the same port must not go on as if it were the first.
                self._volts_per_count = check_hello(hello, self._rig, self.source.name)
                self.hello = hello
        except DeviceError as error:
            self.source.close()
            if self._stop.is_set():
                return
            self.counters.refused_reopenings += 1
            refusal = str(error)
            # Why it is not taken back is news once; that there is no port yet is none.
            if 'no such port' not in refusal and refusal != self._refusal:
                self._refusal = refusal
                self._say(f'{refusal}; still trying')
            return
        self._connected = True
        self._name = self.source.name
        self._bad_since_sample = 0
        if not self.source.numbered:
            self._sequence.restart()
            self._restarted()
        self._say(f'{self._name}: the device is back')

    def feed(self, events: list[Event], now: int) -> bool:
        """Sort the frames of one read at ``now`` (CLOCK_MONOTONIC, ns); True where one was a sample.

        The reader thread calls it; without one, whoever has a clock of his own may (a test, a simulation).
        """
        counters = self.counters
        good = False
        if self._regressed:
            self._observe_newest(events, now)
        for frame in events:
            if type(frame) is SampleFrame or type(frame) is Sample:
                good = True
                flags, seq, t, readings = frame
                number, step, missing = self._sequence.extend(seq, t)
                if step is not Step.NEXT and not self._unusual(number, step, missing, flags):
                    continue
                self._bad_since_sample = 0
                self._was_away = False
                if number < self._first_number:
                    continue
                if flags & FLAG_DEVICE_DROPPED:
                    counters.device_dropped += 1
                if self._regressed and self._torn(number, t):
                    # What came before the clock jumped is stamped by the map that held then.
                    self._hand_over(now)
                    self._observe(seq, t, now)
                elif self._seq and number // self._block_size != self._seq[0] // self._block_size:
                    self._hand_over(now)
                self._seq.append(number)
                self._t.append(t)
                self._readings.append(readings)
                self._flags.append(flags)
                counters.samples += 1
                if number % self._block_size == self._block_size - 1:
                    self._hand_over(now)
            elif type(frame) is BadFrame:
                reason = str(frame.reason)
                counters.bad_frames[reason] = counters.bad_frames.get(reason, 0) + 1
                self._bad_since_sample += frame.reason != BadReason.UNKNOWN_TYPE
            else:
                self._other(frame, now)
        return good

    def _observe_newest(self, events: list[Event], now: int) -> None:
        """Only the newest sample of a read says how late the line is; before any of them is stamped."""
        newest = next((e for e in reversed(events) if type(e) is SampleFrame or type(e) is Sample), None)
        if newest is None:
            return
        _, seq, t_us, _ = newest
        if self._observed is not None:
            last_seq, last_t = self._observed
            if (last_seq - seq) % WRAP < NEARBY and t_us <= last_t:
                # Repeated: it says nothing.
                return
            passed = (seq - last_seq) % WRAP * self._period_us
            if abs(t_us - last_t - passed) > TORN_US:
                # The clock may have jumped within this read: that is seen sample by sample.
                return
        self._observe(seq, t_us, now)

    def _observe(self, seq: int, t_us: int, now: int) -> None:
        passed = None
        if self._observed is not None:
            passed = (seq - self._observed[0]) % WRAP * self._period_us
        self._observed = (seq, t_us)
        if self._clock.observe(t_us, now, passed):
            self.counters.clock_jumps += 1
            self._say(f"{self._name}: the device's clock jumped; times are laid anew")

    def _torn(self, number: int, t_us: int) -> bool:
        """Whether device time does not agree with the numbers since the sample before."""
        last_number, last_t = self._previous
        self._previous = (number, t_us)
        return last_number >= 0 and abs(t_us - last_t - (number - last_number) * self._period_us) > TORN_US

    def _unusual(self, number: int, step: Step, missing: int, flags: int) -> bool:
        """Count a sample that does not simply follow; False where it is to be passed over."""
        if step is Step.FIRST:
            # What we joined in the middle of is passed over: the first block is a whole one.
            self._first_number = -(-number // self._block_size) * self._block_size
        elif step is Step.REPEAT:
            self.counters.repeated += 1
            return False
        elif step is Step.GAP:
            if self._was_away:
                cause = AWAY
            elif flags & FLAG_DEVICE_DROPPED:
                cause = BY_DEVICE
            else:
                cause = DAMAGED if self._bad_since_sample else UNSEEN
            self.counters.count_lost(missing, cause)
        elif step is Step.RESTART:
            self._restarted()
            self._say(f'{self._name}: the device started anew')
        return True

    def _restarted(self) -> None:
        self.counters.restarts += 1
        self._hand_over(time.monotonic_ns())
        self.queue.put(Restarted())

    def _other(self, frame: Event, now: int) -> None:
        if isinstance(frame, PongFrame):
            sent = self._sent.pop(frame.cookie, None)
            if sent is not None:
                self.counters.pongs += 1
                self._unanswered = 0
                if self._regressed:
                    self._clock.observe_reply(frame.t_device_us, sent, now)
        elif isinstance(frame, StatusFrame):
            self.counters.device_overruns = frame.overruns
            if frame.temperature_centi is not None:
                self.counters.temperature = frame.temperature_centi / 100.0
        elif isinstance(frame, HelloFrame) and frame != self.hello:
            try:
                self._volts_per_count = check_hello(frame, self._rig, self._name)
                self.hello = frame
            except DeviceError as error:
                self._say(f'{error}; kept to the first HELLO')

    def _hand_over(self, now: int) -> None:
        if not self._seq:
            return
        seq, t, readings, flags = self._seq, self._t, self._readings, self._flags
        self._seq, self._t, self._readings, self._flags = [], [], [], []
        t_ns = self._ros_time_ns(np.array(t, np.int64))
        # A clock laid anew may point before what was already stamped: time does not go back.
        if t_ns[0] <= self._last_t_ns or bool((t_ns[1:] <= t_ns[:-1]).any()):
            steps = np.arange(1, len(t_ns) + 1)
            t_ns = np.maximum.accumulate(np.maximum(t_ns - steps, self._last_t_ns)) + steps
        self._last_t_ns = int(t_ns[-1])
        if self.queue.qsize() >= self._rig.acquisition.queue_blocks:
            self.counters.queue_dropped += len(seq)
            return
        raw = RawChunk(
            np.array(seq, np.int64),
            t_ns,
            np.array(readings, np.float32) if self._volts_per_count is None else np.array(readings, np.int16),
            np.array(flags, np.uint8),
            self._volts_per_count,
        )
        self.queue.put(Chunk(raw, now))

    def _ros_time_ns(self, t: IntArray) -> IntArray:
        """``t``: as the source gives it."""
        if self.source.clock is Clock.RECORDED:
            return t
        host = self._clock.to_host_ns(t) if self._regressed else t
        return host + (self.to_ros_ns - self._latency_ns)
