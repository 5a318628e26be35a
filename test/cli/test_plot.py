# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.cli.main import main
from psd_deflection.cli.recordings.plot import Drawn
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.records import FloatArray

BAGS = Path(__file__).parent.parent.parent / 'bags'


def content_of(page: Path) -> dict[str, Any]:
    """The data in an interactive page."""
    found = re.search(r'<script type="application/json" id="recording">(.*?)</script>', page.read_text(), re.S)
    assert found is not None
    content: dict[str, Any] = json.loads(found[1])
    return content


def column(text: str, kind: str = '<f4') -> FloatArray:
    return np.frombuffer(base64.b64decode(text), kind).astype(np.float64)


def test_the_page_is_whole(tmp_path: Path) -> None:
    out = tmp_path / 'page.html'
    assert main(['plot', str(BAGS / 'laser_off'), '--out', str(out)]) == 0
    page = out.read_text()
    assert not re.search(r'(src|href)="(?!#)|\bimport\b[^(;]*from|@import|url\(', page)
    assert 'laser lost' in page
    assert '52 blocks' in page
    assert re.findall(r'<div id="plot_(\w+)">', page) == ['shift', 'theta', 'sums', 'spectrum']
    recorded = open_recording(BAGS / 'laser_off').estimates()['/link_tip/deflection']
    columns = content_of(out)['columns']
    dx, t = column(columns['dx']), column(columns['t'], '<f8')
    assert (len(dx), np.isnan(dx).sum()) == (200, 52)
    assert dx[~np.isnan(dx)] == pytest.approx(recorded.pose[:, 0], rel=1e-6)
    assert t[~np.isnan(dx)] == pytest.approx((recorded.t_ns - recorded.t_ns[0]) / 1e9, abs=1e-9)


def test_a_name_that_is_markup_is_text(tmp_path: Path) -> None:
    recording = tmp_path / '<b>&"x".csv'
    assert main(['convert', str(BAGS / 'clean'), '--out', str(tmp_path / 'run.csv')]) == 0
    (tmp_path / 'run.csv').rename(recording)
    out = tmp_path / 'page.html'
    assert main(['plot', str(recording), '--out', str(out)]) == 0
    assert '<b>' not in out.read_text()
    assert '&lt;b&gt;&amp;&quot;x&quot;.csv</title>' in out.read_text()


@pytest.fixture(scope='module')
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds at rest, then two load cases of a second, with the true pose beside."""
    out = tmp_path_factory.mktemp('loaded') / 'run'
    loads = 'steps:0,0,0;0,0,0;0,-10,-5.85;10,0,0:1'
    assert main(['simulate', '--out', str(out), '--loads', loads, '--reference']) == 0
    return out


def test_losses_and_missing_estimates_are_marked() -> None:
    recording = open_recording(BAGS / 'lost_samples')
    drawn = Drawn(recording)
    for records in replayed(recording, Pipeline(rig_at_start(recording)), recording.blocks()):
        for record in records:
            drawn.add(record)
    # As `info` and `replay` count them.
    assert drawn.gone() == 175
    table = drawn.table()
    t, dx = table['t'], table['dx']
    assert (t[1:] > t[:-1]).all()
    # Blocks 100 to 106 are gone: the line is broken there, at their own times.
    gone = t[(dx != dx) & (table['lost'] != table['lost'])]
    assert gone.tolist() == pytest.approx([100 * 0.02, 106 * 0.02], abs=1e-3)
    # Block 50 has too few samples.
    assert t[(dx != dx) & (table['lost'] > 0)].tolist() == pytest.approx([50 * 0.02], abs=1e-3)


@pytest.mark.parametrize(
    ('arguments', 'status', 'reported'),
    [
        (['no_such'], 4, 'no such recording'),
        ([str(BAGS / 'clean'), '--from', '2', '--to', '1'], 2, '--from 2.0 --to 1.0: must rise'),
        ([str(BAGS / 'clean'), '--from', 'mark:x'], 4, 'it has no marks'),
        ([str(BAGS / 'clean'), '--from', '9'], 4, 'has no samples to draw between --from and --to'),
        ([str(BAGS / 'clean'), '--out', 'x.bmp'], 2, 'the name must end in'),
        ([str(BAGS / 'clean'), '--out', '/no/such/folder/x.html'], 4, 'cannot be written'),
        ([str(BAGS / 'clean'), '--out', '/no/such/folder/x.png'], 4, 'cannot be written'),
    ],
)
def test_an_undrawable_recording_gives_one_line(
    arguments: list[str], status: int, reported: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['plot', *arguments]) == status
    err = capsys.readouterr().err
    assert reported in err
    assert err.strip().count('\n') == 0
