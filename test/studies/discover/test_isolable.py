# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a rig could tell apart, beside what a search then answers."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.catalogue import effect_names, make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.load_words import load_history
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.isolable import Isolability, Isolable, isolable
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.planning import SEPARATES
from psd_deflection.studies.discover.result import Discovery
from psd_deflection.studies.loads.fine import fine_means

RIG = load_rig()
LOADS = load_history('thesis:1', RIG.converter.sample_rate_hz).loads


@cache
def answer() -> Isolability:
    return isolable(RIG, LOADS, 'thesis:1')


def of(label: str) -> Isolable:
    return next(one for one in answer().effects if one.label == label)


def searched(name: str, **values: float) -> Discovery:
    """What a search finds in a recording of a rig that has the effect."""
    true = replace_values(RIG, {'effects.e.name': name, **{f'effects.e.{k}': v for k, v in values.items()}})
    volts = RigSimulator(true, 1).step(LOADS).counts.astype(np.float64) * RIG.converter.volts_per_count
    return discover([Observation('made', RIG, volts, LOADS)])


@pytest.mark.slow
def test_it_says_from_which_size_a_search_names_an_effect() -> None:
    one = of('sensor_rotation (psd 2)')
    assert one.parameter == 'angle'
    assert one.observed is not None
    assert one.named is not None
    assert not searched('sensor_rotation', psd=2, angle=0.5 * one.observed).effects
    found = searched('sensor_rotation', psd=2, angle=2.0 * one.named)
    assert [e.active.label for e in found.effects] == [one.label]
    assert not found.unsettled


@pytest.mark.slow
def test_it_says_what_a_search_cannot_separate() -> None:
    one = of('bending_stiffness (moves_frequency 0)')
    assert one.observed is not None
    assert (one.named, one.alike) == (None, 'clamp_bending_compliance')
    # A softer link: a clamp cannot make it stiffer.
    found = searched('bending_stiffness', scale=-100.0 * one.observed, moves_frequency=0)
    names = {e.active.effect.name for e in found.effects} | set(found.unsettled)
    assert {'bending_stiffness', 'clamp_bending_compliance'} <= names


@pytest.mark.slow
def test_what_does_not_show_is_listed_with_what_it_needs() -> None:
    assert answer().hidden['refraction'] == 'a change of temperature'
    still = isolable(RIG, np.zeros((2000, 3)), 'no load')
    assert 'bending_stiffness (moves_frequency 1)' in still.hidden
    # Where a PSD is shows without any load.
    assert any(one.label == 'sensor_position (psd 1, aimed 0)' for one in still.effects)
    assert 'axis_crosstalk (psd 1)' not in isolable(RIG, LOADS, without=['axis_crosstalk']).hidden


@pytest.mark.slow
def test_every_effect_imitates_itself() -> None:
    matrix = answer().matrix
    assert np.diag(matrix) == pytest.approx(np.ones(len(matrix)), abs=1e-6)
    assert (matrix >= 0.0).all()
    assert (matrix <= 1.0).all()


def test_sizes_are_those_whose_chi_square_a_search_accepts() -> None:
    """Each is simulated at its size, beside the rig as it is."""
    loads = np.repeat([(0.0, 0.0, 0.0), (0.0, -20.0, 0.0), (20.0, 0.0, 0.0), (0.0, 0.0, 8.0)], 500, axis=0)
    few = {'sensor_rotation': {'psd': 2}, 'ambient_light': {'psd': 1}}
    found = isolable(RIG, loads, without=[name for name in effect_names() if name not in few])
    sigma = RIG.noises.reshape(-1, 1) / 2.0

    def shown(*effects: ActiveEffect) -> FloatArray:
        return np.asarray(fine_means(ForwardModel(RIG, effects).expect(loads).volts, 4) / sigma)

    for name, choice in few.items():
        (one,) = (e for e in found.effects if e.label.startswith(f'{name} (psd {choice["psd"]}'))
        active = make_active(name, {**choice, one.parameter: one.observed}, 'test')
        count = sum(p.kind != 'choice' for p in active.effect.parameters)
        by_chance = chi2.isf(1e-4 / len(found.effects), count)
        accepted = max(by_chance, count * math.log(6 * 100) + 10.0)
        assert np.sum((shown(active) - shown()) ** 2) == pytest.approx(accepted, rel=0.1)
        assert one.observed is not None
        larger = max(1.0, math.sqrt(SEPARATES / one.apart / accepted))
        assert one.named == pytest.approx(larger * one.observed, rel=1e-3)


def test_loads_too_short_for_a_search_are_rejected() -> None:
    with pytest.raises(RecordingError, match='79 samples: discover needs at least 4 blocks'):
        isolable(RIG, LOADS[:79])


@pytest.mark.slow
def test_the_command_prints_it_and_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['discover', '--isolable', 'thesis:1', '--out', str(tmp_path / 'before'), '--quiet']) == 0
    out = capsys.readouterr().out
    assert answer().lines()[0] in out
    assert answer().sentences()[0] in out
    assert sorted(path.name for path in (tmp_path / 'before').iterdir()) == ['isolable.json', 'report.html']
