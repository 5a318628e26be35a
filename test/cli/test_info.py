# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``info``, ``convert`` and ``plot``."""

import base64
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from psd_deflection.cli.main import main
from psd_deflection.cli.recordings.plot import Drawn
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.summary import summary
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import CLOCK_SQUEEZED, CLOCK_STEP, FloatArray, ParameterChange, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import ACQUISITION, MONITOR
from test.recordings.making import HELLO, STEP, T0, block, write_bag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / 'run', {'sum_min': 1.5})


def test_info_says_what_is_in_it(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(bag), '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    assert (tree['samples'], tree['lost'], tree['blocks'], tree['flagged']) == (1182, 18, 60, 9)
    assert tree['duration_s'] == pytest.approx(1.2)
    assert tree['sample_rate_hz'] == pytest.approx(1000.0)
    assert (tree['device_hello'], tree['changed_parameters']) == (HELLO, {'sum_min': 1.5})
    assert tree['topics']['/psd/samples'] == 60
    assert tree['complete'] is True
    assert main(['info', str(bag)]) == 0
    text = capsys.readouterr().out
    for part in ('complete', '18 lost', 'serial A1', 'sum_min = 1.5', '/link_tip/wls/deflection', '2025-10-09'):
        assert part in text


def test_info_says_what_another_rig_has_as_in_the_thesis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(write_bag(tmp_path / 'run', {'link.length': 0.4}))]) == 0
    assert 'dynamics.bending_frequency = 14.0 Hz' in capsys.readouterr().out
    assert main(['info', str(write_bag(tmp_path / 'thesis', {'sum_min': 1.5}))]) == 0
    assert 'as in the thesis rig' not in capsys.readouterr().out


def test_a_step_of_the_time_map_has_its_time_and_is_no_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three seconds come 1.5 s late; the 1500 samples that came then are 1 ns apart."""
    run = tmp_path / 'run'
    with BagWriter(run, rig_values={'block_size': 20}) as bag:
        for n in range(300):
            made = block(n)
            seq = made.seq
            late = np.select([seq < 3000, seq < 4500], [(seq + 1500) * STEP, 4499 * STEP + seq - 2999], seq * STEP)
            bag.put(SampleBlock(n, seq, T0 + late, made.volts, made.flags))
            if n == 225:
                bag.put(ParameterChange(T0 + 4519 * STEP, n, ((CLOCK_STEP, -1.5),)))
                bag.put(ParameterChange(T0 + 4519 * STEP, n, ((CLOCK_SQUEEZED, 1500.0),)))
    assert main(['info', str(run)]) == 0
    shown = capsys.readouterr().out
    assert '1, the largest at 3.019 s by -1500.0 ms: stamps before it are off by as much' in shown
    assert '1500 samples have stamps 1 ns apart after a step back' in shown
    for since in ('0', '2.5', '3.0'):
        assert main(['replay', str(run), '--from', since]) in (0, 1)
        shown = ''.join(capsys.readouterr())
        assert 'samples' in shown
        assert 'samples a second' not in shown


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
    parts = ('samples      none', 'lacks        samples (/psd/samples)', ' parameters: the rig of the thesis')
    for part in (*parts, 'what the device says of itself', ' known loads'):
        assert part in text
    assert main(['info', str(tmp_path / 'empty'), '--json']) == 0
    assert len(json.loads(capsys.readouterr().out)['lacks']) == 5


def test_times_of_marks_and_changes_count_from_the_start(
    bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def part(*given: Any) -> dict[str, Any]:
        """As of a part that begins within the block of its mark."""
        tree = summary(*given)
        moved = {'t_ns': tree['start_ns'] + 40_000_000, 'block': 200, 'values': {'state.a': 1.0}}
        before = {'t_ns': tree['start_ns'] - 1, 'block': 190, 'values': {'psd_1.noise': 0.1}}
        return {**tree, 'marks': [{'t_s': -1e-5, 'text': 'on'}], 'changes': [before, moved]}

    monkeypatch.setattr('psd_deflection.cli.recordings.info.summary', part)
    assert main(['info', str(bag)]) == 0
    text = capsys.readouterr().out
    assert 'marks            0.000 s  on' in text
    assert '  at the start: psd_1.noise = 0.1\n' in text
    assert 'from 0.040 s on: 1 values that the estimator remembered, for a replay' in text


def test_info_takes_the_rate_over_the_whole_and_a_pause_for_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The clock's map settles in the first second, and the device was off for two seconds on the way.
    with BagWriter(tmp_path / 'run', rig_values={'block_size': 20}) as bag:
        for i in range(200):
            integer = block(i, t0=T0 + (2_000_000_000 if i >= 100 else 0))
            late = np.clip(1_000_000 - integer.seq * 1000, 0, None)
            bag.put(SampleBlock(i, integer.seq, integer.t_ns - late, integer.volts, integer.flags))
    assert main(['info', str(tmp_path / 'run'), '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    assert open_recording(tmp_path / 'run').sample_rate_hz == pytest.approx(999.0, rel=1e-4)
    assert tree['sample_rate_hz'] == pytest.approx(1000.0, rel=3e-4)
    assert tree['lost'] == 0


def test_only_recorded_parameters_are_reported_as_defaults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    every = load_rig().flat()
    links = {k: v for k, v in every.items() if k.startswith('link.')}
    running = {p.name for section in (ACQUISITION, MONITOR) for p in section.parameters.values()}
    rig = {k: v for k, v in every.items() if k not in running}
    for values, heading in (({**rig, 'degraded': 'off'}, 'all'), (links, 'the recorded')):
        with BagWriter(tmp_path / heading, rig_values=values) as out:
            out.put(block(0))
            out.put(ParameterChange(T0, 0, (('state.noise', (0.125,) * 60),)))
        assert main(['info', str(tmp_path / heading)]) == 0
        text = capsys.readouterr().out
        assert f'  {heading} parameters at their defaults' in text
        assert '0.125' not in text
        assert (f'{len(rig) - len(links)} parameters of a rig are not in the recording' in text) == (values is links)


def test_convert_there_and_back_keeps_every_bit(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source, target in (('run', 'a.csv'), ('a.csv', 'again'), ('again', 'b.mcap'), ('b.mcap', 'b.csv')):
        assert main(['convert', str(tmp_path / source), '--out', str(tmp_path / target)]) == 0
    capsys.readouterr()
    first = open_recording(bag)
    for name in ('a.csv', 'again', 'b.mcap', 'b.csv'):
        other = open_recording(tmp_path / name)
        for column in ('t_ns', 'seq', 'x1', 'y1', 'sum1', 'x2', 'y2', 'sum2'):
            np.testing.assert_array_equal(other.samples[column], first.samples[column])
        assert (other.loads(), other.temperatures()) == (first.loads(), first.temperatures())
        np.testing.assert_allclose(other.references(), first.references(), rtol=1e-15)
    with Reader(tmp_path / 'again') as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == open_recording(tmp_path / 'again').topics()
    assert main(['convert', str(bag), '--out', str(tmp_path / 'a.csv')]) == 4
    assert 'exists already' in capsys.readouterr().err


BAGS = Path(__file__).parent.parent.parent / 'bags'


def content_of(page: Path) -> dict[str, Any]:
    """The data in an interactive page."""
    match = re.search(r'<script type="application/json" id="recording">(.*?)</script>', page.read_text(), re.S)
    assert match is not None
    content: dict[str, Any] = json.loads(match[1])
    return content


def column(text: str, kind: str = '<f4') -> FloatArray:
    return np.frombuffer(base64.b64decode(text), kind).astype(np.float64)


def test_the_page_is_whole(tmp_path: Path) -> None:
    out = tmp_path / 'page.html'
    assert main(['plot', str(BAGS / 'laser_off'), '--out', str(out)]) == 0
    page = out.read_text()
    assert not re.search(r'(src|href)="(?!#)|\bimport\b[^(;]*from|@import|url\(', page)
    assert 'laser lost' in page
    assert ('52 blocks' in page, len(re.findall(r' µm, median sd 0\.\d\d µm<', page))) == (True, 2)
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
    # Where the time map steps ahead by 15 ms, and back to where stamps are raised, the line is broken as well.
    for moved_ns in (15_000_000, -19_999_000):
        later = [s if s.index < 150 else dataclasses.replace(s, t_ns=s.t_ns + moved_ns) for s in drawn.spots]
        moved = dataclasses.replace(drawn, spots=later).table()
        breaks = np.setdiff1d(moved['t'][np.isnan(moved['lost'])], gone)
        assert breaks.tolist() == pytest.approx([150 * 0.02 - 0.01 + moved_ns / 2e9], abs=1e-3)
