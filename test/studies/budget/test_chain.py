# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The measuring chain with everything wrong at once, against independent golden readings and closed forms."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.budget.chain import MeasuringChain, dots, measure
from psd_deflection.studies.budget.estimate import estimator_of

GOLDEN: dict[str, Any] = json.loads((Path(__file__).parents[2] / 'data' / 'golden.json').read_text(encoding='utf-8'))
CASES = {c['name']: c for c in GOLDEN['cases']}
RIG = load_rig()


def _pose(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    dx, dy, _, theta, _, _ = CASES[name]['pose']
    return np.array([dx, dy, theta])


def _slope_ratio(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    _, dy, _, _, phi, _ = CASES[name]['pose']
    return np.array([-phi * 0.585 / dy if dy else 0.0])


@pytest.mark.parametrize('name', ['G1', 'G2', 'G3', 'G4', 'G5', 'G6', 'G9', 'G10'])
def test_a_perfect_chain_gives_the_golden_readings(name: str) -> None:
    chain = replace(MeasuringChain.of(RIG), slope_ratio=_slope_ratio(name))
    readings, zeros = measure(chain, _pose(name))
    assert readings[0] == pytest.approx(np.array(CASES[name]['readings']), abs=1e-15)
    assert np.all(zeros == 0.0)


def test_everything_wrong_at_once() -> None:
    # Golden case G12: heights, inclined beams, turned sensors, gains, offsets before load, shortening.
    case = CASES['G12']
    gains = np.array([[1.01, 1.0], [1.0, 0.98]])
    slope = np.tan(np.radians([1.0, 0.5]))
    chain = replace(
        MeasuringChain.of(RIG),
        slope_ratio=_slope_ratio('G12'),
        zeros=np.array(case['m0']) / gains,
        heights=np.array([0.02, 0.02]),
        beam_slope=np.array([[[slope[0], 0.0], [0.0, -slope[1]]]]),
        rotation=np.radians([[1.0, -0.5]]),
        gain=gains[None] - 1.0,
    )
    got = dots(chain, _pose('G12'), dz=case['pose'][2])[0] * gains
    assert got == pytest.approx(np.array(case['readings']), abs=1e-12)
    # measure() reads the same without the shortening, which only inclined beams see.
    readings, zeros = measure(chain, _pose('G12'))
    assert zeros[0] == pytest.approx(np.array(case['m0']), rel=1e-12)
    assert np.max(np.abs(readings[0] - got)) == pytest.approx(slope[0] * case['pose'][2], rel=0.05)


@pytest.mark.parametrize(('method', 'key'), [('exact', 'procrustes'), ('beam', 'beam_gn_k1.5'), ('wls', 'ols')])
@pytest.mark.parametrize('name', [n for n in CASES if n != 'G12'])
def test_the_estimators_give_the_golden_answers(name: str, method: str, key: str) -> None:
    case = CASES[name]
    rig = replace_values(RIG, {'wls.weights': 'inverse_variance'})
    readings, zeros = np.array([case['readings']]), np.array([case['m0']])
    # The linear method's A is of the beams, so the rig must know its zeros.
    rig = replace_values(rig, {'psd_1.zero': case['m0'][0], 'psd_2.zero': case['m0'][1]})
    got = estimator_of(rig, method).estimate(readings, zeros)[0]
    assert got == pytest.approx(case[key], abs=1e-10)


def test_a_method_that_there_is_not_and_a_rig_that_sees_no_twist() -> None:
    with pytest.raises(ConfigError, match='must be one of exact, beam, wls'):
        estimator_of(RIG, 'magic')
    with pytest.raises(ConfigError, match='the twist cannot be seen'):
        estimator_of(replace_values(RIG, {'psd_2.center': [0.0, 0.070]}), 'exact')
