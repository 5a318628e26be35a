# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A part of a recording is one; marks bound it; recordings and estimates as tables, series and figures."""

import argparse
import contextlib
import hashlib
import itertools
import json
import subprocess
import sys
import warnings
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import psd_deflection
from msg_adapters import MARK, to_messages
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli import _many
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.recordings import cdr
from psd_deflection.recordings.charts import estimates_chart, moments, samples_chart
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.formats.format import open_sink
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.recordings.replay.comparison import ReplayComparison
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.recordings.sample_table import digest_of, sample_dtype, samples_table
from psd_deflection.recordings.spans import span_ns
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import AppliedLoad, Mark, ParameterChange, ReferencePose, TemperatureReading
from psd_deflection.studies.study import opened
from tools.program import ROOT

BAGS = ROOT / 'bags'
CLEAN = BAGS / 'clean'
Capsys = pytest.CaptureFixture[str]
WITHOUT = {'recover': 'it saves what is whole'}
"""Commands that take a recording and no part of it."""


def staircase() -> Recording:
    """Rest, 5 N along X, 8 N along Y, rest; a second each; 20 to 23 degrees."""
    loads = [(0, 0, 0), (5, 0, 0), (0, -8, 0), (0, 0, 0)]
    return psd_deflection.simulate(None, loads, seconds=1, temperature=[20.0, 23.0])


def test_a_slice_is_a_part() -> None:
    recording = psd_deflection.open(CLEAN)
    part = recording[1.0:2.5]
    assert part.samples['seq'].tolist() == list(range(1000, 2500))
    assert recording[3.5:].samples['seq'].tolist() == list(range(3500, 4000))
    estimates = psd_deflection.replay(recording)
    inside = estimates[1.0:2.0]
    assert inside.t.tolist() == [t for t in estimates.t.tolist() if 1.0 <= t < 2.0]
    assert inside[:1.5].t.tolist() == [t for t in inside.t.tolist() if t < 1.5]
    assert (len(estimates[9.0:]), series(0)[0.0:].start_ns) == (0, 0)
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
    first, *later = part.temperatures()
    assert first.t_ns == start
    assert first.celsius == pytest.approx(21.125, abs=1e-3)
    assert start < later[0].t_ns <= later[-1].t_ns < start + 1_000_000_000
    assert len(part.references()) == 1000
    frame = part.to_pandas()
    assert list(frame['load_fx'].iloc[[0, 499, 500]]) == [5.0, 5.0, 0.0]


def test_parts_put_together_are_the_whole() -> None:
    full = psd_deflection.open(CLEAN)
    times = [None, 0.5, 1.5015, 3.0, None]
    parts = [full.crop(a, b) for a, b in itertools.pairwise(times)]
    np.testing.assert_array_equal(np.concatenate([part.samples['x1'] for part in parts]), full.samples['x1'])
    topic = '/link_tip/deflection'
    assert sum(len(part.estimates()[topic]) for part in parts) == len(full.estimates()[topic])
    topics = [part.topics() for part in parts]
    assert topics[1][topic] > 40
    assert all(sum(counts.get(name, 0) for counts in topics) <= count for name, count in full.topics().items())
    inner = parts[1].crop(0.25, 0.5).with_block_size(10)
    assert isinstance(inner, RecordingWindow)
    assert (len(inner.samples), inner.samples['seq'][0]) == (250, full.samples['seq'][750])
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
    full = psd_deflection.open(CLEAN)
    start = datetime.fromtimestamp(int(full.samples['t_ns'][0]) * 1e-9, UTC)
    part = full.crop(start + timedelta(seconds=1), start + timedelta(seconds=2))
    assert abs(len(part.samples) - 1000) <= 1


@pytest.mark.parametrize(
    ('bounds', 'error', 'words'),
    [
        ((2.0, 1.0), ConfigError, 'from 2.0 to 1.0: must rise'),
        ((9.0, None), RecordingError, 'clean: has no sample from 9.0 to None'),
        ((-5.0, 0.0), RecordingError, 'has no sample'),
        (('bump', None), ConfigError, "'bump': must be s from the first sample"),
        (('mark:x', None), RecordingError, 'it has no marks'),
    ],
)
def test_a_part_without_samples_is_rejected(bounds: tuple[Any, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        psd_deflection.open(CLEAN).crop(*bounds)


@pytest.mark.parametrize(
    ('words', 'status', 'reported'),
    [
        (['--from', 'noon'], 2, '--from noon: must be s from the first sample, a time such'),
        (['--to', '1e9'], 2, '--to 1e9: must be at most'),
        (['--from', '3', '--to', '2'], 3, 'must rise'),
        (['--from', '2026-11-24T14:03:10'], 4, 'has no sample from 2026-11-24'),
    ],
)
def test_a_wrong_bound_is_rejected(words: list[str], status: int, reported: str, capsys: Capsys) -> None:
    assert main(['info', str(CLEAN), *words]) == status
    assert reported in capsys.readouterr().err


def actions_of(name: str) -> list[argparse.Action]:
    # argparse has no public way to ask what a command takes.
    (commands,) = [a for a in make_parser([name])._actions if isinstance(a, argparse._SubParsersAction)]
    return list(commands.choices[name]._actions)


def parted(name: str) -> set[str]:
    """Options of the command ``name``."""
    return {option for action in actions_of(name) for option in action.option_strings}


def test_every_command_that_reads_a_recording_takes_a_part_of_it() -> None:
    reading = [n for n in COMMANDS if {'recording', 'recordings'} & {a.dest for a in actions_of(n)}]
    assert [n for n in reading if '--from' not in parted(n)] == [n for n in COMMANDS if n in WITHOUT]


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
    name: str, two_files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
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
    calibration = psd_deflection.calibrate(full.crop(0.5, 5.5), ROOT / 'config' / 'thesis_rig.yaml')
    assert calibration.tree()['provenance']['recordings'][0]['name'] == 'whole.csv, from 0.5 s to 5.5 s'


@pytest.mark.parametrize('bag', ['clean', 'lost_samples', 'laser_off'])
def test_a_part_of_a_replay_is_what_it_is_in_the_whole(bag: str, tmp_path: Path, capsys: Capsys) -> None:
    """Also where the part begins and ends within a block; what is rejected in it is counted, and no more."""
    full, part = tmp_path / 'whole.csv', tmp_path / 'part.csv'
    assert main(['replay', str(BAGS / bag), '--out', str(full), '--json']) == 0
    everything = json.loads(capsys.readouterr().out)
    words = ['--from', '1.013', '--to', '2.505']
    assert main(['replay', str(BAGS / bag), *words, '--out', str(part), '--json', '--compare', '--strict']) in (0, 1)
    tree = json.loads(capsys.readouterr().out)
    assert tree['compared']['different'] == tree['compared']['rounded']
    assert tree['compared']['equal'] + tree['compared']['rounded'] > 100
    assert tree['compared']['only_recorded'] == tree['compared']['only_replayed'] == 0
    head, *rows = full.read_text().splitlines()
    first, *part_rows = part.read_text().splitlines()
    assert first == head
    start = int(next(psd_deflection.open(BAGS / bag).blocks()).t_ns[0])
    since = [int(row.partition(',')[0].replace('.', '')) - start for row in rows]
    assert part_rows == [row for row, t_ns in zip(rows, since, strict=True) if 1_013_000_000 <= t_ns < 2_505_000_000]
    assert tree['blocks'] == tree['estimates'] + sum(tree['rejected'].values())
    assert sum(tree['rejected'].values()) <= sum(everything['rejected'].values())
    assert tree['samples'] + tree['lost'] == pytest.approx(1492, abs=40)


@pytest.mark.skipif(_many.FLEET is None, reason='an optional room')
def test_several_recordings_are_replayed_in_the_same_part(capsys: Capsys) -> None:
    assert main(['replay', str(CLEAN), str(BAGS / 'lost_samples'), '--from', '1', '--to', '2', '--json']) == 0
    assert [json.loads(line)['samples'] for line in capsys.readouterr().out.splitlines()] == [1000, 973]


def test_window_before_state_message_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that joins late hears of the memory some seconds later."""
    opened = psd_deflection.open(CLEAN)
    start = int(next(opened.blocks()).t_ns[0])
    first = next(opened.blocks()).index
    memory = ParameterChange(start + 2_000_000_000, first + 100, (('state.whole', 1.0),))
    monkeypatch.setattr(type(opened), 'memory_from', lambda self, index: memory)
    with pytest.raises(RecordingError, match=r'says 2\.0 s after its first sample what the pipeline remembers'):
        ReplayComparison(opened, RecordingWindow(opened, 0.5, 1.5))
    ReplayComparison(opened, RecordingWindow(opened, 0.5, 2.5))


def test_monitor_window_is_for_recordings_only(capsys: Capsys) -> None:
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
    assert (full.marks(), full.crop(0.6, 1.2).marks()) == (MARKS, MARKS[1:2])
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
def test_a_mark_is_a_bound(marked: Path, bounds: tuple[Any, Any], seconds: tuple[float, float]) -> None:
    samples = psd_deflection.open(marked).crop(*bounds).samples
    assert (samples['t_ns'][0] * 1e-9, samples['t_ns'][-1] * 1e-9) == pytest.approx(seconds)


def test_a_mark_that_is_not_there_is_named_with_those_that_are(marked: Path) -> None:
    words = "marked: has no mark 'bumb'; its marks are at rest, bump; did you mean bump"
    with pytest.raises(RecordingError, match=words):
        psd_deflection.open(marked).crop('mark:bumb')


def test_what_is_no_mark_is_left_out_with_a_warning(tmp_path: Path) -> None:
    """Any recorder writes what any node says."""
    (message,) = to_messages(Mark(0, 'two\nlines'))
    with contextlib.closing(BagWriter(tmp_path / 'bag', rig_values={})) as writer:
        writer.write_encoded(MARK, message.type, cdr.encode(message.type, message.fields), 5)
    recording = psd_deflection.open(tmp_path / 'bag')
    assert recording.marks() == []
    assert 'left out: a mark with a control character' in recording.warnings[0]


def test_commands_list_cut_and_draw_them(marked: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert main(['info', str(marked)]) == 0
    assert '  marks            0.500 s  bump\n                   1.000 s  at rest\n' in capsys.readouterr().out
    words = [str(marked), '--from', 'mark:at rest', '--to', 'mark:bump']
    assert main(['info', *words, '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    assert (tree['samples'], [mark['text'] for mark in tree['marks']]) == (500, ['at rest'])
    assert main(['plot', *words, '--json', '--out', str(tmp_path / 'x.html')]) == 0
    assert json.loads(capsys.readouterr().out)['samples'] == 500
    assert '"mark", "at rest"]' in (tmp_path / 'x.html').read_text()
    assert main(['plot', str(marked), '--out', str(tmp_path / 'x.svg')]) == 0
    assert main(['info', str(marked), '--from', 'mark:nothing']) == 4
    assert "has no mark 'nothing'" in capsys.readouterr().err


def test_a_conversion_keeps_them_or_says_that_it_cannot(marked: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert main(['convert', str(marked), '--out', str(tmp_path / 'x.mcap')]) == 0
    assert psd_deflection.open(tmp_path / 'x.mcap').marks() == MARKS
    assert 'marks' not in capsys.readouterr().err
    assert main(['convert', str(marked), '--out', str(tmp_path / 'x.csv')]) == 0
    assert 'a table has no place for marks: 3 left out' in capsys.readouterr().err


START = 1_700_000_000_000_000_000
MS = 1_000_000


def series(n: int = 3) -> EstimateSeries:
    pose = np.arange(3.0 * n).reshape(n, 3) * 1e-6
    t_ns, covariance = START + 20 * MS * np.arange(n), np.tile(np.diag([4e-12, 9e-12, -1.0]), (n, 1, 1))
    return EstimateSeries('x', t_ns, pose, np.zeros((n, 2)), covariance, pose * 1e6, np.arange(float(n)))


def test_series_axes_are_columns_from_first_estimate() -> None:
    made = series()
    assert made.t == pytest.approx([0.0, 0.02, 0.04])
    assert [made.dx[1], made.dy[1], made.theta[1]] == pytest.approx([3e-6, 4e-6, 5e-6])
    sd = made.sd
    assert sd is not None
    assert sd[0, :2] == pytest.approx([2e-6, 3e-6])
    assert np.isnan(sd[0, 2])
    part = made[0.01:0.03]
    assert part.t == pytest.approx([0.02])
    assert part.chi_square == pytest.approx([1.0])
    with pytest.raises(ConfigError, match='a part of time'):
        made[::2]
    assert len(series(0).t) == 0


def test_pandas_and_xarray_wait_until_they_are_asked_for() -> None:
    code = 'import sys, psd_deflection.recordings.estimates; print({"pandas", "xarray"} & {*sys.modules})'
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == 'set()\n'


def test_a_table_has_the_columns_that_there_are() -> None:
    made = series()
    names = [c.name for c in made.table().columns]
    assert names[-4:] == ['fx', 'fy', 'tz', 'chi_square']
    without = EstimateSeries('x', made.t_ns, made.pose, made.tilt)
    assert [c.name for c in without.table().columns] == ['t_ns', 'dx', 'dy', 'theta', 'phi', 'omega']
    assert without.sd is None


def test_a_summary_says_how_long_and_how_far() -> None:
    assert dict(series()._summary()) == {
        'estimates': '3',
        'duration': '0.06 s',
        'ΔX': '+0.00 … +6.00 µm',
        'ΔY': '+1.00 … +7.00 µm',
        'θ': '+0.11 … +0.46 mdeg',
    }
    assert dict(series(0)._summary()) == {'estimates': '0'}


def test_loads_are_held_and_references_stand_once() -> None:
    samples = np.zeros(4, sample_dtype(2))
    samples['t_ns'] = START + MS * np.arange(4)
    loads = [AppliedLoad(START + 2 * MS, 1.0, 2.0, 3.0), AppliedLoad(START + MS, 0.0, -1.0, 0.0)]
    references = [ReferencePose(START - MS, 1e-3, 2e-3, 3e-3), ReferencePose(START + MS + 1, 4e-3, 5e-3, 6e-3)]
    references.append(ReferencePose(START + 3 * MS + 1, 9.0, 9.0, 9.0))
    made = samples_table(samples, 2, loads, [TemperatureReading(START + 3 * MS, 21.5)], references, 'x')
    columns = {c.name: np.asarray(c.values) for c in made.columns}
    np.testing.assert_array_equal(columns['load_fy'], [np.nan, -1.0, 2.0, 2.0])
    np.testing.assert_array_equal(columns['load_tz'], [np.nan, 0.0, 3.0, 3.0])
    np.testing.assert_array_equal(columns['ref_dx'], [1e-3, np.nan, 4e-3, np.nan])
    (warm,) = [columns[c] for c in columns if c.startswith('temp')]
    np.testing.assert_array_equal(warm, [np.nan, np.nan, np.nan, 21.5])


def test_digest_is_that_of_the_bytes_of_all_files(tmp_path: Path) -> None:
    content = bytes(range(256)) * 5000
    for name, part in (('b', content[1000:]), ('a', content[:1000])):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'file').write_bytes(part)
    assert digest_of(tmp_path) == hashlib.sha256(content).hexdigest()
    assert digest_of(tmp_path / 'a' / 'file') == hashlib.sha256(content[:1000]).hexdigest()
    with pytest.raises(RecordingError, match='gone: cannot be read'):
        digest_of(tmp_path / 'gone')


def test_repeated_mark_is_the_first_after_the_start() -> None:
    marks = [Mark(START + t, text) for t, text in ((5, 'on'), (9, 'off'), (20, 'on'), (30, 'off'))]
    recording = cast(Any, SimpleNamespace(path=Path('x'), marks=lambda: marks))
    assert span_ns(recording, START, ('mark:on', 'mark:on')) == (START + 5, START + 20)
    assert span_ns(recording, START, (None, 'mark: off')) == (START, START + 9)
    assert span_ns(recording, START, (1e-8, 'mark:off')) == (START + 10, START + 30)
    assert span_ns(recording, START, ('mark:off', None)) == (START + 9, np.iinfo(np.int64).max)


def test_a_recording_has_length_duration_and_start() -> None:
    recording = psd_deflection.open(CLEAN)
    assert recording
    assert 'samples' not in recording.__dict__
    assert (len(recording), recording.start) == (4000, datetime(2026, 1, 1, tzinfo=UTC))
    assert recording.duration == pytest.approx(4.0)
    assert (recording['x1'] == recording.samples['x1']).all()
    with pytest.raises(KeyError, match="no column 'x3'; there are t, seq, t_ns, x1"):
        recording['x3']


def test_times_that_do_not_count_from_the_epoch_have_no_start() -> None:
    assert psd_deflection.simulate(None, (0, 0, 0), seconds=0.1).start is None


def test_estimates_have_duration_columns_and_times_of_day() -> None:
    estimates = psd_deflection.replay(CLEAN)
    assert estimates.duration == pytest.approx(4.0)
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
        ('csv', None, 'the rig of the thesis: there is none in the recording'),
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
    with warnings.catch_warnings(action='ignore'):
        assert psd_deflection.watch(path, given).sources['rig'] == words


def test_every_channel_is_drawn_with_the_marks() -> None:
    samples = np.zeros(3, sample_dtype(2))
    samples['t_ns'] = [5_000_000_000, 5_500_000_000, 6_000_000_000]
    samples['t'], samples['seq'], samples['y2'] = [0.0, 0.5, 1.0], [0, 1, 2], [1.0, 2.0, 3.0]
    chart = samples_chart(samples, 2, moments([Mark(5_250_000_000, 'bump')], 5_000_000_000))
    assert [panel.y_label for panel in chart.panels] == [f'{n} / V' for n in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')]
    assert [panel.curves[0].colour for panel in chart.panels] == [*['blue'] * 3, *['orange'] * 3]
    words = ['bump', *[''] * 5]
    assert [[(rule.at, rule.words) for rule in rules] for rules in chart.rules()] == [[(0.25, w)] for w in words]
    (curve,) = chart.panels[4].series
    assert (curve.x.tolist(), curve.y.tolist()) == ([0.0, 0.5, 1.0], [1.0, 2.0, 3.0])


def test_estimates_are_drawn_with_their_interval() -> None:
    pose = np.array([[1e-6, 2e-6, np.radians(0.003)]])
    sd = np.array([[1e-7, 2e-7, np.radians(0.0001)]])
    panels = estimates_chart(np.array([0.5]), pose, sd, '/link_tip/deflection', ()).panels
    shown = [(float(s.y[0]), float(s.half_width[0])) for p in panels for s in p.series if s.half_width is not None]
    assert np.allclose(shown, [(1.0, 0.196), (2.0, 0.392), (3.0, 0.196)])
    assert estimates_chart(np.array([0.5]), pose, None, 'a', ()).panels[0].series[0].half_width is None


def test_no_line_is_drawn_over_a_step_of_the_time_map() -> None:
    """Twenty samples, ten of which the stamps are raised by 1 ns each, ten right ones, and a leap by 5 ms."""
    samples = np.zeros(50, sample_dtype(2))
    samples['seq'] = np.arange(50)
    steps = np.repeat([1e-3, 1e-9, 1e-3], [20, 10, 20])
    steps[40] = 5e-3
    samples['t'] = t = np.cumsum(steps)
    (curve,) = samples_chart(samples, 2, ()).panels[0].curves
    drawn = [span for span in _spans(curve.x, curve.y) if span[0] < span[1]]
    assert drawn == [(t[0], t[19]), (t[29], t[39]), (t[40], t[49])]


@pytest.mark.parametrize('part', ['samples', 'estimates'])
def test_a_recording_draws_itself(part: str) -> None:
    recording = psd_deflection.open(CLEAN).crop(1.0, 2.0)
    figure = recording.plot() if part == 'samples' else psd_deflection.replay(recording).plot()
    assert (len(figure.axes), figure._repr_png_()[:4]) == ({'samples': 6, 'estimates': 3}[part], b'\x89PNG')


def _spans(x: np.ndarray, y: np.ndarray) -> list[tuple[float, float]]:
    """From where to where a line is drawn."""
    ends = np.flatnonzero(np.diff(np.concatenate(([False], np.isfinite(y), [False])).astype(int)))
    return [(float(x[a]), float(x[b - 1])) for a, b in ends.reshape(-1, 2)]


@pytest.mark.slow
@pytest.mark.parametrize('drawing', ['samples', 'estimates'])
@pytest.mark.parametrize('bag', ['lost_samples', 'laser_off'])
def test_a_figure_draws_no_line_over_a_gap(drawing: str, bag: str) -> None:
    recording = psd_deflection.open(ROOT / 'bags' / bag)
    estimates = psd_deflection.replay(recording)
    samples = drawing == 'samples'
    figure = recording.plot() if samples else estimates.plot()
    t = recording.samples['t'] if samples else estimates.t
    steps = np.diff(recording.samples['seq'] if samples else estimates.t)
    gaps = np.flatnonzero(steps > 1.5 * np.median(steps))
    expected = list(zip(t[np.concatenate(([0], gaps + 1))], t[np.concatenate((gaps, [len(t) - 1]))], strict=True))
    assert len(expected) > 1 or (samples and bag == 'laser_off')
    for axes in figure.axes:
        (line,) = [line for line in axes.lines if np.size(line.get_xdata()) > 2]
        drawn = _spans(np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
        # Of many points, those at the ends of a stretch may be thinned.
        assert len(drawn) == len(expected)
        assert np.allclose(drawn, expected, atol=0.01)
