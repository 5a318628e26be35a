"""From chunks of samples to records; the live run and replay use the same class.

It owns no clock, thread or I/O. Its output depends only on the rig, the samples and the order of
calls, so ``replay`` reproduces it bit for bit. The steps are: counts -> volts -> blocks -> dots in
metres -> correction of the effects in the rig file -> health checks -> solvers -> estimates, and
the tip load that the link model computes from them.

It has some state from block to block: the twist that ``degraded: hold`` keeps, for how long a
detector's values have not changed, and what effects of the link remember of past loads. When a
recording starts, this state is written as a record (:meth:`Pipeline.memory`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import ARITHMETICS
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.averaging import BlockCutter, block_middle_ns, covariance
from psd_deflection.measure.correction import Correction
from psd_deflection.measure.estimation import BlockSolution, Dots, Estimation, HeldTwist, SeenBlock
from psd_deflection.measure.health import OpticsHealth
from psd_deflection.measure.motion.motion import INERTIA, STATE, ModalFilter, joined_ns, split_ns
from psd_deflection.measure.uncertainty.rest import why_moving
from psd_deflection.measure.uncertainty.stamped import FIT, HELD_RESIDUAL, NOISE, REDUNDANCY, SOME
from psd_deflection.model.detector import VoltsToDots, counts_to_volts
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.simulation.tip_load import TipLoads
from psd_deflection.model.solvers.interface import SolverStatus
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    RESTART,
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    IntArray,
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

START, FIRST_TEMPERATURE, TEMPERATURE = ENVIRONMENT
HELD, FROZEN, TIP_LOADS = 'state.held_twist', 'state.frozen_blocks', 'state.tip_loads'
SYSTEMATIC = 'state.systematic'
ZERO_VARIANCES = 'state.zero_variances'
REMEMBERED = (NOISE, FIT, HELD_RESIDUAL, REDUNDANCY)
"""Names of the values in the record of :meth:`Pipeline.memory`."""


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
    refused: dict[str, int] = field(default_factory=dict)
    findings: dict[str, int] = field(default_factory=dict)


class Pipeline:
    """Samples in, records out.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.counters = PipelineCounters()
        self.last_estimate: DeflectionEstimate | None = None
        self.last_spots: SpotMeans | None = None
        config = rig.estimator
        self._by = ARITHMETICS[config.arithmetic]
        self._cutter = BlockCutter(config.block_size)
        self._period_ns = 1e9 / rig.converter.sample_rate_hz
        self._effects = effects_of_rig(rig)
        self.tip_loads = TipLoads(rig, self._effects if config.wrench == 'effects' else ())
        self._recent: list[Dots] = []
        self._environment: dict[str, float] = {}
        self.zero_refused = ''
        self._end_ns: int | None = None
        self._frozen: tuple[int, ...] = (0,) * len(rig.psds)
        self.estimation = Estimation(rig, self._effects)
        self.stamped = self.estimation.stamped
        self._take(rig)
        self.motion_filter = self._new_filter()

    def _new_filter(self) -> ModalFilter | None:
        """The filter of the motion at the rig's present zero; None if the rig asks for none."""
        if self.rig.estimator.filter == 'none':
            return None
        gain = self.estimation.gain_at_rest()
        return ModalFilter(self.rig, self.tip_loads.compliance, gain, self.stamped.noise.gamma)

    def _take(self, rig: Rig) -> None:
        self.rig = rig
        self._calibration = VoltsToDots.from_rig(rig)
        self._correction = Correction(rig, self._effects)
        self._optics = OpticsHealth(rig)

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
        for block in self._cutter.add(chunk, volts):
            if self._correction.uses_time and START not in self._environment:
                yield self._environment_change(block.index, {START: float(block.t_ns[0])})
            yield from self._block(block)

    def flush(self) -> Iterator[Record]:
        """The records of the unfinished block; call it when the stream ended or restarts."""
        for block in self._cutter.flush():
            yield from self._block(block)

    def zero(self) -> ParameterChange | None:
        """Use the mean dots of the last blocks as the unloaded dots, from the next block on.

        None if the last block was not good, if there is none yet, or if the link moves; ``zero_refused`` says the
        last. Replay applies the returned record again.
        """
        self.zero_refused = ''
        if not self._recent:
            return None
        recent = np.array(self._recent)
        noise = self.estimation.zero_noise(self._cutter.block_size)
        self.zero_refused = why_moving(recent, noise)
        if self.zero_refused:
            return None
        means = [self._by.total(column) / len(self._recent) for column in zip(*self._recent, strict=True)]
        values: dict[str, float | str | tuple[float, ...]] = dict(
            zip(ZEROS, zip(means[0::2], means[1::2], strict=True), strict=False)
        )
        if self.estimation.spread is not None:
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
        """Use the changed values from now on. Raises ConfigError if one is out of bounds."""
        values = {name: list(v) if isinstance(v, tuple) else v for name, v in change.values}
        for name in ENVIRONMENT:
            value = values.pop(name, None)
            if isinstance(value, (int, float)):
                self._environment[name] = float(value)
        # It says which numbers belong to no sample; no estimate depends on it.
        values.pop(RESTART, None)
        held, frozen, loads = values.pop(HELD, None), values.pop(FROZEN, None), values.pop(TIP_LOADS, None)
        motion, load, inertia = values.pop(STATE, None), values.pop(KNOWN_LOAD, None), values.pop(INERTIA, None)
        systematic = values.pop(SYSTEMATIC, None)
        names = [name for name in values if name in REMEMBERED or name.startswith(SOME)]
        told = {name: tuple(v) for name in names if isinstance(v := values.pop(name), list)}
        if isinstance(held, list) and len(held) == 3:
            self.estimation.held = HeldTwist(int(held[0]), held[1], held[2])
        if isinstance(frozen, list) and len(frozen) == len(self._frozen):
            self._frozen = tuple(map(int, frozen))
        variances = values.pop(ZERO_VARIANCES, None)
        if isinstance(variances, list) and len(variances) == 2 * len(self.rig.psds):
            self.estimation.zero_variances = tuple(variances)
        if any(name in ZEROS for name in values):
            self.tip_loads.zeroed = True
            if variances is None:
                # A zero from elsewhere: of as many blocks, with the noise of the rig file.
                self.estimation.zero_variances = tuple(v / ZERO_BLOCKS for v in self.estimation.variances[-1])
        if isinstance(loads, list):
            self.tip_loads.restore(tuple(loads))
        if values:
            rig = replace_values(self.rig, values, 'change')
            if rig.effects != self.rig.effects:
                self._effects = effects_of_rig(rig)
            self.estimation.build(rig, self._effects)
            self._take(rig)
            self.stamped.set_zeros(self.rig)
            if any(name in ZEROS for name in values):
                # The tip did not move with its zero.
                self.motion_filter = self._new_filter()
        self.stamped.restore(told)
        if self.motion_filter is not None:
            self.motion_filter.set_noise(self.stamped.noise.gamma)
            if isinstance(motion, list):
                self.motion_filter.restore(tuple(motion))
            if isinstance(inertia, list):
                self.motion_filter.restore_inertia(tuple(inertia))
            if isinstance(systematic, list):
                self.estimation.systematic = np.reshape(systematic, (3, 3))
            if isinstance(load, list) and len(load) == 5:
                self.motion_filter.load(AppliedLoad(joined_ns(load[0], load[1]), load[2], load[3], load[4]))

    def memory(self, rig: Rig) -> ParameterChange | None:
        """The state that the next block depends on besides its samples and ``rig``; None if there is none.

        ``rig``: the rig as it was at the start; later changes are part of the memory.
        """
        changed = {name: value for name, value in self.rig.values.items() if value != rig.values[name]}
        values: list[tuple[str, float | str | tuple[float, ...]]] = []
        for name, value in changed.items():
            values.append((name, tuple(map(float, value)) if isinstance(value, list) else value))
        values += self._environment.items()
        estimation = self.estimation
        if estimation.spread is not None and estimation.zero_variances:
            values.append((ZERO_VARIANCES, estimation.zero_variances))
        if estimation.held is not None and self.rig.estimator.degraded == 'hold':
            values.append((HELD, tuple(estimation.held)))
        if any(self._frozen):
            values.append((FROZEN, self._frozen))
        if loads := self.tip_loads.memory():
            values.append((TIP_LOADS, loads))
        if self.last_spots is not None:
            values += self.stamped.memory().items()
        if self.motion_filter is not None and (motion := self.motion_filter.memory()):
            values.append((STATE, motion))
            if estimation.systematic is not None:
                values.append((SYSTEMATIC, tuple(estimation.systematic.ravel().tolist())))
        if self.motion_filter is not None and (inertia := self.motion_filter.inertia_memory()):
            values.append((INERTIA, inertia))
        if not values:
            return None
        last = self.last_spots
        t_ns, block = (last.t_ns, last.index + 1) if last is not None else (0, 0)
        return ParameterChange(t_ns, block, tuple(values))

    def load(self, load: AppliedLoad) -> ParameterChange | None:
        """Tell the filter of the motion a known load; None if there is no filter, or if it holds already.

        What the load does before the next block is not foretold.
        """
        if self.motion_filter is None or not self.motion_filter.is_new(load):
            return None
        return self.change({KNOWN_LOAD: (*split_ns(load.t_ns), load.fx, load.fy, load.tz)})

    def accelerate(self, base: BaseAcceleration, there_ns: int | None = None) -> int | None:
        """Tell the filter of the motion a known acceleration of the base, from the next block on.

        ``there_ns``: in a replay, when it was there. Returns the time (ns) to record for that: just after the last
        block. A replay tells it before the next block whose last sample is not before that. None if there is no
        filter, or no block yet. Raises ValueError if the acceleration cannot be used.
        """
        if there_ns is None and self._end_ns is not None:
            there_ns = self._end_ns + 1
        if self.motion_filter is None or there_ns is None:
            return None
        self.motion_filter.inertia.tell(base, there_ns)
        return there_ns

    def temperature(self, celsius: float) -> ParameterChange | None:
        """Set the ambient temperature from the next block on; None if no correction needs it."""
        if not self._correction.uses_temperature:
            return None
        index = self.last_spots.index + 1 if self.last_spots is not None else 0
        first = self._environment.get(FIRST_TEMPERATURE, celsius)
        return self._environment_change(index, {FIRST_TEMPERATURE: first, TEMPERATURE: celsius})

    def _environment_change(self, block: int, values: Mapping[str, float]) -> ParameterChange:
        self._environment.update(values)
        t_ns = self.last_spots.t_ns if self.last_spots is not None else 0
        return ParameterChange(t_ns, block, tuple(self._environment.items()))

    def _corrected(self, block: SampleBlock, samples: FloatArray, sums: FloatArray) -> FloatArray:
        held = self._environment
        warmer = held.get(TEMPERATURE, 0.0) - held.get(FIRST_TEMPERATURE, 0.0)
        t: FloatArray = (block.t_ns - held.get(START, float(block.t_ns[0]))) * np.float64(1e-9)
        return self._correction.apply(samples, sums, warmer, t)

    def dots(self, block: SampleBlock) -> FloatArray:
        """Dots (n, 2P), m, of the samples of ``block``, calibrated and corrected as for the estimate."""
        volts = self._calibration.seen(block.volts)
        samples = self._calibration.dots(volts)
        if not self._correction.active:
            return samples
        return self._corrected(block, samples, volts[:, 2::3].astype(np.float64))

    def _block(self, block: SampleBlock) -> Iterator[Record]:
        size = self._cutter.block_size
        present = len(block.seq)
        self.counters.samples += present
        self.counters.blocks += 1
        self._end_ns = int(block.t_ns[-1])
        volts = self._calibration.seen(block.volts)
        sums = volts[:, 2::3].astype(np.float64)
        samples = self.dots(block)
        means: Dots = tuple((self._by.sum(samples, 0) / present).tolist())
        if self._optics.refuses_frozen:
            self._count_still(volts)
        verdict = self._optics.judge(block, volts, means, sums, self._frozen)
        status, reason, findings = verdict.status, verdict.reason, verdict.findings
        t_ns = block_middle_ns(block, size, self._period_ns)
        slots = block.seq - block.index * size
        seen = SeenBlock(t_ns, block.index, slots, samples, means, sums, verdict, self._frozen)
        answer = self.estimation.solve(seen) if status is BlockStatus.OK or verdict.sound else BlockSolution(means)
        used, best = answer.used, answer.estimate
        degraded = status is not BlockStatus.OK
        if answer.failure is not None:
            status, reason = answer.failure
        if used is not None and used.wrong:
            findings = (*findings, f'psd_{used.wrong} contradicts the others and is left out')
        self.last_estimate = best
        left_out = self.estimation.left_out(used)
        self.stamped.left_out = left_out
        if best is not None:
            self.counters.estimates += 1
            self.counters.degraded += degraded or not answer.complete
            yield best
        if best is not None and used is not None:
            yield TipLoad(t_ns, *self.tip_loads.tip_load(block.index, best.dx, best.dy, best.theta))
        if self.motion_filter is not None:
            # Poses of some PSDs have another noise than the filter knows: it coasts.
            usable = status is BlockStatus.TOO_FEW_SAMPLES or (status is BlockStatus.OK and answer.complete)
            moved = self._moved(self.motion_filter, block.index, t_ns, slots, samples if usable else None)
            if moved is not None:
                yield moved
        if best is not None and used is not None:
            if answer.complete:
                # The zero must not be a mean across an outage.
                last = self.last_spots
                if last is not None and t_ns - last.t_ns > ZERO_BLOCKS * size * self._period_ns:
                    self._recent = []
                self._recent = [*self._recent[1 - ZERO_BLOCKS :], used.dots]
            else:
                self._recent = []
            yield from self.estimation.others(seen, used)
        else:
            self._recent = []
        if best is None:
            name = status.name.lower()
            self.counters.refused[name] = self.counters.refused.get(name, 0) + 1
        # The estimates are out: the rest is not urgent.
        sound = status is BlockStatus.OK and not findings
        if sound and self.stamped.learn(block.index, slots, samples) and self.motion_filter is not None:
            self.motion_filter.set_noise(self.stamped.noise.gamma)
        if answer.complete and used is not None and used.checked is not None:
            self.stamped.suspect(block.index, used.dots, used.checked)
        if not self._optics.refuses_frozen:
            self._count_still(volts)
        findings += self._optics.late_findings(volts, verdict, self._frozen)
        for finding in findings:
            name = finding.split(':')[0]
            self.counters.findings[name] = self.counters.findings.get(name, 0) + 1
        spots = SpotMeans(
            t_ns,
            block.index,
            answer.dots,
            tuple((self._by.sum(sums, 0) / present).tolist()),
            covariance(samples, self._by),
            present,
            size - present,
            status,
            reason,
            findings,
            left_out,
        )
        self.last_spots = spots
        yield spots
        yield block

    def _moved(
        self, motion: ModalFilter, block: int, t_ns: int, slots: IntArray, samples: FloatArray | None
    ) -> TipMotion | None:
        """The motion by the filter; ``samples`` (n, 4) m, None if none of the block can be used."""
        poses: FloatArray | None = None
        if samples is not None:
            solved = self.estimation.primary.solve_many(samples, np.array(self.estimation.variances[0]))
            sound = solved.status == SolverStatus.OK
            if sound.any():
                slots, poses = slots[sound], solved.pose[sound]
        moved = motion.block(block, t_ns, slots if poses is not None else None, poses)
        if moved is None:
            return None
        systematic = self.estimation.systematic
        covariance = moved.covariance if systematic is None else moved.covariance + systematic
        dx, dy, theta = moved.pose.tolist()
        vx, vy, vtheta = moved.velocity.tolist()
        return TipMotion(
            moved.t_ns,
            block,
            dx,
            dy,
            theta,
            0.0,
            0.0,
            tuple(covariance.ravel().tolist()),
            vx,
            vy,
            vtheta,
            tuple(moved.velocity_covariance.ravel().tolist()),
            moved.coasted,
        )

    def _count_still(self, volts: npt.NDArray[np.float32]) -> None:
        still = self._optics.still(volts)
        self._frozen = tuple(n + 1 if same else 0 for n, same in zip(self._frozen, still, strict=True))
