# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One cause of both stiffnesses, told with its size."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.discover.search.coincidence import coincidences
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.hold_out import HeldOut
from psd_deflection.studies.discover.search.ties import CommonCause, Tie, ties
from psd_deflection.studies.discover.search.weighing import Alternative, NamedEffect

FIT = Fit((), 0.0, np.zeros(1), [], np.zeros((1, 0)), (), ())


def stiffness(name: str, scale: float, moves: int = 0) -> ActiveEffect:
    return make_active(f'{name}_stiffness', {'scale': scale, 'moves_frequency': moves}, 'test')


def named(active: ActiveEffect, sd: float, *alternatives: Alternative) -> NamedEffect:
    amplitude = next(p.name for p in active.effect.parameters if p.kind == 'amplitude')
    return NamedEffect(active, {amplitude: sd}, 1e-9, 50.0, HeldOut(9.0, 1.0), (), alternatives, (), None)


def test_radius_material_or_loads_explain_stiffnesses() -> None:
    (tie,) = ties([named(stiffness('bending', -0.04), 1e-4), named(stiffness('torsional', -0.0401), 1e-4)])
    assert tie.share == pytest.approx(-0.04005)
    radius, loads = tie.causes
    assert (radius.name, loads.name) == ('link_radius', 'load_unit')
    # A tube whose radii are multiplied by this has both stiffnesses multiplied by its fourth power.
    assert radius.factor**4 == pytest.approx(1.0 + tie.share)
    assert loads.factor * (1.0 + tie.share) == pytest.approx(1.0)
    for cause, power in ((radius, 0.25), (loads, -1.0)):
        low, high = ((1.0 + share) ** power for share in (tie.share - tie.sd, tie.share + tie.sd))
        assert cause.sd == pytest.approx(abs(high - low) / 2.0, rel=1e-3)
    assert tie.sd == pytest.approx(1e-4 / np.sqrt(2.0))
    for part in ('same share (-4 ± 0.007 %)', 'radii times 0.98983', 'loads times 1.0417', 'weigh the loads'):
        assert part in tie.sentence


def test_if_the_modes_moved_it_is_not_the_loads() -> None:
    (tie,) = ties([named(stiffness('torsional', 0.02, 1), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)])
    assert [c.name for c in tie.causes] == ['link_radius']
    assert 'Not the loads' in tie.sentence
    assert ties([named(stiffness('torsional', 0.02, 0), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)]) == ()


def test_a_rival_may_be_the_half_of_a_tie() -> None:
    clamp = make_active('clamp_torsional_compliance', {'compliance': 2e-5}, 'test')
    alternative = Alternative(stiffness('torsional', -0.04), {'scale': 1e-5}, 0.0, FIT)
    (tie,) = ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8, alternative)])
    assert tie.share == pytest.approx(-0.04)
    assert ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8)]) == ()


@pytest.mark.parametrize(
    ('other', 'sd'), [(-0.041, 1e-5), (0.04, 1e-5), (-0.04, 0.01), (-0.04, 0.0)], ids=('off', 'sign', 'vague', 'fixed')
)
def test_shares_that_differ_or_are_vague_are_no_tie(other: float, sd: float) -> None:
    assert ties([named(stiffness('bending', -0.04), 1e-5), named(stiffness('torsional', other), sd)]) == ()


@pytest.mark.parametrize(('second', 'count'), [('torsional_stiffness', 0), ('axis_crosstalk', 1)])
def test_a_tie_of_known_cause_is_not_called_unknown(second: str, count: int) -> None:
    values = {'scale': -0.04} if count == 0 else {'psd': 1, 'xy': -0.04}
    effects = (stiffness('bending', -0.04), make_active(second, values, 'test'))
    free = ((0, 'scale'), (1, 'scale' if count == 0 else 'xy'))
    fit = Fit(effects, 0.0, np.zeros(2), [], 1e4 * np.eye(2), free, ())
    assert len(coincidences(fit, None)) == count


def test_the_deviation_of_a_tie_is_reported_in_per_cent() -> None:
    cause = CommonCause('link_radius', 1.0, 1e-3)
    assert '(2 ± 1 %)' in Tie(0.02, 0.0149, True, (cause,)).sentence


def test_a_stiffness_without_a_deviation_is_the_half_of_no_tie() -> None:
    without = dataclasses.replace(named(stiffness('torsional', -0.04), 1e-5), sd={})
    assert ties([named(stiffness('bending', -0.04), 1e-5), without]) == ()
