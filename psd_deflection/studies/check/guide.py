# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Leads a person through three pushes: says what to do next, and sees when the link rests, is pushed and is let go."""

from collections import deque
from enum import Enum

import numpy as np

from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.studies.check.wirings import DOTS, PushResponse, pattern, scales_of

REST_S = 2.0
HOLD_S = 0.6
IMPATIENT_S = 10.0
"""After so long without a step forward it says what it waits for."""

LEAST_PUSH = 10e-6
"""m. A smaller movement is not taken for a push, however quiet the rig is."""

STAND_OUT = 10.0
"""Factor by which a push must move the dots farther than they wander at rest."""

STEADY = 0.3
"""A push whose movement wanders less than this share of it is held."""

LET_GO = 0.15
"""A dot that is nearer to its rest than this share of the push has been let go."""

STILL = 5.0
"""Wandering up to this factor of the expected noise counts as rest."""

SHIFT = 2e-6
"""m. Shift between rests that handling alone may cause; drift is reported beyond it."""


class Phase(Enum):
    """What is waited for."""

    REST = 'rest'
    PUSH = 'push'
    RELEASE = 'release'
    DONE = 'done'


def directions(rig: Rig) -> tuple[str, str, str]:
    """What to do for +X, +Y and +θ, with a PSD as the landmark."""
    return (
        f'Push the tip along +X ({_landmark(rig, 0)}) and hold it.',
        f'Push the tip along +Y ({_landmark(rig, 1)}) and hold it.',
        'Turn the tip about +Z (clockwise, looking from the lasers along the beams) and hold it.',
    )


def _landmark(rig: Rig, axis: int) -> str:
    """Where the axis points, seen from the PSD that lies farthest out along it."""
    psd = max(rig.psds, key=lambda p: abs(p.center[axis]))
    x, y = (1e3 * c for c in psd.center)
    where = 'towards' if psd.center[axis] > 0.0 else 'away from'
    return f'{where} the PSD at x {x:g} mm, y {y:g} mm'


class Guide:
    """``phase``: what is waited for. ``number``: which push, 0 to 2. ``moved`` (4,): movement of the device's channels
    from rest now, m. ``progress``: how much of the present phase is done, 0 to 1. ``pushes``: those that were taken.
    """

    def __init__(self, rig: Rig) -> None:
        check_two_psds(rig, 'check')
        self._rig = rig
        self._sensitivity = rig.amplifier.sensitivity
        self._rail = rig.converter.full_scale - 2.0 * rig.converter.volts_per_count
        self._period = 1.0 / rig.converter.sample_rate_hz
        self._noise = rig.amplifier.noise * self._sensitivity
        self._texts = directions(rig)
        self._expected = pattern(rig)
        self.phase = Phase.REST
        self.number = 0
        self.moved = np.zeros(4)
        self.progress = 0.0
        self.pushes: list[PushResponse] = []
        self._rest_volts: list[FloatArray] = []
        self._rests: list[tuple[float, FloatArray]] = []
        self._means: deque[tuple[FloatArray, int]] = deque()
        self._samples: deque[FloatArray] = deque()
        self._held = np.zeros(4)
        self._held_sd = np.zeros(4)
        self._rest_sd = np.zeros(4)
        self._t = self._since = 0.0

    def prompt(self) -> str:
        """What to do now."""
        if self.phase is Phase.REST:
            return 'Leave the link alone.'
        if self.phase is Phase.PUSH:
            return f'{self.number + 1} of 3: {self._texts[self.number]}'
        return 'Let go.' if self.phase is Phase.RELEASE else 'Done.'

    def feed(self, volts: FloatArray) -> str:
        """Take the next samples (n, 6), V, of the device's channels. What to tell the person, or ''."""
        n = len(volts)
        dots = volts[:, DOT_CHANNELS].mean(axis=0) * self._sensitivity
        self._t += n * self._period
        self._means.append((dots, n))
        self._samples.append(volts)
        wanted = round((HOLD_S if self.phase in (Phase.PUSH, Phase.RELEASE) else REST_S) / self._period)
        while sum(count for _, count in self._means) - self._means[0][1] >= wanted:
            self._means.popleft()
            self._samples.popleft()
        here = np.array([mean for mean, _ in self._means])
        filled = min(sum(count for _, count in self._means) / wanted, 1.0)
        self.moved = dots - self._rests[-1][1] if self._rests else dots - here.mean(axis=0)
        # A block's mean wanders less than a sample.
        quiet = STILL * self._noise * np.sqrt(len(here) / max(sum(count for _, count in self._means), 1))
        match self.phase:
            case Phase.REST:
                answer = self._resting(here, filled, max(quiet, LEAST_PUSH / STAND_OUT))
            case Phase.PUSH:
                answer = self._pushed(here, filled)
            case Phase.RELEASE:
                answer = self._released(here, filled)
            case _:
                answer = ''
        return answer

    def _next(self, phase: Phase) -> None:
        self.phase, self.progress, self._since = phase, 0.0, self._t
        self._means.clear()
        self._samples.clear()

    def _impatient(self, why: str) -> str:
        if self._t - self._since < IMPATIENT_S:
            return ''
        self._since = self._t
        return why

    def _resting(self, here: FloatArray, filled: float, quiet: float) -> str:
        moving = float(here.std(axis=0).max())
        self.progress = filled if moving <= quiet else 0.0
        if filled < 1.0:
            return ''
        if moving > quiet and self._t < 3.0 * IMPATIENT_S:
            return self._impatient(f'It still moves by {moving * 1e6:.1f} µm rms: leave it alone.')
        self._rest_sd = np.maximum(here.std(axis=0), self._noise * np.sqrt(len(here) * self._period / REST_S))
        self._rests.append((self._t, here.mean(axis=0)))
        self._rest_volts = list(self._samples)
        self._next(Phase.PUSH)
        return ''

    def _pushed(self, here: FloatArray, filled: float) -> str:
        rest = self._rests[-1][1]
        moved = here.mean(axis=0) - rest
        distance = float(np.linalg.norm(moved))
        needed = max(LEAST_PUSH, STAND_OUT * float(np.linalg.norm(self._rest_sd)))
        moving = float(np.linalg.norm(here.std(axis=0)))
        held = distance > needed and moving < STEADY * distance
        self.progress = filled if held else 0.0
        if max(float(np.abs(v[:, DOT_CHANNELS]).max()) for v in self._samples) >= self._rail:
            return self._impatient('A dot is at the end of its PSD: push less.')
        if not held:
            if distance <= needed:
                return self._impatient(f'No push yet: the dots have moved by {distance * 1e6:.1f} µm.')
            return self._impatient('Hold it steadier.')
        if filled < 1.0:
            return ''
        self._held, self._held_sd = here.mean(axis=0), here.std(axis=0)
        self._next(Phase.RELEASE)
        return 'Got it: ' + ', '.join(f'{c} {v * 1e6:+.0f}' for c, v in zip(DOTS, moved, strict=True)) + ' µm.'

    def _released(self, here: FloatArray, filled: float) -> str:
        push = float(np.linalg.norm(self._held - self._rests[-1][1]))
        back = float(np.linalg.norm(here.mean(axis=0) - self._rests[-1][1]))
        moving = float(np.linalg.norm(here.std(axis=0)))
        free = back < LET_GO * push and moving < LET_GO * push
        self.progress = filled if free else 0.0
        if not free or filled < 1.0:
            return self._impatient('Let go of the link.') if not free else ''
        before, after = self._rests[-1][1], here.mean(axis=0)
        moved = self._held - 0.5 * (before + after)
        # Held by hand, the mean is as sure as the hand was steady and the rest came back.
        sd = np.sqrt(self._rest_sd**2 + 0.25 * (after - before) ** 2 + self._held_sd**2 / max(len(here), 1))
        load = ('fx', 'fy', 'tz')[self.number]
        expected = self._expected[:, self.number]
        self.pushes.append(
            PushResponse(
                (load,), moved, sd, expected, sized=False, only_twist=load == 'tz', scales=scales_of(self._rig)
            )
        )
        self._rests.append((self._t, after))
        self.number += 1
        self._next(Phase.PUSH if self.number < 3 else Phase.DONE)
        return ''

    def rest(self) -> FloatArray:
        """Return the samples (n, 6) of the first rest, V, of the device's channels."""
        return np.concatenate(self._rest_volts)

    def drift(self) -> tuple[FloatArray, FloatArray]:
        """Movement of the rest from first to last, m/s, and its standard deviation, (4,) each."""
        (t0, first), (t1, last) = self._rests[0], self._rests[-1]
        lasted = max(t1 - t0, self._period)
        return (last - first) / lasted, (self._rest_sd + SHIFT) / lasted
