"""Rigs that are not as their rig file says: every tolerance of docs/calibration.md drawn at once.

The optics are written apart from the package: each leaning beam is intersected with each detector's surface in three
dimensions by solving a linear system. The motion is that of :mod:`blind.generator`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

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
CAMERA = (10e-6, 10e-6, math.radians(0.03))
"""Standard deviations of one frame of the reference: m, m, rad."""


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
    """One rig. ``beam_N.x``, ``.y``: where the beam meets the unloaded plate, from the nominal centre, m."""
    out = nominal()
    for name in out:
        kind = name.partition('.')[2]
        if name == 'link.slope_ratio':
            spread = SLOPE[1]
        elif name.startswith('beam'):
            spread = BEAM_ANGLE if kind.startswith('angle') else BEAM_PLACE
        else:
            spread = SPREADS[kind]
        out[name] += float(rng.normal(0.0, spread))
    return out


def dots(rig: Mapping[str, float], pose: Array) -> Array:
    """Readings (n, 4), m, of true poses (n, 3)."""
    n = len(pose)
    k = rig['link.slope_ratio'] / LENGTH
    theta, phi, omega = pose[:, 2], -k * pose[:, 1], k * pose[:, 0]
    zero, one = np.zeros(n), np.ones(n)

    def matrix(rows: Sequence[Sequence[Array]]) -> Array:
        return np.stack([np.stack(row, axis=1) for row in rows], axis=1)

    about_z = matrix([(np.cos(theta), -np.sin(theta), zero), (np.sin(theta), np.cos(theta), zero), (zero, zero, one)])
    about_x = matrix([(one, zero, zero), (zero, np.cos(phi), -np.sin(phi)), (zero, np.sin(phi), np.cos(phi))])
    about_y = matrix([(np.cos(omega), zero, np.sin(omega)), (zero, one, zero), (-np.sin(omega), zero, np.cos(omega))])
    turn = about_y @ about_x @ about_z
    tip = np.column_stack((pose[:, :2], np.full(n, LENGTH)))
    out = np.empty((n, 4))
    for i, (fx, fy) in enumerate(generator.PLACES):
        own = {
            name.partition('.')[2]: v for name, v in rig.items() if name.startswith((f'psd_{i + 1}.', f'beam_{i + 1}.'))
        }
        along = np.array([math.tan(own['angle_x']), math.tan(own['angle_y']), 1.0])
        start = np.array([fx + own['x'], fy + own['y'], LENGTH + own['height']])
        origin = tip + turn @ np.array([own['center_x'], own['center_y'], own['height']])
        # origin + a ex + b ey = start + s along
        system = np.stack((turn[:, :, 0], turn[:, :, 1], np.tile(-along, (n, 1))), axis=2)
        a = np.linalg.solve(system, (start - origin)[:, :, None])[:, :, 0]
        z = (a[:, 0] + 1j * a[:, 1]) * np.exp(-1j * own['rotation'])
        z = z * (1.0 + own['nonlinearity'] * np.abs(z) ** 2)
        out[:, 2 * i] = (1.0 + own['gain_x']) * (z.real + own['crosstalk_xy'] * z.imag)
        out[:, 2 * i + 1] = (1.0 + own['gain_y']) * (z.imag + own['crosstalk_yx'] * z.real)
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
    spread: Sequence[float] = CAMERA,
    outliers: float = 0.0,
    sigma: float = generator.SIGMA,
) -> Recorded:
    """What the converter and a reference say of the motion ``pose`` (n, 3); ``outliers``: share of wrong frames."""
    read = dots(rig, pose) / generator.MM_PER_V
    light = np.full(len(pose), 5.0)
    volts = np.column_stack((read[:, :2], light, read[:, 2:], light)) + rng.normal(0.0, sigma, (len(pose), 6))
    frames = np.arange(17, len(pose) - 17, every)
    reference = pose[frames] + rng.normal(size=(len(frames), 3)) * spread
    wrong = rng.random(len(frames)) < outliers
    reference[wrong] += rng.uniform(-1.0, 1.0, (int(wrong.sum()), 3)) * (1e-3, 1e-3, 1e-2)
    return Recorded(generator.output(volts, []), frames, reference)
