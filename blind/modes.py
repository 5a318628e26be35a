# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well ``identify`` tells the modes of a link: ``python -m blind.modes --rigs 200``."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.integrate import trapezoid

from blind.campaign import options, watched
from blind.generator import Array, coloured
from psd_deflection.studies.identify.modes import modes_of
from psd_deflection.studies.identify.spectra import Mode

RATE = 1000.0


@dataclass(frozen=True)
class Link:
    """``modes``: Hz, damping ratio and share of the step that the mode rings with. ``noise``: m; ``memory``: of one
    sample for the one before it."""

    modes: tuple[tuple[float, float, float], ...]
    noise: float = 2e-6
    memory: float = 0.0


def rung(link: Link, rng: np.random.Generator, seconds: float = 10.0, steps: int = 4, equal: bool = False) -> Array:
    """Samples (n,), m, of a link whose load changes ``steps`` times; ``equal``: one weight is hung on and off."""
    t = np.arange(int(seconds * RATE)) / RATE
    out = np.zeros(len(t))
    weight = float(rng.uniform(0.5e-3, 3e-3)) if equal else math.nan
    for i, start in enumerate(np.sort(rng.uniform(0.2, seconds - 2.0, steps))):
        size = float(rng.uniform(0.5e-3, 3e-3)) * float(rng.choice([-1.0, 1.0]))
        size = weight * (-1.0) ** i if equal else size
        since, moved = np.clip(t - start, 0.0, None), np.ones(len(t))
        for hertz, zeta, share in link.modes:
            w = 2.0 * np.pi * hertz
            w_damped = w * np.sqrt(1.0 - zeta**2)
            ring = np.cos(w_damped * since) + zeta * w / w_damped * np.sin(w_damped * since)
            moved -= share * np.exp(-zeta * w * since) * ring
        out += size * np.where(t > start, moved, 0.0)
    return out + link.noise * coloured(rng.normal(size=len(t)), link.memory)


def driven(link: Link, rng: np.random.Generator, seconds: float = 60.0, rms: float = 200e-6) -> Array:
    """Samples (n,), m, of a link that a random force drives; each step is exact for a force held over it."""
    hertz, zeta, _ = link.modes[0]
    w = 2.0 * np.pi * hertz
    w_damped, h = w * np.sqrt(1.0 - zeta**2), 1.0 / RATE
    decay, cos, sin = np.exp(-zeta * w * h), np.cos(w_damped * h), np.sin(w_damped * h)
    a, b = decay * (cos + zeta * w / w_damped * sin), decay * sin / w_damped
    c, d = -(w**2) * b, decay * (cos - zeta * w / w_damped * sin)
    q = v = 0.0
    out = np.empty(int(seconds * RATE))
    for i, force in enumerate(rng.normal(0.0, 1.0, len(out))):
        q, v = a * (q - force) + b * v + force, c * (q - force) + d * v
        out[i] = q
    # Forget the start from rest.
    out *= rms / out[len(out) // 4 :].std()
    return out + rng.normal(0.0, link.noise, len(out))


def bound(link: Link, seconds: float = 60.0, rms: float = 200e-6) -> tuple[float, float]:
    """Least standard deviations of the first mode's frequency and damping ratio that :func:`driven` allows, relative.
    Cramer and Rao, from the information in a spectrum (Whittle): I = T int (d log S) (d log S)^T df of frequency,
    damping ratio, size and noise, none of which is known."""
    hertz, zeta, _ = link.modes[0]
    # Even in the angle of a Lorentzian: half of the places lie within the resonance.
    f = hertz * np.maximum(1.0 + zeta * np.tan(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40_001)[1:-1]), 0.0)
    f = f[(f > 0.0) & (f < 0.5 * RATE)]
    x = (f / hertz) ** 2
    shape = 1.0 / ((1.0 - x) ** 2 + 4.0 * zeta**2 * x)
    # Of a mode that white noise drives: its variance is pi f / (4 zeta) times its spectrum at 0.
    mode = rms**2 * 4.0 * zeta / (np.pi * hertz) * shape
    noise = np.full(len(f), link.noise**2 / (0.5 * RATE))
    slopes = np.stack(
        (mode * shape * (4.0 * x * (x - 1.0) + 8.0 * zeta**2 * x), -8.0 * zeta**2 * x * shape * mode, mode, noise)
    ) / (mode + noise)
    information = seconds * trapezoid(slopes[:, None] * slopes, f, axis=-1)
    least = np.sqrt(np.linalg.inv(information).diagonal())
    return float(least[0]), float(least[1])


@dataclass
class Score:
    """Relative errors of frequency and damping, and how many 95 % intervals hold the truth."""

    frequency: list[float] = field(default_factory=list)
    damping: list[float] = field(default_factory=list)
    inside: list[tuple[bool, bool]] = field(default_factory=list)
    missed: int = 0

    def add(self, modes: tuple[Mode, ...], hertz: float, zeta: float) -> None:
        if not modes or abs(modes[0].frequency / hertz - 1.0) > 0.2:
            self.missed += 1
            return
        best = modes[0]
        self.frequency.append(best.frequency / hertz - 1.0)
        self.damping.append(best.damping / zeta - 1.0)
        close = abs(best.frequency - hertz) <= 1.96 * best.frequency_sd
        self.inside.append((close, abs(best.damping - zeta) <= 1.96 * best.damping_sd))


class Case(NamedTuple):
    """``operation``: driven all the time. ``equal``: see :func:`rung`. ``memory``: of the noise, which is then 20 µm.
    ``beside``: the second of two modes is so many times as high, each with half of the step."""

    operation: bool = False
    equal: bool = False
    memory: float = 0.0
    beside: float = 0.0


CASES = {
    'ring-down': Case(),
    'equal releases': Case(equal=True),
    'noise of memory 0.9': Case(memory=0.9),
    'two modes, 5 % apart': Case(equal=True, beside=1.05),
    'two modes, 2 % apart': Case(equal=True, beside=1.02),
    'operation': Case(operation=True),
}


def scored(seeds: Iterable[int], case: Case) -> Score:
    score = Score()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        hertz, zeta = float(rng.uniform(5.0, 40.0)), float(np.exp(rng.uniform(np.log(0.003), np.log(0.06))))
        link = Link(((hertz, zeta, 1.0),), *((20e-6, case.memory) if case.memory else ()))
        if case.beside:
            link = Link(((hertz, zeta, 0.5), (case.beside * hertz, zeta, 0.5)))
        samples = driven(link, rng) if case.operation else rung(link, rng, equal=case.equal)
        modes = modes_of(samples, RATE).modes
        # Of two modes the one that is nearest.
        score.add(tuple(sorted(modes, key=lambda m: abs(m.frequency - hertz)) if case.beside else modes), hertz, zeta)
    return score


def report(name: str, score: Score) -> str:
    f, z = np.abs(score.frequency), np.abs(score.damping)
    held = [f'{100.0 * share:.1f} % inside' for share in np.mean(score.inside, axis=0)]
    frequency = f'{100 * np.median(f):.4f} % median, {100 * f.max():.4f} % at most, {held[0]}'
    damping = f'{100 * np.median(z):.2f} %, {100 * z.max():.2f} %, {held[1]}'
    return f'{name:30} frequency {frequency}; damping {damping}; missed {score.missed}'


def main() -> None:
    parser = options(__doc__)
    parser.add_argument('--rigs', type=int, default=200, metavar='N')
    parser.add_argument('--first', type=int, default=1000, metavar='SEED')
    args = parser.parse_args()
    for name, case in CASES.items():
        seeds = range(args.first, args.first + args.rigs)
        print(report(name, scored(watched(seeds), case)), flush=True)


if __name__ == '__main__':
    main()
