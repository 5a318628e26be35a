# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The laws of the blind suite: drawn as stated, scored as stated, and a short form of the campaign."""

from typing import Any

import pytest

from blind import law_forms
from blind.cases import designs, gap_of
from blind.laws import drawn, evaluated, sized

pytestmark = pytest.mark.slow


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
