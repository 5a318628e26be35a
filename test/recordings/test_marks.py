# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Marks of a recording: read, listed, drawn, converted, and used as bounds of a part."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import pytest

import psd_deflection
from msg_adapters import MARK, to_messages
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli.main import main
from psd_deflection.recordings import cdr
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.recordings.write.sinks import open_sink
from psd_deflection.records import Mark

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
