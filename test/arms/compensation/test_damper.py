# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Active damping: what it adds, its limits, and when it stops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.damped_link import SETTINGS, swing
from psd_deflection.arms.compensation.compensator import State
from psd_deflection.arms.compensation.damper import Damper, DamperSettings
from psd_deflection.base.errors import ConfigError

W = 2.0 * math.pi * 14.0
PERIOD = 0.02


class Mode:
    """A link with its joint, stepped exactly, whose velocity is measured as it is; ``q``, ``v`` of the tip."""

    def __init__(self, settings: DamperSettings, speed: float = 0.1) -> None:
        self.damper = Damper(settings)
        self.damper.enable(True)
        self.t, self.q, self.v = 0.0, 0.0, speed
        self.offsets = [0.0]

    def run(self, seconds: float, *, told: bool = True) -> None:
        h = 1e-3
        turned = W * math.sqrt(1.0 - 0.02**2)
        c, s, e = math.cos(turned * h), math.sin(turned * h), math.exp(-0.02 * W * h)
        for _ in range(round(seconds / h)):
            self.t += h
            offsets = [*self.offsets[-2:], self.damper.watch(self.t).offset]
            self.offsets.append(offsets[-1])
            if len(offsets) == 3:
                self.v -= 0.585 * (offsets[2] - 2.0 * offsets[1] + offsets[0]) / h
            self.q, self.v = (
                e * (self.q * c + (self.v + 0.02 * W * self.q) / turned * s),
                e * (self.v * c - (W * W * self.q + 0.02 * W * self.v) / turned * s),
            )
            if told and round(self.t / h) % round(PERIOD / h) == 0:
                self.damper.observe(self.t, self.v, 1e-4)

    @property
    def amplitude(self) -> float:
        return math.hypot(self.q, self.v / W)

    def decrement(self, seconds: float) -> float:
        before = self.amplitude
        self.run(seconds)
        return math.log(before / self.amplitude) / (seconds * 14.0)


MINE = DamperSettings(14.0, 0.02, 0.585, added=0.05, max_offset=0.01)


def test_it_adds_to_the_damping_ratio() -> None:
    mode = Mode(MINE)
    mode.run(0.3)
    # Of 0.02 + 0.05.
    assert mode.decrement(0.2) == pytest.approx(2.0 * math.pi * 0.07, rel=0.2)
    free = Mode(MINE)
    free.damper.enable(False)
    free.run(0.3)
    assert free.decrement(0.2) == pytest.approx(2.0 * math.pi * 0.02, rel=0.03)
    assert not any(free.offsets)


def test_size_and_rate_are_never_exceeded_and_it_still_damps() -> None:
    settings = replace(MINE, max_offset=2e-4, max_rate=0.01)
    mode = Mode(settings, speed=0.5)
    mode.run(0.3)
    assert mode.damper.watch(mode.t).limited
    assert mode.decrement(0.2) > 2.0 * math.pi * 0.02 * 1.02
    offsets = np.array(mode.offsets)
    assert 0.5e-4 < np.abs(offsets).max() <= 2e-4
    assert np.abs(np.diff(offsets)).max() <= 0.01 * 1e-3 * (1.0 + 1e-9)


def test_over_the_filter_of_the_product_the_decrement_is_more_than_thrice() -> None:
    free, damped = (swing(0.85, None, settings, knock=0.2) for settings in (None, SETTINGS))
    assert free.decrement(0.6, 0.8) == pytest.approx(2.0 * math.pi * 0.02, rel=0.1)
    assert damped.decrement(0.6, 0.8) > 3.0 * free.decrement(0.6, 0.8)


def following() -> Mode:
    mode = Mode(MINE)
    mode.run(0.4)
    assert mode.damper.watch(mode.t).state is State.FOLLOWING
    assert abs(mode.offsets[-1]) > 0.0
    return mode


@pytest.mark.parametrize(
    ('velocity', 'deviation', 'why'),
    [
        (math.nan, 1e-4, 'not finite'),
        (0.0, math.inf, 'not finite'),
        (0.0, 0.1, 'uncertain by more than 0.02 m/s'),
        (0.0, -1.0, 'uncertain'),
        (3.0, 1e-4, 'above 2 m/s'),
    ],
)
def test_a_bad_velocity_ends_it_and_good_ones_begin_it_again(velocity: float, deviation: float, why: str) -> None:
    mode = following()
    mode.damper.observe(mode.t + 1e-3, velocity, deviation)
    found = mode.damper.watch(mode.t + 1e-3)
    assert (found.state, why in found.why) == (State.HOLDING, True)
    mode.run(0.1)
    assert mode.damper.watch(mode.t).state is State.HOLDING
    assert mode.offsets[-1] == 0.0
    mode.run(0.2)
    assert mode.damper.watch(mode.t).state is State.FOLLOWING


def test_without_velocities_it_is_zero_within_a_tenth_of_a_second() -> None:
    mode = following()
    mode.run(0.1, told=False)
    assert mode.damper.watch(mode.t).why == 'no velocity for 0.08 s'
    assert mode.offsets[-1] == 0.0


def test_it_stops_if_it_drives_the_vibration() -> None:
    mode = Mode(replace(MINE, lever=-0.585, added=0.1), speed=1e-3)
    mode.run(1.5)
    found = mode.damper.watch(mode.t)
    assert found.why == 'damping drives the vibration: check lever, lag and frequency'
    assert found.offset == 0.0
    mode.damper.enable(True)
    assert mode.damper.watch(mode.t).state is State.FOLLOWING


def test_too_few_velocities_are_no_use() -> None:
    damper = Damper(MINE)
    damper.enable(True)
    for n in range(30):
        damper.observe(0.05 * n, 0.1, 1e-4)
        assert damper.watch(0.05 * n).offset == 0.0


@pytest.mark.parametrize(
    ('changed', 'message'),
    [
        ({'frequency': 0.0}, 'frequency = 0.0: must be above 0'),
        ({'damping': 1.0}, 'damping = 1.0: must be at least 0 and below 1'),
        ({'lag': 0.05}, 'lag = 0.05 s: must be at least 0 and at most half a period'),
        ({'lever': 0.0}, 'lever = 0.0 m'),
        ({'max_rate': math.inf}, 'max_rate = inf: must be above 0 and finite'),
        ({'good': 0}, 'good = 0'),
    ],
)
def test_settings_are_checked(changed: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(MINE, **changed)  # type: ignore[arg-type]
