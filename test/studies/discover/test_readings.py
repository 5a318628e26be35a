# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of readings, a row for each load that hung; recordings of loads and a reference; rigs of three PSDs."""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.catalogue import make_active, with_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.recordings.read.references import is_table
from psd_deflection.recordings.write.bag_writer import McapFile
from psd_deflection.records import AppliedLoad, FloatArray, ReferencePose, TemperatureReading, dot_names
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import differences, fix_of, parameters
from psd_deflection.studies.discover import plant_search
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.noise import SlowNoise
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import CHANNELS, Plant, Readings, ReadingsPlant
from psd_deflection.studies.discover.readings import discovered, read_tables
from psd_deflection.studies.discover.redundant import fourth, fourth_reading
from psd_deflection.studies.discover.rehearsal import simulated_recordings
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring
from psd_deflection.studies.loads.plate_motion import across_of, across_plate, moved_plate

RIG = load_rig()
LOADS = np.array(
    [
        *((0, 0, 0), (0, -5, 0), (0, -10, 0), (0, -20, 0), (0, -30, 0), (0, -40, 0), (0, -10, -5.85)),
        *((0, -30, -17.55), (0, -50, -29.25), (20, 0, 0), (-20, 0, 0), (0, 0, 0)),
    ],
    dtype=np.float64,
)
NOISE = 1e-6
"""m or rad, of one reading."""


def read(
    effects: Sequence[ActiveEffect],
    kind: str = 'dots',
    length: float = RIG.link.length,
    seed: int = 0,
    loads: FloatArray = LOADS,
) -> Readings:
    """What a rig with ``effects`` shows."""
    rig = replace_values(RIG, {'link.length': length})
    table = Readings('table', rig, kind, loads, np.zeros((len(loads), len(CHANNELS[kind]))))
    values = 1e-6 * ReadingsPlant([table]).simulate_effects(effects)[0].T
    return Readings(table.name, rig, kind, loads, values + np.random.default_rng(seed).normal(0.0, NOISE, values.shape))


def written(path: Path, readings: FloatArray, header: str = 'x1_mm,y1_mm,x2_mm,y2_mm') -> Path:
    """A table of millimetres."""
    rows = [','.join(f'{v:.6g}' for v in (*load, *row)) for load, row in zip(LOADS, readings, strict=True)]
    path.write_text('\n'.join((f'load_fx,load_fy,load_tz,{header}', *rows)) + '\n')
    return path


SOFT = make_active('bending_stiffness', {'scale': -0.05}, 'test')
ROTATED = make_active('sensor_rotation', {'psd': 2, 'angle': 0.02}, 'test')


@pytest.mark.slow
def test_table_names_missing_effect_for_model_yaml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = written(tmp_path / 'hung.csv', 1e3 * read([SOFT]).values)
    assert main(['discover', str(table), '--out', str(tmp_path / 'found')]) == 0
    answer = capsys.readouterr()
    assert 'note: a table of readings holds no parameters: the rig of the thesis is taken; --params-file' in answer.err
    assert 'bending_stiffness' in answer.out
    tree = json.loads((tmp_path / 'found' / 'result.json').read_text())
    (effect,) = tree['effects']
    # One length of the link does not tell stiffness from the clamp.
    assert {effect['name'], *effect['equivalent']} == {'bending_stiffness', 'clamp_bending_compliance'}
    assert tree['gap']['heldout_after'] < 1.5 * 1e6 * NOISE < 10.0 < tree['gap']['before']
    repaired = load_rig(tmp_path / 'found' / 'model.yaml')
    assert discover_in(ReadingsPlant(read_tables([table], repaired))).verdict == 'nothing_missing'


@pytest.mark.slow
@pytest.mark.parametrize(('rows', 'y', 'seed'), [(8, 0.02, 9), (8, 0.02, 10), (10, -0.0125, 0), (10, -0.0125, 4)])
def test_of_a_short_table_one_effect_is_named_and_nothing_more(rows: int, y: float, seed: int) -> None:
    loads = LOADS[[0, 1, 2, 3, *([4, 5] if rows == 10 else []), 6, 7, 8, 11]]
    gain = make_active('sensor_gain', {'psd': 2, 'y': y}, 'test')
    discovery = discover_in(ReadingsPlant([read([gain], seed=seed, loads=loads)]))
    assert (discovery.verdict, [e.name for e in discovery.effects]) == ('effects_found', ['sensor_gain'])


@pytest.mark.slow
def test_one_effect_on_both_psds_is_simulated_for_both() -> None:
    gains = [make_active('sensor_gain', {'psd': psd, 'y': 0.01}, 'test') for psd in (1, 2)]
    plant = ReadingsPlant([read([])])
    (both,), (first,), (none,) = (plant.simulate_effects(e) for e in (gains, gains[:1], []))
    assert np.abs(both[3] - none[3]).max() > 10.0
    np.testing.assert_array_equal(first[3], none[3])
    (by_model,) = plant.simulate({'sensor_gain': gains[0].values})
    np.testing.assert_array_equal(by_model, first)


@pytest.mark.slow
def test_what_depends_on_time_or_on_the_row_before_takes_no_part() -> None:
    names = {e.name: e for e in ReadingsPlant([read([])], without=['refraction']).library}
    assert not {'creep', 'clamp_friction', 'amplifier_lag', 'channel_skew', 'laser_pointing_drift', 'refraction'} & set(
        names
    )
    assert {'bending_stiffness', 'sensor_gain', 'tip_force', 'thermal_drift'} <= set(names)
    assert len(list(names['bending_stiffness'].variants())) == 1


@pytest.mark.slow
def test_a_settled_reading_is_what_a_long_hold_ends_with() -> None:
    effects = [make_active('self_weight', {'weight_per_length': 20.0}, 'test'), SOFT]
    held = ForwardModel(RIG, effects).expect(np.tile(LOADS[8], (20_000, 1))).volts[:, -1]
    steady = ForwardModel(RIG, effects, steady=True).expect(LOADS[8:9]).volts[:, 0]
    np.testing.assert_allclose(steady, held, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_rows_of_one_load_are_left_out_together() -> None:
    (parts,) = ReadingsPlant([read([])]).parts()
    assert (parts[0], sorted(set(parts.tolist()))) == (parts[-1], list(range(8)))


@pytest.mark.slow
def test_the_rig_files_effects_are_in_the_model() -> None:
    rotated = {f'effects.turned.{k}': v for k, v in (('name', 'sensor_rotation'), ('psd', 2), ('angle', 0.02))}
    table = read([ROTATED])
    known = Readings(table.name, replace_values(RIG, rotated), 'dots', LOADS, table.values)
    plant = ReadingsPlant([known])
    assert [a.label for a in plant.known] == ['sensor_rotation (psd 2)']
    (rows,) = plant.simulate_effects([])
    assert np.std(rows - 1e6 * table.values.T) < 1.2e6 * NOISE


def test_a_mass_is_a_weight_and_an_arm_its_torque(tmp_path: Path) -> None:
    path = tmp_path / 'hung.csv'
    path.write_text(
        'mass,arm,x1,y1,x2,y2,temperature,by\n'
        '0,0,0,0,0,0,20,me\n1,0,0.1,,0.3,0.4,21,me\n2,0.5,0,1,0,1,22,me\n3,0.5,0,1,0,1,22,me\n'
    )
    message: list[str] = []
    (table,) = read_tables([path], warn=message.append)
    np.testing.assert_allclose(table.loads[2], (0.0, -2.0 * 9.80665, -9.80665))
    sensitivity = RIG.sensitivities.ravel()
    np.testing.assert_allclose(table.values[1], np.array([0.1, np.nan, 0.3, 0.4]) * sensitivity)
    assert table.temperature is not None
    assert table.temperature.tolist() == [20.0, 21.0, 22.0, 22.0]
    assert 'columns that are not read: by' in message[1]


@pytest.mark.slow
def test_a_table_has_the_wiring_of_the_rig(tmp_path: Path) -> None:
    readings = np.arange(4.0 * len(LOADS)).reshape(-1, 4)
    path = written(tmp_path / 'hung.csv', readings)
    (table,) = read_tables([path], replace_values(RIG, {'psds_exchanged': True}))
    np.testing.assert_allclose(table.values, 1e-3 * readings[:, [2, 3, 0, 1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('mass,x1,y1,x2\n1,1,1,1\n', r':1: the header lacks y2 beside the other readings'),
        ('mass,a\n1,1\n', r':1: the header has no readings; a table of readings has load_fx'),
        ('load_fx,x1,y1,x2,y2\n1,1,1,1,1\n', r':1: the header lacks load_fy, load_tz; it has load_fx,x1.*; a table'),
        ('mass,load_fx,x1,y1,x2,y2\n1,1,1,1,1,1\n', r':1: has mass and load_fx: only one'),
        ('mass,x1,y1,x2,y2,dx,dy,theta\n1,1,1,1,1,1,1,1\n', r':1: has x1,y1,x2,y2 and dx,dy,theta: leave one'),
        ('mass,mass,dx,dy,theta\n1,1,1,1,1\n', r':1: column mass is there twice'),
        ('mass,dx,dy,theta\n1,1,1\n', r':2: has 3 cells, the header has 4'),
        ('mass,dx,dy,theta\n1,1,1,1_0\n', r":2: column theta holds '1_0', which is not a number"),
        ('mass,dx,dy,theta\n,1,1,1\n', r":2: column mass holds '', which is not"),
        ('mass,dx,dy,theta\n1,1,1,inf\n', r":2: column theta holds 'inf', which is not"),
        ('mass,dx,dy,theta\n1,1,1,1\n2,,,\n', r'columns dx, dy, theta have less than 2 readings each'),
        ('mass,dx,dy,theta\n1,1,1,1\n2,1,1,1\n3,1,1,1\n', r'3 different loads: discover needs at least 4'),
        ('mass,dx,dy,theta\n', r'holds no row of readings'),
        ('mass,dx,dy,theta\n"1,1,1,1\n', r'is no row of a CSV'),
    ],
)
def test_a_table_that_lacks_something_says_what(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / 'hung.csv'
    path.write_text(text)
    with pytest.raises(RecordingError, match=rf'hung\.csv.*{words}' if words.startswith(':') else words):
        read_tables([path])


@pytest.mark.slow
def test_mixed_tables_and_recordings_are_rejected(tmp_path: Path) -> None:
    table = written(tmp_path / 'hung.csv', 1e3 * read([]).values)
    (tmp_path / 'list.yaml').write_text('- hung.csv\n- recording: run.csv\n')
    (tmp_path / 'run.csv').write_text('t,x1\n')
    with pytest.raises(RecordingError, match=r'run\.csv: is no table of readings, but others are'):
        read_tables([tmp_path / 'list.yaml'])
    (tmp_path / 'list.yaml').write_text('- recording: hung.csv\n  overrides: {link.length: -1.0}\n')
    with pytest.raises(ConfigError, match=r'list\.yaml: entry 1: link.length = -1'):
        read_tables([tmp_path / 'list.yaml'])
    assert is_table(table)
    assert not is_table(tmp_path / 'none.csv')
    assert not is_table(tmp_path / 'run.csv')


def test_tables_of_one_search_are_of_one_kind_and_as_many_psds() -> None:
    three = replace_values(RIG, {'psd_3.center': [0.08, -0.06]})
    with pytest.raises(RecordingError, match='one has x1,y1,x2,y2 and dx,dy,theta: search them one by one'):
        ReadingsPlant([read([]), Readings('b', RIG, 'estimates', LOADS, np.zeros((len(LOADS), 3)))])
    with pytest.raises(RecordingError, match='b: is of 3 PSDs, table of 2: search them one by one'):
        ReadingsPlant([read([]), Readings('b', three, 'dots', LOADS, np.zeros((len(LOADS), 6)))])


@pytest.mark.slow
def test_options_for_recordings_are_rejected_for_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = written(tmp_path / 'hung.csv', 1e3 * read([]).values)
    assert main(['discover', str(table), '--out', str(tmp_path / 'found'), '--next']) == 2
    assert '--next is for recordings of samples, not for readings of a link at rest' in capsys.readouterr().err
    assert main(['replay', str(table)]) != 0
    assert 'discover and info take a table of readings without times' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('rest', ['0', '', '0.0005'])
def test_a_gauge_is_searched_beside_constant_columns(tmp_path: Path, rest: str, axis: int) -> None:
    """Readings that are exactly as simulated are no measurement; nothing is held against them."""
    lines = ['load_fx,load_fy,load_tz,ref_dx,ref_dy,ref_theta']
    for mass in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6):
        load, cells = ['0'] * 3, ['0'] * 3
        load[axis], cells[axis], cells[axis - 1] = f'{-9.81 * mass}', f'{-31.6e-3 * min(mass, 1.2):.6f}', rest
        lines.append(','.join([*load, *cells]))
    (tmp_path / 'beam.csv').write_text('\n'.join(lines) + '\n')
    channel, reported = ('ref_dx', 'ref_dy', 'ref_theta')[axis], list[str]()
    discovery = discovered(read_tables([tmp_path / 'beam.csv']), (), None, reported.append, 0)
    assert [f'{channel} is the same in rows 7 to 9 under different loads' in words for words in reported] == [True]
    assert discovery.verdict in ('effects_found', 'unknown_effect')
    assert 0.0 < discovery.gap_before < 0.1 * 1e6
    assert [gaps[0] > 0.0 for gaps in discovery.per_channel.values()] == [
        i == axis or (rest > '0' and i == (axis - 1) % 3) for i in range(3)
    ]


TABLE_LOADS = np.array(
    [(0, 0, 0), (0, -10, 0), (0, -30, 0), (20, 0, 0), (0, -50, -29), (0, -20, 10), (-20, 0, 0), (0, 0, 0)]
)
HELD, EVERY, START = 6.0, 0.05, 1_700_000_000_000_000_000
REFERENCE_NOISE = np.array([2e-6, 2e-6, 5e-6])
LATE = (0.0, 1.2, 0.4, 2.5, 0.0, 1.9, -0.6, 0.8)
"""s by which each load was noted late."""


def measured(effects: Sequence[ActiveEffect]) -> tuple[FloatArray, FloatArray]:
    """Times (n,) s and poses (n, 3) of a camera that sees the tip ring after each load."""
    each = round(HELD * RIG.converter.sample_rate_hz)
    pose = ForwardModel(RIG, effects).expect(np.repeat(TABLE_LOADS.astype(np.float64), each, axis=0)).pose.T
    step = round(EVERY * RIG.converter.sample_rate_hz)
    observed = pose[::step]
    noise = np.random.default_rng(1).normal(size=observed.shape) * REFERENCE_NOISE
    return np.linspace(0.0, EVERY * (len(observed) - 1), len(observed)), np.asarray(observed + noise, dtype=np.float64)


def recorded(path: Path, effects: Sequence[ActiveEffect], loads: bool = True) -> Path:
    """A bag of that, with the loads as a person noted them."""
    t, poses = measured(effects)
    file = McapFile(path, rig_values=RIG.values)
    if loads:
        for i, (load, late) in enumerate(zip(TABLE_LOADS.tolist(), LATE, strict=True)):
            # The page tells the load again and again.
            for again in (0.0, 1.0):
                file.put(AppliedLoad(START + round(1e9 * (i * HELD + late + again)), *map(float, load)))
    file.put(TemperatureReading(START, 21.5))
    for at, pose in zip(t.tolist(), poses.tolist(), strict=True):
        file.put(ReferencePose(START + round(1e9 * at), *pose))
    file.close()
    return path


def test_reference_names_link_effect_with_late_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = recorded(tmp_path / 'camera.mcap', [SOFT])
    assert main(['discover', str(bag), '--out', str(tmp_path / 'found')]) == 0
    assert 'bending_stiffness' in capsys.readouterr().out
    tree = json.loads((tmp_path / 'found' / 'result.json').read_text())
    (effect,) = tree['effects']
    assert {effect['name'], *effect['equivalent']} == {'bending_stiffness', 'clamp_bending_compliance'}
    # Metres and radians are one gap, of what moves at the distance of the PSDs.
    assert tree['gap']['unit'] == 'µm'
    of_each = [c['before'] for c in tree['gap']['per_channel'].values()]
    distance = float(np.sqrt(np.mean(np.sum(RIG.centers**2, axis=1))))
    assert tree['gap']['before'] == pytest.approx(float(np.sqrt(np.mean(np.multiply(of_each, (1, 1, distance)) ** 2))))
    repaired = load_rig(tmp_path / 'found' / 'model.yaml')
    assert discover_in(ReadingsPlant(read_tables([bag], repaired))).verdict == 'nothing_missing'


@pytest.mark.slow
def test_a_table_with_times_gives_the_same_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t, poses = measured([SOFT])
    annotated = np.searchsorted(HELD * np.arange(len(TABLE_LOADS)) + np.array(LATE), t, side='right') - 1
    lines = [
        ','.join(map(repr, (at, *map(float, TABLE_LOADS[i]), *pose)))
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


TWO = load_rig()
THREE = load_rig(overrides={'psd_3.center': [0.080, -0.060]})
SIX = replace_values(
    THREE, {'psd_4.center': [0.060, 0.050], 'psd_5.center': [-0.060, -0.070], 'psd_6.center': [0.0, -0.090]}
)
LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, 0, 0), (15, -10, 4), (0, 0, 0), (0, -10, -6), (0, 0, 0)], float)
PUSHES = np.repeat(LEVELS, 1000, axis=0)


def make_observation(rig: Rig, *words: str, seed: int = 0, world: Mapping[str, object] | None = None) -> Observation:
    """What the device shows under ``LOADS`` of a rig with the effects of ``words``, which ``world`` has otherwise."""
    true = with_effects(replace_values(rig, world or {}), words, 'test')
    volts = RigSimulator(true, seed).step(PUSHES).counts * rig.converter.volts_per_count
    return Observation('x', rig, np.asarray(volts, dtype=np.float64), PUSHES)


@pytest.mark.parametrize(
    ('word', 'name', 'value'), [('sensor_rotation,psd=3,angle=0.01', 'angle', 0.01), ('load_offset,x=0.01', 'x', 0.01)]
)
def test_a_hidden_effect_is_named_with_its_psd(word: str, name: str, value: float) -> None:
    (effect,) = (discovery := discover([make_observation(THREE, word)])).effects
    wanted = dict(pair.split('=') for pair in word.split(',')[1:])
    assert effect.active.effect.name == word.split(',', maxsplit=1)[0]
    assert effect.active.values.get('psd', 0.0) == float(wanted.get('psd', 0.0))
    assert effect.active.values[name] == pytest.approx(value, abs=4.0 * effect.sd[name])
    assert (discovery.verdict, discovery.setup) == ('effects_found', ())
    assert list(discovery.per_channel) == list(dot_names(3))


def test_simulated_recordings_have_wiring_gaps_and_noise() -> None:
    world = {'psd_2.axes': ['-y', 'x'], 'amplifier.noise': 2.0 * TWO.amplifier.noise}
    o = make_observation(TWO, 'sensor_rotation,psd=2,angle=0.01', world=world)
    rig = replace_values(TWO, {'psd_1.axes': ['x', '-y']})
    given = dataclasses.replace(o, rig=rig, volts=Wiring.from_rig(rig).to_psds(o.volts))
    given.volts[2000:2300, 3] = np.nan
    (corrected,), _, _ = correct_wiring([given], ())
    ws = Workspace([corrected])
    fit = refit(ws, [make_active('sensor_rotation', {'psd': 2, 'angle': 0.0}, 'test')])
    effects = (SimpleNamespace(active=fit.effects[0]),)
    answer = SimpleNamespace(recordings=(given,), workspace=ws, known=(), fit=fit, effects=effects, late=())
    (first,), (second,) = (simulated_recordings(cast(Any, answer), seed) for seed in (1, 2))
    assert (first.rig, first.loads) == (given.rig, given.loads)
    for other in (given, second):
        np.testing.assert_array_equal(np.isnan(first.volts), np.isnan(other.volts))
        sd = np.nanstd(first.volts - other.volts, axis=0)
        assert sd == pytest.approx(math.sqrt(2.0) * ws.noise[0].sigma, rel=0.05)
    for corner, observed in ((0.01, False), (20.0, True)):
        noise = dataclasses.replace(ws.noise[0], slow=SlowNoise.of(np.full(6, corner), 10, 1e-3))
        answer.workspace = ws.replaced(noise=(noise,))
        assert np.array_equal(simulated_recordings(cast(Any, answer), 1)[0].volts, first.volts, True) is not observed


@pytest.mark.slow
def test_wrong_wiring_and_effect_of_six_psds_are_named() -> None:
    discovery = discover([make_observation(SIX, 'sensor_rotation,psd=5,angle=0.01', world={'psd_6.axes': ['-x', 'y']})])
    assert [(f.name, f.where) for f in discovery.setup] == [('channel_sign', 'x6')]
    assert [e.active.label for e in discovery.effects] == ['sensor_rotation (psd 5)']


def test_a_rig_without_the_psd_of_a_law_rejects_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'name: lifts\nacts_on: sum3\nterms:\n  - {form: product, of: [y4], coefficient: 100.0}\n'
    (tmp_path / 'lifts.yaml').write_text(text, encoding='utf-8')
    monkeypatch.setenv('PSD_DEFLECTION_EFFECTS', str(tmp_path))
    with pytest.raises(ConfigError, match='lifts is of a rig of 4 PSDs, this one has 3'):
        RigSimulator(with_effects(THREE, ['lifts,c1=100'], 'test'))
    # A search on a rig without that PSD does not look for it.
    assert discover([make_observation(THREE)]).verdict == 'nothing_missing'
    lit = RigSimulator(with_effects(SIX, ['lifts,c1=1e4'], 'test')).step(PUSHES).counts
    assert np.flatnonzero(np.any(lit != RigSimulator(SIX).step(PUSHES).counts, axis=0)).tolist() == [8]
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
    file = replace_values(THREE, {'psd_1.axes': ['y', '-x'], 'psd_3.axes': ['-x', 'y']})
    right = make_observation(file)
    read = dataclasses.replace(right, volts=Wiring.from_rig(file).to_psds(right.volts))
    assert correct_wiring([read], ())[1:] == ([], {})


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


@pytest.mark.parametrize(('rig', 'count'), [(TWO, 1), (THREE, 3), (SIX, 9)])
def test_rows_across_movement_count_redundant_readings(rig: Rig, count: int) -> None:
    psds, rows = len(rig.psds), across_of(rig)
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


@pytest.mark.parametrize('rig', [TWO, THREE, SIX])
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
    ws = Workspace([make_observation(THREE, word)])
    residual, _ = ws.residual([])
    reading = fourth_reading(ws, residual)
    assert (reading.values, reading.acquits) == (3 * ws.measured[0].shape[1], acquitted)


def test_recordings_of_one_search_are_of_as_many_psds() -> None:
    both = [make_observation(THREE), dataclasses.replace(make_observation(TWO), name='other')]
    with pytest.raises(RecordingError, match='other: is of 2 PSDs, the rig of the search has 3'):
        discover(both)
    with pytest.raises(RecordingError, match='x: is of 3 PSDs, the rig of the search has 2'):
        discover(both[:1], TWO)
    with pytest.raises(RecordingError, match=r'volts \(7000, 9\)'):
        Observation('x', SIX, make_observation(THREE).volts, PUSHES)


def test_terms_of_any_table_are_named_and_predict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, names = np.random.default_rng(3), ['az [deg]', 'force [N]', 'way']
    u = np.column_stack((rng.uniform(0.0, 360.0, 80), rng.uniform(10.0, 30.0, 80), rng.choice([-1.0, 1.0], 80)))
    u[:2, 1] = 10.0, 30.0
    y = 3.0 + 2.0 * np.sin(np.radians(u[:, 0])) - 1.5 * (0.1 * u[:, 1] - 2.0) ** 2 + 0.05 * rng.normal(size=80)
    rows = [
        ','.join([*map(str, values), '' if i == 7 else f'{v:.4f}', str(i // 4)])
        for i, (values, v) in enumerate(zip(u, y, strict=True))
    ]
    (tmp_path / 'a.csv').write_text('\n'.join([','.join([*names, 'd [mm]', 'day']), *rows[:60]]))
    # To predict, the inputs are enough.
    (tmp_path / 'b.csv').write_text('\n'.join([','.join(names), *(row.rsplit(',', 2)[0] for row in rows[60:])]))
    asked: dict[str, Any] = {'inputs': names, 'outputs': ['d [mm]'], 'parts': 'day', 'kinds': {'way': 'sign'}}
    discovery = psd_deflection.discover_in(tmp_path / 'a.csv', **asked)
    assert {e.active.effect.name for e in discovery.effects} == {'d: sin az', 'd: (force - 20)^2'}
    (predicted,) = discovery.predict(tmp_path / 'b.csv')
    assert np.sqrt(np.mean((predicted[0] - y[60:]) ** 2)) < 0.08
    words = ['--inputs', ','.join(names), '--outputs', 'd [mm]', '--parts', 'day', '--out', str(tmp_path / 'out')]
    # The search of the table, then one a rehearsal: the third ends all, or fails.
    ends, searches = iter((KeyboardInterrupt, ValueError)), itertools.count()

    def search(plant: Plant, **options: Any) -> PlantDiscovery:
        n = next(searches) % 4
        if n == 3:
            raise next(ends)
        return discovery if n else discover_in(plant, **options)

    monkeypatch.setattr(plant_search, 'discover_in', search)
    for counts in ((2, 0), (3, 1)):
        assert main(['discover', str(tmp_path / 'a.csv'), *words, '--rehearse', '3']) == 0
        assert 'd: sin az' in capsys.readouterr().out
        rehearsal = json.loads((tmp_path / 'out' / 'result.json').read_text())['rehearsal']
        assert (rehearsal['times'], rehearsal['failed'], rehearsal['again']) == (*counts, 2)
    monkeypatch.undo()
    options: dict[str, Any]
    for options, message in (
        ({'inputs': ['q']}, 'the header lacks q'),
        ({'kinds': {'way': 'up'}}, "way = 'up': must be"),
    ):
        with pytest.raises((ConfigError, RecordingError), match=message):
            psd_deflection.discover_in(tmp_path / 'a.csv', **{**asked, **options})
