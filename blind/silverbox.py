# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The Silverbox, an electronic circuit that is a mass on a spring that stiffens: a plant for ``discover_in``."""

import csv
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

FILE = 'SNLS80mV.csv'
RATE = 1e7 / 2**14  # Hz.
TRAIN = (40650, 105712)  # Samples of the official split: three quarters of the multisines.
TESTS = {'multisine': (105712, 127400), 'arrow': (100, 40575), 'arrow, no extrapolation': (100, 32100)}
START = 50  # Samples of a test that may show its state and that do not count.
CASES, COLUMNS, COMPARED, BEFORE = 10, 25, 100, 50
"""Stretches of the training part; pieces of each that are simulated side by side; samples of a piece that are compared,
and those before them."""
SUBSTEPS = 4
SPEED = 1e-3  # V; Coulomb friction turns round within this speed over w.


def _effect_of(
    name: str, parameter: str, unit: str, most: float, scale: float, words: str, low: float | None = None
) -> Effect:
    return plant_effect(name, EffectParameter(parameter, unit, -most if low is None else low, most, scale, words))


LIBRARY = (
    _effect_of('cubic_spring', 'stiffening', '1/V^2', 10.0, 0.2, 'y grows by stiffening y^3', -3.0),
    _effect_of('quadratic_spring', 'bend', '1/V', 2.0, 0.02, 'y grows by bend y^2'),
    _effect_of('quintic_spring', 'stiffening', '1/V^4', 200.0, 10.0, 'y grows by stiffening y^5', -50.0),
    _effect_of('quadratic_drag', 'drag', '1/V', 0.5, 0.01, 'grows with speed over w squared', 0.0),
    _effect_of('cubic_damping', 'damping', '1/V^2', 3.0, 0.05, 'grows with speed over w cubed', 0.0),
    _effect_of('coulomb_friction', 'force', 'V', 0.01, 1e-4, 'against the motion', 0.0),
    _effect_of('force_offset', 'shift', 'V', 0.05, 1e-3, 'of the input'),
    _effect_of('reading_offset', 'shift', 'V', 0.05, 1e-3, 'of the output'),
    _effect_of('input_delay', 'delay', 's', 1e-3, 2e-5, 'of the input', 0.0),
    _effect_of('input_compression', 'share', '1/V^2', 20.0, 0.5, 'the input falls by share u^3'),
    _effect_of('dead_zone', 'width', 'V', 0.01, 5e-4, 'of the input that shows nothing', 0.0),
)
NUISANCE = (
    _effect_of('frequency', 'scale', '', 0.3, 0.01, 'relative change of w'),
    _effect_of('damping', 'scale', '', 0.6, 0.05, 'relative change of z'),
    _effect_of('gain', 'scale', '', 0.5, 0.01, 'relative change of g'),
)


def read(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Input and output (n,), V. Raises OSError if ``folder`` has no such file, ValueError if it has no numbers."""
    with (folder / FILE).open(newline='') as stream:
        rows = np.array([[float(v) for v in row[:2]] for row in list(csv.reader(stream))[1:] if any(row)])
    return rows[:, 0], rows[:, 1]


def linear(u: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """w (rad/s), z and g of the difference equation of the second order that predicts the next sample best."""
    table = np.column_stack([y[1:-1], y[:-2], u[2:], u[1:-1], u[:-2], np.ones(len(u) - 2)])
    c = np.linalg.lstsq(table, y[2:], rcond=None)[0]
    pole = np.log(np.roots([1.0, -c[0], -c[1]]).astype(complex)[0]) * RATE
    w = float(abs(pole))
    return w, float(-pole.real / w), float(c[2:5].sum() / (1.0 - c[0] - c[1]))


def derivative(y: FloatArray) -> FloatArray:
    """Per second, of the band-limited function through the samples."""
    turn = 2j * np.pi * np.fft.rfftfreq(len(y), 1.0 / RATE)
    return np.fft.irfft(np.fft.rfft(y) * turn, len(y))


class Silverbox(Plant):
    """``train``: first sample, and one past the last, of what is searched."""

    channels = ('output',)
    units = ('V',)
    library: tuple[Effect, ...] = LIBRARY
    nuisance = NUISANCE
    period = 1.0 / RATE

    def __init__(self, folder: Path, train: tuple[int, int] = TRAIN, shape: tuple[int, int] = (CASES, COLUMNS)) -> None:
        """``shape``: cases, and pieces of each. Raises OSError if ``folder`` has no such file, ValueError if it has no
        numbers or ends before ``train`` does."""
        self.u, self.y = read(folder)
        cases, columns = shape
        if not BEFORE + cases * columns * COMPARED <= train[1] - train[0] <= len(self.u) - train[0]:
            raise ValueError(f'{folder / FILE}: has {len(self.u)} samples: too few for {cases} x {columns} pieces')
        self._linear = linear(self.u[train[0] : train[1]], self.y[train[0] : train[1]])
        self._first = train[0] + np.arange(cases * columns) * COMPARED
        self.speed = derivative(self.y)
        self._spectrum = np.fft.rfft(self.u)
        self.forced = lru_cache(maxsize=2)(self._forced)
        begin = self._first[::columns] + BEFORE
        self._spans = [slice(b, b + columns * COMPARED) for b in begin.tolist()]
        self.cases = tuple(f'{b / RATE:.0f} s' for b in begin.tolist())

    def measured(self) -> list[FloatArray]:
        """Output, V."""
        return [self.y[None, span] for span in self._spans]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Input, V."""
        return {'input': [self.u[span] for span in self._spans]}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all pieces side by side."""
        out = self.run(model, self._first, BEFORE + COMPARED)[BEFORE:]
        return [piece.reshape(1, -1) for piece in np.split(out.T, len(self.cases))]

    def run(self, model: Model, first: IntArray, count: int) -> FloatArray:
        """Output (count, pieces) from the measured states at the samples ``first`` on. Between samples the input is the
        band-limited function through them. The linear part is exact for a force that is held over a substep; what is
        not linear is that of the middle of the substep."""

        def of(name: str, parameter: str) -> float:
            return model[name][parameter] if name in model else 0.0

        w, z, g = (value * (1.0 + of(e.name, 'scale')) for value, e in zip(self._linear, self.nuisance, strict=True))
        k2, k3, k5 = (
            of('quadratic_spring', 'bend'),
            of('cubic_spring', 'stiffening'),
            of('quintic_spring', 'stiffening'),
        )
        drag, third, friction = (
            of('quadratic_drag', 'drag'),
            of('cubic_damping', 'damping'),
            of('coulomb_friction', 'force'),
        )
        u = self.forced(of('input_delay', 'delay'))
        u = u - of('input_compression', 'share') * u**3
        width = of('dead_zone', 'width')
        u = u - np.clip(u, -width, width)
        force = g * (u + of('force_offset', 'shift'))
        h = 1.0 / RATE / SUBSTEPS
        # The state is y and v / w.
        step = expm(h * w * np.array([[0.0, 1.0, 0.0], [-1.0, -2.0 * z, 1.0], [0.0, 0.0, 0.0]]))
        (a, b, c), (d, e, f) = step[:2].tolist()
        shift = of('reading_offset', 'shift')
        y, v = self.y[first] - shift, self.speed[first] / w
        half = 0.5 * h * w
        out = np.empty((count, len(first)))
        for i in range(count):
            out[i] = y
            for given in force[first + i].T:
                mid = y + half * v
                push = given - ((k5 * mid**2 + k3) * mid + k2) * mid**2
                if drag or third or friction:
                    push = push - (drag * np.abs(v) + third * v**2) * v - friction * np.tanh(v / SPEED)
                y, v = a * y + b * v + c * push, d * y + e * v + f * push
        return out + shift

    def _forced(self, delay: float, within: float = 0.5) -> FloatArray:
        """The input (n, SUBSTEPS) at the share ``within`` of each substep, ``delay`` later: the band-limited function
        through the samples."""
        n = len(self.u)
        turn = 2j * np.pi * np.arange(len(self._spectrum)) / n
        at = (np.arange(SUBSTEPS) + within) / SUBSTEPS - delay * RATE
        return np.stack([np.fft.irfft(self._spectrum * np.exp(turn * shift), n) for shift in at.tolist()], axis=1)


def rmse(y: FloatArray, model: FloatArray, start: int = START) -> tuple[float, float]:
    """Root mean square of the error after ``start`` samples, and its share of the standard deviation of ``y`` there."""
    residual = float(np.sqrt(np.mean((y[start:] - model[start:]) ** 2)))
    return residual, residual / float(np.std(y[start:]))
