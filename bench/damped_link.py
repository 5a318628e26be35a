# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One flexible link on a joint, in a loop with the product's filter and its damper.

The link is that of the thesis. Its samples, with the rig's noise, go through the pipeline with ``filter: modal``; the
velocity of the tip goes to the damper, and the damper's offset to the joint, which follows with a lag of first order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bench.simulated_arm import LAG_S
from blind import motion
from blind.generator import RATE, Array
from psd_deflection.arms.compensation.damper import Damper, DamperSettings
from psd_deflection.arms.compensation.trajectory import Trajectory
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import RawChunk, TipMotion

FREQUENCY, RATIO = motion.MODES[0]
OMEGA = 2.0 * math.pi * FREQUENCY
SETTINGS = DamperSettings(
    FREQUENCY, RATIO, motion.LENGTH, added=0.15, lag=math.atan(OMEGA * LAG_S) / OMEGA + 0.005, max_offset=0.005
)
"""The joint's lag at the mode's frequency, and half the damper's period."""
LATE = 4
"""Samples after the end of a block at which its velocity is there."""
COMMANDED = 10
"""Samples between two commands of the damper."""


class Swung(NamedTuple):
    """At each ms: the time (n,) s, the tip's deflection (n,) m, its amplitude (n,) m, the damper's offset (n,) rad."""

    t: Array
    deflection: Array
    amplitude: Array
    offset: Array

    def decrement(self, first: float, last: float) -> float:
        """Mean logarithmic decrement of a period between two times, s."""
        a, b = (float(self.amplitude[round(t * RATE)]) for t in (first, last))
        return math.log(a / b) / ((last - first) * FREQUENCY)


def swing(
    seconds: float,
    trajectory: Trajectory | None = None,
    settings: DamperSettings | None = None,
    *,
    start: float = 0.5,
    knock: float = 0.0,
    knocked: float = 0.5,
    seed: int = 0,
) -> Swung:
    """The joint moves along ``trajectory`` from ``start`` on; ``knock`` m/s: what the tip gets at ``knocked``, s.

    ``settings``: of the damper; None: without damping.
    """
    pipeline, damper = Pipeline(motion.rig_of()), Damper(settings or SETTINGS)
    damper.enable(settings is not None)
    rng = np.random.default_rng(seed)
    n, h = round(seconds * RATE), 1.0 / RATE
    wanted = np.zeros(n)
    if trajectory is not None:
        wanted = trajectory.at(np.arange(n, dtype=np.float64) * h - start)[:, 0, 0]
    turned = OMEGA * math.sqrt(1.0 - RATIO**2)
    c, s, e = math.cos(turned * h), math.sin(turned * h), math.exp(-RATIO * OMEGA * h)
    q = v = offset = 0.0
    angle = earlier = float(wanted[0])
    rate = 0.0
    poses = np.zeros((motion.BLOCK, 3))
    waiting: list[tuple[int, TipMotion]] = []
    rows = []
    for i in range(n):
        angle += (wanted[i] + offset - angle) * -math.expm1(-h / LAG_S)
        before, rate = rate, (angle - earlier) / h
        earlier = angle
        v -= motion.LENGTH * (rate - before)
        if i == round(knocked * RATE):
            v += knock
        q, v = (
            e * (q * c + (v + RATIO * OMEGA * q) / turned * s),
            e * (v * c - (OMEGA**2 * q + RATIO * OMEGA * v) / turned * s),
        )
        poses[i % motion.BLOCK, 0] = q
        if i % motion.BLOCK == motion.BLOCK - 1:
            seq = np.arange(i - motion.BLOCK + 1, i + 1)
            volts = motion.volts_of(poses, rng).astype(np.float32)
            chunk = RawChunk(seq, seq * 1_000_000, volts, np.zeros(motion.BLOCK, np.uint8))
            waiting += [(i + LATE, r) for r in pipeline.process(chunk) if isinstance(r, TipMotion)]
        while waiting and waiting[0][0] <= i:
            moved = waiting.pop(0)[1]
            damper.observe(moved.t_ns / 1e9, moved.vx, math.sqrt(moved.velocity_covariance[0]))
        if i % COMMANDED == 0:
            offset = damper.watch(i * h).offset
        rows.append((i * h, q, math.hypot(q, v / OMEGA), offset))
    return Swung(*np.array(rows).T)
