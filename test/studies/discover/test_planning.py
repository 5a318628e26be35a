# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a rig could tell apart, the next recording, when the loop ends; what noise leaves undetermined is no effect."""

import dataclasses
import functools
import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from psd_deflection.base.errors import RecordingError, UsageError
from psd_deflection.cli.main import main
from psd_deflection.cli.studies.discover import how_to_record, limits_from_words
from psd_deflection.measure.pipeline import ZERO_BLOCKS, zero_variances
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue, effect_names, effects_of_rig, make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.loads import load_history
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import zero_variances_at_end
from psd_deflection.records import DOT_CHANNELS, FloatArray, ParameterChange
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.discover import loop
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.experiment import Limits, Setting, expected_sums, pieces, proposals, settings
from psd_deflection.studies.discover.from_recordings import read_observations
from psd_deflection.studies.discover.isolable import Isolability, Isolable, isolable
from psd_deflection.studies.discover.noise import NoiseModel, SlowNoise, block_factor, corners_of
from psd_deflection.studies.discover.planning import Plan, plan_next
from psd_deflection.studies.discover.recorded import Recorded, with_free
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.comparison import EQUIVALENT
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.loads.plate_motion import fine_means

RIG = load_rig()
EI = make_active('bending_stiffness', {'scale': -0.002, 'moves_frequency': 0}, 'test')
CLAMP = make_active('clamp_bending_compliance', {'compliance': 2.6e-7}, 'test')


@pytest.fixture(scope='module')
def models() -> tuple[Workspace, Fit, Fit]:
    """Two effects that one length does not tell apart, fitted to a recording that has the first."""
    history = loads.steps([(0, 0, 0), (0, -50, 0), (0, 0, 0)], 0.6).loads
    hidden = {'effects.e.name': 'bending_stiffness', **{f'effects.e.{k}': v for k, v in EI.values.items()}}
    counts = RigSimulator(replace_values(RIG, hidden), 1).step(history).counts
    volts = counts.astype(np.float64) * RIG.converter.volts_per_count
    workspace = Workspace([Observation('seen', RIG, volts, history)])
    return workspace, refit(workspace, [EI]), refit(workspace, [CLAMP])


@pytest.fixture(scope='module')
def plan(models: tuple[Workspace, Fit, Fit]) -> Plan:
    workspace, named, alternative = models
    planned = plan_next(workspace, named, [alternative], Limits(swing=0.0, sweep=0.0, seconds=12.0))
    assert planned is not None
    return planned


def test_what_pieces_show_adds_up_to_what_the_recording_shows(models: tuple[Workspace, Fit, Fit]) -> None:
    workspace, named, alternative = models
    short = Setting('', {'link.length': 0.4})
    first = loads.steps([(0, 0, 0), (0, -50, 0)], 3.0).loads
    second = loads.steps([(0, -50, 0), (0, 0, 0)], 3.0).loads
    both = [named, alternative]
    one_by_one = (
        expected_sums(workspace, both, short, first) + expected_sums(workspace, both, short, second[3000:]) * 2.0
    )
    together = expected_sums(workspace, both, short, np.concatenate((first, np.zeros((6000, 3)))))
    assert one_by_one.seconds == together.seconds
    assert one_by_one.apart[0, 1] == pytest.approx(together.apart[0, 1], rel=0.1)
    assert one_by_one.fisher[1] == pytest.approx(together.fisher[1], rel=0.1)


@pytest.mark.parametrize(
    ('limits', 'rig'),
    [
        (Limits(), RIG),
        (Limits(force=500.0, torque=500.0, sideways=False, lengths=(0.4, 1.0)), RIG),
        (Limits(rates=(500.0,), seconds=20.0, swing=0.0), load_rig(overrides={'link.length': 1.2})),
    ],
)
def test_every_proposal_is_within_the_limits_and_on_the_sensors(limits: Limits, rig: Rig) -> None:
    offered = proposals(rig, limits)
    assert offered
    once = {(tuple(p.setting.changes.items()), p.piece.script): p for p in offered}
    for p in once.values():
        changed = replace_values(rig, p.setting.changes) if p.setting.changes else rig
        rate = changed.converter.sample_rate_hz
        history = p.piece.loads(rate)
        assert len(history) <= limits.seconds * rate + 1.0
        assert np.abs(history[:, :2]).max() <= limits.force
        assert np.abs(history[:, 2]).max() <= max(limits.torque, limits.force * limits.sidebar)
        if not limits.sideways and 'sweep' not in p.piece.words:
            assert not history[:, 0].any()
            assert history[:, 1].max() <= 0.0
        if 'sweep' in p.piece.words:
            continue
        # At rest under the load: twice as far while it rings.
        held = history[:: round(rate)]
        dots = ForwardModel(changed).run(np.repeat(held, 3000, axis=0)).dots[:, 2999::3000]
        assert np.abs(dots).max() < 0.5e-3 * changed.converter.full_scale
    assert {p.setting.swing for p in offered} == ({0.0, limits.swing} if limits.swing else {0.0})
    assert len(settings(rig, dataclasses.replace(limits, lengths=(), rates=(), swing=0.0))) == 1


@pytest.mark.slow
def test_a_rig_without_anything_can_still_be_looked_at_at_rest() -> None:
    (only,) = pieces(RIG, Limits(force=0.0, torque=0.0, sweep=0.0))
    assert only.words == '30 s unloaded'


@pytest.mark.parametrize(
    ('words', 'expected'),
    [
        (['force=30', 'lengths=0.4,0.5'], Limits(force=30.0, lengths=(0.4, 0.5))),
        (['lengths=', 'rates=2000', 'sideways=no'], Limits(lengths=(), rates=(2000.0,), sideways=False)),
        ([], Limits()),
    ],
)
def test_limits_are_read(words: list[str], expected: Limits) -> None:
    assert limits_from_words(words) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ('word', 'part'),
    [
        ('force', 'NAME=VALUE'),
        ('speed=3', 'force, torque'),
        ('force=', 'a number of at least 0'),
        ('force=-1', 'at least 0'),
        ('force=nan', 'at least 0'),
        ('force=1,2', 'a number'),
        ('lengths=0', 'numbers of at least 0.01'),
        ('sideways=1', 'yes or no'),
        ('seconds=1', 'at least 5'),
    ],
)
def test_a_bad_limit_is_rejected(word: str, part: str) -> None:
    with pytest.raises(UsageError, match=r'--limit ') as rejected:
        limits_from_words([word])
    assert part in str(rejected.value)


class Searches:
    """Stands for discover: each search leaves one fewer alternative of ``free`` parameters; plans are of ``useful``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, equivalents: int, useful: bool = True, free: int = 1) -> None:
        self.observed: list[int] = []
        self.equivalents, self.free = equivalents, free
        monkeypatch.setattr(
            loop,
            'next_of',
            lambda study, _: SimpleNamespace(useful=useful and bool(study.unsettled), sentence='Nothing helps.'),
        )

    def search(self, known: Sequence[Observation]) -> Discovery:
        self.observed.append(len(known))
        tied = ('other',) * max(self.equivalents - len(known) + 1, 0)
        alternatives = [SimpleNamespace(parameters=self.free)] * len(tied)
        return cast(
            Discovery, SimpleNamespace(unsettled=tied, alternative_fits=alternatives, fit=SimpleNamespace(parameters=1))
        )

    def settle(self, most: int | None = None) -> loop.LoopResult:
        first, made = cast(Observation, object()), cast(Observation, object())
        if most is None:
            return loop.run_loop([first], self.search, lambda plan, number: made)
        return loop.run_loop([first], self.search, lambda plan, number: made, most=most)


def test_loop_ends_without_useful_or_allowed_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    done = Searches(monkeypatch, 2, useful=False).settle()
    assert (done.outcome, len(done.plans)) == ('limits', 0)
    assert done.sentence.endswith('Nothing helps.')
    # An alternative that needs more parameters for the same is not needed.
    assert Searches(monkeypatch, 2, useful=False, free=2).settle().outcome == 'unique'
    assert Searches(monkeypatch, 2, free=2).settle().sentence == 'The answer is unique after 2 more recordings.'
    done = Searches(monkeypatch, 9).settle(most=1)
    assert (done.outcome, len(done.plans)) == ('recordings', 1)
    assert done.sentence == 'The answer is not unique after 1 more recording, and no more were allowed.'
    # Three more are allowed if nobody says otherwise.
    assert len(Searches(monkeypatch, 9).settle().plans) == 3


@pytest.fixture(scope='module')
def soft(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('soft') / 'one.csv'
    hidden = 'clamp_bending_compliance,compliance=2e-7'
    words = ['--loads', 'steps:0,0,0;0,-40,0;0,0,0:0.8', '--effect', hidden, '--seed', '3']
    assert main(['simulate', '--out', str(path), *words]) == 0
    return path


@pytest.mark.slow
def test_the_command_settles_what_one_length_leaves_open(
    soft: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = ['--limit', 'swing=0', '--limit', 'sweep=0', '--limit', 'seconds=12', '--quiet']
    truth = ['--effect', 'clamp_bending_compliance,compliance=2e-7']
    command = ['discover', str(soft), '--without', 'creep', '--from', '0.0', '--out', str(tmp_path)]
    assert main([*command, '--quiet']) == 0
    planning = f'next: {shlex.join(["psd-deflection", *command, "--next"])} plans the recording that tells '
    assert f'{planning}link_length from clamp_bending_compliance, ' in capsys.readouterr().out
    assert main(['discover', str(soft), '--out', str(tmp_path), '--next', '--run', *truth, *limits]) == 0
    assert 'The answer is unique after 1 more recording.' in capsys.readouterr().out
    tree = json.loads((tmp_path / 'result.json').read_text())
    assert tree['next'] is None
    assert (tree['run']['outcome'], [e['name'] for e in tree['effects']]) == ('unique', ['clamp_bending_compliance'])
    (made,) = tree['run']['recordings']
    assert made['overrides'] == {'link.length': 0.409}
    (observed,) = read_observations([tmp_path / 'next.yaml'])
    assert (observed.name, observed.rig.link.length) == (made['file'], 0.409)


@pytest.mark.slow
def test_a_plan_is_written_as_files_that_the_commands_take(
    plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    warm = dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, swing=2.0))
    files = loop.LoopResult(cast(Discovery, SimpleNamespace(files=dict, tree=dict)), (), warm, None).files()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    lines = how_to_record(warm, tmp_path)
    script = load_history(str(tmp_path / 'next_loads.csv'), 1000.0).loads
    assert np.array_equal(script, plan.loads)
    command = shlex.split(lines[1])
    assert (command[:2], main(command[1:])) == (['psd-deflection', 'simulate'], 0)
    (observed,) = read_observations([tmp_path / 'next.yaml'])
    assert observed.rig.link.length == 0.409
    assert np.array_equal(observed.loads, plan.loads)
    assert observed.temperature is not None
    assert np.ptp(observed.temperature) == pytest.approx(4.0, abs=0.01)
    shown_table = plan.table
    assert 'hold' in shown_table
    assert 'clamp_bending_compliance' in shown_table


@pytest.mark.parametrize(
    ('words', 'part'),
    [
        (['--run'], '--run is for --next'),
        (['--limit', 'force=3'], '--limit is for --next'),
        (['--next', '--effect', 'damping'], '--effect is for the simulated rig'),
        (['--next', '--run', '--effect', 'nonsense,a=1'], 'no effect of that name'),
    ],
)
def test_options_that_would_be_ignored_are_rejected(
    soft: Path, words: list[str], part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['discover', str(soft), '--out', str(tmp_path), '--quiet', *words]) == 2
    assert part in capsys.readouterr().err


LOADS = load_history('thesis:1', RIG.converter.sample_rate_hz).loads


@cache
def answer() -> Isolability:
    return isolable(RIG, LOADS, 'thesis:1')


def of(label: str) -> Isolable:
    return next(effect for effect in answer().effects if effect.label == label)


def searched(name: str, **values: float) -> Discovery:
    """What a search finds in a recording of a rig that has the effect."""
    true = replace_values(RIG, {'effects.e.name': name, **{f'effects.e.{k}': v for k, v in values.items()}})
    volts = RigSimulator(true, 1).step(LOADS).counts.astype(np.float64) * RIG.converter.volts_per_count
    return discover([Observation('made', RIG, volts, LOADS)])


@pytest.mark.slow
def test_it_says_from_which_size_a_search_names_an_effect() -> None:
    effect = of('sensor_rotation (psd 2)')
    assert effect.parameter == 'angle'
    assert effect.observed is not None
    assert effect.named is not None
    assert not searched('sensor_rotation', psd=2, angle=0.5 * effect.observed).effects
    discovery = searched('sensor_rotation', psd=2, angle=2.0 * effect.named)
    assert [e.active.label for e in discovery.effects] == [effect.label]
    assert not discovery.unsettled


@pytest.mark.slow
def test_it_says_what_a_search_cannot_separate() -> None:
    effect = of('bending_stiffness (moves_frequency 0)')
    assert effect.observed is not None
    assert (effect.named, effect.alike) == (None, 'clamp_bending_compliance')
    # A softer link: a clamp cannot make it stiffer.
    discovery = searched('bending_stiffness', scale=-100.0 * effect.observed, moves_frequency=0)
    names = {e.active.effect.name for e in discovery.effects} | set(discovery.unsettled)
    assert {'bending_stiffness', 'clamp_bending_compliance'} <= names


@pytest.mark.slow
def test_what_does_not_show_is_listed_with_what_it_needs() -> None:
    assert set(answer().hidden.values()) == {'a change of temperature'}  # Not 'nothing', of coarse steps.
    still = isolable(RIG, np.zeros((2000, 3)), 'no load')
    assert 'bending_stiffness (moves_frequency 1)' in still.hidden
    # Where a PSD is shows without any load.
    assert any(effect.label == 'sensor_position (psd 1, aimed 0)' for effect in still.effects)
    assert 'axis_crosstalk (psd 1)' not in isolable(RIG, LOADS, without=['axis_crosstalk']).hidden


@pytest.mark.slow
def test_every_effect_imitates_itself() -> None:
    matrix = answer().matrix
    assert np.diag(matrix) == pytest.approx(np.ones(len(matrix)), abs=1e-6)
    assert (matrix >= 0.0).all()
    assert (matrix <= 1.0).all()


def test_sizes_are_those_whose_chi_square_a_search_accepts() -> None:
    """Each is simulated at its size, beside the rig as it is."""
    loads = np.repeat([(0.0, 0.0, 0.0), (0.0, -20.0, 0.0), (20.0, 0.0, 0.0), (0.0, 0.0, 8.0)], 500, axis=0)
    few = {'sensor_rotation': {'psd': 2}, 'ambient_light': {'psd': 1}}
    listed = isolable(RIG, loads, without=[name for name in effect_names() if name not in few])
    sigma = RIG.noises.reshape(-1, 1) / 2.0

    def shown(*effects: ActiveEffect) -> FloatArray:
        return np.asarray(fine_means(ForwardModel(RIG, effects).expect(loads).volts, 4) / sigma)

    for name, choice in few.items():
        (effect,) = (e for e in listed.effects if e.label.startswith(f'{name} (psd {choice["psd"]}'))
        active = make_active(name, {**choice, effect.parameter: effect.observed}, 'test')
        count = sum(p.kind != 'choice' for p in active.effect.parameters)
        by_chance = chi2.isf(1e-4 / len(listed.effects), count)
        accepted = max(by_chance, count * math.log(6 * 100) + 10.0)
        assert np.sum((shown(active) - shown()) ** 2) == pytest.approx(accepted, rel=0.1)
        assert effect.observed is not None
        larger = max(1.0, math.sqrt(EQUIVALENT / effect.apart / accepted))
        assert effect.named == pytest.approx(larger * effect.observed, rel=1e-3)
    named = [e.named if e.named is not None else math.nan for e in listed.effects]
    np.testing.assert_array_equal(listed.table().column('named'), named)
    # Both change the size of whatever the loads move; an effect of more numbers is no answer for one of fewer.
    alike = {e.label: e.alike for e in listed.effects}
    assert (alike['sensitivity'], alike['link_length']) == ('link_length', 'sensitivity')


def test_loads_too_short_for_a_search_are_rejected() -> None:
    with pytest.raises(RecordingError, match='79 samples: discover needs at least 4 blocks'):
        isolable(RIG, LOADS[:79])


@pytest.mark.slow
def test_the_command_prints_it_and_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['discover', '--isolable', 'thesis:1', '--out', str(tmp_path / 'before'), '--quiet']) == 0
    out = capsys.readouterr().out
    assert answer().lines()[0] in out
    assert answer().sentences()[0] in out
    assert sorted(path.name for path in (tmp_path / 'before').iterdir()) == ['isolable.json', 'report.html']


PERIOD = 0.004
LEVELS = np.repeat(
    np.array([(0, 0, 0), (0, -30, -17), (0, -50, 0), (30, 0, 0), (-20, -20, 15), (0, 0, 0)], float), 3000, axis=0
)


def flicker(n: int, period: float, corner: float, seed: int, channels: int = 6) -> FloatArray:
    """(n, channels): sums of twenty first-order processes, five to a decade, are 1/f; white noise beside them."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(n, channels))
    ratio = 10.0 ** (1.0 / 5.0)
    for k in range(-10, 12):
        pole = 2.0 * np.pi * ratio**k
        a = np.exp(-pole * period)
        # A process of variance v has the density 4 v / pole / (1 + (f / f0)^2); their sum is v times 4.5 / f.
        v = corner * np.log(ratio) * 2.0 * period
        new = rng.normal(size=(n, channels)) * np.sqrt(v * (1.0 - a * a))
        before = a * np.sqrt(v) * rng.normal(size=(1, channels))
        out += lfilter([1.0], [1.0, -a], new, axis=0, zi=before)[0]
    return out


@functools.cache
def clean(angle: float) -> FloatArray:
    true = {'effects.e.name': 'sensor_rotation', 'effects.e.psd': 1, 'effects.e.angle': angle} if angle else {}
    rig = replace_values(RIG, true)
    return np.asarray(ForwardModel(rig, effects_of_rig(rig)).expect(LEVELS).volts.T)


def observed(corner: float, seed: int, angle: float = 0.0) -> Observation:
    step = RIG.converter.volts_per_count
    noise = RIG.noises.ravel() * flicker(len(LEVELS), 1.0 / RIG.converter.sample_rate_hz, corner, seed)
    return Observation('x', RIG, np.rint((clean(angle) + noise) / step) * step, LEVELS)


@pytest.mark.parametrize('corner', [0.5, 2.0, 10.0, 50.0])
def test_the_corner_is_that_of_the_noise(corner: float) -> None:
    parts = [flicker(6000, PERIOD, corner, seed).T for seed in (1, 2)]
    corners = corners_of(parts, [PERIOD, PERIOD])
    assert corners == pytest.approx(np.full(6, corner), rel=0.45)
    assert np.median(corners) == pytest.approx(corner, rel=0.25)


def test_white_noise_has_no_corner_that_matters() -> None:
    white = [np.random.default_rng(seed).normal(size=(6, 6000)) for seed in range(20)]
    corners = [corners_of([rows], [PERIOD]).max() for rows in white]
    assert np.mean(np.array(corners) == 0.0) > 0.5
    assert max(corners) < 0.2


def test_slow_noise_without_light_is_not_electronic() -> None:
    rows = flicker(6000, PERIOD, 5.0, 1).T
    rows[[2, 5]] = np.random.default_rng(2).normal(size=(2, 6000))
    assert corners_of([rows], [PERIOD]).max() < 0.2
    # One light alone moves, or the positions do not.
    rows[2] = flicker(6000, PERIOD, 5.0, 3, 1)[:, 0]
    assert corners_of([rows], [PERIOD]).max() < 0.2
    quiet = np.random.default_rng(4).normal(size=(6, 6000))
    quiet[[2, 5]] = flicker(6000, PERIOD, 5.0, 5, 2).T
    assert corners_of([quiet], [PERIOD]).max() < 0.3


def test_slow_noise_of_a_channel_is_at_most_that_of_the_light() -> None:
    rows = flicker(6000, PERIOD, 2.0, 1).T
    usual = corners_of([rows], [PERIOD])
    rows[0] += 3.0 * np.sin(np.arange(6000) / 400.0)
    corners = corners_of([rows], [PERIOD])
    assert corners[0] <= 1.3 * usual[[2, 5]].min()
    assert corners[1:].tolist() == usual[1:].tolist()


def test_outliers_and_lost_samples_make_no_corner() -> None:
    rows = np.random.default_rng(1).normal(size=(6, 6000))
    rows[:, ::97] += 300.0
    rows[:, 2000:2600] = 0.0
    assert corners_of([rows], [PERIOD]).max() < 0.2
    # Of fewer than 64 values nothing is told.
    few = np.zeros((6, 6000))
    few[:, :63] = 9.0
    assert not corners_of([few], [PERIOD]).any()


def test_whitening_is_its_own_adjoint_and_is_undone() -> None:
    slow = SlowNoise.of(np.array([0.0, 0.5, 1.0, 2.0, 10.0, 50.0]), 500, PERIOD)
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 6, 500))
    np.testing.assert_allclose((slow.whiten(a) * b).sum(axis=1), (a * slow.whiten(b)).sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(slow.unwhiten(slow.whiten(a)), a, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slow.whiten(a)[0], a[0], rtol=1e-12)


def test_cosine_is_weakened_by_root_of_density() -> None:
    n, k = 500, 30
    f = 0.5 * k / (n * PERIOD)
    wave = np.cos(np.pi * k * (np.arange(n) + 0.5) / n) * np.ones((6, 1))
    white = SlowNoise.of(np.full(6, 3.0), n, PERIOD).whiten(wave)
    np.testing.assert_allclose(white, wave / np.sqrt(1.0 + 3.0 / f), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('corner', [1.0, 10.0])
def test_the_mean_of_a_block_is_as_uncertain_as_the_formula_says(corner: float) -> None:
    rows = np.concatenate([flicker(6000, PERIOD, corner, seed).T for seed in range(8)])
    rows -= rows.mean(axis=1, keepdims=True)
    blocks = rows.reshape(len(rows), 1200, 5).mean(axis=2)
    factor = block_factor(24.0, 0.02, np.array([corner]))[0]
    assert 5.0 * (blocks**2).mean() == pytest.approx(factor, rel=0.15)


def model(corners: FloatArray) -> NoiseModel:
    ones = np.ones(6)
    plain = NoiseModel(ones, np.zeros((6, 2)), 2.0 * ones, 0.5 * ones, 3.0, (False,) * 6)
    return plain.with_slow_noise(corners, 1000, PERIOD, 0.02)


def test_noise_model_whitens_by_both_and_keeps_gaps() -> None:
    slow = model(np.full(6, 3.0))
    assert slow.slow is not None
    assert slow.block_sigma == pytest.approx(0.5 * np.sqrt(block_factor(4.0, 0.02, np.full(6, 3.0))))
    rows, count = np.random.default_rng(1).normal(size=(6, 1000)), np.ones((6, 1000))
    np.testing.assert_allclose(slow.whiten(rows, count), slow.slow.whiten(rows / 2.0), rtol=1e-9)
    count[3, 100:200] = 0.0
    gone = slow.whiten(np.where(count > 0.0, rows, 0.0), count)
    assert not gone[3, 100:200].any()
    assert gone[3, 200:].all()
    change = np.cos(np.arange(1000) / 80.0) * np.ones((6, 1))
    np.testing.assert_allclose(
        slow.of_slow_change(slow.whiten(change, np.ones((6, 1000)))), change, rtol=1e-6, atol=1e-9
    )


def test_corners_within_a_fifth_are_alike() -> None:
    corners = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert model(corners).like(model(1.15 * corners))
    assert not model(corners).like(model(1.3 * corners))
    assert not model(corners).like(model(np.zeros(6)))
    assert not model(corners).like(dataclasses.replace(model(corners), coloured=(True,) * 6))
    assert not model(corners).like(dataclasses.replace(model(corners), innovation=2.1 * np.ones(6)))
    assert model(np.zeros(6)).slow is None


def test_workspace_reports_slow_noise_of_recording() -> None:
    ws = Workspace([observed(5.0, 1)])
    (reported,) = ws.provenance()
    assert reported['corners_hz'] == ws.noise[0].corners.tolist()
    assert ws.noise[0].corners == pytest.approx(np.full(6, 5.0), rel=0.4)
    assert ws.floor() > 1.2 * Workspace([observed(0.0, 1)]).floor()
    residual, _ = ws.residual(())
    assert float(residual @ residual) / ws.size == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize('corner', [0.3, 5.0])
def test_nothing_is_missing_from_slow_noise(corner: float) -> None:
    discovery = discover([observed(corner, 1)])
    assert discovery.verdict == 'nothing_missing'
    assert not discovery.setup


BAG = Path(__file__).parents[3] / 'bags' / 'clean'
ZERO_LOADS = np.repeat(
    np.array([(0, 0, 0), (0, -20, 0), (0, -50, -29), (30, 0, 0), (20, -40, 12), (0, 0, 0)], float), 6000, axis=0
)
ZERO = zero_variances(RIG)
OFF = np.sqrt(ZERO) * [0.3, -1.1, 1.6, -0.8]
"""An error that such a zero has."""


def recorded(*, taken: bool, rotated: float = 0.0) -> Observation:
    """A recording with a zero that is off, ``taken`` in it or not, of a rig with a detector ``rotated``, rad."""
    true = {'effects.e.name': 'sensor_rotation', 'effects.e.psd': 1, 'effects.e.angle': rotated} if rotated else {}
    volts = RigSimulator(replace_values(RIG, true), 3).step(ZERO_LOADS).counts * RIG.converter.volts_per_count
    zeros = {f'psd_{i + 1}.zero': OFF[2 * i : 2 * i + 2].tolist() for i in range(2)}
    o = Observation('x', replace_values(RIG, zeros), np.asarray(volts, dtype=np.float64), ZERO_LOADS)
    return replace(o, zero_variances=ZERO) if taken else o


@pytest.fixture(scope='module')
def faultless() -> Discovery:
    return discover([recorded(taken=True)])


@pytest.mark.slow
def test_residual_of_noisy_zero_is_nothing_unknown(faultless: Discovery) -> None:
    assert faultless.verdict == 'nothing_missing'
    assert not faultless.effects
    assert not faultless.unknown


@pytest.mark.slow
def test_the_same_constants_are_reported_if_no_zero_was_taken() -> None:
    discovery = discover([recorded(taken=False)])
    assert discovery.effects or discovery.unknown


def test_a_constant_is_whitened_by_what_the_zero_allows() -> None:
    """One standard deviation of a well seen constant leaves a residual of about one standard deviation of noise."""
    o = recorded(taken=True)
    ws = Workspace([o])
    free = with_free(Recorded((o,), RIG, ()), ws)
    constant = [np.zeros_like(t) for t in ws.measured]
    axis = 3
    constant[0][DOT_CHANNELS[axis]] = np.sqrt(ZERO[axis]) / RIG.sensitivities.ravel()[axis]
    observed = float(np.linalg.norm(ws.whiten(constant)))
    assert observed > 5.0
    assert np.linalg.norm(free.whiten(constant)) == pytest.approx(observed / np.hypot(1.0, observed), rel=1e-9)
    assert not free.free_loads
    assert free.refitted(ws.measured) is free


@pytest.mark.parametrize(
    ('changes', 'variances'),
    [
        ((), ()),
        (({'environment.temperature': 22.0},), ()),
        (({'psd_1.zero': (1e-6, 0.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0, 3.0, 4.0)},), (1.0, 2.0, 3.0, 4.0)),
        (({'state.zero_variances': (1.0, 2.0, 3.0, 4.0)}, {'psd_2.zero': (1e-6, 0.0)}), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': 'x'},), ZERO),
    ],
)
def test_zero_of_a_recording_has_variances(changes: Any, variances: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_recording(BAG)
    reported = [ParameterChange(0, i, tuple(c.items())) for i, c in enumerate(changes)]
    monkeypatch.setattr(recording, 'changes', reported)
    assert zero_variances_at_end(recording, RIG) == variances
    zeroed = replace_values(RIG, {'psd_1.zero': [1e-6, 0.0]})
    assert zero_variances_at_end(recording, zeroed) == (variances or ZERO)


def test_a_zero_that_gives_nothing_is_the_mean_of_half_a_second() -> None:
    per_sample = [s**2 * (n**2 + RIG.converter.volts_per_count**2 / 12) for s, n in _channels()]
    samples = ZERO_BLOCKS * RIG.estimator.block_size
    assert samples == 500
    np.testing.assert_allclose(ZERO, np.array(per_sample) / samples, rtol=1e-12)


def _channels() -> list[tuple[float, float]]:
    return list(zip(RIG.sensitivities.ravel().tolist(), RIG.noises[:, :2].ravel().tolist(), strict=True))


@pytest.mark.parametrize('sideways', [0.0, 3e-15, 1e-5])
def test_a_size_that_hardly_any_load_shows_stays_off(sideways: float) -> None:
    levels = [(0.0, 0.0, 0.0), *((sideways, -w, 0.0) for w in (20.0, 40.0, 10.0, 50.0, 30.0))]
    history = loads.steps(levels, 0.5).loads
    true = replace_values(RIG, {'effects.e.name': 'load_offset', 'effects.e.x': 0.005})
    volts = RigSimulator(true, 3).step(history).counts * RIG.converter.volts_per_count
    workspace = Workspace([Observation('x', RIG, np.asarray(volts, dtype=np.float64), history)], ())
    fitted = refit(workspace, [ActiveEffect(catalogue()['load_offset'], {'x': 0.001, 'y': -1.0})])
    (offset,) = fitted.effects
    assert offset.values['x'] == pytest.approx(0.005, abs=1e-4)
    assert offset.values['y'] == 0.0
    assert not fitted.at_bound
