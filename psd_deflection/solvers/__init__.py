"""From dots to the pose of the tip: one algorithm a file, one interface (``_interface``)."""

from psd_deflection.solvers.from_rig import geometry_from_rig, solver_from_rig
from psd_deflection.solvers.interface import Geometry, Solution, Solutions, Solver, SolverStatus
from psd_deflection.solvers.registry import SOLVERS, make_solver

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
