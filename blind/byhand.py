# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of loads that a person hangs and notes: what hung there, what was noted, and which notes are wrong."""

import functools
import itertools
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from blind.generator import RATE, Array

KINDS = ('late', 'rounded', 'one', 'forgotten', 'mixed', 'twice', 'slow', 'unit', 'ms', 'cell', 'sway', 'near')
"""Each note another delay, late, or late and early; one load only; applied over up to a second; loads rounded to 5 N;
one never noted; one noted as two; torque in another unit; all a few ms late; a load cell's noise; a swaying weight;
each note some ms off, late or early."""
TORQUES = (9.80665, 0.0980665, 9.80665e-3, 1e-3, 1e-2)  # N m of each unit that a torque is noted in.
LEAST_S = 0.05  # A note that is less late than this is right.
BESIDE_UNKNOWN_LOADS = (
    *('sensor_rotation', 'sensor_gain', 'axis_crosstalk', 'spot_clipping', 'mains_interference', 'damping'),
    *('laser_pointing_drift', 'thermal_drift', 'ambient_light'),
)
"""Effects that a recording shows whatever hangs on the link."""
CELL = (0.05, 0.05, 0.01)  # N, N, N m rms of a load cell.


@dataclass(frozen=True, eq=False)
class Hand:
    """``effective``, ``annotated`` (n, 3) N, N, N m. ``wrong``: what is to be told, one by one: its name, what is
    right."""

    effective: Array
    annotated: Array
    temperature: Array
    wrong: tuple[dict[str, Any], ...]


def _levels(rng: np.random.Generator, odd: bool) -> Array:
    """Seven loads (7, 3) after none: weights on hooks and at the ends of a bar, in N and N m; the last is none."""
    out = np.zeros((8, 3))
    for row in out[1:7]:
        kind = int(rng.integers(0, 4))
        size = float(rng.integers(2, 11)) * 5.0 + (float(rng.uniform(-2.2, 2.2)) if odd else 0.0)
        size = round(size, 2)
        row[1] = -size if kind != 2 else 0.0
        row[0] = (0.0, 0.0, float(rng.choice((-1.0, 1.0))) * size, round(0.6 * size, 2))[kind]
        row[2] = round(0.585 * row[1], 3) if kind == 1 else float(rng.choice((0.0, 12.0))) if kind == 3 else 0.0
    for before, row in itertools.pairwise(out):
        if np.abs(row - before).max() < 8.0:
            # Each weight moves the link.
            row[1] -= 15.0
    # All three act once.
    out[4] = (20.0, -30.0, 17.55) if not odd else (21.3, -31.4, 17.9)
    out[7] = 0.0
    return out


def _held(levels: Array, times: Array, n: int) -> Array:
    at = np.arange(n) / RATE
    # Times are whole samples; half of one keeps rounding from choosing another.
    return np.asarray(levels[np.searchsorted(times - 0.5 / RATE, at, side='right')])


def _moved(kind: str, times: Array, ends: float, rng: np.random.Generator) -> Array:
    annotated, edges = times.copy(), np.concatenate(([0.5], times, [ends]))
    which = [int(rng.integers(0, len(times)))] if kind == 'one' else range(len(times))
    for i in which:
        early = kind != 'late' and rng.random() < 0.5
        room = edges[i + 1] - max(edges[i], annotated[i - 1] if i else 0.5) if early else edges[i + 2] - edges[i + 1]
        size = float(rng.uniform(0.3 if kind == 'one' else 0.0, 1.0)) * min(15.0, 0.85 * room)
        annotated[i] += -size if early else size
    for i in range(1, len(annotated)):
        annotated[i] = max(annotated[i], annotated[i - 1] + 0.4)
    return np.asarray(np.round(annotated, 3))


@functools.cache
def drawn(name: str) -> Hand:
    """Return the design of that name, always the same."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    kind = name.split('-')[1]
    levels = _levels(rng, odd=kind == 'rounded')
    spans = rng.uniform(3.0, 14.0, len(levels))
    times, n = np.round(np.cumsum(spans)[:-1], 3), round(spans.sum() * RATE)
    effective = _held(levels, times, n)
    annotated, wrong = effective.copy(), list[dict[str, Any]]()
    if kind in ('late', 'mixed', 'one'):
        message = _moved(kind, times, n / RATE, rng)
        annotated = _held(levels, message, n)
        wrong = [
            {'name': 'load_time', 'where': f'load {i + 1}', 'value': float(b - a)}
            for i, (a, b) in enumerate(zip(times, message, strict=True))
            if abs(b - a) > LEAST_S
        ]
    elif kind == 'slow':
        effective = np.zeros((n, 3))
        for i, at in enumerate(times.tolist()):
            took = float(rng.uniform(0.3, 1.3))
            share = np.clip((np.arange(n) / RATE - at) / took, 0.0, 1.0)
            effective += share[:, None] * (levels[i + 1] - levels[i])
            wrong.append({'name': 'load_ramp', 'where': f'load {i + 1}', 'value': took})
    elif kind == 'rounded':
        reported_levels = np.round(levels / np.array([5.0, 5.0, 2.0])) * np.array([5.0, 5.0, 2.0])
        annotated = _held(reported_levels, times, n)
        wrong = [
            {'name': 'load_value', 'where': f'load {i + 1}', 'load': levels[i + 1].tolist()}
            for i in range(len(times) - 1)
            if np.any(np.abs(levels[i + 1] - reported_levels[i + 1]) > (0.2, 0.2, 0.1))
        ]
    elif kind in ('forgotten', 'twice'):
        i, reported_levels = int(rng.integers(0, len(times) - 1)), levels.copy()
        # Never noted: the load before is held on. Noted twice: what was added is added once more.
        reported_levels[i + 1] = levels[i] if kind == 'forgotten' else 2.0 * levels[i + 1] - levels[i]
        annotated = _held(reported_levels, times, n)
        where = {'name': 'missing_load', 'from': float(times[i])}
        if kind == 'twice':
            where = {'name': 'load_value', 'where': f'load {i + 1}'}
        wrong = [{**where, 'load': levels[i + 1].tolist()}]
    elif kind == 'unit':
        factor = float(rng.choice(TORQUES))
        annotated[:, 2] /= factor
        wrong = [{'name': 'load_unit', 'where': 'tz', 'value': factor}]
    elif kind == 'ms':
        late = round(float(rng.uniform(2e-3, 8e-3)) * RATE) / RATE
        annotated = _held(levels, times + late, n)
        wrong = [{'name': 'load_delay', 'value': late}]
    elif kind == 'near':
        off = np.round(rng.choice((-1.0, 1.0), len(times)) * rng.uniform(4e-3, 28e-3, len(times)), 3)
        annotated = _held(levels, times + off, n)
        named = ((f'load {i}', late) for i, late in enumerate(off.tolist(), start=1))
        wrong = [{'name': 'load_time', 'where': where, 'value': late} for where, late in named]
    elif kind == 'cell':
        annotated = effective + rng.normal(size=effective.shape) * np.array(CELL)
    elif kind == 'sway':
        i = 1 + int(rng.integers(0, 5))
        at = np.arange(n) / RATE - times[i]
        swing = np.where((at > 0.0) & (at < spans[i + 1]), np.exp(-np.maximum(at, 0.0) / 8.0), 0.0)
        effective[:, 0] += swing * np.sin(2.0 * np.pi * float(rng.uniform(0.8, 1.6)) * at)
        wrong = [{'name': 'load_value', 'where': f'load {i + 1}'}]
    at = np.arange(n) / RATE
    temperature = 21.0 + 2.0 * np.sin(0.07 * at) + 0.5 * np.sin(0.31 * at)
    return Hand(effective, annotated, temperature, tuple(wrong))
