# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection convert``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from psd_deflection.cli.main import main
from psd_deflection.recordings.read.readers import open_recording
from test.recordings.making import HELLO, write_bag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / 'run', {'sum_min': 1.5})


def test_convert_there_and_back_keeps_every_bit(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source, target in (('run', 'a.csv'), ('a.csv', 'again'), ('again', 'b.mcap'), ('b.mcap', 'b.csv')):
        assert main(['convert', str(tmp_path / source), '--out', str(tmp_path / target)]) == 0
    capsys.readouterr()
    first = open_recording(bag)
    for name in ('a.csv', 'again', 'b.mcap', 'b.csv'):
        other = open_recording(tmp_path / name)
        for column in ('t_ns', 'seq', 'x1', 'y1', 'sum1', 'x2', 'y2', 'sum2'):
            np.testing.assert_array_equal(other.samples[column], first.samples[column])
        assert other.loads() == first.loads()
        assert other.temperatures() == first.temperatures()
        np.testing.assert_allclose(other.references(), first.references(), rtol=1e-15)
    with Reader(tmp_path / 'again') as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == open_recording(tmp_path / 'again').topics()
    assert main(['convert', str(bag), '--out', str(tmp_path / 'a.csv')]) == 4
    assert 'exists already' in capsys.readouterr().err


def test_convert_notes_the_rig_that_it_is_given(bag: Path, tmp_path: Path) -> None:
    (tmp_path / 'rig.yaml').write_text('/**:\n  ros__parameters:\n    sum_min: 0.5\n')
    assert main(['convert', str(bag), '--out', str(tmp_path / 'a.mcap')]) == 0
    assert open_recording(tmp_path / 'a.mcap').parameters['sum_min'] == 1.5
    assert open_recording(tmp_path / 'a.mcap').hello == HELLO
    out = str(tmp_path / 'b.mcap')
    assert main(['convert', str(bag), '--out', out, '--params-file', str(tmp_path / 'rig.yaml')]) == 0
    assert open_recording(out).parameters['sum_min'] == 0.5
