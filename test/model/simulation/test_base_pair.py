# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""PSDs at the base, lasers on the plate: simulated, recorded, replayed and solved; contradictions are rejected."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.measure.correction import Correction
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.plate import Geometry
from psd_deflection.model.simulation.physics import Physics, dots_on_plate
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.rig.config import load_rig
from test.oracles import RayPlane

pytestmark = pytest.mark.slow

BASE = {'psd_1.height': -0.585, 'psd_2.height': -0.485, 'solver': 'base_pair', 'solvers': ['base_pair']}


def test_the_simulated_dots_are_those_of_the_rays(rays: RayPlane) -> None:
    rig = load_rig(overrides=BASE)
    pose = np.array([1e-3, -2e-3, 0.015])
    physics = Physics.of(rig)
    found = dots_on_plate(pose[:, None], physics.beams.reshape(4, 1), physics)[:, 0]
    tilts = (1.5 * 2e-3 / 0.585, 1.5 * 1e-3 / 0.585)
    np.testing.assert_allclose(found, rays.base_dots(Geometry.from_rig(rig), (*pose, *tilts)), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ('assume', 'load', 'message'),
    [('beam', (3.0, -20.0, 4.0), {}), ('no_twist', (3.0, -20.0, 0.0), {'arrangement': 'base'})],
)
def test_it_is_simulated_recorded_replayed_and_solved(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    assume: str,
    load: tuple[float, float, float],
    message: dict[str, str],
) -> None:
    file, bag = tmp_path / 'rig.yaml', tmp_path / 'run'
    body = {**BASE, **message, 'base_pair.assume': assume}
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': body}}))
    words = ','.join(map(str, load))
    assert main(['simulate', '--params-file', str(file), '--loads', f'constant:{words}:12', '--out', str(bag)]) == 0
    assert main(['replay', str(bag), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    estimates = open_recording(bag).estimates()['/link_tip/deflection']
    rest = estimates.pose[-100:]
    truth = LinkStatics.from_rig(load_rig()).deflection(*load)
    assert (np.abs(rest.mean(axis=0) - truth) < [2e-6, 2e-6, 2e-5]).all()


CONTRADICTIONS = [
    ({'solvers': ['base_pair', 'exact']}, r'exact of solvers.*set solvers: \[base_pair\]'),
    ({'degraded': 'hold'}, 'set degraded: none'),
    ({'solver': 'exact', 'solvers': ['exact']}, 'psd_1.height = -0.585 m.*need arrangement: base, solver: base_pair'),
]


@pytest.mark.parametrize(('more', 'message'), CONTRADICTIONS)
def test_a_contradiction_is_rejected_and_not_simulated(more: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RigSimulator(load_rig(overrides={**BASE, **more}))


def test_moved_optics_of_base_psds_are_rejected() -> None:
    moved = {'effects.a.name': 'sensor_position', 'effects.a.psd': 1, 'effects.a.x': 1e-3}
    with pytest.raises(ConfigError, match='not corrected for PSDs at the base'):
        Correction.from_rig(load_rig(overrides={**BASE, **moved}))
    gain = {'effects.a.name': 'sensor_gain', 'effects.a.psd': 1, 'effects.a.x': 1e-3}
    assert Correction.from_rig(load_rig(overrides={**BASE, **gain})).active
