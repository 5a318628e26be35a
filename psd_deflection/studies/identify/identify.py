# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the modes of the link in a recording."""

from __future__ import annotations

from psd_deflection.studies.identify.from_recordings import IdentifyProblem
from psd_deflection.studies.identify.modes import modes_of
from psd_deflection.studies.identify.result import Identified


def identify(problem: IdentifyProblem) -> Identified:
    """Return the modes of each axis; see :mod:`psd_deflection.studies.identify.modes` for the methods."""
    x, y, twist = (modes_of(problem.poses[:, i], problem.rate) for i in range(3))
    return Identified(problem, (x, y, twist))
