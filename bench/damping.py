# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What shapers and active damping leave of a vibration: ``python -m bench.damping``.

Shapers: the arm of ``config/two_links.yaml`` carries 20 N and moves both joints within 0.4 s. Its links ring at 12 Hz.
The shapers are made for that frequency, and for one that is 5 % below or above. Judged is the amplitude when the joints
have arrived.

Active damping: one link (``bench/damped_link.py``) whose velocity comes from the product's filter. It moves with a
shaper for a frequency that is 10 % wrong, and it is knocked, so hard too that the damper is at its limits.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench import damped_link
from bench.damped_link import Swung, swing
from bench.simulated_arm import LAG_S, SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.compensation.trajectory import Trajectory, TrajectoryShaper, checked
from psd_deflection.arms.inputs import standing
from psd_deflection.arms.shapers import KINDS, Shaper, shaper
from psd_deflection.base.charts import Chart, Colour, Panel, Series
from tools.program import ROOT

FREQUENCY, RATIO = 12.0, 0.02
GRAVITY = 9.81
PAYLOAD = np.array([0.0, 0.0, -20.0])
NAMES = ('shoulder', 'elbow')
START, END = np.array([1.2, 0.6]), np.array([0.9, 1.0])
MOVE_S = 0.4
STEP_S = 0.002
SETTLED_S = 6.0 * LAG_S
"""After the last point the joints have arrived, s."""
PAYLOAD_SHIFT = 1.1
"""The same of the one link."""
LINK_S, ARRIVED, LATER = 2.0, 1.0, 1.6
"""Duration of a run of the one link; times at which it is judged, s. It moves from 0.5 s on."""
WRONG = (0.95, 1.0, 1.05)
"""The frequency that the shaper is made for, over the true one."""


def move() -> Trajectory:
    """From rest to rest: two points with velocities."""
    points = [[at.tolist(), [0.0, 0.0], []] for at in (START, END)]
    return checked(NAMES, [0.0, MOVE_S], points)


def played(trajectory: Trajectory) -> float:
    """Amplitude of the end effector's vibration after the trajectory, m."""
    arm = SimulatedArm(
        read_chain(ROOT / 'config' / 'two_links.yaml').chain,
        START,
        frequency=FREQUENCY,
        damping=RATIO,
        mass=float(np.linalg.norm(PAYLOAD)) / GRAVITY,
    )
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


def left(by: Shaper) -> float:
    """Amplitude after the shaped move over that after the move as it is."""
    return (
        played(TrajectoryShaper(by).shape(0, move(), standing(dict(zip(NAMES, START.tolist(), strict=True)))))
        / unshaped()
    )


def rows() -> list[tuple[str, ...]]:
    """Shaper, what it adds to the move, and what is left for each of ``WRONG``."""
    out = []
    for kind in KINDS:
        shares = [left(shaper(kind, FREQUENCY * wrong, RATIO)) for wrong in WRONG]
        longer = shaper(kind, FREQUENCY, RATIO).duration
        out.append((kind.upper(), f'{1e3 * longer:.0f} ms', *(f'{100.0 * share:.1f} %' for share in shares)))
    return out


def link_move() -> Trajectory:
    """The one link from rest to rest."""
    return checked(['joint'], [0.0, 0.3], [[[0.0], [0.0], []], [[0.4], [0.0], []]])


def moved_links() -> dict[str, Swung]:
    """The one link moved as it is, shaped for a wrong frequency, and that with damping too."""
    by = shaper('zv', PAYLOAD_SHIFT * damped_link.FREQUENCY, damped_link.RATIO)
    shaped = TrajectoryShaper(by).shape(0, link_move(), standing({'joint': 0.0}))
    return {
        'no shaper': swing(LINK_S, link_move()),
        'shaper': swing(LINK_S, shaped),
        'shaper and damping': swing(LINK_S, shaped, damped_link.SETTINGS),
    }


def moved_rows(links: dict[str, Swung]) -> list[tuple[str, ...]]:
    """Amplitude at ``ARRIVED`` and ``LATER``, s."""
    first = links['no shaper'].amplitude[round(1e3 * ARRIVED)]
    out = []
    for name, link in links.items():
        sizes = [link.amplitude[round(1e3 * t)] for t in (ARRIVED, LATER)]
        out.append((name, *(f'{1e3 * a:.3f} mm' for a in sizes), f'{100.0 * sizes[0] / first:.1f} %'))
    return out


def knock_rows() -> list[tuple[str, ...]]:
    """Logarithmic decrement and largest offset after knocks, without damping, with it, and at its limits."""
    out: list[tuple[str, ...]] = []
    held = replace(damped_link.SETTINGS, max_offset=2e-4)
    wrong = replace(damped_link.SETTINGS, lever=-damped_link.SETTINGS.lever)
    for name, settings, knock, windows in (
        ('no damping', None, 0.2, ((0.6, 0.8),)),
        ('damping', damped_link.SETTINGS, 0.2, ((0.6, 0.8),)),
        ('largest offset 0.2 mrad: at it', held, 0.2, ((0.6, 0.8), (1.2, 1.4))),
        ('lever of the wrong sign', wrong, 0.02, ((0.6, 0.8), (2.0, 2.2))),
    ):
        link = swing(windows[-1][1] + 0.1, None, settings, knock=knock)
        most = f'{1e3 * float(np.abs(link.offset).max()):.2f} mrad'
        for i, (first, last) in enumerate(windows):
            names = (name, '0.7 s later') if settings is held else (name, '1.4 s later: damping has stopped')
            out.append((names[i], f'{1e3 * knock:.0f} mm/s', f'{link.decrement(first, last):.2f}', most))
    return out


def chart(links: dict[str, Swung]) -> Chart:
    """Deflection over time."""
    tones: tuple[Colour, ...] = ('quiet', 'blue', 'orange')
    curves = [
        Series(name, link.t, link.deflection * 1e3, tone)
        for (name, link), tone in zip(links.items(), tones, strict=True)
    ]
    panel = Panel(curves, 'time / s', 'deflection of the tip / mm', height=240)
    return Chart('deflection of the tip over time', [panel])


SHAPER_HEAD = ('shaper', 'longer by', '5 % too low', 'right', '5 % too high')
MOVED_HEAD = ('one link, shaper 10 % wrong', 'when the joint has arrived', '0.6 s later', 'of no shaper')
KNOCK_HEAD = ('one link, knocked', 'knock', 'logarithmic decrement', 'largest offset')


def printed(head: Sequence[str], body: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    print('\n| ' + ' | '.join(head) + ' |\n' + '|---' * len(head) + '|')
    for row in body:
        print('| ' + ' | '.join(row) + ' |')


def main() -> None:
    """Print the tables."""
    print(f'without a shaper: {1e3 * unshaped():.2f} mm')
    for head, body in ((SHAPER_HEAD, rows()), (MOVED_HEAD, moved_rows(moved_links())), (KNOCK_HEAD, knock_rows())):
        printed(head, body)


if __name__ == '__main__':
    main()
