# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV recordings in and out."""

import math
import os
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read import csv_reader
from psd_deflection.recordings.read.csv_reader import CsvRecording, SampleRows
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.write.csv_writer import CsvEstimateSink, CsvSampleSink, seconds
from psd_deflection.records import AppliedLoad, Record, ReferencePose, SampleBlock, TemperatureReading, TipLoad

from .making import STEP, T0, block, estimate

HEADER = 't,x1,y1,sum1,x2,y2,sum2'
ROW = '1.5,-2.25,5,0.5,0,5'


def write(path: Path, *lines: str) -> Path:
    path.write_text('\n'.join(lines) + '\n')
    return path


def put_all(sink: CsvSampleSink | CsvEstimateSink, records: Sequence[Record]) -> CsvSampleSink | CsvEstimateSink:
    """The sink, closed behind them."""
    for record in records:
        sink.put(record)
    sink.close()
    return sink


def rows(times: list[str]) -> list[str]:
    return [HEADER, *(f'{t},{ROW}' for t in times)]


def test_a_plain_file_is_read(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path / 'a.csv', *rows([f'{i / 1000:.3f}' for i in range(45)])))
    blocks = list(recording.blocks())
    assert [(b.index, len(b.seq)) for b in blocks] == [(0, 20), (1, 20), (2, 5)]
    np.testing.assert_array_equal(blocks[2].t_ns, np.arange(40, 45) * STEP)
    np.testing.assert_array_equal(blocks[0].volts[0], np.array([1.5, -2.25, 5, 0.5, 0, 5], np.float32))
    assert (recording.sample_rate_hz, recording.topics()) == (1000.0, {'/psd/samples': 3})
    assert (recording.parameters, recording.hello, recording.complete) == ({}, None, True)
    assert recording.estimates() == {}


def test_gaps_in_time_are_lost_samples(tmp_path: Path) -> None:
    present = [i for i in range(100) if i not in (3, 4, 40, 41, 42) and not 60 <= i < 80]
    recording = open_recording(write(tmp_path / 'a.csv', *rows([f'{i / 1000:.3f}' for i in present])))
    assert (recording.samples['seq'].tolist(), [b.index for b in recording.blocks()]) == (present, [0, 1, 2, 4])


@pytest.mark.slow
@pytest.mark.parametrize('rate', [50.0, 1000.0, 3000.0, 9999.0])
@pytest.mark.parametrize('decimals', [4, 6, 9])
def test_short_decimals_and_a_fast_clock_make_no_losses(tmp_path: Path, rate: float, decimals: int) -> None:
    if rate * 10**-decimals > 0.31:
        decimals = 5
    present = [i for i in range(20_000) if i % 997]
    times = [f'{i * 1.0003 / rate:.{decimals}f}' for i in present]
    recording = open_recording(write(tmp_path / 'a.csv', *rows(times)))
    assert (np.diff(recording.samples['seq'])).tolist() == np.diff(present).tolist()
    assert recording.sample_rate_hz == pytest.approx(rate / 1.0003, rel=1e-3)


def test_jitter_of_less_than_half_a_step_makes_no_losses(tmp_path: Path) -> None:
    jitter = np.random.default_rng(1).uniform(-0.35, 0.35, 20_000)
    times = [seconds(round((10 + i + j) * STEP)) for i, j in enumerate(jitter)]
    recording = open_recording(write(tmp_path / 'a.csv', *rows(times)))
    assert recording.samples['seq'].tolist() == list(range(20_000))
    for late, number in ((0.49, 100), (0.51, 101)):
        times = [seconds(round((10 + i + late * (i == 100)) * STEP)) for i in range(101)]
        assert open_recording(write(tmp_path / f'{late}.csv', *rows(times))).samples['seq'][-1] == number


def test_the_rate_can_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / 'a.csv', *rows(['0', '0.003', '0.006', '0.009']))
    assert open_recording(path, sample_rate_hz=1000.0).samples['seq'].tolist() == [0, 3, 6, 9]
    assert open_recording(path).samples['seq'].tolist() == [0, 1, 2, 3]


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_times_keep_every_nanosecond(t_ns: int) -> None:
    assert Decimal(seconds(t_ns)) * 10**9 == t_ns


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31 * 10**9 - 3), st.sampled_from(['{}.{:09d}', ' {}.{:09d} ', '+{}.{:09d}', '{}{:09d}e-9']))
def test_times_are_read_to_the_nanosecond(tmp_path: Path, t_ns: int, form: str) -> None:
    times = [form.format(*divmod(t_ns + i, 10**9)) for i in range(2)]
    recording = CsvRecording(write(tmp_path / 'a.csv', *rows(times)), sample_rate_hz=1e9)
    assert recording.samples['t_ns'].tolist() == [t_ns, t_ns + 1]


@pytest.mark.slow
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=6, max_size=6))
def test_volts_come_through_bit_for_bit(tmp_path: Path, volts: list[float]) -> None:
    path = tmp_path / 'a.csv'
    path.unlink(missing_ok=True)
    v = np.array([volts, volts], np.float32)
    given_block = SampleBlock(0, np.arange(2), T0 + np.arange(2) * STEP, v, np.zeros(2, np.uint8))
    put_all(CsvSampleSink(path), [given_block])
    (back,) = open_recording(path).blocks()
    assert back.volts.tobytes() == v.tobytes()
    np.testing.assert_array_equal(back.t_ns, given_block.t_ns)


def test_samples_with_all_columns_come_back(tmp_path: Path) -> None:
    blocks = [block(i, lost=(4, 9) if i == 1 else ()) for i in range(3)]
    loads = [AppliedLoad(T0, 0.0, 0.0, 0.0), AppliedLoad(T0 + 25 * STEP, 1.0, -2.0, 0.1)]
    references = [ReferencePose(T0 + 7 * STEP, 1e-3, 2e-3, 0.1), ReferencePose(T0 + 30 * STEP, 1.5e-3, 2e-3, 0.2)]
    temperatures = [TemperatureReading(T0 + 10 * STEP, 21.5)]
    sink = CsvSampleSink(tmp_path / 'a.csv', [AppliedLoad, ReferencePose, TemperatureReading])
    put_all(sink, [*loads, *references, *temperatures, TipLoad(T0, 9.0, 9.0, 9.0), *blocks])
    recording = open_recording(tmp_path / 'a.csv')
    np.testing.assert_array_equal(recording.samples['seq'], np.concatenate([b.seq for b in blocks]))
    assert (recording.loads(), recording.references()) == (loads, references)
    assert (recording.temperatures(), recording.topics()['/reference/deflection']) == (temperatures, 2)


def test_records_between_two_samples_go_to_the_later_row(tmp_path: Path) -> None:
    sink = CsvSampleSink(tmp_path / 'a.csv', [AppliedLoad])
    put_all(sink, [AppliedLoad(T0 + 3 * STEP + 1, 1.0, 0.0, 0.0), block(0)])
    assert open_recording(tmp_path / 'a.csv').loads() == [AppliedLoad(T0 + 4 * STEP, 1.0, 0.0, 0.0)]


def test_a_load_that_is_written_in_every_row_is_one_load(tmp_path: Path) -> None:
    lines = [HEADER + ',load_fx,load_fy,load_tz', *(f'{i}e-3,{ROW},{i // 5},0,0' for i in range(10))]
    loads = open_recording(write(tmp_path / 'a.csv', *lines)).loads()
    assert loads == [AppliedLoad(0, 0.0, 0.0, 0.0), AppliedLoad(5 * STEP, 1.0, 0.0, 0.0)]


def test_columns_in_any_order_with_spaces_and_more(tmp_path: Path) -> None:
    lines = ['note, sum2,y2,x2,sum1,y1,x1, t', 'a,6,5,4,3,2,1,0.000', 'b,6,5,4,3,2,1, 0.001', '']
    path = tmp_path / 'a.csv'
    path.write_bytes(b'\xef\xbb\xbf' + '\r\n'.join(lines).encode())
    recording = open_recording(path)
    (b,) = recording.blocks()
    assert b.volts.tolist() == [[1, 2, 3, 4, 5, 6]] * 2
    assert recording.warnings == [f'{path}:1: columns that are not read: note']


GOOD = [f'0.000,{ROW}', f'0.001,{ROW}']


@pytest.mark.parametrize(
    ('lines', 'message'),
    [
        ([], 'is empty'),
        (['t,x1,y1'], ':1: the header lacks sum1, x2, y2, sum2'),
        (['0,1,2,3,4,5,6'], ':1: the header lacks t, x1'),
        ([HEADER + ',x1'], ':1: column x1 is there twice'),
        ([HEADER + ',load_fx', *GOOD], ':1: has load_fx without load_fy, load_tz'),
        ([HEADER], 'holds 0 samples'),
        ([HEADER, GOOD[0]], 'holds 1 samples'),
        ([HEADER, *GOOD, '0.002,1,2'], ':4: has 3 cells, the header has 7'),
        ([HEADER, *GOOD, '0.002,1,2,3,4,abc,6'], ":4: column y2 holds 'abc', which is not a number"),
        ([HEADER, *GOOD, '0.002,1,2,3,4,,6'], ":4: column y2 holds '', which is not a number"),
        ([HEADER, *GOOD, '0.002,1,nan,3,4,5,6'], ":4: column y1 holds 'nan', which is not finite"),
        ([HEADER, *GOOD, '0.002,1,1e300,3,4,5,6'], ":4: column y1 holds '1e300', which is beyond"),
        ([HEADER, *GOOD, f'0.001,{ROW}'], ":4: column t holds '0.001', which is not after the row before"),
        ([HEADER, *GOOD, f'-1,{ROW}'], ":4: column t holds '-1'; seconds from 0"),
        ([HEADER, *GOOD, f'1e30,{ROW}'], ":4: column t holds '1e30'; seconds from 0"),
        ([HEADER, *GOOD, f'inf,{ROW}'], ":4: column t holds 'inf'; seconds from 0"),
        ([HEADER, *GOOD, f'4294967296.0,{ROW}'], ":4: column t holds '4294967296.0'; seconds from 0"),
        # Python reads these as numbers; in a recording they are typing errors.
        ([HEADER, *GOOD, '0.002,1,1_000,3,4,5,6'], ":4: column y1 holds '1_000', which is not a number"),
        ([HEADER, *GOOD, '0.002,1,٣,3,4,5,6'], ":4: column y1 holds '٣', which is not a number"),
        ([HEADER, *GOOD, f'0.00_2,{ROW}'], ":4: column t holds '0.00_2', which is not a number"),
        ([HEADER, *GOOD, f'٣,{ROW}'], ":4: column t holds '٣', which is not a number"),
        ([HEADER, *GOOD, f'soon,{ROW}'], ":4: column t holds 'soon', which is not a number"),
        ([HEADER, *GOOD, f'1.2.3,{ROW}'], ":4: column t holds '1.2.3', which is not a number"),
        ([HEADER + ',temperature', *(g + ',x' for g in GOOD)], ":2: column temperature holds 'x', which is not"),
        ([HEADER + ',ref_dx,ref_dy,ref_theta', *(g + ',1,,2' for g in GOOD)], ':2: has ref_dx, ref_theta without'),
        ([HEADER, 'x' * 20_000], ':2: is longer than 10000 characters'),
        ([HEADER, *GOOD, '0.002,1,2,3,4,5,"6'], ':4: is no row of a CSV'),
        ([HEADER, *GOOD, '0.002,1,2,3,4,5,"6"7'], ':4: is no row of a CSV'),
    ],
)
def test_errors_name_file_line_and_column(tmp_path: Path, lines: list[str], message: str) -> None:
    path = tmp_path / 'run.csv'
    path.write_text('\n'.join(lines))

    def read() -> None:
        recording = open_recording(path)
        list(recording.blocks())
        recording.temperatures()
        recording.references()

    with pytest.raises(RecordingError) as caught:
        read()
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_what_is_no_text_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(RecordingError, match='is not text in UTF-8'):
        open_recording(tmp_path / 'a.csv')


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=60), st.integers(0, 200))
def test_no_text_ends_in_a_traceback(tmp_path: Path, junk: str, where: int) -> None:
    text = '\n'.join([HEADER + ',temperature', *(f'0.00{i},{ROW},20' for i in range(4))])
    path = tmp_path / 'a.csv'
    path.write_bytes((text[:where] + junk + text[where:]).encode('utf-8', 'surrogatepass'))
    line = ''
    try:
        for b in open_recording(path).blocks():
            assert np.isfinite(b.volts).all()
    except RecordingError as error:
        line = str(error)
    assert '\n' not in line.replace(repr(junk)[1:-1], '')


def test_estimates_have_one_row_a_block(tmp_path: Path) -> None:
    of_wls = [estimate(i, 'wls', primary=False)._replace(dx=dx) for i, dx in ((0, 0.25), (4, 0.5))]
    load, later = TipLoad(estimate(0).t_ns, 1.5, -2.5, 0.125), TipLoad(estimate(2).t_ns, 9.0, 9.0, 9.0)
    records = (block(0), estimate(0), load, of_wls[0], later, estimate(3)._replace(chi_square=1.25), of_wls[1])
    put_all(CsvEstimateSink(tmp_path / 'e.csv', ['exact', 'wls']), records).close()
    header, first, second, third = (tmp_path / 'e.csv').read_text().splitlines()
    by_solver = 'exact_dx,exact_dy,exact_theta,wls_dx,wls_dy,wls_theta'
    assert header == f't,dx,dy,theta,sd_dx,sd_dy,sd_theta,{by_solver},chi_square,fx,fy,tz'
    e = estimate(0)
    cells = first.split(',')
    assert cells[0] == f'{e.t_ns // 10**9}.{e.t_ns % 10**9:09d}'
    assert [float(c) for c in cells[1:4]] == [e.dx, e.dy, e.theta]
    assert [float(c) for c in cells[4:7]] == [math.sqrt(e.covariance[i]) for i in (0, 4, 8)]
    assert [float(c) for c in cells[7:13]] == [e.dx, e.dy, e.theta, 0.25, e.dy, e.theta]
    assert (cells[13:], second.split(',')[10:]) == (['', '1.5', '-2.5', '0.125'], ['', '', '', '1.25', '', '', ''])
    assert (float(second.split(',')[1]), third.split(',')[1:10]) == (estimate(3).dx, [''] * 9)
    assert float(third.split(',')[10]) == 0.5


def test_files_are_not_overwritten_and_errors_are_one_line(tmp_path: Path) -> None:
    write(tmp_path / 'a.csv', 'keep me')
    with pytest.raises(RecordingError, match='exists already'):
        CsvSampleSink(tmp_path / 'a.csv')
    assert (tmp_path / 'a.csv').read_text() == 'keep me\n'
    with pytest.raises(RecordingError, match='cannot be made'):
        CsvEstimateSink(tmp_path / 'none' / 'a.csv', ['exact'])
    with pytest.raises(RecordingError, match='is closed'):
        put_all(CsvSampleSink(tmp_path / 'b.csv'), []).put(block(0))


def test_spaces_exponents_and_columns_of_text_are_read(tmp_path: Path) -> None:
    lines = (f'{line},half_way ٣' for line in (*GOOD, ' 2E-3 , +1.5,-.25e1,5.,0.5,0,5'))
    samples = open_recording(write(tmp_path / 'a.csv', HEADER + ',note', *lines)).samples
    assert (len(samples), samples[-1]['y1']) == (len(GOOD) + 1, -2.5)


@pytest.mark.parametrize('name', ['run.csv', 'run.mcap', 'run'])
def test_a_pipe_is_rejected_and_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(RecordingError, match='is no file'):
        open_recording(tmp_path / name)
    folder = tmp_path / 'bag'
    folder.mkdir()
    os.mkfifo(folder / 'a.mcap')
    with pytest.raises(RecordingError, match='is no bag'):
        open_recording(folder)


def test_rows_that_follow_at_once_still_count_upwards(tmp_path: Path) -> None:
    times = [0.0, 0.001, 0.002, 0.00201, 0.00202, 0.00203, 0.00204, *(0.003 + i / 1000 for i in range(60))]
    recording = open_recording(write(tmp_path / 'a.csv', *rows([f'{t:.6f}' for t in times])))
    seq = np.concatenate([b.seq for b in recording.blocks()])
    assert len(seq) == len(times)
    assert (np.diff(seq) >= 1).all()


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
    rows = []
    try:
        for lines_, t_ns, cells in table.rows():
            width = len(table.header)
            rows += [
                (line, t, [c.strip() for c in cells[i * width : (i + 1) * width]])
                for i, (line, t) in enumerate(zip(lines_, t_ns, strict=True))
            ]
    except RecordingError as error:
        return rows, str(error).removeprefix(str(path))
    return rows, ''


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
        patch.setattr(csv_reader, '_PIECE', piece)
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
