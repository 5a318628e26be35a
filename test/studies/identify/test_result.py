# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What of the modes reaches the rig file and the shaper."""

from __future__ import annotations

import numpy as np
import pytest

from blind.modes import RATE
from psd_deflection.cli.main import main
from psd_deflection.studies.identify.axis_modes import AxisModes, Mode
from psd_deflection.studies.identify.from_recordings import IdentifyProblem
from psd_deflection.studies.identify.result import Identified
from psd_deflection.studies.study import Opened, opened


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    """A recording for the answer to be of; its samples are not used."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:0.1']) == 0
    with pytest.warns(UserWarning, match='nominal rig'):
        return opened(path)


def found(source: Opened, *axes: tuple[Mode, ...]) -> Identified:
    nothing = np.full(3, np.nan)
    three = [AxisModes(modes, 'ring-down' if modes else 'none', ((0, 3),), nothing, 1e-6) for modes in axes]
    return Identified(IdentifyProblem(source, np.zeros((3, 3)), RATE), (three[0], three[1], three[2]))


def mode(frequency: float, damping: float = 0.02, *, sd: float = 1e-4, damping_sd: float = 1e-4) -> Mode:
    return Mode(frequency, sd, damping, damping_sd, 1e-3)


def test_modes_known_well_reach_the_rig_file(source: Opened) -> None:
    answer = found(source, (mode(14.001, sd=1e-3),), (mode(14.0, 0.021),), (mode(21.0), mode(40.0)))
    assert answer.values == {
        'dynamics.bending_frequency': 14.0,
        'dynamics.bending_damping_ratio': 0.021,
        'dynamics.torsion_frequency': 21.0,
        'dynamics.torsion_damping_ratio': 0.02,
    }
    assert not any('Nothing for' in line for line in answer.lines())


def test_a_damping_ratio_that_may_be_anything_has_no_shaper(source: Opened) -> None:
    answer = found(source, (mode(14.0, 0.02, damping_sd=0.01),), (), ())
    assert answer.shaper_of(0) is None
    assert answer.tree()['axes']['dx']['shaper'] is None


def test_a_damping_ratio_of_nothing_is_no_answer(source: Opened) -> None:
    assert found(source, (mode(14.0, 0.0, damping_sd=0.0),), (), ()).values == {}
