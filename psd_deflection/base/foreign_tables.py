# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a table of another program is: its encoding, separator, header and units, and the shell line that converts it.

Nothing is converted by itself: a reader that rejects a table says these words.
"""

import re
from collections.abc import Collection, Sequence
from pathlib import PurePath
from typing import BinaryIO, NamedTuple

from psd_deflection.base.text import did_you_mean, sanitize
from psd_deflection.records import MOST_PSDS

OUT = 'OUT.csv'
LONGEST_HEADER = 120
"""Characters of a header that a message quotes."""
PREAMBLE = 200
"""Lines among which a header is looked for."""
BELOW = 12
"""Lines below a header that must be rows of its width."""
_PIECE = 1 << 20

# What other programs call our columns, in the form of `_plain`.
SYNONYMS = {
    't': ('time', 'timestamp', 'times', 'seconds', 'sec', 'elapsed', 'elapsedtime', 'zeit', 'xvalue', 'datetime'),
    'temperature': ('temp', 'tempc', 'celsius'),
    **{f'sum{n}': (f's{n}', f'sigma{n}', f'i{n}', f'intensity{n}', f'total{n}') for n in range(1, MOST_PSDS + 1)},
}
UNITS = {
    'ns': 'nanoseconds: divide by 1e9',
    **dict.fromkeys(('us', 'µs', 'μs', 'micros'), 'microseconds: divide by 1e6'),
    **dict.fromkeys(('ms', 'millis'), 'milliseconds: divide by 1000'),
    'mv': 'millivolts: divide by 1000',
    'µv': 'microvolts: divide by 1e6',
}
_UNIT = re.compile(r'(?:[\[(]\s*(\S{1,8}?)\s*[\])]|[_ .](ns|us|µs|μs|ms|micros|millis|s|v|mv))\s*$', re.IGNORECASE)
QUOTED_COMMAS = r"""sed -E 's/"([+-]?[0-9]+),([0-9]+)"/\1.\2/g'"""
_NUMBER = re.compile(r'\s*"?[+-]? *[0-9]*[.,]?[0-9]+(?:[eE][+-]?[0-9]+)?"?\s*')
_DECIMAL_COMMA = re.compile(r'(?:^|[;\t"])[+-]?[0-9]+,[0-9]+(?=$|[;\t"])', re.MULTILINE)
SEPARATORS = {';': 'semicolons', '\t': 'tabs', '|': 'bars', ' ': 'blanks'}
_IN_TR = {'\t': r'\t'}

EXCEL_DAYS = (30_000.0, 70_000.0)
"""Days since 1899-12-30 of the years 1982 to 2091."""
FROM_1904 = 2_082_844_800
"""Seconds from LabVIEW's and the old Macintosh's epoch, 1904-01-01, to 1970."""
WRAP_S = 4294.967296
"""2^32 µs: where the ``micros()`` of a microcontroller begins again."""
TIME_UNITS = (
    ('milliseconds', 1e3),
    ('microseconds', 1e6),
    ('nanoseconds', 1e9),
    ('minutes', 1 / 60),
    ('hours', 1 / 3600),
    ('days', 1 / 86400),
)
SLOWEST, FASTEST = 5.0, 20_000.0
"""Samples a second of a recording; other rates are those of a time in another unit."""


class Meant(NamedTuple):
    """A column as it is called and what it is called here; ``unit``: what to do with its numbers, in words."""

    name: str
    ours: str
    unit: str


def quoted(path: PurePath) -> str:
    """The name of a file in a shell line."""
    text = sanitize(str(path), 500)
    return text if re.fullmatch(r'[\w./+@%-]+', text) else "'" + text.replace("'", "'\\''") + "'"


def encoding_of(head: bytes) -> str:
    """The encoding that text that is not UTF-8 probably has, as ``iconv`` calls it; '' if it is no text."""
    if head[:2] in (b'\xff\xfe', b'\xfe\xff'):
        return 'UTF-16'
    if (zeros := head.count(0)) > len(head) // 4:
        return 'UTF-16LE' if head[1::2].count(0) > zeros // 2 else 'UTF-16BE'
    if zeros or any(c < 9 or 13 < c < 32 for c in head):
        return ''
    try:
        text = head[: len(head) - 1].decode('cp932', 'strict' if len(head) < 3 else 'replace')
    except UnicodeDecodeError:
        text = '�'
    # Katakana and kanji in pairs of bytes; the accents of Europe stand alone between letters.
    pairs = sum(1 for c in text if '぀' <= c <= '鿿')
    singles = sum(1 for c in text if c == '�' or '｡' <= c <= 'ﾟ')
    if pairs > 3 and pairs > 4 * singles:
        return 'CP932'
    return 'CP1252'


def text_fault(path: PurePath, stream: BinaryIO) -> tuple[int, str]:
    """The line of ``stream`` that is not UTF-8, and what to say of it."""
    line = 1
    while text := stream.readline(_PIECE):
        try:
            text.decode('utf-8')
            bad = b'\0' in text
        except UnicodeDecodeError:
            bad = True
        if bad:
            break
        line += text.endswith(b'\n')
    stream.seek(0)
    head = stream.read(1 << 16)
    encoding = encoding_of(head if b'\0' in text[:100] or line == 1 else text)
    if not encoding:
        return line, 'is not text in UTF-8; delete this line if the logger left it unfinished'
    rest = what_of_text(head.decode({'CP1252': 'latin-1'}.get(encoding, encoding), 'replace'))
    pipe = shell_line(path, [f'iconv -f {encoding} -t UTF-8', *rest.stages])
    return line, f'is not text in UTF-8 but {encoding} by its look{rest.words}: `{pipe}` makes one that is'


class Layout(NamedTuple):
    """What stands in the way of a text that should be a CSV: ``words``, each after a comma, and the shell's stages."""

    words: str
    stages: list[str]


def what_of_text(text: str) -> Layout:
    """Lines before the header, rows of units, separator and decimals of ``text``, the head of a file."""
    lines = text.lstrip('\ufeff').splitlines()[: PREAMBLE + BELOW]
    begin, units, separator = _begin(lines)
    words, stages = '', []
    if begin > 1:
        words += f', its table begins in line {begin}'
        stages.append(f'tail -n +{begin}')
    if units:
        words += ', a row of units below the header' if units == 1 else f', {units} rows of words below the header'
        stages.append('sed 2d' if units == 1 else f'sed 2,{1 + units}d')
    # Between commas a cell with a decimal comma is quoted.
    commas = any('"' in m[0] or separator != ',' for m in _DECIMAL_COMMA.finditer('\n'.join(lines[begin:])))
    if separator == ' ':
        stages += ["tr ',' '.'"] * commas + ["awk -v OFS=, '{$1 = $1} 1'"]
    elif separator != ',':
        delimiter = _IN_TR.get(separator, separator)
        stages.append(f"tr '{delimiter},' ',.'" if commas else f"tr '{delimiter}' ','")
    elif commas:
        stages.append(QUOTED_COMMAS)
    if separator != ',':
        words += f', cells between {SEPARATORS[separator]}'
    return Layout(words + ', decimals with a comma' * commas, stages)


def _width(line: str, separator: str) -> int:
    return len(line.split()) - 1 if separator == ' ' else line.count(separator)


def _begin(lines: Sequence[str]) -> tuple[int, int, str]:
    """The line in which the table's header probably stands, the rows of words below it, and its separator."""
    for i, line in enumerate(lines[:PREAMBLE]):
        for separator in (';', '\t', ',', '|', ' '):
            width = _width(line, separator)
            if width < (4 if separator == ' ' else 1) or _numbers(line, separator):
                continue
            below = [row for row in lines[i + 1 : i + 1 + BELOW] if row.strip()]
            if any(_width(row, separator) != width for row in below):
                continue
            numbers = [_numbers(row, separator) for row in below]
            units = numbers.index(True) if True in numbers else BELOW
            if units <= 2 and all(numbers[units:]):
                return i + 1, units, separator
    head = lines[0] if lines else ''
    counts = {separator: head.count(separator) for separator in (',', ';', '\t', '|')}
    return 1, 0, max(counts, key=lambda separator: counts[separator])


def _numbers(line: str, separator: str) -> bool:
    cells = line.split() if separator == ' ' else line.split(separator)
    return 2 * sum(1 for cell in cells if _NUMBER.fullmatch(cell)) >= len(cells)


def shell_line(path: PurePath, stages: Sequence[str]) -> str:
    """``stages`` as one line of the shell that reads ``path`` and writes ``OUT``."""
    first, *rest = stages
    head = f'{first} < {quoted(path)}'
    return ' | '.join([head, *rest]) + f' > {OUT}'


def _plain(name: str) -> str:
    """``name`` without unit, path, case and marks."""
    bare = _UNIT.sub('', name.strip()).strip()
    return re.sub(r'[\W_]', '', bare.rstrip('/').rpartition('/')[2].lower())


def meant(names: Sequence[str], lacking: Collection[str]) -> list[Meant]:
    """Which of ``names`` probably are the columns ``lacking``, each once, in order."""
    by_plain = {_plain(ours): ours for ours in lacking}
    for ours, synonyms in SYNONYMS.items():
        if ours in lacking:
            by_plain |= dict.fromkeys(synonyms, ours)
    out: list[Meant] = []
    taken: set[str] = set()
    for name in names:
        plain = _plain(name)
        hint = did_you_mean(plain, by_plain) if len(plain) > 3 else ''
        ours = by_plain.get(plain) or (by_plain[hint[len('; did you mean ') : -1]] if hint else '')
        if ours and ours not in taken and name != ours:
            taken.add(ours)
            unit = _UNIT.search(name)
            out.append(Meant(name, ours, UNITS.get((unit[1] or unit[2]).lower(), '') if unit else ''))
    return out


def what_of_header(
    path: PurePath, head: bytes, names: Sequence[str], lacking: Sequence[str], form: str, known: Collection[str]
) -> str:
    """What to say of a header that lacks columns. ``head``: of the file; ``form``: what it should be."""
    program, layout = program_of(head), what_of_text(head.decode('utf-8-sig', 'replace'))
    if program or layout.stages:
        return f'{_converted(path, program, layout)}; {form}'
    words = f'the header lacks {", ".join(lacking)}'
    if names:
        words += f'; it has {sanitize(",".join(names), LONGEST_HEADER)}'
    guesses = meant([name for name in names if name not in known], lacking)
    if guesses:
        reported = ', '.join(f'{m.ours} for {sanitize(m.name, 30)}{f" ({m.unit})" if m.unit else ""}' for m in guesses)
        words += f'; did you mean {reported}?'
    if len(guesses) == len(lacking):
        ours = {m.name: m.ours for m in guesses}
        header = ','.join(ours.get(name, name) for name in names)
        scaled = [(names.index(m.name), m.unit.rpartition(' ')[2]) for m in guesses if m.unit]
        if re.fullmatch(r'[\w., -]+', header):
            cells = ''.join(f' ${i + 1} = sprintf("%.9f", ${i + 1} / {factor});' for i, factor in scaled)
            awk = f'awk -F, -v OFS=, \'NR == 1 {{$0 = "{header}"}} NR > 1 && NF {{{cells.strip()}}} 1\''
            line = shell_line(path, [awk if scaled else f"sed '1s/.*/{header}/'"])
            words += f' `{line}` renames them{" and changes their units" if scaled else ""}'
    return f'{words}; {form}'


MAGIC = (
    (b'LabVIEW Measurement', 'a LabVIEW measurement file (.lvm)'),
    (b'TDSm', 'a LabVIEW .tdms file; write a CSV of it, by npTDMS: TdmsFile.read(FILE).as_dataframe().to_csv(OUT)'),
    (b'PK\3\4', 'a workbook or a .zip; save the sheet as "CSV UTF-8"'),
    (b'\xd0\xcf\x11\xe0', 'an old Excel workbook; save the sheet as "CSV UTF-8"'),
    (b'MATLAB ', 'a .mat file; write a CSV of it: writematrix([t x1 y1 sum1 x2 y2 sum2], "OUT.csv") below a header'),
    (b'\x89HDF', 'an HDF5 file (also .mat v7.3); write a CSV of it'),
    (b'PAR1', 'a Parquet file; write a CSV of it: pandas.read_parquet(FILE).to_csv(OUT, index=False)'),
    (b'SQLite format 3', 'an SQLite file, as rosbag2 wrote before MCAP: `mcap convert IN.db3 OUT.mcap`'),
    (b'#ROSBAG V2.0', 'a bag of ROS 1: `mcap convert IN.bag OUT.mcap`'),
)
"""First bytes of files of other programs, what they are, and the way out."""


def program_of(head: bytes) -> str:
    """What ``head`` begins, with its article and a way out; '' if it is nothing that is known."""
    return next((words for magic, words in MAGIC if head.startswith(magic)), '')


def what_of_file(path: PurePath, head: bytes) -> str:
    """What a file is that no format reads: ``; it is ...``, or ''."""
    program = program_of(head)
    if not program.startswith('a LabVIEW measurement'):
        if program:
            return f'; it is {program}'
        return '; name a table of samples .csv' if encoding_of(head) and b',' in head else ''
    return f'; it {_converted(path, program, what_of_text(head.decode("utf-8-sig", "replace")))}'


def _converted(path: PurePath, program: str, layout: Layout) -> str:
    line = f': `{shell_line(path, layout.stages)}` makes a CSV of it' if layout.stages else ''
    return f'is {program or "no CSV"}{layout.words}{line}'


def why_no_number(name: str, cell: str) -> str:
    """What a cell that is no number probably is: ``: ...``, or ''."""
    if re.fullmatch(r'[+-]?[0-9]+,[0-9]+', cell):
        return f': a decimal comma; `{QUOTED_COMMAS} < IN.csv > {OUT}` writes points'
    if name == 't' and re.match(r'[0-9]{1,4}[-./][0-9]{1,2}[-./][0-9]{1,4}|[0-9]{1,2}:[0-9]{2}', cell):
        return ': a date or clock time; t is seconds (docs/recording.md has the line that converts dates)'
    return ''


def awk_line(path: PurePath, column: int, change: str, rows: str = 'NR > 1') -> str:
    """The shell line that changes ``column`` in ``rows``; ``change``: awk's value, with {} for the cell."""
    cell = f'${column + 1}'
    program = f'{rows} && NF {{{cell} = sprintf("%.9f", {change.format(cell)})}} 1'
    return shell_line(path, [f"awk -F, -v OFS=, '{program}'"])


def why_beyond(path: PurePath, column: int, seconds: float) -> str:
    """What a time that is no second since 1970 or the start probably is: ``: ...``, or ''."""
    if FROM_1904 + 9e8 < seconds < FROM_1904 + 2**31:
        line = awk_line(path, column, f'{{}} - {FROM_1904}')
        return f": LabVIEW's seconds since 1904 by their size; `{line}` counts from 1970"
    if 2**31 <= seconds < 2**32:
        line = awk_line(path, column, '{} / 1000000')
        return f': µs of a 32-bit counter by their size; `{line}` makes seconds'
    for name, scale in TIME_UNITS[:3]:
        if 9e8 < seconds / scale < 2**31:
            return f': {name} since 1970 by their size; `{awk_line(path, column, f"{{}} / {scale:.0f}")}` makes seconds'
    return ''


def why_falling(path: PurePath, column: int, line: int, before_s: float, seconds: float) -> str:
    """What a time that is not after the one before, in ``line``, probably is: ``: ...``, or ''."""
    # The last: µs that nobody has divided yet.
    for wrap, words in ((WRAP_S, 'µs'), (1000 * WRAP_S, 'ms'), (1e6 * WRAP_S, 'µs')):
        step = (seconds - before_s) % wrap
        if 0.4 * wrap < before_s - seconds <= wrap and step < 0.01 * wrap:
            offered = awk_line(path, column, f'{{}} + {wrap:.6f}', f'NR >= {line}')
            return f': a 32-bit counter of {words} began again; `{offered}` adds its 2^32 from this row on'
    return ''


def why_rate(path: PurePath, column: int, rate: float, first_s: float) -> str:
    """What a time with ``rate`` samples a second is not, with the units that would fit; '' if it may be seconds.

    ``column``: its place in the table; ``first_s``: the first time.
    """
    if SLOWEST <= rate <= FASTEST:
        return ''
    fits = {name: scale for name, scale in TIME_UNITS if SLOWEST <= rate * scale <= FASTEST}
    seconds = f'as seconds it has {rate:.4g} samples/s'
    if not fits:
        return f'column t: {seconds}: must be {SLOWEST:g} to {FASTEST:g}'
    begin = ''
    if 'days' in fits and EXCEL_DAYS[0] < first_s < EXCEL_DAYS[1]:
        fits, begin = {"Excel's days": fits['days']}, f' - {int(first_s)}'
    message = ' or '.join(
        f'{unit}: {rate * scale:.1f}/s if {"divided" if scale > 1 else "multiplied"} by {max(scale, 1 / scale):.0f}: '
        f'`{awk_line(path, column, f"({{}}{begin})" + (f" / {scale:.0f}" if scale > 1 else f" * {1 / scale:.0f}"))}`'
        for unit, scale in fits.items()
    )
    return f't looks like {message}; {seconds}'
