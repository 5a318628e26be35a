# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The state of the run in numbers, once a second, for ``/diagnostics`` and for the terminal."""

from typing import NamedTuple

from msg_adapters import ACCELERATION
from psd_deflection.measure.motion.inertia import HOLD_NS
from psd_deflection.measure.motion.motion import AXES
from psd_deflection.measure.motion.unseen import Innovations
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.run.processing import Latency
from psd_deflection.run.session import Session

OK, WARN, ERROR, STALE = 0, 1, 2, 3

CLOCK_STEP_NS = 20_000_000
"""A system clock that has moved by more than this against CLOCK_MONOTONIC was set."""


OFF_NS = 1_000_000
"""If the map of the device's clock is this far from its fit, the stamps are wrong by as much."""


BEYOND = 6.0
"""Standard deviations that the mean NIS of a second may be above 1: chance and a switched load explain that."""

LATE_NS = 5_000_000
"""A shortest round trip to the device above which stamps are uncertain, ns."""

LATE_SHARE = 0.25
"""Share of the base's accelerations that may be late: those of the end of a block are, if they come as they act."""

LOAD_WALK = ('load wanders, fx (N in 1 s)', 'load wanders, fy (N in 1 s)', 'load wanders, tz (N m in 1 s)')


class CounterSnapshot(NamedTuple):
    """What was counted up to ``t_ns``, or between two reports."""

    t_ns: int
    samples: int
    lost: int
    bad: int
    dropped: int
    blocks: int
    estimates: int
    degraded: int
    contradictions: int
    clock_jumps: int
    rejected: int


class HealthReporter:
    """Compares the run's counters with those of the last report."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._observed: CounterSnapshot | None = None
        self._predicted = Innovations()
        self._base = (0, 0, 0, 0)

    def report(self, t_ns: int) -> DiagnosticReport:
        """The report for the time since the last one. ``t_ns``: now, ROS time."""
        s = self._session
        s.settle()
        counters, pipeline = s.acquisition.counters, s.pipeline.counters
        dropped = counters.queue_dropped + s.recorder.dropped
        now = CounterSnapshot(
            t_ns,
            counters.samples,
            counters.lost,
            counters.bad,
            dropped,
            pipeline.blocks,
            pipeline.estimates,
            pipeline.degraded,
            s.pipeline.estimator.contradictions,
            counters.clock_jumps,
            s.rejected.total(),
        )
        # The first report counts from the start. The time that it covers is unknown, so it gives no rates.
        before = self._observed
        self._observed = now
        seconds = (now.t_ns - before.t_ns) / 1e9 if before is not None else 0.0
        new = (
            CounterSnapshot(0, *(b - a for a, b in zip(before[1:], now[1:], strict=True)))
            if before is not None
            else now
        )

        def rate(count: int) -> str:
            return f'{count / seconds:.2f}' if seconds > 0 else 'unknown'

        hello = s.acquisition.hello
        return DiagnosticReport(
            t_ns,
            (
                self._acquisition(new, rate(new.samples)),
                self._clock(new),
                estimates_entry(s.pipeline, new, rate(new.estimates), s.processing.latency()),
                *self._motion(),
                *(laser_entry(s.pipeline, psd, new.samples > 0) for psd in range(1, len(s.rig.psds) + 1)),
                self._recording(),
                *(() if s.watcher is None else (s.watcher.entry(),)),
            ),
            str(hello.info.get('serial', '')) if hello is not None else '',
        )

    def _acquisition(self, new: CounterSnapshot, rate: str) -> DiagnosticEntry:
        s = self._session
        counters = s.acquisition.counters
        level, message = OK, 'samples flow'
        if s.simulated:
            level, message = WARN, 'no port is given: these samples are simulated'
        if new.samples == 0:
            level, message = ERROR, 'no samples'
        elif new.lost or new.bad or new.dropped:
            level, message = WARN, f'{new.lost} samples lost, {new.bad} bad frames, {new.dropped} dropped'
        elif new.rejected:
            level = WARN
            message = '; '.join(f'{topic}: rejected: {why}' for topic, why in sorted(s.why_rejected.items()))
        values = [
            ('port', s.rig.acquisition.port),
            ('rate (samples/s)', rate),
            ('samples', str(counters.samples)),
            ('lost', str(counters.lost)),
            *((f'lost: {cause}', str(count)) for cause, count in sorted(counters.lost_by.items())),
            ('repeated', str(counters.repeated)),
            ('bad frames', str(counters.bad)),
            *((f'bad frames: {reason}', str(count)) for reason, count in sorted(counters.bad_frames.items())),
            ('dropped by the device', str(counters.device_overruns)),
            ('dropped by a full queue', str(counters.queue_dropped)),
            ('device restarts', str(counters.restarts)),
            ('disconnects', str(counters.disconnects)),
            ('silences', str(counters.silences)),
            ('rejected on coming back', str(counters.rejected_reopenings)),
            *((f'messages rejected: {topic}', str(count)) for topic, count in sorted(s.rejected.items())),
            ('blocks waiting', str(s.acquisition.queue.blocks)),
            ('inputs dropped, because the pipeline was held up', str(s.processing.requests_dropped)),
        ]
        values.append(('simulated', 'yes' if s.simulated else 'no'))
        values += s.acquisition.source.describe().items()
        if counters.temperature is not None:
            values.append(('device temperature (degC)', f'{counters.temperature:.2f}'))
        return DiagnosticEntry('psd_deflection: acquisition', level, message, tuple(values))

    def _clock(self, new: CounterSnapshot) -> DiagnosticEntry:
        acquisition = self._session.acquisition
        clock, counters = acquisition.clock_state(), acquisition.counters
        stepped = acquisition.system_clock_step_ns()
        values = [
            ('skew (ppm)', f'{clock.skew_ppm:z.2f}'),
            ('offset (ns)', str(clock.offset_ns)),
            ('residual (us)', f'{clock.residual_ns / 1e3:.1f}'),
            ('seconds in the fit', str(clock.points)),
            ('device clock jumps', str(counters.clock_jumps)),
            ('laid anew', str(clock.resets)),
            ('pings', str(counters.pings)),
            ('pings answered', str(counters.pongs)),
            ('system clock moved since the start (ms)', f'{stepped / 1e6:.3f}'),
        ]
        if clock.round_trip_ns is not None:
            values.append(('least round trip (us)', f'{clock.round_trip_ns / 1e3:.0f}'))
        # A stamp cannot be later than that by a constant delay of the line; without answers nobody knows.
        late = 'not known, no ping is answered' if clock.round_trip_ns is None else f'{clock.round_trip_ns / 1e6:.3f}'
        values += [
            ('stamps late by at most (ms)', late),
            ('steps of the time map', str(counters.map_steps)),
            ('samples with stamps 1 ns apart', str(counters.squeezed)),
        ]
        level, message = OK, f'skew {clock.skew_ppm:z.1f} ppm'
        if clock.round_trip_ns is not None and clock.round_trip_ns > LATE_NS:
            level = WARN
            message = f'the line is slow: stamps may be late by up to {clock.round_trip_ns / 1e6:.1f} ms'
        if new.clock_jumps:
            level = WARN
            message = (
                f"the device's clock jumped or stood still: the time map was started again {new.clock_jumps} times"
            )
        elif abs(clock.residual_ns) > OFF_NS:
            level = WARN
            off_ms = abs(clock.residual_ns) / 1e6
            message = f'times are {off_ms:.1f} ms off: the map still approaches a clock of {clock.skew_ppm:z.0f} ppm'
        if abs(stepped) > CLOCK_STEP_NS:
            level = WARN
            message = f'the system clock was set by {stepped / 1e9:+.3f} s; stamps go on as before until the next start'
        return DiagnosticEntry('psd_deflection: clock', level, message, tuple(values))

    def _motion(self) -> tuple[DiagnosticEntry, ...]:
        motion = self._session.pipeline.motion_filter
        if motion is None:
            return ()
        name = 'psd_deflection: motion'
        before, self._predicted = self._predicted, motion.innovations
        new = self._predicted.since(before)
        values = [
            *((f'NIS a sample, {axis}', f'{nis:.3f}') for axis, nis in zip(AXES, new.means(), strict=True)),
            ('NIS, 95 % band', '{:.3f} to {:.3f}'.format(*new.band(1.96))),
            ('coasting (s)', f'{motion.coasted:.3f}'),
            ('times that it coasted', str(motion.predictions_only)),
            ('base accelerations', str(motion.inertia.count)),
            ('base accelerations, after their samples', str(motion.inertia.late)),
            ('base accelerations, not ended by another', str(motion.inertia.ended)),
            ('base accelerations, rejected', str(self._session.rejected[ACCELERATION])),
            *zip(LOAD_WALK, (f'{random_walk:.3g}' for random_walk in motion.load_walk()), strict=True),
        ]
        level, message = OK, 'the modes predict the samples'
        worst = max(new.means())
        reported = motion.inertia
        base = (reported.count, reported.late, reported.ended, self._session.rejected[ACCELERATION])
        came, late, ended, rejected = (max(now - then, 0) for now, then in zip(base, self._base, strict=True))
        self._base = base
        if rejected:
            level, message = WARN, f'{rejected} base accelerations rejected: {self._session.why_rejected[ACCELERATION]}'
        elif ended:
            level = WARN
            message = f'no base acceleration came for {HOLD_NS / 1e9:g} s, and the last one was not 0: taken as 0'
        elif late > LATE_SHARE * came:
            level, message = WARN, f'{late} of {came} base accelerations came after the samples on which they acted'
        if motion.coasted > 0.0:
            level, message = WARN, f'coasting for {motion.coasted:.2f} s: no samples that can be used'
        elif not new.samples:
            level, message = STALE, 'no samples that can be used'
        elif worst > new.band(BEYOND)[1]:
            axis = AXES[new.means().index(worst)]
            level = WARN
            message = (
                f'the modes of the rig file do not predict {axis}: NIS {worst:.2f} a sample; '
                '`psd-deflection identify` measures them'
            )
        return (DiagnosticEntry(name, level, message, tuple(values)),)

    def _recording(self) -> DiagnosticEntry:
        recorder = self._session.recorder
        folder = recorder.folder
        values = (
            ('folder', str(folder or '')),
            ('messages', str(recorder.written)),
            ('dropped', str(recorder.dropped)),
            ('waiting for the disk', str(recorder.waiting)),
            ('files deleted to make room', str(recorder.files_deleted)),
        )
        level, message = OK, 'recording' if folder else 'not recording'
        if recorder.opening:
            level, message = WARN, 'a recording was asked for; the disk has not answered yet'
        elif recorder.failure:
            level, message = ERROR, f'recording stopped: {recorder.failure}'
        elif recorder.dropped:
            level, message = WARN, f'{recorder.dropped} messages dropped: the disk is too slow'
        return DiagnosticEntry('psd_deflection: recording', level, message, values)


def estimates_entry(
    pipeline: Pipeline, new: CounterSnapshot, rate: str, latency: Latency | None = None
) -> DiagnosticEntry:
    """Whether ``pipeline`` makes estimates, and why not. ``new``: since the last report; ``rate``: estimates/s."""
    counters, spots = pipeline.counters, pipeline.last_spots
    level, message = OK, 'estimates flow'
    if new.estimates == 0:
        level, message = ERROR, spots.reason if spots is not None and spots.reason else 'no blocks'
    elif new.estimates < new.blocks:
        level, message = WARN, f'{new.blocks - new.estimates} of {new.blocks} blocks have no estimate'
    elif new.degraded and spots is not None:
        rule = pipeline.rig.estimator.degraded
        level = WARN
        how = f'from one detector, twist {"held" if rule == "hold" else "assumed 0"}'
        if spots.excluded:
            how = f'without {" and ".join(f"psd_{psd}" for psd in spots.excluded)}'
        why = spots.reason or next((f for f in spots.findings if 'left out' in f), '')
        message = f'degraded: {new.degraded} of {new.blocks} blocks {how}; {why}'
    elif doubt := _doubt(pipeline, new.contradictions):
        level, message = WARN, doubt
    values = [
        ('rate (estimates/s)', rate),
        ('blocks', str(counters.blocks)),
        ('estimates', str(counters.estimates)),
        ('degraded', str(counters.degraded)),
        ('status', spots.status.name if spots is not None else 'none yet'),
        *((f'found: {finding}', str(count)) for finding, count in sorted(counters.findings.items())),
        *((f'rejected: {cause}', str(count)) for cause, count in sorted(counters.rejected.items())),
    ]
    values += pipeline.estimator.words()
    if latency is not None:
        values.append(('latency, median (ms)', f'{latency.median * 1e3:.3f}'))
        values.append(('latency, worst of a second (ms)', f'{latency.worst * 1e3:.3f}'))
    return DiagnosticEntry('psd_deflection: estimates', level, message, tuple(values))


def _doubt(pipeline: Pipeline, contradictions: int) -> str:
    """What widens the covariance of blocks that all have estimates; '' if nothing does."""
    stamped = pipeline.estimator
    if contradictions:
        wrong = stamped.most_likely_wrong() or 'which one is wrong cannot be determined'
        readings = 'four readings' if len(pipeline.rig.psds) == 2 else 'readings'
        return f'the {readings} contradict each other in {contradictions} blocks: {wrong}'
    if stamped.vibrates:
        return f'vibrates {stamped.vibrates}: too fast for a block; the covariance has it'
    return ''


def laser_entry(pipeline: Pipeline, psd: int, flows: bool = True) -> DiagnosticEntry:
    """What ``pipeline`` sees of detector ``psd`` (from 1). ``flows``: whether samples have come lately."""
    name = f'psd_deflection: psd_{psd}'
    spots = pipeline.last_spots
    if spots is None:
        return DiagnosticEntry(name, STALE, 'no block yet', ())
    if not flows:
        # The last readings are out of date.
        return DiagnosticEntry(name, STALE, 'no samples', ())
    total = spots.sums[psd - 1]
    x, y = spots.dots[2 * psd - 2], spots.dots[2 * psd - 1]
    # Reasons and findings name the detector they are about.
    names = (f'laser {psd} ', f'x{psd} ', f'y{psd} ', f'sum{psd} ', f'psd_{psd} ')
    fault = spots.reason if spots.reason.startswith(names) else ''
    findings = [f for f in spots.findings if f.startswith((f'psd_{psd}', 'one of the two lasers'))]
    level, message = OK, 'dot seen'
    if findings:
        level, message = WARN, '; '.join(findings)
    if fault or total < pipeline.rig.estimator.sum_min * 0.5:
        level, message = ERROR, fault or 'laser lost'
    values = (
        ('sum (V)', f'{total:.4f}'),
        ('x (mm)', f'{x * 1e3:.4f}'),
        ('y (mm)', f'{y * 1e3:.4f}'),
        ('x, std in the block (um)', f'{spots.covariance[2 * psd - 2, 2 * psd - 2] ** 0.5 * 1e6:.2f}'),
        ('y, std in the block (um)', f'{spots.covariance[2 * psd - 1, 2 * psd - 1] ** 0.5 * 1e6:.2f}'),
    )
    return DiagnosticEntry(name, level, message, values)
