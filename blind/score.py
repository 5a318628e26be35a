# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scores of the blind suite: against thresholds that were fixed beforehand, with intervals."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from blind.campaign import bound_line
from blind.cases import SHOWS_ACROSS_LENGTHS, SUITE
from psd_deflection.records import CHANNELS

THRESHOLDS: Mapping[str, float] = SUITE['thresholds']


@dataclass(frozen=True)
class Row:
    """A sealed truth and its answer. ``separated``: whether the design can tell it apart, decided beforehand."""

    key: str
    kind: str
    gap: float
    separated: bool
    truth: list[dict[str, Any]]
    answer: dict[str, Any]
    mistake: str = ''
    wrong: tuple[dict[str, Any], ...] = ()

    @property
    def named(self) -> list[str]:
        return [e['name'] for e in self.answer['effects']]

    @property
    def sets(self) -> list[set[str]]:
        return [{e['name'], *e['equivalent']} for e in self.answer['effects']]


def complete(answer: dict[str, Any]) -> dict[str, Any]:
    """Return an answer of any tool with all that is counted: what it leaves out is nothing, or not a number."""
    effects = [{'equivalent': [], 'parameters': {}, **e} for e in answer.get('effects', ())]
    unknown = [{'law': None, **u} for u in answer.get('unknown', ())]
    message = 'unknown_effect' if unknown else 'effects_found' if effects else 'nothing_missing'
    nan = math.nan
    gap = dict.fromkeys(('before', 'after', 'floor', 'heldout_after'), nan)
    usual = {'verdict': message, 'setup': [], 'remaining': {'floors': nan}, 'gap': gap}
    return {**usual, 'provenance': {'forward_simulations': 0}, **answer, 'effects': effects, 'unknown': unknown}


def load(folder: Path, keys: Sequence[str]) -> list[Row]:
    out = []
    for key in keys:
        answer = folder / 'answers' / f'{key}.json'
        if not answer.exists():
            continue
        sealed = json.loads((folder / 'sealed' / f'{key}.json').read_text())
        case, result = sealed['case'], complete(json.loads(answer.read_text()))
        gap = max((g for _, g in case['wanted']), default=0.0)
        apart = case['design'] == 'two' or not any(n in SHOWS_ACROSS_LENGTHS for n, _ in case['wanted'])
        wrong = tuple(sealed.get('wrong', ()))
        out.append(Row(key, case['kind'], gap, apart, sealed['truth'], result, case['mistake'][0], wrong))
    return out


def share(k: int, n: int) -> str:
    """k of n, with the interval of Clopper and Pearson, 95 %."""
    interval = binomtest(k, n).proportion_ci()
    return f'{100 * k / n:.1f} % ({k}/{n}; 95 %: {100 * interval.low:.1f} to {100 * interval.high:.1f})'


def covered(row: Row) -> list[tuple[str, bool]]:
    """For each fitted parameter of the effect named rightly: whether truth is in its 95 % interval."""
    out = []
    for e in row.answer['effects']:
        for t in row.truth:
            if t['name'] != e['name']:
                continue
            fitted = e['parameters']
            # With other choices it is another effect, whose parameters are not those of the truth.
            if any(k in t and isinstance(v, int) and int(t[k]) != v for k, v in fitted.items()):
                continue
            known = {f'amplitude_{c}': v for c, v in zip(CHANNELS, np.ravel(t.get('amplitude', ())), strict=False)} | t
            for name, value in fitted.items():
                if isinstance(value, dict) and value['sd'] > 0.0 and name in known:
                    inside = abs(value['value'] - float(known[name])) <= 1.96 * value['sd']
                    out.append((f'{row.key}:{name}', inside))
    return out


class _Sheet:
    """The lines of a summary, and whether all thresholds hold."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.failures: list[str] = []
        self.passed = True

    def miss(self, rows: Sequence[Row], wrong: Sequence[bool]) -> None:
        """Those of ``rows`` that are ``wrong`` are failures."""
        self.failures += [f'{r.key}: {_row_words(r)}' for r in itertools.compress(rows, wrong)]

    def check(self, good: bool, text: str) -> None:
        self.passed = self.passed and good
        self.lines.append(f'  {bound_line(good, " " + text)}')

    def rate(self, name: str, rows: Sequence[Row], hits: Sequence[bool], low: float, high: float, note: bool) -> None:
        """The share of ``hits``, wanted from ``low`` to ``high``; with ``note``, misses go to the failures."""
        if note:
            self.miss(rows, [not hit for hit in hits])
        n, k = len(hits), sum(hits)
        if n == 0:
            self.lines.append(f'  --    {name}: no cases')
            return
        self.check(low <= k / n <= high, f'{name}: {share(k, n)}, wanted {100 * low:g} to {100 * high:g} %')


def summary(rows: Sequence[Row]) -> tuple[str, bool]:
    sheet = _Sheet()
    single = [r for r in rows if r.kind == 'single' and r.gap >= 3.0]
    _detections(sheet, single)
    _false_alarms(sheet, rows)
    pair = [r for r in rows if r.kind == 'pair']
    sheet.rate('both of a pair in the answer', pair, [_both(r) for r in pair], THRESHOLDS['both_of_a_pair'], 1.0, True)
    _score_spreads(sheet, rows)
    _mistakes(sheet, rows)
    _score_by_hand(sheet, [r for r in rows if r.kind == 'hand'])
    _unknowns(sheet, rows)
    _held_out(sheet, rows)
    cover = [c for r in rows if r.kind == 'single' for c in covered(r)]
    low, high = THRESHOLDS['coverage_low'], THRESHOLDS['coverage_high']
    sheet.rate('parameter inside its 95 % interval', [], [inside for _, inside in cover], low, high, False)
    _cost(sheet, rows)
    sheet.lines += ['', 'detection (truth in the answer or its sets) by gap:', *_curve(rows)]
    sheet.lines += ['', f'failures ({len(sheet.failures)}):', *('  ' + f for f in dict.fromkeys(sheet.failures))]
    outside = [key for key, inside in cover if not inside]
    sheet.lines += ['', f'parameters outside their interval ({len(outside)}):', *('  ' + k for k in outside)]
    return '\n'.join(sheet.lines), sheet.passed


def _detections(sheet: _Sheet, single: Sequence[Row]) -> None:
    """Cases with one effect that is large enough to be seen."""
    wanted = THRESHOLDS['named_or_equivalent']
    hit = [bool(r.sets) and r.truth[0]['name'] in r.sets[0] for r in single]
    sheet.rate('truth named first or in its set, gap >= 3 floors', single, hit, wanted, 1.0, True)
    if single:
        size, most = np.mean([len(r.sets[0]) if r.sets else 1 for r in single]), THRESHOLDS['mean_set_size']
        sheet.check(bool(size <= most), f'mean size of that set: {size:.2f}, wanted <= {most}')
    apart = [r for r in single if r.separated]
    first = [bool(r.named) and r.named[0] == r.truth[0]['name'] for r in apart]
    wanted = THRESHOLDS['named_first_where_separated']
    sheet.rate('named first where the design tells it apart', apart, first, wanted, 1.0, True)


def _false_alarms(sheet: _Sheet, rows: Sequence[Row]) -> None:
    """Cases without a hidden effect, with the rig file's noise and with another."""
    for kind, name in (('null', 'right'), ('wrong', 'wrong')):
        of = [r for r in rows if r.kind == kind]
        alarm = [r.answer['verdict'] != 'nothing_missing' for r in of]
        sheet.miss(of, alarm)
        sheet.rate(f'false alarm, {name} noise', of, alarm, 0.0, THRESHOLDS[f'false_alarm_{name}_noise'], False)


def _unknowns(sheet: _Sheet, rows: Sequence[Row]) -> None:
    """Effects missing from the library must be called unknown; effects in it should not."""
    for kinds in (('leftout',), ('alien',), ('leftout', 'alien')):
        of = [r for r in rows if r.kind in kinds]
        right = [r.answer['verdict'] == 'unknown_effect' for r in of]
        sheet.rate(f'{" or ".join(kinds)} called unknown', of, right, THRESHOLDS['unknown'], 1.0, len(kinds) == 1)
    listed = [r for r in rows if r.kind in ('single', 'pair') and r.gap >= 3.0]
    wrongly = [r for r in listed if r.answer['verdict'] == 'unknown_effect']
    words = 'truth in the library, gap >= 3 floors, and yet something called unknown'
    sheet.lines.append(f'        {words}: {len(wrongly)}/{len(listed)}')
    sheet.lines += [f'          {r.key}: {_row_words(r)}' for r in wrongly]


def _score_spreads(sheet: _Sheet, rows: Sequence[Row]) -> None:
    """Effects of very different size: all are named, and nothing above the noise is left unsaid in any answer."""
    for kind, words in (
        ('spread', 'all of a pair or triple of 1:10:100 floors'),
        ('four', 'all of four effects at once, 3 to 30 floors'),
        ('six', 'all of six effects at once, 3 to 30 floors'),
    ):
        of = [r for r in rows if r.kind == kind]
        sheet.rate(words, of, [_names_all(r) for r in of], THRESHOLDS[f'all_of_{kind}'], 1.0, True)
    of = [r for r in rows if r.kind in ('single', 'pair', 'spread', 'four', 'six')]
    sheet.rate('an effect named that is none', of, [_names_none(r) for r in of], 0.0, 0.0, False)
    sheet.miss(of, [_names_none(r) for r in of])
    most = THRESHOLDS['unsaid_floors']
    unreported = [r for r in rows if r.answer['remaining']['floors'] > most and not r.answer['unknown']]
    sheet.miss(unreported, [True] * len(unreported))
    sheet.check(not unreported, f'answers that leave more than {most} floors unsaid: {len(unreported)}, wanted 0')


def _mistakes(sheet: _Sheet, rows: Sequence[Row]) -> None:
    """A mistake of the set-up is named and nothing else is; a faultless recording has none."""
    of = [r for r in rows if r.kind == 'mistake']
    hits = [{s['name'] for s in r.answer['setup']} == {r.mistake} and not r.named for r in of]
    sheet.rate('mistake of the set-up named, and nothing else', of, hits, THRESHOLDS['mistake_named'], 1.0, True)
    sound = [r for r in rows if r.kind in ('faultless', 'null', 'single', 'pair', 'spread', 'four', 'six')]
    # Coarse steps are both: an effect, and a line of the rig file that is wrong.
    message = [[s['name'] for s in r.answer['setup'] if s['name'] != 'converter_step'] for r in sound]
    sheet.failures += [f'{r.key}: set-up {", ".join(s)}' for r, s in zip(sound, message, strict=True) if s]
    sheet.rate('mistake named where there is none', sound, [bool(s) for s in message], 0.0, 0.0, False)
    odd = [r for r in rows if r.kind == 'faultless']
    alarm = [r.answer['verdict'] != 'nothing_missing' for r in odd]
    sheet.miss(odd, alarm)
    sheet.rate('false alarm, gaps, outliers, start under load, own zeros', odd, alarm, 0.0, 0.01, False)


NEAR = {'load_time': 0.05, 'load_ramp': 0.15, 'load_delay': 5e-4}  # s by which a told time may be off.
TOLERANCES = (0.25, 0.25, 0.12)  # N, N, N m, and 2 %, by which a told load may be off.


def _reported(wrong: dict[str, Any], setup: Sequence[dict[str, Any]]) -> tuple[bool, bool]:
    """Return whether a wrong note is named, and with the right numbers."""
    of = [s for s in setup if s['name'] == wrong['name']]
    if 'from' in wrong:
        of = [s for s in of if abs(float(s['where'].removesuffix(' s')) - wrong['from']) < 0.1]
    elif wrong.get('where', '').startswith('load'):
        of = [s for s in of if s['where'] == wrong['where']]
    if not of:
        return False, False
    if 'load' in wrong:
        pairs = zip(of[0]['value'] or (math.nan,) * 3, wrong['load'], TOLERANCES, strict=True)
        return True, all(abs(a - b) < most + 0.02 * abs(b) for a, b, most in pairs)
    if 'value' not in wrong:
        return True, True
    off = abs(of[0]['value'] - wrong['value'])
    return True, off < NEAR.get(wrong['name'], 0.03 * abs(wrong['value']))


def _score_by_hand(sheet: _Sheet, of: Sequence[Row]) -> None:
    """Notes by hand: each wrong one is named, with the right line; nothing is unknown; no effect is lost."""
    if not of:
        return
    reported = [[_reported(w, r.answer['setup']) for w in r.wrong] for r in of]
    named_all = [_names_all(r) for r in of]
    false = [_names_none(r) for r in of]
    unknown = [r.answer['verdict'] == 'unknown_effect' for r in of]
    mistaken = [i for i, r in enumerate(of) if r.wrong]
    named = [any(a for a, _ in reported[i]) for i in mistaken]
    sheet.rate('hand: mistake named', [of[i] for i in mistaken], named, THRESHOLDS['mistake_named'], 1.0, True)
    each = [b for i in mistaken for _, b in reported[i]]
    sheet.rate('hand: note with the right line', [], each, THRESHOLDS['hand_line'], 1.0, False)
    hidden = [i for i, r in enumerate(of) if r.truth]
    right = [named_all[i] for i in hidden]
    sheet.rate('hand: effect named', [of[i] for i in hidden], right, THRESHOLDS['hand_effect'], 1.0, True)
    sheet.rate('hand: an effect named that is none', of, false, 0.0, 0.0, False)
    sheet.rate('hand: something unknown, nothing is', of, unknown, 0.0, 0.0, False)
    sheet.rate('hand: a law told', of, [any(u['law'] for u in r.answer['unknown']) for r in of], 0.0, 0.0, False)


def _held_out(sheet: _Sheet, rows: Sequence[Row]) -> None:
    """The remaining gap on load cases that the fit has not seen."""
    known = [r for r in rows if r.kind in ('single', 'pair', 'null', 'wrong')]
    known = [r for r in known if not math.isnan(r.answer['gap']['heldout_after'])]
    if not known:
        return
    most, most_p95 = THRESHOLDS['heldout_over_floor_median'], THRESHOLDS['heldout_over_floor_p95']
    ratio = np.array([r.answer['gap']['heldout_after'] / r.answer['gap']['floor'] for r in known])
    middle, top = float(np.median(ratio)), float(np.quantile(ratio, 0.95))
    text = f'held-out gap after, over the floor: median {middle:.3f}, 95th percentile {top:.3f}'
    sheet.check(middle <= most and top <= most_p95, f'{text}, wanted <= {most}, {most_p95}')


def _cost(sheet: _Sheet, rows: Sequence[Row]) -> None:
    if not rows:
        return
    for of, key, what in (
        ([r for r in rows if len(r.truth) <= 1], 'forward_simulations', 'at most one effect'),
        ([r for r in rows if len(r.truth) > 1], 'forward_simulations_several', 'several effects'),
    ):
        cost = max((r.answer['provenance']['forward_simulations'] for r in of), default=0)
        text = f'forward simulations of one search, {what}: at most {cost}, wanted <= {THRESHOLDS[key]:g}'
        sheet.check(cost <= THRESHOLDS[key], text)
    seconds = np.array([r.answer.get('seconds', 0.0) for r in rows])
    sheet.lines.append(f'        seconds a case: median {np.median(seconds):.2f}, largest {seconds.max():.2f}')


def _curve(rows: Sequence[Row]) -> list[str]:
    lines = []
    for gap in sorted({r.gap for r in rows if r.kind == 'single'}):
        of = [r for r in rows if r.kind == 'single' and r.gap == gap]
        k = sum(any(r.truth[0]['name'] in s for s in r.sets) for r in of)
        lines.append(f'  {gap:5.1f} floors: {share(k, len(of))}')
    return lines


def _names_all(r: Row) -> bool:
    return all(any(t['name'] in s for s in r.sets) for t in r.truth)


def _names_none(r: Row) -> bool:
    """Return whether an effect is named that is none: neither it nor one that cannot be distinguished from it is
    hidden."""
    return any(not any(t['name'] in s for t in r.truth) for s in r.sets)


def _both(row: Row) -> bool:
    a, b = (t['name'] for t in row.truth)
    return any(a in first and b in other for first, other in itertools.permutations(row.sets, 2))


def _row_words(row: Row) -> str:
    truth = ', '.join(t['name'] for t in row.truth) or 'nothing'
    message = '; '.join('/'.join(sorted(s)) for s in row.sets) or 'no effect'
    gap = row.answer['gap']
    before, after = gap['before'] / gap['floor'], gap['after'] / gap['floor']
    return f'truth {truth}; {row.answer["verdict"]}: {message}; gap {before:.2f} -> {after:.2f}'
