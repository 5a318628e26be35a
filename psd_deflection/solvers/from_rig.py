"""From a rig's parameters to solvers: which parameter goes to which method is said here alone."""

from __future__ import annotations

from typing import Any

from psd_deflection.config import Rig
from psd_deflection.solvers.interface import Geometry, Solver
from psd_deflection.solvers.registry import make_solver


def geometry_from_rig(rig: Rig) -> Geometry:
    """The geometry that ``psd_N.center``, ``.zero``, ``.height`` and ``link`` describe."""
    return Geometry(
        centers=rig.centers,
        zeros=rig.zeros,
        heights=rig.heights,
        link_length=rig.link.length,
        slope_ratio=rig.link.slope_ratio,
    )


def solver_from_rig(name: str, rig: Rig) -> Solver:
    """The method ``name`` for this rig, with the rig's own options for it (``wls.*``).

    Raises ConfigError for an unknown name, SolverError where the method cannot solve the rig.
    """
    options: dict[str, Any] = {}
    if name in ('wls', 'wls_exact'):
        options = {'weights': rig.estimator.wls_weights, 'row_scaling': rig.estimator.wls_row_scaling}
    return make_solver(name, geometry_from_rig(rig), **options)
