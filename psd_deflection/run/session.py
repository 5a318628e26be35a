# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One run of the daemon, for node and command line: device, sinks and threads. ``reader`` and ``pipeline`` never wait
for the disk; ``recorder``, the zero's thread and the watcher's do."""

import math
import time
from collections.abc import Mapping
from concurrent.futures import Future, wait
from functools import partial
from pathlib import Path

from msg_adapters import ACCELERATION, LOAD, MARK, TOPIC_TYPES, accel_stamped, from_fields, string, to_messages
from psd_deflection.base.bounds import BoundedMap, RateLimit, Tally
from psd_deflection.base.errors import ConfigError, RecordingError, SamplesDroppedError
from psd_deflection.base.log import ERROR, INFO, WARNING, LogCallback
from psd_deflection.base.text import sanitize
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.solvers.registry import check_arrangement, check_live
from psd_deflection.recordings import cdr
from psd_deflection.records import AppliedLoad, BaseAcceleration, Mark, ParameterChange, Record
from psd_deflection.rig.config import Rig, left_as_in_the_thesis, replace_values
from psd_deflection.rig.declarations import ZEROS
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.fanout import Fanout
from psd_deflection.run.processing import Processing, RecordSink
from psd_deflection.run.rate_limited_log import RateLimitedLog
from psd_deflection.run.realtime import lock_memory, of_systemd
from psd_deflection.run.recorder import Recorder
from psd_deflection.run.session_texts import RETAKE_ZERO, load_text, mark_text, zero_text
from psd_deflection.run.simulated_rig import SimulatedRigProcess, simulates
from psd_deflection.run.state import ZeroStore
from psd_deflection.run.watcher import Watcher, WatcherSink

STALLED_S = 5.0
"""A thread that has completed no round for this long hangs: the watchdog gets no more signals."""

SILENT_S = 5.0
"""Dots older than this plus two blocks are out of date."""

JOIN_S = 0.5
"""At the end, a pipeline that has taken nothing from its queue for this long is given up."""

PATIENCE_S = 3.0
"""At the end, the longest time for the last blocks in all."""

KEEP_S = 0.2
"""Time limit for the last zero to reach the disk at the end."""

OPEN_S = 2.0
"""How long the start waits for the disk if a recording is wanted from the start."""

MARKS_A_SECOND = 10
"""Most marks a second: more than a person sets, and few enough for every plot."""

_SIMULATED = {True: 'on which weights hang in turn', False: 'at rest; an annotated load is applied to it'}

LONGEST_LINE = 2000
"""Characters of a log line; the rest is cut."""


class Session:
    """Opens the device on construction. ``log`` and every function in ``listeners`` get one line for each
    change of state, from any thread. ``input_sinks`` get the record of each accepted input: loads, references,
    temperatures, marks, accelerations of the base. ``load``: the known load that acts now, or None. ``rejected``: the
    number of unusable input messages by topic, ``why_rejected``: the latest reason. ``node``: full name of the ROS
    node, for recordings. ``unzeroed``: ``rig`` with the zero of its parameters, if ``rig`` has a kept one.

    Raises DeviceError, ConfigError, SolverError or RecordingError if the run cannot start.
    """

    def __init__(self, rig: Rig, log: LogCallback, node: str = '', unzeroed: Rig | None = None) -> None:
        self._simulated: SimulatedRigProcess | None = None
        self._closed = False
        self._incomplete: SamplesDroppedError | RecordingError | None = None
        self.listeners: list[LogCallback] = [log]
        self.input_sinks: list[RecordSink] = []
        self.load: AppliedLoad | None = None
        self._zeroed_ns = 0
        self.rejected = Tally()
        self.why_rejected: BoundedMap[str, str] = BoundedMap()
        log = self._report  # From here on to all listeners.
        self._limited_log = RateLimitedLog(log)
        self._mark_rate = RateLimit(MARKS_A_SECOND)
        check_live(rig.estimator.solver)
        check_arrangement(rig)
        # The geometry first: a rig that cannot be solved must not open a port.
        pipeline = Pipeline(rig)
        if simulates(rig.values):
            if of_systemd() and not rig.acquisition.demo:
                raise ConfigError(
                    'port: names no device, and a service that records a simulated rig would go unnoticed: set port in '
                    'the rig file (demo: true starts the simulated rig all the same)'
                )
            self._simulated = SimulatedRigProcess(rig)
            rig = replace_values(rig, {'port': self._simulated.port})
            pipeline = Pipeline(rig)
            log(
                f'no port given: started the simulated rig on {self._simulated.port}, '
                f'{_SIMULATED[rig.acquisition.demo]} (parameter port names a real one)',
                WARNING,
            )
        same = left_as_in_the_thesis(rig.values)
        if same:
            more = (
                f' and {len(same) - 1} more (`psd-deflection info` of a recording lists them)' if len(same) > 1 else ''
            )
            log(f'as in the thesis rig, unless you measured the same: {same[0]}{more}')
        try:
            self.acquisition = Acquisition(rig, log)
            self.acquisition.open()
            hello = self.acquisition.hello
            self._store: ZeroStore | None = None
            # Our own simulated rig starts unloaded, so no kept zero applies.
            if rig.acquisition.keep_zero and not self.simulated:
                self._store = ZeroStore(unzeroed or rig, hello.info.get('serial') if hello is not None else None)
                rig, about, level = self._store.load(rig)
                if about:
                    log(about, level)
                    pipeline = Pipeline(rig)
                    pipeline.tip_loads.zeroed = self._store.loaded
            log('; '.join(f'{name}: {what}' for name, what in self.acquisition.source.describe().items()))
            self.processing = Processing(self.acquisition.queue, pipeline, log)
            self.acquisition.why_full = self.processing.lag_reason
            self.recorder = Recorder(
                rig.acquisition.queue_blocks, log, self.processing.request, lambda: self.processing.dropped_before, node
            )
            self.fanout = Fanout(rig.monitor.frame_prefix)
            self.fanout.change_sinks.append(self.recorder)
            self.processing.sinks.append(self.fanout)
            self.watcher: Watcher | None = None
            if rig.acquisition.watch == 'on':
                self.watcher = Watcher(pipeline, log, hello.info if hello is not None else None, node)
                self.processing.sinks.append(self.watcher)
        except BaseException:
            if hasattr(self, 'acquisition'):
                self.acquisition.stop()
            if self._simulated is not None:
                self._simulated.close()
            raise

    def _report(self, text: str, level: int = INFO, /) -> None:
        text = sanitize(text, LONGEST_LINE)
        for listener in tuple(self.listeners):
            listener(text, level)

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline. Other threads may only read its counters and last records."""
        return self.processing.pipeline

    @property
    def rig(self) -> Rig:
        """The rig with its present zero."""
        return self.pipeline.rig

    @property
    def simulated(self) -> bool:
        """Whether the device is the simulated rig that this session started."""
        return self._simulated is not None

    @property
    def applies_loads(self) -> bool:
        """Whether the device is our simulated rig at rest, to which noted loads are applied."""
        return self._simulated is not None and not self.rig.acquisition.demo

    @property
    def alive(self) -> bool:
        """Whether blocks are still processed."""
        return self.processing.alive

    @property
    def failed(self) -> BaseException | None:
        """The error that ended the pipeline or the reader thread, or None.

        After :meth:`close` it is a SamplesDroppedError if samples were read and not processed, a RecordingError if
        the last recording is not whole.
        """
        return self.processing.failed or self.acquisition.failed or self._incomplete

    def responsive(self) -> bool:
        """Whether reader and pipeline completed a round lately; they do so even while the device is away."""
        now = time.monotonic()
        return all(now - beat < STALLED_S for beat in (self.acquisition.beat, self.processing.beat))

    def start(self) -> None:
        """Start recording if the rig says so, and let samples flow.

        Waits up to ``OPEN_S`` for the disk, so that the recording has the first block. If the disk has not
        answered by then, samples flow, and the recording begins when the disk answers. Raises RecordingError
        if the recording cannot be opened.
        """
        cdr.prepare(TOPIC_TYPES.values())
        if self.rig.acquisition.realtime:
            self._report(lock_memory())
        # After the ROS publisher: publishing has priority over recording.
        self.fanout.sinks.append(self.recorder)
        if self.watcher is not None and self.watcher.keeps:
            self.fanout.sinks.append(WatcherSink(self.watcher))
        self.processing.start()
        if self.rig.acquisition.record:
            asked = self.record(True)
            if wait((asked,), OPEN_S).done:
                asked.result()
            else:
                self._report(
                    'the disk does not answer; the recording begins when it does, samples flow meanwhile', WARNING
                )
                asked.add_done_callback(self._report_failed_start)
        self.acquisition.start()

    def record(self, wanted: bool) -> Future[Path | None]:
        """Start or stop a recording between two blocks; the future gives its folder, or None if there was none.

        Waits only for the pipeline, never for the disk: the future is resolved when the disk has
        answered. For its errors see :meth:`Recorder.start` and :meth:`Recorder.stop`. Raises
        TimeoutError if no data flows.
        """

        asked_ns = self.acquisition.now_ns()

        def notify(done: Future[Path | None]) -> None:
            if done.exception() is None and (folder := done.result()) is not None:
                if wanted and (load := self.load) is not None:
                    # The load acts already when the recording begins: it is recorded again.
                    self._put_load(load._replace(t_ns=max(load.t_ns, asked_ns)))
                self._report(f'recording to {folder}' if wanted else f'recording ended: {folder}')

        if wanted:
            hello = self.acquisition.hello.info if self.acquisition.hello is not None else None
            asked = self.recorder.start(self.rig, hello, self.pipeline.snapshot)
        else:
            asked = self.processing.request(self.recorder.stop)
        asked.add_done_callback(notify)
        return asked

    def _report_failed_start(self, done: Future[Path | None]) -> None:
        error = done.exception()
        if error is not None:
            self.recorder.failure = str(error)
            self._report(f'not recorded: {error}', ERROR)

    def take_input(self, topic: str, message: bytes) -> Record | None:
        """Record an encoded input message, act on it, and pass its record to ``input_sinks``.

        Returns the record, or None if the message cannot be decoded or holds a number that is not finite.
        """
        if topic == ACCELERATION:
            return self._take_acceleration(message)
        if topic == MARK:
            try:
                return self._take_mark(message)
            except ValueError:
                return None
        self.recorder.put(topic, TOPIC_TYPES[topic], message, self.acquisition.now_ns())
        if self.watcher is not None:
            self.watcher.put_message(topic, TOPIC_TYPES[topic], message, self.acquisition.now_ns())
        try:
            record = from_fields(topic, cdr.decode(TOPIC_TYPES[topic], message))
        except ValueError as error:
            self.reject_input(topic, str(error))
            return None
        numbers = (n for field in record for n in (field if isinstance(field, tuple) else (field,)))
        if not all(math.isfinite(n) for n in numbers if not isinstance(n, str)):
            self.reject_input(topic, 'a number is not finite')
            return None
        if record.t_ns == 0:
            record = record._replace(t_ns=self.acquisition.now_ns())
        if isinstance(record, AppliedLoad):
            self._set_load(record)
        for sink in self.input_sinks:
            sink.put(record)
        return record

    def _set_load(self, load: AppliedLoad) -> None:
        self.load = load
        if any(load[1:]) and load.t_ns < self._zeroed_ns:
            ago_s = (self.acquisition.now_ns() - self._zeroed_ns) / 1e9
            # It is said once for each zero, however many loads come.
            self._zeroed_ns = 0
            self._report(f'the load acted already when the zero was taken, {ago_s:.2f} s ago: {RETAKE_ZERO}', WARNING)
        if self._simulated is not None and self.applies_loads:
            self._simulated.push(load[1:])
        if self.pipeline.motion_filter is not None:
            self.processing.later(partial(self._notify_filter, load))
        if self.watcher is not None:
            self.processing.later(partial(self.watcher.put, load))

    def _notify_filter(self, load: AppliedLoad) -> None:
        reported = self.pipeline.load(load)
        if reported is not None:
            self.processing.give([reported])

    def _take_acceleration(self, message: bytes) -> Record | None:
        """Unlike other inputs an acceleration is recorded once the pipeline has given it to the filter, with that time:
        the filter's output depends on the block before it, and a replay repeats that."""
        try:
            record = accel_stamped.to_base(cdr.decode(TOPIC_TYPES[ACCELERATION], message))
        except ValueError as error:
            self.reject_input(ACCELERATION, str(error))
            return None
        self.processing.later(partial(self._accelerate, record, message))
        return record

    def _accelerate(self, record: BaseAcceleration, message: bytes) -> None:
        try:
            record_ns = self.pipeline.accelerate(record)
        except ValueError as error:
            self._reject(ACCELERATION, str(error))
            return
        if record_ns is None:
            return
        self.recorder.put(ACCELERATION, TOPIC_TYPES[ACCELERATION], message, record_ns)
        if self.watcher is not None:
            self.watcher.put_message(ACCELERATION, TOPIC_TYPES[ACCELERATION], message, record_ns)
        for sink in self.input_sinks:
            sink.put(record)

    def note_mark(self, text: str, late_s: float = 0.0) -> Mark:
        """Mark the moment ``late_s`` s ago, as if ``text`` had come on ``/link_tip/mark``.

        Raises ValueError if it is no mark, or comes too soon after others; that is counted.
        """
        try:
            fields = string.from_mark(string.to_mark({'data': text}))
        except ValueError as error:
            self.reject_input(MARK, str(error))
            raise
        return self._take_mark(cdr.encode(TOPIC_TYPES[MARK], fields), late_s)

    def _take_mark(self, message: bytes, late_s: float = 0.0) -> Mark:
        """Unlike other inputs an unusable mark is not recorded: it is nothing but untrusted text. Its time is its
        arrival, less ``late_s``."""
        try:
            mark = string.to_mark(cdr.decode(TOPIC_TYPES[MARK], message))
            if not self._mark_rate.allows(time.monotonic()):
                raise ValueError(f'more than {MARKS_A_SECOND} marks a second')
        except ValueError as error:
            self.reject_input(MARK, str(error))
            raise
        mark = mark._replace(t_ns=self.acquisition.now_ns() - round(1e9 * late_s))
        self.recorder.put(MARK, TOPIC_TYPES[MARK], message, mark.t_ns)
        if self.watcher is not None:
            self.watcher.put_message(MARK, TOPIC_TYPES[MARK], message, mark.t_ns)
        for sink in self.input_sinks:
            sink.put(mark)
        self._report(mark_text(mark))
        return mark

    def reject_input(self, topic: str, why: str) -> None:
        """Count a message of another node that cannot be used, and say so."""
        self.processing.later(partial(self._reject, topic, why))

    def _reject(self, topic: str, why: str) -> None:
        # The reason first: the main thread asks for it as soon as there is a count.
        self.why_rejected[topic] = why
        self.rejected.add(topic)
        self._limited_log.log(f'rejected {topic}', f'{topic}: rejected: {why}', WARNING, time.monotonic())

    def settle(self) -> None:
        """Log the count of rejected messages that the rate limit has held back; to be called once a second."""
        self.processing.later(lambda: self._limited_log.settle(time.monotonic()))

    def note_load(
        self, fx: float, fy: float, tz: float, *, add: bool = False, ago_s: float = 0.0, late_s: float = 0.0
    ) -> AppliedLoad:
        """Note that this load (N, N, N m) acts at the tip, as if it had come on ``/link_tip/load``.

        ``add``: it acts beside the present load. ``ago_s``: for how long it has acted already; the recording has that
        time as its stamp, and the present as the time of the message. ``late_s``: for how long the request was under
        way; the stamp is earlier by it, but later than the present load's. Raises ValueError for an ``ago_s`` before
        the present load's time, or on a simulated rig, to which a load is applied when it is noted.
        """
        if ago_s > 0.0 and self.applies_loads:
            raise ValueError('the simulated rig applies a load when it is noted, so it cannot have acted before')
        now_ns = self.acquisition.now_ns()
        since_ns = now_ns - round(1e9 * ago_s)
        if self.load is not None and since_ns < self.load.t_ns and ago_s > 0.0:
            held_s = (now_ns - self.load.t_ns) / 1e9
            raise ValueError(
                f'the present load began {held_s:.2f} s ago, so this one cannot have begun {ago_s:.2f} s ago'
            )
        if not self.applies_loads:
            # Less the delay of the request, but at least 1 ns after the present load.
            held_ns = 0 if self.load is None else self.load.t_ns
            since_ns = max(since_ns - round(1e9 * late_s), min(held_ns + 1, since_ns))
        if add and (held := self.load) is not None:
            fx, fy, tz = held.fx + fx, held.fy + fy, held.tz + tz
        load = AppliedLoad(since_ns, fx, fy, tz)
        self._put_load(load)
        self._report(load_text(load, ago_s))
        return load

    def _put_load(self, load: AppliedLoad) -> None:
        (message,) = to_messages(load)
        self.take_input(LOAD, cdr.encode(message.type, message.fields))

    def temperature(self, celsius: float) -> None:
        """Set the ambient temperature for the corrections that need it, from the next block on.

        Raises TimeoutError if no data flows.
        """
        if not self.pipeline.needs_temperature:
            return

        def change() -> None:
            taken = self.pipeline.temperature(celsius)
            if taken is not None:
                self.processing.give([taken])

        self.processing.request(change)

    def zero(self, late_s: float = 0.0) -> ParameterChange | None:
        """Take the dots of ``late_s`` s ago as the unloaded ones; None if the last block is not good.

        They are kept for the next run if the rig says so. Raises TimeoutError if no data flows, because the
        present dots are unknown then.
        """
        rig = self.rig
        patience = SILENT_S + 2.0 * rig.estimator.block_size / rig.converter.sample_rate_hz

        def change() -> ParameterChange | None:
            if self.acquisition.away or self.processing.silent_s() > patience:
                raise TimeoutError('no data flows')
            taken = self.pipeline.zero(late_s)
            if taken is not None:
                self.processing.give([taken])
            return taken

        taken = self.processing.request(change)
        if taken is not None:
            self._zeroed_ns = self.acquisition.now_ns() - round(1e9 * late_s)
            self._report(zero_text(self.rig))
            self._keep_zero()
            if self.load is not None and any(self.load[1:]) and self.load.t_ns <= self._zeroed_ns:
                self._report(f'the zero was taken under a load ({load_text(self.load)}): {RETAKE_ZERO}', WARNING)
        return taken

    def change(self, values: Mapping[str, float | str | tuple[float, ...]]) -> None:
        """Change live parameters, together, between two blocks.

        Raises TimeoutError if no data flows, ConfigError if a value is out of bounds; then
        nothing has changed.
        """
        self.processing.request(lambda: self.processing.give([self.pipeline.change(values)]))
        shown = (f'{name} = {list(v) if isinstance(v, tuple) else v}' for name, v in values.items())
        self._report(f'changed: {", ".join(shown)}')
        if any(name in ZEROS for name in values):
            self._keep_zero()

    def _keep_zero(self) -> None:
        if self._store is not None:
            self._store.keep(self.rig, self._report)

    def close(self) -> Path | None:
        """Stop reading, process what was read, end the recording; return its folder.

        Ends within two seconds even if a part hangs; what makes progress gets ``PATIENCE_S``. A second call does
        nothing.
        """
        if self._closed:
            return None
        self._closed = True
        if self._simulated is not None:
            self._simulated.hang_up()
        self.acquisition.stop()
        self._finish()
        folder = self.recorder.close()
        if self.recorder.failure and self._incomplete is None:
            self._incomplete = RecordingError(f'the recording ended early: {self.recorder.failure}')
        if self.watcher is not None and (unfinished := self.watcher.close(KEEP_S)):
            self._report(f'watch: {unfinished}', WARNING)
        if self._store is not None and not self._store.join(KEEP_S):
            self._report(f'{self._store.path}: not written within {KEEP_S:g} s; the zero may not be kept', WARNING)
        if self._simulated is not None:
            self._simulated.close()
        return folder

    def _finish(self) -> None:
        """Let the pipeline process what was read; give up what it cannot, and say how much, and why."""
        until = time.monotonic() + PATIENCE_S
        queued = self.acquisition.queue.qsize()
        self.processing.join(JOIN_S)
        while self.processing.alive and time.monotonic() < until:
            before, queued = queued, self.acquisition.queue.qsize()
            if queued >= before:
                break
            self.processing.join(JOIN_S)
        counters = self.acquisition.counters
        if self.processing.alive:
            why = self.processing.lag_reason()
            samples = self.acquisition.abandon()
            self.processing.join(JOIN_S)
            if samples:
                counters.dropped_why = why
                self._report(f'{why}: the last {samples} samples were read and not processed', WARNING)
            if self.processing.alive:
                self._report(f'{self.processing.lag_reason()}: the last block is not waited for', WARNING)
        self.processing.dropped_before = counters.dropped_here
        if counters.dropped_here:
            self._incomplete = SamplesDroppedError(
                f'{counters.dropped_here} samples were read and not processed ({counters.queue_dropped} while it ran, '
                f'{counters.abandoned} at the end): {counters.dropped_why}'
            )
