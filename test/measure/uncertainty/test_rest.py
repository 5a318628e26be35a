# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rest that a zero needs, by numbers that can be added up by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from psd_deflection.measure.uncertainty.block_estimator import BlockEstimator
from psd_deflection.measure.uncertainty.rest import why_moving
from psd_deflection.rig.config import load_rig


def moves(um: list[float], noise_um: float = 0.01) -> str:
    """What is said of blocks of which y1 goes through these places."""
    dots = np.zeros((len(um), 4))
    dots[:, 1] = 1e-6 * np.array(um)
    return why_moving(dots, ((1e-6 * noise_um) ** 2,) * 4)


def test_two_blocks_report_nothing_three_do() -> None:
    assert moves([0.0, 50.0]) == ''
    # From the first block to the mean of the others.
    assert moves([0.0, 2.01, 2.01]).startswith('the link moves: y1 varied by 1.2 µm rms in the last 3 blocks, noise')
    assert moves([0.0, 1.99, 1.99]) == ''
    # Of two at 0 and two at 1 m: 1/sqrt 3 m.
    message = moves([0.0, 0.0, 1e6, 1e6], noise_um=1e5)
    assert ' varied by 577350.3 µm rms in the last 4 blocks, noise explains 100000.0 µm; ' in message


@pytest.mark.parametrize(('noise_um', 'drifts', 'scatters'), [(0.01, 2.0, 10.0), (3.0, 15.0, 15.0)])
def test_moving_is_five_times_the_noise_and_micrometres(noise_um: float, drifts: float, scatters: float) -> None:
    for share, message in ((0.99, False), (1.01, True)):
        assert bool(moves([0.0, 0.0, share * drifts, share * drifts], noise_um)) == message
        # Of a, -a, a, -a the standard deviation is 2 a / sqrt 3.
        a = share * scatters * 3.0**0.5 / 2.0
        assert bool(moves([a, -a, a, -a], noise_um)) == message


@pytest.mark.parametrize(
    ('flat', 'words'), [(False, 'noise of the rig file'), (True, 'noise of the rig file until it is measured')]
)
def test_diagnostics_say_whose_noise_it_is(flat: bool, words: str) -> None:
    estimator = BlockEstimator(load_rig(), flat)
    assert dict(estimator.words())['covariance from'] == words
    # The noise of each reading is told if it is measured.
    assert len(estimator.words()) == (6 + len(estimator.noise_words()) if flat else 5)
    assert len(estimator.noise_words()) >= 4


@pytest.mark.parametrize(
    ('more', 'freedom'), [({}, 1), ({'psd_3.center': [0.08, -0.06], 'psd_4.center': [0.0, 0.1]}, 3)]
)
def test_diagnostics_say_how_probable_a_chi_square_is(more: dict[str, object], freedom: int) -> None:
    estimator = BlockEstimator(load_rig(overrides=more))
    estimator.chi_square, estimator.freedom = 6.0, freedom
    assert dict(estimator.words())['p of that chi-square'] == f'{chi2.sf(6.0, freedom):.2g}'
