# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The dots of one block -> the estimate with its covariance: all readings, or, if their check excludes a PSD, the
others. The state is the last twist that was measured, for ``degraded: hold``."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import nan, pi
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.measure.health import FROZEN_BLOCKS, OpticsHealth, Verdict
from psd_deflection.measure.solving import BlockReadings, Dots, ReadingsRun, SolverAnswer, SolverSet
from psd_deflection.measure.state import State, Value, numbers
from psd_deflection.measure.uncertainty.block_estimator import BlockEstimator
from psd_deflection.measure.uncertainty.block_fit import FittedBlock
from psd_deflection.measure.uncertainty.consistency import ConsistencyResult, Unexplained, widened
from psd_deflection.measure.uncertainty.psd_set import PsdSet
from psd_deflection.measure.uncertainty.vibration import Tone
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.misalignment.rig import ParameterCovariance
from psd_deflection.model.plate import Geometry
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.solvers.interface import Solution, Solver
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.model.solvers.subset import NAME as ONE_PSD
from psd_deflection.model.solvers.subset import OnePsd
from psd_deflection.records import BlockStatus, DeflectionEstimate, FloatArray, IntArray
from psd_deflection.rig.config import Rig

HELD, SYSTEMATIC, ZERO_VARIANCES = 'state.held_twist', 'state.systematic', 'state.zero_variances'
"""Names of the state of :class:`Estimation`."""

Failure = tuple[BlockStatus, str]


@dataclass(frozen=True, slots=True)
class ValidBlock:
    """What is solved: the good samples of a block.

    ``t_ns``: middle of the block, stream time. ``slots`` (n,): places of the samples in the block. ``samples`` (n, 2P):
    their dots, m; ``means`` (2P,): of all. ``mean_sums`` (P,): of the sum signals, V. ``frozen`` (P,): for how many
    blocks each detector's values have not changed. ``due``: whether it has more than its estimate and its samples.
    """

    t_ns: int
    index: int
    slots: IntArray
    samples: FloatArray
    means: Dots
    mean_sums: tuple[float, ...]
    verdict: Verdict
    frozen: tuple[int, ...]
    due: bool


class HeldTwist(NamedTuple):
    """The last twist that was measured: ns, rad, rad^2."""

    t_ns: int
    theta: float
    variance: float


class SolvedReadings(NamedTuple):
    """Readings with the primary solver's solution, None for the reason in ``failure``.

    ``factor`` (C, k) m: square root of what the calibration's uncertainty adds to the dots' covariance, None if
    nothing. ``unexplained``: what no pose explains of the readings. ``checked``: None until the check of their PSDs is
    updated, and for readings that cannot be checked. ``excluded``: the PSD (from 1) that contradicts these readings.
    """

    readings: BlockReadings
    solution: Solution | None
    failure: str = ''
    factor: FloatArray | None = None
    unexplained: Unexplained | None = None
    checked: ConsistencyResult | None = None
    excluded: int = 0


class BlockSolution(NamedTuple):
    """The primary solver's result for a block.

    ``dots`` (2P,) m at the block's timestamp. ``used``: what the estimate is made from; None if it comes from
    one detector or if there is none. ``failure``: why a sound block has no estimate.
    """

    dots: Dots
    used: SolvedReadings | None = None
    estimate: DeflectionEstimate | None = None
    failure: Failure | None = None

    @property
    def complete(self) -> bool:
        """Whether all detectors are in the estimate."""
        return self.used is not None and self.used.readings.psds.is_full


class Estimation:
    """The solvers of a rig and the uncertainty of what they answer.

    ``estimator``: noise, fit and check of the stream. ``systematic`` (3, 3): what the covariance of the last estimate
    holds besides noise, None if nothing. ``held``: see :class:`HeldTwist`. ``zero_variances`` (2P,) m^2 of the rig's
    zero, () if it has none that was taken.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    part = 'the estimate'
    prefixes = (HELD, SYSTEMATIC, ZERO_VARIANCES)

    def __init__(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        config = rig.estimator
        self._xp = FIXED
        variances = dot_noise_variances(rig)
        self.variances = [tuple(float(v) / n for v in variances) for n in range(1, config.block_size + 1)]
        self.zero_variances: tuple[float, ...] = ()
        self.held: HeldTwist | None = None
        self.systematic: FloatArray | None = None
        self.build(rig, effects)
        # After the solvers, which reject a geometry that cannot be solved.
        self.estimator = BlockEstimator(rig, not rig.psds_at_base, solver_class(config.solver).tilts)

    def build(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        """Use ``rig`` from the next block on."""
        self._rig, self._effects = rig, effects
        self._optics = OpticsHealth(rig)
        self._one_psd = OnePsd(Geometry.from_rig(rig))
        self._set_parameter_covariance(self.zero_variances)
        self._solvers = SolverSet(rig)

    def _set_parameter_covariance(self, zero_variances: tuple[float, ...]) -> None:
        """Take the uncertainty of the calibration, and of a zero with these variances (2P,) m^2, () if it has none."""
        self.zero_variances = zero_variances
        at_base = self._rig.psds_at_base
        self.parameter_covariance = (
            None if at_base else ParameterCovariance.from_rig(self._rig, zero_variances, self._effects)
        )

    def state_dict(self) -> State:
        """Return the held twist, what the filter's covariance takes from the last estimate, the zero's variances."""
        out: State = {}
        config = self._rig.estimator
        if self.parameter_covariance is not None and self.zero_variances:
            out[ZERO_VARIANCES] = self.zero_variances
        if self.held is not None and config.degraded == 'hold':
            out[HELD] = tuple(self.held)
        if self.systematic is not None and config.filter != 'none':
            out[SYSTEMATIC] = tuple(self.systematic.ravel().tolist())
        return out

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """See :class:`psd_deflection.measure.state.Part`. Raises ValueError for another number of PSDs."""
        if variances := numbers(values, ZERO_VARIANCES, 'a variance of each reading', 2 * len(self._rig.psds)):
            self._set_parameter_covariance(variances)
        if held := numbers(values, HELD, 'time, twist and variance', 3):
            self.held = HeldTwist(int(held[0]), held[1], held[2])
        if systematic := numbers(values, SYSTEMATIC, 'a covariance', 9):
            self.systematic = np.reshape(systematic, (3, 3))

    @property
    def primary(self) -> Solver:
        """The primary solver, of all detectors."""
        return self._solvers.primary

    def gain_at_rest(self) -> FloatArray:
        """(3, 2P): how the primary solver's answer goes with the dots at the rig's zero."""
        at_rest = tuple(self._rig.zeros.ravel().tolist())
        variances = self.variances[0]
        return self.primary.gain(at_rest, variances, self.primary.solve(at_rest, variances))

    def vibration(self, tones: Sequence[Tone]) -> tuple[FloatArray, FloatArray]:
        """Return the covariance (3, 3) that ``tones`` give the pose, and that of its rate, in SI units."""
        gain = self.gain_at_rest()
        pose, rate = np.zeros((3, 3)), np.zeros((3, 3))
        for tone in tones:
            own = self._xp.einsum('ic,cd,jd->ij', gain, tone.covariance, gain)
            pose += own
            rate += self._xp.square(2.0 * pi * tone.frequency * self._rig.converter.sample_rate_hz) * own
        return pose, rate

    def zero_noise(self, size: int) -> tuple[float, ...]:
        """Variances (2P,), m^2, of the dots of a whole block of ``size`` samples at rest."""
        return self.estimator.mean_variances(size) if self.estimator.on_plate else self.variances[-1]

    def fit(self, blocks: Sequence[ValidBlock]) -> list[BlockReadings | None]:
        """Return all readings of each block, fitted; None for a block whose verdict is not OK. The state stays.

        Blocks that have the same samples are computed together.
        """
        fit = self.estimator.full.fit
        memory = fit.memory
        fitted: list[BlockReadings | None] = []
        for (ok, _), same in itertools.groupby(blocks, _computed_alike):
            together = list(same)
            if not ok:
                fitted += [None] * len(together)
                continue
            slots = together[0].slots
            for run in fit.fit_blocks(slots, np.stack([block.samples for block in together]), memory):
                memory = run.memories[-1]
                variances = self.variances[len(slots) - 1]
                readings = ReadingsRun(self._solvers, self.estimator.full, run.dots, variances, run.covariance)
                fitted += [BlockReadings(readings, at, run.block(at)) for at in range(len(run.dots))]
        return fitted

    def solve(self, block: ValidBlock, readings: BlockReadings | None) -> BlockSolution:
        """Return the primary solver's estimate of a block whose verdict is OK or names sound detectors.

        ``readings``: as :meth:`fit` returns them.
        """
        verdict = block.verdict
        variances = self._with_light(block, self.variances[len(block.slots) - 1])
        if readings is not None:
            self.estimator.full.fit.memory = readings.fitted.memory
            if verdict.findings:
                readings = self._readings(readings.psds, readings.fitted, block, variances)
            return self._solve_consistent(block, readings.dots, variances, readings)
        if self.estimator.on_plate and verdict.sound:
            variances = self._with_light(block, self.estimator.mean_variances(len(block.slots)))
        subset = self._subset(verdict.sound, block, variances) if len(verdict.sound) > 1 else None
        if subset is not None:
            return self._solve_consistent(block, block.means, variances, subset)
        estimate = self._from_one(verdict.sound[0], block, variances) if len(verdict.sound) == 1 else None
        return BlockSolution(block.means, None, estimate)

    def other_estimates(self, block: ValidBlock, used: SolvedReadings) -> Iterator[DeflectionEstimate]:
        """Yield the estimates of the other solvers."""
        for number in range(1, len(self._solvers.names)):
            answer = used.readings.answer(number)
            if answer.solution is not None:
                yield self._estimate(number, block, answer.solution, self._covariance(answer, used))

    def excluded(self, used: SolvedReadings | None) -> tuple[int, ...]:
        """Return the PSDs (from 1) without which a block was solved."""
        if used is None:
            return ()
        return tuple(n for n in range(1, len(self._rig.psds) + 1) if n - 1 not in used.readings.psds.psds)

    def _solve_consistent(
        self, block: ValidBlock, dots: Dots, variances: tuple[float, ...], readings: BlockReadings
    ) -> BlockSolution:
        """Solve ``readings``, without the PSD that contradicts the others if it can be determined.

        ``dots`` (2P,) m to publish, ``variances`` (2P,) m^2 of all PSDs.
        """
        solved, own = self._solved(readings), readings.psds
        may_exclude = len(own.psds) > 2 and self._rig.estimator.consistency != 'report' and self.estimator.on_plate
        if solved.solution is None or not may_exclude:
            return self._finish(block, dots, self._checked(solved, None))
        numbers = own.check.candidates(solved.unexplained, self.estimator.limit_factor)
        subsets = {number: self._solved_without(number, block, variances, own) for number in numbers}
        solved = self._checked(solved, [number for number, subset in subsets.items() if self._agrees(subset)])
        number = self._to_exclude(block, own, solved.checked)
        if number and number not in subsets:
            subsets[number] = self._solved_without(number, block, variances, own)
        without = subsets[number] if number else None
        if without is None:
            return self._finish(block, dots, solved)
        return self._finish(block, dots, self._checked(without, None)._replace(excluded=own.psds[number - 1] + 1))

    def _solved(self, readings: BlockReadings) -> SolvedReadings:
        solution, failure, *_ = readings.answer(0)
        if solution is None:
            return SolvedReadings(readings, None, failure)
        factor = (
            None
            if self.parameter_covariance is None
            else self.parameter_covariance.factor(solution.dx, solution.dy, solution.theta)
        )
        covariance = readings.covariance
        if factor is not None:
            covariance = covariance + self._xp.einsum('ik,jk->ij', factor, factor)
        return SolvedReadings(readings, solution, '', factor, self._unexplained(readings, solution, covariance))

    def _unexplained(self, readings: BlockReadings, solution: Solution, covariance: FloatArray) -> Unexplained | None:
        if not self.estimator.on_plate:
            return None
        return readings.psds.unexplained(readings.dots, solution.residual, covariance, solution[:5])

    def _solved_without(
        self, number: int, block: ValidBlock, variances: tuple[float, ...], psds: PsdSet
    ) -> SolvedReadings | None:
        """Solve the readings of ``psds`` but PSD ``number`` of them (from 1); None if no method can."""
        rest = psds.psds[: number - 1] + psds.psds[number:]
        readings = self._subset(rest, block, variances)
        return None if readings is None else self._solved(readings)

    def _agrees(self, solved: SolvedReadings | None) -> bool:
        """Whether readings are consistent by their noise alone, and enough to tell."""
        if solved is None or solved.solution is None:
            return False
        readings, found = solved.readings, solved.unexplained
        if solved.factor is not None:
            found = self._unexplained(readings, solved.solution, readings.covariance)
        return readings.psds.check.agrees(found, self.estimator.limit_factor)

    def _checked(self, solved: SolvedReadings, blamed: Collection[int] | None) -> SolvedReadings:
        """Update the check of a set of PSDs with a block, and return its readings with the result."""
        if solved.solution is None or not self.estimator.on_plate:
            return solved
        return solved._replace(checked=self.estimator.check(solved.readings.psds, solved.unexplained, blamed))

    def _to_exclude(self, block: ValidBlock, psds: PsdSet, checked: ConsistencyResult | None) -> int:
        """Return the PSD to exclude, from 1 among ``psds``; 0: none."""
        if checked is None or checked.excluded or not checked.contradict:
            return 0 if checked is None else checked.excluded
        # The check cannot tell, but a detector whose values do not change by one bit is known to be wrong.
        still = [n for n, psd in enumerate(psds.psds, 1) if block.frozen[psd] >= FROZEN_BLOCKS]
        return still[0] if len(still) == 1 else 0

    def _finish(self, block: ValidBlock, dots: Dots, used: SolvedReadings) -> BlockSolution:
        """Return the estimate from ``used``, or why there is none; remember its twist and systematic covariance."""
        checked = used.checked
        if used.solution is None:
            return BlockSolution(dots, used, None, (BlockStatus.NOT_SOLVED, used.failure))
        contradict = checked is not None and checked.contradict and not checked.excluded
        if checked is not None and contradict and self._rig.estimator.consistency == 'reject':
            words = 'four readings' if len(self._rig.psds) == 2 else 'readings'
            reason = f'the {words} contradict each other: chi-square {checked.chi_square:.0f} of {checked.freedom}'
            return BlockSolution(dots, used, None, (BlockStatus.INCONSISTENT, reason))
        answer = used.readings.answer(0)
        covariance = self._covariance(answer, used)
        estimate = self._estimate(0, block, used.solution, covariance, used.checked)
        self.held = HeldTwist(block.t_ns, estimate.theta, estimate.variances[2])
        self.systematic = None
        if covariance is not None and answer.noise is not None and covariance is not answer.noise:
            self.systematic = covariance - answer.noise
        return BlockSolution(dots, used, estimate)

    def _readings(
        self, psds: PsdSet, fitted: FittedBlock, block: ValidBlock, variances: tuple[float, ...]
    ) -> BlockReadings:
        """Return the fit of ``psds`` as readings of a block with findings; ``variances`` (2P,) m^2 of all PSDs."""
        own = tuple([variances[i] for i in psds.columns])
        covariance = self._covariance_of(block, fitted.covariance, psds.columns)
        return BlockReadings(ReadingsRun(self._solvers, psds, [fitted.dots], own, covariance[None]), 0, fitted)

    def _subset(self, psds: tuple[int, ...], block: ValidBlock, variances: tuple[float, ...]) -> BlockReadings | None:
        """Return the readings of ``psds`` (from 0) alone; None if the primary method cannot do with them."""
        solver = self._solvers.of(0, psds)
        if solver is None:
            return None
        own = self.estimator.subset(psds, solver.tilts)
        return self._readings(own, own.fit.fit(block.slots, block.samples[:, own.columns]), block, variances)

    def _estimate(
        self,
        number: int,
        block: ValidBlock,
        s: Solution,
        covariance: FloatArray | None,
        checked: ConsistencyResult | None = None,
    ) -> DeflectionEstimate:
        """Return the estimate of solver ``number`` from its solution.

        ``covariance`` (3, 3), None for the solution's own. ``checked``: of the primary solver's readings.
        """
        return DeflectionEstimate(
            t_ns=block.t_ns,
            block=block.index,
            solver=self._solvers.names[number],
            dx=s.dx,
            dy=s.dy,
            theta=s.theta,
            phi=s.phi,
            omega=s.omega,
            covariance=s.covariance if covariance is None else tuple(covariance.ravel().tolist()),
            residual_rms=self._xp.root(self._xp.total([r * r for r in s.residual]) / len(s.residual)),
            primary=number == 0,
            chi_square=checked.chi_square if checked is not None and checked.freedom else nan,
            on_own_topic=block.due,
        )

    def _covariance(self, answer: SolverAnswer, used: SolvedReadings) -> FloatArray | None:
        """Return the covariance (3, 3) of an answer by noise, calibration and check; None if it has no noise."""
        if answer.gain is None or answer.noise is None:
            return None
        own, checked = answer.noise, used.checked
        if used.factor is not None:
            own = own + _through(answer.gain, used.factor, self._xp)
        if checked is not None and self._rig.estimator.consistency == 'widen' and any(checked.possible):
            own = widened(own, answer.gain, checked.possible, self._xp)
        return own

    def _covariance_of(self, block: ValidBlock, covariance: FloatArray, columns: Sequence[int]) -> FloatArray:
        """Return the fit's covariance (C, C) of the readings ``columns``, widened as in :meth:`_with_light`."""
        if not block.verdict.findings:
            return covariance
        background = np.repeat(self._optics.background_variance(block.mean_sums), 2)
        more = 4.0 if block.verdict.half_light else 1.0
        return more * covariance + np.diag(background[list(columns)])

    def _with_light(self, block: ValidBlock, variances: tuple[float, ...]) -> tuple[float, ...]:
        """Return the ``variances`` of the dots' means, m^2, from noise, with those of missing and of foreign light."""
        if not block.verdict.findings:
            return variances
        background = np.repeat(self._optics.background_variance(block.mean_sums), 2).tolist()
        # The noise behind the divider grows as the inverse of the light.
        more = 4.0 if block.verdict.half_light else 1.0
        return tuple(more * v + b for v, b in zip(variances, background, strict=True))

    def _from_one(self, psd: int, block: ValidBlock, variances: tuple[float, ...]) -> DeflectionEstimate | None:
        """The translation from the remaining detector ``psd`` (from 0), by the rule that ``degraded`` names."""
        config = self._rig.estimator
        xp = self._xp
        theta, variance = 0.0, xp.square(config.twist_sd)
        if config.degraded == 'none':
            return None
        if config.degraded == 'hold':
            held = self.held
            if held is None:
                return None
            age = max(block.t_ns - held.t_ns, 0) / 1e9
            theta = held.theta
            variance = held.variance + xp.square(config.twist_sd) * -xp.expm1(-age / config.twist_hold)
        x, y = block.means[2 * psd : 2 * psd + 2]
        vx, vy = variances[2 * psd : 2 * psd + 2]
        dx, dy, cov = self._one_psd.solve(psd, (x, y), (vx, vy), theta, variance)
        if self.parameter_covariance is not None:
            gain = np.zeros((3, 2 * len(self._rig.psds)))
            c, s = xp.cos_sin(theta)
            gain[:2, 2 * psd : 2 * psd + 2] = [[-c, s], [-s, -c]]
            own = np.array(cov).reshape(3, 3) + _through(gain, self.parameter_covariance.factor(dx, dy, theta), xp)
            cov = tuple(own.ravel().tolist())
        return DeflectionEstimate(
            t_ns=block.t_ns,
            block=block.index,
            solver=ONE_PSD,
            dx=dx,
            dy=dy,
            theta=theta,
            phi=0.0,
            omega=0.0,
            covariance=cov,
            residual_rms=0.0,
            primary=True,
            on_own_topic=block.due,
        )


def _computed_alike(block: ValidBlock) -> tuple[bool, bytes]:
    """Return whether a block is fitted, and which samples it has."""
    return block.verdict.status is BlockStatus.OK, block.slots.tobytes()


def _through(gain: FloatArray, factor: FloatArray, xp: Arithmetic) -> FloatArray:
    """Return (K F)(K F)^T (3, 3) for ``gain`` K (3, C) and ``factor`` F (C, k) m."""
    moved = xp.einsum('ij,jk->ik', gain, factor)
    return xp.einsum('ik,jk->ij', moved, moved)
