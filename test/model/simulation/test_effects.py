# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The catalogue: complete, effects off when off, on when on, the same in pieces, and as in blind/; PSDs at the base."""

import dataclasses
import functools
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from blind import generator
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.measure.correction import Correction
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.plate import Geometry
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue, effects_of_rig, effects_to_values, sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, Traced
from psd_deflection.model.simulation.law_forms import play
from psd_deflection.model.simulation.physics import Physics, dots_on_plate
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import CHANNELS, FloatArray, RawChunk, TipLoad
from psd_deflection.rig.config import Rig, load_rig, rig_from_values
from test.oracles import RayPlane

RIG = load_rig()
HISTORY = loads.steps([(0, 0, 0), (5, -50, -29), (60, 10, 20), (20, -25, 10)], 0.3).loads
WARM = 20.0 + 5.0 * np.linspace(0, 1, len(HISTORY)) ** 2


def typical(effect: Effect, choice: dict[str, float], probes: float = 10.0) -> ActiveEffect:
    """Every amplitude ten probes away from off, so that the effect shows."""
    values = effect.off_values(Physics.of(RIG), choice)
    for p in effect.parameters:
        if p.kind == 'amplitude':
            if p.proposed_by(choice).startswith('highest'):
                values[p.name] = 2.0
            elif effect.finite and p.grid:
                values[p.name] = p.grid[-1]
            else:
                values[p.name] = min(max(values[p.name] + probes * p.scale, p.minimum), p.maximum)
        elif p.kind == 'coupled':
            values[p.name] = p.scale
    return ActiveEffect(effect, values)


EVERY = [
    pytest.param(typical(effect, choice), id=f'{name}-{[int(v) for v in choice.values()]}')
    for name, effect in catalogue().items()
    for choice in effect.variants()
]
STRONG = [
    pytest.param(
        typical(effect, choice, 100.0),
        id=f'{name}-{[int(v) for v in choice.values()]}',
        marks=pytest.mark.slow if number else (),
    )
    for name, effect in catalogue().items()
    if effect.stage in ('load', 'link')
    for number, choice in enumerate(effect.variants())
]
"""The first variant of each effect is quick."""


def rig_values(effects: list[ActiveEffect]) -> dict[str, object]:
    return {f'effects.{k}.{n}': v for k, body in effects_to_values(effects).items() for n, v in body.items()}


def volts_of(effects: list[ActiveEffect]) -> FloatArray:
    samples = ForwardModel(RIG, effects).run(HISTORY, WARM)
    model = ForwardModel(RIG, effects)
    model.run(HISTORY, WARM)
    model.finish(samples)
    return samples.volts


@pytest.mark.parametrize('active', EVERY)
def test_on_is_on_and_off_is_off(active: ActiveEffect) -> None:
    nominal = volts_of([])
    on = volts_of([active])
    assert np.all(np.isfinite(on))
    assert np.abs(on - nominal).max() > 1e-5
    choice = {p.name: active.values[p.name] for p in active.effect.parameters if p.kind == 'choice'}
    off = volts_of([ActiveEffect(active.effect, active.effect.off_values(Physics.of(RIG), choice))])
    np.testing.assert_allclose(off, nominal, rtol=0, atol=1e-12)


@pytest.mark.parametrize('active', EVERY)
def test_in_pieces_bit_for_bit(active: ActiveEffect) -> None:
    rig = rig_from_values(rig_values([active]))
    full = RigSimulator(rig, 5).step(HISTORY, WARM)
    pieces = RigSimulator(rig, 5)
    cuts = [0, 1, 2, 3, 10, 299, 301, 640, len(HISTORY)]
    got = [pieces.step(HISTORY[a:b], WARM[a:b]).counts for a, b in itertools.pairwise(cuts)]
    assert np.array_equal(np.concatenate(got), full.counts)


@pytest.mark.slow
@pytest.mark.parametrize('active', EVERY)
def test_a_rig_file_carries_it_there_and_back(active: ActiveEffect, tmp_path: Path) -> None:
    path = tmp_path / 'model.yaml'
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {'effects': effects_to_values([active])}}}))
    (back,) = effects_of_rig(load_rig(path))
    assert back.effect is active.effect
    for key, value in active.values.items():
        assert back.values[key] == value or (math.isnan(value) and math.isnan(back.values[key]))


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'effects.a': 3}, 'effects.a = 3'),
        ({'effects.a.name': 'sensor_rotatoin', 'effects.a.psd': 1}, 'did you mean sensor_rotation'),
        ({'effects.a.name': 'sensor_rotation'}, 'psd is missing'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 7}, 'one of 1, 2'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 3, 'effects.a.angle': 0.1}, 'the rig has 2 PSDs'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 1, 'effects.a.angle': 'big'}, 'must be a number'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 1, 'effects.a.angle': math.inf}, 'finite'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 1, 'effects.a.angle': 4.0}, 'at most 3.2'),
        ({'effects.a.name': 'sensor_rotation', 'effects.a.psd': 1, 'effects.a.turn': 4.0}, 'turn'),
    ],
)
def test_a_bad_effect_is_rejected_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        effects_of_rig(rig_from_values(values))
    assert message in str(error.value)


def test_play_is_the_sequential_operator() -> None:
    x = np.cumsum(np.random.default_rng(0).normal(size=500)).repeat(2)
    y, want = 0.3, []
    for v in x:
        y = min(max(y, v - 0.8), v + 0.8)
        want.append(y)
    np.testing.assert_array_equal(play(x, 0.8, 0.3), want)


CORRECTABLE = [
    ('sensor_rotation', {'psd': 2, 'angle': 0.02}),
    ('sensor_gain', {'psd': 1, 'x': 0.02, 'y': -0.01}),
    ('axis_crosstalk', {'psd': 1, 'xy': 0.01, 'yx': -0.02}),
    ('sensor_nonlinearity', {'psd': 2, 'k': 2000.0}),
    ('sensor_position', {'psd': 1, 'x': 1e-3, 'y': -2e-3}),
    ('sensor_position', {'psd': 2, 'x': 1e-3, 'y': -2e-3, 'aimed': 0}),
    ('thermal_drift', {'psd': 2, 'x': 2e-6, 'y': 1e-6}),
    ('refraction', {'x': 2e-6, 'y': 1e-6}),
    ('laser_pointing_drift', {'psd': 1, 'rate_x': 1e-5, 'rate_y': 2e-5}),
    ('ambient_light', {'psd': 2, 'level': 0.2, 'x': 2e-3, 'y': -1e-3}),
    ('plane_tilt', {'slope_ratio': 1.5}),
]


@pytest.mark.parametrize(('name', 'values'), CORRECTABLE)
def test_the_correction_gives_back_what_the_nominal_rig_shows(name: str, values: dict[str, object]) -> None:
    rig = rig_from_values({'effects.a.name': name, **{f'effects.a.{k}': v for k, v in values.items()}})
    observed = ForwardModel(rig).run(HISTORY, WARM)
    nominal = ForwardModel(RIG).run(HISTORY, WARM)
    correction = Correction.from_rig(rig)
    assert correction.active
    before = np.abs(observed.dots - nominal.dots).max()
    after = np.abs(
        correction.apply(observed.dots.T, observed.sums.T, observed.warmer, observed.t).T - nominal.dots
    ).max()
    assert after < 1e-3 * before


LOADS = ((10.0, -25.0, -12.0), (20.0, -40.0, -20.0), (-5.0, 10.0, 8.0))
HELD_S = 7


def wrenches(rig: Rig, volts: FloatArray) -> FloatArray:
    """The published load (3, 3), N, N, N m, at the end of each of ``LOADS``, of volts (n, 6) that are held so long."""
    seq = np.arange(len(volts))
    if not rig.effects:
        # What came before does not matter: the last three blocks of each load.
        seq = seq[seq % (1000 * HELD_S) >= 1000 * HELD_S - 60]
    chunk = RawChunk(seq, seq * 1_000_000, volts[seq].astype(np.float32), np.zeros(len(seq), np.uint8))
    loads = [(r.fx, r.fy, r.tz) for r in Pipeline(rig).process(chunk) if isinstance(r, TipLoad)]
    return np.array(loads)[len(loads) // 3 * np.arange(1, 4) - 1]


@pytest.mark.parametrize('active', STRONG)
def test_the_wrench_is_the_load(active: ActiveEffect) -> None:
    """Within 0.1 % of it, once the link rests; where the effect displaces the tip, only if it is traced back."""
    calm = {'solvers': ['exact']}
    known = load_rig(overrides={**calm, **rig_values([active])})
    volts, nominal = (
        ForwardModel(load_rig(), effects).run(loads.steps(list(LOADS), HELD_S).loads).volts.T
        for effects in ([active], [])
    )
    traced, blind = wrenches(known, volts), wrenches(load_rig(overrides=calm), volts)
    size = np.linalg.norm(LOADS, axis=1, keepdims=True)
    assert (np.abs(traced - LOADS) < 1e-3 * size).all()
    moved = np.abs(volts[-1] - nominal[-1]).max() > 0.05
    assert not moved or (np.abs(blind - LOADS) > 1e-3 * size).any()


TABLE = Path(__file__).parents[2] / 'data' / 'effects.txt'


def lines_of(effect: Effect) -> list[str]:
    out = [f'{effect.name}: {effect.stage} {effect.order}, at {effect.point}' + ', finite' * effect.finite]
    for p in effect.parameters:
        low, high = (f'{v:.6g}' for v in (p.minimum, p.maximum))
        words = [
            f'{p.kind}, {low} to {high} {p.unit}'.rstrip(),
            f'default {p.of_rig or f"{p.nominal:g}"}',
            f'probe {p.scale:g}',
        ]
        words += ['required'] * p.required + ['each'] * p.each + [f'power {p.power}'] * bool(p.power)
        words += [f'choices {" ".join(map(str, p.choices))}'] * bool(p.choices)
        words += [f'tried {" ".join(f"{v:g}" for v in p.grid)}'] * bool(p.grid)
        words += [f'with {p.partner}'] * bool(p.partner)
        words += [f'from {" ".join(p.proposed_by(c) for c in effect.variants())}'] * bool(p.propose)
        out.append(f'  {p.name}: ' + ', '.join(words))
    return out


def test_the_catalogue_is_the_one_that_rig_files_know() -> None:
    """In the order in which effects act. An effect that is added is held by its second formula, not by this table."""
    physics = Physics.of(load_rig())
    table = TABLE.read_text()
    known = [line.partition(':')[0] for line in table.splitlines() if not line.startswith(' ')]
    every = [ActiveEffect(e, e.off_values(physics, next(e.variants()))) for e in catalogue().values()]
    got = [line for a in sort_effects(every) if a.effect.name in known for line in lines_of(a.effect)]
    assert '\n'.join(got) + '\n' == table


BASE = {'psd_1.height': -0.585, 'psd_2.height': -0.485, 'solver': 'base_pair', 'solvers': ['base_pair']}


@pytest.mark.slow
def test_the_simulated_dots_are_those_of_the_rays(rays: RayPlane) -> None:
    rig = load_rig(overrides=BASE)
    pose = np.array([1e-3, -2e-3, 0.015])
    physics = Physics.of(rig)
    dots = dots_on_plate(pose[:, None], physics.beams.reshape(4, 1), physics)[:, 0]
    tilts = (1.5 * 2e-3 / 0.585, 1.5 * 1e-3 / 0.585)
    np.testing.assert_allclose(dots, rays.base_dots(Geometry.from_rig(rig), (*pose, *tilts)), rtol=0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('assume', 'load', 'message'),
    [('beam', (3.0, -20.0, 4.0), {}), ('no_twist', (3.0, -20.0, 0.0), {'arrangement': 'base'})],
)
def test_it_is_simulated_recorded_replayed_and_solved(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    assume: str,
    load: tuple[float, float, float],
    message: dict[str, str],
) -> None:
    file, bag = tmp_path / 'rig.yaml', tmp_path / 'run'
    body = {**BASE, **message, 'base_pair.assume': assume}
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': body}}))
    words = ','.join(map(str, load))
    assert main(['simulate', '--params-file', str(file), '--loads', f'constant:{words}:12', '--out', str(bag)]) == 0
    assert main(['replay', str(bag), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    estimates = open_recording(bag).estimates()['/link_tip/deflection']
    rest = estimates.pose[-100:]
    truth = LinkStatics.from_rig(load_rig()).deflection(*load)
    assert (np.abs(rest.mean(axis=0) - truth) < [2e-6, 2e-6, 2e-5]).all()


CONTRADICTIONS = [
    ({'solvers': ['base_pair', 'exact']}, r'exact of solvers.*set solvers: \[base_pair\]'),
    ({'degraded': 'hold'}, 'set degraded: none'),
    ({'solver': 'exact', 'solvers': ['exact']}, 'psd_1.height = -0.585 m.*need arrangement: base, solver: base_pair'),
]


@pytest.mark.slow
@pytest.mark.parametrize(('more', 'message'), CONTRADICTIONS)
def test_a_contradiction_is_rejected_and_not_simulated(more: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RigSimulator(load_rig(overrides={**BASE, **more}))


@pytest.mark.slow
def test_moved_optics_of_base_psds_are_rejected() -> None:
    moved = {'effects.a.name': 'sensor_position', 'effects.a.psd': 1, 'effects.a.x': 1e-3}
    with pytest.raises(ConfigError, match='not corrected for PSDs at the base'):
        Correction.from_rig(load_rig(overrides={**BASE, **moved}))
    gain = {'effects.a.name': 'sensor_gain', 'effects.a.psd': 1, 'effects.a.x': 1e-3}
    assert Correction.from_rig(load_rig(overrides={**BASE, **gain})).active


STEPS = loads.steps([(0, 0, 0), (5, -50, -29), (30, 10, 12), (20, -25, 10), (-15, -25, 10)], 0.5).loads
WARMING = 20.0 + 5.0 * np.linspace(0, 1, len(STEPS)) ** 2
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
    samples = model.run(STEPS, WARMING)
    model.finish(samples)
    return samples.volts.T


def theirs(effects: list[dict[str, Any]], length: float) -> FloatArray:
    clean = generator.Generator(STEPS, WARMING, length).clean(effects)
    # A converter of 40 bits: its steps are below the rounding here.
    return generator.output(clean, effects, bits=40)


SHOWN = [
    pytest.param(shown(effect, choice), id=f'{name}-{[int(v) for v in choice.values()]}')
    for name, effect in catalogue().items()
    for choice in effect.variants()
]


@functools.cache
def nominal(length: float) -> tuple[FloatArray, FloatArray]:
    """Without an effect, by either."""
    return ours([], length), theirs([], length)


@pytest.mark.parametrize('length', [0.585, pytest.param(0.400, marks=pytest.mark.slow)])
@pytest.mark.parametrize('active', SHOWN)
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
