"""Counts to volts to metres."""

from __future__ import annotations

import numpy as np

from psd_deflection.calibration import Calibration, counts_to_volts, dot_noise_variances
from psd_deflection.config import rig_from_values
from psd_deflection.records import CHANNELS


def test_counts_become_volts_rounded_once() -> None:
    counts = np.array([[-32768, -1, 0, 1, 16384, 32767]], dtype=np.int16)
    volts = counts_to_volts(counts, 10.0 / 32768.0)
    assert volts.dtype == np.float32
    assert volts[0].tolist() == [np.float32(c * (10.0 / 32768.0)) for c in counts[0].tolist()]


def test_ten_volts_are_five_millimetres_and_channels_stay_in_order() -> None:
    volts = np.array([[10.0, -10.0, 5.0, 2.0, -4.0, 5.0]], dtype=np.float32)
    dots = Calibration.from_rig(rig_from_values({})).dots(volts)
    assert dots.dtype == np.float64
    np.testing.assert_allclose(dots, [[5e-3, -5e-3, 1e-3, -2e-3]], rtol=1e-15)
    assert [CHANNELS[i] for i in (0, 1, 3, 4)] == ['x1', 'y1', 'x2', 'y2']


def test_noise_is_the_amplifiers_and_the_converters() -> None:
    rig = rig_from_values({'amplifier.noise': 2e-3, 'converter.bits': 8})
    step = 20.0 / 256.0
    rng = np.random.default_rng(0)
    clean = rng.uniform(-5.0, 5.0, 200_000)
    read = np.round((clean + 2e-3 * rng.standard_normal(clean.shape)) / step) * step
    seen = np.var((read - clean) * 0.5e-3)
    np.testing.assert_allclose(dot_noise_variances(rig), seen, rtol=0.02)
    np.testing.assert_allclose(
        dot_noise_variances(rig_from_values({})), 1e-12 + 0.25e-6 * (20.0 / 65536.0) ** 2 / 12.0, rtol=1e-12
    )
