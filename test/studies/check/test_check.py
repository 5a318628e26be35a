# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check names every wrong wiring and accuses no right one, of the second generator, and judges as discover does."""

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blind import generator
from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import read_observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.parameter_files import read_parameter_file
from psd_deflection.studies.check import shared_findings
from psd_deflection.studies.check.checkup import check, of_recording, responses
from psd_deflection.studies.check.result import CANNOT_TELL, RIGHT, WRONG, Checkup, levels

CLOUD = 2e-3 * 0.5e-3
"""Noise of one sample, m."""
FORCE = CLOUD / (0.585**3 / (3.0 * generator.EI))
"""N that move a dot by the noise of a sample."""
TORQUE = CLOUD / (0.070 * 0.585 / generator.GJ)
"""N m that turn the nearer dot by the noise of a sample."""
BLOCK = 1.0 / math.sqrt(20.0)
"""Noise of a block's mean over that of a sample."""
Turn = Mapping[str, tuple[str, int]]
"""Of each channel of the device, the channel of the nominal rig whose signal it carries, and its sign."""


def pushes(size: float, signs: Sequence[float] = (1.0, 1.0, 1.0)) -> FloatArray:
    """A second each of +X, +Y and +theta of ``size`` times the noise, with a second of rest about each."""
    loads = np.zeros((7000, 3))
    for i, unit in enumerate((FORCE, FORCE, TORQUE)):
        loads[1000 + 2000 * i : 2000 + 2000 * i, i] = signs[i] * size * unit
    return loads


@cache
def clean(key: bytes, effects: str = '[]') -> FloatArray:
    """Volts (n, 6) without noise of the loads ``key`` on a rig that is wired as it should be."""
    loads = np.frombuffer(key).reshape(-1, 3)
    specs: list[dict[str, Any]] = json.loads(effects)
    none = np.zeros(len(loads) * 5)
    t = np.arange(len(none), dtype=np.float64) * generator.STEP
    dots = generator.optics(generator.motion(loads, 0.585, specs), t, none, 0.585, specs)
    m, light = generator.sensors(dots, t, none, specs)
    return generator.electronics(m, light, t, specs)


def recorded(
    loads: FloatArray, seed: int, wiring: Turn | None = None, effects: Sequence[Any] = (), **noise: Any
) -> FloatArray:
    """What the converter gives, (n, 6) V, with the channels as ``wiring`` has them."""
    volts = clean(np.ascontiguousarray(loads).tobytes(), json.dumps(list(effects)))
    volts = volts + generator.electronic_noise(len(volts), seed, **noise)
    if wiring is not None:
        names = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')
        volts = np.column_stack([sign * volts[:, names.index(of)] for of, sign in (wiring[name] for name in names)])
    return generator.output(volts, [])


def every_turn() -> list[Turn]:
    """128 ways to wire two PSDs to two inputs of three channels, written without the product's own wirings."""
    out: list[Turn] = []
    for swapped in (False, True):
        for kinds in itertools.product(itertools.product((False, True), (1, -1), (1, -1)), repeat=2):
            wiring: dict[str, tuple[str, int]] = {}
            for number, (crossed, sx, sy) in enumerate(kinds, start=1):
                of = 3 - number if swapped else number
                wiring[f'x{number}'] = (f'y{of}' if crossed else f'x{of}', sx)
                wiring[f'y{number}'] = (f'x{of}' if crossed else f'y{of}', sy)
                wiring[f'sum{number}'] = (f'sum{of}', 1)
            out.append(wiring)
    return out


def checked(volts: FloatArray, loads: FloatArray, rig: Rig | None = None) -> Checkup:
    rig = rig or load_rig()
    return check(of_recording(rig, volts, loads))


def lines_of(wiring: Turn) -> dict[str, object]:
    """The lines that put the nominal rig file right, from the turn alone."""
    swapped = wiring['sum1'][0] == 'sum2'
    out: dict[str, object] = {'psds_exchanged': True} if swapped else {}
    for psd in (1, 2):
        axes = []
        for axis in ('x', 'y'):
            channel, sign = next((c, s) for c, (of, s) in wiring.items() if of == f'{axis}{psd}')
            axes.append(('-' if sign < 0 else '') + channel[0])
        if axes != ['x', 'y']:
            out[f'psd_{psd}.axes'] = axes
    return out


@pytest.mark.slow
def test_each_of_127_wrong_wirings_is_named_from_three_pushes() -> None:
    wirings = every_turn()
    assert len(wirings) == 128
    misnamed = []
    for seed, wiring in enumerate(wirings):
        # Ten times the noise of a block is the harder one; that of a sample, now and then.
        loads = pushes(10.0 if seed % 8 == 7 else 10.0 * BLOCK)
        checkup = checked(recorded(loads, seed, wiring), loads)
        wanted = lines_of(wiring)
        if checkup.verdict != (WRONG if wanted else RIGHT) or checkup.values != wanted or len(checkup.wirings) != 1:
            misnamed.append((wiring, checkup.verdict, checkup.values))
    assert not misnamed


def test_a_right_rig_is_accused_of_nothing() -> None:
    for size, seed in itertools.product((10.0, 10.0 * BLOCK), range(2)):
        loads = pushes(size)
        checkup = checked(recorded(loads, seed), loads)
        assert (checkup.verdict, checkup.findings, dict(checkup.values)) == (RIGHT, (), {})


@pytest.mark.slow
@pytest.mark.parametrize('psd', [1, 2])
@pytest.mark.parametrize('rows', [8, -40, 3000, -3000])
def test_a_psd_on_another_clock_is_told_first_and_no_wire(rows: int, psd: int) -> None:
    """Beside one sign that is wrong: both are named, and nothing else."""
    loads = np.concatenate([np.zeros((2000, 3)), np.repeat([(0, -10, 0), (0, 0, 0), (12, 0, 0)], 2500, axis=0)])
    loads = np.concatenate([loads, np.repeat([(0, 0, 4), (3, 0, 0), (0, 0, 0)], 1700, axis=0)]).astype(np.float64)
    volts = recorded(loads, 1, every_turn()[1])
    columns, n = slice(3 * psd - 3, 3 * psd), len(volts) - abs(rows)
    moved = volts[max(rows, 0) :][:n].copy()
    moved[:, columns] = volts[max(-rows, 0) :][:n, columns]
    checkup = checked(moved, loads[max(rows, 0) :][:n])
    ((late,), (wrong,)) = checkup.late, checkup.findings
    assert (checkup.verdict, late.where, wrong.name) == (WRONG, f'psd_{psd}', 'channel_sign')
    assert abs(late.seconds - 1e-3 * rows) < 1e-4
    assert checkup.sentences()[1].startswith(f'psd_{psd}: on another clock: ')
    assert f'{abs(rows)} rows {"up" if rows > 0 else "down"}' in checkup.sentences()[1]
    assert (checkup.tree()['late'][0]['rows'], checkup.values) == (rows, lines_of(every_turn()[1]))


@pytest.mark.slow
@pytest.mark.parametrize('channel', ['x1', 'y1', 'x2', 'y2'])
@pytest.mark.parametrize('stuck', [False, True])
def test_a_dead_channel_is_named_and_no_wiring(channel: str, stuck: bool) -> None:
    loads = pushes(10.0)
    volts = recorded(loads, 2)
    column = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2').index(channel)
    volts[:, column] = 0.1 if stuck else generator.electronic_noise(len(volts), 9)[:, column]
    checkup = checked(volts, loads)
    assert [(f.name, f.where) for f in checkup.findings] == [('stuck_channel', channel)]
    assert not checkup.values
    (reported,) = [text for text in checkup.sentences() if text.startswith(channel)]
    assert re.fullmatch(rf'{channel}: [^:]+: .+', reported)
    assert '  ' not in reported
    assert any(line.startswith(f'  {channel}: ') for line in checkup.lines())


def test_noise_hum_and_light_are_held_against_the_rig_file() -> None:
    loads = pushes(50.0)
    hum = {'name': 'mains_interference', 'frequency': 60.0, 'amplitude': [0, 4e-3, 0, 0, 1e-3, 0], 'phase': [0.0] * 6}
    volts = recorded(loads, 5, effects=[hum], sigmas=(6e-3,) * 6)
    volts[:, 5] *= 0.7
    checkup = checked(volts, loads)
    (noisy,) = checkup.findings
    assert (noisy.name, noisy.fix) == ('noise_level', f'amplifier.noise: {checkup.values["amplifier.noise"]}')
    assert checkup.values['amplifier.noise'] == pytest.approx(6e-3, rel=0.05)
    np.testing.assert_allclose(checkup.levels.noise[[0, 1, 3, 4]], 6e-3, rtol=0.05)
    assert checkup.levels.hum_hz == 60.0
    assert checkup.levels.hum[1] == pytest.approx(4e-3, rel=0.1)
    assert any('psd_2: sum 3.50 V' in note for note in checkup.notes)
    assert any(note.startswith('hum: 4.') for note in checkup.notes)
    quiet = checked(recorded(loads, 5), loads)
    assert not quiet.levels.hum.any()
    assert not quiet.notes


@pytest.mark.slow
@pytest.mark.parametrize('name', ['psd_1', 'psd_2'])
def test_a_wrong_wiring_is_named_whatever_the_sensitivities_are(name: str) -> None:
    loads = pushes(50.0)
    rig = load_rig(overrides={'psd_1.sensitivity': [0.4e-3, 0.6e-3], 'psd_2.sensitivity': [0.5e-3, 0.8e-3]})
    wiring = next(
        t for t in every_turn() if list(lines_of(t)) == [f'{name}.axes'] and lines_of(t)[f'{name}.axes'] == ['-y', 'x']
    )
    volts = recorded(loads, 3)
    gains = (0.5e-3 / rig.sensitivities).tolist()
    for (x, y), first in zip(gains, (0, 3), strict=True):
        volts[:, first] *= x
        volts[:, first + 1] *= y
    names = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')
    rotated = np.column_stack([sign * volts[:, names.index(of)] for of, sign in (wiring[n] for n in names)])
    checkup = checked(rotated, loads, rig)
    assert (checkup.verdict, dict(checkup.values)) == (WRONG, lines_of(wiring))


def test_uninformative_loads_or_gaps_cannot_tell() -> None:
    loads = pushes(10.0)
    volts = recorded(loads, 1)
    assert checked(volts, np.zeros_like(loads)).verdict == CANNOT_TELL
    # A load that comes with the last sample has moved nothing yet.
    late = np.zeros_like(loads)
    late[-1, 1] = 1.0
    assert checked(volts, late).verdict == CANNOT_TELL
    gaps = volts.copy()
    gaps[::3] = np.nan
    checkup = checked(gaps, loads)
    assert (checkup.verdict, dict(checkup.values)) == (RIGHT, {})
    lost = np.where(np.arange(len(volts))[:, None] % 40 < 20, volts, np.nan)
    assert checked(lost, loads).verdict == RIGHT
    with pytest.raises(RecordingError, match='at least 8 are needed'):
        checked(volts[:100], loads[:100])


def written(path: Path, volts: FloatArray, loads: FloatArray) -> Path:
    t = np.arange(len(volts)) * 1e-3
    head = 't,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz'
    np.savetxt(path, np.column_stack((t, volts, loads)), '%.9g', ',', header=head, comments='')
    return path


def test_the_printed_lines_put_the_rig_file_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loads = pushes(10.0)
    recording = str(written(tmp_path / 'pushes.csv', recorded(loads, 7, every_turn()[100]), loads))
    assert main(['check', recording]) == 0
    message = capsys.readouterr().out
    assert 'WRONG: one wiring of 128 fits' in message
    pasted = [text for text in message.splitlines() if text.startswith('    ')]
    rig = tmp_path / 'rig.yaml'
    rig.write_text('\n'.join(['/**:', '  ros__parameters:', *pasted]) + '\n')
    assert read_parameter_file(rig) == lines_of(every_turn()[100])
    assert main(['check', recording, '--params-file', str(rig)]) == 0
    assert 'RIGHT: of 128 wirings only that of the rig file fits.' in capsys.readouterr().out


def test_json_has_the_names_that_programs_rely_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loads = pushes(10.0)
    wiring = {**{n: (n, 1) for n in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')}, 'y1': ('y1', -1)}
    recording = str(written(tmp_path / 'pushes.csv', recorded(loads, 8, wiring), loads))
    assert main(['check', recording, '--json']) == 0
    got = json.loads(capsys.readouterr().out)
    assert got['verdict'] == 'wrong'
    (entry,) = got['setup']
    assert entry.pop('evidence') > 0.0
    assert entry == {
        'name': 'channel_sign',
        'where': 'y1',
        'value': -1.0,
        'fix': 'psd_1.axes: [x, -y]',
        'equivalent': [],
    }
    assert got['lines'] == {'psd_1.axes': ['x', '-y']}
    assert got['wirings_that_fit'] == [{'psds_exchanged': False, 'psd_1.axes': ['x', '-y'], 'psd_2.axes': ['x', 'y']}]


@pytest.mark.parametrize(
    ('args', 'status', 'message'),
    [
        (['check', 'x.csv', '--port', '/dev/null'], 2, '--port is for the guide'),
        (['check', 'bags/clean'], 4, 'holds no loads'),
        (['check', '--world', 'psd_1.axes'], 2, 'must be NAME=VALUE'),
        (['check', '--world', 'psd_1.axes=[x, x]'], 2, 'must name x once and y once'),
        (['check', '--port', '/dev/null', '--world', 'link.length=1'], 2, '--world is for the simulated rig'),
    ],
)
def test_what_cannot_be_checked_is_rejected(
    args: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(args) == status
    assert message in capsys.readouterr().err


# A perfect rig: nothing drifts, whatever hangs on it.
SWAYS = (
    'steps:0,0,0;0,-10,-5.85;0,-30,-17.55;0,-50,-29.25:9',
    'steps:0,0,0;0,-1,-0.585;0,-3,-1.755;0,-5,-2.925:9',
    'steps:0,-50,-29.25;0,0,0:4',
    'thesis:9',
)


def drift_of(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """What ``check --json`` says of a simulated recording."""
    made = str(folder / 'made')
    assert main(['simulate', '--out', made, *words]) == 0
    capsys.readouterr()
    main(['check', made, '--json'])
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    return answer


def test_drift_under_load_steps_is_found_to_1_percent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # 4.5 um/K over 4 K in a minute.
    hidden = ('--temperature', '20,24', '--effect', 'thermal_drift,psd=1,x=4.5e-6')
    tree = drift_of(tmp_path, capsys, '--loads', SWAYS[0].replace(':9', ':15'), *hidden)
    assert tree['drift']['x1'] * 60.0 == pytest.approx(18e-6, rel=0.01)
    (note,) = [note for note in tree['notes'] if 'drift' in note]
    assert 'on x1; let lasers and amplifier warm up' in note


@pytest.mark.slow
def test_removed_weight_moves_dots_by_what_it_held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = load_rig()
    before, after = ForwardModel(rig, steady=True).run(np.array([[0.0, 0.0, 0.0], [0.0, -50.0, -29.25]])).true_dots.T
    made = str(tmp_path / 'made')
    assert main(['simulate', '--out', made, '--loads', SWAYS[2]]) == 0
    observed = read_observation(made, rig)
    (push,) = responses(rig, observed.volts, observed.loads).pushes
    assert push.channels == pytest.approx(before - after, abs=1e-6)
    assert push.expected == pytest.approx(before - after, abs=1e-9)


RIG = load_rig()
NAN = math.nan


@pytest.mark.parametrize(
    ('sizes', 'units'),
    [
        ((1.0, 1.0, 1.0), {}),
        ((9.80665, 9.7, NAN), {0: 'kg instead of N', 1: 'kg instead of N'}),
        ((NAN, 9.80665 * 0.971, 1.0), {1: 'kg instead of N'}),
        ((NAN, 9.80665 * 0.969, 1.0), {}),
        ((9.80665, 1.0, 1.0), {}),
        ((1e3, NAN, 1e3), {0: 'kN instead of N', 2: 'kN m instead of N m'}),
        ((4.45, 4.44, 0.0981), {0: 'lbf instead of N', 1: 'lbf instead of N', 2: 'kg cm instead of N m'}),
        ((NAN, 1 / 9.80665, NAN), {1: 'N, and then converted from kg once more'}),
        ((0.278, 0.28, NAN), {0: 'ozf instead of N', 1: 'ozf instead of N'}),
        ((NAN, NAN, 0.01), {2: 'N cm instead of N m'}),
        ((NAN, NAN, 100.0), {2: 'N m, and then converted from N cm once more'}),
        # Beside forces in grams a torque has their unit if that fits, though newton centimetres are nearer.
        ((9.80665e-3, 9.8e-3, 9.92e-3), {0: 'g instead of N', 1: 'g instead of N', 2: 'kg mm instead of N m'}),
        ((1e-3, 1e-3, 9.88e-3), {0: 'mN instead of N', 1: 'mN instead of N', 2: 'N cm instead of N m'}),
        ((NAN, NAN, 9.92e-3), {2: 'N cm instead of N m'}),
        # Pounds of torque are asked for beside pounds of force alone.
        ((4.45, 4.44, 1.36), {0: 'lbf instead of N', 1: 'lbf instead of N', 2: 'lbf ft instead of N m'}),
        ((4.45, 4.44, 0.113), {0: 'lbf instead of N', 1: 'lbf instead of N', 2: 'lbf in instead of N m'}),
        (
            (NAN, 0.2248, 0.7376),
            {1: 'N, and then converted from lbf once more', 2: 'N m, and then converted from lbf ft once more'},
        ),
        ((1.0, 1.0, 1.36), {}),
        # A digit of Young's modulus is no unit: the forces alone, by ten.
        ((10.0, 10.05, 1.0), {}),
        ((0.1, 0.1, 1.05), {}),
        ((10.0, 10.0, 1.2), {0: 'kg instead of N', 1: 'kg instead of N'}),
    ],
)
def test_a_size_is_a_unit_within_three_per_cent(sizes: tuple[float, float, float], units: dict[int, str]) -> None:
    findings, _ = shared_findings.unit_findings(np.array(sizes))
    places = {'fx': 0, 'fy': 1, 'tz': 2}
    reported = {places[load]: f.fix.partition('it is noted in ')[2] for f in findings for load in f.where.split()}
    assert reported == units


def test_check_and_discover_name_coarser_converter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, folder = tmp_path / 'run.csv', tmp_path / 'found'
    assert main(['simulate', '--out', str(run), '--loads', 'thesis:1', '--world', 'converter.bits=10']) == 0
    assert main(['discover', str(run), '--out', str(folder), '--quiet']) == 0
    capsys.readouterr()
    assert main(['check', str(run), '--json']) == 0
    checked = json.loads(capsys.readouterr().out)
    # What the steps add to the noise is not said once more.
    assert checked['lines'] == {'converter.bits': 10}
    searched = json.loads((folder / 'result.json').read_text())['setup']
    for message in (checked['setup'], searched):
        steps = [f for f in message if f['name'] == 'converter_step']
        assert [f['where'] for f in steps] == ['x1', 'y1', 'sum1', 'x2', 'y2', 'sum2']
        assert [f['value'] for f in steps] == pytest.approx([20.0 / 2**10] * 6, rel=1e-4)
        assert steps[0]['fix'] == 'converter.bits: 10 (x1 steps by 19.5 mV, the rig file says 0.305 mV)'


def test_a_channel_within_a_coarse_step_is_not_dead() -> None:
    rng = np.random.default_rng(3)
    volts = rng.normal((0.0, 0.0, 5.0, 0.0, 0.0, 5.0), 0.002, (3000, 6))
    volts[:, [0, 1, 3, 4]] += 0.2 * np.sin(np.arange(3000) / 300.0)[:, None]
    coarse = levels(RIG, 0.02 * np.round(volts / 0.02))
    assert coarse.stuck == ()
    checkup = check(of_recording(RIG, 0.02 * np.round(volts / 0.02), np.zeros((3000, 3))))
    assert {f.name for f in checkup.findings} == {'converter_step', 'load_coverage'}
    # With a fine converter a channel on which no bit moves is dead.
    volts[:, 5] = 5.0
    assert levels(RIG, volts).stuck == ('sum2',)


def test_quantisation_noise_is_step_over_root_12() -> None:
    stated = math.hypot(2e-3, 0.05 / math.sqrt(12.0))
    steps = np.full((2, 2), 0.05)
    (finding,), lines = shared_findings.noise_findings(RIG, np.full(4, 3.45678 * stated), steps)
    assert (finding.name, finding.where, finding.value) == ('noise_level', 'x1 y1 x2 y2', 3.457)
    assert finding.evidence == pytest.approx(math.log(3.45678))
    assert (lines, finding.fix) == ({'amplifier.noise': 6.9e-3}, 'amplifier.noise: 0.0069')
    # Steps that are finer than the file's make no less.
    alone = math.hypot(2e-3, 20.0 / 2**16 / math.sqrt(12.0))
    (same,), _ = shared_findings.noise_findings(RIG, np.full(4, 3.0 * alone), np.zeros((2, 2)))
    assert same.value == 3.0
    # Channels that nobody sees have no say, however coarse they are.
    steps[0, 1] = 5.0
    (partial,), _ = shared_findings.noise_findings(RIG, np.array([1.0, math.nan, 1.0, 1.0]) * 3.45678 * stated, steps)
    assert partial.value == 3.457
    assert shared_findings.noise_findings(RIG, np.zeros(4)) == ([], {})


@pytest.mark.parametrize(
    ('bits', 'step', 'right', 'words'),
    [
        (16, 0.02, 10, '20 mV, the rig file says 0.305 mV'),
        (12, 0.0101, 11, '10.1 mV, the rig file says 4.88 mV'),
        (11, 0.04006, 9, '40.1 mV, the rig file says 9.77 mV'),
        (11, 0.04004, 9, '40 mV, the rig file says 9.77 mV'),
        # A third more is no bit, and fewer than eight no converter has.
        (16, 0.0004, None, '0.4 mV, the rig file says 0.305 mV'),
        (16, 20.0 / 2**8, 8, ''),
        (16, 40.0 / 2**8, None, ''),
    ],
)
def test_each_doubling_of_the_step_is_a_bit_less(bits: int, step: float, right: int | None, words: str) -> None:
    rig = load_rig(overrides={'converter.bits': bits})
    (finding,), lines = shared_findings.step_findings(rig, np.array([0.0, 0.0, step, 0.0, 0.0, 0.0]))
    assert lines == ({} if right is None else {'converter.bits': right})
    assert (finding.where, finding.value) == ('sum1', step)
    assert finding.evidence == pytest.approx(math.log(step / (20.0 / 2**bits)))
    reported = f'sum1 steps by {words}'
    if words:
        assert finding.fix == (reported if right is None else f'converter.bits: {right} ({reported})')
    # If other channels are finer, no number of bits is right for all.
    (finding,), lines = shared_findings.step_findings(rig, np.array([0.0, 0.0, step, 0.0, 0.0, 0.0]), finer=True)
    assert lines == {}
    assert not finding.fix.startswith('converter.bits')
