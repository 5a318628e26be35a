# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording of loads and of a reference alone is searched as a table of what rests under each load."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.write.bag_writer import McapFile
from psd_deflection.records import AppliedLoad, FloatArray, ReferencePose, TemperatureReading
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.discover.from_recordings import read_tables
from psd_deflection.studies.discover.plant_search import discover_in
from psd_deflection.studies.discover.readings import ReadingsPlant

RIG = load_rig()
LOADS = np.array([(0, 0, 0), (0, -10, 0), (0, -30, 0), (20, 0, 0), (0, -50, -29), (0, -20, 10), (-20, 0, 0), (0, 0, 0)])
HELD, EVERY, START = 6.0, 0.05, 1_700_000_000_000_000_000
NOISE = np.array([2e-6, 2e-6, 5e-6])
LATE = (0.0, 1.2, 0.4, 2.5, 0.0, 1.9, -0.6, 0.8)
"""s by which each load was noted late."""


def measured(effects: Sequence[ActiveEffect]) -> tuple[FloatArray, FloatArray]:
    """Times (n,) s and poses (n, 3) of a camera that sees the tip ring after each load."""
    each = round(HELD * RIG.converter.sample_rate_hz)
    pose = ForwardModel(RIG, effects).expect(np.repeat(LOADS.astype(np.float64), each, axis=0)).pose.T
    step = round(EVERY * RIG.converter.sample_rate_hz)
    observed = pose[::step]
    noise = np.random.default_rng(1).normal(size=observed.shape) * NOISE
    return np.linspace(0.0, EVERY * (len(observed) - 1), len(observed)), np.asarray(observed + noise, dtype=np.float64)


def recorded(path: Path, effects: Sequence[ActiveEffect], loads: bool = True) -> Path:
    """A bag of that, with the loads as a person noted them."""
    t, poses = measured(effects)
    file = McapFile(path, rig_values=RIG.values)
    if loads:
        for i, (load, late) in enumerate(zip(LOADS.tolist(), LATE, strict=True)):
            # The page tells the load again and again.
            for again in (0.0, 1.0):
                file.put(AppliedLoad(START + round(1e9 * (i * HELD + late + again)), *map(float, load)))
    file.put(TemperatureReading(START, 21.5))
    for at, pose in zip(t.tolist(), poses.tolist(), strict=True):
        file.put(ReferencePose(START + round(1e9 * at), *pose))
    file.close()
    return path


SOFT = make_active('bending_stiffness', {'scale': -0.05}, 'test')


def test_reference_names_link_effect_with_late_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = recorded(tmp_path / 'camera.mcap', [SOFT])
    assert main(['discover', str(bag), '--out', str(tmp_path / 'found')]) == 0
    assert 'bending_stiffness' in capsys.readouterr().out
    found = json.loads((tmp_path / 'found' / 'result.json').read_text())
    (effect,) = found['effects']
    assert {effect['name'], *effect['equivalent']} == {'bending_stiffness', 'clamp_bending_compliance'}
    # Metres and radians are one gap, of what moves at the distance of the PSDs.
    assert found['gap']['unit'] == 'µm'
    of_each = [c['before'] for c in found['gap']['per_channel'].values()]
    distance = float(np.sqrt(np.mean(np.sum(RIG.centers**2, axis=1))))
    assert found['gap']['before'] == pytest.approx(float(np.sqrt(np.mean(np.multiply(of_each, (1, 1, distance)) ** 2))))
    repaired = load_rig(tmp_path / 'found' / 'model.yaml')
    assert discover_in(ReadingsPlant(read_tables([bag], repaired))).verdict == 'nothing_missing'


@pytest.mark.slow
def test_a_table_with_times_gives_the_same_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t, poses = measured([SOFT])
    annotated = np.searchsorted(HELD * np.arange(len(LOADS)) + np.array(LATE), t, side='right') - 1
    lines = [
        ','.join(map(repr, (at, *map(float, LOADS[i]), *pose)))
        for at, i, pose in zip(t.tolist(), annotated.tolist(), poses.tolist(), strict=True)
    ]
    lines[5] = lines[5].rsplit(',', 3)[0] + ',,,'
    path = tmp_path / 'camera.csv'
    path.write_text('\n'.join(('t,load_fx,load_fy,load_tz,ref_dx,ref_dy,ref_theta', *lines)) + '\n')
    (of_table,) = read_tables([path])
    (of_bag,) = read_tables([recorded(tmp_path / 'camera.mcap', [SOFT])])
    np.testing.assert_array_equal(of_table.loads, of_bag.loads)
    np.testing.assert_allclose(of_table.values, of_bag.values, rtol=0, atol=2e-6)
    assert main(['info', str(path)]) == 0
    assert '0 to 47.95 s: discover takes what rests under each load' in capsys.readouterr().out


def test_what_a_reference_alone_lacks_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match=r'camera\.mcap: holds references, but neither samples nor loads'):
        read_tables([recorded(tmp_path / 'camera.mcap', [], loads=False)])
    path = tmp_path / 'swept.csv'
    rows = ''.join(f'{0.1 * i},{float(i)},0,0,0,0,0\n' for i in range(20))
    path.write_text(f't,load_fx,load_fy,load_tz,ref_dx,ref_dy,ref_theta\n{rows}')
    with pytest.raises(RecordingError, match=r'swept\.csv: no load hung for as long as 3 references'):
        read_tables([path])
    path.write_text('t,load_fx,load_fy,load_tz,dx,dy,theta\n0,0,0,0,0,0,0\n')
    assert main(['discover', str(path), '--out', str(tmp_path / 'found')]) != 0
    assert 't,x1,y1,sum1,x2,y2,sum2' in capsys.readouterr().err
    bag = recorded(tmp_path / 'second.mcap', [])
    assert main(['discover', str(bag), '--out', str(tmp_path / 'found'), '--from', '2']) == 2
    assert '--from, --to: are for recordings of samples' in capsys.readouterr().err
