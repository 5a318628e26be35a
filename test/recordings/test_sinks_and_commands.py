"""Sinks by name, ``psd-deflection info`` and ``psd-deflection convert``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from psd_deflection.cli.main import main
from psd_deflection.config import load_rig
from psd_deflection.recordings.bag_writer import BagWriter, McapFile
from psd_deflection.recordings.csv_writer import CsvEstimateSink
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.sinks import open_sink
from psd_deflection.records import SampleBlock

from .making import T0, block, run

HELLO = {'serial': 'A1', 'sample_rate_hz': 1000}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    rig = load_rig(None, {'sum_min': 1.5})
    with BagWriter(tmp_path / 'run', rig_values=rig.values, device_hello=HELLO) as out:
        for r in run(60):
            out.put(r)
    return tmp_path / 'run'


@pytest.mark.parametrize(
    ('name', 'kind'), [('e.csv', CsvEstimateSink), ('a.MCAP', McapFile), ('a', BagWriter), ('a.b', BagWriter)]
)
def test_the_name_says_which_sink(tmp_path: Path, name: str, kind: type[object]) -> None:
    sink = open_sink(tmp_path / name, rig_values={}, solvers=['exact', 'wls'])
    assert type(sink) is kind
    for record in run(3):
        sink.put(record)
    sink.close()
    sink.close()
    assert (tmp_path / name).exists()


def test_info_says_what_is_in_it(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(bag), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found['samples'], found['lost'], found['blocks'], found['flagged']) == (1182, 18, 60, 9)
    assert found['duration_s'] == pytest.approx(1.199)
    assert found['sample_rate_hz'] == pytest.approx(1000.0)
    assert found['device_hello'] == HELLO
    assert found['changed_parameters'] == {'sum_min': 1.5}
    assert found['topics']['/psd/samples'] == 60
    assert found['complete'] is True
    assert main(['info', str(bag)]) == 0
    text = capsys.readouterr().out
    for part in ('complete', '18 lost', 'serial A1', 'sum_min = 1.5', '/link_tip/wls/deflection', '2025-10-09'):
        assert part in text


def test_info_reads_a_cut_file_and_says_so(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag / 'run_0.mcap'
    path.write_bytes(path.read_bytes()[:-3000])
    assert main(['info', str(path)]) == 0
    text = capsys.readouterr().out
    assert 'INCOMPLETE' in text
    assert 'before its end' in text


def test_info_of_what_has_no_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    BagWriter(tmp_path / 'empty', rig_values={}).close()
    assert main(['info', str(tmp_path / 'empty')]) == 0
    text = capsys.readouterr().out
    for part in (
        'samples      none',
        'lacks        samples (/psd/samples)',
        ' parameters: the nominal',
        'what the device says of itself',
        ' known loads',
    ):
        assert part in text
    assert main(['info', str(tmp_path / 'empty'), '--json']) == 0
    assert len(json.loads(capsys.readouterr().out)['lacks']) == 5


def test_info_takes_the_rate_over_the_whole_and_a_pause_for_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The clock's map settles in the first second, and the device was off for two seconds on the way.
    with BagWriter(tmp_path / 'run', rig_values={'block_size': 20}) as bag:
        for i in range(200):
            whole = block(i, t0=T0 + (2_000_000_000 if i >= 100 else 0))
            late = np.clip(1_000_000 - whole.seq * 1000, 0, None)
            bag.put(SampleBlock(i, whole.seq, whole.t_ns - late, whole.volts, whole.flags))
    assert main(['info', str(tmp_path / 'run'), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert open_recording(tmp_path / 'run').sample_rate_hz == pytest.approx(999.0, rel=1e-4)
    assert found['sample_rate_hz'] == pytest.approx(1000.0, rel=3e-4)
    assert found['lost'] == 0


def test_an_unreadable_recording_is_status_4_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(tmp_path / 'none.csv')]) == 4
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'no such recording' in said


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


def test_importing_the_package_is_light() -> None:
    code = 'import sys, psd_deflection; print([m for m in ("numpy", "mcap", "yaml") if m in sys.modules])'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'
