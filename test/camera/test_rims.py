# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parts of the fit of the rims by themselves, against geometry."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.camera.discs.rim_classifier import RimClassifier
from psd_deflection.camera.discs.rim_model import PosePrior, expected
from psd_deflection.records import FloatArray


def about(axis: int, angle: float) -> FloatArray:
    """The rotation about X, Y or Z."""
    c, s = math.cos(angle), math.sin(angle)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[a, a], out[a, b], out[b, a], out[b, b] = c, -s, s, c
    return out


def test_the_keystone_that_is_expected_turns_with_the_target() -> None:
    prior = PosePrior(about(2, 0.3), 0.1, np.array([0.02, 0.0]))
    assert expected(prior, about(2, 0.3)) == pytest.approx([0.02, 0.0], abs=1e-15)
    # A quarter turn on, the target's Y points where its X did, the other way.
    assert expected(prior, about(2, 0.3 + math.pi / 2.0)) == pytest.approx([0.0, -0.02], abs=1e-15)
    assert expected(prior, about(2, 0.3 - math.pi / 2.0)) == pytest.approx([0.0, 0.02], abs=1e-15)


def test_discs_that_seem_to_move_together_move_in_the_plane_of_the_target() -> None:
    rotation = about(0, 0.7) @ about(1, -0.4) @ about(2, 0.2)
    lens = cast(Any, SimpleNamespace(focal=1000.0))
    classifier = RimClassifier(lens, 640, np.array([[0.0, 0.1], [0.0, -0.1]]))
    shape = cast(Any, SimpleNamespace(rotation=rotation, place=np.array([0.0, 0.0, 0.5])))
    found = classifier.moved_centres(shape, 0.2)
    sd = 0.2 * 0.5 / 1000.0
    own = rotation.T @ found[3:, 3:] @ rotation
    assert own == pytest.approx(np.diag([sd**2, sd**2, 0.0]), abs=1e-20)
    # Two discs 0.1 m from the middle: an error of each across them turns the target by its share.
    assert found[2, 2] == pytest.approx(sd**2 / (2 * 0.1**2))
    assert not found[:3, 3:].any()
