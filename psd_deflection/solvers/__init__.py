"""From dots to the pose of the tip: one algorithm a file, one interface (``_interface``)."""

from psd_deflection.solvers._interface import Geometry, Solution, Solutions, Solver, SolverStatus
from psd_deflection.solvers._registry import SOLVERS, make_solver
from psd_deflection.solvers._rig import geometry_from_rig, solver_from_rig

__all__ = [
    'SOLVERS',
    'Geometry',
    'Solution',
    'Solutions',
    'Solver',
    'SolverStatus',
    'geometry_from_rig',
    'make_solver',
    'solver_from_rig',
]
