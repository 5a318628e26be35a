# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the forms of a law do to a variable v (n,): of no memory, or following it with a state from block to block.

``shapes``: the numbers that shape the form, by name; ``period``: of the samples, s. A form that
follows keeps in ``state`` what the next block needs.
"""

import math

import numpy as np
from scipy.signal import lfilter

from psd_deflection.model.simulation.declaration import State, Values
from psd_deflection.model.simulation.modes import mode_coefficients
from psd_deflection.records import FloatArray


def play(x: FloatArray, half_width: float, start: float) -> FloatArray:
    """Play operator over (n,) inputs from state ``start``; exact selections, no rounding of its own."""
    moved = np.flatnonzero(np.diff(x)) + 1
    changes = np.concatenate(([0], moved))
    low, high = x[changes] - half_width, x[changes] + half_width
    reach = 1
    while reach < len(changes):
        low0, high0 = low[:-reach], high[:-reach]
        low1, high1 = low[reach:], high[reach:]
        low = np.concatenate((low[:reach], np.minimum(np.maximum(low0, low1), high1)))
        high = np.concatenate((high[:reach], np.minimum(np.maximum(high0, low1), high1)))
        reach *= 2
    outputs = np.minimum(np.maximum(start, low), high)
    return np.repeat(outputs, np.diff(np.concatenate((changes, [len(x)]))))


def above(v: FloatArray, shapes: Values) -> FloatArray:
    """By how much v exceeds the threshold, or 0."""
    return np.maximum(v - shapes['threshold'], 0.0)


def below(v: FloatArray, shapes: Values) -> FloatArray:
    """By how much v falls short of the threshold, or 0."""
    return np.maximum(shapes['threshold'] - v, 0.0)


def excess(v: FloatArray, shapes: Values) -> FloatArray:
    """By how much the size of v exceeds the threshold, with the sign of v."""
    return np.sign(v) * np.maximum(np.abs(v) - shapes['threshold'], 0.0)


def within(v: FloatArray, shapes: Values) -> FloatArray:
    """v, held between the threshold and its negative."""
    return np.clip(v, -shapes['threshold'], shapes['threshold'])


def over(v: FloatArray, shapes: Values) -> FloatArray:
    """1 where v exceeds the threshold, else 0."""
    return (v > shapes['threshold']).astype(np.float64)


def under(v: FloatArray, shapes: Values) -> FloatArray:
    """1 where v is below the threshold, else 0."""
    return (v < shapes['threshold']).astype(np.float64)


def wave(v: FloatArray, shapes: Values) -> FloatArray:
    """A sine of v."""
    return np.sin(2.0 * math.pi * v / shapes['period'] + shapes['phase'])


def rate(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """Derivative of v in time."""
    # Backward, second order: what comes later is not known.
    before = state.get('v', np.full(2, v[0]))
    full = np.concatenate((before, v))
    state['v'] = full[-2:]
    return (1.5 * full[2:] - 2.0 * full[1:-1] + 0.5 * full[:-2]) / period


def rate_absolute(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """Size of the derivative of v."""
    return np.abs(rate(v, shapes, period, state))


def drag(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """Derivative of v times its size."""
    speed = rate(v, shapes, period, state)
    return speed * np.abs(speed)


def direction(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """Sign of the last change of v."""
    change = np.sign(np.diff(v, prepend=state.get('v', v[0])))
    at = np.maximum.accumulate(np.where(change != 0.0, np.arange(1, len(v) + 1), 0))
    out = np.concatenate(([state.get('way', 0.0)], change))[at]
    state['v'], state['way'] = v[-1], out[-1]
    return np.asarray(out)


def relaxed(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """v through a lag of first order."""
    # The input counts from one sample to the next as a straight line.
    a = period / shapes['tau']
    decay = math.exp(-a)
    ahead = 1.0 - (1.0 - decay) / a
    b = np.array([ahead, 1.0 - decay - ahead])
    # Relaxed at zero before the first sample.
    y, state['y'] = lfilter(b, [1.0, -decay], v, zi=state.get('y', np.array([b[1] * v[0]])))
    return np.asarray(y)


def resonance(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """v through a mode."""
    b, a = mode_coefficients(shapes['natural_frequency'], shapes['zeta'], period)
    y, state['y'] = lfilter(b, a, v, zi=state.get('y', np.zeros(2)))
    return np.asarray(y)


def played(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    """v through a play, less v."""
    held = play(v, shapes['half_width'], state.get('held', v[0]))
    state['held'] = float(held[-1])
    return held - v
