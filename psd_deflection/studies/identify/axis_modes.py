# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is found of one axis: its modes, and how they were seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from psd_deflection.records import FloatArray

LEAST_DAMPING, MOST_DAMPING = 1e-6, 0.7
"""Bounds of the fit. A damping ratio at one of them is no answer."""


@dataclass(frozen=True)
class Mode:
    """One mode on one axis.

    ``frequency``, Hz, undamped; ``damping``: ratio; ``*_sd``: standard deviations. ``amplitude``:
    largest of the stretches at their start, m or rad; of a spectrum, rms.
    """

    frequency: float
    frequency_sd: float
    damping: float
    damping_sd: float
    amplitude: float


@dataclass(frozen=True)
class AxisModes:
    """The modes of one axis, the loudest first.

    ``how``: fitted to the link ringing alone, or to the spectrum of its motion in operation;
    ``none`` if it does not move. ``stretches``: first and last sample of each. ``fitted`` (n,): the
    fit, NaN between the stretches. ``noise``: standard deviation of a sample, m or rad.
    """

    modes: tuple[Mode, ...]
    how: Literal['ring-down', 'operation', 'none']
    stretches: tuple[tuple[int, int], ...]
    fitted: FloatArray = field(repr=False)
    noise: float
