# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings and estimates answer what Python's own things answer: length, duration, start, columns, times of day."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import psd_deflection
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.studies.study import opened
from tools.program import ROOT

CLEAN = ROOT / 'bags' / 'clean'


def test_a_recording_has_length_duration_and_start() -> None:
    recording = psd_deflection.open(CLEAN)
    assert recording
    assert 'samples' not in recording.__dict__
    assert (len(recording), recording.start) == (4000, datetime(2026, 1, 1, tzinfo=UTC))
    assert recording.duration == pytest.approx(3.999)
    assert (recording['x1'] == recording.samples['x1']).all()
    with pytest.raises(KeyError, match="no column 'x3'; there are t, seq, t_ns, x1"):
        recording['x3']


def test_times_that_do_not_count_from_the_epoch_have_no_start() -> None:
    assert psd_deflection.simulate(None, (0, 0, 0), seconds=0.1).start is None


def test_estimates_have_duration_columns_and_times_of_day() -> None:
    estimates = psd_deflection.replay(CLEAN)
    assert estimates.duration == pytest.approx(3.98)
    assert (estimates['dx'] == estimates.dx).all()
    with pytest.raises(KeyError, match="no column 'dz'"):
        estimates['dz']
    times = estimates.to_pandas(clock=True).index
    assert (times.view(np.int64) == estimates.t_ns).all()
    assert str(times.tz) == 'UTC'


@pytest.mark.parametrize(
    ('recording', 'rig', 'words'),
    [
        ('bag', None, 'the parameters in the recording'),
        ('csv', None, 'the nominal rig: there is none in the recording'),
        ('csv', 'file', str(ROOT / 'config' / 'thesis_rig.yaml')),
        ('csv', 'object', 'the rig that was given'),
    ],
)
def test_an_answer_names_where_its_rig_is_from(tmp_path: Path, recording: str, rig: str | None, words: str) -> None:
    path = CLEAN
    if recording == 'csv':
        path = tmp_path / 'a.csv'
        rows = [f'{i * 1e-3:.3f},0,0,5,0,0,5' for i in range(40)]
        path.write_text('\n'.join(['t,x1,y1,sum1,x2,y2,sum2', *rows]))
    given = {None: None, 'file': ROOT / 'config' / 'thesis_rig.yaml', 'object': psd_deflection.load_rig()}[rig]
    assert opened(open_recording(path), given, notify=lambda _: None).sources['rig'] == words
