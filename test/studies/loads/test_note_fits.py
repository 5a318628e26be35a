# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Annotated times piece by piece: the fit of one time, what it leaves, and which loads are corrected."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import pytest

from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.loads import annotated_times
from psd_deflection.studies.loads import steps as steps_module
from psd_deflection.studies.loads.annotated_times import (
    correct_loads,
    unannotated_steps,
)
from psd_deflection.studies.loads.steps import last_load_change
from test.studies.loads.test_note_parts import as_steps, note

RIG = load_rig()


def times(n: int) -> FloatArray:
    return np.asarray(np.arange(n, dtype=np.float64) * 1e-3)


def ringing(t: FloatArray) -> FloatArray:
    """Both modes, ringing since long before."""
    out = np.zeros_like(t)
    for frequency, size in ((14.0, 1.0), (21.0, 0.7)):
        w = 2.0 * math.pi * frequency
        out += size * np.exp(-0.02 * w * t) * np.cos(w * math.sqrt(1.0 - 0.02**2) * t + 0.3)
    return out


def moved_by(start: float, took: float, n: int = 6000, rung: float = 1.0) -> FloatArray:
    """Dots (n, 4), m, that a load from ``start`` on moves, beside drift and the ringing of an older one, ``rung``
    times as large.
    """
    t = times(n)
    share = np.clip((t + 1e-3 - start) / max(took, 1e-3), 0.0, 1.0)
    bend, twist = (Filter(mode_coefficients(f, 0.02, 1e-3))(share) for f in (14.0, 21.0))
    moved = np.column_stack((bend, 0.1 * bend + 0.2 * twist, bend + 0.3 * twist, -0.2 * bend))
    beside = (
        rung * ringing(t)[:, None] * (3.0, 2.0, -1.0, 2.0) + t[:, None] * (0.1, -0.2, 0.0, 0.3) + (1.0, 2.0, 3.0, 4.0)
    )
    return np.asarray(1e-4 * (moved + beside))


class Looked:
    """Dots that note which of them are looked at."""

    def __init__(self, dots: FloatArray) -> None:
        self.dots, self.parts = dots, list[slice]()

    def __len__(self) -> int:
        return len(self.dots)

    def __getitem__(self, part: slice) -> FloatArray:
        self.parts.append(part)
        return self.dots[part]


@pytest.mark.parametrize(
    ('start', 'took', 'middle'),
    [(3.0, 0.0, 3.0), (3.0, 0.0, 3.14), (3.0, 0.0, 2.86), (3.0, 0.2, 3.1), (3.0, 2.0, 4.0)],
)
def test_step_time_is_fitted_beside_drift_and_ringing(start: float, took: float, middle: float) -> None:
    step = steps_module.DotStep(
        1000.0 * middle, 1e-4, round(1000.0 * start) - 200, round(1000.0 * (start + took)) + 200
    )
    found = steps_module.time_of_step(RIG, moved_by(start, took), step, (2000.0, 6000.0), 1e-3)
    assert found == pytest.approx((start, took), abs=1e-3 if took else 2e-5)


@pytest.mark.parametrize(
    ('between', 'window'),
    [
        # A second before the step and two after it,
        ((0.0, 9000.0), (3900, 7100)),
        # but not nearer than a tenth of a second to the steps before and after,
        ((4000.4, 6000.6), (4101, 5900)),
        # and the stretch of the step itself in any case.
        ((4950.0, 5050.0), (4900, 5100)),
    ],
)
def test_a_step_is_fitted_without_its_neighbours(between: tuple[float, float], window: tuple[int, int]) -> None:
    looked = Looked(moved_by(5.0, 0.0, 9000))
    step = steps_module.DotStep(5000.0, 1e-4, 4900, 5100)
    steps_module.time_of_step(RIG, cast(FloatArray, looked), step, between, 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {window}


def test_a_time_late_in_a_long_recording_is_fitted_as_well() -> None:
    class Later(Looked):
        def __len__(self) -> int:
            return 1_006_000

        def __getitem__(self, part: slice) -> FloatArray:
            return self.dots[part.start - 1_000_000 : part.stop - 1_000_000]

    step = steps_module.DotStep(1_003_000.0, 1e-4, 1_002_800, 1_003_200)
    found = steps_module.time_of_step(
        RIG, cast(FloatArray, Later(moved_by(3.0, 0.0, rung=100.0))), step, (0.0, 2e6), 1e-3
    )
    assert found == pytest.approx((1003.0, 0.0), abs=3e-4)


# ---- what is left


def test_rough_motion_under_a_slow_load_is_excluded() -> None:
    loads, count = np.zeros((6000, 3)), 6000
    quiet = np.repeat(np.random.default_rng(1).normal(size=(300, 4)), 20, axis=0)
    rest = quiet.copy()
    rest[2500:4000] += 20.0 * np.sin(np.arange(1500) / 40.0)[:, None]
    slow, sudden = note(2.0, 2.0, 0.5), note(2.5, 2.5)
    rough = note(2.0, 2.0, 0.5, rest_only=True)
    assert annotated_times.without_rough_motion(RIG, loads, [slow, sudden], rest).notes == (rough, sudden)
    found = annotated_times.without_rough_motion(RIG, loads, [sudden, slow], rest)
    assert found.loads is loads
    assert found.notes == (sudden, rough)
    ends = 2.5 + 5.0 / (2.0 * math.pi * 14.0 * 0.02)
    assert np.flatnonzero(found.unused).tolist() == list(range(1980, math.floor(1000.0 * ends) + 1))
    # While it was applied it counts as nothing.
    rest = quiet.copy()
    rest[1000:2520] += 100.0 * np.sin(np.arange(1520) / 40.0)[:, None]
    rest[2500:2520] = 1000.0
    found = annotated_times.without_rough_motion(RIG, loads, [slow], rest)
    assert (found.notes, found.unused.sum(), len(found.unused)) == ((slow,), 0, count)


# ---- all of it, with what it is made of told


def with_pieces(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[steps_module.DotStep],
    fitted: dict[float, tuple[float, float]],
    residual: tuple[float, float] = (1.0, 100.0),
) -> list[tuple[float, float]]:
    """Steps, their fitted times and what corrected and annotated loads leave; between which samples a time was
    fitted.
    """
    between: list[tuple[float, float]] = []

    def fit(
        rig: Rig, dots: FloatArray, step: steps_module.DotStep, edges: tuple[float, float], period: float
    ) -> tuple[float, float]:
        between.append(edges)
        return fitted[step.at]

    leaves = iter([residual[0], residual[1]] * 9)
    monkeypatch.setattr(annotated_times, 'lasting_steps', lambda dots, width: steps)
    monkeypatch.setattr(steps_module, 'lasting_steps', lambda dots, width: steps)
    monkeypatch.setattr(annotated_times, 'time_of_step', fit)
    monkeypatch.setattr(
        annotated_times, 'residual_of_dots', lambda rig, dots, loads: (next(leaves), 1e-7 * np.ones((len(dots), 4)))
    )
    return between


def annotated_at(*places: int, count: int = 20_000) -> FloatArray:
    """Loads (n, 3) that change along X, along Y and by a torque in turn."""
    loads = np.zeros((count, 3))
    for k, at in enumerate(places):
        loads[at:, k % 3] += (10.0, 10.0, 3.0)[k % 3]
    return loads


def test_last_step_is_the_last_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with_pieces(monkeypatch, as_steps((100.0, 1.0), (250.0, 1.0), (900.5, 1.0)), {})
    assert last_load_change(RIG, np.zeros((1000, 4)), 0.02) == pytest.approx(18.01)


def test_changes_within_a_quarter_of_a_second_are_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [steps_module.DotStep(at, 1.0, int(at) - 200, int(at) + 200) for at in (3000.0, 8000.0)]
    with_pieces(monkeypatch, steps, {3000.0: (3.01, 0.0), 8000.0: (8.0, 0.0)})
    dots = np.zeros((20_000, 4))
    for apart, reported in ((249, []), (250, [3.01])):
        assert unannotated_steps(RIG, dots, annotated_at(8000, 8000 + apart)) == reported
        assert (correct_loads(RIG, dots, annotated_at(3000, 9000, 9000 + apart)) is None) == (not reported)
    # A ramp is one change, which ends once; one that comes two samples later is another.
    ramp = annotated_at(*range(8000, 8100))
    assert unannotated_steps(RIG, dots, ramp) == [3.01]
    assert unannotated_steps(RIG, dots, annotated_at(8000, 8002)) == []
    # Its end may come with a note of the next one within a quarter of a second.
    assert unannotated_steps(RIG, dots, annotated_at(*range(8000, 8100), 8200)) == []
    assert unannotated_steps(RIG, dots, annotated_at(*range(8000, 8100), 8400)) == [3.01]


def test_load_cell_noise_is_removed_for_any_times(monkeypatch: pytest.MonkeyPatch) -> None:
    dots, chance = np.zeros((2000, 4)), np.random.default_rng(1)
    noisy = np.where(np.arange(2000)[:, None] < 1500, 0.0, 50.0) + chance.normal(size=(2000, 3))
    with_pieces(monkeypatch, [], {})
    found = correct_loads(RIG, dots, noisy)
    assert found is not None
    assert [m.first for m in found.measured] == [0, 1500]
    assert (found.notes, found.timed, found.unused.sum(), found.unused.shape) == ((), (), 0, (2000,))
    assert np.ptp(found.loads[:1500], axis=0).tolist() == [0.0] * 3
    with_pieces(monkeypatch, as_steps((400.0, 1e-4)), {400.0: (0.4, 0.0)})
    found = correct_loads(RIG, dots, noisy)
    assert found is not None
    assert [m.first for m in found.measured] == [0, 1500]
    assert [n.applied for n in found.notes] == [0.4]
