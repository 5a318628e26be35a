# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The functions at the top of the package, and the tables that they give."""

import copy
import html
import importlib.util
import json
import pickle
import pydoc
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection import plants
from psd_deflection.base.errors import ConfigError, PsdDeflectionError, RecordingError, SolverError
from psd_deflection.cli.main import main
from psd_deflection.studies.discover.report import Discovery
from tools.program import ROOT

CLEAN = ROOT / 'bags' / 'clean'


def test_the_import_is_fast_and_brings_nothing_along() -> None:
    code = 'import json, sys, psd_deflection; print(json.dumps(sorted(sys.modules)))'
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        env={'PYTHONPATH': str(ROOT)},
    )
    loaded = json.loads(done.stdout)
    assert {name.partition('.')[0] for name in loaded}.isdisjoint(
        {'numpy', 'scipy', 'pandas', 'xarray', 'yaml', 'mcap'}
    )
    assert [name for name in loaded if name.startswith('psd_deflection')] == ['psd_deflection']


def test_a_machine_of_a_user_is_made_of_one_module() -> None:
    assert plants.__all__ == ['Effect', 'EffectParameter', 'Model', 'Plant', 'plant_effect']
    imported = re.findall(r'^from psd_deflection\S* import .*', (ROOT / 'docs/discover.md').read_text(), re.M)
    assert imported == ['from psd_deflection.plants import EffectParameter, Plant, plant_effect']


def test_help_teaches() -> None:
    text = pydoc.plain(pydoc.render_doc(psd_deflection))
    assert sorted(psd_deflection.__all__) == [
        *('budget', 'calibrate', 'check', 'discover', 'discover_in', 'identify', 'load_rig', 'open', 'replay'),
        *('simulate', 'solve', 'validate', 'watch'),
    ]
    for name in psd_deflection.__all__:
        assert f'\n    {name}(' in text
        assert f'.{name}(' in text.partition('FUNCTIONS')[0]
    assert 'TYPE_CHECKING' not in text


def test_a_rig_by_names_and_maps() -> None:
    rig = psd_deflection.load_rig(block_size=10, link={'length': 0.4}, **{'psd_1.center': [0.0, 0.08]})
    assert (rig.estimator.block_size, rig.link.length, rig.psds[0].center) == (10, 0.4, (0.0, 0.08))
    assert repr(rig) == '<Rig link.length = 0.4 m, psd_1.center = [0.0, 0.08] m, block_size = 10 samples>'
    assert '<td style="text-align:left">0.4 m</td>' in rig._repr_html_()
    assert repr(psd_deflection.load_rig()) == '<Rig of the thesis>'


def test_a_replay_with_another_rig_and_blocks() -> None:
    rig = psd_deflection.load_rig(block_size=40)
    assert len(psd_deflection.replay(str(CLEAN), rig)) == 100
    assert len(psd_deflection.replay(psd_deflection.open(CLEAN), rig, solver='wls')) == 100


def test_the_nominal_rig_is_a_warning(tmp_path: Path) -> None:
    rows = '\n'.join(f'{i / 1000:.3f},0,0,5,0,0,5' for i in range(40))
    path = tmp_path / 'run.csv'
    path.write_text(f't,x1,y1,sum1,x2,y2,sum2\n{rows}\n')
    with pytest.warns(UserWarning, match=r'run\.csv: a CSV holds no parameters: the rig of the thesis'):
        assert len(psd_deflection.replay(path)) == 2
    assert len(psd_deflection.replay(path, psd_deflection.load_rig())) == 2


def test_dots_of_one_block_and_of_many() -> None:
    rig = psd_deflection.load_rig(link={'length': 0.4})
    rng = np.random.default_rng(3)
    many = rng.uniform(-2e-3, 2e-3, (5, 4))
    for name in ('exact', 'wls', 'beam'):
        solved = psd_deflection.solve(many, rig, name)
        assert solved.pose.shape == (5, 3)
        single = psd_deflection.solve(many[2].tolist(), rig, name)
        assert [getattr(single, f).shape for f in ('pose', 'tilt', 'covariance', 'residual', 'status')] == [
            (3,), (2,), (3, 3), (4,), (),
        ]  # fmt: skip
        assert np.array_equal(single.pose, solved.pose[2])
    # A pure translation moves both dots alike, the other way.
    assert psd_deflection.solve([-1e-3, 2e-3, -1e-3, 2e-3], solver='ols').pose == pytest.approx([1e-3, -2e-3, 0.0])


def test_a_simulated_recording_is_a_recording() -> None:
    rig = psd_deflection.load_rig(**{'amplifier.noise': 1e-6, 'converter.bits': 24})
    run = psd_deflection.simulate(rig, [(0.0, 0.0, 0.0), (0.0, -10.0, -5.85)], seconds=1.5, temperature=[20.0, 21.0])
    assert run.samples.shape == (3000,)
    assert [(load.t_ns, load.fy) for load in run.loads()] == [(0, 0.0), (1_500_000_000, -10.0)]
    assert (run.temperatures()[-1].celsius, run.topics()['/psd/samples']) == (21.0, 150)
    estimates = psd_deflection.replay(run)
    truth = np.stack([np.interp(estimates.t, run.samples['t'], run.pose[:, i]) for i in range(3)], axis=1)
    # The flat plate of the simulation is what the method assumes; the rest is the step inside a block.
    steady = np.abs(estimates.t - 1.5) > 0.05
    assert np.abs(estimates.pose - truth)[steady].max() < 1e-5
    first, again, other = (psd_deflection.simulate(rig, 'thesis:0.5', seed=seed).samples['y1'] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_hidden_effects_are_not_named(tmp_path: Path) -> None:
    rig_file = tmp_path / 'rig.yaml'
    rig_file.write_text('/**:\n  ros__parameters:\n    effects:\n      sensor_gain: {psd: 1, x: 0.01}\n')
    load = (0.0, -30.0, -17.0)
    as_map = psd_deflection.simulate(rig_file, load, {'sensor_gain': {'psd': 2, 'y': 0.037}}, seconds=0.1, seed=4)
    as_words = psd_deflection.simulate(rig_file, load, 'sensor_gain,psd=2,y=0.037', seconds=0.1, seed=4)
    assert np.array_equal(as_map.samples['y2'], as_words.samples['y2'])
    assert not np.array_equal(
        as_map.samples['y2'], psd_deflection.simulate(rig_file, load, seconds=0.1, seed=4).samples['y2']
    )
    assert set(as_map.known.effects) == {'sensor_gain.psd', 'sensor_gain.x'}
    assert 0.037 not in as_map.parameters.values()


def test_discover_takes_what_simulate_gives() -> None:
    run = psd_deflection.simulate(
        None,
        [(0, 0, 0), (0, -50, -29), (0, -50, 0), (30, 0, 0), (0, 0, 0)],
        seconds=0.6,
        effects='sensor_gain,psd=1,y=0.02',
    )
    discovery = psd_deflection.discover([run])
    assert isinstance(discovery, Discovery)
    assert [e.active.effect.name for e in discovery.effects] == ['sensor_gain']
    assert repr(discovery).startswith('<Discovery effects_found: sensor_gain (psd 1); gap ')


@pytest.mark.parametrize(
    ('kind', 'message', 'call'),
    [
        (ConfigError, 'override: link.lenght = 1: no parameter of that name; did you mean link.length?',
         lambda: psd_deflection.load_rig(link={'lenght': 1})),
        (ConfigError, 'override: block_size = 0 samples: must be at least 1 and at most 1000',
         lambda: psd_deflection.load_rig(block_size=0)),
        (RecordingError, 'nowhere: no such recording', lambda: psd_deflection.replay('nowhere')),
        (ConfigError, 'nowhere.yaml: no such parameter file', lambda: psd_deflection.solve([0] * 4, 'nowhere.yaml')),
        (ConfigError, 'dots: has the shape (2,): must be (4,) or (n, 4): x1, y1, x2, y2 in m',
         lambda: psd_deflection.solve([1, 2])),
        (ConfigError, 'dots[1, 3] = nan m: must be finite',
         lambda: psd_deflection.solve([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, float('nan')]])),
        (ConfigError, 'dots: must be numbers, (4,) or (n, 4)', lambda: psd_deflection.solve(['a', 'b', 'c', 'd'])),
        (ConfigError, 'did you mean exact?', lambda: psd_deflection.solve([0] * 4, solver='exakt')),
        (SolverError, 'coincide', lambda: psd_deflection.solve(
            [0] * 4, psd_deflection.load_rig(**{'psd_1.center': [0, 0], 'psd_2.center': [0, 0]}))),
        (ConfigError, 'loads: has the shape (2,): must be (3,) or (n, 3): N, N, N m',
         lambda: psd_deflection.simulate(None, (1, 2), seconds=1)),
        (ConfigError, 'loads[1] = [0.0, inf, 0.0]: must be finite',
         lambda: psd_deflection.simulate(None, [(0, 0, 0), (0, float('inf'), 0)], seconds=1)),
        (ConfigError, 'loads: 1 samples at 1000 Hz: must be at least 2; give seconds',
         lambda: psd_deflection.simulate(None, (1, 2, 3))),
        (ConfigError, 'seconds = -1 s: must be above 0 and at most 86400',
         lambda: psd_deflection.simulate(None, (1, 2, 3), seconds=-1)),
        (ConfigError, "seconds = 1 s: loads = 'thesis' says how long they last",
         lambda: psd_deflection.simulate(None, 'thesis', seconds=1)),
        (ConfigError, "temperature = 'warm': must be numbers",
         lambda: psd_deflection.simulate(None, (1, 2, 3), seconds=1, temperature='warm')),
        (ConfigError, 'seed = -1: must be a whole number of at least 0',
         lambda: psd_deflection.simulate(None, (1, 2, 3), seconds=1, seed=-1)),
        (ConfigError, 'effects.effect_0: creep is off without amplitude',
         lambda: psd_deflection.simulate(None, (1, 2, 3), ['creep'], seconds=1)),
        (ConfigError, 'effects.creep: amplitud = 3: creep has the parameters amplitude, time_constant',
         lambda: psd_deflection.simulate(None, (1, 2, 3), {'creep': {'amplitud': 3}}, seconds=1)),
        (ConfigError, 'effects = [3]: must be',
         lambda: psd_deflection.simulate(None, (1, 2, 3), [3], seconds=1)),  # type: ignore[list-item]
    ],
)  # fmt: skip
def test_errors_name_argument_value_and_bound(
    kind: type[PsdDeflectionError], message: str, call: Callable[[], object]
) -> None:
    with pytest.raises(kind) as caught:
        call()
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


needs_tables = pytest.mark.skipif(
    importlib.util.find_spec('xarray') is None, reason="needs pip install 'psd_deflection[pandas]'"
)


@needs_tables
def test_samples_as_tables_with_units(tmp_path: Path) -> None:
    path = tmp_path / 'run.csv'
    rows = [f'{i / 1000:.3f},{i},0,5,0,0,5,,,,,,' for i in range(6)]
    rows[2] = '0.002,2,0,5,0,0,5,1,-2,0.5,,,'
    rows[3] = '0.003,3,0,5,0,0,5,1,-2,0.5,1e-3,2e-3,3e-3'
    header = 't,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz,ref_dx,ref_dy,ref_theta'
    path.write_text('\n'.join([header, *rows]) + '\n')
    recording = psd_deflection.open(path)
    frame = recording.to_pandas()
    assert frame.index.name == 't'
    assert frame.index[3] == pytest.approx(0.003)
    assert list(frame['x1']) == [0, 1, 2, 3, 4, 5]
    # Before the first load it is not known; after it, it is held. A reference holds at its row only.
    assert np.isnan(frame['load_fy'].iloc[:2]).all()
    assert (list(frame['load_fy'].iloc[2:]), np.flatnonzero(frame['ref_dy'].notna()).tolist()) == ([-2.0] * 4, [3])
    assert 'temperature' not in frame
    units = frame.attrs['units']
    assert (units['t'], units['x1'], units['load_tz'], units['ref_theta']) == ('s', 'V', 'N m', 'rad')
    data = recording.to_xarray()
    assert data['load_fx'].attrs['units'] == 'N'
    assert data['x1'].dims == ('t',)
    assert data['t'].attrs == {'units': 's', 'long_name': 'time from the first sample'}
    assert np.array_equal(data['ref_dx'].to_numpy(), frame['ref_dx'].to_numpy(), equal_nan=True)


@needs_tables
def test_estimates_as_tables_with_units() -> None:
    estimates = psd_deflection.replay(CLEAN)
    frame, data = estimates.to_pandas(), estimates.to_xarray()
    assert frame.attrs['units']['sd_theta'] == data['sd_theta'].attrs['units'] == 'rad'
    assert np.array_equal(frame['dy'], estimates.dy)
    assert estimates.wrench is not None
    assert np.array_equal(data['fy'], estimates.wrench[:, 1])
    recorded = psd_deflection.open(CLEAN).estimates()['/link_tip/deflection']
    assert recorded.sd is None
    assert 'sd_dx' not in recorded.to_pandas()


def test_recordings_say_what_they_are() -> None:
    recording = psd_deflection.open(CLEAN)
    assert repr(recording) == f'<BagRecording {CLEAN}: device GOLDEN, parameters {len(recording.parameters)}>'
    assert len(recording.samples) == 4000
    assert 'samples 4000, duration 4.000 s' in repr(recording)
    html: Any = recording._repr_html_()
    assert '<th style="text-align:left">/psd/samples</th><td style="text-align:left">200</td>' in html
    recording.hello = {'serial': '<script>\x1b[2J'}
    assert '<script>' not in recording._repr_html_()
    assert '\x1b' not in repr(recording)
    assert 'ΔY' in psd_deflection.replay(CLEAN)._repr_html_()


def test_a_damaged_recording_can_be_shown(tmp_path: Path) -> None:
    path = tmp_path / 'run.csv'
    path.write_text('t,x1,y1,sum1,x2,y2,sum2\n0.0,0,0,5,0,abc,5\n0.001,0,0,5,0,0,5\n')
    recording = psd_deflection.open(path)
    assert 'cannot be read' in recording._repr_html_()
    assert 'CsvRecording' in repr(recording)


def pushed(seed: int = 2) -> Any:
    """Rest, a push along X, one along Y, a turn; each held for 2 s."""
    loads = [(0, 0, 0), (8, 0, 0), (0, 0, 0), (0, -8, 0), (0, 0, 0), (0, 0, 2), (0, 0, 0)]
    return psd_deflection.simulate(None, loads, seconds=2, seed=seed)


def test_every_study_can_be_asked_from_python(tmp_path: Path) -> None:
    run = pushed()
    answers = {
        'check.json': psd_deflection.check(run),
        'identify.json': psd_deflection.identify(run),
        'calibration.json': psd_deflection.calibrate([run]),
        'budget.json': psd_deflection.budget(load=(0.0, -10.0, 0.0), draws=200),
    }
    for name, answer in answers.items():
        first, *_ = answer.page_sentences()
        assert repr(answer).count('\n') < 20
        files = {path.name: path for path in answer.save(tmp_path / answer.study)}
        assert {name, 'report.html'} <= set(files)
        assert json.loads(files[name].read_text()) == json.loads(answer.json())
        assert html.escape(first) in files['report.html'].read_text()
    assert answers['check.json'].sentences() == ['RIGHT: of 128 wirings only that of the rig file fits.']
    assert psd_deflection.load_rig(tmp_path / 'calibrate' / 'rig.yaml').link.length == 0.585


def test_a_dot_off_its_detector_is_rejected() -> None:
    assert psd_deflection.solve([0.0, -9.9e-3, 0.0, -9.9e-3]).status == 0
    with pytest.raises(ConfigError, match=r'dots\[1\] = -1 m: must be at most 0.01 m, the width of its detector'):
        psd_deflection.solve([0.0, -1.0, 0.0, -2.0])  # mm for m


@pytest.mark.parametrize('name', ['thesis_rig.yaml', 'three_psds.yaml'])
def test_a_rig_can_be_sent_to_another_process_and_copied(name: str) -> None:
    rig = psd_deflection.load_rig(ROOT / 'config' / name)
    for other in (pickle.loads(pickle.dumps(rig)), copy.deepcopy(rig), copy.copy(rig)):  # noqa: S301
        assert (other, other.flat()) == (rig, rig.flat())


def test_a_rig_is_varied_by_replace() -> None:
    rig = psd_deflection.load_rig(block_size=10, **{'psd_3.center': [0.05, 0.05]})
    longer = rig.replace(link={'length': 1.0}, **{'psd_1.height': 0.002})
    assert (longer.link.length, longer.psds[0].height, longer.estimator.block_size) == (1.0, 0.002, 10)
    assert rig.link.length == 0.585
    assert len(longer.psds) == 3
    with pytest.raises(ConfigError, match=r'replace: link.lenght = 1.0: no parameter of that name'):
        rig.replace(link={'lenght': 1.0})


@pytest.mark.repeatable
def test_the_budget_of_python_is_that_of_the_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rig = str(ROOT / 'config' / 'thesis_rig.yaml')
    out = tmp_path / 'budget'
    words = ['budget', '--params-file', rig, '--load', '0', '-10', '0', '--set', 'rotation_tolerance=1e-3']
    assert main([*words, '--json', '--out', str(out)]) == 0
    answer = psd_deflection.budget(rig, (0, -10, 0), inputs={'rotation_tolerance': 1e-3})
    reported = capsys.readouterr().out
    assert answer.tree() == json.loads(reported) == json.loads((out / 'budget.json').read_text())
    assert (out / 'report.html').read_text() == answer.report()


@pytest.mark.parametrize(
    ('ask', 'words'),
    [
        (lambda: psd_deflection.budget(load=(1.0, 2.0)), r'load = \[1.0, 2.0\]: must be three finite numbers'),
        (lambda: psd_deflection.budget(load=(1.0, 2.0, float('nan'))), 'must be three finite numbers'),
        (lambda: psd_deflection.budget(inputs={'rotation_tolerence': 1.0}), 'inputs: rotation_tolerence = 1.0'),
        (lambda: psd_deflection.calibrate([]), 'recordings: must be at least one'),
        (lambda: psd_deflection.calibrate(['a.csv'], references=['b', 'c']), 'references: 2 for 1 recordings'),
        (lambda: psd_deflection.check('bags/clean'), 'holds no loads'),
    ],
)
def test_what_a_study_is_asked_wrongly_is_rejected(
    ask: Callable[[], Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises(PsdDeflectionError, match=words):
        ask()
