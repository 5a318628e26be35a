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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, expm1, nan, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.averaging import BlockCutter, block_middle_ns, covariance
from psd_deflection.calibration import Calibration, counts_to_volts, dot_noise_variances
from psd_deflection.calibration.health import FROZEN_BLOCKS, OpticsHealth, Verdict
from psd_deflection.config import ZEROS, Rig, replace_values
from psd_deflection.correction import Correction
from psd_deflection.errors import ConfigError
from psd_deflection.filtering.motion import STATE, ModalFilter, joined_ns, split_ns
from psd_deflection.geometry import Geometry
from psd_deflection.misalignment.spread import ParameterSpread
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    RESTART,
    AppliedLoad,
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
    dot_names,
)
from psd_deflection.simulation.catalogue import effects_of_rig
from psd_deflection.simulation.tip_load import TipLoads
from psd_deflection.solvers import solver_from_rig
from psd_deflection.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.solvers.one_psd import NAME as ONE_PSD
from psd_deflection.solvers.one_psd import OnePsd
from psd_deflection.solvers.registry import psds_at_base, solver_class
from psd_deflection.solvers.some_psds import solver_of_some
from psd_deflection.uncertainty.consistency import Checked, widened
from psd_deflection.uncertainty.stamped import FIT, HELD_RESIDUAL, NOISE, REDUNDANCY, SOME, SomePsds, StampedDots

ZERO_BLOCKS = 25
"""Number of blocks that :meth:`Pipeline.zero` averages: half a second."""

MOVING, RINGS, STILL = 5.0, 10e-6, 2e-6
"""A zero is refused if the dots scatter or drift by so many times the noise and by more than so much, m: see
:func:`motion`."""

START, FIRST_TEMPERATURE, TEMPERATURE = ENVIRONMENT
HELD, FROZEN, TIP_LOADS = 'state.held_twist', 'state.frozen_blocks', 'state.tip_loads'
SYSTEMATIC = 'state.systematic'
ZERO_VARIANCES = 'state.zero_variances'
REMEMBERED = (NOISE, FIT, HELD_RESIDUAL, REDUNDANCY)
"""Names of the values in the record of :meth:`Pipeline.memory`."""

Dots = tuple[float, ...]


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


class _Held(NamedTuple):
    """The last twist that was measured: ns, rad, rad^2."""

    t_ns: int
    theta: float
    variance: float


class _Readings(NamedTuple):
    """What a block is solved from.

    ``dots`` (C,) m; ``variances`` (C,) m^2; ``spread`` (C, C) m^2 of the dots, None if ``variances`` are all of it.
    ``kept``: the PSDs (from 0) that they are of, with their fit and check ``some``; None: all. ``checked``: the check
    of the readings. ``factor``: what the calibration's uncertainty makes of the dots. ``wrong``: the PSD (from 1) that
    contradicts them.
    """

    dots: Dots
    variances: tuple[float, ...]
    spread: FloatArray | None = None
    kept: tuple[int, ...] | None = None
    some: SomePsds | None = None
    checked: Checked | None = None
    factor: FloatArray | None = None
    wrong: int = 0


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
        self._cutter = BlockCutter(config.block_size)
        self._period_ns = 1e9 / rig.converter.sample_rate_hz
        self._effects = effects_of_rig(rig)
        self.tip_loads = TipLoads(rig, self._effects if config.wrench == 'effects' else ())
        self._recent: list[Dots] = []
        self._environment: dict[str, float] = {}
        self._zero_variances: tuple[float, ...] = ()
        self.zero_refused = ''
        self._held: _Held | None = None
        self._frozen: tuple[int, ...] = (0,) * len(rig.psds)
        variances = dot_noise_variances(rig)
        self._variances = [tuple(float(v) / n for v in variances) for n in range(1, config.block_size + 1)]
        self._build(rig)
        # After the solvers, which refuse a geometry that cannot be solved.
        self.stamped = StampedDots(rig, flat=not psds_at_base(rig), tilts=solver_class(config.solver).tilts)
        # What the covariance of the last estimate holds besides noise.
        self._systematic: FloatArray | None = None
        self.motion_filter = self._new_filter()

    def _new_filter(self) -> ModalFilter | None:
        """The filter of the motion at the rig's present zero; None if the rig asks for none."""
        if self.rig.estimator.filter == 'none':
            return None
        _, solver, _ = self._solvers[0]
        at_rest = tuple(self.rig.zeros.ravel().tolist())
        gain = solver.gain(at_rest, self._variances[0], solver.solve(at_rest, self._variances[0]))
        compliance = self.tip_loads.compliance
        return ModalFilter(self.rig, compliance, gain, self.stamped.noise.gamma)

    def _build(self, rig: Rig) -> None:
        self.rig = rig
        self._calibration = Calibration.from_rig(rig)
        self._correction = Correction(rig, self._effects)
        self._optics = OpticsHealth(rig)
        self._one_psd = OnePsd(Geometry.from_rig(rig))
        config = rig.estimator
        self._spread = None if psds_at_base(rig) else ParameterSpread.from_rig(rig, self._zero_variances, self._effects)
        names = [config.solver, *(name for name in config.solvers if name != config.solver)]
        self._solvers = [(name, solver_from_rig(name, rig), name == config.solver) for name in names]
        self._some_solvers: dict[tuple[int, tuple[int, ...]], Solver | None] = {}

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
        if not self._recent or self.last_spots is None:
            return None
        recent = np.array(self._recent)
        noise = self.stamped.mean_variances(self._cutter.block_size) if self.stamped.flat else self._variances[-1]
        self.zero_refused = motion(recent, noise)
        if self.zero_refused:
            return None
        means = [sum(column) / len(self._recent) for column in zip(*self._recent, strict=True)]
        values: dict[str, float | str | tuple[float, ...]] = dict(
            zip(ZEROS, zip(means[0::2], means[1::2], strict=True), strict=False)
        )
        if self._spread is not None:
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
        motion, load = values.pop(STATE, None), values.pop(KNOWN_LOAD, None)
        systematic = values.pop(SYSTEMATIC, None)
        names = [name for name in values if name in REMEMBERED or name.startswith(SOME)]
        told = {name: tuple(v) for name in names if isinstance(v := values.pop(name), list)}
        if isinstance(held, list) and len(held) == 3:
            self._held = _Held(int(held[0]), held[1], held[2])
        if isinstance(frozen, list) and len(frozen) == len(self._frozen):
            self._frozen = tuple(map(int, frozen))
        variances = values.pop(ZERO_VARIANCES, None)
        if isinstance(variances, list) and len(variances) == 2 * len(self.rig.psds):
            self._zero_variances = tuple(variances)
        if any(name in ZEROS for name in values):
            self.tip_loads.zeroed = True
            if variances is None:
                # A zero from elsewhere: of as many blocks, with the noise of the rig file.
                self._zero_variances = tuple(v / ZERO_BLOCKS for v in self._variances[-1])
        if isinstance(loads, list):
            self.tip_loads.restore(tuple(loads))
        if values:
            rig = replace_values(self.rig, values, 'change')
            if rig.effects != self.rig.effects:
                self._effects = effects_of_rig(rig)
            self._build(rig)
            self.stamped.set_zeros(self.rig)
            if any(name in ZEROS for name in values):
                # The tip did not move with its zero.
                self.motion_filter = self._new_filter()
        self.stamped.restore(told)
        if self.motion_filter is not None:
            self.motion_filter.set_noise(self.stamped.noise.gamma)
            if isinstance(motion, list):
                self.motion_filter.restore(tuple(motion))
            if isinstance(systematic, list):
                self._systematic = np.reshape(systematic, (3, 3))
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
        if self._spread is not None and self._zero_variances:
            values.append((ZERO_VARIANCES, self._zero_variances))
        if self._held is not None and self.rig.estimator.degraded == 'hold':
            values.append((HELD, tuple(self._held)))
        if any(self._frozen):
            values.append((FROZEN, self._frozen))
        if loads := self.tip_loads.memory():
            values.append((TIP_LOADS, loads))
        if self.last_spots is not None:
            values += self.stamped.memory().items()
        if self.motion_filter is not None and (motion := self.motion_filter.memory()):
            values.append((STATE, motion))
            if self._systematic is not None:
                values.append((SYSTEMATIC, tuple(self._systematic.ravel().tolist())))
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
        volts = self._calibration.seen(block.volts)
        sums = volts[:, 2::3].astype(np.float64)
        samples = self.dots(block)
        means: Dots = tuple((samples.sum(axis=0) / present).tolist())
        if self._optics.refuses_frozen:
            self._count_still(volts)
        verdict = self._optics.judge(block, volts, means, sums, self._frozen)
        status, reason, findings = verdict.status, verdict.reason, verdict.findings
        t_ns = block_middle_ns(block, size, self._period_ns)
        slots = block.seq - block.index * size
        whole = _Readings(means, self._variances_of(verdict, sums, present))
        used: _Readings | None = None
        best: DeflectionEstimate | None = None
        failure: tuple[BlockStatus, str] | None = None
        degraded = False

        def take(kept: tuple[int, ...]) -> _Readings | None:
            return self._some(kept, verdict, sums, whole, slots, samples)

        if status is BlockStatus.OK:
            if self.stamped.active:
                fitted = self.stamped.fit(slots, samples)
                whole = whole._replace(dots=fitted.dots, spread=self._spread_of(verdict, sums, fitted.covariance))
            used, best, failure = self._agreed(t_ns, block.index, whole, take)
            if failure is not None:
                status, reason = failure
            elif best is not None:
                self._held = _Held(t_ns, best.theta, best.variances[2])
        elif verdict.sound:
            if self.rig.estimator.covariance != 'file' and self.stamped.flat:
                whole = whole._replace(variances=self.stamped.mean_variances(present))
            others = None
            if len(verdict.sound) > 1:
                others = take(verdict.sound)
            if others is not None:
                used, best, failure = self._agreed(t_ns, block.index, others, take)
                if failure is not None:
                    status, reason = failure
                elif best is not None:
                    self._held = _Held(t_ns, best.theta, best.variances[2])
            elif len(verdict.sound) == 1:
                best = self._from_the_other(verdict.sound[0], t_ns, block.index, whole)
            degraded = best is not None
        if used is not None and used.wrong:
            findings = (*findings, f'psd_{used.wrong} contradicts the others and is left out')
        self.last_estimate = best
        complete = used is not None and used.kept is None
        left_out = self._left_out(used)
        self.stamped.left_out = left_out
        if best is not None:
            self.counters.estimates += 1
            self.counters.degraded += degraded or not complete
            yield best
        if best is not None and used is not None:
            yield TipLoad(t_ns, *self.tip_loads.tip_load(block.index, best.dx, best.dy, best.theta))
        if self.motion_filter is not None:
            # Poses of some PSDs have another noise than the filter knows: it coasts.
            usable = status is BlockStatus.TOO_FEW_SAMPLES or (status is BlockStatus.OK and complete)
            moved = self._moved(self.motion_filter, block.index, t_ns, slots, samples if usable else None)
            if moved is not None:
                yield moved
        if best is not None and used is not None:
            if complete:
                # The zero must not be a mean across an outage.
                last = self.last_spots
                if last is not None and t_ns - last.t_ns > ZERO_BLOCKS * size * self._period_ns:
                    self._recent = []
                self._recent = [*self._recent[1 - ZERO_BLOCKS :], used.dots]
            else:
                self._recent = []
            for number in range(1, len(self._solvers)):
                solution, _ = self._solve(number, used)
                if solution is not None:
                    yield self._estimate(number, t_ns, block.index, solution, used)
        else:
            self._recent = []
        if best is None:
            name = status.name.lower()
            self.counters.refused[name] = self.counters.refused.get(name, 0) + 1
        # The estimates are out: the rest is not urgent.
        sound = status is BlockStatus.OK and not findings
        if sound and self.stamped.learn(block.index, slots, samples) and self.motion_filter is not None:
            self.motion_filter.set_noise(self.stamped.noise.gamma)
        if complete and used is not None and used.checked is not None:
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
            whole.dots,
            tuple((sums.sum(axis=0) / present).tolist()),
            covariance(samples),
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
            solved = self._solvers[0][1].solve_many(samples, np.array(self._variances[0]))
            sound = solved.status == SolverStatus.OK
            if sound.any():
                slots, poses = slots[sound], solved.pose[sound]
        moved = motion.block(block, t_ns, slots if poses is not None else None, poses)
        if moved is None:
            return None
        covariance = moved.covariance if self._systematic is None else moved.covariance + self._systematic
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

    def _agreed(
        self,
        t_ns: int,
        block: int,
        readings: _Readings,
        take: Callable[[tuple[int, ...]], _Readings | None],
    ) -> tuple[_Readings, DeflectionEstimate | None, tuple[BlockStatus, str] | None]:
        """:meth:`_primary`, without the PSD that contradicts the others if it can be told; ``take``: :meth:`_some`."""
        before = tuple(range(len(self.rig.psds))) if readings.kept is None else readings.kept
        taken: dict[int, _Readings | None] = {}

        def without(psd: int) -> _Readings | None:
            # Once a block: a fit remembers the motion that it saw.
            if psd not in taken:
                taken[psd] = take(tuple(p for p in before if p != psd))
            return taken[psd]

        def agree_without(number: int) -> bool:
            others = without(before[number - 1])
            return others is not None and self._agree(others)

        if len(before) < 3 or self.rig.estimator.consistency == 'report':
            return self._primary(t_ns, block, readings)
        found = self._primary(t_ns, block, readings, agree_without)
        checked = found[0].checked
        wrong = before[checked.wrong - 1] if checked is not None and checked.wrong else -1
        still = [psd for psd in before if self._frozen[psd] >= FROZEN_BLOCKS]
        if wrong < 0 and checked is not None and checked.contradict and len(still) == 1:
            # The check cannot tell, but a detector whose values do not change by one bit tells on itself.
            wrong = still[0]
        others = without(wrong) if wrong >= 0 else None
        return found if others is None else self._primary(t_ns, block, others._replace(wrong=wrong + 1))

    def _agree(self, readings: _Readings) -> bool:
        """Whether the readings of some PSDs agree with each other."""
        solution, _ = self._solve(0, readings)
        if solution is None or readings.some is None:
            return False
        spread = np.diag(readings.variances) if readings.spread is None else readings.spread
        return self.stamped.agree(readings.some, readings.dots, solution.residual, spread, solution[:5])

    def _some(
        self,
        kept: tuple[int, ...],
        verdict: Verdict,
        sums: FloatArray,
        whole: _Readings,
        slots: IntArray,
        samples: FloatArray,
    ) -> _Readings | None:
        """The readings of the PSDs ``kept`` (from 0) alone; None if the primary method cannot do with them."""
        solver = self._solver(0, kept)
        if solver is None:
            return None
        some = self.stamped.some(kept, solver.tilts)
        at = some.columns
        dots = tuple(whole.dots[i] for i in at)
        readings = _Readings(dots, tuple(whole.variances[i] for i in at), kept=kept, some=some)
        if not self.stamped.active:
            return readings
        fitted = self.stamped.fit_some(some, slots, samples)
        spread = self._spread_of(verdict, sums, fitted.covariance, at)
        return readings._replace(dots=fitted.dots, spread=spread)

    def _left_out(self, used: _Readings | None) -> tuple[int, ...]:
        """The PSDs (from 1) without which a block was solved."""
        if used is None or used.kept is None:
            return ()
        return tuple(n for n in range(1, len(self.rig.psds) + 1) if n - 1 not in used.kept)

    def _solver(self, number: int, kept: tuple[int, ...] | None) -> Solver | None:
        """Solver ``number`` for all PSDs, or for those ``kept`` (from 0); None if it cannot do with them."""
        name, solver, _ = self._solvers[number]
        if kept is None:
            return solver
        key = (number, kept)
        if key not in self._some_solvers:
            self._some_solvers[key] = solver_of_some(name, self.rig, kept)
        return self._some_solvers[key]

    def _primary(
        self, t_ns: int, block: int, readings: _Readings, agree_without: Callable[[int], bool] | None = None
    ) -> tuple[_Readings, DeflectionEstimate | None, tuple[BlockStatus, str] | None]:
        """The readings with their check, the primary solver's estimate, and why there is none.

        ``agree_without``: as :meth:`StampedDots.check` has it.
        """
        solution, failure = self._solve(0, readings)
        if solution is None:
            return readings, None, (BlockStatus.NOT_SOLVED, failure)
        factor = None if self._spread is None else self._spread.factor(solution.dx, solution.dy, solution.theta)
        checked: Checked | None = None
        if self.stamped.flat:
            allowed = np.diag(readings.variances) if readings.spread is None else readings.spread
            if factor is not None:
                allowed = allowed + np.einsum('ik,jk->ij', factor, factor)
            pose = solution[:5]
            checked = self.stamped.check(readings.dots, solution.residual, allowed, pose, readings.some, agree_without)
        readings = readings._replace(checked=checked, factor=factor)
        told = checked is not None and checked.contradict and not checked.wrong
        if checked is not None and told and self.rig.estimator.consistency == 'refuse':
            words = 'four readings' if len(self.rig.psds) == 2 else 'readings'
            reason = f'the {words} contradict each other: chi-square {checked.chi_square:.0f} of {checked.freedom}'
            return readings, None, (BlockStatus.INCONSISTENT, reason)
        return readings, self._estimate(0, t_ns, block, solution, readings), None

    def _solve(self, number: int, readings: _Readings) -> tuple[Solution | None, str]:
        """The answer of solver ``number``, or None and the reason."""
        name = self._solvers[number][0]
        solver = self._solver(number, readings.kept)
        if solver is None:
            return None, f'{name}: takes all PSDs'
        s = solver.solve(readings.dots, readings.variances)
        if s.status is not SolverStatus.OK:
            return None, f'{name}: {s.status.name.lower().replace("_", " ")}'
        return s, ''

    def _estimate(self, number: int, t_ns: int, block: int, s: Solution, readings: _Readings) -> DeflectionEstimate:
        """An answer with its covariance."""
        name, _, primary = self._solvers[number]
        solver = self._solver(number, readings.kept)
        dots, variances, spread, checked = readings.dots, readings.variances, readings.spread, readings.checked
        rms = (sum(r * r for r in s.residual) / len(s.residual)) ** 0.5
        covariance: tuple[float, ...] = s.covariance
        possible = () if checked is None or self.rig.estimator.consistency != 'widen' else checked.possible
        factor = readings.factor
        if primary:
            self._systematic = None
        # A printed threshold method has no covariance, and no slope either.
        known = solver is not None and covariance[0] == covariance[0]
        if solver is not None and known and (spread is not None or any(possible) or factor is not None):
            gain = solver.gain(dots, variances, s)
            if spread is not None:
                own = np.einsum('ic,ck,jk->ij', gain, spread, gain)
                allowance = solver.allowance(dots, variances)
                own = own if allowance is None else own + allowance
            else:
                own = np.array(covariance).reshape(3, 3)
            noise = own
            if factor is not None:
                own = own + _through(gain, factor)
            if any(possible):
                # A check that was made with all PSDs tells nothing of some of them.
                own = widened(own, gain, possible) if len(possible) == gain.shape[1] else own
            if primary and own is not noise:
                self._systematic = own - noise
            covariance = tuple(own.ravel().tolist())
        chi_square = checked.chi_square if primary and checked is not None and checked.freedom else nan
        return DeflectionEstimate(
            t_ns, block, name, s.dx, s.dy, s.theta, s.phi, s.omega, covariance, rms, primary, chi_square
        )

    def _spread_of(
        self, verdict: Verdict, sums: FloatArray, covariance: FloatArray, columns: Sequence[int] | None = None
    ) -> FloatArray:
        """:meth:`_variances_of` for the fit's own covariance (C, C), of the readings ``columns`` or of all."""
        if not verdict.findings:
            return covariance
        background = np.repeat(self._optics.background_variance(sums), 2)
        more = 4.0 if verdict.half_light else 1.0
        return more * covariance + np.diag(background if columns is None else background[list(columns)])

    def _variances_of(self, verdict: Verdict, sums: FloatArray, present: int) -> tuple[float, ...]:
        """Variances of the dots' means, m^2: from the noise, and from missing or foreign light."""
        variances = self._variances[present - 1]
        if not verdict.findings:
            return variances
        background = np.repeat(self._optics.background_variance(sums), 2).tolist()
        # The noise behind the divider grows as the inverse of the light.
        more = 4.0 if verdict.half_light else 1.0
        return tuple(more * v + b for v, b in zip(variances, background, strict=True))

    def _from_the_other(self, psd: int, t_ns: int, block: int, readings: _Readings) -> DeflectionEstimate | None:
        """The translation from the remaining detector ``psd`` (from 0), by the rule that ``degraded`` names."""
        config = self.rig.estimator
        theta, variance = 0.0, config.twist_sd**2
        if config.degraded == 'none':
            return None
        if config.degraded == 'hold':
            held = self._held
            if held is None:
                return None
            age = max(t_ns - held.t_ns, 0) / 1e9
            theta = held.theta
            variance = held.variance + config.twist_sd**2 * -expm1(-age / config.twist_hold)
        x, y = readings.dots[2 * psd : 2 * psd + 2]
        vx, vy = readings.variances[2 * psd : 2 * psd + 2]
        dx, dy, cov = self._one_psd.solve(psd, (x, y), (vx, vy), theta, variance)
        if self._spread is not None:
            gain = np.zeros((3, 4))
            c, s = cos(theta), sin(theta)
            gain[:2, 2 * psd : 2 * psd + 2] = [[-c, s], [-s, -c]]
            own = np.array(cov).reshape(3, 3) + _through(gain, self._spread.factor(dx, dy, theta))
            cov = tuple(own.ravel().tolist())
        return DeflectionEstimate(t_ns, block, ONE_PSD, dx, dy, theta, 0.0, 0.0, cov, 0.0, True)


def _through(gain: FloatArray, factor: FloatArray) -> FloatArray:
    """(3, 3): what dots that spread by ``factor`` (C, k) m do to an answer with ``gain`` (3, C)."""
    moved = np.einsum('ij,jk->ik', gain, factor)
    return np.asarray(np.einsum('ik,jk->ij', moved, moved))


def motion(dots: FloatArray, noise: tuple[float, ...]) -> str:
    """Why ``dots`` (n, C), m, of the last blocks are not those of a link at rest; '' if they may be.

    ``noise`` (C,): variance of a block's dots, m^2. Moving is what scatters ``MOVING`` times as much as the noise says
    and by more than ``RINGS``, or what drifts by as much and by more than ``STILL`` from the first half to the second.
    A mean over whole periods leaves little of what rings, and all of what drifts.
    """
    if len(dots) < 3:
        return ''
    scatter = dots.std(axis=0, ddof=1)
    half = len(dots) // 2
    drift = np.abs(dots[half:].mean(axis=0) - dots[:half].mean(axis=0))
    least = MOVING * np.sqrt(noise)
    beyond = np.maximum(scatter / np.maximum(least, RINGS), drift / np.maximum(least, STILL))
    worst = int(np.argmax(beyond))
    if beyond[worst] <= 1.0:
        return ''
    return (
        f'the link moves: {dot_names(len(noise) // 2)[worst]} varied by {scatter[worst] * 1e6:.1f} um rms in the last '
        f'{len(dots)} blocks, noise explains {noise[worst] ** 0.5 * 1e6:.1f} um; wait until it is at rest'
    )
