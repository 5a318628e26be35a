"""Names to methods: the one list of what ``solver:`` and ``solvers:`` of a rig file may say."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Any

from psd_deflection.errors import ConfigError, did_you_mean
from psd_deflection.solvers.base_pair import BasePairSolver
from psd_deflection.solvers.beam import BeamSolver
from psd_deflection.solvers.exact import ExactSolver
from psd_deflection.solvers.interface import Geometry, Solver
from psd_deflection.solvers.iterative import IterativeSolver
from psd_deflection.solvers.minimum_tilt import MinimumTiltSolver
from psd_deflection.solvers.ols import OlsSolver
from psd_deflection.solvers.pose import PoseSolver
from psd_deflection.solvers.wls import WlsSolver
from psd_deflection.solvers.wls_exact import WlsExactSolver
from psd_deflection.thesis.appendix_d import AppendixDSolver
from psd_deflection.thesis.appendix_d_least_squares import AppendixDOlsSolver, AppendixDWlsSolver
from psd_deflection.thesis.iterative_printed import IterativePrintedSolver

_CLASSES: tuple[type[Solver], ...] = (
    ExactSolver,
    WlsSolver,
    IterativeSolver,
    BeamSolver,
    WlsExactSolver,
    OlsSolver,
    MinimumTiltSolver,
    PoseSolver,
    BasePairSolver,
    IterativePrintedSolver,
    AppendixDSolver,
    AppendixDOlsSolver,
    AppendixDWlsSolver,
)

SOLVERS: MappingProxyType[str, Callable[..., Solver]] = MappingProxyType({cls.name: cls for cls in _CLASSES})
"""Name to class, the default first."""


def make_solver(name: str, geometry: Geometry, **options: Any) -> Solver:
    """The method ``name`` bound to ``geometry``; ``options`` as its class documents them.

    Raises ConfigError for an unknown name, SolverError where the method cannot solve the geometry.
    """
    cls = SOLVERS.get(name)
    if cls is None:
        raise ConfigError(f'solver = {name!r}: must be one of {", ".join(SOLVERS)}{did_you_mean(name, SOLVERS)}')
    return cls(geometry, **options)
