# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Short forms of ``blind``: a slice of the suite, the second generator, coverage of intervals, the thesis redone."""

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind import generator, run
from blind.cases import DRAWS, EFFECTS, NOISES, Case, designs, short_cases
from blind.coverage import ROWS, UNEQUAL, Inside, fault, on_a_moving_base, over_the_bound, score, warming
from blind.draws import MOST, duel
from blind.generator import LINK
from blind.redone import SHORT, HeldLoad, main, motion
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
    answer, discovery = run.answer(case, run.truth_of(case))
    assert [e['name'] for e in answer['effects']] == [case.wanted[0][0]]
    assert discovery.simulations <= 2000


@pytest.mark.parametrize('noise', ['white', *NOISES])
def test_nothing_is_missing_from_noise_of_any_kind(noise: str) -> None:
    answer, _ = run.answer(Case(f'slice-{noise}', 'null', 'one', (), noise=noise), [])
    assert answer['verdict'] == 'nothing_missing'


LABELS = ('white', 'AR(1) 0.9', 'twice the noise', '1, 2, 4, 2 mV', 'unequal channels')


@pytest.mark.parametrize('label', LABELS)
def test_the_truth_is_inside(label: str) -> None:
    row = next(r for r in ROWS if r.label == label)
    s = score(row, '20 %' if label == 'white' else 'none', rest_s=24, steps=4, seed=3)
    for part in (s.rest, s.ringing):
        assert part.blocks >= 900
        # 0.95, give or take three standard deviations of a thousand blocks.
        assert covers(part)
    assert s.ringing.three > 0.99
    assert s.alarms == 0.0


def covers(part: Inside) -> bool:
    return all(0.92 < share < 0.98 for share in (*part.axes, part.joint))


def test_temperature_drift_in_rig_file_is_covered() -> None:
    assert covers(warming(rest_s=26, steps=2, seed=3).rest)
    assert warming(reported=False, rest_s=26, steps=2, seed=3).rest.joint < 0.8


def test_the_truth_is_inside_on_a_moving_base() -> None:
    assert covers(on_a_moving_base(30, seed=3))


def test_weights_from_the_stated_noise_reach_the_bound() -> None:
    ratios = over_the_bound(UNEQUAL, ('wls', 'ols'), rest_s=160)
    assert (ratios['wls'] < 1.02).all()
    assert ratios['ols'][0] > 1.4


@pytest.mark.parametrize(('kind', 'channel'), [('dead', 1), ('stuck', 3), ('inverted', 0), ('swapped', 1)])
def test_a_wrong_reading_keeps_the_truth_inside_8_sd(kind: str, channel: int) -> None:
    worst, _ = fault(kind, channel, (0.0, -30.0, -17.55))
    assert worst < 8.0


def test_sidebar_weight_rotates_link_as_beam_predicts() -> None:
    """50 N, 0.585 m from the link: -2.23 mm and 0.94 degrees, 0.12 mm sideways because the rig leans."""
    pose = motion(SHORT, HeldLoad(50.0, 1))
    assert np.abs(pose[: round(1000 * SHORT.rest)]).max() < 1e-9
    assert pose[-1, :2] == pytest.approx([0.12e-3, -2.22e-3], rel=0.02)
    assert np.degrees(pose[-1, 2]) == pytest.approx(-0.94, rel=0.02)
    assert motion(SHORT, HeldLoad(50.0, -1))[-1, 2] == pytest.approx(-pose[-1, 2])
    assert motion(SHORT, HeldLoad(50.0, 0))[-1, 2] == 0.0


def test_calibrated_on_the_sidebar_the_rig_is_right_on_the_link(tmp_path: Path) -> None:
    out = tmp_path / 'thesis'
    assert main(['--short', '--seed', '2', '--out', str(out)]) == 0
    summary = json.loads((out / 'summary.json').read_text())
    shares = summary['shares']
    assert max(shares['after'].values()) <= 0.005
    # Without calibration no method is that good, and what was tuned for the sidebar does not do for the link.
    for stem in ('before', 'before_sidebar', 'before_link'):
        assert max(shares[stem].values()) > 3.0 * max(shares['after'].values())
    clock = summary['clock']
    assert clock['value'] == pytest.approx(clock['true'], abs=5e-4)
    page = (out / 'page.html').read_text()
    HTMLParser().feed(page)
    for words in (
        'Table 5.1 anew',
        'Figures 5.12-5.14',
        'Figures 5.21-5.26',
        'psd-deflection calibrate sidebar_right_50N',
    ):
        assert words in page


@pytest.mark.parametrize('seed', range(8))
def test_a_drawn_plant_is_predicted_as_by_the_better_peer(seed: int) -> None:
    assert duel(seed).ratio <= MOST
