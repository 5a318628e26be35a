# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rigs that are not as their rig file says: every tolerance of docs/calibration.md drawn at once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from blind import generator
from blind.generator import Array

LENGTH = 0.585
SPREADS: Mapping[str, float] = {
    'rotation': 0.010,
    'gain_x': 0.01,
    'gain_y': 0.01,
    'crosstalk_xy': 0.005,
    'crosstalk_yx': 0.005,
    'center_x': 0.3e-3,
    'center_y': 0.3e-3,
    'height': 2e-3,
    'nonlinearity': 300.0,
}
BEAM_PLACE, BEAM_ANGLE, SLOPE = 0.5e-3, 3e-3, (1.5, 0.2)
CAMERA = (10e-6, 10e-6, math.radians(0.03))  # Standard deviations of one frame of the reference: m, m, rad.
LASER = 5.0  # V of the sum.
OFFSETS = ('offset_x', 'offset_y', 'offset_sum')


def nominal() -> dict[str, float]:
    """What the rig file of the thesis says, by the names of calibration.json."""
    out = {f'psd_{n}.{name}': 0.0 for n in (1, 2) for name in SPREADS}
    for n, (x, y) in enumerate(generator.PLACES, start=1):
        out[f'psd_{n}.center_x'], out[f'psd_{n}.center_y'] = x, y
    out.update({f'beam_{n}.angle_{axis}': 0.0 for n in (1, 2) for axis in 'xy'})
    out.update({f'beam_{n}.{axis}': 0.0 for n in (1, 2) for axis in 'xy'})
    out['link.slope_ratio'] = SLOPE[0]
    return out


def draw(rng: np.random.Generator) -> dict[str, float]:
    """Return one rig. ``beam_N.x``, ``.y``: where the beam meets the unloaded plate, from the nominal centre, m."""
    out = nominal()
    for name in out:
        out[name] += float(rng.normal(0.0, tolerance(name)))
    return out


def tolerance(name: str) -> float:
    kind = name.partition('.')[2]
    if name == 'link.slope_ratio':
        return SLOPE[1]
    if name.startswith('beam'):
        return BEAM_ANGLE if kind.startswith('angle') else BEAM_PLACE
    return SPREADS[kind]


def dots(rig: Mapping[str, float], pose: Array) -> Array:
    """Readings (n, 4), m, of true poses (n, 3)."""
    n = len(pose)
    k = rig['link.slope_ratio'] / LENGTH
    theta, phi, omega = pose[:, 2], -k * pose[:, 1], k * pose[:, 0]
    zero, ones = np.zeros(n), np.ones(n)

    def matrix(rows: Sequence[Sequence[Array]]) -> Array:
        return np.stack([np.stack(row, axis=1) for row in rows], axis=1)

    about_z = matrix([(np.cos(theta), -np.sin(theta), zero), (np.sin(theta), np.cos(theta), zero), (zero, zero, ones)])
    about_x = matrix([(ones, zero, zero), (zero, np.cos(phi), -np.sin(phi)), (zero, np.sin(phi), np.cos(phi))])
    about_y = matrix([(np.cos(omega), zero, np.sin(omega)), (zero, ones, zero), (-np.sin(omega), zero, np.cos(omega))])
    rotation = about_y @ about_x @ about_z
    tip = np.column_stack((pose[:, :2], np.full(n, LENGTH)))
    out = np.empty((n, 4))
    for i, (fx, fy) in enumerate(generator.PLACES):
        mine = f'psd_{i + 1}.', f'beam_{i + 1}.'
        channel = {name.partition('.')[2]: v for name, v in rig.items() if name.startswith(mine)}
        along = np.array([math.tan(channel['angle_x']), math.tan(channel['angle_y']), 1.0])
        start = np.array([fx + channel['x'], fy + channel['y'], LENGTH + channel['height']])
        origin = tip + rotation @ np.array([channel['center_x'], channel['center_y'], channel['height']])
        # origin + a ex + b ey = start + s along
        system = np.stack((rotation[:, :, 0], rotation[:, :, 1], np.tile(-along, (n, 1))), axis=2)
        a = np.linalg.solve(system, (start - origin)[:, :, None])[:, :, 0]
        z = (a[:, 0] + 1j * a[:, 1]) * np.exp(-1j * channel['rotation'])
        z = z * (1.0 + channel['nonlinearity'] * np.abs(z) ** 2)
        out[:, 2 * i] = (1.0 + channel['gain_x']) * (z.real + channel['crosstalk_xy'] * z.imag)
        out[:, 2 * i + 1] = (1.0 + channel['gain_y']) * (z.imag + channel['crosstalk_yx'] * z.real)
    return out


def pushes(rng: np.random.Generator, holds: int, seconds: float, force: float = 50.0) -> Array:
    """Loads (n, 3): one is held after another, forces in the plane and torques, both at random; at rest first."""
    each = round(seconds * generator.RATE)
    size = rng.uniform(-1.0, 1.0, (holds, 3)) * (force, force, LENGTH * force)
    size[0] = 0.0
    return np.asarray(np.repeat(size, each, axis=0))


def poses(loads: Array) -> Array:
    """True poses (n, 3) at the samples."""
    return generator.motion(loads, LENGTH, [])[:: generator.FINER]


class Light(NamedTuple):
    """Other light on one PSD. ``level``: its part of the sum, V; ``x``, ``y``: its place as the PSD reads it, V.
    ``offset_x``, ``offset_y``: of the outputs of the amplifier, V, whatever light there is; ``offset_sum`` likewise."""

    level: float
    x: float
    y: float
    offset_x: float
    offset_y: float
    offset_sum: float

    def measured(self, laser: float, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """x, y and sum, V, with a laser of so much light that alone would read ``x``, ``y`` V."""
        total = laser + self.level
        share = self.level / total
        moved = x + share * (self.x - x) + self.offset_x, y + share * (self.y - y) + self.offset_y
        return *moved, np.full(len(x), total + self.offset_sum)


DARK = Light(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def draw_light(rng: np.random.Generator) -> tuple[Light, Light]:
    """On both PSDs: 1 to 4 % of the light, anywhere within 2 mm; offsets of 10 mV, of the sum 5 mV (1 sd)."""

    def random_light() -> Light:
        level, place = float(rng.uniform(0.05, 0.2)), rng.uniform(-4.0, 4.0, 2).tolist()
        return Light(level, *place, *rng.normal(0.0, (0.010, 0.010, 0.005)).tolist())

    return random_light(), random_light()


def relit(light: tuple[Light, Light], rng: np.random.Generator) -> tuple[Light, Light]:
    first, second = (
        new._replace(**{n: getattr(old, n) for n in OFFSETS}) for new, old in zip(draw_light(rng), light, strict=True)
    )
    return first, second


def darkness(light: tuple[Light, Light], seconds: float, rng: np.random.Generator) -> Array:
    """Volts (n, 6) with both lasers off: white noise, slower noise (20 ms) as large, the mains' flicker on the sums."""
    n = round(seconds * generator.RATE)
    flat = np.zeros(n)
    volts = np.column_stack([column for side in light for column in side.measured(0.0, flat, flat)])
    keep = math.exp(-1.0 / (0.020 * generator.RATE))
    kicks = rng.normal(0.0, generator.SIGMA * math.sqrt(1.0 - keep**2), (n, 6))
    volts += lfilter([1.0], [1.0, -keep], kicks, axis=0) + rng.normal(0.0, generator.SIGMA, (n, 6))
    flicker = np.sin(2.0 * math.pi * 100.0 * np.arange(n) / generator.RATE + rng.uniform(0.0, 2.0 * math.pi))
    for i in (2, 5):
        volts[:, i] += 0.1 * light[i // 3].level * flicker
    return generator.output(volts, [])


@dataclass(frozen=True)
class Recorded:
    """``volts`` (n, 6) at 1 kHz; ``frames`` (m,): samples at which the reference was taken, ``reference`` (m, 3)."""

    volts: Array
    frames: np.ndarray[tuple[int], np.dtype[np.int64]]
    reference: Array


def record(
    rig: Mapping[str, float],
    pose: Array,
    rng: np.random.Generator,
    *,
    every: int = 33,
    reference_sd: Sequence[float] = CAMERA,
    outliers: float = 0.0,
    sigma: float | Array = generator.SIGMA,
    light: tuple[Light, Light] | None = None,
) -> Recorded:
    """What the converter and a reference say of the motion ``pose`` (n, 3); ``outliers``: share of wrong frames.
    ``sigma``: V, of all channels or of each (6,). ``light``: besides that of the lasers."""
    read = dots(rig, pose) / generator.MM_PER_V
    both = (DARK, DARK) if light is None else light
    sides = (side.measured(LASER, read[:, 2 * i], read[:, 2 * i + 1]) for i, side in enumerate(both))
    volts = np.column_stack([column for side in sides for column in side]) + rng.normal(0.0, sigma, (len(pose), 6))
    frames = np.arange(17, len(pose) - 17, every)
    reference = pose[frames] + rng.normal(size=(len(frames), 3)) * reference_sd
    wrong = rng.random(len(frames)) < outliers
    reference[wrong] += rng.uniform(-1.0, 1.0, (int(wrong.sum()), 3)) * (1e-3, 1e-3, 1e-2)
    return Recorded(generator.output(volts, []), frames, reference)
