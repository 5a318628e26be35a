# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A parameter that the recording does not determine stays off, and excludes no effect."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace

RIG = load_rig()


@pytest.mark.parametrize('sideways', [0.0, 3e-15, 1e-5])
def test_a_size_that_hardly_any_load_shows_stays_off(sideways: float) -> None:
    levels = [(0.0, 0.0, 0.0), *((sideways, -w, 0.0) for w in (20.0, 40.0, 10.0, 50.0, 30.0))]
    history = loads.steps(levels, 0.5).loads
    true = replace_values(RIG, {'effects.e.name': 'load_offset', 'effects.e.x': 0.005})
    volts = RigSimulator(true, 3).step(history).counts * RIG.converter.volts_per_count
    workspace = Workspace([Observation('x', RIG, np.asarray(volts, dtype=np.float64), history)], ())
    effect = catalogue()['load_offset']
    found = refit(workspace, [ActiveEffect(effect, {'x': 0.001, 'y': -1.0})])
    (offset,) = found.effects
    assert offset.values['x'] == pytest.approx(0.005, abs=1e-4)
    assert offset.values['y'] == 0.0
    assert not found.at_bound
