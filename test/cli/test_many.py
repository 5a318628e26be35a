# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The commands that take many recordings: the same answers on every engine, failures listed, the rest done."""

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.cli import _fleet
from psd_deflection.cli.main import main
from psd_deflection.recordings.write.parquet import FAILED

pandas = pytest.importorskip('pandas')
parquet = pytest.importorskip('pyarrow.parquet')


@pytest.fixture(scope='module')
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short recordings with estimates, and a file that is none."""
    folder = tmp_path_factory.mktemp('made') / 'archive'
    folder.mkdir()
    for name, loads in (('one', 'ramp:0,0,0;0,-10,0:0.4'), ('two', 'ramp:0,0,0;0,-5,1:0.2')):
        assert main(['simulate', '--loads', loads, '--out', str(folder / f'{name}.mcap')]) == 0
    (folder / 'broken.csv').write_text('t,x1\n')
    return folder


@pytest.fixture
def archive(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to write in, with the recordings in ``archive``."""
    (tmp_path / 'archive').symlink_to(recordings)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def scheduler() -> Iterator[str]:
    """A Dask cluster of two workers, in threads of this process."""
    distributed = pytest.importorskip('distributed')
    options = {'n_workers': 2, 'threads_per_worker': 1, 'processes': False, 'dashboard_address': None}
    with distributed.LocalCluster(**options, protocol='tcp://', silence_logs=logging.ERROR) as cluster:
        yield 'dask://' + cluster.scheduler_address.removeprefix('tcp://')


@pytest.mark.slow
def test_each_engine_gives_the_serial_answer(archive: Path, scheduler: str, capsys: pytest.CaptureFixture[str]) -> None:
    stated: dict[str, tuple[str, bytes]] = {}
    for i, executor in enumerate(('serial', 'processes:1', scheduler)):
        out = archive / f'{i}.parquet'
        words = ['replay', 'archive/*', '--compare', '--json', '--executor', executor, '--out', str(out)]
        assert main(words) == 8
        reported = capsys.readouterr()
        assert reported.err.endswith('psd-deflection replay: 1 of 3 recordings failed; the others are done\n')
        stated[executor] = (reported.out, out.read_bytes())
    assert (stated['processes:1'], stated[scheduler]) == (stated['serial'], stated['serial'])
    rows = [json.loads(line) for line in stated['serial'][0].splitlines()]
    assert [Path(row['recording']).name for row in rows] == ['broken.csv', 'one.mcap', 'two.mcap']
    assert 'the header lacks' in rows[0]['error']
    assert [row['compared']['identical'] for row in rows[1:]] == [True, True]


def test_the_estimates_of_all_are_one_table(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', 'archive/*', '--out', 'all.parquet']) == 8
    assert 'failed' in capsys.readouterr().out
    frame = pandas.read_parquet('all.parquet')
    counts = frame.groupby('recording', observed=True).size()
    assert counts.to_dict() == {str(archive / 'archive' / 'one.mcap'): 20, str(archive / 'archive' / 'two.mcap'): 10}
    assert main(['replay', 'archive/one.mcap', '--out', 'one.csv']) == 0
    table = np.genfromtxt('one.csv', delimiter=',', names=True)
    rows = frame[frame.recording == str(archive / 'archive' / 'one.mcap')]
    for name in ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta'):
        assert np.array_equal(rows[name], table[name]), name
    schema = parquet.read_schema('all.parquet')
    assert schema.field('dx').metadata == {b'unit': b'm'}
    (failed,) = json.loads(parquet.read_metadata('all.parquet').metadata[FAILED.encode()]).items()
    assert failed[0] == str(archive / 'archive' / 'broken.csv')
    # A recording is never overwritten, nor is this.
    assert main(['replay', 'archive/*', '--out', 'all.parquet']) == 4


def test_what_differs_is_reported_of_each(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (archive / 'rig.yaml').write_text('/**:\n  ros__parameters:\n    amplifier: {sensitivity: 0.0006}\n')
    words = ['replay', 'archive/one.mcap', 'archive/two.mcap', '--compare', '--params-file', 'rig.yaml']
    assert (main(words), capsys.readouterr().out.count('DIFFERS')) == (1, 2)
    # A rig file that is wrong is so for all: nothing is begun.
    (archive / 'rig.yaml').write_text('/**:\n  ros__parameters:\n    amplifier: {sensitivity: -1.0}\n')
    assert main(words) == 3


def test_each_recording_is_calibrated_for_itself(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loads = 'steps:0,0,0;0,-10,-5.85;5,0,0;0,0,3:0.5'
    assert main(['simulate', '--reference', '--loads', loads, '--out', 'run.csv']) == 0
    words = ['calibrate', 'r*.csv', 'nowhere.csv', '--each', '--quiet']
    assert (main([*words, '--out', 'out']), [p.name for p in (archive / 'out').iterdir()]) == (8, ['run.csv'])
    files = {p.name: p for p in (archive / 'out' / 'run.csv').iterdir()}
    assert set(files) == {'calibration.json', 'report.html', 'rig.yaml'}
    assert main([*words, '--out', 'rows.parquet']) == 8
    frame = pandas.read_parquet('rows.parquet')
    assert frame.error.tolist() == ['', f'{archive}/nowhere.csv: no such recording']
    assert frame.result[0] == files['calibration.json'].read_text()
    for name, fitted in json.loads(frame.result[0])['parameters'].items():
        assert (frame[name][0], frame[f'sd {name}'][0]) == (fitted['value'], fitted['sd'])


def test_folders_are_those_of_the_archive(tmp_path: Path) -> None:
    names = ['/lab/a/run', '/lab/b/run', '/lab/b/run.csv']
    assert _fleet.folders_of(names, tmp_path) == {
        '/lab/a/run': tmp_path / 'a' / 'run',
        '/lab/b/run': tmp_path / 'b' / 'run',
        '/lab/b/run.csv': tmp_path / 'b' / 'run.csv',
    }
    assert _fleet.folders_of(['/lab/a/run'], tmp_path) == {'/lab/a/run': tmp_path / 'run'}
