# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The answer of check: what the rig file has wrong, how sure that is, and the lines that put it
right."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from psd_deflection.base.charts import SMALL, Chart, Panel, Series
from psd_deflection.base.pages import table
from psd_deflection.base.tables import Column, Table, columns, text_column
from psd_deflection.measure.uncertainty.block_estimator import ConverterSteps
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import DOTS, WIRINGS, PushResponse, WiringFit, line, on_channels
from psd_deflection.studies.loads.alignment import LatePsd
from psd_deflection.studies.study import PageSection, StudyResult

MAINS = (50.0, 60.0)
"""Hz."""

SUM_FACTOR = 1.15
"""Report a sum that differs from the nominal one by more than this factor."""

LONGEST = 1_000_000
"""Only the first samples of a long recording are used, this many."""

HUM_S = 60.0
"""Longest stretch in which hum is looked for, s."""

HUM_SHARE = 0.25
"""Hum below this share of the noise is not reported."""

_THIRD = np.sqrt(20.0)
"""Root of the variance of the third difference of white noise of variance 1."""

_TO_SD = 1.4826
"""Median absolute value of a normal law to its standard deviation."""

_AT_ONCE = 1000
"""Samples in which the steps are looked for at once: a fine converter tells in the first."""

_FAR = 4.0
_NEIGHBOURS_HZ = 8.0
_STANDS_OUT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Of the device's channels x1 y1 sum1 x2 y2 sum2. ``noise`` (6,): V rms a sample, without motion, drift and hum.

    ``stated``: of the rig file, with the converter's steps, V rms. ``hum`` (6,): amplitude of the mains, V, 0 if none
    stands out. ``hum_hz``: its frequency. ``sums`` (2,): means, V. ``stuck``: channels on which no bit moves. ``steps``
    (6,): of the converter, V, 0 where they are not coarser than the rig file's.
    """

    noise: FloatArray
    stated: float
    hum: FloatArray
    hum_hz: float
    sums: FloatArray
    stuck: tuple[str, ...]
    steps: FloatArray


def levels(rig: Rig, volts: FloatArray) -> Levels:
    """``volts`` (n, 6) of the device's channels, NaN if a sample is lost; some are there. Of a long run, its begin."""
    volts = volts[:LONGEST]
    step = rig.converter.volts_per_count
    stated = float(np.hypot(np.sqrt(np.mean(rig.noises[:, :2] ** 2)), step / np.sqrt(12.0)))
    rough = np.diff(volts, n=3, axis=0)
    rough = rough[np.isfinite(rough).all(axis=1)]
    if not len(rough):
        rough = np.zeros((1, volts.shape[1]))
    complete = volts[np.isfinite(volts).all(axis=1)]
    steps = _steps(rig, complete)
    # Steps of a load and glitches are cut off. The median alone would be as coarse as the converter.
    cut = _FAR * np.maximum(_TO_SD * np.median(np.abs(rough), axis=0), np.maximum(steps, step))
    noise = np.sqrt((np.clip(rough, -cut, cut) ** 2).mean(axis=0)) / _THIRD
    # Steps that are coarser than the noise can hide it: no channel that stands still is dead then.
    moves = rig.amplifier.noise > max(step, float(steps.max()))
    still = (complete == complete[0]).all(axis=0)
    stuck = tuple(name for name, same in zip(CHANNELS, still.tolist(), strict=True) if same and moves)
    rate = rig.converter.sample_rate_hz
    hum_hz, hum = mains_hum(longest_run(volts)[: round(HUM_S * rate)], rate, noise)
    return Levels(noise, stated, hum, hum_hz, complete[:, 2::3].mean(axis=0), stuck, steps)


def _steps(rig: Rig, volts: FloatArray) -> FloatArray:
    converter = ConverterSteps.of_rig(rig)
    for first in range(0, len(volts), _AT_ONCE):
        converter.add(volts[first : first + _AT_ONCE])
    return converter.steps


def longest_run(volts: FloatArray) -> FloatArray:
    """Return the longest stretch without a lost sample."""
    there = np.concatenate(([False], np.isfinite(volts).all(axis=1), [False]))
    edges: npt.NDArray[np.int64] = np.flatnonzero(np.diff(there.astype(np.int8)))
    starts, ends = edges[0::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    return volts[starts[best] : ends[best]]


def mains_hum(volts: FloatArray, rate: float, noise: FloatArray) -> tuple[float, FloatArray]:
    """(Hz, amplitude (6,) V) of the mains frequency that stands out more; its neighbours say what does not.

    A Hann window keeps the link's ringing, tens of hertz away, out of it.
    """
    n = len(volts)
    best = (MAINS[0], np.zeros(6))
    if n < rate or rate < 2.5 * MAINS[1]:
        return best
    window = np.hanning(n)
    values = (volts - volts.mean(axis=0)) * window[:, None]
    t = np.arange(n) / rate
    width = 4.0 * rate / n
    for frequency in MAINS:
        offsets = [o for o in np.arange(-_NEIGHBOURS_HZ, _NEIGHBOURS_HZ + 1.0) if abs(o) > width]
        waves = np.exp(-2j * np.pi * np.outer([frequency, *(frequency + o for o in offsets)], t))
        sizes = 2.0 * np.abs(waves @ values) / window.sum()
        there = sizes[0] > np.maximum(_STANDS_OUT * np.median(sizes[1:], axis=0), HUM_SHARE * noise)
        hum = np.where(there, sizes[0], 0.0)
        if hum.max() > best[1].max():
            best = (frequency, hum)
    return best


RIGHT, WRONG, CANNOT_TELL = 'right', 'wrong', 'cannot_tell'

SIGNIFICANT_DRIFT = 5e-6 / 60.0
"""m/s: a drift whose standard deviation is larger is not shown; the recording is too short."""

NAMES = {
    'channel_sign': 'sign turned',
    'axis_swap': 'x and y exchanged',
    'psd_swap': 'exchanged',
    'load_sign': 'sign turned',
    'load_unit': 'other unit',
    'load_delay': 'all noted late or early',
    'load_ramp': 'applied slowly',
    'load_time': 'noted late or early',
    'load_value': 'another load than noted',
    'missing_load': 'never noted',
    'sensitivity': 'other sensitivity',
    'link_length': 'other length',
    'sample_rate': 'other rate',
    'zero': 'elsewhere when unloaded',
    'jump': 'jumps',
    'stuck_channel': 'dead',
    'noise_level': 'noise',
    'converter_step': 'coarser steps',
    'load_coverage': 'not seen',
}
"""All names that a finding may have, as other programs know them, in words."""
BY_HAND_S = 0.1
"""s by which a load that is noted by hand may be late or early without being a mistake."""
WIRED = ('channel_sign', 'axis_swap', 'psd_swap')


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as the rig file or the recording says.

    ``name``: one of ``NAMES``. ``where``: channel, PSD or load, or when. ``value``: -1 for a turned
    sign, a factor, s late, or what hung: N, N, N m. ``fix``: the line for the rig file, or what to
    do. ``evidence``: how much more of the movement (summed over the pushes) the rig file leaves
    unexplained. ``equivalent``: other causes that look the same to first order. Raises ValueError
    for another name.
    """

    name: str
    where: str
    value: float | tuple[float, ...] | None
    fix: str
    evidence: float = 0.0
    equivalent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise ValueError(f'{self.name}: must be one of {", ".join(NAMES)}')

    @property
    def by_hand(self) -> bool:
        """Whether it is a time as any load noted by hand has, and no mistake."""
        late = isinstance(self.value, float) and abs(self.value) < BY_HAND_S
        return late and self.name in ('load_time', 'load_delay')


def finding_tree(finding: Finding) -> dict[str, Any]:
    """Return a finding as JSON has it."""
    return {
        'name': finding.name,
        'where': finding.where,
        'value': finding.value,
        'fix': finding.fix,
        'evidence': finding.evidence,
        'equivalent': list(finding.equivalent),
    }


@dataclass(frozen=True, eq=False, repr=False)
class Checkup(StudyResult):
    """``findings``: what is wrong. ``values``: parameters for the rig file. ``sizes``: movement of
    each push over the expected one, NaN if it was not seen. ``wirings``: the wirings that explain the
    pushes. ``drift``, ``drift_sd`` (4,): m/s, of the device's channels x1 y1 x2 y2. ``light``: of a PSD,
    in words, that it has too little or too much of it. ``notes``: what else is worth a look. ``source``: the recording.
    ``late``: the PSDs that are on another clock; all the rest is judged with their readings moved.
    """

    study, json_name = 'check', 'check.json'
    title = 'Is the rig set up as its file says?'

    rig: Rig
    verdict: str
    findings: tuple[Finding, ...]
    values: Mapping[str, object]
    pushes: tuple[PushResponse, ...]
    sizes: tuple[float, ...]
    wirings: tuple[WiringFit, ...]
    levels: Levels
    drift: FloatArray
    drift_sd: FloatArray
    light: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = field(default=())
    source: str = ''
    late: tuple[LatePsd, ...] = ()

    @property
    def sources(self) -> Mapping[str, str]:
        """The recording, if it was one."""
        return {'recording': self.source} if self.source else {}

    def sentences(self) -> list[str]:
        """Return the verdict, then what is wrong, one line each, then what to look at."""
        wrong = [f'{what}: {fix}' for what, fix in _findings(self)]
        return [_verdict(self), *wrong, *other_causes(self), *(f'note: {note}' for note in self.notes)]

    def lines(self) -> list[str]:
        """Pushes, verdict, lines for the rig file, levels."""
        out = ['', *columns(push_rows(self)).splitlines(), '', _verdict(self)]
        findings = _findings(self)
        width = max((len(what) for what, _ in findings), default=0)
        out += [f'  {what:<{width}}   {fix}' for what, fix in findings]
        out += [f'  {text}' for text in other_causes(self)]
        if self.values:
            out += ['', 'Lines for the rig file, below ros__parameters:', '']
            out += [f'    {line(name, value)}' for name, value in self.values.items()]
        notes = [('note', note) for note in self.notes]
        return [*out, '', *(f'{name:<9}{text}' for name, text in (*level_rows(self), *notes))]

    def sections(self) -> Iterable[PageSection]:
        """Pushes, lines for the rig file, levels."""
        head, *rows = push_rows(self)
        answers = (table(head, rows), answers_chart(self)) if self.pushes else (table(head, rows),)
        out = [PageSection('How each channel answered', answers)]
        if self.values:
            lines = [(line(name, value),) for name, value in self.values.items()]
            out.append(PageSection('Lines for the rig file', (table(('below ros__parameters',), lines),)))
        return [*out, PageSection('Noise, light and drift', (table(('', ''), level_rows(self)),))]

    def table(self) -> Table:
        """Return one row a finding: ``where``, ``value`` (a number, numbers, or None), ``fix``, ``evidence``."""
        findings = self.findings
        return Table(
            text_column('finding', [f.name for f in findings], 'what is wrong'),
            [
                text_column('where', [f.where for f in findings], 'channel, PSD, load, or when'),
                text_column('value', [f.value for f in findings], 'as it is'),
                text_column('fix', [f.fix for f in findings], 'what puts it right'),
                Column('evidence', np.array([f.evidence for f in findings], dtype=np.float64), '', 'for it'),
            ],
            {'verdict': self.verdict},
        )

    def tree(self) -> dict[str, Any]:
        """In SI units."""
        measured = self.levels
        return {
            'verdict': self.verdict,
            'setup': [finding_tree(f) for f in self.findings],
            'lines': dict(self.values),
            'wirings_that_fit': [_wiring_json(c.wiring) for c in self.wirings],
            'pushes': [
                {
                    'loads': list(p.loads),
                    'observed': p.observed,
                    'channels': _by_name(DOTS, p.channels.tolist()),
                    'sd': _by_name(DOTS, p.sd.tolist()),
                    'size': size if p.sized else None,
                }
                for p, size in zip(self.pushes, self.sizes, strict=True)
            ],
            'noise': {**_by_name(CHANNELS, measured.noise.tolist()), 'rig_file': measured.stated},
            'hum': {'hz': measured.hum_hz, **_by_name(CHANNELS, measured.hum.tolist())},
            'sums': measured.sums.tolist(),
            'light': dict(self.light),
            'late': [late.tree() for late in self.late],
            'drift': _by_name(DOTS, self.drift.tolist()),
            'drift_sd': _by_name(DOTS, self.drift_sd.tolist()),
            'notes': list(self.notes),
        }


def push_rows(checkup: Checkup) -> list[list[str]]:
    """How each channel answered, beside what the rig file expects of it."""
    rows = [['push', *(f'{c} µm' for c in DOTS), '', *DOTS, 'size']]
    for push, size in zip(checkup.pushes, checkup.sizes, strict=True):
        expected = on_channels(Wiring.from_rig(checkup.rig), push.expected)
        size_text = f'{abs(size):.2f}' if push.sized and math.isfinite(size) else ''
        words = [arrow(v, float(np.linalg.norm(expected))) for v in expected.tolist()]
        rows.append(
            [push.name, *(f'{v * 1e6:+z.1f}' for v in push.channels.tolist()), '  rig file:', *words, size_text]
        )
    if not any(row[-1] for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    return rows


def answers_chart(checkup: Checkup) -> Chart:
    """How each channel moved at each push, and how it would by the rig file."""
    wiring = Wiring.from_rig(checkup.rig)
    at = np.arange(1.0, len(checkup.pushes) + 1.0)
    expected = np.array([on_channels(wiring, push.expected) for push in checkup.pushes]) * 1e6
    moved = np.array([push.channels for push in checkup.pushes]) * 1e6
    deviations = np.array([push.sd for push in checkup.pushes]) * 1e6
    panels = []
    for i, name in enumerate(DOTS):
        curves = (
            Series('by the rig file', at, expected[:, i], 'red', 'rings'),
            Series('measured', at, moved[:, i], 'blue', 'points', deviations[:, i]),
        )
        panels.append(Panel(curves, 'push', f'{name} / µm', height=SMALL))
    return Chart('how each channel moved at each push', panels, beside=2)


def arrow(value: float, size: float) -> str:
    """Return a direction: + or -, or 0 for next to nothing."""
    return '0' if abs(value) < 0.1 * size else '+' if value > 0.0 else '-'


def _verdict(checkup: Checkup) -> str:
    fit = len(checkup.wirings)
    if checkup.verdict == RIGHT:
        return f'RIGHT: of {len(WIRINGS)} wirings only that of the rig file fits.'
    if checkup.verdict == CANNOT_TELL:
        if not fit:
            return 'CANNOT TELL: these pushes fit no wiring.'
        verb = 'does' if fit == 2 else 'do'
        return f"CANNOT TELL: the rig file's wiring fits, and so {verb} {fit - 1} of the other {len(WIRINGS) - 1}."
    if not any(f.name in WIRED for f in checkup.findings):
        return 'WRONG, but not in the wiring: that of the rig file fits.' if fit == 1 else 'WRONG, as follows:'
    fits = f'one wiring of {len(WIRINGS)} fits' if fit == 1 else f'{fit} wirings of {len(WIRINGS)} fit'
    return f'WRONG: {fits}, and that of the rig file does not.'


def _findings(checkup: Checkup) -> list[tuple[str, str]]:
    """What is wrong, and what to do about it."""
    rows = [(f'{late.where}: on another clock', late.words(checkup.source)) for late in checkup.late]
    for f in checkup.findings:
        where, name = f.where, NAMES[f.name]
        if f.name == 'psd_swap':
            where = where.replace(' ', ' and ')
        elif f.name == 'load_coverage' and f.value is None:
            where, name = 'pushes', 'not enough to tell'
        rows.append((f'{where}: {name}', f.fix))
    return [*rows, *((f'{psd}: light', text) for psd, text in checkup.light.items())]


def other_causes(checkup: Checkup) -> list[str]:
    """What else would look the same."""
    return [f'or else: {_other(text)}' for text in dict.fromkeys(t for f in checkup.findings for t in f.equivalent)]


def _other(text: str) -> str:
    name, _, loads = text.partition(' of ')
    if name != 'load_sign':
        return text
    ways = {'fx': '+X', 'fy': '+Y', 'tz': '+θ'}
    pushes = ', '.join(ways[load] for load in loads.split())
    return f'the rig file is right, and {pushes} went the other way (sign of the load); this would look the same'


def level_rows(checkup: Checkup) -> list[tuple[str, str]]:
    """Return noise, hum, light and drift as pairs of a title and words."""
    measured = checkup.levels
    noise = '  '.join(f'{c} {v * 1e3:.2f}' for c, v in zip(CHANNELS, measured.noise.tolist(), strict=True))
    drift = '  '.join(
        f'{c} {v * 60e6:+z.1f} ± {sd * 60e6:.1f}'
        for c, v, sd in zip(DOTS, checkup.drift.tolist(), checkup.drift_sd.tolist(), strict=True)
    )
    drift += '  µm a minute'
    if checkup.drift_sd.max() > SIGNIFICANT_DRIFT:
        drift = 'cannot be determined: the recording is too short'
    hum = 'none at 50 or 60 Hz'
    if measured.hum.max() > 0.0:
        sizes = '  '.join(f'{c} {v * 1e3:.1f}' for c, v in zip(CHANNELS, measured.hum.tolist(), strict=True))
        hum = f'{sizes}  mV at {measured.hum_hz:g} Hz'
    sums = '  '.join(f'{name} {v:.2f}' for name, v in zip(('sum1', 'sum2'), measured.sums.tolist(), strict=True))
    return [
        ('noise', f'{noise}  mV rms a sample (rig file {measured.stated * 1e3:.2f})'),
        ('hum', hum),
        ('light', f'{sums}  V (rig file {checkup.rig.amplifier.sum_nominal:g})'),
        ('drift', drift),
    ]


def _wiring_json(wiring: Wiring) -> dict[str, object]:
    axes = {f'psd_{psd}.axes': list(psd_axes) for psd, psd_axes in enumerate(wiring.axes, start=1)}
    return {'psds_exchanged': wiring.exchanged, **axes}


def _by_name(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))
