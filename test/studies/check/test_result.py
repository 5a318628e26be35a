# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The words, rows and charts of a checkup that is made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.rig.config import load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.result import (
    CANNOT_TELL,
    RIGHT,
    SIGNIFICANT_DRIFT,
    WRONG,
    Checkup,
    Finding,
    Levels,
    finding_tree,
    level_rows,
    other_causes,
    push_rows,
)
from psd_deflection.studies.check.wirings import WIRINGS, PushResponse, WiringFit

RIG = load_rig(overrides={'psd_1.axes': ['-x', 'y']})
LEVELS = Levels(
    np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.5]) * 1e-3, 2.2e-3, np.zeros(6), 50.0, np.array([4.5, 5.25]), (), np.zeros(6)
)
PUSHES = (
    PushResponse(
        ('fx',),
        np.array([1e-6, -2.04e-6, 0.0, 4e-6]),
        np.full(4, 1e-7),
        np.array([-1e-6, 0.0, 1e-6, 1e-8]),
        sized=False,
    ),
    PushResponse(
        ('fy', 'tz'), np.array([0.0, 0.0, -1e-8, 1e-3]), np.arange(1.0, 5.0) * 1e-7, np.array([0.0, 2e-6, 0.0, -1e-6])
    ),
)
CHECKUP = Checkup(
    rig=RIG,
    verdict=RIGHT,
    findings=(),
    values={},
    pushes=PUSHES,
    sizes=(1.5, -0.5),
    wirings=(WiringFit(Wiring(), 0.1),),
    levels=LEVELS,
    drift=np.array([1.0, -2.0, 0.0, -1e-4]) * 1e-6 / 60.0,
    drift_sd=np.array([0.1, 0.2, 0.3, 0.44]) * 1e-6 / 60.0,
)


def finding(name: str, where: str, fix: str = 'do it', equivalent: tuple[str, ...] = ()) -> Finding:
    return Finding(name, where, 1.5, fix, 0.25, equivalent)


def fits(count: int) -> tuple[WiringFit, ...]:
    return tuple(WiringFit(w, 0.0) for w in WIRINGS[:count])


@pytest.mark.parametrize(
    ('verdict', 'names', 'count', 'words'),
    [
        (RIGHT, (), 1, 'RIGHT: of 128 wirings only that of the rig file fits.'),
        (CANNOT_TELL, (), 0, 'CANNOT TELL: these pushes fit no wiring.'),
        (CANNOT_TELL, (), 2, "CANNOT TELL: the rig file's wiring fits, and so does 1 of the other 127."),
        (CANNOT_TELL, (), 3, "CANNOT TELL: the rig file's wiring fits, and so do 2 of the other 127."),
        (WRONG, ('noise_level',), 1, 'WRONG, but not in the wiring: that of the rig file fits.'),
        (WRONG, ('noise_level',), 2, 'WRONG, as follows:'),
        (WRONG, ('noise_level',), 0, 'WRONG, as follows:'),
        (WRONG, ('axis_swap',), 1, 'WRONG: one wiring of 128 fits, and that of the rig file does not.'),
        (WRONG, ('noise_level', 'psd_swap'), 2, 'WRONG: 2 wirings of 128 fit, and that of the rig file does not.'),
    ],
)
def test_the_verdict_is_a_sentence(verdict: str, names: tuple[str, ...], count: int, words: str) -> None:
    findings = tuple(finding(name, 'x1') for name in names)
    checkup = replace(CHECKUP, verdict=verdict, findings=findings, wirings=fits(count))
    assert checkup.sentences()[0] == words
    assert words in checkup.lines()


def test_what_is_wrong_is_reported_with_where_and_what_to_do() -> None:
    checkup = replace(
        CHECKUP,
        verdict=WRONG,
        findings=(
            finding('psd_swap', 'psd_1 psd_2', 'psds_exchanged: true', ('load_sign of fx tz', 'another')),
            replace(finding('load_coverage', 'fx fy', 'push'), value=None),
            finding('load_coverage', 'load_fx', 'note it'),
            finding('channel_sign', 'x1', 'turn', ('another',)),
        ),
        light={'psd_2': 'too much'},
        values={'psds_exchanged': True, 'psd_1.axes': ['x', 'y']},
        notes=('hum',),
    )
    causes = [
        'or else: the rig file is right, and +X, +θ went the other way (sign of the load); this would look the same',
        'or else: another',
    ]
    assert checkup.sentences()[1:] == [
        'psd_1 and psd_2: exchanged: psds_exchanged: true',
        'pushes: not enough to tell: push',
        'load_fx: not seen: note it',
        'x1: sign turned: turn',
        'psd_2: light: too much',
        *causes,
        'note: hum',
    ]
    assert other_causes(checkup) == causes
    lines = checkup.lines()
    at = lines.index(checkup.sentences()[0])
    assert lines[at + 1 : at + 14] == [
        '  psd_1 and psd_2: exchanged   psds_exchanged: true',
        '  pushes: not enough to tell   push',
        '  load_fx: not seen            note it',
        '  x1: sign turned              turn',
        '  psd_2: light                 too much',
        *(f'  {cause}' for cause in causes),
        '',
        'Lines for the rig file, below ros__parameters:',
        '',
        '    psds_exchanged: true',
        "    psd_1.axes: [x, 'y']",
        '',
    ]
    assert lines[-1] == 'note     hum'
    assert lines[-2].startswith('drift    x1')
    titles = [section.title for section in checkup.sections()]
    assert titles == ['How each channel answered', 'Lines for the rig file', 'Noise, light and drift']
    assert [s.title for s in CHECKUP.sections()] == [titles[0], titles[2]]
    (first, *_) = checkup.sections()
    assert len(first.parts) == 2
    (first, *_) = replace(CHECKUP, pushes=(), sizes=()).sections()
    assert len(first.parts) == 1


def test_push_rows_list_expected_channels_of_rig_file() -> None:
    head, along, beside = push_rows(CHECKUP)
    assert head == ['push', 'x1 µm', 'y1 µm', 'x2 µm', 'y2 µm', '', 'x1', 'y1', 'x2', 'y2', 'size']
    # The file has x1 turned; a hundredth of the whole is next to nothing. By hand there is no size.
    assert along == ['+X', '+1.0', '-2.0', '+0.0', '+4.0', '  rig file:', '+', '0', '+', '0', '']
    assert beside == ['+Y with +θ', '+0.0', '+0.0', '+0.0', '+1000.0', '  rig file:', '0', '+', '0', '-', '0.50']
    # Rounded to a tenth of a micrometre.
    rounded = replace(PUSHES[0], channels=np.array([1.0499995e-6, 1.0500005e-6, 0.0, 0.0]))
    assert push_rows(replace(CHECKUP, pushes=(rounded,), sizes=(1.0,)))[1][1:3] == ['+1.0', '+1.1']
    assert [row[-1] for row in push_rows(replace(CHECKUP, pushes=PUSHES[::-1]))] == ['size', '1.50', '']
    assert [len(row) for row in push_rows(replace(CHECKUP, sizes=(1.5, math.nan)))] == [10, 10, 10]
    assert CHECKUP.lines()[0] == ''
    assert CHECKUP.lines()[1].split() == [
        *('push', 'x1', 'µm', 'y1', 'µm', 'x2', 'µm', 'y2', 'µm', 'x1', 'y1', 'x2', 'y2', 'size')
    ]


def test_levels_are_in_mv_and_drift_in_um_per_minute() -> None:
    assert level_rows(CHECKUP) == [
        ('noise', 'x1 1.00  y1 2.00  sum1 3.00  x2 4.00  y2 5.00  sum2 6.50  mV rms a sample (rig file 2.20)'),
        ('hum', 'none at 50 or 60 Hz'),
        ('light', 'sum1 4.50  sum2 5.25  V (rig file 5)'),
        ('drift', 'x1 +1.0 ± 0.1  y1 -2.0 ± 0.2  x2 +0.0 ± 0.3  y2 +0.0 ± 0.4  µm a minute'),
    ]
    hum = replace(LEVELS, hum=np.array([0.0, 1e-3, 0.0, 2.5e-3, 0.0, 0.0]), hum_hz=60.0)
    assert level_rows(replace(CHECKUP, levels=hum))[1] == (
        'hum',
        'x1 0.0  y1 1.0  sum1 0.0  x2 2.5  y2 0.0  sum2 0.0  mV at 60 Hz',
    )
    minute = 1e-6 / 60.0
    rounded = replace(
        CHECKUP,
        drift=minute * np.array([1.04999999, 1.05000001, 0.0, 0.0]),
        drift_sd=minute * np.array([2.24999998, 2.25000002, 0.0, 0.0]),
        levels=replace(LEVELS, hum=np.array([1.0495e-3, 1.0505e-3, 0.0, 0.0, 0.0, 0.0]), stated=2.2245e-3),
    )
    reported = dict(level_rows(rounded))
    assert reported['drift'].startswith('x1 +1.0 ± 2.2  y1 +1.1 ± 2.3  ')
    assert reported['hum'].startswith('x1 1.0  y1 1.1  ')
    assert reported['noise'].endswith('(rig file 2.22)')
    assert level_rows(replace(CHECKUP, levels=replace(LEVELS, stated=2.2255e-3)))[0][1].endswith('(rig file 2.23)')
    for sd, known in ((SIGNIFICANT_DRIFT, True), (1.001 * SIGNIFICANT_DRIFT, False)):
        short = replace(CHECKUP, drift_sd=np.array([0.0, 0.0, sd, 0.0]))
        assert (level_rows(short)[3][1] != 'cannot be determined: the recording is too short') is known


def test_a_load_noted_within_a_tenth_of_a_second_is_no_mistake() -> None:
    late = [replace(finding('load_time', 'load 2'), value=value) for value in (-0.099, 0.1, (1.0, 0.0, 0.0))]
    assert [f.by_hand for f in (*late, replace(finding('sensitivity', 'psd 1'), value=0.05))] == [True, *[False] * 3]


def test_the_tree_and_the_table_have_all_numbers() -> None:
    wrong = replace(CHECKUP, verdict=WRONG, findings=(finding('channel_sign', 'x1', 'turn', ('a',)),), source='run.csv')
    assert (wrong.sources, CHECKUP.sources) == ({'recording': 'run.csv'}, {})
    tree = wrong.tree()
    assert tree['setup'] == [finding_tree(wrong.findings[0])]
    assert tree['setup'] == [
        {'name': 'channel_sign', 'where': 'x1', 'value': 1.5, 'fix': 'turn', 'evidence': 0.25, 'equivalent': ['a']}
    ]
    first, second = tree['pushes']
    assert (first['loads'], first['observed'], first['size']) == (['fx'], True, None)
    assert (second['loads'], second['observed'], second['size']) == (['fy', 'tz'], True, -0.5)
    assert second['sd'] == pytest.approx({'x1': 1e-7, 'y1': 2e-7, 'x2': 3e-7, 'y2': 4e-7})
    assert tree['noise']['sum2'] == pytest.approx(6.5e-3)
    assert tree['noise']['rig_file'] == 2.2e-3
    assert tree['hum'] == {'hz': 50.0, 'x1': 0.0, 'y1': 0.0, 'sum1': 0.0, 'x2': 0.0, 'y2': 0.0, 'sum2': 0.0}
    assert tree['sums'] == [4.5, 5.25]
    assert tree['wirings_that_fit'] == [{'psds_exchanged': False, 'psd_1.axes': ['x', 'y'], 'psd_2.axes': ['x', 'y']}]
    table = wrong.table()
    assert table.attributes == {'verdict': WRONG}
    assert [c.name for c in table.columns] == ['where', 'value', 'fix', 'evidence']
    assert [c.values[0] for c in table.columns] == ['x1', 1.5, 'turn', 0.25]
