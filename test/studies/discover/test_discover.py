# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover: names what was hidden, keeps silent where nothing was, and leaves files that work."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import psd_deflection
from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import effect_names, effects_of_rig, make_active
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.records import FloatArray, ParameterChange
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.declarations import DESCRIPTION
from psd_deflection.rig.parameter_files import read_parameter_file
from psd_deflection.studies.check.result import NAMES, Finding
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.screen import SignatureBank, solve_observable
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.study import described

SCHEMA = json.loads((Path(__file__).parents[2] / 'data' / 'result.schema.json').read_text())
SHARED_SCHEMA = Path(__file__).parents[4] / 'shared' / 'checks' / 'result.schema.json'
RIG = load_rig()
HISTORY = loads.identification()
WARM = 21.0 + 2.0 * np.sin(np.linspace(0.0, 5.0, len(HISTORY)))
BANK = SignatureBank()
NEAR = (
    *('bending_stiffness', 'clamp_bending_compliance', 'load_direction', 'tip_mass', 'damping', 'sensor_rotation'),
    *('axis_crosstalk', 'sensor_gain', 'plane_tilt', 'mains_interference', 'amplifier_lag', 'channel_skew'),
)
"""What might stand in for a turned sensor, a softer link or hum."""


def observe(rig: Rig, seed: int = 0, known: Rig = RIG, history: FloatArray = HISTORY.loads) -> Observation:
    counts = RigSimulator(rig, seed).step(history, WARM[: len(history)]).counts
    volts = counts.astype(np.float64) * rig.converter.volts_per_count
    return Observation('test', known, volts, history, WARM[: len(history)])


def with_effect(name: str, **values: object) -> Rig:
    return replace_values(RIG, {'effects.e.name': name, **{f'effects.e.{k}': v for k, v in values.items()}})


@pytest.fixture(scope='module')
def rotated() -> Discovery:
    return discover([observe(with_effect('sensor_rotation', psd=2, angle=0.002))], RIG, bank=BANK)


@pytest.mark.slow
def test_nothing_missing_is_the_answer_to_noise() -> None:
    found = discover([observe(RIG, seed=7)], RIG, bank=BANK)
    assert found.verdict == 'nothing_missing'
    assert found.effects == ()
    assert found.gap_after == pytest.approx(found.gap_floor, rel=0.05)
    assert found.sentence.startswith('Nothing is missing')


@pytest.mark.slow
def test_the_hidden_effect_is_named_with_its_size(rotated: Discovery) -> None:
    assert rotated.verdict == 'effects_found'
    (effect,) = rotated.effects
    assert effect.active.effect.name == 'sensor_rotation'
    assert effect.active.values['psd'] == 2
    assert abs(effect.active.values['angle'] - 0.002) < 4 * effect.sd['angle']
    assert effect.sd['angle'] < 2e-5
    assert rotated.gap_before > 4 * rotated.gap_after
    assert rotated.gap_heldout_after < 1.05 * rotated.gap_floor
    assert rotated.simulations < 2000


def test_where_is_the_turned_sensor(rotated: Discovery) -> None:
    assert {c.channel for c in rotated.where.cells[:5]} <= {'x2', 'y2'}
    assert rotated.where.cells[0].p < 1e-6
    assert 'dot_position' in rotated.where.cells[0].depends_on


def test_the_model_closes_the_gap_on_new_data(rotated: Discovery, tmp_path: Path) -> None:
    path = tmp_path / 'model.yaml'
    path.write_text(described(RIG, rotated.active_effects))
    model = load_rig(path)
    assert model.values == RIG.values
    assert [a.effect.name for a in effects_of_rig(model)] == ['sensor_rotation']
    observed = observe(with_effect('sensor_rotation', psd=2, angle=0.002), seed=9, known=model)
    again = discover([observed], model, without=[n for n in effect_names() if n not in NEAR])
    assert again.verdict == 'nothing_missing'


def check_schema(tree: dict[str, Any]) -> None:
    """The conditions on result.json; and that it is JSON without NaN."""
    jsonschema.validate(json.loads(json.dumps(tree, allow_nan=False)), SCHEMA)


@pytest.mark.slow
def test_result_keeps_to_the_contract_and_to_json(rotated: Discovery) -> None:
    tree = rotated.tree()
    check_schema(tree)
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree


@pytest.mark.slow
def test_a_parameter_stays_where_the_rig_lets_it() -> None:
    workspace = Workspace([observe(RIG)])
    ambient = make_active('ambient_light', {'psd': 2, 'level': 0.01, 'x': 0.4, 'y': 0.0}, 'test')
    fit = refit(workspace, [ambient], iterations=1)
    assert fit.effects[0].values['x'] <= 0.5 * RIG.psds[1].active_area[0]


@pytest.mark.slow
def test_directions_that_cannot_be_observed_are_left_alone() -> None:
    fisher = np.array([[1.0, 1.0], [1.0, 1.0]])
    gain, rank, c = solve_observable(fisher, np.array([2.0, 2.0]), np.diag(fisher))
    assert rank == 1
    assert gain == pytest.approx(4.0)
    np.testing.assert_allclose(c, [1.0, 1.0])


def simulate(tmp_path: Path, *words: str) -> Path:
    out = tmp_path / 'seen.csv'
    assert main(['simulate', '--out', str(out), *words]) == 0
    return out


def test_from_simulate_to_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = simulate(
        tmp_path, '--loads', 'thesis:1.5', '--effect', 'sensor_gain,psd=1,x=0.004,y=0.003', '--reference'
    )
    out = tmp_path / 'out'
    assert main(['discover', str(recorded), '--out', str(out), '--quiet']) == 0
    message = capsys.readouterr().out
    assert 'sensor_gain (psd 1) is missing' in message
    tree = json.loads((out / 'result.json').read_text())
    check_schema(tree)
    assert tree['provenance']['forward_simulations'] <= 2000
    page = (out / 'report.html').read_text()
    assert page.count('<figure class="chart"') == 3
    assert page.count('<svg class="matrix"') == 1
    model = out / 'model.yaml'
    # Without a file of the user it describes the rig, and not the machine that recorded.
    assert set(read_parameter_file(model)) == {*DESCRIPTION, *(k for k in load_rig(model).flat() if 'effects.' in k)}
    model.write_text('# The rig as of Monday.\n' + model.read_text())
    assert main(['discover', str(recorded), '--params-file', str(model), '--out', str(out), '--quiet']) == 0
    assert 'Nothing is missing' in capsys.readouterr().out
    assert model.read_text().startswith('# The rig as of Monday.\n')
    assert [a.effect.name for a in effects_of_rig(load_rig(model))] == ['sensor_gain']


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'wrong'), [('sensor_rotation,psd=1,angle=0.02', True), ('amplifier_lag,time_constant=2e-4', False)]
)
def test_estimate_error_is_change_by_model_in_replay(effect: str, wrong: bool, tmp_path: Path) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'a'), '--loads', 'thesis:1', '--effect', effect]) == 0
    found = psd_deflection.discover([tmp_path / 'a'])
    (tmp_path / 'model.yaml').write_text(found.model_yaml())
    without, corrected = (psd_deflection.replay(tmp_path / 'a', rig) for rig in (None, tmp_path / 'model.yaml'))
    changed = [float(np.abs(getattr(corrected, axis) - getattr(without, axis)).max()) for axis in ('dx', 'dy', 'theta')]
    # An estimate is of a moment; this is of the mean of a block, in which the link may swing.
    assert found.moves == pytest.approx(changed, rel=0.2, abs=1e-12)
    assert ('Without it an estimate is wrong by up to' in found.sentence) is wrong
    assert ('An estimate is not corrected for amplifier_lag.' in found.sentence) is not wrong


@pytest.mark.slow
def test_a_bag_reports_its_own_rig_but_not_what_was_hidden(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / 'short.yaml'
    short.write_text(described(replace_values(RIG, {'link.length': 0.4}), ()))
    words = ['--params-file', str(short), '--loads', 'thesis:1', '--effect', 'sensor_rotation,psd=1,angle=0.003']
    assert main(['simulate', '--out', str(tmp_path / 'run'), *words]) == 0
    assert main(['discover', str(tmp_path / 'run'), '--out', str(tmp_path / 'found'), '--quiet']) == 0
    assert 'sensor_rotation (psd 1) is missing' in capsys.readouterr().out
    assert load_rig(tmp_path / 'found' / 'model.yaml').link.length == 0.4
    found = psd_deflection.discover([tmp_path / 'run'], tmp_path / 'found' / 'model.yaml')
    assert found.verdict == 'nothing_missing'


@pytest.mark.slow
def test_a_zero_taken_while_it_ran_is_part_of_the_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'run'), '--loads', 'thesis:0.5']) == 0
    recording = open_recording(tmp_path / 'run')
    later = ParameterChange(0, 3, (('psd_2.zero', (1e-4, -2e-4)), ('environment.temperature', 22.0)))
    monkeypatch.setattr(recording, 'changes', [later])
    assert rig_at_end(recording).zeros.tolist() == [[0.0, 0.0], [1e-4, -2e-4]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ('listed', 'message'),
    [
        ('{}', 'must be a list'),
        ('- {rec: a.csv}', 'must have "recording: FILE"'),
        ('- {recording: seen.csv, overrides: 3}', 'must be a map'),
        ('- {recording: seen.csv, length: 3}', 'only recording and overrides'),
        ('- {recording: seen.csv, overrides: {link.lenght: 0.4}}', 'did you mean link.length'),
        ('- {recording: gone.csv}', 'no such recording'),
        ('- [', 'malformed YAML'),
    ],
)
def test_a_bad_list_is_rejected_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], listed: str, message: str
) -> None:
    simulate(tmp_path, '--loads', 'constant:0,0,0:1')
    path = tmp_path / 'list.yaml'
    path.write_text(listed)
    assert main(['discover', str(path), '--out', str(tmp_path / 'out'), '--quiet']) in (3, 4)
    assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--loads', 'thesis:0'], 'above 0'),
        (['--loads', 'constant:1,2:3'], 'must be 3 numbers'),
        (['--loads', 'chirp:1,0,0:1,900:3'], 'below 500 Hz'),
        (['--loads', 'up and down'], 'not a load history'),
        (['--effect', 'sensor_gain,psd'], 'not KEY=VALUE'),
        (['--effect', 'sensor_gian,psd=1'], 'did you mean sensor_gain'),
        (['--temperature', 'warm'], 'not a list of numbers'),
    ],
)
def test_bad_words_of_simulate_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'x.csv'), *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_recording_without_loads_is_rejected_with_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'bare.csv'
    rows = [f'{i / 1000:.3f},0,0,5,0,0,5' for i in range(200)]
    path.write_text('\n'.join(['t,x1,y1,sum1,x2,y2,sum2', *rows]) + '\n')
    assert main(['discover', str(path), '--out', str(tmp_path / 'out'), '--quiet']) == 4
    assert 'holds no loads' in capsys.readouterr().err


@pytest.mark.slow
def test_a_finding_has_a_name_that_other_programs_know() -> None:
    known = SCHEMA['properties']['setup']['items']['properties']['name']['enum']
    assert set(NAMES) <= set(known)
    with pytest.raises(ValueError, match='load_size: must be one of channel_sign'):
        Finding('load_size', 'load 3', None, '')


@pytest.mark.slow
@pytest.mark.skipif(not SHARED_SCHEMA.is_file(), reason='the schema is not beside the checkout')
def test_the_schema_is_that_of_other_programs() -> None:
    assert json.loads(SHARED_SCHEMA.read_text()) == SCHEMA
