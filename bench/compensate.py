# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make demo NAME=compensate``: a simulated arm with and without compensation and shapers, on one page."""

import argparse
import collections
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import shapers
from bench.simulated_arm import SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import read_arm
from psd_deflection.arms.compensation.compensator import Compensator, Observed, State
from psd_deflection.arms.compensation.settings import CompensatorSettings
from psd_deflection.base.charts import Chart, Colour, Panel, Rule, Series, drawn
from psd_deflection.base.figures import figure_of
from psd_deflection.base.pages import page, table
from psd_deflection.records import FloatArray

ROOT = Path(__file__).resolve().parent.parent
URDF = ROOT / 'config' / 'two_links.urdf'
PERIOD, LATE = 0.02, 0.03
NOISE = 1e-6  # Of a deflection, m, one standard deviation.
PAYLOAD = np.array([0.0, 0.0, -20.0])
TAKEN, MOVED, ARRIVED, LOST, BACK, ENABLED, PUT_DOWN, END = 1.0, 8.0, 11.0, 16.0, 16.5, 3.0, 20.0, 26.0
TONES: tuple[Colour, ...] = ('blue', 'orange')
POSES = np.array([[1.2, 0.6], [0.7, 1.3]])
WINDOWS = {
    'payload held': (ENABLED + 3.0, MOVED),
    'while the arm moves': (MOVED, ARRIVED),
    'payload held elsewhere': (ARRIVED + 3.0, LOST),
    'without estimates': (LOST, BACK),
    'six seconds after it is put down': (PUT_DOWN, END),
}


class Ran(NamedTuple):
    """A run: times (n,) s, errors (n,) m, offsets (n, 2) rad, whether the offsets were held (n,)."""

    t: FloatArray
    error: FloatArray
    offsets: FloatArray
    held: FloatArray


def wanted(t: float) -> FloatArray:
    """The joints that the trajectory asks for, rad: at rest, a smooth move of three seconds, at rest."""
    s = min(max((t - MOVED) / (ARRIVED - MOVED), 0.0), 1.0)
    out: FloatArray = POSES[0] + (POSES[1] - POSES[0]) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return out


def run(compensated: bool, end: float = END) -> Ran:
    file = read_chain(ROOT / 'config' / 'two_links.yaml')
    plant = SimulatedArm(file.chain, POSES[0], damping=0.02)
    arm = read_arm(URDF, 'tool')
    compensator = Compensator(arm, CompensatorSettings(axes=('x', 'z'), takeover=False))
    noise = np.random.default_rng(1)
    late: collections.deque[tuple[float, Transform]] = collections.deque()
    offsets = np.zeros(2)
    rows = []
    for n in range(round(end / PERIOD)):
        t = n * PERIOD
        compensator.enable(compensated and t >= ENABLED)
        plant.force = PAYLOAD if TAKEN <= t < PUT_DOWN else np.zeros(3)
        plant.step(wanted(t) + offsets, PERIOD)
        compensator.joints(t, plant.angles)
        observed = plant.end()
        at = observed.deflection.position + noise.normal(size=3) * NOISE
        if not LOST <= t < BACK:
            late.append((t, Transform(observed.deflection.rotation, at)))
        while late and late[0][0] <= t - LATE:
            stamp, deflection = late.popleft()
            covariance = np.eye(6) * NOISE**2
            compensator.observe(t, Observed(stamp, deflection, covariance, t - stamp))
        command = compensator.watch(t)
        offsets = command.offsets
        error = np.linalg.norm(observed.deflected.position - arm.pose(wanted(t)).position)
        rows.append((t, error, *offsets, command.state is State.HOLDING))
    out = np.array(rows, dtype=np.float64)
    return Ran(out[:, 0], out[:, 1], out[:, 2:4], out[:, 4])


def rms(ran: Ran, window: tuple[float, float]) -> float:
    inside = (ran.t >= window[0]) & (ran.t < window[1])
    return float(np.sqrt(np.mean(ran.error[inside] ** 2)))


def chart(without: Ran, ran: Ran) -> Chart:
    events = ((TAKEN, 'payload'), (ENABLED, 'enabled'), (MOVED, 'move'), (LOST, 'no estimates'), (PUT_DOWN, 'put down'))
    rules = [Rule(t, what) for t, what in events]
    both: tuple[tuple[str, Ran, Colour], ...] = (('without', without, 'quiet'), ('with', ran, 'blue'))
    errors = [Series(name, each.t, each.error * 1e3, tone) for name, each, tone in both]
    named = zip(('shoulder', 'elbow'), TONES, ran.offsets.T, strict=True)
    joints = [Series(name, ran.t, column * 1e3, tone) for name, tone, column in named]
    held = ran.held > 0
    joints.append(Series('held', np.tile(ran.t[held], 2), ran.offsets[held].T.ravel() * 1e3, 'red', 'points'))
    panels = (
        Panel(errors, 'time / s', 'distance from the rigid pose / mm', log='y', rules=rules, height=220),
        Panel(joints, 'time / s', 'offset / mrad', rules=[Rule(t) for t, _ in events], height=220),
    )
    return Chart('distance from the rigid pose and offsets of the joints over time', panels)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--out', type=Path, default=ROOT / 'build' / 'compensate')
    args = parser.parse_args(argv)
    without, ran = run(False), run(True)
    rows = []
    for name, window in WINDOWS.items():
        before, after = rms(without, window), rms(ran, window)
        rows.append((name, f'{before * 1e3:.4f}', f'{after * 1e3:.4f}', f'{100.0 * after / before:.2f} %'))
        print(f'{name:34}{before * 1e3:10.4f} mm{after * 1e3:10.4f} mm{100.0 * after / before:8.2f} %')
    compensated = chart(without, ran)
    print(f'vibration after a quick move without a shaper: {1e3 * shapers.unshaped():.2f} mm')
    residuals = shapers.rows()
    print(*('  '.join(f'{cell:>12}' for cell in row) for row in (shapers.SHAPER_HEAD, *residuals)), sep='\n')
    head = ('rms distance from the rigid pose', 'without, mm', 'with, mm', 'left')
    body = [
        '<h1>A payload on a flexible arm, with and without compensation</h1>',
        '<p>Two links of the thesis, simulated, with a payload of 20 N at the end effector. The compensator sees the '
        'deflection 30 ms late and with noise, and moves both joints.</p>',
        table(head, rows),
        drawn(compensated),
        '<h1>A quick move, with and without a shaper</h1>',
        '<p>What each shaper leaves of the vibration of the arm. The frequency is right, or 5 % wrong.</p>',
        table(shapers.SHAPER_HEAD, residuals),
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / 'report.html').write_text(page('Compensation', body), encoding='utf-8')
    figure_of(compensated).savefig(args.out / 'compensation.png', dpi=90)
    print(f'the page: {args.out / "report.html"}')


if __name__ == '__main__':
    main()
