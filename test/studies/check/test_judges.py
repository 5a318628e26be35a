# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What check and discover both judge: the same recording gets the same words."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import LEAST_BITS
from psd_deflection.studies.check import shared_findings
from psd_deflection.studies.check.checkup import check, of_recording
from psd_deflection.studies.check.result import levels

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
    run, found = tmp_path / 'run.csv', tmp_path / 'found'
    assert main(['simulate', '--out', str(run), '--loads', 'thesis:1', '--world', 'converter.bits=10']) == 0
    assert main(['discover', str(run), '--out', str(found), '--quiet']) == 0
    capsys.readouterr()
    assert main(['check', str(run), '--json']) == 0
    checked = json.loads(capsys.readouterr().out)
    # What the steps add to the noise is not said once more.
    assert checked['lines'] == {'converter.bits': 10}
    searched = json.loads((found / 'result.json').read_text())['setup']
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
    found = check(of_recording(RIG, 0.02 * np.round(volts / 0.02), np.zeros((3000, 3))))
    assert {f.name for f in found.findings} == {'converter_step', 'load_coverage'}
    # With a fine converter a channel on which no bit moves is dead.
    volts[:, 5] = 5.0
    assert levels(RIG, volts).stuck == ('sum2',)


def test_quantisation_noise_is_step_over_root_12() -> None:
    stated = math.hypot(2e-3, 0.05 / math.sqrt(12.0))
    steps = np.full((2, 2), 0.05)
    (found,), lines = shared_findings.noise_findings(RIG, np.full(4, 3.45678 * stated), steps)
    assert (found.name, found.where, found.value) == ('noise_level', 'x1 y1 x2 y2', 3.457)
    assert found.evidence == pytest.approx(math.log(3.45678))
    assert lines == {'amplifier.noise': 6.9e-3}
    assert found.fix == 'amplifier.noise: 0.0069'
    # Steps that are finer than the file's make no less.
    alone = math.hypot(2e-3, 20.0 / 2**16 / math.sqrt(12.0))
    (same,), _ = shared_findings.noise_findings(RIG, np.full(4, 3.0 * alone), np.zeros((2, 2)))
    assert same.value == 3.0
    # Channels that nobody sees have no say, however coarse they are.
    steps[0, 1] = 5.0
    (some,), _ = shared_findings.noise_findings(RIG, np.array([1.0, math.nan, 1.0, 1.0]) * 3.45678 * stated, steps)
    assert some.value == 3.457
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
        (16, 20.0 / 2**LEAST_BITS, LEAST_BITS, ''),
        (16, 40.0 / 2**LEAST_BITS, None, ''),
    ],
)
def test_each_doubling_of_the_step_is_a_bit_less(bits: int, step: float, right: int | None, words: str) -> None:
    rig = load_rig(overrides={'converter.bits': bits})
    (found,), lines = shared_findings.step_findings(rig, np.array([0.0, 0.0, step, 0.0, 0.0, 0.0]))
    assert lines == ({} if right is None else {'converter.bits': right})
    assert (found.where, found.value) == ('sum1', step)
    assert found.evidence == pytest.approx(math.log(step / (20.0 / 2**bits)))
    reported = f'sum1 steps by {words}'
    if words:
        assert found.fix == (reported if right is None else f'converter.bits: {right} ({reported})')
    # If other channels are finer, no number of bits is right for all.
    (found,), lines = shared_findings.step_findings(rig, np.array([0.0, 0.0, step, 0.0, 0.0, 0.0]), finer=True)
    assert lines == {}
    assert not found.fix.startswith('converter.bits')
