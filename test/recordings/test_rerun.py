# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings for Rerun, without Rerun: what is written row by row, and what is told where it is missing.

``make demo NAME=rerun`` reads the files with Rerun's own reader and looks at its picture.
"""

import itertools
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

import psd_deflection
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.write.rerun_writer import POSE, RerunFile, Row
from psd_deflection.records import SpotMeans

BAGS = Path(__file__).parent.parent.parent / 'bags'
FIND = 'psd_deflection.recordings.write.rerun_writer.importlib.util.find_spec'


@pytest.fixture
def no_rerun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FIND, lambda name: None)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """What takes every call, in rerun's place, be rerun installed or not."""
    rerun = MagicMock()
    monkeypatch.setattr(FIND, lambda name: object())
    monkeypatch.setitem(sys.modules, 'rerun', rerun)
    monkeypatch.setitem(sys.modules, 'rerun.blueprint', rerun.blueprint)
    return rerun


def rows_of(name: str, out: Path, moved_ns: int = 0) -> dict[str, list[tuple[int, Row]]]:
    """``moved_ns``: a step of the time map before block 20."""
    recording = psd_deflection.open(BAGS / name)
    rig = rig_at_start(recording)
    sink = RerunFile(out, rig)
    for records in replayed(recording, Pipeline(rig)):
        for record in records:
            if isinstance(record, SpotMeans) and record.index >= 20:
                record = replace(record, t_ns=record.t_ns + moved_ns)
            sink.put(record)
    return sink._rows


@pytest.mark.usefixtures('no_rerun')
@pytest.mark.parametrize('command', ['convert', 'replay'])
@pytest.mark.parametrize('name', ['a.rrd', 'a.RRD'])
def test_without_rerun_the_error_says_how_to_install_it(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / name
    assert main([command, str(BAGS / 'clean'), '--out', str(out)]) == 3
    err = capsys.readouterr().err
    assert 'pip install rerun-sdk' in err
    assert "pip install 'psd_deflection[rerun]'" in err
    assert err.strip().count('\n') == 0
    assert not out.exists()


@pytest.mark.usefixtures('stand_in')
def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'a.rrd').write_text('mine')
    assert main(['convert', str(BAGS / 'clean'), '--out', str(tmp_path / 'a.rrd')]) == 4
    assert 'exists already' in capsys.readouterr().err
    assert (tmp_path / 'a.rrd').read_text() == 'mine'
    assert main(['convert', str(BAGS / 'clean'), '--out', str(tmp_path / 'no' / 'a.rrd')]) == 4
    assert 'cannot be made' in capsys.readouterr().err


def test_disk_that_rejects_is_one_line(stand_in: MagicMock, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stand_in.RecordingStream.return_value.flush.side_effect = RuntimeError('File-writer thread shut down')
    assert main(['convert', str(BAGS / 'clean'), '--out', str(tmp_path / 'a.rrd')]) == 4
    assert 'a.rrd: cannot be written (File-writer thread shut down)' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures('stand_in')
@pytest.mark.parametrize('name', ['clean', 'lost_samples', 'laser_off'])
def test_every_estimate_and_no_other_is_written(name: str, tmp_path: Path) -> None:
    rows = rows_of(name, tmp_path / 'a.rrd')
    recorded = psd_deflection.open(BAGS / name).estimates()['/link_tip/deflection_with_covariance']
    assert recorded.covariance is not None
    for i, (entity, _, _, scale, _) in enumerate(POSE):
        written = [(t, row) for t, row in rows[f'tip/{entity}'] if row is not None]
        assert [t for t, _ in written] == recorded.t_ns.tolist()
        # Another machine's last bits may differ.
        assert np.allclose([row[0] for _, row in written], recorded.pose[:, i] * scale, rtol=1e-9, atol=1e-9)
        sd = 2.0 * np.sqrt(recorded.covariance[:, i, i]) * scale
        low, high = np.array([row for _, row in rows[f'tip/{entity}/band'] if row is not None]).T
        assert np.allclose(high - low, 2.0 * sd)
    for path, of_entity in rows.items():
        times = [t for t, _ in of_entity]
        assert all(a < b for a, b in itertools.pairwise(times)), path


@pytest.mark.usefixtures('stand_in')
def test_a_loss_breaks_every_line(tmp_path: Path) -> None:
    rows = rows_of('lost_samples', tmp_path / 'a.rrd')
    start = rows['lost'][0][0]
    breaks = [(t - start) / 2e7 for t, row in rows['tip/dx'] if row is None]
    # bags/make.py: block 50 has too few samples, blocks 100 to 106 are gone.
    assert breaks == pytest.approx([50.0, 100.0], abs=0.01)
    assert [(t - start) / 2e7 for t, row in rows['psd_1/plane/dot'] if row is None] == pytest.approx([100.0], abs=0.01)
    assert [row is None for _, row in rows['rig/tip/plate']] == [False, True, False, True, False]
    lost = {round((t - start) / 2e7): row for t, row in rows['lost']}
    assert (lost[100], lost[106]) == ((20,), (20,))
    assert 101 not in lost


@pytest.mark.usefixtures('stand_in')
@pytest.mark.parametrize('moved_ns', [15_000_000, -19_999_000])
def test_a_step_of_the_time_map_breaks_every_line(moved_ns: int, tmp_path: Path) -> None:
    rows = rows_of('clean', tmp_path / 'a.rrd', moved_ns)
    for path in ('tip/dx', 'psd_2/plane/dot', 'rig/link', 'sums/psd_1'):
        breaks = [t - rows['lost'][0][0] for t, row in rows[path] if row is None]
        assert breaks == pytest.approx([19.5 * 2e7 + moved_ns / 2], abs=1e4), path
    assert None not in [row for _, row in rows['lost']]


def test_times_of_a_csv_are_since_its_start(stand_in: MagicMock, tmp_path: Path) -> None:
    assert main(['convert', str(BAGS / 'clean'), '--out', str(tmp_path / 'a.csv')]) == 0
    text = (tmp_path / 'a.csv').read_text().splitlines()
    cut = [line.partition('.')[2] for line in text[1:500]]
    (tmp_path / 'b.csv').write_text('\n'.join([text[0], *('1.' + line for line in cut)]) + '\n')
    assert main(['convert', str(tmp_path / 'b.csv'), '--out', str(tmp_path / 'b.rrd')]) == 0
    kinds = {kind for call in stand_in.TimeColumn.call_args_list for kind in call.kwargs}
    assert kinds == {'duration'}


def test_it_ends_once(stand_in: MagicMock, tmp_path: Path) -> None:
    sink = RerunFile(tmp_path / 'a.rrd', rig_at_start(psd_deflection.open(BAGS / 'clean')))
    sink.close()
    sink.close()
    stand_in.RecordingStream.return_value.disconnect.assert_called_once_with()
