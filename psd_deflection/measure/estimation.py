# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The dots of one block -> the estimate with its covariance: by all detectors, by some of them, or by one.

The primary solver answers first; the check of the readings too many says whether they belong together, and which
detector contradicts the others. The other solvers answer from the same readings. It remembers the last twist that was
measured, for ``degraded: hold``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import nan, pi
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.measure.health import FROZEN_BLOCKS, OpticsHealth, Verdict
from psd_deflection.measure.memory import Memory, Value, numbers
from psd_deflection.measure.uncertainty.consistency import ConsistencyCheck, widened
from psd_deflection.measure.uncertainty.stamped import SomePsds, StampedDots
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.misalignment.spread import ParameterSpread
from psd_deflection.model.plate import Geometry
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.one_psd import NAME as ONE_PSD
from psd_deflection.model.solvers.one_psd import OnePsd
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.model.solvers.some_psds import solver_of_some
from psd_deflection.records import BlockStatus, DeflectionEstimate, FloatArray, IntArray
from psd_deflection.rig.config import Rig

HELD, SYSTEMATIC, ZERO_VARIANCES = 'state.held_twist', 'state.systematic', 'state.zero_variances'
"""Names under which :meth:`Estimation.memory` is recorded."""

Dots = tuple[float, ...]
Failure = tuple[BlockStatus, str]
_Found = tuple['BlockReadings', DeflectionEstimate | None, Failure | None]


@dataclass(frozen=True, slots=True)
class SeenBlock:
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


class BlockReadings(NamedTuple):
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
    checked: ConsistencyCheck | None = None
    factor: FloatArray | None = None
    wrong: int = 0


class BlockSolution(NamedTuple):
    """What the primary solver makes of a block.

    ``dots`` (2P,) m: the block's value at its stamp. ``used``: what the estimate is made from; None if it comes from
    one detector or if there is none. ``failure``: why a sound block has no estimate.
    """

    dots: Dots
    used: BlockReadings | None = None
    estimate: DeflectionEstimate | None = None
    failure: Failure | None = None

    @property
    def complete(self) -> bool:
        """Whether all detectors are in the estimate."""
        return self.used is not None and self.used.kept is None


class Estimation:
    """The solvers of a rig and the uncertainty of what they answer.

    ``stamped``: noise, fit and check of the stream. ``systematic`` (3, 3): what the covariance of the last estimate
    holds besides noise, None if nothing. ``held``: see :class:`HeldTwist`. ``zero_variances`` (2P,) m^2 of the rig's
    zero, () if it has none that was taken.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    part = 'the estimate'
    remembers = (HELD, SYSTEMATIC, ZERO_VARIANCES)

    def __init__(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        config = rig.estimator
        self._by = FIXED
        variances = dot_noise_variances(rig)
        self.variances = [tuple(float(v) / n for v in variances) for n in range(1, config.block_size + 1)]
        self.zero_variances: tuple[float, ...] = ()
        self.held: HeldTwist | None = None
        self.systematic: FloatArray | None = None
        self.build(rig, effects)
        # After the solvers, which refuse a geometry that cannot be solved.
        self.stamped = StampedDots(rig, flat=not rig.psds_at_base, tilts=solver_class(config.solver).tilts)

    def build(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        """Use ``rig`` from the next block on."""
        self._rig, self._effects = rig, effects
        self._optics = OpticsHealth(rig)
        self._one_psd = OnePsd(Geometry.from_rig(rig))
        config = rig.estimator
        self._spread_from(self.zero_variances)
        names = [config.solver, *(name for name in config.solvers if name != config.solver)]
        self._solvers = [(name, solver_from_rig(name, rig), name == config.solver) for name in names]
        self._some_solvers: dict[tuple[int, tuple[int, ...]], Solver | None] = {}

    def _spread_from(self, zero_variances: tuple[float, ...]) -> None:
        """Take the uncertainty of the calibration, and of a zero with these variances (2P,) m^2, () if it has none."""
        self.zero_variances = zero_variances
        at_base = self._rig.psds_at_base
        self.spread = None if at_base else ParameterSpread.from_rig(self._rig, zero_variances, self._effects)

    def memory(self) -> Memory:
        """The held twist, what the filter's covariance takes over from the last estimate, how sure the zero is."""
        out: Memory = {}
        config = self._rig.estimator
        if self.spread is not None and self.zero_variances:
            out[ZERO_VARIANCES] = self.zero_variances
        if self.held is not None and config.degraded == 'hold':
            out[HELD] = tuple(self.held)
        if self.systematic is not None and config.filter != 'none':
            out[SYSTEMATIC] = tuple(self.systematic.ravel().tolist())
        return out

    def restore(self, values: Mapping[str, Value]) -> None:
        """Go on from another one's :meth:`memory`. Raises ValueError if it was of another number of PSDs."""
        if variances := numbers(values, ZERO_VARIANCES, 'a variance of each reading', 2 * len(self._rig.psds)):
            self._spread_from(variances)
        if held := numbers(values, HELD, 'time, twist and variance', 3):
            self.held = HeldTwist(int(held[0]), held[1], held[2])
        if systematic := numbers(values, SYSTEMATIC, 'a covariance', 9):
            self.systematic = np.reshape(systematic, (3, 3))

    @property
    def primary(self) -> Solver:
        """The primary solver, of all detectors."""
        return self._solvers[0][1]

    def gain_at_rest(self) -> FloatArray:
        """(3, 2P): how the primary solver's answer goes with the dots at the rig's zero."""
        at_rest = tuple(self._rig.zeros.ravel().tolist())
        variances = self.variances[0]
        return self.primary.gain(at_rest, variances, self.primary.solve(at_rest, variances))

    def vibration(self) -> tuple[FloatArray, FloatArray]:
        """Covariance (3, 3) of what vibrates too fast for a block: of the pose and of its rate, in SI units."""
        gain = self.gain_at_rest()
        pose, rate = np.zeros((3, 3)), np.zeros((3, 3))
        for tone in self.stamped.noise.tones:
            own = self._by.einsum('ic,cd,jd->ij', gain, tone.covariance, gain)
            pose += own
            rate += self._by.square(2.0 * pi * tone.frequency * self._rig.converter.sample_rate_hz) * own
        return pose, rate

    def zero_noise(self, size: int) -> tuple[float, ...]:
        """Variances (2P,), m^2, of the dots of a whole block of ``size`` samples at rest."""
        return self.stamped.mean_variances(size) if self.stamped.flat else self.variances[-1]

    def solve(self, block: SeenBlock) -> BlockSolution:
        """The primary solver's estimate of a block whose verdict is OK or names sound detectors."""
        verdict = block.verdict
        whole = BlockReadings(block.means, self._variances_of(block))
        if verdict.status is BlockStatus.OK:
            fitted = self.stamped.fit(block.slots, block.samples)
            whole = whole._replace(dots=fitted.dots, spread=self._spread_of(block, fitted.covariance))
            return self._agreed(block, whole, whole)
        if not verdict.sound:
            return BlockSolution(whole.dots)
        if self.stamped.flat:
            whole = whole._replace(variances=self.stamped.mean_variances(len(block.slots)))
        others = self._some(verdict.sound, block, whole) if len(verdict.sound) > 1 else None
        if others is not None:
            return self._agreed(block, whole, others)
        if len(verdict.sound) == 1:
            return BlockSolution(whole.dots, None, self._from_one(verdict.sound[0], block, whole))
        return BlockSolution(whole.dots)

    def others(self, block: SeenBlock, used: BlockReadings) -> Iterator[DeflectionEstimate]:
        """The estimates of the other solvers."""
        for number in range(1, len(self._solvers)):
            solution, _ = self._solve(number, used)
            if solution is not None:
                yield self._estimate(number, block, solution, used)

    def left_out(self, used: BlockReadings | None) -> tuple[int, ...]:
        """The PSDs (from 1) without which a block was solved."""
        if used is None or used.kept is None:
            return ()
        return tuple(n for n in range(1, len(self._rig.psds) + 1) if n - 1 not in used.kept)

    def _agreed(self, block: SeenBlock, whole: BlockReadings, readings: BlockReadings) -> BlockSolution:
        """The answer from ``readings``, without the PSD that contradicts the others if it can be told.

        ``whole``: the readings of all PSDs.
        """
        used, estimate, failure = self._most_agreed(block, whole, readings)
        if estimate is not None:
            self.held = HeldTwist(block.t_ns, estimate.theta, estimate.variances[2])
        return BlockSolution(whole.dots, used, estimate, failure)

    def _most_agreed(self, block: SeenBlock, whole: BlockReadings, readings: BlockReadings) -> _Found:
        """As :meth:`_primary`, without the PSD that contradicts the others if it can be told."""
        before = tuple(range(len(self._rig.psds))) if readings.kept is None else readings.kept
        if len(before) < 3 or self._rig.estimator.consistency == 'report':
            return self._primary(block, readings)
        taken: dict[int, BlockReadings | None] = {}

        def without(psd: int) -> BlockReadings | None:
            # Once a block: a fit remembers the motion that it saw.
            if psd not in taken:
                taken[psd] = self._some(tuple(p for p in before if p != psd), block, whole)
            return taken[psd]

        def agree_without(number: int) -> bool:
            others = without(before[number - 1])
            return others is not None and self._agree(others)

        found = self._primary(block, readings, agree_without)
        checked = found[0].checked
        wrong = before[checked.wrong - 1] if checked is not None and checked.wrong else -1
        still = [psd for psd in before if block.frozen[psd] >= FROZEN_BLOCKS]
        if wrong < 0 and checked is not None and checked.contradict and len(still) == 1:
            # The check cannot tell, but a detector whose values do not change by one bit tells on itself.
            wrong = still[0]
        others = without(wrong) if wrong >= 0 else None
        return found if others is None else self._primary(block, others._replace(wrong=wrong + 1))

    def _agree(self, readings: BlockReadings) -> bool:
        """Whether the readings of some PSDs agree with each other."""
        solution, _ = self._solve(0, readings)
        if solution is None or readings.some is None:
            return False
        spread = np.diag(readings.variances) if readings.spread is None else readings.spread
        return self.stamped.agree(readings.some, readings.dots, solution.residual, spread, solution[:5])

    def _some(self, kept: tuple[int, ...], block: SeenBlock, whole: BlockReadings) -> BlockReadings | None:
        """The readings of the PSDs ``kept`` (from 0) alone; None if the primary method cannot do with them."""
        solver = self._solver(0, kept)
        if solver is None:
            return None
        some = self.stamped.some(kept, solver.tilts)
        at = some.columns
        dots = tuple(whole.dots[i] for i in at)
        readings = BlockReadings(dots, tuple(whole.variances[i] for i in at), kept=kept, some=some)
        fitted = self.stamped.fit_some(some, block.slots, block.samples)
        return readings._replace(dots=fitted.dots, spread=self._spread_of(block, fitted.covariance, at))

    def _solver(self, number: int, kept: tuple[int, ...] | None) -> Solver | None:
        """Solver ``number`` for all PSDs, or for those ``kept`` (from 0); None if it cannot do with them."""
        name, solver, _ = self._solvers[number]
        if kept is None:
            return solver
        key = (number, kept)
        if key not in self._some_solvers:
            self._some_solvers[key] = solver_of_some(name, self._rig, kept)
        return self._some_solvers[key]

    def _primary(
        self, block: SeenBlock, readings: BlockReadings, agree_without: Callable[[int], bool] | None = None
    ) -> _Found:
        """The readings with their check, the primary solver's estimate, and why there is none.

        ``agree_without``: as :meth:`StampedDots.check` has it.
        """
        solution, failure = self._solve(0, readings)
        if solution is None:
            return readings, None, (BlockStatus.NOT_SOLVED, failure)
        factor = None if self.spread is None else self.spread.factor(solution.dx, solution.dy, solution.theta)
        checked: ConsistencyCheck | None = None
        if self.stamped.flat:
            allowed = np.diag(readings.variances) if readings.spread is None else readings.spread
            if factor is not None:
                allowed = allowed + self._by.einsum('ik,jk->ij', factor, factor)
            pose = solution[:5]
            checked = self.stamped.check(readings.dots, solution.residual, allowed, pose, readings.some, agree_without)
        readings = readings._replace(checked=checked, factor=factor)
        told = checked is not None and checked.contradict and not checked.wrong
        if checked is not None and told and self._rig.estimator.consistency == 'refuse':
            words = 'four readings' if len(self._rig.psds) == 2 else 'readings'
            reason = f'the {words} contradict each other: chi-square {checked.chi_square:.0f} of {checked.freedom}'
            return readings, None, (BlockStatus.INCONSISTENT, reason)
        return readings, self._estimate(0, block, solution, readings), None

    def _solve(self, number: int, readings: BlockReadings) -> tuple[Solution | None, str]:
        """The answer of solver ``number``, or None and the reason."""
        name = self._solvers[number][0]
        solver = self._solver(number, readings.kept)
        if solver is None:
            return None, f'{name}: takes all PSDs'
        s = solver.solve(readings.dots, readings.variances)
        if s.status is not SolverStatus.OK:
            return None, f'{name}: {s.status.name.lower().replace("_", " ")}'
        return s, ''

    def _estimate(self, number: int, block: SeenBlock, s: Solution, readings: BlockReadings) -> DeflectionEstimate:
        """An answer with its covariance."""
        name, _, primary = self._solvers[number]
        checked = readings.checked
        covariance, systematic = self._covariance(number, s, readings)
        if primary:
            self.systematic = systematic
        return DeflectionEstimate(
            t_ns=block.t_ns,
            block=block.index,
            solver=name,
            dx=s.dx,
            dy=s.dy,
            theta=s.theta,
            phi=s.phi,
            omega=s.omega,
            covariance=covariance,
            residual_rms=self._by.root(self._by.total([r * r for r in s.residual]) / len(s.residual)),
            primary=primary,
            chi_square=checked.chi_square if primary and checked is not None and checked.freedom else nan,
            on_own_topic=block.due,
        )

    def _covariance(
        self, number: int, s: Solution, readings: BlockReadings
    ) -> tuple[tuple[float, ...], FloatArray | None]:
        """The covariance of an answer, and what it holds besides noise, None if nothing."""
        solver = self._solver(number, readings.kept)
        checked, factor = readings.checked, readings.factor
        possible = () if checked is None or self._rig.estimator.consistency != 'widen' else checked.possible
        # A printed threshold method has no covariance, and no slope either.
        if solver is None or s.covariance[0] != s.covariance[0]:
            return s.covariance, None
        if readings.spread is None and factor is None and not any(possible):
            return s.covariance, None
        gain = solver.gain(readings.dots, readings.variances, s)
        noise = own = self._noise_of(solver, gain, s, readings)
        if factor is not None:
            own = own + _through(gain, factor, self._by)
        # A check that was made with all PSDs tells nothing of some of them.
        if any(possible) and len(possible) == gain.shape[1]:
            own = widened(own, gain, possible, self._by)
        return tuple(own.ravel().tolist()), own - noise if own is not noise else None

    def _noise_of(self, solver: Solver, gain: FloatArray, s: Solution, readings: BlockReadings) -> FloatArray:
        """The covariance (3, 3) by the noise of the readings alone."""
        if readings.spread is None:
            return np.array(s.covariance).reshape(3, 3)
        own = self._by.einsum('ic,ck,jk->ij', gain, readings.spread, gain)
        allowance = solver.allowance(readings.dots, readings.variances)
        return own if allowance is None else own + allowance

    def _spread_of(self, block: SeenBlock, covariance: FloatArray, columns: Sequence[int] | None = None) -> FloatArray:
        """:meth:`_variances_of` for the fit's own covariance (C, C), of the readings ``columns`` or of all."""
        if not block.verdict.findings:
            return covariance
        background = np.repeat(self._optics.background_variance(block.mean_sums), 2)
        more = 4.0 if block.verdict.half_light else 1.0
        return more * covariance + np.diag(background if columns is None else background[list(columns)])

    def _variances_of(self, block: SeenBlock) -> tuple[float, ...]:
        """Variances of the dots' means, m^2: from the noise, and from missing or foreign light."""
        variances = self.variances[len(block.slots) - 1]
        if not block.verdict.findings:
            return variances
        background = np.repeat(self._optics.background_variance(block.mean_sums), 2).tolist()
        # The noise behind the divider grows as the inverse of the light.
        more = 4.0 if block.verdict.half_light else 1.0
        return tuple(more * v + b for v, b in zip(variances, background, strict=True))

    def _from_one(self, psd: int, block: SeenBlock, readings: BlockReadings) -> DeflectionEstimate | None:
        """The translation from the remaining detector ``psd`` (from 0), by the rule that ``degraded`` names."""
        config = self._rig.estimator
        by = self._by
        theta, variance = 0.0, by.square(config.twist_sd)
        if config.degraded == 'none':
            return None
        if config.degraded == 'hold':
            held = self.held
            if held is None:
                return None
            age = max(block.t_ns - held.t_ns, 0) / 1e9
            theta = held.theta
            variance = held.variance + by.square(config.twist_sd) * -by.expm1(-age / config.twist_hold)
        x, y = readings.dots[2 * psd : 2 * psd + 2]
        vx, vy = readings.variances[2 * psd : 2 * psd + 2]
        dx, dy, cov = self._one_psd.solve(psd, (x, y), (vx, vy), theta, variance)
        if self.spread is not None:
            gain = np.zeros((3, 2 * len(self._rig.psds)))
            c, s = by.cos_sin(theta)
            gain[:2, 2 * psd : 2 * psd + 2] = [[-c, s], [-s, -c]]
            own = np.array(cov).reshape(3, 3) + _through(gain, self.spread.factor(dx, dy, theta), by)
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


def _through(gain: FloatArray, factor: FloatArray, by: Arithmetic) -> FloatArray:
    """(3, 3): what dots that spread by ``factor`` (C, k) m do to an answer with ``gain`` (3, C)."""
    moved = by.einsum('ij,jk->ik', gain, factor)
    return by.einsum('ik,jk->ij', moved, moved)
