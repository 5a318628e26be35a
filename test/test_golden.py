# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The golden recordings of ``bags/``: replayed on every run, held against their truth."""

import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.records import DeflectionEstimate, SpotMeans

BAGS = Path(__file__).parent.parent / 'bags'
LOST = {45, 46, 200, *range(1003, 1030), *range(2000, 2145), 3999}
WITHOUT_ESTIMATE = {
    'clean': {},
    # 3 and 11 of 20 are left of blocks 50 and 51; blocks 100 to 106 are gone altogether; 107 has 15.
    'lost_samples': {50: 'TOO_FEW_SAMPLES'},
    # Samples 1507 to 2522, so blocks 75 to 126.
    'laser_off': dict.fromkeys(range(75, 127), 'LASER_LOST'),
}
GONE = {'clean': set(), 'lost_samples': set(range(100, 107)), 'laser_off': set()}


def truth(name: str) -> npt.NDArray[np.float64]:
    """(200, 3): dX, dY, theta, means over each block."""
    with (BAGS / f'{name}_truth.csv').open() as stream:
        rows = list(csv.DictReader(stream))
    return np.array([[float(r[k]) for k in ('dx', 'dy', 'theta')] for r in rows])


@pytest.mark.parametrize('name', sorted(WITHOUT_ESTIMATE))
def test_a_golden_recording_gives_its_estimates_and_rejections(name: str) -> None:
    recording = open_recording(BAGS / name)
    assert recording.complete
    assert recording.hello is not None
    assert recording.hello['serial'] == 'GOLDEN'
    rig = rig_at_start(recording)
    pipeline = Pipeline(rig)
    records = [r for step in replayed(recording, pipeline) for r in step]
    best = {r.block: r for r in records if isinstance(r, DeflectionEstimate) and r.primary}
    spots = {r.index: r for r in records if isinstance(r, SpotMeans)}
    assert {i: s.status.name for i, s in spots.items() if s.reason} == WITHOUT_ESTIMATE[name]
    assert set(range(200)) - set(spots) == GONE[name]
    assert set(best) == set(spots) - set(WITHOUT_ESTIMATE[name])
    lost = sum(s.lost for s in spots.values()) + 20 * len(GONE[name])
    assert lost == (len(LOST) if name == 'lost_samples' else 0)
    # What was recorded is what comes out; to the last bits, which another processor may round elsewhere.
    for topic, solver in (('/link_tip/deflection', 'exact'), ('/link_tip/wls/deflection', 'wls')):
        recorded = recording.estimates()[topic]
        again = np.array([r[3:6] for r in records if isinstance(r, DeflectionEstimate) and r.solver == solver])
        np.testing.assert_allclose(recorded.pose, again, rtol=0, atol=1e-12)


def test_fresh_recording_replays_to_the_last_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = tmp_path / 'again'
    assert main(['replay', str(BAGS / 'lost_samples'), '--out', str(again)]) == 0
    assert main(['replay', str(again), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out


def test_compare_names_the_largest_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    amplifier:\n      sensitivity: 0.00051\n')
    assert main(['replay', str(BAGS / 'clean'), '--params-file', str(rig), '--compare']) == 1
    out = capsys.readouterr().out
    assert 'differ' in out
    assert '/link_tip/deflection ΔY (m)' in out


def test_a_zero_that_was_taken_while_recording_is_taken_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from psd_deflection.recordings.write.bag_writer import BagWriter
    from psd_deflection.records import RawChunk

    recording = open_recording(BAGS / 'clean')
    rig = rig_at_start(recording)
    pipeline = Pipeline(rig)
    folder = tmp_path / 'zeroed'
    with BagWriter(folder, rig_values=dict(rig.values)) as bag:
        for block in recording.blocks():
            for record in pipeline.process(RawChunk(block.seq, block.t_ns, block.volts, block.flags)):
                bag.put(record)
            if block.index in (20, 40):
                change = pipeline.zero()
                assert change is not None
                bag.put(change)
            if block.index == 150:
                bag.put(pipeline.change({'sum_min': 6.0}))
    assert main(['replay', str(folder), '--compare']) == 0
    out = capsys.readouterr().out
    assert 'no bit differs' in out
    assert '49 blocks, laser lost' in out


def test_csv_out_has_the_contracts_columns(tmp_path: Path) -> None:
    out = tmp_path / 'estimates.csv'
    assert main(['replay', str(BAGS / 'clean'), '--out', str(out)]) == 0
    with out.open() as stream:
        rows = list(csv.DictReader(stream))
    names = ['t', 'dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta']
    assert (list(rows[0])[:7], list(rows[0])[-4:]) == (names, ['chi_square', 'fx', 'fy', 'tz'])
    # The load at the tip, N.
    assert max(abs(float(r['fy'])) for r in rows) > 10.0
    # One number left of four readings and three unknowns: half of a chi-square is below 0.455, and means of a ringing
    # plate's dots give a little more.
    assert 0.3 < np.median([float(r['chi_square']) for r in rows]) < 0.9
    for solver in ('exact', 'wls', 'iterative'):
        assert {f'{solver}_dx', f'{solver}_dy', f'{solver}_theta'} <= set(rows[0])
    assert len(rows) == 200
    estimates = open_recording(BAGS / 'clean').estimates()['/link_tip/deflection'].pose
    np.testing.assert_allclose([float(r['dy']) for r in rows], estimates[:, 1], rtol=0, atol=1e-12)


LOSES = {'clean': 0, 'lost_samples': len(LOST), 'laser_off': 0, 'motion': 0, 'calibrated': 0, 'three_psds': 0}


@pytest.mark.parametrize('name', sorted(LOSES))
def test_a_golden_recording_replays_bit_for_bit(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """On every processor; with another numpy to rounding."""
    recording = open_recording(BAGS / name)
    if recording.made_with['numpy'] == np.__version__:
        assert main(['replay', str(BAGS / name), '--compare']) == 0
        assert 'no bit differs' in capsys.readouterr().out
    steps = replayed(recording, Pipeline(rig_at_start(recording)))
    again = [r[3:6] for step in steps for r in step if isinstance(r, DeflectionEstimate) and r.primary]
    np.testing.assert_allclose(recording.estimates()['/link_tip/deflection'].pose, again, rtol=0, atol=1e-12)


@pytest.mark.parametrize('name', sorted(LOSES))
def test_a_golden_recording_is_true_at_the_middle_of_its_blocks(name: str) -> None:
    recording = open_recording(BAGS / name)
    records = [r for step in replayed(recording, Pipeline(rig_at_start(recording))) for r in step]
    best = {r.block: r for r in records if isinstance(r, DeflectionEstimate) and r.primary}
    spots = {r.index: r for r in records if isinstance(r, SpotMeans)}
    assert 4000 - sum(s.present for s in spots.values()) == LOSES[name]
    expected = truth(name)
    # A load that is switched inside a block has no value at its middle: the block and the next are left out.
    full = [i for i in best if spots[i].present == 20 and i % 50 > 1]
    assert len(full) > 120
    error = np.array([best[i][3:6] for i in full]) - expected[full]
    sd = np.sqrt([np.array(best[i].covariance)[[0, 4, 8]] for i in full])
    # The mean of the truth over a block is not its value in the middle while the link rings: some per cent of it.
    still = [k for k, i in enumerate(full) if i < 50]
    ratio = np.sqrt((error[still] ** 2).mean(axis=0) / (sd[still] ** 2).mean(axis=0))
    assert (ratio < 1.3).all()
