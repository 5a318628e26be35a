# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plain lines of a CSV are read many at once: the same rows and the same errors as one by one."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read import csv_rows
from psd_deflection.recordings.read.csv_rows import SampleRows

TIMES = st.lists(
    st.one_of(
        st.sampled_from(['{}.000', '{}.5', '{}.000000001', '{}.25', '{}', '{}e0', ' {}.5', '{}.0000000004']),
        st.sampled_from(['', 'x', '3.', '-1.0', '1_0.0', '9999999999.0', 'nan']),
    ),
    min_size=1,
    max_size=12,
)
CELLS = st.sampled_from(['1.5', '-2e-3', '', 'nan', ' 7', 'ä', '1_0', '+.5'])
ODD = st.sampled_from(['', '1.0', '1.0,2,3,4', '#', ' '])


def reported(path: Path, lines: list[str], ending: str, last: str) -> tuple[list[tuple[int, int, list[str]]], str]:
    """(line, t_ns, cells) of each row before the error, and the error without its file."""
    path.write_bytes((ending.join(lines) + last).encode())
    table = SampleRows(path)
    found = []
    try:
        for lines_, t_ns, cells in table.rows():
            width = len(table.header)
            found += [
                (line, t, [c.strip() for c in cells[i * width : (i + 1) * width]])
                for i, (line, t) in enumerate(zip(lines_, t_ns, strict=True))
            ]
    except RecordingError as error:
        return found, str(error).removeprefix(str(path))
    return found, ''


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('rows')


@given(
    times=TIMES,
    cells=st.lists(CELLS, min_size=12, max_size=12),
    odd=st.dictionaries(st.integers(0, 11), ODD, max_size=1),
    ending=st.sampled_from(['\n', '\r\n']),
    last=st.sampled_from(['', '\n']),
    piece=st.integers(1, 80),
)
def test_lines_in_pieces_and_lines_in_quotes_give_the_same(
    folder: Path, times: list[str], cells: list[str], odd: dict[int, str], ending: str, last: str, piece: int
) -> None:
    rows = [(time.format(i), '0.5', cell) for i, (time, cell) in enumerate(zip(times, cells, strict=False))]

    def lines(quote: str) -> list[str]:
        written = [','.join(f'{quote}{cell}{quote}' for cell in row) for row in rows]
        return ['t,x1,y1', *(odd.get(i, line) for i, line in enumerate(written))]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_rows, '_PIECE', piece)
        at_once = reported(folder / 'a.csv', lines(''), ending, last)
    one_by_one = reported(folder / 'a.csv', lines('"'), ending, last)
    assert at_once == one_by_one


def test_plain_rows_come_together_and_keep_their_nanoseconds(tmp_path: Path) -> None:
    path = tmp_path / 'a.csv'
    count = 20_000
    path.write_text('t,x1\n' + ''.join(f'1700000000.{i:09d},{i}\n' for i in range(count)))
    parts = list(SampleRows(path).rows())
    assert len(parts) < 20
    assert [t for part in parts for t in part.t_ns] == [1_700_000_000 * 10**9 + i for i in range(count)]
    assert [line for part in parts for line in part.lines] == list(range(2, count + 2))
    assert [cell for part in parts for cell in part.cells[1::2]] == [str(i) for i in range(count)]


def test_a_blank_line_ends_the_plain_rows_and_not_the_reading(tmp_path: Path) -> None:
    path = tmp_path / 'a.csv'
    path.write_text('t,x1\n0.1,1\n\n0.2,2\n')
    assert [(list(r.lines), list(r.t_ns)) for r in SampleRows(path).rows()] == [([2, 4], [100_000_000, 200_000_000])]


def test_a_line_without_an_end_is_rejected_before_it_is_held(tmp_path: Path) -> None:
    path = tmp_path / 'a.csv'
    path.write_text('t,x1\n0.1,1\n0.2,' + '1' * 200_000)
    table = SampleRows(path)
    with pytest.raises(RecordingError, match=r':3: is longer than 10000 characters'):
        list(table.rows())
