# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The laws of the blind suite: drawn as stated, scored as stated, and a short form of the campaign."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from blind import law_forms
from blind.cases import designs, gap_of
from blind.laws import drawn, evaluated, observe, sized, summary
from psd_deflection.studies.discover.laws.laws import find_law
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace

pytestmark = pytest.mark.slow


def test_laws_are_drawn_over_stages_and_forms_and_each_is_its_own() -> None:
    laws = drawn(40, 24)
    assert drawn(40, 24) == laws
    assert {law['name'] for law in laws} == {f'law_{s}' for s in law_forms.OF_STAGE}
    assert len({law['form'] for law in laws}) >= 10
    assert len({str(law) for law in laws}) == 24
    for law in laws:
        assert law['form'] in law_forms.OF_STAGE[law['name'].removeprefix('law_')]
        assert law_forms.truth_of(law)['variables']


@pytest.mark.parametrize('stage', law_forms.OF_STAGE)
def test_each_form_of_a_stage_changes_the_readings(stage: str) -> None:
    t = np.arange(5000) / 5000.0
    known = {n: np.sin(7.0 * t) * full for n, full in law_forms.FULL.items()}
    for form in law_forms.OF_STAGE[stage]:
        law = {**law_forms.draw(3, stage, form), 'times': [0.2, 0.5] if 'events' in form else []}
        if form != 'jitter':
            out = law_forms.added(law, known, t, 1.0 / 5000.0)
            assert np.all(np.isfinite(out)), form
            assert np.ptp(out) > 0.01, form


def test_a_law_has_the_gap_it_says() -> None:
    law = sized(next(law for law in drawn(40, 12) if law['name'] == 'law_psd'))
    assert gap_of(designs('one'), law) == pytest.approx(law['gap'], rel=0.1)


def reported(**law: Any) -> dict[str, Any]:
    full = {'stage': 'psd', 'variables': ['x1'], 'kind': 'static', 'expression': '', 'heldout_after': 2.2e-7}
    message = {**full, 'equivalent': [], **law}
    gap = {'floor': 2e-7, 'heldout_after': 1e-6}
    return {'verdict': 'unknown_effect', 'effects': [], 'setup': [], 'unknown': [{'law': message}], 'gap': gap}


def test_an_answer_is_right_if_the_law_or_one_that_ties_is() -> None:
    truth = {**law_forms.draw(1, 'psd', 'cube'), 'of': ['x1'], 'gap': 9.0}
    row = evaluated(truth, reported())
    assert (row['stage'], row['variables'], row['kind'], row['set']) == (True, True, True, 1)
    assert row['floors'] == pytest.approx(1.1)
    tie = {'stage': 'psd', 'variables': ['x1']}
    row = evaluated(truth, reported(stage='optics', variables=['y1'], equivalent=[tie]))
    assert (row['stage'], row['stage_alone'], row['variables'], row['variables_alone']) == (True, False, True, False)
    row = evaluated(truth, {**reported(), 'unknown': [{'law': None}]})
    assert (row['stage'], row['variables'], row['law'], row['floors']) == (False, False, None, pytest.approx(5.0))
    assert evaluated(None, reported())['alarm']
    assert not evaluated(None, {**reported(), 'unknown': []})['alarm']


def test_a_law_that_never_acts_is_drawn_anew() -> None:
    law = next(law for law in drawn(396, 12) if law['number'] == 400)
    assert gap_of(designs('one'), sized(law)) == pytest.approx(law['gap'], rel=0.1)


def test_a_dot_that_jumps_may_be_reported_as_jumps_of_its_detector() -> None:
    truth = {**law_forms.draw(1, 'optics', 'events'), 'where': 'x2', 'times': [5.4, 9.0], 'gap': 9.0}
    found = [{'name': 'jump', 'where': 'psd_2', 'value': t} for t in (9.002, 5.399)]
    nothing = {**reported(), 'unknown': [], 'verdict': 'nothing_missing'}
    row = evaluated(truth, {**nothing, 'setup': found})
    assert (row['stage'], row['variables'], row['stage_alone'], row['jumps']) == (True, True, False, True)
    wrong = [
        [],
        found[:1],
        [*found, found[0]],
        [found[0], {**found[1], 'where': 'psd_1'}],
        [found[0], {**found[1], 'value': 5.3}],
    ]
    for message in wrong:
        row = evaluated(truth, {**nothing, 'setup': message})
        assert (row['stage'], row['variables'], row['jumps']) == (False, False, False)
    for other in ({'where': 'load_fx'}, {'form': 'gain_events'}):
        assert not evaluated({**truth, **other}, {**nothing, 'setup': found})['jumps']


def test_a_law_that_acts_under_one_load_only_may_be_reported_as_another_load() -> None:
    truth = next(law for law in drawn(1400, 12) if law['number'] == 1410)
    truth = {**truth, 'size': 0.5}
    found = [{'name': 'load_value', 'where': 'load 6', 'value': [30.0, 0.57, 0.0]}]
    nothing = {**reported(), 'unknown': [], 'verdict': 'nothing_missing'}
    row = evaluated(truth, {**nothing, 'setup': found})
    assert (row['stage'], row['variables'], row['stage_alone'], row['note']) == (True, True, False, True)
    # Under forces along y it acts at five of the annotated loads.
    several = {**truth, 'of': ['load_fy'], 'where': 'load_fx', 'at': 0.1, 'sign': -1.0}
    for law, message in (
        (truth, []),
        (truth, found * 2),
        (truth, [{**found[0], 'where': 'load 7'}]),
        (several, found),
    ):
        row = evaluated(law, {**nothing, 'setup': message})
        assert (row['stage'], row['note']) == (False, False)
    assert not evaluated(truth, {**reported(stage='psd'), 'setup': found})['note']


def test_a_threshold_that_is_missed_is_reported() -> None:
    truth = {**law_forms.draw(1, 'psd', 'cube'), 'of': ['x1'], 'gap': 9.0}
    good = {**evaluated(truth, reported()), 'seconds': 1.0}
    assert summary([good] * 10) == (summary([good] * 10)[0], True)
    assert not summary([good] * 8 + [{**good, 'stage': False}] * 2)[1]
    assert not summary([good] * 7 + [{**good, 'floors': 1.3}] * 3)[1]
    text, passed = summary([good, {'alarm': True}])
    assert not passed
    assert 'MISS laws where nothing is missing: 1/1' in text


def test_a_drawn_law_is_found_on_its_stage_with_its_variables() -> None:
    law = next(law for law in drawn(40, 12) if law['name'] == 'law_link')
    truth = law_forms.truth_of(law)
    ws = Workspace(observe(sized(law), 40))
    null = refit(ws, ())
    excess = 0.5 * (null.chi2 - ws.size)
    rng = np.random.default_rng(0)
    found = find_law(ws, null, null, float(np.log(ws.effective_size())), excess, rng, lambda _: None)
    assert found is not None
    assert truth['stage'] in {found.law.stage, *(e.stage for e in found.equivalent)}
    assert sorted(found.law.variables) == truth['variables']
    assert found.heldout_gap < 1.2 * ws.floor()
