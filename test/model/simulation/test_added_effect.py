# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""An effect from outside the package: simulated, corrected and discovered like one of ours.

The effect is the one of docs/simulation.md, "Add an effect", so that the page is tried as well.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.measure.correction import Correction
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation import effects
from psd_deflection.model.simulation.catalogue import FOLDERS, GROUP, catalogue, effect_names
from psd_deflection.model.simulation.loads import sidebar
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import Counts, DeflectionEstimate, FloatArray, RawChunk
from psd_deflection.rig.config import Rig, load_rig

PACKAGE = Path(psd_deflection.__file__).parent
PAGE = (PACKAGE.parent / 'docs' / 'simulation.md').read_text(encoding='utf-8')
NAME = 'warm_gain'
(CODE,) = re.findall(r'```python\n(.*?)```', PAGE, re.S)
EFFECT = {'effects.one.name': NAME, 'effects.one.psd': 2, 'effects.one.k': 2e-4}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of effects, empty so far."""
    path = tmp_path / 'effects'
    path.mkdir()
    monkeypatch.setenv(FOLDERS, str(path))
    return path


@pytest.fixture
def rig(folder: Path) -> Rig:
    """The rig with the added effect on."""
    (folder / f'{NAME}.py').write_text(CODE)
    return load_rig(overrides=EFFECT)


def poses(rig: Rig, counts: Counts) -> FloatArray:
    """Estimates (blocks, 3) of a link that was at 20 degrees Celsius first and is at 30 now."""
    pipeline = Pipeline(rig)
    pipeline.temperature(20.0)
    pipeline.temperature(30.0)
    n = len(counts)
    seq = np.arange(n, dtype=np.int64)
    chunk = RawChunk(seq, seq * 1_000_000, counts, np.zeros(n, np.uint8), rig.converter.volts_per_count)
    records = [*pipeline.process(chunk), *pipeline.flush()]
    return np.array([(r.dx, r.dy, r.theta) for r in records if isinstance(r, DeflectionEstimate) and r.primary])


def test_a_file_that_is_edited_is_read_anew(folder: Path) -> None:
    """As in a notebook, without a new process."""
    file, read = folder / f'{NAME}.py', []
    for written_ns, words in ((1, 'as it was'), (1, 'as it was'), (2, 'edited')):
        file.write_text(CODE.replace("summary='", f"summary='{words}: "))
        os.utime(file, ns=(0, written_ns))
        read.append(catalogue()[NAME])
    assert [effect.summary.split(':')[0] for effect in read] == ['as it was', 'as it was', 'edited']
    assert read[0] is read[1]


@pytest.mark.slow
def test_it_is_simulated_and_corrected(rig: Rig) -> None:
    load = np.tile(sidebar(50.0), (8000, 1))
    warm = np.full(len(load), 30.0)
    warm[0] = 20.0
    counts = RigSimulator(rig, 4).step(load, warm).counts
    truth = poses(load_rig(), RigSimulator(load_rig(), 4).step(load, warm).counts)[-50:].mean(axis=0)
    blind, corrected = (np.abs(poses(r, counts)[-50:].mean(axis=0) - truth) for r in (load_rig(), rig))
    assert Pipeline(rig).needs_temperature
    assert not Pipeline(load_rig()).needs_temperature
    # A count is 0.08 um.
    assert (corrected[:2] < 3e-8).all()
    assert corrected.max() < 1e-6
    assert (blind > 20.0 * corrected).any()
    assert blind.max() > 1e-6


@pytest.mark.slow
def test_it_is_discovered_and_named(rig: Rig, tmp_path: Path) -> None:
    run, out = tmp_path / 'run', tmp_path / 'found'
    words = ['--loads', 'identification', '--temperature', '20,26,22', '--effect', f'{NAME},psd=2,k=2e-4']
    assert main(['simulate', '--out', str(run), *words]) == 0
    assert main(['discover', str(run), '--out', str(out), '--quiet']) == 0
    answer = json.loads((out / 'result.json').read_text())
    assert answer['verdict'] == 'effects_found'
    (named,) = answer['effects']
    assert (named['name'], named['parameters']['psd']) == (NAME, 2)
    k = named['parameters']['k']
    assert k['unit'] == '1/K'
    assert abs(k['value'] - 2e-4) < 4.0 * k['sd']
    assert Pipeline(load_rig(out / 'model.yaml')).needs_temperature


@pytest.mark.parametrize(('name', 'row'), [('temperature', 'warmer'), ('time', 't')])
def test_undeclared_value_in_correction_is_rejected(folder: Path, name: str, row: str) -> None:
    (folder / f'{NAME}.py').write_text(CODE.replace("{'temperature'}", '').replace('reading.warmer', f'reading.{row}'))
    with pytest.raises(ConfigError, match=f'{NAME}.*fails on a reading.*uses'):
        Pipeline(load_rig(overrides=EFFECT))
    declared = CODE.replace("{'temperature'}", f"{{'{name}'}}").replace('reading.warmer', f'reading.{row}')
    # Under another name: what is loaded once stays as it was.
    (folder / 'other.py').write_text(declared.replace(NAME, 'other'))
    correction = Correction.from_rig(load_rig(overrides={**EFFECT, 'effects.one.name': 'other'}))
    assert (correction.uses_temperature, correction.uses_time) == (name == 'temperature', name == 'time')


LOADED = """
from psd_deflection.model.simulation.declaration import Effect, EffectParameter

def _apply(samples, values, state):
    samples.loads *= 1.0 + values['by']

def _trace_back(block, values, remembered):
    block.loads[:] = [load / (1.0 + values['by']) for load in block.loads]

EFFECT = Effect('heavier', 'load', 's', 'e', 's', 'n', (EffectParameter('by', '', -0.5, 1.0, 1e-3, 'd'),),
                'load', apply=_apply, trace_back=_trace_back)
"""


def test_load_is_traced_back_and_failing_trace_is_rejected(folder: Path) -> None:
    (folder / 'heavier.py').write_text(LOADED)
    rig = load_rig(overrides={'effects.heavier.by': 0.25})
    load = Pipeline(rig).tip_loads.tip_load(0, *LinkStatics.from_rig(rig).deflection(10.0, -20.0, 5.0))
    assert load == pytest.approx((8.0, -16.0, 4.0))
    (folder / 'broken.py').write_text(LOADED.replace('block.loads', 'block.forces').replace('heavier', 'broken'))
    with pytest.raises(ConfigError, match=r'broken: trace_back fails on a pose .*forces'):
        Pipeline(load_rig(overrides={'effects.broken.by': 0.25}))


BROKEN = [
    ('def', 'SyntaxError'),
    ('import no_such_module', 'no_such_module'),
    ('raise RuntimeError("out of order")', 'out of order'),
    ('import sys; sys.exit("gone")', 'gone'),
    ('', 'EFFECT'),
    ('EFFECT = 3', 'must be an Effect'),
    (CODE.replace(f"name='{NAME}'", "name='cold_gain'"), 'cold_gain'),
    (CODE.replace("stage='psd'", "stage='pds'"), "stage = 'pds'"),
    (CODE.replace("point='dots'", "point='dot'"), "point = 'dot'"),
    (CODE.replace('    apply=_apply,\n', ''), 'needs apply'),
    (CODE.replace("{'temperature'}", "{'weather'}"), 'weather'),
    (CODE.replace('correct=', 'trace_back='), 'trace_back is for the points load, static and pose'),
    (CODE.replace("'relative growth per kelvin'", "'', kind='phase'"), 'amplitude'),
]


@pytest.mark.parametrize(('code', 'message'), BROKEN, ids=[message for _, message in BROKEN])
def test_a_broken_file_is_named_with_the_cause(folder: Path, code: str, message: str) -> None:
    file = folder / f'{NAME}.py'
    file.write_text(code)
    for load in (lambda: Pipeline(load_rig(overrides=EFFECT)), catalogue):
        with pytest.raises(ConfigError) as error:
            load()
        assert str(file) in str(error.value)
        assert message in str(error.value)
    Pipeline(load_rig())
    Pipeline(load_rig(overrides={'effects.one.name': 'sensor_gain', 'effects.one.psd': 1, 'effects.one.x': 0.01}))


def test_a_folder_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDERS, str(tmp_path / 'efects'))
    with pytest.raises(ConfigError, match=rf'{FOLDERS}: .*efects: cannot be read'):
        effect_names()
    Pipeline(load_rig())
    monkeypatch.delenv(FOLDERS)
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    assert NAME not in effect_names()


def test_two_effects_of_one_name_are_rejected(folder: Path) -> None:
    file = folder / 'creep.py'
    file.write_text(CODE)
    with pytest.raises(ConfigError) as error:
        effect_names()
    assert str(file) in str(error.value)
    assert 'effects.creep' in str(error.value)


def test_a_package_offers_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported = tmp_path / 'some_package-1.0.dist-info'
    reported.mkdir()
    (reported / 'METADATA').write_text('Metadata-Version: 2.1\nName: some-package\nVersion: 1.0\n')
    (reported / 'entry_points.txt').write_text(f'[{GROUP}]\n{NAME} = some_package_with_an_effect:EFFECT\n')
    (tmp_path / 'some_package_with_an_effect.py').write_text(CODE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(FOLDERS, '')
    assert Pipeline(load_rig(overrides=EFFECT)).needs_temperature


HEAVY = ('scipy.signal', 'scipy.special', 'scipy.optimize', 'scipy.stats', 'matplotlib', 'pandas')


@pytest.mark.parametrize(('overrides', 'loaded'), [({}, []), (EFFECT | {'effects.one.name': 'x'}, ['x'])])
def test_a_start_loads_the_effects_that_are_on_and_nothing_heavy(
    folder: Path, overrides: dict[str, object], loaded: list[str]
) -> None:
    (folder / 'x.py').write_text(CODE.replace(NAME, 'x'))
    program = f"""
import json, sys
from psd_deflection.rig.config import load_rig
from psd_deflection.measure.pipeline import Pipeline
Pipeline(load_rig(overrides=json.loads({json.dumps(overrides)!r})))
print(json.dumps(sorted(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    modules = json.loads(done.stdout)
    assert [m for m in modules if m.startswith(HEAVY)] == []
    assert [m for m in modules if m.startswith(effects.__name__ + '.')] == []
    assert [
        m.rsplit('.', 1)[1] for m in modules if m.startswith('psd_deflection.model.simulation.catalogue.')
    ] == loaded
    assert 'psd_deflection.model.simulation.simulator' not in modules
