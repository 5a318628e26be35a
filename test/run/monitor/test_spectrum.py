# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
import json
import re
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import pytest

from psd_deflection.recordings.replay.engine import open_for_replay
from psd_deflection.records import DiagnosticEntry, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor.spectrum import SEGMENT, Spectrum, density_json, line_entry
from tools.program import ROOT

RIG = load_rig()


def blocks(volts: npt.NDArray[np.float64], lose: frozenset[int] = frozenset()) -> list[SampleBlock]:
    """Blocks of 20 of x1 in V; the other channels at rest."""
    readings = np.zeros((len(volts), 6), np.float32)
    readings[:, 0] = volts
    readings[:, 2::3] = 5.0
    seq = np.array([i for i in range(len(volts)) if i not in lose], np.int64)
    return [
        SampleBlock(k, part, part * 1_000_000, readings[part], np.zeros(len(part), np.uint8))
        for k in range(len(volts) // 20)
        if len(part := seq[seq // 20 == k])
    ]


def spectrum_of(given: Iterable[SampleBlock]) -> Spectrum:
    spectrum = Spectrum(RIG)
    for block in given:
        spectrum.add(block)
    return spectrum


def density_of(given: Iterable[SampleBlock]) -> npt.NDArray[np.float64]:
    density = spectrum_of(given).density()
    assert density is not None
    return density


def test_white_noise_has_its_density_and_a_sine_its_power() -> None:
    rng = np.random.default_rng(1)
    # 2 mV rms of white noise at 1 kHz is 2 mV / sqrt(500 Hz), times 0.5 mm/V.
    density = density_of(blocks(rng.normal(0.0, 2e-3, 4000)))
    assert density.shape == (4, SEGMENT // 2)
    assert np.sqrt((density[0] ** 2).mean()) == pytest.approx(2e-3 * 0.5e-3 / np.sqrt(500.0), rel=0.05)
    t = np.arange(4000) / 1000.0
    density = density_of(blocks(0.1 * np.sin(2.0 * np.pi * 14.0 * t)))
    frequencies = Spectrum(RIG).frequencies
    assert frequencies[int(density[0].argmax())] == pytest.approx(14.0, abs=1.0)
    # Parseval: the area under the squared density is the variance of the dot, (0.1 V * 0.5 mm/V)^2 / 2.
    area = (density[0] ** 2).sum() * (frequencies[1] - frequencies[0])
    assert area == pytest.approx((0.1 * 0.5e-3) ** 2 / 2.0, rel=0.02)
    assert density[1:].max() == 0.0


def test_a_segment_never_spans_a_loss() -> None:
    rng = np.random.default_rng(2)
    lossy = blocks(rng.normal(0.0, 1.0, 4000), lose=frozenset(range(500, 4000, 1000)))
    assert spectrum_of(lossy).density() is None
    # A step where samples are missing: seen as one segment it would be a large low-frequency line.
    volts = np.where(np.arange(4000) < 2000, 0.0, 1.0)
    assert density_of(blocks(volts, lose=frozenset({1999})))[0].max() < 1e-12


def test_it_keeps_four_seconds_and_restarts_when_numbers_go_back() -> None:
    noisy = np.zeros(12_000)
    noisy[:6000] = np.random.default_rng(3).normal(0.0, 1.0, 6000)
    for end, there in ((9_500, True), (12_000, False)):
        spectrum = spectrum_of(blocks(noisy[:end]))
        density = spectrum.density()
        assert density is not None
        assert bool(density[0].any()) is there
    spectrum.add(blocks(noisy)[0])
    assert spectrum.density() is None


def test_samples_without_light_are_no_dots() -> None:
    rng = np.random.default_rng(4)
    lit, dark = blocks(rng.normal(1.0, 2e-3, 4000)), blocks(np.zeros(4000))
    for block in dark:
        block.volts[:, 2] = 0.01
    # The dot stands at 0.5 mm; counted as one at 0 mm, the dark part in the middle would be a step.
    density = density_of([*lit[:80], *dark[80:120], *lit[120:]])
    assert np.sqrt((density[0] ** 2).mean()) == pytest.approx(2e-3 * 0.5e-3 / np.sqrt(500.0), rel=0.1)
    # PSD 1 dark, or its sum not a number, all along: nothing of it, and PSD 2 is told all the same.
    for sum1 in (0.01, np.nan):
        half = blocks(rng.normal(0.0, 2e-3, 4000))
        for block in half:
            block.volts[:, 2] = sum1
        density = density_of(half)
        assert np.isnan(density[:2]).all()
        assert (density[2:] == 0.0).all()
        # NaN is no JSON: a browser would reject the whole message.
        assert json.loads(density_json(density)) == [[None] * (SEGMENT // 2)] * 2 + [[0.0] * (SEGMENT // 2)] * 2
    for block in dark:
        block.volts[:, 5] = 0.01
    assert spectrum_of(dark).density() is None


def entry_of(volts: npt.NDArray[np.float64]) -> DiagnosticEntry:
    spectrum = spectrum_of(blocks(volts))
    return line_entry(RIG, spectrum.frequencies, spectrum.density())


@pytest.mark.parametrize('hz', [40.0, 1040.0, 960.0])
def test_line_without_mode_has_alternatives(hz: float) -> None:
    """The samples of 40, 960 and 1040 Hz are the same."""
    noise = np.random.default_rng(1).normal(0.0, 2e-3, 4000)
    entry = entry_of(noise + 0.04 * np.sin(2.0 * np.pi * hz * np.arange(4000) * 1e-3))
    assert entry.level == 1
    assert re.match(r'a line of 14\.[12] µm rms at 40 Hz on x1, where the rig file has no mode: ', entry.message)
    assert 'something at 960 or 1040 Hz is folded' in entry.message
    assert dict(entry.values) == {'line (Hz)': '40.0'}


def test_noise_and_the_modes_of_the_rig_are_no_line() -> None:
    t = np.arange(4000) * 1e-3
    rng = np.random.default_rng(2)
    for hz in (14.0, 21.0):
        ringing = 4.0 * np.exp(-0.02 * 2.0 * np.pi * hz * (t % 2.0)) * np.sin(2.0 * np.pi * hz * (t % 2.0))
        assert entry_of(ringing + rng.normal(0.0, 2e-3, 4000)).level == 0
    for _ in range(50):
        assert entry_of(rng.normal(0.0, 2e-3, 4000)).level == 0
    assert (entry_of(np.zeros(4000)).level, line_entry(RIG, Spectrum(RIG).frequencies, None).level) == (0, 0)


def test_loads_that_come_and_go_are_no_line() -> None:
    recording, rig = open_for_replay(ROOT / 'bags' / 'clean')
    spectrum = Spectrum(rig)
    for number, block in enumerate(recording.blocks()):
        spectrum.add(block)
        if number % 25 == 24:
            assert line_entry(rig, spectrum.frequencies, spectrum.density()).level == 0
