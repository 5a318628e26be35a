# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What vibrates faster than a block: found by its tone, not taken for noise, and never seen where there is none."""

import json
from pathlib import Path

import numpy as np
import pytest

from blind import generator
from blind.coverage import LOSSES, ROWS, Row, drifting, motion, rig, run, score, shaken, volts_of
from blind.generator import present
from psd_deflection.cli.main import main
from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_estimator import VIBRATION
from psd_deflection.measure.uncertainty.block_fit import BlockFit
from psd_deflection.measure.uncertainty.drift import Drift
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.vibration import Tone, Tones, ToneSearch, rms_of, words_of
from psd_deflection.records import FloatArray, IntArray, RawChunk, Record, TipMotion
from psd_deflection.rig.config import Rig, load_rig

SIZE, RATE = 20, 1000.0
N = SIZE * SEGMENT_BLOCKS
TURN = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]])
ALL = np.arange(N)


def tone(hz: float, phase: float = 0.3, places: IntArray = ALL) -> FloatArray:
    return np.asarray(np.sin(2.0 * np.pi * hz / RATE * places + phase))


def noise(seed: int, columns: int = 2, n: int = N) -> FloatArray:
    return 1e-6 * np.random.default_rng(seed).normal(size=(n, columns))


def moving_tones(moving: FloatArray, still: FloatArray, places: IntArray = ALL, **of: tuple[float, ...]) -> list[Tone]:
    return list(ToneSearch(SIZE, SEGMENT_BLOCKS).tones(places, moving @ TURN, still, TURN, **of).moving)


@pytest.mark.parametrize('hz', [26.0, 36.4, 47.0, 87.0, 130.4, 300.0, 480.0])
def test_a_tone_is_found_with_its_frequency_and_its_covariance(hz: float) -> None:
    amplitudes = np.array([5e-6, -2e-6])
    (peak,) = moving_tones(noise(1) + tone(hz)[:, None] * amplitudes, noise(2))
    assert peak.frequency * RATE == pytest.approx(hz, abs=0.1)
    want = TURN.T @ np.outer(amplitudes, amplitudes) @ TURN / 2.0
    np.testing.assert_allclose(peak.covariance, want, rtol=0.05, atol=6e-13)


def test_two_tones_are_two_and_what_does_not_take_part_stays_out() -> None:
    moving = noise(1)
    moving[:, 0] += 3e-6 * tone(87.0)
    moving[:, 1] += 9e-6 * tone(180.0)
    second, first = sorted(moving_tones(moving, noise(2)), key=rms_of)
    assert [round(t.frequency * RATE) for t in (first, second)] == [180, 87]
    np.testing.assert_allclose(first.covariance, np.outer(TURN[1], TURN[1]) * 9e-6**2 / 2.0, rtol=0.05, atol=1e-20)
    assert words_of((first, second), RATE) == '5.1 µm rms near 180 Hz, 1.7 µm rms near 87 Hz'
    assert words_of((Tone(0.087, np.eye(4) * 200e-12),), RATE) == '14 µm rms near 87 Hz'
    # What is within a twenty-fifth of the frequency belongs to it: 3 um at 312 Hz, of whose lobe 5/6 are within.
    wide = noise(1) + (9e-6 * tone(300.0) + 3e-6 * tone(312.0))[:, None] * (1.0, 0.0)
    strongest = max(moving_tones(wide, noise(2)), key=rms_of)
    assert TURN[0] @ strongest.covariance @ TURN[0] == pytest.approx((81.0 + 9.0 / 1.2) * 0.5e-12, rel=0.015)


def test_the_floor_of_a_tone_is_that_about_it() -> None:
    """Noise whose power falls to 1e-4 at 222 Hz: in its quiet half a tone of 2 um stands out, in its loud half not."""
    spectrum = (
        np.random.default_rng(4).normal(size=(2, N // 2 + 1, 2))
        * np.where(np.arange(N // 2 + 1) < 222, 1.0, 0.01)[:, None]
    )
    moving = 1e-3 * np.fft.irfft(spectrum[0] + 1j * spectrum[1], axis=0)
    for hz, names in ((247.0, [247]), (197.0, [])):
        assert [round(t.frequency * RATE) for t in moving_tones(moving + 2e-6 * tone(hz)[:, None], noise(2))] == names


def test_a_tone_lasts_until_it_is_below_twelve_times_the_floor() -> None:
    """White noise of 1 um: 0.33 um are 24 times the floor, 0.24 um 13. Both are too weak to be found, enough to stay;
    and 0.33 um is confirmed if it was almost there before."""
    for um, hz, stays in ((0.33, 87.0, 1), (0.33, 93.0, 0), (0.24, 87.0, 1), (0.2, 87.0, 0), (0.33, 90.0, 1)):
        moving = noise(1) + um * 1e-6 * tone(87.0)[:, None]
        assert not moving_tones(moving, noise(2))
        counts = [len(moving_tones(moving, noise(2), ALL, **{past: (hz / RATE,)})) for past in ('known', 'candidates')]
        assert counts == [stays, (um, hz) == (0.33, 87.0)]
    for um, hz in ((0.45, 87.0), (0.55, 498.0)):  # The last bin but one.
        assert moving_tones(noise(1) + um * 1e-6 * tone(hz)[:, None], noise(2))
    # A strong one elsewhere is found beside it.
    both = noise(1) + 0.33e-6 * tone(87.0)[:, None] + 3e-6 * tone(200.0)[:, None]
    assert [round(t.frequency * RATE) for t in moving_tones(both, noise(2), known=(0.087,))] == [200, 87]


def test_a_block_reports_the_tones_that_widen_it() -> None:
    places = np.array([[0.0, 0.070], [-0.100, 0.0]])
    gamma = np.zeros((4, 4, SIZE))
    gamma[range(4), range(4), 0] = 1e-12
    fit = BlockFit(SIZE, places, places)
    still = np.zeros((SIZE, 4))
    for share, named in ((0.9, ()), (1.1, (1,))):
        # Of x of the middle: a mean of 20 has 5e-14 m^2, and a fifth of it all is 1.25e-14.
        weak = np.outer([1.0, 0.0, 1.0, 0.0], [1.0, 0.0, 1.0, 0.0]) * 0.5 * 1.25e-14 * share
        fit.set_noise(gamma, [Tone(0.35, weak * 1e-3), Tone(0.4, weak)])
        assert fit.fit(ALL[:SIZE], still).vibrating == named


@pytest.mark.parametrize('loss', ['none', '20 %'])
def test_a_ringing_link_is_not_called_vibrating(loss: str) -> None:
    """14 and 21 Hz make a tone of 35 Hz in the dots, which the fit follows, and samples lost one by one make more."""
    clean, truth = motion(4, 4)
    got = run(Pipeline(rig(ROWS[0])), volts_of(ROWS[0], clean, 1), truth, present(len(clean), 1001, *LOSSES[loss]))
    assert sum('vibrates' in f for f in got.findings) < 0.03 * len(got.findings)
    # The plate moves faster than 20 samples show only after a step of the load.
    assert 4 <= sum(f == 'moves: faster than 20 samples show' for f in got.findings) < 0.1 * len(got.findings)


@pytest.mark.slow
@pytest.mark.parametrize(('hz', 'size'), [(28.0, 0.05), (36.0, 0.05), (44.0, 0.15), (36.0, 0.15)])
def test_a_weak_tone_below_a_cycle_a_block_is_covered(hz: float, size: float) -> None:
    """Of 1 and 3 um in dY: at 36 Hz and 1 um 0.70 of the intervals of dY held the truth."""
    s = shaken(hz, seconds=12, size=size).inside(200)
    assert min(*s.axes, s.joint) > 0.93
    assert s.three > 0.995


@pytest.mark.parametrize('share', [0.15, 1.0])
def test_hum_in_what_cannot_move_is_no_motion(share: float) -> None:
    moving = noise(1) + 5e-6 * tone(50.0)[:, None]
    assert moving_tones(moving, noise(2))
    assert not moving_tones(moving, noise(2) + share * 5e-6 * tone(50.0)[:, None])
    # A sound rig leaks some of a motion into them.
    assert moving_tones(moving, noise(2) + 0.05 * 5e-6 * tone(50.0)[:, None])


def test_hum_is_taken_off_with_its_phase_in_each_reading() -> None:
    cosine, sine = np.array([3e-6, -1e-6, 0.0]), np.array([1e-6, 2e-6, 4e-6])
    angle = 2.0 * np.pi * 0.0503 * ALL[:, None]
    hum = cosine * np.cos(angle) + sine * np.sin(angle)
    # Beside a motion of a tenth of a millimetre at 14 Hz, with every seventh sample lost.
    plain = noise(3, 3) + 1e-4 * tone(14.0)[:, None] + 1e-3
    here = np.flatnonzero(ALL % 7 != 3)
    rest, removed = ToneSearch(SIZE, SEGMENT_BLOCKS).without(here, (plain + hum)[here], 0.0503)
    np.testing.assert_allclose([removed.cosine, removed.sine], [cosine, sine], atol=3e-7)
    assert np.abs(rest - plain[here]).max() < 6e-7
    lags = removed.autocovariance(SIZE)
    expected = np.stack([hum[:-SIZE].T @ hum[lag : lag - SIZE] for lag in range(SIZE)], axis=2) / (N - SIZE)
    np.testing.assert_allclose(lags, expected, atol=1.5e-12)


def band_noise(first: int, last: int, seed: int = 5) -> FloatArray:
    """Random, of 1 rms, with the bins from ``first`` to ``last`` alone."""
    rng, spectrum = np.random.default_rng(seed), np.zeros(N // 2 + 1, complex)
    spectrum[first:last] = rng.normal(size=last - first) + 1j * rng.normal(size=last - first)
    out = np.fft.irfft(spectrum)
    return np.asarray(out / out.std())


def test_readings_that_vary_together_in_a_band_vibrate() -> None:
    readings, still = noise(1, 4), noise(2)
    together = np.array([2e-6, 0.0, 2e-6, 0.0])
    search, identity = ToneSearch(SIZE, SEGMENT_BLOCKS), np.eye(4)
    shaken = readings + band_noise(120, 155)[:, None] * together

    def of(dots: FloatArray, beside: FloatArray, known: tuple[float, ...] = ()) -> tuple[Tone, ...]:
        return search.tones(ALL, dots, beside, identity, known).moving

    (band,) = of(shaken, still)
    assert band.frequency * RATE == pytest.approx(136.5, abs=25.0)
    np.testing.assert_allclose(band.covariance, np.outer(together, together), atol=1.2e-12)
    assert of(readings, still) == ()
    # Two readings of one PSD may have one supply, and so may all the electronics.
    assert of(readings + band_noise(120, 155)[:, None] * (2e-6, 2e-6, 0.0, 0.0), still) == ()
    assert of(shaken, still + band_noise(120, 155, 6)[:, None] * 2e-6) == ()
    # What is weak is believed where it vibrated before, and below 62 Hz the fit follows.
    weak = readings + band_noise(120, 155)[:, None] * together * 0.22
    assert of(weak, still) == () != of(weak, still, (0.130,))
    assert all(np.linalg.eigvalsh(t.covariance)[0] > -1e-27 for t in of(weak, still, (0.130,)))
    slow, fast = (of(readings + band_noise(*band)[:, None] * together, still) for band in ((15, 44), (64, 90)))
    assert (slow, len(fast)) == ((), 1)
    # A tone beside it is told apart.
    both = of(shaken + 9e-6 * tone(139.0)[:, None] * (1.0, 0.0, 1.0, 0.0), still)
    assert [round(t.frequency * RATE, -1) for t in both] == [140.0, 140.0]
    assert rms_of(both[0]) == pytest.approx(9e-6 / 2.0**0.5, rel=0.1)
    assert rms_of(both[1]) == pytest.approx(2e-6, rel=0.25)


@pytest.mark.parametrize('hz', [50.0, 60.0])
def test_hum_leaves_the_intervals_as_they_are(hz: float) -> None:
    """10 mV, not the same on all channels. Of 60 Hz the fit followed 2.9 um and said 0.44."""
    s = score(Row('hum', hum=10e-3, mains=hz), 'none', rest_s=12, steps=1)
    assert min(*s.rest.axes, s.rest.joint) > 0.92
    assert s.rest.rms[1] < 0.25e-6
    # Ringing at exactly 50 Hz, each block meets the same phase: 0.86 are inside.
    assert s.rest.named == s.ringing.named == 1.0


def test_slow_motion_steps_and_regular_gaps_make_no_tone() -> None:
    slow = 1e-3 * np.stack((tone(14.0), np.where(ALL > 433, 1.0, -0.4)), axis=1)
    assert not moving_tones(noise(1) + slow, noise(2))
    # Every tenth sample lost makes a tone of 100 Hz of any slow motion that is not bridged.
    here = np.flatnonzero(ALL % 10 != 3)
    ramp = 2e-2 * np.stack((ALL / N, (ALL / N) ** 2), axis=1)
    assert not moving_tones((noise(1) + ramp)[here], noise(2)[here], here)
    # Lines across gaps left 30 um.
    assert not moving_tones((noise(1) + slow)[here], noise(2)[here], here)
    # What is slower than half a cycle a block is followed, and at half the sample rate both halves of a tone are one.
    assert not moving_tones(noise(1) + 5e-6 * tone(22.0)[:, None], noise(2))
    assert not moving_tones(noise(1) + 5e-6 * (-1.0) ** ALL[:, None], noise(2))


def test_too_short_segments_have_no_tones() -> None:
    assert ToneSearch(2, SEGMENT_BLOCKS).tones(ALL[:100], noise(1, 3, 100), noise(2, n=100), TURN) == Tones()
    assert moving_tones(noise(1, n=1), noise(2, n=1), ALL[:1]) == []


def test_a_tone_with_gaps_is_no_smaller() -> None:
    here = np.sort(np.random.default_rng(3).choice(N, 800, replace=False))
    (measured,) = moving_tones((noise(1) + 5e-6 * tone(87.0)[:, None])[here], noise(2)[here], here)
    assert 1.0 <= rms_of(measured) / (5e-6 / 2.0**0.5 * np.abs(TURN.sum(axis=0)).max()) < 1.3


@pytest.mark.parametrize('lost', [(), (2, 3, 11, 12)])
def test_the_fit_states_what_it_leaves_of_a_tone(lost: tuple[int, ...]) -> None:
    """Sinusoids of every phase through the fit: their mean square error is what the covariance grows by."""
    places = np.array([[0.0, 0.070], [-0.100, 0.0]])
    gamma = np.zeros((4, 4, SIZE))
    gamma[range(4), range(4), 0] = 1e-12
    slots = np.delete(np.arange(SIZE), lost)
    direction = np.array([1.0, 0.2, 1.0, 0.2]) * 1e-9
    hz = 87.0
    fit = BlockFit(SIZE, places, places)
    fit.set_noise(gamma, [Tone(hz / RATE, np.outer(direction, direction) / 2.0)])
    plain = BlockFit(SIZE, places, places)
    plain.set_noise(gamma)
    angle = 2.0 * np.pi * hz / RATE * (slots - 0.5 * (SIZE - 1))
    errors = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
        dots = np.sin(angle + phase)[:, None] * direction
        got = fit.fit(slots, dots)
        errors.append(np.array(got.dots) - np.sin(phase) * direction)
        stated = got.covariance - plain.fit(slots, dots).covariance
    mean = np.einsum('ni,nj->ij', errors, errors) / len(errors)
    np.testing.assert_allclose(stated, mean, rtol=1e-3, atol=1e-24)


def records_of(clean: FloatArray, rig: Rig, seed: int = 1, row: Row = ROWS[0]) -> list[Record]:
    return list(Pipeline(rig).process(chunk(volts_of(row, clean, seed))))


def chunk(volts: FloatArray, first: int = 0) -> RawChunk:
    seq = np.arange(first, first + len(volts))
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(len(seq), np.uint8))


@pytest.mark.slow
@pytest.mark.parametrize('hz', [75.0, 87.0, 180.0, 480.0])
def test_a_vibration_is_counted_and_named(hz: float) -> None:
    got = shaken(hz, seconds=8)
    s = got.inside(200)
    assert s.three > 0.99
    assert min(s.axes) > 0.93
    assert s.rms[1] > s.sd[1] / 1.2
    assert s.named == 1.0
    assert got.findings[-1].endswith(f'vibrates: 14 µm rms near {hz:g} Hz')


@pytest.mark.parametrize('readings', [[1], [0, 2]])
def test_readings_that_drift_say_so(readings: list[int]) -> None:
    """A drift of both PSDs is a motion of the plate, or none: 0.28 of the regions hold the truth after a minute."""
    s = drifting(readings, 30)
    assert s.reported > 0.95
    assert drifting([], 30).named < 0.01


@pytest.mark.parametrize(('rise', 'segments', 'reported'), [(2.23, 4, False), (2.24, 3, False), (2.24, 4, True)])
def test_a_drift_is_of_four_to_twenty_segments(rise: float, segments: int, reported: bool) -> None:
    """The slope of four means is known to 0.447 of their sd; five of its own make it a drift."""
    of, still = Drift(1), Drift(1)
    for k in range(segments):
        of.add(np.array([rise * k]), np.ones(1))
    assert (of.slope != 0.0) == reported
    for k in range(60):
        still.add(np.array([10.0 * min(k, 39)]), np.ones(1))
    assert still.slope == 0.0


def shaking(seconds: int, hz: float = 87.0) -> FloatArray:
    fine = np.arange(seconds * 5000) / 5000.0
    pose = np.stack((0.0 * fine, 20e-6 * np.sin(2.0 * np.pi * hz * fine), 0.0 * fine), axis=1)
    none = np.zeros(len(fine))
    m, light = generator.sensors(generator.optics(pose, none, none, 0.585, []), none, none, [])
    return generator.electronics(m, light, none, [])


def test_what_another_rig_remembers_of_tones_does_not_fit() -> None:
    places = np.array([[0.0, 0.07], [-0.1, 0.0]])
    noisy = StreamNoise(SIZE, places, places, 1e-12, 1e-9)
    noisy.look_for_tones(2)
    block = (0.0, 2.0, 0.0, 1.0, *(0.0,) * 8)
    with pytest.raises(ValueError, match='4 sum signals'):
        noisy.set_segment(block, (1.0,) * 3)
    noisy.set_segment(block, (1.0, 2.0, 3.0, 4.0))
    assert noisy.segment() == block
    assert noisy.sums() == (1.0, 2.0, 3.0, 4.0)
    noisy.set_segment(block)
    assert (noisy.sums(), noisy.buffered) == ((0.0,) * 4, len(block) + 4)
    pipeline = Pipeline(load_rig())
    with pytest.raises(ValueError, match='17 numbers for each tone'):
        pipeline.estimator.load_state_dict({'state.noise': (0.0,) * 6, VIBRATION: (0.1, 1.0)})


def test_the_filter_states_it_too() -> None:
    """The filtered pose and the velocity: 14 um and what 87 Hz makes of them."""
    filtering = load_rig(overrides={'filter': 'modal'})
    moved = [r for r in records_of(shaking(4), filtering) if isinstance(r, TipMotion)]
    last = moved[-1]
    pose, velocity = (np.sqrt(np.reshape(c, (3, 3))[1, 1]) for c in (last.covariance, last.velocity_covariance))
    size = 20e-6 / 2.0**0.5
    assert 0.95 * size < pose < 1.5 * size
    assert 0.95 * 2.0 * np.pi * 87.0 * size < velocity < 1.5 * 2.0 * np.pi * 87.0 * size


def test_info_says_what_vibrates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'shaken.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'chirp:0,-4,0:87,87:4']) == 0
    capsys.readouterr()
    assert main(['info', str(path)]) == 0
    assert 'µm rms near 87 Hz, in 100 % of the seconds' in capsys.readouterr().out
    assert main(['info', str(path), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['vibration']['hz'] == pytest.approx(87.0, abs=0.2)
    assert main(['simulate', '--out', str(tmp_path / 'quiet.csv'), '--loads', 'steps:0,0,0;0,-10,0:2']) == 0
    capsys.readouterr()
    assert main(['info', str(tmp_path / 'quiet.csv'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['vibration'] is None
