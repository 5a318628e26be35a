# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The cases of the suite: hidden effects, drawn from the case's own seed and scaled to a stated gap."""

import functools
import math
import tomllib
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blind import byhand, generator
from blind.generator import Array, Generator

BLOCK = 20
FLOOR = generator.SIGMA * generator.MM_PER_V / math.sqrt(BLOCK)
SIZES = (1.0, 3.0, 10.0)
NOISES = ('heavy', 'coloured', 'loud', 'flicker')  # Other noise than the rig file's.
SHOWS_ACROSS_LENGTHS = {
    *('bending_stiffness', 'torsional_stiffness', 'clamp_bending_compliance', 'clamp_torsional_compliance'),
    *('self_weight', 'mount_tilt', 'tip_force'),
}
"""Effects that one link length cannot distinguish; half of their cases have two lengths."""
SUITE: Mapping[str, Any] = tomllib.loads(Path(__file__).with_name('suite.toml').read_text(encoding='utf-8'))
MIMICKED: Mapping[str, str] = SUITE['mimicked']


def histories() -> tuple[Array, Array]:
    """Loads (n, 3) and temperature (n,) of the suite's own experiment: 24 s."""
    levels = [
        *((0, 0, 0), (0, -30, -17.55), (0, -50, -29.25), (0, -10, -5.85), (0, 0, 0), (0, -50, 0)),
        *((30, 0, 0), (-20, -20, 15), (0, 20, 25), (0, 0, 0)),
    ]
    held = np.repeat(np.array(levels, dtype=np.float64), 2000, axis=0)
    t = np.arange(4000) / 1000.0
    sweep = np.sin(2 * np.pi * (2.0 * t + 3.5 * t * t))[:, None] * np.array([4.0, 4.0, 3.0])
    loads = np.concatenate((held, sweep))
    at = np.arange(len(loads)) / 1000.0
    return loads, 21.0 + 3.0 * np.sin(0.21 * at) + 0.8 * np.sin(0.9 * at)


@functools.cache
def designs(name: str) -> tuple[Generator, ...]:
    """``one``: a link of 0.585 m; ``two``: that and one of 0.400 m; ``hand-...``: loads hung by hand."""
    if name.startswith('hand-'):
        hand = byhand.drawn(name)
        return (Generator(hand.effective, hand.temperature, 0.585),)
    loads, temperature = histories()
    lengths = (0.585,) if name == 'one' else (0.585, 0.400)
    return tuple(Generator(loads, temperature, length) for length in lengths)


Draw = Callable[[np.random.Generator, float], dict[str, Any]]


def _signed(rng: np.random.Generator) -> tuple[float, float]:
    angle = float(rng.uniform(0, 2 * math.pi))
    return math.cos(angle), math.sin(angle)


def _draw_of(*names: str, scale: float, signed: bool = True, psd: bool = False, **more: Any) -> Draw:
    """Of one value, with a sign by chance, or of two, with an angle by chance."""

    def draw(rng: np.random.Generator, size: float) -> dict[str, Any]:
        signs = _signed(rng) if len(names) == 2 else [float(rng.choice((-1.0, 1.0))) if signed else 1.0]
        out: dict[str, Any] = {name: scale * size * sign for name, sign in zip(names, signs, strict=True)}
        out.update({k: int(rng.choice(v)) for k, v in more.items()})
        return {'psd': int(rng.integers(1, 3)), **out} if psd else out

    return draw


def _xy(scale: float, names: tuple[str, str] = ('x', 'y'), **more: Any) -> Draw:
    return _draw_of(*names, scale=scale, **more)


def _creep(rng: np.random.Generator, size: float) -> dict[str, Any]:
    return {'time_constant': float(np.exp(rng.uniform(math.log(0.5), math.log(12.0)))), 'amplitude': 1e-3 * size}


def _damping(rng: np.random.Generator, size: float) -> dict[str, Any]:
    a, b = _signed(rng)
    return {'bending_ratio': max(0.0, 0.02 + 2e-4 * size * a), 'torsion_ratio': max(0.0, 0.02 + 2e-4 * size * b)}


def _second(rng: np.random.Generator, size: float) -> dict[str, Any]:
    frequency, ratio = float(rng.uniform(60.0, 110.0)), float(rng.uniform(0.01, 0.03))
    return {'frequency': frequency, 'damping_ratio': ratio, 'shares': int(rng.integers(0, 3)), 'gain': 1e-3 * size}


def _ambient(rng: np.random.Generator, size: float) -> dict[str, Any]:
    psd, (x, y) = int(rng.integers(1, 3)), rng.uniform(-3e-3, 3e-3, 2).tolist()
    return {'psd': psd, 'x': x, 'y': y, 'level': 1e-3 * size}


def _mains(rng: np.random.Generator, size: float) -> dict[str, Any]:
    amplitude = rng.uniform(0.3, 1.0, 6) * np.array([1, 1, 0.5, 1, 1, 0.5])
    return {
        'frequency': float(rng.choice((50.0, 60.0)) + rng.uniform(-0.1, 0.1)),
        'amplitude': (2e-3 * size * amplitude).tolist(),
        'phase': rng.uniform(-3.0, 3.0, 6).tolist(),
    }


def _saturation(rng: np.random.Generator, size: float) -> dict[str, Any]:
    # What the size means is found by bisection: a small one clips only the highest peaks.
    return {'limit': 10.0 * math.exp(-0.02 * size), 'sums': int(rng.integers(0, 2))}


DRAWS: Mapping[str, Draw] = {
    'bending_stiffness': _draw_of('scale', scale=1e-3, moves_frequency=(0, 1)),
    'torsional_stiffness': _draw_of('scale', scale=1e-3, moves_frequency=(0, 1)),
    'clamp_bending_compliance': _draw_of('compliance', scale=1e-7, signed=False),
    'clamp_torsional_compliance': _draw_of('compliance', scale=1e-6, signed=False),
    'clamp_friction': _draw_of('width', scale=1e-6, signed=False, axis=(1, 2, 3)),
    'creep': _creep,
    'damping': _damping,
    'tip_mass': _draw_of('mass', scale=1e-3, signed=False),
    'second_bending_mode': _second,
    'self_weight': _draw_of('weight_per_length', scale=0.1, signed=False),
    'mount_tilt': _xy(1e-6),
    'load_offset': _xy(1e-4),
    'load_direction': _draw_of('angle', scale=1e-3),
    'plane_tilt': _draw_of('slope_ratio', scale=1.0, signed=False),
    'laser_pointing_drift': _xy(1e-7, ('rate_x', 'rate_y'), psd=True),
    'refraction': _xy(1e-7),
    'sensor_rotation': _draw_of('angle', scale=1e-3, psd=True),
    'sensor_position': _xy(1e-4, psd=True, aimed=(0, 1)),
    'sensor_gain': _xy(1e-3, psd=True),
    'sensor_nonlinearity': _draw_of('k', scale=100.0, psd=True),
    'axis_crosstalk': _xy(1e-3, ('xy', 'yx'), psd=True),
    'ambient_light': _ambient,
    'thermal_drift': _xy(1e-7, psd=True),
    'spot_clipping': _draw_of('radius', scale=1e-3, signed=False, psd=True, profile=(1, 2)),
    'mains_interference': _mains,
    'amplifier_saturation': _saturation,
    'amplifier_lag': _draw_of('time_constant', scale=1e-4, signed=False),
    'channel_skew': _draw_of('delay', scale=1e-4, signed=False, psd=True),
    'quantisation': _draw_of('step', scale=1e-3, signed=False),
    'tip_force': _xy(1e-2),
    'alien_cubic_spring': _draw_of('size', scale=1e-4),
    'alien_quadratic_load': _draw_of('size', scale=1e-9),
    'alien_soft_mode': _draw_of('size', scale=1e-4),
    'alien_square_crosstalk': _draw_of('size', scale=1.0),
    'alien_thermal_square': _draw_of('size', scale=1e-7),
    'alien_gain_drift': _draw_of('size', scale=1e-4),
    'alien_thermal_gain': _draw_of('size', scale=1e-4),
    'alien_rectifier': _draw_of('size', scale=1e-3),
    'alien_walk': _draw_of('size', scale=1e-8, seed=tuple(range(100))),
    'alien_backlash': _draw_of('size', scale=1e-6, signed=False),
    'alien_beat': _draw_of('size', scale=1e-6),
}
EFFECTS = tuple(n for n in DRAWS if not n.startswith('alien_'))
ALIENS = tuple(n for n in DRAWS if n.startswith('alien_'))


@dataclass(frozen=True)
class Case:
    """One run. ``wanted``: (effect, gap in floors), not yet scaled. ``without``: effects left out of the library.
    ``mistake``: of the set-up, with its size."""

    key: str
    kind: str
    design: str
    wanted: tuple[tuple[str, float], ...]
    noise: str = 'white'
    without: tuple[str, ...] = field(default=())
    mistake: tuple[str, float] = ('', 0.0)

    @property
    def seed(self) -> int:
        """Seed of its noise and draws, from its name, so that adding cases changes no other case."""
        return zlib.crc32(self.key.encode())


def _blocks(volts: Array) -> Array:
    n = len(volts) // BLOCK * BLOCK
    rows = volts[:n, [0, 1, 3, 4]].reshape(-1, BLOCK, 4)
    return np.asarray(rows.mean(axis=1) * generator.MM_PER_V)


def gap_of(design: tuple[Generator, ...], effect: Mapping[str, Any]) -> float:
    """Gap in floors that this effect alone makes, without noise."""
    total, count = 0.0, 0
    for g in design:
        v, nominal = g.clean([effect]), g.clean([])
        if effect['name'] in ('amplifier_saturation', 'quantisation'):
            # These act on the noisy signal; with the same noise on both, the difference is the effect.
            hiss = generator.noise(len(v), 'white', 12345)
            v, nominal = generator.output(v + hiss, [effect]), generator.output(nominal + hiss, [])
        if effect['name'] == 'mains_interference':
            d = (v - nominal)[:, [0, 1, 3, 4]] * generator.MM_PER_V / math.sqrt(BLOCK)
        else:
            d = _blocks(v) - _blocks(nominal)
        total, count = total + float(np.sum(d**2)), count + d.size
    return math.sqrt(total / count) / FLOOR


def scaled(case_seed: int, name: str, gap: float, design: tuple[Generator, ...]) -> dict[str, Any]:
    """Return the effect with its size such that its gap is ``gap`` floors, within 3 %; secant in logarithms."""

    def at(size: float) -> dict[str, Any]:
        rng = np.random.default_rng((case_seed, zlib.crc32(name.encode())))
        return {'name': name, **DRAWS[name](rng, size)}

    size, low, high = 1.0, 0.0, math.inf
    best: tuple[float, dict[str, Any]] = (math.inf, at(1.0))
    for _ in range(40):
        effect = at(size)
        got = gap_of(design, effect)
        error = abs(math.log(max(got, 1e-9) / gap))
        if error < best[0]:
            best = (error, effect)
        if error < 0.03:
            break
        if got < gap:
            low = size
        else:
            high = size
        # Proportional first; once bracketed and outside, bisection.
        step = size * min(max(gap / max(got, 1e-9), 0.05), 20.0)
        if not low < step < high:
            step = math.sqrt(low * high) if low > 0.0 and high < math.inf else (2.0 * size if got < gap else 0.5 * size)
        size = step
    return best[1]


def possible(effect: Mapping[str, Any]) -> bool:
    """Whether a machine can have it: no second mode swings farther than the link bends, as some must to be seen if the
    loads were applied slowly."""
    return effect['name'] != 'second_bending_mode' or float(abs(effect['gain'])) <= 1.0


def all_cases(seeds: int, nulls: int, wrong: int, pairs: int, first: int, **hard: int) -> Iterator[Case]:
    """The whole suite from seed ``first`` on; ``hard``: spreads, mistakes, fours, sixes and hand."""
    for seed in range(first, first + seeds):
        for name in EFFECTS:
            two = name in SHOWS_ACROSS_LENGTHS and seed % 2 == 1
            for gap in SIZES:
                yield Case(f'single-{name}-{gap:g}-{seed}', 'single', 'two' if two else 'one', ((name, gap),))
    rng = np.random.default_rng(20240501 + first)
    for i in range(first, first + pairs):
        a, b = (str(n) for n in rng.choice(EFFECTS, 2, replace=False))
        gaps = tuple(float(g) for g in np.exp(rng.uniform(math.log(3.0), math.log(10.0), 2)))
        two = bool({a, b} & SHOWS_ACROSS_LENGTHS)
        yield Case(f'pair-{i}-{a}-{b}', 'pair', 'two' if two else 'one', ((a, gaps[0]), (b, gaps[1])))
    for name in EFFECTS:
        if name not in MIMICKED:
            for gap in (3.0, 10.0):
                yield Case(f'leftout-{name}-{gap:g}-{first}', 'leftout', 'one', ((name, gap),), without=(name,))
    for name in ALIENS:
        for gap in (3.0, 10.0):
            for seed in range(first, first + 2):
                yield Case(f'alien-{name}-{gap:g}-{seed}', 'alien', 'one', ((name, gap),))
    for i in range(first, first + wrong):
        yield Case(f'wrong-{i}', 'wrong', 'one', (), noise=NOISES[i % len(NOISES)])
    for i in range(first, first + nulls):
        yield Case(f'null-{i}', 'null', 'one', ())
    yield from hard_cases(first, hard['spreads'], hard['mistakes'])
    yield from cases_of_many(first, hard['fours'], 4, 20261123)
    yield from cases_of_many(first, hard['sixes'], 6, 20261127)
    yield from cases_by_hand(first, hard['hand'])


def cases_of_many(first: int, count: int, effects: int, seed: int) -> Iterator[Case]:
    """So many ``effects`` at once, each with a gap of 3 to 30 floors; the draws are those of ``seed``."""
    rng = np.random.default_rng(seed + first)
    kind = {4: 'four', 6: 'six'}[effects]
    for i in range(first, first + count):
        names = [str(n) for n in rng.choice([n for n in EFFECTS if n not in UNSPREAD], effects, replace=False)]
        gaps = np.exp(rng.uniform(math.log(3.0), math.log(30.0), effects)).tolist()
        two, wanted = bool(set(names) & SHOWS_ACROSS_LENGTHS), tuple(zip(names, gaps, strict=True))
        yield Case(f'{kind}-{i}-{"-".join(names)}', kind, 'two' if two else 'one', wanted)


def cases_by_hand(first: int, hand: int) -> Iterator[Case]:
    """Loads hung and noted by hand, in turns of all kinds; half with a hidden effect of 3 to 30 floors."""
    rng = np.random.default_rng(20261125 + first)
    shown = [n for n in EFFECTS if n not in UNSPREAD]
    for i in range(first, first + hand):
        kind = byhand.KINDS[i % len(byhand.KINDS)]
        name, gap = str(rng.choice(shown)), float(np.exp(rng.uniform(math.log(3.0), math.log(30.0))))
        if kind == 'rounded':
            # What moves the plate at rest is a load that nobody knows.
            name = str(rng.choice(byhand.BESIDE_UNKNOWN_LOADS))
        # Each kind is with and without one in turn.
        wanted = ((name, gap),) if (i + i // len(byhand.KINDS)) % 2 else ()
        what = f'-{name}' if wanted else ''
        yield Case(f'hand-{kind}-{i}{what}', 'hand', f'hand-{kind}-{i}', wanted, mistake=('hand', 0.0))


MISTAKES: Mapping[str, Sequence[float]] = SUITE['mistakes']
FAULTLESS = (('gaps', 0.3), ('outliers', 0.01), ('under_load', 0.0), ('own_zeros', 3e-4))
"""Recordings that look odd and are right: share of the samples, share, nothing, m."""
SPREADS = ((3.0, 30.0), (3.0, 300.0), (3.0, 30.0, 300.0))
"""Gaps of effects that act together, in floors: the small ones must not vanish behind the large ones."""


def hard_cases(first: int, spreads: int, mistakes: int) -> Iterator[Case]:
    """Effects of very different size together; mistakes of the set-up; gaps and outliers in faultless recordings."""
    rng = np.random.default_rng(20261122 + first)
    for i in range(first, first + spreads):
        gaps = SPREADS[i % len(SPREADS)]
        names = [str(n) for n in rng.choice([n for n in EFFECTS if n not in UNSPREAD], len(gaps), replace=False)]
        two, wanted = bool(set(names) & SHOWS_ACROSS_LENGTHS), tuple(zip(names, gaps, strict=True))
        yield Case(f'spread-{i}-{"-".join(names)}', 'spread', 'two' if two else 'one', wanted)
    for name, sizes in MISTAKES.items():
        for k in range(min(mistakes, len(sizes))):
            yield Case(f'mistake-{name}-{k}-{first}', 'mistake', 'one', (), mistake=(name, float(sizes[k])))
    for i in range(first, first + 4 * mistakes):
        kind = FAULTLESS[i % 4]
        yield Case(f'faultless-{kind[0]}-{i}', 'faultless', 'one', (), mistake=kind)


UNSPREAD = frozenset(('amplifier_saturation', 'quantisation', 'plane_tilt', 'sensor_nonlinearity'))
"""Effects that cannot be 300 floors large within their bounds, or that spoil what is small."""


def short_cases() -> list[Case]:
    """Return a small selection to run on every change: a few of each kind."""
    gaps = {'sensor_rotation': 3.0, 'plane_tilt': 3.0, 'creep': 3.0, 'amplifier_lag': 10.0, 'quantisation': 3.0}
    listed = (*gaps.items(), ('spot_clipping', 10.0))
    out = [Case(f'single-{name}-{gap:g}-s', 'single', 'one', ((name, gap),)) for name, gap in listed]
    out.append(Case('pair-s', 'pair', 'one', (('sensor_gain', 5.0), ('load_direction', 5.0))))
    out.append(Case('alien-s', 'alien', 'one', (('alien_square_crosstalk', 10.0),)))
    out.append(Case('spread-s', 'spread', 'one', (('sensor_rotation', 3.0), ('load_direction', 300.0))))
    out.append(Case('mistake-s', 'mistake', 'one', (), mistake=('link_length', 1.02)))
    out += [Case(f'null-s{i}', 'null', 'one', ()) for i in range(3)]
    out += [Case(f'wrong-s{i}', 'wrong', 'one', (), noise=k) for i, k in enumerate(NOISES)]
    return out
