# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The cases of the blind suite as files, and the score of any tool's answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from blind import given
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
