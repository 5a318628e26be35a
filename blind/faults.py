# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One wrong reading after the other, and how far the estimates are off: ``python -m blind.faults``."""

import sys
from collections.abc import Sequence

import numpy as np

from blind import coverage, generator
from blind.campaign import options
from psd_deflection.measure.pipeline import Pipeline


def fault(kind: str, channel: int, load: tuple[float, float, float], seed: int = 1) -> tuple[float, str]:
    """Largest error in own standard deviations of any estimate of a rig with one wrong reading, and what is named.
    ``kind``: dead, stuck, inverted (``channel`` 0 to 3: x1, y1, x2, y2) or swapped (0 or 1: the PSD whose x and y are
    exchanged). Four seconds at rest, then ``load`` (N, N, N m) switched on for four."""
    n = 8000
    loads = np.zeros((n, 3))
    loads[n // 2 + 7 :] = load
    fine = generator.motion(loads, 0.585, [])
    clean, truth = coverage.optics_of(fine), coverage.middles(fine)
    volts = coverage.volts_of(coverage.Row(kind), clean, seed)
    column = (0, 1, 3, 4)[channel]
    if kind == 'dead':
        volts[:, column] = 0.0
    elif kind == 'stuck':
        volts[n // 4 :, column] = volts[n // 4, column]
    elif kind == 'inverted':
        volts[:, column] *= -1.0
    else:
        pair = [3 * channel, 3 * channel + 1]
        volts[:, pair] = volts[:, pair[::-1]]
    # Zeroed as it is: the readings at rest are what they are then.
    pipeline = Pipeline(coverage.rig(coverage.Row(kind)))
    worst = 0.0
    for e in coverage.estimates(pipeline, volts, np.ones(n, bool), zero_at=coverage.SETTLED // 2):
        if e.block < coverage.SETTLED // 2:
            continue
        sd = np.sqrt(np.array(e.covariance).reshape(3, 3).diagonal())
        worst = max(worst, float(np.abs((np.array((e.dx, e.dy, e.theta)) - truth[e.block]) / sd).max()))
    return worst, pipeline.estimator.most_likely_wrong()


FAULTS = tuple(
    [(kind, channel) for kind in ('dead', 'stuck', 'inverted') for channel in range(4)]
    + [('swapped', psd) for psd in range(2)]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Print :func:`fault` for every wrong reading at 10, 30 and 50 N."""
    parser = options(__doc__)
    parser.add_argument('--rows', type=int, help='only the first wrong readings')
    args = parser.parse_args(argv)
    print('| wrong | load | largest error, own sd | named |\n|---|---|---|---|')
    for kind, channel in FAULTS[: args.rows]:
        for force in (10.0, 30.0, 50.0):
            for name, load in (('sidebar', (0.0, -force, -0.585 * force)), ('link', (0.0, -force, 0.0))):
                worst, named = fault(kind, channel, load)
                print(
                    f'| {kind} {channel} | {force:g} N, {name} | {worst:.1f} | {named or "cannot be determined"} |',
                    flush=True,
                )
    return 0


if __name__ == '__main__':
    sys.exit(main())
