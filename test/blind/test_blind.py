# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A slice of the blind suite, the second generator against integrators and the simulation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind import generator, run
from blind.cases import DRAWS, EFFECTS, NOISES, Case, designs, short_cases
from blind.generator import LINK
from psd_deflection.model.simulation.catalogue import make_active, sort_effects
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow


def test_the_second_generator_agrees_with_an_adaptive_integrator() -> None:
    loads = np.repeat([[0.0, 0.0, 0.0], [10.0, -50.0, -29.0], [0.0, 20.0, 5.0]], 100, axis=0)
    pose = generator.motion(loads, 0.585, [])
    w, zeta = 2 * np.pi * 14.0, 0.02
    state, want = np.zeros(2), []

    def slope(_: float, y: FloatArray, u: float) -> list[float]:
        return [y[1], w * w * (u - y[0]) - 2 * zeta * w * y[1]]

    give = 0.585**3 / (3 * generator.EI)
    for u in loads[:, 1] * give:
        want.append(state[0])
        state = solve_ivp(slope, (0, 1e-3), state, args=(u,), rtol=1e-11, atol=1e-15).y[:, -1]
    np.testing.assert_allclose(pose[:: generator.FINER, 1], want, atol=1e-9)


def test_both_generators_show_the_nominal_rig_alike() -> None:
    (g,) = designs('one')
    ours = ForwardModel(load_rig(), []).run(g.loads, g.temperature).volts.T
    # A thousandth of the noise: what differs is the step of the second integrator.
    assert np.abs(g.clean([]) - ours).max() < 2e-6


@pytest.mark.parametrize('first', sorted(LINK & set(EFFECTS)))
def test_both_generators_show_two_effects_of_the_link_alike(first: str) -> None:
    """What each reads of the other: the mass the clamp, the second mode the creep. A case of several has both."""
    (g,) = designs('one')
    for second in sorted(LINK & set(EFFECTS)):
        if second < first:
            continue
        pair = [{'name': n, **DRAWS[n](np.random.default_rng(3), 10.0)} for n in {first, second}]
        shown = [make_active(e['name'], {k: v for k, v in e.items() if k != 'name'}, 'test') for e in pair]
        ours = ForwardModel(load_rig(), sort_effects(shown)).run(g.loads, g.temperature).volts.T
        moved = np.abs(ours - g.clean([])).max()
        assert np.abs(g.clean(pair) - ours).max() < 2e-6 + 1e-5 * moved, second


@pytest.mark.parametrize('key', ['single-sensor_rotation-3-s', 'single-plane_tilt-3-s', 'single-quantisation-3-s'])
def test_a_hidden_effect_is_named(key: str) -> None:
    case = next(c for c in short_cases() if c.key == key)
    answer, found = run.answer(case, run.truth_of(case))
    assert [e['name'] for e in answer['effects']] == [case.wanted[0][0]]
    assert found.simulations <= 2000


@pytest.mark.parametrize('noise', ['white', *NOISES])
def test_nothing_is_missing_from_noise_of_any_kind(noise: str) -> None:
    answer, _ = run.answer(Case(f'slice-{noise}', 'null', 'one', (), noise=noise), [])
    assert answer['verdict'] == 'nothing_missing'
