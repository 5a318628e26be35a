# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Many loads that nobody noted: check, calibrate and discover tell it in the same words, and leave their time out."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.loads.effective import effective_loads
from psd_deflection.studies.loads.plateaus import Plateau, PlateauLoads
from psd_deflection.studies.loads.unannotated import unannotated_times
from test.studies.held_loads import RIG, answers, read

LEVELS = np.array(
    [
        *[(0, 0, 0), (30, 0, 0), (0, -50, -29), (0, 0, 0)],
        *[(40, -40, 20), (0, -30, 0), (25, 10, -10), (10, 0, 0), (0, -40, 10), (15, 0, 0), (0, -9, 0), (0, -45, 0)],
    ],
    float,
)
DWELL = 2000
HELD = np.repeat(LEVELS, DWELL, axis=0)
ROTATED = {'effects__e__name': 'sensor_rotation', 'effects__e__psd': 1, 'effects__e__angle': 0.02}
WORDS = 'nobody noted it: note each change; this time is left out'


STOPPED = HELD.copy()
STOPPED[4 * DWELL :] = 0.0
"""Somebody noted nothing any more after the second load was taken off."""
VOLTS = read(HELD)


@pytest.mark.slow
def test_check_calibrate_and_discover_say_the_same() -> None:
    words = f'x: from 8.000 s to the end the load changed 8 times, and {WORDS}'
    checked, known, log, found = answers(VOLTS, STOPPED)
    # The loads that are left move all readings, but none of them along Y alone.
    reported, pushes = checked.findings
    assert (reported.name, reported.where, reported.fix) == ('load_coverage', 'load_fx load_fy load_tz', words)
    assert (pushes.name, pushes.where) == ('load_coverage', 'fy tz')
    assert checked.verdict == 'wrong'
    assert f'load_fx load_fy load_tz: not seen: {words}' in checked.sentences()
    assert log == [words]
    assert np.isnan(known.volts[8_000:]).all()
    assert np.isfinite(known.volts[:8_000]).all()
    (reported,) = found.setup
    assert (reported.name, reported.fix) == ('load_coverage', words)
    assert reported.value == pytest.approx(16 / 24)
    assert found.verdict == 'nothing_missing'
    assert found.simulations <= 300


@pytest.mark.slow
def test_an_effect_beside_loads_that_were_not_noted_is_named() -> None:
    found = discover([Observation('x', RIG, read(HELD, **ROTATED), STOPPED)])
    assert [f.name for f in found.setup] == ['load_coverage']
    assert [e.active.effect.name for e in found.effects] == ['sensor_rotation']
    assert found.effects[0].active.values['angle'] == pytest.approx(0.02, abs=4.0 * found.effects[0].sd['angle'])
    assert found.verdict == 'effects_found'


def test_missing_loads_are_excluded_until_next_note() -> None:
    annotated = HELD.copy()
    annotated[2 * DWELL : 10 * DWELL] = LEVELS[1]
    effective = effective_loads(RIG, VOLTS, annotated)
    assert [n.words('x') for n in effective.notes] == [
        f'x: from 4.000 s to 20.000 s the load changed 8 times, and {WORDS}'
    ]
    gone = np.flatnonzero(np.isnan(effective.volts).all(axis=1))
    assert (gone[0], gone[-1], len(gone)) == (4000, 19_999, 16_000)
    np.testing.assert_array_equal(effective.loads, annotated)


@pytest.mark.slow
def test_two_loads_that_were_not_noted_are_reported_one_by_one() -> None:
    annotated = HELD.copy()
    annotated[2 * DWELL : 4 * DWELL] = LEVELS[1]
    effective = effective_loads(RIG, VOLTS, annotated)
    assert [n.name for n in effective.notes] == ['missing_load', 'missing_load']
    assert np.isfinite(effective.volts).all()


@pytest.mark.slow
def test_a_recording_without_any_noted_load_stays_as_it_is() -> None:
    effective = effective_loads(RIG, VOLTS, np.zeros_like(HELD))
    assert not effective.notes
    assert np.isfinite(effective.volts).all()


def asked(more: list[float], *, alone: int, across: float = 0.0, annotated: float = 10.0) -> PlateauLoads:
    """Plateaus of 2 s under one annotated load; all but the first ``alone`` are unnoted. ``more``: N along Y."""
    rows = np.array([(0.0, y, 0.0) for y in more])
    listed = tuple(
        Plateau(0, 2000 * i, 2000 * (i + 1), 1, i >= alone, np.array((0.0, annotated, 0.0))) for i in range(len(more))
    )
    other = Plateau(0, 2000 * len(more), 2000 * len(more) + 2000, 2, False, np.array((0.0, 20.0, 0.0)))
    nothing = np.zeros((3, 0))
    return PlateauLoads(
        (*listed, other),
        np.vstack((rows, np.zeros((1, 3)))),
        nothing,
        nothing,
        np.zeros(0),
        np.array([across] * len(more) + [0.0]),
        np.array((4e-5, 4e-5, 6e-5)),
        4,
    )


def test_change_counts_above_three_times_allowed_effects() -> None:
    """That is 0.3 N and 1 % of the largest load, which is 20 N: 1.5 N in all."""
    (found,) = unannotated_times(asked([0.0, 1.6, 0.0, 1.6], alone=1), 20_000, 0.001)
    assert (found.first, found.last, found.changes) == (2000, 8000, 3)
    assert found.value == found.size == pytest.approx(0.3)
    assert unannotated_times(asked([0.0, 1.4, 0.0, 1.4], alone=1), 20_000, 0.001) == []


def test_two_changes_are_too_few_and_noted_ones_do_not_count() -> None:
    assert unannotated_times(asked([0.0, 9.0, 0.0], alone=1), 20_000, 0.001) == []
    assert unannotated_times(asked([0.0, 9.0, 0.0, 9.0], alone=2), 20_000, 0.001) == []
