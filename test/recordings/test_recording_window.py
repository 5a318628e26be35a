"""A part of a recording is a recording."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.recordings.write.sinks import open_sink
from psd_deflection.records import ParameterChange
from tools.program import ROOT

BAGS = ROOT / 'bags'
WITHOUT = {
    'monitor': 'its page has a window of its own',
    'replay': 'the estimates of a block depend on those before it; plot and convert cut',
    'recover': 'it saves what is whole',
}
"""Commands that take a recording and no part of it."""


def staircase() -> Recording:
    """Rest, 5 N along X, 8 N along Y, rest; a second each; 20 to 23 degrees."""
    loads = [(0, 0, 0), (5, 0, 0), (0, -8, 0), (0, 0, 0)]
    return psd_deflection.simulate(None, loads, seconds=1, temperature=[20.0, 23.0])


def test_samples_keep_number_time_and_volts() -> None:
    whole = staircase()
    part = whole.crop(1.505, 2.5)
    inside = whole.samples[1505:2500]
    for name in ('seq', 't_ns', 'x1', 'sum2', 'flags'):
        np.testing.assert_array_equal(part.samples[name], inside[name])
    assert part.samples['t'][0] == 0.0
    # The block at the start is cut; its number stays.
    first, *_ = part.blocks()
    assert (first.index, len(first.seq)) == (75, 15)
    assert part.lasts(int(inside['t_ns'][0]), int(inside['t_ns'][-1])) == pytest.approx(0.995)


def test_what_held_at_the_start_holds_from_there_on() -> None:
    part = staircase().crop(1.5, 2.5)
    start = 1_500_000_000
    assert [load.t_ns for load in part.loads()] == [start, 2_000_000_000]
    assert [(load.fx, load.fy) for load in part.loads()] == [(5.0, 0.0), (0.0, -8.0)]
    first, *others = part.temperatures()
    assert first.t_ns == start
    assert first.celsius == pytest.approx(21.125, abs=1e-3)
    assert start < others[0].t_ns <= others[-1].t_ns < start + 1_000_000_000
    assert len(part.references()) == 1000
    frame = part.to_pandas()
    assert list(frame['load_fx'].iloc[[0, 499, 500]]) == [5.0, 5.0, 0.0]


def test_parts_put_together_are_the_whole() -> None:
    whole = psd_deflection.open(BAGS / 'clean')
    times = [None, 0.5, 1.5015, 3.0, None]
    parts = [whole.crop(a, b) for a, b in itertools.pairwise(times)]
    np.testing.assert_array_equal(np.concatenate([part.samples['x1'] for part in parts]), whole.samples['x1'])
    topic = '/link_tip/deflection'
    assert sum(len(part.estimates()[topic]) for part in parts) == len(whole.estimates()[topic])
    counted = [part.topics() for part in parts]
    assert counted[1][topic] > 40
    assert all(sum(one.get(name, 0) for one in counted) <= count for name, count in whole.topics().items())
    # A part of a part counts from its own start, and a new block size cuts the same samples.
    inner = parts[1].crop(0.25, 0.5).with_block_size(10)
    assert isinstance(inner, RecordingWindow)
    assert len(inner.samples) == 250
    assert inner.samples['seq'][0] == whole.samples['seq'][750]
    assert {len(block.seq) for block in inner.blocks()} == {10}


def test_a_change_before_the_start_belongs_to_the_part(tmp_path: Path) -> None:
    """The rig of a part has the zero that was taken before its start, and not one that was taken after its end."""
    rig = psd_deflection.load_rig()
    early, late = (ParameterChange(round(s * 1e9), round(s * 50), (('psd_1.zero', (s, s)),)) for s in (1e-2, 3e-2))
    blocks = list(psd_deflection.simulate(rig, [(0, 0, 0)], seconds=0.04).blocks())
    with contextlib.closing(open_sink(tmp_path / 'bag', rig.flat())) as sink:
        for record in (blocks[0], early, blocks[1], late):
            sink.put(record)
    part = psd_deflection.open(tmp_path / 'bag').crop(0.02, 0.025)
    assert list(part.changes) == [early]
    assert rig_at_end(part).psds[0].zero == (1e-2, 1e-2)
    assert rig_at_end(part.crop(0.0, 0.001)).psds[0].zero == (1e-2, 1e-2)


def test_bounds_may_be_times_of_the_clock() -> None:
    whole = psd_deflection.open(BAGS / 'clean')
    start = datetime.fromtimestamp(int(whole.samples['t_ns'][0]) * 1e-9, UTC)
    part = whole.crop(start + timedelta(seconds=1), start + timedelta(seconds=2))
    assert abs(len(part.samples) - 1000) <= 1


@pytest.mark.parametrize(
    ('bounds', 'error', 'words'),
    [
        ((2.0, 1.0), ConfigError, 'from 2.0 to 1.0: must rise'),
        ((9.0, None), RecordingError, 'clean: has no sample from 9.0 to None'),
        ((-5.0, 0.0), RecordingError, 'has no sample'),
    ],
)
def test_a_part_without_samples_is_refused(
    bounds: tuple[float | None, float | None], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        psd_deflection.open(BAGS / 'clean').crop(*bounds)


def test_a_part_is_written_and_studied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, part = tmp_path / 'whole.csv', tmp_path / 'part.csv'
    loads = [(0, 0, 0), (8, 0, 0), (0, 0, 0), (0, -8, 0), (0, 0, 0), (0, 0, 2), (0, 0, 0)]
    made = psd_deflection.simulate(None, loads, seconds=2, seed=2)
    convert(made, whole, made.parameters, Beside.of(made), made.blocks())
    assert main(['convert', str(whole), '--out', str(part), '--from', '0.5', '--to', '8']) == 0
    assert '7500 samples' in capsys.readouterr().out
    np.testing.assert_array_equal(psd_deflection.open(part).samples['x1'],
                                  psd_deflection.open(whole).crop(0.5, 8.0).samples['x1'])  # fmt: skip
    assert main(['info', str(whole), '--from', '0.5', '--to', '8', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['samples'] == 7500
    # Without its last push the recording does not tell the wires of the twist.
    assert main(['check', str(whole), '--to', '8', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['verdict'] != 'right'


@pytest.mark.parametrize(
    ('words', 'status', 'told'),
    [
        (['--from', 'noon'], 2, '--from noon: must be s from the first sample, a time such'),
        (['--to', '1e9'], 2, '--to 1e9: must be at most'),
        (['--from', '3', '--to', '2'], 3, 'must rise'),
        (['--from', '2026-11-24T14:03:10'], 4, 'has no sample from 2026-11-24'),
    ],
)
def test_a_wrong_bound_is_refused(words: list[str], status: int, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(BAGS / 'clean'), *words]) == status
    assert told in capsys.readouterr().err


def test_every_command_that_reads_a_recording_takes_a_part_of_it() -> None:
    without = []
    for name in COMMANDS:
        parser = make_parser([name])
        (commands,) = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        actions = commands.choices[name]._actions
        if any(a.dest in ('recording', 'recordings') for a in actions) and not any(
            '--from' in a.option_strings for a in actions
        ):
            without.append(name)
    assert without == [name for name in COMMANDS if name in WITHOUT]
