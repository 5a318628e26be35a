# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The watch as a function: the alarms of ``replay --watch``, as a result that shows and writes itself."""

import json
from pathlib import Path

import numpy as np
import pytest

import psd_deflection
from psd_deflection.cli.main import main
from psd_deflection.recordings.recording import Recording

LOADS = 'steps:0,0,0;0,-10,0;0,0,0:12'


@pytest.fixture(scope='module')
def bumped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which a detector slips by 20 um at 18 s, under a load that is held."""
    path = tmp_path_factory.mktemp('watch') / 'bumped.csv'
    assert main(['simulate', '--out', str(path), '--loads', LOADS]) == 0
    head, *rows = path.read_text().splitlines()
    column = head.split(',').index('y1')
    moved = []
    for n, row in enumerate(rows):
        cells = row.split(',')
        if n >= 18_000:
            cells[column] = f'{float(cells[column]) + 0.04:.6f}'
        moved.append(','.join(cells))
    path.write_text('\n'.join([head, *moved]) + '\n')
    return path


def test_a_sound_rig_has_no_alarm() -> None:
    run = psd_deflection.simulate(None, (0, -10, -5.85), seconds=10)
    assert isinstance(run, Recording)
    watched = psd_deflection.watch(run)
    assert watched.alarms == ()
    assert watched.sentences()[0].startswith('the rig matches its model; watched: ')
    assert watched.tree()['same'] is True
    assert watched.to_pandas().empty
    assert 'the rig matches its model' in watched.report()


@pytest.mark.slow
@pytest.mark.filterwarnings('ignore:.*lacks its parameters')
def test_a_bump_is_reported_as_by_the_command(bumped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.errstate(all='raise'):
        watched = psd_deflection.watch(bumped, psd_deflection.load_rig())
    assert main(['replay', str(bumped), '--watch']) == 0
    message = [line for line in capsys.readouterr().out.splitlines() if line.startswith('  watch: ')]
    assert [f'  watch: {sentence}' for sentence in watched.sentences()] == message
    first = watched.alarms[0]
    assert watched.since_s(first) == pytest.approx(18.0, abs=1.0)
    table = watched.to_pandas()
    assert (table.index[0], table['channel'].iloc[0]) == (watched.since_s(first), first.channel)
    assert [path.name for path in watched.save(tmp_path / 'out')] == ['report.html', 'watch.json']
    tree = json.loads((tmp_path / 'out' / 'watch.json').read_text())
    assert tree['alarms'][0]['channel'] == first.channel
    assert first.channel in (tmp_path / 'out' / 'report.html').read_text()
