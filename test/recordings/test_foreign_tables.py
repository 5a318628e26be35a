# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of other loggers: each is rejected with what it is, and the shell line that is offered makes a recording of
it.

Made anew in the forms that public reports describe; no row is anybody's.
"""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import PsdDeflectionError, RecordingError
from psd_deflection.base.foreign_tables import why_rate
from psd_deflection.base.plugins import optional
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.loads import from_csv
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import ReadingsTable, read_references

pytestmark = pytest.mark.foreign
CAMERA = optional('psd_deflection.camera.footage')
NAMES = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')
HEADER = ','.join(('t', *NAMES))
N = 60


def volts(i: int) -> list[float]:
    """A row of numbers of which none is like another."""
    return [round(0.01 * i + 0.001 * k, 4) + (5.0 if k % 3 == 2 else 0.0) for k in range(6)]


def table(
    header: str = HEADER,
    *,
    time: Callable[[int], str] = lambda i: f'{0.01 * i:.3f}',
    separator: str = ',',
    comma: bool = False,
    before: str = '',
    end: str = '\n',
) -> str:
    """Rows at 100 Hz."""
    rows = [separator.join([time(i), *(f'{v:.4f}' for v in volts(i))]) for i in range(N)]
    if comma:
        rows = [row.replace('.', ',') for row in rows]
    return before.replace('\n', end) + end.join([header.replace(',', separator), *rows, ''])


WORDS = ('ベンダ', 'モデル', '測定間隔', 'トリガ点', '開始時刻')
PREAMBLE = ''.join(f'{word}\t"{i}"\n' for i, word in enumerate(WORDS))
EUROPE = 'Gerät;Müller & Söhne Prüfstand 3\nPrüfer;Jörg\n\n'
LVM = 'LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\t\n'
UNITS = '\n' + '\t'.join(['s', *['V'] * 6])
US = 2**32


def counter(first: int, *, signed: bool = False, raw: bool = False) -> bytes:
    """Seconds of a 32-bit counter of µs from ``first`` on; ``raw``: the µs, under a name of their own."""

    def time(i: int) -> str:
        us = (first + 10_000 * i) % US
        us = us - US if signed and us >= US // 2 else us
        return str(us) if raw else f'{us / 1e6:.6f}'

    return table(f't_us{HEADER[1:]}' if raw else HEADER, time=time).encode()


CONVERTIBLE: dict[str, tuple[bytes, tuple[str, ...]]] = {
    # Cases that people reported.
    'graphtec': (
        table(before=PREAMBLE, separator='\t', header=HEADER + UNITS, end='\r\n').encode('cp932'),
        ('CP932', 'begins in line 6', 'row of units', 'tabs'),
    ),
    'labview': (table(before=LVM, separator='\t').encode(), ('LabVIEW measurement file', 'line 5', 'tabs')),
    'semicolons': (table(separator=';', comma=True).encode(), ('semicolons', 'decimals with a comma')),
    'excel_days': (
        table(separator=';', comma=True, time=lambda i: f'{46350.5 + 0.01 * i / 86400:.10f}').encode('utf-8-sig'),
        ('semicolons', "Excel's days: 100.0/s"),
    ),
    'unicode_text': (
        table(separator='\t', comma=True, end='\r\n').encode('utf-16'),
        ('UTF-16', 'tabs', 'decimals with a comma'),
    ),
    'milliseconds': (table(time=lambda i: str(10 * i)).encode(), ('milliseconds: 100.0/s if divided by 1000:',)),
    'microseconds': (table(time=lambda i: str(10_000 * i)).encode(), ('microseconds: 100.0/s if divided by 1000000',)),
    'days': (table(time=lambda i: f'{0.01 * i / 86400:.12f}').encode(), ('days: 100.0/s if multiplied by 86400',)),
    't_us': (
        table('t_us,x1,y1,sum1,x2,y2,sum2', time=lambda i: str(10_000 * i)).encode(),
        ('did you mean t for t_us (microseconds: divide by 1e6)?',),
    ),
    'plotjuggler': (
        table('__time,/psd/x1,/psd/y1,/psd/sum1,/psd/x2,/psd/y2,/psd/sum2').encode(),
        ('t for __time', 'x1 for /psd/x1', 'sum2 for /psd/sum2'),
    ),
    'quoted_commas': (
        '\n'.join(
            [
                HEADER,
                *(','.join(f'"{c}"' for c in r.split(';')) for r in table(separator=';', comma=True).splitlines()[1:]),
            ]
        ).encode(),
        ("column t holds '0,000'", 'a decimal comma'),
    ),
    # Of loggers that are not among them.
    'capitals': (table('T,X1,Y1,SUM1,X2,Y2,SUM2').encode(), ('did you mean t for T, x1 for X1',)),
    'units_in_names': (
        table('t [s],x1 [V],y1 [V],sum1 [V],x2 [V],y2 [V],sum2 [V]').encode(),
        ('t for t [s]', 'sum1 for sum1 [V]'),
    ),
    'saleae': (
        table('Time (s),X1 (V),Y1 (V),Sum1 (V),X2 (V),Y2 (V),Sum2 (V)').encode(),
        ('t for Time (s)', 'y2 for Y2 (V)'),
    ),
    'picoscope': (
        table('Time,x1,y1,sum1,x2,y2,sum2\n(ms),(V),(V),(V),(V),(V),(V)\n', time=lambda i: f'{10 * i:.8f}').encode(),
        ('t for Time', 'row of units', 'milliseconds'),
    ),
    'tera_term': (table(before='[log opened]\nboot ok\n').encode(), ('begins in line 3',)),
    'matlab_save_ascii': (
        table(separator='   ', header=HEADER, time=lambda i: f'{0.01 * i:.7e}').replace('\n', '\n  ').encode(),
        ('cells between blanks',),
    ),
    'latin_1_preamble': (
        table(before=EUROPE, separator=';', comma=True).encode('latin-1'),
        ('CP1252', 'begins in line 4', 'semicolons'),
    ),
    'utf_16_without_mark': (table(separator='\t').encode('utf-16-le'), ('UTF-16LE', 'tabs')),
    'bars': (table(separator='|').encode(), ('cells between bars',)),
    'wraps': (counter(US - 300_000), (':32: ', 'a 32-bit counter of µs began again')),
    'signed': (counter(US // 2 - 300_000, signed=True), (':32: ', 'a 32-bit counter of µs began again')),
    't_us_wraps': (counter(US - 300_000, raw=True), ('t for t_us', 'changes their units', 'µs began again')),
    't_us_signed': (
        counter(US // 2 - 300_000, signed=True, raw=True),
        ('t for t_us', 'µs began again', 'microseconds'),
    ),
    'epoch_ms': (table(time=lambda i: str(1_795_788_190_000 + 10 * i)).encode(), ('milliseconds since 1970',)),
    'labview_1904': (table(time=lambda i: f'{3_878_632_990 + 0.01 * i:.3f}').encode(), ('since 1904', 'from 1970')),
}


def rejection(path: Path) -> str:
    """What is said of the file, one line that names it; '' if it is read whole."""
    why = ''
    try:
        list(open_recording(path).blocks())
    except RecordingError as error:
        why = str(error)
    assert why.startswith(str(path) if why else '')
    assert '\n' not in why
    return why


def test_a_rate_is_from_5_to_20_000_samples_a_second() -> None:
    assert [rate for rate in (4.9, 5.0, 20_000.0, 20_001.0) if not why_rate(Path('a'), 1, rate, 0.0)] == [5.0, 20_000.0]


@pytest.mark.parametrize('name', CONVERTIBLE)
def test_a_logger_s_table_follows_its_advice(tmp_path: Path, name: str) -> None:
    content, words = CONVERTIBLE[name]
    path = tmp_path / f'{name}.csv'
    path.write_bytes(content)
    logged = []
    for n in range(6):
        why = rejection(path)
        if not why:
            break
        logged.append(why)
        offered = re.findall(r'`([^`]* > OUT\.csv)`', why)
        assert offered, why
        line = offered[-1].replace('IN.csv', path.name)
        subprocess.run(['bash', '-c', line], cwd=tmp_path, check=True, timeout=20)
        path = (tmp_path / 'OUT.csv').rename(tmp_path / f'{name}_{n}.csv')
    assert logged
    assert all(word in ' '.join(logged) for word in words), logged
    samples = open_recording(path).samples
    assert np.allclose(np.diff(samples['t']), 0.01, atol=1e-5)
    assert np.allclose([[float(s[c]) for c in NAMES] for s in samples], [volts(i) for i in range(N)], atol=1e-6)


@pytest.mark.parametrize('command', ['replay', 'info', 'discover', 'check', 'identify', 'calibrate'])
def test_every_command_says_the_unit_of_time(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'a.csv'
    for name in ('days', 'milliseconds', 'microseconds', 'epoch_ms', 't_us'):
        content, words = CONVERTIBLE[name]
        path.write_bytes(content)
        out = ['--out', str(tmp_path / 'out')] if command in ('discover', 'calibrate') else []
        assert main([command, str(path), *out]) == 4
        assert words[-1] in capsys.readouterr().err


def split(rows: list[str]) -> bytes:
    """A sample in two rows."""
    cells = rows[9].split(',')
    halves = [','.join([*cells[:4], '', '', '']), ','.join([cells[0], '', '', '', *cells[4:]])]
    return '\n'.join([*rows[:9], *halves, *rows[10:]]).encode()


ROWS = table().splitlines()


@pytest.mark.parametrize(
    ('content', 'words'),
    [
        (split(ROWS), (':11: ', 'cells are empty', 'one sample into two rows')),
        ('\n'.join([*ROWS[:5], ROWS[5].replace('.', ','), *ROWS[6:]]).encode(), (':6: has 14 cells', 'with a comma')),
        (
            '\n'.join([*ROWS[:5], *(r.replace('0.', '2026-11-24T14:03:10.', 1) for r in ROWS[5:])]).encode(),
            (':6: ', 'a date or clock time'),
        ),
        (table(time=lambda i: f'24.11.2026 14:03:1{0.01 * i:.2f}').encode(), (':2: ', 'a date or clock time')),
        (table().encode()[:-200] + b'\xff\x00\x01\n', ('is not text in UTF-8; delete this line',)),
        (
            b't [s], x_cal [au], y_cal [au], x_mm, y_mm\n0.1,1,2,3,4\n0.2,1,2,3,4\n',
            ('it has t [s],x_cal [au]', 't for t'),
        ),
        (b'0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n', (':1: the header lacks t', 'it has 0.0,1,2')),
        (b'a,b\n1,2\n3,4\n5,6\n', ('the header lacks t, x1', 'it has a,b')),
    ],
    ids=['split', 'midfile', 'iso', 'german_date', 'stray', 'thorlabs', 'no_header', 'whole_numbers'],
)
def test_what_no_line_converts_is_named_by_row(tmp_path: Path, content: bytes, words: tuple[str, ...]) -> None:
    path = tmp_path / 'a.csv'
    path.write_bytes(content)
    why = rejection(path)
    assert all(word in why for word in words), why


@pytest.mark.parametrize(
    ('name', 'head', 'words'),
    [
        ('a.tdms', b'TDSm\x0e\0\0\0', 'LabVIEW .tdms file'),
        ('a.lvm', table(before=LVM, separator='\t').encode(), 'LabVIEW measurement file (.lvm), its table begins'),
        ('a.xlsx', b'PK\x03\x04\x14\0', 'save the sheet as "CSV UTF-8"'),
        ('a.mat', b'MATLAB 5.0 MAT-file', 'a .mat file'),
        ('a.bag', b'#ROSBAG V2.0\n', '`mcap convert IN.bag OUT.mcap`'),
        ('a.db3', b'SQLite format 3\0', '`mcap convert IN.db3 OUT.mcap`'),
        ('a.txt', table().encode(), 'name a table of samples .csv'),
    ],
)
def test_a_file_of_another_program_is_named(tmp_path: Path, name: str, head: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(head)
    assert words in rejection(tmp_path / name)


@pytest.mark.parametrize('reader', ['recording', 'references', 'readings', 'loads', *(['frames'] if CAMERA else [])])
def test_every_reader_of_a_csv_says_the_same(tmp_path: Path, reader: str) -> None:
    readers: dict[str, tuple[str, Callable[[Path], object]]] = {
        'recording': (HEADER, open_recording),
        'references': ('t,dx,dy,theta', read_references),
        'readings': ('load_fx,load_fy,load_tz,dx,dy,theta', lambda path: ReadingsTable(path).loads()),
        'loads': ('t,load_fx,load_fy,load_tz', from_csv),
        'frames': ('file,t,exposure', lambda path: CAMERA.Footage(str(path.parent), 0.0)),
    }
    form, read = readers[reader]
    names = form.split(',')
    path = tmp_path / 'frames.csv'

    def logged(text: bytes) -> str:
        path.write_bytes(text)
        with pytest.raises(PsdDeflectionError) as caught:
            read(path)
        assert str(caught.value).startswith(f'{path}:1: ')
        return str(caught.value)

    row = ','.join(['0.5'] * len(names))
    capitals = logged(f'{form.upper()}\n{row}\n'.encode())
    assert f'did you mean {names[0]} for {names[0].upper()}' in capitals
    assert 'cells between semicolons' in logged(f'{form}\n{row}\n{row}\n'.replace(',', ';').encode())
    assert 'UTF-16' in logged(f'{form}\n{row}\n'.encode('utf-16'))
    assert f'column {names[1]} is there twice' in logged(f'{form},{names[1]}\n{row},1\n'.encode())
