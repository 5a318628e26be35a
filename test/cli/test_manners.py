# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a script relies on: exit status, one line of error, JSON alone on stdout, whole outputs, printable words."""

import ast
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from mcap.writer import Writer

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.plugins import optional
from psd_deflection.cli import _report
from psd_deflection.cli._options import FOREIGN
from psd_deflection.cli.main import COMMANDS, main
from psd_deflection.cli.recordings import info
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording

ROOT = Path(__file__).parent.parent.parent
CLEAN = str(ROOT / 'bags' / 'clean')
RIG = str(ROOT / 'config' / 'thesis_rig.yaml')
CHAIN = str(ROOT / 'config' / 'two_links.yaml')
URDF = str(ROOT / 'config' / 'two_links.urdf')
SHORT = ('--loads', 'constant:0,-10,0:0.1')
CSV_SINK = 'psd_deflection.recordings.write.csv_writer.CsvSampleSink.put'
Capsys = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where nothing is yet, and where relative names lead."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rejected(capsys: Capsys, *argv: str) -> tuple[int, str]:
    """Exit status and the one line of error; nothing else is said."""
    status = main(list(argv))
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1, err
    assert err.startswith(f'psd-deflection {argv[0]}: ')
    return status, err


OF_FLEETS = set() if optional('psd_deflection.cli._fleet') else {'--each', '--executor', 'x.parquet', 'b'}
"""Words for many recordings, which are an optional room."""


def offered(row: tuple[list[str], int, str]) -> bool:
    """Whether command and options of a case are there: an optional room may not be."""
    return row[0][0] in COMMANDS and not OF_FLEETS.intersection(row[0])


REJECTED: list[tuple[list[str], int, str]] = [
    (['simulate', '--out', 'a.csv', '--seed', '-1'], 2, '--seed -1: must be a whole number of at least 0'),
    (['simulate', '--out', 'a.csv', '--seed', '1.5'], 2, '--seed 1.5: must be a whole number'),
    (['simulate', '--serve', '--seed', '-1'], 2, '--seed -1'),
    (['simulate', '--serve', '--skew-ppm', 'nan'], 2, '--skew-ppm nan: must be a number of at least'),
    (['simulate', '--serve', '--first-seq', '-5'], 2, '--first-seq -5: must be a whole number of at least 0'),
    (['simulate', '--serve', '--link', 'taken'], 2, 'taken: no link can be made there'),
    (['simulate', '--serve', '--temperature', '20'], 2, '--temperature is for a recording'),
    (['simulate', '--serve', '--loads', 'rest'], 2, 'rest'),
    (['simulate', '--serve', '--out', 'a.csv'], 2, '--out is for a recording'),
    (['simulate', '--out', 'a.csv', '--device', 'dataq'], 2, '--device is for a device'),
    (['simulate', '--out', 'a.csv', '--loads', 'constant:0,0,0:0.001'], 2, 'last 1 samples at 1000 Hz'),
    (['simulate', '--out', 'a.csv', '--effect', 'sensor_gain,psd=9'], 2, "psd = '9': must be one of 1, 2"),
    (['simulate', '--out', 'a.csv', '--effect', 'hum'], 2, 'did you mean mains_interference?'),
    (['discover', CLEAN, '--out', 'found', '--seed', '-1'], 2, '--seed -1'),
    (['discover', CLEAN, '--out', 'found', '--without', 'everything'], 2, 'no effect of that name'),
    (['discover', '--out', 'found'], 2, 'REC: needed: one recording or several; --isolable LOADS needs none'),
    (['discover', CLEAN, '--out', 'found', '--isolable', 'thesis:1'], 2, '--isolable thesis:1 needs no recording'),
    (['discover', '--out', 'found', '--isolable', 'nothing'], 2, '--isolable nothing: not a load history'),
    (['discover', '--out', 'found', '--isolable', 'thesis:1', '--next'], 2, '--next needs a REC'),
    (['discover', '--out', 'found', '--isolable', 'thesis:1', '--from', '2'], 2, '--from, --to: need a REC'),
    (['calibrate', CLEAN, '--live', '--out', 'new'], 2, 'REC, --from, --to: --live makes a recording of its own'),
    (['calibrate', '--live', '--check', RIG], 2, '--check is for recordings that are there'),
    (['calibrate', CLEAN, '--out', 'new', '--url', 'http://127.0.0.1:1/'], 2, '--url: is for --live'),
    (['monitor', '--speed', '2'], 2, '--speed is for a recording'),
    (['monitor', '--loop'], 2, '--loop is for a recording'),
    (['monitor', CLEAN, '--demo'], 2, '--demo is for a rig'),
    (['monitor', '--demo', '--port', '/dev/null'], 2, '--demo is for the simulated rig: leave out --port'),
    (['estimator', '--demo', '--port', '/dev/null'], 2, '--demo is for the simulated rig: leave out --port'),
    (['monitor', CLEAN, '--speed', 'nan'], 2, '--speed nan: must be above 0'),
    (['monitor', CLEAN, '--http-port', '99999'], 2, 'monitor_port = 99999: must be at least 0 and at most 65535'),
    (['monitor', '--baud', '-1'], 2, 'baud = -1'),
    (['estimator', '--no-ros', '--baud', '-1'], 2, 'baud = -1'),
    (['estimator', '--no-ros', '--source', 'nonsense'], 2, '--source nonsense: must be one of serial, dataq'),
    (['estimator', '--no-ros', '--baud', '-1', '--params-file', RIG], 2, 'command line: baud = -1'),
    (['estimator', '--no-ros', '--ros-args', '-p', 'port:=/dev/ttyACM0'], 2, 'not read with --no-ros'),
    (['budget', '--explain', '--json'], 2, '--json does nothing beside --explain'),
    (['design', '--radius', '0.1'], 2, '--radius is for the placement of a rig'),
    (['design', '--params-file', RIG, '--box', '0', '0', 'nan', '1'], 2, '--box'),
    (['plot', CLEAN, '--out', 'a.jpg'], 2, '--out a.jpg: the name must end in .png, .svg, .pdf or .html'),
    (['replay', ''], 2, 'an argument is empty (a variable that is not set?)'),
    (['replay', CLEAN, '--out', ''], 2, '--out is empty'),
    (['replay', CLEAN, '--params-file='], 2, '--params-file is empty'),
    (['estimator', '--record', ''], 2, '--record is empty'),
    (['load', 'nan', '0', '0'], 2, 'must be finite'),
    (['load', '0', 'inf', '0'], 2, 'must be finite'),
    *(
        (['zero', '--url', url], 2, f'--url = {url}: is no address')
        for url in ('ftp://rig/', 'http://', 'http://rig:99999/', 'http://[::1/')
    ),
    (['discover', 'a', 'b', '--executor', 'processes', '--out', 'x'], 2, 'needs --each'),
    (['discover', 'a', '--out', 'x.parquet'], 2, 'needs --each'),
    (['discover', 'a', '--each', '--adopt', 'mine', '--out', 'x'], 2, 'not with --each'),
    (['calibrate', 'a', '--each', '--reference', 'b', '--out', 'x'], 2, 'not with --each'),
    (['calibrate', 'a', '--each', '--check', 'b'], 2, 'is for itself'),
    (['replay', 'a', 'b', '--out', 'x.csv'], 2, 'go into one X.parquet'),
    (['replay', 'a', '--executor', 'threads'], 2, 'must be serial, processes'),
    (['info', 'a', 'b', '--out', 'x.csv'], 2, 'must end in .parquet'),
    (['simulate'], 2, '--out OUT (a recording) or --serve'),
    (['design', '--out', 'a.png'], 2, 'give --params-file'),
    (['monitor', 'no_such_bag'], 4, 'no such recording'),
    (['monitor', CLEAN, '--speed', '0'], 2, '--speed 0: must be above 0'),
    (['monitor', '--speed', '0'], 2, '--speed 0: must be above 0'),
    (['monitor', CLEAN, '--port', '/dev/ttyACM0'], 2, '--port is for a rig'),
    (['monitor', '--http-port', '70000'], 2, 'monitor_port = 70000'),
    (['monitor', CLEAN, '--address', '192.0.2.1', '--http-port', '0'], 3, 'cannot be served there'),
    (['plot', 'no_such'], 4, 'no such recording'),
    (['plot', CLEAN, '--from', '2', '--to', '1'], 2, '--from 2.0 --to 1.0: must rise'),
    (['plot', CLEAN, '--from', 'mark:x'], 4, 'it has no marks'),
    (['plot', CLEAN, '--from', '9'], 4, 'has no samples to draw between --from and --to'),
    (['plot', CLEAN, '--out', 'x.bmp'], 2, 'the name must end in'),
    (['plot', CLEAN, '--out', '/no/such/folder/x.html'], 4, 'cannot be written'),
    (['plot', CLEAN, '--out', '/no/such/folder/x.png'], 4, 'cannot be written'),
    (['chain', CHAIN, '--json'], 2, '--out, --json and --count need --no-ros'),
    (['chain', CHAIN, '--no-ros', '--out', 'x.txt'], 2, 'must end in .csv'),
    (['chain', CHAIN, '--no-ros', '--out', 'gone/x.csv'], 4, 'there is no folder gone'),
    (['chain', 'gone.yaml', '--no-ros'], 3, 'gone.yaml: no such chain file'),
    (['compensator', '--urdf', URDF, '--tip', 'tol'], 3, 'tip: no link tol; did you mean tool?'),
    (['compensator', '--tip', 'tool', '--axes', 'x,u'], 2, "--axes = ['x', 'u']: each must be one of"),
    (['compensator', '--urdf', URDF], 3, 'tip: the link of the end effector must be named'),
    (['compensator', '--drive'], 3, 'tip: the link of the end effector must be named'),
    (['compensator', '--urdf', URDF, '--tip', 'tool', '--stale', 'nan'], 2, '--stale = nan s: must be finite'),
    (['compensator', '--urdf', 'gone.urdf', '--tip', 'tool'], 3, 'gone.urdf: no such URDF file'),
]
REJECTED_SLOWLY: list[tuple[list[str], int, str]] = [
    (['shaper'], 3, 'which mode: give params_file, or frequency and damping_ratio; or shaper: none'),
    (['shaper', '--shaper', 'zvx'], 2, "--shaper = 'zvx': must be one of zv, mzv, zvd, ei, recommended, none"),
    (['shaper', '--damping-ratio', '0.1'], 2, 'damping_ratio: must be given together with frequency'),
    (['shaper', '--frequency', '-9', '--damping-ratio', '0'], 2, '--frequency = -9.0 Hz: must be at least 0'),
    (['shaper', '--frequency', '0.01'], 2, '--frequency = 0.01 Hz: must be at least 0.1'),
    (['shaper', '--frequency', '9', '--params-file', RIG], 2, 'frequency and params_file: must not be given'),
    (['shaper', '--params-file', RIG, '--modes', 'bending,bending'], 2, 'modes: none may be there twice'),
    (['shaper', '--params-file', RIG, '--modes', 'shear'], 2, 'each must be one of bending, torsion'),
    (['shaper', '--max-step', 'nan'], 2, '--max-step = nan rad or m: must be finite'),
    (['shaper', '--params-file', 'gone.yaml'], 3, 'gone.yaml: no such parameter file'),
    (['shaper', '--shaper', 'none', '--urdf', 'gone.urdf'], 3, 'gone.urdf: no such URDF file'),
    (['budget', '--set', 'nothing'], 2, 'NAME=VALUE'),
    (['budget', '--set', 'nothing=1'], 2, 'no such input'),
    (['budget', '--monte-carlo', '1'], 2, '--monte-carlo'),
    (['budget', '--monte-carlo', '1000', '--seed', '-1'], 2, '--seed'),
    (['budget', '--load', 'nan', '0', '0'], 2, 'must be finite'),
    (['budget', '--load', '0', '-500', '0'], 2, 'take a smaller load'),
    (['budget', '--load', '1e300', '0', '0'], 2, 'than the link is long'),
    (['budget', '--out', 'budget.txt'], 2, '.png, .svg or .pdf'),
    (['budget', '--inputs', 'absent.yaml'], 3, 'absent.yaml'),
    (['budget', '--params-file', 'absent.yaml'], 3, 'absent.yaml'),
    (['design', '--params-file', RIG, '--sigma', '0'], 2, '--sigma'),
    (['design', '--params-file', RIG, '--radius', '-1'], 2, '--radius'),
    (['design', '--params-file', RIG, '--out', 'plan.txt'], 2, '.png, .svg or .pdf'),
    (['design', '--params-file', RIG, '--out', 'no/such/folder/plan.png'], 4, 'cannot be written'),
]


@pytest.mark.parametrize(
    ('argv', 'status', 'message'),
    [
        *filter(offered, REJECTED),
        *(pytest.param(*row, marks=pytest.mark.slow) for row in REJECTED_SLOWLY if offered(row)),
    ],
    ids=lambda v: ' '.join(v)[-60:] if isinstance(v, list) else '',
)
def test_what_cannot_be_asked_for_is_one_line(
    argv: list[str], status: int, message: str, folder: Path, capsys: Capsys
) -> None:
    (folder / 'taken').touch()
    ended, err = rejected(capsys, *argv)
    assert ended == status
    assert message in err
    assert [p.name for p in folder.iterdir()] == ['taken']


@pytest.mark.slow
@pytest.mark.parametrize(('command', 'also'), [('convert', '.rrd'), ('replay', '.rrd .parquet'), ('simulate', '')])
def test_recording_name_of_foreign_suffix_is_rejected(command: str, also: str, folder: Path, capsys: Capsys) -> None:
    arguments = [] if command == 'simulate' else [CLEAN]
    for suffix in sorted(FOREIGN - {*also.split()}):
        for name in (f'run{suffix}', f'run_0.5N{suffix.upper()}'):
            status, err = rejected(capsys, command, *arguments, '--out', name)
            assert status == 2
            assert f'--out {name}: {suffix} cannot be written; use X.csv, X.mcap' in err
            assert ('X.rrd' in err) == bool(also)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize('name', ['run', 'run_0.5N', 'run.2026.01.02', '12.5', 'a.b', '.hidden', 'run.'])
def test_any_other_dot_is_part_of_a_folder_s_name(name: str, folder: Path) -> None:
    assert main(['convert', CLEAN, '--out', name]) == 0
    assert (folder / name / 'metadata.yaml').is_file()
    assert main(['simulate', *SHORT, '--out', f'sim_{name}']) == 0
    assert (folder / f'sim_{name}' / 'metadata.yaml').is_file()


@pytest.mark.parametrize(
    'argv',
    [
        ['simulate', '--out', 'a.csv', *SHORT, '--temperature', '-5,-2.5e1'],
        ['budget', '--json', '--load', '-1e0', '-5e1', '-.5'],
        ['design', '--params-file', RIG, '--box', '-1.2e-1', '-.1', '1e-1', '1e-1'],
    ],
    ids=lambda argv: argv[0],
)
def test_a_negative_number_is_a_value_however_it_is_written(argv: list[str]) -> None:
    assert argv[0] not in COMMANDS or main(argv) == 0


def bad_from_row(folder: Path, row: int) -> Path:
    """A CSV that can be read up to ``row``."""
    path = folder / 'bad.csv'
    rows = [f'{i / 1000:.3f},0,0,5,0,{"0" if i < row else "abc"},5' for i in range(row + 3)]
    path.write_text('\n'.join(['t,x1,y1,sum1,x2,y2,sum2', *rows]) + '\n')
    return path


@pytest.mark.parametrize('name', ['out.csv', 'out.mcap', 'out'])
@pytest.mark.parametrize('command', ['convert', 'replay'])
def test_unfinished_output_stays_partial(command: str, name: str, folder: Path, capsys: Capsys) -> None:
    bad = bad_from_row(folder, 2000)
    for partial in (f'{name}.partial', f'{name}.partial2'):
        status, err = rejected(capsys, command, str(bad), '--out', name)
        assert status == 4
        assert "column y2 holds 'abc'" in err
        assert f'{partial} holds what came before' in err
        assert (folder / partial).exists()
        assert not (folder / name).exists()


@pytest.fixture
def signals() -> Iterator[None]:
    """Handlers as in a program that has just begun: commands that go on until Ctrl-C leave theirs behind."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures('signals')
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize(
    ('argv', 'sink'),
    [
        (['simulate', '--loads', 'thesis'], CSV_SINK),
        (['convert', CLEAN], CSV_SINK),
        (['replay', CLEAN], 'psd_deflection.cli.recordings.replay.Totals.add'),
    ],
    ids=lambda v: v[0] if isinstance(v, list) else '',
)
def test_ctrl_c_leaves_no_output_that_looks_whole(
    argv: list[str], sink: str, number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.setattr(sink, lambda *_: signal.raise_signal(number))
    before = signal.getsignal(number)
    assert main([*argv, '--out', 'out.csv']) == 130
    assert signal.getsignal(number) is before
    reported = f'psd-deflection {argv[0]}: interrupted; out.csv.partial holds what came before\n'
    assert capsys.readouterr().err == reported


class Finalised:
    """Python drops what a signal raises in here."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures('signals')
def test_ctrl_c_that_python_drops_comes_again(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    dropped: list[object] = []

    def put(self: object, record: object) -> None:
        if not dropped:
            Finalised()
            # Not reached if the signal was not dropped.
            dropped.append(record)
        # Nothing ends this but the interrupt.
        threading.Event().wait(60.0)

    monkeypatch.setattr(CSV_SINK, put)
    before = sys.unraisablehook
    assert main(['convert', CLEAN, '--out', 'out.csv']) == 130
    assert dropped
    assert sys.unraisablehook is before
    assert capsys.readouterr().err.startswith('psd-deflection convert: interrupted; out.csv.partial')
    assert [p.name for p in folder.iterdir()] == ['out.csv.partial']


def test_an_existing_output_is_not_moved(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    out = folder / 'out.csv'
    out.write_text('mine')
    status, err = rejected(capsys, 'convert', CLEAN, '--out', 'out.csv')
    assert (status, 'never overwritten' in err) == (4, True)
    monkeypatch.setattr('psd_deflection.cli.recordings.simulate.run', Mock(side_effect=KeyboardInterrupt))
    for name in ('out.csv', 'none.csv'):
        assert main(['simulate', '--out', name]) == 130
        assert capsys.readouterr().err == 'psd-deflection: interrupted\n'
    assert (out.read_text(), list(folder.iterdir())) == ('mine', [out])


@pytest.mark.skipif('discover' not in COMMANDS, reason='an optional room')
def test_discover_without_input_leaves_no_folder(folder: Path, capsys: Capsys) -> None:
    assert (rejected(capsys, 'discover', CLEAN, '--out', 'found')[0], list(folder.iterdir())) == (4, [])


def test_a_picture_is_whole_or_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, link = folder / 'a.png', folder / 'link.png'
    place.write_bytes(b'old')
    link.symlink_to(place)
    _report.save(b'new', link)
    assert place.read_bytes() == b'new'
    assert link.is_symlink()
    monkeypatch.setattr(os, 'fsync', Mock(side_effect=OSError(28, 'No space left on device')))
    with pytest.raises(RecordingError, match=r'^--out .*a\.png: cannot be written \(No space left on device\)$'):
        _report.save(b'newer', place)
    assert (sorted(folder.iterdir()), place.read_bytes()) == ([place, link], b'new')


def program(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """``line`` in a shell, with PROGRAM as our program; a pipe's status is that of the program."""
    command = line.replace('PROGRAM', f'"{sys.executable}" -m psd_deflection')
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), **environment}
    return subprocess.run(['bash', '-o', 'pipefail', '-c', command], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize('unbuffered', ['', '1'], ids=['buffered', 'unbuffered'])
@pytest.mark.parametrize('command', ['params', 'params --json', 'info CLEAN', '--help'])
def test_a_closed_pipe_is_not_an_error(command: str, unbuffered: str) -> None:
    command = command.replace('CLEAN', CLEAN)
    for reader in ('true', 'head -1'):
        done = program(f'PROGRAM {command} | {reader}', PYTHONUNBUFFERED=unbuffered)
        assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='no /dev/full here')
@pytest.mark.parametrize('unbuffered', ['', '1'], ids=['buffered', 'unbuffered'])
@pytest.mark.parametrize('command', ['params', 'info CLEAN --json', 'convert CLEAN --out whole.csv'])
def test_an_output_that_cannot_be_written_to_is_one_line(command: str, unbuffered: str, folder: Path) -> None:
    done = program(f'PROGRAM {command.replace("CLEAN", CLEAN)} > /dev/full', PYTHONUNBUFFERED=unbuffered)
    assert done.returncode == 4
    assert done.stderr == 'psd-deflection: the standard output cannot be written (No space left on device)\n'
    # The file was done before it could not be told.
    assert (folder / 'whole.csv').exists() == ('whole.csv' in command)


@pytest.mark.slow
@pytest.mark.skipif(not Path('/dev/full').exists(), reason='no /dev/full here')
@pytest.mark.parametrize('where', ['2>&-', '2>/dev/full'])
def test_a_closed_standard_error_keeps_the_exit_status(where: str, folder: Path) -> None:
    (folder / 'cut.mcap').write_bytes(Path(CLEAN, 'clean_0.mcap').read_bytes()[:100_000])
    done = program(f'PROGRAM replay nowhere {where}')
    assert (done.returncode, done.stdout) == (4, '')
    for what, least in ((f'{CLEAN} --json {where}', 4000), ('cut.mcap --json 2>&-', 1001)):
        done = program(f'PROGRAM replay {what}')
        assert done.returncode == 0
        assert least <= strict(done.stdout)['samples'] <= 4000


def test_no_letter_is_missing_so_much_that_it_fails() -> None:
    done = program(f'PROGRAM replay {CLEAN}', PYTHONIOENCODING='ascii')
    assert (done.returncode, done.stderr) == (0, '')
    assert '4000 samples' in done.stdout


def test_a_name_that_is_no_text_is_drawn_as_far_as_it_is(folder: Path) -> None:
    name = os.fsdecode(b'n\xff.mcap')
    (folder / name).write_bytes(Path(CLEAN, 'clean_0.mcap').read_bytes())
    assert main(['plot', name, '--out', 'a.html']) == 0
    assert 'n\ufffd.mcap' in (folder / 'a.html').read_text(encoding='utf-8')


def strict(text: str) -> Any:
    """``text`` as JSON; NaN and Infinity are none."""

    def reject(constant: str) -> float:
        raise AssertionError(constant)

    return json.loads(text, parse_constant=reject)


def odd_recording(folder: Path) -> Path:
    """A foreign .mcap without samples, whose rig holds numbers that JSON has not."""
    path = folder / 'odd.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        parameters = '{"link.length": NaN, "psd_1.center": [Infinity, 0.0]}'
        rig = f'{{"version": "1", "t_ns": 0, "block": 0, "parameters": {parameters}, "changed": {{}}}}'
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
        for topic, text in (('/link_tip/rig', rig), ('/chatter', 'a')):
            words = text.encode() + b'\0'
            message = b'\0\1\0\0' + len(words).to_bytes(4, 'little') + words
            writer.add_message(writer.register_channel(topic, 'cdr', schema), 1, message, 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    'argv',
    [
        ['info', CLEAN],
        ['info', 'odd.mcap'],
        ['replay', CLEAN],
        ['replay', CLEAN, '--compare'],
        ['plot', CLEAN, '--out', 'a.svg'],
        ['plot', 'dark.csv', '--out', 'a.svg'],
        ['convert', CLEAN, '--out', 'a.csv'],
        ['recover', 'cut.mcap'],
        ['simulate', *SHORT, '--out', 'a'],
        ['params'],
        *([['budget', '--load', '0', '0', '0', '--monte-carlo', '100']] if 'budget' in COMMANDS else []),
        ['devices'],
    ],
    ids=' '.join,
)
def test_json_is_all_that_is_on_stdout(
    argv: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    # Whatever this machine has is not for a test to speak to.
    monkeypatch.setattr('serial.tools.list_ports.comports', list)
    odd_recording(folder)
    rows = [f'{i / 1000:.3f},0,0,0,0,0,0' for i in range(100)]
    (folder / 'dark.csv').write_text('\n'.join(['t,x1,y1,sum1,x2,y2,sum2', *rows]) + '\n')
    (folder / 'cut.mcap').write_bytes(Path(CLEAN, 'clean_0.mcap').read_bytes()[:100_000])
    # A recording of another machine may differ in its last bits.
    assert main([*argv, '--json']) in ((0, 1) if '--compare' in argv else (0,))
    out, err = capsys.readouterr()
    tree = strict(out)
    assert isinstance(tree, dict)
    if '--compare' in argv:
        compared = tree['compared']
        assert compared['equal'] + compared['different'] > 1000
        assert compared['same'] == (not compared['different'])
    elif argv[0] == 'replay':
        assert tree['compared'] is None
    elif argv[0] == 'recover':
        (recording,) = tree['recordings']
        (file,) = recording['files']
        assert file['repaired']
        assert file['messages'] > 500
    # A verdict and a warning are for whoever reads the log; a CSV file says nothing of its rig.
    assert (err == '') == ('--compare' not in argv and argv[0] != 'recover' and 'dark.csv' not in argv)


@pytest.mark.parametrize(
    ('error', 'why'),
    [(MemoryError(), 'too little memory'), (RuntimeError("can't start new thread"), 'no further thread')],
)
def test_a_machine_that_gives_no_more_is_one_line(
    error: Exception, why: str, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.setattr('psd_deflection.cli.recordings.info.open_recording', Mock(side_effect=error))
    assert main(['info', 'x.csv']) == 71
    output = capsys.readouterr().err
    assert (why in output, output.count('\n')) == (True, 1)


def test_another_error_of_ours_is_still_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    defect = Mock(side_effect=RuntimeError('a defect'))
    monkeypatch.setattr('psd_deflection.cli.recordings.info.open_recording', defect)
    with pytest.raises(RuntimeError, match='a defect'):
        main(['info', 'x.csv'])


def reported() -> Iterator[tuple[Path, str]]:
    """Every text of the package that is no docstring."""
    for path in sorted((ROOT / 'psd_deflection').rglob('*.py')):
        tree = ast.parse(path.read_text(encoding='utf-8'))
        alone = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
        for n in ast.walk(tree):
            if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in alone:
                yield path, n.value


def test_micrometres_use_one_symbol_in_all_texts() -> None:
    # Names that scripts read, of columns and of keys of /diagnostics, are ASCII: `shift (um)`.
    wrong = [(path.name, text) for path, text in reported() if re.search(r'(?<![\w(])(um|urad)(?!\w)', text)]
    assert wrong == []


@pytest.mark.parametrize(
    ('body', 'status', 'message'),
    [
        ('solver: exakt', 3, "solver = 'exakt': must be one of exact, wls,"),
        ('psd_2: {center: [0.0, 0.070]}', 6, 'coincide'),
        ('effects: {creap: {amplitude: 0.1}}', 3, 'did you mean creep?'),
        ('block_size: 0', 3, 'rig.yaml: block_size = 0 samples: must be at least 1'),
        ('[', 3, 'malformed YAML'),
    ],
)
def test_params_rejects_a_rig_that_cannot_be_evaluated(
    body: str, status: int, message: str, folder: Path, capsys: Capsys
) -> None:
    (folder / 'rig.yaml').write_text(f'/**:\n  ros__parameters:\n    {body}\n')
    ended, err = rejected(capsys, 'params', '--params-file', 'rig.yaml')
    assert ended == status
    assert message in err


def test_a_recording_with_a_typing_error_is_found(capsys: Capsys) -> None:
    for name, words in ((f'{CLEAN}n', '; did you mean clean?'), ('/nowhere/at/all', '')):
        status, err = rejected(capsys, 'info', name)
        assert (status, err.endswith(f'{name}: no such recording{words}\n')) == (4, True)


@pytest.mark.slow
@pytest.mark.parametrize('command', ['replay', 'plot', 'info'])
def test_how_long_a_recording_lasts_is_by_its_stamps(command: str, tmp_path: Path, capsys: Capsys) -> None:
    """At 200 Hz, with the rig file of 1000 Hz."""
    path = tmp_path / 'run.csv'
    rows = '\n'.join(f'{i / 200:.3f},0.0{i % 7},0.0{i % 5},5,0.0{i % 3},0.0{i % 4},5' for i in range(400))
    path.write_text(f't,x1,y1,sum1,x2,y2,sum2\n{rows}\n')
    out = ['--out', str(tmp_path / 'run.png')] if command == 'plot' else []
    assert main([command, str(path), '--json', *out]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree['seconds' if command == 'replay' else 'duration_s'] == pytest.approx(2.0)


ESCAPE = '\x1b[31mred\x1b]0;title\x07\nstate complete'


def clean_of(text: str) -> None:
    assert all(line.isprintable() for line in text.splitlines())
    assert '\nstate complete' not in text


def test_info_prints_no_control_characters(monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    def opened(path: Path, namespace: str | None = None, **_: object) -> Recording:
        recording = info_of(path)
        recording.hello = {'serial': ESCAPE, ESCAPE: '\ud800', 'firmware': 'x' * 10_000}
        recording.version = ESCAPE
        recording.parameters = {ESCAPE: ESCAPE}
        return recording

    info_of = open_recording
    monkeypatch.setattr(info, 'open_recording', opened)
    assert main(['info', CLEAN]) == 0
    out = capsys.readouterr().out
    clean_of(out)
    assert '\\x1b[31mred' in out


@pytest.mark.slow
def test_names_of_files_reach_the_terminal_in_printable_lines(tmp_path: Path, capsys: Capsys) -> None:
    copy = tmp_path / 'copy\x1b[31m\nstate complete'
    shutil.copytree(CLEAN, copy)
    (copy / 'metadata.yaml').unlink()
    for command, suffix in (('recover', ''), ('replay', '.csv'), ('convert', '.mcap'), ('plot', '.svg')):
        assert main([command, str(copy), *(['--out', f'{copy}{suffix}'] if suffix else [])]) == 0
        output = capsys.readouterr().out
        clean_of(output)
        assert '\\x1b[31m\\nstate' in output, command


def test_a_message_about_a_file_prints_none_either(tmp_path: Path, capsys: Capsys) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**: {ros__parameters: {"\\e[31mRED": 1}}')
    assert main(['params', '--params-file', str(rig)]) == 3
    copy = tmp_path / 'copy\x1b[31m'
    shutil.copytree(CLEAN, copy)
    (copy / 'metadata.yaml').write_text('x: [')
    assert main(['info', str(copy)]) == 4
    output = capsys.readouterr().err
    clean_of(output)
    assert '\\x1b[31m' in output
