# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two lasers over one beam splitter: the rules of the thesis by hand, and what the pipeline does when one fails."""

import json
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.records import BlockStatus
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.splitter import Lasers, lit, rules, simulated

RIG = load_rig()
FILE = str(Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml')


@pytest.mark.parametrize(
    ('powers', 'allowed', 'satisfied'),
    [
        # Both together; each alone is enough (a quarter of 5 V is the least); one out is told; as spares; alike.
        ((1e-3, 1e-3), 1e-3, [True, True, True, True, True, True, True]),
        ((1.1e-3, 1e-3), 1e-3, [False, True, True, True, True, True, True]),
        ((2.1e-3, 2e-3), 1e-3, [False, True, True, True, False, True, True]),
        ((1e-3, 2.1e-3), 1e-3, [False, True, True, False, True, False, False]),
        ((1e-3, 0.3e-3), 1e-3, [True, True, False, False, True, True, False]),
        ((0.3e-3, 1e-3), 1e-3, [True, False, True, False, True, True, False]),
    ],
)
def test_the_three_rules(powers: tuple[float, float], allowed: float, satisfied: list[bool]) -> None:
    assert [rule.satisfied for rule in rules(RIG, Lasers(powers, allowed))] == satisfied


def test_the_numbers_of_the_rules() -> None:
    both, first, second, share, _, _, spare = rules(RIG, Lasers((0.6e-3, 0.4e-3), 1e-3))
    assert (both.value, both.limit) == pytest.approx((1e-3, 2e-3))
    assert (first.value, second.value, first.limit) == pytest.approx((3.0, 2.0, 1.25))
    assert (share.value, spare.value) == pytest.approx((0.4, 5.0 / 1.5))


def test_failed_laser_costs_certainty_or_warm_up() -> None:
    """The link swings slowly and for ever: an estimate is held against the pose in the middle of its block."""
    slow = {'dynamics.bending_frequency': 1.0, 'dynamics.bending_damping_ratio': 0.0}
    both, out, alone, cold, spare = simulated(load_rig(None, slow), Lasers((1e-3, 1e-3), 1e-3, 0.5))
    assert both.scatter == pytest.approx(both.deviations, rel=0.3)
    assert [p.estimates for p in (both, out, alone, cold, spare)] == [1.0, 1.0, 1.0, 0.0, 1.0]
    assert cold.status is BlockStatus.LASER_LOST
    assert out.message == 'one of the two lasers is out: half the light on both detectors'
    assert 'laser 1 lost' in cold.message
    # Half the light has twice the noise, at least; the spare has what the first one had.
    assert np.all(out.deviations > 1.9 * both.deviations)
    assert spare.deviations == pytest.approx(alone.deviations, rel=0.3)
    assert max(p.largest for p in (both, out, alone, spare)) < 5.0
    # Where the dots leap, the tip seems to: half a dot's distance if both shone, all of it for a spare.
    assert [p.off[0] for p in (both, out, alone, spare)] == pytest.approx([0.0, -5e-4, 0.0, -1e-3], abs=1e-6)
    assert cold.largest == 0.0
    odd = simulated(load_rig(None, {**slow, 'block_size': 21}), Lasers((1e-3, 1e-3), 1e-3, 0.0))
    assert odd[0].scatter == pytest.approx(odd[0].deviations, rel=0.3)
    assert [p.name for p in odd][-2:] == ['laser 1 alone', 'its spare']


def test_half_the_light_halves_the_sum_and_doubles_the_noise() -> None:
    """An amplifier's noise goes with one over the sum; in the dark there is nothing else."""
    rng = np.random.default_rng(3)
    noise = RIG.noises.ravel()
    level = np.tile([1.0, -2.0, 5.0], 2)
    volts = level + noise * rng.standard_normal((20_000, 6))
    half, dark, full = (lit(RIG, volts, np.full(len(volts), share), rng) for share in (0.5, 0.0, 1.0))
    np.testing.assert_array_equal(full, volts)
    places, sums = [0, 1, 3, 4], [2, 5]
    np.testing.assert_allclose(half[:, places].std(axis=0), 2.0 * noise[places], rtol=0.03)
    np.testing.assert_allclose(half[:, places].mean(axis=0), level[places], atol=1e-4)
    np.testing.assert_allclose(half[:, sums], 0.5 * volts[:, sums])
    np.testing.assert_allclose(dark[:, places].std(axis=0), noise[places], rtol=0.03)
    np.testing.assert_allclose(dark.mean(axis=0), 0.0, atol=1e-4)


def test_the_command_says_which_rule_is_broken(capsys: pytest.CaptureFixture[str]) -> None:
    words = ['design', '--params-file', FILE, '--splitter', '1e-3', '1e-3']
    assert main([*words, '--allowed', '1e-3']) == 0
    out = capsys.readouterr().out
    assert 'NO' not in out
    assert 'laser 1 out: one of the two lasers is out' in out
    assert main([*words, '--allowed', '0.9e-3', '--json']) == 1
    tree = json.loads(capsys.readouterr().out)
    assert [rule['words'] for rule in tree['rules'] if not rule['satisfied']] == ['both together']
    assert tree['phases'][3]['status'] == 'LASER_LOST'


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--splitter', '1e-3', '1e-3'], 'give --allowed W too'),
        (['--allowed', '1e-3'], 'is of two lasers: give --splitter W W'),
        (['--splitter', '0', '1e-3', '--allowed', '1e-3'], 'must be above 0'),
        (['--splitter', '1e-3', '1e6', '--allowed', '1e-3'], 'splitter = 1000000.0 W: must be above 0 and below 1000'),
        (['--splitter', '1e-3', '1e-3', '--allowed', '1e-3', '--warm-up', '-1'], 'must be at least 0'),
        (['--splitter', '1e-3', '1e-3', '--allowed', '1e-3', '--radius', '0.1'], 'not for --splitter'),
    ],
)
def test_what_cannot_be_is_rejected(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design', '--params-file', FILE, *words]) != 0
    assert message in capsys.readouterr().err


def test_lasers_are_checked() -> None:
    with pytest.raises(ConfigError, match=r'apart = 0\.006 m: must be at least'):
        Lasers((1e-3, 1e-3), 1e-3, apart=0.006)
    with pytest.raises(ConfigError, match='allowed = nan'):
        Lasers((1e-3, 1e-3), float('nan'))
