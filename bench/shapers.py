# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What shapers leave of a vibration."""

import functools

import numpy as np

from bench.simulated_arm import LAG_S, SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.compensation.trajectory import Trajectory, TrajectoryShaper, checked
from psd_deflection.arms.inputs import standing
from psd_deflection.model.link.shapers import KINDS, Shaper, shaper
from tools.program import ROOT

FREQUENCY, RATIO = 12.0, 0.02
GRAVITY, PAYLOAD = 9.81, np.array([0.0, 0.0, -20.0])
NAMES = ('shoulder', 'elbow')
START, END = np.array([1.2, 0.6]), np.array([0.9, 1.0])
MOVE_S, STEP_S = 0.4, 0.002
SETTLED_S = 6.0 * LAG_S  # After the last point the joints have arrived, s.
WRONG = (0.95, 1.0, 1.05)  # The frequency that the shaper is made for, over the true one.


def move() -> Trajectory:
    """From rest to rest: two points with velocities."""
    points = [[at.tolist(), [0.0, 0.0], []] for at in (START, END)]
    return checked(NAMES, [0.0, MOVE_S], points)


def played(trajectory: Trajectory) -> float:
    """Amplitude of the end effector's vibration after the trajectory, m."""
    chain, mass = read_chain(ROOT / 'config' / 'two_links.yaml').chain, float(np.linalg.norm(PAYLOAD)) / GRAVITY
    arm = SimulatedArm(chain, START, frequency=FREQUENCY, damping=RATIO, mass=mass)
    arm.force = PAYLOAD
    arm.settle()
    times = np.arange(0.0, trajectory.duration + SETTLED_S, STEP_S)
    for wanted in trajectory.at(times)[:, 0]:
        arm.step(wanted, STEP_S)
    return arm.vibration()


@functools.cache
def unshaped() -> float:
    """Amplitude after the move as it is, m."""
    return played(move())


def residual(shaper: Shaper) -> float:
    """Amplitude after the shaped move over that after the move as it is."""
    start = standing(dict(zip(NAMES, START.tolist(), strict=True)))
    return played(TrajectoryShaper(shaper).shape(0, move(), start)) / unshaped()


SHAPER_HEAD = ('shaper', 'longer by', '5 % too low', 'right', '5 % too high')


def rows() -> list[tuple[str, ...]]:
    """Shaper, what it adds to the move, and what is left for each of ``WRONG``."""
    out = []
    for kind in KINDS:
        shares = [residual(shaper(kind, FREQUENCY * wrong, RATIO)) for wrong in WRONG]
        longer = f'{1e3 * shaper(kind, FREQUENCY, RATIO).duration:.0f} ms'
        out.append((kind.upper(), longer, *(f'{100.0 * share:.1f} %' for share in shares)))
    return out
