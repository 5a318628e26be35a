# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Dots of 2 mm beside those of 1 mm, and the errors that both have by hand."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.studies.thesis.large_spots import DIAMETERS, FORCES, spot_changes, spot_run


def test_while_the_weight_is_held_larger_dots_change_nothing() -> None:
    """As the thesis says: the dots are 2.7 mm and more from the edges of the sensors, which is 2.7 radii."""
    for c in spot_changes():
        np.testing.assert_allclose(c.error[1], c.error[0], atol=1e-9)


def test_overshoot_of_larger_weight_alone_reaches_edge() -> None:
    """It goes to nearly twice the deflection, 3.8 mm in the mean of a block.

    The part of a dot of 2 mm that lies beyond 5 mm is not read.
    """
    for c in spot_changes():
        assert (c.largest[1] > 1e-5) == (c.force == 50.0)
        assert c.largest[1] < 5e-5
    peak = spot_run(50.0, DIAMETERS[1]).truth[:, 1].min()
    assert -3.9e-3 < peak < -3.7e-3


@pytest.mark.parametrize('force', FORCES)
def test_least_squares_error_is_its_neglected_rotation(force: float) -> None:
    """theta dY less theta^2/2 of 100 mm, on dX; the iteration here has none."""
    truth = spot_run(force, DIAMETERS[0]).truth[-50:].mean(axis=0)
    (least_squares,) = (c for c in spot_changes() if (c.force, c.method) == (force, 'weighted least squares'))
    (iteration,) = (c for c in spot_changes() if (c.force, c.method) == (force, 'iteration'))
    by_hand = truth[2] * truth[1] - 0.5 * truth[2] ** 2 * 0.1
    assert least_squares.error[0][0] == pytest.approx(by_hand, rel=0.02)
    assert np.abs(iteration.error[0][:2]).max() < 1e-7
