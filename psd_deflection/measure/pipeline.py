# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From chunks of samples to records, by one class in the live run and in replay: no clock, thread or I/O, so the output
is that of rig, samples and order of calls, bit for bit. Parts tell what they remember (:mod:`.state`)."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.averaging import BlockCutter, BlockMeasures, measured, middles_ns, of_one_length
from psd_deflection.measure.correction import FIRST_TEMPERATURE, START, TEMPERATURE, Correction, Surroundings
from psd_deflection.measure.estimation import ZERO_VARIANCES, BlockInput, BlockSolution, Estimation
from psd_deflection.measure.health import CalibratedRange, Loudness, OpticsHealth, Stillness, Verdict
from psd_deflection.measure.motion.modal import joined_ns, split_ns
from psd_deflection.measure.motion.motion import ModalFilter
from psd_deflection.measure.solving import BlockReadings, Dots
from psd_deflection.measure.state import FULL, STATE, Part, State, Value, load_states, numbers
from psd_deflection.measure.uncertainty.vibration import Tone, why_moving
from psd_deflection.model.detector import VoltsToDots, counts_to_volts, dot_noise_variances
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.simulation.tip_load import TipLoads
from psd_deflection.model.solvers.interface import SolverStatus
from psd_deflection.records import (
    CLOCK_SQUEEZED,
    CLOCK_STEP,
    ENVIRONMENT,
    KNOWN_LOAD,
    RESTART,
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    ParameterChange,
    RawChunk,
    Record,
    SampleBlock,
    SpotMeans,
    TipLoad,
    TipMotion,
)
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.declarations import ZEROS

ZERO_BLOCKS = 25
"""Number of blocks that :meth:`Pipeline.zero` averages: half a second."""

ZERO_KEPT_S = 15.0
"""How old, s, the request for a zero may be: the dots of so long are kept."""


def zero_variances(rig: Rig) -> tuple[float, ...]:
    """Variances (2P,), m^2, of a zero without its own: of a mean over ``ZERO_BLOCKS``, noise of the rig file."""
    return tuple(float(v) / rig.estimator.block_size / ZERO_BLOCKS for v in dot_noise_variances(rig))


@dataclass(slots=True)
class PipelineCounters:
    """Counts of samples, blocks, estimates, and blocks without an estimate.

    ``degraded``: those of ``estimates`` that do not come from all detectors. ``findings``: number of blocks
    with each finding.
    """

    samples: int = 0
    blocks: int = 0
    estimates: int = 0
    degraded: int = 0
    rejected: dict[str, int] = field(default_factory=dict)  # Bound: our own causes.
    findings: dict[str, int] = field(default_factory=dict)  # Bound: our own sentences.

    def count_findings(self, findings: Iterable[str]) -> None:
        """Count the findings of a block by what is before their colon."""
        for finding in findings:
            name = finding.split(':')[0]
            self.findings[name] = self.findings.get(name, 0) + 1


class Pipeline:
    """Samples in, records out. ``mismatches``: a message for each state of the last change this rig cannot restore.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    def __init__(self, rig: Rig) -> None:
        self.counters = PipelineCounters()
        self.last_estimate: DeflectionEstimate | None = None
        self.last_spots: SpotMeans | None = None
        config = rig.estimator
        self._xp = FIXED
        self._cutter = BlockCutter(config.block_size)
        self._period_ns = 1e9 / rig.converter.sample_rate_hz
        self.zero_rejected = ''
        self._end_ns: int | None = None
        self.mismatches: list[str] = []  # Bound: one a part of the rig.
        self._changes = 0
        self._begin(rig)

    def _begin(self, rig: Rig) -> None:
        """Make all parts that have a state anew."""
        self._effects = effects_of_rig(rig)
        self.tip_loads = TipLoads(rig, self._effects)
        blocks = round(ZERO_KEPT_S * rig.converter.sample_rate_hz / rig.estimator.block_size)
        self._recent: deque[tuple[int, Dots]] = deque(maxlen=ZERO_BLOCKS + blocks)
        self._surroundings = Surroundings()
        self._stillness = Stillness(len(rig.psds))
        self._loudness = Loudness()
        self.estimation = Estimation(rig, self._effects)
        self.estimator = self.estimation.estimator
        self._take(rig)
        self.motion_filter = self._new_filter()

    @property
    def _parts(self) -> tuple[Part, ...]:
        """Everything that has a state."""
        parts = (self._surroundings, self._stillness, self._loudness, self.estimation, self.tip_loads, self.estimator)
        return parts if self.motion_filter is None else (*parts, self.motion_filter)

    def _new_filter(self) -> ModalFilter | None:
        """The filter of the motion at the rig's present zero; None if the rig asks for none."""
        if self.rig.estimator.filter == 'none':
            return None
        gain = self.estimation.gain_at_rest()
        return ModalFilter(self.rig, self.tip_loads.compliance, gain, self.estimator.noise.gamma)

    def _take(self, rig: Rig) -> None:
        self.rig = rig
        self._calibration = VoltsToDots.from_rig(rig)
        self._correction = Correction(rig, self._effects)
        self._optics = OpticsHealth(rig)
        self._calibrated = CalibratedRange(rig)

    @property
    def repeated(self) -> int:
        """Number of samples ignored because their number did not increase."""
        return self._cutter.repeated

    @property
    def needs_temperature(self) -> bool:
        """Whether a corrected effect depends on the ambient temperature."""
        return self._correction.uses_temperature

    def process(self, chunk: RawChunk) -> Iterator[Record]:
        """The records of every block that ``chunk`` completes, each as soon as it is known.

        A block's primary estimate comes first, before the other solvers run, so it can be published
        without delay. Exhaust the generator before calling :meth:`process` again.
        """
        readings = chunk.readings
        volts: npt.NDArray[np.float32]
        if chunk.volts_per_count is not None:
            volts = counts_to_volts(readings.astype(np.int32, copy=False), chunk.volts_per_count)
        else:
            volts = readings.astype(np.float32, copy=False)
        if volts.shape[1] != 3 * len(self.rig.psds):
            raise ConfigError(
                f'the samples are of {volts.shape[1] // 3} PSDs, the rig file has {len(self.rig.psds)} (psd_N.center)'
            )
        yield from self.process_blocks(self._cutter.add(chunk, volts))

    def process_blocks(self, blocks: Sequence[SampleBlock]) -> Iterator[Record]:
        """The records of whole blocks of this rig in turn, as :meth:`process` has them."""
        for together in of_one_length(blocks):
            yield from self._alike(together)

    def flush(self) -> Iterator[Record]:
        """The records of the unfinished block; call it when the stream ended or restarts."""
        for block in self._cutter.flush():
            yield from self._alike([block])

    def zero(self, late_s: float = 0.0) -> ParameterChange | None:
        """Use the mean dots of the last blocks as the unloaded dots, from the next block on.

        ``late_s``: s for which the request was under way; its blocks end so long before the last one. None if there is
        no block, if the last one was not good, or, with the reason in ``zero_rejected``, if the link moved or the
        blocks of that time are not kept (``ZERO_KEPT_S``). Replay applies the returned record again.
        """
        self.zero_rejected = ''
        if not self._recent:
            return None
        until_ns = self._recent[-1][0] - round(1e9 * late_s)
        dots = [dots for t_ns, dots in self._recent if t_ns <= until_ns][-ZERO_BLOCKS:]
        if not dots:
            self.zero_rejected = f'the request is {late_s:.1f} s old, and no good block of that time is kept; try again'
            return None
        recent = np.array(dots)
        noise = self.estimation.zero_noise(self._cutter.block_size)
        self.zero_rejected = why_moving(recent, noise)
        if self.zero_rejected:
            return None
        means = [self._xp.total(column) / len(dots) for column in zip(*dots, strict=True)]
        values: dict[str, float | str | tuple[float, ...]] = dict(
            zip(ZEROS, zip(means[0::2], means[1::2], strict=True), strict=False)
        )
        if self.estimation.parameter_covariance is not None:
            scatter = recent.var(axis=0, ddof=1) if len(recent) > 1 else np.zeros(len(means))
            values[ZERO_VARIANCES] = tuple((np.maximum(scatter, noise) / len(recent)).tolist())
        return self.change(values)

    def change(self, values: Mapping[str, float | str | tuple[float, ...]]) -> ParameterChange:
        """Change parameters from the next block on; returns the change as a record.

        Raises ConfigError if a value is out of bounds; then nothing has changed.
        """
        last = self.last_spots
        record = ParameterChange(
            last.t_ns if last is not None else 0, last.index + 1 if last is not None else 0, tuple(values.items())
        )
        self.apply(record)
        return record

    def apply(self, change: ParameterChange) -> None:
        """Use the changed values from now on, and go on from the state that it names.

        Raises ConfigError if a parameter is out of bounds; then nothing has changed. ``mismatches`` has a line for each
        value that fits no part of this rig; it is left out.
        """
        self._changes += 1
        reported = dict(change.values)
        # Notes for readers: numbers that a restart of the device skipped, steps of the time map.
        for name in (RESTART, CLOCK_STEP, CLOCK_SQUEEZED):
            reported.pop(name, None)
        load = {name: reported.pop(name) for name in (KNOWN_LOAD,) if name in reported}
        memory = {name: reported.pop(name) for name in tuple(reported) if name in ENVIRONMENT or name.startswith(STATE)}
        if memory.pop(FULL, None) is not None:
            self._begin(self.rig)
        if reported:
            self._change_rig(reported)
        self.mismatches = load_states(self._parts, memory)
        if self.motion_filter is not None:
            self.motion_filter.set_noise(self.estimator.noise.gamma)
            self._apply_load(self.motion_filter, load)

    def _change_rig(self, reported: Mapping[str, Value]) -> None:
        """Use the parameters ``reported``."""
        values = {name: list(v) if isinstance(v, tuple) else v for name, v in reported.items()}
        rig = replace_values(self.rig, values, 'change')
        zeroed = any(name in ZEROS for name in values)
        if rig.effects != self.rig.effects:
            self._effects = effects_of_rig(rig)
        if zeroed:
            self.tip_loads.zeroed = True
            self.estimation.zero_variances = zero_variances(rig)
        self.estimation.build(rig, self._effects)
        self._take(rig)
        self.estimator.set_zeros(rig)
        if zeroed:
            # All poses shift with a new zero, though the tip did not move: the old filter would see a jump.
            self.motion_filter = self._new_filter()

    def _apply_load(self, motion: ModalFilter, reported: State) -> None:
        try:
            load = numbers(reported, KNOWN_LOAD, 'seconds, nanoseconds and a load', 5)
        except ValueError as error:
            self.mismatches.append(str(error))
            return
        if load is not None:
            motion.load(AppliedLoad(joined_ns(load[0], load[1]), load[2], load[3], load[4]))

    @property
    def buffers(self) -> int:
        """How many numbers the unfinished noise segment adds to :meth:`snapshot`; 0 between two segments."""
        return self.estimator.noise.buffered

    def snapshot(self, rig: Rig) -> ParameterChange | None:
        """The state that the next block depends on besides its samples and ``rig``; None if there is none.

        ``rig``: the rig as it was at the start; later changes are part of the memory. Nothing is changed by it.
        """
        values: State = {
            name: tuple(map(float, value)) if isinstance(value, list) else value
            for name, value in self.rig.values.items()
            if value != rig.values[name]
        }
        for part in self._parts:
            # Before the first block its state is that of a new one.
            if part is not self.estimator or self.last_spots is not None:
                values |= part.state_dict()
        if not values:
            return None
        last = self.last_spots
        t_ns, block = (last.t_ns, last.index + 1) if last is not None else (0, 0)
        return ParameterChange(t_ns, block, tuple(values.items()))

    def load(self, load: AppliedLoad) -> ParameterChange | None:
        """Tell the filter of the motion a known load; None if there is no filter, or if this load is the last one told.

        Blocks that are processed already are not corrected for it.
        """
        if self.motion_filter is None or not self.motion_filter.is_new(load):
            return None
        return self.change({KNOWN_LOAD: (*split_ns(load.t_ns), load.fx, load.fy, load.tz)})

    def accelerate(self, base: BaseAcceleration, there_ns: int | None = None) -> int | None:
        """Tell the filter of the motion a known acceleration of the base, from the next block on.

        ``there_ns``: in a replay, the recorded time of arrival. Returns the time of arrival (ns) to record: just after
        the last block; a replay passes the acceleration before the first block whose last sample is not earlier. None
        if there is no filter, or no block yet. Raises ValueError if the acceleration cannot be used.
        """
        if there_ns is None and self._end_ns is not None:
            there_ns = self._end_ns + 1
        if self.motion_filter is None or there_ns is None:
            return None
        self.motion_filter.inertia.notify(base, there_ns)
        return there_ns

    def temperature(self, celsius: float) -> ParameterChange | None:
        """Set the ambient temperature from the next block on; None if no correction needs it."""
        if not self._correction.uses_temperature:
            return None
        index = self.last_spots.index + 1 if self.last_spots is not None else 0
        first = self._surroundings.known.get(FIRST_TEMPERATURE, celsius)
        return self._environment_change(index, {FIRST_TEMPERATURE: first, TEMPERATURE: celsius})

    def _environment_change(self, block: int, values: Mapping[str, float]) -> ParameterChange:
        self._surroundings.known.update(values)
        t_ns = self.last_spots.t_ns if self.last_spots is not None else 0
        return ParameterChange(t_ns, block, tuple(self._surroundings.known.items()))

    def _corrected(self, block: SampleBlock, samples: FloatArray, sums: FloatArray) -> FloatArray:
        around = self._surroundings
        return self._correction.apply(samples, sums, around.warmer, around.seconds(block.t_ns))

    def dots(self, block: SampleBlock) -> FloatArray:
        """Dots (n, 2P), m, of the samples of ``block``, calibrated and corrected as for the estimate."""
        return self._dots(block, self._calibration.observed(block.volts))

    def _dots(self, block: SampleBlock, volts: npt.NDArray[np.float32]) -> FloatArray:
        samples = self._calibration.dots(volts)
        if not self._correction.active:
            return samples
        return self._corrected(block, samples, volts[:, 2::3].astype(np.float64))

    def _alike(self, blocks: Sequence[SampleBlock]) -> Iterator[Record]:
        """The records of ``blocks`` of one length; what changes in between holds from the next block on."""
        while blocks:
            first = blocks[0]
            if self._correction.uses_time and START not in self._surroundings.known:
                yield self._environment_change(first.index, {START: float(first.t_ns[0])})
            changes = self._changes
            volts = [self._calibration.observed(block.volts) for block in blocks]
            samples = [self._dots(block, block_volts) for block, block_volts in zip(blocks, volts, strict=True)]
            measures = measured(volts, samples)
            observed = list(self._classified(blocks, measures))
            readings = self.estimation.fit(observed)
            done = 0
            for inputs in zip(blocks, measures, observed, readings, strict=True):
                yield from self._block(*inputs)
                done += 1
                if self._changes != changes:
                    # The others were fitted with what no longer holds.
                    break
            blocks = blocks[done:]

    def _block(
        self, block: SampleBlock, measures: BlockMeasures, observed: BlockInput, readings: BlockReadings | None
    ) -> Iterator[Record]:
        self.counters.samples += len(block.seq)
        self._end_ns = int(block.t_ns[-1])
        self._stillness.blocks = observed.frozen
        verdict = observed.verdict
        solvable = verdict.status is BlockStatus.OK or verdict.sound
        answer = self.estimation.solve(observed, readings) if solvable else BlockSolution(observed.means)
        self.last_estimate = answer.estimate
        fitted = None if answer.solved is None else answer.solved.readings.fitted
        self.estimator.record(fitted, self.estimation.missing_psds(answer.solved))
        status, reason = answer.failure or (verdict.status, verdict.reason)
        self._count(status, verdict, answer)
        yield from self._estimates(observed, answer, status)
        # The estimates are out: the rest is not urgent. What this block teaches applies from the next one on.
        if status is BlockStatus.OK and not verdict.findings and not (answer.solved and answer.solved.excluded_psd):
            self._learn(observed, measures)
        findings = self._findings(measures, observed, answer)
        self.last_spots = SpotMeans(
            t_ns=observed.t_ns,
            index=observed.index,
            dots=answer.dots,
            sums=measures.mean_sums,
            covariance=measures.covariance,
            present=len(observed.slots),
            lost=self._cutter.block_size - len(observed.slots),
            status=status,
            reason=reason,
            findings=findings,
            excluded=self.estimator.excluded,
            published=observed.fully_published,
        )
        yield self.last_spots
        yield block

    def _classified(self, blocks: Sequence[SampleBlock], measures: Iterable[BlockMeasures]) -> Iterator[BlockInput]:
        """The dots of each block, and whether lasers and detectors are sound."""
        frozen = self._stillness.blocks
        size = self._cutter.block_size
        seq, t_ns = np.array([block.seq for block in blocks]), np.array([block.t_ns for block in blocks])
        middles = middles_ns(seq, t_ns, size, self._period_ns)
        for block, block_measures, slots, middle in zip(blocks, measures, seq % size, middles, strict=True):
            frozen = self._optics.frozen(frozen, block_measures)
            yield BlockInput(
                t_ns=middle,
                index=block.index,
                slots=slots,
                samples=block_measures.samples,
                means=block_measures.means,
                mean_sums=block_measures.mean_sums,
                verdict=self._optics.classify(block, block_measures, frozen),
                frozen=frozen,
                fully_published=block.index % self.rig.estimator.decimation == 0,
            )

    def _count(self, status: BlockStatus, verdict: Verdict, answer: BlockSolution) -> None:
        counters = self.counters
        counters.blocks += 1
        if answer.estimate is None:
            name = status.name.lower()
            counters.rejected[name] = counters.rejected.get(name, 0) + 1
            return
        counters.estimates += 1
        counters.degraded += verdict.status is not BlockStatus.OK or not answer.complete

    def _estimates(self, observed: BlockInput, answer: BlockSolution, status: BlockStatus) -> Iterator[Record]:
        """The primary estimate first, then its load, the motion and the other solvers' estimates."""
        best, solved = answer.estimate, answer.solved
        if best is not None:
            yield best
            if solved is not None:
                load = self.tip_loads.tip_load(observed.index, best.dx, best.dy, best.theta)
                if observed.fully_published:
                    yield TipLoad(observed.t_ns, *load)
        if self.motion_filter is not None:
            # A pose without all PSDs has other noise than the filter is set for: it predicts only.
            usable = status is BlockStatus.TOO_FEW_SAMPLES or (status is BlockStatus.OK and answer.complete)
            # A block without a fit does not say which tones it follows.
            tones = self.estimator.noise.tones if answer.solved is None else self.estimator.vibrating
            moved = self._moved(self.motion_filter, observed, usable, tones)
            if moved is not None:
                yield moved
        self._keep_for_zero(observed, answer)
        if observed.fully_published and best is not None and solved is not None:
            yield from self.estimation.other_estimates(observed, solved)

    def _keep_for_zero(self, observed: BlockInput, answer: BlockSolution) -> None:
        """Keep the dots of the last good blocks; a zero must not be a mean across an outage."""
        if answer.estimate is None or answer.solved is None or not answer.complete:
            self._recent.clear()
            return
        last = self.last_spots
        if last is not None and observed.t_ns - last.t_ns > ZERO_BLOCKS * self._cutter.block_size * self._period_ns:
            self._recent.clear()
        self._recent.append((observed.t_ns, answer.solved.readings.dots))

    def _findings(self, measures: BlockMeasures, observed: BlockInput, answer: BlockSolution) -> tuple[str, ...]:
        """Return the findings of a block, and count them."""
        findings, solved = observed.verdict.findings, answer.solved
        if solved is not None and solved.excluded_psd:
            findings = (*findings, f'psd_{solved.excluded_psd} contradicts the others and is left out')
        if answer.complete and solved is not None and solved.check_result is not None:
            self.estimator.search_outliers(observed.index, solved.readings.dots, solved.check_result)
        findings += self._optics.late_findings(measures, observed.verdict, observed.frozen, self._loudness)
        findings += self.estimator.findings
        if answer.estimate is not None:
            findings += self._calibrated.findings(answer.estimate.pose)
        self.counters.count_findings(findings)
        return findings

    def _learn(self, observed: BlockInput, measures: BlockMeasures) -> None:
        """Update the measured noise with a good block, and the filter with the noise."""
        changed = self.estimator.learn(observed.index, observed.slots, observed.samples, measures.volts)
        if not changed:
            return
        self._changes += 1
        if self.motion_filter is not None:
            self.motion_filter.set_noise(self.estimator.noise.gamma)

    def _moved(
        self, motion: ModalFilter, observed: BlockInput, usable: bool, tones: Sequence[Tone]
    ) -> TipMotion | None:
        """The motion by the filter; ``usable``: whether samples of the block can be used; ``tones``: not followed."""
        slots, poses = observed.slots, None
        if usable:
            solved = self.estimation.primary.solve_many(observed.samples, np.array(self.estimation.variances[0]))
            sound = solved.status == SolverStatus.OK
            if sound.any():
                slots, poses = slots[sound], solved.pose[sound]
        moved = motion.block(observed.index, observed.t_ns, slots if poses is not None else None, poses)
        if moved is None:
            return None
        systematic = self.estimation.systematic
        covariance = moved.covariance if systematic is None else moved.covariance + systematic
        velocity_covariance = moved.velocity_covariance
        if tones:
            pose, rate = self.estimation.vibration(tones)
            covariance, velocity_covariance = covariance + pose, velocity_covariance + rate
        dx, dy, theta = moved.pose.tolist()
        vx, vy, vtheta = moved.velocity.tolist()
        return TipMotion(
            t_ns=moved.t_ns,
            block=observed.index,
            dx=dx,
            dy=dy,
            theta=theta,
            phi=0.0,
            omega=0.0,
            covariance=tuple(covariance.ravel().tolist()),
            vx=vx,
            vy=vy,
            vtheta=vtheta,
            velocity_covariance=tuple(velocity_covariance.ravel().tolist()),
            coasted=moved.coasted,
        )
