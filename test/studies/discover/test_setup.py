# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes of the set-up: each is named with its size and the line that puts it right, and nothing else is."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import effect_names
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation, read_observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.discover.cleaning import clean, outliers
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring, likely_delays, likely_jumps

RIG = load_rig()
PUSHES = [(0.0, -40.0, -15.0), (0.0, -40.0, 0.0), (25.0, 0.0, 0.0), (0.0, 15.0, 20.0)]
HISTORY = loads.steps([(0.0, 0.0, 0.0), *PUSHES, (0.0, 0.0, 0.0)], 1.0).loads


def recorded(seed: int = 0, **true: object) -> Observation:
    """A recording of a rig that differs by ``true`` from the rig file, which stays the nominal one."""
    rig = replace_values(RIG, {name.replace('__', '.'): value for name, value in true.items()})
    counts = RigSimulator(rig, seed).step(HISTORY).counts
    return Observation('seen', RIG, counts.astype(np.float64) * RIG.converter.volts_per_count, HISTORY.copy())


def changed(o: Observation, change: Callable[[FloatArray], FloatArray]) -> Observation:
    return dataclasses.replace(o, volts=change(o.volts.copy()))


def loaded(o: Observation, *factors: float) -> Observation:
    return dataclasses.replace(o, loads=o.loads * np.array(factors))


def rotated(*channels: int) -> Callable[[FloatArray], FloatArray]:
    signs = np.ones(6)
    signs[list(channels)] = -1.0
    return lambda volts: volts * signs


def ordered(*columns: int) -> Callable[[FloatArray], FloatArray]:
    return lambda volts: volts[:, list(columns)]


@pytest.mark.parametrize(
    ('mistake', 'named'),
    [
        (lambda o: o, []),
        (lambda o: changed(o, rotated(1)), [('channel_sign', 'y1', -1.0, 'psd_1.axes: [x, -y]')]),
        (lambda o: changed(o, rotated(3)), [('channel_sign', 'x2', -1.0, "psd_2.axes: [-x, 'y']")]),
        (lambda o: changed(o, ordered(1, 0, 2, 3, 4, 5)), [('axis_swap', 'psd_1', None, "psd_1.axes: ['y', x]")]),
        (lambda o: changed(o, ordered(3, 4, 5, 0, 1, 2)), [('psd_swap', 'psd_1 psd_2', None, 'psds_exchanged: true')]),
        (lambda o: loaded(o, 1.0, -1.0, 1.0), [('load_sign', 'fy', -1.0, 'turn the sign of load_fy in the recording')]),
        (lambda o: loaded(o, 1.0, 1.0, -1.0), [('load_sign', 'tz', -1.0, 'turn the sign of load_tz in the recording')]),
        (
            lambda o: loaded(o, 1 / 9.80665, 1 / 9.80665, 1.0),
            [
                (
                    'load_unit',
                    'fx fy',
                    9.80665,
                    'multiply load_fx load_fy in the recording by 9.80665: it is noted in kg instead of N',
                )
            ],
        ),
        (
            lambda o: loaded(o, 1.0, 1.0, 1e3),
            [
                (
                    'load_unit',
                    'tz',
                    1e-3,
                    'multiply load_tz in the recording by 0.001: it is noted in N mm instead of N m',
                )
            ],
        ),
    ],
)
def test_wiring_signs_and_units_are_put_right(
    mistake: Callable[[Observation], Observation], named: list[tuple[str, str, float | None, str]]
) -> None:
    o = recorded()
    wrong = mistake(o)
    (corrected,), findings, lines = correct_wiring([wrong], ())
    assert [(f.name, f.where, f.value, f.fix) for f in findings] == named
    np.testing.assert_array_equal(corrected.volts, o.volts)
    np.testing.assert_allclose(corrected.loads, o.loads, rtol=1e-9)
    # The lines alone wire the rig file right.
    assert replace_values(RIG, lines).values == corrected.rig.values


@pytest.mark.slow
def test_alike_units_differ_where_movement_is_nonlinear() -> None:
    """50 N at the end of a bar: what moves in proportion to the load is 1 % off, and the units are 2 % apart."""
    loads = np.repeat([(0, 0, 0), (0, -50, -29.25), (0, 0, 0)], 2000, axis=0).astype(np.float64)
    volts = np.asarray(RigSimulator(RIG, 1).step(loads).counts * RIG.converter.volts_per_count, dtype=np.float64)
    for factor in (9.80665e-3, 1e-2):
        annotated = np.asarray(loads / (1.0, 1.0, factor), dtype=np.float64)
        _, findings, _ = correct_wiring([Observation('x', RIG, volts, annotated)], ())
        assert [(f.where, f.value) for f in findings] == [('tz', factor)]


def test_a_soft_or_stiff_link_is_no_other_unit() -> None:
    for modulus in (6.9e11, 6.9e9, 7.2e10, 5e10):
        _, findings, _ = correct_wiring([recorded(link__youngs_modulus=modulus)], ())
        assert findings == []


NEAR = (
    *('load_direction', 'bending_stiffness', 'torsional_stiffness', 'damping', 'creep', 'sensor_rotation'),
    *('sensor_gain', 'sensor_position', 'amplifier_lag', 'channel_skew'),
)
"""What might stand in for a mistake of the set-up. The rest of the catalogue takes time and tells nothing more."""


def found_in(*observations: Observation, full: bool = False) -> Discovery:
    found = discover(observations, RIG, without=() if full else [n for n in effect_names() if n not in NEAR])
    tree = found.tree()
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree
    return found


@pytest.mark.slow
def test_a_setup_that_explains_all_leaves_nothing_missing() -> None:
    """A longer link makes EI and GJ look wrong by a cube and by itself: one length explains both."""
    found = found_in(recorded(link__length=0.585 * 1.02), full=True)
    assert (found.verdict, found.effects) == ('nothing_missing', ())
    (mistake,) = found.setup
    assert (mistake.name, mistake.where) == ('link_length', 'link.length')
    assert mistake.value == pytest.approx(1.02, abs=1e-4)
    assert mistake.fix.startswith('link.length: 0.596')
    assert found.floors < 1.05
    assert 'The set-up is not as' in found.sentence


def test_a_jump_is_found_at_its_sample() -> None:
    o = recorded()
    o.volts[2600:, 0] += 0.02
    workspace = Workspace([o])
    (recording, psd, time), *_ = likely_jumps(workspace, workspace.residual(())[0])
    assert (recording, psd) == (1, 1)
    assert time == pytest.approx(2.6, abs=0.004)
    assert likely_delays(workspace) == []


@pytest.mark.parametrize('share', [0.001, 0.05])
def test_outliers_are_excluded_and_movement_is_kept(share: float) -> None:
    o = recorded()
    rng = np.random.default_rng(3)
    bad = rng.random(o.volts.shape) < share
    volts = o.volts + np.where(bad, rng.choice((-1.0, 1.0), bad.shape) * rng.uniform(0.1, 5.0, bad.shape), 0.0)
    cleaned, findings = clean(dataclasses.replace(o, volts=volts), ())
    gone = np.isnan(cleaned.volts)
    assert findings == []
    assert np.mean(gone[bad]) > 0.999
    assert np.mean(gone[~bad]) < 1e-3
    # Neither a step of the load nor hum of a hundred times the noise.
    t = np.arange(len(o.volts))[:, None] / 1000.0
    assert not outliers(o.volts + 0.2 * np.sin(2.0 * np.pi * 50.0 * t), 5e-4).any()


def csv_of(o: Observation, path: Path, step: float, rows: Sequence[int] | None = None) -> Path:
    lines = ['t,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz']
    for i in range(len(o.volts)) if rows is None else rows:
        numbers = [i * step, *o.volts[i].tolist(), *o.loads[i].tolist()]
        lines.append(','.join(f'{v:.9g}' for v in numbers))
    path.write_text('\n'.join(lines) + '\n')
    return path


@pytest.mark.slow
def test_command_prints_lines_and_puts_them_in_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Y of PSD 1 turned, and times of 800 samples a second against the 1000 of the rig file."""
    rig = replace_values(RIG, {'converter.sample_rate_hz': 800.0})
    counts = RigSimulator(rig, 0).step(HISTORY).counts
    volts = counts.astype(np.float64) * RIG.converter.volts_per_count * np.array([1, -1, 1, 1, 1, 1])
    path = csv_of(Observation('seen', RIG, volts, HISTORY), tmp_path / 'seen.csv', 1.0 / 800.0)
    out = tmp_path / 'out'
    assert main(['discover', str(path), '--out', str(out), '--quiet']) == 0
    message = capsys.readouterr().out
    assert 'set-up: channel_sign y1: psd_1.axes: [x, -y]' in message
    assert 'set-up: sample_rate converter.sample_rate_hz: converter.sample_rate_hz: 800' in message
    model: Rig = load_rig(out / 'model.yaml')
    assert model.psds[0].axes == ('x', '-y')
    assert model.converter.sample_rate_hz == 800.0
    tree = json.loads((out / 'result.json').read_text())
    assert tree['verdict'] == 'nothing_missing'
    assert [s['name'] for s in tree['setup']] == ['sample_rate', 'channel_sign']
    assert clean(read_observation(path, model), ())[1] == []
    assert correct_wiring([read_observation(path, model)], ())[1] == []
