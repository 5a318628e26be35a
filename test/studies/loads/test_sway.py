# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A weight that swayed: check, calibrate and discover tell it in the same words, and leave its time out."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.loads import sway
from psd_deflection.studies.loads.plateaus import Plateau, PlateauLoads, implied_beside_rig, plateaus
from psd_deflection.studies.loads.sway import SwayingLoad, excluded, swaying_loads
from test.studies.held_loads import DWELL, HELD, RIG, T, answers, read


def swung(force: float, frequency: float, axis: int = 0, number: int = 3) -> FloatArray:
    """The loads with a swing in one plateau."""
    out = HELD.copy()
    since = T - number * DWELL / 1000.0
    held = (since > 0.0) & (since < DWELL / 1000.0)
    out[:, axis] += np.where(held, force * np.sin(2.0 * np.pi * frequency * since), 0.0)
    return out


SWUNG = read(swung(1.0, 1.3))


def test_check_calibrate_and_discover_say_the_same() -> None:
    checked, steady, log, found = answers(SWUNG, HELD)
    assert [(f.name, f.where, f.value) for f in checked.findings] == [('load_value', 'load 3', None)]
    words = checked.findings[0].fix
    assert words.startswith('the weight that hung on the link of x from 12.000 s to 16.000 s swayed at 1.3')
    assert checked.verdict == 'wrong'
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    assert log == [words]
    assert np.isnan(steady.volts[12_000:16_000]).all()
    assert np.isfinite(steady.volts[:12_000]).all()
    assert np.isfinite(steady.volts[20_000:]).all()
    assert [f.fix for f in found.setup] == [words]
    assert found.verdict == 'nothing_missing'


@pytest.mark.slow
@pytest.mark.parametrize(('force', 'frequency', 'axis'), [(0.5, 0.9, 0), (2.0, 1.6, 0), (1.0, 1.1, 1)])
def test_force_and_frequency_are_those_of_the_swing(force: float, frequency: float, axis: int) -> None:
    (found,) = swaying_loads(RIG, read(swung(force, frequency, axis)), HELD)
    assert found.plateau.number == 3
    assert found.frequency == pytest.approx(frequency, abs=0.02)
    assert found.force == pytest.approx(force, rel=0.1)
    # How it swung, but for how much more a link of 14 Hz swings than under a load that rests.
    assert found.swung is not None
    true = (swung(force, frequency, axis) - HELD)[3 * DWELL : 4 * DWELL]
    assert np.abs(found.swung - true).max() < 0.03 * force
    assert sway.swung(len(HELD), []) is None
    every = sway.swung(len(HELD), [found])
    assert every is not None
    np.testing.assert_array_equal(every[3 * DWELL : 4 * DWELL], found.swung)


def test_apparent_step_excludes_sway_from_its_start() -> None:
    asked, annotated = implied_beside_rig(RIG, SWUNG, HELD), plateaus(RIG, SWUNG, HELD, annotated_only=True)
    cut = 3 * DWELL + 1200
    pieces = [
        *annotated[:3],
        dataclasses.replace(annotated[3], last=cut),
        dataclasses.replace(annotated[3], first=cut, unannotated=True),
        *annotated[4:],
    ]
    (found,) = sway.swaying(asked(pieces), annotated, asked, 1e-3)
    assert (found.plateau.first, found.plateau.last) == (3 * DWELL, 4 * DWELL)


ROTATED = {'effects__e__name': 'sensor_rotation', 'effects__e__psd': 1, 'effects__e__angle': 0.02}
STICKS = {'effects__e__name': 'clamp_friction', 'effects__e__width': 1.4e-5, 'effects__e__axis': 3}


@pytest.mark.slow
@pytest.mark.parametrize(
    'true', [{}, ROTATED, STICKS, {'dynamics__bending_damping_ratio': 0.01}, {'link__length': 0.6}]
)
def test_what_no_weight_does_is_no_sway(true: dict[str, object]) -> None:
    assert swaying_loads(RIG, read(HELD, **true), HELD) == []


def test_the_time_is_left_out_until_the_link_has_come_to_rest() -> None:
    rig = load_rig(overrides={'dynamics.bending_frequency': 10.0, 'dynamics.bending_damping_ratio': 0.05})
    volts = np.zeros((9000, 6))
    swayed = [SwayingLoad(Plateau(0, 2000, 5000, 1, False, np.zeros(3)), 1.0, 1.0, 1e-3)]
    rest = round(5.0 / (2.0 * math.pi * 10.0 * 0.05) / 1e-3)
    gone = np.flatnonzero(np.isnan(excluded(rig, volts, swayed)).all(axis=1))
    assert gone.tolist() == list(range(2000, 5000 + rest))
    assert not volts.any()


def test_a_peak_is_the_vertex_of_a_log_parabola() -> None:
    f = np.array([0.5, 1.0, 1.5, 2.0])
    top = np.exp(-(((f - 1.1) / 0.4) ** 2))
    assert sway.peak_frequency(f, top) == pytest.approx(1.1)
    assert sway.peak_frequency(f, np.array([1.0, 0.5, 0.2, 0.1])) == pytest.approx(0.5, abs=0.01)
    assert sway.peak_frequency(f, np.zeros(4)) == 0.0
    assert sway.peak_frequency(f[:2], np.array([1.0, 3.0])) == 1.0
    assert sway.peak_frequency(np.zeros(0), np.zeros(0)) == 0.0


def test_a_swing_is_what_no_constant_load_explains() -> None:
    """A tone of 1.3 Hz that fades from 2 N, in means of four samples."""
    n, size = 4000, 4
    held = tuple(Plateau(0, n * k, n * (k + 1), k, False, np.zeros(3)) for k in range(6))
    t = np.arange(n) * 1e-3
    force = 2.0 * (1.0 - 0.1 * t) * np.sin(2.0 * math.pi * 1.3 * t + 0.4)
    rest = 1e-9 * np.random.default_rng(0).standard_normal((3, 6 * n // size))
    rest[1, 3 * n // size : n] += 2e-5 * force.reshape(-1, size).mean(axis=1)
    none = np.zeros((6, 3))
    implied = PlateauLoads(held, none, rest, rest, rest[:1], none[:, 0], np.array([1e-5, 2e-5, 1e-4]), size)
    (found,) = sway.swaying(implied, held, lambda _: implied, 1e-3)
    assert found.plateau is held[3]
    assert [found.frequency, found.force] == [pytest.approx(1.3, abs=0.01), pytest.approx(1.6, abs=0.1)]
    assert found.swung is not None
    np.testing.assert_allclose(found.swung[:, 1], force, atol=5e-3)
    assert np.abs(found.swung[:, [0, 2]]).max() < 1e-3
    # Of two lost holds nothing is known, and what is less than eight times the median is no sway.
    lost = rest.copy()
    lost[:, n // size : 3 * n // size] = np.nan
    lost[1, n:] += 2e-6 * np.tile(force, 2).reshape(-1, size).mean(axis=1)
    implied = dataclasses.replace(implied, rest=lost)
    assert [s.plateau for s in sway.swaying(implied, held, lambda _: implied, 1e-3)] == [held[3]]
