# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether the link is at rest, as a zero needs it."""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray, dot_names

MOVING, RINGS, STILL = 5.0, 10e-6, 2e-6
"""A zero is rejected if the dots scatter or drift by so many times the noise and by more than so much, m: see
:func:`why_moving`."""


def why_moving(dots: FloatArray, noise: tuple[float, ...]) -> str:
    """Why ``dots`` (n, C), m, of the last blocks are not those of a link at rest; '' if they may be.

    ``noise`` (C,): variance of a block's dots, m^2. Moving is what scatters ``MOVING`` times as much as the noise says
    and by more than ``RINGS``, or what drifts by as much and by more than ``STILL`` from the first half to the second.
    A mean over whole periods leaves little of what rings, and all of what drifts.
    """
    if len(dots) < 3:
        return ''
    scatter = dots.std(axis=0, ddof=1)
    half = len(dots) // 2
    drift = np.abs(dots[half:].mean(axis=0) - dots[:half].mean(axis=0))
    least = MOVING * np.sqrt(noise)
    beyond = np.maximum(scatter / np.maximum(least, RINGS), drift / np.maximum(least, STILL))
    worst = int(np.argmax(beyond))
    if beyond[worst] <= 1.0:
        return ''
    return (
        f'the link moves: {dot_names(len(noise) // 2)[worst]} varied by {scatter[worst] * 1e6:.1f} µm rms in the last '
        f'{len(dots)} blocks, noise explains {noise[worst] ** 0.5 * 1e6:.1f} µm; wait until it is at rest'
    )
