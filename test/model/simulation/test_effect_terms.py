# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each term of each effect on samples of any values: formulas written here from docs/simulation.md and the equations.

``test_effects.py`` has whole simulations against a second generator; here one effect is called alone, at
two sizes and with either sign, so that no term hides behind another.
"""

import copy
import itertools
from collections.abc import Mapping

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import Reading, State, Traced
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig

COUNT = 9
RIG = load_rig()
EFFECTS = catalogue()
Values = Mapping[str, float]


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


def test_impossible_reading_is_corrected_to_finite_value() -> None:
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
def test_strongest_nonlinearity_inverts_to_rounding(k: float) -> None:
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
    full = quad(across, -reach, reach)[0]
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
            light = quad(across, low, high)[0]
            moved = quad(lambda u: u * across(u), low, high)[0] / light
            assert after.dots[at + axis, i] == pytest.approx(place + moved, abs=1e-3 * radius)
            share *= light / full
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


@pytest.mark.parametrize('psd', [1, 2])
@pytest.mark.parametrize('phase', [0.0, 0.3e-3])
@pytest.mark.parametrize('delay', [-0.6e-3, 0.0, 0.1e-3, 0.4e-3, 1e-3, 1.3e-3, 2.7e-3, 6e-3])
def test_one_psds_samples_are_late_by_the_delay(psd: int, phase: float, delay: float) -> None:
    t, got = electronics('channel_skew', {'psd': psd, 'delay': delay}, phase, PIECES)
    want = smooth(t)
    rows = slice(3 * psd - 3, 3 * psd)
    want[rows] = smooth(t - delay)[rows]
    np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-9)


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

            solution = solve_ivp(change, (at, end), state, t_eval=[at + phase, end], rtol=1e-9, atol=1e-14)
            out.append(float(solution.y[0, 0]))
            state, at = solution.y[:, 1], end
        return out

    for row in range(2):
        want = np.array(ringing(static[row], frequency, ratio))
        if shares == 1:
            want -= ringing(static[row], p.bending_frequency, p.bending_damping_ratio)
        if shares == 2:
            want -= static[row]
        np.testing.assert_allclose(got[row], gain * want, rtol=0.0, atol=1e-9)
    assert not got[2].any()


def without_friction(width: float, axis: int, poses: list[tuple[float, float, float]]) -> FloatArray:
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
            got = without_friction(width, axis, poses) - poses
            other_axes = [i for i in range(3) if i != row]
            assert not got[:, other_axes].any()
            return [float(v) for v in (way * got[:, row] / half if half else got[:, row])]

        half_loop = 1.0 if sticks else 0.0
        # Below half of half a loop from rest it has not moved, above it has.
        assert added(at(0.0, 0.0, 0.49)) == pytest.approx([0.0, 0.0, 0.0])
        assert added(at(0.0, 0.0, 0.51, 1.0, 4.0)) == pytest.approx([0.0, 0.0, half_loop, half_loop, half_loop])
        # It came to rest at 5: a return to 4 is a way back. Without the rest it still is on its way from 0.
        assert added(at(*[5.0] * 12, 4.0))[-1] == pytest.approx(-half_loop)
        assert added(at(*[5.0] * 11, 4.0))[-1] == pytest.approx(half_loop)
        # A rest that wanders by 0.45 is one; by 0.55 it is none.
        assert added(at(*[5.0] * 6, *[5.45] * 6, 4.0))[-1] == pytest.approx(-half_loop)
        assert added(at(*[5.0] * 6, *[5.55] * 6, 4.0))[-1] == pytest.approx(half_loop)
        # At rest, moved by less than a quarter of the loop: as it came.
        assert added(at(*[5.0] * 12, 4.7, 5.3))[-2:] == pytest.approx([half_loop, half_loop])
        # Back through where it rested first, and at rest there.
        assert added(at(*[5.0] * 12, *[0.0] * 20, 0.3, 0.6))[-3:] == pytest.approx([-half_loop, -half_loop, half_loop])


def test_a_link_sags_by_its_own_weight() -> None:
    """w L^4/(8 EI) of the beam, and at a clamp that gives way c w L^2/2 of turn, times L."""
    p = physics()
    p.static_offset += (1e-4, 2e-4)
    p.weight_per_length, p.clamp_bending = 12.0, 3e-5
    sag = 12.0 * L**4 / (8.0 * EI) + 3e-5 * 12.0 * L**3 / 2.0
    assert p.at_rest == pytest.approx((1e-4, 2e-4 - sag), rel=1e-12)
