# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measures by how much joints move with their offsets o: on an arm at rest, q = a + s f(o), f a lag of first order; s
is 1 if the controller adds them. Its half-width is what could be wrong at worst. Two motions in a row must say that s
is wrong: the load may have changed in one."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

LAGS_S = (0.0, 0.02, 0.05, 0.12, 0.3)
"""Lags of joints behind their commands that are tried, s."""
REST_S = 0.2
"""A fit begins with an arm that has been at rest for this time, s."""
REST_SHARE = 0.1
"""At rest: no joint and no offset moves by more than this share of ``follow_error``."""
LARGEST_ERROR = 0.1
"""A slope is wrong if it is this far from 1, beyond its half-width."""
KNOWN_WITHIN = 0.2
"""Largest half-width of a slope that counts as measured."""
LARGEST_SLOPE = 5.0
UNEXPLAINED = 0.3
"""If a slope is larger than that, or the fit leaves this share of a joint's standard deviation, the arm was moved by
something else."""
PROVEN_S = 0.5
"""Slopes that are wrong within this time of the first that is right, s, are of the same motion."""
PAUSE_S = 2.0
"""Time from a wrong slope to the next fit, s: it is to be of another motion."""
MOST_ROWS = 256
MOST_S = 60.0
"""Longest fit, s: a controller may change."""
SPACING_S = 0.019
"""Least time between two rows of a fit, s; it doubles when there are ``MOST_ROWS``."""
SAME = 1e-9
"""Positions that are closer are one reading, rad or m."""


class JointResponse:
    """``slopes`` (n,) of n joints and ``half_widths`` (n,), NaN until they are known. Owns no clock; for one thread."""

    def __init__(self, joints: int) -> None:
        self._lagged = np.zeros((len(LAGS_S), joints))
        self._last_t = self._spacing = 0.0
        self._pause_t = -math.inf
        self._rows: list[tuple[float, FloatArray, FloatArray]] = []  # Bound: MOST_ROWS.
        self._begun = False
        # When a slope was right for the first time.
        self._right_t = math.inf
        # Joints whose last slope was wrong.
        self.candidates: set[int] = set()  # Bound: the joints of the arm.
        self.slopes = np.full(joints, np.nan)
        self.half_widths = np.full(joints, np.nan)

    def begin(self, offsets: FloatArray) -> None:
        """Forget the slopes: from now on the joints get offsets that begin at ``offsets`` (n,), which they have."""
        self._lagged = np.tile(offsets, (len(LAGS_S), 1))
        self._rows = [(t, joints, self._lagged) for t, joints, _ in self._rows]
        self.candidates.clear()
        self._right_t = math.inf
        self.slopes, self.half_widths = np.full_like(self.slopes, np.nan), np.full_like(self.slopes, np.nan)

    def forget_motion(self) -> None:
        """Forget the motion of now and the slopes that were wrong: the robot stood, perhaps since before it said so."""
        wrong = list(self.candidates)
        self.slopes[wrong] = self.half_widths[wrong] = math.nan
        self.candidates.clear()
        self._rows.clear()
        self._restart()

    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: whether the slope of each joint was measured, and is right."""
        right = self.half_widths <= KNOWN_WITHIN
        right[list(self.candidates)] = False
        return right

    def add(
        self, now: float, joints: FloatArray, offsets: FloatArray, follow_error: float, arrived: bool = True
    ) -> int | None:
        """Take measured positions and the offsets sent, (n,) each, at ``now``, s; the joint whose slope is wrong.

        ``follow_error``: the step of an encoder that has shown one reading only, rad or m. ``arrived``: whether the
        controller has these offsets; until then an arm that stands is not at rest.
        """
        elapsed = max(now - self._last_t, 0.0)
        if now < self._pause_t or (self._rows and elapsed < self._spacing):
            return None
        self._last_t = now
        shares = np.array([-np.expm1(-elapsed / lag) if lag else 1.0 for lag in LAGS_S])[:, None]
        self._lagged = self._lagged + (offsets - self._lagged) * shares
        self._rows.append((now, joints, self._lagged))
        rests = arrived and self._rests(now, REST_SHARE * follow_error)
        if not self._begun:
            self._begun = rests
            # Rows of before, but for one, would be of an arm that moved.
            while not rests and len(self._rows) > 2 and self._rows[1][0] <= now - REST_S:
                del self._rows[0]
            return None
        if now - self._rows[0][0] > MOST_S:
            self._restart()
            return None
        if len(self._rows) > MOST_ROWS:
            self._rows, self._spacing = self._rows[::2], 2.0 * self._spacing
        return self._fit(follow_error, rests)

    def wrong(self, names: Sequence[str], joint: int) -> str:
        """Why the slope of ``joint`` is wrong."""
        slope, half_width = self.slopes[joint], self.half_widths[joint]
        return f'{names[joint]} moves by {slope:.2f} ± {half_width:.2f} of its offset, must be 1'

    def _restart(self) -> None:
        self._rows, self._begun, self._spacing = self._rows[-1:], False, SPACING_S

    def _rests(self, now: float, limit: float) -> bool:
        """Whether neither joints nor offsets have moved for ``REST_S``."""
        first = next((n for n in range(len(self._rows) - 1, -1, -1) if self._rows[n][0] <= now - REST_S), None)
        if first is None:
            return False
        rows = self._rows[first:]
        moved = [np.ptp(values, axis=0).max() for values in ([q for _, q, _ in rows], [f[0] for _, _, f in rows])]
        return float(max(moved)) <= limit

    def _fit(self, follow_error: float, rests: bool) -> int | None:
        joints = np.array([q for _, q, _ in self._rows])
        lagged = np.array([f for _, _, f in self._rows])
        travel = np.ptp(lagged[:, 0], axis=0)
        q, f = joints - joints.mean(axis=0), lagged - lagged.mean(axis=0)
        squares = np.maximum((f * f).sum(axis=0), 1e-30)
        slopes = (f * q[:, None]).sum(axis=0) / squares
        residual = np.sqrt(np.square(q[:, None] - slopes * f).mean(axis=0))
        wrong, restarts = None, False
        for j in range(joints.shape[1]):
            step = _step(joints[:, j], follow_error)
            best = int(residual[:, j].argmin())
            slope, smallest, size = slopes[best, j], residual[best, j], np.sqrt(squares[best, j] / len(q))
            moved = np.ptp(joints[:, j]) > 0.5 * follow_error
            if moved and (abs(slope) > LARGEST_SLOPE or smallest > UNEXPLAINED * q[:, j].std()):
                self._restart()
                return None
            if not rests or travel[j] <= 4.0 * SAME:
                continue
            alike = residual[:, j] <= 2.0 * smallest + 0.1 * step
            half_width = smallest / size + step / travel[j] + np.abs(slopes[alike, j] - slope).max()
            if half_width > KNOWN_WITHIN * max(1.0, abs(slope)) or abs(slope) > LARGEST_SLOPE:
                continue
            before, width = self.slopes[j], self.half_widths[j]
            self.slopes[j], self.half_widths[j] = slope, half_width
            if abs(slope - 1.0) <= LARGEST_ERROR + half_width:
                self.candidates.discard(j)
                self._right_t = min(self._right_t, self._last_t)
                continue
            restarts = True
            again = j in self.candidates and abs(slope - before) <= half_width + width
            if again or self._last_t - self._right_t < PROVEN_S:
                wrong = j
            self.candidates.add(j)
        if restarts:
            self._restart()
            self._pause_t = self._last_t + PAUSE_S
        return wrong


def _step(positions: FloatArray, unknown: float) -> float:
    """Smallest difference between two readings of an encoder, ``unknown`` if there is only one reading."""
    steps = np.diff(np.unique(positions))
    steps = steps[steps > SAME]
    return float(steps.min()) if len(steps) else unknown
