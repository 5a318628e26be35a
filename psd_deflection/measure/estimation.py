# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates the pose of the tip plate, with its covariance, from a block of ``block_size`` successive samples.

A dot is where a beam meets a position sensing detector (PSD): two readings, x and y, m from the detector's centre. The
2P readings of P PSDs have the order x1, y1, x2, y2, ...; a subset of the PSDs has C readings in the same order. A pose
is (dX, dY, theta) in m, m, rad; theta is called twist. The zero is the dots of the unloaded link.

The PSDs without a fault are solved together. If their readings contradict each other and the consistency check blames
one PSD, that PSD is excluded. If only one PSD is left, the translation is estimated, if ``degraded`` asks for it.
"""

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
"""Keys of the recorded state: ``held``, ``systematic`` and ``zero_variances`` of :class:`Estimation`."""


@dataclass(frozen=True, slots=True)
class BlockInput:
    """One block for :class:`Estimation`: its n samples as dots, and the verdict on lasers and detectors.

    ``t_ns``: ROS time of the middle of the block, ns. ``index``: block number. ``slots`` (n,): places of the samples in
    the block, from 0. ``samples`` (n, 2P): dots, m; ``means`` (2P,): their means. ``mean_sums`` (P,): mean sum signals
    (total light), V. ``frozen`` (P,): for each PSD, in how many successive blocks, up to this one, its values did not
    change. ``fully_published``: whether the parameter ``decimation`` selects this block; if not, only
    the primary estimate is published, on ``/link_tip/deflection``; dots, tip load and the solvers' topics are skipped.
    """

    t_ns: int
    index: int
    slots: IntArray
    samples: FloatArray
    means: Dots
    mean_sums: tuple[float, ...]
    verdict: Verdict
    frozen: tuple[int, ...]
    fully_published: bool


class HeldTwist(NamedTuple):
    """Time (ns), value (rad) and variance (rad^2) of the last twist from two or more PSDs, for ``degraded: hold``."""

    t_ns: int
    theta: float
    variance: float


class SolvedReadings(NamedTuple):
    """Readings of two or more PSDs, the primary solver's solution of them, and the result of their consistency check.

    ``solution``: None if the solver failed, for the reason ``failure``. ``factor`` F (C, k), m: the uncertainty of the
    calibration adds F F^T to the covariance of the readings; None: it adds nothing. ``unexplained``: the part of the
    readings that no pose explains. ``unexplained`` and ``check_result`` are None if the readings cannot be checked.
    ``excluded_psd``: number (from 1) of the PSD whose readings are excluded because they contradict these; 0: none.
    """

    readings: BlockReadings
    solution: Solution | None
    failure: str = ''
    factor: FloatArray | None = None
    unexplained: Unexplained | None = None
    check_result: ConsistencyResult | None = None
    excluded_psd: int = 0


class BlockSolution(NamedTuple):
    """The result of a block: the dots to publish, and the primary solver's estimate, None if there is none.

    ``dots`` (2P,), m: fitted at the block's timestamp, or the means of the samples if the verdict is not OK.
    ``solved``: the readings behind the estimate or the ``failure``; None if fewer than two PSDs were solved.
    ``failure``: status and reason if the solver failed, or if inconsistent readings are rejected.
    """

    dots: Dots
    solved: SolvedReadings | None = None
    estimate: DeflectionEstimate | None = None
    failure: tuple[BlockStatus, str] | None = None

    @property
    def complete(self) -> bool:
        """Whether the solved readings are those of all PSDs of the rig."""
        return self.solved is not None and self.solved.readings.psds.is_full


class Estimation:
    """Solves blocks with the solvers of a rig. A :class:`psd_deflection.measure.state.Part`: its state is recorded.

    ``estimator``: noise model, block fit and consistency check. ``variances``: item n - 1 has the noise variances
    (2P,), m^2, of a mean of n samples, from the rig file. ``systematic`` (3, 3): covariance of the last estimate minus
    its part from noise; None if all of it is from noise. ``zero_variances`` (2P,), m^2: of a zero that was taken after
    the calibration; () if none was. ``parameter_covariance``: the uncertainty of the calibration; None if the
    covariance of an estimate does not contain it.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    part = 'the estimate'
    prefixes = (HELD, SYSTEMATIC, ZERO_VARIANCES)

    def __init__(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        config = rig.estimator
        self._xp = FIXED  # Its results have the same bits on every machine.
        sample_variances = dot_noise_variances(rig)
        self.variances = [tuple(float(v) / n for v in sample_variances) for n in range(1, config.block_size + 1)]
        self.zero_variances: tuple[float, ...] = ()
        self.held: HeldTwist | None = None
        self.systematic: FloatArray | None = None
        self.build(rig, effects)
        # After build(): there the solvers reject a geometry that cannot be solved, before BlockEstimator uses it.
        # PSDs on the plate: their noise is measured, and their readings are checked. At the base: neither.
        self.estimator = BlockEstimator(rig, on_plate=not rig.psds_at_base, tilts=solver_class(config.solver).tilts)

    def build(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        """Use ``rig`` and its ``effects`` (physical causes such as a rotated detector) from the next block on."""
        self._rig, self._effects = rig, effects
        self._optics = OpticsHealth(rig)
        self._one_psd = OnePsd(Geometry.from_rig(rig))
        self._set_parameter_covariance(self.zero_variances)
        self._solvers = SolverSet(rig)

    def _set_parameter_covariance(self, zero_variances: tuple[float, ...]) -> None:
        """Set ``zero_variances``, and ``parameter_covariance`` from the calibration and this zero."""
        self.zero_variances = zero_variances
        self.parameter_covariance = (
            None if self._rig.psds_at_base else ParameterCovariance.from_rig(self._rig, zero_variances, self._effects)
        )

    def state_dict(self) -> State:
        """Return the state to record, without the values that the parameters of the rig leave unused."""
        state: State = {}
        config = self._rig.estimator
        if self.parameter_covariance is not None and self.zero_variances:
            state[ZERO_VARIANCES] = self.zero_variances
        if self.held is not None and config.degraded == 'hold':
            state[HELD] = tuple(self.held)
        if self.systematic is not None and config.filter != 'none':
            state[SYSTEMATIC] = tuple(self.systematic.ravel().tolist())
        return state

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Continue from ``values`` of :meth:`state_dict`. Raises ValueError if they are of another number of PSDs."""
        if variances := numbers(values, ZERO_VARIANCES, 'a variance of each reading', 2 * len(self._rig.psds)):
            self._set_parameter_covariance(variances)
        if held := numbers(values, HELD, 'time, twist and variance', 3):
            self.held = HeldTwist(int(held[0]), held[1], held[2])
        if systematic := numbers(values, SYSTEMATIC, 'a covariance', 9):
            self.systematic = np.reshape(systematic, (3, 3))

    @property
    def primary(self) -> Solver:
        """The primary solver (parameter ``solver``) for all PSDs."""
        return self._solvers.primary

    def gain_at_rest(self) -> FloatArray:
        """Return the primary solver's gain at the zero: d(dX, dY, theta)/d(readings), (3, 2P), 1 and rad/m."""
        zero_dots = tuple(self._rig.zeros.ravel().tolist())
        variances = self.variances[0]
        return self.primary.gain(zero_dots, variances, self.primary.solve(zero_dots, variances))

    def vibration(self, tones: Sequence[Tone]) -> tuple[FloatArray, FloatArray]:
        """Return the covariances (3, 3) of pose and pose rate, SI units, that ``tones`` cause.

        Tones are sinusoidal vibrations; their frequencies are in cycles per sample."""
        gain = self.gain_at_rest()
        pose_covariance, rate_covariance = np.zeros((3, 3)), np.zeros((3, 3))
        for tone in tones:
            tone_covariance = self._xp.einsum('ic,cd,jd->ij', gain, tone.covariance, gain)
            angular_frequency = 2.0 * pi * tone.frequency * self._rig.converter.sample_rate_hz
            pose_covariance += tone_covariance
            rate_covariance += self._xp.square(angular_frequency) * tone_covariance
        return pose_covariance, rate_covariance

    def zero_noise(self, size: int) -> tuple[float, ...]:
        """Return the noise variances (2P,), m^2, of the mean of a complete block of ``size`` samples at rest."""
        return self.estimator.mean_variances(size) if self.estimator.on_plate else self.variances[-1]

    def fit(self, blocks: Sequence[BlockInput]) -> list[BlockReadings | None]:
        """Return for each block all readings, fitted at its timestamp; None if its verdict is not OK.

        Changes no state: :meth:`solve` stores, for each block, what the fit remembers of the motion.
        """
        fit, readings = self.estimator.full.fit, list[BlockReadings | None]()
        memory = fit.memory
        # Blocks with samples in the same slots are fitted together, which saves time and changes no result.
        for (ok, _), group in itertools.groupby(blocks, key=_fit_group):
            alike = list(group)
            if not ok:
                readings += [None] * len(alike)
                continue
            slots, samples = alike[0].slots, np.stack([block.samples for block in alike])
            for fitted in fit.fit_blocks(slots, samples, memory):
                memory, variances = fitted.memories[-1], self.variances[len(slots) - 1]
                run = ReadingsRun(self._solvers, self.estimator.full, fitted.dots, variances, fitted.covariance)
                readings += [BlockReadings(run, at, fitted.block(at)) for at in range(len(fitted.dots))]
        return readings

    def solve(self, block: BlockInput, readings: BlockReadings | None) -> BlockSolution:
        """Return the primary solver's result for a block whose verdict is OK or names sound PSDs (without a fault).

        ``readings``: those of :meth:`fit`.
        """
        verdict = block.verdict
        variances = self._variances_with_light_errors(block, self.variances[len(block.slots) - 1])
        if readings is not None:
            self.estimator.full.fit.memory = readings.fitted.memory
            if verdict.findings:
                # If half of the light is lost or there is background light, the fit's covariance lacks those errors.
                readings = self._block_readings(readings.psds, readings.fitted, block, variances)
            return self._solve_consistent(block, readings.dots, variances, readings)
        if self.estimator.on_plate and verdict.sound:
            # A block with a faulty PSD uses the measured noise instead of that of the rig file.
            variances = self._variances_with_light_errors(block, self.estimator.mean_variances(len(block.slots)))
        subset = self._fit_psds(verdict.sound, block, variances) if len(verdict.sound) > 1 else None
        if subset is not None:
            return self._solve_consistent(block, block.means, variances, subset)
        estimate = self._from_one_psd(verdict.sound[0], block, variances) if len(verdict.sound) == 1 else None
        return BlockSolution(block.means, None, estimate)

    def other_estimates(self, block: BlockInput, solved: SolvedReadings) -> Iterator[DeflectionEstimate]:
        """Yield the estimates of the other solvers (parameter ``solvers``) from the readings of ``solved``."""
        for solver_number in range(1, len(self._solvers.names)):
            answer = solved.readings.answer(solver_number)
            if answer.solution is not None:
                yield self._estimate(solver_number, block, answer.solution, self._covariance(answer, solved))

    def missing_psds(self, solved: SolvedReadings | None) -> tuple[int, ...]:
        """Return the numbers (from 1) of the PSDs, faulty or contradicting, that are not in ``solved``; () for None."""
        if solved is None:
            return ()
        return tuple(n for n in range(1, len(self._rig.psds) + 1) if n - 1 not in solved.readings.psds.psds)

    def _solve_consistent(
        self, block: BlockInput, dots: Dots, variances: tuple[float, ...], readings: BlockReadings
    ) -> BlockSolution:
        """Return the result of ``readings``, without one PSD if the consistency check blames that PSD.

        ``dots`` (2P,), m: to publish. ``variances`` (2P,), m^2: noise of the readings of all PSDs.
        """
        solved, psd_set = self._solve_primary(readings), readings.psds
        may_exclude = len(psd_set.psds) > 2 and self._rig.estimator.consistency != 'report' and self.estimator.on_plate
        if solved.solution is None or not may_exclude:
            return self._finish(block, dots, self._check(solved, None))
        # The check identifies a PSD by its place (from 1) in ``psd_set``.
        places = psd_set.check.candidates(solved.unexplained, self.estimator.limit_factor)
        without = {place: self._solve_without(place, block, variances, psd_set) for place in places}
        # A PSD may be wrong if the others are consistent without it.
        may_be_wrong = [place for place, remaining in without.items() if self._is_consistent(remaining)]
        solved = self._check(solved, may_be_wrong)
        place = self._place_to_exclude(block, psd_set, solved.check_result)
        # A frozen PSD is excluded even if it was not among the candidates.
        if place and place not in without:
            without[place] = self._solve_without(place, block, variances, psd_set)
        remaining = without[place] if place else None
        return self._finish(block, dots, solved if remaining is None else self._check(remaining, None))

    def _solve_primary(self, readings: BlockReadings) -> SolvedReadings:
        """Return ``readings`` with their solution by the primary solver."""
        solution, failure, *_ = readings.answer(0)
        if solution is None:
            return SolvedReadings(readings, None, failure)
        factor: FloatArray | None = None
        covariance = readings.covariance
        if self.parameter_covariance is not None:
            factor = self.parameter_covariance.factor(solution.dx, solution.dy, solution.theta)
            covariance = covariance + self._xp.einsum('ik,jk->ij', factor, factor)
        return SolvedReadings(readings, solution, '', factor, self._unexplained(readings, solution, covariance))

    def _unexplained(self, readings: BlockReadings, solution: Solution, covariance: FloatArray) -> Unexplained | None:
        """Return the part of ``readings`` that no pose explains; None if the readings cannot be checked.

        ``covariance`` (C, C), m^2: of the readings, with or without the uncertainty of the calibration.
        """
        if not self.estimator.on_plate:
            return None
        return readings.psds.unexplained(readings.dots, solution.residual, covariance, solution[:5])

    def _solve_without(
        self, place: int, block: BlockInput, variances: tuple[float, ...], psd_set: PsdSet
    ) -> SolvedReadings | None:
        """Return the solved readings of ``psd_set`` without the PSD at ``place``; None if the solver needs that PSD."""
        readings = self._fit_psds(psd_set.psds[: place - 1] + psd_set.psds[place:], block, variances)
        if readings is None:
            return None
        return self._solve_primary(readings)._replace(excluded_psd=psd_set.psds[place - 1] + 1)

    def _is_consistent(self, solved: SolvedReadings | None) -> bool:
        """Return whether the readings can be checked and are consistent within their noise alone."""
        if solved is None or solved.solution is None:
            return False
        readings, unexplained = solved.readings, solved.unexplained
        if solved.factor is not None:
            unexplained = self._unexplained(readings, solved.solution, readings.covariance)
        return readings.psds.check.agrees(unexplained, self.estimator.limit_factor)

    def _check(self, solved: SolvedReadings, may_be_wrong: Collection[int] | None) -> SolvedReadings:
        """Update the consistency check of the PSDs of ``solved``; return ``solved`` with the ``check_result``.

        ``may_be_wrong``: places of the PSDs without which the others are consistent; None: no PSD may be excluded.
        """
        if solved.solution is None or not self.estimator.on_plate:
            return solved
        return solved._replace(
            check_result=self.estimator.check(solved.readings.psds, solved.unexplained, may_be_wrong)
        )

    def _place_to_exclude(self, block: BlockInput, psd_set: PsdSet, check_result: ConsistencyResult | None) -> int:
        """Return the place in ``psd_set`` of the PSD to exclude; 0: none."""
        if check_result is None or check_result.excluded or not check_result.contradict:
            return 0 if check_result is None else check_result.excluded
        # The check blames no single PSD, but a PSD whose values stay constant is known to be wrong.
        frozen = [place for place, psd in enumerate(psd_set.psds, 1) if block.frozen[psd] >= FROZEN_BLOCKS]
        return frozen[0] if len(frozen) == 1 else 0

    def _finish(self, block: BlockInput, dots: Dots, solved: SolvedReadings) -> BlockSolution:
        """Return the block's result, the estimate or the failure of ``solved``; set ``held`` and ``systematic``."""
        check_result = solved.check_result
        if solved.solution is None:
            return BlockSolution(dots, solved, None, (BlockStatus.NOT_SOLVED, solved.failure))
        may_reject = self._rig.estimator.consistency == 'reject'
        if may_reject and check_result is not None and check_result.contradict and not check_result.excluded:
            subject = 'four readings' if len(self._rig.psds) == 2 else 'readings'
            chi_square = f'chi-square {check_result.chi_square:.0f} of {check_result.freedom}'
            reason = f'the {subject} contradict each other: {chi_square}'
            return BlockSolution(dots, solved, None, (BlockStatus.INCONSISTENT, reason))
        answer = solved.readings.answer(0)
        covariance = self._covariance(answer, solved)
        estimate = self._estimate(0, block, solved.solution, covariance, check_result)
        self.held, self.systematic = HeldTwist(block.t_ns, estimate.theta, estimate.variances[2]), None
        if covariance is not None and answer.noise is not None and covariance is not answer.noise:
            self.systematic = covariance - answer.noise
        return BlockSolution(dots, solved, estimate)

    def _block_readings(
        self, psd_set: PsdSet, fitted: FittedBlock, block: BlockInput, variances: tuple[float, ...]
    ) -> BlockReadings:
        """Return the readings of one block from the fit of ``psd_set``.

        ``variances`` (2P,), m^2: noise of the readings of all PSDs, for the weights of the solvers.
        """
        set_variances = tuple([variances[i] for i in psd_set.columns])
        covariance = self._covariance_with_light_errors(block, fitted.covariance, psd_set.columns)
        run = ReadingsRun(self._solvers, psd_set, [fitted.dots], set_variances, covariance[None])
        return BlockReadings(run, 0, fitted)

    def _fit_psds(self, psds: tuple[int, ...], block: BlockInput, variances: tuple[float, ...]) -> BlockReadings | None:
        """Return the fitted readings of ``psds`` (from 0); None if the primary solver needs other PSDs too."""
        solver = self._solvers.of(0, psds)
        if solver is None:
            return None
        psd_set = self.estimator.subset(psds, solver.tilts)
        fitted = psd_set.fit.fit(block.slots, block.samples[:, psd_set.columns])
        return self._block_readings(psd_set, fitted, block, variances)

    def _estimate(
        self,
        solver_number: int,
        block: BlockInput,
        solution: Solution,
        covariance: FloatArray | None,
        check_result: ConsistencyResult | None = None,
    ) -> DeflectionEstimate:
        """Return the estimate of a solver (0: primary) from its ``solution``.

        ``covariance`` (3, 3); None for that of the solution. ``check_result``: of the primary solver's readings.
        """
        residual_rms = self._xp.root(self._xp.total([r * r for r in solution.residual]) / len(solution.residual))
        chi_square = check_result.chi_square if check_result is not None and check_result.freedom else nan
        labels, pose_and_tilts = (block.t_ns, block.index, self._solvers.names[solver_number]), solution[:5]
        values = solution.covariance if covariance is None else tuple(covariance.ravel().tolist())
        return DeflectionEstimate(
            *labels, *pose_and_tilts, values, residual_rms, solver_number == 0, chi_square, block.fully_published
        )

    def _covariance(self, answer: SolverAnswer, solved: SolvedReadings) -> FloatArray | None:
        """Return the pose covariance (3, 3) by noise, calibration and inconsistency; None if the solver has none."""
        if answer.gain is None or answer.noise is None:
            return None
        covariance, check_result = answer.noise, solved.check_result
        if solved.factor is not None:
            covariance = covariance + _pose_covariance(answer.gain, solved.factor, self._xp)
        if (
            check_result is not None
            and self._rig.estimator.consistency == 'widen'
            and any(check_result.possible_errors)
        ):
            covariance = widened(covariance, answer.gain, check_result.possible_errors, self._xp)
        return covariance

    def _light_errors(self, block: BlockInput) -> tuple[float, FloatArray]:
        """Return the factor on the noise variances, and the variances (2P,), m^2, that background light adds.

        Without a finding (a warning) in the verdict, the factor is 1 and the variances of sound PSDs are 0.
        """
        # One of two lasers of a beam splitter is lost. Half the light doubles the noise: four times its variance.
        factor = 4.0 if block.verdict.half_light else 1.0
        return factor, np.repeat(self._optics.background_variance(block.mean_sums), 2)

    def _covariance_with_light_errors(
        self, block: BlockInput, covariance: FloatArray, columns: Sequence[int]
    ) -> FloatArray:
        """Return the ``covariance`` (C, C), m^2, of the readings ``columns``, increased by :meth:`_light_errors`."""
        if not block.verdict.findings:
            return covariance
        factor, background = self._light_errors(block)
        return factor * covariance + np.diag(background[list(columns)])

    def _variances_with_light_errors(self, block: BlockInput, variances: tuple[float, ...]) -> tuple[float, ...]:
        """Return the noise ``variances`` (2P,), m^2, of the mean readings, increased by :meth:`_light_errors`."""
        if not block.verdict.findings:
            return variances
        factor, background = self._light_errors(block)
        return tuple(factor * v + b for v, b in zip(variances, background.tolist(), strict=True))

    def _from_one_psd(self, psd: int, block: BlockInput, variances: tuple[float, ...]) -> DeflectionEstimate | None:
        """Return the estimate from the one sound ``psd`` (from 0): its translation, with a twist that is not measured.

        The parameter ``degraded`` selects the last measured twist (hold), a twist of 0 (zero) or no estimate (none).
        """
        config, xp = self._rig.estimator, self._xp
        if config.degraded == 'none':
            return None
        theta, theta_variance = 0.0, xp.square(config.twist_sd)
        if config.degraded == 'hold':
            if self.held is None:
                return None
            theta = self.held.theta
            age_s = max(block.t_ns - self.held.t_ns, 0) / 1e9
            # Grows to the held variance plus twist_sd^2, with the time constant twist_hold.
            theta_variance = self.held.variance + xp.square(config.twist_sd) * -xp.expm1(-age_s / config.twist_hold)
        x, y = block.means[2 * psd : 2 * psd + 2]
        vx, vy = variances[2 * psd : 2 * psd + 2]
        dx, dy, covariance = self._one_psd.solve(psd, (x, y), (vx, vy), theta, theta_variance)
        if self.parameter_covariance is not None:
            # translation = l - R(theta) (c + dot), so its derivative by the dot is -R(theta). l, c: places of the
            # beam and of the PSD's centre on the unloaded plate, m.
            gain = np.zeros((3, 2 * len(self._rig.psds)))
            cos, sin = xp.cos_sin(theta)
            gain[:2, 2 * psd : 2 * psd + 2] = [[-cos, sin], [-sin, -cos]]
            added = _pose_covariance(gain, self.parameter_covariance.factor(dx, dy, theta), xp)
            covariance = tuple((np.array(covariance).reshape(3, 3) + added).ravel().tolist())
        labels, pose_and_tilts = (block.t_ns, block.index, ONE_PSD), (dx, dy, theta, 0.0, 0.0)
        return DeflectionEstimate(
            *labels, *pose_and_tilts, covariance, residual_rms=0.0, primary=True, on_own_topic=block.fully_published
        )


def _fit_group(block: BlockInput) -> tuple[bool, bytes]:
    """Return the key of blocks that are fitted together: whether the verdict is OK, and which slots have samples."""
    return block.verdict.status is BlockStatus.OK, block.slots.tobytes()


def _pose_covariance(gain: FloatArray, factor: FloatArray, xp: Arithmetic) -> FloatArray:
    """Return (K F)(K F)^T (3, 3): the pose covariance from that of readings, F F^T; K: ``gain``, F: ``factor``."""
    pose_factor = xp.einsum('ij,jk->ik', gain, factor)
    return xp.einsum('ik,jk->ij', pose_factor, pose_factor)
