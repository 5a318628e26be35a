# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A part of a recording is a recording; marks are read, listed, drawn, converted, and bound a part."""

import argparse
import contextlib
import itertools
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import psd_deflection
from msg_adapters import MARK, to_messages
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli import _many
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.recordings import cdr
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.recordings.replay.comparison import ReplayComparison
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.recordings.write.sinks import open_sink
from psd_deflection.records import Mark, ParameterChange
from tools.program import ROOT

BAGS = ROOT / 'bags'
WITHOUT = {'recover': 'it saves what is whole'}
"""Commands that take a recording and no part of it."""


def staircase() -> Recording:
    """Rest, 5 N along X, 8 N along Y, rest; a second each; 20 to 23 degrees."""
    loads = [(0, 0, 0), (5, 0, 0), (0, -8, 0), (0, 0, 0)]
    return psd_deflection.simulate(None, loads, seconds=1, temperature=[20.0, 23.0])


def test_a_slice_is_a_part() -> None:
    recording = psd_deflection.open(BAGS / 'clean')
    part = recording[1.0:2.5]
    assert part.samples['seq'].tolist() == list(range(1000, 2500))
    assert recording[3.5:].samples['seq'].tolist() == list(range(3500, 4000))
    estimates = psd_deflection.replay(recording)
    inside = estimates[1.0:2.0]
    assert inside.t.tolist() == [t for t in estimates.t.tolist() if 1.0 <= t < 2.0]
    assert inside[:1.5].t.tolist() == [t for t in inside.t.tolist() if t < 1.5]
    assert len(estimates[9.0:]) == 0
    for full in (recording, estimates):
        for wrong in (3, slice(1.0, 2.0, 0.5)):
            with pytest.raises(ConfigError, match=r'must be a part of time, as (recording|estimates)\['):
                full[wrong]  # type: ignore[index]


def test_samples_keep_number_time_and_volts() -> None:
    full = staircase()
    part = full.crop(1.505, 2.5)
    inside = full.samples[1505:2500]
    for name in ('seq', 't_ns', 'x1', 'sum2', 'flags'):
        np.testing.assert_array_equal(part.samples[name], inside[name])
    assert part.samples['t'][0] == 0.0
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
    full = psd_deflection.open(BAGS / 'clean')
    times = [None, 0.5, 1.5015, 3.0, None]
    parts = [full.crop(a, b) for a, b in itertools.pairwise(times)]
    np.testing.assert_array_equal(np.concatenate([part.samples['x1'] for part in parts]), full.samples['x1'])
    topic = '/link_tip/deflection'
    assert sum(len(part.estimates()[topic]) for part in parts) == len(full.estimates()[topic])
    counted = [part.topics() for part in parts]
    assert counted[1][topic] > 40
    assert all(sum(one.get(name, 0) for one in counted) <= count for name, count in full.topics().items())
    inner = parts[1].crop(0.25, 0.5).with_block_size(10)
    assert isinstance(inner, RecordingWindow)
    assert len(inner.samples) == 250
    assert inner.samples['seq'][0] == full.samples['seq'][750]
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
    full = psd_deflection.open(BAGS / 'clean')
    start = datetime.fromtimestamp(int(full.samples['t_ns'][0]) * 1e-9, UTC)
    part = full.crop(start + timedelta(seconds=1), start + timedelta(seconds=2))
    assert abs(len(part.samples) - 1000) <= 1


@pytest.mark.parametrize(
    ('bounds', 'error', 'words'),
    [
        ((2.0, 1.0), ConfigError, 'from 2.0 to 1.0: must rise'),
        ((9.0, None), RecordingError, 'clean: has no sample from 9.0 to None'),
        ((-5.0, 0.0), RecordingError, 'has no sample'),
    ],
)
def test_a_part_without_samples_is_rejected(
    bounds: tuple[float | None, float | None], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        psd_deflection.open(BAGS / 'clean').crop(*bounds)


@pytest.mark.parametrize(
    ('words', 'status', 'reported'),
    [
        (['--from', 'noon'], 2, '--from noon: must be s from the first sample, a time such'),
        (['--to', '1e9'], 2, '--to 1e9: must be at most'),
        (['--from', '3', '--to', '2'], 3, 'must rise'),
        (['--from', '2026-11-24T14:03:10'], 4, 'has no sample from 2026-11-24'),
    ],
)
def test_a_wrong_bound_is_rejected(
    words: list[str], status: int, reported: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['info', str(BAGS / 'clean'), *words]) == status
    assert reported in capsys.readouterr().err


def actions_of(name: str) -> list[argparse.Action]:
    # argparse has no public way to ask what a command takes.
    (commands,) = [a for a in make_parser([name])._actions if isinstance(a, argparse._SubParsersAction)]
    return list(commands.choices[name]._actions)


def test_every_command_that_reads_a_recording_takes_a_part_of_it() -> None:
    without = []
    for name in COMMANDS:
        actions = actions_of(name)
        if any(a.dest in ('recording', 'recordings') for a in actions) and not any(
            '--from' in a.option_strings for a in actions
        ):
            without.append(name)
    assert without == [name for name in COMMANDS if name in WITHOUT]


ASKED = {
    'calibrate': ['--out', 'calibrated'],
    'check': [],
    'convert': ['--out', 'converted.csv'],
    'discover': ['--out', 'found', '--quiet'],
    'identify': [],
    'info': [],
    'plot': ['--out', 'drawn.png'],
    'replay': [],
    'validate': [],
}
"""Commands that answer in JSON of a part of a recording, with the options that they cannot do without."""
ALL_BEFORE = {'plot', 'replay'}
"""They have estimates, and that of a block depends on the blocks before it, which a file with the part alone lacks."""
OF_THE_FILE = {'bytes', 'path', 'name', 'sha256', 'recording'}


def parted(name: str) -> set[str]:
    """Options of the command ``name``."""
    return {option for action in actions_of(name) for option in action.option_strings}


def answer_without_names(text: str) -> object:
    """The answer in ``text`` without what tells files apart."""
    return json.loads(text, object_hook=lambda d: {k: v for k, v in d.items() if k not in OF_THE_FILE})


@pytest.fixture(scope='module')
def two_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording with loads, references and a link that rings, and a file with a part of it alone."""
    folder = tmp_path_factory.mktemp('parts')
    full, part = folder / 'whole.csv', folder / 'part.csv'
    rest = (0, 0, 0)
    loads = [rest, (20, 0, 0), rest, (0, -30, 0), rest, (0, 0, 2), rest, (30, 0, 0)]
    made = psd_deflection.simulate(None, loads, seconds=1, seed=2)
    convert(made, full, made.parameters, Beside.of(made), made.blocks())
    assert main(['convert', str(full), '--out', str(part), '--from', '0.5', '--to', '5.5']) == 0
    return full, part


@pytest.mark.repeatable
@pytest.mark.parametrize('name', [name for name in COMMANDS if {'--from', '--json'} <= parted(name)])
def test_answer_of_window_equals_that_of_cut_file(
    name: str,
    two_files: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    full, part = (str(path) for path in two_files)
    answers: list[object] = []
    for recording in ([full, '--from', '0.5', '--to', '5.5'], [part], [full]):
        folder = tmp_path / str(len(answers))
        folder.mkdir()
        monkeypatch.chdir(folder)
        capsys.readouterr()
        assert main([name, *recording, *ASKED[name], '--json']) == 0
        answers.append(answer_without_names(capsys.readouterr().out))
    of_the_part, of_the_file, of_all = answers
    assert of_the_part == of_the_file or name in ALL_BEFORE
    assert of_the_part != of_all


@pytest.mark.skipif('calibrate' not in COMMANDS, reason='an optional room')
def test_what_is_computed_from_a_part_says_which(two_files: tuple[Path, Path]) -> None:
    full = psd_deflection.open(two_files[0])
    assert full.crop(0.5, 5.5).name == 'whole.csv, from 0.5 s to 5.5 s'
    assert full.crop(0.5, None).crop(1.0, None).name == 'whole.csv, from 0.5 s, from 1 s'
    found = psd_deflection.calibrate(full.crop(0.5, 5.5), ROOT / 'config' / 'thesis_rig.yaml')
    assert found.tree()['provenance']['recordings'][0]['name'] == 'whole.csv, from 0.5 s to 5.5 s'


@pytest.mark.parametrize('bag', ['clean', 'lost_samples', 'laser_off'])
def test_a_part_of_a_replay_is_what_it_is_in_the_whole(
    bag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where the part begins and ends within a block; what is rejected in it is counted, and no more."""
    full, part = tmp_path / 'whole.csv', tmp_path / 'part.csv'
    assert main(['replay', str(BAGS / bag), '--out', str(full), '--json']) == 0
    everything = json.loads(capsys.readouterr().out)
    words = ['--from', '1.013', '--to', '2.505']
    assert main(['replay', str(BAGS / bag), *words, '--out', str(part), '--json', '--compare', '--strict']) in (0, 1)
    found = json.loads(capsys.readouterr().out)
    assert found['compared']['different'] == found['compared']['rounded']
    assert found['compared']['equal'] + found['compared']['rounded'] > 100
    assert found['compared']['only_recorded'] == found['compared']['only_replayed'] == 0
    head, *rows = full.read_text().splitlines()
    first, *others = part.read_text().splitlines()
    assert first == head
    start = int(next(psd_deflection.open(BAGS / bag).blocks()).t_ns[0])
    since = [int(row.partition(',')[0].replace('.', '')) - start for row in rows]
    assert others == [row for row, t_ns in zip(rows, since, strict=True) if 1_013_000_000 <= t_ns < 2_505_000_000]
    assert found['blocks'] == found['estimates'] + sum(found['rejected'].values())
    assert sum(found['rejected'].values()) <= sum(everything['rejected'].values())
    assert found['samples'] + found['lost'] == pytest.approx(1492, abs=40)


@pytest.mark.skipif(_many.FLEET is None, reason='an optional room')
def test_several_recordings_are_replayed_in_the_same_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(BAGS / 'clean'), str(BAGS / 'lost_samples'), '--from', '1', '--to', '2', '--json']) == 0
    assert [json.loads(line)['samples'] for line in capsys.readouterr().out.splitlines()] == [1000, 973]


def test_window_before_state_message_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that joins late hears of the memory some seconds later."""
    opened = psd_deflection.open(BAGS / 'clean')
    start = int(next(opened.blocks()).t_ns[0])
    first = next(opened.blocks()).index
    memory = ParameterChange(start + 2_000_000_000, first + 100, (('state.whole', 1.0),))
    monkeypatch.setattr(type(opened), 'memory_from', lambda self, index: memory)
    with pytest.raises(RecordingError, match=r'says 2\.0 s after its first sample what the pipeline remembers'):
        ReplayComparison(opened, RecordingWindow(opened, 0.5, 1.5))
    ReplayComparison(opened, RecordingWindow(opened, 0.5, 2.5))


def test_monitor_window_is_for_recordings_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert make_parser(['monitor']).parse_args(['monitor', 'run', '--from', '1', '--to', '3']).span == (1.0, 3.0)
    assert main(['monitor', '--from', '1']) == 2
    assert '--from and --to are for a recording' in capsys.readouterr().err


def test_the_rate_is_that_of_the_samples_whose_stamps_are_even() -> None:
    """After a step back of the time map 2,900 samples have stamps 1 ns apart."""
    seq = np.arange(4000)
    t_ns = np.select([seq < 100, seq < 3000], [seq * 10**6, 10**9 + seq], 10**9 + (seq - 2990) * 10**6)
    blocks = [SimpleNamespace(seq=seq[n : n + 20], t_ns=t_ns[n : n + 20]) for n in range(0, 4000, 20)]
    late = SimpleNamespace(blocks=lambda: iter(blocks))
    assert vars(Recording)['sample_rate_hz'].func(late) == pytest.approx(1000.0, rel=1e-6)


MARKS = [Mark(500_000_000, 'bump'), Mark(1_000_000_000, 'at rest'), Mark(1_500_000_000, 'bump')]


@pytest.fixture(scope='module')
def marked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds with three marks, two of one name."""
    path = tmp_path_factory.mktemp('marks') / 'marked'
    rig = psd_deflection.load_rig()
    with contextlib.closing(open_sink(path, rig.flat())) as sink:
        for block in psd_deflection.simulate(rig, (0, -10, 0), seconds=2).blocks():
            for mark in MARKS:
                if block.t_ns[0] <= mark.t_ns < block.t_ns[0] + 20_000_000:
                    sink.put(mark)
            sink.put(block)
    return path


def test_marks_are_read_and_belong_to_their_part(marked: Path) -> None:
    full = psd_deflection.open(marked)
    assert full.marks() == MARKS
    assert full.crop(0.6, 1.2).marks() == MARKS[1:2]
    assert full.topics()[MARK] == 3


@pytest.mark.parametrize(
    ('bounds', 'seconds'),
    [
        (('mark:bump', None), (0.5, 1.999)),
        (('mark:bump', 'mark:bump'), (0.5, 1.499)),
        (('mark:at rest', 'mark:bump'), (1.0, 1.499)),
        ((None, 'mark: at rest '), (0.0, 0.999)),
        ((0.6, 'mark:bump'), (0.6, 1.499)),
    ],
)
def test_a_mark_is_a_bound(
    marked: Path, bounds: tuple[float | str | None, float | str | None], seconds: tuple[float, float]
) -> None:
    samples = psd_deflection.open(marked).crop(*bounds).samples
    assert (samples['t_ns'][0] * 1e-9, samples['t_ns'][-1] * 1e-9) == pytest.approx(seconds)


def test_a_mark_that_is_not_there_is_named_with_those_that_are(marked: Path) -> None:
    full = psd_deflection.open(marked)
    with pytest.raises(
        RecordingError, match="marked: has no mark 'bumb'; its marks are at rest, bump; did you mean bump"
    ):
        full.crop('mark:bumb')
    with pytest.raises(ConfigError, match="'bump': must be s from the first sample"):
        full.crop('bump')
    with pytest.raises(RecordingError, match='it has no marks'):
        psd_deflection.simulate().crop('mark:x')


def test_what_is_no_mark_is_left_out_with_a_warning(tmp_path: Path) -> None:
    """Any recorder writes what any node says."""
    (message,) = to_messages(Mark(0, 'two\nlines'))
    with contextlib.closing(BagWriter(tmp_path / 'bag', rig_values={})) as writer:
        writer.write_encoded(MARK, message.type, cdr.encode(message.type, message.fields), 5)
    recording = psd_deflection.open(tmp_path / 'bag')
    assert recording.marks() == []
    assert 'left out: a mark with a control character' in recording.warnings[0]


def test_commands_list_cut_and_draw_them(marked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(marked)]) == 0
    assert '  marks            0.500 s  bump\n                   1.000 s  at rest\n' in capsys.readouterr().out
    words = [str(marked), '--from', 'mark:at rest', '--to', 'mark:bump']
    assert main(['info', *words, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found['samples'], [mark['text'] for mark in found['marks']]) == (500, ['at rest'])
    assert main(['plot', *words, '--json', '--out', str(tmp_path / 'x.html')]) == 0
    assert json.loads(capsys.readouterr().out)['samples'] == 500
    assert '"mark", "at rest"]' in (tmp_path / 'x.html').read_text()
    assert main(['plot', str(marked), '--out', str(tmp_path / 'x.svg')]) == 0
    assert main(['info', str(marked), '--from', 'mark:nothing']) == 4
    assert "has no mark 'nothing'" in capsys.readouterr().err


def test_a_conversion_keeps_them_or_says_that_it_cannot(
    marked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['convert', str(marked), '--out', str(tmp_path / 'x.mcap')]) == 0
    assert psd_deflection.open(tmp_path / 'x.mcap').marks() == MARKS
    assert 'marks' not in capsys.readouterr().err
    assert main(['convert', str(marked), '--out', str(tmp_path / 'x.csv')]) == 0
    assert 'a table has no place for marks: 3 left out' in capsys.readouterr().err
