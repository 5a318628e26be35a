# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The input of discover: one recording as arrays on a complete sample grid, lost samples NaN, with its own rig."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray, IntArray, Moment
from psd_deflection.rig.config import Rig

QUIET = 0.25
"""A load that has not changed for this long, s, ends a load case at its next change."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """``volts`` (n, 3P) V of the PSDs, x y sum of each, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held.

    ``temperature`` (n,) degrees Celsius or None. ``rig``: the rig with this recording's own
    overrides. ``digest``: of its source. ``unknown_load``: numbers of samples before the first known load and
    after the last; what ``loads`` holds there is only a placeholder. ``stated_rate_hz``: the rig
    file's sample rate if the recording's times say another, which ``rig`` then has; else 0. ``marks``: from the
    first sample. ``zero_variances`` (2P,) m^2: of the rig's zero, if it was taken in the recording. ``swing`` (n, 3):
    N, N, N m, what a weight that swayed added to the loads, or None.
    """

    name: str
    rig: Rig
    volts: FloatArray
    loads: FloatArray
    temperature: FloatArray | None = None
    digest: str = ''
    unknown_load: tuple[int, int] = (0, 0)
    stated_rate_hz: float = 0.0
    marks: tuple[Moment, ...] = ()
    zero_variances: tuple[float, ...] = ()
    swing: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.volts)
        if n < 4 * self.rig.estimator.block_size:
            raise RecordingError(f'{self.name}: {n} samples: discover needs at least 4 blocks')
        if self.volts.shape != (n, 3 * self.psds) or self.loads.shape != (n, 3):
            raise RecordingError(f'{self.name}: volts {self.volts.shape} and loads {self.loads.shape} do not match')
        if not np.all(np.isfinite(self.loads)):
            raise RecordingError(f'{self.name}: a load is not a finite number')
        if self.temperature is not None and not np.all(np.isfinite(self.temperature)):
            raise RecordingError(f'{self.name}: a temperature is not a finite number')

    @property
    def acting(self) -> FloatArray:
        """(n, 3): the loads with what swayed."""
        return self.loads if self.swing is None else self.loads + self.swing

    @property
    def psds(self) -> int:
        """How many PSDs the rig has."""
        return len(self.rig.psds)

    @property
    def period(self) -> float:
        """s between samples."""
        return 1.0 / self.rig.converter.sample_rate_hz

    @property
    def duration(self) -> float:
        """s."""
        return len(self.volts) * self.period

    def hashed(self) -> str:
        """SHA-256 of the numbers themselves, for provenance."""
        h = hashlib.sha256()
        for a in (self.volts, self.loads, self.temperature):
            if a is not None:
                h.update(np.ascontiguousarray(a, dtype=np.float32).tobytes())
        return h.hexdigest()


def check_same_psds(observations: Sequence[Observation], rig: Rig) -> None:
    """Raise RecordingError if a recording is of another number of PSDs than the ``rig`` of the search."""
    for o in observations:
        if o.psds != len(rig.psds):
            raise RecordingError(
                f'{o.name}: is of {o.psds} PSDs, the rig of the search has {len(rig.psds)}: search them one by one'
            )


def load_cases(loads: FloatArray, period: float) -> IntArray:
    """Return the load case of each sample, int (n,), counted from 0.

    A case begins if the load changes after at least ``QUIET`` seconds of rest. Each step with its
    ringing is one case; a sweep or ramp is one case. If there is only one case, it is cut into four
    pieces.
    """
    n = len(loads)
    changed = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    quiet = max(1, round(QUIET / period))
    case = np.zeros(n, dtype=np.int64)
    starts = [int(c) for i, c in enumerate(changed) if i == 0 or c - changed[i - 1] >= quiet]
    for start in starts:
        case[start:] += 1
    if len(starts) < 2:
        case = np.arange(n, dtype=np.int64) * 4 // n
    return case
