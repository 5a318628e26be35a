# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes that people make with a rig, put into a recording of the second generator; and faultless oddities."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from blind.generator import Array, Generator
from psd_deflection.recordings.observation import Observation
from psd_deflection.rig.config import Rig, replace_values

LENGTH = 0.585  # m, of the rig file.
AXES = {1: [1, 0, 2, 3, 4, 5], 2: [0, 1, 2, 4, 3, 5]}
Make = Callable[[float, Observation, np.random.Generator], list[Observation]]


def _of(o: Observation, **changes: Any) -> list[Observation]:
    return [dataclasses.replace(o, **changes)]


def _signs(count: int, size: float) -> Array:
    """(count,) of 1, with -1 at the place ``size``."""
    return np.where(np.arange(count) == int(size), -1.0, 1.0)


def _delayed(size: float, o: Observation) -> Array:
    return np.asarray(o.loads[np.clip(np.arange(len(o.loads)) - round(size / o.period), 0, len(o.loads) - 1)])


def _rig(name: str) -> Make:
    """The recording is right, the rig file is not: what it says times the size would be."""

    def make(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
        true = o.rig.values[name]
        if not isinstance(true, float):
            raise TypeError(f'{name} = {true!r}: must be a number')
        return _of(o, rig=replace_values(o.rig, {name: true / size}))

    return make


def _zero(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    signs, shift = rng.choice((-1.0, 1.0), 4), np.zeros(6)
    shift[[0, 1, 3, 4]] = size / o.rig.amplifier.sensitivity * signs * rng.uniform(0.5, 1.0, 4)
    half = len(o.volts) // 2
    first = dataclasses.replace(o, name='first', volts=o.volts[:half], loads=o.loads[:half])
    rest = dataclasses.replace(o, name='second', volts=o.volts[half:] + shift, loads=o.loads[half:])
    parts = [first, rest]
    if o.temperature is None:
        return parts
    return [dataclasses.replace(part, temperature=np.full(len(part.volts), 21.0)) for part in parts]


def _coverage(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    loads, first = o.loads.copy(), round(size * len(o.loads))
    loads[:first] = 0.0
    return _of(o, loads=loads, unknown_load=(first, 0))


def _stuck(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    volts, channel = o.volts.copy(), int(rng.choice((0, 1, 3, 4)))
    start = int(rng.uniform(0.1, 0.6) * len(volts))
    volts[start : start + round(size / o.period), channel] = volts[start, channel]
    return _of(o, volts=volts)


def _jump(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    volts, psd, angle = o.volts.copy(), int(rng.integers(0, 2)), rng.uniform(0.0, 2.0 * np.pi)
    start = int(rng.uniform(0.2, 0.8) * len(volts))
    along = np.array([np.cos(angle), np.sin(angle)]) * size / o.rig.amplifier.sensitivity
    volts[start:, 3 * psd : 3 * psd + 2] += along
    return _of(o, volts=volts)


def _outliers(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    bad = rng.random(o.volts.shape) < size
    return _of(o, volts=np.where(bad, rng.uniform(-10.0, 10.0, bad.shape), o.volts))


def _under_load(size: float, o: Observation, rng: np.random.Generator) -> list[Observation]:
    first = int(rng.uniform(0.05, 0.2) * len(o.volts))
    warm = None if o.temperature is None else np.full(len(o.volts) - first, 21.0)
    return _of(o, volts=o.volts[first:], loads=o.loads[first:], temperature=warm)


MAKE: Mapping[str, Make] = {
    'channel_sign': lambda size, o, rng: _of(o, volts=o.volts * _signs(6, size)),
    'axis_swap': lambda size, o, rng: _of(o, volts=o.volts[:, AXES[int(size)]]),
    'psd_swap': lambda size, o, rng: _of(o, volts=o.volts[:, [3, 4, 5, 0, 1, 2]]),
    'load_sign': lambda size, o, rng: _of(o, loads=o.loads * _signs(3, size)),
    'load_unit': lambda size, o, rng: _of(o, loads=o.loads / np.array([size, size, 1.0])),
    'load_delay': lambda size, o, rng: _of(o, loads=_delayed(size, o)),
    'sensitivity': _rig('amplifier.sensitivity'),
    'link_length': _rig('link.length'),
    'sample_rate': _rig('converter.sample_rate_hz'),
    'zero': _zero,
    'noise_level': _rig('amplifier.noise'),
    'load_coverage': _coverage,
    'stuck_channel': _stuck,
    'jump': _jump,
    'gaps': lambda size, o, rng: _of(o, volts=np.where(rng.random((len(o.volts), 1)) < size, np.nan, o.volts)),
    'outliers': _outliers,
    'under_load': _under_load,
}


def own_zeros(size: float, g: Generator, rig: Rig, noise: str, seed: int) -> list[Observation]:
    """Three recordings with beams that are moved in between by up to ``size``, m, as the zero of each says."""
    rng, out = np.random.default_rng(seed), []
    for i in range(3):
        truth: list[dict[str, Any]] = []
        zeros: dict[str, object] = {}
        for psd in (1, 2):
            x, y = rng.uniform(-size, size, 2).tolist()
            # The detector with its beam, and then the detector back.
            truth.append({'name': 'sensor_position', 'psd': psd, 'x': x, 'y': y, 'aimed': 1.0})
            truth.append({'name': 'sensor_position', 'psd': psd, 'x': -x, 'y': -y, 'aimed': 0.0})
            before = rig.zeros[psd - 1]
            zeros[f'psd_{psd}.zero'] = [float(before[0]) + x, float(before[1]) + y]
        volts = g.record(truth, noise, 10 * seed + i)
        out.append(Observation(f'recording {i + 1}', replace_values(rig, zeros), volts, g.loads, g.temperature))
    return out


def observed(mistake: tuple[str, float], g: Generator, rig: Rig, noise: str, seed: int) -> list[Observation]:
    """Return a recording without any hidden effect, with one mistake."""
    name, size = mistake
    if name == 'own_zeros':
        return own_zeros(size, g, rig, noise, seed)
    o = Observation('recording 1', rig, g.record([], noise, seed), g.loads, g.temperature)
    return MAKE[name](size, o, np.random.default_rng(seed))
