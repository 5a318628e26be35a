# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The verdict, the findings and the notes of pushes, levels and drift that are made by hand."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.checkup import CheckProblem, check
from psd_deflection.studies.check.result import CANNOT_TELL, RIGHT, WRONG, Checkup, Levels
from psd_deflection.studies.check.wirings import PushResponse, on_channels
from psd_deflection.studies.loads.annotated_times import CorrectedNote

RIG = load_rig()
STATED = math.hypot(2e-3, 20.0 / 2**16 / math.sqrt(12.0))
PLATE = {'fx': [-1.0, 0.0, -1.0, 0.0], 'fy': [0.0, -1.0, 0.0, -1.0], 'tz': [0.07, 0.0, 0.0, 0.1]}
"""How x1 y1 x2 y2 of PSDs at (0, 70) and (-100, 0) mm move by a metre along X, along Y and by a radian."""


def push(
    load: str, size: float = 1.0, wiring: Wiring | None = None, *, sized: bool = True, sd: float = 1e-6
) -> PushResponse:
    """A movement of ``size`` times the expected one, some tenths of a millimetre, on the channels of ``wiring``."""
    expected = (1e-4 if load != 'tz' else 1e-3) * np.array(PLATE[load])
    moved = on_channels(wiring or Wiring(), size * expected)
    return PushResponse((load,), moved, np.full(4, sd), expected, sized=sized)


THREE = [push('fx'), push('fy'), push('tz')]


def of_levels(
    noise: float | FloatArray = STATED,
    sums: tuple[float, float] = (5.0, 5.0),
    hum: Sequence[float] = (0.0,) * 6,
    stuck: tuple[str, ...] = (),
    steps: Sequence[float] = (0.0,) * 6,
    hum_hz: float = 50.0,
) -> Levels:
    return Levels(np.zeros(6) + noise, STATED, np.array(hum), hum_hz, np.array(sums), stuck, np.array(steps))


def checked(
    pushes: Sequence[PushResponse] = THREE,
    levels: Levels | None = None,
    drift: Sequence[float] = (0.0,) * 4,
    drift_sd: float = 1e-9,
    rig: Rig = RIG,
    notes: Sequence[CorrectedNote] = (),
) -> Checkup:
    drifting = np.array(drift), np.full(4, drift_sd)
    return check(CheckProblem(rig, pushes, levels or of_levels(), *drifting, source='x', notes=notes))


def of(found: Checkup) -> list[tuple[str, str]]:
    return [(f.name, f.where) for f in found.findings]


def test_channel_below_a_tenth_of_every_push_is_dead() -> None:
    def with_share(share: float, only_twist: bool = False) -> Checkup:
        fx = replace(push('fx'), channels=np.array([share, 0.0, math.sqrt(1.0 - share**2), 0.0]) * -1e-4)
        turn = replace(push('tz'), channels=np.array([0.0, 0.0, 0.0, 1e-4]), only_twist=only_twist)
        return checked([fx, push('fy'), turn])

    assert of(with_share(0.099)) == [('stuck_channel', 'x1')]
    assert with_share(0.099).findings[0].fix == 'x1 does not answer: look at its cable'
    assert ('stuck_channel', 'x1') not in of(with_share(0.101))
    # Of 1, 3, 9 and 3 the first is a tenth of the whole: that is an answer.
    tenth = replace(push('fx'), channels=np.array([1.0, 3.0, 9.0, 3.0]) * -1e-4)
    assert ('stuck_channel', 'x1') not in of(checked([tenth, push('fy')]))
    # A turn by hand says nothing of it, and without pushes along both axes nobody knows.
    rotated = replace(push('tz'), only_twist=True)
    dead = replace(push('fx'), channels=np.array([0.0, 0.0, -1e-4, 0.0]))
    assert of(checked([dead, push('fy'), rotated])) == [('stuck_channel', 'x1')]
    assert ('stuck_channel', 'x1') not in of(checked([dead, push('fy'), push('tz')]))
    assert ('stuck_channel', 'x1') not in of(checked([dead, rotated]))


def test_stuck_channel_is_reported_once_without_wiring() -> None:
    dead = replace(push('fx'), channels=np.array([0.0, 0.0, -1e-4, 0.0]))
    found = checked([dead, push('fy')], of_levels(stuck=('x1', 'sum2')))
    assert of(found) == [('stuck_channel', 'x1'), ('stuck_channel', 'sum2')]
    assert found.verdict == WRONG
    rotated = Wiring(False, (('-x', 'y'), ('x', 'y')))
    three = [push(load, 9.80665, rotated) for load in ('fx', 'fy', 'tz')]
    assert of(checked(three, of_levels(stuck=('sum2',)))) == [('stuck_channel', 'sum2')]


def test_a_wrong_wiring_has_its_lines_only_if_it_is_the_only_one() -> None:
    wiring = Wiring(False, (('-x', 'y'), ('x', 'y')))
    three = [push(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')]
    found = checked(three)
    assert of(found) == [('channel_sign', 'x1')]
    assert dict(found.values) == {'psd_1.axes': ['-x', 'y']}
    # By the file a push along X is opposite on x1, which leaves all of it; one turn is opposite, too.
    assert found.findings[0].evidence == pytest.approx(1.0 + 1.0 - 0.0, abs=0.7)
    assert found.findings[0].evidence > 1.0
    assert found.findings[0].equivalent == ()
    two = checked(three[:2])
    assert two.verdict == WRONG
    assert dict(two.values) == {}
    assert len(two.wirings) == 2
    assert two.findings[0].equivalent == ('1 other wiring, which these pushes cannot tell apart',)
    one = checked(three[:1])
    others = len(one.wirings) - 1
    assert others > 1
    assert one.findings[0].equivalent == (f'{others} other wirings, which these pushes cannot tell apart',)


def test_all_signs_turned_may_be_the_loads_as_well() -> None:
    wiring = Wiring(False, (('-x', '-y'), ('-x', '-y')))
    found = checked([push(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')])
    assert {f.equivalent for f in found.findings} == {('load_sign of fx fy tz',)}
    # By the file each push goes the other way and leaves nothing of its own: three that are not explained at all.
    assert [f.evidence for f in found.findings] == pytest.approx([3.0] * 4)
    # If one of the loads went the other way too, only the others are turned: half as far as expected.
    other = checked([push('fx', 1.0, wiring), push('fy', 1.0, wiring), push('tz', -0.5, wiring)])
    assert ('load_sign of fx fy',) in {f.equivalent for f in other.findings}
    # A push that leans leaves 0.04 of 1.04 of the best one as well.
    lean = replace(push('fx', 1.0, wiring), channels=np.array([1.0, 0.2, 1.0, 0.2]) * 1e-4)
    found = checked([lean, *(push(load, 1.0, wiring) for load in ('fy', 'tz'))])
    assert [f.evidence for f in found.findings] == pytest.approx([3.0 - 0.04 / 1.04] * 4)
    # A push that leans leaves 0.36 of it, beyond the limit: then the loads are no other explanation.
    lean = replace(push('fx', 1.0, wiring), channels=np.array([1.0, 0.75, 1.0, 0.75]) * 1e-4)
    found = checked([lean, *(push(load, 1.0, wiring) for load in ('fy', 'tz'))])
    assert not any('load_sign' in text for f in found.findings for text in f.equivalent)


def test_a_load_of_the_other_sign_is_reported() -> None:
    found = checked([push('fx'), push('fy'), push('tz', -1.0)])
    assert [(f.name, f.where, f.value, f.fix) for f in found.findings] == [
        ('load_sign', 'tz', -1.0, 'load_tz in the recording has the wrong sign')
    ]
    assert found.sizes == pytest.approx([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ('size', 'reported'),
    [
        (1.09, ''),
        (1.11, '1.11'),
        (0.92, ''),
        (0.9, '0.90'),
        (2.05, '2.05'),
        (0.48, '0.48'),
        (-1.2, '1.20'),
        (-1.05, ''),
    ],
)
def test_a_push_a_tenth_too_large_is_noted(size: float, reported: str) -> None:
    found = checked([push('fx'), push('fy'), push('tz', size)])
    words = (
        f'+θ: the dots move {reported} times what the rig file expects; see its link and amplifier.sensitivity '
        '(`psd-deflection discover` names the cause)'
    )
    assert found.notes == ((words,) if reported else ())
    # By hand nobody knows how far.
    assert checked([push('fx'), push('fy'), push('tz', size, sized=False)]).notes == ()


@pytest.mark.parametrize(
    ('pushes', 'where', 'fix'),
    [
        ([push('fx'), push('fy')], 'tz', 'record again with a torque about Z alone too'),
        ([push('fy'), push('tz')], 'fx', 'record again with a load along X alone too'),
        ([push('fx')], 'fy tz', 'record again, one after the other: a load along Y alone, a torque about Z alone'),
        (
            [],
            'fx fy tz',
            'record again, one after the other: a load along X alone, a load along Y alone, a torque about Z alone',
        ),
        ([push('fx'), push('fy'), push('tz', sd=1.0)], 'tz', '+θ does not stand out of the noise: push harder'),
        (
            [push('fx', sd=1.0), push('fy', sd=1.0), push('tz')],
            'fx fy',
            '+X and +Y do not stand out of the noise: push harder',
        ),
    ],
)
def test_what_is_missing_is_asked_for(pushes: list[PushResponse], where: str, fix: str) -> None:
    found = checked(pushes)
    assert found.verdict == CANNOT_TELL
    assert [(f.name, f.where, f.value, f.fix) for f in found.findings] == [('load_coverage', where, None, fix)]
    assert [math.isnan(s) for s in found.sizes] == [not p.observed for p in pushes]


def test_pushes_that_no_wiring_explains_are_asked_for_again() -> None:
    odd = [replace(push('fx'), channels=np.array([-1.0, 1.0, 1.0, 1.0]) * 1e-4), push('fy'), push('tz')]
    odd[0] = replace(odd[0], channels=np.array([-1.0, 1.0, -1.0, 1.0]) * 1e-4)
    found = checked(odd)
    assert found.wirings == ()
    assert found.verdict == CANNOT_TELL
    assert [(f.where, f.fix) for f in found.findings] == [
        ('fx fy tz', 'no wiring explains these pushes: push one way at a time, along +X, along +Y, then turn about +θ')
    ]
    # Of a wrong wiring several are left: that is wrong, and more is asked for too.
    wiring = Wiring(False, (('-x', 'y'), ('x', 'y')))
    assert of(checked([push('fx', 1.0, wiring), push('fy', 1.0, wiring)]))[-1] == ('load_coverage', 'tz')


def test_noise_is_that_of_the_psds_whatever_inputs_they_are_on() -> None:
    rig = load_rig(
        overrides={
            'psd_1.noise': [1e-3, 2e-3],
            'psd_2.noise': [4e-3, 3e-3],
            'psds_exchanged': True,
            'psd_1.axes': ['y', 'x'],
        }
    )
    wiring = Wiring.from_rig(rig)
    # PSD 1 is on input 2 with its axes exchanged: its x is y2. PSD 2 is on input 1.
    noise = np.array([4e-3, 3e-3, 1.0, 2e-3, 1e-3, 1.0])
    pushes = [push(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')]
    assert checked(pushes, of_levels(noise), rig=rig).findings == ()
    noise[4] = 9e-3
    found = checked(pushes, of_levels(noise), rig=rig)
    assert of(found) == [('noise_level', 'x1')]
    assert dict(found.values) == {'psd_1.noise': [9e-3, 2e-3]}


@pytest.mark.parametrize(
    ('sums', 'light'),
    [
        ((5.0, 2.5), {}),
        ((7.5, 5.0), {}),
        ((5.0, 2.49), {'psd_2': 'too little: sum 2.49 V, below sum_min 2.5 V'}),
        ((7.51, 5.0), {'psd_1': 'too much: sum 7.51 V, above sum_max 7.5 V'}),
        ((1.0, 9.0), {'psd_1': 'too little: sum 1.00 V', 'psd_2': 'too much: sum 9.00 V'}),
    ],
)
def test_a_sum_between_its_limits_is_light_enough(sums: tuple[float, float], light: dict[str, str]) -> None:
    found = checked(levels=of_levels(sums=sums))
    assert list(found.light) == list(light)
    assert all(found.light[psd].startswith(words) for psd, words in light.items())
    assert found.verdict == (WRONG if light else RIGHT)
    # Exchanged PSDs have the light of the other input.
    rig = load_rig(overrides={'psds_exchanged': True})
    other = [push(load, 1.0, Wiring(exchanged=True)) for load in ('fx', 'fy', 'tz')]
    assert {f'psd_{3 - int(psd[-1])}' for psd in checked(other, of_levels(sums=sums), rig=rig).light} == {*light}
    # One that is stuck is told already.
    dead = checked(levels=of_levels(sums=sums, stuck=('sum1', 'sum2')))
    assert not dead.light


@pytest.mark.parametrize(
    ('level', 'reported'), [(5.74, False), (5.76, True), (4.35, False), (4.34, True), (7.5, True), (7.6, False)]
)
def test_a_sum_that_is_off_by_fifteen_per_cent_is_worth_a_look(level: float, reported: bool) -> None:
    found = checked(levels=of_levels(sums=(5.0, level)))
    words = f'psd_2: sum {level:.2f} V, the rig file says 5 V; see amplifier.sum_nominal'
    assert found.notes == ((words,) if reported else ())


@pytest.mark.parametrize(
    ('drift', 'sd', 'note'),
    [
        ((0.0, 5.1, 0.0, 0.0), 0.06, '+5.1 µm a minute on y1'),
        ((0.0, 4.9, 0.0, 0.0), 0.06, ''),
        # The farthest of those that stand out.
        ((6.0, 0.0, -7.0, 0.0), 0.06, '-7.0 µm a minute on x2'),
        # Beyond five deviations, and of a short recording nothing.
        ((0.0, 0.0, 0.0, 7.1), 1.4, '+7.1 µm a minute on y2'),
        ((0.0, 0.0, 0.0, 7.1), 1.5, ''),
        ((0.0, 0.0, 0.0, 26.0), 4.99, '+26.0 µm a minute on y2'),
        ((0.0, 0.0, 0.0, 26.0), 5.01, ''),
    ],
)
def test_drift_beyond_5_um_a_minute_and_5_sd_is_noted(drift: tuple[float, ...], sd: float, note: str) -> None:
    minute = 1e-6 / 60.0
    notes = checked(drift=[minute * d for d in drift], drift_sd=minute * sd).notes
    assert notes == ((f'drift: {note}; let lasers and amplifier warm up',) if note else ())


def test_hum_is_noted_where_it_is_largest() -> None:
    hum = (0.0, 1e-3, 0.0, 4e-3, 0.0, 2e-3)
    words = 'hum: 4.0 mV at 60 Hz on x2; look at shielding and ground'
    assert checked(levels=of_levels(hum=hum, hum_hz=60.0)).notes == (words,)
