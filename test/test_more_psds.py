# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rigs of three and more PSDs from the rig file to the estimate: by truth, with one PSD failing, bit for bit again."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from msg_adapters import point_cloud2, to_messages
from psd_deflection.base.errors import ConfigError, PsdDeflectionError, RecordingError
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.formats.format import open_sink
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import (
    MOST_PSDS,
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    Record,
    SampleBlock,
    TipLoad,
    channel_names,
)
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.run.session_texts import zero_text
from test.streams import COUNT, chunk
from test.streams import spots as spots_of

Counts = npt.NDArray[np.int32]
Spoil = Callable[[Counts], None]
THREE = Path(__file__).parents[1] / 'config' / 'three_psds.yaml'
LEVEL = {'psd_1.height': 0.0, 'psd_2.height': 0.0}
FOURTH = {'psd_4.center': [-0.06, -0.06], 'psd_4.height': -0.04}


@pytest.fixture(scope='module')
def three() -> Rig:
    return load_rig(THREE)


def with_solver(rig: Rig, solver: str, **more: object) -> Rig:
    return replace_values(rig, {'solver': solver, 'solvers': [solver], **more})


def primaries(records: Sequence[Record]) -> list[DeflectionEstimate]:
    return [r for r in records if isinstance(r, DeflectionEstimate) and r.primary]


def at_rest(rig: Rig, dots: FloatArray, n: int, seed: int) -> Counts:
    """Counts of ``n`` samples of the dots (2P,), m, with 2 mV of noise on every channel."""
    volts = np.full(3 * len(rig.psds), 5.0)
    for i in range(len(rig.psds)):
        volts[3 * i : 3 * i + 2] = dots[2 * i : 2 * i + 2] / 5e-4
    noisy = volts + np.random.default_rng(seed).normal(0.0, 2e-3, (n, len(volts)))
    return np.rint(noisy / COUNT).astype(np.int32)


@pytest.mark.slow
def test_third_psd_defaults_are_filled_and_round_trip(three: Rig) -> None:
    assert three.psds[2].center == (0.08, -0.06)
    assert (three.psds[2].height, three.beams[2].angle, three.psds[2].axes) == (0.0, (0.0, 0.0), ('x', 'y'))
    assert load_rig(overrides=three.flat()) == three
    assert f'psd_3.zero {[0.0, 0.0]}' in ' '.join(f'{p.name} {three.values[p.name]}' for p in three.parameters)
    assert zero_text(three).endswith('psd_3 (0.0000, 0.0000)')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'psd_4.center': [0.0, -0.07]}, 'psd_4.center is given without psd_3.center'),
        ({'psd_3.height': 0.01}, 'psd_3.height is given without psd_3.center'),
        ({'beam_3.angle': [0.0, 0.001]}, 'beam_3.angle is given without psd_3.center'),
        ({f'psd_{MOST_PSDS + 1}.center': [0.0, 0.0]}, f'psd_{MOST_PSDS + 1}.center'),
        ({'psd_3.center': [0.08, 0.0], 'psd_3.axes': ['x', '-x']}, 'must name x once and y once'),
    ],
)
def test_a_gap_and_a_psd_without_a_place_are_rejected_by_name(values: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rig(overrides=values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'solvers': ['pose', 'minimum_tilt']}, 'minimum_tilt takes two PSDs.*pose'),
        ({'solvers': ['pose', 'appendix_d']}, 'appendix_d takes two PSDs.*pose'),
        ({'solvers': ['pose', 'wls'], 'wls.weights': 'thesis'}, 'wls.weights = thesis.*inverse_variance'),
        ({'effects.sensor_gain.psd': 4, 'effects.sensor_gain.x': 0.01}, 'psd = 4: the rig has 3 PSDs'),
        ({'calibration.names': ['psd_1.rotation'], 'calibration.sds': [0.001]}, 'psd_3.center is given: a calibration'),
    ],
)
def test_what_is_made_for_two_is_rejected(three: Rig, changes: dict[str, object], words: str) -> None:
    with pytest.raises(PsdDeflectionError, match=words):
        Pipeline(replace_values(three, changes))


def test_samples_of_three_psds_are_none_of_a_rig_of_two(three: Rig) -> None:
    with pytest.raises(ConfigError, match='the samples are of 3 PSDs, the rig file has 2 '):
        list(Pipeline(load_rig()).process(chunk(at_rest(three, np.zeros(6), 20, 1))))


FAILS = 1800


def dark(psd: int) -> Spoil:
    def spoil(counts: Counts) -> None:
        counts[FAILS:, 3 * psd : 3 * psd + 3] %= 13

    return spoil


def saturated(psd: int) -> Spoil:
    def spoil(counts: Counts) -> None:
        counts[FAILS:, 3 * psd] = 32767

    return spoil


def stuck(psd: int) -> Spoil:
    def spoil(counts: Counts) -> None:
        counts[FAILS:, 3 * psd : 3 * psd + 3] = counts[FAILS - 1, 3 * psd : 3 * psd + 3]

    return spoil


def inverted(psd: int) -> Spoil:
    def spoil(counts: Counts) -> None:
        counts[FAILS:, 3 * psd + 1] *= -1

    return spoil


PUSHED = loads.steps([(0.0, 0.0, 0.0), (0.0, -30.0, -5.0), (10.0, 10.0, 5.0)], 1.2)


def run(rig: Rig, spoil: Spoil | None = None) -> tuple[list[Record], FloatArray, Pipeline]:
    """The records of a link that is pushed and rings, and its true poses in the middle of the blocks."""
    simulated = RigSimulator(rig, 3).step(PUSHED.loads)
    counts = simulated.counts.copy()
    if spoil is not None:
        spoil(counts)
    pipeline = Pipeline(rig)
    records = list(pipeline.process(chunk(counts)))
    middle = np.arange(9, len(counts), 20)
    p = simulated.pose
    return records, (9.0 * (p[middle] + p[middle + 1]) - p[middle - 1] - p[middle + 2]) / 16.0, pipeline


def deviations(records: Sequence[Record], truth: FloatArray) -> FloatArray:
    """|error| over its own standard deviation, (n, 3), of the primary estimates."""
    estimates = primaries(records)
    errors = np.array([e.pose for e in estimates]) - truth[[e.block for e in estimates]]
    return np.asarray(np.abs(errors) / np.sqrt([e.variances for e in estimates]))


def assert_inside(records: Sequence[Record], truth: FloatArray) -> None:
    """As good as two PSDs while the link rings: 99 % within three standard deviations, none far out."""
    ratios = deviations(records, truth)
    assert (ratios < 3.0).mean() > 0.99
    assert ratios.max() < 6.0


@pytest.mark.slow
@pytest.mark.parametrize(('solver', 'more'), [('exact', LEVEL), ('pose', {})])
@pytest.mark.parametrize(('fault', 'psd'), [(dark, 0), (saturated, 2)])
def test_without_one_psd_the_estimate_goes_on_from_the_others(
    three: Rig, solver: str, more: dict[str, object], fault: Callable[[int], Spoil], psd: int
) -> None:
    rig = with_solver(three, solver, **more)
    records, truth, pipeline = run(rig, fault(psd))
    estimates, spots = primaries(records), spots_of(records)
    assert len(estimates) == len(spots) == 180
    assert_inside(records, truth)
    after = [s for s in spots if s.index * 20 >= FAILS]
    assert {s.excluded for s in after} == {(psd + 1,)}
    assert {s.status for s in after} == {BlockStatus.LASER_LOST if fault is dark else BlockStatus.SATURATED}
    assert pipeline.counters.degraded == len(after) == 90
    assert sum(isinstance(r, TipLoad) for r in records) == 180
    # What is left says less, and its own check has two degrees of freedom less: one, or none.
    before = np.mean([e.variances for e in estimates[50:90]], axis=0)
    assert (np.mean([e.variances for e in estimates[-50:]], axis=0) > 1.1 * before).all()
    squares = np.array([e.chi_square for e in estimates[-80:]])
    assert np.isnan(squares).all() if solver == 'pose' else 0.5 < squares.mean() < 1.6
    topics = {m.topic for m in to_messages(after[-1])}
    assert topics == {f'/psd_{n}/spot' for n in (1, 2, 3) if n != psd + 1}


@pytest.mark.slow
@pytest.mark.parametrize(('fault', 'psd'), [(stuck, 1), (inverted, 0), (inverted, 2)])
def test_a_psd_that_contradicts_the_others_is_named_and_left_out(
    three: Rig, fault: Callable[[int], Spoil], psd: int
) -> None:
    rig = with_solver(three, 'exact', **LEVEL)
    records, truth, pipeline = run(rig, fault(psd))
    estimates, spots = primaries(records), spots_of(records)
    assert len(estimates) == 180
    assert_inside(records, truth)
    excluded = [s.excluded for s in spots if s.index * 20 >= FAILS]
    assert excluded.count((psd + 1,)) > 30
    assert excluded.count((psd + 1,)) + excluded.count(()) == 90
    assert not any(s.excluded for s in spots if s.index * 20 < FAILS)
    assert pipeline.estimator.most_likely_wrong() == f'psd_{psd + 1} does not fit the others and is left out'
    assert f'psd_{psd + 1} contradicts the others and is left out' in pipeline.counters.findings
    good = [e.chi_square for e, s in zip(estimates, spots, strict=True) if s.excluded]
    assert np.mean(good) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize('psd', [0, 2])
def test_one_degree_of_freedom_blames_no_psd(three: Rig, psd: int) -> None:
    records, truth, pipeline = run(three, inverted(psd))
    assert len(primaries(records)) == 180
    assert_inside(records, truth)
    assert pipeline.estimator.contradictions > 60
    assert pipeline.estimator.most_likely_wrong() == ''


def test_frozen_psd_is_not_the_psd_that_contradicts(three: Rig) -> None:
    """At rest PSD 1 is 1 mm off; PSD 3 does not move by a bit, as a quiet one may."""
    rig = with_solver(three, 'exact', **LEVEL)
    counts = at_rest(rig, np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]), 200, 1)
    counts[:, 6:] = np.rint(np.array([0.0, 0.0, 5.0]) / COUNT)
    pipeline = Pipeline(rig)
    spots = spots_of(list(pipeline.process(chunk(counts))))
    assert {s.excluded for s in spots} == {(1,)}
    assert (pipeline.counters.estimates, pipeline.counters.degraded) == (10, 10)
    assert pipeline.counters.findings['psd_3 stands still'] == 6


@pytest.mark.parametrize(('still', 'place'), [(0, [-0.1, 0.0]), (1, [-0.1, 0.0]), (1, [0.0, 0.07])])
def test_of_two_outlier_candidates_the_frozen_one_is_excluded(three: Rig, still: int, place: list[float]) -> None:
    """PSD 1 or PSD 2 is off across its base line to PSD 3, so that either may be wrong: PSD 3 is not, even if the
    first two are in one place and say nothing without it."""
    rig = with_solver(three, 'exact', **LEVEL, **{'psd_2.center': place})
    dots, along = np.zeros(6), rig.centers[still] - rig.centers[2]
    dots[2 * still : 2 * still + 2] = 1e-4 * np.array([-along[1], along[0]]) / np.hypot(*along)
    counts = at_rest(rig, dots, 200, 1)
    counts[:, 3 * still : 3 * still + 3] = counts[0, 3 * still : 3 * still + 3]
    pipeline = Pipeline(rig)
    excluded = [s.excluded for s in spots_of(list(pipeline.process(chunk(counts))))]
    assert excluded == [()] * 4 + [(still + 1,)] * 6
    assert pipeline.counters.findings[f'psd_{still + 1} contradicts the others and is left out'] == 6


@pytest.mark.slow
def test_reject_rejects_only_what_cannot_be_reported(three: Rig) -> None:
    report, _, _ = run(with_solver(three, 'exact', consistency='reject', **LEVEL), inverted(2))
    assert len(primaries(report)) > 110
    not_reported, _, pipeline = run(replace_values(three, {'consistency': 'reject'}), inverted(2))
    assert pipeline.counters.rejected['inconsistent'] > 60
    assert spots_of(not_reported)[-1].status is BlockStatus.INCONSISTENT
    assert spots_of(not_reported)[-1].reason.startswith('the readings contradict each other')
    reported, _, pipeline = run(with_solver(three, 'exact', consistency='report', **LEVEL), inverted(2))
    assert len(primaries(reported)) == 180
    assert not any(s.excluded for s in spots_of(reported))
    assert pipeline.estimator.contradictions > 60


@pytest.mark.slow
def test_with_one_psd_left_the_rule_for_one_holds(three: Rig) -> None:
    def two_dark(counts: Counts) -> None:
        dark(0)(counts)
        dark(1)(counts)

    records, _, pipeline = run(with_solver(three, 'exact', **LEVEL), two_dark)
    assert len(primaries(records)) == 90
    assert pipeline.counters.rejected == {'laser_lost': 90}
    records, truth, _ = run(with_solver(three, 'exact', degraded='hold', **LEVEL), two_dark)
    assert {e.solver for e in primaries(records)[90:]} == {'one_psd'}
    assert_inside(records, truth)


@pytest.mark.parametrize('psd', [0, 1, 2])
def test_each_of_three_may_be_the_last(three: Rig, psd: int) -> None:
    """The tip is 1 mm off and not turned: so are the dots, the other way."""
    rig = with_solver(three, 'exact', degraded='zero', **LEVEL)
    counts = at_rest(rig, np.tile([-1e-3, 2e-3], 3), 20, 1)
    for other in {0, 1, 2} - {psd}:
        counts[:, 3 * other : 3 * other + 3] = 0
    (estimate,) = primaries(list(Pipeline(rig).process(chunk(counts))))
    assert estimate.solver == 'one_psd'
    assert estimate.pose == pytest.approx((1e-3, -2e-3, 0.0), abs=2e-6)


def test_two_of_four_may_fail_one_after_the_other(three: Rig) -> None:
    def spoil(counts: Counts) -> None:
        dark(3)(counts)
        counts[2400:, 1] *= -1

    rig = with_solver(three, 'exact', **LEVEL, **{**FOURTH, 'psd_4.height': 0.0})
    records, truth, pipeline = run(rig, spoil)
    assert_inside(records, truth)
    assert spots_of(records)[100].excluded == (4,)
    assert spots_of(records)[-1].excluded == (1, 4)
    assert pipeline.estimator.most_likely_wrong() == 'psd_1 and psd_4 does not fit the others and is left out'


@pytest.mark.slow
@pytest.mark.parametrize(('solver', 'reading'), [('pose', 1), ('pose', 5), ('exact', 3)])
def test_a_reading_that_drifts_slowly_is_held_by_the_covariance(three: Rig, solver: str, reading: int) -> None:
    """A micrometre a second, from the fifth second on. One degree of freedom names nothing."""
    n = 14_000
    dots = np.zeros((n, 6))
    dots[:, reading] = 1e-9 * np.maximum(np.arange(n) - 4000, 0)
    volts = np.full((n, 9), 5.0)
    for psd in range(3):
        volts[:, 3 * psd : 3 * psd + 2] = dots[:, 2 * psd : 2 * psd + 2] / 5e-4
    noisy = volts + np.random.default_rng(0).normal(0.0, 2e-3, volts.shape)
    counts = np.rint(noisy / COUNT).astype(np.int32)
    estimates = primaries(list(Pipeline(with_solver(three, solver)).process(chunk(counts))))[200:]
    off = np.abs([e.pose for e in estimates]) / np.sqrt([e.variances for e in estimates])
    assert off.max() < 7.0
    assert (off < 1.96).mean(axis=0).min() > 0.93


@pytest.mark.slow
def test_recording_of_three_psds_replays_bit_for_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ['--params-file', str(THREE), '--loads', 'steps:0,0,0;0,-20,-4:0.6']
    assert main(['simulate', *words, '--out', str(tmp_path / 'a')]) == 0
    assert main(['replay', str(tmp_path / 'a'), '--out', str(tmp_path / 'b.mcap')]) == 0
    assert main(['replay', str(tmp_path / 'b.mcap'), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    bag = open_recording(tmp_path / 'b.mcap')
    assert bag.psds == 3
    assert bag.samples.dtype.names is not None
    assert bag.samples.dtype.names[3:12] == channel_names(3)
    assert '/psd_3/spot' in bag.topics()
    # The same samples as a CSV, which names no rig.
    assert main(['convert', str(tmp_path / 'b.mcap'), '--out', str(tmp_path / 'c.csv')]) == 0
    csv = open_recording(tmp_path / 'c.csv')
    assert csv.psds == 3
    assert all((csv.samples[c] == bag.samples[c]).all() for c in channel_names(3))
    assert main(['replay', str(tmp_path / 'c.csv')]) == 3
    assert 'samples of 3 PSDs, the rig file has 2' in capsys.readouterr().err
    assert main(['replay', str(tmp_path / 'c.csv'), '--params-file', str(THREE)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ('header', 'words'),
    [
        ('t,x1,y1,sum1,x2,y2,sum2,x3,sum3', 'has x3, sum3 without y3'),
        ('t,x1,y1,sum1,x2,y2,sum2,x4,y4,sum4', 'without x3, y3, sum3'),
        ('t,x1,y1,sum1', 'the header lacks x2, y2, sum2'),
    ],
)
def test_a_csv_with_part_of_a_psd_is_rejected(tmp_path: Path, header: str, words: str) -> None:
    path = tmp_path / 'a.csv'
    path.write_text('\n'.join([header, '0,' + '0,' * (header.count(',') - 1) + '0']))
    with pytest.raises(RecordingError, match=words):
        open_recording(path)


@pytest.mark.slow
def test_a_bag_whose_number_of_psds_changes_is_rejected(tmp_path: Path, three: Rig) -> None:
    blocks = []
    for index, rig in enumerate((three, load_rig())):
        counts = RigSimulator(rig).step(np.zeros((20, 3))).counts
        seq = np.arange(20) + 20 * index
        flags = np.zeros(20, np.uint8)
        blocks.append(SampleBlock(index, seq, seq * 1_000_000 + 1, (counts * COUNT).astype(np.float32), flags))
    with contextlib.closing(open_sink(tmp_path / 'a.mcap', three.flat())) as sink:
        for block in blocks:
            sink.put(block)
    with pytest.raises(RecordingError, match='has 2 PSDs, the samples before have 3'):
        list(open_recording(tmp_path / 'a.mcap').blocks())


def test_the_cloud_of_two_is_as_it_was() -> None:
    names = ('seq', 'dt', 'x1', 'y1', 'sum1', 'x2', 'y2', 'sum2', 'flags', 'seq_high')
    assert point_cloud2.point_of(2) == point_cloud2.point_of(2, 0)
    for more in range(3):
        dtype = point_cloud2.point_of(2, more)
        assert dtype.names == names[: 8 + more]
        assert dtype.itemsize == 32 + 4 * more
    assert [point_cloud2.point_of(n).itemsize for n in (3, MOST_PSDS)] == [44, 8 + 12 * MOST_PSDS]


def test_a_zero_is_of_all_psds(three: Rig) -> None:
    zeros = {'psd_1.zero': [1e-4, -1e-4], 'psd_2.zero': [0.0, 2e-4], 'psd_3.zero': [-3e-4, 1e-4]}
    counts = RigSimulator(replace_values(three, zeros), 2).step(np.zeros((600, 3))).counts
    pipeline = Pipeline(three)
    list(pipeline.process(chunk(counts)))
    taken = pipeline.zero()
    assert taken is not None
    values = dict(taken.values)
    for name, wanted in zeros.items():
        assert values[name] == pytest.approx(wanted, abs=1e-6)
    assert [e.pose for e in primaries(list(pipeline.process(chunk(counts, 600))))][-1] == pytest.approx(
        (0.0, 0.0, 0.0), abs=5e-6
    )


STUDIES: dict[str, list[str]] = {
    'budget': ['--params-file', str(THREE)],
    'design': ['--params-file', str(THREE)],
    **{name: ['{three}'] for name in ('calibrate', 'check', 'discover', 'identify', 'validate')},
}
"""What each study is asked of a rig of three PSDs."""
OF_NO_RIG = {'certificate', 'effects', 'thesis'}


@pytest.mark.slow
def test_every_study_takes_a_rig_of_three_psds_or_says_why_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = (Path(__file__).parents[1] / 'psd_deflection' / 'cli' / 'studies').glob('[a-z]*.py')
    assert {c.stem for c in commands} == {*STUDIES, *OF_NO_RIG}
    three = tmp_path / 'three'
    run = ['simulate', '--params-file', str(THREE), '--out', str(three), '--loads', 'steps:0,0,0;0,-20,0;30,0,0:2']
    assert main(run) == 0
    for name, given in STUDIES.items():
        out = [] if name in ('budget', 'design', 'check', 'validate') else ['--out', str(tmp_path / name)]
        capsys.readouterr()
        code = main([name, *(a.format(three=three) for a in given), *out])
        message = capsys.readouterr().err
        assert code == 0 or (code in (3, 4) and ('PSDs' in message or 'reference' in message)), (name, code, message)
