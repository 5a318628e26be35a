# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is said of modes that are given, by hand, and what of them reaches the rig file and the shaper."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from blind.modes import RATE
from psd_deflection.cli.main import main
from psd_deflection.model.link.shapers import recommended, shaper
from psd_deflection.studies.identify.identify import Identified, IdentifyProblem
from psd_deflection.studies.identify.spectra import AxisModes, Mode
from psd_deflection.studies.study import Opened, opened


def mode(frequency: float = 14.0, damping: float = 0.02, *, sd: float = 1e-4, damping_sd: float = 1e-4) -> Mode:
    return Mode(frequency, sd, damping, damping_sd, 1e-3)


def of_axes(*axes: tuple[Mode, ...], stretches: int = 1) -> Identified:
    """Seen in ``stretches`` of half a second, one each second; 500 samples a second."""
    places = tuple((500 * i + 50, 500 * i + 300) for i in range(stretches))
    x, y, twist = (
        AxisModes(
            modes, 'ring-down' if modes and stretches else 'operation' if modes else 'none', places, np.zeros(3), 1e-6
        )
        for modes in axes
    )
    nowhere: Any = None
    return Identified(IdentifyProblem(nowhere, np.zeros((3, 3)), 500.0), (x, y, twist))


@pytest.mark.parametrize(
    ('x', 'y', 'why'),
    [
        ((mode(sd=0.139),), (), None),
        ((mode(sd=0.141),), (), 'not known well'),
        ((mode(damping_sd=0.0067),), (), None),
        ((mode(damping_sd=0.0069),), (), 'not known well'),
        # The surer of the two counts.
        ((mode(sd=0.2),), (mode(sd=0.1),), None),
        # As a share of its frequency: the higher of two that agree within their scatter.
        ((mode(12.0, sd=0.1199, damping_sd=0.5),), (mode(12.3, sd=0.1228),), None),
        # Apart by half a percent...
        ((mode(),), (mode(14.069),), None),
        ((mode(14.0702),), (mode(14.0),), None),
        ((mode(),), (mode(14.072),), 'ΔX and ΔY ring at different frequencies'),
        # ...or by three standard deviations of both, 0.03 and 0.04 Hz.
        ((mode(sd=0.03),), (mode(14.149, sd=0.04),), None),
        ((mode(sd=0.03),), (mode(14.151, sd=0.04),), 'different frequencies'),
        # Within 30 % of the loudest one.
        ((mode(10.0), mode(13.1)), (), None),
        ((mode(10.0), mode(12.9)), (), 'two modes close'),
        ((mode(10.0),), (mode(10.0), mode(30.0), mode(7.1)), 'two modes close'),
        ((mode(10.0), mode(6.9)), (mode(10.0),), None),
        ((), (), None),
    ],
)
def test_why_the_rig_file_does_not_get_a_mode(x: tuple[Mode, ...], y: tuple[Mode, ...], why: str | None) -> None:
    answer = of_axes(x, y, ())
    message = answer.withheld_reason('bending')
    assert (message is None) is (why is None)
    assert why is None or (message is not None and why in message)
    assert bool(answer.values) is bool((x or y) and why is None)
    assert answer.withheld_sentences() == ([f'Nothing for dynamics.bending_*: {message}.'] if why else [])
    assert answer.withheld_reason('torsion') is None


def test_the_surer_axis_is_the_one_that_the_rig_file_gets() -> None:
    less, more = mode(14.00000012, 0.0200000123, sd=2e-3), mode(14.01234567890, 0.0212345678, sd=1e-3)
    rounded = {'dynamics.bending_frequency': 14.012346, 'dynamics.bending_damping_ratio': 0.0212346}
    assert (of_axes((less,), (more,), ()).values, of_axes((more,), (less,), ()).values) == (rounded, rounded)
    # Sure is the share of the frequency.
    assert (
        of_axes((mode(14.0, sd=1.0e-3),), (mode(14.05, sd=1.002e-3),), ()).values['dynamics.bending_frequency'] == 14.05
    )
    twist = of_axes((), (), (mode(21.0), mode(3.0))).values
    assert twist == {'dynamics.torsion_frequency': 21.0, 'dynamics.torsion_damping_ratio': 0.02}


@pytest.mark.parametrize(('sd', 'name'), [(0.03, 'mzv'), (0.05, 'zvd')])
def test_the_shaper_suits_all_close_modes_and_their_scatter(sd: float, name: str) -> None:
    """It works from three standard deviations below the lowest to as far above the highest: for 0.69 or 0.75 Hz.

    MZV leaves at most 5 % to 0.71 Hz from 14 Hz.
    """
    modes = (mode(13.7), mode(13.4, sd=sd), mode(14.6, 0.05))
    answer = of_axes((*modes, mode(50.0, sd=1.0)), (mode(sd=0.3),), ())
    both = answer.shaper_of(0)
    middle = shaper(name, 14.0, 0.02)
    assert both is not None
    assert both.name == name
    assert both.times == pytest.approx(middle.times)
    assert both.sizes == pytest.approx(middle.sizes)
    assert answer.shaper_of(1) == shaper('zvd', 14.0, 0.02)
    assert answer.shaper_of(2) is None


def test_a_mode_in_words() -> None:
    x = Mode(14.0, 0.01, 0.02, 0.001, 12.34e-6)
    twist = Mode(21.0, 0.02, 0.03, 0.001, math.radians(0.0125))
    answer = of_axes((x, mode(40.0)), (), (twist,))
    words = ('14.000 ± 0.020', '0.0200 ± 0.0020', '12.3 µm', '1 ring-down')
    assert (answer.mode_words(0, x), answer.mode_words(2, twist)[2:]) == (words, ('12.5 mdeg', '1 ring-down'))
    assert of_axes((x,), (), (), stretches=2).mode_words(0, x)[3] == '2 ring-downs'
    assert of_axes((x,), (), (), stretches=0).mode_words(0, x)[3] == 'the spectrum in operation'
    best = answer.shaper_of(0)
    assert best is not None
    impulses = ', '.join(f'{s:.4f} at {1000.0 * t:.1f} ms' for s, t in zip(best.sizes, best.times, strict=True))
    lines = answer.sentences()
    assert lines[0] == f'ΔX: {words[0]} Hz, damping ratio {words[1]} (95 %), {words[2]}, from {words[3]}'
    assert lines[1].startswith('ΔX: 40.')
    assert lines[2] == f'ΔX: input shaper {best.name.upper()}: {impulses}'
    assert lines[3] == 'ΔY: no mode stands out of the noise. Knock on the link, or release a load.'
    y = dataclasses.replace(answer.axes[1], why='it moves')
    moving = dataclasses.replace(answer, axes=(answer.axes[0], y, answer.axes[2]))
    assert moving.sentences()[3] == 'ΔY: it moves. Knock on the link, or release a load.'
    assert moving.page_sentences()[1] == 'ΔY: it moves.'
    assert [moving.tree()['axes'][name]['why'] for name in ('dx', 'dy')] == ['', 'it moves']
    assert [line[:2] for line in lines[4:]] == ['θ:', 'θ:']
    rows = answer.rows()
    assert rows[0] == ['ΔX', *words, best.name.upper()]
    # The shaper stands beside the loudest mode only.
    assert [row[-1] == '' for row in rows] == [False, True, True, False]
    assert rows[2] == ['ΔY', 'none: knock on the link, or release a load', '', '', '', '']


def test_numbers_for_machines_are_in_si_units() -> None:
    x = Mode(14.0, 0.01, 0.02, 0.001, 12e-6)
    tree = of_axes((x,), (), (mode(21.0), mode(30.0)), stretches=2).tree()
    assert list(tree['axes']) == ['dx', 'dy', 'theta']
    dx = tree['axes']['dx']
    assert (dx['unit'], dx['how'], dx['noise'], tree['axes']['theta']['unit']) == ('m', 'ring-down', 1e-6, 'rad')
    np.testing.assert_allclose(dx['stretches'], [[0.1, 0.6], [1.1, 1.6]])
    best = recommended(14.0, 0.01, 0.02)
    assert dx['shaper'] == {'name': best.name, 'times': best.times, 'sizes': best.sizes}
    assert tree['axes']['dy']['shaper'] is None
    expected = {
        'frequency': 14.0,
        'frequency_sd': 0.01,
        'damping_ratio': 0.02,
        'damping_ratio_sd': 0.001,
        'amplitude': 12e-6,
    }
    assert (dx['modes'], len(tree['axes']['theta']['modes'])) == ([expected], 2)


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    """A recording for the answer to be of; its samples are not used."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:0.1']) == 0
    with pytest.warns(UserWarning, match='rig of the thesis'):
        return opened(path)


def made_of(source: Opened, *axes: tuple[Mode, ...]) -> Identified:
    nothing = np.full(3, np.nan)
    three = [AxisModes(modes, 'ring-down' if modes else 'none', ((0, 3),), nothing, 1e-6) for modes in axes]
    return Identified(IdentifyProblem(source, np.zeros((3, 3)), RATE), (three[0], three[1], three[2]))


def test_modes_known_well_reach_the_rig_file(source: Opened) -> None:
    answer = made_of(source, (mode(14.001, sd=1e-3),), (mode(14.0, 0.021),), (mode(21.0), mode(40.0)))
    assert answer.values == {
        'dynamics.bending_frequency': 14.0,
        'dynamics.bending_damping_ratio': 0.021,
        'dynamics.torsion_frequency': 21.0,
        'dynamics.torsion_damping_ratio': 0.02,
    }
    assert not any('Nothing for' in line for line in answer.lines())


def test_a_damping_ratio_that_may_be_anything_has_no_shaper(source: Opened) -> None:
    answer = made_of(source, (mode(14.0, 0.02, damping_sd=0.01),), (), ())
    assert answer.shaper_of(0) is None
    assert answer.tree()['axes']['dx']['shaper'] is None


def test_a_damping_ratio_of_nothing_is_no_answer(source: Opened) -> None:
    assert made_of(source, (mode(14.0, 0.0, damping_sd=0.0),), (), ()).values == {}
