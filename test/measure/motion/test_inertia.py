# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What known accelerations of the base do, against an integration of the equation of motion by scipy."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind import motion
from msg_adapters import ACCELERATION, to_messages
from psd_deflection.measure.motion import inertia
from psd_deflection.measure.motion.inertia import HOLD_NS, Inertia
from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.measure.motion.motion import INERTIA
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import BaseAcceleration, DiagnosticEntry, FloatArray, RawChunk, Record, TipMotion
from psd_deflection.rig.config import rig_from_values
from psd_deflection.run.diagnostics import HealthReporter

MODES = (Oscillator(14.0, 0.02), Oscillator(14.0, 0.02), Oscillator(21.0, 0.02))
L = 0.585
MS = 1_000_000
NONE = (0.0, 0.0, 0.0)


def rigid_tip(base: BaseAcceleration) -> tuple[float, float, float]:
    """Its acceleration, by the cross product."""
    at_tip = np.array(base.linear) + np.cross(base.angular, (0.0, 0.0, L))
    return float(at_tip[0]), float(at_tip[1]), base.angular[2]


def integrated(changes: Sequence[tuple[float, Sequence[float]]], t: FloatArray) -> FloatArray:
    """(3, n, 2): q and q'/w at ``t`` (n,), s, from rest at 0; ``changes``: time, and accelerations from then on."""
    out = np.zeros((3, len(t), 2))
    for axis, mode in enumerate(MODES):
        state = np.zeros(2)
        for k, (begin, accelerations) in enumerate(changes):
            end = changes[k + 1][0] if k + 1 < len(changes) else float(t[-1]) + 1e-9
            a, w, zeta = accelerations[axis], mode.w, mode.damping_ratio

            def rate(_: float, y: FloatArray, a: float = a, w: float = w, zeta: float = zeta) -> list[float]:
                return [y[1], -2.0 * zeta * w * y[1] - w * w * y[0] - a]

            inside = (t >= begin) & (t < end)
            solution = solve_ivp(rate, (begin, end), state, t_eval=[*t[inside], end], rtol=1e-10, atol=1e-14).y
            out[axis, inside] = (solution[:, :-1] / np.array([[1.0], [w]])).T
            state = solution[:, -1]
    return out


def test_it_is_the_solution_of_the_equation_of_motion() -> None:
    reported = [
        BaseAcceleration(-5 * MS, (0.3, -1.0, 9.0), (2.0, 0.5, -4.0)),
        BaseAcceleration(7 * MS + 300_000, (0.0, 2.0, 0.0), (-1.0, 3.0, 8.0)),
        BaseAcceleration(12 * MS, NONE, NONE),
    ]
    known = Inertia(MODES, L)
    for i in (2, 0, 1, 1):
        known.notify(reported[i], 0)
    seconds = 1e-3 * np.arange(1.0, 21.0)
    forced = known.forced(0, seconds)
    changes = [(0.0, rigid_tip(reported[0])), (0.0073, rigid_tip(reported[1])), (0.012, rigid_tip(reported[2]))]
    np.testing.assert_allclose(forced.at[..., :2], integrated(changes, seconds), rtol=1e-7, atol=1e-13)
    assert not forced.at[..., 2:].any()
    # Of two changes that other messages led to, the twentieth part may be wrong.
    sizes = np.abs(np.diff([a for _, a in changes], axis=0)).sum(axis=0) / np.array([mode.w for mode in MODES]) ** 2
    np.testing.assert_allclose(forced.doubt, 0.05 * sizes)
    assert (known.count, known.late) == (4, 1)


def test_acceleration_holds_0_1_s_and_starts_uncertain() -> None:
    known = Inertia(MODES, L)
    first = BaseAcceleration(10 * MS, (1.0, 0.0, 0.0), NONE)
    known.notify(first, 0)
    seconds = 1e-3 * np.arange(1.0, 201.0)
    forced = known.forced(0, seconds)
    changes = [(0.0, NONE), (0.010, (1.0, 0.0, 0.0)), (0.110, NONE)]
    np.testing.assert_allclose(forced.at[..., :2], integrated(changes, seconds), rtol=1e-7, atol=1e-13)
    # It may have begun before it was told, and nobody knows how it ended.
    assert forced.doubt[0] == pytest.approx(2.0 / MODES[0].w ** 2)
    known.notify(BaseAcceleration(111 * MS, (1.0, 0.0, 0.0), NONE), 100 * MS)
    assert known.forced(0, seconds[:150]).doubt[0] == pytest.approx(3.0 / MODES[0].w ** 2)
    known.forget_before(10 * MS + HOLD_NS)
    assert (known.ended, len(known.reported)) == (0, 2)
    known.forget_before(111 * MS)
    assert (known.ended, len(known.reported)) == (1, 1)
    known.forget_before(111 * MS + HOLD_NS)
    assert (known.ended, known.known) == (2, False)


@pytest.mark.parametrize(
    ('base', 'why'),
    [
        (BaseAcceleration(899 * MS, NONE, NONE), r'header.stamp is 0.101 s before the last sample.*0.1 s.*clocks'),
        (BaseAcceleration(11_001 * MS, NONE, NONE), r'header.stamp is 10.001 s after the last sample'),
        (BaseAcceleration(1000 * MS, (0.0, math.nan, 0.0), NONE), r'accel.linear.y is nan, the bound is 10000'),
        (BaseAcceleration(1000 * MS, NONE, (0.0, 0.0, -2e4)), r'accel.angular.z is -20000, the bound is 10000'),
    ],
)
def test_what_cannot_be_used_is_rejected(base: BaseAcceleration, why: str) -> None:
    known = Inertia(MODES, L)
    with pytest.raises(ValueError, match=why):
        known.notify(base, 1000 * MS)
    assert not known.known
    known.notify(BaseAcceleration(900 * MS, NONE, NONE), 1000 * MS)
    known.notify(BaseAcceleration(11_000 * MS, (1e4, 0.0, 0.0), NONE), 1000 * MS)
    assert len(known.reported) == 2


def test_most_accelerations_that_wait_are_a_hundred_thousand() -> None:
    known = Inertia(MODES, L)
    known.reported = [(n, NONE) for n in range(99_999)]
    known.notify(BaseAcceleration(MS, NONE, NONE), 0)
    with pytest.raises(ValueError, match='100000 accelerations wait'):
        known.notify(BaseAcceleration(2 * MS, NONE, NONE), 0)


def rotated(seconds: float) -> motion.Run:
    """A joint at the base turns about x to and fro: 4 rad/s^2 from 0.5 s on, -4 from 0.75 s on, and so on."""
    t = np.arange(round(1000 * seconds)) / 1000.0
    begins = np.arange(0.5, seconds, 0.25)
    angular = [(4.0 if k % 2 == 0 else -4.0, 0.0, 0.0) for k in range(len(begins))]
    changes = [
        (0.0, NONE),
        *((b, rigid_tip(BaseAcceleration(0, NONE, a))) for b, a in zip(begins, angular, strict=True)),
    ]
    states = integrated(changes, t)
    pose = states[..., 0].T
    velocity = (states[..., 1] * np.array([[mode.w] for mode in MODES])).T
    reported = []
    for ms in range(25, len(t), 5):
        now = int(np.searchsorted(begins, ms / 1000.0 + 1e-6)) - 1
        reported.append(BaseAcceleration(ms * MS, NONE, angular[now] if now >= 0 else NONE))
    return motion.Run(pose, pose, velocity, motion.volts_of(pose, np.random.default_rng(3)), tuple(reported))


@pytest.fixture(scope='module')
def run() -> motion.Run:
    return rotated(2.0)


def through(
    pipeline: Pipeline, run: motion.Run, blocks: range, reported: list[BaseAcceleration] | None = None, late: int = 0
) -> list[Record]:
    """What is told comes ``late`` samples after its stamp."""
    reported = list(run.reported) if reported is None else reported
    out: list[Record] = []
    for b in blocks:
        while reported and reported[0].t_ns < ((b + 1) * motion.BLOCK - late) * MS:
            pipeline.accelerate(reported.pop(0))
        out += pipeline.process(motion.chunk(run, b))
    return out


def moved(records: list[Record]) -> list[TipMotion]:
    return [r for r in records if isinstance(r, TipMotion)]


def test_lost_lasers_are_coasted_through_with_what_is_reported(run: motion.Run) -> None:
    dark = motion.Run(run.loads, run.pose, run.velocity, run.volts.copy(), run.reported)
    # A turn of the acceleration is in it.
    dark.volts[940:1040, 2] = 0.0
    last = moved(through(Pipeline(motion.rig_of()), dark, range(52)))[-1]
    assert last.coasted == pytest.approx(0.1)
    error = abs(last.dy - run.pose[1039, 1])
    assert error < 3.0 * last.covariance[4] ** 0.5
    assert error < 0.1 * np.abs(run.pose[:, 1]).max()


@pytest.mark.slow
def test_what_comes_late_is_put_right(run: motion.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the process noise stated and no doubt the filter is linear: late or not, it finds the same in the end."""
    monkeypatch.setattr(inertia, 'SHARE', 0.0)
    rig = motion.rig_of({'filter_load_walk': [1.0, 1.0, 0.1]})
    in_time, late = Pipeline(rig), Pipeline(rig)
    expected = moved(through(in_time, run, range(39)))
    # At 0.75 s, in the middle of block 37, the acceleration turns.
    early = [message for message in run.reported if message.t_ns < 750 * MS]
    observed = moved(through(late, run, range(38), reported=early))
    assert observed[36] == expected[36]
    assert abs(observed[37].vy - expected[37].vy) > 0.01
    for message in run.reported[145:]:
        late.accelerate(message)
    after = moved(list(late.process(motion.chunk(run, 38))))[-1]
    assert late.motion_filter is not None
    assert late.motion_filter.inertia.late == 2
    assert after.vy == pytest.approx(expected[38].vy, abs=1e-12)
    assert after.dy == pytest.approx(expected[38].dy, abs=1e-15)
    # And from then on it is less sure of what it says.
    assert after.velocity_covariance[4] > 4.0 * expected[38].velocity_covariance[4]


def test_diagnostics_say_what_is_wrong_with_what_is_reported(run: motion.Run) -> None:
    pipeline = Pipeline(motion.rig_of())
    session: Any = SimpleNamespace(pipeline=pipeline, rejected=Counter(), why_rejected={})
    health = HealthReporter(session)

    def entry() -> DiagnosticEntry:
        # Private: a whole report needs a session with a device.
        (motion_entry,) = health._motion()
        return motion_entry

    def message() -> tuple[int, str]:
        status = entry()
        return status.level, status.message

    reported = list(run.reported)
    through(pipeline, run, range(25), reported)
    assert message() == (0, 'the modes predict the samples')
    session.rejected[ACCELERATION], session.why_rejected[ACCELERATION] = 3, 'no frame'
    through(pipeline, run, range(25, 30), reported)
    assert message() == (1, '3 base accelerations rejected: no frame')
    # Of four messages in a block two come late.
    through(pipeline, run, range(30, 35), reported, late=10)
    assert message() == (1, '8 of 18 base accelerations came after the samples on which they acted')
    through(pipeline, run, range(35, 42), [])
    assert message() == (1, 'no base acceleration came for 0.1 s, and the last one was not 0: taken as 0')
    assert dict(entry().values)['base accelerations, not ended by another'] == '1'


def test_a_memory_that_is_none_is_rejected() -> None:
    filtered = Pipeline(motion.rig_of()).motion_filter
    assert filtered is not None
    row = (5.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    for values in (row, (4.0, *row[1:], *6 * row), (math.inf,), (-4.0, *9 * row), (*row, *5 * (0.0,), math.nan)):
        with pytest.raises(ValueError, match=r'state.inertia: .* in blocks of 20 samples'):
            filtered.load_state_dict({INERTIA: values})
    filtered.load_state_dict({INERTIA: (*row, *row)})
    assert filtered.inertia.reported == [(1_000_000_000, (0.0, 0.0, 0.0))]


@pytest.mark.parametrize('start', [20, 38, 50])
def test_a_recording_begun_at_any_block_replays_to_the_bit(start: int, run: motion.Run, tmp_path: Path) -> None:
    """It is recorded as the session does it, also with lost samples and messages that come late."""
    dark = motion.Run(run.loads, run.pose, run.velocity, run.volts.copy(), run.reported)
    dark.volts[940:1000, 2] = 0.0
    rig = motion.rig_of({'filter_ahead': 0.005})
    live = Pipeline(rig)
    reported = list(run.reported)
    through(live, dark, range(start), reported, late=10)
    # Two that the filter has not used yet. In block 37 the acceleration turned.
    assert start != 38 or reported[0].t_ns == 750 * MS
    for message in (reported.pop(0), reported.pop(0)):
        live.accelerate(message)
    with BagWriter(tmp_path / 'bag', rig_values=rig.flat()) as bag:
        memory = live.snapshot(rig)
        assert memory is not None
        assert INERTIA in dict(memory.values)
        bag.put(memory)
        expected = []
        for b in range(start, 70):
            while reported and reported[0].t_ns < ((b + 1) * motion.BLOCK - 5) * MS:
                message = reported.pop(0)
                known_ns = live.accelerate(message)
                assert known_ns is not None
                (m,) = to_messages(message)
                bag.write_encoded(m.topic, m.type, cdr.encode(m.type, m.fields), known_ns)
            # Every seventh block has lost its end: it is computed when the next one begins.
            chunk = motion.chunk(dark, b)
            if b % 7 == 0:
                chunk = RawChunk(chunk.seq[:17], chunk.t_ns[:17], chunk.readings[:17], chunk.flags[:17])
            for record in live.process(chunk):
                bag.put(record)
                expected += moved([record])
        for record in live.flush():
            bag.put(record)
    recording = open_recording(tmp_path / 'bag')
    replayed_rows = [
        m for records in replayed(recording, Pipeline(rig_from_values(recording.parameters))) for m in moved(records)
    ]
    assert replayed_rows == expected
