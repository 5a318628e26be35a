# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Readings of blocks -> what each solver of a rig makes of them. Blocks that were fitted together are solved together;
the bits of a block do not depend on that."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.measure.uncertainty.block_fit import FittedBlock
from psd_deflection.measure.uncertainty.psd_set import PsdSet
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.subset import subset_solver
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

Dots = tuple[float, ...]


class SolverSet:
    """The solvers of a rig, by number; the primary one is 0. ``names``: of each.

    Raises SolverError or ConfigError if the rig cannot be solved.
    """

    def __init__(self, rig: Rig) -> None:
        config = rig.estimator
        self.names = [config.solver, *(name for name in config.solvers if name != config.solver)]
        self._rig = rig
        self._of_all = [solver_from_rig(name, rig) for name in self.names]
        self._of_some: dict[tuple[int, tuple[int, ...]], Solver | None] = {}  # Bound: sets of at most six PSDs.

    @property
    def primary(self) -> Solver:
        """The primary solver, of all PSDs."""
        return self._of_all[0]

    def of(self, number: int, psds: tuple[int, ...]) -> Solver | None:
        """Return solver ``number`` for ``psds`` (from 0); None if it needs the others too."""
        if len(psds) == len(self._rig.psds):
            return self._of_all[number]
        key = (number, psds)
        if key not in self._of_some:
            self._of_some[key] = subset_solver(self.names[number], self._rig, psds)
        return self._of_some[key]


class SolverAnswer(NamedTuple):
    """What a solver makes of the readings of one block.

    ``solution``: None if there is none, with the reason in ``failure``. ``gain`` (3, C), None of a printed threshold
    method, which has no covariance either. ``noise`` (3, 3): covariance of the pose by the noise of the readings.
    """

    solution: Solution | None
    failure: str = ''
    gain: FloatArray | None = None
    noise: FloatArray | None = None


class ReadingsRun:
    """Readings of the same PSDs in B blocks in turn, weighted alike.

    ``psds``: whose they are. ``dots``: of each block (C,), m, at its stamp. ``variances`` (C,) m^2: the weights.
    ``covariance`` (B, C, C) m^2: of the dots.
    """

    def __init__(
        self, solvers: SolverSet, psds: PsdSet, dots: Sequence[Dots], variances: Dots, covariance: FloatArray
    ) -> None:
        self._solvers = solvers
        self.psds, self.dots, self.variances, self.covariance = psds, dots, variances, covariance
        self._answers: dict[int, list[SolverAnswer]] = {}  # Bound: the rig's solvers.

    def answer(self, number: int, at: int) -> SolverAnswer:
        """Return the answer of solver ``number`` for block ``at`` (from 0)."""
        if number not in self._answers:
            # The primary solver's answer is published before the others compute.
            self._solve((0,) if number == 0 else range(1, len(self._solvers.names)))
        return self._answers[number][at]

    def _solve(self, numbers: Iterable[int]) -> None:
        solved: list[tuple[int, Solver, list[Solution], FloatArray]] = []
        for number in numbers:
            solver = self._solvers.of(number, self.psds.psds)
            if solver is None:
                failed = SolverAnswer(None, f'{self._solvers.names[number]}: takes all PSDs')
                self._answers[number] = [failed] * len(self.dots)
            else:
                solved.append((number, solver, *self._solutions(solver)))
        if not solved:
            return
        gains = np.array([gain for *_, gain in solved])
        # Of all solvers at once: of so few numbers the calls cost most.
        noises = FIXED.einsum('sbic,bck,sbjk->sbij', gains, self.covariance, gains)
        for (number, solver, solutions, gain), noise in zip(solved, noises, strict=True):
            self._answers[number] = [
                self._answer(number, solver, at, solution, gain[at], noise[at]) for at, solution in enumerate(solutions)
            ]

    def _solutions(self, solver: Solver) -> tuple[list[Solution], FloatArray]:
        """The solutions and their gains (B, 3, C), 0 of those without."""
        variances = self.variances
        if len(self.dots) == 1:
            solution = solver.solve(self.dots[0], variances)
            return [solution], self._gain(solver, 0, solution)[None]
        dots = np.array(self.dots)
        batch = solver.solve_many(dots, np.array(variances))
        solutions = batch.rows()
        if all(map(_has_gain, solutions)):
            return solutions, solver.gain_many(dots, variances, batch)
        return solutions, np.array([self._gain(solver, at, solution) for at, solution in enumerate(solutions)])

    def _gain(self, solver: Solver, at: int, solution: Solution) -> FloatArray:
        """(3, C): of a solution of block ``at``, 0 if it has none."""
        if _has_gain(solution):
            return solver.gain(self.dots[at], self.variances, solution)
        return np.zeros((3, len(self.variances)))

    def _answer(
        self, number: int, solver: Solver, at: int, solution: Solution, gain: FloatArray, noise: FloatArray
    ) -> SolverAnswer:
        if solution.status is not SolverStatus.OK:
            return SolverAnswer(
                None, f'{self._solvers.names[number]}: {solution.status.name.lower().replace("_", " ")}'
            )
        if not _has_gain(solution):
            return SolverAnswer(solution)
        allowance = solver.allowance(self.dots[at], self.variances)
        return SolverAnswer(solution, '', gain, noise if allowance is None else noise + allowance)


def _has_gain(solution: Solution) -> bool:
    return solution.status is SolverStatus.OK and solution.covariance[0] == solution.covariance[0]


class BlockReadings(NamedTuple):
    """Readings of one block that are solved together: those of block ``at`` (from 0) of ``run``, and their fit."""

    run: ReadingsRun
    at: int
    fitted: FittedBlock

    @property
    def psds(self) -> PsdSet:
        """The PSDs that have these readings."""
        return self.run.psds

    @property
    def dots(self) -> Dots:
        """(C,) m at the stamp."""
        return self.fitted.dots

    @property
    def covariance(self) -> FloatArray:
        """(C, C) m^2 of the dots: of the fit, and of missing or foreign light."""
        return np.asarray(self.run.covariance[self.at])

    def answer(self, number: int) -> SolverAnswer:
        """Return what solver ``number`` makes of them."""
        return self.run.answer(number, self.at)
