# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover_in beside two peers, on plants drawn by chance: ``python -m blind.draws --plants 30``."""

import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blind.campaign import bound_line, conclude, options, over
from blind.duels import forward_backward, linear, rms, stlsq
from psd_deflection.model.simulation.declaration import EffectParameter
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.studies.discover.plant_search import discover_in
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

UNSEEN = 1000  # Readings of each channel that no search has.
MEDIAN, MOST, FALSE = 1.02, 1.15, 0.01
"""Bounds of the unseen error against the better peer, and of the share of false names (p of a name)."""


class Drawn(Plant):
    """``terms`` (channels, n, p): what 1 of each term does. ``y`` (channels, n): measured, of noise 1."""

    cases = ('table',)

    def __init__(self, terms: FloatArray, y: FloatArray, states_noise: bool) -> None:
        self.terms, self.y = terms, y
        self.channels = tuple(f'y{i}' for i in range(len(y)))
        self.units = ('mm',) * len(y)
        self.noise = (1.0,) * len(y) if states_noise else ()
        size = EffectParameter('size', 'mm', -1e3, 1e3, 1.0, 'of the term')
        self.library = tuple(plant_effect(f't{j}', size) for j in range(terms.shape[2]))

    def measured(self) -> Sequence[FloatArray]:
        return [self.y]

    def simulate(self, model: Model) -> Sequence[FloatArray]:
        sizes = np.zeros(len(self.library))
        for name, values in model.items():
            sizes[int(name[1:])] = values['size']
        return [self.terms @ sizes]


class Outcome(NamedTuple):
    """``errors``: unseen rms of discover_in, forward-backward BIC, STLSQ. ``named``: terms, ``false``: those of them
    that are none."""

    seed: int
    terms: int
    true: int
    errors: tuple[float, float, float]
    named: int
    false: int

    @property
    def ratio(self) -> float:
        """Our error over that of the better peer."""
        return self.errors[0] / min(self.errors[1:])


def drawn(seed: int) -> tuple[Drawn, BoolArray, set[str]]:
    """5 to 40 terms of correlated inputs, 0 to 15 of them true, each of 1 to 10 standard deviations; the readings (n,)
    that a search has; the names of what is true."""
    rng = np.random.default_rng(seed)
    channels, p = int(rng.integers(1, 4)), int(rng.integers(5, 41))
    true = rng.choice(p, int(rng.integers(min(15, p) + 1)), replace=False)
    n = int(rng.integers(max(40, 2 * p), 200)) // channels + 1
    shared, factors = rng.uniform(0.0, 0.9), int(rng.integers(2, 7))
    inputs = rng.normal(size=(n + UNSEEN, factors)) @ rng.normal(size=(channels, factors, p)) / np.sqrt(factors)
    terms = shared * inputs + np.sqrt(1.0 - shared**2) * rng.normal(size=inputs.shape)
    # Some move one channel alone.
    alone = (rng.random(p) < 0.3) & (np.arange(channels)[:, None] != rng.integers(channels, size=p))
    terms *= ~alone[:, None, :]
    shown = np.arange(n + UNSEEN) < n
    table = terms[:, shown][:, :, true].reshape(channels * n, len(true))
    sizes = np.zeros(p)
    sizes[true] = np.sqrt(np.diag(np.linalg.pinv(table.T @ table))) * rng.uniform(1.0, 10.0, len(true))
    sizes[true] *= rng.choice([-1.0, 1.0], len(true))
    y = terms @ sizes + rng.normal(size=terms.shape[:2])
    return Drawn(terms, y, bool(rng.integers(2))), shown, {f't{j}' for j in true}


def duel(seed: int) -> Outcome:
    """One plant, by the three methods."""
    plant, shown, true = drawn(seed)
    result = discover_in(Drawn(plant.terms[:, shown], plant.y[:, shown], bool(plant.noise)))
    ours = plant.y - result.predict(plant)[0]
    y, observed = plant.y.ravel(), np.tile(shown, len(plant.y))
    peers = forward_backward(plant, linear(plant, y), observed), stlsq(plant, y, observed)
    named = {e.active.effect.name for e in result.effects}
    errors = rms(ours[:, ~shown]), rms(peers[0][~observed]), rms(peers[1][~observed])
    return Outcome(seed, len(plant.library), len(true), errors, len(named), len(named - true))


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table and what of the bounds is met; 1 if one is not."""
    parser = options(__doc__, jobs=1)
    parser.add_argument('--plants', type=int, default=30)
    parser.add_argument('--first', type=int, default=0, help='seed of the first; another gives unseen plants')
    args = parser.parse_args(argv)
    every = list(over(duel, range(args.first, args.first + args.plants), args.jobs, 'plants'))
    rows = [
        '| seed | terms, true | discover_in | forward-backward BIC | STLSQ | ratio | named, false |',
        '|---|' + '---|' * 6,
    ]
    for o in every:
        words = ' | '.join(f'{e:.3f}' for e in o.errors)
        rows.append(f'| {o.seed} | {o.terms}, {o.true} | {words} | {o.ratio:.3f} | {o.named}, {o.false} |')
    ratios, named, false = [o.ratio for o in every], sum(o.named for o in every), sum(o.false for o in every)
    bounds = (
        (
            float(np.median(ratios)) <= MEDIAN,
            f'unseen error over that of the better peer, median {np.median(ratios):.3f}',
        ),
        (max(ratios) <= MOST, f'largest {max(ratios):.3f}'),
        (false <= max(1.0, 2.0 * FALSE * named), f'{false} of {named} names false'),
    )
    met = all(m for m, _ in bounds)
    return conclude('\n'.join([*rows, '', *(bound_line(m, words) for m, words in bounds)]), met)


if __name__ == '__main__':
    sys.exit(main())
