# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every effect against a second formula: that of the generator in ``blind/``, written from docs/simulation.md alone.

The judge is how the volts differ from those of the nominal rig, sample by sample, at two lengths of
the link. An effect that is added to the catalogue needs a second formula too: without one its test
fails.
"""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from blind import generator
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, Traced
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import load_rig

HISTORY = loads.steps([(0, 0, 0), (5, -50, -29), (30, 10, 12), (20, -25, 10), (-15, -25, 10)], 0.5).loads
WARM = 20.0 + 5.0 * np.linspace(0, 1, len(HISTORY)) ** 2

AMPLITUDES = {
    'ambient_light': {'level': 0.3, 'x': 2e-3, 'y': -1e-3},
    'amplifier_saturation': {'limit': 2.0},
    'creep': {'amplitude': 0.05, 'time_constant': 0.3},
    'quantisation': {'step': 0.07},
    'sensor_position': {'x': 3e-4, 'y': -2e-4},
    'spot_clipping': {'radius': 4.5e-3},
    'second_bending_mode': {'gain': 0.05, 'frequency': 71.0, 'damping_ratio': 0.015},
}
"""Values that show each parameter, if ten probes do not."""

LARGEST_MISS = {
    # What a load step does between two samples is interpolated in another way there.
    'amplifier_lag': 2e-2,
    'channel_skew': 2e-2,
}
"""Of the largest change that the effect makes; 1e-4 for all others."""


def shown(effect: Effect, choice: dict[str, float]) -> ActiveEffect:
    """Each parameter at another distance from off, so that exchanged ones show."""
    values = effect.off_values(Physics.of(load_rig()), choice)
    amplitudes = [p for p in effect.parameters if p.kind in ('amplitude', 'phase')]
    for i, p in enumerate(amplitudes):
        wanted = values[p.name] + (1.0, -0.7, 0.5, -0.4, 0.3, -0.2)[i % 6] * 10.0 * p.scale
        values[p.name] = min(max(wanted, p.minimum + p.scale), p.maximum)
    values.update(AMPLITUDES.get(effect.name, {}))
    return ActiveEffect(effect, values)


def as_second(active: ActiveEffect) -> dict[str, Any]:
    """The same effect for the second generator: six amplitudes and phases are lists there."""
    values = active.values
    spec: dict[str, Any] = {'name': active.effect.name}
    for name, value in values.items():
        if not name.startswith(('amplitude_', 'phase_')):
            spec[name] = value
    for many in ('amplitude', 'phase'):
        if f'{many}_{CHANNELS[0]}' in values:
            spec[many] = [values[f'{many}_{c}'] for c in CHANNELS]
    return spec


def ours(effects: list[ActiveEffect], length: float) -> FloatArray:
    rig = load_rig()
    rig = dataclasses.replace(rig, link=dataclasses.replace(rig.link, length=length))
    model = ForwardModel(rig, effects)
    samples = model.run(HISTORY, WARM)
    model.finish(samples)
    return samples.volts.T


def theirs(effects: list[dict[str, Any]], length: float) -> FloatArray:
    clean = generator.Generator(HISTORY, WARM, length).clean(effects)
    # A converter of 40 bits: its steps are below the rounding here.
    return generator.output(clean, effects, bits=40)


EVERY = [
    pytest.param(shown(effect, choice), id=f'{name}-{[int(v) for v in choice.values()]}')
    for name, effect in catalogue().items()
    for choice in effect.variants()
]


@functools.cache
def nominal(length: float) -> tuple[FloatArray, FloatArray]:
    """Without an effect, by either."""
    return ours([], length), theirs([], length)


@pytest.mark.parametrize('length', [0.585, pytest.param(0.400, marks=pytest.mark.slow)])
@pytest.mark.parametrize('active', EVERY)
def test_it_does_what_the_second_formula_says(active: ActiveEffect, length: float) -> None:
    got = ours([active], length) - nominal(length)[0]
    want = theirs([as_second(active)], length) - nominal(length)[1]
    size = np.abs(want).max(axis=0)
    assert size.max() > 1e-4, 'the second formula has no such effect'
    allowed = LARGEST_MISS.get(active.effect.name, 1e-4)
    assert np.abs(got - want).max() <= allowed * size.max()


@pytest.mark.parametrize(
    ('name', 'size', 'sigma'),
    [
        ('amplifier_saturation', {'limit': 0.3}, 0.0),
        ('amplifier_saturation', {'limit': 0.3}, 0.1),
        ('amplifier_saturation', {'limit': 0.3}, 1.5),
        # With little noise a step of the converter is all but sharp; with much it is all but gone.
        ('quantisation', {'step': 0.05}, 0.0),
        ('quantisation', {'step': 0.05}, 0.002),
        ('quantisation', {'step': 0.05}, 0.005),
        ('quantisation', {'step': 0.05}, 0.007),
        ('quantisation', {'step': 0.05}, 0.02),
    ],
)
def test_a_signal_without_its_noise_shows_the_mean_over_it(name: str, size: dict[str, float], sigma: float) -> None:
    volts = np.linspace(-0.46, 0.47, 41)
    physics = Physics.of(load_rig())
    samples = SimulatedSamples(np.zeros(41), np.zeros(41), np.zeros((3, 41)), physics, volts=np.tile(volts, (6, 1)))
    samples.noise[:] = sigma
    effect = catalogue()[name]
    assert effect.apply is not None
    effect.apply(samples, {**effect.off_values(physics, next(effect.variants())), **size}, {})
    # The mean by adding up: 20001 values of the noise with their weights.
    deviate = np.linspace(-8.0, 8.0, 20_001)
    weight = np.exp(-0.5 * deviate**2)
    noisy = volts[:, None] + sigma * deviate
    each = np.clip(noisy, -0.3, 0.3) if 'limit' in size else np.rint(noisy / 0.05) * 0.05
    want = (each * weight).sum(axis=1) / weight.sum()
    assert np.abs(samples.volts - want).max() < 2e-5


def traced(name: str, values: dict[str, float], poses: FloatArray, seconds: float) -> FloatArray:
    """The poses before a link effect, block after block."""
    effect, physics = catalogue()[name], Physics.of(load_rig())
    assert effect.trace_back is not None
    full = {**effect.off_values(physics, next(effect.variants())), **values}
    remembered: list[float] = []
    out = []
    for pose in poses.tolist():
        block = Traced(pose, [0.0, 0.0, 0.0], seconds, physics)
        effect.trace_back(block, full, remembered)
        out.append(block.pose)
    return np.array(out)


def test_creep_is_taken_off_a_step_and_off_its_end() -> None:
    """A step to q grows by amplitude (1 - exp(-t/tau)) q; what grew stays when it ends, and dies away."""
    amplitude, tau, period = 0.2, 0.5, 0.02
    t = np.arange(1, 101) * period
    grown = 1.0 - np.exp(-t / tau)
    after = np.where(t > 1.0, 1.0 - np.exp(-(t - 1.0) / tau), 0.0)
    static = np.where(t > 1.0 + 1e-9, 0.0, 1.0)[:, None] * np.array([1e-3, -2e-3, 0.01])
    crept = static + amplitude * (grown - after)[:, None] * np.array([1e-3, -2e-3, 0.01])
    got = traced('creep', {'amplitude': amplitude, 'time_constant': tau}, crept, period)
    np.testing.assert_allclose(got, static, atol=1e-12)


def test_a_turned_force_is_turned_back() -> None:
    effect, physics = catalogue()['load_direction'], Physics.of(load_rig())
    assert effect.trace_back is not None
    # By 30 degrees about Z the load (2, 0) acts as (sqrt 3, 1), and (0, 2) as (-1, sqrt 3).
    for given, acts in (((2.0, 0.0), (3.0**0.5, 1.0)), ((0.0, 2.0), (-1.0, 3.0**0.5))):
        block = Traced([0.0] * 3, [*acts, 7.0], 0.02, physics)
        effect.trace_back(block, {'angle': np.pi / 6.0}, [])
        assert block.loads == pytest.approx([*given, 7.0])
