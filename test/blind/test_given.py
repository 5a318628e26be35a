# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The cases of the blind suite as files, and the score of any tool's answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from blind import given, run, score
from blind.cases import Case
from blind.run import observe, seal
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow

CASE = Case('mistake-sensitivity-0-7', 'mistake', 'one', (), mistake=('sensitivity', 0.5))


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('suite')
    seal([CASE], out)
    assert given.given((CASE, str(out / 'sealed' / f'{CASE.key}.json'), str(out / 'cases'))) == CASE.key
    return out


def test_a_case_as_files_is_what_discover_was_given(folder: Path) -> None:
    (observed,) = observe(CASE, [])
    at = folder / 'cases' / CASE.key
    assert json.loads((at / 'case.json').read_text()) == {'recordings': ['recording_1'], 'without': []}
    rows = np.genfromtxt(at / 'recording_1.csv', delimiter=',', names=True)
    there = np.isfinite(observed.volts).all(axis=1)
    assert len(rows) == there.sum()
    read = np.column_stack([rows[name] for name in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')])
    np.testing.assert_allclose(read, observed.volts[there], atol=1e-9)
    held = np.column_stack([rows[name] for name in ('load_fx', 'load_fy', 'load_tz')])
    np.testing.assert_allclose(held, observed.loads[there], atol=1e-8)
    rig = load_rig(at / 'recording_1.yaml')
    assert rig.values == observed.rig.values
    assert rig.values != load_rig().values


def test_the_score_takes_an_answer_of_any_tool(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = folder / 'answers'
    answers.mkdir()
    message = {'setup': [{'name': 'sensitivity', 'where': 'amplifier.sensitivity', 'value': 0.5}]}
    (answers / f'{CASE.key}.json').write_text(json.dumps(message))
    assert run.main(['--score', '--out', str(folder)]) == 0
    assert 'ok    mistake of the set-up named, and nothing else: 100.0 % (1/1;' in capsys.readouterr().out
    (answers / f'{CASE.key}.json').write_text(json.dumps({**message, 'effects': [{'name': 'sensor_gain'}]}))
    assert run.main(['--score', '--out', str(folder)]) == 1
    shown = capsys.readouterr().out
    assert 'MISS  mistake of the set-up named, and nothing else: 0.0 % (0/1;' in shown
    assert f'{CASE.key}: truth nothing; effects_found: sensor_gain; gap nan -> nan' in shown
    assert run.main(['--score', '--out', str(folder), '--only', 'hand-']) == 0
    assert 'mistake of the set-up named, and nothing else: no cases' in capsys.readouterr().out


def test_what_an_answer_leaves_out_counts_as_nothing() -> None:
    assert score.complete({})['verdict'] == 'nothing_missing'
    assert score.complete({'effects': [{'name': 'a'}]})['effects'] == [
        {'name': 'a', 'equivalent': [], 'parameters': {}}
    ]
    assert score.complete({'effects': [{'name': 'a'}]})['verdict'] == 'effects_found'
    assert score.complete({'effects': [{'name': 'a'}], 'unknown': [{}]})['unknown'] == [{'law': None}]
    assert score.complete({'effects': [{'name': 'a'}], 'unknown': [{}]})['verdict'] == 'unknown_effect'
    full = {'verdict': 'unknown_effect', 'gap': {'floor': 1.0}, 'effects': [], 'unknown': []}
    assert score.complete(full)['gap'] == {'floor': 1.0}
    assert score.complete(full)['verdict'] == 'unknown_effect'
