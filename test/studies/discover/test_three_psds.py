# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A search on rigs of three and more PSDs: what is hidden is named on the PSD that has it."""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.simulation.catalogue import make_active, with_effects
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import dot_names
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import WIRINGS, differences, fix_of, parameters, wirings_of
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.redundant import fourth, fourth_reading
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring
from psd_deflection.studies.loads.plate_motion import across_of, across_plate, moved_plate

TWO = load_rig()
RIG = load_rig(overrides={'psd_3.center': [0.080, -0.060]})
SIX = replace_values(
    RIG, {'psd_4.center': [0.060, 0.050], 'psd_5.center': [-0.060, -0.070], 'psd_6.center': [0.0, -0.090]}
)
LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, 0, 0), (15, -10, 4), (0, 0, 0), (0, -10, -6), (0, 0, 0)], float)
LOADS = np.repeat(LEVELS, 1000, axis=0)


def make_observation(rig: Rig, *words: str, seed: int = 0, world: Mapping[str, object] | None = None) -> Observation:
    """What the device shows under ``LOADS`` of a rig with the effects of ``words``, which ``world`` has otherwise."""
    true = with_effects(replace_values(rig, world or {}), words, 'test')
    volts = RigSimulator(true, seed).step(LOADS).counts * rig.converter.volts_per_count
    return Observation('x', rig, np.asarray(volts, dtype=np.float64), LOADS)


@pytest.mark.parametrize(
    ('word', 'name', 'value'), [('sensor_rotation,psd=3,angle=0.01', 'angle', 0.01), ('load_offset,x=0.01', 'x', 0.01)]
)
def test_a_hidden_effect_is_named_with_its_psd(word: str, name: str, value: float) -> None:
    (effect,) = (found := discover([make_observation(RIG, word)])).effects
    wanted = dict(pair.split('=') for pair in word.split(',')[1:])
    assert effect.active.effect.name == word.split(',', maxsplit=1)[0]
    assert effect.active.values.get('psd', 0.0) == float(wanted.get('psd', 0.0))
    assert effect.active.values[name] == pytest.approx(value, abs=4.0 * effect.sd[name])
    assert (found.verdict, found.setup) == ('effects_found', ())
    assert list(found.per_channel) == list(dot_names(3))


@pytest.mark.slow
def test_wrong_wiring_and_effect_of_six_psds_are_named() -> None:
    found = discover([make_observation(SIX, 'sensor_rotation,psd=5,angle=0.01', world={'psd_6.axes': ['-x', 'y']})])
    assert [(f.name, f.where) for f in found.setup] == [('channel_sign', 'x6')]
    assert [e.active.label for e in found.effects] == ['sensor_rotation (psd 5)']


def test_a_rig_without_the_psd_of_a_law_rejects_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'name: lifts\nacts_on: sum3\nterms:\n  - {form: product, of: [y4], coefficient: 100.0}\n'
    (tmp_path / 'lifts.yaml').write_text(text, encoding='utf-8')
    monkeypatch.setenv('PSD_DEFLECTION_EFFECTS', str(tmp_path))
    with pytest.raises(ConfigError, match='lifts is of a rig of 4 PSDs, this one has 3'):
        RigSimulator(with_effects(RIG, ['lifts,c1=100'], 'test'))
    # A search on a rig without that PSD does not look for it.
    assert discover([make_observation(RIG)]).verdict == 'nothing_missing'
    lit = RigSimulator(with_effects(SIX, ['lifts,c1=1e4'], 'test')).step(LOADS).counts
    dark = RigSimulator(SIX).step(LOADS).counts
    assert np.flatnonzero(np.any(lit != dark, axis=0)).tolist() == [8]
    assert make_active('lifts', {'c1': 1.0}, 'test').effect.least_psds == 4


def test_a_crossed_wiring_goes_to_the_device_and_back() -> None:
    wiring = Wiring(True, (('x', 'y'), ('-y', 'x'), ('x', '-y'), ('x', 'y')), (2, 4))
    assert [wiring.input_of(psd) for psd in (1, 2, 3, 4)] == [2, 4, 3, 1]
    volts = np.arange(24.0).reshape(2, 12)
    device = wiring.to_device(volts)
    assert wiring.to_psds(device) == pytest.approx(volts)
    # x of PSD 2 is minus y of input 4.
    assert device[:, 10] == pytest.approx(-volts[:, 3])
    assert not Wiring(crossed=(1, 3), axes=(('x', 'y'),) * 3).nominal


def test_a_wiring_as_the_rig_file_says_it_is_no_finding() -> None:
    file = replace_values(RIG, {'psd_1.axes': ['y', '-x'], 'psd_3.axes': ['-x', 'y']})
    right = make_observation(file)
    read = dataclasses.replace(right, volts=Wiring.from_rig(file).to_psds(right.volts))
    assert correct_wiring([read], ())[1:] == ([], {})


def test_wirings_have_two_wrong_psds_or_all_alike() -> None:
    nominal = Wiring(axes=(('x', 'y'),) * 3)
    each = [wiring.axes[0] for wiring in WIRINGS[:64:8]]
    all_of_three = set(itertools.product(each, repeat=3))
    few = {a for a in all_of_three if sum(axes != ('x', 'y') for axes in a) <= 2 or len(set(a)) == 1}
    tried = wirings_of(nominal)
    assert len(tried) == len(set(tried)) == 4 * len(few)
    for swap in ((False, ()), (True, ()), (False, (1, 3)), (False, (2, 3))):
        assert {w.axes for w in tried if (w.exchanged, w.crossed) == swap} == few
    assert tried[0] == nominal
    assert wirings_of(Wiring()) is WIRINGS


def test_what_is_wired_otherwise_is_reported_of_any_psd() -> None:
    file = Wiring(axes=(('x', 'y'),) * 4)
    wired = Wiring(True, (('x', 'y'), ('x', 'y'), ('x', 'y'), ('-y', 'x')))
    wrong = differences(wired, file)
    assert [(d.name, d.where) for d in wrong] == [
        *(('psd_swap', 'psd_1 psd_2'), ('axis_swap', 'psd_4'), ('channel_sign', 'y4'))
    ]
    lines = parameters(wired, file)
    assert lines == {'psds_exchanged': True, 'psd_4.axes': ['-y', 'x']}
    assert [fix_of(d, wired, lines) for d in wrong] == ['psds_exchanged: true', *['psd_4.axes: [-y, x]'] * 2]


@pytest.mark.parametrize(('rig', 'count'), [(TWO, 1), (RIG, 3), (SIX, 9)])
def test_rows_across_movement_count_redundant_readings(rig: Rig, count: int) -> None:
    psds = len(rig.psds)
    rows = across_of(rig)
    assert rows.shape == (count, 2 * psds)
    assert rows @ rows.T == pytest.approx(np.eye(count), abs=1e-12)
    # x = -X + ly theta, y = -Y - lx theta.
    places = rig.centers + rig.zeros
    plate = np.zeros((2 * psds, 3))
    plate[0::2, 0] = plate[1::2, 1] = -1.0
    plate[0::2, 2], plate[1::2, 2] = places[:, 1], -places[:, 0]
    pose = np.array([[1e-4, 0.0], [-2e-4, 1e-5], [0.0, 3e-4]])
    volts = np.full((3 * psds, 2), 5.0)
    volts[[c for c in range(3 * psds) if c % 3 != 2]] = (plate @ pose) / rig.sensitivities.reshape(-1, 1)
    assert moved_plate(rig, volts, np.ones_like(volts)) == pytest.approx(pose, abs=1e-12)
    assert across_plate(rig, volts) == pytest.approx(np.zeros((count, 2)), abs=1e-12)
    volts[3 * psds - 3] += 1.0
    assert np.linalg.norm(across_plate(rig, volts), axis=0) == pytest.approx(
        np.linalg.norm(rows[:, -2]) * rig.sensitivities[-1, 0]
    )


@pytest.mark.parametrize('rig', [TWO, RIG, SIX])
def test_redundant_readings_have_unit_covariance(rig: Rig) -> None:
    """Also if the noise of the detectors and their sensitivities differ."""
    other = {'psd_2.noise': [3e-3, 1e-3], 'psd_2.sensitivity': [1e-3, 2e-3], 'psd_1.sensitivity': [4e-4, 7e-4]}
    ws = Workspace([make_observation(replace_values(rig, other))])
    readings, blocks = 2 * len(rig.psds), ws.measured[0].shape[1]
    # The combinations themselves: every reading alone, one after the other.
    each = np.zeros((readings, ws.measured[0].size))
    for k, row in enumerate(ws.rows):
        each[k, row * blocks] = 1.0
    basis = fourth(ws, each).reshape(readings, -1, blocks)[:, :, 0]
    assert basis.shape == (readings, readings - 3)
    assert basis.T @ basis == pytest.approx(np.eye(readings - 3), abs=1e-9)
    # And what noise makes of them.
    white = np.random.default_rng(0).standard_normal((1, ws.measured[0].size))
    observed = fourth(ws, white)[0].reshape(readings - 3, blocks)
    assert observed @ observed.T / blocks == pytest.approx(np.eye(readings - 3), abs=5.0 * (2.0 / blocks) ** 0.5)
    # A movement of the plate is none of them.
    moved = ws.simulate([make_active('load_offset', {'x': 0.01}, 'test')])
    change = ws.whiten([a - b for a, b in zip(moved, ws.simulate([]), strict=True)])
    assert np.abs(fourth(ws, change[None, :])).max() < 1e-2 * np.abs(change).max()


@pytest.mark.parametrize(
    ('word', 'acquitted'),
    [
        ('tip_mass,mass=0.3', True),
        ('bending_stiffness,scale=-0.01', True),
        ('sensor_rotation,psd=3,angle=0.01', False),
        ('sensor_gain,psd=1,y=0.01', False),
    ],
)
def test_redundant_readings_acquit_detectors(word: str, acquitted: bool) -> None:
    ws = Workspace([make_observation(RIG, word)])
    residual, _ = ws.residual([])
    reading = fourth_reading(ws, residual)
    assert reading.values == 3 * ws.measured[0].shape[1]
    assert reading.acquits == acquitted


def test_recordings_of_one_search_are_of_as_many_psds() -> None:
    both = [make_observation(RIG), dataclasses.replace(make_observation(TWO), name='other')]
    with pytest.raises(RecordingError, match='other: is of 2 PSDs, the rig of the search has 3'):
        discover(both)
    with pytest.raises(RecordingError, match='x: is of 3 PSDs, the rig of the search has 2'):
        discover(both[:1], TWO)


def test_volts_of_wrong_number_of_psds_are_rejected() -> None:
    with pytest.raises(RecordingError, match=r'volts \(7000, 9\)'):
        Observation('x', SIX, make_observation(RIG).volts, LOADS)
