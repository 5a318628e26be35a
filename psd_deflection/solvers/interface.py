"""The inputs and outputs of every solver, for one block and for many.

Theory of operation. A dot reading m_i is where laser i falls on PSD i, from the PSD's centre c_i,
in plate axes. Before load it was m_i0, so the beam is at l_i = c_i + m_i0, fixed to the base. The
plate point under it is now q_i = c_i + m_i. A flat plate that moved by d = (dX, dY) and turned by
theta about +Z has q_i = Rz(-theta)(l_i - d); a solver inverts this, or the fuller model with tilts
phi (about X) and omega (about Y), R = Ry(omega) Rx(phi) Rz(theta).

``solve`` takes and returns plain floats: it is called once per block in real time, and numpy's cost
per call would dominate. ``solve_many`` is vectorised over n blocks.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.config import Rig
from psd_deflection.geometry.layout import Geometry
from psd_deflection.records import FloatArray


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
    covariance: tuple[float, float, float, float, float, float, float, float, float]
    residual: tuple[float, ...]
    status: SolverStatus
    iterations: int


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


class Solver(abc.ABC):
    """One method, bound to one geometry; holds no state between blocks.

    ``name``: as in the registry. ``budgeted_as``: the model of the error budget (``budget.estimate.METHODS``)
    whose errors the method has; '' if there is none.
    """

    name: ClassVar[str]
    budgeted_as: ClassVar[str]

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

    @abc.abstractmethod
    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """Solve n blocks at once: ``dots`` (n, 2P) m, ``variances`` (2P,) or (n, 2P) m^2."""
