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
def test_one_time_is_fitted_beside_drift_and_the_ringing_of_before(start: float, took: float, middle: float) -> None:
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
def test_a_time_is_fitted_without_its_neighbours(between: tuple[float, float], window: tuple[int, int]) -> None:
    looked = Looked(moved_by(5.0, 0.0, 9000))
    step = steps_module.DotStep(5000.0, 1e-4, 4900, 5100)
    steps_module.time_of_step(RIG, cast(FloatArray, looked), step, between, 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {window}


def test_a_time_is_fitted_to_no_more_than_there_is() -> None:
    looked = Looked(moved_by(0.5, 0.0, 1500))
    step = steps_module.DotStep(500.0, 1e-4, 400, 600)
    found = steps_module.time_of_step(RIG, cast(FloatArray, looked), step, (-2000.0, 9000.0), 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {(0, 1500)}
    assert found[0] == pytest.approx(0.5, abs=1e-4)


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


def test_steps_every_6_ms_and_ramps_below_half_are_fitted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[list[tuple[float, float]], float]] = []
    slowly = [0.49]

    def least(residual: object, starts: list[tuple[float, float]], reach: float) -> tuple[float, tuple[float, float]]:
        asked.append((starts, reach))
        return (1.0, (3.01, 0.0)) if len(asked) % 2 else (slowly[0], (2.5, -1.1))

    monkeypatch.setattr(steps_module, 'best_time', least)
    step = steps_module.DotStep(3000.0, 1e-4, 2800, 3200)
    for residual, found in ((0.49, (2.5, 1.1)), (0.5, (3.01, 0.0)), (1.2, (3.01, 0.0))):
        slowly[0] = residual
        assert steps_module.time_of_step(RIG, moved_by(3.0, 0.0), step, (0.0, 6000.0), 1e-3) == found
    (sudden, by), (ramps, seconds) = asked[:2]
    assert [at for at, _ in sudden] == pytest.approx([2.85 + 0.006 * i for i in range(51)])
    assert {took for _, took in sudden} == {0.0}
    # About the middle, of a tenth of a second and more up to some seconds.
    assert [at + 0.5 * took for at, took in ramps] == pytest.approx([3.0] * 6)
    assert [took for _, took in ramps] == [0.15, 0.3, 0.6, 1.0, 1.5, 2.5]
    assert (by, seconds) == (1e-3, 0.05)


def test_the_time_search_ends_after_120_evaluations() -> None:
    looks: list[tuple[float, float]] = []

    def down(x: FloatArray) -> float:
        looks.append((float(x[0]), float(x[1])))
        return float(-x[0] - 2.0 * x[1])

    steps_module.best_time(down, [(1.0, 0.5), (2.0, 1.0)], 0.25)
    assert looks[2:5] == [(2.0, 1.0), (2.25, 1.0), (2.0, 1.25)]
    assert len(looks) == 2 + 120


# ---- what is left


def test_what_is_left_of_the_dots_is_what_least_squares_leave() -> None:
    chance = np.random.default_rng(5)
    loads = np.zeros((1010, 3))
    loads[200:, 0], loads[500:, 1], loads[700:, 2] = 3.0, -20.0, 8.0
    columns = [np.ones(1010), np.arange(1010.0)]
    for k, frequency in enumerate((14.0, 14.0, 21.0)):
        columns.append(Filter(mode_coefficients(frequency, 0.02, 1e-3))(loads[:, k]))
    design = np.column_stack(columns)
    dots = 1e-4 * design @ chance.normal(size=(5, 4)) * (1.0, 1e-3, 1.0, 1.0) + 1e-6 * chance.normal(size=(1010, 4))
    dots[chance.random(1010) < 0.1] = np.nan
    dots[400:420] = np.nan
    # One of a block.
    dots[600:619] = np.nan
    there = np.asarray(np.isfinite(dots).all(axis=1))
    rest = np.where(there[:, None], dots - design @ np.linalg.lstsq(design[there], dots[there], rcond=None)[0], np.nan)
    with np.errstate(invalid='raise', divide='raise'):
        residual, means = annotated_times.residual_of_dots(RIG, dots, loads)
    assert residual == pytest.approx(float(np.nansum(rest**2)), rel=1e-6)
    assert means.shape == dots.shape
    for first in range(0, 1010, 20):
        part = rest[first : first + 20]
        wanted = np.nanmean(part, axis=0) if np.isfinite(part).any() else np.full(4, np.nan)
        assert means[first : first + 20] == pytest.approx(np.tile(wanted, (len(part), 1)), rel=1e-4, nan_ok=True)
    # A millionth of the loads moves the dots alike.
    assert annotated_times.residual_of_dots(RIG, dots, 1e-6 * loads)[0] == pytest.approx(residual, rel=1e-6)
    # And one axis that is never loaded does nothing.
    loads[:, 1] = 0.0
    design[:, 3] = 0.0
    rest = dots[there] - design[there] @ np.linalg.lstsq(design[there], dots[there], rcond=None)[0]
    assert annotated_times.residual_of_dots(RIG, dots, loads)[0] == pytest.approx(float((rest**2).sum()), rel=1e-6)


def test_a_link_moves_for_five_time_constants_of_its_slower_mode() -> None:
    t = times(8000)
    rig = load_rig(overrides={'dynamics.torsion_frequency': 10.0, 'dynamics.torsion_damping_ratio': 0.05})
    # 1 / (2 pi f ratio): 0.568 s of 14 Hz at 0.02, 0.318 s of 10 Hz at 0.05.
    wanted = 5.0 / (2.0 * math.pi * 14.0 * 0.02)
    for took in (0.0, 0.7):
        moving = np.flatnonzero(annotated_times.in_motion(rig, note(3.0, 2.0, took), t))
        assert moving[0] == 1980
        assert moving[-1] == math.floor(1000.0 * (2.0 + took + wanted))
        assert len(moving) == moving[-1] - moving[0] + 1
    # Without damping of a thousandth or more it would never end.
    free = load_rig(overrides={'dynamics.torsion_frequency': 200.0, 'dynamics.torsion_damping_ratio': 0.0})
    assert np.flatnonzero(annotated_times.in_motion(free, note(3.0, 2.0), t))[-1] == math.floor(
        2000.0 + 5e6 / (400.0 * math.pi)
    )


def rest_of(sizes: list[float], block: int = 4) -> FloatArray:
    """Blocks whose four dots are each of these sizes."""
    return np.repeat(np.outer(sizes, np.ones(4)), block, axis=0)


def test_ringing_is_rough_beyond_three_times_the_noise() -> None:
    # Neighbours of quiet blocks differ by 1 of each of four dots: half of the square, of four, is the noise, 2.
    quiet = [0.0, 1.0] * 20
    rings = np.zeros(4 * 46, dtype=bool)
    rings[-24:] = True
    # Six that are s off their mean, of four dots: 4 s^2, above 9 * 2 if s is above 2.1.
    for size, rough in ((2.1, False), (2.14, True)):
        rest = rest_of([*quiet, *[size, -size] * 3])
        assert annotated_times.is_rough(rest, rings, 4) is rough
        # About their own mean.
        rest[-24:] += 50.0
        assert annotated_times.is_rough(rest, rings, 4) is rough
    # Exactly three times is not beyond: 1.5 of two dots, beside quiet ones of which one differs by 1.
    rest = rest_of([*quiet, *[1.5, -1.5] * 3]) * (1.0, 0.0, 0.0, 0.0)
    rest[-24:, 1] = rest[-24:, 0]
    assert not annotated_times.is_rough(rest, rings, 4)
    assert annotated_times.is_rough(1.01 * rest - 0.01 * rest * ~rings[:, None], rings, 4)
    # A lost block counts as none, and of three nothing is told.
    rest = rest_of([*quiet, *[5.0, -5.0] * 3])
    rest[-8:] = np.nan
    assert annotated_times.is_rough(rest, rings, 4)
    rest[-12:, 2] = np.nan
    assert not annotated_times.is_rough(rest, rings, 4)


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


def test_steps_without_a_note_near_them_are_reported_by_their_fitted_time(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [steps_module.DotStep(at, 1.0, int(at) - 200, int(at) + 200) for at in (3000.0, 8000.0, 15000.0)]
    fitted = {3000.0: (3.01, 0.5), 8000.0: (8.02, 0.7), 15000.0: (15.03, 0.9)}
    between = with_pieces(monkeypatch, steps, fitted)
    dots = np.zeros((20_000, 4))
    assert unannotated_steps(RIG, dots, np.zeros((20_000, 3))) == [3.01, 8.02, 15.03]
    assert between == [(0.0, 8000.0), (3000.0, 15000.0), (8000.0, 20000.0)]
    # Near: two widths of 286 before the step's first sample, or after its last.
    for at, near in ((7228, True), (7227, False), (8772, True), (8773, False)):
        reported = unannotated_steps(RIG, dots, annotated_at(3000, at, 15000))
        assert reported == ([] if near else [8.02])
    # One axis is enough for a note, and two samples may be one change after the other.
    for axis in range(3):
        loads = np.zeros((20_000, 3))
        for at in (3000, 8000, 15000):
            loads[at:, axis] += 1.0
        assert unannotated_steps(RIG, dots, loads) == []
        assert unannotated_steps(RIG, dots, loads[:, [axis, axis, axis]]) == []


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


def test_times_are_mended_if_they_differ_and_leave_a_quarter_of_the_movement(monkeypatch: pytest.MonkeyPatch) -> None:
    places = (3000.0, 8000.0, 15000.0)
    sizes = annotated_times.expected_movements(RIG, np.array([(10.0, 0, 0), (0, 10.0, 0), (0, 0, 3.0)])).tolist()
    steps = [
        steps_module.DotStep(at, size, int(at) - 200, int(at) + 200) for at, size in zip(places, sizes, strict=True)
    ]
    fitted = {3000.0: (3.0, 0.0), 8000.0: (8.0, 0.0), 15000.0: (15.0, 0.0)}
    dots = np.zeros((20_000, 4))
    between = with_pieces(monkeypatch, steps, fitted)
    late = annotated_at(3000, 9500, 15000)
    found = correct_loads(RIG, dots, late)
    assert found is not None
    assert [(n.number, n.annotated, n.applied, n.took) for n in found.notes] == [(2, 9.5, 8.0, 0.0)]
    assert [n.number for n in found.timed] == [1, 2, 3]
    assert found.loads == pytest.approx(annotated_at(3000, 8000, 15000))
    assert between == [(0.0, 8000.0), (3000.0, 15000.0), (8000.0, 20000.0)]
    assert not found.unused.any()
    assert found.measured == ()
    # Right as annotated, all late alike, or two milliseconds off: nothing is fitted.
    for loads in (annotated_at(3000, 8000, 15000), annotated_at(3500, 8500, 15500), annotated_at(3002, 8000, 14998)):
        between.clear()
        assert correct_loads(RIG, dots, loads) is None
        assert between == []
    # A step that is longer than two widths and a tenth of a second is looked at: 2 * 286 + 100 samples.
    for long, looks in ((672, 0), (673, 3)):
        between.clear()
        some = [steps[0], steps_module.DotStep(8000.0, sizes[1], 7700, 7700 + long), steps[2]]
        monkeypatch.setattr(annotated_times, 'lasting_steps', lambda dots, width, some=some: some)
        monkeypatch.setattr(steps_module, 'lasting_steps', lambda dots, width, some=some: some)
        assert correct_loads(RIG, dots, annotated_at(3000, 8000, 15000)) is None
        assert len(between) == looks
    # Applied over a tenth of a second is a step.
    for took, reported in ((0.1, None), (0.101, [0.101])):
        fitted[8000.0] = (8.0, took)
        ramp = correct_loads(RIG, dots, annotated_at(3000, 8000, 15000))
        assert (None if ramp is None else [n.took for n in ramp.notes]) == reported
    fitted[8000.0] = (8.0, 0.0)
    monkeypatch.setattr(annotated_times, 'lasting_steps', lambda dots, width: steps)
    monkeypatch.setattr(steps_module, 'lasting_steps', lambda dots, width: steps)
    # Alike by the fitted times, though not by the middles of the steps.
    fitted.update({3000.0: (2.999, 0.0), 8000.0: (9.498, 0.0), 15000.0: (15.0, 0.0)})
    assert correct_loads(RIG, dots, late) is None
    fitted.update({3000.0: (3.0, 0.0), 8000.0: (8.0, 0.0)})
    for residual, reported_late in (((1.0, 3.9), False), ((1.0, 4.0), True), ((1.0, 4.1), True), ((0.1, 0.41), True)):
        with_pieces(monkeypatch, steps, fitted, residual)
        assert (correct_loads(RIG, dots, late) is not None) == reported_late


def test_loads_of_a_cell_lose_their_noise_whether_times_are_mended_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(('rate', 'width'), [(1000.0, 286), (200.0, 57), (10.0, 3), (5.0, 2)])
def test_means_take_four_periods_of_bending_and_two_samples_at_least(
    rate: float, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    widths: list[int] = []

    def none(dots: FloatArray, width: int) -> list[steps_module.DotStep]:
        widths.append(width)
        return []

    monkeypatch.setattr(annotated_times, 'lasting_steps', none)
    monkeypatch.setattr(steps_module, 'lasting_steps', none)
    rig = load_rig(overrides={'converter.sample_rate_hz': rate, 'dynamics.bending_frequency': 14.0})
    loads = np.zeros((100, 3))
    loads[50:] = 1.0
    assert unannotated_steps(rig, np.zeros((100, 4)), loads) == []
    assert last_load_change(rig, np.zeros((100, 4)), 1.0 / rate) is None
    assert correct_loads(rig, np.zeros((100, 4)), loads) is None
    assert widths == [width] * 3
