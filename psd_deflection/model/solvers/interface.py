# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs and outputs of every solver, for one block and for many.

Theory of operation. A dot reading m_i is where laser i falls on PSD i, from the PSD's centre c_i,
in plate axes. Before load it was m_i0, so the beam is at l_i = c_i + m_i0, fixed to the base. The
plate point under it is now q_i = c_i + m_i. A flat plate that moved by d = (dX, dY) and turned by
theta about +Z has q_i = Rz(-theta)(l_i - d); a solver inverts this, or the fuller model with tilts
phi (about X) and omega (about Y), R = Ry(omega) Rx(phi) Rz(theta).

``solve`` takes and returns plain floats: it is called once per block in real time, and numpy's cost
per call would dominate. ``solve_many`` takes and returns arrays of n blocks.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.plate.layout import Geometry
from psd_deflection.model.plate.plate import Number, Tilts
from psd_deflection.model.solvers.plane import Covariance, checked_variances
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.rig.config import Rig

Columns = FloatArray | float

_STEP = 1e-8
"""m. Of differences: far above rounding, far below what bends the answer."""


class SolverStatus(IntEnum):
    """How a solver ended."""

    OK = 0
    NOT_CONVERGED = 1
    NO_HIT = 2
    """A printed threshold method found no trial inside its tolerance (kept for comparison only)."""
    INADMISSIBLE = 3
    """The readings contradict the model (for example a base line longer than the plate's)."""


class Solution(NamedTuple):
    """One block's answer.

    ``dx``, ``dy`` m; ``theta``, ``phi``, ``omega`` rad, right-hand positive (tilts are 0 if the
    method has none). ``covariance``: 3 x 3 of (dx, dy, theta), row by row; NaN of a printed threshold
    method, which has none. ``residual``:
    (x1, y1, x2, y2, ...) measured minus modelled dots, m. ``iterations``: 0 for a closed form.
    """

    dx: float
    dy: float
    theta: float
    phi: float
    omega: float
    covariance: Covariance
    residual: tuple[float, ...]
    status: SolverStatus
    iterations: int


_STATUSES = tuple(SolverStatus)


@dataclass(frozen=True, slots=True, eq=False)
class Solutions:
    """The answers of n blocks.

    ``pose`` (n, 3): dX m, dY m, theta rad. ``tilt`` (n, 2): phi, omega, rad. ``covariance``
    (n, 3, 3). ``residual`` (n, 2P), m. ``status`` int8 (n,): values of :class:`SolverStatus`.
    """

    pose: FloatArray
    tilt: FloatArray
    covariance: FloatArray
    residual: FloatArray
    status: npt.NDArray[np.int8]

    def rows(self) -> list[Solution]:
        """Each block's answer; its iterations are not counted."""
        arrays = self.pose, self.tilt, self.covariance.reshape(-1, 9), self.residual, self.status
        return [
            Solution(x, y, theta, phi, omega, tuple(covariance), tuple(residual), _STATUSES[status], 0)
            for (x, y, theta), (phi, omega), covariance, residual, status in zip(
                *[array.tolist() for array in arrays], strict=True
            )
        ]


def flat_solutions(
    pose: Sequence[FloatArray], covariance: Sequence[Columns], residual: Sequence[FloatArray], converged: BoolArray
) -> Solutions:
    """The answers of n blocks without tilts, of columns (n,): 3 of the pose, 9 of the covariance, 2P of the residual.

    ``converged`` (n,): the others have NOT_CONVERGED.
    """
    n = len(converged)
    covariances = np.stack([np.broadcast_to(column, n) for column in covariance], axis=1).reshape(n, 3, 3)
    status = np.where(converged, SolverStatus.OK, SolverStatus.NOT_CONVERGED).astype(np.int8)
    return Solutions(np.stack(pose, axis=1), np.zeros((n, 2)), covariances, np.stack(residual, axis=1), status)


class Solver(abc.ABC):
    """One method, bound to one geometry; holds no state between blocks.

    ``name``: as in the registry. ``budgeted_as``: the model of the error budget (``studies.budget.estimate.METHODS``)
    whose errors the method has; '' if there is none. ``psds_at``: ``tip`` (on the plate, lasers at the base) or
    ``base`` (lasers on the plate). ``tilts``: what it says of the plate's tilts.
    """

    name: ClassVar[str]
    budgeted_as: ClassVar[str]
    psds_at: ClassVar[Literal['tip', 'base']] = 'tip'
    tilts: ClassVar[Tilts] = 'none'

    def __init_subclass__(cls) -> None:
        # A method derived from another one that changes the answer of one block changes that of many.
        for single, many in (('solve', 'solve_many'), ('gain', 'gain_many')):
            if single in vars(cls) and many not in vars(cls):
                setattr(cls, many, getattr(Solver, many))

    @abc.abstractmethod
    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the method cannot solve it."""

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """The options that the method reads from the rig file: keyword arguments of the class."""
        return {}

    @abc.abstractmethod
    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """Solve one block.

        ``dots``: (x1, y1, x2, y2, ...), m, block means from each PSD's centre (pre-load reading
        not subtracted). ``variances``: of those means, m^2, all > 0.
        """

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """Solve n blocks: ``dots`` (n, 2P) m, ``variances`` (2P,) or (n, 2P) m^2.

        Raises SolverError if a variance is not above 0.
        """
        m = np.atleast_2d(np.asarray(dots, dtype=np.float64))
        v = np.broadcast_to(checked_variances(variances), m.shape)
        solutions = [self.solve(tuple(a), tuple(b)) for a, b in zip(m.tolist(), v.tolist(), strict=True)]
        return Solutions(
            np.array([f[:3] for f in solutions]),
            np.array([f[3:5] for f in solutions]),
            np.array([f.covariance for f in solutions]).reshape(-1, 3, 3),
            np.array([f.residual for f in solutions]),
            np.array([f.status for f in solutions], dtype=np.int8),
        )

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """How the answer goes with each dot, d(dX, dY, theta)/d(dots), (3, 2P): 1 and rad/m.

        With it the covariance of the dots becomes that of the answer, K C K^T, whatever the weights were.
        ``solution``: what :meth:`solve` gave for ``dots`` and ``variances``. By differences here.
        """
        out = np.empty((3, len(dots)))
        for i in range(len(dots)):
            moved = self.solve((*dots[:i], dots[i] + _STEP, *dots[i + 1 :]), variances)
            out[0, i] = (moved.dx - solution.dx) / _STEP
            out[1, i] = (moved.dy - solution.dy) / _STEP
            out[2, i] = (moved.theta - solution.theta) / _STEP
        return out

    def gain_many(self, dots: FloatArray, variances: tuple[float, ...], solutions: Solutions) -> FloatArray:
        """:meth:`gain` (n, 3, 2P) of n blocks: ``dots`` (n, 2P) m, ``variances`` (2P,) m^2 of all of them."""
        rows = zip(dots.tolist(), solutions.rows(), strict=True)
        return np.stack([self.gain(tuple(block_dots), variances, solution) for block_dots, solution in rows])

    def allowance(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> FloatArray | None:
        """(3, 3): what the covariance of :meth:`solve` holds besides the dots' noise; None if there is nothing."""
        del dots, variances
        return None


def flat_gain(
    centers: tuple[float, ...],
    dots: tuple[float, ...],
    variances: tuple[float, ...],
    solution: Solution,
    arithmetic: Arithmetic = LIBRARY,
) -> FloatArray:
    """:meth:`Solver.gain` of weighted least squares on a flat plate. ``centers``: (x1, y1, x2, y2, ...), m."""
    points = [center + dot for center, dot in zip(centers, dots, strict=True)]
    return np.array(weighted_gain(points, arithmetic.cos_sin(solution.theta), variances, solution.covariance))


def flat_gain_many(
    centers: tuple[float, ...],
    dots: FloatArray,
    variances: tuple[float, ...],
    solutions: Solutions,
    arithmetic: Arithmetic = LIBRARY,
) -> FloatArray:
    """:meth:`Solver.gain_many`, as :func:`flat_gain`."""
    points = [center + column for center, column in zip(centers, dots.T, strict=True)]
    theta = solutions.pose[:, 2]
    cos_sin = arithmetic.cos_many(theta), arithmetic.sin_many(theta)
    rows = weighted_gain(points, cos_sin, variances, tuple(solutions.covariance.reshape(-1, 9).T))
    return np.array(rows).transpose(2, 0, 1)


def weighted_gain(
    points: Sequence[Number], cos_sin: tuple[Number, Number], variances: Sequence[float], covariance: Sequence[Number]
) -> tuple[list[Number], list[Number], list[Number]]:
    """P A^T V^-1, P the answer's own ``covariance``: the gain of least squares with the weights 1/``variances``.

    Rows of dX, dY, theta, of one block or of arrays of blocks. ``points``: q = (x1, y1, ...), m. ``cos_sin``: of
    theta. The readings of a dot at q go with the pose as -R(-theta) and (q_y, -q_x).
    """
    c, s = cos_sin
    xx, xy, xt, _, yy, yt, _, _, tt = covariance
    rows: tuple[list[Number], list[Number], list[Number]] = ([], [], [])
    for i in range(0, len(points), 2):
        qx, qy = points[i], points[i + 1]
        for ax, ay, at, v in ((-c, -s, qy, variances[i]), (s, -c, -qx, variances[i + 1])):
            rows[0].append((xx * ax + xy * ay + xt * at) / v)
            rows[1].append((xy * ax + yy * ay + yt * at) / v)
            rows[2].append((xt * ax + yt * ay + tt * at) / v)
    return rows
