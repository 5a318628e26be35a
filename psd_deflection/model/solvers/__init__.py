# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From dots to the pose of the tip: one algorithm a file, one interface (``interface``)."""

from psd_deflection.model.solvers.interface import Solution, Solutions, Solver, SolverStatus
from psd_deflection.model.solvers.registry import SOLVERS, make_solver, solver_from_rig

__all__ = ['SOLVERS', 'Solution', 'Solutions', 'Solver', 'SolverStatus', 'make_solver', 'solver_from_rig']
