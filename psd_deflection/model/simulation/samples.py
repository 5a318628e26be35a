# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Consecutive samples on their way through the stages."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Self

import numpy as np

from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray


def _none() -> FloatArray:
    return np.empty((0, 0))


def no_samples_between(phase: float) -> FloatArray:
    """Nothing: only an effect on the volts may ask for them, while it acts."""
    return np.empty((6, 0))


@dataclass(slots=True, eq=False)
class SimulatedSamples:
    """n samples, one row a quantity, filled stage by stage; effects change rows in place.

    ``t`` (n,): s since the first sample. ``warmer`` (n,): K above the first temperature.
    ``loads`` (3, n): Fx, Fy N, Tz N m. ``static`` (3, n): the pose these loads would settle at,
    without ``physics.at_rest``. ``pose`` (3, n): dX, dY m, theta rad. ``beams`` (2P, n): l_1,
    l_2 ..., m. ``true_dots`` (2P, n): on the plate from the PSD centres. ``dots`` (2P, n): as the PSDs
    report them. ``sums`` (P, n), ``volts`` (3P, n): V. ``noise`` (3P,): V rms of a noise that is not in ``volts``,
    which are then to be the mean over it; 0 if ``volts`` are single samples. ``between(phase)``: the volts
    (3P, n) that are there ``phase`` s after each sample, less than a period, for an effect on ``volts``; an
    effect asks for the same phases in every chunk of a run.
    """

    t: FloatArray
    warmer: FloatArray
    loads: FloatArray
    physics: Physics
    static: FloatArray = field(default_factory=_none)
    pose: FloatArray = field(default_factory=_none)
    beams: FloatArray = field(default_factory=_none)
    true_dots: FloatArray = field(default_factory=_none)
    dots: FloatArray = field(default_factory=_none)
    sums: FloatArray = field(default_factory=_none)
    volts: FloatArray = field(default_factory=_none)
    noise: FloatArray = field(default_factory=lambda: np.zeros(6))
    between: Callable[[float], FloatArray] = no_samples_between

    def first(self, n: int) -> Self:
        """The first ``n`` samples, all of whose quantities are there."""
        out = replace(self)
        for name in (f.name for f in fields(self) if f.name != 'noise'):
            if isinstance(rows := getattr(self, name), np.ndarray):
                setattr(out, name, rows[..., :n])
        return out

    def up_to_plate(self, physics: Physics) -> Self:
        """The samples up to the dots on the plate, shared and read-only, for another reading of them."""
        out = replace(self, physics=physics, dots=_none(), sums=_none(), volts=_none(), between=no_samples_between)
        for rows in (self.t, self.warmer, self.loads, self.static, self.pose, self.beams, self.true_dots):
            rows.setflags(write=False)
        return out
