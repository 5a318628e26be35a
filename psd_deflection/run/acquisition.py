# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reader thread owns source, sequence numbers and clock, and puts chunks with host times on a bounded queue, each
as soon as its block is complete. It never waits; every missing sample is counted once, under its cause."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import ERROR, INFO, WARNING, LogCallback
from psd_deflection.base.sequence import SequenceExtender, Step
from psd_deflection.devices.protocol.frames import BadFrame, BadReason, HelloFrame, PongFrame, SampleFrame, StatusFrame
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.source import Clock, Event, Notice, Sample, Source, SourceEndedError
from psd_deflection.measure.timing import ClockState
from psd_deflection.records import (
    CLOCK_SQUEEZED,
    CLOCK_STEP,
    FLAG_DEVICE_DROPPED,
    RESTART,
    IntArray,
    ParameterChange,
    RawChunk,
)
from psd_deflection.rig.config import Rig
from psd_deflection.run.arrivals import (
    AWAY,
    BY_DEVICE,
    DAMAGED,
    UNSEEN,
    AcquisitionCounters,
    Annotation,
    Arrival,
    Ended,
    ItemQueue,
    Restarted,
    SampleBuffer,
)
from psd_deflection.run.clock_watch import ClockWatch
from psd_deflection.run.hello import AnotherDeviceError, HelloGate, Pinger
from psd_deflection.run.rate_limited_log import RateLimitedLog
from psd_deflection.run.realtime import SLOW, prefer_reader

SILENCE_S = 2.0
"""A device that sends no sample for this long is reported, and asked for samples again."""

RETRY_S = 0.2
"""Pause between two tries to reopen a device that is away."""

READ_TIMEOUT_S = 0.1
READY_S = 10.0
GIVE_UP_TIMES = 5
"""Number of give_up() calls at stop, READ_TIMEOUT_S apart."""

NEWS = 3
"""Events of one kind that are reported one by one, before they are counted and told together."""

RECORDED_RESTARTS = 10_000
"""Restarts of one run that are recorded, and steps of its time map: a device that does nothing else must not fill the
disk."""

MAP_STEP_NS = 1_000_000
"""A step of the time map from here on is logged and recorded."""

GATHER_S = 0.018
GATHER_SAMPLES = 36
"""Longest time that the reader lets samples gather, and most samples: waking up costs more than
reading a sample. The kernel holds 4096 bytes for us."""


class Acquisition:
    """Reads one device until stopped. ``log`` gets one line for every change of state.

    For every thread: ``source``, ``counters``, ``hello``, ``queue``, ``to_ros_ns``. ``why_full``:
    asked why the queue is full, by the reader thread. Of the reader thread: ``beat`` (monotonic
    time, s, of its last round), ``failed`` (the error that ended it). Raises ConfigError if the rig
    names an unknown source.
    """

    def __init__(self, rig: Rig, log: LogCallback) -> None:
        self.source: Source = make_source(rig)
        self.counters = AcquisitionCounters()
        self.queue = ItemQueue()
        self.why_full: Callable[[], str] = lambda: SLOW
        # Monotonic time is mapped to ROS time by one constant: a step of the wall clock while
        # running must not tear the stamps apart.
        self.to_ros_ns = time.time_ns() - time.monotonic_ns()
        self.beat = time.monotonic()
        self.failed: BaseException | None = None

        # Values from the rig.
        self._rig = rig
        self._name = self.source.name
        self._log = log
        self._limited_log = RateLimitedLog(log)
        self._gate = HelloGate(rig)
        self._block_size = rig.estimator.block_size
        self._period_us = 1e6 / rig.converter.sample_rate_hz
        self._latency_ns = round(rig.acquisition.latency_offset * 1e9)

        # Numbers and times of samples.
        # A device with a clock of its own: it confirms how much is missing.
        confirmed = self.source.clock is Clock.DEVICE
        self._sequence = SequenceExtender(self._block_size, self._period_us if confirmed else 0.0)
        self._clock = ClockWatch(self._period_us, regressed=self.source.clock in (Clock.DEVICE, Clock.COUNTED))
        self._pinger = Pinger()

        # The stream: the first number that is taken, the last one that was, the last stamp that was
        # given, ns.
        self._buffer = SampleBuffer()
        self._first_number = 0
        self._last_number = -1
        self._last_t_ns = 0
        # Samples whose stamps were raised since the last that was not; how often that was.
        self._squeezed = self._squeezes = 0

        # What tells the cause of the next gap.
        self._bad_since_sample = 0
        self._was_away = False

        # Bad frames of each reason when a silence was last told.
        self._bad_reported: dict[str, int] = {}

        # The connection: whether there is one, and why the last try to have it back failed.
        self._connected = False
        self._rejection = ''

        self._stop = threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name='reader', daemon=True)

    def open(self) -> None:
        """Open the source and wait for its HELLO.

        Raises DeviceError if the port cannot be opened, nothing valid arrives in 2 s, or the device
        does not fit the rig.
        """
        hello = self.source.open(SILENCE_S)
        try:
            self._gate.take(hello, self.source.name, volts=self.source.volts)
        except BaseException:
            self.source.close()
            raise
        self._name = self.source.name
        self._connected = True

    def start(self) -> None:
        """Start the reader thread, after :meth:`open`. Samples that arrive from now on are read."""
        self._thread.start()
        self._ready.wait(READY_S)

    def stop(self) -> None:
        """Stop the reader and close the port; an Ended item is the last on the queue.

        A source that waits for its device is asked to give up; a reader thread that still hangs is
        abandoned.
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
                self._log(f'{self._name}: the source hangs; it is not waited for', WARNING)
                self.queue.put(Ended())
                return
        self.source.close()

    def abandon(self) -> int:
        """Take what waits off the queue, after :meth:`stop`: nobody will process it. Returns its number of samples."""
        samples = 0
        with contextlib.suppress(queue.Empty):
            while True:
                item = self.queue.get()
                samples += len(item.raw.seq) if isinstance(item, Arrival) else 0
        self.queue.put(Ended())
        self.counters.abandoned += samples
        return samples

    @property
    def hello(self) -> HelloFrame | None:
        """The device's last HELLO that was taken, None before the first."""
        return self._gate.hello

    @property
    def away(self) -> bool:
        """Whether the run waits for the device to come back."""
        return not self._connected

    def clock_state(self) -> ClockState:
        """Offset and rate of the device's clock against the host's."""
        return self._clock.state()

    def now_ns(self) -> int:
        """Now, in the time of the stamps: a step of the system clock does not change it, ns."""
        return time.monotonic_ns() + self.to_ros_ns

    def system_clock_step_ns(self) -> int:
        """How far the system clock has moved against CLOCK_MONOTONIC since the start, ns.

        Stamps do not follow it, because time would jump within a recording. The next start uses the
        new time.
        """
        return time.time_ns() - self.now_ns()

    def _run(self) -> None:
        if self._rig.acquisition.realtime:
            self._log(prefer_reader())
        # Locking the memory takes its time: only what comes after it is as old as it looks.
        if self._connected:
            try:
                self.source.start()
            except DeviceError as error:
                # Unplugged since its HELLO.
                self._disconnected(error)
        self._ready.set()
        silent_since = time.monotonic()
        try:
            while not self._stop.is_set():
                self.beat = time.monotonic()
                self._limited_log.settle(self.beat)
                if not self._connected:
                    if not self._stop.wait(RETRY_S):
                        self._reopen()
                    silent_since = time.monotonic()
                    continue
                try:
                    events, now, size = self.source.read(READ_TIMEOUT_S)
                    if events or size:
                        self.counters.bytes += size
                        if self.feed(events, now):
                            silent_since = now / 1e9
                            self._gather()
                    elif self._buffer.seq:
                        self._enqueue(now)
                    if now / 1e9 - silent_since > SILENCE_S:
                        silent_since = now / 1e9
                        self._silent(size, now)
                    if self._pinger.is_due(now / 1e9):
                        self.counters.pings += self._pinger.ask(self.source, now / 1e9, time.monotonic_ns())
                except DeviceError as error:
                    self._disconnected(error)
                except SourceEndedError as end:
                    self._log(f'{self._name}: {end}')
                    break
        except BaseException as error:
            self.failed = error
            raise
        finally:
            self._enqueue(time.monotonic_ns())
            self.queue.put(Ended())

    def _gather(self) -> None:
        """Let samples gather before the next read; the last ones of a block are waited for one by one.

        The clock map needs samples and answers to pings that are read as they arrive, and the
        estimate needs the last sample.
        """
        # Without the map, the time of the read is the time of the sample.
        if not self._clock.regressed or self._pinger.awaits(time.monotonic_ns()):
            return
        to_come = -(self._last_number + 1) % self._block_size or self._block_size
        period_s = self._period_us / 1e6
        rest = min(GATHER_S, min(to_come - 2, GATHER_SAMPLES) * period_s)
        if rest >= 2 * period_s:
            time.sleep(rest)

    def _silent(self, size: int, now: int) -> None:
        self.counters.silences += 1
        what = 'no sample'
        if size:
            new = {reason: n - self._bad_reported.get(reason, 0) for reason, n in self.counters.bad_frames.items()}
            self._bad_reported = dict(self.counters.bad_frames)
            most = max(new, key=lambda reason: new[reason], default='')
            why = f'{new[most]} bad frames: {most}' if most and new[most] else 'is the baud rate right?'
            what = f'bytes but no sample ({why})'
        self._limited_log.log(
            'silent', f'{self._name}: {what} for {SILENCE_S:g} s; still listening', WARNING, now / 1e9
        )
        # It may have been stopped, by itself or by another program.
        self.source.wake()

    def _disconnected(self, error: DeviceError) -> None:
        if self._stop.is_set():
            # Given up by us.
            return
        self.counters.disconnects += 1
        self._enqueue(time.monotonic_ns())
        self.source.close()
        self._connected = False
        self._was_away = True
        self._rejection = ''
        self._limited_log.log('away', f'{error}; waiting for it to come back', ERROR, time.monotonic(), NEWS)

    def _reopen(self) -> None:
        try:
            hello = self.source.reopen()
            if hello is not None:
                self._gate.take(hello, self.source.name, volts=self.source.volts)
        except DeviceError as error:
            self.source.close()
            if self._stop.is_set():
                return
            self.counters.rejected_reopenings += 1
            rejection = str(error)
            # Report once why the device is rejected; a port that is still missing is not worth a
            # line.
            if 'no such port' not in rejection and rejection != self._rejection:
                self._rejection = rejection
                self._limited_log.log('rejected', f'{rejection}; still trying', WARNING, time.monotonic(), NEWS)
            return
        self._connected = True
        self._name = self.source.name
        self._bad_since_sample = 0
        if not self.source.numbered:
            self._restarted(self._sequence.restart())
        self._limited_log.log('back', f'{self._name}: the device is back', INFO, time.monotonic(), NEWS)

    def feed(self, events: Sequence[Event], now: int) -> bool:
        """Sort the frames of one read at ``now`` (CLOCK_MONOTONIC, ns); True if one was a sample.

        The reader thread calls it. Without a reader thread, a caller with its own clock may (a
        test, a simulation). Raises AnotherDeviceError if a HELLO has another serial number than the
        first one.
        """
        counters = self.counters
        good = False
        if self._clock.newest(events, now):
            self._jumped(now)
        for frame in events:
            if type(frame) is SampleFrame or type(frame) is Sample:
                good = True
                flags, seq, t, readings = frame
                number, step, missing = self._sequence.extend(seq, t)
                if step is not Step.NEXT and not self._unusual(number, step, missing, flags, now):
                    continue
                self._bad_since_sample = 0
                self._was_away = False
                if number < self._first_number:
                    continue
                if flags & FLAG_DEVICE_DROPPED:
                    counters.device_dropped += 1
                waiting = self._buffer.seq
                self._last_number = number
                if self._clock.torn(number, t):
                    # Samples from before the clock jumped are stamped by the map that was valid
                    # then.
                    self._enqueue(now)
                    if self._clock.observe(seq, t, now):
                        self._jumped(now)
                elif self._clock.lags(number, t, now):
                    self._enqueue(now)
                    self._clock.lay_anew(number, seq, t, now)
                    self.counters.clock_jumps += 1
                    self._limited_log.log(
                        'lag',
                        f"{self._name}: the device's clock stands still, or falls behind its sample numbers; "
                        'the time map starts again',
                        WARNING,
                        now / 1e9,
                        NEWS,
                    )
                elif step_us := self._clock.stepped(number, t):
                    self._enqueue(now)
                    self._stepped(step_us, now)
                elif waiting and number // self._block_size != waiting[0] // self._block_size:
                    self._enqueue(now)
                self._buffer.add(number, t, readings, flags)
                counters.samples += 1
                if number % self._block_size == self._block_size - 1:
                    self._enqueue(now)
            elif type(frame) is BadFrame:
                reason = str(frame.reason)
                counters.bad_frames.add(reason)
                self._bad_since_sample += frame.reason != BadReason.UNKNOWN_TYPE
            else:
                self._other(frame, now)
        return good

    def _jumped(self, now: int) -> None:
        self.counters.clock_jumps += 1
        self._limited_log.log(
            'jump', f"{self._name}: the device's clock jumped; the time map starts again", WARNING, now / 1e9, NEWS
        )

    def _stepped(self, step_us: int, now: int) -> None:
        self.counters.clock_jumps += 1
        text = f"{self._name}: the device's clock jumped by {step_us / 1e3:+.1f} ms; the time map follows"
        self._limited_log.log('jump', text, WARNING, now / 1e9, NEWS)

    def _note_step(self, now: int) -> None:
        """Log and record by how much the time map has stepped; the steps of a line that recovers are one."""
        step_ns = self._clock.take_step_ns()
        if abs(step_ns) < MAP_STEP_NS:
            return
        self.counters.map_steps += 1
        off = f'{abs(step_ns) / 1e6:.1f} ms too {"late" if step_ns < 0 else "early"}'
        text = f'{self._name}: samples were stamped {off} (the line or the clock): the time map steps'
        self._limited_log.log('step', text, WARNING, now / 1e9, NEWS)
        self._record(CLOCK_STEP, step_ns / 1e9, self.counters.map_steps)

    def _record(self, name: str, value: float, count: int) -> None:
        """Put a note of the time map into the recording, unless there are many."""
        if count <= RECORDED_RESTARTS:
            block = max(self._last_number, 0) // self._block_size
            self.queue.put(Annotation(ParameterChange(self._last_t_ns, block, ((name, value),))))

    def _note_squeezed(self, squeezed: int, now: int) -> None:
        """Count samples whose stamps had to be raised; log and record them, and the step, when there are no more."""
        self._squeezed += squeezed
        if squeezed or self._clock.drains:
            return
        self._note_step(now)
        if not self._squeezed:
            return
        count, self._squeezed = self._squeezed, 0
        self.counters.squeezed += count
        self._squeezes += 1
        text = f'{self._name}: {count} samples have stamps 1 ns apart, so that time does not go back'
        self._limited_log.log('squeezed', text, WARNING, now / 1e9, NEWS)
        self._record(CLOCK_SQUEEZED, float(count), self._squeezes)

    def _unusual(self, number: int, step: Step, missing: int, flags: int, now: int) -> bool:
        """Count a sample that does not directly follow the last one; False if it is to be skipped."""
        if step is Step.FIRST:
            # Skip the block in which we joined: the first block is a whole one.
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
            self._restarted(number)
            self._limited_log.log('restart', f'{self._name}: the device started anew', WARNING, now / 1e9, NEWS)
        return True

    def _restarted(self, number: int | None) -> None:
        """``number``: of the next sample."""
        self.counters.restarts += 1
        self._enqueue(time.monotonic_ns())
        change = None
        if number is not None and self._last_number >= 0 and self.counters.restarts <= RECORDED_RESTARTS:
            values = ((RESTART, (self._last_number, number)),)
            change = ParameterChange(self._last_t_ns, number // self._block_size, values)
        self.queue.put(Restarted(change))

    def _other(self, frame: Event, now: int) -> None:
        if isinstance(frame, PongFrame):
            sent = self._pinger.answered(frame.cookie)
            if sent is not None:
                self.counters.pongs += 1
                self._clock.reply(frame.t_device_us, sent, now)
        elif isinstance(frame, StatusFrame):
            self.counters.device_overruns = frame.overruns
            if frame.temperature_centi is not None:
                self.counters.temperature = frame.temperature_centi / 100.0
        elif isinstance(frame, Notice):
            self._limited_log.log('notice', f'{self._name}: {frame.text}', WARNING, now / 1e9, NEWS)
        elif isinstance(frame, HelloFrame) and frame != self.hello:
            try:
                self._gate.take(frame, self._name, volts=self.source.volts)
            except AnotherDeviceError:
                raise
            except DeviceError as error:
                self._limited_log.log('hello', f'{error}; kept to the first HELLO', WARNING, now / 1e9)

    def _enqueue(self, now: int) -> None:
        buffered = self._buffer
        if not buffered.seq:
            return
        self._buffer = SampleBuffer()
        t_ns = self._ros_time_ns(np.array(buffered.t, np.int64))
        # A restarted clock map may give times before the last stamp: time must not go back.
        squeezed = 0
        if t_ns[0] <= self._last_t_ns or bool((t_ns[1:] <= t_ns[:-1]).any()):
            steps = np.arange(1, len(t_ns) + 1)
            raised = np.maximum.accumulate(np.maximum(t_ns - steps, self._last_t_ns)) + steps
            squeezed, t_ns = int((raised > t_ns).sum()), raised
        self._note_squeezed(squeezed, now)
        self._last_t_ns = int(t_ns[-1])
        if self.queue.blocks >= self._rig.acquisition.queue_blocks:
            self.counters.queue_dropped += len(buffered.seq)
            self.counters.dropped_why = self.why_full()
            self._limited_log.log(
                'full',
                f'{self.counters.dropped_why}: {self.counters.queue_dropped} samples dropped here so far '
                f'({self._rig.acquisition.queue_blocks} blocks wait, queue_blocks)',
                WARNING,
                now / 1e9,
            )
            return
        raw = RawChunk(
            np.array(buffered.seq, np.int64),
            t_ns,
            np.array(buffered.readings, np.float32)
            if self._gate.volts_per_count is None
            else np.array(buffered.readings, np.int32),
            np.array(buffered.flags, np.uint8),
            self._gate.volts_per_count,
        )
        self.queue.put(Arrival(raw, now, self.counters.queue_dropped))

    def _ros_time_ns(self, t: IntArray) -> IntArray:
        """``t``: as the source gives it."""
        if self.source.clock is Clock.RECORDED:
            return t
        return self._clock.to_host_ns(t) + (self.to_ros_ns - self._latency_ns)
