# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes docs/gallery.md and its pictures: ``python -m tools.gallery``."""

import contextlib
import io
import re
import shlex
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

from blind.campaign import conclude, options, over
from psd_deflection.cli.main import main as psd_deflection
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.replay.engine import open_for_replay, replayed
from psd_deflection.records import CHANNELS, SampleBlock
from psd_deflection.run.diagnostics import OK, CounterSnapshot, estimates_entry, laser_entry
from psd_deflection.run.monitor.spectrum import Spectrum, line_entry
from tools.program import ROOT

PAGE = ROOT / 'docs' / 'gallery.md'
FIGURES = ROOT / 'docs' / 'figures' / 'gallery'
NUMBER = re.compile(r'(?<![\w.])[+\-−]?\d+(?:\.(\d+))?(?:e([+-]?\d+))?')
ALIKE = re.compile(r'[\w.]*\d[\w.]*|[+\-−]?Δ?[XYθ]\b|[+\-−](?=#)')
"""What lines of the same kind differ in: names of channels and axes, numbers."""
LONGEST = 80  # Characters of a line; the rest is cut.
WIDTH = 760  # Pixels of a picture, as wide as the column of the site.
COLOURS, RATE_HZ = 24, 1000
Columns = dict[str, npt.NDArray[np.float64]]
"""A CSV recording, column by column."""


def _scaled(c: Columns, **factors: float) -> Columns:
    return {n: f * c[n] for n, f in factors.items()}


def _held(c: Columns, **volts: float) -> Columns:
    return {n: np.full_like(c[n], v) for n, v in volts.items()}


def _line(c: Columns, *, hertz: float, **volts: float) -> Columns:
    """A sine, sampled as it comes: above half the rate it appears at another frequency."""
    return {n: c[n] + v * np.sin(2.0 * np.pi * hertz * c['t']) for n, v in volts.items()}


def _coarse(c: Columns, *, step: float) -> Columns:
    return {n: step * np.round(c[n] / step) for n in CHANNELS}


def _dark(c: Columns) -> Columns:
    """Laser 2 goes off after a second."""
    rng = np.random.default_rng(1)
    return {n: np.where(c['t'] >= 1.0, rng.normal(0.0, 0.002, len(c['t'])), c[n]) for n in CHANNELS[3:]}


def _frozen(c: Columns) -> Columns:
    """PSD 1 keeps the values that it had after a second."""
    at = int(np.searchsorted(c['t'], 1.0))
    return {n: np.where(c['t'] >= 1.0, c[n][at], c[n]) for n in CHANNELS[:3]}


def _shifted(c: Columns, *, seconds: float, names: Sequence[str]) -> Columns:
    """Late by so long; what was first holds before."""
    late = round(seconds * RATE_HZ)
    return {n: np.concatenate((np.full(late, c[n][0]), c[n][:-late])) for n in names}


def _moved(c: Columns, *, after: float, **offsets: float) -> Columns:
    """A jump after so many seconds."""
    return {n: c[n] + offset * (c['t'] >= after) for n, offset in offsets.items()}


CHANGES: Mapping[str, Callable[..., Columns]] = {
    f.__name__[1:]: f for f in (_scaled, _held, _line, _coarse, _dark, _frozen, _shifted, _moved)
}


class Study(NamedTuple):
    """One part of the page; what the fields mean stands in tools/gallery_cases.toml."""

    title: str
    about: str
    command: str
    message: str = '.+'


class Case(NamedTuple):
    """``do``: what a person does; ``change``: names of :data:`CHANGES` with their arguments."""

    name: str
    study: str
    title: str
    simulate: str
    do: str = ''
    change: Mapping[str, Mapping[str, Any]] = {}


_TABLES = tomllib.loads(Path(__file__).with_name('gallery_cases.toml').read_text(encoding='utf-8'))
STUDIES = {name: Study(**study) for name, study in _TABLES['studies'].items()}
CASES = tuple(Case(**case) for case in _TABLES['cases'])


def run(words: list[str]) -> str:
    """What one of our commands prints. Raises SystemExit if it fails."""
    stream, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(errors):
        status = psd_deflection(words)
    if status:
        raise SystemExit(f'{shlex.join(words)}\n{stream.getvalue()}{errors.getvalue()}')
    return stream.getvalue()


def record(case: Case, folder: Path) -> Path:
    path = folder / f'{case.name}.csv'
    words = re.sub(r'\b[A-Z_]{4,}\b', lambda word: str(_TABLES['loads'][word[0]]), case.simulate)
    run(['simulate', '--out', str(path), *shlex.split(words)])
    if case.change:
        names = path.read_text().partition('\n')[0].split(',')
        # A reference is in the rows of its frames only.
        table = np.genfromtxt(path, delimiter=',', skip_header=1)
        columns = {name: table[:, i] for i, name in enumerate(names)}
        for name, arguments in case.change.items():
            columns |= CHANGES[name](columns, **arguments)
        text = io.StringIO()
        np.savetxt(text, np.column_stack(list(columns.values())), '%.10g', ',', header=','.join(names), comments='')
        path.write_text(text.getvalue().replace('nan', ''))
    return path


def reported_live(path: Path) -> str:
    """What the live page and ``/diagnostics`` say at the end of the recording, from a report that covers it all."""
    recording, rig = open_for_replay(path)
    pipeline, spectrum = Pipeline(rig), Spectrum(rig)
    for records in replayed(recording, pipeline):
        for block in (record for record in records if isinstance(record, SampleBlock)):
            spectrum.add(block)
    c, contradictions = pipeline.counters, pipeline.estimator.contradictions
    new = CounterSnapshot(0, c.samples, 0, 0, 0, c.blocks, c.estimates, c.degraded, contradictions, 0, 0)
    lasers = (laser_entry(pipeline, psd) for psd in range(1, len(rig.psds) + 1))
    entries = [estimates_entry(pipeline, new, 'unknown'), *lasers]
    line = line_entry(rig, spectrum.frequencies, spectrum.density())
    entries += [line] if line.level > OK else []
    wrong = [entry for entry in entries if entry.level > OK]
    lines = [f'{e.name.partition(": ")[2]}: {e.message}' for e in wrong or entries]
    return '\n'.join(without_repeats(lines))


def answered(case: Case, folder: Path) -> str:
    path = record(case, folder)
    if case.study == 'live':
        return reported_live(path)
    study = STUDIES[case.study]
    names = {'REC': str(path), 'OUT': str(folder / 'out')}
    answer = run([names.get(word, word) for word in study.command.split()])
    lines = [line.strip() for text in re.findall(study.message, answer, re.M) for line in text.splitlines()]
    return '\n'.join(without_repeats(lines)).replace(f'{folder}/', '')


def without_repeats(lines: list[str]) -> list[str]:
    """Return the lines, cut to LONGEST; of lines that differ only in names and numbers, the later ones are named."""
    first: dict[str, tuple[int, str]] = {}
    alike: dict[int, list[str]] = {}
    texts: list[str] = []
    for line in lines:
        label = line.partition(': ')[0]
        at, name = first.setdefault(ALIKE.sub('#', line), (len(texts), label))
        if label == name:
            texts.append(line)
        else:
            alike.setdefault(at, []).append(label.split()[-1])
    texts = [text if len(text) <= LONGEST else f'{text[:LONGEST].rpartition(" ")[0]} …' for text in texts]
    return [f'{text} [{", ".join(alike[i])}: alike]' if i in alike else text for i, text in enumerate(texts)]


def picture(case: Case, folder: Path) -> bytes:
    drawn = folder / f'{case.name}.png'
    run(['plot', str(folder / f'{case.name}.csv'), '--out', str(drawn)])
    image = Image.open(drawn).convert('RGB')
    image.thumbnail((WIDTH, WIDTH))
    stream = io.BytesIO()
    image.quantize(COLOURS).save(stream, 'png', optimize=True)
    return stream.getvalue()


def section(case: Case, message: str) -> str:
    quoted = '\n'.join(f'    {line}' for line in message.splitlines())
    parts = (f'### {case.title}', f'![Recording](figures/gallery/{case.name}.png)', quoted, case.do)
    return '\n\n'.join(filter(None, parts)) + '\n'


def page(message: dict[str, str]) -> str:
    head = 'A good rig and typical faults: the recording, the first lines of the output (… marks a cut), and the remedy'
    parts = [f'# Gallery\n\n{head}. `make docs STEP=gallery` makes this page; the tests compare it.\n']
    for name, study in STUDIES.items():
        parts.append(f'## {study.title}\n\n{study.about}\n')
        parts += [section(case, message[case.name]) for case in CASES if case.study == name and case.name in message]
    parts.append('Where next: [troubleshooting](troubleshooting.md).\n')
    return '\n'.join(parts)


def stored() -> dict[str, str]:
    if not PAGE.exists():
        return {}
    blocks = re.findall(r'figures/gallery/(\w+)\.png\)\n\n((?: {4}.*\n)+)', PAGE.read_text())
    return {name: '\n'.join(line[4:] for line in text.splitlines()) for name, text in blocks}


def same(now: str, before: str) -> bool:
    """Whether two answers have the same words, and numbers that agree within 5 % or two of their last digit. Other
    processors round otherwise. A number without a decimal point is a count, and the 2 of y2 a word."""
    if NUMBER.sub('#', now) != NUMBER.sub('#', before):
        return False
    for a, b in zip(NUMBER.finditer(now), NUMBER.finditer(before), strict=True):
        x, y = (float(match[0].replace('−', '-')) for match in (a, b))
        digit = max(10.0 ** (int(m[2] or 0) - len(m[1] or '')) if m[1] or m[2] else 0.0 for m in (a, b))
        if abs(x - y) > 0.05 * max(abs(x), abs(y)) + 2.0 * digit:
            return False
    return True


def shown(case: Case, renew: bool) -> str:
    with tempfile.TemporaryDirectory() as temporary:
        message = answered(case, Path(temporary))
        if renew:
            (FIGURES / f'{case.name}.png').write_bytes(picture(case, Path(temporary)))
    return message


def main() -> int:
    """Run the cases; write the page, or hold it against what they say now."""
    parser = options(__doc__, jobs=1)
    parser.add_argument('--only', metavar='WORD', help='only the cases with this word in their name')
    parser.add_argument('--check', action='store_true', help='write nothing: does the page have what they say?')
    args = parser.parse_args()
    cases = [case for case in CASES if args.only is None or args.only in case.name]
    FIGURES.mkdir(exist_ok=True)
    message, before = {}, stored()
    answers = over(partial(shown, renew=not args.check), cases, args.jobs, 'cases')
    for case, answer in zip(cases, answers, strict=True):
        message[case.name] = answer
    differ = [name for name, answer in message.items() if not same(answer, before.get(name, ''))]
    if not args.check:
        PAGE.write_text(page(stored() | message))
        for unused in set(FIGURES.glob('*.png')) - {FIGURES / f'{case.name}.png' for case in CASES}:
            unused.unlink()
    text = '\n\n'.join(f'{name}\n{message[name]}' for name in differ)
    return conclude(text or 'every case says what the page has', met=not (args.check and differ))


if __name__ == '__main__':
    sys.exit(main())
