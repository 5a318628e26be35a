# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each term of each effect on samples of any values: formulas written here from docs/simulation.md and the equations.

``test_effect_formulas.py`` has whole simulations against a second generator; here one effect is called alone, at
two sizes and with either sign, so that no term hides behind another.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect, Reading, State, Traced
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import load_rig

COUNT = 9
RIG = load_rig()
EFFECTS = catalogue()
Values = Mapping[str, float]
Rows = dict[str, FloatArray]


def physics() -> Physics:
    out = Physics.of(RIG)
    out.half_area = np.array([[5e-3, 6e-3], [7e-3, 8e-3]])
    return out


def samples_of(seed: int = 1, psds: int = 2) -> SimulatedSamples:
    """Values of the usual sizes, all different."""
    rng = np.random.default_rng(seed)

    def rows(count: int, size: float) -> FloatArray:
        return np.asarray(rng.uniform(0.3, 1.0, (count, COUNT)) * rng.choice((-size, size), (count, COUNT)))

    return SimulatedSamples(
        t=0.7 + np.arange(COUNT, dtype=np.float64) * 1e-3,
        warmer=rng.uniform(1.0, 5.0, COUNT),
        loads=rows(3, 30.0),
        physics=physics(),
        static=rows(3, 3e-3),
        pose=rows(3, 3e-3),
        beams=rows(2 * psds, 0.1),
        dots=rows(2 * psds, 4e-3),
        sums=rng.uniform(2.0, 5.0, (psds, COUNT)),
        volts=rows(3 * psds, 4.0),
        noise=np.zeros(3 * psds),
    )


def values_of(name: str, given: Values) -> dict[str, float]:
    effect = EFFECTS[name]
    return {**effect.off_values(physics(), next(effect.variants())), **given}


def applied(name: str, given: Values, samples: SimulatedSamples) -> SimulatedSamples:
    out = copy.deepcopy(samples)
    apply = EFFECTS[name].apply
    assert apply is not None
    apply(out, values_of(name, given), {})
    return out


def turned(v: FloatArray, angle: float) -> FloatArray:
    """(2, n) turned by ``angle`` about +Z."""
    z = (v[0] + 1j * v[1]) * np.exp(1j * angle)
    return np.array([z.real, z.imag])


def of_psd(
    rows: FloatArray, psd: int, change: Callable[[FloatArray, FloatArray], tuple[FloatArray, ...]]
) -> FloatArray:
    """``rows`` (2P, n) with the x and y of one PSD changed."""
    out = rows.copy()
    at = 2 * (psd - 1)
    out[at], out[at + 1] = change(rows[at], rows[at + 1])
    return out


def light(s: SimulatedSamples, v: Values) -> Rows:
    """The centroid of two spots, each with its weight."""
    psd = int(v['psd'])
    total = s.sums[psd - 1] + v['level']

    def change(x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        return tuple(
            np.average([d, np.full(COUNT, c)], axis=0, weights=[s.sums[psd - 1], np.full(COUNT, v['level'])])
            for d, c in ((x, v['x']), (y, v['y']))
        )

    sums = s.sums.copy()
    sums[psd - 1] = total
    return {'dots': of_psd(s.dots, psd, change), 'sums': sums}


def hum(s: SimulatedSamples, v: Values) -> Rows:
    out = s.volts.copy()
    for row, name in enumerate(CHANNELS):
        out[row] += v[f'amplitude_{name}'] * np.sin(2 * np.pi * v['frequency'] * s.t + v[f'phase_{name}'])
    return {'volts': out}


def offset(s: SimulatedSamples, v: Values) -> Rows:
    """Tz = r x F."""
    arm = np.tile([v['x'], v['y'], 0.0], (COUNT, 1))
    force = np.stack((s.loads[0], s.loads[1], 0.0 * s.loads[0]), axis=1)
    return {'loads': s.loads + np.stack((np.zeros(COUNT), np.zeros(COUNT), np.cross(arm, force)[:, 2]))}


FORMULAS: dict[str, Callable[[SimulatedSamples, Values], Rows]] = {
    'ambient_light': light,
    'axis_crosstalk': lambda s, v: {
        'dots': of_psd(s.dots, int(v['psd']), lambda x, y: (x + v['xy'] * y, y + v['yx'] * x))
    },
    'laser_pointing_drift': lambda s, v: {
        'beams': of_psd(s.beams, int(v['psd']), lambda x, y: (x + v['rate_x'] * s.t, y + v['rate_y'] * s.t))
    },
    'load_direction': lambda s, v: {'loads': np.vstack((turned(s.loads[:2], v['angle']), s.loads[2:]))},
    'load_offset': offset,
    'mains_interference': hum,
    'refraction': lambda s, v: {
        'beams': s.beams + np.tile([[v['x']], [v['y']]], (len(s.beams) // 2, 1)) * s.warmer,
    },
    'sensor_gain': lambda s, v: {
        'dots': of_psd(s.dots, int(v['psd']), lambda x, y: (x * (1 + v['x']), y * (1 + v['y'])))
    },
    'sensor_nonlinearity': lambda s, v: {
        'dots': of_psd(
            s.dots, int(v['psd']), lambda x, y: (x + v['k'] * x * (x * x + y * y), y + v['k'] * y * (x * x + y * y))
        )
    },
    'sensor_rotation': lambda s, v: {
        'dots': of_psd(s.dots, int(v['psd']), lambda x, y: tuple(turned(np.array([x, y]), -v['angle'])))
    },
    'thermal_drift': lambda s, v: {
        'dots': of_psd(s.dots, int(v['psd']), lambda x, y: (x + v['x'] * s.warmer, y + v['y'] * s.warmer))
    },
}

SIZES: dict[str, tuple[Values, Values]] = {
    'ambient_light': ({'level': 0.8, 'x': 2e-3, 'y': -1e-3}, {'level': 3.0, 'x': -3e-3, 'y': 4e-3}),
    'axis_crosstalk': ({'xy': 0.3, 'yx': -0.2}, {'xy': -0.1, 'yx': -0.4}),
    'laser_pointing_drift': ({'rate_x': 1e-4, 'rate_y': -3e-4}, {'rate_x': -2e-4, 'rate_y': 5e-4}),
    'load_direction': ({'angle': 0.4}, {'angle': -1.9}),
    'load_offset': ({'x': 0.03, 'y': -0.05}, {'x': -0.2, 'y': -0.07}),
    'mains_interference': (
        {'frequency': 50.0, **{f'amplitude_{c}': 0.25 * (i + 1) for i, c in enumerate(CHANNELS)}},
        {
            'frequency': 61.7,
            **{f'amplitude_{c}': -0.2 * (i + 1) for i, c in enumerate(CHANNELS)},
            **{f'phase_{c}': 0.9 * i - 2.0 for i, c in enumerate(CHANNELS)},
        },
    ),
    'refraction': ({'x': 2e-5, 'y': -5e-5}, {'x': -3e-4, 'y': 1e-4}),
    'sensor_gain': ({'x': 0.2, 'y': -0.1}, {'x': -0.5, 'y': 2.0}),
    # At the lower end a dot at 5 mm is read a quarter short, and reads no more where it is farther out.
    'sensor_nonlinearity': ({'k': 3000.0}, {'k': -8000.0}),
    'sensor_rotation': ({'angle': 0.3}, {'angle': -2.2}),
    'thermal_drift': ({'x': 2e-5, 'y': -5e-5}, {'x': -3e-4, 'y': 1e-4}),
}

CASES = [
    pytest.param(name, {**size, **psd}, id=f'{name}-{i}-{psd}')
    for name, sizes in SIZES.items()
    for i, size in enumerate(sizes)
    for psd in (({'psd': 1.0}, {'psd': 2.0}) if any(p.name == 'psd' for p in EFFECTS[name].parameters) else ({},))
]


@pytest.mark.parametrize(('name', 'given'), CASES)
def test_samples_change_by_the_formula_and_nothing_else_does(name: str, given: dict[str, float]) -> None:
    before = samples_of()
    after = applied(name, given, before)
    want = FORMULAS[name](before, values_of(name, given))
    for row in ('t', 'warmer', 'loads', 'static', 'pose', 'beams', 'dots', 'sums', 'volts', 'noise'):
        expected = want.get(row, getattr(before, row))
        np.testing.assert_allclose(getattr(after, row), expected, rtol=1e-12, atol=1e-18, err_msg=row)


@pytest.mark.parametrize(('name', 'given'), [c for c in CASES if EFFECTS[str(c.values[0])].correct is not None])
def test_the_correction_takes_off_all_of_it(name: str, given: dict[str, float]) -> None:
    """At sizes far beyond what a rig has, and of the other PSD nothing."""
    before = samples_of()
    before.dots *= 0.8
    after = applied(name, given, before)
    reading = Reading(after.dots, after.sums, after.warmer, after.t)
    correct = EFFECTS[name].correct
    assert correct is not None
    correct(reading, values_of(name, given))
    np.testing.assert_allclose(reading.dots, before.dots, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(reading.sums, before.sums, rtol=1e-12)


def test_all_beams_bend_in_the_same_air() -> None:
    before = samples_of(psds=3)
    after = applied('refraction', {'x': 2e-5, 'y': -5e-5}, before)
    np.testing.assert_allclose(
        after.beams - before.beams, np.tile([[2e-5], [-5e-5]], (3, 1)) * before.warmer, atol=1e-17
    )


def test_a_reading_that_no_dot_could_have_is_corrected_to_something_finite() -> None:
    """With k < 0 a dot reads at most 2/3 of sqrt(-1/(3 k)), here 4.3 mm. Beyond, it is taken where the slope is 1/10.

    There 1 + 3 k r^2 = 0.1, so that 1 + k r^2 = 0.7.
    """
    dots = np.array([[6.5e-3, 3.9e-3, -50e-3], [0.0] * 3, [1e-3] * 3, [0.0] * 3])
    reading = Reading(dots.copy(), np.ones((2, 3)), np.zeros(3), np.zeros(3))
    correct = EFFECTS['sensor_nonlinearity'].correct
    assert correct is not None
    correct(reading, {'psd': 1.0, 'k': -8000.0})
    np.testing.assert_allclose(reading.dots[0, [0, 2]], [6.5e-3 / 0.7, -50e-3 / 0.7], rtol=1e-12)
    # One that a dot can have still is one.
    true = reading.dots[0, 1]
    assert true * (1.0 - 8000.0 * true**2) == pytest.approx(3.9e-3, rel=1e-9)
    assert (reading.dots[1:] == dots[1:]).all()


@pytest.mark.parametrize('k', [1e5, -1e4])
def test_a_bent_reading_is_straightened_to_rounding_at_the_strongest_bend(k: float) -> None:
    """The ends of what a coefficient may be, out to the edge of a sensor."""
    true = np.array([5e-3, -4e-3, 1e-3])
    dots = np.zeros((4, 3))
    dots[2], dots[3] = 0.8 * true * (1.0 + k * true**2), 0.6 * true * (1.0 + k * true**2)
    reading = Reading(dots, np.ones((2, 3)), np.zeros(3), np.zeros(3))
    correct = EFFECTS['sensor_nonlinearity'].correct
    assert correct is not None
    correct(reading, {'psd': 2.0, 'k': k})
    np.testing.assert_allclose(reading.dots[2:], [0.8 * true, 0.6 * true], rtol=0.0, atol=1e-8)


def test_more_light_than_there_is_leaves_a_thousandth() -> None:
    """A level above the whole sum: the laser's part is taken as a thousandth of it, not as nothing or less."""
    reading = Reading(np.full((4, 1), 1e-4), np.array([[2.0], [2.0]]), np.zeros(1), np.zeros(1))
    correct = EFFECTS['ambient_light'].correct
    assert correct is not None
    correct(reading, {'psd': 2.0, 'level': 3.0, 'x': 1e-3, 'y': -1e-3})
    assert reading.sums[:, 0].tolist() == [2.0, 2e-3]
    np.testing.assert_allclose(reading.dots[2:, 0], [(2e-4 - 3e-3) / 2e-3, (2e-4 + 3e-3) / 2e-3], rtol=1e-12)


L, EI = 0.585, RIG.link.bending_stiffness


def stiffer(scale: float, name: str) -> Callable[[Physics, Values], dict[str, Any]]:
    frequency = 'bending_frequency' if name == 'bending_stiffness' else 'torsion_frequency'

    def change(p: Physics, v: Values) -> dict[str, Any]:
        moved = np.sqrt(1.0 + scale) if v['moves_frequency'] else 1.0
        return {name: getattr(p, name) * (1.0 + scale), frequency: getattr(p, frequency) * moved}

    return change


def moved_center(p: Physics, v: Values) -> dict[str, Any]:
    centers, beams = p.centers.copy(), p.beams.copy()
    centers[int(v['psd']) - 1] += (v['x'], v['y'])
    if v['aimed'] == 1:
        beams[int(v['psd']) - 1] += (v['x'], v['y'])
    return {'centers': centers, 'beams': beams}


CONFIGURED: list[tuple[str, Values, Callable[[Physics, Values], dict[str, Any]]]] = [
    *(
        (name, {'scale': scale, 'moves_frequency': moves}, stiffer(scale, name))
        for name in ('bending_stiffness', 'torsional_stiffness')
        for scale in (0.44, -0.19)
        for moves in (0.0, 1.0)
    ),
    ('clamp_bending_compliance', {'compliance': 3e-5}, lambda p, v: {'clamp_bending': 3e-5 + p.clamp_bending}),
    ('clamp_torsional_compliance', {'compliance': 3e-4}, lambda p, v: {'clamp_torsion': 3e-4 + p.clamp_torsion}),
    (
        'damping',
        {'bending_ratio': 0.3, 'torsion_ratio': 0.2},
        lambda p, v: {'bending_damping_ratio': 0.3, 'torsion_damping_ratio': 0.2},
    ),
    ('damping', {'bending_ratio': np.nan, 'torsion_ratio': 0.2}, lambda p, v: {'torsion_damping_ratio': 0.2}),
    ('damping', {'bending_ratio': 0.3, 'torsion_ratio': np.nan}, lambda p, v: {'bending_damping_ratio': 0.3}),
    (
        'mount_tilt',
        {'x': 2e-3, 'y': -3e-3},
        lambda p, v: {'static_offset': p.static_offset + np.array([2e-3, -3e-3]) * L},
    ),
    ('plane_tilt', {'slope_ratio': 1.7}, lambda p, v: {'slope_ratio': 1.7}),
    ('self_weight', {'weight_per_length': 12.0}, lambda p, v: {'weight_per_length': p.weight_per_length + 12.0}),
    *(
        ('sensor_position', {'psd': psd, 'x': 1e-3, 'y': -2e-3, 'aimed': aimed}, moved_center)
        for psd in (1.0, 2.0)
        for aimed in (0.0, 1.0)
    ),
    # The stiffness at the end is 3 EI/L^3, and the mode's mass with it k/w^2: w' = sqrt(k/(m + mass)).
    *(
        (
            'tip_mass',
            {'mass': mass},
            lambda p, v: {
                'bending_frequency': np.sqrt(
                    (3.0 * EI / L**3) / ((3.0 * EI / L**3) / (2.0 * np.pi * p.bending_frequency) ** 2 + v['mass'])
                )
                / (2.0 * np.pi)
            },
        )
        for mass in (0.05, 2.0)
    ),
]


@pytest.mark.parametrize(('name', 'given', 'formula'), CONFIGURED)
def test_constants_change_by_the_formula_and_no_other_does(
    name: str, given: Values, formula: Callable[[Physics, Values], dict[str, Any]]
) -> None:
    before = physics()
    # As if another effect had been there first.
    before.static_offset += (1e-4, 2e-4)
    after = copy.deepcopy(before)
    configure = EFFECTS[name].configure
    assert configure is not None
    configure(after, values_of(name, given))
    want = formula(before, values_of(name, given))
    for field in set(Physics.__slots__) - {'by'}:
        np.testing.assert_allclose(
            np.asarray(getattr(after, field), dtype=float),
            np.asarray(want.get(field, getattr(before, field)), dtype=float),
            rtol=1e-12,
            err_msg=field,
        )


@pytest.mark.parametrize('psd', [1, 2])
@pytest.mark.parametrize('profile', [1, 2])
@pytest.mark.parametrize('radius', [1.5e-3, 3e-3])
def test_a_spot_at_the_edge_is_integrated(psd: int, profile: int, radius: float) -> None:
    """The share of the light on the area, and its centroid, by quadrature along one axis and then the other."""
    half_x, half_y = physics().half_area[psd - 1]

    def across(u: float) -> float:
        """The light on a line at ``u`` from the spot's middle."""
        return 2.0 * np.sqrt(max(radius**2 - u**2, 0.0)) if profile == 1 else float(np.exp(-2.0 * u**2 / radius**2))

    reach = radius if profile == 1 else 4.0 * radius
    whole = quad(across, -reach, reach)[0]
    before = samples_of()
    at = 2 * (psd - 1)
    before.dots[at : at + 2] = np.array(
        [[half_x - 0.3 * radius, -half_x - 0.4 * radius, 0.0], [0.1e-3, 0.0, 0.2 * radius - half_y]]
    ).repeat(3, axis=1)
    after = applied('spot_clipping', {'psd': psd, 'profile': profile, 'radius': radius}, before)
    for i in range(COUNT):
        share = 1.0
        for axis, half in enumerate((half_x, half_y)):
            place = before.dots[at + axis, i]
            low, high = max(-half - place, -reach), min(half - place, reach)
            left = quad(across, low, high)[0]
            moved = quad(lambda u: u * across(u), low, high)[0] / left
            assert after.dots[at + axis, i] == pytest.approx(place + moved, abs=1e-3 * radius)
            share *= left / whole
        assert after.sums[psd - 1, i] == pytest.approx(before.sums[psd - 1, i] * share, rel=1e-3)
    other = 2 - at
    assert (after.dots[other : other + 2] == before.dots[other : other + 2]).all()
    assert (after.sums[2 - psd] == before.sums[2 - psd]).all()


def test_a_spot_without_size_or_off_the_area_stays_finite() -> None:
    before = samples_of()
    assert (applied('spot_clipping', {'psd': 1, 'radius': 0.0}, before).dots == before.dots).all()
    before.dots[0] = 0.05
    for profile in (1, 2):
        after = applied('spot_clipping', {'psd': 1, 'radius': 1e-3, 'profile': profile}, before)
        assert np.isfinite(after.dots).all()
        # What is left of it: below a thousandth of the light.
        assert (after.sums[0] < 1e-3 * before.sums[0]).all()
        assert (after.sums[0] > 0.0).all()
    # The place of a disc that is all but gone is within its radius of the edge.
    after = applied('spot_clipping', {'psd': 1, 'radius': 1e-3}, before)
    assert np.abs(0.05 - after.dots[0]).max() == pytest.approx(1e-3, rel=2e-3)


FUNCTION = (1.3, 0.8, 2.0 * np.pi * 47.0)


def smooth(t: FloatArray) -> FloatArray:
    """Six channels of a + b sin(w t), another b each; at rest before 0."""
    a, b, w = FUNCTION
    sizes = b * np.array([1.0, -0.5, 2.0, 0.3, -1.5, 0.7])
    return np.asarray(a + sizes[:, None] * np.sin(w * np.maximum(t, 0.0)))


def electronics(name: str, given: Values, phase: float, cuts: list[int]) -> tuple[FloatArray, FloatArray]:
    """Times and volts of an effect on ``smooth``, taken ``phase`` after each sample, in pieces."""
    p, out = physics(), []
    state: State = {}
    p.phase = phase
    period = p.period
    apply = EFFECTS[name].apply
    assert apply is not None
    for first, end in itertools.pairwise(cuts):
        at = np.arange(first, end, dtype=np.float64) * period

        def between(later: float, at: FloatArray = at) -> FloatArray:
            assert 0.0 <= later <= period
            return smooth(at + later)

        t = at + phase
        samples = SimulatedSamples(t, 0.0 * t, np.zeros((3, len(t))), p, volts=smooth(t), between=between)
        apply(samples, values_of(name, given), state)
        out.append(samples.volts)
    return np.arange(cuts[-1], dtype=np.float64) * period + phase, np.concatenate(out, axis=1)


PIECES = [0, 0, 1, 2, 5, 5, 60]


@pytest.mark.parametrize('tau', [2e-5, 0.4e-3, 3e-3])
@pytest.mark.parametrize('phase', [0.0, 0.3e-3])
def test_an_amplifier_lags_as_its_equation_says(tau: float, phase: float) -> None:
    """tau v' = u - v from v = u at rest, solved by hand for u = a + b sin w t."""
    t, got = electronics('amplifier_lag', {'time_constant': tau}, phase, PIECES)
    a, _, w = FUNCTION
    x = w * tau
    lag = (np.sin(w * t) - x * np.cos(w * t) + x * np.exp(-t / tau)) / (1.0 + x * x)
    want = a + (smooth(np.array([0.25 / 47.0])) - a) * lag
    np.testing.assert_allclose(got, want, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize('tau', [0.0, 1e-9])
def test_an_amplifier_without_lag_changes_nothing(tau: float) -> None:
    t, got = electronics('amplifier_lag', {'time_constant': tau}, 0.0, PIECES)
    assert (got == smooth(t)).all()


def test_an_amplifier_is_settled_before_the_first_sample() -> None:
    """On whatever is there first: a constant stays."""
    p = physics()
    ones = np.arange(1.0, 7.0)[:, None] * np.ones(5)
    samples = SimulatedSamples(
        np.arange(5, dtype=np.float64) * 1e-3, np.zeros(5), np.zeros((3, 5)), p, volts=ones.copy()
    )
    samples.between = lambda later: ones.copy()
    apply = EFFECTS['amplifier_lag'].apply
    assert apply is not None
    apply(samples, {'time_constant': 2e-3}, {})
    np.testing.assert_allclose(samples.volts, ones, rtol=1e-12)


@pytest.mark.parametrize('psd', [1, 2])
@pytest.mark.parametrize('phase', [0.0, 0.3e-3])
@pytest.mark.parametrize('delay', [0.0, 0.1e-3, 0.4e-3, 1e-3, 1.3e-3, 2.7e-3, 6e-3])
def test_one_psds_samples_are_late_by_the_delay(psd: int, phase: float, delay: float) -> None:
    t, got = electronics('channel_skew', {'psd': psd, 'delay': delay}, phase, PIECES)
    want = smooth(t)
    rows = slice(3 * psd - 3, 3 * psd)
    want[rows] = smooth(t - delay)[rows]
    np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-9)


def test_whole_periods_of_delay_ask_for_nothing_between_samples() -> None:
    """Also those whose quotient is no whole number in floating point."""
    p = physics()
    delays = [float(np.nextafter(n * p.period, side)) for n in (3, 7) for side in (-1.0, 1.0)] + [5 * p.period]
    for delay in delays:
        asked: list[float] = []

        def between(later: float, asked: list[float] = asked) -> FloatArray:
            asked.append(later)
            return np.zeros((6, 3))

        samples = SimulatedSamples(
            np.arange(3, dtype=np.float64) * 1e-3, np.zeros(3), np.zeros((3, 3)), p, volts=np.zeros((6, 3))
        )
        samples.between = between
        apply = EFFECTS['channel_skew'].apply
        assert apply is not None
        apply(samples, {'psd': 1.0, 'delay': delay}, {})
        assert set(asked) == {0.0}, delay


def held(rng: np.random.Generator, count: int) -> FloatArray:
    """(3, n) of loads that are held for some samples."""
    return np.repeat(rng.uniform(-3e-3, 3e-3, (3, count)), 7, axis=1)


def linked(name: str, given: Values, static: FloatArray, point: str, phase: float = 0.0) -> FloatArray:
    """What an effect makes of static poses, in pieces; of ``pose``, 0 before."""
    p, out = physics(), []
    state: State = {}
    p.phase = phase
    apply = EFFECTS[name].apply
    assert apply is not None
    cuts = [0, 0, 1, 3, 20, static.shape[1]]
    for first, end in itertools.pairwise(cuts):
        part = static[:, first:end].copy()
        n = end - first
        samples = SimulatedSamples(
            np.arange(n, dtype=np.float64) * p.period, np.zeros(n), np.zeros((3, n)), p, static=part
        )
        samples.pose = np.zeros((3, n))
        apply(samples, values_of(name, given), state)
        if point == 'pose':
            assert (samples.static == static[:, first:end]).all()
        out.append(getattr(samples, point))
    return np.concatenate(out, axis=1)


@pytest.mark.parametrize(
    ('axis', 'rows'), [(1, (True, True, False)), (2, (False, False, True)), (3, (True, True, True))]
)
@pytest.mark.parametrize('width', [0.0, 1e-3, 4e-3])
def test_a_clamp_that_sticks_follows_at_the_end_of_its_play(axis: int, rows: tuple[bool, ...], width: float) -> None:
    static = held(np.random.default_rng(3), 12)
    got = linked('clamp_friction', {'width': width, 'axis': axis}, static, 'static')
    for row, (sticks, lever) in enumerate(zip(rows, (L, L, 1.0), strict=True)):
        y, want = 0.0, []
        half = 0.5 * width * lever if sticks else 0.0
        for x in static[row]:
            y = x - half if x - half > y else min(y, x + half)
            want.append(y)
        np.testing.assert_allclose(got[row], want, rtol=0.0, atol=1e-18)


@pytest.mark.parametrize(('amplitude', 'tau'), [(0.3, 0.05), (-0.4, 0.004)])
def test_creep_is_a_lag_of_the_held_deflection(amplitude: float, tau: float) -> None:
    """y' = (q - y)/tau from one sample to the next, q held; the sample at t sees what was before t."""
    static = held(np.random.default_rng(4), 12)
    got = linked('creep', {'amplitude': amplitude, 'time_constant': tau}, static, 'static')
    y = np.zeros(3)
    for i, q in enumerate(static.T):
        np.testing.assert_allclose(got[:, i], q + amplitude * y, rtol=1e-12)
        y = q + (y - q) * np.exp(-physics().period / tau)


@pytest.mark.parametrize('shares', [0, 1, 2])
@pytest.mark.parametrize('phase', [0.0, 0.4e-3])
def test_a_second_mode_rings_as_its_equation_says(shares: int, phase: float) -> None:
    """w^2 (q - x) - 2 zeta w x' = x'' with q held, by numerical integration; dX and dY, not theta."""
    static = held(np.random.default_rng(5), 4)
    gain, frequency, ratio = -0.3, 83.0, 0.1
    given = {'gain': gain, 'frequency': frequency, 'damping_ratio': ratio, 'shares': shares}
    got = linked('second_bending_mode', given, static, 'pose', phase)
    p = physics()

    def ringing(q: FloatArray, hertz: float, zeta: float) -> list[float]:
        w, at, state, out = 2.0 * np.pi * hertz, 0.0, np.zeros(2), []
        for load in q:
            end = at + p.period

            def change(t: float, s: FloatArray, load: float = load) -> tuple[float, float]:
                return float(s[1]), w * w * (load - float(s[0])) - 2.0 * zeta * w * float(s[1])

            found = solve_ivp(
                change,
                (at, end),
                state,
                t_eval=[at + phase, end],
                rtol=1e-9,
                atol=1e-14,
            )
            out.append(float(found.y[0, 0]))
            state, at = found.y[:, 1], end
        return out

    for row in range(2):
        want = np.array(ringing(static[row], frequency, ratio))
        if shares == 1:
            want -= ringing(static[row], p.bending_frequency, p.bending_damping_ratio)
        if shares == 2:
            want -= static[row]
        np.testing.assert_allclose(got[row], gain * want, rtol=0.0, atol=1e-9)
    assert not got[2].any()


@pytest.mark.parametrize(('shares', 'share'), [(0, 0.8), (1, 1.0), (2, 1.0)])
def test_at_rest_a_second_mode_adds_its_share_or_nothing(shares: int, share: float) -> None:
    block = Traced([1e-3, -2e-3, 0.01], [0.0] * 3, 0.02, physics())
    trace_back = EFFECTS['second_bending_mode'].trace_back
    assert trace_back is not None
    trace_back(block, {'gain': -0.2, 'shares': shares}, [])
    assert block.pose == pytest.approx([1e-3 / share, -2e-3 / share, 0.01], rel=1e-12)


def test_a_load_beside_the_centroid_is_traced_back() -> None:
    block = Traced([0.0] * 3, [3.0, -4.0, 2.0], 0.02, physics())
    trace_back = EFFECTS['load_offset'].trace_back
    assert trace_back is not None
    trace_back(block, {'x': 0.1, 'y': -0.2}, [])
    # 0.1 m times -4 N, and -(-0.2 m) times 3 N, is 0.2 N m.
    assert block.loads == pytest.approx([3.0, -4.0, 2.0 - 0.2])


def freed(width: float, axis: int, poses: list[tuple[float, float, float]]) -> FloatArray:
    """The poses with the clamp's friction taken off, block after block."""
    trace_back, p = EFFECTS['clamp_friction'].trace_back, physics()
    assert trace_back is not None
    remembered: list[float] = []
    out, sizes = [], set()
    for pose in poses:
        block = Traced(list(pose), [0.0] * 3, 0.02, p)
        trace_back(block, {'width': width, 'axis': axis}, remembered)
        out.append(block.pose)
        sizes.add(len(remembered))
    # Of each axis where it rested, its way, and twelve blocks.
    assert sizes == {3 * (2 + 12)}
    return np.array(out)


@pytest.mark.parametrize(
    ('axis', 'rows'), [(1, (True, True, False)), (2, (False, False, True)), (3, (True, True, True))]
)
@pytest.mark.parametrize('way', [1.0, -1.0])
def test_half_a_loop_further_on_the_way_it_came(axis: int, rows: tuple[bool, ...], way: float) -> None:
    """Each axis by its own lever, from its own last rest; 12 blocks at one place are a rest, 11 are none."""
    width = 2e-3
    for row, (sticks, lever) in enumerate(zip(rows, (L, L, 1.0), strict=True)):
        half = 0.5 * width * lever if sticks else 0.0

        def at(*places: float, row: int = row, half: float = 0.5 * width * lever) -> list[tuple[float, float, float]]:
            """Poses in halves of the loop, of this axis; the others stay at 0."""
            return [tuple(way * half * p if i == row else 0.0 for i in range(3)) for p in places]  # type: ignore[misc]

        def added(poses: list[tuple[float, float, float]], row: int = row, half: float = half) -> list[float]:
            """What the last block had added, in halves of the loop; nothing on another axis."""
            got = freed(width, axis, poses) - poses
            others = [i for i in range(3) if i != row]
            assert not got[:, others].any()
            return [float(v) for v in (way * got[:, row] / half if half else got[:, row])]

        one = 1.0 if sticks else 0.0
        # Below half of half a loop from rest it has not moved, above it has.
        assert added(at(0.0, 0.0, 0.49)) == pytest.approx([0.0, 0.0, 0.0])
        assert added(at(0.0, 0.0, 0.51, 1.0, 4.0)) == pytest.approx([0.0, 0.0, one, one, one])
        # It came to rest at 5: a return to 4 is a way back. Without the rest it still is on its way from 0.
        assert added(at(*[5.0] * 12, 4.0))[-1] == pytest.approx(-one)
        assert added(at(*[5.0] * 11, 4.0))[-1] == pytest.approx(one)
        # A rest that wanders by 0.45 is one; by 0.55 it is none.
        assert added(at(*[5.0] * 6, *[5.45] * 6, 4.0))[-1] == pytest.approx(-one)
        assert added(at(*[5.0] * 6, *[5.55] * 6, 4.0))[-1] == pytest.approx(one)
        # At rest, moved by less than a quarter of the loop: as it came.
        assert added(at(*[5.0] * 12, 4.7, 5.3))[-2:] == pytest.approx([one, one])
        # Back through where it rested first, and at rest there.
        assert added(at(*[5.0] * 12, *[0.0] * 20, 0.3, 0.6))[-3:] == pytest.approx([-one, -one, one])


@pytest.mark.parametrize(('name', 'parameter'), [('ambient_light', 'x'), ('ambient_light', 'y')])
@pytest.mark.parametrize('psd', [1, 2])
def test_measured_light_falls_on_the_area(name: str, parameter: str, psd: int) -> None:
    half = physics().half_area[psd - 1, 'xy'.index(parameter)]
    assert EFFECTS[name].parameter(parameter).bounds(physics(), {'psd': psd}) == (-half, half)


def test_a_second_mode_is_no_copy_of_the_first() -> None:
    """A cantilever's is 6.27 times as high; one nearer than 1.6 times would mimic the first."""
    p = physics()
    low, high = EFFECTS['second_bending_mode'].parameter('frequency').bounds(p, {})
    assert low == pytest.approx(1.6 * p.bending_frequency)
    assert high == 450.0


@pytest.mark.parametrize('psds', [2, 3])
@pytest.mark.parametrize('sums', [0, 1])
@pytest.mark.parametrize('limit', [0.7, 2.5])
def test_an_amplifier_clips_at_both_ends(psds: int, sums: int, limit: float) -> None:
    before = samples_of(psds=psds)
    after = applied('amplifier_saturation', {'limit': limit, 'sums': sums}, before)
    want = np.clip(before.volts, -limit, limit)
    if not sums:
        want[2::3] = before.volts[2::3]
    np.testing.assert_allclose(after.volts, want, rtol=1e-12)


@pytest.mark.parametrize(('name', 'given'), [('amplifier_saturation', {'limit': 0.9}), ('quantisation', {'step': 0.4})])
def test_each_channel_has_the_mean_over_its_own_noise(name: str, given: Values) -> None:
    before = samples_of()
    before.volts = np.linspace(-1.1, 1.0, COUNT)[None].repeat(6, axis=0)
    before.noise = np.array([0.0, 0.1, 0.2, 0.06, 0.3, 0.15])
    after = applied(name, given, before)
    nodes = np.linspace(-7.0, 7.0, 40_001)
    weights = np.exp(-0.5 * nodes**2)
    for got, volts, sigma in zip(after.volts, before.volts, before.noise, strict=True):
        noisy = volts[:, None] + sigma * nodes
        each = np.clip(noisy, -0.9, 0.9) if 'limit' in given else np.rint(noisy / 0.4) * 0.4
        want = (each * weights).sum(axis=1) / weights.sum()
        np.testing.assert_allclose(got, want, rtol=0.0, atol=2e-4)


def test_no_coarser_step_than_the_converters_changes_nothing() -> None:
    before = samples_of()
    assert (applied('quantisation', {'step': 0.0}, before).volts == before.volts).all()


def test_the_clamp_adds_to_what_another_effect_gave_it() -> None:
    """Root rotation C F L moves the end by C F L^2; the clamp's twist adds C Tz."""
    history = loads.steps([(2.0, -3.0, 4.0)], 0.01).loads
    active = [
        ActiveEffect(EFFECTS[name], {'compliance': value})
        for name, value in (('clamp_bending_compliance', 1e-4), ('clamp_torsional_compliance', 2e-4))
    ]
    still, moved = (ForwardModel(RIG, effects).run(history).static[:, -1] for effects in ([], active))
    np.testing.assert_allclose(moved - still, [1e-4 * 2.0 * L**2, -1e-4 * 3.0 * L**2, 2e-4 * 4.0], rtol=1e-9)


def test_a_link_sags_by_its_own_weight() -> None:
    """w L^4/(8 EI) of the beam, and at a clamp that gives way c w L^2/2 of turn, times L."""
    p = physics()
    p.static_offset += (1e-4, 2e-4)
    p.weight_per_length, p.clamp_bending = 12.0, 3e-5
    sag = 12.0 * L**4 / (8.0 * EI) + 3e-5 * 12.0 * L**3 / 2.0
    assert p.at_rest == pytest.approx((1e-4, 2e-4 - sag), rel=1e-12)
