# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The forward model against closed forms, an independent integrator, and itself in pieces."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.devices.serve import served_loads
from psd_deflection.model.detector import VoltsToDots, counts_to_volts, dot_noise_variances
from psd_deflection.model.simulation import loads, simulator
from psd_deflection.model.simulation.catalogue import make_active, with_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig


def test_any_splitting_gives_the_same_samples_bit_for_bit() -> None:
    history = loads.identification().loads[1500:4200]
    full = RigSimulator(load_rig(), seed=3).step(history)
    for sizes in ([1] * 50, [7, 13, 1, 64, 3], [20] * 9):
        pieces = RigSimulator(load_rig(), seed=3)
        got = []
        start = 0
        for size in sizes:
            got.append(pieces.step(history[start : start + size]))
            start += size
        got.append(pieces.step(history[start:]))
        assert np.array_equal(np.concatenate([g.counts for g in got]), full.counts)
        assert np.array_equal(np.concatenate([g.pose for g in got]), full.pose)
        assert np.array_equal(np.concatenate([g.dots for g in got]), full.dots)


def test_mode_is_exact_against_an_independent_integrator() -> None:
    w, zeta = 2 * np.pi * 14.0, 0.02
    held = np.repeat([1.0, -0.5, 2.0], 40)
    got = Filter(mode_coefficients(14.0, zeta, 1e-3))(held)
    state, want = np.zeros(2), []

    def slope(_: float, y: FloatArray, u: float) -> list[float]:
        return [y[1], w * w * (u - y[0]) - 2 * zeta * w * y[1]]

    for u in held:
        want.append(state[0])
        state = solve_ivp(slope, (0, 1e-3), state, args=(u,), rtol=1e-11, atol=1e-14).y[:, -1]
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_settled_pose_is_the_beam_formula() -> None:
    rig = load_rig()
    step = RigSimulator(rig).step(loads.constant(loads.sidebar(50.0), 12.0).loads)
    assert np.array_equal(step.pose[0], np.zeros(3))
    # 50 N (docs/mechanics.md).
    np.testing.assert_allclose(
        step.pose[-1], [0.0, -2.2271675e-3, -50 * 0.585**2 / rig.link.torsional_stiffness], atol=2e-9
    )
    assert step.pose[-1, 2] == pytest.approx(-0.016418222, abs=2e-8)


def test_dots_obey_the_contract_equation() -> None:
    rig = load_rig()
    samples = ForwardModel(rig).run(loads.identification().loads)
    for i, (c, m) in enumerate(zip(rig.centers, (samples.dots[:2], samples.dots[2:]), strict=True)):
        rotations = np.array(
            [[np.cos(samples.pose[2]), -np.sin(samples.pose[2])], [np.sin(samples.pose[2]), np.cos(samples.pose[2])]]
        )
        back = np.einsum('ijn,jn->in', rotations, np.asarray(c)[:, None] + m) + samples.pose[:2]
        np.testing.assert_allclose(back, np.tile(np.asarray(c)[:, None], back.shape[1]), atol=1e-15, err_msg=str(i))


def test_cyclic_loads_go_round() -> None:
    history = loads.ramp((0, 0, 0), (1, 2, 3), 0.007)
    cycle = loads.CyclicLoads(history)
    got = np.concatenate([cycle.take(5), cycle.take(4), cycle.take(12)])
    np.testing.assert_array_equal(got, np.concatenate([history.loads] * 3))


def test_the_served_rig_is_loaded_a_second_after_power_up() -> None:
    served = served_loads(1000.0)
    got, cycle = served.take(5000 + 36_000), loads.thesis_load_cases().loads
    assert not got[:1000].any()
    np.testing.assert_array_equal(got[1000:5000], np.tile(loads.sidebar(10.0), (4000, 1)))
    np.testing.assert_array_equal(got[-3000:], cycle[5000:8000])


def test_load_file_is_held_between_rows(tmp_path: Path) -> None:
    path = tmp_path / 'loads.csv'
    path.write_text('t,load_fx,load_fy,load_tz\n0,0,0,0\n0.003,0,-10,0\n0.006,1,0,2\n')
    np.testing.assert_array_equal(loads.from_csv(path).loads, [[0, 0, 0]] * 3 + [[0, -10, 0]] * 3 + [[1, 0, 2]] * 3)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'is empty'),
        ('t,load_fx,load_fy\n0,1,2\n', 'the header lacks load_tz'),
        ('t,load_fx,load_fy,load_tz\n', 'no rows'),
        ('t,load_fx,load_fy,load_tz\n0,1,2,abc\n', ':2: column load_tz'),
        ('t,load_fx,load_fy,load_tz\n0,1,2,nan\n', ':2: '),
        ('t,load_fx,load_fy,load_tz\n0,1,2,3\n0,1,2,3\n', ':3: column t does not rise'),
    ],
)
def test_bad_load_file_is_rejected_by_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'loads.csv'
    path.write_text(text)
    with pytest.raises(RecordingError) as error:
        loads.from_csv(path)
    assert 'loads.csv' in str(error.value)
    assert message in str(error.value)


OWN = {
    'psd_1.noise': [1e-3, 2e-3],
    'psd_2.noise': [4e-3, 3e-3],
    'psd_1.sensitivity': [1e-3, 0.0],
    'psd_2.sensitivity': [0.0, 0.25e-3],
}


def test_each_channel_has_its_own_noise_and_sensitivity() -> None:
    rig = load_rig(overrides=OWN)
    step = RigSimulator(rig, seed=4).step(loads.constant((3.0, -5.0, 1.0), 20.0).loads)
    volts = counts_to_volts(step.counts, rig.converter.volts_per_count)
    error = VoltsToDots.from_rig(rig).dots(volts) - step.dots
    assert np.abs(error.mean(axis=0)).max() < 1e-7
    np.testing.assert_allclose(error.var(axis=0), dot_noise_variances(rig), rtol=0.05)


def test_a_rig_with_dark_levels_is_simulated_in_that_light() -> None:
    """PSD 2 has 0.2 V of other light at 1 V, -2 V: currents of the lasers' 5 V and of the light add."""
    plain, lit = (load_rig(overrides=over) for over in ({}, {'psd_2.dark': [1.0, -2.0, 0.2]}))
    history = loads.constant((3.0, -5.0, 1.0), 0.2).loads
    laser, both = (ForwardModel(rig).run(history).volts for rig in (plain, lit))
    np.testing.assert_array_equal(both[:3], laser[:3])
    np.testing.assert_allclose(both[3], (5.0 * laser[3] + 0.2) / 5.2, rtol=1e-12)
    np.testing.assert_allclose(both[4], (5.0 * laser[4] - 0.4) / 5.2, rtol=1e-12)
    np.testing.assert_allclose(both[5], 5.2)
    dots = VoltsToDots.from_rig(lit).dots(both.T.astype(np.float32))
    np.testing.assert_allclose(dots, ForwardModel(plain).run(history).dots.T, atol=2e-9)


STEPS = [(0.0, 0.0, 0.0), (5.0, -40.0, -20.0), (-10.0, 0.0, 10.0)]
FINER = 10


def fine_volts(more: int = 1) -> FloatArray:
    """Volts (6, n FINER + more) of the nominal rig at 10 kHz, the loads held for 1 ms, the last of them longer."""
    fine = load_rig(overrides={'converter.sample_rate_hz': 1e3 * FINER})
    history = np.repeat(loads.steps(STEPS, 0.05).loads, FINER, axis=0)
    return ForwardModel(fine).run(np.concatenate((history, np.repeat(history[-1:], more, axis=0)))).volts


def effect_volts(*effects: ActiveEffect) -> FloatArray:
    return ForwardModel(load_rig(), effects).run(loads.steps(STEPS, 0.05).loads).volts


@pytest.mark.parametrize('delay', [-3.7e-3, -0.4e-3, 0.4e-3, 1e-3, 3.7e-3])
def test_a_delay_is_exact_just_after_a_load_step_too(delay: float) -> None:
    fine = fine_volts(40)
    at = np.arange(0, fine.shape[1] - 40, FINER)
    expected = fine[:, at]
    expected[3:] = fine[3:, np.maximum(at - round(delay * 1e3 * FINER), 0)]
    delayed = effect_volts(make_active('channel_skew', {'psd': 2, 'delay': delay}, 'test'))
    np.testing.assert_allclose(delayed, expected, rtol=0.0, atol=1e-10)
    assert np.abs(expected - fine[:, at]).max() > 1e-2


def test_a_running_rig_has_no_early_psd() -> None:
    rig = with_effects(load_rig(), ['channel_skew,psd=2,delay=-0.0015', 'thermal_drift,psd=1,x=1e-4'], 'test')
    simulator, history = RigSimulator(rig), loads.constant((0.0, -5.0, 1.0), 0.05).loads
    assert simulator.step(history, np.linspace(20.0, 25.0, 50)).counts.shape == (50, 6)
    with pytest.raises(ConfigError, match='a PSD that is early is simulated with all loads at once'):
        simulator.step(history)


def lagged(fine: FloatArray, tau: float) -> FloatArray:
    """tau y' = u - y at all places of ``fine``; in each millisecond u is the polynomial through its 11 values."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    places = np.linspace(0.0, 1.0, FINER + 1)
    out = np.empty_like(fine)
    out[:, 0] = fine[:, 0]
    # The whole milliseconds first: the others begin with them.
    for step in range(FINER, 0, -1):
        end = places[step]
        s = 0.5 * end * (nodes + 1.0)
        kernel = 0.5 * end * weights * 1e-3 / tau * np.exp(-1e-3 / tau * (end - s))
        basis = np.array([np.prod([(s - b) / (a - b) for b in places if b != a], axis=0) for a in places])
        for start in range(0, fine.shape[1] - 1, FINER):
            decayed = np.exp(-1e-3 / tau * end) * out[:, start]
            out[:, start + step] = decayed + fine[:, start : start + FINER + 1] @ basis @ kernel
    return out


@pytest.mark.parametrize('tau', [0.3e-3, 3e-3])
def test_a_lag_is_exact_just_after_a_load_step_too(tau: float) -> None:
    fine = fine_volts()
    expected = lagged(fine, tau)
    lag = make_active('amplifier_lag', {'time_constant': tau}, 'test')
    np.testing.assert_allclose(effect_volts(lag), expected[:, :-1:FINER], rtol=0.0, atol=3e-7)
    assert np.abs(expected - fine).max() > 1e-2
    skew = make_active('channel_skew', {'psd': 1, 'delay': 0.4e-3}, 'test')
    late = np.concatenate((np.repeat(fine[:3, :1], 4, axis=1), expected[:3, :-4]), axis=1)
    np.testing.assert_allclose(effect_volts(lag, skew)[:3], late[:, :-1:FINER], rtol=0.0, atol=3e-7)


@pytest.mark.repeatable
def test_a_long_history_is_simulated_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces give the bits of the whole; an effect that needs the whole history gets it in one piece."""
    steps = np.repeat(np.array([[0.0, 0.0, 0.0], [3.0, 1.0, 0.1]]), 30, axis=0)
    warm = np.linspace(20.0, 21.0, len(steps))
    lag = make_active('amplifier_lag', {'time_constant': 1e-3}, 'test')
    at_once = ActiveEffect(dataclasses.replace(lag.effect, full=True), lag.values)
    monkeypatch.setattr(simulator, 'PIECE', 14)
    for effects, sizes in (([lag], [12, 12, 12, 12, 12]), ([at_once], [60])):
        model = ForwardModel(load_rig(), effects)
        pieces = list(model.expect_in_pieces(steps, warm, 4))
        assert [at.stop - at.start for at, _ in pieces] == sizes
        assert [at.start for at, _ in pieces] == [sum(sizes[:i]) for i in range(len(sizes))]
        full = ForwardModel(load_rig(), effects).expect(steps, warm).volts
        assert np.array_equal(np.concatenate([samples.volts for _, samples in pieces], axis=1), full)
    assert list(ForwardModel(load_rig(), [at_once]).expect_in_pieces(steps[:0], None)) == []


def test_what_no_converter_reads_is_at_the_ends_of_its_range() -> None:
    """A load of 20 kN moves the dots by nearly a metre."""
    rig = load_rig()
    history = np.repeat([[0.0, -2e4, 0.0], [0.0, 2e4, 0.0]], 30, axis=0)
    counts = RigSimulator(rig).step(history).counts
    assert (counts.min(), counts.max()) == (-32768, 32767)
    assert np.array_equal(counts, RigSimulator(rig, 0).step(history).counts)
    volts = ForwardModel(rig).expect(history).volts
    np.testing.assert_allclose([volts.min(), volts.max()], rig.converter.volts_per_count * np.array([-32768, 32767]))


def test_what_is_taken_between_the_samples_has_that_time() -> None:
    rig = load_rig()
    assert ForwardModel(rig, phase=0.0004).run(np.zeros((3, 3))).t == pytest.approx([0.0004, 0.0014, 0.0024])
    assert ForwardModel(rig).run(np.zeros((3, 3))).t == pytest.approx([0.0, 0.001, 0.002])
