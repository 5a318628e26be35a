# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""E_C, the method's own error on perfect readings (last row of Table 3.1; 3.9, 3.10 corrected).

For an exact method it is zero. The least squares of chapter 4 are linear: the result is sin theta
instead of theta, and d is not rotated, d^ - d = -theta z x d + theta^2 l/2. The iteration of
section 2.2 stops at the first trial angle inside a window, which is always short of the true one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.chain import MeasuringChain, measure
from psd_deflection.studies.budget.term import Cause, Contribution, Kind, Situation


def stop_window(beams: FloatArray, tolerance: float) -> float:
    """Distance from the true angle at which both 3.9 and 3.10 first hold, rad: tolerance / max(|E_x|, |E_y|)."""
    base = np.abs(beams[0] - beams[1])
    return tolerance / float(base.max())


def _iteration(at: Situation) -> Contribution:
    twist = float(at.pose[2])
    window, step = stop_window(at.rig.centers + at.rig.zeros, at['iteration_tolerance']), at['iteration_step']
    if window < step / 2.0:
        raise ConfigError(
            f'iteration_tolerance = {at["iteration_tolerance"]:g} m: its window of ±{window:g} rad is narrower than '
            f'iteration_step = {step:g} rad: the iteration may step over it; take a finer step'
        )
    # The first trial inside the window is uniform within one step of its edge.
    short, deviation = window - step / 2.0, step / math.sqrt(12.0)
    if abs(twist) <= window:
        short, deviation = abs(twist), 0.0
    # The thesis takes d from PSD 1: d = l_1 - R(theta) q_1, so an angle error moves it by that
    # angle times l_1 - d.
    arm = at.rig.centers[0] + at.rig.zeros[0] - at.pose[:2]
    response = np.array([arm[1], -arm[0], 1.0])
    return Contribution(-math.copysign(short, twist) * response, deviation**2 * np.outer(response, response))


class Computation(Cause):
    """E_C of the chosen method."""

    name = 'computation'
    row = 'E_C'
    kind = Kind.KNOWN
    formula = (
        "the method's answer to perfect readings of its own model, less the truth; thesis_iteration: its stop rule"
    )
    inputs = ('iteration_tolerance', 'iteration_step')

    def contribution(self, at: Situation) -> Contribution:
        """As declared; the stop rule leaves a bias and, because of its grid, a small random part."""
        if at.method == 'thesis_iteration':
            return _iteration(at)
        return Contribution(perfect_answer(at) - at.pose, np.zeros((3, 3)))

    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """As declared: the chain is unchanged."""
        return chain

    def perturb(
        self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator, *, shaped: bool = False
    ) -> MeasuringChain:
        """As declared."""
        return chain

    def beside(self, at: Situation, count: int, random: np.random.Generator) -> FloatArray:
        """As declared."""
        bias, covariance = self.contribution(at)
        return np.asarray(random.multivariate_normal(bias, covariance, size=count, method='svd'))


COMPUTATION = Computation()


def perfect_answer(at: Situation) -> FloatArray:
    """(3,): the estimator's answer if the chain is as the estimator models it."""
    chain = replace(at.chain, slope_ratio=np.array([at.estimator.slope_ratio]))
    return np.asarray(at.estimator.estimate(*measure(chain, at.pose))[0])
